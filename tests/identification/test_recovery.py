"""What is put in comes out: noise-free chains, the demo's beam, the hub-driven rig, the silicone beam."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.simulation.setups import rollout
from vjm.chain.curve import marker_poses
from vjm.chain.layout import layout, layout_of_lengths, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import ChoiceError, InsufficientDataError, ShapeError
from vjm.experiment.load import load_experiment
from vjm.identification import Identification, identify
from vjm.identification.parameters import Parametrisation
from vjm.identification.torque_method import fit_torque
from vjm.identification.training_data import TrainingData
from vjm.records import Experiment, Link, Recording, Rig

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared" / "data"
DEMO = ROOT / "vjm" / "demo" / "experiment.toml"
TRUTH = json.loads((ROOT / "tests" / "fine_beam" / "demo_truth.json").read_text())


@cache
def demo() -> Experiment:
    return load_experiment(DEMO)


@cache
def demo_fit(method: str, parameters: str) -> Identification:
    """The fit without its replays' cost: only the training recordings."""
    experiment = demo()
    kept = tuple(r for r in experiment.recordings if r.kind == "decay" and r.role == "train")
    return identify(replace(experiment, recordings=kept), method, parameters=parameters, baselines=False)


def chain_recordings(joint: str, n: int, seed: int, free: bool = False) -> tuple[Experiment, Chain]:
    """Noise-free recordings of a chain with uneven K and D; the rig file's stiffness is wrong by a factor of two."""
    rng = np.random.default_rng(seed)
    arcs = tuple((np.arange(1, n + 1) / n).tolist())
    hub = 0.02 if joint == "revolute" else 0.0
    link = Link("beam", joint, 1.0, 0.44, 1.9, arcs, hub_inertia=hub, virtual_joints=n)  # type: ignore[arg-type]
    even = uniform_chain(link, layout_of_lengths(layout(1.0, n).lengths, "free") if free else layout(1.0, n))
    stiffness = even.stiffness * rng.uniform(0.7, 1.3, n)
    truth = Chain("rig", (replace(even, stiffness=stiffness, damping=stiffness * rng.uniform(2e-3, 4e-3, n)),))
    time = np.arange(900) / 600.0
    active = truth.active.size
    waves = np.sin(2 * np.pi * np.outer(time, [0.7, 1.9, 4.3, 7.7]) + rng.uniform(0, 6, 4)).sum(axis=1)
    recordings = []
    for k in range(2):
        empty = Recording(
            time,
            np.zeros((time.size, n, 2)),
            np.zeros((time.size, active)),
            0.1 * np.repeat(waves[:, None], active, axis=1),
            kind="driven" if active else "decay",
            role="train",
            file=f"r{k}.csv",
        )
        start = np.zeros((1, truth.size))
        start[0, truth.passive] = 0.05 * rng.normal(size=n)
        q = rollout([truth], empty, start, 0 * start, step=2.5e-4)[0][:, 0]
        markers = marker_poses(truth, q, (np.array(arcs),), (False,))[0]
        recordings.append(replace(empty, theta=q[:, truth.active], markers=markers))
    rig = Rig("rig", (replace(link, bending_stiffness=2 * 1.9, hub_inertia=2 * hub),), marker_noise=1e-9)
    return Experiment(rig, tuple(recordings)), truth


@pytest.mark.parametrize(("joint", "n"), [("clamped", 1), ("clamped", 2), ("revolute", 2)])
@pytest.mark.parametrize("seed", [0, 1])
def test_noise_free_chain_gives_its_stiffness_and_damping_from_a_far_start(joint: str, n: int, seed: int) -> None:
    experiment, truth = chain_recordings(joint, n, seed)
    fit = fit_torque(TrainingData.of(experiment, "joints"), "joints")
    problem = fit.problem
    found, true = problem.parametrisation.chain(fit.x).links[0], truth.links[0]
    assert fit.converged
    assert found.stiffness == pytest.approx(true.stiffness, rel=1e-3)
    assert found.damping == pytest.approx(true.damping, rel=1e-3)
    assert found.hub_inertia == pytest.approx(true.hub_inertia, rel=1e-3)
    # J at the found parameters is never above J at the true ones
    at_truth = Parametrisation(truth, "joints", problem.parametrisation.hubs)
    x = at_truth.start * [at_truth.scale(c) for c in at_truth.coordinates]
    x = x / [problem.parametrisation.scale(c) for c in problem.parametrisation.coordinates]
    assert problem.parametrisation.chain(x).links[0].stiffness == pytest.approx(true.stiffness)
    found_j, true_j = (float(np.sum(problem.vector(point) ** 2)) for point in (fit.x, x))
    assert found_j <= true_j


@pytest.mark.parametrize(("method", "first", "second"), [("torque", 0.01, 0.05), ("torque+frequency", 0.002, 0.01)])
@pytest.mark.parametrize("parameters", ["uniform", "joints", pytest.param("lengths", marks=pytest.mark.slow)])
def test_demo_frequencies(method: str, parameters: str, first: float, second: float) -> None:
    fit = demo_fit(method, parameters)
    f1, f2 = TRUTH["euler_bernoulli"]["frequencies_hz"][:2]
    assert fit.status == "converged"
    assert fit.modes[0].frequency_model == pytest.approx(f1, rel=first)
    assert fit.modes[1].frequency_model == pytest.approx(f2, rel=second)
    assert fit.modes[0].frequency_measured == pytest.approx(f1, rel=1e-3)
    assert fit.modes[1].frequency_measured == pytest.approx(f2, rel=2e-3)


