"""`vjm init`: what it proposes, what it asks, what it leaves to be filled in, and that its file is one vjm reads."""

from __future__ import annotations

import io
import os
import shlex
import shutil
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from vjm.cli import main
from vjm.experiment.load import load_experiment

DEMO = Path(__file__).parents[2] / "vjm" / "demo"
RIG = ["--length", "1", "--mass", "0.44", "--bending-stiffness", "1.9"]


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    status = main([str(each) for each in arguments])
    captured = capsys.readouterr()
    return status, captured.out, captured.err


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("quiet", "first_mode", "second_mode"):
        shutil.copy(DEMO / f"{name}.csv", tmp_path)
    return tmp_path


def hub_file(path: Path, torque: float, count: int = 200) -> None:
    """Two markers of a turning link as a motion-capture system may write them, and the motor in a file of its own."""
    time = 0.01 * np.arange(count)
    angle = 0.4 * np.sin(3.0 * time)
    columns: dict[str, np.ndarray] = {"Frame": np.arange(count), "Time (ms)": 1e3 * time}
    for k, arc in enumerate((250.0, 500.0), start=1):
        columns |= {f"Marker{k} X": arc * np.cos(angle), f"Marker{k} Y": 900 + 0 * angle}
        columns[f"Marker{k} Z"] = arc * np.sin(angle)
    pd.DataFrame(columns).to_csv(path, index=False)
    motors = {"Time (ms)": 1e3 * time, "Motor angle (deg)": np.rad2deg(angle), "Torque": torque * np.cos(3.0 * time)}
    pd.DataFrame(motors).to_csv(path.with_stem(f"{path.stem}_motors"), index=False)


def test_what_is_given_makes_a_whole_experiment(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "init", folder, *RIG)
    assert (status, err) == (0, "")
    assert "experiment.toml is written. Correct what it guesses.\n" in out
    assert "training recordings, 1 held out" in out
    assert [line for line in out.splitlines() if len(line.rstrip()) > 80 and str(folder) not in line] == []
    experiment = load_experiment(folder / "experiment.toml")
    (link,) = experiment.rig.links
    assert (link.name, link.joint, link.length, link.mass) == ("beam", "clamped", 1.0, 0.44)
    assert link.markers == pytest.approx((0.2, 0.4, 0.6, 0.8, 1.0), abs=2e-3)
    found = {each.file: (each.kind, each.role) for each in experiment.recordings}
    assert found == {
        "first_mode.csv": ("decay", "train"),
        "quiet.csv": ("quiet", "train"),
        "second_mode.csv": ("decay", "holdout"),
    }


def test_names_units_axes_and_motors_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, torque in (("a", 0.2), ("b", 0.0), ("c", 0.1)):
        hub_file(tmp_path / f"{name}.csv", torque)
    run(capsys, "init", tmp_path, "--length", "0.5", "--mass", "0.2", "--bending-stiffness", "3", "-q")
    text = (tmp_path / "experiment.toml").read_text()
    for line in (
        'length = "mm"  # guessed',
        'angle = "deg"  # the column',
        'time = "ms"',
        'axes = ["x", "z"]',
        '"Marker1 X"',
    ):
        assert line in text
    experiment = load_experiment(tmp_path / "experiment.toml")
    first = experiment.recordings[0]
    assert [each.kind for each in experiment.recordings] == ["driven", "decay", "driven"]
    assert [each.role for each in experiment.recordings] == ["train", "train", "holdout"]
    np.testing.assert_allclose(first.markers[:, 1, 1], 0.5 * np.sin(first.theta[:, 0]), atol=1e-9)
    np.testing.assert_allclose(first.time, 0.01 * np.arange(200), atol=1e-12)
    assert experiment.rig.links[0].markers == (0.25, 0.5)
    assert experiment.unused_columns == ("Frame",)


