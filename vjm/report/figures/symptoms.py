"""The pictures of what is wrong, before any cause is named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vjm.records import Array
from vjm.report.figures.style import (
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    TORQUE,
    Picture,
    Row,
    Sheet,
    letters_on,
    log_ticks,
    panel_title,
    png,
    printable,
    sheet,
    styled,
)
from vjm.report.figures.windows import liveliest_window, marker_name, tip_signal
from vjm.report.text import number, short
from vjm.symptoms.amplitude import FreeMotion
from vjm.symptoms.bands import Band
from vjm.symptoms.examine import Examined
from vjm.symptoms.find import Symptoms
from vjm.symptoms.lags import Lag
from vjm.symptoms.profiles import Profile
from vjm.symptoms.records import Symptom
from vjm.symptoms.tones import Quiet, Spectrum

MOST_ROWS = 24
_MOST_BANDS = 3
_ROW = 0.3  # inches a recording
_LIMITS = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)  # of a colour scale [% or deg]
_MOST_POINTS = 10
_TIMES = 250.0  # per cent; more is told as so many times
_CLEAR = 4.0  # times the median error: what is less sure is not drawn
_LEAST_RANGE = 2e-3  # of a frequency or damping ratio, on its axis
_BAND_KINDS = ("frequency", "phase", "amplitude", "damping", "rest_amplitude", "rest_delay")
_TREND_KINDS = ("frequency_with_amplitude", "damping_with_amplitude")


@styled
def bands(found: Symptoms) -> Figure:
    """Amplitude of every band in every recording, and its phase when the motion ends, measured against simulated.

    Args:
        found: with at least one recording in which a band moves.
    """
    rows = [each for each in found.recordings if each.bands is not None and each.bands.bands][:MOST_ROWS]
    shown = [mode for mode in range(len(found.frequencies)) if any(_band(each, mode) is not None for each in rows)]
    tables = (_table(rows, shown, _size, rest=True), _table(rows, shown, _angle, rest=False))
    nothing = "Amplitude and phase of all vibrations are as simulated"
    page = titled(title_of(found, _BAND_KINDS, nothing), [Row(_ROW * len(rows), 2, gap=0.5)], left=2.3)
    words = ("amplitude, measured against model [%]", "phase at the end, measured ahead [deg]")
    labels = [f"{number(found.frequencies[mode], 2)} Hz" for mode in shown]
    for axes, table, word, names in zip(page.axes[0], tables, words, ([*labels, "the rest"], labels), strict=True):
        _draw_map(axes, table, word, names, times=table is tables[0])
    files = [printable(short(each.followed.recording.file, 22)) for each in rows]
    page.axes[0][0].set_yticks(np.arange(len(rows)) + 0.5, files)
    page.axes[0][1].set_yticks([])
    for axes in page.axes[0]:
        axes.set_ylabel("recording", labelpad=6)
    colors = colormaps["PuOr_r"]
    page.legend(
        [
            Patch(facecolor=colors(0.95), edgecolor="#bbbbbb", label="larger, ahead"),
            Patch(facecolor="white", edgecolor="#bbbbbb", label="0: as the model, within three standard errors"),
            Patch(facecolor=colors(0.05), edgecolor="#bbbbbb", label="smaller, behind"),
            Patch(facecolor=BAND, edgecolor="#bbbbbb", label="does not move"),
        ]
    )
    return page.figure


def _band(each: Examined, mode: int) -> Band | None:
    return None if each.bands is None else each.bands.of_mode(mode)


def _size(band: Band) -> float:
    if abs(band.size.value) < 3 * band.size.std:
        return 0.0
    return 100 * float(np.expm1(band.size.value))


def _angle(band: Band) -> float:
    return float(np.degrees(band.ahead))


def _table(rows: Sequence[Examined], modes: Sequence[int], value: object, rest: bool) -> Array:
    """(recordings, bands) with the rest's gain as the last column where it is asked for; NaN where nothing moves."""
    table = np.full((len(rows), len(modes) + rest), np.nan)
    for r, each in enumerate(rows):
        for c, mode in enumerate(modes):
            band = _band(each, mode)
            if band is not None and callable(value):
                table[r, c] = value(band)
        if rest and each.bands is not None and np.isfinite(each.bands.rest_gain.std):
            gain = each.bands.rest_gain
            table[r, -1] = 100 * gain.value if abs(gain.value) > 3 * gain.std else 0.0
    return table


