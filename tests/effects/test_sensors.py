"""What cameras and encoders show, and which torques they were."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from tests.effects.setups import FORE, LINK, POST, RIG, recording_of
from vjm.effects import (
    CameraRotation,
    CameraScale,
    CameraTranslation,
    ClockScale,
    EncoderOffset,
    LensDistortion,
    MarkerOffset,
    RollingShutter,
    TimeOffset,
    TorqueGain,
    TorqueOffset,
)
from vjm.errors import ShapeError
from vjm.records import Array, Rig

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


def test_a_camera_scales_turns_and_distorts_about_the_base() -> None:
    radius = np.linalg.norm(POSITIONS, axis=-1)
    scaled = CameraScale(scale=1.02).marker_positions(POSITIONS, HEADINGS)
    assert scaled == pytest.approx(1.02 * POSITIONS)
    turned = CameraRotation(angle=0.3).marker_positions(POSITIONS, HEADINGS)
    assert np.linalg.norm(turned, axis=-1) == pytest.approx(radius)
    assert np.exp(0.3j) * (POSITIONS @ [1, 1j]) == pytest.approx(turned @ [1, 1j])
    bent = LensDistortion(k1=-0.02).marker_positions(POSITIONS, HEADINGS)
    assert np.linalg.norm(bent, axis=-1) == pytest.approx(radius * (1 - 0.02 * radius**2))


def test_a_shifted_camera_shifts_all_markers_alike_whichever_way_they_point() -> None:
    shown = CameraTranslation(dx=0.003, dy=-0.02).marker_positions(POSITIONS, HEADINGS)
    assert shown - POSITIONS == pytest.approx(np.broadcast_to([0.003, -0.02], POSITIONS.shape))
    alone = CameraTranslation().at(np.array([1.0, 0.0]))
    assert (alone.dx, alone.dy) == (0.005, 0.0)


def test_one_marker_is_displaced_along_tangent_and_normal() -> None:
    recording = recording_of(RIG)
    variants = MarkerOffset().variants(RIG, [recording])
    assert [(each.link, each.marker, each.column) for each in variants] == [
        (0, 1, 0),
        (1, 1, 1),
        (1, 2, 2),
        (1, 3, 3),
        (2, 1, 4),
        (2, 2, 5),
    ]
    for each in variants:
        displaced = each.at(np.array([2.0, -1.0])).marker_positions(POSITIONS, HEADINGS) - POSITIONS
        own = each.column
        assert not np.delete(displaced, own, axis=1).any()
        expected = (2 - 1j) * 0.005 * RIG.links[each.link].length * np.exp(1j * HEADINGS[:, own])
        assert displaced[:, own] @ [1, 1j] == pytest.approx(expected)


def test_a_marker_of_a_later_link_needs_its_rig() -> None:
    assert MarkerOffset(marker=2, along=0.1).column == 1
    with pytest.raises(ShapeError, match="variants"):
        _ = MarkerOffset(marker=2, along=0.1, link=1).column


def test_torques_and_encoders_are_those_of_the_joint_whatever_is_clamped_before_it() -> None:
    recording = recording_of(RIG)
    for effect in (TorqueGain(), TorqueOffset(), EncoderOffset()):
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
