"""The command line's arguments; light, so that --help answers at once."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

# Written out here so that --help need not import the identification; a test holds them equal.
METHODS = ("torque", "torque+frequency", "trajectory")
PARAMETERS = ("uniform", "joints", "lengths", "full")
DEFAULT_METHOD: Final = "trajectory"
DEFAULT_MAX_EFFECTS, DEFAULT_JOBS, DEFAULT_SEED = 3, 1, 0
DEFAULT_DIRECTORY = Path("vjm-out")

_FILES = "DIR gets result.json, model.json, model.urdf, report.html and figures/*.png."
_STATUS = "Exit status: 0 done, 2 the input is unusable, 130 interrupted, 1 anything else."


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments; end the program on --help, --version and arguments that make no sense (status 2)."""
    return _parser().parse_args(argv)


def _parser() -> argparse.ArgumentParser:
    description = (
        "Identify a flexible robot arm from camera markers as a chain of rigid links and springs, and say what the "
        "model lacks."
    )
    parser = argparse.ArgumentParser(
        prog="vjm", description=description, epilog=f"{_STATUS} 'vjm COMMAND --help' tells more."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str, more: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}. {more}", epilog=_STATUS)
        added.add_argument("--json", action="store_true", help="print the result object on stdout, and nothing else")
        added.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
        added.add_argument("--no-progress", action="store_true", help="no progress bar on the terminal")
        return added

    more = f"Identifies a steel beam from simulated markers, then diagnoses it. {_FILES} DIR/diagnosis gets the same."
    _add_directory(command("demo", "a worked example on the data that comes with the package", more))

    more = "Also says what the recordings can identify, and what they cannot tell apart."
    check = command("check", "read an experiment and say what is wrong with it", more)
    _add_experiment(check)
    text = "folder for result.json; without it nothing is written"
    check.add_argument("-o", "--out", metavar="DIR", type=Path, default=None, help=text)

    _add_identification(command("identify", "identify the virtual-joint model of an arm", _FILES))

    simulate = command("simulate", "replay every recording with an identified model, and compare", _FILES)
    _add_experiment(simulate)
    text = "the model.json of an identification or a diagnosis"
    simulate.add_argument("model", metavar="MODEL", type=Path, help=text)
    _add_directory(simulate)

    more = f"{_FILES} model.json holds the model with what was found."
    _add_diagnosis(command("diagnose", "find what a model of the arm lacks, why, and what adding it gains", more))

    more = "Of an experiment, the chain of its nominal values. The springs' stiffness is in the element vjm:model."
    urdf = command("urdf", "write the virtual-joint chain as URDF", more)
    urdf.add_argument("source", metavar="MODEL|EXPERIMENT", type=Path, help="a model.json, or an experiment file")
    text = "the URDF file (default: standard output; with --json, inside the result object)"
    urdf.add_argument("-o", "--out", metavar="FILE", type=Path, default=None, help=text)
    return parser


class _Version(argparse.Action):
    """Prints the version; `importlib.metadata` is slow to import and rarely needed."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"vjm {version('vjm')}")
        parser.exit()


def _add_experiment(command: argparse.ArgumentParser) -> None:
    command.add_argument("experiment", metavar="EXPERIMENT", type=Path, help="the experiment file (TOML)")


def _add_directory(command: argparse.ArgumentParser) -> None:
    text = f"folder for the results (default: {DEFAULT_DIRECTORY}); made if need be"
    command.add_argument("-o", "--out", metavar="DIR", type=Path, default=DEFAULT_DIRECTORY, help=text)


def _add_identification(command: argparse.ArgumentParser) -> None:
    _add_experiment(command)
    _add_directory(command)
    text = (
        "trajectory: whole simulated trajectories against everything measured; torque: torque errors alone, as in the "
        f"paper; torque+frequency: with the natural frequencies (default: {DEFAULT_METHOD})"
    )
    command.add_argument("--method", choices=METHODS, default=DEFAULT_METHOD, help=text)
    text = "number of virtual joints of each link (default: the experiment file's, else chosen from the data)"
    command.add_argument("--virtual-joints", metavar="N", type=_at_least(1), default=None, help=text)
    text = (
        "uniform: one bending stiffness and Kelvin-Voigt time per link (default); joints: every joint's stiffness and "
        "damping; lengths: those and the virtual links' lengths; full: masses and inertias too"
    )
    command.add_argument("--parameters", choices=PARAMETERS, default=PARAMETERS[0], help=text)


def _add_diagnosis(command: argparse.ArgumentParser) -> None:
    _add_experiment(command)
    _add_directory(command)
    text = "ids of the effects to look for, as tip_payload,coulomb_friction (default: all that are built in)"
    command.add_argument("--effects", metavar="A,B,C", type=_names, default=None, help=text)
    for option, metavar, kind, default, words in (
        ("--max-effects", "M", _at_least(1), DEFAULT_MAX_EFFECTS, "number of causes at most"),
        ("--jobs", "J", _at_least(1), DEFAULT_JOBS, "number of processes"),
        ("--seed", "S", _at_least(0), DEFAULT_SEED, "seed of all random numbers"),
    ):
        text = f"{words} (default: {default})"
        command.add_argument(option, metavar=metavar, type=kind, default=default, help=text)


def _at_least(least: int) -> Callable[[str], int]:
    def whole(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
        return value

    return whole


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of names with commas between them")
    return names
