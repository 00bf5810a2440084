"""Raw markers of the recordings (the paper's Fig. 8)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from vjm.chain.curve import link_poses, rotate
from vjm.chain.virtual_links import Chain, LinkChain
from vjm.errors import InsufficientDataError
from vjm.identification.records import TorqueData
from vjm.records import Array, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    NOMINAL_STYLE,
    TORQUE,
    Row,
    Sheet,
    log_ticks,
    panel_title,
    printable,
    series,
    sheet,
    styled,
)
from vjm.report.figures.windows import Signal, liveliest_window, marker_name, period, tip_signal, windows
from vjm.report.text import counted, listed, millimetres, number, short
from vjm.simulation.measurement import MarkerArcs
from vjm.simulation.model import Model

MOST_PANELS = 8
_MOST_MARKERS = 6
_MOST_LINKS = 3
_MOST_DOTS = 40  # frames in a panel that are drawn as dots too


def most_recordings(rig: Rig) -> int:
    """How many recordings fit in the picture: several links take a panel each."""
    return MOST_PANELS // min(len(rig.links), _MOST_LINKS)


@styled
def raw_markers(rig: Rig, recordings: Sequence[Recording]) -> Figure:
    """Measured marker coordinates against time, as they stand in the files; y, or x where that moves clearly more.

    Args:
        rig: the arm.
        recordings: to be drawn, at least one; a row of panels each where there are several links.
    """
    links = list(range(len(rig.links)))[:_MOST_LINKS]
    panels = [(recording, link) for recording in recordings for link in links]
    columns = len(links) if len(links) > 1 else min(2, len(panels))
    rows = -(-len(panels) // columns)
    total = sum(len(link.markers) for link in rig.links)
    title = f"Markers as measured: {counted(len(recordings), 'recording')}, {counted(total, 'marker')}"
    page = sheet(title, [Row(1.45 if rows > 1 else 2.3, columns, gap=0.62)] * rows)
    axes = [each for row in page.axes for each in row]
    for unused in axes[len(panels) :]:
        unused.remove()
    for each, (recording, link) in zip(axes, panels, strict=False):
        _draw(each, rig, recording, link)
    most = max((_shown(rig, link) for link in links), key=len)
    page.legend(
        [
            Line2D([], [], color=color, linestyle=style, label=f"marker {number + 1}")
            for number, (color, style) in zip(most, series(len(most)), strict=True)
        ]
    )
    return page.figure


def _shown(rig: Rig, link: int) -> list[int]:
    """Numbers (from 0) of the link's markers that are drawn: all of a few, else some from base to tip."""
    count = len(rig.links[link].markers)
    numbers: list[int] = np.unique(np.linspace(0, count - 1, min(count, _MOST_MARKERS)).round().astype(int)).tolist()
    return numbers


def _draw(axes: Axes, rig: Rig, recording: Recording, link: int) -> None:
    start, stop = _window(rig, recording)
    rows = recording.frames
    rows = rows[(recording.time[rows] >= start) & (recording.time[rows] <= stop)]
    own = 1e3 * recording.markers[rows][:, rig.marker_slices[link]]
    axis = _axis(own)
    numbers = _shown(rig, link)
    dots = "." if rows.size <= _MOST_DOTS else "none"
    for marker, (color, style) in zip(numbers, series(len(numbers)), strict=True):
        # A marker lost for a moment leaves a gap in its line.
        axes.plot(
            recording.time[rows],
            own[:, marker, axis],
            marker=dots,
            markersize=4,
            color=color,
            linestyle=style,
            linewidth=1.1,
        )
    axes.set_ylabel(f"{'xy'[axis]} [mm]")
    axes.set_xlabel("time [s]")
    panel_title(axes, _heading(rig, recording, link, stop - start))


def _window(rig: Rig, recording: Recording) -> tuple[float, float]:
    tip = tip_signal(rig, recording)
    if tip is None or recording.kind in ("quiet", "static"):
        return float(recording.time[0]), float(recording.time[-1])
    return liveliest_window(tip.time, tip.value)


