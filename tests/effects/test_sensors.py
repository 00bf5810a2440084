"""What cameras and encoders show, and which torques they were."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from tests.effects.setups import FORE, LINK, POST, RIG, recording_of
from tests.model.chains import extended_chain
from vjm.effects import (
    CameraRotation,
    CameraScale,
    CameraTilt,
    CameraTranslation,
    CameraVibration,
    ClockScale,
    EncoderEccentricity,
    EncoderOffset,
    LensDistortion,
    MarkerDatum,
    MarkerOffset,
    RollingShutter,
    TimeOffset,
    TimestampJitter,
    TorqueGain,
    TorqueOffset,
)
from vjm.errors import ShapeError
from vjm.records import Array, Rig
from vjm.simulation.arm import Arm

TIME = np.array([0.0, 0.1, 0.5])
RNG = np.random.default_rng(3)
POSITIONS: Array = RNG.normal(size=(3, 6, 2))
HEADINGS: Array = RNG.normal(size=(3, 6))


def test_a_camera_that_lags_shows_an_earlier_state() -> None:
    assert TimeOffset(delay=0.02).camera_instants(TIME, POSITIONS) == pytest.approx(TIME - 0.02)


def test_a_fast_clock_stamps_too_late() -> None:
    assert 1.01 * ClockScale(scale=1.01).camera_instants(TIME, POSITIONS) == pytest.approx(TIME)


def test_rows_are_read_one_after_another() -> None:
    found = RollingShutter(readout=0.01).camera_instants(TIME, POSITIONS)
    assert found == pytest.approx(TIME[:, None] - 0.01 * POSITIONS[:, :, 1])
    turned = RollingShutter(readout=0.01, direction=0.4).camera_instants(TIME, POSITIONS)
    assert turned == pytest.approx(TIME[:, None] - 0.01 * (np.exp(-0.4j) * (POSITIONS @ [1, 1j])).imag)


@given(st.floats(0.01, 0.4), st.sampled_from([1.0, -1.0]), st.floats(-1.57, 1.57))
def test_a_readout_comes_back_from_the_components_in_which_it_is_searched(
    size: float, side: float, direction: float
) -> None:
    shutter = RollingShutter(readout=side * size, direction=direction)
    assert shutter.at(shutter.coordinates).values == pytest.approx(shutter.values)
    assert shutter.at(-shutter.coordinates).readout == pytest.approx(-shutter.readout)
    assert shutter.at(np.zeros(2)).is_null
    assert shutter.magnitude_count == shutter.coordinates.size == 2


def test_a_camera_scales_turns_and_distorts_about_the_base() -> None:
    radius = np.linalg.norm(POSITIONS, axis=-1)
    scaled = CameraScale(scale=1.02).marker_positions(POSITIONS, HEADINGS, TIME)
    assert scaled == pytest.approx(1.02 * POSITIONS)
    turned = CameraRotation(angle=0.3).marker_positions(POSITIONS, HEADINGS, TIME)
    assert np.linalg.norm(turned, axis=-1) == pytest.approx(radius)
    assert np.exp(0.3j) * (POSITIONS @ [1, 1j]) == pytest.approx(turned @ [1, 1j])
    bent = LensDistortion(k1=-0.02).marker_positions(POSITIONS, HEADINGS, TIME)
    assert np.linalg.norm(bent, axis=-1) == pytest.approx(radius * (1 - 0.02 * radius**2))


@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_a_tilted_camera_sees_straight_lines_and_the_right_scale_at_its_centre(
    px: float, py: float, x: float, y: float
) -> None:
    camera = CameraTilt(px=px, py=py, centre_x=x, centre_y=y)
    line = np.array([x, y]) + np.multiply.outer(np.array([-1.0, -1e-6, 0.0, 1e-6, 2.0]), np.array([0.6, -0.8]))
    seen = camera.marker_positions(line[None], np.zeros((1, 5)), np.zeros(1))[0] @ [1, 1j]
    assert ((seen - seen[2]) / (0.6 - 0.8j)).imag == pytest.approx(0, abs=1e-12)
    assert abs(seen[3] - seen[1]) == pytest.approx(2e-6)
    # The way to where the plane recedes to infinity is halved where it is as far again.
    base = camera.marker_positions(np.zeros((1, 1, 2)), np.zeros((1, 1)), np.zeros(1))
    assert_array_equal(base, np.zeros((1, 1, 2)))
    if np.hypot(px, py) > 1e-3:
        away = np.array([px, py]) / (px * px + py * py)
        far = np.array([x, y]) + np.multiply.outer([0.0, 1.0], away)
        ends = camera.marker_positions(far[None], np.zeros((1, 2)), np.zeros(1))[0]
        assert ends[1] - ends[0] == pytest.approx(away / 2)


def test_a_lens_distorts_about_its_axis_and_leaves_the_base() -> None:
    lens = LensDistortion(k1=0.03, centre_x=0.4, centre_y=-0.2)
    seen = lens.marker_positions(POSITIONS, HEADINGS, TIME) @ [1, 1j]
    off = POSITIONS @ [1, 1j] - (0.4 - 0.2j)
    base = -(0.4 - 0.2j) * (1 + 0.03 * 0.2)
    assert seen == pytest.approx(off * (1 + 0.03 * np.abs(off) ** 2) - base)


@pytest.mark.parametrize("effect", [LensDistortion(), CameraTilt()])
def test_searches_start_from_centres_all_over_the_picture(effect: LensDistortion | CameraTilt) -> None:
    recording = recording_of(RIG)
    points = np.concatenate([np.zeros((1, 2)), recording.markers.reshape(-1, 2)])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    centres = [[each.centre_x, each.centre_y] for each in effect.variants(RIG, [recording])]
    assert len(centres) == 9
    assert np.unique(np.round((np.array(centres) - low) / (high - low), 9)).tolist() == [0.0, 0.5, 1.0]
    assert [(each.centre_x, each.centre_y) for each in effect.variants(RIG, [])] == [(0.0, 0.0)]


def test_a_shifted_camera_shifts_all_markers_alike_whichever_way_they_point() -> None:
    shown = CameraTranslation(dx=0.003, dy=-0.02).marker_positions(POSITIONS, HEADINGS, TIME)
    assert shown - POSITIONS == pytest.approx(np.broadcast_to([0.003, -0.02], POSITIONS.shape))
    alone = CameraTranslation().at(np.array([1.0, 0.0]))
    assert (alone.dx, alone.dy) == (0.005, 0.0)


def test_a_shaking_camera_carries_all_markers_round_an_ellipse() -> None:
    """The ellipse as the product of its axes' matrices, against the sum of two circles in which it is searched."""
    shaking = CameraVibration(amplitude=0.002, frequency=3.0, direction=0.4, phase=-2.5, ellipticity=-0.3)
    time = np.linspace(0.0, 0.4, 25)
    still = np.zeros((25, 4, 2))
    shift = shaking.marker_positions(still, still[..., 0], time)
    assert shift == pytest.approx(np.broadcast_to(shift[:, :1], shift.shape))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    angle = 6 * np.pi * time - 2.5
    own = np.stack([0.002 * np.sin(angle), 0.3 * 0.002 * np.cos(angle)])
    assert shift[:, 0] == pytest.approx((turn @ own).T, abs=1e-15)
    xc, yc, xs, ys, tone = shaking.coordinates
    assert tone == pytest.approx(np.log(3 / 2.5))
    waves = np.stack([np.cos(6 * np.pi * time), np.sin(6 * np.pi * time)])
    assert shift[:, 0] == pytest.approx(5e-4 * (np.array([[xc, xs], [yc, ys]]) @ waves).T, abs=1e-15)


