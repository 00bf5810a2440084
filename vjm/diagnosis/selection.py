"""What was missing already before a change: looked for in the reference recordings alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.baseline import Base
from vjm.diagnosis.candidate_fit import ADRIFT, Explanation, Extension, Names, named, refit, sized
from vjm.diagnosis.directions import screen
from vjm.diagnosis.encoder_feedback import can_be_held, held, held_at_nominal, released
from vjm.diagnosis.fit_cache import COARSE, NOISE, Job, Tell, Trials, proposal
from vjm.diagnosis.screen import Family, Looked, looked_for
from vjm.diagnosis.workers import ALONE, Workers
from vjm.effects import Effect
from vjm.effects.effect import Key, is_abrupt
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.records import REFERENCE, Rig
from vjm.simulation.initial_state import most_likely
from vjm.simulation.run import Run

LACKING = 1.5  # misfit of the reference recordings from which something was missing before the change
_LOST = 0.3  # share of the motion; a larger residual does not follow it


@dataclass(frozen=True)
class Beginning:
    """Where the search begins.

    Attributes:
        before: the model as it was before any change, beside all training recordings.
        start: the best model without effects, from which effects are looked for.
        lost: whether it does not follow what has changed: then no slope is a guide.
        lacking: misfit of the reference recordings, in units of the noise, that is taken as noise; one: it is noise.
    """

    before: Explanation
    start: Explanation
    lost: bool = False
    lacking: float = 1.0


def beginning(base: Base, plain: Explanation) -> Beginning:
    """From the model of the reference recordings, or of all where there are none.

    Args:
        base: the base fit, and the recordings that it has not.
        plain: the same fit, with what was there before any change.
    """
    if not base.others:
        return Beginning(plain, plain)
    point = plain.point
    lacking = point.misfit if point.misfit > LACKING else 1.0
    problem = point.problem
    known = [_scaled(run, lacking) for run in point.runs]
    others = [replace(each, noise=(lacking * each.noise[0], lacking * each.noise[1])) for each in base.others]
    arms = problem.varied.arms(point.x, [each.recording for each in others])
    new = [run for run, _ in most_likely(arms, others, coarse=problem.coarse)]
    runs = (*known, *new)
    problem = replace(problem, observed=tuple(run.observed for run in runs))
    before = Explanation(TrajectoryFit(Point(problem, point.x, runs), False, 0))
    if any(_lost(run) for run in new):
        return Beginning(before, before, True, lacking)
    start = refit(before, before.effects)
    return Beginning(before, start or before, False, lacking)


def _scaled(run: Run, factor: float) -> Run:
    """The same run with its noise so many times as large."""
    if factor == 1.0:
        return run
    noise = run.observed.noise
    return replace(run, observed=replace(run.observed, noise=(factor * noise[0], factor * noise[1])))


def _lost(run: Run) -> bool:
    """Whether a run does not follow its recording."""
    seen = run.observed
    markers, _ = seen.spread(seen.values - seen.predicted(run.arm, run.steps))
    measured, _ = seen.spread(seen.values)
    motion = np.nanstd(measured, axis=0)
    return bool(np.sqrt(np.nanmean(markers**2)) > _LOST * np.sqrt(np.mean(motion**2)))


Array = NDArray[np.float64]
Step = tuple[Explanation, Sequence[int]]

# Of what something that sticks or rattles explains, the share that a good fit may leave: impacts are not exact.
_ABRUPT_LEAVES = 0.001
_BEST = 8  # candidates refitted a round
FEW = 3  # of them, among which what sticks and slips must be beside other effects
_PAIRS = 4  # pairs refitted that no single step leads to


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
    matters: float = 0.0025
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
        first: the screen beside the model without effects, and its p-values.
        last: the same beside the best explanation.
        p_values: of each effect of the best explanation, when it was added.
        runner_up: the next best of as many effects, where another search found both; None: this one knows.
    """

    best: Explanation
    first: Family
    last: Family
    p_values: dict[Key, float] = field(default_factory=dict)
    runner_up: Explanation | None = None

    @classmethod
    def nothing(cls, start: Explanation, first: Family) -> Found:
        """Before anything was looked for."""
        return cls(start, first, first)


