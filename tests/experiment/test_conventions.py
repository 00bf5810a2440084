"""Recordings in other units, another frame, under other names and in two files: they become the same experiment."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from experiment_files import DRIVEN, FREE, TOML, csv_text, rows, write_experiment
from hypothesis import given, settings
from hypothesis import strategies as st

from vjm.errors import ExperimentError, RecordingError
from vjm.experiment.conventions import FACTORS, Camera
from vjm.experiment.load import load_experiment
from vjm.records import Experiment

BASE = [name for name in DRIVEN if name.startswith("arm.m")]  # in the camera's frame; the tip's are in its link's


def table_of(columns: list[str], seed: int) -> dict[str, np.ndarray]:
    cells = [[float(cell) if cell else np.nan for cell in line] for line in rows(columns, seed=seed)]
    return dict(zip(columns, np.array(cells).T, strict=True))


def text_of(table: dict[str, np.ndarray]) -> str:
    cells = [["" if np.isnan(x) else repr(float(x)) for x in line] for line in zip(*table.values(), strict=True)]
    return csv_text(list(table), cells)


def as_filmed(table: dict[str, np.ndarray], units: dict[str, str], camera: Camera) -> dict[str, np.ndarray]:
    """The table as a camera in this pose would write it, in these units: the inverse, written another way."""
    turn = np.exp(-1j * camera.rotation)
    seen = {}
    for name, values in table.items():
        quantity = {"t": "time", "theta": "angle", "tau": "torque"}.get(name.split(".")[-1], "length")
        factor = FACTORS[quantity][units[quantity]]
        if name not in BASE:
            seen[name] = values / factor
        elif name.endswith(".x"):
            place = (values + 1j * table[f"{name[:-1]}y"] - complex(*camera.origin)) * turn
            for axis, value in zip(camera.axes, (place.real, place.imag), strict=True):
                seen[f"{name[:-1]}{axis[-1]}"] = (-value if axis[0] == "-" else value) / factor
    return seen


def in_two(table: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What the camera and what the motors measured, each at its own instants."""
    motors = {name: values for name, values in table.items() if name == "t" or name.endswith(("theta", "tau"))}
    frames = {name: values for name, values in table.items() if name == "t" or name not in motors}
    filmed = np.any([np.isfinite(values) for name, values in frames.items() if name != "t"], axis=0)
    return {name: values[filmed] for name, values in frames.items()}, motors


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    letters = draw(st.permutations("xyz"))[:2]
    signs = draw(st.lists(st.sampled_from(["", "-"]), min_size=2, max_size=2))
    origin = draw(st.tuples(st.floats(-2, 2), st.floats(-2, 2)))
    rotation = draw(st.one_of(st.just(0.0), st.floats(-4, 4)))
    return Camera(origin, rotation, tuple(sign + letter for sign, letter in zip(signs, letters, strict=True)))


@settings(max_examples=60, deadline=None)
@given(
    camera=cameras(),
    units=st.fixed_dictionaries({key: st.sampled_from(list(names)) for key, names in FACTORS.items()}),
    renamed=st.booleans(),
    two_files=st.booleans(),
)
def test_what_was_filmed_elsewhere_comes_back(
    camera: Camera, units: dict[str, str], renamed: bool, two_files: bool
) -> None:
    plain = {seed: table_of(columns, seed) for seed, columns in enumerate((DRIVEN, DRIVEN, FREE))}
    seen = {seed: as_filmed(table, units, camera) for seed, table in plain.items()}
    names = {name: f"Column {k}, own" for k, name in enumerate(seen[0])} if renamed else {}
    header = "".join(f'{key} = "{unit}"\n' for key, unit in units.items())
    toml = TOML + f"[units]\n{header}[camera]\norigin = {list(camera.origin)}\nrotation = {camera.rotation}\n"
    toml += f"axes = {list(camera.axes)}\n".replace("'", '"')
    toml += "[columns]\n" + "".join(f'"{ours}" = "{theirs}"\n' for ours, theirs in names.items())
    with tempfile.TemporaryDirectory() as folder:
        texts = {}
        for seed, file in enumerate(("drive_1", "drive_2", "free")):
            named = {f'"{names[name]}"' if renamed else name: values for name, values in seen[seed].items()}
            texts[file] = text_of(named)
            if two_files:
                frames, motors = in_two(seen[seed])
                for label, table in ((file, frames), (f"{file}_motors", motors)):
                    named = {f'"{names[name]}"' if renamed else name: values for name, values in table.items()}
                    (Path(folder) / f"{label}.csv").write_text(text_of(named))
                    texts[label] = text_of(named)
                toml = toml.replace(f'file = "{file}.csv"', f'file = "{file}.csv"\nmotors_file = "{file}_motors.csv"')
        read = load_experiment(write_experiment(Path(folder), toml, **texts))
        (Path(folder) / "plain").mkdir()
        expected = load_experiment(write_experiment(Path(folder) / "plain"))
    assert read.rig == expected.rig
    for one, other in zip(read.recordings, expected.recordings, strict=True):
        np.testing.assert_allclose(one.time, other.time, rtol=1e-14)
        for key in ("markers", "theta", "tau"):
            np.testing.assert_allclose(getattr(one, key), getattr(other, key), rtol=1e-13, atol=1e-14)


