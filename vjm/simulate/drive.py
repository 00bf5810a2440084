"""Measured joint torques as an integrator's steps see them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.errors import InsufficientDataError
from vjm.experiment.records import Recording

Array = NDArray[np.float64]

_GAUSS = np.array([-1.0, 1.0]) / np.sqrt(3.0)  # exact for the product of a line and a quadratic


@dataclass(frozen=True)
class Drive:
    """Active joints' torques over evenly spaced steps.

    Within a step the torque may have kinks at its samples. There it is replaced by the quadratic with the same mean,
    first and second moment: all that motion slower than the step can tell apart.

    Attributes:
        start, middle, end: (S, C, n_a) the quadratic's values at the steps' ends and middles [N m].
        ends: (S + 1, C, n_a) the torque itself at the steps' ends [N m].
        first: (C,) instants of the first step's start [s].
        step: [s].
    """

    start: Array
    middle: Array
    end: Array
    ends: Array
    first: Array
    step: float

    @classmethod
    def of(cls, recordings: Sequence[Recording], step: float, count: int) -> Drive:
        """The drive of C recordings, each from its own first instant; no torque acts after a recording's end.

        Raises:
            InsufficientDataError: an active joint without measured torque.
        """
        parts = [_fitted(*measured_torque(recording), recording.time, step, count) for recording in recordings]
        start, middle, end, ends = (np.stack(each, axis=1) for each in zip(*parts, strict=True))
        return cls(start, middle, end, ends, np.array([recording.time[0] for recording in recordings]), step)


def measured_torque(recording: Recording) -> tuple[Array, Array]:
    """Instants (T',) [s] and torques (T', n_a) [N m] at which all the active joints' torques were measured.

    Raises:
        InsufficientDataError: an active joint without measured torque: what drives it is unknown.
    """
    if recording.tau.shape[1] == 0:
        return recording.time[:1], np.zeros((1, 0))
    known = np.isfinite(recording.tau).all(axis=1)
    if known.sum() < 2:
        raise InsufficientDataError(
            f"simulation of {recording.file}",
            "no torque was measured at its active joints",
            "record the column LINK.tau",
        )
    return recording.time[known], recording.tau[known]


def _fitted(knots: Array, torque: Array, time: Array, step: float, count: int) -> tuple[Array, Array, Array, Array]:
    """The quadratics' values (S, n_a) at starts, middles and ends, and the torque at the steps' ends (S + 1, n_a)."""
    edges = np.asarray(time[0] + step * np.arange(count + 1))
    # Pieces on which the torque is a line: between neighbouring knots and steps' ends.
    inner = knots[(knots > edges[0]) & (knots < edges[-1])]
    bounds = np.union1d(edges, inner)
    middles, halves = (bounds[1:] + bounds[:-1]) / 2, np.diff(bounds) / 2
    owner = np.clip(((middles - edges[0]) / step).astype(int), 0, count - 1)
    instants = middles[:, None] + halves[:, None] * _GAUSS
    x = (instants - edges[owner][:, None]) * 2 / step - 1
    moments = (np.ones_like(x), x, (3 * x**2 - 1) / 2)
    after = time[-1] + 1e-9 * step
    quadratics, ends = [], []
    for column in torque.T:
        values = np.where(instants > after, 0.0, np.interp(instants, knots, column)) * halves[:, None]
        c0, c1, c2 = (
            (2 * k + 1) / step * np.bincount(owner, (values * moment).sum(axis=1), count)
            for k, moment in enumerate(moments)
        )
        quadratics.append((c0 - c1 + c2, c0 - c2 / 2, c0 + c1 + c2))
        ends.append(np.where(edges > after, 0.0, np.interp(edges, knots, column)))
    if not quadratics:
        empty = np.zeros((count, 0))
        return empty, empty, empty, np.zeros((count + 1, 0))
    start, middle, end = (np.stack(each, axis=-1) for each in zip(*quadratics, strict=True))
    return start, middle, end, np.stack(ends, axis=-1)
