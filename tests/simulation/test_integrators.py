"""The fast integrator against the reference, both against closed forms, and the trajectory between the steps."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import PPoly, make_interp_spline

from tests.model.chains import extended_chain
from tests.model.lagrange import lagrange_mass_matrix, lagrange_potential
from tests.simulation.integrators import INTEGRATORS, simulate
from tests.simulation.setups import (
    DOWN,
    arm_of,
    end_load_shape,
    jerky_torque,
    recording_of,
    rig_of,
    rollout,
    steel_link,
    two_link_arm,
)
from vjm.chain.virtual_links import Chain
from vjm.effects import StructuralDamping
from vjm.model.modes import modes
from vjm.records import Recording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import default_step, simulate_trajectories
from vjm.simulation.system import Trajectory

Array = NDArray[np.float64]
TEN_SECONDS = np.arange(5001) / 500.0
REFERENCE = 4e-4  # s, with RK4: within 1e-8 m of 100 us, see below


class Case(NamedTuple):
    """A chain, what happens to it, and where it starts from rest."""

    chain: Chain
    recording: Recording
    start: Array


def fit_open_loop(n: int, payload: float = 0.0, gravity: tuple[float, float] = (0.0, 0.0)) -> Case:
    chain = arm_of(steel_link(n))
    recording = recording_of(chain, TEN_SECONDS, payload=payload, gravity=gravity)
    return Case(chain, recording, end_load_shape(chain, 0.1))


def driven(n: int, seed: int, payload: float = 0.0, gravity: tuple[float, float] = (0.0, 0.0)) -> Case:
    chain = arm_of(steel_link(n, "revolute"))
    recording = recording_of(chain, TEN_SECONDS, jerky_torque(1, seed), payload, gravity)
    return Case(chain, recording, np.zeros(n + 1) if gravity == (0.0, 0.0) else np.r_[-1.2, np.zeros(n)])


def two_links(seed: int) -> Case:
    chain = two_link_arm()
    return Case(chain, recording_of(chain, TEN_SECONDS, jerky_torque(2, seed)), np.zeros(chain.size))


def released(chain: Chain, gravity: tuple[float, float]) -> Case:
    """From straight, where it is not at rest."""
    return Case(chain, recording_of(chain, TEN_SECONDS, gravity=gravity), np.zeros(chain.size))


def noisy(n: int, seed: int) -> Case:
    """A measured torque: every sample has an error of its own."""
    chain = arm_of(steel_link(n, "revolute"))
    noise = np.random.default_rng(seed).normal(0.0, 0.05, TEN_SECONDS.size)
    recording = recording_of(chain, TEN_SECONDS, lambda t: (0.2 * np.sin(3 * t) + noise)[:, None])
    return Case(chain, recording, np.zeros(n + 1))


CASES = {
    "released, 4 joints": fit_open_loop(4),
    "released, 6 joints": fit_open_loop(6),
    "released with payload and gravity": fit_open_loop(6, 0.05, (1.0, -3.0)),
    "driven, 4 joints": driven(4, 1),
    "driven, 6 joints": driven(6, 2),
    "driven with payload and gravity": driven(6, 3, 0.05, DOWN),
    "driven by a noisy torque": noisy(4, 4),
    "two driven links": two_links(5),
    "a link on a link, released in gravity": released(extended_chain(), (0.0, -9.81)),
}

# With everything at once: elbow, noisy torque, payload and gravity. The others tell which of it is wrong.
FAST = ("two driven links", "driven by a noisy torque", "released with payload and gravity")


def markers_of(case: Case, integrator: str, step: float | None = None) -> Array:
    return simulate(
        case.chain, rig_of(case.chain), case.recording, case.start, 0 * case.start, integrator, step
    ).markers


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in FAST else [pytest.mark.slow]) for name in CASES]
)
def test_default_agrees_with_runge_kutta_to_a_micrometre(name: str) -> None:
    expected = markers_of(CASES[name], "rk4", REFERENCE)
    assert np.ptp(expected[:, -1], axis=0).max() > 0.1
    assert np.abs(markers_of(CASES[name], "exponential") - expected).max() < 1e-6


@pytest.mark.parametrize(
    ("n", "kelvin_voigt", "step"), [(20, 3e-4, 1e-4), pytest.param(40, 1e-4, 2.5e-5, marks=pytest.mark.slow)]
)
def test_long_chains_take_long_steps_as_exactly(n: int, kelvin_voigt: float, step: float) -> None:
    """The top mode, of 1 to 4 kHz, turns 3 to 15 times in a step; Runge-Kutta has to follow it."""
    chain = arm_of(steel_link(n, kelvin_voigt=kelvin_voigt))
    case = Case(chain, recording_of(chain, np.arange(101) / 100.0), end_load_shape(chain, 0.1))
    assert default_step(chain) > 3.5e-3
    assert np.abs(markers_of(case, "exponential") - markers_of(case, "rk4", step)).max() < 1e-6


@pytest.mark.parametrize("n", [8, *(pytest.param(n, marks=pytest.mark.slow) for n in (16, 24))])
def test_an_elbow_s_steps_are_short_enough_for_many_joints(n: int) -> None:
    """With steps and a linear part that few joints need, 24 a link are off by 0.05 mm after two seconds."""
    chain = two_link_arm(n)
    recording = recording_of(chain, TEN_SECONDS[:1001], jerky_torque(2, 5))
    case = Case(chain, recording, np.zeros(chain.size))
    found, finer = (markers_of(case, "exponential", default_step(chain) / k) for k in (1, 4))
    assert np.ptp(found[:, -1], axis=0).max() > 0.2
    assert np.abs(found - finer).max() < 1e-5


@pytest.mark.slow  # it asks of the reference alone
@pytest.mark.parametrize("name", ["released, 6 joints", "two driven links"])
def test_the_reference_s_own_step_is_short_enough(name: str) -> None:
    """Against its default, the 100 us of the paper's section 6.4."""
    case = CASES[name]
    brief = case._replace(recording=replace_time(case.recording, TEN_SECONDS[:1001]))
    assert np.abs(markers_of(brief, "rk4") - markers_of(brief, "rk4", REFERENCE)).max() < 1e-8


