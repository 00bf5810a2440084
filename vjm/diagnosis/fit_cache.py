"""Explanations that were fitted, each beside the same knowledge of what the chain's coarseness does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from vjm.diagnosis.baseline import SearchStart
from vjm.diagnosis.candidate_fit import (
    CandidateFit,
    Names,
    named,
    parameters_unreliable,
    refit,
    restart_from_nominal,
    sized,
    truncated_at_parameters,
    truncated_fit,
)
from vjm.diagnosis.discretization import CLOSE, corrected, discretization_bias, with_offset
from vjm.diagnosis.screen import Screen
from vjm.diagnosis.workers import Workers
from vjm.effects import Effect
from vjm.effects.effect import is_nonsmooth
from vjm.identification.trajectory_fit import Point, TrajectoryProblem
from vjm.records import Array, Rig

ALIKE = 10.0  # chi^2 by which an explanation must be worse to be told from another
OFF = 3.0  # misfit from which an explanation does not follow the recordings
_NEAR = 1.5  # times the best misfit of the recordings' beginnings, up to which an explanation may be best in the end
_EXPLAINED = 1.1  # misfit of what explains them
_LITTLE = 2.0  # the same of whole recordings, before a fit has ended
_REST = 1e-3  # of the chi^2 beyond noise, if more was explained at a stroke
_KEPT = 4  # explanations that are followed where none does
FIRST_STEPS = 2  # of each explanation, before the most promising are followed to the end
_MOST_FIRST_STEPS = 6  # the same as long as the next one promises much
_MUCH = 0.1  # of chi^2
_MOST_SHORT_STEPS = 20  # beside the recordings' beginnings
_FAR = 2.0  # times the best misfit there
_HOPELESS = 30.0  # times the best misfit of all, after some steps
_STUCK, _GAINED = 5, 0.97  # steps, and the share of chi^2 below which they have gained enough
_ABRUPT_GAINED = 0.998  # the same where something sticks or rattles: such a fit creeps to its end
_MARGIN = 3.0  # a refit is given up once its next step promises less than a third of what it lacks
# Of an explanation that leaves so large a misfit, the best parameters do not matter once a step lowers chi^2 by less.
_DONE = ((1.5, 1e-2), (1.01, 1e-3))
_ROUGHLY = 1e-3  # of chi^2: well below what an effect must explain to matter


@dataclass(frozen=True)
class FitJob:
    """A refit to try.

    Attributes:
        start: the explanation to begin with.
        effects: those wanted, with the parameters from which their search starts.
    """

    start: CandidateFit
    effects: tuple[Effect, ...]


def proposal(start: CandidateFit, seen: Screen, chosen: Sequence[int], screen_unreliable: bool = False) -> FitJob:
    """An explanation with further effects, of sizes that a screen guesses.

    Args:
        start: the explanation.
        seen: the screen.
        chosen: of its effects.
        screen_unreliable: whether the start is no guide: then sizes are everyday ones.
    """
    added = [seen.effects[k] for k in chosen]
    guess = np.ones(sum(effect.magnitude_count for effect in added)) if screen_unreliable else seen.guess(chosen)
    stops = np.cumsum([effect.magnitude_count for effect in added])
    new = [
        sized(effect, guess[stop - effect.magnitude_count : stop], start.point.chain)
        for stop, effect in zip(stops, added, strict=True)
    ]
    return FitJob(start, (*start.effects, *new))


def start_fit(job: FitJob, whole: float, record: float = np.inf) -> CandidateFit | None:
    """A refit's first steps; of recordings' beginnings, as many as may still make it one of the best.

    Args:
        job: the refit.
        whole: duration of the longest recording [s].
        record: chi^2 of the best beside the beginnings so far.
    """
    nonsmooth = is_nonsmooth(job.effects)
    if is_short(job.start, whole):
        return refit(job.start, job.effects, StoppingRule(_MOST_SHORT_STEPS, _FAR**2 * record, nonsmooth))
    # Held, a fit goes where its steps point; open loop, what a step promises may be far from what it does.
    most = _MOST_FIRST_STEPS if job.start.uses_feedback else FIRST_STEPS
    return refit(job.start, job.effects, StoppingRule(FIRST_STEPS, nonsmooth=nonsmooth, most=most))


def is_short(candidate_fit: CandidateFit, whole: float) -> bool:
    """Whether it is of the recordings' beginnings only."""
    return candidate_fit.point.problem.longest < whole


