"""The maximum-likelihood fit in the space of what was measured: every recording simulated open loop, all at once.

Unknowns are the parametrisation's coordinates and every recording's initial state. The initial states are eliminated
recording by recording, so the search itself is one over the coordinates (Levenberg-Marquardt). It starts with the
recordings' first few periods, where no frequency error can have cost a whole cycle, and lengthens them step by step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from vjm.chain.records import Chain
from vjm.errors import SimulationDivergedError
from vjm.identification.parametrisation import Parametrisation
from vjm.simulate.damping import Damping
from vjm.simulate.initial_state import most_likely
from vjm.simulate.observation import Observed
from vjm.simulate.rollout import locked_frequencies
from vjm.simulate.run import Run, Start, run_all
from vjm.simulate.sensitivity import Moved
from vjm.simulate.triangle import Triangle

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_MOST_ITERATIONS = 60
_NEGLIGIBLE = 1e-3  # decrease of chi^2, in units of its mean: three hundredths of a standard error
_COARSE = 1e-2  # the same relative to chi^2, before the whole recordings are looked at
_FIRST_PERIODS = 3.0  # of the slowest mode
_LONGER = 3.0  # from one horizon to the next
_DERIVATIVE_STEP = 1e-6


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
    """

    parametrisation: Parametrisation
    observed: tuple[Observed, ...]
    coarse: float = 1.0
    preference: tuple[Array, Array] | None = None
    spread: float = 1.0
    hold: Hold | None = None

    def until(self, duration: float) -> TrajectoryProblem:
        """The same with the recordings' first seconds only."""
        parts = [each.until(float(each.recording.time[0]) + duration) for each in self.observed]
        return replace(self, observed=tuple(parts))

    def moved(self, x: Array) -> tuple[Moved, ...]:
        """The chain with each coordinate moved a little."""
        found = []
        upper = self.parametrisation.bounds[1]
        for k, value in enumerate(x):
            by = _DERIVATIVE_STEP * max(abs(value), 1e-2)
            by = by if value + by <= upper[k] else -by
            point = x.copy()
            point[k] += by
            found.append(Moved(self.parametrisation.chain(point), by))
        return tuple(found)

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
        return self.problem.parametrisation.chain(self.x)

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

    @cached_property
    def triangles(self) -> tuple[Triangle, ...]:
        """Each recording's linearised problem: its initial state first, then the coordinates."""
        moved = self.problem.moved(self.x)
        return tuple(run.triangle(moved) for run in self.runs)

    def gathered(self, damping: float = 0.0) -> tuple[Triangle, tuple[Triangle, ...]]:
        """What recordings and preference together say of the coordinates, and each recording's own problem."""
        parts = tuple(triangle.damped(damping) for triangle in self.triangles)
        rows = [part.eliminated(part.columns - self.x.size).R for part in parts]
        rows.append(np.column_stack(self.problem.preferred(self.x)))
        stacked = np.vstack(rows)
        return Triangle.of([(stacked[:, :-1], stacked[:, -1])], self.x.size), parts


@dataclass(frozen=True)
class TrajectoryFit:
    """A minimum.

    Attributes:
        point: where.
        converged: whether nothing more was to be gained there.
        iterations: simulations of all recordings it took.
    """

    point: Point
    converged: bool
    iterations: int


def fit_trajectory(
    problem: TrajectoryProblem,
    start: Array,
    progress: Progress | None = None,
    states: Sequence[Array] | None = None,
    known: float = np.inf,
) -> TrajectoryFit:
    """Find the coordinates and initial states that explain the measurements best.

    Args:
        problem: the measurements and the coordinates.
        start: (p,) coordinates to start from.
        progress: told (text, done, total) now and then.
        states: (2 nv,) initial states near the minimum; None: the search begins with the recordings' first periods.
        known: how long `start` and `states` are known to follow the recordings [s].
    """
    lower, upper = problem.parametrisation.bounds
    x = np.clip(start, lower + 1e-6, upper)
    horizons = _horizons(problem, x, 0.0 if states is None else known)
    count = 0
    for k, horizon in enumerate(horizons):
        last = k == len(horizons) - 1
        part = problem if last else problem.until(horizon)
        fit = _search(part, x, states, _Progress(progress, k, len(horizons)), final=last)
        count += fit.iterations
        x, states = fit.point.x, [run.state for run in fit.point.runs]
    return replace(fit, iterations=count)


