"""Fits that race: a few steps of each explanation, the promising ones to their end, the hopeless ones given up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.refit import Explanation, refit, sized
from vjm.diagnosis.screen import Screen
from vjm.effects import Effect
from vjm.effects.effect import is_abrupt
from vjm.identification.trajectory_problem import Point, TrajectoryProblem

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
