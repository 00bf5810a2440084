"""Maximum-likelihood fit of trajectories: all recordings are simulated open loop, and their residuals minimised.

Unknowns are the parametrisation's coordinates and every recording's initial state. The initial states are eliminated
recording by recording (variable projection), so that Levenberg-Marquardt steps are taken in the coordinates alone. The
search starts with the recordings' first few periods, over which a wrong frequency is off by less than a cycle, and
lengthens them step by step.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, Key, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.parameters import NEAREST_TO_BOUND, Parametrisation, at_bounds
from vjm.model.modes import modes
from vjm.records import REFERENCE, Array, Mask, Progress, Record, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import (
    backtrack,
    best_damped,
    fit_initial_states,
    refine_initial_states,
    simulate_from_best_states,
)
from vjm.simulation.integrate import locked_joint_frequencies
from vjm.simulation.least_squares import LevenbergMarquardt, SquareRootInformation, Status, Step, minimise
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run, is_followed, linearize
from vjm.simulation.variational_equations import PerturbedArm
from vjm.text import ratio

DIVERGED_MISFIT = 10.0  # RMS residual over noise from which a fit has certainly not found the minimum it looks for
# Decrease by a step of the coordinates, in units of the reduced chi^2, below which they have settled where the cost is
# nonsmooth: a step of 0.3 standard errors, which adds 4 % to the error.
_SETTLED_DECREASE = 0.1
# Decreases predicted for its next step that a fit is given: one that then stays above the best so far is given up.
LARGEST_GAIN = 3.0
_GROWTH = 3.0  # of the horizon: a frequency fitted to it is right to far less than the sixth of a cycle that is safe


@dataclass(frozen=True, repr=False)
class TrajectoryProblem(Record):
    """Least-squares problem of several recordings: coordinates of a chain and of effects, and initial states.

    Attributes:
        parametrisation: the chain's coordinates.
        observed: the recordings.
        step_multiple: multiple of the integrator's default step.
        preference: mean and standard deviation (p,) of a normal prior of the coordinates; None: no prior.
        fixed: index of a physical parameter that is held, its value, and the standard deviation allowed; None: all are
            free.
        effects: effects in the model, of any size. Their coordinates follow those of the chain: magnitudes in units of
            typical ones, then shape parameters: logarithms, or linear where they may be zero.
        reference_effects: number of effects, the first ones, that act in the reference recordings too.
    """

    parametrisation: Parametrisation
    observed: tuple[Observations, ...]
    step_multiple: float = 1.0
    preference: tuple[Array, Array] | None = None
    fixed: tuple[int, float, float] | None = None
    effects: tuple[Effect, ...] = ()
    reference_effects: int = 0

    def chain(self, x: Array) -> Chain:
        """Build the chain at coordinates x (p,), without effects."""
        return self.parametrisation.chain(x[: len(self.parametrisation.coordinates)])

    def effects_at(self, x: Array) -> tuple[Effect, ...]:
        """Return the effects at coordinates x (p,)."""
        return tuple(effect.at(x[part]) for effect, part in zip(self.effects, self.parts, strict=True))

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Coordinates of each effect."""
        counts = [effect.coordinates.size for effect in self.effects]
        stops = (len(self.parametrisation.coordinates) + np.cumsum(counts, dtype=int)).tolist()
        return tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,) of the coordinates."""
        bounds = zip(self.parametrisation.bounds, *(effect.bounds for effect in self.effects), strict=True)
        lower, upper = map(np.concatenate, bounds)
        for effect, part in zip(self.effects, self.parts, strict=True):
            if effect.adds_joint(self.parametrisation.template):
                lower[part.start] = 1e-3  # at zero the joint would vanish, and with it a coordinate of the chain
        return lower, upper

    @cached_property
    def max_step(self) -> Array:
        """(p,) largest change of each coordinate in one step; only shape parameters, far from linear, are limited."""
        steps = np.full(self.bounds[0].size, np.inf)
        for effect, part in zip(self.effects, self.parts, strict=True):
            # A factor e of a shape parameter whose coordinate is a logarithm, a typical value of a linear one.
            shapes = np.setdiff1d(np.arange(part.stop - part.start), effect.size_coordinates)
            steps[part.start + shapes] = 1.0
        return steps

    @property
    def longest(self) -> float:
        """Duration of the longest recording [s]."""
        return max(float(observed.recording.time[-1] - observed.recording.time[0]) for observed in self.observed)

    def until(self, duration: float) -> TrajectoryProblem:
        """Return the problem of the recordings' first `duration` seconds."""
        parts = [observed.truncated(float(observed.recording.time[0]) + duration) for observed in self.observed]
        return replace(self, observed=tuple(parts))

    def first_horizon(self, x: Array) -> float:
        """Return three periods of the slowest vibration [s], the duration of the first fit.

        A frequency that is wrong by 15 % is off by half a cycle after these, the most from which the gradient leads to
        the right minimum.
        """
        chain = self.chain(x)
        return 3 / min(
            float(modes(chain, observed.recording.payload_body).frequencies[0]) for observed in self.observed
        )

    def durations(self, first: float) -> list[float]:
        """Return the durations [s] to fit one after another, from `first` to infinite: whole recordings."""
        durations = []
        while first < self.longest / 1.5:  # a longer one would hardly differ from the whole
            durations.append(first)
            first *= _GROWTH
        return [*durations, np.inf]

    def arms(self, x: Array, recordings: Sequence[Recording] | None = None) -> tuple[Arm, ...]:
        """Return the arm at coordinates x (p,) in each of some recordings; None: in the problem's own."""
        chain, present = self.chain(x), self.effects_at(x)
        reference, extended = Arm.of(chain, present[: self.reference_effects]), Arm.of(chain, present)
        wanted = [observed.recording for observed in self.observed] if recordings is None else recordings
        return tuple(
            (reference if recording.condition == REFERENCE else extended).in_recording(recording)
            for recording in wanted
        )

    def point(self, x: Array, states: Sequence[Array] | None = None) -> Point:
        """Simulate every recording at coordinates x (p,), from given or from maximum-likelihood initial states (2 nv,).

        Raises:
            SimulationDivergedError: one of them diverged.
        """
        if states is None:
            likely = fit_initial_states(self.arms(x), self.observed, step_multiple=self.step_multiple)
            return Point(self, x, tuple(run for run, _ in likely))
        return self.simulated(x, states, states, [1.0] * len(states)).with_scaled_prior()

    def simulated(self, x: Array, states: Sequence[Array], others: Sequence[Array], scales: Sequence[float]) -> Point:
        """Simulate every recording at x (p,) by `simulate_from_best_states`, its prior at a given scale."""
        arms = self.arms(x)
        triples = zip(arms, self.observed, scales, strict=True)
        priors = [InitialStatePrior.of(arm, observed.recording, scale) for arm, observed, scale in triples]
        return Point(
            self, x, tuple(simulate_from_best_states(arms, self.observed, priors, states, others, self.step_multiple))
        )

    def perturbed_arms(self, x: Array) -> tuple[tuple[PerturbedArm, ...], ...]:
        """Return, for each recording, its arm with each coordinate perturbed in turn, for finite differences."""
        by_coordinate = []
        lower, upper = self.bounds
        for k, value in enumerate(x):
            step = 1e-6 * max(abs(value), 1e-2)
            step = step if lower[k] <= value + step <= upper[k] else -step
            moved = x.copy()
            moved[k] += step
            by_coordinate.append([PerturbedArm(arm, step) for arm in self.arms(moved)])
        return tuple(zip(*by_coordinate, strict=True))

    def prior(self, x: Array) -> tuple[Array, Array]:
        """Return the Jacobian (r, p) and residuals (r,) of the priors at x: the preference, then the parameter held."""
        rows, residual = np.zeros((0, x.size)), np.zeros(0)
        if self.preference is not None:
            centre, width = self.preference
            rows, residual = np.diag(1 / width), (centre - x) / width
        if self.fixed is None:
            return rows, residual
        index, value, fixed_width = self.fixed
        slope = self.parametrisation.jacobian(x)[index] / fixed_width
        distance = (value - self.parametrisation.physical(x)[index]) / fixed_width
        return np.vstack([rows, slope]), np.append(residual, distance)


