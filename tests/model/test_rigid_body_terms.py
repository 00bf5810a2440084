"""M, h and inverse dynamics against the two-link arm's closed form and against the Lagrangian itself."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.model.arms import GRAVITY, arms, one_joint_arm, random_motion
from tests.model.lagrange import TwoBodies, lagrange_bias, lagrange_mass_matrix
from vjm.chain.virtual_links import Chain
from vjm.errors import InputError, ShapeError
from vjm.model.dynamics import Mechanism
from vjm.records import NO_PAYLOAD, Payload

Array = NDArray[np.float64]


def bias(mechanism: Mechanism, q: Array, v: Array) -> Array:
    """h(q, v): torques without accelerations."""
    return mechanism.inverse_dynamics(q, v, np.zeros_like(v))


@pytest.mark.parametrize("payload", [NO_PAYLOAD, Payload(0.16), Payload(0.16, 0.05, 4e-4)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_active_joint_and_virtual_joint_in_closed_form(payload: Payload, seed: int) -> None:
    chain = one_joint_arm("revolute")
    q, v, a = random_motion(chain, 7, seed)
    closed = TwoBodies.of(chain.links[0], payload, GRAVITY)
    M, h = closed.mass_matrix(q[:, 1]), closed.bias(*q.T, *v.T)
    mechanism = Mechanism(chain, payload)
    np.testing.assert_allclose(mechanism.mass_matrix(q), M, rtol=1e-12)
    np.testing.assert_allclose(bias(mechanism, q, v), h, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(
        mechanism.inverse_dynamics(q, v, a), np.einsum("tij,tj->ti", M, a) + h, rtol=1e-11, atol=1e-12
    )


@pytest.mark.parametrize("payload", [NO_PAYLOAD, Payload(0.16), Payload(0.16, 0.05, 4e-4)])
def test_clamped_link_has_one_moving_body(payload: Payload) -> None:
    chain = one_joint_arm("clamped")
    q, v, a = random_motion(chain, 6, 5)
    closed = TwoBodies.of(chain.links[0], payload, GRAVITY)
    gravity_torque = closed.mu1 * (GRAVITY[0] * np.sin(q) - GRAVITY[1] * np.cos(q))
    mechanism = Mechanism(chain, payload)
    np.testing.assert_allclose(mechanism.inverse_dynamics(q, v, a), closed.beta * a + gravity_torque, rtol=1e-12)
    np.testing.assert_allclose(mechanism.mass_matrix(q)[:, 0], closed.beta + 0 * q, rtol=1e-12)
    np.testing.assert_allclose(bias(mechanism, q, v), gravity_torque, rtol=1e-12)


def test_closed_form_is_the_lagrangian_s() -> None:
    chain = one_joint_arm("revolute")
    closed = TwoBodies.of(chain.links[0], NO_PAYLOAD, GRAVITY)
    for q, v in zip(*random_motion(chain, 8, 6)[:2], strict=True):
        np.testing.assert_allclose(closed.mass_matrix(q[1:])[0], lagrange_mass_matrix(chain, q), rtol=1e-13)
        np.testing.assert_allclose(closed.bias(*q[:, None], *v[:, None])[0], lagrange_bias(chain, q, v), rtol=1e-11)


@given(arms(), st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_any_arm_obeys_lagrange(chain: Chain, seed: int) -> None:
    q, v, a = random_motion(chain, 3, seed)
    mechanism = Mechanism(chain)
    M, h = mechanism.mass_matrix(q), bias(mechanism, q, v)
    for t in range(3):
        np.testing.assert_allclose(M[t], lagrange_mass_matrix(chain, q[t]), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(h[t], lagrange_bias(chain, q[t], v[t]), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        mechanism.inverse_dynamics(q, v, a), np.einsum("tij,tj->ti", M, a) + h, rtol=1e-9, atol=1e-9
    )


@given(arms(), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_forward_dynamics_undoes_inverse_dynamics(chain: Chain, seed: int) -> None:
    q, v, a = random_motion(chain, 1, seed)
    mechanism = Mechanism(chain)
    torque = mechanism.inverse_dynamics(q, v, a)
    np.testing.assert_allclose(mechanism.forward_dynamics(q[0], v[0], torque[0]), a[0], rtol=1e-6, atol=1e-6)


def test_gravity_stiffness_is_the_slope_of_the_static_torque() -> None:
    chain = one_joint_arm("revolute")
    mechanism = Mechanism(chain)
    q, rest, step = np.array([0.4, -0.9]), np.zeros((1, 2)), 1e-6
    slopes = [
        (bias(mechanism, (q + e)[None], rest) - bias(mechanism, (q - e)[None], rest))[0] / (2 * step)
        for e in step * np.eye(2)
    ]
    np.testing.assert_allclose(mechanism.gravity_stiffness(q), np.transpose(slopes), atol=1e-8)


# Batches


@pytest.mark.parametrize("joint", ["revolute", "clamped"])
@pytest.mark.parametrize("samples", [1, 2, 3, 2500])
def test_a_batch_is_its_samples_one_by_one(joint: Literal["revolute", "clamped"], samples: int) -> None:
    """Two samples of two joints would hide samples and joints swapped from any check of shapes."""
    chain = one_joint_arm(joint)
    mechanism = Mechanism(chain)
    motion = random_motion(chain, samples, 7)
    together = mechanism.inverse_dynamics(*motion)
    assert together.shape == (samples, chain.size)
    for t in {0, samples // 2, samples - 1}:
        alone = mechanism.inverse_dynamics(*(part[t : t + 1] for part in motion))
        np.testing.assert_array_equal(together[t], alone[0])


def test_memory_order_does_not_matter() -> None:
    chain = one_joint_arm("revolute")
    mechanism = Mechanism(chain)
    motion = random_motion(chain, 2, 8)
    expected = mechanism.inverse_dynamics(*motion)
    np.testing.assert_array_equal(mechanism.inverse_dynamics(*map(np.asfortranarray, motion)), expected)
    np.testing.assert_array_equal(mechanism.inverse_dynamics(*(part.tolist() for part in motion)), expected)
    reverse = mechanism.inverse_dynamics(*(part[::-1] for part in motion))
    np.testing.assert_array_equal(reverse, expected[::-1])


def test_no_samples_no_torques() -> None:
    assert Mechanism(one_joint_arm("revolute")).inverse_dynamics(*3 * [np.empty((0, 2))]).shape == (0, 2)


@pytest.mark.parametrize("shapes", [((3, 2), (3, 2), (4, 2)), ((3, 1), (3, 2), (3, 2)), ((2, 3), (2, 3), (2, 3))])
def test_arrays_that_do_not_fit_are_refused(shapes: tuple[tuple[int, int], ...]) -> None:
    with pytest.raises(ShapeError) as caught:
        Mechanism(one_joint_arm("revolute")).inverse_dynamics(*(np.zeros(shape) for shape in shapes))
    assert isinstance(caught.value, InputError)


@given(st.integers(0, 2**32 - 1), arms())
@settings(max_examples=20, deadline=None)
def test_forward_dynamics_is_the_inverse_of_inverse_dynamics(seed: int, chain: Chain) -> None:
    mechanism, (q, v, a) = Mechanism(chain), random_motion(chain, 4, seed)
    found = mechanism.forward_dynamics(q, v, mechanism.inverse_dynamics(q, v, a))
    np.testing.assert_allclose(found, a, rtol=1e-6, atol=1e-6 * np.abs(a).max())


# Gravity and payload


def test_gravity_given_replaces_the_chain_s() -> None:
    chain = one_joint_arm("revolute")
    q, rest, _ = random_motion(chain, 3, 9)
    other = TwoBodies.of(chain.links[0], NO_PAYLOAD, (0.5, 3.0)).bias(*q.T, *rest.T)
    np.testing.assert_allclose(bias(Mechanism(chain, gravity=(0.5, 3.0)), q, rest), other, rtol=1e-11)
    assert not bias(Mechanism(chain, gravity=(0.0, 0.0)), q, 0 * rest).any()


def test_extra_payload_hangs_on_the_last_tip_only() -> None:
    """Two bodies on one tip are one about their common centre, by the parallel axis theorem."""
    one = {"payload": 0.11, "payload_offset": 0.0, "payload_inertia": 1e-4}
    center = 0.2 * 0.03 / 0.31
    both = {
        "payload": 0.31,
        "payload_offset": center,
        "payload_inertia": 1e-4 + 0.11 * center**2 + 2e-4 + 0.2 * (0.03 - center) ** 2,
    }
    first, second, heavy = (one_joint_arm("revolute", **changes).links[0] for changes in ({}, one, both))
    chain, heavier = Chain("arm", (first, second), GRAVITY), Chain("arm", (first, heavy), GRAVITY)
    motion = random_motion(chain, 3, 10)
    np.testing.assert_allclose(
        Mechanism(chain, Payload(0.2, 0.03, 2e-4)).inverse_dynamics(*motion),
        Mechanism(heavier).inverse_dynamics(*motion),
        rtol=1e-12,
    )


@given(arms(), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_derivatives_are_those_of_inverse_dynamics(chain: Chain, seed: int) -> None:
    motion = random_motion(chain, 3, seed)
    mechanism, step = Mechanism(chain, Payload(0.1, 0.02, 1e-4)), 1e-5
    for k, found in enumerate(mechanism.derivatives(*motion)):
        for column, change in enumerate(step * np.eye(chain.size)):
            ahead, behind = (
                mechanism.inverse_dynamics(*(x + sign * change * (j == k) for j, x in enumerate(motion)))
                for sign in (1, -1)
            )
            expected = (ahead - behind) / (2 * step)
            np.testing.assert_allclose(found[:, :, column], expected, rtol=1e-5, atol=1e-6)
