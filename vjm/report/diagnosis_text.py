"""What a diagnosis found, in sentences: the first thing a user reads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from vjm.effects.effect import Effect
from vjm.report.text import UNKNOWN, Grade, Verdict, counted, listed, millimetres, number, unit, with_error
from vjm.simulation.model import Model

if TYPE_CHECKING:
    from vjm.diagnosis.records import Candidate, Cause, Diagnosis
    from vjm.records import Estimate


# Everyday units, the largest first; each is used from a tenth of it on.
_SCALES: Mapping[str, tuple[tuple[float, str], ...]] = {
    "kg": ((1.0, "kg"), (1e-3, "g")),
    "N": ((1.0, "N"), (1e-3, "mN")),
    "N m": ((1.0, "N m"), (1e-3, "mN m")),
    "N m s/rad": ((1.0, "N m s/rad"), (1e-3, "mN m s/rad")),
    "s": ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")),
    "s/m": ((1.0, "s/m"), (1e-3, "ms/m")),
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")),
    "rad": ((math.pi / 180, "°"),),
    "rad/(N m)": ((math.pi / 180, "°/(N m)"),),
    "1/s": ((1e-2, "%/s"),),
}


def quantity(value: float, std: float | None, unit_name: str, digits: int = 2) -> str:
    """A value with its standard error, if it has one, in an everyday unit: `13.30 ± 0.10 g`."""
    if not math.isfinite(value):
        return UNKNOWN
    factor, name = _scale(value, unit_name)
    text = number(value / factor, digits) if std is None else with_error(value / factor, std / factor)
    between = "" if name.startswith("°") and "±" not in text and "×" not in text else " "
    return f"{text}{between}{name}".rstrip()


def place(effect: Effect, model: Model) -> str:
    """Name of the link, or of the joint at its proximal end, where an effect acts; empty for what is camera-wide."""
    return "" if effect.link is None else model.chain.links[effect.link].name


def clause(effect: Effect, model: Model, sizes: Mapping[str, Estimate] | None = None) -> str:
    """An effect with its numbers, as in "the data need: ...".

    Args:
        effect: with its parameters.
        model: names the links.
        sizes: with standard errors; None: the effect's own values, without.
    """
    units = {each.name: each for each in effect.parameters()}
    texts = {}
    for name, value in effect.values.items():
        size = None if sizes is None else sizes.get(name)
        if units[name].integer:
            texts[name] = str(int(value))
        elif size is None:
            texts[name] = quantity(value, None, units[name].unit, 3)
        else:
            texts[name] = quantity(size.value, size.std, size.unit, 4)
    link = place(effect, model) or model.chain.links[0].name
    if effect.clause:
        return effect.clause.format(link=link, **texts)
    values = ", ".join(f"{name} {text}" for name, text in texts.items())
    where = f" ({link})" if effect.link is not None else ""
    return f"{effect.description or effect.id}{where}{': ' if values else ''}{values}"


def capital(text: str) -> str:
    """With a capital letter first."""
    return text[:1].upper() + text[1:]


def sizes_text(effect: Effect, sizes: Mapping[str, float]) -> str:
    """Sizes of an effect's parameters by name, without errors: `13 g`, or `gx 0.10, gy 0.02 m/s²`.

    Of a parameter whose null is no zero, as a scale, it is the difference: `+0.04 %`.
    """
    off = {each.name: each.null for each in effect.parameters() if each.null and math.isfinite(each.null)}
    units = {each.name: each.unit for each in effect.parameters()}
    if len(sizes) == 1:
        (name, value) = next(iter(sizes.items()))
        if name in off and not units[name] and math.isfinite(value):
            return f"{'+' if value >= off[name] else '-'}{number(100 * abs(value - off[name]), 2)} %"
    return _together([(name, value, units.get(name, "")) for name, value in sizes.items()])


def _together(sizes: list[tuple[str, float, str]]) -> str:
    """Values by name; those of one unit share it: `along 4.0, across -6.0 mm`."""
    if len(sizes) == 1:
        return quantity(sizes[0][1], None, sizes[0][2])
    if len({unit_name for *_, unit_name in sizes}) == 1 and all(math.isfinite(value) for _, value, _ in sizes):
        largest = max(abs(value) for _, value, _ in sizes)
        factor, name = _scale(largest, sizes[0][2])
        last = max(1 - math.floor(math.log10(largest / factor)), 0) if largest > 0 else 0
        values = ", ".join(f"{own} {round(value / factor, last) + 0.0:.{last}f}" for own, value, _ in sizes)
        return f"{values} {name}".rstrip()
    return ", ".join(f"{own} {quantity(value, None, unit_name)}" for own, value, unit_name in sizes) or UNKNOWN


def _scale(value: float, unit_name: str) -> tuple[float, str]:
    """The everyday unit in which a value is best read, in SI units, and its name."""
    scales = _SCALES.get(unit_name, ((1.0, unit(unit_name)),))
    return next((each for each in scales if abs(value) >= 0.1 * each[0]), scales[-1])


def differences_text(effect: Effect, sizes: Mapping[str, float]) -> str:
    """The same of sizes given as differences from the null: `off by 0.04 %` where that is no zero."""
    for each in effect.parameters():
        off = bool(each.null) and math.isfinite(each.null)
        if off and not each.unit and list(sizes) == [each.name]:
            return f"off by {number(100 * sizes[each.name], 2)} %"
    units = {each.name: each.unit for each in effect.parameters()}
    return _together([(name, value, units.get(name, "")) for name, value in sizes.items()])


def named(identifier: str) -> str:
    """An effect's id as words: `Tip payload`."""
    return capital(identifier.replace("_", " "))


