"""How well the model follows every recording, in one picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vjm.identification.records import RecordingFit
from vjm.report.figures.style import IDENTIFIED, MEASURED, NOMINAL, Row, log_ticks, printable, sheet, styled
from vjm.report.wording import listed, number, short

MOST_RECORDINGS = 40
_ROW = 0.3  # inches a recording


@styled
def fit_of_recordings(fits: Sequence[RecordingFit], name: str = "identified") -> Figure:
    """Root mean square marker residual of every recording beside the noise, on a logarithmic axis.

    Args:
        fits: in the order to be shown, from the top.
        name: what to call the model.
    """
    shown = list(fits)[:MOST_RECORDINGS]
    page = sheet(_title(shown, name), [Row(max(_ROW * len(shown), 0.7))], left=2.75)
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    for place, fit in zip(places.tolist(), shown, strict=True):
        pair = [each.marker_rms * 1e3 for each in (fit.nominal, fit.replay) if each is not None]
        if len(pair) == 2:
            axes.plot(pair, [place, place], color="#bbbbbb", linewidth=1.0, zorder=1)
        if fit.nominal is not None:
            axes.plot(1e3 * fit.nominal.marker_rms, place, marker="s", color=NOMINAL, markerfacecolor="white", zorder=2)
        if fit.replay is not None:
            axes.plot(1e3 * fit.replay.marker_rms, place, marker="o", color=IDENTIFIED, zorder=3)
        axes.plot(1e3 * fit.marker_noise, place, marker="|", markersize=15, markeredgewidth=2, color=MEASURED, zorder=1)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.15, high * 1.15)
    log_ticks(axes.xaxis)
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [_label(fit) for fit in shown])
    axes.grid(False, axis="y")
    axes.set_xlabel("marker residual over the whole recording, open loop, RMS [mm]")
    axes.set_ylabel("recording", labelpad=6)
    page.legend(
        [
            Line2D([], [], linestyle="", marker="s", color=NOMINAL, markerfacecolor="white", label="nominal model"),
            Line2D([], [], linestyle="", marker="o", color=IDENTIFIED, label=f"{name} model"),
            Line2D([], [], linestyle="", marker="|", markersize=11, markeredgewidth=2, color=MEASURED, label="noise"),
        ]
    )
    return page.figure


def _label(fit: RecordingFit) -> str:
    role = "held out" if fit.recording.role == "holdout" else "train"
    missing = "" if fit.replay is not None else ", not simulated"
    return printable(f"{short(fit.recording.file, 24)} ({role}{missing})")


def _title(fits: Sequence[RecordingFit], name: str) -> str:
    parts = []
    for role, words in (("train", "train"), ("holdout", "held-out")):
        ratios = [fit.replay.marker_rms / fit.marker_noise for fit in fits if fit.replay and fit.recording.role == role]
        if ratios:
            low, high = number(min(ratios), 2), number(max(ratios), 2)
            parts.append(f"{low if low == high else f'{low} to {high}'} times the noise in {words} recordings")
    return f"Residual of the {name} model: {listed(parts)}" if parts else "No recording could be simulated"
