"""Identifications, comparisons and checks as pages: their sentences, tables and sections."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.identification.check import Check
from vjm.identification.records import Comparison, Identification, ModeComparison, Whiteness
from vjm.records import Estimate, Experiment, RecordingComparison
from vjm.report.figures.panels import Picture
from vjm.report.interactive import arm_animation, time_histories
from vjm.report.page import Grade, Page, Section, Table, named
from vjm.report.result_json import result_object
from vjm.report.text import ROLES, title_and_place
from vjm.simulation.model import Model
from vjm.text import (
    MOST_NAMED,
    UNKNOWN,
    counted,
    interval,
    listed,
    millimetres,
    number,
    short,
    unit,
    with_error,
)

_TORQUE_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper. "
    "A shape function fitted to the markers gives the joint angles; the parameters minimise the torque errors of the "
    "equation of motion (Yoshikawa, Ohta and Kanaoka, ICRA 2001). Standard errors assume that the model is complete: "
    "where the residual exceeds the noise, true errors are larger."
)
_TRAJECTORY_METHOD = (
    "Each flexible link is a chain of rigid virtual links joined by passive joints with a spring and a damper "
    "(Yoshikawa, Ohta and Kanaoka, ICRA 2001). The parameters are the most likely ones given everything measured: "
    "every training recording is simulated open loop over its full length, from an initial state estimated with the "
    "parameters. The search starts from the torque method's result, where there is one. Standard errors and 95 % "
    "intervals assume that the model is complete; residuals beyond the noise widen them, and values may be off by more."
)


def identification_page(result: Comparison | Check, pictures: Sequence[Picture] | None = None) -> Page:
    """Return the page of an identification, a comparison or a check: with pictures the report, else a summary."""
    if isinstance(result, Check):
        return _check_page(result)
    return _fit_page(result, pictures) if isinstance(result, Identification) else _comparison_page(result, pictures)


def _fit_page(fit: Identification, pictures: Sequence[Picture] | None) -> Page:
    headline, grade = _closeness(fit.recordings, "identified")
    if fit.status == "failed":
        headline, grade = f"Identification failed: {fit.remedy}.", "poor"
    elif fit.status != "converged":
        headline, grade = f"Not converged: {fit.remedy or 'do not use this model'}.", "poor"
    points = [
        *_recording_points(fit.recordings),
        *_stiffness_points(fit),
        *_undetermined_points(fit.parameters),
        *_not_simulated_points(fit.recordings),
    ]
    parameters, modes = parameter_table(fit.parameters, fit.nominal.chain), _mode_table(fit.modes)
    comparisons = recording_table(fit.recordings, "identified", "nominal", "torque method")
    animation = None
    if pictures is None:
        notes = [note for note in fit.notes if note not in fit.warnings]
        sections = [Section(tables=[parameters, modes, comparisons]), Section("Notes", notes)]
    else:
        correlations = named(pictures, "correlations")
        data = named(pictures, "shapes", "angles", "torque_errors", "markers")
        followed, animation = _followed(fit, comparisons, pictures, "identified")
        method = _TRAJECTORY_METHOD if fit.trajectory else _TORQUE_METHOD
        sections = [
            Section("Parameters", tables=[parameters, modes]),
            followed,
            Section("Residuals", (), _whiteness_tables(fit.whiteness), named(pictures, "residual"), folded=True),
            Section("Identifiability", fit.notes, _remedy_tables(fit.parameters), correlations, folded=True),
            Section("Data", pictures=data, folded=True),
            input_section(fit.experiment),
            Section("Settings", terms=_settings(fit), text=method, folded=True),
        ]
    title = fit.experiment.rig.name
    return Page(title, "identification", headline, grade, points, fit.warnings, sections, animation)


def _comparison_page(comparison: Comparison, pictures: Sequence[Picture] | None) -> Page:
    recordings = comparison.recordings
    headline, grade = _closeness(recordings, "given")
    points = [*_recording_points(recordings), *_not_simulated_points(recordings)]
    table, carried = recording_table(recordings, "given", "nominal"), carried_points(comparison.model)
    animation = None
    if pictures is None:
        sections = [Section(tables=[table]), Section(points=carried)]
    else:
        followed, animation = _followed(comparison, table, pictures, "given")
        sections = [followed, Section("Effects", carried), input_section(comparison.experiment)]
    title = comparison.experiment.rig.name
    return Page(title, "simulation", headline, grade, points, comparison.warnings, sections, animation)


def _followed(
    result: Comparison, table: Table, pictures: Sequence[Picture], name: str
) -> tuple[Section, dict[str, Any] | None]:
    """Return the section on how closely recordings are followed, and the animation of one of them."""
    rig, labels = result.model.rig, {"reference": "nominal model", "simulated": f"{name} model"}
    plots, still = time_histories(rig, result.recordings, labels), named(pictures, "tip")
    section = Section("Fit per recording", tables=[table], pictures=named(pictures, "fit"), plots=plots, still=still)
    models = {"reference": result.nominal, "simulated": result.model}
    return section, arm_animation(rig, result.recordings, labels, models)


def input_section(experiment: Experiment) -> Section:
    """Return what went into a result: the experiment file, and its recordings."""
    rows = []
    for recording in experiment.recordings:
        duration = number(float(recording.time[-1] - recording.time[0]), 3)
        rows.append((recording.file, recording.kind, ROLES[recording.role], duration, str(recording.frames.size)))
    headers = ("recording", "kind", "role", "duration [s]", "frames")
    file = "none, built in Python" if experiment.file is None else str(experiment.file)
    trained, held_out = (len(experiment.with_role(role)) for role in ("train", "holdout"))
    terms = [("Experiment file", file), ("Recordings", f"{trained} for training, {held_out} held out")]
    return Section("Input", tables=[Table("Recordings", headers, tuple(rows), words=3)], terms=terms, folded=True)


def _check_page(check: Check) -> Page:
    trained, held_out = (len(check.experiment.with_role(role)) for role in ("train", "holdout"))
    links = zip(check.experiment.rig.links, check.virtual_joints, strict=False)
    joints = ", ".join(f"{link.name} {count}" for link, count in links)
    points = (
        f"virtual joints: {joints or 'none'}",
        f"expected natural frequencies: {', '.join(number(frequency) for frequency in check.modes[:5])} Hz",
        *(f"--parameters {kind}: {_share(estimates)}" for kind, estimates in check.identifiable.items()),
    )
    headline = f"{counted(trained, 'training recording')}, {held_out} held out."
    grade: Grade = "poor" if check.problem else "fair" if check.warnings else "good"
    sections = [Section(tables=[_overview_table(check)])] if check.overviews else []
    return Page(check.experiment.rig.name, "check", headline, grade, points, check.warnings, sections)


def _overview_table(check: Check) -> Table:
    """Return the recordings in numbers, narrow enough for a terminal of 80 columns."""
    rows = []
    for overview in check.overviews:
        rates = [overview.frame_rate] + ([] if overview.sensor_rate is None else [overview.sensor_rate])
        row = (
            short(Path(overview.recording.file).stem, 14),
            number(overview.duration, 2),
            "/".join(number(rate, 3) for rate in rates),
            str(overview.frames),
            str(overview.missing),
            number(1e3 * overview.noise, 2),
            number(overview.motion, 2),
            " ".join(number(frequency, 3) for frequency in overview.modes) or UNKNOWN,
        )
        rows.append(row)
    encoder = any(overview.sensor_rate is not None for overview in check.overviews)
    rate = "camera/ encoder [Hz]" if encoder else "camera [Hz]"
    headers = ("recording", "[s]", rate, "frames", "cells missing", "noise [mm]", "motion/ noise", "modes [Hz]")
    return Table("", headers, tuple(rows))


def _ratio(comparison: RecordingComparison) -> float:
    return 0.0 if comparison.simulated is None else comparison.simulated.marker_rms / comparison.noise[0]


def _closeness(comparisons: Sequence[RecordingComparison], name: str) -> tuple[str, Grade]:
    simulated = [comparison for comparison in comparisons if comparison.simulated is not None]
    held_out = [comparison for comparison in simulated if comparison.recording.role == "holdout"]
    if not simulated:
        return "No recording could be simulated.", "poor"
    worst = max(_ratio(comparison) for comparison in held_out or simulated)
    ending = "" if held_out else " No recording was held out: prediction not tested."
    claim = "predicts every held-out recording" if held_out else "follows every training recording"
    if len(held_out) == 1:
        claim = f"predicts the held-out recording {short(held_out[0].recording.file)}"
    if worst <= 1.1:  # a tenth above the noise is half of it in quadrature: not to be seen in a picture
        return f"The {name} model {claim} to within camera noise.{ending}", "good" if held_out else "fair"
    if worst <= 1.5:  # what is missing is about as large as the noise
        return f"The {name} model {claim} to {number(worst, 2)} × camera noise.{ending}", "fair"
    roles = "held-out" if held_out else "training"
    missed = f"residual up to {number(worst, 2)} × camera noise in {roles} recordings"
    remedy = "" if name == "given" else " 'vjm diagnose' looks for the cause."
    return f"The {name} model is incomplete: {missed}.{ending}{remedy}", "poor"


def _recording_points(comparisons: Sequence[RecordingComparison]) -> list[str]:
    points = []
    for role, words, count in (("holdout", "held out", MOST_NAMED), ("train", "training", 1)):
        group = [comparison for comparison in comparisons if comparison.recording.role == role]
        # The worst first; at rest, any model follows.
        group.sort(key=lambda comparison: (comparison.recording.kind != "quiet", _ratio(comparison)), reverse=True)
        shown = [(comparison, comparison.simulated) for comparison in group if comparison.simulated is not None]
        name = words if len(shown) == 1 or role == "holdout" else f"worst {words} recording"
        for comparison, simulated in shown[:count]:
            recording = comparison.recording
            duration = f"{number(float(recording.time[-1] - recording.time[0]), 2)}\N{NO-BREAK SPACE}s"
            models = [("torque method", comparison.alternative), ("nominal", comparison.reference)]
            errors = ", ".join(f"{label} {millimetres(sim.marker_rms)}" for label, sim in models if sim is not None)
            rms = f"{millimetres(simulated.marker_rms)} RMS over {duration}, open loop"
            text = f"{short(recording.file)} ({name}): {rms}{f' ({errors})' if errors else ''}"
            points.append(f"{text}; camera noise {millimetres(comparison.noise[0])}.")
    return points


def _stiffness_points(fit: Identification) -> list[str]:
    points = []
    links = result_object(fit)["model"]["links"]
    for link, identified, nominal in zip(fit.model.chain.links, links, fit.nominal.chain.links, strict=True):
        bending = identified["bending_stiffness"]
        value, std = bending["value"], bending["std"]
        error = None if std is None else math.hypot(std, bending["std_discretisation"] or 0.0)
        change = 100 * (value / nominal.bending_stiffness - 1)
        deviation = f"{abs(change):.1f} % {'above' if change > 0 else 'below'} nominal"
        text = f"{link.name}: bending stiffness {with_error(value, error)} N m², {deviation}"
        points.append(f"{text}; {counted(link.virtual_joints, 'virtual joint')}.")
    return points


def _not_simulated_points(comparisons: Sequence[RecordingComparison]) -> list[str]:
    missing = [
        f"{short(comparison.recording.file)} ({comparison.problem})"
        for comparison in comparisons
        if comparison.simulated is None
    ]
    return [f"Not simulated: {listed(missing[:MOST_NAMED])}."] if missing else []


def _undetermined(estimates: Sequence[Estimate]) -> list[Estimate]:
    return [estimate for estimate in estimates if not estimate.identifiable]


def _undetermined_points(estimates: Sequence[Estimate]) -> list[str]:
    missing = _undetermined(estimates)
    if len(missing) > MOST_NAMED:
        names = listed([estimate.name for estimate in missing[:MOST_NAMED]])
        return [f"{len(missing)} of {len(estimates)} parameters not determined by these recordings: {names} …"]
    return [f"Not determined by these recordings: {_explained(estimate)}." for estimate in missing]


def _share(estimates: Sequence[Estimate]) -> str:
    missing = _undetermined(estimates)
    text = f"{len(estimates) - len(missing)} of {len(estimates)} parameters determined"
    if not missing:
        return text
    brief, limit = len(missing) <= 2, 2 * MOST_NAMED
    names = [_explained(estimate) if brief else estimate.name for estimate in missing[:limit]]
    return f"{text}; not {', '.join(names)}{' …' if len(missing) > limit else ''}"


def _explained(estimate: Estimate) -> str:
    return f"{estimate.name} ({estimate.reason}{f'; needs {estimate.remedy}' if estimate.remedy else ''})"


def carried_points(model: Model) -> list[str]:
    """Return which effects the URDF carries and which only model.json has, a sentence each; none without effects."""
    points = []
    for carried, words in (
        (True, "In model.urdf and model.json"),
        (False, "In model.json only (URDF cannot express it)"),
    ):
        effects = [effect for effect in model.effects if effect.in_urdf is carried]
        names = [title_and_place(effect, model) for effect in effects]
        points += [f"{words}: {', '.join(names)}."] if names else []
    return points


def parameter_table(estimates: Sequence[Estimate], nominal: Chain, beside: str = "nominal") -> Table:
    """Return every parameter beside its value in another chain, with standard error and 95 % interval.

    It is the paper's Table 1; `beside` names the other chain.
    """
    rows, compared = [], _values_by_name(nominal)
    for estimate in estimates:
        value, std = estimate.value, estimate.error
        state = "no" if not estimate.identifiable else "yes" if std is not None else "fixed"
        relative = None if std is None or value == 0 else abs(100 * std / value)
        uncertain = interval(value, std), number(relative, 2)
        before = number(compared.get(estimate.name), 4)
        rows.append((estimate.name, with_error(value, std), unit(estimate.unit), before, *uncertain, state))
    headers = ("parameter", "identified ± standard error", "unit", beside)
    optional = ("95 % interval", "error [%]", "determined")
    return Table("Table 1. Parameters", (*headers, *optional), tuple(rows), optional=optional)


def _values_by_name(chain: Chain) -> dict[str, float]:
    """Return a chain's values by the names of parameters; virtual joints count from 1, virtual links from 0."""
    arrays = {"length": "lengths", "mass": "masses", "mass_center": "mass_centers", "inertia": "inertias"}
    values: dict[str, float] = {}
    for link in chain.links:
        for name in ("bending_stiffness", "kelvin_voigt_time", "hub_inertia"):
            values[f"{link.name}.{name}"] = float(getattr(link, name))
        for name in ("stiffness", "damping", *arrays):
            numbers = enumerate(getattr(link, arrays.get(name, name)), 0 if name in arrays else 1)
            values |= {f"{link.name}.{name}_{k}": float(value) for k, value in numbers}
    return values


