"""Coordinates that cannot be right are not measurements: they are left out before anything is fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vjm.experiment.checks import DEFAULT_MARKER_NOISE, clipped_runs, distance_limits
from vjm.experiment.records import Array, Mask, Recording, Rig


def cleaned(rig: Rig, recording: Recording) -> Recording:
    """Return the recording without markers much farther apart than their link allows, and without clipped coordinates.

    The experiment's warnings tell of both. A frame in which leaving out one marker of a link makes the others
    possible loses that marker, any other such frame all markers of the link.

    Args:
        rig: says where the markers are.
        recording: as read.

    Returns:
        The recording itself where nothing is wrong with it.
    """
    noise = rig.marker_noise or DEFAULT_MARKER_NOISE
    wrong = _clipped(recording.markers)
    for link, own in zip(rig.links, rig.marker_slices, strict=True):
        wrong[:, own] |= _impossible(recording.markers[:, own], np.array(link.markers), noise)[..., None]
    if not (wrong & np.isfinite(recording.markers)).any():
        return recording
    return replace(recording, markers=np.where(wrong, np.nan, recording.markers))


def _impossible(markers: Array, arcs: Array, noise: float) -> Mask:
    """Return which markers (T, k) of one link, at arc lengths (k,) [m], cannot be where they were seen."""
    offset = np.nan_to_num(markers[:, :, None] - markers[:, None])
    # A little too far is a scale that is off, or a marker that is not where the rig file says: something to be found,
    # not to be left out. As a share of the distance, and at least 1 cm.
    slack = np.maximum(0.04 * np.abs(arcs[:, None] - arcs), 0.01)
    beyond = np.hypot(offset[..., 0], offset[..., 1]) > distance_limits(arcs, noise) + slack
    count = beyond.sum(axis=(1, 2)) // 2
    culprit = (beyond.sum(axis=2) == count[:, None]) & (count[:, None] > 0)  # all such pairs are its
    single = culprit.sum(axis=1) == 1
    wrong: Mask = np.where(single[:, None], culprit, (count > 0)[:, None])
    return wrong


def _clipped(markers: Array) -> Mask:
    """Return which coordinates (T, k, 2) stand still at their very extreme, as at the edge of an image."""
    flat = markers.reshape(len(markers), -1)
    wrong = np.zeros(flat.shape, dtype=np.bool_)
    for column, values in enumerate(flat.T):
        measured = np.flatnonzero(np.isfinite(values))
        for sign in (1.0, -1.0):
            starts, _ = clipped_runs(sign * values[measured])
            if starts.size:  # then shorter runs at the same value, at smaller peaks, are clipped too
                wrong[:, column] |= values == values[measured[starts[0]]]
    return wrong.reshape(markers.shape)
