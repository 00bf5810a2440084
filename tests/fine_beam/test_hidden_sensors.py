"""Faulty cameras and encoders: what they show of a known motion."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from tests.fine_beam.arms import HUB, MARKERS, alone, drive
from tests.fine_beam.hidden import Physics
from tests.fine_beam.motion import Motion, Run
from tests.fine_beam.sensor_faults import Faults, shown_angle, shown_markers


@pytest.fixture(scope="module")
def seen() -> Motion:
    """A driven motion from a quarter of a second before its recording to a quarter after."""
    time = np.arange(-125, 626) / 500.0
    return alone(HUB, Physics(), Run(0.5 * drive(time) * (time > 0.0)), time)


STAMPS = np.arange(101) / 100.0


def test_a_good_camera_and_encoder_show_the_motion(seen: Motion) -> None:
    expected = seen.at(STAMPS)
    np.testing.assert_allclose(shown_markers(seen, STAMPS, MARKERS, Faults()), expected.positions(MARKERS), atol=1e-15)
    np.testing.assert_array_equal(shown_angle(seen, STAMPS, Faults()), expected.theta)
    np.testing.assert_allclose(shown_angle(seen, STAMPS, Faults(encoder_offset_offset=0.01)), expected.theta + 0.01)
    eccentric = Faults(encoder_eccentricity_sine=0.02, encoder_eccentricity_cosine=-0.01)
    error = 0.02 * np.sin(expected.theta) - 0.01 * (np.cos(expected.theta) - 1.0)
    np.testing.assert_allclose(shown_angle(seen, STAMPS, eccentric), expected.theta + error)


def test_late_and_fast_cameras_show_other_instants(seen: Motion) -> None:
    late = shown_markers(seen, STAMPS, MARKERS, Faults(time_offset_delay=0.015))
    np.testing.assert_allclose(late, seen.at(STAMPS - 0.015).positions(MARKERS), atol=1e-15)
    fast = shown_markers(seen, STAMPS, MARKERS, Faults(clock_scale_scale=1.01))
    np.testing.assert_allclose(fast, seen.at(STAMPS / 1.01).positions(MARKERS), atol=1e-15)
    assert Faults(time_offset_delay=-0.015).margin(5.0, 1.0) == pytest.approx(0.015)
    assert Faults(clock_scale_scale=0.99).margin(5.0, 1.0) == pytest.approx(5.0 / 0.99 - 5.0)


def test_a_rolling_shutter_sees_each_marker_when_its_row_is_read(seen: Motion) -> None:
    shown = shown_markers(seen, STAMPS, MARKERS, Faults(rolling_shutter_readout=0.05))
    for frame in (30, 60, 100):
        for marker, arc in enumerate(MARKERS):
            instant = np.array([STAMPS[frame] - 0.05 * shown[frame, marker, 1]])
            np.testing.assert_allclose(seen.at(instant).positions([arc])[0, 0], shown[frame, marker], atol=1e-6)
    assert np.abs(shown - seen.at(STAMPS).positions(MARKERS)).max() > 1e-3


def test_a_readout_may_be_in_any_direction(seen: Motion) -> None:
    shown = shown_markers(seen, STAMPS, MARKERS, Faults(rolling_shutter_readout=0.05, rolling_shutter_direction=-2.0))
    way = (np.exp(2.0j) * (shown @ [1, 1j])).imag
    for marker, arc in enumerate(MARKERS):
        instant = np.array([STAMPS[60] - 0.05 * way[60, marker]])
        np.testing.assert_allclose(seen.at(instant).positions([arc])[0, 0], shown[60, marker], atol=1e-6)


def test_a_tilted_camera_shows_a_homography_with_its_scale_right_at_the_isocentre(seen: Motion) -> None:
    """Whatever the camera's height: closed form, against rays in space."""
    truth = seen.at(STAMPS).positions(MARKERS)
    centre, slope = np.array([0.3, -0.2]), np.array([0.02, 0.05])
    closed = (truth - centre) / (1.0 + (truth - centre) @ slope)[..., None] + centre / (1.0 - centre @ slope)
    named = {"camera_tilt_px": 0.02, "camera_tilt_py": 0.05, "camera_tilt_centre_x": 0.3, "camera_tilt_centre_y": -0.2}
    for height in (0.5, 2.0, 8.0):
        shown = shown_markers(seen, STAMPS, MARKERS, Faults(**named, camera_tilt_height=height))
        np.testing.assert_allclose(shown, closed, atol=1e-13)


def test_distortions_of_the_image(seen: Motion) -> None:
    truth = seen.at(STAMPS).positions(MARKERS)
    flat = truth[..., 0] + 1j * truth[..., 1]
    for faults, expected in (
        (Faults(camera_scale_scale=1.01), 1.01 * flat),
        (Faults(camera_rotation_angle=0.01), np.exp(0.01j) * flat),
        (Faults(camera_translation_dx=0.004, camera_translation_dy=-0.01), flat + 0.004 - 0.01j),
        # The camera stands aside of the base and is turned: the shift is seen along its own axes.
        (Faults(camera_rotation_angle=0.5, camera_translation_dx=0.01), np.exp(0.5j) * flat + 0.01),
        (Faults(lens_distortion_k1=0.02), (1.0 + 0.02 * np.abs(flat) ** 2) * flat),
        # About the point i, which the base is one away from.
        (
            Faults(lens_distortion_k1=0.02, lens_distortion_centre_y=1.0),
            flat + 0.02 * np.abs(flat - 1.0j) ** 2 * (flat - 1.0j) + 0.02j,
        ),
    ):
        shown = shown_markers(seen, STAMPS, MARKERS, faults)
        np.testing.assert_allclose(shown[..., 0] + 1j * shown[..., 1], expected, atol=1e-14)


