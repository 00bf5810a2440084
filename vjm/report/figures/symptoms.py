"""Pictures of the symptoms: what is wrong, before any cause is named."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from vjm.diagnosis.symptoms import RecordingSymptoms, Symptoms
from vjm.diagnosis.symptoms.channels import Coefficient, SensorAtRest
from vjm.diagnosis.symptoms.joints import JointProfile
from vjm.diagnosis.symptoms.modes import FreeMotion, ModeDifference
from vjm.records import Array
from vjm.report.figures.panels import Curve, motion_panel, residual_panel
from vjm.report.figures.selection import Signal, liveliest_window
from vjm.report.figures.style import (
    AXIS,
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    TORQUE,
    Page,
    Picture,
    line_styles,
    log_scale,
    printable,
    readable_on,
    styled,
)  # fmt: skip
from vjm.report.text import number, short

# Every file name that these pictures may have.
NAMES = tuple(f"symptom_{name}" for name in ("overview", "bands", "amplitude", "profiles", "lag", "quiet"))
_MOST_ROWS = 24  # recordings on a page: more could not be read
_DOTS, _POOLED = "#cfcfcf", "#c9d6e6"
_UNITS = {"m": (1e3, "mm"), "rad": (float(np.degrees(1.0)), "deg"), "N m": (1e3, "mN m")}


def symptom_pictures(found: Symptoms) -> list[Picture]:
    """Draw all pictures that the recordings have something for."""
    drawn: list[tuple[str, str, Callable[[Symptoms], Figure], object]] = [
        ("overview", "The recordings that the model follows worst, and their residuals: one that grows is a wrong "
         "frequency, one that keeps the motion's shape a wrong size or time.", _overview, _worst(found)),
        ("bands", "Each mode, measured against the model: a column of one colour is off in every recording, a row of "
         "one colour is that recording's own.", _modes, [one for one in found.recordings if one.modes.modes]),
        ("amplitude", "Frequency and damping while nothing drives the arm, one curve a condition: marks beside their "
         "line are off; marks with another slope depend on amplitude as the model does not.", _with_amplitude,
         _free_motion(found)),
        ("profiles", "Residuals against position, velocity and direction, each without what the other two explain: a "
         "slope goes with the motion, a step changes with its direction.", _profiles, _profiles_shown(found)),
        ("lag", "Delay of each sensor against the model: dark marks off the zero line are two clocks that disagree.",
         _lags, _with_lag(found)),
        ("quiet", "The sensors at rest: a line above the dashed one is no noise, a slope is noise that is not white.",
         _quiet, _at_rest(found)),
    ]  # fmt: skip
    pictures = []
    for name, caption, draw, something in drawn:
        if something:
            pictures.append(Picture(f"symptom_{name}", caption, draw(found)))
    return pictures


def _page(found: Symptoms, kinds: Sequence[str], otherwise: str, rows: Sequence[tuple[float, int]]) -> Page:
    """Make a page titled by the largest symptom of some kinds (none: of any), or by other words without any."""
    symptoms = found.headlines(len(found.found))
    first = next((one.sentence for one in symptoms if one.kind in kinds or not kinds), otherwise)
    return Page.of(first.removesuffix("."), rows)


def _file(one: RecordingSymptoms, most: int) -> str:
    return printable(short(one.simulated.recording.file, most))


def _worst(found: Symptoms) -> list[RecordingSymptoms]:
    """Return the recording of the first symptom, then those with the largest residuals; one of each repeat."""
    moving = [one for one in found.recordings if one.modes.remaining]
    moving.sort(key=lambda one: -one.misfit / max(sum(int(s.known.sum()) for s in one.sensors), 1))
    first = next((one.recording for one in found.headlines(len(found.found)) if one.recording is not None), None)
    moving.sort(key=lambda one: one.simulated.recording.file != first)
    kept: dict[str, RecordingSymptoms] = {}
    for one in moving:
        recording = one.simulated.recording
        kept.setdefault(recording.repeat or f"file {recording.file}", one)
    return list(kept.values())[:3]


@styled
def _overview(found: Symptoms) -> Figure:
    """Draw the measured and simulated tip where it is worst, and the residual of the whole recording below."""
    shown = _worst(found)
    rows = [(2.4, len(shown)), (1.8, len(shown))]
    page = _page(found, (), "The model follows every recording to within what noise explains", rows)
    for upper, lower, one in zip(*page.axes, shown, strict=True):
        signal = Signal.of(found.rig, one.simulated.recording)
        if signal is None:  # a recording that moves was measured
            continue
        residual = signal.residual(one.simulated)
        window = liveliest_window(signal.time, np.nan_to_num(residual))
        curve = Curve(one.simulated, "model", {"color": IDENTIFIED, "linestyle": "-"})
        motion_panel(upper, signal, [curve], window, most_circles=0)
        whole = window[1] - window[0] > 0.99 * (signal.time[-1] - signal.time[0])
        upper.set_title(f"{_file(one, 18)}{'' if whole else ', worst stretch'}")
        curve = Curve(one.simulated, "measured minus model", {"color": NOMINAL})
        residual_panel(lower, signal, [curve], one.simulated.noise, [window])
        noise = one.simulated.noise[0 if signal.is_marker else 1]
        lower.set_title(f"{number(float(np.sqrt(np.nanmean(residual**2))) / noise, 2)} times the noise")
    page.legend()
    return page.figure


@styled
def _modes(found: Symptoms) -> Figure:
    """Draw frequency, damping, amplitude and phase of every mode and recording, measured against simulated."""
    rows = [one for one in found.recordings if one.modes.modes][:_MOST_ROWS]
    modes = sorted({mode.mode for one in rows for mode in one.modes.modes})[:3]
    nothing = "Frequency, damping, amplitude and phase of all modes are as simulated"
    kinds = ("frequency", "damping", "amplitude", "phase", "slow_amplitude", "slow_delay")
    page = _page(found, kinds, nothing, [(0.8 + 0.28 * max(len(rows), 2), 1)])
    axes, start, ticks, colors = page.axes[0][0], 0.0, {}, colormaps["PuOr_r"]
    values: Sequence[tuple[str, Callable[[ModeDifference], float]]] = (
        ("frequency [%]", lambda mode: 100 * _sure(mode.frequency)),
        ("damping ratio [10⁻³]", lambda mode: 1e3 * _sure(mode.damping)),
        ("amplitude [%]", lambda mode: 100 * np.expm1(_sure(mode.gain))),
        ("phase [deg]", lambda mode: np.degrees(_sure(mode.phase))),
    )
    for title, value in values:
        table = np.full((len(rows), max(len(modes), 2) + (title[:3] == "amp")), np.nan)
        for r, one in enumerate(rows):
            for mode in one.modes.modes:
                if mode.mode in modes:
                    table[r, modes.index(mode.mode)] = value(mode)
            if title[:3] == "amp" and one.modes.slow_gain.known:
                table[r, -1] = 100 * _sure(one.modes.slow_gain)
        names = [_frequency(found, mode, 2) for mode in modes] + ["rest"] * (title[:3] == "amp")
        _draw_table(axes, start, table[:, -len(names) :] if len(modes) > 1 else table[:, [0, -1][: len(names)]])
        axes.text(start, -0.12, title, va="bottom", fontsize=8.5, color="#333333")
        ticks.update({start + 0.5 + k: name for k, name in enumerate(names)})
        start += table.shape[1] + 0.4
    axes.set_xlim(0, start - 0.4)
    axes.set_ylim(len(rows), 0)
    axes.set_xticks(list(ticks), list(ticks.values()))
    axes.set_yticks(np.arange(len(rows)) + 0.5, [_file(one, 22) for one in rows])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.grid(False)
    axes.set_xlabel("mode, and the motion outside the modes [Hz]")
    axes.set_ylabel("recording")
    words = ((colors(0.95), "more than the model"), ("white", "0: as the model, within three standard errors"),
             (colors(0.05), "less"), (BAND, "does not move"))  # fmt: skip
    page.legend([Patch(facecolor=color, edgecolor="#bbbbbb", label=word) for color, word in words])
    return page.figure


def _frequency(found: Symptoms, mode: int, digits: int) -> str:
    """Write the frequency of a mode in the simulated motion, that of most recordings where it differs."""
    values = [each.simulated for one in found.recordings for each in one.modes.modes if each.mode == mode]
    values = values or [float(f) for one in found.recordings for each in one.modes.free for f in each.rates[:, 1, 0]]
    return number(float(np.median(values)), digits)


def _sure(value: Coefficient) -> float:
    return value.value if abs(value.value) > 3 * value.std else 0.0


def _draw_table(axes: Axes, start: float, table: Array) -> None:
    """Draw coloured numbers, on a colour scale of their own."""
    largest = float(np.nanmax(np.abs(table), initial=1e-12))
    shade = np.sign(table) * np.sqrt(np.abs(table) / largest)  # small ones show as well
    columns, rows = np.arange(table.shape[1] + 1) + start, np.arange(len(table) + 1)
    colors = colormaps["PuOr_r"].with_extremes(bad=BAND)
    axes.pcolormesh(columns, rows, shade, cmap=colors, vmin=-1, vmax=1, edgecolors="#bbbbbb", linewidth=0.6)
    for (row, column), value in np.ndenumerate(table):
        if np.isfinite(value):
            letters = readable_on(colors(0.5 + 0.5 * float(shade[row, column])))
            place = {"x": start + column + 0.5, "y": row + 0.5, "s": _signed(value)}
            axes.text(**place, ha="center", va="center", fontsize=8, color=letters)


def _signed(value: float) -> str:
    if abs(value) < 5e-3:
        return "0"
    digits = 0 if abs(value) >= 10 else 1 if abs(value) >= 0.95 else 2
    return f"{value:+.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _free_motion(found: Symptoms) -> dict[int, dict[str, list[FreeMotion]]]:
    """Return free motion in one unit, by mode and condition; of the modes with most points, at most three."""
    modes: dict[int, dict[str, list[FreeMotion]]] = {}
    for one in found.recordings:
        for free in one.modes.free:
            groups = modes.setdefault(free.mode, {})
            if all(other[0].unit == free.unit for other in groups.values()):
                groups.setdefault(free.condition, []).append(free)
    counts = {mode: sum(f.time.size for own in groups.values() for f in own) for mode, groups in modes.items()}
    kept = sorted(sorted(modes, key=lambda mode: -counts[mode])[:3])
    return {mode: modes[mode] for mode in kept}


@styled
def _with_amplitude(found: Symptoms) -> Figure:
    """Draw frequency and damping ratio of every mode against amplitude, while nothing drives the arm."""
    modes = _free_motion(found)
    conditions = list(dict.fromkeys(condition for groups in modes.values() for condition in groups))
    looks = dict(zip(conditions, line_styles(len(conditions)), strict=True))
    markers = dict(zip(conditions, "osD^v<>ph*" * len(conditions), strict=False))
    nothing = "Frequency and damping are as in the model, and change with amplitude as they do there"
    kinds = ("frequency", "damping", "frequency_with_amplitude", "damping_with_amplitude")
    page = _page(found, kinds, nothing, [(2.1, len(modes)), (2.35, len(modes))])
    for column, (mode, groups) in enumerate(modes.items()):
        upper, lower = page.axes[0][column], page.axes[1][column]
        every = [free for own in groups.values() for free in own]
        scale, unit = _UNITS[every[0].unit]
        for condition, own in groups.items():
            amplitude = scale * np.concatenate([free.amplitude for free in own])
            std = np.concatenate([free.std for free in own])
            for axes, j in ((upper, 0), (lower, 1)):
                pairs = np.concatenate([free.rates[..., j] for free in own])
                scaled = std[:, j]
                if not j:  # in per cent of the model's at the smallest amplitude, conditions lie on one axis
                    first = pairs[np.argmin(amplitude), 1]
                    pairs, scaled = 100 * (pairs / first - 1), 100 * scaled / first
                _draw_trend(axes, amplitude, pairs, scaled, 2 - j, looks[condition] | {"marker": markers[condition]})
        for axes in (upper, lower):
            low, high = axes.get_ylim()
            least = 0.05 if axes is upper else 2e-5  # per cent, and a ratio: or nothing but noise is magnified
            if high - low < least:
                axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))
            largest = scale * np.concatenate([free.amplitude for free in every])
            log_scale(axes.xaxis, float(largest.min()) / 1.15, float(largest.max()) * 1.15)
            axes.ticklabel_format(axis="y", useOffset=False)
        upper.set_ylabel("frequency, off the model's [%]")
        lower.set_ylabel("damping ratio [1]")
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(f"amplitude [{unit}]")
        upper.set_title(printable(f"mode at {_frequency(found, mode, 3)} Hz"))
    handles = [
        Line2D([], [], color=MEASURED, linestyle="", marker="o", markerfacecolor="white", label="measured, with error"),
        Line2D([], [], color=MEASURED, label="model"),
    ]
    for condition in conditions if len(conditions) > 1 else ():
        name = printable(short(condition or "other recordings", 24))
        look: Any = looks[condition] | {"marker": markers[condition], "markerfacecolor": "white"}
        handles.append(Line2D([], [], label=name, **look))
    page.legend(handles)
    return page.figure


def _draw_trend(axes: Axes, amplitude: Array, pairs: Array, std: Array, power: int, look: dict[str, Any]) -> None:
    """Draw measured and simulated values (P, 2): the model's trend, and what is measured beside it.

    What other motion leaks into the windows is the same in both, and goes with their difference. Neighbours in
    amplitude are averaged by their errors.
    """
    line = np.stack([np.ones_like(amplitude), (amplitude / amplitude.max()) ** power], axis=1)
    model = line @ np.linalg.lstsq(line / std[:, None], pairs[:, 1] / std, rcond=None)[0]
    measured = model + pairs[:, 0] - pairs[:, 1]
    parts = np.array_split(np.argsort(amplitude), min(8, max(amplitude.size // 2, 1)))
    place, shown, errors = (np.empty(len(parts)) for _ in range(3))
    for k, part in enumerate(parts):
        weights = std[part] ** -2.0
        place[k], shown[k] = (float(np.average(v[part], weights=weights)) for v in (amplitude, measured))
        scatter = np.average((measured[part] - shown[k]) ** 2, weights=weights) / max(part.size - 1, 1)
        errors[k] = max(float(np.sum(weights) ** -0.5), float(np.sqrt(scatter)))
    clear = errors <= 4 * np.median(errors)  # of the others nothing could be seen
    order = np.argsort(amplitude)
    axes.plot(amplitude[order], model[order], **(look | {"marker": ""}))
    bars: Any = look | {"linestyle": "", "markersize": 5, "markerfacecolor": "white"}
    axes.errorbar(place[clear], shown[clear], yerr=errors[clear], elinewidth=1.1, **bars)


def _profiles_shown(found: Symptoms) -> list[JointProfile]:
    """Return the missing torque or acceleration in all recordings, and the residual that goes most with a motion."""

    def surest(profiles: Sequence[JointProfile]) -> list[JointProfile]:
        return sorted(profiles, key=lambda profile: min(one.p_value for one in profile.fit.changes))[:1]

    every = [profile for one in found.recordings for profile in one.profiles]
    torques = found.profiles or [profile for profile in every if profile.quantity != "residual"]
    return surest(list(torques)) + surest([profile for profile in every if profile.quantity == "residual"])


@styled
def _profiles(found: Symptoms) -> Figure:
    """Draw residuals against position, velocity and direction, each without what the two others explain."""
    shown = _profiles_shown(found)
    nothing = "What the model misses depends neither on where the arm is nor on how fast or which way it moves"
    kinds = ("against_angle", "against_velocity", "against_sign")
    page = _page(found, kinds, nothing, [(2.35, 3)] * len(shown))
    for axes, profile in zip(page.axes, shown, strict=True):
        _draw_profile(axes, found, profile)
    dots = Line2D([], [], linestyle="", marker=".", color=_DOTS, label="single values")
    means = Line2D([], [], linestyle="", marker="o", color=IDENTIFIED, label="means, two standard errors")
    page.legend([dots, means, Line2D([], [], color=NOMINAL, label="trend, or jump")])
    return page.figure


def _draw_profile(row: Sequence[Axes], found: Symptoms, profile: JointProfile) -> None:
    scale, unit = _UNITS.get(profile.unit, (1.0, profile.unit))
    if unit == "deg" and float(np.percentile(np.abs(profile.values), 80)) * scale < 0.1:
        scale, unit = 1e3, "mrad"
    place, motion = _UNITS[profile.motion_unit]
    fit = profile.fit
    remaining, (slope, rate, jump) = scale * fit.remaining, scale * fit.slopes
    parts = scale * (fit.parts - fit.parts.mean(axis=0))
    middle, position, velocity = profile.position.mean(), profile.position, profile.velocity
    ends = np.array([position.min(), position.max()])
    _draw_means(row[0], place * position, remaining + parts[:, 0])
    row[0].plot(place * ends, slope * (ends - middle), color=NOMINAL, zorder=2)
    _draw_means(row[1], place * velocity, remaining + parts[:, 1])
    ends = np.array([velocity.min(), velocity.max()])
    row[1].plot(place * ends, rate * (ends - velocity.mean()), color=NOMINAL, zorder=2)
    clear = np.abs(profile.direction) > 0.5
    side = np.sign(profile.direction[clear])
    _draw_means(
        row[2], side + 0.1 * np.random.default_rng(0).uniform(-1, 1, side.size), (remaining + parts[:, 2])[clear]
    )
    row[2].plot([-1.4, 0, 0, 1.4], 0.5 * jump * np.array([-1, -1, 1, 1]), color=NOMINAL, zorder=2)
    row[2].set_xlim(-1.6, 1.6)
    row[2].set_xticks([-1.0, 1.0], ["backwards", "forwards"])
    what = "missing torque" if profile.quantity == "torque" else profile.quantity
    for axes in row:
        axes.set_ylabel(f"{what} [{unit}]")
    row[0].set_xlabel(f"{printable(short(profile.motion, 16))} [{motion}]")
    row[1].set_xlabel(f"its velocity [{motion}/s]")
    row[2].set_xlabel("its direction [1]")
    several = np.unique(profile.recording).size > 1
    where = "all recordings" if several else _file(found.recordings[int(profile.recording[0])], 16)
    row[0].set_title(printable(f"{short(profile.sensor, 18)}, {where}"))


def _draw_means(axes: Axes, place: Array, values: Array) -> None:
    """Draw single values, and means over about as many each; on the third panel, over the two directions."""
    thin = slice(None, None, max(1, place.size // 600))
    axes.plot(place[thin], values[thin], ".", color=_DOTS, markersize=3, zorder=1)
    axes.axhline(0.0, color=AXIS, linewidth=0.6, zorder=1)
    two = set(np.round(place)) <= {-1.0, 1.0} and bool(np.all(np.abs(np.abs(place) - 1) <= 0.1))
    order = np.argsort(place)
    parts = [np.flatnonzero(place * s > 0) for s in (-1, 1)] if two else np.array_split(order, min(10, place.size // 6))
    parts = [part for part in parts if part.size > 2]
    means = np.array([values[part].mean() for part in parts])
    errors = np.array([2 * values[part].std() / np.sqrt(part.size - 1) for part in parts])
    centres = [place[part].mean() for part in parts]
    axes.errorbar(centres, means, yerr=errors, linestyle="", marker="o", markersize=4, color=IDENTIFIED, elinewidth=1.1)
    # The means are shown well; of the single values, those at the far ends may be cut off.
    means_reach = float((np.abs(means) + errors).max(initial=0.0))
    reach = max(1.25 * means_reach, 1.3 * float(np.percentile(np.abs(values), 80)), 1e-12)
    axes.set_ylim(-reach, reach)


def _with_lag(found: Symptoms) -> list[RecordingSymptoms]:
    known = [one for one in found.recordings if one.modes.camera_lag.known]
    known = [one for one in known if all(sensor.delay.known for sensor in one.sensors)]
    return sorted(known, key=lambda one: one.modes.camera_lag.std)[:_MOST_ROWS]


@styled
def _lags(found: Symptoms) -> Figure:
    """Draw the delay of camera and encoders against the model, and of the one against the other."""
    shown, lag = _with_lag(found), found.lag
    within = number(1e3 * (abs(lag.value) + 2 * lag.std), 2)
    nothing = f"Camera and encoders tell the same time, to within {within} ms"
    page = _page(found, ("camera_lag",), nothing, [(0.6 + 0.34 * max(len(shown), 2), 1)])
    axes, places = page.axes[0][0], np.arange(len(shown))[::-1]
    axes.axvspan(1e3 * (lag.value - 2 * lag.std), 1e3 * (lag.value + 2 * lag.std), color=_POOLED, linewidth=0)
    axes.axvline(0.0, color=AXIS, linewidth=0.8)
    handles: list[Line2D | Patch] = []
    against_encoder = [one.modes.camera_lag for one in shown]
    for label, delays, offset, color, marker, face in (
        ("camera against model", [one.sensors[0].delay for one in shown], 0.22, MEASURED, "o", "white"),
        ("encoder against model", [one.sensors[1].delay for one in shown], -0.22, TORQUE, "s", "white"),
        ("camera against encoder", against_encoder, 0.0, IDENTIFIED, "D", IDENTIFIED),
    ):
        look: Any = {"linestyle": "", "marker": marker, "color": color, "markerfacecolor": face}
        errors = [2e3 * delay.std for delay in delays]
        axes.errorbar([1e3 * d.value for d in delays], places + offset, xerr=errors, markersize=4.5, **look)
        handles.append(Line2D([], [], label=label, **look))
    axes.set_ylim(-0.6, len(shown) - 0.4)
    axes.set_yticks(places, [_file(one, 22) for one in shown])
    axes.grid(False, axis="y")
    axes.set_xlabel("delay, two standard errors [ms]")
    axes.set_ylabel("recording")
    page.legend([*handles, Patch(color=_POOLED, label="all recordings together")])
    return page.figure


def _at_rest(found: Symptoms) -> list[tuple[RecordingSymptoms, SensorAtRest]]:
    """Return the sensors at rest, at most four."""
    return [(one, rest) for one in found.recordings for rest in one.at_rest][:4]


@styled
def _quiet(found: Symptoms) -> Figure:
    """Draw amplitude spectra of the sensors at rest, beside the noise that was supposed."""
    panels = _at_rest(found)
    columns = min(2, len(panels))
    rows = [(2.5, columns)] * -(-len(panels) // columns)
    nothing = "At rest, the sensors show white noise of the size that was supposed"
    page = _page(found, ("quiet_tone", "noise_size", "noise_correlation"), nothing, rows)
    for axes, (one, rest) in zip(page.panels(len(panels)), panels, strict=True):
        _draw_spectrum(axes, rest)
        size = f"{number(1 + rest.size.value, 3)} times the noise"
        tone = "" if rest.tone is None else f", tone at {number(rest.tone.frequency, 3)} Hz"
        axes.set_title(printable(f"{_file(one, 18)}, {rest.channels.sensor}: {size}{tone}"))
    page.legend(
        [
            Line2D([], [], color=IDENTIFIED, label="residual at rest"),
            Line2D([], [], color=MEASURED, linewidth=1.6, label="white noise as supposed"),
            Line2D([], [], color=MEASURED, linestyle=(0, (4, 2)), label="its limit (99.9 %)"),
            Line2D([], [], linestyle="", marker="v", color=NOMINAL, label="a tone"),
        ]
    )
    return page.figure


def _draw_spectrum(axes: Axes, rest: SensorAtRest) -> None:
    scale, unit = (1e6, "µm") if rest.channels.unit == "m" else (1e6, "µrad")
    amplitude = scale * rest.amplitude
    axes.plot(rest.frequency, amplitude, color=IDENTIFIED, linewidth=0.8)
    axes.axhline(scale * rest.white, color=MEASURED, linewidth=1.6)
    axes.axhline(scale * rest.limit, color=MEASURED, linestyle=(0, (4, 2)), linewidth=1.1)
    if rest.tone is not None:
        at = int(np.argmin(np.abs(rest.frequency - rest.tone.frequency)))
        axes.plot([rest.tone.frequency], [1.25 * float(amplitude[at])], marker="v", color=NOMINAL)
    low, high = 0.8 * float(np.quantile(amplitude, 0.02)), 1.6 * max(scale * rest.limit, float(amplitude.max()))
    log_scale(axes.yaxis, low, high)
    axes.set_xlim(0.0, float(rest.frequency[-1]))
    axes.set_xlabel("frequency [Hz]")
    axes.set_ylabel(f"amplitude [{unit}]")
