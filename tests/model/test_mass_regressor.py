"""Torques are linear in the virtual links' masses, first moments and moments of inertia."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.model.arms import arms, one_joint_arm, random_motion
from vjm.chain.virtual_links import Chain
from vjm.model.dynamics import build, inverse_dynamics, mass_regressor

Array = NDArray[np.float64]


def mass_parameters(chain: Chain) -> Array:
    """Mass, first moment and moment of inertia about the proximal end, body by body."""
    parts = []
    for link in chain.links:
        m, c = link.masses, link.mass_centers
        parts.append(np.stack([m, m * c, link.inertias + m * c**2], axis=-1).ravel())
    return np.concatenate(parts)


@given(arms(point_masses=False), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_regressor_times_parameters_is_the_torque(chain: Chain, seed: int) -> None:
    motion = random_motion(chain, 4, seed)
    regressor = mass_regressor(chain, *motion, chain.gravity)
    np.testing.assert_allclose(
        regressor @ mass_parameters(chain), inverse_dynamics(build(chain), *motion), rtol=1e-9, atol=1e-9
    )


@given(arms(), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_regressor_knows_no_masses_but_the_lengths(chain: Chain, seed: int) -> None:
    motion = random_motion(chain, 2, seed)
    other = replace(
        chain, links=tuple(replace(link, masses=2 + link.masses, hub_inertia=0.0, payload=0.0) for link in chain.links)
    )
    np.testing.assert_array_equal(
        mass_regressor(chain, *motion, chain.gravity), mass_regressor(other, *motion, chain.gravity)
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_regressor_is_pinocchio_s(seed: int) -> None:
    """One virtual link a joint, each in its joint's frame: columns m, m c and I are Pinocchio's m, m cx and Izz."""
    rng = np.random.default_rng(seed)
    link = replace(
        one_joint_arm("revolute").links[0],
        lengths=rng.uniform(0.2, 0.7, 4),
        masses=rng.uniform(0.2, 0.7, 4),
        mass_centers=rng.uniform(0.2, 0.7, 4),
        inertias=rng.uniform(0.01, 0.02, 4),
        stiffness=np.ones(3),
        damping=np.ones(3),
        cells=np.ones(3),
    )
    chain = Chain("arm", (link, replace(link, name="fore", lengths=rng.uniform(0.2, 0.7, 4))), (1.0, -9.81))
    model = build(chain).model
    motion = random_motion(chain, 3, seed)
    found = mass_regressor(chain, *motion, chain.gravity)
    for t in range(3):
        full = pin.computeJointTorqueRegressor(model, model.createData(), *(part[t] for part in motion))
        expected = full.reshape(chain.size, chain.size, 10)[:, :, [0, 1, 9]].reshape(chain.size, -1)
        np.testing.assert_allclose(found[t], expected, rtol=1e-10, atol=1e-10)


def test_a_body_that_stands_still_has_no_torque() -> None:
    chain = one_joint_arm("clamped")
    regressor = mass_regressor(chain, *random_motion(chain, 3, 1), chain.gravity)
    assert regressor.shape == (3, 1, 6)
    assert not regressor[:, :, :3].any()
    assert not regressor[:, :, 3].any()  # a mass on the joint's axis
    assert regressor[:, :, 4:].all()
