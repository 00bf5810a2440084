"""The command `vjm`: its arguments, its exit status, and what it says of failures; light, so that --help is quick."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

# Written out here so that --help need not import the identification and the diagnosis; a test holds them equal.
METHODS = ("torque", "torque+frequency", "trajectory")
PARAMETERS = ("uniform", "joints", "lengths", "full")
_DIRECTORY = Path("vjm-out")
_OUT = f"folder for the results (default: {_DIRECTORY}); made if need be"
_FILES = "DIR gets result.json, model.json, model.urdf, report.html and figures/*.png."
_STATUS = "Exit status: 0 done, 2 the input is unusable, 130 interrupted, 1 anything else."


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the process's own arguments where `argv` is None, and return its exit status."""
    try:
        arguments = _parse(argv)
        if not sys.warnoptions:
            warnings.simplefilter("ignore")  # a user can do nothing about a library's warnings
        # The matrices are small: BLAS threads would only wait for each other. Read when NumPy is first imported.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        from vjm.cli.commands import COMMANDS  # everything heavy comes with it

        COMMANDS[arguments.command](arguments)
        sys.stdout.flush()
    except KeyboardInterrupt:
        return _failed("interrupted", 130)
    except BrokenPipeError:
        # The reader of our output has gone; the rest of the buffer must not raise once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        from vjm.errors import InputError, VjmError

        if isinstance(error, VjmError):
            return _failed(str(error), 2 if isinstance(error, InputError) else 1)
        text = " ".join(str(error).split())
        return _failed(f"internal error: {type(error).__name__}{': ' if text else ''}{text}", 1)
    return 0


def _failed(message: str, status: int) -> int:
    # Half a surrogate pair (from an undecodable file name) cannot be printed as it is.
    print(f"vjm: {message}".encode("utf-8", "backslashreplace").decode("utf-8"), file=sys.stderr)
    return status


def _parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments; end the program on --help, --version and arguments that make no sense (status 2)."""
    description = (
        "Identify a flexible robot arm from camera markers as a chain of rigid links and springs, and say what the "
        "model lacks."
    )
    parser = argparse.ArgumentParser(
        prog="vjm", description=description, epilog=f"{_STATUS} 'vjm COMMAND --help' tells more."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(
        name: str, text: str, more: str, out: str = _OUT, folder: Path | None = _DIRECTORY, metavar: str = "DIR",
        experiment: bool = True,
    ) -> argparse.ArgumentParser:  # fmt: skip
        command = commands.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}. {more}", epilog=_STATUS
        )
        command.add_argument("--json", action="store_true", help="print the result object on stdout, and nothing else")
        command.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
        command.add_argument("--no-progress", action="store_true", help="no progress bar on the terminal")
        command.add_argument("-o", "--out", metavar=metavar, type=Path, default=folder, help=out)
        if experiment:
            command.add_argument("experiment", metavar="EXPERIMENT", type=Path, help="the experiment file (TOML)")
        return command

    more = f"Identifies a steel beam from simulated markers, then diagnoses it. {_FILES} DIR/diagnosis gets the same."
    add("demo", "a worked example on the data that comes with the package", more, experiment=False)

    more = "Also says what the recordings can identify, and what they cannot tell apart."
    text = "folder for result.json; without it nothing is written"
    add("check", "read an experiment and say what is wrong with it", more, text, None)

    identify = add("identify", "identify the virtual-joint model of an arm", _FILES)
    text = (
        "trajectory: whole simulated trajectories against everything measured; torque: torque errors alone, as in the "
        "paper; torque+frequency: with the natural frequencies (default: trajectory)"
    )
    identify.add_argument("--method", choices=METHODS, default="trajectory", help=text)
    text = "number of virtual joints of each link (default: the experiment file's, else chosen from the data)"
    identify.add_argument("--virtual-joints", metavar="N", type=_at_least(1), default=None, help=text)
    text = (
        "uniform: one bending stiffness and Kelvin-Voigt time per link (default); joints: every joint's stiffness and "
        "damping; lengths: those and the virtual links' lengths; full: masses and inertias too"
    )
    identify.add_argument("--parameters", choices=PARAMETERS, default=PARAMETERS[0], help=text)

    simulate = add("simulate", "replay every recording with an identified model, and compare", _FILES)
    text = "the model.json of an identification or a diagnosis"
    simulate.add_argument("model", metavar="MODEL", type=Path, help=text)

    more = f"{_FILES} model.json holds the model with what was found."
    diagnose = add("diagnose", "find what a model of the arm lacks, why, and what adding it gains", more)
    text = "ids of the effects to look for, as tip_payload,coulomb_friction (default: all that are built in)"
    diagnose.add_argument("--effects", metavar="A,B,C", type=_names, default=None, help=text)
    for option, metavar, least, default, words in (
        ("--max-effects", "M", 1, 3, "number of causes at most"),
        ("--jobs", "J", 1, 1, "number of processes"),
        ("--seed", "S", 0, 0, "seed of all random numbers"),
    ):
        text = f"{words} (default: {default})"
        diagnose.add_argument(option, metavar=metavar, type=_at_least(least), default=default, help=text)
    text = (
        "time after which the search ends with the best it has and says what it has not tried (default: 120 s for two "
        "processes and up to 35 s of training recordings, more for more, twice as much for one process)"
    )
    diagnose.add_argument("--budget", metavar="SECONDS", type=_positive, default=None, help=text)

    more = "Of an experiment, the chain of its nominal values. The springs' stiffness is in the element vjm:model."
    text = "the URDF file (default: standard output; with --json, inside the result object)"
    urdf = add("urdf", "write the virtual-joint chain as URDF", more, text, None, "FILE", experiment=False)
    urdf.add_argument("source", metavar="MODEL|EXPERIMENT", type=Path, help="a model.json, or an experiment file")
    return parser.parse_args(argv)


class _Version(argparse.Action):
    """Prints the version; `importlib.metadata` is slow to import and rarely needed."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"vjm {version('vjm')}")
        parser.exit()


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


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
    return value


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of names with commas between them")
    return names
