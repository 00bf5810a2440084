"""Figures of the data behind an identification: markers, shapes of the links, joint angles and torque errors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import CubicSpline

from vjm.chain.virtual_links import Chain
from vjm.identification.records import Identification
from vjm.identification.training_data import PreparedRecording
from vjm.records import Array, Indices, Recording, Rig
from vjm.report.figures.panels import LINES, MARKS, Color, PanelFigure, Picture, draw_marks, log_axis
from vjm.report.figures.signals import Signal, liveliest_window, moving_axis, one_of_each_repeat
from vjm.text import counted, listed, millimetres, number, short

_MOST_LINKS = 3  # beside each other


def data_pictures(fit: Identification) -> Iterator[Picture]:
    """Return pictures of the measurements that an identification was made from."""
    rig, chain, recordings = fit.model.rig, fit.model.chain, fit.experiment.recordings
    moving = sorted(fit.torque_data, key=lambda data: (data.recording.kind == "quiet", -_motion(rig, data.recording)))
    moving = one_of_each_repeat(moving, lambda data: data.recording)[:2]
    if moving:
        names = listed([short(data.recording.file) for data in moving])
        caption = f"Shape function, virtual links and joints at several instants of {names}; lateral scale magnified."
        yield Picture("shapes", caption, partial(_link_shapes, rig, chain, moving))
        caption = f"Angles from the markers of {short(moving[0].recording.file)}, with rates and accelerations."
        yield Picture("angles", caption, partial(_joint_angles, chain, moving[0]))
        caption = (
            "Residual of the equation of motion at each joint (eq. 14). A complete model leaves only the noise of the "
            "accelerations."
        )
        yield Picture("torque_errors", caption, partial(_torque_errors, fit))
    shown = _spread_over(recordings, 8 // min(len(rig.links), _MOST_LINKS))
    if shown:
        part = "" if len(shown) == len(recordings) else f" ({len(shown)} of {len(recordings)})"
        caption = f"Measured marker coordinates of the recordings{part}, at their largest motion."
        yield Picture("markers", caption, partial(_raw_markers, rig, shown))


def _motion(rig: Rig, recording: Recording) -> float:
    signal = Signal.of(rig, recording)
    return 0.0 if signal is None else float(np.std(signal.value))


def _spread_over(recordings: Sequence[Recording], most: int) -> list[Recording]:
    """Return at most so many recordings, in order; one of each set of repeats and every role and kind come first."""
    seen: Counter[tuple[str | None, ...]] = Counter()
    ranks = []
    for recording in recordings:
        group = (recording.role, recording.kind, recording.repeat)
        ranks.append(seen[group])
        seen[group] += 1
    return [recordings[k] for k in np.sort(np.argsort(ranks, kind="stable")[:most])]


def _evenly(count: int, most: int) -> list[int]:
    return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, most)).round())]


def _raw_markers(rig: Rig, recordings: Sequence[Recording]) -> Figure:
    links = range(min(len(rig.links), _MOST_LINKS))
    panels = [(recording, link) for recording in recordings for link in links]
    count = sum(len(link.markers) for link in rig.links)
    title = f"Markers as measured: {counted(len(recordings), 'recording')}, {counted(count, 'marker')}"
    page = PanelFigure.grid(title, len(panels), (2.8, 1.9), max(len(links), 2))
    for axes, (recording, link) in zip(page.axes[0], panels, strict=True):
        signal = Signal.of(rig, recording)
        start, stop = whole = float(recording.time[0]), float(recording.time[-1])
        if signal is not None and recording.kind not in ("quiet", "static"):
            start, stop = liveliest_window(signal.time, signal.value)
        rows = recording.frames
        rows = rows[(recording.time[rows] >= start) & (recording.time[rows] <= stop)]
        markers = 1e3 * recording.markers[rows][:, rig.marker_slices[link]]
        axis = moving_axis(markers)
        dots: Any = {"marker": "." if rows.size <= 40 else "none", "markersize": 4}  # frames, where there are few
        for k in _evenly(markers.shape[1], 6):  # a marker lost for a moment leaves a gap in its line
            axes.plot(recording.time[rows], markers[:, k, axis], linewidth=1.1, label=f"marker {k + 1}", **dots)
        axes.set(xlabel="time [s]", ylabel=f"{'xy'[axis]} [mm]")
        length, duration = stop - start, whole[1] - whole[0]
        part = "" if length > 0.99 * duration else f", {length:.2g} s of {duration:.3g} s"
        role = "held out" if recording.role == "holdout" else "train"
        heading = f"{short(recording.file, 22)} ({recording.kind}, {role}{part})"
        if len(links) > 1:
            heading = f"{short(rig.links[link].name, 12)} ({rig.links[link].markers_frame} frame), {heading}"
        axes.set_title(heading)
    return page.finish()


def _link_shapes(rig: Rig, chain: Chain, recordings: Sequence[PreparedRecording]) -> Figure:
    residuals = np.concatenate([fit.residuals.ravel() for data in recordings for fit in data.angles.shapes])
    rms = float(np.sqrt(np.nanmean(residuals**2))) if np.isfinite(residuals).any() else 0.0
    title = f"Shape functions fit the markers of all links to {millimetres(rms)} RMS"
    if all(fit.order == fit.residuals.shape[1] for fit in recordings[0].angles.shapes):
        title = "Shape functions: as many as markers, so the fit is exact and not a test"
    page = PanelFigure.of(title, [(3.1, len(recordings))] * len(rig.links))
    for i, row in enumerate(page.axes):
        for axes, data in zip(row, recordings, strict=True):
            _draw_shapes(axes, rig, chain, data, i)
            axes.set_title(short(data.recording.file))
    return page.finish()


def _draw_shapes(axes: Axes, rig: Rig, chain: Chain, data: PreparedRecording, i: int) -> None:
    fit, length = data.angles.shapes[i], chain.links[i].length
    arcs = np.linspace(0.0, fit.length, 80)
    lateral, slopes = fit.evaluate(arcs), fit.evaluate(arcs, 1)
    frames, places = _instants(data, lateral[:, -1]), rig.links[i].markers
    markers = fit.evaluate(places) + fit.residuals
    curve: Any = {"linestyle": "-", "linewidth": 2.2, "alpha": 0.6, "label": "shape function"}
    joints: Any = {"marker": "s", "markersize": 4, "markerfacecolor": "white", "markevery": slice(1, -1)}
    joints |= {"linestyle": (0, (4, 2)), "linewidth": 0.9, "label": "virtual links and joints"}
    circles: Any = {"marker": "o", "markersize": 4.5, "markeredgecolor": "black", "linestyle": ""}
    for k, frame in enumerate(frames):
        color = f"C{k}"
        cosine = np.sqrt(np.clip(1 - slopes[frame] ** 2, 0.0, 1.0))
        x = np.r_[0.0, np.cumsum((cosine[1:] + cosine[:-1]) / 2 * np.diff(arcs))]
        axes.plot(x, 1e3 * lateral[frame], color=color, **curve)
        headings = np.r_[0.0, np.cumsum(data.angles.q[frame, chain.passive_slices[i]])]
        steps = chain.links[i].lengths[:, None] * np.stack([np.cos(headings), 1e3 * np.sin(headings)], axis=-1)
        axes.plot(*np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]).T, color=color, **joints)
        axes.plot(np.interp(places, arcs, x), 1e3 * markers[frame], color=color, label="measured markers", **circles)
        tip, label = (x[-1], 1e3 * lateral[frame, -1]), f"{data.angles.time[frame]:.2f} s"
        axes.annotate(label, tip, xytext=(5, 0), textcoords="offset points", va="center", fontsize=7.5)
    name = short(rig.links[i].name, 24)
    axes.set(xlabel=f"along {name} [m]", ylabel="lateral [mm]", xlim=(-0.02 * length, 1.14 * length))


def _instants(data: PreparedRecording, deflection: Array) -> Indices:
    """Return five frames from one extreme of the tip's deflection (F,) to the other, where it moves most."""
    time = data.angles.time
    complete = np.flatnonzero(np.isfinite(data.angles.q).all(axis=1) & np.isfinite(deflection))
    if complete.size <= 5:
        return complete
    start, stop = liveliest_window(time[complete], deflection[complete])
    near = complete[(time[complete] >= start) & (time[complete] <= stop)]
    levels = np.linspace(deflection[near].min(), deflection[near].max(), 5)
    return np.unique([near[np.argmin(np.abs(deflection[near] - level))] for level in levels])


