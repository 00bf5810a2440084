"""Maximum-likelihood fits of models with effects, to recordings or to their segments (multiple shooting).

Chain, effects and initial states are fitted together, as in `vjm.identification.trajectory_fit`. The coordinates of an
effect are its magnitudes in units of typical ones, zero where it is absent, and its shape parameters: logarithms, or
linear where they may be zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from time import monotonic

import numpy as np
from scipy import stats

from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.check import estimates
from vjm.identification.discretization import with_offset
from vjm.identification.parameters import at_bounds
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory, stays_above
from vjm.identification.trajectory_method import hides_fast_modes, search_step_multiple
from vjm.identification.uncertainty import Information, trajectory_information
from vjm.records import NOT_NOISE, Array, Rig
from vjm.simulation.initial_state import FEW_TRIALS, best_of_starts, damped_states, fit_initial_states
from vjm.simulation.model import Model
from vjm.simulation.run import Run, earlier_runs, is_followed, linearize_by_states, state_at

INCOMPLETE_MISFIT = 1.5  # RMS residual over noise from which a model certainly lacks something, misjudged noise or not
LEAST_SHARE = 0.0025  # of chi^2: what an effect explains from which it matters (`SearchOptions.least_share`)
# Bounds of the starting values of effects' sizes, in typical magnitudes.
_LARGEST_START = 5.0  # a linear estimate beyond that is far outside the range where the effect is linear
LEAST_START = 0.5  # for friction, play and joint compliance, whose derivatives vanish or are misleading near zero
_STEPS_BETWEEN_MULTISTARTS = 3  # where stick-slip or play gives initial states many maxima


@dataclass(frozen=True)
class SearchOptions:
    """Options of a search.

    Attributes:
        alpha: significance level of the search as a whole.
        least_share: decrease of chi^2 from which an effect matters, as a share of the chi^2 that remains.
        parameter_share: relative penalty of chi^2 for each free parameter of the effects, as of `criterion`.
        max_effects: number of effects at most.
        seed: of random numbers.
        deadline: reading of `time.monotonic` after which nothing more is fitted [s].
    """

    alpha: float = 0.01
    least_share: float = LEAST_SHARE
    parameter_share: float = 0.0
    max_effects: int = 3
    seed: int = 0
    deadline: float = np.inf

    def criterion(self, fit: TrajectoryFit) -> float:
        """Return chi^2 of a model, larger for each free parameter of its effects: rivals are ranked by it."""
        parameters = int(np.sum(~fit.point.held[len(fit.point.problem.parametrisation.coordinates) :]))
        return fit.chi2 * (1 + self.parameter_share) ** parameters

    def negligible(self, chi2: float) -> float:
        """Return the decrease of a chi^2 from which an effect matters: a share of what remains after it."""
        return chi2 * self.least_share / (1 + self.least_share)


class StoppingRule:
    """Stopping rule for one of several rival fits: ends it if it cannot become the best, or hardly improves.

    Args:
        max_chi2: chi^2 above which a fit is of no use, such as that of the best one so far: the fit ends where three
            times the decrease predicted for its next step would leave it above. With stick-slip or play, which make
            promises that no step keeps, it is what the last step has brought, if that is less.
        max_steps: number of steps at most.
        deadline: reading of `time.monotonic` [s] after which every fit ends.
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
        stuck = len(self.accepted) > 5 and self.accepted[-5] - point.chi2 < _stall_decrease(point)
        ended = self.steps > self.max_steps or monotonic() > self.deadline
        if is_nonsmooth(point.problem.effects) and len(self.accepted) > 1:
            predicted = min(predicted, self.accepted[-2] - point.chi2)
        return ended or stuck or stays_above(point, predicted, self.max_chi2)


def _stall_decrease(point: Point) -> float:
    """Return the decrease of chi^2 that four accepted steps must bring for a fit to go on.

    The first bound is just below the decrease from which an effect matters. The second is a tenth of the excess over
    noise: at that rate the fit would need ten times as many steps to come down to noise.
    """
    return max(0.8 * LEAST_SHARE * point.chi2, 0.1 * (point.chi2 - point.expected_chi2))