def _draw_map(axes: Axes, table: Array, words: str, names: Sequence[str], times: bool) -> None:
    largest = float(np.nanmax(np.abs(table))) if np.isfinite(table).any() else 0.0
    limit = next((each for each in _LIMITS if largest <= each), _LIMITS[-1])
    colors = colormaps["PuOr_r"]
    axes.set_facecolor(BAND)
    shade = np.sign(table) * np.sqrt(np.minimum(np.abs(table) / limit, 1.0))  # small ones are seen as well
    axes.pcolormesh(np.ma.masked_invalid(shade), cmap=colors, vmin=-1, vmax=1, edgecolors="#bbbbbb", linewidth=0.6)
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value):
            color = letters_on(colors(0.5 + 0.5 * float(shade[row, column])))
            text = _signed(float(value), times)
            axes.text(column + 0.5, row + 0.5, text, ha="center", va="center", fontsize=8.5, color=color)
    axes.invert_yaxis()
    axes.set_xticks(np.arange(len(names)) + 0.5, list(names))
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.set_xlabel("band [Hz]")
    panel_title(axes, words)


def _signed(value: float, times: bool) -> str:
    if abs(value) < 5e-3:
        return "0"
    if times and value > _TIMES:
        return f"{1 + value / 100:.0f} times"
    if not times and abs(value) > 360:
        return f"{value / 360:+.1f} turns".replace("-", "\N{MINUS SIGN}")
    text = f"{value:+.0f}" if abs(value) >= 10 else f"{value:+.1f}" if abs(value) >= 0.95 else f"{value:+.2f}"
    return text.replace("-", "\N{MINUS SIGN}")


@styled
def with_amplitude(found: Symptoms) -> Figure:
    """Frequency and damping ratio of every band against amplitude, while nothing drives the arm.

    Args:
        found: with free motion in at least one recording.
    """
    groups = _groups(found)
    nothing = "Frequency and damping change with amplitude as they do in the model"
    page = titled(title_of(found, _TREND_KINDS, nothing), [Row(1.7, len(groups)), Row(1.7, len(groups), gap=0.45)])
    for column, (mode, own) in enumerate(groups):
        scale, unit = (1e3, "mm") if own[0].unit == "m" else (float(np.degrees(1.0)), "deg")
        amplitude = scale * np.concatenate([each.amplitude for each in own])
        frequency = np.concatenate([each.frequencies for each in own])
        damping = np.concatenate([each.decays for each in own]) / (2 * np.pi * frequency[:, 1:])
        frequency_std = np.concatenate([each.frequency_std for each in own])
        damping_std = np.concatenate([each.decay_std for each in own]) / (2 * np.pi * frequency[:, 1])
        upper, lower = page.axes[0][column], page.axes[1][column]
        _draw_trend(upper, amplitude, frequency, frequency_std, power=2)
        _draw_trend(lower, amplitude, damping, damping_std, power=1)
        upper.set_ylabel("frequency [Hz]")
        lower.set_ylabel("damping ratio [1]")
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(f"amplitude [{unit}]")
        panel_title(
            upper,
            f"mode at {number(found.frequencies[mode], 3)} Hz, {number(float(len(own)), 1)} recordings"
            if len(own) > 1
            else f"mode at {number(found.frequencies[mode], 3)} Hz",
        )
    page.legend(
        [
            Line2D(
                [], [], linestyle="", marker="o", color=MEASURED, markerfacecolor="white", label="measured, with error"
            ),
            Line2D([], [], color=IDENTIFIED, label="model"),
        ]
    )
    return page.figure


def has_free_motion(found: Symptoms) -> bool:
    """Whether there is anything to draw of frequency and damping against amplitude."""
    return bool(_groups(found))