def test_defaults_change_no_bit(tmp_path: Path) -> None:
    toml = TOML + '[units]\nlength = "m"\n[camera]\naxes = ["x", "y"]\n'
    (tmp_path / "plain").mkdir()
    plain = load_experiment(write_experiment(tmp_path / "plain"))
    assert load_experiment(write_experiment(tmp_path, toml)).recordings == plain.recordings


def test_bare_dotted_names_do_as_well(tmp_path: Path) -> None:
    text = csv_text(DRIVEN, rows(DRIVEN)).replace("arm.m1.x", "Elbow X", 1)
    toml = TOML + '[columns]\narm.m1.x = "Elbow X"\n'
    assert load_experiment(write_experiment(tmp_path, toml, drive_1=text)).unused_columns == ()


def test_columns_that_nothing_names_are_left_out_and_said(tmp_path: Path) -> None:
    columns = [*DRIVEN, "Frame", "Quality"]
    cells = [[*line, str(number), "good"] for number, line in enumerate(rows(DRIVEN))]
    toml = TOML + '[columns]\nt = "t"\n'
    experiment = load_experiment(write_experiment(tmp_path, toml, drive_1=csv_text(columns, cells)))
    (warning,) = experiment.warnings
    assert warning == "columns that nothing names are not used: Frame, Quality"
    np.testing.assert_array_equal(experiment.recordings[0].tau, [[float(line[2])] for line in rows(DRIVEN)])
    with pytest.raises(RecordingError, match="'Frame': unknown column"):
        load_experiment(write_experiment(tmp_path, TOML, drive_1=csv_text(columns, cells)))


def test_instants_that_differ_by_rounding_share_a_row(tmp_path: Path) -> None:
    frames, motors = in_two(table_of(DRIVEN, 0))
    motors["t"] = motors["t"] + 1e-9
    motors = {name: np.delete(values, 4) for name, values in motors.items()}
    (tmp_path / "motors.csv").write_text(text_of(motors))
    toml = TOML.replace('file = "drive_1.csv"', 'file = "drive_1.csv"\nmotors_file = "motors.csv"')
    drive = load_experiment(write_experiment(tmp_path, toml, drive_1=text_of(frames))).recordings[0]
    assert drive.time.size == 40
    assert np.flatnonzero(np.isnan(drive.theta[:, 0])).tolist() == [4]
    assert drive.frames.tolist() == list(range(0, 40, 2))


CAMERA = "[camera]\n"
TABLES = [  # what is appended to the file, table, key, words of the message
    ('[units]\nlength = "inch"\n', "units", "length", ["'inch'", '"m", "mm", "cm" or "in"']),
    ('[units]\nangle = "degrees"\n', "units", "angle", ['"rad" or "deg"']),
    ('[units]\ntime = "min"\n', "units", "time", ['"s", "ms" or "us"']),
    ('[units]\ntorque = "Nm"\n', "units", "torque", ['"N m" or "N mm"']),
    ('[units]\nmass = "g"\n', "units", "mass", ["unknown key", "length, angle, time, torque"]),
    ("[unit]\n", "", "unit", ["did you mean 'units'"]),
    (CAMERA + "origin = [1.0]\n", "camera", "origin", ["got [1.0]", "two finite numbers"]),
    (CAMERA + "rotation = true\n", "camera", "rotation", ["got True", "radians"]),
    (CAMERA + "rotation = inf\n", "camera", "rotation", ["an angle in radians"]),
    (CAMERA + "rotation = 90\n", "camera", "rotation", ["got 90", "an angle in radians, at most 2 pi = 6.28"]),
    (CAMERA + 'axes = ["x", "w"]\n', "camera", "axes", ["item 2 is 'w'", '["x", "-z"]']),
    (CAMERA + 'axes = ["y", "-y"]\n', "camera", "axes", ["both are the column y", '["y", "x"]']),
    (CAMERA + "shift = 1\n", "camera", "shift", ["unknown key", "origin, rotation, axes"]),
    ("[columns]\ntime = 'a'\n", "columns", "time", ["unknown column", "arm.theta"]),
    ("[columns]\n'arm.m4.x' = 'a'\n", "columns", "arm.m4.x", ["unknown column, did you mean"]),
    ("[columns]\n'arm.m1.x' = 3\n", "columns", "arm.m1.x", ["got 3", "a string"]),
    ("[columns]\n'arm.m1.x' = ''\n", "columns", "arm.m1.x", ["got ''"]),
    ("[columns]\nt = 'a'\n'arm.m1.x' = 'a'\n", "columns", "arm.m1.x", ["already 't'"]),
    ("columns = 3\n", "", "columns", ["got 3", "[columns]"]),
]


