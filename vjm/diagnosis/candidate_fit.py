"""Fits of models with effects: the coordinates of the chain and of the effects, all at once.

Maximum likelihood over whole trajectories, as in `vjm.identification.trajectory_fit`, whose coordinates are extended
by each effect's sizes (in units of typical magnitudes, zero where absent) and shape parameters (logarithms, or linear
where they may be zero).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from time import monotonic

import numpy as np
from scipy import stats

from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.check import estimates
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory, stays_above
from vjm.identification.trajectory_method import search_step_multiple
from vjm.identification.uncertainty import Information, trajectory_information
from vjm.records import NOT_NOISE, Array, Rig
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations, PrecedingMotion
from vjm.simulation.model import Model
from vjm.simulation.run import Run, earlier_runs, is_followed, state_at
from vjm.simulation.system import Trajectory

INCOMPLETE_MISFIT = 1.5  # RMS residual over noise from which a model certainly lacks something, misjudged noise or not
# Sizes that fits start from, in typical magnitudes.
_LARGEST_START = 5.0  # a linear guess beyond that is no guide
LEAST_START = 0.5  # less friction, play or compliance of a joint does nothing that derivatives show
_ITERATIONS = 4  # by which initial states come near enough for a fit of all parameters
_FEW_STEPS = 3  # of all unknowns between searches for initial states, where slopes show little of these


class StoppingRule:
    """Stopping rule of a fit among several: it ends a fit that cannot become the best, or gains next to nothing.

    Args:
        max_chi2: chi^2 above which a fit is of no use, such as that of the best one so far: it is given up where three
            decreases as large as its next step promises would leave it above.
        max_steps: number of steps at most.
        deadline: reading of `time.monotonic` after which it ends every fit [s].
    """

    def __init__(self, max_chi2: float = np.inf, max_steps: float = np.inf, deadline: float = np.inf) -> None:
        self.max_chi2, self.max_steps, self.deadline = max_chi2, max_steps, deadline
        self.steps = 0
        self.accepted: list[float] = []

    def __call__(self, point: Point, predicted: float) -> bool:
        """Return True to end the fit at a point, given the predicted decrease of chi^2 by its next step."""
        self.steps += 1
        if not self.accepted or point.chi2 != self.accepted[-1]:
            self.accepted.append(point.chi2)
        stuck = len(self.accepted) > 5 and self.accepted[-5] - point.chi2 < _least_decrease(point)
        ended = self.steps > self.max_steps or monotonic() > self.deadline
        return ended or stuck or stays_above(point, predicted, self.max_chi2)


def _least_decrease(point: Point) -> float:
    """Return the decrease of chi^2 that five accepted steps must bring for a fit to go on.

    It is less than what matters (`SearchOptions.least_share`), or a tenth of what exceeds noise, whose rest would take
    ten times as many steps.
    """
    return max(0.002 * point.chi2, 0.1 * (point.chi2 - point.expected_chi2))


@lru_cache(maxsize=4)
def information_of(fit: TrajectoryFit) -> Information:
    """Return the Fisher information of a fit's coordinates, and the covariance of their scores; remember the last."""
    return trajectory_information(fit, True)[0]


def model_of(fit: TrajectoryFit, rig: Rig, noise: tuple[float, float]) -> Model:
    """Return the model of a fit with the estimates of its chain's parameters, for a rig and its noise [m, rad]."""
    parametrisation, information = fit.point.problem.parametrisation, information_of(fit)
    own = slice(len(parametrisation.coordinates))
    estimate, scores = fit.estimate[own], information.score_covariance[own, own]
    kept = Information(information.normal[own, own], scores)
    physical = parametrisation.physical_covariance(estimate, information.covariance[own, own])
    parameters = estimates(parametrisation, estimate, kept, physical)
    chain = parametrisation.chain(fit.point.x[own])
    return Model(chain, rig, *noise, parameters, fit.effects, fit.point.problem.reference_effects)


