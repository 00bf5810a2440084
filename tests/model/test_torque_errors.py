"""Torque errors vanish at the truth and nowhere else (eqs. 14-15)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.model.arms import GRAVITY, arms, one_joint_arm, random_motion
from tests.model.lagrange import TwoBodies, lagrange_bias, lagrange_mass_matrix
from vjm.chain.virtual_links import Chain
from vjm.errors import ShapeError
from vjm.model.dynamics import objective, torque_errors
from vjm.records import Payload

Array = NDArray[np.float64]
PAYLOAD = Payload(0.16, 0.03, 2e-4)
BODY_FIELDS = ("lengths", "mass_centers", "masses", "inertias")
JOINT_FIELDS = ("stiffness", "damping", "payload")


class Motion(NamedTuple):
    """A motion that the equations of motion allow, at T instants."""

    chain: Chain
    q: Array
    v: Array
    a: Array
    torque: Array

    def objective(self, chain: Chain | None = None, **changes: Array) -> float:
        """J of a changed chain or a changed motion."""
        moved = self._replace(**changes)
        errors = torque_errors(chain or self.chain, moved.q, moved.v, moved.a, moved.torque, PAYLOAD)
        return objective([errors])


@cache
def driven() -> Motion:
    """Two seconds of the revolute arm under a smooth torque; accelerations from the closed form at every state."""
    chain = one_joint_arm("revolute")
    closed = TwoBodies.of(chain.links[0], PAYLOAD, GRAVITY)

    def accelerations(t: Array, q: Array, v: Array) -> Array:
        load = np.stack([torque_at(t), -closed.stiffness * q[:, 1] - closed.damping * v[:, 1]], axis=-1)
        return np.linalg.solve(closed.mass_matrix(q[:, 1]), (load - closed.bias(*q.T, *v.T))[..., None])[..., 0]

    def slope(t: float, x: Array) -> Array:
        return np.concatenate([x[2:], accelerations(np.array([t]), x[None, :2], x[None, 2:])[0]])

    time = np.linspace(0.0, 2.0, 83)
    path = solve_ivp(slope, (0.0, 2.0), [0.3, -0.2, 1.0, 2.0], "DOP853", time, rtol=1e-11, atol=1e-12).y.T
    q, v = path[:, :2], path[:, 2:]
    return Motion(chain, q, v, accelerations(time, q, v), torque_at(time)[:, None])


def torque_at(time: Array) -> Array:
    return np.asarray(0.8 * np.sin(3.1 * time) + 0.5 * np.cos(7.3 * time))


@cache
def decaying() -> Motion:
    """The clamped link without gravity: beta phi'' + D phi' + K phi = 0 is solved by a decaying exponential."""
    chain = replace(one_joint_arm("clamped"), gravity=(0.0, 0.0))
    closed = TwoBodies.of(chain.links[0], PAYLOAD, (0.0, 0.0))
    root = np.roots([closed.beta, closed.damping, closed.stiffness])[0]
    assert root.imag != 0
    time = np.linspace(0.0, 2.0, 50)[:, None]
    phi = [np.real(0.4 * np.exp(0.3j) * root**k * np.exp(root * time)) for k in range(3)]
    return Motion(chain, *phi, np.zeros((50, 0)))


@pytest.mark.parametrize("motion", [driven, decaying])
def test_no_torque_error_at_the_truth(motion: Callable[[], Motion]) -> None:
    true = motion()
    errors = torque_errors(true.chain, true.q, true.v, true.a, true.torque, PAYLOAD)
    assert errors.shape == true.q.shape
    np.testing.assert_allclose(errors, 0.0, atol=1e-12)
    assert true.objective() < 1e-24


def one_per_cent_off(chain: Chain, field: str, k: int) -> Chain:
    link = chain.links[0]
    value = getattr(link, field)
    changed = value * 1.01 if np.ndim(value) == 0 else value * (1 + 0.01 * (np.arange(value.size) == k))
    return replace(chain, links=(replace(link, **{field: changed}),))


@pytest.mark.parametrize(
    ("field", "k"),
    [
        *((field, k) for field in BODY_FIELDS for k in (0, 1)),
        *((field, 0) for field in JOINT_FIELDS),
        ("hub_inertia", 0),
    ],
)
def test_every_parameter_of_a_driven_arm_counts(field: str, k: int) -> None:
    assert driven().objective(one_per_cent_off(driven().chain, field, k)) > 1e-9


@pytest.mark.parametrize(
    ("field", "k"),
    [*((field, 1) for field in BODY_FIELDS), *((field, 0) for field in JOINT_FIELDS)],
)
def test_every_parameter_of_a_clamped_arm_counts(field: str, k: int) -> None:
    assert decaying().objective(one_per_cent_off(decaying().chain, field, k)) > 1e-9


@pytest.mark.parametrize("field", [*BODY_FIELDS, "hub_inertia"])
def test_the_clamped_body_counts_nothing(field: str) -> None:
    assert decaying().objective(one_per_cent_off(decaying().chain, field, 0)) < 1e-24


