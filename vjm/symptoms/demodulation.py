"""Complex amplitudes of a frequency band, window by window, measured and simulated through the same windows.

In each window, four periods or longer and smooth at its ends, a signal is fitted by a sine whose amplitude and phase
may change linearly, by sines at the other bands' frequencies, and by a polynomial that takes what is slower than half
the band's frequency (weighted least squares). Gaps only make the amplitude less sure, and what the window does to a
signal it does to both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.records import Array, Complex
from vjm.symptoms.signals import Channels

_LEAST_PERIODS = 4.0  # of a band in a recording
_LEAST_SAMPLES = 2.2  # in a period
# Chosen together, on decaying sinusoids of 6 periods beside slow and fast ones: a hundredth of a motion of a third of
# the band's frequency comes through, and a tenth of one of twice its frequency.
_PERIODS = 4.0  # in a window, at least
REACH = 0.35  # of a window's length, from its centre to the end of the recording, at least
_ORDER = 6  # of the polynomial
_STIFFNESS = 1e-3  # against slopes and high orders, of the normal matrix: for windows that the recording's end cuts
_TERMS = _ORDER + 5  # fitted in a window besides the other bands
_SAMPLES_A_TERM = 3.0
_HOPS = 4  # windows begun in the length of one
_MOST_WINDOWS = 96
_RIDGE = 1e-11  # of the scaled normal matrix: windows that hold hardly any data


@dataclass(frozen=True)
class Demodulated:
    """One band of one sensor.

    Attributes:
        frequency: the band's [Hz].
        centres: (J,) of the windows [s].
        length: of a window [s].
        measured: (J, C) complex amplitudes a of Re(a exp(2 pi i frequency t)) [m or rad].
        simulated: (J, C) the same of the simulation.
        std: (J, C) standard error of a measured amplitude's real and imaginary part.
        wave: (F, C) complex, what the simulation has in this band: its real part is the motion [m or rad].
    """

    frequency: float
    centres: Array
    length: float
    measured: Complex
    simulated: Complex
    std: Array
    wave: Complex


def visible(channels: Channels, frequency: float) -> bool:
    """Whether a sensor can show a band: enough samples a period, and enough periods."""
    duration = float(channels.time[-1] - channels.time[0])
    return frequency * duration >= _LEAST_PERIODS and frequency * channels.step * _LEAST_SAMPLES <= 1


def demodulate(channels: Channels, frequency: float, others: Sequence[float]) -> Demodulated:
    """Amplitudes of a band that the sensor can show.

    Args:
        channels: the sensor.
        frequency: the band's [Hz].
        others: of the other bands [Hz].
    """
    start, stop = float(channels.time[0]), float(channels.time[-1])
    seen = [each for each in others if visible(channels, each)]
    samples = _SAMPLES_A_TERM * (_TERMS + 2 * len(seen)) * channels.step
    length = min(max(_PERIODS / frequency, samples, _HOPS * (stop - start) / _MOST_WINDOWS), stop - start)
    room = stop - start - 2 * REACH * length
    centres = np.linspace(start + REACH * length, stop - REACH * length, max(int(_HOPS * room / length) + 1, 2))
    apart = [each for each in seen if abs(each - frequency) * length > 1 and each > frequency / 2]
    windows = _Windows.of(channels.time, centres, length)
    known, whole = channels.known, np.ones_like(channels.known)
    values = [np.where(known, channels.measured, 0.0), channels.simulated, channels.simulated]
    found = windows.fit(np.hstack(values), np.hstack([known, known, whole]), frequency, apart)
    measured, simulated, complete = np.split(found[0], 3, axis=1)
    slope, std = found[1][:, -complete.shape[1] :], found[2][:, : measured.shape[1]]
    wave = windows.wave(complete, slope, frequency)
    return Demodulated(frequency, centres, length, measured, simulated, std * channels.noise, wave)


@dataclass(frozen=True)
class _Windows:
    """Windows on a time axis.

    Attributes:
        time: (F,) [s].
        centres: (J,) [s].
        rows: (J, W) instants in each window; of windows with fewer, the last repeat with no weight.
        place: (J, W) from -1 to 1 in a window.
        weights: (J, W).
    """

    time: Array
    centres: Array
    rows: NDArray[np.intp]
    place: Array
    weights: Array

    @staticmethod
    def of(time: Array, centres: Array, length: float) -> _Windows:
        first = np.searchsorted(time, centres - length / 2)
        counts = np.searchsorted(time, centres + length / 2) - first
        rows = first[:, None] + np.arange(max(int(counts.max()), 1))
        inside = np.arange(rows.shape[1]) < counts[:, None]
        rows = np.minimum(rows, len(time) - 1)
        place = 2 * (time[rows] - centres[:, None]) / length
        weights = np.where(inside, np.cos(0.5 * np.pi * np.clip(place, -1, 1)) ** 2, 0.0)
        return _Windows(time, centres, rows, np.clip(place, -1, 1), weights)

    def _basis(self, frequency: float, others: Sequence[float]) -> Array:
        """(J, W, q) own sine, its slope, the polynomial, the others' sines; each of about the same size."""
        since = self.time[self.rows] - self.centres[:, None]
        own = np.exp(2j * np.pi * frequency * since)
        columns = [own.real, -own.imag, self.place * own.real, -self.place * own.imag]
        columns += list(np.moveaxis(np.polynomial.legendre.legvander(self.place, _ORDER), 2, 0))
        for other in others:
            wave = np.exp(2j * np.pi * other * since)
            columns += [wave.real, wave.imag]
        return np.stack(columns, axis=2)

    def fit(
        self, values: Array, known: NDArray[np.bool_], frequency: float, others: Sequence[float]
    ) -> tuple[Complex, Complex, Array]:
        """(J, C) amplitudes, their slopes from centre to end of a window, and their errors from noise of size one."""
        basis = self._basis(frequency, others)
        size, columns = basis.shape[2], values.shape[1]
        soft = np.zeros(size)
        soft[[2, 3, *range(7, 5 + _ORDER)]] = _STIFFNESS  # slopes, and what is steeper than a parabola
        amplitude, slope = (np.zeros((len(self.rows), columns), dtype=np.complex128) for _ in range(2))
        std = np.full((len(self.rows), columns), np.inf)
        patterns: dict[bytes, list[int]] = {}
        for c, pattern in enumerate(known.T):
            patterns.setdefault(pattern.tobytes(), []).append(c)
        for own in patterns.values():
            pattern = known[:, own[0]]
            seen = self.weights * pattern[self.rows]
            weighted = np.swapaxes(basis * seen[:, :, None], 1, 2)
            normal = weighted @ basis
            level = np.trace(normal, axis1=1, axis2=2)[:, None, None] / size
            normal += (level + 1e-300) * np.diag(soft + _RIDGE)
            inverse = np.linalg.inv(normal)
            found = inverse @ (weighted @ values[:, own][self.rows])
            amplitude[:, own], slope[:, own] = found[:, 0] + 1j * found[:, 1], found[:, 2] + 1j * found[:, 3]
            spread = inverse[:, :2] @ weighted
            error = np.sqrt(0.5 * np.sum(spread**2, axis=(1, 2)))
            full = np.count_nonzero(seen > 0, axis=1) > size
            std[:, own] = np.where(full, error, np.inf)[:, None]
        turn = np.exp(-2j * np.pi * frequency * self.centres)[:, None]
        return amplitude * turn, slope * turn, std

    def wave(self, amplitude: Complex, slope: Complex, frequency: float) -> Complex:
        """(F, C) a band's motion put together again from its windows."""
        total = np.zeros(self.time.size)
        wave = np.zeros((self.time.size, amplitude.shape[1]), dtype=np.complex128)
        for rows, place, weights, a, b in zip(self.rows, self.place, self.weights, amplitude, slope, strict=True):
            count = int(rows[-1]) - int(rows[0]) + 1  # the last ones may repeat the end
            own = slice(int(rows[0]), int(rows[0]) + count)
            total[own] += weights[:count]
            wave[own] += weights[:count, None] * a + (weights * place)[:count, None] * b
        carrier: Complex = np.exp(2j * np.pi * frequency * self.time) / np.maximum(total, 1e-300)
        return wave * carrier[:, None]
