"""Picture of a check: the markers as they were recorded over the rig as it is described."""

from __future__ import annotations

import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Circle
from matplotlib.patheffects import withStroke

from vjm.identification.check import Check, RecordingOverview
from vjm.records import Array, Link, Rig
from vjm.report.figures.panels import Color, Picture
from vjm.text import number, short

_LINK = "#c9c9c9"
_RED, _GREEN, _WRONG = "#c0392b", "#2e8b57", "#b00020"
_MOST_POINTS = 1500  # of a marker's path
_MOST_LENGTHS = 5.0  # of the link, up to which markers may be away for its own labels to be read
_HALO = [withStroke(linewidth=3, foreground="white")]
_LABEL: dict[str, Any] = {"ha": "center", "fontsize": 9, "path_effects": _HALO, "zorder": 8}


def check_picture(check: Check) -> Picture:
    """Return the picture of the first link: what is described in grey, what was recorded in colour."""
    caption = "Where the recordings and the experiment file agree, numbered dots lie in the rings of the same number."
    return Picture("check", caption, partial(_draw, check))


def _draw(check: Check) -> Figure:
    rig, link = check.experiment.rig, check.experiment.rig.links[0]
    figure = Figure(figsize=(9.2, 6.4), layout="constrained")
    valid = not check.problem
    turns = "; the paths should end at the dashed lines" if link.joint == "revolute" else ""
    title = check.problem or f"Each dot should lie in the ring of its number{turns}."
    lines = textwrap.wrap(title.replace("\n", " "), 100)
    figure.suptitle("\n".join(lines), x=0.011, ha="left", color="black" if valid else _WRONG)
    axes = figure.subplots()
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x of the base frame [m]", ylabel="y of the base frame [m]")
    if link.markers_frame == "link":
        axes.set(xlabel=f"x of {link.name}'s own frame [m]", ylabel=f"y of {link.name}'s own frame [m]")
    shown = max(check.overviews, key=lambda overview: overview.motion)
    resting = next((overview for overview in check.overviews if overview.recording.kind == "quiet"), shown)
    markers = _filled(link, shown.recording.markers[shown.recording.frames][:, rig.marker_slices[0]])
    colors = colormaps["viridis"](np.linspace(0.0, 0.85, len(link.markers)))
    _draw_paths(axes, markers, colors, shown)
    # Beside recordings in millimetres a link in metres is a dot, which its labels would hide.
    labelled = bool(np.nanmax(np.abs(markers), initial=0.0) < _MOST_LENGTHS * link.length)
    angles = _draw_link(axes, rig, shown, resting, labelled)
    _draw_frame(axes, rig, angles, labelled)
    _draw_rest(axes, rig, resting, colors)
    axes.margins(0.12)
    axes.update_datalim([(0.0, -0.12 * link.length)])  # room for the numbers below the link
    axes.autoscale_view()
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.09), ncols=2, markerscale=0.5)
    return figure


def _filled(link: Link, markers: Array) -> Array:
    """Return a link's markers (..., k, 2) with x, where it was not measured, as described; a lone y will do there."""
    x = np.where(np.isfinite(markers[..., 0]), markers[..., 0], np.array(link.markers))
    return np.stack([x, markers[..., 1]], axis=-1) if link.markers_frame == "link" else markers


def _draw_paths(axes: Axes, markers: Array, colors: Array, shown: RecordingOverview) -> None:
    rows = np.unique(np.linspace(0, len(markers) - 1, min(len(markers), _MOST_POINTS)).astype(int))
    for k, color in enumerate(colors):
        label = f"recorded: paths in {short(Path(shown.recording.file).name, 24)}" if k == 0 else None
        axes.plot(*markers[rows, k].T, "-", color=color, alpha=0.55, linewidth=1.0, label=label)


def _draw_link(
    axes: Axes, rig: Rig, shown: RecordingOverview, resting: RecordingOverview, labelled: bool
) -> tuple[float, float, float]:
    """Draw the straight link where the encoder has it, at rest and at the ends of its travel; return those [rad]."""
    link = rig.links[0]
    theta, radius = shown.recording.theta, link.hub_radius if link.markers_frame == "base" else 0.0
    arcs = radius + np.array(link.markers)
    rest_angle = low = high = 0.0
    if link.joint == "revolute" and link.markers_frame == "base":
        low, high = float(np.nanmin(theta[:, 0])), float(np.nanmax(theta[:, 0]))
        rest_angle = float(resting.recording.initial_theta[0])
    # An end at which the link rests is not drawn again.
    ends = [angle for angle in (low, high) if abs(angle - rest_angle) > 0.05 * (high - low) > 0]
    for k, angle in enumerate(ends):
        x, y = (radius + link.length) * np.cos(angle), (radius + link.length) * np.sin(angle)
        label = "described: ends of the encoder's travel" if k == 0 else None
        axes.plot(
            [radius * np.cos(angle), x],
            [radius * np.sin(angle), y],
            color=Color.MEASURED,
            linestyle=(0, (5, 3)),
            linewidth=1.2,
            label=label,
        )
        text = f"{link.name}.theta = {number(angle, 3)} rad ({number(np.rad2deg(angle), 3)}°)"
        label_style: dict[str, Any] = {"xytext": (0, 7), "va": "bottom"} if y > 0 else {"xytext": (0, -7), "va": "top"}
        if labelled:
            axes.annotate(text, (x, y), textcoords="offset points", **_LABEL, **label_style)
            axes.update_datalim([(1.2 * x, 1.15 * y)])  # room for it
    direction = np.array([np.cos(rest_angle), np.sin(rest_angle)])
    ends_of_link = np.outer(direction, [radius, radius + link.length])
    axes.plot(*ends_of_link, color=_LINK, linewidth=9, solid_capstyle="butt", zorder=1)
    if radius:
        axes.add_patch(Circle((0, 0), radius, facecolor="none", edgecolor=_LINK, linewidth=3, zorder=1))
    places = np.outer(arcs, direction)
    ring: dict[str, Any] = {"markersize": 19, "markerfacecolor": "none", "markeredgecolor": Color.AXIS, "zorder": 4}
    axes.plot(*places.T, "o", **ring, linestyle="none", label="described: markers at rest")
    for k, place in enumerate(places if labelled else (), start=1):
        axes.annotate(str(k), place, (0, -19), textcoords="offset points", color=Color.AXIS, **_LABEL)
    return rest_angle, low, high


