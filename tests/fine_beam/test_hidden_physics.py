"""Hidden physics at the joint against rigid bodies; and all of it against balances of energy and finer steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.optimize import brentq

from tests.fine_beam import linear_modes, simulate, static_state
from tests.fine_beam.arms import HUB, INERTIA, MARKERS, RIGID, TIME, alone, drive, energy, rms
from tests.fine_beam.beam import Body
from tests.fine_beam.extended import Extended
from tests.fine_beam.hidden import Physics
from tests.fine_beam.motion import Run, simulate_runs

Array = NDArray[np.float64]


# Nothing hidden


def test_with_nothing_hidden_it_is_the_plain_beam() -> None:
    motion = alone(HUB, Physics(), Run(drive(TIME)))
    plain = simulate(HUB, TIME, drive(TIME))
    np.testing.assert_allclose(motion.positions(MARKERS), plain.positions(MARKERS), atol=1e-7)
    np.testing.assert_allclose(motion.theta, plain.theta, atol=1e-7)


@pytest.mark.parametrize("friction", [0.0, pytest.param(0.008, marks=pytest.mark.slow)])
def test_runs_together_are_the_runs_alone(friction: float) -> None:
    body = Body(0.05, 0.04, 1e-4)
    runs = [Run(drive(TIME)), Run(drive(TIME), payload=body), Run(-0.5 * drive(TIME), payload=body), Run(held=True)]
    physics = Physics(
        coulomb_friction_torque=friction, structural_damping_loss_factor=0.02, linear_drag_coefficient=0.02
    )
    for run, motion in zip(runs, simulate_runs(HUB, physics, TIME, runs), strict=True):
        # Friction halves steps wherever any joint of the batch starts or stops.
        np.testing.assert_allclose(motion.theta, alone(HUB, physics, run).theta, atol=5e-6)


# Mass and gravity


def test_payload_is_that_of_the_plain_beam() -> None:
    heavy = replace(HUB, payload=0.06)
    motion = alone(HUB, Physics(tip_payload_mass=0.01), Run(drive(TIME), payload=Body(0.05)))
    plain = simulate(heavy, TIME, drive(TIME))
    np.testing.assert_allclose(motion.positions(MARKERS), plain.positions(MARKERS), atol=1e-7)
    frequencies = motion.beam.modes()[0][:3] / (2.0 * np.pi)
    np.testing.assert_allclose(frequencies, linear_modes(heavy).frequencies[:3], rtol=1e-6)


def test_a_known_payload_is_the_body_that_it_is() -> None:
    physics, body = Physics(payload_body_offset=0.05, payload_body_radius_of_gyration=0.04), Body(0.05, -0.02, 1e-4)
    hidden = alone(HUB, physics, Run(drive(TIME), payload=body))
    known = alone(HUB, Physics(), Run(drive(TIME), payload=Body(0.05, 0.03, 1e-4 + 0.05 * 0.04**2)))
    radius = (0.04**2 + 1e-4 / 0.05) ** 0.5
    physics = Physics(tip_payload_mass=0.05, tip_payload_offset=0.03, tip_payload_radius_of_gyration=radius)
    unknown = alone(HUB, physics, Run(drive(TIME)))
    point = alone(HUB, Physics(), Run(drive(TIME), payload=Body(0.05)))
    np.testing.assert_allclose(hidden.positions(MARKERS), unknown.positions(MARKERS), atol=1e-10)
    np.testing.assert_allclose(known.positions(MARKERS), unknown.positions(MARKERS), atol=1e-10)
    assert rms(point, known) > 5e-4


def test_a_rigid_link_on_a_hub_turns_as_a_body_about_the_axis() -> None:
    radius, length, mass = 0.2, RIGID.length, RIGID.mass
    motion = alone(RIGID, Physics(hub_radius_radius=radius), Run(drive(TIME), payload=Body(0.05)))
    inertia = RIGID.hub_inertia + mass * (length**2 / 12 + (radius + length / 2) ** 2) + 0.05 * (radius + length) ** 2
    turned = cumulative_simpson(cumulative_simpson(drive(TIME), x=TIME, initial=0.0), x=TIME, initial=0.0) / inertia
    np.testing.assert_allclose(motion.theta, turned, atol=2e-3 * np.abs(turned).max())
    ends = motion.positions([0.0, length])
    heading = np.stack([np.cos(motion.theta), np.sin(motion.theta)], axis=-1)
    np.testing.assert_allclose(ends[:, 0], radius * heading, atol=1e-12)
    np.testing.assert_allclose(ends[:, 1], (radius + length) * heading, atol=1e-3)


def test_markers_have_their_weight_and_their_inertia() -> None:
    """Sag by small loads at arcs a, the sum of m g a^2 (3 l - a) / (6 EI), and inertia of a rigid link."""
    arcs, length = (0.25, 0.6, 1.0), HUB.length
    heavy = Physics(marker_mass_mass=0.01, marker_mass_arcs=arcs, in_plane_gravity_gy=-0.01)
    light = Physics(in_plane_gravity_gy=-0.01)
    tips = [alone(HUB, physics, Run(held=True)).positions([length])[0, 0, 1] for physics in (heavy, light)]
    places = np.array(arcs)
    sag = np.sum(0.01 * 0.01 * places**2 * (3 * length - places)) / (6 * HUB.bending_stiffness)
    assert tips[1] - tips[0] == pytest.approx(sag, rel=1e-3)
    inertias = [Extended(RIGID, physics).mass[0, 0, 0] for physics in (heavy, light)]
    assert inertias[0] - inertias[1] == pytest.approx(0.01 * np.sum(places**2))


def test_gravity_is_that_of_the_plain_beam() -> None:
    tilted = replace(HUB, gravity=(0.1, -0.2))
    motion = alone(HUB, Physics(in_plane_gravity_gx=0.1, in_plane_gravity_gy=-0.2), Run(drive(TIME)))
    plain = simulate(tilted, TIME, drive(TIME), static_state(tilted))
    np.testing.assert_allclose(motion.positions(MARKERS), plain.positions(MARKERS), atol=1e-7)
    assert motion.hold == pytest.approx(0.2 * 0.44 * 0.5, rel=5e-3)


def test_what_is_held_stays() -> None:
    physics = Physics(in_plane_gravity_gy=-0.3, backlash_gap=4e-3, clamp_compliance_compliance=5e-3)
    motion = alone(HUB, physics, Run(held=True))
    np.testing.assert_allclose(motion.positions(MARKERS), motion.positions(MARKERS)[:1].repeat(501, 0), atol=1e-7)
    assert motion.positions([1.0])[0, 0, 1] < -5e-3


# The joint


@pytest.mark.parametrize(
    ("physics", "spring", "viscous"),
    [(Physics(joint_spring_stiffness=0.5), 0.5, 0.0), (Physics(viscous_friction_coefficient=0.04), 0.0, 0.04)],
)
def test_spring_and_viscous_friction_at_the_joint_of_a_rigid_arm(
    physics: Physics, spring: float, viscous: float
) -> None:
    torque = 0.3 * np.sin(6.0 * TIME)
    rigid = solve_ivp(
        lambda t, y: [y[1], (0.3 * np.sin(6.0 * t) - spring * y[0] - viscous * y[1]) / INERTIA],
        (0.0, 1.0),
        [0.0, 0.0],
        t_eval=TIME,
        rtol=1e-9,
        atol=1e-12,
    )
    np.testing.assert_allclose(alone(RIGID, physics, Run(torque)).theta, rigid.y[0], atol=2e-5)


def test_dry_friction_holds_until_the_torque_exceeds_it() -> None:
    stiff = replace(HUB, bending_stiffness=200.0)
    motion = alone(stiff, Physics(coulomb_friction_torque=0.02), Run(0.05 * TIME))
    slips = np.maximum(TIME - 0.4, 0.0)
    np.testing.assert_allclose(motion.theta, 0.05 * slips**3 / (6.0 * INERTIA), atol=5e-5)
    assert np.abs(motion.theta[TIME < 0.399]).max() < 2e-7
    below = alone(HUB, Physics(coulomb_friction_torque=0.05), Run(0.02 * np.sin(20.0 * TIME)))
    assert np.abs(below.theta).max() < 2e-7  # stuck, though the arm swings
    assert np.abs(below.rates[:, 0]).max() < 1e-9


def test_dry_friction_takes_its_share_of_every_swing_and_then_sticks() -> None:
    time = np.arange(2001) / 500.0
    physics = Physics(coulomb_friction_torque=0.08, joint_spring_stiffness=4.0)
    theta = alone(replace(HUB, bending_stiffness=200.0), physics, Run(theta=0.2), time).theta
    turns = theta[1:-1][(theta[1:-1] - theta[:-2]) * (theta[2:] - theta[1:-1]) < 0.0]
    # 0.2 falls by twice the friction over the stiffness with every half swing until the spring cannot break away.
    np.testing.assert_allclose(np.abs(turns[np.abs(turns) > 0.02]), [0.16, 0.12, 0.08, 0.04], atol=2e-3)
    assert abs(theta[-1]) <= 0.02 + 1e-6
    assert np.ptp(theta[-250:]) < 2e-6


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_the_motor_has_its_share_of_the_inertia(share: float) -> None:
    physics = Physics(gear_elasticity_stiffness=60.0, gear_elasticity_motor_share=share)
    motor = share * RIGID.hub_inertia
    expected = np.sqrt(60.0 * (1.0 / motor + 1.0 / (INERTIA - motor)))
    assert Extended(RIGID, physics).modes()[0][0] == pytest.approx(expected, rel=1e-3)


def test_elastic_gear_of_a_rigid_arm() -> None:
    beam = Extended(RIGID, Physics(gear_elasticity_stiffness=60.0))
    expected = np.sqrt(60.0 * (1.0 / 0.01 + 1.0 / (INERTIA - 0.01)))
    assert beam.modes()[0][0] == pytest.approx(expected, rel=1e-3)
    motion = alone(RIGID, Physics(gear_elasticity_stiffness=60.0, in_plane_gravity_gy=-0.3), Run(held=True))
    assert motion.coordinates[0, 1] == pytest.approx(-0.3 * 0.22 / 60.0, rel=1e-3)
    assert motion.theta[0] == 0.0
    stiff = alone(HUB, Physics(gear_elasticity_stiffness=1e7), Run(drive(TIME)))
    assert rms(stiff, alone(HUB, Physics(), Run(drive(TIME)))) < 1e-6


@pytest.mark.parametrize("damping", [0.05, 0.5, 3.0])
def test_the_damper_beside_an_elastic_gear_slows_the_twist_of_two_inertias(damping: float) -> None:
    """Motor and arm against each other, x'' = -(1/a + 1/b) (k x + d x'): underdamped, and next to no swing at all."""
    motor, arm = 0.3 * 0.02, INERTIA - 0.3 * 0.02
    physics = Physics(gear_elasticity_stiffness=60.0, gear_elasticity_motor_share=0.3, gear_elasticity_damping=damping)
    push = np.zeros(2 * Extended(RIGID, physics).size)
    push[:2] = 0.01 * arm / (motor + arm), -0.01 * motor / (motor + arm)  # a twist about the centre of both
    motion = alone(RIGID, physics, Run(push=push), step=5e-4)
    mobility = 1.0 / motor + 1.0 / arm
    decay, square = 0.5 * damping * mobility, 60.0 * mobility
    pulsation = np.sqrt(complex(square - decay**2))
    swing = np.cos(pulsation * TIME) + decay / pulsation * np.sin(pulsation * TIME)
    twist = 0.01 * (np.exp(-decay * TIME) * swing).real
    np.testing.assert_allclose(motion.coordinates[:, 0] - motion.coordinates[:, 1], twist, atol=5e-5)


@pytest.mark.parametrize("damping", [0.1, 1.0])
def test_the_damper_beside_a_clamp_s_spring_damps_a_rigid_link(damping: float) -> None:
    """Of an oscillator J x'' + d x' + x / c = 0, the exact eigenvalue."""
    rigid = replace(RIGID, joint="clamped", hub_inertia=0.0)
    physics = Physics(clamp_compliance_compliance=0.05, clamp_compliance_damping=damping)
    values = np.linalg.eigvals(Extended(rigid, physics).linear(0))
    slowest = values[np.argmin(np.abs(values))]
    inertia = 0.44 / 3.0
    assert slowest.real == pytest.approx(-0.5 * damping / inertia, rel=2e-3)
    assert abs(slowest) ** 2 == pytest.approx(20.0 / inertia, rel=2e-3)


def test_play_passes_nothing_until_it_closes() -> None:
    physics = Physics(backlash_gap=0.01)
    torque = np.full(501, 1e-3)
    motion = alone(RIGID, physics, Run(torque))
    free = 0.5 * 1e-3 / 0.01 * TIME**2  # the motor's half of the hub by itself
    inside = free < 0.004
    np.testing.assert_allclose(motion.theta[inside], free[inside], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(motion.coordinates[inside, 1:], 0.0, atol=1e-12)
    soft = Physics(backlash_gap=0.01, backlash_contact_stiffness=500.0, in_plane_gravity_gy=-0.3)
    resting = alone(HUB, soft, Run(held=True))
    assert resting.coordinates[0, 1] == pytest.approx(-0.005 - 0.066 / 500.0, abs=1e-6)


def test_steps_resolve_impacts() -> None:
    """Better than a diagnosis tells gaps of some mrad: to two microradians."""
    physics = Physics(backlash_gap=0.004, backlash_contact_stiffness=1500.0, backlash_contact_damping_ratio=0.25)
    time = TIME[:151]
    run = Run(0.3 * np.sin(9.0 * time) + 0.3 * np.sin(61.0 * time))
    found, finer = (simulate_runs(HUB, physics, time, [run], step=step)[0].theta for step in (None, physics.step / 4))
    assert np.sqrt(np.mean((found - finer) ** 2)) < 1e-7


# The table


def table(**values: float) -> Physics:
    return Physics(**{f"base_compliance_{name}": value for name, value in values.items()})


@pytest.mark.parametrize("direction", [0.0, 0.8, np.pi / 2])
def test_a_rigid_arm_on_a_table_is_a_pendulum_on_a_cart(direction: float) -> None:
    """Lagrange's equations of both, without bending; the arm turns by more than two radians."""
    stiffness, mass, ratio, moment = 300.0, 2.0, 0.05, 0.44 * 0.5
    damping = 2.0 * ratio * np.sqrt(stiffness * mass)
    torque = 1.2 * np.sin(4.0 * TIME)

    def slope(t: float, y: Array) -> list[float]:
        theta, u, turning, speed = y
        across, ahead = np.sin(direction - theta), np.cos(direction - theta)
        matrix = np.array([[INERTIA, moment * across], [moment * across, 2.44]])
        pulled = moment * ahead * turning**2 - stiffness * u - damping * speed
        return [turning, speed, *np.linalg.solve(matrix, [1.2 * np.sin(4.0 * t), pulled])]

    exact = solve_ivp(slope, (0.0, 1.0), np.zeros(4), t_eval=TIME, rtol=1e-10, atol=1e-13).y
    physics = table(stiffness=stiffness, mass=mass, direction=direction, damping_ratio=ratio)
    motion = alone(RIGID, physics, Run(torque))
    np.testing.assert_allclose(motion.theta, exact[0], atol=3e-4)  # it bends a little
    np.testing.assert_allclose(motion.coordinates[:, -1], exact[1], atol=3e-5)
    assert np.ptp(exact[0]) > 1.5
    assert np.abs(exact[1]).max() > 2e-3
    shift = motion.positions([0.0]) - exact[1][:, None, None] * [np.cos(direction), np.sin(direction)]
    np.testing.assert_allclose(shift, 0.0, atol=3e-5)


def sliding(pulsation: float, stiffness: float, mass: float) -> float:
    """Zero at the natural frequencies of a beam whose root slides across it with a mass on a spring, N/m."""
    z = np.sqrt(pulsation) * (0.44 / 1.97) ** 0.25
    cos, sin, cosh, sinh = np.cos(z), np.sin(z), np.cosh(z), np.sinh(z)
    held, shear = stiffness - mass * pulsation**2, 1.97 * z**3
    rows = [[0, 1, 0, 1], [held / shear, -1, held / shear, 1], [-cos, -sin, cosh, sinh], [sin, -cos, sinh, cosh]]
    return float(np.linalg.det(np.array(rows) / [[1], [1], [cosh], [cosh]]))


def test_a_link_on_a_table_has_the_frequencies_of_a_beam_whose_root_slides() -> None:
    clamped = replace(HUB, joint="clamped", hub_inertia=0.0)
    pulsations = Extended(clamped, table(stiffness=2000.0, mass=3.0)).modes()[0][:4]
    for found in pulsations:
        assert found == pytest.approx(brentq(sliding, 0.98 * found, 1.02 * found, args=(2000.0, 3.0)), rel=2e-6)
    assert np.abs(pulsations - np.sqrt(2000.0 / 3.4)).min() < 1.0


def test_weight_does_not_move_the_table() -> None:
    physics = replace(table(stiffness=500.0, direction=1.0), in_plane_gravity_gy=-0.3)
    motion = alone(HUB, physics, Run(held=True))
    grounded = alone(HUB, Physics(in_plane_gravity_gy=-0.3), Run(held=True))
    np.testing.assert_allclose(motion.positions(MARKERS), grounded.positions(MARKERS), atol=1e-9)


def test_decays_begin_in_the_modes_of_an_arm_on_the_ground() -> None:
    physics = replace(table(stiffness=500.0), clamp_compliance_compliance=5e-3)
    run, grounded = Run(tip_amplitudes=(0.05, -0.01)), Physics(clamp_compliance_compliance=5e-3)
    first = [alone(HUB, hidden, run, TIME[:2]).positions(MARKERS)[0] for hidden in (physics, grounded)]
    np.testing.assert_allclose(*first, atol=1e-9)


# Energy and steps


UNDAMPED = replace(HUB, kelvin_voigt_time=0.0)


@pytest.mark.parametrize(
    "physics",
    [
        Physics(gear_elasticity_stiffness=60.0),
        Physics(clamp_compliance_compliance=5e-3),
        Physics(tip_payload_mass=0.05, tip_payload_offset=0.1, tip_payload_radius_of_gyration=0.05),
        table(stiffness=500.0, mass=2.0, direction=0.9, damping_ratio=0.0),
        Physics(hub_radius_radius=0.1, clamp_compliance_compliance=5e-3),
    ],
    ids=["gear", "clamp", "payload", "table", "hub"],
)
def test_energy_is_kept_where_nothing_takes_it(physics: Physics) -> None:
    motion = alone(UNDAMPED, physics, Run(tip_amplitudes=(0.05, 0.005), payload=Body(0.02, 0.06, 5e-5)), step=1e-3)
    np.testing.assert_allclose(energy(motion), energy(motion)[0], rtol=1e-5)


@pytest.mark.parametrize(
    "physics",
    [
        Physics(coulomb_friction_torque=0.008),
        Physics(viscous_friction_coefficient=0.004),
        Physics(linear_drag_coefficient=0.02),
        Physics(quadratic_drag_coefficient=0.05),
        Physics(structural_damping_loss_factor=0.01),
    ],
    ids=["coulomb", "viscous", "linear drag", "quadratic drag", "structural"],
)
def test_what_only_takes_energy_never_gives_any(physics: Physics) -> None:
    stored = energy(alone(UNDAMPED, physics, Run(tip_amplitudes=(0.1, 0.02))))
    assert np.diff(stored).max() < 1e-6 * stored[0]
    assert stored[-1] < 0.99 * stored[0]


@pytest.mark.parametrize(
    ("physics", "twist"),
    [
        (Physics(gear_elasticity_stiffness=60.0, gear_elasticity_damping=0.2), [1.0, -1.0]),
        (Physics(clamp_compliance_compliance=5e-3, clamp_compliance_damping=2.0), [0.0, 1.0]),
    ],
    ids=["gear", "clamp"],
)
def test_energy_falls_by_what_dampers_of_joints_take(physics: Physics, twist: list[float]) -> None:
    motion = alone(UNDAMPED, physics, Run(tip_amplitudes=(0.05, 0.005)), step=1e-3)
    damping = physics.gear_elasticity_damping + physics.clamp_compliance_damping
    taken = cumulative_simpson(damping * (motion.rates[:, :2] @ twist) ** 2, x=TIME, initial=0.0)
    stored = energy(motion)
    np.testing.assert_allclose(stored, stored[0] - taken, atol=1e-5 * stored[0])
    assert taken[-1] > 0.02 * stored[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("physics", "error"),
    [
        (Physics(coulomb_friction_torque=0.008), 3e-6),
        (Physics(backlash_gap=0.004), 3e-6),
        (Physics(gear_elasticity_stiffness=60.0, external_tone_amplitude=0.05, external_tone_frequency=7.0), 1e-7),
        (Physics(hysteresis_ratio=0.1, viscoelastic_creep_ratio=0.05, cubic_stiffness_coefficient=-0.1), 1e-7),
        (Physics(stiffness_asymmetry_ratio=0.1, taper_taper=0.2), 1e-7),
        (table(stiffness=500.0, mass=2.0, direction=0.9), 1e-7),
        (Physics(gear_elasticity_stiffness=60.0, gear_elasticity_damping=0.5), 1e-7),
        (Physics(quadratic_drag_coefficient=0.1, clamp_compliance_compliance=5e-3, stiffness_drift_rate=0.01), 1e-7),
    ],
    ids=["coulomb", "backlash", "gear", "hysteresis", "asymmetry", "table", "damped gear", "drag"],
)
def test_half_the_step_changes_next_to_nothing(physics: Physics, error: float) -> None:
    run = Run(drive(TIME))
    assert rms(alone(HUB, physics, run), alone(HUB, physics, run, step=0.5 * physics.step)) < error
