"""Initial states beside what sticks or rattles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.diagnosis.rigs import NOISE, RIG, chain_of
from vjm.chain.virtual_links import Array
from vjm.effects import Backlash, CoulombFriction, Effect, ViscousFriction
from vjm.records import Kind, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import _state_at_rest, backtrack, fit_initial_states, simulate_from_best_states
from vjm.simulation.measurement import MarkerArcs, Observations
from vjm.simulation.run import InitialStatePrior, Run, simulate_runs
from vjm.simulation.system import Trajectory

GAP, ANGLE = 0.004, 0.3
PLAY = Arm.of(chain_of(), [Backlash(link=0, gap=GAP)])
STUCK = Arm.of(chain_of(), [CoulombFriction(link=0, torque=0.008)])


def seen_at(arm: Arm, q: Array, seed: int, kind: Kind = "quiet") -> Observations:
    """What camera and encoder show of an arm that does not move."""
    time = np.arange(401) / 200
    random = np.random.default_rng(seed)
    markers = MarkerArcs.of(RIG).positions_in_frames(arm, Trajectory.at_rest(time, q), time)
    markers = markers + NOISE[0] * random.standard_normal(markers.shape)
    theta = q[arm.chain.active] + NOISE[1] * random.standard_normal((time.size, 1))
    return Observations.of(
        RIG, Recording(time, markers, theta, np.zeros((401, 1)), kind=kind, role="train", file=f"{kind}.csv"), NOISE
    )


def stands(arm: Arm, twist: float = 0.0) -> Array:
    """Angles of a straight link on a turned joint, and on a hub that is turned against its motor."""
    q = np.zeros(arm.chain.size)
    q[arm.chain.active] = ANGLE
    q[arm.chain.roots] = twist
    return q


def runs_of(arm: Arm, observed: Observations, state: Array, known: Array) -> Run:
    return simulate_from_best_states(
        [arm], [observed], [InitialStatePrior.of(arm, observed.recording)], [state], [known], 1.0
    )[0]


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
@pytest.mark.parametrize("twist", [-0.002, 0.0, 0.0013])
def test_a_loose_hub_stands_where_it_is_seen(seed: int, twist: float) -> None:
    observed = seen_at(PLAY, stands(PLAY, twist), seed)
    found = _state_at_rest(PLAY, observed, InitialStatePrior.of(PLAY, observed.recording))
    q, v = np.split(found, 2)
    assert not v.any()
    assert q[PLAY.chain.roots] == pytest.approx(twist, abs=4e-5)  # 0.3 mm over 400 frames of five markers
    assert q[PLAY.chain.active] == pytest.approx(ANGLE, abs=4e-5)
    run = runs_of(PLAY, observed, found, found)
    assert run.chi2 == pytest.approx(observed.count, rel=0.06)


def test_it_stands_on_a_flank_where_it_is_seen_beyond() -> None:
    observed = seen_at(PLAY, stands(PLAY, 1.2 * GAP / 2), 1)
    found = _state_at_rest(PLAY, observed, InitialStatePrior.of(PLAY, observed.recording))
    assert found[PLAY.chain.roots] == pytest.approx(GAP / 2, abs=1e-12)


@pytest.mark.parametrize("arm", [PLAY, STUCK], ids=["play", "friction"])
def test_a_shaken_state_is_left_for_one_that_stands(arm: Arm) -> None:
    observed = seen_at(arm, stands(arm), 4)
    shaken = np.concatenate([stands(arm), np.zeros(arm.chain.size)])
    shaken[arm.chain.size] = 0.2
    run = runs_of(arm, observed, shaken, shaken)
    assert run.chi2 == pytest.approx(observed.count, rel=0.06)
    driven = seen_at(arm, stands(arm), 4, "driven")
    assert runs_of(arm, driven, shaken, shaken).state is shaken


def test_what_was_known_before_is_kept_where_it_is_better() -> None:
    """An arm that really moves, slowly, though its recording is called quiet."""
    time = np.arange(401) / 200
    moving = np.concatenate([stands(STUCK), np.zeros(STUCK.chain.size)])
    moving[STUCK.chain.size] = 0.5
    blank = seen_at(STUCK, stands(STUCK), 5)
    free = runs_of(STUCK, replace(blank, recording=replace(blank.recording, kind="driven")), moving, moving)
    markers = MarkerArcs.of(RIG).positions_in_frames(STUCK, free.trajectory, time)
    theta = free.trajectory.angles(free.observed.recording.time)[:, STUCK.chain.active]
    observed = Observations.of(RIG, replace(blank.recording, markers=markers, theta=theta), NOISE)
    rest = np.concatenate([stands(STUCK), np.zeros(STUCK.chain.size)])
    assert runs_of(STUCK, observed, rest, moving).state is moving


def test_a_smooth_arm_begins_as_it_is_told() -> None:
    arm = Arm(chain_of())
    observed = seen_at(arm, stands(arm), 6)
    shaken = np.concatenate([stands(arm), np.zeros(arm.chain.size)])
    shaken[arm.chain.size] = 0.2
    assert runs_of(arm, observed, shaken, np.zeros(shaken.size)).state is shaken


def test_effects_say_where_an_arm_stays() -> None:
    effects: list[Effect] = [CoulombFriction(link=0, torque=0.008), Backlash(link=0, gap=GAP)]
    arm = Arm.of(chain_of(), effects)
    q = np.random.default_rng(7).normal(size=(5, arm.chain.size))
    found = arm.rest_angles(q)
    others = np.delete(np.arange(arm.chain.size), arm.chain.roots)
    assert np.array_equal(found[:, others], q[:, others])
    assert found[:, arm.chain.roots] == pytest.approx(np.clip(q[:, arm.chain.roots], -GAP / 2, GAP / 2))


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
def test_a_recording_begins_with_as_much_of_a_change_as_follows_it_best(share: float) -> None:
    state = np.concatenate([stands(STUCK), np.zeros(STUCK.chain.size)])
    state[STUCK.chain.size] = 0.5
    change = np.zeros(state.size)
    change[STUCK.chain.size :] = 0.1
    blank = seen_at(STUCK, stands(STUCK), 6, "driven")
    start = InitialStatePrior.of(STUCK, blank.recording)
    true = simulate_runs([STUCK], [blank], [start], [state + share * change], 1.0)[0]
    markers = MarkerArcs.of(RIG).positions_in_frames(STUCK, true.trajectory, blank.recording.time)
    theta = true.trajectory.angles(true.observed.recording.time)[:, STUCK.chain.active]
    observed = Observations.of(RIG, replace(blank.recording, markers=markers, theta=theta), NOISE)
    whole = simulate_runs([STUCK], [observed], [start], [state + change], 1.0)[0]
    found = backtrack([whole], [change], 1.0)[0]
    assert found.state == pytest.approx(state + share * change, abs=1e-12)
    assert (found is whole) == (share == 1.0)


@pytest.mark.parametrize("effect", [CoulombFriction(link=0, torque=0.008), ViscousFriction(link=0, coefficient=0.02)])
def test_only_what_sticks_is_left_after_a_few_steps_in_vain(monkeypatch: pytest.MonkeyPatch, effect: Effect) -> None:
    arm = Arm.of(chain_of(), [effect])
    observed = seen_at(arm, stands(arm), 7, "driven")
    moving = np.concatenate([stands(arm), np.full(arm.chain.size, 0.05)])
    tried = []
    monkeypatch.setattr(
        "vjm.simulation.initial_state._trial_runs", lambda pending, step_multiple: tried.append(0) or [None]
    )
    ((run, _),) = fit_initial_states([arm], [observed], [moving])
    assert run.state is moving
    assert (len(tried) == 4) == effect.nonsmooth