def near_noise(partial_fits: CandidateFit, whole: float, fewer: CandidateFit) -> bool:
    """Whether so little is left that its fit is worth ending before others are tried.

    Args:
        partial_fits: the fit.
        whole: duration of the longest recording [s].
        fewer: the best with fewer effects.
    """
    short = is_short(partial_fits, whole)
    little = partial_fits.point.misfit < (_EXPLAINED if short or partial_fits.uses_feedback else _LITTLE)
    return little or (not short and explains_nearly_all(partial_fits, fewer))


def explains_nearly_all(candidate_fit: CandidateFit, fewer: CandidateFit) -> bool:
    """Whether it leaves next to nothing of what another with fewer effects lacked: what is left is for further ones."""
    lacked, lacks = (max(each.point.misfit**2 - 1.0, 0.0) for each in (fewer, candidate_fit))
    return candidate_fit.point.misfit < _LITTLE and lacks < _REST * lacked


def promising(partial_fits: Sequence[CandidateFit], whole: float) -> list[CandidateFit]:
    """The best first; of those that were tried on the recordings' beginnings, the ones that may be best in the end.

    Of those that explain nothing, a few at most.
    """
    ordered = sorted(partial_fits, key=lambda each: each.point.misfit)
    short = [each for each in ordered if is_short(each, whole)]
    if short:
        best = short[0].point.misfit
        near = sum(each.point.misfit < _NEAR * max(best, 1.0) for each in short)
        short = short[: near if best < _EXPLAINED else min(near, _KEPT)]
    least = min((each.point.misfit for each in partial_fits), default=np.inf)
    long = [each for each in ordered if not is_short(each, whole) and each.point.misfit < _HOPELESS * least]
    kept = [*(long if not long or long[0].follows else long[:_KEPT]), *short]
    return sorted(kept, key=lambda each: each.point.misfit)


def finish_fit(partial_fits: CandidateFit, record: float, whole: TrajectoryProblem) -> CandidateFit | None:
    """A refit to its end; given up once it will not come near the record.

    Args:
        partial_fits: where it has come to.
        record: chi^2 of the best so far.
        whole: all of the recordings.
    """
    short, nonsmooth = is_short(partial_fits, whole.longest), is_nonsmooth(partial_fits.effects)
    if partial_fits.fit.converged and not short:
        return partial_fits
    if not short and is_hopeless(partial_fits, record):
        return partial_fits
    enough = _ABRUPT_GAINED if nonsmooth else _GAINED
    patience = StoppingRule(np.inf, record, nonsmooth, enough, rough=partial_fits.uses_feedback and not nonsmooth)
    return refit(partial_fits, partial_fits.effects, patience, whole=whole if short else None)


def is_hopeless(partial_fits: CandidateFit, record: float) -> bool:
    """Whether what another step promises, if that is known, is far from a record (chi^2).

    A fit that does not follow the recordings begins again with their beginnings, where more may be promised.
    """
    return partial_fits.follows and StoppingRule(np.inf, record)(partial_fits.point, partial_fits.fit.promised)


