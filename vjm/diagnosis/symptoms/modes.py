"""Modes of a recording, measured against simulated: frequency, damping, amplitude and phase.

The simulated motion is fitted by the damped oscillators of `vjm.experiment.spectrum`, free and driven by the torques,
besides motion slower than the modes. The measured motion is the same with a gain, a phase and another pole in each
mode, a gain and a delay of the motion outside the modes, and a clock of the camera's own, all fitted together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import least_squares

from vjm.diagnosis.symptoms.channels import Channels, Coefficient, explained, regress
from vjm.experiment.spectrum import Oscillators
from vjm.records import Array, Complex, Recording

SLOW = 0.5  # of the lowest natural frequency: slower motion is no vibration
_TERMS = 4  # of a mode: gain, phase, decay, speed
_BESIDE = "slow_gain", "slow_delay", "camera_lag", "camera_clock"  # parameters that follow those of the modes
_MOST_ROWS = 1500  # instants to which the simulated, noise-free motion is fitted
_LEAST_SIGNAL = 30.0  # root of the sum of squares over the noise: an amplitude known to 5 %
_BLUR = 0.04  # relative error of a mode's parameters: oscillators describe no large motion exactly


class ModeDifference(NamedTuple):
    """One mode of one recording, measured minus simulated."""

    mode: int  # index among the natural frequencies
    pole: complex  # of the simulated motion [1/s]
    gain: Coefficient  # natural logarithm of measured over simulated amplitude
    phase: Coefficient  # by which the measured motion is ahead [rad]
    decay: Coefficient  # difference of the decay rates [1/s]
    speed: Coefficient  # difference of the angular frequencies [rad/s]
    shapes: tuple[tuple[str, Coefficient], ...]  # gain of each coordinate of the camera against that of all

    @property
    def simulated(self) -> float:
        """Natural frequency of the simulated motion [Hz]."""
        return abs(self.pole) / (2 * np.pi)

    @property
    def frequency(self) -> Coefficient:
        """Relative difference of the frequencies [1]."""
        return self.speed.times(1 / abs(self.pole.imag))

    @property
    def damping(self) -> Coefficient:
        """Difference of the damping ratios [1]."""
        return self.decay.times(1 / abs(self.pole))


class FreeMotion(NamedTuple):
    """One freely oscillating mode in successive windows, P times."""

    mode: int  # index
    condition: str  # payload and condition of the recording, in words; empty for neither
    unit: str  # of the amplitude
    time: Array  # (P,) [s]
    amplitude: Array  # (P,) of the coordinate that moves most [m or rad]
    rates: Array  # (P, 2, 2) measured and simulated, each a frequency [Hz] and a fraction of critical damping
    std: Array  # (P, 2) standard errors of the measured ones
    instants: Array  # (F,) of the recording [s], and there
    envelope: Array  # (F,) the amplitude of all coordinates together, in units of the noise

    def misfit_of(self, rate: float, largest: float, power: int) -> float:
        """Return the squared misfit of a rate [1/s] at a largest amplitude that goes with a power of the amplitude."""
        size: Array = np.interp(self.instants, self.time, self.amplitude / largest) ** power
        turned = np.asarray(cumulative_trapezoid(size, self.instants), dtype=np.float64)
        turned = np.append(0.0, turned)
        turned -= np.polyval(np.polyfit(self.instants, turned, 1, w=self.envelope), self.instants)
        return 0.5 * float(np.sum((rate * turned * self.envelope) ** 2))


class ModeComparison(NamedTuple):
    """All modes of one recording, and the slow motion beside them."""

    modes: tuple[ModeDifference, ...] = ()  # those that move
    slow_gain: Coefficient = Coefficient()  # of the motion outside the modes
    slow_delay: Coefficient = Coefficient()  # of the same [s]
    camera_lag: Coefficient = Coefficient()  # of the camera behind the encoders [s]
    camera_clock: Coefficient = Coefficient()  # by how much more time the camera counts than the encoders [1]
    free: tuple[FreeMotion, ...] = ()
    remaining: tuple[Array, ...] = ()  # of each sensor, (F, C) the residual without all of these, in units of the noise

    @classmethod
    def of(cls, recording: Recording, sensors: Sequence[Channels], natural: Sequence[float]) -> ModeComparison:
        """Compare the modes of a recording in its sensors, at least one, near the model's natural frequencies [Hz]."""
        fit = _Fit.to_simulation(recording, sensors, natural)
        residual = np.concatenate([sensor.centred(sensor.residual).ravel() for sensor in sensors])
        x, jacobian = fit.solve(residual)
        left = residual - fit.change(x)
        groups = np.concatenate([sensor.all_groups for sensor in sensors])
        lost = sum(len(sensor.names) + sensor.unknown for sensor in sensors)
        estimates, _ = regress(jacobian, left + jacobian @ x, groups, lost)
        parts = np.split(left, np.cumsum([sensor.known.size for sensor in sensors])[:-1])
        remaining = tuple(part.reshape(sensor.known.shape) for sensor, part in zip(sensors, parts, strict=True))

        def gained(*kept: int) -> float:
            return explained(fit.change(np.where(np.isin(np.arange(x.size), kept), x, 0.0)), residual)

        modes = []
        for k, (index, pole) in enumerate(zip(fit.modes, fit.poles, strict=True)):
            gain, phase, decay, speed = range(_TERMS * k, _TERMS * (k + 1))
            if abs(x[gain]) > np.log(10):  # ten times as large or as small: another motion, not this one changed
                continue
            start = gained(gain, phase)
            shares = (gained(gain), gained(phase), gained(gain, phase, decay) - start,
                      gained(gain, phase, speed) - start)  # fmt: skip
            own = estimates[_TERMS * k : _TERMS * (k + 1)]
            terms = [_blurred(one)._replace(explained=share) for one, share in zip(own, shares, strict=True)]
            shapes = fit.shapes(k, x, remaining[0])
            modes.append(ModeDifference(index, pole, terms[0], terms[1], terms[2], terms[3], shapes))
        others = range(_TERMS * len(fit.modes), x.size)
        beside = dict(zip(_BESIDE, (estimates[j]._replace(explained=gained(j)) for j in others), strict=False))
        free = [fit.free_motion(k, x, recording) for k in range(len(fit.modes))]
        return cls(tuple(modes), **beside, free=tuple(f for f in free if f is not None), remaining=remaining)


