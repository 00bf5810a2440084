"""Faulty files: one error, of the right type, that says where the fault is and what was expected."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from experiment_files import DRIVEN, FREE, TOML, csv_text, rows, write_experiment

from vjm.errors import ExperimentError, RecordingError, ShapeError
from vjm.experiment.load import load_experiment

LINK, TIP, REC = "link[1] arm", "link[2] tip", "recording[1] drive_1.csv"
ARM_MARKERS = "markers = [0.25, 0.5, 1.0]"

TOML_CASES = [  # old text, new text, table, key, words of the message
    ("schema = 1\n", "", "", "schema", ["missing", "schema = 1"]),
    ("schema = 1", "schema = 2", "", "schema", ["got 2", "schema = 1"]),
    ("schema = 1", "schema = true", "", "schema", ["got True"]),
    ("schema = 1", "schema = 1.0", "", "schema", ["got 1.0"]),
    ('name = "two links"\n', "", "", "name", ["missing"]),
    ('name = "two links"', 'name = ""', "", "name", ["not empty"]),
    ('name = "two links"', 'name = "\\u001b[2J"', "", "name", ["control characters"]),
    ('name = "two links"', '"\\u001b[2J\\n" = 1', "", "\x1b[2J\n", ["key '\\u001b[2J\\n'", "unknown key"]),
    ('name = "two links"', 'nme = "two links"', "", "nme", ["unknown key", "did you mean 'name'", "schema, name"]),
    ("[sensors]", "[sensor]", "", "sensor", ["unknown key", "did you mean 'sensors'"]),
    ("[base]\ngravity = [0.0, -9.81]\n", "", "", "base", ["missing", "m/s^2"]),
    ("gravity = [0.0, -9.81]\n", "", "base", "gravity", ["missing", "two finite numbers"]),
    ("gravity = [0.0, -9.81]", "gravity = [0.0]", "base", "gravity", ["got [0.0]", "two finite numbers"]),
    ("gravity = [0.0, -9.81]", "gravity = [0.0, 0.0, -9.81]", "base", "gravity", ["two finite numbers"]),
    ("gravity = [0.0, -9.81]", "gravity = 9.81", "base", "gravity", ["got 9.81"]),
    ("gravity = [0.0, -9.81]", "gravity = [0.0, nan]", "base", "gravity", ["item 2 is nan"]),
    ("gravity = [0.0, -9.81]", "gravity = [0.0, false]", "base", "gravity", ["item 2 is False"]),
    ('name = "arm"', 'name = "my arm"', "link[1] my arm", "name", ["'my arm'", "letters, digits and underscores"]),
    ('name = "arm"', 'name = "ärm"', "link[1] ärm", "name", ["letters, digits and underscores"]),
    ('name = "arm"', 'name = "arm\\n"', "link[1] arm\n", "name", ["letters, digits and underscores"]),
    ('name = "arm"\n', "", "link[1]", "name", ["missing"]),
    ('name = "tip"', 'name = "arm"', "link[2] arm", "name", ["already the name of link[1]"]),
    ('joint = "revolute"', 'joint = "hinge"', LINK, "joint", ["'hinge'", '"revolute" or "clamped"']),
    ('joint = "revolute"\n', "", LINK, "joint", ["missing", '"revolute" or "clamped"']),
    ("length = 1.0", "length = -1.0", LINK, "length", ["got -1.0", "positive number [m]"]),
    ("length = 1.0", "length = 0", LINK, "length", ["got 0", "positive number [m]"]),
    ("length = 1.0", 'length = "1.0"', LINK, "length", ["got '1.0'"]),
    ("length = 1.0", "length = true", LINK, "length", ["got True"]),
    ("length = 1.0", "length = inf", LINK, "length", ["got inf"]),
    ("length = 1.0", "length = 1e9", LINK, "length", ["got 1000000000.0", "from 1e-9 to 1e6"]),
    ("mass = 0.4", "mass = 4e-301", LINK, "mass", ["got 4e-301", "from 1e-14 to 1e9"]),
    ("hub_inertia = 0.02", "hub_inertia = 2e298", LINK, "hub_inertia", ["at most 1e15"]),
    ("bending_stiffness = 1.5", "bending_stiffness = 1.5e300", TIP, "bending_stiffness", ["from 1e-18 to 1e18"]),
    ("gravity = [0.0, -9.81]", "gravity = [0.0, -9.81e9]", "base", "gravity", ["item 2 is -9810000000.0", "1e8"]),
    ("marker_noise = 0.0005", "marker_noise = 5e-304", "sensors", "marker_noise", ["from 1e-12 to 1e6"]),
    ("length = 1.0", "length = 1979-05-27", LINK, "length", ["positive number [m]"]),
    ("length = 1.0", "lenght = 1.0", LINK, "lenght", ["unknown key", "did you mean 'length'", "1 more fault "]),
    ("mass = 0.4", "mass = 0.0", LINK, "mass", ["positive number [kg]"]),
    ("hub_inertia = 0.02", "hub_inertia = -0.02", LINK, "hub_inertia", ["zero or positive [kg m^2]"]),
    ("payload = 0.05", "payload = 0.05\nhub_inertia = 0.01", TIP, "hub_inertia", ["clamped", "revolute"]),
    ("payload = 0.05", "payload = -0.05", TIP, "payload", ["got -0.05", "zero or positive [kg]"]),
    ("payload = 0.05", "payload_offset = 0.05", TIP, "payload_offset", ["given without a payload"]),
    (
        "payload = 0.05",
        "payload = 0.05\npayload_inertia = -1e-5",
        TIP,
        "payload_inertia",
        ["zero or positive [kg m^2]"],
    ),
    ("payload = 0.1", "payload_inertia = 1e-5", "recording[3] free.csv", "payload_inertia", ["without a payload"]),
    (
        "payload = 0.1",
        'payload = 0.1\npayload_offset = "1 cm"',
        "recording[3] free.csv",
        "payload_offset",
        ["number [m]"],
    ),
    ("width = 0.03\n", "", LINK, "width", ["missing", "either youngs_modulus, width and thickness"]),
    ("bending_stiffness = 1.5\n", "", TIP, "bending_stiffness", ["missing", "either youngs_modulus"]),
    ("bending_stiffness = 1.5", "bending_stiffness = 1.5\nwidth = 0.03", TIP, "width", ["together", "either"]),
    ("bending_stiffness = 1.5", "bending_stiffness = 0", TIP, "bending_stiffness", ["positive number [N m^2]"]),
    ("thickness = 0.002", "thickness = 1e-200", LINK, "thickness", ["got 1e-200", "from 1e-9 to 1e6"]),
    ("thickness = 0.002", "thickness = 2e6", LINK, "thickness", ["got 2000000.0", "from 1e-9 to 1e6"]),
    ("thickness = 0.002", "thickness = 1e-9", LINK, "youngs_modulus", ["comes out as 1.75e-19", "1e-18 to"]),
    (ARM_MARKERS, "markers = [0.25, 0.5, 1.2]", LINK, "markers", ["item 3 is 1.2", "beyond the link", "1 m"]),
    (ARM_MARKERS, "markers = [0.5, 0.25, 1.0]", LINK, "markers", ["item 2 is 0.25", "strictly increasing"]),
    (ARM_MARKERS, "markers = [0.5, 0.5, 1.0]", LINK, "markers", ["strictly increasing"]),
    (ARM_MARKERS, "markers = [0.0, 0.5, 1.0]", LINK, "markers", ["item 1 is 0.0", "positive"]),
    (ARM_MARKERS, 'markers = [0.25, "a"]', LINK, "markers", ["item 2 is 'a'"]),
    (ARM_MARKERS + "\n", "", LINK, "markers", ["missing"]),
    ('markers_frame = "link"', 'markers_frame = "tip"', TIP, "markers_frame", ['"base" or "link"']),
    ("virtual_joints = 3", "virtual_joints = 0", TIP, "virtual_joints", ["from 1 to 60"]),
    ("virtual_joints = 3", "virtual_joints = 61", TIP, "virtual_joints", ["from 1 to 60"]),
    ("virtual_joints = 3", "virtual_joints = 3.0", TIP, "virtual_joints", ["whole number"]),
    ("virtual_joints = 3", "virtual_joints = true", TIP, "virtual_joints", ["whole number"]),
    ("marker_noise = 0.0005", "marker_noise = 0", "sensors", "marker_noise", ["positive number [m]"]),
    ("marker_noise = 0.0005", "encoder_noise = -1", "sensors", "encoder_noise", ["positive number [rad]"]),
    ("marker_noise = 0.0005", "markers_noise = 1", "sensors", "markers_noise", ["did you mean 'marker_noise'"]),
    ('file = "drive_1.csv"', 'file = "none.csv"', "recording[1] none.csv", "file", ["no file", "relative"]),
    ('file = "drive_1.csv"', 'file = "."', "recording[1] .", "file", ["directory"]),
    ('file = "drive_1.csv"', 'file = ""', "recording[1]", "file", ["CSV file"]),
    ('file = "drive_1.csv"', 'file = "a\\u0000b"', "recording[1] a\0b", "file", ["CSV file"]),
    ('file = "drive_1.csv"', f'file = "{"x" * 5000}"', f"recording[1] {'x' * 5000}", "file", ["CSV file"]),
    ('file = "drive_1.csv"', 'file = "drive_2.csv"', "recording[2] drive_2.csv", "file", ["same file", "holdout"]),
    ('kind = "driven"', 'kind = "drive"', REC, "kind", ["'drive'", '"driven", "decay", "static" or "quiet"']),
    ('role = "train"\n', "", REC, "role", ["missing", '"train" or "holdout"']),
    ('role = "train"', 'role = "test"', REC, "role", ["'test'"]),
    ('repeat = "drive"', 'repeats = "drive"', REC, "repeats", ["did you mean 'repeat'"]),
    ('repeat = "drive"', "repeat = 1", REC, "repeat", ["label"]),
    ("payload = 0.1", "payload = -0.1", "recording[3] free.csv", "payload", ["zero or positive"]),
    ("gravity = [0, 0]", 'repeat = "drive"', "recording[3] free.csv", "kind", ["'decay'", REC, "'driven'"]),
    ('repeat = "drive"', 'repeat = "drive"\npayload = 1', "recording[2] drive_2.csv", "payload", ["0.0", "1.0"]),
    ('repeat = "drive"', 'repeat = "drive"\ngravity = [1, 0]', "recording[2] drive_2.csv", "gravity", ["(1.0, 0.0)"]),
    ("schema = 1", "schema = ", "", "", ["not valid TOML", "line 1"]),
    ('name = "tip"', "name = tip", "", "", ["not valid TOML", "line 19"]),
    ('name = "tip"', 'name = "tip"\nname = "tip"', "", "", ["not valid TOML", "line 20"]),
    ("schema = 1", "schema = " + "[" * 5000, "", "", ["nested too deeply"]),
    ("mass = 0.4", "mass = 1" + "0" * 5000, "", "", ["not valid TOML"]),
    ("mass = 0.4", "mass = 0x1" + "0" * 5000, LINK, "mass", ["positive number [kg]"]),
    ("two links", "two \udcff links", "", "", ["line 2 is not UTF-8"]),
]


@pytest.mark.parametrize(("old", "new", "table", "key", "words"), TOML_CASES, ids=range(len(TOML_CASES)))
def test_experiment_file_is_refused(tmp_path: Path, old: str, new: str, table: str, key: str, words: list[str]) -> None:
    assert old in TOML
    file = write_experiment(tmp_path, TOML.replace(old, new, 1))
    with pytest.raises(ExperimentError) as caught:
        load_experiment(file)
    assert (caught.value.file, caught.value.table, caught.value.key) == (file, table, key)
    assert caught.value.expected
    for word in [str(file), *words]:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("toml", "key", "words"),
    [
        ("", "schema", ["missing", "4 more faults"]),
        (TOML[: TOML.index("[[link]]")] + TOML[TOML.index("[sensors]") :], "link", ["missing", "[[link]]"]),
        (TOML[: TOML.index("[[recording]]")], "recording", ["missing", "[[recording]]"]),
        ("recording = []\n" + TOML[: TOML.index("[[recording]]")], "recording", ["got []", "[[recording]]"]),
        ('link = 3\nschema = 1\nname = "a"\nbase.gravity = [0, 0]\n', "link", ["got 3", "[[link]]"]),
    ],
)
def test_whole_tables_are_refused(tmp_path: Path, toml: str, key: str, words: list[str]) -> None:
    file = write_experiment(tmp_path, toml)
    with pytest.raises(ExperimentError) as caught:
        load_experiment(file)
    assert (caught.value.table, caught.value.key) == ("", key)
    for word in words:
        assert word in str(caught.value)


def test_an_item_that_is_no_table(tmp_path: Path) -> None:
    file = write_experiment(tmp_path, 'schema = 1\nname = "a"\nlink = [4]\nbase.gravity = [0, 0]\nrecording = [4]\n')
    with pytest.raises(ExperimentError, match=r"\[link\[1\]\]: got 4 .*expected a table"):
        load_experiment(file)


def test_no_marker_on_any_link(tmp_path: Path) -> None:
    toml = TOML.replace(ARM_MARKERS, "markers = []").replace("markers = [0.2, 0.5]", "markers = []")
    with pytest.raises(ExperimentError, match="no link has a marker") as caught:
        load_experiment(write_experiment(tmp_path, toml))
    assert caught.value.key == "markers"


def test_experiment_file_that_is_absent_or_a_directory(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match="no such file"):
        load_experiment(tmp_path / "none.toml")
    with pytest.raises(ExperimentError, match="directory"):
        load_experiment(tmp_path)
    for nothing in ("a\0b", ""):
        with pytest.raises(ShapeError, match=r"path: got .*; expected the path of an experiment file"):
            load_experiment(nothing)


def cell(row: int, column: str, value: str) -> Callable[[list[str], list[list[str]]], str]:
    """A recording with one cell replaced; `row` counts the file's lines from 1."""

    def change(columns: list[str], cells: list[list[str]]) -> str:
        cells[row - 2][columns.index(column)] = value
        return csv_text(columns, cells)

    return change