class StoppingRule:
    """Ends a fit after some steps, or when it will not come near a record, or when it is wrong and as good as done.

    Where something sticks and slips, or little is followed, slopes are only roughly a guide: once many steps have
    gained little, none will.

    Args:
        steps: after which it ends.
        record: chi^2 that it must come near.
        nonsmooth: whether something sticks and slips.
        enough: share of chi^2 below which some steps have gained enough.
        most: steps, as long as the next one promises much.
        rough: whether it need not be fitted to its very end, as what is held and will be fitted open loop.
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
        self.seen: list[float] = []

    def __call__(self, point: Point, predicted: float) -> bool:
        """Whether to end it where it is, given by how much its next step may lower chi^2."""
        self.seen.append(point.chi2)
        share = predicted / point.chi2
        steps = self.steps if share < _MUCH else max(self.steps, self.most)
        done = any(point.misfit > misfit and share < little for misfit, little in _DONE)
        done = done or (self.rough and share < _ROUGHLY)
        slow = self.nonsmooth or point.misfit > OFF
        stuck = slow and len(self.seen) > _STUCK and point.chi2 > self.enough * self.seen[-_STUCK]
        return len(self.seen) > steps or done or stuck or point.chi2 - _MARGIN * predicted > self.record + 5 * ALIKE


NOISE = 1.02  # misfit that leaves nothing to explain
COARSE = 1.15  # the same as long as the chain's coarseness is not known; what leaves more is not the end of a search
Tell = Callable[[str], None]
Enough = Callable[[Sequence[CandidateFit]], bool]


class FitCache:
    """All that a search has fitted, by the names of the effects.

    Attributes:
        start: the explanation from which effects are looked for.
        diverges_from_data: whether it does not follow what has changed.
        tried: explanations; hopeless ones not to their end.
        uncorrected: those that do not know what `surplus` says.
        discretization_offset: what more virtual joints would show, for each recording; None: not known yet.
    """

    def __init__(self, rig: Rig, partial_fits: SearchStart, tell: Tell, workers: Workers) -> None:
        self.rig = rig
        self.start = partial_fits.start
        self.diverges_from_data = partial_fits.diverges_from_data
        self.tell = tell
        self.workers = workers
        self.tried: dict[Names, CandidateFit] = {partial_fits.start.names: partial_fits.start}
        self.uncorrected: set[Names] = set()
        self.discretization_offset: tuple[Array, ...] | None = None
        self._partial_fits: dict[Names, CandidateFit] = {}
        self._linearization_points: dict[Names, CandidateFit] = {}
        self._refit_starts: dict[Names, CandidateFit] = {}

    def linearization_point(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Where slopes tell what is missing: where it does not follow the recordings, at their beginnings."""
        if self.screen_unreliable(candidate_fit) or candidate_fit.follows:
            return candidate_fit
        if candidate_fit.names not in self._linearization_points:
            self._linearization_points[candidate_fit.names] = truncated_fit(candidate_fit)
        return self._linearization_points[candidate_fit.names]

    def refit_start(self, candidate_fit: CandidateFit, nonsmooth: bool = False) -> CandidateFit:
        """Where fits with further effects begin: the recordings' beginnings, where its own parameters are no guide.

        Args:
            candidate_fit: the effects that are there.
            nonsmooth: whether a further one sticks or rattles, which is found from wherever slopes lead.
        """
        far = self.screen_unreliable(candidate_fit)
        if not far and (nonsmooth or not parameters_unreliable(candidate_fit)):
            return self.linearization_point(candidate_fit)
        if candidate_fit.names not in self._refit_starts:
            self._refit_starts[candidate_fit.names] = (
                truncated_at_parameters(candidate_fit) if far else restart_from_nominal(candidate_fit)
            )
        return self._refit_starts[candidate_fit.names]

    def screen_unreliable(self, candidate_fit: CandidateFit) -> bool:
        """Whether nothing is a guide from there."""
        return self.diverges_from_data and candidate_fit is self.start

    def best(self, count: int) -> CandidateFit | None:
        """The best explanation of so many effects."""
        found = [each for each in self.tried.values() if len(each.effects) == count]
        return min(found, key=lambda each: each.chi2, default=None)

    def next_best(self, best: CandidateFit) -> CandidateFit | None:
        """The next best explanation of as many effects; None where nothing else was tried, or nothing is explained.

        Where the best left nothing, so that no other was fitted to its end, the most promising one is now.
        """
        tried, partial_fits = (
            [each for each in some.values() if _rivals(each, best)] for some in (self.tried, self._partial_fits)
        )
        if not tried and partial_fits:
            self.tell("fitting the next best")
            most = min(partial_fits, key=lambda each: each.point.misfit)
            found = finish_fit(most, np.inf, self._beside(self.start).point.problem)
            tried = [] if found is None else [found]
        return min(tried, key=lambda each: each.chi2, default=None)

    def fit(self, jobs: Sequence[FitJob], every: bool = False) -> None:
        """A few steps for each; then to the end for those that may be the best, the most promising first.

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
            record = min((each.chi2 for each in partial_fits if is_short(each, whole.longest)), default=np.inf)
            found = self.workers.map(partial(start_fit, whole=whole.longest, record=record), together)
            new = [each for each in found if each is not None]
            partial_fits += new
            self._partial_fits |= {each.names: each for each in new}
            near = [each for each in new if near_noise(each, whole.longest, self._fewer(each))]
            near.sort(key=lambda each: each.chi2)
            if enough(self._finish(near, whole, enough)):
                return
        rest = [each for each in promising(partial_fits, whole.longest) if each.names not in self.tried]
        self._finish(rest, whole, enough)

    def _finish(
        self, partial_fits: Sequence[CandidateFit], whole: TrajectoryProblem, enough: Enough
    ) -> list[CandidateFit]:
        """Fits to their end, as long as they may be the best of so many effects."""
        known = [
            each.chi2
            for each in self.tried.values()
            if partial_fits and len(each.effects) == len(partial_fits[0].effects)
        ]
        record = min(
            [*known, *(each.chi2 for each in partial_fits if not is_short(each, whole.longest))], default=np.inf
        )
        ended: list[CandidateFit] = []
        waiting = [*partial_fits]
        while waiting:
            # What explains all so far is waited for alone: others beside it may take far longer.
            count = 1 if enough(waiting[:1]) else self.workers.count
            together, waiting = waiting[:count], waiting[count:]
            self.tell("fitting " + " and ".join(sorted({name for each in together for name, _ in each.names})))
            found = self.workers.map(partial(finish_fit, record=record, whole=whole), together)
            ended += [each for each in found if each is not None]
            self.tried |= {each.names: each for each in ended}
            if enough(ended):
                break  # nothing can be better, and what equals it is asked for in the end
            record = min([record, *(each.chi2 for each in ended)])
        return ended

    def explained(self, count: int) -> bool:
        """Whether so many effects leave nothing but noise."""
        found = self.best(count)
        return found is not None and self._explained([found])

    def without(self, candidate_fit: CandidateFit, effect: Effect, record: float) -> CandidateFit | None:
        """The same explanation without one of its effects, fitted again; None where that cannot be simulated.

        Args:
            candidate_fit: the explanation.
            effect: one of its effects.
            record: chi^2 of no interest beyond; the fit is given up once it will not come near.
        """
        names = candidate_fit.names - {effect.key}
        known = self.tried.get(names)
        # A fit that is worse than one of fewer effects has lost its way.
        astray = known is not None and any(
            each.names < names and each.chi2 < known.chi2 for each in self.tried.values()
        )
        far = known is not None and not astray and (known.point.misfit > CLOSE or known.chi2 > 2 * record)
        # Also what was fitted before may be fitted better from here.
        kept = tuple(each for each in candidate_fit.effects if each is not effect)
        steps = FIRST_STEPS if far else np.inf
        found = refit(candidate_fit, kept, StoppingRule(steps, record, is_nonsmooth(kept)))
        if far and known is not None and found is not None and found.chi2 < known.chi2:
            patience = StoppingRule(np.inf, record, is_nonsmooth(kept))
            found = found if is_hopeless(found, record) else refit(found, kept, patience)
        if found is None or (known is not None and names not in self.uncorrected and known.chi2 < found.chi2):
            return known
        self.tried[names] = found
        self.uncorrected.discard(names)
        return self.tried[names]

    def _explained(self, candidate_fits: Sequence[CandidateFit]) -> bool:
        """Whether one of them leaves nothing but noise, and what the chain's coarseness may; or next to nothing."""
        least = COARSE if self.discretization_offset is None else NOISE
        return any(each.point.misfit < least or explains_nearly_all(each, self._fewer(each)) for each in candidate_fits)

    def _fewer(self, candidate_fit: CandidateFit) -> CandidateFit:
        """The best with fewer effects."""
        count = len(candidate_fit.effects)
        found = [each for each in self.tried.values() if len(each.effects) < count]
        return min(found, key=lambda each: each.chi2, default=self.start)

    def refresh(self, wanted: Sequence[Names]) -> None:
        """Fit again what was fitted before the chain's coarseness was known."""
        for names in self.uncorrected.intersection(wanted):
            known = self._beside(self.tried[names])
            found = refit(known, known.effects)
            if found is not None:
                self.tried[names] = found
        self.uncorrected.difference_update(wanted)

    def converge(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Fitted to the very end, unless that is of no use."""
        if candidate_fit.fit.converged or candidate_fit.point.misfit > COARSE:
            return candidate_fit
        if candidate_fit.uses_feedback or is_nonsmooth(candidate_fit.effects):
            return candidate_fit  # it is fitted open loop in the end, or was fitted as far as that leads anywhere
        found = refit(candidate_fit, candidate_fit.effects)
        if found is None or found.chi2 > candidate_fit.chi2:
            return candidate_fit
        self.tried[found.names] = found
        return found

    def correct_discretization(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Once it follows the recordings, with its chain's coarseness known, which all later fits know too.

        Held simulations show little of it, and what they find is fitted open loop where that is possible.
        """
        if candidate_fit.uses_feedback or candidate_fit.point.misfit > CLOSE or is_nonsmooth(candidate_fit.effects):
            return candidate_fit
        self.tell("asking what more virtual joints would show")
        rough = candidate_fit.point.misfit > COARSE
        found = discretization_bias(candidate_fit.point, self.rig, rough)
        if found is None:
            return candidate_fit
        known = CandidateFit(corrected(candidate_fit.fit, found, rough), found.shift)
        self.discretization_offset, self.uncorrected = found.discretization_offset, {*self.tried} - {known.names}
        self._linearization_points.clear()
        self._refit_starts.clear()
        self.tried[known.names] = known
        return known

    def _known(self, start: CandidateFit) -> CandidateFit:
        """The start of a fit; short ones are good enough as they are."""
        return start if is_short(start, self.start.point.problem.longest) else self._beside(start)

    def _beside(self, candidate_fit: CandidateFit) -> CandidateFit:
        """An explanation beside what is known of the chain's coarseness."""
        if self.discretization_offset is None or candidate_fit.names not in self.uncorrected:
            return candidate_fit
        return replace(
            candidate_fit,
            fit=replace(candidate_fit.fit, point=with_offset(candidate_fit.point, self.discretization_offset)),
        )


def _rivals(one: CandidateFit, best: CandidateFit) -> bool:
    """Whether it has as many effects as the best, and others; what sticks or rattles is slow to fit, and left out."""
    slow = is_nonsmooth(one.effects) and not is_nonsmooth(best.effects)
    return len(one.effects) == len(best.effects) > best.reference_effects and one.names != best.names and not slow


def _never(candidate_fits: Sequence[CandidateFit]) -> bool:
    return False
