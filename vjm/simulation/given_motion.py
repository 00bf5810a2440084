"""Joints that turn as their encoders say: their accelerations, and what the encoders' noise may make of these."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.fft import idct
from scipy.interpolate import BSpline, make_smoothing_spline
from scipy.optimize import minimize_scalar

from vjm.effects.effect import Effect
from vjm.records import Array, Recording

# Share of a component of the encoders' noise that the smoothed motion keeps, below which no resonance shows it.
_LEAST_GAIN = 1e-3
_BATCH = 128  # components that are smoothed at once


@dataclass(frozen=True)
class AccelerationError(Effect):
    """Error of the accelerations with which joints turn as their encoders say."""

    error: Array = field(default_factory=lambda: np.zeros((0, 0)), kw_only=True, repr=False)  # (T, n_a) [rad/s^2]

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with the error added to its accelerations, if it has any."""
        if recording.acceleration is None:
            return recording
        return replace(recording, acceleration=recording.acceleration + self.error)


def given_acceleration(recording: Recording, noise: float) -> Array:
    """Return accelerations (T, n_a) [rad/s^2] of joints that turn as their encoders say; noise is these' 1-sigma [rad].

    They are of the cubic smoothing spline with the least expected error. Linear from one measured angle to the next,
    they integrate to the spline exactly.
    """
    accelerations = np.empty(recording.theta.shape)
    for joint in range(recording.theta.shape[1]):
        knots, values, penalty = _smoothing(recording, joint, noise)
        spline = make_smoothing_spline(knots, values, lam=penalty)
        accelerations[:, joint] = _at_instants(recording, knots, spline)[:, 0]
    return accelerations


def acceleration_errors(recording: Recording, noise: float, shortest: float, most: int) -> Iterator[AccelerationError]:
    """Yield errors of `given_acceleration` by the encoders' noise: independent, each of one standard deviation.

    They are those of cosines over the recording, the slowest first: for each joint as many as given at most, down to a
    shortest period [s].
    """
    for joint in range(recording.theta.shape[1]):
        knots, _, penalty = _smoothing(recording, joint, noise)
        slow = int(min(knots.size, most, 1 + 2 * np.ptp(knots) / shortest))
        for first in range(0, slow, _BATCH):
            count = min(_BATCH, slow - first)
            cosines = idct(np.eye(knots.size, count, -first), axis=0, norm="ortho")
            smoothed = make_smoothing_spline(knots, cosines, lam=penalty)
            gains = np.einsum("tk,tk->k", cosines, smoothed(knots))
            accelerations = _at_instants(recording, knots, smoothed)
            for gain, acceleration in zip(gains.tolist(), accelerations.T, strict=True):
                if gain < _LEAST_GAIN:
                    break
                error = np.zeros(recording.theta.shape)
                error[:, joint] = noise * acceleration
                yield AccelerationError(error=error)
            if gains.min() < _LEAST_GAIN:
                break


def _smoothing(recording: Recording, joint: int, noise: float) -> tuple[Array, Array, float]:
    """Return instants (K,) at which an angle was measured [s], the angles (K,) [rad], and the penalty [s^3]."""
    known = np.isfinite(recording.theta[:, joint])
    knots, values = recording.time[known], recording.theta[known, joint]
    return knots, values, _best_penalty(knots, values, noise)


def _at_instants(recording: Recording, knots: Array, spline: BSpline) -> Array:
    """Return the second derivatives (T, k) of k splines at a recording's instants, linear between the knots."""
    columns = np.reshape(spline(knots, 2), (knots.size, -1)).T
    return np.stack([np.interp(recording.time, knots, column) for column in columns], axis=1)


def _best_penalty(time: Array, values: Array, noise: float) -> float:
    """Return the penalty [s^3] with the least expected error of a smoothing spline through values (T,) of known noise.

    It minimises Mallows' statistic (Craven and Wahba, Numerische Mathematik 31, 1979): the squared residuals over the
    noise, and twice the degrees of freedom, which for even instants are the sum of 1 / (1 + penalty omega^4 dt).
    """
    count, duration = time.size, float(np.ptp(time))
    fourth_powers = (np.pi * np.arange(count) / duration) ** 4 * duration / max(count - 1, 1)

    def risk(exponent: float) -> float:
        penalty = float(np.exp(exponent))
        residual = values - make_smoothing_spline(time, values, lam=penalty)(time)
        return float(residual @ residual / noise**2 + 2 * np.sum(1 / (1 + penalty * fourth_powers)))

    # The penalty is a time cubed: from a thousandth of an interval, which interpolates, to all of the recording.
    bounds = 3 * float(np.log(1e-3 * np.diff(time).min())), 3 * float(np.log(duration))
    return float(np.exp(minimize_scalar(risk, bounds=bounds, method="bounded", options={"xatol": 0.05}).x))
