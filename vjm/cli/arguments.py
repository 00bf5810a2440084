"""The arguments of the command `vjm`; light, so that --help is quick."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import suppress
from math import inf, isfinite
from pathlib import Path
from typing import NoReturn, TypeVar

T = TypeVar("T", int, float)

# Written out here so that --help need not import the identification and the diagnosis; a test holds them equal.
METHODS = ("torque", "torque+frequency", "trajectory")
PARAMETERS = ("uniform", "joints", "lengths", "full")
SIMULATORS = {"pinocchio": ".py", "mujoco": ".xml", "gazebo": ".sdf", "drake": ".py", "pybullet": ".py"}
_DIRECTORY = Path("vjm-out")  # of the demo; of the other commands a folder of their own each
_FILES = "DIR gets result.json, model.json, model.urdf, report.html and figures/*.png."
_STATUS = "Exit status: 0 done, 2 unusable input, 130 interrupted, 1 anything else."


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Return the arguments; end the program on --help, --version and arguments that make no sense (status 2)."""
    description = (
        "Identify a flexible robot arm from camera markers as a chain of rigid links and springs, and diagnose what "
        "the model lacks."
    )
    parser = _Parser(prog="vjm", description=description, epilog=f"{_STATUS} 'vjm COMMAND --help' tells more.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(
        name: str, text: str, notes: str, folder: Path | None, out: str = "", metavar: str = "DIR",
        experiment: bool = True,
    ) -> argparse.ArgumentParser:  # fmt: skip
        out = out or f"folder for the results (default: {folder}), created if missing"
        command = commands.add_parser(
            name, help=text, description=f"{text[0].upper()}{text[1:]}. {notes}", epilog=_STATUS
        )
        command.add_argument("--json", action="store_true", help="print the result object on stdout, and nothing else")
        command.add_argument("-q", "--quiet", action="store_true", help="print nothing but errors")
        command.add_argument("--no-progress", action="store_true", help="no progress bar on the terminal")
        command.add_argument("-o", "--out", metavar=metavar, type=_path, default=folder, help=out)
        if experiment:
            command.add_argument("experiment", metavar="EXPERIMENT", type=_path, help="the experiment file (TOML)")
        return command

    notes = (
        f"Identifies a steel beam from simulated markers, then diagnoses what has changed a week later. {_FILES} "
        "DIR/diagnosis gets those of the diagnosis."
    )
    add("demo", "run a worked example on the data that comes with the package", notes, _DIRECTORY, experiment=False)

    _add_init(add)
    notes = "Also describes each recording, and says which parameters the recordings determine and which they do not."
    text = "folder for check.png (the markers drawn over the rig) and result.json; without it nothing is written"
    add("check", "read an experiment and report what is wrong with it", notes, None, text)

    identify = add("identify", "identify the virtual-joint model of an arm", _FILES, Path("vjm-identify"))
    text = (
        "trajectory: simulated trajectories against everything measured; torque: torque errors alone, as in the paper; "
        "torque+frequency: torque errors and natural frequencies (default: trajectory)"
    )
    identify.add_argument("--method", choices=METHODS, default="trajectory", help=text)
    text = "number of virtual joints of each link (default: the experiment file's, or else chosen from the data)"
    identify.add_argument("--virtual-joints", metavar="N", type=_at_least(1), default=None, help=text)
    text = (
        "uniform: one bending stiffness and Kelvin-Voigt time per link (default); joints: every joint's stiffness and "
        "damping; lengths: those and the virtual links' lengths; full: masses and inertias too"
    )
    identify.add_argument("--parameters", choices=PARAMETERS, default=PARAMETERS[0], help=text)

    text = "replay every recording with an identified model, and compare"
    simulate = add("simulate", text, _FILES, Path("vjm-simulate"))
    text = "the model.json of an identification or a diagnosis"
    simulate.add_argument("model", metavar="MODEL", type=_path, help=text)

    _add_diagnose(add)
    _add_urdf(add)
    _add_flexify(add)
    arguments = parser.parse_args(argv)
    if arguments.command == "urdf" and arguments.simulator and arguments.out is None:
        parser.error("--for writes two files; name the URDF with -o FILE.urdf")
    return arguments


