"""Fits of models with effects: the coordinates of the chain and of the effects, all at once.

Maximum likelihood over whole trajectories, as in `vjm.identification.trajectory_fit`, whose coordinates are extended
by each effect's sizes (in units of typical magnitudes, zero where absent) and shape parameters (logarithms).
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
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.identification.uncertainty import Information, trajectory_information
from vjm.records import Array, Rig
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations, PrecedingMotion
from vjm.simulation.model import Model
from vjm.simulation.run import Run
from vjm.simulation.system import Trajectory

INCOMPLETE = 1.5  # RMS residual over noise from which a model certainly lacks something, misjudged noise or not
# Sizes that fits start from, in typical magnitudes.
_LARGEST_START = 5.0  # a linear guess beyond that is no guide
_SHARES = (1.0, 0.5, 0.25, 0.125)  # of a start that are tried as long as it cannot be simulated
LEAST_START = 0.5  # less friction, play or compliance of a joint does nothing that derivatives show
# Share of its motion that a swing leaves where its phase is off by phi, 2 sin(phi/2): up to this one (phi = 17 deg) it
# is linear in phi within 0.5 %, so that derivatives lead back.
_FOLLOWED = 0.3
_FEW = 4  # simulations by which initial states come near enough for a fit of all parameters
_FEW_STEPS = 3  # of all unknowns between searches for initial states, where slopes show little of these
_RESTARTS = (0.5, 2.0, 4.0)  # multiples of a joint's compliance or mass: of its frequency, half an octave or more
_RESTART_STEPS = 5  # after which a start that leads elsewhere shows
_MISSED = 1e-3  # significance level at which a recording is missed
_STUCK, _LITTLE = 5, 0.002  # accepted steps, and the share of chi^2 that they must gain for a fit to go on
_SLOW = 0.1  # share of what is missing, beside noise, that as many steps must gain: the rest takes ten times as many
_MARGIN = 0.1  # of a segment, simulated beyond its values: sensors that are early or late are so by less


class StoppingRule:
    """Stopping rule of a fit among several: it ends a fit that cannot become the best, or gains next to nothing.

    Args:
        record: chi^2 of the best so far; a fit whose next three steps would not come near it is given up, the next one
            being the best of them as long as the linearised problem is any guide.
        most: number of steps.
        deadline: reading of `time.monotonic` after which it ends every fit [s].
    """

    def __init__(self, record: float = np.inf, most: float = np.inf, deadline: float = np.inf) -> None:
        self.record, self.most, self.deadline = record, most, deadline
        self.steps = 0
        self.accepted: list[float] = []

    def __call__(self, point: Point, predicted: float) -> bool:
        """Return True to end the fit at a point, given the predicted decrease of chi^2 by its next step."""
        self.steps += 1
        if not self.accepted or point.chi2 != self.accepted[-1]:
            self.accepted.append(point.chi2)
        stuck = len(self.accepted) > _STUCK and self.accepted[-_STUCK] - point.chi2 < _least_gain(point)
        ended = self.steps > self.most or monotonic() > self.deadline
        return ended or stuck or point.chi2 - 3 * predicted > self.record


def _least_gain(point: Point) -> float:
    """Return the decrease of chi^2 that several steps must bring for a fit to go on."""
    return max(_LITTLE * point.chi2, _SLOW * (point.chi2 - point.expected_chi2))


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


def start_size(effect: Effect, guess: Array, chain: Chain) -> Effect:
    """Return an effect of a size from which a fit may start.

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
    for share in _SHARES:  # a linear guess may be far beyond what can be simulated
        sized = [effect if effect.key in known else effect.scaled(share) for effect in effects]
        problem = replace(start.point.problem, effects=tuple(sized))
        chain = start.point.x[: len(problem.parametrisation.coordinates)]
        x = np.clip(np.concatenate([chain, *(effect.coordinates for effect in sized)]), *problem.bounds)
        for step_multiple in dict.fromkeys((problem.step_multiple, 1.0)):
            problem = replace(problem, step_multiple=step_multiple)
            pairs = zip(start.point.runs, problem.arms(x), strict=True)
            states = [transfer_state(run.chain, arm.chain, run.state) for run, arm in pairs]
            try:
                return _minimum(problem, x, states, StoppingRule() if stop is None else stop)
            except (SimulationDivergedError, InsufficientDataError):
                continue
    return None


def restarted(fit: TrajectoryFit, deadline: float = np.inf) -> TrajectoryFit:
    """Fit a model again from other frequencies of its effects that are joints of their own; return the best fit.

    Such a joint vibrates, and where its frequency is wrong by a cycle over a segment there is another minimum. After
    the deadline, as of `StoppingRule`, what has been found is returned.
    """
    best = fit
    for effect, part in zip(fit.effects, fit.point.problem.parts, strict=True):
        if effect.nonsmooth or not effect.adds_joint(fit.point.problem.parametrisation.template):
            continue
        for factor in _RESTARTS:
            x = fit.point.x.copy()
            x[part] = np.clip(effect.with_softer_joint(factor).coordinates, *effect.bounds)
            try:
                trial = fit_trajectory(
                    fit.point.problem, x, None, fit.point.states, stop=StoppingRule(best.chi2, _RESTART_STEPS, deadline)
                )
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


