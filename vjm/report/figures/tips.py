"""Tip simulation against data (the paper's Fig. 10)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from vjm.errors import InsufficientDataError
from vjm.experiment.records import Recording, Rig
from vjm.identification.records import RecordingFit
from vjm.model import Model
from vjm.report.choose import Signal, marker_name, tip_signal, windows
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    NOMINAL_STYLE,
    TORQUE,
    Row,
    Sheet,
    panel_title,
    sheet,
    styled,
)
from vjm.report.wording import millimetres, short
from vjm.simulate.initial_state import Replay
from vjm.simulate.observation import Arcs

Array = NDArray[np.float64]

_MOST_CIRCLES = 170  # across the page
_LEGIBLE = 4.0  # another model's residual is drawn where it is at most so many times the identified one's
_WORTH_A_LINE = 1.05  # and the torque method's where it is at least so many times that
_DRAWN_POINTS = 800  # a camera takes few frames a period; the simulation is drawn between them too


@styled
def tip_motion(fit: RecordingFit, model: Model, nominal: Model, name: str = "identified") -> Figure:
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
    if fit.replay is None or signal is None:
        raise InsufficientDataError(f"tip of {fit.recording.file}", fit.problem or "no marker", "choose another")
    residual = signal.value - simulated(fit.replay, fit.recording, signal)
    parts = windows(signal.time, signal.value)
    page = sheet(_title(fit, signal, residual, name), [Row(2.2, len(parts)), Row(1.2, gap=0.75)])
    _draw_tips(page, fit, model, nominal, signal, parts)
    _draw_residual(page.axes[1][0], fit, signal, residual, name)
    page.legend(_handles(fit, signal, name, _crowded(signal, parts)))
    return page.figure


def _title(fit: RecordingFit, signal: Signal, residual: Array, name: str) -> str:
    role = "held out" if fit.recording.role == "holdout" else "train"
    text = f"Tip of {short(fit.recording.file)} ({role}): {name} model within {millimetres(_rms(residual))} RMS"
    for other, words in ((fit.torque, "torque method"), (fit.nominal, "nominal")):
        if other is not None:
            text += f", {words} {millimetres(_rms(signal.value - simulated(other, fit.recording, signal)))}"
    return f"{text}; noise {millimetres(fit.marker_noise)}"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def simulated(replay: Replay, recording: Recording, signal: Signal) -> Array:
    """The simulated coordinate at the instants at which it was measured [m]."""
    rows = np.isfinite(recording.markers[:, signal.marker, signal.axis])
    values: Array = replay.simulation.markers[rows, signal.marker, signal.axis]
    return values


def drawn(
    replay: Replay, model: Model, recording: Recording, signal: Signal, window: tuple[float, float]
) -> tuple[Array, Array]:
    """The simulated coordinate, as the camera would show it, at closely spaced instants of a window [s, m]."""
    simulation, arm, arcs = replay.simulation, model.arm_in(recording), Arcs.of(model.rig)
    path = CubicHermiteSpline(simulation.time, simulation.q, simulation.v)
    time = np.linspace(*window, _DRAWN_POINTS)
    seen, stamps, positions = time, time - simulation.time[0], arcs.markers(arm.chain, path(time))
    for effect in arm.sensors:
        seen = seen + (effect.instants(stamps, positions).T - stamps)
    markers = arcs.shown(arm, path(np.clip(seen, simulation.time[0], simulation.time[-1])))
    return time, markers[:, signal.marker, signal.axis]


def _draw_tips(
    page: Sheet, fit: RecordingFit, model: Model, nominal: Model, signal: Signal, parts: list[tuple[float, float]]
) -> None:
    limits = []
    for axes, window in zip(page.axes[0], parts, strict=True):
        rows = (signal.time >= window[0]) & (signal.time <= window[1])
        axes.plot(signal.time[rows], 1e3 * signal.value[rows], **_measured_look(_crowded(signal, parts)))
        if fit.replay is not None:
            time, value = drawn(fit.replay, model, fit.recording, signal, window)
            axes.plot(time, 1e3 * value, color=IDENTIFIED, linewidth=1.3)
        if fit.nominal is not None:
            time, value = drawn(fit.nominal, nominal, fit.recording, signal, window)
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


def _draw_residual(axes: Axes, fit: RecordingFit, signal: Signal, residual: Array, name: str) -> None:
    noise = 1e3 * fit.marker_noise
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


def _before(fit: RecordingFit, signal: Signal, residual: Array) -> _Before | None:
    """The torque method's residual or, where that is as good, the nominal one's; None where it would hide the other."""
    if fit.torque is not None:
        other = signal.value - simulated(fit.torque, fit.recording, signal)
        if _WORTH_A_LINE * _rms(residual) < _rms(other) <= _LEGIBLE * _rms(residual):
            return _Before("torque method's", TORQUE, other)
    if fit.nominal is not None:
        other = signal.value - simulated(fit.nominal, fit.recording, signal)
        if _rms(other) <= _LEGIBLE * _rms(residual):
            return _Before("nominal", NOMINAL, other)
    return None


def _handles(fit: RecordingFit, signal: Signal, name: str, crowded: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="measured", **_measured_look(crowded)),
        Line2D([], [], color=IDENTIFIED, label=f"{name} model"),
    ]
    if fit.nominal is not None:
        handles.append(Line2D([], [], color=NOMINAL, linestyle=NOMINAL_STYLE, label="nominal model"))
    other = (
        _before(fit, signal, signal.value - simulated(fit.replay, fit.recording, signal))
        if fit.replay is not None
        else None
    )
    if other is not None and other.color == TORQUE:
        handles.append(Line2D([], [], color=TORQUE, label="torque method (residual)"))
    return [*handles, Patch(color=BAND, label="±2σ noise")]
