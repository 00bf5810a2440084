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
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats
from scipy.interpolate import CubicSpline, PPoly

from vjm.records import Array, Indices, Mask, Rig, SimulatedRecording

T = TypeVar("T", np.float64, np.intp)
LEAST_VALUES = 8  # measured values of a channel; with fewer than about two a coefficient nothing can be tested
_GROUPS = 12  # stretches of time taken as independent: few, so that each outlasts the residual's correlation


class Coefficient(NamedTuple):
    """A coefficient of a regression."""

    value: float
    std: float  # standard error; infinite where the data do not determine the value
    p_value: float  # probability that a residual without this component shows as much

    @property
    def known(self) -> bool:
        """True if the data determine the value."""
        return bool(np.isfinite(self.std))

    def times(self, factor: float) -> Coefficient:
        """Return the coefficient in another unit."""
        return Coefficient(self.value * factor, self.std * abs(factor), self.p_value)


UNKNOWN = Coefficient(0.0, np.inf, 1.0)


def coefficient(value: float, noise_std: float, group_std: float, freedom: int) -> Coefficient:
    """Return a coefficient with the larger of two standard errors and the larger of two p-values.

    Args:
        value: of the coefficient.
        noise_std: standard error under white noise, normally distributed.
        group_std: standard error from a few groups, with Student's distribution of so many degrees of
        freedom: of freedom.
    """
    if not np.isfinite([value, noise_std, group_std]).all() or noise_std <= 0:
        return UNKNOWN
    p_value = 2 * stats.norm.sf(abs(value) / noise_std)
    if group_std > 0:
        p_value = max(p_value, 2 * stats.t.sf(abs(value) / group_std, max(freedom, 1)))
    return Coefficient(float(value), float(max(noise_std, group_std)), float(p_value))


def regress(columns: Array, residual: Array, groups: Indices, lost: int = 0) -> tuple[list[Coefficient], Array]:
    """Fit columns to a residual by least squares, with standard errors that hold for a correlated residual.

    The errors are the largest of white noise of the known size, white noise of the residual's own size, and the
    cluster-robust sandwich over stretches of time (Liang and Zeger 1986, Biometrika 73, from statsmodels).

    Args:
        columns: (N, p) in units of the noise.
        residual: (N,) in units of the noise.
        groups: (N,) stretch of time of each row.
        lost: degrees of freedom taken out of columns and residual beforehand.

    Returns:
        The coefficients (p), unknown where other columns make up the same, and the remaining residual (N,).
    """
    from statsmodels.regression.linear_model import OLS

    size = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(size > 0, size, 1.0)
    eigenvalues, vectors = np.linalg.eigh(scaled.T @ scaled)
    dependent = eigenvalues < 1e-10 * max(float(eigenvalues[-1]), 1e-300)
    kept, own = vectors[:, ~dependent], eigenvalues[~dependent]
    # A column of which the others leave less than 1e-6 (squared sine of the angle between them) has no own coefficient.
    variances = np.sum(kept**2 / own, axis=1)
    determined = (size > 0) & (np.sum(vectors[:, dependent] ** 2, axis=1) < 1e-3) & (variances < 1e6)
    count = int(np.unique(groups).size)
    if count < 2 or residual.size <= columns.shape[1] or not determined.any():
        return [UNKNOWN] * columns.shape[1], residual
    fit = OLS(residual, scaled @ kept).fit(cov_type="cluster", cov_kwds={"groups": groups}, use_t=True)
    left = np.asarray(fit.resid)
    variance = max(float(left @ left) / max(left.size - columns.shape[1] - lost, 1), 1.0)
    noise_std = np.sqrt(variance * variances)
    group_std = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", kept, fit.cov_params(), kept), 0.0))
    rows = zip(kept @ fit.params, noise_std, group_std, np.where(size > 0, size, 1.0), determined, strict=True)
    found = [coefficient(v / s, n / s, g / s, count - 1) if own else UNKNOWN for v, n, g, s, own in rows]
    return found, left


