"""Recordings as they come: each fault gives a clear error or a clear warning, and never a silent wrong result."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

import vjm
from tests.fine_beam import Camera
from tests.fine_beam.make_hub import TRUTH, write_hub_experiment
from tests.identification.test_recovery import DEMO
from vjm.errors import InsufficientDataError
from vjm.experiment.checks import _impossible, cleaned
from vjm.identification import Identification, comparison, identify
from vjm.identification.check import fit_warnings
from vjm.identification.comparison import replay_without_outliers
from vjm.identification.records import Whiteness
from vjm.identification.torque_method import fit_torque
from vjm.identification.training_data import TrainingData
from vjm.identification.trajectory_fit import DIVERGED_MISFIT
from vjm.identification.trajectory_method import _first_step_multiple, _StallRule, first_fit
from vjm.model.modes import modes
from vjm.records import Experiment, Link

Array = NDArray[np.float64]
Change = Callable[[pd.DataFrame], pd.DataFrame]
NOISE = 3e-4


@pytest.fixture(scope="module")
def hub_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hub")
    write_hub_experiment(folder, 1)
    return folder


def fit_changed(hub_folder: Path, tmp_path: Path, change: Change, file: str = "drive_large.csv") -> Identification:
    """The fit of the experiment with one of its files changed."""
    folder = tmp_path / "changed"
    shutil.copytree(hub_folder, folder)
    table = pd.read_csv(folder / file)
    change(table).to_csv(folder / file, index=False)
    return identify(vjm.load_experiment(folder / "experiment.toml"), virtual_joints=4, baselines=False)


def assert_sane(fit: Identification, within: float = 2e-3) -> None:
    assert fit.status == "converged"
    assert fit.parameters[0].value == pytest.approx(TRUTH.bending_stiffness, rel=within)
    held_out = next(one for one in fit.recordings if one.recording.role == "holdout")
    assert held_out.simulated is not None
    assert held_out.simulated.marker_rms < 1.1 * NOISE


def test_one_outlier_of_a_metre(hub_folder: Path, tmp_path: Path) -> None:
    def change(table: pd.DataFrame) -> pd.DataFrame:
        row = table["beam.m3.x"].first_valid_index() + 5 * 200
        table.loc[row, "beam.m3.y"] += 1.0
        return table

    fit = fit_changed(hub_folder, tmp_path, change)
    assert_sane(fit)
    assert any("farther apart" in text for text in fit.warnings)
    assert any("left out" in text for text in fit.warnings)


def test_labels_swapped_for_a_fifth_of_a_second(hub_folder: Path, tmp_path: Path) -> None:
    def change(table: pd.DataFrame) -> pd.DataFrame:
        rows = (table["t"] >= 2.0) & (table["t"] < 2.2)
        for axis in "xy":
            one, other = f"beam.m2.{axis}", f"beam.m4.{axis}"
            table.loc[rows, [one, other]] = table.loc[rows, [other, one]].to_numpy()
        return table

    fit = fit_changed(hub_folder, tmp_path, change)
    assert_sane(fit)
    assert any("swapped" in text for text in fit.warnings)


def test_a_coordinate_that_clips(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    shutil.copytree(DEMO.parent, folder)
    table = pd.read_csv(folder / "first_mode.csv")
    table["beam.m5.y"] = table["beam.m5.y"].clip(upper=0.6 * table["beam.m5.y"].max())
    table.to_csv(folder / "first_mode.csv", index=False)
    fit = identify(vjm.load_experiment(folder / "experiment.toml"), virtual_joints=4, baselines=False)
    assert fit.parameters[0].value == pytest.approx(1.9736, rel=1e-3)
    assert any("clipped" in text for text in fit.warnings)
    assert any("left out" in text for text in fit.warnings)
    assert all(one.simulated is not None and one.simulated.marker_rms < 1.1 * NOISE for one in fit.recordings)


def test_a_clip_that_lasts_to_the_end_is_seen_as_a_misfit(hub_folder: Path, tmp_path: Path) -> None:
    """An arm that comes to rest looks the same; the model that fits everything else does not."""

    def change(table: pd.DataFrame) -> pd.DataFrame:
        table["beam.m5.y"] = table["beam.m5.y"].clip(upper=0.8 * table["beam.m5.y"].max())
        return table

    fit = fit_changed(hub_folder, tmp_path, change)
    assert any("drive_large.csv" in text and "unmodelled dynamics" in text for text in fit.warnings)


def test_every_second_frame_lost(hub_folder: Path, tmp_path: Path) -> None:
    def change(table: pd.DataFrame) -> pd.DataFrame:
        frames = table.index[table["beam.m1.x"].notna()]
        table.loc[frames[1::2], [c for c in table.columns if ".m" in c]] = np.nan
        return table

    assert_sane(fit_changed(hub_folder, tmp_path, change))


def test_a_camera_of_five_frames_a_second(tmp_path: Path) -> None:
    """Too slow for the second mode; what moves the arm is known, so its frames say enough."""
    experiment = vjm.load_experiment(write_hub_experiment(tmp_path, 1, Camera(5.0, NOISE)))
    fit = identify(experiment, virtual_joints=4, baselines=False)
    assert_sane(fit, within=5e-3)
    assert any("frames/s" in text or "rate" in text for text in fit.warnings)


def test_occluded_markers_and_dropped_frames_are_ordinary(tmp_path: Path) -> None:
    camera = Camera(100.0, NOISE, dropped_frames=0.1, occluded=0.2)
    fit = identify(vjm.load_experiment(write_hub_experiment(tmp_path, 2, camera)), virtual_joints=4, baselines=False)
    assert_sane(fit)


def test_torque_missing_in_one_recording(hub_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(vjm.InputError, match=r"drive_large\.csv.*beam\.tau"):
        fit_changed(hub_folder, tmp_path, lambda table: table.drop(columns="beam.tau"))
    experiment = vjm.load_experiment(hub_folder / "experiment.toml")
    silent = tuple(
        replace(r, kind="decay", tau=np.full_like(r.tau, np.nan)) if r.file == "drive_large.csv" else r
        for r in experiment.recordings
    )
    fit = identify(replace(experiment, recordings=silent), virtual_joints=4, baselines=False)
    assert_sane(fit, within=5e-3)
    assert any("drive_large.csv" in text and "torque" in text for text in fit.warnings)


def test_torque_missing_everywhere(hub_folder: Path) -> None:
    experiment = vjm.load_experiment(hub_folder / "experiment.toml")
    silent = tuple(replace(r, kind="decay", tau=np.full_like(r.tau, np.nan)) for r in experiment.recordings)
    with pytest.raises(InsufficientDataError, match="method 'torque'"):
        identify(replace(experiment, recordings=silent))


def test_a_recording_in_which_nothing_moves(hub_folder: Path) -> None:
    experiment = vjm.load_experiment(hub_folder / "experiment.toml")
    still = []
    for recording in experiment.recordings:
        rng = np.random.default_rng(3)
        where = np.where(np.isfinite(recording.markers), 1.0, np.nan)
        arcs = np.stack([np.linspace(0.2, 1.0, 5), np.zeros(5)], axis=-1)
        markers = where * (arcs + NOISE * rng.standard_normal(recording.markers.shape))
        theta = np.where(np.isfinite(recording.theta), 1e-4 * rng.standard_normal(recording.theta.shape), np.nan)
        still.append(replace(recording, markers=markers, theta=theta, tau=0 * recording.tau))
    mixed = (still[0], *experiment.recordings[1:])
    assert_sane(identify(replace(experiment, recordings=mixed), virtual_joints=4, baselines=False))
    with pytest.raises(InsufficientDataError, match="noise"):
        identify(replace(experiment, recordings=tuple(still)))


def test_repeats_that_are_none(hub_folder: Path) -> None:
    experiment = vjm.load_experiment(hub_folder / "experiment.toml")
    labelled = tuple(replace(r, repeat="drive") if r.role == "train" else r for r in experiment.recordings)
    fit = identify(replace(experiment, recordings=labelled), virtual_joints=4, baselines=False)
    (text,) = (each for each in fit.warnings if "are labelled repeats" in each)
    assert "drive_small.csv and drive_large.csv" in text
    twice = (replace(labelled[1], file="again.csv"), *labelled[1:])
    fit = identify(replace(experiment, recordings=twice), virtual_joints=4, baselines=False)
    assert not any("are labelled repeats" in each for each in fit.warnings)


def softened(link: Link, factor: float) -> Link:
    assert link.youngs_modulus is not None
    return replace(link, bending_stiffness=None, youngs_modulus=factor * link.youngs_modulus)


def test_a_wrong_nominal_stiffness_does_not_matter() -> None:
    """Half and twice the stiffness, where no torque tells it: the frequencies do."""
    experiment = vjm.load_experiment(DEMO)
    for factor in (0.5, 2.0):
        (link,) = experiment.rig.links
        rig = replace(experiment.rig, links=(softened(link, factor),))
        fit = identify(replace(experiment, rig=rig), virtual_joints=4, baselines=False)
        assert fit.parameters[0].value == pytest.approx(1.9736, rel=1e-3)


def test_without_torque_errors_other_stiffnesses_are_tried() -> None:
    """No frame shows all of the link, so the torque method has nothing to start from."""
    experiment = vjm.load_experiment(DEMO)
    (link,) = experiment.rig.links
    rig = replace(experiment.rig, links=(softened(link, 0.6),))
    halves = []
    for recording in experiment.recordings:
        markers = recording.markers.copy()
        markers[::2, :4] = np.nan
        markers[1::2, [0, 1, 2, 4]] = np.nan
        halves.append(replace(recording, markers=markers))
    fit = identify(replace(experiment, rig=rig, recordings=tuple(halves)), virtual_joints=4, baselines=False)
    assert fit.parameters[0].value == pytest.approx(1.9736, rel=1e-3)


def column(load: float, nominal_load: float) -> Experiment:
    """Return swings of an upright clamped beam under loads q l^3 / EI, of which it carries 7.63 with four joints."""
    weight = 0.4 * 9.81
    link = Link("column", "clamped", 1.0, 0.4, bending_stiffness=weight / load, markers=(0.25, 0.5, 0.75, 1.0))
    rig = vjm.Rig("upright", [link], gravity=(-9.81, 0.0))
    truth, rng = vjm.Model.nominal(rig, 4, 4e-3), np.random.default_rng(1)
    recordings = []
    for role, angle in (("train", 0.03), ("holdout", 0.02)):
        motion = truth.simulate(torque=np.zeros((151, 0)), duration=3.0, initial=[[angle] * 4, [0.0] * 4])
        markers = motion.markers + NOISE * rng.standard_normal(motion.markers.shape)
        recordings.append(vjm.Recording(motion.time, markers, motion.theta, kind="decay", role=role))
    nominal = replace(link, bending_stiffness=weight / nominal_load)
    return Experiment(replace(rig, links=(nominal,)), tuple(recordings))


def test_a_column_is_identified_whose_nominal_one_buckles() -> None:
    fit = identify(column(6.0, 8.4), virtual_joints=4, baselines=False)
    assert fit.status == "converged"
    assert fit.parameters[0].value == pytest.approx(0.4 * 9.81 / 6.0, rel=1e-3)


def test_a_column_is_identified_of_which_nothing_is_known_but_a_nominal_one_that_buckles() -> None:
    experiment, hidden = column(6.0, 8.4), []
    for recording in experiment.recordings:  # no frame shows all of it: the torque method has nothing to start from
        markers = recording.markers.copy()
        markers[::2, :3] = np.nan
        markers[1::2, [0, 1, 3]] = np.nan
        hidden.append(replace(recording, markers=markers))
    fit = identify(replace(experiment, recordings=tuple(hidden)), virtual_joints=4, baselines=False)
    assert fit.parameters[0].value == pytest.approx(0.4 * 9.81 / 6.0, rel=1e-3)


def test_starts_that_buckle_are_passed_over() -> None:
    """Here the torque method's: a column almost at its limit, and noise."""
    data = TrainingData.of(column(7.625, 6.0), virtual_joints=4)
    torque = fit_torque(data)
    with pytest.raises(InsufficientDataError, match="position of rest"):
        modes(torque.chain)
    _, fit = first_fit(data)
    assert fit.misfit < DIVERGED_MISFIT
    assert _first_step_multiple(fit.point.problem, torque.x) == 1.0


