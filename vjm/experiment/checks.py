"""Checks of recordings: warnings in plain sentences, coordinates that cannot be right, gaps in what drives the arm."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from vjm.errors import RecordingError
from vjm.text import counted, listed

if TYPE_CHECKING:
    from vjm.experiment.conventions import Conventions
    from vjm.experiment.records import Array, Indices, Link, Mask, Recording, Rig

# Of the link's length, or of a radian: as much as a sensor may have where the experiment does not give it.
DEFAULT_NOISE = 1e-3
MIN_FRAMES = 10  # usable ones, for a recording to be worth anything
UNTRACKED_PLACE = "where another marker or the zero of the coordinates is"


def experiment_warnings(rig: Rig, recordings: Sequence[Recording], conventions: Conventions) -> Iterator[str]:
    """Yield everything the checks have to say about an experiment, recording by recording, then across them."""
    for recording in recordings:
        yield from (f"{recording.file}: {sentence}" for sentence in _recording_warnings(rig, recording, conventions))
    yield from _repeat_warnings(recordings)
    for recording in recordings:
        label = recording.condition
        matches = label and difflib.get_close_matches(label.lower(), ["reference", "ref"], n=1, cutoff=0.75)
        if matches and label != "reference":
            yield f"{recording.file}: its condition {label!r} is not 'reference', and has no meaning"
    for file, count in Counter(recording.file for recording in recordings).items():
        if count > 1:  # it would count as independent measurements
            yield f"{file}: listed {count} times"
    yield from _copy_warnings(recordings)


def cleaned(rig: Rig, recording: Recording, camera_origin: tuple[float, float] = (0.0, 0.0)) -> Recording:
    """Return the recording without markers that were not tracked, are too far apart for their link, or are clipped.

    Of one whose torques are unknown for too long, a part. `Experiment.warnings` reports all of this. A frame in which
    leaving out one marker of a link makes the others possible loses that marker; any other such frame loses all markers
    of the link. A recording with nothing wrong is returned itself.

    Args:
        rig: the arm.
        recording: as it was read.
        camera_origin: where the zero of the camera's coordinates is in the base frame [m].

    Raises:
        RecordingError: no frame of a link is left.
    """
    recording = tracked(rig, _without_gaps(rig, recording), camera_origin)
    coordinates = recording.markers.reshape(len(recording.time), -1)
    clipped = np.zeros(coordinates.shape, dtype=np.bool_)
    for column, _, begin, _ in _clippings(coordinates):  # shorter runs at the same value, at smaller peaks, as well
        clipped[:, column] |= coordinates[:, column] == coordinates[begin, column]
    invalid = clipped.reshape(recording.markers.shape)
    for link, marker_slice in zip(rig.links, rig.marker_slices, strict=True):
        arcs, markers = np.array(link.markers), recording.markers[:, marker_slice]
        impossible = _impossible(markers, link, rig.marker_noise)
        measured = np.isfinite(markers).any(axis=2)
        if measured.any() and impossible[measured].all():
            first, second = np.triu_indices(arcs.size, 1)
            ratios = _distances(markers)[impossible.any(axis=1)][:, first, second] / (arcs[second] - arcs[first])
            problem = (
                f"in no frame are the markers of '{link.name}' compatible with the rig's marker positions: they are "
                f"{np.median(ratios.max(axis=1)):.4g} times as far apart as along the link"
            )
            raise RecordingError(recording.file, None, None, problem, "coordinates in metres, marker by marker")
        invalid[:, marker_slice] |= impossible[..., None]
    if not (invalid & np.isfinite(recording.markers)).any():
        return recording
    return replace(recording, markers=np.where(invalid, np.nan, recording.markers))


def _without_gaps(rig: Rig, recording: Recording) -> Recording:
    """Return the part of a recording with known torques or given motion, mostly all of it.

    If every part is too short, it is returned without any torques.

    Raises:
        RecordingError: no part of a given motion is long enough.
    """
    part = _driven_part(rig, recording)
    if part == (recording.time[0], recording.time[-1]):
        return recording
    if part is None and recording.input == "motion":
        problem = f"the motion that is given is nowhere known over {MIN_FRAMES} frames"
        raise RecordingError(recording.file, None, "theta", problem, "angles of every joint, without long gaps")
    if part is None:
        return replace(recording, tau=np.full_like(recording.tau, np.nan))
    rows = (recording.time >= part[0]) & (recording.time <= part[1])
    arrays = {name: getattr(recording, name)[rows] for name in ("time", "markers", "theta", "tau")}
    return replace(recording, **arrays)


def _driven_part(rig: Rig, recording: Recording) -> tuple[float, float] | None:
    """Return beginning and end of the part with most frames in which nothing is unknown for too long [s].

    That is the whole recording where no torque was measured at all; None where no part shows enough.
    """
    gaps = _unknown_intervals(rig, recording)
    parts = np.concatenate([recording.time[:1], gaps.ravel(), recording.time[-1:]]).reshape(-1, 2)
    frames = recording.time[recording.frames]
    counts = np.searchsorted(frames, parts[:, 1], side="right") - np.searchsorted(frames, parts[:, 0])
    best = int(np.argmax(counts))
    begin, end = parts[best].tolist()
    rows = (recording.time >= begin) & (recording.time <= end)
    seen = counts[best] >= MIN_FRAMES and np.isfinite(recording.theta[rows]).any(axis=0).all()
    return (begin, end) if seen or not len(gaps) else None


def _unknown_intervals(rig: Rig, recording: Recording) -> Array:
    """Return beginning and end (G, 2) of each interval in which a torque or given angle is unknown for too long [s].

    In order. Whether it is too long is what `_is_torque_unknown` and `_is_motion_unknown` say of its number of steps.
    """
    driving = recording.theta if recording.input == "motion" else recording.tau
    time, known = recording.time, np.isfinite(driving).all(axis=1)
    if not driving.shape[1] or known.sum() < 2:
        return np.zeros((0, 2))
    knots, values = time[known], driving[known]
    # The usual step; where most steps are far shorter than the average one, a grid of these would be too large.
    step = max(float(np.median(np.diff(knots))), float(np.ptp(knots)) / (4 * knots.size))
    bounds = np.concatenate([time[:1], knots, time[-1:]])
    intervals = np.stack([bounds[:-1], bounds[1:]], axis=1)
    inner = (np.arange(len(intervals)) > 0) & (np.arange(len(intervals)) < len(intervals) - 1)
    long = np.diff(intervals, axis=1)[:, 0] > 1.5 * step
    intervals, inner = intervals[long], inner[long]
    steps = np.round(np.diff(intervals, axis=1)[:, 0] / step).astype(int)
    too_long = np.zeros(len(intervals), dtype=bool)
    for is_inner in (False, True):
        for count in np.unique(steps[inner == is_inner]).tolist():
            alike = (inner == is_inner) & (steps == count)
            if recording.input == "motion":
                too_long[alike] = not is_inner or _is_motion_unknown(rig, knots, values, step, count)
            else:
                errors = _impulse_errors(knots, values, step, count, is_inner)
                places = (intervals[alike].mean(axis=1) - time[0]) / np.ptp(time)
                too_long[alike] = _is_torque_unknown(rig, errors, float(np.ptp(time)), places)
    return intervals[too_long]


def _is_torque_unknown(rig: Rig, errors: Array, duration: float, places: Array) -> Mask:
    """Return at which places (G,) in a recording's duration [s] errors (n_a,) of impulses [N m s] are too much.

    A straight line, or before the first and after the last measured torque a constant, misses a torque's impulse by as
    much as it does, on average, where the torque was measured. Over the inertia of link and hub that is an error of the
    joint's rate. It bends the simulated angle, in which a recording's initial angle and rate absorb a straight line; an
    RMS of what is left beyond the noise of one measured angle is too much.
    """
    bends = duration * np.sqrt((places * (1 - places)) ** 3 / 3)  # RMS of a kink, less the line nearest to it
    links = [rig.links[i] for i in rig.active_links]
    by_encoder = DEFAULT_NOISE if rig.encoder_noise is None else rig.encoder_noise
    noise = np.array([min(_marker_angle_noise(rig, link), by_encoder) for link in links])
    limits = noise * np.array([_inertia(link) for link in links])
    return np.asarray((errors * bends[:, None] > limits).any(axis=1))


def _is_motion_unknown(rig: Rig, knots: Array, angles: Array, step: float, count: int) -> bool:
    """Return True if joints' angles (K, n_a) at K knots [s] are uncertain where so many steps [s] are unknown.

    The markers' noise, or that of the encoder as the shortest interval shows it, is what an angle may be off.
    """
    shortest, error = (_interpolation_errors(knots, angles, step, steps) for steps in (2, count))
    allowed = np.array([_marker_angle_noise(rig, rig.links[i]) for i in rig.active_links])
    if np.isinf(error).any():
        return True
    return bool((error**2 - shortest**2 > np.maximum(allowed, shortest) ** 2).any())


def _interpolation_errors(knots: Array, angles: Array, step: float, count: int) -> Array:
    """Return the RMS error (n_a,) in the middle of so many steps of a cubic through four angles around them [rad].

    The angles (K, n_a) at K knots [s] tell it where they were measured. The outer two are as far from the inner two as
    these are from each other, so that it is more than a spline's. It grows with the fourth power of the distance, by
    which it is extrapolated where no such interval was measured.
    """
    places = np.round((knots - knots[0]) / step).astype(int)
    grid = np.arange(places[-1] + 1)
    values = np.stack([np.interp(grid * step, knots - knots[0], column) for column in angles.T], axis=1)
    measured = np.zeros(grid.size, dtype=bool)
    measured[places] = True
    wanted = -(-count // 2)
    half = min(wanted, (grid.size - 1) // 6)
    while half:
        middle = grid[3 * half : grid.size - 3 * half]
        around = middle + half * np.array([[-3], [-1], [1], [3], [0]])
        middle_known = measured[around].all(axis=0)
        if middle_known.any():
            first, second, third, fourth, true = values[around[:, middle_known]]
            errors = true - (9 * (second + third) - first - fourth) / 16
            return np.asarray((wanted / half) ** 4 * np.sqrt(np.mean(errors**2, axis=0)))
        half //= 2
    return np.full(angles.shape[1], np.inf)


def _impulse_errors(knots: Array, torque: Array, step: float, count: int, inner: bool) -> Array:
    """Return the RMS error (n_a,) of the impulse of interpolated torques over so many steps [N m s].

    The torques (K, n_a) at K knots [s] tell it, where they were measured throughout as long an interval; where they
    nowhere were, it grows with the time beyond the longest one by which they were.
    """
    places = np.round((knots - knots[0]) / step).astype(int)
    grid = np.arange(places[-1] + 1)
    values = np.stack([np.interp(grid, places, column) for column in torque.T], axis=1)
    missing = np.ones(grid.size, dtype=bool)
    missing[places] = False
    # Steps up to each instant that were measured throughout.
    measured = grid - np.maximum.accumulate(np.where(missing, grid, -1)) - 1
    span = min(count, int(measured.max()))
    if span < 1:
        return np.full(torque.shape[1], np.inf)
    last = np.flatnonzero(measured >= span)
    first = last - span
    integral = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum((values[1:] + values[:-1]) / 2, axis=0)])
    bridged = (values[first] + values[last]) / 2 if inner else values[first]
    error = integral[last] - integral[first] - span * bridged
    return np.asarray(count / span * step * np.sqrt(np.mean(error**2, axis=0)))


def _inertia(link: Link) -> float:
    """Return the inertia of a straight link and its hub about its joint [kg m^2], the least that its torque moves."""
    radius, end = link.hub_radius, link.hub_radius + link.length
    return link.hub_inertia + link.mass * (end**3 - radius**3) / (3 * link.length) + link.payload * end**2


def _marker_angle_noise(rig: Rig, link: Link) -> float:
    """Return the noise of a link's angle as a marker on its tip shows it [rad]."""
    return DEFAULT_NOISE if rig.marker_noise is None else rig.marker_noise / link.length


