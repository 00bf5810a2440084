"""Frequency band by frequency band: amplitude and phase of the vibrations; frequency and damping against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    Row,
    letters_on,
    log_ticks,
    panel_title,
    printable,
    styled,
)
from vjm.report.figures.symptom_motion import title_of, titled
from vjm.report.wording import number, short
from vjm.symptoms import Symptoms
from vjm.symptoms.amplitude import FreeMotion
from vjm.symptoms.bands import Band
from vjm.symptoms.examine import Examined

Array = NDArray[np.float64]

MOST_ROWS = 24
_MOST_BANDS = 3
_ROW = 0.3  # inches a recording
_LIMITS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # of a colour scale [% or deg]
_MOST_POINTS = 10
_TIMES = 250.0  # per cent; more is told as so many times
_CLEAR = 4.0  # times the median error: what is less sure is not drawn
_LEAST_RANGE = 2e-3  # of a frequency or damping ratio, on its axis
_BAND_KINDS = ("frequency", "phase", "amplitude", "damping", "rest_amplitude", "rest_delay")
_TREND_KINDS = ("frequency_with_amplitude", "damping_with_amplitude")


@styled
def bands(found: Symptoms) -> Figure:
    """Amplitude of every band in every recording, and its phase when the motion ends, measured against simulated.

    Args:
        found: with at least one recording in which a band moves.
    """
    rows = [each for each in found.recordings if each.bands is not None and each.bands.bands][:MOST_ROWS]
    shown = [mode for mode in range(len(found.frequencies)) if any(_band(each, mode) is not None for each in rows)]
    tables = (_table(rows, shown, _size, rest=True), _table(rows, shown, _angle, rest=False))
    nothing = "Amplitude and phase of all vibrations are as simulated"
    page = titled(title_of(found, _BAND_KINDS, nothing), [Row(_ROW * len(rows), 2, gap=0.5)], left=2.3)
    words = ("amplitude, measured against model [%]", "phase at the end, measured ahead [deg]")
    labels = [f"{number(found.frequencies[mode], 2)} Hz" for mode in shown]
    for axes, table, word, names in zip(page.axes[0], tables, words, ([*labels, "the rest"], labels), strict=True):
        _draw_map(axes, table, word, names, times=table is tables[0])
    files = [printable(short(each.followed.recording.file, 22)) for each in rows]
    page.axes[0][0].set_yticks(np.arange(len(rows)) + 0.5, files)
    page.axes[0][1].set_yticks([])
    for axes in page.axes[0]:
        axes.set_ylabel("recording", labelpad=6)
    colors = colormaps["PuOr_r"]
    page.legend(
        [
            Patch(facecolor=colors(0.95), edgecolor="#bbbbbb", label="larger, ahead"),
            Patch(facecolor="white", edgecolor="#bbbbbb", label="0: as the model, within three standard errors"),
            Patch(facecolor=colors(0.05), edgecolor="#bbbbbb", label="smaller, behind"),
            Patch(facecolor=BAND, edgecolor="#bbbbbb", label="does not move"),
        ]
    )
    return page.figure


def _band(each: Examined, mode: int) -> Band | None:
    return None if each.bands is None else each.bands.of_mode(mode)


def _size(band: Band) -> float:
    if abs(band.size.value) < 3 * band.size.std:
        return 0.0
    return 100 * float(np.expm1(band.size.value))


def _angle(band: Band) -> float:
    return float(np.degrees(band.ahead))


def _table(rows: Sequence[Examined], modes: Sequence[int], value: object, rest: bool) -> Array:
    """(recordings, bands) with the rest's gain as the last column where it is asked for; NaN where nothing moves."""
    table = np.full((len(rows), len(modes) + rest), np.nan)
    for r, each in enumerate(rows):
        for c, mode in enumerate(modes):
            band = _band(each, mode)
            if band is not None and callable(value):
                table[r, c] = value(band)
        if rest and each.bands is not None and np.isfinite(each.bands.rest_gain.std):
            gain = each.bands.rest_gain
            table[r, -1] = 100 * gain.value if abs(gain.value) > 3 * gain.std else 0.0
    return table


def _draw_map(axes: Axes, table: Array, words: str, names: Sequence[str], times: bool) -> None:
    largest = float(np.nanmax(np.abs(table))) if np.isfinite(table).any() else 0.0
    limit = next((each for each in _LIMITS if largest <= each), _LIMITS[-1])
    colors = colormaps["PuOr_r"]
    axes.set_facecolor(BAND)
    shade = np.sign(table) * np.sqrt(np.minimum(np.abs(table) / limit, 1.0))  # small ones are seen as well
    axes.pcolormesh(np.ma.masked_invalid(shade), cmap=colors, vmin=-1, vmax=1, edgecolors="#bbbbbb", linewidth=0.6)
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value):
            color = letters_on(colors(0.5 + 0.5 * float(shade[row, column])))
            text = _signed(float(value), times)
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=8.5, color=color)
    axes.invert_yaxis()
    axes.set_xticks(np.arange(len(names)) + 0.5, list(names))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.set_xlabel("band [Hz]")
    panel_title(axes, words)


