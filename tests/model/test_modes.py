"""Natural frequencies, damping ratios and positions of rest in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.optimize import brentq

from tests.model.arms import arms, one_joint_arm
from tests.model.lagrange import TwoBodies, lagrange_bias, lagrange_mass_matrix
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, ShapeError
from vjm.model.dynamics import mechanism_of
from vjm.model.modes import linearise, modes, modes_of
from vjm.records import NO_PAYLOAD, Payload

STILL = (0.0, 0.0)


@pytest.mark.parametrize("payload", [NO_PAYLOAD, Payload(0.16), Payload(0.16, 0.05, 4e-4)])
def test_clamped_link_with_one_joint(payload: Payload) -> None:
    """Beta phi'' + D phi' + K phi = 0: omega = sqrt(K / beta), zeta = D / (2 sqrt(K beta))."""
    chain = one_joint_arm("clamped")
    closed = TwoBodies.of(chain.links[0], payload, STILL)
    found = modes(chain, payload, STILL)
    omega = np.sqrt(closed.stiffness / closed.beta)
    np.testing.assert_allclose(found.frequencies, [omega / (2 * np.pi)], rtol=1e-12)
    np.testing.assert_allclose(found.damping_ratios, [closed.damping / (2 * omega * closed.beta)], rtol=1e-12)
    np.testing.assert_allclose(np.abs(found.shapes), [[closed.beta**-0.5]], rtol=1e-12)


@pytest.mark.parametrize("payload", [NO_PAYLOAD, Payload(0.16), Payload(0.16, 0.05, 4e-4)])
def test_free_hub_with_one_joint(payload: Payload) -> None:
    """Angular momentum is nil: theta = -(M12 / M11) phi; so (det M / M11) phi'' + D phi' + K phi = 0."""
    chain = one_joint_arm("revolute")
    closed = TwoBodies.of(chain.links[0], payload, STILL)
    M = closed.mass_matrix(np.zeros(1))[0]
    reduced = np.linalg.det(M) / M[0, 0]
    omega = np.sqrt(closed.stiffness / reduced)
    found = modes(chain, payload, STILL)
    np.testing.assert_allclose(found.frequencies, [omega / (2 * np.pi)], rtol=1e-12)
    np.testing.assert_allclose(found.damping_ratios, [closed.damping / (2 * omega * reduced)], rtol=1e-12)
    np.testing.assert_allclose(found.shapes[0] / found.shapes[1], -M[0, 1] / M[0, 0], rtol=1e-10)


def test_a_heavy_hub_is_a_clamp() -> None:
    free = modes(one_joint_arm("revolute", hub_inertia=1e6), gravity=STILL)
    np.testing.assert_allclose(free.frequencies, modes(one_joint_arm("clamped"), gravity=STILL).frequencies, rtol=1e-6)


@pytest.mark.parametrize("pull", [9.81, -3.0])
def test_gravity_along_the_link_stiffens_it(pull: float) -> None:
    chain = one_joint_arm("clamped")
    closed = TwoBodies.of(chain.links[0], NO_PAYLOAD, STILL)
    omega = np.sqrt((closed.stiffness + closed.mu1 * pull) / closed.beta)
    found = modes(chain, gravity=(pull, 0.0))
    np.testing.assert_allclose(found.frequencies, [omega / (2 * np.pi)], rtol=1e-12)
    np.testing.assert_allclose(linearise(chain, gravity=(pull, 0.0))[3], 0.0, atol=1e-12)


@pytest.mark.parametrize("theta", [0.0, 0.8, -2.5])
def test_rest_is_where_the_spring_holds_the_weight(theta: float) -> None:
    """K phi = mu1 g cos(theta + phi) for gravity -g along y, downwards bending being negative."""
    chain = one_joint_arm("revolute")
    closed = TwoBodies.of(chain.links[0], Payload(0.16), (0.0, -9.81))
    phi = brentq(lambda x: closed.stiffness * x + 9.81 * closed.mu1 * np.cos(theta + x), -3, 3, xtol=1e-15)
    _, _, K, found = linearise(chain, Payload(0.16), (0.0, -9.81), theta)
    np.testing.assert_allclose(found, [theta, phi], atol=1e-11)
    sine = 9.81 * np.array([closed.mu0 * np.sin(theta), closed.mu1 * np.sin(theta + phi)])
    expected = [[-sine.sum(), -sine[1]], [-sine[1], closed.stiffness - sine[1]]]
    np.testing.assert_allclose(K, expected, atol=1e-9)


