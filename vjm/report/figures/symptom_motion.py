"""Where the model goes wrong: the recordings that it follows worst, and when each sensor shows the motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from vjm.report.choose import liveliest_window, marker_name, tip_signal
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    TORQUE,
    Row,
    Sheet,
    panel_title,
    printable,
    sheet,
    styled,
)
from vjm.report.wording import number, short
from vjm.symptoms import Symptom, Symptoms
from vjm.symptoms.examine import Examined
from vjm.symptoms.lags import Lag

Array = NDArray[np.float64]

MOST_SHOWN = 3
_MOST_LAGS = 24
_ROW = 0.34  # inches a recording
_STRETCH = "#fbe3c8"


class _Shown(NamedTuple):
    """A measured coordinate: instants (F,) [s], measured and simulated (F,), their name and unit, and the noise."""

    time: Array
    measured: Array
    simulated: Array
    name: str
    unit: str
    noise: float


def title_of(found: Symptoms, kinds: tuple[str, ...], otherwise: str) -> str:
    """The largest symptom of some kinds in words, without a full stop; else what to say where there is none."""
    first = next((each for each in found.headlines(len(found.found)) if each.kind in kinds), None)
    return otherwise if first is None else first.sentence.removesuffix(".")


def titled(title: str, rows: Sequence[Row], left: float | None = None) -> Sheet:
    """A sheet whose title, a sentence with broad letters perhaps, does not leave the page.

    Args:
        title: wrapped.
        rows: from the top.
        left: room for labels [inches].
    """
    page = sheet(title, rows) if left is None else sheet(title, rows, left=left)
    text = page.figure.texts[0]
    room = page.figure.bbox.width - 2 * text.get_window_extent().x0
    width = text.get_window_extent().width
    if width > room:
        text.set_fontsize(text.get_fontsize() * room / width)
    return page


def worst(found: Symptoms) -> list[Examined]:
    """The recordings with motion whose mean square residual, in units of the noise, is largest; one of each repeat."""
    moving = [each for each in found.recordings if each.bands is not None and _signal(each) is not None]
    moving.sort(key=lambda each: -each.misfit / max(sum(int(s.known.sum()) for s in each.sensors), 1))
    seen: set[str] = set()
    kept = []
    for each in moving:
        label = each.followed.recording.repeat
        if label is None or label not in seen:
            kept.append(each)
        if label is not None:
            seen.add(label)
    first = next((each.recording for each in found.headlines(len(found.found)) if each.recording is not None), None)
    shown = [each for each in kept if each.followed.recording.file == first]
    return [*shown[:1], *(each for each in kept if each not in shown[:1])][:MOST_SHOWN]


@styled
def overview(found: Symptoms) -> Figure:
    """Measured and simulated tip where it is worst, and the residual of the whole recording below.

    Args:
        found: with at least one recording in which something moves.
    """
    shown = worst(found)
    largest: Symptom | None = next(iter(found.headlines(1)), None)
    nothing = "The model follows every recording to within what noise explains"
    rows = [Row(1.9, len(shown)), Row(1.25, len(shown), gap=0.8)]
    page = titled(nothing if largest is None else largest.sentence.removesuffix("."), rows)
    for column, each in enumerate(shown):
        signal = _signal(each)
        if signal is not None:
            _draw(page.axes[0][column], page.axes[1][column], each, signal)
    page.legend(
        [
            Line2D([], [], color="#bdbdbd", linewidth=4.0, solid_capstyle="round", label="measured"),
            Line2D([], [], color=IDENTIFIED, label="model"),
            Line2D([], [], color=NOMINAL, linewidth=1.0, label="measured less model"),
            Patch(color=_STRETCH, label="the stretch shown above"),
            Patch(color=BAND, label="±2σ noise"),
        ]
    )
    return page.figure


def _signal(each: Examined) -> _Shown | None:
    followed = each.followed
    tip = tip_signal(followed.rig, followed.recording)
    if tip is not None:
        rows = np.isfinite(followed.recording.markers[:, tip.marker, tip.axis])
        name = f"{marker_name(followed.rig, tip.marker)}.{'xy'[tip.axis]}"
        simulated = followed.markers[rows, tip.marker, tip.axis]
        return _Shown(tip.time, 1e3 * tip.value, 1e3 * simulated, name, "mm", 1e3 * followed.noise[0])
    encoder = next((sensor for sensor in each.sensors if sensor.sensor == "encoder"), None)
    if encoder is None:
        return None
    rows, scale = encoder.known[:, 0], float(np.degrees(1.0))
    measured, simulated = scale * encoder.measured[rows, 0], scale * encoder.simulated[rows, 0]
    return _Shown(encoder.time[rows], measured, simulated, encoder.names[0], "deg", scale * encoder.noise)


def _draw(upper: Axes, lower: Axes, each: Examined, signal: _Shown) -> None:
    residual = signal.measured - signal.simulated
    start, stop = liveliest_window(signal.time, residual)
    inside = (signal.time >= start) & (signal.time <= stop)
    upper.plot(signal.time[inside], signal.measured[inside], color="#bdbdbd", linewidth=4.0, solid_capstyle="round")
    upper.plot(signal.time[inside], signal.simulated[inside], color=IDENTIFIED, linewidth=1.2)
    whole = stop - start > 0.99 * (signal.time[-1] - signal.time[0])
    panel_title(upper, f"{short(each.followed.recording.file, 18)}{'' if whole else ', worst stretch'}")
    lower.axvspan(start, stop, color=_STRETCH, linewidth=0)
    lower.axhspan(-2 * signal.noise, 2 * signal.noise, color=BAND, linewidth=0)
    lower.plot(signal.time, residual, color=NOMINAL, linewidth=0.9)
    lower.axhline(0.0, color="#444444", linewidth=0.6)
    for axes, what in ((upper, short(signal.name, 16)), (lower, "residual")):
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{printable(what)} [{signal.unit}]", labelpad=2)
    panel_title(lower, f"{number(float(np.sqrt(np.mean(residual**2))) / signal.noise, 2)} times the noise")


@styled
def lags(found: Symptoms) -> Figure:
    """Delay of the camera and of the encoders against the model, and of the one against the other.

    Args:
        found: with at least one recording that shows both.
    """
    shown: list[tuple[Examined, Lag]] = [(each, each.lag) for each in found.recordings if each.lag is not None]
    shown.sort(key=lambda pair: pair[1].lag.std)
    shown = shown[:_MOST_LAGS]
    pooled = found.lag
    within = number(1e3 * (abs(pooled.value) + 2 * pooled.std), 2)
    title = title_of(found, ("camera_lag",), f"Camera and encoders tell the same time, to within {within} ms")
    page = titled(title, [Row(max(_ROW * len(shown), 0.7))], left=2.2)
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    axes.axvspan(
        1e3 * (pooled.value - 2 * pooled.std), 1e3 * (pooled.value + 2 * pooled.std), color="#c9d6e6", linewidth=0
    )
    axes.axvline(0.0, color="#444444", linewidth=0.8)
    for estimates, offset, color, marker, filled in (
        ([lag.camera for _, lag in shown], 0.22, MEASURED, "o", False),
        ([lag.encoder for _, lag in shown], -0.22, TORQUE, "s", False),
        ([lag.lag for _, lag in shown], 0.0, IDENTIFIED, "D", True),
    ):
        axes.errorbar(
            [1e3 * each.value for each in estimates],
            places + offset,
            xerr=[2e3 * each.std for each in estimates],
            linestyle="",
            marker=marker,
            markersize=4.5,
            color=color,
            markerfacecolor=color if filled else "white",
            elinewidth=1.1,
        )
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [printable(short(each.followed.recording.file, 22)) for each, _ in shown])
    axes.grid(False, axis="y")
    axes.set_xlabel("delay, two standard errors [ms]")
    axes.set_ylabel("recording", labelpad=6)
    page.legend(
        [
            Line2D(
                [], [], linestyle="", marker="o", color=MEASURED, markerfacecolor="white", label="camera against model"
            ),
            Line2D(
                [], [], linestyle="", marker="s", color=TORQUE, markerfacecolor="white", label="encoder against model"
            ),
            Line2D([], [], linestyle="", marker="D", color=IDENTIFIED, label="camera against encoder"),
            Patch(color="#c9d6e6", label="all recordings together"),
        ]
    )
    return page.figure