def starting_effect(effect: Effect, guess: Array, chain: Chain) -> Effect:
    """Return an effect with magnitudes from which a fit may start.

    Args:
        effect: with its shape parameters.
        guess: (s,) sizes by a screen, in typical magnitudes.
        chain: to which it is added.
    """
    coordinates = effect.coordinates
    least = LEAST_START if effect.nonsmooth or effect.adds_joint(chain) else -_LARGEST_START
    coordinates[: effect.magnitude_count] = np.clip(guess, least, _LARGEST_START)
    return effect.at(np.clip(coordinates, *effect.bounds))


def refit(start: TrajectoryFit, effects: Sequence[Effect], stop: StoppingRule | None = None) -> TrajectoryFit | None:
    """Fit a model with other effects to the same recordings, from a fit with some of them or with none.

    Args:
        start: where to begin.
        effects: those wanted, with the parameters from which their search starts.
        stop: ends the search; None: as by default.

    Returns:
        The fit; None where it cannot be simulated.
    """
    known = {effect.key for effect in start.effects}
    for share in (1.0, 0.5, 0.25, 0.125):  # a linear guess may be far beyond what can be simulated
        sized = [effect if effect.key in known else effect.scaled(share) for effect in effects]
        problem = replace(start.point.problem, effects=tuple(sized))
        chain = start.point.x[: len(problem.parametrisation.coordinates)]
        x = np.clip(np.concatenate([chain, *(effect.coordinates for effect in sized)]), *problem.bounds)
        for step_multiple in dict.fromkeys((problem.step_multiple, 1.0)):
            problem = replace(problem, step_multiple=step_multiple)
            pairs = zip(start.point.runs, problem.arms(x), strict=True)
            states = [transfer_state(run.chain, arm.chain, run.state) for run, arm in pairs]
            try:
                return _fit_accurately(problem, x, states, StoppingRule() if stop is None else stop)
            except (SimulationDivergedError, InsufficientDataError):
                continue
    return None


def refit_other_frequencies(fit: TrajectoryFit, deadline: float = np.inf) -> TrajectoryFit:
    """Fit a model again from other frequencies of those of its effects that add a joint; return the best fit.

    Such a joint vibrates, and where its frequency is wrong by a cycle over a segment there is another minimum. After
    the deadline, as of `StoppingRule`, the best fit so far is returned.
    """
    best = fit
    for effect, part in zip(fit.effects, fit.point.problem.parts, strict=True):
        if effect.nonsmooth or not effect.adds_joint(fit.point.problem.parametrisation.template):
            continue
        for factor in (0.5, 2.0, 4.0):  # of its compliance or mass: half an octave or more of its frequency
            x = fit.point.x.copy()
            x[part] = np.clip(effect.with_softer_joint(factor).coordinates, *effect.bounds)
            try:
                few = StoppingRule(best.chi2, 5, deadline)  # steps, after which a start that leads elsewhere shows
                trial = fit_trajectory(fit.point.problem, x, None, fit.point.states, stop=few)
                if trial.chi2 < best.chi2:
                    best = fit_trajectory(
                        trial.point.problem,
                        trial.point.x,
                        None,
                        trial.point.states,
                        stop=StoppingRule(deadline=deadline),
                    )
            except (SimulationDivergedError, InsufficientDataError):
                continue
    return best


def _fit_accurately(problem: TrajectoryProblem, x: Array, states: Sequence[Array], stop: StoppingRule) -> TrajectoryFit:
    """Fit as `_fit_multistart`, with steps so short that their error is of no account beside what the fit leaves.

    Those that will do beside what a model lacks may be too long once the cause is in it. Only those of an elbow's
    swing are so many that it pays to begin with long ones.
    """
    fit = _fit_multistart(problem, x, states, stop)
    while problem.parametrisation.template.elbows.size and not is_nonsmooth(problem.effects):
        multiple = problem.step_multiple
        if multiple == 1.0 or fit.chi2 > stop.max_chi2 or monotonic() > stop.deadline:
            break
        problem = replace(problem, step_multiple=search_step_multiple(fit.point, most=multiple))
        if problem.step_multiple == multiple:
            break
        further = _fit_multistart(problem, fit.point.x, fit.point.states, stop)
        fit = replace(further, iterations=fit.iterations + further.iterations)
    return fit