def tracked(rig: Rig, recording: Recording, camera_origin: tuple[float, float]) -> Recording:
    """Return the recording without markers that were not tracked, itself if there are none."""
    lost = untracked(rig, recording, camera_origin)
    return replace(recording, markers=np.where(lost[..., None], np.nan, recording.markers)) if lost.any() else recording


def untracked(rig: Rig, recording: Recording, camera_origin: tuple[float, float]) -> Mask:
    """Return (T, k) where a marker is exactly where another one of its link is, or at the zero of its coordinates.

    It is what some programs write of markers that they did not see. In the link's frame the zero is the link's root,
    and the base's zero that of the first link, where no marker is. The camera's zero is `camera_origin` in the base
    frame [m]: a place like any other, that only a marker which leaps there and back did not reach.
    """
    found = np.zeros(recording.markers.shape[:2], dtype=np.bool_)
    for index, (link, marker_slice) in enumerate(zip(rig.links, rig.marker_slices, strict=True)):
        points, lost = recording.markers[:, marker_slice], found[:, marker_slice]
        same = (points[:, :, None] == points[:, None]).all(axis=3) & ~np.eye(points.shape[1], dtype=np.bool_)
        lost |= same.any(axis=2)
        if index == 0 or link.markers_frame == "link":
            lost |= (points == 0.0).all(axis=2)
        at_zero = (points == np.array(camera_origin)).all(axis=2) & ~lost
        for column in np.flatnonzero(at_zero.any(axis=0)).tolist() if link.markers_frame == "base" else ():
            others = ~lost[:, column] & np.isfinite(points[:, column]).all(axis=1)
            resting = recording.kind in ("quiet", "static")
            noise = rig.marker_noise or DEFAULT_NOISE * link.length
            lost[others, column] = _leaps(
                recording.time[others], points[others, column], at_zero[others, column], noise, resting
            )
    return found


