"""Experiments with something hidden: what their files say, what they do not say, and that they come back."""

from __future__ import annotations

import csv
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import vjm
from tests.hidden import rigs
from tests.hidden.conftest import Plant
from tests.hidden.rigs import Conditions, perform, write_hidden
from tests.hidden.settings import CAMERA, Rig, Units, setting_of
from tests.hidden.severities import (
    EFFECTS,
    ONLY_WITH_HUB,
    POWERS,
    SIZES,
    VECTORS,
    Planted,
    draw,
    effects_of,
    of_size,
    twins,
)
from tests.hidden.visibility import sigmas
from tests.scaling import scaled
from vjm.effects import BUILTIN

Array = NDArray[np.float64]


def columns(path: Path) -> dict[str, Array]:
    """Columns of a CSV; an empty cell is NaN."""
    with path.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    return dict(zip(header, np.array([[float(cell or "nan") for cell in row] for row in rows]).T, strict=True))


@pytest.mark.parametrize("rig", ["hub", "clamped"])
def test_clean_experiment_loads_without_a_word(plant: Plant, rig: Rig) -> None:
    file, truth = plant(rig)
    experiment = vjm.load_experiment(file)
    assert list(experiment.warnings) == []
    assert [recording.file for recording in experiment.recordings] == list(truth.noise_rms)
    assert {recording.role for recording in experiment.recordings} == {"train", "holdout"}
    assert truth.effects == ()


@pytest.mark.slow
def test_the_files_do_not_tell_the_truth(plant: Plant) -> None:
    file, truth = plant("hub", "tip_payload", "coulomb_friction")
    tables = tomllib.loads(file.read_text())
    (link,) = tables["link"]
    assert "payload" not in link
    assert [entry.get("payload") for entry in tables["recording"]] == [None] * 5 + [0.05] + [None] * 2
    assert link["bending_stiffness"] != pytest.approx(truth.setting.beam.bending_stiffness, rel=1e-6)
    assert sorted(path.name for path in file.parent.iterdir()) == sorted([*truth.noise_rms, "experiment.toml"])
    words = "".join(path.read_text() for path in file.parent.iterdir() if path.suffix == ".toml")
    assert not any(effect in words for effect in EFFECTS)
    assert [each.effect for each in truth.effects] == ["tip_payload", "coulomb_friction"]


@pytest.mark.slow
def test_the_same_seed_writes_the_same_bytes(plant: Plant) -> None:
    first = {path.name: path.read_bytes() for path in plant("clamped", "linear_drag", seed=4)[0].parent.iterdir()}
    again = {path.name: path.read_bytes() for path in plant("clamped", "linear_drag", seed=4)[0].parent.iterdir()}
    other = {path.name: path.read_bytes() for path in plant("clamped", "linear_drag", seed=5)[0].parent.iterdir()}
    assert first == again
    assert all(first[name] != other[name] for name in first)


def test_noise_is_what_a_perfect_model_leaves(plant: Plant) -> None:
    _, truth = plant("clamped", "cubic_stiffness")
    np.testing.assert_allclose(list(truth.noise_rms.values()), CAMERA.noise, rtol=0.03)
    _, spoilt = plant("clamped", conditions=Conditions(0.8, 0.005, 0.1))
    np.testing.assert_allclose(list(spoilt.right_rms.values()), CAMERA.noise, rtol=0.2)
    assert min(spoilt.noise_rms.values()) > 2.0 * CAMERA.noise


def test_dropped_frames_are_missing(plant: Plant) -> None:
    file, _ = plant("clamped", conditions=Conditions(dropped_frames=0.1))
    assert len(columns(file.parent / "quiet.csv")["t"]) == pytest.approx(0.9 * 501, rel=0.05)


