"""Fits of candidate models: begun, compared and finished in two stages, and kept for later questions.

Many refits are begun and few are finished: those that will not come near the best are given up early (successive
halving: Jamieson and Talwalkar, AISTATS 2016). All fits share what is known of the chain's discretization error.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.diagnosis.baseline import CLOSE, DiscretizationBias, SearchStart, with_offset
from vjm.diagnosis.candidate_fit import (
    INCOMPLETE,
    CandidateFit,
    Names,
    adds_joint,
    named,
    refit,
)
from vjm.diagnosis.records import Cause
from vjm.diagnosis.screen import Screen, Workers
from vjm.effects import Effect
from vjm.effects.effect import is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.records import Array, Rig
from vjm.simulation.initial_state import fit_initial_states

# Sizes that refits start from, in typical magnitudes.
_LARGEST_START = 5.0  # a linear guess beyond that is no guide
_NONSMOOTH_START = 0.5  # less friction or play does nothing that derivatives show
_LEAST_JOINT_START = 0.1  # a joint that is nearly rigid has next to no derivative
ALIKE = 10.0  # chi^2 below which models are not distinguished: a likelihood ratio of e^5, decisive by Jeffreys
LOST_MISFIT = 3.0  # misfit from which a model does not follow the recordings
_PERIODS = 3.0  # times the first horizon: long enough to compare models where nothing is a guide
_NEAR = 1.5  # times the best misfit of the first periods, up to which a model may be the best in the end
_EXPLAINED = 1.1  # misfit of a model that explains the first periods
_REST = 1e-3  # share of the chi^2 beyond noise that a model may leave for further effects
_KEPT = 4  # fits that are finished where none explains anything
FIRST_STEPS = 2  # of each fit, before the most promising are finished
_MOST_FIRST_STEPS = 6  # the same as long as the next step promises much
_MUCH = 0.1  # decrease of chi^2, as a share of it, that is worth another first step
_MOST_SHORT_STEPS = 20  # beside the first periods, where a step takes little time
_FAR = 2.0  # times the best misfit of the first periods, from which a fit is given up
_HOPELESS = 30.0  # times the best misfit after the first steps, from which a fit is given up
_STUCK, _GAINED = 5, 0.97  # steps, and the share of chi^2 below which they have gained enough
_NONSMOOTH_GAINED = 0.998  # the same for stick-slip and play, whose fits creep to their ends
_MARGIN = 3.0  # a refit is given up once its next step promises less than a third of what it lacks
# Misfits beyond which the best parameters do not matter once a step lowers chi^2 by less than a share.
_DONE = ((1.5, 1e-2), (1.01, 1e-3))
_ROUGHLY = 1e-3  # of chi^2: well below what an effect must explain to matter


@dataclass(frozen=True)
class FitJob:
    """Refit to try.

    Attributes:
        start: the fit to begin with.
        effects: those wanted, with the parameters from which their search starts.
    """

    start: CandidateFit
    effects: tuple[Effect, ...]

    @classmethod
    def of(cls, start: CandidateFit, kept: Sequence[Effect], added: Sequence[Effect], sizes: Array) -> Self:
        """Return the refit of a model with further effects.

        Args:
            start: the model.
            kept: effects with the parameters from which their search starts.
            added: further effects, with their shape parameters.
            sizes: (s,) of those as a screen guesses them, in typical magnitudes.
        """
        parts = np.split(sizes, np.cumsum([effect.magnitude_count for effect in added])[:-1])
        sized = [_with_start_size(effect, own, start.point.chain) for effect, own in zip(added, parts, strict=True)]
        return cls(start, (*kept, *sized))


def _with_start_size(effect: Effect, guess: Array, chain: Chain) -> Effect:
    """Return an effect of a size from which a refit may start.

    Args:
        effect: with its shape parameters.
        guess: (s,) sizes by a screen, in typical magnitudes.
        chain: to which it is added.
    """
    coordinates = effect.coordinates
    smooth = _LEAST_JOINT_START if adds_joint(effect, chain) else -_LARGEST_START
    least = _NONSMOOTH_START if effect.nonsmooth else smooth
    coordinates[: effect.magnitude_count] = np.clip(guess, least, _LARGEST_START)
    return effect.at(np.clip(coordinates, *effect.bounds))


def _start_fit(job: FitJob, whole: float, record: float = np.inf) -> CandidateFit | None:
    """Begin a refit; beside the recordings' first periods, with as many steps as may make it one of the best.

    Args:
        job: the refit.
        whole: duration of the longest recording [s].
        record: chi^2 of the best beside the first periods so far.
    """
    nonsmooth = is_nonsmooth(job.effects)
    if _is_short(job.start, whole):
        return refit(job.start, job.effects, StoppingRule(_MOST_SHORT_STEPS, _FAR**2 * record, nonsmooth))
    # With encoder feedback a step does what it promises; open loop that may be far off.
    most = _MOST_FIRST_STEPS if job.start.uses_feedback else FIRST_STEPS
    return refit(job.start, job.effects, StoppingRule(FIRST_STEPS, nonsmooth=nonsmooth, most=most))


def _is_short(candidate_fit: CandidateFit, whole: float) -> bool:
    """True if it has the recordings' first periods only."""
    return candidate_fit.point.problem.longest < whole


