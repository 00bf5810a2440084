"""Which effects are looked for, where, and how sure one must be: p-values of the whole search."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.diagnosis.records import Candidate
from vjm.effects import BUILTIN, Effect
from vjm.effects.effect import Key
from vjm.errors import ChoiceError, ShapeError
from vjm.identification.trajectory_fit import Point
from vjm.records import Array, Recording, Rig
from vjm.simulation.run import Run

_ABSORBED = 1e-7  # share of a direction's square left once all else has been projected out, below which it is none


@dataclass(frozen=True)
class Screen:
    """What is left of candidates' directions and of the residuals once all other parameters are chosen best.

    Attributes:
        effects: V absent effects.
        parts: the columns of each one's sizes.
        R: (c + 1, c + 1) triangle with R^T R their inner products; the last column stands for the residuals.
        whole: (c,) squares of the directions before anything was projected out; infinite where they have no end.
    """

    effects: tuple[Effect, ...]
    parts: tuple[slice, ...]
    R: Array
    whole: Array

    @cached_property
    def products(self) -> Array:
        """(c + 1, c + 1) inner products of directions and residuals."""
        result: Array = self.R.T @ self.R
        return result

    @cached_property
    def absorbed(self) -> NDArray[np.bool_]:
        """(V,) whether other parameters explain all that an effect would do."""
        left = np.diag(self.products)[:-1] <= _ABSORBED * self.whole
        return np.array([bool(left[part].any()) for part in self.parts])

    @cached_property
    def statistics(self) -> Array:
        """(V,) by how much each alone would lower chi^2; zero where absorbed, or on the wrong side of a bound."""
        return np.array([self._gain([k]) for k in range(len(self.effects))])

    @cached_property
    def p_values(self) -> Array:
        """(V,) that noise alone makes this one effect look as needed."""
        return tail(self.statistics, *self.kinds)

    @property
    def kinds(self) -> tuple[Array, Array]:
        """(V,) numbers of sizes, and (V,) whether the null is a bound of the only size."""
        sizes = np.array([part.stop - part.start for part in self.parts])
        return sizes, np.array([is_one_sided(effect) for effect in self.effects])

    def one_each(self, chosen: Iterable[int]) -> list[int]:
        """Of several variants of one effect at one place the one that explains most; the most needed first."""
        return one_each(self.effects, sorted(chosen, key=lambda k: -self.statistics[k]))

    def pair(self, one: int, other: int) -> float:
        """By how much two effects together would lower chi^2."""
        return self._gain([one, other])

    def guess(self, chosen: Sequence[int]) -> Array:
        """(s,) best sizes of some effects together, in everyday sizes."""
        columns = self._columns(chosen)
        found = np.linalg.lstsq(self.R[:, columns], self.R[:, -1], rcond=1e-10)[0]
        return np.asarray(found)

    def std(self, k: int) -> Array:
        """(s,) standard errors of effect k's sizes, each with the others known, in everyday sizes."""
        return np.asarray(1 / np.sqrt(np.maximum(np.diag(self.products)[self.parts[k]], 1e-300)))

    @cached_property
    def likeness(self) -> Array:
        """(V, V) largest cosine between what two effects can do to the residuals."""
        bases = [np.linalg.qr(self.R[:, part])[0] for part in self.parts]
        found = np.eye(len(bases))
        for i, one in enumerate(bases):
            for j, other in enumerate(bases[:i]):
                found[i, j] = found[j, i] = np.linalg.norm(one.T @ other, 2)
        return found

    def draws(self, count: int, seed: int) -> Array:
        """(count, V) statistics under noise alone."""
        c = len(self.R) - 1
        scale = np.sqrt(np.maximum(np.diag(self.products)[:c], 1e-300))
        directions = self.R[:, :c] / scale
        noise = np.random.default_rng(seed).standard_normal((count, len(self.R))) @ directions
        found = np.zeros((count, len(self.parts)))
        for k, part in enumerate(self.parts):
            if self.absorbed[k]:
                continue
            if part.stop - part.start == 1:
                one = noise[:, part.start]
                found[:, k] = np.where(one > 0, one, 0.0) ** 2 if is_one_sided(self.effects[k]) else one**2
            else:
                inside = np.linalg.pinv(directions[:, part].T @ directions[:, part])
                found[:, k] = np.einsum("di,ij,dj->d", noise[:, part], inside, noise[:, part])
        return found

    def _gain(self, chosen: Sequence[int]) -> float:
        if any(self.absorbed[k] for k in chosen):
            return 0.0
        guess = self.guess(chosen)
        first = 0
        for k in chosen:
            if is_one_sided(self.effects[k]) and guess[first] < 0:
                return 0.0 if len(chosen) == 1 else max(self._gain([other]) for other in chosen if other != k)
            first += self.parts[k].stop - self.parts[k].start
        columns = self._columns(chosen)
        left = self.R[:, -1] - self.R[:, columns] @ guess
        return float(self.R[:, -1] @ self.R[:, -1] - left @ left)

    def _columns(self, chosen: Sequence[int]) -> list[int]:
        return [column for k in chosen for column in range(self.parts[k].start, self.parts[k].stop)]


