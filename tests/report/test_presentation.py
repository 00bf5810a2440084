"""Results present themselves in Python as they do on the terminal, briefly and safely."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot

from tests.report.diagnoses import DIAGNOSES, undecided
from tests.report.fits import demo_fit, elbow_fit
from tests.report.test_page import HOSTILE, Elements, assert_self_contained
from vjm.cli.commands import _show
from vjm.diagnosis.records import Diagnosis
from vjm.errors import ChoiceError, InsufficientDataError
from vjm.identification.comparison import Comparison
from vjm.records import Result
from vjm.report.result_json import result_object


def comparison() -> Comparison:
    fit = demo_fit()
    return Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, fit.recordings, ("careful",))


RESULTS: dict[str, Any] = {"demo": demo_fit, "elbow": elbow_fit, "comparison": comparison, **DIAGNOSES}


@pytest.fixture(params=list(RESULTS))
def result(request: pytest.FixtureRequest) -> Result:
    found: Result = RESULTS[request.param]()
    return found


def test_summary_is_what_the_command_prints(result: Result, capsys: pytest.CaptureFixture[str]) -> None:
    _show(argparse.Namespace(json=False, quiet=False), result)  # type: ignore[arg-type]
    assert result.summary() == capsys.readouterr().out
    assert "\x1b" not in result.summary()


def test_to_dict_is_the_result_object(result: Result) -> None:
    assert result.to_dict() == result_object(result)  # type: ignore[arg-type]


def test_repr_is_brief(result: Result) -> None:
    assert len(repr(result).splitlines()) <= 20
    assert max(map(len, repr(result).splitlines())) <= 120
    assert repr(result).startswith(f"<{type(result).__name__} of '")


def test_repr_of_many_points_is_cut() -> None:
    found = undecided()
    many = replace(found, causes=found.causes * 30)
    assert len(repr(many).splitlines()) == 20
    assert repr(many).endswith("…")


def test_records_with_arrays_are_told_in_a_line() -> None:
    fit = demo_fit()
    first = fit.recordings[0]
    assert first.simulated is not None
    assert fit.trajectory is not None
    records = (fit.model, first, first.simulated, first.simulated.simulation, fit.trajectory, fit.trajectory.point)
    diagnosis = undecided()
    chain = fit.model.chain
    records = (*records, chain, chain.links[0], diagnosis.symptoms)  # type: ignore[assignment]
    for record in (*records, fit.torque_data[0], fit.torque_data[0].angles, fit.torque_data[0].derivatives):
        assert "\n" not in repr(record)
        assert len(repr(record)) < 400


def test_estimates_are_found_by_name() -> None:
    fit = demo_fit()
    assert "beam.bending_stiffness" in fit
    assert "beam.colour" not in fit
    assert [fit[name] for name in fit] == list(fit.parameters)
    with pytest.raises(ChoiceError, match=r"beam\.colour.*beam\.bending_stiffness"):
        fit["beam.colour"]


def test_notebooks_show_verdict_and_tables(result: Result) -> None:
    html = result._repr_html_()
    assert_self_contained(html)
    assert "<html" not in html
    assert html.index("headline") < html.index("<table>")
    if not isinstance(result, Diagnosis):
        assert "Fit per recording" in html


def test_notebooks_keep_hostile_names_as_text() -> None:
    fit = demo_fit()
    rig = replace(fit.experiment.rig, name=HOSTILE)
    hostile = replace(fit, experiment=replace(fit.experiment, rig=rig), warnings=(HOSTILE,), notes=(HOSTILE,))
    html = hostile._repr_html_()
    assert_self_contained(html)
    assert not [tag for tag, _ in Elements(html).found if tag in ("script", "img")]
    assert "&lt;script&gt;alert(" in html


@pytest.mark.parametrize("method", ["plot_fit", "plot_residuals"])
def test_plots_draw_measurement_and_simulation(method: str) -> None:
    fit = elbow_fit()
    axes = getattr(fit, method)()
    simulated = [each for each in fit.recordings if each.simulated is not None]
    assert len(axes) == len(simulated) < len(fit.recordings)
    assert all("[mm]" in one.get_ylabel() for one in axes)
    assert [one.get_title().split()[0] for one in axes] == [each.recording.file for each in simulated]
    pyplot.close("all")
    own = pyplot.figure().subplots()
    assert getattr(fit, method)("drive_1.csv", ax=own).tolist() == [own]
    assert own.get_title() == "drive_1.csv (train)"
    assert getattr(fit, method)(fit.experiment.recordings[2])[0].get_title() == "drive_2.csv (held out)"
    pyplot.close("all")


def test_the_plotted_fit_is_the_simulation() -> None:
    fit = demo_fit()
    first = fit.recordings[1].simulated
    assert first is not None
    measured, simulated = fit.plot_fit(first.recording)[0].get_lines()
    tip = np.s_[:, 4, 1]
    assert np.allclose(1e3 * first.recording.markers[tip], measured.get_ydata(), rtol=1e-12)
    at_frames = np.interp(first.simulation.time, np.asarray(simulated.get_xdata()), np.asarray(simulated.get_ydata()))
    assert np.allclose(1e3 * first.simulation.markers[tip], at_frames, rtol=1e-12)
    residual = fit.plot_residuals(first.recording)[0].get_lines()[-1]
    assert np.allclose(1e3 * first.marker_residual[tip], residual.get_ydata(), rtol=1e-12)
    pyplot.close("all")


def test_what_cannot_be_plotted_is_told() -> None:
    with pytest.raises(ChoiceError, match=r"nobody\.csv"):
        elbow_fit().plot_fit("nobody.csv")
    with pytest.raises(InsufficientDataError, match="no torque was measured"):
        elbow_fit().plot_residuals("no_torque.csv")
