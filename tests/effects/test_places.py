"""Where effects are sought, and where they cannot be seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.effects.setups import FORE, LINK, POST, RIG, recording_of
from vjm.effects import BUILTIN, CameraRotation, Cogging, ExternalTone, Hysteresis, ViscoelasticCreep
from vjm.records import Recording, Rig

CLAMPED, HUB = Rig("post", (POST,)), Rig("hub", (LINK,))
JOINT = {
    "hub_radius",
    "coulomb_friction",
    "viscous_friction",
    "joint_spring",
    "torque_gain",
    "torque_offset",
    "gear_elasticity",
    "backlash",
    "encoder_offset",
    "encoder_eccentricity",
    "actuator_lag",
    "torque_saturation",
    "cogging",
    "stribeck",
}
LINKS = {
    "clamp_compliance",
    "linear_drag",
    "quadratic_drag",
    "structural_damping",
    "viscoelastic_creep",
    "hysteresis",
    "cubic_stiffness",
    "stiffness_drift",
    "rest_curvature",
    "taper",
    "stiffness_asymmetry",
    "marker_offset",
    "marker_mass",
}
TIP = {"tip_payload", "payload_body", "external_tone"}


def test_each_is_sought_where_it_can_act() -> None:
    for effect in BUILTIN:
        wanted: tuple[int | None, ...] = (None,)
        wanted = (1, 2) if effect.id in JOINT else wanted
        wanted = (0, 1, 2) if effect.id in LINKS else wanted
        wanted = (2,) if effect.id in TIP else wanted
        wanted = (1, 2) if effect.id == "marker_datum" else wanted  # the links with several markers
        assert effect.places(RIG) == wanted, effect.id
        assert {each.link for each in effect.variants(RIG, [])} == set(wanted), effect.id


def test_inner_values_are_tried_in_turn() -> None:
    for effect, name, count in ((ViscoelasticCreep(), "time_constant", 5), (Hysteresis(), "yield_angle", 4)):
        values = [each.values[name] for each in effect.variants(HUB, [])]
        assert len(values) == count
        assert np.diff(np.log(values)) == pytest.approx(np.log(values[1] / values[0]), rel=0.05)


def test_tones_are_sought_down_to_one_period_of_the_longest_recording() -> None:
    slow = replace(recording_of(HUB), time=0.02 * np.arange(12))
    (tone,) = ExternalTone().variants(HUB, [recording_of(HUB), slow])
    assert tone.at(tone.bounds[0].clip(-1.0)).frequency == pytest.approx(1 / 0.22)


def test_cogging_is_sought_down_to_one_wave_in_the_largest_turn() -> None:
    turning = replace(recording_of(HUB), theta=np.linspace(0.2, 0.6, 12)[:, None])
    (wave,) = Cogging().variants(HUB, [turning, replace(turning, theta=0.5 * turning.theta)])
    assert wave.at(wave.bounds[0].clip(-9.0)).count == pytest.approx(2 * np.pi / 0.4)
    resting = replace(turning, theta=np.zeros((12, 1)))
    assert Cogging().variants(HUB, [resting])[0].bounds[0][2] == pytest.approx(np.log(1.0 / 24.0))


def without(recording: Recording, *names: str) -> Recording:
    return replace(recording, **{name: np.full_like(getattr(recording, name), np.nan) for name in names})


def blind_effects(rig: Rig, recording: Recording) -> dict[str, str]:
    found = {effect.id: effect.untestable(rig, [recording]) for effect in BUILTIN if effect.parameters}
    return {identifier: reason for identifier, reason in found.items() if reason}


def test_everything_shows_where_everything_is_measured() -> None:
    assert blind_effects(RIG, recording_of(RIG)) == {}
    assert blind_effects(HUB, recording_of(HUB)) == {}


def test_without_a_torque_there_is_none_that_is_wrong() -> None:
    recorded = {"torque_gain", "torque_offset", "actuator_lag", "torque_saturation"}
    assert set(blind_effects(HUB, without(recording_of(HUB), "tau"))) == recorded


def test_where_a_motion_is_given_nothing_shows_that_acts_on_its_drive_or_is_in_it() -> None:
    drives = JOINT - {"hub_radius", "encoder_offset", "gear_elasticity", "backlash"}
    given = replace(recording_of(HUB), input="motion")
    assert set(blind_effects(HUB, given)) == drives
    assert "given motion" in blind_effects(HUB, given)["encoder_eccentricity"]


def test_without_an_encoder_there_is_none_that_is_wrong() -> None:
    pulled = without(recording_of(HUB), "theta")
    assert set(blind_effects(HUB, pulled)) == {"encoder_offset", "encoder_eccentricity"}
    # In free space the arm may as well point elsewhere.
    floating = replace(pulled, gravity=(0.0, 0.0))
    assert set(blind_effects(HUB, floating)) == {"encoder_offset", "encoder_eccentricity", "camera_rotation"}


def test_a_camera_alone_has_no_clock_to_compare_with() -> None:
    found = blind_effects(HUB, without(recording_of(HUB), "theta", "tau"))
    assert {"time_offset", "clock_scale"} <= set(found)
    assert "clock" in found["time_offset"]
    assert set(blind_effects(CLAMPED, recording_of(CLAMPED))) == JOINT | {"time_offset", "clock_scale"}


def test_the_camera_s_own_faults_do_not_show_in_a_link_s_frame() -> None:
    turning = Rig("hub", (replace(LINK, markers_frame="link"),))
    assert set(blind_effects(turning, recording_of(turning))) == {
        "camera_rotation",
        "camera_tilt",
        "camera_translation",
        "camera_vibration",
        "lens_distortion",
        "rolling_shutter",
    }
    # A clamped link's frame is the base's; a link without markers has none to speak of.
    post = replace(POST, markers_frame="link")
    assert CameraRotation().untestable(Rig("post", (post,)), []) == ""
    bare = Rig("arm", (post, replace(FORE, markers_frame="link", markers=())))
    assert CameraRotation().untestable(bare, []) == ""
