"""The maximum-likelihood fit in the space of what was measured: every recording simulated open loop, all at once.

Unknowns are the parametrisation's coordinates and every recording's initial state. The initial states are eliminated
recording by recording, so the search itself is one over the coordinates (Levenberg-Marquardt). It starts with the
recordings' first few periods, where no frequency error can have cost a whole cycle, and lengthens them step by step.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Protocol

import numpy as np
from scipy.optimize import lsq_linear

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.parameters import Parametrisation
from vjm.model.modes import modes
from vjm.records import Array, Progress, Record, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import backtrack, fit_initial_states, simulate_or_rest
from vjm.simulation.least_squares import Damping, SquareRootInformation
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run
from vjm.simulation.sensitivity import PerturbedArm

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
class FixedParameter:
    """One physical parameter held at a value.

    Attributes:
        index: of the parameter.
        value: in its unit.
        width: how closely, in its unit.
    """

    index: int
    value: float
    width: float


@dataclass(frozen=True, repr=False)
class TrajectoryProblem(Record):
    """Everything measured in several recordings, as a function of a parametrisation's coordinates and initial states.

    Attributes:
        parametrisation: the coordinates.
        observed: the recordings.
        step_multiple: multiple of the integrator's default step.
        preference: centre and width (p,) of the coordinates wanted where the data are silent; None: no preference.
        spread: size of the weighted residuals that counts as one standard deviation beside the preference.
        fixed: a parameter that is not free; None: all are.
        extension: what is varied where that is more than the parametrisation, whose coordinates come first.
    """

    parametrisation: Parametrisation
    observed: tuple[Observations, ...]
    step_multiple: float = 1.0
    preference: tuple[Array, Array] | None = None
    spread: float = 1.0
    fixed: FixedParameter | None = None
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
    def with_feedback(self) -> bool:
        """Whether simulations are held near the angles that encoders measured."""
        return any(each.feedback is not None for each in self.observed)

    def until(self, duration: float) -> TrajectoryProblem:
        """The same with the recordings' first seconds only."""
        parts = [each.truncated(float(each.recording.time[0]) + duration) for each in self.observed]
        return replace(self, observed=tuple(parts))

    def arms(self, x: Array) -> tuple[Arm, ...]:
        """What moves in each recording."""
        return self.varied.arms(x, [each.recording for each in self.observed])

    def moved(self, x: Array) -> tuple[tuple[PerturbedArm, ...], ...]:
        """For each recording, its arm with each coordinate moved a little."""
        found = []
        upper = self.varied.bounds[1]
        for k, value in enumerate(x):
            by = _DERIVATIVE_STEP * max(abs(value), 1e-2)
            by = by if value + by <= upper[k] else -by
            point = x.copy()
            point[k] += by
            found.append([PerturbedArm(arm, by) for arm in self.arms(point)])
        return tuple(zip(*found, strict=True))

    def preferred(self, x: Array) -> tuple[Array, Array]:
        """Rows (r, p) and what they want (r,) of a preference and of a parameter held, for a change of x."""
        rows, wanted = np.zeros((0, x.size)), np.zeros(0)
        if self.preference is not None:
            centre, width = self.preference
            rows, wanted = np.diag(self.spread / width), self.spread * (centre - x) / width
        if self.fixed is None:
            return rows, wanted
        slope = self.parametrisation.jacobian(x)[self.fixed.index] / self.fixed.width
        return np.vstack([rows, slope]), np.append(wanted, self.fixed_offset(x))

    def fixed_offset(self, x: Array) -> float:
        """How far the parameter held is off its value, in widths; zero where none is held."""
        if self.fixed is None:
            return 0.0
        return float((self.fixed.value - self.parametrisation.physical(x)[self.fixed.index]) / self.fixed.width)


@dataclass(frozen=True, repr=False)
class Point(Record):
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
    def fixed_cost(self) -> float:
        """What a parameter held adds to the cost."""
        return self.problem.fixed_offset(self.x) ** 2

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
    def linearizations(self) -> tuple[SquareRootInformation, ...]:
        """Each recording's linearised problem: its initial state first, then the coordinates."""
        moved = self.problem.moved(self.x)
        return tuple(run.linearized(own) for run, own in zip(self.runs, moved, strict=True))

    def gathered(self, damping: float = 0.0) -> tuple[SquareRootInformation, tuple[SquareRootInformation, ...]]:
        """What recordings and preference together say of the coordinates, and each recording's own problem."""
        parts = tuple(linearized.damped(damping) for linearized in self.linearizations)
        rows = [part.eliminated(part.columns - self.x.size).R for part in parts]
        rows.append(np.column_stack(self.problem.preferred(self.x)))
        stacked = np.vstack(rows)
        return SquareRootInformation.of([(stacked[:, :-1], stacked[:, -1])], self.x.size), parts


