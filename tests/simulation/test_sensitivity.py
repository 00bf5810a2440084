"""Derivatives of a simulated motion, against simulations from moved states and of moved chains."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.interpolate import PPoly, make_interp_spline
from scipy.linalg import eigh, expm

from tests.chain.beams import beam_chain
from tests.diagnosis.rigs import RIG, chain_of, recorded
from tests.simulation.integrators import followed_events
from tests.simulation.setups import (
    DOWN,
    arm_of,
    end_load_shape,
    jerky_torque,
    recording_of,
    rig_of,
    steel_link,
    two_link_arm,
)
from vjm.chain.curve import transfer_state
from vjm.chain.layout import LAYOUTS, LayoutName
from vjm.chain.virtual_links import Chain
from vjm.effects import (
    Backlash,
    BaseCompliance,
    ClampCompliance,
    CoulombFriction,
    Effect,
    GearElasticity,
    Hysteresis,
    PayloadBody,
    Stribeck,
    StructuralDamping,
    TipPayload,
    ViscoelasticCreep,
)
from vjm.model.modes import linearise, modes
from vjm.records import NO_PAYLOAD, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.exponential import flow_and_response, phi_functions
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.least_squares import SquareRootInformation
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run, linearize, simulate_runs
from vjm.simulation.system import Trajectory
from vjm.simulation.variational_equations import PerturbedArm

Array = NDArray[np.float64]
STEP = 1e-5
NOISE = (3e-4, 1e-4)


def hub() -> tuple[Chain, Recording, Array]:
    chain = arm_of(steel_link(3, "revolute"))
    recording = recording_of(chain, np.arange(301) / 100.0, jerky_torque(1, 3), 0.05, DOWN)
    return replace(chain, gravity=DOWN), recording, np.r_[-1.2, 0.02, 0.01, -0.01, 0.3, 0.0, 0.1, 0.0]


def clamped() -> tuple[Chain, Recording, Array]:
    chain = arm_of(steel_link(4))
    recording = recording_of(chain, np.arange(301) / 100.0)
    return chain, recording, np.r_[end_load_shape(chain, 0.1), 0.1, 0.0, -0.2, 0.1]


def two_links() -> tuple[Chain, Recording, Array]:
    chain = two_link_arm()
    recording = recording_of(chain, np.arange(201) / 100.0, jerky_torque(2, 4, 0.05))
    return chain, recording, np.zeros(2 * chain.size)


ARMS = {"hub": hub, "clamped": clamped, "two links": two_links}


def seen_by(chain: Chain, recording: Recording, until: float = np.inf) -> Observations:
    """As if everything had been measured, by the camera until some time, s."""
    markers = np.zeros_like(recording.markers)
    markers[recording.time > until] = np.nan
    everything = replace(recording, markers=markers, theta=np.zeros((recording.time.size, chain.active.size)))
    return Observations.of(rig_of(chain), everything, NOISE)


def run_of(chain: Chain, recording: Recording, state: Array, until: float = np.inf) -> Run:
    seen = seen_by(chain, recording, until)
    return simulate_runs([Arm(chain)], [seen], [InitialStatePrior.of(Arm(chain), recording)], [state], 1.0)[0]


def changed(chain: Chain, by: float) -> dict[str, Chain]:
    """The chain with one parameter of its last link moved."""
    link = chain.links[-1]
    longer = (
        link.lengths + by * link.length * np.eye(link.lengths.size)[0] - by * link.length * np.eye(link.lengths.size)[1]
    )
    parts = {
        "stiffness": replace(link, stiffness=link.stiffness * (1 + by)),
        "a joint's stiffness": replace(link, stiffness=link.stiffness * (1 + by * np.eye(link.virtual_joints)[-1])),
        "damping": replace(link, damping=link.damping * (1 + by)),
        "mass": replace(link, masses=link.masses * (1 + by)),
        "length": replace(link, lengths=longer),
    }
    if link.joint == "revolute":
        parts["hub"] = replace(link, hub_inertia=link.hub_inertia * (1 + by))
        parts["hub's radius"] = replace(link, hub_radius=link.hub_radius + by * link.length)
    return {name: replace(chain, links=(*chain.links[:-1], part)) for name, part in parts.items()}


def by_differences(run: Run, moved: list[tuple[Array, Chain, Array, Chain]]) -> Array:
    """(N, C) central differences of the weighted predictions, all simulated in one batch."""
    copies = [copy for ahead, one, behind, other in moved for copy in ((ahead, Arm(one)), (behind, Arm(other)))]
    states, arms = zip(*copies, strict=True)
    priors = [InitialStatePrior.of(arm, run.observed.recording) for arm in arms]
    runs = simulate_runs(arms, [run.observed] * len(arms), priors, states, 1.0)
    values = run.observed.weights * np.stack([each.predicted for each in runs])
    return (values[::2] - values[1::2]).T / (2 * STEP)


def of_one_stretch(run: Run, moved: list[PerturbedArm]) -> Array:
    """The run's derivatives, all of them in a single stretch of time."""
    (rows,) = list(run.weighted_jacobian(run.linearization(moved)))
    return rows[0]


