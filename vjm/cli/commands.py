"""What each command does."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from vjm.chain.records import Chain
from vjm.cli.arguments import DEFAULT_JOBS, DEFAULT_MAX_EFFECTS, DEFAULT_METHOD, DEFAULT_SEED
from vjm.cli.printing import Summary, print_json
from vjm.cli.progress import Report, progress
from vjm.effects.effect import Effect
from vjm.errors import InputError, ModelFileError
from vjm.experiment import load_experiment
from vjm.files import json_text, write_text_atomic
from vjm.identification import identify
from vjm.identification.records import Identification
from vjm.identification.select import choose_virtual_joints, cuts_of, nominal_chain
from vjm.model import extended_urdf
from vjm.parameters import Estimate
from vjm.report.comparison import Comparison, compare
from vjm.report.diagnosis_tables import candidate_table, cause_table, followed_table
from vjm.report.diagnosis_words import diagnosis_verdict
from vjm.report.effect_words import carried_points
from vjm.report.folder import FolderError, check_folder, check_parent, write_together
from vjm.report.save import REPORT, save
from vjm.report.stored import stored_chain, stored_model
from vjm.report.tables import mode_table, parameter_table, recording_table
from vjm.report.verdict import comparison_verdict, identification_verdict
from vjm.report.wording import counted, number
from vjm.result import check_result, comparison_result, diagnosis_result, identification_result, urdf_result
from vjm.shape.order import visible_modes
from vjm.simulate.arm import Arm

if TYPE_CHECKING:
    from vjm.checking import Check
    from vjm.diagnosis.records import Diagnosis

DIAGNOSIS = "diagnosis"  # folder of the demo's diagnosis, inside that of its identification
_MOST_NAMED = 6
_MOST_SYMPTOMS = 4
_MOST_CANDIDATES = 6


def demo(arguments: argparse.Namespace) -> None:
    """`vjm demo`."""
    with resources.as_file(resources.files("vjm") / "demo") as folder:
        found = _identify(arguments, folder / "experiment.toml", DEFAULT_METHOD, None, "uniform")
        if not arguments.json:
            _print_identification(arguments, found)
        place = arguments.out / DIAGNOSIS
        later = folder / "later.toml"
        diagnosis = _diagnose(arguments, later, place, None, DEFAULT_MAX_EFFECTS, DEFAULT_JOBS, DEFAULT_SEED)
    if arguments.json:
        print_json({**identification_result(found), "diagnosis": diagnosis_result(diagnosis)})
    else:
        _print_diagnosis(arguments, diagnosis, place)


def identification(arguments: argparse.Namespace) -> None:
    """`vjm identify`."""
    chosen = arguments.method, arguments.virtual_joints, arguments.parameters
    fit = _identify(arguments, arguments.experiment, *chosen)
    if arguments.json:
        print_json(identification_result(fit))
    else:
        _print_identification(arguments, fit)


def _identify(
    arguments: argparse.Namespace, file: Path, method: str, virtual_joints: int | None, parameters: str
) -> Identification:
    check_folder(arguments.out)
    with progress(arguments) as report:
        fit = identify(load_experiment(file), method, virtual_joints, parameters, progress=report)
        _save(fit, arguments.out, report)
    return fit


def _print_identification(arguments: argparse.Namespace, fit: Identification) -> None:
    if arguments.quiet:
        return
    summary = Summary(fit.experiment.rig.name)
    summary.verdict(identification_verdict(fit))
    summary.table(parameter_table(fit.parameters, fit.nominal.chain))
    summary.table(mode_table(fit.modes))
    summary.table(recording_table(fit.recordings))
    summary.notes([note for note in fit.notes if note not in fit.warnings])
    summary.warnings(fit.warnings)
    summary.report(arguments.out / REPORT)


def diagnosing(arguments: argparse.Namespace) -> None:
    """`vjm diagnose`."""
    chosen = arguments.effects, arguments.max_effects, arguments.jobs, arguments.seed
    diagnosis = _diagnose(arguments, arguments.experiment, arguments.out, *chosen)
    if arguments.json:
        print_json(diagnosis_result(diagnosis))
    else:
        _print_diagnosis(arguments, diagnosis, arguments.out)


def _diagnose(
    arguments: argparse.Namespace,
    file: Path,
    place: Path,
    effects: Sequence[str] | None,
    max_effects: int,
    jobs: int,
    seed: int,
) -> Diagnosis:
    from vjm.diagnosis import diagnose

    check_folder(place)
    with progress(arguments) as report:
        found = diagnose(load_experiment(file), effects, max_effects, jobs, seed, progress=report)
        _save(found, place, report)
    return found


def _print_diagnosis(arguments: argparse.Namespace, diagnosis: Diagnosis, place: Path) -> None:
    if arguments.quiet:
        return
    summary = Summary(f"Diagnosis: {diagnosis.experiment.rig.name}")
    summary.verdict(diagnosis_verdict(diagnosis))
    symptoms = () if diagnosis.symptoms is None else diagnosis.symptoms.headlines(_MOST_SYMPTOMS)
    if symptoms:
        summary.line("What is wrong, before any cause is named:")
        summary.points([each.sentence for each in symptoms])
    if diagnosis.causes:
        summary.table(cause_table(diagnosis))
    summary.table(candidate_table(diagnosis, _MOST_CANDIDATES))
    summary.table(followed_table(diagnosis))
    summary.points(carried_points(diagnosis.model.effects, diagnosis.model))
    summary.warnings(diagnosis.warnings)
    summary.report(place / REPORT)


def simulation(arguments: argparse.Namespace) -> None:
    """`vjm simulate`."""
    check_folder(arguments.out)
    with progress(arguments) as report:
        experiment = load_experiment(arguments.experiment)
        comparison = compare(experiment, *stored_model(arguments.model, experiment), progress=report)
        _save(comparison, arguments.out, report)
    if arguments.json:
        print_json(comparison_result(comparison))
    elif not arguments.quiet:
        summary = Summary(experiment.rig.name)
        summary.verdict(comparison_verdict(comparison))
        summary.table(recording_table(comparison.recordings, "given"))
        summary.points(carried_points(comparison.model.effects, comparison.model))
        summary.warnings(comparison.warnings)
        summary.report(arguments.out / REPORT)


def _save(result: Identification | Comparison | Diagnosis, directory: Path, report: Report) -> None:
    report("drawing the report", 0, 1)
    save(result, directory)
    report("drawing the report", 1, 1)


def checking(arguments: argparse.Namespace) -> None:
    """`vjm check`."""
    from vjm.checking import check

    if arguments.out is not None:
        check_folder(arguments.out)
    with progress(arguments):
        found = check(load_experiment(arguments.experiment))
    result = check_result(found)
    if arguments.out is not None:
        text = json_text(result)
        write_together(arguments.out, lambda stage: write_text_atomic(stage / "result.json", text))
    if arguments.json:
        print_json(result)
    elif not arguments.quiet:
        _print_check(found)
    if found.problem:
        raise InputError(found.problem)


def _print_check(found: Check) -> None:
    rig = found.experiment.rig
    summary = Summary(rig.name)
    trained, held_out = (len(found.experiment.with_role(role)) for role in ("train", "holdout"))
    counts = [f"{link.name} {joints}" for link, joints in zip(rig.links, found.virtual_joints, strict=False)]
    summary.points(
        [
            f"read: {counted(trained, 'recording')} to train on, {held_out} held out",
            f"virtual joints: {', '.join(counts) or 'none'}",
            f"natural frequencies expected: {', '.join(number(each, 3) for each in found.modes[:5])} Hz",
            *(f"--parameters {kind}: {_share(each)}" for kind, each in found.identifiable.items()),
        ]
    )
    summary.warnings(found.warnings)


def _share(estimates: Sequence[Estimate]) -> str:
    """How many of the parameters the recordings determine, and which they do not."""
    missing = [each for each in estimates if not each.identifiable]
    text = f"{len(estimates) - len(missing)} of {len(estimates)} parameters determined"
    if not missing:
        return text
    few = len(missing) <= 2
    names = [f"{each.name} ({_why(each)})" if few else each.name for each in missing[:_MOST_NAMED]]
    return f"{text}; not {', '.join(names)}{' …' if len(missing) > _MOST_NAMED else ''}"


def _why(estimate: Estimate) -> str:
    return f"{estimate.reason}; it takes {estimate.remedy}" if estimate.remedy else estimate.reason


def urdf(arguments: argparse.Namespace) -> None:
    """`vjm urdf`."""
    if arguments.out is not None:
        if arguments.out.is_dir():
            raise FolderError(arguments.out, "this is a folder", "name a file with -o FILE")
        check_parent(arguments.out)
    source, effects = _chain(arguments.source)
    chain, text = Arm.of(source, effects).chain, extended_urdf(source, effects)
    if arguments.out is not None:
        _write_urdf(arguments.out, text)
    if arguments.json:
        print_json(urdf_result(chain, text, None if arguments.out is None else str(arguments.out)))
    elif arguments.out is None:
        sys.stdout.buffer.write(text.encode("utf-8"))
    elif not arguments.quiet:
        print(f"{arguments.out}: {chain.size} joints, {len(chain.links)} flexible links")


def _write_urdf(file: Path, text: str) -> None:
    try:
        write_text_atomic(file, text)
    except OSError as error:
        raise FolderError(file, f"cannot be written ({error.strerror or error})", "choose another with -o") from error


def _chain(source: Path) -> tuple[Chain, tuple[Effect, ...]]:
    """Chain and effects of a model.json, or the nominal one of an experiment file; the content says which it is."""
    if source.suffix != ".toml" and _is_json(source):
        return stored_chain(source)
    rig = load_experiment(source).rig
    joints = [
        choose_virtual_joints(link, visible_modes(len(link.markers)), link.virtual_joints).joints for link in rig.links
    ]
    return nominal_chain(rig, cuts_of(rig, joints)), ()


def _is_json(source: Path) -> bool:
    try:
        with source.open("rb") as stream:
            return source.suffix == ".json" or stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
    except (OSError, ValueError) as error:
        problem = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise ModelFileError(source, problem, "a model.json or an experiment file (TOML)") from error


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": demo,
    "check": checking,
    "identify": identification,
    "simulate": simulation,
    "diagnose": diagnosing,
    "urdf": urdf,
}