class Search:
    """One search, with all that it has fitted."""

    def __init__(
        self,
        rig: Rig,
        begun: Beginning,
        effects: Sequence[Effect],
        rules: Rules,
        tell: Tell,
        workers: Workers = ALONE,
    ) -> None:
        self.rig = rig
        self.effects = effects
        self.rules = rules
        self.tell = tell
        self.begun = begun
        self.start = begun.start
        self.workers = workers
        self.trials = Trials(rig, begun, tell, workers)
        self.looked = self._looked(self.start)

    def again(self, start: Explanation) -> Search:
        """The same search from another start, which follows the recordings."""
        begun = replace(self.begun, start=start, lost=False)
        return Search(self.rig, begun, self.effects, self.rules, self.tell, self.workers)

    def run(self, begun: Found, ended: Callable[[Found], bool] = lambda found: False) -> Found:
        """Add effects while they are needed.

        Args:
            begun: where to go on.
            ended: whether the search should go no further.
        """
        best, family, p_values = begun.best, begun.last, dict(begun.p_values)
        found = begun
        while len(best.effects) < self.rules.most + len(self.start.effects) and not ended(found):
            needed = self.needed(best, family)
            if not needed:
                break
            trial = self._tried(best, begun.first, family, needed)
            if trial is None or not self._worth(best, trial):
                break
            best = self.trials.sharpen(self.trials.polish(self._without_idle(trial)))
            p_values |= {
                key: min(_p_value(each, key) for each in (family, begun.first)) for key in best.names - p_values.keys()
            }
            family = self.judged(best)
            found = Found(best, begun.first, family, p_values)
        return found

    def _tried(self, best: Explanation, first: Family, family: Family, needed: Sequence[int]) -> Explanation | None:
        """The best explanation with one effect more."""
        steps: list[Step] = [(best, [k]) for k in needed[: None if self.trials.from_afar(best) else _BEST]]
        if best.is_held and not is_abrupt(best.effects):
            # Slopes show little of what sticks or rattles; held, it can be tried.
            chosen = {k for _, (k,) in steps}
            variants = family.seen.one_each(k for k, each in enumerate(family.seen.effects) if each.abrupt)
            steps += [(best, [k]) for k in variants if k not in chosen]
        near = is_abrupt(best.effects) and best.point.misfit < COARSE
        if len(best.effects) == len(self.start.effects) + 1 and not near and not self.trials.from_afar(self.start):
            steps += self._pairs(first, best)
        smooth, abrupt = self._apart(family, first, best, steps)
        if self.trials.footing(best) is not best or best.is_held:
            smooth, abrupt = steps, []  # over first periods only, or held, nothing takes long
        self.race(best, family, first, smooth)
        if not self.trials.explained(len(best.effects) + 1):
            self.race(best, family, first, abrupt)
        return self.trials.best(len(best.effects) + 1)

    def judged(self, explanation: Explanation) -> Family:
        """Candidates beside an explanation."""
        self.tell("looking for what is missing")
        names = explanation.names
        looked = self.looked if explanation is self.start else self._looked(explanation)
        # What sticks and slips is slow to try, and not what could be left where all but noise is explained.
        quick = explanation is not self.start and explanation.point.misfit < NOISE
        kept = [
            k
            for k, variant in enumerate(looked.variants)
            if variant.key not in names and not (quick and variant.abrupt)
        ]
        variants = [looked.variants[k] for k in kept]
        footing = self.trials.footing(explanation)
        seen = screen(footing.point, footing.effects, variants, self.workers)
        return Family.of(seen, looked.times[kept], self.rules.alpha, self.rules.seed)

    def _looked(self, explanation: Explanation) -> Looked:
        """What to look for: a tone where the residuals have one."""
        return looked_for(self.effects, self.rig, self.trials.footing(explanation).point)

    def matters(self, explanation: Explanation) -> float:
        """By how much candidates beside an explanation must lower the chi^2 that they are judged by.

        A share of what noise leaves: much more may be left beside an explanation that lacks something else.
        """
        footing = self.trials.footing(explanation)
        least = self.rules.least(min(footing.chi2, footing.point.count))
        for effect in explanation.effects:
            if effect.abrupt:
                without = self.trials.tried.get(explanation.names - {effect.key}, self.start)
                least = max(least, _ABRUPT_LEAVES * (self.trials.footing(without).chi2 - footing.chi2))
        return least

    def race(self, best: Explanation, family: Family, first: Family, steps: Sequence[Step]) -> None:
        """Refit explanations, giving up those that will not come near the best."""
        jobs = []
        for start, chosen in steps:
            seen = family.seen if start is best else first.seen
            abrupt = any(seen.effects[k].abrupt for k in chosen)
            job = proposal(self.trials.origin(start, abrupt), seen, chosen, self.trials.from_afar(start))
            if len(named(job.effects)) == len(job.effects):
                jobs.append(job)
        self.trials.fit(jobs)

    def replacements(
        self, best: Explanation, others: Sequence[Effect], added: Sequence[Effect], guesses: Sequence[Array]
    ) -> None:
        """Fit explanations in which a cause is replaced, from the best without it.

        Args:
            best: the explanation.
            others: its effects but the cause.
            added: what may stand in its place, one at a time.
            guesses: (s,) how large each must be to do what the cause does, in everyday sizes.
        """
        names, trials = named(others), self.trials
        trials.refresh([names | {effect.key} for effect in added])
        sizes = {k: size for k, size in enumerate(guesses) if names | {added[k].key} not in trials.tried}
        new = [added[k] for k in sizes]
        start = trials.tried.get(names, self.start)
        if new and start.names == names:
            footing, afar = trials.footing(start), trials.from_afar(start)
            seen = screen(footing.point, footing.effects, new, self.workers)
            jobs = [proposal(trials.origin(start, each.abrupt), seen, [k], afar) for k, each in enumerate(new)]
            trials.fit(jobs, every=True)
        elif new:  # the others were never fitted without the cause
            chain = best.point.chain
            trials.fit([Job(best, (*others, sized(added[k], size, chain))) for k, size in sizes.items()], every=True)

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

    def needed(self, best: Explanation, family: Family) -> list[int]:
        """Candidates that are needed beside an explanation, one variant each, the most needed first."""
        seen, least, lost = family.seen, self.matters(best), self.trials.from_afar(best)
        needed = seen.one_each(
            k
            for k in range(len(seen.effects))
            if (lost and not seen.absorbed[k]) or (family.p_values[k] < self.rules.alpha and seen.statistics[k] > least)
        )
        if best is self.start:
            return needed
        # What sticks and slips takes as long to try as all else together: only where it is among the most needed.
        return [k for place, k in enumerate(needed) if place < FEW or not seen.effects[k].abrupt]

    def _pairs(self, first: Family, best: Explanation) -> list[Step]:
        """Pairs that explain most by the first screen, without the best single effect.

        Of several variants, as of a marker that is off, the best may be another beside another effect than alone.
        """
        seen = first.seen
        others = [k for k, effect in enumerate(seen.effects) if effect.key not in best.names]
        scored = [
            (seen.pair(i, j), i, j)
            for n, i in enumerate(others)
            for j in others[:n]
            if seen.effects[i].key != seen.effects[j].key
        ]
        found: dict[Names, list[int]] = {}
        for _, i, j in sorted(scored, reverse=True):
            found.setdefault(frozenset({seen.effects[i].key, seen.effects[j].key}), [i, j])
        return [(self.start, pair) for pair in [*found.values()][:_PAIRS]]

    def _worth(self, fewer: Explanation, more: Explanation) -> bool:
        return fewer.chi2 - more.chi2 > max(self.rules.least(fewer.chi2), self.matters(fewer))

    def _without_idle(self, explanation: Explanation) -> Explanation:
        """Without effects that the others make needless."""
        new = explanation.effects[len(self.start.effects) :]
        for effect in new if len(new) > 1 else ():  # the step to a first effect is judged against the start
            fewer = self.trials.without(explanation, effect, explanation.chi2 * (1 + self.rules.matters))
            if fewer is not None and not self._worth(fewer, explanation):
                return self._without_idle(fewer)
        return explanation