@dataclass(frozen=True)
class Channels:
    """The F instants and C coordinates of one sensor in one recording, measured beside simulated."""

    sensor: Literal["camera", "encoder"]
    names: tuple[str, ...]  # (C) `beam.m3.y`, `beam.m3 across` where the axes turn with the link, `beam.theta`
    places: tuple[tuple[int, int], ...]  # (C) marker and axis (0: x or along, 1: y or across), or joint and 0
    time: Array  # (F,) instants at which anything was measured [s]
    path: PPoly  # simulated coordinates as a function of time, giving (F, C) [m or rad]
    residual: Array  # (F, C) measured minus simulated, in units of the noise; zero where not measured
    known: Mask  # (F, C) where measured
    noise: float  # 1-sigma [m or rad]
    groups: Indices  # (F,) stretch of time of each instant, the same for all sensors

    @cached_property
    def simulated(self) -> Array:
        """(F, C) [m or rad]."""
        return np.asarray(self.path(self.time), dtype=np.float64)

    @cached_property
    def rate(self) -> Array:
        """(F, C) of the simulation [m/s or rad/s]."""
        return np.asarray(self.path(self.time, 1), dtype=np.float64)

    @cached_property
    def moving(self) -> Mask:
        """(C,) whether the simulated motion stands out of the noise (three sigma)."""
        power = np.sum(self.centred(self.simulated) ** 2, axis=0) / np.maximum(self.known.sum(axis=0), 1)
        return np.asarray(np.sqrt(power) > 3 * self.noise)

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
        mean = np.sum(np.where(self.known, values, 0.0), axis=0) / np.maximum(self.known.sum(axis=0), 1)
        return np.where(self.known, values - mean, 0.0)

    def stacked(self, values: NDArray[T]) -> NDArray[T]:
        """Return the known ones of values (F, C) or (F,), channel by channel, (N,)."""
        whole = np.broadcast_to(values.reshape(len(self.time), -1), self.known.shape)
        return whole.T[self.known.T]


def channels_of(rig: Rig, simulated: SimulatedRecording) -> tuple[Channels, ...]:
    """Return the sensors that measured anything in a recording, the camera first."""
    recording, simulation = simulated.recording, simulated.simulation
    time, count = recording.time, recording.time.size
    if count < LEAST_VALUES:
        return ()
    turns = _turns(rig, simulated)
    velocity = _turned(CubicSpline(time, simulation.markers)(time, 1), turns).reshape(count, -1)
    path = CubicSpline(time, velocity).antiderivative()
    path.c[-1] += _turned(simulation.markers[:1], turns[:1]).reshape(1, -1)
    markers = [f"{link.name}.m{k + 1}" for link in rig.links for k in range(len(link.markers))]
    axes = [(" along", " across") if turning else (".x", ".y") for turning in np.any(turns != 0, axis=0)]
    places = [(m, axis) for m in range(len(markers)) for axis in (0, 1)]
    names = [markers[m] + axes[m][axis] for m, axis in places]
    residual = _turned(simulated.marker_residual, turns).reshape(count, -1)
    joints = [f"{rig.links[i].name}.theta" for i in rig.active_links]
    angle = CubicSpline(time, simulation.theta)
    camera = _channels("camera", names, places, path, residual, simulated)
    own = [(j, 0) for j in range(len(joints))]
    encoder = _channels("encoder", joints, own, angle, simulated.theta_residual, simulated)
    return tuple(sensor for sensor in (camera, encoder) if sensor is not None)


def _turns(rig: Rig, simulated: SimulatedRecording) -> Array:
    """Return (T, k) angles by which the axes of markers turn [rad]; zero where one coordinate alone is measured."""
    markers = simulated.recording.markers
    turns = np.zeros(markers.shape[:2])
    both = np.isfinite(markers.sum(axis=2)).any(axis=0)
    for i, (link, own) in enumerate(zip(rig.links, rig.marker_slices, strict=True)):
        before = [j for j, active in enumerate(rig.active_links) if active <= i]
        if link.markers_frame == "base" and before:
            turns[:, own] = simulated.simulation.theta[:, before].sum(axis=1, keepdims=True) * both[own]
    return turns


def _turned(vectors: Array, turns: Array) -> Array:
    """Resolve (T, k, 2) vectors in axes that have turned by (T, k) angles [rad]."""
    x, y = vectors[..., 0], vectors[..., 1]
    cosine, sine = np.cos(turns), np.sin(turns)
    still = np.all(turns == 0, axis=0)  # NaN in one coordinate must not spoil the other
    return np.stack([np.where(still, x, cosine * x + sine * y), np.where(still, y, cosine * y - sine * x)], axis=2)


