"""Frames Sigma_i and markers of arms of several links (eq. 9)."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.chain.beams import beam_chain
from vjm.chain.curve import curve_map, marker_pose_slopes, marker_poses
from vjm.chain.virtual_links import Chain, MovingBase

Array = NDArray[np.float64]
Joint = Literal["revolute", "clamped"]
ARCS = (np.array([0.3, 0.8]), np.array([0.1, 0.2, 0.5]), np.array([0.4]))
LENGTHS = (0.8, 0.5, 0.4)
BASE, OWN = (False, False, False), (True, True, True)
PROXIMAL = (np.zeros(1),) * 3  # where each link's frame is
JOINTS = list(product(["revolute", "clamped"], repeat=3))
SEEDS = st.integers(0, 2**32 - 1)


def arm(joints: tuple[Joint, ...]) -> Chain:
    links = [
        replace(beam_chain(n, joint=joint, length=length, distal=distal).links[0], name=f"link_{n}")
        for n, joint, length, distal in zip((3, 2, 1), joints, LENGTHS, ("joined", "joined", "free"), strict=True)
    ]
    return Chain("arm", tuple(links))


def posture(chain: Chain, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(-0.7, 0.7, chain.size)


def complex_of(points: Array) -> NDArray[np.complex128]:
    return np.asarray(points[..., 0] + 1j * points[..., 1])


@given(st.sampled_from(JOINTS), SEEDS)
@settings(max_examples=40, deadline=None)
def test_each_frame_sits_on_the_tip_before_it(joints: tuple[Joint, ...], seed: int) -> None:
    """Where the curve before it ends, along its tangent, turned by the active angle."""
    chain = arm(joints)
    q = posture(chain, seed)
    origins, headings = marker_poses(chain, q, PROXIMAL, BASE)
    tips = marker_poses(chain, q, tuple(np.array([length]) for length in LENGTHS), BASE)[0]
    np.testing.assert_array_equal(origins[0], 0.0)
    np.testing.assert_allclose(origins[1:], tips[:2], atol=1e-12)
    heading = 0.0
    for i, (link, part) in enumerate(zip(chain.links, chain.passive_slices, strict=True)):
        heading += q[part.start - 1] if link.joint == "revolute" else 0.0
        assert headings[i] == pytest.approx(heading, abs=1e-12)
        heading += float(curve_map(link, [link.length]).heading[0] @ q[part])


@given(st.sampled_from(JOINTS), SEEDS)
@settings(max_examples=40, deadline=None)
def test_markers_in_the_link_frame_are_the_same_points(joints: tuple[Joint, ...], seed: int) -> None:
    chain = arm(joints)
    q = posture(chain, seed)
    origins, headings = marker_poses(chain, q, PROXIMAL, BASE)
    base, own = marker_poses(chain, q, ARCS, BASE)[0], marker_poses(chain, q, ARCS, OWN)[0]
    of_link = np.repeat([0, 1, 2], [2, 3, 1])
    carried = complex_of(origins)[of_link] + np.exp(1j * headings[of_link]) * complex_of(own)
    np.testing.assert_allclose(carried, complex_of(base), atol=1e-12)
    mixed = marker_poses(chain, q, ARCS, (False, True, False))[0]
    np.testing.assert_array_equal(mixed, np.concatenate([base[:2], own[2:5], base[5:]]))


@given(st.sampled_from([joints for joints in JOINTS if joints[0] == "revolute"]), SEEDS, st.floats(-6, 6))
@settings(max_examples=40, deadline=None)
def test_turning_the_base_turns_everything(joints: tuple[Joint, ...], seed: int, turn: float) -> None:
    chain = arm(joints)
    q = posture(chain, seed)
    turned = q + turn * np.eye(chain.size)[0]
    before, after = (complex_of(marker_poses(chain, each, ARCS, BASE)[0]) for each in (q, turned))
    np.testing.assert_allclose(after, np.exp(1j * turn) * before, atol=1e-12)
    np.testing.assert_array_equal(marker_poses(chain, q, ARCS, OWN)[0], marker_poses(chain, turned, ARCS, OWN)[0])


@given(st.sampled_from(JOINTS), SEEDS)
@settings(max_examples=20, deadline=None)
def test_many_postures_at_once_are_the_same_one_by_one(joints: tuple[Joint, ...], seed: int) -> None:
    chain = arm(joints)
    q = np.random.default_rng(seed).uniform(-0.7, 0.7, (3, 2, chain.size))
    together = marker_poses(chain, q, ARCS, BASE)[0]
    assert together.shape == (3, 2, 6, 2)
    for index in np.ndindex(3, 2):
        np.testing.assert_allclose(together[index], marker_poses(chain, q[index], ARCS, BASE)[0], atol=1e-13)


def test_a_straight_arm_lies_along_its_active_angles() -> None:
    chain = arm(("revolute", "revolute", "clamped"))
    q = np.zeros(chain.size)
    q[chain.active] = [0.4, -1.1]
    points = complex_of(marker_poses(chain, q, ARCS, BASE)[0])
    first, second = np.exp(0.4j), np.exp(-0.7j)
    expected = [0.3 * first, 0.8 * first, *(0.8 * first + np.array([0.1, 0.2, 0.5, 0.9]) * second)]
    np.testing.assert_allclose(points, expected, atol=1e-12)


def test_links_on_hubs_begin_on_their_rims() -> None:
    chain = arm(("revolute", "revolute", "clamped"))
    links = [replace(link, hub_radius=radius) for link, radius in zip(chain.links, (0.1, 0.03, 0.0), strict=True)]
    chain = replace(chain, links=tuple(links))
    q = np.zeros(chain.size)
    q[chain.active] = [0.4, -1.1]
    first, second = np.exp(0.4j), np.exp(-0.7j)
    points = complex_of(marker_poses(chain, q, ARCS, BASE)[0])
    expected = [0.4 * first, 0.9 * first, *(0.9 * first + (0.03 + np.array([0.1, 0.2, 0.5, 0.9])) * second)]
    np.testing.assert_allclose(points, expected, atol=1e-12)
    own = complex_of(marker_poses(chain, q, ARCS, OWN)[0])
    np.testing.assert_allclose(own, np.concatenate(ARCS), atol=1e-12)
    # A compliant clamp turns on the rim, a gear at the axis.
    for geared, place in ((0.0, 0.1 + 0.3 * np.exp(0.2j)), (1e-3, 0.4 * np.exp(0.2j))):
        rooted = replace(chain.links[0], root_stiffness=5.0, root_inertia=geared)
        turned = replace(chain, links=(rooted, *chain.links[1:]))
        angles = np.zeros(turned.size)
        angles[[0, 1]] = 0.4, 0.2
        np.testing.assert_allclose(complex_of(marker_poses(turned, angles, ARCS, BASE)[0])[0], place * first)


def test_joints_of_an_outer_link_leave_inner_markers_alone() -> None:
    chain = arm(("revolute", "revolute", "revolute"))
    q = posture(chain, 1)
    moved = q.copy()
    moved[chain.passive_slices[2].start - 1 :] += 0.3
    before, after = marker_poses(chain, q, ARCS, BASE)[0], marker_poses(chain, moved, ARCS, BASE)[0]
    np.testing.assert_array_equal(before[:5], after[:5])
    assert np.abs(before[5] - after[5]).max() > 0.05


@given(
    st.sampled_from(JOINTS),
    SEEDS,
    st.booleans(),
    st.booleans(),
    st.sampled_from([BASE, OWN, (False, True, False)]),
    st.sampled_from([0.0, 1e-3]),
)
@settings(max_examples=40, deadline=None)
def test_slopes_are_those_of_the_poses(
    joints: tuple[Joint, ...], seed: int, moves: bool, gives: bool, frames: tuple[bool, ...], geared: float
) -> None:
    """Of curved links too, on hubs, on roots that give and on a base that moves, along any directions."""
    chain, rng = arm(joints), np.random.default_rng(seed)
    root = {"root_stiffness": 2.0, "root_inertia": geared} if gives else {}
    links = [
        replace(link, rest_curvature=rng.normal(), hub_radius=0.1 * (link.joint == "revolute"), **root)
        for link in chain.links
    ]
    base = MovingBase(mass=1.0, stiffness=3.0, damping=0.1, direction=rng.uniform(-3, 3)) if moves else None
    chain = replace(chain, links=tuple(links), base=base)
    q, directions = rng.uniform(-0.7, 0.7, (5, chain.size)), rng.normal(size=(chain.size, 3))
    slopes, turning = marker_pose_slopes(chain, q, directions, ARCS, frames)
    assert (slopes.shape, turning.shape) == ((5, 6, 2, 3), (6, 3))
    for k, direction in enumerate(1e-5 * directions.T):
        after, before = (marker_poses(chain, q + change, ARCS, frames) for change in (direction, -direction))
        np.testing.assert_allclose(slopes[..., k], (after[0] - before[0]) / 2e-5, atol=1e-7)
        np.testing.assert_allclose(np.tile(turning[:, k], (5, 1)), (after[1] - before[1]) / 2e-5, atol=1e-8)
