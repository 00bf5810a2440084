"""Cameras that are not where or as they should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Self

import numpy as np

from vjm.chain.curve import rotate
from vjm.effects.effect import Effect, WaveEffect, is_recorded, magnitude, shape_parameter
from vjm.records import Array, Recording, Rig


@dataclass(frozen=True)
class _CameraEffect(Effect):
    """Acts on the camera; markers given in a moving link's frame do not show it."""

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        fixed = all(
            link.markers_frame == "base" or (i == 0 and link.joint == "clamped")
            for i, link in enumerate(rig.links)
            if link.markers
        )
        return "" if fixed else "marker coordinates are in a rotating link frame, not the camera's"


@dataclass(frozen=True)
class CameraScale(Effect):
    """A camera that shows all positions larger than they are, by the scale."""

    scale: float = magnitude("", 0.008, null=1.0, lower=0.5, upper=2.0)

    description = "scale error of the camera"
    clause = "the camera scale is {scale} times the true one"
    assumptions = "one scale in both directions and all over the picture"
    reference = "Z. Zhang, A flexible new technique for camera calibration, IEEE Trans. Pattern Analysis 22(11), 2000"
    distinguishing_experiment = "two fiducials at a known distance in the camera's view"
    abscissa = "position"
    camera_order = 3
    common = True

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return larger positions."""
        return self.scale * positions


@dataclass(frozen=True)
class CameraRotation(_CameraEffect):
    """A camera that shows all positions turned about the base's origin."""

    angle: float = magnitude("rad", 0.01, lower=-np.pi, upper=np.pi)

    description = "camera rotated relative to the base"
    clause = "the camera is rotated by {angle} relative to the base"
    assumptions = "a turn within the plane of motion, about the base's origin; the same in every recording"
    reference = "R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision, 2nd edition, Cambridge, 2004"
    distinguishing_experiment = "a fixed fiducial beside the base in the camera's view"
    abscissa = "tangential"
    camera_order = 3

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Return the reason if nothing else says where the arm points."""
        if reason := super().untestable(rig, recordings):
            return reason
        under_gravity = any(any(recording.gravity) for recording in recordings)
        if rig.links[0].joint == "revolute" and not is_recorded(recordings, "theta") and not under_gravity:
            return "without encoder or gravity, a rotated camera and a rotated arm are indistinguishable"
        return ""

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return turned positions."""
        return rotate(positions, np.asarray(self.angle))


