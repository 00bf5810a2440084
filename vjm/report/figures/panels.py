"""Style, page and panels that the figures share: tables, spectra, and the RMS residuals of many recordings."""

from __future__ import annotations

import io
import math
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch
from matplotlib.ticker import AutoLocator, LogLocator, NullLocator
from scipy import stats
from scipy.signal import periodogram

from vjm.records import Array, RecordingComparison, SimulatedRecording
from vjm.report.text import recording_label

FALSE_ALARM = 1e-3  # probability that white noise passes a limit anywhere in one recording


class Color:
    """Colours that stay apart in grey as well; each comes with a line style or a marker of its own."""

    IDENTIFIED = "#0b2f5c"
    NOMINAL = "#b85c00"
    TORQUE = "#66b9dd"
    MEASURED = "#7d7d7d"
    BAND = "#d6d6d6"
    AXIS = "#444444"


SMALLEST = 7.5  # points; 9 pixels where the report shows a figure at its least width
# From dark through white to light, so that signs stay apart in grey as well.
DIVERGING = LinearSegmentedColormap.from_list("diverging", ["#2d004b", "#8073ac", "#f9f9f9", "#fbd9a5", "#e8a13c"])

# Lines and marks of a RecordingComparison's simulations, in the order in which they are drawn.
LINES: dict[str, dict[str, Any]] = {
    "reference": {"color": Color.NOMINAL, "linestyle": (0, (4, 2))},
    "alternative": {"color": Color.TORQUE, "linestyle": (0, (6, 1.5, 1.5, 1.5))},
    "simulated": {"color": Color.IDENTIFIED, "linestyle": "-"},
}
MARKS: dict[str, dict[str, Any]] = {
    "noise": {"color": Color.MEASURED, "marker": "|", "markersize": 15, "markeredgewidth": 2},
    "reference": {"color": Color.NOMINAL, "marker": "s", "markerfacecolor": "white"},
    "alternative": {"color": Color.TORQUE, "marker": "D", "markersize": 7},
    "simulated": {"color": Color.IDENTIFIED, "marker": "o"},
}


@contextmanager
def _style() -> Iterator[None]:
    with mpl.style.context(["default", "vjm.report.figures.vjm"]), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # characters that the font lacks are shown as boxes
        yield


@dataclass(frozen=True)
class Picture:
    """A figure of a report."""

    name: str  # of its file, without suffix
    caption: str  # one sentence on how to read it
    draw: Callable[[], Figure]

    @cached_property
    def figure(self) -> Figure:
        """The figure, in vjm's style."""
        with _style():
            return self.draw()

    @property
    def alternative(self) -> str:
        """The title, for those who cannot see the figure."""
        return self.figure.texts[0].get_text().replace("\n", " ")

    @cached_property
    def png(self) -> bytes:
        """The PNG file, the same bytes for the same figure."""
        stream = io.BytesIO()
        with _style():
            self.figure.savefig(stream, format="png", metadata={"Software": "vjm"})
        return stream.getvalue()