@given(
    st.floats(0.1, 5.0), st.floats(-1.57, 1.57), st.floats(-3.14, 3.14), st.floats(-0.99, 0.99), st.floats(-1.0, 1.0)
)
def test_a_vibration_comes_back_from_the_amplitudes_in_which_it_is_searched(
    size: float, direction: float, phase: float, ellipticity: float, tone: float
) -> None:
    shaking = CameraVibration(5e-4 * size, float(2.5 * np.exp(tone)), direction, phase, ellipticity)
    again = shaking.at(shaking.coordinates)
    assert again.values == pytest.approx(shaking.values, rel=1e-6, abs=1e-6)
    assert shaking.at(0 * shaking.coordinates).is_null
    assert shaking.magnitude_count == 4
    opposite = shaking.at(np.r_[-shaking.coordinates[:4], tone])
    assert (opposite.amplitude, opposite.ellipticity) == pytest.approx((5e-4 * size, ellipticity))
    assert abs(opposite.phase - phase) == pytest.approx(np.pi)


def test_jitter_is_searched_by_its_variance_and_changes_no_prediction() -> None:
    jitter = TimestampJitter(jitter=0.012)
    assert jitter.coordinates == pytest.approx([9.0])
    assert jitter.at(np.array([0.25])).timing_noise == pytest.approx(0.002)
    assert jitter.at(np.zeros(1)).is_null
    assert jitter.sensor
    assert jitter.bounds[0] == [0.0]
    assert_array_equal(jitter.marker_positions(POSITIONS, HEADINGS, TIME), POSITIONS)
    assert_array_equal(jitter.camera_instants(TIME, POSITIONS), TIME)