@lru_cache(maxsize=4)
def information_of(fit: TrajectoryFit) -> Information:
    """Return the Fisher information of a fit's coordinates with the covariance of their scores; cached.

    Where the correction for the discretization has led a coordinate off a bound, or to one, it is that at the estimate,
    with the residuals of the fit. It stays that of the fit if the estimate cannot be simulated.
    """
    point, estimate = fit.point, fit.estimate
    if (at_bounds(estimate, point.problem.bounds) != point.held).any():
        try:
            moved = with_offset(point, None).problem.point(estimate, point.states)
        except SimulationDivergedError:
            moved = point
        pairs = zip(point.runs, moved.runs, strict=True)
        differences = [before.predicted - after.predicted for before, after in pairs]
        offsets = [run.observed.discretization_offset for run in point.runs]
        residual = [
            change if known is None else known + change for known, change in zip(offsets, differences, strict=True)
        ]
        fit = replace(fit, point=with_offset(moved, residual))
    return trajectory_information(fit, True)[0]


def predicted_increase(fit: TrajectoryFit, effect: Effect) -> float:
    """Return the increase of chi^2 without one of a model's effects, by its linear model with all else refitted."""
    sizes, R = fit.sizes_of(effect), fit.point.reduced()[0].R[:, :-1]
    remaining = [k for k in np.flatnonzero(~fit.point.held).tolist() if k not in sizes]
    reduced = np.asarray(np.linalg.qr(R[:, [*remaining, *sizes]], mode="r"))[len(remaining) :, len(remaining) :]
    return float(np.sum((reduced @ fit.point.x[sizes]) ** 2))


def model_of(fit: TrajectoryFit, rig: Rig, noise: tuple[float, float]) -> Model:
    """Return a fit's model with the estimates of its chain's parameters, for a rig and its noise [m, rad]."""
    parametrisation, information = fit.point.problem.parametrisation, information_of(fit)
    chain_part = slice(len(parametrisation.coordinates))
    estimate, scores = fit.estimate[chain_part], information.score_covariance[chain_part, chain_part]
    chain_information = Information(information.normal[chain_part, chain_part], scores, information.held[chain_part])
    physical = parametrisation.physical_covariance(estimate, information.covariance[chain_part, chain_part])
    parameters = estimates(parametrisation, estimate, chain_information, physical)
    return Model(fit.point.chain, rig, *noise, parameters, fit.effects, fit.point.problem.reference_effects)


def starting_effect(effect: Effect, guess: Array, chain: Chain) -> Effect:
    """Return an effect with starting values for a fit.

    Args:
        effect: the effect, with its shape parameters.
        guess: (s,) sizes estimated by a screen, in typical magnitudes.
        chain: the chain to which it is added.
    """
    coordinates = effect.coordinates
    lower = LEAST_START if effect.nonsmooth or effect.adds_joint(chain) else -_LARGEST_START
    coordinates[: effect.magnitude_count] = np.clip(guess, lower, _LARGEST_START)
    return effect.at(np.clip(coordinates, *effect.bounds))


def refit(
    start: TrajectoryFit, effects: Sequence[Effect], stop: StoppingRule | None = None, states_first: bool = False
) -> TrajectoryFit | None:
    """Refit a model with other effects to the same recordings, starting from a fit with some of them or none.

    Args:
        start: the fit to start from.
        effects: all effects of the model, with starting values of their parameters.
        stop: stopping rule; None: `StoppingRule()`.
        states_first: True to estimate initial states at the starting values before all parameters are fitted.

    Returns:
        The fit; None if the model cannot be simulated, not even with new effects of an eighth of their size.
    """
    known = {effect.key for effect in start.effects}
    stop = StoppingRule() if stop is None else stop
    for share in (1.0, 0.5, 0.25, 0.125):  # a linear estimate may be too large to be simulated
        sized = [effect if effect.key in known else effect.scaled(share) for effect in effects]
        problem = replace(start.point.problem, effects=tuple(sized))
        chain = start.point.x[: len(problem.parametrisation.coordinates)]
        x = np.clip(np.concatenate([chain, *(effect.coordinates for effect in sized)]), *problem.bounds)
        # Longer steps than the default have been found short enough without an added joint, which may vibrate fast.
        # With elbows they are shortened as the fit improves.
        template = problem.parametrisation.template
        smooth = [effect for effect in sized if not effect.nonsmooth]  # play has short steps of its own
        added = not template.elbows.size and any(effect.adds_joint(template) for effect in smooth)
        for step_multiple in dict.fromkeys((1.0 if added else problem.step_multiple, 1.0)):
            problem = replace(problem, step_multiple=step_multiple)
            pairs = zip(start.point.runs, problem.arms(x), strict=True)
            states = [transfer_state(run.chain, arm.chain, run.state) for run, arm in pairs]
            try:
                if states_first:
                    states = [run.state for run in likely_runs(problem, x, states, stop.deadline)]
                fit = fit_accurately(problem, x, states, stop)
                # Beside the discretization error, a new effect is as beside a beam; without it, all are biased anew.
                corrected = all(run.observed.discretization_offset is not None for run in fit.point.runs)
                return replace(fit, shift=transferred_shift(start, fit) if corrected else None)
            except (SimulationDivergedError, InsufficientDataError):
                continue
    return None


