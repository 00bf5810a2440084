"""The sensors of one recording, measured and simulated at the same instants and in the same coordinates.

Markers of a link that turns are taken along and across the link, in axes that turn with the simulated joints, and
both measured and simulated motion are *unrolled*: the simulated one becomes the integral of its velocity in those axes
(along an arc, for a joint that turns), the measured one is that plus the residual in those axes. Residuals and noise
stay what they are, a marker on a slewing arm moves as one on a straight rail would, and what is off by a constant in
the arm's own frame, a marker or a curvature, is a constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PPoly

from vjm.records import Array, Rig
from vjm.symptoms.records import Followed

Sensor = Literal["camera", "encoder"]

_LEAST_VALUES = 8  # of a channel
_BLOCKS = 12  # stretches of time whose sums are taken as independent
_LEAST_FRAMES_A_BLOCK = 4
_STILL = 3.0  # a channel that moves less than so many times its noise tells of an offset only


@dataclass(frozen=True)
class Channels:
    """What the camera, or all encoders, measured in one recording, beside what the model has for it.

    Attributes:
        sensor: which.
        names: (C) of the coordinates: `beam.m3.y` as in the recording's header, `beam.m3 across` where they turn with
            the link, `beam.theta` of an encoder.
        places: (C) marker and axis (0: x or along, 1: y or across), or joint and 0.
        time: (F,) instants at which anything was measured [s].
        measured: (F, C) [m or rad]; NaN where not measured.
        path: the simulation as a function of time, giving (F, C).
        noise: 1-sigma [m or rad].
        blocks: (F,) stretch of time to which each instant belongs, the same for camera and encoder.
    """

    sensor: Sensor
    names: tuple[str, ...]
    places: tuple[tuple[int, int], ...]
    time: Array
    measured: Array
    path: PPoly
    noise: float
    blocks: NDArray[np.intp]

    @cached_property
    def simulated(self) -> Array:
        """(F, C) [m or rad]."""
        return np.asarray(self.path(self.time), dtype=np.float64)

    @cached_property
    def rate(self) -> Array:
        """(F, C) of the simulation [m/s or rad/s]."""
        return np.asarray(self.path(self.time, 1), dtype=np.float64)

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """(F, C) where something was measured."""
        return np.isfinite(self.measured)

    @cached_property
    def residual(self) -> Array:
        """(F, C) measured less simulated, in units of the noise; zero where not measured."""
        return np.where(self.known, self.measured - self.simulated, 0.0) / self.noise

    @cached_property
    def moving(self) -> NDArray[np.bool_]:
        """(C,) whether the simulation moves by more than the noise."""
        return spread(self.simulated, self.known) > _STILL * self.noise

    @property
    def unit(self) -> str:
        """Of what is measured."""
        return "m" if self.sensor == "camera" else "rad"

    @property
    def step(self) -> float:
        """Median interval between instants [s]."""
        return float(np.median(np.diff(self.time)))


def spread(values: Array, known: NDArray[np.bool_]) -> Array:
    """(C,) standard deviation of (F, C) values over what is known."""
    return np.asarray(np.sqrt(np.sum(centred(values, known) ** 2, axis=0) / np.maximum(known.sum(axis=0), 1)))


def centred(values: Array, known: NDArray[np.bool_]) -> Array:
    """(F, C) values less their mean over what is known; zero elsewhere."""
    mean = np.sum(np.where(known, values, 0.0), axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known, values - mean, 0.0)


def middle_of_motion(channels: Channels) -> float:
    """Mean time of a sensor's motion [s]: delay and stretch are nearly independent there."""
    power = np.sum((channels.rate * channels.known) ** 2, axis=1)
    return float(np.average(channels.time, weights=power)) if power.any() else float(channels.time.mean())