@pytest.mark.parametrize("arm", ARMS)
def test_parameters(arm: str) -> None:
    chain, recording, state = ARMS[arm]()
    run = run_of(chain, recording, state)
    ahead, behind = changed(chain, STEP), changed(chain, -STEP)
    moved = [PerturbedArm(Arm(each), STEP) for each in ahead.values()]
    found = of_one_stretch(run, moved)[:, -len(moved) :]
    pairs = [(state, ahead[name], state, behind[name]) for name in ahead]
    expected = by_differences(run, pairs)
    for k, name in enumerate(ahead):
        error = np.linalg.norm(found[:, k] - expected[:, k]) / np.linalg.norm(expected[:, k])
        assert error < 0.02, (name, error)


@pytest.mark.parametrize("arm", ARMS)
def test_parameters_of_a_payload(arm: str) -> None:
    chain, recording, state = ARMS[arm]()
    body = {"payload": 0.05, "payload_offset": 0.04, "payload_inertia": 1e-4}

    def loaded(name: str | None, by: float) -> Chain:
        factors = {each: value * (1 + by * (each == name)) for each, value in body.items()}
        return replace(chain, links=(*chain.links[:-1], replace(chain.links[-1], **factors)))

    run = run_of(loaded(None, 0.0), recording, state)
    found = of_one_stretch(run, [PerturbedArm(Arm(loaded(name, STEP)), STEP) for name in body])[:, -len(body) :]
    expected = by_differences(run, [(state, loaded(name, STEP), state, loaded(name, -STEP)) for name in body])
    for k, name in enumerate(body):
        error = np.linalg.norm(found[:, k] - expected[:, k]) / np.linalg.norm(expected[:, k])
        assert error < 0.02, (name, error)


def test_parameters_of_a_known_payload() -> None:
    chain, recording, state = hub()
    assert recording.payload

    def arm(name: str, by: float) -> Arm:
        return Arm.of(chain, (PayloadBody(**{"offset": 0.02, "radius_of_gyration": 0.03, name: 0.02 + by}),))

    for name in ("offset", "radius_of_gyration"):
        arms = [arm(name, by) for by in (0.0, STEP, -STEP)]
        runs = simulate_runs(arms, [seen_by(chain, recording)] * 3, None, [state] * 3, 1.0)
        found = of_one_stretch(runs[0], [PerturbedArm(arms[1], STEP)])[:, -1]
        expected = (runs[2].residual - runs[1].residual) / (2 * STEP)
        assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected), name


@pytest.mark.parametrize("arm", ARMS)
def test_initial_state(arm: str) -> None:
    chain, recording, state = ARMS[arm]()
    run = run_of(chain, recording, state)
    directions = run.basis.states
    found = of_one_stretch(run, [])
    pairs = [(state + STEP * each, chain, state - STEP * each, chain) for each in directions.T]
    expected = by_differences(run, pairs)
    assert found.shape == expected.shape
    # Along directions that change what is seen: of unit length in the measurements, the slowest modes first.
    lengths = np.linalg.norm(expected, axis=0)
    errors = np.linalg.norm(found - expected, axis=0) / lengths
    strong = lengths > 0.05 * lengths.max()
    assert strong.sum() >= 2
    assert errors[strong].max() < (0.05 if arm != "two links" else 0.1)
    assert errors[0] < 1e-3