def _joint_angles(chain: Chain, data: PreparedRecording) -> Figure:
    links, parts = range(min(len(chain.links), _MOST_LINKS)), chain.passive_slices
    derivatives, inside = data.derivatives, data.derivatives.interior  # the noise is known there
    noise = derivatives.noise(np.sqrt(np.diag(data.angles.covariance)))
    signals = np.stack([derivatives.value, derivatives.rate, derivatives.acceleration])
    known = signals[:, inside][..., chain.passive]
    std = np.std(known, axis=1)
    ratios = np.max(std / np.maximum(noise[:, chain.passive], 1e-300), axis=1)
    times = listed([f"{ratio:.0f}" if ratio >= 2 else f"{ratio:.1f}" for ratio in ratios])
    window = liveliest_window(derivatives.time[inside], known[0][:, int(np.argmax(std[0]))])
    title = f"Virtual joint angles of {short(data.recording.file)}: signal/noise of angle, rate and acceleration "
    page = PanelFigure.of(f"{title}{times}", [(1.75, len(links))] * 3)
    time = np.linspace(*window, 800)  # a camera may take no more than four frames a period
    lines = CubicSpline(derivatives.time, signals, axis=1)(time)
    frames = (data.angles.time >= window[0]) & (data.angles.time <= window[1])
    alike = len({parts[i].stop - parts[i].start for i in links}) == 1  # else a label would stand for several looks
    for i in links:
        joints = _evenly(parts[i].stop - parts[i].start, 4)
        for kind, unit in enumerate(("angle [rad]", "rate [rad/s]", "acceleration [rad/s²]")):
            axes = page.axes[kind][i]
            axes.set(ylabel=unit, xlim=window)
            axes.tick_params(labelbottom=kind == 2)
            for joint in joints:
                line, sigma = lines[kind, :, parts[i].start + joint], noise[kind, parts[i].start + joint]
                axes.fill_between(
                    time, line - 2 * sigma, line + 2 * sigma, color=Color.BAND, linewidth=0, label="±2σ noise"
                )
                axes.plot(time, line, linewidth=1.2, label=f"joint {joint + 1}" if alike else None)
            for k, joint in reversed([*enumerate(joints)]) if kind == 0 else ():
                angles = data.angles.q[frames, parts[i].start + joint]
                axes.plot(data.angles.time[frames], angles, ".", markersize=4, color=f"C{k}", label="single frame")
        axes.set_xlabel("time [s]")
        numbers = listed([str(joint + 1) for joint in joints])
        heading = f"{short(chain.links[i].name, 16)}: joint{'s'[: len(joints) - 1]} {numbers}, from the base outwards"
        page.axes[0][i].set_title(heading)
    return page.finish()