@pytest.mark.slow
def test_reference_recordings_hide_nothing() -> None:
    effects = (Planted("torque_gain", {"gain": 1.2}), Planted("camera_scale", {"scale": 1.05}))
    hidden, clean = perform("hub", effects, 1, reference=True), perform("hub", (), 1, reference=True)
    for one, other in zip(hidden, clean, strict=True):
        if one.plan.entry.condition == "reference":
            np.testing.assert_array_equal(one.markers, other.markers)
        else:
            assert np.abs(one.markers - other.markers).max() > 0.01
    assert sum(one.plan.entry.condition == "reference" for one in hidden) == 2


@pytest.mark.slow
def test_recorded_torque_is_not_the_true_one() -> None:
    effects = (Planted("torque_gain", {"gain": 1.25}), Planted("torque_offset", {"offset": 0.01}))
    both = {each.plan.entry.file: each for each in perform("hub", effects, 1)}
    gain = {each.plan.entry.file: each for each in perform("hub", effects[:1], 1)}
    clean = {each.plan.entry.file: each for each in perform("hub", (), 1)}
    early = slice(40, 61)  # around 0.1 s: the arm has hardly moved, and answers in proportion
    for file in ("chirp.csv", "drive_large.csv"):
        np.testing.assert_array_equal(both[file].torque, clean[file].torque)
        np.testing.assert_allclose(gain[file].angle[early] / clean[file].angle[early], 1.25, rtol=1e-3)
        assert np.all(both[file].angle[early] > gain[file].angle[early] + 1e-4)
    # In the quiet recording the drive makes up for the offset.
    np.testing.assert_allclose(both["quiet.csv"].torque, -0.01 / 1.25, rtol=1e-9)
    assert np.ptp(both["quiet.csv"].angle) < 1e-9


@pytest.mark.parametrize("rig", ["hub", "clamped"])
def test_repeats_are_one_motion_and_quiet_recordings_are_quiet(rig: Rig) -> None:
    shown = {each.plan.entry.file: each for each in perform(rig, [draw("in_plane_gravity", 1)], 1)}
    assert np.ptp(shown["quiet.csv"].markers, axis=0).max() < 1e-9
    if rig == "hub":
        np.testing.assert_array_equal(shown["drive_small_1.csv"].markers, shown["drive_small_2.csv"].markers)


