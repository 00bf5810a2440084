"""Overview of recordings: how long, how often, how noisy, how much they move and which modes they show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vjm.experiment.checks import moves
from vjm.experiment.spectrum import measure_modes, sensor_noise
from vjm.records import Array, Experiment, Indices, Record, Recording, Rig


@dataclass(frozen=True, repr=False)
class RecordingOverview(Record):
    """One recording in numbers.

    Attributes:
        recording: as it was read.
        duration: from the first row to the last [s].
        frame_rate: of the camera [Hz].
        sensor_rate: of the encoder [Hz]; None where there is none.
        frames: number of rows in which the camera saw anything.
        missing: number of marker coordinates that it did not see in those, though it did in others.
        noise: 1-sigma of a marker coordinate in this recording alone [m].
        motion: standard deviation of the coordinate that moves most, over that noise.
        modes: (m,) frequencies of the bending that it shows [Hz].
    """

    recording: Recording
    duration: float
    frame_rate: float
    sensor_rate: float | None
    frames: int
    missing: int
    noise: float
    motion: float
    modes: Array


def overviews_of(experiment: Experiment) -> tuple[RecordingOverview, ...]:
    """Return an overview of each recording."""
    return tuple(_overview(experiment.rig, recording) for recording in experiment.recordings)


def _overview(rig: Rig, recording: Recording) -> RecordingOverview:
    frames, time = recording.frames, recording.time
    markers = recording.markers[frames].reshape(frames.size, -1)
    markers = markers[:, np.isfinite(markers).any(axis=0)]
    encoder = time[np.isfinite(recording.theta).any(axis=1)]
    noise = sensor_noise(replace(rig, marker_noise=None), [replace(recording, kind="decay")])[0]
    return RecordingOverview(
        recording,
        float(np.ptp(time)),
        1.0 / float(np.median(np.diff(time[frames]))),
        1.0 / float(np.median(np.diff(encoder))) if encoder.size > 1 else None,
        frames.size,
        int(np.count_nonzero(~np.isfinite(markers))),
        noise,
        float(np.nanstd(markers, axis=0).max()) / noise,
        seen_modes(rig, recording, 3),
    )


def angle_at(recording: Recording, rows: Indices) -> Array:
    """Return the first active joint's angle at some rows (F,) [rad]; zero where there is no such joint."""
    if not recording.theta.shape[1]:
        return np.zeros(rows.size)
    known = np.isfinite(recording.theta[:, 0])
    return np.asarray(np.interp(recording.time[rows], recording.time[known], recording.theta[known, 0]))


def seen_modes(rig: Rig, recording: Recording, most: int) -> Array:
    """Return the frequencies (m,) that the first link's outermost markers show in its frame, slowest first [Hz]."""
    if not rig.links[0].markers or recording.kind not in ("driven", "decay") or recording.input != "torque":
        return np.empty(0)
    rows = recording.frames[:20_000]  # of a longer recording, its beginning
    markers, theta = recording.markers[rows][:, rig.marker_slices[0]], angle_at(recording, rows)
    y = markers[..., 1]
    if rig.links[0].markers_frame == "base":
        y = np.cos(theta)[:, None] * y - np.sin(theta)[:, None] * markers[..., 0]
    y = y[:, np.isfinite(y).mean(axis=0) > 0.5][:, -2:]  # NaN in frames that lack one are left out
    known = np.isfinite(y).all(axis=1)
    if (
        not y.size
        or known.sum() < 16
        or not any(moves(column[known], rig.marker_noise, rig.links[0].length) for column in y.T)
    ):
        return np.empty(0)
    driven = np.isfinite(recording.tau).all(axis=1) & bool(recording.tau.shape[1])
    torque = (recording.time[driven], recording.tau[driven]) if driven.sum() > 2 else None
    noise = sensor_noise(replace(rig, marker_noise=None), [replace(recording, kind="decay")])[0]
    deflection = y[known] - y[known].mean(axis=0)
    return measure_modes(recording.time[rows][known], deflection, noise, most, torque).frequencies
