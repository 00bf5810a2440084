"""Time histories: which channel and which stretch of a recording a figure shows, measured beside simulated."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import detrend

from vjm.errors import InsufficientDataError, require, require_choice
from vjm.records import REFERENCE, Array, Indices, Recording, RecordingComparison, Rig, SimulatedRecording, Simulation
from vjm.report.figures.panels import LINES, Color, PanelFigure
from vjm.report.text import recording_label
from vjm.text import millimetres, number, short

Window = tuple[float, float]  # first and last instant [s]
_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Signal:
    """One measured coordinate of a marker, or one measured joint angle."""

    name: str  # `LINK.mK.x`, `LINK.mK.y` or `LINK.theta`
    index: tuple[int, ...]  # of the marker and its axis (0: x, 1: y), or of the active joint
    rows: Indices  # (F,) of the recording, at which it was measured
    time: Array  # (F,) [s]
    value: Array  # (F,) [m] or [rad]

    @classmethod
    def of(cls, rig: Rig, recording: Recording) -> Signal | None:
        """Return the outermost measured marker's coordinate that moves most, else the outermost joint's angle.

        None where nothing was measured.
        """
        signals = {signal.index: signal for signal in measured_signals(rig, recording) if signal.rows.size >= 2}
        channels: list[tuple[int, ...]] = []
        for link, marker_slice in reversed([*zip(rig.links, rig.marker_slices, strict=True)]):
            outwards = np.argsort(link.markers)[::-1] + marker_slice.start
            channels += [(marker, moving_axis(recording.markers[:, [marker]])) for marker in outwards.tolist()]
        channels += [(joint,) for joint in reversed(range(len(rig.active_links)))]
        return next((signals[index] for index in channels if index in signals), None)

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

    def rms(self, simulated: SimulatedRecording) -> float:
        """Return the RMS residual [m] or [rad]."""
        return float(np.sqrt(np.nanmean(self.residual(simulated) ** 2)))

    def rms_text(self, simulated: SimulatedRecording) -> str:
        """Return the RMS residual, with its unit."""
        rms = self.rms(simulated)
        return millimetres(rms) if self.is_marker else f"{number(self.unit[0] * rms, 2)}°"

    def is_whole(self, window: Window) -> bool:
        """Return True if a window shows all of it."""
        return window[1] - window[0] > 0.99 * float(self.time[-1] - self.time[0])

    def windows(self) -> list[tuple[Window, str]]:
        """Return windows with headings: all of it if its oscillations stay apart on paper, else its first and last."""
        start, end, stop = float(self.time[0]), float(self.time[-1]), float(self.time[-1])
        deflection = np.abs(self.value - np.median(self.value))
        moving = np.flatnonzero(deflection > 0.03 * deflection.max())  # what comes after has died out
        if moving.size and moving[-1] >= 20:
            stop = float(self.time[moving[-1]])
        length, legible = _few_periods(self.time, self.value)
        if stop - start <= legible:
            complete = self.is_whole((start, stop))
            return [((start, stop), "" if complete else f"First {stop - start:.2g} s of {end - start:.3g} s")]
        first = f"First {length:.2g} s of {end - start:.3g} s"
        last = f"Last {length:.2g} s{'' if stop == end else ' before it dies out'}"
        return [((start, start + length), first), ((stop - length, stop), last)]


def measured_signals(rig: Rig, recording: Recording) -> list[Signal]:
    """Return every coordinate of a marker and every joint angle that was measured, from the base outwards."""
    names = [column for link in rig.links for column in link.marker_columns]
    channels: list[tuple[str, tuple[int, ...]]] = [(name, divmod(k, 2)) for k, name in enumerate(names)]
    channels += [(f"{rig.links[link].name}.theta", (joint,)) for joint, link in enumerate(rig.active_links)]
    signals = []
    for name, index in channels:
        values = _channel(recording, index)
        rows = np.flatnonzero(np.isfinite(values))
        if rows.size:
            signals.append(Signal(name, index, rows, recording.time[rows], values[rows]))
    return signals


def simulations(comparison: RecordingComparison, roles: Collection[str]) -> dict[str, SimulatedRecording]:
    """Return the simulations of a recording by role, of some of the roles, in the order in which they are drawn."""
    pairs = [(role, getattr(comparison, role)) for role in LINES if role in roles]
    return {role: simulated for role, simulated in pairs if simulated is not None}


def _channel(source: Recording | Simulation, index: tuple[int, ...]) -> Array:
    return source.markers[:, index[0], index[1]] if len(index) == 2 else source.theta[:, index[0]]


def moving_axis(markers: Array) -> int:
    """Return 0 where markers (F, k, 2) move 1.5 times as far along x as along y, or only x was measured; else 1."""
    columns = [[column[np.isfinite(column)] for column in markers[..., axis].T] for axis in (0, 1)]
    along_x, along_y = (max((np.ptp(column) for column in axis if column.size), default=-1.0) for axis in columns)
    return 0 if along_x > 1.5 * max(along_y, 0.0) else 1


def _few_periods(time: Array, value: Array) -> tuple[float, float]:
    """Return how long six periods of a signal (F,) are, and how many stay apart in a panel [s]; infinite at rest."""
    if time.size < 40 or np.ptp(value) == 0:
        return np.inf, np.inf
    grid = np.linspace(time[0], time[-1], time.size)
    power = np.abs(np.fft.rfft(detrend(np.interp(grid, time, value)) * np.hanning(grid.size))) ** 2
    period = float(grid[-1] - grid[0]) / (int(np.argmax(power[2:])) + 2)
    length = max(6 * period, 20 * float(np.median(np.diff(time))))
    return length, max(14 * period, 2 * length)


def liveliest_window(time: Array, value: Array) -> Window:
    """Return the few periods of a signal (F,) that move most; the whole of it where it is short."""
    length, _ = _few_periods(time, value)
    starts = np.flatnonzero(time + length <= time[-1])
    if not starts.size:
        return float(time[0]), float(time[-1])
    squares = np.cumsum(np.r_[0.0, (value - np.mean(value)) ** 2])
    stops = np.searchsorted(time, time[starts] + length, side="right")
    best = float(time[starts[np.argmax(squares[stops] - squares[starts])]])
    return best, best + length


def moving_recordings(
    rig: Rig, comparisons: Sequence[RecordingComparison], role: str
) -> list[tuple[RecordingComparison, Signal]]:
    """Return recordings in motion that one of the models can simulate, with their signals, by falling RMS residual."""
    moving = [
        (comparison, signal)
        for comparison in comparisons
        if comparison.recording.kind != "quiet"
        and getattr(comparison, role) is not None
        and (signal := Signal.of(rig, comparison.recording)) is not None
    ]
    return sorted(moving, key=lambda pair: -getattr(pair[0], role).marker_rms / pair[0].noise[0])


def ranked_recordings(comparisons: Sequence[RecordingComparison], roles: Collection[str]) -> list[RecordingComparison]:
    """Return recordings that a model of these roles can simulate, the most informative first.

    Held-out ones come first; of these the ones that may show what has changed; then the largest residual of the model
    that is compared with, or of the one that is judged.
    """

    def rank(comparison: RecordingComparison) -> tuple[bool, bool, float]:
        first = next(iter(simulations(comparison, roles).values()))
        recording = comparison.recording
        return recording.role != "holdout", recording.condition == REFERENCE, -first.marker_rms / comparison.noise[0]

    return sorted((comparison for comparison in comparisons if simulations(comparison, roles)), key=rank)


def one_of_each_repeat(items: Iterable[_Item], recording: Callable[[_Item], Recording]) -> list[_Item]:
    """Return the items in order, of those whose recordings repeat one experiment the first one only."""
    unique: dict[object, _Item] = {}
    for item in items:
        unique.setdefault(recording(item).repeat or id(item), item)
    return list(unique.values())


def _motion_panel(
    axes: Axes, signal: Signal, comparison: RecordingComparison, labels: Mapping[str, str],
    window: Window | None = None, most_circles: int = 170,
) -> None:  # fmt: skip
    """Draw a measured signal and labelled simulations of it in a window; with many frames as a broad grey line."""
    start, stop = window or (float(signal.time[0]), float(signal.time[-1]))
    visible = (signal.time >= start) & (signal.time <= stop)
    scale, unit = signal.unit
    look: dict[str, Any] = {"color": "#bdbdbd", "linewidth": 4.0, "solid_capstyle": "round"}
    if np.count_nonzero(visible) <= most_circles:
        look = {"linestyle": "", "marker": "o", "markersize": 4.5, "markerfacecolor": "white", "color": Color.MEASURED}
    axes.plot(signal.time[visible], scale * signal.value[visible], label="measured", **look)
    for role, simulated in reversed(simulations(comparison, labels).items()):
        instants = simulated.simulation.time
        path = CubicSpline(instants, _channel(simulated.simulation, signal.index))
        # A camera may take no more than four frames a period: closely spaced instants between those of the recording.
        time = np.union1d(np.linspace(start, stop, 800), instants[(instants >= start) & (instants <= stop)])
        axes.plot(time, scale * path(time), label=labels[role], **LINES[role])
    axes.set(xlabel="time [s]", ylabel=f"{short(signal.name, 20)} [{unit}]")


def _residual_panel(
    axes: Axes, signal: Signal, comparison: RecordingComparison, labels: Mapping[str, str],
    windows: Sequence[Window] = (),
) -> None:  # fmt: skip
    """Draw measured minus simulated values over the whole recording, beside the noise; the windows are shaded."""
    scale, unit = signal.unit
    sigma = scale * comparison.noise[0 if signal.is_marker else 1]
    for window in windows:
        if not signal.is_whole(window):
            axes.axvspan(*window, color="#fbeeda", linewidth=0, label="shown above")
    axes.axhspan(-2 * sigma, 2 * sigma, color=Color.BAND, linewidth=0, label="±2σ noise")
    axes.axhline(0.0, color=Color.AXIS, linewidth=0.6)
    largest = 4 * sigma
    for role, simulated in simulations(comparison, labels).items():
        values = scale * signal.residual(simulated)
        look = LINES[role] | {"linestyle": "-", "linewidth": 0.9}
        axes.plot(signal.time, values, label=labels[role], **look)
        largest = max(largest, 1.08 * float(np.nanmax(np.abs(values), initial=0.0)))
    axes.set_ylim(-largest, largest)
    axes.set(xlabel="time [s]", ylabel=f"residual [{unit}]")


def motion_figure(
    title: str, shown: Sequence[tuple[Signal, RecordingComparison, Sequence[tuple[Window, str]]]],
    labels: Mapping[str, str], hidden: Collection[str] = (),
    headings: Sequence[str] = ("Measured minus simulated, whole recording",),
) -> Figure:  # fmt: skip
    """Draw measured signals and simulations of them in one or two windows [s] with headings; below, the residuals.

    The motion by the alternative model is not drawn, nor are the residuals of the simulations named in `hidden`.
    `headings` are the residuals', one a signal.
    """
    page = PanelFigure.of(title, [(2.6, sum(len(windows) for *_, windows in shown)), (1.75, len(shown))])
    upper, lower = page.axes
    motion = {role: label for role, label in labels.items() if role != "alternative"}
    residuals = {role: label for role, label in labels.items() if role not in hidden}
    for (signal, comparison, windows), axes, heading in zip(shown, lower, headings, strict=True):
        panels, upper = upper[: len(windows)], upper[len(windows) :]
        for panel, (window, text) in zip(panels, windows, strict=True):
            _motion_panel(panel, signal, comparison, motion, window, 170 // len(page.axes[0]))
            panel.set_title(text)
        limits = np.array([panel.get_ylim() for panel in panels])
        for panel in panels:
            panel.set_ylim(limits.min(), limits.max())
        _residual_panel(axes, signal, comparison, residuals, [window for window, _ in windows])
        axes.set_title(heading)
    return page.finish()


def plot_recordings(
    rig: Rig, comparisons: Sequence[RecordingComparison], residual: bool, recording: Recording | str | None,
    ax: Axes | None,
) -> NDArray[Any]:  # fmt: skip
    """Plot the outermost measured signal of each recording and its simulation, or their `residual`.

    The other arguments, the result and the errors are those of `SimulatedResult.plot_fit`.
    """
    name = recording.file if isinstance(recording, Recording) else recording
    files = [comparison.recording.file for comparison in comparisons]
    require_choice("recording", name, (None, *files) if name is None else files)
    require("ax", ax, ax is None or isinstance(ax, Axes), "matplotlib axes, or None")
    asked = [comparison for comparison in comparisons if name in (None, comparison.recording.file)]
    chosen = [
        (comparison, signal)
        for comparison in asked
        if comparison.simulated is not None and (signal := Signal.of(rig, comparison.recording)) is not None
    ]
    if not chosen:
        reason = (asked[0].problem if asked else "") or "nothing was measured"
        raise InsufficientDataError("plot", f"no recording could be simulated: {reason}", "choose another recording")
    plotted = np.array([ax])
    if ax is None:
        size = (8, 2.5 * len(chosen))
        _, grid = pyplot.subplots(len(chosen), figsize=size, squeeze=False, layout="constrained")
        plotted = grid[:, 0]
    for axes, (comparison, signal) in zip(plotted, chosen, strict=False):
        (_residual_panel if residual else _motion_panel)(axes, signal, comparison, {"simulated": "simulated"})
        axes.set_title(recording_label(comparison.recording))
        axes.legend(loc="upper right")
    return plotted