def _groups(found: Symptoms) -> list[tuple[int, list[FreeMotion]]]:
    """Modes and their free motions in one unit, most points first; at most three, slowest first."""
    every = [motion for each in found.recordings for motion in each.free]
    groups = []
    for mode in range(len(found.frequencies)):
        own = [motion for motion in every if motion.mode == mode]
        own = [motion for motion in own if motion.unit == own[0].unit]
        if sum(motion.time.size for motion in own) >= 3:
            groups.append((mode, own))
    groups.sort(key=lambda group: -sum(motion.time.size for motion in group[1]))
    return sorted(groups[:_MOST_BANDS], key=lambda group: group[0])


def _draw_trend(axes: Axes, amplitude: Array, pairs: Array, std: Array, power: int) -> None:
    """Measured and simulated values (P, 2): the model's trend, and what is measured beside it.

    What leaks into the windows from other motion is the same in both, and goes with their difference. Neighbours in
    amplitude are averaged by their errors.
    """
    line = np.stack([np.ones_like(amplitude), (amplitude / amplitude.max()) ** power], axis=1)
    model = line @ np.linalg.lstsq(line / std[:, None], pairs[:, 1] / std, rcond=None)[0]
    values = np.stack([model + pairs[:, 0] - pairs[:, 1], model], axis=1)
    order = np.argsort(amplitude)
    parts = np.array_split(order, min(_MOST_POINTS, order.size))
    weights = [std[part] ** -2.0 for part in parts]
    place = np.array([np.average(amplitude[part], weights=w) for part, w in zip(parts, weights, strict=True)])
    means = np.array([np.average(values[part], axis=0, weights=w) for part, w in zip(parts, weights, strict=True)])
    errors = np.array(
        [max(_scatter(values[part, 0], w), np.sum(w) ** -0.5) for part, w in zip(parts, weights, strict=True)]
    )
    clear = errors <= _CLEAR * np.median(errors)
    place, means, errors = place[clear], means[clear], errors[clear]
    axes.plot(place, means[:, 1], color=IDENTIFIED, linewidth=1.3)
    look: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 5, "color": MEASURED}
    axes.errorbar(place, means[:, 0], yerr=errors, elinewidth=1.1, markerfacecolor="white", **look)
    low, high = axes.get_ylim()
    least = _LEAST_RANGE * float(np.abs(means).mean())  # or nothing but noise is magnified
    if high - low < least:
        axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
    axes.set_xscale("log")
    low, high = float(place.min()), float(place.max())
    axes.set_xlim(low / 1.15, high * 1.15)
    log_ticks(axes.xaxis)
    axes.ticklabel_format(axis="y", useOffset=False)


def _scatter(values: Array, weights: Array) -> float:
    """Standard error of a weighted mean from the values' own scatter."""
    if values.size < 3:
        return 0.0
    mean = np.average(values, weights=weights)
    return float(np.sqrt(np.average((values - mean) ** 2, weights=weights) / (values.size - 1)))


MOST_SHOWN = 3
_MOST_LAGS = 24
_ROW_SYMPTOM_MOTION = 0.34  # inches a recording
_STRETCH = "#fbe3c8"


class _Shown(NamedTuple):
    """A measured coordinate: instants (F,) [s], measured and simulated (F,), their name and unit, and the noise."""

    time: Array
    measured: Array
    simulated: Array
    name: str
    unit: str
    noise: float


def title_of(found: Symptoms, kinds: tuple[str, ...], otherwise: str) -> str:
    """The largest symptom of some kinds in words, without a full stop; else what to say where there is none."""
    first = next((each for each in found.headlines(len(found.found)) if each.kind in kinds), None)
    return otherwise if first is None else first.sentence.removesuffix(".")


def titled(title: str, rows: Sequence[Row], left: float | None = None) -> Sheet:
    """A sheet whose title, a sentence with broad letters perhaps, does not leave the page.

    Args:
        title: wrapped.
        rows: from the top.
        left: room for labels [inches].
    """
    page = sheet(title, rows) if left is None else sheet(title, rows, left=left)
    text = page.figure.texts[0]
    room = page.figure.bbox.width - 2 * text.get_window_extent().x0
    width = text.get_window_extent().width
    if width > room:
        text.set_fontsize(text.get_fontsize() * room / width)
    return page