def _near_noise(partial_fit: CandidateFit, whole: float, fewer: CandidateFit) -> bool:
    """True if so little remains that the fit is worth finishing before others are tried.

    Args:
        partial_fit: the fit.
        whole: duration of the longest recording [s].
        fewer: the best with fewer effects.
    """
    short = _is_short(partial_fit, whole)
    little = partial_fit.misfit < (_EXPLAINED if short or partial_fit.uses_feedback else CLOSE)
    return little or (not short and _explains_nearly_all(partial_fit, fewer))


def _explains_nearly_all(candidate_fit: CandidateFit, fewer: CandidateFit) -> bool:
    """True if it leaves next to nothing of what another with fewer effects lacked: the rest is for further ones."""
    lacked, lacks = (max(each.misfit**2 - 1.0, 0.0) for each in (fewer, candidate_fit))
    return candidate_fit.misfit < CLOSE and lacks < _REST * lacked


def _promising(partial_fits: Sequence[CandidateFit], whole: float) -> list[CandidateFit]:
    """Keep fits that may be best in the end, the best first; a few at most where none explains anything."""
    ordered = sorted(partial_fits, key=lambda each: each.misfit)
    short = [each for each in ordered if _is_short(each, whole)]
    if short:
        best = short[0].misfit
        near = sum(each.misfit < _NEAR * max(best, 1.0) for each in short)
        short = short[: near if best < _EXPLAINED else min(near, _KEPT)]
    least = min((each.misfit for each in partial_fits), default=np.inf)
    long = [each for each in ordered if not _is_short(each, whole) and each.misfit < _HOPELESS * least]
    kept = [*(long if not long or long[0].follows else long[:_KEPT]), *short]
    return sorted(kept, key=lambda each: each.misfit)


def _finish_fit(partial_fit: CandidateFit, record: float, whole: TrajectoryProblem) -> CandidateFit | None:
    """Finish a refit; give it up once it will not come near the record.

    Args:
        partial_fit: where it has come to.
        record: chi^2 of the best so far.
        whole: all of the recordings.
    """
    short, nonsmooth = _is_short(partial_fit, whole.longest), is_nonsmooth(partial_fit.effects)
    if partial_fit.fit.converged and not short:
        return partial_fit
    if not short and _is_hopeless(partial_fit, record):
        return partial_fit
    enough = _NONSMOOTH_GAINED if nonsmooth else _GAINED
    rule = StoppingRule(np.inf, record, nonsmooth, enough, rough=partial_fit.uses_feedback and not nonsmooth)
    return refit(partial_fit, partial_fit.effects, rule, whole=whole if short else None)


