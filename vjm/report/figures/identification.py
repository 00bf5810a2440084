"""The figures of an identification, or of a model compared with recordings: simulation and residual."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import partial

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from scipy import stats

from vjm.identification.records import Comparison, Identification
from vjm.records import Array, Estimate, RecordingComparison, Rig
from vjm.report.figures.measurements import data_pictures
from vjm.report.figures.panels import (
    DIVERGING,
    FALSE_ALARM,
    SMALLEST,
    Color,
    PanelFigure,
    Picture,
    Spectrum,
    heatmap,
    rms_figure,
)
from vjm.report.figures.signals import Signal, motion_figure, moving_recordings, one_of_each_repeat
from vjm.report.text import recording_label
from vjm.simulation.model import Model
from vjm.text import number, short

_MOST_ROWS = 40  # recordings in the RMS figure
_MOST_MAP_ROWS, _MOST_MAP_COLUMNS = 24, 14


def identification_pictures(result: Comparison) -> list[Picture]:
    """Return all pictures of an identification, or of a comparison of a given model with recordings."""
    if not isinstance(result, Identification):
        return _replay_pictures(result.recordings, result.model, "given")
    return [
        *_replay_pictures(result.recordings, result.model, "identified"),
        *(_residual_pictures(result) if result.trajectory is not None else ()),
        *_correlation_pictures(result.parameters, result.covariance),
        *data_pictures(result),
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
        more = "" if k or len(shown) == len(comparisons) else f" {len(shown)} of {len(comparisons)} recordings shown."
        caption = f"{signal.name} in {short(comparison.recording.file)}, measured and simulated; residual below.{more}"
        pictures.append(Picture(f"tip_{k + 1}", caption, partial(_tip_figure, comparison, signal, labels)))
    return pictures


def _first_of(comparisons: Sequence[RecordingComparison], most: int) -> str:
    return f" The first {most} recordings of {len(comparisons)}." if len(comparisons) > most else ""


def _rms_title(comparisons: Sequence[RecordingComparison], labels: dict[str, str]) -> str:
    simulated = [each for each in comparisons if each.simulated is not None]
    held_out = [each for each in simulated if each.recording.role == "holdout"]
    parts = []
    for role in reversed(labels):
        pairs = [(getattr(each, role), each.noise[0]) for each in held_out or simulated]
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
    simulations = {role: getattr(comparison, role) for role in labels if getattr(comparison, role) is not None}
    rms = {role: signal.rms(simulated) for role, simulated in simulations.items()}
    # A second residual is drawn where it is neither hidden by the first one nor hides it.
    least: tuple[tuple[str, float], ...] = (("alternative", 1.05), ("reference", 0.0))
    own = rms["simulated"]  # zero where nothing moves
    second = [role for role, low in least if low * own < rms.get(role, np.nan) <= 4 * own][:1]
    sizes = [f"{labels[role]} {signal.rms_text(simulations[role])}" for role in reversed(simulations)]
    title = f"{recording_label(comparison.recording)}: residual of {signal.name} alone, RMS: {', '.join(sizes)}"
    hidden = {"alternative", "reference"} - {*second}
    return motion_figure(title, [(signal, comparison, signal.windows())], labels, hidden)


def _residual_pictures(fit: Identification) -> Iterator[Picture]:
    replayed = [each for each in fit.recordings if each.simulated is not None and each.recording.frames.size]
    if not replayed:
        return
    caption = (
        "RMS residual of each marker coordinate in units of camera noise. Pale: complete model; dark column: "
        "misplaced marker, or a mode that only it shows; dark row: specific to that recording."
        f"{_first_of(replayed, _MOST_MAP_ROWS)}"
    )
    yield Picture("residual_map", caption, partial(_residual_map, fit.model.rig, replayed[:_MOST_MAP_ROWS]))
    shown = [(each, Spectrum.of(each.simulated)) for each, _ in _shown_tips(fit.model.rig, replayed) if each.simulated]
    spectra = [(each, spectrum) for each, spectrum in shown if spectrum is not None]
    if spectra:
        caption = (
            "Amplitude of the residual, RMS over all marker coordinates. A peak above the dashed line at a natural "
            "frequency: its frequency or damping is off; elsewhere: unmodelled dynamics."
        )
        white = {item.file for item in fit.whiteness if not item.coloured}  # the table says so
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
    levels = next((each for each in scales if np.nanmax(table) <= each[-1]), scales[-1])
    colors = LinearSegmentedColormap.from_list("residual", ["#ffffff", "#f5c38a", "#c2541a", "#3d0f04"])
    norm = LogNorm(1.0, levels[-1], clip=True)
    rows = [recording_label(each.recording, 24) for each in comparisons]
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
    residuals = [each.simulated.marker_residual / each.noise[0] for each in comparisons if each.simulated is not None]
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
    if (where := _peak(model, comparison, spectrum, white)) is not None:
        times = f"{number(float(spectrum.amplitude.max() / spectrum.white), 2)} × white noise"
        title = f"Residual spectrum: largest {where} in {short(comparison.recording.file)}, {times}"
    page = PanelFigure.grid(title, len(spectra), (2.8, 2.3))
    for axes, (comparison, spectrum) in zip(page.axes[0], spectra, strict=True):
        other = None if comparison.alternative is None else Spectrum.of(comparison.alternative)
        drawn = [(other, "torque method", Color.TORQUE)] if other is not None else []
        modes = model.modes(comparison.recording.payload).frequencies
        Spectrum.draw(axes, [*drawn, (spectrum, "identified model", Color.IDENTIFIED)], modes)
        where = _peak(model, comparison, spectrum, white)
        axes.set_title(
            f"{recording_label(comparison.recording, 20)}: {'noise only' if where is None else f'largest {where}'}"
        )
    return page.finish()


def _peak(model: Model, comparison: RecordingComparison, spectrum: Spectrum, white: Collection[str]) -> str | None:
    """Tell the frequency of the largest residual, and its mode; None where nothing is above the limit of noise.

    Residuals of the files in `white` are noise by the test of their correlation.
    """
    at = int(np.argmax(spectrum.amplitude))
    if spectrum.amplitude[at] <= spectrum.limit or comparison.recording.file in white:
        return None
    peak, line = float(spectrum.frequency[at]), float(spectrum.frequency[0])
    if at < 2:  # not even two periods in the recording
        return f"below {number(float(spectrum.frequency[2]), 2)} Hz (drift)"
    modes = model.modes(comparison.recording.payload).frequencies
    nearest = int(np.argmin(np.abs(modes - peak)))
    mode = f" (mode {nearest + 1})" if abs(modes[nearest] - peak) < max(0.05 * peak, 2 * line) else ""
    return f"at {number(peak, 3)} Hz{mode}"


def _correlation_pictures(estimates: Sequence[Estimate], covariance: Array) -> Iterator[Picture]:
    names = [each.name for each in estimates if each.std is not None]
    if covariance.shape != (len(names), len(names)):
        return
    variance = np.diag(covariance)
    kept = np.flatnonzero(np.isfinite(covariance).all(axis=1) & (variance > 0))
    if kept.size > 1:
        std = np.sqrt(variance[kept])
        correlation = np.clip(covariance[np.ix_(kept, kept)] / np.outer(std, std), -1.0, 1.0)
        caption = (
            "Correlation of the estimates' errors. Near +1 or −1 the recordings determine only one combination of the "
            "two parameters."
        )
        yield Picture("correlations", caption, partial(_correlation_map, [names[k] for k in kept], correlation))


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
