"""What the commands print and write; the identification itself is put in place, not run."""

from __future__ import annotations

import argparse
import io
import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import BaseModel

import vjm
from tests.model.chains import write_model
from tests.model.urdf_contents import extension_from, robot_from, springs_from
from tests.report.diagnoses import nothing, pair, undecided, unknown
from tests.report.fits import DEMO, demo_fit, elbow_fit, torque_fit
from tests.report.schema import (
    CheckResult,
    DemoResult,
    DiagnoseResult,
    IdentifyResult,
    SimulateResult,
    UrdfForResult,
    UrdfResult,
)
from vjm.cli import commands, main
from vjm.cli.commands import _progress
from vjm.effects import CubicStiffness, TipPayload
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.files import GENERATED
from vjm.identification.check import Check, overview
from vjm.identification.comparison import Comparison
from vjm.model.urdf import chain_to_urdf
from vjm.report import output

Raise = Callable[[BaseException], None]


@cache
def checked() -> Check:
    fit = demo_fit()
    doubts = ("careful", f"{fit.recordings[0].recording.file}: {'something is doubtful, ' * 9}")
    identifiable = {"uniform": fit.parameters, "joints": elbow_fit().parameters}
    overviews = tuple(overview(fit.experiment.rig, one) for one in fit.experiment.recordings)
    return Check(fit.experiment, doubts, np.array([1.2, 7.4]), (4,), identifiable, overviews=overviews)