def _axis(markers: NDArray[np.float64]) -> int:
    """0 where the markers (F, k, 2) move clearly more along x, or were measured along x alone."""
    travel = [-1.0, -1.0]
    for axis in (0, 1):
        values = markers[..., axis]
        measured = values[:, np.isfinite(values).any(axis=0)]
        if measured.size:
            travel[axis] = float(np.max(np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)))
    return 0 if travel[0] > 1.5 * max(travel[1], 0.0) else 1


def _heading(rig: Rig, recording: Recording, link: int, length: float) -> str:
    role = "train" if recording.role == "train" else "held out"
    duration = float(recording.time[-1] - recording.time[0])
    part = "" if length > 0.99 * duration else f", {length:.2g} s of {duration:.3g} s"
    if len(rig.links) == 1:
        return f"{short(recording.file)} ({recording.kind}, {role}{part})"
    frame = f"{short(rig.links[link].name, 16)}, {rig.links[link].markers_frame} frame"
    return f"{short(recording.file, 22)} ({role}{part}): {frame}"


_INSTANTS = 5
_POINTS = 80  # along the drawn curve
_PERIODS = 4  # the instants are chosen within so many periods from the largest deflection on
_GAP = 0.62  # inches between rows
_LINKS: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (4, 2))}
_JOINTS: dict[str, Any] = {"marker": "s", "markersize": 4, "markerfacecolor": "white"}
_MARKERS: dict[str, Any] = {
    "linestyle": "",
    "marker": "o",
    "markersize": 4.5,
    "markeredgecolor": "black",
    "markeredgewidth": 0.6,
}


@styled
def link_shapes(rig: Rig, chain: Chain, recordings: Sequence[TorqueData]) -> Figure:
    """Each link in its own frame at five instants; lateral deflection magnified.

    Args:
        rig: the arm.
        chain: its virtual links and joints.
        recordings: one or two, a column of panels each.
    """
    page = sheet(_title(rig, recordings), [Row(2.5, len(recordings), _GAP)] * len(rig.links))
    for i, row in enumerate(page.axes):
        for axes, data in zip(row, recordings, strict=True):
            _draw_link(axes, rig, chain, data, i)
    page.legend(
        [
            Line2D([], [], color=MEASURED, label="measured markers", **_MARKERS),
            Line2D([], [], color="#444444", linewidth=2.2, alpha=0.6, label="shape function"),
            Line2D([], [], color="#444444", label="virtual links and joints", **_LINKS, **_JOINTS),
        ]
    )
    return page.figure


def _title(rig: Rig, recordings: Sequence[TorqueData]) -> str:
    residuals = np.concatenate([fit.residuals.ravel() for data in recordings for fit in data.angles.shapes])
    known = residuals[np.isfinite(residuals)]
    rms = float(np.sqrt(np.mean(known**2))) if known.size else 0.0
    if all(fit.order == fit.residuals.shape[1] for fit in recordings[0].angles.shapes):
        return "Shape of the link: as many functions as markers, so the curve passes through them and is not tested"
    where = "the link" if len(rig.links) == 1 else "all links"
    return f"Shape functions pass the markers of {where} within {millimetres(rms)} RMS"


def _draw_link(axes: Axes, rig: Rig, chain: Chain, data: TorqueData, i: int) -> None:
    frames = _instants(data, i)
    markers = _link_frame_markers(rig, chain, data, i)
    for frame, (color, _) in zip(frames, series(len(frames)), strict=True):
        x, y = _curve(data, i, int(frame))
        axes.plot(x, 1e3 * y, color=color, linewidth=2.2, alpha=0.6)
        corners = _virtual_links(chain.links[i], data.angles.q[frame, chain.passive_slices[i]])
        axes.plot(corners[:, 0], 1e3 * corners[:, 1], color=color, **_LINKS)
        axes.plot(corners[1:-1, 0], 1e3 * corners[1:-1, 1], color=color, linestyle="", **_JOINTS)
        axes.plot(markers[frame, :, 0], 1e3 * markers[frame, :, 1], color=color, **_MARKERS)
        label, tip = f"{data.angles.time[frame]:.2f} s", (x[-1], 1e3 * y[-1])
        axes.annotate(label, tip, xytext=(5, 0), textcoords="offset points", va="center", fontsize=7.5)
    axes.set_xlim(-0.02 * chain.links[i].length, 1.14 * chain.links[i].length)
    axes.set_xlabel(f"along {rig.links[i].name} [m]")
    axes.set_ylabel("lateral [mm]")
    panel_title(axes, short(data.recording.file))