_MOST_ITERATIONS = 60
_NEGLIGIBLE = 1e-3  # decrease of chi^2, in units of its mean: three hundredths of a standard error
_ROUGH = 0.5  # the same, once a step has not lowered it at all
_COARSE = 1e-2  # the same relative to chi^2, before the whole recordings are looked at
_FIRST_PERIODS = 3.0  # of the slowest mode
_LONGER = 3.0  # from one horizon to the next
_MISSED = 0.5  # of what a step predicts for a recording


@dataclass(frozen=True, repr=False)
class TrajectoryFit(Record):
    """A minimum.

    Attributes:
        point: where.
        converged: whether nothing more was to be gained there.
        iterations: simulations of all recordings it took.
        promised: by how much another search would first expect to lower the cost; infinite: not known.
    """

    point: Point
    converged: bool
    iterations: int
    promised: float = np.inf


def fit_trajectory(
    problem: TrajectoryProblem,
    start: Array,
    progress: Progress | None = None,
    states: Sequence[Array] | None = None,
    known: float = np.inf,
    rough: bool = False,
    hopeless: Callable[[Point, float], bool] | None = None,
) -> TrajectoryFit:
    """Find the coordinates and initial states that explain the measurements best.

    Args:
        problem: the measurements and the coordinates.
        start: (p,) coordinates to start from.
        progress: told (text, done, total) now and then.
        states: (2 nv,) initial states near the minimum; None: the search begins with the recordings' first periods.
        known: how long `start` and `states` are known to follow the recordings [s].
        rough: whether the minimum is only a start for another search.
        hopeless: told where the search is and by how much its next step is expected to lower the cost; it may end it.
    """
    lower, upper = problem.varied.bounds
    x = np.clip(start, lower + 1e-6, upper)
    horizons = _horizons(problem, x, 0.0 if states is None else known)
    count = 0
    for k, horizon in enumerate(horizons):
        last = k == len(horizons) - 1
        part = problem if last else problem.until(horizon)
        tell = _Progress(progress, k, len(horizons))
        fit = _search(part, x, states, tell, last and not rough, hopeless if last else None)
        count += fit.iterations
        x, states = fit.point.x, [run.state for run in fit.point.runs]
    return replace(fit, iterations=count)


def _horizons(problem: TrajectoryProblem, x: Array, known: float) -> list[float]:
    """Lengths of the recordings' beginnings to fit, beyond what is known, each a few times the one before [s]."""
    horizon, found = first_horizon(problem, x), []
    while horizon < problem.longest / 1.5:
        if horizon > _LONGER / 2 * known:
            found.append(horizon)
        horizon *= _LONGER
    return [*found, np.inf]


def first_horizon(problem: TrajectoryProblem, x: Array) -> float:
    """A few periods of the slowest vibration [s]: so short that a wrong frequency has not yet cost a cycle."""
    chain = problem.varied.chain(x)
    return _FIRST_PERIODS / min(float(modes(chain, o.recording.payload).frequencies[0]) for o in problem.observed)


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
    problem: TrajectoryProblem,
    x: Array,
    states: Sequence[Array] | None,
    tell: _Progress,
    final: bool,
    hopeless: Callable[[Point, float], bool] | None,
) -> TrajectoryFit:
    if states is None:
        found = fit_initial_states(problem.arms(x), problem.observed, step_multiple=problem.step_multiple)
        point = Point(problem, x, tuple(run for run, _ in found))
    else:
        point = _point(problem, x, states, states)
        point = replace(point, runs=tuple(run.with_scaled_prior() for run in point.runs))
    damping, done, iteration, promised = Damping(), False, 0, np.inf
    for iteration in range(_MOST_ITERATIONS):
        tell(iteration)
        step = _step(point, damping.value)
        promised = np.inf if damping.value else step.predicted
        least = _NEGLIGIBLE * max(point.misfit, 1.0) ** 2
        if step.predicted < (least if final else max(least, _COARSE * point.chi2)):
            done = True
            break
        if hopeless is not None and hopeless(point, step.predicted):
            break
        trial = _attempt(point, step)
        if trial is not None and trial.cost < point.cost:
            point = replace(trial, runs=tuple(run.with_scaled_prior() for run in trial.runs))
            damping = damping.better()
        else:
            if trial is not None and _step(point, 0.0).predicted < _ROUGH * max(point.misfit, 1.0) ** 2:
                done = True  # what yields or sticks makes the cost rough: no step finds what slopes promise
                break
            damping = damping.worse(partial(_length, point))
            if damping.exhausted:
                break
    return TrajectoryFit(point, done, iteration + 1, promised)