def _remedy_tables(estimates: Sequence[Estimate]) -> list[Table]:
    rows = tuple((estimate.name, estimate.reason, estimate.remedy or UNKNOWN) for estimate in _undetermined(estimates))
    headers = ("parameter", "reason", "recording that would determine it")
    return [Table("Parameters not determined by these recordings", headers, rows, words=3)] if rows else []


def _whiteness_tables(whiteness: Sequence[Whiteness]) -> list[Table]:
    rows = []
    for test in whiteness:
        rms = math.sqrt(test.mean_square) if test.mean_square >= 0 else None
        rows.append((test.file, "yes" if test.white else "no", number(rms, 3), number(test.correlation, 2)))
    headers = ("recording", "white", "residual / noise, all sensors", "largest correlation (lags up to 10)")
    caption = "Residuals of the training recordings"
    return [Table(caption, headers, tuple(rows), words=2)] if rows else []


def _mode_table(modes: Sequence[ModeComparison]) -> Table:
    """Return frequencies and damping ratios of the model beside the measured ones (the paper's Table 2)."""
    rows = []
    for k, mode in enumerate(modes):
        measured, damping = mode.frequency_measured, mode.damping_measured
        difference = None if measured is None else 100 * (mode.frequency_model / measured - 1)
        row = (
            f"mode {k + 1}",
            number(mode.frequency_model, 5),
            "no peak" if measured is None else with_error(measured, mode.frequency_std),
            UNKNOWN if difference is None else f"{difference:+.2f}".replace("-", "\N{MINUS SIGN}"),
            number(100 * mode.damping_model, 3),
            "no peak" if damping is None else number(100 * damping, 3),
            UNKNOWN if mode.mac is None else f"{mode.mac:.4f}",
        )
        rows.append(row)
    frequency = ("model [Hz]", "measured [Hz]", "difference [%]")
    headers = ("", *frequency, "damping, model [%]", "damping, measured [%]", "shape, MAC")
    return Table("Table 2. Natural frequencies and damping", headers, tuple(rows)).without_empty("shape, MAC")


