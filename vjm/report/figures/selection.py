"""Which channel and which stretch of a recording a figure shows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.signal import detrend

from vjm.records import Array, Indices, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.report.text import millimetres, number

Window = tuple[float, float]  # first and last instant [s]
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Signal:
    """One measured coordinate of a marker, or one measured joint angle.

    Attributes:
        name: `LINK.mK.x`, `LINK.mK.y` or `LINK.theta`.
        index: of the marker and its axis (0: x, 1: y), or of the active joint.
        rows: (F,) rows of the recording at which it was measured.
        time, value: (F,) [s], [m] or [rad].
    """

    name: str
    index: tuple[int, ...]
    rows: Indices
    time: Array
    value: Array

    @classmethod
    def of(cls, rig: Rig, recording: Recording) -> Signal | None:
        """Return the outermost measured marker's coordinate that moves most, else the outermost joint's angle.

        None where nothing was measured.
        """
        for link in reversed(range(len(rig.links))):
            by_arc = np.argsort(rig.links[link].markers)[::-1] + rig.marker_slices[link].start
            for marker in by_arc.tolist():
                axis = moving_axis(recording.markers[:, [marker]])
                name = f"{marker_name(rig, marker)}.{'xy'[axis]}"
                if (signal := cls._measured(name, (marker, axis), recording, recording.markers)) is not None:
                    return signal
        names = [f"{rig.links[link].name}.theta" for link in rig.active_links]
        angles = (
            cls._measured(names[joint], (joint,), recording, recording.theta) for joint in range(len(names))[::-1]
        )
        return next((signal for signal in angles if signal is not None), None)

    @classmethod
    def _measured(cls, name: str, index: tuple[int, ...], recording: Recording, values: Array) -> Signal | None:
        channel: Array = np.moveaxis(values, 0, -1)[index]
        rows = np.flatnonzero(np.isfinite(channel))
        return cls(name, index, rows, recording.time[rows], channel[rows]) if rows.size >= 2 else None

    @property
    def is_marker(self) -> bool:
        """True if it is a coordinate of a marker, in metres."""
        return len(self.index) == 2

    @property
    def unit(self) -> tuple[float, str]:
        """Factor from SI to the unit in which it is drawn, and that unit."""
        return (1e3, "mm") if self.is_marker else (float(np.degrees(1.0)), "°")

    def residual(self, simulated: SimulatedRecording) -> Array:
        """Return (F,) measured minus simulated values [m] or [rad]; NaN where the simulation's recording has none."""
        residual = simulated.marker_residual if self.is_marker else simulated.theta_residual
        values: Array = residual[self.rows, *self.index]
        return values

    def rms_text(self, simulated: SimulatedRecording) -> str:
        """Return the RMS residual, with its unit."""
        rms = float(np.sqrt(np.nanmean(self.residual(simulated) ** 2)))
        return millimetres(rms) if self.is_marker else f"{number(self.unit[0] * rms, 2)}°"


def marker_name(rig: Rig, marker: int) -> str:
    """Return `LINK.mK` of a marker given by its index among all."""
    link = next(i for i, own in enumerate(rig.marker_slices) if marker < own.stop)
    return f"{rig.links[link].name}.m{marker - rig.marker_slices[link].start + 1}"


def moving_axis(markers: Array) -> int:
    """Return 0 where markers (F, k, 2) move 1.5 times as far along x as along y, or only x was measured; else 1."""
    columns = [[own[np.isfinite(own)] for own in markers[..., axis].T] for axis in (0, 1)]
    along_x, along_y = (max((np.ptp(own) for own in axis if own.size), default=-1.0) for axis in columns)
    return 0 if along_x > 1.5 * max(along_y, 0.0) else 1


def few_periods(time: Array, value: Array) -> tuple[float, float]:
    """Return how long six periods of a signal (F,) are, and how many of them stay apart across a panel [s].

    Of its strongest oscillation; at least 20 frames, and twice as many. Infinite where nothing oscillates.
    """
    if time.size < 40 or np.ptp(value) == 0:
        return np.inf, np.inf
    grid = np.linspace(time[0], time[-1], time.size)
    power = np.abs(np.fft.rfft(detrend(np.interp(grid, time, value)) * np.hanning(grid.size))) ** 2
    period = float(grid[-1] - grid[0]) / (int(np.argmax(power[2:])) + 2)
    length = max(6 * period, 20 * float(np.median(np.diff(time))))
    return length, max(14 * period, 2 * length)


def liveliest_window(time: Array, value: Array) -> Window:
    """Return the few periods of a signal (F,) that move most; the whole of it where it is short."""
    length, _ = few_periods(time, value)
    whole = np.flatnonzero(time + length <= time[-1])
    if not whole.size:
        return float(time[0]), float(time[-1])
    squares = np.cumsum(np.r_[0.0, (value - np.mean(value)) ** 2])
    stops = np.searchsorted(time, time[whole] + length, side="right")
    best = float(time[whole[np.argmax(squares[stops] - squares[whole])]])
    return best, best + length


def moving_recordings(
    rig: Rig, comparisons: Sequence[RecordingComparison], role: str
) -> list[tuple[RecordingComparison, Signal]]:
    """Return recordings in motion that a model (`simulated` or `reference`) can simulate, by falling RMS residual."""
    pairs = [(each, Signal.of(rig, each.recording)) for each in comparisons if each.recording.kind != "quiet"]
    usable = [(each, signal) for each, signal in pairs if signal is not None and getattr(each, role) is not None]
    return sorted(usable, key=lambda pair: -getattr(pair[0], role).marker_rms / pair[0].noise[0])


def one_of_each_repeat(items: Iterable[_Item], recording: Callable[[_Item], Recording]) -> list[_Item]:
    """Return the items in order, of those whose recordings repeat one experiment the first one only."""
    labels: set[str] = set()
    kept = []
    for item in items:
        label = recording(item).repeat
        if label is None or label not in labels:
            kept.append(item)
        labels |= set() if label is None else {label}
    return kept