def test_of_exact_recordings_nothing_is_said_to_be_missing() -> None:
    """Simulated with the package itself, without any noise: a first thing to try."""
    rig = vjm.Rig("exact", [vjm.Link("beam", "revolute", 1.0, 0.44, 1.9, (0.25, 0.5, 0.75, 1.0), hub_inertia=0.02)])
    truth = vjm.Model.nominal(replace(rig, links=(replace(rig.links[0], bending_stiffness=1.976),)), 3, 2e-3)
    time = np.linspace(0, 2, 101)
    recordings = []
    for role, torque in (("train", 0.2 * np.sin(7 * time) * time), ("holdout", 0.2 * np.sin(7 * time + 1))):
        motion = truth.simulate(torque=torque, duration=2.0)
        recordings.append(vjm.Recording(motion.time, motion.markers, motion.theta, torque, kind="driven", role=role))
    fit = vjm.identify(vjm.Experiment(rig, recordings), virtual_joints=3, baselines=False)
    assert fit.parameters[0].value == pytest.approx(1.976, rel=1e-6)
    assert "to within camera noise" in " ".join(fit.summary().split())
    assert not any("unmodelled" in warning or "residual" in warning for warning in fit.warnings)


def test_residuals_that_are_too_large_and_white_are_no_missing_dynamics() -> None:
    noisy, moving = Whiteness("a.csv", 4.0, 0.03, False, True), Whiteness("b.csv", 4.0, 0.5, True, True)
    assert fit_warnings((), whiteness=[replace(noisy, mean_square=2.0)]) == []  # 1.4 times the noise
    (warning,) = fit_warnings((), whiteness=[noisy])
    assert "white noise, but larger" in warning
    assert "a.csv (2.00 × noise)" in warning
    (warning,) = fit_warnings((), whiteness=[moving])
    assert "unmodelled dynamics" in warning


