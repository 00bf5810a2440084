"""Selection of effects: forward steps by score tests and fits, with backward elimination, until nothing is needed.

Recordings are cut into segments so short that even an incomplete model stays in phase; the search begins with some of
them, and goes on in all. Each step tests the candidates beside the best model, fits those that may explain most, adds
the best if it is significant and large enough to matter, and drops effects that are no longer needed. The segments are
then lengthened up to whole recordings. Small effects show best there and are searched for there, and on the way where
longer segments no longer fit.
Where the discretization error cannot be measured, the search ends with the longest segments in which it can be, or in
which it does not show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from time import monotonic

import numpy as np
from scipy.stats import norm

from vjm.diagnosis.candidate_fit import (
    INCOMPLETE_MISFIT,
    LEAST_SHARE,
    SearchOptions,
    StoppingRule,
    continued,
    predicted_increase,
    refit,
    refit_other_frequencies,
    refit_within_bounds,
    starting_effect,
)
from vjm.diagnosis.cross_validation import is_determined, predicts_better
from vjm.diagnosis.discretization import CLOSE_MISFIT, bias_of, corrected_for_discretization
from vjm.diagnosis.screen import CandidateSet, FamilyTest, Screen
from vjm.diagnosis.segments import (
    draw_segments,
    fit_all,
    fit_segments,
    fit_some,
    largest_chi2_in_all,
    largest_chi2_in_longer,
    simulate_segments,
)
from vjm.diagnosis.workers import SERIAL, Workers
from vjm.effects import Effect
from vjm.effects.effect import Key, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import LARGEST_GAIN, Point, TrajectoryFit
from vjm.records import Rig
from vjm.simulation.run import all_followed
from vjm.text import ratio

Report = Callable[[str], None]
Fits = dict[frozenset[Key], TrajectoryFit]


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Attributes:
        best: the best model, fitted to whole recordings, or to segments where it follows nothing longer.
        first_tests: score tests beside the model without effects, in segments unless these show nothing but noise.
        last_tests: the same beside the best model.
        p_values: of each effect of the best model, when it was added.
        fits: models fitted to the recordings or segments of the best one.
        segment_fits: models fitted to the first segments, or to whole recordings where the search began with these.
    """

    best: TrajectoryFit
    first_tests: FamilyTest
    last_tests: FamilyTest
    p_values: dict[Key, float] = field(default_factory=dict)
    fits: Fits = field(default_factory=dict)
    segment_fits: Fits = field(default_factory=dict)