def refit_within_bounds(
    start: TrajectoryFit, deadline: float, max_chi2: float, effects: Sequence[Effect]
) -> TrajectoryFit | None:
    """Refit a model with other effects; None where it cannot be simulated, or only with an effect at its bounds.

    One of several sizes may be there, such as gravity along a clamped link, which its motion hardly shows: it stands in
    for what further effects explain, and the others are estimates.

    A model with stick-slip or play as well that fits no better than the one without was thrown off by its first step,
    which was to correct initial states that suit a motion without them: the states are then estimated first.
    """
    fit = refit(start, effects, StoppingRule(max_chi2, deadline=deadline))
    added = {effect.key: effect.nonsmooth for effect in effects if effect.key not in start.effect_keys}
    nested = len(added) == len(effects) - len(start.effects)
    worse = fit is None or fit.chi2 >= start.chi2
    if worse and nested and any(added.values()) and max_chi2 > start.chi2 and monotonic() <= deadline:
        retried = refit(start, effects, StoppingRule(max_chi2, deadline=deadline), states_first=True)
        fit = min(filter(None, (fit, retried)), key=lambda fit: fit.chi2, default=None)
    return None if fit is None or any(all(effect.at_bounds) for effect in fit.new_effects) else fit


def transferred_shift(start: TrajectoryFit, fit: TrajectoryFit) -> Array | None:
    """Return a model's discretization shift (p,) by that of one with other effects: zero for new effects.

    None where it is not known, or is in other coordinates, since an effect was recentred.
    """
    if start.shift is None:
        return None
    shift, count = np.zeros(fit.point.x.size), len(fit.point.problem.parametrisation.coordinates)
    shift[:count] = start.shift[:count]
    before = {effect.key: effect for effect in start.effects}
    for effect, part in zip(fit.effects, fit.point.problem.parts, strict=True):
        if effect.key in before:
            shifted = start.part_of(before[effect.key])
            if effect.at(start.point.x[shifted]) != before[effect.key]:
                return None
            shift[part] = start.shift[shifted]
    return shift


def continued(fit: TrajectoryFit, deadline: float) -> TrajectoryFit:
    """Continue a fit that was stopped early until it has converged, if that lowers chi^2.

    After the deadline, as of `StoppingRule`, it ends where it stands.
    """
    sticking = any(run.arm.has_dry_friction for run in fit.point.runs)
    if sticking or not fit.converged:
        fit = _better_from(fit.point, fit, deadline)
    if sticking and monotonic() <= deadline:
        beyond = _multistart(fit.point, only_at_kinks=True, deadline=deadline)
        fit = _better_from(replace(fit.point, runs=beyond), fit, deadline)
    return fit


def _better_from(start: Point, fit: TrajectoryFit, deadline: float) -> TrajectoryFit:
    """Return the fit that a start leads to, if its chi^2 is lower than that of a fit; else the latter."""
    try:
        further = fit_trajectory(start.problem, start.x, None, start.states, stop=lambda *_: monotonic() > deadline)
    except (SimulationDivergedError, InsufficientDataError):
        return fit
    return replace(further, shift=fit.shift) if further.chi2 < fit.chi2 else fit