@pytest.mark.parametrize("part", ["q", "v", "a", "torque"])
def test_every_column_of_the_motion_counts(part: str) -> None:
    true = getattr(driven(), part)
    for column in range(true.shape[1]):
        changed = true * (1 + 0.01 * (np.arange(true.shape[1]) == column))
        assert driven().objective(**{part: changed}) > 5e-9
    for sample in (0, len(true) // 2, len(true) - 1):
        changed = true.copy()
        changed[sample] += 0.1
        assert driven().objective(**{part: changed}) > 5e-9


def test_gravity_and_payload_count() -> None:
    true = driven()
    motion = true.q, true.v, true.a, true.torque
    assert objective([torque_errors(true.chain, *motion, PAYLOAD, (0.0, -9.81))]) > 1e-3
    assert objective([torque_errors(true.chain, *motion)]) > 1e-3
    turned = replace(true.chain, gravity=(0.0, 0.0))
    assert objective([torque_errors(turned, *motion, PAYLOAD, GRAVITY)]) < 1e-24


@given(arms(), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_errors_of_any_arm_are_the_balance_of_eq_14(chain: Chain, seed: int) -> None:
    q, v, a = random_motion(chain, 3, seed)
    applied = np.random.default_rng(seed).normal(size=(3, chain.active.size))
    errors = torque_errors(chain, q, v, a, applied)
    for t in range(3):
        inertial = lagrange_mass_matrix(chain, q[t]) @ a[t] + lagrange_bias(chain, q[t], v[t])
        balance = -inertial - chain.stiffness * q[t] - chain.damping * v[t]
        balance[chain.active] += applied[t]
        np.testing.assert_allclose(errors[t], balance, rtol=1e-9, atol=1e-8)


@given(arms(), st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_every_joint_s_acceleration_acts_on_its_own_row(chain: Chain, seed: int) -> None:
    """dtau_j/da_j = -M_jj < 0, the last joint included."""
    q, v, a = random_motion(chain, 2, seed)
    applied = np.zeros((2, chain.active.size))
    before = torque_errors(chain, q, v, a, applied)
    for j in range(chain.size):
        pushed = a.copy()
        pushed[:, j] += 1.0
        diagonal = [-lagrange_mass_matrix(chain, angles)[j, j] for angles in q]
        change = (torque_errors(chain, q, v, pushed, applied) - before)[:, j]
        np.testing.assert_allclose(change, diagonal, rtol=1e-6)


def test_samples_and_joints_are_not_swapped() -> None:
    """As many samples as joints: only the values tell them apart."""
    true = driven()
    two = [part[[10, 50]] for part in (true.q, true.v, true.a, true.torque)]
    np.testing.assert_allclose(torque_errors(true.chain, *two, PAYLOAD), 0.0, atol=1e-12)
    turned = [part.T.copy() if part.shape == (2, 2) else part for part in two]
    assert np.abs(torque_errors(true.chain, *turned, PAYLOAD)).max() > 0.1


def test_unmeasured_torque_silences_only_its_row() -> None:
    true = driven()
    torque = np.where(np.arange(len(true.q))[:, None] % 3 == 0, np.nan, true.torque)
    errors = torque_errors(true.chain, true.q, true.v, 1.1 * true.a, torque, PAYLOAD)
    expected = torque_errors(true.chain, true.q, true.v, 1.1 * true.a, true.torque, PAYLOAD)
    assert np.isnan(errors[::3, 0]).all()
    expected[::3, 0] = 0.0
    np.testing.assert_array_equal(np.nan_to_num(errors), expected)
    assert objective([errors]) == objective([np.delete(expected.ravel(), np.arange(0, expected.size, 6))])


def test_inputs_are_left_alone() -> None:
    true = driven()
    parts = [part.copy() for part in (true.q, true.v, true.a, true.torque)]
    torque_errors(true.chain, *parts, PAYLOAD)
    for part, original in zip(parts, (true.q, true.v, true.a, true.torque), strict=True):
        np.testing.assert_array_equal(part, original)


@pytest.mark.parametrize("shape", [(83,), (83, 2), (83, 0)])
def test_torques_that_do_not_fit_are_refused(shape: tuple[int, ...]) -> None:
    true = driven()
    with pytest.raises(ShapeError):
        torque_errors(true.chain, true.q, true.v, true.a, np.zeros(shape))


# J


def test_objective_is_the_mean_square_over_all_recordings() -> None:
    errors = [np.array([[1.0, 2.0], [-3.0, 0.5], [np.nan, 4.0]]), np.array([[7.0]])]
    assert objective(errors) == pytest.approx((5 + 9.25 + 16 + 49) / 6)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_whitened_noise_has_objective_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(3, 3))
    errors = rng.normal(size=(20000, 3)) @ mixing.T
    assert objective([errors @ np.linalg.inv(mixing).T]) == pytest.approx(1.0, rel=0.03)
