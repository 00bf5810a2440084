"""Selection of effects: forward steps by score tests and refits, with backward elimination, until nothing is needed.

Each round screens the candidates beside the best model, refits the most significant, and keeps the best if it lowers
chi^2 by more than chance and by more than matters. Joints that stick, slip or rattle are looked for with simulations
held near the encoders' angles. The same search in the reference recordings alone finds what was there before a change.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vjm.diagnosis.baseline import Baseline, SearchStart
from vjm.diagnosis.candidate_fit import (
    DIVERGED_MISFIT,
    INCOMPLETE,
    CandidateFit,
    Extension,
    Names,
    named,
)
from vjm.diagnosis.encoder_feedback import (
    feedback_possible,
    fit_open_loop,
    fit_with_feedback,
    nominal_with_feedback,
)
from vjm.diagnosis.fit_cache import COARSE, NOISE, FitCache, FitJob, Tell
from vjm.diagnosis.screen import ALONE, CandidateSet, FamilyTest, Screen, Workers
from vjm.effects import Effect
from vjm.effects.effect import Key, is_nonsmooth
from vjm.identification.trajectory_fit import Point
from vjm.records import REFERENCE, Array, Rig

Step = tuple[CandidateFit, Sequence[int]]

# Share of the decrease of chi^2 by stick-slip or play that a good fit may leave: impacts are not exact.
_NONSMOOTH_REST = 0.001
_BEST = 8  # candidates refitted a round
FEW = 3  # candidates refitted a round among which stick-slip must be beside other effects
_PAIRS = 4  # pairs refitted that no single step leads to


@dataclass(frozen=True)
class Rules:
    """Rules by which a search goes on.

    Attributes:
        alpha: significance level of the search as a whole.
        matters: decrease of chi^2 from which an effect matters, as a share of what remains.
        most: number of effects at most.
        seed: of random numbers.
    """

    alpha: float = 0.01
    matters: float = 0.0025
    most: int = 3
    seed: int = 0

    def least(self, chi2: float) -> float:
        """Return the decrease of chi^2 from which an effect matters."""
        return chi2 * self.matters / (1 + self.matters)


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Attributes:
        best: the best model.
        first: the screen beside the model without effects, and its p-values.
        last: the same beside the best model.
        p_values: of each effect of the best model, when it was added.
        next_best: the next best of as many effects, where another search found both; None: this one knows.
    """

    best: CandidateFit
    first: FamilyTest
    last: FamilyTest
    p_values: dict[Key, float] = field(default_factory=dict)
    next_best: CandidateFit | None = None

    @classmethod
    def nothing(cls, start: CandidateFit, first: FamilyTest) -> SearchResult:
        """Return the result before anything was looked for."""
        return cls(start, first, first)


