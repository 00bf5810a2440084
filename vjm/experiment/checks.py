"""What a user should know about recordings before trusting results: plain sentences that name the file."""

from __future__ import annotations

import difflib
from collections.abc import Sequence

import numpy as np

from vjm.errors import InsufficientDataError
from vjm.experiment.marker_checks import (
    DEFAULT_MARKER_NOISE,
    absence_warnings,
    clipping_warnings,
    distance_warnings,
    units_warnings,
)
from vjm.experiment.records import Array, Recording, Rig

LONGEST_INTERVAL = 3.0  # median camera intervals; anything longer is a gap
LEAST_MOTION = 4.0  # noise standard deviations; pure noise spreads over 2.8, see `moves`
DEFAULT_ENCODER_NOISE = 1e-3  # rad, where the experiment does not give it
LARGEST_TORQUE_DIFFERENCE = 0.05  # of the torque's root mean square, between repeats


def experiment_warnings(rig: Rig, recordings: Sequence[Recording]) -> list[str]:
    """Everything the checks have to say about an experiment, recording by recording, then across them."""
    warnings = [
        f"{recording.file}: {sentence}" for recording in recordings for sentence in recording_warnings(rig, recording)
    ]
    return warnings + repeat_warnings(recordings) + condition_warnings(recordings) + duplicate_warnings(recordings)


def recording_warnings(rig: Rig, recording: Recording) -> list[str]:
    """What the checks have to say about one recording, without its name."""
    frames = recording.frames
    time, markers = recording.time[frames], recording.markers[frames]
    names = [f"{link.name}.m{number}" for link in rig.links for number in range(1, len(link.markers) + 1)]
    needs_x = np.array([link.markers_frame == "base" for link in rig.links for _ in link.markers], dtype=np.bool_)
    warnings = absence_warnings(markers, names, needs_x) + gap_warnings(time) + _sensor_warnings(rig, recording, time)
    with np.errstate(over="ignore", invalid="ignore"):  # absurd coordinates deserve the sentence on units, not noise
        units = units_warnings(markers, sum(link.length for link in rig.links))
        warnings += units or _geometry_warnings(rig, time, markers, names)
        if recording.kind in ("driven", "decay"):
            warnings += _stillness_warnings(rig, recording)
    coordinates = [f"{name}.{axis}" for name in names for axis in "xy"]
    return warnings + clipping_warnings(time, markers.reshape(len(time), -1), coordinates)


def camera_rate(recording: Recording) -> float:
    """Frames per second of a recording's camera, from the median interval between frames [Hz].

    Half of it bounds the modes that can be asked of the recording.

    Raises:
        InsufficientDataError: the recording has fewer than two frames.
    """
    times = recording.time[recording.frames]
    if times.size < 2:
        reason = f"{recording.file} has {times.size} frame{'' if times.size == 1 else 's'} with a marker"
        raise InsufficientDataError("camera rate", reason, "record at least two")
    return float(1.0 / np.median(np.diff(times)))


def gap_warnings(times: Array) -> list[str]:
    """Intervals between frames that are much longer than usual.

    Args:
        times: (F,) instants of the camera's frames [s].
    """
    if times.size < 3:
        return []
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    gaps = np.flatnonzero(intervals > LONGEST_INTERVAL * usual)
    if not gaps.size:
        return []
    longest = gaps[intervals[gaps].argmax()]
    return [
        f"{gaps.size} gap{'s' if gaps.size > 1 else ''} without any marker, the longest {intervals[longest]:.4g} s "
        f"from t = {times[longest]:.6g} s, where frames usually follow every {usual:.4g} s"
    ]


def coverage_warnings(what: str, sensor_times: Array, frame_times: Array) -> list[str]:
    """A sensor that starts after the camera's first frame or stops before its last, by more than a camera interval.

    Args:
        what: the sensor's column.
        sensor_times: (S,) instants of the sensor's samples [s].
        frame_times: (F,) instants of the camera's frames [s].
    """
    if not sensor_times.size or frame_times.size < 2:
        return []
    usual = float(np.median(np.diff(frame_times)))
    if sensor_times[0] - frame_times[0] <= usual and frame_times[-1] - sensor_times[-1] <= usual:
        return []
    return [
        f"{what} is measured from t = {sensor_times[0]:.6g} to {sensor_times[-1]:.6g} s only, "
        f"the markers from {frame_times[0]:.6g} to {frame_times[-1]:.6g} s"
    ]


def difference_noise(values: Array) -> float:
    """1-sigma noise of a well sampled signal (N,), from the median size of its first differences; same unit."""
    differences = np.diff(values)
    if not differences.size:
        return 0.0
    spread = np.median(np.abs(differences - np.median(differences)))
    return float(1.4826 * spread / np.sqrt(2.0))  # 1.4826: standard deviation over median deviation, for a Gaussian


