"""report.html: one file, safe whatever the names, with the verdict first."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from tests.report.fits import demo_fit, elbow_fit, pictures_of, torque_fit, with_rms
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification, Whiteness
from vjm.records import Estimate, RecordingComparison
from vjm.report.page import report_page
from vjm.report.tables import (
    Table,
    _nominal_value,
    mode_table,
    parameter_table,
    recording_table,
    remedy_table,
    whiteness_table,
)
from vjm.report.text import millimetres
from vjm.report.verdict import verdict

HOSTILE = "<script>alert('1')</script><img src=http://evil.example/x onerror=alert(2)>&amp; \"quoted\" {{ 7 * 7 }}"


def fits_table(comparisons: Sequence[RecordingComparison]) -> Table:
    return recording_table(comparisons, "identified", "nominal", "torque method")


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
    page = report_page(fit, pictures_of(fit))
    assert_self_contained(page)
    assert len(page) < 3e6
    assert page.index("headline") < page.index("Table 1") < page.index("Table 2") < page.index("<figure>")
    for text in (*(recording.file for recording in fit.experiment.recordings), *fit.notes):
        assert text in page


def test_page_says_which_method_it_was() -> None:
    assert "simulated open loop over its whole length" in report_page(demo_fit(), [])
    assert "simulated open loop over its whole length" not in report_page(torque_fit(), [])


def test_page_tells_what_is_not_determined_and_what_would_be_needed() -> None:
    page = report_page(elbow_fit(), [])
    assert page.count("a driven recording whose torque changes faster</td>") == 2
    assert "Parameters that these recordings do not determine" not in report_page(demo_fit(), [])


def test_hostile_names_stay_text() -> None:
    fit = demo_fit()
    rig = replace(fit.experiment.rig, name=HOSTILE)
    recording = replace(fit.recordings[0].recording, file=HOSTILE)
    hostile = replace(
        fit,
        experiment=replace(fit.experiment, rig=rig),
        recordings=(replace(fit.recordings[0], recording=recording, problem=HOSTILE),),
        warnings=(HOSTILE,),
        notes=(HOSTILE,),
        parameters=tuple(replace(each, reason=HOSTILE, remedy=HOSTILE, identifiable=False) for each in fit.parameters),
    )
    page = report_page(hostile, pictures_of(fit)[:1])
    assert_self_contained(page)
    assert "&lt;script&gt;alert(" in page
    assert "{{ 7 * 7 }}" in page


def with_ratio(fit: Identification, ratio: float, role: str | None = None) -> tuple[RecordingComparison, ...]:
    """The recordings' fits, those of one role (or all) at so many times the noise."""
    result = []
    for each in fit.recordings:
        factor = ratio if role in (None, each.recording.role) else 1.0
        assert each.simulated is not None
        result.append(replace(each, simulated=with_rms(each.simulated, factor * each.noise[0])))
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
    finding = verdict(replace(fit, recordings=with_ratio(fit, ratio, "holdout")))
    assert finding.grade == grade
    assert words in finding.headline
    assert "held-out" in finding.headline


def test_held_out_recordings_are_told_beside_the_torque_method() -> None:
    fit = demo_fit()
    held_out = fit.recordings[3]
    assert held_out.simulated is not None
    found, nominal, torque = (with_rms(held_out.simulated, rms) for rms in (0.31e-3, 7.6e-3, 0.4e-3))
    shown = replace(held_out, simulated=found, reference=nominal, alternative=torque)
    point = verdict(replace(fit, recordings=(shown,))).points[0].replace("\N{NO-BREAK SPACE}", " ")
    assert "0.31 mm RMS over its whole 10 s, open loop (torque method: 0.40 mm, nominal values: 7.6 mm)" in point
    alone = replace(shown, alternative=None)
    point = verdict(replace(fit, recordings=(alone,))).points[0].replace("\N{NO-BREAK SPACE}", " ")
    assert "open loop (nominal values: 7.6 mm); the camera" in point


def test_verdict_without_held_out_recordings_says_so() -> None:
    fit = demo_fit()
    train = tuple(each for each in with_ratio(fit, 1.0) if each.recording.role == "train")
    finding = verdict(replace(fit, recordings=train))
    assert finding.grade == "fair"
    assert "No recording was held out" in finding.headline


