"""The numbers that a page embeds are those of the records, to a tenth of the noise, and not many."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.report.diagnoses import named, nothing, undecided
from tests.report.fits import demo_fit, elbow_fit
from tests.report.test_page import Elements
from vjm.diagnosis.records import Diagnosis
from vjm.identification.records import Identification
from vjm.records import Recording, SimulatedRecording, Simulation
from vjm.report import interactive
from vjm.report.interactive import _extreme_rows, time_histories
from vjm.report.output import result_page
from vjm.report.text import recording_label


@pytest.mark.parametrize("result", [demo_fit, elbow_fit, pytest.param(undecided, marks=pytest.mark.slow), nothing])
def test_embedded_numbers_are_those_of_the_records(result: object) -> None:
    assert callable(result)
    found: Identification | Diagnosis = result()
    text, _ = Elements(result_page(found, []).html()).scripts
    data = json.loads(text)
    shown = [each for each in found.recordings if each.reference is not None]
    assert [each["label"] for each in data["recordings"]] == [recording_label(each.recording) for each in shown]
    assert not data["thinned"]
    columns = [name for link in found.experiment.rig.links for name in link.marker_columns]
    joints = [f"{found.experiment.rig.links[k].name}.theta" for k in found.experiment.rig.active_links]
    for own, comparison in zip(data["recordings"], shown, strict=True):
        recording = comparison.recording
        measured = [*recording.markers.reshape(len(recording.time), -1).T, *recording.theta.T]
        values = dict(zip([*columns, *joints], measured, strict=True))
        assert [each["name"] for each in own["signals"]] == [n for n, v in values.items() if np.isfinite(v).any()]
        for signal in own["signals"]:
            known = np.isfinite(values[signal["name"]])
            step = np.diff(recording.time).min()
            assert np.allclose(own["times"][signal["time"]], recording.time[known], rtol=0, atol=5e-3 * step)
            is_marker = signal["unit"] == "mm"
            factor, noise = (1e3, comparison.noise[0]) if is_marker else (180 / np.pi, comparison.noise[1])
            assert np.isclose(signal["step"], 0.1 * factor * noise)
            exact = {"measured": values[signal["name"]]}
            for role in data["labels"]:
                simulation = getattr(comparison, role).simulation
                flat = [*simulation.markers.reshape(len(recording.time), -1).T, *simulation.theta.T]
                exact[role] = flat[[*columns, *joints].index(signal["name"])]
            for name, wanted in exact.items():
                error = np.array(signal[name]) * signal["step"] - factor * wanted[known]
                assert np.abs(error).max() <= 0.501 * signal["step"], (signal["name"], name)


def test_the_plot_begins_with_the_recording_of_the_animation() -> None:
    page = result_page(named(), [])
    (plots,) = [section.plots for section in page.sections if section.plots]
    assert page.animation is not None
    assert plots["recordings"][plots["first"]]["label"] == page.animation["recording"]
    assert plots["recordings"][plots["first"]]["first"] == "beam.m5.y"


@given(st.integers(1, 3), st.integers(2, 400), st.integers(10, 200), st.randoms(use_true_random=False))
def test_thinned_rows_keep_the_extremes(columns: int, count: int, most: int, random: object) -> None:
    seed = random.randrange(1000)  # type: ignore[attr-defined]
    values = np.random.default_rng(seed).standard_normal((count, columns))
    rows = _extreme_rows(values, most)
    assert len(rows) <= most
    assert (np.diff(rows) > 0).all()
    assert rows[0] == 0
    assert rows[-1] == count - 1
    assert (values[rows].max(axis=0) == values.max(axis=0)).all()
    assert (values[rows].min(axis=0) == values.min(axis=0)).all()


def longer(fit: Identification, times: int) -> Identification:
    """The same, its recordings so many times as long."""

    def recording(one: Recording) -> Recording:
        length = one.time[-1] + np.diff(one.time).mean()
        time = np.concatenate([one.time + k * length for k in range(times)])
        arrays = {name: np.tile(getattr(one, name), (times, 1)) for name in ("theta", "tau")}
        return replace(one, time=time, markers=np.tile(one.markers, (times, 1, 1)), **arrays)

    def simulated(one: SimulatedRecording) -> SimulatedRecording:
        own = recording(one.recording)
        own_parts = {name: np.tile(getattr(one.simulation, name), (times, 1)) for name in ("q", "v", "theta")}
        simulation = Simulation(own.time, **own_parts, markers=np.tile(one.simulation.markers, (times, 1, 1)))
        return replace(one, recording=own, simulation=simulation)

    comparisons = []
    for each in fit.recordings:
        assert each.simulated is not None
        assert each.reference is not None
        both = {"simulated": simulated(each.simulated), "reference": simulated(each.reference)}
        comparisons.append(replace(each, recording=recording(each.recording), **both))
    return replace(fit, recordings=tuple(comparisons))


def test_long_recordings_are_thinned() -> None:
    fit = longer(demo_fit(), 40)
    page = result_page(fit, []).html()
    text, _ = Elements(page).scripts
    assert "Long recordings are thinned" in page
    assert len(text) < 3e6
    data = json.loads(text)
    moved = data["recordings"][data["first"]]
    assert all(len(times) <= interactive._MOST_INSTANTS for times in moved["times"])
    tip = moved["signals"][-1]
    recording = next(each.recording for each in fit.recordings if recording_label(each.recording) == moved["label"])
    assert tip["name"] == "beam.m5.y"
    for extreme in (np.min, np.max):
        wanted = 1e3 * extreme(recording.markers[:, 4, 1])
        assert abs(extreme(tip["measured"]) * tip["step"] - wanted) <= 0.501 * tip["step"]


def test_of_very_many_recordings_those_are_left_out_that_tell_least() -> None:
    fit = demo_fit()
    many = fit.recordings * 20
    data = time_histories(fit.model.rig, many, {"reference": "nominal model", "simulated": "identified model"})
    assert data is not None
    assert data["left_out"] == len(many) - len(data["recordings"]) > 0
    assert "both_modes.csv (held out)" in [each["label"] for each in data["recordings"]]
    assert "quiet.csv (train)" not in [each["label"] for each in data["recordings"]]
    assert len(json.dumps(data)) < 4e6
