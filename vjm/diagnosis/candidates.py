"""Candidates of the search: which absent effects the recordings can show, and p-values of the search as a whole.

An effect is screened at every place of the rig and for every starting value of its shape parameters; looking so often
makes chance findings likely. The p-values are therefore those of the smallest p-value among all candidates under
noise that correlates as the candidates do (minP: Westfall and Young, Resampling-Based Multiple Testing, 1993).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy import stats

from vjm.diagnosis.records import Candidate
from vjm.diagnosis.screen import Screen
from vjm.effects import Effect
from vjm.identification.trajectory_fit import Point
from vjm.records import Array, Rig
from vjm.simulation.run import Run

_DRAWS = 4000  # the 1 % quantile of the smallest p-value is then known within 16 % (1/sqrt(0.01 * 4000))
_POWER = 1.2816  # standard deviations: the normal distribution's 90 % quantile


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
    def of(cls, effects: Sequence[Effect], rig: Rig, point: Point) -> Self:
        """Collect the variants of effects that a fit's recordings can show.

        Args:
            effects: absent effects, without a place.
            rig: the arm.
            point: a fit; frequencies of periodic forces are looked for in its residuals.
        """
        recordings = [run.observed.recording for run in point.runs]
        variants: list[Effect] = []
        multiplicity: list[float] = []
        untestable: list[Candidate] = []
        for effect in effects:
            reason = effect.untestable(rig, recordings) or ("" if effect.places(rig) else "the rig has no place for it")
            if reason:
                untestable.append(Candidate.untestable(effect, reason))
                continue
            own, tests = effect.variants(rig, recordings), 1.0
            for parameter in effect.parameters():
                if parameter.from_spectrum:
                    peaks, frequencies = _residual_peaks(point.runs)
                    places = {variant.link: variant for variant in own}.values()
                    changes: list[dict[str, Any]] = [{parameter.name: peak} for peak in peaks]
                    own = tuple(replace(variant, **change) for variant in places for change in changes)
                    tests = frequencies / max(len(own), 1)
            variants += own
            multiplicity += [tests] * len(own)
        return cls(tuple(variants), np.array(multiplicity), tuple(untestable))


def _residual_peaks(runs: Sequence[Run]) -> tuple[list[float], float]:
    """Frequencies of the residuals' highest spectral peaks [Hz], and the number of independent frequencies searched.

    Peaks of quiet recordings, where nothing else moves, and of all together, where joints are free to move.
    """
    time = max((run.observed.recording.time[run.observed.frames] for run in runs), key=lambda t: float(np.ptp(t)))
    duration, step = float(np.ptp(time)), float(np.median(np.diff(time)))
    highest = 0.45 / step  # nearer to half the sampling rate, a tone cannot be distinguished from its image
    frequencies = np.arange(1 / duration, highest, 1 / (4 * duration))  # between two, a peak loses 5 % at most
    peaks: list[float] = []
    for chosen in ([run for run in runs if run.observed.recording.kind == "quiet"], runs):
        power, first = _power(chosen, frequencies), len(peaks)
        for k in np.argsort(power)[::-1].tolist() if chosen else ():
            # Half the width of the main lobe of Hann's window (Harris, Proceedings of the IEEE 66, 1978).
            if all(abs(frequencies[k] - peak) > 2.0 / duration for peak in peaks):
                peaks.append(float(frequencies[k]))
            if len(peaks) == first + 3:  # more tones at once have not been met
                break
    return peaks, duration * highest


def _power(runs: Sequence[Run], frequencies: Array) -> Array:
    """Power of the residuals (F,), all recordings, marker coordinates and encoders together."""
    power = np.zeros(frequencies.size)
    for run in runs:
        observed, time = run.observed, run.observed.recording.time - run.observed.recording.time[0]
        markers, angles = observed.on_grid(run.residual)
        for instants, residual in ((time[observed.frames], markers), (time, angles)):
            known = np.isfinite(residual).any(axis=1)
            if known.any():
                # Hann's window: what drifts slowly must not leak into all other frequencies.
                window = np.sin(np.pi * instants[known] / max(float(time[-1]), 1e-300)) ** 2
                waves = np.exp(-2j * np.pi * np.outer(frequencies, instants[known])) * window
                power += np.sum(np.abs(waves @ np.nan_to_num(residual[known])) ** 2, axis=1) / np.sum(window**2)
    return power


@dataclass(frozen=True)
class FamilyTest:
    """Score tests of all candidates, with the p-values of the search as a whole.

    Attributes:
        screen: the score tests.
        multiplicity: (V,) as of `CandidateSet`.
        tests: number of independent tests that the search amounts to.
    """

    screen: Screen
    multiplicity: Array
    tests: float

    @classmethod
    def of(cls, screen: Screen, multiplicity: Array, alpha: float, seed: int) -> FamilyTest:
        """Count the independent tests that give the smallest p-value under noise its distribution near alpha."""
        if not screen.effects:
            return cls(screen, multiplicity, 1.0)
        smallest = np.min(_smallest_of(screen.tail(screen.draws(_DRAWS, seed)), multiplicity), axis=1)
        level = max(float(np.quantile(smallest, alpha)), 1e-12)
        return cls(screen, multiplicity, max(1.0, float(np.log1p(-alpha) / np.log1p(-level))))

    @property
    def p_values(self) -> Array:
        """(V,) probability that noise alone makes any candidate look as needed."""
        return _smallest_of(_smallest_of(self.screen.tail(self.screen.statistics), self.multiplicity), self.tests)

    def p_of_fit(self, effect: Effect, decrease: float) -> float:
        """Return the p-value of a fitted effect that lowers chi^2 by so much (likelihood ratio)."""
        own = [
            count
            for count, variant in zip(self.multiplicity.tolist(), self.screen.effects, strict=True)
            if variant.key == effect.key
        ]
        single = np.array([stats.chi2.sf(decrease, effect.coordinates.size)])
        return float(_smallest_of(_smallest_of(single, max(own, default=1.0)), self.tests)[0])

    def _threshold(self, alpha: float) -> Array:
        """Return the z (V,) from which a candidate's p-value is below alpha."""
        single = -np.expm1(np.log1p(-alpha) / (self.tests * self.multiplicity))
        tail = np.where(self.screen.one_sided, 2 * single, single)
        return np.asarray(np.sqrt(stats.chi2.isf(tail, self.screen.sizes)))

    def table(self, alpha: float, least_decrease: float) -> tuple[Candidate, ...]:
        """List the effects that were tested, the most needed first.

        Args:
            alpha: significance level of the search.
            least_decrease: decrease of chi^2 below which an effect does not matter, whatever its p-value.
        """
        screen, p = self.screen, self.p_values
        detectable = np.maximum(self._threshold(alpha), np.sqrt(least_decrease)) + _POWER
        rows = []
        for k in screen.one_each(range(len(screen.effects))):
            effect = screen.effects[k]
            if screen.absorbed[k]:
                reason = "whatever its size, other parameters explain these recordings as well"
                rows.append(Candidate.untestable(effect, reason))
                continue
            guess = effect.at(np.r_[screen.guess([k]), effect.coordinates[effect.magnitude_count :]]).values
            sizes = [parameter for parameter in effect.parameters() if not parameter.shape_parameter]
            smallest = {}
            for parameter, coordinate in zip(sizes, (detectable[k] * screen.std(k)).tolist(), strict=False):
                value = parameter.value(coordinate)
                smallest[parameter.name] = value if parameter.reciprocal else abs(value - parameter.null)
            guessed = {parameter.name: float(guess[parameter.name]) for parameter in sizes}
            rows.append(Candidate(effect, float(np.sqrt(screen.statistics[k])), float(p[k]), guessed, smallest))
        return tuple(rows)


def _smallest_of(p: Array, count: Array | float) -> Array:
    """Probability that the smallest of several independent p-values is as small."""
    result: Array = -np.expm1(count * np.log1p(-np.minimum(p, 1 - 1e-16)))
    return result