def header(old: str, new: str) -> Callable[[list[str], list[list[str]]], str]:
    return lambda columns, cells: csv_text([new if name == old else name for name in columns], cells)


def without(*names: str) -> Callable[[list[str], list[list[str]]], str]:
    def change(columns: list[str], cells: list[list[str]]) -> str:
        kept = [index for index, name in enumerate(columns) if name not in names]
        return csv_text([columns[i] for i in kept], [[line[i] for i in kept] for line in cells])

    return change


def text(change: Callable[[str], str]) -> Callable[[list[str], list[list[str]]], str]:
    return lambda columns, cells: change(csv_text(columns, cells))


def european(table: str) -> str:
    """A table as a spreadsheet writes it where commas separate decimals."""
    header, _, body = table.partition("\n")
    return header.replace(",", ";") + "\n" + body.replace(",", ";").replace(".", ",")


def emptied(column: str) -> Callable[[list[str], list[list[str]]], str]:
    def change(columns: list[str], cells: list[list[str]]) -> str:
        return csv_text(columns, [[("" if n == column else c) for n, c in zip(columns, x, strict=True)] for x in cells])

    return change


def scaled_time(factor: float) -> Callable[[list[str], list[list[str]]], str]:
    return lambda columns, cells: csv_text(columns, [[repr(factor * float(t)), *rest] for t, *rest in cells])


