"""Whether what a model leaves is noise: residuals in bands of frequency, beside what noise has there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.fft import dct

from vjm.simulate.run import Run

Array = NDArray[np.float64]

_EDGES = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # Hz
_NOISE_FROM = 0.5  # of the highest frequency: beyond, a camera or encoder shows nothing but noise
_MISJUDGED = 1.3  # times the mean square expected: more is no misjudged noise but something in the recording
_LEAST = 20  # coefficients of a band that is looked at


@dataclass(frozen=True)
class Band:
    """One kind of sensor of one recording in one band of frequencies.

    Attributes:
        file: the recording's.
        sensor: `markers` or `encoder`.
        band: lowest and highest frequency [Hz].
        excess: sum of squares beyond what noise has there, in units of the noise.
        p_value: that noise alone has so much.
    """

    file: str
    sensor: str
    band: tuple[float, float]
    excess: float
    p_value: float


@dataclass(frozen=True)
class Leftover:
    """What is left of all recordings.

    Attributes:
        bands: the least likely first.
        p_value: that noise alone leaves as much in any band, or in all together.
        excess: sum of squares of all bands beyond that of noise, in units of the noise.
    """

    bands: tuple[Band, ...]
    p_value: float
    excess: float


def leftover(runs: Sequence[Run], expected: float = 1.0) -> Leftover:
    """Judge the residuals of recordings.

    Args:
        runs: beside what was measured; their residuals are white where they are noise.
        expected: mean square of a residual that is taken as noise.
    """
    cells = [cell for run in runs for cell in _cells(run)]
    found, total, freedom = [], 0.0, 0
    for run, sensor, band, squares, count, level in cells:
        power = expected * float(np.clip(level / expected, 1.0, _MISJUDGED))
        p = float(stats.chi2.sf(squares / power, count))
        found.append(Band(run.observed.recording.file, sensor, band, squares / power - count, p))
        total, freedom = total + squares / power, freedom + count
    if not found:
        return Leftover((), 1.0, 0.0)
    together = float(stats.chi2.sf(total, freedom))
    smallest = min(min(each.p_value for each in found) * len(found), together)
    ordered = tuple(sorted(found, key=lambda each: (each.p_value, -each.excess)))
    return Leftover(ordered, min(1.0, 2 * smallest), total - freedom)


def _cells(run: Run) -> Iterator[tuple[Run, str, tuple[float, float], float, int, float]]:
    """Sums of squares over a band, their number, and the mean square where there is nothing but noise."""
    seen = run.observed
    markers, angles = seen.spread(run.residual)
    time = seen.recording.time
    for sensor, series, instants in (("markers", markers, time[seen.frames]), ("encoder", angles, time)):
        rows = np.isfinite(series).any(axis=1)
        if rows.sum() < 2 * _LEAST:
            continue
        values, instants = series[rows], instants[rows]
        complete = np.isfinite(values).all(axis=0)
        if not complete.any():
            values, complete = np.nan_to_num(values), np.isfinite(values).mean(axis=0) > 0.5
        coefficients = dct(values[:, complete], axis=0, norm="ortho") ** 2
        highest = 0.5 * (len(instants) - 1) / max(float(np.ptp(instants)), 1e-300)
        frequencies = np.linspace(0.0, highest, len(coefficients))
        level = float(np.mean(coefficients[frequencies > _NOISE_FROM * highest]))
        edges = [*(edge for edge in _EDGES if edge < _NOISE_FROM * highest), _NOISE_FROM * highest]
        for low, high in pairwise(edges):
            inside = coefficients[(frequencies >= low) & (frequencies < high)]
            if inside.size >= _LEAST:
                yield run, sensor, (low, high), float(inside.sum()), int(inside.size), level