def recording_table(
    comparisons: Sequence[RecordingComparison], model: str, reference: str, alternative: str = "alternative"
) -> Table:
    """Return how closely each recording is followed, open loop over its whole length.

    The names are those of the columns of its comparison's `simulated`, `reference` and `alternative`.
    """
    rows, notes = [], []
    for comparison in comparisons:
        recording, simulated, noise = comparison.recording, comparison.simulated, comparison.noise[0]
        theta = None if simulated is None or simulated.theta_rms is None else 1e3 * simulated.theta_rms
        row = (
            recording.file,
            ROLES[recording.role],
            recording.kind,
            *(
                millimetres(sim.marker_rms if sim else None)
                for sim in (comparison.reference, comparison.alternative, simulated)
            ),
            millimetres(noise),
            number(simulated.marker_rms / noise if simulated else None, 2),
            number(theta, 2),
        )
        rows.append(row)
        remarks = [f"not simulated: {comparison.problem}"] if simulated is None else []
        if simulated is not None and simulated.status != "converged":
            remarks.append("initial state not converged: residual may be too large")
        if simulated is not None and comparison.left_out:
            remarks.append(f"{counted(comparison.left_out, 'marker coordinate')} left out")
        notes.append("; ".join(remarks))
    numbers = (reference, alternative, model, "noise", f"{model}\N{NO-BREAK SPACE}/ noise", "encoder [mrad]")
    caption = "Fit per recording: RMS marker residual, open loop"
    headers, optional = ("recording", "role", "kind", *numbers), ("kind", "encoder [mrad]", "noise")
    table = Table(caption, headers, tuple(rows), words=3, notes=tuple(notes), optional=optional)
    return table.without_empty(reference, alternative, "encoder [mrad]")


