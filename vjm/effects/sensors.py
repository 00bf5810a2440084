"""Cameras and markers that are not where they should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from vjm.chain.curve import rotate
from vjm.effects.effect import (
    LINK_FRAME,
    NO_CLOCK,
    NO_ENCODER,
    ColumnEffect,
    Effect,
    LinkEffect,
    has_encoder,
    has_torque,
    in_base_frame,
    magnitude,
    shape_parameter,
)
from vjm.errors import ShapeError
from vjm.records import Array, Recording, Rig


@dataclass(frozen=True)
class CameraScale(Effect):
    """All positions are shown larger than they are.

    Attributes:
        scale: measured over true position.
    """

    scale: float = magnitude("", 0.008, null=1.0, lower=0.5, upper=2.0)

    id = "camera_scale"
    description = "a camera whose scale is off"
    clause = "a camera that shows everything {scale} times as large as it is"
    reference = (
        "Z. Zhang, A flexible new technique for camera calibration, IEEE Transactions on Pattern Analysis and Machine "
        "Intelligence 22(11), 2000"
    )
    distinguishing_experiment = "two fiducials at a measured distance in the camera's view"
    abscissa = "position"
    common = True
    sensor = True

    def marker_positions(self, positions: Array, headings: Array) -> Array:
        """Larger."""
        return positions if self.is_null else self.scale * positions


@dataclass(frozen=True)
class CameraRotation(Effect):
    """All positions are shown turned about the base's origin.

    Attributes:
        angle: [rad].
    """

    angle: float = magnitude("rad", 0.01, lower=-np.pi, upper=np.pi)

    id = "camera_rotation"
    description = "a camera that is turned against the base"
    clause = "a camera that is turned by {angle} against the base"
    reference = "R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision, 2nd edition, Cambridge, 2004"
    distinguishing_experiment = "a fixed fiducial beside the base in the camera's view"
    abscissa = "tangential"
    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Something else must say where the arm points."""
        if not in_base_frame(rig):
            return LINK_FRAME
        pulled = any(any(recording.gravity) for recording in recordings)
        if rig.links[0].joint == "revolute" and not has_encoder(recordings) and not pulled:
            return "without an encoder and without gravity, a turned camera and a turned arm look the same"
        return ""

    def marker_positions(self, positions: Array, headings: Array) -> Array:
        """Turned."""
        return positions if self.is_null else rotate(positions, np.asarray(self.angle))


@dataclass(frozen=True)
class LensDistortion(Effect):
    """Radial, about the base's origin: measured = true (1 + k1 r^2).

    Attributes:
        k1: [1/m^2].
    """

    k1: float = magnitude("1/m^2", 0.01, lower=-0.5, upper=0.5)

    id = "lens_distortion"
    description = "a lens that distorts with the distance from the middle"
    clause = "a lens that distorts with the distance from the middle, by {k1}"
    reference = "D. C. Brown, Decentering distortion of lenses, Photogrammetric Engineering 32(3), 1966"
    distinguishing_experiment = "three or more fiducials at measured distances in the camera's view"
    abscissa = "radial"
    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """The middle is the camera's."""
        return "" if in_base_frame(rig) else LINK_FRAME

    def marker_positions(self, positions: Array, headings: Array) -> Array:
        """Distorted."""
        if self.is_null:
            return positions
        squares: Array = (positions * positions).sum(axis=-1, keepdims=True)
        return positions * (1 + self.k1 * squares)


