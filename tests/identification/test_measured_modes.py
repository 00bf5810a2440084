"""Frequencies and noise read off recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vjm.experiment.spectrum import MeasuredModes, match, measure_modes, measured_noise, sensor_noise, white_noise
from vjm.records import Link, Recording, Rig


def decay(t: np.ndarray, frequency: float, ratio: float, phase: float) -> np.ndarray:
    omega = 2 * np.pi * frequency
    return np.exp(-ratio * omega * t) * np.cos(omega * np.sqrt(1 - ratio**2) * t + phase)


@pytest.mark.parametrize("seed", range(3))
def test_two_decaying_modes_finer_than_a_bin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(300) / 30.0  # bins of 0.1 Hz
    shapes = rng.normal(size=(2, 4))
    y = 0.05 * decay(t, 1.187, 0.002, 0.4)[:, None] * shapes[0]
    y += 0.01 * decay(t, 7.43, 0.008, 1.0)[:, None] * shapes[1] + 0.003
    y += 3e-4 * rng.normal(size=y.shape)
    y[40:44, 1] = np.nan
    found = measure_modes(t, y, 3e-4, most=5)
    assert found.frequencies == pytest.approx([1.187, 7.43], rel=1e-3)
    assert found.damping_ratios == pytest.approx([0.002, 0.008], abs=4e-4)
    pulls = (found.frequencies - [1.187, 7.43]) / found.frequency_std
    assert np.abs(pulls).max() < 4


def test_standard_errors_are_what_noise_does() -> None:
    t = np.arange(200) / 30.0
    pulls = []
    for seed in range(40):
        y = 0.01 * decay(t, 2.3, 0.01, 0.2)[:, None] + 3e-4 * np.random.default_rng(seed).normal(size=(200, 1))
        found = measure_modes(t, y, 3e-4, most=1)
        pulls.append((found.frequencies[0] - 2.3) / found.frequency_std[0])
    assert 0.75 < np.std(pulls) < 1.3


@pytest.mark.parametrize("seed", range(2))
def test_a_driven_mode_is_told_from_its_drive(seed: int) -> None:
    """The drive's own tone is no mode: oscillator of 3.1 Hz driven by tones at 1.3 and 4.7 Hz."""
    rng = np.random.default_rng(seed)
    knots = np.arange(0, 8, 0.002)
    torque = 0.3 * np.sin(2 * np.pi * 1.3 * knots) + 0.2 * np.sin(2 * np.pi * 4.7 * knots + 0.5)
    omega, ratio = 2 * np.pi * 3.1, 0.01

    def motion(t: float, state: np.ndarray) -> list[float]:
        force = float(np.interp(t, knots, torque))
        return [state[1], force - 2 * ratio * omega * state[1] - omega**2 * state[0]]

    t = np.arange(0, 7.9, 0.01)
    path = solve_ivp(motion, (0, 7.95), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-12, max_step=0.002).y[0]
    y = path[:, None] + 1e-6 * rng.normal(size=(t.size, 1))
    found = measure_modes(t, y, 1e-6, most=3, torque=(knots, torque[:, None]))
    assert found.frequencies == pytest.approx([3.1], rel=1e-4)
    assert found.damping_ratios == pytest.approx([0.01], rel=0.01)


@pytest.mark.parametrize("seed", range(20))
def test_noise_shows_no_mode(seed: int) -> None:
    y = np.random.default_rng(seed).normal(size=(400, 3))
    assert measure_modes(np.arange(400) / 100, y, 1.0, most=4).frequencies.size == 0


def test_match_takes_the_nearest_mode_and_weighs_recordings() -> None:
    def one(frequency: float, std: float) -> MeasuredModes:
        return MeasuredModes(np.array([frequency]), np.array([0.01]), np.array([std]), np.array([1e-3]))

    combined = match(3.0, [one(3.01, 1e-3), one(3.05, 0.1), one(7.0, 1e-3)], 0.15)
    assert combined is not None
    assert combined[0] == pytest.approx(3.01, abs=1e-3)
    assert match(5.0, [one(3.01, 1e-3), one(7.0, 1e-3)], 0.15) is None


@pytest.mark.parametrize("moving", [0.0, 0.05])
def test_white_noise_under_motion(moving: float) -> None:
    t = np.arange(1500) / 100
    rng = np.random.default_rng(1)
    y = moving * decay(t, 2.2, 0.004, 0.1)[:, None] * np.ones(4) + 3e-4 * rng.normal(size=(1500, 4))
    assert white_noise(y) == pytest.approx(3e-4, rel=0.06)
    assert np.isnan(white_noise(y[:10]))


def still_then_moving(quantum: float, noise: float, quiet: bool) -> list[Recording]:
    """Recordings of rounded markers and angles, one of them at rest."""
    t, random = np.arange(1500) / 100, np.random.default_rng(2)
    recordings = []
    for kind, size in (("quiet", 0.0), ("decay", 0.1)) if quiet else (("decay", 0.1),):
        signal = size * decay(t, 2.2, 0.004, 0.1)[:, None] * np.ones(5) + noise * random.normal(size=(1500, 5))
        signal = quantum * np.round(signal / quantum)
        recordings.append(Recording(t, signal[:, :4].reshape(-1, 2, 2), signal[:, 4], kind=kind, file=f"{kind}.csv"))
    return recordings


@pytest.mark.parametrize("quiet", [True, False])
@pytest.mark.parametrize("noise", [0.0, 1e-5, 3e-4, 2e-3])
def test_sensors_that_round_are_no_more_exact_at_rest(noise: float, quiet: bool) -> None:
    expected = np.hypot(noise, 1e-3 / np.sqrt(12))
    for measured in measured_noise(still_then_moving(1e-3, noise, quiet)):
        # At rest within a step, noise below it is seen where it reaches the next one: with half of its variance.
        assert expected / np.sqrt(2) < measured < 1.15 * expected


def test_noise_that_recordings_do_not_show_is_not_zero() -> None:
    rig = Rig("rig", (Link("beam", "revolute", 2.0, 1.0, 1.0, (1.0, 2.0)),))
    resting = still_then_moving(1e-3, 0.0, True)[:1]
    few = [Recording(each.time[:12], each.markers[:12], each.theta[:12], kind="quiet") for each in resting]
    for recordings in (resting, few):
        assert np.isnan(measured_noise(recordings)).all()
        assert sensor_noise(rig, recordings) == (2e-3, 1e-3)
    exact = still_then_moving(1e-18, 0.0, False)
    assert sensor_noise(rig, exact) == (2e-7, 1e-7)
    assert sensor_noise(replace(rig, marker_noise=1e-4, encoder_noise=1e-5), resting) == (1e-4, 1e-5)
