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
from scipy.ndimage import find_objects, label
from scipy.optimize import least_squares

from vjm.diagnosis.symptoms.channels import Channels, Coefficient, explained, regress
from vjm.experiment.spectrum import Oscillators, project_out, projected_jacobian
from vjm.records import Array, Complex, Recording

SLOW = 0.5  # of the lowest natural frequency: slower motion is no vibration
_TERMS = 4  # of a mode: gain, phase, decay rate, angular frequency
_LARGEST_GAIN = 3.0  # logarithm of an amplitude ratio: beyond, the measured motion is another one
_LEAST_SIGNAL = 30.0  # root of the sum of squares over the noise: an amplitude known to 5 %


class ModeDifference(NamedTuple):
    """One mode of one recording, measured minus simulated."""

    mode: int  # index among the natural frequencies
    pole: complex  # of the simulated motion [1/s]
    shapes: tuple[tuple[str, Coefficient], ...]  # gain of each coordinate of the camera against that of all
    gain: Coefficient  # natural logarithm of measured over simulated amplitude
    phase: Coefficient  # by which the measured motion is ahead [rad]
    decay: Coefficient  # difference of the decay rates [1/s]
    angular_frequency: Coefficient  # difference of the angular frequencies [rad/s]

    @property
    def simulated(self) -> float:
        """Natural frequency of the simulated motion [Hz]."""
        return abs(self.pole) / (2 * np.pi)

    @property
    def frequency(self) -> Coefficient:
        """Relative difference of the frequencies [1]."""
        return self.angular_frequency.times(1 / abs(self.pole.imag))

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
        phase = np.asarray(cumulative_trapezoid(size, self.instants, initial=0), dtype=np.float64)
        phase -= np.polyval(np.polyfit(self.instants, phase, 1, w=self.envelope), self.instants)
        return 0.5 * float(np.sum((rate * phase * self.envelope) ** 2))


class MotionComparison(NamedTuple):
    """All modes of one recording, and the slow motion outside them."""

    modes: tuple[ModeDifference, ...] = ()  # those that move
    slow_gain: Coefficient = Coefficient()  # of the motion outside the modes
    slow_delay: Coefficient = Coefficient()  # of the same [s]
    camera_lag: Coefficient = Coefficient()  # of the camera behind the encoders [s]
    camera_clock: Coefficient = Coefficient()  # by how much more time the camera counts than the encoders [1]
    free: tuple[FreeMotion, ...] = ()
    remaining: tuple[Array, ...] = ()  # of each sensor, (F, C) the residual without all of these, in units of the noise

    @classmethod
    def of(cls, recording: Recording, sensors: Sequence[Channels], natural: Sequence[float]) -> MotionComparison:
        """Compare the modes of a recording in its sensors, at least one, near the model's natural frequencies [Hz]."""
        fit = _Fit.to_simulation(recording, sensors, natural)
        residual = np.concatenate([sensor.centred(sensor.residual).ravel() for sensor in sensors])
        x, jacobian = fit.solve(residual)
        remainder = residual - fit.change(x)
        groups = np.concatenate([sensor.all_groups for sensor in sensors])
        freedom_lost = sum(len(sensor.names) + sensor.unknown for sensor in sensors)
        estimates, _ = regress(jacobian, remainder + jacobian @ x, groups, freedom_lost)
        parts = np.split(remainder, np.cumsum([sensor.known.size for sensor in sensors])[:-1])
        remaining = tuple(part.reshape(sensor.known.shape) for sensor, part in zip(sensors, parts, strict=True))

        def gained(*parameters: int) -> float:
            return explained(fit.change(np.where(np.isin(np.arange(x.size), parameters), x, 0.0)), residual)

        modes = []
        for k, mode in enumerate(fit.modes):
            gain, phase, decay, angular_frequency = range(_TERMS * k, _TERMS * (k + 1))
            if abs(x[gain]) > np.log(10):  # ten times as large or as small: another motion, not this one changed
                continue
            start = gained(gain, phase)
            shares = (gained(gain), gained(phase), gained(gain, phase, decay) - start,
                      gained(gain, phase, angular_frequency) - start)  # fmt: skip
            terms = (_with_model_error(estimates[gain + j])._replace(explained=share) for j, share in enumerate(shares))
            shapes = fit.shapes(mode, fit.own(x)[k], remaining[0])
            modes.append(ModeDifference(mode.order, mode.pole, shapes, *terms))
        names, indices = ("slow_gain", "slow_delay", "camera_lag", "camera_clock"), range(fit.own(x).size, x.size)
        slow = dict(zip(names, (estimates[j]._replace(explained=gained(j)) for j in indices), strict=False))
        free = [fit.free_motion(k, fit.own(x), recording) for k in range(len(fit.modes))]
        return cls(tuple(modes), **slow, free=tuple(f for f in free if f is not None), remaining=remaining)


