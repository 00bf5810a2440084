"""Which estimated parameters the recordings can tell apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy import stats

from vjm.records import Array, Estimate, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    TORQUE,
    Row,
    letters_on,
    log_ticks,
    panel_title,
    printable,
    sheet,
    styled,
)
from vjm.report.figures.windows import marker_name, tips
from vjm.report.text import number, short
from vjm.simulation.model import Model

_LEAST_VALUES = 8  # of a coordinate, for a spectrum
_FALSE_ALARM = 1e-3  # chance that white noise passes the limit anywhere


class Column(NamedTuple):
    """One measured coordinate of one marker, or all those of one.

    Attributes:
        name: as in the recordings' header.
        marker: its index among all markers of the rig.
        axes: the coordinates pooled, 0 for x and 1 for y.
    """

    name: str
    marker: int
    axes: tuple[int, ...]


def residual(recording: Recording, replay: SimulatedRecording) -> Array:
    """(T, k, 2) measured less simulated marker coordinates [m]; NaN where not measured."""
    difference: Array = recording.markers - replay.simulation.markers
    return difference


def columns(rig: Rig, fits: list[RecordingComparison], most: int) -> list[Column]:
    """The coordinates measured in any of the recordings, pooled marker by marker where there are too many."""
    measured = np.any([np.isfinite(fit.recording.markers).any(axis=0) for fit in fits], axis=0)
    seen = [(marker, tuple(np.flatnonzero(axes).tolist())) for marker, axes in enumerate(measured) if axes.any()]
    single = [Column(f"{marker_name(rig, m)}.{'xy'[axis]}", m, (axis,)) for m, axes in seen for axis in axes]
    if len(single) <= most:
        return single
    return [Column(marker_name(rig, marker), marker, axes) for marker, axes in seen]


def misfit(fits: list[RecordingComparison], shown: list[Column]) -> tuple[Array, Array]:
    """RMS residual in units of the noise, and what white noise would pass anywhere in one report of a thousand.

    Both (recordings, columns); NaN where nothing was measured or simulated.
    """
    table = np.full((len(fits), len(shown)), np.nan)
    limit = table.copy()
    for row, fit in enumerate(fits):
        if fit.simulated is None:
            continue
        left = residual(fit.recording, fit.simulated) / fit.noise[0]
        for k, column in enumerate(shown):
            values = left[:, column.marker, list(column.axes)]
            known = np.isfinite(values)
            if known.any():
                count = int(known.sum())
                table[row, k] = np.sqrt(np.mean(values[known] ** 2))
                limit[row, k] = np.sqrt(stats.chi2.isf(_FALSE_ALARM / table.size, count) / count)
    return table, limit


class Spectrum(NamedTuple):
    """Amplitude of the residual, root mean square over all marker coordinates.

    A sine of amplitude a in every coordinate is a line of height a.

    Attributes:
        frequency: (F,) from one period in the recording up to half the camera's rate [Hz].
        amplitude: (F,) [m].
        white: what white noise of the camera's size would give [m].
        limit: what it would pass anywhere in one recording of a thousand [m].
    """

    frequency: Array
    amplitude: Array
    white: float
    limit: float


def spectrum(recording: Recording, replay: SimulatedRecording, noise: float) -> Spectrum | None:
    """Amplitude spectrum of what the model leaves of a recording.

    Values lost for a moment count as zeros, and amplitudes are scaled by the number of those there are.

    Args:
        recording: as measured.
        replay: of it.
        noise: 1-sigma of a marker coordinate [m].

    Returns:
        None where too little was measured.
    """
    rows = recording.frames
    if rows.size < _LEAST_VALUES:
        return None
    time = recording.time[rows]
    step = float(np.median(np.diff(time)))
    place = np.round((time - time[0]) / step).astype(int)  # frames that the camera dropped leave gaps
    left = residual(recording, replay)[rows].reshape(rows.size, -1)
    counts = np.isfinite(left).sum(axis=0)
    kept = counts >= _LEAST_VALUES
    if not kept.any():
        return None
    even = np.zeros((int(place[-1]) + 1, int(kept.sum())))
    even[place] = np.nan_to_num(left[:, kept])
    lines = np.fft.rfft(even, axis=0)[1:-1] * (2 / counts[kept])
    power: Array = np.mean(np.abs(lines) ** 2, axis=1)
    white = noise**2 * float(np.mean(4 / counts[kept]))
    freedom = 2 * int(kept.sum())
    limit = white * float(stats.chi2.isf(_FALSE_ALARM / power.size, freedom)) / freedom
    frequency = np.asarray(np.fft.rfftfreq(len(even), step)[1:-1], dtype=np.float64)
    amplitude: Array = np.sqrt(power)
    return Spectrum(frequency, amplitude, float(np.sqrt(white)), float(np.sqrt(limit)))


MOST_ROWS = 24
_MOST_COLUMNS = 14
_MOST_SPECTRA = 4
_ROW = 0.3  # inches a recording
_MODES = "#a03060"
# Residual over noise from white to dark: the scale that the worst needs.
_LEVELS = ((1.0, 1.5, 3.0, 10.0), (1.0, 3.0, 10.0, 100.0), (1.0, 10.0, 100.0, 1000.0))
_SLOW_LINES = 2  # of a spectrum, from its beginning: not even two periods in the recording
_SAME_MODE = 0.05  # of a frequency
_NEGLIGIBLE = 1.1  # residual over noise that is nothing to look for


@styled
def residual_map(model: Model, fits: Sequence[RecordingComparison]) -> Figure:
    """RMS residual of every marker coordinate in every recording, in units of the noise.

    Args:
        model: the identified one.
        fits: of the recordings, at least one with a replay and a marker.
    """
    shown = [fit for fit in fits if fit.simulated is not None][:MOST_ROWS]
    heads = columns(model.rig, shown, _MOST_COLUMNS)
    table, limit = misfit(shown, heads)
    page = sheet(_map_title(shown, [head.name for head in heads], table, limit), [Row(_ROW * len(shown))], left=2.75)
    axes = page.axes[0][0]
    levels = next((each for each in _LEVELS if np.nanmax(table) <= each[-1]), _LEVELS[-1])
    colors, norm = _colors(), LogNorm(1.0, levels[-1], clip=True)
    axes.pcolormesh(np.ma.masked_invalid(table), cmap=colors, norm=norm, edgecolors="#bbbbbb", linewidth=0.6)
    if len(heads) <= 2 * _MOST_COLUMNS:
        _write_cells(axes, table, colors, norm)
    axes.invert_yaxis()
    axes.set_yticks(np.arange(len(shown)) + 0.5, [_label(fit) for fit in shown])
    single = len(model.rig.links) == 1
    names = [head.name.partition(".")[2] if single else head.name.replace(".", "\n", 1) for head in heads]
    axes.set_xticks(np.arange(len(heads)) + 0.5, [printable(short(name, 14)) for name in names])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.set_xlabel("marker coordinate")
    axes.set_ylabel("recording", labelpad=6)
    page.legend(
        [
            Patch(facecolor=colors(norm(level)), edgecolor="#bbbbbb", label=f"{level:g} times the noise{more}")
            for level, more in zip(levels, (" or less", "", "", " or more"), strict=True)
        ]
    )
    return page.figure


def _colors() -> Colormap:
    return LinearSegmentedColormap.from_list("residual", ["#ffffff", "#f5c38a", "#c2541a", "#3d0f04"])


def _write_cells(axes: Axes, table: Array, colors: Colormap, norm: LogNorm) -> None:
    size = 8.5 if table.shape[1] <= _MOST_COLUMNS else 6.5
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value):
            color = letters_on(colors(norm(value)))
            text = f"{value:.0f}" if value >= 10 else f"{value:.2f}"
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=size, color=color)


def _label(fit: RecordingComparison) -> str:
    role = "held out" if fit.recording.role == "holdout" else "train"
    return printable(f"{short(fit.recording.file, 24)} ({role})")


def _map_title(fits: Sequence[RecordingComparison], names: Sequence[str], table: Array, limit: Array) -> str:
    row, column = divmod(int(np.nanargmax(table)), table.shape[1])
    worst = float(table[row, column])
    noise = bool(np.nanmax(table / np.maximum(limit, _NEGLIGIBLE)) <= 1)
    where = f"{names[column]} in {short(fits[row].recording.file)}"
    if noise:
        return f"Every marker is followed to within the noise; at most {number(worst, 3)} times it, {where}"
    return f"Residual marker by marker: at most {number(worst, 3)} times the noise, {where}"


def residual_spectra(model: Model, fits: Sequence[RecordingComparison]) -> Figure | None:
    """Amplitude spectra of what the model leaves of the held-out and the worst recordings, beside white noise.

    Args:
        model: the identified one; its natural frequencies are marked.
        fits: of the recordings.

    Returns:
        None where no recording has a spectrum.
    """
    found = []
    for fit in tips(model.rig, fits, _MOST_SPECTRA):
        left = None if fit.simulated is None else spectrum(fit.recording, fit.simulated, fit.noise[0])
        if left is not None:
            found.append((fit, left))
    return _spectra(model, found) if found else None


@styled
def _spectra(model: Model, found: Sequence[tuple[RecordingComparison, Spectrum]]) -> Figure:
    count = min(2, len(found))
    rows = -(-len(found) // count)
    page = sheet(_spectrum_title(model, found), [Row(1.7 if rows > 1 else 2.2, count, gap=0.8)] * rows)
    panels = [axes for row in page.axes for axes in row]
    for unused in panels[len(found) :]:
        unused.remove()
    for axes, (fit, left) in zip(panels, found, strict=False):
        _draw_spectrum(axes, model, fit, left)
    handles = [
        Line2D([], [], color=IDENTIFIED, label="identified model"),
        Line2D([], [], color=MEASURED, linewidth=1.6, label="white noise"),
        Line2D([], [], color=MEASURED, linestyle=(0, (4, 2)), label="its limit (99.9 %)"),
        Line2D([], [], color=_MODES, linestyle=(0, (1, 1.5)), label="natural frequency of the model"),
    ]
    if any(fit.alternative is not None for fit, _ in found):
        handles.insert(1, Line2D([], [], color=TORQUE, linewidth=1.0, label="torque method"))
    page.legend(handles)
    return page.figure


def _draw_spectrum(axes: Axes, model: Model, fit: RecordingComparison, left: Spectrum) -> None:
    before = None if fit.alternative is None else spectrum(fit.recording, fit.alternative, fit.noise[0])
    drawn = [left.amplitude]
    if before is not None:
        axes.plot(before.frequency, 1e6 * before.amplitude, color=TORQUE, linewidth=1.0)
        drawn.append(before.amplitude)
    axes.plot(left.frequency, 1e6 * left.amplitude, color=IDENTIFIED, linewidth=1.0)
    axes.axhline(1e6 * left.white, color=MEASURED, linewidth=1.6)
    axes.axhline(1e6 * left.limit, color=MEASURED, linestyle=(0, (4, 2)), linewidth=1.1)
    low, high = float(left.frequency[0]), float(left.frequency[-1])
    for frequency in model.modes(fit.recording.payload).frequencies:
        if low <= frequency <= high:
            axes.axvline(float(frequency), color=_MODES, linestyle=(0, (1, 1.5)), linewidth=1.3, zorder=1)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(low, high)
    least = min(float(np.quantile(each, 0.02)) for each in drawn)
    axes.set_ylim(0.7e6 * min(least, left.white), 1.5e6 * max(left.limit, *(float(each.max()) for each in drawn)))
    log_ticks(axes.xaxis)
    log_ticks(axes.yaxis)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("amplitude [µm]")
    role = "held out" if fit.recording.role == "holdout" else "train"
    panel_title(axes, f"{short(fit.recording.file, 20)} ({role}): {_peak(model, fit, left)}")


def _peak(model: Model, fit: RecordingComparison, left: Spectrum) -> str:
    at = int(np.argmax(left.amplitude))
    if left.amplitude[at] <= left.limit:
        return "nothing but noise"
    return f"most {_where(model, fit, left)}"


def _where(model: Model, fit: RecordingComparison, left: Spectrum) -> str:
    """The frequency at which most is missing, and the mode that is there."""
    at = int(np.argmax(left.amplitude))
    peak, line = float(left.frequency[at]), float(left.frequency[0])
    if at < _SLOW_LINES:
        return f"below {number(float(left.frequency[_SLOW_LINES]), 2)} Hz (drift)"
    modes = model.modes(fit.recording.payload).frequencies
    nearest = int(np.argmin(np.abs(modes - peak)))
    mode = f" (mode {nearest + 1})" if abs(modes[nearest] - peak) < max(_SAME_MODE * peak, 2 * line) else ""
    return f"at {number(peak, 3)} Hz{mode}"


def _spectrum_title(model: Model, found: Sequence[tuple[RecordingComparison, Spectrum]]) -> str:
    beyond = [(fit, left) for fit, left in found if left.amplitude.max() > left.limit]
    if not beyond:
        return "Spectrum of the residual: no frequency at which the model misses more than noise"
    fit, left = max(beyond, key=lambda pair: float(np.max(pair[1].amplitude / pair[1].white)))
    times = float(f"{left.amplitude.max() / left.white:.2g}")
    return (
        f"Spectrum of the residual: most is missing {_where(model, fit, left)}, in "
        f"{short(fit.recording.file)}: {times:g} times what white noise gives"
    )


_ANNOTATED = 16  # parameters whose correlations can be written into the cells
_MOST = 48
_STRONG = 0.9
_WEAK = 0.5
_LEFT, _CELL, _SQUARE = 2.75, 0.3, 6.25  # inches: room for names, largest height of a row, width of the map
_WIDEST = 0.85  # inches of a column


def correlations(estimates: Sequence[Estimate], covariance: Array) -> tuple[list[str], Array]:
    """Names (p) and correlation matrix (p, p) of the estimates with a finite, positive standard error.

    Args:
        estimates: all of them.
        covariance: of those with a standard error, in their order.
    """
    names = [each.name for each in estimates if each.std is not None]
    if covariance.shape != (len(names), len(names)):
        return [], np.empty((0, 0))
    variance = np.diag(covariance)
    kept = np.flatnonzero(np.isfinite(covariance).all(axis=1) & (variance > 0))
    part, std = covariance[np.ix_(kept, kept)], np.sqrt(variance[kept])
    return [names[k] for k in kept], np.clip(part / np.outer(std, std), -1.0, 1.0)


def correlation_map(estimates: Sequence[Estimate], covariance: Array) -> Figure | None:
    """The estimates' correlation matrix as a map; None where fewer than two parameters have an error.

    Args:
        estimates: all of them.
        covariance: of those with a standard error, in their order.
    """
    names, matrix = correlations(estimates, covariance)
    return _map(names, matrix) if len(names) > 1 else None


@styled
def _map(names: Sequence[str], matrix: Array) -> Figure:
    title = _title(names, matrix)
    count = min(len(names), _MOST)
    matrix = matrix[:count, :count]
    page = sheet(title, [Row(min(_CELL, _SQUARE / count) * count)], left=_LEFT)
    axes = page.axes[0][0]
    colors = colormaps["PuOr_r"]
    box = axes.get_position()
    axes.set_position((box.x0, box.y0, box.width * min(1.0, _WIDEST * count / _SQUARE), box.height))
    axes.set_facecolor(BAND)  # the diagonal
    off = np.ma.masked_where(np.eye(count, dtype=bool), matrix)
    axes.pcolormesh(off, cmap=colors, vmin=-1.0, vmax=1.0, edgecolors="#bbbbbb", linewidth=0.5)
    if count <= _ANNOTATED:
        for (row, column), value in np.ndenumerate(matrix):
            if row != column:
                color = letters_on(colors(0.5 + 0.5 * float(value)))
                axes.text(
                    column + 0.5, row + 0.5, _signed(float(value)), ha="center", va="center", fontsize=8, color=color
                )
    axes.invert_yaxis()
    size = 9.0 if count <= _ANNOTATED else 6.0
    places = np.arange(count) + 0.5
    labels = [printable(f"{short(name, 30)}  {k + 1}") for k, name in enumerate(names[:count])]
    axes.set_yticks(places, labels, fontsize=size)
    axes.set_xticks(places, [str(k + 1) for k in range(count)], fontsize=size)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.set_xlabel("parameter")
    axes.set_ylabel("parameter")
    page.legend(
        [
            Patch(facecolor=colors(0.5 + 0.5 * value), edgecolor="#bbbbbb", label=label)
            for value, label in ((1.0, "+1: rise together"), (0.0, "0: independent"), (-1.0, "−1: one for the other"))
        ]
    )
    return page.figure


def _title(names: Sequence[str], matrix: Array) -> str:
    """The strongest correlation, and what it means."""
    off = np.abs(matrix) - 2 * np.eye(len(names))  # a parameter's correlation with itself is none
    row, column = divmod(int(np.argmax(off)), len(names))
    value = float(matrix[row, column])
    pair = f"{short(names[row], 30)} and {short(names[column], 30)} ({_signed(value)})"
    strong = int(np.count_nonzero(off > _STRONG)) // 2
    if strong > 1:
        return f"{strong} pairs of parameters are correlated beyond {_STRONG}, above all {pair}"
    if abs(value) > _STRONG:
        return f"The recordings hardly tell {pair} apart"
    if abs(value) < _WEAK:
        return f"The recordings tell all parameters apart; most correlated are {pair}"
    return f"Correlation of the estimates: strongest between {pair}"


def _signed(value: float) -> str:
    text = f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")
    return "0.00" if text[1:] == "0.00" else text
