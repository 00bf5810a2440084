"""Time histories of a report as numbers, for plots that a reader can zoom into."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vjm.records import Array, Indices, RecordingComparison, Rig, SimulatedRecording
from vjm.report.figures.panels import LINES
from vjm.report.figures.signals import Signal, measured_signals, ranked_recordings
from vjm.report.text import recording_label

_ROUNDING = 0.1  # of the noise: rounding adds less than a thousandth to the variance of a residual
_MOST_INSTANTS = 2000  # of a recording, about two a pixel of a wide screen
_LEAST_INSTANTS = 500  # where there are many, rather fewer recordings than fewer instants
_MOST_VALUES = 500_000  # of all recordings together, some 2.5 MB


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
    roles = [role for role in LINES if role in labels and role != "alternative"]
    ranked = ranked_recordings(comparisons, roles)
    if not ranked:
        return None
    series = (len(roles) + 1) * (2 * sum(len(link.markers) for link in rig.links) + len(rig.active_links))
    most = max(1, _MOST_VALUES // (series * _LEAST_INSTANTS))
    kept = [each for each in comparisons if any(each is one for one in ranked[:most])]
    instants = min(_MOST_INSTANTS, _MOST_VALUES // (series * len(kept)))
    recordings = [_recording(rig, each, roles, instants) for each in kept]
    return {
        "labels": {role: labels[role] for role in roles},
        "first": next(k for k, each in enumerate(kept) if each is ranked[0]),
        "recordings": recordings,
        "thinned": any(signal["thinned"] for recording in recordings for signal in recording["signals"]),
        "left_out": len(ranked) - len(kept),
    }


def _simulations(comparison: RecordingComparison, roles: Sequence[str]) -> dict[str, SimulatedRecording]:
    pairs = {role: getattr(comparison, role) for role in roles}
    return {role: simulated for role, simulated in pairs.items() if simulated is not None}


def _recording(rig: Rig, comparison: RecordingComparison, roles: Sequence[str], most: int) -> dict[str, Any]:
    recording, outermost = comparison.recording, Signal.of(rig, comparison.recording)
    simulations = _simulations(comparison, roles)
    signals = [_signal(each, comparison, simulations, most) for each in measured_signals(rig, recording)]
    times: list[list[float]] = []  # markers mostly share theirs
    for signal in signals:
        times += [] if signal["time"] in times else [signal["time"]]
        signal["time"] = times.index(signal["time"])
    first = "" if outermost is None else outermost.name
    return {"label": recording_label(recording), "first": first, "times": times, "signals": signals}


def _signal(
    signal: Signal, comparison: RecordingComparison, simulations: Mapping[str, SimulatedRecording], most: int
) -> dict[str, Any]:
    residuals = {role: signal.residual(simulated) for role, simulated in simulations.items()}
    rows = telling_rows(np.nan_to_num(np.stack([signal.value, *residuals.values()], axis=1)), most)
    (factor, unit), noise = signal.unit, comparison.noise[0 if signal.is_marker else 1]
    step, time = _ROUNDING * noise, signal.time[rows]
    digits = 2 - math.floor(math.log10(float(np.diff(time).min()))) if time.size > 1 else 3
    return {
        "name": signal.name,
        "unit": unit,
        "step": factor * step,
        "noise": factor * noise,
        "thinned": rows.size < signal.time.size,
        "time": [round(instant, max(digits, 0)) for instant in time.tolist()],
        "measured": _whole(signal.value[rows] / step),
        **{role: _whole((signal.value - residual)[rows] / step) for role, residual in residuals.items()},
    }


def telling_rows(values: Array, most: int) -> Indices:
    """Return at most so many rows of values (F, s), increasing: in each of even stretches the extremes of each column.

    Both extremes of a stretch are what a line drawn through all its rows covers on a screen.
    """
    if len(values) <= most:
        return np.arange(len(values))
    rows = [0, len(values) - 1]
    for stretch in np.array_split(np.arange(len(values)), max(1, (most - 2) // (2 * values.shape[1]))):
        rows += [*stretch[values[stretch].argmin(axis=0)], *stretch[values[stretch].argmax(axis=0)]]
    return np.unique(rows)


def _whole(values: Array) -> list[int | None]:
    """Return whole numbers; None where a simulation's recording lacks what was measured."""
    return [int(value) if math.isfinite(value) else None for value in np.round(values).tolist()]