class Search:
    """Search for effects, with all that it has fitted."""

    def __init__(
        self,
        rig: Rig,
        search_start: SearchStart,
        effects: Sequence[Effect],
        rules: Rules,
        tell: Tell,
        workers: Workers = ALONE,
    ) -> None:
        self.rig = rig
        self.effects = effects
        self.rules = rules
        self.tell = tell
        self.search_start = search_start
        self.start = search_start.start
        self.workers = workers
        self.trials = FitCache(rig, search_start, tell, workers)
        self.candidate_set = self._candidates(self.start)

    def restarted(self, start: CandidateFit) -> Search:
        """Return the same search from another start, which follows the recordings."""
        search_start = replace(self.search_start, start=start, diverges_from_data=False)
        return Search(self.rig, search_start, self.effects, self.rules, self.tell, self.workers)

    def run(self, so_far: SearchResult, ended: Callable[[SearchResult], bool] = lambda found: False) -> SearchResult:
        """Add effects while they are needed.

        Args:
            so_far: where to go on.
            ended: whether the search should go no further.
        """
        best, family, p_values = so_far.best, so_far.last, dict(so_far.p_values)
        found = so_far
        while len(best.effects) < self.rules.most + len(self.start.effects) and not ended(found):
            needed = self.needed(best, family)
            if not needed:
                break
            trial = self._best_addition(best, so_far.first, family, needed)
            if trial is None or not self._worth(best, trial):
                break
            best = self.trials.correct_discretization(self.trials.converge(self._without_idle(trial)))
            p_values |= {
                key: min(_p_value(each, key) for each in (family, so_far.first)) for key in best.names - p_values.keys()
            }
            family = self.screen(best)
            found = SearchResult(best, so_far.first, family, p_values)
        return found

    def _best_addition(
        self, best: CandidateFit, first: FamilyTest, family: FamilyTest, needed: Sequence[int]
    ) -> CandidateFit | None:
        """Best model with one effect more."""
        steps: list[Step] = [(best, [k]) for k in needed[: None if self.trials.screen_unreliable(best) else _BEST]]
        if best.uses_feedback and not is_nonsmooth(best.effects):
            # Derivatives show little of stick-slip and play; with encoder feedback they can be tried.
            chosen = {k for _, (k,) in steps}
            variants = family.screen.one_each(k for k, each in enumerate(family.screen.effects) if each.nonsmooth)
            steps += [(best, [k]) for k in variants if k not in chosen]
        near = is_nonsmooth(best.effects) and best.misfit < COARSE
        if (
            len(best.effects) == len(self.start.effects) + 1
            and not near
            and not self.trials.screen_unreliable(self.start)
        ):
            steps += self._pairs(first, best)
        smooth, nonsmooth = self._apart(family, first, best, steps)
        if self.trials.linearization_point(best) is not best or best.uses_feedback:
            smooth, nonsmooth = steps, []  # over first periods only, or with feedback, nothing takes long
        self.refit_candidates(best, family, first, smooth)
        if not self.trials.explained(len(best.effects) + 1):
            self.refit_candidates(best, family, first, nonsmooth)
        return self.trials.best(len(best.effects) + 1)

    def screen(self, candidate_fit: CandidateFit) -> FamilyTest:
        """Test the candidates beside a model."""
        self.tell("looking for what is missing")
        names = candidate_fit.names
        candidate_set = self.candidate_set if candidate_fit is self.start else self._candidates(candidate_fit)
        # Stick-slip is slow to try, and cannot be what remains where all but noise is explained.
        quick = candidate_fit is not self.start and candidate_fit.misfit < NOISE
        kept = [
            k
            for k, variant in enumerate(candidate_set.variants)
            if variant.key not in names and not (quick and variant.nonsmooth)
        ]
        variants = [candidate_set.variants[k] for k in kept]
        linearization_point = self.trials.linearization_point(candidate_fit)
        screened = Screen.of(linearization_point.point, linearization_point.effects, variants, self.workers)
        return FamilyTest.of(screened, candidate_set.multiplicity[kept], self.rules.alpha, self.rules.seed)

    def _candidates(self, candidate_fit: CandidateFit) -> CandidateSet:
        """Candidates, with tones where the residuals have peaks."""
        return CandidateSet.of(self.effects, self.rig, self.trials.linearization_point(candidate_fit).point)

    def least_decrease(self, candidate_fit: CandidateFit) -> float:
        """Return the decrease of the chi^2 they are tested by from which candidates beside a model matter.

        It is a share of the noise: a model that lacks something else may leave much more.
        """
        linearization_point = self.trials.linearization_point(candidate_fit)
        least = self.rules.least(min(linearization_point.chi2, linearization_point.point.count))
        for effect in candidate_fit.effects:
            if effect.nonsmooth:
                without = self.trials.tried.get(candidate_fit.names - {effect.key}, self.start)
                least = max(
                    least, _NONSMOOTH_REST * (self.trials.linearization_point(without).chi2 - linearization_point.chi2)
                )
        return least

    def refit_candidates(
        self, best: CandidateFit, family: FamilyTest, first: FamilyTest, steps: Sequence[Step]
    ) -> None:
        """Refit models, giving up those that will not come near the best."""
        jobs = []
        for start, chosen in steps:
            job = self.trials.job(start, (family if start is best else first).screen, chosen)
            if len(named(job.effects)) == len(job.effects):
                jobs.append(job)
        self.trials.fit(jobs)

    def replacements(
        self, best: CandidateFit, others: Sequence[Effect], added: Sequence[Effect], guesses: Sequence[Array]
    ) -> None:
        """Fit models in which a cause is replaced, from the best without it.

        Args:
            best: the best model.
            others: its effects but the cause.
            added: what may stand in its place, one at a time.
            guesses: (s,) how large each must be to do what the cause does, in typical magnitudes.
        """
        names, trials = named(others), self.trials
        trials.refresh([names | {effect.key} for effect in added])
        sizes = {k: size for k, size in enumerate(guesses) if names | {added[k].key} not in trials.tried}
        new = [added[k] for k in sizes]
        start = trials.tried.get(names, self.start)
        if new and start.names == names:
            linearization_point = trials.linearization_point(start)
            screened = Screen.of(linearization_point.point, linearization_point.effects, new, self.workers)
            trials.fit([trials.job(start, screened, [k]) for k in range(len(new))], every=True)
        elif new:  # the others were never fitted without the cause
            trials.fit([FitJob.of(best, others, [added[k]], size) for k, size in sizes.items()], every=True)

    def _apart(
        self, family: FamilyTest, first: FamilyTest, best: CandidateFit, steps: Sequence[Step]
    ) -> tuple[list[Step], list[Step]]:
        """Separate steps that are quickly fitted from those with stick-slip."""
        smooth: list[Step] = []
        nonsmooth: list[Step] = []
        for start, chosen in steps:
            screened = family.screen if start is best else first.screen
            (nonsmooth if any(screened.effects[k].nonsmooth for k in chosen) else smooth).append((start, chosen))
        return smooth, nonsmooth

    def needed(self, best: CandidateFit, family: FamilyTest) -> list[int]:
        """Return candidates that are needed beside a model, one variant each, the most needed first."""
        screened, least, unreliable = (
            family.screen,
            self.least_decrease(best),
            self.trials.screen_unreliable(best),
        )
        needed = screened.one_each(
            k
            for k in range(len(screened.effects))
            if (unreliable and not screened.absorbed[k])
            or (family.p_values[k] < self.rules.alpha and screened.statistics[k] > least)
        )
        if best is self.start:
            return needed
        # Stick-slip takes as long to try as all else together: only where it is among the most needed.
        return [k for place, k in enumerate(needed) if place < FEW or not screened.effects[k].nonsmooth]

    def still_needed(self, result: SearchResult) -> tuple[Effect, ...]:
        """Return candidates that are significant and matter beside the best model, the most needed first."""
        screened, least = result.last.screen, self.least_decrease(result.best)
        significant = (result.last.p_values < self.rules.alpha) & (screened.statistics > least)
        return tuple(screened.effects[k] for k in screened.one_each(np.flatnonzero(significant).tolist()))

    def _pairs(self, first: FamilyTest, best: CandidateFit) -> list[Step]:
        """Pairs that explain most by the first screen, without the best single effect.

        Of several variants, as of a marker that is off, the best may be another beside another effect than alone.
        """
        screened = first.screen
        others = [k for k, effect in enumerate(screened.effects) if effect.key not in best.names]
        scored = [
            (screened.gain([i, j]), i, j)
            for n, i in enumerate(others)
            for j in others[:n]
            if screened.effects[i].key != screened.effects[j].key
        ]
        found: dict[Names, list[int]] = {}
        for _, i, j in sorted(scored, reverse=True):
            found.setdefault(frozenset({screened.effects[i].key, screened.effects[j].key}), [i, j])
        return [(self.start, pair) for pair in [*found.values()][:_PAIRS]]

    def _worth(self, fewer: CandidateFit, more: CandidateFit) -> bool:
        return fewer.chi2 - more.chi2 > max(self.rules.least(fewer.chi2), self.least_decrease(fewer))

    def _without_idle(self, candidate_fit: CandidateFit) -> CandidateFit:
        """Drop effects that the others make needless."""
        new = candidate_fit.effects[len(self.start.effects) :]
        for effect in new if len(new) > 1 else ():  # the step to a first effect is judged against the start
            fewer = self.trials.without(candidate_fit, effect, candidate_fit.chi2 * (1 + self.rules.matters))
            if fewer is not None and not self._worth(fewer, candidate_fit):
                return self._without_idle(fewer)
        return candidate_fit