@dataclass(frozen=True)
class CameraTranslation(_CameraEffect):
    """A camera whose origin is not the base's: it shows all positions shifted by the same vector."""

    dx: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)
    dy: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)

    description = "camera shifted relative to the base"
    clause = "the camera is shifted relative to the base: all markers appear {dx} along x and {dy} along y off"
    assumptions = "the same shift in every recording, within the plane of motion"
    reference = (
        "R. Y. Tsai and R. K. Lenz, A new technique for fully autonomous and efficient 3D robotics hand/eye "
        "calibration, IEEE Trans. Robotics and Automation 5(3), 1989"
    )
    distinguishing_experiment = "a fixed fiducial beside the base in the camera's view; several hub angles"
    abscissa = "marker"
    camera_order = 4

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return shifted positions."""
        return positions if self.is_null else positions + np.array([self.dx, self.dy])


@dataclass(frozen=True)
class CameraVibration(WaveEffect, _CameraEffect):
    """A camera that shakes at one frequency, so that all markers move together along an ellipse.

    They move by amplitude sin(2 pi frequency t + phase) along the ellipse's long axis, which is turned by the direction
    from x, and by -ellipticity amplitude cos(2 pi frequency t + phase) across it. Time is that since the start of each
    recording. A search varies the cosine's and the sine's amplitudes along x and y, in which the motion is linear.
    """

    amplitude: float = magnitude("m", 5e-4, lower=0.0, in_rig_units=True)
    frequency: float = shape_parameter("Hz", 2.5, lower=5e-3, upper=5e3, from_spectrum="time", in_rig_units=True)
    direction: float = shape_parameter("rad", 0.0, lower=-np.pi / 2, upper=np.pi / 2)
    phase: float = shape_parameter("rad", 0.0, lower=-np.pi, upper=np.pi)
    ellipticity: float = shape_parameter("", 0.0, lower=-1.0, upper=1.0)  # short over long axis, against the clock

    description = "camera vibration: all markers shake together"
    clause = "the camera vibrates by {amplitude} at {frequency}, {direction} from x"
    assumptions = "one constant ellipse, frequency and phase in every recording; no turn of the camera"
    reference = (
        "S. Yoneyama and H. Ueda, Bridge deflection measurement using digital image correlation with camera movement "
        "correction, Materials Transactions 53(2), 2012"
    )
    distinguishing_experiment = "a fixed fiducial in the camera's view; a quiet recording, in which nothing moves"
    abscissa = "frequency"
    camera_order = 4

    @property
    def coordinates(self) -> Array:
        """(5,) cosine's amplitudes along x and y and the sine's, over a typical one; logarithm of the frequency."""
        amplitude, frequency = self.parameters[:2]
        size, axis, start = amplitude.coordinate(self.amplitude), np.exp(1j * self.direction), np.exp(1j * self.phase)
        cosine = axis * size * (start.imag - 1j * self.ellipticity * start.real)
        sine = axis * size * (start.real + 1j * self.ellipticity * start.imag)
        logarithm = frequency.coordinate(self.frequency)
        return np.array([cosine.real, cosine.imag, sine.real, sine.imag, logarithm])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at other coordinates (5,); without amplitude, with direction and phase zero."""
        amplitude, frequency = self.parameters[:2]
        numbers = np.asarray(coordinates, dtype=float)
        cosine, sine = numbers[[0, 2]] + 1j * numbers[[1, 3]]
        # The ellipse is the sum of two circles, run through in opposite senses.
        forward, backward = 1j * (cosine - 1j * sine) / 2, -1j * (cosine + 1j * sine) / 2
        sizes, angles = np.abs([forward, backward]), np.angle([forward, backward])
        direction, phase = float(angles.sum() / 2), float((angles[0] - angles[1]) / 2)
        if abs(direction) > np.pi / 2:  # half a turn of the axis is half a cycle
            direction, phase = (angle - np.copysign(np.pi, angle) for angle in (direction, phase))
        major, minor = float(sizes.sum()), float(sizes[0] - sizes[1])
        return replace(
            self,
            amplitude=amplitude.value(major),
            frequency=frequency.value(float(numbers[4])),
            direction=direction,
            phase=phase,
            ellipticity=minor / major if major else 0.0,
        )

    @property
    def magnitude_count(self) -> int:
        """Number of magnitudes: of cosine and sine, along x and y."""
        return 4

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return positions that shake."""
        angle = 2 * np.pi * self.frequency * time + self.phase
        along, across = self.amplitude * np.sin(angle), -self.ellipticity * self.amplitude * np.cos(angle)
        shake = rotate(np.stack([along, across], axis=-1), np.asarray(self.direction))
        return positions if self.is_null else positions + shake[:, None]


@dataclass(frozen=True)
class _CentredEffect(_CameraEffect):
    """Deforms the picture about a centre, and shows the base where it is; `centre_x` and `centre_y` are parameters."""

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return instances with centres in the middle, on the edges and in the corners of what the camera saw."""
        seen = [recording.markers[np.isfinite(recording.markers).all(axis=-1)] for recording in recordings]
        points = np.concatenate([np.zeros((1, 2)), *seen])  # the base was in the picture
        x, y = map(np.unique, np.linspace(points.min(axis=0), points.max(axis=0), 3).T)
        return tuple(
            replace(absent, **{"centre_x": centre_x, "centre_y": centre_y})
            for absent in super().variants(rig, recordings)
            for centre_x, centre_y in product(x.tolist(), y.tolist())
        )

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return deformed positions."""
        values = self.values
        centre = np.array([values["centre_x"], values["centre_y"]])
        deformed: Array = positions + self.displacement(positions - centre) - self.displacement(-centre)
        return deformed

    def displacement(self, points: Array) -> Array:
        """Return by how much (..., 2) the picture displaces points (..., 2) given from the centre [m]."""
        raise NotImplementedError


def _centre() -> Any:
    """Declare a coordinate of a picture's centre: typically half the arm's length from the base, at most all of it."""
    return shape_parameter("m", 0.5, lower=-1.0, upper=1.0, power=1, in_rig_units=True)


@dataclass(frozen=True)
class CameraTilt(_CentredEffect):
    """A pinhole camera that looks at the plane of motion obliquely: measured = true / (1 + px x + py y) from a centre.

    The centre is the isocentre, where the scale is right: the ray to it halves the angle between the optical axis and
    the plane's normal. The vector (px, py) points where the plane recedes; its length is the sine of the tilt over the
    camera's height above the plane. The base is shown where it is: the picture's origin was set to it.
    """

    px: float = magnitude("1/m", 0.01, lower=-0.2, upper=0.2, in_rig_units=True)
    py: float = magnitude("1/m", 0.01, lower=-0.2, upper=0.2, in_rig_units=True)
    centre_x: float = _centre()
    centre_y: float = _centre()

    description = "camera that looks at the plane of motion obliquely"
    clause = (
        "the camera is tilted: its scale falls by {px} along x and {py} along y"
        "[, from a centre {centre_x} along x][, {centre_y} along y off the base]"
    )
    assumptions = "a pinhole; square pixels; markers in one plane; the right scale at the centre, the base in its place"
    reference = "R. Hartley and A. Zisserman, Multiple View Geometry in Computer Vision, 2nd edition, Cambridge, 2004"
    distinguishing_experiment = "four fiducials at known places in the camera's view"
    abscissa = "position"
    camera_order = 1

    def displacement(self, points: Array) -> Array:
        """Return the displacement by the perspective."""
        depth: Array = (points * np.array([self.px, self.py])).sum(axis=-1, keepdims=True)
        return -points * depth / (1 + depth)


@dataclass(frozen=True)
class LensDistortion(_CentredEffect):
    """A radial distortion about a centre, where the lens's axis meets the plane: measured = true (1 + k1 r^2) from it.

    The base is shown where it is: the picture's origin was set to it.
    """

    k1: float = magnitude("1/m^2", 0.01, lower=-0.5, upper=0.5, in_rig_units=True)
    centre_x: float = _centre()
    centre_y: float = _centre()

    description = "radial lens distortion"
    clause = "the lens distorts radially, k1 = {k1}[, its axis {centre_x} along x][, {centre_y} along y off the base]"
    assumptions = "one coefficient; the right scale at the centre, the base in its place"
    reference = "D. C. Brown, Decentering distortion of lenses, Photogrammetric Engineering 32(3), 1966"
    distinguishing_experiment = "three or more fiducials at known distances in the camera's view"
    abscissa = "radial"
    camera_order = 2

    def displacement(self, points: Array) -> Array:
        """Return the displacement by the lens."""
        squares: Array = (points * points).sum(axis=-1, keepdims=True)
        return self.k1 * squares * points


@dataclass(frozen=True)
class RollingShutter(_CameraEffect):
    """Rows that are read one after another: a marker is shown as it was earlier, by the readout times its way along it.

    The direction of the readout is from y, against the clock: rows along x are read at zero. A search varies the
    readout's components along x and y, in which delays are linear.
    """

    readout: float = magnitude("s/m", 0.01, lower=-0.4, upper=0.4, in_rig_units=True)
    direction: float = shape_parameter("rad", 0.0, lower=-np.pi / 2, upper=np.pi / 2)

    description = "rolling shutter: the camera reads its rows one after another"
    clause = "the camera has a rolling shutter, readout {readout} in a direction {direction} from y"
    assumptions = "straight rows, read at a constant rate; a row through the base's origin taken at the time stamp"
    reference = "C.-K. Liang et al., Analysis and compensation of rolling shutter effect, IEEE Trans. Image Proc., 2008"
    distinguishing_experiment = "fast motion far to both sides of the base"
    abscissa = "velocity"

    @property
    def coordinates(self) -> Array:
        """(2,) components of the readout along y and against x, over a typical one."""
        size = self.parameters[0].coordinate(self.readout)
        return size * np.array([np.cos(self.direction), np.sin(self.direction)])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at other components (2,); without a readout, in direction zero."""
        along, against = np.asarray(coordinates, dtype=float).tolist()
        side = -1.0 if along < 0 else 1.0  # half a turn of the direction is the readout's sign
        size, direction = side * float(np.hypot(along, against)), float(np.arctan2(side * against, side * along))
        return replace(self, readout=self.parameters[0].value(size), direction=direction)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (2,), (2,) of the components."""
        low, high = self.parameters[0].bounds
        return np.full(2, low), np.full(2, high)

    @property
    def magnitude_count(self) -> int:
        """Number of magnitudes: of both components."""
        return 2

    def camera_instants(self, time: Array, positions: Array) -> Array:
        """Return each marker's own instants."""
        readout = self.readout * np.array([-np.sin(self.direction), np.cos(self.direction)])
        return time if self.is_null else time[:, None] - positions @ readout