@dataclass(frozen=True, repr=False)
class Point(Record):
    """An iterate of the search: coordinates and initial states, with every recording simulated from them.

    Attributes:
        problem: the least-squares problem.
        x: (p,) coordinates.
        runs: the run of each recording or segment, with its initial state.
    """

    problem: TrajectoryProblem
    x: Array
    runs: tuple[Run, ...]

    @cached_property
    def chain(self) -> Chain:
        """The chain at x."""
        return self.problem.chain(self.x)

    @property
    def states(self) -> list[Array]:
        """(2 nv,) initial state of each recording."""
        return [run.state for run in self.runs]

    @cached_property
    def held(self) -> Mask:
        """(p,) true for coordinates at a bound, which keeps them from changing with the measurements."""
        return at_bounds(self.x, self.problem.bounds)

    @cached_property
    def cost(self) -> float:
        """Objective of the search: the residuals' loss, and the priors of x and of the initial states."""
        residual = self.problem.prior(self.x)[1]
        return sum(run.cost for run in self.runs) + float(residual @ residual)

    @property
    def chi2(self) -> float:
        """Sum of squared weighted residuals, as of `Run.chi2`."""
        return sum(run.chi2 for run in self.runs)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return sum(run.observed.count for run in self.runs)

    @property
    def expected_chi2(self) -> float:
        """Expected value of `chi2` where the model is right: the number of values, if there is no timing noise."""
        return sum(run.expected_chi2 for run in self.runs)

    @property
    def noise_limit(self) -> float:
        """Chi^2 below which only noise is left: five standard deviations above its expected value."""
        return self.expected_chi2 + 5 * float(np.sqrt(2 * self.count))

    @property
    def misfit(self) -> float:
        """RMS weighted residual, the root of the reduced chi^2: one where only noise is left."""
        return float(np.sqrt(self.chi2 / max(self.expected_chi2, 1.0)))

    @cached_property
    def linearizations(self) -> tuple[SquareRootInformation, ...]:
        """Each recording's linearised problem: its initial state first, then the coordinates."""
        moved = self.problem.perturbed_arms(self.x)
        return tuple(
            run.linearized(linearization)
            for run, linearization in zip(self.runs, linearize(self.runs, moved), strict=True)
        )

    def reduced(self, damping: float = 0.0) -> tuple[SquareRootInformation, tuple[SquareRootInformation, ...]]:
        """Return the linearised problem of the coordinates, initial states eliminated, and each recording's of both."""
        parts = tuple(linearized.damped(damping) for linearized in self.linearizations)
        rows = [part.eliminated(part.columns - self.x.size).R for part in parts]
        rows.append(np.column_stack(self.problem.prior(self.x)))
        stacked = np.vstack(rows)
        return SquareRootInformation.of([(stacked[:, :-1], stacked[:, -1])], self.x.size), parts

    @cached_property
    def scale(self) -> Array:
        """(p,) norm of each coordinate's column of the Jacobian, initial states eliminated."""
        return self.reduced()[0].scale

    def with_scaled_prior(self) -> Point:
        """Return the point with its initial states' priors scaled by the RMS residuals."""
        return replace(self, runs=tuple(run.with_scaled_prior() for run in self.runs))


