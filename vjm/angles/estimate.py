"""From a recording's markers to the joint angles of an arm of N links (eqs. 9-12)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vjm.angles.curvature import curvature_angles, curvature_map, tip_pose
from vjm.angles.points import chord_angles, representative_points
from vjm.chain.curve import rotate
from vjm.chain.layout import Layout
from vjm.errors import ChoiceError, InsufficientDataError
from vjm.experiment.records import Link, Recording, Rig
from vjm.shape.fit import ShapeFit, fit_shape

Array = NDArray[np.float64]
AngleMethod = Literal["curvature", "points"]
ANGLE_METHODS: tuple[str, ...] = get_args(AngleMethod)


@dataclass(frozen=True)
class ShapeSettings:
    """How shape functions are fitted and read.

    Attributes:
        family: of the shape functions.
        orders: for each link, the number of functions.
        method: `curvature`: shape over arc length, phi = cell times curvature; `points`: shape over measured position
            and representative points, as in the paper.
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
        known = shapes[i] if shapes is not None and settings.method == "curvature" else None
        fit, phi, position, turn = _read_link(link, cuts[i], markers, settings, settings.orders[i], known)
        origin, heading = origin + rotate(position, heading), heading + turn
        columns.append(phi)
        fits.append(fit)
        blocks.append(_covariance(link, cuts[i], fit, marker_noise, encoder_noise))
    q = np.concatenate(columns, axis=1)
    return Angles(
        time=recording.time[rows],
        q=q,
        torque=_at_frames(recording, recording.tau, rows),
        covariance=block_diag(*blocks),
        shapes=tuple(fits),
        unsolved=int((~np.isfinite(q).all(axis=1)).sum()),
    )


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


def _read_link(
    link: Link, cuts: Layout, markers: Array, settings: ShapeSettings, order: int, known: ShapeFit | None
) -> tuple[ShapeFit, Array, Array, Array]:
    """Shape, phi (F, n), and the pose (F, 2), (F,) of the tip, from markers (F, k, 2) in the link frame."""
    if settings.method == "curvature":
        fit = known or fit_shape(
            link.markers, markers[..., 1], link.length, settings.family, order, robust=settings.robust
        )
        phi = curvature_angles(fit, np.cumsum(cuts.lengths)[:-1], cuts.cells)
        return (fit, phi, *tip_pose(fit))
    if not np.isfinite(markers[..., 0]).any():
        raise InsufficientDataError(
            "representative points", f"the x coordinates of {link.name}'s markers were not measured", "record them"
        )
    fit = fit_shape(markers[..., 0], markers[..., 1], link.length, settings.family, order, robust=settings.robust)
    points = representative_points(fit, cuts.lengths)
    phi = chord_angles(points)
    return fit, phi, points[:, -1], phi.sum(axis=1)


def _covariance(link: Link, cuts: Layout, fit: ShapeFit, marker_noise: float, encoder_noise: float) -> Array:
    """Noise covariance of (theta, phi) of one link [rad^2], for small bends."""
    to_phi = curvature_map(fit, np.cumsum(cuts.lengths)[:-1], cuts.cells)
    phi_block = marker_noise**2 * to_phi @ fit.covariance @ to_phi.T
    if link.joint == "clamped":
        return phi_block
    block = np.zeros((len(phi_block) + 1,) * 2)
    block[0, 0] = encoder_noise**2
    block[1:, 1:] = phi_block
    return block
