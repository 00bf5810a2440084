"""What the model leaves: found at the marker and at the frequency at which it was put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.report.fits import demo_fit, elbow_fit
from tests.report.test_figures import figure_of
from vjm.identification.records import Identification, Whiteness
from vjm.records import RecordingComparison, SimulatedRecording
from vjm.report.figures.identification import identification_pictures
from vjm.report.figures.panels import Picture, Spectrum

Array = NDArray[np.float64]
_NOISE = 3e-4


def with_residual(fit: RecordingComparison, residual: Array) -> RecordingComparison:
    """Return the same recording, with another residual (T, k, 2) [m] of the model."""
    assert fit.simulated is not None
    markers = np.where(np.isfinite(fit.recording.markers), fit.simulated.simulation.markers + residual, np.nan)
    recording = replace(fit.recording, markers=markers)
    return replace(fit, recording=recording, simulated=replace(fit.simulated, recording=recording))


def noisy(fit: RecordingComparison, seed: int, more: Array | float = 0.0) -> RecordingComparison:
    """Return the recording with white noise of the camera's size, and something more."""
    shape = fit.recording.markers.shape
    return with_residual(fit, _NOISE * np.random.default_rng(seed).standard_normal(shape) + more)


def with_markers(fit: RecordingComparison, markers: Array) -> SimulatedRecording:
    """Return the simulation beside other measured markers."""
    assert fit.simulated is not None
    return replace(fit.simulated, recording=replace(fit.recording, markers=markers))


def residual_pictures(fit: Identification) -> list[Picture]:
    """Draw the residuals, without the data."""
    bare = replace(fit, torque_data=(), experiment=replace(fit.experiment, recordings=fit.experiment.recordings[:1]))
    return [each for each in identification_pictures(bare) if each.name.startswith("residual")]


def cells(fit: Identification) -> tuple[list[str], Array]:
    """Return the names of the columns of the residual map, and its values."""
    (axes,) = figure_of(residual_pictures(fit), "residual_map").axes
    (mesh,) = axes.collections
    names = [label.get_text().replace(" ", ".") for label in axes.get_xticklabels()]
    return names, np.ma.filled(mesh.get_array(), np.nan).reshape(len(axes.get_yticks()), len(names))  # type: ignore[arg-type]


def white(fit: Identification) -> Identification:
    return replace(fit, recordings=tuple(noisy(each, k) for k, each in enumerate(fit.recordings)))


def sine(fit: RecordingComparison, frequency: float, amplitude: float) -> Array:
    wave = amplitude * np.sin(2 * np.pi * frequency * fit.recording.time)
    return np.broadcast_to(wave[:, None, None], fit.recording.markers.shape)


def test_a_sine_stands_at_its_frequency_with_its_amplitude() -> None:
    fit = demo_fit().recordings[1]
    step = float(np.median(np.diff(fit.recording.time)))
    frequency = 30 / (step * fit.recording.time.size)  # a line of the spectrum
    wave = with_residual(fit, sine(fit, frequency, 2e-3)).recording.markers
    lost = wave.copy()
    lost[np.random.default_rng(0).random(lost.shape[:2]) < 0.3] = np.nan
    for markers, tolerance in ((wave, 1e-6), (lost, 0.05)):
        spectrum = Spectrum.of(with_markers(fit, markers))
        assert spectrum is not None
        peak = int(np.argmax(spectrum.amplitude))
        assert spectrum.frequency[peak] == pytest.approx(frequency, rel=1e-3)
        assert spectrum.amplitude[peak] == pytest.approx(2e-3, rel=tolerance)


def test_white_noise_lies_on_its_level_and_below_its_limit() -> None:
    fit = demo_fit().recordings[1]
    passed = 0
    for seed in range(40):
        simulated = noisy(fit, seed).simulated
        assert simulated is not None
        spectrum = Spectrum.of(simulated)
        assert spectrum is not None
        assert float(np.sqrt(np.mean(spectrum.amplitude**2))) == pytest.approx(spectrum.white, rel=0.1)
        passed += bool((spectrum.amplitude > spectrum.limit).any())
    assert passed <= 1


def test_a_recording_of_a_few_frames_has_no_spectrum() -> None:
    fit = demo_fit().recordings[1]
    markers = np.full_like(fit.recording.markers, np.nan)
    assert Spectrum.of(with_markers(fit, markers)) is None
    markers[:5] = 0.0
    assert Spectrum.of(with_markers(fit, markers)) is None


def test_a_marker_that_is_hardly_seen_does_not_count() -> None:
    fit = noisy(demo_fit().recordings[1], 0)
    markers = fit.recording.markers.copy()
    markers[3:, 0] = np.nan
    markers[:3, 0] = 0.5
    spectrum = Spectrum.of(with_markers(fit, markers))
    assert spectrum is not None
    assert spectrum.amplitude.max() < spectrum.limit