def _torque_errors(fit: Identification) -> Figure:
    chain, recordings = fit.model.chain, fit.torque_data
    nominal, identified = (
        [data.errors(model.chain, data.derivatives.interior) for data in recordings]
        for model in (fit.nominal, fit.model)
    )
    largest = [np.nan_to_num(_rms(errors)) for errors in nominal]
    worst = int(np.argmax([rms.max() for rms in largest]))
    data, joint = recordings[worst], int(np.argmax(largest[worst]))
    before, after = _rms(np.concatenate(nominal)), _rms(np.concatenate(identified))
    samples = [data.derivatives.time.size for data in recordings]
    variances = [np.diag(data.noise_covariance(chain)) for data in recordings]
    noise = np.sqrt(np.average(variances, axis=0, weights=samples))
    total = [f"{number(1e3 * float(np.sqrt(np.nansum(rms**2))), 2)} mN m" for rms in (before, after, noise)]
    title = f"Torque errors of the training recordings: nominal model {total[0]}, identified {total[1]}, expected "
    rows = [(2.35, 1), (0.7 + 0.28 * chain.size, 1)] if chain.size > 1 else [(2.35, 1)]
    page = PanelFigure.of(f"{title}from noise {total[2]} (RMS, all joints)", rows)
    trace, time = page.axes[0][0], data.derivatives.time
    start, stop = liveliest_window(time, np.nan_to_num(data.derivatives.value[:, joint]))
    time = time[data.derivatives.interior]
    shown = (time >= start) & (time <= stop)
    trace.axhline(0.0, color=Color.AXIS, linewidth=0.6)
    trace.plot(time[shown], 1e3 * identified[worst][shown, joint], label="identified", **LINES["simulated"])
    trace.plot(time[shown], 1e3 * nominal[worst][shown, joint], label="nominal", **LINES["reference"])
    heading = f"{chain.joint_names[joint]} in {short(data.recording.file)} (largest nominal error)"
    trace.set(xlabel="time [s]", ylabel="error [mN m]", title=heading)
    if chain.size > 1:
        lower, values = page.axes[1][0], 1e3 * np.stack([noise, before, after])
        labels = {"noise": "expected from noise", "reference": "nominal, RMS", "simulated": "identified, RMS"}
        marks = [(label, rms, None, MARKS[kind]) for (kind, label), rms in zip(labels.items(), values, strict=True)]
        draw_marks(lower, chain.joint_names, marks)
        known = values[np.isfinite(values) & (values > 0)]
        log_axis(lower.xaxis, known.min() / 1.4, known.max() * 1.4)
        lower.set(xlabel="RMS error, over all training recordings [mN m]", ylabel="joint")
    return page.finish()


def _rms(errors: Array) -> Array:
    return np.asarray(np.sqrt(np.ma.masked_invalid(errors**2).mean(axis=0).filled(np.nan)))
