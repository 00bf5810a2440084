"""Panels that figures and plots are made of: time histories, residuals, spectra, and the RMS of many recordings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import CubicHermiteSpline

from vjm.errors import ChoiceError, InsufficientDataError
from vjm.records import Array, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.report.figures.selection import Signal, Window
from vjm.report.figures.style import (
    AXIS,
    BAND,
    IDENTIFIED,
    MEASURED,
    NOMINAL,
    TORQUE,
    Page,
    log_scale,
    printable,
    styled,
)
from vjm.report.text import short
from vjm.simulation.measurement import MarkerArcs
from vjm.simulation.model import Model

Role = Literal["reference", "alternative", "simulated"]  # the simulations of a RecordingComparison
# The line and the marker of each; what is judged is drawn last and lies on top.
_LOOKS: dict[Role, tuple[dict[str, Any], dict[str, Any]]] = {
    "reference": ({"linestyle": (0, (4, 2))}, {"color": NOMINAL, "marker": "s", "markerfacecolor": "white"}),
    "alternative": ({"linestyle": "-"}, {"color": TORQUE, "marker": "D", "markersize": 7}),
    "simulated": ({"linestyle": "-"}, {"color": IDENTIFIED, "marker": "o"}),
}
FALSE_ALARM = 1e-3  # probability that white noise passes a limit anywhere in one recording


@dataclass(frozen=True)
class Curve:
    """A simulation of a recording as panels draw it.

    Attributes:
        simulated: the simulation.
        label: the model's name.
        look: `color` and `linestyle`.
        model: for the motion between the camera's frames; None: it is drawn at the frames only.
    """

    simulated: SimulatedRecording
    label: str
    look: Mapping[str, Any]
    model: Model | None = None

    @classmethod
    def of(
        cls, comparison: RecordingComparison, labels: Mapping[Role, str], models: Mapping[Role, Model]
    ) -> dict[Role, Curve]:
        """Return the simulations of a recording in the order in which they are drawn.

        Args:
            comparison: a recording and its simulations.
            labels: names of the models.
            models: the models.
        """
        curves: dict[Role, Curve] = {}
        for role, (line, marker) in _LOOKS.items():
            simulated = getattr(comparison, role)
            if simulated is not None:
                curves[role] = cls(simulated, labels[role], {"color": marker["color"], **line}, models.get(role))
        return curves


def motion_panel(
    axes: Axes, signal: Signal, curves: Sequence[Curve], window: Window | None = None, most_circles: int = 170
) -> None:
    """Draw a measured signal and simulations of it against time.

    Args:
        axes: to draw into.
        signal: as measured.
        curves: the simulations, the one on which the others are drawn last.
        window: first and last instant [s]; None: all.
        most_circles: so many frames at most are drawn as circles; more of them as a broad grey line.
    """
    start, stop = window or (float(signal.time[0]), float(signal.time[-1]))
    inside = (signal.time >= start) & (signal.time <= stop)
    scale, unit = signal.unit
    look: dict[str, Any] = {"color": "#bdbdbd", "linewidth": 4.0, "solid_capstyle": "round"}
    if np.count_nonzero(inside) <= most_circles:
        look = {"linestyle": "", "marker": "o", "markersize": 4.5, "markerfacecolor": "white", "color": MEASURED}
    axes.plot(signal.time[inside], scale * signal.value[inside], label="measured", **look)
    for curve in reversed(curves):
        time, value = _simulated_signal(curve, signal, (start, stop))
        axes.plot(time, scale * value, label=curve.label, **curve.look)
    axes.set(xlabel="time [s]", ylabel=f"{printable(short(signal.name, 20))} [{unit}]")


def _simulated_signal(curve: Curve, signal: Signal, window: Window) -> tuple[Array, Array]:
    """Return a simulated signal, as the sensor shows it, at closely spaced instants: frames may be far apart."""
    simulation, model = curve.simulated.simulation, curve.model
    if model is None or not signal.is_marker:
        inside = (simulation.time >= window[0]) & (simulation.time <= window[1])
        values = simulation.markers if signal.is_marker else simulation.theta
        return simulation.time[inside], np.moveaxis(values, 0, -1)[signal.index][inside]
    arm, arcs, time = model.arm_in(curve.simulated.recording), MarkerArcs.of(model.rig), np.linspace(*window, 800)
    path = CubicHermiteSpline(simulation.time, simulation.q, simulation.v)
    instants, stamps, positions = time, time - simulation.time[0], arcs.positions(arm.chain, path(time))
    for effect in arm.sensors:
        instants = instants + (effect.camera_instants(stamps, positions).T - stamps)
    markers = arcs.measured_positions(arm, path(np.clip(instants, simulation.time[0], simulation.time[-1])))
    return time, np.moveaxis(markers, 0, -1)[signal.index]


def residual_panel(
    axes: Axes, signal: Signal, curves: Sequence[Curve], noise: tuple[float, float], windows: Sequence[Window] = ()
) -> None:
    """Draw measured minus simulated values of a signal over the whole recording, beside the noise.

    Args:
        axes: to draw into.
        signal: as measured.
        curves: the simulations.
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        windows: of the motion panels, shaded where they are not the whole recording.
    """
    scale, unit = signal.unit
    sigma = scale * (noise[0] if signal.is_marker else noise[1])
    for start, stop in windows:
        if stop - start < 0.99 * (signal.time[-1] - signal.time[0]):
            axes.axvspan(start, stop, color="#fbeeda", linewidth=0, label="shown above")
    axes.axhspan(-2 * sigma, 2 * sigma, color=BAND, linewidth=0, label="±2σ noise")
    axes.axhline(0.0, color=AXIS, linewidth=0.6)
    largest = 4 * sigma
    for curve in curves:
        values = scale * signal.residual(curve.simulated)
        axes.plot(signal.time, values, color=curve.look["color"], linewidth=0.9, label=curve.label)
        largest = max(largest, 1.08 * float(np.nanmax(np.abs(values), initial=0.0)))
    axes.set_ylim(-largest, largest)
    axes.set(xlabel="time [s]", ylabel=f"residual [{unit}]", title="Measured minus simulated, whole recording")


@styled
def motion_figure(
    title: str, noise: tuple[float, float], signal: Signal, motion: Sequence[Curve], residuals: Sequence[Curve],
    windows: Sequence[tuple[Window, str]],
) -> Figure:  # fmt: skip
    """Draw a measured signal and simulations of it in one or two windows [s] with headings; below, the residuals.

    `noise` is 1-sigma of a marker coordinate [m] and of an encoder [rad].
    """
    page = Page.of(title, [(2.6, len(windows)), (1.75, 1)])
    panels, (lowest,) = page.axes
    for axes, (window, heading) in zip(panels, windows, strict=True):
        motion_panel(axes, signal, motion, window, 170 // len(windows))
        axes.set_title(printable(heading))
    limits = np.array([axes.get_ylim() for axes in panels])
    for axes in panels:
        axes.set_ylim(limits.min(), limits.max())
    residual_panel(lowest, signal, residuals, noise, [window for window, _ in windows])
    page.legend()
    return page.figure


@dataclass(frozen=True)
class Spectrum:
    """Amplitude of a residual, RMS over all marker coordinates; a sine of amplitude a is a line of height a.

    Attributes:
        frequency: (F,) from one period in the recording up to half the camera's rate [Hz].
        amplitude: (F,) [m].
        white: what white noise of the camera's size would give [m].
        limit: what it would pass anywhere in one recording of a thousand [m].
    """

    frequency: Array
    amplitude: Array
    white: float
    limit: float

    @classmethod
    def of(cls, simulated: SimulatedRecording) -> Spectrum | None:
        """Return the spectrum of the markers' residuals; None where too little was measured.

        Values that were not measured count as zeros, and amplitudes are scaled by the number of those that were.
        """
        rows, least_values = simulated.recording.frames, 8
        if rows.size < least_values:
            return None
        residual = simulated.marker_residual[rows].reshape(rows.size, -1)
        counts = np.isfinite(residual).sum(axis=0)
        kept = counts >= least_values
        if not kept.any():
            return None
        time = simulated.recording.time[rows]
        step = float(np.median(np.diff(time)))
        place = np.round((time - time[0]) / step).astype(int)  # frames that the camera dropped leave gaps
        even = np.zeros((int(place[-1]) + 1, int(kept.sum())))
        even[place] = np.nan_to_num(residual[:, kept])
        power: Array = np.mean(np.abs(np.fft.rfft(even, axis=0)[1:-1] * (2 / counts[kept])) ** 2, axis=1)
        # The mean of c squared magnitudes of white noise is chi-squared with 2 c degrees of freedom.
        white = simulated.noise[0] ** 2 * float(np.mean(4 / counts[kept]))
        freedom = 2 * int(kept.sum())
        limit = white * float(stats.chi2.isf(FALSE_ALARM / power.size, freedom)) / freedom
        frequency: Array = np.fft.rfftfreq(len(even), step)[1:-1].astype(float)
        return cls(frequency, np.sqrt(power), float(np.sqrt(white)), float(np.sqrt(limit)))


def spectrum_panel(
    axes: Axes, spectra: Sequence[tuple[Spectrum, str, str]], modes: Array | Sequence[float] = ()
) -> None:
    """Draw a recording's residual spectra, each with label and colour, beside white noise; mark frequencies [Hz]."""
    for spectrum, label, color in spectra:
        axes.plot(spectrum.frequency, 1e6 * spectrum.amplitude, color=color, linewidth=1.0, label=label)
    last = spectra[-1][0]
    axes.axhline(1e6 * last.white, color=MEASURED, linewidth=1.6, label="white noise")
    axes.axhline(1e6 * last.limit, color=MEASURED, linestyle=(0, (4, 2)), linewidth=1.1, label="its limit (99.9 %)")
    low, high = float(last.frequency[0]), float(last.frequency[-1])
    look: dict[str, Any] = {"color": "#a03060", "linestyle": (0, (1, 1.5)), "zorder": 1}
    for frequency in modes:
        if low <= frequency <= high:
            axes.axvline(float(frequency), label="natural frequency of the model", **look)
    least = min(last.white, *(float(np.quantile(spectrum.amplitude, 0.02)) for spectrum, *_ in spectra))
    largest = max(last.limit, *(float(spectrum.amplitude.max()) for spectrum, *_ in spectra))
    log_scale(axes.xaxis, low, high)
    log_scale(axes.yaxis, 0.7e6 * least, 1.5e6 * largest)
    axes.set(xlabel="frequency [Hz]", ylabel="amplitude [µm]")


