"""Explanations that were fitted, each beside the same knowledge of what the chain's coarseness does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.candidate_fit import (
    Explanation,
    Names,
    anew,
    is_astray,
    named,
    of_beginnings,
    refit,
    shortened,
    sized,
)
from vjm.diagnosis.discretization import CLOSE, beside, coarseness, corrected
from vjm.diagnosis.screen import Screen
from vjm.diagnosis.selection import Beginning
from vjm.diagnosis.workers import Workers
from vjm.effects import Effect
from vjm.effects.effect import is_abrupt
from vjm.identification.trajectory_fit import Point, TrajectoryProblem
from vjm.records import Rig

Array = NDArray[np.float64]
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
class Job:
    """A refit to try.

    Attributes:
        start: the explanation to begin with.
        effects: those wanted, with the parameters from which their search starts.
    """

    start: Explanation
    effects: tuple[Effect, ...]


def proposal(start: Explanation, seen: Screen, chosen: Sequence[int], from_afar: bool = False) -> Job:
    """An explanation with further effects, of sizes that a screen guesses.

    Args:
        start: the explanation.
        seen: the screen.
        chosen: of its effects.
        from_afar: whether the start is no guide: then sizes are everyday ones.
    """
    added = [seen.effects[k] for k in chosen]
    guess = np.ones(sum(effect.sizes for effect in added)) if from_afar else seen.guess(chosen)
    stops = np.cumsum([effect.sizes for effect in added])
    new = [
        sized(effect, guess[stop - effect.sizes : stop], start.point.chain)
        for stop, effect in zip(stops, added, strict=True)
    ]
    return Job(start, (*start.effects, *new))


def begun_with(job: Job, whole: float, record: float = np.inf) -> Explanation | None:
    """A refit's first steps; of recordings' beginnings, as many as may still make it one of the best.

    Args:
        job: the refit.
        whole: duration of the longest recording [s].
        record: chi^2 of the best beside the beginnings so far.
    """
    abrupt = is_abrupt(job.effects)
    if is_short(job.start, whole):
        return refit(job.start, job.effects, Patience(_MOST_SHORT_STEPS, _FAR**2 * record, abrupt))
    # Held, a fit goes where its steps point; open loop, what a step promises may be far from what it does.
    most = _MOST_FIRST_STEPS if job.start.is_held else FIRST_STEPS
    return refit(job.start, job.effects, Patience(FIRST_STEPS, abrupt=abrupt, most=most))


def is_short(explanation: Explanation, whole: float) -> bool:
    """Whether it is of the recordings' beginnings only."""
    return explanation.point.problem.longest < whole


def near_noise(begun: Explanation, whole: float, fewer: Explanation) -> bool:
    """Whether so little is left that its fit is worth ending before others are tried.

    Args:
        begun: the fit.
        whole: duration of the longest recording [s].
        fewer: the best with fewer effects.
    """
    short = is_short(begun, whole)
    little = begun.point.misfit < (_EXPLAINED if short or begun.is_held else _LITTLE)
    return little or (not short and explains_nearly_all(begun, fewer))


def explains_nearly_all(explanation: Explanation, fewer: Explanation) -> bool:
    """Whether it leaves next to nothing of what another with fewer effects lacked: what is left is for further ones."""
    lacked, lacks = (max(each.point.misfit**2 - 1.0, 0.0) for each in (fewer, explanation))
    return explanation.point.misfit < _LITTLE and lacks < _REST * lacked


def promising(begun: Sequence[Explanation], whole: float) -> list[Explanation]:
    """The best first; of those that were tried on the recordings' beginnings, the ones that may be best in the end.

    Of those that explain nothing, a few at most.
    """
    ordered = sorted(begun, key=lambda each: each.point.misfit)
    short = [each for each in ordered if is_short(each, whole)]
    if short:
        best = short[0].point.misfit
        near = sum(each.point.misfit < _NEAR * max(best, 1.0) for each in short)
        short = short[: near if best < _EXPLAINED else min(near, _KEPT)]
    least = min((each.point.misfit for each in begun), default=np.inf)
    long = [each for each in ordered if not is_short(each, whole) and each.point.misfit < _HOPELESS * least]
    kept = [*(long if not long or long[0].follows else long[:_KEPT]), *short]
    return sorted(kept, key=lambda each: each.point.misfit)


