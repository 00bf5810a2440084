"""Linear least squares by triangular factors, damping of its steps, and robust losses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from vjm.records import Array


@dataclass(frozen=True)
class SquareRootInformation:
    """Least-squares problem min |J x - r|^2 as an upper triangle R with |J x - r|^2 = |R (x, -1)|^2.

    Attributes:
        R: (C + 1, C + 1), the last column standing for r.
    """

    R: Array

    @classmethod
    def of(cls, parts: Iterable[tuple[Array, Array]], columns: int) -> SquareRootInformation:
        """Return the triangle of rows given as pairs of J (m, C) and r (m,)."""
        R: Array = np.zeros((0, columns + 1))
        for jacobian, residual in parts:
            R = np.asarray(np.linalg.qr(np.vstack([R, np.column_stack([jacobian, residual])]), mode="r"))
        missing = columns + 1 - len(R)
        return cls(np.vstack([R, np.zeros((missing, columns + 1))]) if missing > 0 else R)

    @property
    def columns(self) -> int:
        """Number of unknowns C."""
        return len(self.R) - 1

    @property
    def scale(self) -> Array:
        """(C,) length of each column of J."""
        length: Array = np.linalg.norm(self.R[:, :-1], axis=0)
        return length

    def with_rows(self, jacobian: Array, residual: Array) -> SquareRootInformation:
        """Return the problem with more rows."""
        return SquareRootInformation.of([(self.R[:, :-1], self.R[:, -1]), (jacobian, residual)], self.columns)

    def damped(self, damping: float) -> SquareRootInformation:
        """Return the problem with Levenberg and Marquardt's rows, in units of the columns' lengths."""
        if damping == 0:
            return self
        return self.with_rows(np.diag(np.sqrt(damping) * self.scale), np.zeros(self.columns))

    def eliminated(self, count: int) -> SquareRootInformation:
        """Return the problem of the other unknowns once the first `count` are eliminated."""
        return SquareRootInformation(self.R[count:, count:])

    def solve(self, count: int, others: Array) -> Array:
        """Return the (count,) best first unknowns, given the others (C - count,)."""
        top = self.R[:count]
        return _solved(top[:, :count], top[:, -1] - top[:, count:-1] @ others)

    def elimination_slopes(self, count: int) -> Array:
        """Return (count, C - count) derivatives of the best first unknowns by the others, with reversed sign."""
        return _solved(self.R[:count, :count], self.R[:count, count:-1])

    def best(self) -> Array:
        """Return all (C,) unknowns."""
        return self.solve(self.columns, np.zeros(0))

    def decrease(self, x: Array) -> float:
        """Return the decrease of |J x - r|^2 from zero to x."""
        at_zero, at_x = self.R[:, -1], self.R[:, :-1] @ x - self.R[:, -1]
        return float(at_zero @ at_zero - at_x @ at_x)


def _solved(R: Array, z: Array) -> Array:
    """Least-squares solution; unknowns that the rows do not depend on stay at zero."""
    scale = np.linalg.norm(R, axis=0)
    scale[scale == 0] = 1.0
    return np.asarray((np.linalg.lstsq(R / scale, z, rcond=1e-13)[0].T / scale).T)


_SMALLEST, _LARGEST = 1e-10, 1e6  # damping, in units of the columns' squared lengths
_RISE, _FALL = 4.0, 5.0


@dataclass(frozen=True)
class Damping:
    """Damping of Levenberg and Marquardt's steps.

    Attributes:
        value: of the columns' squared lengths; zero for a full step.
    """

    value: float = 0.0

    @property
    def exhausted(self) -> bool:
        """True if no step however small has helped."""
        return self.value > _LARGEST

    def better(self) -> Damping:
        """Return the damping after a step that helped."""
        lower = self.value / _FALL
        return Damping(lower if lower > _SMALLEST else 0.0)

    def worse(self, length: Callable[[float], float]) -> Damping:
        """Return the damping after a step that failed: large enough to halve the next one, which else would fail again.

        Args:
            length: of the step at a damping, in any metric.
        """
        longest, damping = length(self.value) / 2, self
        while not damping.exhausted:
            damping = Damping(max(_RISE * damping.value, _SMALLEST))
            if length(damping.value) < longest:
                break
        return damping


_TUNING = 3.0**2  # squared standard deviations from which a loss departs from the square

# rho for a tuning constant of one, and its slope, of z, the square of a weighted residual; names as in SciPy.
_LOSSES: dict[str, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "linear": (lambda z: z, np.ones_like),
    "huber": (
        lambda z: np.where(z <= 1, z, 2 * np.sqrt(np.maximum(z, 1)) - 1),
        lambda z: 1 / np.sqrt(np.maximum(z, 1)),
    ),
    "soft_l1": (lambda z: 2 * (np.sqrt(1 + z) - 1), lambda z: 1 / np.sqrt(1 + z)),
    "cauchy": (np.log1p, lambda z: 1 / (1 + z)),
}
LOSSES = tuple(_LOSSES)


@dataclass(frozen=True)
class Loss:
    """Loss rho(z) of z, the square of a weighted residual, with rho(z) = z for small z.

    Attributes:
        name: one of `LOSSES`, as in `scipy.optimize.least_squares`.
    """

    name: str

    def value(self, z: Array) -> Array:
        """Return rho(z)."""
        return _TUNING * _LOSSES[self.name][0](z / _TUNING)

    def slope(self, z: Array) -> Array:
        """Return rho'(z), the weight that a value keeps."""
        return _LOSSES[self.name][1](z / _TUNING)


LINEAR = Loss("linear")
