"""What the trajectory method minimises: everything measured, as a function of coordinates and initial states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.experiment.records import Recording
from vjm.identification.parametrisation import Parametrisation
from vjm.simulate.arm import Arm
from vjm.simulate.observation import Observed
from vjm.simulate.run import Run
from vjm.simulate.sensitivity import Moved
from vjm.simulate.triangle import Triangle

Array = NDArray[np.float64]

_DERIVATIVE_STEP = 1e-6


class Coordinates(Protocol):
    """What a search varies."""

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,)."""

    @property
    def reach(self) -> Array:
        """(p,) by how much a step may change each coordinate."""

    def chain(self, x: Array) -> Chain:
        """The chain at coordinates x (p,), without effects."""

    def arms(self, x: Array, recordings: Sequence[Recording]) -> tuple[Arm, ...]:
        """What moves in each of the recordings."""


@dataclass(frozen=True)
class Hold:
    """One physical parameter held at a value.

    Attributes:
        index: of the parameter.
        value: in its unit.
        width: how closely, in its unit.
    """

    index: int
    value: float
    width: float


@dataclass(frozen=True)
class TrajectoryProblem:
    """Everything measured in several recordings, as a function of a parametrisation's coordinates and initial states.

    Attributes:
        parametrisation: the coordinates.
        observed: the recordings.
        coarse: multiple of the integrator's default step.
        preference: centre and width (p,) of the coordinates wanted where the data are silent; None: no preference.
        spread: size of the weighted residuals that counts as one standard deviation beside the preference.
        hold: a parameter that is not free; None: all are.
        extension: what is varied where that is more than the parametrisation, whose coordinates come first.
    """

    parametrisation: Parametrisation
    observed: tuple[Observed, ...]
    coarse: float = 1.0
    preference: tuple[Array, Array] | None = None
    spread: float = 1.0
    hold: Hold | None = None
    extension: Coordinates | None = None

    @property
    def varied(self) -> Coordinates:
        """What the search varies."""
        return self.parametrisation if self.extension is None else self.extension

    @property
    def longest(self) -> float:
        """Duration of the longest recording [s]."""
        return max(float(each.recording.time[-1] - each.recording.time[0]) for each in self.observed)

    @property
    def guided(self) -> bool:
        """Whether simulations are held near the angles that encoders measured."""
        return any(each.guide is not None for each in self.observed)

    def until(self, duration: float) -> TrajectoryProblem:
        """The same with the recordings' first seconds only."""
        parts = [each.until(float(each.recording.time[0]) + duration) for each in self.observed]
        return replace(self, observed=tuple(parts))

    def arms(self, x: Array) -> tuple[Arm, ...]:
        """What moves in each recording."""
        return self.varied.arms(x, [each.recording for each in self.observed])

    def moved(self, x: Array) -> tuple[tuple[Moved, ...], ...]:
        """For each recording, its arm with each coordinate moved a little."""
        found = []
        upper = self.varied.bounds[1]
        for k, value in enumerate(x):
            by = _DERIVATIVE_STEP * max(abs(value), 1e-2)
            by = by if value + by <= upper[k] else -by
            point = x.copy()
            point[k] += by
            found.append([Moved(arm, by) for arm in self.arms(point)])
        return tuple(zip(*found, strict=True))

    def preferred(self, x: Array) -> tuple[Array, Array]:
        """Rows (r, p) and what they want (r,) of a preference and of a parameter held, for a change of x."""
        rows, wanted = np.zeros((0, x.size)), np.zeros(0)
        if self.preference is not None:
            centre, width = self.preference
            rows, wanted = np.diag(self.spread / width), self.spread * (centre - x) / width
        if self.hold is None:
            return rows, wanted
        slope = self.parametrisation.jacobian(x)[self.hold.index] / self.hold.width
        return np.vstack([rows, slope]), np.append(wanted, self.held(x))

    def held(self, x: Array) -> float:
        """How far the parameter held is off its value, in widths; zero where none is held."""
        if self.hold is None:
            return 0.0
        return float((self.hold.value - self.parametrisation.physical(x)[self.hold.index]) / self.hold.width)


@dataclass(frozen=True)
class Point:
    """Coordinates and initial states, with every recording simulated from there.

    Attributes:
        problem: what is minimised.
        x: (p,) coordinates.
        runs: one a recording.
    """

    problem: TrajectoryProblem
    x: Array
    runs: tuple[Run, ...]

    @cached_property
    def chain(self) -> Chain:
        """The chain at x."""
        return self.problem.varied.chain(self.x)

    @cached_property
    def cost(self) -> float:
        """What the search minimises."""
        wanted = self.problem.preferred(self.x)[1]
        return sum(run.cost for run in self.runs) + float(wanted @ wanted)

    @property
    def held_cost(self) -> float:
        """What a parameter held adds to the cost."""
        return self.problem.held(self.x) ** 2

    @property
    def chi2(self) -> float:
        """Sum of squared weighted residuals."""
        return sum(run.chi2 for run in self.runs)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return sum(run.observed.count for run in self.runs)

    @property
    def misfit(self) -> float:
        """RMS weighted residual: one where it is the noise."""
        return float(np.sqrt(self.chi2 / self.count))

    @cached_property
    def triangles(self) -> tuple[Triangle, ...]:
        """Each recording's linearised problem: its initial state first, then the coordinates."""
        moved = self.problem.moved(self.x)
        return tuple(run.triangle(own) for run, own in zip(self.runs, moved, strict=True))

    def gathered(self, damping: float = 0.0) -> tuple[Triangle, tuple[Triangle, ...]]:
        """What recordings and preference together say of the coordinates, and each recording's own problem."""
        parts = tuple(triangle.damped(damping) for triangle in self.triangles)
        rows = [part.eliminated(part.columns - self.x.size).R for part in parts]
        rows.append(np.column_stack(self.problem.preferred(self.x)))
        stacked = np.vstack(rows)
        return Triangle.of([(stacked[:, :-1], stacked[:, -1])], self.x.size), parts
