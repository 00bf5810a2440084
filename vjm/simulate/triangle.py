"""Least squares in small: rows of a linear problem gathered into one triangle, a stretch of time after another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Triangle:
    """min |J x - r|^2 as an upper triangle R with |J x - r|^2 = |R (x, -1)|^2.

    Attributes:
        R: (C + 1, C + 1), the last column standing for r.
    """

    R: Array

    @classmethod
    def of(cls, parts: Iterable[tuple[Array, Array]], columns: int) -> Triangle:
        """Gather rows: pairs of J (m, C) and r (m,)."""
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

    def with_rows(self, jacobian: Array, residual: Array) -> Triangle:
        """The same with more rows."""
        return Triangle.of([(self.R[:, :-1], self.R[:, -1]), (jacobian, residual)], self.columns)

    def damped(self, damping: float) -> Triangle:
        """With Levenberg and Marquardt's rows, in the columns' own lengths."""
        if damping == 0:
            return self
        return self.with_rows(np.diag(np.sqrt(damping) * self.scale), np.zeros(self.columns))

    def eliminated(self, count: int) -> Triangle:
        """What is left for the other unknowns once the first `count` are chosen best."""
        return Triangle(self.R[count:, count:])

    def solve(self, count: int, others: Array) -> Array:
        """(count,) best first unknowns, given the others (C - count,)."""
        top = self.R[:count]
        return _solved(top[:, :count], top[:, -1] - top[:, count:-1] @ others)

    def followed(self, count: int) -> Array:
        """(count, C - count) how the best first unknowns follow the others."""
        return _solved(self.R[:count, :count], self.R[:count, count:-1])

    def best(self) -> Array:
        """(C,) all unknowns."""
        return self.solve(self.columns, np.zeros(0))

    def decrease(self, x: Array) -> float:
        """By how much |J x - r|^2 falls from zero to x."""
        at_zero, at_x = self.R[:, -1], self.R[:, :-1] @ x - self.R[:, -1]
        return float(at_zero @ at_zero - at_x @ at_x)


def _solved(R: Array, z: Array) -> Array:
    """Least-squares solution that leaves what the rows do not speak of at zero."""
    scale = np.linalg.norm(R, axis=0)
    scale[scale == 0] = 1.0
    scaled = np.linalg.lstsq(R / scale, z, rcond=1e-13)[0]
    solution: Array = (scaled.T / scale).T
    return solution