def test_one_marker_is_displaced_along_tangent_and_normal() -> None:
    recording = recording_of(RIG)
    variants = MarkerOffset().variants(RIG, [recording])
    assert [(each.link, each.marker) for each in variants] == [(0, 1), (1, 1), (1, 2), (1, 3), (2, 1), (2, 2)]
    for own, each in enumerate(variants):
        displaced = each.at(np.array([2.0, -1.0])).marker_positions(POSITIONS, HEADINGS, TIME) - POSITIONS
        assert not np.delete(displaced, own, axis=1).any()
        expected = (2 - 1j) * 0.005 * RIG.links[each.link].length * np.exp(1j * HEADINGS[:, own])
        assert displaced[:, own] @ [1, 1j] == pytest.approx(expected)


def test_all_markers_of_a_link_are_displaced_alike() -> None:
    variants = MarkerDatum().variants(RIG, [recording_of(RIG)])
    assert [(each.link, each.columns) for each in variants] == [(1, (1, 2, 3)), (2, (4, 5))]
    for each in variants:
        alone = [marker for marker in MarkerOffset().variants(RIG, []) if marker.link == each.link]
        expected = POSITIONS
        for marker in alone:
            expected = marker.at(np.array([2.0, -1.0])).marker_positions(expected, HEADINGS, TIME)
        assert_array_equal(each.at(np.array([2.0, -1.0])).marker_positions(POSITIONS, HEADINGS, TIME), expected)
    everything = MarkerDatum(along=0.1, across=-0.2).marker_positions(POSITIONS, HEADINGS, TIME) - POSITIONS
    assert everything @ [1, 1j] == pytest.approx((0.1 - 0.2j) * np.exp(1j * HEADINGS))


@given(st.permutations(range(7)))
def test_what_a_camera_sees_does_not_depend_on_the_order_of_causes(order: list[int]) -> None:
    """An offset marker is turned with the rest of the picture, which the lens has bent and which is shifted last."""
    offset = MarkerOffset(link=1, marker=2, columns=(1, 2, 3), along=0.3, across=-0.1)
    scale, turn, shift = CameraScale(scale=1.2), CameraRotation(angle=0.4), CameraTranslation(dx=0.2, dy=-0.5)
    shake, lens = CameraVibration(amplitude=0.1, frequency=1.3, direction=0.5), LensDistortion(k1=0.05)
    tilt = CameraTilt(px=0.1, py=-0.05)
    effects = (shift, turn, shake, lens, offset, scale, tilt)
    arm = Arm.of(extended_chain(), [effects[k] for k in order])
    displaced = offset.marker_positions(POSITIONS, HEADINGS, TIME)
    moved = displaced @ [1, 1j] / (1 + displaced @ [0.1, -0.05])
    expected = 1.2 * np.exp(0.4j) * moved * (1 + 0.05 * np.abs(moved) ** 2) + 0.2 - 0.5j
    expected += 0.1 * (np.sin(2.6 * np.pi * TIME) * np.exp(0.5j))[:, None]
    assert arm.marker_positions(POSITIONS, HEADINGS, TIME) @ [1, 1j] == pytest.approx(expected)


