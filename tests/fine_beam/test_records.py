"""Sensors, the written files, and the demo's data."""

from __future__ import annotations

import ast
import csv
import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.fine_beam import (
    Beam,
    Camera,
    Encoder,
    Frames,
    RecordingEntry,
    Trajectory,
    observe,
    read_encoder,
    simulate,
    write_experiment,
    write_recording,
)
from tests.fine_beam.make_demo import (
    DEMO_DIRECTORY,
    MARKERS,
    NOMINAL_STIFFNESS,
    RECORDINGS,
    TRUE_BEAM,
    TRUTH_FILE,
    DemoRecording,
    euler_bernoulli_frequencies,
    make_demo,
    simulate_recording,
)
from tests.fine_beam.write import Value

Array = NDArray[np.float64]
HUB = Beam(length=1.0, mass=0.44, bending_stiffness=1.97, kelvin_voigt_time=3e-4, joint="revolute", hub_inertia=0.02)


@pytest.fixture(scope="module")
def motion() -> Trajectory:
    """One second of a hub-driven motion at 500 Hz."""
    time = np.arange(501) / 500.0
    return simulate(HUB, time, 0.3 * np.sin(6.0 * time))


@pytest.fixture(scope="module")
def still() -> Trajectory:
    """A hundred seconds of rest, as two instants: enough to count what sensors do."""
    moving = simulate(HUB, np.array([0.0, 1e-3]))
    return Trajectory(HUB, moving.numerics, np.array([0.0, 100.0]), moving.coordinates, moving.rates, moving.mechanics)


def read(path: Path) -> dict[str, Array]:
    """Columns of a CSV; an empty cell is NaN."""
    with path.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    assert all(len(row) == len(header) for row in rows)
    values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])
    assert np.all(np.isfinite(values) | np.isnan(values))
    return dict(zip(header, values.T, strict=True))


# Sensors


def test_white_noise_has_the_asked_size_and_repeats_with_its_seed(still: Trajectory) -> None:
    camera = Camera(rate=100.0, noise=3e-4)
    frames = observe(still, MARKERS, camera, seed=1)
    error = frames.markers - still.positions(MARKERS)[0]
    assert error.std() == pytest.approx(3e-4, rel=0.01)
    lagged = np.mean(error[1:] * error[:-1]) / error.var()
    assert abs(lagged) < 0.01
    np.testing.assert_array_equal(frames.markers, observe(still, MARKERS, camera, seed=1).markers)
    assert np.all(frames.markers != observe(still, MARKERS, camera, seed=2).markers)


def test_coloured_noise_keeps_its_size_and_correlation(still: Trajectory) -> None:
    camera = Camera(rate=100.0, noise=3e-4, noise_correlation=0.8)
    error = observe(still, MARKERS, camera, seed=1).markers - still.positions(MARKERS)[0]
    assert error.std() == pytest.approx(3e-4, rel=0.03)
    assert error[0].std() == pytest.approx(3e-4, rel=0.7)  # stationary from the first frame on
    assert np.mean(error[1:] * error[:-1]) / error.var() == pytest.approx(0.8, abs=0.02)


def test_lost_frames_occlusions_and_outliers_leave_the_rest_unchanged(still: Trajectory) -> None:
    clean = observe(still, MARKERS, Camera(rate=100.0, noise=3e-4), seed=1)
    spoilt = observe(
        still, MARKERS, Camera(100.0, 3e-4, dropped_frames=0.1, occluded=0.05, outliers=0.02, outlier_size=0.03), seed=1
    )
    assert len(spoilt.time) == pytest.approx(0.9 * len(clean.time), rel=0.02)
    hidden = np.isnan(spoilt.markers)
    assert hidden.mean() == pytest.approx(0.05, abs=0.01)
    np.testing.assert_array_equal(hidden[..., 0], hidden[..., 1])
    difference = np.abs(spoilt.markers - clean.markers[np.isin(clean.time, spoilt.time)])
    wrong = difference > 0.0
    assert wrong[~hidden].mean() == pytest.approx(0.02, abs=0.003)
    assert np.sqrt(np.mean(difference[wrong] ** 2)) == pytest.approx(0.03, rel=0.05)


