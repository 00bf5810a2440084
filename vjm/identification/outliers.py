"""Single measurements far from what comes before and after them: a label lost for a frame, a reflection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter, median_filter

from vjm.records import Array, Mask, Recording
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

_AROUND = 15  # frames that say what a residual should be like
_SPREAD_OVER = 31  # frames that say how far residuals scatter about it
_FAR = 8.0  # standard deviations
_BEYOND = 5.0  # times the root mean square of the residuals but the largest
_TO_SIGMA = 1.4826  # from a median absolute deviation
# Frames that lead to one from before, from after, and from both sides.
_LEADING = ((-3, -2, -1), (-2, -1)), ((1, 2, 3), (1, 2)), ((-2, -1, 1, 2),)
_LOUDEST = 5.0  # times the noise of a value, in what such frames lead to; more are too far away
_REACH = 7  # frames that one that is wrong leads astray, with itself
_PASSES = 3
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
            wrong[(known, *index)] = _outlying(values[known]) | _leaping(values[known], recording.time[known])
    count = int(wrong.sum())
    if count == 0 or count > max(1.0, _MOST * np.isfinite(residual).sum()):
        return recording, 0
    return replace(recording, markers=np.where(wrong, np.nan, recording.markers)), count


def trimmed(run: Run) -> Observations:
    """What was measured in a recording that a model follows, without outliers; the same where there are none."""
    seen = run.observed
    markers = seen.arcs.frames(run.arm, run.trajectory, seen.recording.time)
    recording, count = without_outliers(seen.recording, markers, seen.noise[0])
    return seen.of_recording(recording) if count else seen


def _outlying(values: Array) -> Mask:
    away = np.abs(values - median_filter(values, _AROUND, mode="nearest"))
    scatter = _TO_SIGMA * median_filter(away, _SPREAD_OVER, mode="nearest")
    usual = np.sort(np.abs(values))[: max(1, int((1 - _MOST) * values.size))]
    found: Mask = away > np.maximum(_FAR * np.maximum(scatter, 1.0), _BEYOND * np.sqrt(np.mean(usual**2)))
    return found


def _leaping(values: Array, time: Array) -> Mask:
    """What neither the frames before nor those after, nor both together, lead to, however much a model misses smoothly.

    Of several frames close together the worst is left out before the others are judged.
    """
    found = np.zeros(values.size, dtype=np.bool_)
    for _ in range(_PASSES):
        kept = np.flatnonzero(~found)
        away = _off_course(values[kept], time[kept])
        scatter = _TO_SIGMA * median_filter(away, _SPREAD_OVER, mode="nearest")
        far = (away > _FAR * np.maximum(scatter, 1.0)) & (away == maximum_filter(away, _REACH))
        if not far.any():
            break
        found[kept[far]] = True
    return found


def _off_course(values: Array, time: Array) -> Array:
    """(T,) how far values are off the nearest of the polynomials through the frames that lead to them.

    After a step, as of a marker that slips, those after it do. Zero where frames lead to a value from one side only.
    """
    away = np.full((len(_LEADING), values.size), np.inf)
    for side, several in zip(away, _LEADING, strict=True):
        for offsets in several:
            rows = np.arange(max(0, -min(offsets)), values.size - max(0, max(offsets)))
            given = rows[:, None] + np.array(offsets)
            weights = _lagrange(time[given], time[rows])
            near = np.linalg.norm(weights, axis=1) < _LOUDEST
            rows, given, weights = rows[near], given[near], weights[near]
            side[rows] = np.minimum(side[rows], np.abs(values[rows] - np.sum(weights * values[given], axis=1)))
    return np.where(np.isinf(away[:2]).any(axis=0), 0.0, away.min(axis=0))


def _lagrange(nodes: Array, at: Array) -> Array:
    """(R, m) weights of values at nodes (R, m) in the polynomial through them at (R,)."""
    apart = nodes[:, :, None] - nodes[:, None, :]
    away = np.broadcast_to(at[:, None, None] - nodes[:, None, :], apart.shape)
    same = np.eye(nodes.shape[1], dtype=np.bool_)
    found: Array = np.prod(np.where(same, 1.0, away / np.where(same, 1.0, apart)), axis=2)
    return found
