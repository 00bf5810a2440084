"""Segments of recordings, each simulated from a state of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.diagnosis.rigs import NOISE, RIG, chain_of, recorded
from vjm.effects import (
    BaseCompliance,
    ClampCompliance,
    ClockScale,
    Effect,
    ExternalTone,
    Hysteresis,
    StiffnessDrift,
    TimeOffset,
    TipPayload,
    TorqueGain,
    ViscoelasticCreep,
)
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import Observations, PrecedingMotions
from vjm.simulation.run import Run, linearize, linearize_by_states, simulate_runs
from vjm.simulation.system import torque_at
from vjm.simulation.variational_equations import PerturbedArm

TIMED = (
    (),
    (StiffnessDrift(link=0, rate=-0.05),),
    (ExternalTone(link=0, amplitude=0.01, frequency=1.7, phase=0.4),),
    (ClockScale(scale=1.01),),
    (TimeOffset(delay=0.01),),
)


def run_of(arm: Arm, observed: Observations, state: np.ndarray) -> Run:
    return simulate_runs([arm], [observed], None, [state], 0.5)[0]


def parts_of(effects: Sequence[Effect]) -> tuple[Run, list[Run]]:
    """A recording, and its segments from the states of the whole at their beginnings."""
    arm = Arm.of(chain_of(), effects)
    observed = Observations.of(RIG, recorded(arm, 1)[1], NOISE)
    whole = run_of(arm, observed, np.zeros(2 * arm.chain.size))
    parts = []
    for part in observed.segments(0.5, 0.05):
        q, v = whole.trajectory.sample(part.recording.time[:1])
        parts.append(run_of(arm, part, np.concatenate([q[0], v[0]])))
    return whole, parts


@pytest.mark.parametrize("effects", TIMED, ids=lambda effects: effects[0].id if effects else "nothing")
def test_segments_from_the_states_of_the_whole_predict_what_it_predicts(effects: tuple[Effect, ...]) -> None:
    """Effects count time from where the recording began, not from where a segment does."""
    whole, parts = parts_of(effects)
    assert len(parts) == 4
    assert sum(part.observed.count for part in parts) == whole.observed.count
    assert sum(part.chi2 for part in parts) == pytest.approx(whole.chi2, rel=2e-3)


def test_segments_are_driven_as_the_whole_is_though_its_torque_is_sampled_slowly() -> None:
    """In some segments no torque was measured."""
    recording = recorded(Arm(chain_of()), 1)[0]
    slow = np.where(np.arange(recording.time.size)[:, None] % 70 == 0, recording.tau, np.nan)
    whole = replace(recording, tau=slow)
    parts = Observations.of(RIG, whole, NOISE).segments(0.2, 0.02)
    assert min(np.isfinite(slow[np.isin(whole.time, part.recording.time)]).sum() for part in parts) == 0
    for part in parts:
        time = part.recording.time
        np.testing.assert_allclose(torque_at(part.recording, time), torque_at(whole, time), atol=1e-15)


@pytest.mark.parametrize("effects", TIMED[1:], ids=lambda effects: effects[0].id)
def test_derivatives_in_segments_are_those_of_differences(effects: tuple[Effect, ...]) -> None:
    """Two routes to what a size does in the last segment: variational equations, and simulations."""
    _, parts = parts_of(effects)
    last, (effect,) = parts[-1], effects
    coordinates = effect.coordinates.copy()
    step = 1e-4 * max(abs(coordinates[0]), 1.0)
    coordinates[0] += step
    other = Arm.of(chain_of(), (effect.at(coordinates),))
    moved = run_of(other, last.observed, last.state)
    slopes = np.empty(last.observed.count)
    for measured, part in last.jacobian(last.linearization([PerturbedArm(other, step)])):
        slopes[measured] = part[:, -1]
    expected = (last.residual - moved.residual) / step
    assert np.linalg.norm(slopes - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize(
    "beside", [(), (Hysteresis(link=0, ratio=0.05, yield_angle=0.02),)], ids=["none", "hysteresis"]
)
def test_segments_are_linearised_together_as_each_alone(beside: tuple[Effect, ...]) -> None:
    """With forces, torques, sensors and internal states that the arm has not."""
    _, parts = parts_of(beside)
    absent = (
        StiffnessDrift(link=0, rate=0.01),
        TorqueGain(link=0, gain=1.1),
        TipPayload(link=0, mass=0.01),
        TimeOffset(delay=0.001),
        ViscoelasticCreep(link=0, ratio=0.05, time_constant=0.1),
        ClampCompliance(link=0, compliance=1e-5),
        BaseCompliance(stiffness=1e6, mass=1e3),
    )
    moved = [PerturbedArm(Arm.of(chain_of(), (*beside, effect)), 0.1) for effect in absent]
    together = list(linearize(parts, [moved] * len(parts)))
    assert len(parts) > 2
    assert all(each.known is not None for each in together)
    for part, linearization in zip(parts, together, strict=True):
        found, alone = part.linearized(linearization).R, part.linearized(part.linearization(moved)).R
        scale = np.linalg.norm(alone, axis=0)
        np.testing.assert_allclose((found / scale).T @ (found / scale), (alone / scale).T @ (alone / scale), atol=1e-7)


def test_initial_states_of_segments_are_linearised_together_as_each_alone() -> None:
    _, parts = parts_of(())
    alone = [part.linearized(part.linearization()).R for part in parts]
    linearize_by_states(parts)
    for part, expected in zip(parts, alone, strict=True):
        found, scale = part.linearized_by_state.R, np.linalg.norm(expected, axis=0)
        np.testing.assert_allclose(
            (found / scale).T @ (found / scale), (expected / scale).T @ (expected / scale), atol=1e-7
        )


@settings(max_examples=40, deadline=None)
@given(st.floats(0.05, 5.0), st.floats(0.0, 0.3))
def test_every_value_is_in_exactly_one_segment(duration: float, margin: float) -> None:
    observed = Observations.of(RIG, recorded(Arm(chain_of()), 1)[0], NOISE)
    parts = observed.segments(duration, margin)
    markers = np.concatenate([part.values[: part.marker_indices.size] for part in parts])
    angles = np.concatenate([part.values[part.marker_indices.size :] for part in parts])
    assert np.array_equal(np.concatenate([markers, angles]), observed.values)
    for part in parts:
        time = part.recording.time[np.unique(part.instants)]
        assert part.recording.time[0] <= max(time[0] - margin, observed.recording.time[0]) + 0.006
        assert part.began == observed.began
        grids = part.on_grid(part.values)
        measured = np.concatenate([grid[np.isfinite(grid)] for grid in grids])
        assert np.array_equal(np.sort(measured), np.sort(part.values))


REMEMBERING = (
    ViscoelasticCreep(link=0, ratio=0.05, time_constant=0.1),
    Hysteresis(link=0, ratio=0.05, yield_angle=0.02),
)


@pytest.mark.parametrize("effect", REMEMBERING, ids=lambda effect: effect.id)
def test_effects_with_a_memory_remember_the_motion_before_a_segment(effect: Effect) -> None:
    whole, parts = parts_of((effect,))
    path = whole.trajectory
    forgetful = sum(part.chi2 for part in parts)
    remembering = 0.0
    # Beside a shorter recording and a longer one, which are followed together.
    shorter = np.arange(3.0), path.q[:3], path.v[:3]
    longer = np.r_[path.elapsed(path.time), 10.0], np.r_[path.q, path.q[:1]], np.r_[path.v, path.v[:1]]
    own = {whole.observed.recording.file: (path.elapsed(path.time), path.q, path.v)}
    preceding = PrecedingMotions.of(whole.chain, {"shorter": shorter, **own, "longer": longer})
    for part in parts:
        observed = replace(part.observed, preceding=preceding)
        remembering += run_of(part.arm, observed, part.state).chi2
    assert abs(remembering - whole.chi2) < 0.1 * (forgetful - whole.chi2)


def test_a_memory_follows_the_angles_where_rates_do_not_add_up_to_them() -> None:
    """From one segment to the next the angles jump, by what their initial states are off."""
    arm = Arm.of(chain_of(), (ViscoelasticCreep(link=0, ratio=0.05, time_constant=1e6),))
    time, random = np.linspace(0.0, 1.0, 101), np.random.default_rng(3)
    q, v = np.cumsum(random.normal(0, 1e-3, (2, time.size, arm.chain.size)), axis=1)
    z = arm.follow(time, q, v)
    assert z == pytest.approx((q - q[0])[:, arm.effects[0].virtual_joints(arm.chain)], abs=1e-6)


@pytest.mark.parametrize("frames", [51, 1001])
def test_what_relaxes_between_two_instants_is_followed(frames: int) -> None:
    """Elements that relax in a tenth of a frame, or less, are deflected as dampers are: by rate times time constant."""
    arm = Arm.of(chain_of(), (ViscoelasticCreep(link=0, ratio=0.05, time_constant=2e-4),))
    time = np.linspace(0.0, 2.0, frames)
    angle = 2 * np.pi * time[:, None] * np.ones(arm.chain.size)
    q, v = 0.1 * np.sin(angle), 0.2 * np.pi * np.cos(angle)
    z = arm.follow(time, q, v)
    part = arm.effects[0].virtual_joints(arm.chain)
    assert z[1:] == pytest.approx(2e-4 * v[1:, part], abs=0.05 * 2e-4 * 0.2 * np.pi)
