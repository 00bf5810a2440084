"""The measured motion as the simulated one with an amplitude, phase, frequency and damping of its own in every band."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vjm.records import Array, Complex
from vjm.symptoms.demodulation import Demodulated
from vjm.symptoms.regression import Regression, regress, solve
from vjm.symptoms.signals import Channels, centred, middle_of_motion

TERMS = 4  # of a band: gain, phase, decay, speed
_MOST_STEPS = 8
_HALVINGS = 5
_ENOUGH = 1e-6  # relative decrease of the misfit that is not worth another step
_LARGEST_EXPONENT = 3.0  # of an amplitude ratio


@dataclass(frozen=True)
class Part:
    """One band in one sensor.

    Attributes:
        band: index among the bands that are there.
        sensor: index among the recording's sensors.
        demodulated: amplitudes window by window.
    """

    band: int
    sensor: int
    demodulated: Demodulated


@dataclass(frozen=True)
class BandModel:
    """Of one recording.

    Attributes:
        sensors: the recording's.
        parts: each band in each sensor that shows it.
        starts: (B,) when each band's motion begins [s]; gain and phase are those at that time.
    """

    sensors: tuple[Channels, ...]
    parts: tuple[Part, ...]
    starts: Array

    @property
    def size(self) -> int:
        """Number of parameters: four a band, then gain and delay of the rest, lag and clock of the camera."""
        return TERMS * len(self.starts) + len(self.linear)

    @cached_property
    def linear(self) -> tuple[list[Array], ...]:
        """For each parameter that belongs to no band, (F, C) what it does to each sensor [m or rad].

        The gain and the delay [s] of what the simulation has outside the bands; where there are two sensors, also the
        lag of the camera behind the encoders [s], and by how much more time it counts.
        """
        shapes, rates, lags, clocks = [], [], [], []
        for index, sensor in enumerate(self.sensors):
            wave = sum((p.demodulated.wave.real for p in self.parts if p.sensor == index), np.zeros(1))
            rest = sensor.simulated - wave
            rate = np.gradient(rest, sensor.time, axis=0) if len(sensor.time) > 1 else np.zeros_like(rest)
            shapes.append(centred(rest, sensor.known) * sensor.moving)
            rates.append(-rate * sensor.moving)
            late = -sensor.rate * (sensor.sensor == "camera")
            lags.append(late)
            clocks.append(late * (sensor.time - middle_of_motion(self.sensors[0]))[:, None])
        return (shapes, rates, lags, clocks) if len(self.sensors) > 1 else (shapes, rates)

    @cached_property
    def blocks(self) -> NDArray[np.intp]:
        """(N,) stretch of time of everything that was measured."""
        return np.concatenate([np.broadcast_to(s.blocks, s.known.T.shape)[s.known.T] for s in self.sensors])

    @cached_property
    def residual(self) -> Array:
        """(N,) measured less simulated, each coordinate less its mean, in units of the noise."""
        return self.stacked([centred(sensor.residual, sensor.known) for sensor in self.sensors])

    def stacked(self, values: Sequence[Array]) -> Array:
        """(N,) of values (F, C), one array a sensor, where something was measured."""
        return np.concatenate([v.T[s.known.T] for v, s in zip(values, self.sensors, strict=True)])

    def change(self, x: Array) -> Array:
        """(N,) what parameters x do to the simulation, each coordinate less its mean, in units of the noise."""
        own = x[TERMS * len(self.starts) :]
        changes = [sum(value * each[k] for value, each in zip(own, self.linear, strict=True)) for k in self._places]
        for part in self.parts:
            wave = part.demodulated.wave * (self.factor(part, x) - 1)[:, None]
            changes[part.sensor] = changes[part.sensor] + wave.real
        return self._scaled(changes)

    def columns(self, x: Array) -> Array:
        """(N, p) derivatives of the change."""
        zero = [np.zeros_like(each) for each in self.linear[0]]
        columns = [list(zero) for _ in range(TERMS * len(self.starts))]
        for part in self.parts:
            wave = part.demodulated.wave * self.factor(part, x)[:, None]
            since = (self.sensors[part.sensor].time - self.starts[part.band])[:, None]
            first = TERMS * part.band
            derivatives = (wave.real, -wave.imag, -since * wave.real, -since * wave.imag)
            for k, derivative in enumerate(derivatives):
                columns[first + k][part.sensor] = derivative
        return np.stack([self._scaled(each) for each in (*columns, *self.linear)], axis=1)

    @property
    def _places(self) -> range:
        return range(len(self.sensors))

    def factor(self, part: Part, x: Array) -> Complex:
        """(F,) by what a band's motion is multiplied."""
        gain, phase, decay, speed = x[TERMS * part.band : TERMS * (part.band + 1)]
        since = self.sensors[part.sensor].time - self.starts[part.band]
        growth = np.clip(gain - decay * since, -_LARGEST_EXPONENT, _LARGEST_EXPONENT)
        factor: Complex = np.exp(growth + 1j * (phase + speed * since))
        return factor

    def _scaled(self, values: Sequence[Array]) -> Array:
        pairs = zip(values, self.sensors, strict=True)
        return self.stacked([centred(each, sensor.known) / sensor.noise for each, sensor in pairs])

    def suggestion(self) -> Array:
        """Parameters that the ratios of the demodulated amplitudes suggest."""
        x = np.zeros(self.size)
        for band, start in enumerate(self.starts):
            own = [part.demodulated for part in self.parts if part.band == band]
            x[TERMS * band : TERMS * (band + 1)] = _suggested(own, float(start))
        return x

    def fit(self) -> tuple[Array, Regression]:
        """The best parameters (Gauss-Newton with halved steps), and their errors."""
        starts = [np.zeros(self.size), self.suggestion()]
        costs = [self._cost(x) for x in starts]
        x, cost = starts[int(np.argmin(costs))], min(costs)
        for _ in range(_MOST_STEPS):
            step = solve(self.columns(x), self.residual - self.change(x))
            trials = ((x + step / 2**k) for k in range(_HALVINGS))
            better = next((trial for trial in trials if self._cost(trial) < cost), x)
            gained, x = cost - self._cost(better), better
            cost -= gained
            if gained < _ENOUGH * cost:
                break
        columns = self.columns(x)
        lost = sum(len(sensor.names) for sensor in self.sensors)
        return x, regress(columns, self.residual - self.change(x) + columns @ x, self.blocks, lost)

    def _cost(self, x: Array) -> float:
        return float(np.sum((self.residual - self.change(x)) ** 2))