@dataclass(frozen=True, repr=False, eq=False)
class TrajectoryFit(Record):
    """Result of a fit.

    Attributes:
        point: the last iterate.
        converged: True if it is a minimum: the predicted decrease of another step is negligible.
        iterations: number of simulations of all recordings.
        predicted_decrease: decrease of the cost predicted for another Gauss-Newton step; infinite: not known.
        shift: (p,) discretization correction, from the chain's best coordinates to those of a beam; None: not measured.
    """

    point: Point
    converged: bool = False
    iterations: int = 0
    predicted_decrease: float = np.inf
    shift: Array | None = None

    @property
    def chi2(self) -> float:
        """Sum of squared weighted residuals."""
        return self.point.chi2

    @property
    def misfit(self) -> float:
        """RMS weighted residual, the root of the reduced chi^2: one where only noise is left."""
        return self.point.misfit

    @property
    def estimate(self) -> Array:
        """(p,) coordinates corrected for the chain's discretization, where that was measured."""
        if self.shift is None:
            return self.point.x
        return np.clip(self.point.x + self.shift, *self.point.problem.bounds)

    @property
    def has_settled(self) -> bool:
        """True if it has converged, or its next step promises less than one standard error."""
        return self.converged or self.predicted_decrease < 1.0

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects with their parameters at the point, not corrected for the discretization."""
        return self.point.problem.effects_at(self.point.x)

    @property
    def new_effects(self) -> tuple[Effect, ...]:
        """Effects that do not act in the reference recordings."""
        return self.effects[self.point.problem.reference_effects :]

    def part_of(self, effect: Effect) -> slice:
        """Return the coordinates of one of the effects."""
        pairs = zip(self.effects, self.point.problem.parts, strict=True)
        return next(part for candidate, part in pairs if candidate is effect)

    def sizes_of(self, effect: Effect) -> list[int]:
        """Return the coordinates that are one of the effects' sizes."""
        return [self.part_of(effect).start + k for k in effect.size_coordinates]

    @cached_property
    def effect_keys(self) -> frozenset[Key]:
        """Ids of the effects, each with its place."""
        return frozenset(effect.key for effect in self.effects)


