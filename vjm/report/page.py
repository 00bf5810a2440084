"""report.html of a diagnosis: what is missing first, then what supports it."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.metadata import version
from typing import TYPE_CHECKING

from jinja2 import Environment, StrictUndefined, Template

from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.report.diagnosis_text import carried_points, diagnosis_verdict, indistinct
from vjm.report.figures.style import Picture
from vjm.report.tables import (
    Table,
    candidate_table,
    cause_table,
    followed_table,
    mode_table,
    parameter_table,
    recording_table,
    remedy_table,
    whiteness_table,
)
from vjm.report.text import Verdict, comparison_verdict, identification_verdict, settings

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis


_TEMPLATE = "report.html.jinja"


@dataclass(frozen=True)
class Section:
    """Part of a page: a heading, sentences, tables, pictures."""

    heading: str
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    terms: tuple[tuple[str, str], ...] = ()
    text: str = ""
    points: tuple[str, ...] = ()


@dataclass(frozen=True)
class Page:
    """All that the template fills in."""

    title: str
    kicker: str
    verdict: Verdict
    warnings: tuple[str, ...]
    sections: tuple[Section, ...]


def identification_page(fit: Identification, pictures: Sequence[Picture]) -> str:
    """The report of an identification, as self-contained HTML."""
    follow = tuple(each for each in pictures if each.name == "fit" or each.name.startswith("tip"))
    left = tuple(each for each in pictures if each.name.startswith("residual"))
    correlated = tuple(each for each in pictures if each.name == "correlations")
    rest = tuple(each for each in pictures if each not in (*follow, *left, *correlated))
    missing = remedy_table(fit.parameters)
    summary = fit.trajectory
    white = () if summary is None or not summary.whiteness else (whiteness_table(summary.whiteness),)
    sections = (
        Section("Parameters", (parameter_table(fit.parameters, fit.nominal.chain), mode_table(fit.modes))),
        Section("How well the model follows the recordings", (recording_table(fit.recordings),), follow),
        Section("What the model leaves unexplained", white, left),
        Section("What the recordings determine", () if missing is None else (missing,), correlated, points=fit.notes),
        Section("What the model was identified from", (), rest),
        Section("Settings", terms=tuple(settings(fit)), text=_METHOD if summary is None else _TRAJECTORY_METHOD),
    )
    name = fit.experiment.rig.name
    return render(Page(name, "identification", identification_verdict(fit), fit.warnings, sections))


def comparison_page(comparison: Comparison, pictures: Sequence[Picture]) -> str:
    """The report of a simulation, as self-contained HTML."""
    table = recording_table(comparison.recordings, "given")
    sections = (
        Section("How well the model follows the recordings", (table,), tuple(pictures)),
        Section("Effects in the model", points=carried_points(comparison.model.effects, comparison.model)),
    )
    name = comparison.experiment.rig.name
    return render(Page(name, "simulation", comparison_verdict(comparison), comparison.warnings, sections))


_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper. "
    "A shape function fitted to the markers gives the joint angles; the parameters are those that make the equation of "
    "motion hold best (Yoshikawa, Ohta and Kanaoka, ICRA 2001). Standard errors hold if the model is right: where the "
    "fit is worse than the noise, the true errors are larger."
)
_TRAJECTORY_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper "
    "(Yoshikawa, Ohta and Kanaoka, ICRA 2001). The parameters are the most likely ones given everything measured: "
    "every training recording is simulated open loop over its whole length, from an initial state estimated with the "
    "parameters. The search starts from what the torque method finds, where there is something for it to find. "
    "Standard errors and 95 % intervals hold if the model is right; what it leaves unexplained widens them, and can "
    "make the values wrong by more."
)


def render(page: Page) -> str:
    """The page as self-contained HTML."""
    return _template().render(page=page, vjm=version("vjm"), embedded=_embedded)


def _embedded(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(resources.files("vjm.report").joinpath(_TEMPLATE).read_text(encoding="utf-8"))


_MOST_SYMPTOMS = 8
_METHOD_DIAGNOSIS_PAGE = (
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
        Section("How it was judged", terms=_terms(diagnosis), text=_METHOD_DIAGNOSIS_PAGE),
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