class Search:
    """Search for effects beside some recordings.

    Attributes:
        rig: the arm.
        start: the model to which effects are added, with whole recordings; after the search, where none is needed, with
            the discretization error corrected.
        effects: what is looked for.
        options: of the search.
        report: called with what is being done, in words.
        workers: share the work.
        whole, recordings: the recordings, as measured and as given.
        p_values: of effects that were added on the way, at that time.
        unfinished: keys of effects whose fits were wanted when the deadline came.
        unjustified: ids of effects that were dropped, since the recordings do not determine them or are predicted no
            better with them.
        deadline: reading of `time.monotonic` after which nothing more is fitted [s]: that of the options, before which
            the last tests of candidates must be made.
        stopped: True if the deadline came before the search was done.
        kept_in_segments: why the best model is fitted to segments of the recordings, where it is.
    """

    def __init__(
        self,
        rig: Rig,
        start: TrajectoryFit,
        effects: Sequence[Effect],
        options: SearchOptions,
        report: Report,
        workers: Workers = SERIAL,
    ) -> None:
        self.rig, self.start, self.effects, self.options = rig, start, effects, options
        self.report, self.workers = report, workers
        self.whole = tuple(replace(run.observed, discretization_offset=None) for run in start.point.runs)
        self.recordings = [observed.recording for observed in self.whole]
        self.p_values: dict[Key, float] = {}
        self.unfinished: set[Key] = set()
        self.unjustified: list[str] = []
        self.deadline, self.stopped = options.deadline, False
        self.kept_in_segments = "no effects are looked for"
        self._measured_beside = start.effect_keys  # effects beside which the discretization error was measured last
        self._all_segments: Point | None = None  # all segments, where the search begins with some of them
        self._decreases: dict[Key, float] = {}
        self._first_tests: FamilyTest | None = None  # beside the model without effects

    @property
    def out_of_time(self) -> bool:
        """True after the deadline, which is noted: what asks has something left to do."""
        exhausted = monotonic() > self.deadline
        self.stopped = self.stopped or exhausted
        return exhausted

    def stop(self, max_chi2: float = np.inf) -> StoppingRule:
        """Return the stopping rule of a fit whose chi^2 must come below a bound."""
        return StoppingRule(max_chi2, deadline=self.deadline)

    def run(self) -> SearchResult:
        """Find the effects that are needed."""
        # Where the discretization error is known, what is missing is small, and shows most in whole recordings.
        whole = self.start.shift is not None
        self.kept_in_segments = "longer ones show more than the model explains"
        best, durations = (self.start, []) if whole else (self._fit_segments_without_effects(), self._durations())
        durations = durations if self._all_segments else durations[1:]
        fits = segment_fits = {best.effect_keys: best}
        best, family = self._forward_selection(best, fits, small=whole)
        # Beside the discretization error of another model others do not compare.
        stages: list[tuple[TrajectoryFit, Fits]] = [(best, {} if whole else fits)]
        for duration in durations:
            if self.out_of_time:
                break
            # The longer a segment with stick-slip or play, the more minima the likelihood of its state has: a fit that
            # is in none in these, within a standard error, will not find one in longer ones.
            if is_nonsmooth(best.effects) and self._segments_to_add(duration) is None:
                if not self._leaves_only_noise(best):
                    break
                if not best.has_settled:
                    best = fits[best.effect_keys] = continued(best, self.deadline)
                if not best.has_settled:
                    break
            longer = self._lengthened(best, duration)
            if longer is None and family is None:  # what is small in these segments may be what longer ones lack
                fit = best
                best, fits, family = self._select_small(stages)
                longer = None if best is fit else self._lengthened(best, duration)
            if longer is None:
                break
            best, fits = self._better_in_longer_segments(longer, self._close_second(best, fits), duration)
            stages.append((best, fits))
            family, count = None, len(stages)
            # Small effects show most in whole recordings, and are looked for there if these can be followed.
            if not np.isfinite(duration) or longer.misfit > INCOMPLETE_MISFIT:
                best, fits, family = self._select_small(stages)
            if len(stages) < count:
                break
        if family is None:
            best, fits, family = self._select_small(stages)
        if is_nonsmooth(best.effects):
            self.kept_in_segments = "dry friction or backlash"
        self.deadline = self.options.deadline  # the last tests are made
        # A corrected model had converged before its discretization error was measured.
        if best.new_effects and not (self._is_corrected(best) or self.out_of_time):
            self.report("converging")
            best = fits[best.effect_keys] = continued(best, self.deadline)
            again = (self._corrected(best) if self._is_measurable(best) else None) or best
            if again.chi2 != best.chi2:  # beside another discretization error others do not compare
                fits, family = {}, self.screen(again)
            best = fits[best.effect_keys] = again
        justified = self._justified(best, fits)
        if justified is not best:
            best, family = justified, self.screen(justified)
        if not best.new_effects and len(best.point.runs) == len(self.whole):
            self.start = best  # beside the discretization error, or in a better minimum
        return SearchResult(best, self._first_tests or family, family, self.p_values, fits, segment_fits)

    def _select_small(self, stages: list[tuple[TrajectoryFit, Fits]]) -> tuple[TrajectoryFit, Fits, FamilyTest]:
        """Add small effects that are needed beside a model corrected for its chain's discretization error.

        Over many periods this error looks like a small cause, and grows with the number of periods. Where it cannot be
        measured, the search goes back to the longest segments in which it can be or whose residual is noise, or to the
        first ones. No small effects are added where it is not known.

        Args:
            stages: models fitted to ever longer segments, with all fits to these; stages gone back from are removed.
        """
        fit, fits = stages[-1]
        if self.out_of_time:
            return fit, fits, self.screen(fit)
        while (corrected := fit if is_nonsmooth(fit.effects) else self._corrected(fit)) is None:
            if len(stages) == 1 or fit.chi2 < fit.point.noise_limit:
                break
            stages.pop()
            fit, fits = stages[-1]
            self.kept_in_segments = "a discretization error that grows"
        best = fits[fit.effect_keys] = corrected or fit
        if corrected is not None:  # an effect that stood in for the discretization error is not needed any more
            best = self._backward_elimination(best, fits, doubtful=True)
        measured = set() if is_nonsmooth(fit.effects) else {best.effect_keys}
        best, family = self._forward_selection(best, fits, small=corrected is not None)
        while family is None and corrected and not self.out_of_time and best.effect_keys not in measured:
            measured.add(best.effect_keys)
            corrected = self._corrected(best)
            if corrected is None:
                break
            fits = {corrected.effect_keys: corrected}  # others, beside another discretization error, do not compare
            best, family = self._forward_selection(corrected, fits, small=True)
        stages[-1] = best, fits
        return best, fits, family or self.screen(best)

    def _justified(self, fit: TrajectoryFit, fits: Fits) -> TrajectoryFit:
        """Drop effects with a size at its bound, or that fail Wald's test or cross-validation; small ones first.

        The score and likelihood-ratio tests assume that only noise is left otherwise: an effect that stands in for
        another one, not among the candidates, passes them, but not these two.
        """
        for effect in sorted(fit.new_effects, key=lambda effect: self._decreases.get(effect.key, 0.0)):
            reduced = self.refit_without(fit, effect, fits)
            if reduced is None:
                continue
            determined = is_determined(fit, effect, self.options.alpha) and not any(effect.at_bounds)
            if not (determined and predicts_better(fit, reduced)):
                self.unjustified.append(effect.id)
                return self._justified(reduced, fits)
        return fit

    def without_effects(self) -> SearchResult:
        """Return the result before anything was looked for: the model without effects, in segments."""
        base = self._fit_segments_without_effects()
        family = self.screen(base)
        return SearchResult(base, family, family)

    def _fit_segments_without_effects(self) -> TrajectoryFit:
        """Fit the model without effects to the shortest segments; start from nominal values too if it fits poorly.

        To some of them, if these hold as many values as it takes to find whatever matters.
        """
        self.report("fitting segments")
        problem, duration = self.start.point.problem, self._durations()[0]
        all_segments = simulate_segments(self.start, self.whole, duration)
        # What takes off a share of chi^2 has a z of at least the root of that share of the values. This one is beyond
        # Bonferroni's bound for one test of each effect, with a probability of 90 %.
        z = norm.isf(self.options.alpha / max(len(self.effects), 1) / 2) + norm.ppf(0.9)
        chosen = draw_segments(all_segments.runs, z**2 / LEAST_SHARE, self.options.seed)
        base, all_segments = fit_some(all_segments, chosen, self.stop())
        if not all_followed(base.point.runs):
            x = self.start.point.x.copy()
            x[: len(problem.parametrisation.coordinates)] = problem.parametrisation.start
            try:
                nominal = simulate_segments(replace(self.start, point=problem.point(x)), self.whole, duration)
                from_nominal, nominal = fit_some(nominal, chosen, self.stop(base.chi2))
                base, all_segments = min([(base, all_segments), (from_nominal, nominal)], key=lambda pair: pair[0].chi2)
            except (SimulationDivergedError, InsufficientDataError):
                pass
        self._all_segments = all_segments if len(chosen) < len(all_segments.runs) else None
        return base

    def _segments_to_add(self, duration: float) -> Point | None:
        """Return all segments of a duration, where the search has begun with some of them."""
        return self._all_segments if duration == self._durations()[0] else None

    def screen(self, fit: TrajectoryFit) -> FamilyTest:
        """Test the candidates beside a model.

        A search ends with these tests: the time that they take is kept for that.
        """
        self.report("testing candidates")
        began, share = monotonic(), fit.point.count / self.start.point.count
        candidates = CandidateSet.of(self.effects, self.rig, self.recordings, fit.point.runs)
        absent = [k for k, variant in enumerate(candidates.variants) if variant.key not in fit.effect_keys]
        screened = Screen.of(fit.point, fit.effects, [candidates.variants[k] for k in absent], self.workers)
        family = FamilyTest.of(screened, candidates.multiplicity[absent], self.options.alpha, self.options.seed)
        self.deadline = min(self.deadline, self.options.deadline - (monotonic() - began) / share)
        return replace(family, untestable=candidates.untestable)

    def needed(self, fit: TrajectoryFit, family: FamilyTest) -> list[int]:
        """Return candidates that are significant and matter beside a model, one variant each, the most needed first.

        Where the model is too far from the recordings for a linear model, only the fit shows if a candidate matters.
        """
        screened, unit = family.screen, max(1.0, fit.misfit) ** 2
        significant = family.p_values_for(unit) < self.options.alpha
        large = screened.statistics > self.options.negligible(fit.chi2)
        matters = large | (not all_followed(fit.point.runs))
        return screened.best_variants(np.flatnonzero(significant & matters).tolist())

    def _durations(self) -> list[float]:
        """Return the durations of segments [s], one after another; the last is infinite, for whole recordings."""
        problem = self.start.point.problem
        # The start may be a fit with wrong frequencies: the nominal one limits the horizon too.
        horizon = min(problem.first_horizon(x) for x in (self.start.point.x, problem.parametrisation.start))
        # Over half of it, one and a half periods, a frequency wrong by 30 % is off by half a cycle.
        return problem.durations(horizon / 2)

    def _forward_selection(
        self, best: TrajectoryFit, fits: Fits, small: bool = False
    ) -> tuple[TrajectoryFit, FamilyTest | None]:
        """Add effects to a model while they are needed.

        Args:
            best: the model.
            fits: known fits to the same recordings or segments, and the new ones.
            small: whether effects are looked for although only noise is left. The discretization error is then
                measured beside each model that comes close; with stick-slip or play, where it takes longer, before a
                further effect is added.

        Returns:
            The model, and the score tests beside it; None instead of these where none were made, as only noise is left
            or the discretization error must be measured first.
        """
        while small or not self._leaves_only_noise(best):
            family = self.screen(best)
            self._first_tests = self._first_tests or family
            needed = self.needed(best, family) if len(best.new_effects) < self.options.max_effects else []
            if small and needed and is_nonsmooth(best.effects) and self._is_measurable(best):
                break
            trial = self._best_addition(best, family, needed, fits) if needed else None
            if trial is None or not self._matters(best, trial):
                return best, family
            self._decreases |= {
                effect.key: best.chi2 - trial.chi2 for effect in trial.effects if effect.key not in best.effect_keys
            }
            best = self._backward_elimination(trial, fits)
            added = best.effect_keys - self.p_values.keys()
            self.p_values |= {key: min(family.p_value(key), self._first_tests.p_value(key)) for key in added}
            if small and not is_nonsmooth(best.effects) and self._is_measurable(best):
                break
        return best, None

    def _best_addition(
        self, best: TrajectoryFit, family: FamilyTest, needed: Sequence[int], fits: Fits
    ) -> TrajectoryFit | None:
        """Fit models with one effect more, and return the best.

        Candidates are fitted in the order of their score statistics, the predicted decreases of chi^2, until the best
        fit exceeds what the rest can gain, or leaves nothing to them. Stick-slip and play, which are slow to fit, come
        after all that may gain as much. All are fitted where the model is too far from the recordings for a linear
        model; compliant joints always are, being nonlinear early. A model in a wrong minimum predicts a small share of
        what fits then gain: others are taken to gain as many times their statistics, and run to their end.
        """
        screened, followed, base = family.screen, all_followed(best.point.runs), fits.get(self.start.effect_keys)
        trial: TrajectoryFit | None = None
        gain_ratio = 1.0  # the largest of a fit's gain over its score statistic so far

        def largest_gain(k: int) -> float:
            # Beside a model at a minimum near the recordings no fit of a smooth effect without a joint of its own has
            # gained more than twice its score statistic.
            return float(screened.statistics[k]) * (1.0 if screened.effects[k].nonsmooth else 2.0)

        def promises(k: int) -> bool:
            gained = 0.0 if trial is None else best.chi2 - trial.chi2
            effect = screened.effects[k]
            compliant = effect.adds_joint(best.point.chain) and not effect.nonsmooth
            # Compliant joints, which may vibrate at frequencies between those of the screen, are always fitted, in the
            # first segments only: longer ones have better linear predictions and slower fits.
            return not followed or (compliant and base is not None) or 2 * gain_ratio * screened.statistics[k] > gained

        order, count = sorted(needed, key=largest_gain, reverse=True), self.workers.count
        for first in range(0, len(order), count):  # fitted side by side
            chosen = [k for k in order[first : first + count] if promises(k)]
            promising = [self._with_candidates(best, family, [k]) for k in chosen]
            if base is not None:
                restarted = list(filter(None, (self._from_base(base, best, effects) for effects in promising)))
                trial = self._best_fit(base, restarted, trial, fits) if restarted else trial
            bounded = gain_ratio <= LARGEST_GAIN
            trial = self._best_fit(best, promising, trial, fits, bounded) if promising else trial
            if self._leaves_only_noise(trial):
                return trial
            for k in chosen:
                effect = screened.effects[k]
                fit = fits.get(best.effect_keys | {effect.key})
                if fit is not None and not (effect.nonsmooth or effect.adds_joint(best.point.chain)):
                    gain_ratio = max(gain_ratio, (best.chi2 - fit.chi2) / screened.statistics[k])
        added = [] if trial is None else [effect for effect in trial.effects if effect.key not in best.effect_keys]
        if trial is not None and any(effect.adds_joint(best.point.chain) for effect in added):
            trial = fits[trial.effect_keys] = refit_other_frequencies(trial, self.deadline)
        if base is not None and len(best.new_effects) == 1 and not self._leaves_only_noise(trial):
            trial = self._best_fit(base, self._pairs(base, best), trial, fits)
        return trial

    def _best_fit(
        self,
        start: TrajectoryFit,
        steps: Sequence[Sequence[Effect]],
        best: TrajectoryFit | None,
        fits: Fits,
        bounded: bool = True,
    ) -> TrajectoryFit | None:
        """Fit models from a start, and return the best of them and of the best so far.

        They are given up, if bounded, where they are not expected to become the best.
        """
        trials = self.fit_models(start, steps, np.inf if best is None or not bounded else best.chi2, fits)
        return min([*trials, *([] if best is None else [best])], key=self.options.criterion, default=None)

    def _from_base(self, base: TrajectoryFit, best: TrajectoryFit, effects: Sequence[Effect]) -> tuple[Effect, ...]:
        """Return a model's effects as the model without effects starts them, if the best model misleads; else none.

        Beside a model that lacks something, the flanks of a play or the speed of a Stribeck friction go to a bound,
        from where no step leads to the right ones.
        """
        held = best.point.held
        misleads = any(effect.nonsmooth and held[best.part_of(effect)].any() for effect in best.new_effects)
        if not misleads or self._first_tests is None:
            return ()
        screen, new = self._first_tests.screen, effects[base.point.problem.reference_effects :]
        variants = [[k for k, other in enumerate(screen.effects) if other.key == effect.key] for effect in new]
        chosen = max(product(*variants), key=screen.decrease, default=())
        return self._with_candidates(base, self._first_tests, chosen) if chosen else ()

    def fit_models(
        self, start: TrajectoryFit, models: Sequence[Sequence[Effect]], max_chi2: float, fits: Fits
    ) -> list[TrajectoryFit]:
        """Fit several models with other effects from a start, as far as they can be simulated.

        Args:
            start: where to begin.
            models: effects of each, with the parameters from which its search starts.
            max_chi2: fits that stay above it are given up.
            fits: known ones, which are not fitted again, and the new ones.
        """
        models_keys = [frozenset(effect.key for effect in effects) for effects in models]
        untried = [effects for keys, effects in zip(models_keys, models, strict=True) if keys not in fits]
        if untried:
            added = {effect.key for effects in untried for effect in effects} - start.effect_keys
            if not self.out_of_time:
                ids = sorted({name for name, _ in added})
                names = " and ".join(ids[:2]) + (f" and {len(ids) - 2} more" if len(ids) > 2 else "")
                self.report(
                    f"fitting {names}, residual {ratio(min(fit.misfit for fit in (start, *fits.values())))} × noise"
                )
                trials = self.workers.map(partial(refit_within_bounds, start, self.deadline, max_chi2), untried)
                fits |= {trial.effect_keys: trial for trial in trials if trial is not None}
            if self.out_of_time:
                self.unfinished |= added
        return [fits[keys] for keys in models_keys if keys in fits]

    def _with_candidates(self, fit: TrajectoryFit, family: FamilyTest, chosen: Sequence[int]) -> tuple[Effect, ...]:
        """Return a model's effects and further ones, with starting values by the linear model."""
        added = [family.screen.effects[k] for k in chosen]
        guess = family.screen.best_sizes(chosen)
        parts = np.split(guess, np.cumsum([effect.magnitude_count for effect in added])[:-1])
        starts = [family.screen.starting_variant(k, sizes) for k, sizes in zip(chosen, parts, strict=True)]
        sized = [starting_effect(*start, fit.point.chain) for start in starts]
        return (*fit.effects, *sized)

    def _leaves_only_noise(self, fit: TrajectoryFit | None) -> bool:
        """Return True if a model leaves only noise, within five standard deviations, or if a finer chain would.

        Further effects would stand in for a discretization error that is not known. What a finer chain leaves is told
        to first order, but not with stick-slip and play.
        """
        if fit is None or fit.chi2 < fit.point.noise_limit:
            return fit is not None
        known = fit.shift is not None
        if known or is_nonsmooth(fit.effects) or fit.misfit > CLOSE_MISFIT or self.out_of_time:
            return False
        bias = bias_of(fit, self.rig)
        return bias is not None and fit.chi2 - bias.decrease < fit.point.noise_limit

    def _matters(self, reduced: TrajectoryFit, full: TrajectoryFit) -> bool:
        return bool(reduced.chi2 - full.chi2 > self.options.negligible(reduced.chi2))

    def _backward_elimination(self, fit: TrajectoryFit, fits: Fits, doubtful: bool = False) -> TrajectoryFit:
        """Drop effects that the others make needless.

        With `doubtful`, a single one too, but only those without which a linear model's chi^2 hardly rises.
        """
        for effect in fit.new_effects if doubtful or len(fit.new_effects) > 1 else ():
            if doubtful and predicted_increase(fit, effect) > 3 * self.options.negligible(fit.chi2):
                continue
            largest = fit.chi2 * (1 + self.options.least_share)
            reduced = self.refit_without(fit, effect, fits, largest)
            if reduced is not None and not self._matters(reduced, fit):
                return self._backward_elimination(reduced, fits, doubtful)
        return fit

    def refit_without(
        self, fit: TrajectoryFit, effect: Effect, fits: Fits, max_chi2: float = np.inf
    ) -> TrajectoryFit | None:
        """Fit a model again without one of its effects; None where that cannot be simulated, or not in time.

        A fit that is known, or the model that the search started from, will do where its chi^2 is no larger than the
        linear model makes it, times what fits may gain at most: then it is in no minimum of its own. After the deadline
        it will do whatever its chi^2.

        Args:
            fit: the model.
            effect: one of its effects.
            fits: known ones, and the new one.
            max_chi2: a fit that stays above it is given up.
        """
        remaining = tuple(present for present in fit.effects if present is not effect)
        keys, is_whole = fit.effect_keys - {effect.key}, len(fit.point.runs) == len(self.whole)
        known = fits.get(keys, self.start if is_whole and keys == self.start.effect_keys else None)
        sufficient = known is not None and known.chi2 - fit.chi2 <= LARGEST_GAIN * predicted_increase(fit, effect)
        if sufficient or self.out_of_time:
            return known
        trials = filter(None, (refit(fit, remaining, self.stop(max_chi2)), known))
        best = min(trials, key=lambda fit: fit.chi2, default=None)
        if best is not None:
            fits[best.effect_keys] = best
        return best

    def _pairs(self, base: TrajectoryFit, best: TrajectoryFit) -> list[tuple[Effect, ...]]:
        """Return the two pairs of effects with the largest joint score statistics, without the best single effect."""
        if self._first_tests is None:
            return []
        pairs = self._first_tests.screen.best_pairs(2, best.effect_keys)
        return [self._with_candidates(base, self._first_tests, pair) for pair in pairs]

    def _lengthened(self, fit: TrajectoryFit, duration: float) -> TrajectoryFit | None:
        """Fit a model to longer segments, or to all of the first ones; None where it fits them much worse.

        With stick-slip or play also None where it leaves more than noise of them, and after the deadline always.
        """
        if self.out_of_time:
            return None
        all_segments, nonsmooth, max_chi2 = self._segments_to_add(duration), is_nonsmooth(fit.effects), np.inf
        self.report("lengthening segments" if all_segments is None else "adding segments")
        try:
            if all_segments is None:
                max_chi2 = largest_chi2_in_longer(fit, self.whole, duration) if nonsmooth else np.inf
                longer = fit_segments(fit, self.whole, duration, self.stop(max_chi2))
            else:
                max_chi2 = largest_chi2_in_all(fit, all_segments) if nonsmooth else np.inf
                longer = fit_all(fit, all_segments, self.stop(max_chi2))
        except (SimulationDivergedError, InsufficientDataError):
            return None
        if longer.chi2 > max_chi2:  # without what its chain's discretization error adds, which grows with the duration
            bias = None if self.out_of_time else bias_of(longer, self.rig)
            if bias is None or longer.chi2 - bias.decrease > max_chi2:
                return None
        return None if longer.misfit > INCOMPLETE_MISFIT * max(1.0, fit.misfit) else longer

    def _close_second(self, best: TrajectoryFit, fits: Fits) -> TrajectoryFit | None:
        """Return the next best model of as many effects, if it is worse by less than the best one's excess of chi^2."""
        unexplained, present = best.chi2 - best.point.expected_chi2, best.effect_keys
        rivals = [fit for keys, fit in fits.items() if len(keys) == len(present) and keys != present]
        second = min(rivals, key=self.options.criterion, default=None)
        if second is None or self._leaves_only_noise(best) or second.chi2 - best.chi2 > unexplained:
            return None
        return second

    def _better_in_longer_segments(
        self, longer: TrajectoryFit, second: TrajectoryFit | None, duration: float
    ) -> tuple[TrajectoryFit, Fits]:
        """Fit the close second, if there is one, to longer segments as well; return the better model, and both."""
        alternative = None if second is None else self._lengthened(second, duration)
        fits = {fit.effect_keys: fit for fit in (longer, alternative) if fit is not None}
        best = min(fits.values(), key=self.options.criterion)
        replaced = max((self._decreases.get(key, 0.0) for key in longer.effect_keys - best.effect_keys), default=0.0)
        for key in best.effect_keys - longer.effect_keys:
            self.p_values.setdefault(key, 1.0 if self._first_tests is None else self._first_tests.p_value(key))
            self._decreases.setdefault(key, replaced)  # nearly the same, or there would be no close second
        return best, fits

    def _is_measurable(self, fit: TrajectoryFit) -> bool:
        """Return True if a model's discretization error is not known, and no smaller than what else is missing.

        Measured beside other effects it is wrong: initial states absorb part of what is missing, those of a finer chain
        do not, and the difference looks like a discretization error, which biases damping.
        """
        return not self._is_corrected(fit) and fit.misfit <= CLOSE_MISFIT and not self.out_of_time

    def _is_corrected(self, fit: TrajectoryFit) -> bool:
        measured = all(run.observed.discretization_offset is not None for run in fit.point.runs)
        return measured and self._measured_beside == fit.effect_keys

    def _corrected(self, fit: TrajectoryFit) -> TrajectoryFit | None:
        """Refit a model with its chain's discretization error corrected; None where that cannot be measured.

        One with stick-slip or play is fitted until it has converged before.
        """
        self.report("measuring the discretization error")
        fit = continued(fit, self.deadline) if is_nonsmooth(fit.effects) else fit
        self._measured_beside = fit.effect_keys
        return corrected_for_discretization(fit, self.rig, self.options.negligible(fit.chi2), self.deadline)

    def still_needed(self, result: SearchResult) -> tuple[Effect, ...]:
        """Return candidates that are significant and matter beside the best model, the most needed first."""
        return tuple(result.last_tests.screen.effects[k] for k in self.needed(result.best, result.last_tests))