def _settings(fit: Identification) -> list[tuple[str, str]]:
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
        mean, searched = number(trajectory.misfit**2, 4), counted(trajectory.iterations, "simulation")
        text = f"mean square residual {mean} × that of noise, over {trajectory.point.count} measured values"
        rows.append(("Trajectories", f"{text}; {searched} of every recording in the last search"))
    if fit.objective is not None:
        before, after = number(fit.objective_nominal, 4), number(fit.objective, 4)
        rows.append(("J, eq. (15)", f"nominal model {before}, identified {after}"))
    for k, link in enumerate(rig.links):
        shapes = [data.angles.shapes[k] for data in fit.torque_data[:1]]
        rows += [(f"Shape functions, {link.name}", f"{shape.family}, order {shape.order}") for shape in shapes]
    for data in fit.torque_data:
        smoothing = data.derivatives.smoothing
        filtering = "interpolated" if smoothing is None else f"smoothing spline, penalty {number(10**smoothing, 2)}"
        text = f"{data.angles.time.size} frames, {data.angles.unsolved} unsolved; {filtering}"
        noise = data.derivatives.noise(np.sqrt(np.diag(data.angles.covariance))).max(axis=1)
        values = f"{number(1e3 * noise[0], 2)} mrad, {number(noise[1], 2)} rad/s, {number(noise[2], 2)} rad/s²"
        rows.append((f"Used from {data.recording.file}", text))
        rows.append((f"Noise in {data.recording.file}", f"worst joint's angle, rate and acceleration: {values}"))
    return rows