def _is_hopeless(partial_fit: CandidateFit, record: float) -> bool:
    """True if what another step promises, if that is known, is far from a record (chi^2).

    A fit that does not follow the recordings begins again with their first periods, where more may be promised.
    """
    return partial_fit.follows and StoppingRule(np.inf, record)(partial_fit.point, partial_fit.fit.predicted_decrease)


class StoppingRule:
    """Stopping rule of a fit: after some steps, far from a record, or when it is wrong and as good as done.

    With stick-slip, or far from the recordings, derivatives are only roughly a guide: once many steps have gained
    little, none will.

    Args:
        steps: after which it ends.
        record: chi^2 that it must come near.
        nonsmooth: whether there is stick-slip or play.
        enough: share of chi^2 below which some steps have gained enough.
        most: steps, as long as the next one promises much.
        rough: whether it need not be fitted to its very end, since it will be fitted open loop.
    """

    def __init__(
        self,
        steps: float,
        record: float = np.inf,
        nonsmooth: bool = False,
        enough: float = _GAINED,
        most: float = 0.0,
        rough: bool = False,
    ) -> None:
        self.steps = steps
        self.rough = rough
        self.most = most
        self.record = record
        self.nonsmooth = nonsmooth
        self.enough = enough
        self.history: list[float] = []

    def __call__(self, point: Point, predicted: float) -> bool:
        """Return True to end it where it is, given the predicted decrease of chi^2 by its next step."""
        self.history.append(point.chi2)
        share = predicted / point.chi2
        steps = self.steps if share < _MUCH else max(self.steps, self.most)
        done = any(point.misfit > misfit and share < little for misfit, little in _DONE)
        done = done or (self.rough and share < _ROUGHLY)
        slow = self.nonsmooth or point.misfit > LOST_MISFIT
        stuck = slow and len(self.history) > _STUCK and point.chi2 > self.enough * self.history[-_STUCK]
        return len(self.history) > steps or done or stuck or point.chi2 - _MARGIN * predicted > self.record + 5 * ALIKE


NOISE = 1.02  # misfit that leaves nothing to explain
COARSE = 1.15  # the same as long as the discretization error is not known; more is not the end of a search
Tell = Callable[[str], None]
Enough = Callable[[Sequence[CandidateFit]], bool]


