"""Symptoms: what is wrong with the simulation of recordings, in numbers and sentences, before any cause is named."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from vjm.diagnosis.symptoms.channels import (
    UNKNOWN,
    Channels,
    Coefficient,
    SensorAtRest,
    Tone,
    at_rest,
    channels_of,
    coefficient,
    regress,
    sensor_delay,
    strongest_tone,
)
from vjm.diagnosis.symptoms.joints import JointProfile, joint_profiles, pooled
from vjm.diagnosis.symptoms.modes import SLOW, FreeMotion, ModeComparison, ModeDifference, compare_modes, slow_columns
from vjm.errors import ShapeError
from vjm.records import Array, Record, Recording, Rig, SimulatedRecording

FALSE_ALARM = 0.01  # probability that clean recordings show any symptom at all, shared by all that is looked for
_LEAST_SHARE = 0.01  # of a recording's mean square residual that a symptom describes, to be worth a sentence


@dataclass(frozen=True)
class Symptom:
    """One way in which the model and a recording differ; not a cause.

    Attributes:
        kind: what differs.
        recording: its file; None where it was seen in several together.
        sensor: a coordinate such as `beam.m5.y`, an encoder such as `beam.theta`, or `camera`; None: the whole arm.
        mode: index of the mode; None: none.
        value: measured minus simulated.
        std: its standard error.
        unit: of both.
        p_value: probability that a residual without it shows as much.
        share: of all recordings' mean square residual, in units of the noise, that it describes.
        local: the same of its own recording, or of those in which it was seen.
        sentence: in words.
    """

    kind: str
    recording: str | None
    sensor: str | None
    mode: int | None
    value: float
    std: float
    unit: str
    p_value: float
    share: float
    local: float
    sentence: str


_STILL = ModeComparison()


@dataclass(frozen=True)
class RecordingSymptoms:
    """All that was looked at in one recording."""

    simulated: SimulatedRecording
    sensors: tuple[Channels, ...]  # the camera and the encoders, as far as they measured anything
    misfit: float  # squared residuals, in units of the noise
    delays: tuple[Coefficient, ...] = ()  # of each sensor against the simulation [s]
    modes: ModeComparison = _STILL  # empty where nothing moves
    profiles: tuple[JointProfile, ...] = ()  # residuals against the joints' motion
    at_rest: tuple[SensorAtRest, ...] = ()  # each sensor, where nothing moves


@dataclass(frozen=True, repr=False)
class Symptoms(Record):
    """Symptoms: faults of the simulation, before any cause is named.

    Attributes:
        rig: the arm.
        found: all that was looked for, significant or not, the largest share first.
        recordings: each of them, in the order given.
        profiles: torques that are missing, against the joints' motion, over all recordings.
        lag: of the camera behind the encoders, over all recordings [s].
    """

    rig: Rig
    found: tuple[Symptom, ...]
    recordings: tuple[RecordingSymptoms, ...]
    profiles: tuple[JointProfile, ...]
    lag: Coefficient

    @property
    def significant(self) -> tuple[Symptom, ...]:
        """Symptoms that are more than chance, at a level that allows for all that was looked for, and worth a word."""
        level = FALSE_ALARM / max(len(self.found), 1)
        return tuple(one for one in self.found if one.p_value < level and one.local >= _LEAST_SHARE)

    def headlines(self, most: int = 8) -> tuple[Symptom, ...]:
        """Return the largest symptom of each kind and mode; its sentence tells in how many other recordings it shows.

        Args:
            most: how many at most.
        """
        groups: dict[tuple[str, int | None], list[Symptom]] = {}
        for symptom in self.significant:
            groups.setdefault((symptom.kind, symptom.mode), []).append(symptom)
        # When the misfit comes is told after what it is.
        ordered = sorted(groups.values(), key=lambda group: group[0].kind == "growth")
        return tuple(_headline(group) for group in ordered[:most])


def _headline(group: Sequence[Symptom]) -> Symptom:
    first = group[0]
    same = {each.recording for each in group if each.value * first.value > 0} - {first.recording}
    if not same:
        return first
    more = "another recording" if len(same) == 1 else f"{len(same)} other recordings"
    return replace(first, sentence=f"{first.sentence.removesuffix('.')}; likewise in {more}.")


def symptoms(
    rig: Rig, simulated: Sequence[SimulatedRecording], frequencies: Mapping[float, Sequence[float]]
) -> Symptoms:
    """Return what differs between recordings and the model's simulations of them.

    Args:
        rig: the arm.
        simulated: the recordings.
        frequencies: the model's natural frequencies [Hz] with each payload of the recordings [kg], as many with each.

    Raises:
        ShapeError: frequencies that are not positive or are missing for a payload, or recordings of another rig.
    """
    for one in simulated:
        own = frequencies.get(one.recording.payload)
        if own is None or not all(0 < f < math.inf for f in own):
            raise ShapeError(f"frequencies of {one.recording.file}", own, "positive numbers [Hz] for its payload")
        shapes = one.simulation.markers.shape[1], one.simulation.theta.shape[1]
        expected = sum(len(link.markers) for link in rig.links), len(rig.active_links)
        if shapes != expected:
            raise ShapeError(f"markers and joints of {one.recording.file}", shapes, f"{expected}, as the rig has them")
    recordings = tuple(_look_at(k, rig, one, frequencies[one.recording.payload]) for k, one in enumerate(simulated))
    total = sum(one.misfit for one in recordings)
    found = [symptom for one in recordings for symptom in _of_recording(one, total)]
    found += _with_amplitude(recordings, total)
    profiles: dict[tuple[str, str], list[JointProfile]] = {}
    for profile in (profile for one in recordings for profile in one.profiles if profile.quantity != "residual"):
        profiles.setdefault((profile.sensor, profile.quantity), []).append(profile)
    together = tuple(joint for joint in map(pooled, profiles.values()) if joint is not None)
    for joint in together:
        seen = [recordings[k] for k in np.unique(joint.recording)]
        found += _against(_Source(None, sum(one.misfit for one in seen), total), joint, seen)
    both = [(one, one.modes.rest) for one in recordings if one.modes.rest[2][0].known]
    source = _Source(None, sum(one.misfit for one, _ in both), total)
    lag, clock = (_mean([rest[k][0] for _, rest in both]) for k in (2, 3))
    described = [sum(rest[k][1] for _, rest in both) for k in (2, 3)]
    if both:
        words = f"{_quantity(lag.value, 's')} {_either(lag, 'later', 'earlier')} than the encoders do"
        found.append(source.symptom("camera_lag", lag, "s", described[0], f"the camera shows the motion {words}"))
        words = f"{_percent(clock.value)} {_either(clock, 'more', 'less')} time than the encoders'"
        found.append(source.symptom("camera_clock", clock, "1", described[1], f"the camera's clock counts {words}"))
    found.sort(key=lambda symptom: -symptom.share)
    return Symptoms(rig, tuple(found), recordings, together, lag)


def _look_at(index: int, rig: Rig, simulated: SimulatedRecording, natural: Sequence[float]) -> RecordingSymptoms:
    sensors = channels_of(rig, simulated)
    found = RecordingSymptoms(simulated, sensors, float(sum(np.sum(sensor.residual**2) for sensor in sensors)))
    if simulated.recording.kind in ("quiet", "static"):
        return replace(found, at_rest=tuple(rest for rest in map(at_rest, sensors) if rest is not None))
    if not sensors:
        return found
    return replace(
        found,
        delays=tuple(sensor_delay(sensor) for sensor in sensors),
        modes=compare_modes(simulated.recording, sensors, natural),
        profiles=tuple(joint_profiles(index, rig, simulated, sensors)),
    )


class _Source(NamedTuple):
    """Source of a symptom: the file (None: several), its misfit, and that of all recordings."""

    file: str | None
    own: float
    total: float

    def symptom(
        self,
        kind: str,
        found: Coefficient,
        unit: str,
        described: float,
        words: str,
        sensor: str | None = None,
        mode: int | None = None,
    ) -> Symptom:
        sentence = f"{words[:1].upper()}{words[1:]}." if self.file is None else f"{self.file}: {words}."
        share, local = (float(np.clip(described / max(m, 1e-300), 0.0, 1.0)) for m in (self.total, self.own))
        where = (kind, self.file, sensor, mode)
        return Symptom(*where, *found[:2], unit, found.p_value, share, local, sentence)


def _of_recording(one: RecordingSymptoms, total: float) -> Iterator[Symptom]:
    source = _Source(one.simulated.recording.file, one.misfit, total)
    for rest in one.at_rest:
        yield from _rest(source, rest)
    if not one.delays:
        return
    present = [mode.simulated for mode in one.modes.modes]
    for sensor, delay, remaining in zip(one.sensors, one.delays, one.modes.remaining, strict=True):
        yield from _aligned(source, sensor, delay)
        yield from _slow_drift(source, sensor, remaining, present)
        yield from _tone(source, sensor, strongest_tone(sensor, remaining, False, present))
    for mode in one.modes.modes:
        yield from _mode(source, mode, one)
    (gain, shared), (delay, later) = one.modes.rest[:2]
    words = "its vibrations apart, the arm moves"
    if gain.known:
        more = f"{words} {_percent(gain.value)} {_either(gain, 'more', 'less')} than the model"
        yield source.symptom("rest_amplitude", gain, "1", shared, more)
    if delay.known:
        more = f"{words} {_quantity(delay.value, 's')} {_either(delay, 'later', 'earlier')} than the model"
        yield source.symptom("rest_delay", delay, "s", later, more)
    for profile in one.profiles:
        yield from _against(source, profile, [one])
    yield from _growth(source, one)


def _aligned(source: _Source, sensor: Channels, delay: Coefficient) -> Iterator[Symptom]:
    """Yield offset, gain, delay and drift of each coordinate, and the delay of the whole sensor."""
    for c, name in enumerate(sensor.names):
        rows = sensor.known[:, c]
        time, residual = sensor.time[rows], sensor.residual[rows, c]
        moving, drifting = bool(sensor.moving[c]), sensor.sensor == "encoder"
        motion = sensor.simulated[rows, c] - sensor.simulated[rows, c].mean()
        parts = [("offset", np.ones(time.size))]
        parts += [("gain", motion), ("delay", -sensor.rate[rows, c])] if moving else []
        parts += [("drift", (time - time.mean()) / sensor.duration)] if drifting else []
        columns = np.stack([column for _, column in parts], axis=1) / sensor.noise
        found, _ = regress(columns, residual, sensor.groups[rows])
        for (kind, _), one, column in zip(parts, found, columns.T, strict=True):
            if not one.known:
                continue
            size, more = _quantity(one.value, sensor.unit), _either(one, "more", "less")
            words, unit = {
                "offset": (f"{name} reads {size} {more} than the model, all the time", sensor.unit),
                "gain": (f"{name} moves {_percent(one.value)} {more} than in the model", "1"),
                "delay": (_late(f"of {name}", one), "s"),
                "drift": (f"{name} drifts away from the model, by {_either(one, '+', '−')}{size} over the recording",
                          sensor.unit),
            }[kind]  # fmt: skip
            change = one.value * column
            yield source.symptom(kind, one, unit, float(change @ (2 * residual - change)), words, name)
    if delay.known:
        change = (sensor.path(sensor.time - delay.value) - sensor.simulated) * sensor.known / sensor.noise
        words = _late("before the camera" if sensor.sensor == "camera" else "of the joints", delay)
        described = float(np.sum(change * (2 * sensor.residual - change)))
        yield source.symptom("delay", delay, "s", described, words, sensor.sensor)


def _late(who: str, delay: Coefficient) -> str:
    when = _either(delay, "later", "earlier")
    return f"the motion {who} comes {_quantity(delay.value, 's')} {when} than in the model"


def _mode(source: _Source, mode: ModeDifference, one: RecordingSymptoms) -> Iterator[Symptom]:
    gain, phase, relative, at = mode.gain, mode.phase, mode.frequency, f"at {_plain(mode.simulated)} Hz"
    wide = f"{_percent(math.expm1(gain.value))} {_either(gain, 'wider', 'less wide')}"
    ahead = f"{_quantity(phase.value, 'rad')} {_either(phase, 'ahead of', 'behind')}"
    faster = f"{_percent(relative.value)} {_either(relative, 'faster', 'slower')} {at} than the model"
    dies = f"dies out {_either(mode.decay, 'faster', 'more slowly')} than in the model"
    if one.simulated.recording.kind == "decay":  # driven, the phase does not go on growing
        # Told for the time in which the simulated motion falls to a twentieth.
        duration = min(max(s.duration for s in one.sensors), 3 / max(-mode.pole.real, 1e-9))
        after, turned = f"{_plain(duration)} s", mode.speed.value * duration
        end = turned + (phase.value if abs(phase.value) > 3 * phase.std else 0.0)
        verbs = ("after", "leads by", "lags by")
        if end * turned <= 0:  # it starts ahead and falls behind, or the other way round
            end, verbs = turned, ("in", "gains", "loses")
        size = _quantity(end, "rad") if abs(end) < 2 * math.pi else f"{_plain(end / (2 * math.pi))} periods"
        faster += f": {verbs[0]} {after} it {verbs[1] if end > 0 else verbs[2]} {size}"
        ratio = math.exp(float(np.clip(-mode.decay.value * duration, -10, 10)))
        size = f"{_percent(ratio - 1)} {'larger' if ratio > 1 else 'smaller'} than"
        dies += f": after {after} its amplitude is {size if 0.5 < ratio < 2 else f'{_plain(ratio)} times'} the model's"
    for kind, value, unit, described, words in (
        ("amplitude", gain, "log", mode.described[0], f"{at} the arm swings {wide} than the model from the start"),
        ("phase", phase, "rad", mode.described[1], f"{at} the arm is {ahead} the model from the start"),
        ("damping", mode.damping, "1", mode.described[2], f"the swing {at} {dies}"),
        ("frequency", relative, "1", mode.described[3], f"the arm swings {faster}"),
    ):
        yield source.symptom(kind, value, unit, described, words, mode=mode.mode)
    for name, value, described in mode.shapes:
        more = f"{_percent(value.value)} {_either(value, 'more', 'less')}"
        words = f"{at} {name} moves {more} than the model, set against the other markers"
        yield source.symptom("mode_shape", value, "1", described, words, name, mode.mode)


def _against(source: _Source, profile: JointProfile, seen: Sequence[RecordingSymptoms]) -> Iterator[Symptom]:
    """Yield what goes with a joint's position, velocity and direction."""
    sensors = [sensor for one in seen for sensor in one.sensors if profile.sensor in sensor.names]
    misfit = sum(float(np.sum(s.residual[:, s.names.index(profile.sensor)] ** 2)) for s in sensors)
    residual = profile.quantity == "residual"
    what = f"the residual of {profile.sensor}" if residual else f"the {profile.quantity} missing at {profile.sensor}"
    for k, kind in enumerate(("against_angle", "against_velocity", "against_sign")):
        one = profile.fit.changes[k]
        if not one.known:
            continue
        rises, size = _either(one, "rises", "falls"), _quantity(one.value, profile.unit)
        words = {
            "against_angle": f"{what} {rises} by {size} from low to high {profile.motion}",
            "against_velocity": f"{what} {rises} by {size} from fast backwards to fast forwards of {profile.motion}",
            "against_sign": f"{what} jumps {_either(one, 'up', 'down')} by {size} when {profile.motion} turns from "
            "backwards to forwards",
        }[kind]
        yield source.symptom(kind, one, profile.unit, profile.fit.described[k] * misfit, words, profile.sensor)


