"""Every figure: what it must show, units on its axes, nothing on top of anything else, no warnings."""

from __future__ import annotations

import itertools
import re
import warnings
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

import vjm
from tests.report.fits import SHARED, demo_fit, elbow_fit, hub_fit, pictures_of, torque_fit
from vjm.identification.records import Identification
from vjm.records import RecordingComparison, SimulatedRecording
from vjm.report.figures.identification import _data_pictures, _replay_pictures, identification_pictures
from vjm.report.figures.panels import DIVERGING, LINES, SMALLEST, Picture, Spectrum
from vjm.report.figures.signals import Signal, _motion_panel, _residual_panel, liveliest_window
from vjm.report.output import _PICTURES

Array = NDArray[np.float64]
# Axes that hold names, not quantities.
_COUNTS = ("recording", "joint", "marker coordinate", "parameter")


def figure_of(pictures: list[Picture], name: str) -> Figure:
    (picture,) = [picture for picture in pictures if picture.name == name]
    return picture.figure


def replayed(fit: Identification, name: str) -> Figure:
    return figure_of(_replay_pictures(fit.recordings, fit.model, "identified"), name)


def legend_labels(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.subfigs[0].legends[0].texts]


def marks(axes: Axes, label: str) -> list[float]:
    """Return the abscissae of the marks of a label."""
    (container,) = [each for each in axes.containers if each.get_label() == label]
    assert isinstance(container, ErrorbarContainer)
    return np.ravel(container.lines[0].get_xdata()).tolist()


def test_every_figure_is_readable(fit: Identification) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for picture in pictures_of(fit):
            assert picture.caption.endswith(".")
            assert picture.alternative.strip(), "a figure without a finding"
            assert_readable(picture.figure)


def assert_readable(figure: Figure) -> None:
    for axes in figure.axes:
        if axes.xaxis.get_tick_params()["labelbottom"]:  # else the panel below says it
            assert_labelled(axes.get_xlabel())
        if axes.yaxis.get_tick_params()["labelleft"]:  # else the panel on the left says it
            assert_labelled(axes.get_ylabel())
    assert_nothing_overlaps(figure)
    texts = [text for text in figure.findobj(Text) if text.get_text()]
    assert min(text.get_fontsize() for text in texts) >= SMALLEST


def assert_labelled(label: str) -> None:
    assert label in _COUNTS or (label.endswith("]") and "[" in label), label


def assert_nothing_overlaps(figure: Figure) -> None:
    figure.draw_without_rendering()
    page = figure.bbox
    boxes = [("legend", figure.subfigs[0].legends[0].get_tightbbox()), ("title", figure.texts[0].get_window_extent())]
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
    assert set(names) <= set(_PICTURES)
    assert len(names) == len(set(names)) <= 12


def test_residuals_are_shown_for_whole_trajectories_only() -> None:
    shown = {name for name in _PICTURES if name.startswith("residual")}
    assert shown <= {picture.name for picture in pictures_of(demo_fit())}
    assert not shown & {picture.name for picture in pictures_of(torque_fit())}


def test_every_model_stands_beside_the_noise_in_every_recording() -> None:
    fit = demo_fit()
    figure = figure_of(pictures_of(fit), "fit")
    assert sorted(legend_labels(figure)) == ["identified model", "noise", "nominal model", "torque method"]
    (axes,) = figure.axes
    assert axes.get_xlabel().endswith("[× noise]")
    expected = [each.alternative.marker_rms / each.noise[0] for each in fit.recordings if each.alternative]
    assert marks(axes, "torque method") == pytest.approx(expected)
    title = pictures_of(fit)[0].alternative
    for words in ("in held-out recordings: identified model 2.3", "torque method", "nominal model 53"):
        assert words in title
    assert "torque method" not in legend_labels(figure_of(pictures_of(torque_fit()), "fit"))


def test_tip_shows_the_measured_motion_and_the_simulated_one_between_frames() -> None:
    fit = demo_fit()
    for comparison in fit.recordings[2:]:
        signal = Signal.of(fit.model.rig, comparison.recording)
        assert signal is not None
        figure = Figure()
        axes = figure.subplots()
        assert comparison.simulated is not None
        _motion_panel(axes, signal, comparison, {"simulated": "model"})
        measured, simulated = axes.lines
        assert (measured.get_label(), simulated.get_label()) == ("measured", "model")
        assert np.asarray(measured.get_ydata()) == pytest.approx(1e3 * signal.value)
        # At the frames the line is the measured signal less its residual.
        at_frames = np.interp(signal.time, np.asarray(simulated.get_xdata()), np.asarray(simulated.get_ydata()))
        expected = 1e3 * (signal.value - signal.residual(comparison.simulated))
        assert at_frames == pytest.approx(expected)