def tail(statistics: Array, sizes: Array, one_sided: Array) -> Array:
    """(V,) probability of larger statistics under noise: chi-square, half of it at a bound."""
    found = np.asarray(stats.chi2.sf(statistics, sizes))
    return np.where(one_sided, np.where(statistics > 0, found / 2, 1.0), found)


def is_one_sided(effect: Effect) -> bool:
    """Whether the null is a bound of an effect's only size."""
    lower, upper = effect.bounds
    return effect.magnitude_count == 1 and bool(lower[0] == 0 or upper[0] == 0)


def one_each(effects: Sequence[Effect], order: Iterable[int]) -> list[int]:
    """Of several variants of one effect at one place the first in an order."""
    first: dict[Key, int] = {}
    for k in order:
        first.setdefault(effects[k].key, k)
    return list(first.values())


_DRAWS = 4000
_SURELY = 1.2816  # standard deviations: nine times in ten
_TONES = 3  # peaks of the residuals' spectrum that are looked at
_FINER = 4  # points of the spectrum a bin
_APART = 2.0  # bins between peaks


def chosen_effects(effects: Sequence[str | Effect] | None) -> tuple[Effect, ...]:
    """The effects to look for.

    Args:
        effects: ids of built-in ones, or instances; None: all that are built in.

    Raises:
        ChoiceError: an id that is not known.
        ShapeError: the same effect twice, or something that is no effect.
    """
    known = {effect.id: effect for effect in BUILTIN}
    found: list[Effect] = []
    for each in BUILTIN if effects is None else effects:
        if isinstance(each, str) and each not in known:
            raise ChoiceError("effect", each, known)
        effect = known[each] if isinstance(each, str) else each
        if not isinstance(effect, Effect):
            raise ShapeError("effects", repr(effect), "ids, or instances of vjm.effects.Effect")
        found.append(effect)
    names = [effect.id for effect in found]
    if len(set(names)) < len(names) or not names:
        raise ShapeError("effects", ", ".join(names) or "none", "at least one, each once")
    return tuple(found)


@dataclass(frozen=True)
class CandidateSet:
    """What is looked for.

    Attributes:
        variants: absent effects, one a place and choice of inner parameters.
        times: (V,) as how many independent looks each counts.
        untestable: effects that the recordings cannot show, with the reason.
    """

    variants: tuple[Effect, ...]
    times: Array
    untestable: tuple[tuple[Effect, str], ...]


def build_candidates(effects: Sequence[Effect], rig: Rig, point: Point) -> CandidateSet:
    """The variants of effects that a fit's recordings can show."""
    recordings: list[Recording] = [run.observed.recording for run in point.runs]
    variants: list[Effect] = []
    times: list[float] = []
    untestable = []
    for effect in effects:
        reason = effect.untestable(rig, recordings)
        if reason or not effect.places(rig):
            untestable.append((effect, reason or "the rig has no place for it"))
            continue
        own, looks = effect.variants(rig, recordings), 1.0
        for parameter in effect.parameters():
            if parameter.from_spectrum:
                own, looks = _at_spectral_peaks(own, parameter.name, point.runs)
        variants += own
        times += [looks] * len(own)
    return CandidateSet(tuple(variants), np.array(times), tuple(untestable))


def _at_spectral_peaks(variants: Sequence[Effect], name: str, runs: Sequence[Run]) -> tuple[tuple[Effect, ...], float]:
    """Return a variant for each place and peak of the residuals' spectra, and as how many independent looks one counts.

    Peaks of quiet recordings, where nothing else moves, and of all together, where joints are free to move.
    """
    time = max((run.observed.recording.time[run.observed.frames] for run in runs), key=lambda t: float(np.ptp(t)))
    duration, step = float(np.ptp(time)), float(np.median(np.diff(time)))
    frequencies = np.arange(1 / duration, 0.45 / step, 1 / (_FINER * duration))
    quiet = [run for run in runs if run.observed.recording.kind == "quiet"]
    peaks: list[float] = []
    for chosen in (quiet, runs):
        power, first = _power(chosen, frequencies), len(peaks)
        for k in np.argsort(power)[::-1].tolist() if chosen else ():
            if all(abs(frequencies[k] - other) > _APART / duration for other in peaks):
                peaks.append(float(frequencies[k]))
            if len(peaks) == first + _TONES:
                break
    at_places = {variant.link: variant for variant in variants}
    changes: list[dict[str, Any]] = [{name: peak} for peak in peaks]
    found = tuple(replace(variant, **change) for variant in at_places.values() for change in changes)
    return found, duration * 0.45 / step / max(len(found), 1)