@pytest.mark.parametrize(("text", "table", "key", "words"), TABLES, ids=range(len(TABLES)))
def test_faulty_tables_are_refused(tmp_path: Path, text: str, table: str, key: str, words: list[str]) -> None:
    file = write_experiment(tmp_path, text + TOML if text.startswith("columns") else TOML + text)
    with pytest.raises(ExperimentError) as caught:
        load_experiment(file)
    assert (caught.value.file, caught.value.table, caught.value.key) == (file, table, key)
    for word in [str(file), *words]:
        assert word in str(caught.value)


def test_a_name_that_no_file_has(tmp_path: Path) -> None:
    toml = TOML + '[columns]\n"tip.m1.x" = "arm.m1.xx"\n'
    with pytest.raises(ExperimentError, match=r"no recording has a column 'arm.m1.xx', did you mean 'arm.m1.x'"):
        load_experiment(write_experiment(tmp_path, toml))


def test_a_name_that_no_file_has_beside_the_documentations_own(tmp_path: Path) -> None:
    """It does nothing: the files call the column as the documentation does."""
    with pytest.raises(ExperimentError) as caught:
        load_experiment(write_experiment(tmp_path, TOML + '[columns]\n"arm.m1.x" = "Elbow X"\n'))
    assert (caught.value.table, caught.value.key) == ("columns", "arm.m1.x")
    expected = (
        "no recording has a column 'Elbow X'; expected one of the files' columns: t, arm.theta, arm.tau, arm.m1.x"
    )
    assert expected in str(caught.value)


def test_a_name_that_its_file_has_not(tmp_path: Path) -> None:
    text = csv_text(DRIVEN, rows(DRIVEN)).replace("arm.m1.x", "Elbow X", 1).replace("arm.m1.y", "Elbow Y", 1)
    toml = TOML + '[columns]\n"arm.m1.x" = "Elbov X"\n"arm.m1.y" = "Elbow Y"\n'
    with pytest.raises(
        RecordingError, match=r"'Elbov X': the column is missing, did you mean 'Elbow X'\?; expected both"
    ):
        load_driven(tmp_path, toml, text)


@pytest.mark.parametrize(("table", "has_remedy"), [("", True), ('t = "t"', True), ('"arm.m1.x" = "Elbow X"', False)])
def test_columns_are_the_remedy_until_they_are_used(tmp_path: Path, table: str, has_remedy: bool) -> None:
    text = csv_text(DRIVEN, rows(DRIVEN)).replace("arm.m1.x", "Elbow", 1)
    with pytest.raises(RecordingError) as caught:
        load_driven(tmp_path, f"{TOML}[columns]\n{table}\n", text)
    assert ("in [columns]" in str(caught.value)) is has_remedy


def test_one_file_may_have_the_documentations_own_name(tmp_path: Path) -> None:
    text = csv_text(DRIVEN, rows(DRIVEN)).replace("arm.m1.x", "Elbow X", 1)
    load_driven(tmp_path, TOML + '[columns]\n"arm.m1.x" = "Elbow X"\n', text)


def test_a_camera_of_markers_in_their_links_frames(tmp_path: Path) -> None:
    toml = TOML.replace("markers = [0.25, 0.5, 1.0]", 'markers = [0.25, 0.5, 1.0]\nmarkers_frame = "link"') + CAMERA
    with pytest.raises(ExperimentError, match=r'\[camera\].*markers_frame = "link".*expected no \[camera\]'):
        load_experiment(write_experiment(tmp_path, toml))


