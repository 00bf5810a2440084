"""Score tests of absent effects: what each would explain of a fit's residuals if it alone were added.

Every effect is linearised about its null, one direction in the space of the residuals for each of its sizes. What the
fit's own coordinates and initial states can do is projected out of the directions and the residuals. The decrease of
chi^2 along what remains is the score statistic (Rao 1948; Engle, Handbook of Econometrics 2, chapter 13): no refit.

An effect is screened at every place of the rig and for every starting value of its shape parameters; looking so often
makes chance findings likely. The p-values are therefore those of the smallest p-value among all candidates under
noise that correlates as the candidates do (minP: Westfall and Young, Resampling-Based Multiple Testing, 1993).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from itertools import combinations, pairwise
from typing import Self

import numpy as np
from scipy import stats

from vjm.diagnosis.candidate_fit import LEAST_START
from vjm.diagnosis.records import Candidate
from vjm.diagnosis.search_starts import ABSORBED, spectral_starts, temporal_peaks
from vjm.diagnosis.workers import SERIAL, Workers
from vjm.effects.effect import Effect, Key
from vjm.identification.trajectory_fit import Point
from vjm.records import REFERENCE, Array, Mask, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.run import Run, linearize
from vjm.simulation.sensitivity import Linearization
from vjm.simulation.variational_equations import PerturbedArm

_STEP = 0.1  # of the typical magnitude, for a difference quotient; all effects but joints are nearly linear in it
_JOINT_STEP = 1e-4  # the same for the compliance of a joint of its own, in which an arm is far from linear
_DRAWS = 4000  # the 1 % quantile of the smallest p-value is then known within 16 % (1/sqrt(0.01 * 4000))


@dataclass(frozen=True)
class Screen:
    """Score tests of absent effects, from their directions once all other parameters have been projected out.

    Attributes:
        effects: V absent effects.
        parts: columns of each one's sizes, which are its magnitudes in units of typical ones.
        R: (c + 1, c + 1) factor; R^T R are the directions' inner products, the last column stands for the residuals.
        unprojected: (c,) squares of the directions before the projection; infinite where a slope diverges.
        directions: before the projection.
    """

    effects: tuple[Effect, ...]
    parts: tuple[slice, ...]
    R: Array
    unprojected: Array
    directions: Directions

    @classmethod
    def of(
        cls, point: Point, present: Sequence[Effect], variants: Sequence[Effect], workers: Workers = SERIAL
    ) -> Screen:
        """Test absent effects beside a fit; arguments as for `Directions.of`."""
        return Directions.of(point, present, variants, workers).screen()

    @cached_property
    def products(self) -> Array:
        """(c + 1, c + 1) inner products of directions and residuals."""
        result: Array = self.R.T @ self.R
        return result

    @cached_property
    def absorbed(self) -> Mask:
        """(V,) true for effects that are collinear with the other parameters."""
        vanishing = np.diag(self.products)[:-1] <= ABSORBED * self.unprojected
        return np.array([bool(vanishing[part].any()) for part in self.parts])

    @cached_property
    def statistics(self) -> Array:
        """(V,) score statistic: predicted decrease of chi^2 by each effect alone; zero if absorbed or infeasible."""
        return np.array([self.decrease([k]) for k in range(len(self.effects))])

    @cached_property
    def magnitude_counts(self) -> Array:
        """(V,) number of each effect's sizes."""
        return np.array([part.stop - part.start for part in self.parts])

    @cached_property
    def one_sided(self) -> Mask:
        """(V,) true where the null is a bound of an effect's only size."""
        bounds = [effect.bounds for effect in self.effects]
        at_bound = [bool(lower[0] == 0 or upper[0] == 0) for lower, upper in bounds]
        return np.asarray(np.logical_and(at_bound, self.magnitude_counts == 1))

    def tail_probabilities(self, statistics: Array) -> Array:
        """Return probabilities of larger statistics (..., V) under noise: chi-square, and half of that at a bound."""
        p = np.asarray(stats.chi2.sf(statistics, self.magnitude_counts))
        return np.where(self.one_sided, np.where(statistics > 0, p / 2, 1.0), p)

    def best_variants(self, chosen: Iterable[int]) -> list[int]:
        """Return the variant of each effect and place that explains most, the most needed first."""
        return self.first_variants(sorted(chosen, key=lambda k: -self.statistics[k]))

    def first_variants(self, order: Iterable[int]) -> list[int]:
        """Return the variant of each effect and place that comes first in an order."""
        first: dict[Key, int] = {}
        for k in order:
            first.setdefault(self.effects[k].key, k)
        return list(first.values())

    def best_pairs(self, count: int, without: Collection[Key]) -> list[list[int]]:
        """Return the pairs of variants with the largest joint score statistics, one for each two effects and places.

        Args:
            count: number of pairs at most.
            without: keys of effects that are left out.
        """
        allowed = [k for k, effect in enumerate(self.effects) if effect.key not in without]
        pairs = [[j, i] for i, j in combinations(allowed, 2) if self.effects[i].key != self.effects[j].key]
        chosen: dict[frozenset[Key], list[int]] = {}
        for pair in sorted(pairs, key=lambda pair: (self.decrease(pair), pair), reverse=True):
            chosen.setdefault(frozenset(self.effects[k].key for k in pair), pair)
        return [*chosen.values()][:count]

    def best_sizes(self, chosen: Sequence[int]) -> Array:
        """Return the best sizes (s,) of some effects together, in units of their typical magnitudes."""
        columns = self._columns(chosen)
        return np.asarray(np.linalg.lstsq(self.R[:, columns], self.R[:, -1], rcond=1e-10)[0])

    def starting_variant(self, k: int, sizes: Array) -> tuple[Effect, Array]:
        """Return the absent effect from which a fit of variant k with its sizes (s,) starts, and the sizes there."""
        effect = self.effects[k]
        group = [j for j, variant in enumerate(self.effects) if effect.superposes(variant) and not self.absorbed[j]]
        return (
            effect.superposition([self.effects[j] for j in group], self.best_sizes(group)) if group else (effect, sizes)
        )

    def std(self, k: int) -> Array:
        """Return standard errors (s,) of effect k's sizes, each with the others known, in typical magnitudes."""
        return np.asarray(1 / np.sqrt(np.maximum(np.diag(self.products)[self.parts[k]], 1e-300)))

    @cached_property
    def cosines(self) -> Array:
        """(V, V) cosine of the smallest angle between the directions of two effects."""
        bases = [np.linalg.qr(self.R[:, part])[0] for part in self.parts]
        cosines = np.eye(len(bases))
        for i, first in enumerate(bases):
            for j, second in enumerate(bases[:i]):
                cosines[i, j] = cosines[j, i] = np.linalg.norm(first.T @ second, 2)
        return cosines

    def draw_statistics(self, count: int, seed: int) -> Array:
        """Return statistics (count, V) drawn under noise alone, correlated as the directions are."""
        directions = self.R[:, :-1] / np.sqrt(np.maximum(np.diag(self.products)[:-1], 1e-300))
        noise = np.random.default_rng(seed).standard_normal((count, len(self.R))) @ directions
        statistics = np.zeros((count, len(self.parts)))
        for k, part in enumerate(self.parts):
            if self.absorbed[k]:
                continue
            if self.magnitude_counts[k] == 1:
                score = noise[:, part.start]
                statistics[:, k] = np.where(score > 0, score, 0.0) ** 2 if self.one_sided[k] else score**2
            else:
                inverse = np.linalg.pinv(directions[:, part].T @ directions[:, part])
                statistics[:, k] = np.einsum("di,ij,dj->d", noise[:, part], inverse, noise[:, part])
        return statistics

    def decrease(self, chosen: Sequence[int]) -> float:
        """Return the predicted decrease of chi^2 by some effects together, those with infeasible signs left out."""
        if not chosen or any(self.absorbed[k] for k in chosen):
            return 0.0
        guess = self.best_sizes(chosen)
        first = 0
        for k in chosen:
            if self.one_sided[k] and guess[first] < 0:
                return self.decrease([index for index in chosen if index != k])
            first += self.magnitude_counts[k]
        unexplained = self.R[:, -1] - self.R[:, self._columns(chosen)] @ guess
        return float(self.R[:, -1] @ self.R[:, -1] - unexplained @ unexplained)

    def _columns(self, chosen: Sequence[int]) -> list[int]:
        return [column for k in chosen for column in range(self.parts[k].start, self.parts[k].stop)]