@styled
def rms_figure(
    title: str, comparisons: Sequence[RecordingComparison], labels: Mapping[Role, str], in_noise: bool
) -> Figure:
    """Draw each recording's RMS marker residual by several models in units of the noise, or else in millimetres."""
    page = Page.of(title, [(0.7 + 0.28 * max(len(comparisons), 2), 1)])
    axes, names, values = page.axes[0][0], [], []
    for place, comparison in enumerate(comparisons):
        unit = comparison.noise[0] if in_noise else 1e-3
        simulations: dict[Role, SimulatedRecording | None] = {role: getattr(comparison, role) for role in labels}
        sizes = {role: each.marker_rms / unit for role, each in simulations.items() if each is not None}
        values += [comparison.noise[0] / unit, *sizes.values()]
        label = recording_label(comparison.recording, 24)
        names.append(printable(label if sizes else f"{label[:-1]}, not simulated)"))
        axes.plot([*sizes.values()], [place] * len(sizes), color="#bbbbbb", linewidth=1.0, zorder=1)
        for role, size in sizes.items():
            axes.plot(size, place, linestyle="", label=labels[role], **_LOOKS[role][1])
        noise: dict[str, Any] = {"marker": "|", "markersize": 15, "markeredgewidth": 2, "color": MEASURED, "zorder": 1}
        axes.plot(comparison.noise[0] / unit, place, linestyle="", label="noise", **noise)
    log_scale(axes.xaxis, min(values) / 1.15, max(values) * 1.15)
    axes.set_ylim(len(comparisons) - 0.4, -0.6)
    axes.set_yticks(range(len(comparisons)), names)
    axes.grid(False, axis="y")
    unit_name = "times the noise" if in_noise else "mm"
    axes.set(xlabel=f"marker residual over the whole recording, open loop, RMS [{unit_name}]", ylabel="recording")
    page.legend()
    return page.figure


def recording_label(recording: Recording, most: int = 36) -> str:
    """Return a recording's file name, shortened to so many characters, with its role."""
    return f"{short(recording.file, most)} ({'held out' if recording.role == 'holdout' else 'train'})"


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
