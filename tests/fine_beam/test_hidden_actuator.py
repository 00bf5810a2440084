"""Hidden actuators against rigid bodies, whose equations of motion are integrated by SciPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.fine_beam.arms import HUB, INERTIA, RIGID, TIME, alone, drive, rms
from tests.fine_beam.hidden import Physics
from tests.fine_beam.motion import Run

Array = NDArray[np.float64]


def rigid(torque: Callable[[float, Array], float], rates: Callable[[float, Array], float] | None = None) -> Array:
    """Angles (T,) of a rigid arm from rest under a torque by time and state (angle, rate, further one)."""

    def slope(t: float, y: Array) -> list[float]:
        return [y[1], torque(t, y) / INERTIA, 0.0 if rates is None else rates(t, y)]

    return np.asarray(solve_ivp(slope, (0.0, 1.0), [0.0, 0.0, 0.0], t_eval=TIME, rtol=1e-9, atol=1e-12).y[0])


def test_a_late_torque_is_the_first_order_lag_of_the_one_asked_for() -> None:
    motion = alone(RIGID, Physics(actuator_lag_time_constant=0.05), Run(0.3 * np.sin(6.0 * TIME)))
    late = rigid(lambda t, y: y[2], lambda t, y: (0.3 * np.sin(6.0 * t) - y[2]) / 0.05)
    np.testing.assert_allclose(motion.theta, late, atol=2e-5)
    assert np.abs(motion.theta - alone(RIGID, Physics(), Run(0.3 * np.sin(6.0 * TIME))).theta).max() > 1e-2


def test_a_lag_is_steady_where_a_recording_begins() -> None:
    physics = Physics(actuator_lag_time_constant=0.05, in_plane_gravity_gy=-0.3)
    held = alone(HUB, physics, Run(held=True))
    np.testing.assert_allclose(held.theta, 0.0, atol=1e-9)
    constant = alone(RIGID, Physics(actuator_lag_time_constant=0.05), Run(np.full(501, 0.02)))
    np.testing.assert_allclose(constant.theta, 0.5 * 0.02 / INERTIA * TIME**2, atol=1e-5)


def test_a_saturated_torque_is_clipped() -> None:
    motion = alone(RIGID, Physics(torque_saturation_limit=0.2), Run(0.3 * np.sin(6.0 * TIME)))
    clipped = rigid(lambda t, y: float(np.clip(0.3 * np.sin(6.0 * t), -0.2, 0.2)))
    np.testing.assert_allclose(motion.theta, clipped, atol=2e-5)
    high = alone(HUB, Physics(torque_saturation_limit=0.5), Run(drive(TIME)), step=1e-3)
    np.testing.assert_array_equal(high.theta, alone(HUB, Physics(), Run(drive(TIME)), step=1e-3).theta)


def test_dry_friction_is_not_what_an_actuator_clips_or_delays() -> None:
    for physics in (Physics(torque_saturation_limit=0.01), Physics(actuator_lag_time_constant=0.05)):
        stuck = replace(physics, coulomb_friction_torque=0.02)
        assert np.abs(alone(RIGID, stuck, Run(np.full(501, 0.015))).theta).max() < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize(
    ("physics", "error"),
    [
        (Physics(actuator_lag_time_constant=0.005), 1e-7),
        (Physics(torque_saturation_limit=0.12), 3e-6),
        (Physics(cogging_amplitude=0.01, cogging_count=80.0), 1e-7),
    ],
    ids=["lag", "saturation", "cogging"],
)
def test_half_the_step_changes_next_to_nothing(physics: Physics, error: float) -> None:
    run = Run(drive(TIME))
    assert rms(alone(HUB, physics, run), alone(HUB, physics, run, step=0.5 * physics.step)) < error


def test_cogging_goes_with_the_motor_s_angle() -> None:
    physics = Physics(cogging_amplitude=0.05, cogging_count=18.0, cogging_phase=0.4)
    motion = alone(RIGID, physics, Run(0.3 * np.sin(6.0 * TIME)))
    turned = rigid(lambda t, y: 0.3 * np.sin(6.0 * t) + 0.05 * float(np.sin(18.0 * y[0] + 0.4)))
    np.testing.assert_allclose(motion.theta, turned, atol=2e-5)
    held = alone(HUB, physics, Run(held=True))
    assert held.hold == pytest.approx(-0.05 * np.sin(0.4))
    np.testing.assert_allclose(held.theta, 0.0, atol=1e-9)


STRIBECK = Physics(coulomb_friction_torque=0.02, stribeck_torque=0.03, stribeck_speed=0.1)


def test_friction_that_falls_with_speed_holds_what_friction_at_rest_does() -> None:
    for torque, moves in ((0.049, False), (0.051, True)):
        motion = alone(RIGID, STRIBECK, Run(np.full(501, torque)))
        assert bool(np.abs(motion.theta).max() > 1e-3) is moves


def test_friction_falls_with_the_speed_of_a_rigid_arm() -> None:
    """Pushed to and fro as hard as friction at rest allows it to go on at once."""
    torque = 0.3 * np.cos(8.0 * TIME)

    def friction(t: float, y: Array) -> float:
        level = 0.02 + 0.03 * np.exp(-((y[1] / 0.1) ** 2))
        return float(0.3 * np.cos(8.0 * t) - level * np.tanh(y[1] / 1e-5))

    motion = alone(RIGID, STRIBECK, Run(torque))
    np.testing.assert_allclose(motion.theta, rigid(friction), atol=6e-5)
    constant = replace(STRIBECK, coulomb_friction_torque=0.05, stribeck_torque=0.0)
    assert np.abs(motion.theta - alone(RIGID, constant, Run(torque)).theta).max() > 3e-3


def test_friction_at_high_speed_is_coulomb_s_alone() -> None:
    fast = Run(push=np.eye(2 * 9)[9] * 3.0)
    start = alone(RIGID, Physics(), fast).rates[:, 0]
    slowed = alone(RIGID, STRIBECK, fast).rates[:, 0]
    np.testing.assert_allclose((start - slowed)[[100, 400]], 0.02 / INERTIA * TIME[[100, 400]], rtol=1e-3)