def _slow_drift(source: _Source, sensor: Channels, remaining: Array, present: Sequence[float]) -> Iterator[Symptom]:
    """Yield the part of a residual that is slower than half the lowest natural frequency."""
    limit = SLOW * min(present, default=0.0)
    columns = slow_columns(sensor.time, sensor.time[0], sensor.duration, limit)
    count = columns.shape[1] - 1
    if count < 1 or sensor.time.size < 4 * count:
        return
    described = np.zeros(len(sensor.names))
    for c, rows in enumerate(sensor.known.T):
        residual = remaining[rows, c] - remaining[rows, c].mean()
        sizes, *_ = np.linalg.lstsq(columns[rows], residual, rcond=1e-6)
        described[c] = np.sum(residual**2) - np.sum((residual - columns[rows] @ sizes) ** 2)
    counts = sensor.known.sum(axis=0)
    most = int(np.argmax(described / counts))
    size = sensor.noise * math.sqrt(max(described[most] - count, 0.0) / counts[most])
    chance = float(stats.chi2.sf(described.sum(), count * described.size))
    found = Coefficient(size, sensor.noise / math.sqrt(2 * counts[most]), chance)
    much = f"{_quantity(size, sensor.unit)} RMS below {_plain(limit)} Hz"
    words = f"{sensor.names[most]} wanders slowly about the model, by {much}"
    beyond = max(float(described.sum()) - count * described.size, 0.0)
    yield source.symptom("slow_drift", found, sensor.unit, beyond, words, sensor.names[most])


