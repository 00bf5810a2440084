"""The independent beam against closed forms, conservation laws, boundary value problems, and itself refined."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson, solve_bvp, solve_ivp
from scipy.optimize import brentq

from tests.fine_beam import Beam, Numerics, State, linear_modes, modal_state, rest_state, simulate, static_state
from tests.fine_beam.make_demo import MARKERS, RECORDINGS, euler_bernoulli_frequencies, simulate_recording

Array = NDArray[np.float64]

CLAMPED = Beam(length=1.0, mass=0.44, bending_stiffness=1.97, kelvin_voigt_time=3e-4)
HUB = replace(CLAMPED, joint="revolute", hub_inertia=0.02)
FINE = Numerics(basis_size=12, node_count=28, max_step=5e-4)


def drive(time: Array) -> Array:
    """A hub torque, N m: a swing of about 2 rad and steps that excite bending."""
    return np.asarray(0.25 * np.sin(4.4 * time) + 0.1 * np.sign(np.sin(8.2 * time)))


# Linear vibration


def characteristic(pulsation: float, beam: Beam) -> float:
    """Determinant whose zeros are the natural frequencies, rad/s, of a hub, an Euler-Bernoulli beam and a point mass.

    With w(x) the whole transverse displacement: w(0) = 0; the beam's root moment EI w''(0) turns the hub, whose angle
    is w'(0); w''(L) = 0; the shear EI w'''(L) accelerates the tip mass.
    """
    b = np.sqrt(pulsation) * (beam.mass / beam.length / beam.bending_stiffness) ** 0.25
    z = b * beam.length
    cos, sin, cosh, sinh = np.cos(z), np.sin(z), np.cosh(z), np.sinh(z)
    stiffness = beam.bending_stiffness
    hub, tip = beam.hub_inertia * pulsation**2, beam.payload * pulsation**2
    rows = [
        [1.0, 0.0, 1.0, 0.0],
        [-stiffness * b**2, hub * b, stiffness * b**2, hub * b],
        [-cos, -sin, cosh, sinh],
        [
            stiffness * b**3 * sin + tip * cos,
            -stiffness * b**3 * cos + tip * sin,
            stiffness * b**3 * sinh + tip * cosh,
            stiffness * b**3 * cosh + tip * sinh,
        ],
    ]
    return float(np.linalg.det(np.array(rows) / cosh))


def characteristic_frequencies(beam: Beam, count: int) -> Array:
    """The first zeros of the determinant, Hz, found by scanning for sign changes."""
    grid = np.linspace(1.0, 400.0, 4000)
    signs = np.sign([characteristic(pulsation, beam) for pulsation in grid])
    brackets = np.flatnonzero(signs[1:] != signs[:-1])[:count]
    roots = [brentq(characteristic, grid[i], grid[i + 1], args=(beam,), xtol=1e-11) for i in brackets]
    return np.array(roots) / (2.0 * np.pi)


def test_clamped_frequencies_are_euler_bernoulli() -> None:
    beam = replace(CLAMPED, length=0.7, mass=0.31)
    roots = np.array([1.8751040687119611, 4.694091132974175, 7.854757438237613])  # tabulated beta L
    expected = roots**2 * np.sqrt(1.97 / (0.31 * 0.7**3)) / (2.0 * np.pi)
    np.testing.assert_allclose(linear_modes(beam).frequencies[:3], expected, rtol=1e-8)
    np.testing.assert_allclose(euler_bernoulli_frequencies(beam, 3), expected, rtol=1e-12)


@pytest.mark.parametrize("hub_inertia", [0.002, 0.02, 0.5])
@pytest.mark.parametrize("payload", [0.0, 0.05, 0.4])
def test_hub_frequencies_solve_the_characteristic_equation(hub_inertia: float, payload: float) -> None:
    beam = replace(HUB, hub_inertia=hub_inertia, payload=payload)
    np.testing.assert_allclose(linear_modes(beam).frequencies[:3], characteristic_frequencies(beam, 3), rtol=1e-7)


@pytest.mark.parametrize("beam", [CLAMPED, replace(HUB, payload=0.05)])
def test_damping_ratio_is_half_pulsation_times_kelvin_voigt_time(beam: Beam) -> None:
    modes = linear_modes(beam)
    expected = np.pi * modes.frequencies[:4] * beam.kelvin_voigt_time
    np.testing.assert_allclose(modes.damping_ratios[:4], expected, rtol=1e-6)


def test_small_decay_follows_the_linear_mode() -> None:
    time = np.arange(1001) / 500.0
    modes = linear_modes(CLAMPED)
    tip = simulate(CLAMPED, time, state=modal_state(CLAMPED, [0.0, 1e-4])).positions([1.0])[:, 0, 1]
    pulsation, ratio = 2.0 * np.pi * modes.frequencies[1], modes.damping_ratios[1]
    root = pulsation * (-ratio + 1j * np.sqrt(1.0 - ratio**2))
    expected = 1e-4 * np.real((1.0 - 1j * root.real / -root.imag) * np.exp(root * time))
    np.testing.assert_allclose(tip, expected, atol=1e-9)


# Large static bends


def elastica(beam: Beam, tip_force: tuple[float, float], theta: float, arc_lengths: list[float]) -> Array:
    """Equilibrium positions, m, (k, 2): EI psi'' = n_x sin psi - n_y cos psi, with n(s) the load beyond s."""
    tip_load = np.array(tip_force) + beam.payload * np.array(beam.gravity)
    line_load = beam.mass / beam.length * np.array(beam.gravity)

    def slope(s: Array, y: Array) -> Array:
        load = tip_load[:, None] + line_load[:, None] * (beam.length - s)
        moment_slope = load[0] * np.sin(y[0]) - load[1] * np.cos(y[0])
        return np.stack([y[1], moment_slope / beam.bending_stiffness, np.cos(y[0]), np.sin(y[0])])

    def ends(start: Array, end: Array) -> Array:
        return np.array([start[0] - theta, end[1], start[2], start[3]])

    mesh = np.linspace(0.0, beam.length, 41)
    solution = solve_bvp(slope, ends, mesh, np.stack([theta + 0 * mesh, 0 * mesh, mesh, 0 * mesh]), tol=1e-9)
    assert solution.success
    return np.asarray(solution.sol(np.array(arc_lengths))[2:].T)


@pytest.mark.parametrize(
    ("beam", "tip_force", "theta"),
    [
        (CLAMPED, (0.0, 6.0), 0.0),
        (replace(CLAMPED, bending_stiffness=0.6, payload=0.05, gravity=(1.5, -9.81)), (0.0, 0.0), 0.0),
        (replace(HUB, payload=0.1, gravity=(0.0, -9.81)), (1.0, 0.5), 0.7),
    ],
)
def test_static_bend_is_the_elastica(beam: Beam, tip_force: tuple[float, float], theta: float) -> None:
    state = static_state(beam, tip_force, theta)
    positions = simulate(beam, np.array([0.0]), state=state).positions(MARKERS)[0]
    expected = elastica(beam, tip_force, theta, MARKERS)
    straight = np.array(MARKERS)[:, None] * [np.cos(theta), np.sin(theta)]
    assert np.linalg.norm(expected - straight, axis=1)[-1] > 0.25  # far from linear
    np.testing.assert_allclose(positions, expected, atol=1e-6)


def test_equilibrium_under_gravity_stays_still() -> None:
    beam = replace(CLAMPED, payload=0.05, gravity=(0.5, -9.81))
    positions = simulate(beam, np.arange(101) / 100.0, state=static_state(beam)).positions(MARKERS)
    np.testing.assert_allclose(positions, positions[:1].repeat(101, axis=0), atol=1e-9)


# Motion


def test_undamped_swing_under_gravity_keeps_its_energy() -> None:
    beam = replace(HUB, kelvin_voigt_time=0.0, payload=0.02, gravity=(0.0, -9.81))
    motion = simulate(
        beam, np.arange(501) / 250.0, state=static_state(beam, theta=-0.3), numerics=Numerics(max_step=5e-4)
    )
    deflection = motion.positions([1.0], frame="link")[:, 0, 1]
    assert np.ptp(motion.theta) > 2.0
    assert np.ptp(deflection) > 0.2
    assert np.ptp(motion.energy) < 1e-6 * np.abs(motion.energy).max()


@pytest.mark.slow
def test_undamped_clamped_beam_keeps_its_energy() -> None:
    beam = replace(CLAMPED, kelvin_voigt_time=0.0)
    energy = simulate(
        beam, np.arange(251) / 125.0, state=modal_state(beam, [0.3]), numerics=Numerics(max_step=5e-4)
    ).energy
    assert np.ptp(energy) < 1e-6 * energy[0]


def test_energy_changes_by_work_less_dissipation() -> None:
    time = np.arange(2001) / 1000.0
    torque = 0.3 * time  # a ramp, and not a curve: simulated torque is linear between samples
    beam = replace(HUB, kelvin_voigt_time=3e-3)
    motion = simulate(beam, time, torque, modal_state(beam, [0.1, 0.01]))
    curvature_rate = motion.rates @ motion.mechanics.curvature.T
    lost = beam.bending_stiffness * 3e-3 * curvature_rate**2 @ motion.mechanics.basis.weights
    balance = cumulative_simpson(torque * motion.rates[:, 0] - lost, x=time, initial=0.0)
    assert np.mean(lost) > 1e-2
    np.testing.assert_allclose(motion.energy - motion.energy[0], balance, atol=1e-5)  # J, of 0.37 J lost


def test_free_hub_keeps_its_angular_momentum() -> None:
    state = modal_state(HUB, [0.1, 0.01])
    spinning = State(state.bending, state.bending_rate, theta=0.4, theta_rate=2.0)
    momentum = simulate(HUB, np.arange(501) / 250.0, state=spinning).angular_momentum
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-6)


def test_torque_is_linear_between_samples() -> None:
    time = np.arange(51) / 25.0  # coarse: 40 ms between samples
    torque = np.random.default_rng(5).normal(0.0, 0.1, len(time))
    impulse = np.concatenate([[0.0], np.cumsum(0.5 * (torque[1:] + torque[:-1]) * np.diff(time))])
    np.testing.assert_allclose(simulate(HUB, time, torque).angular_momentum, impulse, atol=1e-8)


def test_stiff_beam_swings_as_a_rigid_pendulum() -> None:
    beam = replace(HUB, bending_stiffness=2e5, kelvin_voigt_time=1e-5, payload=0.3, gravity=(0.0, -9.81))
    time = np.arange(101) / 100.0
    inertia, moment = 0.02 + 0.44 / 3.0 + 0.3, 9.81 * (0.44 / 2.0 + 0.3)
    rigid = solve_ivp(
        lambda _, y: [y[1], -moment / inertia * np.cos(y[0])],
        (0.0, 1.0),
        [0.2, 0.0],
        t_eval=time,
        rtol=1e-10,
        atol=1e-12,
    )
    state = rest_state(theta=0.2)
    np.testing.assert_allclose(simulate(beam, time, state=state).theta, rigid.y[0], atol=5e-5)


# Resolution


@pytest.mark.slow
def test_hub_driven_motion_is_converged() -> None:
    time = np.arange(1501) / 500.0
    default = simulate(HUB, time, drive(time))
    assert np.ptp(default.theta) > 1.0
    positions = default.positions(MARKERS)
    half_step = simulate(HUB, time, drive(time), numerics=Numerics(max_step=5e-4)).positions(MARKERS)
    more_functions = simulate(HUB, time, drive(time), numerics=Numerics(13, 32)).positions(MARKERS)
    assert np.abs(positions - half_step).max() < 1e-8
    assert np.abs(positions - more_functions).max() < 1e-7


@pytest.mark.slow
def test_demo_motion_is_converged() -> None:
    short = RECORDINGS[3]._replace(duration=2.0)
    default = simulate_recording(short).positions(MARKERS)
    assert np.abs(default - simulate_recording(short, FINE).positions(MARKERS)).max() < 1e-7