def worst(found: Symptoms) -> list[Examined]:
    """The recordings with motion whose mean square residual, in units of the noise, is largest; one of each repeat."""
    moving = [each for each in found.recordings if each.bands is not None and _signal(each) is not None]
    moving.sort(key=lambda each: -each.misfit / max(sum(int(s.known.sum()) for s in each.sensors), 1))
    seen: set[str] = set()
    kept = []
    for each in moving:
        label = each.followed.recording.repeat
        if label is None or label not in seen:
            kept.append(each)
        if label is not None:
            seen.add(label)
    first = next((each.recording for each in found.headlines(len(found.found)) if each.recording is not None), None)
    shown = [each for each in kept if each.followed.recording.file == first]
    return [*shown[:1], *(each for each in kept if each not in shown[:1])][:MOST_SHOWN]


@styled
def overview(found: Symptoms) -> Figure:
    """Measured and simulated tip where it is worst, and the residual of the whole recording below.

    Args:
        found: with at least one recording in which something moves.
    """
    shown = worst(found)
    largest: Symptom | None = next(iter(found.headlines(1)), None)
    nothing = "The model follows every recording to within what noise explains"
    rows = [Row(1.9, len(shown)), Row(1.25, len(shown), gap=0.8)]
    page = titled(nothing if largest is None else largest.sentence.removesuffix("."), rows)
    for column, each in enumerate(shown):
        signal = _signal(each)
        if signal is not None:
            _draw(page.axes[0][column], page.axes[1][column], each, signal)
    page.legend(
        [
            Line2D([], [], color="#bdbdbd", linewidth=4.0, solid_capstyle="round", label="measured"),
            Line2D([], [], color=IDENTIFIED, label="model"),
            Line2D([], [], color=NOMINAL, linewidth=1.0, label="measured less model"),
            Patch(color=_STRETCH, label="the stretch shown above"),
            Patch(color=BAND, label="±2σ noise"),
        ]
    )
    return page.figure


def _signal(each: Examined) -> _Shown | None:
    followed = each.followed
    tip = tip_signal(followed.rig, followed.recording)
    if tip is not None:
        rows = np.isfinite(followed.recording.markers[:, tip.marker, tip.axis])
        name = f"{marker_name(followed.rig, tip.marker)}.{'xy'[tip.axis]}"
        simulated = followed.markers[rows, tip.marker, tip.axis]
        return _Shown(tip.time, 1e3 * tip.value, 1e3 * simulated, name, "mm", 1e3 * followed.noise[0])
    encoder = next((sensor for sensor in each.sensors if sensor.sensor == "encoder"), None)
    if encoder is None:
        return None
    rows, scale = encoder.known[:, 0], float(np.degrees(1.0))
    measured, simulated = scale * encoder.measured[rows, 0], scale * encoder.simulated[rows, 0]
    return _Shown(encoder.time[rows], measured, simulated, encoder.names[0], "deg", scale * encoder.noise)


def _draw(upper: Axes, lower: Axes, each: Examined, signal: _Shown) -> None:
    residual = signal.measured - signal.simulated
    start, stop = liveliest_window(signal.time, residual)
    inside = (signal.time >= start) & (signal.time <= stop)
    upper.plot(signal.time[inside], signal.measured[inside], color="#bdbdbd", linewidth=4.0, solid_capstyle="round")
    upper.plot(signal.time[inside], signal.simulated[inside], color=IDENTIFIED, linewidth=1.2)
    whole = stop - start > 0.99 * (signal.time[-1] - signal.time[0])
    panel_title(upper, f"{short(each.followed.recording.file, 18)}{'' if whole else ', worst stretch'}")
    lower.axvspan(start, stop, color=_STRETCH, linewidth=0)
    lower.axhspan(-2 * signal.noise, 2 * signal.noise, color=BAND, linewidth=0)
    lower.plot(signal.time, residual, color=NOMINAL, linewidth=0.9)
    lower.axhline(0.0, color="#444444", linewidth=0.6)
    for axes, what in ((upper, short(signal.name, 16)), (lower, "residual")):
        axes.set_xlabel("time [s]")
        axes.set_ylabel(f"{printable(what)} [{signal.unit}]", labelpad=2)
    panel_title(lower, f"{number(float(np.sqrt(np.mean(residual**2))) / signal.noise, 2)} times the noise")