@dataclass(frozen=True)
class MarkerOffset(LinkEffect):
    """One marker is not where the rig's file says.

    Attributes:
        marker: which of the link's, from 1.
        along, across: where it is, less where it should be, along the link's tangent and normal [m].
        first: number of markers on the links before this one; None: unknown, right for the first link only.
    """

    marker: int = shape_parameter("", 1, lower=1, integer=True)
    along: float = magnitude("m", 0.005, lower=-0.5, upper=0.5)
    across: float = magnitude("m", 0.005, lower=-0.5, upper=0.5)
    first: int | None = field(default=None, kw_only=True)

    id = "marker_offset"
    description = "a marker that is not where the experiment file says"
    clause = "marker {marker} of {link} off by {along} along and {across} across the link"
    reference = (
        "J. M. Hollerbach and C. W. Wampler, The calibration index and taxonomy for robot kinematic calibration "
        "methods, International Journal of Robotics Research 15(6), 1996"
    )
    distinguishing_experiment = "a ruler: measure where on the link the marker is"
    abscissa = "marker"
    sensor = True

    @property
    def column(self) -> int:
        """Of the marker among all links' markers.

        Raises:
            ShapeError: a link further out whose first marker is unknown.
        """
        if self.first is None and self.index > 0:
            raise ShapeError("marker_offset", f"link {self.index} without `first`", "an instance from `variants`")
        return (self.first or 0) + self.marker - 1

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Links with markers."""
        return tuple(i for i, link in enumerate(rig.links) if link.markers)

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """One for each marker."""
        return tuple(
            replace(self, link=i, marker=k, first=part.start)
            for i, part in enumerate(rig.marker_slices)
            for k in range(1, part.stop - part.start + 1)
        )

    def marker_positions(self, positions: Array, headings: Array) -> Array:
        """With that marker displaced."""
        if self.is_null:
            return positions
        found, heading = positions.copy(), headings[..., self.column]
        found[..., self.column, :] += rotate(np.array([self.along, self.across]), heading)
        return found


@dataclass(frozen=True)
class EncoderOffset(ColumnEffect):
    """The encoder's zero is not where the link points along x.

    Attributes:
        offset: shown less true angle [rad].
    """

    offset: float = magnitude("rad", 0.005, lower=-np.pi, upper=np.pi)

    id = "encoder_offset"
    description = "the encoder's zero is off"
    clause = "an encoder at {link} whose zero is off by {offset}"
    reference = (
        "J. M. Hollerbach and C. W. Wampler, The calibration index and taxonomy for robot kinematic calibration "
        "methods, International Journal of Robotics Research 15(6), 1996"
    )
    distinguishing_experiment = (
        "a fixed fiducial beside the base in the camera's view; under gravity, static sag at several hub angles"
    )
    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Without an encoder there is nothing to be wrong."""
        return super().untestable(rig, recordings) or ("" if has_encoder(recordings) else NO_ENCODER)

    def encoder_angles(self, theta: Array) -> Array:
        """Shifted."""
        return theta if self.is_null else self.column_of(theta, 1.0, self.offset)


@dataclass(frozen=True)
class ClockEffect(Effect):
    """In the camera's clock against that of encoders and torques."""

    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """One clock alone is never wrong."""
        return "" if has_torque(recordings) or has_encoder(recordings) else NO_CLOCK


@dataclass(frozen=True)
class TimeOffset(ClockEffect):
    """The camera shows an earlier state than that of its time stamp.

    Attributes:
        delay: [s].
    """

    delay: float = magnitude("s", 0.015, lower=-0.1, upper=0.1)

    id = "time_offset"
    description = "a camera that lags behind its time stamps"
    clause = "a camera that lags {delay} behind its time stamps"
    reference = (
        "P. Furgale, J. Rehder and R. Siegwart, Unified temporal and spatial calibration for multi-sensor systems, "
        "IEEE/RSJ International Conference on Intelligent Robots and Systems (IROS), 2013"
    )
    distinguishing_experiment = "driven recordings with fast motion, and two recordings that start differently"
    abscissa = "velocity"
    common = True

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Earlier."""
        return time if self.is_null else time - self.delay


@dataclass(frozen=True)
class ClockScale(ClockEffect):
    """The camera's clock runs faster than the encoder's.

    Attributes:
        scale: time of the camera over true time.
    """

    scale: float = magnitude("", 0.002, null=1.0, lower=0.8, upper=1.25)

    id = "clock_scale"
    description = "a camera whose clock does not run at the encoder's rate"
    clause = "a camera whose clock runs {scale} times as fast as the encoder's"
    reference = (
        "E. Olson, A passive solution to the sensor synchronization problem, IEEE/RSJ International Conference on "
        "Intelligent Robots and Systems (IROS), 2010"
    )
    distinguishing_experiment = "long driven recordings"

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """By the encoder's clock."""
        return time if self.is_null else time / self.scale


@dataclass(frozen=True)
class RollingShutter(Effect):
    """Rows are read one after another: a marker is shown as it was earlier, in proportion to its y.

    Attributes:
        readout: delay over y [s/m].
    """

    readout: float = magnitude("s/m", 0.005, lower=-0.2, upper=0.2)

    id = "rolling_shutter"
    description = "a camera that reads its rows one after another"
    clause = "a camera that reads its rows one after another, in {readout}"
    reference = (
        "C.-K. Liang, L.-W. Chang and H. H. Chen, Analysis and compensation of rolling shutter effect, IEEE "
        "Transactions on Image Processing 17(8), 2008"
    )
    distinguishing_experiment = "fast motion far to both sides of the base"
    abscissa = "velocity"
    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Rows are the camera's."""
        return "" if in_base_frame(rig) else LINK_FRAME

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Each marker's own."""
        return time if self.is_null else time[:, None] - self.readout * positions[..., 1]