@given(arms())
@settings(max_examples=40, deadline=None)
def test_modes_of_any_arm_solve_the_linear_equation(chain: Chain) -> None:
    chain = replace(chain, gravity=STILL)
    M = lagrange_mass_matrix(chain, np.zeros(chain.size))
    K, D = np.diag(chain.stiffness), np.diag(chain.damping)
    found = modes(chain)
    assert found.frequencies.size == chain.passive.size  # as many rigid-body motions as active joints
    assert (np.diff(found.frequencies) >= 0).all()
    squares = (2 * np.pi * found.frequencies) ** 2
    scale = np.abs(K @ found.shapes).max()
    np.testing.assert_allclose(K @ found.shapes, M @ found.shapes * squares, atol=1e-6 * scale)
    np.testing.assert_allclose(found.shapes.T @ M @ found.shapes, np.eye(squares.size), atol=1e-8)
    shares = np.diag(found.shapes.T @ D @ found.shapes)
    np.testing.assert_allclose(found.damping_ratios, shares / (2 * np.sqrt(squares)), rtol=1e-9)


@given(arms())
@settings(max_examples=40, deadline=None)
def test_damping_in_proportion_to_stiffness_is_exact(chain: Chain) -> None:
    """D = T K: the damped eigenvalues have the ratio omega T / 2."""
    time = 1e-3
    links = tuple(replace(link, damping=time * link.stiffness) for link in chain.links)
    found = modes(replace(chain, links=links), gravity=STILL)
    np.testing.assert_allclose(found.damping_ratios, np.pi * found.frequencies * time, rtol=1e-9)


@given(arms())
@settings(max_examples=40, deadline=None)
def test_at_rest_every_virtual_joint_is_balanced(chain: Chain) -> None:
    theta = np.linspace(-1.0, 1.0, chain.active.size)
    stiff = tuple(replace(link, stiffness=1000 * link.stiffness) for link in chain.links)
    chain = replace(chain, links=stiff)
    q = linearise(chain, theta=theta)[3]
    np.testing.assert_array_equal(q[chain.active], theta)
    balance = lagrange_bias(chain, q, np.zeros(chain.size)) + chain.stiffness * q
    np.testing.assert_allclose(balance[chain.passive], 0.0, atol=1e-8)


@settings(max_examples=30, deadline=None)
@given(arms())
def test_linear_equations_are_those_of_the_angles_asked_for(chain: Chain) -> None:
    """Also where another angle was asked for just before, and what came out of that was changed."""
    gravity = (0.0, 0.0)
    for theta in np.linspace(-1.0, 1.0, 3):
        M, _, _, q = linearise(chain, NO_PAYLOAD, gravity, theta)
        np.testing.assert_array_equal(q[chain.active], theta)
        np.testing.assert_allclose(
            M, mechanism_of(chain, NO_PAYLOAD, gravity).mass_matrix(q[None])[0], rtol=1e-9, atol=1e-15
        )
        q += 1.0


@pytest.mark.parametrize(
    ("stiffness", "gravity"), [(0.0, (0.0, -9.81)), (0.5, (-9.81, 0.0)), (0.5, (-9.81, -0.1))], ids=str
)
def test_a_link_that_falls_over_has_no_position_of_rest(stiffness: float, gravity: tuple[float, float]) -> None:
    """No spring at all, and an upright link too heavy for its spring: balanced at best."""
    chain = one_joint_arm("clamped", stiffness=[stiffness], payload=1.0)
    for find in (linearise, modes):
        with pytest.raises(InsufficientDataError):
            find(chain, gravity=gravity)


def test_a_body_without_mass_is_refused() -> None:
    with pytest.raises(ShapeError):
        modes_of(np.zeros((1, 1)), np.ones((1, 1)), np.ones((1, 1)))
