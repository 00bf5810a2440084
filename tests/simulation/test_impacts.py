"""Motions of joints that come to the flanks of their gaps and leave them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.simulation.integrators import followed_events
from tests.simulation.setups import arm_of, jerky_torque, recording_of, steel_link, two_link_arm
from vjm.effects import Backlash, CoulombFriction, Effect, ViscoelasticCreep
from vjm.records import Recording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import default_step, simulate_trajectories
from vjm.simulation.system import Trajectory

Array = NDArray[np.float64]
CHAIN = arm_of(steel_link(4, "revolute"))
PLAY = Backlash(link=0, gap=0.004, motor_share=0.4)


def moved(arm: Arm, recording: Recording, step: float | None = None, copies: int = 1) -> Trajectory:
    rest = [np.zeros(arm.chain.size)] * copies
    return simulate_trajectories([arm] * copies, [recording] * copies, rest, rest, step)[-1]


def jerked(arm: Arm, seed: int, duration: float = 0.4, interval: float = 0.001) -> Recording:
    count = round(duration / interval)
    return recording_of(arm.chain, interval * np.arange(count + 1), jerky_torque(arm.chain.active.size, seed))


@pytest.mark.parametrize(("stiffness", "most"), [(100.0, 2e-5), (1000.0, 2e-5), (10000.0, 6e-5)])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_motions_are_those_from_event_to_event(stiffness: float, most: float, seed: int) -> None:
    """At every millisecond, in which a joint may come to a flank and leave it, or vibrate in contact."""
    play = Backlash(link=0, gap=0.004, motor_share=0.4, flank_stiffness=stiffness, flank_damping=0.5)
    arm = Arm.of(CHAIN, (play,))
    recording, step = jerked(arm, seed), default_step(CHAIN)
    expected = followed_events(arm, recording)
    found = moved(arm, recording)
    assert found.impacts is not None
    assert found.impacts.instants.size > 2
    assert found.angles(recording.time) == pytest.approx(expected, abs=most)
    assert moved(arm, recording, step / 4).angles(recording.time) == pytest.approx(expected, abs=most / 10)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_gaps_of_two_joints_are_followed(seed: int) -> None:
    plays = Backlash(link=0, gap=0.004), Backlash(link=1, gap=0.01, motor_share=0.3)
    arm = Arm.of(two_link_arm(), plays)
    recording = jerked(arm, seed, duration=0.2)
    found, expected = moved(arm, recording), followed_events(arm, recording)
    assert found.impacts is not None
    assert {*found.impacts.contacts.tolist()} == {0, 1}
    assert found.angles(recording.time) == pytest.approx(expected, abs=2e-5)


BESIDE: dict[str, tuple[Effect, ...]] = {
    "dry friction": (CoulombFriction(link=0, torque=0.02),),
    "creep": (ViscoelasticCreep(link=0, ratio=0.1, time_constant=0.05),),
}


@pytest.mark.parametrize("beside", BESIDE)
def test_motions_beside_other_effects_do_not_depend_on_the_step(beside: str) -> None:
    arm = Arm.of(CHAIN, (PLAY, *BESIDE[beside]))
    recording = jerked(arm, 1)
    step = min(default_step(arm.chain), arm.longest_step)
    fine = moved(arm, recording, step / 16).angles(recording.time)
    assert moved(arm, recording, step).angles(recording.time) == pytest.approx(fine, abs=2e-5)


def test_copies_move_as_each_alone() -> None:
    arms = [Arm.of(CHAIN, (Backlash(link=0, gap=gap, motor_share=0.4),)) for gap in (0.002, 0.004, 0.01)]
    recordings = [jerked(arm, seed, 0.3 + 0.05 * seed) for seed, arm in enumerate(arms)]
    rest = [np.zeros(arm.chain.size) for arm in arms]
    together = simulate_trajectories(arms, recordings, rest, rest, step=0.003)
    for arm, recording, found in zip(arms, recordings, together, strict=True):
        alone = moved(arm, recording, 0.003)
        assert found.q == pytest.approx(alone.q, abs=1e-9)
        assert found.impacts is not None
        assert alone.impacts is not None
        assert found.impacts.instants == pytest.approx(alone.impacts.instants, abs=1e-6)
        assert found.impacts.met.tolist() == alone.impacts.met.tolist()
        assert (found.impacts.path.time <= found.time[-1] + 1e-12).all()


def test_steps_may_be_far_longer_than_a_contact() -> None:
    """A contact's whole period is in a step, in which the joint comes to a flank, rebounds and leaves it."""
    arm = Arm.of(CHAIN, (Backlash(link=0, gap=0.004, motor_share=0.4, flank_stiffness=10000.0, flank_damping=0.5),))
    recording, step = jerked(arm, 0), default_step(CHAIN)
    found = moved(arm, recording)
    assert found.step == pytest.approx(step, rel=0.1)
    assert found.impacts is not None
    steps = found.impacts.instants.astype(int)
    assert np.unique(steps).size < steps.size
    assert np.diff(found.impacts.instants).min() > 0.0


