"""Models with effects in model.json, as URDF, and in reference recordings."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.model.chains import write_model
from tests.model.urdf_contents import robot_from
from tests.report.diagnoses import FRICTION, PAYLOAD, hub_experiment
from tests.report.fits import _chain, two_link_experiment
from vjm.effects import BUILTIN, Effect, GearElasticity, MarkerOffset, TipPayload, TorqueGain, magnitude
from vjm.errors import ModelFileError
from vjm.records import Experiment
from vjm.report.model_json import load_model, read_model
from vjm.simulation.model import Model


def present(experiment: Experiment) -> tuple[Effect, ...]:
    """Every built-in effect at the last of its places, at less than an everyday size."""
    found = []
    for effect in BUILTIN:
        variant = effect.variants(experiment.rig, experiment.recordings)[-1]
        at = variant.coordinates
        found.append(variant.at(at + 0.3 * (np.arange(at.size) < variant.magnitude_count)))
    return tuple(found)


elbow = cache(two_link_experiment)
PAYLOAD_OF_TWO = TipPayload(link=1, mass=0.1)


def two_links(effects: tuple[Effect, ...]) -> tuple[Experiment, Model]:
    experiment = elbow()
    return experiment, Model(_chain(experiment.rig, 3, 1.0, 1e-3), experiment.rig, 3e-4, 1e-4, (), effects)


def written(model: Model, file: Path) -> dict[str, Any]:
    write_model(model, file)
    content: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return content


def test_every_effect_comes_back_exactly(tmp_path: Path) -> None:
    experiment, _ = two_links(())
    effects = (*present(experiment), GearElasticity(link=0))  # the last one absent: its stiffness is infinite
    _, model = two_links(effects)
    content = written(model, tmp_path / "model.json")
    assert [each["effect"] for each in content["effects"]] == [each.id for each in effects]
    assert {each["link"] for each in content["effects"]} == {None, "upper", "fore"}
    assert content["effects"][-1]["parameters"] == {"stiffness": None, "motor_share": 0.5, "damping": 0.0}
    assert read_model(tmp_path / "model.json", experiment)[0].effects == effects
    assert load_model(tmp_path / "model.json").effects == effects


def test_effects_of_reference_recordings_come_first(tmp_path: Path) -> None:
    _, model = two_links((PAYLOAD_OF_TWO, TorqueGain(link=1, gain=1.1, column=1)))
    content = written(replace(model, reference_effects=1), tmp_path / "model.json")
    assert [each["in_reference"] for each in content["effects"]] == [True, False]
    content["effects"].reverse()
    (tmp_path / "model.json").write_text(json.dumps(content), encoding="utf-8")
    back = load_model(tmp_path / "model.json")
    assert (back.effects, back.reference_effects) == (model.effects, 1)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"effect": "gremlin"}, r"key 'effects\[0\]\.effect': got 'gremlin'; expected one of tip_payload"),
        ({"link": "tail"}, r"effects\[0\]\.link': got 'tail'; expected null or one of \['upper', 'fore'\]"),
        ({"link": "upper"}, r"key 'effects\[0\]\.link': got 'upper'; expected one of \['fore'\]"),
        (
            {"parameters": {"mass": 0.1, "radius_of_gyration": 0.0, "offset": 0.0, "colour": 1.0}},
            r"key 'effects\[0\]\.parameters\.colour': unknown key",
        ),
        ({"parameters": {}}, r"key 'effects\[0\]\.parameters\.mass': missing"),
        ({"parameters": {"mass": -0.1}}, r"key 'effects\[0\]\.parameters\.mass': got -0\.1; expected 0 to inf kg"),
        ({"parameters": {"mass": None}}, r"key 'effects\[0\]\.parameters\.mass': got null"),
        ({"parameters": {"mass": "much"}}, r"key 'effects\[0\]\.parameters\.mass': got 'much'"),
        ({"more": 1}, r"key 'effects\[0\]\.more': unknown key"),
    ],
)
def test_faults_name_the_key(tmp_path: Path, change: dict[str, Any], fault: str) -> None:
    experiment, model = two_links((TipPayload(link=1, mass=0.1),))
    content = written(model, tmp_path / "model.json")
    content["effects"][0] |= change
    (tmp_path / "model.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ModelFileError, match=fault):
        read_model(tmp_path / "model.json", experiment)


@pytest.mark.parametrize(
    ("marker", "fault"), [(9.0, r"marker': got 9; expected one of \[1, 2, 3, 4\]"), (1.5, "whole")]
)
def test_a_marker_that_is_not_there_is_refused(tmp_path: Path, marker: float, fault: str) -> None:
    experiment, model = two_links((MarkerOffset(link=1, marker=4, along=1e-3, columns=(3, 4, 5, 6)),))
    content = written(model, tmp_path / "model.json")
    content["effects"][0]["parameters"]["marker"] = marker
    (tmp_path / "model.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ModelFileError, match=fault):
        read_model(tmp_path / "model.json", experiment)


@dataclass(frozen=True)
class Own(Effect):
    """A user's own effect."""

    twist: float = magnitude("rad", 0.1)

    id = "own"
    description = "a twist"


def test_a_users_own_effect_comes_back_where_it_is_given(tmp_path: Path) -> None:
    experiment, model = two_links((Own(twist=0.2), TorqueGain(link=1, gain=1.1, column=1)))
    written(model, tmp_path / "model.json")
    with pytest.raises(ModelFileError, match="got 'own'"):
        read_model(tmp_path / "model.json", experiment)
    found = read_model(tmp_path / "model.json", experiment, (*BUILTIN, Own()))[0]
    assert found.effects == model.effects


def test_a_value_at_its_bound_but_for_rounding_is_read(tmp_path: Path) -> None:
    experiment, model = two_links((TipPayload(link=1, mass=-1e-18),))
    content = written(model, tmp_path / "model.json")
    content["effects"] = [
        {
            "effect": "structural_damping",
            "link": "upper",
            "parameters": {"loss_factor": 0.30000000000000004, "dispersion": 1.0, "longest_time_constant": 60.0},
            "in_reference": False,
        }
    ]
    (tmp_path / "model.json").write_text(json.dumps(content), encoding="utf-8")
    assert read_model(tmp_path / "model.json", experiment)[0].effects[0].values["loss_factor"] > 0.3


def test_urdf_has_payload_and_friction(tmp_path: Path) -> None:
    _, base = hub_experiment(())
    model = replace(base, effects=(PAYLOAD, FRICTION))
    file = model.to_urdf(tmp_path / "arm.urdf")
    robot = robot_from(file)
    assert robot.link_map["beam_payload"].inertial.mass == PAYLOAD.mass
    assert float(robot.joint_map["beam_joint"].dynamics.friction) == FRICTION.torque


def test_no_effect_is_present_in_reference_recordings() -> None:
    experiment, base = hub_experiment((PAYLOAD,))
    with_it = replace(base, effects=(PAYLOAD,))
    first = experiment.recordings[0]
    reference = replace(first, condition="reference")
    plain = base.replay(first).simulation.markers
    assert np.array_equal(with_it.replay(reference).simulation.markers, plain)
    one, other = with_it.replay(first), with_it.replay(reference)
    assert not np.array_equal(one.simulation.markers, plain)
    assert np.allclose(other.simulation.markers, plain, atol=1e-4)
    assert one.marker_rms < other.marker_rms