def fit_trajectory(
    problem: TrajectoryProblem,
    start: Array,
    progress: Progress | None = None,
    states: Sequence[Array] | None = None,
    known_duration: float = np.inf,
    rough: bool = False,
    stop: Callable[[Point, float], bool] | None = None,
) -> TrajectoryFit:
    """Fit coordinates and initial states by maximum likelihood.

    Args:
        problem: the measurements and the coordinates.
        start: (p,) coordinates to start from.
        progress: called with (text, done, total) now and then.
        states: (2 nv,) initial states near the minimum; None: the search begins with the recordings' first periods.
        known_duration: with `states`, the duration [s] that was fitted before: the search begins with the next longer.
        rough: True for a loose tolerance, where the minimum is only a start for another search.
        stop: ends the search where it returns True for the point and the decrease of the cost that its next step
            predicts.

    Raises:
        SimulationDivergedError: the start cannot be simulated.
    """
    lower, upper = problem.bounds
    x = np.clip(start, lower + NEAREST_TO_BOUND, upper)
    known = 0.0 if states is None else known_duration
    durations = problem.durations(problem.first_horizon(x))[:-1] if np.isfinite(known) else []
    horizons = [*(duration for duration in durations if duration > _GROWTH / 2 * known), np.inf]
    iterations = 0
    for k, horizon in enumerate(horizons):
        last = k == len(horizons) - 1

        def report(iteration: int, misfit: float, k: int = k) -> None:
            if progress is not None:
                fraction = 1 - 0.7**iteration  # the number of iterations is not known: an estimate for the progress bar
                text = f"fitting trajectories, residual {ratio(misfit)} × noise"
                progress(text, int(100 * (k + fraction) / len(horizons)), 100)

        part = problem if last else problem.until(horizon)
        search = _TrajectorySearch(part.point(x, states), last and not rough, stop, report)
        minimise([search], lambda running: [_trial_point(each.point, each.step) for each in running], max_trials=60)
        iterations += len(search.decreases) + 1
        x, states = search.point.x, search.point.states
    return TrajectoryFit(search.point, search.status == "converged", iterations, search.predicted_decrease)


def stays_above(point: Point, predicted: float, max_chi2: float) -> bool:
    """Return True if three times the decrease predicted for the next step would leave chi^2 above a bound."""
    return point.chi2 - LARGEST_GAIN * predicted > max_chi2


@dataclass(frozen=True)
class _TrajectoryStep(Step):
    """Step of coordinates and initial states.

    Attributes:
        change: (p,) change of the coordinates.
        state_changes: (2 nv,) change of each recording's initial state.
        own_changes: (2 nv,) part of each of these that does not follow from the coordinates' change.
        predicted_decreases: predicted decrease of each recording's part of the cost.
        coordinate_decrease: part of `predicted` by the coordinates' change, initial states following.
    """

    change: Array
    state_changes: list[Array]
    own_changes: list[Array]
    predicted_decreases: list[float]
    coordinate_decrease: float


