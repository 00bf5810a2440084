"""A robot's motion as the identification of its springs sees it: checked input, angles from markers, noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from vjm.errors import InsufficientDataError, ShapeError, is_number, require, require_kind
from vjm.experiment.arrays import number_array
from vjm.experiment.spectrum import white_noise
from vjm.identification.uncertainty import SINGULAR
from vjm.markers.angles import solve_angles
from vjm.model.flexible import FlexibleModel
from vjm.model.kinematics import MarkerTree
from vjm.records import Array, Indices, Mask

FEWEST_FRAMES = 40  # frames: ten in each half after the ends are cut off, as few as a recording may have
# Units that are wrong put markers a robot's length away; a bend that the method is for, far less than a tenth of it.
_LARGEST_MISFIT = 0.1
# A frame left out makes the filter uneven, which costs more than its noise: with one marker in ten hidden, standard
# errors are 1.5 times larger where the limit is 10, and the same at 30.
_LARGEST_VARIANCE = 100.0
_FINEST = 1e-9  # of the robot's reach: exact data still need a finite weight
_EXPECTED = "positions in metres in the model's world, angles in radians, markers in the order of `markers`"


@dataclass(frozen=True)
class SpringGroup:
    """Joints that share a material: their stiffness and damping are one value each over the joints' cells."""

    stiffness: str  # names of the parameters
    damping: str
    unit: str  # of the stiffness
    damping_unit: str
    motion: str  # in words
    joints: Indices  # coordinates
    cells: Array  # [m]; one where the value is the joint's own

    def values(self, model: FlexibleModel) -> tuple[float, float]:
        """Return a model's stiffness and damping."""
        k = self.joints
        return float(np.mean(model.stiffness[k] * self.cells)), float(np.mean(model.damping[k] * self.cells))


@dataclass(frozen=True)
class RobotSignals:
    """Sampled signals through one filter: angles of all coordinates, and what else was measured of the motors."""

    columns: Array  # (T, m): q (nv), then given rates (n_a), accelerations (n_a) and torques (n_a) of the motors
    covariances: Array  # (P, m, m) of a sample's noise, one for each set of markers seen
    sets: Indices  # (T,) which of them a sample has
    rates: bool  # whether rates and accelerations of the motors were given
    accelerations: bool

    @property
    def covariance(self) -> Array:
        """Mean covariance of a sample's noise (m, m)."""
        share = np.bincount(self.sets, minlength=len(self.covariances)) / self.sets.size
        return np.asarray(np.tensordot(share, self.covariances, axes=1))


def checked_motion(
    model: FlexibleModel,
    time: ArrayLike,
    q_active: ArrayLike,
    rates: ArrayLike | None,
    accelerations: ArrayLike | None,
    torques: ArrayLike | None,
    positions: ArrayLike,
    markers: Sequence[tuple[str, ArrayLike]] | Mapping[str, tuple[str, ArrayLike]],
    bandwidth: float | None,
) -> tuple[Array, dict[str, Array], Array, list[tuple[str, Array]]]:
    """Return instants, what the motors measure by name, markers' positions and places, or refuse them."""
    valid = isinstance(model, FlexibleModel) and bool(model.passive.size)
    require("model", model, valid, "a vjm.FlexibleModel with passive joints")
    t = number_array("time", time)
    if t.ndim != 1 or t.size < FEWEST_FRAMES:
        raise InsufficientDataError(
            "stiffness", f"time has shape {t.shape}", f"give (T,) of {FEWEST_FRAMES} frames or more"
        )
    if not np.isfinite(t).all() or (np.diff(t) <= 0).any():
        raise ShapeError("time", "instants that are not finite or do not grow", "(T,) in seconds, growing")
    quantities = {"q_active": q_active, "rates": rates, "accelerations": accelerations, "torques": torques}
    highest = 0.25 / float(np.median(np.diff(t)))
    valid = bandwidth is None or (is_number(bandwidth) and 0 < bandwidth <= highest)
    require("bandwidth", bandwidth, valid, f"a frequency up to {highest:.4g} Hz, a quarter of the frame rate")
    motors = {}
    for name, values in quantities.items():
        if values is None and name != "q_active":
            continue
        array = number_array(name, values)
        if array.shape != (t.size, model.active.size):
            raise ShapeError(name, f"shape {array.shape}", f"shape (T, n_a) = ({t.size}, {model.active.size})")
        if not np.isfinite(array).all():
            raise ShapeError(
                name, f"NaN or infinity in row {int(np.argmin(np.isfinite(array).all(axis=1)))}", "numbers"
            )
        motors[name] = array
    places = []
    require_kind("markers", markers, (Mapping, Sequence), "a frame and an offset (3,) [m] for each, in a list")
    for place in markers.values() if isinstance(markers, Mapping) else markers:
        try:
            frame, offset = place
        except (TypeError, ValueError):
            raise ShapeError("markers", place, "a frame and an offset (3,) [m] for each") from None
        offset = number_array(f"marker in {frame}", offset)
        if offset.shape != (3,) or not np.isfinite(offset).all():
            raise ShapeError(f"marker in {frame}", offset.tolist(), "an offset of three finite numbers [m]")
        places.append((str(frame), offset))
    marker_positions = number_array("marker_positions_3d", positions)
    if marker_positions.shape != (t.size, len(places), 3):
        raise ShapeError(
            "marker_positions_3d", f"shape {marker_positions.shape}", f"shape (T, k, 3) = ({t.size}, {len(places)}, 3)"
        )
    if np.isinf(marker_positions).any():
        raise ShapeError("marker_positions_3d", "infinity", "numbers, or NaN where a marker was not seen")
    return t, motors, marker_positions, places


