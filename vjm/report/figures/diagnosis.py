"""The figures of a diagnosis: symptoms, the evidence for each cause, and the gain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter1d

from vjm.diagnosis.records import Cause, Diagnosis
from vjm.diagnosis.symptoms.joints import missing_torque
from vjm.effects.effect import Effect
from vjm.records import REFERENCE, Array, RecordingComparison, SimulatedRecording
from vjm.report.figures.panels import MARKS, Color, PanelFigure, Picture, Spectrum, binned_means, rms_figure
from vjm.report.figures.signals import Signal, liveliest_window, motion_figure, moving_recordings
from vjm.report.figures.symptoms import symptom_pictures
from vjm.report.text import clause, place, recording_label
from vjm.simulation.model import Model
from vjm.text import capital, millimetres, short

_LABELS = {"reference": "without causes", "alternative": "next best explanation", "simulated": "with causes"}
_WITHOUT_AND_WITH = ("without this cause", "with it")


def diagnosis_pictures(diagnosis: Diagnosis) -> list[Picture]:
    """Return all pictures of a diagnosis: symptoms, evidence, gain."""
    symptoms = [] if diagnosis.symptoms is None else symptom_pictures(diagnosis.symptoms)
    return [*symptoms, *_cause_pictures(diagnosis), *_gain_pictures(diagnosis)]


def _cause_pictures(diagnosis: Diagnosis) -> Iterator[Picture]:
    first = diagnosis.most_improved
    if first is None:
        return
    for k, cause in enumerate(diagnosis.causes[:4]):
        shown = [first, *(comparison for comparison in diagnosis.recordings if comparison is not first)]
        reference = "the model fitted without it"
        if len(diagnosis.causes) > 1:
            shown = [first if cause.without is None else replace(first, reference=cause.without)]
            reference = "the same model without this cause"
        caption = (
            f"{cause.effect.title}, in the recording with the largest gain, compared with {reference}. Left: residual "
            "against the quantity on which this cause depends. Right: residual without the cause against its "
            "contribution to the simulation; equal on the dashed line."
        )
        yield Picture(f"cause_{k + 1}", caption, partial(_evidence, cause, diagnosis.model, shown))


def _gain_pictures(diagnosis: Diagnosis) -> Iterator[Picture]:
    shown = [comparison for comparison in diagnosis.recordings if comparison.reference is not None]
    shown.sort(key=lambda comparison: comparison.recording.role != "holdout")  # these are what counts
    if shown:
        gain, title = diagnosis.gain, "Residual of the model without effects"
        labels = _LABELS if diagnosis.causes else {"reference": "model"}
        if gain is not None and diagnosis.causes:
            best = "" if gain.next_best is None else f", next best explanation {millimetres(gain.next_best)}"
            sizes = f"{millimetres(gain.before)} without causes, {millimetres(gain.after)} with causes"
            title = f"Held-out residual, all markers: {sizes}{best}; noise {millimetres(gain.noise)}"
        caption = "RMS of all marker coordinates, open loop. A complete model lies on the noise mark."
        yield Picture("gain", caption, partial(rms_figure, title, shown[:40], labels, in_noise=False))
    for k, (comparison, signal) in enumerate(_held_out(diagnosis) if diagnosis.causes else ()):
        sensor = "Tip marker" if signal.is_marker else "Joint angle"
        caption = f"{sensor} in {short(comparison.recording.file)}: measured and simulated, without and with causes."
        yield Picture(f"held_out_{k + 1}", caption, partial(_before_and_after, comparison, signal))


def _held_out(diagnosis: Diagnosis) -> list[tuple[RecordingComparison, Signal]]:
    usable = [comparison for comparison in diagnosis.recordings if comparison.simulated is not None]
    ordered = moving_recordings(diagnosis.model.rig, usable, "reference")
    held_out = [pair for pair in ordered if pair[0].recording.role == "holdout"]
    changed = [pair for pair in held_out if pair[0].recording.condition != REFERENCE]
    return (changed or held_out)[:3] or ordered[:1]


def _before_and_after(comparison: RecordingComparison, signal: Signal) -> Figure:
    before, after = comparison.reference, comparison.simulated
    assert before is not None
    assert after is not None
    sizes = f"{signal.rms_text(before)} RMS without causes, {signal.rms_text(after)} with causes"
    title = f"{recording_label(comparison.recording)}: residual of {signal.name} alone: {sizes}"
    window = liveliest_window(signal.time, np.nan_to_num(signal.residual(before)))
    heading = "" if signal.is_whole(window) else "Where the residual without causes is largest"
    return motion_figure(title, [(signal, comparison, [(window, heading)])], _LABELS)


_Points = Sequence[tuple[Array, Array]]  # abscissae and residuals (P,), without and with a cause


def _evidence(cause: Cause, model: Model, comparisons: Sequence[RecordingComparison]) -> Figure:
    clause_text = capital(clause(cause.effect, model, cause.parameters))
    page = PanelFigure.of(f"{clause_text}: {short(comparisons[0].recording.file)} without and with it", [(3.4, 2)])
    left, right = page.axes[0]
    before, after = comparisons[0].reference, comparisons[0].simulated
    if before is not None and after is not None:
        spectrum_without, spectrum_with = Spectrum.of(before), Spectrum.of(after)
        if cause.effect.abscissa == "frequency" and spectrum_without and spectrum_with:
            labelled = zip(
                (spectrum_without, spectrum_with), _WITHOUT_AND_WITH, (Color.NOMINAL, Color.IDENTIFIED), strict=True
            )
            Spectrum.draw(left, [*labelled])
            left.set_title("Spectrum of the residual")
        elif points := _missing_torques(cause.effect, model, comparisons):
            abscissa = "joint angle [°]" if cause.effect.abscissa == "joint_angle" else "joint velocity [°/s]"
            _draw_points(left, points)
            left.set(xlabel=abscissa, ylabel="unmodelled torque [mN m]", title="Unmodelled joint torque")
        else:
            _draw_marker_residuals(left, cause.effect, before, after)
        _draw_added(right, before, after)
    return page.finish()


def _draw_marker_residuals(axes: Axes, effect: Effect, before: SimulatedRecording, after: SimulatedRecording) -> None:
    """Draw the markers' residuals against the abscissa of an effect; against time where that is no marker's."""
    frames, kind = after.recording.frames, effect.abscissa
    time, shown = after.recording.time[frames], after.simulation.markers[frames]
    residuals = [simulated.marker_residual[frames] for simulated in (before, after)]
    rms = kind not in ("velocity", "position", "radial", "tangential")
    if kind == "velocity":
        x, label = np.gradient(shown, time, axis=0), "velocity of the marker [m/s]"
    elif kind == "position":
        x, label = shown, "coordinate of the marker [m]"
    elif kind in ("radial", "tangential"):
        x, label = np.linalg.norm(shown, axis=-1), "distance from the base [m]"
        outwards = shown / np.maximum(x, 1e-12)[..., None]
        across = np.stack([-outwards[..., 1], outwards[..., 0]], axis=-1)
        residuals = [np.sum(residual * (outwards if kind == "radial" else across), axis=-1) for residual in residuals]
    elif kind == "marker":
        x, label = np.arange(1.0, shown.shape[1] + 1)[None, :, None], "marker, from the base outwards [1]"
    elif kind == "amplitude":
        width = max(3, round(0.08 * len(shown)))  # frames on which each mean is taken: 8 % of the recording
        power = uniform_filter1d((shown - shown.mean(axis=0)) ** 2, width, axis=0, mode="nearest")
        x, label = np.sqrt(power), "RMS of the motion around each instant [m]"
    else:
        x, label = (time - time[0])[:, None, None], "time since the start [s]"
    x = np.broadcast_to(x, residuals[0].shape)
    known = np.isfinite(x) & np.isfinite(residuals[0]) & np.isfinite(residuals[1])
    _draw_points(axes, [(x[known], 1e3 * residual[known]) for residual in residuals], 1e3 * before.noise[0], rms)
    axes.set(xlabel=label, ylabel="residual, RMS [mm]" if rms else "residual [mm]", title="Residual")
    if kind == "marker":
        axes.set_xticks(np.unique(x[known]))


def _missing_torques(effect: Effect, model: Model, comparisons: Sequence[RecordingComparison]) -> _Points:
    """Return the missing torque at the joint of an effect that is plainest there; nothing where it is not known."""
    if effect.abscissa not in ("joint_angle", "joint_rate"):
        return []
    by_angle, points = effect.abscissa == "joint_angle", []
    for role in ("reference", "simulated"):
        simulated = [getattr(comparison, role) for comparison in comparisons if getattr(comparison, role) is not None]
        profile = missing_torque(model.rig, simulated, f"{place(effect, model)}.theta")
        if profile is None:
            return []
        points.append((np.degrees(profile.position if by_angle else profile.velocity), 1e3 * profile.fit.own))
    return points


def _draw_points(axes: Axes, points: _Points, noise: float = 0.0, rms: bool = False) -> None:
    """Draw residuals and their means, or RMS values, over bins; noise is their 1-sigma, zero where it is not known."""
    largest = 3 * noise
    band = (0.0, noise) if rms else (-2 * noise, 2 * noise)
    axes.axhspan(*band, color=Color.BAND, linewidth=0)
    axes.axhline(0.0, color=Color.AXIS, linewidth=0.6)
    for (x, values), role, label in zip(points, ("reference", "simulated"), _WITHOUT_AND_WITH, strict=True):
        if not rms:
            axes.plot(*_thinned(x, values), ".", color=MARKS[role]["color"], alpha=0.3, markersize=2, zorder=1)
        centres, means, _ = binned_means(x, values**2 if rms else values, 24 if x.size > 1000 else 10)
        means = np.sqrt(means) if rms else means
        axes.plot(centres, means, linestyle="-", linewidth=1.1, label=label, **MARKS[role])
        largest = max(largest, 1.5 * float(np.max(np.abs(means), initial=0.0)))
    axes.set_ylim(0.0 if rms else -largest, None if rms else largest)


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return at most 1,500 of the points, regardless of their order: more dots do not show."""
    chosen = np.sort(np.random.default_rng(0).permutation(x.size)[:1500])
    return x[chosen], y[chosen]


def _draw_added(axes: Axes, before: SimulatedRecording, after: SimulatedRecording) -> None:
    residual, added = before.marker_residual, after.simulation.markers - before.simulation.markers
    known = np.isfinite(residual)
    x, y, noise = 1e3 * added[known], 1e3 * residual[known], 1e3 * before.noise[0]
    limit = max(float(np.percentile(np.abs(x), 99.5)), 3 * noise) * 1.15
    ends = np.array([-limit, limit])
    axes.fill_between(ends, ends - 2 * noise, ends + 2 * noise, color=Color.BAND, linewidth=0, label="noise")
    axes.plot(ends, ends, "--", color=Color.MEASURED, linewidth=1.2, label="residual = contribution")
    axes.plot(*_thinned(x, y), ".", color=Color.IDENTIFIED, markersize=2.2, zorder=3)
    axes.set(xlim=ends, ylim=1.15 * ends)
    axes.set(xlabel="contribution of the cause [mm]", ylabel="residual without the cause [mm]")
    share = 1 - float(np.sum((y - x) ** 2)) / max(float(np.sum(y**2)), 1e-300)
    axes.set_title(f"{max(100 * share, 0.0):.1f} % of the mean square residual explained")
