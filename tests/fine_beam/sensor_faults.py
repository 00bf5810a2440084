"""Cameras and encoders that do not show what they should; each fault is null by default.

A field is named by the effect and its parameter, `time_offset_delay` for the `delay` of `time_offset`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam.motion import Motion

Array = NDArray[np.float64]

_LATEST = 4.0  # standard deviations; no frame is taken earlier or later than that
_REACH = 1.5  # lengths of the arm; a rolling shutter sees no marker farther off


@dataclass(frozen=True)
class Faults:
    """Faults of the sensors. A camera's time stamp t is of its own clock, since the recording's start.

    Attributes:
        time_offset_delay: a frame shows the state of so much earlier than its stamp, s.
        clock_scale_scale: stamp over true time.
        camera_scale_scale: measured over true position.
        camera_rotation_angle: by which measured positions are turned about the base origin, rad.
        camera_translation_dx, camera_translation_dy: added to measured positions, after all else, m.
        camera_vibration_amplitude, camera_vibration_frequency, camera_vibration_phase: of the long axis of an ellipse
            on which measured positions go round, after all else, since the recording's start; m, Hz, rad.
        camera_vibration_direction, camera_vibration_ellipticity: of the long axis from x, rad; short over long axis,
            positive if they go round against the clock.
        encoder_offset_offset: encoder less true angle, rad.
        encoder_eccentricity_sine, encoder_eccentricity_cosine: of the angle, in what the encoder shows too much, rad.
        camera_tilt_px, camera_tilt_py: of a camera that looks at the plane obliquely, the sine of its tilt over its
            height, along the direction in which the plane recedes, 1/m.
        camera_tilt_centre_x, camera_tilt_centre_y: of the isocentre in the plane, where the scale is right, m.
        camera_tilt_height: of the camera above the plane, m.
        lens_distortion_k1: measured = true (1 + k1 r^2) about the lens's axis, 1/m^2; the base is at the origin.
        lens_distortion_centre_x, lens_distortion_centre_y: where the lens's axis meets the plane, m.
        rolling_shutter_readout: a marker is seen so much earlier per metre of its own way along the readout, s/m.
        rolling_shutter_direction: of the readout from y, against the clock, rad.
        timestamp_jitter_jitter, timestamp_jitter_seed: standard deviation, s, of the instants at which frames are taken
            about those of their stamps, which is normal up to four times as much; of the random numbers.
        marker_offset_marker: index of the misplaced marker, from 1; 0: none.
        marker_offset_along, marker_offset_across: where it is, less where it should be, m.
        marker_datum_along, marker_datum_across: where all markers are, less where they should be, m.
    """

    time_offset_delay: float = 0.0
    clock_scale_scale: float = 1.0
    camera_scale_scale: float = 1.0
    camera_rotation_angle: float = 0.0
    camera_translation_dx: float = 0.0
    camera_translation_dy: float = 0.0
    camera_vibration_amplitude: float = 0.0
    camera_vibration_frequency: float = 1.0
    camera_vibration_direction: float = 0.0
    camera_vibration_phase: float = 0.0
    camera_vibration_ellipticity: float = 0.0
    encoder_offset_offset: float = 0.0
    encoder_eccentricity_sine: float = 0.0
    encoder_eccentricity_cosine: float = 0.0
    camera_tilt_px: float = 0.0
    camera_tilt_py: float = 0.0
    camera_tilt_centre_x: float = 0.0
    camera_tilt_centre_y: float = 0.0
    camera_tilt_height: float = 2.0
    lens_distortion_k1: float = 0.0
    lens_distortion_centre_x: float = 0.0
    lens_distortion_centre_y: float = 0.0
    rolling_shutter_readout: float = 0.0
    rolling_shutter_direction: float = 0.0
    timestamp_jitter_jitter: float = 0.0
    timestamp_jitter_seed: int = 0
    marker_offset_marker: int = 0
    marker_offset_along: float = 0.0
    marker_offset_across: float = 0.0
    marker_datum_along: float = 0.0
    marker_datum_across: float = 0.0

    @property
    def encoder_eccentricity_phasor(self) -> complex:
        """Eccentricity over the radius of the disc's graduation, as a vector that turns with the joint."""
        return complex(self.encoder_eccentricity_sine, self.encoder_eccentricity_cosine)

    def margin(self, duration: float, length: float) -> float:
        """How far before its start and after its end, s, a recording of `duration` s sees an arm of `length` m."""
        late = abs(self.time_offset_delay) + abs(self.rolling_shutter_readout) * _REACH * length
        late += _LATEST * self.timestamp_jitter_jitter
        return late + duration * abs(1.0 / self.clock_scale_scale - 1.0)


def is_sensor_fault(effect: str) -> bool:
    """Whether the effect is in the sensors."""
    return any(each.name.startswith(f"{effect}_") for each in fields(Faults))