def _blurred(coefficient: Coefficient) -> Coefficient:
    return coefficient._replace(std=float(np.hypot(coefficient.std, _BLUR * coefficient.value)))


def _free_interval(recording: Recording) -> tuple[float, float] | None:
    """Return the longest interval in which no torque drives the arm [s]; None where there is none."""
    time = recording.time
    if recording.kind == "decay" or recording.tau.shape[1] == 0:
        return float(time[0]), float(time[-1])
    known = np.isfinite(recording.tau).all(axis=1)
    if not known.any():
        return None
    torque = np.interp(time, time[known], np.abs(recording.tau[known]).max(axis=1))
    idle = torque <= 0.02 * torque.max()  # drives nothing that stands out of the motion before
    edges = np.flatnonzero(np.diff(np.r_[False, idle, False].astype(int)))
    if not edges.size:
        return None
    starts, stops = edges[::2], edges[1::2] - 1
    longest = int(np.argmax(time[stops] - time[starts]))
    return float(time[starts[longest]]), float(time[stops[longest]])


@dataclass(frozen=True)
class _Fit:
    """The simulated motion as oscillators, and its change by the parameters."""

    sensors: tuple[Channels, ...]
    oscillators: tuple[Oscillators, ...]  # of each sensor, at its instants
    modes: tuple[int, ...]  # (m) indices of those that move
    poles: tuple[complex, ...]  # (m) of the simulated motion [1/s]
    weights: tuple[tuple[Complex, ...], ...]  # (m, sensors) (1 + inputs, C) free and driven amplitudes [m or rad]
    middle: float  # mean time of the motion [s], where lag and clock are nearly independent

    @classmethod
    def to_simulation(cls, recording: Recording, sensors: Sequence[Channels], natural: Sequence[float]) -> _Fit:
        """Fit the oscillators to the simulated motion, near natural frequencies [Hz]."""
        camera = sensors[0]
        power = np.sum((camera.rate * camera.known) ** 2, axis=1)
        middle = float(np.average(camera.time, weights=power)) if power.any() else float(camera.time.mean())
        # Three periods of a mode, and more than two frames a period, or its pole cannot be told.
        modes = [k for k, f in enumerate(natural) if f * camera.duration >= 3 and 2.2 * f * camera.step <= 1]
        still = tuple(Oscillators(sensor.time, None) for sensor in sensors)
        if not modes:
            return cls(tuple(sensors), still, (), (), (), middle)
        lowest = SLOW * min(natural)
        thin = max(1, camera.time.size // _MOST_ROWS)
        while thin > 1 and 4 * thin * camera.step * max(natural[k] for k in modes) > 1:
            thin -= 1
        motion = (camera.simulated[::thin] - camera.simulated.mean(axis=0)) / camera.noise
        known = recording.tau[:, np.isfinite(recording.tau).all(axis=0)]
        torque, own, expected = None, {}, {k: natural[k] for k in modes}
        before = np.inf
        for trial in (None, (recording.time, known)) if known.size else (None,):
            part = Oscillators(camera.time[::thin], trial)
            found, misfit = _poles(part, _slow(part, camera.time[::thin], camera, lowest), motion, expected)
            # Torques that leave half of what free oscillation leaves, or more, drive no mode.
            if misfit < 0.5 * before:
                torque, own, before = trial, found, misfit
        modes, poles = list(own), list(own.values())
        if not modes:
            return cls(tuple(sensors), still, (), (), (), middle)
        oscillators = still if torque is None else tuple(Oscillators(sensor.time, torque) for sensor in sensors)
        pairs = list(zip(sensors, oscillators, strict=True))
        weights = [_weights(each, _slow(each, s.time, s, lowest), s.simulated, poles) for s, each in pairs]
        kept = []
        for k, pole in enumerate(poles):
            waves = [
                (o.responses(pole) @ w[k]).real * s.known / s.noise for (s, o), w in zip(pairs, weights, strict=True)
            ]
            if max(float(np.linalg.norm(wave)) for wave in waves) > _LEAST_SIGNAL:
                kept.append(k)
        return cls(
            tuple(sensors), oscillators, tuple(modes[k] for k in kept), tuple(poles[k] for k in kept),
            tuple(tuple(w[k] for w in weights) for k in kept), middle,
        )  # fmt: skip

    def waves(self, k: int, change: Array | None = None) -> list[Complex]:
        """Return the (F, C) complex motion of a mode in each sensor, changed by its four parameters [m or rad]."""
        gain, phase, decay, speed = np.zeros(_TERMS) if change is None else change
        factor = np.exp(np.clip(gain, -3, 3) + 1j * phase)
        pole = complex(min(self.poles[k].real - decay, 3 / self.sensors[0].duration), self.poles[k].imag + speed)
        return [factor * (o.responses(pole) @ w) for o, w in zip(self.oscillators, self.weights[k], strict=True)]

    @cached_property
    def _unchanged(self) -> list[list[Complex]]:
        return [self.waves(k) for k in range(len(self.modes))]

    @cached_property
    def _slow(self) -> list[tuple[Array, Array]]:
        """Effect of gain and delay of the motion outside the modes, (F, C) in each sensor [m or rad]."""
        pairs = []
        for s, sensor in enumerate(self.sensors):
            slow = sensor.simulated - sum((own[s].real for own in self._unchanged), np.zeros(1))
            rate = np.gradient(slow, sensor.time, axis=0)
            pairs.append((sensor.centred(slow) * sensor.moving, -rate * sensor.moving))
        return pairs

    def change(self, x: Array) -> Array:
        """Return the (N,) change of the simulation, each coordinate minus its mean, in units of the noise."""
        gain, delay, lag, clock = (*x[_TERMS * len(self.modes) :], 0.0, 0.0)[:4]
        changes = [gain * shape + delay * rate for shape, rate in self._slow]
        for k, own in enumerate(self._unchanged):
            mode = x[_TERMS * k : _TERMS * (k + 1)]
            if mode.any():
                for s, wave in enumerate(self.waves(k, mode)):
                    changes[s] = changes[s] + (wave - own[s]).real
        if lag or clock:
            camera = self.sensors[0]
            shifted = camera.time - lag - clock * (camera.time - self.middle)
            changes[0] = changes[0] + camera.path(shifted) - camera.simulated
        return np.concatenate([(s.centred(c) / s.noise).ravel() for s, c in zip(self.sensors, changes, strict=True)])

    def solve(self, residual: Array) -> tuple[Array, Array]:
        """Return the parameters (p,) that fit a residual (N,) best, and the Jacobian (N, p) of the change."""

        def misfit(x: Array) -> Array:
            return residual - self.change(x)

        def search(start: Array) -> Any:
            return least_squares(misfit, start, x_scale="jac", max_nfev=30)

        start = np.zeros(_TERMS * len(self.modes) + (4 if len(self.sensors) > 1 else 2))
        best = search(start)
        # Where that leaves a residual, a frequency may be off by more than half a period over the recording.
        if self.modes and 2 * best.cost > 2 * sum(sensor.known.sum() for sensor in self.sensors):
            camera = self.sensors[0]
            frequency, power = camera.spectrum(camera.centred(camera.measured), 4)
            for k, pole in enumerate(self.poles):
                speed = 2 * np.pi * frequency - pole.imag
                start[_TERMS * k + 3] = speed[np.argmax(np.where(np.abs(speed) < 0.5 * pole.imag, power, 0.0))]
            other = search(start)
            best = other if other.cost < best.cost else best
        x = np.array(best.x)
        phases = slice(1, _TERMS * len(self.modes), _TERMS)
        x[phases] = np.angle(np.exp(1j * x[phases]))
        return x, -np.asarray(best.jac)

    def shapes(self, k: int, x: Array, remaining: Array) -> tuple[tuple[str, Coefficient], ...]:
        """Return the gain of each camera coordinate in a mode against that of all."""
        camera = self.sensors[0]
        if camera.sensor != "camera":
            return ()
        wave = camera.centred(self.waves(k, x[_TERMS * k : _TERMS * (k + 1)])[0].real) / camera.noise
        size = np.linalg.norm(wave, axis=0)
        shapes = []
        for c in np.flatnonzero(size > max(_LEAST_SIGNAL, 0.1 * size.max())):
            rows = camera.known[:, c]
            (gain,), _ = regress(wave[rows, c][:, None], remaining[rows, c], camera.groups[rows], 1)
            shapes.append((camera.names[c], _blurred(gain)))
        return tuple(shapes)

    def free_motion(self, k: int, x: Array, recording: Recording) -> FreeMotion | None:
        """Measure a mode in overlapping windows of two periods and more, each with a straight change of its own."""
        camera, count, interval = self.sensors[0], len(self.modes), _free_interval(recording)
        if interval is None:
            return None
        start, duration = interval[0], interval[1] - interval[0]
        half = max(2 * np.pi / self.poles[k].imag, (5 + 3 * count) * camera.step, duration / 12)
        centres = np.linspace(start + half, start + duration - half, max(int(duration / half) - 1, 0))
        shape = self._unchanged[k][0][np.searchsorted(camera.time, start)]
        unit = np.conj(shape) / max(float(np.linalg.norm(shape)), 1e-300)
        changes = x[: _TERMS * count].reshape(-1, _TERMS)
        poles = np.array([[p + complex(-c[2], c[3]) for p, c in zip(self.poles, changes, strict=True)], self.poles])
        measured = camera.simulated + camera.noise * camera.residual
        points = []
        for centre in centres:
            rows = (np.abs(camera.time - centre) <= half) & camera.known.all(axis=1)
            place, values, own = (camera.time[rows] - centre) / half, [], poles[0]
            for motion, own in zip((measured, camera.simulated), poles, strict=True):
                waves = np.exp(own * (place * half)[:, None])
                waves = np.hstack([waves, waves[:, k : k + 1] * place[:, None]])
                inverse = np.linalg.pinv(np.hstack([waves.real, -waves.imag, np.vander(place, 3)]))
                sizes = inverse @ motion[rows] @ unit
                amplitude, change = sizes[[k, count]] + 1j * sizes[[k + count + 1, 2 * count + 1]]
                pole = own[k] + change / amplitude / half
                values.append((abs(amplitude), pole.imag / (2 * np.pi), -pole.real / abs(pole)))
                noise = camera.noise * np.linalg.norm(inverse[[k, count]], axis=1)
            # Seen where the noise leaves the phase certain to a fiftieth of a period.
            if rows.sum() >= 2 * (5 + 2 * count) and min(v[0] for v in values) > 8 * noise[0]:
                points.append((centre, *values, noise[1] / half / values[0][0]))
        if len(points) < 4:  # too few to show a trend
            return None
        times, *pairs, std = (np.array(column) for column in zip(*points, strict=True))
        rates, largest = np.stack(pairs, axis=1), float(np.abs(shape).max() / np.linalg.norm(shape))
        errors = np.stack([std / (2 * np.pi), std / abs(self.poles[k])], axis=1)
        envelope = np.linalg.norm(self.waves(k, changes[k])[0] * camera.known, axis=1) / camera.noise
        payload = f"payload {1e3 * recording.payload:.3g} g" if recording.payload else ""
        condition = ", ".join(part for part in (payload, recording.condition or "") if part)
        return FreeMotion(
            self.modes[k], condition, camera.unit, times, largest * rates[:, 0, 0], rates[..., 1:], errors,
            camera.time, envelope,
        )  # fmt: skip


def _slow(oscillators: Oscillators, time: Array, sensor: Channels, highest: float) -> Array:
    """Return (T, k) motion slower than a frequency [Hz], and the double integrals of the torques (rigid motion).

    Cosines have no slope at the ends; a polynomial makes up for that.
    """
    double = [signal for signal in oscillators.responses(1e-3 * highest).T[1:].real]
    rigid = [np.cumsum(column * np.gradient(time)) for column in double]
    slow = sensor.slow_columns(time, highest)
    polynomial = np.polynomial.legendre.legvander(2 * (time - sensor.time[0]) / sensor.duration - 1, 4)[:, 1:]
    columns = [*slow.T, *polynomial.T, *rigid]
    return np.stack([c / max(float(np.abs(c).max()), 1e-300) for c in columns], axis=1)


_Poles = tuple[dict[int, complex], float]


def _poles(oscillators: Oscillators, slow: Array, motion: Array, natural: dict[int, float]) -> _Poles:
    """Fit poles [1/s] to a motion (T, C) in units of the noise, and return the RMS that they do not explain.

    All that is linear is projected out. Modes are left out until the noise would leave each frequency certain to a
    twentieth of its half-power bandwidth, or to 0.2 %: what is driven far from its resonance shows no pole.
    """
    basis, _ = np.linalg.qr(slow)
    motion = motion - basis @ (basis.T @ motion)
    kept = list(natural)
    while kept:

        def residual(values: Array) -> Array:
            columns = oscillators.columns(values.reshape(-1, 2))[:, 1:]
            columns = columns - basis @ (basis.T @ columns)
            sizes, *_ = np.linalg.lstsq(columns, motion, rcond=1e-10)
            return np.asarray(motion - columns @ sizes).ravel()

        own = np.array([natural[k] for k in kept])
        starts = [np.column_stack([own, np.full(own.size, ratio)]).ravel() for ratio in (0.003, 0.01, 0.05)]
        bounds: Any = tuple(
            np.column_stack([f * own, np.full(own.size, z)]).ravel() for f, z in ((0.75, 0.0), (1.25, 0.5))
        )
        scale = np.column_stack([0.01 * own, np.full(own.size, 0.01)]).ravel()
        first = np.maximum(min(starts, key=lambda x: float(np.sum(residual(x) ** 2))), 1e-6)
        found: Any = least_squares(residual, first, bounds=bounds, x_scale=scale, max_nfev=20)
        values = found.x.reshape(-1, 2)
        covariance = np.linalg.pinv(found.jac.T @ found.jac)
        std = np.sqrt(np.diag(covariance)).reshape(-1, 2)[:, 0] / values[:, 0]
        unsure = std / np.maximum(0.1 * values[:, 1], 2e-3) * np.where(values[:, 1] > 0.3, np.inf, 1.0)
        if unsure.max() <= 1:
            pairs = zip(kept, values, strict=True)
            poles = {k: 2 * np.pi * f * complex(-z, np.sqrt(1 - z**2)) for k, (f, z) in pairs}
            return poles, float(np.sqrt(2 * found.cost / motion.size))
        kept = [k for k, ratio in zip(kept, unsure, strict=True) if ratio < min(float(unsure.max()), 5.0)]
    return {}, float(np.sqrt(np.mean(motion**2)))


def _weights(oscillators: Oscillators, slow: Array, motion: Array, poles: Sequence[complex]) -> list[Complex]:
    """Return for each pole the (1 + inputs, C) complex amplitudes of its free and driven part of a motion (T, C)."""
    waves = np.hstack([oscillators.responses(pole) for pole in poles])
    scale = np.maximum(np.abs(waves).max(axis=0), 1e-300)
    columns = np.hstack([waves.real / scale, -waves.imag / scale, slow])
    sizes, *_ = np.linalg.lstsq(columns, motion - motion.mean(axis=0), rcond=1e-10)
    real, imaginary = np.split(sizes[: 2 * scale.size], 2)
    both = (real + 1j * imaginary) / scale[:, None]
    return list(both.reshape(len(poles), -1, motion.shape[1]))
