"""The curve through the virtual joints against exact integrals and the independent beam."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad_vec
from scipy.interpolate import make_interp_spline

from tests.chain.beams import beam_chain
from tests.fine_beam import Beam, State, modal_state, simulate, static_state
from vjm.chain.curve import curve_map
from vjm.chain.layout import LAYOUTS
from vjm.chain.virtual_links import LinkChain

Array = NDArray[np.float64]
ARCS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
PHIS = st.lists(st.floats(-0.3, 0.3), min_size=1, max_size=8)


def link_of(n: int, name: str = "end-corrected", length: float = 1.0) -> LinkChain:
    return beam_chain(n, name, length=length).links[0]


def bent_as(link: LinkChain, curvature: Callable[[Array], Array], arcs: Array = ARCS) -> Array:
    """The link's curve when each joint turns by its cell times the curvature at it."""
    return curve_map(link, arcs).positions(link.cells * curvature(link.joint_arcs))


def exact_curve(heading: Callable[[float], float], arcs: Array = ARCS) -> Array:
    """Integrals of (cos, sin) of the heading, (k, 2)."""

    def tangent(s: float) -> Array:
        return np.array([np.cos(heading(s)), np.sin(heading(s))])

    return np.array([quad_vec(tangent, 0.0, arc, epsabs=1e-13, epsrel=1e-13)[0] for arc in arcs])


# Shapes


