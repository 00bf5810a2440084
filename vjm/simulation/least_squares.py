"""Loss functions of weighted residuals: how much a value far from the model may count."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from vjm.records import Array


@dataclass(frozen=True)
class SquareRootInformation:
    """min |J x - r|^2 as an upper triangle R with |J x - r|^2 = |R (x, -1)|^2.

    Attributes:
        R: (C + 1, C + 1), the last column standing for r.
    """

    R: Array

    @classmethod
    def of(cls, parts: Iterable[tuple[Array, Array]], columns: int) -> SquareRootInformation:
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

    def with_rows(self, jacobian: Array, residual: Array) -> SquareRootInformation:
        """The same with more rows."""
        return SquareRootInformation.of([(self.R[:, :-1], self.R[:, -1]), (jacobian, residual)], self.columns)

    def damped(self, damping: float) -> SquareRootInformation:
        """With Levenberg and Marquardt's rows, in the columns' own lengths."""
        if damping == 0:
            return self
        return self.with_rows(np.diag(np.sqrt(damping) * self.scale), np.zeros(self.columns))

    def eliminated(self, count: int) -> SquareRootInformation:
        """What is left for the other unknowns once the first `count` are chosen best."""
        return SquareRootInformation(self.R[count:, count:])

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


_SMALLEST = 1e-10  # of the columns' squared lengths
_LARGEST = 1e6
_RISE = 4.0
_FALL = 5.0
_SHORTER = 0.5


@dataclass(frozen=True)
class Damping:
    """How much a step is held back.

    Attributes:
        value: of the columns' squared lengths; zero for a full step.
    """

    value: float = 0.0

    @property
    def exhausted(self) -> bool:
        """Whether no step however small has helped."""
        return self.value > _LARGEST

    def better(self) -> Damping:
        """After a step that helped."""
        lower = self.value / _FALL
        return Damping(lower if lower > _SMALLEST else 0.0)

    def worse(self, length: Callable[[float], float]) -> Damping:
        """After a step that did not: so much more that the next one is clearly shorter, or it would only fail again.

        Args:
            length: of the step at a damping, in any metric.
        """
        longest, found = _SHORTER * length(self.value), self
        while not found.exhausted:
            found = Damping(max(_RISE * found.value, _SMALLEST))
            if length(found.value) < longest:
                break
        return found


_TUNING = 3.0**2  # standard deviations squared, from which a loss departs from the square


@dataclass(frozen=True)
class Loss:
    """A loss rho(z) of z, the square of a weighted residual, with rho(z) = z for small z.

    Attributes:
        name: as `least_squares` of SciPy calls it.
        shape: rho for a tuning constant of one, and its slope.
    """

    name: str
    shape: tuple[Callable[[Array], Array], Callable[[Array], Array]]

    def __reduce__(self) -> tuple[Callable[[str], Loss], tuple[str]]:
        return loss_of, (self.name,)

    def value(self, z: Array) -> Array:
        """rho(z)."""
        return _TUNING * self.shape[0](z / _TUNING)

    def slope(self, z: Array) -> Array:
        """rho'(z), the weight that a value keeps."""
        return self.shape[1](z / _TUNING)


LINEAR = Loss("linear", (lambda z: z, np.ones_like))
LOSSES = {
    loss.name: loss
    for loss in (
        LINEAR,
        Loss(
            "huber",
            (
                lambda z: np.where(z <= 1, z, 2 * np.sqrt(np.maximum(z, 1)) - 1),
                lambda z: 1 / np.sqrt(np.maximum(z, 1)),
            ),
        ),
        Loss("soft_l1", (lambda z: 2 * (np.sqrt(1 + z) - 1), lambda z: 1 / np.sqrt(1 + z))),
        Loss("cauchy", (np.log1p, lambda z: 1 / (1 + z))),
    )
}


def loss_of(name: str) -> Loss:
    """The loss of that name."""
    return LOSSES[name]
