"""What drives a simulation, what it refuses, and how it says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.simulation.integrators import simulate, trajectories_of
from tests.simulation.setups import (
    arm_of,
    end_load_shape,
    jerky_torque,
    recording_of,
    rig_of,
    rollout,
    steel_link,
    two_link_arm,
)
from vjm.chain.curve import marker_poses
from vjm.chain.virtual_links import Chain
from vjm.effects import RollingShutter
from vjm.errors import InputError, InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.records import Recording
from vjm.simulation.arm import Arm
from vjm.simulation.measurement import MarkerArcs

Array = NDArray[np.float64]
HUB = arm_of(steel_link(3, "revolute"))


def tip(chain: Chain, recording: Recording, integrator: str = "exponential", step: float | None = None) -> Array:
    """Path of the tip from straight rest, (T, 2)."""
    rest = np.zeros(chain.size)
    return simulate(chain, rig_of(chain), recording, rest, rest, integrator, step).markers[:, -1]


def test_simulation_starts_where_it_is_told_and_shows_the_chain_s_markers() -> None:
    chain = two_link_arm()
    recording = recording_of(chain, 2.5 + np.arange(41) / 40.0, jerky_torque(2, 1))
    rng = np.random.default_rng(2)
    q, v = rng.normal(0, 0.1, chain.size), rng.normal(0, 0.5, chain.size)
    rig = rig_of(chain)
    rig = replace(rig, links=(rig.links[0], replace(rig.links[1], markers_frame="link")))
    found = simulate(chain, rig, recording, q, v)
    np.testing.assert_array_equal(found.time, recording.time)
    np.testing.assert_allclose(found.q[0], q, atol=1e-14)
    np.testing.assert_allclose(found.v[0], v, atol=1e-12)
    np.testing.assert_array_equal(found.theta, found.q[:, [0, 4]])
    arcs = tuple(np.array(link.markers) for link in rig.links)
    np.testing.assert_array_equal(found.markers, marker_poses(chain, found.q, arcs, (False, True))[0])


def test_rows_that_are_read_one_after_another_show_each_marker_where_it_is_when_its_row_is_read() -> None:
    """Not where it is at the time stamp: the arm turns by a centimetre meanwhile."""
    time = np.arange(20, 201) / 100.0
    torque = jerky_torque(1, 3)
    rest = np.zeros(HUB.size)
    (motion,) = trajectories_of([Arm(HUB)], [recording_of(HUB, np.arange(301) / 100.0, torque)], [rest], [rest])
    arcs, arm = MarkerArcs.of(rig_of(HUB)), Arm.of(HUB, [RollingShutter(readout=0.02, direction=1.1)])
    shown, exposures = arcs.positions_in_frames(arm, motion, time), arcs.exposure_times(arm, motion, time)
    way = (np.exp(-1.1j) * (shown @ [1, 1j])).imag
    np.testing.assert_allclose(exposures, (time[:, None] - 0.02 * way).T, atol=1e-6)
    for marker, instants in enumerate(exposures):
        np.testing.assert_allclose(
            shown[:, marker], arcs.positions(HUB, motion.angles(instants))[:, marker], atol=1e-12
        )
    assert np.abs(shown - arcs.positions(HUB, motion.angles(time))).max() > 0.01


def test_time_may_start_anywhere() -> None:
    time = np.arange(101) / 100.0
    torque = jerky_torque(1, 3)(time)
    early = tip(HUB, recording_of(HUB, time, lambda _: torque))
    late = tip(HUB, recording_of(HUB, time + 1e4, lambda _: torque))
    np.testing.assert_allclose(late, early, atol=1e-8)


# Torque


def test_torque_is_linear_between_irregular_samples() -> None:
    """The same broken line, told by few irregular samples or by many."""
    rng = np.random.default_rng(4)
    few = np.unique(np.r_[0.0, rng.uniform(0.0, 2.0, 60).round(2), 2.0])
    values = rng.normal(0.0, 0.15, (few.size, 1))
    many = np.arange(1001) / 500.0
    exact = tip(HUB, recording_of(HUB, many, lambda t: np.interp(t, few, values[:, 0])[:, None]), "rk4", 2e-4)
    at_few = np.searchsorted(many, few - 1e-9)
    np.testing.assert_allclose(tip(HUB, recording_of(HUB, few, lambda _: values), step=1e-3), exact[at_few], atol=1e-6)


def test_rows_without_torque_are_bridged() -> None:
    """Camera frames between the encoder's samples have no torque of their own."""
    time = np.arange(501) / 500.0
    recording = recording_of(HUB, time, lambda t: 0.3 * np.sin(5 * t)[:, None])
    merged = np.union1d(time, np.arange(30) / 30.0)
    torque = np.full((merged.size, 1), np.nan)
    torque[np.isin(merged, time)] = recording.tau
    path = tip(HUB, recording_of(HUB, merged, lambda _: torque))
    np.testing.assert_allclose(path[np.isin(merged, time)], tip(HUB, recording), atol=1e-9)