def _growth(source: _Source, one: RecordingSymptoms) -> Iterator[Symptom]:
    """Yield the growth of the residual from the first to the last fifth of a recording."""
    start, stop = (end(sensor.time[k] for sensor in one.sensors) for end, k in ((min, 0), (max, -1)))
    total, count = np.zeros(5), np.zeros(5)
    for sensor in one.sensors:
        fifth = np.clip((5 * (sensor.time - start) / max(stop - start, 1e-300)).astype(np.intp), 0, 4)
        total += np.bincount(fifth, np.sum(sensor.residual**2, axis=1), 5)
        count += np.bincount(fifth, sensor.known.sum(axis=1), 5)
    if count.min() < 2 or total.min() <= 0:
        return
    power = total / count
    # Of a residual larger than the noise, the size in a fifth goes up and down with the motion, by a third or so.
    std = math.hypot(math.sqrt(0.5 / count[0] + 0.5 / count[-1]), 0.3 if power.max() > 2 else 0.15)
    growth = coefficient(0.5 * math.log(power[-1] / power[0]), std, 0.0, 1)
    if one.simulated.recording.kind == "decay" and growth.value < 0:  # it shrinks as the motion does
        return
    described = float(np.sum(np.maximum(total - count * total.sum() / count.sum(), 0.0)))
    fold = f"{_plain(math.exp(abs(growth.value)))}-fold from the first to the last fifth of the recording"
    yield source.symptom(
        "growth", growth, "log", described, f"the residual {_either(growth, 'grows', 'shrinks')} {fold}"
    )


