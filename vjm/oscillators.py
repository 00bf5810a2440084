"""Free and forced motion of damped oscillators: what recordings of a vibrating arm are made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]


class Oscillators:
    """Basis functions of oscillators with given frequencies and damping ratios, at the camera's instants."""

    def __init__(self, time: Array, torque: tuple[ArrayLike, ArrayLike] | None) -> None:
        self.time = time - time[0] if time.size else time
        self.inputs: list[Array] = []
        if torque is None or time.size == 0:
            return
        knots, values = np.asarray(torque[0], dtype=float), np.asarray(torque[1], dtype=float)
        step = float(np.median(np.diff(knots)))
        self.step = min(step, float(np.median(np.diff(time))))
        grid = np.arange(int(np.ceil(self.time[-1] / self.step)) + 2) * self.step
        for column in values.T:
            sampled = np.interp(time[0] + grid, knots, column)
            if np.ptp(sampled) > 0:
                self.inputs.append(sampled)

    def columns(self, values: Array) -> Array:
        """(T, 1 + 2 m (1 + inputs)) offset, free and forced motion of m oscillators (Hz, ratio) (m, 2)."""
        parts = [np.ones_like(self.time)]
        for frequency, ratio in values:
            pole = 2 * np.pi * frequency * (-ratio + 1j * np.sqrt(max(1 - ratio**2, 1e-12)))
            free = np.exp(pole * self.time)
            parts += [free.real, free.imag]
            for signal in self.inputs:
                forced = self._forced(pole, signal)
                size = max(float(np.abs(forced).max()), 1e-300)
                parts += [forced.real / size, forced.imag / size]
        return np.stack(parts, axis=1)

    def _forced(self, pole: complex, signal: Array) -> NDArray[np.complex128]:
        """Response of z' = pole z + u at the camera's instants, u linear between its samples (exact)."""
        h = self.step
        flow = np.exp(pole * h)
        first = (flow - 1) / pole
        second = (flow - 1 - pole * h) / (pole**2 * h)
        response = np.concatenate(
            [[0.0], lfilter([1.0], [1.0, -flow], (first - second) * signal[:-1] + second * signal[1:])]
        )
        # Between grid instants: exact propagation from the one before, with the torque frozen in its linear piece.
        k = np.minimum((self.time / h + 1e-9).astype(int), signal.size - 2)
        rest = self.time - k * h
        part = np.exp(pole * rest)
        slope = (signal[k + 1] - signal[k]) / h
        zeroth = (part - 1) / pole
        moved: NDArray[np.complex128] = part * response[k] + zeroth * signal[k] + (zeroth - rest) / pole * slope
        return moved
