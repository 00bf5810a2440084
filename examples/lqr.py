"""LQR of a flexible arm on its identified model, beside the same LQR on a rigid model of it.

Both weigh the tip's distance from its target and the motor's torque alike. The flexible one plans the motion of motor
and beam, without a sensor of the bend: its torque goes to the motor, and the encoder holds that to the plan. The
plant is the arm that nobody knows, nonlinear and with more virtual joints. Run it: python examples/lqr.py
"""

import control
import matplotlib

matplotlib.use("Agg")
import hub_arm
import matplotlib.pyplot as plt
import numpy as np

TARGET = 0.5  # rad
DURATION, MOVED = 4.0, 1.5  # s; what moves from then on is residual vibration
ACCURACY, EFFORT = 0.1, 1.0  # m at the tip that count as much as N m of the motor


def gains(model):
    """Return the LQR's gains, its linear model and the tip's derivative by the state."""
    flexible = model.flexible_model()
    rest = np.zeros(flexible.model.nq)
    tip = list(model.marker_slopes(rest).values())[-1]
    linear = flexible.state_space(rest, outputs={"tip": tip})
    Q = linear.C.T @ linear.C / ACCURACY**2
    K, _, _ = control.lqr(linear.A, linear.B, Q, np.eye(1) / EFFORT**2)
    return np.asarray(K), linear, tip


def rigid_gains(model):
    """Return the same LQR's gains for the arm as a rigid body: angle and rate of its motor."""
    flexible = model.flexible_model()
    M, _, _ = flexible.linearise(np.zeros(flexible.model.nq), coordinates="active")
    length = model.rig.links[0].length
    K, _, _ = control.lqr([[0, 1], [0, 0]], [[0], [1 / M[0, 0]]], np.diag([(length / ACCURACY) ** 2, 0]), 1 / EFFORT**2)
    return np.asarray(K)[0]


def tip_angle(motion):
    """Return the direction in which the base sees the tip [rad]."""
    return np.arctan2(motion.markers[:, -1, 1], motion.markers[:, -1, 0])


def main() -> None:
    model = hub_arm.identified().model
    K, linear, _ = gains(model)
    k = rigid_gains(model)

    time = np.linspace(0.0, DURATION, 4001)
    start = np.zeros(len(linear.A))
    start[0] = -TARGET
    closed = control.ss(linear.A - linear.B @ K, linear.B, np.eye(len(linear.A)), 0)
    plan = control.initial_response(closed, time, start).outputs  # of all states, from the target
    torque = -(K @ plan)[0]
    motor, rate = plan[0] + TARGET, plan[len(linear.A) // 2]

    def planned(t, theta, omega):
        at = [np.interp(t, time, values) for values in (torque, motor, rate)]
        return at[0] + k[0] * (at[1] - theta) + k[1] * (at[2] - omega)

    def rigid(t, theta, omega):
        return k[0] * (TARGET - theta) - k[1] * omega

    motions = {law.__name__: hub_arm.TRUTH.simulate(torque=law, duration=DURATION) for law in (rigid, planned)}
    misses = {name: 1e3 * model.rig.links[0].length * (tip_angle(motion) - TARGET) for name, motion in motions.items()}
    late = {name: float(np.std(miss[motions[name].time > MOVED])) for name, miss in misses.items()}
    cut = 100 * (1 - late["planned"] / late["rigid"])
    print(f"residual vibration of the tip: {late['rigid']:.2f} mm RMS with the rigid model's LQR,")
    print(f"{late['planned']:.2f} mm RMS with the identified one's: {cut:.1f} % less")

    figure, axes = plt.subplots(figsize=(8, 4))
    words = {"rigid": "LQR on a rigid model", "planned": "LQR on the identified model"}
    for (name, miss), colour in zip(misses.items(), ("#c0392b", "#0b2f5c"), strict=True):
        axes.plot(motions[name].time, miss, color=colour, label=f"{words[name]}: {late[name]:.1f} mm RMS left")
    axes.axvspan(MOVED, DURATION, color="0.94", zorder=0)
    axes.text(MOVED + 0.05, 0.03, "residual vibration", transform=axes.get_xaxis_transform(), color="0.4")
    limit = 1.3 * max(np.abs(miss[motions[name].time > 0.5]).max() for name, miss in misses.items())
    axes.set(xlabel="time [s]", ylabel="tip from its target [mm]", ylim=(-limit, limit), xlim=(0, DURATION))
    axes.legend(loc="upper right")
    axes.set_title(f"Turning a flexible arm by {np.degrees(TARGET):.0f} degrees: {cut:.0f} % less residual vibration")
    figure.savefig("lqr.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