def _horizons(problem: TrajectoryProblem, x: Array, known: float) -> list[float]:
    """Lengths of the recordings' beginnings to fit, beyond what is known, each a few times the one before [s]."""
    longest = max(float(o.recording.time[-1] - o.recording.time[0]) for o in problem.observed)
    horizon, found = first_horizon(problem, x), []
    while horizon < longest / 1.5:
        if horizon > _LONGER / 2 * known:
            found.append(horizon)
        horizon *= _LONGER
    return [*found, np.inf]


def first_horizon(problem: TrajectoryProblem, x: Array) -> float:
    """A few periods of the slowest mode [s]: so short that a wrong frequency has not yet cost a cycle."""
    chain = problem.parametrisation.chain(x)
    return _FIRST_PERIODS / min(locked_frequencies(chain, o.recording.payload)[0] for o in problem.observed)


@dataclass(frozen=True)
class _Progress:
    """Says how far the search has come."""

    tell: Progress | None
    stage: int
    stages: int

    def __call__(self, iteration: int) -> None:
        if self.tell is not None:
            inside = 1 - 0.7**iteration  # how many more there will be is not known
            self.tell("fitting trajectories", int(100 * (self.stage + inside) / self.stages), 100)


def _search(
    problem: TrajectoryProblem, x: Array, states: Sequence[Array] | None, tell: _Progress, final: bool
) -> TrajectoryFit:
    if states is None:
        found = most_likely(problem.parametrisation.chain(x), problem.observed, coarse=problem.coarse)
        point = Point(problem, x, tuple(run for run, _ in found))
    else:
        point = _point(problem, x, states)
        point = replace(point, runs=tuple(run.weighed() for run in point.runs))
    damping, done, iteration = Damping(), False, 0
    for iteration in range(_MOST_ITERATIONS):
        tell(iteration)
        change, state_changes, predicted = _step(point, damping.value)
        least = _NEGLIGIBLE * max(point.chi2 / point.count, 1.0)
        if predicted < (least if final else max(least, _COARSE * point.chi2)):
            done = True
            break
        trial = _attempt(point, change, state_changes)
        if trial is not None and trial.cost < point.cost:
            point = replace(trial, runs=tuple(run.weighed() for run in trial.runs))
            damping = damping.better()
        else:
            damping = damping.worse()
            if damping.exhausted:
                break
    return TrajectoryFit(point, done, iteration + 1)


def _point(
    problem: TrajectoryProblem, x: Array, states: Sequence[Array], spreads: Sequence[float] | None = None
) -> Point:
    chain = problem.parametrisation.chain(x)
    starts = [Start.of(chain, each.recording) for each in problem.observed]
    if spreads is not None:
        starts = [replace(start, spread=spread) for start, spread in zip(starts, spreads, strict=True)]
    runs = run_all(chain, problem.observed, starts, states, problem.coarse)
    return Point(problem, x, tuple(runs))


def _step(point: Point, damping: float) -> tuple[Array, list[Array], float]:
    """Change of the coordinates and of the initial states, and the decrease of the cost that they promise."""
    together, parts = point.gathered(damping)
    lower, upper = point.problem.parametrisation.bounds
    change = together.best()
    if ((point.x + change < lower) | (point.x + change > upper)).any():
        R = together.R[:, :-1]
        scale = np.maximum(np.linalg.norm(R, axis=0), 1e-300)
        bounds = ((lower - point.x) * scale, (upper - point.x) * scale)
        bounds = (np.minimum(bounds[0], 0.0) - 1e-12, np.maximum(bounds[1], 0.0) + 1e-12)
        change = np.clip(lsq_linear(R / scale, together.R[:, -1], bounds).x / scale, lower - point.x, upper - point.x)
    states, predicted = [], 0.0
    for run, part, plain in zip(point.runs, parts, point.triangles, strict=True):
        modal = part.solve(part.columns - change.size, change)
        states.append(run.basis.states @ modal)
        predicted += plain.decrease(np.concatenate([modal, change]))
    rows, wanted = point.problem.preferred(point.x)
    predicted += float(wanted @ wanted - np.sum((wanted - rows @ change) ** 2))
    return change, states, predicted


def _attempt(point: Point, change: Array, states: Sequence[Array]) -> Point | None:
    """The point a step further; None where a simulation diverges or the chain is none."""
    moved = [run.state + by for run, by in zip(point.runs, states, strict=True)]
    try:
        spreads = [run.start.spread for run in point.runs]
        return _point(point.problem, point.x + change, moved, spreads)
    except SimulationDivergedError:
        return None