JOINTS = {
    "clamp": ClampCompliance(link=0, damping=0.0),
    "gear": GearElasticity(link=0),
    "slow base": BaseCompliance(mass=38.0, direction=2.0),
    "fast base": BaseCompliance(mass=1.26, direction=2.0),
}


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
def test_a_joint_that_is_not_there(joint: str, arm: str) -> None:
    """The derivative by its compliance, at zero, against whole simulations with little of it."""
    chain, recording, state = ARMS[arm]()
    if joint == "gear" and not chain.active.size:
        pytest.skip("a clamped link has no gear")
    effect, run = JOINTS[joint], run_of(chain, recording, state)
    step, size = 1e-4, 0.01

    def extended(size: float) -> Arm:
        return Arm.of(chain, (effect.at(np.r_[size, effect.coordinates[1:]]),))

    linearization = run.linearization([PerturbedArm(extended(step), step)])
    (rows,) = list(run.weighted_jacobian(linearization))
    # A joint starts as in the derivative. Kinks of the torque make it vibrate, the less the stiffer it is: hence 5 %.
    moved = linearization.trajectories[0]
    null, one, two = (
        run.residual,
        *(
            simulate_runs(
                [own],
                [run.observed],
                [InitialStatePrior.of(own, recording)],
                [np.r_[state_of(moved.q[0], chain, own, share), state_of(moved.v[0], chain, own, share)]],
                1.0,
            )[0].residual
            for own, share in ((extended(size), size / step), (extended(2 * size), 2 * size / step))
        ),
    )
    expected = (3 * null - 4 * one + two) / (2 * size)
    free = np.linalg.qr(rows[0][:, :-1])[0]  # what any initial state of the arm may do
    found, expected = (each - free @ (free.T @ each) for each in (rows[0][:, -1], expected))
    assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(expected)


@pytest.mark.parametrize("gap", [2e-4, 5e-4])
@pytest.mark.parametrize("arm", ["hub", "two links"])
def test_play_that_is_not_there(arm: str, gap: float) -> None:
    """The direction of play, against whole simulations with a little of it, between flanks that let nothing rebound."""
    chain, recording, state = ARMS[arm]()
    run = run_of(chain, recording, state)
    loose = Arm.of(chain, (Backlash(link=0, gap=gap, flank_stiffness=2e4, flank_damping=60.0),))
    prior, started = InitialStatePrior.of(loose, recording), transfer_state(chain, loose.chain, state)
    expected = run.residual - simulate_runs([loose], [run.observed], [prior], [started], 1.0)[0].residual
    rows = of_one_stretch(run, [PerturbedArm(loose, 1.0)])
    free = np.linalg.qr(rows[:, :-1])[0]  # what any initial state of the arm may do
    found, expected = (each - free @ (free.T @ each) for each in (rows[:, -1], expected))
    assert np.linalg.norm(found - expected) < 0.12 * np.linalg.norm(expected)


MEMORIES: tuple[Effect, ...] = (
    ViscoelasticCreep(link=0, ratio=0.04, time_constant=0.08),
    Hysteresis(link=0, ratio=0.05, yield_angle=0.05),
    StructuralDamping(link=0, loss_factor=0.02, longest_time_constant=20.0),
)


