"""The figures of an identification, or of a model compared with recordings: simulation, residual, and the data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from scipy import stats
from scipy.interpolate import CubicSpline

from vjm.chain.virtual_links import Chain
from vjm.identification.records import Comparison, Identification
from vjm.identification.training_data import PreparedRecording
from vjm.model.modes import modes
from vjm.records import Array, Estimate, Indices, Recording, RecordingComparison, Rig
from vjm.report.figures.panels import (
    DIVERGING,
    FALSE_ALARM,
    LINES,
    MARKS,
    SMALLEST,
    Color,
    PanelFigure,
    Picture,
    Spectrum,
    draw_marks,
    heatmap,
    log_axis,
    rms_figure,
)
from vjm.report.figures.signals import (
    Signal,
    liveliest_window,
    motion_figure,
    moving_axis,
    moving_recordings,
    one_of_each_repeat,
    simulations,
)
from vjm.report.text import ROLES, recording_label
from vjm.simulation.model import Model
from vjm.text import counted, listed, millimetres, number, short

_MOST_ROWS = 40  # recordings in the RMS figure
_MOST_MAP_ROWS, _MOST_MAP_COLUMNS = 24, 14
_MOST_LINKS = 3  # beside each other


def identification_pictures(result: Comparison) -> list[Picture]:
    """Return all pictures of an identification, or of a comparison of a given model with recordings."""
    if not isinstance(result, Identification):
        return _replay_pictures(result.recordings, result.model, "given")
    return [
        *_replay_pictures(result.recordings, result.model, "identified"),
        *(_residual_pictures(result) if result.trajectory is not None else ()),
        *_correlation_pictures(result.parameters, result.covariance),
        *_data_pictures(result),
    ]


def _replay_pictures(comparisons: Sequence[RecordingComparison], model: Model, name: str) -> list[Picture]:
    labels = {"reference": "nominal model", "alternative": "torque method", "simulated": f"{name} model"}
    caption = (
        "RMS of all marker coordinates, open loop: only the initial state is estimated from each recording. A complete "
        f"model lies on the noise mark.{_first_of(comparisons, _MOST_ROWS)}"
    )
    title = _rms_title(comparisons, labels)
    pictures = [Picture("fit", caption, partial(rms_figure, title, comparisons[:_MOST_ROWS], labels, in_noise=True))]
    shown = _shown_tips(model.rig, comparisons)
    for k, (comparison, signal) in enumerate(shown):
        note = "" if k or len(shown) == len(comparisons) else f" {len(shown)} of {len(comparisons)} recordings shown."
        caption = f"{signal.name} in {short(comparison.recording.file)}, measured and simulated; residual below.{note}"
        pictures.append(Picture(f"tip_{k + 1}", caption, partial(_tip_figure, comparison, signal, labels)))
    return pictures


def _first_of(comparisons: Sequence[RecordingComparison], count: int) -> str:
    return f" The first {count} recordings of {len(comparisons)}." if len(comparisons) > count else ""


def _rms_title(comparisons: Sequence[RecordingComparison], labels: dict[str, str]) -> str:
    simulated = [comparison for comparison in comparisons if comparison.simulated is not None]
    held_out = [comparison for comparison in simulated if comparison.recording.role == "holdout"]
    parts = []
    for role in reversed(labels):
        pairs = [(getattr(comparison, role), comparison.noise[0]) for comparison in held_out or simulated]
        ratios = [simulation.marker_rms / noise for simulation, noise in pairs if simulation is not None]
        if ratios:
            ends = dict.fromkeys([number(min(ratios), 2), number(max(ratios), 2)])
            parts.append(f"{labels[role]} {' to '.join(ends)}")
    if not parts:
        return "No recording could be simulated"
    return f"Residual / noise in {'held-out' if held_out else 'training'} recordings: {', '.join(parts)}"


def _shown_tips(rig: Rig, comparisons: Sequence[RecordingComparison]) -> list[tuple[RecordingComparison, Signal]]:
    """Return recordings that move, held-out ones first (at most two instead of training ones), worst first."""
    ordered = moving_recordings(rig, comparisons, "simulated")
    held_out = [pair for pair in ordered if pair[0].recording.role == "holdout"]
    train = [pair for pair in ordered if pair[0].recording.role == "train"]
    chosen = one_of_each_repeat([*held_out[:2], *train, *held_out[2:]], lambda pair: pair[0].recording)[:4]
    return sorted(chosen, key=lambda pair: pair[0].recording.role != "holdout")


def _tip_figure(comparison: RecordingComparison, signal: Signal, labels: dict[str, str]) -> Figure:
    simulated = simulations(comparison, labels)
    rms = {role: signal.rms(simulation) for role, simulation in simulated.items()}
    # A second residual is drawn where it is neither hidden by the first one nor hides it.
    limits: tuple[tuple[str, float], ...] = (("alternative", 1.05), ("reference", 0.0))
    judged_rms = rms["simulated"]  # zero where nothing moves
    second = [role for role, low in limits if low * judged_rms < rms.get(role, np.nan) <= 4 * judged_rms][:1]
    sizes = [f"{labels[role]} {signal.rms_text(simulated[role])}" for role in reversed(simulated)]
    title = f"{recording_label(comparison.recording)}: residual of {signal.name} alone, RMS: {', '.join(sizes)}"
    hidden = {"alternative", "reference"} - {*second}
    return motion_figure(title, [(signal, comparison, signal.windows())], labels, hidden)


def _residual_pictures(fit: Identification) -> Iterator[Picture]:
    replayed = [
        comparison
        for comparison in fit.recordings
        if comparison.simulated is not None and comparison.recording.frames.size
    ]
    if not replayed:
        return
    caption = (
        "RMS residual of each marker coordinate in units of camera noise. Pale: complete model; dark column: "
        "misplaced marker, or a mode that only it shows; dark row: specific to that recording."
        f"{_first_of(replayed, _MOST_MAP_ROWS)}"
    )
    yield Picture("residual_map", caption, partial(_residual_map, fit.model.rig, replayed[:_MOST_MAP_ROWS]))
    spectra = [
        (comparison, spectrum)
        for comparison, _ in _shown_tips(fit.model.rig, replayed)
        if comparison.simulated and (spectrum := Spectrum.of(comparison.simulated)) is not None
    ]
    if spectra:
        caption = (
            "Amplitude of the residual, RMS over all marker coordinates. A peak above the dashed line at a natural "
            "frequency: its frequency or damping is off; elsewhere: unmodelled dynamics."
        )
        white = {item.file for item in fit.whiteness if item.white}  # the table says so
        yield Picture("residual_spectra", caption, partial(_residual_spectra, fit.model, spectra, white))


def _residual_map(rig: Rig, comparisons: Sequence[RecordingComparison]) -> Figure:
    names, table, count = _residual_table(rig, comparisons)
    # RMS that white noise passes anywhere in one such table of a thousand, and never less than 10 % above the noise.
    limit = np.sqrt(stats.chi2.isf(FALSE_ALARM / table.size, np.maximum(count, 1)) / np.maximum(count, 1))
    row, column = divmod(int(np.nanargmax(table)), table.shape[1])
    worst = f"at most {number(float(table[row, column]), 3)} × noise"
    white = bool(np.nanmax(table / np.maximum(limit, 1.1)) <= 1)
    title = "All markers within noise" if white else "Residual of each marker"
    title = f"{title}: {worst} ({names[column]} in {short(comparisons[row].recording.file)})"
    page = PanelFigure.of(title, [(0.65 + 0.28 * max(len(comparisons), 2), 1)])
    axes = page.axes[0][0]
    scales = ((1.0, 1.5, 3.0, 10.0), (1.0, 3.0, 10.0, 100.0), (1.0, 10.0, 100.0, 1000.0))
    levels = next((scale for scale in scales if np.nanmax(table) <= scale[-1]), scales[-1])
    colors = LinearSegmentedColormap.from_list("residual", ["#ffffff", "#f5c38a", "#c2541a", "#3d0f04"])
    norm = LogNorm(1.0, levels[-1], clip=True)
    rows = [recording_label(comparison.recording, 24) for comparison in comparisons]
    heads = [name.partition(".")[2] if len(rig.links) == 1 else name.replace(".", " ", 1) for name in names]
    roomy = len(names) <= _MOST_MAP_COLUMNS
    text = (lambda value: f"{value:.0f}" if value >= 10 else f"{value:.2f}") if len(names) <= 28 else None
    heatmap(axes, table, (colors, norm), (rows, [short(head, 14) for head in heads]), text, 8.5 if roomy else SMALLEST)
    axes.set(xlabel="marker coordinate", ylabel="recording")
    words = [f"{level:g} × noise" for level in levels]
    words = [f"{words[0]} or less", *words[1:-1], f"{words[-1]} or more"]
    return page.finish(areas=dict(zip(words, colors(norm(levels)), strict=True)))


def _residual_table(rig: Rig, comparisons: Sequence[RecordingComparison]) -> tuple[list[str], Array, Array]:
    """Return coordinates (C), pooled by marker if too many, RMS residuals over noise and numbers of values (R, C)."""
    residuals = [
        comparison.simulated.marker_residual / comparison.noise[0]
        for comparison in comparisons
        if comparison.simulated is not None
    ]
    squares = np.stack([np.nansum(residual**2, axis=0) for residual in residuals])  # (R, k, 2)
    counts = np.stack([np.isfinite(residual).sum(axis=0) for residual in residuals])
    measured = np.argwhere(counts.any(axis=0))
    columns = [column for link in rig.links for column in link.marker_columns]
    names = [columns[2 * marker + axis] for marker, axis in measured.tolist()]
    table, count = squares[:, *measured.T], counts[:, *measured.T]
    if len(names) > _MOST_MAP_COLUMNS:
        markers = np.unique(measured[:, 0])
        names = [columns[2 * marker].removesuffix(".x") for marker in markers.tolist()]
        table, count = squares.sum(axis=2)[:, markers], counts.sum(axis=2)[:, markers]
    return names, np.sqrt(table / np.where(count > 0, count, np.nan)), count


def _residual_spectra(
    model: Model, spectra: Sequence[tuple[RecordingComparison, Spectrum]], white: Collection[str]
) -> Figure:
    judged = [pair for pair in spectra if pair[0].recording.file not in white] or spectra
    comparison, spectrum = max(judged, key=lambda pair: float(np.max(pair[1].amplitude / pair[1].limit)))
    title = "Residual spectrum: no peak above noise"
    if (peak := _peak(model, comparison, spectrum, white)) is not None:
        times = f"{number(float(spectrum.amplitude.max() / spectrum.white), 2)} × white noise"
        title = f"Residual spectrum: largest {peak} in {short(comparison.recording.file)}, {times}"
    page = PanelFigure.grid(title, len(spectra), (2.8, 2.3))
    for axes, (comparison, spectrum) in zip(page.axes[0], spectra, strict=True):
        torque_spectrum = None if comparison.alternative is None else Spectrum.of(comparison.alternative)
        drawn = [(torque_spectrum, "torque method", Color.TORQUE)] if torque_spectrum is not None else []
        frequencies = modes(model.chain, *model.arm.loads(comparison.recording.payload_body)).frequencies
        Spectrum.draw(axes, [*drawn, (spectrum, "identified model", Color.IDENTIFIED)], frequencies)
        peak = _peak(model, comparison, spectrum, white)
        axes.set_title(
            f"{recording_label(comparison.recording, 20)}: {'noise only' if peak is None else f'largest {peak}'}"
        )
    return page.finish()


def _peak(model: Model, comparison: RecordingComparison, spectrum: Spectrum, white: Collection[str]) -> str | None:
    """Return the frequency of the largest residual in words, with its mode; None where noise would be as large.

    Residuals of the files in `white` are noise by the test of their correlation.
    """
    index = int(np.argmax(spectrum.amplitude))
    if spectrum.amplitude[index] <= spectrum.limit or comparison.recording.file in white:
        return None
    peak, line = float(spectrum.frequency[index]), float(spectrum.frequency[0])
    if index < 2:  # not even two periods in the recording
        return f"below {number(float(spectrum.frequency[2]), 2)} Hz (drift)"
    frequencies = modes(model.chain, *model.arm.loads(comparison.recording.payload_body)).frequencies
    nearest = int(np.argmin(np.abs(frequencies - peak)))
    mode = f" (mode {nearest + 1})" if abs(frequencies[nearest] - peak) < max(0.05 * peak, 2 * line) else ""
    return f"at {number(peak, 3)} Hz{mode}"


def _correlation_pictures(estimates: Sequence[Estimate], covariance: Array) -> Iterator[Picture]:
    names = [estimate.name for estimate in estimates if estimate.std is not None]
    if covariance.shape != (len(names), len(names)):
        return
    variance = np.diag(covariance)
    determined = np.flatnonzero(np.isfinite(covariance).all(axis=1) & (variance > 0))
    if determined.size > 1:
        std = np.sqrt(variance[determined])
        correlation = np.clip(covariance[np.ix_(determined, determined)] / np.outer(std, std), -1.0, 1.0)
        caption = (
            "Correlation of the estimates' errors. Near +1 or −1 the recordings determine only one combination of the "
            "two parameters."
        )
        yield Picture("correlations", caption, partial(_correlation_map, [names[k] for k in determined], correlation))


def _correlation_map(names: Sequence[str], matrix: Array) -> Figure:
    count = min(len(names), 48)
    roomy = count <= 16
    page = PanelFigure.of(_correlation_title(names, matrix), [(0.6 + max(2, count) * min(0.28, 6.25 / count), 1)])
    axes = page.axes[0][0]
    if count < 8:
        axes.set_box_aspect(0.35)
        axes.set_anchor("W")
    shown = np.where(np.eye(count, dtype=bool), np.nan, matrix[:count, :count])
    rows = [f"{short(name, 30)}  {k + 1}" for k, name in enumerate(names[:count])]
    columns = [str(k + 1) for k in range(count)]
    colors, norm = DIVERGING, Normalize(-1.0, 1.0)
    heatmap(axes, shown, (colors, norm), (rows, columns), _signed if roomy else None, 8.5 if roomy else SMALLEST)
    axes.set(xlabel="parameter", ylabel="parameter")
    words = ("+1", "0: independent", "−1")
    return page.finish(areas=dict(zip(words, colors(norm([1.0, 0.0, -1.0])), strict=True)))


def _correlation_title(names: Sequence[str], matrix: Array) -> str:
    size = np.triu(np.abs(matrix), 1)  # each pair once: rounding must not choose the order of its names
    row, column = divmod(int(np.argmax(size)), len(names))
    pair = f"{short(names[row], 30)} and {short(names[column], 30)} ({_signed(float(matrix[row, column]))})"
    strong = int(np.count_nonzero(size > 0.9))
    if strong > 1:
        return f"{strong} pairs of parameters correlated beyond 0.9, strongest: {pair}"
    if strong == 1:
        return f"The recordings hardly distinguish {pair}"
    if size.max() < 0.5:
        return f"All parameters distinguishable; strongest correlation: {pair}"
    return f"Correlation of the estimates, strongest: {pair}"


def _signed(value: float) -> str:
    return "0.00" if abs(value) < 5e-3 else f"{value:+.2f}".replace("-", "\N{MINUS SIGN}")


def _data_pictures(fit: Identification) -> Iterator[Picture]:
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


def _spread_over(recordings: Sequence[Recording], count: int) -> list[Recording]:
    """Return at most so many recordings, in order; one of each set of repeats and every role and kind come first."""
    counts: Counter[tuple[str | None, ...]] = Counter()
    ranks = []
    for recording in recordings:
        group = (recording.role, recording.kind, recording.repeat)
        ranks.append(counts[group])
        counts[group] += 1
    return [recordings[k] for k in np.sort(np.argsort(ranks, kind="stable")[:count])]


def _evenly(count: int, limit: int) -> list[int]:
    return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, limit)).round())]


def _raw_markers(rig: Rig, recordings: Sequence[Recording]) -> Figure:
    links = range(min(len(rig.links), _MOST_LINKS))
    panels = [(recording, link) for recording in recordings for link in links]
    count = sum(len(link.markers) for link in rig.links)
    title = f"Markers as measured: {counted(len(recordings), 'recording')}, {counted(count, 'marker')}"
    page = PanelFigure.grid(title, len(panels), (2.8, 1.9), max(len(links), 2))
    for axes, (recording, link) in zip(page.axes[0], panels, strict=True):
        signal = Signal.of(rig, recording)
        start, stop = interval = float(recording.time[0]), float(recording.time[-1])
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
        length, duration = stop - start, interval[1] - interval[0]
        part = "" if length > 0.99 * duration else f", {length:.2g} s of {duration:.3g} s"
        heading = f"{short(recording.file, 22)} ({recording.kind}, {ROLES[recording.role]}{part})"
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
    frames = complete[(time[complete] >= start) & (time[complete] <= stop)]
    levels = np.linspace(deflection[frames].min(), deflection[frames].max(), 5)
    return np.unique([frames[np.argmin(np.abs(deflection[frames] - level))] for level in levels])


def _joint_angles(chain: Chain, data: PreparedRecording) -> Figure:
    links, parts = range(min(len(chain.links), _MOST_LINKS)), chain.passive_slices
    derivatives, interior = data.derivatives, data.derivatives.interior  # the noise is known there
    noise = derivatives.noise(np.sqrt(np.diag(data.angles.covariance)))
    signals = np.stack([derivatives.value, derivatives.rate, derivatives.acceleration])
    known = signals[:, interior][..., chain.passive]
    std = np.std(known, axis=1)
    ratios = np.max(std / np.maximum(noise[:, chain.passive], 1e-300), axis=1)
    times = listed([f"{ratio:.0f}" if ratio >= 2 else f"{ratio:.1f}" for ratio in ratios])
    window = liveliest_window(derivatives.time[interior], known[0][:, int(np.argmax(std[0]))])
    title = f"Virtual joint angles of {short(data.recording.file)}: signal/noise of angle, rate and acceleration "
    page = PanelFigure.of(f"{title}{times}", [(1.75, len(links))] * 3)
    time = np.linspace(*window, 800)  # a camera may take no more than four frames a period
    lines = CubicSpline(derivatives.time, signals, axis=1)(time)
    frames = (data.angles.time >= window[0]) & (data.angles.time <= window[1])
    equal = len({parts[i].stop - parts[i].start for i in links}) == 1  # else a label would stand for several looks
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
                axes.plot(time, line, linewidth=1.2, label=f"joint {joint + 1}" if equal else None)
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
    variances = [np.diag(data.noise_covariance(chain, data.inertia(chain))) for data in recordings]
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
