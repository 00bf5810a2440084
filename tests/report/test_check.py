"""What `vjm check` shows of recordings: a table that fits a terminal, and a picture in which a wrong axis is seen."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib import image

import vjm
from tests.report.fits import DEMO
from tests.report.schema import CheckResult
from vjm.cli import main
from vjm.identification.check import Check, RecordingOverview
from vjm.records import Experiment, Link, Recording, Rig
from vjm.report.figures.check import check_picture


@pytest.fixture(scope="module")
def checked() -> Check:
    return vjm.check(vjm.load_experiment(DEMO))


def test_the_table_tells_of_each_recording_within_80_columns(checked: Check) -> None:
    lines = checked.summary().splitlines()
    (row,) = [line for line in lines if line.strip().startswith("first_mode")]
    name, seconds, rate, frames, missing, noise, motion, *modes = row.split()
    assert (name, seconds, rate, frames, missing) == ("first_mode", "10", "30.0", "301", "0")
    assert float(noise) == pytest.approx(0.3, rel=0.1)
    assert float(motion) > 100
    assert [float(mode) for mode in modes] == pytest.approx([1.19, 7.42], rel=0.01)
    table = lines[next(k for k, line in enumerate(lines) if not line.strip()) :]  # an empty line is above it
    assert max(len(line.rstrip()) for line in table) <= 80
    measured = CheckResult.model_validate(checked.to_dict()).recordings[1]
    assert (measured.frames, measured.missing_cells, measured.encoder_samples_per_s) == (301, 0, None)


def test_missing_cells_are_counted(checked: Check) -> None:
    recording = checked.experiment.recordings[1]
    markers = recording.markers.copy()
    markers[10:20, 2] = np.nan
    experiment = replace(checked.experiment, recordings=(replace(recording, markers=markers),))
    assert vjm.check(experiment).overviews[0].missing == 20


def test_the_picture_has_dots_where_the_markers_are(checked: Check) -> None:
    figure = check_picture(checked).figure
    (axes,) = figure.axes
    texts = [text.get_text() for text in axes.texts]
    assert {"x", "y", "base origin,\nclamp", "1", "5"} <= set(texts)
    rings = next(line for line in axes.lines if str(line.get_label()).startswith("described: markers"))
    np.testing.assert_allclose(rings.get_xdata(), checked.experiment.rig.links[0].markers)
    dots = [line for line in axes.lines if line.get_markersize() == 13]
    np.testing.assert_allclose([float(dot.get_xdata()[0]) for dot in dots], rings.get_xdata(), atol=1e-3)
    assert image.imread(io.BytesIO(check_picture(checked).png)).shape[1] > 1000


def test_the_picture_of_a_joint_has_the_sense_and_the_travel_of_its_angle() -> None:
    link = Link("arm", "revolute", 1.0, 0.4, 2.0, (0.4, 1.0), hub_inertia=0.02)
    time = np.linspace(0.0, 2.0, 101)
    theta = 0.5 * np.sin(3 * time) ** 2
    markers = np.array(link.markers)[:, None] * np.stack([np.cos(theta), np.sin(theta)], axis=1)[:, None]
    recording = Recording(time, markers, theta[:, None], 0 * theta[:, None], kind="driven", file="turn.csv")
    rig = Rig("rig", (link,), marker_noise=3e-4)
    overview = RecordingOverview(recording, 2.0, 50.0, 50.0, 101, 0, 3e-4, 1e3, np.zeros(0))
    for scale, labels in ((1.0, {"arm.theta > 0", "arm.theta = 0.500 rad (28.6°)"}), (1e3, set[str]())):
        item = replace(overview, recording=replace(recording, markers=scale * markers))
        experiment = Experiment(rig, (item.recording,))
        (axes,) = check_picture(Check(experiment, (), np.zeros(0), (), {}, overviews=(item,))).figure.axes
        texts = {text.get_text() for text in axes.texts}
        assert {text for text in texts if "theta" in text} == labels  # none over a link that is a dot
        assert {"x", "y", "base origin,\njoint"} <= texts


def test_what_is_wrong_is_the_title(checked: Check) -> None:
    flipped = tuple(replace(each, markers=each.markers * [-1, 1]) for each in checked.experiment.recordings)
    wrong = vjm.check(replace(checked.experiment, recordings=flipped))
    picture = check_picture(wrong)
    assert "along -x" in picture.alternative
    assert len(picture.png) > 10_000


def test_the_command_writes_it(tmp_path: Path) -> None:
    assert main(["check", str(DEMO), "-o", str(tmp_path / "out"), "-q"]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["check.png", "result.json"]