def _p_value(family: Family, key: Key) -> float:
    """The smallest of an effect's variants; one where it was not among the candidates."""
    found = zip(family.seen.effects, family.p_values.tolist(), strict=True)
    return min((p for effect, p in found if effect.key == key), default=1.0)


def whole_search(search: Search, begun: Found) -> tuple[Search, Found]:
    """Look for all that is missing, open loop as far as that is a guide.

    A joint that sticks a moment too early is off for good, so that fits open loop are lost among accidents. What may
    stick and slip is looked for with simulations held; what does not is fitted open loop, which shows more.

    Args:
        search: open loop.
        begun: what it has found so far.

    Returns:
        The search that found the explanation, and where it ended.
    """
    if not can_be_held(search.start):
        return search, search.run(begun)
    found, asked = begun, set[Names]()
    while True:
        found = search.run(found, lambda each: each.best.names not in asked and _may_stick(search, each))
        if found.best.names in asked or not _may_stick(search, found):
            return search, found
        asked.add(found.best.names)
        search.tell("holding the arm near the angles that were measured")
        held_search = _held(search, found)
        if held_search is None:
            continue
        other, beside = held_search
        if _is_needed(other, beside) or _is_adrift(search, found):
            beside = other.run(beside)
            if is_abrupt(beside.best.effects):
                return other, beside
            found = _released(search, found, beside.best, other.trials.runner_up(beside.best))
            asked.add(found.best.names)


