"""Effects are hidden in recordings of a continuous beam, and have to be found from the files alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import vjm
from tests.diagnosis.rigs import first_seconds
from tests.hidden.conftest import Plant
from tests.hidden.rigs import PLAIN, Conditions, Truth, write_hidden
from tests.hidden.severities import Planted, draw
from vjm.effects import BUILTIN

HUB_RIG = Path(__file__).parents[3] / "shared" / "data" / "hub_rig" / "experiment.toml"
# Of every kind, each with one that looks like it: a search among them takes half as long as among all.
SOME = [
    "tip_payload",
    "viscous_friction",
    "torque_gain",
    "torque_offset",
    "linear_drag",
    "stiffness_drift",
    "time_offset",
    "camera_scale",
    "marker_offset",
]


UNLIMITED = float("inf")  # s: what is found must not depend on how fast the computer is
FEW = ("drive_small_1.csv", "drive_large.csv")  # training recordings of the hub rig that are enough for much


def diagnosed(file: Path, effects: Sequence[str] | None = None) -> vjm.Diagnosis:
    return vjm.diagnose(vjm.load_experiment(file), effects=effects, budget=UNLIMITED)


def with_few(file: Path) -> vjm.Experiment:
    """The experiment without most of its training recordings, which takes less than half as long."""
    experiment = vjm.load_experiment(file)
    kept = tuple(each for each in experiment.recordings if each.role == "holdout" or each.file in FEW)
    return replace(experiment, recordings=kept)


def beginnings(file: Path) -> vjm.Experiment:
    """The first three seconds of few recordings: large effects show in them as well."""
    experiment = with_few(file)
    return replace(experiment, recordings=tuple(first_seconds(each, 3.0) for each in experiment.recordings))


def visible(planted: Planted) -> dict[str, float]:
    """Parameters that the effect has in vjm as well, without the height of a tilted camera, which no picture shows."""
    (own,) = (effect.values.keys() - {"height"} for effect in BUILTIN if effect.id == planted.effect)
    return {name: value for name, value in planted.parameters.items() if name in own}


def assert_sizes(diagnosis: vjm.Diagnosis, truth: Truth) -> None:
    """Every parameter of each cause is within three standard errors."""
    sizes = {cause.effect.id: cause.parameters for cause in diagnosis.causes}
    for planted in truth.effects:
        for name, value in visible(planted).items():
            size = sizes[planted.effect][name]
            assert size.std is not None
            assert abs(size.value - value) < 3 * size.std, name


def classes(diagnosis: vjm.Diagnosis) -> list[set[str]]:
    """What each cause may be."""
    return [
        {cause.effect.id, *(alternative.effect.id for alternative in cause.alternatives)} for cause in diagnosis.causes
    ]


def assert_found(diagnosis: vjm.Diagnosis, truth: Truth) -> None:
    """The causes are those hidden, of their sizes, and explain what was held out."""
    assert {each.effect for each in truth.effects} == {cause.effect.id for cause in diagnosis.causes}
    for hidden in truth.effects:
        cause = next(cause for cause in diagnosis.causes if cause.effect.id == hidden.effect)
        for name, value in visible(hidden).items():
            found = cause.parameters[name]
            assert found.value == pytest.approx(value, abs=4 * (found.std or 0.0) + 0.02 * abs(value) + 1e-9)
    assert diagnosis.gain is not None
    noise = [truth.right_rms[each.recording.file] for each in diagnosis.recordings if each.recording.role == "holdout"]
    assert diagnosis.gain.after < 1.03 * max(noise)
    assert diagnosis.gain.interval[0] < diagnosis.gain.reduction < diagnosis.gain.interval[1]


@pytest.mark.slow
def test_a_late_camera_is_found_in_coloured_noise(plant: Plant) -> None:
    file, truth = plant("hub", "time_offset", seed=11, conditions=Conditions(noise_correlation=0.7))
    diagnosis = diagnosed(file, SOME)
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)


def test_two_causes_are_found(plant: Plant) -> None:
    file, truth = plant("hub", "torque_gain", "marker_offset", seed=12)
    diagnosis = vjm.diagnose(beginnings(file), effects=SOME, budget=UNLIMITED)
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)
    first, second = diagnosis.causes  # each with what is lost without it alone
    assert first.decrease > 1.2 * second.decrease
    assert diagnosis.gain is not None
    assert diagnosis.gain.next_best is not None  # what the next best would have gained
    assert diagnosis.gain.next_best > 1.03 * diagnosis.gain.after


@pytest.mark.slow
def test_dry_friction_is_found_beside_what_looks_like_it(plant: Plant) -> None:
    file, truth = plant("hub", "coulomb_friction", seed=17)
    diagnosis = vjm.diagnose(
        with_few(file), effects=["coulomb_friction", "viscous_friction", "torque_gain"], budget=UNLIMITED
    )
    assert diagnosis.verdict == "named"
    (cause,), (hidden,) = diagnosis.causes, truth.effects
    assert cause.effect.id == "coulomb_friction"
    torque = cause.parameters["torque"]
    assert torque.value == pytest.approx(hidden.parameters["torque"], rel=0.015)
    assert abs(torque.value - hidden.parameters["torque"]) < 2 * (torque.std or 0.0)
    assert diagnosis.gain is not None
    assert diagnosis.gain.reduction > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "damping"),
    [(1, 0.1), (2, 0.02), (2, 0.0), (3, 0.0), (3, 0.1)],
)
def test_a_gear_has_its_stiffness_and_its_damping(tmp_path: Path, seed: int, damping: float) -> None:
    drawn = draw("gear_elasticity", seed)
    truth = write_hidden(tmp_path, "hub", [replace(drawn, parameters={**drawn.parameters, "damping": damping})], seed)
    diagnosis = vjm.diagnose(beginnings(tmp_path / "experiment.toml"), effects=["gear_elasticity"], budget=UNLIMITED)
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)
    assert_sizes(diagnosis, truth)
    assert ("damping" in diagnosis.summary().partition("Held-out")[0]) == (damping > 0)


@pytest.mark.parametrize("seed", [921, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (922, 924))])
def test_a_hub_has_its_radius(tmp_path: Path, seed: int) -> None:
    """Which a shifted camera, one that shakes, and a clock look like."""
    truth = write_hidden(tmp_path, "hub", [draw("hub_radius", seed)], seed)
    others = ["camera_translation", "camera_vibration", "clock_scale", "camera_scale"]
    diagnosis = diagnosed(tmp_path / "experiment.toml", ["hub_radius", *others])
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)
    assert_sizes(diagnosis, truth)


@pytest.mark.parametrize(
    ("effect", "seed"),
    [
        ("lens_distortion", 921),
        *(pytest.param("encoder_eccentricity", seed, marks=pytest.mark.slow) for seed in (921, 922)),
        *(pytest.param("marker_datum", seed, marks=pytest.mark.slow) for seed in (921, 922, 923)),
        *(pytest.param("camera_tilt", seed, marks=pytest.mark.slow) for seed in (921, 922, 923)),
        *(pytest.param("lens_distortion", seed, marks=pytest.mark.slow) for seed in (922, 923)),
        *(pytest.param("rolling_shutter", seed, marks=pytest.mark.slow) for seed in (921, 922, 923)),
    ],
)
def test_sensors_are_set_up_in_any_way(tmp_path: Path, effect: str, seed: int) -> None:
    """A camera's axis meets the plane anywhere and obliquely, rows are read in any direction, rulers begin anywhere."""
    truth = write_hidden(tmp_path, "hub", [draw(effect, seed)], seed)
    cameras = ["camera_tilt", "lens_distortion", "rolling_shutter", "camera_scale", "camera_translation"]
    encoders = ["encoder_eccentricity", "encoder_offset"]
    diagnosis = diagnosed(
        tmp_path / "experiment.toml", [*cameras, "marker_datum", "marker_offset", "hub_radius", *encoders]
    )
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)
    assert_sizes(diagnosis, truth)