@pytest.mark.slow
def test_demo_with_every_parameter_free() -> None:
    fit = demo_fit("torque", "full")
    f1, f2 = TRUTH["euler_bernoulli"]["frequencies_hz"][:2]
    assert [mode.frequency_model for mode in fit.modes[:2]] == pytest.approx([f1, f2], rel=0.01)
    link = fit.model.chain.links[0]
    assert link.lengths.sum() == pytest.approx(1.0)
    assert link.masses.sum() == pytest.approx(0.44)
    # what moves the arm too little to be seen is said so, not sold as known
    assert any(not estimate.identifiable and estimate.reason for estimate in fit.parameters)


def test_demo_stiffness_is_within_its_standard_error() -> None:
    stiffness, time = demo_fit("torque", "uniform").parameters
    assert abs(stiffness.value - TRUTH["bending_stiffness"]) < 4 * (stiffness.std or 0)
    assert stiffness.std is not None
    assert stiffness.std < 0.005 * stiffness.value
    assert time.value == pytest.approx(TRUTH["kelvin_voigt_time"], rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_standard_errors_hold_for_fresh_noise(seed: int) -> None:
    """The same beam under other noise: estimates scatter as their standard errors say (smoke test of the scale)."""
    rng = np.random.default_rng(seed)
    experiment = demo()
    kept = []
    for recording in experiment.recordings:
        if recording.kind == "decay" and recording.role == "train":
            kept.append(replace(recording, markers=recording.markers + 3e-4 * rng.normal(size=recording.markers.shape)))
    noisier = Experiment(replace(experiment.rig, marker_noise=3e-4 * np.sqrt(2)), tuple(kept))
    fit = fit_torque(TrainingData.of(noisier))
    found = fit.problem.parametrisation.physical(fit.x)[0]
    assert found == pytest.approx(TRUTH["bending_stiffness"], rel=0.006)


def test_evaluate_agrees_with_the_search() -> None:
    fit = fit_torque(TrainingData.of(demo()))
    again = fit.problem.evaluate(fit.x)
    assert fit.jacobian == pytest.approx(again.jacobian, rel=1e-3, abs=1e-3 * np.abs(again.jacobian).max())


@pytest.mark.parametrize("kind", ["uniform", "joints"])
def test_errors_that_are_linear_are_those_of_the_chain(kind: str) -> None:
    data = TrainingData.of(demo(), kind)
    fit = fit_torque(data)
    problem = fit.problem if kind == "uniform" else fit.refined(kind)
    x = problem.parametrisation.start * np.random.default_rng(0).uniform(0.5, 2.0, len(problem.parametrisation.start))
    direct = data.weighted_errors(problem.parametrisation.chain(x))
    for found, expected in zip(problem.torque_residuals(x), direct, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_errors_name_what_is_wrong() -> None:
    experiment = demo()
    with pytest.raises(ChoiceError, match="torque"):
        identify(experiment, "guess")
    with pytest.raises(ChoiceError, match="lengths"):
        identify(experiment, parameters="all")
    with pytest.raises(ChoiceError, match="smoothing"):
        identify(experiment, derivatives="finite differences")
    for joints in (0, True, "3", 2.5):
        with pytest.raises(ShapeError, match=f"virtual_joints: got {joints!r}; expected a whole number"):
            identify(experiment, virtual_joints=joints)  # type: ignore[arg-type]
    quiet = tuple(r for r in experiment.recordings if r.kind == "quiet")
    with pytest.raises(InsufficientDataError, match="driven"):
        identify(replace(experiment, recordings=quiet))


@pytest.mark.skipif(not (SHARED / "hub_rig").exists(), reason="the shared recordings are absent")
def test_hub_rig_is_followed_to_its_noise_on_held_out_recordings() -> None:
    experiment = load_experiment(SHARED / "hub_rig" / "experiment.toml")
    kept = tuple(r for r in experiment.recordings if r.file in {"drive_small_1.csv", "drive_large.csv", "slew.csv"})
    fit = identify(replace(experiment, recordings=kept), baselines=False)
    held_out = next(one for one in fit.recordings if one.recording.role == "holdout")
    assert held_out.simulated is not None
    assert held_out.simulated.marker_rms < 1.1 * 3e-4
    assert {e.name for e in fit.parameters if e.identifiable} == {
        "beam.bending_stiffness",
        "beam.kelvin_voigt_time",
        "beam.hub_inertia",
    }


@pytest.mark.skipif(not (SHARED / "silicone_beam").exists(), reason="the shared recordings are absent")
def test_silicone_beam_shows_one_mode_and_says_so() -> None:
    experiment = load_experiment(SHARED / "silicone_beam" / "experiment.toml")
    unloaded = tuple(r for r in experiment.recordings if r.condition == "reference")
    fit = identify(replace(experiment, recordings=unloaded), "torque+frequency", baselines=False)
    assert any("1 shape function," in text for text in (*fit.notes, *fit.warnings))
    assert fit.model.chain.links[0].virtual_joints <= 3
    assert fit.modes[0].frequency_measured == pytest.approx(7.74, abs=0.03)
    assert fit.modes[0].frequency_model == pytest.approx(7.74, rel=0.01)
    assert [data.recording.file for data in fit.torque_data] == ["unloaded_a.csv"]
