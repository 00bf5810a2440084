"""Single measurements far from what comes before and after them: a label lost for a frame, a reflection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter, median_filter

from vjm.records import Array, Mask
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

_SCALE_FRAMES = 31  # whose median absolute deviation, with an error of a sixth, is the residuals' standard deviation
_MAX_SHARE = 0.02  # of a recording's values; more are no outliers but something the model lacks
# Offsets of the frames that predict one by a polynomial: from before, from after, and from both sides.
_PREDICTORS = ((-3, -2, -1), (-2, -1)), ((1, 2, 3), (1, 2)), ((-2, -1, 1, 2),)


def trimmed(run: Run) -> Observations:
    """Return a run's observations without outliers; the same object where there are none.

    Marker coordinates are left out whose residual stands out from those of the frames around them. What a model gets
    wrong changes smoothly with time and is no outlier, however large.
    """
    observed, recording = run.observed, run.observed.recording
    markers = observed.arcs.positions_in_frames(run.arm, run.trajectory, recording.time)
    outlying = _outliers((recording.markers - markers) / observed.noise[0], recording.time)
    if not outlying.any():
        return observed
    return observed.of_recording(replace(recording, markers=np.where(outlying, np.nan, recording.markers)))


def _outliers(residual: Array, time: Array) -> Mask:
    """Return (T, k, 2) True where a coordinate's weighted residual stands out; nowhere if too many do."""
    outlying = np.zeros(residual.shape, dtype=np.bool_)
    for index in np.ndindex(residual.shape[1:]):
        values = residual[(slice(None), *index)]
        known = np.flatnonzero(np.isfinite(values))
        if known.size > _SCALE_FRAMES:
            outlying[(known, *index)] = _outlying(values[known]) | _unpredicted(values[known], time[known])
    too_many = outlying.sum() > max(1.0, _MAX_SHARE * np.isfinite(residual).sum())
    return np.zeros_like(outlying) if too_many else outlying


def _outlying(values: Array) -> Mask:
    """Return True where a residual is far from the running median, beside the scatter around it and that of most."""
    distance = np.abs(values - median_filter(values, 15, mode="nearest"))
    typical = np.sort(np.abs(values))[: max(1, int((1 - _MAX_SHARE) * values.size))]
    outlying: Mask = distance > np.maximum(_threshold(distance), 5 * np.sqrt(np.mean(typical**2)))
    return outlying


def _threshold(distance: Array) -> Array:
    """Return the distance beyond which a value is outlying; 1.4826 median absolute deviations are a standard one."""
    scale = 1.4826 * median_filter(distance, _SCALE_FRAMES, mode="nearest")
    # Eight standard deviations: beyond any of a million normal values, and tails heavier than normal.
    threshold: Array = 8 * np.maximum(scale, 1.0)
    return threshold


def _unpredicted(values: Array, time: Array) -> Mask:
    """Return True where neither the frames before nor those after, nor both together, predict a residual.

    What a model misses smoothly they predict. Of several frames close together, the worst is left out before the others
    are judged: a wrong one disturbs the predictions of seven.
    """
    outlying = np.zeros(values.size, dtype=np.bool_)
    for _ in range(3):
        inliers = np.flatnonzero(~outlying)
        error = _prediction_error(values[inliers], time[inliers])
        peaks = (error > _threshold(error)) & (error == maximum_filter(error, 7))
        if not peaks.any():
            break
        outlying[inliers[peaks]] = True
    return outlying


def _prediction_error(values: Array, time: Array) -> Array:
    """Return the distance (T,) of values from the nearest prediction by polynomials through the frames around them.

    After a step, as of a marker that slips, that is by those after it. Zero where frames are on one side only.
    """
    error = np.full((len(_PREDICTORS), values.size), np.inf)
    for side, predictors in zip(error, _PREDICTORS, strict=True):
        for offsets in predictors:
            rows = np.arange(max(0, -min(offsets)), values.size - max(0, max(offsets)))
            neighbours = rows[:, None] + np.array(offsets)
            weights = _lagrange_weights(time[neighbours], time[rows])
            reliable = np.linalg.norm(weights, axis=1) < 5  # or the prediction is that much noisier than a value
            rows, neighbours, weights = rows[reliable], neighbours[reliable], weights[reliable]
            side[rows] = np.minimum(side[rows], np.abs(values[rows] - np.sum(weights * values[neighbours], axis=1)))
    return np.where(np.isinf(error[:2]).any(axis=0), 0.0, error.min(axis=0))


def _lagrange_weights(nodes: Array, at: Array) -> Array:
    """Return the weights (R, m) of values at nodes (R, m) in the polynomial through them at (R,)."""
    differences = nodes[:, :, None] - nodes[:, None, :]
    distances = np.broadcast_to(at[:, None, None] - nodes[:, None, :], differences.shape)
    diagonal = np.eye(nodes.shape[1], dtype=np.bool_)
    weights: Array = np.prod(np.where(diagonal, 1.0, distances / np.where(diagonal, 1.0, differences)), axis=2)
    return weights
