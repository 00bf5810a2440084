"""The search for what is missing: screens, refits of the best few, pairs as well as single steps, drops."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.beginning import Beginning
from vjm.diagnosis.candidates import Family, Looked
from vjm.diagnosis.coarseness import CLOSE, beside, coarseness, corrected
from vjm.diagnosis.extension import Extension
from vjm.diagnosis.race import Job, begun_with, finished, proposal
from vjm.diagnosis.refit import Explanation, refit
from vjm.diagnosis.screen import Screen, screen
from vjm.effects import Effect
from vjm.experiment.records import Rig

Array = NDArray[np.float64]
Tell = Callable[[str], None]
Key = tuple[str, int | None]
Step = tuple[Explanation, Sequence[int]]

_BEST = 8  # candidates refitted a round
_PAIRS = 4  # pairs refitted that no single step leads to
_NOISE = 1.02  # misfit that leaves nothing to explain


@dataclass(frozen=True)
class Rules:
    """When a search goes on.

    Attributes:
        alpha: chance that any effect is found where there is none.
        matters: by how much chi^2 must fall for an effect to matter, as a share of what is left then.
        most: number of effects at most.
        seed: of what is drawn.
    """

    alpha: float = 0.01
    matters: float = 0.008
    most: int = 3
    seed: int = 0

    def least(self, chi2: float) -> float:
        """By how much chi^2 must fall from there."""
        return chi2 * self.matters / (1 + self.matters)


@dataclass(frozen=True)
class Found:
    """Where a search ended.

    Attributes:
        best: the explanation.
        tried: every explanation that was fitted, by what is in it; hopeless ones not to their end.
        first: the screen beside the model without effects, and its p-values.
        last: the same beside the best explanation.
        p_values: of each effect of the best explanation, when it was added.
    """

    best: Explanation
    tried: dict[frozenset[Key], Explanation]
    first: Family
    last: Family
    p_values: dict[Key, float] = field(default_factory=dict)


class Search:
    """One search, with all that it has fitted."""

    def __init__(
        self,
        rig: Rig,
        begun: Beginning,
        looked: Looked,
        rules: Rules,
        tell: Tell,
        executor: Executor | None = None,
        workers: int = 1,
    ) -> None:
        self.rig = rig
        self.looked = looked
        self.rules = rules
        self.tell = tell
        self.executor = executor
        self.workers = workers
        self.begun = begun
        self.start = begun.start
        self.tried: dict[frozenset[Key], Explanation] = {begun.start.names: begun.start}
        self.stale: set[frozenset[Key]] = set()  # fitted before the chain's coarseness was known
        self.surplus: list[Array] | None = None

    def run(self, first: Family) -> Found:
        """Add effects while they are needed.

        Args:
            first: the candidates beside the start.
        """
        best, p_values, family = self.start, dict[Key, float](), first
        while len(best.effects) < self.rules.most + len(self.start.effects):
            needed = self._needed(best, family)
            if not needed:
                break
            steps: list[Step] = [(best, [k]) for k in needed[: None if self.begun.lost else _BEST]]
            if len(best.effects) == len(self.start.effects) + 1 and not self.begun.lost:
                steps += self._pairs(first, best)
            smooth, abrupt = self._apart(family, first, best, steps)
            self.race(best, family, first, smooth)
            if not self._explained(len(best.effects) + 1):
                self.race(best, family, first, abrupt)
            trial = self._best(len(best.effects) + 1)
            if trial is None or not self._worth(best, trial):
                break
            best = self._sharpened(self._polished(self._without_idle(trial)))
            p_values |= {
                key: min(_p_value(each, key) for each in (family, first)) for key in best.names - p_values.keys()
            }
            family = self.judged(best)
        return Found(best, self.tried, first, family, p_values)

    def _apart(
        self, family: Family, first: Family, best: Explanation, steps: Sequence[Step]
    ) -> tuple[list[Step], list[Step]]:
        """Steps that are quickly fitted, and those with what sticks and slips."""
        smooth: list[Step] = []
        abrupt: list[Step] = []
        for start, chosen in steps:
            seen = family.seen if start is best else first.seen
            (abrupt if any(seen.effects[k].abrupt for k in chosen) else smooth).append((start, chosen))
        return smooth, abrupt

    def _explained(self, count: int) -> bool:
        """Whether so many effects leave nothing but noise."""
        found = self._best(count)
        return found is not None and found.point.misfit < _NOISE

    def judged(self, explanation: Explanation) -> Family:
        """Candidates beside an explanation."""
        self.tell("looking for what is missing")
        names = explanation.names
        # What sticks and slips is slow to try, and not what could be left where all but noise is explained.
        quick = explanation is not self.start and explanation.point.misfit < _NOISE
        kept = [
            k
            for k, variant in enumerate(self.looked.variants)
            if _key(variant) not in names and not (quick and variant.abrupt)
        ]
        variants = [self.looked.variants[k] for k in kept]
        seen = screen(explanation.point, explanation.effects, variants)
        return Family.of(seen, self.looked.times[kept], self.rules.alpha, self.rules.seed)

    def race(self, best: Explanation, family: Family, first: Family, steps: Sequence[Step]) -> None:
        """Refit explanations, giving up those that will not come near the best."""
        jobs = []
        for start, chosen in steps:
            seen = family.seen if start is best else first.seen
            job = proposal(self._beside(start), seen, chosen, self.begun.lost and start is self.start)
            names = frozenset(_key(effect) for effect in job[1])
            if names not in self.tried and len(names) == len(job[1]):
                jobs.append((names, job))
        self._fit(jobs)

    def replacements(self, others: Sequence[Effect], added: Sequence[Effect]) -> None:
        """Fit explanations in which a cause is replaced, from the best without it.

        Args:
            others: the explanation's effects but the cause.
            added: what may stand in its place, one at a time.
        """
        names = frozenset(_key(effect) for effect in others)
        start = self.tried.get(names, self.start)
        self._refreshed([names | {_key(effect)} for effect in added])
        new = [effect for effect in added if names | {_key(effect)} not in self.tried]
        if new:
            seen = screen(start.point, start.effects, new)
            lost, start = self.begun.lost and start is self.start, self._beside(start)
            self._fit([(names | {_key(effect)}, proposal(start, seen, [k], lost)) for k, effect in enumerate(new)])

    def _refreshed(self, wanted: Sequence[frozenset[Key]]) -> None:
        """Fit again what was fitted before the chain's coarseness was known."""
        for names in self.stale.intersection(wanted):
            known = self._beside(self.tried[names])
            own = [effect.coordinates[: effect.sizes] for effect in known.effects]
            found = refit(known, known.effects, own)
            if found is not None:
                self.tried[names] = found
        self.stale.difference_update(wanted)

    def _beside(self, explanation: Explanation) -> Explanation:
        """An explanation beside what is known of the chain's coarseness."""
        if self.surplus is None or explanation.names not in self.stale:
            return explanation
        fit = replace(explanation.fit, point=beside(explanation.point, self.surplus))
        return replace(explanation, fit=fit)

    def _fit(self, jobs: Sequence[tuple[frozenset[Key], Job]]) -> None:
        """A few steps for each; then to the end for those that may be the best, the most promising first."""
        self.tell("trying " + ", ".join(sorted({name for names, _ in jobs for name, _ in names})))
        if not jobs:
            return
        begun = [found for found in self._map(begun_with, [job for _, job in jobs]) if found is not None]
        begun.sort(key=lambda each: each.chi2)
        record = min((each.chi2 for each in begun), default=np.inf)
        for first in range(0, len(begun), self.workers):
            together = begun[first : first + self.workers]
            self.tell("fitting " + " and ".join(sorted({name for each in together for name, _ in each.names})))
            for found in self._map(partial(finished, record=record), together):
                if found is not None:
                    self.tried[found.names] = found
                    record = min(record, found.chi2)

    def _map(self, work: Callable[..., Explanation | None], jobs: Sequence[object]) -> list[Explanation | None]:
        if self.executor is None or len(jobs) < 2:
            return [work(job) for job in jobs]
        return [*self.executor.map(work, jobs)]

    def _needed(self, best: Explanation, family: Family) -> list[int]:
        """Candidates that are needed beside an explanation, one variant each, the most needed first."""
        seen = family.seen
        least = self.rules.least(best.chi2)
        lost = self.begun.lost and best is self.start
        needed = [
            k
            for k in range(len(seen.effects))
            if (lost and not seen.absorbed[k]) or (family.p_values[k] < self.rules.alpha and seen.statistics[k] > least)
        ]
        return one_each(seen, needed) if needed else []

    def _pairs(self, first: Family, best: Explanation) -> list[Step]:
        """Pairs that explain most by the first screen, without the best single effect."""
        seen = first.seen
        alone = [k for k in one_each(seen, range(len(seen.effects))) if _key(seen.effects[k]) not in best.names]
        scored = [(seen.pair(i, j), i, j) for n, i in enumerate(alone) for j in alone[:n]]
        scored.sort(reverse=True)
        return [(self.start, [i, j]) for _, i, j in scored[:_PAIRS]]

    def _best(self, count: int) -> Explanation | None:
        found = [each for each in self.tried.values() if len(each.effects) == count]
        return min(found, key=lambda each: each.chi2, default=None)

    def _worth(self, fewer: Explanation, more: Explanation) -> bool:
        return fewer.chi2 - more.chi2 > self.rules.least(fewer.chi2)

    def _polished(self, explanation: Explanation) -> Explanation:
        """Fitted to the very end, unless that is of no use."""
        if explanation.fit.converged or any(effect.abrupt for effect in explanation.effects):
            return explanation
        own = [effect.coordinates[: effect.sizes] for effect in explanation.effects]
        found = refit(explanation, explanation.effects, own)
        if found is None or found.chi2 > explanation.chi2:
            return explanation
        self.tried[found.names] = found
        return found

    def _sharpened(self, explanation: Explanation) -> Explanation:
        """Once it follows the recordings, with its chain's coarseness known, which all later fits know too."""
        if explanation.point.misfit > CLOSE or any(effect.abrupt for effect in explanation.effects):
            return explanation
        self.tell("asking what more virtual joints would show")
        found = coarseness(explanation.point, self.rig)
        if found is None:
            return explanation
        fit = corrected(explanation.fit, found)
        extension = fit.point.problem.extension
        effects = extension.present(fit.point.x) if isinstance(extension, Extension) else ()
        known = Explanation(effects, fit, found.shift)
        self.surplus, self.stale = [*found.surplus], {*self.tried} - {known.names}
        self.tried[known.names] = known
        return known

    def _without_idle(self, explanation: Explanation) -> Explanation:
        """Without effects that the others make needless."""
        for effect in explanation.effects[len(self.start.effects) :]:
            names = explanation.names - {_key(effect)}
            if names in self.tried and self.tried[names].point.misfit < CLOSE:
                self._refreshed([names])
            fewer = self.tried.get(names)
            if fewer is not None and fewer is not self.start and not self._worth(fewer, explanation):
                return self._without_idle(fewer)
        return explanation


def _key(effect: Effect) -> Key:
    return effect.id, effect.link


def _p_value(family: Family, key: Key) -> float:
    """The smallest of an effect's variants; one where it was not among the candidates."""
    found = zip(family.seen.effects, family.p_values.tolist(), strict=True)
    return min((p for effect, p in found if _key(effect) == key), default=1.0)


def one_each(seen: Screen, chosen: Sequence[int]) -> list[int]:
    """Of several variants of one effect at one place the one that explains most; the most needed first."""
    best: dict[Key, int] = {}
    for k in sorted(chosen, key=lambda k: -seen.statistics[k]):
        best.setdefault(_key(seen.effects[k]), k)
    return list(best.values())
