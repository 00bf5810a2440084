"""The camera's noise: its colour is found, and what whitens it leaves white noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.diagnosis import rigs
from tests.diagnosis.rigs import NOISE, chain_of, point_of, recorded
from vjm.diagnosis.noise import Noise, _autoregression, _frame_numbers
from vjm.effects import CameraVibration, InPlaneGravity
from vjm.records import Link, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import Observations

RIG = Rig("rig", (Link("beam", "clamped", 1.0, 0.4, 2.0, (0.5, 1.0)),))


def coloured(seed: int, frames: int, coefficients: list[float], dropped: float) -> Observations:
    """What a camera with autoregressive noise of 1 mm shows of an arm that stands still; some frames are lost."""
    random = np.random.default_rng(seed)
    white = random.standard_normal((frames + 500, 2, 2))
    noise = lfilter([1.0], [1.0, *(-np.array(coefficients))], white, axis=0)[500:]
    noise *= 1e-3 / np.sqrt(autocovariance(coefficients)[0])
    kept = random.random(frames) >= dropped
    time = np.arange(frames)[kept] / 100
    empty = np.zeros((kept.sum(), 0))
    recording = Recording(time, noise[kept], empty, empty, kind="quiet", role="train", file="quiet.csv")
    return Observations.of(RIG, recording, (1e-3, 1e-4))


def autocovariance(coefficients: list[float]) -> np.ndarray:
    """By the impulse response, which the code under test does not use."""
    impulse = lfilter([1.0], [1.0, *(-np.array(coefficients))], np.r_[1.0, np.zeros(4000)])
    return np.array([impulse[: impulse.size - lag] @ impulse[lag:] for lag in range(41)])


@pytest.mark.parametrize("coefficients", [[0.7], [1.2, -0.5]])
def test_the_autoregression_is_found(coefficients: list[float]) -> None:
    expected = autocovariance(coefficients)
    found = _autoregression(expected[:9] / expected[0], 100_000)
    np.testing.assert_allclose(found, coefficients, atol=1e-6)


def test_white_noise_has_no_colour() -> None:
    correlation = np.r_[1.0, 0.01 * np.random.default_rng(1).standard_normal(8)]
    assert _autoregression(correlation, 10_000).size == 0


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(("coefficients", "dropped"), [([0.8], 0.0), ([0.8], 0.3), ([1.2, -0.5], 0.1)])
def test_whitened_noise_is_white_and_of_unit_size(seed: int, coefficients: list[float], dropped: float) -> None:
    observed = coloured(seed, 3000, coefficients, dropped)
    whitening = Noise(1e-3, np.array(coefficients), "").whitened(observed)
    values = whitening.whitened(whitening.weights * whitening.values).reshape(-1, 4)
    assert np.std(values) == pytest.approx(1.0, abs=0.03)
    for lag in (1, 2, 5):
        correlation = np.mean(values[lag:] * values[:-lag]) / np.mean(values**2)
        assert abs(correlation) < 4 / np.sqrt(values.size)
    raw = observed.values.reshape(-1, 4)
    assert np.mean(raw[1:] * raw[:-1]) / np.mean(raw**2) > 0.5


@pytest.mark.parametrize("rate", [15, 24, 30, 60, 90, 120])
def test_frames_are_counted_by_time_stamps_of_milliseconds(rate: int) -> None:
    numbers = np.flatnonzero(np.random.default_rng(rate).random(3000) >= 0.2)
    numbers = np.setdiff1d(numbers, np.arange(1000, 1060)) - numbers[0]
    assert _frame_numbers(np.round(numbers / rate, 3)).tolist() == numbers.tolist()


def test_what_is_correlated_beyond_any_process_is_no_noise() -> None:
    """Exact recordings leave what the model lacks; correlations over gaps may come out above one."""
    correlation = np.array([1.0, 1.001, 0.99, 1.0, 0.98])
    coefficients = _autoregression(correlation, 1000)
    assert np.abs(np.roots(np.r_[1.0, -coefficients])).max(initial=0.0) < 1
    assert Noise(1e-3, coefficients, "").whitened(coloured(1, 200, [0.8], 0.1)).count


def test_the_beginning_of_whitened_measurements_is_whitened_alike() -> None:
    integer = Noise(1e-3, np.array([0.8]), "").whitened(coloured(4, 500, [0.8], 0.1))
    part = integer.truncated(2.0)
    values = integer.whitened(integer.values).reshape(-1, 4)[: part.values.size // 4]
    np.testing.assert_allclose(part.whitened(part.values).reshape(-1, 4), values, rtol=1e-12)


def test_without_an_encoder_the_markers_alone_say_where_the_arm_is() -> None:
    wrong = point_of(chain_of(), (InPlaneGravity(gx=0.15, gy=-0.1),), recorded(Arm(chain_of()), 1)).runs
    blind = [replace(run.observed.recording, theta=np.nan * run.observed.recording.theta) for run in wrong]
    runs = [
        replace(run, observed=replace(run.observed, recording=each)) for run, each in zip(wrong, blind, strict=True)
    ]
    assert Noise.of(runs).std == pytest.approx(NOISE[0], rel=0.1)


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_noise_is_known_where_the_model_is_all_wrong(correlation: float) -> None:
    """Where the arm is, its markers say; a simulation may have it anywhere."""
    recordings = recorded(Arm(chain_of()), 1, correlation=correlation)
    wrong = point_of(chain_of(), (InPlaneGravity(gx=1.5, gy=-1.0),), recordings)
    assert wrong.misfit > 100
    noise = Noise.of(wrong.runs)
    assert noise.std == pytest.approx(NOISE[0], rel=0.1)
    assert noise.autoregression.size == (correlation > 0)
    assert noise.autoregression == pytest.approx([correlation] * noise.autoregression.size, abs=0.1)


def test_noise_is_known_where_a_simulation_has_coiled_the_arm_up() -> None:
    """Newton's steps lead nowhere from there; they begin at a straight link too."""
    wrong = point_of(chain_of(), (), recorded(Arm(chain_of()), 1)).runs
    coil = np.array([0.0, 2.5, -2.0, 2.5])
    coils = [replace(run.trajectory, q=run.trajectory.q + coil[: run.chain.size]) for run in wrong]
    runs = [replace(run, trajectory=trajectory) for run, trajectory in zip(wrong, coils, strict=True)]
    assert Noise.of(runs).std == pytest.approx(NOISE[0], rel=0.1)


