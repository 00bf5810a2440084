"""What is left of a joint's or the tip's motion, against where it is, how fast it moves and which way.

Of a joint, the torque that the model misses is looked at: the residual of the hub's own equation of motion, which is
its inertia times the residual's acceleration, less what the link's bending, as the markers show it, explains of that.
Accelerations are those of parabolas fitted to short stretches of time that do not overlap, so their noise is
independent; such an acceleration is the mean of the true one with weights (1 - u^2)^2 over the stretch, and everything
that it is held against is averaged with the same weights. The residuals themselves are looked at as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from vjm.records import Array
from vjm.symptoms.profiles import Points, Profile, fitted
from vjm.symptoms.records import Followed
from vjm.symptoms.signals import Channels, spread

_STRETCHES = 64  # of time in a recording: the longer, the less noise; no longer than from one turn to the next
_LONGEST = 1.5  # of the mean time from one turn to the next
_LEAST_SAMPLES = 5  # in a stretch
_LEAST_POINTS = 24
_SLOW = 0.05  # of the velocity's root mean square: slower than this is neither forwards nor backwards
_LEAST_MOTION = 20.0  # times the noise


@dataclass(frozen=True)
class _Motion:
    """What a residual is held against: a function of time."""

    name: str
    unit: str
    path: CubicSpline


def profiles(index: int, followed: Followed, sensors: Sequence[Channels]) -> list[Profile]:
    """Residuals of one recording against position, velocity and its sign.

    Of every joint, the missing torque (the residual's acceleration where the rig has no hub inertia) and the residual;
    of the tip, the residual against the last joint or, on an arm without joints, the residual's acceleration against
    the tip's own motion.

    Args:
        index: of the recording.
        followed: the recording.
        sensors: of it.
    """
    found: list[Profile | None] = []
    names = [f"{followed.rig.links[i].name}.theta" for i in followed.rig.active_links]
    paths = [CubicSpline(followed.recording.time, angle) for angle in followed.theta.T]
    motions = [_Motion(name, "rad", path) for name, path in zip(names, paths, strict=True)]
    camera = next((each for each in sensors if each.sensor == "camera"), None)
    for sensor in sensors:
        if sensor.sensor == "encoder":
            for c, (joint, _) in enumerate(sensor.places):
                found.append(_missing_torque(index, followed, sensor, c, motions[joint], camera))
                found.append(_residuals(index, sensor, c, motions[joint]))
        elif motions:
            found.append(_residuals(index, sensor, _tip(sensor), motions[-1]))
        else:
            tip = _tip(sensor)
            motion = _Motion(sensor.names[tip], "m", CubicSpline(sensor.time, sensor.simulated[:, tip]))
            points = _accelerations(sensor, tip, motion, [])
            if points is not None:
                found.append(_profile(index, sensor.names[tip], motion, ("acceleration", "m/s²"), points))
    return [each for each in found if each is not None]


def _tip(sensor: Channels) -> int:
    """The channel of the outermost marker that moves most."""
    last = max(marker for marker, _ in sensor.places)
    size = spread(sensor.simulated, sensor.known)
    return max((c for c, (marker, _) in enumerate(sensor.places) if marker == last), key=lambda c: float(size[c]))


def _residuals(index: int, sensor: Channels, c: int, motion: _Motion) -> Profile | None:
    rows = sensor.known[:, c]
    position, velocity = (motion.path(sensor.time[rows], order) for order in (0, 1))
    if not _moves(motion, position, sensor):
        return None
    values = sensor.residual[rows, c] * sensor.noise
    std = np.full(values.size, sensor.noise)
    points = Points(values, std, position, velocity, _way(velocity), sensor.blocks[rows], *_nothing(values.size))
    return _profile(index, sensor.names[c], motion, ("residual", sensor.unit), points)


def _missing_torque(
    index: int, followed: Followed, sensor: Channels, c: int, motion: _Motion, camera: Channels | None
) -> Profile | None:
    """Of a joint: what its hub's equation of motion leaves.

    Whatever goes with the residuals of the link's own markers is the link's pull; whatever goes with the torque, the
    simulated pull and its rate is a wrong inertia, stiffness or damping of the link, of which other symptoms tell.
    """
    joint = sensor.places[c][0]
    link = followed.rig.active_links[joint]
    inertia = followed.rig.links[link].hub_inertia
    beside = [np.interp(sensor.time, sensor.time[sensor.known[:, c]], sensor.residual[sensor.known[:, c], c])]
    if camera is not None:
        markers = range(*followed.rig.marker_slices[link].indices(followed.markers.shape[1]))
        own = [k for k, (marker, axis) in enumerate(camera.places) if marker in markers and axis == 1]
        seen = [camera.known[:, k] for k in own]
        beside += [
            np.interp(sensor.time, camera.time[r], camera.residual[r, k]) for k, r in zip(own, seen, strict=True)
        ]
    torque = followed.recording.tau[:, joint]
    known = np.isfinite(torque)
    if known.any():
        driven = np.interp(sensor.time, followed.recording.time[known], torque[known])
        pull = driven - inertia * motion.path(sensor.time, 2)
        beside += [driven, pull, np.gradient(pull, sensor.time)]
    points = _accelerations(sensor, c, motion, beside if len(beside) > 1 else [])
    if points is None:
        return None
    if inertia <= 0:
        return _profile(index, sensor.names[c], motion, ("acceleration", "rad/s²"), points)
    points = replace(points, values=inertia * points.values, std=inertia * points.std)
    return _profile(index, sensor.names[c], motion, ("torque", "N m"), points)


def _accelerations(sensor: Channels, c: int, motion: _Motion, beside: Sequence[Array]) -> Points | None:
    """Accelerations of a residual, without what goes with other residuals (F,) beside it; None without motion."""
    rows = sensor.known[:, c]
    time, blocks = sensor.time[rows], sensor.blocks[rows]
    if time.size < _LEAST_POINTS:
        return None
    position, velocity = (motion.path(time, order) for order in (0, 1))
    turns, duration = int(np.count_nonzero(np.diff(np.sign(velocity)))), float(time[-1] - time[0])
    width = max(duration / max(_STRETCHES, turns + 1), _LEAST_SAMPLES * float(np.median(np.diff(time))))
    if width * (turns + 1) > _LONGEST * duration:
        return None
    stretch = np.floor((time - time[0]) / width + 1e-9).astype(np.intp)
    full = np.bincount(stretch) >= _LEAST_SAMPLES
    kept = full[stretch]
    if np.count_nonzero(full) < _LEAST_POINTS or not _moves(motion, position, sensor):
        return None
    _, stretch = np.unique(stretch[kept], return_inverse=True)
    values, std, place = _curvature(time[kept], sensor.residual[rows, c][kept] * sensor.noise, stretch, width)
    weights = (1 - np.clip(place, -1, 1) ** 2) ** 2
    total = np.bincount(stretch, weights)
    averaged = [
        np.bincount(stretch, weights * each[kept]) / total
        for each in (position, velocity, _way(velocity), *(other[rows] for other in beside))
    ]
    first = np.searchsorted(stretch, np.arange(total.size))
    others, recording = _nothing(total.size)
    others = np.column_stack([others, *averaged[3:]])
    std = std * sensor.noise
    return Points(values, std, averaged[0], averaged[1], averaged[2], blocks[kept][first], others, recording)


def _nothing(count: int) -> tuple[Array, NDArray[np.intp]]:
    """Nothing beside so many points, all of one recording."""
    return np.zeros((count, 0)), np.zeros(count, dtype=np.intp)


def _moves(motion: _Motion, position: Array, sensor: Channels) -> bool:
    noise = sensor.noise if motion.unit == sensor.unit else 0.0
    return bool(position.size > _LEAST_POINTS and np.ptp(position) > max(_LEAST_MOTION * noise, 1e-9))


def _way(velocity: Array) -> Array:
    """One forwards, minus one backwards, in between where it is slow."""
    slow = max(_SLOW * float(np.sqrt(np.mean(velocity**2))), 1e-300)
    return np.asarray(np.clip(velocity / slow, -1.0, 1.0))


def _curvature(time: Array, values: Array, stretch: NDArray[np.intp], width: float) -> tuple[Array, Array, Array]:
    """Second derivative of values in each stretch, its error from noise of size one, and (F,) places in the stretch."""
    middle = np.bincount(stretch, time) / np.bincount(stretch)
    place = 2 * (time - middle[stretch]) / width
    powers = np.stack([np.ones_like(place), place, place**2])
    normal = np.array([[np.bincount(stretch, a * b) for b in powers] for a in powers]).transpose(2, 0, 1)
    right = np.array([np.bincount(stretch, a * values) for a in powers]).T
    inverse = np.linalg.inv(normal + 1e-12 * np.eye(3))
    scale = 8 / width**2
    return scale * np.einsum("sk,sk->s", inverse[:, 2], right), scale * np.sqrt(inverse[:, 2, 2]), place


def _profile(index: int, name: str, motion: _Motion, units: tuple[str, str], points: Points) -> Profile:
    return fitted((index,), name, motion.name, units, motion.unit, points)