def _leaps(time: Array, places: Array, at_zero: Mask, noise: float, resting: bool) -> Mask:
    """Return at which instants (N,) [s] a marker, at places (N, 2) [m], is at zero by a leap, and not by its motion.

    A motion comes to zero and leaves it by steps as it takes elsewhere, which its noise [m] and rounding widen; one
    that is never elsewhere is at rest there, if the arm is.
    """
    if at_zero.all():
        return np.full(at_zero.size, not resting)
    elsewhere, intervals = ~at_zero, np.diff(time)
    steps = np.hypot(*np.diff(places, axis=0).T)
    usual = steps[elsewhere[1:] & elsewhere[:-1] & (intervals <= 1.5 * np.median(intervals))]
    if not usual.size:  # zero in every other frame, or more
        usual = np.hypot(*np.diff(places[elsewhere], axis=0).T)
    # Chance reaches 6 sigma once in 1e9 comparisons; what is rounded moves by whole steps of the rounding.
    rounding = float(steps[steps > 0].min())
    widened = 6.0 * np.sqrt(2.0) * max(noise, rounding)
    leap = steps > usual.max(initial=0.0) + widened
    edges = np.flatnonzero(np.diff(at_zero, prepend=False, append=False))
    leaping = np.zeros(at_zero.size, dtype=np.bool_)
    for begin, end in edges.reshape(-1, 2).tolist():
        leaping[begin:end] = leap[max(begin - 1, 0) : begin].any() or leap[end - 1 : end].any()
    return leaping


