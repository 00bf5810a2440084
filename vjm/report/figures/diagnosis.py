"""The pictures of a diagnosis, drawn, named and captioned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from vjm.diagnosis.symptoms.joints import JointProfile, missing_torque
from vjm.effects.effect import Abscissa, Effect
from vjm.errors import InsufficientDataError
from vjm.records import REFERENCE, Array, Recording, SimulatedRecording
from vjm.report.figures.motion import drawn, label, simulated
from vjm.report.figures.residuals import spectrum
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    NOMINAL_STYLE,
    TORQUE,
    Picture,
    Row,
    Sheet,
    log_ticks,
    panel_title,
    png,
    printable,
    sheet,
    styled,
)
from vjm.report.figures.symptoms import symptom_pictures
from vjm.report.figures.windows import (
    Signal,
    liveliest_window,
    tip_signal,
)
from vjm.report.text import capital, clause, millimetres, named, place, short
from vjm.simulation.model import Model

if TYPE_CHECKING:
    from vjm.records import RecordingComparison
from vjm.diagnosis.records import Cause, Diagnosis

_WINDOW = 0.08  # of a recording, over which a local size is taken


class Cloud(NamedTuple):
    """A residual without and with a cause, against something.

    Attributes:
        x: (P,) what it is held against.
        before, after: (P,) what the two models leave [m].
        label: of x, with its unit.
        squared: whether the size of the residual matters, not its sign.
    """

    x: Array
    before: Array
    after: Array
    label: str
    squared: bool


def cloud(effect: Effect, recording: Recording, before: SimulatedRecording, after: SimulatedRecording) -> Cloud:
    """What two models leave of a recording against the abscissa of an effect (never of a joint or of frequency)."""
    frames = recording.frames
    measured = recording.markers[frames]
    left = [measured - each.simulation.markers[frames] for each in (before, after)]
    time, shown = recording.time[frames], after.simulation.markers[frames]
    kind = effect.abscissa
    if kind == "velocity":
        velocity = np.gradient(shown, time, axis=0)
        return _cloud(velocity, left, "velocity of the marker [m/s]", False)
    if kind == "position":
        return _cloud(shown, left, "coordinate of the marker [m]", False)
    if kind in ("radial", "tangential"):
        return _polar(shown, left, kind)
    if kind == "marker":
        marker = np.broadcast_to(np.arange(1.0, shown.shape[1] + 1)[None, :, None], shown.shape)
        return _cloud(marker, left, "marker, from the base outwards [1]", True)
    if kind == "amplitude":
        return _cloud(_local(shown - np.nanmean(shown, axis=0)), left, "local size of the motion, RMS [m]", True)
    whole = np.broadcast_to((time - time[0])[:, None, None], shown.shape)
    return _cloud(whole, left, "time since the start [s]", True)


def added(recording: Recording, before: SimulatedRecording, after: SimulatedRecording) -> tuple[Array, Array]:
    """What the causes add to the simulated marker coordinates, and what was missing: (P,), (P,) [m]."""
    frames = recording.frames
    first = before.simulation.markers[frames]
    x, y = after.simulation.markers[frames] - first, recording.markers[frames] - first
    known = np.isfinite(y)
    return x[known], y[known]


def _cloud(x: Array, left: list[Array], label: str, squared: bool) -> Cloud:
    known = np.isfinite(left[0]) & np.isfinite(left[1]) & np.isfinite(x)
    return Cloud(x[known], left[0][known], left[1][known], label, squared)


def _polar(shown: Array, left: list[Array], kind: Abscissa) -> Cloud:
    """Residual outwards, or around the base, against the distance from it."""
    radius = np.linalg.norm(shown, axis=-1)
    outwards = shown / np.maximum(radius, 1e-12)[..., None]
    around = np.stack([-outwards[..., 1], outwards[..., 0]], axis=-1)
    way = outwards if kind == "radial" else around
    parts = [(each * way).sum(axis=-1) for each in left]
    return _cloud(radius, parts, "distance from the base [m]", False)


def _local(values: Array) -> Array:
    """Root mean square over a stretch of time around each frame, of values (F, k, 2)."""
    width = max(3, round(_WINDOW * len(values)))
    kernel = np.ones(width) / width
    squares = np.nan_to_num(values**2).reshape(len(values), -1)
    weights = np.convolve(np.ones(len(values)), kernel, mode="same")
    smooth = np.stack([np.convolve(column, kernel, mode="same") / weights for column in squares.T], axis=1)
    result: Array = np.sqrt(np.maximum(smooth, 0.0)).reshape(values.shape)
    return result


_BINS = 24
_BOTH = ("reference", "simulated")
_MOST_DOTS = 1500
_PALE_BEFORE, _PALE_AFTER = "#f3c793", "#8fa5c4"


@styled
def evidence(cause: Cause, diagnosis: Diagnosis, followed: Sequence[RecordingComparison]) -> Figure:
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
    if first.reference is not None and first.simulated is not None:
        _draw_left(left, cause.effect, diagnosis.model, followed, (first.reference, first.simulated))
        _draw_added(right, first, first.reference, first.simulated)
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
    axes: Axes,
    effect: Effect,
    model: Model,
    followed: Sequence[RecordingComparison],
    replays: tuple[SimulatedRecording, SimulatedRecording],
) -> None:
    kind, first = effect.abscissa, followed[0]
    if kind in ("joint_angle", "joint_rate"):
        joint = f"{place(effect, model)}.theta"
        simulated = [[one for f in followed if (one := getattr(f, name)) is not None] for name in _BOTH]
        found = [missing_torque(model.rig, own, joint) for own in simulated]
        if found[0] is not None and found[1] is not None:
            _draw_joint(axes, effect, (found[0], found[1]))
            return
    if kind == "frequency" and _draw_spectrum(axes, first, replays):
        return
    _draw_cloud(axes, cloud(effect, first.recording, *replays), first.noise[0])


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


def _draw_added(
    axes: Axes, followed: RecordingComparison, before: SimulatedRecording, after: SimulatedRecording
) -> None:
    x, y = (1e3 * each for each in added(followed.recording, before, after))
    some = _some(x.size)
    reach = max(float(np.percentile(np.abs(x), 99.5)), 3e3 * followed.noise[0]) * 1.15
    ends = np.array([-reach, reach])
    noise = 2e3 * followed.noise[0]
    axes.fill_between(ends, ends - noise, ends + noise, color=BAND, linewidth=0)
    axes.plot(ends, ends, color=MEASURED, linestyle="--", linewidth=1.2, zorder=2)
    axes.plot(x[some], y[some], ".", color=IDENTIFIED, markersize=2.2, zorder=3)
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-1.15 * reach, 1.15 * reach)
    axes.set_xlabel("what the cause adds to the simulated markers [mm]")
    axes.set_ylabel("what was missing [mm]")
    share = 1 - float(np.sum((y - x) ** 2)) / max(float(np.sum(y**2)), 1e-300)
    panel_title(axes, f"Explained: {max(100 * share, 0.0):.1f} % of what was missing, in mean square")


def _draw_joint(axes: Axes, effect: Effect, found: Sequence[JointProfile]) -> None:
    by_angle = effect.abscissa == "joint_angle"
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    largest = 0.0
    for profile, color, marker, pale in zip(
        found, (NOMINAL, IDENTIFIED), ("s", "o"), (_PALE_BEFORE, _PALE_AFTER), strict=True
    ):
        x = np.degrees(profile.position if by_angle else profile.velocity)
        values = 1e3 * profile.fit.own
        axes.plot(x, values, ".", color=pale, markersize=3, zorder=1)
        centres, means = _binned(x, values, np.unique(np.quantile(x, np.linspace(0, 1, 11))), False)
        face = "white" if marker == "s" else color
        axes.plot(centres, means, color=color, marker=marker, markerfacecolor=face, markersize=4.5, linewidth=1.1)
        largest = max(largest, float(np.abs(means).max(initial=0.0)), float(np.percentile(np.abs(values), 90)))
    axes.set_ylim(-1.3 * largest, 1.3 * largest)
    axes.set_xlabel("joint angle [°]" if by_angle else "joint velocity [°/s]")
    axes.set_ylabel("missing torque [mN m]")
    panel_title(axes, "Torque that the model misses at the joint")


def _draw_spectrum(
    axes: Axes, followed: RecordingComparison, replays: tuple[SimulatedRecording, SimulatedRecording]
) -> bool:
    """Amplitude of the residual against frequency; false where there is too little to show."""
    found = [spectrum(followed.recording, each, followed.noise[0]) for each in replays]
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


MOST_RECORDINGS = 40
_ROW = 0.3  # inches a recording
_LOOKS: dict[str, dict[str, Any]] = {
    "reference": {"linestyle": "", "marker": "s", "color": NOMINAL, "markerfacecolor": "white", "zorder": 2},
    "alternative": {"linestyle": "", "marker": "D", "color": TORQUE, "markersize": 6, "zorder": 3},
    "simulated": {"linestyle": "", "marker": "o", "color": IDENTIFIED, "zorder": 4},
}
_NAMES = {"reference": "without the causes", "alternative": "next best explanation", "simulated": "with the causes"}
_NOISE: dict[str, Any] = {"linestyle": "", "marker": "|", "markeredgewidth": 2, "color": MEASURED}
_MEASURED: dict[str, Any] = {"color": "#bdbdbd", "linewidth": 4.0, "solid_capstyle": "round"}


@styled
def gain_of_recordings(diagnosis: Diagnosis) -> Figure:
    """RMS marker residual of every recording without and with the causes, beside the noise, logarithmic.

    Args:
        diagnosis: with at least one recording that the models follow.
    """
    # Held-out recordings first: they are what counts.
    ordered = sorted(diagnosis.recordings, key=lambda each: each.recording.role != "holdout")
    shown = [each for each in ordered if each.reference is not None][:MOST_RECORDINGS]
    page = sheet(_title(diagnosis), [Row(max(_ROW * len(shown), 0.7))], left=2.75)
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    kept = [name for name in _LOOKS if name == "reference" or (diagnosis.causes and _any(shown, name))]
    for row, each in zip(places.tolist(), shown, strict=True):
        sizes = {name: replay.marker_rms for name in kept if (replay := getattr(each, name)) is not None}
        if "simulated" in sizes:
            ends = [1e3 * sizes["reference"], 1e3 * sizes["simulated"]]
            axes.plot(ends, [row, row], color="#bbbbbb", linewidth=1.0, zorder=1)
        for name, size in sizes.items():
            axes.plot(1e3 * size, row, **_LOOKS[name])
        axes.plot(1e3 * each.noise[0], row, **_NOISE, markersize=15, zorder=1)
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.15, high * 1.15)
    log_ticks(axes.xaxis)
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [_label(each) for each in shown])
    axes.grid(False, axis="y")
    axes.set_xlabel("marker residual over the whole recording, open loop, RMS [mm]")
    axes.set_ylabel("recording", labelpad=6)
    handles = [Line2D([], [], **_LOOKS[name], label=_NAMES[name] if diagnosis.causes else "model") for name in kept]
    page.legend([*handles, Line2D([], [], **_NOISE, markersize=11, label="noise")])
    return page.figure


def _any(shown: Sequence[RecordingComparison], name: str) -> bool:
    return any(getattr(each, name) is not None for each in shown)


def _title(diagnosis: Diagnosis) -> str:
    gain = diagnosis.gain
    if gain is None or not diagnosis.causes:
        return "How far each recording is from the model without any effect"
    text = f"Held-out recordings: {millimetres(gain.before)} without the causes, {millimetres(gain.after)} with them"
    if gain.next_best is not None:
        text += f", {millimetres(gain.next_best)} with the next best explanation"
    return f"{text}; noise {millimetres(gain.noise)}"


def _label(each: RecordingComparison) -> str:
    role = "held out" if each.recording.role == "holdout" else "train"
    return printable(f"{short(each.recording.file, 24)} ({role})")


@styled
def before_and_after(followed: RecordingComparison, diagnosis: Diagnosis) -> Figure:
    """Tip of one recording, measured and by the models without and with the causes; residuals underneath.

    Args:
        followed: a recording that both models follow, with at least one marker.
        diagnosis: has the models.

    Raises:
        InsufficientDataError: a recording without replays or marker.
    """
    recording, model = followed.recording, diagnosis.model
    signal = tip_signal(model.rig, recording)
    if signal is None or followed.reference is None or followed.simulated is None:
        raise InsufficientDataError(f"tip of {recording.file}", "no marker or no replay", "choose another recording")
    left = {
        name: signal.value - simulated(replay, recording, signal)
        for name in ("reference", "alternative", "simulated")
        if (replay := getattr(followed, name)) is not None
    }
    role = "held out" if recording.role == "holdout" else "train"
    sizes = [millimetres(float(np.sqrt(np.mean(left[name] ** 2)))) for name in ("reference", "simulated")]
    title = (
        f"Tip of {short(recording.file)} ({role}): off by {sizes[0]} RMS without the causes, by {sizes[1]} with them"
    )
    page = sheet(title, [Row(1.8), Row(1.8, gap=0.75)])
    start, stop = liveliest_window(signal.time, left["reference"])
    _draw_motion(page.axes[0][0], followed, diagnosis, signal, (start, stop))
    _draw_residuals(page.axes[1][0], followed, signal, left)
    page.legend(_handles("alternative" in left))
    return page.figure


def _draw_motion(
    axes: Axes, followed: RecordingComparison, diagnosis: Diagnosis, signal: Signal, window: tuple[float, float]
) -> None:
    rows = (signal.time >= window[0]) & (signal.time <= window[1])
    axes.plot(signal.time[rows], 1e3 * signal.value[rows], **_MEASURED)
    shown: list[tuple[SimulatedRecording | None, Model, dict[str, Any]]] = [
        (followed.reference, diagnosis.base, {"color": NOMINAL, "linestyle": NOMINAL_STYLE, "linewidth": 1.3}),
        (followed.simulated, diagnosis.model, {"color": IDENTIFIED, "linewidth": 1.3}),
    ]
    for replay, model, look in shown:
        if replay is not None:
            time, value = drawn(replay, model, followed.recording, signal, window)
            axes.plot(time, 1e3 * value, **look)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(label(diagnosis.model.rig, signal))
    whole = window[1] - window[0] > 0.99 * (signal.time[-1] - signal.time[0])
    panel_title(axes, "" if whole else "Where the model without the causes is off most")


def _draw_residuals(axes: Axes, followed: RecordingComparison, signal: Signal, left: dict[str, Array]) -> None:
    noise = 1e3 * followed.noise[0]
    axes.axhspan(-2 * noise, 2 * noise, color=BAND, linewidth=0)
    axes.axhline(0.0, color="#444444", linewidth=0.6)
    colors = {"reference": NOMINAL, "alternative": TORQUE, "simulated": IDENTIFIED}
    largest = 4 * noise
    for name, values in left.items():
        axes.plot(signal.time, 1e3 * values, color=colors[name], linewidth=0.9, alpha=0.95)
        if name != "alternative":
            largest = max(largest, 1.08e3 * float(np.abs(values).max()))
    axes.set_ylim(-largest, largest)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("residual [mm]")
    panel_title(axes, "Measured less simulated, whole recording")


def _handles(next_best: bool) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="measured", **_MEASURED),
        Line2D([], [], color=NOMINAL, linestyle=NOMINAL_STYLE, label=_NAMES["reference"]),
        Line2D([], [], color=IDENTIFIED, label=_NAMES["simulated"]),
    ]
    if next_best:
        handles.append(Line2D([], [], color=TORQUE, label=f"{_NAMES['alternative']} (residual)"))
    return [*handles, Patch(color=BAND, label="±2σ noise")]


_MOST_CAUSES = 4
_MOST_HELD_OUT = 3
# Every file name that these pictures may have.
NAMES = (
    *(f"cause_{k + 1}" for k in range(_MOST_CAUSES)),
    "gain",
    *(f"held_out_{k + 1}" for k in range(_MOST_HELD_OUT)),
)


def diagnosis_pictures(diagnosis: Diagnosis) -> list[Picture]:
    """All figures of a diagnosis: what is wrong, the evidence, what is gained."""
    wrong = [] if diagnosis.symptoms is None else symptom_pictures(diagnosis.symptoms)
    return [*wrong, *_causes(diagnosis), *_gained(diagnosis)]


def _causes(diagnosis: Diagnosis) -> Iterator[Picture]:
    for k, cause in enumerate(diagnosis.causes[:_MOST_CAUSES]):
        shown = _without(cause, diagnosis)
        if not shown:
            continue
        beside = "the same model without this cause" if len(diagnosis.causes) > 1 else "the model fitted without it"
        caption = (
            f"{named(cause.effect.id)}, in the recording where the causes gain most, beside {beside}. Left: what the "
            "models miss, against what makes this cause plain. Right: what was missing against what the cause adds; on "
            "the dashed line the two are the same."
        )
        yield _picture(f"cause_{k + 1}", caption, evidence(cause, diagnosis, shown))


def _without(cause: Cause, diagnosis: Diagnosis) -> list[RecordingComparison]:
    """Recordings simulated without this cause but with the others, the one in which all causes gain most first."""
    first = diagnosis.most_improved
    if first is None:
        return []
    if len(diagnosis.causes) == 1:
        return [first, *(each for each in diagnosis.recordings if each is not first)]
    return [first if cause.without is None else replace(first, reference=cause.without)]


def _gained(diagnosis: Diagnosis) -> Iterator[Picture]:
    if any(each.reference is not None for each in diagnosis.recordings):
        caption = "Open-loop simulation of each whole recording; a model that misses nothing lies on the noise mark."
        yield _picture("gain", caption, gain_of_recordings(diagnosis))
    if not diagnosis.causes:
        return
    for k, each in enumerate(_held_out(diagnosis)):
        caption = f"Tip marker in {short(each.recording.file)}: measured, and as simulated before and after."
        yield _picture(f"held_out_{k + 1}", caption, before_and_after(each, diagnosis))


def _held_out(diagnosis: Diagnosis) -> list[RecordingComparison]:
    """Held-out recordings, the one that gains most first; a training one where none is held out."""
    rig = diagnosis.model.rig
    usable = [
        each
        for each in diagnosis.recordings
        if each.reference is not None
        and each.simulated is not None
        and each.recording.kind != "quiet"
        and tip_signal(rig, each.recording) is not None
    ]
    usable.sort(key=lambda each: -each.reference.marker_rms if each.reference else 0.0)
    held_out = [each for each in usable if each.recording.role == "holdout"]
    changed = [each for each in held_out if each.recording.condition != REFERENCE]
    return (changed or held_out)[:_MOST_HELD_OUT] or usable[:1]


def _picture(name: str, caption: str, figure: Figure) -> Picture:
    return Picture(name, caption, figure.texts[0].get_text().replace("\n", " ").replace(r"\$", "$"), png(figure))