def test_a_marker_that_is_off_shows_in_its_cell() -> None:
    fit = white(demo_fit())
    off = np.zeros(fit.recordings[2].recording.markers.shape)
    off[:, 3, 1] = 5 * _NOISE
    recordings = list(fit.recordings)
    recordings[2] = noisy(recordings[2], 2, off)
    changed = replace(fit, recordings=tuple(recordings))
    names, table = cells(changed)
    assert table.shape == (4, 10)
    assert names[7] == "m4.y"
    assert table[2, 7] == pytest.approx(26**0.5, rel=0.05)
    assert (table > 1.3).sum() == 1
    title = residual_pictures(changed)[0].alternative
    assert "beam.m4.y in second_mode.csv" in title
    assert "within noise" not in title


def test_columns_are_what_was_measured() -> None:
    names, table = cells(elbow_fit())
    assert names == [f"upper.m{k}.{axis}" for k in (1, 2, 3) for axis in "xy"] + [f"fore.m{k}.y" for k in (1, 2, 3, 4)]
    comparison = elbow_fit().recordings[1]
    assert comparison.simulated is not None
    residual = comparison.simulated.marker_residual / comparison.noise[0]
    assert table[1, 0] == pytest.approx(np.sqrt(np.mean(residual[:, 0, 0] ** 2)))
    assert table[1, 4] == pytest.approx(np.sqrt(np.nanmean(residual[:, 2, 0] ** 2)))  # occluded for a moment


def test_coordinates_of_many_markers_are_pooled() -> None:
    fit = demo_fit()
    rig = replace(
        fit.model.rig, links=(replace(fit.model.rig.links[0], markers=(0.1, 0.2, 0.3, 0.4, 0.6, 0.7, 0.8, 1.0)),)
    )
    wide = tuple(
        noisy(RecordingComparison(widened(each).recording, each.noise, widened(each)), k)
        for k, each in enumerate(fit.recordings)
    )
    experiment = replace(fit.experiment, rig=rig, recordings=tuple(each.recording for each in wide))
    names, table = cells(replace(fit, experiment=experiment, model=replace(fit.model, rig=rig), recordings=wide))
    assert names == [f"m{k}" for k in range(1, 9)]
    assert table == pytest.approx(np.ones((4, 8)), abs=0.3)


def widened(fit: RecordingComparison) -> SimulatedRecording:
    """Return the simulation with eight markers."""
    assert fit.simulated is not None
    wide = [0, 1, 2, 3, 4, 0, 1, 4]
    recording = replace(fit.recording, markers=fit.recording.markers[:, wide])
    simulation = replace(fit.simulated.simulation, markers=fit.simulated.simulation.markers[:, wide])
    return replace(fit.simulated, recording=recording, simulation=simulation)


def test_titles_say_that_nothing_is_missing() -> None:
    table, spectra = residual_pictures(white(demo_fit()))
    assert "within noise" in table.alternative
    assert "no peak above noise" in spectra.alternative
    assert {axes.get_title("left").split(": ")[1] for axes in spectra.figure.axes} == {"noise only"}


@pytest.mark.parametrize(
    ("frequency", "words"), [(None, "Hz (mode 2) in both_modes.csv"), (3.0, "at 2.99 Hz in"), (0.0, "(drift)")]
)
def test_title_says_where_something_is_missing(frequency: float | None, words: str) -> None:
    fit = white(demo_fit())
    second = float(fit.model.modes().frequencies[1])
    recordings = list(fit.recordings)
    more = sine(recordings[3], second if frequency is None else frequency, 5e-4)
    if frequency == 0.0:
        more = np.broadcast_to(np.linspace(-2e-3, 2e-3, len(more))[:, None, None], more.shape)
    recordings[3] = noisy(recordings[3], 3, more)
    title = residual_pictures(replace(fit, recordings=tuple(recordings)))[1].alternative
    assert words in title
    assert "both_modes.csv" in title
    if frequency is not None:
        assert "(mode" not in title


def test_a_peak_is_named_only_where_the_table_finds_no_white_residual() -> None:
    fit = white(demo_fit())
    recordings = list(fit.recordings)
    recordings[3] = noisy(recordings[3], 3, sine(recordings[3], 3.0, 5e-4))
    called = Whiteness(recordings[3].recording.file, 1.0, 0.0, correlated=False, excessive=False)
    for whiteness, words in (((), "at 2.99 Hz in"), ((called,), "no peak above noise")):
        changed = replace(fit, recordings=tuple(recordings), whiteness=whiteness)
        assert words in residual_pictures(changed)[1].alternative


def test_spectra_mark_the_natural_frequencies_that_the_camera_sees() -> None:
    fit = demo_fit()
    marked = [
        line.get_xdata()[0]  # type: ignore[index]
        for line in figure_of(residual_pictures(fit), "residual_spectra").axes[0].lines
        if len(set(line.get_xdata())) == 1  # type: ignore[arg-type]
    ]
    assert marked == pytest.approx(fit.model.modes().frequencies[:2].tolist())


def test_nothing_simulated_has_no_residuals() -> None:
    fit = demo_fit()
    assert (
        residual_pictures(replace(fit, recordings=tuple(replace(each, simulated=None) for each in fit.recordings)))
        == []
    )
