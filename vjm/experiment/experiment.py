"""The experiment: a rig and what was recorded on it, with coordinates that cannot be right left out once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from vjm.errors import ExperimentError, shown
from vjm.experiment.checks import DEFAULT_MARKER_NOISE, clipped_runs, distance_limits, experiment_warnings
from vjm.experiment.records import Array, Mask, Recording, Rig, Role, as_rig, check_recording, several


@dataclass(frozen=True)
class Experiment:
    """A rig and what was recorded on it.

    Attributes:
        rig: the arm; a bare link is fine too.
        recordings: in the file's order; a bare one is fine too.
        file: the experiment file, None for an experiment built in Python.

    Raises:
        ExperimentError: no recording, or recordings of one `repeat` label that differ in kind, payload or gravity.
        RecordingError: a recording that does not fit the rig, or has fewer than 10 usable frames.
    """

    rig: Rig
    recordings: tuple[Recording, ...]
    file: Path | None = None

    def __post_init__(self) -> None:
        """Validate."""
        rig = as_rig(self.rig)
        rig.require_markers()
        recordings = []
        for number, recording in enumerate(several(self.recordings, Recording, "experiment", "recordings"), start=1):
            recording = recording.completed(rig, number)
            check_recording(recording.file, rig, recording)
            recordings.append(recording)
        object.__setattr__(self, "rig", rig)
        object.__setattr__(self, "recordings", tuple(recordings))
        self._check_repeats()

    def _check_repeats(self) -> None:
        """Refuse recordings of one `repeat` label that differ in kind, payload or gravity."""
        first: dict[str, int] = {}
        for index, recording in enumerate(self.recordings):
            if recording.repeat is None:
                continue
            number = first.setdefault(recording.repeat, index)
            other = self.recordings[number]
            for key in ("kind", "payload", "gravity"):
                here, there = getattr(recording, key), getattr(other, key)
                if here != there:
                    place = f"[recording[{number + 1}] {other.file}] with the same repeat label '{recording.repeat}'"
                    problem = f"{shown(here)}, but {place} has another"
                    table, expected = f"recording[{index + 1}] {recording.file}", f"{shown(there)}, or another label"
                    raise ExperimentError(self.file, table, key, problem, expected)

    def __repr__(self) -> str:
        lines = [repr(self.rig), *map(repr, self.recordings[:8])]
        more = len(self.recordings) - 8
        lines += [f"and {more} more recordings"] if more > 0 else []
        return "Experiment(" + "\n  ".join(lines) + ")"

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that a user should read before trusting results."""
        return tuple(experiment_warnings(self.rig, self.recordings))

    @cached_property
    def cleaned_recordings(self) -> tuple[Recording, ...]:
        """The recordings without coordinates that cannot be right: what models are fitted to and compared with."""
        return tuple(cleaned(self.rig, recording) for recording in self.recordings)

    def with_role(self, role: Role) -> tuple[Recording, ...]:
        """Return the recordings of one role as they were read, in order."""
        return tuple(recording for recording in self.recordings if recording.role == role)


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
