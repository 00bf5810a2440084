"""Animation and plots of a report as numbers, which report.html.jinja and report.js draw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vjm.chain.curve import marker_poses, rotate
from vjm.chain.virtual_links import Chain
from vjm.records import Array, Indices, Mask, Recording, RecordingComparison, Rig, SimulatedRecording
from vjm.report.figures.signals import (
    Signal,
    Window,
    liveliest_window,
    measured_signals,
    ranked_recordings,
    simulations,
)
from vjm.report.text import recording_label
from vjm.simulation.model import Model
from vjm.text import number

# Of the animation.
_MOST_FRAMES = 150  # 25 in each of the six periods that are shown, as many as a film has in a second
_ARC_POINTS = 24  # of a link's curve: straight pieces between them are off by less than a pixel
_WIDTH = 1000.0  # of the picture, in its own unit: about a pixel of a wide screen
_SECONDS = (8.0, 14.0)  # that it takes: six periods are then slow enough for the eye
_VISIBLE = 0.06  # deflections smaller than this fraction of the arm are magnified
_MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Of the plots.
_ROUNDING = 0.1  # of the noise: rounding adds less than a thousandth to the variance of a residual
_MOST_INSTANTS = 2000  # of a recording, about two a pixel of a wide screen
_LEAST_INSTANTS = 500  # where there are many, rather fewer recordings than fewer instants
_MOST_VALUES = 500_000  # of all recordings together, some 2.5 MB


def arm_animation(
    rig: Rig, comparisons: Sequence[RecordingComparison], labels: Mapping[str, str], models: Mapping[str, Model]
) -> dict[str, Any] | None:
    """Return an animation of the few periods in which a recording moves most, as report.html.jinja draws it.

    It shows the first one of `ranked_recordings` in motion.

    Args:
        rig: the arm.
        comparisons: recordings beside their simulations.
        labels: names of the simulations to draw, by their role in a comparison.
        models: what simulated them, by role.

    Returns:
        Size, duration, words and coordinates; None where no recording moves.
    """
    moving = [candidate for candidate in comparisons if candidate.recording.kind != "quiet"]
    pairs = ((candidate, Signal.of(rig, candidate.recording)) for candidate in ranked_recordings(moving, labels))
    comparison, signal = next(
        ((candidate, signal) for candidate, signal in pairs if signal and signal.is_marker), (None, None)
    )
    if comparison is None or signal is None:
        return None
    recording, window = comparison.recording, liveliest_window(signal.time, signal.value)
    rows = _frame_rows(recording, window)
    time = recording.time[rows]
    simulated_by = simulations(comparison, labels)
    arms = {role: (models[role].arm_in(recording).chain, simulated) for role, simulated in simulated_by.items()}
    judged, simulated = arms[judged_role := [*arms][-1]]
    factor = _magnification(judged, simulated.simulation.q[rows])
    curves = {
        role: _magnified(chain, sim.simulation.q[rows], _arcs(chain), factor)[0] for role, (chain, sim) in arms.items()
    }
    places, measured, visible = _markers(rig, judged, simulated, rows, factor)
    points = np.concatenate(
        [positions.reshape(-1, 2) for positions in (*curves.values(), places, measured, np.zeros(2))]
    )
    low, scale = points.min(axis=0), _WIDTH / max(float(np.ptp(points, axis=0).max()), 1e-9)

    def drawn(values: Array) -> Array:  # y points down in a picture
        result: Array = np.round((values - low) * [scale, -scale] + [0.0, scale * float(np.ptp(points[:, 1]))], 1)
        return result

    seconds = float(np.clip(time[-1] - time[0], *_SECONDS))
    ends = np.cumsum([0, *(_ARC_POINTS for _ in judged.links)])[:-1]
    roots = [int(end) for end, link in zip(ends, judged.links, strict=True) if link.joint == "revolute"]
    # The picture that does not move is that of the largest deflection.
    still = int(np.argmax(np.abs(curves[judged_role] - curves[judged_role].mean(axis=0)).max(axis=(1, 2))))
    times = (time - time[0]) / (time[-1] - time[0])
    return {
        "recording": recording_label(recording),
        "width": round(float(np.ptp(points[:, 0])) * scale),
        "height": round(float(np.ptp(points[:, 1])) * scale),
        "seconds": round(seconds, 2),
        "times": ";".join(f"{instant:.4g}" for instant in times.tolist()),
        "pace": _pace(seconds / float(time[-1] - time[0])),
        "magnification": factor,
        "still": still,
        "still_second": round(seconds * float(times[still]), 2),
        "clamp": drawn(np.zeros(2)).tolist() if judged.links[0].joint == "clamped" else None,
        "curves": [(role, labels[role], [_line(frame) for frame in drawn(curve)]) for role, curve in curves.items()],
        "joints": [_path(drawn(curves[judged_role][:, root])) for root in roots],
        "simulated": [_path(drawn(places[:, k])) for k in range(places.shape[1])],
        "measured": [
            {**_path(drawn(measured[:, k])), "seen": visible[:, k].astype(int).tolist()}
            for k in range(places.shape[1])
            if visible[:, k].any()
        ],
    }


def _frame_rows(recording: Recording, window: Window) -> Indices:
    """Return rows of at most so many camera frames of a recording, evenly over a window [s]."""
    frames = recording.frames
    time = recording.time[frames]
    shown_frames = frames[(time >= window[0]) & (time <= window[1])]
    chosen = np.unique(np.linspace(0, shown_frames.size - 1, min(shown_frames.size, _MOST_FRAMES)).round().astype(int))
    rows: Indices = shown_frames[chosen]
    return rows


def _arcs(chain: Chain) -> list[Array]:
    return [np.linspace(0.0, link.length, _ARC_POINTS) for link in chain.links]


def _magnified(chain: Chain, q: Array, arcs: Sequence[Array], factor: float) -> tuple[Array, Array]:
    """Return points (F, k, 2) [m] of the links in the base frame, their deflection magnified; and headings (F, k)."""
    rigid = np.zeros_like(q)
    rigid[:, chain.active] = q[:, chain.active]
    in_base = [False] * len(chain.links)
    positions, headings = marker_poses(chain, q, arcs, in_base)
    undeformed, _ = marker_poses(chain, rigid, arcs, in_base)
    return undeformed + factor * (positions - undeformed), headings


def _magnification(chain: Chain, q: Array) -> int:
    """Return by how much deflections are magnified to be seen."""
    arcs, reach = _arcs(chain), sum(link.length for link in chain.links)
    deflection = np.abs(_magnified(chain, q, arcs, 1.0)[0] - _magnified(chain, q, arcs, 0.0)[0]).max()
    return next((factor for factor in _MAGNIFICATIONS if factor * deflection >= _VISIBLE * reach), 1)


def _markers(
    rig: Rig, chain: Chain, simulated: SimulatedRecording, rows: Indices, factor: float
) -> tuple[Array, Array, Mask]:
    """Return simulated and measured markers (F, k, 2) [m] in the base frame, and which of these were measured.

    A measured marker is off the simulated one by its residual, in which the camera's own effects do not count; along
    an axis that was not measured it is not off.
    """
    q, arcs = simulated.simulation.q[rows], [np.array(link.markers) for link in rig.links]
    places, headings = _magnified(chain, q, arcs, factor)
    _, own_headings = marker_poses(chain, q, arcs, [link.markers_frame == "link" for link in rig.links])
    residual = simulated.marker_residual[rows]
    offset = rotate(np.nan_to_num(residual), headings - own_headings)
    visible: Mask = np.asarray(np.isfinite(residual).any(axis=2))
    return places, places + factor * offset, visible


def _pace(slower: float) -> str:
    if 0.9 < slower < 1.1:
        return "real time"
    return f"{number(slower, 2)} × slower" if slower > 1 else f"{number(1 / slower, 2)} × faster"


def _line(points: Array) -> str:
    return " ".join(f"{x:g},{y:g}" for x, y in points.tolist())


def _path(points: Array) -> dict[str, list[float]]:
    return {"x": points[:, 0].tolist(), "y": points[:, 1].tolist()}


def time_histories(
    rig: Rig, comparisons: Sequence[RecordingComparison], labels: Mapping[str, str]
) -> dict[str, Any] | None:
    """Return every measured signal of the recordings beside its simulations, as report.js plots them.

    Values are whole multiples of a tenth of the sensor's noise. Of long recordings those instants are kept that hold
    the extremes of what is measured and of the residuals; of very many recordings the first of `ranked_recordings`.

    Args:
        rig: the arm.
        comparisons: recordings beside their simulations.
        labels: names of the simulations to plot, by their role in a comparison.

    Returns:
        Plain numbers, text, lists and dictionaries; None where nothing was simulated.
    """
    ranked = ranked_recordings(comparisons, labels)
    if not ranked:
        return None
    series = (len(labels) + 1) * (2 * sum(len(link.markers) for link in rig.links) + len(rig.active_links))
    limit = max(1, _MOST_VALUES // (series * _LEAST_INSTANTS))
    kept = [comparison for comparison in comparisons if any(comparison is chosen for chosen in ranked[:limit])]
    instants = min(_MOST_INSTANTS, _MOST_VALUES // (series * len(kept)))
    recordings = [_plotted_recording(rig, comparison, simulations(comparison, labels), instants) for comparison in kept]
    return {
        "labels": labels,
        "first": next(k for k, comparison in enumerate(kept) if comparison is ranked[0]),
        "recordings": recordings,
        "thinned": any(signal["thinned"] for recording in recordings for signal in recording["signals"]),
        "left_out": len(ranked) - len(kept),
    }


def _plotted_recording(
    rig: Rig, comparison: RecordingComparison, simulated: Mapping[str, SimulatedRecording], count: int
) -> dict[str, Any]:
    recording, outermost = comparison.recording, Signal.of(rig, comparison.recording)
    signals = [
        _plotted_signal(measured, comparison.noise, simulated, count) for measured in measured_signals(rig, recording)
    ]
    times: list[list[float]] = []  # markers mostly share theirs
    for signal in signals:
        times += [] if signal["time"] in times else [signal["time"]]
        signal["time"] = times.index(signal["time"])
    first = "" if outermost is None else outermost.name
    return {"label": recording_label(recording), "first": first, "times": times, "signals": signals}


def _plotted_signal(
    signal: Signal, noise: tuple[float, float], simulated: Mapping[str, SimulatedRecording], count: int
) -> dict[str, Any]:
    residuals = {role: signal.residual(simulation) for role, simulation in simulated.items()}
    rows = _extreme_rows(np.nan_to_num(np.stack([signal.value, *residuals.values()], axis=1)), count)
    (factor, unit), sigma, time = signal.unit, noise[0 if signal.is_marker else 1], signal.time[rows]
    step = _ROUNDING * sigma
    digits = 2 - math.floor(math.log10(float(np.diff(time).min()))) if time.size > 1 else 3
    return {
        "name": signal.name,
        "unit": unit,
        "step": factor * step,
        "noise": factor * sigma,
        "thinned": rows.size < signal.time.size,
        "time": [round(instant, max(digits, 0)) for instant in time.tolist()],
        "measured": _whole(signal.value[rows] / step),
        **{role: _whole((signal.value - residual)[rows] / step) for role, residual in residuals.items()},
    }


def _extreme_rows(values: Array, count: int) -> Indices:
    """Return at most so many rows of values (F, s), increasing: in each of even stretches the extremes of each column.

    Both extremes of a stretch are what a line drawn through all its rows covers on a screen.
    """
    if len(values) <= count:
        return np.arange(len(values))
    rows = [0, len(values) - 1]
    for stretch in np.array_split(np.arange(len(values)), max(1, (count - 2) // (2 * values.shape[1]))):
        rows += [*stretch[values[stretch].argmin(axis=0)], *stretch[values[stretch].argmax(axis=0)]]
    return np.unique(rows)


def _whole(values: Array) -> list[int | None]:
    """Return whole numbers; None where a simulation's recording lacks what was measured."""
    return [int(value) if math.isfinite(value) else None for value in np.round(values).tolist()]