@pytest.mark.parametrize(("present", "absent"), [*permutations(MEMORIES, 2)], ids=lambda each: each.id)
@pytest.mark.parametrize("first", [False, True])  # whether the absent one comes first among the effects
def test_memories_that_are_not_there_beside_one_that_is(present: Effect, absent: Effect, first: bool) -> None:
    """The derivative by the size, at zero, of an effect with internal states beside another one with such."""
    chain, recording, state = hub()

    def arm(share: float) -> Arm:
        size, *shape = absent.coordinates
        effects = (present, absent.at(np.r_[share * size, shape]))
        return Arm.of(chain, effects[::-1] if first else effects)

    def simulated(arm: Arm) -> Run:
        seen = seen_by(chain, recording)
        return simulate_runs([arm], [seen], [InitialStatePrior.of(arm, recording)], [state], 1.0)[0]

    run, step = simulated(arm(0.0)), 1e-6
    found = of_one_stretch(run, [PerturbedArm(arm(step), step)])[:, -1]
    one, two = (simulated(arm(share)).residual for share in (0.01, 0.02))
    expected = (3 * run.residual - 4 * one + two) / 0.02
    # The slip has kinks wherever its joint turns round.
    most = 0.1 if isinstance(present, Hysteresis) else 0.01
    assert np.linalg.norm(found - expected) < most * np.linalg.norm(expected)


def state_of(values: Array, chain: Chain, own: Arm, share: float) -> Array:
    """Of the coordinates of an arm, those that the chain lacks times a share."""
    added = [name not in chain.joint_names for name in own.chain.joint_names]
    return np.where(added, share * values, values)


def runs_from_rest(arm: Arm, observed: list[Observations]) -> list[Run]:
    priors = [InitialStatePrior.of(arm, each.recording) for each in observed]
    return simulate_runs([arm] * len(observed), observed, priors, [np.zeros(2 * arm.chain.size)] * len(observed), 1.0)


@pytest.mark.parametrize(
    ("effect", "name", "change"),
    [
        (Backlash(link=0, gap=0.004, motor_share=0.4), "gap", 4e-5),
        pytest.param(Backlash(link=0, gap=0.004, motor_share=0.4), "motor_share", 1e-2, marks=pytest.mark.slow),
        (CoulombFriction(link=0, torque=0.01), "torque", 1e-4),
    ],
)
def test_derivatives_across_impacts_and_stiction_lead_to_the_truth(effect: Effect, name: str, change: float) -> None:
    """Motions with impacts are chaotic: of a dozen most must agree, in direction and in length."""
    chain, step = arm_of(steel_link(3, "revolute")), 1e-3 * change
    torques = [jerky_torque(1, seed) for seed in range(12)]
    observed = [seen_by(chain, recording_of(chain, np.arange(101) / 100.0, torque)) for torque in torques]

    def arm(off: float) -> Arm:
        return Arm.of(chain, (replace(effect, **{name: getattr(effect, name) + off}),))

    cosines, lengths = [], []
    for run, behind, ahead in zip(*(runs_from_rest(arm(off), observed) for off in (0.0, -change, change)), strict=True):
        found = of_one_stretch(run, [PerturbedArm(arm(step), step)])[:, -1]
        expected = (behind.residual - ahead.residual) / (2 * change)
        cosines.append(found @ expected / (np.linalg.norm(found) * np.linalg.norm(expected)))
        lengths.append(found @ expected / (found @ found))
    assert np.median(cosines) > 0.7
    assert np.median(lengths) == pytest.approx(1.0, abs=0.3)


def rubbing(name: str) -> tuple[Arm, dict[str, tuple[Arm, float]], float]:
    """An arm with dry friction, others with a parameter changed by a step, and the size of its torques, N m."""
    chain, joints = (two_link_arm(), (0, 1)) if name == "two links" else (arm_of(steel_link(3, "revolute")), (0,))
    friction: list[Effect] = [CoulombFriction(link=joint, torque=0.1 if joint == 0 else 0.04) for joint in joints]
    if name == "Stribeck":
        friction.append(Stribeck(link=0, torque=0.04, speed=0.3))
    moved = {each: (Arm.of(other, friction), 1e-6) for each, other in changed(chain, 1e-6).items()}
    for k, effect in enumerate(friction):
        others = [replace(other, torque=other.torque + 1e-8 * (other is effect)) for other in friction]
        moved[f"friction {k}"] = Arm.of(chain, others), 1e-8
    moved["payload"] = Arm.of(chain, [*friction, TipPayload(mass=1e-6)]), 1e-6
    moved["known payload"] = Arm.of(chain, [*friction, PayloadBody(offset=1e-6)]), 1e-6
    return Arm.of(chain, friction), moved, 0.05 if name == "two links" else 0.15