def refit_other_frequencies(fit: TrajectoryFit, deadline: float = np.inf) -> TrajectoryFit:
    """Refit a model from other compliances of the joints that its effects add (multistart); return the best fit.

    Such a joint vibrates, and each cycle by which its frequency is off over a segment has a local minimum. After the
    deadline, as of `StoppingRule`, the best fit so far is returned.
    """
    best = fit
    for effect, part in zip(fit.effects, fit.point.problem.parts, strict=True):
        if effect.nonsmooth or not effect.adds_joint(fit.point.problem.parametrisation.template):
            continue
        for factor in (0.5, 2.0, 4.0):  # of its compliance or mass: half an octave or more of its frequency
            x = fit.point.x.copy()
            x[part] = np.clip(effect.with_softer_joint(factor).coordinates, *effect.bounds)
            try:
                short = StoppingRule(best.chi2, 5, deadline)  # five steps show if a start leads to a better minimum
                trial = fit_trajectory(fit.point.problem, x, None, fit.point.states, stop=short)
                if trial.chi2 < best.chi2:
                    further = StoppingRule(deadline=deadline)
                    best = fit_trajectory(trial.point.problem, trial.point.x, None, trial.point.states, stop=further)
                    best = replace(best, shift=fit.shift)
            except (SimulationDivergedError, InsufficientDataError):
                continue
    return best


def fit_accurately(problem: TrajectoryProblem, x: Array, states: Sequence[Array], stop: StoppingRule) -> TrajectoryFit:
    """Fit as `_fit_recentred`, and again with shorter integrator steps where these were too long.

    Steps that are accurate enough beside the residual of a poor fit may be too long once the fit is good: they hide
    fast modes of a decay. With elbows they are shortened until their error is negligible; only these arms take so many
    steps that it pays to begin with long ones.
    """
    fit = _fit_recentred(problem, x, states, stop)
    while fit.chi2 <= stop.max_chi2 and monotonic() <= stop.deadline:
        multiple = _needed_step_multiple(fit)
        if multiple == fit.point.problem.step_multiple:
            break
        shorter = replace(fit.point.problem, step_multiple=multiple)
        fit = _fit_recentred(shorter, fit.point.x, fit.point.states, stop)
    return fit


def _needed_step_multiple(fit: TrajectoryFit) -> float:
    """Return the multiple of the integrator's default step, at most the fit's own, that its residual allows."""
    problem = fit.point.problem
    if is_nonsmooth(problem.effects) or problem.step_multiple == 1.0:
        return problem.step_multiple
    if problem.parametrisation.template.elbows.size:
        return search_step_multiple(fit.point, largest=problem.step_multiple)
    return 1.0 if hides_fast_modes(fit, INCOMPLETE_MISFIT) else problem.step_multiple


def _fit_recentred(problem: TrajectoryProblem, x: Array, states: Sequence[Array], stop: StoppingRule) -> TrajectoryFit:
    """Fit as `_fit_multistart`, and again in other coordinates where effects end too far from the origin of theirs."""
    fit = _fit_multistart(problem, x, states, stop)
    while True:
        effects = tuple(effect.recentred() for effect in fit.effects)
        if all(recentred is original for recentred, original in zip(effects, fit.effects, strict=True)):
            return fit
        problem = replace(problem, effects=effects)
        chain = fit.point.x[: len(problem.parametrisation.coordinates)]
        x = np.concatenate([chain, *(effect.coordinates for effect in effects)])
        fit = _fit_multistart(problem, x, fit.point.states, stop)


def _fit_multistart(problem: TrajectoryProblem, x: Array, states: Sequence[Array], stop: StoppingRule) -> TrajectoryFit:
    """Fit coordinates x (p,) and initial states (2 nv,), alternating with a multistart of poorly fitted segments.

    The likelihood of a segment's initial state may have several local maxima. Segments that fit poorly where most fit
    well are started again from other initial states, as long as that lowers chi^2. With stick-slip or play there are
    many maxima: the multistart follows every few steps, not only the converged fit. There is none where the number of
    steps is limited.
    """
    nonsmooth = is_nonsmooth(problem.effects)
    if np.isfinite(stop.max_steps):
        return fit_trajectory(problem, x, None, states, stop=stop)
    before = np.inf
    # With stick-slip or play the first steps are not stopped by `max_chi2`: before the first multistart, the predicted
    # decrease does not tell what chi^2 can be reached.
    max_chi2, steps = (np.inf, _STEPS_BETWEEN_MULTISTARTS) if nonsmooth else (stop.max_chi2, np.inf)
    while True:
        fit = fit_trajectory(problem, x, None, states, stop=StoppingRule(max_chi2, steps, stop.deadline))
        max_chi2 = stop.max_chi2
        if (not nonsmooth and fit.chi2 > stop.max_chi2) or monotonic() > stop.deadline:
            return fit
        # The last multistart was at nearly the same coordinates where the steps since then have hardly gained.
        repeated = nonsmooth and before - fit.chi2 < _stall_decrease(fit.point)
        point = replace(fit.point, runs=_multistart(fit.point, repeated, stop.deadline))
        gained = before - point.chi2 if nonsmooth else fit.chi2 - point.chi2
        hopeless = stays_above(point, gained, stop.max_chi2)  # as each round of steps and multistart gains less
        if gained < _stall_decrease(point) or hopeless:
            return replace(fit, point=point)
        before, x, states = point.chi2, point.x, point.states