def spring_groups(model: FlexibleModel, tied: bool) -> tuple[SpringGroup, ...]:
    """Return the parameters of the passive joints: of flexible links together, of other joints one by one."""
    groups = []
    free = {model.names[k]: k for k in model.passive.tolist()}
    for link in model.links if tied else ():
        for axis, names in link.joints.items():
            k = np.array([free.pop(name) for name in names])
            kind, end = ("torsional", "") if axis == "torsion" else ("bending", f"_{axis}")
            stiffness, damping = (f"{link.name}.{kind}_{quantity}{end}" for quantity in ("stiffness", "damping"))
            motion = f"torsion of {link.name}" if axis == "torsion" else f"bending of {link.name} about {axis}"
            cells = np.array([model.cells[name] for name in names])
            groups.append(SpringGroup(stiffness, damping, "N m^2", "N m^2 s", motion, k, cells))
    for name, k in free.items():
        angle = np.array([k])
        parameters, units = (f"{name}.stiffness", f"{name}.damping"), ("N m/rad", "N m s/rad")
        groups.append(SpringGroup(*parameters, *units, f"turning of {name}", angle, np.ones(1)))
    return tuple(groups)


def unseen_coordinates(model: FlexibleModel, tree: MarkerTree, motors: Array, groups: Sequence[SpringGroup]) -> Indices:
    """Return the passive coordinates that do not move the markers at all, of whole groups.

    Raises:
        InsufficientDataError: markers that show a group, but not each of its angles.
    """
    q = np.zeros((1, model.model.nv))
    q[0, model.active] = motors.mean(axis=0)
    slopes = tree.positions(q)[1][0][..., model.passive].reshape(-1, model.passive.size)
    size = np.linalg.norm(slopes, axis=0)
    unmoved = size <= SINGULAR * max(float(size.max(initial=0.0)), 1e-300)
    moving = model.passive[~unmoved]
    if moving.size:
        _, values, vectors = np.linalg.svd(slopes[:, ~unmoved] / size[~unmoved], full_matrices=True)
        rank = int((values > np.sqrt(SINGULAR) * values[0]).sum())
        ambiguous = moving[(np.abs(vectors[rank:]) > 1e-3).any(axis=0)] if rank < moving.size else moving[:0]
    else:
        ambiguous = moving
    unobservable: Indices = model.passive[unmoved]
    for group in groups:
        if np.isin(group.joints, unobservable).all():
            continue
        undetermined = np.isin(group.joints, np.r_[unobservable, ambiguous])
        if undetermined.any():
            names = ", ".join(model.names[k] for k in group.joints[undetermined])
            reason = f"the markers do not tell apart the angles of {names}"
            raise InsufficientDataError(
                group.stiffness, reason, "add markers, or make the link flexible by fewer joints"
            )
    return unobservable