class FitCache:
    """Fits of a search, by the names of their effects.

    Attributes:
        start: the model to which effects are added.
        diverges_from_data: whether it does not follow what has changed.
        tried: fits; hopeless ones not to their end.
        uncorrected: those fitted without `discretization_offset`.
        discretization_offset: what more virtual joints would show, for each recording; None: not known yet.
    """

    def __init__(self, rig: Rig, search_start: SearchStart, tell: Tell, workers: Workers) -> None:
        self.rig = rig
        self.start = search_start.start
        self.diverges_from_data = search_start.diverges_from_data
        self.tell = tell
        self.workers = workers
        self.tried: dict[Names, CandidateFit] = {search_start.start.names: search_start.start}
        self.uncorrected: set[Names] = set()
        self.discretization_offset: tuple[Array, ...] | None = None
        self._partial_fits: dict[Names, CandidateFit] = {}
        self._linearization_points: dict[Names, CandidateFit] = {}
        self._refit_starts: dict[Names, CandidateFit] = {}

    def linearization_point(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Return the fit at which derivatives guide: of the first periods where the model loses the recordings."""
        if self.screen_unreliable(candidate_fit) or candidate_fit.follows:
            return candidate_fit
        if candidate_fit.names not in self._linearization_points:
            self._linearization_points[candidate_fit.names] = _truncated_fit(candidate_fit)
        return self._linearization_points[candidate_fit.names]

    def refit_start(self, candidate_fit: CandidateFit, nonsmooth: bool = False) -> CandidateFit:
        """Return the start of fits with further effects: of the first periods, where its own parameters are no guide.

        Args:
            candidate_fit: the model.
            nonsmooth: whether a further effect is stick-slip or play, found from wherever derivatives lead.
        """
        far = self.screen_unreliable(candidate_fit)
        if not far and (nonsmooth or not _parameters_unreliable(candidate_fit)):
            return self.linearization_point(candidate_fit)
        if candidate_fit.names not in self._refit_starts:
            self._refit_starts[candidate_fit.names] = (
                _truncated_at_parameters(candidate_fit) if far else _restart_from_nominal(candidate_fit)
            )
        return self._refit_starts[candidate_fit.names]

    def screen_unreliable(self, candidate_fit: CandidateFit) -> bool:
        """Return True if no derivative is a guide from there."""
        return self.diverges_from_data and candidate_fit is self.start

    def job(self, model: CandidateFit, screened: Screen, chosen: Sequence[int]) -> FitJob:
        """Return the refit of a model with some effects of its screen; of typical sizes, where that is unreliable."""
        added = [screened.effects[k] for k in chosen]
        start = self.refit_start(model, is_nonsmooth(added))
        typical = np.ones(sum(effect.magnitude_count for effect in added))
        sizes = typical if self.screen_unreliable(model) else screened.guess(chosen)
        return FitJob.of(start, start.effects, added, sizes)

    def best(self, count: int) -> CandidateFit | None:
        """Return the best model of so many effects."""
        found = [each for each in self.tried.values() if len(each.effects) == count]
        return min(found, key=lambda each: each.chi2, default=None)

    def next_best(self, best: CandidateFit) -> CandidateFit | None:
        """Return the next best model of as many effects; None where no other was tried, or nothing is explained.

        Where the best left nothing, so that no other was fitted to its end, the most promising one is now.
        """
        tried, partial_fits = (
            [each for each in some.values() if _rivals(each, best)] for some in (self.tried, self._partial_fits)
        )
        if not tried and partial_fits:
            self.tell("fitting the next best")
            most = min(partial_fits, key=lambda each: each.misfit)
            found = _finish_fit(most, np.inf, self._beside(self.start).point.problem)
            tried = [] if found is None else [found]
        return min(tried, key=lambda each: each.chi2, default=None)

    def fit(self, jobs: Sequence[FitJob], every: bool = False) -> None:
        """Begin all refits, then finish those that may be the best, the most promising first.

        Args:
            jobs: refits to try.
            every: whether to try others once one leaves nothing, which may leave as little.
        """
        enough = _never if every else self._explained
        wanted = {named(job.effects): job for job in jobs}
        wanted = {names: job for names, job in wanted.items() if names not in self.tried}
        self.tell("trying " + ", ".join(sorted({name for names in wanted for name, _ in names})))
        if not wanted:
            return
        whole = self._beside(self.start).point.problem
        pending = [replace(job, start=self._known(job.start)) for job in wanted.values()]
        partial_fits: list[CandidateFit] = []
        while pending:
            together, pending = pending[: self.workers.count], pending[self.workers.count :]
            record = min((each.chi2 for each in partial_fits if _is_short(each, whole.longest)), default=np.inf)
            found = self.workers.map(partial(_start_fit, whole=whole.longest, record=record), together)
            new = [each for each in found if each is not None]
            partial_fits += new
            self._partial_fits |= {each.names: each for each in new}
            near = [each for each in new if _near_noise(each, whole.longest, self._fewer(each))]
            near.sort(key=lambda each: each.chi2)
            if enough(self._finish(near, whole, enough)):
                return
        rest = [each for each in _promising(partial_fits, whole.longest) if each.names not in self.tried]
        self._finish(rest, whole, enough)

    def _finish(
        self, partial_fits: Sequence[CandidateFit], whole: TrajectoryProblem, enough: Enough
    ) -> list[CandidateFit]:
        """Finish fits as long as they may be the best of so many effects."""
        known = [
            each.chi2
            for each in self.tried.values()
            if partial_fits and len(each.effects) == len(partial_fits[0].effects)
        ]
        record = min(
            [*known, *(each.chi2 for each in partial_fits if not _is_short(each, whole.longest))], default=np.inf
        )
        ended: list[CandidateFit] = []
        waiting = [*partial_fits]
        while waiting:
            # What explains all so far is waited for alone: others beside it may take far longer.
            count = 1 if enough(waiting[:1]) else self.workers.count
            together, waiting = waiting[:count], waiting[count:]
            self.tell("fitting " + " and ".join(sorted({name for each in together for name, _ in each.names})))
            found = self.workers.map(partial(_finish_fit, record=record, whole=whole), together)
            ended += [each for each in found if each is not None]
            self.tried |= {each.names: each for each in ended}
            if enough(ended):
                break  # nothing can be better, and what equals it is asked for in the end
            record = min([record, *(each.chi2 for each in ended)])
        return ended

    def with_replaced(self, best: CandidateFit, cause: Cause) -> list[CandidateFit]:
        """Return the fits in which alternatives stand in a cause's place."""
        others = best.names - {cause.effect.key}
        names = [others | {alternative.effect.key} for alternative in cause.alternatives]
        return [self.tried[each] for each in names if each in self.tried]

    def explained(self, count: int) -> bool:
        """Return True if so many effects leave nothing but noise."""
        found = self.best(count)
        return found is not None and self._explained([found])

    def without(self, candidate_fit: CandidateFit, effect: Effect, record: float) -> CandidateFit | None:
        """Fit a model again without one of its effects; None where that cannot be simulated.

        Args:
            candidate_fit: the model.
            effect: one of its effects.
            record: chi^2 of no interest beyond; the fit is given up once it will not come near.
        """
        names = candidate_fit.names - {effect.key}
        known = self.tried.get(names)
        # A fit that is worse than one of fewer effects has lost its way.
        astray = known is not None and any(
            each.names < names and each.chi2 < known.chi2 for each in self.tried.values()
        )
        far = known is not None and not astray and (known.misfit > CLOSE or known.chi2 > 2 * record)
        # A model that was fitted before may be fitted better from here.
        kept = tuple(each for each in candidate_fit.effects if each is not effect)
        steps = FIRST_STEPS if far else np.inf
        found = refit(candidate_fit, kept, StoppingRule(steps, record, is_nonsmooth(kept)))
        if far and known is not None and found is not None and found.chi2 < known.chi2:
            rule = StoppingRule(np.inf, record, is_nonsmooth(kept))
            found = found if _is_hopeless(found, record) else refit(found, kept, rule)
        if found is None or (known is not None and names not in self.uncorrected and known.chi2 < found.chi2):
            return known
        self.tried[names] = found
        self.uncorrected.discard(names)
        return self.tried[names]

    def _explained(self, candidate_fits: Sequence[CandidateFit]) -> bool:
        """One of them leaves nothing but noise and the chain's discretization error, or next to nothing."""
        least = COARSE if self.discretization_offset is None else NOISE
        return any(each.misfit < least or _explains_nearly_all(each, self._fewer(each)) for each in candidate_fits)

    def _fewer(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Best fit with fewer effects."""
        count = len(candidate_fit.effects)
        found = [each for each in self.tried.values() if len(each.effects) < count]
        return min(found, key=lambda each: each.chi2, default=self.start)

    def refresh(self, wanted: Sequence[Names]) -> None:
        """Fit models again that were fitted before the chain's discretization error was known."""
        for names in self.uncorrected.intersection(wanted):
            known = self._beside(self.tried[names])
            found = refit(known, known.effects)
            if found is not None:
                self.tried[names] = found
        self.uncorrected.difference_update(wanted)

    def converge(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Fit a model to the very end, unless that is of no use."""
        if candidate_fit.fit.converged or candidate_fit.misfit > COARSE:
            return candidate_fit
        if candidate_fit.uses_feedback or is_nonsmooth(candidate_fit.effects):
            return candidate_fit  # it is fitted open loop in the end, or was fitted as far as that leads anywhere
        found = refit(candidate_fit, candidate_fit.effects)
        if found is None or found.chi2 > candidate_fit.chi2:
            return candidate_fit
        self.tried[found.names] = found
        return found

    def correct_discretization(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Measure the chain's discretization error once a model follows the recordings, for all later fits too.

        With encoder feedback it hardly shows; such models are fitted open loop where that is possible.
        """
        if candidate_fit.uses_feedback or candidate_fit.misfit > CLOSE or is_nonsmooth(candidate_fit.effects):
            return candidate_fit
        self.tell("measuring the discretization error")
        rough = candidate_fit.misfit > COARSE
        found = DiscretizationBias.of(candidate_fit.point, self.rig, rough)
        if found is None:
            return candidate_fit
        known = found.corrected(candidate_fit, rough)
        self.discretization_offset, self.uncorrected = found.offset, {*self.tried} - {known.names}
        self._linearization_points.clear()
        self._refit_starts.clear()
        self.tried[known.names] = known
        return known

    def _known(self, start: CandidateFit) -> CandidateFit:
        """Start of a fit; short ones are good enough as they are."""
        return start if _is_short(start, self.start.point.problem.longest) else self._beside(start)

    def _beside(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Model beside what is known of the chain's discretization error."""
        if self.discretization_offset is None or candidate_fit.names not in self.uncorrected:
            return candidate_fit
        return replace(
            candidate_fit,
            fit=replace(candidate_fit.fit, point=with_offset(candidate_fit.point, self.discretization_offset)),
        )


def _truncated_fit(fit: CandidateFit) -> CandidateFit:
    """Fit the recordings' first periods only, which the model follows better.

    A fit of recordings that it cannot follow may have ended anywhere: the search begins there and at the nominal chain.
    """
    point = fit.point
    nominal = point.problem.parametrisation.start
    plain = np.concatenate([nominal, point.x[nominal.size :]])
    part = point.problem.until(min(point.problem.first_horizon(x) for x in (point.x, plain)))
    fits: list[TrajectoryFit] = []
    for x, states in ((point.x, [run.state for run in point.runs]), (plain, None)):
        with contextlib.suppress(SimulationDivergedError, InsufficientDataError):
            fits.append(fit_trajectory(part, x, None, states, rough=True))
    if not fits:
        return fit
    return CandidateFit(min(fits, key=lambda each: each.point.chi2))


def _parameters_unreliable(fit: CandidateFit) -> bool:
    """Return True where feedback keeps joints from drifting, but wrong frequencies may be in any phase."""
    return fit.uses_feedback and fit.misfit > INCOMPLETE and not is_nonsmooth(fit.effects)


def _truncated_at_parameters(fit: CandidateFit) -> CandidateFit:
    """Same parameters beside the recordings' first periods, from their most likely initial states there."""
    point = fit.point
    duration = _PERIODS * point.problem.first_horizon(point.x)
    return _at_first_periods(fit, point.x, duration, [run.state for run in point.runs])


def _restart_from_nominal(fit: CandidateFit) -> CandidateFit:
    """Return the effects beside the nominal chain and the first periods; the fit itself if that cannot be simulated."""
    nominal = fit.point.problem.parametrisation.start
    x = np.concatenate([nominal, fit.point.x[nominal.size :]])
    try:
        return _at_first_periods(fit, x, fit.point.problem.first_horizon(x))
    except (SimulationDivergedError, InsufficientDataError):
        return fit


def _at_first_periods(
    fit: CandidateFit, x: Array, duration: float, states: Sequence[Array] | None = None
) -> CandidateFit:
    """Coordinates x (p,) beside the recordings' first seconds, not fitted."""
    part = fit.point.problem.until(duration)
    found = fit_initial_states(part.arms(x), part.observed, states, part.step_multiple)
    return CandidateFit.unfitted(part, x, [run for run, _ in found])


def _rivals(one: CandidateFit, best: CandidateFit) -> bool:
    """True if it has as many effects as the best, and others; stick-slip is slow to fit, and left out."""
    slow = is_nonsmooth(one.effects) and not is_nonsmooth(best.effects)
    return len(one.effects) == len(best.effects) > best.reference_effects and one.names != best.names and not slow


def _never(candidate_fits: Sequence[CandidateFit]) -> bool:
    return False