def _add_diagnose(add: Callable[..., argparse.ArgumentParser]) -> None:
    notes = f"{_FILES} model.json holds the model with the causes found."
    diagnose = add(
        "diagnose", "find the causes of a model's residual, and what modelling them gains", notes, Path("vjm-diagnose")
    )
    text = "ids of the effects to look for, such as tip_payload,coulomb_friction (default: all built-in effects)"
    diagnose.add_argument("--effects", metavar="A,B,C", type=_names, default=None, help=text)
    for option, metavar, minimum, default, words in (
        ("--max-effects", "M", 1, 3, "largest number of causes"),
        ("--jobs", "J", 1, 1, "number of processes"),
        ("--seed", "S", 0, 0, "seed of all random numbers"),
    ):
        text = f"{words} (default: {default})"
        diagnose.add_argument(option, metavar=metavar, type=_at_least(minimum), default=default, help=text)
    text = (
        "time after which the search ends with the best model so far and lists what was not tried (default: 120 s for "
        "two processes and up to 40 periods of the slowest vibration or 3,500 frames in the training recordings, "
        "longer for more, up to 240 s, as for any arm with an elbow; twice as long for one process)"
    )
    diagnose.add_argument("--budget", metavar="SECONDS", type=_positive, default=None, help=text)


def _add_urdf(add: Callable[..., argparse.ArgumentParser]) -> None:
    notes = "An experiment gives the chain of its nominal values. The springs' stiffness is in the element vjm:model."
    text = "the URDF file (default: standard output; with --json, inside the result object)"
    urdf = add("urdf", "write the virtual-joint chain as URDF", notes, None, text, "FILE", experiment=False)
    urdf.add_argument("source", metavar="MODEL|EXPERIMENT", type=_path, help="a model.json, or an experiment file")
    text = "also write, beside FILE, a model with springs for this simulator: " + ", ".join(
        f"{name} {suffix}" for name, suffix in SIMULATORS.items()
    )
    urdf.add_argument("--for", metavar="SIMULATOR", dest="simulator", choices=tuple(SIMULATORS), help=text)


def _add_flexify(add: Callable[..., argparse.ArgumentParser]) -> None:
    notes = (
        "The link is cut along its axis into virtual links, which keep its mass, centre of mass and inertia, joined by "
        "springs; the joint gets a motor side and, behind a spring, a link side. Everything else in the file stays as "
        "it was. The springs' stiffness is in the element vjm:model."
    )
    text = "the URDF file (default: standard output; with --json, inside the result object)"
    flexify = add(
        "flexify", "make a link or a joint of a robot's URDF flexible", notes, None, text, "FILE", experiment=False
    )
    flexify.add_argument("urdf", metavar="ROBOT.urdf", type=_path, help="the robot")
    link = flexify.add_argument_group("flexible link")
    link.add_argument("--link", metavar="NAME", help="the link")
    link.add_argument("--joints", metavar="N", type=_at_least(1), help="number of virtual joints along the link")
    text = "EI [N m^2]: one value, or one for each axis of --bending with commas between them"
    link.add_argument("--bending-stiffness", metavar="EI", type=_numbers, help=text)
    text = "axes of the link's frame about which it bends, such as y,z (default: the two most nearly across the link)"
    link.add_argument("--bending", metavar="AXES", type=_names, help=text)
    link.add_argument("--torsion", metavar="GJ", type=_positive, help="GJ [N m^2] (default: the link does not twist)")
    text = "instead of stiffness: tube:DIAMETER,WALL, rod:DIAMETER or box:WIDTH,HEIGHT [m]; with --youngs-modulus"
    link.add_argument("--section", help=text)
    link.add_argument("--youngs-modulus", metavar="E", type=_positive, help="Young's modulus of the section [Pa]")
    text = "shear modulus of the section [Pa] (default: the link does not twist)"
    link.add_argument("--shear-modulus", metavar="G", type=_positive, help=text)
    text = "density of the section [kg/m^3], for its share of the link's mass (default: what the inertia allows)"
    link.add_argument("--density", metavar="RHO", type=_positive, help=text)
    text = "direction of the link: x, y, z or X,Y,Z in its frame (default: from its origin to its child joint's)"
    link.add_argument("--axis", type=_axis, help=text)
    link.add_argument("--child", metavar="JOINT", help="the joint at the far end of a link that branches")
    text = "ends of the flexible part as X,Y,Z in the link's frame [m], instead of --axis and --child"
    link.add_argument("--ends", metavar=("START", "END"), type=_numbers, nargs=2, help=text)
    joint = flexify.add_argument_group("flexible joint")
    joint.add_argument("--joint", metavar="NAME", help="the joint")
    joint.add_argument(
        "--stiffness", metavar="K", type=_positive, help="stiffness of its spring [N m/rad], prismatic [N/m]"
    )
    text = "inertia of its motor, seen at the joint: gear ratio squared times the rotor's [kg m^2], prismatic [kg]"
    joint.add_argument("--rotor-inertia", metavar="B", type=_positive, help=text)
    text = "damping over stiffness of all springs [s] (default: 0)"
    flexify.add_argument("--kelvin-voigt", metavar="TIME", type=_finite, default=0.0, help=text)


