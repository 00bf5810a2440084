"""Two flexible links with a motor each: put together in Python, driven, simulated and drawn.

python examples/two_links.py
"""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from vjm.chain.curve import marker_poses
from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.model.modes import modes
from vjm.records import Link, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.measurement import MarkerArcs, sensor_readings

STEEL = 1.93e11 * 0.035 * 0.001**3 / 12  # E w h^3 / 12 of a 35 mm x 1 mm strip [N m^2]
MARKERS = (0.15, 0.3, 0.45, 0.6)  # m

RIG = Rig(
    "two flexible links",
    (
        Link("upper", "revolute", 0.6, 0.16, STEEL, MARKERS, hub_inertia=0.05),
        Link("lower", "revolute", 0.6, 0.16, STEEL, MARKERS, hub_inertia=0.01, payload=0.05),
    ),
)


def main() -> None:
    # The upper link carries a moment at its end, the lower one's end is free: they are cut differently.
    chain = nominal_chain(RIG, rig_layouts(RIG, [4, 4]), kelvin_voigt=1e-3)
    print("natural frequencies:", ", ".join(f"{f:.2f}" for f in modes(chain).frequencies[:4]), "Hz")

    time = np.linspace(0, 1, 401)
    push = 1.2 * np.sin(2 * np.pi * time)  # N m
    torque = np.stack([push, -0.1 * push], axis=1)
    unknown = np.full((time.size, 8, 2), np.nan)  # the markers are what the simulation gives
    drive = Recording(time, unknown, np.full((time.size, 2), np.nan), torque, kind="driven", role="train", file="drive")
    arm, rest = Arm(chain), np.zeros(chain.size)
    (trajectory,) = simulate_trajectories([arm], [drive], [rest], [rest])
    motion = sensor_readings(arm, MarkerArcs.of(RIG), drive, trajectory)
    print(f"at t = {time[-1]:g} s: joints at {np.degrees(motion.theta[-1]).round(1)} degrees")

    arcs = tuple(np.linspace(0, link.length, 40) for link in RIG.links)
    curves, _ = marker_poses(chain, motion.q[::50], arcs, (False, False))  # (instants, points, 2), base frame
    figure, axes = plt.subplots(figsize=(6, 5))
    for curve, shade in zip(curves, np.linspace(0.8, 0, len(curves)), strict=True):
        axes.plot(curve[:, 0], curve[:, 1], color=str(shade))
    axes.plot(*motion.markers[::50].reshape(-1, 2).T, "o", ms=3)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="every 0.125 s, later is darker")
    figure.savefig("two_links.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
