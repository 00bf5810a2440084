"""Curves through the virtual joints, and the markers on them.

A virtual joint bent by phi_j stands for the curvature kappa(s_j) = phi_j / cell_j (its moment K_j phi_j is the
beam's EI kappa there). Between the joints the curvature is an interpolating spline that vanishes at a free end;
heading and position follow by integrating it. The chords of the virtual links are up to a centimetre off this curve.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from vjm.chain.layout import Cuts, Layout
from vjm.chain.virtual_links import Chain, Distal, LinkChain
from vjm.records import Array

_NODES = 6  # Gauss-Legendre nodes a panel
_PANELS = 4  # least number of panels a link


@dataclass(frozen=True)
class CurveMap:
    """Linear maps from a link's phi to headings, and from headings to positions, at chosen arc lengths."""

    arcs: Array  # (k,) arc lengths [m]
    heading: Array  # (k, n) d psi(arcs) / d phi
    node_heading: Array  # (Q, n) d psi / d phi at the quadrature nodes
    nodes: Array  # (Q,) arc lengths of the quadrature nodes [m]
    weights: Array  # (k, Q) quadrature weights from the proximal end to each arc length [m]

    def positions(self, phi: ArrayLike, root_angle: ArrayLike = 0.0, rest_curvature: float = 0.0) -> Array:
        """Return positions (..., k, 2) [m] in the link frame.

        Args:
            phi: (..., n) virtual joints' angles [rad].
            root_angle: (...) of the root joint [rad].
            rest_curvature: of the unloaded link [1/m].
        """
        psi = self._node_headings(phi, root_angle, rest_curvature)
        return np.stack([np.cos(psi) @ self.weights.T, np.sin(psi) @ self.weights.T], axis=-1)

    def jacobian(self, phi: ArrayLike) -> Array:
        """Return the (..., k, 2, n) derivative of `positions` by phi [m/rad], of a link that is straight at rest."""
        return self.slopes(self.node_heading, phi)

    def slopes(self, turning: Array, phi: ArrayLike, root_angle: ArrayLike = 0.0, rest_curvature: float = 0.0) -> Array:
        """Return (..., k, 2, m) derivatives of `positions` by what turns the nodes' headings by (Q, m) [rad]."""
        psi = self._node_headings(phi, root_angle, rest_curvature)
        weighted = (self.weights[:, :, None] * turning).swapaxes(0, 1).reshape(self.nodes.size, -1)
        shape = (*psi.shape[:-1], self.arcs.size, turning.shape[1])
        return np.stack([(part @ weighted).reshape(shape) for part in (-np.sin(psi), np.cos(psi))], axis=-2)

    def _node_headings(self, phi: ArrayLike, root_angle: ArrayLike, rest_curvature: float) -> Array:
        psi: Array = np.asarray(phi, dtype=float) @ self.node_heading.T
        psi += rest_curvature * self.nodes + np.asarray(root_angle, dtype=float)[..., None]
        return psi


def _curvature_spline(cuts: Cuts) -> BSpline:
    """Return the curvature along a link as a spline linear in phi: evaluates to (..., n) [1/m per rad]."""
    knots, values = np.cumsum(cuts.lengths), np.diag(1 / cuts.cells)
    if cuts.distal == "joined":
        knots = knots[:-1]
    else:
        values = np.vstack([values, np.zeros(cuts.cells.size)])
    return make_interp_spline(knots, values, k=min(3, knots.size - 1))


def curve_map(cuts: Cuts, arcs: ArrayLike) -> CurveMap:
    """Return the map from a link's phi to its curve at arc lengths (k,) [m]."""
    numbers = (cuts.lengths, cuts.cells, np.asarray(arcs, dtype=float).ravel())
    lengths, cells, ends = (tuple(values.tolist()) for values in numbers)
    return _curve_map(lengths, cells, cuts.distal, ends)