def _instants(data: TorqueData, i: int) -> NDArray[np.intp]:
    """Frames from one extreme of the tip's deflection to the other, within a few periods of the largest."""
    fit, time = data.angles.shapes[i], data.angles.time
    deflection = fit.evaluate(np.array([fit.length]))[:, 0]
    complete = np.flatnonzero(np.isfinite(data.angles.q).all(axis=1) & np.isfinite(deflection))
    if complete.size <= _INSTANTS:
        return complete
    cycle = period(time[complete], deflection[complete])
    length = float(time[-1] - time[0]) if cycle is None else _PERIODS * cycle
    start = time[complete[np.argmax(np.abs(deflection[complete]))]]
    start = min(float(start), float(time[complete[-1]]) - length)
    near = complete[(time[complete] >= start) & (time[complete] <= start + length)]
    near = near if near.size >= _INSTANTS else complete
    levels = np.linspace(deflection[near].min(), deflection[near].max(), _INSTANTS)
    closest = [int(near[np.argmin(np.abs(deflection[near] - level))]) for level in levels]
    return np.unique(closest)


def _curve(data: TorqueData, i: int, frame: int) -> tuple[Array, Array]:
    """The shape function over arc length as points (x, y) [m]."""
    fit = data.angles.shapes[i]
    arcs = np.linspace(0.0, fit.length, _POINTS)
    slope = fit.evaluate(arcs, 1)[frame]
    cosine = np.sqrt(np.clip(1 - slope**2, 0.0, 1.0))
    x = np.r_[0.0, np.cumsum((cosine[1:] + cosine[:-1]) / 2 * np.diff(arcs))]
    return x, fit.evaluate(arcs)[frame]


