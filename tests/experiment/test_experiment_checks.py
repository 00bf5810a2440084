"""Warnings: each appears when it should, says where, and stays away otherwise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from experiment_files import DRIVEN, FREE, ROWS, TOML, csv_text, rows, write_experiment
from hypothesis import given
from hypothesis import strategies as st

from vjm.errors import RecordingError
from vjm.experiment.checks import (
    _absence_warnings,
    _clipped_runs,
    _clipping_warnings,
    _coverage_warnings,
    _distance_warnings,
    _driving_gap_warnings,
    _gap_warnings,
    _impulse_errors,
    _interpolation_errors,
    _leaps,
    _torque_difference,
    _unit_warnings,
    cleaned,
    moves,
    untracked,
)
from vjm.experiment.load import load_experiment
from vjm.records import Experiment, Link, Recording, Rig

NOISE = 3e-4
ARCS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
NAMES = [f"beam.m{number}" for number in range(1, 6)]
TIME = 0.01 * np.arange(400)


def beam(seed: int = 0, count: int = 400) -> np.ndarray:
    """Markers (count, 5, 2) on a straight beam that turns: every distance is at its limit, but for the noise."""
    angle = np.sin(3.0 * TIME[:count])[:, None]
    markers = np.stack([ARCS * np.cos(angle), ARCS * np.sin(angle)], axis=-1)
    return markers + np.random.default_rng(seed).normal(0.0, NOISE, markers.shape)


def load_changed(
    folder: Path, name: str, change: Callable[[np.ndarray, list[str]], None], toml: str = TOML
) -> Experiment:
    """The small experiment with the numbers of one recording changed in place, NaN for empty."""
    columns = FREE if name == "free" else DRIVEN
    table = np.array([[float(cell) if cell else np.nan for cell in line] for line in rows(columns, 100, seed=9)])
    change(table, columns)
    cells = [["" if np.isnan(x) else repr(float(x)) for x in line] for line in table]
    return load_experiment(write_experiment(folder, toml, **{name: csv_text(columns, cells)}))


def test_gaps() -> None:
    times = np.delete(0.01 * np.arange(100), np.r_[20:25, 60])
    assert list(_gap_warnings(0.01 * np.arange(100))) == []
    assert list(_gap_warnings(np.delete(0.01 * np.arange(100), 60))) == []
    (sentence,) = _gap_warnings(times)
    assert "1 gap without any marker" in sentence
    assert "0.06 s from t = 0.19 s" in sentence
    assert "every 0.01 s" in sentence
    assert list(_gap_warnings(np.array([0.0, 5.0]))) == []


def test_units() -> None:
    assert list(_unit_warnings(beam(), 1.0)) == []
    (sentence,) = _unit_warnings(1000.0 * beam(), 1.0)
    assert "millimetres" in sentence
    assert list(_unit_warnings(np.full((3, 2, 2), np.nan), 1.0)) == []


@pytest.mark.parametrize("seed", range(5))
def test_a_straight_beam_is_consistent(seed: int) -> None:
    assert list(_distance_warnings(TIME, beam(seed), ARCS, NAMES, NOISE)) == []


def test_markers_too_far_apart() -> None:
    markers = beam()
    markers[[50, 51, 60], 4] *= 1.02
    (sentence,) = _distance_warnings(TIME, markers, ARCS, NAMES, NOISE)
    assert sentence.startswith("in 3 frames (first at t = 0.5 s)")
    assert "by up to 0.02" in sentence
    assert "beam.m5" in sentence
    assert "swapped" not in sentence


def test_a_bent_beam_is_consistent() -> None:
    markers = beam()
    markers[:, 1:] -= 0.3 * (markers[:, 1:] - markers[:, [0]])
    assert list(_distance_warnings(TIME, markers, ARCS, NAMES, NOISE)) == []


@pytest.mark.parametrize(("first", "second"), [(0, 1), (1, 2), (0, 4), (2, 4)])
def test_swapped_labels(first: int, second: int) -> None:
    markers = beam()
    if (first, second) == (0, 4):
        markers, arcs, names = markers[:, [0, 1, 4]], ARCS[[0, 1, 4]], [NAMES[i] for i in (0, 1, 4)]
        first, second = 0, 2
    else:
        arcs, names = ARCS, NAMES
    markers[100:150, [first, second]] = markers[100:150, [second, first]]
    (sentence,) = _distance_warnings(TIME, markers, arcs, names, NOISE)
    assert "in 50 frames (first at t = 1 s)" in sentence
    assert f"labels may be swapped: exchanging {names[first]} and {names[second]}" in sentence
    assert "50 of the 50" in sentence


def test_distances_with_occluded_markers_and_lone_y() -> None:
    markers = beam()
    markers[::2, 1] = np.nan
    markers[:, 3] = np.nan
    assert list(_distance_warnings(TIME, markers, ARCS, NAMES, NOISE)) == []
    markers[..., 0] = np.nan
    assert list(_distance_warnings(TIME, markers, ARCS, NAMES, NOISE)) == []
    markers[7, 2, 1] += 5.0
    (sentence,) = _distance_warnings(TIME, markers, ARCS, NAMES, NOISE)
    assert "in 1 frame (first at t = 0.07 s)" in sentence


def test_clipping() -> None:
    y = 0.1 * np.sin(3.0 * TIME)
    assert list(_clipping_warnings(TIME, y[:, None], ["beam.m1.y"])) == []
    (sentence,) = _clipping_warnings(TIME, np.minimum(y, 0.08)[:, None], ["beam.m1.y"])
    assert "beam.m1.y stays at exactly its largest value, 0.08 m" in sentence
    (sentence,) = _clipping_warnings(TIME, np.maximum(y, -0.08)[:, None], ["beam.m1.y"])
    assert "smallest value, -0.08 m" in sentence
    gappy = np.minimum(y, 0.08)
    gappy[::2] = np.nan
    assert len(list(_clipping_warnings(TIME, gappy[:, None], ["beam.m1.y"]))) == 1


def test_what_only_resembles_clipping() -> None:
    rest = np.concatenate([np.full(100, 1.0), np.cos(3.0 * TIME), np.full(50, np.cos(3.0 * TIME[-1]))])
    assert _clipped_runs(rest)[0].size == 0
    assert _clipped_runs(np.ones(50))[0].size == 0
    for step in (1e-4, 1e-3, 1e-2):  # rounded peaks
        assert _clipped_runs(np.round(0.1 * np.sin(1.5 * TIME + 0.3) / step) * step)[0].size == 0


def test_noise_and_motion() -> None:
    noise = np.random.default_rng(0).normal(0.0, NOISE, 2000)
    for told in (NOISE, None):
        assert not moves(noise, told)
        assert moves(noise[:400] + 2.0 * NOISE * np.sin(20.0 * TIME), told)
    assert not moves(np.full(50, 0.1 + 0.2), None)
    assert not moves(np.full(97, 0.1), None)
    assert not moves(np.full(50, np.nan), None)
    fast = 0.05 * np.sin(2.0 * np.pi * 31.0 * TIME)  # near half the sampling rate, differences are no longer noise
    assert moves(fast, None)


def test_absence() -> None:
    markers = beam(count=20)
    needs_x = np.ones(5, dtype=bool)
    assert list(_absence_warnings(markers, NAMES, needs_x)) == []
    markers[:, 2] = np.nan
    markers[4, 1, 0] = np.nan
    first, second = _absence_warnings(markers, NAMES, needs_x)
    assert first == "no position of beam.m3 in this recording"
    assert second.startswith("in 1 frame a marker has one coordinate")
    assert list(_absence_warnings(markers[:, 1:2], NAMES[1:2], ~needs_x[:1])) == []


def test_coverage() -> None:
    frames = 0.01 * np.arange(100)
    assert list(_coverage_warnings("beam.tau", frames[1:-1], frames)) == []
    (sentence,) = _coverage_warnings("beam.tau", frames[:50], frames)
    assert "beam.tau is measured from t = 0 to 0.49 s only" in sentence
    assert len(list(_coverage_warnings("beam.tau", frames[5:], frames))) == 1
    assert list(_coverage_warnings("beam.tau", frames[:0], frames)) == []


HUB = Rig("rig", (Link("beam", "revolute", 1.0, 0.44, 1.97, (1.0,), hub_inertia=0.02),), marker_noise=NOISE)


def driven(torque: np.ndarray, rate: float = 200.0, first_frame: float = 0.0) -> Recording:
    """A recording under torques (T,), with frames from some time on, s."""
    time = np.arange(torque.size) / rate
    markers = np.where(time[:, None, None] >= first_frame, 1.0, np.full((torque.size, 1, 2), np.nan))
    return Recording(time, markers, np.zeros((torque.size, 1)), torque[:, None], kind="driven", file="a.csv")


def unknown_during(torque: np.ndarray, begin: int, end: int) -> np.ndarray:
    return np.where((np.arange(torque.size) >= begin) & (np.arange(torque.size) < end), np.nan, torque)


@pytest.mark.parametrize("inner", [True, False])
@pytest.mark.parametrize("count", [2, 30, 150])
def test_the_impulse_that_interpolation_misses_is_that_of_a_sinusoid(count: int, inner: bool) -> None:
    rate, omega, duration = 1000.0, 7.0, count / 1000.0
    time = np.arange(20 * 898) / rate  # whole periods
    errors = _impulse_errors(time, np.sin(omega * time)[:, None], 1 / rate, count, inner)
    half = omega * duration / 2
    if inner:  # chord: its impulse at a phase is in step with the sinusoid's at the middle
        expected = abs(2 / omega * np.sin(half) - duration * np.cos(half))
    else:
        expected = abs((np.exp(2j * half) - 1) / (1j * omega) - duration)
    assert errors[0] == pytest.approx(expected / np.sqrt(2), rel=0.01, abs=3e-8)  # the sum is by trapezoids


SMOOTH = 0.08 * np.sin(2 * np.pi * 1.3 * np.arange(1001) / 200.0)


@pytest.mark.parametrize(
    ("torque", "part"),
    [
        (SMOOTH, (0.0, 5.0)),
        (unknown_during(SMOOTH, 400, 403), (0.0, 5.0)),  # a line will do
        (unknown_during(SMOOTH, 400, 560), (2.8, 5.0)),
        (unknown_during(unknown_during(SMOOTH, 280, 400), 700, 800), (2.0, 3.495)),
        (unknown_during(SMOOTH, 0, 200), (1.0, 5.0)),
        (unknown_during(SMOOTH, 900, 1001), (0.0, 4.495)),
        (unknown_during(SMOOTH, 998, 1001), (0.0, 5.0)),
        (unknown_during(SMOOTH, 100, 910), (0.0, 0.495)),  # longer than anything that was measured
        (unknown_during(np.zeros(1001), 400, 600), (0.0, 5.0)),  # a torque that nowhere changes does not there
        (np.full(1001, np.nan), (0.0, 5.0)),  # not measured: no recording of torques
    ],
)
def test_of_a_recording_whose_torque_is_unknown_for_too_long_a_part_is_used(
    torque: np.ndarray, part: tuple[float, float]
) -> None:
    whole = driven(torque)
    used = cleaned(HUB, whole)
    assert (used.time[0], used.time[-1]) == pytest.approx(part, abs=1e-9)
    assert np.array_equal(used.tau, torque[(whole.time >= used.time[0]) & (whole.time <= used.time[-1])][:, None], True)
    sentences = list(_driving_gap_warnings(HUB, whole, "beam.tau"))
    assert len(sentences) == (used is not whole)
    for sentence in sentences:
        assert sentence.startswith("beam.tau is unknown for too long")
        assert f"only t = {part[0]:.6g} to {part[1]:.6g} s are used" in sentence
    assert cleaned(HUB, replace(whole, input="motion")).time.size == 1001


@given(coefficients=st.tuples(*[st.floats(-1, 1)] * 4), count=st.integers(2, 300))
def test_a_cubic_motion_is_interpolated_exactly(coefficients: tuple[float, ...], count: int) -> None:
    angles = np.polynomial.Polynomial(coefficients)(np.linspace(-1, 1, 1001))
    assert _interpolation_errors(np.arange(1001) / 200.0, angles[:, None], 1 / 200, count)[0] < 1e-10


@pytest.mark.parametrize("count", [2, 10, 40])
def test_the_error_of_an_interpolated_motion_is_that_of_a_sinusoid(count: int) -> None:
    omega = 2 * np.pi * 1.3
    angles = np.sin(omega * np.arange(1001) / 200.0)
    half = omega * count / 400.0
    expected = abs(1 - (9 * np.cos(half) - np.cos(3 * half)) / 8) / np.sqrt(2)
    assert _interpolation_errors(np.arange(1001) / 200.0, angles[:, None], 1 / 200, count)[0] == pytest.approx(
        expected, rel=0.05
    )


def turned(theta: np.ndarray, rate: float = 200.0) -> Recording:
    """A recording of a joint that turns as its angles (T,) say."""
    return replace(driven(np.zeros(theta.size), rate), theta=theta[:, None], input="motion")


TURNING = 0.3 * np.sin(2 * np.pi * 0.8 * np.arange(1001) / 200.0)
ENCODER_NOISE = 1e-4 * np.random.default_rng(3).standard_normal(1001)


@pytest.mark.parametrize("noise", [0.0, 1.0, 30.0])
@pytest.mark.parametrize(
    ("begin", "end", "part"),
    [
        (400, 403, (0.0, 5.0)),
        (400, 560, (2.8, 5.0)),
        (600, 640, (0.0, 2.995)),
        (0, 200, (1.0, 5.0)),  # angles from before the encoder's first one are nowhere known
        (990, 1001, (0.0, 4.945)),
        (100, 910, (0.0, 0.495)),  # longer than anything that was measured
    ],
)
def test_of_a_recording_whose_motion_is_unknown_for_too_long_a_part_is_used(
    noise: float, begin: int, end: int, part: tuple[float, float]
) -> None:
    whole = turned(unknown_during(TURNING + noise * ENCODER_NOISE, begin, end))
    used = cleaned(HUB, whole)
    assert (used.time[0], used.time[-1]) == pytest.approx(part, abs=1e-9)
    sentences = list(_driving_gap_warnings(HUB, whole, "beam.theta"))
    assert len(sentences) == (used is not whole)
    for sentence in sentences:
        assert sentence.startswith("beam.theta is unknown for too long")
        assert f"only t = {part[0]:.6g} to {part[1]:.6g} s are used" in sentence
        assert "zeros" not in sentence
    by_torque = cleaned(HUB, replace(whole, input="torque"))
    assert by_torque.time.size == 1001  # an angle that was not measured is a missing value, no more


@pytest.mark.parametrize("seed", range(20))
def test_a_joint_that_rests_is_known_however_noisy_its_encoder(seed: int) -> None:
    noise = np.random.default_rng(seed).normal(0.0, 5e-3, 1001)
    assert cleaned(HUB, turned(unknown_during(noise, 400, 440))).time.size == 1001


def test_a_motion_that_is_nowhere_known_is_refused() -> None:
    theta = np.where(np.arange(1001) % 100 < 5, TURNING, np.nan)
    with pytest.raises(RecordingError, match="nowhere known"):
        cleaned(HUB, turned(theta))


def test_a_torque_that_is_known_for_too_short_a_time_is_not_used() -> None:
    whole = driven(unknown_during(SMOOTH, 5, 1001))
    used = cleaned(HUB, whole)
    assert used.time.size == 1001
    assert np.isnan(used.tau).all()
    (sentence,) = _driving_gap_warnings(HUB, whole, "beam.tau")
    assert "the recording is not used" in sentence


def test_gaps_are_told_in_long_recordings_and_uneven_ones() -> None:
    """Of a million rows a tenth may be missing; and most rows may come at once, with seconds between others."""
    random = np.random.default_rng(1)
    time = np.arange(1_000_000) / 500.0
    torque = np.where(random.random(time.size) < 0.1, np.nan, 0.01 * np.sin(time))
    began = perf_counter()
    _ = cleaned(HUB, driven(torque, 500.0))
    assert perf_counter() - began < 20
    uneven = np.cumsum(np.where(np.arange(4000) % 100 == 0, 2.0, 1e-9))
    recording = Recording(uneven, np.zeros((4000, 1, 2)), np.zeros(4000), np.sin(uneven), kind="driven")
    assert cleaned(HUB, recording).time.size == 100  # between two gaps


def test_the_part_with_most_frames_is_used() -> None:
    whole = driven(unknown_during(SMOOTH, 600, 700), first_frame=3.2)
    assert cleaned(HUB, whole).time[0] == pytest.approx(3.5)


@given(length=st.floats(1e-2, 1e2), mass=st.floats(1e-2, 1e2), duration=st.floats(1e-2, 1e2))
def test_the_part_that_is_used_is_the_same_at_any_scale(length: float, mass: float, duration: float) -> None:
    gapped = unknown_during(unknown_during(SMOOTH, 300, 305), 600, 615)
    link, inertia = HUB.links[0], mass * length**2
    scaled = replace(
        link,
        length=link.length * length,
        mass=link.mass * mass,
        markers=(length,),
        hub_inertia=link.hub_inertia * inertia,
    )
    rig = replace(HUB, links=(scaled,), marker_noise=NOISE * length)
    original, found = cleaned(HUB, driven(gapped)), cleaned(rig, driven(gapped * inertia / duration**2, 200 / duration))
    assert original.time.size == found.time.size < 1001


def recording(time: np.ndarray, tau: np.ndarray) -> Recording:
    markers = np.zeros((len(time), 1, 2))
    return Recording(time, markers, np.zeros_like(tau), tau, kind="driven", role="train", file="a.csv")


def test_torque_difference() -> None:
    torque = np.sin(TIME)[:, None]
    first = recording(TIME, torque)
    assert _torque_difference(first, first) == 0.0
    assert _torque_difference(first, recording(TIME + 1.0, torque)) == pytest.approx(0.0, abs=1e-9)
    assert _torque_difference(first, recording(TIME[:300], 1.2 * torque[:300])) == pytest.approx(0.2)
    assert _torque_difference(recording(TIME, 0.0 * torque), first) == np.inf
    assert _torque_difference(first, recording(TIME, np.full_like(torque, np.nan))) == 0.0


def frozen(table: np.ndarray, columns: list[str]) -> None:
    table[:, 1:] = np.where(np.isnan(table[:, 1:]), np.nan, np.nanmean(table[:, 1:], axis=0))


def millimetres(table: np.ndarray, columns: list[str]) -> None:
    table[:, [".m" in name for name in columns]] *= 1000.0


def occluded(table: np.ndarray, columns: list[str]) -> None:
    table[20:40, [".m" in name for name in columns]] = np.nan


def swapped(table: np.ndarray, columns: list[str]) -> None:
    first, second = columns.index("arm.m1.x"), columns.index("arm.m2.x")
    table[50:60, first : first + 4] = table[50:60, [second, second + 1, first, first + 1]]


def clipped(table: np.ndarray, columns: list[str]) -> None:
    column = columns.index("arm.m3.y")
    table[:, column] = np.minimum(table[:, column], 0.2)


def unseen(table: np.ndarray, columns: list[str]) -> None:
    table[:, columns.index("tip.m2.y")] = np.nan


def short_torque(table: np.ndarray, columns: list[str]) -> None:
    table[50:, columns.index("arm.tau")] = np.nan


def no_torque(table: np.ndarray, columns: list[str]) -> None:
    table[:, columns.index("arm.tau")] = 0.0


def other_torque(table: np.ndarray, columns: list[str]) -> None:
    table[:, columns.index("arm.tau")] *= 1.3


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("free", frozen, ["free.csv: nothing moves", "'decay'"]),
        ("free", millimetres, ["free.csv: a marker coordinate reaches", "1.5 m long", "millimetres"]),
        ("free", occluded, ["free.csv: 1 gap", "from t = 0.18 s"]),
        ("free", swapped, ["free.csv: in 5 frames", "exchanging arm.m1 and arm.m2"]),
        ("free", clipped, ["free.csv: arm.m3.y stays", "0.2 m"]),
        ("free", unseen, ["free.csv: no position of tip.m2"]),
        ("drive_1", short_torque, ["drive_1.csv: arm.tau is unknown for too long", "only t = 0 to 0.49 s are used"]),
        ("drive_1", no_torque, ["drive_1.csv: every torque is zero"]),
        ("drive_2", other_torque, ["drive_2.csv: it repeats drive_1.csv", "differ by 30 %"]),
    ],
)
def test_warnings_of_an_experiment(
    tmp_path: Path, name: str, change: Callable[[np.ndarray, list[str]], None], words: list[str]
) -> None:
    warnings = load_changed(tmp_path, name, change).warnings
    (sentence,) = (x for x in warnings if x.startswith(words[0]))
    assert all(word in sentence for word in words)
    assert len(warnings) == 1 + (change is no_torque)  # whose repeat, of course, has another torque


@pytest.mark.parametrize("kind", ["static", "quiet"])
def test_standing_still_is_right_for_some_kinds(tmp_path: Path, kind: str) -> None:
    toml = TOML.replace('kind = "decay"', f'kind = "{kind}"')
    assert load_changed(tmp_path, "free", frozen, toml).warnings == ()


def test_labels_that_contradict(tmp_path: Path) -> None:
    toml = TOML.replace('repeat = "drive"', 'repeat = "drive"\ncondition = "Reference"', 1)
    repeat, condition = load_experiment(write_experiment(tmp_path, toml)).warnings
    assert "drive_2.csv: it repeats drive_1.csv" in repeat
    assert "its condition is none and the other's is 'Reference'" in repeat
    assert "drive_1.csv: its condition 'Reference' is not 'reference'" in condition


def test_free_conditions(tmp_path: Path) -> None:
    for label in ("reference", "damaged"):
        toml = TOML.replace("gravity = [0, 0]", f'condition = "{label}"')
        experiment = load_experiment(write_experiment(tmp_path, toml))
        assert experiment.recordings[2].condition == label
        assert experiment.warnings == ()


def test_one_file_listed_twice(tmp_path: Path) -> None:
    toml = TOML + '[[recording]]\nfile = "free.csv"\nkind = "decay"\nrole = "train"\n'
    assert load_experiment(write_experiment(tmp_path, toml)).warnings == ("free.csv: listed 2 times",)


def test_marker_without_columns(tmp_path: Path) -> None:
    columns = [name for name in FREE if not name.startswith("arm.m2")]
    experiment = load_experiment(write_experiment(tmp_path, free=csv_text(columns, rows(columns))))
    assert experiment.warnings == ("free.csv: no position of arm.m2 in this recording",)
    assert np.isnan(experiment.recordings[2].markers[:, 1]).all()
    assert experiment.recordings[2].markers.shape == (ROWS, 5, 2)


def test_markers_in_millimetres_are_refused_once_they_are_used(tmp_path: Path) -> None:
    experiment = load_changed(tmp_path, "free", millimetres)
    assert len(experiment.warnings) == 1
    words = r"free\.csv: in no frame .* 'arm' .* rig's marker positions: .* 100[0-9] times .*; expected .* metres"
    with pytest.raises(RecordingError, match=words):
        _ = experiment.cleaned_recordings
    free = experiment.recordings[2]
    shrunk = replace(experiment, recordings=(replace(free, markers=0.02 * free.markers),))
    with pytest.raises(RecordingError, match=r"are 20.* times"):
        _ = shrunk.cleaned_recordings


@pytest.mark.parametrize("length", [0.03, 1.0, 30.0])
def test_what_is_left_out_does_not_depend_on_the_size_of_the_arm(length: float) -> None:
    link = Link("beam", "clamped", length, 1.0, 1.0, tuple(length * arc for arc in (0.2, 0.6, 1.0)))
    markers = np.tile(np.column_stack([link.markers, np.zeros(3)]), (20, 1, 1))
    markers[3, 2, 0] += 0.015 * length  # less than 4 % of the distances: a scale or a marker that is off
    markers[7, 2, 0] += 0.05 * length
    recording = Recording(np.arange(20) / 20, markers, kind="decay", file="decay.csv")
    left = cleaned(Rig("rig", (link,)), recording).markers
    assert np.flatnonzero(np.isnan(left).any(axis=(1, 2))).tolist() == [7]


CAMERAS = ["", "origin = [0.5, -0.3]\n", 'rotation = 0.4\norigin = [0.1, 0.2]\naxes = ["-y", "x"]\n']


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("unit", ["m", "mm"])
@pytest.mark.parametrize("marker", [1, 2, 3])
@pytest.mark.parametrize("lost", [np.s_[30:50], np.s_[:20], np.s_[20::4]])
def test_zeros_in_a_file_are_what_was_not_tracked_in_any_pose_of_the_camera(
    tmp_path: Path, camera: str, unit: str, marker: int, lost: slice
) -> None:
    def zeros(table: np.ndarray, columns: list[str]) -> None:
        table[:, [".m" in name for name in columns]] *= 1e3 if unit == "mm" else 1.0
        for axis in "xy":
            column = columns.index(f"arm.m{marker}.{axis}")
            table[lost, column] = np.where(np.isfinite(table[lost, column]), 0.0, np.nan)

    toml = f'{TOML}[camera]\n{camera}[units]\nlength = "{unit}"\n'
    experiment = load_changed(tmp_path, "drive_1", zeros, toml)
    seen = np.isfinite(experiment.recordings[0].markers[:, marker - 1]).all(axis=1)
    rows = seen & np.isin(np.arange(seen.size), np.arange(seen.size)[lost])
    (sentence,) = (text for text in experiment.warnings if "not tracked" in text)
    assert f"in {rows.sum()} frames" in sentence
    assert f"arm.m{marker} stand exactly where another marker or the zero of the coordinates is" in sentence
    found = untracked(experiment.rig, experiment.recordings[0], experiment.conventions.camera.origin)
    assert np.array_equal(found[:, marker - 1], rows)
    assert found.sum() == rows.sum()


@pytest.mark.parametrize("frame", ["base", "link"])
@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("share", [0.2, 1.0])
def test_zeros_of_a_single_marker_of_any_link_are_found(frame: str, index: int, share: float) -> None:
    links = tuple(Link(name, "revolute", 0.5, 0.1, 1.0, (0.5,), markers_frame=frame) for name in ("upper", "fore"))
    angle = np.sin(3.0 * TIME)
    upper = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    fore = 0.5 * np.stack([np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    markers = np.stack([upper, upper + fore if frame == "base" else fore], axis=1)
    origin = (0.3, -0.7)
    zero = origin if frame == "base" else (0.0, 0.0)
    markers[: round(share * TIME.size), index] = zero
    recording = Recording(TIME, markers, np.zeros((TIME.size, 2)), kind="decay", file="decay.csv")
    found = untracked(Rig("rig", links), recording, origin)
    assert np.array_equal(found, (markers == zero).all(axis=2))
    assert found[:, index].mean() == share


@pytest.mark.parametrize("rounding", [1e-6, 1e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("amplitude", [0.0, 6e-3, 0.02, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_a_marker_that_comes_to_the_camera_s_zero_by_its_motion_was_tracked(
    rounding: float, amplitude: float, seed: int
) -> None:
    """The camera's origin is often put where a marker rests."""
    swing = amplitude * np.sin(12.0 * TIME) * np.exp(-TIME)
    places = np.stack([-0.5 * swing**2, swing], axis=-1)
    places += np.random.default_rng(seed).normal(0.0, NOISE, places.shape)
    places = np.round(places / rounding) * rounding
    at_zero = (places == 0.0).all(axis=1)
    assert not _leaps(TIME, places, at_zero, NOISE, resting=amplitude == 0.0)[at_zero].any()
    link = Link("beam", "clamped", 1.0, 0.4, 1.0, (1.0,))
    recording = Recording(TIME, places[:, None] + (1.0, 0.0), kind="quiet" if amplitude == 0.0 else "decay", file="a")
    assert not untracked(Rig("rig", (link,), marker_noise=NOISE), recording, (1.0, 0.0)).any()


def test_a_marker_that_is_nowhere_but_at_the_camera_s_zero_rests_there_or_was_not_tracked() -> None:
    link = Link("beam", "clamped", 1.0, 0.4, 1.0, (1.0,))
    for kind, lost in (("quiet", False), ("static", False), ("decay", True)):
        still = Recording(TIME, np.full((TIME.size, 1, 2), (1.0, 0.0)), kind=kind, file="a.csv")
        assert untracked(Rig("rig", (link,)), still, (1.0, 0.0)).all() == lost
        assert untracked(Rig("rig", (link,)), still, (1.0, 0.0)).any() == lost
        at_base = replace(still, markers=0 * still.markers)
        assert untracked(Rig("rig", (link,)), at_base, (0.0, 0.0)).all()  # where no marker is
