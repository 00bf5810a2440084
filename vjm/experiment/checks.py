"""What a user should know about recordings before trusting results: plain sentences that name the file."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from vjm.errors import InsufficientDataError
from vjm.experiment.records import Array, Recording, Rig

DEFAULT_MARKER_NOISE = 1e-3  # m, where the experiment does not give it
LARGEST_REACH = 20.0  # arm lengths; a coordinate beyond is no longer in metres
TOLERANCE = 6.0  # standard deviations of a distance: chance reaches it once in 1e9 comparisons
SHORTEST_CLIP = 5  # frames
CLIP_DROP = 20.0  # finest steps; a smooth peak, rounded, drops by 9 within its own width (see `clipped_runs`)
MOST_SWAP_FRAMES = 50


def units_warnings(markers: Array, arm_length: float) -> list[str]:
    """Coordinates far outside the arm's reach.

    Args:
        markers: (T, k, 2) positions [m].
        arm_length: sum of the links' lengths [m].
    """
    largest = float(np.nanmax(np.abs(markers), initial=0.0))
    if largest <= LARGEST_REACH * arm_length:
        return []
    return [
        f"a marker coordinate reaches {largest:.4g} m with an arm {arm_length:.4g} m long: "
        "the coordinates look like millimetres, and metres are expected"
    ]


def distance_warnings(time: Array, markers: Array, arcs: Array, names: list[str], noise: float) -> list[str]:
    """Frames in which two markers of one link are farther apart than the link between them is long.

    Args:
        time: (T,) [s].
        markers: (T, k, 2) positions of one link's markers [m]; an unknown coordinate is NaN and counts as no distance.
        arcs: (k,) arc lengths of the markers [m].
        names: k names of the markers.
        noise: 1-sigma noise of a coordinate [m].
    """
    limits = distance_limits(arcs, noise)
    bad, excess, pair = _beyond_limits(markers, limits)
    if not bad.size:
        return []
    first, second = pair
    sentence = (
        f"in {bad.size} frame{'s' if bad.size > 1 else ''} (first at t = {time[bad[0]]:.6g} s) markers are "
        f"farther apart than the link allows, by up to {excess:.3g} m between {names[first]} and {names[second]}, "
        f"which are {abs(arcs[second] - arcs[first]):.4g} m apart along the link"
    )
    return [sentence + _swap_hint(markers[bad], limits, names)]


def distance_limits(arcs: Array, noise: float) -> Array:
    """(k, k) distance [m] beyond which two of a link's markers cannot be apart, whatever the link's shape.

    Args:
        arcs: (k,) arc lengths of the markers [m].
        noise: 1-sigma noise of a coordinate [m].
    """
    limits: Array = np.abs(arcs[:, None] - arcs) + TOLERANCE * np.sqrt(2.0) * noise
    return limits


def _beyond_limits(markers: Array, limits: Array) -> tuple[NDArray[np.intp], float, tuple[int, int]]:
    """Frames with a distance beyond its limit, the largest excess over the arc [m], and the pair that has it."""
    count = markers.shape[1]
    bad = np.zeros(len(markers), dtype=np.bool_)
    worst, pair = 0.0, (0, 0)
    for first in range(count - 1):
        beyond = _lengths(markers[:, first + 1 :] - markers[:, [first]]) - limits[first, first + 1 :]
        bad |= (beyond > 0.0).any(axis=1)
        largest = beyond.max(axis=0, initial=0.0)
        if largest.max() > worst:
            worst, pair = float(largest.max()), (first, first + 1 + int(largest.argmax()))
    return np.flatnonzero(bad), worst + float(limits[0, 0]), pair


def _lengths(differences: Array) -> Array:
    """(...,) lengths of vectors (..., 2), the unknown parts of which count as zero."""
    known = np.where(np.isfinite(differences), differences, 0.0)
    lengths: Array = np.hypot(known[..., 0], known[..., 1])
    return lengths


def _swap_hint(markers: Array, limits: Array, names: list[str]) -> str:
    """Says which two labels, exchanged, make most of these frames (F, k, 2) consistent; empty where none do."""
    chosen = markers[np.unique(np.linspace(0, len(markers) - 1, MOST_SWAP_FRAMES).astype(int))]
    distances = _lengths(chosen[:, :, None] - chosen[:, None])
    best, repaired = (0, 0), 0
    for pair in combinations(range(len(limits)), 2):
        order = np.arange(len(limits))
        order[list(pair)] = order[[pair[1], pair[0]]]
        count = int((distances <= limits[np.ix_(order, order)]).all(axis=(1, 2)).sum())
        if count > repaired:
            best, repaired = pair, count
    if not repaired:
        return ""
    return (
        f"; labels may be swapped: exchanging {names[best[0]]} and {names[best[1]]} makes "
        f"{repaired} of the {len(chosen)} such frames looked at consistent"
    )


def clipping_warnings(time: Array, coordinates: Array, names: list[str]) -> list[str]:
    """Coordinates that stand still at their very extreme, as at the edge of a camera's image.

    Args:
        time: (T,) [s].
        coordinates: (T, c) marker coordinates [m].
        names: c names of the coordinates.
    """
    warnings: list[str] = []
    for values, name in zip(coordinates.T, names, strict=True):
        measured = np.flatnonzero(np.isfinite(values))
        for sign, extreme in ((1.0, "largest"), (-1.0, "smallest")):
            starts, lengths = clipped_runs(sign * values[measured])
            if not lengths.size:
                continue
            begin = int(measured[starts[0]])
            warnings.append(
                f"{name} stays at exactly its {extreme} value, {values[begin]:.6g} m, for up to {int(lengths.max())} "
                f"frames in a row (first at t = {time[begin]:.6g} s): it looks clipped, as at the edge of the image"
            )
    return warnings


def clipped_runs(values: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where a signal stays at its maximum as a clipped one does.

    A run counts when it is long, touches neither end of the signal (an arm at rest), and the signal falls steeply
    on both sides: within the run's own length by more than a smooth peak does that is flat only because its values
    are rounded. A parabola that rounding to steps q keeps flat over a width w is 9 q lower at a distance of 3 w / 2.

    Args:
        values: (N,) finite values.

    Returns:
        First index and length of each run.
    """
    none = np.empty(0, dtype=np.intp)
    steps = np.unique(values[np.isfinite(values)])
    if steps.size < 2:
        return none, none
    finest = float(np.diff(steps).min())
    at_top = np.concatenate(([False], values == steps[-1], [False]))
    edges = np.flatnonzero(np.diff(at_top.astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    lengths = stops - starts
    long = lengths >= SHORTEST_CLIP
    starts, stops, lengths = starts[long], stops[long], lengths[long]
    # a run at either end of the signal has no drop on that side
    before = steps[-1] - values[np.maximum(starts - lengths, 0)]
    after = steps[-1] - values[np.minimum(stops - 1 + lengths, len(values) - 1)]
    steep = np.minimum(before, after) > CLIP_DROP * finest
    return starts[steep], lengths[steep]


def absence_warnings(markers: Array, names: list[str], needs_x: NDArray[np.bool_]) -> list[str]:
    """Markers never measured, and frames that have one coordinate of a marker but not the other.

    Args:
        markers: (T, k, 2) positions [m].
        names: k names of the markers.
        needs_x: (k,) whether x is needed besides y: the marker is measured in the base frame.
    """
    measured = np.isfinite(markers)
    never = [names[index] for index in np.flatnonzero(~np.any(measured, axis=(0, 2)))]
    warnings = [f"no position of {', '.join(never)} in this recording"] if never else []
    halves = int(((measured[..., 0] != measured[..., 1]) & needs_x).any(axis=1).sum())
    if halves:
        warnings.append(f"in {halves} frame{'s' if halves > 1 else ''} a marker has one coordinate but not the other")
    return warnings


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