@dataclass(frozen=True)
class PanelFigure:
    """A figure with a title, a legend and rows of panels, laid out by matplotlib's constrained layout."""

    figure: Figure
    axes: list[list[Axes]]  # row by row from the top

    @classmethod
    def of(cls, title: str, rows: Sequence[tuple[float, int]]) -> PanelFigure:
        """Make an empty page under a sentence; each row has a height with labels [inches] and a number of panels."""
        lines = textwrap.wrap(title, 98)  # so many characters of the title's size fit across the page
        height = 0.42 + 0.18 * len(lines) + sum(size for size, _ in rows)  # title and legend stand above the rows
        figure = Figure(figsize=(9.2, height), layout="constrained")
        figure.suptitle("\n".join(lines), x=0.011, ha="left", wrap=True)
        columns = math.lcm(*(count for _, count in rows))
        mosaic = [[f"{r}.{c * count // columns}" for c in range(columns)] for r, (_, count) in enumerate(rows)]
        # The panels are a subfigure, so that its legend stands between them and the title.
        body: SubFigure = figure.subfigures(1, 1)  # type: ignore[assignment]
        panels = body.subplot_mosaic(mosaic, height_ratios=[size for size, _ in rows])  # type: ignore[arg-type]
        return cls(figure, [[panels[f"{r}.{k}"] for k in range(count)] for r, (_, count) in enumerate(rows)])

    @classmethod
    def grid(cls, title: str, count: int, heights: tuple[float, float], columns: int = 2) -> PanelFigure:
        """Make a page of so many panels in one row; the heights are those of a single row and of one of several."""
        columns = min(columns, count)
        rows = math.ceil(count / columns)
        page = cls.of(title, [(heights[rows > 1], columns)] * rows)
        all_axes = [axes for row in page.axes for axes in row]
        for unused in all_axes[count:]:
            unused.remove()
        return cls(page.figure, [all_axes[:count]])

    def finish(self, areas: Mapping[str, Any] | None = None) -> Figure:
        """Return the figure, laid out, with one legend above the panels.

        The legend explains the colours of `areas`, by label; without any, all labelled lines and areas of the panels.
        """
        labelled: dict[str, Artist] = {}
        for axes in self.figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                labelled.setdefault(label, handle)
        patches = [Patch(facecolor=color, edgecolor="#bbbbbb", label=label) for label, color in (areas or {}).items()]
        is_area = {handle: isinstance(handle, (Patch, Collection)) for handle in labelled.values()}
        shown: list[Artist] = [*patches] or sorted(is_area, key=is_area.__getitem__)
        self.figure.subfigs[0].legend(handles=shown, loc="outside upper left", ncols=min(6, len(shown)))
        engine = self.figure.get_layout_engine()
        assert engine is not None
        # As many ticks as the panels have room for: where their number followed the layout, and the layout the width of
        # their labels, the two need not settle.
        room = self._set_ticks()
        engine.execute(self.figure)
        if self._set_ticks() != room:
            engine.execute(self.figure)
        self.figure.set_layout_engine(None)  # with an engine, saving would draw everything twice
        return self.figure

    def _set_ticks(self) -> list[int]:
        """Set the numbers of ticks, where these are free, to those that the panels have room for, and return them."""
        room = []
        for axes in self.figure.axes:
            for axis in (axes.xaxis, axes.yaxis):
                if isinstance(locator := axis.get_major_locator(), AutoLocator):
                    room.append(max(1, min(axis.get_tick_space(), 9)))
                    locator.set_params(nbins=room[-1])
        return room


def log_axis(axis: Axis, low: float, high: float) -> None:
    """Make an axis logarithmic between two limits, with its ticks in plain numbers."""
    name = axis.axis_name  # type: ignore[attr-defined]
    axis.axes.set(**{f"{name}scale": "log", f"{name}lim": (low, high)})
    steps = (1.0,) if high > 300 * low else (1.0, 3.0) if high > 30 * low else (1.0, 2.0, 3.0, 5.0)
    axis.set_major_locator(LogLocator(subs=steps, numticks=12))
    axis.set_major_formatter("{x:.4g}")
    axis.set_minor_locator(NullLocator())


def heatmap(
    axes: Axes, table: Array, shades: tuple[Colormap, Normalize], names: tuple[Sequence[str], Sequence[str]],
    text: Callable[[float], str] | None, fontsize: float, levels: Array | None = None,
) -> None:  # fmt: skip
    """Draw a table (R, C) as coloured cells, the first row at the top; cells that are NaN are grey and empty.

    `names` are those of the rows and of the columns; `text`, if any, is written into the cells. Colours are those of
    `levels` (R, C), or of the table itself.
    """
    (colors, norm), levels = shades, table if levels is None else levels
    axes.set_facecolor(Color.BAND)
    axes.pcolormesh(np.ma.masked_invalid(levels), cmap=colors, norm=norm, edgecolors="#bbbbbb", linewidth=0.6)
    for (row, column), value in np.ndenumerate(table):
        if text is not None and np.isfinite(value):
            luma = float(np.dot(colors(norm(levels[row, column]))[:3], (0.3, 0.59, 0.11)))
            look: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": fontsize, "in_layout": False}
            axes.text(column + 0.5, row + 0.5, text(value), color="#222222" if luma > 0.55 else "white", **look)
    axes.invert_yaxis()
    axes.set_yticks(np.arange(len(table)) + 0.5, names[0], fontsize=fontsize)
    axes.set_xticks(np.arange(table.shape[1]) + 0.5, names[1], fontsize=fontsize)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)


