"""Two flexible links with a motor each: put together in Python, driven, simulated and drawn.

python examples/two_links.py
"""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from vjm.chain.curve import marker_positions
from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.model.modes import modes
from vjm.records import Link, Recording, Rig
from vjm.simulation.integrate import simulate

STEEL = 1.93e11 * 0.035 * 0.001**3 / 12  # E w h^3 / 12 of a 35 mm x 1 mm strip [N m^2]
MARKERS = (0.15, 0.3, 0.45, 0.6)  # m

RIG = Rig(
    "two flexible links",
    (
        Link("upper", "revolute", 0.6, 0.16, STEEL, MARKERS, hub_inertia=0.05),
        Link("lower", "revolute", 0.6, 0.16, STEEL, MARKERS, hub_inertia=0.01, payload=0.05),
    ),
)


def arm(rig: Rig, joints: int = 4) -> Chain:
    """Each link cut into virtual links; the upper one carries a moment at its end, the lower one's end is free."""
    links = []
    for link in rig.links:
        distal = "free" if link is rig.links[-1] else "joined"
        cuts = layout(link.length, joints, distal=distal)
        links.append(uniform_chain(link, cuts, kelvin_voigt=1e-3))
    return Chain(rig.name, tuple(links), rig.gravity)


def main() -> None:
    chain = arm(RIG)
    print("natural frequencies:", ", ".join(f"{f:.2f}" for f in modes(chain).frequencies[:4]), "Hz")

    time = np.linspace(0, 1, 401)
    push = 1.2 * np.sin(2 * np.pi * time)  # N m
    torque = np.stack([push, -0.1 * push], axis=1)
    unknown = np.full((time.size, 8, 2), np.nan)  # the markers are what the simulation gives
    drive = Recording(time, unknown, np.full((time.size, 2), np.nan), torque, kind="driven", role="train", file="drive")
    motion = simulate(chain, RIG, drive, q=np.zeros(chain.size), v=np.zeros(chain.size))
    print(f"at t = {time[-1]:g} s: joints at {np.degrees(motion.theta[-1]).round(1)} degrees")

    arcs = tuple(np.linspace(0, link.length, 40) for link in RIG.links)
    curves = marker_positions(chain, motion.q[::50], arcs, (False, False))  # (instants, points, 2), base frame
    figure, axes = plt.subplots(figsize=(6, 5))
    for curve, shade in zip(curves, np.linspace(0.8, 0, len(curves)), strict=True):
        axes.plot(curve[:, 0], curve[:, 1], color=str(shade))
    axes.plot(*motion.markers[::50].reshape(-1, 2).T, "o", ms=3)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="every 0.125 s, later is darker")
    figure.savefig("two_links.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
