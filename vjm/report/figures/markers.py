"""Raw markers of the recordings (the paper's Fig. 8)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vjm.experiment.records import Recording, Rig
from vjm.report.choose import liveliest_window, tip_signal
from vjm.report.figures.style import Row, panel_title, series, sheet, styled
from vjm.report.wording import counted, short

MOST_PANELS = 8
_MOST_MARKERS = 6
_MOST_LINKS = 3
_MOST_DOTS = 40  # frames in a panel that are drawn as dots too


def most_recordings(rig: Rig) -> int:
    """How many recordings fit in the picture: several links take a panel each."""
    return MOST_PANELS // min(len(rig.links), _MOST_LINKS)


@styled
def raw_markers(rig: Rig, recordings: Sequence[Recording]) -> Figure:
    """Measured marker coordinates against time, as they stand in the files; y, or x where that moves clearly more.

    Args:
        rig: the arm.
        recordings: to be drawn, at least one; a row of panels each where there are several links.
    """
    links = list(range(len(rig.links)))[:_MOST_LINKS]
    panels = [(recording, link) for recording in recordings for link in links]
    columns = len(links) if len(links) > 1 else min(2, len(panels))
    rows = -(-len(panels) // columns)
    total = sum(len(link.markers) for link in rig.links)
    title = f"Markers as measured: {counted(len(recordings), 'recording')}, {counted(total, 'marker')}"
    page = sheet(title, [Row(1.45 if rows > 1 else 2.3, columns, gap=0.62)] * rows)
    axes = [each for row in page.axes for each in row]
    for unused in axes[len(panels) :]:
        unused.remove()
    for each, (recording, link) in zip(axes, panels, strict=False):
        _draw(each, rig, recording, link)
    most = max((_shown(rig, link) for link in links), key=len)
    page.legend(
        [
            Line2D([], [], color=color, linestyle=style, label=f"marker {number + 1}")
            for number, (color, style) in zip(most, series(len(most)), strict=True)
        ]
    )
    return page.figure


def _shown(rig: Rig, link: int) -> list[int]:
    """Numbers (from 0) of the link's markers that are drawn: all of a few, else some from base to tip."""
    count = len(rig.links[link].markers)
    numbers: list[int] = np.unique(np.linspace(0, count - 1, min(count, _MOST_MARKERS)).round().astype(int)).tolist()
    return numbers


def _draw(axes: Axes, rig: Rig, recording: Recording, link: int) -> None:
    start, stop = _window(rig, recording)
    rows = recording.frames
    rows = rows[(recording.time[rows] >= start) & (recording.time[rows] <= stop)]
    own = 1e3 * recording.markers[rows][:, rig.marker_slices[link]]
    axis = _axis(own)
    numbers = _shown(rig, link)
    dots = "." if rows.size <= _MOST_DOTS else "none"
    for number, (color, style) in zip(numbers, series(len(numbers)), strict=True):
        # A marker lost for a moment leaves a gap in its line.
        axes.plot(
            recording.time[rows],
            own[:, number, axis],
            marker=dots,
            markersize=4,
            color=color,
            linestyle=style,
            linewidth=1.1,
        )
    axes.set_ylabel(f"{'xy'[axis]} [mm]")
    axes.set_xlabel("time [s]")
    panel_title(axes, _heading(rig, recording, link, stop - start))


def _window(rig: Rig, recording: Recording) -> tuple[float, float]:
    tip = tip_signal(rig, recording)
    if tip is None or recording.kind in ("quiet", "static"):
        return float(recording.time[0]), float(recording.time[-1])
    return liveliest_window(tip.time, tip.value)


def _axis(markers: NDArray[np.float64]) -> int:
    """0 where the markers (F, k, 2) move clearly more along x, or were measured along x alone."""
    travel = [-1.0, -1.0]
    for axis in (0, 1):
        values = markers[..., axis]
        measured = values[:, np.isfinite(values).any(axis=0)]
        if measured.size:
            travel[axis] = float(np.max(np.nanmax(measured, axis=0) - np.nanmin(measured, axis=0)))
    return 0 if travel[0] > 1.5 * max(travel[1], 0.0) else 1


def _heading(rig: Rig, recording: Recording, link: int, length: float) -> str:
    role = "train" if recording.role == "train" else "held out"
    duration = float(recording.time[-1] - recording.time[0])
    part = "" if length > 0.99 * duration else f", {length:.2g} s of {duration:.3g} s"
    if len(rig.links) == 1:
        return f"{short(recording.file)} ({recording.kind}, {role}{part})"
    frame = f"{short(rig.links[link].name, 16)}, {rig.links[link].markers_frame} frame"
    return f"{short(recording.file, 22)} ({role}{part}): {frame}"