class _TrajectorySearch(LevenbergMarquardt[Point, _TrajectoryStep]):
    """Levenberg-Marquardt search over coordinates, with each recording's initial state eliminated.

    Attributes:
        final: False for a loose tolerance, where the minimum is only a start for another search.
        stop: stopping rule, as of `fit_trajectory`.
        report: called with the number of the iteration and the RMS weighted residual.
        predicted_decrease: decrease of the cost predicted for the last Gauss-Newton step; infinite after a damped one.
    """

    def __init__(
        self,
        point: Point,
        final: bool,
        stop: Callable[[Point, float], bool] | None,
        report: Callable[[int, float], None],
    ) -> None:
        super().__init__(point)
        self.final, self.stop, self.report = final, stop, report
        self.predicted_decrease = np.inf

    def step_at(self, damping: float) -> _TrajectoryStep:
        """Minimise the linearised problem within the coordinates' bounds and largest steps."""
        point = self.point
        reduced, parts = point.reduced(damping)
        change = _bounded_change(reduced, point)
        state_changes, own_changes, decreases = [], [], []
        for run, part, undamped in zip(point.runs, parts, point.linearizations, strict=True):
            modal, uncoupled = (part.solve(part.columns - change.size, by) for by in (change, np.zeros(change.size)))
            state_changes.append(run.basis.states @ modal)
            own_changes.append(run.basis.states @ uncoupled)
            decreases.append(undamped.decrease(np.concatenate([modal, change])))
        rows, residual = point.problem.prior(point.x)
        prior_decrease = float(residual @ residual - np.sum((residual - rows @ change) ** 2))
        length = float(np.linalg.norm(point.scale * change))
        predicted, by_coordinates = sum(decreases) + prior_decrease, reduced.decrease(change)
        return _TrajectoryStep(predicted, length, change, state_changes, own_changes, decreases, by_coordinates)

    def stopping_rule(self) -> Status:
        """Converge where the predicted decrease is negligible; stop where `stop` says so."""
        self.report(len(self.decreases), self.point.misfit)
        self.predicted_decrease = np.inf if self.damping else self.step.predicted
        # A decrease by d units of chi^2 is a step of sqrt(d) standard errors: three hundredths of one.
        negligible = 1e-3 * self._chi2_unit
        if not self.final:  # 1 % of chi^2, 0.5 % of the RMS residual
            negligible = max(negligible, 1e-2 * self.point.chi2)
        if self.step.predicted < negligible or self._only_states_are_left():
            return "converged"
        return "stopped" if self.stop is not None and self.stop(self.point, self.step.predicted) else "running"

    def is_nonsmooth_minimum(self, trial: Point | None) -> bool:
        """Return True if a step that is not worth its price had predicted next to nothing.

        Stiction and play make the cost nonsmooth: no derivative leads an initial state any further, however much it
        promises. The coordinates are then where they belong if theirs promise little.
        """
        if trial is None:
            return False
        if is_nonsmooth(self.point.problem.effects) and self.decreases[-1] < self.step.predicted / 2:
            return self.step_at(0.0).coordinate_decrease < _SETTLED_DECREASE * self._chi2_unit
        rejected = not self.decreases[-1] > 0
        return rejected and self.step_at(0.0).predicted < 0.5 * self._chi2_unit  # a step of 0.7 standard errors

    def _only_states_are_left(self) -> bool:
        """Return True if no more than initial states are left to be improved, and these cannot make the model right.

        With stick-slip or play they take most of a fit's time, and where the model lacks something else they are
        estimated anew beside that.
        """
        if self.damping or not is_nonsmooth(self.point.problem.effects):
            return False
        settled = self.step.coordinate_decrease < _SETTLED_DECREASE * self._chi2_unit
        return settled and stays_above(self.point, self.step.predicted, self.point.noise_limit)

    @property
    def _chi2_unit(self) -> float:
        """Reduced chi^2, at least one: the decrease of chi^2 by a step of one standard error."""
        return max(self.point.misfit, 1.0) ** 2


def _bounded_change(problem: SquareRootInformation, point: Point) -> Array:
    """Return the change (p,) that minimises a linearised problem within the coordinates' bounds and largest steps."""
    max_step = point.problem.max_step
    lower, upper = point.problem.bounds
    lower, upper = np.maximum(lower - point.x, -max_step), np.minimum(upper - point.x, max_step)
    change = problem.best()
    if ((change < lower) | (change > upper)).any():
        scale = np.maximum(problem.scale, 1e-300)
        bounds = np.minimum(lower * scale, 0.0) - 1e-12, np.maximum(upper * scale, 0.0) + 1e-12
        change = np.clip(lsq_linear(problem.R[:, :-1] / scale, problem.R[:, -1], bounds).x / scale, lower, upper)
    return change