@pytest.mark.parametrize(
    ("effect", "seed"),
    [
        ("payload_body", 921),
        *(pytest.param("payload_body", seed, marks=pytest.mark.slow) for seed in (922, 924, 925)),
        *(pytest.param("tip_payload", seed, marks=pytest.mark.slow) for seed in (921, 922, 924)),
        *(pytest.param("marker_mass", seed, marks=pytest.mark.slow) for seed in (921, 922, 924)),
    ],
)
def test_bodies_on_the_link_have_their_masses_and_places(tmp_path: Path, effect: str, seed: int) -> None:
    """A chain whose end is free of moment, where a body bends it, has an error of first order in 1/n."""
    truth = write_hidden(tmp_path, "hub", [draw(effect, seed)], seed)
    diagnosis = diagnosed(tmp_path / "experiment.toml", [effect])
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)
    assert_sizes(diagnosis, truth)


@pytest.mark.slow
@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_a_clamp_has_its_compliance_and_its_damping(tmp_path: Path, damping: float) -> None:
    """Beside the link's own damping, which a small one looks like: between none and this the likelihood has a dip."""
    drawn = draw("clamp_compliance", 3, "clamped")
    hidden = replace(drawn, parameters={**drawn.parameters, "damping": damping})
    truth = write_hidden(tmp_path, "clamped", [hidden], 3)
    diagnosis = diagnosed(tmp_path / "experiment.toml", ["clamp_compliance"])
    assert diagnosis.verdict == "named"
    assert_found(diagnosis, truth)
    assert_sizes(diagnosis, truth)


