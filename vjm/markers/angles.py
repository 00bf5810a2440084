"""Joint angles of an arm of N links from a recording's markers (eqs. 9-12)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize.elementwise import find_root

from vjm.chain.curve import CurveMap, curve_map, rotate
from vjm.chain.layout import Cuts
from vjm.errors import InsufficientDataError
from vjm.markers.shape import ShapeFit, basis, fit_shape
from vjm.records import Array, Indices, Link, Record, Recording, Rig

_LARGEST_TURN = 0.5  # rad a step


AngleMethod = Literal["curvature", "curve", "points"]


@dataclass(frozen=True)
class ShapeSettings:
    """Settings of shape functions and of the angles taken from them."""

    family: str  # of the shape functions
    orders: tuple[int, ...]  # for each link, the number of functions
    # `curvature`: shape over arc length, phi = cell times curvature; `curve`: the chain's own curve, which needs
    # at least as many markers as joints; `points`: shape over measured position and representative points, as in the
    # paper.
    method: AngleMethod = "curvature"
    robust: bool = False  # Huber weights against wild markers


@dataclass(frozen=True, repr=False)
class Angles(Record):
    """Joint angles at the camera's frames."""

    time: Array  # (F,) [s]
    q: Array  # (F, nv) active and passive joint angles, in the chain's order [rad]; NaN where a frame gives none
    torque: Array  # (F, n_a) measured torques at the frames [N m]; NaN where none was measured
    covariance: Array  # (nv, nv) of the angles' noise in a complete frame [rad^2]
    shapes: tuple[ShapeFit, ...]  # each link's fitted shape functions
    unsolved: int  # number of frames in which some angle does not exist


def estimate_angles(
    rig: Rig,
    cuts: Sequence[Cuts],
    recording: Recording,
    settings: ShapeSettings,
    marker_noise: float,
    encoder_noise: float,
    shapes: Sequence[ShapeFit] | None = None,
) -> Angles:
    """Return the joint angles that a recording's markers and encoders show, noise [m, rad] being theirs (1-sigma).

    Link i + 1 starts from link i's tip and heading, so the links are done from the base outwards. Shape functions over
    arc length do not depend on the layout: where each link's are fitted already, they may be given as `shapes`.

    Raises:
        InsufficientDataError: for `points`, markers without x coordinate; for `curve`, fewer markers than joints.
    """
    rows = recording.frames
    theta = _at_frames(recording, recording.theta, rows)
    origin, heading = np.zeros((rows.size, 2)), np.zeros(rows.size)
    columns: list[Array] = []
    fits: list[ShapeFit] = []
    blocks: list[Array] = []
    for i, link in enumerate(rig.links):
        if link.joint == "revolute":
            active_angle = theta[:, [rig.active_links.index(i)]]
            columns.append(active_angle)
            blocks.append(np.array([[encoder_noise**2]]))
            heading = heading + active_angle[:, 0]
        markers = recording.markers[rows][:, rig.marker_slices[i]]
        root = np.array([link.hub_radius, 0.0])
        if link.markers_frame == "base":
            markers = rotate(markers - origin[:, None], -heading[:, None]) - root
        measurement = _LinkMeasurement(link, cuts[i], settings, markers)
        known = None if shapes is None or settings.method == "points" else shapes[i]
        fit = known or measurement.fit_shape(settings.orders[i])
        phi, position, tip_heading = measurement.angles(fit)
        origin, heading = origin + rotate(root + position, heading), heading + tip_heading
        columns.append(phi)
        fits.append(fit)
        blocks.append(measurement.covariance(fit, marker_noise))
    q = np.concatenate(columns, axis=1)
    return Angles(
        time=recording.time[rows],
        q=q,
        torque=_at_frames(recording, _linearly_interpolated(recording.time, recording.tau), rows),
        covariance=block_diag(*blocks),
        shapes=tuple(fits),
        unsolved=int((~np.isfinite(q).all(axis=1)).sum()),
    )