@styled
def lags(found: Symptoms) -> Figure:
    """Delay of the camera and of the encoders against the model, and of the one against the other.

    Args:
        found: with at least one recording that shows both.
    """
    shown: list[tuple[Examined, Lag]] = [(each, each.lag) for each in found.recordings if each.lag is not None]
    shown.sort(key=lambda pair: pair[1].lag.std)
    shown = shown[:_MOST_LAGS]
    pooled = found.lag
    within = number(1e3 * (abs(pooled.value) + 2 * pooled.std), 2)
    title = title_of(found, ("camera_lag",), f"Camera and encoders tell the same time, to within {within} ms")
    page = titled(title, [Row(max(_ROW_SYMPTOM_MOTION * len(shown), 0.7))], left=2.2)
    axes = page.axes[0][0]
    places = np.arange(len(shown))[::-1]
    axes.axvspan(
        1e3 * (pooled.value - 2 * pooled.std), 1e3 * (pooled.value + 2 * pooled.std), color="#c9d6e6", linewidth=0
    )
    axes.axvline(0.0, color="#444444", linewidth=0.8)
    for estimates, offset, color, marker, filled in (
        ([lag.camera for _, lag in shown], 0.22, MEASURED, "o", False),
        ([lag.encoder for _, lag in shown], -0.22, TORQUE, "s", False),
        ([lag.lag for _, lag in shown], 0.0, IDENTIFIED, "D", True),
    ):
        axes.errorbar(
            [1e3 * each.value for each in estimates],
            places + offset,
            xerr=[2e3 * each.std for each in estimates],
            linestyle="",
            marker=marker,
            markersize=4.5,
            color=color,
            markerfacecolor=color if filled else "white",
            elinewidth=1.1,
        )
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [printable(short(each.followed.recording.file, 22)) for each, _ in shown])
    axes.grid(False, axis="y")
    axes.set_xlabel("delay, two standard errors [ms]")
    axes.set_ylabel("recording", labelpad=6)
    page.legend(
        [
            Line2D(
                [], [], linestyle="", marker="o", color=MEASURED, markerfacecolor="white", label="camera against model"
            ),
            Line2D(
                [], [], linestyle="", marker="s", color=TORQUE, markerfacecolor="white", label="encoder against model"
            ),
            Line2D([], [], linestyle="", marker="D", color=IDENTIFIED, label="camera against encoder"),
            Patch(color="#c9d6e6", label="all recordings together"),
        ]
    )
    return page.figure


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
    _draw_symptom_profiles(axes[0], place * points.position, scale * (rest + parts[0]))
    _draw_symptom_profiles(axes[1], place * points.velocity, scale * (rest + parts[1] + parts[2]))
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


def _draw_symptom_profiles(axes: Axes, place: Array, values: Array) -> None:
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


_MOST_PANELS = 4
_DASHES = (0, (4, 2))
_KINDS_SYMPTOM_QUIET = ("tone", "quiet_size", "quiet_colour")


def shown(found: Symptoms) -> list[tuple[Quiet, Spectrum]]:
    """Sensors at rest whose spectrum can be drawn, at most four."""
    pairs = [(quiet, quiet.spectrum) for each in found.recordings for quiet in each.quiet]
    return [(quiet, spectrum) for quiet, spectrum in pairs if spectrum is not None][:_MOST_PANELS]


@styled
def quiet(found: Symptoms) -> Figure:
    """Amplitude spectra of the sensors at rest, beside the noise that was supposed.

    Args:
        found: with at least one quiet recording.
    """
    panels = shown(found)
    files = {found.recordings[each.recording].followed.recording.file for each, _ in panels}
    largest = next((s for s in found.significant if s.kind in _KINDS_SYMPTOM_QUIET and s.recording in files), None)
    nothing = "At rest, the sensors show white noise of the size that was supposed"
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    title = nothing if largest is None else largest.sentence.removesuffix(".")
    page = titled(title, [Row(1.9, columns, gap=0.8) for _ in range(rows)])
    every = [axes for row in page.axes for axes in row]
    for unused in every[len(panels) :]:
        unused.remove()
    for axes, (each, spectrum) in zip(every, panels, strict=False):
        _draw_symptom_quiet(axes, each, spectrum)
        file = found.recordings[each.recording].followed.recording.file
        panel_title(axes, f"{short(file, 18)}, {each.channels.sensor}: {_words(each)}")
    page.legend(
        [
            Line2D([], [], color=IDENTIFIED, label="residual at rest"),
            Line2D([], [], color=MEASURED, linewidth=1.6, label="white noise as supposed"),
            Line2D([], [], color=MEASURED, linestyle=_DASHES, label="its limit (99.9 %)"),
            Line2D([], [], linestyle="", marker="v", color=NOMINAL, label="a tone"),
        ]
    )
    return page.figure


