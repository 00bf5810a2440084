"""Frequency and damping as they change with amplitude, while nothing drives the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vjm.records import Array, Complex, Recording
from vjm.symptoms.bands import Band, Bands
from vjm.symptoms.demodulation import REACH, Demodulated
from vjm.symptoms.records import Estimate
from vjm.symptoms.regression import regress, solve
from vjm.symptoms.signals import Channels, centred

_IDLE = 0.02  # of a recording's largest torque: less drives nothing
_APART = 2  # windows between two whose phases give a frequency: half a window's length
_LEAST_RATIO = 8.0  # of an amplitude over its error
_LEAST_POINTS = 5
_LEAST_RANGE = 1.3  # of the largest over the smallest amplitude


@dataclass(frozen=True)
class FreeMotion:
    """Instantaneous frequency and damping of one band in one recording, P times.

    Attributes:
        recording: index.
        mode: index of the band.
        time: (P,) [s].
        amplitude: (P,) measured, of the coordinate that moves most [m, or rad of an encoder].
        unit: of the amplitude.
        frequencies: (P, 2) measured and simulated [Hz].
        frequency_std: (P,) of the measured ones.
        decays: (P, 2) measured and simulated [1/s].
        decay_std: (P,) of the measured ones.
    """

    recording: int
    mode: int
    time: Array
    amplitude: Array
    unit: str
    frequencies: Array
    frequency_std: Array
    decays: Array
    decay_std: Array


@dataclass(frozen=True)
class Trend:
    """How one band's frequency or damping changes with amplitude, in all recordings together.

    Attributes:
        mode: index of the band.
        frequency: its centre [Hz].
        of: which of the two: relative frequency, or damping ratio.
        change: from the smallest to the largest amplitude, measured less simulated [1].
        simulated: the same change of the simulation alone [1].
        amplitudes: smallest and largest [m or rad].
        unit: of the amplitudes.
        described: recordings (indices), and the misfit that it describes in each, in units of the noise squared.
    """

    mode: int
    frequency: float
    of: str
    change: Estimate
    simulated: float
    amplitudes: tuple[float, float]
    unit: str
    described: tuple[tuple[int, float], ...]


def free_stretch(recording: Recording) -> tuple[float, float] | None:
    """The longest stretch of time in which nothing drives the arm [s]; None where there is none."""
    time = recording.time
    if recording.kind == "decay" or recording.tau.shape[1] == 0:
        return float(time[0]), float(time[-1])
    known = np.isfinite(recording.tau).all(axis=1)
    if not known.any():
        return None
    torque = np.interp(time, time[known], np.abs(recording.tau[known]).max(axis=1))
    idle = torque <= _IDLE * torque.max()
    edges = np.flatnonzero(np.diff(np.r_[False, idle, False].astype(int)))
    if not edges.size:
        return None
    starts, stops = edges[::2], edges[1::2] - 1
    longest = int(np.argmax(time[stops] - time[starts]))
    return float(time[starts[longest]]), float(time[stops[longest]])


def free_motion(index: int, recording: Recording, sensors: Sequence[Channels], bands: Bands) -> list[FreeMotion]:
    """Frequency and damping, window by window, of every band that swings freely for long enough.

    Args:
        index: of the recording.
        recording: tells when nothing drives the arm.
        sensors: of the recording.
        bands: of the recording.
    """
    stretch = free_stretch(recording)
    found = [] if stretch is None else [_motion(index, sensors, band, stretch) for band in bands.bands]
    return [each for each in found if each is not None]


def _motion(index: int, sensors: Sequence[Channels], band: Band, stretch: tuple[float, float]) -> FreeMotion | None:
    own = band.demodulated[0]
    reach = REACH * own.length - 1e-9
    inside = (own.centres - reach >= stretch[0]) & (own.centres + reach <= stretch[1])
    measured, simulated, std, size = _together(own)
    there = inside & (np.abs(measured) > _LEAST_RATIO * std) & (np.abs(simulated) > std)
    first = np.flatnonzero(there[:-_APART] & there[_APART:])
    if first.size < 2:
        return None
    second = first + _APART
    step = own.centres[second] - own.centres[first]
    pair = np.stack([measured, simulated], axis=1)
    turned = np.angle(pair[second] * np.conj(pair[first])) / (2 * np.pi * step[:, None])
    dying = -np.log(np.abs(pair[second] / pair[first])) / step[:, None]
    relative = np.hypot(std[first] / np.abs(measured[first]), std[second] / np.abs(measured[second])) / step
    return FreeMotion(
        index,
        band.mode,
        0.5 * (own.centres[first] + own.centres[second]),
        size * np.sqrt(np.abs(measured[first] * measured[second])),
        sensors[band.sensors[0]].unit,
        band.frequency + turned,
        relative / (2 * np.pi),
        dying,
        relative,
    )


def _together(own: Demodulated) -> tuple[Complex, Complex, Array, float]:
    """(J,) measured and simulated amplitude along the band's shape, its error, and the shape's largest coordinate."""
    _, _, shapes = np.linalg.svd(own.simulated, full_matrices=False)
    shape = np.conj(shapes[0])
    std = np.sqrt(own.std**2 @ np.maximum(np.abs(shape) ** 2, 1e-300))
    return own.measured @ shape, own.simulated @ shape, std, float(np.abs(shape).max())


def trends(
    free: Sequence[FreeMotion], bands: Sequence[Bands | None], sensors: Sequence[Sequence[Channels]], mode: int
) -> list[Trend]:
    """Change of a mode's frequency and damping with amplitude, over all recordings.

    Args:
        free: of all recordings and modes.
        bands: of each recording; None where there are none.
        sensors: of each recording.
        mode: which.
    """
    own = [each for each in free if each.mode == mode]
    if not own or len({each.unit for each in own}) > 1:
        return []
    amplitude = np.concatenate([each.amplitude for each in own])
    if amplitude.size < _LEAST_POINTS or amplitude.max() < _LEAST_RANGE * amplitude.min():
        return []
    centre = float(np.concatenate([each.frequencies[:, 1] for each in own]).mean())
    found = []
    for of in ("frequency", "damping"):
        power, scale = (2, 1 / centre) if of == "frequency" else (1, 1 / (2 * np.pi * centre))
        pairs = np.concatenate([each.frequencies if of == "frequency" else each.decays for each in own]) * scale
        stds = np.concatenate([each.frequency_std if of == "frequency" else each.decay_std for each in own]) * scale
        place = (amplitude / amplitude.max()) ** power
        columns = np.stack([np.ones_like(place), place], axis=1) / stds[:, None]
        one = regress(columns, (pairs[:, 0] - pairs[:, 1]) / stds, np.arange(place.size))[1]
        alone = float(solve(columns, pairs[:, 1] / stds)[1])
        turn = one.value * 2 * np.pi * centre * (1j if of == "frequency" else -1.0)
        described = [
            (each.recording, _described(sensors[each.recording], bands[each.recording], each, turn, amplitude, power))
            for each in own
        ]
        reach, limits = float(np.ptp(place)), (float(amplitude.min()), float(amplitude.max()))
        trend = Trend(mode, centre, of, one.times(reach), alone * reach, limits, own[0].unit, tuple(described))
        found.append(trend)
    return found


def _described(
    sensors: Sequence[Channels], bands: Bands | None, free: FreeMotion, rate: complex, amplitude: Array, power: int
) -> float:
    """Misfit that a change of speed (imaginary) or decay (real) with amplitude describes beyond a constant one."""
    band = None if bands is None else bands.of_mode(free.mode)
    if bands is None or band is None:
        return 0.0
    total = 0.0
    for index, own in zip(band.sensors, band.demodulated, strict=True):
        sensor = sensors[index]
        size = np.interp(sensor.time, free.time, free.amplitude / amplitude.max()) ** power
        course = np.concatenate([[0.0], np.cumsum(0.5 * (size[1:] + size[:-1]) * np.diff(sensor.time))])
        weight = np.sqrt(np.sum(np.abs(own.wave) ** 2, axis=1))
        line = np.stack([np.ones_like(course), sensor.time], axis=1)
        bent = course - line @ solve(line * weight[:, None], course * weight)
        change = centred(((np.exp(rate * bent) - 1)[:, None] * own.wave).real, sensor.known) / sensor.noise
        total += float(np.sum(change * (2 * bands.left[index] - change)))
    return total