def _virtual_links(link: LinkChain, phi: Array) -> Array:
    """(n + 2, 2) ends of the virtual links in the link frame [m]."""
    headings = np.r_[0.0, np.cumsum(phi)]
    steps = link.lengths[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def _link_frame_markers(rig: Rig, chain: Chain, data: TorqueData, i: int) -> Array:
    """(F, k_i, 2) measured markers of link i in its own frame [m]; a missing x is the marker's arc length."""
    recording, link = data.recording, rig.links[i]
    markers = recording.markers[recording.frames][:, rig.marker_slices[i]]
    if link.markers_frame == "base":
        origins, headings = link_poses(chain, data.angles.q)
        markers = rotate(markers - origins[:, None, i], -headings[:, i, None])
    along = np.where(np.isfinite(markers[..., 0]), markers[..., 0], np.array(link.markers))
    return np.stack([along, markers[..., 1]], axis=-1)


_MOST_CIRCLES = 170  # across the page
_LEGIBLE = 4.0  # another model's residual is drawn where it is at most so many times the identified one's
_WORTH_A_LINE = 1.05  # and the torque method's where it is at least so many times that
_DRAWN_POINTS = 800  # a camera takes few frames a period; the simulation is drawn between them too


@styled
def tip_motion(fit: RecordingComparison, model: Model, nominal: Model, name: str = "identified") -> Figure:
    """Tip of one recording: measured, simulated by the model and by the nominal one; residual underneath.

    Args:
        fit: of a recording with a replay and at least one marker.
        model: the model that was replayed.
        nominal: the one to compare with.
        name: what to call the model.

    Raises:
        InsufficientDataError: a recording without replay or marker.
    """
    signal = tip_signal(model.rig, fit.recording)
    if fit.simulated is None or signal is None:
        raise InsufficientDataError(f"tip of {fit.recording.file}", fit.problem or "no marker", "choose another")
    residual = signal.value - simulated(fit.simulated, fit.recording, signal)
    parts = windows(signal.time, signal.value)
    page = sheet(_title_tips(fit, signal, residual, name), [Row(2.2, len(parts)), Row(1.2, gap=0.75)])
    _draw_tips(page, fit, model, nominal, signal, parts)
    _draw_residual(page.axes[1][0], fit, signal, residual, name)
    page.legend(_handles(fit, signal, name, _crowded(signal, parts)))
    return page.figure


def _title_tips(fit: RecordingComparison, signal: Signal, residual: Array, name: str) -> str:
    role = "held out" if fit.recording.role == "holdout" else "train"
    text = f"Tip of {short(fit.recording.file)} ({role}): {name} model within {millimetres(_rms(residual))} RMS"
    for other, words in ((fit.alternative, "torque method"), (fit.reference, "nominal")):
        if other is not None:
            text += f", {words} {millimetres(_rms(signal.value - simulated(other, fit.recording, signal)))}"
    return f"{text}; noise {millimetres(fit.noise[0])}"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def simulated(replay: SimulatedRecording, recording: Recording, signal: Signal) -> Array:
    """The simulated coordinate at the instants at which it was measured [m]."""
    rows = np.isfinite(recording.markers[:, signal.marker, signal.axis])
    values: Array = replay.simulation.markers[rows, signal.marker, signal.axis]
    return values


def drawn(
    replay: SimulatedRecording, model: Model, recording: Recording, signal: Signal, window: tuple[float, float]
) -> tuple[Array, Array]:
    """The simulated coordinate, as the camera would show it, at closely spaced instants of a window [s, m]."""
    simulation, arm, arcs = replay.simulation, model.arm_in(recording), MarkerArcs.of(model.rig)
    path = CubicHermiteSpline(simulation.time, simulation.q, simulation.v)
    time = np.linspace(*window, _DRAWN_POINTS)
    seen, stamps, positions = time, time - simulation.time[0], arcs.positions(arm.chain, path(time))
    for effect in arm.sensors:
        seen = seen + (effect.camera_instants(stamps, positions).T - stamps)
    markers = arcs.measured_positions(arm, path(np.clip(seen, simulation.time[0], simulation.time[-1])))
    return time, markers[:, signal.marker, signal.axis]


def _draw_tips(
    page: Sheet,
    fit: RecordingComparison,
    model: Model,
    nominal: Model,
    signal: Signal,
    parts: list[tuple[float, float]],
) -> None:
    limits = []
    for axes, window in zip(page.axes[0], parts, strict=True):
        rows = (signal.time >= window[0]) & (signal.time <= window[1])
        axes.plot(signal.time[rows], 1e3 * signal.value[rows], **_measured_look(_crowded(signal, parts)))
        if fit.simulated is not None:
            time, value = drawn(fit.simulated, model, fit.recording, signal, window)
            axes.plot(time, 1e3 * value, color=IDENTIFIED, linewidth=1.3)
        if fit.reference is not None:
            time, value = drawn(fit.reference, nominal, fit.recording, signal, window)
            axes.plot(time, 1e3 * value, color=NOMINAL, linestyle=NOMINAL_STYLE, linewidth=1.2)
        axes.set_xlabel("time [s]")
        axes.set_ylabel(label(model.rig, signal))
        limits.append(axes.get_ylim())
        panel_title(axes, _part(signal, parts, window))
    for axes in page.axes[0]:
        axes.set_ylim(min(low for low, _ in limits), max(high for _, high in limits))


def _part(signal: Signal, parts: list[tuple[float, float]], window: tuple[float, float]) -> str:
    """Which part of the recording a panel shows; empty for the whole."""
    length, whole = window[1] - window[0], float(signal.time[-1] - signal.time[0])
    if length > 0.99 * whole:
        return ""
    if window is parts[0]:
        return f"First {length:.2g} s of {whole:.3g} s"
    return f"Last {length:.2g} s" + ("" if window[1] == signal.time[-1] else " before it dies out")


def _crowded(signal: Signal, parts: list[tuple[float, float]]) -> bool:
    """Whether single frames would run into each other."""
    frames = max(int(((signal.time >= start) & (signal.time <= stop)).sum()) for start, stop in parts)
    return frames * len(parts) > _MOST_CIRCLES


def _measured_look(crowded: bool) -> dict[str, Any]:
    """A broad line under the simulated ones, or circles."""
    if crowded:
        return {"color": "#bdbdbd", "linewidth": 4.0, "solid_capstyle": "round"}
    circles = {"marker": "o", "markersize": 4.5, "markerfacecolor": "white", "markeredgecolor": MEASURED}
    return {"linestyle": "", **circles}


def label(rig: Rig, signal: Signal) -> str:
    """Of the axis on which a coordinate is drawn."""
    return f"{short(marker_name(rig, signal.marker), 20)}.{'xy'[signal.axis]} [mm]"


def _draw_residual(axes: Axes, fit: RecordingComparison, signal: Signal, residual: Array, name: str) -> None:
    noise = 1e3 * fit.noise[0]
    axes.axhspan(-2 * noise, 2 * noise, color=BAND, linewidth=0)
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    drawn, largest = "", max(4 * noise, 1.08e3 * float(np.abs(residual).max()))
    other = _before(fit, signal, residual)
    if other is not None:
        axes.plot(signal.time, 1e3 * other.residual, color=other.color, linewidth=0.8, alpha=0.9)
        drawn, largest = f" and {other.name}", max(largest, 1.08e3 * float(np.abs(other.residual).max()))
    axes.plot(signal.time, 1e3 * residual, color=IDENTIFIED, linewidth=0.8)
    axes.set_ylim(-largest, largest)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual [mm]")
    panel_title(axes, f"Measured less {name}{drawn} model, whole recording")


class _Before(NamedTuple):
    """What another model leaves of the signal, to be drawn beside what the identified one leaves."""

    name: str
    color: str
    residual: Array


def _before(fit: RecordingComparison, signal: Signal, residual: Array) -> _Before | None:
    """The torque method's residual or, where that is as good, the nominal one's; None where it would hide the other."""
    if fit.alternative is not None:
        other = signal.value - simulated(fit.alternative, fit.recording, signal)
        if _WORTH_A_LINE * _rms(residual) < _rms(other) <= _LEGIBLE * _rms(residual):
            return _Before("torque method's", TORQUE, other)
    if fit.reference is not None:
        other = signal.value - simulated(fit.reference, fit.recording, signal)
        if _rms(other) <= _LEGIBLE * _rms(residual):
            return _Before("nominal", NOMINAL, other)
    return None


def _handles(fit: RecordingComparison, signal: Signal, name: str, crowded: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="measured", **_measured_look(crowded)),
        Line2D([], [], color=IDENTIFIED, label=f"{name} model"),
    ]
    if fit.reference is not None:
        handles.append(Line2D([], [], color=NOMINAL, linestyle=NOMINAL_STYLE, label="nominal model"))
    other = (
        _before(fit, signal, signal.value - simulated(fit.simulated, fit.recording, signal))
        if fit.simulated is not None
        else None
    )
    if other is not None and other.color == TORQUE:
        handles.append(Line2D([], [], color=TORQUE, label="torque method (residual)"))
    return [*handles, Patch(color=BAND, label="±2σ noise")]