def _trial_point(point: Point, step: _TrajectoryStep) -> Point | None:
    """Simulate a step; None where it diverges, has no position of rest, or vibrates too fast for the samples."""
    states = [state + change for state, change in zip(point.states, step.state_changes, strict=True)]
    try:
        if _cycles_per_sample(point.problem, point.x + step.change) > 1.0 >= _cycles_per_sample(point.problem, point.x):
            return None
        scales = [run.prior.scale for run in point.runs]
        trial = point.problem.simulated(point.x + step.change, states, point.states, scales)
    except (SimulationDivergedError, InsufficientDataError):
        return None
    with contextlib.suppress(SimulationDivergedError):
        return _with_refined_states(point, step, trial)
    return trial


def _cycles_per_sample(problem: TrajectoryProblem, x: Array) -> float:
    """Return the cycles of the arm's slowest mode in a sampling interval, of the recording where they are fewest.

    Above one, no recording shows the mode. A search that stiffens the arm so far has diverged, as it does where torques
    are given in a unit that is wrong by 1e6, and its simulations would take very many steps.
    """
    cycles = []
    for arm, observed in zip(problem.arms(x), problem.observed, strict=True):
        recording = observed.recording
        slowest, _ = locked_joint_frequencies(arm.chain, recording.payload_body)
        cycles.append(slowest * np.ptp(recording.time) / max(recording.time.size - 1, 1))
    return float(min(cycles))


def _with_refined_states(point: Point, step: _TrajectoryStep, trial: Point) -> Point:
    """Refine the initial states of recordings whose cost falls by less than half of the predicted decrease.

    The linear model is often wrong for the initial state of one among many segments. Damping the whole step would hold
    back the coordinates of all for its sake; instead this state alone is searched for, the coordinates being as the
    step has them (variable projection: Golub and Pereyra, SIAM Journal on Numerical Analysis 10, 1973). Where joints
    stick, the state's step is shortened; with play, which begins and ends at other instants after the step, the search
    backtracks towards the state before.
    """
    multiple, predicted = point.problem.step_multiple, step.predicted_decreases
    short = _falling_short(point, step, trial)
    sticking = [k for k in short if trial.runs[k].arm.has_dry_friction]
    linearized = [point.linearizations[k] for k in sticking]
    trials, before = ([each.runs[k] for k in sticking] for each in (trial, point))
    trial = _with_runs(trial, sticking, best_damped(trials, before, linearized, step.change, multiple))
    playing = [k for k in short if is_nonsmooth(trial.runs[k].arm.effects) and k not in sticking]
    runs = backtrack([trial.runs[k] for k in playing], [step.own_changes[k] for k in playing], multiple)
    trial = _with_runs(trial, playing, runs)
    if point.cost - trial.cost >= step.predicted / 2:
        return trial
    # By a standard error of the state or more, where derivatives lead to the minimum.
    poor = [
        k
        for k in _falling_short(point, step, trial)
        if predicted[k] - (point.runs[k].cost - trial.runs[k].cost) > 1.0
        and is_followed([point.runs[k]])
        and k not in sticking
    ]
    # Where most fall short, the coordinates' step is wrong; but play's impacts upset the states of all recordings.
    if 2 * len(poor) > len(trial.runs) and not is_nonsmooth(point.problem.effects):
        return trial
    targets = [point.runs[k].cost - predicted[k] / 2 for k in poor]
    try:
        refined = refine_initial_states([trial.runs[k] for k in poor], targets, point.runs, multiple)
    except SimulationDivergedError:
        return trial
    return _with_runs(trial, poor, refined)


def _falling_short(point: Point, step: _TrajectoryStep, trial: Point) -> list[int]:
    """Return the recordings whose cost falls by less than half of the predicted decrease."""
    decreases = [before.cost - run.cost for before, run in zip(point.runs, trial.runs, strict=True)]
    pairs = zip(decreases, step.predicted_decreases, strict=True)
    return [k for k, (decrease, predicted) in enumerate(pairs) if decrease < predicted - abs(predicted) / 2]


def _with_runs(point: Point, indices: Sequence[int], runs: Sequence[Run]) -> Point:
    """Return the point with the runs of some recordings replaced."""
    replaced = dict(zip(indices, runs, strict=True))
    return replace(point, runs=tuple(replaced.get(k, run) for k, run in enumerate(point.runs)))
