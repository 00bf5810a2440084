"""The commands: each reads its input, computes, writes its folder, and prints what it found."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.diagnosis import Diagnosis, diagnose
from vjm.effects.effect import Effect
from vjm.errors import InputError, ModelFileError
from vjm.experiment.load import load_experiment
from vjm.files import check_folder, json_text, write_folder, write_text
from vjm.identification import identify
from vjm.identification.check import Check, check
from vjm.identification.comparison import compare
from vjm.identification.records import Comparison
from vjm.identification.training_data import JointChoice
from vjm.records import Progress
from vjm.report.model_json import load_model, read_model
from vjm.report.output import REPORT, result_page, save
from vjm.report.result_json import result_object, urdf_result
from vjm.report.text import counted
from vjm.simulation.arm import Arm

Saved = Comparison | Diagnosis


@contextmanager
def _progress(arguments: argparse.Namespace) -> Iterator[Progress]:
    """Give a function (text, done, total) that moves the bar; one that does nothing where no bar is wanted."""
    if arguments.quiet or arguments.no_progress or not sys.stderr.isatty():
        yield lambda text, done, total: None
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with ProgressBar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)
        yield lambda text, done, total: bar.update(task, description=text, completed=done, total=total)


def _saved(arguments: argparse.Namespace, folder: Path, compute: Callable[[Progress], Saved]) -> Saved:
    check_folder(folder)
    with _progress(arguments) as report:
        result = compute(report)
        report("drawing the report", 0, 1)
        save(result, folder)
    return result


def _print(text: str) -> None:
    """Print text as UTF-8, whatever the terminal; of half a surrogate pair its escape."""
    sys.stdout.buffer.write(text.encode("utf-8", "backslashreplace"))


def _show(arguments: argparse.Namespace, result: Saved | Check, folder: Path | None = None) -> None:
    if arguments.json:
        _print(json_text(result_object(result)))
    elif not arguments.quiet:
        # A terminal without Unicode shows a substitute instead of failing.
        reconfigure = getattr(sys.stdout, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(
                errors="replace" if sys.stdout.encoding.lower() not in ("utf-8", "utf8") else "backslashreplace"
            )
        result_page(result).write(sys.stdout)
        if folder is not None:
            print(f"Report: {folder / REPORT}")


def _run(arguments: argparse.Namespace, compute: Callable[[Progress], Saved]) -> None:
    _show(arguments, _saved(arguments, arguments.out, compute), arguments.out)


def _identify(arguments: argparse.Namespace) -> None:
    chosen = arguments.method, arguments.virtual_joints, arguments.parameters
    _run(arguments, lambda report: identify(load_experiment(arguments.experiment), *chosen, progress=report))


def _diagnose(arguments: argparse.Namespace) -> None:
    chosen = arguments.effects, arguments.max_effects, arguments.jobs, arguments.seed, arguments.budget
    _run(arguments, lambda report: diagnose(load_experiment(arguments.experiment), *chosen, progress=report))


def _simulate(arguments: argparse.Namespace) -> None:
    def compute(report: Progress) -> Comparison:
        experiment = load_experiment(arguments.experiment)
        return compare(experiment, *read_model(arguments.model, experiment), progress=report)

    _run(arguments, compute)


def _demo(arguments: argparse.Namespace) -> None:
    with resources.as_file(resources.files("vjm") / "demo") as data:
        first, later = data / "experiment.toml", data / "later.toml"
        steps: dict[Path, Callable[[Progress], Saved]] = {
            arguments.out: lambda report: identify(load_experiment(first), progress=report),
            arguments.out / "diagnosis": lambda report: diagnose(load_experiment(later), progress=report),
        }
        results = []
        for folder, compute in steps.items():
            results.append(_saved(arguments, folder, compute))
            if not arguments.json:
                _show(arguments, results[-1], folder)
    if arguments.json:
        identified, diagnosed = map(result_object, results)
        _print(json_text({**identified, "diagnosis": diagnosed}))


def _check(arguments: argparse.Namespace) -> None:
    if arguments.out is not None:
        check_folder(arguments.out)
    with _progress(arguments):
        checked = check(load_experiment(arguments.experiment))
    if arguments.out is not None:
        write_folder(arguments.out, {"result.json": json_text(result_object(checked))})
    _show(arguments, checked)
    if checked.problem:
        raise InputError(checked.problem)


def _urdf(arguments: argparse.Namespace) -> None:
    arm = Arm.of(*_chain(arguments.source))
    chain, text, file = arm.chain, arm.urdf(), arguments.out
    if file is not None:
        write_text(file, text)
    if arguments.json:
        _print(json_text(urdf_result(chain, text, None if file is None else str(file))))
    elif file is None:
        _print(text)
    elif not arguments.quiet:
        print(f"{file}: {counted(chain.size, 'joint')}, {counted(len(chain.links), 'flexible link')}")


def _chain(source: Path) -> tuple[Chain, tuple[Effect, ...]]:
    """Return chain and effects of a model.json, or the nominal chain of an experiment file; the content tells which."""
    try:
        with source.open("rb") as stream:
            is_json = source.suffix == ".json" or stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
    except (OSError, ValueError) as error:
        problem = f"cannot be read ({getattr(error, 'strerror', None) or error})"
        raise ModelFileError(source, problem, "a model.json or an experiment file (TOML)") from error
    if is_json:
        model = load_model(source)
        return model.chain, model.effects
    rig = load_experiment(source).rig
    joints = [  # right for as many modes as there are markers to show them (eq. 1)
        JointChoice.of(link, max(len(link.markers), 1), link.virtual_joints).joints for link in rig.links
    ]
    return nominal_chain(rig, rig_layouts(rig, joints)), ()


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": _demo,
    "check": _check,
    "identify": _identify,
    "simulate": _simulate,
    "diagnose": _diagnose,
    "urdf": _urdf,
}
