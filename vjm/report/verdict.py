"""What was found, in sentences: the first thing a user reads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vjm.identification.records import Identification, RecordingFit, TrajectorySummary
from vjm.model import Model
from vjm.report.comparison import Comparison
from vjm.report.tables import nominal_value, unit
from vjm.report.wording import counted, listed, millimetres, number, short, with_error
from vjm.result import bending_stiffness

Grade = Literal["good", "fair", "poor"]
_AT_NOISE, _NEAR_NOISE = 1.1, 1.5  # residual over noise
_MOST_NAMED = 3


@dataclass(frozen=True)
class Verdict:
    """A finding.

    Attributes:
        headline: one sentence.
        grade: `good`: as close as the noise allows; `fair`: something small is missing; `poor`: do not trust it yet.
        points: what supports it.
    """

    headline: str
    grade: Grade
    points: tuple[str, ...]


def identification_verdict(fit: Identification) -> Verdict:
    """What an identification found, and how far it can be trusted."""
    headline, grade = _how_close(fit.recordings, "identified")
    if fit.status != "converged":
        headline, grade = f"The search has not converged: {fit.remedy or 'do not use this model'}.", "poor"
    points = [*_closeness(fit.recordings), *_stiffnesses(fit), *_undetermined(fit), *_unsimulated(fit.recordings)]
    return Verdict(headline, grade, tuple(points))


def comparison_verdict(comparison: Comparison) -> Verdict:
    """How well a given model follows the recordings."""
    headline, grade = _how_close(comparison.recordings, "given")
    points = [*_closeness(comparison.recordings), *_unsimulated(comparison.recordings)]
    return Verdict(headline, grade, tuple(points))


def _ratio(fit: RecordingFit) -> float:
    return 0.0 if fit.replay is None else fit.replay.marker_rms / fit.marker_noise


def _how_close(fits: Sequence[RecordingFit], name: str) -> tuple[str, Grade]:
    """One sentence on the worst held-out recording; on the training ones where none was held out."""
    replayed = [fit for fit in fits if fit.replay is not None]
    held_out = [fit for fit in replayed if fit.recording.role == "holdout"]
    if not replayed:
        return "No recording could be simulated.", "poor"
    worst = max(_ratio(fit) for fit in held_out or replayed)
    ending = "" if held_out else " No recording was held out: how it predicts is not tested."
    what = "predicts every held-out recording" if held_out else "follows every training recording"
    if len(held_out) == 1:
        what = f"predicts the held-out recording {short(held_out[0].recording.file)}"
    if worst <= _AT_NOISE:
        return f"The {name} model {what} to within the camera's noise.{ending}", "good" if held_out else "fair"
    if worst <= _NEAR_NOISE:
        return f"The {name} model {what} to {number(worst, 2)} times the camera's noise.{ending}", "fair"
    what = "held-out" if held_out else "training"
    missed = f"misses {what} recordings by up to {number(worst, 2)} times the camera's noise"
    return f"The {name} model {missed}: something is missing from it.{ending}", "poor"


def _closeness(fits: Sequence[RecordingFit]) -> list[str]:
    """The worst of the held-out recordings, in millimetres; then of the others."""
    points = []
    for role, words in (("holdout", "held out"), ("train", "train")):
        group = [fit for fit in fits if fit.replay is not None and fit.recording.role == role]
        for fit in sorted(group, key=_ratio, reverse=True)[: _MOST_NAMED if role == "holdout" else 1]:
            points.append(_one_recording(fit, words if len(group) == 1 or role == "holdout" else f"worst of {words}"))
    return points


def _one_recording(fit: RecordingFit, words: str) -> str:
    seconds = float(fit.recording.time[-1] - fit.recording.time[0])
    text = (
        f"{short(fit.recording.file)} ({words}): {millimetres(fit.replay.marker_rms if fit.replay else None)} RMS "
        f"over its whole {number(seconds, 2)}\N{NO-BREAK SPACE}s, open loop"
    )
    if fit.torque is not None:
        others = [("torque method", fit.torque), ("nominal values", fit.nominal)]
        named = [f"{words}: {millimetres(each.marker_rms)}" for words, each in others if each is not None]
        text += f" ({', '.join(named)})"
    elif fit.nominal is not None:
        text += f"; {millimetres(fit.nominal.marker_rms)} with nominal values"
    return f"{text}; the camera's noise is {millimetres(fit.marker_noise)}."


def _stiffnesses(fit: Identification) -> list[str]:
    points = []
    for link in fit.model.chain.links:
        value, std = bending_stiffness(link, fit.parameters, fit.covariance)
        text = f"{link.name}: bending stiffness {with_error(value, std)} {unit('N m^2')}"
        before = nominal_value(f"{link.name}.bending_stiffness", fit.nominal.chain)
        if before:
            change = 100 * (value / before - 1)
            text += f", {abs(change):.1f} % {'above' if change > 0 else 'below'} nominal"
        points.append(f"{text}; {counted(link.virtual_joints, 'virtual joint')}.")
    return points


def _undetermined(fit: Identification) -> list[str]:
    missing = [estimate for estimate in fit.parameters if not estimate.identifiable]
    if not missing:
        return []
    if len(missing) <= _MOST_NAMED:
        return [
            f"Not determined by these recordings: {each.name} ({each.reason})"
            + (f"; it takes {each.remedy}." if each.remedy else ".")
            for each in missing
        ]
    names = listed([each.name for each in missing[:_MOST_NAMED]])
    return [f"{len(missing)} of {len(fit.parameters)} parameters are not determined by these recordings: {names} …"]


def _unsimulated(fits: Sequence[RecordingFit]) -> list[str]:
    missing = [fit for fit in fits if fit.replay is None]
    shown = [f"{short(fit.recording.file)} ({fit.problem})" for fit in missing[:_MOST_NAMED]]
    return [f"Not simulated: {listed(shown)}."] if missing else []


def settings(fit: Identification) -> list[tuple[str, str]]:
    """How the identification was made: term and description."""
    rows = [
        ("Method", f"{fit.method}, parameters {fit.parametrisation}; {fit.status}"),
        ("Virtual joints", listed([f"{link.name}: {link.virtual_joints}" for link in fit.model.chain.links])),
        ("Marker noise", f"{millimetres(fit.model.marker_noise)} ({_source(fit.experiment.rig.marker_noise)})"),
        *_encoder(fit.model),
        *_trajectories(fit.trajectory),
    ]
    if fit.objective is not None:
        before, after = number(fit.objective_nominal, 4), number(fit.objective, 4)
        rows.append(("J, eq. (15)", f"nominal model {before}, identified {after}"))
    for k, link in enumerate(fit.model.rig.links):
        shapes = [data.angles.shapes[k] for data in fit.torque_data[:1]]
        rows += [(f"Shape functions, {link.name}", f"{shape.family}, order {shape.order}") for shape in shapes]
    for data in fit.torque_data:
        frames, lost = data.angles.time.size, data.angles.unsolved
        smoothing = data.derivatives.smoothing
        how = "interpolated" if smoothing is None else f"smoothing spline, penalty 10^{smoothing:.1f}"
        text = f"{frames} frames, {lost} without a solution; {how}"
        rows.append((f"Used from {data.recording.file}", text))
        noise = data.derivatives.noise(np.sqrt(np.diag(data.angles.covariance))).max(axis=1)
        values = f"{number(1e3 * noise[0], 2)} mrad, {number(noise[1], 2)} rad/s, {number(noise[2], 2)} rad/s²"
        rows.append((f"Noise in {data.recording.file}", f"angle, rate and acceleration of the worst joint: {values}"))
    return rows


def _trajectories(summary: TrajectorySummary | None) -> list[tuple[str, str]]:
    if summary is None:
        return []
    mean = number(summary.chi2_per_sample, 4)
    text = f"mean square residual {mean} times the noise's, over {summary.fit.point.count} measured values"
    searched = f"{counted(summary.fit.iterations, 'simulation')} of all recordings"
    return [("Trajectories", f"{text}; {searched} in the last search")]


def _encoder(model: Model) -> list[tuple[str, str]]:
    if not model.rig.active_links:
        return []
    noise = f"{number(1e3 * model.encoder_noise, 2)} mrad ({_source(model.rig.encoder_noise)})"
    return [("Encoder noise", noise)]


def _source(given: float | None) -> str:
    return "estimated from the recordings" if given is None else "from the experiment file"