def test_a_search_that_failed_comes_first() -> None:
    fit = replace(demo_fit(), status="not converged", remedy="give recordings that move more")
    finding = verdict(fit)
    assert finding.grade == "poor"
    assert "give recordings that move more" in finding.headline


def test_points_name_what_is_not_determined_and_not_simulated() -> None:
    text = " ".join(verdict(elbow_fit()).points)
    assert "upper.hub_inertia" in text
    assert "; it takes a driven recording whose torque changes faster)." in text
    assert "no_torque.csv (no torque was measured)" in text


def test_torque_method_and_mac_have_columns_where_there_is_something_to_show() -> None:
    fit, plain = demo_fit(), torque_fit()
    table = fits_table(fit.recordings)
    column = table.headers.index("torque method")
    assert [row[column] for row in table.rows] == [
        millimetres(each.alternative.marker_rms) for each in fit.recordings if each.alternative
    ]
    assert "torque method" not in fits_table(plain.recordings).headers
    modes = mode_table(fit.modes)
    assert [row[modes.headers.index("shape, MAC")] for row in modes.rows] == ["0.9987", "0.9987", "–"]
    assert len({len(row) for row in (modes.headers, *modes.rows)}) == 1
    assert "shape, MAC" not in mode_table([replace(each, mac=None) for each in fit.modes]).headers


def test_left_out_coordinates_are_told() -> None:
    fits = [replace(demo_fit().recordings[0], left_out=3), demo_fit().recordings[1]]
    assert fits_table(fits).notes == ("3 marker coordinates left out", "")


def test_parameter_table_has_errors_and_intervals() -> None:
    chain = elbow_fit().nominal.chain
    known = Estimate("upper.bending_stiffness", 4.2, 0.0105, "N m^2")
    rows = parameter_table((known, replace(known, std=None), replace(known, std=4.2)), chain).rows
    assert rows[0] == ("upper.bending_stiffness", "yes", "4.000", "4.200 ± 0.011", "4.179 … 4.221", "0.25", "N m²")
    assert rows[1][4:6] == ("–", "–")
    assert rows[2][4:6] == ("0.0 … 12.4", "100")


def test_whiteness_table() -> None:
    table = whiteness_table((Whiteness("a.csv", 1.21, 0.03, False), Whiteness("b.csv", 4.0, 0.9, True)))
    assert table.rows == (("a.csv", "yes", "1.10", "0.030"), ("b.csv", "no", "2.00", "0.90"))


def test_nothing_simulated() -> None:
    fit = demo_fit()
    bare = tuple(
        RecordingComparison(each.recording, each.noise, None, problem="it diverged") for each in fit.recordings
    )
    assert verdict(replace(fit, recordings=bare)).headline == "No recording could be simulated."
    assert "not simulated: it diverged" in fits_table(bare).notes


def test_report_page() -> None:
    fit = demo_fit()
    comparison = Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, fit.recordings, ())
    page = report_page(comparison, [])
    assert_self_contained(page)
    assert verdict(comparison).headline.replace("'", "&#39;") in page
    assert "<p>Warnings</p>" not in page


def test_nominal_values_are_found_by_name() -> None:
    chain = elbow_fit().nominal.chain
    upper = chain.links[0]
    assert _nominal_value("upper.stiffness_2", chain) == upper.stiffness[1]
    assert _nominal_value("upper.length_0", chain) == upper.lengths[0]
    assert _nominal_value("upper.mass_center_1", chain) == upper.mass_centers[1]
    assert _nominal_value("upper.mass_1", chain) == upper.masses[1]
    assert _nominal_value("fore.hub_inertia", chain) == 2e-3
    assert _nominal_value("upper.bending_stiffness", chain) == pytest.approx(4.0)
    for unknown in ("upper.length_99", "upper.colour", "nobody.mass_0", "upper.mass_x"):
        assert _nominal_value(unknown, chain) is None


def test_parameter_table_survives_what_is_not_finite() -> None:
    fit = demo_fit()
    lost = replace(fit.parameters[0], value=math.nan, std=math.inf, identifiable=False, reason="nothing moves")
    table = parameter_table((lost,), fit.nominal.chain)
    assert table.rows[0][1] == "no"
    assert "nan" not in " ".join(table.rows[0])
    missing = remedy_table((lost, fit.parameters[1]))
    assert missing is not None
    assert missing.rows == ((lost.name, "nothing moves", "–"),)
