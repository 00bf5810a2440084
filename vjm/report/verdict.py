"""Verdicts on results: the sentences that a user reads first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vjm.diagnosis.records import Candidate, Cause, Diagnosis
from vjm.identification.check import Check
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.records import Estimate, RecordingComparison
from vjm.report.result_json import bending_stiffness
from vjm.report.text import (
    capital,
    clause,
    counted,
    listed,
    millimetres,
    named,
    number,
    probability,
    short,
    sizes_text,
    unit,
    with_error,
)
from vjm.simulation.model import Model

_MOST_NAMED = 3  # of a list in a sentence; the tables have all
Grade = Literal["good", "fair", "poor"]


@dataclass(frozen=True)
class Verdict:
    """A finding.

    Attributes:
        headline: one or two sentences.
        grade: `good`: as close as the noise allows; `fair`: something small is missing; `poor`: do not trust it yet.
        points: what supports it.
    """

    headline: str
    grade: Grade
    points: tuple[str, ...]


def verdict(result: Check | Identification | Comparison | Diagnosis) -> Verdict:
    """Return what was found, how far it can be trusted, and what supports it."""
    if isinstance(result, Check):
        return _check_verdict(result)
    if isinstance(result, Diagnosis):
        return _diagnosis_verdict(result)
    comparisons = result.recordings
    headline, grade = _closeness(comparisons, "identified" if isinstance(result, Identification) else "given")
    points = _recording_points(comparisons)
    if isinstance(result, Identification):
        if result.status != "converged":
            headline, grade = f"The search has not converged: {result.remedy or 'do not use this model'}.", "poor"
        points += [*_stiffness_points(result), *_undetermined(result.parameters)]
    missing = [item for item in comparisons if item.simulated is None]
    shown = [f"{short(item.recording.file)} ({item.problem})" for item in missing[:_MOST_NAMED]]
    points += [f"Not simulated: {listed(shown)}."] if missing else []
    return Verdict(headline, grade, tuple(points))


def _ratio(comparison: RecordingComparison) -> float:
    return 0.0 if comparison.simulated is None else comparison.simulated.marker_rms / comparison.noise[0]


def _closeness(comparisons: Sequence[RecordingComparison], name: str) -> tuple[str, Grade]:
    """Return one sentence on the worst held-out recording; on the training ones if none was held out."""
    simulated = [item for item in comparisons if item.simulated is not None]
    held_out = [item for item in simulated if item.recording.role == "holdout"]
    if not simulated:
        return "No recording could be simulated.", "poor"
    worst = max(_ratio(item) for item in held_out or simulated)
    ending = "" if held_out else " No recording was held out: prediction is not tested."
    what = "predicts every held-out recording" if held_out else "follows every training recording"
    if len(held_out) == 1:
        what = f"predicts the held-out recording {short(held_out[0].recording.file)}"
    if worst <= 1.1:  # a tenth above the noise is half of it in quadrature: not to be seen in a picture
        return f"The {name} model {what} to within the camera's noise.{ending}", "good" if held_out else "fair"
    if worst <= 1.5:  # what is missing is about as large as the noise
        return f"The {name} model {what} to {number(worst, 2)} times the camera's noise.{ending}", "fair"
    roles = "held-out" if held_out else "training"
    missed = f"misses {roles} recordings by up to {number(worst, 2)} times the camera's noise"
    return f"The {name} model {missed}: something is missing from it.{ending}", "poor"


def _recording_points(comparisons: Sequence[RecordingComparison]) -> list[str]:
    """Return a sentence on each of the worst held-out recordings, then one on the worst of the others."""
    points = []
    for role, words, most in (("holdout", "held out", _MOST_NAMED), ("train", "train", 1)):
        group = sorted((item for item in comparisons if item.recording.role == role), key=_ratio, reverse=True)
        shown = [(item, item.simulated) for item in group if item.simulated is not None]
        name = words if len(shown) == 1 or role == "holdout" else f"worst of {words}"
        for item, simulated in shown[:most]:
            recording = item.recording
            duration = f"{number(float(recording.time[-1] - recording.time[0]), 2)}\N{NO-BREAK SPACE}s"
            others = [("torque method", item.alternative), ("nominal values", item.reference)]
            beside = ", ".join(f"{other}: {millimetres(sim.marker_rms)}" for other, sim in others if sim is not None)
            rms = f"{millimetres(simulated.marker_rms)} RMS over its whole {duration}, open loop"
            text = f"{short(recording.file)} ({name}): {rms}{f' ({beside})' if beside else ''}"
            points.append(f"{text}; the camera's noise is {millimetres(item.noise[0])}.")
    return points


def _stiffness_points(fit: Identification) -> list[str]:
    points = []
    for link, nominal in zip(fit.model.chain.links, fit.nominal.chain.links, strict=True):
        value, std = bending_stiffness(link, fit.parameters, fit.covariance)
        change = 100 * (value / nominal.bending_stiffness - 1)
        beside = f"{abs(change):.1f} % {'above' if change > 0 else 'below'} nominal"
        joints = counted(link.virtual_joints, "virtual joint")
        points.append(f"{link.name}: bending stiffness {with_error(value, std)} {unit('N m^2')}, {beside}; {joints}.")
    return points


def _undetermined(estimates: Sequence[Estimate]) -> list[str]:
    missing = [estimate for estimate in estimates if not estimate.identifiable]
    if len(missing) > _MOST_NAMED:
        names = listed([estimate.name for estimate in missing[:_MOST_NAMED]])
        return [f"{len(missing)} of {len(estimates)} parameters are not determined by these recordings: {names} …"]
    return [f"Not determined by these recordings: {estimate.name} ({_why(estimate)})." for estimate in missing]


def _why(estimate: Estimate) -> str:
    return f"{estimate.reason}; it takes {estimate.remedy}" if estimate.remedy else estimate.reason


def _check_verdict(check: Check) -> Verdict:
    trained, held_out = (len(check.experiment.with_role(role)) for role in ("train", "holdout"))
    links = zip(check.experiment.rig.links, check.virtual_joints, strict=False)
    joints = ", ".join(f"{link.name} {count}" for link, count in links)
    points = (
        f"virtual joints: {joints or 'none'}",
        f"natural frequencies expected: {', '.join(number(frequency) for frequency in check.modes[:5])} Hz",
        *(f"--parameters {kind}: {_share(estimates)}" for kind, estimates in check.identifiable.items()),
    )
    headline = f"{counted(trained, 'recording')} to train on, {held_out} held out."
    return Verdict(headline, "poor" if check.problem else "fair" if check.warnings else "good", points)


def _share(estimates: Sequence[Estimate]) -> str:
    """Return how many of the parameters the recordings determine, and which they do not."""
    missing = [estimate for estimate in estimates if not estimate.identifiable]
    text = f"{len(estimates) - len(missing)} of {len(estimates)} parameters determined"
    if not missing:
        return text
    few = len(missing) <= 2
    names = [f"{each.name} ({_why(each)})" if few else each.name for each in missing[: 2 * _MOST_NAMED]]
    return f"{text}; not {', '.join(names)}{' …' if len(missing) > 2 * _MOST_NAMED else ''}"


def _diagnosis_verdict(diagnosis: Diagnosis) -> Verdict:
    headline, grade = _diagnosis_headline(diagnosis)
    points = _cause_points(diagnosis) + _gain_points(diagnosis) + _residual_points(diagnosis)
    if diagnosis.verdict == "none":
        more = _detectable(diagnosis)[2 : 2 + _MOST_NAMED]
        points += [f"Also, {listed(more)} would have been detected."] if more else []
        # Each p-value is of the whole search, of all candidates: one in a hundred of such searches is wrong.
        certain = [item.effect.id for item in diagnosis.candidates if item.p_value is not None and item.p_value < 0.01]
        names = [name.replace("_", " ") for name in dict.fromkeys(certain)][:_MOST_NAMED]
        points += [f"Significant by their p-values, but too small to matter: {listed(names)}."] if names else []
    if diagnosis.verdict != "insufficient":
        points += _next_point(diagnosis)
    return Verdict(headline, grade, tuple(points))


def _diagnosis_headline(diagnosis: Diagnosis) -> tuple[str, Grade]:
    kind, gain = diagnosis.verdict, diagnosis.gain
    if kind == "none":
        testable = sum(candidate.testable for candidate in diagnosis.candidates)
        small = _detectable(diagnosis)[:2]
        as_small = f", and an effect as small as {' or '.join(small)} would have been detected" if small else ""
        return f"Nothing is missing: none of the {counted(testable, 'candidate')} is needed{as_small}.", "good"
    if kind == "insufficient":
        why = diagnosis.warnings[0].rstrip(".") if diagnosis.warnings else "they show too little"
        return f"These recordings cannot support a diagnosis: {why}.", "poor"
    causes = "; and ".join(clause(cause.effect, diagnosis.model, cause.parameters) for cause in diagnosis.causes)
    if kind == "named":
        return f"{capital(causes)}. {_improvement(diagnosis)}".rstrip(), "good"
    if kind == "set":
        choices = "; and ".join(_choice(cause, diagnosis.model) for cause in diagnosis.causes)
        text = f"{capital(choices)}: these recordings cannot distinguish them. {_improvement(diagnosis)}"
        return text.rstrip(), "fair"
    description = diagnosis.remaining.description.rstrip(".")
    ending = f": {description}" if description else ""
    # Causes lead where what they leave unexplained is about as large as the noise.
    if diagnosis.causes and gain is not None and gain.after < 1.5 * gain.noise:
        return f"{capital(causes)}, and something more that no candidate explains{ending}.", "poor"
    part = f" A part of it looks like this: {causes}." if diagnosis.causes else ""
    return f"Something is missing that no candidate explains{ending}.{part}", "poor"


def _choice(cause: Cause, model: Model) -> str:
    """Return a cause and what cannot be told from it: `either A, or B`."""
    own = clause(cause.effect, model, cause.parameters)
    others = [clause(item.effect, model) for item in cause.alternatives[:2]]
    more = len(cause.alternatives) - len(others)
    others += [f"{counted(more, 'other')} (see below)"] if more else []
    return f"either {own}, or {', or '.join(others)}" if others else own


def _detectable(diagnosis: Diagnosis) -> list[str]:
    """Return the smallest sizes that would be found, of frequent causes first: `a tip payload of 0.4 g`."""
    chosen: dict[str, Candidate] = {}
    for candidate in sorted(diagnosis.candidates, key=lambda candidate: not candidate.effect.common):
        if candidate.testable and len(candidate.smallest_detectable) == 1:
            chosen.setdefault(candidate.effect.id.replace("_", " "), candidate)
    sizes = {words: sizes_text(item.effect, item.smallest_detectable, from_null=True) for words, item in chosen.items()}
    return [
        f"{'an' if words[0] in 'aeiou' else 'a'} {words} {'' if size.startswith('off') else 'of '}{size}"
        for words, size in sizes.items()
    ]


def _improvement(diagnosis: Diagnosis) -> str:
    """Return what is gained on held-out recordings, as a sentence; empty if none was held out."""
    gain = diagnosis.gain
    if gain is None:
        return ""
    with_them = f"With {'it' if len(diagnosis.causes) == 1 else 'them'}"
    change = f"{'falls' if gain.after < gain.before else 'rises'} from {millimetres(gain.before)}"
    return f"{with_them} the held-out error {change} to {millimetres(gain.after)} (noise {millimetres(gain.noise)})."


def _cause_points(diagnosis: Diagnosis) -> list[str]:
    points = []
    for cause in diagnosis.causes:
        evidence = f": {cause.evidence.rstrip('.')}" if cause.evidence else ""
        chance = f"noise alone makes any candidate look as necessary is {probability(cause.p_value)}"
        points.append(f"{named(cause.effect.id)}{evidence}; the probability that {chance}.")
    return points


def _gain_points(diagnosis: Diagnosis) -> list[str]:
    gain = diagnosis.gain
    if gain is None:
        return ["No recording was held out: what the causes gain is not tested."] if diagnosis.causes else []
    if not diagnosis.causes:
        return [f"Held-out error {millimetres(gain.before)}, noise {millimetres(gain.noise)}."]
    low, high = (f"{100 * bound:.0f}" for bound in gain.interval)
    less = f"{abs(100 * gain.reduction):.0f} % {'less' if gain.reduction >= 0 else 'more'}"
    text = f"Held-out error: {less} (95 % interval of the reduction: {low} … {high} %)"
    if gain.next_best is not None:
        others = listed([named(effect.id).lower() for effect in diagnosis.next_best])
        text += (
            f"; with the next best explanation{f', {others},' if others else ''} it is {millimetres(gain.next_best)}"
        )
    return [f"{text}."]


def _residual_points(diagnosis: Diagnosis) -> list[str]:
    remaining = diagnosis.remaining
    if diagnosis.verdict in ("unknown", "insufficient") or remaining.p_value is None:
        return []
    if remaining.description:
        return [f"Residual: {remaining.description.rstrip('.')}."]
    chance = probability(remaining.p_value)
    chance = f"p {chance}" if chance.startswith("<") else f"p = {chance}"
    if remaining.p_value < 1e-3:  # seldom by chance; the verdict judges by size what this test shows in long recordings
        return [f"The residual is slightly more than noise ({chance}), and too little to matter."]
    return [f"The residual looks like noise ({chance})."]


def _next_point(diagnosis: Diagnosis) -> list[str]:
    text = diagnosis.next_experiment
    return [f"Next experiment: {text.rstrip('.')}."] if text else []


def alternative_points(diagnosis: Diagnosis) -> list[str]:
    """Return the causes that cannot be distinguished and the recording that would, a sentence each."""
    points = []
    for cause in diagnosis.causes:
        for item in cause.alternatives:
            own, other = clause(cause.effect, diagnosis.model), clause(item.effect, diagnosis.model)
            worse = f"chi² is {number(item.worse, 2)} larger" if item.worse >= 0 else "chi² is no larger"
            points.append(f"{capital(own)}, or {other}: with the latter, {worse}.")
            apart = item.effect.distinguishing_experiment or cause.effect.distinguishing_experiment
            points += [f"{named(item.effect.id)} would be distinguished from the rest by {apart}."] if apart else []
    return points + (_next_point(diagnosis) if diagnosis.next_experiment not in diagnosis.warnings else [])
