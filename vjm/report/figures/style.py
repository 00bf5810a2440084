"""The style that all figures share: matplotlib settings, colours that stay apart in grey, layout, and the PNG file."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, wraps
from typing import Any, ParamSpec

import matplotlib as mpl
import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.colors import Colormap, Normalize, to_hex
from matplotlib.figure import Figure, SubFigure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from vjm.records import Array

# Dark, middle and light: apart in grey as well, and each with a line style or a marker of its own.
IDENTIFIED = "#0b2f5c"
NOMINAL = "#e07b00"
TORQUE = "#4aa3c7"
MEASURED = "#7d7d7d"
BAND = "#d6d6d6"
AXIS = "#444444"

_SETTINGS: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlepad": 4,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": AXIS,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-4, 5),
    "axes.xmargin": 0.01,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.6,
    "legend.columnspacing": 1.8,
    "legend.borderpad": 0.0,
    "figure.titlesize": 11,
    "figure.titleweight": "bold",
    "figure.constrained_layout.h_pad": 0.07,
    "figure.constrained_layout.w_pad": 0.09,
    "savefig.dpi": 120,
}
_P = ParamSpec("_P")


@dataclass(frozen=True)
class Picture:
    """A figure of a report.

    Attributes:
        name: of its file, without suffix.
        caption: one sentence on how to read it.
        figure: as drawn.
    """

    name: str
    caption: str
    figure: Figure

    @property
    def alternative(self) -> str:
        """The title, for those who cannot see the figure."""
        return self.figure.texts[0].get_text().replace("\n", " ").replace(r"\$", "$")

    @cached_property
    def png(self) -> bytes:
        """The PNG file, the same bytes for the same figure."""
        stream = io.BytesIO()
        with mpl.style.context(["default", _SETTINGS]):
            self.figure.savefig(stream, format="png", metadata={"Software": None})
        return stream.getvalue()


def styled(draw: Callable[_P, Figure]) -> Callable[_P, Figure]:
    """Return a drawing function that draws in vjm's style, whatever the user's own settings of matplotlib are."""

    @wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> Figure:
        with mpl.style.context(["default", _SETTINGS]):
            return draw(*args, **kwargs)

    return drawn


@dataclass(frozen=True)
class Page:
    """A figure with a title, a legend and rows of panels, laid out by matplotlib's constrained layout.

    Attributes:
        figure: the whole.
        axes: of the panels, row by row from the top.
    """

    figure: Figure
    axes: list[list[Axes]]

    @classmethod
    def of(cls, title: str, rows: Sequence[tuple[float, int]]) -> Page:
        """Make an empty page under a sentence; each row has a height with labels [inches] and a number of panels."""
        lines = textwrap.wrap(printable(title), 98)  # so many characters of the title's size fit across the page
        height = 0.42 + 0.18 * len(lines) + sum(size for size, _ in rows)  # title and legend stand above the rows
        figure = Figure(figsize=(9.2, height), layout="constrained")
        figure.suptitle("\n".join(lines), x=0.011, ha="left", wrap=True)
        columns = math.lcm(*(count for _, count in rows))
        mosaic = [[f"{r}.{c * count // columns}" for c in range(columns)] for r, (_, count) in enumerate(rows)]
        # The panels are a subfigure, so that its legend stands between them and the title.
        body: SubFigure = figure.subfigures(1, 1)  # type: ignore[assignment]
        panels = body.subplot_mosaic(mosaic, height_ratios=[size for size, _ in rows])  # type: ignore[arg-type]
        return cls(figure, [[panels[f"{r}.{k}"] for k in range(count)] for r, (_, count) in enumerate(rows)])

    def panels(self, count: int) -> list[Axes]:
        """Return the first panels, and remove the others from the page."""
        every = [axes for row in self.axes for axes in row]
        for unused in every[count:]:
            unused.remove()
        return every[:count]

    def legend(self, handles: Sequence[Artist] = (), columns: int = 6) -> None:
        """Add one legend between title and panels, of labelled handles or of all labels in the panels, areas last."""
        labelled: dict[str, Artist] = {}
        for axes in self.figure.axes:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                labelled.setdefault(label, handle)
        areas = [handle for handle in labelled.values() if isinstance(handle, (Patch, Collection))]
        lines = [handle for handle in labelled.values() if handle not in areas]
        shown = [*(handles or [*lines, *areas])]
        self.figure.subfigs[0].legend(handles=shown, loc="outside upper left", ncols=min(columns, len(shown)))


def line_styles(count: int) -> list[dict[str, Any]]:
    """Return `color` and `linestyle` of lines that differ in darkness and in dashes."""
    dashes = ("-", (0, (5, 1.5)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)))
    colors = mpl.colormaps["viridis"](np.linspace(0.0, 0.8, max(count, 1)))[:count]
    return [{"color": to_hex(color), "linestyle": dashes[i % len(dashes)]} for i, color in enumerate(colors)]


def readable_on(color: tuple[float, float, float, float]) -> str:
    """Return the colour of letters on a ground of a colour (red, green, blue, opacity, each up to 1), by its luma."""
    red, green, blue, _ = color
    return "#222222" if 0.3 * red + 0.59 * green + 0.11 * blue > 0.55 else "white"


def heat_map(
    axes: Axes, table: Array, shades: tuple[Colormap, Normalize], names: tuple[Sequence[str], Sequence[str]],
    text: Callable[[float], str] | None, fontsize: float = 8.5,
) -> None:  # fmt: skip
    """Draw a table (R, C) as coloured cells, the first row at the top; cells that are NaN are grey and empty.

    `names` are those of the rows and of the columns; `text`, if any, is written into the cells.
    """
    colors, norm = shades
    axes.set_facecolor(BAND)
    axes.pcolormesh(np.ma.masked_invalid(table), cmap=colors, norm=norm, edgecolors="#bbbbbb", linewidth=0.6)
    for (row, column), value in np.ndenumerate(table):
        if text is not None and np.isfinite(value):
            look: Any = {"ha": "center", "va": "center", "fontsize": fontsize, "in_layout": False}
            axes.text(column + 0.5, row + 0.5, text(value), color=readable_on(colors(norm(value))), **look)
    axes.invert_yaxis()
    axes.set_yticks(np.arange(len(table)) + 0.5, [printable(name) for name in names[0]], fontsize=fontsize)
    axes.set_xticks(np.arange(table.shape[1]) + 0.5, [printable(name) for name in names[1]], fontsize=fontsize)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)


def log_scale(axis: Axis, low: float, high: float) -> None:
    """Make an axis logarithmic between two limits, with its ticks in plain numbers."""
    name = axis.axis_name  # type: ignore[attr-defined]
    axis.axes.set(**{f"{name}scale": "log", f"{name}lim": (low, high)})
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1.0,) if high > 300 * low else (1.0, 3.0) if high > 30 * low else (1.0, 2.0, 3.0, 5.0)
    ticks = [step * 10.0**decade for decade in decades for step in steps if low <= step * 10.0**decade <= high]
    if len(ticks) < 3:
        ticks = [tick for tick in MaxNLocator(4).tick_values(low, high) if low <= tick <= high]
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
    axis.set_minor_locator(NullLocator())


def printable(text: str) -> str:
    """Return text that matplotlib prints as it is: no mathematics, no characters that the font lacks."""
    known = _characters()
    return "".join(c if ord(c) in known or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text).replace("$", r"\$")


@cache
def _characters() -> frozenset[int]:
    return frozenset(get_font(findfont(FontProperties(family=["DejaVu Sans"]))).get_charmap())
