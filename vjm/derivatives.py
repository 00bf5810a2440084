"""Angles' rates and accelerations from sampled angles: smoothing splines, and the paper's interpolating spline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, CubicSpline
from scipy.linalg import solveh_banded
from scipy.optimize import brentq
from scipy.sparse import csr_array, dia_array

from vjm.errors import InsufficientDataError, ShapeError

Array = NDArray[np.float64]

# Degree 7 keeps the second derivative right to 0.1 % at four samples a period, where a cubic spline is 20 % off.
_DEGREE = 7
_PENALTY = 4  # order of the penalised difference
_ROUGHEST, _SMOOTHEST = -4.0, 10.0  # log10 of the penalty searched
INTERPOLATION_STEP = 0.004  # s, the paper's grid
_KERNEL_TAIL = 0.02  # of the kernel's energy may lie outside the recording at the first and last instants kept


@dataclass(frozen=True)
class Derivatives:
    """Signals with their rates and accelerations.

    Attributes:
        time: (S,) [s].
        value, rate, acceleration: (S, m) in the signals' unit, per s and per s^2.
        gains: (3, 3) covariance of (value, rate, acceleration) per unit variance of a sample, away from the ends.
        interior: (S,) instants far enough from the ends for `gains` to hold.
        smoothing: log10 of the spline's penalty; None for interpolation.
    """

    time: Array
    value: Array
    rate: Array
    acceleration: Array
    gains: Array
    interior: NDArray[np.bool_]
    smoothing: float | None

    def noise(self, sample_noise: ArrayLike) -> Array:
        """(3, m) 1-sigma noise of value, rate and acceleration for sample noise (m,)."""
        return np.sqrt(np.diag(self.gains))[:, None] * np.asarray(sample_noise, dtype=float)


def interpolate(time: ArrayLike, values: ArrayLike, step: float = INTERPOLATION_STEP) -> Derivatives:
    """Cubic-spline interpolation on a fine grid, as in the paper.

    Args:
        time: (T,) [s].
        values: (T, m); frames with NaN are left out.
        step: of the grid [s].

    Raises:
        InsufficientDataError: fewer than four frames.
    """
    t, y, _ = _clean(time, values, None)
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-9) + 1)
    spline = CubicSpline(t, y)
    impulse = np.zeros(t.size)
    impulse[t.size // 2] = 1.0
    response = CubicSpline(t, impulse)
    # Averaged over the grid, the response to one sample says how much noise a grid instant carries.
    spread = np.stack([response(grid, d) for d in range(3)]) * np.sqrt(t.size / grid.size)
    return Derivatives(
        grid,
        spline(grid),
        spline(grid, 1),
        spline(grid, 2),
        spread @ spread.T,
        np.ones(grid.size, dtype=bool),
        None,
    )


def smooth(
    time: ArrayLike,
    values: ArrayLike,
    noise: ArrayLike,
    weights: ArrayLike | None = None,
    exponent: float | None = None,
) -> Derivatives:
    """Smoothing spline whose residual is as large as the noise says it should be (discrepancy principle).

    All signals share one penalty, so value, rate and acceleration pass through the same filter and linear relations
    among them survive it. Degree 7 with a penalty on the fourth difference (Eilers and Marx 1996).

    Args:
        time: (T,) [s].
        values: (T, m); frames with NaN are left out.
        noise: (m,) 1-sigma noise of a sample, or (m, m) its covariance.
        weights: (T,) relative inverse variance of the frames; equal when None.
        exponent: log10 of the penalty, to repeat an earlier filter; found from the noise when None.

    Raises:
        InsufficientDataError: fewer than ten frames.
        ShapeError: arrays that do not fit together.
    """
    t, y, w = _clean(time, values, weights, least=10)
    whiten = _whitener(noise, y.shape[1])
    spline = _PenalisedSpline(t, w)
    centre = y.mean(axis=0)
    target = float(y.shape[1] * t.size)

    def excess(exponent: float) -> float:
        residual = (y - centre - spline.basis[0] @ spline.solve(y - centre, exponent)) @ whiten
        return float(np.log(max(np.sum(w[:, None] * residual**2), 1e-300) / target))

    if exponent is None:
        exponent = _root(excess)
    coefficients = spline.solve(y - centre, exponent)
    gains, reach = spline.gains(exponent)
    inside = (t >= t[0] + reach) & (t <= t[-1] - reach)
    value, rate, acceleration = (matrix @ coefficients for matrix in spline.basis)
    return Derivatives(t, value + centre, rate, acceleration, gains, inside, exponent)


def _root(excess: Callable[[float], float]) -> float:
    """Penalty at which the residual is as large as the noise, within the penalties searched."""
    if excess(_SMOOTHEST) <= 0:
        return _SMOOTHEST
    if excess(_ROUGHEST) >= 0:
        return _ROUGHEST
    return float(brentq(excess, _ROUGHEST, _SMOOTHEST, xtol=0.01))


def _clean(
    time: ArrayLike, values: ArrayLike, weights: ArrayLike | None, least: int = 4
) -> tuple[Array, Array, Array]:
    t, y = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    w = np.ones(t.size) if weights is None else np.asarray(weights, dtype=float)
    if y.ndim != 2 or t.shape != y.shape[:1] or w.shape != t.shape:
        raise ShapeError("time, values, weights", (t.shape, y.shape, w.shape), "(T,), (T, m) and (T,)")
    kept = np.isfinite(y).all(axis=1) & np.isfinite(w)
    if kept.sum() < least:
        raise InsufficientDataError("derivatives", f"only {kept.sum()} complete frames", f"at least {least} are needed")
    return t[kept], y[kept], w[kept] / w[kept].mean()


def _whitener(noise: ArrayLike, size: int) -> Array:
    """(m, m) matrix W such that samples @ W have unit, uncorrelated noise; directions without noise are left out."""
    given = np.asarray(noise, dtype=float)
    covariance = np.diag(given**2) if given.ndim == 1 else given
    if covariance.shape != (size, size):
        raise ShapeError("noise", given.shape, f"({size},) or ({size}, {size})")
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-12 * max(float(values.max()), 1e-300)
    return np.asarray(vectors * np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), 0.0) * np.sqrt(size / kept.sum()))


class _PenalisedSpline:
    """B-splines on uniform knots with a difference penalty, solved as a banded system."""

    def __init__(self, time: Array, weights: Array) -> None:
        step = float(np.median(np.diff(time)))
        count = int(np.ceil((time[-1] - time[0]) / step + 1e-9))
        knots = time[0] + step * np.arange(-_DEGREE, count + _DEGREE + 1)
        self.time, self.weights, self.step = time, weights, step
        size = knots.size - _DEGREE - 1
        self.basis = [self._derivative(knots, size, d) for d in range(3)]
        weighted = self.basis[0].multiply(weights[:, None]).tocsr()
        self._right = weighted.T
        self._gram = _bands(csr_array(self.basis[0].T @ weighted), _DEGREE)
        difference = csr_array(np.eye(1))
        signs = np.array([1.0])
        for _ in range(_PENALTY):
            signs = np.convolve(signs, [1.0, -1.0])
        difference = dia_array(
            (np.repeat(signs[:, None], size, axis=1), np.arange(_PENALTY + 1)), shape=(size - _PENALTY, size)
        ).tocsr()
        self._penalty = _bands(csr_array(difference.T @ difference), _DEGREE)

    def _derivative(self, knots: Array, size: int, d: int) -> csr_array:
        """Sparse matrix from coefficients to the d-th derivative at the data's instants."""
        inner = knots[d : knots.size - d]
        matrix = csr_array(BSpline.design_matrix(np.minimum(self.time, knots[-_DEGREE - 1]), inner, _DEGREE - d))
        for k in range(d):
            rows = size - d + k
            ones = np.ones(rows + 1)
            shift = dia_array((np.stack([-ones, ones]), np.array([0, 1])), shape=(rows, rows + 1)).tocsr()
            matrix = csr_array(matrix @ shift) / self.step
        return csr_array(matrix)

    def _banded(self, exponent: float) -> Array:
        # Differences of coefficients are per step; the scale makes the penalty independent of the frame rate's unit.
        bands: Array = self._gram + 10.0**exponent * self._penalty
        return bands

    def solve(self, values: Array, exponent: float) -> Array:
        """Coefficients (size, m) for values (T, m)."""
        result: Array = solveh_banded(self._banded(exponent), self._right @ values)
        return result

    def gains(self, exponent: float) -> tuple[Array, float]:
        """Noise covariance (3, 3) of value, rate, acceleration at mid-record, and the kernel's reach [s]."""
        middle = self.time.size // 2
        rows = np.stack([matrix[[middle], :].toarray()[0] for matrix in self.basis], axis=1)
        kernels = (self._right.T @ solveh_banded(self._banded(exponent), rows)).T
        kernels = kernels / np.sqrt(self.weights)
        distance = np.abs(self.time - self.time[middle])
        order = np.argsort(distance)
        energy = np.cumsum(kernels[2][order] ** 2)
        reached = int(np.searchsorted(energy, (1 - _KERNEL_TAIL) * energy[-1]))
        reach = float(distance[order][reached])
        return kernels @ kernels.T, min(reach, 0.2 * float(self.time[-1] - self.time[0]))


def _bands(matrix: csr_array, width: int) -> Array:
    """Upper-banded storage of a symmetric matrix for `solveh_banded`."""
    size = matrix.shape[0]
    bands = np.zeros((width + 1, size))
    for k in range(width + 1):
        bands[width - k, k:] = matrix.diagonal(k)
    return bands