def finished(begun: Explanation, record: float, whole: TrajectoryProblem) -> Explanation | None:
    """A refit to its end; given up once it will not come near the record.

    Args:
        begun: where it has come to.
        record: chi^2 of the best so far.
        whole: all of the recordings.
    """
    short, abrupt = is_short(begun, whole.longest), is_abrupt(begun.effects)
    if begun.fit.converged and not short:
        return begun
    if not short and is_hopeless(begun, record):
        return begun
    enough = _ABRUPT_GAINED if abrupt else _GAINED
    patience = Patience(np.inf, record, abrupt, enough, rough=begun.is_held and not abrupt)
    return refit(begun, begun.effects, patience, whole=whole if short else None)


def is_hopeless(begun: Explanation, record: float) -> bool:
    """Whether what another step promises, if that is known, is far from a record (chi^2).

    A fit that does not follow the recordings begins again with their beginnings, where more may be promised.
    """
    return begun.follows and Patience(np.inf, record)(begun.point, begun.fit.promised)


class Patience:
    """Ends a fit after some steps, or when it will not come near a record, or when it is wrong and as good as done.

    Where something sticks and slips, or little is followed, slopes are only roughly a guide: once many steps have
    gained little, none will.

    Args:
        steps: after which it ends.
        record: chi^2 that it must come near.
        abrupt: whether something sticks and slips.
        enough: share of chi^2 below which some steps have gained enough.
        most: steps, as long as the next one promises much.
        rough: whether it need not be fitted to its very end, as what is held and will be fitted open loop.
    """

    def __init__(
        self,
        steps: float,
        record: float = np.inf,
        abrupt: bool = False,
        enough: float = _GAINED,
        most: float = 0.0,
        rough: bool = False,
    ) -> None:
        self.steps = steps
        self.rough = rough
        self.most = most
        self.record = record
        self.abrupt = abrupt
        self.enough = enough
        self.seen: list[float] = []

    def __call__(self, point: Point, predicted: float) -> bool:
        """Whether to end it where it is, given by how much its next step may lower chi^2."""
        self.seen.append(point.chi2)
        share = predicted / point.chi2
        steps = self.steps if share < _MUCH else max(self.steps, self.most)
        done = any(point.misfit > misfit and share < little for misfit, little in _DONE)
        done = done or (self.rough and share < _ROUGHLY)
        slow = self.abrupt or point.misfit > OFF
        stuck = slow and len(self.seen) > _STUCK and point.chi2 > self.enough * self.seen[-_STUCK]
        return len(self.seen) > steps or done or stuck or point.chi2 - _MARGIN * predicted > self.record + 5 * ALIKE


NOISE = 1.02  # misfit that leaves nothing to explain
COARSE = 1.15  # the same as long as the chain's coarseness is not known; what leaves more is not the end of a search
Tell = Callable[[str], None]
Enough = Callable[[Sequence[Explanation]], bool]


