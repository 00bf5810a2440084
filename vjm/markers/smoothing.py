"""Rates and accelerations of sampled angles, by smoothing splines or by the paper's interpolating spline."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, CubicSpline
from scipy.linalg import solveh_banded
from scipy.ndimage import binary_erosion
from scipy.optimize import brentq
from scipy.sparse import csr_array, diags_array

from vjm.records import Array, Mask, Record

# Degree 7 keeps the second derivative right to 0.1 % at four samples a period, where a cubic spline is 20 % off.
_DEGREE = 7
_PENALISED = 4  # order of the difference
_BRIDGED = 50  # knots on either side of a pause; no kernel is wider than 10^(_SMOOTHEST / 8) = 18 of them
_ROUGHEST, _SMOOTHEST = -4.0, 10.0  # log10 of the penalty searched


@dataclass(frozen=True, repr=False)
class Derivatives(Record):
    """Signals with their rates and accelerations."""

    time: Array  # (S,) [s]
    value: Array  # (S, m) in the signals' unit
    rate: Array  # (S, m) per s
    acceleration: Array  # (S, m) per s^2
    gains: Array  # (3, 3) covariance of (value, rate, acceleration) per unit variance of a sample, away from the ends
    interior: Mask  # (S,) instants far enough from the ends for `gains` to hold
    smoothing: float | None  # log10 of the spline's penalty; None for interpolation

    def noise(self, sample_noise: ArrayLike) -> Array:
        """Return the (3, m) 1-sigma noise of value, rate and acceleration for sample noise (m,)."""
        result: Array = np.sqrt(np.diag(self.gains))[:, None] * np.asarray(sample_noise, dtype=float)
        return result


def interpolate(time: Array, values: Array, step: float = 0.004) -> Derivatives:
    """Interpolate values (T, m) at instants (T,) [s] by a cubic spline on a grid of a step [s], the paper's by default.

    Frames with NaN are left out.
    """
    complete = np.isfinite(values).all(axis=1)
    t, y = time[complete], values[complete]
    grid = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-9) + 1)
    spline = CubicSpline(t, y)
    impulse = np.zeros(t.size)
    impulse[t.size // 2] = 1.0
    response = CubicSpline(t, impulse)
    # Averaged over the grid, the response to one sample says how much noise a grid instant carries.
    responses = np.stack([response(grid, order) for order in range(3)]) * np.sqrt(t.size / grid.size)
    value, rate, acceleration = (spline(grid, order) for order in range(3))
    return Derivatives(grid, value, rate, acceleration, responses @ responses.T, np.ones(grid.size, dtype=bool), None)


class Smoother:
    """Smoothing spline over a fixed set of instants; its residual is as large as the noise (discrepancy principle).

    All signals share one penalty, so value, rate and acceleration pass through the same filter and linear relations
    among them survive it. B-splines of degree 7 on uniform knots with a penalty on the fourth difference of their
    coefficients (Eilers and Marx 1996), solved as a banded system.

    Args:
        time: (T,) instants of the data [s], ten or more.
        instants: (S,) at which the derivatives are wanted, inside the data [s] (default: the data's).
    """

    def __init__(self, time: Array, instants: Array | None = None) -> None:
        self.time = t = time
        self.instants = time if instants is None else instants
        step = float(np.median(np.diff(t)))
        count = int(np.ceil((t[-1] - t[0]) / step + 1e-9))
        knots = t[0] + step * np.arange(-_DEGREE, count + _DEGREE + 1)
        size = knots.size - _DEGREE - 1

        def basis(at: Array, order: int) -> csr_array:
            clipped = np.minimum(at, knots[-_DEGREE - 1])
            matrix = csr_array(BSpline.design_matrix(clipped, knots[order : knots.size - order], _DEGREE - order))
            return csr_array(matrix @ _differences(size, order) / step**order)

        # Matrices from coefficients to values at the data (T, size), and to value, rate and acceleration (S, size).
        self._data = basis(t, 0)
        self._basis = [basis(self.instants, order) for order in range(3)]
        penalty = _differences(size, _PENALISED)
        self._gram = _bands(csr_array(self._data.T @ self._data))
        # Inside a long pause the penalty alone would determine the coefficients, and over hundreds of them no better
        # than rounding errors: the spline is split there.
        inside_pause = binary_erosion(self._gram[-1] == 0.0, iterations=_BRIDGED)
        penalty = penalty[abs(penalty) @ inside_pause == 0.0]
        self._penalty = _bands(csr_array(penalty.T @ penalty))
        self._penalty[-1] += inside_pause

    def derivatives(self, values: Array, covariance: Array, exponent: float | None = None) -> Derivatives:
        """Smooth signals and differentiate them.

        Args:
            values: (T, m), all finite.
            covariance: (m, m) of a sample's noise; signals without noise do not count.
            exponent: log10 of the penalty, to repeat an earlier filter; found from the noise when None.
        """
        y, t, whiten = values, self.instants, _whitener(covariance)
        centre = y.mean(axis=0)
        right_hand_side = self._data.T @ (y - centre)

        def excess(trial: float) -> float:
            residual = (y - centre - self._data @ self._solve(right_hand_side, trial)) @ whiten
            return float(np.log(max(np.sum(residual**2), 1e-300) / y.size))

        if exponent is None:
            exponent = _discrepancy_root(excess)
        coefficients = self._solve(right_hand_side, exponent)
        gains, half_width = self._gains(exponent)
        half_width -= 0.5 * float(np.median(np.diff(self.time)))  # rounding of the instants must not decide on a frame
        interior = (t >= self.time[0] + half_width) & (t <= self.time[-1] - half_width)
        value, rate, acceleration = (matrix @ coefficients for matrix in self._basis)
        return Derivatives(t, value + centre, rate, acceleration, gains, interior, exponent)

    def exponent_of(self, frequency: float) -> float:
        """Return the log10 of the penalty at which a frequency [Hz], below half the sampling rate, passes by half.

        The gain is b^2 / (b^2 + penalty d^8): b is that of the sampled B-spline, from coefficients to values, and d = 2
        sin(omega h / 2) that of a difference at the step h.
        """
        step = float(np.median(np.diff(self.time)))
        knots = np.arange(_DEGREE + 2) - (_DEGREE + 1) / 2
        places = np.arange(-(_DEGREE // 2), _DEGREE // 2 + 1)
        spline = BSpline.basis_element(knots)(places) @ np.cos(2 * np.pi * frequency * step * places)
        difference = 2 * np.sin(np.pi * frequency * step)
        return float(2 * np.log10(spline) - 2 * _PENALISED * np.log10(difference))

    def adjoint(self, weights: Sequence[Array], exponent: float) -> Array:
        """Return the derivative (T, m) by the data of a weighted sum of all values, rates and accelerations.

        Args:
            weights: of value, rate and acceleration, each (S, m).
            exponent: log10 of the penalty.
        """
        right_hand_side = sum(basis.T @ weight for basis, weight in zip(self._basis, weights, strict=True))
        return np.asarray(self._data @ self._solve(np.asarray(right_hand_side), exponent))

    def _solve(self, right_hand_side: Array, exponent: float) -> Array:
        """Return coefficients (size, m) for a right-hand side (size, m)."""
        matrix = self._gram + 10.0**exponent * self._penalty
        try:
            return np.asarray(solveh_banded(matrix, right_hand_side))
        except np.linalg.LinAlgError:
            # With few frames beside a long pause the matrix is singular up to rounding: add ten times that much.
            matrix[-1] += 10 * np.finfo(float).eps * matrix[-1].max()
            return np.asarray(solveh_banded(matrix, right_hand_side))

    def _gains(self, exponent: float) -> tuple[Array, float]:
        """Return the noise covariance (3, 3) of value, rate, acceleration, and the kernel's half width [s].

        Two per cent of the kernel's energy may lie outside the recording at the first and last instants kept.
        """
        middle = self.instants.size // 2
        rows = np.stack([matrix[[middle], :].toarray()[0] for matrix in self._basis], axis=1)
        kernels = (self._data @ self._solve(rows, exponent)).T
        distance = np.abs(self.time - self.instants[middle])
        order = np.argsort(distance)
        energy = np.cumsum(kernels[2][order] ** 2)
        last = int(np.searchsorted(energy, 0.98 * energy[-1]))
        half_width = float(distance[order][last])
        return kernels @ kernels.T, min(half_width, 0.2 * float(self.time[-1] - self.time[0]))


def _discrepancy_root(excess: Callable[[float], float]) -> float:
    """Return the penalty at which the residual is as large as the noise, within the penalties searched."""
    if excess(_SMOOTHEST) <= 0:
        return _SMOOTHEST
    if excess(_ROUGHEST) >= 0:
        return _ROUGHEST
    return float(brentq(excess, _ROUGHEST, _SMOOTHEST, xtol=1e-4))


def _whitener(covariance: Array) -> Array:
    """Return W (m, m) such that samples @ W have unit, uncorrelated noise; directions without noise are left out."""
    values, vectors = np.linalg.eigh(covariance)
    noisy = values > 1e-12 * max(float(values.max()), 1e-300)
    whitener = vectors * np.where(noisy, 1 / np.sqrt(np.where(noisy, values, 1.0)), 0.0)
    return np.asarray(whitener * np.sqrt(values.size / noisy.sum()))


def _differences(size: int, order: int) -> csr_array:
    """Return the matrix (size - order, size) that takes differences of an order."""
    pascal = [(-1.0) ** (order - k) * comb(order, k) for k in range(order + 1)]
    return diags_array(pascal, offsets=range(order + 1), shape=(size - order, size), format="csr")


def _bands(matrix: csr_array) -> Array:
    """Return the upper bands (degree + 1, size) of a symmetric matrix, as `solveh_banded` takes them."""
    bands = np.zeros((_DEGREE + 1, matrix.shape[0]))
    for k in range(_DEGREE + 1):
        bands[_DEGREE - k, k:] = matrix.diagonal(k)
    return bands
