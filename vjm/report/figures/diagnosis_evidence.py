"""The picture that convinces: what the model misses without and with a cause, against what makes the cause plain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from vjm.effects.effect import Effect
from vjm.experiment.records import Recording
from vjm.model import Model
from vjm.report.abscissae import Cloud, abscissa_of, added, cloud
from vjm.report.effect_words import capital, clause, place
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    Row,
    Sheet,
    log_ticks,
    panel_title,
    sheet,
    styled,
)
from vjm.report.residuals import spectrum
from vjm.report.wording import short
from vjm.simulate.initial_state import Replay
from vjm.symptoms import Followed
from vjm.symptoms.joints import profiles
from vjm.symptoms.profiles import Profile, joined
from vjm.symptoms.signals import observe

if TYPE_CHECKING:
    from vjm.diagnosis.records import Cause, Diagnosis, Replayed

Array = NDArray[np.float64]

_BINS = 24
_BOTH = ("before", "after")
_MOST_DOTS = 1500
_PALE_BEFORE, _PALE_AFTER = "#f3c793", "#8fa5c4"


@styled
def evidence(cause: Cause, diagnosis: Diagnosis, followed: Sequence[Replayed]) -> Figure:
    """Residual without and with a cause against what makes it plain; beside it, what was missing against what it adds.

    Args:
        cause: the one to show.
        diagnosis: names it, and has the model with it.
        followed: recordings with replays without this cause alone, and with all causes; the first one is shown.
    """
    words = capital(clause(cause.effect, diagnosis.model, cause.parameters))
    page = sheet(f"{words}: {short(followed[0].recording.file)} without and with it", [Row(2.9, 2)])
    left, right = page.axes[0]
    first = followed[0]
    if first.before is not None and first.after is not None:
        _draw_left(left, cause.effect, diagnosis.model, followed, (first.before, first.after))
        _draw_added(right, first, first.before, first.after)
    _legend(page)
    return page.figure


def _legend(page: Sheet) -> None:
    page.legend(
        [
            Line2D([], [], color=NOMINAL, marker="s", markerfacecolor="white", label="without the cause"),
            Line2D([], [], color=IDENTIFIED, marker="o", label="with it"),
            Patch(color=BAND, label="noise"),
            Line2D([], [], color=MEASURED, linestyle="--", label="all that was missing"),
        ]
    )


def _draw_left(
    axes: Axes, effect: Effect, model: Model, followed: Sequence[Replayed], replays: tuple[Replay, Replay]
) -> None:
    kind, first = abscissa_of(effect), followed[0]
    if kind == "joint":
        found = [_missing_torque(effect, model, [(f.recording, getattr(f, name)) for f in followed]) for name in _BOTH]
        if found[0] is not None and found[1] is not None:
            _draw_joint(axes, effect, (found[0], found[1]))
            return
    if kind == "frequency" and _draw_spectrum(axes, first, replays):
        return
    _draw_cloud(axes, cloud(effect, first.recording, *replays), first.noise)


def _draw_cloud(axes: Axes, found: Cloud, noise: float) -> None:
    level = 1e3 * noise
    if found.squared:
        axes.axhspan(0.0, level, color=BAND, linewidth=0)
    else:
        axes.axhspan(-2 * level, 2 * level, color=BAND, linewidth=0)
        axes.axhline(0.0, color="#444444", linewidth=0.6)
    whole = bool(np.all(found.x == np.round(found.x)))  # numbers of markers
    edges = _edges(found.x, whole)
    for values, color, marker, pale in (
        (found.before, NOMINAL, "s", _PALE_BEFORE),
        (found.after, IDENTIFIED, "o", _PALE_AFTER),
    ):
        if not found.squared:
            some = _some(values.size)
            axes.plot(found.x[some], 1e3 * values[some], ".", color=pale, markersize=2, zorder=1)
        centres, sizes = _binned(found.x, values, edges, found.squared)
        face = "white" if marker == "s" else color
        axes.plot(centres, 1e3 * sizes, color=color, marker=marker, markerfacecolor=face, markersize=4.5, linewidth=1.1)
    axes.set_xlabel(found.label)
    axes.set_ylabel("residual, RMS [mm]" if found.squared else "residual [mm]")
    if found.squared:
        axes.set_ylim(bottom=0.0)
    else:
        _, sizes = _binned(found.x, found.before, edges, False)
        most = 1.5e3 * max(float(np.nanmax(np.abs(sizes), initial=0.0)), 3 * noise)
        axes.set_ylim(-most, most)
    if whole:
        axes.set_xticks(np.unique(found.x))
    panel_title(axes, "What the model misses")


def _edges(x: Array, whole: bool) -> Array:
    """Of bins that hold about as many points each; of whole numbers, one bin each."""
    if whole:
        kinds = np.unique(x)
        return np.concatenate([kinds - 0.5, kinds[-1:] + 0.5])
    return np.unique(np.quantile(x, np.linspace(0, 1, _BINS + 1)))


def _binned(x: Array, values: Array, edges: Array, squared: bool) -> tuple[Array, Array]:
    """Mean abscissa and mean value, or root mean square, of the points of each bin."""
    count = max(edges.size - 1, 1)
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, count - 1)
    sizes = np.bincount(bins, minlength=count)
    kept = sizes > 0
    per = np.maximum(sizes, 1)
    centres = np.bincount(bins, x, count) / per
    means = np.bincount(bins, values**2 if squared else values, count) / per
    result = np.sqrt(means) if squared else means
    return centres[kept], result[kept]


def _some(count: int) -> NDArray[np.intp]:
    """At most so many of them, without the order in which they come."""
    return np.sort(np.random.default_rng(0).permutation(count)[:_MOST_DOTS])


def _draw_added(axes: Axes, followed: Replayed, before: Replay, after: Replay) -> None:
    x, y = (1e3 * each for each in added(followed.recording, before, after))
    some = _some(x.size)
    reach = max(float(np.percentile(np.abs(x), 99.5)), 3e3 * followed.noise) * 1.15
    ends = np.array([-reach, reach])
    noise = 2e3 * followed.noise
    axes.fill_between(ends, ends - noise, ends + noise, color=BAND, linewidth=0)
    axes.plot(ends, ends, color=MEASURED, linestyle="--", linewidth=1.2, zorder=2)
    axes.plot(x[some], y[some], ".", color=IDENTIFIED, markersize=2.2, zorder=3)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-1.15 * reach, 1.15 * reach)
    axes.set_xlabel("what the cause adds to the simulated markers [mm]")
    axes.set_ylabel("what was missing [mm]")
    share = 1 - float(np.sum((y - x) ** 2)) / max(float(np.sum(y**2)), 1e-300)
    panel_title(axes, f"Explained: {max(100 * share, 0.0):.1f} % of what was missing, in mean square")


def _missing_torque(
    effect: Effect, model: Model, replayed: Sequence[tuple[Recording, Replay | None]]
) -> Profile | None:
    """Torque at the joint that replays lack; None where the recordings do not show it."""
    noise, name, found = (model.marker_noise, model.encoder_noise), f"{place(effect, model)}.theta", []
    for k, (recording, replay) in enumerate(replayed):
        if replay is None or recording.kind != "driven":
            continue
        shown = Followed(model.rig, recording, replay.simulation.markers, replay.simulation.theta, noise)
        own = profiles(k, shown, observe(shown))
        found += [each for each in own if each.quantity == "torque" and each.motion == name]
    return joined(found) or next(iter(found), None)


def _draw_joint(axes: Axes, effect: Effect, found: Sequence[Profile]) -> None:
    by_angle = effect.id in ("joint_spring", "torque_offset")
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    largest = 0.0
    for profile, color, marker, pale in zip(
        found, (NOMINAL, IDENTIFIED), ("s", "o"), (_PALE_BEFORE, _PALE_AFTER), strict=True
    ):
        x = np.degrees(profile.points.position if by_angle else profile.points.velocity)
        values = 1e3 * profile.values
        axes.plot(x, values, ".", color=pale, markersize=3, zorder=1)
        centres, means = _binned(x, values, np.unique(np.quantile(x, np.linspace(0, 1, 11))), False)
        face = "white" if marker == "s" else color
        axes.plot(centres, means, color=color, marker=marker, markerfacecolor=face, markersize=4.5, linewidth=1.1)
        largest = max(largest, float(np.abs(means).max(initial=0.0)), float(np.percentile(np.abs(values), 90)))
    axes.set_ylim(-1.3 * largest, 1.3 * largest)
    axes.set_xlabel("joint angle [°]" if by_angle else "joint velocity [°/s]")
    axes.set_ylabel("missing torque [mN m]")
    panel_title(axes, "Torque that the model misses at the joint")


def _draw_spectrum(axes: Axes, followed: Replayed, replays: tuple[Replay, Replay]) -> bool:
    """Amplitude of the residual against frequency; false where there is too little to show."""
    found = [spectrum(followed.recording, each, followed.noise) for each in replays]
    if found[0] is None or found[1] is None:
        return False
    for each, color in zip(found, (NOMINAL, IDENTIFIED), strict=True):
        if each is not None:
            axes.plot(each.frequency, 1e3 * each.amplitude, color=color, linewidth=1.0)
    axes.axhline(1e3 * found[0].limit, color=MEASURED, linestyle=":", linewidth=1.0)
    axes.set_yscale("log")
    log_ticks(axes.yaxis)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel("amplitude of the residual [mm]")
    panel_title(axes, "What the model misses; dotted: limit of noise")
    return True