class Trials:
    """All that a search has fitted, by the names of the effects.

    Attributes:
        start: the explanation from which effects are looked for.
        lost: whether it does not follow what has changed.
        tried: explanations; hopeless ones not to their end.
        stale: those that do not know what `surplus` says.
        surplus: what more virtual joints would show, for each recording; None: not known yet.
    """

    def __init__(self, rig: Rig, begun: Beginning, tell: Tell, workers: Workers) -> None:
        self.rig = rig
        self.start = begun.start
        self.lost = begun.lost
        self.tell = tell
        self.workers = workers
        self.tried: dict[Names, Explanation] = {begun.start.names: begun.start}
        self.stale: set[Names] = set()
        self.surplus: tuple[Array, ...] | None = None
        self._begun: dict[Names, Explanation] = {}
        self._footings: dict[Names, Explanation] = {}
        self._origins: dict[Names, Explanation] = {}

    def footing(self, explanation: Explanation) -> Explanation:
        """Where slopes tell what is missing: where it does not follow the recordings, at their beginnings."""
        if self.from_afar(explanation) or explanation.follows:
            return explanation
        if explanation.names not in self._footings:
            self._footings[explanation.names] = shortened(explanation)
        return self._footings[explanation.names]

    def origin(self, explanation: Explanation, abrupt: bool = False) -> Explanation:
        """Where fits with further effects begin: the recordings' beginnings, where its own parameters are no guide.

        Args:
            explanation: the effects that are there.
            abrupt: whether a further one sticks or rattles, which is found from wherever slopes lead.
        """
        far = self.from_afar(explanation)
        if not far and (abrupt or not is_astray(explanation)):
            return self.footing(explanation)
        if explanation.names not in self._origins:
            self._origins[explanation.names] = of_beginnings(explanation) if far else anew(explanation)
        return self._origins[explanation.names]

    def from_afar(self, explanation: Explanation) -> bool:
        """Whether nothing is a guide from there."""
        return self.lost and explanation is self.start

    def best(self, count: int) -> Explanation | None:
        """The best explanation of so many effects."""
        found = [each for each in self.tried.values() if len(each.effects) == count]
        return min(found, key=lambda each: each.chi2, default=None)

    def runner_up(self, best: Explanation) -> Explanation | None:
        """The next best explanation of as many effects; None where nothing else was tried, or nothing is explained.

        Where the best left nothing, so that no other was fitted to its end, the most promising one is now.
        """
        tried, begun = ([each for each in some.values() if _rivals(each, best)] for some in (self.tried, self._begun))
        if not tried and begun:
            self.tell("fitting the next best")
            most = min(begun, key=lambda each: each.point.misfit)
            found = finished(most, np.inf, self._beside(self.start).point.problem)
            tried = [] if found is None else [found]
        return min(tried, key=lambda each: each.chi2, default=None)

    def fit(self, jobs: Sequence[Job], every: bool = False) -> None:
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
        begun: list[Explanation] = []
        while pending:
            together, pending = pending[: self.workers.count], pending[self.workers.count :]
            record = min((each.chi2 for each in begun if is_short(each, whole.longest)), default=np.inf)
            found = self.workers.map(partial(begun_with, whole=whole.longest, record=record), together)
            new = [each for each in found if each is not None]
            begun += new
            self._begun |= {each.names: each for each in new}
            near = [each for each in new if near_noise(each, whole.longest, self._fewer(each))]
            near.sort(key=lambda each: each.chi2)
            if enough(self._finish(near, whole, enough)):
                return
        rest = [each for each in promising(begun, whole.longest) if each.names not in self.tried]
        self._finish(rest, whole, enough)

    def _finish(self, begun: Sequence[Explanation], whole: TrajectoryProblem, enough: Enough) -> list[Explanation]:
        """Fits to their end, as long as they may be the best of so many effects."""
        known = [each.chi2 for each in self.tried.values() if begun and len(each.effects) == len(begun[0].effects)]
        record = min([*known, *(each.chi2 for each in begun if not is_short(each, whole.longest))], default=np.inf)
        ended: list[Explanation] = []
        waiting = [*begun]
        while waiting:
            # What explains all so far is waited for alone: others beside it may take far longer.
            count = 1 if enough(waiting[:1]) else self.workers.count
            together, waiting = waiting[:count], waiting[count:]
            self.tell("fitting " + " and ".join(sorted({name for each in together for name, _ in each.names})))
            found = self.workers.map(partial(finished, record=record, whole=whole), together)
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

    def without(self, explanation: Explanation, effect: Effect, record: float) -> Explanation | None:
        """The same explanation without one of its effects, fitted again; None where that cannot be simulated.

        Args:
            explanation: the explanation.
            effect: one of its effects.
            record: chi^2 of no interest beyond; the fit is given up once it will not come near.
        """
        names = explanation.names - {effect.key}
        known = self.tried.get(names)
        # A fit that is worse than one of fewer effects has lost its way.
        astray = known is not None and any(
            each.names < names and each.chi2 < known.chi2 for each in self.tried.values()
        )
        far = known is not None and not astray and (known.point.misfit > CLOSE or known.chi2 > 2 * record)
        # Also what was fitted before may be fitted better from here.
        kept = tuple(each for each in explanation.effects if each is not effect)
        steps = FIRST_STEPS if far else np.inf
        found = refit(explanation, kept, Patience(steps, record, is_abrupt(kept)))
        if far and known is not None and found is not None and found.chi2 < known.chi2:
            patience = Patience(np.inf, record, is_abrupt(kept))
            found = found if is_hopeless(found, record) else refit(found, kept, patience)
        if found is None or (known is not None and names not in self.stale and known.chi2 < found.chi2):
            return known
        self.tried[names] = found
        self.stale.discard(names)
        return self.tried[names]

    def _explained(self, explanations: Sequence[Explanation]) -> bool:
        """Whether one of them leaves nothing but noise, and what the chain's coarseness may; or next to nothing."""
        least = COARSE if self.surplus is None else NOISE
        return any(each.point.misfit < least or explains_nearly_all(each, self._fewer(each)) for each in explanations)

    def _fewer(self, explanation: Explanation) -> Explanation:
        """The best with fewer effects."""
        count = len(explanation.effects)
        found = [each for each in self.tried.values() if len(each.effects) < count]
        return min(found, key=lambda each: each.chi2, default=self.start)

    def refresh(self, wanted: Sequence[Names]) -> None:
        """Fit again what was fitted before the chain's coarseness was known."""
        for names in self.stale.intersection(wanted):
            known = self._beside(self.tried[names])
            found = refit(known, known.effects)
            if found is not None:
                self.tried[names] = found
        self.stale.difference_update(wanted)

    def polish(self, explanation: Explanation) -> Explanation:
        """Fitted to the very end, unless that is of no use."""
        if explanation.fit.converged or explanation.point.misfit > COARSE:
            return explanation
        if explanation.is_held or is_abrupt(explanation.effects):
            return explanation  # it is fitted open loop in the end, or was fitted as far as that leads anywhere
        found = refit(explanation, explanation.effects)
        if found is None or found.chi2 > explanation.chi2:
            return explanation
        self.tried[found.names] = found
        return found

    def sharpen(self, explanation: Explanation) -> Explanation:
        """Once it follows the recordings, with its chain's coarseness known, which all later fits know too.

        Held simulations show little of it, and what they find is fitted open loop where that is possible.
        """
        if explanation.is_held or explanation.point.misfit > CLOSE or is_abrupt(explanation.effects):
            return explanation
        self.tell("asking what more virtual joints would show")
        rough = explanation.point.misfit > COARSE
        found = coarseness(explanation.point, self.rig, rough)
        if found is None:
            return explanation
        known = Explanation(corrected(explanation.fit, found, rough), found.shift)
        self.surplus, self.stale = found.surplus, {*self.tried} - {known.names}
        self._footings.clear()
        self._origins.clear()
        self.tried[known.names] = known
        return known

    def _known(self, start: Explanation) -> Explanation:
        """The start of a fit; short ones are good enough as they are."""
        return start if is_short(start, self.start.point.problem.longest) else self._beside(start)

    def _beside(self, explanation: Explanation) -> Explanation:
        """An explanation beside what is known of the chain's coarseness."""
        if self.surplus is None or explanation.names not in self.stale:
            return explanation
        return replace(explanation, fit=replace(explanation.fit, point=beside(explanation.point, self.surplus)))


def _rivals(one: Explanation, best: Explanation) -> bool:
    """Whether it has as many effects as the best, and others; what sticks or rattles is slow to fit, and left out."""
    slow = is_abrupt(one.effects) and not is_abrupt(best.effects)
    return len(one.effects) == len(best.effects) > best.everywhere and one.names != best.names and not slow


def _never(explanations: Sequence[Explanation]) -> bool:
    return False
