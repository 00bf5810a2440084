"""Actuators: late, clipped and uneven torques, and friction by speed, against other ways to the same answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from tests.effects.setups import FORE, LINK, POST, chain_of, recording_of
from tests.fine_beam import Beam, Physics, Run, simulate_runs
from vjm.chain.virtual_links import Array
from vjm.effects import ActuatorLag, Cogging, CoulombFriction, Effect, Stribeck, TorqueSaturation
from vjm.records import NO_PAYLOAD, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulate_trajectories

HUB, CHAIN = Rig("hub", (LINK,)), chain_of(LINK)

BEAM = Beam(LINK.length, LINK.mass, LINK.bending_stiffness, 5e-4, joint="revolute", hub_inertia=LINK.hub_inertia)
BOTH_WAYS = [
    (ActuatorLag(time_constant=0.008), Physics(actuator_lag_time_constant=0.008), 3e-3),
    pytest.param(TorqueSaturation(limit=0.05), Physics(torque_saturation_limit=0.05), 1e-3, marks=pytest.mark.slow),
    pytest.param(
        Cogging(amplitude=0.006, count=40.0, phase=0.5),
        Physics(cogging_amplitude=0.006, cogging_count=40.0, cogging_phase=0.5),
        2e-3,
        marks=pytest.mark.slow,
    ),
    pytest.param(
        Stribeck(torque=0.006, speed=0.12),
        Physics(stribeck_torque=0.006, stribeck_speed=0.12),
        2e-2,
        marks=pytest.mark.slow,
    ),
]


def driven(time: Array, torque: Array) -> Recording:
    """A recording of nothing but torques (T,) or (T, n_a)."""
    tau = torque.reshape(time.size, -1)
    return Recording(time, np.full((time.size, 1, 2), np.nan), np.zeros_like(tau), tau, kind="driven")


def late_torque(recording: Recording, time_constant: float, instants: Array) -> Array:
    """The lag of the torque that is linear between the samples, by an adaptive integrator from sample to sample."""
    u, found, y = recording.tau[:, 0], [], float(recording.tau[0, 0])
    for k, (start, end) in enumerate(zip(recording.time[:-1], recording.time[1:], strict=True)):
        wanted = instants[(instants >= start) & (instants < end)]

        def slope(t: float, y: Array, k: int = k, start: float = start, end: float = end) -> Array:
            return np.asarray((u[k] + (u[k + 1] - u[k]) * (t - start) / (end - start) - y) / time_constant)

        solved = solve_ivp(slope, (start, end), [y], t_eval=np.append(wanted, end), rtol=1e-11, atol=1e-13)
        found.append(solved.y[0, :-1])
        y = float(solved.y[0, -1])
    return np.concatenate(found)


@pytest.mark.parametrize("time_constant", [3e-4, 0.005, 0.3])
def test_a_late_torque_has_the_integrals_of_the_exact_response(time_constant: float) -> None:
    """Over every hat function of the samples, which need not be evenly spaced."""
    random = np.random.default_rng(1)
    recording = driven(0.1 + np.cumsum(random.uniform(0.002, 0.02, 40)), random.normal(size=40))
    late = ActuatorLag(time_constant=time_constant).true_inputs(recording)
    nodes, weights = np.polynomial.legendre.leggauss(20)
    # Each interval in parts, the first ones short: the response starts abruptly.
    shares = np.append(0.0, np.geomspace(1e-3, 1.0, 12))
    edges = np.unique((recording.time[:-1, None] + np.diff(recording.time)[:, None] * shares).ravel())
    middles, halves = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
    instants = (middles[:, None] + halves[:, None] * nodes).ravel()
    weight = (halves[:, None] * weights).ravel()
    exact = late_torque(recording, time_constant, instants)
    found = np.interp(instants, late.time, late.tau[:, 0])
    for hat in np.eye(40):
        tested = weight * np.interp(instants, recording.time, hat)
        assert found @ tested == pytest.approx(exact @ tested, abs=1e-9)


@given(st.floats(1e-6, 10.0), st.floats(-1.0, 1.0), st.floats(-5.0, 5.0))
def test_a_torque_that_rises_steadily_is_late_by_the_time_constant(lag: float, first: float, slope: float) -> None:
    time = np.arange(60) * lag
    late = ActuatorLag(time_constant=lag).true_inputs(driven(time, first + slope * time)).tau[:, 0]
    assert late[-10:] == pytest.approx(first + slope * (time[-10:] - lag), abs=1e-9 + 1e-9 * abs(slope) * time[-1])


def test_motion_under_a_late_torque_is_that_under_one_sampled_much_faster() -> None:
    """What is left of a torque being linear between samples is a hundredth of what an encoder shows."""
    time, fine = np.arange(501) / 250, np.arange(0, 100 * 500 + 1) / 25000
    torque = 0.1 * np.sign(np.sin(9.0 * time)) + 0.1 * np.sin(35.0 * time)
    recording = driven(time, torque)
    exact = driven(fine, np.append(late_torque(recording, 0.006, fine[:-1]), 0.0))
    samples = driven(time, exact.tau[::100])  # the response itself at the samples, linear between
    late = ActuatorLag(time_constant=0.006).true_inputs(recording)
    rest, angles = np.zeros(CHAIN.size), []
    for each in (exact, late, samples):
        (steps,) = simulate_trajectories([Arm(CHAIN)], [each], [rest], [rest])
        angles.append(steps.angles(time)[:, 0])
    assert np.abs(angles[1] - angles[0]).max() < 1e-6
    assert np.abs(angles[1] - angles[0]).max() < 0.1 * np.abs(angles[2] - angles[0]).max()


def test_only_known_torques_of_the_joint_are_late() -> None:
    rig = Rig("arm", (POST, LINK, FORE))
    recording = recording_of(rig, 40)
    torque = recording.tau.copy()
    torque[5::3, 1] = np.nan
    recording = replace(recording, tau=torque)
    (first, second) = ActuatorLag().variants(rig, [recording])
    late = second.at(np.array([2.0])).true_inputs(recording).tau
    known = np.isfinite(recording.tau).all(axis=1)
    np.testing.assert_array_equal(late[:, 0], recording.tau[:, 0])
    np.testing.assert_array_equal(late[~known], recording.tau[~known])
    alone = driven(recording.time[known], recording.tau[known, 1])
    assert late[known, 1] == pytest.approx(second.at(np.array([2.0])).true_inputs(alone_column(alone)).tau[:, 1])
    assert not np.allclose(first.at(np.array([2.0])).true_inputs(recording).tau[known, 0], recording.tau[known, 0])


def alone_column(recording: Recording) -> Recording:
    """The same with a column of zeros before it."""
    return replace(
        recording, tau=np.column_stack([0 * recording.tau, recording.tau]), theta=np.zeros((len(recording.time), 2))
    )


@given(st.integers(0, 99), st.floats(0.05, 3.0))
def test_a_saturated_torque_has_the_integrals_of_the_clipped_one(seed: int, limit: float) -> None:
    """Over every hat function of the samples; the torque crosses both limits from one sample to the next."""
    random = np.random.default_rng(seed)
    recording = driven(np.cumsum(random.uniform(0.002, 0.02, 30)), random.normal(size=30))
    clipped = TorqueSaturation(limit=limit).true_inputs(recording)
    fine = np.linspace(recording.time[0], recording.time[-1], 200001)
    exact = np.interp(fine, recording.time, recording.tau[:, 0]).clip(-limit, limit)
    lost = exact - np.interp(fine, recording.time, clipped.tau[:, 0])
    for k, hat in enumerate(np.eye(30)):
        first, last = np.searchsorted(fine, recording.time[[max(k - 1, 0), min(k + 1, 29)]])
        part = slice(max(first - 1, 0), last + 1)  # the hat is zero elsewhere
        weighted = lost[part] * np.interp(fine[part], recording.time, hat)
        assert np.trapezoid(weighted, fine[part]) == pytest.approx(0.0, abs=1e-8)


def test_a_saturated_torque_is_clipped_at_its_joint() -> None:
    rig = Rig("arm", (POST, LINK, FORE))
    recording = recording_of(rig)
    levels = np.where(np.arange(12) < 6, 0.2, 0.7)
    recording = replace(recording, tau=np.stack([recording.tau[:, 0], levels], axis=1))
    clipped = TorqueSaturation(limit=0.3, link=2, column=1).true_inputs(recording)
    np.testing.assert_array_equal(clipped.tau[:, 0], recording.tau[:, 0])
    assert clipped.tau[:4, 1] == pytest.approx(0.2, abs=5e-3)
    assert clipped.tau[8:, 1] == pytest.approx(0.3, abs=5e-3)


def test_limits_are_counted_from_the_largest_torque() -> None:
    recordings = [recording_of(HUB), replace(recording_of(HUB), tau=3 * recording_of(HUB).tau)]
    peak = 3 * np.abs(recordings[0].tau).max()
    (absent,) = TorqueSaturation().variants(HUB, recordings)
    assert absent.at(np.array([1e-9])).limit == pytest.approx(peak)
    assert absent.at(np.array([1.0])).limit == pytest.approx(peak / 3)
    assert absent.at(np.array([-1.0])).is_null
    for limit in (0.2 * peak, 0.9 * peak):
        assert absent.at(replace(absent, limit=limit).coordinates).limit == pytest.approx(limit)
    assert replace(absent, limit=1.1 * peak).coordinates == pytest.approx([0.0])
    assert absent.bounds[0] == pytest.approx([0.0])


def test_every_torque_changes_little_with_the_limit_next_to_the_largest() -> None:
    recording = driven(np.arange(500) / 500, np.sin(np.arange(500) / 20))
    (absent,) = TorqueSaturation().variants(HUB, [recording])
    lost = [np.abs(absent.at(np.array([c])).true_inputs(recording).tau - recording.tau).max() for c in (1e-3, 1e-2)]
    assert lost == pytest.approx([2e-3, 2e-2], rel=0.1)


@pytest.mark.parametrize("effect", [ActuatorLag(), TorqueSaturation()], ids=lambda effect: effect.id)
def test_without_a_torque_they_are_not_looked_for(effect: Effect) -> None:
    unknown = replace(recording_of(HUB), tau=np.full((12, 1), np.nan))
    assert "torque" in effect.untestable(HUB, [unknown])
    assert effect.untestable(HUB, [unknown, recording_of(HUB)]) == ""


def test_an_arm_that_is_never_driven_shows_no_limit() -> None:
    idle = replace(recording_of(HUB), tau=np.zeros((12, 1)))
    assert "driven" in TorqueSaturation().untestable(HUB, [idle])


def test_cogging_is_a_wave_of_the_joint_s_angle() -> None:
    chain, rng = chain_of(POST, LINK), np.random.default_rng(2)
    joint, q = chain.active[0], rng.normal(size=(50, chain.size))
    force = Cogging(amplitude=0.02, count=18.0, phase=0.4, link=1).force(chain, NO_PAYLOAD)
    assert force is not None
    found = force(np.zeros(50), q, 0 * q, np.zeros((50, 0)))
    assert found[:, joint] == pytest.approx(0.02 * np.sin(18.0 * q[:, joint] + 0.4))
    assert not np.delete(found, joint, axis=1).any()


def test_a_joint_comes_to_rest_where_cogging_pulls_it() -> None:
    """A rigid arm that is let go near a stable place swings about it with the frequency of that spring."""
    stiff = replace(CHAIN, links=tuple(replace(link, stiffness=300 * link.stiffness) for link in CHAIN.links))
    time, start = np.arange(1001) / 250, np.zeros(CHAIN.size)
    start[0] = 0.002
    arm = Arm.of(stiff, (Cogging(amplitude=0.05, count=20.0, phase=np.pi).placed(HUB, 0),))
    (steps,) = simulate_trajectories([arm], [driven(time, 0 * time)], [start], [0 * start])
    inertia = LINK.hub_inertia + LINK.mass * LINK.length**2 / 3
    swing = 0.002 * np.cos(np.sqrt(0.05 * 20.0 / inertia) * time)
    assert steps.angles(time)[:, 0] == pytest.approx(swing, abs=1e-4)


def test_steps_follow_waves_that_pass_fast() -> None:
    slow, fast = (Cogging(amplitude=0.01, count=count).max_step(CHAIN) for count in (10.0, 100.0))
    assert slow == pytest.approx(10 * fast)


def test_friction_falls_with_the_joint_s_rate() -> None:
    rates = np.linspace(-0.5, 0.5, 101)[:, None]
    friction = Arm.of(CHAIN, (Stribeck(torque=0.008, speed=0.1), CoulombFriction(torque=0.003))).friction_torques(rates)
    assert friction == pytest.approx(0.003 + 0.008 * np.exp(-((rates / 0.1) ** 2)))


def test_friction_by_speed_beside_coulomb_s_holds_both_torques() -> None:
    stiff = replace(CHAIN, links=tuple(replace(link, stiffness=300 * link.stiffness) for link in CHAIN.links))
    effects = tuple(each.placed(HUB, 0) for each in (CoulombFriction(torque=0.02), Stribeck(torque=0.03, speed=0.1)))
    arm, time, rest = Arm.of(stiff, effects), np.arange(501) / 250, np.zeros(CHAIN.size)
    for torque, moves in ((0.048, False), (0.052, True)):
        ramp = torque * np.minimum(time, 1.0)
        (steps,) = simulate_trajectories([arm], [driven(time, ramp)], [rest], [rest])
        assert bool(np.abs(steps.angles(time)[:, 0]).max() > 5e-3) is moves


def test_steadily_turning_fast_there_is_coulomb_s_friction_only() -> None:
    stiff = replace(CHAIN, links=tuple(replace(link, stiffness=300 * link.stiffness) for link in CHAIN.links))
    inertia, time = LINK.hub_inertia + LINK.mass * LINK.length**2 / 3, np.arange(251) / 250
    turning = np.zeros(CHAIN.size)
    turning[0] = 3.0
    effects = CoulombFriction(torque=0.02).placed(HUB, 0), Stribeck(torque=0.03, speed=0.1).placed(HUB, 0)
    (steps,) = simulate_trajectories([Arm.of(stiff, effects)], [driven(time, 0 * time)], [0 * turning], [turning])
    assert steps.angles(time)[-1, 0] == pytest.approx(3.0 - 0.5 * 0.02 / inertia, abs=1e-3)


@pytest.mark.parametrize(("effect", "physics", "error"), BOTH_WAYS, ids=lambda each: getattr(each, "id", None))
def test_the_continuous_beam_says_the_same(effect: Effect, physics: Physics, error: float) -> None:
    """Encoders' angles by two simulations that share nothing, over what the effect changes of them."""
    time, chain = np.arange(1501) / 500, chain_of(LINK, n=10, kelvin_voigt=5e-4)
    torque = 0.06 * np.sin(5.7 * time + 0.4) * np.minimum(4 * time, 1.0) + 0.03 * np.sin(14.5 * time)
    rest = np.zeros(chain.size)
    (steps,) = simulate_trajectories([Arm.of(chain, (effect.placed(HUB, 0),))], [driven(time, torque)], [rest], [rest])
    (beam,) = simulate_runs(BEAM, physics, time, [Run(torque)])
    (plain,) = simulate_runs(BEAM, Physics(), time, [Run(torque)])
    off, change = steps.angles(time)[:, 0] - beam.theta, beam.theta - plain.theta
    assert np.abs(change).max() > 1e-3
    assert np.linalg.norm(off) < error * np.linalg.norm(change)