def _impossible(markers: Array, link: Link, noise: float | None) -> Mask:
    """Return which markers (T, k) of a link cannot be where they were seen, given their noise [m] if it is known."""
    arcs = np.array(link.markers)
    # Markers a little too far apart show a wrong scale, or a marker that is not where the rig file says: something to
    # find, not to leave out. The slack is a share of the distance, but at least a share of the length.
    slack = np.maximum(0.04 * np.abs(arcs[:, None] - arcs), 0.01 * link.length)
    exceeding = _distances(markers) > _distance_limits(arcs, noise or DEFAULT_NOISE * link.length) + slack
    count = exceeding.sum(axis=(1, 2)) // 2
    culprit = (exceeding.sum(axis=2) == count[:, None]) & (count[:, None] > 0)  # it is in all such pairs
    single = culprit.sum(axis=1) == 1
    impossible: Mask = np.where(single[:, None], culprit, (count > 0)[:, None])
    return impossible


def _distances(markers: Array) -> Array:
    """Return the distances (T, k, k) between markers (T, k, 2), along the coordinates that are known."""
    offsets = markers[:, :, None] - markers[:, None]
    offsets = np.where(np.isfinite(offsets), offsets, 0.0)
    return np.asarray(np.hypot(offsets[..., 0], offsets[..., 1]))


