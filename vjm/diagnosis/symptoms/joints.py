"""Residuals against the angle, velocity and direction of a joint, or the position of the tip of an arm without joints.

Of a joint, the torque that the model misses is shown: the residual of the hub's equation of motion, its inertia times
the residual's acceleration, without what the link's bending, as its markers show it, explains. Accelerations are those
of parabolas fitted to stretches of time that do not overlap, so that their noise is independent. Such an acceleration
is the mean of the true one with weights (1 - u^2)^2 over the stretch, u from -1 to 1, and everything that it is
regressed on is averaged with the same weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from vjm.diagnosis.symptoms.channels import Channels, Coefficient, channels_of, regress
from vjm.records import Array, Indices, Rig, SimulatedRecording

_LEAST_POINTS = 24  # twice the groups that give the standard errors


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
    groups: Indices  # (P,) stretches of time taken as independent
    others: Array  # (P, m) what else may explain the values
    recording: Indices  # (P,) index of the recording

    @cached_property
    def fit(self) -> _JointProfileFit:
        """Regression on position, velocity and direction, each recording having a constant of its own."""
        own = (self.recording[:, None] == np.unique(self.recording)).astype(float)
        terms = np.stack([self.position, self.velocity, 0.5 * self.direction], axis=1)
        columns = np.hstack([terms, own, self.others]) / self.std[:, None]
        values = self.values / self.std
        found, left = regress(columns, values, self.groups)
        remaining = float(left @ left)
        described = []
        for k in range(3):
            _, without = regress(np.delete(columns, k, axis=1), values, self.groups)
            gained = max(float(without @ without) - remaining, 0.0)
            described.append(gained / max(gained + remaining, 1e-300))
        ends = [float(np.subtract(*np.percentile(term, [95, 5]))) for term in terms.T[:2]]
        changes = tuple(one.times(reach) for one, reach in zip(found, (*ends, 1.0), strict=False))
        slopes = np.array([one.value if one.known else 0.0 for one in found[:3]])
        parts = terms * slopes
        return _JointProfileFit(changes, tuple(described), slopes, parts, left * self.std)


class _JointProfileFit(NamedTuple):
    """Parts of a residual that position, velocity and direction explain."""

    changes: tuple[Coefficient, ...]  # over the ranges of position and velocity, and from backwards to forwards
    described: tuple[float, ...]  # share of the mean square that each describes, of what the others leave
    slopes: Array  # (3,) a unit of position, of velocity, and the jump with the direction
    parts: Array  # (P, 3) what each of them explains of the values
    remaining: Array  # (P,) what nothing explains

    @property
    def own(self) -> Array:
        """(P,) the values without what goes with other things than the motion."""
        return np.asarray(self.remaining + self.parts.sum(axis=1))


_Source = tuple[SimulatedRecording, Sequence[Channels]]
_Profiles = tuple[JointProfile, ...]


def joint_profiles(rig: Rig, recordings: Sequence[_Source]) -> tuple[list[_Profiles], _Profiles]:
    """Return the profiles of each recording (simulated, and its sensors), and those of several together.

    Of every joint, the missing torque (the residual's acceleration where the rig has no hub inertia) and the residual;
    of the tip, the residual against the last joint or, on an arm without joints, its acceleration against its motion.
    """
    profiles = [
        tuple(replace(profile, recording=np.full(profile.values.size, k)) for profile in _of_recording(rig, *one))
        for k, one in enumerate(recordings)
    ]
    groups: dict[tuple[str, str], list[JointProfile]] = {}
    for profile in (profile for own in profiles for profile in own if profile.quantity != "residual"):
        groups.setdefault((profile.sensor, profile.quantity), []).append(profile)
    pooled = []
    for members in groups.values():
        if len(members) < 2 or len({profile.others.shape[1] for profile in members}) > 1:
            continue
        starts = np.cumsum([0, *(int(profile.groups.max()) + 1 for profile in members)])
        names = ("values", "std", "position", "velocity", "direction", "others", "recording")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in members]) for name in names}
        groups_ = np.concatenate([one.groups + start for one, start in zip(members, starts, strict=False)])
        pooled.append(replace(members[0], groups=groups_, **arrays))
    return profiles, tuple(pooled)


def missing_torque(rig: Rig, simulated: Sequence[SimulatedRecording], joint: str) -> JointProfile | None:
    """Return the torque that the model misses at a joint (`beam.theta`) in driven recordings; None if not shown."""
    driven = [(one, channels_of(rig, one)) for one in simulated if one.recording.kind == "driven"]
    own, together = joint_profiles(rig, driven)
    every = [*together, *(profile for profiles in own for profile in profiles)]
    return next((profile for profile in every if profile.quantity == "torque" and profile.motion == joint), None)


def _of_recording(rig: Rig, simulated: SimulatedRecording, sensors: Sequence[Channels]) -> Iterator[JointProfile]:
    if not sensors:
        return
    paths = [CubicSpline(simulated.recording.time, angle) for angle in simulated.simulation.theta.T]
    motions = [(f"{rig.links[i].name}.theta", "rad", path) for i, path in zip(rig.active_links, paths, strict=True)]
    camera = next((sensor for sensor in sensors if sensor.sensor == "camera"), None)
    found: list[JointProfile | None] = []
    for sensor in sensors:
        if sensor.sensor == "encoder":
            for c, (joint, _) in enumerate(sensor.places):
                found.append(_missing_torque(rig, simulated, sensor, c, motions[joint], camera))
                found.append(_residual(sensor, c, motions[joint]))
        elif motions:
            found.append(_residual(sensor, _tip(sensor), motions[-1]))
        else:
            tip = _tip(sensor)
            motion = (sensor.names[tip], "m", CubicSpline(sensor.time, sensor.simulated[:, tip]))
            found.append(_acceleration(sensor, tip, motion, ("acceleration", "m/s²"), 1.0, []))
    yield from (profile for profile in found if profile is not None)


_Motion = tuple[str, str, CubicSpline]  # name, unit and path of what moves


def _tip(sensor: Channels) -> int:
    """Return the channel of the outermost marker that moves most."""
    last = max(marker for marker, _ in sensor.places)
    power = np.sum(sensor.centred(sensor.simulated) ** 2, axis=0)
    return max((c for c, (marker, _) in enumerate(sensor.places) if marker == last), key=lambda c: float(power[c]))


def _moves(motion: _Motion, position: Array, sensor: Channels) -> bool:
    noise = sensor.noise if motion[1] == sensor.unit else 0.0
    return bool(position.size > _LEAST_POINTS and np.ptp(position) > max(20 * noise, 1e-9))


def _direction(velocity: Array) -> Array:
    """Return 1 forwards, -1 backwards, in between where slower than a twentieth of the root mean square."""
    slow = max(0.05 * float(np.sqrt(np.mean(velocity**2))), 1e-300)
    return np.asarray(np.clip(velocity / slow, -1.0, 1.0))


def _residual(sensor: Channels, c: int, motion: _Motion) -> JointProfile | None:
    rows = sensor.known[:, c]
    position, velocity = (motion[2](sensor.time[rows], order) for order in (0, 1))
    if not _moves(motion, position, sensor):
        return None
    values = sensor.residual[rows, c] * sensor.noise
    head = (sensor.names[c], motion[0], "residual", sensor.unit, motion[1])
    return JointProfile(
        *head, values, np.full(values.size, sensor.noise), position, velocity, _direction(velocity),
        sensor.groups[rows], np.zeros((values.size, 0)), np.zeros(values.size, int),
    )  # fmt: skip


def _missing_torque(
    rig: Rig, simulated: SimulatedRecording, sensor: Channels, c: int, motion: _Motion, camera: Channels | None
) -> JointProfile | None:
    """Return the torque that the equation of motion of a joint's hub leaves.

    What goes with the residuals of the link's own markers is the link's pull; what goes with the torque, the simulated
    pull and its rate is a wrong inertia, stiffness or damping of the link, of which other symptoms tell.
    """
    joint = sensor.places[c][0]
    link = rig.active_links[joint]
    inertia = rig.links[link].hub_inertia
    others = [np.interp(sensor.time, sensor.time[sensor.known[:, c]], sensor.residual[sensor.known[:, c], c])]
    if camera is not None:
        own = rig.marker_slices[link]
        for k, (marker, axis) in enumerate(camera.places):
            if own.start <= marker < own.stop and axis == 1:
                rows = camera.known[:, k]
                others.append(np.interp(sensor.time, camera.time[rows], camera.residual[rows, k]))
    torque = simulated.recording.tau[:, joint]
    known = np.isfinite(torque)
    if known.any():
        driven = np.interp(sensor.time, simulated.recording.time[known], torque[known])
        pull = driven - inertia * motion[2](sensor.time, 2)
        others += [driven, pull, np.gradient(pull, sensor.time)]
    words = ("torque", "N m") if inertia > 0 else ("acceleration", "rad/s²")
    others = others if len(others) > 1 else []
    return _acceleration(sensor, c, motion, words, inertia if inertia > 0 else 1.0, others)


def _acceleration(
    sensor: Channels, c: int, motion: _Motion, words: tuple[str, str], inertia: float, others: Sequence[Array]
) -> JointProfile | None:
    """Return accelerations of a residual times an inertia, beside other residuals (F,); None without motion."""
    rows = sensor.known[:, c]
    time = sensor.time[rows]
    if time.size < 5 * _LEAST_POINTS:
        return None
    position, velocity = (motion[2](time, order) for order in (0, 1))
    # At most 64 stretches, for the noise of their accelerations grows fast, but one from turn to turn of the motion.
    turns, duration = int(np.count_nonzero(np.diff(np.sign(velocity)))), float(time[-1] - time[0])
    step = float(np.median(np.diff(time)))
    size = max(round(duration / max(64, turns + 1) / step), 5)
    count = time.size // size
    if size * step * (turns + 1) > 1.5 * duration or count < _LEAST_POINTS or not _moves(motion, position, sensor):
        return None

    def stretches(values: Array) -> Array:
        return values[: count * size].reshape(count, size)

    instants = stretches(time)
    width = np.ptp(instants, axis=1) + step
    whole = width < 1.5 * size * step  # without a gap
    instants, width = instants[whole], width[whole, None]
    if len(instants) < _LEAST_POINTS:
        return None
    place = 2 * (instants - instants.mean(axis=1, keepdims=True)) / width
    weights = (1 - np.clip(place, -1, 1) ** 2) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    parabola = np.linalg.pinv(np.stack([place**0, place, place**2], axis=2))[:, 2] * 8 / width**2 * inertia
    averaged = [
        np.sum(weights * stretches(values)[whole], axis=1)
        for values in (position, velocity, _direction(velocity), *(other[rows] for other in others))
    ]
    values = sensor.noise * np.sum(parabola * stretches(sensor.residual[rows, c])[whole], axis=1)
    beside = np.column_stack([np.zeros((values.size, 0)), *averaged[3:]])
    groups = sensor.groups[rows][: count * size : size][whole]
    return JointProfile(
        sensor.names[c], motion[0], *words, motion[1], values, sensor.noise * np.linalg.norm(parabola, axis=1),
        averaged[0], averaged[1], averaged[2], groups, beside, np.zeros(values.size, int),
    )  # fmt: skip
