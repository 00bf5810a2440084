"""Which estimated parameters the recordings can tell apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from vjm.parameters import Estimate
from vjm.report.figures.style import BAND, Row, letters_on, printable, sheet, styled
from vjm.report.wording import short

Array = NDArray[np.float64]

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
