"""A trajectory at an integrator's own steps, and at any instant between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Steps:
    """A trajectory at the integrator's own instants.

    Attributes:
        time: (S + 1,) evenly spaced [s].
        q, v, a: (S + 1, C, nv) angles [rad], rates [rad/s] and accelerations [rad/s^2] of C copies.
        z: (S + 1, C, nz) internal states of the effects.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    z: Array

    @property
    def step(self) -> float:
        """Distance between instants [s]."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


def sample(steps: Steps, time: Array) -> tuple[Array, Array]:
    """Angles and rates at any instants between the first and last step, by quintic Hermite interpolation.

    Args:
        steps: the trajectory.
        time: (T,) [s].

    Returns:
        q, v (T, C, nv) [rad, rad/s].
    """
    h = steps.step
    k = np.clip(((time - steps.time[0]) / h).astype(int), 0, len(steps.time) - 2)
    s = ((time - steps.time[k]) / h)[:, None, None]
    q0, v0, a0 = steps.q[k], steps.v[k] * h, steps.a[k] * h * h / 2
    jump = steps.q[k + 1] - q0 - v0 - a0
    slope = steps.v[k + 1] * h - v0 - 2 * a0
    bend = (steps.a[k + 1] * h * h - 2 * a0) / 2
    c3, c4, c5 = 10 * jump - 4 * slope + bend, -15 * jump + 7 * slope - 2 * bend, 6 * jump - 3 * slope + bend
    q = q0 + s * (v0 + s * (a0 + s * (c3 + s * (c4 + s * c5))))
    v = (v0 + s * (2 * a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h
    return q, v


def still(time: Array, q: Array) -> Steps:
    """An arm that stays at angles (nv,) [rad] from the first of the instants [s] to the last."""
    ends = np.array([time[0], time[-1]])
    each = (np.broadcast_to(x, (2, 1, x.size)) for x in (q, 0 * q, 0 * q, np.zeros(0)))
    return Steps(ends, *each)