MOST_RECORDINGS = 40
_ROW = 0.3  # inches a recording
_LOOKS: tuple[dict[str, Any], ...] = (
    {"linestyle": "", "marker": "s", "color": NOMINAL, "markerfacecolor": "white", "zorder": 2},
    {"linestyle": "", "marker": "D", "color": TORQUE, "markersize": 8, "zorder": 3},
    {"linestyle": "", "marker": "o", "color": IDENTIFIED, "zorder": 4},
)  # nominal, torque method, identified
_NOISE: dict[str, Any] = {"linestyle": "", "marker": "|", "markeredgewidth": 2, "color": MEASURED}


@styled
def fit_of_recordings(fits: Sequence[RecordingComparison], name: str = "identified") -> Figure:
    """Root mean square marker residual of every recording beside the noise, on a logarithmic axis.

    In millimetres; in units of the noise where the torque method stands beside the trajectory method.

    Args:
        fits: in the order to be shown, from the top.
        name: what to call the model.
    """
    shown = list(fits)[:MOST_RECORDINGS]
    compared = any(fit.alternative is not None for fit in shown)
    page = sheet(
        _compared(shown, name) if compared else _title_fits(shown, name), [Row(max(_ROW * len(shown), 0.7))], left=2.75
    )
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    for place, fit in zip(places.tolist(), shown, strict=True):
        unit = fit.noise[0] if compared else 1e-3
        drawn = [(each, look) for each, look in zip(_replays(fit), _LOOKS, strict=True) if each is not None]
        if len(drawn) > 1:
            ends = [drawn[0][0].marker_rms / unit, drawn[-1][0].marker_rms / unit]
            axes.plot(ends, [place, place], color="#bbbbbb", linewidth=1.0, zorder=1)
        for replay, look in drawn:
            axes.plot(replay.marker_rms / unit, place, **look)
        if not compared:
            axes.plot(fit.noise[0] / unit, place, **_NOISE, markersize=15, zorder=1)
    axes.set_xscale("log")
    if compared:
        axes.axvline(1.0, color=MEASURED, linewidth=2, zorder=1)
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.15, high * 1.15)
    log_ticks(axes.xaxis)
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [_label(fit) for fit in shown])
    axes.grid(False, axis="y")
    unit_name = "times the noise" if compared else "mm"
    axes.set_xlabel(f"marker residual over the whole recording, open loop, RMS [{unit_name}]")
    axes.set_ylabel("recording", labelpad=6)
    labels = ("nominal model", "torque method", f"{name} model{' (trajectory method)' if compared else ''}")
    handles = [Line2D([], [], **look, label=label) for look, label in zip(_LOOKS, labels, strict=True)]
    page.legend([*(handles if compared else handles[::2]), Line2D([], [], **_NOISE, markersize=11, label="noise")])
    return page.figure


