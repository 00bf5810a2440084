"""Hidden physics of the link and the air around it against closed forms and rigid bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson, solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq, fsolve

from tests.fine_beam.arms import CLAMPED, HUB, INERTIA, MARKERS, RIGID, TIME, alone, energy, rms
from tests.fine_beam.extended import Extended
from tests.fine_beam.hidden import Physics, slip_rate
from tests.fine_beam.motion import Run, simulate_runs
from tests.fine_beam.wedge import wedge_pulsations

Array = NDArray[np.float64]


# The link's bending


def rooted(pulsation: float, stiffness: float) -> float:
    """Zero at the natural frequencies of a cantilever whose root turns on a spring, N m/rad; from its four shapes."""
    z = np.sqrt(pulsation) * (0.44 / 1.97) ** 0.25
    cos, sin, cosh, sinh = np.cos(z), np.sin(z), np.cosh(z), np.sinh(z)
    rows = [[1, 0, 1, 0], [1.97 * z**2, stiffness * z, -1.97 * z**2, stiffness * z], [-cos, -sin, cosh, sinh]]
    return float(np.linalg.det(np.array([*rows, [sin, -cos, sinh, cosh]]) / cosh))


def test_clamp_compliance_has_the_frequencies_of_a_sprung_root() -> None:
    pulsations = Extended(CLAMPED, Physics(clamp_compliance_compliance=5e-3)).modes()[0][:3]
    expected = [brentq(rooted, 0.97 * p, 1.03 * p, args=(200.0,), xtol=1e-12) for p in pulsations]
    np.testing.assert_allclose(pulsations, expected, rtol=2e-6)
    plain = Extended(CLAMPED, Physics()).modes()[0][:3]
    assert np.all(pulsations < 0.995 * plain)


def test_clamp_compliance_turns_the_root_by_its_moment() -> None:
    physics = Physics(clamp_compliance_compliance=5e-3, in_plane_gravity_gy=-0.2)
    motion = alone(HUB, physics, Run(held=True))
    assert motion.coordinates[0, 1] == pytest.approx(5e-3 * -0.2 * 0.22, rel=1e-3)


@pytest.mark.parametrize("taper", [0.04, 0.6])
def test_taper_has_the_frequencies_of_a_truncated_wedge(taper: float) -> None:
    pulsations = Extended(CLAMPED, Physics(taper_taper=taper)).modes()[0][:3]
    np.testing.assert_allclose(pulsations, wedge_pulsations(1.0, 0.44, 1.97, taper, 3), rtol=2e-6)
    turned = Extended(CLAMPED, Physics(taper_taper=-taper)).modes()[0][0]
    assert turned < pulsations[0]  # thick at the tip


def test_taper_bends_where_the_link_is_thin() -> None:
    physics = Physics(taper_taper=0.3, in_plane_gravity_gy=-0.2)
    motion = alone(CLAMPED, physics, Run(held=True), TIME[:2])
    arcs = motion.beam.basis.nodes
    # Of the mass beyond s, per length 0.44 (1.15 - 0.3 s), in a sag so small that it hangs straight out.
    moment = -0.2 * 0.44 * (1.15 * (1 - arcs) ** 2 / 2 - 0.3 * (1 / 3 - arcs / 2 + arcs**3 / 6))
    expected = moment / (1.97 * (1.15 - 0.3 * arcs) ** 3)
    np.testing.assert_allclose(motion.beam.curvature @ motion.coordinates[0], expected, atol=2e-5)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_asymmetry_is_a_stiffness_for_each_side(side: float) -> None:
    """Gravity bends the whole link one way."""
    physics = Physics(stiffness_asymmetry_ratio=0.2, in_plane_gravity_gy=side)
    plain = replace(CLAMPED, bending_stiffness=1.97 * (1.0 + 0.2 * side))
    sag = alone(CLAMPED, physics, Run(held=True), TIME[:2]).positions(MARKERS)
    expected = alone(plain, Physics(in_plane_gravity_gy=side), Run(held=True), TIME[:2]).positions(MARKERS)
    np.testing.assert_allclose(sag, expected, atol=1e-8)


def test_asymmetry_keeps_its_energy_and_swings_farther_to_the_soft_side() -> None:
    undamped = replace(CLAMPED, kelvin_voigt_time=0.0)
    motion = alone(undamped, Physics(stiffness_asymmetry_ratio=0.2), Run(tip_amplitudes=(0.05,)))
    bend = motion.coordinates @ motion.beam.curvature.T
    stored = energy(motion) + 0.5 * 0.2 * 1.97 * (bend * np.abs(bend)) @ motion.beam.basis.weights
    np.testing.assert_allclose(stored, stored[0], rtol=1e-5)
    tip = motion.positions([1.0])[:, 0, 1]
    assert tip.min() / tip.max() == pytest.approx(-np.sqrt(1.2 / 0.8), rel=0.02)


def modal_decay(matrix: Array, state: Array) -> Array:
    """First coordinate of a linear system (d, d) from a state (d,), at TIME."""
    step = expm(matrix * 0.002)
    path = [state]
    for _ in TIME[1:]:
        path.append(step @ path[-1])
    return np.array(path)[:, 0]


def tip_of(physics: Physics, mode: int) -> tuple[Array, float]:
    """Tip's y, m, of a small decay in one mode (from 0), and the mode's undamped pulsation, rad/s."""
    amplitudes = [0.0] * mode + [1e-5]
    motion = alone(CLAMPED, physics, Run(tip_amplitudes=tuple(amplitudes)))
    return motion.positions([1.0])[:, 0, 1], float(motion.beam.modes()[0][mode])


@pytest.mark.parametrize("spacing", [0.5, 1.0])
def test_structural_damping_is_half_the_loss_factor_in_every_mode_and_stiffens_them(spacing: float) -> None:
    """By 2 eta / pi for every factor e in frequency, as causality asks of a loss that is the same at all of them."""
    loss, undamped = 0.02, replace(CLAMPED, kelvin_voigt_time=0.0)
    hidden = Physics(structural_damping_loss_factor=loss, structural_damping_spacing=spacing)
    roots = np.linalg.eigvals(Extended(undamped, hidden).linear(0))
    pulsations, _ = Extended(undamped, Physics()).modes()
    # Of the arms' loss, as a share of it, and as much of what they add to the stiffness in this mode and in the first.
    ripple = 2.0 / np.cosh(np.pi**2 / (spacing * np.log(10.0)))
    error = 2.0 * (loss * ripple + loss**2)
    for expected in pulsations[:4]:
        root = min((root for root in roots if root.imag > 0.0), key=lambda root: abs(root.imag - expected))
        stiffness = 1.0 + 2.0 * loss / np.pi * np.log(expected / pulsations[0])
        assert (abs(root) / expected) ** 2 == pytest.approx(stiffness, abs=error)
        assert -2.0 * root.real / abs(root) * stiffness == pytest.approx(loss, abs=error)


@pytest.mark.parametrize("mode", [0, 1, 2])
def test_structural_damping_without_dispersion_is_a_damper_for_each_mode(mode: int) -> None:
    hidden = Physics(structural_damping_loss_factor=0.02, structural_damping_dispersion=0.0)
    tip, pulsation = tip_of(hidden, mode)
    ratio = 0.01 + 0.5 * 5e-4 * pulsation
    matrix = np.array([[0.0, 1.0], [-(pulsation**2), -2.0 * ratio * pulsation]])
    np.testing.assert_allclose(tip, modal_decay(matrix, np.array([1e-5, 0.0])), atol=1e-9)


@pytest.mark.parametrize("mode", [0, 1])
def test_creep_is_a_standard_linear_solid(mode: int) -> None:
    tip, pulsation = tip_of(Physics(viscoelastic_creep_ratio=0.05, viscoelastic_creep_time_constant=0.1), mode)
    squared = pulsation**2
    matrix = np.array([[0.0, 1.0, 0.0], [-squared, -squared * 5e-4, -squared * 0.05], [0.0, 1.0, -10.0]])
    np.testing.assert_allclose(tip, modal_decay(matrix, np.array([1e-5, 0.0, 0.0])), atol=1e-9)


def test_creep_relaxes_with_its_time_constant() -> None:
    # A bend held since t = 0 keeps 1 + ratio exp(-t / T) of its moment: kappa_m' = -kappa_m / T once kappa rests.
    matrix = Extended(CLAMPED, Physics(viscoelastic_creep_ratio=0.05)).linear(0)
    np.testing.assert_allclose(matrix[16:, 16:], -10.0 * np.eye(8))
    np.testing.assert_allclose(matrix[16:, 8:16], np.eye(8))


def test_stiffness_drift_follows_its_line() -> None:
    tip, pulsation = tip_of(Physics(stiffness_drift_rate=0.1), 0)
    squared = pulsation**2

    def slope(t: float, y: Array) -> list[float]:
        return [y[1], -squared * (1.0 + 0.1 * t) * (y[0] + 5e-4 * y[1])]

    expected = solve_ivp(slope, (0.0, 1.0), [1e-5, 0.0], t_eval=TIME, rtol=1e-9, atol=1e-14).y[0]
    np.testing.assert_allclose(tip, expected, atol=1e-9)


def test_slip_saturates_exponentially_and_unloads_elastically() -> None:
    loading = solve_ivp(
        lambda t, z: slip_rate(np.ones(1), z, 0.05), (0, 0.2), [0.0], t_eval=[0.05, 0.2], rtol=1e-10, atol=1e-13
    )
    np.testing.assert_allclose(loading.y[0], 0.05 * (1.0 - np.exp([-1.0, -4.0])), rtol=1e-6)
    assert slip_rate(-np.ones(1), np.array([0.04]), 0.05)[0] == -1.0


def test_hysteresis_is_elastic_below_its_yield_and_softens_above() -> None:
    physics = Physics(hysteresis_ratio=0.2, hysteresis_yield_angle=0.05)
    small, large = Run(tip_amplitudes=(1e-6,)), Run(tip_amplitudes=(0.1,))
    plain = simulate_runs(CLAMPED, Physics(), TIME, [small, large])
    slipping = simulate_runs(CLAMPED, physics, TIME, [small, large])
    scale = np.ptp(plain[0].positions([1.0])[:, 0, 1])
    assert rms(plain[0], slipping[0]) < 2e-4 * scale
    tips = [motion.positions([1.0])[:, 0, 1] for motion in (plain[1], slipping[1])]
    first_zeros = [TIME[np.flatnonzero(tip < 0.0)[0]] for tip in tips]
    assert first_zeros[1] > first_zeros[0] + 0.003


def static_bend(coefficient: float) -> Array:
    """Curvature of a sagging clamped link at its nodes, 1/m, over what the same moment does without the cubic term."""
    physics = Physics(cubic_stiffness_coefficient=coefficient, in_plane_gravity_gy=-1.5)
    motion = alone(CLAMPED, physics, Run(held=True), TIME[:2])
    return np.asarray(motion.beam.curvature @ motion.coordinates[0])


def test_cubic_stiffness_in_a_static_sag() -> None:
    plain, stiff = static_bend(0.0), static_bend(0.5)
    root, sag = plain[0], stiff[0]  # both bends are small enough for one and the same moment
    assert fsolve(lambda k: k * (1.0 + 0.5 * k**2) - root, root)[0] == pytest.approx(sag, rel=2e-3)
    assert abs(sag / root - 1.0) > 5e-3


def test_unloaded_link_is_an_arc() -> None:
    motion = alone(CLAMPED, Physics(rest_curvature_curvature=0.2), Run())
    arcs = np.array(MARKERS)
    expected = np.stack([np.sin(0.2 * arcs) / 0.2, (1.0 - np.cos(0.2 * arcs)) / 0.2], axis=-1)
    np.testing.assert_allclose(motion.positions(MARKERS), np.broadcast_to(expected, (501, 5, 2)), atol=1e-9)


# The air and the tone


@pytest.mark.parametrize(("linear", "quadratic"), [(0.2, 0.0), (0.0, 0.5)])
def test_drag_on_a_rigid_arm(linear: float, quadratic: float) -> None:
    rigid = solve_ivp(
        lambda _, y: [y[1], (0.3 - linear * y[1] / 3.0 - quadratic * y[1] * abs(y[1]) / 4.0) / INERTIA],
        (0.0, 1.0),
        [0.0, 0.0],
        t_eval=TIME,
        rtol=1e-9,
        atol=1e-12,
    )
    physics = Physics(linear_drag_coefficient=linear, quadratic_drag_coefficient=quadratic)
    np.testing.assert_allclose(alone(RIGID, physics, Run(np.full(501, 0.3))).theta, rigid.y[0], atol=2e-5)


def test_drag_takes_the_energy_that_its_power_says() -> None:
    physics = Physics(linear_drag_coefficient=0.1, quadratic_drag_coefficient=0.2)
    motion = alone(replace(CLAMPED, kelvin_voigt_time=0.0), physics, Run(tip_amplitudes=(0.2, 0.02)))
    heading, rate = motion.coordinates @ motion.beam.heading.T, motion.rates @ motion.beam.heading.T
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    velocity = motion.beam.basis.cumulative @ (rate[..., None] * normal)
    across = np.sum(velocity * normal, axis=-1)
    lost = (0.1 * across**2 + 0.2 * np.abs(across) ** 3) @ motion.beam.basis.weights
    spent = cumulative_simpson(lost, x=TIME, initial=0.0)
    np.testing.assert_allclose(energy(motion)[0] - energy(motion), spent, atol=1e-6)
    assert spent[-1] > 5e-3


def test_slow_tone_bends_the_link_as_a_static_force_on_its_tip() -> None:
    time = np.arange(1001) / 200.0
    physics = Physics(external_tone_amplitude=0.05, external_tone_frequency=0.05, external_tone_phase=0.3)
    damped = replace(CLAMPED, kelvin_voigt_time=0.1)  # what the tone's start sets swinging dies out
    tip = alone(damped, physics, Run(), time).positions([1.0])[:, 0, 1]
    response = 0.05 / (3.0 * 1.97 * (1.0 + 0.1j * 0.1 * np.pi))
    expected = np.imag(response * np.exp(1j * (0.1 * np.pi * time + 0.3)))
    np.testing.assert_allclose(tip[400:], expected[400:], atol=0.005 * abs(response))


def test_tone_turns_a_rigid_arm() -> None:
    physics = Physics(external_tone_amplitude=0.05, external_tone_frequency=2.0, external_tone_phase=0.4)
    pulsation = 4.0 * np.pi
    moved = np.sin(0.4) + pulsation * TIME * np.cos(0.4) - np.sin(pulsation * TIME + 0.4)
    np.testing.assert_allclose(alone(RIGID, physics, Run()).theta, 0.05 / INERTIA * moved / pulsation**2, atol=2e-6)
