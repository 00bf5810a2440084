"""Sensor noise estimated from recordings themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import get_window

from vjm.experiment.records import Array, Recording, Rig


def white_noise(samples: ArrayLike) -> float:
    """Return the 1-sigma of the white part of evenly sampled signals.

    A low quantile of the windowed periodogram: its bins are noise power times an exponential variate, and the few that
    hold motion do not move the quantile.

    Args:
        samples: (T, m), complete rows; columns are signals with the same noise.

    Returns:
        The noise, in the signals' unit; NaN for fewer than 16 samples.
    """
    values = np.asarray(samples, dtype=float)
    if len(values) < 16:
        return float("nan")
    # Ends that differ would leak over the whole spectrum: the window and the second difference of a line take that out.
    line = np.linspace(0, 1, len(values))[:, None]
    detrended = values - values[:1] * (1 - line) - values[-1:] * line
    window = get_window("blackmanharris", len(values))[:, None]
    power = np.abs(np.fft.rfft(detrended * window, axis=0)[4:-1]) ** 2 / np.sum(window**2)
    low = 0.3  # of the spectrum's bins: motion fills few of them, noise fills all
    return float(np.sqrt(np.quantile(power, low) / -np.log(1 - low)))


def sensor_noise(rig: Rig, recordings: Sequence[Recording]) -> tuple[float, float]:
    """Return marker noise [m] and encoder noise [rad]: the experiment's, else the median over recordings.

    Quiet recordings, where there are any, speak for all.
    """
    quiet = [recording for recording in recordings if recording.kind == "quiet"]
    chosen = quiet or list(recordings)
    size = max(link.length for link in rig.links)
    markers = rig.marker_noise or _median([_marker_noise(recording) for recording in chosen], size)
    encoder = rig.encoder_noise or _median([white_noise(_complete(r.theta)) for r in chosen if r.theta.size], 1.0)
    return markers, encoder


def _complete(values: Array) -> Array:
    """Return the complete rows of the columns that were measured."""
    rows = values[np.isfinite(values).any(axis=1)]
    rows = rows[:, np.isfinite(rows).any(axis=0)]
    kept: Array = rows[np.isfinite(rows).all(axis=1)]
    return kept


def _marker_noise(recording: Recording) -> float:
    return white_noise(_complete(recording.markers[recording.frames].reshape(recording.frames.size, -1)))


def _median(values: list[float], size: float) -> float:
    known = [value for value in values if np.isfinite(value)]
    return max(float(np.median(known)) if known else 0.0, 1e-9 * size)  # exact data still need a finite weight