def _distance_limits(arcs: Array, noise: float) -> Array:
    """Return the (k, k) distances beyond which markers at arc lengths (k,) cannot be, whatever their link's shape."""
    # The difference of two coordinates has sqrt(2) of their noise; chance reaches 6 sigma once in 1e9 comparisons.
    return np.asarray(np.abs(arcs[:, None] - arcs) + 6.0 * np.sqrt(2.0) * noise)


def _clippings(coordinates: Array) -> Iterator[tuple[int, str, int, int]]:
    """Yield column, `largest` or `smallest`, first row and longest run where coordinates (T, c) are clipped."""
    for column in np.flatnonzero(np.isfinite(coordinates).any(axis=0)).tolist():
        values = coordinates[:, column]
        measured = np.flatnonzero(np.isfinite(values))
        for sign, extreme in ((1.0, "largest"), (-1.0, "smallest")):
            starts, lengths = _clipped_runs(sign * values[measured])
            if starts.size:
                yield column, extreme, int(measured[starts[0]]), int(lengths.max())


def _clipped_runs(values: Array) -> tuple[Indices, Indices]:
    """Return first index and length of each run in which a signal (N,) stays at its maximum as a clipped one does."""
    steps = np.unique(values)
    finest = float(np.diff(steps).min(initial=np.inf))
    edges = np.flatnonzero(np.diff(values == steps[-1], prepend=False, append=False))
    starts, stops = edges[::2], edges[1::2]
    lengths = stops - starts
    # A run counts when it is long, touches neither end of the signal (an arm at rest: no drop on that side), and the
    # signal falls within the run's own length by more than a smooth peak does that is flat because values are rounded:
    # a parabola that rounding to steps q keeps flat over a width w is 9 q lower at a distance of 3 w / 2.
    before = steps[-1] - values[np.maximum(starts - lengths, 0)]
    after = steps[-1] - values[np.minimum(stops - 1 + lengths, len(values) - 1)]
    clipped = (lengths >= 5) & (np.minimum(before, after) > 20.0 * finest)  # twice the drop of a rounded peak
    return starts[clipped], lengths[clipped]


