"""The commands: each reads its input, computes, writes its folder, and prints what it found.

What takes long to import is imported when it is needed: a fault in an input file is told in a fraction of the time.
"""

from __future__ import annotations

import argparse
import codecs
import inspect
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as ProgressBar

import vjm
from vjm.cli.init import init, stdin_is_terminal
from vjm.errors import MistakeError, ModelFileError, printable
from vjm.files import check_file, check_folder, check_model_file, json_text, write_folder, write_models
from vjm.records import Experiment, Progress
from vjm.text import counted, number

if TYPE_CHECKING:
    _Saved = vjm.Comparison | vjm.Diagnosis

_COMPUTING = 0.9  # share of the bar; drawing takes the rest


@contextmanager
def _progress(arguments: argparse.Namespace) -> Iterator[Callable[[str, float], None]]:
    """Give a function of a stage's name and the share done that moves the bar, or does nothing where none is wanted."""
    if arguments.quiet or arguments.no_progress or not sys.stderr.isatty():
        yield lambda text, share: None
        return
    time_left = TextColumn("{task.fields[time_left]}", markup=False)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(20), TimeElapsedColumn(), time_left)
    with ProgressBar(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("reading", total=None, time_left="")

        def show(text: str, share: float) -> None:
            elapsed, time_left = bar.tasks[0].elapsed or 0.0, ""
            if share > 0.1:  # before, next to nothing is known
                time_left = f"about {number(elapsed * (1 / share - 1), 1)} s left"
            bar.update(task, description=printable(text), completed=share, total=1.0, time_left=time_left)

        yield show


def _saved(
    arguments: argparse.Namespace, file: Path, folder: Path, compute: Callable[[Experiment, Progress], _Saved]
) -> _Saved:
    with _progress(arguments) as show:
        experiment = vjm.load_experiment(file)
        from vjm.report.output import check_result_folder

        check_result_folder(folder)
        result = compute(experiment, lambda text, done, total: show(text, _COMPUTING * done / max(total, 1)))
        drawing = 1 - _COMPUTING
        report = lambda text, done, total: show(text, _COMPUTING + drawing * done / max(total, 1))  # noqa: E731
        vjm.save(result, folder, arguments.line, report)
    return result


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Write what an encoding lacks in plain characters: a minus sign must not get lost."""
    assert isinstance(error, UnicodeEncodeError)
    characters = error.object[error.start : error.end]
    return "".join(_SUBSTITUTES.get(character, "?") for character in characters), error.end


_PLAIN = "vjm-plain"
_SUBSTITUTES = {"−": "-", "±": "+-", "×": "x", "µ": "u", "…": "..", "°": "deg", "²": "^2", "³": "^3", "χ": "chi"}
_SUBSTITUTES |= dict(zip("⁻⁰¹⁴⁵⁶⁷⁸⁹", "-01456789", strict=True)) | {"≥": ">=", "–": "-", "─": "-"}
codecs.register_error(_PLAIN, _plain)


def _print(text: str) -> None:
    """Print text as UTF-8, whatever the terminal; of half a surrogate pair its escape."""
    sys.stdout.buffer.write(text.encode("utf-8", "backslashreplace"))


def _show(arguments: argparse.Namespace, result: _Saved | vjm.Check, folder: Path | None = None) -> None:
    from vjm.report.output import REPORT, result_page
    from vjm.report.result_json import result_object

    if arguments.json:
        _print(json_text(result_object(result)))
    elif not arguments.quiet:
        # A terminal without Unicode shows a substitute instead of failing.
        reconfigure = getattr(sys.stdout, "reconfigure", None)
        if reconfigure is not None:
            unicode = sys.stdout.encoding.lower() in ("utf-8", "utf8")
            reconfigure(errors="backslashreplace" if unicode else _PLAIN)
        result_page(result).write(sys.stdout)
        if folder is not None:
            print(printable(f"Report: {folder / REPORT}"))


def _run(arguments: argparse.Namespace, compute: Callable[[Experiment, Progress], _Saved]) -> None:
    _show(arguments, _saved(arguments, arguments.experiment, arguments.out, compute), arguments.out)


def _identify(arguments: argparse.Namespace) -> None:
    chosen = arguments.method, arguments.virtual_joints, arguments.parameters
    _run(arguments, lambda experiment, report: vjm.identify(experiment, *chosen, progress=report))


def _diagnose(arguments: argparse.Namespace) -> None:
    chosen = arguments.effects, arguments.max_effects, arguments.jobs, arguments.seed, arguments.budget
    _run(arguments, lambda experiment, report: vjm.diagnose(experiment, *chosen, progress=report))


def _simulate(arguments: argparse.Namespace) -> None:
    def compute(experiment: Experiment, report: Progress) -> vjm.Comparison:
        from vjm.report.model_json import read_model

        return vjm.compare(experiment, *read_model(arguments.model, experiment), progress=report)

    if _is_json(arguments.experiment) and not _is_json(arguments.model):
        usage = f"vjm simulate {arguments.model} {arguments.experiment}"
        raise ModelFileError(arguments.experiment, "a model stands where the experiment belongs", usage)
    _run(arguments, compute)


def _demo(arguments: argparse.Namespace) -> None:
    from vjm.report.output import check_result_folder
    from vjm.report.result_json import result_object

    steps: dict[str, tuple[Path, Callable[[Experiment, Progress], _Saved]]] = {
        "experiment.toml": (arguments.out, lambda experiment, report: vjm.identify(experiment, progress=report)),
        "later.toml": (
            arguments.out / "diagnosis",
            lambda experiment, report: vjm.diagnose(experiment, progress=report),
        ),
    }
    for folder, _ in steps.values():
        if folder.parent.exists():
            check_result_folder(folder)
    results = []
    with resources.as_file(resources.files("vjm") / "demo") as data:
        for file, (folder, compute) in steps.items():
            results.append(_saved(arguments, data / file, folder, compute))
            if not arguments.json:
                _show(arguments, results[-1], folder)
    if arguments.json:
        identified, diagnosed = map(result_object, results)
        _print(json_text({**identified, "diagnosis": diagnosed}))


_CHECKED = "check.png", "result.json"


def _init(arguments: argparse.Namespace) -> None:
    if arguments.out is not None:
        check_folder(arguments.out, _CHECKED)
    file, missing = init(arguments, stdin_is_terminal() and not arguments.quiet)
    if not (arguments.quiet or arguments.json):
        todo = f"Fill in {', '.join(dict.fromkeys(missing))}, and correct" if missing else "Correct"
        shown, command = printable(str(file)), printable(shlex.quote(str(file)))
        print(f"{shown} is written. {todo} what it guesses.\n\n$ vjm check {command}", flush=True)
    arguments.experiment = file
    _check(arguments)


def _check(arguments: argparse.Namespace) -> None:
    if arguments.out is not None:
        check_folder(arguments.out, _CHECKED)
    with _progress(arguments):
        experiment = vjm.load_experiment(arguments.experiment)
        checked = vjm.check(experiment)
    if arguments.out is not None:
        from vjm.report.figures.check import check_picture
        from vjm.report.result_json import result_object

        picture, result = _CHECKED
        files: dict[str, str | bytes] = {picture: check_picture(checked).png}  # shows what is refused as well
        if not checked.problem:
            files[result] = json_text(result_object(checked))
        write_folder(arguments.out, files)
    _show(arguments, checked)
    if checked.problem:
        raise MistakeError(checked.problem.split("\n"))


def _urdf(arguments: argparse.Namespace) -> None:
    from vjm.model.urdf import simulator_path

    file, simulator = arguments.out, arguments.simulator
    simulator_file = None if simulator is None else simulator_path(file, simulator)
    for written in (file, simulator_file):
        if written is not None:
            check_model_file(written, arguments.source)
    model = _model(arguments.source)
    chain, text = model.arm.chain, model.arm.urdf()
    if simulator is not None:
        model.export(file, simulator)
    elif file is not None:
        model.to_urdf(file)
    left_out = model.arm.not_in_simulators if simulator else ()
    if arguments.json:
        from vjm.report.result_json import urdf_result

        files = [None if path is None else str(path) for path in (file, simulator_file)]
        _print(json_text(urdf_result(chain, text, files[0], files[1], left_out)))
    elif file is None:
        _print(text)
    elif not arguments.quiet:
        print(printable(f"{file}: {counted(chain.size, 'joint')}, {counted(len(chain.links), 'flexible link')}"))
        if simulator_file is not None:
            print(printable(f"{simulator_file}: for {simulator}, with springs, dampers, friction and gravity"))
        if left_out:
            print(f"In neither ({simulator} cannot express it): {', '.join(left_out)}.")


def _flexify(arguments: argparse.Namespace) -> None:
    from vjm.model.urdf_document import UrdfDocument, springs_of

    parameters = inspect.signature(vjm.flexify).parameters
    options = {key: value for key, value in vars(arguments).items() if key in parameters}
    file = arguments.out
    if file is not None:
        check_model_file(file, arguments.urdf)
    text = vjm.flexify(**options)
    if file is not None:
        write_models({file: text})
    document = UrdfDocument.read(text)
    springs = springs_of(document)
    if arguments.json:
        from vjm.report.result_json import flexify_result

        robot = document.robot.attributes.get("name", "")
        _print(json_text(flexify_result(robot, springs, text, None if file is None else str(file))))
    elif file is None:
        _print(text)
    elif not arguments.quiet:
        print(printable(f"{file}: {counted(len(springs), 'joint')} with a spring"))


def _model(source: Path) -> vjm.Model:
    """Return the model of a model.json, or the nominal one of an experiment file; the content tells which."""
    if _is_json(source):
        return vjm.load_model(source)
    rig = vjm.load_experiment(source).rig
    from vjm.chain.layout import nominal_chain, rig_layouts
    from vjm.identification.training_data import JointChoice

    joints = [  # right for as many modes as there are markers to show them (eq. 1)
        JointChoice.of(link, max(len(link.markers), 1), link.virtual_joints).joints for link in rig.links
    ]
    return replace(vjm.Model.nominal(rig), chain=nominal_chain(rig, rig_layouts(rig, joints)))


def _is_json(source: Path) -> bool:
    """Return True if a file is named or begins as JSON does, as models do and experiments do not."""
    try:
        check_file(source)
        with source.open("rb") as stream:
            return source.suffix == ".json" or stream.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{")
    except OSError as error:
        expected = "a model.json or an experiment file (TOML)"
        raise ModelFileError(source, f"cannot be read ({error.strerror})", expected) from error


COMMANDS: dict[str, Callable[[argparse.Namespace], None]] = {
    "demo": _demo,
    "init": _init,
    "check": _check,
    "identify": _identify,
    "simulate": _simulate,
    "diagnose": _diagnose,
    "urdf": _urdf,
    "flexify": _flexify,
}