def _words(each: Quiet) -> str:
    size = f"{number(1 + each.size.value, 3)} times the noise"
    return size if each.tone is None else f"{size}, tone at {number(each.tone.frequency.value, 3)} Hz"


def _draw_symptom_quiet(axes: Axes, each: Quiet, spectrum: Spectrum) -> None:
    scale, unit = (1e6, "µm") if each.channels.unit == "m" else (1e6, "µrad")
    axes.plot(spectrum.frequency, scale * spectrum.amplitude, color=IDENTIFIED, linewidth=0.8)
    axes.axhline(scale * spectrum.white, color=MEASURED, linewidth=1.6)
    axes.axhline(scale * spectrum.limit, color=MEASURED, linestyle=_DASHES, linewidth=1.1)
    if each.tone is not None:
        at = int(np.argmin(np.abs(spectrum.frequency - each.tone.frequency.value)))
        height = 1.25 * scale * float(spectrum.amplitude[at])
        axes.plot([each.tone.frequency.value], [height], marker="v", color=NOMINAL)
    axes.set_yscale("log")
    low = 0.8 * float(np.quantile(spectrum.amplitude, 0.02))
    axes.set_ylim(scale * low, 1.6 * scale * max(spectrum.limit, float(spectrum.amplitude.max())))
    axes.set_xlim(0.0, float(spectrum.frequency[-1]))
    log_ticks(axes.yaxis)
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"amplitude [{unit}]")


# Every file name that these pictures may have.
NAMES = (
    "symptom_overview",
    "symptom_bands",
    "symptom_amplitude",
    "symptom_profiles",
    "symptom_lag",
    "symptom_quiet",
)


def symptom_pictures(found: Symptoms) -> list[Picture]:
    """All pictures that the recordings have something for.

    Args:
        found: the symptoms.
    """
    return list(_pictures(found))


def _pictures(found: Symptoms) -> Iterator[Picture]:
    if worst(found):
        caption = (
            "The recordings that the model follows worst, and what it leaves of them: a residual that grows is a wrong "
            "frequency, one that keeps the motion's shape a wrong size or time."
        )
        yield _picture("symptom_overview", caption, overview(found))
    if any(each.bands is not None and each.bands.bands for each in found.recordings):
        caption = (
            "How far each vibration is off in amplitude and phase: a column of one colour is off in every recording, a "
            "row of one colour is that recording's own."
        )
        yield _picture("symptom_bands", caption, bands(found))
    if has_free_motion(found):
        caption = (
            "Frequency and damping while nothing drives the arm: where the measured ones are not on the model's line, "
            "they are off; where they have another slope, they depend on amplitude as the model does not."
        )
        yield _picture("symptom_amplitude", caption, with_amplitude(found))
    if chosen(found):
        caption = (
            "What the model misses against position, velocity and direction, each without what the other two explain: "
            "a slope goes with the motion, a step in the middle changes with its direction."
        )
        yield _picture("symptom_profiles", caption, profiles(found))
    if any(each.lag is not None for each in found.recordings):
        caption = "Delay of each sensor against the model: dark marks off the zero line are two clocks that disagree."
        yield _picture("symptom_lag", caption, lags(found))
    if shown(found):
        caption = "The sensors at rest: a line above the dashed one is no noise, a slope is noise that is not white."
        yield _picture("symptom_quiet", caption, quiet(found))


def _picture(name: str, caption: str, figure: Figure) -> Picture:
    return Picture(name, caption, figure.texts[0].get_text().replace("\n", " ").replace(r"\$", "$"), png(figure))
