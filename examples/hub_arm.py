"""An arm with a motor, identified from two recordings: what the examples on control begin with.

The recordings are simulated, with noise, so that the examples run anywhere and their truth is known; with yours,
replace `recordings` (docs/how-to/arrays.md). Run it: python examples/hub_arm.py
"""

from functools import cache

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import vjm

MARKERS = (0.25, 0.5, 0.75, 1.0)  # m
NOISE = 2e-4  # of a marker coordinate [m]
ENCODER = 1e-4  # [rad]


def rig(bending_stiffness: float) -> vjm.Rig:
    link = vjm.Link("beam", "revolute", 1.0, 0.44, bending_stiffness, MARKERS, hub_inertia=0.05, payload=0.1)
    return vjm.Rig("arm with a motor", (link,), marker_noise=NOISE, encoder_noise=ENCODER)


TRUTH = vjm.Model.nominal(rig(2.4), virtual_joints=8, kelvin_voigt=8e-4)  # nobody knows it; it is the plant


def recordings() -> list[vjm.Recording]:
    """A push to and fro, for the fit, and another one to judge it by."""
    found = []
    for role, seed in (("train", 1), ("holdout", 2)):
        rng = np.random.default_rng(seed)
        t = np.linspace(0.0, 4.0, 801)
        tones = np.array([0.5, 1.1, 2.3, 6.1])
        torque = np.sin(2 * np.pi * tones * t[:, None] + rng.uniform(0, 2 * np.pi, 4)) @ np.array([0.6, 0.5, 0.4, 0.4])
        torque *= np.minimum(1.0, t / 0.2)
        motion = TRUTH.simulate(torque=torque, duration=4.0)
        markers = motion.markers + NOISE * rng.normal(size=motion.markers.shape)
        theta = motion.theta + ENCODER * rng.normal(size=motion.theta.shape)
        found.append(vjm.Recording(t, markers, theta, torque[:, None], kind="driven", role=role, file=f"push {seed}"))
    return found


@cache
def identified() -> vjm.Identification:
    """Identify the arm from a guess of its stiffness that is a fifth off."""
    return vjm.identify(vjm.Experiment(rig(2.0), tuple(recordings())), method="torque")


def main() -> None:
    fit = identified()
    stiffness = fit["beam.bending_stiffness"]
    print(stiffness)
    fit.plot_fit("push 2")
    plt.savefig("hub_arm.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