def condition_of(recording: Recording) -> str:
    """Return what was different in a recording: its payload and its condition, in words; empty for neither."""
    payload = f"payload {1e3 * recording.payload:.3g} g" if recording.payload else ""
    return ", ".join(part for part in (payload, recording.condition or "") if part)


def _with_amplitude(recordings: Sequence[RecordingSymptoms], total: float) -> Iterator[Symptom]:
    """Yield changes of frequency and damping with amplitude, separately for recordings of different conditions."""
    groups: dict[tuple[int, str, str], list[tuple[RecordingSymptoms, FreeMotion]]] = {}
    for one in recordings:
        for free in one.modes.free:
            groups.setdefault((free.mode, condition_of(one.simulated.recording), free.unit), []).append((one, free))
    for (mode, condition, unit), members in groups.items():
        amplitude = np.concatenate([free.amplitude for _, free in members])
        if amplitude.size < 5 or amplitude.max() < 1.3 * amplitude.min():  # too little to show a change
            continue
        source = _Source(None, sum(one.misfit for one, _ in members), total)
        centre = float(np.concatenate([free.frequencies[:, 1] for _, free in members]).mean())
        small, large = (_quantity(float(size), unit) for size in (amplitude.min(), amplitude.max()))
        for of, power in (("frequency", 2), ("damping", 1)):
            ratio = of == "damping"
            pairs = np.concatenate([free.ratios if ratio else free.frequencies / centre for _, free in members])
            std = np.concatenate([free.std[:, 1] if ratio else free.std[:, 0] / centre for _, free in members])
            place = (amplitude / amplitude.max()) ** power
            columns = np.stack([np.ones_like(place), place], axis=1) / std[:, None]
            # Windows overlap by half, and a point is the difference of two: three in a row are taken together.
            slope = regress(columns, (pairs[:, 0] - pairs[:, 1]) / std, np.arange(place.size) // 3)[0][1]
            rate = 2 * np.pi * centre * slope.value * (-1 if ratio else 1j)
            described = sum(_bent(one, free, rate, float(amplitude.max()), power) for one, free in members)
            own = float(np.linalg.lstsq(columns, pairs[:, 1] / std, rcond=None)[0][1]) * float(np.ptp(place))
            change = slope.times(float(np.ptp(place)))
            measured = change.value + own
            what = f"the {'damping ratio of the ' * ratio}swing at {_plain(centre)} Hz"
            more = [f"{_plain(v)} {'higher' if v > 0 else 'lower'}" if ratio else
                    f"{_percent(v)} {'faster' if v > 0 else 'slower'}" for v in (measured, own)]  # fmt: skip
            model = "is the same" if abs(own) < 0.05 * abs(measured) else f"is {more[1]}"
            words = f"at {large} {what} is {more[0]} than at {small}; the model's {model}"
            words += f" ({condition})" if condition else ""
            yield source.symptom(f"{of}_with_amplitude", change, "1", described, words, mode=mode)


def _bent(one: RecordingSymptoms, free: FreeMotion, rate: complex, largest: float, power: int) -> float:
    """Return the squared misfit of a rate (imaginary: speed, real: decay) that goes with amplitude."""
    camera = one.sensors[0]
    size = np.interp(camera.time, free.time, free.amplitude / largest) ** power
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (size[1:] + size[:-1]) * np.diff(camera.time))])
    weight = np.linalg.norm(free.wave, axis=1)
    turned = turned - np.polyval(np.polyfit(camera.time, turned, 1, w=weight), camera.time)
    change = camera.centred((np.expm1(rate * turned)[:, None] * free.wave).real) / camera.noise
    return float(np.sum(change * (2 * one.modes.remaining[0] - change)))