def _fit_multistart(problem: TrajectoryProblem, x: Array, states: Sequence[Array], stop: StoppingRule) -> TrajectoryFit:
    """Fit coordinates and initial states from (p,) and (2 nv,) each, some initial states from several starts.

    The likelihood of a segment's initial state may have several maxima, from which no slope leads away: those that are
    missed, where most are not, are begun otherwise as well, as long as that helps. Where something sticks or rattles
    there are many: this is done after a few steps already.
    """
    nonsmooth = is_nonsmooth(problem.effects)
    if stop.max_steps < _FEW_STEPS:
        return fit_trajectory(problem, x, None, states, stop=stop)
    before, iterations = np.inf, 0
    # Not at first where states are unlikely: slopes do not show then what can be reached.
    max_chi2, steps = (np.inf, _FEW_STEPS) if nonsmooth else (stop.max_chi2, stop.max_steps)
    while True:
        fit = fit_trajectory(problem, x, None, states, stop=StoppingRule(max_chi2, steps, stop.deadline))
        iterations += fit.iterations
        max_chi2 = stop.max_chi2
        if not nonsmooth and fit.chi2 > stop.max_chi2:
            return replace(fit, iterations=iterations)
        point = replace(fit.point, runs=_multistart(fit.point))
        gained = before - point.chi2 if nonsmooth else fit.chi2 - point.chi2
        if gained < _least_decrease(point) or monotonic() > stop.deadline:
            return replace(fit, point=point, iterations=iterations)
        before, x, states = point.chi2, point.x, point.states


def _multistart(point: Point) -> tuple[Run, ...]:
    """Return runs, those of missed segments from the best of several initial states.

    These are their own; the same with the active joints at rest; the state in which the segment before ends or, for the
    first one, rest of the whole arm; and those that effects propose.
    """
    best, trials = [*point.runs], []
    # With wrong parameters most segments are missed, whatever their initial states: the best quarter is the measure.
    usual = max(1.0, float(np.quantile([run.chi2 / max(run.expected_chi2, 1) for run in point.runs], 0.25)))
    missed = [k for k, run in enumerate(point.runs) if run.chi2 > usual * stats.chi2.isf(NOT_NOISE, run.expected_chi2)]
    if not is_nonsmooth(point.problem.effects) and 2 * len(missed) > len(point.runs):
        return point.runs  # what is missing is in the model, not in initial states
    for k in missed:
        run = point.runs[k]
        resting, before = run.state.copy(), earlier_runs(point.runs, run.observed)
        resting[run.chain.size + run.chain.active] = 0.0
        previous = state_at(before, run.observed) if before else run.prior.rest
        trials += [(k, resting), (k, previous)]
        for effect in run.arm.effects:
            trials += [(k, state) for known in (run.state, previous) for state in effect.other_states(run.chain, known)]
    if not trials:
        return point.runs
    arms, observed = point.problem.arms(point.x), point.problem.observed
    indices, states = [k for k, _ in trials], [state for _, state in trials]
    try:
        likely = fit_initial_states(
            [arms[k] for k in indices],
            [observed[k] for k in indices],
            states,
            point.problem.step_multiple,
            most=_ITERATIONS,
        )
    except SimulationDivergedError:
        return point.runs
    for k, (run, _) in zip(indices, likely, strict=True):
        best[k] = min(best[k], run, key=lambda run: run.cost)
    return tuple(best)


