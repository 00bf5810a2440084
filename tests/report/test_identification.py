"""Identifications and comparisons as pages: verdict and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from tests.report.fits import demo_fit, elbow_fit, torque_fit, with_rms
from vjm.identification.records import Identification, Whiteness
from vjm.records import Estimate, RecordingComparison
from vjm.report.identification import (
    _mode_table,
    _remedy_tables,
    _values_by_name,
    _whiteness_tables,
    parameter_table,
    recording_table,
)
from vjm.report.output import result_page
from vjm.report.page import Table
from vjm.text import millimetres


def fits_table(comparisons: Sequence[RecordingComparison]) -> Table:
    return recording_table(comparisons, "identified", "nominal", "torque method")


def test_page_says_which_method_it_was() -> None:
    assert "simulated open loop over its full length" in result_page(demo_fit(), []).html()
    assert "simulated open loop over its full length" not in result_page(torque_fit(), []).html()


def test_page_tells_what_is_not_determined_and_what_would_be_needed() -> None:
    page = result_page(elbow_fit(), []).html()
    assert page.count("a driven recording whose torque changes faster</td>") == 2
    assert "Parameters that these recordings do not determine" not in result_page(demo_fit(), []).html()


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
        (1.02, "good", "to within camera noise"),
        (1.3, "fair", "to 1.3 × camera noise"),
        (9.0, "poor", "is incomplete"),
    ],
)
def test_verdict_rests_on_held_out_recordings(ratio: float, grade: str, words: str) -> None:
    fit = demo_fit()
    finding = result_page(replace(fit, recordings=with_ratio(fit, ratio, "holdout")))
    assert finding.grade == grade
    assert words in finding.headline
    assert "held-out" in finding.headline


def test_held_out_recordings_are_told_beside_the_torque_method() -> None:
    fit = demo_fit()
    held_out = fit.recordings[3]
    assert held_out.simulated is not None
    found, nominal, torque = (with_rms(held_out.simulated, rms) for rms in (0.31e-3, 7.6e-3, 0.4e-3))
    shown = replace(held_out, simulated=found, reference=nominal, alternative=torque)
    point = result_page(replace(fit, recordings=(shown,))).points[0].replace("\N{NO-BREAK SPACE}", " ")
    assert "0.31 mm RMS over 10 s, open loop (torque method 0.40 mm, nominal 7.6 mm)" in point
    alone = replace(shown, alternative=None)
    point = result_page(replace(fit, recordings=(alone,))).points[0].replace("\N{NO-BREAK SPACE}", " ")
    assert "open loop (nominal 7.6 mm); camera" in point


def test_verdict_without_held_out_recordings_says_so() -> None:
    fit = demo_fit()
    train = tuple(each for each in with_ratio(fit, 1.0) if each.recording.role == "train")
    finding = result_page(replace(fit, recordings=train))
    assert finding.grade == "fair"
    assert "No recording was held out" in finding.headline


def test_a_search_that_failed_comes_first() -> None:
    fit = replace(demo_fit(), status="not converged", remedy="give recordings that move more")
    finding = result_page(fit)
    assert finding.grade == "poor"
    assert "give recordings that move more" in finding.headline


def test_points_name_what_is_not_determined_and_not_simulated() -> None:
    text = " ".join(result_page(elbow_fit()).points)
    assert "upper.hub_inertia" in text
    assert "; needs a driven recording whose torque changes faster)." in text
    assert "no_torque.csv (no torque was measured)" in text


def test_torque_method_and_mac_have_columns_where_there_is_something_to_show() -> None:
    fit, plain = demo_fit(), torque_fit()
    table = fits_table(fit.recordings)
    column = table.headers.index("torque method")
    assert [row[column] for row in table.rows] == [
        millimetres(each.alternative.marker_rms) for each in fit.recordings if each.alternative
    ]
    assert "torque method" not in fits_table(plain.recordings).headers
    modes = _mode_table(fit.modes)
    assert [row[modes.headers.index("shape, MAC")] for row in modes.rows] == ["0.9987", "0.9987", "–"]
    assert len({len(row) for row in (modes.headers, *modes.rows)}) == 1
    assert "shape, MAC" not in _mode_table([replace(each, mac=None) for each in fit.modes]).headers


def test_left_out_coordinates_are_told() -> None:
    fits = [replace(demo_fit().recordings[0], left_out=3), demo_fit().recordings[1]]
    assert fits_table(fits).notes == ("3 marker coordinates left out", "")


def test_parameter_table_has_errors_and_intervals() -> None:
    chain = elbow_fit().nominal.chain
    known = Estimate("upper.bending_stiffness", 4.2, 0.0105, "N m^2")
    rows = parameter_table((known, replace(known, std=None), replace(known, std=4.2)), chain).rows
    assert rows[0] == ("upper.bending_stiffness", "4.200 ± 0.011", "N m²", "4.000", "4.179 … 4.221", "0.25", "yes")
    assert rows[1][4:6] == ("–", "–")
    assert rows[2][4:6] == ("0.0 … 12.4", "100")


def test_a_recording_at_rest_is_not_called_the_worst() -> None:
    """Any model follows it: how far it is from the noise tells nothing."""
    points = result_page(demo_fit()).points
    assert not any(point.startswith("quiet.csv") for point in points)
    assert sum("(worst training recording)" in point for point in points) == 1


def test_whiteness_table() -> None:
    (table,) = _whiteness_tables(
        (Whiteness("a.csv", 1.21, 0.03, False, False), Whiteness("b.csv", 4.0, 0.9, True, True))
    )
    assert table.rows == (("a.csv", "yes", "1.10", "0.030"), ("b.csv", "no", "2.00", "0.90"))


def test_nothing_simulated() -> None:
    fit = demo_fit()
    bare = tuple(
        RecordingComparison(each.recording, each.noise, None, problem="it diverged") for each in fit.recordings
    )
    assert result_page(replace(fit, recordings=bare)).headline == "No recording could be simulated."
    assert "not simulated: it diverged" in fits_table(bare).notes


def test_nominal_values_are_found_by_name() -> None:
    chain = elbow_fit().nominal.chain
    upper, values = chain.links[0], _values_by_name(chain)
    assert values["upper.stiffness_2"] == upper.stiffness[1]
    assert values["upper.length_0"] == upper.lengths[0]
    assert values["upper.mass_center_1"] == upper.mass_centers[1]
    assert values["upper.mass_1"] == upper.masses[1]
    assert values["fore.hub_inertia"] == 2e-3
    assert values["upper.bending_stiffness"] == pytest.approx(4.0)
    unknown = Estimate("upper.colour", 1.0, None, "")
    assert parameter_table((unknown,), chain).rows[0][3] == "–"


def test_parameter_table_survives_what_is_not_finite() -> None:
    fit = demo_fit()
    lost = replace(fit.parameters[0], value=math.nan, std=math.inf, identifiable=False, reason="nothing moves")
    table = parameter_table((lost,), fit.nominal.chain)
    assert table.rows[0][-1] == "no"
    assert "nan" not in " ".join(table.rows[0])
    (missing,) = _remedy_tables((lost, fit.parameters[1]))
    assert missing.rows == ((lost.name, "nothing moves", "–"),)
