"""What a diagnosis found, in sentences: the first thing a user reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from vjm.report.effect_words import capital, clause, differences_text, named
from vjm.report.verdict import Grade, Verdict
from vjm.report.wording import counted, listed, millimetres, number

if TYPE_CHECKING:
    from vjm.diagnosis.records import Candidate, Cause, Diagnosis

_GRADES: dict[str, Grade] = {"none": "good", "named": "good", "set": "fair", "unknown": "poor", "insufficient": "poor"}
_LEAST_P = 1e-16  # smaller ones are not told apart
_CLEARLY_MORE = 1e-3  # p-value below which what is left is more than noise
_CERTAIN = 0.01  # p-value of the whole search below which a candidate is more than chance
_MOST_SMALL = 3
_MOST_RIVALS = 2  # in a headline
_NEARLY = 1.5  # times the noise; held-out recordings that are missed by less are nearly explained
# The effects whose smallest detectable size is told first: what is asked for most.
_ASKED_FOR = ("tip_payload", "coulomb_friction", "clamp_compliance", "camera_scale", "time_offset", "torque_gain")


def diagnosis_verdict(diagnosis: Diagnosis) -> Verdict:
    """The finding of a diagnosis, and what supports it."""
    headline = {
        "none": _nothing,
        "named": _named,
        "set": _set,
        "unknown": _unknown,
        "insufficient": _insufficient,
    }[diagnosis.verdict](diagnosis)
    return Verdict(headline, _GRADES[diagnosis.verdict], tuple(_points(diagnosis)))


def probability(value: float | None) -> str:
    """A p-value as a person reads it."""
    if value is not None and value < _LEAST_P:
        return "< 10⁻¹⁶"
    return number(value, 2)


def _nothing(diagnosis: Diagnosis) -> str:
    looked = [each for each in diagnosis.candidates if each.testable]
    seen = f"none of the {counted(len(looked), 'candidate')} is needed"
    small = smallest_sizes(diagnosis, 2)
    as_small = f", and an effect as small as {' or '.join(small)} would have been seen" if small else ""
    return f"Nothing is missing: {seen}{as_small}."


def smallest_sizes(diagnosis: Diagnosis, most: int) -> list[str]:
    """The smallest sizes that would be found, of the effects that are asked for most: `a tip payload of 0.4 g`."""
    testable = [each for each in diagnosis.candidates if each.testable and len(each.smallest_detectable) == 1]

    def rank(each: Candidate) -> int:
        return _ASKED_FOR.index(each.effect.id) if each.effect.id in _ASKED_FOR else len(_ASKED_FOR)

    chosen: dict[str, Candidate] = {}
    for each in sorted(testable, key=rank):
        chosen.setdefault(each.effect.id, each)
    return [_small(each) for each in list(chosen.values())[:most]]


def _small(candidate: Candidate) -> str:
    words = candidate.effect.id.replace("_", " ")
    size = differences_text(candidate.effect, candidate.smallest_detectable)
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words} {'' if size.startswith('off') else 'of '}{size}"


def _named(diagnosis: Diagnosis) -> str:
    return f"{_causes(diagnosis)}. {_improvement(diagnosis)}".rstrip()


def _causes(diagnosis: Diagnosis) -> str:
    """All causes, as the beginning of a sentence."""
    return capital(_clauses(diagnosis))


def _clauses(diagnosis: Diagnosis) -> str:
    return "; and ".join(clause(each.effect, diagnosis.model, each.parameters) for each in diagnosis.causes)


def _improvement(diagnosis: Diagnosis) -> str:
    """What is gained, as a sentence; of the training recordings where none was held out."""
    gain, it = diagnosis.gain, "it" if len(diagnosis.causes) == 1 else "them"
    if gain is None:
        return ""
    how = "falls" if gain.after < gain.before else "rises"
    change = f"{how} from {millimetres(gain.before)} to {millimetres(gain.after)}"
    return f"With {it} the held-out error {change} (noise {millimetres(gain.noise)})."


def _set(diagnosis: Diagnosis) -> str:
    parts = []
    for cause in diagnosis.causes:
        own = clause(cause.effect, diagnosis.model, cause.parameters)
        others = [clause(rival.effect, diagnosis.model) for rival in cause.rivals[:_MOST_RIVALS]]
        more = len(cause.rivals) - _MOST_RIVALS
        others += [f"{counted(more, 'other')} (see below)"] if more > 0 else []
        parts.append(f"either {own}, or {', or '.join(others)}" if others else own)
    told = "these recordings cannot tell which"
    return f"{capital('; and '.join(parts))}: {told}. {_improvement(diagnosis)}".rstrip()


def _unknown(diagnosis: Diagnosis) -> str:
    description = diagnosis.remaining.description.rstrip(".")
    ending = f": {description}" if description else ""
    if diagnosis.causes and diagnosis.gain is not None and diagnosis.gain.after < _NEARLY * diagnosis.gain.noise:
        return f"{_causes(diagnosis)}, and something more that no candidate explains{ending}."
    part = f" A part of it looks like this: {_clauses(diagnosis)}." if diagnosis.causes else ""
    return f"Something is missing that no candidate explains{ending}.{part}"


def _insufficient(diagnosis: Diagnosis) -> str:
    why = diagnosis.warnings[0].rstrip(".") if diagnosis.warnings else "they show too little"
    return f"These recordings cannot support a diagnosis: {why}."


def _points(diagnosis: Diagnosis) -> list[str]:
    points = [_sure(each, diagnosis) for each in diagnosis.causes]
    points += _gain_points(diagnosis)
    points += _remaining(diagnosis)
    if diagnosis.verdict == "none":
        small = smallest_sizes(diagnosis, 2 + _MOST_SMALL)[2:]
        points += [f"Also, {listed(small)} would have been seen."] if small else []
        points += _too_small(diagnosis)
    if diagnosis.next_experiment and diagnosis.verdict != "insufficient":
        points.append(f"Next experiment: {diagnosis.next_experiment.rstrip('.')}.")
    return points


def _too_small(diagnosis: Diagnosis) -> list[str]:
    """Candidates that are more than chance, and explain too little to matter."""
    certain = [each for each in diagnosis.candidates if each.p_value is not None and each.p_value < _CERTAIN]
    names = list(dict.fromkeys(each.effect.id.replace("_", " ") for each in certain))[:_MOST_SMALL]
    return [f"More than chance by their p-values, but too small to matter: {listed(names)}."] if names else []


def _sure(cause: Cause, diagnosis: Diagnosis) -> str:
    evidence = f": {cause.evidence.rstrip('.')}" if cause.evidence else ""
    chance = f"the chance that noise alone makes any candidate look so needed is {probability(cause.p_value)}"
    return f"{named(cause.effect.id)}{evidence}; {chance}."


def _gain_points(diagnosis: Diagnosis) -> list[str]:
    gain = diagnosis.gain
    if gain is None:
        return ["No recording was held out: what the causes gain is not tested."] if diagnosis.causes else []
    if not diagnosis.causes:
        return [f"Held-out error {millimetres(gain.before)}, noise {millimetres(gain.noise)}."]
    low, high = (f"{100 * each:.0f}" for each in gain.interval)
    less = f"{abs(100 * gain.reduction):.0f} % {'less' if gain.reduction >= 0 else 'more'}"
    text = f"Held-out error: {less} (95 % interval of the reduction: {low} … {high} %)"
    if gain.runner_up is not None:
        others = listed([named(each.id).lower() for each in diagnosis.runner_up])
        called = f", {others}," if others else ""
        text += f"; the next best explanation{called} leaves {millimetres(gain.runner_up)}"
    return [f"{text}."]


def _remaining(diagnosis: Diagnosis) -> list[str]:
    remaining = diagnosis.remaining
    if diagnosis.verdict in ("unknown", "insufficient") or remaining.p_value is None:
        return []
    if remaining.description:
        return [f"What is left: {remaining.description.rstrip('.')}."]
    chance = probability(remaining.p_value)
    chance = f"p {chance}" if chance.startswith("<") else f"p = {chance}"
    if remaining.p_value < _CLEARLY_MORE:
        return [f"What is left is a little more than noise ({chance}), and too little to matter."]
    return [f"What is left looks like noise ({chance})."]


def indistinct(diagnosis: Diagnosis) -> Sequence[str]:
    """What cannot be told apart and the recording that would, a sentence each."""
    found = []
    for cause in diagnosis.causes:
        for rival in cause.rivals:
            own, other = clause(cause.effect, diagnosis.model), clause(rival.effect, diagnosis.model)
            worse = f"chi² is {number(rival.worse, 2)} larger" if rival.worse >= 0 else "chi² is no larger"
            found.append(f"{capital(own)}, or {other}: with the latter, {worse}.")
            apart = rival.effect.apart_by or cause.effect.apart_by
            if apart:
                found.append(f"{named(rival.effect.id)} would be told from the rest by {apart}.")
    if diagnosis.next_experiment and diagnosis.next_experiment not in diagnosis.warnings:
        found.append(f"Next experiment: {diagnosis.next_experiment.rstrip('.')}.")
    return found
