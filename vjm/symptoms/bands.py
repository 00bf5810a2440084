"""Amplitude, phase, frequency and damping of each band of a recording, measured against simulated.

Of every band, the simulated motion z(t) is taken as complex, and the measured one as z(t) exp(eta(t)) with
eta = gain + i phase + (i speed - decay) (t - start); what lies in no band may have a gain and a delay, and the camera a
clock of its own. All are fitted together, over all markers and encoders, whose offsets are free.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.records import Array
from vjm.symptoms.band_model import TERMS, BandModel, Part
from vjm.symptoms.demodulation import REACH, Demodulated, demodulate, visible
from vjm.symptoms.records import UNKNOWN, Estimate
from vjm.symptoms.regression import estimate, regress
from vjm.symptoms.signals import Channels, centred

_LEAST_SIGNAL = 30.0  # a band's motion over the noise, root of the sum of squares, below which it is not there
_LEAST_PART = 0.1  # of the motion of the coordinate that moves most in a band
_ALIVE = 0.05  # of its largest amplitude: where a band's motion begins and ends
_BLUR = 0.04  # relative error of what is found in a band: none is cut out of its surroundings perfectly
_SURE = 3.0  # standard errors
_FAR = 2.0  # logarithm of an amplitude ratio, or phase, from which one motion is no longer the other one changed


@dataclass(frozen=True)
class Band:
    """One band of one recording, all sensors together.

    Attributes:
        mode: index of its frequency in the list that all recordings share.
        frequency: centre [Hz].
        gain: natural logarithm of measured over simulated amplitude at `start`.
        phase: by how much the measured motion is ahead at `start` [rad].
        decay: by how much faster it dies out [1/s].
        speed: by how much faster it swings [rad/s].
        described: misfit that gain, phase, decay and speed describe, in units of the noise squared; the two last beyond
            what the two first do by themselves.
        start: when its motion begins [s].
        end: when it ends [s].
        size: natural logarithm of measured over simulated root mean square, phases disregarded.
        shapes: for each marker coordinate that moves in the band, its name and the logarithm of its own amplitude
            ratio over that of all; and the misfit described.
        sensors: indices of the recording's sensors that show it, and
        demodulated: what each of them shows.
    """

    mode: int
    frequency: float
    gain: Estimate
    phase: Estimate
    decay: Estimate
    speed: Estimate
    described: tuple[float, float, float, float]
    start: float
    end: float
    size: Estimate
    shapes: tuple[tuple[str, Estimate, float], ...]
    sensors: tuple[int, ...]
    demodulated: tuple[Demodulated, ...]

    @property
    def comparable(self) -> bool:
        """Whether what was measured swings so much like what was simulated that the two can be compared."""
        return bool(np.hypot(self.gain.value, self.phase.value) < _FAR)

    @property
    def ahead(self) -> float:
        """By how much the measured motion is ahead when it ends [rad], as far as that is sure."""
        return _certain(self.phase) + _certain(self.speed) * (self.end - self.start)


@dataclass(frozen=True)
class Bands:
    """All bands of one recording.

    Attributes:
        bands: those in which the simulation moves, by mode.
        rest_gain: of what lies in no band: measured over simulated amplitude, less one; and
        rest_delay: by how much it comes later [s].
        lag: of the camera behind the encoders [s]; and
        clock: by how much more time it counts, relative; both unknown where one of the two is missing.
        others: misfit that each of these four describes, in units of the noise squared.
        left: for each sensor, (F, C) what all of this leaves, in units of the noise; zero where not measured.
    """

    bands: tuple[Band, ...]
    rest_gain: Estimate
    rest_delay: Estimate
    lag: Estimate
    clock: Estimate
    others: tuple[float, float, float, float]
    left: tuple[Array, ...]

    def of_mode(self, mode: int) -> Band | None:
        """The band of a mode; None where the recording does not show it."""
        return next((band for band in self.bands if band.mode == mode), None)


def compare_bands(sensors: Sequence[Channels], frequencies: Sequence[float]) -> Bands:
    """Bands of one recording.

    Args:
        sensors: of the recording, at least one.
        frequencies: natural frequencies [Hz].
    """
    modes, parts = _present(sensors, frequencies)
    first = [next(part.demodulated for part in parts if part.band == band) for band in range(len(modes))]
    spans = [_span(each) for each in first]
    model = BandModel(tuple(sensors), tuple(parts), np.array([start for start, _ in spans]))
    x, found = model.fit()
    residual = model.residual
    left = _unstacked(model, residual - model.change(x))
    bands = []
    for band, mode in enumerate(modes):
        own = [part for part in parts if part.band == band]
        terms = [_blurred(found[TERMS * band + k]) for k in range(TERMS)]
        bands.append(
            Band(
                mode=mode,
                frequency=float(frequencies[mode]),
                gain=terms[0],
                phase=terms[1],
                decay=terms[2],
                speed=terms[3],
                described=_described(model, residual, x, band),
                start=spans[band][0],
                end=spans[band][1],
                size=_size(own[0].demodulated),
                shapes=_shapes(model, own[0], x, left),
                sensors=tuple(part.sensor for part in own),
                demodulated=tuple(part.demodulated for part in own),
            )
        )
    others = [
        (found[k], _reduction(model, residual, x, [k])) if k < model.size else (UNKNOWN, 0.0)
        for k in range(TERMS * len(modes), TERMS * len(modes) + 4)
    ]
    (gain, *_), (delay, *_), (lag, *_), (clock, *_) = others
    shares = (others[0][1], others[1][1], others[2][1], others[3][1])
    return Bands(tuple(band for band in bands if band.comparable), gain, delay, lag, clock, shares, left)


def _certain(found: Estimate) -> float:
    return found.value if abs(found.value) > _SURE * found.std else 0.0


def _blurred(found: Estimate) -> Estimate:
    return found._replace(std=float(np.hypot(found.std, _BLUR * found.value)))


def _reduction(model: BandModel, residual: Array, x: Array, kept: Sequence[int]) -> float:
    """Misfit that some of the parameters describe."""
    change = model.change(np.where(np.isin(np.arange(x.size), kept), x, 0.0))
    return float(2 * change @ residual - change @ change)


def _described(model: BandModel, residual: Array, x: Array, band: int) -> tuple[float, float, float, float]:
    gain, phase, decay, speed = range(TERMS * band, TERMS * (band + 1))
    size, angle = (max(_reduction(model, residual, x, [k]), 0.0) for k in (gain, phase))
    dying = _reduction(model, residual, x, [gain, decay]) - size
    turning = _reduction(model, residual, x, [phase, speed]) - angle
    return size, angle, dying, turning


def _present(sensors: Sequence[Channels], frequencies: Sequence[float]) -> tuple[list[int], list[Part]]:
    """Modes in whose band the simulation moves, and each of them in the sensors that show it."""
    modes: list[int] = []
    parts: list[Part] = []
    for mode, frequency in enumerate(frequencies):
        others = [float(each) for k, each in enumerate(frequencies) if k != mode]
        own = []
        for index, sensor in enumerate(sensors):
            if visible(sensor, frequency) and sensor.moving.any():
                found = demodulate(sensor, float(frequency), others)
                found = _without_strangers(sensor, found)
                power = np.sum(np.abs(found.wave * sensor.known * sensor.moving) ** 2) / (2 * sensor.noise**2)
                if power > _LEAST_SIGNAL**2:
                    own.append(Part(len(modes), index, found))
        if own:
            modes.append(mode)
            parts += own
    return modes, parts


def _without_strangers(sensor: Channels, found: Demodulated) -> Demodulated:
    """Without what is no vibration: motion along the links, and what leaks into coordinates that hardly move."""
    lateral = np.array([axis == 1 for _, axis in sensor.places])
    sizes = np.sqrt(np.sum(np.abs(found.simulated) ** 2, axis=0)) * (lateral if lateral.any() else 1.0)
    own = sizes > _LEAST_PART * sizes.max()
    return replace(found, simulated=found.simulated * own, measured=found.measured * own, wave=found.wave * own)


def _size(demodulated: Demodulated) -> Estimate:
    """Measured over simulated motion, all windows and coordinates together, less the noise's part."""
    variance = np.where(np.isfinite(demodulated.std), demodulated.std**2, 0.0)
    powers = np.abs(demodulated.measured) ** 2, np.abs(demodulated.simulated) ** 2
    seen = variance > 0
    noise, own, model = 2 * float(variance.sum()), float(powers[0][seen].sum()), float(powers[1][seen].sum())
    if own <= 2 * noise or model <= 0:
        return UNKNOWN
    std = float(np.sqrt(np.sum(powers[0] * variance))) / own
    return _blurred(estimate(0.5 * float(np.log((own - noise) / model)), std, 0.0, 1))