def _rest(source: _Source, rest: SensorAtRest) -> Iterator[Symptom]:
    name, size, colour = rest.channels.sensor, rest.size, rest.colour
    words = f"the noise of the {name} is {_percent(size.value)} {_either(size, 'larger', 'smaller')} than supposed"
    yield source.symptom("quiet_size", size, "1", rest.described[0], f"at rest, {words}", name)
    value = f"{_either(colour, '', '−')}{_plain(colour.value)}"
    like = f"{_either(colour, 'resembles', 'opposes')} the one before (correlation {value})"
    words = f"at rest, each value of the {name} {like}"
    yield source.symptom("quiet_colour", colour, "1", rest.described[1], words, name)
    yield from _tone(source, rest.channels, rest.tone, "quiet_tone")


def _tone(source: _Source, sensor: Channels, tone: Tone | None, kind: str = "tone") -> Iterator[Symptom]:
    if tone is None:
        return
    size, at = _quantity(tone.amplitude.value, sensor.unit), f"at {_plain(tone.frequency, 3)} Hz"
    words = f"{tone.sensor} swings by {size} {at}, which the model does not"
    if tone.simulated >= tone.amplitude.value:
        swing = _quantity(tone.simulated, sensor.unit)
        words = f"{at}, where the model swings by {swing}, {tone.sensor} is off by {size}"
    yield source.symptom(kind, tone.amplitude, sensor.unit, tone.described, words, tone.sensor)