def test_a_search_without_outliers_begins_where_the_one_with_them_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    starts: list[object] = []

    def replay(observed: object, states: object) -> list[object]:
        starts.append(states)
        return [(SimpleNamespace(state="found"), True)]

    monkeypatch.setattr(comparison, "trimmed", lambda run: SimpleNamespace())
    for given, then in ((None, "found"), ("given", "given")):
        starts.clear()
        replay_without_outliers(replay, [SimpleNamespace()], [given])  # type: ignore[arg-type,list-item]
        assert starts == [[given], [then]]


# What is left out before anything is fitted


LINK = Link("beam", "clamped", 1.0, 0.4, bending_stiffness=2.0, markers=(0.2, 0.4, 0.6, 0.8, 1.0))


def straight(frames: int) -> Array:
    arcs = np.stack([np.linspace(0.2, 1.0, 5), np.zeros(5)], axis=-1)
    return np.repeat(arcs[None], frames, axis=0)


def test_a_single_culprit_goes_alone() -> None:
    markers = straight(3)
    markers[1, 2, 1] = 1.0
    wrong = _impossible(markers, LINK, NOISE)
    assert np.argwhere(wrong).tolist() == [[1, 2]]


def test_where_no_single_marker_explains_it_all_go() -> None:
    markers = straight(3)
    markers[1, [1, 3]] = markers[1, [3, 1]]
    wrong = _impossible(markers, LINK, NOISE)
    assert wrong[1].all()
    assert not wrong[[0, 2]].any()


def test_what_is_right_stays_the_same_object() -> None:
    experiment = vjm.load_experiment(DEMO)
    for recording in experiment.recordings:
        assert cleaned(experiment.rig, recording) is recording


def test_a_search_that_ends_far_from_the_recordings_is_no_crawl() -> None:
    """A model that lacks a mass on the tip has its minimum at twenty times the noise; that is where the search ends."""
    for costs, predicted, stopped in (
        ([100.0, 20.2, 20.03, 20.01, 20.004, 20.001, 20.0], 1e-3, False),  # refines a minimum
        ([100.0, 95.0, 91.0, 88.0, 85.0, 83.0, 81.0], 2.0, True),  # crawls
        ([100.0, 99.0, 99.0, 99.0, 99.0, 99.0, 99.0], 1e-3, True),  # damped steps, each rejected, promise little
        ([100.0, 60.0, 36.0, 22.0, 13.0, 8.0, 5.0], 2.0, False),  # gets there
    ):
        rule, points = _StallRule(), [SimpleNamespace(cost=cost, count=9, misfit=20.0) for cost in costs]
        assert any(rule(point, predicted) for point in points) is stopped, costs  # type: ignore[arg-type]