@dataclass(frozen=True)
class Directions:
    """Linearised problem of a fit with absent effects, initial states projected out.

    Attributes:
        effects: V absent effects.
        parts: columns of each one's sizes, counted from the first effect's.
        rows: (r, p + c + 1) derivatives by p coordinates and c sizes, then residuals; true up to a rotation.
        held: (p,) true for coordinates at a bound, which are not projected out.
        unprojected: (c,) squares of the effects' directions before anything was projected out.
    """

    effects: tuple[Effect, ...]
    parts: tuple[slice, ...]
    rows: Array
    held: Mask
    unprojected: Array

    @classmethod
    def of(
        cls, point: Point, present: Sequence[Effect], variants: Sequence[Effect], workers: Workers = SERIAL
    ) -> Directions:
        """Linearise absent effects about their nulls beside a fit.

        Args:
            point: the fit.
            present: effects that it already has.
            variants: absent effects, one for each place and choice of shape parameters.
            workers: share the work.
        """
        edges = np.linspace(0, len(point.runs), 2 if workers.count == 1 else 2 * workers.count + 1, dtype=int)
        groups = [slice(first, last) for first, last in pairwise(edges.tolist()) if first < last]
        jobs = [_some_recordings(point, group) for group in groups]
        linearized = [pair for batch in workers.map(partial(_linearized, present, variants), jobs) for pair in batch]
        parts = _parts([variant.magnitude_count for variant in variants])
        unprojected = sum((squares for _, squares in linearized), start=np.zeros(parts[-1].stop if parts else 0))
        return cls(tuple(variants), parts, np.vstack([rows for rows, _ in linearized]), point.held, unprojected)

    def screen(self, present: tuple[Effect, slice] | None = None, chosen: Sequence[int] | None = None) -> Screen:
        """Project the fit's coordinates out.

        Args:
            present: an effect of the fit with its coordinates, whose sizes are kept as if it were absent; it comes
                first.
            chosen: some of the absent effects; None: all.
        """
        chosen = range(len(self.effects)) if chosen is None else chosen
        effects, counts = [self.effects[k] for k in chosen], [self.effects[k].magnitude_count for k in chosen]
        sizes = [column for k in chosen for column in range(self.parts[k].start, self.parts[k].stop)]
        unprojected, retained = self.unprojected[sizes], list[int]()
        if present is not None:
            effect, part = present
            retained = [part.start + size for size in effect.size_coordinates]
            effects, counts = [effect, *effects], [len(retained), *counts]
            unprojected = np.r_[np.zeros(len(retained)), unprojected]
        eliminated = [k for k in np.flatnonzero(~self.held).tolist() if k not in retained]
        rows = self.rows[:, [*eliminated, *retained, *(self.held.size + k for k in sizes), -1]]
        information = SquareRootInformation.of([(rows[:, :-1], rows[:, -1])], rows.shape[1] - 1)
        return Screen(tuple(effects), _parts(counts), information.eliminated(len(eliminated)).R, unprojected, self)


