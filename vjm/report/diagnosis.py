"""Diagnoses as pages: their sentences, tables and sections."""

from __future__ import annotations

from collections.abc import Sequence

from vjm.diagnosis.records import Candidate, Cause, Diagnosis
from vjm.records import RecordingComparison
from vjm.report.figures.panels import Picture
from vjm.report.identification import carried_points, input_section, parameter_table, recording_table
from vjm.report.interactive import arm_animation, time_histories
from vjm.report.page import Grade, Page, Section, Table, named
from vjm.report.text import clause, place, sizes_text, title_and_place
from vjm.simulation.model import Model
from vjm.text import (
    MOST_NAMED,
    UNKNOWN,
    capital,
    counted,
    in_sentence,
    listed,
    millimetres,
    number,
    quantity,
    ratio,
    unit,
    with_error,
)

_METHOD = (
    "The model without effects is fitted to all training recordings at once. The discretization error of its virtual "
    "joints is measured with a finer chain and corrected, so that it is not taken for an effect. A score test then "
    "judges each candidate added alone to that model, with every other parameter free; the best ones, alone and in "
    "pairs, are fitted together with all other parameters. The false-alarm probability is the probability that noise "
    "alone makes any candidate of the search this significant. Held-out recordings take no part in any of this. z is a"
    " candidate's estimate over its standard error, linearised about the model without effects. Every effect that "
    "resembles the true cause has a large z; the fits decide: the residual of a candidate fitted alone, with all other"
    " parameters, is in the table where that was done. The estimate if it were the only cause is linearised, and "
    "contains the contribution of all other causes; the size of a cause comes from the nonlinear fit with all causes."
)


def diagnosis_page(diagnosis: Diagnosis, pictures: Sequence[Picture] | None = None) -> Page:
    """Return the page of a diagnosis: the report with its pictures, or without any a summary."""
    (headline, grade), gain = _headline(diagnosis), diagnosis.gain
    if diagnosis.causes and gain is not None and gain.harmful:
        causes = "this cause" if len(diagnosis.causes) == 1 else "these causes"
        before, after = millimetres(gain.before), millimetres(gain.after)
        change = (
            f"from {before} to {after}" if after != before else f"by {number(-100 * gain.reduction, 2)} % of {before}"
        )
        harm = f"Use the model without {causes}: with {causes} the held-out error rises {change}."
        headline, grade = f"{harm} {headline}", "poor"
    if diagnosis.budget.exhausted and diagnosis.budget.not_tried:
        titles = {candidate.effect.id: in_sentence(candidate.effect.title) for candidate in diagnosis.candidates}
        untried = listed([titles.get(name, name) for name in diagnosis.budget.not_tried[:MOST_NAMED]])
        count = len(diagnosis.budget.not_tried) - MOST_NAMED
        remainder = f" and {counted(count, 'other')}" if count > 0 else ""
        headline, grade = f"{headline} Out of time before trying {untried}{remainder}.", "poor"
    points = _minor_points(diagnosis) + _cause_points(diagnosis) + _gain_points(diagnosis) + _residual_points(diagnosis)
    if diagnosis.verdict == "none":
        points += _small_effect_points(diagnosis)
    if diagnosis.verdict != "insufficient":
        points += _next_points(diagnosis)
    cause_tables = [_cause_table(diagnosis)] if diagnosis.causes else []
    recordings, carried = _recording_table(diagnosis), carried_points(diagnosis.model)
    symptom_heading = "Symptoms without causes" if diagnosis.causes else "Symptoms"
    animation = None
    if pictures is None:
        sections = [
            Section(symptom_heading, _symptom_points(diagnosis, 4)),
            Section(tables=[*cause_tables, _candidate_table(diagnosis, 6), recordings]),
            Section(points=carried),
        ]
    else:
        symptom_figures, still, gained = (named(pictures, name) for name in ("symptom", "held_out", "gain"))
        labels = {"reference": "without causes", "simulated": "with causes"}
        labels = labels if diagnosis.causes else {"reference": "model"}
        rig, models = diagnosis.model.rig, {"reference": diagnosis.reference, "simulated": diagnosis.model}
        animation = arm_animation(rig, diagnosis.recordings, labels, models)
        plots = time_histories(rig, diagnosis.recordings, labels)
        nothing_wrong = ["None: the model without effects follows every recording to within the noise."]
        symptoms = _symptom_points(diagnosis, 8) or (nothing_wrong if diagnosis.symptoms else [])
        parameters = parameter_table(diagnosis.parameters, diagnosis.reference.chain, "without causes")
        noise = [("Noise", diagnosis.noise)] if diagnosis.noise else []
        notes = [("Note", note) for note in diagnosis.notes]
        gain_heading = "Gain" if diagnosis.causes else "Fit per recording"
        sections = [
            Section(symptom_heading, symptoms, pictures=symptom_figures[:1]),
            Section("Symptoms in detail", pictures=symptom_figures[1:], folded=True),
            Section("Causes", tables=cause_tables, pictures=named(pictures, "cause")),
            Section("Indistinguishable causes", _alternative_points(diagnosis)),
            Section(gain_heading, tables=[recordings], pictures=gained, plots=plots, still=still),
            Section("Candidates", _untestable_points(diagnosis), [_candidate_table(diagnosis)], folded=True),
            Section("Model", carried, [parameters], folded=True),
            input_section(diagnosis.experiment),
            Section("Method", terms=noise + notes, text=_METHOD, folded=True),
        ]
    title = diagnosis.experiment.rig.name
    return Page(title, "diagnosis", headline, grade, points, diagnosis.warnings, sections, animation)


