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


@pytest.mark.parametrize("pause", [5.0, 100.0, 2000.0])
def test_a_pause_parts_what_is_before_from_what_is_after(pause: float) -> None:
    t, y, omega = wave(2.0)
    covariance = np.array([[1e-8]])
    alone = Smoother(t).derivatives(y, covariance, 2.0)
    both = Smoother(np.r_[t, t + t[-1] + pause]).derivatives(np.r_[y, y], covariance, 2.0)
    for part in (slice(0, t.size), slice(t.size, None)):
        for name, unit in (("value", 1.0), ("rate", omega), ("acceleration", omega**2)):
            np.testing.assert_allclose(getattr(both, name)[part], getattr(alone, name), atol=1e-4 * unit)


@pytest.mark.parametrize("exponent", [0.0, 2.0, 4.0, 10.0])
@pytest.mark.parametrize("frames", [[*range(24), *range(154, 178)], [*range(24), 300, *range(600, 624)]])
def test_few_frames_beside_a_pause_are_smoothed_as_they_are_alone(frames: list[int], exponent: float) -> None:
    """The penalty alone holds the coefficients of the pause, and that no better than rounding."""
    t = np.array(frames) / RATE
    y, covariance = np.sin(3 * t)[:, None], np.array([[1e-6]])
    alone = Smoother(t[:24]).derivatives(y[:24], covariance, exponent)
    both = Smoother(t).derivatives(y, covariance, exponent)
    assert np.isfinite(both.acceleration).all()
    if exponent < 10:  # the smoothest of all, which only has to be solved
        np.testing.assert_allclose(both.value[:24], alone.value, atol=1e-4)
        np.testing.assert_allclose(both.rate[:24], alone.rate, atol=1e-3 * 3)


def test_dropped_frames_do_not_matter() -> None:
    t, y, omega = wave(2.0)
    kept = np.random.default_rng(8).random(t.size) > 0.3
    found = Smoother(t[kept]).derivatives(y[kept], np.array([[1e-8]]))
    inner = found.interior
    assert np.abs(found.acceleration + omega**2 * y[kept])[inner].max() < 0.02 * omega**2


def test_a_tone_at_the_given_frequency_passes_by_half() -> None:
    time = np.arange(2000) / 200.0
    smoother = Smoother(time)
    tones = np.stack([np.sin(2 * np.pi * f * time) for f in (5.0, 12.0, 25.0)], axis=1)
    found = smoother.derivatives(tones, np.eye(3), smoother.exponent_of(12.0))
    middle = slice(500, 1500)
    passed = [float(found.value[middle, k] @ tones[middle, k]) / float(np.sum(tones[middle, k] ** 2)) for k in range(3)]
    assert passed == pytest.approx([1.0, 0.5, 0.0], abs=0.005)


def test_the_adjoint_is_the_derivative_by_every_sample() -> None:
    """A weighted sum of what the filter gives at instants between its data, by differences of single samples."""
    rng = np.random.default_rng(1)
    time, instants = np.arange(60) / 50.0, np.sort(rng.uniform(0.1, 1.1, 25))
    smoother, values = Smoother(time, instants), rng.normal(size=(60, 2))
    weights = [rng.normal(size=(25, 2)) for _ in range(3)]

    def weighted(samples: np.ndarray) -> float:
        found = smoother.derivatives(samples, np.eye(2), 2.0)
        parts = zip(weights, (found.value, found.rate, found.acceleration), strict=True)
        return float(sum(np.sum(weight * part) for weight, part in parts))

    slopes = smoother.adjoint(weights, 2.0)
    for sample, column in ((0, 0), (17, 1), (40, 0), (59, 1)):
        changed = values.copy()
        changed[sample, column] += 1.0  # linear: any step is exact
        # The mean is taken out before smoothing; the spline passes constants, so nothing of it is seen.
        assert weighted(changed) - weighted(values) == pytest.approx(slopes[sample, column], rel=1e-6, abs=1e-6)
