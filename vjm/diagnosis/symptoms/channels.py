"""Sensor channels of a simulated recording: linear regression on their residuals, spectra and tones.

Markers of a link that turns are resolved along and across the link, in axes that turn with the simulated joints, and
the motion is unrolled: it is the integral of the velocity in those axes, so that a marker on a slewing arm moves as on
a straight rail. Residuals and noise stay as they are; a constant offset in the link's own frame is a constant.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import signal, stats
from scipy.interpolate import CubicSpline, PPoly

from vjm.records import Array, Indices, Mask, Rig, SimulatedRecording

_LEAST_VALUES = 8  # measured values of a channel; with fewer than about two a coefficient nothing can be tested
GROUPS = 12  # stretches of time taken as independent: few, so that each outlasts the residual's correlation


class Coefficient(NamedTuple):
    """A coefficient of a regression; by default one that the data do not determine."""

    value: float = 0.0
    std: float = np.inf  # standard error; infinite where the data do not determine the value
    p_value: float = 1.0  # probability that a residual without this component shows as much
    explained: float = 0.0  # decrease of the residual's sum of squares by it, in units of the noise

    @classmethod
    def of(cls, value: float, white_std: float, cluster_std: float, freedom: int) -> Coefficient:
        """Take the larger standard error of white noise and of a few clusters (Student), and the larger p-value."""
        if not np.isfinite([value, white_std, cluster_std]).all() or white_std <= 0:
            return cls()
        p_value = 2 * stats.norm.sf(abs(value) / white_std)
        if cluster_std > 0:
            p_value = max(p_value, 2 * stats.t.sf(abs(value) / cluster_std, max(freedom, 1)))
        return cls(float(value), float(max(white_std, cluster_std)), float(p_value))

    @property
    def known(self) -> bool:
        """True if the data determine the value."""
        return bool(np.isfinite(self.std))

    def times(self, factor: float) -> Coefficient:
        """Return the coefficient in another unit."""
        return self._replace(value=self.value * factor, std=self.std * abs(factor))


def explained(change: Array, residual: Array) -> float:
    """Return by how much a change of the simulation lowers the sum of squares of a residual, both of any shape."""
    return float(np.sum(change * (2 * residual - change)))


def regress(columns: Array, residual: Array, groups: Indices, freedom_lost: int = 0) -> tuple[list[Coefficient], Array]:
    """Fit columns (N, p) to a residual (N,) by least squares, with standard errors that hold for a correlated residual.

    The errors are the largest of white noise of the known size, white noise of the residual's own size, and the
    cluster-robust sandwich (Liang and Zeger 1986, Biometrika 73) over stretches of time `groups` (N,). Columns and
    residual are in units of the noise; `freedom_lost` degrees of it were taken out of them beforehand. Returns the
    coefficients (p), unknown where other columns make up the same, and the remaining residual (N,).
    """
    from statsmodels.regression.linear_model import OLS

    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = np.inf
    scaled = columns / size
    eigenvalues, vectors = np.linalg.eigh(scaled.T @ scaled)
    dependent = eigenvalues < 1e-10 * max(float(eigenvalues[-1]), 1e-300)
    basis = vectors[:, ~dependent]
    # A column of which the others leave less than 1e-6 (squared sine of the angle between them) has no own coefficient.
    variances = np.sum(basis**2 / eigenvalues[~dependent], axis=1)
    determined = np.isfinite(size) & (np.sum(vectors[:, dependent] ** 2, axis=1) < 1e-3) & (variances < 1e6)
    count = int(np.unique(groups).size)
    if count < 2 or residual.size <= columns.shape[1] or not determined.any():
        return [Coefficient()] * columns.shape[1], residual
    fit = OLS(residual, scaled @ basis).fit(cov_type="cluster", cov_kwds={"groups": groups}, use_t=True)
    remaining, values = np.asarray(fit.resid), basis @ fit.params
    noise = max(float(remaining @ remaining) / max(remaining.size - columns.shape[1] - freedom_lost, 1), 1.0)
    white, cluster = np.sqrt(noise * variances), np.sqrt(np.maximum(np.diag(basis @ fit.cov_params() @ basis.T), 0.0))
    coefficients = [Coefficient()] * columns.shape[1]
    for k in np.flatnonzero(determined):
        coefficient = Coefficient.of(values[k], white[k], cluster[k], count - 1).times(1 / size[k])
        # Without the column, the others fitted again, the sum of squares would be so much larger.
        coefficients[k] = coefficient._replace(explained=float(values[k] ** 2 / variances[k]))
    return coefficients, remaining


class Tone(NamedTuple):
    """A sinusoid in a residual."""

    frequency: float  # [Hz]
    amplitude: Coefficient  # where it is largest [m or rad]
    coordinate: str  # that coordinate
    simulated: float  # amplitude of the simulation there [m or rad]
    wave: Array  # (F, C) in units of the noise


@dataclass(frozen=True)
class Channels:
    """The F instants and C coordinates of one sensor in one recording, measured and simulated."""

    sensor: str  # `camera` or `encoder`
    names: tuple[str, ...]  # (C) `beam.m3.y`, `beam.m3 across` where the axes turn with the link, `beam.theta`
    places: tuple[tuple[int, int], ...]  # (C) marker and axis (0: x or along, 1: y or across), or joint and 0
    time: Array  # (F,) instants at which anything was measured [s]
    path: PPoly  # simulated coordinates as a function of time, giving (F, C) [m or rad]
    residual: Array  # (F, C) measured minus simulated, in units of the noise; zero where not measured
    known: Mask  # (F, C) where measured
    noise: float  # 1-sigma [m or rad]
    groups: Indices  # (F,) stretch of time of each instant, the same for all sensors

    @classmethod
    def of(cls, rig: Rig, simulated: SimulatedRecording) -> tuple[Channels, ...]:
        """Return the sensors that measured anything in a recording, the camera first."""
        recording, simulation = simulated.recording, simulated.simulation
        time, count = recording.time, recording.time.size
        if count < _LEAST_VALUES:
            return ()
        turns = _turns(rig, simulated)
        velocity = _turned(CubicSpline(time, simulation.markers)(time, 1), turns).reshape(count, -1)
        path = CubicSpline(time, velocity).antiderivative()
        path.c[-1] += _turned(simulation.markers[:1], turns[:1]).reshape(1, -1)
        axes = [(" along", " across") if turning else (".x", ".y") for turning in np.any(turns != 0, axis=0)]
        coordinates = [(name + axes[m][axis], (m, axis)) for m, name in enumerate(rig.marker_names) for axis in (0, 1)]
        joints = [(f"{rig.links[i].name}.theta", (j, 0)) for j, i in enumerate(rig.active_links)]
        residual = _turned(simulated.marker_residual, turns).reshape(count, -1)
        sensors: list[Channels] = []
        for sensor, labels, curve, values, noise in (
            ("camera", coordinates, path, residual, simulated.noise[0]),
            ("encoder", joints, CubicSpline(time, simulation.theta), simulated.theta_residual, simulated.noise[1]),
        ):
            columns = np.flatnonzero(np.isfinite(values).sum(axis=0) >= _LEAST_VALUES)
            if not columns.size:
                continue
            rows = np.flatnonzero(np.isfinite(values[:, columns]).any(axis=1))
            data, blocks = values[np.ix_(rows, columns)], min(GROUPS, max(rows.size // 4, 2))
            groups = np.minimum(((time[rows] - time[0]) / (time[-1] - time[0]) * blocks).astype(np.intp), blocks - 1)
            names, places = zip(*(labels[column] for column in columns), strict=True)
            motion, scaled = PPoly(curve.c[:, :, columns], curve.x), np.nan_to_num(data) / noise
            sensors.append(cls(sensor, names, places, time[rows], motion, scaled, np.isfinite(data), noise, groups))
        return tuple(sensors)

    @cached_property
    def simulated(self) -> Array:
        """(F, C) [m or rad]."""
        return np.asarray(self.path(self.time), dtype=np.float64)

    @cached_property
    def rate(self) -> Array:
        """(F, C) of the simulation [m/s or rad/s]."""
        return np.asarray(self.path(self.time, 1), dtype=np.float64)

    @property
    def measured(self) -> Array:
        """(F, C) [m or rad]; the simulated values where nothing was measured."""
        return self.simulated + self.noise * self.residual

    @cached_property
    def moving(self) -> Mask:
        """(C,) whether the simulated motion stands out of the noise (three sigma)."""
        power = np.sum(self.centred(self.simulated) ** 2, axis=0) / self.counts
        return np.asarray(np.sqrt(power) > 3 * self.noise)

    @cached_property
    def counts(self) -> Array:
        """(C,) numbers of measured values, at least one."""
        return np.asarray(np.maximum(self.known.sum(axis=0), 1), dtype=np.float64)

    @property
    def unknown(self) -> int:
        """Number of values that were not measured."""
        return int(np.sum(~self.known))

    @property
    def all_groups(self) -> Indices:
        """(F C,) stretch of time of each value."""
        return np.repeat(self.groups, len(self.names))

    @property
    def unit(self) -> str:
        """Unit of the coordinates."""
        return "m" if self.sensor == "camera" else "rad"

    @property
    def step(self) -> float:
        """Median interval between instants [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def duration(self) -> float:
        """Time from the first to the last instant [s]."""
        return float(self.time[-1] - self.time[0])

    def centred(self, values: Array) -> Array:
        """Return values (F, C) minus each channel's mean over what is known; zero elsewhere."""
        return np.where(self.known, values - np.sum(np.where(self.known, values, 0.0), axis=0) / self.counts, 0.0)

    def slow_columns(self, time: Array, highest: float) -> Array:
        """Return cosines below a frequency [Hz] over the recording, (T, K + 1), the constant first."""
        count = min(int(2 * self.duration * highest), 40)
        return np.asarray(np.cos(np.pi * ((time - self.time[0]) / self.duration)[:, None] * np.arange(count + 1)))

    def _evenly(self, values: Array) -> Array:
        """Return values (F, C) on an even grid of instants, zero where nothing was measured."""
        place = np.round((self.time - self.time[0]) / self.step).astype(np.intp)
        even = np.zeros((int(place[-1]) + 1, values.shape[1]))
        even[place] = values
        return even

    @cached_property
    def delay(self) -> Coefficient:
        """Delay against the simulation [s]: the peak of their cross-correlation, then regression."""
        if not self.moving.any() or self.step <= 0:
            return Coefficient()
        signals = [self._evenly(self.centred(values * self.moving)) for values in (self.measured, self.simulated)]
        pairs = zip(signals[0].T, signals[1].T, strict=True)
        correlation = np.sum([signal.correlate(*pair, method="fft") for pair in pairs], axis=0)
        start = self.step * (int(np.argmax(correlation)) - correlation.size // 2)
        centred_time = (self.time - self.time.mean())[:, None]
        estimate = Coefficient()
        for _ in range(3):  # the motion is not linear in a delay
            shifted, rate = (self.path(self.time - start, order) for order in (0, 1))
            motion = self.centred(shifted) * self.moving
            power = np.maximum(np.sum(motion**2, axis=0), 1e-300)
            parts = []
            for values in (self.measured - shifted, -rate, -rate * centred_time):  # residual, delay, and another clock
                inner = self.centred(values * self.moving)
                own = inner - motion * (np.sum(motion * inner, axis=0) / power)  # each coordinate has a gain of its own
                parts.append(own.ravel() / self.noise)
            freedom_lost = 2 * len(self.names) + self.unknown
            estimate = regress(np.stack(parts[1:], axis=1), parts[0], self.all_groups, freedom_lost)[0][0]
            if not estimate.known:
                return Coefficient()
            start += estimate.value
        change = (self.path(self.time - start) - self.simulated) * self.known / self.noise
        delay = Coefficient.of(start, estimate.std, estimate.std, int(self.groups[-1]))
        return delay._replace(explained=explained(change, self.residual))

    def spectrum(self, residual: Array) -> tuple[Array, Array]:
        """Return frequencies (L,) [Hz], and mean power (L,) of the coordinates, that of white noise being one."""
        even = self._evenly(residual / np.sqrt(self.counts))
        power = np.mean(np.abs(np.fft.rfft(even, 4 * len(even), axis=0)[1:-1]) ** 2, axis=1)
        return np.asarray(np.fft.rfftfreq(4 * len(even), self.step)[1:-1], dtype=np.float64), power

    def strongest_tone(self, residual: Array, white: bool = False, modes: Sequence[float] = ()) -> Tone | None:
        """Return the strongest sinusoid of a residual (F, C); None where it is likely to be chance.

        White noise alone, or also what a model misses is expected beside it; nothing is looked for near `modes` [Hz].
        """
        if self.time.size < 3 * _LEAST_VALUES:
            return None
        frequency, power = self.spectrum(residual)
        lowest = 2 / self.duration  # two periods
        allowed = (frequency >= lowest) & (frequency < 0.98 * frequency[-1])
        for mode in modes:
            allowed &= np.abs(frequency - mode) > max(2 * lowest, 0.15 * mode)
        if not allowed.any():
            return None
        best, columns = int(np.argmax(np.where(allowed, power, 0.0))), len(self.names)
        distance = np.abs(np.arange(power.size) - best)
        neighbours = power[(distance > 8) & (distance <= 48)]  # a dozen lines on either side, without the peak's own
        ratio = float(power[best]) / max(float(np.median(neighbours)) if neighbours.size else 1.0, 1.0)
        # White noise is independent in every coordinate; what a model misses may be the same in all of them.
        chance = float(stats.chi2.sf(2 * columns * ratio, 2 * columns)) if white else 0.5**ratio
        chance *= np.count_nonzero(allowed) / 4
        if chance > 0.01:
            return None
        below, top, above = np.log(power[best - 1 : best + 2])  # the vertex of a parabola lies between spectral lines
        peak = float(frequency[best] + 0.5 * (below - above) / (below - 2 * top + above) * frequency[0])
        pair = np.stack([np.cos(2 * np.pi * peak * self.time), np.sin(2 * np.pi * peak * self.time)], axis=1)
        wave, sizes = np.zeros_like(residual), np.zeros(columns)
        for column, rows in enumerate(self.known.T):
            amplitudes, *_ = np.linalg.lstsq(pair[rows], residual[rows, column], rcond=None)
            wave[rows, column], sizes[column] = pair[rows] @ amplitudes, math.hypot(*amplitudes)
        largest = int(np.argmax(sizes))
        noise = max(float(np.mean((residual - wave)[self.known] ** 2)), 1.0)
        std = self.noise * math.sqrt(2 * noise / self.counts[largest])
        window = signal.windows.hann(self.time.size) ** 2  # lets nothing slower into the simulation's own amplitude
        motion = self.simulated[:, largest] - np.average(self.simulated[:, largest], weights=window)
        swing = 2 * abs(np.sum(window * motion * (pair[:, 0] - 1j * pair[:, 1]))) / np.sum(window)
        amplitude = Coefficient(self.noise * sizes[largest], std, chance, explained(wave, residual))
        return Tone(peak, amplitude, self.names[largest], float(swing), wave)


def _turns(rig: Rig, simulated: SimulatedRecording) -> Array:
    """Return (T, k) angles by which the axes of markers turn [rad]; zero where one coordinate alone is measured."""
    markers = simulated.recording.markers
    turns = np.zeros(markers.shape[:2])
    complete = np.isfinite(markers.sum(axis=2)).any(axis=0)
    for i, (link, columns) in enumerate(zip(rig.links, rig.marker_slices, strict=True)):
        before = [j for j, active in enumerate(rig.active_links) if active <= i]
        if link.markers_frame == "base" and before:
            turns[:, columns] = simulated.simulation.theta[:, before].sum(axis=1, keepdims=True) * complete[columns]
    return turns


def _turned(vectors: Array, turns: Array) -> Array:
    """Resolve (T, k, 2) vectors in axes that have turned by (T, k) angles [rad]."""
    x, y = vectors[..., 0], vectors[..., 1]
    cosine, sine = np.cos(turns), np.sin(turns)
    fixed = np.all(turns == 0, axis=0)  # NaN in one coordinate must not spoil the other
    return np.stack([np.where(fixed, x, cosine * x + sine * y), np.where(fixed, y, cosine * y - sine * x)], axis=2)


class SensorAtRest(NamedTuple):
    """A sensor while nothing moves."""

    channels: Channels
    size: Coefficient  # root mean square over the noise supposed, minus one
    correlation: Coefficient  # of one value with the next, any tone taken out
    tone: Tone | None

    @classmethod
    def of(cls, sensor: Channels) -> SensorAtRest | None:
        """Return size, correlation and tone of a sensor's residual at rest.

        None with hardly any values, and where each coordinate has one value throughout: a sensor that rounds shows
        nothing of its noise at rest.
        """
        from statsmodels.stats.diagnostic import acorr_ljungbox

        if sensor.time.size < 3 * _LEAST_VALUES:
            return None
        measured = np.where(sensor.known, sensor.measured, np.nan)
        smallest, largest = np.nanmin(measured, axis=0), np.nanmax(measured, axis=0)
        varying = ~np.isclose(smallest, largest, rtol=1e-12, atol=1e-9 * sensor.noise)
        if not varying.any():
            return None
        count, power = int(sensor.known.sum()), np.sum(sensor.residual**2, axis=1)
        size = math.sqrt(power.sum() / count) - 1
        means = np.bincount(sensor.groups, power) / np.maximum(np.bincount(sensor.groups, sensor.known.sum(axis=1)), 1)
        scatter = float(np.std(means, ddof=1)) / math.sqrt(means.size) / 2 / (1 + size)
        # The noise supposed may itself be off by three per cent, where it was estimated from recordings.
        larger = Coefficient.of(size, math.hypot((2 * count) ** -0.5, 0.03), scatter, means.size - 1)
        tone = sensor.strongest_tone(sensor.residual, white=True)
        clean = sensor.centred(sensor.residual - (0.0 if tone is None else tone.wave))
        columns = [column[known] for column, known in zip(clean.T[varying], sensor.known.T[varying], strict=True)]
        statistic = sum(float(acorr_ljungbox(column, lags=[1])["lb_stat"].iloc[0]) for column in columns)
        cross, variance = (sum(float(column[k:] @ column[: column.size - k]) for column in columns) for k in (1, 0))
        chance = float(stats.chi2.sf(statistic, len(columns)))
        correlation = Coefficient(cross / variance, count**-0.5, chance, cross**2 / variance)
        return cls(sensor, larger._replace(explained=abs(float(power.sum()) - count)), correlation, tone)