def test_what_is_missing_is_left_open_and_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = run(capsys, "init", folder, "--mass", "0.44")
    assert status == 2
    assert "Fill in length, bending_stiffness, and correct what it guesses.\n" in out
    assert "key 'length': got '?' (and 1 more fault in this file); expected a finite positive number [m]" in err
    text = (folder / "experiment.toml").read_text()
    (folder / "experiment.toml").write_text(text.replace('length = "?"', "length = 1", 1).replace('= "?"', "= 1.9"))
    assert run(capsys, "check", folder / "experiment.toml", "-q")[0] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["--bending-stiffness", "1.9", "--width", "0.035"],
            "--width: given together with --bending-stiffness; expected either --youngs-modulus, --width and "
            "--thickness, or --bending-stiffness\n",
        ),
        (
            ["--bending-stiffness", "1.9", "--width", "0.035", "--thickness", "0.0015", "--youngs-modulus", "2e11"],
            "--youngs-modulus: given together with --bending-stiffness; expected either --youngs-modulus, --width and",
        ),
        (["--hub-inertia", "0.1"], "--hub-inertia: the link is clamped and has no hub"),
        (["--hub-inertia", "0.1", "--joint", "clamped"], "--hub-inertia: the link is clamped and has no hub"),
        (["--name", ""], "--name: got ''; expected the experiment's name"),
        (["--mass", "1e12"], "--mass: got 1000000000000.0; expected a finite positive number [kg]"),
        (["--gravity", "0", "1e9"], "--gravity: item 2 is 1000000000.0; expected two finite numbers"),
        (
            ["--width", "1e-8", "--thickness", "1e-9", "--youngs-modulus", "1e-5"],
            "--youngs-modulus: bending stiffness E w h^3 / 12 comes out as 8.33333e-42",
        ),
    ],
)
@pytest.mark.parametrize("length", [[], ["--length", "1"]])  # what has to be filled in does not keep it from looking
def test_options_that_the_file_would_be_refused_for(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str, length: list[str]
) -> None:
    status, out, err = run(capsys, "init", folder, *options, *length)
    assert (status, out) == (2, "")
    assert message in err
    assert not (folder / "experiment.toml").exists()