@pytest.mark.parametrize("kelvin_voigt", [0.03, 0.3])
def test_an_overdamped_link_takes_no_more_steps(kelvin_voigt: float) -> None:
    """Its fastest modes decay in a hundredth of a step and less, which is no reason to follow them."""
    play = Backlash(link=0, gap=0.004, motor_share=0.4, flank_stiffness=1000.0, flank_damping=0.5)
    arms = [
        Arm.of(arm_of(steel_link(4, "revolute", kelvin_voigt=constant)), (play,)) for constant in (3e-4, kelvin_voigt)
    ]
    recording = jerked(arms[0], 0)
    found = [moved(arm, recording, default_step(CHAIN)) for arm in arms]
    assert found[1].angles(recording.time) == pytest.approx(followed_events(arms[1], recording), abs=2e-5)
    steps_an_event = []
    for motion in found:
        assert motion.impacts is not None
        steps_an_event.append(motion.impacts.path.time.size / motion.impacts.instants.size)
    assert steps_an_event[1] < 3 * steps_an_event[0]


@pytest.mark.parametrize(("stiffness", "damping"), [(1e8, 0.5), (1e6, 1e3), (1e2, 1e3)])
def test_flanks_may_be_as_stiff_and_damped_as_a_search_tries(stiffness: float, damping: float) -> None:
    play = Backlash(link=0, gap=0.004, motor_share=0.4, flank_stiffness=stiffness, flank_damping=damping)
    arm = Arm.of(CHAIN, (play,))
    recording = jerked(arm, 1, duration=0.2)  # errors grow with every rebound
    found, fine = (moved(arm, recording, default_step(CHAIN) / division).angles(recording.time) for division in (1, 4))
    assert found == pytest.approx(fine, abs=2e-5)


def test_a_flank_that_is_followed_out_of_and_into_again_is_not_met() -> None:
    """The joint leaves faster than the flank springs back, is pushed, and is touched again while it is still in."""
    arm = Arm.of(CHAIN, (PLAY,))
    (contact,) = arm.contacts
    q, v = np.zeros((2, arm.chain.size))
    q[contact.joint], v[contact.joint] = contact.gap / 2 + 2e-4, -0.2
    recording = recording_of(arm.chain, np.arange(51) / 1000.0, lambda time: np.full((time.size, 1), -4.0))
    (found,) = simulate_trajectories([arm], [recording], [q], [v])
    assert found.impacts is not None
    assert not found.impacts.touching.any()
    began = found.time[0] + found.step * found.impacts.instants[0]
    turn, rate = (each[contact.joint] for each in found.sample(began))
    assert contact.depth(turn) > 1e-6
    assert contact.resistance(turn, rate) == pytest.approx(0.0, abs=1e-6)
    assert not found.impacts.met[0]
