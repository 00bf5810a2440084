"""Angles: phi -> markers -> phi, by each method, for arms of one to three links."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vjm.chain.curve import marker_poses
from vjm.chain.layout import Layout, layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError
from vjm.markers.angles import AngleMethod, ShapeSettings, estimate_angles
from vjm.records import Link, Recording, Rig

Array = NDArray[np.float64]
N = 3


def arm(links: int, joints: int = N, markers: tuple[float, ...] | None = None) -> tuple[Rig, list[Layout], Chain]:
    lengths = (1.0, 0.7, 0.45)[:links]
    rig_links, cuts, chains = [], [], []
    for i, length in enumerate(lengths):
        distal = "free" if i == links - 1 else "joined"
        cut = layout(length, joints, "end-corrected", distal)
        arcs = markers or tuple(np.linspace(length / 4, length, 4).tolist())
        link = Link(f"link{i}", "revolute" if i else "clamped", length, 0.3, 1.5, arcs)
        rig_links.append(link)
        cuts.append(cut)
        chains.append(uniform_chain(link, cut))
    return Rig("arm", tuple(rig_links)), cuts, Chain("arm", tuple(chains))


def recording(chain: Chain, q: Array, markers: Array) -> Recording:
    time = 0.01 * np.arange(len(q))
    theta = q[:, chain.active]
    return Recording(time, markers, theta, np.full_like(theta, np.nan), kind="decay", role="train", file="r.csv")


def bends(rng: np.random.Generator, chain: Chain, frames: int, size: float) -> Array:
    q = rng.uniform(-size, size, (frames, chain.size))
    q[:, chain.active] = rng.uniform(-3, 3, (frames, chain.active.size))
    return q


@pytest.mark.parametrize("links", [1, 2, 3])
@given(seed=st.integers(0, 2**31), size=st.floats(0.01, 1.0))
@settings(max_examples=15, deadline=None)
def test_angles_come_back_through_the_curve(links: int, seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    rig, cuts, chain = arm(links)
    q = bends(rng, chain, 12, size)
    arcs = tuple(np.array(link.markers) for link in rig.links)
    markers = marker_poses(chain, q, arcs, (False,) * links)[0]
    settings_ = ShapeSettings("clamped-polynomial", (3,) * links, "curve")
    found = estimate_angles(rig, cuts, recording(chain, q, markers), settings_, 3e-4, 1e-4)
    assert np.abs(found.q - q).max() < 1e-9


def joints_of(chain: Chain, q: Array) -> Array:
    """Ends of the virtual links 1 .. n of every link in the base frame, by adding up chords."""
    result = []
    position, heading = np.zeros((len(q), 2)), np.zeros(len(q))
    columns = iter(q.T)
    for link in chain.links:
        if link.joint == "revolute":
            heading = heading + next(columns)
        for j, length in enumerate(link.lengths):
            if j:
                heading = heading + next(columns)
            position = position + length * np.column_stack([np.cos(heading), np.sin(heading)])
            if j:
                result.append(position)
    return np.stack(result, axis=1)


@pytest.mark.parametrize("links", [1, 2, 3])
@given(seed=st.integers(0, 2**31), size=st.floats(0.01, 0.4))
@settings(max_examples=15, deadline=None)
def test_angles_come_back_through_representative_points(links: int, seed: int, size: float) -> None:
    """Markers at the virtual joints: a polynomial with as many terms goes through them all (eqs. 2-12)."""
    rng = np.random.default_rng(seed)
    rig, cuts, chain = arm(links)
    placed = []
    for link, cut in zip(rig.links, cuts, strict=True):
        ends = tuple(np.cumsum(cut.lengths)[1:].tolist())
        placed.append(Link(**{**link.__dict__, "markers": ends}))
    q = bends(rng, chain, 12, size)
    settings_ = ShapeSettings("clamped-polynomial", (N,) * links, "points")
    data = recording(chain, q, joints_of(chain, q))
    found = estimate_angles(Rig("arm", tuple(placed)), cuts, data, settings_, 3e-4, 1e-4)
    assert found.unsolved == 0
    assert np.abs(found.q - q).max() < 1e-9


def test_the_curvature_reading_approaches_the_curve_as_the_shape_gets_finer() -> None:
    arcs = tuple(np.linspace(0.1, 1.0, 10).tolist())
    errors = []
    for order in (2, 4, 6):
        rig, cuts, chain = arm(1, 6, arcs)
        s = chain.links[0].joint_arcs
        q = (0.36 * (1 - s) * cuts[0].cells)[None] * np.array([[0.3], [1.0]])
        data = recording(chain, q, marker_poses(chain, q, (np.array(arcs),), (False,))[0])
        found = estimate_angles(rig, cuts, data, ShapeSettings("clamped-polynomial", (order,)), 3e-4, 1e-4)
        errors.append(np.abs(found.q - q).max())
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-4


def test_a_point_that_does_not_exist_is_reported_not_invented() -> None:
    rig, cuts, chain = arm(1, markers=(0.3, 0.6, 1.0))
    markers = np.zeros((3, 3, 2))
    markers[:, :, 0] = [0.3, 0.6, 1.0]
    markers[1, :, 0] = [0.1, 0.2, 0.3]  # bunched up: the curve climbs so steeply that its slope by arc exceeds one
    markers[1, :, 1] = [0.4, 0.9, 1.6]
    data = recording(chain, np.zeros((3, chain.size)), markers)
    found = estimate_angles(rig, cuts, data, ShapeSettings("clamped-polynomial", (3,), "curvature"), 3e-4, 1e-4)
    assert found.unsolved == 1
    assert np.isnan(found.q[1]).any()
    assert np.isfinite(found.q[[0, 2]]).all()


def test_representative_points_beyond_the_links_end_are_refused() -> None:
    rig, cuts, chain = arm(1, markers=(0.3, 0.6, 1.0))
    longer = [replace(cuts[0], lengths=1.2 * cuts[0].lengths)]
    markers = np.zeros((2, 3, 2))
    markers[:, :, 0] = [0.3, 0.6, 1.0]
    data = recording(chain, np.zeros((2, chain.size)), markers)
    found = estimate_angles(rig, longer, data, ShapeSettings("clamped-polynomial", (2,), "points"), 3e-4, 1e-4)
    assert found.unsolved == 2
    assert np.isnan(found.q[:, -1]).all()


@pytest.mark.parametrize(("method", "order"), [("curvature", 2), ("curve", 2)])
def test_noise_of_the_angles_is_what_the_covariance_says(method: AngleMethod, order: int) -> None:
    rig, cuts, chain = arm(1)
    rng = np.random.default_rng(11)
    rest = marker_poses(chain, np.zeros((20_000, chain.size)), (np.array(rig.links[0].markers),), (False,))[0]
    data = recording(chain, np.zeros((20_000, chain.size)), rest + 3e-4 * rng.normal(size=rest.shape))
    found = estimate_angles(rig, cuts, data, ShapeSettings("cantilever", (order,), method), 3e-4, 1e-4)
    assert np.cov(found.q.T) == pytest.approx(found.covariance, rel=0.08, abs=2e-8)


def test_link_frame_markers_need_no_x_but_points_do() -> None:
    rig, cuts, chain = arm(1)
    local = Rig("arm", (Link(**{**rig.links[0].__dict__, "markers_frame": "link"}),))
    q = bends(np.random.default_rng(2), chain, 5, 0.1)
    markers = marker_poses(chain, q, (np.array(rig.links[0].markers),), (True,))[0]
    markers[..., 0] = np.nan
    data = recording(chain, q, markers)
    found = estimate_angles(local, cuts, data, ShapeSettings("cantilever", (2,), "curve"), 3e-4, 1e-4)
    assert np.abs(found.q - q).max() < 1e-9
    with pytest.raises(InsufficientDataError, match="x coordinates"):
        estimate_angles(local, cuts, data, ShapeSettings("cantilever", (2,), "points"), 3e-4, 1e-4)