def test_a_stiffness_may_be_that_of_the_section(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    section = ["--width", "0.03", "--thickness", "0.002", "--youngs-modulus", "7e10"]
    rig = ["--length", "1", "--mass", "0.44", "--bending-stiffness", "1.4", *section]
    assert run(capsys, "init", folder, *rig, "-q") == (0, "", "")
    (link,) = load_experiment(folder / "experiment.toml").rig.links
    assert (link.bending_stiffness, link.width, link.youngs_modulus) == (1.4, 0.03, 7e10)


@pytest.mark.parametrize(("option", "value"), [("--thickness", 0.0015), ("--width", 0.035), ("--youngs-modulus", 2e11)])
def test_half_a_section_leaves_the_rest_open(
    folder: Path, capsys: pytest.CaptureFixture[str], option: str, value: float
) -> None:
    run(capsys, "init", folder, option, value)
    (link,) = tomllib.loads((folder / "experiment.toml").read_text())["link"]
    key = option[2:].replace("-", "_")
    keys = {"width", "thickness", "youngs_modulus"}
    assert {each: link[each] for each in keys} == {**dict.fromkeys(keys, "?"), key: value}
    assert "bending_stiffness" not in link


def test_markers_beyond_the_link_are_no_guess(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = run(capsys, "init", folder, "--length", "0.5", *RIG[2:])
    assert status == 2
    assert "key 'markers': item 1 is '?'" in err
    assert "distances from the camera's origin do not fit" in (folder / "experiment.toml").read_text()


def test_a_marker_at_the_tip_is_not_rounded_beyond_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "init", folder, "--length", "0.9996", *RIG[2:], "-q") == (0, "", "")
    assert load_experiment(folder / "experiment.toml").rig.links[0].markers[-1] == 0.9996


def test_a_joint_that_is_clamped_has_no_motor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its angle and torque are left out, whatever the file calls them."""
    hub_file(tmp_path / "a.csv", 0.2)
    rig = ["--length", "0.5", "--mass", "0.2", "--bending-stiffness", "3", "--joint", "clamped"]
    run(capsys, "init", tmp_path, *rig, "-q")
    experiment = load_experiment(tmp_path / "experiment.toml")
    assert experiment.unused_columns == ("Frame", "Motor angle (deg)", "Torque")
    assert experiment.recordings[0].kind == "decay"
    table = pd.read_csv(DEMO / "first_mode.csv").assign(**{"beam.theta": 0.0, "beam.tau": 0.1})
    table.to_csv(tmp_path / "standard.csv", index=False)
    (tmp_path / "experiment.toml").unlink()
    run(capsys, "init", tmp_path, *RIG, "--joint", "clamped", "--csv", tmp_path / "standard.csv", "-q")
    assert load_experiment(tmp_path / "experiment.toml").unused_columns == ("beam.theta", "beam.tau")


def test_a_torque_without_an_angle_belongs_to_a_joint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pd.read_csv(DEMO / "first_mode.csv").assign(Torque=0.1).to_csv(tmp_path / "a.csv", index=False)
    status, _, err = run(capsys, "init", tmp_path, *RIG)
    assert status == 2
    assert "column 'beam.theta': the column is missing; expected the angle of the active joint" in err
    assert not (tmp_path / "experiment.toml").exists()


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda text: text, ["--joint", "revolute"], "column 'beam.theta': the column is missing"),
        (lambda text: text.replace("beam.m1.x", "t", 1), [], "column 't': the column occurs twice"),
        (lambda text: text.replace("beam.m1.x", "beam.m1.y", 1), [], "column 'beam.m1.y': the column occurs twice"),
        (lambda text: text.replace("0.2,", "much,", 1), [], "'much' is not a number"),
    ],
)
def test_columns_that_the_check_would_refuse_are_refused_before_anything_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str], change: Callable[[str], str], options: list[str], message: str
) -> None:
    file = folder / "first_mode.csv"
    text = change(file.read_text())
    if "much" in message:
        text = text.rstrip("\n").rpartition("\n")[0] + "\n" + ",".join(["9e9", "much"] + ["0"] * 9) + "\n"
    file.write_text(text)
    status, out, err = run(capsys, "init", folder, *RIG, *options)
    assert (status, out) == (2, "")
    assert f"{folder}/" in err
    assert message in err
    assert not (folder / "experiment.toml").exists()


@pytest.mark.parametrize(("joint", "missing"), [("clamped", ["t"]), ("revolute", ["t", "beam.theta"])])
def test_columns_that_may_be_those_that_are_needed_are_left_open(
    folder: Path, capsys: pytest.CaptureFixture[str], joint: str, missing: list[str]
) -> None:
    renamed = {"t": "Moment", "beam.m5.y": "Winkel"}
    for file in folder.glob("*.csv"):
        pd.read_csv(file).drop(columns="beam.m5.x").rename(columns=renamed).to_csv(file, index=False)
    status, out, err = run(capsys, "init", folder, *RIG, "--joint", joint)
    assert status == 2
    assert f"Fill in {', '.join(missing)}, and correct" in out
    assert err.endswith("[columns], key 't': got '?'; expected the name of a column, a string\n")
    file = folder / "experiment.toml"
    text = file.read_text()
    assert tomllib.loads(text)["columns"] == dict.fromkeys(missing, "?")
    for header in renamed.values():
        text = text.replace('= "?"', f'= "{header}"', 1)
    file.write_text(text)
    assert load_experiment(file).recordings


def test_the_joint_that_is_given_is_the_first_links(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time = 0.01 * np.arange(200)
    columns = {"t": time, "beam.theta": np.sin(time), "tip.theta": np.cos(time)}
    columns |= {f"{link}.m1.{axis}": np.sin(time) for link in ("beam", "tip") for axis in "xy"}
    pd.DataFrame(columns).to_csv(tmp_path / "a.csv", index=False)
    run(capsys, "init", tmp_path, "--joint", "clamped")
    rig = tomllib.loads((tmp_path / "experiment.toml").read_text())
    assert [link["joint"] for link in rig["link"]] == ["clamped", "revolute"]


def test_a_recording_is_named_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = folder / "first_mode.csv"
    status, _, err = run(capsys, "init", folder, *RIG, "--csv", file, file)
    assert status == 2
    assert "the same file is recording[1], of role 'train'" in err
    assert not (folder / "experiment.toml").exists()


def test_a_folder_may_be_a_link(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "far" / "away").mkdir(parents=True)
    (folder / "near").symlink_to(folder / "far" / "away")
    file = folder / "first_mode.csv"
    assert run(capsys, "init", folder / "near", *RIG, "--csv", file, "-q") == (0, "", "")
    assert load_experiment(folder / "near" / "experiment.toml").recordings[0].file == "../../first_mode.csv"


def test_it_overwrites_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "experiment.toml").write_text("mine")
    status, out, err = run(capsys, "init", folder, *RIG)
    assert (status, out) == (2, "")
    assert "experiment.toml: it exists already, and is left as it is; choose another folder" in err
    assert (folder / "experiment.toml").read_text() == "mine"


def test_folders_and_files_that_will_not_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no such folder" in run(capsys, "init", tmp_path / "none")[2]
    assert "there is no CSV file in it" in run(capsys, "init", tmp_path)[2]
    (tmp_path / "a.csv").write_text("t,force\n0,1\n1,2\n")
    err = run(capsys, "init", tmp_path)[2]
    assert "a.csv: row 1: no column looks like a marker's coordinate; expected names such as beam.m1.x and" in err
    assert "Marker1_Y; for others write [columns] by hand" in err
    (tmp_path / "a.csv").write_text("name\nx\n")
    assert "no column of numbers" in run(capsys, "init", tmp_path)[2]
    (tmp_path / "a.csv").unlink()
    os.mkfifo(tmp_path / "a.csv")
    assert "a.csv: cannot be read (this is a pipe or a device, not a file)" in run(capsys, "init", tmp_path)[2]
    assert not (tmp_path / "experiment.toml").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty; expected a header line and rows of numbers"),
        (b"\xef\xbb\xbf \n\n", "the file is empty"),
        (b"t,M1 X,M1 Y\n", "no row follows the header"),
        (b"t,M1 X,M1 Y\n0,1,2\n1,2,3,4\n", "row 3: 4 cells; expected 3 cells, as in the header"),
        (b't,M1 X,M1 Y\n0,1,"2\n', "row 2: cannot be read (unexpected end of data)"),
        (b"t,M1 X,M1 Y\n\xff,1,2\n", "row 2: byte 0xff is not UTF-8"),
    ],
)
def test_what_is_no_csv_file_is_said_as_check_says_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, message: str
) -> None:
    (tmp_path / "a.csv").write_bytes(content)
    status, out, err = run(capsys, "init", tmp_path)
    assert (status, out) == (2, "")
    assert f"a.csv: {message}" in err
    assert not (tmp_path / "experiment.toml").exists()


def test_columns_of_text_are_left_out(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in folder.glob("*.csv"):
        pd.read_csv(file).assign(Quality="good").to_csv(file, index=False)
    status, out, err = run(capsys, "init", folder, *RIG)
    assert (status, err) == (0, "")
    assert "not used: Quality" in out


def test_names_are_recognized_as_documented(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    time = 0.01 * np.arange(200)
    names = ["Seconds", "Marker1_X", "Marker1_Z", "tip x (mm)", "tip z (mm)", "Encoder 1", "Motor torque", "Angle 2"]
    pd.DataFrame({name: np.sin(time + k) + time for k, name in enumerate(names)}).to_csv(
        tmp_path / "a.csv", index=False
    )
    run(capsys, "init", tmp_path)
    columns = tomllib.loads((tmp_path / "experiment.toml").read_text())["columns"]
    assert list(columns.items()) == [
        *(("t", "Seconds"), ("beam.m1.x", "Marker1_X"), ("beam.m1.z", "Marker1_Z")),
        *(("beam.m2.x", "tip x (mm)"), ("beam.m2.z", "tip z (mm)")),
        *(("beam.theta", "Encoder 1"), ("beam.tau", "Motor torque")),
    ]


def test_names_of_files_and_columns_may_be_odd(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd = folder / "a\x7fb\u2028"
    odd.mkdir()
    columns = pd.read_csv(folder / "first_mode.csv")
    columns.assign(**{"no\x1bise": 1.0}).to_csv(odd / "one\n\x7f.csv", index=False)
    status, out, err = run(capsys, "init", odd, *RIG)
    assert (status, err) == (0, "")
    assert r"a\u007fb\u2028" in out
    assert r"no\u001bise" in out
    assert load_experiment(odd / "experiment.toml").recordings[0].file == "one\n\x7f.csv"


def test_it_asks_on_a_terminal(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = "\n".join(["", "one", "1.0", "0.44", "", "1.93e11", "0.035", "0.0015", "", "", ""]) + "\n"
    monkeypatch.setattr(sys, "stdin", io.StringIO(answers))
    monkeypatch.setattr("vjm.cli.commands.stdin_is_terminal", lambda: True)
    status, _, err = run(capsys, "init", folder)
    assert status == 0, err
    (link,) = load_experiment(folder / "experiment.toml").rig.links
    assert (link.joint, link.length, link.thickness) == ("clamped", 1.0, 0.0015)


def test_files_elsewhere_are_named_from_the_folder(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "described").mkdir()
    files = [folder / "first_mode.csv", folder / "second_mode.csv"]
    assert run(capsys, "init", folder / "described", *RIG, "--csv", *files, "-q") == (0, "", "")
    assert load_experiment(folder / "described" / "experiment.toml").recordings[0].file == "../first_mode.csv"


def test_files_with_semicolons_and_decimal_commas_are_read_like_others(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, "init", folder, *RIG, "-q") == (0, "", "")
    text = (folder / "experiment.toml").read_text()
    (folder / "experiment.toml").unlink()
    for file in folder.glob("*.csv"):
        file.write_text(file.read_text().replace(",", ";").replace("\n0.", "\n0,").replace(".", ","))
        lines = file.read_text().split("\n")
        file.write_text("\n".join([lines[0].replace(",", "."), *lines[1:]]))
    assert run(capsys, "init", folder, *RIG, "-q") == (0, "", "")
    assert (folder / "experiment.toml").read_text() == text


def test_the_command_that_it_names_can_be_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spaced = folder.rename(folder.with_name("arm 1"))
    _, out, _ = run(capsys, "init", spaced, *RIG)
    command = next(line for line in out.splitlines() if line.startswith("$ vjm check"))
    assert shlex.split(command)[3:] == [str(spaced / "experiment.toml")]


def test_an_encoder_belongs_to_the_link_that_it_names(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And not to another whose name its own ends with."""
    time = 0.01 * np.arange(200)
    angle = 0.4 * np.sin(3.0 * time)
    columns = {"t": time, "arm.m1.x": 0.5 + 0 * time, "arm.m1.y": 0.01 * angle, "forearm.theta": angle}
    columns |= {"forearm.m1.x": 0.5 + 0.5 * np.cos(angle), "forearm.m1.y": 0.5 * np.sin(angle)}
    pd.DataFrame(columns).to_csv(tmp_path / "swing.csv", index=False)
    run(capsys, "init", tmp_path)
    rig = tomllib.loads((tmp_path / "experiment.toml").read_text())
    assert {link["name"]: link["joint"] for link in rig["link"]} == {"arm": "clamped", "forearm": "revolute"}
