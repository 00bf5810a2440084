"""Symptoms: how recordings differ from their simulations, in numbers and sentences; no cause is named here."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from vjm.diagnosis.symptoms.channels import GROUPS, Channels, Coefficient, SensorAtRest, Tone, explained, regress
from vjm.diagnosis.symptoms.joints import JointProfile, joint_profiles
from vjm.diagnosis.symptoms.modes import SLOW, FreeMotion, ModeDifference, MotionComparison
from vjm.records import Array, Payload, Record, Rig, SimulatedRecording
from vjm.text import capital, counted

# Sentence of each kind, and the words that stand for {way} where the value is positive and where it is negative.
_SENTENCES = {
    "offset": ("{name} is offset by {way}{size} from the model throughout", "+", "−"),
    "gain": ("{name} moves {size} {way} than simulated", "more", "less"),
    "drift": ("{name} drifts from the model by {way}{size} over the recording", "+", "−"),
    "delay": ("motion {who} is {size} {way}", "late", "early"),
    "camera_lag": ("camera is {size} {way} relative to the encoders", "late", "early"),
    "camera_clock": ("camera clock runs {size} {way} relative to the encoders' clock", "fast", "slow"),
    "amplitude": ("initial amplitude at {at} is {size} {way} than simulated", "larger", "smaller"),
    "phase": ("initial phase at {at} {way} the model by {size}", "leads", "lags"),
    "damping": ("damping at {at} is {way} than in the model{after}", "higher", "lower"),
    "frequency": ("frequency at {at} is {size} {way} than in the model{after}", "higher", "lower"),
    "mode_shape": ("{name} moves {size} {way} at {at} than in the model's mode shape", "more", "less"),
    "slow_amplitude": ("motion below the first mode is {size} {way} than simulated", "larger", "smaller"),
    "slow_delay": ("motion below the first mode is {size} {way}", "late", "early"),
    "against_angle": ("{what} {way} by {size} over the range of {motion}", "rises", "falls"),
    "against_velocity": ("{what} {way} by {size} from full reverse to full forward rate of {motion}", "rises", "falls"),
    "against_sign": ("{what} jumps {way} by {size} where {motion} reverses to forward", "up", "down"),
    "slow_drift": ("{name} has a low-frequency residual of {size} RMS below {limit} Hz", "", ""),
    "growth": ("residual {way} {fold}-fold from the first to the last fifth of the recording", "grows", "shrinks"),
    "frequency_with_amplitude": (
        "frequency at {at} is {here} at {large} amplitude than at {small}; model: {own}", "", "",
    ),
    "damping_with_amplitude": (
        "damping ratio at {at} is {here} at {large} amplitude than at {small}; model: {own}", "", "",
    ),
    "noise_size": ("at rest, {name} noise is {size} {way} than assumed", "larger", "smaller"),
    "noise_correlation": ("at rest, {name} noise is correlated (lag-one correlation {way}{value})", "+", "−"),
    "tone": ("{name} oscillates by {size} at {at}; the model does not", "", ""),
    "tone_of_model": ("{name} is off by {size} at {at}, where the model oscillates by {swing}", "", ""),
}  # fmt: skip


@dataclass(frozen=True)
class Symptom:
    """One way in which the model and a recording differ; not a cause."""

    kind: str  # what differs
    recording: str | None  # its file; None where it was seen in several together
    sensor: str | None  # a coordinate such as `beam.m5.y`, an encoder such as `beam.theta`, or `camera`; None: the arm
    mode: int | None  # index of the mode; None: none
    value: float  # measured minus simulated
    std: float  # its standard error
    unit: str  # of both
    p_value: float  # probability that a residual without it shows as much
    share: float  # of all recordings' mean square residual, in units of the noise, that it describes
    local_share: float  # the same of its own recording, or of those in which it was seen
    sentence: str  # in words


@dataclass(frozen=True)
class RecordingSymptoms:
    """All that was looked at in one recording."""

    simulated: SimulatedRecording
    sensors: tuple[Channels, ...]  # the camera and the encoders, as far as they measured anything
    misfit: float  # squared residuals, in units of the noise
    modes: MotionComparison = field(default_factory=MotionComparison)  # empty where nothing moves or was measured
    profiles: tuple[JointProfile, ...] = ()  # residuals against the joints' motion
    at_rest: tuple[SensorAtRest, ...] = ()  # each sensor, where nothing moves


@dataclass(frozen=True, repr=False)
class Symptoms(Record):
    """Faults of the simulation, before any cause is named."""

    rig: Rig
    found: tuple[Symptom, ...]  # all that was looked for, significant or not, the largest share first
    recordings: tuple[RecordingSymptoms, ...]  # in the order given
    profiles: tuple[JointProfile, ...]  # torques that are missing, against the joints' motion, over all recordings
    lag: Coefficient  # of the camera behind the encoders, over all recordings [s]

    @classmethod
    def of(
        cls, rig: Rig, simulated: Sequence[SimulatedRecording], frequencies: Mapping[Payload, Sequence[float]]
    ) -> Symptoms:
        """Find what differs between recordings and the model's simulations of them.

        `frequencies` are the model's natural ones [Hz] with each payload of the recordings, as many with each.
        """
        recordings = []
        for replay in simulated:
            sensors = Channels.of(rig, replay)
            misfit = float(sum(np.sum(sensor.residual**2) for sensor in sensors))
            modes, at_rest = MotionComparison(), list[SensorAtRest]()
            if replay.recording.kind in ("quiet", "static"):
                at_rest = [quiet for quiet in map(SensorAtRest.of, sensors) if quiet is not None]
            elif sensors:
                modes = MotionComparison.of(replay.recording, sensors, frequencies[replay.recording.payload_body])
            recordings.append(RecordingSymptoms(replay, sensors, misfit, modes, at_rest=tuple(at_rest)))
        separate, together = joint_profiles(
            rig,
            [(recording.simulated, recording.sensors if recording.modes.remaining else ()) for recording in recordings],
        )
        recordings = [
            replace(recording, profiles=profiles) for recording, profiles in zip(recordings, separate, strict=True)
        ]
        total = sum(recording.misfit for recording in recordings)
        found = [symptom for recording in recordings for symptom in _of_recording(recording, total)]
        found += _with_amplitude(recordings, total)
        for profile in together:
            pooled = [recordings[k] for k in np.unique(profile.recording)]
            found += _against(_Source.of(pooled, total), profile, pooled)
        timed = [recording for recording in recordings if recording.modes.camera_lag.known]
        lag, clock = (
            _mean([getattr(recording.modes, kind) for recording in timed]) for kind in ("camera_lag", "camera_clock")
        )
        found.append(_Source.of(timed, total).symptom("camera_lag", lag, "s"))
        found.append(_Source.of(timed, total).symptom("camera_clock", clock, "1"))
        known = sorted((symptom for symptom in found if math.isfinite(symptom.std)), key=lambda symptom: -symptom.share)
        return cls(rig, tuple(known), tuple(recordings), together, lag)

    @property
    def significant(self) -> tuple[Symptom, ...]:
        """Symptoms that are more than chance, at a level that allows for all that was looked for, and worth a word."""
        level = 0.01 / max(len(self.found), 1)  # clean recordings show any symptom at all once in a hundred times
        # A sentence is worth one per cent of a recording's mean square residual.
        return tuple(symptom for symptom in self.found if symptom.p_value < level and symptom.local_share >= 0.01)

    def headlines(self, most: int = 8) -> tuple[Symptom, ...]:
        """Return the largest symptom of each kind and mode, at most so many, saying how many recordings share it."""
        groups: dict[tuple[str, int | None], list[Symptom]] = {}
        for symptom in self.significant:
            groups.setdefault((symptom.kind, symptom.mode), []).append(symptom)
        headlines = []
        for first, *weaker in list(groups.values())[:most]:
            # Without a recording, a symptom is that of several together.
            shared_by = {similar.recording for similar in weaker if similar.value * first.value > 0}
            others = len(shared_by - {first.recording, None})
            sentence = f"{first.sentence.removesuffix('.')}; also in {counted(others, 'other')}."
            headlines.append(replace(first, sentence=sentence) if others and first.recording else first)
        return tuple(headlines)


class _Source(NamedTuple):
    """Source of a symptom: the file (None: several), its misfit, and that of all recordings."""

    file: str | None
    misfit: float
    total: float

    @classmethod
    def of(cls, recordings: Sequence[RecordingSymptoms], total: float) -> _Source:
        """Return several recordings together as one source."""
        return cls(None, sum(recording.misfit for recording in recordings), total)

    def symptom(
        self, kind: str, estimate: Coefficient, unit: str, sensor: str | None = None, mode: int | None = None,
        template: str = "", **words: str,
    ) -> Symptom:  # fmt: skip
        """Return a symptom, its sentence filled with further words."""
        sentence, positive, negative = _SENTENCES[template or kind]
        words = {"name": sensor or "", "size": _quantity(estimate.value, unit)} | words
        text = sentence.format(way=positive if estimate.value > 0 else negative, **words)
        text = f"{capital(text)}." if self.file is None else f"{self.file}: {text}."
        share, local = (float(np.clip(estimate.explained / max(m, 1e-300), 0, 1)) for m in (self.total, self.misfit))
        return Symptom(kind, self.file, sensor, mode, *estimate[:2], unit, estimate.p_value, share, local, text)


def _of_recording(recording: RecordingSymptoms, total: float) -> Iterator[Symptom]:
    source, modes = _Source(recording.simulated.recording.file, recording.misfit, total), recording.modes
    for quiet in recording.at_rest:
        name, correlation = quiet.channels.sensor, quiet.correlation
        yield source.symptom("noise_size", quiet.size, "1", name)
        yield source.symptom("noise_correlation", correlation, "1", name, value=_plain(correlation.value))
        yield from _tone(source, quiet.channels, quiet.tone, "quiet_tone")
    if not modes.remaining:
        return
    present = [mode.simulated for mode in modes.modes]
    for sensor, remaining in zip(recording.sensors, modes.remaining, strict=True):
        yield from _aligned(source, sensor)
        yield from _slow_drift(source, sensor, remaining, SLOW * min(present, default=0.0))
        yield from _tone(source, sensor, sensor.strongest_tone(remaining, modes=present), "tone")
    for mode in modes.modes:
        yield from _mode(source, mode, recording)
    yield source.symptom("slow_amplitude", modes.slow_gain, "1")
    yield source.symptom("slow_delay", modes.slow_delay, "s")
    for profile in recording.profiles:
        yield from _against(source, profile, [recording])
    yield from _growth(source, recording)


def _aligned(source: _Source, sensor: Channels) -> Iterator[Symptom]:
    for index, name in enumerate(sensor.names):
        rows = sensor.known[:, index]
        time, residual = sensor.time[rows], sensor.residual[rows, index]
        parts = {"offset": np.ones(time.size)}
        if sensor.moving[index]:
            motion = sensor.simulated[rows, index]
            parts |= {"gain": motion - motion.mean(), "delay": -sensor.rate[rows, index]}
        if sensor.sensor == "encoder":
            parts["drift"] = (time - time.mean()) / sensor.duration
        columns = np.stack(list(parts.values()), axis=1) / sensor.noise
        estimates, _ = regress(columns, residual, sensor.groups[rows])
        for kind, estimate, column in zip(parts, estimates, columns.T, strict=True):
            if kind != "delay":  # that of the whole sensor follows
                alone = estimate._replace(explained=explained(estimate.value * column, residual))
                yield source.symptom(kind, alone, "1" if kind == "gain" else sensor.unit, name)
    observer = "seen by the camera" if sensor.sensor == "camera" else "of the joints"
    yield source.symptom("delay", sensor.delay, "s", sensor.sensor, who=observer)


def _mode(source: _Source, mode: ModeDifference, recording: RecordingSymptoms) -> Iterator[Symptom]:
    at, phase, phase_text, decay = f"{_plain(mode.simulated)} Hz", mode.phase, "", ""
    if recording.simulated.recording.kind == "decay":  # driven, the phase does not go on growing
        # After the time in which the simulated motion falls to a twentieth.
        duration = min(max(sensor.duration for sensor in recording.sensors), 3 / max(-mode.pole.real, 1e-9))
        after, turned = f"{_plain(duration)} s", mode.angular_frequency.value * duration
        phase_text = f": {'gains' if turned > 0 else 'loses'} {_phase(turned)} of phase in {after}"
        if abs(phase.value) > 3 * phase.std:
            ends = (f"{'+' if end > 0 else '−'}{_phase(end)}" for end in (phase.value, phase.value + turned))
            phase_text += f" (from {' to '.join(ends)}, as the initial state is fitted to the whole recording)"
        ratio = math.exp(float(np.clip(-mode.decay.value * duration, -10, 10)))
        size = f"{_quantity(ratio - 1, '1')} {'larger' if ratio > 1 else 'smaller'} than"
        decay = f": after {after} the amplitude is {size if 0.5 < ratio < 2 else f'{_plain(ratio)} times'} the model's"
    for kind, estimate, unit, after in (("amplitude", mode.gain, "log", ""), ("phase", phase, "rad", ""),
                                        ("damping", mode.damping, "1", decay),
                                        ("frequency", mode.frequency, "1", phase_text)):  # fmt: skip
        yield source.symptom(kind, estimate, unit, mode=mode.mode, at=at, after=after)
    for name, estimate in mode.shapes:
        yield source.symptom("mode_shape", estimate, "1", name, mode.mode, at=at)


def _against(source: _Source, profile: JointProfile, recordings: Sequence[RecordingSymptoms]) -> Iterator[Symptom]:
    name, motion = profile.sensor, profile.motion
    sensors = [sensor for recording in recordings for sensor in recording.sensors if name in sensor.names]
    misfit = sum(float(np.sum(sensor.residual[:, sensor.names.index(name)] ** 2)) for sensor in sensors)
    subject = f"residual of {name}" if profile.quantity == "residual" else f"unmodelled {profile.quantity} at {name}"
    for kind, change in zip(("angle", "velocity", "sign"), profile.fit.changes, strict=True):
        share = change.explained / max(change.explained + profile.fit.misfit, 1e-300)
        change = change._replace(explained=share * misfit)
        yield source.symptom(f"against_{kind}", change, profile.unit, name, what=subject, motion=motion)


def _slow_drift(source: _Source, sensor: Channels, remaining: Array, limit: float) -> Iterator[Symptom]:
    columns = sensor.slow_columns(sensor.time, limit)
    count = columns.shape[1] - 1
    if count < 1 or sensor.time.size < 4 * count:
        return
    power = np.zeros(len(sensor.names))
    for column, rows in enumerate(sensor.known.T):
        residual = remaining[rows, column] - remaining[rows, column].mean()
        sizes, *_ = np.linalg.lstsq(columns[rows], residual, rcond=1e-6)
        power[column] = explained(columns[rows] @ sizes, residual)
    largest = int(np.argmax(power / sensor.counts))
    size = sensor.noise * math.sqrt(max(power[largest] - count, 0.0) / sensor.counts[largest])
    chance, excess = float(stats.chi2.sf(power.sum(), count * power.size)), float(power.sum()) - count * power.size
    drift = Coefficient(size, sensor.noise / math.sqrt(2 * sensor.counts[largest]), chance, max(excess, 0.0))
    yield source.symptom("slow_drift", drift, sensor.unit, sensor.names[largest], limit=_plain(limit))


def _growth(source: _Source, recording: RecordingSymptoms) -> Iterator[Symptom]:
    time = np.concatenate([sensor.time for sensor in recording.sensors])
    squares = np.concatenate([np.sum(sensor.residual**2, axis=1) for sensor in recording.sensors])
    known = np.concatenate([np.sum(sensor.known, axis=1) for sensor in recording.sensors])
    fifths = np.linspace(time.min(), time.max(), 6)
    total, count = (np.histogram(time, fifths, weights=values)[0] for values in (squares, known))
    if count.min() < 2 or total.min() <= 0:
        return
    power = total / count
    # Of a residual larger than the noise, the size in a fifth goes up and down with the motion, by a third or so.
    std = math.hypot(math.sqrt(0.5 / count[0] + 0.5 / count[-1]), 0.3 if power.max() > 2 else 0.15)
    growth = Coefficient.of(0.5 * math.log(power[-1] / power[0]), std, 0.0, 1)
    if recording.simulated.recording.kind == "decay" and growth.value < 0:  # it shrinks as the motion does
        return
    excess = float(np.sum(np.maximum(total - count * total.sum() / count.sum(), 0.0)))
    growth = growth._replace(explained=excess)
    yield source.symptom("growth", growth, "log", fold=_plain(math.exp(abs(growth.value))))


def _with_amplitude(recordings: Sequence[RecordingSymptoms], total: float) -> Iterator[Symptom]:
    """Yield changes of frequency and damping with amplitude, separately for recordings of different conditions."""
    groups: dict[tuple[int, str, str], list[tuple[RecordingSymptoms, FreeMotion]]] = {}
    for recording in recordings:
        for free in recording.modes.free:
            groups.setdefault((free.mode, free.condition, free.unit), []).append((recording, free))
    for (mode, condition, unit), members in groups.items():
        amplitude = np.concatenate([free.amplitude for _, free in members])
        largest, smallest = float(amplitude.max()), float(amplitude.min())
        if amplitude.size < 5 or largest < 1.3 * smallest:  # too little to show a change
            continue
        source = _Source.of([recording for recording, _ in members], total)
        rates, std = (np.concatenate(parts) for parts in zip(*((f.rates, f.std) for _, f in members), strict=True))
        centre = float(rates[:, 1, 0].mean())
        for column, kind, power in ((0, "frequency", 2), (1, "damping", 1)):
            scale = centre if kind == "frequency" else 1.0
            values, errors = rates[..., column] / scale, std[:, column] / scale
            place = (amplitude / largest) ** power
            columns = np.stack([np.ones_like(place), place], axis=1) / errors[:, None]
            # Windows overlap by half: two in a row are taken together.
            slope = regress(columns, (values[:, 0] - values[:, 1]) / errors, np.arange(place.size) // 2)[0][1]
            rate = 2 * np.pi * centre * slope.value
            excess = sum(free.misfit_of(rate, largest, power) for _, free in members)
            modelled = float(np.linalg.lstsq(columns, values[:, 1] / errors, rcond=None)[0][1] * np.ptp(place))
            change = slope.times(float(np.ptp(place)))._replace(explained=excess)
            measured, model = (f"{_plain(v) if column else _quantity(v, '1')} {'higher' if v > 0 else 'lower'}"
                               for v in (change.value + modelled, modelled))  # fmt: skip
            model = "the same" if abs(modelled) < 0.05 * abs(change.value + modelled) else model
            yield source.symptom(
                f"{kind}_with_amplitude", change, "1", mode=mode, here=measured, at=f"{_plain(centre)} Hz",
                own=model + (f" ({condition})" if condition else ""), large=_quantity(largest, unit),
                small=_quantity(smallest, unit),
            )  # fmt: skip


def _tone(source: _Source, sensor: Channels, tone: Tone | None, kind: str) -> Iterator[Symptom]:
    if tone is not None:
        template = "tone_of_model" if tone.simulated >= tone.amplitude.value else "tone"
        at, swing = f"{_plain(tone.frequency, 3)} Hz", _quantity(tone.simulated, sensor.unit)
        yield source.symptom(kind, tone.amplitude, sensor.unit, tone.coordinate, template=template, at=at, swing=swing)


def _mean(estimates: Sequence[Coefficient]) -> Coefficient:
    """Average several recordings' values, with a standard error no smaller than their scatter implies."""
    known = [estimate for estimate in estimates if estimate.known and estimate.std > 0]
    if not known:
        return Coefficient()
    values = np.array([estimate.value for estimate in known])
    weights = np.array([estimate.std for estimate in known]) ** -2
    mean, std = float(np.average(values, weights=weights)), float(np.sum(weights) ** -0.5)
    scatter = math.sqrt(np.sum(weights * (values - mean) ** 2) / max(values.size - 1, 1))
    together = Coefficient.of(mean, std, std * max(scatter, 1.0), GROUPS - 1 + values.size - 1)
    return together._replace(explained=sum(estimate.explained for estimate in estimates))


