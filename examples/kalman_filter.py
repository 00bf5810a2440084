"""Bend of a flexible arm in real time: an extended Kalman filter from an encoder and two markers.

The state is angles and rates of motor and virtual joints; a random torque shakes the motor. If the filter is right
about itself, 95 % of the true angles are within its own 1.96 sigma, and the state's normalised squared error (NEES) has
the size of the state: Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and
Navigation, 2001, sections 5.4 and 10.3. Run it: python examples/kalman_filter.py
"""

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import vjm
from vjm.chain.curve import marker_poses

MARKER, ENCODER, SHAKE = 5e-4, 2e-4, 0.3  # noise: of a marker [m], of the encoder [rad], of the torque for a step [N m]
STEP, STEPS, SUBSTEPS = 0.005, 800, 5  # s, of the filter; and of the integration in each of them
LINK = vjm.Link("beam", "revolute", 1.0, 0.44, 2.4, (0.5, 1.0), hub_inertia=0.05, payload=0.1)
MODEL = vjm.Model.nominal(vjm.Rig("arm with a motor", (LINK,)), virtual_joints=3, kelvin_voigt=2e-3)  # or fit.model
FLEXIBLE = MODEL.flexible_model()
SIZE = FLEXIBLE.model.nv


def derivative(x, torque):
    """Return x' of states (m, 2 nv) under motor torques (m,)."""
    q, v = x[:, :SIZE], x[:, SIZE:]
    return np.hstack([v, FLEXIBLE.forward_dynamics(q, v, torque[:, None])])


def moved(x, torque):
    """Return states (m, 2 nv) one step later under constant torques (m,), by Runge and Kutta's method."""
    h = STEP / SUBSTEPS
    for _ in range(SUBSTEPS):
        k1 = derivative(x, torque)
        k2 = derivative(x + h / 2 * k1, torque)
        k3 = derivative(x + h / 2 * k2, torque)
        k4 = derivative(x + h * k3, torque)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def slopes(f, x, step=1e-6):
    """Return f(x) and its derivative by x, all differences in one batch."""
    steps = step * np.eye(x.size)
    values = f(np.vstack([x, x + steps, x - steps]))
    return values[0], (values[1 : 1 + x.size] - values[1 + x.size :]).T / (2 * step)


def sensors(x):
    """Return encoder and both markers' coordinates (m, 5) in states (m, 2 nv)."""
    markers, _ = marker_poses(MODEL.chain, x[:, :SIZE], [np.array(LINK.markers)], (False,))
    return np.hstack([x[:, :1], markers.reshape(len(x), -1)])


def main(seed=1):
    rng = np.random.default_rng(seed)
    noise = np.diag(np.r_[ENCODER**2, np.full(4, MARKER**2)])
    spread = np.diag(np.r_[np.full(SIZE, 0.02**2), np.full(SIZE, 0.1**2)])
    true, x, P = rng.multivariate_normal(np.zeros(2 * SIZE), spread), np.zeros(2 * SIZE), spread
    rows = []
    for k in range(STEPS):
        torque = 0.8 * np.sin(2 * np.pi * 0.7 * k * STEP)
        true = moved(true[None], np.array([torque + SHAKE * rng.normal()]))[0]
        measured = sensors(true[None])[0] + np.sqrt(np.diag(noise)) * rng.normal(size=5)

        # Prediction: state and torque together, whose noise is the random torque.
        both, J = slopes(lambda s: moved(s[:, :-1], s[:, -1]), np.r_[x, torque])
        x, P = both, J[:, :-1] @ P @ J[:, :-1].T + SHAKE**2 * np.outer(J[:, -1], J[:, -1])
        # Correction, in Joseph's form, which stays symmetric.
        expected, H = slopes(sensors, x)
        K = np.linalg.solve(H @ P @ H.T + noise, H @ P).T
        x = x + K @ (measured - expected)
        keep = np.eye(x.size) - K @ H
        P = keep @ P @ keep.T + K @ noise @ K.T
        error = true - x
        rows.append((true[1:SIZE], x[1:SIZE], np.sqrt(np.diag(P))[1:SIZE], error @ np.linalg.solve(P, error)))
    phi, found, sigma, nees = (np.array(column) for column in zip(*rows, strict=True))
    inside = 100 * np.mean(np.abs(phi - found) < 1.96 * sigma)
    print(f"bend within 1.96 sigma: {inside:.1f} % of the time (95 %)")
    print(f"normalised squared error of the state: {nees.mean():.2f} ({2 * SIZE})")
    error = 1e3 * np.sqrt(np.mean((phi - found) ** 2))
    print(f"error of the angles: {error:.2f} mrad RMS, of {1e3 * np.std(phi):.0f} mrad")

    time = STEP * np.arange(1, STEPS + 1)
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(8, 5), height_ratios=(1, 1))
    above.plot(time, 1e3 * phi[:, 0], color="0.6", lw=3, label="true")
    above.plot(time, 1e3 * found[:, 0], color="#0b2f5c", lw=1, label="filter, from encoder and two markers")
    above.set_ylabel("first virtual joint [mrad]")
    above.set_ylim(top=1.9e3 * phi[:, 0].max())
    above.legend(loc="upper right", ncols=2)
    above.set_title(f"The filter is right about itself: {inside:.0f} % of its errors within 95 % bounds")
    bound = 1.96e3 * sigma[:, 0]
    below.fill_between(time, -bound, bound, color="#c9d6e8", label="95 % by the filter")
    below.plot(time, 1e3 * (phi - found)[:, 0], color="#c0392b", lw=0.8, label="error")
    below.set(xlabel="time [s]", ylabel="error [mrad]", ylim=(-2 * bound[-1], 3 * bound[-1]), xlim=(0, time[-1]))
    below.legend(loc="upper right", ncols=2)
    figure.savefig("kalman_filter.png", dpi=150, bbox_inches="tight")


if __name__ == "__main__":
    main()