def ratio(demodulated: Demodulated) -> tuple[Complex, Array]:
    """(J,) measured over simulated amplitude, all coordinates together, and its standard error.

    Zero, with an infinite error, where the simulation has no motion in the window.
    """
    weights = np.where(np.isfinite(demodulated.std), 1 / np.maximum(demodulated.std, 1e-300) ** 2, 0.0)
    power = np.sum(weights * np.abs(demodulated.simulated) ** 2, axis=1)
    cross = np.sum(weights * np.conj(demodulated.simulated) * demodulated.measured, axis=1)
    there = power > 0
    safe = np.where(there, power, 1.0)
    return np.where(there, cross / safe, 0.0), np.where(there, safe**-0.5, np.inf)


def _suggested(own: Sequence[Demodulated], start: float) -> Array:
    """(4,) gain, phase, decay and speed from the logarithms of the ratios, window by window."""
    x = np.zeros(TERMS)
    rows = []
    for each in own:
        value, std = ratio(each)
        rows.append((each.centres, value, np.where(np.abs(value) > 3 * std, np.abs(value) / std, 0.0)))
    if not rows:
        return x
    time, value, weight = max(rows, key=lambda row: float(np.sum(row[2] ** 2)))
    kept = weight > 0
    if kept.sum() < 2:
        return x
    since, logarithm = time[kept] - start, np.log(np.abs(value[kept]))
    angle = np.unwrap(np.angle(value[kept]))
    line = np.stack([np.ones_like(since), since], axis=1) * weight[kept, None]
    (x[0], slope), (x[1], x[3]) = (
        np.linalg.lstsq(line, each * weight[kept], rcond=1e-9)[0] for each in (logarithm, angle)
    )
    x[2] = -slope
    x[1] = np.angle(np.exp(1j * x[1]))
    return x