def observe(followed: Followed) -> tuple[Channels, ...]:
    """The sensors that measured anything in a recording, the camera first."""
    recording = followed.recording
    if recording.time.size < _LEAST_VALUES:
        return ()
    joints = [(j, 0) for j in range(recording.theta.shape[1])]
    names = [f"{followed.rig.links[i].name}.theta" for i in followed.rig.active_links]
    encoder = _channels(
        followed, "encoder", names, recording.theta, CubicSpline(recording.time, followed.theta), joints
    )
    found = (_camera(followed), encoder)
    return tuple(each for each in found if each is not None)


def _camera(followed: Followed) -> Channels | None:
    recording, count = followed.recording, len(followed.recording.time)
    places = [(m, axis) for m in range(recording.markers.shape[1]) for axis in (0, 1)]
    measured, turns = recording.markers.reshape(count, -1), _turns(followed)
    simulated = CubicSpline(recording.time, followed.markers.reshape(count, -1))
    if turns is None:
        return _channels(followed, "camera", _names(followed.rig, turns), measured, simulated, places)
    residual = _turned(recording.markers - followed.markers, turns).reshape(count, -1)
    velocity = _turned(simulated(recording.time, 1).reshape(count, -1, 2), turns).reshape(count, -1)
    unrolled = CubicSpline(recording.time, velocity).antiderivative()
    start = _turned(followed.markers[:1], turns[:1]).reshape(1, -1)
    unrolled.c[-1] += start
    return _channels(
        followed, "camera", _names(followed.rig, turns), unrolled(recording.time) + residual, unrolled, places
    )


def _turns(followed: Followed) -> Array | None:
    """(T, k) angles by which the axes of each marker turn [rad]; None where none does."""
    recording, rig = followed.recording, followed.rig
    turns = np.zeros(recording.markers.shape[:2])
    both = np.isfinite(recording.markers.sum(axis=2)).sum(axis=0) > 0
    for i, (link, own) in enumerate(zip(rig.links, rig.marker_slices, strict=True)):
        before = [j for j, active in enumerate(rig.active_links) if active <= i]
        if link.markers_frame == "base" and before:
            turns[:, own] = followed.theta[:, before].sum(axis=1, keepdims=True) * both[own]
    return turns if turns.any() else None


def _turned(vectors: Array, turns: Array) -> Array:
    """(T, k, 2) vectors in axes that have turned by (T, k) angles [rad]."""
    x, y = vectors[..., 0], vectors[..., 1]
    cosine, sine = np.cos(turns), np.sin(turns)
    still = np.all(turns == 0, axis=0)  # of a marker with one coordinate, the other must not spoil it
    along = np.where(still, x, cosine * x + sine * y)
    return np.stack([along, np.where(still, y, cosine * y - sine * x)], axis=2)


def _names(rig: Rig, turns: Array | None) -> list[str]:
    markers = [f"{link.name}.m{k + 1}" for link in rig.links for k in range(len(link.markers))]
    turning = np.zeros(len(markers), dtype=bool) if turns is None else np.any(turns != 0, axis=0)
    axes = [(" along", " across") if each else (".x", ".y") for each in turning]
    return [marker + axis for marker, pair in zip(markers, axes, strict=True) for axis in pair]


def _channels(
    followed: Followed, sensor: Sensor, names: list[str], measured: Array, path: PPoly, places: list[tuple[int, int]]
) -> Channels | None:
    kept = np.flatnonzero(np.isfinite(measured).sum(axis=0) >= _LEAST_VALUES)
    time = followed.recording.time
    if not kept.size:
        return None
    rows = np.flatnonzero(np.isfinite(measured[:, kept]).any(axis=1))
    count = min(_BLOCKS, max(rows.size // _LEAST_FRAMES_A_BLOCK, 2))
    share = (time[rows] - time[0]) / (time[-1] - time[0])
    return Channels(
        sensor,
        tuple(names[c] for c in kept),
        tuple(places[c] for c in kept),
        time[rows],
        measured[np.ix_(rows, kept)],
        PPoly(path.c[:, :, kept], path.x),
        followed.noise[0] if sensor == "camera" else followed.noise[1],
        np.minimum((share * count).astype(np.intp), count - 1),
    )