def test_residual_is_measured_minus_simulated_over_the_whole_recording() -> None:
    comparison = demo_fit().recordings[1]
    signal = Signal.of(demo_fit().model.rig, comparison.recording)
    assert signal is not None
    assert comparison.simulated is not None
    axes = Figure().subplots()
    _residual_panel(axes, signal, comparison, {"simulated": "model"})
    (line,) = [line for line in axes.lines if line.get_label() == "model"]
    marker, axis = signal.index
    expected = comparison.recording.markers - comparison.simulated.simulation.markers
    assert np.asarray(line.get_ydata()) == pytest.approx(1e3 * expected[signal.rows, marker, axis])
    assert np.abs(axes.get_ylim()).min() >= 1e3 * np.nanmax(np.abs(expected[signal.rows, marker, axis]))


def test_an_arm_without_markers_shows_its_joint_angle() -> None:
    fit = elbow_fit()
    comparison = fit.recordings[0]
    assert comparison.simulated is not None
    markers = np.full_like(comparison.recording.markers, np.nan)
    signal = Signal.of(fit.model.rig, replace(comparison.recording, markers=markers))
    assert signal is not None
    assert signal.name == "fore.theta"
    assert signal.residual(comparison.simulated) == pytest.approx(comparison.simulated.theta_residual[:, 1])
    axes = Figure().subplots()
    _motion_panel(axes, signal, comparison, {"simulated": "model"})
    assert axes.get_ylabel() == "fore.theta [°]"
    line, simulation = axes.lines[1], comparison.simulated.simulation
    at_samples = np.interp(simulation.time, np.asarray(line.get_xdata()), np.asarray(line.get_ydata()))
    expected = np.degrees(simulation.theta[:, 1])
    assert at_samples == pytest.approx(expected)


def test_spectrum_is_drawn_beside_white_noise() -> None:
    simulated = demo_fit().recordings[1].simulated
    assert simulated is not None
    spectrum = Spectrum.of(simulated)
    assert spectrum is not None
    axes = Figure().subplots()
    Spectrum.draw(axes, [(spectrum, "model", "k")])
    line, white, limit = axes.lines
    assert np.asarray(line.get_ydata()) == pytest.approx(1e6 * spectrum.amplitude)
    assert np.asarray(white.get_ydata())[0] == pytest.approx(1e6 * spectrum.white)
    assert np.asarray(limit.get_ydata())[0] == pytest.approx(1e6 * spectrum.limit)


def test_tip_shows_the_torque_methods_residual_where_it_is_worse_but_legible() -> None:
    fit = demo_fit()
    shown = fit.recordings[3]
    assert shown.simulated is not None
    assert shown.alternative is not None

    def residuals(torque: SimulatedRecording | None) -> list[str]:
        changed = replace(fit, recordings=(replace(shown, alternative=torque),))
        return [str(line.get_label()) for line in replayed(changed, "tip_1").axes[-1].lines]

    assert "torque method" in residuals(shown.alternative)
    assert "torque method" not in residuals(shown.simulated)  # as good: its line would hide the other
    assert "torque method" not in residuals(None)


def test_held_out_recordings_are_shown_first_and_repeats_once() -> None:
    fit = hub_fit() if SHARED.is_dir() else demo_fit()
    titles = [each.alternative for each in pictures_of(fit) if each.name.startswith("tip")]
    assert "held out" in titles[0]
    assert any("(train)" in title for title in titles)
    files = {each.recording.file: each.recording.repeat for each in fit.recordings}
    labels = [label for file, label in files.items() if label and any(title.startswith(file) for title in titles)]
    assert len(labels) == len(set(labels))


def test_a_recording_that_was_not_simulated_is_named_but_has_no_tip_figure() -> None:
    pictures = pictures_of(elbow_fit())
    assert not [each for each in pictures if each.name.startswith("tip") and "no_torque" in each.alternative]
    labels = [label.get_text() for label in figure_of(pictures, "fit").axes[0].get_yticklabels()]
    assert labels[-1] == "no_torque.csv (train, not simulated)"


