"""Plots that users make from a result, on axes of their own if they like."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from numpy.typing import NDArray

from vjm.errors import ChoiceError, InsufficientDataError
from vjm.records import Array, Recording, RecordingComparison, SimulatedRecording
from vjm.report.text import short

AxesArray = NDArray[Any]  # of matplotlib Axes


def plot_fit(
    comparisons: Sequence[RecordingComparison], recording: Recording | str | None = None, ax: Axes | None = None
) -> AxesArray:
    """Plot the coordinate that moves most of each recording's markers, measured and simulated, in [mm] against [s].

    Args:
        comparisons: recordings beside their simulations.
        recording: the only one to plot, or the name of its file; None: all (into `ax`, the first one).
        ax: axes to draw into; None: a new figure.

    Returns:
        (k,) axes, one for each recording.

    Raises:
        ChoiceError: a recording that is not among them.
        InsufficientDataError: no recording could be simulated.
    """
    chosen, axes = _chosen(comparisons, recording, ax)
    for one, (comparison, simulated) in zip(axes, chosen, strict=True):
        frames, index = simulated.recording.frames, _liveliest(simulated)
        both = (simulated.recording.markers, simulated.simulation.markers)
        measured, model = (1e3 * markers[frames][:, *index] for markers in both)
        time = simulated.recording.time[frames]
        one.plot(time, measured, ".", color="0.6", markersize=3, label="measured")
        one.plot(time, model, linewidth=1.0, label="simulated")
        one.set(title=short(comparison.recording.file), ylabel=f"marker {index[0] + 1}, {'xy'[index[1]]} [mm]")
    return _finished(axes)


def plot_residuals(
    comparisons: Sequence[RecordingComparison], recording: Recording | str | None = None, ax: Axes | None = None
) -> AxesArray:
    """Plot measured minus simulated marker coordinates of each recording in [mm] against [s], and the noise.

    Args:
        comparisons, recording, ax: as of `plot_fit`, which raises the same errors.

    Returns:
        (k,) axes, one for each recording.
    """
    chosen, axes = _chosen(comparisons, recording, ax)
    for one, (comparison, simulated) in zip(axes, chosen, strict=True):
        frames, sigma = simulated.recording.frames, 1e3 * comparison.noise[0]
        residual = 1e3 * simulated.marker_residual[frames].reshape(frames.size, -1)
        one.axhspan(-2 * sigma, 2 * sigma, color="0.85", label="±2σ noise")
        one.plot(simulated.recording.time[frames], residual, ".", markersize=2)
        one.set(title=short(comparison.recording.file), ylabel="residual [mm]")
    return _finished(axes)


def _chosen(
    comparisons: Sequence[RecordingComparison], recording: Recording | str | None, ax: Axes | None
) -> tuple[list[tuple[RecordingComparison, SimulatedRecording]], AxesArray]:
    """Return the recordings to plot with their simulations, and the axes to plot them into."""
    name = recording.file if isinstance(recording, Recording) else recording
    files = [item.recording.file for item in comparisons]
    if name is not None and name not in files:
        raise ChoiceError("recording", name, files)
    asked = [item for item in comparisons if name in (None, item.recording.file)]
    chosen = [(item, item.simulated) for item in asked if item.simulated is not None]
    if not chosen:
        reason = asked[0].problem if asked else "there is no recording"
        raise InsufficientDataError("plot", f"no recording could be simulated: {reason}", "choose another recording")
    if ax is not None:
        return chosen[:1], np.array([ax])
    _, axes = pyplot.subplots(len(chosen), figsize=(8, 2.2 * len(chosen)), squeeze=False, layout="constrained")
    return chosen, axes[:, 0]


def _liveliest(simulated: SimulatedRecording) -> tuple[int, int]:
    """Return marker and coordinate whose measured values spread most."""
    markers: Array = simulated.recording.markers[simulated.recording.frames]
    counts = np.isfinite(markers).sum(axis=0)
    spread = np.where(counts > 1, np.nanstd(np.where(counts > 1, markers, 0.0), axis=0), -1.0)
    marker, coordinate = np.unravel_index(int(spread.argmax()), spread.shape)
    return int(marker), int(coordinate)


def _finished(axes: AxesArray) -> AxesArray:
    axes[-1].set_xlabel("time [s]")
    axes[0].legend(loc="upper right")
    return axes
