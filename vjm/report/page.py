"""Results as pages: report.html with everything, and the short page for terminals and notebooks."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.metadata import version

import numpy as np
from jinja2 import Environment, StrictUndefined, Template

from vjm.diagnosis.records import Diagnosis
from vjm.identification.check import Check
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.records import RecordingComparison
from vjm.report.figures.style import Picture
from vjm.report.tables import (
    Table,
    candidate_table,
    cause_table,
    mode_table,
    parameter_table,
    recording_table,
    remedy_table,
    whiteness_table,
)
from vjm.report.text import counted, listed, millimetres, named, number, place
from vjm.report.verdict import Verdict, alternative_points, verdict
from vjm.simulation.model import Model

_TORQUE_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper. "
    "A shape function fitted to the markers gives the joint angles; the parameters are those that make the equation of "
    "motion hold best (Yoshikawa, Ohta and Kanaoka, ICRA 2001). Standard errors hold if the model is right: where the "
    "fit is worse than the noise, the true errors are larger."
)
_TRAJECTORY_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper "
    "(Yoshikawa, Ohta and Kanaoka, ICRA 2001). The parameters are the most likely ones given everything measured: "
    "every training recording is simulated open loop over its whole length, from an initial state estimated with the "
    "parameters. The search starts from the torque method's result, where there is one. Standard errors and 95 % "
    "intervals hold if the model is right; residuals beyond the noise widen them, and may make"
    " the values wrong by more."
)
_DIAGNOSIS_METHOD = (
    "The model without effects is fitted to all training recordings at once. The error of its few virtual joints is "
    "measured with a finer chain and corrected, so that it is not taken for an effect. Each candidate is then judged "
    "by a score test beside it, every other parameter being free; the best ones, alone and in pairs, are fitted "
    "together with all other parameters. The p-value is for the whole search: the probability that noise alone makes "
    "any candidate look as necessary. Held-out recordings take no part in any of this. z is the number of standard "
    "errors by which a candidate's size differs from zero beside the model without effects: where one thing is "
    "missing, everything that looks like it has a large z too."
)


@dataclass(frozen=True)
class _Section:
    """Part of a page: a heading, sentences, tables, pictures, terms with their descriptions, a paragraph."""

    heading: str
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    terms: tuple[tuple[str, str], ...] = ()
    text: str = ""
    points: tuple[str, ...] = ()


@dataclass(frozen=True)
class Page:
    """A result as it is shown, whatever shows it."""

    title: str
    kind: str
    verdict: Verdict
    warnings: tuple[str, ...]
    sections: tuple[_Section, ...]


def summary_page(result: Check | Identification | Comparison | Diagnosis) -> Page:
    """Return the short page of a result, without pictures."""
    if isinstance(result, Identification):
        parameters, modes = parameter_table(result.parameters, result.nominal.chain), mode_table(result.modes)
        fits = recording_table(result.recordings, "identified", "nominal", "torque method")
        notes = tuple(note for note in result.notes if note not in result.warnings)
        return _page(result, _Section("", (parameters, modes, fits)), _Section("Notes", points=notes))
    if isinstance(result, Comparison):
        table = recording_table(result.recordings, "given", "nominal")
        return _page(result, _Section("", (table,)), _Section("", points=_carried_points(result.model)))
    if isinstance(result, Check):
        return _page(result)
    tables = (candidate_table(result, 6), _diagnosed_table(result))
    return _page(
        result,
        _Section("Symptoms of the model without effects", points=_symptoms(result, 4)),
        _Section("", (cause_table(result), *tables) if result.causes else tables),
        _Section("", points=_carried_points(result.model)),
    )


def report_page(result: Identification | Comparison | Diagnosis, pictures: Sequence[Picture]) -> str:
    """Return report.html: self-contained, with pictures.

    Args:
        result: of an identification, of a comparison or of a diagnosis.
        pictures: its figures.
    """
    if isinstance(result, Identification):
        sections = _identification_sections(result, pictures)
    elif isinstance(result, Diagnosis):
        sections = _diagnosis_sections(result, pictures)
    else:
        table = recording_table(result.recordings, "given", "nominal")
        points = _carried_points(result.model)
        sections = [_Section("Fit per recording", (table,), tuple(pictures)), _Section("Effects", points=points)]
    return _template().render(page=_page(result, *sections), vjm=version("vjm"), embedded=_embedded)


def notebook_html(result: Check | Identification | Comparison | Diagnosis) -> str:
    """Return the short page of a result as an HTML fragment for notebooks."""
    template = _template()
    context = template.new_context({"page": summary_page(result), "vjm": version("vjm"), "embedded": _embedded})
    return "".join(template.blocks["page"](context))


def _page(result: Check | Identification | Comparison | Diagnosis, *sections: _Section) -> Page:
    kinds = {Identification: "identification", Comparison: "simulation", Diagnosis: "diagnosis", Check: "check"}
    return Page(result.experiment.rig.name, kinds[type(result)], verdict(result), result.warnings, sections)


def _embedded(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    text = resources.files("vjm.report").joinpath("report.html.jinja").read_text(encoding="utf-8")
    return environment.from_string(text)


def _named(pictures: Sequence[Picture], *beginnings: str) -> tuple[Picture, ...]:
    return tuple(picture for picture in pictures if picture.name.startswith(beginnings))


def _identification_sections(fit: Identification, pictures: Sequence[Picture]) -> list[_Section]:
    missing = remedy_table(fit.parameters)
    white = (whiteness_table(fit.whiteness),) if fit.whiteness else ()
    method = _TRAJECTORY_METHOD if fit.trajectory else _TORQUE_METHOD
    names = ("fit", "tip"), ("residual",), ("correlations",)
    simulated, residuals, correlated = (_named(pictures, *beginnings) for beginnings in names)
    data = tuple(picture for picture in pictures if picture not in (*simulated, *residuals, *correlated))
    fits = recording_table(fit.recordings, "identified", "nominal", "torque method")
    return [
        _Section("Parameters", (parameter_table(fit.parameters, fit.nominal.chain), mode_table(fit.modes))),
        _Section("Fit per recording", (fits,), simulated),
        _Section("Residuals", white, residuals),
        _Section("Identifiability", () if missing is None else (missing,), correlated, points=fit.notes),
        _Section("Data", (), data),
        _Section("Settings", terms=tuple(_settings(fit)), text=method),
    ]


def _diagnosis_sections(diagnosis: Diagnosis, pictures: Sequence[Picture]) -> list[_Section]:
    wrong, evidence = _named(pictures, "symptom"), _named(pictures, "cause")
    gained = tuple(picture for picture in pictures if picture not in (*wrong, *evidence))
    noise = (("Noise", diagnosis.noise),) if diagnosis.noise else ()
    nothing_wrong = ("The model without effects follows every recording to within the noise.",)
    symptoms = _symptoms(diagnosis, 8) or (nothing_wrong if diagnosis.symptoms else ())
    parameters = parameter_table(diagnosis.parameters, diagnosis.base.chain, "without the causes")
    return [
        _Section("Symptoms of the model without effects", pictures=wrong, points=symptoms),
        _Section("Causes", (cause_table(diagnosis),) if diagnosis.causes else (), evidence),
        _Section("Causes that cannot be distinguished", points=tuple(alternative_points(diagnosis))),
        _Section("Gain" if diagnosis.causes else "Fit per recording", (_diagnosed_table(diagnosis),), gained),
        _Section("Candidates", (candidate_table(diagnosis),)),
        _Section("Model", (parameters,), points=_carried_points(diagnosis.model)),
        _Section("Method", terms=(*noise, *(("Note", note) for note in diagnosis.notes)), text=_DIAGNOSIS_METHOD),
    ]


def _symptoms(diagnosis: Diagnosis, most: int) -> tuple[str, ...]:
    symptoms = diagnosis.symptoms
    return () if symptoms is None else tuple(symptom.sentence for symptom in symptoms.headlines(most))


def _settings(fit: Identification) -> list[tuple[str, str]]:
    """Return how the identification was made: term and description."""
    model, rig, trajectory = fit.model, fit.experiment.rig, fit.trajectory
    origin = {True: "estimated from the recordings", False: "from the experiment file"}
    rows = [
        ("Method", f"{fit.method}, parameters {fit.parametrisation}; {fit.status}"),
        ("Virtual joints", listed([f"{link.name}: {link.virtual_joints}" for link in model.chain.links])),
        ("Marker noise", f"{millimetres(model.marker_noise)} ({origin[rig.marker_noise is None]})"),
    ]
    if rig.active_links:
        encoder = f"{number(1e3 * model.encoder_noise, 2)} mrad ({origin[rig.encoder_noise is None]})"
        rows.append(("Encoder noise", encoder))
    if trajectory is not None:
        mean, searched = number(trajectory.chi2_per_sample, 4), counted(trajectory.iterations, "simulation")
        text = f"mean square residual {mean} times the noise's, over {trajectory.point.count} measured values"
        rows.append(("Trajectories", f"{text}; {searched} of all recordings in the last search"))
    if fit.objective is not None:
        before, after = number(fit.objective_nominal, 4), number(fit.objective, 4)
        rows.append(("J, eq. (15)", f"nominal model {before}, identified {after}"))
    for k, link in enumerate(rig.links):
        shapes = [data.angles.shapes[k] for data in fit.torque_data[:1]]
        rows += [(f"Shape functions, {link.name}", f"{shape.family}, order {shape.order}") for shape in shapes]
    for data in fit.torque_data:
        smoothing = data.derivatives.smoothing
        how = "interpolated" if smoothing is None else f"smoothing spline, penalty 10^{smoothing:.1f}"
        text = f"{data.angles.time.size} frames, {data.angles.unsolved} without a solution; {how}"
        noise = data.derivatives.noise(np.sqrt(np.diag(data.angles.covariance))).max(axis=1)
        values = f"{number(1e3 * noise[0], 2)} mrad, {number(noise[1], 2)} rad/s, {number(noise[2], 2)} rad/s²"
        rows.append((f"Used from {data.recording.file}", text))
        rows.append((f"Noise in {data.recording.file}", f"angle, rate and acceleration of the worst joint: {values}"))
    return rows


def _carried_points(model: Model) -> tuple[str, ...]:
    """Return which effects the URDF carries and which only model.json has, a sentence each; none without effects."""
    points = []
    for carried, words in (
        (True, "model.urdf and model.json hold"),
        (False, "Only model.json holds, because URDF cannot express it"),
    ):
        chosen = [
            (named(effect.id).lower(), place(effect, model)) for effect in model.effects if effect.in_urdf is carried
        ]
        names = [f"{name} ({where})" if where else name for name, where in chosen]
        points += [f"{words}: {', '.join(names)}."] if names else []
    return tuple(points)


def _diagnosed_table(diagnosis: Diagnosis) -> Table:
    """Return how closely each recording is followed without and with the causes, and with the next best explanation."""
    if diagnosis.causes:
        return recording_table(diagnosis.recordings, "with", "without", "next best")
    alone = [RecordingComparison(item.recording, item.noise, item.reference) for item in diagnosis.recordings]
    return recording_table(alone, "residual", "without")