def _parts(counts: Sequence[int]) -> tuple[slice, ...]:
    stops = np.cumsum(counts, dtype=int).tolist()
    return tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))


def _some_recordings(point: Point, chosen: slice) -> Point:
    runs = point.runs[chosen]
    return replace(point, runs=runs, problem=replace(point.problem, observed=tuple(run.observed for run in runs)))


def _linearized(present: Sequence[Effect], variants: Sequence[Effect], point: Point) -> list[tuple[Array, Array]]:
    """Return each recording's factor (r, p + c + 1), initial state eliminated, and the squares of its directions."""
    extended = [_extended(point, present, variant) for variant in variants]
    coordinates = point.problem.perturbed_arms(point.x)
    moved = [
        (*arms, *(arm for arms in extended for arm in _moved(run, arms)))
        for run, arms in zip(point.runs, coordinates, strict=True)
    ]
    parts = _parts([variant.magnitude_count for variant in variants])
    pairs = zip(point.runs, linearize(point.runs, moved), strict=True)
    return [_projected(run, linearization, parts) for run, linearization in pairs]


def _projected(run: Run, linearization: Linearization, parts: Sequence[slice]) -> tuple[Array, Array]:
    """Return the factor of one recording's problem, and the squares of the directions in `parts`."""
    count = parts[-1].stop if parts else 0
    squares, weights = np.zeros(count), np.sqrt(run.observed.loss.slope(run.residual**2))

    def rows() -> Iterator[tuple[Array, Array]]:
        for measured, slopes in run.jacobian(linearization):
            directions = slopes[:, slopes.shape[1] - count :]
            # Along a wrong motion a derivative may diverge, and the effect cannot be tested. Beyond 1e12 times the
            # noise its square would leave the others no digits.
            diverging = ~(np.abs(directions) < 1e12).all(axis=0)
            directions[:, diverging] = 0.0
            squares[diverging] = np.inf
            squares[:] += np.sum(directions**2, axis=0)
            yield weights[measured, None] * slopes, weights[measured] * run.residual[measured]

    initial = 2 * run.basis.slow_count
    columns = initial + len(linearization.perturbed)
    information = SquareRootInformation.of(rows(), columns).with_rows(*run.prior_rows(columns))
    timing = run.timing_rows(linearization, likelihood_ratio=True)
    squares += np.sum(timing[0][:, columns - count :] ** 2, axis=0)
    information = information.with_rows(*timing)
    return information.eliminated(initial).R, squares


