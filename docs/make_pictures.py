"""Draw the pictures of README.md, in few colours to keep them small: two as `vjm demo` draws them, the rig, and a slew.

Run from the repository's root: python docs/make_pictures.py
"""

from __future__ import annotations

import sys
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Rectangle
from PIL import Image

import vjm
from vjm.chain.curve import marker_poses
from vjm.report.figures.identification import identification_pictures

HERE = Path(__file__).parent
DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"
CHOSEN = {"shapes": "shapes.png", "tip_1": "tip.png"}
COLOURS = 48

X_AXIS, Y_AXIS, ANGLE, LINK, MARKER, FAINT = "#c0392b", "#2e8b57", "#0b2f5c", "#b4b4b4", "#222222", "#888888"


def main() -> None:
    draw_slew("slew.gif")
    save(draw_rig(), "rig.png", "base frame, angle and markers of a link")
    fit = vjm.identify(vjm.load_experiment(DEMO))
    for picture in identification_pictures(fit):
        if picture.name in CHOSEN:
            save(picture.png, CHOSEN[picture.name], picture.alternative)


def save(png: bytes, name: str, alternative: str) -> None:
    image = Image.open(BytesIO(png)).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE)
    image.save(HERE / name, optimize=True)
    print(f"docs/{name}: {alternative}")


def draw_slew(name: str, rate: float = 20.0, duration: float = 3.5) -> None:
    """Draw a slew of a flexible arm, as it is and shaped by `examples/input_shaping.py`, frame by frame."""
    sys.path.insert(0, str(HERE.parent / "examples"))
    import hub_arm
    import input_shaping as shaping

    first, second = shaping.vibrations(hub_arm.identified().model)[:2]
    shaper = shaping.convolved(shaping.zvd(*first), shaping.zvd(*second))
    cases = (("slew as it is", (np.zeros(1), np.ones(1)), X_AXIS), ("shaped with the\nidentified model", shaper, ANGLE))
    time, arcs = np.arange(round(rate * duration)) / rate, np.linspace(0.0, 1.0, 41)
    curves = []
    for _, impulses, _ in cases:
        motion = hub_arm.TRUTH.simulate(torque=shaping.follow(shaping.SLEW, impulses), duration=duration)
        q = np.stack([np.interp(time, motion.time, angle) for angle in motion.q.T], axis=1)
        curves.append(marker_poses(hub_arm.TRUTH.chain, q, [arcs], [False])[0])
    images = []
    for k, now in enumerate(time):
        figure = Figure(figsize=(7.0, 3.85), dpi=80)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set(xlim=(-0.1, 1.8), ylim=(-0.1, 0.945), aspect="equal")
        axes.axis("off")
        target = np.array([np.cos(shaping.ANGLE), np.sin(shaping.ANGLE)])
        axes.plot(*np.stack([[0, 0], target], axis=1), color=FAINT, lw=1, ls=(0, (5, 4)))
        axes.annotate("target", target, (5, 4), textcoords="offset points", color=FAINT, fontsize=11)
        for row, ((words, _, colour), curve) in enumerate(zip(cases, curves, strict=True)):
            recent = curve[max(0, k - 6) : k + 1, -1]
            axes.plot(*recent.T, color=colour, lw=1, alpha=0.4)
            axes.plot(*curve[k].T, color=colour, lw=4, solid_capstyle="round")
            axes.plot(*curve[k, -1], "o", color=colour, ms=9)
            axes.text(1.12, 0.3 - 0.1 * row, words, color=colour, fontsize=12, fontweight="bold", va="top")
        axes.plot(0, 0, "o", ms=14, mfc="white", mec=MARKER, mew=2)
        axes.text(1.12, 0.85, f"{now:.2f} s", fontsize=11, color=FAINT)
        stream = BytesIO()
        figure.savefig(stream, format="png", facecolor="white")
        images.append(Image.open(stream).convert("RGB").quantize(32, dither=Image.Dither.NONE))
    still = [round(1000 / rate)] * (len(images) - 1) + [1500]
    images[0].save(HERE / name, save_all=True, append_images=images[1:], duration=still, loop=0, optimize=True)
    print(f"docs/{name}: a slew of a flexible arm, as it is and shaped")


