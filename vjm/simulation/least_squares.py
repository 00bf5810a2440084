"""Least squares: linear problems by triangular factors, Levenberg-Marquardt searches, and robust losses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, inf, log
from time import monotonic
from typing import Generic, Literal, Protocol, Self, TypeVar, get_args

import numpy as np

from vjm.records import Array, Mask

_MOST_DAMPING = 1e6  # a step is then a millionth of a Gauss-Newton step
_LEAST_DAMPING = 1e-10  # smaller eigenvalues of the scaled J^T J are rounding errors of forward differences


@dataclass(frozen=True)
class SquareRootInformation:
    """Linear least-squares problem min |J x - r|^2 as a triangular factor R with |J x - r|^2 = |R (x, -1)|^2.

    Source: G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, 1977.

    Attributes:
        R: (C + 1, C + 1), the last column standing for r.
    """

    R: Array

    @classmethod
    def of(cls, parts: Iterable[tuple[Array, Array]], columns: int) -> SquareRootInformation:
        """Return the factor of a problem whose rows are given as pairs of J (m, C) and r (m,).

        The rows of unknowns whose columns of J are zero are zero, too. QR alone would leave there what further columns
        and r have in some direction, and `eliminated` and `least` would lose it.
        """
        R: Array = np.zeros((0, columns + 1))
        for jacobian, residual in parts:
            R = np.asarray(np.linalg.qr(np.vstack([R, np.column_stack([jacobian, residual])]), mode="r"))
        used = np.append(R[:, :-1].any(axis=0), True)
        if used.all() and len(R) == len(used):
            return cls(R)
        R = np.asarray(np.linalg.qr(R[:, used], mode="r"))
        factor, rows = np.zeros((columns + 1, columns + 1)), np.flatnonzero(used)[: len(R)]
        factor[np.ix_(rows, used)] = R
        return cls(factor)

    @property
    def columns(self) -> int:
        """Number of unknowns C."""
        return len(self.R) - 1

    @property
    def scale(self) -> Array:
        """(C,) length of each column of J."""
        length: Array = np.linalg.norm(self.R[:, :-1], axis=0)
        return length

    @property
    def least(self) -> float:
        """Least value of |J x - r|^2."""
        return float(self.R[-1, -1] ** 2)

    def with_rows(self, jacobian: Array, residual: Array) -> SquareRootInformation:
        """Return the problem with more rows."""
        if not len(residual):
            return self
        return SquareRootInformation.of([(self.R[:, :-1], self.R[:, -1]), (jacobian, residual)], self.columns)

    def damped(self, damping: float) -> SquareRootInformation:
        """Return the problem with Levenberg-Marquardt damping, in units of the squared lengths of J's columns."""
        if damping == 0:
            return self
        return self.with_rows(np.diag(np.sqrt(damping) * self.scale), np.zeros(self.columns))

    def eliminated(self, count: int) -> SquareRootInformation:
        """Return the problem of the other unknowns, the first `count` having been eliminated (variable projection)."""
        return SquareRootInformation(self.R[count:, count:])

    def of_unknowns(self, chosen: Mask) -> SquareRootInformation:
        """Return the problem of the unknowns where a mask (C,) is true, the others held at zero."""
        return SquareRootInformation.of([(self.R[:, :-1][:, chosen], self.R[:, -1])], int(chosen.sum()))

    def solve(self, count: int, others: Array) -> Array:
        """Return the first `count` unknowns (count,) that minimise the sum, given the others (C - count,)."""
        top = self.R[:count]
        return _solved(top[:, :count], top[:, -1] - top[:, count:-1] @ others)

    def elimination_jacobian(self, count: int) -> Array:
        """Return minus the derivatives (count, C - count) of `solve` by the other unknowns."""
        return _solved(self.R[:count, :count], self.R[:count, count:-1])

    def best(self) -> Array:
        """Return the unknowns (C,) that minimise the sum."""
        return self.solve(self.columns, np.zeros(0))

    def decrease(self, x: Array) -> float:
        """Return the decrease of |J x - r|^2 from zero to x."""
        at_zero, at_x = self.R[:, -1], self.R[:, :-1] @ x - self.R[:, -1]
        return float(at_zero @ at_zero - at_x @ at_x)


def _solved(R: Array, z: Array) -> Array:
    """Return the least-squares solution of R x = z; unknowns that the rows do not depend on stay at zero."""
    scale = np.linalg.norm(R, axis=0)
    scale[scale == 0] = 1.0
    return np.asarray((np.linalg.lstsq(R / scale, z, rcond=1e-13)[0].T / scale).T)


class _Iterate(Protocol):
    """An iterate of a search."""

    @property
    def cost(self) -> float:
        """Objective of the search."""

    def with_scaled_prior(self) -> Self:
        """Return the iterate with its priors scaled by its RMS residual; trials are compared with it at this scale."""


@dataclass(frozen=True)
class Step:
    """A proposed step of a search, from the linearised problem.

    Attributes:
        predicted: decrease of the cost that the linearised problem predicts.
        length: norm of the step, each unknown times the length of its column of the Jacobian.
    """

    predicted: float
    length: float


Status = Literal["running", "converged", "stopped"]
P = TypeVar("P", bound=_Iterate)
S = TypeVar("S", bound=Step)


