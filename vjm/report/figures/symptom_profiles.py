"""What the model misses, against where the arm is, how fast it moves and which way."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from vjm.report.figures.style import IDENTIFIED, NOMINAL, Row, panel_title, printable, styled
from vjm.report.figures.symptom_motion import title_of, titled
from vjm.report.wording import short
from vjm.symptoms import Symptoms
from vjm.symptoms.profiles import Profile

Array = NDArray[np.float64]

_BINS = 10
_MOST_DOTS = 600
_MOST_ROWS = 2
_LEAST_DEGREES = 0.1  # smaller angles are in mrad
_DOTS = "#cfcfcf"
_UNITS = {  # of a quantity: factor and name
    "m": (1e3, "mm"),
    "rad": (float(np.degrees(1.0)), "deg"),
    "N m": (1e3, "mN m"),
    "m/s²": (1.0, "m/s²"),
    "rad/s²": (1.0, "rad/s²"),
}
_KINDS = ("against_angle", "against_velocity", "against_sign")


def chosen(found: Symptoms) -> list[Profile]:
    """What all recordings show of a missing torque or acceleration, and the residual that goes most with a motion."""
    every = [profile for each in found.recordings for profile in each.profiles]
    torques = list(found.profiles) or [profile for profile in every if profile.quantity != "residual"]
    residuals = [profile for profile in every if profile.quantity == "residual"]
    kept = sorted(torques, key=_chance)[:1] + sorted(residuals, key=_chance)[:1]
    return kept[:_MOST_ROWS]


def _chance(profile: Profile) -> float:
    return min(each.p_value for each in profile.estimates)


@styled
def profiles(found: Symptoms) -> Figure:
    """Residuals against position, velocity and direction, each without what the two others explain.

    Args:
        found: with at least one joint or tip that moves.
    """
    shown = chosen(found)
    nothing = "What the model misses depends neither on where the arm is nor on how fast or which way it moves"
    rows = [Row(1.75, 3, gap=0.85) for _ in shown]
    page = titled(title_of(found, _KINDS, nothing), rows)
    for axes, profile in zip(page.axes, shown, strict=True):
        _draw_row(axes, found, profile)
    page.legend(
        [
            Line2D([], [], linestyle="", marker=".", color=_DOTS, label="single values"),
            Line2D([], [], linestyle="", marker="o", color=IDENTIFIED, label="means, two standard errors"),
            Line2D([], [], color=NOMINAL, label="trend, or jump"),
        ]
    )
    return page.figure


def _draw_row(axes: list[Axes], found: Symptoms, profile: Profile) -> None:
    scale, unit = _UNITS.get(profile.unit, (1.0, profile.unit))
    if unit == "deg" and float(np.percentile(np.abs(profile.values), 80)) * scale < _LEAST_DEGREES:
        scale, unit = 1e3, "mrad"
    place, motion = _UNITS[profile.motion_unit]
    points, (slope, rate, jump) = profile.points, profile.estimates
    centred = points.position - points.position.mean()
    known = [each.value if np.isfinite(each.std) else 0.0 for each in (slope, rate, jump)]
    parts = [known[0] * centred, known[1] * points.velocity, 0.5 * known[2] * points.way]
    rest = profile.values - sum(parts) - _levels(profile, parts)
    what = "missing torque" if profile.quantity == "torque" else profile.quantity
    where = "all recordings" if len(profile.recordings) > 1 else _file(found, profile)
    _draw(axes[0], place * points.position, scale * (rest + parts[0]))
    _draw(axes[1], place * points.velocity, scale * (rest + parts[1] + parts[2]))
    ends = np.array([points.position.min(), points.position.max()])
    _trend(axes[0], place * ends, scale * known[0] * (ends - points.position.mean()))
    ends = np.array([min(points.velocity.min(), 0.0), 0.0, 0.0, max(points.velocity.max(), 0.0)])
    _trend(axes[1], place * ends, scale * (known[1] * ends + 0.5 * known[2] * np.array([-1.0, -1.0, 1.0, 1.0])))
    _draw_jump(axes[2], profile, scale * (rest + parts[2]), scale * known[2])
    for each in axes:
        each.set_ylabel(f"{what} [{unit}]", labelpad=2)
    axes[0].set_xlabel(f"{printable(short(profile.motion, 16))} [{motion}]")
    axes[1].set_xlabel(f"its velocity [{motion}/s]")
    axes[2].set_xlabel("its direction [1]")
    panel_title(axes[0], f"{short(profile.sensor, 18)}, {short(where, 16)}")


def _file(found: Symptoms, profile: Profile) -> str:
    return found.recordings[profile.recordings[0]].followed.recording.file


def _levels(profile: Profile, parts: list[Array]) -> Array:
    """(P,) mean of each recording's own points, which tells nothing of the motion."""
    own = (profile.points.recording[:, None] == np.arange(len(profile.recordings))).astype(float)
    weights = own * profile.points.std[:, None] ** -2.0
    left = profile.values - sum(parts)
    levels: Array = own @ ((weights.T @ left) / weights.sum(axis=0))
    return levels


