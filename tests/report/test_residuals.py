"""What the model leaves: found at the marker and at the frequency at which it was put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.report.fits import demo_fit, elbow_fit
from vjm.identification.records import Identification
from vjm.records import RecordingComparison
from vjm.report.figures.residuals import columns, misfit, residual_map, residual_spectra, spectrum

Array = NDArray[np.float64]
_NOISE = 3e-4


def with_residual(fit: RecordingComparison, left: Array) -> RecordingComparison:
    """The same recording, which the model misses by this much (T, k, 2) [m]."""
    assert fit.simulated is not None
    markers = np.where(np.isfinite(fit.recording.markers), fit.simulated.simulation.markers + left, np.nan)
    return replace(fit, recording=replace(fit.recording, markers=markers))


def noisy(fit: RecordingComparison, seed: int, more: Array | float = 0.0) -> RecordingComparison:
    """The recording with white noise of the camera's size, and something more."""
    shape = fit.recording.markers.shape
    return with_residual(fit, _NOISE * np.random.default_rng(seed).standard_normal(shape) + more)


def white(fit: Identification) -> Identification:
    return replace(fit, recordings=tuple(noisy(each, k) for k, each in enumerate(fit.recordings)))


def sine(fit: RecordingComparison, frequency: float, amplitude: float) -> Array:
    wave = amplitude * np.sin(2 * np.pi * frequency * fit.recording.time)
    return np.broadcast_to(wave[:, None, None], fit.recording.markers.shape)


def test_a_sine_stands_at_its_frequency_with_its_amplitude() -> None:
    fit = demo_fit().recordings[1]
    assert fit.simulated is not None
    step = float(np.median(np.diff(fit.recording.time)))
    frequency = 30 / (step * fit.recording.time.size)  # a line of the spectrum
    wave = with_residual(fit, sine(fit, frequency, 2e-3))
    lost = wave.recording.markers.copy()
    lost[np.random.default_rng(0).random(lost.shape[:2]) < 0.3] = np.nan
    for recording, tolerance in ((wave.recording, 1e-6), (replace(wave.recording, markers=lost), 0.05)):
        found = spectrum(recording, fit.simulated, _NOISE)
        assert found is not None
        peak = int(np.argmax(found.amplitude))
        assert found.frequency[peak] == pytest.approx(frequency, rel=1e-3)
        assert found.amplitude[peak] == pytest.approx(2e-3, rel=tolerance)


def test_white_noise_lies_on_its_level_and_below_its_limit() -> None:
    fit = demo_fit().recordings[1]
    assert fit.simulated is not None
    passed = 0
    for seed in range(40):
        found = spectrum(noisy(fit, seed).recording, fit.simulated, _NOISE)
        assert found is not None
        assert float(np.sqrt(np.mean(found.amplitude**2))) == pytest.approx(found.white, rel=0.1)
        passed += bool((found.amplitude > found.limit).any())
    assert passed <= 1


def test_a_recording_of_a_few_frames_has_no_spectrum() -> None:
    fit = demo_fit().recordings[1]
    assert fit.simulated is not None
    markers = np.full_like(fit.recording.markers, np.nan)
    markers[:5] = 0.0
    assert spectrum(replace(fit.recording, markers=markers), fit.simulated, _NOISE) is None


def test_a_marker_that_is_hardly_seen_does_not_count() -> None:
    fit = noisy(demo_fit().recordings[1], 0)
    assert fit.simulated is not None
    markers = fit.recording.markers.copy()
    markers[3:, 0] = np.nan
    markers[:3, 0] = 0.5
    found = spectrum(replace(fit.recording, markers=markers), fit.simulated, _NOISE)
    assert found is not None
    assert found.amplitude.max() < found.limit


def test_a_marker_that_is_off_shows_in_its_cell() -> None:
    fit = white(demo_fit())
    off = np.zeros(fit.recordings[2].recording.markers.shape)
    off[:, 3, 1] = 5 * _NOISE
    fits = list(fit.recordings)
    fits[2] = noisy(fits[2], 2, off)
    table, limit = misfit(fits, columns(fit.model.rig, fits, 14))
    assert table.shape == (4, 10)
    assert table[2, 7] == pytest.approx(26**0.5, rel=0.05)
    assert (table > np.maximum(limit, 1.1)).sum() == 1
    title = residual_map(fit.model, fits).texts[0].get_text()
    assert "beam.m4.y in second_mode.csv" in title.replace("\n", " ")
    assert "within the noise" not in title


def test_columns_are_what_was_measured_and_pooled_where_there_are_many() -> None:
    fit = elbow_fit()
    shown = [each for each in fit.recordings if each.simulated is not None]
    names = [column.name for column in columns(fit.model.rig, shown, 14)]
    assert names == [f"upper.m{k}.{axis}" for k in (1, 2, 3) for axis in "xy"] + [f"fore.m{k}.y" for k in (1, 2, 3, 4)]
    pooled = columns(fit.model.rig, shown, 9)
    assert [column.name for column in pooled] == [f"upper.m{k}" for k in (1, 2, 3)] + [
        f"fore.m{k}" for k in range(1, 5)
    ]
    assert [column.axes for column in pooled] == [(0, 1)] * 3 + [(1,)] * 4


def test_titles_say_that_nothing_is_missing() -> None:
    fit = white(demo_fit())
    assert "within the noise" in residual_map(fit.model, fit.recordings).texts[0].get_text()
    figure = residual_spectra(fit.model, fit.recordings)
    assert figure is not None
    assert "no frequency" in figure.texts[0].get_text()
    assert {axes.get_title("left").split(": ")[1] for axes in figure.axes} == {"nothing but noise"}


@pytest.mark.parametrize(
    ("frequency", "words"), [(None, "Hz (mode 2), in both_modes.csv"), (3.0, "at 2.99 Hz, in"), (0.0, "(drift)")]
)
def test_title_says_where_something_is_missing(frequency: float | None, words: str) -> None:
    fit = white(demo_fit())
    second = float(fit.model.modes().frequencies[1])
    fits = list(fit.recordings)
    more = sine(fits[3], second if frequency is None else frequency, 5e-4)
    if frequency == 0.0:
        more = np.broadcast_to(np.linspace(-2e-3, 2e-3, len(more))[:, None, None], more.shape)
    fits[3] = noisy(fits[3], 3, more)
    figure = residual_spectra(fit.model, fits)
    assert figure is not None
    title = figure.texts[0].get_text().replace("\n", " ")
    assert words in title
    assert "both_modes.csv" in title
    if frequency is not None:
        assert "(mode" not in title


def test_spectra_mark_the_natural_frequencies_that_the_camera_sees() -> None:
    fit = demo_fit()
    figure = residual_spectra(fit.model, fit.recordings)
    assert figure is not None
    marked = [
        line.get_xdata()[0]  # type: ignore[index]
        for line in figure.axes[0].lines
        if len(set(line.get_xdata())) == 1  # type: ignore[arg-type]
    ]
    assert marked == pytest.approx(fit.model.modes().frequencies[:2].tolist())


def test_nothing_replayed_has_no_spectra() -> None:
    fit = demo_fit()
    assert residual_spectra(fit.model, [replace(each, simulated=None) for each in fit.recordings]) is None