def draw_rig() -> bytes:
    """Draw what the columns of a recording mean: base origin, axes, sign of theta and numbers of markers."""
    figure = Figure(figsize=(9.2, 4.5), dpi=120)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-0.24, 1.48), ylim=(-0.18, 0.6613), aspect="equal")
    axes.axis("off")
    theta, arcs = np.deg2rad(32.0), np.linspace(0.0, 1.0, 201)
    heading = theta - 0.6 * (arcs - arcs**2 / 2)  # the tip lags behind: the link is being turned to the left
    points = np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * (arcs[1] - arcs[0])
    points -= points[0]
    arrow = {"arrowstyle": "-|>,head_width=0.35,head_length=0.7", "linewidth": 2.4, "shrinkA": 0, "shrinkB": 0}

    straight = 1.06 * np.array([np.cos(theta), np.sin(theta)])
    axes.plot(*np.stack([[0.0, 0.0], straight], axis=1), color=FAINT, linewidth=1.2, linestyle=(0, (5, 4)), zorder=2)
    axes.annotate("undeformed", straight, (7, 2), textcoords="offset points", color=FAINT, fontsize=11, va="center")
    base = Rectangle((-0.07, -0.07), 0.14, 0.14, facecolor="#e4e4e4", edgecolor=FAINT, linewidth=1.2, zorder=1)
    axes.add_patch(base)
    axes.plot(*points.T, color=LINK, linewidth=9, solid_capstyle="butt", zorder=3)
    for name, end, color, place in (("x", (1.3, 0.0), X_AXIS, (8, -5)), ("y", (0.0, 0.6), Y_AXIS, (-20, -10))):
        axes.annotate("", end, (0, 0), arrowprops={**arrow, "color": color}, zorder=4)
        axes.annotate(name, end, place, textcoords="offset points", color=color, fontsize=18, fontweight="bold")
    axes.plot(0, 0, "o", markersize=15, markerfacecolor="white", markeredgecolor=MARKER, markeredgewidth=2.2, zorder=5)
    axes.plot(0, 0, "o", markersize=4, color=MARKER, zorder=6)
    axes.annotate("base origin:\njoint or clamp", (0.0, -0.08), va="top", ha="center", fontsize=12)

    radius = 0.36
    axes.add_patch(Arc((0, 0), 2 * radius, 2 * radius, theta2=28.0, color=ANGLE, linewidth=2.4, zorder=4))
    tip, tail = (radius * np.array([np.cos(angle), np.sin(angle)]) for angle in (theta, theta - 0.06))
    axes.annotate("", tip, tail, arrowprops={**arrow, "color": ANGLE}, zorder=4)
    axes.annotate("beam.theta > 0", (0.39, 0.1), color=ANGLE, fontsize=14, fontweight="bold")
    axes.annotate("beam.tau > 0 turns the same way", (0.39, 0.045), color=ANGLE, fontsize=11)

    for k in range(1, 5):
        axes.plot(*points[50 * k], "o", color=MARKER, markersize=19, zorder=5)
        style = {"ha": "center", "va": "center_baseline", "color": "white", "fontweight": "bold"}
        axes.annotate(str(k), points[50 * k], fontsize=12, zorder=6, **style)
    x, y = points[-1]
    for end in ((x, 0.0), (0.0, y)):
        axes.plot(*np.stack([(x, y), end], axis=1), color=FAINT, linewidth=1.2, linestyle=(0, (1, 2)), zorder=1)
    offset = {"textcoords": "offset points", "fontsize": 12}
    axes.annotate("beam.m4.x", (x, 0.0), (0, -8), ha="center", va="top", **offset)
    axes.annotate("beam.m4.y", (0.0, y), (-7, 0), ha="right", va="center", **offset)
    text = "markers, numbered from\nthe base outwards:\nmarkers = [0.25, 0.5, 0.75, 1.0]\nalong the link [m]"
    axes.annotate(text, (x, y), (20, -12), va="top", linespacing=1.35, **(offset | {"fontsize": 11}))
    stream = BytesIO()
    figure.savefig(stream, format="png", facecolor="white", metadata={"Software": None})
    return stream.getvalue()


if __name__ == "__main__":
    main()