def _draw_frame(axes: Axes, rig: Rig, angles: tuple[float, float, float], labelled: bool) -> None:
    """Draw the base: its origin and axes, the sense of the joint's angle, and gravity."""
    link = rig.links[0]
    # Short of the first marker, as far as the arrows can then still be seen.
    size = float(np.clip(0.8 * min(link.markers, default=link.length), 0.08 * link.length, 0.16 * link.length))
    arrow: dict[str, Any] = {"arrowstyle": "-|>,head_width=0.3,head_length=0.6", "linewidth": 2.2}
    for name, color, end, place in (("x", _RED, (size, 0.0), (-6, -17)), ("y", _GREEN, (0.0, size), (-13, -6))):
        axes.annotate("", end, (0, 0), arrowprops={**arrow, "color": color, "shrinkA": 0, "shrinkB": 0}, zorder=6)
        axes.annotate(name, end, place, textcoords="offset points", color=color, fontsize=12, fontweight="bold")
    mark: dict[str, Any] = {"markersize": 11, "markerfacecolor": "white", "markeredgecolor": "black", "zorder": 7}
    axes.plot(0, 0, "o" if link.joint == "revolute" else "s", **mark, markeredgewidth=1.8, linestyle="none")
    axes.update_datalim([(-0.18 * link.length, 0.0)])  # room for these words
    text = f"base origin,\n{'joint' if link.joint == 'revolute' else 'clamp'}"
    axes.annotate(
        text, (0, 0), (-11, -4), textcoords="offset points", ha="right", va="top", fontsize=9, path_effects=_HALO
    )
    if link.joint == "revolute" and link.markers_frame == "base" and labelled:
        span, radius = 35.0, 0.3 * link.length
        first = np.rad2deg(angles[0])
        arc: dict[str, Any] = {"color": "black", "linewidth": 1.8, "zorder": 6}
        axes.add_patch(Arc((0, 0), 2 * radius, 2 * radius, theta1=first, theta2=first + span - 4, **arc))
        end, before = np.deg2rad(first + span), np.deg2rad(first + span - 4)
        tip, tail = ((radius * float(np.cos(angle)), radius * float(np.sin(angle))) for angle in (end, before))
        axes.annotate("", tip, tail, arrowprops={**arrow, "color": "black", "shrinkA": 0, "shrinkB": 0}, zorder=6)
        label_place = (1.06 * tip[0], 1.06 * tip[1])
        axes.annotate(
            f"{link.name}.theta > 0", label_place, fontsize=10, fontweight="bold", path_effects=_HALO, zorder=8
        )
    strength = float(np.hypot(*rig.gravity))
    if strength:
        step = np.array(rig.gravity) / strength * size
        style = {"arrowstyle": "-|>", "color": Color.NOMINAL, "linewidth": 2.0}
        start = (-0.12 * link.length, 0.12 * link.length)
        axes.annotate("", (start[0] + step[0], start[1] + step[1]), start, arrowprops=style)
        axes.annotate("gravity", start, (-4, 4), textcoords="offset points", ha="right", color=Color.NOMINAL)


def _draw_rest(axes: Axes, rig: Rig, resting: RecordingOverview, colors: Array) -> None:
    """Draw the markers where they were at the beginning of a recording, at rest if there is a quiet one."""
    link, recording = rig.links[0], resting.recording
    first = recording.frames[: 10 if recording.kind == "quiet" else 1]
    places = _filled(link, np.nanmedian(recording.markers[first][:, rig.marker_slices[0]], axis=0))
    instant = "at rest" if recording.kind == "quiet" else "in the first frame"
    for k, (place, color) in enumerate(zip(places, colors, strict=True), start=1):
        label = f"recorded: markers {instant} ({short(Path(recording.file).name, 24)})" if k == 1 else None
        axes.plot(*place, "o", color=color, markersize=13, zorder=5, label=label, linestyle="none")
        style: dict[str, Any] = {"ha": "center", "va": "center", "color": "white", "fontweight": "bold", "zorder": 8}
        if np.isfinite(place).all():
            axes.annotate(str(k), place, fontsize=8, **style)
