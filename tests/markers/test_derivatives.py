"""Derivatives of sampled angles and their noise."""

from __future__ import annotations

import numpy as np
import pytest

from vjm.markers.smoothing import Smoother, interpolate

RATE = 30.0


def wave(frequency: float, duration: float = 20.0) -> tuple[np.ndarray, np.ndarray, float]:
    t = np.arange(int(duration * RATE)) / RATE
    return t, np.sin(2 * np.pi * frequency * t + 0.3)[:, None], 2 * np.pi * frequency


def gain(found: np.ndarray, expected: np.ndarray) -> float:
    return float(np.sum(found * expected) / np.sum(expected**2))


def test_interpolating_spline_is_a_fifth_off_at_four_samples_a_period() -> None:
    t, y, omega = wave(7.4)
    found = interpolate(t, y, 1 / RATE)
    inner = slice(20, -20)
    assert gain(found.acceleration[inner], -(omega**2) * y[inner]) == pytest.approx(1.2, abs=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_smoothing_passes_value_rate_and_acceleration_through_one_filter(seed: int) -> None:
    t, y, omega = wave(7.4)
    noisy = y + 0.01 * np.random.default_rng(seed).normal(size=y.shape)
    found = Smoother(t).derivatives(noisy, np.array([[0.01**2]]))
    rate = omega * np.cos(omega * t + 0.3)[:, None]
    kept = found.interior
    gains = [
        gain(found.value[kept], y[kept]),
        gain(found.rate[kept], rate[kept]),
        gain(found.acceleration[kept], -(omega**2) * y[kept]),
    ]
    assert gains == pytest.approx([gains[0]] * 3, rel=4e-3)
    assert gains[0] == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_residual_is_as_large_as_the_noise(noise: float) -> None:
    t, y, _ = wave(3.1)
    noisy = y + noise * np.random.default_rng(1).normal(size=y.shape)
    found = Smoother(t).derivatives(noisy, np.array([[noise**2]]))
    assert np.sqrt(np.mean((found.value - noisy) ** 2)) == pytest.approx(noise, rel=0.01)


def test_noise_of_the_derivatives_is_what_the_gains_say() -> None:
    t = np.arange(400) / RATE
    smoother = Smoother(t)
    samples = np.random.default_rng(4).normal(size=(400, 500))
    found = smoother.derivatives(samples, np.eye(500), exponent=1.0)
    stack = np.stack([found.value[200], found.rate[200], found.acceleration[200]])
    size = np.sqrt(np.diag(found.gains))
    correlation = np.cov(stack) / np.outer(size, size)
    assert correlation == pytest.approx(found.gains / np.outer(size, size), abs=0.15)
    assert found.noise([2.0])[2, 0] == pytest.approx(2 * size[2])
    assert found.interior[200]
    assert not found.interior[0]


def test_interpolation_says_how_noisy_it_is() -> None:
    t = np.arange(300) / RATE
    samples = np.random.default_rng(6).normal(size=(300, 500))
    found = interpolate(t, samples)
    inner = found.acceleration[500:-500]
    assert np.sqrt(np.mean(inner**2)) == pytest.approx(float(found.noise([1.0])[2, 0]), rel=0.05)
    assert np.diff(found.time) == pytest.approx(0.004)


def test_dropped_frames_do_not_matter() -> None:
    t, y, omega = wave(2.0)
    kept = np.random.default_rng(8).random(t.size) > 0.3
    found = Smoother(t[kept]).derivatives(y[kept], np.array([[1e-8]]))
    inner = found.interior
    assert np.abs(found.acceleration + omega**2 * y[kept])[inner].max() < 0.02 * omega**2
