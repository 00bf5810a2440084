"""Single measurements far from what comes before and after them: a label lost for a frame, a reflection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from vjm.experiment.records import Recording
from vjm.simulate.observation import Observed, view
from vjm.simulate.run import Run

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_AROUND = 15  # frames that say what a residual should be like
_SPREAD_OVER = 31  # frames that say how far residuals scatter about it
_FAR = 8.0  # standard deviations
_BEYOND = 5.0  # times the root mean square of the residuals but the largest
_TO_SIGMA = 1.4826  # from a median absolute deviation
_MOST = 0.02  # of a recording's values; more are no outliers but something the model lacks


def without_outliers(recording: Recording, markers: Array, noise: float) -> tuple[Recording, int]:
    """Leave out marker coordinates whose residual stands out from those of the frames around them.

    What a model gets wrong changes smoothly with time and is no outlier, however large.

    Args:
        recording: as measured.
        markers: (T, k, 2) simulated [m].
        noise: 1-sigma of a coordinate [m].

    Returns:
        The recording without them, and how many there were.
    """
    residual = (recording.markers - markers) / noise
    wrong = np.zeros(residual.shape, dtype=np.bool_)
    for index in np.ndindex(residual.shape[1:]):
        values = residual[(slice(None), *index)]
        known = np.flatnonzero(np.isfinite(values))
        if known.size > _SPREAD_OVER:
            wrong[(known, *index)] = _outlying(values[known])
    count = int(wrong.sum())
    if count == 0 or count > max(1.0, _MOST * np.isfinite(residual).sum()):
        return recording, 0
    return replace(recording, markers=np.where(wrong, np.nan, recording.markers)), count


def trimmed(run: Run) -> Observed:
    """What was measured in a recording that a model follows, without outliers; the same where there are none."""
    seen = run.observed
    markers = view(run.arm, seen.arcs, run.steps, seen.recording.time)
    recording, count = without_outliers(seen.recording, markers, seen.noise[0])
    return seen.again(recording) if count else seen


def _outlying(values: Array) -> Mask:
    away = np.abs(values - median_filter(values, _AROUND, mode="nearest"))
    scatter = _TO_SIGMA * median_filter(away, _SPREAD_OVER, mode="nearest")
    usual = np.sort(np.abs(values))[: max(1, int((1 - _MOST) * values.size))]
    found: Mask = away > np.maximum(_FAR * np.maximum(scatter, 1.0), _BEYOND * np.sqrt(np.mean(usual**2)))
    return found