def test_torque_of_either_joint_alone_is_not_enough() -> None:
    chain = two_link_arm()
    time = np.arange(21) / 20.0
    torque = np.zeros((21, 2))
    torque[:, 1] = np.nan
    with pytest.raises(InsufficientDataError, match=r"made\.csv.*torque") as caught:
        tip(chain, recording_of(chain, time, lambda _: torque))
    assert isinstance(caught.value, InputError)


def test_missing_torque_is_said() -> None:
    with pytest.raises(InsufficientDataError) as caught:
        tip(HUB, recording_of(HUB, np.arange(21) / 20.0, lambda t: np.full((t.size, 1), np.nan)))
    assert "tau" in caught.value.remedy


def test_a_clamped_link_needs_no_torque() -> None:
    chain = arm_of(steel_link(3))
    np.testing.assert_array_equal(tip(chain, recording_of(chain, np.arange(21) / 20.0))[:, 1], 0.0)


# What cannot be done


@pytest.mark.parametrize("step", [0.0, -1e-3, np.inf, np.nan])
def test_absurd_steps_are_refused(step: float) -> None:
    with pytest.raises(ShapeError):
        tip(HUB, recording_of(HUB, np.arange(21) / 20.0), step=step)


def test_a_recording_too_long_for_so_stiff_an_arm_is_named() -> None:
    chain = arm_of(steel_link(3, bending_stiffness=1e17))
    with pytest.raises(InsufficientDataError, match=r"simulation of made\.csv: its 1 s are .* steps.* Hz"):
        tip(chain, recording_of(chain, np.arange(21) / 20.0))


def test_divergence_is_said_with_its_time_and_remedy() -> None:
    chain = arm_of(steel_link(8))
    recording = recording_of(chain, 3.0 + np.arange(41) / 4.0)
    start = end_load_shape(chain, 0.1)
    with pytest.raises(SimulationDivergedError) as caught:
        simulate(chain, rig_of(chain), recording, 40 * start, 0 * start, step=0.1)
    assert 3.0 <= caught.value.time < 13.0
    assert caught.value.step == pytest.approx(0.1)
    assert caught.value.remedy


@pytest.mark.parametrize("chain", [arm_of(steel_link(2)), two_link_arm()], ids=["clamped", "two links"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_a_state_that_is_no_number_is_divergence(chain: Chain, value: float) -> None:
    """Nor are the matrices of an arm with an elbow, whose inertia depends on its angle."""
    q = np.full((1, chain.size), value)
    with pytest.raises(SimulationDivergedError), np.errstate(invalid="ignore", over="ignore"):
        rollout([chain], recording_of(chain, np.arange(21) / 20.0), q, 0.0 * np.ones(q.shape))


def test_a_single_instant_is_its_initial_state() -> None:
    chain = arm_of(steel_link(2))
    q, v = rollout([chain], recording_of(chain, np.array([0.5])), [[0.1, 0.2]], [[3.0, 4.0]])
    np.testing.assert_allclose(q, [[[0.1, 0.2]]])
    np.testing.assert_allclose(v, [[[3.0, 4.0]]])
