"""Verdict of a diagnosis: what is missing, how sure that is, and what is gained, read from the findings of its steps.

Nothing is simulated or fitted here: every function is pure, from records to the diagnosis and its texts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vjm.diagnosis.records import (
    EQUIVALENT,
    Budget,
    Diagnosis,
    Gain,
    Remaining,
    RepeatComparison,
    Verdict,
    held_out,
)
from vjm.records import NOT_NOISE, REFERENCE, VISIBLE_SHARE, Array, Experiment, RecordingComparison
from vjm.text import in_sentence, number, ratio


def why_insufficient(experiment: Experiment) -> tuple[str, ...]:
    """Return why recordings cannot support a diagnosis, a sentence each; nothing where they can."""
    train, testing = experiment.with_role("train"), experiment.with_role("holdout")
    referenced = any(recording.condition == REFERENCE for recording in experiment.recordings)
    reasons = []
    if not testing:
        reasons.append(
            'no recording is held out, so no cause can be confirmed: set role = "holdout" on one of another kind or '
            "amplitude"
        )
    if not referenced and sum(recording.kind in ("driven", "decay") for recording in train) < 2:
        reasons.append(
            "only one training recording moves: a model error in it is indistinguishable from another initial state or "
            "stiffness; record at least one more, with another amplitude or drive"
        )
    if referenced and not any(recording.condition == REFERENCE for recording in train):
        reasons.append('all recordings with condition = "reference" are held out: none is left to train on')
    if referenced and all(recording.condition == REFERENCE for recording in train):
        reasons.append(
            'every training recording has condition = "reference", in which the effect sought is absent: none is left '
            "that could show it"
        )
    reasons += [
        f'repeats "{label}" are one experiment, but differ in their condition'
        for label in dict.fromkeys(recording.repeat for recording in experiment.recordings if recording.repeat)
        if len({recording.condition for recording in experiment.recordings if recording.repeat == label}) > 1
    ]
    if testing and all(recording.frames.size < 30 for recording in testing):  # an RMS within 13 % (1/sqrt(2 N))
        reasons.append("the held-out recordings have almost no frames with markers: no cause can be confirmed")
    return tuple(reasons)


def _estimate_gain(recordings: Sequence[RecordingComparison], seed: int) -> Gain | None:
    """Return the improvement of held-out recordings; None where none of them can be simulated by both models.

    The interval is by a block bootstrap of the squared residuals, with blocks as long as these are correlated.
    """
    tested = held_out(recordings)
    if not tested:
        return None
    frames = [_squares(comparison) for comparison in tested]
    before, after, next_best, count = np.sum([part.sum(axis=0) for part in frames], axis=0)
    blocks = []
    for part in frames:
        # The reduction is a ratio of sums: this is how each frame moves it, to first order.
        length = _block_length(part[:, 1] - after / max(before, 1e-300) * part[:, 0])
        blocks.append(np.add.reduceat(part[:, :2], np.arange(0, len(part), length), axis=0))
    stacked = np.concatenate(blocks)
    random, count_of_blocks = np.random.default_rng(seed), len(stacked)
    draws = (random.integers(0, count_of_blocks, count_of_blocks) for _ in range(2000))  # quantiles to 0.06 sigma
    sums = np.array([stacked[draw].sum(axis=0) for draw in draws])  # one after another: there may be many blocks
    low, high = np.quantile(1 - np.sqrt(sums[:, 1] / np.maximum(sums[:, 0], 1e-300)), (0.025, 0.975)).tolist()
    return Gain(
        before=float(np.sqrt(before / count)),
        after=float(np.sqrt(after / count)),
        noise=tested[0].noise[0],
        reduction=float(1 - np.sqrt(after / before)),
        interval=(low, high),
        next_best=float(np.sqrt(next_best / count)) if np.isfinite(next_best) else None,
    )


def _squares(comparison: RecordingComparison) -> Array:
    """Return sums of squares before, after and by the next best model [m^2], and counts of coordinates, by frame."""
    residuals = [
        np.full_like(comparison.recording.markers, np.nan) if simulated is None else simulated.simulation.markers
        for simulated in (comparison.reference, comparison.simulated, comparison.alternative)
    ]
    frames = comparison.recording.frames
    measured = comparison.recording.markers[frames]
    known = np.isfinite(measured)
    squares = [np.where(known, measured - markers[frames], 0.0) ** 2 for markers in residuals]
    return np.column_stack([np.sum(part, axis=(1, 2)) for part in (*squares, known)])


def _block_length(series: Array) -> int:
    """Return the optimal block length of a circular block bootstrap of a series' mean, at most a third of the series.

    For blocks that do not overlap the optimum is an eighth less (Lahiri, Annals of Statistics 27, 1999).

    Source: Politis and White, Econometric Reviews 23, 2004, with the correction by Patton, Politis and White,
    Econometric Reviews 28, 2009, whose constants these are.
    """
    count = len(series)
    centred = series - series.mean()
    run = max(5, int(np.ceil(np.sqrt(np.log10(count)))))
    lags = min(int(np.ceil(np.sqrt(count))) + run, count - 1)
    covariance = np.array([centred[lag:] @ centred[: count - lag] for lag in range(lags + 1)]) / count
    if covariance[0] <= 0 or lags <= run:
        return 1
    significant = np.abs(covariance[1:] / covariance[0]) >= 2 * np.sqrt(np.log10(count) / count)
    quiet = np.lib.stride_tricks.sliding_window_view(~significant, run).all(axis=1)
    last = int(np.argmax(quiet)) if quiet.any() else int(np.flatnonzero(significant)[-1]) + 1
    window = min(2 * max(last, 1), lags)
    lag = np.arange(1, window + 1)
    weighted = np.minimum(1.0, 2 * (1 - lag / window)) * covariance[1 : window + 1]
    slope, long_run = 2 * float(np.sum(lag * weighted)), covariance[0] + 2 * float(np.sum(weighted))
    longest = np.ceil(min(3 * np.sqrt(count), count / 3))
    optimal = (1.5 * slope**2 / max(long_run**2, 1e-300) * count) ** (1 / 3)
    return int(np.ceil(min(max(optimal, 1.0), longest)))


def is_unexplained(findings: Diagnosis) -> bool:
    """Return True if the best model leaves more than noise, or clearly more than was missing before the change."""
    if findings.reference_misfit > 1:
        # Misfits add in squares: at twice the old one, the new one is 1.7 times as large by itself. The old one is that
        # without the effect that was there before, which was fitted to those recordings, and suits others less.
        return findings.changed_misfit > 2 * findings.baseline_misfit
    matters = findings.residuals.excess > findings.negligible
    return bool(findings.needed) or (findings.residuals.p_value < NOT_NOISE and matters)


def conclude(findings: Diagnosis) -> Diagnosis:
    """Add the conclusions: verdict, gain on held-out recordings, what remains, what to do next.

    Causes that together explain too little to be seen in the residual, in training or held out, are dropped. In
    segments, where the search may have ended, some leave hardly a trace, and yet make whole recordings drift apart.
    """
    findings = replace(
        findings,
        noise=f"{findings.noise}; {_noise_by_repeats(findings.repeats)}",
        warnings=tuple(dict.fromkeys(text for text in (*findings.insufficient, *findings.warnings) if text)),
    )
    if findings.insufficient:
        return replace(findings, next_experiment=findings.insufficient[0])
    unexplained = is_unexplained(findings)
    gain = _estimate_gain(findings.recordings, findings.seed)
    if findings.causes and findings.decrease < VISIBLE_SHARE and not _is_visible(gain) and not unexplained:
        findings = _without_causes(findings)
        gain = _estimate_gain(findings.recordings, findings.seed)
    verdict: Verdict = "named" if findings.causes else "none"
    if any(cause.alternatives for cause in findings.causes):
        verdict = "set"
    if unexplained:
        verdict = "unknown"
    elif findings.reference_misfit == 1 and findings.residuals.p_value < NOT_NOISE:
        note = "residuals slightly exceed noise, too little to matter"
        findings = replace(findings, notes=(*findings.notes, note))
    if findings.budget.exhausted:
        findings = replace(findings, warnings=(*findings.warnings, _budget_warning(findings.budget)))
    remaining = Remaining(findings.residuals.p_value, _description(findings))
    next_experiment = _next_experiment(findings, verdict)
    return replace(findings, verdict=verdict, gain=gain, remaining=remaining, next_experiment=next_experiment)


def _is_visible(gain: Gain | None) -> bool:
    """Return True if causes certainly take a visible share off the squared residuals of held-out recordings."""
    return gain is not None and (1 - gain.interval[0]) ** 2 < 1 - VISIBLE_SHARE


def _without_causes(findings: Diagnosis) -> Diagnosis:
    causes = ", ".join(cause.effect.title for cause in findings.causes)
    warning = f"{causes}: certain, but too small to matter: without it the residual is the same to two digits"
    return replace(
        findings,
        causes=(),
        model=findings.reference,
        next_best=(),
        recordings=tuple(replace(pair, simulated=pair.reference, alternative=None) for pair in findings.recordings),
        warnings=(*findings.warnings, warning),
    )


def _budget_warning(budget: Budget) -> str:
    omissions = (
        f"not fully tried: {', '.join(budget.not_tried)}" if budget.not_tried else "small effects were not searched for"
    )
    return (
        f"search stopped at its budget of {budget.seconds:.3g} s with the best model so far; {omissions}; a larger "
        "--budget, fewer --effects or more --jobs would let it finish"
    )


def _description(findings: Diagnosis) -> str:
    """Describe what remains; empty where nothing does."""
    residuals = findings.residuals
    if not is_unexplained(findings):
        if findings.reference_misfit <= 1:
            return ""
        return (
            f"residual {ratio(findings.changed_misfit)} × noise in the changed recordings, "
            f"{ratio(findings.baseline_misfit)} × noise in the reference recordings without effects: no worse than "
            "before the change"
        )
    parts = []
    if residuals.bands and residuals.p_value < NOT_NOISE:
        worst = residuals.bands[0]
        low, high = worst.frequencies
        parts.append(f"largest in the {worst.sensor} of {worst.file}, {number(low)} to {number(high)} Hz")
    parts += [findings.resemblance, _recurrence(findings.repeats)]
    if findings.needed:
        parts.append(f"{in_sentence(findings.needed[0].title)} would explain part of it")
    return "; ".join(part for part in parts if part)


def _recurrence(repeats: RepeatComparison | None) -> str:
    """Say whether the residuals recur; empty where no recordings show that."""
    if repeats is None or not np.isfinite(repeats.recurring_share):
        return ""
    percent = 100 * repeats.recurring_share
    if percent >= 50:
        return f"{percent:.0f} % of it recurs in repeated recordings: systematic"
    return (
        f"{100 - percent:.0f} % of it differs between repeated recordings: a disturbance, stick-slip, or a change from "
        "one to the next"
    )


def _noise_by_repeats(repeats: RepeatComparison | None) -> str:
    if repeats is None:
        return "no two training recordings repeat each other"
    difference = 1e3 * repeats.individual * repeats.noise
    return f"residuals of repeated recordings differ by {number(difference, 2)} mm"


def _next_experiment(findings: Diagnosis, verdict: Verdict) -> str | None:
    ambiguous = next((cause for cause in findings.causes if cause.alternatives), None)
    if ambiguous is not None:
        effects = (ambiguous.effect, *(alternative.effect for alternative in ambiguous.alternatives))
        aim = f"to distinguish {' from '.join(in_sentence(effect.title) for effect in effects)}"
        # A linear forecast may be too large by a factor of three.
        if findings.proposals and findings.proposals[0].difference > 3 * EQUIVALENT:
            best = findings.proposals[0]
            return f"{aim}: {best.text} (expected chi² difference {number(best.difference, 2)})"
        means = dict.fromkeys(part for effect in effects for part in effect.distinguishing_experiment.split("; "))
        return f"{aim}: record {'; or '.join(part for part in means if part)}"
    if verdict != "unknown":
        return None
    if all(recording.kind != "quiet" for recording in findings.experiment.recordings):
        return 'record the arm at rest (kind = "quiet"): what remains without motion is an external disturbance'
    return "repeat the same drive at half and twice the amplitude: a residual that does not scale is nonlinear"
