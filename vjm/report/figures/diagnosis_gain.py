"""What the causes gain: each recording without and with them, and held-out motion before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from vjm.errors import InsufficientDataError
from vjm.model import Model
from vjm.report.choose import Signal, liveliest_window, tip_signal
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    NOMINAL_STYLE,
    TORQUE,
    Row,
    log_ticks,
    panel_title,
    printable,
    sheet,
    styled,
)
from vjm.report.figures.tips import drawn, label, simulated
from vjm.report.wording import millimetres, short
from vjm.simulate.initial_state import Replay

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis, Replayed

Array = NDArray[np.float64]

MOST_RECORDINGS = 40
_ROW = 0.3  # inches a recording
_LOOKS: dict[str, dict[str, Any]] = {
    "before": {"linestyle": "", "marker": "s", "color": NOMINAL, "markerfacecolor": "white", "zorder": 2},
    "runner_up": {"linestyle": "", "marker": "D", "color": TORQUE, "markersize": 6, "zorder": 3},
    "after": {"linestyle": "", "marker": "o", "color": IDENTIFIED, "zorder": 4},
}
_NAMES = {"before": "without the causes", "runner_up": "next best explanation", "after": "with the causes"}
_NOISE: dict[str, Any] = {"linestyle": "", "marker": "|", "markeredgewidth": 2, "color": MEASURED}
_MEASURED: dict[str, Any] = {"color": "#bdbdbd", "linewidth": 4.0, "solid_capstyle": "round"}


@styled
def gain_of_recordings(diagnosis: Diagnosis) -> Figure:
    """RMS marker residual of every recording without and with the causes, beside the noise, logarithmic.

    Args:
        diagnosis: with at least one recording that the models follow.
    """
    # Held-out recordings first: they are what counts.
    ordered = sorted(diagnosis.recordings, key=lambda each: each.recording.role != "holdout")
    shown = [each for each in ordered if each.before is not None][:MOST_RECORDINGS]
    page = sheet(_title(diagnosis), [Row(max(_ROW * len(shown), 0.7))], left=2.75)
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    kept = [name for name in _LOOKS if name == "before" or (diagnosis.causes and _any(shown, name))]
    for row, each in zip(places.tolist(), shown, strict=True):
        sizes = {name: replay.marker_rms for name in kept if (replay := getattr(each, name)) is not None}
        if "after" in sizes:
            ends = [1e3 * sizes["before"], 1e3 * sizes["after"]]
            axes.plot(ends, [row, row], color="#bbbbbb", linewidth=1.0, zorder=1)
        for name, size in sizes.items():
            axes.plot(1e3 * size, row, **_LOOKS[name])
        axes.plot(1e3 * each.noise, row, **_NOISE, markersize=15, zorder=1)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.15, high * 1.15)
    log_ticks(axes.xaxis)
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [_label(each) for each in shown])
    axes.grid(False, axis="y")
    axes.set_xlabel("marker residual over the whole recording, open loop, RMS [mm]")
    axes.set_ylabel("recording", labelpad=6)
    handles = [Line2D([], [], **_LOOKS[name], label=_NAMES[name] if diagnosis.causes else "model") for name in kept]
    page.legend([*handles, Line2D([], [], **_NOISE, markersize=11, label="noise")])
    return page.figure


def _any(shown: Sequence[Replayed], name: str) -> bool:
    return any(getattr(each, name) is not None for each in shown)


def _title(diagnosis: Diagnosis) -> str:
    gain = diagnosis.gain
    if gain is None or not diagnosis.causes:
        return "How far each recording is from the model without any effect"
    text = f"Held-out recordings: {millimetres(gain.before)} without the causes, {millimetres(gain.after)} with them"
    if gain.runner_up is not None:
        text += f", {millimetres(gain.runner_up)} with the next best explanation"
    return f"{text}; noise {millimetres(gain.noise)}"


def _label(each: Replayed) -> str:
    role = "held out" if each.recording.role == "holdout" else "train"
    return printable(f"{short(each.recording.file, 24)} ({role})")


@styled
def before_and_after(followed: Replayed, diagnosis: Diagnosis) -> Figure:
    """Tip of one recording, measured and by the models without and with the causes; residuals underneath.

    Args:
        followed: a recording that both models follow, with at least one marker.
        diagnosis: has the models.

    Raises:
        InsufficientDataError: a recording without replays or marker.
    """
    recording, model = followed.recording, diagnosis.model
    signal = tip_signal(model.rig, recording)
    if signal is None or followed.before is None or followed.after is None:
        raise InsufficientDataError(f"tip of {recording.file}", "no marker or no replay", "choose another recording")
    left = {
        name: signal.value - simulated(replay, recording, signal)
        for name in ("before", "runner_up", "after")
        if (replay := getattr(followed, name)) is not None
    }
    role = "held out" if recording.role == "holdout" else "train"
    sizes = [millimetres(float(np.sqrt(np.mean(left[name] ** 2)))) for name in ("before", "after")]
    title = (
        f"Tip of {short(recording.file)} ({role}): off by {sizes[0]} RMS without the causes, by {sizes[1]} with them"
    )
    page = sheet(title, [Row(1.8), Row(1.8, gap=0.75)])
    start, stop = liveliest_window(signal.time, left["before"])
    _draw_motion(page.axes[0][0], followed, diagnosis, signal, (start, stop))
    _draw_residuals(page.axes[1][0], followed, signal, left)
    page.legend(_handles("runner_up" in left))
    return page.figure


def _draw_motion(
    axes: Axes, followed: Replayed, diagnosis: Diagnosis, signal: Signal, window: tuple[float, float]
) -> None:
    rows = (signal.time >= window[0]) & (signal.time <= window[1])
    axes.plot(signal.time[rows], 1e3 * signal.value[rows], **_MEASURED)
    shown: list[tuple[Replay | None, Model, dict[str, Any]]] = [
        (followed.before, diagnosis.base, {"color": NOMINAL, "linestyle": NOMINAL_STYLE, "linewidth": 1.3}),
        (followed.after, diagnosis.model, {"color": IDENTIFIED, "linewidth": 1.3}),
    ]
    for replay, model, look in shown:
        if replay is not None:
            time, value = drawn(replay, model, followed.recording, signal, window)
            axes.plot(time, 1e3 * value, **look)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label(diagnosis.model.rig, signal))
    whole = window[1] - window[0] > 0.99 * (signal.time[-1] - signal.time[0])
    panel_title(axes, "" if whole else "Where the model without the causes is off most")


def _draw_residuals(axes: Axes, followed: Replayed, signal: Signal, left: dict[str, Array]) -> None:
    noise = 1e3 * followed.noise
    axes.axhspan(-2 * noise, 2 * noise, color=BAND, linewidth=0)
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    colors = {"before": NOMINAL, "runner_up": TORQUE, "after": IDENTIFIED}
    largest = 4 * noise
    for name, values in left.items():
        axes.plot(signal.time, 1e3 * values, color=colors[name], linewidth=0.9, alpha=0.95)
        if name != "runner_up":
            largest = max(largest, 1.08e3 * float(np.abs(values).max()))
    axes.set_ylim(-largest, largest)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual [mm]")
    panel_title(axes, "Measured less simulated, whole recording")


def _handles(runner_up: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="measured", **_MEASURED),
        Line2D([], [], color=NOMINAL, linestyle=NOMINAL_STYLE, label=_NAMES["before"]),
        Line2D([], [], color=IDENTIFIED, label=_NAMES["after"]),
    ]
    if runner_up:
        handles.append(Line2D([], [], color=TORQUE, label=f"{_NAMES['runner_up']} (residual)"))
    return [*handles, Patch(color=BAND, label="±2σ noise")]
