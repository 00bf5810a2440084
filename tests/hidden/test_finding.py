"""Effects are hidden in recordings of a continuous beam, and have to be found from the files alone."""

from __future__ import annotations

from pathlib import Path

import pytest

import vjm
from tests.hidden.conftest import Plant
from tests.hidden.rigs import Conditions, Truth
from vjm.effects import BUILTIN


def diagnosed(file: Path, effects: list[str] | None = None, max_effects: int = 3) -> vjm.Diagnosis:
    return vjm.diagnose(vjm.load_experiment(file), effects=effects, max_effects=max_effects)


def classes(diagnosis: vjm.Diagnosis) -> list[set[str]]:
    """What each cause may be."""
    return [{cause.effect.id, *(rival.effect.id for rival in cause.rivals)} for cause in diagnosis.causes]


def assert_found(diagnosis: vjm.Diagnosis, truth: Truth) -> None:
    """The causes are those hidden, of their sizes, and explain what was held out."""
    assert {each.effect for each in truth.effects} == {cause.effect.id for cause in diagnosis.causes}
    for hidden in truth.effects:
        cause = next(cause for cause in diagnosis.causes if cause.effect.id == hidden.effect)
        for name, value in hidden.parameters.items():
            found = cause.parameters[name]
            assert found.value == pytest.approx(value, abs=4 * (found.std or 0.0) + 0.02 * abs(value) + 1e-9)
    assert diagnosis.gain is not None
    noise = [truth.right_rms[each.recording.file] for each in diagnosis.recordings if each.recording.role == "holdout"]
    assert diagnosis.gain.after < 1.03 * max(noise)
    assert diagnosis.gain.interval[0] < diagnosis.gain.reduction < diagnosis.gain.interval[1]


def test_a_late_camera_is_found_in_coloured_noise(plant: Plant) -> None:
    file, truth = plant("hub", "time_offset", seed=11, conditions=Conditions(noise_correlation=0.7))
    diagnosis = diagnosed(file)
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)


def test_two_causes_are_found(plant: Plant) -> None:
    file, truth = plant("hub", "torque_gain", "marker_offset", seed=12)
    diagnosis = diagnosed(file)
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)


def test_gravity_without_which_nothing_is_followed_is_found(plant: Plant) -> None:
    """Without it the model misses by a thousand times the noise. Two processes find what one does."""
    file, truth = plant("hub", "in_plane_gravity", seed=7)
    some = ["tip_payload", "in_plane_gravity", "viscous_friction", "torque_offset", "time_offset", "stiffness_drift"]
    experiment = vjm.load_experiment(file)
    one, two = (vjm.diagnose(experiment, some, max_effects=1, jobs=jobs) for jobs in (1, 2))
    assert_found(one, truth)
    assert two.causes == one.causes
    assert one.candidates[0].effect.id == "in_plane_gravity"  # the most needed at first sight


def test_what_cannot_be_told_apart_is_a_set(plant: Plant) -> None:
    """Without gravity a turned camera and an encoder's offset are the same."""
    file, _ = plant("hub", "camera_rotation", seed=13)
    sensors = [effect.id for effect in BUILTIN if effect.sensor]
    diagnosis = diagnosed(file, sensors)
    assert diagnosis.verdict == "set"
    assert classes(diagnosis) == [{"camera_rotation", "encoder_offset"}]
    assert diagnosis.next_experiment


def test_nothing_is_found_where_nothing_is(plant: Plant) -> None:
    file, truth = plant("hub", seed=14, conditions=Conditions(outliers=0.005, dropped_frames=0.1))
    diagnosis = diagnosed(file)
    assert diagnosis.verdict == "none"
    assert diagnosis.causes == ()
    assert truth.effects == ()
    assert all(each.smallest_detectable for each in diagnosis.candidates if each.testable)


def test_a_cause_that_is_not_in_the_list_is_not_named(plant: Plant) -> None:
    file, _ = plant("hub", "time_offset", seed=15)
    clocks = {"time_offset", "clock_scale", "rolling_shutter"}
    others = [effect.id for effect in BUILTIN if effect.id not in clocks and not effect.abrupt]
    diagnosis = diagnosed(file, others, max_effects=1)
    assert diagnosis.verdict == "unknown"
    assert diagnosis.remaining.description
    assert diagnosis.remaining.p_value is not None
    assert diagnosis.remaining.p_value < 1e-3


def test_drag_is_found_in_decays_of_a_clamped_link(plant: Plant) -> None:
    file, _ = plant("clamped", "quadratic_drag", seed=16)
    diagnosis = diagnosed(file)
    assert diagnosis.verdict in ("named", "set")
    (found,) = classes(diagnosis)
    assert "quadratic_drag" in found
    assert len(found) <= 3