@pytest.mark.parametrize("name", [pytest.param("one joint", marks=pytest.mark.slow), "Stribeck", "two links"])
def test_derivatives_of_what_sticks_are_differences_of_simulations(name: str) -> None:
    """Each unknown is changed and simulated alone; the arm begins in motion, as at rest a joint slips either way."""
    arm, moved, size = rubbing(name)
    count, chain = arm.chain.active.size, arm.chain
    begun = np.r_[np.zeros(chain.size), np.where(np.isin(np.arange(chain.size), chain.active), 0.02, 0.2)]
    errors, held = [], []
    for seed in range(2 if count > 1 else 4):
        seen = seen_by(arm.chain, recording_of(arm.chain, np.arange(41) / 100.0, jerky_torque(count, seed, size), 0.02))
        (run,) = simulate_runs([arm], [seen], None, [begun], 1.0)
        assert run.trajectory.friction is not None
        stopped = np.isfinite(run.trajectory.friction.stop) & (run.trajectory.friction.restarted == 0)
        held.append(stopped.mean(axis=0))
        found = of_one_stretch(run, [PerturbedArm(other, step) for other, step in moved.values()])
        slow = run.basis.slow_count
        unknowns = [(arm, 0 * run.state, 0.0)]  # as it is, but rounded as the others are
        unknowns += [(arm, 1e-6 * run.basis.states[:, k], 1e-6) for k in (0, 1, slow, slow + 1)]
        unknowns += [(other, 0 * run.state, step) for other, step in moved.values()]
        arms, offsets, steps = zip(*unknowns, strict=True)
        states = [run.state + off for off in offsets]
        same, *others = simulate_runs(arms, [seen] * len(arms), [run.prior] * len(arms), states, 1.0)
        columns = [(same.residual - each.residual) / step for each, step in zip(others, steps[1:], strict=True)]
        chosen = np.r_[0, 1, slow, slow + 1, 2 * slow : found.shape[1]]
        expected = np.stack(columns, axis=1)
        errors.append(np.linalg.norm(found[:, chosen] - expected, axis=0) / np.linalg.norm(expected, axis=0))
    assert (np.mean(held, axis=0) > 0.05).all()  # of the time
    assert (np.median(errors, axis=0) < 0.05).all()
    assert np.median(errors) < 0.01


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 1, 2, 4, 5))])
def test_derivatives_across_impacts_are_differences_of_motions_from_event_to_event(seed: int) -> None:
    chain, play = arm_of(steel_link(2, "revolute")), Backlash(link=0, gap=0.004, motor_share=0.4)
    recording = recording_of(chain, np.arange(16) / 100.0, jerky_torque(1, seed))
    observed, arm = seen_by(chain, recording), Arm.of(chain, (play,))
    prior = InitialStatePrior.of(arm, recording)
    (run,) = simulate_runs([arm], [observed], [prior], [np.zeros(2 * arm.chain.size)], 1.0)
    assert run.trajectory.angles(recording.time) == pytest.approx(followed_events(arm, recording), abs=5e-6)
    pieces = run.linearization().pieces(run.linearization().rows)
    assert pieces is not None
    assert np.count_nonzero(pieces.met) > 0
    changes = {"gap": 1e-6, "motor_share": 1e-4, "flank_stiffness": 0.1, "flank_damping": 1e-4}

    def changed_by(name: str, size: float) -> Arm:
        return Arm.of(chain, (replace(play, **{name: getattr(play, name) + size}),))

    def markers(changed: Arm) -> Array:
        q = followed_events(changed, recording)
        return observed.predicted(changed, Trajectory(recording.time, q, 0 * q, 0 * q, np.zeros((len(q), 0))))

    moved = [PerturbedArm(changed_by(name, 1e-3 * size), 1e-3 * size) for name, size in changes.items()]
    found = of_one_stretch(run, moved)[:, -len(changes) :]
    expected = {
        name: observed.weights * (markers(changed_by(name, size)) - markers(changed_by(name, -size))) / (2 * size)
        for name, size in changes.items()
    }
    visible = play.gap * np.linalg.norm(expected["gap"])  # what the flanks are like may hardly show beside it
    for (name, column), derivative in zip(expected.items(), found.T, strict=True):
        shown, error = (getattr(play, name) * np.linalg.norm(each) for each in (column, derivative - column))
        assert error < 0.03 * shown + 0.01 * visible, name