@pytest.mark.slow
def test_play_is_found_beside_what_looks_like_it(plant: Plant) -> None:
    file, _ = plant("hub", "backlash", seed=18)
    diagnosis = vjm.diagnose(
        with_few(file), effects=["backlash", "gear_elasticity", "coulomb_friction"], budget=UNLIMITED
    )
    assert [cause.effect.id for cause in diagnosis.causes] == ["backlash"]


@pytest.mark.slow
def test_gravity_without_which_nothing_is_followed_is_found(plant: Plant) -> None:
    """Without it the model misses by a thousand times the noise."""
    file, truth = plant("hub", "in_plane_gravity", seed=7)
    diagnosis = vjm.diagnose(with_few(file), effects=["in_plane_gravity", *SOME], budget=UNLIMITED, max_effects=1)
    assert_found(diagnosis, truth)
    assert diagnosis.candidates[0].effect.id == "in_plane_gravity"  # the most needed at first sight


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hidden", "others"),
    [
        # Gravity alone leaves so much that the discretization error cannot be told: beside both, it is no cause.
        (("in_plane_gravity", "stiffness_drift"), ["cubic_stiffness"]),
        (("structural_damping", "viscoelastic_creep"), ["hysteresis"]),  # the first goes to zero on the way
        (("stribeck",), ["base_compliance"]),  # which stood in for the chain's discretization error
        (("backlash", "coulomb_friction"), []),  # without friction the flanks become rigid
    ],
    ids=lambda each: "+".join(each),
)
def test_causes_are_found_and_nothing_else(tmp_path: Path, hidden: tuple[str, ...], others: list[str]) -> None:
    write_hidden(tmp_path, "hub", [draw(effect, 905, "hub") for effect in hidden], 905)
    diagnosis = diagnosed(tmp_path / "experiment.toml", [*hidden, *others])
    assert diagnosis.verdict == "named"
    assert {cause.effect.id for cause in diagnosis.causes} == {*hidden}


@pytest.mark.slow
def test_what_cannot_be_told_apart_is_a_set(plant: Plant) -> None:
    """Without gravity a turned camera and an encoder's offset are the same."""
    file, _ = plant("hub", "camera_rotation", seed=13)
    sensors = [effect.id for effect in BUILTIN if effect.sensor]
    diagnosis = vjm.diagnose(beginnings(file), effects=sensors, budget=UNLIMITED)
    assert diagnosis.verdict == "set"
    assert classes(diagnosis) == [{"camera_rotation", "encoder_offset"}]
    assert diagnosis.next_experiment


def test_nothing_is_found_where_nothing_is(plant: Plant) -> None:
    file, truth = plant("hub", seed=14, conditions=Conditions(outliers=0.005, dropped_frames=0.1))
    diagnosis = vjm.diagnose(with_few(file), budget=UNLIMITED)
    assert diagnosis.verdict == "none"
    assert diagnosis.causes == ()
    assert truth.effects == ()
    assert all(each.smallest_detectable for each in diagnosis.candidates if each.testable)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [601, 602])
@pytest.mark.parametrize("effect", [None, "tip_payload"])
def test_what_a_coarse_encoder_makes_of_a_given_motion_is_noise(plant: Plant, effect: str | None, seed: int) -> None:
    """Half a milliradian; without the motion's errors, clean recordings leave what no candidate explains."""
    file, truth = plant("hub", *([effect] if effect else []), seed=seed)
    experiment, random = vjm.load_experiment(file), np.random.default_rng(seed)
    recordings = [
        replace(
            each,
            theta=each.theta + 5e-4 * random.standard_normal(each.theta.shape),
            input="motion" if each.kind == "driven" else each.input,
        )
        for each in experiment.recordings
    ]
    rig = replace(experiment.rig, encoder_noise=float(np.hypot(5e-4, experiment.rig.encoder_noise or 0.0)))
    diagnosis = vjm.diagnose(vjm.Experiment(rig, recordings), budget=UNLIMITED)
    assert diagnosis.remaining.p_value is not None
    assert diagnosis.remaining.p_value > 0.01
    assert [cause.effect.id for cause in diagnosis.causes] == [planted.effect for planted in truth.effects]
    for cause, planted in zip(diagnosis.causes, truth.effects, strict=True):
        mass = cause.parameters["mass"]
        assert abs(mass.value - planted.parameters["mass"]) < 3 * (mass.std or 0.0)