def _headline(diagnosis: Diagnosis) -> tuple[str, Grade]:
    kind, gain = diagnosis.verdict, diagnosis.gain
    if kind == "none":
        testable = sum(candidate.testable for candidate in diagnosis.candidates)
        small = _detectable(diagnosis)[:2]
        limits = f" Detection limits: {', '.join(small)}." if small else ""
        return f"No cause found: none of the {counted(testable, 'candidate')} improves the model.{limits}", "good"
    if kind == "insufficient":
        reason = diagnosis.warnings[0].rstrip(".") if diagnosis.warnings else "the recordings show too little"
        return f"Not enough data for a diagnosis: {reason}.", "poor"
    main = diagnosis.main_causes
    causes = "; ".join(clause(cause.effect, diagnosis.model, cause.parameters) for cause in main)
    opening = "Cause found" if len(main) == 1 else f"{len(main)} causes found"
    if kind == "named":
        return f"{opening}: {causes}. {_improvement(diagnosis)}".rstrip(), "good"
    if kind == "set":
        choices = "; ".join(_choice(cause, diagnosis.model) for cause in main)
        text = f"{opening}: {choices}. These recordings cannot distinguish the alternatives. {_improvement(diagnosis)}"
        return text.rstrip(), "fair"
    tried = "any candidate tried in time" if diagnosis.budget.not_tried else "any candidate"
    description = diagnosis.remaining.description.rstrip(".")
    ending = f": {description}" if description else ""
    # Causes lead where what they leave unexplained is about as large as the noise.
    if diagnosis.causes and gain is not None and gain.after < 1.5 * gain.noise:
        return f"{opening}: {causes}. A further residual is not explained by {tried}{ending}.", "poor"
    part = f" Explained in part by: {causes}." if diagnosis.causes else ""
    return f"Residual not explained by {tried}{ending}.{part}", "poor"


def _minor_points(diagnosis: Diagnosis) -> list[str]:
    points = []
    for cause in diagnosis.minor_causes:
        gain = cause.holdout_gain
        change = (
            "" if gain is None else f"; held-out error {millimetres(abs(gain))} {'smaller' if gain >= 0 else 'larger'}"
        )
        points.append(f"Minor cause: {_choice(cause, diagnosis.model)}{change}.")
    return points


def _choice(cause: Cause, model: Model) -> str:
    main_clause = clause(cause.effect, model, cause.parameters)
    alternatives = [clause(alternative.effect, model) for alternative in cause.alternatives[:2]]
    count = len(cause.alternatives) - len(alternatives)
    alternatives += [f"{counted(count, 'other')} (see below)"] if count else []
    return f"{main_clause}, or {', or '.join(alternatives)}" if alternatives else main_clause


def _detectable(diagnosis: Diagnosis) -> list[str]:
    """Return detection limits, of frequent causes first: `tip payload 0.4 g`."""
    chosen: dict[str, Candidate] = {}
    for candidate in sorted(diagnosis.candidates, key=lambda candidate: not candidate.effect.common):
        if candidate.testable and len(candidate.smallest_detectable) == 1:
            chosen.setdefault(in_sentence(candidate.effect.title), candidate)
    return [
        f"{title} {sizes_text(item.effect, item.smallest_detectable, from_null=True)}" for title, item in chosen.items()
    ]


