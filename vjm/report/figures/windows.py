"""Which recordings, markers and stretches of time a figure shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vjm.identification.records import TorqueData
from vjm.records import Array, Recording, RecordingComparison, Rig

LEGIBLE_PERIODS = 14  # more oscillations than this across a panel are a black blob


_SHOWN_PERIODS = 6


_LEAST_FRAMES = 20  # in a window


_MOST_HOLDOUT = 2


_DIED_OUT = 0.03  # of the largest deflection: what comes after shows nothing


_CLEARLY = 1.5  # x is shown where it moves so much more than y


class Signal(NamedTuple):
    """One measured coordinate of one marker.

    Attributes:
        marker: its index among all markers of the rig.
        axis: 0 for x, 1 for y.
        time: (F,) instants at which it was measured [s].
        value: (F,) [m].
    """

    marker: int
    axis: int
    time: Array
    value: Array


def marker_name(rig: Rig, marker: int) -> str:
    """`LINK.mK` of a marker given by its index among all."""
    for link, own in zip(rig.links, rig.marker_slices, strict=True):
        if own.start <= marker < own.stop:
            return f"{link.name}.m{marker - own.start + 1}"
    raise IndexError(marker)


def tip_signal(rig: Rig, recording: Recording) -> Signal | None:
    """The coordinate that moves most of the outermost marker that was measured; None without any marker."""
    order = sorted(range(len(rig.links)), reverse=True)
    for link in order:
        own = rig.marker_slices[link]
        by_arc = np.argsort(rig.links[link].markers)[::-1] + own.start
        for marker in by_arc.tolist():
            found = moving_signal(recording, marker)
            if found is not None:
                return found
    return None


def moving_signal(recording: Recording, marker: int) -> Signal | None:
    """The lateral coordinate of one marker, or x where that moves clearly more; None where no two frames show it."""
    spread: list[float] = []
    for axis in (0, 1):
        values = recording.markers[:, marker, axis]
        known = np.isfinite(values)
        spread.append(float(np.std(values[known])) if known.sum() >= 2 else -1.0)
    if max(spread) < 0:
        return None
    axis = 0 if spread[0] > _CLEARLY * max(spread[1], 0.0) else 1
    known = np.isfinite(recording.markers[:, marker, axis])
    return Signal(marker, axis, recording.time[known], recording.markers[known, marker, axis])


def motion(rig: Rig, recording: Recording) -> float:
    """Root mean square motion of the outermost marker [m]."""
    signal = tip_signal(rig, recording)
    return 0.0 if signal is None else float(np.std(signal.value))


def period(time: Array, value: Array) -> float | None:
    """Period of the strongest oscillation in a signal [s]; None where there is none to speak of."""
    if time.size < 2 * _LEAST_FRAMES or np.ptp(value) == 0:
        return None
    grid = np.linspace(time[0], time[-1], time.size)
    even = np.interp(grid, time, value)
    trend = np.polyval(np.polyfit(grid - grid[0], even, 1), grid - grid[0])
    power = np.abs(np.fft.rfft((even - trend) * np.hanning(grid.size))) ** 2
    peak = int(np.argmax(power[2:])) + 2
    return float((grid[-1] - grid[0]) / peak)


def windows(time: Array, value: Array) -> list[tuple[float, float]]:
    """All of the motion where its oscillations stay apart on paper; else its first and its last few periods."""
    start, stop = float(time[0]), _end_of_motion(time, value)
    cycle = period(time, value)
    if cycle is None or stop - start <= LEGIBLE_PERIODS * cycle:
        return [(start, stop)]
    length = _few_periods(time, cycle)
    if 2 * length >= stop - start:
        return [(start, stop)]
    return [(start, start + length), (stop - length, stop)]


def _end_of_motion(time: Array, value: Array) -> float:
    """Instant after which a signal has died out; the recording's end where it has not, or where it came first."""
    deflection = np.abs(value - np.median(value))
    moving = np.flatnonzero(deflection > _DIED_OUT * deflection.max())
    if not moving.size or moving[-1] < _LEAST_FRAMES:
        return float(time[-1])
    return float(time[moving[-1]])


def _few_periods(time: Array, cycle: float) -> float:
    return max(_SHOWN_PERIODS * cycle, _LEAST_FRAMES * float(np.median(np.diff(time))))


def liveliest_window(time: Array, value: Array) -> tuple[float, float]:
    """The few periods of a signal (T,) that move most; the whole of it where it is short."""
    cycle = period(time, value)
    length = np.inf if cycle is None else _few_periods(time, cycle)
    if length >= time[-1] - time[0]:
        return float(time[0]), float(time[-1])
    squares = np.cumsum(np.r_[0.0, (value - np.mean(value)) ** 2])
    stops = np.searchsorted(time, time + length, side="right")
    whole = np.flatnonzero(time + length <= time[-1])
    best = int(whole[np.argmax((squares[stops] - squares[np.arange(time.size)])[whole])])
    return float(time[best]), float(time[best] + length)


def tips(rig: Rig, fits: Sequence[RecordingComparison], most: int) -> list[RecordingComparison]:
    """Recordings to show tip motion of: held-out ones first, then the worst followed; repeats and rest left out."""
    usable = [fit for fit in fits if fit.simulated is not None and fit.recording.kind != "quiet"]
    usable = [fit for fit in usable if tip_signal(rig, fit.recording) is not None]
    holdout = _worst_first([fit for fit in usable if fit.recording.role == "holdout"])
    rest = _worst_first([fit for fit in usable if fit.recording.role == "train"])
    chosen = _one_of_each_repeat([*holdout[:_MOST_HOLDOUT], *rest, *holdout[_MOST_HOLDOUT:]])[:most]
    return [fit for fit in (*holdout, *rest) if any(fit is each for each in chosen)]


def _worst_first(fits: list[RecordingComparison]) -> list[RecordingComparison]:
    return sorted(fits, key=lambda fit: -fit.simulated.marker_rms / fit.noise[0] if fit.simulated else 0.0)


def _one_of_each_repeat(fits: list[RecordingComparison]) -> list[RecordingComparison]:
    seen: set[str] = set()
    kept = []
    for fit in fits:
        label = fit.recording.repeat
        if label is None or label not in seen:
            kept.append(fit)
        if label is not None:
            seen.add(label)
    return kept


def liveliest(rig: Rig, data: Sequence[TorqueData], most: int) -> list[TorqueData]:
    """Training recordings that move most, one of each set of repeats, quiet ones last."""
    ordered = sorted(data, key=lambda each: (each.recording.kind == "quiet", -motion(rig, each.recording)))
    seen: set[str] = set()
    kept = []
    for each in ordered:
        label = each.recording.repeat
        if label is not None and label in seen:
            continue
        if label is not None:
            seen.add(label)
        kept.append(each)
    return kept[:most]


def spread_over(recordings: Sequence[Recording], most: int) -> list[Recording]:
    """At most so many recordings, in order, one of each set of repeats and every role and kind first."""
    groups: dict[tuple[str | None, ...], list[Recording]] = {}
    for recording in recordings:
        key = (recording.role, recording.kind, recording.repeat)
        groups.setdefault(key, []).append(recording)
    queue: list[Recording] = []
    while any(groups.values()):
        queue += [group.pop(0) for group in groups.values() if group]
    chosen = queue[:most]
    return [recording for recording in recordings if any(recording is each for each in chosen)]