def _linearly_interpolated(time: Array, samples: Array) -> Array:
    """Return the samples (T, m) of a smooth signal with the frequency content of the lines between given samples.

    Lines between samples h apart contain a tone of frequency f times sinc^2(f h): to second order, its samples plus
    h^2 / 12 times their second derivative. That is 2 % less at a dozen samples a period, and matters once the torque
    is filtered.
    """
    result = samples.copy()
    for column in range(samples.shape[1]):
        known = np.flatnonzero(np.isfinite(samples[:, column]))
        if known.size < 3:
            continue
        t, y = time[known], samples[known, column]
        slopes = np.diff(y) / np.diff(t)
        # h^2 times the second difference quotient, h the mean of the two neighbouring intervals
        result[known[1:-1], column] += np.diff(slopes) * (t[2:] - t[:-2]) / 2 / 12
    return result


def _at_frames(recording: Recording, values: Array, rows: Indices) -> Array:
    """Return the columns of an encoder or torque sensor at the camera's frames, linear between its own samples."""
    result = np.full((rows.size, values.shape[1]), np.nan)
    for column, signal in enumerate(values.T):
        known = np.isfinite(signal)
        if known.sum() >= 2:
            sampled = recording.time[known]
            result[:, column] = np.interp(recording.time[rows], sampled, signal[known], left=np.nan, right=np.nan)
    return result


@dataclass(frozen=True)
class _LinkMeasurement:
    """One link's markers (F, k, 2) in its frame, and the virtual joints whose angles they give."""

    link: Link
    cuts: Cuts
    settings: ShapeSettings
    markers: Array

    def fit_shape(self, order: int) -> ShapeFit:
        link, settings = self.link, self.settings
        if settings.method == "points":
            if not np.isfinite(self.markers[..., 0]).any():
                problem = f"the x coordinates of {link.name}'s markers were not measured"
                raise InsufficientDataError("representative points", problem, "record them")
            places = self.markers[..., 0]
        else:
            places = np.array(link.markers)
        return fit_shape(places, self.markers[..., 1], link.length, settings.family, order, robust=settings.robust)

    def angles(self, fit: ShapeFit) -> tuple[Array, Array, Array]:
        """Return angles phi (F, n), and the tip's position (F, 2) and heading (F,) in the link frame."""
        if self.settings.method == "points":
            points = _representative_points(fit, self.cuts.lengths)
            chords = np.diff(points, axis=1)
            directions = np.arctan2(chords[..., 1], chords[..., 0])
            # Each virtual link's direction less that of the one before it (eq. 12); link 0 lies along the x axis.
            return np.diff(directions, axis=1, prepend=0.0), points[:, -1], directions[:, -1]
        # With y given over arc length, sin(psi) = y' and kappa = y'' / cos(psi).
        joints = np.cumsum(self.cuts.lengths)[:-1]
        phi = np.asarray(self.cuts.cells * fit.evaluate(joints, 2) / np.cos(_headings(fit, joints)))
        if self.settings.method == "curvature":
            return (phi, *_tip_pose(fit))
        phi = _curve_angles(curve_map(self.cuts, self.link.markers), self.markers, phi)
        tip = curve_map(self.cuts, [self.link.length])
        return phi, tip.positions(phi)[:, 0], phi @ tip.heading[0]

    def covariance(self, fit: ShapeFit, marker_noise: float) -> Array:
        """Return the noise covariance of phi [rad^2], for small bends."""
        if self.settings.method == "curve":
            straight = np.zeros(self.cuts.cells.size)
            inverse = np.linalg.pinv(curve_map(self.cuts, self.link.markers).jacobian(straight)[:, 1, :])
            return np.asarray(marker_noise**2 * (inverse @ inverse.T))
        functions = basis(fit.family, fit.order, np.cumsum(self.cuts.lengths)[:-1], fit.length, 2)
        to_phi = self.cuts.cells[:, None] * functions
        return np.asarray(marker_noise**2 * to_phi @ fit.covariance @ to_phi.T)


def _headings(fit: ShapeFit, arcs: Array) -> Array:
    """Return headings psi (T, p) [rad] at arc lengths (p,) [m]; NaN where a shape's slope by arc length exceeds one."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.arcsin(fit.evaluate(arcs, 1)))


def _tip_pose(fit: ShapeFit) -> tuple[Array, Array]:
    """Return position (T, 2) [m] and heading (T,) [rad] of the tip in the link frame, by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    abscissa = np.cos(_headings(fit, fit.length * (1 + nodes) / 2)) @ weights * fit.length / 2
    end = np.array([fit.length])
    return np.stack([abscissa, fit.evaluate(end)[:, 0]], axis=-1), _headings(fit, end)[:, 0]


