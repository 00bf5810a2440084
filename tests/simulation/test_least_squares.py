"""Levenberg-Marquardt searches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vjm.simulation.least_squares import LevenbergMarquardt, SquareRootInformation, Status, Step, minimise

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Valley:
    """A point in Rosenbrock's valley."""

    x: Array

    @property
    def residual(self) -> Array:
        return np.array([10 * (self.x[1] - self.x[0] ** 2), 1 - self.x[0]])

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    def with_scaled_prior(self) -> Self:
        return self


@dataclass(frozen=True)
class Change(Step):
    change: Array


class ValleySearch(LevenbergMarquardt[Valley, Change]):
    rough = False

    def step_at(self, damping: float) -> Change:
        jacobian = np.array([[-20 * self.point.x[0], 10.0], [-1.0, 0.0]])
        problem = SquareRootInformation.of([(jacobian, -self.point.residual)], 2)
        change = problem.damped(damping).best()
        return Change(problem.decrease(change), float(np.linalg.norm(problem.scale * change)), change)

    def stopping_rule(self) -> Status:
        return "converged" if self.step.predicted < 1e-20 else "running"

    def is_nonsmooth_minimum(self, trial: Valley | None) -> bool:
        return self.rough


class Scripted(ValleySearch):
    """A search whose steps have a given length."""

    def __init__(self, length: Callable[[float], float], damping: float = 0.0) -> None:
        super().__init__(Valley(np.zeros(2)))
        self.length, self.damping, self.steps = length, damping, 0

    def step_at(self, damping: float) -> Change:
        self.steps += 1
        return Change(1.0, self.length(damping), np.zeros(2))


@pytest.mark.parametrize("zeros", [(), (0,), (1, 2), (4,), (0, 3, 4), (0, 1, 2, 3, 4)])
@pytest.mark.parametrize("count", [3, 30])
def test_unknowns_that_nothing_depends_on_take_nothing_of_the_residual(count: int, zeros: tuple[int, ...]) -> None:
    random = np.random.default_rng(1)
    jacobian, residual = random.normal(size=(count, 5)), random.normal(size=count)
    jacobian[:, zeros] = 0.0

    def least(chosen: Array, residual: Array) -> float:
        return float(np.sum((residual - chosen @ np.linalg.lstsq(chosen, residual)[0]) ** 2))

    whole = SquareRootInformation.of([(jacobian[:2], residual[:2]), (jacobian[2:], residual[2:])], 5)
    first = SquareRootInformation.of([(jacobian[:2], residual[:2])], 5)
    for problem in (whole, first.with_rows(jacobian[2:], residual[2:])):
        assert problem.least == pytest.approx(least(jacobian, residual), abs=1e-12)
        assert not np.tril(problem.R, -1).any()
        others = random.normal(size=3)
        left = residual - jacobian[:, 2:] @ others
        reduced = problem.eliminated(2)
        remaining = reduced.R[:, :-1] @ others - reduced.R[:, -1]
        assert remaining @ remaining == pytest.approx(least(jacobian[:, :2], left), abs=1e-12)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (3.0, -4.0)])
def test_the_bottom_of_a_bent_valley_is_found(start: tuple[float, float]) -> None:
    search = ValleySearch(Valley(np.array(start)))
    minimise([search], lambda searches: [Valley(each.point.x + each.step.change) for each in searches], 60)
    assert search.status == "converged"
    assert search.point.x == pytest.approx([1.0, 1.0], abs=1e-8)


def test_searches_side_by_side_are_independent() -> None:
    starts = [np.array([-1.2, 1.0]), np.array([3.0, -4.0])]

    def simulate(searches: object) -> list[Valley]:
        return [Valley(each.point.x + each.step.change) for each in searches]  # type: ignore[attr-defined]

    alone = [ValleySearch(Valley(start)) for start in starts]
    together = [ValleySearch(Valley(start)) for start in starts]
    for search in alone:
        minimise([search], simulate, 60)
    minimise(together, simulate, 60)
    for one, other in zip(alone, together, strict=True):
        assert one.decreases == other.decreases
        assert np.array_equal(one.point.x, other.point.x)


@given(st.floats(-9.0, 3.0), st.floats(-10.0, 3.0))
def test_the_next_step_is_clearly_shorter(knee: float, first: float) -> None:
    """Of a step whose length falls once the damping is as large as its own eigenvalue."""

    def length(damping: float) -> float:
        return 1 / (1 + damping / 10**knee)

    for begun in (0.0, 10**first):
        search = Scripted(length, begun)
        search.propose()
        search.judge(None)
        assert search.status == "running"
        assert search.damping > begun
        assert length(search.damping) < 0.5 * length(begun)
        # And not a hundred times shorter: it need not be.
        assert length(search.damping) > 0.05 * length(begun)
        assert begun or search.steps <= 1 + 5  # of 27 dampings from zero: each takes the least squares of all runs


def test_a_search_stops_where_no_damping_shortens_its_step() -> None:
    search = Scripted(lambda damping: 1.0)
    minimise([search], lambda searches: [None for _ in searches], 60)
    assert search.status == "stopped"
    assert search.decreases == [0.0]


def test_damping_fades_after_steps_that_help() -> None:
    search = Scripted(lambda damping: 1.0, 1e-3)
    for k in range(20):
        search.propose()
        damping = search.damping
        along = 1 - 0.5 ** (k + 1)
        search.judge(Valley(np.array([along, along**2])))
        assert search.damping < damping or search.damping == 0.0
    assert search.damping == 0.0


def test_a_rough_minimum_is_the_end_of_a_search() -> None:
    search = ValleySearch(Valley(np.array([-1.2, 1.0])))
    search.rough = True
    minimise([search], lambda searches: [None for _ in searches], 60)
    assert search.status == "converged"
    assert len(search.decreases) == 1