def replace_time(recording: Recording, time: Array) -> Recording:
    """The recording's beginning."""
    rows = slice(time.size)
    return replace(
        recording, time=time, theta=recording.theta[rows], tau=recording.tau[rows], markers=recording.markers[rows]
    )


@pytest.mark.parametrize(("integrator", "step", "least"), [("rk4", 4e-3, 3.7), ("exponential", 8e-3, 3.7)])
def test_both_are_of_fourth_order(integrator: str, step: float, least: float) -> None:
    chain = arm_of(steel_link(3))
    case = Case(chain, recording_of(chain, np.linspace(0.0, 0.96, 25)), end_load_shape(chain, 0.2))
    exact = markers_of(case, "rk4", 1e-4)
    errors = [np.abs(markers_of(case, integrator, step / k) - exact).max() for k in (1, 2)]
    assert np.log2(errors[0] / errors[1]) > least


# Laws


def energy(chain: Chain, q: Array, v: Array, payload: float) -> Array:
    """Kinetic, elastic and gravity's, J, at q, v (T, nv)."""
    tip = chain.links[-1]
    loaded = replace(chain, links=(*chain.links[:-1], replace(tip, payload=tip.payload + payload)))
    kinetic = [v_t @ lagrange_mass_matrix(loaded, q_t) @ v_t / 2 for q_t, v_t in zip(q, v, strict=True)]
    elastic = q**2 @ chain.stiffness / 2
    return np.asarray(np.array(kinetic) + elastic + [float(lagrange_potential(loaded, q_t).real) for q_t in q])


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("joint", ["clamped", "revolute"])
def test_undamped_motion_keeps_its_energy(integrator: str, joint: str) -> None:
    link = steel_link(4, joint, kelvin_voigt=0.0)  # type: ignore[arg-type]
    chain = replace(arm_of(link), gravity=DOWN)
    recording = recording_of(chain, np.arange(201) / 40.0, payload=0.05, gravity=DOWN)
    start = np.full(chain.size, 0.05)
    found = simulate(chain, rig_of(chain), recording, start, 0 * start, integrator, 5e-4)
    total = energy(chain, found.q, found.v, 0.05)
    assert np.ptp(np.sum(found.v**2, axis=1)) > 1.0
    assert np.ptp(total) < 1e-7 * (0.44 + 0.05) * 9.81