def _with_model_error(coefficient: Coefficient) -> Coefficient:
    """Add a relative error of 4 %: oscillators describe no large motion exactly."""
    return coefficient._replace(std=float(np.hypot(coefficient.std, 0.04 * coefficient.value)))


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
    intervals = [(float(time[part][0]), float(time[part][-1])) for (part,) in find_objects(label(idle)[0])]
    return max(intervals, key=lambda interval: interval[1] - interval[0], default=None)


class _SimulatedMode(NamedTuple):
    """A mode of the simulated motion, as an oscillator."""

    order: int  # among the natural frequencies
    pole: complex  # [1/s]
    amplitudes: tuple[Complex, ...]  # of each sensor, (1 + inputs, C) of the free and the driven motion [m or rad]


@dataclass(frozen=True)
class _Fit:
    """The simulated motion as oscillators, and its change by the parameters."""

    sensors: Sequence[Channels]
    oscillators: Sequence[Oscillators]  # of each sensor, at its instants
    modes: Sequence[_SimulatedMode] = ()  # (m) those that move

    @classmethod
    def to_simulation(cls, recording: Recording, sensors: Sequence[Channels], natural: Sequence[float]) -> _Fit:
        """Fit the oscillators to the simulated motion, near natural frequencies [Hz]."""
        camera = sensors[0]
        # Three periods of a mode, and more than two frames a period, or its pole cannot be told.
        shown = {k: f for k, f in enumerate(natural) if f * camera.duration >= 3 and 2.2 * f * camera.step <= 1}
        free = [Oscillators(sensor.time, None) for sensor in sensors]
        if not shown:
            return cls(sensors, free)
        lowest, limit = SLOW * min(natural), int(1 / (4 * camera.step * max(shown.values())))  # four instants a period
        stride = max(1, min(camera.time.size // 1500, limit))  # so many instants of a motion without noise are enough
        motion = (camera.simulated[::stride] - camera.simulated.mean(axis=0)) / camera.noise
        known = recording.tau[:, np.isfinite(recording.tau).all(axis=0)]
        torque, poles, smallest = None, dict[int, complex](), np.inf
        for trial in (None, (recording.time, known)) if known.size else (None,):
            thinned = Oscillators(camera.time[::stride], trial)
            slow = _slow_motion(thinned, camera.time[::stride], camera, lowest)
            trial_poles, misfit = _poles(thinned, slow, motion, shown)
            # Torques that leave half of what free oscillation leaves, or more, drive no mode.
            if misfit < 0.5 * smallest:
                torque, poles, smallest = trial, trial_poles, misfit
        if not poles:
            return cls(sensors, free)
        oscillators = [Oscillators(sensor.time, torque) for sensor in sensors]
        amplitudes = [
            _amplitudes(waves, _slow_motion(waves, sensor.time, sensor, lowest), sensor.simulated, [*poles.values()])
            for sensor, waves in zip(sensors, oscillators, strict=True)
        ]
        modes = [_SimulatedMode(*row) for row in zip(poles, poles.values(), zip(*amplitudes, strict=True), strict=True)]
        fit = cls(sensors, oscillators, modes)
        return cls(sensors, oscillators, [mode for mode in modes if fit.signal(mode) > _LEAST_SIGNAL])

    def signal(self, mode: _SimulatedMode) -> float:
        """Return the root of the sum of squares over the noise, in the sensor that shows a mode best."""
        pairs = zip(self.sensors, self.waves(mode), strict=True)
        return max(float(np.linalg.norm(wave.real * sensor.known / sensor.noise)) for sensor, wave in pairs)

    def waves(self, mode: _SimulatedMode, change: Sequence[float] | Array = (0.0,) * _TERMS) -> list[Complex]:
        """Return the (F, C) complex motion of a mode in each sensor, changed by its four parameters [m or rad]."""
        gain, phase, decay, angular_frequency = change
        factor = np.exp(np.clip(gain, -_LARGEST_GAIN, _LARGEST_GAIN) + 1j * phase)
        pole = complex(min(mode.pole.real - decay, self._fastest_growth), mode.pole.imag + angular_frequency)
        return [factor * (o.responses(pole) @ a) for o, a in zip(self.oscillators, mode.amplitudes, strict=True)]

    @property
    def _fastest_growth(self) -> float:
        """Largest rate at which a mode may grow [1/s]: by e^3 over the recording."""
        return 3 / self.sensors[0].duration

    @cached_property
    def _unchanged(self) -> list[list[Complex]]:
        return [self.waves(mode) for mode in self.modes]

    @cached_property
    def _middle(self) -> float:
        """Mean time of the motion [s], where lag and clock are nearly independent."""
        camera = self.sensors[0]
        power = np.sum((camera.rate * camera.known) ** 2, axis=1)
        return float(np.average(camera.time, weights=power if power.any() else None))

    @cached_property
    def _slow(self) -> list[tuple[Array, Array]]:
        """Effect of gain and delay of the motion outside the modes, (F, C) in each sensor [m or rad]."""
        pairs = []
        for index, sensor in enumerate(self.sensors):
            slow = sensor.simulated - sum((waves[index].real for waves in self._unchanged), np.zeros(1))
            rate = np.gradient(slow, sensor.time, axis=0)
            pairs.append((sensor.centred(slow) * sensor.moving, -rate * sensor.moving))
        return pairs

    def change(self, x: Array) -> Array:
        """Return the (N,) change of the simulation, each coordinate minus its mean, in units of the noise."""
        gain, delay, lag, clock = (*x[_TERMS * len(self.modes) :], 0.0, 0.0)[:4]
        changes = [gain * shape + delay * rate for shape, rate in self._slow]
        for mode, unchanged, terms in zip(self.modes, self._unchanged, self.own(x), strict=True):
            if terms.any():
                for index, wave in enumerate(self.waves(mode, terms)):
                    changes[index] = changes[index] + (wave - unchanged[index]).real
        if lag or clock:
            camera = self.sensors[0]
            shifted = camera.time - lag - clock * (camera.time - self._middle)
            changes[0] = changes[0] + camera.path(shifted) - camera.simulated
        return self._in_noise_units(changes)

    def jacobian(self, x: Array) -> Array:
        """Return the (N, p) derivatives of `change` by the parameters."""
        columns: list[Sequence[Array]] = []  # of each parameter, (F, C) in each sensor [m or rad]
        for mode, terms in zip(self.modes, self.own(x), strict=True):
            step = 1e-6 * abs(mode.pole)
            waves, faster = self.waves(mode, terms), self.waves(mode, terms + step * np.array([0.0, 0.0, 0.0, 1.0]))
            # A wave is an analytic function of its pole.
            by_pole = [(perturbed - wave) / (1j * step) for wave, perturbed in zip(waves, faster, strict=True)]
            by_gain = float(abs(terms[0]) < _LARGEST_GAIN)  # beyond its bounds a parameter changes nothing
            by_decay = -float(mode.pole.real - terms[2] < self._fastest_growth)
            columns += [[by_gain * wave.real for wave in waves], [-wave.imag for wave in waves]]
            columns += [[by_decay * wave.real for wave in by_pole], [-wave.imag for wave in by_pole]]
        columns += zip(*self._slow, strict=True)
        if x.size > len(columns):
            camera = self.sensors[0]
            shifted = camera.time - x[-2] - x[-1] * (camera.time - self._middle)
            step = 1e-4 * camera.step
            rate = (camera.path(shifted + step) - camera.path(shifted - step)) / (2 * step)
            zeros = [np.zeros(sensor.known.shape) for sensor in self.sensors[1:]]
            columns += [[-rate, *zeros], [-rate * (camera.time - self._middle)[:, None], *zeros]]
        return np.stack([self._in_noise_units(column) for column in columns], axis=1)

    def _in_noise_units(self, change: Sequence[Array]) -> Array:
        """Return changes (F, C) of each sensor as (N,), each coordinate minus its mean, in units of the noise."""
        pairs = zip(self.sensors, change, strict=True)
        return np.concatenate([(sensor.centred(values) / sensor.noise).ravel() for sensor, values in pairs])

    def own(self, x: Array) -> Array:
        """Return the parameters (m, 4) of the modes."""
        return x[: _TERMS * len(self.modes)].reshape(-1, _TERMS)

    def solve(self, residual: Array) -> tuple[Array, Array]:
        """Return the parameters (p,) that fit a residual (N,) best, and the Jacobian (N, p) of the change."""

        def misfit(x: Array) -> Array:
            return residual - self.change(x)

        def jacobian(x: Array) -> Array:
            return -self.jacobian(x)

        def search(start: Array) -> Any:
            return least_squares(misfit, start, jacobian, x_scale="jac", max_nfev=30)

        start = np.zeros(_TERMS * len(self.modes) + (4 if len(self.sensors) > 1 else 2))
        best = search(start)
        # Where that leaves a residual, a frequency may be off by more than half a period over the recording.
        if self.modes and 2 * best.cost > 2 * sum(sensor.known.sum() for sensor in self.sensors):
            camera = self.sensors[0]
            frequency, power = camera.spectrum(camera.centred(camera.measured))
            for mode, terms in zip(self.modes, self.own(start), strict=True):
                faster = 2 * np.pi * frequency - mode.pole.imag
                terms[3] = faster[np.argmax(np.where(np.abs(faster) < 0.5 * mode.pole.imag, power, 0.0))]
            restarted = search(start)
            best = restarted if restarted.cost < best.cost else best
        x = np.array(best.x)
        self.own(x)[:, 1] = np.angle(np.exp(1j * self.own(x)[:, 1]))
        return x, -np.asarray(best.jac)

    def shapes(self, mode: _SimulatedMode, terms: Array, remaining: Array) -> tuple[tuple[str, Coefficient], ...]:
        """Return the gain of each camera coordinate in a mode against that of all."""
        camera = self.sensors[0]
        if camera.sensor != "camera":
            return ()
        wave = camera.centred(self.waves(mode, terms)[0].real) / camera.noise
        size = np.linalg.norm(wave, axis=0)
        shapes = []
        for column in np.flatnonzero(size > max(_LEAST_SIGNAL, 0.1 * size.max())):
            rows = camera.known[:, column]
            (gain,), _ = regress(wave[rows, column][:, None], remaining[rows, column], camera.groups[rows], 1)
            shapes.append((camera.names[column], _with_model_error(gain)))
        return tuple(shapes)

    def free_motion(self, k: int, changes: Array, recording: Recording) -> FreeMotion | None:
        """Measure a mode in overlapping windows of two periods and more, each with a straight change of its own."""
        camera, mode, count, interval = self.sensors[0], self.modes[k], len(self.modes), _free_interval(recording)
        if interval is None:
            return None
        # The torque may be recorded for longer than the camera looks on.
        start, stop = np.clip(interval, camera.time[0], camera.time[-1])
        half = max(2 * np.pi / mode.pole.imag, (5 + 3 * count) * camera.step, (stop - start) / 12)
        shape = self._unchanged[k][0][np.searchsorted(camera.time, start)]
        shape = shape / max(float(np.linalg.norm(shape)), 1e-300)
        simulated = np.array([mode.pole for mode in self.modes])
        poles = simulated - changes[:, 2] + 1j * changes[:, 3], simulated
        # What grows or decays by all the digits there are over half a window is no oscillation.
        if np.abs(np.concatenate(poles).real).max() * half > -np.log(np.finfo(float).eps):
            return None
        points = []
        for centre in np.linspace(start + half, stop - half, max(int((stop - start) / half) - 1, 0)):
            rows = (np.abs(camera.time - centre) <= half) & camera.known.all(axis=1)
            if rows.sum() < 2 * (5 + 2 * count):
                continue
            time, motions = camera.time[rows] - centre, (camera.measured[rows], camera.simulated[rows])
            (amplitude, pole, noise), (own_amplitude, own_pole, _) = (
                _local_oscillation(time / half, half, motion @ np.conj(shape), motion_poles, k)
                for motion, motion_poles in zip(motions, poles, strict=True)
            )
            # Seen where the noise leaves the phase certain to a fiftieth of a period.
            if min(amplitude, own_amplitude) > 8 * camera.noise * noise[0]:
                points.append((centre, amplitude, pole, own_pole, camera.noise * noise[1] / amplitude))
        if len(points) < 4:  # too few to show a trend
            return None
        times, amplitudes, *fitted, std = (np.array(column) for column in zip(*points, strict=True))
        rates = [np.stack([values.imag / (2 * np.pi), -values.real / np.abs(values)], axis=1) for values in fitted]
        errors = np.stack([std / (2 * np.pi), std / abs(mode.pole)], axis=1)
        envelope = np.linalg.norm(self.waves(mode, changes[k])[0] * camera.known, axis=1) / camera.noise
        payload = f"payload {1e3 * recording.payload:.3g} g" if recording.payload else ""
        condition = ", ".join(part for part in (payload, recording.condition or "") if part)
        return FreeMotion(
            mode.order, condition, camera.unit, times, float(np.abs(shape).max()) * amplitudes, np.stack(rates, axis=1),
            errors, camera.time, envelope,
        )  # fmt: skip


def _local_oscillation(
    place: Array, half: float, motion: Complex, poles: Complex, k: int
) -> tuple[float, complex, Array]:
    """Fit oscillations to a motion (F,) at places from -1 to 1 in a window, half of which lasts so long [s].

    One of them, the k-th, changes linearly over the window. Returns its amplitude in the middle, its pole [1/s] there,
    and the standard errors of amplitude and decay rate times amplitude, both per unit of noise.
    """
    count = poles.size
    waves = np.exp(poles * (place * half)[:, None])
    waves = np.hstack([waves, waves[:, k : k + 1] * place[:, None]])
    inverse = np.linalg.pinv(np.hstack([waves.real, -waves.imag, np.vander(place, 3)]))
    sizes = inverse @ motion
    amplitude, change = sizes[[k, count]] + 1j * sizes[[k + count + 1, 2 * count + 1]]
    noise = np.linalg.norm(inverse[[k, count]], axis=1) / [1.0, half]
    return abs(amplitude), complex(poles[k] + change / amplitude / half), noise


def _slow_motion(oscillators: Oscillators, time: Array, sensor: Channels, highest: float) -> Array:
    """Return (T, k) motion slower than a frequency [Hz], and the double integrals of the torques (rigid motion).

    Cosines have no slope at the ends; a polynomial makes up for that.
    """
    double = [signal for signal in oscillators.responses(1e-3 * highest).T[1:].real]
    rigid = [np.cumsum(column * np.gradient(time)) for column in double]
    slow = sensor.slow_columns(time, highest)
    polynomial = np.polynomial.legendre.legvander(2 * (time - sensor.time[0]) / sensor.duration - 1, 4)[:, 1:]
    columns = [*slow.T, *polynomial.T, *rigid]
    return np.stack([column / max(float(np.abs(column).max()), 1e-300) for column in columns], axis=1)


def _poles(
    oscillators: Oscillators, slow: Array, motion: Array, natural: dict[int, float]
) -> tuple[dict[int, complex], float]:
    """Fit poles [1/s] to a motion (T, C) in units of the noise, and return the RMS that they do not explain.

    All that is linear is projected out. Modes are left out until the noise would leave each frequency certain to a
    twentieth of its half-power bandwidth, or to 0.2 %: what is driven far from its resonance shows no pole.
    """
    basis, _ = np.linalg.qr(np.column_stack([np.ones(len(slow)), slow]))
    motion = project_out(basis, motion)
    orders = list(natural)
    while orders:
        unit = np.array([[natural[k], 1.0] for k in orders])  # x: frequencies over the natural ones, and damping ratios

        def residual(x: Array, unit: Array = unit) -> Array:
            columns = project_out(basis, oscillators.columns(x.reshape(-1, 2) * unit)[:, 1:])
            sizes, *_ = np.linalg.lstsq(columns, motion, rcond=1e-10)
            return np.asarray(motion - columns @ sizes).ravel()

        def slopes(x: Array, unit: Array = unit) -> Array:
            return -projected_jacobian(oscillators, motion, x.reshape(-1, 2) * unit, basis) * unit.ravel()

        starts = [np.tile([1.0, ratio], len(orders)) for ratio in (0.003, 0.01, 0.05)]
        first = min(starts, key=lambda x: float(np.sum(residual(x) ** 2)))
        bounds = np.tile([0.75, 0.0], len(orders)), np.tile([1.25, 0.5], len(orders))
        fit: Any = least_squares(residual, first, slopes, bounds, x_scale=0.01, max_nfev=20)
        std = np.sqrt(np.diag(np.linalg.pinv(fit.jac.T @ fit.jac)))[::2] / fit.x[::2]
        unsure = std / np.maximum(0.1 * fit.x[1::2], 2e-3) * np.where(fit.x[1::2] > 0.3, np.inf, 1.0)
        if unsure.max() <= 1:
            poles = {
                k: 2 * np.pi * f * complex(-z, np.sqrt(1 - z**2))
                for k, (f, z) in zip(orders, fit.x.reshape(-1, 2) * unit, strict=True)
            }
            return poles, float(np.sqrt(2 * fit.cost / motion.size))
        orders = [k for k, ratio in zip(orders, unsure, strict=True) if ratio < min(float(unsure.max()), 5.0)]
    return {}, float(np.sqrt(np.mean(motion**2)))


def _amplitudes(oscillators: Oscillators, slow: Array, motion: Array, poles: Sequence[complex]) -> list[Complex]:
    """Return for each pole the (1 + inputs, C) complex amplitudes of its free and driven part of a motion (T, C)."""
    waves = np.hstack([oscillators.responses(pole) for pole in poles])
    scale = np.maximum(np.abs(waves).max(axis=0), 1e-300)
    columns = np.hstack([waves.real / scale, -waves.imag / scale, slow])
    sizes, *_ = np.linalg.lstsq(columns, motion - motion.mean(axis=0), rcond=1e-10)
    real, imaginary = np.split(sizes[: 2 * scale.size], 2)
    amplitudes = (real + 1j * imaginary) / scale[:, None]
    return list(amplitudes.reshape(len(poles), -1, motion.shape[1]))