def carried_points(effects: Sequence[Effect], model: Model) -> tuple[str, ...]:
    """Which effects the URDF carries and which only model.json has, a sentence each; none without effects."""
    points = []
    for carried, words in (
        (True, "model.urdf and model.json hold"),
        (False, "Only model.json holds, as URDF has no word for it"),
    ):
        chosen = [each for each in effects if each.in_urdf is carried]
        names = [f"{named(each.id).lower()}{_at(each, model)}" for each in chosen]
        if names:
            points.append(f"{words}: {', '.join(names)}.")
    return tuple(points)


def _at(effect: Effect, model: Model) -> str:
    where = place(effect, model)
    return f" ({where})" if where else ""


_GRADES: dict[str, Grade] = {"none": "good", "named": "good", "set": "fair", "unknown": "poor", "insufficient": "poor"}
_LEAST_P = 1e-16  # smaller ones are not told apart
_CLEARLY_MORE = 1e-3  # p-value below which what is left is more than noise
_CERTAIN = 0.01  # p-value of the whole search below which a candidate is more than chance
_MOST_SMALL = 3
_MOST_RIVALS = 2  # in a headline
_NEARLY = 1.5  # times the noise; held-out recordings that are missed by less are nearly explained


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
    candidate_set = [each for each in diagnosis.candidates if each.testable]
    seen = f"none of the {counted(len(candidate_set), 'candidate')} is needed"
    small = smallest_sizes(diagnosis, 2)
    as_small = f", and an effect as small as {' or '.join(small)} would have been seen" if small else ""
    return f"Nothing is missing: {seen}{as_small}."


def smallest_sizes(diagnosis: Diagnosis, most: int) -> list[str]:
    """The smallest sizes that would be found, of the effects that are asked for most: `a tip payload of 0.4 g`."""
    testable = [each for each in diagnosis.candidates if each.testable and len(each.smallest_detectable) == 1]
    chosen: dict[str, Candidate] = {}
    for each in sorted(testable, key=lambda candidate: not candidate.effect.common):
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
        others = [clause(alternative.effect, diagnosis.model) for alternative in cause.alternatives[:_MOST_RIVALS]]
        more = len(cause.alternatives) - _MOST_RIVALS
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
    if gain.next_best is not None:
        others = listed([named(each.id).lower() for each in diagnosis.next_best])
        called = f", {others}," if others else ""
        text += f"; the next best explanation{called} leaves {millimetres(gain.next_best)}"
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
        for alternative in cause.alternatives:
            own, other = clause(cause.effect, diagnosis.model), clause(alternative.effect, diagnosis.model)
            worse = f"chi² is {number(alternative.worse, 2)} larger" if alternative.worse >= 0 else "chi² is no larger"
            found.append(f"{capital(own)}, or {other}: with the latter, {worse}.")
            apart = alternative.effect.distinguishing_experiment or cause.effect.distinguishing_experiment
            if apart:
                found.append(f"{named(alternative.effect.id)} would be told from the rest by {apart}.")
    if diagnosis.next_experiment and diagnosis.next_experiment not in diagnosis.warnings:
        found.append(f"Next experiment: {diagnosis.next_experiment.rstrip('.')}.")
    return found