@pytest.mark.parametrize("n", [2, 3, 4, 6, 9])
@pytest.mark.parametrize("name", LAYOUTS)
def test_curvature_of_an_end_load_is_met_exactly(n: int, name: str) -> None:
    """Curvature F (L - s) / EI, however large: linear, and nil on the free end."""
    found = bent_as(link_of(n, name), lambda s: 1.5 * (1 - s))
    np.testing.assert_allclose(found, exact_curve(lambda s: 1.5 * (s - s**2 / 2)), atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_small_end_load_bends_as_euler_bernoulli_says(n: int) -> None:
    """Deflection F (3 L s^2 - s^3) / 6 EI; one joint as well, whose cell is made for it."""
    link = link_of(n, length=0.7)
    force, stiffness = 1e-5, 1.97
    load = force * (0.7 - link.joint_arcs) / stiffness
    arcs = 0.7 * ARCS
    found = curve_map(link, arcs).positions(link.cells * load)
    np.testing.assert_allclose(found[:, 0], arcs, rtol=1e-9)
    np.testing.assert_allclose(found[:, 1], force * arcs**2 * (2.1 - arcs) / (6 * stiffness), rtol=1e-9)


def wavy(s: Array) -> Array:
    return np.asarray(3 * np.cos(4.5 * s) * (1 - s) ** 2)


@pytest.mark.parametrize(("name", "least"), [("end-corrected", 4.0), ("half-ends", 4.5)])
def test_smooth_curvature_converges_at_fourth_order(name: str, least: float) -> None:
    s = np.linspace(0.0, 1.0, 2001)
    expected = exact_curve(make_interp_spline(s, wavy(s), 5).antiderivative())
    found = [np.abs(bent_as(link_of(n, name), wavy) - expected).max() for n in (6, 12, 24)]
    orders = np.log2(np.array(found[:-1]) / found[1:])
    assert (orders > least).all()
    assert found[1] < 1e-4


BEAM = Beam(length=1.0, mass=0.44, bending_stiffness=1.97)


@pytest.mark.parametrize(
    ("state", "bound"),
    [
        (static_state(BEAM, (0.0, 0.73)), 5e-7),
        (static_state(BEAM, (0.4, -2.5)), 2e-5),
        (modal_state(BEAM, [0.12]), 1e-5),
        (modal_state(BEAM, [0.0, 0.03]), 4e-5),
    ],
    ids=["0.12 m by a force", "0.3 m by a force", "0.12 m in mode 1", "0.03 m in mode 2"],
)
def test_six_joints_draw_the_beam_s_curve(state: State, bound: float) -> None:
    """Joint angles from the beam's curvature give its markers; 0.05 mm is what diagnosis allows."""
    motion = simulate(BEAM, np.array([0.0]), state=state)
    mechanics = motion.mechanics
    curvature = make_interp_spline(mechanics.basis.nodes, mechanics.curvature @ state.bending, 5)
    markers = motion.positions(ARCS)[0]
    assert np.abs(markers[:, 1]).max() > 0.029
    assert np.abs(bent_as(link_of(6), curvature) - markers).max() < bound <= 5e-5


def test_the_chord_is_far_off_where_the_curve_is_not() -> None:
    """The rigid links of two joints miss a 0.12 m bend by millimetres; their curve does not."""
    link = link_of(2)
    phi = link.cells * 0.36 * (1 - link.joint_arcs)
    headings = np.r_[0.0, np.cumsum(phi)]
    knots = np.r_[0.0, np.cumsum(link.lengths * np.sin(headings))]
    chord = np.interp(ARCS, np.r_[0.0, np.cumsum(link.lengths)], knots)
    curve = exact_curve(lambda s: 0.36 * (s - s**2 / 2))
    assert np.abs(chord - curve[:, 1]).max() > 2e-3
    np.testing.assert_allclose(curve_map(link, ARCS).positions(phi), curve, atol=1e-12)


# Laws


@given(PHIS, st.sampled_from(LAYOUTS))
@settings(max_examples=60, deadline=None)
def test_the_curve_is_inextensible(phi: list[float], name: str) -> None:
    """Unit speed everywhere: neighbouring points are as far apart as their arc lengths, to third order."""
    arcs = np.linspace(0.0, 1.0, 401)
    points = curve_map(link_of(len(phi), name), arcs).positions(phi)
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    bend = np.abs(np.diff(curve_map(link_of(len(phi), name), arcs).heading @ phi)).max()
    assert (steps <= 1 / 400 + 1e-12).all()
    assert (steps >= 1 / 400 * (1 - bend**2 / 12) - 1e-12).all()


@given(PHIS, st.sampled_from(LAYOUTS))
@settings(max_examples=60, deadline=None)
def test_the_curve_leaves_the_link_frame_along_x(phi: list[float], name: str) -> None:
    near = curve_map(link_of(len(phi), name), [0.0, 1e-4])
    points = near.positions(phi)
    np.testing.assert_array_equal(points[0], 0.0)
    np.testing.assert_allclose(near.heading[0], 0.0, atol=1e-14)
    np.testing.assert_allclose(points[1], [1e-4, 0.0], atol=2e-6)


@given(PHIS)
@settings(max_examples=40, deadline=None)
def test_heading_is_the_curve_s_direction(phi: list[float]) -> None:
    arcs = np.array([0.15, 0.5, 0.93])
    link, step = link_of(len(phi)), 3e-4
    tangent = (curve_map(link, arcs + step).positions(phi) - curve_map(link, arcs - step).positions(phi)) / (2 * step)
    heading = curve_map(link, arcs).heading @ phi
    np.testing.assert_allclose(tangent, np.stack([np.cos(heading), np.sin(heading)], axis=-1), atol=3e-4)


@given(PHIS)
@settings(max_examples=40, deadline=None)
def test_mirrored_angles_give_the_mirrored_curve(phi: list[float]) -> None:
    curve = curve_map(link_of(len(phi)), ARCS)
    np.testing.assert_array_equal(curve.positions(np.negative(phi)), curve.positions(phi) * [1, -1])


@given(PHIS, st.floats(0.1, 5.0))
@settings(max_examples=40, deadline=None)
def test_the_curve_scales_with_the_link(phi: list[float], length: float) -> None:
    unit = curve_map(link_of(len(phi)), ARCS).positions(phi)
    scaled = curve_map(link_of(len(phi), length=length), length * ARCS).positions(phi)
    np.testing.assert_allclose(scaled, length * unit, atol=1e-12 * length)


@given(PHIS)
@settings(max_examples=40, deadline=None)
def test_jacobian_is_the_slope_of_the_positions(phi: list[float]) -> None:
    curve, at, step = curve_map(link_of(len(phi)), ARCS), np.array(phi), 1e-6
    slopes = [
        (curve.positions(at + step * unit) - curve.positions(at - step * unit)) / (2 * step) for unit in np.eye(at.size)
    ]
    np.testing.assert_allclose(curve.jacobian(at), np.stack(slopes, axis=-1), atol=1e-9)


@pytest.mark.parametrize("shape", [(), (3,), (3, 2)])
def test_any_number_of_leading_axes(shape: tuple[int, ...]) -> None:
    phi = np.random.default_rng(1).uniform(-0.5, 0.5, (*shape, 4))
    curve = curve_map(link_of(4), ARCS)
    positions, jacobian = curve.positions(phi), curve.jacobian(phi)
    assert positions.shape == (*shape, 5, 2)
    assert jacobian.shape == (*shape, 5, 2, 4)
    for index in np.ndindex(shape):
        np.testing.assert_allclose(positions[index], curve.positions(phi[index]), atol=1e-15)
        np.testing.assert_allclose(jacobian[index], curve.jacobian(phi[index]), atol=1e-15)


def test_a_marker_s_place_does_not_hang_on_the_other_markers() -> None:
    link, phi = link_of(5), np.linspace(0.3, -0.2, 5)
    together = curve_map(link, [0.97, 0.11, 0.5, 0.11]).positions(phi)
    for arc, place in zip([0.97, 0.11, 0.5, 0.11], together, strict=True):
        np.testing.assert_allclose(curve_map(link, [arc]).positions(phi)[0], place, atol=1e-10)
