"""The animation shows the records: measured markers off the simulated ones by their residuals, on the arm."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.report.diagnoses import DIAGNOSES, named, pair, undecided
from tests.report.fits import demo_fit, elbow_fit
from tests.report.test_page import Elements
from vjm.identification.records import Identification
from vjm.records import RecordingComparison
from vjm.report.figures.signals import Signal, liveliest_window
from vjm.report.interactive import _MOST_FRAMES, _frame_rows, arm_animation
from vjm.report.output import result_page


def animation_of(fit: Identification) -> tuple[dict[str, Any], RecordingComparison]:
    """The animation of an identification, and the recording that it shows."""
    motion = result_page(fit, []).animation
    assert motion is not None
    shown = next(each for each in fit.recordings if str(motion["recording"]).startswith(each.recording.file))
    return dict(motion), shown


def coordinates(paths: list[dict[str, list[float]]]) -> np.ndarray[Any, Any]:
    """(F, k, 2) of k moving points."""
    return np.stack([np.column_stack([path["x"], path["y"]]) for path in paths], axis=1)


def test_markers_are_drawn_where_they_were_measured_and_simulated() -> None:
    motion, shown = animation_of(demo_fit())
    assert motion["magnification"] == 1
    signal = Signal.of(demo_fit().model.rig, shown.recording)
    assert signal is not None
    rows = _frame_rows(shown.recording, liveliest_window(signal.time, signal.value))
    assert shown.simulated is not None
    simulated, measured = coordinates(motion["simulated"]), coordinates(motion["measured"])
    real = shown.simulated.simulation.markers[rows]
    scale = np.ptp(simulated[..., 1]) / np.ptp(real[..., 1])
    shift = simulated * [1, -1] - scale * real
    assert np.ptp(shift, axis=(0, 1)).max() < 0.5  # coordinates are rounded to a tenth
    offset = (measured - simulated) / scale * [1, -1]
    residual = shown.simulated.marker_residual[rows]
    assert np.abs(offset - residual).max() < 0.11 / scale
    assert np.corrcoef(offset.ravel(), residual.ravel())[0, 1] > 0.9


def test_the_arm_passes_through_its_markers() -> None:
    for fit in (demo_fit(), elbow_fit()):
        motion, _ = animation_of(fit)
        curves = {role: lines for role, _, lines in motion["curves"]}
        assert list(curves) == ["reference", "simulated"]
        markers = coordinates(motion["simulated"])
        for line, places in zip(curves["simulated"], markers, strict=True):
            points = np.array([[float(each) for each in pair.split(",")] for pair in line.split()])
            pieces = np.linspace(points[:-1], points[1:], 20, axis=1).reshape(-1, 2)
            distance = np.linalg.norm(pieces[None] - places[:, None], axis=-1).min(axis=1)
            assert distance.max() < 2  # of a picture 1,000 wide


def test_only_the_deflection_is_magnified() -> None:
    """An arm leaves its base at the joint's angle, however its deflection is magnified."""
    motion, shown = animation_of(elbow_fit())
    assert motion["magnification"] > 1
    signal = Signal.of(elbow_fit().model.rig, shown.recording)
    assert signal is not None
    assert shown.simulated is not None
    rows = _frame_rows(shown.recording, liveliest_window(signal.time, signal.value))
    lines = {role: lines for role, _, lines in motion["curves"]}["simulated"]
    ends = np.array([[[float(each) for each in pair.split(",")] for pair in line.split()[:2]] for line in lines])
    steps = (ends[:, 1] - ends[:, 0]) * [1, -1]
    angles = np.arctan2(steps[:, 1], steps[:, 0])
    assert np.abs(angles - shown.simulated.simulation.theta[rows, 0]).max() < 0.02  # coordinates are rounded


def test_small_deflections_are_magnified() -> None:
    fit = demo_fit()
    small = []
    for each in fit.recordings:
        simulated = each.simulated
        assert simulated is not None
        q = simulated.simulation.q / 50
        small.append(replace(each, simulated=replace(simulated, simulation=replace(simulated.simulation, q=q))))
    labels, models = {"simulated": "model"}, {"simulated": fit.model}
    motion = arm_animation(fit.model.rig, small, labels, models)
    assert motion is not None
    assert motion["magnification"] in (50, 100)


def test_a_marker_out_of_sight_is_not_drawn_there() -> None:
    motion, _ = animation_of(elbow_fit())
    seen = [path["seen"] for path in motion["measured"]]
    assert 0 in seen[2]  # occluded for a moment
    assert all(0 not in each for k, each in enumerate(seen) if k != 2)
    page = result_page(elbow_fit(), []).html()
    assert page.count('attributeName="opacity"') == 1


def test_a_held_out_recording_of_what_has_changed_is_shown() -> None:
    found = undecided()
    motion = result_page(found, []).animation
    assert motion is not None
    assert str(motion["recording"]).endswith("(held out)")
    held_out = [each for each in found.recordings if each.recording.role == "holdout"]
    earlier = tuple(
        replace(each, recording=replace(each.recording, condition="reference", file="earlier.csv")) for each in held_out
    )
    again = result_page(replace(found, recordings=(*earlier, *found.recordings)), []).animation
    assert again is not None
    assert again["recording"] == motion["recording"]


def test_nothing_is_animated_where_nothing_moves() -> None:
    fit = demo_fit()
    quiet = tuple(each for each in fit.recordings if each.recording.kind == "quiet")
    page = result_page(replace(fit, recordings=quiet), [])
    assert page.animation is None
    assert "<svg" not in page.html()


@pytest.mark.parametrize("name", ["demo", *DIAGNOSES])
def test_the_animation_is_light_and_stands_still_without_one(name: str) -> None:
    result = demo_fit() if name == "demo" else DIAGNOSES[name]()
    html = result_page(result, []).html()
    start, stop = html.index("<svg"), html.index("</svg>")
    assert stop - start < 3e5
    elements = Elements(html[start : stop + len("</svg>")])
    for tag, attributes in elements.found:
        if tag == "animate":
            counts = {attributes[name].count(";") + 1 for name in ("values", "keytimes")}  # type: ignore[union-attr]
            assert len(counts) == 1
            assert max(counts) <= _MOST_FRAMES
            assert attributes["repeatcount"] == "indefinite"
            times = [float(each) for each in str(attributes["keytimes"]).split(";")]
            assert times[0] == 0
            assert times[-1] == 1
            assert times == sorted(times)
        if tag in ("polyline", "circle"):
            assert attributes.get("points") or (attributes["cx"] and attributes["cy"])


def test_before_and_after_are_of_their_own_models() -> None:
    """A model with a delayed camera or with friction: its chain moves as it was simulated."""
    for found in (pair(), named()):
        motion = result_page(found, []).animation
        assert motion is not None
        (_, label, before), (_, other, after) = motion["curves"]
        assert (label, other) == ("without causes", "with causes")
        assert before != after
