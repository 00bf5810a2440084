"""From a recording's markers to the joint angles of an arm of N links (eqs. 9-12)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vjm.angles.curvature import curvature_angles, curvature_map, tip_pose
from vjm.angles.curve import curve_angles, curve_covariance
from vjm.angles.points import chord_angles, representative_points
from vjm.chain.curve import curve_map_of, rotate
from vjm.chain.layout import Layout
from vjm.chain.records import Distal
from vjm.errors import ChoiceError, InsufficientDataError
from vjm.experiment.records import Link, Recording, Rig
from vjm.shape.fit import ShapeFit, fit_shape

Array = NDArray[np.float64]
AngleMethod = Literal["curvature", "curve", "points"]
ANGLE_METHODS: tuple[str, ...] = get_args(AngleMethod)


@dataclass(frozen=True)
class ShapeSettings:
    """How shape functions are fitted and read.

    Attributes:
        family: of the shape functions.
        orders: for each link, the number of functions.
        method: `curvature`: shape over arc length, phi = cell times curvature; `curve`: the chain's own curve, which
            needs a marker a joint; `points`: shape over measured position and representative points, as in the paper.
        robust: Huber weights against wild markers.
    """

    family: str
    orders: tuple[int, ...]
    method: AngleMethod = "curvature"
    robust: bool = False


@dataclass(frozen=True)
class Angles:
    """Joint angles at the camera's frames.

    Attributes:
        time: (F,) [s].
        q: (F, nv) active and passive joint angles, in the chain's order [rad]; NaN where a frame gives none.
        torque: (F, n_a) measured torques at the frames [N m]; NaN where none was measured.
        covariance: (nv, nv) of the angles' noise in a complete frame [rad^2].
        shapes: each link's fitted shape functions.
        unsolved: number of frames in which some angle does not exist.
    """

    time: Array
    q: Array
    torque: Array
    covariance: Array
    shapes: tuple[ShapeFit, ...]
    unsolved: int


def estimate_angles(
    rig: Rig,
    cuts: Sequence[Layout],
    recording: Recording,
    settings: ShapeSettings,
    marker_noise: float,
    encoder_noise: float,
    shapes: Sequence[ShapeFit] | None = None,
) -> Angles:
    """Read the joint angles off a recording's markers.

    Link i + 1 rests on link i's tip and heading, so the links are done from the base outwards.

    Args:
        rig: the arm.
        cuts: each link's virtual links and cells.
        recording: markers and encoders.
        settings: shape family, orders and method.
        marker_noise: 1-sigma [m].
        encoder_noise: 1-sigma [rad].
        shapes: each link's shape functions where they are fitted already; those over arc length do not depend on
            the cuts, and `points` ignores them.

    Raises:
        ChoiceError: unknown method.
        InsufficientDataError: an active joint without encoder, or, for `points`, markers without x coordinate.
    """
    if settings.method not in ANGLE_METHODS:
        raise ChoiceError("angle method", settings.method, ANGLE_METHODS)
    rows = recording.frames
    theta = _at_frames(recording, recording.theta, rows)
    origin, heading = np.zeros((rows.size, 2)), np.zeros(rows.size)
    columns: list[Array] = []
    fits: list[ShapeFit] = []
    blocks: list[Array] = []
    for i, link in enumerate(rig.links):
        if link.joint == "revolute":
            own = theta[:, [rig.active_links.index(i)]]
            columns.append(own)
            heading = heading + own[:, 0]
        markers = recording.markers[rows][:, rig.marker_slices[i]]
        if link.markers_frame == "base":
            markers = rotate(markers - origin[:, None], -heading[:, None])
        known = shapes[i] if shapes is not None and settings.method != "points" else None
        reading = _LinkReading(link, cuts[i], "free" if i == len(rig.links) - 1 else "joined", settings)
        fit = known or reading.shape(markers, settings.orders[i])
        phi, position, turn = reading.angles(fit, markers)
        origin, heading = origin + rotate(position, heading), heading + turn
        columns.append(phi)
        fits.append(fit)
        blocks.append(reading.covariance(fit, marker_noise, encoder_noise))
    q = np.concatenate(columns, axis=1)
    return Angles(
        time=recording.time[rows],
        q=q,
        torque=_at_frames(recording, held_linearly(recording.time, recording.tau), rows),
        covariance=block_diag(*blocks),
        shapes=tuple(fits),
        unsolved=int((~np.isfinite(q).all(axis=1)).sum()),
    )


def held_linearly(time: Array, samples: Array) -> Array:
    """Samples (T, m) of a smooth signal with the content of the lines drawn between a sampled signal's samples.

    Lines between samples h apart hold sinc^2(f h) of a tone of f, to second order its samples plus h^2 / 12 times
    their second derivative: 2 % less at a dozen samples a period, which a filtered torque has to know.
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


def _at_frames(recording: Recording, values: Array, rows: NDArray[np.intp]) -> Array:
    """Columns of an encoder or torque sensor at the camera's frames, linear between its own samples."""
    result = np.full((rows.size, values.shape[1]), np.nan)
    time = recording.time[rows]
    for column in range(values.shape[1]):
        known = np.isfinite(values[:, column])
        if known.sum() >= 2:
            samples = recording.time[known]
            inside = (time >= samples[0]) & (time <= samples[-1])
            result[inside, column] = np.interp(time[inside], samples, values[known, column])
    return result


@dataclass(frozen=True)
class _LinkReading:
    """How one link's angles follow from its markers."""

    link: Link
    cuts: Layout
    distal: Distal
    settings: ShapeSettings

    def shape(self, markers: Array, order: int) -> ShapeFit:
        """Shape functions of markers (F, k, 2) in the link frame."""
        link, settings = self.link, self.settings
        if settings.method == "points":
            if not np.isfinite(markers[..., 0]).any():
                what = f"the x coordinates of {link.name}'s markers were not measured"
                raise InsufficientDataError("representative points", what, "record them")
            places = markers[..., 0]
        else:
            places = np.array(link.markers)
        return fit_shape(places, markers[..., 1], link.length, settings.family, order, robust=settings.robust)

    def angles(self, fit: ShapeFit, markers: Array) -> tuple[Array, Array, Array]:
        """Angles phi (F, n), and the tip's position (F, 2) and heading (F,) in the link frame."""
        if self.settings.method == "points":
            points = representative_points(fit, self.cuts.lengths)
            phi = chord_angles(points)
            return phi, points[:, -1], phi.sum(axis=1)
        phi = curvature_angles(fit, np.cumsum(self.cuts.lengths)[:-1], self.cuts.cells)
        if self.settings.method == "curvature":
            return (phi, *tip_pose(fit))
        phi = curve_angles(curve_map_of(self.cuts, self.distal, self.link.markers), markers, phi)
        tip = curve_map_of(self.cuts, self.distal, [self.link.length])
        return phi, tip.positions(phi)[:, 0], phi @ tip.heading[0]

    def covariance(self, fit: ShapeFit, marker_noise: float, encoder_noise: float) -> Array:
        """Noise covariance of (theta, phi) [rad^2], for small bends."""
        if self.settings.method == "curve":
            phi_block = marker_noise**2 * curve_covariance(curve_map_of(self.cuts, self.distal, self.link.markers))
        else:
            to_phi = curvature_map(fit, np.cumsum(self.cuts.lengths)[:-1], self.cuts.cells)
            phi_block = marker_noise**2 * to_phi @ fit.covariance @ to_phi.T
        return phi_block if self.link.joint == "clamped" else block_diag(np.array([[encoder_noise**2]]), phi_block)