def _add_init(add: Callable[..., argparse.ArgumentParser]) -> None:
    notes = (
        "It looks at the CSV files for links, markers, units and kinds of recordings, asks on a terminal for what is "
        "not given, leaves a '?' where a number is missing, and checks what it has written. It never overwrites one."
    )
    text = "folder for the check's result.json and check.png; without it neither is written"
    init = add("init", "write an experiment file for recordings", notes, None, text, experiment=False)
    init.add_argument("folder", metavar="FOLDER", type=_path, help="where experiment.toml is written")
    text = "recordings (default: all CSV files in FOLDER)"
    init.add_argument("--csv", metavar="FILE", type=_path, nargs="+", default=None, help=text)
    init.add_argument("--name", help="name of the experiment (default: the folder's)")
    init.add_argument("--joint", choices=("revolute", "clamped"), help="kind of joint at the first link's proximal end")
    for key, unit in (
        ("length", "m"), ("mass", "kg"), ("bending-stiffness", "N m^2"), ("youngs-modulus", "Pa"), ("width", "m"),
        ("thickness", "m"), ("hub-inertia", "kg m^2"),
    ):  # fmt: skip
        name = "Young's modulus" if key == "youngs-modulus" else key.replace("-", " ")
        text = f"{name} of the first link [{unit}]"
        init.add_argument(f"--{key}", metavar="X", type=_positive, default=None, help=text)
    text = "gravity in the plane of motion [m/s^2] (default: 0 0)"
    init.add_argument("--gravity", metavar=("GX", "GY"), type=_finite, nargs=2, default=None, help=text)


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints are printable, whatever the arguments hold."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and a message, and end the program with status 2."""
        from vjm.errors import printable

        super().error(printable(message))


class _Version(argparse.Action):
    """Prints the version; `importlib.metadata` is slow to import and rarely needed."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"vjm {version('vjm')}")
        parser.exit()


def _number(kind: Callable[[str], T], valid: Callable[[T], bool], expected: str) -> Callable[[str], T]:
    """Return a parser of an argument that is a number of some kind for which `valid` holds."""

    def parsed(text: str) -> T:
        with suppress(ValueError):
            if valid(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is not {expected}")

    return parsed


_positive = _number(float, lambda value: 0 < value < inf, "a positive number")
_finite = _number(float, isfinite, "a finite number")


def _path(text: str) -> Path:
    if not text:  # which Path takes for the current folder
        raise argparse.ArgumentTypeError("'' names no file and no folder")
    return Path(text)


def _at_least(minimum: int) -> Callable[[str], int]:
    return _number(int, lambda value: value >= minimum, f"a whole number of at least {minimum}")


def _numbers(text: str) -> tuple[float, ...]:
    return tuple(_finite(number) for number in text.split(","))


def _axis(text: str) -> str | tuple[float, ...]:
    return _numbers(text) if "," in text else text


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of names with commas between them")
    return names