def _point(
    problem: TrajectoryProblem,
    x: Array,
    states: Sequence[Array],
    known: Sequence[Array],
    spreads: Sequence[float] | None = None,
) -> Point:
    arms = problem.arms(x)
    starts = [InitialStatePrior.of(arm, each.recording) for arm, each in zip(arms, problem.observed, strict=True)]
    if spreads is not None:
        starts = [replace(prior, scale=scale) for prior, scale in zip(starts, spreads, strict=True)]
    runs = simulate_or_rest(arms, problem.observed, starts, states, known, problem.step_multiple)
    return Point(problem, x, tuple(runs))


@dataclass(frozen=True)
class _Step:
    """A step from a point.

    Attributes:
        change: (p,) of the coordinates.
        states: (2 nv,) of each recording's initial state.
        own: (2 nv,) of each, were the coordinates to stay.
        gains: by how much each recording's part of the cost should fall.
        predicted: the decrease of the cost.
    """

    change: Array
    states: list[Array]
    own: list[Array]
    gains: list[float]
    predicted: float


def _step(point: Point, damping: float) -> _Step:
    """The step that the linearised problem asks for."""
    together, parts = point.gathered(damping)
    lower, upper = point.problem.varied.bounds
    reach = point.problem.varied.reach
    lower, upper = np.maximum(lower, point.x - reach), np.minimum(upper, point.x + reach)
    change = together.best()
    if ((point.x + change < lower) | (point.x + change > upper)).any():
        R = together.R[:, :-1]
        scale = np.maximum(np.linalg.norm(R, axis=0), 1e-300)
        bounds = ((lower - point.x) * scale, (upper - point.x) * scale)
        bounds = (np.minimum(bounds[0], 0.0) - 1e-12, np.maximum(bounds[1], 0.0) + 1e-12)
        change = np.clip(lsq_linear(R / scale, together.R[:, -1], bounds).x / scale, lower - point.x, upper - point.x)
    states, own, gains = [], [], []
    for run, part, plain in zip(point.runs, parts, point.linearizations, strict=True):
        modal, alone = (part.solve(part.columns - change.size, by) for by in (change, np.zeros(change.size)))
        states.append(run.basis.states @ modal)
        own.append(run.basis.states @ alone)
        gains.append(plain.decrease(np.concatenate([modal, change])))
    rows, wanted = point.problem.preferred(point.x)
    preferred = float(wanted @ wanted - np.sum((wanted - rows @ change) ** 2))
    return _Step(change, states, own, gains, sum(gains) + preferred)


def _length(point: Point, damping: float) -> float:
    """Of the step of the coordinates, in the lengths of the predictions' derivatives by each."""
    return float(np.linalg.norm(point.gathered()[0].scale * _step(point, damping).change))


def _attempt(point: Point, step: _Step) -> Point | None:
    """The point a step further; None where a simulation diverges or the chain is none."""
    moved = [run.state + by for run, by in zip(point.runs, step.states, strict=True)]
    try:
        spreads = [run.prior.scale for run in point.runs]
        trial = _point(point.problem, point.x + step.change, moved, [run.state for run in point.runs], spreads)
    except (SimulationDivergedError, InsufficientDataError):  # or it does not come to rest under its load
        return None
    with contextlib.suppress(SimulationDivergedError):
        return _nearer(point, step, trial)
    return trial


def _nearer(point: Point, step: _Step, trial: Point) -> Point:
    """A trial whose recordings that stick or rattle begin nearer to where they did, if that follows them better.

    The coordinates' part of a step holds for them, what it does to a state for its own sake often not.
    """
    missed = [
        k
        for k, (before, run, gain) in enumerate(zip(point.runs, trial.runs, step.gains, strict=True))
        if is_nonsmooth(run.arm.effects) and before.cost - run.cost < gain - _MISSED * abs(gain)
    ]
    runs = list(trial.runs)
    found = backtrack([runs[k] for k in missed], [step.own[k] for k in missed], point.problem.step_multiple)
    for k, run in zip(missed, found, strict=True):
        runs[k] = run
    return replace(trial, runs=tuple(runs))
