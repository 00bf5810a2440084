"""Noise of frames that are not taken at the instants of their stamps.

In each frame all markers are off along their velocities, by one error of time. To first order in these errors, which
are independent of each other with a variance s^2, the covariance of a frame's weighted residuals is I + s^2 u u^T, with
u its weighted velocities (Balakrishnan, On the problem of time jitter in sampling, IRE Transactions on Information
Theory 8(3), 1962). Minus twice the logarithm of the likelihood is the sum of squares of the residuals that are made
white, and of the logarithms of 1 + s^2 u^T u.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy import sparse

from vjm.records import Array
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import Observations
from vjm.simulation.system import Trajectory

_MOST_STEPS = 50  # by Fisher scoring, which needs a few
_TOLERANCE = 1e-6  # of a variance


@dataclass(frozen=True)
class TimingNoise:
    """Errors of the instants at which the frames of a recording were taken.

    Attributes:
        variance: of the errors [s^2].
        velocities: (F, N) sparse, weighted velocity of each measured value, in the row of its frame [1/s].
    """

    variance: float
    velocities: sparse.csr_array

    @classmethod
    def of(cls, observed: Observations, arm: Arm, trajectory: Trajectory) -> Self:
        """Return the errors of an arm's camera along a trajectory."""
        velocities = observed.arcs.velocities(arm, trajectory, observed.recording.time[observed.frames])
        weights = observed.weights[: observed.marker_indices.size]
        if observed.whitening is not None:
            # Whitened, an error shows in the frames after its own as well; it is counted in its own alone.
            squares = np.asarray(observed.whitening.multiply(observed.whitening).sum(axis=0)).ravel()
            weights = weights * np.sqrt(squares[: weights.size])
        frames = observed.marker_indices // (2 * velocities.shape[1])
        entries = weights * velocities.ravel()[observed.marker_indices], (frames, np.arange(frames.size))
        shape = (observed.frames.size, observed.count)
        return cls(arm.timing_variance, sparse.csr_array(entries, shape=shape))

    @cached_property
    def _squares(self) -> Array:
        """(F,) u^T u."""
        return np.asarray(self.velocities.multiply(self.velocities).sum(axis=1)).ravel()

    @cached_property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the weighted residuals' covariance."""
        return float(np.sum(np.log1p(self.variance * self._squares)))

    def whitened(self, weighted: Array) -> Array:
        """Return weighted values (N, ...) transformed so that their noise is white."""
        squares = np.where(self._squares > 0, self._squares, 1.0)
        shares = (1 - 1 / np.sqrt(1 + self.variance * self._squares)) / squares
        result: Array = weighted - self.velocities.T @ (shares * (self.velocities @ weighted).T).T
        return result

    def score(self, residual: Array) -> tuple[float, float]:
        """Return the slope and residual of the row of a least-squares problem that stands for the variance.

        Its gradient is that of the likelihood, its square the expected curvature (Fisher scoring); about a variance of
        zero it gives Rao's score test of a variance component (Lin, Biometrika 84(2), 1997).

        Args:
            residual: (N,) that was made white.
        """
        return _score(*self._errors(residual))

    def likelihood_ratio(self, residual: Array) -> tuple[float, float]:
        """Return a row as of `score`, whose best variance and decrease of chi^2 are those of the likelihood itself.

        Rao's statistic, the square of the squares' excess, predicts too large a decrease for large errors of time.
        Residuals are scaled by their RMS across the velocities, so that noise larger than it was given is not taken for
        errors of time. The decrease is at most the sum of squares along the velocities.
        """
        squares, given = self._errors(residual)
        projections = given / self._mean_square_across(residual)
        best, change = 0.0, np.inf
        for _ in range(_MOST_STEPS):
            spread = 1 + best * squares
            information = squares / spread
            score, curvature = information @ (projections / spread - 1), information @ information
            change = max(float(score / curvature), -best) if curvature > 0 else 0.0
            best += change
            if abs(change) <= _TOLERANCE * best:
                break
        if not best > 0:
            return _score(squares, projections)
        shares = best * squares / (1 + best * squares)
        fall = min(float(projections @ shares - np.sum(np.log1p(best * squares))), float(given.sum()))
        decrease = float(np.sqrt(max(fall, 0.0)))
        return decrease / best, decrease

    def _mean_square_across(self, residual: Array) -> float:
        """Return the mean square of white residuals (N,) of moving frames across their velocities; one without any."""
        moving, v = self._squares > 0, self.velocities
        ones = sparse.csr_array((np.ones(v.nnz), v.indices, v.indptr), shape=v.shape)
        freedom = float((np.diff(v.indptr) - 1)[moving].sum())
        squares = float(np.sum(np.asarray(ones @ residual**2)[moving]) - np.sum(self._errors(residual)[1]))
        return squares / freedom if freedom > 0 and squares > 0 else 1.0

    def _errors(self, residual: Array) -> tuple[Array, Array]:
        """Return squared lengths of moving frames' directions in white residuals (N,), and squares of these along."""
        moving = self._squares > 0
        squares = self._squares[moving]
        projections = (self.velocities @ residual)[moving] ** 2 / squares
        return squares / (1 + self.variance * squares), projections


def _score(squares: Array, projections: Array) -> tuple[float, float]:
    """Return slope and residual of the variance's row, from what `TimingNoise._errors` returns."""
    if not squares.size:
        return 0.0, 0.0
    slope = float(np.linalg.norm(squares) / np.sqrt(2))
    return slope, float(squares @ (projections - 1)) / (2 * slope)
