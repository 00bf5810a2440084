"""What the model leaves of a recording: marker by marker and frequency by frequency."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.experiment.records import Recording, Rig
from vjm.identification.records import RecordingFit
from vjm.report.choose import marker_name
from vjm.simulate.initial_state import Replay

Array = NDArray[np.float64]

_LEAST_VALUES = 8  # of a coordinate, for a spectrum
_FALSE_ALARM = 1e-3  # chance that white noise passes the limit anywhere


class Column(NamedTuple):
    """One measured coordinate of one marker, or all those of one.

    Attributes:
        name: as in the recordings' header.
        marker: its index among all markers of the rig.
        axes: the coordinates pooled, 0 for x and 1 for y.
    """

    name: str
    marker: int
    axes: tuple[int, ...]


def residual(recording: Recording, replay: Replay) -> Array:
    """(T, k, 2) measured less simulated marker coordinates [m]; NaN where not measured."""
    difference: Array = recording.markers - replay.simulation.markers
    return difference


def columns(rig: Rig, fits: list[RecordingFit], most: int) -> list[Column]:
    """The coordinates measured in any of the recordings, pooled marker by marker where there are too many."""
    measured = np.any([np.isfinite(fit.recording.markers).any(axis=0) for fit in fits], axis=0)
    seen = [(marker, tuple(np.flatnonzero(axes).tolist())) for marker, axes in enumerate(measured) if axes.any()]
    single = [Column(f"{marker_name(rig, m)}.{'xy'[axis]}", m, (axis,)) for m, axes in seen for axis in axes]
    if len(single) <= most:
        return single
    return [Column(marker_name(rig, marker), marker, axes) for marker, axes in seen]


def misfit(fits: list[RecordingFit], shown: list[Column]) -> tuple[Array, Array]:
    """RMS residual in units of the noise, and what white noise would pass anywhere in one report of a thousand.

    Both (recordings, columns); NaN where nothing was measured or simulated.
    """
    table = np.full((len(fits), len(shown)), np.nan)
    limit = table.copy()
    for row, fit in enumerate(fits):
        if fit.replay is None:
            continue
        left = residual(fit.recording, fit.replay) / fit.marker_noise
        for k, column in enumerate(shown):
            values = left[:, column.marker, list(column.axes)]
            known = np.isfinite(values)
            if known.any():
                count = int(known.sum())
                table[row, k] = np.sqrt(np.mean(values[known] ** 2))
                limit[row, k] = np.sqrt(stats.chi2.isf(_FALSE_ALARM / table.size, count) / count)
    return table, limit


class Spectrum(NamedTuple):
    """Amplitude of the residual, root mean square over all marker coordinates.

    A sine of amplitude a in every coordinate is a line of height a.

    Attributes:
        frequency: (F,) from one period in the recording up to half the camera's rate [Hz].
        amplitude: (F,) [m].
        white: what white noise of the camera's size would give [m].
        limit: what it would pass anywhere in one recording of a thousand [m].
    """

    frequency: Array
    amplitude: Array
    white: float
    limit: float


def spectrum(recording: Recording, replay: Replay, noise: float) -> Spectrum | None:
    """Amplitude spectrum of what the model leaves of a recording.

    Values lost for a moment count as zeros, and amplitudes are scaled by the number of those there are.

    Args:
        recording: as measured.
        replay: of it.
        noise: 1-sigma of a marker coordinate [m].

    Returns:
        None where too little was measured.
    """
    rows = recording.frames
    if rows.size < _LEAST_VALUES:
        return None
    time = recording.time[rows]
    step = float(np.median(np.diff(time)))
    place = np.round((time - time[0]) / step).astype(int)  # frames that the camera dropped leave gaps
    left = residual(recording, replay)[rows].reshape(rows.size, -1)
    counts = np.isfinite(left).sum(axis=0)
    kept = counts >= _LEAST_VALUES
    if not kept.any():
        return None
    even = np.zeros((int(place[-1]) + 1, int(kept.sum())))
    even[place] = np.nan_to_num(left[:, kept])
    lines = np.fft.rfft(even, axis=0)[1:-1] * (2 / counts[kept])
    power: Array = np.mean(np.abs(lines) ** 2, axis=1)
    white = noise**2 * float(np.mean(4 / counts[kept]))
    freedom = 2 * int(kept.sum())
    limit = white * float(stats.chi2.isf(_FALSE_ALARM / power.size, freedom)) / freedom
    frequency = np.asarray(np.fft.rfftfreq(len(even), step)[1:-1], dtype=np.float64)
    amplitude: Array = np.sqrt(power)
    return Spectrum(frequency, amplitude, float(np.sqrt(white)), float(np.sqrt(limit)))
