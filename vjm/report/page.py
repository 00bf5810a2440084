"""report.html: what was found, in the order in which a reader asks."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.metadata import version

from jinja2 import Environment, StrictUndefined, Template

from vjm.identification.records import Identification
from vjm.report.comparison import Comparison
from vjm.report.figures.pictures import Picture
from vjm.report.tables import Table, mode_table, parameter_table, recording_table
from vjm.report.verdict import Verdict, comparison_verdict, identification_verdict, settings

_TEMPLATE = "report.html.jinja"


@dataclass(frozen=True)
class Section:
    """Part of a page: a heading, tables, pictures."""

    heading: str
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    terms: tuple[tuple[str, str], ...] = ()
    text: str = ""


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
    rest = tuple(each for each in pictures if each not in follow)
    sections = (
        Section("Parameters", (parameter_table(fit.parameters, fit.nominal.chain), mode_table(fit.modes))),
        Section("How well the model follows the recordings", (recording_table(fit.recordings),), follow),
        Section("What the model was identified from", (), rest),
        Section("Settings", terms=tuple(settings(fit)), text=_METHOD),
    )
    name = fit.experiment.rig.name
    return _render(Page(name, "identification", identification_verdict(fit), fit.warnings, sections))


def comparison_page(comparison: Comparison, pictures: Sequence[Picture]) -> str:
    """The report of a simulation, as self-contained HTML."""
    table = recording_table(comparison.recordings, "given")
    section = Section("How well the model follows the recordings", (table,), tuple(pictures))
    name = comparison.experiment.rig.name
    return _render(Page(name, "simulation", comparison_verdict(comparison), comparison.warnings, (section,)))


_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper. "
    "A shape function fitted to the markers gives the joint angles; the parameters are those that make the equation of "
    "motion hold best (Yoshikawa, Ohta and Kanaoka, ICRA 2001). Standard errors hold if the model is right: where the "
    "fit is worse than the noise, the true errors are larger."
)


def _render(page: Page) -> str:
    return _template().render(page=page, vjm=version("vjm"), embedded=_embedded)


def _embedded(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    return environment.from_string(resources.files("vjm.report").joinpath(_TEMPLATE).read_text(encoding="utf-8"))
