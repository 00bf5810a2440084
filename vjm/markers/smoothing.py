"""Rates and accelerations of sampled angles, by smoothing splines or by the paper's interpolating spline."""

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
from vjm.records import Array, Record

# Degree 7 keeps the second derivative right to 0.1 % at four samples a period, where a cubic spline is 20 % off.
_DEGREE = 7
_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # penalised: the fourth
_ROUGHEST, _SMOOTHEST = -4.0, 10.0  # log10 of the penalty searched


@dataclass(frozen=True, repr=False)
class Derivatives(Record):
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
        """Return the (3, m) 1-sigma noise of value, rate and acceleration for sample noise (m,)."""
        result: Array = np.sqrt(np.diag(self.gains))[:, None] * np.asarray(sample_noise, dtype=float)
        return result


def interpolate(time: ArrayLike, values: ArrayLike, step: float = 0.004) -> Derivatives:
    """Interpolate by a cubic spline on a fine grid, as in the paper.

    Args:
        time: (T,) [s].
        values: (T, m); frames with NaN are left out.
        step: of the grid [s]; the paper's is the default.

    Raises:
        InsufficientDataError: fewer than four frames.
        ShapeError: arrays that do not fit together.
    """
    t, y = np.asarray(time, dtype=float), np.asarray(values, dtype=float)
    if y.ndim != 2 or t.shape != y.shape[:1]:
        raise ShapeError("time, values", (t.shape, y.shape), "(T,) and (T, m)")
    kept = np.isfinite(y).all(axis=1)
    if kept.sum() < 4:
        raise InsufficientDataError("derivatives", f"only {kept.sum()} complete frames", "at least 4 are needed")
    t, y = t[kept], y[kept]
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-9) + 1)
    spline = CubicSpline(t, y)
    impulse = np.zeros(t.size)
    impulse[t.size // 2] = 1.0
    response = CubicSpline(t, impulse)
    # Averaged over the grid, the response to one sample says how much noise a grid instant carries.
    responses = np.stack([response(grid, d) for d in range(3)]) * np.sqrt(t.size / grid.size)
    return Derivatives(
        grid,
        spline(grid),
        spline(grid, 1),
        spline(grid, 2),
        responses @ responses.T,
        np.ones(grid.size, dtype=bool),
        None,
    )


@dataclass(frozen=True)
class Smoother:
    """Smoothing spline over a fixed set of instants; its residual is as large as the noise (discrepancy principle).

    All signals share one penalty, so value, rate and acceleration pass through the same filter and linear relations
    among them survive it. Degree 7 with a penalty on the fourth difference (Eilers and Marx 1996).
    """

    _spline: _PenalisedSpline

    @classmethod
    def of(cls, time: ArrayLike) -> Smoother:
        """Return the smoother of instants (T,) [s].

        Raises:
            InsufficientDataError: fewer than ten instants.
        """
        t = np.asarray(time, dtype=float)
        if t.size < 10:
            raise InsufficientDataError("derivatives", f"only {t.size} complete frames", "at least 10 are needed")
        return cls(_PenalisedSpline(t))

    def derivatives(self, values: ArrayLike, noise: ArrayLike, exponent: float | None = None) -> Derivatives:
        """Smooth signals and differentiate them.

        Args:
            values: (T, m), all finite.
            noise: (m,) 1-sigma noise of a sample, or (m, m) its covariance; signals without noise do not count.
            exponent: log10 of the penalty, to repeat an earlier filter; found from the noise when None.

        Raises:
            ShapeError: arrays that do not fit together, or values that are not finite.
        """
        y, t = np.asarray(values, dtype=float), self._spline.time
        if y.ndim != 2 or len(y) != t.size or not np.isfinite(y).all():
            raise ShapeError("values", f"shape {y.shape}", f"({t.size}, m), all finite")
        whiten = _whitener(noise, y.shape[1])
        centre = y.mean(axis=0)

        def excess(trial: float) -> float:
            residual = (y - centre - self._spline.basis[0] @ self._spline.solve(y - centre, trial)) @ whiten
            return float(np.log(max(np.sum(residual**2), 1e-300) / y.size))

        if exponent is None:
            exponent = _discrepancy_root(excess)
        coefficients = self._spline.solve(y - centre, exponent)
        gains, half_width = self._spline.gains(exponent)
        inside = (t >= t[0] + half_width) & (t <= t[-1] - half_width)
        value, rate, acceleration = (matrix @ coefficients for matrix in self._spline.basis)
        return Derivatives(t, value + centre, rate, acceleration, gains, inside, exponent)


def _discrepancy_root(excess: Callable[[float], float]) -> float:
    """Penalty at which the residual is as large as the noise, within the penalties searched."""
    if excess(_SMOOTHEST) <= 0:
        return _SMOOTHEST
    if excess(_ROUGHEST) >= 0:
        return _ROUGHEST
    return float(brentq(excess, _ROUGHEST, _SMOOTHEST, xtol=0.01))


def _whitener(noise: ArrayLike, size: int) -> Array:
    """(m, m) matrix W such that samples @ W have unit, uncorrelated noise; directions without noise are left out."""
    given = np.asarray(noise, dtype=float)
    covariance = np.diag(given**2) if given.ndim == 1 else given
    if covariance.shape != (size, size):
        raise ShapeError("noise", given.shape, f"({size},) or ({size}, {size})")
    values, vectors = np.linalg.eigh(covariance)
    kept = values > 1e-12 * max(float(values.max()), 1e-300)
    return np.asarray(
        vectors * np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), 0.0) * np.sqrt(size / kept.sum())
    )