@lru_cache(maxsize=256)
def _curve_map(
    lengths: tuple[float, ...], cells: tuple[float, ...], distal: Distal, arcs: tuple[float, ...]
) -> CurveMap:
    cuts, ends = Layout(np.array(lengths), np.array(cells), distal), np.array(arcs)
    edges = np.unique(np.r_[np.linspace(0.0, cuts.lengths.sum(), _PANELS + 1), ends])
    abscissae, gauss = np.polynomial.legendre.leggauss(_NODES)
    half = np.diff(edges) / 2
    nodes = (edges[:-1, None] + half[:, None] * (1 + abscissae)).ravel()
    weights = (half[:, None] * gauss).ravel()
    heading = _curvature_spline(cuts).antiderivative()
    return CurveMap(
        arcs=ends,
        heading=heading(ends) - heading(0.0),
        node_heading=heading(nodes) - heading(0.0),
        nodes=nodes,
        weights=np.where(nodes < ends[:, None], weights, 0.0),
    )


def rotate(vectors: Array, angle: Array) -> Array:
    """Return vectors (..., 2) turned by angles (...) [rad]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def marker_poses(
    chain: Chain, q: ArrayLike, arcs: Sequence[Array], in_link_frame: Sequence[bool]
) -> tuple[Array, Array]:
    """Return the markers of all links: positions (..., k, 2) [m], and headings of the curves there (..., k) [rad].

    Args:
        chain: the arm.
        q: (..., nv) joint angles [rad].
        arcs: for each link, (k_i,) the arc lengths of its markers [m].
        in_link_frame: for each link, whether its markers are wanted in its own frame instead of the base frame, which
            stays where it is if the base moves; so does the frame of a first link that is clamped.
    """
    angles = np.asarray(q, dtype=float)
    # Of the link's frame Sigma_i in the base frame (eq. 9), active angle included.
    origin, heading = np.zeros((*angles.shape[:-1], 2)), np.zeros(angles.shape[:-1])
    if chain.base is not None:
        origin = angles[..., :1] * chain.base.axis
    positions, headings = [], []
    for i, (link, part) in enumerate(zip(chain.links, chain.passive_slices, strict=True)):
        if link.joint == "revolute":
            heading = heading + angles[..., part.stop - link.coordinates]
        phi, root_angle = _shape_angles(link, part, angles)
        curve, root = curve_map(link, arcs[i]), _root_position(link, root_angle)
        position = root[..., None, :] + curve.positions(phi, root_angle, link.rest_curvature)
        tangent = root_angle[..., None] + phi @ curve.heading.T + link.rest_curvature * curve.arcs
        if not in_link_frame[i] or (i == 0 and link.joint == "clamped"):
            position = origin[..., None, :] + rotate(position, heading[..., None])
            tangent = tangent + heading[..., None]
        else:  # whose origin is where the proximal end of the straight link would be
            position = position - np.array([link.hub_radius, 0.0])
        positions.append(position)
        headings.append(tangent)
        if i + 1 < len(chain.links):
            tip = curve_map(link, [link.length])
            end = root + tip.positions(phi, root_angle, link.rest_curvature)[..., 0, :]
            origin = origin + rotate(end, heading)
            heading = heading + root_angle + phi @ tip.heading[0] + link.rest_curvature * link.length
    return np.concatenate(positions, axis=-2), np.concatenate(headings, axis=-1)


def marker_pose_slopes(
    chain: Chain, q: Array, directions: Array, arcs: Sequence[Array], in_link_frame: Sequence[bool]
) -> tuple[Array, Array]:
    """Return the derivatives of `marker_poses` along directions (nv, m) of the angles.

    Returns:
        Those of the positions, (..., k, 2, m) [m/rad], and of the headings, (k, m), which are linear in q.
    """
    heading, turning = np.zeros(q.shape[:-1]), np.zeros(directions.shape[1])  # of the link's frame
    shift = np.zeros((*q.shape[:-1], 1, 2, turning.size))  # of its origin
    if chain.base is not None:
        shift += chain.base.axis[:, None] * directions[0]
    positions, headings = [], []
    for i, (link, part) in enumerate(zip(chain.links, chain.passive_slices, strict=True)):
        if link.joint == "revolute":
            heading = heading + q[..., part.stop - link.coordinates]
            turning = turning + directions[part.stop - link.coordinates]
        shape = *_shape_angles(link, part, q), link.rest_curvature
        bending, root_turning = _shape_angles(link, part, directions.T)
        curve, root = curve_map(link, arcs[i]), _root_position(link, shape[1])[..., None, :]
        # Of the proximal end, which a root joint before it turns.
        across = link.radii[1] * np.stack([-np.sin(shape[1]), np.cos(shape[1])], axis=-1)[..., None, :, None]
        position = across * root_turning + curve.slopes(curve.node_heading @ bending.T + root_turning, *shape)
        tangent = curve.heading @ bending.T + root_turning
        if not in_link_frame[i] or (i == 0 and link.joint == "clamped"):
            position = shift + _rotated_slopes(root + curve.positions(*shape), position, heading, turning)
            tangent = tangent + turning
        positions.append(position)
        headings.append(tangent)
        if i + 1 < len(chain.links):
            tip = curve_map(link, [link.length])
            slopes = across * root_turning + tip.slopes(tip.node_heading @ bending.T + root_turning, *shape)
            shift = shift + _rotated_slopes(root + tip.positions(*shape), slopes, heading, turning)
            heading = heading + shape[1] + shape[0] @ tip.heading[0] + link.rest_curvature * link.length
            turning = turning + root_turning + bending @ tip.heading[0]
    return np.concatenate(positions, axis=-3), np.concatenate(headings)


def _shape_angles(link: LinkChain, part: slice, q: Array) -> tuple[Array, Array]:
    """Return the angles of a link's virtual joints (..., n) and of its root (...), zero where it has none."""
    root = np.zeros(q.shape[:-1]) if link.root_stiffness is None else q[..., part.start - 1]
    return q[..., part], root


