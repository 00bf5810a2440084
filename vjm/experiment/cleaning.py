"""Coordinates that cannot be right are not measurements: they are left out before anything is fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vjm.experiment.checks import DEFAULT_MARKER_NOISE, clipped_runs, distance_limits
from vjm.experiment.records import Array, Mask, Recording, Rig

# A little too far is a scale that is off, or a marker that is not where the rig file says: something to be found, not
# to be left out. As a share of the distance, and at least [m].
_SLACK = 0.04
_SHORT = 0.01


def cleaned(rig: Rig, recording: Recording) -> Recording:
    """The recording without markers much farther apart than their link allows, and without clipped coordinates.

    Both are told of when the experiment is loaded. A frame in which leaving out one marker of a link makes the others
    possible loses that marker, any other such frame all markers of the link.

    Args:
        rig: says where the markers are.
        recording: as loaded.

    Returns:
        The recording itself where nothing is wrong with it.
    """
    noise = rig.marker_noise or DEFAULT_MARKER_NOISE
    wrong = np.zeros(recording.markers.shape, dtype=np.bool_)
    for link, own in zip(rig.links, rig.marker_slices, strict=True):
        arcs = np.array(link.markers)
        wrong[:, own] = impossible(recording.markers[:, own], arcs, noise)[..., None]
    wrong |= _clipped(recording.markers)
    if not (wrong & np.isfinite(recording.markers)).any():
        return recording
    return replace(recording, markers=np.where(wrong, np.nan, recording.markers))


def impossible(markers: Array, arcs: Array, noise: float) -> Mask:
    """Which markers (T, k) of one link cannot be where they were seen.

    Args:
        markers: (T, k, 2) positions [m].
        arcs: (k,) arc lengths [m].
        noise: 1-sigma of a coordinate [m].
    """
    offset = np.nan_to_num(markers[:, :, None] - markers[:, None])
    limits = distance_limits(arcs, noise) + np.maximum(_SLACK * np.abs(arcs[:, None] - arcs), _SHORT)
    beyond = np.hypot(offset[..., 0], offset[..., 1]) > limits
    count = beyond.sum(axis=(1, 2)) // 2
    # All the impossible pairs are this marker's.
    culprit = (beyond.sum(axis=2) == count[:, None]) & (count[:, None] > 0)
    single = culprit.sum(axis=1) == 1
    wrong: Mask = np.where(single[:, None], culprit, (count > 0)[:, None])
    return wrong


def _clipped(markers: Array) -> Mask:
    """Which coordinates (T, k, 2) stand still at their very extreme, as at the edge of an image."""
    flat = markers.reshape(len(markers), -1)
    wrong = np.zeros(flat.shape, dtype=np.bool_)
    for column, values in enumerate(flat.T):
        measured = np.flatnonzero(np.isfinite(values))
        for sign in (1.0, -1.0):
            starts, _ = clipped_runs(sign * values[measured])
            if starts.size:  # then shorter runs at the same value, at smaller peaks, are clipped too
                wrong[:, column] |= values == values[measured[starts[0]]]
    return wrong.reshape(markers.shape)
