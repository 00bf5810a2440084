"""A diagnosis as numbers, words, tables, pictures and files."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.model.urdf_contents import robot_from
from tests.report.diagnoses import (
    CLAMP,
    DIAGNOSES,
    FRICTION,
    insufficient,
    named,
    nothing,
    pair,
    pictures_of,
    undecided,
    unknown,
)
from tests.report.schema import DiagnoseResult
from tests.report.test_figures import assert_nothing_overlaps, assert_readable, figure_of, marks
from tests.report.test_page import HOSTILE, Elements, assert_self_contained
from vjm.diagnosis.records import Diagnosis, Remaining
from vjm.effects import BUILTIN, CameraScale, Effect, InPlaneGravity, LinearDrag, TimeOffset, TipPayload
from vjm.files import json_text
from vjm.records import Estimate
from vjm.report import output
from vjm.report.diagnosis import _alternative_points, _candidate_table, _cause_table, _untestable_points
from vjm.report.figures.diagnosis import _evidence, diagnosis_pictures
from vjm.report.figures.panels import Picture
from vjm.report.model_json import read_model
from vjm.report.output import result_page, save
from vjm.report.result_json import result_object
from vjm.report.text import clause, sizes_text
from vjm.text import in_sentence, number, quantity


@pytest.fixture(params=list(DIAGNOSES))
def diagnosis(request: pytest.FixtureRequest) -> Diagnosis:
    return DIAGNOSES[request.param]()


def plain(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ")


def test_result_has_the_keys_of_the_interface(diagnosis: Diagnosis) -> None:
    result = DiagnoseResult.model_validate_json(json_text(result_object(diagnosis)))
    assert result.verdict == diagnosis.verdict
    assert [each.effect for each in result.causes] == [each.effect.id for each in diagnosis.causes]
    assert len(result.candidates) == len(diagnosis.candidates)
    assert {each.link for each in result.candidates} <= {None, "beam"}
    assert (result.gain is None) == (diagnosis.gain is None)


def test_rivals_are_named() -> None:
    (cause,) = DiagnoseResult.model_validate_json(json_text(result_object(undecided()))).causes
    assert cause.indistinguishable_from == ["clamp_compliance"]
    assert cause.alternatives[0].parameters == {"compliance": CLAMP.compliance, "damping": 0.0}
    assert cause.parameters["mass"].value == 0.0133


def test_what_is_not_finite_becomes_null() -> None:
    found = undecided()
    cause = replace(found.causes[0], parameters={"mass": Estimate("mass", math.inf, math.nan, "kg")}, p_value=math.nan)
    assert found.gain is not None
    gain = replace(found.gain, reduction=math.nan, interval=(-math.inf, 0.1))
    text = json_text(result_object(replace(found, causes=(cause,), gain=gain)))
    result = DiagnoseResult.model_validate_json(text)
    assert result.causes[0].parameters["mass"].value is None
    assert result.gain is not None
    assert result.gain.ci95 == [None, 0.1]


@pytest.mark.parametrize(
    ("of", "grade", "words"),
    [
        (pair, "good", "2 causes found: camera frames are 12.00 ± 0.12 ms late; marker 3 of 'beam' is off by"),
        (
            undecided,
            "fair",
            "Cause found: unknown mass of 13.30 ± 0.13 g on the tip of 'beam', or the clamp of",
        ),
        (unknown, "poor", "Residual not explained by any candidate: most of it in the camera of"),
        (
            nothing,
            "good",
            "improves the model. Detection limits: tip payload 0.44 g, clamp compliance 0.26 mrad/(N m).",
        ),
        (insufficient, "poor", "Not enough data for a diagnosis: no recording is held out"),
    ],
)
def test_verdict_says_it_in_a_sentence(of: object, grade: str, words: str) -> None:
    assert callable(of)
    finding = result_page(of())
    assert finding.grade == grade
    assert words in plain(finding.headline)


@pytest.mark.parametrize(
    ("after", "first"), [(3.1e-4, "Cause found: viscous friction of"), (1.4e-3, "Residual not explained by any")]
)
def test_what_is_named_leads_only_where_it_nearly_explains_what_was_held_out(after: float, first: str) -> None:
    found = named()
    assert found.gain is not None
    looks = Remaining(1e-40, "odd in velocity")
    found = replace(found, verdict="unknown", remaining=looks, gain=replace(found.gain, noise=3e-4, after=after))
    headline = plain(result_page(found).headline)
    assert headline.startswith(first)
    for part in ("viscous friction", "not explained by any candidate", "odd in velocity"):
        assert part in headline.lower()


def test_a_small_cause_is_told_after_the_headline() -> None:
    found = pair()
    delay, marker = found.causes
    page = result_page(replace(found, causes=(delay, replace(marker, role="minor", holdout_gain=2e-5))))
    assert "marker" not in page.headline
    (said,) = [plain(point) for point in page.points if point.startswith("Minor cause: ")]
    assert "marker" in said
    assert said.endswith("held-out error 0.020 mm smaller.")


def test_the_headline_says_first_where_causes_make_predictions_worse() -> None:
    found = pair()
    assert found.gain is not None
    gain = replace(found.gain, before=3e-4, after=5e-4, reduction=-0.67, interval=(-0.7, -0.6))
    page = result_page(replace(found, gain=gain))
    assert page.grade == "poor"
    assert plain(page.headline).startswith(
        "Use the model without these causes: with these causes the held-out error rises from 0.30 mm to 0.50 mm."
    )
    assert replace(found, gain=gain).to_dict()["recommended"] == "without causes"
    little = replace(gain, before=3.001e-4, after=3.04e-4, reduction=-0.013, interval=(-0.02, -0.01))
    told = "the held-out error rises by 1.3 % of 0.30 mm."
    assert told in plain(result_page(replace(found, gain=little)).headline)


def test_gain_is_told_in_millimetres_and_with_its_interval() -> None:
    found = pair()
    assert found.gain is not None
    gain = replace(found.gain, before=2.1e-3, after=3.1e-4, reduction=0.85, interval=(0.83, 0.87), next_best=1.2e-3)
    finding = result_page(replace(found, gain=gain))
    assert "Held-out error falls from 2.1 mm to 0.31 mm (noise 0.30 mm)." in plain(finding.headline)
    told = "Held-out error: 85 % less (95 % interval of the reduction 83 … 87 %)"
    assert f"{told}; next best explanation: 1.2 mm." in [plain(point) for point in finding.points]
    called = result_page(replace(found, gain=gain, next_best=(TimeOffset(), LinearDrag(link=0))))
    said = "next best explanation (time offset and linear drag): 1.2 mm."
    assert f"{told}; {said}" in [plain(point) for point in called.points]
    assert "not tested" in " ".join(result_page(replace(found, gain=None)).points)


def test_a_gain_too_small_for_the_digits_of_the_error_is_told_as_one() -> None:
    found = pair()
    assert found.gain is not None
    gain = replace(found.gain, before=3.004e-4, after=3.002e-4, reduction=7e-4, interval=(-3e-4, 1.7e-3))
    page = result_page(replace(found, gain=gain))
    assert "The gain is too small to show in the held-out error of 0.30 mm (noise 0.30 mm)." in plain(page.headline)
    told = "Held-out error: 0.070 % less (95 % interval of the reduction −0.030 … 0.17 %)"
    assert any(plain(point).startswith(told) for point in page.points)


def test_what_cannot_be_told_apart_comes_with_the_recording_that_would() -> None:
    text = " ".join(_alternative_points(undecided()))
    assert "chi² larger by 0.70" in text
    assert "Next experiment: to distinguish tip payload from clamp compliance" in text
    assert _alternative_points(pair()) == []


@pytest.mark.parametrize("effect", BUILTIN, ids=lambda each: each.id)
def test_every_effect_has_words(effect: Effect) -> None:
    model = pair().model
    usual = effect.at(0.5 * (effect.coordinates * 0 + 1))
    named = clause(replace(usual, link=0), model)
    assert "{" not in named
    assert named[0].islower()
    if effect.parameters:
        assert any(character.isdigit() for character in named)


def test_quantities_are_in_everyday_units() -> None:
    assert quantity(0.0133, 1.3e-4, "kg") == "13.30 ± 0.13 g"
    assert quantity(0.0, 0.09, "m") == "0 ± 90 mm"  # not 90000 µm
    assert quantity(1e-7, math.inf, "m") == "0.1000 µm"
    assert quantity(0.5, None, "kg") == "0.50 kg"
    assert quantity(math.pi / 180, None, "rad") == "1.0°"
    assert quantity(0.003366, 3e-6, "rad/(N m)", 4) == "3.3660 ± 0.0030 mrad/(N m)"  # as README.md has it
    assert quantity(-2.2e-3, None, "1/s") == "−0.22 %/s"
    assert quantity(math.inf, None, "N m/rad") == "–"
    assert sizes_text(InPlaneGravity(), {"gx": 0.1, "gy": -1e-9}) == "gx 0.10, gy 0.00 m/s²"
    assert sizes_text(CameraScale(), {"scale": 1.008}) == "+0.80 %"
    assert sizes_text(CameraScale(), {"scale": 4e-4}, from_null=True) == "0.040 %"
    assert sizes_text(TipPayload(), {"mass": 4e-4}, from_null=True) == "0.40 g"


def test_urdf_carries_what_it_can() -> None:
    found = pair()
    model = replace(found.model, effects=(FRICTION, *found.model.effects))
    points = result_page(replace(found, model=model)).sections[-1].points
    assert points[0] == "In model.urdf and model.json: Coulomb friction (beam)."
    assert "In model.json only" in points[1]
    assert "time offset, marker offset (beam)" in points[1]


def test_tables(diagnosis: Diagnosis) -> None:
    for table in (_cause_table(diagnosis), _candidate_table(diagnosis)):
        assert {len(row) for row in table.rows} <= {len(table.headers)}
    few = _candidate_table(diagnosis, 4)
    assert len(few.rows) == 4
    assert [row[2] for row in few.rows[: len(diagnosis.causes)]] == ["found"] * len(diagnosis.causes)
    assert len(_candidate_table(diagnosis).rows) == sum(each.testable for each in diagnosis.candidates)


def test_what_cannot_be_tested_is_one_line(diagnosis: Diagnosis) -> None:
    untestable = [each for each in diagnosis.candidates if not each.testable]
    lines = _untestable_points(diagnosis)
    assert len(lines) == bool(untestable)
    for each in untestable:
        assert in_sentence(each.effect.title) in lines[0]
        assert lines[0].count(each.reason) == 1


def test_the_table_of_candidates_says_which_fits_better_and_why_one_is_not_possible() -> None:
    found = named()
    first, second, third, *others = (each for each in found.candidates if each.testable)
    fitted = (
        replace(first, misfit=1.004),
        replace(second, misfit=2.5, bound="lower"),
        replace(third, misfit=7.0, bound="upper", z=0.0),
    )
    found = replace(found, candidates=(*fitted, *others))
    table = _candidate_table(found)
    rows = {row[0]: dict(zip(table.headers, row, strict=True)) for row in table.rows}
    residual = "residual fitted alone [×\N{NO-BREAK SPACE}noise]"
    assert rows[first.effect.title][residual] == "1.00"
    assert rows[second.effect.title][residual] == "≥ 2.50"
    assert rows[third.effect.title][residual] == "≤ 7.00"
    assert rows[third.effect.title]["estimate if it were the only cause"] == "wrong sign"
    assert found.gain is not None
    assert rows[found.causes[0].effect.title]["held-out [mm]"] == number(1e3 * found.gain.after, 2)
    result = DiagnoseResult.model_validate_json(json_text(result_object(found)))
    bounds = [(each.residual, each.residual_bound) for each in result.candidates[:3]]
    assert bounds == [(1.004, None), (2.5, "lower"), (7.0, "upper")]
    held_out = {each.effect: each.holdout_rms_m for each in result.candidates if each.holdout_rms_m is not None}
    (next_best,) = found.next_best
    assert held_out == {found.causes[0].effect.id: found.gain.after, next_best.id: found.gain.next_best}


def test_a_size_that_differs_from_the_estimate_is_explained() -> None:
    found = named()
    (cause,) = found.causes
    own = {name: size.value for name, size in cause.parameters.items()}
    for sizes, explained in ((own, False), ({name: 1.5 * value for name, value in own.items()}, True)):
        candidates = tuple(
            replace(each, sizes=sizes) if each.effect.key == cause.effect.key else each for each in found.candidates
        )
        assert ("in the fit" in _candidate_table(replace(found, candidates=candidates)).notes[0]) == explained


def test_page_has_the_verdict_first(diagnosis: Diagnosis) -> None:
    pictures = pictures_of(diagnosis) if diagnosis is pair() else []  # they take seconds, and are tested by themselves
    page = result_page(diagnosis, pictures).html()
    assert_self_contained(page)
    assert len(page) < 3e6
    symptoms = "Symptoms without causes" if diagnosis.causes else "Symptoms"
    order = ['class="headline"', "<svg", f"{symptoms}</h2>"]
    order += ["Causes</h2>"] if diagnosis.causes else []
    order += ['class="plots"', "Candidates</h2>", "Method</h2>"]
    places = [page.index(each) for each in order]
    assert places == sorted(places)
    for recording in diagnosis.experiment.recordings:
        assert recording.file in page


def test_hostile_names_stay_text() -> None:
    found = undecided()
    rig = replace(found.experiment.rig, name=HOSTILE)
    hostile = replace(
        found,
        experiment=replace(found.experiment, rig=rig),
        warnings=(HOSTILE,),
        next_experiment=HOSTILE,
        causes=tuple(replace(each, evidence=HOSTILE) for each in found.causes),
    )
    page = result_page(hostile, []).html()
    assert_self_contained(page)
    assert not [tag for tag, _ in Elements(page).found if tag == "img"]


def test_figures_are_readable(diagnosis: Diagnosis) -> None:
    for picture in diagnosis_pictures(replace(diagnosis, symptoms=None)):
        assert_readable(picture.figure)


def test_residuals_without_and_with_the_causes_are_drawn() -> None:
    found = replace(pair(), symptoms=None)
    shown = next(each for each in found.recordings if each.recording.role == "holdout")
    assert shown.reference is not None
    assert shown.simulated is not None
    motion, residual = figure_of(diagnosis_pictures(found), "held_out_1").axes
    assert [line.get_label() for line in motion.lines] == ["measured", "with causes", "without causes"]
    sizes = {line.get_label(): np.ptp(np.asarray(line.get_ydata())) for line in residual.lines}
    assert sizes["with causes"] < sizes["without causes"]
    gain = figure_of(diagnosis_pictures(found), "gain").axes[0]
    assert marks(gain, "with causes")[0] == pytest.approx(1e3 * shown.simulated.marker_rms)  # held out comes first


def test_pictures_have_their_names(diagnosis: Diagnosis) -> None:
    drawn = pictures_of(diagnosis)
    assert {each.name for each in drawn} <= set(output._PICTURES)
    assert sum(each.name.startswith("cause") for each in drawn) == len(diagnosis.causes)
    for each in drawn:
        assert each.caption.endswith(".")
        assert each.alternative.strip()


# For every abscissa the effect with the longest clause.
LONGEST = [*{effect.abscissa: effect for effect in sorted(BUILTIN, key=lambda effect: len(effect.clause))}.values()]


@pytest.mark.parametrize("effects", [LONGEST, pytest.param(BUILTIN, marks=pytest.mark.slow)], ids=["longest", "all"])
def test_every_effect_has_its_evidence(effects: Sequence[Effect]) -> None:
    """Whatever the effect, there is something to hold the residual against."""
    found = pair()
    first = found.recordings[0]
    for effect in effects:
        cause = replace(found.causes[0], effect=replace(effect, link=0), parameters={})
        assert_nothing_overlaps(Picture("cause", "", partial(_evidence, cause, found.model, [first])).figure)


@pytest.mark.parametrize("name", ["undecided", "pair", "nothing"])
def test_folder_holds_a_model_that_comes_back(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = DIAGNOSES[name]()
    monkeypatch.setattr(output, "diagnosis_pictures", pictures_of)
    folder = save(found, tmp_path / "out")
    assert {path.name for path in folder.iterdir()} == {
        "result.json",
        "model.json",
        "model.urdf",
        "report.html",
        "figures",
    }
    DiagnoseResult.model_validate_json((folder / "result.json").read_bytes())
    model, _ = read_model(folder / "model.json", found.experiment)
    assert model.effects == found.model.effects
    assert model.estimates == found.parameters
    carried = robot_from(folder / "model.urdf").link_map.get("beam_payload")
    assert (carried.inertial.mass if carried else 0.0) == found.model.arm.chain.links[0].payload
    assert bool(json.loads((folder / "model.json").read_text())["effects"]) == bool(found.model.effects)
    recording = found.experiment.recordings[1]
    assert model.replay(recording).marker_rms == pytest.approx(found.model.replay(recording).marker_rms, rel=1e-6)


def test_names_of_pictures_differ() -> None:
    assert len(set(output._PICTURES)) == len(output._PICTURES)