def _curve_angles(curve: CurveMap, markers: Array, initial: Array) -> Array:
    """Return phi (T, n) [rad] by Gauss-Newton steps on markers (T, k, 2) [m]; NaN for frames with too few of them."""
    n = curve.heading.shape[1]
    if curve.arcs.size < n:
        problem = f"{curve.arcs.size} markers cannot place {n} virtual joints"
        raise InsufficientDataError("angles by the curve", problem, "ask for fewer joints")
    enough = np.isfinite(markers[..., 1]).sum(axis=1) >= n
    phi = solve_angles(lambda phi: (curve.positions(phi), curve.jacobian(phi)), markers, initial)
    return np.where(enough[:, None], phi, np.nan)


def solve_angles(locate: Callable[[Array], tuple[Array, Array]], markers: Array, initial: Array) -> Array:
    """Return the angles (T, n) [rad] at which markers are nearest to where they were seen, frame by frame.

    Gauss-Newton steps for all frames at once (J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed. 2006,
    section 10.3), each cut to half a radian; they converge quadratically on exact data.

    Args:
        locate: from angles (T, n), the markers' positions (T, k, d) [m] and their derivatives (T, k, d, n).
        markers: (T, k, d) seen [m]; NaN where they were not.
        initial: (T, n) where the search begins; NaN is zero.

    Returns:
        (T, n); of no meaning in frames whose markers leave angles open.
    """
    phi = np.nan_to_num(initial)
    n = phi.shape[1]
    known = np.isfinite(markers)
    values = np.where(known, markers, 0.0)
    enough = known.sum(axis=(1, 2)) >= n
    ridge = 1e-14 * np.eye(n)  # keeps frames without enough markers solvable; their angles are dropped
    for _ in range(12):
        positions, slopes = locate(phi)
        residual = np.where(known, values - positions, 0.0).reshape(len(phi), -1)
        jacobian = np.where(known[..., None], slopes, 0.0).reshape(*residual.shape, -1)
        transposed = np.swapaxes(jacobian, 1, 2)
        normal, gradient = transposed @ jacobian, (transposed @ residual[..., None])[..., 0]
        # Columns scaled to one before solving: joints near the tip move the markers little.
        size = np.sqrt(np.maximum(np.einsum("tii->ti", normal), 1e-300))
        scaled = normal / (size[:, :, None] * size[:, None, :])
        step = np.linalg.solve(scaled + ridge, (gradient / size)[..., None])[..., 0] / size
        largest = np.abs(step).max(axis=1, keepdims=True)
        phi = phi + step * np.minimum(1.0, _LARGEST_TURN / np.maximum(largest, 1e-300))
        if not (largest[enough] > 1e-13).any():  # rad: rounding errors
            break
    return phi


def _representative_points(fit: ShapeFit, lengths: Array) -> Array:
    """Return joints 1 .. n and the tip on the curve (T, n + 1, 2) [m], each at its link's length from the one before.

    Virtual link 0 lies along the x axis of Sigma_i; joint 1 is therefore at (l_0, 0). From there on
    (x_(j+1) - x_j)^2 + (y_(j+1) - y_j)^2 = l_j^2 with y_(j+1) = y(x_(j+1)), which has a root between x_j and x_j + l_j.
    NaN for frames in which a point is beyond the link's end.
    """
    frames = np.arange(len(fit.coefficients))

    def height(x: Array, frames: Indices = frames) -> Array:
        return replace(fit, coefficients=fit.coefficients[frames]).evaluate(x[:, None])[:, 0]

    def excess(x: Array, x0: Array, y0: Array, length: float, frames: Indices) -> Array:
        return (x - x0) ** 2 + (height(x, frames) - y0) ** 2 - length**2

    x, y = np.full(frames.size, lengths[0]), np.zeros(frames.size)
    points = [np.stack([x, y], axis=-1)]
    for length in lengths[1:]:
        x = find_root(excess, (x, x + length), args=(x, y, length, frames)).x
        x = np.where(x <= fit.length * (1 + 1e-6), x, np.nan)
        y = height(x)
        points.append(np.stack([x, y], axis=-1))
    return np.stack(points, axis=1)