def binned_means(x: Array, values: Array, most: int, std: Array | float = np.inf) -> tuple[Array, Array, Array]:
    """Return abscissae, means and their standard errors of values (N,) over bins of x (N,) of about as many of them.

    Args:
        x: where they are whole numbers, each has a bin of its own.
        values: with independent errors.
        most: number of bins at most.
        std: standard errors of the values, by which they are weighted; infinite: not known.
    """
    numbers, bins = np.unique(x, return_inverse=True)
    if np.any(numbers != np.round(numbers)):
        bins[np.argsort(x)] = np.arange(x.size) * max(most, 1) // x.size
    weights = np.where(np.isfinite(std), np.broadcast_to(std, x.shape) ** -2.0, 1.0)
    sizes, total = np.bincount(bins), np.bincount(bins, weights)
    centres, means = (np.bincount(bins, weights * quantity) / total for quantity in (x, values))
    scatter = np.bincount(bins, weights * (values - means[bins]) ** 2) / total / np.maximum(sizes - 1, 1)
    known = np.where(np.isfinite(std).any(), 1 / total, 0.0)  # variance that the given errors leave at least
    return centres, means, np.sqrt(np.maximum(scatter, known))


@dataclass(frozen=True)
class Spectrum:
    """Amplitude of a residual, RMS over all coordinates; a sine of amplitude a is a line of height a."""

    frequency: Array  # (F,) from one period in the recording up to half the sensor's rate [Hz]
    amplitude: Array  # (F,) [m], or [rad] of encoders
    white: float  # what white noise of the sensor's size would give
    limit: float  # what it would pass anywhere in one recording of a thousand

    @classmethod
    def of(cls, simulated: SimulatedRecording, encoder: bool = False) -> Spectrum | None:
        """Return the spectrum of the markers', or the encoders', residuals; None where too little was measured.

        Values that were not measured count as zeros, and amplitudes are scaled by the number of those that were.
        """
        residual = simulated.theta_residual if encoder else simulated.marker_residual
        residual, least_values = residual.reshape(len(residual), -1), 8
        rows = np.flatnonzero(np.isfinite(residual).any(axis=1))
        counts = np.isfinite(residual).sum(axis=0)
        usable = counts >= least_values
        if not usable.any():
            return None
        time = simulated.recording.time[rows]
        step = float(np.median(np.diff(time)))
        place = np.round((time - time[0]) / step).astype(int)  # frames that the camera dropped leave gaps
        even = np.zeros((int(place[-1]) + 1, int(usable.sum())))
        even[place] = np.nan_to_num(residual[np.ix_(rows, usable)])
        even *= len(even) / counts[usable]
        frequency, powers = periodogram(even, 1 / step, detrend=False, scaling="spectrum", axis=0)
        power: Array = 2 * powers[1:-1].mean(axis=1)  # a sine of amplitude a has the power a^2 / 2
        # The mean of c squared magnitudes of white noise is chi-squared with 2 c degrees of freedom.
        white = simulated.noise[encoder] ** 2 * float(np.mean(4 / counts[usable]))
        freedom = 2 * int(usable.sum())
        limit = white * float(stats.chi2.isf(FALSE_ALARM / power.size, freedom)) / freedom
        return cls(frequency[1:-1], np.sqrt(power), float(np.sqrt(white)), float(np.sqrt(limit)))

    @staticmethod
    def draw(
        axes: Axes, spectra: Sequence[tuple[Spectrum, str, str]], modes: Array | Sequence[float] = (), unit: str = "µm"
    ) -> None:
        """Draw residual spectra of one recording, with labels and colours, and the white noise of the last one.

        `modes` are frequencies to mark [Hz]; `unit` is that of a millionth of an amplitude.
        """
        for spectrum, label, color in spectra:
            axes.plot(
                spectrum.frequency, 1e6 * spectrum.amplitude, color=color, linestyle="-", linewidth=1.0, label=label
            )
        last = spectra[-1][0]
        axes.axhline(1e6 * last.white, color=Color.MEASURED, linewidth=1.6, label="white noise")
        dashed: dict[str, Any] = {"color": Color.MEASURED, "linestyle": (0, (4, 2)), "linewidth": 1.1}
        axes.axhline(1e6 * last.limit, label="limit of noise (99.9 %)", **dashed)
        low, high = float(last.frequency[0]), float(last.frequency[-1])
        look: dict[str, Any] = {"color": "#a03060", "linestyle": (0, (1, 1.5)), "zorder": 1}
        for frequency in modes:
            if low <= frequency <= high:
                axes.axvline(float(frequency), label="natural frequency of the model", **look)
        smallest = min(last.white, *(float(np.quantile(spectrum.amplitude, 0.02)) for spectrum, *_ in spectra))
        largest = max(last.limit, *(float(spectrum.amplitude.max()) for spectrum, *_ in spectra))
        log_axis(axes.xaxis, low, high)
        log_axis(axes.yaxis, 0.7e6 * smallest, 1.5e6 * largest)
        axes.set(xlabel="frequency [Hz]", ylabel=f"amplitude [{unit}]")