def moves(values: Array, noise: float | None, most_noise: float) -> bool:
    """Whether a signal spreads over more than its noise explains.

    The spread is the range of a sinusoid of the same variance, 2.8 standard deviations; unlike the plain range it
    does not grow with the number of samples.

    Args:
        values: (N,) one coordinate or angle; NaN where not measured.
        noise: its 1-sigma noise; None: estimated from first differences.
        most_noise: cap on that estimate, which fast motion inflates.
    """
    measured = values[np.isfinite(values)]
    if measured.size < 2:
        return False
    sigma = min(difference_noise(measured), most_noise) if noise is None else noise
    spread = 2.0 * np.sqrt(2.0) * (measured - measured[0]).std()  # from the first: a constant has exactly none
    return bool(spread > LEAST_MOTION * sigma)


def stillness_warnings(kind: str, moving: bool) -> list[str]:
    """A recording that should move and does not."""
    if moving:
        return []
    return [f"nothing moves beyond the noise, though the recording is of kind '{kind}'"]


def idle_torque_warnings(tau: Array) -> list[str]:
    """A driven recording in which every torque (T, nv) [N m] is zero throughout."""
    return [] if np.nanmax(np.abs(tau), initial=0.0) > 0.0 else ["every torque is zero, though the kind is 'driven'"]


def repeat_warnings(recordings: Sequence[Recording]) -> list[str]:
    """Recordings with one `repeat` label that differ in their torque or in their condition."""
    first: dict[str, Recording] = {}
    warnings: list[str] = []
    for recording in recordings:
        if recording.repeat is None or first.setdefault(recording.repeat, recording) is recording:
            continue
        other = first[recording.repeat]
        pair = f"{recording.file}: it repeats {other.file} (label '{recording.repeat}')"
        difference = torque_difference(other, recording)
        if difference > LARGEST_TORQUE_DIFFERENCE:
            warnings.append(f"{pair}, but their torques differ by {100.0 * difference:.3g} % of their root mean square")
        if recording.condition != other.condition:
            given, there = (repr(x.condition) if x.condition else "none" for x in (recording, other))
            warnings.append(f"{pair}, but its condition is {given} and the other's is {there}")
    return warnings


def torque_difference(first: Recording, second: Recording) -> float:
    """Largest root mean square difference of a joint's torque between two recordings, relative to the first's own.

    The recordings are aligned at their starts and compared where they overlap; zero where they cannot be compared.
    """
    largest = 0.0
    for own, other in zip(first.tau.T, second.tau.T, strict=True):
        mine, others = np.isfinite(own), np.isfinite(other)
        if mine.sum() < 2 or others.sum() < 2:
            continue
        times, other_times = first.time[mine] - first.time[0], second.time[others] - second.time[0]
        overlap = (times >= other_times[0]) & (times <= other_times[-1])
        torque = own[mine][overlap]
        difference = np.interp(times[overlap], other_times, other[others]) - torque
        size, change = (float(np.sqrt((x**2).mean())) if x.size else 0.0 for x in (torque, difference))
        if change > 0.0:
            largest = max(largest, change / size if size > 0.0 else np.inf)
    return largest


def condition_warnings(recordings: Sequence[Recording]) -> list[str]:
    """Conditions that are almost, but not quite, the word with a meaning."""
    return [
        f"{recording.file}: its condition {recording.condition!r} is not 'reference', and has no meaning"
        for recording in recordings
        if recording.condition not in (None, "reference")
        and difflib.get_close_matches(str(recording.condition).lower(), ["reference", "ref"], cutoff=0.75)
    ]


def duplicate_warnings(recordings: Sequence[Recording]) -> list[str]:
    """Files listed more than once: they would count as independent measurements."""
    files = [recording.file for recording in recordings]
    return [f"{file}: listed {files.count(file)} times" for file in dict.fromkeys(files) if files.count(file) > 1]


def _sensor_warnings(rig: Rig, recording: Recording, frame_times: Array) -> list[str]:
    warnings: list[str] = []
    for quantity, values in (("theta", recording.theta), ("tau", recording.tau)):
        for column, index in enumerate(rig.active_links):
            times = recording.time[np.isfinite(values[:, column])]
            warnings += coverage_warnings(f"{rig.links[index].name}.{quantity}", times, frame_times)
    if recording.kind == "driven" and rig.active_links:
        warnings += idle_torque_warnings(recording.tau)
    return warnings


def _geometry_warnings(rig: Rig, time: Array, markers: Array, names: list[str]) -> list[str]:
    noise = DEFAULT_MARKER_NOISE if rig.marker_noise is None else rig.marker_noise
    warnings: list[str] = []
    for link, own in zip(rig.links, rig.marker_slices, strict=True):
        if len(link.markers) > 1:
            warnings += distance_warnings(time, markers[:, own], np.array(link.markers), names[own], noise)
    return warnings


def _stillness_warnings(rig: Rig, recording: Recording) -> list[str]:
    coordinates = recording.markers.reshape(len(recording.time), -1).T
    moving = any(moves(values, rig.marker_noise, DEFAULT_MARKER_NOISE) for values in coordinates)
    moving = moving or any(moves(values, rig.encoder_noise, DEFAULT_ENCODER_NOISE) for values in recording.theta.T)
    return stillness_warnings(recording.kind, moving)