def test_a_cause_that_is_not_in_the_list_is_not_named(plant: Plant) -> None:
    file, _ = plant("hub", "time_offset", seed=15)
    others = [*(effect for effect in SOME if effect != "time_offset"), "actuator_lag"]
    diagnosis = vjm.diagnose(beginnings(file), effects=others, budget=UNLIMITED, max_effects=1)
    assert diagnosis.verdict == "unknown"
    assert diagnosis.remaining.description
    assert diagnosis.remaining.p_value is not None
    assert diagnosis.remaining.p_value < 1e-3


def test_a_search_ends_with_its_budget_and_says_what_it_left_untried(plant: Plant) -> None:
    file, _ = plant("hub", "time_offset", seed=15)
    diagnosis = vjm.diagnose(beginnings(file), effects=["time_offset", "camera_scale"], budget=1e-3)
    assert diagnosis.budget.exhausted
    assert "time_offset" in diagnosis.budget.not_tried
    assert (diagnosis.verdict, diagnosis.causes) == ("unknown", ())
    assert diagnosis.budget.spent > diagnosis.budget.seconds
    assert "not fully tried: time_offset" in " ".join(diagnosis.summary().split())


@pytest.mark.slow
def test_two_processes_find_what_one_does(plant: Plant) -> None:
    file, _ = plant("hub", "time_offset", seed=15)
    experiment = with_few(file)
    effects = ["time_offset", "torque_gain"]
    one, two = (vjm.diagnose(experiment, effects, max_effects=1, jobs=jobs, budget=UNLIMITED) for jobs in (1, 2))
    assert [cause.effect.id for cause in one.causes] == ["time_offset"]
    same = [{**each.to_dict(), "budget": None} for each in (one, two)]
    assert same[0] == same[1]


@pytest.mark.slow
def test_drag_is_found_in_decays_of_a_clamped_link(plant: Plant) -> None:
    file, _ = plant("clamped", "quadratic_drag", seed=16)
    diagnosis = diagnosed(file)
    assert diagnosis.verdict in ("named", "set")
    (found,) = classes(diagnosis)
    assert "quadratic_drag" in found
    assert len(found) <= 3


@pytest.mark.slow
@pytest.mark.skipif(not HUB_RIG.exists(), reason="the shared recordings are absent")
def test_what_no_digit_of_the_residual_shows_is_no_cause() -> None:
    """A link of another program's is tapered by 0.0007 to a model that is fitted to enough of it, however certainly."""
    experiment = vjm.load_experiment(HUB_RIG)
    seen = {"drive_small_1.csv": 3.0, "drive_small_2.csv": 1.5, "chirp.csv": 1.0}  # s
    recordings = []
    for recording in experiment.recordings:
        unseen = recording.time > seen.get(recording.file, np.inf)
        recordings.append(replace(recording, markers=np.where(unseen[:, None, None], np.nan, recording.markers)))
    effects = ["taper", "tip_payload", "torque_gain"]
    diagnosis = vjm.diagnose(replace(experiment, recordings=tuple(recordings)), effects, budget=UNLIMITED)
    assert (diagnosis.verdict, diagnosis.causes) == ("none", ())
    assert diagnosis.model is diagnosis.reference
    assert any(warning.startswith("Taper: certain, but too small to matter") for warning in diagnosis.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11133, 1])
def test_a_table_is_found_whatever_its_frequency(seed: int, tmp_path: Path) -> None:
    """The screen tries three; between them it promises a small part of what a fit gains, and less than others do."""
    factor = float(0.3 * 10.0 ** np.random.default_rng([seed, 7]).uniform())  # of the size, as in the benchmark's arms
    truth = write_hidden(tmp_path, "arm", [draw("base_compliance", seed, "arm", factor)], seed, PLAIN)
    others = ["in_plane_gravity", "cogging", "joint_spring", "torque_gain", "external_tone", "clamp_compliance"]
    assert_found(diagnosed(tmp_path / "experiment.toml", [*others, "base_compliance"]), truth)