def _power(runs: Sequence[Run], frequencies: Array) -> Array:
    """(F,) power of the residuals, all recordings, marker coordinates and encoders together."""
    power = np.zeros(frequencies.size)
    for run in runs:
        seen, time = run.observed, run.observed.recording.time - run.observed.recording.time[0]
        markers, angles = seen.spread(run.residual)
        for instants, residual in ((time[seen.frames], markers), (time, angles)):
            known = np.isfinite(residual).any(axis=1)
            if known.any():
                # Hann's window: what drifts slowly must not leak into all other frequencies.
                window = np.sin(np.pi * instants[known] / max(float(time[-1]), 1e-300)) ** 2
                waves = np.exp(-2j * np.pi * np.outer(frequencies, instants[known])) * window
                power += np.sum(np.abs(waves @ np.nan_to_num(residual[known])) ** 2, axis=1) / np.sum(window**2)
    return power


@dataclass(frozen=True)
class Family:
    """How p-values of single looks become those of the whole search.

    Attributes:
        looks: number of independent looks that the search amounts to.
        times: (V,) as of `Looked`.
        seen: the screen.
    """

    looks: float
    times: Array
    seen: Screen

    @classmethod
    def of(cls, seen: Screen, times: Array, alpha: float, seed: int) -> Family:
        """From the smallest p-values that noise alone gives, candidates being alike as they are (maximum statistic)."""
        if not seen.effects:
            return cls(1.0, times, seen)
        draws = seen.draws(_DRAWS, seed)
        sizes, one_sided = seen.kinds
        smallest = np.min(_several(tail(draws, sizes, one_sided), times), axis=1)
        level = max(float(np.quantile(smallest, alpha)), 1e-12)
        return cls(max(1.0, float(np.log1p(-alpha) / np.log1p(-level))), times, seen)

    @property
    def p_values(self) -> Array:
        """(V,) of the whole search."""
        return _several(_several(self.seen.p_values, self.times), np.full(len(self.times), self.looks))

    def p_of_fit(self, effect: Effect, fall: float) -> float:
        """Of the whole search, that noise alone lets a fitted effect lower chi^2 by so much (likelihood ratio)."""
        times = [t for t, each in zip(self.times.tolist(), self.seen.effects, strict=True) if each.key == effect.key]
        single = np.array([stats.chi2.sf(fall, effect.coordinates.size)])
        return float(_several(_several(single, np.array([max(times, default=1.0)])), np.array([self.looks]))[0])

    def threshold(self, alpha: float) -> Array:
        """(V,) z that a candidate must reach to be below alpha."""
        single = -np.expm1(np.log1p(-alpha) / (self.looks * self.times))
        sizes, one_sided = self.seen.kinds
        return np.asarray(np.sqrt(stats.chi2.isf(np.where(one_sided, 2 * single, single), sizes)))


def _several(p: Array, looks: Array) -> Array:
    """Probability that the smallest of several independent p-values is as small."""
    result: Array = -np.expm1(looks * np.log1p(-np.minimum(p, 1 - 1e-16)))
    return result


def candidates(candidate_set: CandidateSet, family: Family, alpha: float, floor: float) -> tuple[Candidate, ...]:
    """Every effect that was looked for, the most needed first, those that cannot be tested last.

    Args:
        candidate_set: the variants.
        family: p-values.
        alpha: of the whole search.
        floor: fall of chi^2 below which an effect does not matter, whatever its p-value.
    """
    seen, p = family.seen, family.p_values
    wanted = np.maximum(family.threshold(alpha), np.sqrt(floor)) + _SURELY
    found = []
    for k in seen.one_each(range(len(seen.effects))):
        effect = seen.effects[k]
        if seen.absorbed[k]:
            reason = "whatever its size, other parameters explain these recordings as well"
            found.append(Candidate(effect, None, None, {}, {}, reason))
            continue
        guess = effect.at(np.r_[seen.guess([k]), effect.coordinates[effect.magnitude_count :]])
        sizes = {each.name: float(guess.values[each.name]) for each in effect.parameters() if not each.shape_parameter}
        least = _least(effect, wanted[k] * seen.std(k))
        found.append(Candidate(effect, float(np.sqrt(seen.statistics[k])), float(p[k]), sizes, least))
    return (*found, *(Candidate(effect, None, None, {}, {}, reason) for effect, reason in candidate_set.untestable))


def _least(effect: Effect, coordinates: Array) -> dict[str, float]:
    """Sizes at coordinates (s,), as differences from the null (reciprocal ones as values)."""
    named = [each for each in effect.parameters() if not each.shape_parameter]
    found = {}
    for each, coordinate in zip(named, coordinates.tolist(), strict=False):
        value = each.value(coordinate)
        found[each.name] = value if each.reciprocal else abs(value - each.null)
    return found