@pytest.mark.parametrize("direction", [0.0, 1.5])
def test_a_shaking_camera_is_not_taken_for_noise(direction: float) -> None:
    shaking = CameraVibration(amplitude=3 * NOISE[0], frequency=7.0, direction=direction)
    noise = Noise.of(point_of(chain_of(), (), recorded(Arm(chain_of(), (shaking,)), 1)).runs)
    assert noise.std == pytest.approx(NOISE[0], rel=0.05)
    assert noise.autoregression.size == 0


@pytest.mark.parametrize("direction", [0.0, 0.7])
def test_a_shaking_camera_is_not_taken_for_noise_by_few_markers(direction: float) -> None:
    """Three markers, and three motions across the link: what shifts them along it is no motion of the arm."""
    shaking = CameraVibration(amplitude=3 * NOISE[0], frequency=7.0, direction=direction)
    hidden = np.isin(np.arange(5), [1, 3])[:, None]
    recordings = [
        replace(recording, markers=np.where(hidden, np.nan, recording.markers))
        for recording in recorded(Arm(chain_of(2), (shaking,)), 1)
    ]
    noise = Noise.of(point_of(chain_of(2), (), recordings).runs)
    assert noise.std == pytest.approx(NOISE[0], rel=0.1)
    assert noise.autoregression.size == 0


@pytest.mark.parametrize(("hidden", "joints"), [([], 3), ([], 2), ([1], 2)])
def test_what_moves_no_marker_takes_no_noise_away(
    hidden: list[int], joints: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the link's frame its turn does not show, and where y alone is measured, neither does a shift along x."""
    own_frame = replace(rigs.RIG, links=(replace(rigs.LINK, markers_frame="link"),))
    monkeypatch.setattr(rigs, "RIG", own_frame)
    recordings = []
    for recording in recorded(Arm(chain_of(joints)), 1, duration=5.0):
        markers = recording.markers.copy()
        markers[..., 0] = np.nan
        markers[:, hidden] = np.nan
        recordings.append(replace(recording, markers=markers))
    assert Noise.of(point_of(chain_of(joints), (), recordings).runs).std == pytest.approx(NOISE[0], rel=0.1)