def test_a_marker_of_a_later_link_needs_its_rig() -> None:
    expected = np.zeros(POSITIONS.shape)
    expected[:, 1] = 0.1 * np.stack([np.cos(HEADINGS[:, 1]), np.sin(HEADINGS[:, 1])], axis=-1)
    moved = MarkerOffset(marker=2, along=0.1).marker_positions(POSITIONS, HEADINGS, TIME)
    assert moved - POSITIONS == pytest.approx(expected, abs=1e-12)
    for effect in (MarkerOffset(marker=2, along=0.1, link=1), MarkerDatum(along=0.1, link=1)):
        with pytest.raises(ShapeError, match="variants"):
            effect.marker_positions(POSITIONS, HEADINGS, TIME)


@given(st.floats(0.0, 0.01), st.floats(-3.14, 3.14))
def test_an_eccentric_disc_is_read_by_a_head_that_stands_still(eccentricity: float, azimuth: float) -> None:
    """Closed form, of first order in the eccentricity, against the geometry of a disc whose centre goes round the axis.

    The head, at one from the axis, reads the direction in which it sees the centre, in the disc's own frame.
    """
    theta = np.linspace(-3.0, 3.0, 25)
    head = np.exp(0.3j)
    centre = eccentricity * np.exp(1j * (azimuth + theta))
    read = theta - np.unwrap(np.angle((head - centre) / head))
    phasor = eccentricity * np.exp(1j * (azimuth - 0.3))
    encoder = EncoderEccentricity(sine=phasor.real, cosine=phasor.imag)
    found = encoder.encoder_angles(theta[:, None])[:, 0]
    assert found == pytest.approx(read - read[12], abs=2 * eccentricity**2 + 1e-12)
    assert found[12] == 0.0


def test_torques_and_encoders_are_those_of_the_joint_whatever_is_clamped_before_it() -> None:
    recording = recording_of(RIG)
    for effect in (TorqueGain(), TorqueOffset(), EncoderOffset(), EncoderEccentricity()):
        assert [(each.link, each.column) for each in effect.variants(RIG, [])] == [(1, 0), (2, 1)]
    gain, offset, encoder = (
        effect.variants(RIG, [])[1].at(np.ones(1)) for effect in (TorqueGain(), TorqueOffset(), EncoderOffset())
    )
    multiplied, added = gain.true_inputs(recording), offset.true_inputs(recording)
    assert_array_equal(multiplied.tau[:, 0], recording.tau[:, 0])
    assert multiplied.tau[:, 1] == pytest.approx(1.05 * recording.tau[:, 1])
    assert added.tau - recording.tau == pytest.approx(np.tile([0.0, offset.offset], (12, 1)))
    assert_array_equal(added.theta, recording.theta)
    assert encoder.encoder_angles(recording.theta) - recording.theta == pytest.approx(np.tile([0.0, 0.005], (12, 1)))


def test_without_a_rig_the_joint_is_the_link_s() -> None:
    driven = recording_of(Rig("arm", (LINK, FORE)))
    found = TorqueGain(gain=2.0, link=1).true_inputs(driven).tau
    assert found == pytest.approx(driven.tau * [1.0, 2.0])
    alone = recording_of(Rig("arm", (LINK,)))
    assert TorqueGain(gain=2.0).true_inputs(alone).tau == pytest.approx(2 * alone.tau)
    assert recording_of(Rig("arm", (POST,))).tau.shape == (12, 0)
