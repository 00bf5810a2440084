"""Creep and hysteresis: relaxation, loops, and states that stay where they belong."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.effects.setups import LINK, chain_of
from vjm.chain.virtual_links import Array
from vjm.effects import Effect, Hysteresis, ViscoelasticCreep
from vjm.records import NO_PAYLOAD

CHAIN = chain_of(LINK, n=1)
STIFFNESS = CHAIN.stiffness[1]


def followed(effect: Effect, time: Array, phi: Array) -> tuple[Array, Array]:
    """The joint's extra moment and the internal state over time, for angles (T,), by Runge-Kutta steps."""
    rates, force = effect.state_rates(CHAIN), effect.force(CHAIN, NO_PAYLOAD)
    assert rates is not None
    assert force is not None
    q = np.stack([0 * phi, phi], axis=-1)
    z = effect.initial_states(CHAIN, q[0])
    states = [z]
    for k in range(0, len(time) - 2, 2):
        h = time[k + 2] - time[k]
        v = [np.gradient(q[k : k + 3], time[k : k + 3], axis=0, edge_order=2)[i] for i in range(3)]
        k1 = rates(time[k], q[k], v[0], z)
        k2 = rates(time[k + 1], q[k + 1], v[1], z + h / 2 * k1)
        k3 = rates(time[k + 1], q[k + 1], v[1], z + h / 2 * k2)
        k4 = rates(time[k + 2], q[k + 2], v[2], z + h * k3)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(z)
    found = np.array(states)
    moments = force(time[: len(found) * 2 : 2], q[: len(found) * 2 : 2], 0 * q[: len(found) * 2 : 2], found)
    return -moments[:, 1], found[:, 0]


def test_a_held_bend_relaxes() -> None:
    effect = ViscoelasticCreep(ratio=0.2, time_constant=0.3)
    time = np.linspace(0, 2, 2001)
    ramp = 0.1 * np.minimum(time / 0.01, 1.0)
    moment, _ = followed(effect, time, ramp)
    seen = time[::2] > 0.1
    expected = 0.2 * STIFFNESS * 0.1 * 0.3 / 0.01 * (np.exp(0.01 / 0.3) - 1) * np.exp(-time[::2] / 0.3)
    assert moment[seen] == pytest.approx(expected[seen], rel=1e-3)


@pytest.mark.parametrize("pulsation", [3.0, *(pytest.param(each, marks=pytest.mark.slow) for each in (0.5, 40.0))])
def test_a_standard_linear_solid_is_stiff_and_lossy_as_theory_says(pulsation: float) -> None:
    effect = ViscoelasticCreep(ratio=0.2, time_constant=0.3)
    time = np.linspace(0, 3 + 20 / pulsation, 10001)
    moment, _ = followed(effect, time, 0.1 * np.cos(pulsation * time))
    seen, there = time[::2] > 3, pulsation * time[::2]
    basis = np.stack([np.cos(there), -np.sin(there)], axis=-1)
    stored, lost = np.linalg.lstsq(basis[seen], moment[seen], rcond=None)[0] / (0.1 * STIFFNESS)
    quick = 1j * pulsation * 0.3
    assert stored + 1j * lost == pytest.approx(0.2 * quick / (1 + quick), abs=1e-3)


def test_creep_starts_relaxed() -> None:
    q = np.array([[0.3, 0.1], [0.2, -0.4]])
    assert not ViscoelasticCreep(ratio=0.2).initial_states(CHAIN, q).any()


def test_a_loop_far_beyond_the_yield_angle_has_the_area_of_dry_friction() -> None:
    effect = Hysteresis(ratio=0.3, yield_angle=0.02)
    yielding = effect.yields(CHAIN)[0]
    assert yielding == pytest.approx(0.02 * CHAIN.links[0].cells[0] / LINK.length)
    time = np.linspace(0, 3, 12001)
    phi = 0.5 * np.sin(2 * np.pi * time)
    moment, z = followed(effect, time, phi)
    assert np.abs(z).max() == pytest.approx(yielding, rel=1e-6)
    last = time[::2] >= 2.0  # one closed loop
    lost = np.trapezoid(moment[last], phi[::2][last])
    # K ratio times four amplitudes and the yield angle, less what the two reversals take: from y to zero along the
    # elastic line, y (2 y - y / 2), and on to -y exponentially, y^2.
    slip = 0.3 * STIFFNESS * yielding
    assert lost == pytest.approx(slip * (4 * 0.5 - 5 * yielding), rel=1e-4)