def draw_marks(
    axes: Axes, names: Sequence[str], marks: Sequence[tuple[str, Array, Array | None, Mapping[str, Any]]],
    apart: float = 0.0,
) -> None:  # fmt: skip
    """Draw marks in a row for each of R names, from the top.

    Each kind of mark has a label, values (R,), their errors (R,) if known, and a look; those of a row stand `apart`
    rows below each other.
    """
    places = np.arange(len(names))
    for k, (label, values, errors, look) in enumerate(marks):
        rows = places + apart * (k - (len(marks) - 1) / 2)
        if np.isfinite(values).any():
            axes.errorbar(values, rows, xerr=errors, linestyle="", label=label, **look)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_yticks(places, names)
    axes.grid(False, axis="y")


def rms_figure(
    title: str, comparisons: Sequence[RecordingComparison], labels: Mapping[str, str], in_noise: bool
) -> Figure:
    """Draw each recording's RMS marker residual by several models in units of the noise, or else in millimetres."""
    page = PanelFigure.of(title, [(0.7 + 0.28 * max(len(comparisons), 2), 1)])
    axes, noise = page.axes[0][0], np.array([comparison.noise[0] for comparison in comparisons])
    units = noise if in_noise else np.full(noise.shape, 1e-3)
    marks, names = [("noise", noise / units, None, MARKS["noise"])], []
    for role in [role for role in LINES if role in labels]:
        simulations = [getattr(comparison, role) for comparison in comparisons]
        rms = np.array([np.nan if simulation is None else simulation.marker_rms for simulation in simulations]) / units
        marks.append((labels[role], rms, None, MARKS[role]))
    all_values = np.stack([values for _, values, *_ in marks])
    for comparison, known in zip(comparisons, np.isfinite(all_values[1:]).any(axis=0), strict=True):
        label = recording_label(comparison.recording, 24)
        names.append(label if known else f"{label[:-1]}, not simulated)")
    axes.hlines(
        range(len(names)), np.fmin.reduce(all_values[1:]), np.fmax.reduce(all_values[1:]), color="#bbbbbb", zorder=1
    )
    draw_marks(axes, names, marks)
    log_axis(axes.xaxis, np.nanmin(all_values) / 1.15, np.nanmax(all_values) * 1.15)
    unit_name = "× noise" if in_noise else "mm"
    axes.set(xlabel=f"RMS residual of all markers, open loop [{unit_name}]", ylabel="recording")
    return page.finish()