@pytest.mark.parametrize(("rig", "seed"), [("arm", 1), ("clamped_arm", 2)])
def test_an_arm_of_any_size_is_written_in_its_own_units(
    rig: Rig, seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same as a metre's arm, scaled by what knows nothing of how arms are written."""
    effect = draw("tip_payload", seed, rig)
    truth = write_hidden(tmp_path / "own", rig, [effect], seed)
    units = truth.setting.units
    monkeypatch.setattr(rigs, "setting_of", lambda *drawn: replace(setting_of(*drawn), units=Units()))
    plain = write_hidden(tmp_path / "metre", rig, [effect], seed)
    own, metre = (vjm.load_experiment(tmp_path / name / "experiment.toml") for name in ("own", "metre"))
    expected = scaled(metre, units.length, units.mass, units.time)
    (link,), (wanted,) = own.rig.links, expected.rig.links
    for name in ("length", "mass", "bending_stiffness", "hub_inertia", "markers"):
        np.testing.assert_allclose(getattr(link, name), getattr(wanted, name), rtol=1e-9)
    assert own.rig.marker_noise == pytest.approx(expected.rig.marker_noise)
    assert truth.effects[0].parameters["mass"] == pytest.approx(units.mass * plain.effects[0].parameters["mass"])
    for one, other in zip(own.recordings, expected.recordings, strict=True):
        assert one.payload == pytest.approx(other.payload)
        np.testing.assert_allclose(one.time, other.time, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(one.markers, other.markers, atol=2e-6 * units.length)
        np.testing.assert_allclose(one.tau, other.tau, rtol=1e-9, atol=1e-12)


def test_units_of_sizes_are_those_that_effects_declare() -> None:
    units = Units(2.0, 3.0, 5.0)
    for effect in BUILTIN:
        hidden = draw(effect.id, 1).parameters if effect.id in EFFECTS else {}
        for parameter in effect.parameters:
            if parameter.name in hidden and not parameter.integer:
                mine = units.of(*POWERS.get((effect.id, parameter.name), (0, 0, 0)))
                assert mine == pytest.approx(in_units(parameter.unit, units)), (effect.id, parameter.name)


def in_units(text: str, units: Units) -> float:
    """What a number of a unit is multiplied by, as the unit itself is read."""
    base = {"m": units.length, "kg": units.mass, "s": units.time, "N": units.of(1, 1, -2), "Hz": 1 / units.time}
    over, _, under = text.replace("(", "").replace(")", "").partition("/")
    product = 1.0
    for part, sign in ((over, 1), (under, -1)):
        for word in part.split():
            name, _, power = word.partition("^")
            product *= base.get(name, 1.0) ** (sign * int(power or 1))
    return product


def test_every_effect_has_an_everyday_size() -> None:
    assert len(EFFECTS) == len(set(EFFECTS)) == 43
    for effect in EFFECTS:
        drawn = [draw(effect, seed) for seed in range(20)]
        assert len({tuple(each.parameters.values()) for each in drawn}) == 20
        for name, size in SIZES.get(effect, {}).items():
            values = np.array([each.parameters[name] for each in drawn])
            shares = (
                size.typical_magnitude / values if size.reciprocal else (values - size.null) / size.typical_magnitude
            )
            assert np.all((np.abs(shares) >= 0.699) & (np.abs(shares) <= 1.401))
            assert bool(shares.min() < 0.0) is size.signed
    for effect, (names, typical) in VECTORS.items():
        drawn = [draw(effect, seed) for seed in range(20)]
        assert {tuple(each.parameters)[:2] for each in drawn} == {names}
        lengths = [np.hypot.reduce([each.parameters[name] for name in names]) for each in drawn]
        assert 0.7 * typical < min(lengths) < max(lengths) < 1.4 * typical


def test_sizes_in_multiples_of_the_smallest_that_is_seen() -> None:
    assert of_size("coulomb_friction", 1, {"torque": 1e-4}, 5.0).parameters["torque"] == pytest.approx(5e-4)
    assert of_size("gear_elasticity", 1, {"stiffness": 5e4}, 20.0).parameters["stiffness"] == pytest.approx(2500.0)
    assert abs(of_size("torque_gain", 1, {"gain": 1e-3}, 2.0).parameters["gain"] - 1.0) == pytest.approx(2e-3)
    tone = of_size("external_tone", 1, {"amplitude": 1e-3}, 2.0).parameters
    assert tone["amplitude"] == pytest.approx(2e-3)
    assert tone["frequency"] == draw("external_tone", 1).parameters["frequency"]
    tilt = of_size("in_plane_gravity", 1, {"gx": 1e-3, "gy": 2e-3}, 5.0).parameters
    assert np.hypot(tilt["gx"] / 1e-3, tilt["gy"] / 2e-3) == pytest.approx(5.0)
    with pytest.raises(ValueError, match="no smallest"):
        of_size("backlash", 1, {}, 5.0)


def test_twins_are_known_on_their_rig() -> None:
    assert twins("hub", "tip_payload") == {"tip_payload"}
    assert twins("clamped", "tip_payload") == {"tip_payload", "clamp_compliance"}
    assert "rest_curvature" in twins("hub", "camera_rotation")
    assert not set(effects_of("clamped")) & set(ONLY_WITH_HUB)


@pytest.mark.slow
def test_everyday_effects_are_seen() -> None:
    clean = perform("clamped", (), 2)
    for effect in ("tip_payload", "linear_drag", "marker_offset", "external_tone"):
        assert sigmas(perform("clamped", [draw(effect, 2, "clamped")], 2), clean) > 50.0
    assert setting_of("clamped", 2).beam.joint == "clamped"