def _signed(value: float, times: bool) -> str:
    if abs(value) < 5e-3:
        return "0"
    if times and value > _TIMES:
        return f"{1 + value / 100:.0f} times"
    if not times and abs(value) > 360:
        return f"{value / 360:+.1f} turns".replace("-", "\N{MINUS SIGN}")
    text = f"{value:+.0f}" if abs(value) >= 10 else f"{value:+.1f}" if abs(value) >= 0.95 else f"{value:+.2f}"
    return text.replace("-", "\N{MINUS SIGN}")


@styled
def with_amplitude(found: Symptoms) -> Figure:
    """Frequency and damping ratio of every band against amplitude, while nothing drives the arm.

    Args:
        found: with free motion in at least one recording.
    """
    groups = _groups(found)
    nothing = "Frequency and damping change with amplitude as they do in the model"
    page = titled(title_of(found, _TREND_KINDS, nothing), [Row(1.7, len(groups)), Row(1.7, len(groups), gap=0.45)])
    for column, (mode, own) in enumerate(groups):
        scale, unit = (1e3, "mm") if own[0].unit == "m" else (float(np.degrees(1.0)), "deg")
        amplitude = scale * np.concatenate([each.amplitude for each in own])
        frequency = np.concatenate([each.frequencies for each in own])
        damping = np.concatenate([each.decays for each in own]) / (2 * np.pi * frequency[:, 1:])
        frequency_std = np.concatenate([each.frequency_std for each in own])
        damping_std = np.concatenate([each.decay_std for each in own]) / (2 * np.pi * frequency[:, 1])
        upper, lower = page.axes[0][column], page.axes[1][column]
        _draw_trend(upper, amplitude, frequency, frequency_std, power=2)
        _draw_trend(lower, amplitude, damping, damping_std, power=1)
        upper.set_ylabel("frequency [Hz]")
        lower.set_ylabel("damping ratio [1]")
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(f"amplitude [{unit}]")
        panel_title(
            upper,
            f"mode at {number(found.frequencies[mode], 3)} Hz, {number(float(len(own)), 1)} recordings"
            if len(own) > 1
            else f"mode at {number(found.frequencies[mode], 3)} Hz",
        )
    page.legend(
        [
            Line2D(
                [], [], linestyle="", marker="o", color=MEASURED, markerfacecolor="white", label="measured, with error"
            ),
            Line2D([], [], color=IDENTIFIED, label="model"),
        ]
    )
    return page.figure


def has_free_motion(found: Symptoms) -> bool:
    """Whether there is anything to draw of frequency and damping against amplitude."""
    return bool(_groups(found))


def _groups(found: Symptoms) -> list[tuple[int, list[FreeMotion]]]:
    """Modes and their free motions in one unit, most points first; at most three, slowest first."""
    every = [motion for each in found.recordings for motion in each.free]
    groups = []
    for mode in range(len(found.frequencies)):
        own = [motion for motion in every if motion.mode == mode]
        own = [motion for motion in own if motion.unit == own[0].unit]
        if sum(motion.time.size for motion in own) >= 3:
            groups.append((mode, own))
    groups.sort(key=lambda group: -sum(motion.time.size for motion in group[1]))
    return sorted(groups[:_MOST_BANDS], key=lambda group: group[0])


def _draw_trend(axes: Axes, amplitude: Array, pairs: Array, std: Array, power: int) -> None:
    """Measured and simulated values (P, 2): the model's trend, and what is measured beside it.

    What leaks into the windows from other motion is the same in both, and goes with their difference. Neighbours in
    amplitude are averaged by their errors.
    """
    line = np.stack([np.ones_like(amplitude), (amplitude / amplitude.max()) ** power], axis=1)
    model = line @ np.linalg.lstsq(line / std[:, None], pairs[:, 1] / std, rcond=None)[0]
    values = np.stack([model + pairs[:, 0] - pairs[:, 1], model], axis=1)
    order = np.argsort(amplitude)
    parts = np.array_split(order, min(_MOST_POINTS, order.size))
    weights = [std[part] ** -2.0 for part in parts]
    place = np.array([np.average(amplitude[part], weights=w) for part, w in zip(parts, weights, strict=True)])
    means = np.array([np.average(values[part], axis=0, weights=w) for part, w in zip(parts, weights, strict=True)])
    errors = np.array(
        [max(_scatter(values[part, 0], w), np.sum(w) ** -0.5) for part, w in zip(parts, weights, strict=True)]
    )
    clear = errors <= _CLEAR * np.median(errors)
    place, means, errors = place[clear], means[clear], errors[clear]
    axes.plot(place, means[:, 1], color=IDENTIFIED, linewidth=1.3)
    look: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 5, "color": MEASURED}
    axes.errorbar(place, means[:, 0], yerr=errors, elinewidth=1.1, markerfacecolor="white", **look)
    low, high = axes.get_ylim()
    least = _LEAST_RANGE * float(np.abs(means).mean())  # or nothing but noise is magnified
    if high - low < least:
        axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
    axes.set_xscale("log")
    low, high = float(place.min()), float(place.max())
    axes.set_xlim(low / 1.15, high * 1.15)
    log_ticks(axes.xaxis)
    axes.ticklabel_format(axis="y", useOffset=False)


def _scatter(values: Array, weights: Array) -> float:
    """Standard error of a weighted mean from the values' own scatter."""
    if values.size < 3:
        return 0.0
    mean = np.average(values, weights=weights)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weights) / (values.size - 1)))