def _channels(
    sensor: Literal["camera", "encoder"],
    names: list[str],
    places: list[tuple[int, int]],
    path: PPoly,
    residual: Array,
    simulated: SimulatedRecording,
) -> Channels | None:
    kept = np.flatnonzero(np.isfinite(residual).sum(axis=0) >= LEAST_VALUES)
    if not kept.size:
        return None
    time, noise = simulated.recording.time, simulated.noise[0 if sensor == "camera" else 1]
    rows = np.flatnonzero(np.isfinite(residual[:, kept]).any(axis=1))
    own = residual[np.ix_(rows, kept)]
    count = min(_GROUPS, max(rows.size // 4, 2))
    groups = np.minimum(((time[rows] - time[0]) / (time[-1] - time[0]) * count).astype(np.intp), count - 1)
    names, places = [names[c] for c in kept], [places[c] for c in kept]
    path, own, known = PPoly(path.c[:, :, kept], path.x), np.nan_to_num(own) / noise, np.isfinite(own)
    return Channels(sensor, tuple(names), tuple(places), time[rows], path, own, known, noise, groups)


def sensor_delay(sensor: Channels) -> Coefficient:
    """Estimate the delay of a sensor against the simulation: peak of their cross-correlation, then regression."""
    if not sensor.moving.any() or sensor.step <= 0:
        return UNKNOWN
    even = np.arange(sensor.time[0], sensor.time[-1], sensor.step)
    simulated = sensor.centred(sensor.simulated) * sensor.moving
    measured = (simulated + sensor.noise * sensor.residual) * sensor.moving
    both = [np.stack([np.interp(even, sensor.time, v) for v in values.T], axis=1) for values in (measured, simulated)]
    correlation = sum(signal.correlate(m, s, method="fft") for m, s in zip(both[0].T, both[1].T, strict=True))
    start = sensor.step * float(int(np.argmax(correlation)) - (even.size - 1))
    since = (sensor.time - sensor.time.mean())[:, None]
    found = [UNKNOWN]
    for _ in range(3):  # the motion is not linear in a delay
        shifted, rate = (sensor.path(sensor.time - start, order) for order in (0, 1))
        motion = sensor.centred(shifted) * sensor.moving
        power = np.maximum(np.sum(motion**2, axis=0), 1e-300)
        parts = []
        for values in (sensor.simulated + sensor.noise * sensor.residual - shifted, -rate, -rate * since):
            inner = sensor.centred(values * sensor.moving)
            own = inner - motion * (np.sum(motion * inner, axis=0) / power)  # each coordinate has a gain of its own
            parts.append(sensor.stacked(own) / sensor.noise)
        groups = sensor.stacked(sensor.groups)
        found, _ = regress(np.stack(parts[1:], axis=1), parts[0], groups, 2 * len(sensor.names))
        if not found[0].known:
            return UNKNOWN
        start += found[0].value
    return coefficient(start, found[0].std, found[0].std, int(sensor.groups[-1]))


class Tone(NamedTuple):
    """A sinusoid in a residual."""

    frequency: float  # [Hz]
    amplitude: Coefficient  # where it is strongest [m or rad]
    sensor: str  # that coordinate
    simulated: float  # amplitude of the simulation there [m or rad]
    described: float  # squared misfit, in units of the noise
    wave: Array  # (F, C) in units of the noise


class SensorAtRest(NamedTuple):
    """A sensor while nothing moves."""

    channels: Channels
    size: Coefficient  # root mean square over the noise supposed, minus one
    colour: Coefficient  # correlation of one value with the next, any tone taken out
    tone: Tone | None
    frequency: Array  # (L,) of the residual's spectrum [Hz]
    amplitude: Array  # (L,) of a sine, root mean square over the coordinates [m or rad]
    white: float  # amplitude that white noise of the size supposed gives, and
    limit: float  # that it passes anywhere in one recording of a thousand
    described: tuple[float, float]  # squared misfit beyond the noise supposed, and that the correlation describes


def at_rest(sensor: Channels) -> SensorAtRest | None:
    """Return size, colour and tone of a sensor's residual while nothing moves; None with hardly any values."""
    from statsmodels.stats.diagnostic import acorr_ljungbox

    if sensor.time.size < 3 * LEAST_VALUES:
        return None
    count, power = int(sensor.known.sum()), np.sum(sensor.residual**2, axis=1)
    size = math.sqrt(power.sum() / count) - 1
    means = np.bincount(sensor.groups, power) / np.maximum(np.bincount(sensor.groups, sensor.known.sum(axis=1)), 1)
    scatter = float(np.std(means, ddof=1)) / math.sqrt(means.size) / 2 / (1 + size)
    # The noise supposed may itself be off by three per cent, where it was estimated from recordings.
    larger = coefficient(size, math.hypot((2 * count) ** -0.5, 0.03), scatter, means.size - 1)
    tone = strongest_tone(sensor, sensor.residual, white=True)
    clean = sensor.centred(sensor.residual - (0.0 if tone is None else tone.wave))
    columns = [column[known] for column, known in zip(clean.T, sensor.known.T, strict=True)]
    statistic = sum(float(acorr_ljungbox(column, lags=[1])["lb_stat"].iloc[0]) for column in columns)
    cross, own = (sum(float(column[k:] @ column[: column.size - k]) for column in columns) for k in (1, 0))
    colour = Coefficient(cross / own, count**-0.5, float(stats.chi2.sf(statistic, len(columns))))
    frequency, spectrum = _spectrum(sensor, sensor.residual, 1)
    white, freedom = sensor.noise * math.sqrt(float(np.mean(4 / sensor.known.sum(axis=0)))), 2 * len(columns)
    limit = white * math.sqrt(float(stats.chi2.isf(1e-3 / frequency.size, freedom)) / freedom)
    described = (abs(float(power.sum()) - count), colour.value * cross)
    return SensorAtRest(sensor, larger, colour, tone, frequency, white * np.sqrt(spectrum), white, limit, described)


def _spectrum(sensor: Channels, residual: Array, oversampling: int) -> tuple[Array, Array]:
    """Return frequencies (L,) [Hz], and mean power (L,) of the coordinates, that of white noise being one."""
    place = np.round((sensor.time - sensor.time[0]) / sensor.step).astype(np.intp)
    even = np.zeros((int(place[-1]) + 1, residual.shape[1]))
    even[place] = residual / np.sqrt(np.maximum(sensor.known.sum(axis=0), 1))
    power = np.mean(np.abs(np.fft.rfft(even, oversampling * len(even), axis=0)[1:-1]) ** 2, axis=1)
    return np.asarray(np.fft.rfftfreq(oversampling * len(even), sensor.step)[1:-1], dtype=np.float64), power


def strongest_tone(sensor: Channels, residual: Array, white: bool, modes: Sequence[float] = ()) -> Tone | None:
    """Return the strongest sinusoid of a residual; None where it is likely to be chance.

    Args:
        sensor: whose residual it is.
        residual: (F, C) in units of the noise.
        white: whether the residual is expected to be white noise, and not what a model misses.
        modes: frequencies [Hz] near which nothing is looked for.
    """
    if sensor.time.size < 3 * LEAST_VALUES:
        return None
    frequency, power = _spectrum(sensor, residual, 4)
    lowest = 2 / sensor.duration  # two periods
    allowed = (frequency >= lowest) & (frequency < 0.98 * frequency[-1])
    for mode in modes:
        allowed &= np.abs(frequency - mode) > max(2 * lowest, 0.15 * mode)
    if not allowed.any():
        return None
    best, columns = int(np.argmax(np.where(allowed, power, 0.0))), len(sensor.names)
    near = np.abs(np.arange(power.size) - best)
    beside = power[(near > 8) & (near <= 48)]  # a dozen lines on either side, without the peak's own
    ratio = float(power[best]) / max(float(np.median(beside)) if beside.size else 1.0, 1.0)
    # White noise is independent in every coordinate; what a model misses may be the same in all of them.
    chance = float(stats.chi2.sf(2 * columns * ratio, 2 * columns)) if white else 0.5**ratio
    chance *= np.count_nonzero(allowed) / 4
    if chance > 0.01:
        return None
    fine = 2 * np.pi * (frequency[best] + np.linspace(-1, 1, 41) * (frequency[1] - frequency[0]))
    total = sum(signal.lombscargle(sensor.time, column, fine) for column in residual.T)
    peak = float(fine[np.argmax(total)]) / (2 * np.pi)
    pair = np.stack([np.cos(2 * np.pi * peak * sensor.time), np.sin(2 * np.pi * peak * sensor.time)], axis=1)
    wave, sizes = np.zeros_like(residual), np.zeros(columns)
    for c, rows in enumerate(sensor.known.T):
        found, *_ = np.linalg.lstsq(pair[rows], residual[rows, c], rcond=None)
        wave[rows, c], sizes[c] = pair[rows] @ found, math.hypot(*found)
    most = int(np.argmax(sizes))
    rest = max(float(np.mean((residual - wave)[sensor.known] ** 2)), 1.0)
    std = sensor.noise * math.sqrt(2 * rest / sensor.known[:, most].sum())
    window = signal.windows.hann(sensor.time.size) ** 2  # lets nothing slower into the simulation's own amplitude
    motion = sensor.simulated[:, most] - np.average(sensor.simulated[:, most], weights=window)
    swing = 2 * abs(np.sum(window * motion * (pair[:, 0] - 1j * pair[:, 1]))) / np.sum(window)
    size, described = Coefficient(sensor.noise * sizes[most], std, chance), np.sum(wave * (2 * residual - wave))
    return Tone(peak, size, sensor.names[most], float(swing), float(described), wave)
