"""Every figure: units on its axes, nothing on top of anything else, no warnings."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator
from dataclasses import replace

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from tests.report.fits import demo_fit, elbow_fit, hub_fit, pictures_of, torque_fit
from vjm.errors import InsufficientDataError
from vjm.identification.records import Identification
from vjm.records import RecordingComparison, SimulatedRecording
from vjm.report.figures.joints import joint_angles, torque_error_figure
from vjm.report.figures.motion import fit_of_recordings, link_shapes, most_recordings, raw_markers, tip_motion
from vjm.report.figures.pictures import NAMES, identification_pictures, replay_pictures
from vjm.report.figures.residuals import correlation_map, residual_map, residual_spectra
from vjm.report.figures.style import png
from vjm.report.figures.windows import liveliest, spread_over, tips, windows

_COUNTS = (
    "recording",
    "joint, from the base outwards",
    "marker coordinate",
    "parameter",
)  # axes that hold names, not quantities


def figures(fit: Identification) -> Iterator[Figure]:
    rig, chain = fit.model.rig, fit.model.chain
    yield fit_of_recordings(fit.recordings)
    for each in tips(rig, fit.recordings, 4):
        yield tip_motion(each, fit.model, fit.nominal)
    yield residual_map(fit.model, fit.recordings)
    yield drawn(residual_spectra(fit.model, fit.recordings))
    yield drawn(correlation_map(fit.parameters, fit.covariance))
    lively = liveliest(rig, fit.torque_data, 2)
    yield link_shapes(rig, chain, lively)
    yield joint_angles(chain, lively[0])
    yield torque_error_figure(chain, fit.torque_data)
    yield raw_markers(rig, spread_over(fit.experiment.recordings, most_recordings(rig)))


def drawn(figure: Figure | None) -> Figure:
    assert figure is not None
    return figure


def test_every_figure_is_readable(fit: Identification) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for figure in figures(fit):
            assert figure.texts[0].get_text().strip(), "a figure without a finding"
            for axes in figure.axes:
                if axes.xaxis.get_tick_params()["labelbottom"]:  # else the panel below says it
                    assert_labelled(axes.get_xlabel())
                assert_labelled(axes.get_ylabel())
            assert_nothing_overlaps(figure)


def assert_labelled(label: str) -> None:
    assert label in _COUNTS or (label.endswith("]") and "[" in label), label


def assert_nothing_overlaps(figure: Figure) -> None:
    figure.draw_without_rendering()
    page = figure.bbox
    boxes = [("legend", figure.legends[0].get_tightbbox()), ("title", figure.texts[0].get_window_extent())]
    boxes += [(f"axes {k}", axes.get_tightbbox()) for k, axes in enumerate(figure.axes)]
    for name, box in boxes:
        assert box is not None, name
        inside = page.x0 <= box.x0 and box.x1 <= page.x1 + 1 and page.y0 <= box.y0 and box.y1 <= page.y1
        assert inside, f"{name} leaves the page: {box} in {page}"
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        assert a is not None
        assert b is not None
        common = Bbox.intersection(a, b)
        assert common is None or min(common.width, common.height) < 1, f"{one} and {other} overlap"


@pytest.mark.parametrize("fit", ["demo", "hub"], indirect=True)
def test_names_and_number_of_pictures(fit: Identification) -> None:
    names = [picture.name for picture in pictures_of(fit)]
    assert set(names) <= set(NAMES)
    assert len(names) == len(set(names)) <= 12


def test_residuals_are_shown_for_whole_trajectories_only() -> None:
    shown = {name for name in NAMES if name.startswith("residual")}
    assert shown <= {picture.name for picture in pictures_of(demo_fit())}
    assert not shown & {picture.name for picture in pictures_of(torque_fit())}


def test_all_three_models_stand_beside_each_other_in_units_of_the_noise() -> None:
    figure = fit_of_recordings(demo_fit().recordings)
    assert [text.get_text() for text in figure.legends[0].texts] == [
        "nominal model",
        "torque method",
        "identified model (trajectory method)",
        "noise",
    ]
    axes = figure.axes[0]
    assert axes.get_xlabel().endswith("[times the noise]")
    marks = [line for line in axes.lines if line.get_marker() == "D"]
    expected = [each.alternative.marker_rms / each.noise[0] for each in demo_fit().recordings if each.alternative]
    assert np.ravel([line.get_xdata() for line in marks]).tolist() == pytest.approx(expected)
    title = figure.texts[0].get_text().replace("\n", " ")
    for words in ("in held-out recordings: identified model 2.3", "torque method", "nominal model 53"):
        assert words in title


def test_without_torque_method_beside_it_residuals_are_in_millimetres() -> None:
    figure = fit_of_recordings(torque_fit().recordings)
    assert figure.axes[0].get_xlabel().endswith("[mm]")
    assert [text.get_text() for text in figure.legends[0].texts] == ["nominal model", "identified model", "noise"]


def test_tip_shows_the_torque_methods_residual_where_it_is_worse_but_legible() -> None:
    fit = demo_fit()
    shown = fit.recordings[3]
    assert shown.simulated is not None
    assert shown.alternative is not None

    def residuals(torque: SimulatedRecording | None) -> tuple[str, str]:
        figure = tip_motion(replace(shown, alternative=torque), fit.model, fit.nominal)
        return figure.axes[-1].get_title("left"), figure.texts[0].get_text().replace("\n", " ")

    panel, title = residuals(shown.alternative)
    assert "torque method's" in panel
    assert "torque method" in title
    assert "torque" not in residuals(shown.simulated)[0]  # as good: its line would hide the other
    assert "torque" not in residuals(None)[1]


def test_holdout_recordings_are_shown_first() -> None:
    fit = hub_fit() if hub_available() else demo_fit()
    shown = tips(fit.model.rig, fit.recordings, 4)
    assert shown[0].recording.role == "holdout"
    assert {each.recording.role for each in shown} == {"train", "holdout"}
    labels = [each.recording.repeat for each in shown if each.recording.repeat]
    assert len(labels) == len(set(labels))


def hub_available() -> bool:
    from tests.report.fits import SHARED

    return SHARED.is_dir()


def test_a_recording_that_was_not_simulated_has_no_tip_figure() -> None:
    fit = elbow_fit()
    assert all(each.recording.file != "no_torque.csv" for each in tips(fit.model.rig, fit.recordings, 9))
    with pytest.raises(InsufficientDataError, match="no torque"):
        tip_motion(fit.recordings[-1], fit.model, fit.nominal)


def test_many_periods_are_cut_to_a_window() -> None:
    time = np.arange(0.0, 20.0, 0.01)
    parts = windows(time, np.sin(2 * np.pi * 7 * time))
    assert [round(stop - start, 1) for start, stop in parts] == [0.9, 0.9]
    assert parts[1][1] == time[-1]
    assert windows(time, np.sin(2 * np.pi * 0.5 * time)) == [(0.0, time[-1])]
    dying = windows(time, np.exp(-4 * time) * np.sin(2 * np.pi * 7 * time))
    assert len(dying) == 1
    assert dying[0][1] < 1.5


def test_without_training_data_or_replays_the_rest_is_drawn() -> None:
    fit = demo_fit()
    bare = tuple(
        RecordingComparison(each.recording, each.noise, None, problem="it diverged") for each in fit.recordings
    )
    names = [picture.name for picture in identification_pictures(replace(fit, torque_data=(), recordings=bare))]
    assert names == ["fit", "correlations", "markers"]


def test_comparison_pictures_name_the_given_model() -> None:
    fit = demo_fit()
    pictures = replay_pictures(fit.recordings, fit.model, fit.nominal)
    assert "given model" in pictures[1].alternative


def test_pictures_do_not_depend_on_the_users_settings_and_leave_them_alone() -> None:
    fit = demo_fit()
    plain = png(fit_of_recordings(fit.recordings))
    with mpl.rc_context({"font.size": 30, "axes.grid": False, "savefig.dpi": 10}):
        assert png(fit_of_recordings(fit.recordings)) == plain
        assert mpl.rcParams["font.size"] == 30
    assert plain.startswith(b"\x89PNG")


def test_strange_file_names_are_printed_as_they_are() -> None:
    fit = demo_fit()
    names = ["$x^2$ \\alpha_$.csv", "二.csv", "a" * 300 + ".csv", "line\nbreak.csv"]
    strange = tuple(
        replace(each, recording=replace(each.recording, file=name))
        for each, name in zip(fit.recordings, names, strict=True)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert png(fit_of_recordings(strange))
        assert png(tip_motion(strange[1], fit.model, fit.nominal))
        assert png(tip_motion(strange[2], fit.model, fit.nominal))
