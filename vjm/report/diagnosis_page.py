"""report.html of a diagnosis: what is missing first, then what supports it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from vjm.report.diagnosis_tables import candidate_table, cause_table, followed_table
from vjm.report.diagnosis_words import diagnosis_verdict, indistinct
from vjm.report.effect_words import carried_points
from vjm.report.figures.pictures import Picture
from vjm.report.page import Page, Section, render
from vjm.report.tables import parameter_table

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis

_MOST_SYMPTOMS = 8
_METHOD = (
    "The model without effects is fitted to all training recordings at once. What a finer chain would show beyond it "
    "is measured and added, so that few joints are not taken for an effect. Each candidate is then judged by a score "
    "test beside it, every other parameter being free; the best ones, alone and in pairs, are fitted together with all "
    "other parameters. The p-value is for the whole search: that noise alone makes any candidate look as needed. "
    "Held-out recordings take no part in any of this. z is how many standard errors a candidate's size is off zero "
    "beside the model without any: where one thing is missing, everything that looks like it has a large z too."
)
_NOTHING_WRONG = "The model without effects follows every recording to within what noise explains."


def diagnosis_page(diagnosis: Diagnosis, pictures: Sequence[Picture]) -> str:
    """The report of a diagnosis, as self-contained HTML."""
    wrong = tuple(each for each in pictures if each.name.startswith("symptom"))
    causes = tuple(each for each in pictures if each.name.startswith("cause"))
    gained = tuple(each for each in pictures if each not in (*wrong, *causes))
    rig = diagnosis.experiment.rig
    found = () if not diagnosis.causes else (cause_table(diagnosis),)
    parameters = (parameter_table(diagnosis.parameters, diagnosis.base.chain, "without the causes"),)
    sections = (
        Section("What is wrong, before any cause is named", pictures=wrong, points=_symptoms(diagnosis)),
        Section("The evidence", found, causes),
        Section("What cannot be told apart", points=tuple(indistinct(diagnosis))),
        Section("What is gained" if causes else "How well the model follows", (followed_table(diagnosis),), gained),
        Section("What was looked for", (candidate_table(diagnosis),)),
        Section(
            "The extended model" if diagnosis.causes else "The model",
            parameters,
            points=carried_points(diagnosis.model.effects, diagnosis.model),
        ),
        Section("How it was judged", terms=_terms(diagnosis), text=_METHOD),
    )
    return render(Page(rig.name, "diagnosis", diagnosis_verdict(diagnosis), diagnosis.warnings, sections))


def _symptoms(diagnosis: Diagnosis) -> tuple[str, ...]:
    if diagnosis.symptoms is None:
        return ()
    found = tuple(each.sentence for each in diagnosis.symptoms.headlines(_MOST_SYMPTOMS))
    return found or (_NOTHING_WRONG,)


def _terms(diagnosis: Diagnosis) -> tuple[tuple[str, str], ...]:
    noise = (("Noise", diagnosis.noise),) if diagnosis.noise else ()
    return (*noise, *(("Note", note) for note in diagnosis.notes))
