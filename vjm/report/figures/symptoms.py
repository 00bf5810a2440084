"""Pictures of the symptoms: how recordings differ from the model without effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from vjm.diagnosis.symptoms import RecordingSymptoms, Symptoms
from vjm.diagnosis.symptoms.channels import Coefficient, SensorAtRest
from vjm.diagnosis.symptoms.joints import JointProfile
from vjm.diagnosis.symptoms.modes import FreeMotion, ModeDifference
from vjm.records import Array, RecordingComparison
from vjm.report.figures.panels import (
    DIVERGING,
    Color,
    PanelFigure,
    Picture,
    Spectrum,
    binned_means,
    draw_marks,
    heatmap,
    log_axis,
)
from vjm.report.figures.signals import Signal, liveliest_window, motion_figure, one_of_each_repeat
from vjm.text import number, ratio, short

_MOST_ROWS = 24  # recordings on a page: more could not be read
_DOTS, _POOLED = "#cfcfcf", "#c9d6e6"
_UNITS = {"m": (1e3, "mm"), "rad": (float(np.degrees(1.0)), "deg"), "N m": (1e3, "mN m")}


def symptom_pictures(symptoms: Symptoms) -> list[Picture]:
    """Return all pictures that the recordings have something for; each has a title of its own."""
    headlines, used_titles, pictures = symptoms.headlines(len(symptoms.found)), set[str](), []
    moving = sorted(
        (recording for recording in symptoms.recordings if recording.modes.remaining), key=_times_noise, reverse=True
    )
    worst = one_of_each_repeat(moving, lambda recording: recording.simulated.recording)[:3]
    overview = "The model follows every recording to within noise"
    if worst and headlines:
        size = number(_times_noise(worst[0]), 2)
        overview = f"Largest residual: {size} × noise over all sensors, in {_file(worst[0], 36)}"
    lag = number(1e3 * (abs(symptoms.lag.value) + 2 * symptoms.lag.std), 2)  # it may differ from zero by so much
    # Name, kinds of symptoms it shows, title without any, caption, function and content.
    table: list[tuple[str, Sequence[str], str, str, Callable[..., Figure], Any]] = [
        ("overview", (), overview,
         "Recordings with the largest residuals. A growing residual: wrong frequency; one shaped like the motion: "
         "wrong amplitude or time.", _overview, worst),
        ("bands", ("frequency", "damping", "amplitude", "phase", "slow_amplitude", "slow_delay"),
         "Frequency, damping, amplitude and phase of all modes agree with the model",
         "Modes, measured minus model; colours by significance. A column of one colour: off in every recording; a row: "
         "specific to that recording.",
         _modes, [recording for recording in symptoms.recordings if recording.modes.modes][:_MOST_ROWS]),
        ("amplitude", ("frequency", "damping", "frequency_with_amplitude", "damping_with_amplitude"),
         "Frequency and damping against amplitude agree with the model",
         "Frequency and damping in free motion, one curve for each condition. Marks beside their line: offset from the "
         "model; another slope: amplitude dependence that the model lacks.", _with_amplitude, _free_motion(symptoms)),
        ("profiles", ("against_angle", "against_velocity", "against_sign"),
         "Residual does not depend on position, velocity or direction",
         "Residual against position, velocity and direction, each corrected for the other two. Slope: spring or "
         "damper; step: dry friction.", _profiles, _profiles_shown(symptoms)),
        ("lag", ("camera_lag",), f"Camera and encoders are synchronous to within {lag} ms",
         "Delay of each sensor relative to the model. Dark marks off zero: camera and encoder clocks disagree.",
         _lags, _with_lag(symptoms)),
        ("quiet", ("quiet_tone", "noise_size", "noise_correlation"),
         "At rest, the sensors show white noise of the assumed size",
         "Sensors at rest. A line above the dashed one: a disturbance; a slope: coloured noise.",
         _quiet, _at_rest(symptoms)),
    ]  # fmt: skip
    for name, kinds, default_title, caption, draw, shown in table:
        if not shown:
            continue
        sentences = [symptom.sentence.removesuffix(".") for symptom in headlines if symptom.kind in kinds]
        subject = caption.partition(":")[0]  # where another figure has told all of them
        title = next(
            (sentence for sentence in sentences if sentence not in used_titles), subject if sentences else default_title
        )
        used_titles.add(title)
        pictures.append(Picture(f"symptom_{name}", caption, partial(draw, title, symptoms, shown)))
    return pictures


def _times_noise(recording: RecordingSymptoms) -> float:
    return float(np.sqrt(recording.misfit / max(sum(int(sensor.known.sum()) for sensor in recording.sensors), 1)))


def _file(recording: RecordingSymptoms, length: int) -> str:
    return short(recording.simulated.recording.file, length)


def _overview(title: str, symptoms: Symptoms, shown: Sequence[RecordingSymptoms]) -> Figure:
    drawn, headings = [], []
    for recording in shown:
        simulated = recording.simulated
        signal = Signal.of(symptoms.rig, simulated.recording)
        assert signal is not None  # a recording that moves was measured
        window = liveliest_window(signal.time, np.nan_to_num(signal.residual(simulated)))
        heading = f"{_file(recording, 18)}{'' if signal.is_whole(window) else ', largest residual'}"
        comparison = RecordingComparison(simulated.recording, simulated.noise, simulated)
        drawn.append((signal, comparison, [(window, heading)]))
        size = signal.rms(simulated) / simulated.noise[0 if signal.is_marker else 1]
        headings.append(f"{signal.name}: {number(size, 2)} × noise")
    return motion_figure(title, drawn, {"simulated": "model"}, headings=headings)


def _modes(title: str, symptoms: Symptoms, rows: Sequence[RecordingSymptoms]) -> Figure:
    modes = sorted({mode.mode for recording in rows for mode in recording.modes.modes})[:3]
    page, colors = PanelFigure.of(title, [(0.85 + 0.28 * max(len(rows), 2), 4)]), DIVERGING
    kinds: Sequence[tuple[str, Callable[[ModeDifference], Coefficient], Callable[[float], float]]] = (
        ("frequency [%]", lambda mode: mode.frequency, lambda value: 100 * value),
        ("damping ratio [10⁻³]", lambda mode: mode.damping, lambda value: 1e3 * value),
        ("amplitude [%]", lambda mode: mode.gain, lambda value: 100 * float(np.expm1(value))),
        ("phase [°]", lambda mode: mode.phase, lambda value: float(np.degrees(value))),
    )
    for k, (axes, (heading, estimate, scaled)) in enumerate(zip(page.axes[0], kinds, strict=True)):
        rest_column = ["rest"] if heading.startswith("amplitude") else []  # the motion outside the modes
        table = np.full((len(rows), len(modes) + len(rest_column)), np.nan)
        levels = table.copy()
        for row, recording in enumerate(rows):
            cells = {modes.index(mode.mode): estimate(mode) for mode in recording.modes.modes if mode.mode in modes}
            if rest_column and recording.modes.slow_gain.known:
                cells[len(modes)] = recording.modes.slow_gain
            for column, value in cells.items():
                table[row, column] = (100 * _sure(value)) if column == len(modes) else scaled(_sure(value))
                levels[row, column] = _significance(value)
        names = [_frequency(symptoms, mode, 2) for mode in modes] + rest_column
        files = [_file(recording, 22) for recording in rows]
        heatmap(axes, table, (colors, Normalize(-1.0, 1.0)), (files, names), _signed, 8.0, levels)
        axes.tick_params(labelleft=k == 0)
        axes.set(title=heading, xlabel="mode, or rest of motion [Hz]" if rest_column else "mode [Hz]")
    page.axes[0][0].set_ylabel("recording")
    equal = "0: within three standard errors"
    areas = {"above the model": colors(0.99), equal: colors(0.5), "below": colors(0.01), "no motion": Color.BAND}
    return page.finish(areas=areas)


def _frequency(symptoms: Symptoms, mode: int, digits: int) -> str:
    """Write the frequency of a mode in the simulated motion, that of most recordings where it differs."""
    values = [
        motion.simulated for recording in symptoms.recordings for motion in recording.modes.modes if motion.mode == mode
    ]
    values = values or [
        float(f) for recording in symptoms.recordings for motion in recording.modes.free for f in motion.rates[:, 1, 0]
    ]
    return number(float(np.median(values)), digits)


def _sure(value: Coefficient) -> float:
    return value.value if abs(value.value) > 3 * value.std else 0.0


def _significance(value: Coefficient) -> float:
    """Return a signed shade: 0 within three standard errors, 0.2 beyond, 1 at a hundred times as much."""
    times = abs(value.value) / max(3 * value.std, 1e-300)
    return 0.0 if times <= 1 else float(np.copysign(min(0.2 + 0.4 * np.log10(times), 1.0), value.value))


def _signed(value: float) -> str:
    if abs(value) < 5e-3:
        return "0"
    digits = 0 if abs(value) >= 10 else 1 if abs(value) >= 0.95 else 2
    return f"{value:+.{digits}f}".replace("-", "\N{MINUS SIGN}")


_FreeMotions = dict[int, dict[str, list[FreeMotion]]]


def _free_motion(symptoms: Symptoms) -> _FreeMotions:
    """Return free motion in one unit, by mode and condition; of the modes with most points, at most three."""
    modes: _FreeMotions = {}
    for recording in symptoms.recordings:
        for free in recording.modes.free:
            groups = modes.setdefault(free.mode, {})
            if all(group[0].unit == free.unit for group in groups.values()):
                groups.setdefault(free.condition, []).append(free)
    counts = {mode: sum(f.time.size for group in groups.values() for f in group) for mode, groups in modes.items()}
    chosen = sorted(sorted(modes, key=lambda mode: -counts[mode])[:3])
    return {mode: modes[mode] for mode in chosen}


def _with_amplitude(title: str, symptoms: Symptoms, modes: _FreeMotions) -> Figure:
    conditions = list(dict.fromkeys(condition for groups in modes.values() for condition in groups))
    styles: dict[str, Any] = {}
    for k, (condition, marker) in enumerate(zip(conditions, "osD^v<>ph*" * len(conditions), strict=False)):
        color = f"C{round(5 * k / max(len(conditions) - 1, 1))}"  # of the cycle's six
        styles[condition] = {"color": color, "linestyle": ("-", "--", ":", "-.")[k % 4], "marker": marker}
    page = PanelFigure.of(title, [(2.1, len(modes)), (2.35, len(modes))])
    for upper, lower, (mode, groups) in zip(*page.axes, modes.items(), strict=True):
        scale, unit = _UNITS[next(iter(groups.values()))[0].unit]
        for condition, group in groups.items():
            amplitude, look = scale * np.concatenate([free.amplitude for free in group]), styles[condition]
            rates, std = np.concatenate([free.rates for free in group]), np.concatenate([free.std for free in group])
            first = rates[np.argmin(amplitude), 1, 0]  # relative to the model's there, conditions lie on one axis
            _draw_trend(upper, amplitude, 100 * (rates[..., 0] / first - 1), 100 * std[:, 0] / first, 2, look)
            _draw_trend(lower, amplitude, rates[..., 1], std[:, 1], 1, look)
        all_amplitudes = scale * np.concatenate([free.amplitude for group in groups.values() for free in group])
        for axes, span in ((upper, 0.05), (lower, 2e-5)):  # per cent, and a ratio: or nothing but noise is magnified
            low, high = axes.get_ylim()
            margin = max(span - (high - low), 0.0) / 2
            axes.set_ylim(low - margin, high + margin)
            log_axis(axes.xaxis, float(all_amplitudes.min()) / 1.15, float(all_amplitudes.max()) * 1.15)
            axes.ticklabel_format(axis="y", useOffset=False)
        upper.set(ylabel="frequency, relative [%]", title=f"mode at {_frequency(symptoms, mode, 3)} Hz")
        upper.tick_params(labelbottom=False)
        lower.set(ylabel="damping ratio [1]", xlabel=f"amplitude [{unit}]")
    marks: Any = {"linestyle": "", "marker": "o"}
    legend = [("measured, with error", marks | {"color": Color.MEASURED}), ("model", {"color": Color.MEASURED})]
    if len(conditions) > 1:
        legend += [(short(condition or "other recordings", 24), styles[condition]) for condition in conditions]
    for label, look in legend:
        page.axes[0][0].plot([], [], label=label, **look, markerfacecolor="white")
    return page.finish()


def _draw_trend(axes: Axes, amplitude: Array, pairs: Array, std: Array, power: int, look: dict[str, Any]) -> None:
    """Draw measured and simulated values (P, 2): the model's trend, and what is measured beside it."""
    abscissa = (amplitude / amplitude.max()) ** power
    model = np.polyval(np.polyfit(abscissa, pairs[:, 1], 1, w=1 / std), abscissa)
    # What other motion leaks into the windows is the same in both, and goes with their difference.
    measured = model + pairs[:, 0] - pairs[:, 1]
    place, shown, errors = binned_means(amplitude, measured, min(8, amplitude.size // 2), std)
    clear = errors <= 4 * np.median(errors)  # of the others nothing could be seen
    order = np.argsort(amplitude)
    axes.plot(amplitude[order], model[order], **(look | {"marker": ""}))
    bars: Any = look | {"linestyle": "", "markersize": 5, "markerfacecolor": "white"}
    axes.errorbar(place[clear], shown[clear], yerr=errors[clear], elinewidth=1.1, **bars)


def _profiles_shown(symptoms: Symptoms) -> list[JointProfile]:
    """Return the missing torque or acceleration in all recordings, and the residual that goes most with a motion."""

    def surest(profiles: Sequence[JointProfile]) -> list[JointProfile]:
        return sorted(profiles, key=lambda profile: min(change.p_value for change in profile.fit.changes))[:1]

    all_profiles = [profile for recording in symptoms.recordings for profile in recording.profiles]
    torques = symptoms.profiles or [profile for profile in all_profiles if profile.quantity != "residual"]
    return surest(torques) + surest([profile for profile in all_profiles if profile.quantity == "residual"])


def _profiles(title: str, symptoms: Symptoms, shown: Sequence[JointProfile]) -> Figure:
    page = PanelFigure.of(title, [(2.35, 3)] * len(shown))
    for row, profile in zip(page.axes, shown, strict=True):
        _draw_profile(row, profile)
        several = np.unique(profile.recording).size > 1
        source = "all recordings" if several else _file(symptoms.recordings[int(profile.recording[0])], 16)
        row[0].set_title(f"{short(profile.sensor, 18)}, {source}")
    return page.finish()


def _draw_profile(row: Sequence[Axes], profile: JointProfile) -> None:
    scale, unit = _UNITS.get(profile.unit, (1.0, profile.unit))
    if unit == "deg" and float(np.percentile(np.abs(profile.values), 80)) * scale < 0.1:
        scale, unit = 1e3, "mrad"
    factor, motion_unit = _UNITS[profile.motion_unit]
    parts = scale * (profile.fit.parts - profile.fit.parts.mean(axis=0))
    values = scale * profile.fit.remaining[:, None] + parts
    trend: Any = {"color": Color.NOMINAL, "linestyle": "-", "zorder": 2, "label": "trend or step"}
    quantity = "unmodelled torque" if profile.quantity == "torque" else profile.quantity
    for k, (x, label) in enumerate((
        (factor * profile.position, f"{short(profile.motion, 16)} [{motion_unit}]"),
        (factor * profile.velocity, f"its velocity [{motion_unit}/s]"),
        (profile.direction, "its direction [1]"),
    )):  # fmt: skip
        ends = [np.argmin(x), np.argmax(x)]
        if k < 2:
            _draw_means(row[k], x, values[:, k])
            row[k].plot(x[ends], parts[ends, k], **trend)
        else:
            clear = np.abs(x) > 0.5
            _draw_means(row[k], np.sign(x[clear]), values[clear, k], spread=0.1)
            row[k].plot([-1.4, 0, 0, 1.4], np.repeat(parts[ends, k], 2), **trend)
            row[k].set_xlim(-1.6, 1.6)
            row[k].set_xticks([-1.0, 1.0], ["backwards", "forwards"])
        row[k].set(xlabel=label, ylabel=f"{quantity} [{unit}]")


def _draw_means(axes: Axes, x: Array, values: Array, spread: float = 0.0) -> None:
    """Draw single values, scattered sideways by so much, and their means with two standard errors."""
    thinned = slice(None, None, max(1, x.size // 600))
    scattered = x + spread * np.random.default_rng(0).uniform(-1, 1, x.size)
    axes.plot(scattered[thinned], values[thinned], ".", color=_DOTS, markersize=3, zorder=1, label="single values")
    axes.axhline(0.0, color=Color.AXIS, linewidth=0.6, zorder=1)
    centres, means, errors = binned_means(x, values, min(24 if x.size > 1000 else 10, x.size // 6))
    bars: Any = {"linestyle": "", "marker": "o", "markersize": 4, "color": Color.IDENTIFIED, "elinewidth": 1.1}
    axes.errorbar(centres, means, yerr=2 * errors, label="means, two standard errors", **bars)
    # The means are shown well; of the single values, those at the far ends may be cut off.
    farthest = float((np.abs(means) + 2 * errors).max(initial=0.0))
    largest = max(1.25 * farthest, 1.3 * float(np.percentile(np.abs(values), 80)), 1e-12)
    axes.set_ylim(-largest, largest)


def _with_lag(symptoms: Symptoms) -> list[RecordingSymptoms]:
    known = [recording for recording in symptoms.recordings if recording.modes.camera_lag.known]
    known = [recording for recording in known if all(sensor.delay.known for sensor in recording.sensors)]
    return sorted(known, key=lambda recording: recording.modes.camera_lag.std)[:_MOST_ROWS]


def _lags(title: str, symptoms: Symptoms, shown: Sequence[RecordingSymptoms]) -> Figure:
    page, lag = PanelFigure.of(title, [(0.6 + 0.34 * max(len(shown), 2), 1)]), symptoms.lag
    axes = page.axes[0][0]
    interval = 1e3 * (lag.value - 2 * lag.std), 1e3 * (lag.value + 2 * lag.std)
    axes.axvspan(*interval, color=_POOLED, linewidth=0, label="all recordings together")
    axes.axvline(0.0, color=Color.AXIS, linewidth=0.8)
    marks = []
    for label, delays, color, marker, face in (
        ("camera against model", [r.sensors[0].delay for r in shown], Color.MEASURED, "o", "white"),
        ("camera against encoder", [r.modes.camera_lag for r in shown], Color.IDENTIFIED, "D", Color.IDENTIFIED),
        ("encoder against model", [r.sensors[1].delay for r in shown], Color.TORQUE, "s", "white"),
    ):
        values, errors = (np.array([1e3 * getattr(delay, name) for delay in delays]) for name in ("value", "std"))
        look = {"color": color, "marker": marker, "markersize": 4.5, "markerfacecolor": face}
        marks.append((label, values, 2 * errors, look))
    draw_marks(axes, [_file(recording, 22) for recording in shown], marks, apart=0.22)
    axes.set(xlabel="delay, two standard errors [ms]", ylabel="recording")
    return page.finish()


def _at_rest(symptoms: Symptoms) -> list[tuple[RecordingSymptoms, SensorAtRest, Spectrum]]:
    sensors = [(recording, sensor) for recording in symptoms.recordings for sensor in recording.at_rest][:4]
    spectra = [Spectrum.of(recording.simulated, sensor.channels.sensor == "encoder") for recording, sensor in sensors]
    return [(*pair, spectrum) for pair, spectrum in zip(sensors, spectra, strict=True) if spectrum is not None]


def _quiet(title: str, _: Symptoms, shown: Sequence[tuple[RecordingSymptoms, SensorAtRest, Spectrum]]) -> Figure:
    page = PanelFigure.grid(title, len(shown), (2.5, 2.5))
    for axes, (recording, sensor, spectrum) in zip(page.axes[0], shown, strict=True):
        unit = "µm" if sensor.channels.unit == "m" else "µrad"
        Spectrum.draw(axes, [(spectrum, "residual at rest", Color.IDENTIFIED)], unit=unit)
        if sensor.tone is not None:
            peak = 1.25e6 * float(np.interp(sensor.tone.frequency, spectrum.frequency, spectrum.amplitude))
            axes.plot(sensor.tone.frequency, peak, "v", color=Color.NOMINAL, label="a tone")
        size = f"{ratio(1 + sensor.size.value)} × noise"
        tone = "" if sensor.tone is None else f", tone at {number(sensor.tone.frequency, 3)} Hz"
        axes.set_title(f"{_file(recording, 18)}, {sensor.channels.sensor}: {size}{tone}")
    return page.finish()
