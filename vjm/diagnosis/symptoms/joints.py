"""Residuals against the angle, velocity and direction of a joint, or the position of the tip of an arm without joints.

Of a joint, the torque that the model misses is shown: the residual of the hub's equation of motion, its inertia times
the residual's acceleration, without what the link's bending, as its markers show it, explains. Accelerations are those
of parabolas fitted to stretches of time (Savitzky and Golay, Analytical Chemistry 36, 1964) that do not overlap, so
that their noise is independent. Such an acceleration is the mean of the true one with weights (1 - u^2)^2 over the
stretch, u from -1 to 1, and everything that it is regressed on is averaged with the same weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import savgol_coeffs

from vjm.diagnosis.symptoms.channels import GROUPS, Channels, Coefficient, regress
from vjm.records import Array, Indices, Rig, SimulatedRecording

_LEAST_POINTS = 2 * GROUPS  # whose scatter gives the standard errors


@dataclass(frozen=True)
class JointProfile:
    """A residual against a motion, P times."""

    sensor: str  # whose residual it is
    motion: str  # name of what moves
    quantity: str  # `torque` that the model misses, `acceleration` of the residual, or the `residual` itself
    unit: str  # of the quantity
    motion_unit: str  # of the position
    values: Array  # (P,) of the quantity
    std: Array  # (P,) of their noise
    position: Array  # (P,) of the motion
    velocity: Array  # (P,)
    direction: Array  # (P,) from minus one, backwards, to one, forwards
    groups: Indices  # (P,) stretches of time of each recording taken as independent
    others: Array  # (P, m) what else may explain the values
    recording: Indices  # (P,) index of the recording

    @cached_property
    def fit(self) -> _JointProfileFit:
        """Regression on position, velocity and direction, each recording having a constant of its own."""
        recordings, index = np.unique(self.recording, return_inverse=True)
        terms = np.stack([self.position, self.velocity, 0.5 * self.direction], axis=1)
        columns = np.hstack([terms, np.eye(recordings.size)[index], self.others]) / self.std[:, None]
        groups = index * (int(self.groups.max()) + 1) + self.groups
        estimates, remaining = regress(columns, self.values / self.std, groups)
        ends = [float(np.subtract(*np.percentile(term, [95, 5]))) for term in terms.T[:2]]
        changes = (estimate.times(reach) for estimate, reach in zip(estimates, (*ends, 1.0), strict=False))
        slopes = np.array([estimate.value if estimate.known else 0.0 for estimate in estimates[:3]])
        return _JointProfileFit(tuple(changes), terms * slopes, remaining * self.std, float(remaining @ remaining))


class _JointProfileFit(NamedTuple):
    """Parts of a residual that position, velocity and direction explain."""

    changes: tuple[Coefficient, ...]  # over the ranges of position and velocity, and from backwards to forwards
    parts: Array  # (P, 3) what each of them explains of the values
    remaining: Array  # (P,) what nothing explains
    misfit: float  # sum of squares of that, in units of the noise

    @property
    def own(self) -> Array:
        """(P,) the values without what goes with other things than the motion."""
        return np.asarray(self.remaining + self.parts.sum(axis=1))


_Profiles = tuple[JointProfile, ...]


def joint_profiles(
    rig: Rig, recordings: Sequence[tuple[SimulatedRecording, Sequence[Channels]]]
) -> tuple[list[_Profiles], _Profiles]:
    """Return the profiles of each recording (simulated, and its sensors), and those of several together.

    Of every joint, the missing torque (the residual's acceleration where the rig has no hub inertia) and the residual;
    of the tip, the residual against the last joint or, on an arm without joints, its acceleration against its motion.
    """
    profiles = [
        tuple(replace(profile, recording=np.full(profile.values.size, k)) for profile in _of_recording(rig, *recording))
        for k, recording in enumerate(recordings)
    ]
    groups: dict[tuple[str, str, int], list[JointProfile]] = {}
    for profile in (profile for batch in profiles for profile in batch if profile.quantity != "residual"):
        groups.setdefault((profile.sensor, profile.quantity, profile.others.shape[1]), []).append(profile)
    pooled = []
    for members in (members for members in groups.values() if len(members) > 1):
        names = [name for name, value in vars(members[0]).items() if isinstance(value, np.ndarray)]
        arrays: dict[str, Any] = {name: np.concatenate([getattr(member, name) for member in members]) for name in names}
        pooled.append(replace(members[0], **arrays))
    return profiles, tuple(pooled)


def missing_torque(rig: Rig, simulated: Sequence[SimulatedRecording], joint: str) -> JointProfile | None:
    """Return the torque that the model misses at a joint (`beam.theta`) in driven recordings; None if not shown."""
    driven = [(replay, Channels.of(rig, replay)) for replay in simulated if replay.recording.kind == "driven"]
    separate, together = joint_profiles(rig, driven)
    candidates = [*together, *(profile for profiles in separate for profile in profiles)]
    return next((profile for profile in candidates if profile.quantity == "torque" and profile.motion == joint), None)


def _of_recording(rig: Rig, simulated: SimulatedRecording, sensors: Sequence[Channels]) -> Iterator[JointProfile]:
    if not sensors:
        return
    time, angles = simulated.recording.time, simulated.simulation.theta.T
    motions = [
        _Motion(f"{rig.links[i].name}.theta", "rad", CubicSpline(time, angle))
        for i, angle in zip(rig.active_links, angles, strict=True)
    ]
    camera = next((sensor for sensor in sensors if sensor.sensor == "camera"), None)
    profiles: list[JointProfile | None] = []
    for sensor in sensors:
        if sensor.sensor == "encoder":
            for column, (joint, _) in enumerate(sensor.places):
                profiles.append(_missing_torque(rig, simulated, sensor, column, motions[joint], camera))
                profiles.append(_residual(sensor, column, motions[joint]))
        elif motions:
            profiles.append(_residual(sensor, _tip(sensor), motions[-1]))
        else:
            tip = _tip(sensor)
            motion = _Motion(sensor.names[tip], "m", CubicSpline(sensor.time, sensor.simulated[:, tip]))
            profiles.append(_acceleration(sensor, tip, motion, ("acceleration", "m/s²"), 1.0, []))
    yield from (profile for profile in profiles if profile is not None)


class _Motion(NamedTuple):
    name: str
    unit: str
    path: CubicSpline

    def shows(self, position: Array, sensor: Channels) -> bool:
        """Return True if there are enough positions, over a range that stands out of the noise of a sensor of it."""
        noise = sensor.noise if self.unit == sensor.unit else 0.0
        return bool(position.size > _LEAST_POINTS and np.ptp(position) > max(20 * noise, 1e-9))


def _tip(sensor: Channels) -> int:
    last = max(marker for marker, _ in sensor.places)
    power = np.sum(sensor.centred(sensor.simulated) ** 2, axis=0)
    return max((c for c, (marker, _) in enumerate(sensor.places) if marker == last), key=lambda c: float(power[c]))


def _direction(velocity: Array) -> Array:
    """Return 1 forwards, -1 backwards, in between where slower than a twentieth of the root mean square."""
    slow = max(0.05 * float(np.sqrt(np.mean(velocity**2))), 1e-300)
    return np.asarray(np.clip(velocity / slow, -1.0, 1.0))


def _residual(sensor: Channels, column: int, motion: _Motion) -> JointProfile | None:
    rows = sensor.known[:, column]
    position, velocity = motion.path(sensor.time[rows]), motion.path(sensor.time[rows], 1)
    if not motion.shows(position, sensor):
        return None
    values = sensor.residual[rows, column] * sensor.noise
    return JointProfile(
        sensor.names[column], motion.name, "residual", sensor.unit, motion.unit,
        values, np.full(values.size, sensor.noise), position, velocity, _direction(velocity),
        sensor.groups[rows], np.zeros((values.size, 0)), np.zeros(values.size, int),
    )  # fmt: skip


def _missing_torque(
    rig: Rig, simulated: SimulatedRecording, sensor: Channels, column: int, motion: _Motion, camera: Channels | None
) -> JointProfile | None:
    """Return the torque that the equation of motion of a joint's hub leaves.

    What goes with the residuals of the link's own markers is the link's pull; what goes with the torque, the simulated
    pull and its rate is a wrong inertia, stiffness or damping of the link, of which other symptoms tell.
    """
    joint, known = sensor.places[column][0], sensor.known[:, column]
    link = rig.active_links[joint]
    inertia = rig.links[link].hub_inertia
    regressors = [np.interp(sensor.time, sensor.time[known], sensor.residual[known, column])]
    if camera is not None:
        marker_slice = rig.marker_slices[link]
        for k, (marker, axis) in enumerate(camera.places):
            if marker_slice.start <= marker < marker_slice.stop and axis == 1:
                rows = camera.known[:, k]
                regressors.append(np.interp(sensor.time, camera.time[rows], camera.residual[rows, k]))
    torque = simulated.recording.tau[:, joint]
    known = np.isfinite(torque)
    if known.any():
        driven = np.interp(sensor.time, simulated.recording.time[known], torque[known])
        pull = driven - inertia * motion.path(sensor.time, 2)
        regressors += [driven, pull, np.gradient(pull, sensor.time)]
    words = ("torque", "N m") if inertia > 0 else ("acceleration", "rad/s²")
    return _acceleration(sensor, column, motion, words, inertia or 1.0, regressors if len(regressors) > 1 else [])


def _acceleration(
    sensor: Channels, column: int, motion: _Motion, words: tuple[str, str], inertia: float, others: Sequence[Array]
) -> JointProfile | None:
    """Return accelerations of a residual times an inertia, and averages of others (F,); None without motion."""
    rows = sensor.known[:, column]
    time = sensor.time[rows]
    if time.size < 5 * _LEAST_POINTS:
        return None
    position, velocity = motion.path(time), motion.path(time, 1)
    # At most 64 stretches, for the noise of their accelerations grows fast, but one from turn to turn of the motion.
    turns, duration = int(np.count_nonzero(np.diff(np.sign(velocity)))), float(time[-1] - time[0])
    step = float(np.median(np.diff(time)))
    size = max(round(duration / max(64, turns + 1) / step), 5)
    if size * step * (turns + 1) > 1.5 * duration or not motion.shows(position, sensor):
        return None
    starts = np.arange(0, time.size - size + 1, size)
    steps = (time[starts + size - 1] - time[starts]) / (size - 1)
    starts, steps = starts[steps < 1.5 * step], steps[steps < 1.5 * step]  # of the others, a third is a gap
    if starts.size < _LEAST_POINTS:
        return None
    weights = (1 - (np.arange(1 - size, size, 2) / size) ** 2) ** 2
    weights, second_derivative = weights / weights.sum(), np.asarray(savgol_coeffs(size, 2, deriv=2))

    def weighted(weights: Array, values: Array) -> Array:
        return np.asarray(values[starts[:, None] + np.arange(size)] @ weights)

    scale = sensor.noise * inertia / steps**2
    position, velocity, direction = (weighted(weights, signal) for signal in (position, velocity, _direction(velocity)))
    explaining = [weighted(weights, series[rows]) for series in others]
    return JointProfile(
        sensor.names[column], motion.name, *words, motion.unit,
        scale * weighted(second_derivative, sensor.residual[rows, column]),
        scale * float(np.linalg.norm(second_derivative)), position, velocity, direction,
        sensor.groups[rows][starts], np.reshape(explaining, (-1, starts.size)).T, np.zeros(starts.size, int),
    )  # fmt: skip