def _replays(
    fit: RecordingComparison,
) -> tuple[SimulatedRecording | None, SimulatedRecording | None, SimulatedRecording | None]:
    return fit.reference, fit.alternative, fit.simulated


def _compared(fits: Sequence[RecordingComparison], name: str) -> str:
    """The held-out recordings by all three models; the training ones where none was held out."""
    replayed = [fit for fit in fits if fit.simulated is not None]
    held_out = [fit for fit in replayed if fit.recording.role == "holdout"]
    parts = []
    for k, words in enumerate((f"{name} model", "torque method", "nominal model")):
        known = [(fit, _replays(fit)[2 - k]) for fit in held_out or replayed]
        ratios = [replay.marker_rms / fit.noise[0] for fit, replay in known if replay is not None]
        if ratios:
            parts.append(f"{words} {_range(ratios)}")
    return f"Residual over noise in {'held-out' if held_out else 'training'} recordings: {', '.join(parts)}"


def _range(ratios: Sequence[float]) -> str:
    low, high = number(min(ratios), 2), number(max(ratios), 2)
    return low if low == high else f"{low} to {high}"


def _label(fit: RecordingComparison) -> str:
    role = "held out" if fit.recording.role == "holdout" else "train"
    missing = "" if fit.simulated is not None else ", not simulated"
    return printable(f"{short(fit.recording.file, 24)} ({role}{missing})")


def _title_fits(fits: Sequence[RecordingComparison], name: str) -> str:
    parts = []
    for role, words in (("train", "train"), ("holdout", "held-out")):
        ratios = [
            fit.simulated.marker_rms / fit.noise[0] for fit in fits if fit.simulated and fit.recording.role == role
        ]
        if ratios:
            parts.append(f"{_range(ratios)} times the noise in {words} recordings")
    return f"Residual of the {name} model: {listed(parts)}" if parts else "No recording could be simulated"
