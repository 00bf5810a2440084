"""The rods' kinematics against the geometry of the rigid-body model."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.model.arms import arms, random_motion
from vjm.chain.virtual_links import Array, Chain
from vjm.effects import ClampCompliance, RestCurvature
from vjm.effects.loads import Rods
from vjm.model.dynamics import Mechanism

STEP = 1e-6


def extended(chain: Chain, compliant: bool, curvature: float) -> Chain:
    for i in range(len(chain.links)):
        chain = RestCurvature(curvature=curvature, link=i).chain(chain)
        chain = ClampCompliance(compliance=0.01, link=i).chain(chain) if compliant else chain
    return chain


def drawn(chain: Chain, q: Array, distances: Array) -> tuple[Array, Array]:
    """(B, 2) points at distances along the virtual links, and their headings (B,), as Pinocchio places them."""
    model = Mechanism(chain).model
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    placed, points, headings, b = {}, [], [], 0
    for joint, name in enumerate(model.names):
        placed[name] = data.oMi[joint]
    pose = placed["universe"]
    for link in chain.links:
        for end in ("joint", "root"):
            pose = placed.get(f"{link.name}_{end}", pose)
            # A gear's root joint is at the axis, a clamp's where the link begins.
            if link.hub_radius and (end == "root") == (link.root_stiffness is not None and link.root_inertia > 0):
                points.append(pose.act(np.array([distances[b], 0, 0]))[:2])
                headings.append(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0]))
                pose, b = pose * pin.SE3(np.eye(3), np.array([link.hub_radius, 0, 0])), b + 1
        for j, length in enumerate(link.lengths.tolist()):
            pose = placed[f"{link.name}_virtual_{j}"] if j else pose
            points.append(pose.act(np.array([distances[b], 0, 0]))[:2])
            headings.append(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0]))
            pose = pose * pin.SE3(np.eye(3), np.array([length, 0, 0]))
            b += 1
    return np.array(points), np.array(headings)


@settings(max_examples=40)
@given(arms(), st.booleans(), st.floats(-1, 1), st.integers(0, 99))
def test_velocities_and_forces_are_those_of_the_geometry(
    arm: Chain, compliant: bool, curvature: float, seed: int
) -> None:
    chain = extended(arm, compliant, curvature)
    q, v, _ = random_motion(chain, 1, seed)
    rods = Rods(chain)
    rng = np.random.default_rng(seed)
    distances = rng.uniform(0, 1, rods.lengths.size) * rods.lengths
    force = rng.normal(size=rods.lengths.size)

    direction = rods.directions(q[0])
    rate, normal = rods.motion(direction, v[0])
    _, headings = drawn(chain, q[0], distances)
    normals = np.stack([-np.sin(headings), np.cos(headings)], axis=-1)
    np.testing.assert_allclose(direction, np.exp(1j * headings), atol=1e-12)

    def along_normals(direction: Array) -> Array:
        moved = [drawn(chain, q[0] + sign * STEP * direction, distances)[0] for sign in (1, -1)]
        return np.sum((moved[0] - moved[1]) / (2 * STEP) * normals, axis=-1)

    np.testing.assert_allclose(normal + rate * distances, along_normals(v[0]), atol=1e-6)
    # Virtual work: each joint's force is what a turn of it makes the forces' points do.
    expected = [along_normals(unit) @ force for unit in np.eye(chain.size)]
    np.testing.assert_allclose(rods.torques(direction, force, force * distances), expected, atol=1e-6)