def _recording_warnings(rig: Rig, recording: Recording, conventions: Conventions) -> Iterator[str]:
    frames = recording.frames
    time, markers = recording.time[frames], recording.markers[frames]
    names = [*rig.marker_names]
    needs_x = np.array([link.markers_frame == "base" for link in rig.links for _ in link.markers], dtype=np.bool_)
    lost = untracked(rig, recording, conventions.camera.origin)[frames]
    markers = np.where(lost[..., None], np.nan, markers)
    yield from _absence_warnings(markers, names, needs_x)
    if lost.any():
        rows = lost.any(axis=1)
        together = listed([names[k] for k in np.flatnonzero(lost.any(axis=0))])
        yield (
            f"in {counted(int(rows.sum()), 'frame')} (first at t = {time[rows][0]:.6g} s) {together} stand exactly "
            f"{UNTRACKED_PLACE}: zeros, as it seems, of what was not tracked, and left out"
        )
    yield from _gap_warnings(time)
    driving = "theta" if recording.input == "motion" else "tau"
    for quantity in dict.fromkeys(("theta", driving)):
        columns = [conventions.name_in_files(f"{rig.links[index].name}.{quantity}") for index in rig.active_links]
        gaps = list(_driving_gap_warnings(rig, recording, " or ".join(columns))) if quantity == driving else []
        yield from gaps
        for name, signal in zip(columns, getattr(recording, quantity).T, strict=True) if not gaps else ():
            yield from _coverage_warnings(name, recording.time[np.isfinite(signal)], time)
    torque = recording.kind == "driven" and recording.input == "torque"
    if torque and rig.active_links and not np.nanmax(np.abs(recording.tau), initial=0.0) > 0.0:
        yield "every torque is zero, though the kind is 'driven'"
    reach = sum(link.hub_radius + link.length for link in rig.links)
    with np.errstate(over="ignore", invalid="ignore"):  # absurd coordinates deserve the sentence on units, not noise
        units = list(_unit_warnings(markers, reach))
        yield from units
        for link, marker_slice in zip(rig.links, rig.marker_slices, strict=True):
            if not units and len(link.markers) > 1:
                noise = rig.marker_noise or DEFAULT_NOISE * link.length
                yield from _distance_warnings(
                    time, markers[:, marker_slice], np.array(link.markers), names[marker_slice], noise
                )
        places = recording.markers.reshape(len(recording.time), -1)
        moving = [moves(values, rig.marker_noise, reach) for values in places.T]
        moving += [moves(values, rig.encoder_noise) for values in recording.theta.T]
        if recording.kind in ("driven", "decay") and not any(moving):
            yield f"nothing moves beyond the noise, though the recording is of kind '{recording.kind}'"
    coordinates = [
        conventions.source_of(f"{link.name}.m{number}", axis, link.markers_frame)
        for link in rig.links
        for number in range(1, len(link.markers) + 1)
        for axis in ("x", "y")
    ]
    yield from _clipping_warnings(time, markers.reshape(len(time), -1), coordinates)


def _absence_warnings(markers: Array, names: list[str], needs_x: Mask) -> Iterator[str]:
    measured = np.isfinite(markers)
    never = [names[index] for index in np.flatnonzero(~np.any(measured, axis=(0, 2)))]
    if never:
        yield f"no position of {', '.join(never)} in this recording"
    halves = int(((measured[..., 0] != measured[..., 1]) & needs_x).any(axis=1).sum())
    if halves:
        yield f"in {counted(halves, 'frame')} a marker has one coordinate but not the other"


def _gap_warnings(times: Array) -> Iterator[str]:
    intervals = np.diff(times)
    median = float(np.median(intervals)) if intervals.size else 0.0
    gaps = np.flatnonzero(intervals > 3.0 * median)
    if gaps.size:
        longest = gaps[intervals[gaps].argmax()]
        yield (
            f"{counted(gaps.size, 'gap')} without any marker, the longest {intervals[longest]:.4g} s "
            f"from t = {times[longest]:.6g} s, where frames usually follow every {median:.4g} s"
        )