def _span(demodulated: Demodulated) -> tuple[float, float]:
    """When a band's motion begins and ends [s]."""
    size = np.sqrt(np.sum(np.abs(demodulated.simulated) ** 2, axis=1))
    alive = np.flatnonzero(size > _ALIVE * size.max())
    reach = REACH * demodulated.length  # of the first and last window, to the ends of the recording
    centres = demodulated.centres
    return (
        float(centres[alive[0]] - (reach if alive[0] == 0 else 0.0)),
        float(centres[alive[-1]] + (reach if alive[-1] + 1 == size.size else 0.0)),
    )


def _unstacked(model: BandModel, values: Array) -> tuple[Array, ...]:
    found, start = [], 0
    for sensor in model.sensors:
        count = int(sensor.known.sum())
        filled = np.zeros(sensor.known.T.shape)
        filled[sensor.known.T] = values[start : start + count]
        found.append(filled.T)
        start += count
    return tuple(found)


def _shapes(model: BandModel, part: Part, x: Array, left: Sequence[Array]) -> tuple[tuple[str, Estimate, float], ...]:
    """How the amplitude of each coordinate differs from what all of them say."""
    sensor = model.sensors[part.sensor]
    wave = part.demodulated.wave * model.factor(part, x)[:, None] / sensor.noise
    columns = [centred(each, sensor.known) for each in (wave.real, -wave.imag)]
    found = []
    for c, name in enumerate(sensor.names):
        rows = sensor.known[:, c]
        pair = np.stack([each[rows, c] for each in columns], axis=1)
        if np.sum(pair[:, 0] ** 2) < _LEAST_SIGNAL**2:
            continue
        one = regress(pair, left[part.sensor][rows, c], sensor.blocks[rows], 1)
        change = one[0].value * pair[:, 0]
        found.append((name, one[0], float(2 * change @ left[part.sensor][rows, c] - change @ change)))
    return tuple(found)