def test_a_shaking_camera_moves_all_markers_round_one_ellipse(seen: Motion) -> None:
    faults = Faults(
        camera_vibration_amplitude=0.002,
        camera_vibration_frequency=5.0,
        camera_vibration_direction=0.4,
        camera_vibration_phase=-1.0,
        camera_vibration_ellipticity=0.25,
    )
    shift = shown_markers(seen, STAMPS, MARKERS, faults) - shown_markers(seen, STAMPS, MARKERS, Faults())
    np.testing.assert_allclose(shift, np.broadcast_to(shift[:, :1], shift.shape), atol=1e-15)
    own = np.exp(-0.4j) * (shift[:, 0] @ np.array([1.0, 1.0j]))  # along the ellipse's axes
    np.testing.assert_allclose(own.real, 0.002 * np.sin(10 * np.pi * STAMPS - 1.0), atol=1e-14)
    np.testing.assert_allclose((own.real / 0.002) ** 2 + (own.imag / 0.0005) ** 2, 1.0, atol=1e-9)
    assert np.all(np.diff(np.unwrap(np.angle(own))) > 0.0)  # against the clock
    # Rows that are read later shake later.
    rolling = replace(faults, rolling_shutter_readout=0.05)
    still = shown_markers(seen, STAMPS, MARKERS, Faults(rolling_shutter_readout=0.05))
    later = np.exp(-0.4j) * ((shown_markers(seen, STAMPS, MARKERS, rolling) - still) @ np.array([1.0, 1.0j]))
    instants = STAMPS[:, None] - 0.05 * still[..., 1]
    np.testing.assert_allclose(later.real, 0.002 * np.sin(10 * np.pi * instants - 1.0), atol=1e-14)


def test_frames_are_taken_a_little_earlier_or_later_all_markers_together(seen: Motion) -> None:
    faults = Faults(timestamp_jitter_jitter=0.004, timestamp_jitter_seed=3)
    one, other = (shown_markers(seen, STAMPS, MARKERS, faults, recording) for recording in (1, 2))
    np.testing.assert_array_equal(one, shown_markers(seen, STAMPS, MARKERS, faults, 1))
    assert np.abs(one - other).max() > 1e-3
    # The instants that explain the markers, by how far they are along their velocities.
    ahead, behind = (seen.at(STAMPS + side).positions(MARKERS) for side in (1e-4, -1e-4))
    speed, difference = (ahead - behind) / 2e-4, one - seen.at(STAMPS).positions(MARKERS)
    moving = np.linalg.norm(speed, axis=(1, 2)) > 0.1
    errors = (np.sum(speed * difference, axis=(1, 2)) / np.sum(speed**2, axis=(1, 2)))[moving]
    assert errors.size > 40
    assert np.std(errors) == pytest.approx(0.004, rel=0.3)
    assert abs(np.mean(errors)) < 4 * 0.004 / np.sqrt(errors.size)
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < 4 / np.sqrt(errors.size)
    assert faults.margin(5.0, 1.0) == pytest.approx(0.016)


@pytest.mark.parametrize("marker", [2, 5])
def test_one_misplaced_marker(seen: Motion, marker: int) -> None:
    faults = Faults(marker_offset_marker=marker, marker_offset_along=-0.01, marker_offset_across=0.002)
    shown = shown_markers(seen, STAMPS, MARKERS, faults)
    truth = seen.at(STAMPS).positions([*MARKERS, MARKERS[marker - 1] - 0.01, MARKERS[marker - 1] - 0.01001])
    others = [k for k in range(5) if k != marker - 1]
    np.testing.assert_allclose(shown[:, others], truth[:, others], atol=1e-15)
    tangent = (truth[:, 5] - truth[:, 6]) / 1e-5
    expected = truth[:, 5] + 0.002 * np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    np.testing.assert_allclose(shown[:, marker - 1], expected, atol=1e-7)
    beyond = shown_markers(seen, STAMPS, MARKERS, replace(faults, marker_offset_along=0.01, marker_offset_across=0.0))
    here = seen.at(STAMPS).positions(MARKERS)[:, marker - 1]
    assert np.linalg.norm(beyond[:, marker - 1] - here, axis=-1) == pytest.approx(0.01, rel=1e-4)


def test_a_ruler_that_began_elsewhere_displaces_all_markers(seen: Motion) -> None:
    one = Faults(marker_datum_along=-0.01, marker_datum_across=0.002)
    shown = shown_markers(seen, STAMPS, MARKERS, one)
    for marker in range(5):
        alone = Faults(marker_offset_marker=marker + 1, marker_offset_along=-0.01, marker_offset_across=0.002)
        expected = shown_markers(seen, STAMPS, MARKERS, alone)[:, marker]
        np.testing.assert_allclose(shown[:, marker], expected, atol=1e-15)


def test_null_values_are_those_of_no_effect() -> None:
    assert Physics() == Physics(**{each.name: each.default for each in fields(Physics)})  # type: ignore[arg-type]
    assert Faults().margin(5.0, 1.0) == 0.0