def _mean(found: Sequence[Coefficient]) -> Coefficient:
    """Average several recordings' values, with an error that their scatter does not belie."""
    known = [one for one in found if one.known and one.std > 0]
    if not known:
        return UNKNOWN
    values, weights = np.array([one.value for one in known]), np.array([one.std for one in known]) ** -2
    mean, std = float(np.average(values, weights=weights)), float(np.sum(weights) ** -0.5)
    scatter = math.sqrt(np.sum(weights * (values - mean) ** 2) / max(values.size - 1, 1))
    return coefficient(mean, std, std * max(scatter, 1.0), 11 + values.size - 1)


def _either(found: Coefficient, positive: str, negative: str) -> str:
    return positive if found.value > 0 else negative


def _plain(value: float, digits: int = 2) -> str:
    """Write a number's size with so many significant digits, without a power of ten: `0.40`, `1200`."""
    size = abs(value)
    if size == 0 or not math.isfinite(size):
        return "0"
    exponent = int(f"{size:.{digits - 1}e}".split("e")[1])
    return f"{round(size, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}"


def _percent(value: float) -> str:
    return f"{_plain(100 * value)} %"


def _quantity(value: float, unit: str) -> str:
    """Write a number's size in a unit that suits it: `2.0 mm`, `11 deg`, `4.0 ms`, `290 mm/s²`."""
    size = abs(value)
    scale, name = 1.0, unit
    if unit in ("m", "s"):
        steps = ((1e6, "µ"), (1e3, "m"), (1.0, ""))
        scale, prefix = steps[0] if size < 1e-5 else steps[1] if unit == "m" or size < 1 else steps[2]
        name = prefix + unit
    elif unit == "rad":
        scale, name = (math.degrees(1.0), "deg") if size >= math.radians(0.1) else (1e3, "mrad")
    elif unit == "m/s²" and size < 1:
        scale, name = 1e3, "mm/s²"
    return f"{_plain(size * scale)} {name}"