class LevenbergMarquardt(ABC, Generic[P, S]):
    """A Levenberg-Marquardt search, advanced from outside by `propose` and `judge`.

    Source: J. J. More, The Levenberg-Marquardt algorithm: implementation and theory, 1978; J. Nocedal and S. J. Wright,
    Numerical Optimization, 2nd ed. 2006, section 10.3. Gauss-Newton steps are taken as long as they lower the cost.

    Attributes:
        point: best iterate so far.
        step: the step last proposed from there.
        damping: lambda, in units of the squared lengths of the Jacobian's columns; zero for a Gauss-Newton step.
        decreases: decrease of the cost by each trial; zero for a rejected one.
        status: `running`, `converged`, or `stopped` before that.
    """

    step: S

    def __init__(self, point: P) -> None:
        self.point = point
        self.damping = 0.0
        self.decreases: list[float] = []
        self.status: Status = "running"

    @abstractmethod
    def step_at(self, damping: float) -> S:
        """Minimise the linearised problem at the iterate, with Levenberg-Marquardt damping."""

    @abstractmethod
    def stopping_rule(self) -> Status:
        """Decide from the proposed step whether to go on."""

    @abstractmethod
    def is_nonsmooth_minimum(self, trial: P | None) -> bool:
        """Return True if the cost is nonsmooth here, so that its gradient does not lead any lower."""

    def propose(self) -> None:
        """Propose the next step, or end the search."""
        self.step = self.step_at(self.damping)
        self.status = self.stopping_rule()

    def judge(self, trial: P | None) -> None:
        """Accept the trial at the proposed step if it lowers the cost; None: it could not be simulated."""
        decrease = 0.0 if trial is None else max(self.point.cost - trial.cost, 0.0)
        self.decreases.append(decrease)
        if trial is not None and decrease > 0:
            self.point = trial.with_scaled_prior()
            self.damping = self.damping / 5 if self.damping > 5 * _LEAST_DAMPING else 0.0
        if self.is_nonsmooth_minimum(trial):
            self.status = "converged"
        elif not decrease > 0:
            self._shorten_step()

    def _shorten_step(self) -> None:
        """Increase the damping until the next step is half as long as the rejected one; stop where none does that."""
        first = max(4 * self.damping, _LEAST_DAMPING)
        dampings = [first * 4.0**k for k in range(ceil(log(_MOST_DAMPING / first, 4)))]

        def is_short(damping: float) -> bool:
            return self.step_at(damping).length < self.step.length / 2

        if self.damping:  # one of the next
            found = next((k for k, damping in enumerate(dampings) if is_short(damping)), len(dampings))
        else:  # one of many; the length falls as the damping grows
            found = bisect_left(dampings, True, key=is_short)
        if found == len(dampings):
            self.status = "stopped"
        else:
            self.damping = dampings[found]


def minimise(
    searches: Sequence[LevenbergMarquardt[P, S]],
    simulate: Callable[[Sequence[LevenbergMarquardt[P, S]]], Iterable[P | None]],
    max_trials: int,
    linearize: Callable[[Sequence[P]], None] | None = None,
    deadline: float = inf,
) -> None:
    """Advance independent searches together until each has converged or stopped.

    Args:
        searches: each with its own point and damping.
        simulate: returns for each of some searches the trial at its step; None where that cannot be simulated.
        max_trials: number of trials of each at most.
        linearize: linearises the points of several searches together beforehand; None: each search does so by itself.
        deadline: reading of `time.monotonic` after which no trial begins [s].
    """
    for _ in range(max_trials):
        if monotonic() > deadline:
            break
        running = [search for search in searches if search.status == "running"]
        if linearize is not None:
            linearize([search.point for search in running])
        for search in running:
            search.propose()
        running = [search for search in searches if search.status == "running"]
        if not running:
            break
        for search, trial in zip(running, simulate(running), strict=True):
            search.judge(trial)


_TUNING = 3.0**2  # robust losses leave the square at three standard deviations; normal noise exceeds these at 0.3 %

LossName = Literal["linear", "huber", "soft_l1", "cauchy"]
LOSSES: tuple[LossName, ...] = get_args(LossName)

# rho(z) and rho'(z) of the squared weighted residual z, for a tuning constant of one; names as in SciPy.
_LOSSES: dict[LossName, tuple[Callable[[Array], Array], Callable[[Array], Array]]] = {
    "linear": (lambda z: z, np.ones_like),
    "huber": (
        lambda z: np.where(z <= 1, z, 2 * np.sqrt(np.maximum(z, 1)) - 1),
        lambda z: 1 / np.sqrt(np.maximum(z, 1)),
    ),
    "soft_l1": (lambda z: 2 * (np.sqrt(1 + z) - 1), lambda z: 1 / np.sqrt(1 + z)),
    "cauchy": (np.log1p, lambda z: 1 / (1 + z)),
}


@dataclass(frozen=True)
class Loss:
    """Robust loss rho(z) of the squared weighted residual z, with rho(z) = z for small z.

    Attributes:
        name: one of `LOSSES`, as in `scipy.optimize.least_squares`.
    """

    name: LossName

    def value(self, z: Array) -> Array:
        """Return rho(z)."""
        return _TUNING * _LOSSES[self.name][0](z / _TUNING)

    def slope(self, z: Array) -> Array:
        """Return rho'(z), the factor of a value's weight in the linearised problem."""
        return _LOSSES[self.name][1](z / _TUNING)


LINEAR = Loss("linear")