def _coverage_warnings(column: str, sensor_times: Array, frame_times: Array) -> Iterator[str]:
    if not sensor_times.size or frame_times.size < 2:
        return
    interval = float(np.median(np.diff(frame_times)))
    if sensor_times[0] - frame_times[0] > interval or frame_times[-1] - sensor_times[-1] > interval:
        yield (
            f"{column} is measured from t = {sensor_times[0]:.6g} to {sensor_times[-1]:.6g} s only, "
            f"the markers from {frame_times[0]:.6g} to {frame_times[-1]:.6g} s"
        )


def _driving_gap_warnings(rig: Rig, recording: Recording, column: str) -> Iterator[str]:
    """Yield a sentence where only a part of a recording is used, since torques or angles are unknown for too long."""
    gaps = _unknown_intervals(rig, recording)
    if not len(gaps):
        return
    first, last = gaps[np.argmax(np.diff(gaps, axis=1))]
    count = f"{len(gaps)} intervals, the longest " if len(gaps) > 1 else ""
    part = _driven_part(rig, recording)
    used = "the recording is not used" if part is None else f"only t = {part[0]:.6g} to {part[1]:.6g} s are used"
    zeros = "" if recording.input == "motion" else ", or write zeros where no torque acted"
    yield (
        f"{column} is unknown for too long to simulate the arm, {count}from t = {first:.6g} to {last:.6g} s: {used}; "
        f"list the other parts as files of their own{zeros}"
    )


def _unit_warnings(markers: Array, arm_length: float) -> Iterator[str]:
    largest = float(np.nanmax(np.abs(markers), initial=0.0))
    if largest > 20.0 * arm_length:
        yield (
            f"a marker coordinate reaches {largest:.4g} m with an arm {arm_length:.4g} m long: "
            "the coordinates look like millimetres, and metres are expected"
        )


def _distance_warnings(time: Array, markers: Array, arcs: Array, names: list[str], noise: float) -> Iterator[str]:
    limits = _distance_limits(arcs, noise)
    excess = _distances(markers) - limits
    bad = (excess > 0.0).any(axis=(1, 2))
    if bad.any():
        count, largest = int(bad.sum()), excess.max(axis=0)
        first, second = np.unravel_index(largest.argmax(), largest.shape)
        yield (
            f"in {counted(count, 'frame')} (first at t = {time[bad][0]:.6g} s) markers are farther apart "
            f"than the link allows, by up to {largest.max() + limits[0, 0]:.3g} m between {names[first]} and "
            f"{names[second]}, which are {abs(arcs[second] - arcs[first]):.4g} m apart along the link"
            + _swap_hint(markers[bad], limits, names)
        )


def _swap_hint(markers: Array, limits: Array, names: list[str]) -> str:
    """Say which two labels, exchanged, make most of these frames (F, k, 2) consistent; empty where none do."""
    rows = np.unique(np.linspace(0, len(markers) - 1, 50).astype(int))
    sample = markers[rows]
    distances = _distances(sample)
    repaired = {}
    for first, second in combinations(range(len(limits)), 2):
        order = np.arange(len(limits))
        order[[first, second]] = second, first
        repaired[first, second] = int((distances <= limits[np.ix_(order, order)]).all(axis=(1, 2)).sum())
    (first, second), count = max(repaired.items(), key=lambda item: item[1])
    if not count:
        return ""
    return (
        f"; labels may be swapped: exchanging {names[first]} and {names[second]} makes "
        f"{count} of the {len(sample)} such frames looked at consistent"
    )


def _clipping_warnings(time: Array, coordinates: Array, names: list[str]) -> Iterator[str]:
    """Yield a warning for each of the coordinates (T, c) [m] that stays at its extreme, as at the edge of an image."""
    for column, extreme, begin, longest in _clippings(coordinates):
        yield (
            f"{names[column]} stays at exactly its {extreme} value, {coordinates[begin, column]:.6g} m, for up to "
            f"{longest} frames in a row (first at t = {time[begin]:.6g} s): "
            "it looks clipped, as at the edge of the image"
        )