def test_a_motor_that_moves_nothing_has_no_derivative() -> None:
    chain, recording, state = hub()
    light = replace(chain, links=(replace(chain.links[0], hub_inertia=0.0),))
    run, gear = run_of(light, recording, state), GearElasticity(link=0)
    moved = Arm.of(light, (gear.at(np.r_[1e-4, gear.coordinates[1:]]),))
    slopes = np.concatenate([part for _, part in run.jacobian(run.linearization([PerturbedArm(moved, 1e-4)]))])
    assert np.isnan(slopes[:, -1]).any()
    assert np.isfinite(slopes[:, :-1]).all()


@pytest.mark.parametrize("seen", [1.0, 0.5])  # part of the time in which the camera sees the markers
def test_stretches_of_time_make_no_difference(seen: float, monkeypatch: pytest.MonkeyPatch) -> None:
    chain, recording, state = hub()
    until = seen * recording.time[-1]
    run = run_of(chain, recording, state, until)
    moved = [PerturbedArm(Arm(each), STEP) for each in changed(chain, STEP).values()]
    for effect in JOINTS.values():
        moved.append(PerturbedArm(Arm.of(chain, (effect.at(np.r_[1e-4, effect.coordinates[1:]]),)), 1e-4))
    whole = run.linearized(run.linearization(moved))
    monkeypatch.setattr("vjm.simulation.sensitivity._MOST_COEFFICIENTS", 2000)
    again = run_of(chain, recording, state, until)
    assert len(list(again.weighted_jacobian(again.linearization(moved)))) > 3
    R = again.linearized(again.linearization(moved)).R
    np.testing.assert_allclose(R.T @ R, whole.R.T @ whole.R, rtol=1e-8)


@pytest.mark.parametrize("size", [1e-3, 1.0, 40.0])
def test_phi_functions(size: float) -> None:
    """By the exponential of a block matrix, which holds them in its first row."""
    rng = np.random.default_rng(1)
    skew = rng.normal(size=(3, 4, 4))
    matrices = size * (skew - np.swapaxes(skew, 1, 2)) - 0.1 * size * np.eye(4)
    found = phi_functions(matrices, 1.0, 2)
    for k, matrix in enumerate(matrices):
        block = np.zeros((16, 16))
        block[:4, :4] = matrix
        block[range(12), range(4, 16)] = 1.0
        expected = expm(block)[:4].reshape(4, 4, 4)
        for order in range(4):
            np.testing.assert_allclose(found[order][k], expected[:, order], rtol=1e-10, atol=1e-11)
    forcing = [rng.normal(size=(3, 4, 2)) for _ in range(3)]
    flow, response = flow_and_response(matrices, 1.0, 2, (forcing[0], forcing[1], forcing[2]))
    np.testing.assert_allclose(flow, found[0], rtol=1e-12, atol=1e-13)
    combined = sum(phi @ part for phi, part in zip(found[1:], forcing, strict=True))
    np.testing.assert_allclose(response, combined, rtol=1e-10, atol=1e-11)
    assert flow_and_response(matrices, 1.0, 2, (np.zeros((3, 4, 0)),) * 3)[1].shape == (3, 4, 0)


# The triangle


