"""Shape function, virtual links and joints at several instants, with the markers (the paper's Fig. 9)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vjm.chain.curve import link_poses, rotate
from vjm.chain.records import Chain, LinkChain
from vjm.experiment.records import Rig
from vjm.identification.records import TorqueData
from vjm.report.choose import period
from vjm.report.figures.style import MEASURED, Row, panel_title, series, sheet, styled
from vjm.report.wording import millimetres, short

Array = NDArray[np.float64]

_INSTANTS = 5
_POINTS = 80  # along the drawn curve
_PERIODS = 4  # the instants are chosen within so many periods from the largest deflection on
_GAP = 0.62  # inches between rows
_LINKS: dict[str, Any] = {"linewidth": 0.9, "linestyle": (0, (4, 2))}
_JOINTS: dict[str, Any] = {"marker": "s", "markersize": 4, "markerfacecolor": "white"}
_MARKERS: dict[str, Any] = {
    "linestyle": "",
    "marker": "o",
    "markersize": 4.5,
    "markeredgecolor": "black",
    "markeredgewidth": 0.6,
}


@styled
def link_shapes(rig: Rig, chain: Chain, recordings: Sequence[TorqueData]) -> Figure:
    """Each link in its own frame at five instants; lateral deflection magnified.

    Args:
        rig: the arm.
        chain: its virtual links and joints.
        recordings: one or two, a column of panels each.
    """
    page = sheet(_title(rig, recordings), [Row(2.5, len(recordings), _GAP)] * len(rig.links))
    for i, row in enumerate(page.axes):
        for axes, data in zip(row, recordings, strict=True):
            _draw_link(axes, rig, chain, data, i)
    page.legend(
        [
            Line2D([], [], color=MEASURED, label="measured markers", **_MARKERS),
            Line2D([], [], color="#444444", linewidth=2.2, alpha=0.6, label="shape function"),
            Line2D([], [], color="#444444", label="virtual links and joints", **_LINKS, **_JOINTS),
        ]
    )
    return page.figure


def _title(rig: Rig, recordings: Sequence[TorqueData]) -> str:
    residuals = np.concatenate([fit.residuals.ravel() for data in recordings for fit in data.angles.shapes])
    known = residuals[np.isfinite(residuals)]
    rms = float(np.sqrt(np.mean(known**2))) if known.size else 0.0
    if all(fit.order == fit.residuals.shape[1] for fit in recordings[0].angles.shapes):
        return "Shape of the link: as many functions as markers, so the curve passes through them and is not tested"
    where = "the link" if len(rig.links) == 1 else "all links"
    return f"Shape functions pass the markers of {where} within {millimetres(rms)} RMS"


def _draw_link(axes: Axes, rig: Rig, chain: Chain, data: TorqueData, i: int) -> None:
    frames = _instants(data, i)
    markers = _link_frame_markers(rig, chain, data, i)
    for frame, (color, _) in zip(frames, series(len(frames)), strict=True):
        x, y = _curve(data, i, int(frame))
        axes.plot(x, 1e3 * y, color=color, linewidth=2.2, alpha=0.6)
        corners = _virtual_links(chain.links[i], data.angles.q[frame, chain.passive_slices[i]])
        axes.plot(corners[:, 0], 1e3 * corners[:, 1], color=color, **_LINKS)
        axes.plot(corners[1:-1, 0], 1e3 * corners[1:-1, 1], color=color, linestyle="", **_JOINTS)
        axes.plot(markers[frame, :, 0], 1e3 * markers[frame, :, 1], color=color, **_MARKERS)
        label, tip = f"{data.angles.time[frame]:.2f} s", (x[-1], 1e3 * y[-1])
        axes.annotate(label, tip, xytext=(5, 0), textcoords="offset points", va="center", fontsize=7.5)
    axes.set_xlim(-0.02 * chain.links[i].length, 1.14 * chain.links[i].length)
    axes.set_xlabel(f"along {rig.links[i].name} [m]")
    axes.set_ylabel("lateral [mm]")
    panel_title(axes, short(data.recording.file))


def _instants(data: TorqueData, i: int) -> NDArray[np.intp]:
    """Frames from one extreme of the tip's deflection to the other, within a few periods of the largest."""
    fit, time = data.angles.shapes[i], data.angles.time
    deflection = fit.evaluate(np.array([fit.length]))[:, 0]
    complete = np.flatnonzero(np.isfinite(data.angles.q).all(axis=1) & np.isfinite(deflection))
    if complete.size <= _INSTANTS:
        return complete
    cycle = period(time[complete], deflection[complete])
    length = float(time[-1] - time[0]) if cycle is None else _PERIODS * cycle
    start = time[complete[np.argmax(np.abs(deflection[complete]))]]
    start = min(float(start), float(time[complete[-1]]) - length)
    near = complete[(time[complete] >= start) & (time[complete] <= start + length)]
    near = near if near.size >= _INSTANTS else complete
    levels = np.linspace(deflection[near].min(), deflection[near].max(), _INSTANTS)
    closest = [int(near[np.argmin(np.abs(deflection[near] - level))]) for level in levels]
    return np.unique(closest)


def _curve(data: TorqueData, i: int, frame: int) -> tuple[Array, Array]:
    """The shape function over arc length as points (x, y) [m]."""
    fit = data.angles.shapes[i]
    arcs = np.linspace(0.0, fit.length, _POINTS)
    slope = fit.evaluate(arcs, 1)[frame]
    cosine = np.sqrt(np.clip(1 - slope**2, 0.0, 1.0))
    x = np.r_[0.0, np.cumsum((cosine[1:] + cosine[:-1]) / 2 * np.diff(arcs))]
    return x, fit.evaluate(arcs)[frame]


def _virtual_links(link: LinkChain, phi: Array) -> Array:
    """(n + 2, 2) ends of the virtual links in the link frame [m]."""
    headings = np.r_[0.0, np.cumsum(phi)]
    steps = link.lengths[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def _link_frame_markers(rig: Rig, chain: Chain, data: TorqueData, i: int) -> Array:
    """(F, k_i, 2) measured markers of link i in its own frame [m]; a missing x is the marker's arc length."""
    recording, link = data.recording, rig.links[i]
    markers = recording.markers[recording.frames][:, rig.marker_slices[i]]
    if link.markers_frame == "base":
        origins, headings = link_poses(chain, data.angles.q)
        markers = rotate(markers - origins[:, None, i], -headings[:, i, None])
    along = np.where(np.isfinite(markers[..., 0]), markers[..., 0], np.array(link.markers))
    return np.stack([along, markers[..., 1]], axis=-1)