def shown_markers(
    motion: Motion, stamps: Array, arc_lengths: Sequence[float], faults: Faults, recording: int = 0
) -> Array:
    """What a camera without noise shows in frames stamped (f,) in s: markers, m, (f, k, 2).

    The recording's number makes the instants' random errors its own.
    """
    arcs = np.array(arc_lengths, dtype=float) + faults.marker_datum_along
    across = np.full(len(arc_lengths), faults.marker_datum_across)
    if faults.marker_offset_marker:
        arcs[faults.marker_offset_marker - 1] += faults.marker_offset_along
        across[faults.marker_offset_marker - 1] += faults.marker_offset_across
    time = stamps / faults.clock_scale_scale - faults.time_offset_delay
    if faults.timestamp_jitter_jitter:
        errors = np.random.default_rng([faults.timestamp_jitter_seed, recording]).standard_normal(len(stamps))
        time = time - faults.timestamp_jitter_jitter * np.clip(errors, -_LATEST, _LATEST)
    points = motion.at(time).positions(arcs, across)
    # Readout's time per metre along x and y.
    angle = faults.rolling_shutter_direction
    readout = faults.rolling_shutter_readout * np.array([-np.sin(angle), np.cos(angle)])
    if faults.rolling_shutter_readout:
        points = _read_out(motion, time, arcs, across, points, readout)
    seen = time[:, None] - points @ readout
    return _distort(points, faults) + _shake(seen, faults)


def _read_out(motion: Motion, time: Array, arcs: Array, across: Array, points: Array, readout: Array) -> Array:
    """Points (f, k, 2) each seen at t - readout . position, with the position at which it is seen."""
    for _ in range(4):
        seen = [
            motion.at(time - points[:, k] @ readout).positions([arc], [side])[:, 0]
            for k, (arc, side) in enumerate(zip(arcs, across, strict=True))
        ]
        points = np.stack(seen, axis=1)
    return points


def _distort(points: Array, faults: Faults) -> Array:
    """Tilt first, then lens, then scale, then rotation, then translation; the first two leave the base where it is."""
    for deform in (_look_obliquely, _refract):
        points = deform(points, faults) - deform(np.zeros(2), faults)
    points = faults.camera_scale_scale * points
    cosine, sine = np.cos(faults.camera_rotation_angle), np.sin(faults.camera_rotation_angle)
    shift = np.array([faults.camera_translation_dx, faults.camera_translation_dy])
    return np.asarray(points @ np.array([[cosine, sine], [-sine, cosine]]) + shift)


def _look_obliquely(points: Array, faults: Faults) -> Array:
    """What a pinhole camera shows of points (..., 2) in the plane, its picture's axes along x and y without a tilt.

    The ray to the isocentre halves the angle between the picture's normal and the plane's; there the scale is one.
    """
    height, tilt = faults.camera_tilt_height, np.array([faults.camera_tilt_px, faults.camera_tilt_py])
    angle, azimuth = np.arcsin(height * np.linalg.norm(tilt)), np.arctan2(tilt[1], tilt[0])
    away = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])  # where the plane recedes
    left, up = np.array([-away[1], away[0], 0.0]), np.array([0.0, 0.0, 1.0])
    isocentre = np.array([faults.camera_tilt_centre_x, faults.camera_tilt_centre_y, 0.0])
    camera = isocentre + height * (up - np.tan(angle / 2) * away)
    sight = np.sin(angle) * away - np.cos(angle) * up  # the optical axis
    picture = np.cos(angle) * away + np.sin(angle) * up
    rays = np.concatenate([points, np.zeros((*points.shape[:-1], 1))], axis=-1) - camera
    depth = rays @ sight
    pixels = np.stack([rays @ picture / depth, rays @ left / depth], axis=-1)
    return np.asarray(
        height * pixels @ np.stack([away[:2], left[:2]])
    )  # the isocentre is as deep as the camera is high


def _refract(points: Array, faults: Faults) -> Array:
    """Points (..., 2) as a lens with radial distortion shows them."""
    off = points - np.array([faults.lens_distortion_centre_x, faults.lens_distortion_centre_y])
    return np.asarray(points + faults.lens_distortion_k1 * np.sum(off**2, axis=-1, keepdims=True) * off)


def _shake(time: Array, faults: Faults) -> Array:
    """By how much a camera that shakes shows markers beside where they are, at instants (f, k) in s: m, (f, k, 2)."""
    angle = 2.0 * np.pi * faults.camera_vibration_frequency * time + faults.camera_vibration_phase
    axis = np.array([np.cos(faults.camera_vibration_direction), np.sin(faults.camera_vibration_direction)])
    side = np.array([-axis[1], axis[0]]) * faults.camera_vibration_ellipticity
    ellipse = np.sin(angle)[..., None] * axis - np.cos(angle)[..., None] * side
    return np.asarray(faults.camera_vibration_amplitude * ellipse)


def shown_angle(motion: Motion, time: Array, faults: Faults) -> Array:
    """What an encoder without noise shows at instants (e,) in s: the joint's angle, rad, (e,)."""
    theta = motion.at(time).theta
    # The disc's centre turns about the axis; the head stays where it is, and the encoder is set to zero at zero.
    wobble = np.imag(faults.encoder_eccentricity_phasor * (np.exp(1j * theta) - 1.0))
    return np.asarray(theta + wobble + faults.encoder_offset_offset)