class _PenalisedSpline:
    """B-splines on uniform knots with a difference penalty, solved as a banded system."""

    def __init__(self, time: Array) -> None:
        step = float(np.median(np.diff(time)))
        count = int(np.ceil((time[-1] - time[0]) / step + 1e-9))
        knots = time[0] + step * np.arange(-_DEGREE, count + _DEGREE + 1)
        self.time, self.step = time, step
        size = knots.size - _DEGREE - 1
        self.basis = [self._derivative(knots, size, d) for d in range(3)]
        self._right = self.basis[0].T
        self._gram = _bands(csr_array(self._right @ self.basis[0]), _DEGREE)
        order = _DIFFERENCE.size - 1
        diagonals = np.repeat(_DIFFERENCE[:, None], size, axis=1)
        difference = dia_array((diagonals, np.arange(order + 1)), shape=(size - order, size)).tocsr()
        self._penalty = _bands(csr_array(difference.T @ difference), _DEGREE)

    def _derivative(self, knots: Array, size: int, d: int) -> csr_array:
        """Sparse matrix from coefficients to the d-th derivative at the data's instants."""
        inner = knots[d : knots.size - d]
        matrix = csr_array(BSpline.design_matrix(np.minimum(self.time, knots[-_DEGREE - 1]), inner, _DEGREE - d))
        for k in range(d):
            rows = size - d + k
            ones = np.ones(rows + 1)
            shift = dia_array((np.stack([-ones, ones]), np.array([0, 1])), shape=(rows, rows + 1)).tocsr()
            matrix = _as_csr(matrix @ shift / self.step)
        return csr_array(matrix)

    def _banded(self, exponent: float) -> Array:
        bands: Array = self._gram + 10.0**exponent * self._penalty
        return bands

    def solve(self, values: Array, exponent: float) -> Array:
        """Return coefficients (size, m) for values (T, m)."""
        result: Array = solveh_banded(self._banded(exponent), self._right @ values)
        return result

    def gains(self, exponent: float) -> tuple[Array, float]:
        """Return the noise covariance (3, 3) of value, rate, acceleration, and the kernel's half width [s].

        Two per cent of the kernel's energy may lie outside the recording at the first and last instants kept.
        """
        middle = self.time.size // 2
        rows = np.stack([matrix[[middle], :].toarray()[0] for matrix in self.basis], axis=1)
        kernels = (self._right.T @ solveh_banded(self._banded(exponent), rows)).T
        distance = np.abs(self.time - self.time[middle])
        order = np.argsort(distance)
        energy = np.cumsum(kernels[2][order] ** 2)
        last = int(np.searchsorted(energy, 0.98 * energy[-1]))
        half_width = float(distance[order][last])
        return kernels @ kernels.T, min(half_width, 0.2 * float(self.time[-1] - self.time[0]))


def _as_csr(matrix: object) -> csr_array:
    return csr_array(matrix)  # type: ignore[call-overload, no-any-return]


def _bands(matrix: csr_array, width: int) -> Array:
    """Upper-banded storage of a symmetric matrix for `solveh_banded`."""
    size = matrix.shape[0]
    bands = np.zeros((width + 1, size))
    for k in range(width + 1):
        bands[width - k, k:] = matrix.diagonal(k)
    return bands