def test_occlusions_last_as_long_as_asked(still: Trajectory) -> None:
    frames = observe(still, MARKERS, Camera(100.0, occluded=0.2, occlusion_frames=8.0), seed=3)
    hidden = np.isnan(frames.markers[..., 0])
    begun = np.sum(hidden[1:] & ~hidden[:-1])
    assert hidden.mean() == pytest.approx(0.2, abs=0.02)
    assert hidden.sum() / begun == pytest.approx(8.0, rel=0.1)


def test_encoder_noise_and_resolution(still: Trajectory) -> None:
    _, noisy = read_encoder(still, Encoder(rate=500.0, noise=1e-4), seed=1)
    assert noisy.std() == pytest.approx(1e-4, rel=0.02)
    _, rounded = read_encoder(still, Encoder(rate=500.0, noise=1e-4, resolution=2e-4), seed=1)
    np.testing.assert_allclose(rounded / 2e-4, np.round(rounded / 2e-4), atol=1e-12)
    assert np.abs(rounded - noisy).max() <= 1e-4 * (1 + 1e-9)


def test_frames_between_samples_are_the_motion_there(motion: Trajectory) -> None:
    frames = observe(motion, MARKERS, Camera(rate=30.0), seed=1)
    merged = np.union1d(np.round(frames.time, 9), np.round(motion.time, 9))
    torque = np.interp(merged, motion.time, 0.3 * np.sin(6.0 * motion.time))
    exact = simulate(HUB, merged, torque).positions(MARKERS)[np.isin(merged, np.round(frames.time, 9))]
    np.testing.assert_allclose(frames.markers, exact, atol=1e-8)
    between = motion.at(motion.time[:-1] + 1e-3)
    slopes = np.gradient(motion.at(np.linspace(0.1, 0.2, 1001)).theta, 1e-4)
    np.testing.assert_allclose(
        np.interp(between.time[50:99], np.linspace(0.1, 0.2, 1001), slopes), between.rates[50:99, 0], atol=1e-5
    )
    with pytest.raises(ValueError, match="outside"):
        motion.at(np.array([1.5]))


def test_link_frame_turns_with_the_joint(motion: Trajectory) -> None:
    base, link = motion.positions(MARKERS), motion.positions(MARKERS, frame="link")
    turned = np.exp(1j * motion.theta)[:, None] * (link[..., 0] + 1j * link[..., 1])
    np.testing.assert_allclose(turned, base[..., 0] + 1j * base[..., 1], atol=1e-14)


# Files


def test_two_rates_share_one_file(motion: Trajectory, tmp_path: Path) -> None:
    frames = observe(motion, MARKERS, Camera(rate=30.0, noise=3e-4, occluded=0.1), seed=1)
    encoder = read_encoder(motion, Encoder(rate=500.0, noise=1e-4), seed=1)
    torque = 0.3 * np.sin(6.0 * motion.time)
    write_recording(tmp_path / "drive.csv", "arm_1", frames, encoder, (motion.time, torque))
    columns = read(tmp_path / "drive.csv")
    axes = [f"arm_1.m{marker}.{axis}" for marker in range(1, 6) for axis in "xy"]
    assert list(columns) == ["t", "arm_1.theta", "arm_1.tau", *axes]
    assert np.all(np.diff(columns["t"]) > 0.0)
    assert len(columns["t"]) == 501 + 31 - 11  # every third frame falls on an encoder sample
    sampled = ~np.isnan(columns["arm_1.tau"])
    np.testing.assert_allclose(columns["arm_1.tau"][sampled], torque, rtol=1e-11)
    np.testing.assert_allclose(columns["arm_1.theta"][sampled], encoder[1], atol=5.1e-8)
    filmed = np.isin(np.round(columns["t"], 7), np.round(frames.time, 7))
    written = np.stack([columns[name] for name in axes], axis=1)
    np.testing.assert_allclose(written[filmed].reshape(-1, 5, 2), frames.markers, atol=5.1e-7)
    assert np.all(np.isnan(written[~filmed]))