def _p_value(family: FamilyTest, key: Key) -> float:
    """The smallest of an effect's variants; one where it was not among the candidates."""
    found = zip(family.screen.effects, family.p_values.tolist(), strict=True)
    return min((p for effect, p in found if effect.key == key), default=1.0)


def select_effects(search: Search, so_far: SearchResult) -> tuple[Search, SearchResult]:
    """Add effects while they are needed, fitted open loop as far as that is a guide.

    A joint that sticks a moment too early is off for good, so that open-loop fits of stick-slip are lost among local
    minima: it is looked for with encoder feedback. All else is fitted open loop, which shows more.

    Args:
        search: open loop.
        so_far: what it has found so far.

    Returns:
        The search that found the best model, and its result.
    """
    if not feedback_possible(search.start):
        return search, search.run(so_far)
    found, asked = so_far, set[Names]()
    while True:
        found = search.run(found, lambda each: each.best.names not in asked and _may_stick(search, each))
        if found.best.names in asked or not _may_stick(search, found):
            return search, found
        asked.add(found.best.names)
        search.tell("fitting with encoder feedback")
        with_feedback = _held(search, found)
        if with_feedback is None:
            continue
        other, beside = with_feedback
        if _is_needed(other, beside) or _is_adrift(search, found):
            beside = other.run(beside)
            if is_nonsmooth(beside.best.effects):
                return other, beside
            found = _released(search, found, beside.best, other.trials.next_best(beside.best))
            asked.add(found.best.names)


