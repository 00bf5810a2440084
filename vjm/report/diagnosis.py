"""Diagnoses as pages: their sentences, tables and sections."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from vjm.diagnosis.records import Candidate, Cause, Diagnosis
from vjm.records import RecordingComparison
from vjm.report.identification import carried_points, parameter_table, recording_table
from vjm.report.page import Grade, Page, Section, Table
from vjm.report.text import (
    MOST_NAMED,
    UNKNOWN,
    capital,
    clause,
    counted,
    listed,
    millimetres,
    named,
    number,
    place,
    quantity,
    sizes_text,
    unit,
    with_error,
)
from vjm.simulation.model import Model

if TYPE_CHECKING:
    from vjm.report.figures.panels import Picture

_METHOD = (
    "The model without effects is fitted to all training recordings at once. The error of its few virtual joints is "
    "measured with a finer chain and corrected, so that it is not taken for an effect. Each candidate is then judged "
    "by a score test beside it, every other parameter being free; the best ones, alone and in pairs, are fitted "
    "together with all other parameters. The p-value is for the whole search: the probability that noise alone makes "
    "any candidate look as necessary. Held-out recordings take no part in any of this. z is the number of standard "
    "errors by which a candidate's size differs from zero beside the model without effects: where one thing is "
    "missing, everything that looks like it has a large z too."
)


def diagnosis_page(diagnosis: Diagnosis, pictures: Sequence[Picture] | None = None) -> Page:
    """Return the page of a diagnosis: the report with its pictures, or without any a summary."""
    headline, grade = _headline(diagnosis)
    if diagnosis.causes and diagnosis.recommended is diagnosis.reference:
        headline, grade = f"{_harm(diagnosis)} {headline}", "poor"
    if diagnosis.budget.exhausted and diagnosis.budget.not_tried:
        untried = listed([named(name).lower() for name in diagnosis.budget.not_tried[:MOST_NAMED]])
        more = len(diagnosis.budget.not_tried) - MOST_NAMED
        others = f" and {counted(more, 'other')}" if more > 0 else ""
        headline, grade = f"{headline} The search ran out of time before it had tried {untried}{others}.", "poor"
    points = _minor_points(diagnosis) + _cause_points(diagnosis) + _gain_points(diagnosis) + _residual_points(diagnosis)
    if diagnosis.verdict == "none":
        points += _small_effect_points(diagnosis)
    if diagnosis.verdict != "insufficient":
        points += _next_points(diagnosis)
    symptoms_heading = "Symptoms of the model without effects"
    causes = [_cause_table(diagnosis)] if diagnosis.causes else []
    recordings, carried = _recording_table(diagnosis), carried_points(diagnosis.model)
    if pictures is None:
        sections = [
            Section(symptoms_heading, _symptom_points(diagnosis, 4)),
            Section(tables=[*causes, _candidate_table(diagnosis, 6), recordings]),
            Section(points=carried),
        ]
    else:
        wrong, evidence = ([each for each in pictures if each.name.startswith(kind)] for kind in ("symptom", "cause"))
        gained = [picture for picture in pictures if not picture.name.startswith(("symptom", "cause"))]
        nothing_wrong = ["The model without effects follows every recording to within the noise."]
        symptoms = _symptom_points(diagnosis, 8) or (nothing_wrong if diagnosis.symptoms else [])
        parameters = parameter_table(diagnosis.parameters, diagnosis.reference.chain, "without the causes")
        noise = [("Noise", diagnosis.noise)] if diagnosis.noise else []
        notes = [("Note", note) for note in diagnosis.notes]
        gain_heading = "Gain" if diagnosis.causes else "Fit per recording"
        sections = [
            Section(symptoms_heading, symptoms, pictures=wrong),
            Section("Causes", tables=causes, pictures=evidence),
            Section("Causes that cannot be distinguished", _alternative_points(diagnosis)),
            Section(gain_heading, tables=[recordings], pictures=gained),
            Section("Candidates", tables=[_candidate_table(diagnosis)]),
            Section("Model", carried, [parameters]),
            Section("Method", terms=noise + notes, text=_METHOD),
        ]
    return Page(diagnosis.experiment.rig.name, "diagnosis", headline, grade, points, diagnosis.warnings, sections)


def _headline(diagnosis: Diagnosis) -> tuple[str, Grade]:
    kind, gain = diagnosis.verdict, diagnosis.gain
    if kind == "none":
        testable = sum(candidate.testable for candidate in diagnosis.candidates)
        small = _detectable(diagnosis)[:2]
        as_small = f", and an effect as small as {' or '.join(small)} would have been detected" if small else ""
        return f"Nothing is missing: none of the {counted(testable, 'candidate')} is needed{as_small}.", "good"
    if kind == "insufficient":
        why = diagnosis.warnings[0].rstrip(".") if diagnosis.warnings else "they show too little"
        return f"These recordings cannot support a diagnosis: {why}.", "poor"
    main = diagnosis.main_causes
    causes = "; and ".join(clause(cause.effect, diagnosis.model, cause.parameters) for cause in main)
    if kind == "named":
        return f"{capital(causes)}. {_improvement(diagnosis)}".rstrip(), "good"
    if kind == "set":
        choices = "; and ".join(_choice(cause, diagnosis.model) for cause in main)
        text = f"{capital(choices)}: these recordings cannot distinguish them. {_improvement(diagnosis)}"
        return text.rstrip(), "fair"
    description = diagnosis.remaining.description.rstrip(".")
    ending = f": {description}" if description else ""
    # Causes lead where what they leave unexplained is about as large as the noise.
    if diagnosis.causes and gain is not None and gain.after < 1.5 * gain.noise:
        return f"{capital(causes)}, and something more that no candidate explains{ending}.", "poor"
    part = f" A part of it looks like this: {causes}." if diagnosis.causes else ""
    return f"Something is missing that no candidate explains{ending}.{part}", "poor"


def _harm(diagnosis: Diagnosis) -> str:
    gain = diagnosis.gain
    if gain is None:
        return ""
    change = f"from {millimetres(gain.before)} to {millimetres(gain.after)}"
    causes = "this cause" if len(diagnosis.causes) == 1 else "these causes"
    return f"Use the model without {causes}: with {causes} the held-out error grows {change}."


def _minor_points(diagnosis: Diagnosis) -> list[str]:
    points = []
    for cause in diagnosis.minor_causes:
        gain = cause.holdout_gain
        held = "" if gain is None else f"; held-out error {'less' if gain >= 0 else 'more'} by {millimetres(abs(gain))}"
        points.append(f"Also present, and small: {_choice(cause, diagnosis.model)}{held}.")
    return points


def _choice(cause: Cause, model: Model) -> str:
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
            chosen.setdefault(named(candidate.effect.id).lower(), candidate)
    sizes = {words: sizes_text(item.effect, item.smallest_detectable, from_null=True) for words, item in chosen.items()}
    return [
        f"{'an' if words[0] in 'aeiou' else 'a'} {words} {'' if size.startswith('off') else 'of '}{size}"
        for words, size in sizes.items()
    ]


def _improvement(diagnosis: Diagnosis) -> str:
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
        chance = f"noise alone makes any candidate look as necessary is {_probability(cause.p_value)}"
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
        next_best = f"the next best explanation{f', {others},' if others else ''}"
        text += f"; with {next_best} it is {millimetres(gain.next_best)}"
    return [f"{text}."]


def _residual_points(diagnosis: Diagnosis) -> list[str]:
    remaining = diagnosis.remaining
    if diagnosis.verdict in ("unknown", "insufficient") or remaining.p_value is None:
        return []
    if remaining.description:
        return [f"Residual: {remaining.description.rstrip('.')}."]
    chance = f"p = {_probability(remaining.p_value)}".replace("= <", "<")
    if remaining.p_value < 1e-3:  # seldom by chance; the verdict judges by size what this test shows in long recordings
        return [f"The residual is slightly more than noise ({chance}), and too little to matter."]
    return [f"The residual looks like noise ({chance})."]


def _small_effect_points(diagnosis: Diagnosis) -> list[str]:
    """Return what else would have been detected, and what is significant but too small to matter."""
    more = _detectable(diagnosis)[2 : 2 + MOST_NAMED]
    points = [f"Also, {listed(more)} would have been detected."] if more else []
    # Each p-value is of the whole search, of all candidates: one in a hundred of such searches is wrong.
    certain = [item.effect.id for item in diagnosis.candidates if item.p_value is not None and item.p_value < 0.01]
    names = [named(name).lower() for name in dict.fromkeys(certain)][:MOST_NAMED]
    return points + ([f"Significant by their p-values, but too small to matter: {listed(names)}."] if names else [])


def _next_points(diagnosis: Diagnosis) -> list[str]:
    text = diagnosis.next_experiment
    return [f"Next experiment: {text.rstrip('.')}."] if text else []


def _alternative_points(diagnosis: Diagnosis) -> list[str]:
    points = []
    for cause in diagnosis.causes:
        for item in cause.alternatives:
            own, other = clause(cause.effect, diagnosis.model), clause(item.effect, diagnosis.model)
            worse = f"chi² is {number(item.worse, 2)} larger" if item.worse >= 0 else "chi² is no larger"
            points.append(f"{capital(own)}, or {other}: with the latter, {worse}.")
            apart = item.effect.distinguishing_experiment or cause.effect.distinguishing_experiment
            points += [f"{named(item.effect.id)} would be distinguished from the rest by {apart}."] if apart else []
    return points + (_next_points(diagnosis) if diagnosis.next_experiment not in diagnosis.warnings else [])


def _symptom_points(diagnosis: Diagnosis, most: int) -> list[str]:
    symptoms = diagnosis.symptoms
    return [] if symptoms is None else [symptom.sentence for symptom in symptoms.headlines(most)]


def _recording_table(diagnosis: Diagnosis) -> Table:
    if diagnosis.causes:
        return recording_table(diagnosis.recordings, "with", "without", "next best")
    alone = [RecordingComparison(item.recording, item.noise, item.reference) for item in diagnosis.recordings]
    return recording_table(alone, "residual", "without")


def _cause_table(diagnosis: Diagnosis) -> Table:
    rows = []
    for cause in diagnosis.causes:
        where = place(cause.effect, diagnosis.model) or "everywhere"
        for name, size in cause.parameters.items():
            value = f"{size.value:.6g}" if size.std is None else with_error(size.value, size.std)
            everyday = UNKNOWN if size.std is None else quantity(size.value, size.std, size.unit)
            gained = UNKNOWN if cause.holdout_gain is None else number(1e3 * cause.holdout_gain, 2)
            rows.append((named(cause.effect.id), cause.role, where, name, value, unit(size.unit), everyday, gained))
    uncertain = ("parameter", "value ± standard error", "unit", "in everyday units")
    headers = ("cause", "role", "where", *uncertain, "held-out gain [mm]")
    return Table("Causes", headers, tuple(rows), words=3)


def _candidate_table(diagnosis: Diagnosis, most: int | None = None) -> Table:
    """Return candidates as judged beside the model without effects, causes first; so many testable ones, or all."""
    causes = {cause.effect.key for cause in diagnosis.causes}
    shown = sorted(diagnosis.candidates, key=lambda candidate: candidate.effect.key not in causes)
    if most is not None:
        shown = [candidate for candidate in shown if candidate.testable][:most]
    rows = []
    for candidate in shown:
        effect = candidate.effect
        row = (
            named(effect.id),
            place(effect, diagnosis.model) or "everywhere",
            "found" if effect.key in causes else "" if candidate.testable else "not testable",
            number(candidate.z, 3),
            _probability(candidate.p_value) if candidate.testable else UNKNOWN,
            sizes_text(effect, candidate.sizes),
            sizes_text(effect, candidate.smallest_detectable, from_null=True),
        )
        rows.append(row)
    headers = ("candidate", "where", "", "z", "p, whole search", "size, by itself", "smallest detectable")
    caption = "Candidates, each by itself beside the model without effects (linearised)"
    return Table(caption, headers, tuple(rows), words=3, notes=tuple(candidate.reason for candidate in shown))


def _probability(value: float | None) -> str:
    """Return a p-value; those below 1e-16, the precision of a double, are not told apart."""
    return "< 10⁻¹⁶" if value is not None and value < 1e-16 else number(value, 2)