def _trend(axes: Axes, place: Array, values: Array) -> None:
    axes.plot(place, values, color=NOMINAL, linewidth=1.3, zorder=2)


def _draw(axes: Axes, place: Array, values: Array) -> None:
    thin = slice(None, None, max(1, place.size // _MOST_DOTS))
    axes.plot(place[thin], values[thin], ".", color=_DOTS, markersize=3, zorder=1)
    order = np.argsort(place)
    parts = np.array_split(order, min(_BINS, max(place.size // 6, 1)))
    centres = np.array([place[part].mean() for part in parts])
    means = np.array([values[part].mean() for part in parts])
    errors = np.array([2 * values[part].std() / np.sqrt(max(part.size - 1, 1)) for part in parts])
    axes.axhline(0.0, color="#444444", linewidth=0.6, zorder=1)
    axes.errorbar(centres, means, yerr=errors, linestyle="", marker="o", markersize=4, color=IDENTIFIED, elinewidth=1.1)
    _limit(axes, values, np.abs(means) + errors)


def _draw_jump(axes: Axes, profile: Profile, values: Array, jump: float) -> None:
    way = profile.points.way
    spread = 0.12 * np.random.default_rng(0).standard_normal(way.size).clip(-2, 2)
    thin = slice(None, None, max(1, way.size // _MOST_DOTS))
    clear = np.abs(way) > 0.5
    axes.plot((np.sign(way) + spread)[clear][thin], values[clear][thin], ".", color=_DOTS, markersize=3, zorder=1)
    axes.axhline(0.0, color="#444444", linewidth=0.6, zorder=1)
    _trend(axes, np.array([-1.35, 0.0, 0.0, 1.35]), 0.5 * jump * np.array([-1.0, -1.0, 1.0, 1.0]))
    sizes = []
    for side in (-1.0, 1.0):
        own = values[way * side > 0.5]
        if own.size > 2:
            error = 2 * float(own.std() / np.sqrt(own.size - 1))
            axes.errorbar(
                [side], [own.mean()], yerr=[error], marker="o", markersize=5, color=IDENTIFIED, elinewidth=1.3
            )
            sizes.append(abs(float(own.mean())) + error)
    axes.set_xlim(-1.6, 1.6)
    axes.set_xticks([-1.0, 1.0], ["backwards", "forwards"])
    _limit(axes, values, np.array([*sizes, abs(jump)]))


def _limit(axes: Axes, values: Array, means: Array) -> None:
    """Limits that show the means well; of the single values, those at the far ends may be cut off."""
    most = max(1.25 * float(means.max(initial=0.0)), 1.3 * float(np.percentile(np.abs(values), 80)), 1e-12)
    axes.set_ylim(-most, most)