def fit_segments(
    fit: TrajectoryFit, whole: Sequence[Observations], duration: float, stop: StoppingRule
) -> TrajectoryFit:
    """Fit a model to the segments of recordings, each with an initial state of its own (multiple shooting).

    Over a segment of one or two periods nothing is lost in phase, whatever the model lacks, so that slopes guide from
    far away (Bock, Recent advances in parameter identification techniques for O.D.E., 1983; Ribeiro et al.,
    Automatica 121, 2020). Segments show less of frequencies than whole recordings do.

    Args:
        fit: to other segments of the same recordings, or to the recordings.
        whole: the recordings.
        duration: of a segment [s]; infinite: the recordings themselves.
        stop: ends the fit.

    Raises:
        SimulationDivergedError, InsufficientDataError: the model cannot be simulated.
    """
    observed = [part for one in whole for part in segments(one, duration)]
    if len(fit.point.runs) != len(whole):
        observed = _with_preceding_motion(observed, fit.point.runs)
    problem = replace(fit.point.problem, observed=tuple(observed))
    states = [state_at(fit.point.runs, part) for part in observed]
    if len(fit.point.runs) == len(whole):
        states = _initial_states(problem, fit.point.x, states)
    found = _fit_accurately(problem, fit.point.x, states, stop)
    # Effects with memory, fitted from here, start each segment after the motion that was estimated last.
    observed = _with_preceding_motion([run.observed for run in found.point.runs], found.point.runs)
    runs = [replace(run, observed=part) for run, part in zip(found.point.runs, observed, strict=True)]
    problem = replace(problem, observed=tuple(observed))
    return replace(found, point=Point(problem, found.point.x, tuple(runs)), shift=fit.shift)


def _initial_states(problem: TrajectoryProblem, x: Array, states: Sequence[Array]) -> list[Array]:
    """Return likely initial states (2 nv,) of segments, from those of whole recordings there, or from rest.

    The simulation of a whole recording may be anywhere where a segment of it begins.
    """
    arms, observed = problem.arms(x), problem.observed
    runs = [run for run, _ in fit_initial_states(arms, observed, states, problem.step_multiple, most=_ITERATIONS)]
    missed = [k for k, run in enumerate(runs) if not is_followed([run])]
    if missed:
        resting = fit_initial_states(
            [arms[k] for k in missed],
            [observed[k] for k in missed],
            None,
            problem.step_multiple,
            most=2 * _ITERATIONS,
        )
        for k, (run, _) in zip(missed, resting, strict=True):
            runs[k] = min(runs[k], run, key=lambda run: run.cost)
    return [run.state for run in runs]


def segments(observed: Observations, duration: float) -> tuple[Observations, ...]:
    """Return a recording's parts of a duration [s].

    A quiet one of a clamped arm stays whole: nothing gets out of phase in it. A joint that is held where the model
    knows of no load turns ever faster in its simulations.
    """
    held = observed.recording.kind == "quiet" and not observed.recording.theta.shape[1]
    if held or not np.isfinite(duration):
        return (observed,)
    return observed.segments(duration, 0.1 * duration)  # simulated beyond its values, for sensors early or late


def _with_preceding_motion(observed: Sequence[Observations], runs: Sequence[Run]) -> list[Observations]:
    """Return segments with the motion of their recordings, as last simulated from one segment to the next."""
    parts: dict[str, list[Run]] = {}
    for run in sorted(runs, key=lambda run: float(run.trajectory.time[0])):
        parts.setdefault(run.observed.recording.file, []).append(run)
    motions = {file: _joined([run.trajectory for run in own], own[0].chain) for file, own in parts.items()}
    return [
        replace(part, preceding=motions[part.recording.file]) if part.start is not None else part for part in observed
    ]


def _joined(paths: Sequence[Trajectory], chain: Chain) -> PrecedingMotion:
    """Join trajectories, each up to where the next begins."""
    ends = [*(float(path.time[0]) for path in paths[1:]), np.inf]
    shown = [(path, path.time < end) for path, end in zip(paths, ends, strict=True)]
    time = np.concatenate([path.elapsed(path.time)[own] for path, own in shown])
    q, v = (np.concatenate([getattr(path, name)[own] for path, own in shown]) for name in ("q", "v"))
    return PrecedingMotion(chain, time, q, v)