def _may_stick(search: Search, found: SearchResult) -> bool:
    """Stick-slip may be needed: it is among the most significant, or hidden where the model loses the recordings."""
    return bool(search.needed(found.best, found.last)) and (_is_adrift(search, found) or _is_needed(search, found))


def _is_adrift(search: Search, found: SearchResult) -> bool:
    """The search begins where the model loses the recordings."""
    return found.best is search.start and found.best.misfit > DIVERGED_MISFIT


def _is_needed(search: Search, found: SearchResult) -> bool:
    """Stick-slip is among the most significant candidates."""
    return any(found.last.screen.effects[k].nonsmooth for k in search.needed(found.best, found.last)[:FEW])


def _held(search: Search, found: SearchResult) -> tuple[Search, SearchResult] | None:
    """Search with encoder feedback, and what it would have found so far; None where that cannot be simulated."""
    start = fit_with_feedback(search.start)
    best = start if found.best is search.start else fit_with_feedback(found.best)
    if start is None or best is None:
        return None
    if best is start and start.misfit > DIVERGED_MISFIT:
        # Parameters that follow nothing, even with feedback, lead away from what is missing.
        best = start = nominal_with_feedback(search.start) or start
    other = search.restarted(start)
    first = other.screen(start)
    if best is start:
        return other, SearchResult.nothing(start, first)
    other.trials.tried[best.names] = best
    return other, SearchResult(best, first, other.screen(best), found.p_values)


def _released(search: Search, found: SearchResult, best: CandidateFit, next_best: CandidateFit | None) -> SearchResult:
    """Result with encoder feedback, fitted open loop; the one before where that cannot be simulated."""
    free = None if best.names == found.best.names else fit_open_loop(best, search.start)
    if free is None:
        return found
    search.trials.tried[free.names] = free
    free = search.trials.correct_discretization(search.trials.converge(free))
    return SearchResult(free, found.first, search.screen(free), found.p_values, next_best)


_MUCH = Rules(matters=0.3, most=1)  # share of chi^2: what explains less is no better than not to know


def find_preexisting_effects(
    baseline: Baseline, effects: Sequence[Effect], rig: Rig, tell: Tell, workers: Workers
) -> tuple[CandidateFit, str]:
    """Extend the model of the reference recordings by the effect that explains much of them, if one does.

    Args:
        baseline: the model without effects.
        effects: what to look for.
        rig: the arm.
        tell: told what is being done.
        workers: share the work.

    Returns:
        The model, and a warning where the baseline misses the reference recordings; empty where it does not.
    """
    misfit, noise = baseline.fit.misfit, 1e3 * baseline.fit.point.runs[0].observed.noise[0]
    if not baseline.changed or misfit < INCOMPLETE:
        return baseline.fit, ""
    warning = (
        f"already in the reference recordings the model misses by {misfit * noise:.2g} mm, {misfit:.3g} times the "
        "noise: present before the change, and not counted as one"
    )
    start = CandidateFit(replace(baseline.fit.fit, point=_as(baseline.fit.point, None)))
    smooth = [effect for effect in effects if not effect.nonsmooth]
    search = Search(rig, SearchStart(start, start), smooth, _MUCH, tell, workers)
    best = search.run(SearchResult.nothing(start, search.screen(start))).best
    if not best.effects:
        return baseline.fit, f"{warning}; no single candidate explains it"
    problem = best.point.problem
    extension = Extension(problem.parametrisation, best.effects, reference_effects=len(best.effects))
    point = _as(replace(best.point, problem=replace(problem, extension=extension)), REFERENCE)
    known = CandidateFit(replace(best.fit, point=point))
    values = ", ".join(f"{name} {value:.3g}" for name, value in known.effects[0].values.items())
    remaining = noise * (known.misfit if known.misfit > INCOMPLETE else 1.0)
    explanation = f"{known.effects[0].id} ({values}) explains it down to {remaining:.2g} mm and is part of both models"
    return known, f"{warning}; {explanation}"


def _as(point: Point, condition: str | None) -> Point:
    """Point with its recordings in another condition."""
    runs = tuple(
        replace(run, observed=replace(run.observed, recording=replace(run.observed.recording, condition=condition)))
        for run in point.runs
    )
    return replace(point, runs=runs, problem=replace(point.problem, observed=tuple(run.observed for run in runs)))
