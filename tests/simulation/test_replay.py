"""SimulatedRecording: the initial state, and nothing else, from a recording."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh

import vjm
from tests.fine_beam.make_demo import TRUTH_FILE
from tests.simulation.integrators import simulate
from tests.simulation.setups import (
    DOWN,
    arm_of,
    end_load_shape,
    jerky_torque,
    recording_of,
    rig_of,
    rollout,
    steel_link,
)
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.load import load_experiment
from vjm.model.modes import linearise
from vjm.records import Experiment, Recording, Rig, SimulatedRecording
from vjm.simulation import initial_state
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import MarkerArcs, Observations
from vjm.simulation.run import InitialStatePrior, simulate_runs

Array = NDArray[np.float64]
NOISE = 3e-4
ENCODER_NOISE = 1e-4
DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"


def replay(arm: Arm, rig: Rig, recording: Recording, marker_noise: float, encoder_noise: float) -> SimulatedRecording:
    observed = Observations.of(rig, recording, (marker_noise, encoder_noise))
    ((run, converged),) = fit_initial_states([arm], [observed])
    return run.simulated_recording(converged)


def residuals(simulated: SimulatedRecording) -> Array:
    """All measured values less the simulated ones, over their noise."""
    parts = simulated.marker_residual, simulated.theta_residual
    weighted = np.concatenate([part.ravel() / size for part, size in zip(parts, simulated.noise, strict=True)])
    return np.asarray(weighted[np.isfinite(weighted)])


def chi2_of(simulated: SimulatedRecording) -> float:
    return float(np.sum(residuals(simulated) ** 2))


def seen(chain: Chain, recording: Recording, q: Array, v: Array, noise: float = 0.0, seed: int = 0) -> Recording:
    """What a camera and the encoders record of the chain's own motion."""
    path = simulate(chain, rig_of(chain), recording, q, v)
    rng = np.random.default_rng(seed)
    return replace(
        recording,
        markers=path.markers + noise * rng.standard_normal(path.markers.shape),
        theta=path.theta + noise / NOISE * ENCODER_NOISE * rng.standard_normal(path.theta.shape),
    )


def fit_open_loop(n: int = 4, rate: float = 30.0, seconds: float = 4.0) -> tuple[Chain, Recording, Array, Array]:
    chain = arm_of(steel_link(n))
    recording = recording_of(chain, np.arange(round(rate * seconds) + 1) / rate)
    rng = np.random.default_rng(n)
    return chain, recording, end_load_shape(chain, 0.1) + rng.normal(0, 5e-3, n), rng.normal(0, 0.1, n)


def found_state(chain: Chain, recording: Recording) -> tuple[Array, Array, SimulatedRecording]:
    result = replay(Arm(chain), rig_of(chain), recording, NOISE, ENCODER_NOISE)
    assert result.status == "converged"
    return result.simulation.q[0], result.simulation.v[0], result


# Without noise


@pytest.mark.parametrize("n", [1, 3, 4])
def test_a_released_link_s_state_is_recovered(n: int) -> None:
    """From rest and far away, first-mode swings of 0.1 m included."""
    chain, recording, q, v = fit_open_loop(n)
    q_found, _, result = found_state(chain, seen(chain, recording, q, v))
    np.testing.assert_allclose(q_found, q, atol=2e-3)
    assert result.marker_rms < 0.02 * NOISE
    assert result.theta_rms is None
    assert residuals(result).size == 2 * 5 * recording.time.size


@pytest.mark.parametrize("gravity", [(0.0, 0.0), DOWN], ids=str)
def test_a_driven_link_s_state_is_recovered(gravity: tuple[float, float]) -> None:
    chain = replace(arm_of(steel_link(3, "revolute")), gravity=gravity)
    recording = recording_of(chain, np.arange(301) / 100.0, jerky_torque(1, 1), 0.05, gravity)
    q, v = np.array([-1.3, 0.05, 0.02, -0.01]), np.array([0.4, 0.1, -0.3, 0.2])
    q_found, v_found, result = found_state(chain, seen(chain, recording, q, v))
    np.testing.assert_allclose(q_found, q, atol=1e-3)
    assert v_found[0] == pytest.approx(v[0], abs=0.05)
    assert result.marker_rms < 0.02 * NOISE
    assert result.theta_rms is not None
    assert result.theta_rms < 0.05 * ENCODER_NOISE
    assert residuals(result).size == 301 * 11


