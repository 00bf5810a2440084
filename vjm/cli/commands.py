"""What each command does."""

from __future__ import annotations

import argparse
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table as RichTable
from rich.text import Text

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.cli.arguments import DEFAULT_JOBS, DEFAULT_MAX_EFFECTS, DEFAULT_METHOD, DEFAULT_SEED
from vjm.effects.effect import Effect
from vjm.errors import InputError, ModelFileError
from vjm.experiment import load_experiment
from vjm.files import FolderError, check_folder, check_parent, encoded, json_text, write_folder, write_text
from vjm.identification import identify
from vjm.identification.comparison import Comparison, compare
from vjm.identification.records import Identification
from vjm.identification.virtual_joints import choose_virtual_joints
from vjm.markers.shape import visible_modes
from vjm.records import Estimate
from vjm.report.diagnosis_text import carried_points, diagnosis_verdict
from vjm.report.model_json import load_model, read_model
from vjm.report.result_json import result_object, urdf_result
from vjm.report.save import REPORT, save
from vjm.report.tables import (
    Table,
    candidate_table,
    cause_table,
    followed_table,
    mode_table,
    parameter_table,
    recording_table,
)
from vjm.report.text import Verdict, comparison_verdict, counted, identification_verdict, number
from vjm.simulation.arm import Arm
from vjm.simulation.model import extended_urdf

if TYPE_CHECKING:
    from vjm.diagnosis.records import Diagnosis
    from vjm.identification.check import Check


_MOST_ROWS = 16
_MOST_WARNINGS = 8
_LONGEST_NAME = 30
_COLORS = {"good": "green", "fair": "yellow", "poor": "red"}
_PLAIN_WIDTH = 110  # columns where the output is no terminal


def print_json(result: dict[str, Any]) -> None:
    """The result object, and nothing else."""
    _forgiving_stdout()
    sys.stdout.write(json_text(result))


class Summary:
    """Prints the parts of a summary on stdout."""

    def __init__(self, title: str) -> None:
        _forgiving_stdout()
        width = None if sys.stdout.isatty() else _PLAIN_WIDTH
        self.console = Console(file=sys.stdout, markup=False, highlight=False, emoji=False, width=width)
        self.console.print(Text(title, style="bold"))

    def verdict(self, verdict: Verdict) -> None:
        """The finding and its points."""
        self.console.print(Text(verdict.headline, style=_COLORS[verdict.grade]))
        self.points(verdict.points)

    def points(self, points: Sequence[str]) -> None:
        """A list of sentences."""
        for point in points:
            self._item("-", point)

    def line(self, text: str) -> None:
        """One line."""
        self.console.print(Text(text))

    def table(self, table: Table) -> None:
        """A table; of a long one the first rows."""
        rich = RichTable(box=box.SIMPLE_HEAD, title=table.caption, title_justify="left", title_style="bold")
        rich.collapse_padding = True
        rich.pad_edge = False
        for k, header in enumerate(table.headers):
            words = k < table.words
            rich.add_column(
                Text(header), justify="left" if words else "right", overflow="fold", no_wrap=_whole(k, table)
            )
        for row in table.rows[:_MOST_ROWS]:
            rich.add_row(*map(Text, row))
        self.console.print(rich)
        left = len(table.rows) - _MOST_ROWS
        if left > 0:
            self.line(f"  … and {left} more in the report")

    def notes(self, notes: Sequence[str]) -> None:
        """What was decided on the way, and what the result rests on."""
        if notes:
            self.console.print(Text("Notes:", style="bold"))
            self.points(notes)

    def warnings(self, warnings: Sequence[str]) -> None:
        """What a user should know before trusting the result."""
        if not warnings:
            return
        self.console.print(Text("Warnings:", style="bold yellow"))
        for warning in warnings[:_MOST_WARNINGS]:
            self._item("!", warning)
        if len(warnings) > _MOST_WARNINGS:
            self._item("!", f"… and {len(warnings) - _MOST_WARNINGS} more, see the report")

    def report(self, path: Path) -> None:
        """Where everything is; on one line, so that it can be copied."""
        self.console.print(Text(f"Report: {path}"), soft_wrap=True)

    def _item(self, mark: str, text: str) -> None:
        wrapper = textwrap.TextWrapper(self.console.width - 1, f"  {mark} ", "    ", break_on_hyphens=False)
        self.console.print(Text(wrapper.fill(text)), soft_wrap=True)


def _whole(column: int, table: Table) -> bool:
    """Whether a column's cells are never broken: names, which are copied, unless one is far too long."""
    return column == 0 and max((len(row[0]) for row in table.rows), default=0) <= _LONGEST_NAME


def _forgiving_stdout() -> None:
    """Let a terminal without Unicode show a substitute instead of failing."""
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="replace" if sys.stdout.encoding.lower() not in ("utf-8", "utf8") else "backslashreplace")


Report = Callable[[str, int, int], None]


@contextmanager
def progress(arguments: argparse.Namespace) -> Iterator[Report]:
    """A function (text, done, total) that moves the bar; one that does nothing where no bar is wanted."""
    if arguments.quiet or arguments.no_progress or not sys.stderr.isatty():
        yield lambda text, done, total: None
        return
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with ProgressBar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None)

        def report(text: str, done: int, total: int) -> None:
            bar.update(task, description=text, completed=done, total=total)

        yield report


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
        print_json({**result_object(found), "diagnosis": result_object(diagnosis)})
    else:
        _print_diagnosis(arguments, diagnosis, place)


def identification(arguments: argparse.Namespace) -> None:
    """`vjm identify`."""
    chosen = arguments.method, arguments.virtual_joints, arguments.parameters
    fit = _identify(arguments, arguments.experiment, *chosen)
    if arguments.json:
        print_json(result_object(fit))
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
        print_json(result_object(diagnosis))
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
        comparison = compare(experiment, *read_model(arguments.model, experiment), progress=report)
        _save(comparison, arguments.out, report)
    if arguments.json:
        print_json(result_object(comparison))
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
    from vjm.identification.check import check

    if arguments.out is not None:
        check_folder(arguments.out)
    with progress(arguments):
        found = check(load_experiment(arguments.experiment))
    result = result_object(found)
    if arguments.out is not None:
        write_folder(arguments.out, {"result.json": encoded(json_text(result))})
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
        write_text(file, text)
    except OSError as error:
        raise FolderError(file, f"cannot be written ({error.strerror or error})", "choose another with -o") from error


def _chain(source: Path) -> tuple[Chain, tuple[Effect, ...]]:
    """Chain and effects of a model.json, or the nominal one of an experiment file; the content says which it is."""
    if source.suffix != ".toml" and _is_json(source):
        model = load_model(source)
        return model.chain, model.effects
    rig = load_experiment(source).rig
    joints = [
        choose_virtual_joints(link, visible_modes(len(link.markers)), link.virtual_joints).joints for link in rig.links
    ]
    return nominal_chain(rig, rig_layouts(rig, joints)), ()


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
