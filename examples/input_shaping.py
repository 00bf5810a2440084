"""Slew of a flexible arm with and without input shaping, from identified frequencies and dampings.

The slew is convolved with the three impulses of a zero-vibration-and-derivative (ZVD) shaper for each of two modes: N.
C. Singer and W. P. Seering, Preshaping command inputs to reduce system vibration, ASME J. Dyn. Syst. Meas. Control 112,
1990. The plant is the arm that nobody knows. Run it: python examples/input_shaping.py
"""

import matplotlib

matplotlib.use("Agg")
import hub_arm
import matplotlib.pyplot as plt
import numpy as np

ANGLE, SLEW, DURATION = 0.5, 0.5, 4.0  # rad, s, s
STIFF, DAMPED = 60.0, 6.0  # motor's position control [N m/rad], [N m s/rad]


def vibrations(model):
    """Return frequencies [Hz] and damping ratios of the arm whose motor is under position control, slowest first."""
    linear = model.flexible_model().state_space(np.zeros(model.chain.size))
    feedback = np.zeros((1, len(linear.A)))
    feedback[0, [0, len(linear.A) // 2]] = STIFF, DAMPED
    poles = np.linalg.eigvals(linear.A - linear.B @ feedback)
    poles = sorted(poles[(poles.imag > 0) & (-poles.real < 0.3 * np.abs(poles))], key=abs)
    return [(abs(pole) / (2 * np.pi), -pole.real / abs(pole)) for pole in poles]


def zvd(frequency, damping):
    """Return instants [s] and sizes of the three impulses of a ZVD shaper."""
    decay = np.exp(-np.pi * damping / np.sqrt(1 - damping**2))
    period = 1 / (frequency * np.sqrt(1 - damping**2))
    return period * np.array([0.0, 0.5, 1.0]), np.array([1.0, 2 * decay, decay**2]) / (1 + decay) ** 2


def convolved(first, second):
    """Return the impulses of two shapers one after the other."""
    return np.add.outer(first[0], second[0]).ravel(), np.outer(first[1], second[1]).ravel()


def slew(t, duration):
    """Return angle and rate of a smooth slew (a quintic, at rest at both ends)."""
    s = np.clip(t / duration, 0.0, 1.0)
    return ANGLE * s**3 * (10 - 15 * s + 6 * s**2), ANGLE * 30 * s**2 * (1 - s) ** 2 / duration


def follow(duration, impulses):
    """Return the control law that follows a slew after a shaper."""
    times, sizes = impulses

    def law(t, theta, rate):
        angle, speed = (sizes @ values for values in slew(t - times, duration))
        return STIFF * (angle - theta) + DAMPED * (speed - rate)

    return law


def main() -> None:
    first, second = vibrations(hub_arm.identified().model)[:2]
    shaper = convolved(zvd(*first), zvd(*second))
    none, late = (np.zeros(1), np.ones(1)), SLEW + shaper[0].max()
    cases = {
        "slew as it is": (SLEW, none, "#c0392b"),
        "as slow as the shaped one": (late, none, "0.6"),
        "shaped (ZVD)": (SLEW, shaper, "#0b2f5c"),
    }

    figure, axes = plt.subplots(figsize=(8, 4))
    left = []
    for name, (duration, impulses, colour) in cases.items():
        motion = hub_arm.TRUTH.simulate(torque=follow(duration, impulses), duration=DURATION)
        x, y = motion.markers[:, -1].T
        miss, end = 1e3 * (np.arctan2(y, x) - ANGLE), duration + impulses[0].max()  # the tip is at 1 m
        left.append(float(np.abs(miss[motion.time > end]).max()))
        axes.plot(motion.time, miss, color=colour, label=f"{name}: {left[-1]:.1f} mm left after {end:.2f} s")
        axes.axvline(end, color=colour, lw=0.8, ls=":")
    plain, slow, shaped = left
    cut = 100 * (1 - shaped / plain)
    print(
        f"modes under control: {first[0]:.3f} Hz ({100 * first[1]:.2f} %), {second[0]:.3f} Hz ({100 * second[1]:.2f} %)"
    )
    print(f"residual vibration of the tip: {plain:.2f} mm without a shaper, {slow:.2f} mm as slow as with it,")
    print(f"{shaped:.2f} mm with it: {cut:.2f} % less")
    axes.set(xlabel="time [s]", ylabel="tip from its target [mm]", xlim=(0, DURATION))
    axes.set_ylim(-1.3 * plain, 2.3 * plain)
    axes.legend(loc="upper right")
    axes.set_title(
        f"A slew by {np.degrees(ANGLE):.0f} degrees: {plain:.0f} mm of residual vibration, {shaped:.1f} mm if shaped"
    )
    figure.savefig("input_shaping.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