def _minimum(problem: TrajectoryProblem, x: Array, states: Sequence[Array], stop: StoppingRule) -> TrajectoryFit:
    """Fit coordinates and initial states from (p,) and (2 nv,) each.

    Where something sticks or rattles, the likelihood of an initial state has many maxima, from which no slope leads
    away: after a few steps each recording that is missed is begun otherwise as well, as long as that helps.
    """
    if not is_nonsmooth(problem.effects) or stop.most < _FEW_STEPS:
        return fit_trajectory(problem, x, None, states, stop=stop)
    record, iterations = np.inf, 0  # slopes tell whether a record can be reached once the initial states are likely
    before = np.inf
    while True:
        fit = fit_trajectory(problem, x, None, states, stop=StoppingRule(record, _FEW_STEPS, stop.deadline))
        record, iterations = stop.record, iterations + fit.iterations
        point = replace(fit.point, runs=_multistart(fit.point))
        if before - point.chi2 < _least_gain(point) or monotonic() > stop.deadline:
            return replace(fit, point=point, iterations=iterations)
        before, x, states = point.chi2, point.x, point.states


def _multistart(point: Point) -> tuple[Run, ...]:
    """Return runs, those of missed segments from the best of their initial states and of others.

    These are rest of the active joints, the state in which the segment before ends, or rest of the whole arm, and what
    effects propose.
    """
    best, trials = [*point.runs], []
    # Where the parameters are wrong most segments are missed, and no start of theirs leads out of that.
    usual = max(1.0, float(np.quantile([run.chi2 / max(run.expected_chi2, 1) for run in point.runs], 0.25)))
    for k, run in enumerate(point.runs):
        if run.chi2 < usual * stats.chi2.isf(_MISSED, run.expected_chi2):
            continue
        resting, before = run.state.copy(), _before(point.runs, run.observed)
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
            [arms[k] for k in indices], [observed[k] for k in indices], states, point.problem.step_multiple, most=_FEW
        )
    except SimulationDivergedError:
        return point.runs
    for k, (run, _) in zip(indices, likely, strict=True):
        best[k] = min(best[k], run, key=lambda run: run.cost)
    return tuple(best)


def cut(fit: TrajectoryFit, whole: Sequence[Observations], duration: float, stop: StoppingRule) -> TrajectoryFit:
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
    found = _minimum(problem, fit.point.x, states, stop)
    # What was estimated last is remembered by effects that are fitted from here.
    observed = _with_preceding_motion([run.observed for run in found.point.runs], found.point.runs)
    runs = [replace(run, observed=part) for run, part in zip(found.point.runs, observed, strict=True)]
    problem = replace(problem, observed=tuple(observed))
    return replace(found, point=Point(problem, found.point.x, tuple(runs)), shift=fit.shift)


def _initial_states(problem: TrajectoryProblem, x: Array, states: Sequence[Array]) -> list[Array]:
    """Return likely initial states (2 nv,) of segments, from those of whole recordings there, or from rest.

    The simulation of a whole recording may be anywhere where a segment of it begins.
    """
    arms, observed = problem.arms(x), problem.observed
    runs = [run for run, _ in fit_initial_states(arms, observed, states, problem.step_multiple, most=_FEW)]
    lost = [k for k, run in enumerate(runs) if not is_followed([run])]
    if lost:
        resting = fit_initial_states(
            [arms[k] for k in lost], [observed[k] for k in lost], None, problem.step_multiple, most=2 * _FEW
        )
        for k, (run, _) in zip(lost, resting, strict=True):
            runs[k] = min(runs[k], run, key=lambda run: run.cost)
    return [run.state for run in runs]


def is_followed(runs: Sequence[Run]) -> bool:
    """Return True if simulations of parts of a recording follow its motion, so that slopes tell what they lack."""
    missed = sum(run.chi2 - run.expected_chi2 for run in runs)
    moved = sum(run.observed.motion for run in runs)
    return all(run.observed.recording.kind == "quiet" for run in runs) or missed <= _FOLLOWED**2 * moved


def segments(observed: Observations, duration: float) -> tuple[Observations, ...]:
    """Return a recording's parts of a duration [s].

    A quiet one of a clamped arm stays whole: nothing gets out of phase in it. A joint that is held where the model
    knows of no load turns ever faster in its simulations.
    """
    held = observed.recording.kind == "quiet" and not observed.recording.theta.shape[1]
    if held or not np.isfinite(duration):
        return (observed,)
    return observed.segments(duration, _MARGIN * duration)


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
    """Trajectories one after another, each up to where the next begins."""
    ends = [*(float(path.time[0]) for path in paths[1:]), np.inf]
    shown = [(path, path.time < end) for path, end in zip(paths, ends, strict=True)]
    time = np.concatenate([path.elapsed(path.time)[own] for path, own in shown])
    q, v = (np.concatenate([getattr(path, name)[own] for path, own in shown]) for name in ("q", "v"))
    return PrecedingMotion(chain, time, q, v)


def _before(runs: Sequence[Run], observed: Observations) -> list[Run]:
    """Return the simulations of the same recording that begin earlier than a part of it."""
    own = [run for run in runs if run.observed.recording.file == observed.recording.file]
    return [run for run in own if run.trajectory.time[0] < observed.recording.time[0]]


def state_at(runs: Sequence[Run], observed: Observations) -> Array:
    """Return the state (2 nv,) at which an observation begins, from the simulations of the same recording."""
    instant = observed.recording.time[:1]
    paths = [run.trajectory for run in runs if run.observed.recording.file == observed.recording.file]
    begun = [path for path in paths if path.time[0] <= instant[0]]
    path = max(begun, key=lambda path: float(path.time[0]), default=paths[0])
    return np.concatenate([values[0] for values in path.sample(instant)])
