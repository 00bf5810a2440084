"""The arguments: names, defaults, and that asking for help costs nothing."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from vjm.cli.arguments import METHODS, PARAMETERS, SIMULATORS, parse
from vjm.diagnosis import diagnose
from vjm.identification import METHODS as KNOWN_METHODS
from vjm.identification import PARAMETRISATIONS, identify
from vjm.model.urdf import SIMULATORS as KNOWN_SIMULATORS


def test_choices_are_those_of_the_identification() -> None:
    assert METHODS == KNOWN_METHODS
    assert SIMULATORS == KNOWN_SIMULATORS
    assert PARAMETERS == PARAMETRISATIONS
    signature = inspect.signature(identify)
    assert signature.parameters["method"].default == parse(["identify", "x.toml"]).method
    assert signature.parameters["parameters"].default == parse(["identify", "x.toml"]).parameters


def test_defaults_are_those_of_the_diagnosis() -> None:
    arguments, signature = parse(["diagnose", "x.toml"]), inspect.signature(diagnose)
    for name in ("effects", "max_effects", "jobs", "seed", "budget"):
        assert getattr(arguments, name) == signature.parameters[name].default


def test_effects_are_a_list_of_names() -> None:
    arguments = parse(["diagnose", "x.toml", "--effects", "tip_payload, linear_drag", "--seed", "0"])
    assert arguments.effects == ("tip_payload", "linear_drag")
    assert arguments.seed == 0


def test_help_and_version_import_nothing_heavy() -> None:
    code = "import sys; from vjm.cli import main\ntry: main([{!r}])\nexcept SystemExit: pass\n"
    code += "print(sorted({{'numpy', 'rich', 'matplotlib', 'pydantic'}} & set(sys.modules)))"
    for option in ("--help", "--version"):
        command = [sys.executable, "-c", code.format(option)]
        result = subprocess.run(command, capture_output=True, text=True, check=True)
        assert result.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("command", ["check", "identify", "flexify"])
def test_a_fault_in_a_file_is_told_before_anything_heavy_is_imported(command: str, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("x = 1")
    code = "import sys; from vjm.cli import main; status = main(sys.argv[1:])\n"
    code += "print(status, *sorted({'matplotlib', 'scipy.stats', 'vjm.diagnosis'} & set(sys.modules)))"
    arguments = [command, str(wrong), *(["--link", "arm"] if command == "flexify" else [])]
    result = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["2"], result.stderr


def test_help_is_quick() -> None:
    def once() -> float:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "vjm", "--help"], capture_output=True, check=True)
        return time.perf_counter() - start

    assert min(once() for _ in range(4)) < 0.4


COMMANDS = ["demo", "init", "check", "identify", "simulate", "diagnose", "urdf", "flexify"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        parse([command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for option in ("--out", "--json", "--quiet", "--no-progress", "Exit status"):
        assert option in text
    # A help text can be read alone: "length of the first link", not "of the first link".
    assert not {"of", "in", "at"} & {*re.findall(r"^  -.*?\s{2,}(\w+)", text, re.MULTILINE)}


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["colour"],
        ["identify"],
        ["identify", "x.toml", "--method", "guess"],
        ["identify", "x.toml", "--parameters", "all"],
        ["identify", "x.toml", "--virtual-joints", "0"],
        ["identify", "x.toml", "--virtual-joints", "many"],
        ["simulate", "x.toml"],
        ["diagnose"],
        ["diagnose", "x.toml", "--effects", "tip_payload,,drag"],
        ["diagnose", "x.toml", "--max-effects", "0"],
        ["diagnose", "x.toml", "--jobs", "all"],
        ["diagnose", "x.toml", "--budget", "0"],
        ["diagnose", "x.toml", "--budget", "long"],
        ["diagnose", "x.toml", "--budget", "inf"],
        ["diagnose", "x.toml", "--seed", "-1"],
        ["urdf"],
        ["flexify"],
        ["flexify", "x.urdf", "--joints", "0"],
        ["flexify", "x.urdf", "--stiffness", "-1"],
        ["flexify", "x.urdf", "--bending-stiffness", "stiff"],
        ["flexify", "x.urdf", "--ends", "0,0,0"],
        ["demo", "extra"],
        ["check", "x.toml", "\x1b[2J"],
    ],
)
def test_senseless_arguments_end_with_status_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        parse(arguments)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "usage: vjm" in captured.err
    assert "\x1b" not in captured.err


@pytest.mark.parametrize(
    "arguments", [["init", ""], ["check", ""], *([command, "x", "-o", ""] for command in COMMANDS)]
)
def test_an_empty_path_is_not_the_current_folder(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(arguments)
    assert ended.value.code == 2
    assert re.search(r"argument \S+: '' names no file and no folder\n$", capsys.readouterr().err)


def test_common_options() -> None:
    arguments = parse(["identify", "x.toml", "-o", "here", "--json", "-q", "--no-progress", "--virtual-joints", "4"])
    assert (str(arguments.out), arguments.json, arguments.quiet, arguments.no_progress) == ("here", True, True, True)
    assert arguments.virtual_joints == 4
    assert str(parse(["demo"]).out) == "vjm-out"
    for command, *model in (("identify",), ("diagnose",), ("simulate", "model.json")):  # none overwrites another's
        assert str(parse([command, "experiment.toml", *model]).out) == f"vjm-{command}"
    assert parse(["check", "x.toml"]).out is None
    assert parse(["urdf", "x.toml"]).out is None
    assert parse(["flexify", "x.urdf"]).out is None


def test_two_files_need_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parse(["urdf", "model.json", "--for", "mujoco"])
    assert ended.value.code == 2
    assert "-o FILE.urdf" in capsys.readouterr().err