def _with_size(variant: Effect, size: int, magnitude: float) -> Effect:
    """Return the effect with one of its sizes off the null."""
    coordinates = np.where(np.arange(variant.coordinates.size) < variant.magnitude_count, 0.0, variant.coordinates)
    coordinates[size] = magnitude
    return variant.at(coordinates)


def _extended(point: Point, present: Sequence[Effect], variant: Effect) -> list[tuple[Arm, float]]:
    """Return the arm with each size of an effect off its null, and by how much."""
    step = _STEP
    if variant.adds_joint(point.chain):  # with a gap, the flanks' compliance sets in at once
        step = LEAST_START if variant.nonsmooth else _JOINT_STEP
    effects = [_with_size(variant, size, step) for size in range(variant.magnitude_count)]
    return [(Arm.of(point.chain, (*present, effect)), step) for effect in effects]


def _moved(run: Run, extended: Sequence[tuple[Arm, float]]) -> list[PerturbedArm]:
    """Return the arms of an effect off its null, as far as it acts in a recording."""
    recording = run.observed.recording
    absent = recording.condition == REFERENCE
    return [PerturbedArm(run.arm if absent else arm.in_recording(recording), step) for arm, step in extended]


@dataclass(frozen=True)
class CandidateSet:
    """Absent effects that are looked for.

    Attributes:
        variants: V absent effects, one for each place and choice of shape parameters.
        multiplicity: (V,) number of independent tests that each counts as.
        untestable: effects that the recordings cannot show.
    """

    variants: tuple[Effect, ...]
    multiplicity: Array
    untestable: tuple[Candidate, ...]

    @classmethod
    def of(cls, effects: Sequence[Effect], rig: Rig, recordings: Sequence[Recording], runs: Sequence[Run]) -> Self:
        """Collect the variants of effects that recordings can show.

        Args:
            effects: absent effects, without a place.
            rig: the arm.
            recordings: what was measured.
            runs: simulations of these or of their segments: periodic effects have the frequencies of their residuals.
        """
        variants: list[Effect] = []
        multiplicity: list[float] = []
        untestable: list[Candidate] = []
        over_time = cache(partial(temporal_peaks, recordings, runs))  # once for all effects that need them
        for effect in effects:
            reason = effect.untestable(rig, recordings) or ("" if effect.places(rig) else "the rig has no place for it")
            if reason:
                untestable.append(Candidate.untestable(effect, reason))
                continue
            effect_variants, tests = effect.variants(rig, recordings), 1.0
            for parameter in effect.parameters:
                if parameter.from_spectrum:
                    effect_variants, tests = spectral_starts(parameter, effect_variants, runs, over_time)
            if not effect_variants:
                untestable.append(Candidate.untestable(effect, "the joints turn too little to show a whole wave"))
            variants += effect_variants
            multiplicity += [tests] * len(effect_variants)
        return cls(tuple(variants), np.array(multiplicity), tuple(untestable))


