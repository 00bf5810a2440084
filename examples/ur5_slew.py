"""A UR5 whose forearm bends and twists: a slew, the vibration it leaves, and the same slew shaped.

python examples/ur5_slew.py [ur5_robot.urdf]        (without it: the one of PyPI's example-robot-data)
"""

import sys
from functools import reduce
from importlib import metadata

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from input_shaping import convolved, zvd

import vjm

START = np.array([0.0, -1.2, 1.0, -0.6, 0.8, 0.0])  # rad
GOAL = START + np.array([0.8, 0.3, -0.2, 0.0, 0.0, 0.0])
SLEW, DURATION, STEP = 0.35, 2.5, 5e-4  # s


def ur5():
    """Return the file of the UR5, or end with a sentence."""
    try:
        package = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        sys.exit("ur5_slew.py needs a URDF of the UR5: pip install example-robot-data, or give the file")
    return package.locate_file("cmeel.prefix/share/example-robot-data/robots/ur_description/urdf/ur5_robot.urdf")


def flexible(file):
    """Return the robot with a forearm far softer than its own, for the eye."""
    text = vjm.flexify(
        file, link="forearm_link", joints=2, bending_stiffness=150.0, torsion=100.0, kelvin_voigt=3e-4
    )  # or of an identification: docs/how-to/identify-robot.md
    return vjm.FlexibleModel.from_urdf(text)


def slew(t):
    """Return angles, rates and accelerations (..., 6) of a smooth slew (a quintic, at rest at both ends)."""
    s = np.clip(np.asarray(t)[..., None] / SLEW, 0.0, 1.0)
    way = GOAL - START
    rate, acceleration = 30 * s**2 * (1 - s) ** 2 / SLEW, 60 * s * (1 - s) * (1 - 2 * s) / SLEW**2
    return START + way * s**3 * (10 - 15 * s + 6 * s**2), way * rate, way * acceleration


def shaped(impulses):
    """Return the slew after a shaper, as `slew` does."""
    times, sizes = impulses
    return lambda t: [sizes @ values for values in slew(t - times)]


def follow_exactly(robot, motors, start, duration, step):
    """Return time and angles (T, nv) of all joints when the motors follow a motion exactly, by Runge and Kutta.

    `motors` gives their angles, rates and accelerations at a time.
    """
    size, moving, driven = robot.model.nv, robot.passive, robot.active
    units = np.vstack([np.zeros(size), np.eye(size)[moving]])

    def motion(t, x):
        q, v, a = np.zeros((3, size))
        q[driven], v[driven], a[driven] = motors(t)
        q[moving], v[moving] = np.split(x, 2)
        return q, v, a

    def derivative(t, x):
        q, v, a = motion(t, x)
        # The springs' joints are free of torque: M22 phi'' = -(M21 theta'' + h2 + K phi + D phi').
        torques = robot.inverse_dynamics(q, v, a + units)[:, moving]
        return np.r_[v[moving], np.linalg.solve((torques[1:] - torques[0]).T, -torques[0])]

    x, rows = np.r_[start[moving], np.zeros(moving.size)], []
    time = step * np.arange(round(duration / step))
    for t in time:
        rows.append(motion(t, x)[0])
        k1 = derivative(t, x)
        k2 = derivative(t + step / 2, x + step / 2 * k1)
        k3 = derivative(t + step / 2, x + step / 2 * k2)
        k4 = derivative(t + step, x + step * k3)
        x = x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return time, np.array(rows)


def main(file=None):
    robot = flexible(file or ur5())
    begin, end = np.zeros((2, robot.model.nq))
    begin[robot.active], end[robot.active] = START, GOAL
    rest = robot.static_equilibrium(begin)
    goal = robot.static_equilibrium(end).q
    modes, target = robot.modes(goal), position(robot, goal)
    vibrations = list(zip(modes.frequencies.tolist(), modes.damping_ratios.tolist(), strict=True))[:3]
    print("forearm's modes:", ", ".join(f"{f:.2f} Hz ({100 * d:.1f} %)" for f, d in vibrations))
    shaper = reduce(convolved, (zvd(*vibration) for vibration in vibrations))
    cases = {"slew as it is": ((np.zeros(1), np.ones(1)), "#c0392b"), "shaped (ZVD)": (shaper, "#0b2f5c")}
    figure, axes = plt.subplots(figsize=(8, 4))
    left, axis = [], 0
    for name, (impulses, colour) in cases.items():
        time, q = follow_exactly(robot, shaped(impulses), rest.q, DURATION, STEP)
        hand = np.array([position(robot, each) for each in q[::8]])
        after = SLEW + impulses[0].max()
        swing = np.ptp(hand[time[::8] > after], axis=0)
        axis = int(np.argmax(swing)) if not left else axis  # the one along which it swings most
        left.append(1e3 * float(swing.max()))
        miss = 1e3 * (hand - target)[:, axis]
        axes.plot(time[::8], miss, color=colour, label=f"{name}: {left[-1]:.1f} mm left after {after:.2f} s")
        axes.axvline(after, color=colour, lw=0.8, ls=":")
    plain, little = left
    print(
        f"hand swings by {plain:.2f} mm after the slew, by {little:.2f} mm when shaped: {plain / little:.0f} times less"
    )
    axes.set(xlabel="time [s]", ylabel=f"hand from its target along {'xyz'[axis]} [mm]", xlim=(0, DURATION))
    axes.set_ylim(-plain, 1.7 * plain)
    axes.legend(loc="upper right")
    axes.set_title(f"UR5 with a flexible forearm: {plain:.0f} mm of swing after a slew, {little:.1f} mm if shaped")
    figure.savefig("ur5_slew.png", dpi=150, bbox_inches="tight")


def position(robot, q):
    """Return where the hand is in the world (3,) [m]."""
    import pinocchio as pin

    data = robot.model.createData()
    pin.framesForwardKinematics(robot.model, data, q)
    return data.oMf[robot.model.getFrameId("ee_link")].translation.copy()


if __name__ == "__main__":
    main(*sys.argv[1:])