def _root_position(link: LinkChain, root_angle: Array) -> Array:
    """Return where a link's proximal end is (..., 2) in its active joint's frame [m], by its root's angle (...)."""
    before, after = link.radii
    return np.stack([before + after * np.cos(root_angle), after * np.sin(root_angle)], axis=-1)


def _rotated_slopes(positions: Array, slopes: Array, angle: Array, turning: Array) -> Array:
    """Return derivatives (..., k, 2, m) of positions (..., k, 2) turned by an angle (...), which turns as well (m,)."""
    turned = rotate(positions, angle[..., None])
    across = np.stack([-turned[..., 1], turned[..., 0]], axis=-1)
    rotated = np.swapaxes(rotate(np.swapaxes(slopes, -1, -2), angle[..., None, None]), -1, -2)
    result: Array = rotated + across[..., None] * turning
    return result


def transfer_state(given: Chain, wanted: Chain, state: Array) -> Array:
    """Return an initial state (2 nv,) with the same curvatures in the joints of another chain of the same arm.

    A root joint that the given chain lacks is turned by the moment that the link's curvature there exerts on it; a base
    that did not move stands still.
    """
    links = zip(given.links, wanted.links, given.passive_slices, wanted.passive_slices, strict=True)
    transform = np.zeros((wanted.size, given.size))
    transform[wanted.active, given.active] = 1.0
    transform[: wanted.base_size, : given.base_size] = 1.0
    for source, target, source_slice, target_slice in links:
        curvature = _curvature_spline(source)
        transform[target_slice, source_slice] = target.cells[:, None] * curvature(target.joint_arcs)
        if target.root_stiffness is None:
            continue
        if source.root_stiffness is not None:
            transform[target_slice.start - 1, source_slice.start - 1] = 1.0
        else:
            transform[target_slice.start - 1, source_slice] = (
                source.bending_stiffness / max(target.root_stiffness, 1e-300) * curvature(0.0)
            )
    q, v = np.split(state, 2)
    return np.concatenate([transform @ q, transform @ v])