def compared() -> Comparison:
    fit = demo_fit()
    return Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, fit.recordings, ("careful",))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = demo_fit()

    def identify(*_: object, progress: Callable[[str, int, int], None]) -> Any:
        progress("pretending", 1, 2)
        return fit

    monkeypatch.setattr(vjm, "identify", identify)
    monkeypatch.setattr(vjm, "compare", lambda *_, progress: compared())
    monkeypatch.setattr(output, "identification_pictures", lambda fit: [])
    monkeypatch.setattr(output, "diagnosis_pictures", lambda _: [])
    monkeypatch.setattr(vjm, "diagnose", lambda *_, **__: undecided())
    monkeypatch.setattr(vjm, "check", lambda experiment: checked())


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.json"
    write_model(demo_fit().model, path)
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    status = main([str(each) for each in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def too_wide(out: str) -> list[str]:
    """Lines that a terminal of 80 columns would break; the path of a report may be as long as it is."""
    return [line for line in out.splitlines() if len(line.rstrip()) > 80 and not line.startswith("Report: ")]


def test_identify_prints_a_short_summary(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "identify", DEMO, "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert out.splitlines()[0] == "stainless steel beam, clamped"
    for words in ("held-out", "beam.bending_stiffness", "mode 1", "both_modes.csv", f"Report: {tmp_path / 'out'}"):
        assert words in out
    for note in demo_fit().notes:
        assert f"  - {note}" in out
    assert "(torque method " in " ".join(out.split())
    assert len(out.splitlines()) <= 50
    assert too_wide(out) == []
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.parametrize(("command", "schema"), [("identify", IdentifyResult), ("diagnose", DiagnoseResult)])
def test_json_prints_the_object_alone(
    command: str, schema: type[BaseModel], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, command, DEMO, "-o", tmp_path / "out", "--json")
    assert (status, err) == (0, "")
    schema.model_validate_json(out)
    assert out == (tmp_path / "out" / "result.json").read_text(encoding="utf-8")


def test_demo_identifies_then_diagnoses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "demo", "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert out.index("beam.bending_stiffness") < out.index("Diagnosis: ") < out.index("Cause found: unknown mass")
    place = tmp_path / "out"
    IdentifyResult.model_validate_json((place / "result.json").read_bytes())
    DiagnoseResult.model_validate_json((place / "diagnosis" / "result.json").read_bytes())
    assert (place / "diagnosis" / "report.html").is_file()
    assert too_wide(out) == []
    assert run(capsys, "demo", "-o", place, "-q") == (0, "", "")
    status, out, _ = run(capsys, "demo", "-o", place, "--json")
    assert DemoResult.model_validate_json(out).diagnosis.verdict == "set"


def test_diagnose_prints_the_finding(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def diagnose(experiment: Any, *options: Any, progress: Any) -> Any:
        progress("looking", 1, 2)
        asked.append(options)
        return undecided() if options[0] is None else nothing()

    monkeypatch.setattr(vjm, "diagnose", diagnose)
    status, out, err = run(capsys, "diagnose", DEMO, "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    told = " ".join(out.split())
    for words in (
        "Cause found: unknown mass of 13.30 ± 0.13 g on the tip of 'beam'",
        "Next experiment: to distinguish tip payload from clamp compliance",
        "Symptoms",
        "In model.urdf and model.json: tip payload (beam).",
        f"Report: {tmp_path / 'out'}",
    ):
        assert words in told
    assert len(out.splitlines()) <= 50
    chosen = [
        "--effects",
        "tip_payload,linear_drag",
        "--max-effects",
        "2",
        "--jobs",
        "2",
        "--seed",
        "5",
        "--budget",
        "90",
    ]
    assert "No cause found" in run(capsys, "diagnose", DEMO, "-o", tmp_path / "out", *chosen)[1]
    assert asked == [(None, 3, 1, 0, None), (("tip_payload", "linear_drag"), 2, 2, 5, 90.0)]
    assert run(capsys, "diagnose", DEMO, "-o", tmp_path / "out", "-q") == (0, "", "")


def test_diagnosed_model_is_simulated_and_written_as_urdf(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "diagnose", DEMO, "-o", tmp_path / "out", "-q")[0] == 0
    model = tmp_path / "out" / "model.json"
    status, out, _ = run(capsys, "urdf", model, "-o", tmp_path / "arm.urdf")
    assert (status, out) == (0, f"{tmp_path / 'arm.urdf'}: 4 joints, 1 flexible link\n")
    assert robot_from(tmp_path / "arm.urdf").link_map["beam_payload"].inertial.mass == 0.0133
    assert (tmp_path / "arm.urdf").read_text() == (tmp_path / "out" / "model.urdf").read_text()


def test_quiet_prints_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "identify", DEMO, "-o", tmp_path / "out", "-q") == (0, "", "")
    assert run(capsys, "check", DEMO, "-q") == (0, "", "")
    assert (tmp_path / "out" / "result.json").is_file()


def test_check_writes_only_where_it_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    status, out, _ = run(capsys, "check", DEMO)
    assert status == 0
    assert "3 training recordings, 1 held out" in out
    assert "careful" in out
    assert not list(tmp_path.iterdir())
    status, out, _ = run(capsys, "check", DEMO, "--json", "-o", tmp_path / "out")
    CheckResult.model_validate_json(out)
    assert (tmp_path / "out" / "result.json").read_text(encoding="utf-8") == out


def test_check_of_hopeless_recordings_ends_with_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hopeless = Check(
        demo_fit().experiment,
        (),
        np.array([1.2]),
        (),
        {},
        "identification: nothing moves; excite it",
        tuple(overview(demo_fit().experiment.rig, one) for one in demo_fit().experiment.recordings),
    )
    monkeypatch.setattr(vjm, "check", lambda experiment: hopeless)
    status, out, err = run(capsys, "check", DEMO, "-o", tmp_path / "out")
    assert status == 2
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["check.png"]
    assert err == f"vjm: {DEMO}: identification: nothing moves; excite it\n"
    assert "virtual joints: none" in out


def test_simulate(tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "simulate", DEMO, model, "-o", tmp_path / "out")
    assert (status, err) == (0, "")
    assert "careful" in out
    status, out, _ = run(capsys, "simulate", DEMO, model, "-o", tmp_path / "out", "--json")
    SimulateResult.model_validate_json(out)


def test_model_of_another_arm_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_model(elbow_fit().model, tmp_path / "elbow.json")
    status, out, err = run(capsys, "simulate", DEMO, tmp_path / "elbow.json", "-o", tmp_path / "out")
    assert (status, out) == (2, "")
    assert "upper" in err
    assert not (tmp_path / "out").exists()


def test_urdf_of_a_model(tmp_path: Path, model: Path, capfdbinary: pytest.CaptureFixture[bytes]) -> None:
    expected = chain_to_urdf(demo_fit().model.chain)
    assert main(["urdf", str(model)]) == 0
    assert capfdbinary.readouterr().out.decode() == expected
    assert main(["urdf", str(model), "-o", str(tmp_path / "arm.urdf")]) == 0
    assert (tmp_path / "arm.urdf").read_text(encoding="utf-8") == expected
    capfdbinary.readouterr()
    assert main(["urdf", str(model), "--json"]) == 0
    assert UrdfResult.model_validate_json(capfdbinary.readouterr().out).urdf == expected


def test_urdf_for_a_simulator_says_what_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    effects = (CubicStiffness(coefficient=2.0, link=0), TipPayload(mass=0.01, link=0))
    write_model(replace(demo_fit().model, effects=effects), tmp_path / "model.json")
    file = tmp_path / "arm.urdf"
    status, out, _ = run(capsys, "urdf", tmp_path / "model.json", "--for", "mujoco", "-o", file)
    assert status == 0
    assert "arm.xml: for mujoco" in out
    assert "In neither (mujoco cannot express it): cubic stiffness (beam)." in out
    _, out, _ = run(capsys, "urdf", tmp_path / "model.json", "--for", "gazebo", "-o", file, "--json")
    result = UrdfForResult.model_validate_json(out)
    assert (result.simulator_file, result.left_out) == (str(file.with_suffix(".sdf")), ["cubic stiffness (beam)"])
    assert file.with_suffix(".sdf").exists()
    assert run(capsys, "urdf", tmp_path / "model.json", "--for", "mujoco", "-o", tmp_path / "arm.xml")[0] == 2


def test_urdf_of_an_experiment_has_its_nominal_values(tmp_path: Path) -> None:
    assert main(["urdf", str(DEMO), "-o", str(tmp_path / "arm.urdf"), "-q"]) == 0
    cells = [float(joint.attrib["cell"]) for joint in extension_from(tmp_path / "arm.urdf")[0]]
    springs = [*springs_from(tmp_path / "arm.urdf").values()]
    assert np.multiply(springs, cells) == pytest.approx(demo_fit().experiment.rig.links[0].bending_stiffness)
    joints = robot_from(tmp_path / "arm.urdf").actuated_joints
    assert [float(joint.dynamics.damping) for joint in joints] == [0.0] * len(springs)


def test_experiment_without_suffix_and_model_without_suffix_are_told_apart(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    renamed = tmp_path / "no_suffix"
    renamed.write_bytes(model.read_bytes())
    assert run(capsys, "urdf", renamed, "-o", tmp_path / "arm.urdf")[0] == 0
    renamed.write_text("schema = 2")
    status, _, err = run(capsys, "urdf", renamed)
    assert status == 2
    assert "schema" in err


def test_places_that_cannot_be_written(
    tmp_path: Path, model: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    (tmp_path / "mine" / "diagnosis").mkdir(parents=True)
    for name in ("report.html", "check.png", "diagnosis/report.html"):
        (tmp_path / "mine" / name).write_text("mine")
    computed: list[str] = []
    for name in ("identify", "compare", "diagnose", "check"):
        monkeypatch.setattr(vjm, name, lambda *_, name=name, **__: computed.append(name))
    places = (file, tmp_path / "missing" / "out", file / "out", tmp_path / "mine", Path("/proc/out"))
    for place in places if sys.platform == "linux" else places[:-1]:
        for command in (
            ["identify", DEMO],
            ["demo"],
            ["check", DEMO],
            ["simulate", DEMO, model],
            ["diagnose", DEMO],
        ):
            status, out, err = run(capsys, *command, "-o", place)
            assert (status, out) == (2, "")
            assert err.startswith("vjm: ")
            assert len(err.splitlines()) == 1
    (tmp_path / "mine" / "report.html").unlink()
    assert "diagnosis/report.html: this file exists" in run(capsys, "demo", "-o", tmp_path / "mine")[2]
    shutil.rmtree(tmp_path / "mine")
    assert not computed  # before the work begins, minutes of it
    assert run(capsys, "urdf", model, "-o", tmp_path)[0] == 2
    for place in (".", tmp_path.anchor):
        assert "this is a folder" in run(capsys, "urdf", model, "--for", "pinocchio", "-o", place)[2]
    assert run(capsys, "urdf", model, "-o", tmp_path / "missing" / "arm.urdf")[0] == 2
    assert file.read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"file", "model.json"}


def test_a_urdf_replaces_urdfs_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for each in DEMO.parent.glob("*.*"):
        shutil.copy(each, tmp_path)
    experiment, robot, link = tmp_path / DEMO.name, tmp_path / "robot.urdf", tmp_path / "link.urdf"
    flexify = "flexify", robot, "--joint", "beam_virtual_1", "--stiffness", "6", "--rotor-inertia", "7", "-o"
    for earlier in ("", f"\ufeff<!-- {GENERATED} -->\n<robot/>"):
        robot.write_text(earlier, encoding="utf-8")
        assert run(capsys, "urdf", experiment, "-o", robot)[0] == 0
    link.symlink_to(robot)
    script, mine, page = tmp_path / "first_mode.py", tmp_path / "mine.xml", tmp_path / "page.html"
    script.write_text("# Simulates my arm\n", encoding="utf-8")
    mine.write_text("<mujoco/>\n", encoding="utf-8")
    page.write_text("<!DOCTYPE html>\n", encoding="utf-8")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for command in (
        *(("urdf", experiment, "-o", place) for place in (experiment, tmp_path / "first_mode.csv", mine, page)),
        ("urdf", experiment, "--for", "pinocchio", "-o", script.with_suffix(".urdf")),
        ("urdf", experiment, "--for", "mujoco", "-o", mine.with_suffix(".urdf")),
        *((*flexify, place) for place in (robot, link, experiment, mine, page)),
    ):
        status, out, err = run(capsys, *command)
        assert (status, out) == (2, "")
        assert "choose another" in err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert run(capsys, *flexify, tmp_path / "flexible.urdf")[0] == 0
    for _ in range(2):  # what was made so may be made again
        assert run(capsys, "urdf", experiment, "--for", "pinocchio", "-o", tmp_path / "made.urdf")[0] == 0
        assert run(capsys, *flexify, tmp_path / "flexible.urdf")[0] == 0


@pytest.mark.parametrize(
    ("error", "status", "text"),
    [
        (InsufficientDataError("modes", "nothing moves", "excite it"), 2, f"{DEMO}: modes: nothing moves; excite it"),
        (SimulationDivergedError(1.0, 0.01, "check the masses"), 1, "check the masses"),
        (ZeroDivisionError("two\nlines"), 1, "vjm: internal error: ZeroDivisionError: two lines"),
        (MemoryError("9 GiB"), 1, "vjm: not enough memory; give fewer or shorter recordings (9 GiB)"),
        (KeyboardInterrupt(), 130, "vjm: interrupted"),
    ],
)
def test_failures_are_one_line_and_leave_nothing(
    error: BaseException,
    status: int,
    text: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(vjm, "identify", fail)
    found, out, err = run(capsys, "identify", DEMO, "-o", tmp_path / "out")
    assert (found, out) == (status, "")
    assert text in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["check", "identify", "diagnose", "urdf"])
def test_malformed_experiments_end_with_status_2(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = {"missing.toml": None, "broken.toml": "schema = [", "empty.toml": "", "binary.toml": "\x00\x01"}
    for name, text in cases.items():
        if text is not None:
            (tmp_path / name).write_text(text)
        place = [] if command == "urdf" else ["-o", tmp_path / "out"]
        status, out, err = run(capsys, command, tmp_path / name, *place)
        assert (status, out) == (2, "")
        assert name in err
        assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_only_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    options = argparse.Namespace(quiet=False, no_progress=False)
    for stream, wanted in ((Terminal(), True), (io.StringIO(), False)):
        monkeypatch.setattr("sys.stderr", stream)
        with _progress(options) as report:
            report("fitting [bold]", 0.5)
        assert ("fitting [bold]" in stream.getvalue()) == wanted
        assert ("s left" in stream.getvalue()) == wanted
    for silent in (
        argparse.Namespace(quiet=True, no_progress=False),
        argparse.Namespace(quiet=False, no_progress=True),
    ):
        stream = Terminal()
        monkeypatch.setattr("sys.stderr", stream)
        with _progress(silent) as report:
            report("fitting", 0.5)
        assert stream.getvalue() == ""


def with_long_names(result: Any) -> Any:
    """The same result of recordings whose names are as long as those of files often are."""

    def renamed(item: Any, k: int) -> Any:
        return replace(item, recording=replace(item.recording, file=f"2024-05-0{k}_steel_beam_free_decay_{k}.csv"))

    field = "overviews" if isinstance(result, Check) else "recordings"
    return replace(result, **{field: tuple(renamed(item, k) for k, item in enumerate(getattr(result, field)))})


RESULTS = [checked, demo_fit, elbow_fit, torque_fit, compared, pair, undecided, unknown, nothing]


@pytest.mark.parametrize("of", RESULTS, ids=lambda of: of.__name__)
@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("long_names", [False, True])
def test_nothing_is_wider_than_80_columns(
    of: Callable[[], Any], terminal: bool, long_names: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = Terminal() if terminal else io.StringIO()
    monkeypatch.setenv("COLUMNS", "80")
    result = with_long_names(of()) if long_names else of()
    output.result_page(result).write(stream)
    said = re.sub(r"\x1b\[[\d;]*m", "", stream.getvalue())
    assert too_wide(said) == []
    if long_names:  # and what tells one from the other is left of them
        rows = {line.split()[0] for line in said.splitlines() if line.startswith(" 2024-05-0")}
        assert len(rows) == len(result.experiment.recordings)


def test_arguments_in_the_wrong_order_are_recognised(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status, out, err = run(capsys, "simulate", model, DEMO, "-o", tmp_path / "out")
    assert (status, out) == (2, "")
    assert "a model stands where the experiment belongs" in err
    assert f"vjm simulate {DEMO} {model}" in err


def test_warnings_and_names_are_printed_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = demo_fit()
    strange = Check(fit.experiment, ("[red]not markup[/red] :smile:", ""), np.array([1.0]), (4,), {})
    monkeypatch.setattr(vjm, "check", lambda experiment: strange)
    assert "[red]not markup[/red] :smile:" in run(capsys, "check", DEMO)[1]
    result = json.loads(run(capsys, "check", DEMO, "--json")[1])
    assert result["warnings"][0] == "[red]not markup[/red] :smile:"


def test_terminal_without_unicode(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(raw, encoding="ascii"))
    assert main(["check", str(DEMO)]) == 0
    assert b"stainless steel beam" in raw.getvalue()


def test_a_terminal_without_unicode_keeps_signs_and_powers() -> None:
    text = "−0.72 ± 0.01, (3.1 ± 0.1) × 10⁻⁴, ≥ 2 µm … 3°"
    assert text.encode("ascii", commands._PLAIN).decode() == "-0.72 +- 0.01, (3.1 +- 0.1) x 10-4, >= 2 um .. 3deg"