def _may_stick(search: Search, found: Found) -> bool:
    """Whether what sticks and slips is among the most needed, or may be hidden where nothing follows the recordings."""
    return bool(search.needed(found.best, found.last)) and (_is_adrift(search, found) or _is_needed(search, found))


def _is_adrift(search: Search, found: Found) -> bool:
    """Whether the search begins where nothing follows the recordings."""
    return found.best is search.start and found.best.point.misfit > ADRIFT


def _is_needed(search: Search, found: Found) -> bool:
    """Whether what sticks and slips is among the most needed."""
    return any(found.last.seen.effects[k].abrupt for k in search.needed(found.best, found.last)[:FEW])


def _held(search: Search, found: Found) -> tuple[Search, Found] | None:
    """The search with simulations held, and what it would have found so far; None where that cannot be simulated."""
    start = held(search.start)
    best = start if found.best is search.start else held(found.best)
    if start is None or best is None:
        return None
    if best is start and start.point.misfit > ADRIFT:
        # Parameters that follow nothing, even held, lead away from what is missing.
        best = start = held_at_nominal(search.start) or start
    other = search.again(start)
    first = other.judged(start)
    if best is start:
        return other, Found.nothing(start, first)
    other.trials.tried[best.names] = best
    return other, Found(best, first, other.judged(best), found.p_values)


def _released(search: Search, found: Found, best: Explanation, runner_up: Explanation | None) -> Found:
    """What was found with simulations held, fitted open loop; what was before where that cannot be simulated."""
    free = None if best.names == found.best.names else released(best, search.start)
    if free is None:
        return found
    search.trials.tried[free.names] = free
    free = search.trials.sharpen(search.trials.polish(free))
    return Found(free, found.first, search.judged(free), found.p_values, runner_up)


_MUCH = Rules(matters=0.3, most=1)  # share of chi^2: what explains less is no better than not to know


def already_there(
    base: Base, effects: Sequence[Effect], rig: Rig, tell: Callable[[str], None], workers: Workers
) -> Explanation:
    """The model of the reference recordings, with the effect that explains much of them, if one does.

    Args:
        base: the model without effects.
        effects: what to look for.
        rig: the arm.
        tell: told what is being done.
        workers: share the work.
    """
    if not base.others or base.point.misfit < LACKING:
        return base.plain
    start = Explanation(replace(base.fit, point=_as(base.point, None)))
    smooth = [effect for effect in effects if not effect.abrupt]
    search = Search(rig, Beginning(start, start), smooth, _MUCH, tell, workers)
    best = search.run(Found.nothing(start, search.judged(start))).best
    if not best.effects:
        return base.plain
    problem = best.point.problem
    extension = Extension(problem.parametrisation, best.effects, everywhere=len(best.effects))
    point = _as(replace(best.point, problem=replace(problem, extension=extension)), REFERENCE)
    return Explanation(replace(best.fit, point=point))


def _as(point: Point, condition: str | None) -> Point:
    """The same with its recordings in another condition."""
    runs = tuple(
        replace(run, observed=replace(run.observed, recording=replace(run.observed.recording, condition=condition)))
        for run in point.runs
    )
    return replace(point, runs=runs, problem=replace(point.problem, observed=tuple(run.observed for run in runs)))


def told(base: Base, known: Explanation, lacking: float) -> str:
    """What the reference recordings show already, as a sentence; empty where it is nothing but noise."""
    if base.point.misfit < LACKING or not base.others:
        return ""
    noise = 1e3 * base.point.runs[0].observed.noise[0]
    said = (
        f"already in the reference recordings the model misses by {base.point.misfit * noise:.2g} mm, "
        f"{base.point.misfit:.3g} times the noise: present before the change, and not counted as one"
    )
    if not known.effects:
        return f"{said}; no single candidate explains it"
    effect = known.effects[0]
    values = ", ".join(f"{name} {value:.3g}" for name, value in effect.values.items())
    return f"{said}; {effect.id} ({values}) explains it down to {lacking * noise:.2g} mm and is part of both models"