def _improvement(diagnosis: Diagnosis) -> str:
    gain = diagnosis.gain
    if gain is None:
        return ""
    before, after, noise = (millimetres(error) for error in (gain.before, gain.after, gain.noise))
    if before == after:
        return f"The gain is too small to show in the held-out error of {after} (noise {noise})."
    return (
        f"Held-out error {'falls' if gain.after < gain.before else 'rises'} from {before} to {after} (noise {noise})."
    )


def _cause_points(diagnosis: Diagnosis) -> list[str]:
    points = []
    for cause in diagnosis.causes:
        evidence = f": {cause.evidence.rstrip('.')}" if cause.evidence else ""
        chance = f"false-alarm probability (whole search) {_probability(cause.p_value)}"
        points.append(f"{cause.effect.title}{evidence}; {chance}.")
    return points


def _gain_points(diagnosis: Diagnosis) -> list[str]:
    gain = diagnosis.gain
    if gain is None:
        return ["No recording was held out: the gain is not tested."] if diagnosis.causes else []
    if not diagnosis.causes:
        return [f"Held-out error {millimetres(gain.before)}, noise {millimetres(gain.noise)}."]
    low, high = (number(100 * bound, 2) for bound in gain.interval)
    change = f"{number(abs(100 * gain.reduction), 2)} % {'less' if gain.reduction >= 0 else 'more'}"
    text = f"Held-out error: {change} (95 % interval of the reduction {low} … {high} %)"
    if gain.next_best is not None:
        explanations = listed([in_sentence(effect.title) for effect in diagnosis.next_best])
        text += f"; next best explanation{f' ({explanations})' if explanations else ''}: {millimetres(gain.next_best)}"
    return [f"{text}."]


def _residual_points(diagnosis: Diagnosis) -> list[str]:
    remaining = diagnosis.remaining
    if diagnosis.verdict in ("unknown", "insufficient") or remaining.p_value is None:
        return []
    if remaining.description:
        return [f"Residual: {remaining.description.rstrip('.')}."]
    chance = f"p = {_probability(remaining.p_value)}".replace("= <", "<")
    if remaining.p_value < 1e-3:  # seldom by chance; the verdict judges by size what this test shows in long recordings
        return [f"Residual slightly exceeds noise ({chance}), too little to matter."]
    return [f"Residual is consistent with noise ({chance})."]


def _small_effect_points(diagnosis: Diagnosis) -> list[str]:
    """Return what else would have been detected, and what is significant but too small to matter."""
    limits = _detectable(diagnosis)[2 : 2 + MOST_NAMED]
    points = [f"Further detection limits: {', '.join(limits)}."] if limits else []
    # Each p-value is of the whole search, of all candidates: one in a hundred of such searches is wrong.
    certain = [item.effect.title for item in diagnosis.candidates if item.p_value is not None and item.p_value < 0.01]
    names = [in_sentence(title) for title in dict.fromkeys(certain)][:MOST_NAMED]
    return points + ([f"Significant, but too small to matter: {listed(names)}."] if names else [])


def _next_points(diagnosis: Diagnosis) -> list[str]:
    text = diagnosis.next_experiment
    return [f"Next experiment: {text.rstrip('.')}."] if text else []


def _alternative_points(diagnosis: Diagnosis) -> list[str]:
    points = []
    for cause in diagnosis.causes:
        cause_clause = capital(clause(cause.effect, diagnosis.model))
        for alternative in cause.alternatives:
            increase = alternative.chi2_increase
            comparison = f"chi² larger by {number(increase, 2)}" if increase >= 0 else "chi² no larger"
            points.append(f"{cause_clause}, or {clause(alternative.effect, diagnosis.model)} ({comparison}).")
            experiment = alternative.effect.distinguishing_experiment or cause.effect.distinguishing_experiment
            points += [f"{alternative.effect.title} would be distinguished by {experiment}."] if experiment else []
    return points + (_next_points(diagnosis) if diagnosis.next_experiment not in diagnosis.warnings else [])


