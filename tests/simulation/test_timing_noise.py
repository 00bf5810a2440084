"""Errors of the frames' instants: their likelihood against the one of a full covariance, and their tests."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import optimize, sparse, stats

from vjm.records import Array
from vjm.simulation.timing_noise import TimingNoise

FRAMES, WIDTH, OTHERS = 40, 6, 7  # frames of as many values, and values that are no camera's


def velocities() -> sparse.csr_array:
    """Weighted velocities [1/s] of values some of which were not measured; the arm rests in the first frames."""
    random = np.random.default_rng(1)
    frames = np.repeat(np.arange(FRAMES), WIDTH)[random.random(FRAMES * WIDTH) < 0.9]
    entries = random.normal(size=frames.size) * (frames > 4)
    shape = (FRAMES, frames.size + OTHERS)
    return sparse.csr_array((entries, (frames, np.arange(frames.size))), shape=shape)


def covariance(variance: float, rows: sparse.csr_array) -> Array:
    dense = rows.toarray()
    return np.eye(rows.shape[1]) + variance * dense.T @ dense


def minus_twice_log_likelihood(variance: float, rows: sparse.csr_array, weighted: Array) -> float:
    density = stats.multivariate_normal(np.zeros(weighted.size), covariance(variance, rows))
    return float(-2 * density.logpdf(weighted) - weighted.size * np.log(2 * np.pi))


def test_the_likelihood_is_that_of_the_full_covariance() -> None:
    rows, weighted = velocities(), np.random.default_rng(2).normal(size=velocities().shape[1])
    for variance in (0.0, 0.3, 20.0):
        noise = TimingNoise(variance, rows)
        white = noise.whitened(weighted)
        assert white @ white + noise.log_determinant == pytest.approx(
            minus_twice_log_likelihood(variance, rows, weighted)
        )
        transform = noise.whitened(np.eye(weighted.size))
        assert transform @ covariance(variance, rows) @ transform.T == pytest.approx(np.eye(weighted.size), abs=1e-10)


@pytest.mark.parametrize("variance", [0.0, 0.7])
def test_the_row_of_the_variance_has_the_likelihood_s_gradient_and_its_expected_curvature(variance: float) -> None:
    rows, weighted = velocities(), np.random.default_rng(3).normal(size=velocities().shape[1])
    noise = TimingNoise(variance, rows)
    slope, residual = noise.score(noise.whitened(weighted))
    at = [minus_twice_log_likelihood(variance + step, rows, weighted) for step in (0.0, 1e-5, 2e-5)]
    assert slope * residual == pytest.approx(-(-3 * at[0] + 4 * at[1] - at[2]) / 2e-5 / 2, rel=1e-4)
    change = np.linalg.solve(covariance(variance, rows), (rows.T @ rows).toarray())
    assert slope**2 == pytest.approx(np.trace(change @ change) / 2)


def test_what_the_best_variance_explains_is_foretold() -> None:
    random = np.random.default_rng(4)
    rows = velocities()
    weighted = np.linalg.cholesky(covariance(3.0, rows)) @ random.normal(size=rows.shape[1])
    found = optimize.minimize_scalar(
        lambda variance: minus_twice_log_likelihood(variance, rows, weighted), bounds=(0, 50), method="bounded"
    )
    noise = TimingNoise(0.0, rows)
    slope, decrease = noise.likelihood_ratio(weighted)
    assert decrease / slope == pytest.approx(found.x, rel=0.1)
    assert decrease**2 == pytest.approx(weighted @ weighted - found.fun, rel=0.1)


@pytest.mark.parametrize("size", [0.8, 1.0, 1.3])
def test_noise_alone_and_noise_larger_than_given_are_no_errors_of_time(size: float) -> None:
    """One-sided tests of recordings, and of fifty together, exceed their level no more often than they should."""
    random, noise = np.random.default_rng(5), TimingNoise(0.0, velocities())
    found = [noise.likelihood_ratio(size * random.normal(size=noise.velocities.shape[1])) for _ in range(1000)]
    slopes, residuals = np.array(found).reshape(20, 50, 2).transpose(2, 0, 1)
    assert np.mean(residuals > stats.norm.isf(0.05)) < 0.05 + 3 * np.sqrt(0.05 / 1000)
    assert np.mean(residuals < 0.0) > 0.45
    together = np.sum(slopes * residuals, axis=1) / np.linalg.norm(slopes, axis=1)
    assert abs(np.mean(together)) < 1.5
    assert np.max(together) < 3.0


def test_what_exact_recordings_leave_is_no_error_of_time() -> None:
    """A thousandth of the noise, however unlike noise: nearly all of it lies along the velocities."""
    noise = TimingNoise(0.0, velocities())
    lengths = np.sqrt(noise.velocities.power(2).sum(axis=1))
    along = np.asarray(noise.velocities.sum(axis=0)).ravel() / lengths.max()
    residual = along + 0.1 * np.random.default_rng(1).normal(size=along.size)
    assert noise.likelihood_ratio(1e-3 * residual)[1] < 1
    assert noise.likelihood_ratio(10 * residual)[1] > 10


def test_an_arm_at_rest_says_nothing() -> None:
    noise = TimingNoise(0.0, 0.0 * velocities())
    assert noise.score(np.ones(noise.velocities.shape[1])) == (0.0, 0.0)
    assert noise.likelihood_ratio(np.ones(noise.velocities.shape[1])) == (0.0, 0.0)