# With noise


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_residuals_are_the_noise_and_no_more(seed: int) -> None:
    """chi^2 falls short of the number of values by about the number of states."""
    chain, recording, q, v = fit_open_loop()
    _, _, result = found_state(chain, seen(chain, recording, q, v, NOISE, seed))
    spread = np.sqrt(2 * residuals(result).size)
    assert chi2_of(result) == pytest.approx(residuals(result).size - 2 * chain.size, abs=4 * spread)
    true = seen(chain, recording, q, v)
    noisy = seen(chain, recording, q, v, NOISE, seed)
    assert chi2_of(result) <= np.sum(((noisy.markers - true.markers) / NOISE) ** 2) + 1.0


@pytest.mark.parametrize("seed", [4, 5])
def test_no_neighbouring_state_fits_better(seed: int) -> None:
    chain, recording, q, v = fit_open_loop()
    noisy = seen(chain, recording, q, v, NOISE, seed)
    q_found, v_found, result = found_state(chain, noisy)

    state = np.concatenate([q_found, v_found])
    scale = np.r_[np.full(chain.size, 1e-3), np.full(chain.size, 2e-2)]
    steps = np.vstack([np.diag(scale), scale * np.random.default_rng(seed).normal(size=(6, state.size))])
    states = state + np.vstack([0 * state, steps, -steps])
    paths, _ = rollout([chain] * len(states), noisy, *np.hsplit(states, 2))
    markers = MarkerArcs.of(rig_of(chain)).positions(chain, paths)
    chi2 = np.sum(((noisy.markers[:, None] - markers) / NOISE) ** 2, axis=(0, 2, 3))
    assert chi2[0] == pytest.approx(chi2_of(result), rel=1e-9)
    assert (chi2[1:] > chi2[0]).all()
    ahead, behind = np.split(chi2[1:], 2)
    to_gain = (ahead - behind) ** 2 / (8 * (ahead + behind - 2 * chi2[0]))  # at the parabola's bottom
    assert (to_gain < 0.1).all()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_few_steps_lead_from_the_state_of_a_similar_model(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """To the state that a search from rest finds, in no more simulations than are allowed."""
    chain, recording, q, v = fit_open_loop()
    noisy = seen(chain, recording, q, v, NOISE, seed)
    model = vjm.Model(chain, rig_of(chain), NOISE, ENCODER_NOISE)
    (link,) = chain.links
    softer = replace(model, chain=replace(chain, links=(replace(link, stiffness=0.97 * link.stiffness),)))
    near, expected = softer.replay(noisy).simulation.initial_state, model.replay(noisy)
    starts: list[Array] = []

    def counted(arms: list[Arm], observed: object, priors: object, states: list[Array], step_multiple: float) -> object:
        starts.extend(states)
        return simulate_runs(arms, observed, priors, states, step_multiple)  # type: ignore[arg-type]

    monkeypatch.setattr(initial_state, "simulate_runs", counted)
    result = model.replay(noisy, near)
    prior = InitialStatePrior.of(Arm(chain), noisy)

    def cost(simulated: SimulatedRecording) -> float:
        deviation = prior.sqrt_information @ (simulated.simulation.initial_state - prior.rest)
        return chi2_of(simulated) + float(deviation @ deviation)

    assert cost(result) == pytest.approx(cost(expected), abs=0.1)
    np.testing.assert_allclose(result.simulation.initial_state[: chain.size], expected.simulation.q[0], atol=1e-4)
    assert len(starts) <= 1 + initial_state.FEW_TRIALS
    assert np.array_equal(starts[0], near)


def test_lost_frames_and_hidden_markers_do_not_matter() -> None:
    chain, recording, q, v = fit_open_loop(seconds=6.0)
    whole = seen(chain, recording, q, v, NOISE, 6)
    rng = np.random.default_rng(7)
    markers = np.where(rng.random(whole.markers.shape[:2])[..., None] < 0.2, np.nan, whole.markers)
    markers[rng.random(len(markers)) < 0.2] = np.nan
    markers[:, 1, 0] = np.nan  # a coordinate never measured
    holed = replace(whole, markers=markers)
    kept = np.r_[0, 1 + np.flatnonzero(rng.random(len(markers) - 1) > 0.2)]
    dropped = replace(
        whole, time=whole.time[kept], markers=whole.markers[kept], theta=whole.theta[kept], tau=whole.tau[kept]
    )
    clean = seen(chain, recording, q, v).markers
    for spoilt, rows in ((holed, slice(None)), (dropped, kept)):
        _, _, result = found_state(chain, spoilt)
        assert residuals(result).size == np.isfinite(spoilt.markers).sum()
        assert result.marker_rms == pytest.approx(NOISE, rel=0.06)
        error = result.simulation.markers - clean[rows]
        assert np.sqrt(np.mean(error**2)) < NOISE / 4
        assert np.abs(error).max() < 3 * NOISE


def test_camera_and_encoder_keep_their_own_clocks() -> None:
    """A camera of 30 Hz and an encoder of 100 Hz: most rows hold only one of the two."""
    chain = arm_of(steel_link(3, "revolute"))
    time = np.union1d(np.arange(301) / 100.0, (np.arange(91) / 30.0).round(9))
    encoder = np.isin(time, np.arange(301) / 100.0)
    camera = np.isin(time, (np.arange(91) / 30.0).round(9))
    torque = jerky_torque(1, 8)(time)
    q, v = np.array([0.3, 0.04, -0.02, 0.01]), np.array([0.2, 0.1, 0.0, -0.1])
    made = seen(chain, recording_of(chain, time, lambda _: np.where(encoder[:, None], torque, np.nan)), q, v, NOISE, 9)
    sparse = replace(
        made,
        markers=np.where(camera[:, None, None], made.markers, np.nan),
        theta=np.where(encoder[:, None], made.theta, np.nan),
    )
    q_found, _, result = found_state(chain, sparse)
    assert residuals(result).size == 91 * 10 + 301
    assert result.marker_rms == pytest.approx(NOISE, rel=0.08)
    assert result.theta_rms == pytest.approx(ENCODER_NOISE, rel=0.15)
    assert q_found[0] == pytest.approx(q[0], abs=1e-3)


def test_a_driven_link_without_torque_cannot_be_replayed() -> None:
    chain = arm_of(steel_link(2, "revolute"))
    recording = recording_of(chain, np.arange(31) / 30.0, lambda t: np.full((t.size, 1), np.nan))
    with pytest.raises(InsufficientDataError):
        replay(Arm(chain), rig_of(chain), recording, NOISE, ENCODER_NOISE)


# The independent beam


@cache
def demo() -> tuple[Experiment, dict[str, float]]:
    return load_experiment(DEMO), json.loads(TRUTH_FILE.read_text())


@pytest.mark.parametrize(
    ("file", "n", "most"),
    [
        ("quiet.csv", 6, 1.05),
        ("first_mode.csv", 6, 1.06),
        ("second_mode.csv", 6, 1.03),
        ("both_modes.csv", 6, 1.05),
        ("first_mode.csv", 8, 1.02),
    ],
)
def test_the_true_stiffness_follows_the_independent_beam_to_the_noise(file: str, n: int, most: float) -> None:
    experiment, truth = demo()
    (recording,) = (each for each in experiment.recordings if each.file == file)
    chain = arm_of(steel_link(n, bending_stiffness=truth["bending_stiffness"], kelvin_voigt=truth["kelvin_voigt_time"]))
    result = replay(Arm(chain), experiment.rig, recording, NOISE, ENCODER_NOISE)
    assert result.status == "converged"
    assert result.marker_rms < most * NOISE


def test_a_wrong_stiffness_does_not() -> None:
    """Two per cent of frequency is ten seconds' phase: the state cannot make up for it."""
    experiment, truth = demo()
    chain = arm_of(steel_link(6, bending_stiffness=1.04 * truth["bending_stiffness"], kelvin_voigt=3.07e-4))
    first = next(each for each in experiment.recordings if each.file == "first_mode.csv")
    assert replay(Arm(chain), experiment.rig, first, NOISE, ENCODER_NOISE).marker_rms > 20 * NOISE


@pytest.mark.parametrize("joints", [4, 12])
def test_the_prior_of_an_initial_state_expects_shapes_that_a_force_bends(joints: int) -> None:
    """Every mode of a cantilever bent by a tenth of its length has one standard deviation, at rest or in full swing."""
    chain = arm_of(steel_link(joints))
    recording = recording_of(chain, np.arange(301) / 100.0)
    prior = InitialStatePrior.of(Arm(chain), recording)
    mass, _, stiffness, rest = linearise(chain, recording.payload_body, recording.gravity, recording.initial_theta)
    squares, modes = eigh(stiffness, mass)
    load = end_load_shape(chain, 0.1 * chain.links[0].length) - rest
    coordinates = modes.T @ mass @ load
    for slow in range(joints // 2):
        bent = coordinates[slow] * modes[:, slow]
        at_rest = np.concatenate([bent, np.zeros(joints)])
        in_full_swing = np.concatenate([np.zeros(joints), np.sqrt(squares[slow]) * bent])
        for state in (at_rest, in_full_swing):
            # The slowest mode has 97 % of the energy of the bent shape.
            assert np.linalg.norm(prior.sqrt_information @ state) == pytest.approx(1.0, rel=0.1)