def _symptom_points(diagnosis: Diagnosis, count: int) -> list[str]:
    symptoms = diagnosis.symptoms
    return [] if symptoms is None else [symptom.sentence for symptom in symptoms.headlines(count)]


def _recording_table(diagnosis: Diagnosis) -> Table:
    if diagnosis.causes:
        return recording_table(diagnosis.recordings, "with", "without", "next best")
    comparisons = [RecordingComparison(item.recording, item.noise, item.reference) for item in diagnosis.recordings]
    return recording_table(comparisons, "residual", "without")


def _cause_table(diagnosis: Diagnosis) -> Table:
    rows = []
    for cause in diagnosis.causes:
        location = place(cause.effect, diagnosis.model) or "whole system"
        for name, size in cause.parameters.items():
            value, everyday = with_error(size.value, size.std), quantity(size.value, size.std, size.unit, 4)
            gained = UNKNOWN if cause.holdout_gain is None else number(1e3 * cause.holdout_gain, 2)
            rows.append((cause.effect.title, name, everyday, gained, location, cause.role, value, unit(size.unit)))
    headers = ("cause", "parameter", "estimate ± standard error", "held-out gain [mm]", "where", "role")
    optional = ("in SI units", "unit", "role", "where")
    return Table("Causes", (*headers, "in SI units", "unit"), tuple(rows), words=2, optional=optional)


_BOUNDS = {None: "", "lower": "≥ ", "upper": "≤ "}


def _candidate_table(diagnosis: Diagnosis, count: int | None = None) -> Table:
    """Return testable candidates as judged beside the model without effects, causes first; so many, or all."""
    causes = {cause.effect.key: cause for cause in diagnosis.causes}
    testable = [candidate for candidate in diagnosis.candidates if candidate.testable]
    shown = sorted(testable, key=lambda candidate: candidate.effect.key not in causes)[:count]
    held_out, rows, notes = diagnosis.held_out_alone, [], []
    for candidate in shown:
        effect, error = candidate.effect, held_out.get(candidate.effect.key)
        estimate = sizes_text(effect, candidate.sizes) if candidate.z != 0 else "wrong sign"
        row = (
            effect.title,
            place(effect, diagnosis.model) or "whole system",
            "found" if effect.key in causes else "",
            number(candidate.z, 3),
            _probability(candidate.p_value),
            UNKNOWN if candidate.misfit is None else _BOUNDS[candidate.bound] + ratio(candidate.misfit),
            UNKNOWN if error is None else number(1e3 * error, 2),
            estimate,
            sizes_text(effect, candidate.smallest_detectable, from_null=True),
        )
        rows.append(row)
        notes.append(candidate.reason or _why_it_differs(causes.get(effect.key), estimate))
    estimate, alarm = "estimate if it were the only cause", "false-alarm probability (whole search)"
    fitted = ("residual fitted alone [×\N{NO-BREAK SPACE}noise]", "held-out [mm]")
    headers = ("candidate", "where", "", "z", alarm, *fitted, estimate, "detection limit")
    caption = "Candidate causes, each added alone (linearised)"
    table = Table(caption, headers, tuple(rows), 3, tuple(notes), (alarm, "where", "detection limit"))
    return table.without_empty(*fitted)


def _why_it_differs(cause: Cause | None, estimate: str) -> str:
    """Explain why a cause has another size than the candidate alone; empty where it has not."""
    if cause is None:
        return ""
    fitted = sizes_text(cause.effect, {name: size.value for name, size in cause.parameters.items()})
    if fitted == estimate:
        return ""
    reason = "which is nonlinear and has all causes; this row's estimate is linearised, for this cause alone"
    return f"{fitted} in the fit, {reason}"


def _untestable_points(diagnosis: Diagnosis) -> list[str]:
    """Return one line that lists the candidates that the recordings cannot show, by reason; none without any."""
    by_reason: dict[str, list[str]] = {}
    for candidate in diagnosis.candidates:
        if not candidate.testable:
            by_reason.setdefault(candidate.reason, []).append(title_and_place(candidate.effect, diagnosis.model))
    texts = [f"{listed(names)} ({reason})" for reason, names in by_reason.items()]
    return [f"Not testable: {'; '.join(texts)}."] if texts else []


def _probability(value: float | None) -> str:
    """Return a p-value; those below 1e-16, the precision of a double, are not told apart."""
    return "< 10⁻¹⁶" if value is not None and value < 1e-16 else number(value, 2)