def test_damping_only_takes_energy_away() -> None:
    chain = arm_of(steel_link(4))
    recording = recording_of(chain, np.arange(201) / 40.0)
    found = simulate(chain, rig_of(chain), recording, end_load_shape(chain, 0.1), np.zeros(4))
    total = energy(chain, found.q, found.v, 0.0)
    assert (np.diff(total) < 1e-12).all()
    assert total[-1] < 0.97 * total[0]


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("mode", [0, pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_small_vibration_is_its_mode_s(integrator: str, mode: int) -> None:
    """x(t) = shape Re[(1 + i c) exp(r t)], r = -zeta w + i w sqrt(1 - zeta^2), at rest at t = 0."""
    chain = arm_of(steel_link(5, kelvin_voigt=1e-3))
    found = modes(chain)
    shape = 1e-6 * found.shapes[:, mode]
    omega, zeta = 2 * np.pi * found.frequencies[mode], found.damping_ratios[mode]
    recording = recording_of(chain, np.arange(301) / 150.0)
    path = simulate(chain, rig_of(chain), recording, shape, 0 * shape, integrator, 2e-4)
    root = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    motion = (1 + 1j * root.real / root.imag) * np.exp(root * recording.time)
    scale = np.abs(shape).max()
    np.testing.assert_allclose(path.q, np.outer(motion.real, shape), atol=1e-6 * scale)
    np.testing.assert_allclose(path.v, np.outer((root * motion).real, shape), atol=1e-6 * scale * omega)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_stiff_arm_swings_as_a_rigid_pendulum(integrator: str) -> None:
    """I theta'' = -m g r cos(theta), of a rod with hub and payload, whose ends are far from the small angles."""
    chain = replace(arm_of(steel_link(3, "revolute", bending_stiffness=2e4, kelvin_voigt=1e-5)), gravity=DOWN)
    time = np.arange(101) / 50.0
    inertia, moment = 0.02 + 0.44 / 3 + 0.3, 9.81 * (0.22 + 0.3)
    rigid = solve_ivp(
        lambda _, y: [y[1], -moment / inertia * np.cos(y[0])], (0, 2), [0.2, 0.0], "DOP853", time, rtol=1e-11
    )
    start = np.r_[0.2, np.zeros(3)]
    recording = recording_of(chain, time, payload=0.3, gravity=DOWN)
    found = simulate(chain, rig_of(chain), recording, start, 0 * start, integrator, 1e-4)
    assert np.ptp(rigid.y[0]) > 3.0
    np.testing.assert_allclose(found.theta[:, 0], rigid.y[0], atol=5e-4)


def test_a_torque_turns_a_free_arm_by_its_impulse() -> None:
    """Angular momentum about the hub is the impulse of a torque that is linear between samples."""
    chain = arm_of(steel_link(4, "revolute"))
    time = np.arange(201) / 100.0
    recording = recording_of(chain, time, lambda t: np.random.default_rng(3).normal(0.0, 0.1, (t.size, 1)))
    (found,) = simulate_trajectories([Arm(chain)], [recording], np.zeros((1, 5)), np.zeros((1, 5)))
    inside = found.time <= time[-1]
    momentum = [lagrange_mass_matrix(chain, q)[0] @ v for q, v in zip(found.q[inside], found.v[inside], strict=True)]
    impulse = PPoly.from_spline(make_interp_spline(time, recording.tau[:, 0], k=1)).antiderivative()
    np.testing.assert_allclose(momentum, impulse(found.time[inside]), atol=1e-8)


# Copies


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("same", [True, False], ids=["equal chains", "different chains"])
def test_copies_together_move_as_each_alone(integrator: str, same: bool) -> None:
    chains = [arm_of(steel_link(3, "revolute", bending_stiffness=1.97 + 0.3 * c * (not same))) for c in range(3)]
    recording = recording_of(chains[0], np.arange(101) / 100.0, jerky_torque(1, 7), 0.05, DOWN)
    rng = np.random.default_rng(8)
    q, v = rng.normal(0, 0.05, (3, 4)), rng.normal(0, 0.5, (3, 4))
    together = rollout(chains, recording, q, v, integrator, 1e-3)
    assert together[0].shape == (101, 3, 4)
    for c, chain in enumerate(chains):
        alone = rollout([chain], recording, q[c : c + 1], v[c : c + 1], integrator, 1e-3)
        np.testing.assert_allclose(together[0][:, c], alone[0][:, 0], atol=1e-10)
        np.testing.assert_allclose(together[1][:, c], alone[1][:, 0], atol=1e-8)


def test_copies_with_payloads_move_as_each_alone() -> None:
    chain = arm_of(steel_link(3, "revolute"))
    recording = recording_of(chain, np.arange(101) / 100.0, jerky_torque(1, 7))
    recordings = [replace(recording, payload=payload) for payload in (0.0, 0.1, 0.0, 0.1)]
    q, v = np.random.default_rng(8).normal(0, 0.05, (2, 4, 4))
    together = simulate_trajectories([Arm(chain)] * 4, recordings, q, v, step=1e-3)
    for k, found in enumerate(together):
        (alone,) = simulate_trajectories([Arm(chain)], recordings[k : k + 1], q[k : k + 1], v[k : k + 1], step=1e-3)
        np.testing.assert_allclose(found.q, alone.q, atol=1e-10)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_the_same_run_gives_the_same_bits(integrator: str) -> None:
    case = driven(3, 9, 0.02, DOWN)
    brief = case._replace(recording=replace_time(case.recording, TEN_SECONDS[:251]))
    np.testing.assert_array_equal(markers_of(brief, integrator), markers_of(brief, integrator))


# Between the steps


@given(st.integers(0, 2**32 - 1), st.integers(2, 7), st.floats(-50, 50), st.floats(1e-3, 0.5))
@settings(max_examples=50, deadline=None)
def test_quintics_are_sampled_exactly(seed: int, count: int, start: float, step: float) -> None:
    """Quintics of time, so that three derivatives at both ends of a step determine them."""
    rng = np.random.default_rng(seed)
    coefficients = rng.normal(size=(6, 2, 3))
    knots = start + step * np.arange(count)

    def at(time: Array, order: int) -> Array:
        scaled = polynomial.polyder(coefficients, order, axis=0)
        return np.moveaxis(polynomial.polyval((time - start) / (step * count), scaled), -1, 0) / (step * count) ** order

    trajectory = Trajectory(knots, at(knots, 0), at(knots, 1), at(knots, 2), at(knots, 0)[..., :0])
    time = np.sort(np.r_[knots, rng.uniform(knots[0], knots[-1], 20)])
    q, v = trajectory.sample(time)
    assert q.shape == (count + 20, 2, 3)
    np.testing.assert_allclose(q, at(time, 0), atol=1e-9 * max(1.0, abs(start) / step))
    np.testing.assert_allclose(v, at(time, 1), atol=1e-9 * max(1.0, abs(start) / step) / step)


def test_instants_between_steps_are_as_good_as_steps() -> None:
    chain = arm_of(steel_link(4))
    irregular = np.sort(np.random.default_rng(1).uniform(0.0, 2.0, 83))
    irregular[0] = 0.0
    start = end_load_shape(chain, 0.1)
    found = simulate(chain, rig_of(chain), recording_of(chain, irregular), start, 0 * start)
    exact = simulate(chain, rig_of(chain), recording_of(chain, irregular), start, 0 * start, "rk4", 2e-4)
    assert irregular.size * default_step(chain) > 0.4  # a step has few instants, most inside it
    np.testing.assert_allclose(found.markers, exact.markers, atol=1e-6)


@pytest.mark.parametrize("dispersion", [0.0, 1.0])
@pytest.mark.parametrize("loss_factor", [0.1, 0.3])
def test_a_lossy_link_is_simulated_in_steps_that_its_loss_needs(loss_factor: float, dispersion: float) -> None:
    """The headings of its end, and at 10 % no shorter steps than without loss."""
    chain, recording, *_ = driven(8, 4)
    arm = Arm.of(chain, (StructuralDamping(link=0, loss_factor=loss_factor, dispersion=dispersion),))
    at_rest = [np.zeros(chain.size)]
    (found,) = simulate_trajectories([arm], [recording], at_rest, at_rest)
    step = float(found.time[1])
    assert step > 0.99 * default_step(chain) or loss_factor > 0.1
    (finer,) = simulate_trajectories([arm], [recording], at_rest, at_rest, step=step / 4)
    assert np.abs((found.q[:2000] - finer.q[:8000:4]).sum(axis=1)).max() < 1e-6