@given(st.integers(0, 1000))
def test_triangle_is_the_least_squares_problem(seed: int) -> None:
    rng = np.random.default_rng(seed)
    J, r = rng.normal(size=(30, 5)), rng.normal(size=30)
    parts = [(J[:3], r[:3]), (J[3:4], r[3:4]), (J[4:], r[4:])]
    linearized = SquareRootInformation.of(parts, 5)
    best = np.linalg.lstsq(J, r, rcond=None)[0]
    np.testing.assert_allclose(linearized.best(), best, atol=1e-9)
    assert linearized.decrease(best) == pytest.approx(r @ r - np.sum((r - J @ best) ** 2))
    others = rng.normal(size=2)
    inner = np.linalg.lstsq(J[:, :3], r - J[:, 3:] @ others, rcond=None)[0]
    np.testing.assert_allclose(linearized.solve(3, others), inner, atol=1e-9)
    np.testing.assert_allclose(linearized.eliminated(3).best(), best[3:], atol=1e-9)
    follow = linearized.elimination_jacobian(3)
    np.testing.assert_allclose(J[:, :3].T @ (J[:, 3:] - J[:, :3] @ follow), 0.0, atol=1e-9)


def test_triangle_of_fewer_rows_than_unknowns() -> None:
    linearized = SquareRootInformation.of([(np.array([[2.0, 0.0, 0.0]]), np.array([4.0]))], 3)
    np.testing.assert_allclose(linearized.best(), [2.0, 0.0, 0.0])


# From one chain to another


@pytest.mark.parametrize("given_joints", [3, 5])
def test_a_state_told_in_another_chain_s_joints_looks_the_same(given_joints: int) -> None:
    one, other = arm_of(steel_link(given_joints, "revolute")), arm_of(steel_link(6, "revolute"))
    state = np.r_[0.3, end_load_shape(one, 0.08), 0.5, end_load_shape(one, 0.2)]
    moved = transfer_state(one, other, state)
    rig = rig_of(one)
    seen = Observations.of(rig, recording_of(one, np.arange(2.0)), NOISE)
    q, p = state[: one.size], moved[: other.size]
    np.testing.assert_allclose(seen.arcs.positions(other, p[None]), seen.arcs.positions(one, q[None]), atol=2e-5)
    assert moved[other.size] == 0.5


def locked_modes(chain: Chain) -> tuple[Array, Array]:
    """Mass matrix of the passive joints and their modes, slowest first."""
    M, _, K, _ = linearise(chain, NO_PAYLOAD, (0.0, 0.0))
    passive = np.ix_(chain.passive, chain.passive)
    return M[passive], np.asarray(eigh(K[passive], M[passive])[1])


@pytest.mark.parametrize("joint", ["revolute", "clamped"])
def test_rates_of_fast_modes_do_not_reach_slower_ones_of_another_chain(joint: Literal["revolute", "clamped"]) -> None:
    """As noise has them, where it alone determines the fastest mode."""
    chain, finer = arm_of(steel_link(4, joint)), arm_of(steel_link(12, joint))
    (_, shapes), (finer_inertia, finer_shapes) = locked_modes(chain), locked_modes(finer)
    recording = recording_of(chain, np.arange(3) / 100.0)

    def modal_rates(amplitudes: list[float]) -> Array:
        state = np.zeros(2 * chain.size)
        state[chain.size + chain.passive] = shapes @ amplitudes
        rates = run_of(chain, recording, state).transferred_state(Arm(finer))[finer.size :]
        return finer_shapes.T @ finer_inertia @ rates[finer.passive]

    assert abs(modal_rates([0.01, 0.0, 0.0, 0.0])[0]) == pytest.approx(0.01, rel=0.01)
    noisy = modal_rates([0.0, 0.0, 0.0, 0.05])
    assert noisy[:3] == pytest.approx(0.0, abs=1e-12)
    assert abs(noisy[3]) > 0.01


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_mode_keeps_its_rate_where_chains_differ_in_its_frequency(layout: LayoutName) -> None:
    """The first mode of two equal links is 49 % too fast, that of three 33 %."""
    for n in (2, 3, 5):
        chain, finer = beam_chain(n, layout), beam_chain(n + 1, layout)
        (_, shapes), (inertia, finer_shapes) = locked_modes(chain), locked_modes(finer)
        recording = recording_of(chain, np.linspace(0.0, 0.1, 3))
        for k in range(n):
            run = run_of(chain, recording, np.r_[np.zeros(n), 0.01 * shapes[:, k]])
            rates = finer_shapes.T @ inertia @ run.transferred_state(Arm(finer))[n + 1 :]
            assert abs(rates[k]) > 0.005


