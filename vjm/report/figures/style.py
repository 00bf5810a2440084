"""The look all figures share: sheets of axes at fixed places, colours that stay apart in grey, PNG."""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any, ParamSpec

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

Dashes = tuple[float, tuple[float, ...]]
Look = tuple[str, Dashes]

# Dark, middle and light: apart in grey as well; the torque method has marks or dashes of its own beside them.
IDENTIFIED = "#0b2f5c"
NOMINAL = "#e07b00"
TORQUE = "#4aa3c7"
MEASURED = "#7d7d7d"
BAND = "#d6d6d6"
NOMINAL_STYLE: Dashes = (0, (4, 2))
_LINE_STYLES: tuple[Dashes, ...] = ((0, ()), (0, (5, 1.5)), (0, (1, 1)), (0, (6, 1.5, 1, 1.5)))

_LIGHT = 0.55  # of white
_DPI = 120
_WIDTH = 9.2  # inches, as all lengths of the page below
_LEFT, _RIGHT, _BOTTOM = 0.85, 0.2, 0.52
_TITLE_LINE, _LEGEND_LINE, _TOP = 0.22, 0.27, 0.37
_ROW_GAP, _COLUMN_GAP = 0.28, 0.85
_TITLE_WIDTH = 101  # characters
_SETTINGS: Any = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#444444",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-4, 5),
    "axes.unicode_minus": True,
    "axes.xmargin": 0.01,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.6,
    "text.usetex": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "path.simplify": True,
}
_P = ParamSpec("_P")


def styled(draw: Callable[_P, Figure]) -> Callable[_P, Figure]:
    """A drawing function that draws in vjm's style, whatever the user's own settings of matplotlib are."""

    @wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> Figure:
        with mpl.rc_context(_SETTINGS):
            return draw(*args, **kwargs)

    return drawn


def png(figure: Figure) -> bytes:
    """The figure as a PNG file, the same bytes for the same picture."""
    stream = io.BytesIO()
    with mpl.rc_context(_SETTINGS):
        figure.savefig(stream, format="png", dpi=_DPI, metadata={"Software": None})
    return stream.getvalue()


@dataclass(frozen=True)
class Row:
    """One row of axes on a sheet.

    Attributes:
        height: of its axes [inches].
        columns: number of axes in the row.
        gap: room above it [inches].
    """

    height: float
    columns: int = 1
    gap: float = _ROW_GAP


@dataclass(frozen=True)
class Sheet:
    """A figure with axes at fixed places.

    Attributes:
        figure: the whole.
        axes: row by row, from the top.
        legend_top: where the legend begins, as a fraction of the height.
    """

    figure: Figure
    axes: list[list[Axes]]
    legend_top: float

    def legend(self, handles: Sequence[Artist], columns: int = 6) -> None:
        """One legend for the whole sheet, between title and axes; the labels are the handles' own."""
        self.figure.legend(
            handles=list(handles),
            loc="upper left",
            bbox_to_anchor=(0.1 / _WIDTH, self.legend_top),
            ncols=min(columns, len(handles)),
            borderaxespad=0.0,
            borderpad=0.0,
            columnspacing=1.8,
        )


def sheet(title: str, rows: Sequence[Row], left: float = _LEFT, bottom: float = _BOTTOM) -> Sheet:
    """A sheet of axes; their places are computed beforehand, so nothing overlaps and nothing has to be tried.

    Args:
        title: what the picture shows, in a sentence; wrapped.
        rows: from the top.
        left: room for labels [inches].
        bottom: room for labels [inches].
    """
    lines = textwrap.wrap(printable(title), _TITLE_WIDTH)
    top = _TOP + _TITLE_LINE * len(lines) + _LEGEND_LINE
    height = top + sum(row.height + row.gap for row in rows) - rows[0].gap + bottom
    figure = Figure(figsize=(_WIDTH, height))
    figure.text(0.1 / _WIDTH, 1 - 0.12 / height, "\n".join(lines), va="top", fontsize=11, fontweight="bold")
    axes: list[list[Axes]] = []
    y = height - top + rows[0].gap
    for row in rows:
        y -= row.height + row.gap
        width = (_WIDTH - left - _RIGHT - _COLUMN_GAP * (row.columns - 1)) / row.columns
        places = [left + (width + _COLUMN_GAP) * column for column in range(row.columns)]
        axes.append([figure.add_axes((x / _WIDTH, y / height, width / _WIDTH, row.height / height)) for x in places])
    return Sheet(figure, axes, 1 - (0.2 + _TITLE_LINE * len(lines)) / height)


def panel_title(axes: Axes, text: str) -> None:
    """A small heading above one panel."""
    axes.set_title(printable(text), loc="left", color="#333333", pad=4)


def series(count: int) -> list[Look]:
    """So many looks that differ in darkness and in line style."""
    colors = mpl.colormaps["viridis"](np.linspace(0.0, 0.8, max(count, 1)))
    return [(to_hex(color), _LINE_STYLES[i % len(_LINE_STYLES)]) for i, color in enumerate(colors[:count])]


def letters_on(color: tuple[float, float, float, float]) -> str:
    """Colour of letters that are read on a ground of this colour (red, green, blue, opacity, each up to 1)."""
    red, green, blue, _ = color
    return "#222222" if 0.3 * red + 0.59 * green + 0.11 * blue > _LIGHT else "white"


def log_ticks(axis: Axis) -> None:
    """Labels in plain numbers on a logarithmic axis whose limits are set."""
    low, high = sorted(axis.get_view_interval())
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    steps = (1.0,) if high > 300 * low else (1.0, 3.0) if high > 30 * low else (1.0, 2.0, 3.0, 5.0)
    ticks = [step * 10.0**decade for decade in decades for step in steps if low <= step * 10.0**decade <= high]
    if len(ticks) < 3:
        ticks = [tick for tick in MaxNLocator(4).tick_values(low, high) if low <= tick <= high]
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.4g}"))
    axis.set_minor_locator(NullLocator())


def printable(text: str) -> str:
    """Text that matplotlib prints as it is: no mathematics, no characters that the font lacks."""
    known = _characters()
    return "".join(c if ord(c) in known or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in text).replace("$", r"\$")


@cache
def _characters() -> frozenset[int]:
    return frozenset(get_font(findfont(FontProperties(family=["DejaVu Sans"]))).get_charmap())


@dataclass(frozen=True)
class Picture:
    """A drawn figure.

    Attributes:
        name: of its file, without suffix.
        caption: one sentence on how to read it.
        alternative: what it shows, for those who cannot see it.
        png: the file.
    """

    name: str
    caption: str
    alternative: str
    png: bytes