@dataclass(frozen=True)
class FamilyTest:
    """Score tests of all candidates, with the p-values of the search as a whole.

    Attributes:
        screen: the score tests.
        multiplicity: (V,) as of `CandidateSet`.
        tests: effective number of tests: independent ones that the search amounts to.
        untestable: effects that the recordings cannot show.
    """

    screen: Screen
    multiplicity: Array
    tests: float
    untestable: tuple[Candidate, ...] = ()

    @classmethod
    def of(cls, screen: Screen, multiplicity: Array, alpha: float, seed: int) -> FamilyTest:
        """Estimate the effective number of tests: it gives the smallest p-value under noise its alpha-quantile."""
        if not screen.effects:
            return cls(screen, multiplicity, 1.0)
        smallest = np.min(_sidak(screen.tail_probabilities(screen.draw_statistics(_DRAWS, seed)), multiplicity), axis=1)
        level = max(float(np.quantile(smallest, alpha)), 1e-12)
        return cls(screen, multiplicity, max(1.0, float(np.log1p(-alpha) / np.log1p(-level))))

    @property
    def p_values(self) -> Array:
        """(V,) probability that noise alone makes any candidate look as needed."""
        return self.p_values_for(1.0)

    def p_values_for(self, mean_square: float) -> Array:
        """Return the p-values for noise of a mean square other than one."""
        tail = self.screen.tail_probabilities(self.screen.statistics / mean_square)
        return _sidak(_sidak(tail, self.multiplicity), self.tests)

    def p_value(self, key: Key) -> float:
        """Return the smallest p-value of an effect's variants; one where it was not among the candidates."""
        p_values = zip(self.screen.effects, self.p_values.tolist(), strict=True)
        return min((p for effect, p in p_values if effect.key == key), default=1.0)

    def p_of_fit(self, effect: Effect, decrease: float) -> float:
        """Return the p-value of a fitted effect that lowers chi^2 by so much (likelihood ratio)."""
        tests = [
            count
            for count, variant in zip(self.multiplicity.tolist(), self.screen.effects, strict=True)
            if variant.key == effect.key
        ]
        single = np.array([stats.chi2.sf(decrease, effect.coordinates.size)])
        return float(_sidak(_sidak(single, max(tests, default=1.0)), self.tests)[0])

    def _threshold(self, alpha: float) -> Array:
        """Return the z (V,) from which a candidate's p-value is below alpha."""
        single = -np.expm1(np.log1p(-alpha) / (self.tests * self.multiplicity))
        tail = np.where(self.screen.one_sided, 2 * single, single)
        return np.asarray(np.sqrt(stats.chi2.isf(tail, self.screen.magnitude_counts)))

    def table(self, alpha: float, least_decrease: float) -> tuple[Candidate, ...]:
        """List the effects that were tested, the most needed first, then those that cannot be.

        Args:
            alpha: significance level of the search.
            least_decrease: decrease of chi^2 below which an effect does not matter, whatever its p-value.
        """
        screen, p = self.screen, self.p_values
        detected = stats.norm.ppf(0.9)  # of the time: the power of a `smallest_detectable` size
        detectable = np.maximum(self._threshold(alpha), np.sqrt(least_decrease)) + detected
        rows = []
        for k in screen.best_variants(range(len(screen.effects))):
            effect = screen.effects[k]
            if screen.absorbed[k]:
                reason = "whatever its size, other parameters explain these recordings as well"
                rows.append(Candidate.untestable(effect, reason))
                continue
            guess = effect.at(np.r_[screen.best_sizes([k]), effect.coordinates[effect.magnitude_count :]]).values
            sizes = [parameter for parameter in effect.parameters if not parameter.shape_parameter]
            smallest = {}
            for index, (parameter, coordinate) in enumerate(zip(sizes, detectable[k] * screen.std(k), strict=False)):
                value = _with_size(effect, index, float(coordinate)).values[parameter.name]
                smallest[parameter.name] = value if parameter.reciprocal else abs(value - parameter.null)
            guessed = {parameter.name: float(guess[parameter.name]) for parameter in sizes}
            rows.append(Candidate(effect, float(np.sqrt(screen.statistics[k])), float(p[k]), guessed, smallest))
        return (*rows, *self.untestable)


def _sidak(p: Array, count: Array | float) -> Array:
    """Return the probability that the smallest of several independent p-values is as small (Sidak's correction)."""
    result: Array = -np.expm1(count * np.log1p(-np.minimum(p, 1 - 1e-16)))
    return result
