"""What was found, as symptoms: a value, its error, its share of the misfit, and one sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vjm.symptoms import wording
from vjm.symptoms.alignment import Alignment
from vjm.symptoms.amplitude import Trend
from vjm.symptoms.bands import Band, Bands
from vjm.symptoms.examine import Examined
from vjm.symptoms.profiles import Profile
from vjm.symptoms.records import Estimate, Kind, Symptom
from vjm.symptoms.tones import Quiet, Tone

_LEAST_MISFIT = 1e-300
_AGAINST: tuple[Kind, ...] = ("against_angle", "against_velocity", "against_sign")


@dataclass(frozen=True)
class _Lister:
    """Makes symptoms of one recording, or of several together.

    Attributes:
        file: of the recording; None: several.
        own: misfit of what it was seen in.
        total: misfit of all recordings.
    """

    file: str | None
    own: float
    total: float

    def __call__(
        self,
        kind: Kind,
        found: Estimate,
        unit: str,
        described: float,
        words: str,
        sensor: str | None = None,
        band: float | None = None,
    ) -> Symptom:
        """One symptom; `described` in units of the noise squared."""
        size = max(described, 0.0)
        share, local = (float(min(size / max(each, _LEAST_MISFIT), 1.0)) for each in (self.total, self.own))
        text = wording.sentence(self.file, words)
        return Symptom(kind, self.file, sensor, band, *found[:2], unit, found.p_value, share, local, text)


def of_recording(one: Examined, total: float) -> list[Symptom]:
    """All symptoms of one recording, significant or not.

    Args:
        one: the recording.
        total: misfit of all recordings.
    """
    lister = _Lister(one.followed.recording.file, one.misfit, total)
    found = [symptom for each in one.alignments for symptom in _aligned(lister, each)]
    if one.bands is not None:
        found += [symptom for band in one.bands.bands for symptom in _band(lister, band)]
        found += _rest(lister, one.bands)
    units = {name: sensor.unit for sensor in one.sensors for name in sensor.names}
    found += [_tone(lister, each, units[each.sensor]) for each in one.tones]
    for profile in one.profiles:
        found += _profile(lister, profile, _misfit_of(one, profile.sensor))
    found += [symptom for each in one.quiet for symptom in _quiet(lister, each)]
    for slow in one.wanders:
        unit = units[slow.sensor]
        words = wording.wander(slow.sensor, slow.size.value, unit, slow.limit)
        found.append(lister("wander", slow.size, unit, slow.described, words, slow.sensor))
    dying = one.followed.recording.kind == "decay"
    if one.course is not None and not (dying and one.course.growth.value < 0):  # it shrinks as the motion does
        growth = one.course.growth
        found.append(lister("course", growth, "log", one.course.described, wording.course(growth.value)))
    return found


def of_all(
    examined: Sequence[Examined],
    trends: Sequence[Trend],
    profiles: Sequence[Profile],
    lag: Estimate,
    clock: Estimate,
    total: float,
) -> list[Symptom]:
    """Symptoms that were sought in all recordings together.

    Args:
        examined: the recordings.
        trends: of frequency and damping with amplitude.
        profiles: of residuals against motion.
        lag: of the camera [s].
        clock: of the camera, relative.
        total: misfit of all recordings.
    """
    found = []
    for trend in trends:
        own = float(sum(examined[index].misfit for index, _ in trend.described))
        measured = trend.change.value + trend.simulated
        words = wording.with_amplitude(
            trend.of, trend.frequency, measured, trend.simulated, trend.amplitudes, trend.unit
        )
        kind: Kind = "frequency_with_amplitude" if trend.of == "frequency" else "damping_with_amplitude"
        described = sum(each for _, each in trend.described)
        found.append(_Lister(None, own, total)(kind, trend.change, "1", described, words, band=trend.frequency))
    for profile in profiles:
        shown = [examined[index] for index in profile.recordings]
        lister = _Lister(None, float(sum(one.misfit for one in shown)), total)
        found += _profile(lister, profile, sum(_misfit_of(one, profile.sensor) for one in shown))
    lags = [(one, one.lag) for one in examined if one.lag is not None]
    if lags:
        lister = _Lister(None, float(sum(one.misfit for one, _ in lags)), total)
        sums = [float(sum(each.described[k] for _, each in lags)) for k in (0, 1)]
        found.append(lister("camera_lag", lag, "s", sums[0], wording.camera_lag(lag.value), "camera"))
        found.append(lister("camera_clock", clock, "1", sums[1], wording.camera_clock(clock.value), "camera"))
    return found


def _aligned(lister: _Lister, one: Alignment) -> Iterator[Symptom]:
    unit = one.channels.unit
    for name, *parts in one.coordinates:
        (offset, _), (gain, _), (delay, _), (drift, _) = parts
        rows: tuple[tuple[Kind, str, str], ...] = (
            ("offset", unit, wording.offset(name, offset.value, unit)),
            ("gain", "1", wording.gain(name, gain.value)),
            ("delay", "s", wording.delay(f"of {name}", delay.value)),
            ("drift", unit, wording.drift(name, drift.value, unit)),
        )
        for (kind, of, words), (found, described) in zip(rows, parts, strict=True):
            if np.isfinite(found.std):
                yield lister(kind, found, of, described, words, name)
    if np.isfinite(one.delay.std):
        who = "before the camera" if one.channels.sensor == "camera" else "of the joints"
        words = wording.delay(who, one.delay.value)
        yield lister("delay", one.delay, "s", one.described, words, one.channels.sensor)


def _band(lister: _Lister, band: Band) -> Iterator[Symptom]:
    circle, duration = 2 * np.pi * band.frequency, band.end - band.start
    gain, phase, decay, speed = band.described
    relative = band.speed.times(1 / circle)
    yield lister(
        "amplitude", band.gain, "log", gain, wording.amplitude(band.frequency, band.gain.value), band=band.frequency
    )
    yield lister(
        "phase", band.phase, "rad", phase, wording.phase(band.frequency, band.phase.value), band=band.frequency
    )
    words = wording.frequency(band.frequency, relative.value, duration, band.speed.value * duration, band.ahead)
    yield lister("frequency", relative, "1", speed, words, band=band.frequency)
    words = wording.damping(band.frequency, band.decay.value, duration)
    yield lister("damping", band.decay, "1/s", decay, words, band=band.frequency)
    for name, found, described in band.shapes:
        words = wording.shape(band.frequency, name, found.value)
        yield lister("shape", found, "log", described, words, name, band.frequency)


def _rest(lister: _Lister, bands: Bands) -> list[Symptom]:
    gain, delay = bands.rest_gain, bands.rest_delay
    found = []
    if np.isfinite(gain.std):
        found.append(lister("rest_amplitude", gain, "1", bands.others[0], wording.rest_gain(gain.value)))
    if np.isfinite(delay.std):
        found.append(lister("rest_delay", delay, "s", bands.others[1], wording.rest_delay(delay.value)))
    return found


def _tone(lister: _Lister, found: Tone, unit: str) -> Symptom:
    frequency = found.frequency.value
    words = wording.tone(found.sensor, found.amplitude.value, unit, frequency, found.simulated)
    return lister("tone", found.amplitude, unit, found.described, words, found.sensor, frequency)


def _profile(lister: _Lister, found: Profile, misfit: float) -> Iterator[Symptom]:
    for k, kind in enumerate(_AGAINST):
        one = found.estimates[k].times(found.reach[k])
        if np.isfinite(one.std):
            words = wording.against(kind, found.sensor, found.quantity, one.value, found.unit, found.motion)
            yield lister(kind, one, found.unit, found.described[k] * misfit, words, found.sensor)


def _misfit_of(one: Examined, name: str) -> float:
    """Misfit of one coordinate."""
    sensor = next(each for each in one.sensors if name in each.names)
    return float(np.sum(sensor.residual[:, sensor.names.index(name)] ** 2))


def _quiet(lister: _Lister, found: Quiet) -> Iterator[Symptom]:
    sensor = found.channels.sensor
    words = wording.quiet_size(sensor, found.size.value)
    yield lister("quiet_size", found.size, "1", found.described[0], words, sensor)
    words = wording.quiet_colour(sensor, found.colour.value)
    yield lister("quiet_colour", found.colour, "1", found.described[1], words, sensor)
    if found.tone is not None:
        yield _tone(lister, found.tone, found.channels.unit)