def load_driven(folder: Path, toml: str, text: str, motors: str = "") -> Experiment:
    if motors:
        (folder / "motors.csv").write_text(motors)
        toml = toml.replace('file = "drive_1.csv"', 'file = "drive_1.csv"\nmotors_file = "motors.csv"')
    return load_experiment(write_experiment(folder, toml, drive_1=text))


NAMED = TOML + '[columns]\nt = "Time"\n"arm.m1.x" = "Elbow X"\n"arm.theta" = "Angle"\n[units]\ntime = "ms"\n'


def test_faults_in_recordings_bear_the_files_own_names(tmp_path: Path) -> None:
    text = csv_text(DRIVEN, rows(DRIVEN)).replace("arm.m1.x", "Elbow X", 1).replace("t,arm.theta", "Time,Angle", 1)
    load_driven(tmp_path, NAMED, text)
    lines = text.split("\n")
    cells = lines[5].split(",")
    cases = [
        (
            "\n".join(lines).replace(lines[5], ",".join([*cells[:3], "12,3".replace(",", ";"), *cells[4:]])),
            6,
            "Elbow X",
        ),
        ("\n".join([*lines[:5], lines[3], *lines[5:]]), 6, "Time"),
        ("\n".join(lines).replace("Elbow X", "Elbow", 1), 1, "Elbow X"),
        ("\n".join(lines).replace("arm.m2.x", "Elbow X", 1), 1, "Elbow X"),
    ]
    for changed, row, column in cases:
        with pytest.raises(RecordingError) as caught:
            load_driven(tmp_path, NAMED, changed)
        assert (caught.value.file.name, caught.value.row, caught.value.column) == ("drive_1.csv", row, column)


def test_faults_are_in_the_file_that_has_them(tmp_path: Path) -> None:
    frames, motors = in_two(table_of(DRIVEN, 0))
    text, other = text_of(frames), text_of(motors)
    load_driven(tmp_path, TOML, text, other)
    late = {
        name: np.where(np.arange(40) == 7, -1.0, values) if name == "t" else values for name, values in motors.items()
    }
    without = {name: values for name, values in motors.items() if name != "arm.tau"}
    since_1970 = motors | {"t": motors["t"] + 1.7e9}
    cases = [
        (text, text_of(since_1970), "motors.csv", None, "t", "in drive_1.csv they are from 0 to"),
        (text, text_of(late), "motors.csv", 9, "t", "does not increase"),
        (text, text_of(without), "motors.csv", 1, "arm.tau", "missing"),
        (text, other.replace("t,", "time,", 1), "motors.csv", 1, "time", "unknown column"),
        (text, other.replace("arm.theta", "arm.m1.x", 1), "motors.csv", 1, "arm.m1.x", "a marker's column"),
        (text.replace("arm.m1.x", "arm.tau", 1), other, "motors.csv", 1, "arm.tau", "is in drive_1.csv as well"),
        (text.replace("arm.m1.x", "arm.m9.x", 1), other, "drive_1.csv", 1, "arm.m9.x", "has 3 markers"),
        (text.replace("tip.m1.y", "arm.m1.z", 1), other, "drive_1.csv", 1, "arm.m1.z", "[camera] axes"),
        (text, "arm.theta,arm.tau\n1,2\n", "motors.csv", 1, "t", "missing"),
    ]
    for camera, motor, file, row, column, words in cases:
        with pytest.raises(RecordingError) as caught:
            load_driven(tmp_path, TOML, camera, motor)
        assert (caught.value.file.name, caught.value.row, caught.value.column) == (file, row, column)
        assert words in str(caught.value)
    with pytest.raises(ExperimentError, match="there is no file"):
        load_experiment(write_experiment(tmp_path, TOML.replace("repeat =", 'motors_file = "gone.csv"\nrepeat =', 1)))


def test_warnings_bear_the_files_own_names(tmp_path: Path) -> None:
    cells = rows(DRIVEN)
    for line in cells[30:]:
        line[1] = ""
    text = csv_text(DRIVEN, cells).replace("arm.theta", "Angle", 1)
    experiment = load_driven(tmp_path, TOML + '[columns]\narm.theta = "Angle"\n', text)
    assert experiment.warnings[0].startswith("drive_1.csv: Angle is measured from t = 0 to 0.29 s only")