def moves(values: Array, noise: float | None, unit: float = 1.0) -> bool:
    """Return True if a signal (N,) spreads over more than its noise explains.

    Noise that is not given is estimated, and taken as at most a thousandth of `unit`: a length [m], or one radian.
    """
    measured = values[np.isfinite(values)]
    if measured.size < 2:
        return False
    if noise is None:  # estimated from first differences of a well sampled signal; fast motion inflates them
        differences = np.diff(measured)
        deviation = np.median(np.abs(differences - np.median(differences)))
        noise = min(1.4826 * deviation / np.sqrt(2.0), DEFAULT_NOISE * unit)  # 1.4826: standard over median deviation
    # The range of a sinusoid of the same variance; the plain range would grow with the number of samples.
    spread = 2.0 * np.sqrt(2.0) * (measured - measured[0]).std()  # from the first: a constant has exactly none
    return bool(spread > 4.0 * noise)  # pure noise spreads over 2.8 sigma


def _copy_warnings(recordings: Sequence[Recording]) -> Iterator[str]:
    """Yield files most of whose frames are those of another.

    Rounded frames of an arm at rest are the same by chance.
    """
    earlier: list[tuple[Recording, set[bytes]]] = []
    for recording in recordings:
        if recording.kind in ("quiet", "static"):
            continue
        frames = {row.tobytes() for row in recording.markers[recording.frames]}
        for other, others in earlier:
            share = len(frames & others) / min(len(frames), len(others))
            if share > 0.5 and recording.file != other.file:
                effect = (
                    "it counts twice" if recording.role == other.role else "it predicts nothing that was not fitted"
                )
                yield f"{recording.file}: {100 * share:.0f} % of its frames are those of {other.file}, a copy: {effect}"
        earlier.append((recording, frames))


def _repeat_warnings(recordings: Sequence[Recording]) -> Iterator[str]:
    first: dict[str, Recording] = {}
    for recording in recordings:
        if recording.repeat is None or first.setdefault(recording.repeat, recording) is recording:
            continue
        earlier = first[recording.repeat]
        pair = f"{recording.file}: it repeats {earlier.file} (label '{recording.repeat}')"
        difference = _torque_difference(earlier, recording)
        if difference > 0.05:
            yield f"{pair}, but their torques differ by {100.0 * difference:.3g} % of their root mean square"
        if recording.condition != earlier.condition:
            condition, earlier_condition = (repr(r.condition) if r.condition else "none" for r in (recording, earlier))
            yield f"{pair}, but its condition is {condition} and the other's is {earlier_condition}"


def _torque_difference(first: Recording, second: Recording) -> float:
    """Return the largest RMS difference of a joint's torque relative to the first recording's; zero without overlap."""
    largest = 0.0
    for columns in zip(first.tau.T, second.tau.T, strict=True):
        torque, repeated = overlapping_samples(first, second, *columns)
        size, change = (float(np.sqrt((x**2).mean())) if x.size else 0.0 for x in (torque, repeated - torque))
        if change > 0.0:
            largest = max(largest, change / size if size > 0.0 else np.inf)
    return largest


def overlapping_samples(first: Recording, second: Recording, own: Array, other: Array) -> tuple[Array, Array]:
    """Return one signal of two recordings at the same times after their starts, (N,) and (N,), where both overlap.

    The signals are (T1,) and (T2,), NaN where not measured; the second is interpolated at the instants of the first.
    """
    known, other_known = np.isfinite(own), np.isfinite(other)
    if known.sum() < 2 or other_known.sum() < 2:
        return np.zeros(0), np.zeros(0)
    times, other_times = first.time[known] - first.time[0], second.time[other_known] - second.time[0]
    overlap = (times >= other_times[0]) & (times <= other_times[-1])
    return own[known][overlap], np.interp(times[overlap], other_times, other[other_known])