def angles_from_markers(
    model: FlexibleModel, tree: MarkerTree, motors: Array, seen: Array, shown: Indices
) -> tuple[Array, float, float]:
    """Return angles (T, nv) of all coordinates, NaN where a frame does not determine them; markers' misfit and noise.

    Misfit is the RMS distance of a marker's coordinate from the model's, noise its white part [m].

    Raises:
        InsufficientDataError: too few frames.
        ShapeError: markers far from where the model can have them.
    """

    def coordinates(phi: Array, active: Array = motors) -> Array:
        q = np.zeros((len(phi), model.model.nv))
        q[:, model.active], q[:, shown] = active, phi
        return q

    def locate(phi: Array) -> tuple[Array, Array]:
        positions, slopes = tree.positions(coordinates(phi))
        return positions, slopes[..., shown]

    straight = np.zeros((len(motors), shown.size))
    at_rest, slopes = locate(straight)
    reach = float(np.linalg.norm(at_rest, axis=-1).max())
    determined = _determining_frames(
        slopes.mean(axis=0).reshape(-1, shown.size), np.isfinite(seen).reshape(len(seen), -1)
    )
    if determined.sum() < FEWEST_FRAMES:
        reason = f"only {int(determined.sum())} frames show markers enough to tell all angles"
        raise InsufficientDataError("stiffness", reason, f"record {FEWEST_FRAMES} or more of them")
    if np.array_equal(np.fmin.reduce(seen), np.fmax.reduce(seen), equal_nan=True):
        reason = "every frame shows the markers at the same places, without any noise"
        raise InsufficientDataError("stiffness", reason, "record a motion that bends the links")
    # Bends that are large enough may bring the markers anywhere: in a rigid robot degrees are told from radians.
    in_degrees = tree.positions(coordinates(straight, np.radians(motors)))[0]
    rigid, rigid_in_degrees = (float(np.sqrt(np.nanmean((seen - places) ** 2))) for places in (at_rest, in_degrees))
    if rigid_in_degrees <= _LARGEST_MISFIT * reach < rigid:
        misfits = f"{rigid:.3g} m (RMS) off the markers, and degrees {rigid_in_degrees:.3g} m"
        raise ShapeError("q_active", f"angles that would be {misfits}, were the robot rigid", _EXPECTED)
    phi = solve_angles(locate, seen, straight)
    residual = np.where(determined[:, None, None], seen - locate(phi)[0], np.nan)
    misfit = float(np.sqrt(np.nanmean(residual**2)))
    if not misfit <= _LARGEST_MISFIT * reach:
        raise ShapeError(
            "marker_positions_3d", f"markers {misfit:.3g} m (RMS) from the model's, however bent", _EXPECTED
        )
    # Differences of neighbouring frames are free of what misfits slowly; angles have taken their share of the noise.
    steps = np.diff(residual, axis=0)
    known = np.isfinite(steps)
    freedom = 1 - shown.size * determined.sum() / np.isfinite(residual).sum()
    noise = float(np.sqrt(np.sum(steps[known] ** 2) / (2 * max(known.sum(), 1) * max(freedom, SINGULAR))))
    return np.where(determined[:, None], coordinates(phi), np.nan), misfit, max(noise, _FINEST * reach)


def _determining_frames(slopes: Array, visible: Mask) -> Mask:
    """Return the frames (T,) whose markers determine all angles with at most ten times the noise that all markers give.

    Args:
        slopes: (3 k, n) derivatives of the markers' coordinates by the angles.
        visible: (T, 3 k) which of them were seen.
    """
    if not visible.any():
        return np.zeros(len(visible), dtype=bool)
    sets, of_frame = np.unique(visible, axis=0, return_inverse=True)
    size = np.maximum(np.linalg.norm(slopes[visible.any(axis=0)], axis=0), 1e-300)
    scaled = slopes / size
    observed = scaled[visible.any(axis=0)]
    values, vectors = np.linalg.eigh(observed.T @ observed)
    whitened = scaled @ (vectors / np.sqrt(np.maximum(values, SINGULAR * values[-1])))
    information = np.einsum("pm,mi,mj->pij", sets.astype(float), whitened, whitened, optimize=True)
    determined = np.linalg.eigvalsh(information)[:, 0] >= 1 / _LARGEST_VARIANCE
    return np.asarray(determined[of_frame.ravel()])


def sampled_signals(
    model: FlexibleModel,
    tree: MarkerTree,
    q: Array,
    motors: Mapping[str, Array],
    visible: Mask,
    shown: Indices,
    noise: float,
) -> RobotSignals:
    """Return all sampled signals with their noise: that of angles by encoders and the markers seen (T, 3 k)."""
    encoder = _column_noise(motors["q_active"])
    slopes = tree.positions(q.mean(axis=0)[None])[1][0].reshape(-1, model.model.nv)
    sets, of_frame = np.unique(visible, axis=0, return_inverse=True)
    motor_columns = [motors[name] for name in ("rates", "accelerations", "torques") if name in motors]
    covariances = []
    for markers in sets:
        inverse = np.linalg.pinv(slopes[markers][:, shown])
        spread = np.zeros(
            (model.model.nv, model.active.size)
        )  # of the encoders' noise: the markers stay where they are
        spread[model.active] = np.eye(model.active.size)
        spread[shown] = -inverse @ slopes[markers][:, model.active]
        angles = spread @ np.diag(encoder**2) @ spread.T
        angles[np.ix_(shown, shown)] += noise**2 * inverse @ inverse.T
        covariances.append(block_diag(angles, *(np.diag(_column_noise(values) ** 2) for values in motor_columns)))
    columns = np.hstack([q, *motor_columns])
    measured = "rates" in motors, "accelerations" in motors
    return RobotSignals(columns, np.array(covariances), of_frame.ravel(), *measured)


def _column_noise(values: Array) -> Array:
    """Return the 1-sigma of each column's white noise."""
    return np.array([np.nan_to_num(white_noise(values[:, [k]])) for k in range(values.shape[1])])
