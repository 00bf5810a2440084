"""Simulations held near measured angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.simulation.integrators import trajectories_of
from tests.simulation.setups import arm_of, jerky_torque, recording_of, rig_of, steel_link, two_link_arm
from vjm.chain.virtual_links import Chain
from vjm.effects import EncoderOffset
from vjm.records import Recording
from vjm.simulation.arm import Arm, EncoderFeedback
from vjm.simulation.integrate import simulate_trajectories
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run, simulate_runs
from vjm.simulation.sensitivity import PerturbedArm

Array = NDArray[np.float64]
NOISE = (3e-4, 1e-4)


def resting(chain: Chain, angle: float, duration: float = 3.0) -> Recording:
    """Every encoder shows the same angle throughout; no torque."""
    recording = recording_of(chain, np.arange(round(200 * duration) + 1) / 200)
    return replace(recording, theta=np.full(recording.theta.shape, angle))


def rigid(stiffness: float = 2000.0) -> Chain:
    """A rod that hardly bends, 1 m and 0.44 kg, on a hub of 0.02 kg m^2."""
    return arm_of(steel_link(3, "revolute", bending_stiffness=stiffness, kelvin_voigt=1e-5))


@pytest.mark.parametrize(("frequency", "ratio"), [(0.4, 0.7), (1.5, 0.2)])
@pytest.mark.parametrize("integrator", ["exponential", "rk4"])
def test_a_rigid_arm_swings_as_it_is_told(frequency: float, ratio: float, integrator: str) -> None:
    """theta = theta_0 exp(-zeta w t) (cos w_d t + zeta w / w_d sin w_d t), about the angle that was measured."""
    chain, angle = rigid(), 0.3
    recording = resting(chain, angle)
    feedback = EncoderFeedback.of(recording, chain, 1e-4, frequency, ratio)
    rest = np.zeros(chain.size)
    step = 2e-4 if integrator == "rk4" else None
    arm = Arm(chain).with_feedback(feedback)
    (steps,) = trajectories_of([arm], [recording], [rest], [rest], integrator, step)
    w, t = 2 * np.pi * frequency, steps.time
    swing = w * np.sqrt(1 - ratio**2)
    expected = angle * (1 - np.exp(-ratio * w * t) * (np.cos(swing * t) + ratio * w / swing * np.sin(swing * t)))
    assert np.abs(steps.q[:, 0] - expected).max() < 0.01 * angle


def test_its_stiffness_is_of_the_whole_arm_s_inertia() -> None:
    chain = rigid()
    feedback = EncoderFeedback.of(resting(chain, 0.0), chain, 1e-4, 1.0, 0.5)
    assert feedback is not None
    inertia = 0.02 + 0.44 / 3
    assert feedback.stiffness[0] == pytest.approx((2 * np.pi) ** 2 * inertia, rel=0.01)
    assert feedback.damping[0] == pytest.approx(2 * np.pi * inertia, rel=0.01)


def driven(chain: Chain, seed: int = 3) -> tuple[Recording, Array]:
    """A recording in which the chain itself was seen, from rest, and its angles (T, n_a)."""
    recording = recording_of(chain, np.arange(401) / 200, jerky_torque(chain.active.size, seed, 0.1))
    rest = np.zeros(chain.size)
    steps = simulate_trajectories([Arm(chain)], [recording], [rest], [rest])[0]
    theta = np.stack([np.interp(recording.time, steps.time, each) for each in steps.q[:, chain.active].T], axis=-1)
    return replace(recording, theta=theta), theta


@pytest.mark.parametrize("arm", ["hub", "two links"])
def test_a_right_model_moves_as_it_would_alone(arm: str) -> None:
    chain = arm_of(steel_link(3, "revolute")) if arm == "hub" else two_link_arm()
    recording, theta = driven(chain)
    feedback = EncoderFeedback.of(recording, chain, 1e-5, 1.5, 0.7)
    rest = np.zeros(chain.size)
    found = simulate_trajectories([Arm(chain).with_feedback(feedback)], [recording], [rest], [rest])[0]
    away = np.stack([np.interp(recording.time, found.time, each) for each in found.q[:, chain.active].T], axis=-1)
    assert np.abs(away - theta).max() < 2e-3 * np.abs(theta).max()


def test_a_wrong_model_stays_near() -> None:
    """Half as much inertia on the hub is soon far off alone."""
    chain = arm_of(steel_link(3, "revolute", hub_inertia=0.2))
    recording, theta = driven(chain)
    wrong = arm_of(steel_link(3, "revolute", hub_inertia=0.1))
    feedback = EncoderFeedback.of(recording, wrong, 1e-5, 1.5, 0.7)
    rest = np.zeros(chain.size)
    arms = [Arm(wrong), Arm(wrong).with_feedback(feedback)]
    free, held = simulate_trajectories(arms, [recording] * 2, [rest] * 2, [rest] * 2)
    off = [np.abs(np.interp(recording.time, each.time, each.q[:, 0]) - theta[:, 0]).max() for each in (free, held)]
    assert off[1] < 0.2 * off[0]


def test_copies_are_held_each_by_its_own() -> None:
    """Together or one by one; one of them is held by nothing; their recordings differ in length."""
    chain = rigid(2.0)
    recordings = [resting(chain, 0.2), resting(chain, -0.1, 2.5), resting(chain, 0.3)]
    feedbacks = [
        EncoderFeedback.of(recordings[0], chain, 1e-4, 1.0, 0.7),
        EncoderFeedback.of(recordings[1], chain, 1e-4, 0.5, 0.2),
        None,
    ]
    arms = [Arm(chain).with_feedback(feedback) for feedback in feedbacks]
    rest = np.zeros(chain.size)
    together = simulate_trajectories(arms, recordings, [rest] * 3, [rest] * 3)
    for arm, recording, found in zip(arms, recordings, together, strict=True):
        alone = simulate_trajectories([arm], [recording], [rest], [rest])[0]
        rows = min(len(alone.q), len(found.q))
        assert np.abs(alone.q[:rows] - found.q[:rows]).max() < 1e-9
    assert np.abs(together[2].q).max() == 0.0


def test_it_draws_to_where_the_encoder_would_show_the_angle() -> None:
    chain, offset = rigid(20.0), 0.05
    recording = resting(chain, 0.3, 4.0)
    feedback = EncoderFeedback.of(recording, chain, 1e-4, 1.0, 0.7)
    arm = Arm.of(chain, (EncoderOffset(link=0, offset=offset),)).with_feedback(feedback)
    rest = np.zeros(chain.size)
    steps = simulate_trajectories([arm], [recording], [rest], [rest])[0]
    assert steps.q[-1, 0] == pytest.approx(0.3 - offset, abs=1e-4)
    angle, rate = arm.read_encoders(np.array([[0.1], [0.2]]), np.array([[1.0], [-2.0]]))
    assert angle == pytest.approx(np.array([[0.15], [0.25]]))
    assert rate == pytest.approx(np.array([[1.0], [-2.0]]))


def test_angles_that_were_not_measured_are_drawn_between() -> None:
    chain = rigid()
    recording, theta = driven(chain)
    holes = recording.theta.copy()
    holes[100:106] = np.nan
    whole, broken = (
        EncoderFeedback.of(replace(recording, theta=each), chain, 1e-5, 1.0, 0.7) for each in (recording.theta, holes)
    )
    assert whole is not None
    assert broken is not None
    assert np.abs(whole.theta - broken.theta).max() < 0.01 * np.ptp(theta)


def test_nothing_is_held_without_angles() -> None:
    clamped, hub = arm_of(steel_link(3)), rigid()
    assert EncoderFeedback.of(resting(clamped, 0.0), clamped, 1e-4, 1.0, 0.7) is None
    unseen = recording_of(hub, np.arange(401) / 200)
    assert EncoderFeedback.of(unseen, hub, 1e-4, 1.0, 0.7) is None


def run_of(chain: Chain, observed: Observations, state: Array) -> Run:
    return simulate_runs(
        [Arm(chain)], [observed], [InitialStatePrior.of(Arm(chain), observed.recording)], [state], 1.0
    )[0]


def test_derivatives_know_of_it() -> None:
    """By the hub's inertia and the initial state, against simulations from moved ones."""
    chain = arm_of(steel_link(3, "revolute"))
    recording, _ = driven(arm_of(steel_link(3, "revolute", hub_inertia=0.03)))
    recording = replace(recording, markers=np.zeros(recording.markers.shape))
    observed = Observations.of(rig_of(chain), recording, NOISE)
    observed = replace(observed, feedback=EncoderFeedback.of(recording, chain, 1e-5, 1.5, 0.7))
    state, by = np.zeros(2 * chain.size), 1e-5

    def heavier(share: float) -> Chain:
        link = chain.links[0]
        return arm_of(replace(link, hub_inertia=link.hub_inertia * (1 + share)))

    run = run_of(chain, observed, state)
    ((_, found),) = run.slopes([PerturbedArm(Arm(heavier(by)), by)])
    directions = [*run.basis.states.T]
    moved = [
        (run_of(chain, observed, state + by * each), run_of(chain, observed, state - by * each)) for each in directions
    ]
    moved.append((run_of(heavier(by), observed, state), run_of(heavier(-by), observed, state)))
    expected = np.stack([(behind.residual - ahead.residual) / (2 * by) for ahead, behind in moved], axis=1)
    lengths = np.linalg.norm(expected, axis=0)
    errors = np.linalg.norm(found - expected, axis=0) / lengths
    assert errors[lengths > 0.05 * lengths.max()].max() < 0.05
    assert errors[-1] < 0.05  # by the hub's inertia