def test_many_periods_are_cut_to_windows() -> None:
    fit = demo_fit()
    assert len(replayed(fit, "tip_1").axes) == 2  # all of 10 s at 1.2 Hz
    titles = {each.alternative.partition(" ")[0]: each.figure for each in pictures_of(fit) if each.name[:3] == "tip"}
    first, last, _ = titles["second_mode.csv"].axes
    assert first.get_title("left").startswith("First 0.8")
    assert last.get_title("left").startswith("Last 0.8")
    time = np.arange(0.0, 20.0, 0.01)
    start, stop = liveliest_window(time, np.sin(2 * np.pi * 7 * time) * np.exp(-((time - 9) ** 2)))
    assert start < 9 < stop < start + 1
    assert liveliest_window(time, np.sin(2 * np.pi * 0.1 * time)) == (0.0, time[-1])


def test_a_signal_that_dies_out_is_shown_until_then() -> None:
    fit = demo_fit()
    shown = fit.recordings[1]
    faded = shown.recording.markers * np.exp(-2 * shown.recording.time)[:, None, None]
    changed = replace(shown, recording=replace(shown.recording, markers=faded))
    first, *_ = replayed(replace(fit, recordings=(changed,)), "tip_1").axes
    assert first.get_xlim()[1] < 0.5 * shown.recording.time[-1]


def test_without_training_data_or_replays_the_rest_is_drawn() -> None:
    fit = demo_fit()
    bare = tuple(
        RecordingComparison(each.recording, each.noise, None, problem="it diverged") for each in fit.recordings
    )
    names = [picture.name for picture in identification_pictures(replace(fit, torque_data=(), recordings=bare))]
    assert names == ["fit", "correlations", "markers"]


def test_raw_markers_show_every_kind_of_recording() -> None:
    fit = demo_fit()
    copies = tuple(replace(fit.experiment.recordings[1], file=f"copy_{k}.csv") for k in range(12))
    crowded = replace(fit.experiment, recordings=(*copies, *fit.experiment.recordings))
    *_, picture = _data_pictures(replace(fit, experiment=crowded))
    headings = " ".join(axes.get_title("left") for axes in picture.figure.axes)
    assert len(picture.figure.axes) == 8
    assert "quiet.csv (quiet, train)" in headings
    assert "both_modes.csv (decay, held out" in headings


def test_comparison_pictures_name_the_given_model() -> None:
    fit = demo_fit()
    pictures = _replay_pictures(fit.recordings, fit.model, "given")
    assert "given model" in pictures[1].alternative


def test_pictures_do_not_depend_on_the_users_settings_and_leave_them_alone() -> None:
    fit = demo_fit()
    plain = figure_png(fit)
    with mpl.rc_context(
        {"font.size": 30, "axes.grid": False, "savefig.dpi": 10, "lines.marker": "x", "font.family": "serif"}
    ):
        assert figure_png(fit) == plain
        assert mpl.rcParams["font.size"] == 30
    assert plain.startswith(b"\x89PNG")


def figure_png(fit: Identification) -> bytes:
    return _replay_pictures(fit.recordings[:1], fit.model, "given")[0].png


def test_strange_file_names_are_printed_as_they_are() -> None:
    fit = demo_fit()
    names = ["$x^2$ \\alpha_$.csv", "二.csv", "a" * 300 + ".csv", "line\nbreak.csv"]
    strange = [
        replace(each, recording=replace(each.recording, file=name))
        for each, name in zip(fit.recordings, names, strict=True)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pictures = _replay_pictures(strange, fit.model, "given")
        assert [picture.png[:4] for picture in pictures] == [b"\x89PNG"] * len(pictures)
        assert pictures[0].figure.axes[0].get_yticklabels()[0].get_text() == "$x^2$ \\alpha_$.csv (train)"
        warnings.filterwarnings("ignore", "Glyph")
        for picture in pictures:
            assert_nothing_overlaps(picture.figure)


def test_text_in_figures_can_be_read_on_a_telephone() -> None:
    """A page 400 pixels wide shows a figure at its least width, which scrolls."""
    rem, least = 16, 9  # pixels
    style = (Path(vjm.__file__).parent / "report" / "report.css").read_text(encoding="utf-8")
    (width,) = re.findall(r"figure img \{[^}]*min-width: ([\d.]+)rem", style)
    figure = pictures_of(demo_fit())[0].figure
    shown = float(width) * rem / (figure.get_figwidth() * figure.dpi)
    assert shown * SMALLEST * figure.dpi / 72 >= least


def test_baselines_stay_apart_in_grey() -> None:
    greys = sorted(np.dot(to_rgb(look["color"]), (0.3, 0.59, 0.11)) for look in LINES.values())
    assert np.diff(greys).min() > 0.15
    assert len({str(look["linestyle"]) for look in LINES.values()}) == len(LINES)
    negative, positive = (np.dot(DIVERGING(place)[:3], (0.3, 0.59, 0.11)) for place in (0.0, 1.0))
    assert positive - negative > 0.3