ARM_COLUMNS = ["arm.m1.x", "arm.m1.y", "arm.m2.x", "arm.m2.y", "arm.m3.x", "arm.m3.y"]
FIRST_CELL = rows(DRIVEN)[0][0]

CSV_CASES: list[tuple[Callable[[list[str], list[list[str]]], str], int | None, str | None, list[str]]] = [
    (cell(7, "arm.tau", "abc"), 7, "arm.tau", ["'abc' is not a number", "finite number, or an empty cell"]),
    (cell(7, "arm.tau", "nan"), 7, "arm.tau", ["'nan' is not a number"]),
    (cell(7, "arm.tau", "NA"), 7, "arm.tau", ["'NA' is not a number"]),
    (cell(7, "arm.tau", "None"), 7, "arm.tau", ["not a number"]),
    (cell(41, "tip.m2.y", "inf"), 41, "tip.m2.y", ["infinite value, 'inf'"]),
    (cell(3, "arm.theta", "-Infinity"), 3, "arm.theta", ["infinite"]),
    (cell(3, "arm.theta", "1e999"), 3, "arm.theta", ["infinite"]),
    (cell(3, "arm.theta", "1_000"), 3, "arm.theta", ["not a number"]),
    (cell(3, "arm.theta", "0x10"), 3, "arm.theta", ["not a number"]),
    (cell(3, "arm.theta", "1 2"), 3, "arm.theta", ["not a number"]),
    (cell(3, "arm.theta", "٣"), 3, "arm.theta", ["not a number"]),
    (cell(3, "arm.theta", "1-2"), 3, "arm.theta", ["not a number"]),
    (cell(3, "arm.theta", '"1"2'), 3, None, ["cannot be read"]),
    (cell(41, "tip.m2.y", '"1'), 41, None, ["cannot be read"]),
    (cell(9, "t", ""), 9, "t", ["time is missing"]),
    (cell(9, "t", "0.05"), 9, "t", ["does not increase", "0.05 after 0.06"]),
    (cell(9, "t", "0.06"), 9, "t", ["does not increase", "0.06 after 0.06"]),
    (text(lambda x: x.replace("\n", "\n\n", 3).replace("0.09,", "0.01,")), 14, "t", ["does not increase"]),
    (text(lambda x: x.replace("\n0.03,", "\n0.03,0,")), 5, None, ["12 cells", "11 cells, as in the header"]),
    (text(lambda x: x.replace("\n0.03,", "\n")), 5, None, ["10 cells"]),
    (text(lambda x: x.replace(f"\n{FIRST_CELL},", f"\n{FIRST_CELL},0,")), 2, None, ["12 cells"]),
    (text(lambda x: x + "0.5\n"), 42, None, ["1 cell;"]),
    (text(lambda x: x.replace("\n", ",\n").replace(",\n", "\n", 1)), 2, None, ["12 cells"]),
    (text(lambda x: x.replace("\n", ",\n")), 1, "", ["without a name", "names in [columns]"]),
    (text(lambda x: x.replace(",", ";", 3)), 1, "t;arm.theta;arm.tau;arm.m1.x", ["unknown column"]),
    (text(lambda x: x.replace(",", ";").replace(";", "\t", 3)), 1, None, ["semicolons and tabs", "one of them"]),
    (text(lambda x: x.replace(",", ";").replace("\n0.03;", "\n0,03;")), 2, "t", ["'0.0' is not a", "decimal comma"]),
    (text(lambda x: x.replace(",", ";").replace("\n0.03;", "\n0.03,")), 2, "t", ["'0.0' is not a", "decimal comma"]),
    (text(lambda x: x.replace(",", ";").replace("\n0.03;", "\n1,000.03;")), 2, "t", ["'0.0' is not", "decimal comma"]),
    (text(lambda x: european(x).replace("\n0,03;", "\n1.000,03;")), 5, "t", ["'1.000,03' is not a", "decimal comma"]),
    (text(lambda x: european(x).replace("\n0,03;", "\n0,0,3;")), 5, "t", ["'0,0,3' is not a number"]),
    (text(lambda x: european(x).replace("\n0,03;", "\n0,03,")), 5, None, ["10 cells", "11 cells, as in the header"]),
    (text(lambda x: x.replace(",", "\t").replace("\n0.03\t", "\n0.03,")), 2, "t", ["decimal comma"]),
    (text(lambda x: ""), None, None, ["empty", "header"]),
    (text(lambda x: " \n\n"), None, None, ["empty"]),
    (text(lambda x: x[: x.index("\n") + 1]), None, None, ["no row follows"]),
    (text(lambda x: x[: x.index("\n") + 1] + '""\n'), None, None, ["no row follows"]),
    (text(lambda x: x[x.index("\n") + 1 :]), 1, FIRST_CELL, ["unknown column", "t, arm.theta"]),
    (text(lambda x: "# by hand\n" + x), 1, "# by hand", ["unknown", ", or the file's own names in [columns]"]),
    (text(lambda x: x.replace("0.03", "0.03\udce9", 1)), 5, None, ["byte 0xe9 is not UTF-8"]),
    (text(lambda x: x.replace("\n0.03", "\n0.03\0", 1)), 5, None, ["NUL"]),
    (header("arm.tau", "arm.torque"), 1, "arm.torque", ["unknown column", "did you mean", "arm.mK.x"]),
    (header("arm.tau", "Arm.tau"), 1, "Arm.tau", ["no link 'Arm'", "did you mean 'arm.tau'"]),
    (header("arm.tau", "tip.tau"), 1, "tip.tau", ["unknown column", "clamped", "no active joint"]),
    (header("arm.tau", "tip.theta"), 1, "tip.theta", ["clamped"]),
    (header("arm.m3.x", "arm.m4.x"), 1, "arm.m4.x", ["has 3 markers", "K = 1..3"]),
    (header("arm.m3.x", "arm.m0.x"), 1, "arm.m0.x", ["unknown column"]),
    (header("arm.m3.x", "arm.m3.z"), 1, "arm.m3.z", ["unknown column"]),
    (header("arm.m3.x", "arm.m03.x"), 1, "arm.m03.x", ["unknown column"]),
    (header("arm.tau", "arm.theta"), 1, "arm.theta", ["twice"]),
    (header("arm.tau", "comment"), 1, "comment", ["unknown column"]),
    (without("t"), 1, "t", ["missing", "time of each row [s], or the file's name for it in [columns]"]),
    (without("arm.theta"), 1, "arm.theta", ["missing", "angle"]),
    (without("arm.tau"), 1, "arm.tau", ["missing", "torque"]),
    (without("arm.m2.x"), 1, "arm.m2.x", ["missing", "base frame"]),
    (without("arm.m2.y"), 1, "arm.m2.y", ["missing", "x and y"]),
    (without("tip.m1.y", "tip.m2.y"), 1, "tip.m1.y", ["missing", "at least one marker of link 'tip'"]),
    (header("tip.m2.y", "tip.m2.x"), 1, "tip.m2.y", ["missing"]),
    (emptied("arm.theta"), None, "arm.theta", ["every cell is empty"]),
    (emptied("arm.tau"), None, "arm.tau", ["every cell is empty"]),
    (lambda columns, cells: csv_text(columns, cells[:18]), None, None, ["9 usable frames", "at least 10"]),
    (cell(41, "t", "1e9"), 41, "t", ["1e+09 s after the row before", "every 0.02 s", "split"]),
    (cell(41, "t", "1e300"), 41, "t", ["1e+300 s is beyond any arm"]),
    (cell(3, "t", "1e-13"), 3, "t", ["1e-13 s after the sensor's measurement before"]),
    (scaled_time(1e12), None, "t", ["3.9e+11 s from the first row to the last", "at most 1e+10 s"]),
    (cell(4, "arm.theta", "-1e300"), 4, "arm.theta", ["-1e+300 rad is beyond any arm"]),
    (cell(4, "arm.tau", "1e300"), 4, "arm.tau", ["1e+300 N m is beyond any arm"]),
    (cell(4, "arm.m2.x", "1e300"), 4, "arm.m2.x", ["1e+300 m is beyond any arm"]),
    (header("arm.tau", "\x1b[31m\u202e"), 1, "\x1b[31m\u202e", ["column '\\u001b[31m\\u202e'"]),
]  # fmt: skip


