"""How well the model follows every recording, in one picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vjm.identification.records import RecordingFit
from vjm.report.figures.style import (
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    TORQUE,
    Row,
    log_ticks,
    printable,
    sheet,
    styled,
)
from vjm.report.wording import listed, number, short
from vjm.simulate.initial_state import Replay

MOST_RECORDINGS = 40
_ROW = 0.3  # inches a recording
_LOOKS: tuple[dict[str, Any], ...] = (
    {"linestyle": "", "marker": "s", "color": NOMINAL, "markerfacecolor": "white", "zorder": 2},
    {"linestyle": "", "marker": "D", "color": TORQUE, "markersize": 8, "zorder": 3},
    {"linestyle": "", "marker": "o", "color": IDENTIFIED, "zorder": 4},
)  # nominal, torque method, identified
_NOISE: dict[str, Any] = {"linestyle": "", "marker": "|", "markeredgewidth": 2, "color": MEASURED}


@styled
def fit_of_recordings(fits: Sequence[RecordingFit], name: str = "identified") -> Figure:
    """Root mean square marker residual of every recording beside the noise, on a logarithmic axis.

    In millimetres; in units of the noise where the torque method stands beside the trajectory method.

    Args:
        fits: in the order to be shown, from the top.
        name: what to call the model.
    """
    shown = list(fits)[:MOST_RECORDINGS]
    compared = any(fit.torque is not None for fit in shown)
    page = sheet(
        _compared(shown, name) if compared else _title(shown, name), [Row(max(_ROW * len(shown), 0.7))], left=2.75
    )
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    for place, fit in zip(places.tolist(), shown, strict=True):
        unit = fit.marker_noise if compared else 1e-3
        drawn = [(each, look) for each, look in zip(_replays(fit), _LOOKS, strict=True) if each is not None]
        if len(drawn) > 1:
            ends = [drawn[0][0].marker_rms / unit, drawn[-1][0].marker_rms / unit]
            axes.plot(ends, [place, place], color="#bbbbbb", linewidth=1.0, zorder=1)
        for replay, look in drawn:
            axes.plot(replay.marker_rms / unit, place, **look)
        if not compared:
            axes.plot(fit.marker_noise / unit, place, **_NOISE, markersize=15, zorder=1)
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


def _replays(fit: RecordingFit) -> tuple[Replay | None, Replay | None, Replay | None]:
    return fit.nominal, fit.torque, fit.replay


def _compared(fits: Sequence[RecordingFit], name: str) -> str:
    """The held-out recordings by all three models; the training ones where none was held out."""
    replayed = [fit for fit in fits if fit.replay is not None]
    held_out = [fit for fit in replayed if fit.recording.role == "holdout"]
    parts = []
    for k, words in enumerate((f"{name} model", "torque method", "nominal model")):
        known = [(fit, _replays(fit)[2 - k]) for fit in held_out or replayed]
        ratios = [replay.marker_rms / fit.marker_noise for fit, replay in known if replay is not None]
        if ratios:
            parts.append(f"{words} {_range(ratios)}")
    return f"Residual over noise in {'held-out' if held_out else 'training'} recordings: {', '.join(parts)}"


def _range(ratios: Sequence[float]) -> str:
    low, high = number(min(ratios), 2), number(max(ratios), 2)
    return low if low == high else f"{low} to {high}"


def _label(fit: RecordingFit) -> str:
    role = "held out" if fit.recording.role == "holdout" else "train"
    missing = "" if fit.replay is not None else ", not simulated"
    return printable(f"{short(fit.recording.file, 24)} ({role}{missing})")


def _title(fits: Sequence[RecordingFit], name: str) -> str:
    parts = []
    for role, words in (("train", "train"), ("holdout", "held-out")):
        ratios = [fit.replay.marker_rms / fit.marker_noise for fit in fits if fit.replay and fit.recording.role == role]
        if ratios:
            parts.append(f"{_range(ratios)} times the noise in {words} recordings")
    return f"Residual of the {name} model: {listed(parts)}" if parts else "No recording could be simulated"
