"""report.html: one file, safe whatever the names, with the verdict first."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from tests.report.fits import demo_fit, elbow_fit, pictures_of
from vjm.identification.records import Identification, RecordingFit
from vjm.report.comparison import Comparison
from vjm.report.page import comparison_page, identification_page
from vjm.report.tables import nominal_value, parameter_table, recording_table
from vjm.report.verdict import comparison_verdict, identification_verdict

HOSTILE = "<script>alert('1')</script><img src=http://evil.example/x onerror=alert(2)>&amp; \"quoted\" {{ 7 * 7 }}"


class Elements(HTMLParser):
    """Tags and their attributes, and that every tag is closed."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def assert_self_contained(page: str) -> None:
    for tag, attributes in Elements(page).found:
        assert tag not in ("script", "link", "iframe", "object", "base")
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "srcset", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:image/png;base64,")
    assert not re.search(r"url\(|@import", page)


@pytest.mark.parametrize("fit", ["demo", "elbow"], indirect=True)
def test_page_is_one_light_file(fit: Identification) -> None:
    page = identification_page(fit, pictures_of(fit))
    assert_self_contained(page)
    assert len(page) < 3e6
    assert page.index("headline") < page.index("Table 1") < page.index("Table 2") < page.index("<figure>")
    for recording in fit.experiment.recordings:
        assert recording.file in page


def test_hostile_names_stay_text() -> None:
    fit = demo_fit()
    rig = replace(fit.experiment.rig, name=HOSTILE)
    recording = replace(fit.recordings[0].recording, file=HOSTILE)
    hostile = replace(
        fit,
        experiment=replace(fit.experiment, rig=rig),
        recordings=(replace(fit.recordings[0], recording=recording, problem=HOSTILE),),
        warnings=(HOSTILE,),
        parameters=tuple(replace(each, reason=HOSTILE, identifiable=False) for each in fit.parameters),
    )
    page = identification_page(hostile, pictures_of(fit)[:1])
    assert_self_contained(page)
    assert "&lt;script&gt;alert(" in page
    assert "{{ 7 * 7 }}" in page


def with_ratio(fit: Identification, ratio: float, role: str | None = None) -> tuple[RecordingFit, ...]:
    """The recordings' fits, those of one role (or all) at so many times the noise."""
    result = []
    for each in fit.recordings:
        factor = ratio if role in (None, each.recording.role) else 1.0
        assert each.replay is not None
        result.append(replace(each, replay=replace(each.replay, marker_rms=factor * each.marker_noise)))
    return tuple(result)


@pytest.mark.parametrize(
    ("ratio", "grade", "words"),
    [
        (1.02, "good", "to within the camera's noise"),
        (1.3, "fair", "to 1.3 times the camera's noise"),
        (9.0, "poor", "something is missing"),
    ],
)
def test_verdict_rests_on_held_out_recordings(ratio: float, grade: str, words: str) -> None:
    fit = demo_fit()
    verdict = identification_verdict(replace(fit, recordings=with_ratio(fit, ratio, "holdout")))
    assert verdict.grade == grade
    assert words in verdict.headline
    assert "held-out" in verdict.headline


def test_verdict_without_held_out_recordings_says_so() -> None:
    fit = demo_fit()
    train = tuple(each for each in with_ratio(fit, 1.0) if each.recording.role == "train")
    verdict = identification_verdict(replace(fit, recordings=train))
    assert verdict.grade == "fair"
    assert "No recording was held out" in verdict.headline


def test_a_search_that_failed_comes_first() -> None:
    fit = replace(demo_fit(), status="not converged", remedy="give recordings that move more")
    verdict = identification_verdict(fit)
    assert verdict.grade == "poor"
    assert "give recordings that move more" in verdict.headline


def test_points_name_what_is_not_determined_and_not_simulated() -> None:
    text = " ".join(identification_verdict(elbow_fit()).points)
    assert "upper.hub_inertia" in text
    assert "no_torque.csv (no torque was measured)" in text


def test_nothing_simulated() -> None:
    fit = demo_fit()
    bare = tuple(replace(each, replay=None, nominal=None, problem="it diverged") for each in fit.recordings)
    assert identification_verdict(replace(fit, recordings=bare)).headline == "No recording could be simulated."
    assert "not simulated: it diverged" in recording_table(bare).notes


def test_comparison_page() -> None:
    fit = demo_fit()
    comparison = Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, {}, fit.recordings, ())
    page = comparison_page(comparison, [])
    assert_self_contained(page)
    assert comparison_verdict(comparison).headline.replace("'", "&#39;") in page
    assert "Notes and warnings" not in page


def test_nominal_values_are_found_by_name() -> None:
    chain = elbow_fit().nominal.chain
    upper = chain.links[0]
    assert nominal_value("upper.stiffness_2", chain) == upper.stiffness[1]
    assert nominal_value("upper.length_0", chain) == upper.lengths[0]
    assert nominal_value("upper.mass_center_1", chain) == upper.mass_centers[1]
    assert nominal_value("upper.mass_1", chain) == upper.masses[1]
    assert nominal_value("fore.hub_inertia", chain) == 2e-3
    assert nominal_value("upper.bending_stiffness", chain) == pytest.approx(4.0)
    for unknown in ("upper.length_99", "upper.colour", "nobody.mass_0", "upper.mass_x"):
        assert nominal_value(unknown, chain) is None


def test_parameter_table_survives_what_is_not_finite() -> None:
    fit = demo_fit()
    lost = replace(fit.parameters[0], value=math.nan, std=math.inf, identifiable=False, reason="nothing moves")
    table = parameter_table((lost,), fit.nominal.chain)
    assert table.rows[0][1] == "no"
    assert table.notes == ("nothing moves",)