def test_numbers_that_round_to_zero_have_no_sign(tmp_path: Path) -> None:
    write_recording(
        tmp_path / "a.csv", "beam", Frames(np.array([0.0, 0.1]), np.array([[[-1e-9, -0.0]], [[-1e-6, 1.0]]]))
    )
    assert (tmp_path / "a.csv").read_text() == "t,beam.m1.x,beam.m1.y\n0,0.000000,0.000000\n0.1,-0.000001,1.000000\n"


def test_experiment_file_holds_what_was_given(tmp_path: Path) -> None:
    link: dict[str, Value] = {
        "name": "arm_1",
        "joint": "revolute",
        "length": 1.0,
        "youngs_modulus": 2.0072e11,
        "markers": [0.5, 1.0],
    }
    entry = RecordingEntry("a.csv", "driven", "train", "a", "reference", 0.05, (0.0, -9.81))
    path = tmp_path / "experiment.toml"
    write_experiment(path, 'a "rig"', link, {"marker_noise": 3e-4}, [entry, RecordingEntry("b.csv", "quiet", "train")])
    assert tomllib.loads(path.read_text()) == {
        "schema": 1,
        "name": 'a "rig"',
        "base": {"gravity": [0.0, 0.0]},
        "link": [link],
        "sensors": {"marker_noise": 3e-4},
        "recording": [
            {"file": "a.csv", "kind": "driven", "role": "train", "repeat": "a"}
            | {"condition": "reference", "payload": 0.05, "gravity": [0.0, -9.81]},
            {"file": "b.csv", "kind": "quiet", "role": "train"},
        ],
    }


def test_the_simulator_uses_nothing_of_the_package() -> None:
    for path in Path(__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.split(".")[0] == "vjm" for name in names), path.name


# The demo's data


@pytest.mark.slow
def test_demo_regenerates_byte_for_byte(tmp_path: Path) -> None:
    make_demo(tmp_path / "demo", tmp_path / "truth.json")
    stored = sorted(path.name for path in DEMO_DIRECTORY.iterdir() if path.suffix in (".csv", ".toml"))
    assert stored == sorted(path.name for path in (tmp_path / "demo").iterdir())
    for name in stored:
        assert (tmp_path / "demo" / name).read_bytes() == (DEMO_DIRECTORY / name).read_bytes(), name
    assert (tmp_path / "truth.json").read_bytes() == TRUTH_FILE.read_bytes()


def test_demo_experiment_hides_a_stiffness_error() -> None:
    experiment = tomllib.loads((DEMO_DIRECTORY / "experiment.toml").read_text())
    truth = json.loads(TRUTH_FILE.read_text())
    (link,) = experiment["link"]
    nominal = link["youngs_modulus"] * link["width"] * link["thickness"] ** 3 / 12.0
    assert nominal == pytest.approx(NOMINAL_STIFFNESS) == truth["bending_stiffness_nominal"]
    assert 1.03 < truth["bending_stiffness"] / nominal < 1.05
    assert (link["length"], link["mass"], link["markers"]) == (TRUE_BEAM.length, TRUE_BEAM.mass, MARKERS)
    assert [entry["file"] for entry in experiment["recording"]] == [item.entry.file for item in RECORDINGS]
    expected = euler_bernoulli_frequencies(TRUE_BEAM, 3)
    np.testing.assert_allclose(truth["simulator"]["frequencies_hz"], expected, rtol=1e-8)
    np.testing.assert_allclose(truth["simulator"]["damping_ratios"], np.pi * 3.07e-4 * np.array(expected), rtol=1e-7)


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda item: item.entry.file)
def test_demo_recording_is_the_motion_with_white_noise(recording: DemoRecording) -> None:
    columns = read(DEMO_DIRECTORY / recording.entry.file)
    axes = [f"beam.m{marker}.{axis}" for marker in range(1, 6) for axis in "xy"]
    assert list(columns) == ["t", *axes]
    np.testing.assert_allclose(columns["t"], np.arange(len(columns["t"])) / 30.0, atol=1e-8)
    assert columns["t"][-1] == pytest.approx(recording.duration)
    short = recording._replace(duration=1.0)
    truth = simulate_recording(short).positions(MARKERS)[::20].reshape(-1, 10)
    error = np.stack([columns[name] for name in axes], axis=1)[: len(truth)] - truth
    assert error.std() == pytest.approx(3e-4, rel=0.15)
    assert abs(error.mean()) < 6e-5