def _phase(angle: float) -> str:
    """Write a phase's size in whole degrees, so that differences agree, or in periods from one on."""
    degrees = math.degrees(abs(angle))
    if degrees < 9.5:
        return _quantity(angle, "rad")
    return f"{degrees:.0f}°" if degrees < 359.5 else f"{_plain(angle / (2 * math.pi))} periods"


def _plain(value: float, digits: int = 2) -> str:
    """Write a number's size with so many significant digits, without a power of ten: `0.40`, `1200`."""
    size = abs(value)
    if size == 0 or not math.isfinite(size):
        return "0"
    decimals = digits - 1 - int(f"{size:.{digits - 1}e}".split("e")[1])
    return f"{round(size, decimals):.{max(decimals, 0)}f}"


# Scales in which sizes of a unit are written, each from a size on.
_SCALES = {
    "1": ((0.0, 100.0, "%"),),
    "log": ((0.0, 100.0, "%"),),
    "m": ((1e-5, 1e3, "mm"), (0.0, 1e6, "µm")),
    "s": ((1.0, 1.0, "s"), (1e-5, 1e3, "ms"), (0.0, 1e6, "µs")),
    "rad": ((math.radians(0.1), math.degrees(1.0), "°"), (0.0, 1e3, "mrad")),
    "m/s²": ((1.0, 1.0, "m/s²"), (0.0, 1e3, "mm/s²")),
}


def _quantity(value: float, unit: str) -> str:
    """Write a number's size in a unit that suits it: `2.0 mm`, `11°`, `4.0 ms`, `290 mm/s²`, `0.40 %`."""
    size = abs(math.expm1(value)) if unit == "log" else abs(value)
    scales = _SCALES.get(unit, ((0.0, 1.0, unit),))
    scale, name = next((scale, name) for limit, scale, name in scales if size >= limit or not limit)
    return f"{_plain(size * scale)}{'' if name == '°' else ' '}{name}"