def _multistart(point: Point, only_at_kinks: bool = False, deadline: float = np.inf) -> tuple[Run, ...]:
    """Return a point's runs, those of poorly fitted segments from the best of several initial states.

    Tried are the present state; the same with the active joints at rest; the final state of the preceding segment or,
    for the first one, the arm at rest; and states that effects propose, such as either flank of a play. Where a joint
    only just sticks the likelihood has a kink, at which a search ends though its derivatives promise more than a unit
    of chi^2: states beyond the kink are tried too, to which steps lead that overshoot it.

    Args:
        point: where the search has ended.
        only_at_kinks: True to leave out all but the last.
        deadline: as of `fit_initial_states`.
    """
    trials = _states_beyond_kinks(point)
    # With wrong parameters all segments fit poorly: the reduced chi^2 that the best quarter stays below is the measure.
    usual = max(1.0, float(np.quantile([run.chi2 / max(run.expected_chi2, 1) for run in point.runs], 0.25)))
    poor = [k for k, run in enumerate(point.runs) if run.chi2 > usual * stats.chi2.isf(NOT_NOISE, run.expected_chi2)]
    if not is_nonsmooth(point.problem.effects) and 2 * len(poor) > len(point.runs):
        return point.runs  # the model is wrong, not initial states
    for k in () if only_at_kinks else poor:
        run = point.runs[k]
        resting, before = run.state.copy(), earlier_runs(point.runs, run.observed)
        resting[run.chain.size + run.chain.active] = 0.0
        previous = state_at(before, run.observed) if before else run.prior.rest
        trials += [(k, resting), (k, previous)]
        for effect in run.arm.effects:
            trials += [(k, state) for known in (run.state, previous) for state in effect.other_states(run.chain, known)]
    return tuple(best_of_starts(point.runs, trials, point.problem.step_multiple, deadline))


def _states_beyond_kinks(point: Point) -> list[tuple[int, Array]]:
    """Return other states for runs, by index, that stick and whose derivatives promise more than a unit of chi^2."""
    sticking = [k for k, run in enumerate(point.runs) if run.arm.has_dry_friction]
    linearize_by_states([point.runs[k] for k in sticking])
    states, unit = [], max(point.misfit, 1.0) ** 2
    for k in sticking:
        run, linearized = point.runs[k], point.runs[k].linearized_by_state
        if linearized.decrease(linearized.best()) > unit:
            longest = damped_states(run, linearized, np.zeros(0))[:2]  # those that overshoot a kink
            states += [(k, state) for state in longest]
    return states


def likely_runs(problem: TrajectoryProblem, x: Array, states: Sequence[Array], deadline: float = np.inf) -> list[Run]:
    """Return runs of segments from their most likely initial states, looked for from given ones (2 nv,).

    Where these are too far from the recording for the search to follow it, it starts from rest as well.
    """
    arms, observed = problem.arms(x), problem.observed
    multiple = problem.step_multiple
    runs = [run for run, _ in fit_initial_states(arms, observed, states, multiple, FEW_TRIALS, deadline)]
    poor = [k for k, run in enumerate(runs) if not is_followed([run]) and monotonic() <= deadline]
    if poor:
        resting = fit_initial_states(
            [arms[k] for k in poor],
            [observed[k] for k in poor],
            None,
            multiple,
            2 * FEW_TRIALS,
            deadline,
        )
        for k, (run, _) in zip(poor, resting, strict=True):
            runs[k] = min(runs[k], run, key=lambda run: run.cost)
    return runs