@pytest.mark.parametrize(("change", "row", "column", "words"), CSV_CASES, ids=range(len(CSV_CASES)))
def test_recording_is_refused(
    tmp_path: Path,
    change: Callable[[list[str], list[list[str]]], str],
    row: int | None,
    column: str | None,
    words: list[str],
) -> None:
    file = write_experiment(tmp_path, drive_1=change(list(DRIVEN), rows(DRIVEN)))
    with pytest.raises(RecordingError) as caught:
        load_experiment(file)
    assert (caught.value.file, caught.value.row, caught.value.column) == (tmp_path / "drive_1.csv", row, column)
    assert caught.value.expected
    for word in [str(tmp_path / "drive_1.csv"), *([f"row {row}"] if row else []), *words]:
        assert word in str(caught.value)


def test_a_usable_base_frame_marker_has_both_coordinates(tmp_path: Path) -> None:
    cells = rows(FREE)
    for line in cells:
        line[FREE.index("arm.m1.y")] = ""
        for name in ("arm.m2.x", "arm.m3.x", "tip.m1.y", "tip.m2.y"):
            line[FREE.index(name)] = ""
    with pytest.raises(RecordingError, match="0 usable frames"):
        load_experiment(write_experiment(tmp_path, free=csv_text(FREE, cells)))
