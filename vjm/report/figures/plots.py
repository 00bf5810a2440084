"""Plots that users make from a result, on axes of their own if they like."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from numpy.typing import NDArray

from vjm.errors import ChoiceError, InsufficientDataError
from vjm.records import Recording, RecordingComparison, Rig
from vjm.report.figures.panels import Curve, motion_panel, recording_label, residual_panel
from vjm.report.figures.selection import Signal
from vjm.report.figures.style import IDENTIFIED

AxesArray = NDArray[Any]  # of matplotlib Axes
_Panel = tuple[Axes, Signal, list[Curve], RecordingComparison]


def plot_fit(
    rig: Rig, comparisons: Sequence[RecordingComparison], recording: Recording | str | None, ax: Axes | None
) -> AxesArray:
    """Plot the outermost measured signal of each recording, measured and simulated, against time.

    Args:
        rig: names the markers.
        comparisons: recordings beside their simulations.
        recording: the only one to plot, or the name of its file; None: all (into `ax`, the first one).
        ax: axes to draw into; None: a new figure.

    Returns:
        (k,) axes, one for each recording.

    Raises:
        ChoiceError: a recording that is not among them.
        InsufficientDataError: no recording could be simulated.
    """
    panels = list(_panels(rig, comparisons, recording, ax))
    for axes, signal, curves, item in panels:
        motion_panel(axes, signal, curves)
        axes.set_title(recording_label(item.recording))
        axes.legend(loc="upper right")
    return np.array([axes for axes, *_ in panels])


def plot_residuals(
    rig: Rig, comparisons: Sequence[RecordingComparison], recording: Recording | str | None, ax: Axes | None
) -> AxesArray:
    """Plot measured minus simulated values of the outermost signal of each recording, and the noise, against time.

    Args:
        rig, comparisons, recording, ax: as of `plot_fit`, which raises the same errors.

    Returns:
        (k,) axes, one for each recording.
    """
    panels = list(_panels(rig, comparisons, recording, ax))
    for axes, signal, curves, item in panels:
        residual_panel(axes, signal, curves, item.noise)
        axes.set_title(recording_label(item.recording))
        axes.legend(loc="upper right")
    return np.array([axes for axes, *_ in panels])


def _panels(
    rig: Rig, comparisons: Sequence[RecordingComparison], recording: Recording | str | None, ax: Axes | None
) -> Iterator[_Panel]:
    """Give for each recording that is plotted its axes, its signal, its simulation and itself."""
    name = recording.file if isinstance(recording, Recording) else recording
    files = [item.recording.file for item in comparisons]
    if name is not None and name not in files:
        raise ChoiceError("recording", name, files)
    asked = [item for item in comparisons if name in (None, item.recording.file)]
    pairs = [(item, Signal.of(rig, item.recording)) for item in asked]
    chosen = [(item, signal) for item, signal in pairs if item.simulated is not None and signal is not None]
    if not chosen:
        reason = (asked[0].problem if asked else "") or "nothing was measured"
        raise InsufficientDataError("plot", f"no recording could be simulated: {reason}", "choose another recording")
    if ax is None:
        _, new = pyplot.subplots(len(chosen), figsize=(8, 2.5 * len(chosen)), squeeze=False, layout="constrained")
    for axes, (item, signal) in zip([ax] if ax is not None else new[:, 0], chosen, strict=False):
        assert item.simulated is not None
        yield axes, signal, [Curve(item.simulated, "simulated", {"color": IDENTIFIED})], item
