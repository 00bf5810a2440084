"""Which effects are looked for, where, and how sure one must be: p-values of the whole search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.diagnosis.records import Candidate
from vjm.diagnosis.screen import Screen, tail
from vjm.effects import BUILTIN, Effect, ExternalTone
from vjm.errors import ChoiceError, ShapeError
from vjm.experiment.records import Recording, Rig
from vjm.identification.trajectory_problem import Point
from vjm.simulate.run import Run

Array = NDArray[np.float64]

COARSENESS = "unmodelled_mode"
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
class Looked:
    """What is looked for.

    Attributes:
        variants: absent effects, one a place and choice of inner parameters.
        times: (V,) as how many independent looks each counts.
        untestable: effects that the recordings cannot show, with the reason.
    """

    variants: tuple[Effect, ...]
    times: Array
    untestable: tuple[tuple[Effect, str], ...]


def looked_for(effects: Sequence[Effect], rig: Rig, point: Point) -> Looked:
    """The variants of effects that a fit's recordings can show."""
    recordings: list[Recording] = [run.observed.recording for run in point.runs]
    variants: list[Effect] = []
    times: list[float] = []
    untestable = []
    for effect in effects:
        if effect.id == COARSENESS:
            joints = ", ".join(f"{link.name} {link.virtual_joints}" for link in point.chain.links)
            untestable.append((effect, f"what so few virtual joints ({joints}) get wrong is measured and no cause"))
            continue
        reason = effect.untestable(rig, recordings)
        if reason or not effect.places(rig):
            untestable.append((effect, reason or "the rig has no place for it"))
            continue
        if isinstance(effect, ExternalTone):
            tones, looks = _tones(effect, rig, point.runs)
            variants += tones
            times += [looks] * len(tones)
            continue
        own = effect.variants(rig, recordings)
        variants += own
        times += [1.0] * len(own)
    return Looked(tuple(variants), np.array(times), tuple(untestable))


def _tones(effect: ExternalTone, rig: Rig, runs: Sequence[Run]) -> tuple[list[Effect], float]:
    """Tones at peaks of the residuals' spectra, and how many independent frequencies there were to look at.

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
    at_places = {each.link: each for each in effect.variants(rig, [run.observed.recording for run in runs])}
    found = [replace(each, frequency=peak) for each in at_places.values() for peak in peaks]
    return [*found], duration * 0.45 / step / max(len(found), 1)


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


def candidates(looked: Looked, family: Family, alpha: float, floor: float) -> tuple[Candidate, ...]:
    """Every effect that was looked for, the most needed first, those that cannot be tested last.

    Args:
        looked: the variants.
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
        guess = effect.at(np.r_[seen.guess([k]), effect.coordinates[effect.sizes :]])
        sizes = {each.name: float(guess.values[each.name]) for each in effect.parameters() if not each.inner}
        least = _least(effect, wanted[k] * seen.std(k))
        found.append(Candidate(effect, float(np.sqrt(seen.statistics[k])), float(p[k]), sizes, least))
    return (*found, *(Candidate(effect, None, None, {}, {}, reason) for effect, reason in looked.untestable))


def _least(effect: Effect, coordinates: Array) -> dict[str, float]:
    """Sizes at coordinates (s,), as differences from the null (reciprocal ones as values)."""
    named = [each for each in effect.parameters() if not each.inner]
    found = {}
    for each, coordinate in zip(named, coordinates.tolist(), strict=False):
        value = each.value(coordinate)
        found[each.name] = value if each.reciprocal else abs(value - each.null)
    return found