@pytest.mark.parametrize("direction", [0.0, 0.05])
def test_a_mode_keeps_its_rate_where_chains_order_their_modes_differently(direction: float) -> None:
    """A table that is as fast as the third mode of bending, between what the two chains make of that."""
    chain, finer = arm_of(steel_link(3)), arm_of(steel_link(9))
    third = np.sqrt(modes(chain).frequencies[2] * modes(finer).frequencies[2])
    mass = 7.0
    table = BaseCompliance(stiffness=(mass + 0.44) * (2 * np.pi * third) ** 2, mass=mass, direction=direction)
    arm, other = Arm.of(chain, (table,)), Arm.of(finer, (table,))
    (inertia, shapes), (other_inertia, _) = locked_modes(arm.chain), locked_modes(other.chain)
    for k in range(arm.chain.size):
        state = np.r_[np.zeros(arm.chain.size), 0.01 * shapes[:, k]]
        recording = recording_of(arm.chain, np.arange(3) / 100.0)
        observed = seen_by(chain, recording)
        run = simulate_runs([arm], [observed], [InitialStatePrior.of(arm, recording)], [state], 1.0)[0]
        rates = run.transferred_state(other)[other.chain.size :]
        # Three joints interpolate the curvature of the third mode of bending no better.
        assert rates @ other_inertia @ rates == pytest.approx(1e-4 * shapes[:, k] @ inertia @ shapes[:, k], rel=0.3)


def test_a_torque_s_moments_survive_its_steps() -> None:
    """A straight arm's rotation under a torque of many kinks, by steps that pass over ten of them."""
    chain = arm_of(steel_link(1, "revolute", bending_stiffness=1e8))
    noise = np.random.default_rng(5).normal(0, 1, (1001, 1))
    recording = recording_of(chain, np.arange(1001) / 1000.0, lambda _: noise)
    rest = np.zeros((1, 2))
    (wide,) = simulate_trajectories([Arm(chain)], [recording], rest, rest, step=1e-2)
    torque = PPoly.from_spline(make_interp_spline(recording.time, noise[:, 0], k=1))
    inertia = 0.02 + 0.44 / 3
    expected = torque.antiderivative(2)(wide.time) / inertia
    inside = wide.time <= 1.0
    assert np.ptp(expected) > 0.01
    np.testing.assert_allclose(wide.q[inside, 0], expected[inside], atol=1e-8)


@pytest.mark.parametrize(
    "effect",
    [CoulombFriction(link=0, torque=0.005), Backlash(link=0, gap=0.001, motor_share=0.4)],
    ids=["friction", "play"],
)
def test_encoders_of_a_given_motion_tell_no_mass_beside_friction_or_play(effect: Effect) -> None:
    """The joint turns as it is told, whatever hangs on it."""
    recording = recorded(Arm(chain_of()), 1)[1]
    recording = replace(recording, input="motion", tau=np.full_like(recording.tau, np.nan))
    observed = Observations.of(RIG, recording, NOISE)

    def arm(mass: float) -> Arm:
        return Arm.of(chain_of(), (effect, TipPayload(link=0, mass=mass))).in_recording(recording)

    state = np.zeros(2 * arm(0.02).chain.size)
    state[0] = recording.theta[0, 0]
    prior = InitialStatePrior.of(arm(0.02), recording)
    middle, less, more = (simulate_runs([arm(m)], [observed], [prior], [state], 1.0)[0] for m in (0.02, 0.0199, 0.0201))
    (linearization,) = linearize([middle], [[PerturbedArm(arm(0.02 + 1e-8), 1e-8)]])
    derivative = np.zeros(observed.count)
    for rows, part in middle.jacobian(linearization):
        derivative[rows] = part[:, -1]
    theta = slice(observed.marker_indices.size, None)
    differences = (less.residual - more.residual) / 2e-4
    assert np.linalg.norm(derivative[theta]) < 1e-4 * np.linalg.norm(differences)
    assert np.linalg.norm(differences[theta]) < 1e-4 * np.linalg.norm(differences)
