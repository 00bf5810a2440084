"""Stiffness and damping of a UR5's forearm from a motion: markers in space and encoders.

The motion is simulated, with 0.2 mm and 20 microradian of noise, by the robot that nobody knows; the identification
begins with a guess (docs/how-to/identify-robot.md).

python examples/identify_robot.py [ur5_robot.urdf]        (without it: the one of PyPI's example-robot-data)
"""

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from ur5_slew import START, follow_exactly, ur5

import vjm
from vjm.model.kinematics import marker_tree

RATE, DURATION, NOISE, ENCODER = 250, 5.0, 2e-4, 2e-5  # Hz, s, m, rad
MARKERS = [("forearm_link", np.array([side, 0.05, arc])) for arc in (0.13, 0.26, 0.39) for side in (-0.1, 0.1)]


def forearm(file, bending, torsion, kelvin_voigt):
    """Return the robot with a forearm of two virtual joints."""
    options = {"bending_stiffness": bending, "torsion": torsion, "kelvin_voigt": kelvin_voigt}
    return vjm.FlexibleModel.from_urdf(vjm.flexify(file, link="forearm_link", joints=2, **options))


def wander(t):
    """Return angles, rates and accelerations (..., 6) of the motors: tones up to 12 Hz, faded in."""
    rng = np.random.default_rng(1)
    tones = 2 * np.pi * np.linspace(0.7, 12.0, 12)
    phases = rng.uniform(0, 2 * np.pi, (START.size, tones.size))
    sizes = 0.15 / tones
    angle = np.sin(tones * np.asarray(t)[..., None, None] + phases) @ sizes
    rate = np.cos(tones * np.asarray(t)[..., None, None] + phases) @ (sizes * tones)
    acceleration = -np.sin(tones * np.asarray(t)[..., None, None] + phases) @ (sizes * tones**2)
    return START + angle, rate, acceleration


def recorded(file, duration=DURATION):
    """Return instants (T,), encoders (T, 6) and markers' positions (T, k, 3) of a motion, with noise."""
    truth = forearm(file, (400.0, 300.0), 150.0, 2e-3)
    posture = np.zeros(truth.model.nq)
    posture[truth.active] = wander(0.0)[0]
    time, q = follow_exactly(truth, wander, truth.static_equilibrium(posture).q, duration, 4e-4)
    every = round(1 / RATE / 4e-4)
    time, q = time[::every], q[::every]

    rng = np.random.default_rng(2)
    positions, _ = marker_tree(truth, MARKERS).positions(q)
    positions += NOISE * rng.normal(size=positions.shape)
    encoders = q[:, truth.active] + ENCODER * rng.normal(size=(len(q), truth.active.size))
    return time, encoders, positions


def main(file=None):
    file = file or ur5()
    time, encoders, positions = recorded(file)
    guess = forearm(file, (250.0, 500.0), 250.0, 1e-3)
    fit = vjm.identify_stiffness(
        guess, encoders, None, None, None, positions, time=time, markers=MARKERS, bandwidth=20.0
    )
    print(fit)
    values = {"x": 400.0, "y": 300.0, "torsion": 150.0}
    true = np.array([B * factor for B in values.values() for factor in (1.0, 2e-3)])
    begun = np.array([B * factor for B in (250.0, 500.0, 250.0) for factor in (1.0, 1e-3)])
    found, stds = (np.array([getattr(each, name) for each in fit.parameters]) for name in ("value", "std"))
    errors = np.abs(100 * (found / true - 1))
    print(f"largest error: stiffness {errors[::2].max():.2f} %, damping {errors[1::2].max():.2f} %")

    figure, axes = plt.subplots(figsize=(8, 3.8))
    rows = np.arange(true.size)[::-1]
    axes.axvline(1.0, color="0.7", lw=1)
    axes.plot(begun / true, rows, "o", mfc="white", color="#c0392b", label="guess")
    bars = {"fmt": "o", "color": "#0b2f5c", "capsize": 4, "ms": 5}
    axes.errorbar(found / true, rows, xerr=1.96 * stds / true, label="identified, with 95 % bars", **bars)
    axes.set_yticks(rows, [each.name.partition(".")[2].replace("_", " ") for each in fit.parameters])
    axes.set(xlabel="over the truth", xlim=(0.2, 1.9))
    axes.legend(loc="lower right")
    axes.set_title(f"Forearm of a UR5 from {DURATION:.0f} s of motion: stiffness right to {errors[::2].max():.1f} %")
    figure.savefig("identify_robot.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main(*sys.argv[1:])