def test_a_small_loop_loses_next_to_nothing_and_is_as_stiff_as_before() -> None:
    effect = Hysteresis(ratio=0.3, yield_angle=0.5)
    time = np.linspace(0, 2, 4001)
    phi = 1e-4 * np.sin(2 * np.pi * time)
    moment, _ = followed(effect, time, phi)
    assert np.abs(moment).max() < 1e-3 * STIFFNESS * 1e-4


@pytest.mark.parametrize("rate", [3.0, 300.0, 3e5])
def test_slip_is_stable_however_fast_a_joint_turns_for_an_instant(rate: float) -> None:
    effect = Hysteresis(ratio=0.3, yield_angle=0.02)
    time = effect.max_step(CHAIN) / 2 * np.arange(401.0)
    _, z = followed(effect, time, rate * time)
    assert np.abs(z).max() < 1.5 * effect.yields(CHAIN)[0]


def test_bouc_wen_follows_its_own_equation() -> None:
    effect = Hysteresis(ratio=0.3, yield_angle=0.02)
    rates, y = effect.state_rates(CHAIN), effect.yields(CHAIN)[0]
    assert rates is not None
    for rate in (0.7, -0.4):
        for z in (0.6 * y, -0.3 * y, 0.0):
            expected = rate * (1 - abs(z) / y * (1 + np.sign(rate * z)) / 2)
            found = rates(np.array(0.0), np.zeros(2), np.array([9.0, rate]), np.array([z]))
            assert found == pytest.approx(expected)


@pytest.mark.parametrize("turn", [0.004, -0.02, 0.3])
def test_hysteresis_starts_where_a_slow_first_bend_ends(turn: float) -> None:
    """By the effect's own equation, from no bending on."""
    effect = Hysteresis(ratio=0.3, yield_angle=0.02)
    time = np.linspace(0.0, 1.0, 2001)
    _, z = followed(effect, time, turn * time)
    assert z[-1] == pytest.approx(effect.initial_states(CHAIN, np.array([0.0, turn]))[0], rel=1e-5)


@given(st.floats(-2, 2), st.floats(1e-3, 3))
def test_hysteresis_starts_with_the_angle_as_far_as_it_holds(angle: float, yield_angle: float) -> None:
    effect = Hysteresis(ratio=0.1, yield_angle=yield_angle)
    z, y = effect.initial_states(CHAIN, np.array([0.3, angle]))[0], effect.yields(CHAIN)[0]
    assert abs(z) <= (1 + 1e-12) * min(y, abs(angle)) + 1e-300
    assert z * angle >= 0
    if abs(angle) < 0.05 * y:
        assert z == pytest.approx(angle, rel=0.5 * abs(angle) / y + 1e-12)


def test_there_is_a_state_for_each_virtual_joint_of_its_link() -> None:
    chain = chain_of(LINK, LINK, n=3)
    for effect in (ViscoelasticCreep(ratio=0.1, link=1), Hysteresis(ratio=0.1, link=1)):
        assert effect.initial_states(chain, np.zeros(chain.size)).shape == (3,)
        motion, rates = effect.force(chain, NO_PAYLOAD), effect.state_rates(chain)
        assert motion is not None
        assert rates is not None
        q = np.zeros(chain.size)
        found = motion(np.array(0.0), q, q, np.full(3, 0.1))
        assert np.flatnonzero(found).tolist() == [5, 6, 7]
        assert found[5:] == pytest.approx(-0.01 * chain.links[1].stiffness)


def test_steps_follow_what_is_fast() -> None:
    assert ViscoelasticCreep(ratio=0.1, time_constant=0.01).max_step(CHAIN) < 2.5 * 0.01
    assert Hysteresis(ratio=0.1, yield_angle=0.01).max_step(CHAIN) < 0.01
