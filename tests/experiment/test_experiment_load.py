"""What valid files become."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from experiment_files import DRIVEN, FREE, TOML, csv_text, rows, write_experiment

from vjm.experiment.load import load_experiment

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def numbers(cells: list[list[str]], columns: list[str], names: list[str]) -> np.ndarray:
    table = np.array([[float(cell) if cell else np.nan for cell in line] for line in cells])
    return table[:, [columns.index(name) for name in names]]


def test_rig(tmp_path: Path) -> None:
    rig = load_experiment(write_experiment(tmp_path)).rig
    arm, tip = rig.links
    assert (rig.name, rig.gravity, rig.marker_noise, rig.encoder_noise) == ("two links", (0.0, -9.81), 5e-4, None)
    assert (arm.name, arm.joint, arm.hub_inertia, arm.length, arm.mass) == ("arm", "revolute", 0.02, 1.0, 0.4)
    assert arm.bending_stiffness == pytest.approx(7e10 * 0.03 * 0.002**3 / 12, rel=1e-14)
    assert (arm.markers, arm.markers_frame, arm.payload, arm.virtual_joints) == ((0.25, 0.5, 1.0), "base", 0.0, None)
    assert (tip.bending_stiffness, tip.payload, tip.markers_frame, tip.virtual_joints) == (1.5, 0.05, "link", 3)
    assert (tip.hub_inertia, tip.width, tip.thickness, tip.youngs_modulus) == (0.0, None, None, None)


def test_recordings(tmp_path: Path) -> None:
    file = write_experiment(tmp_path)
    experiment = load_experiment(str(file))
    drive, repeat, free = experiment.recordings
    assert experiment.file == file
    assert experiment.warnings == ()
    assert (drive.file, drive.kind, drive.role, drive.repeat) == ("drive_1.csv", "driven", "train", "drive")
    assert (drive.gravity, drive.payload, drive.condition) == ((0.0, -9.81), 0.0, None)
    assert (repeat.role, repeat.repeat) == ("holdout", "drive")
    assert (free.gravity, free.payload, free.repeat) == ((0.0, 0.0), 0.1, None)
    cells = rows(DRIVEN)
    np.testing.assert_array_equal(drive.time, numbers(cells, DRIVEN, ["t"])[:, 0])
    np.testing.assert_array_equal(drive.theta, numbers(cells, DRIVEN, ["arm.theta"]))
    np.testing.assert_array_equal(drive.tau, numbers(cells, DRIVEN, ["arm.tau"]))
    np.testing.assert_array_equal(drive.markers[:, :3].reshape(-1, 6), numbers(cells, DRIVEN, DRIVEN[3:9]))


def test_lone_y_of_the_link_frame(tmp_path: Path) -> None:
    drive = load_experiment(write_experiment(tmp_path)).recordings[0]
    assert np.isnan(drive.markers[:, 3:, 0]).all()
    np.testing.assert_array_equal(drive.markers[:, 3:, 1], numbers(rows(DRIVEN), DRIVEN, DRIVEN[9:]))


def test_link_frame_with_x_as_well(tmp_path: Path) -> None:
    columns = [*FREE[:8], "tip.m1.x", "tip.m1.y", "tip.m2.y"]
    free = load_experiment(write_experiment(tmp_path, free=csv_text(columns, rows(columns)))).recordings[2]
    np.testing.assert_array_equal(free.markers[:, 3, 0], numbers(rows(columns), columns, ["tip.m1.x"])[:, 0])


def test_torque_not_measured_is_nan(tmp_path: Path) -> None:
    free = load_experiment(write_experiment(tmp_path)).recordings[2]
    assert free.tau.shape == (40, 1)
    assert np.isnan(free.tau).all()


def test_sensors_of_different_rates(tmp_path: Path) -> None:
    cells = rows(FREE)
    for row, line in enumerate(cells):  # the encoder is silent whenever the camera is not
        if row % 2 == 0:
            line[1] = ""
    free = load_experiment(write_experiment(tmp_path, free=csv_text(FREE, cells))).recordings[2]
    np.testing.assert_array_equal(free.frames, np.arange(0, 40, 2))
    np.testing.assert_array_equal(np.isfinite(free.theta[:, 0]), np.arange(40) % 2 == 1)


def test_columns_in_any_order(tmp_path: Path) -> None:
    order = np.random.default_rng(0).permutation(len(DRIVEN))
    shuffled = csv_text([DRIVEN[i] for i in order], [[line[i] for i in order] for line in rows(DRIVEN)])
    experiment = load_experiment(write_experiment(tmp_path, drive_1=shuffled))
    (tmp_path / "plain").mkdir()
    plain = load_experiment(write_experiment(tmp_path / "plain"))
    np.testing.assert_array_equal(experiment.recordings[0].markers, plain.recordings[0].markers)
    np.testing.assert_array_equal(experiment.recordings[0].tau, plain.recordings[0].tau)


def european(text: str, separator: str = ";") -> str:
    """A table as a spreadsheet writes it where commas separate decimals."""
    header, _, body = text.partition("\n")
    return header.replace(",", separator) + "\n" + body.replace(",", separator).replace(".", ",")


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.removesuffix("\n"),
        lambda text: text + "\n\n",
        lambda text: text.replace("\n", "\n\n"),
        lambda text: text.replace("\n", "\n  \n"),
        lambda text: text.replace(",", " , "),
        lambda text: text.replace(",", ",\t"),
        lambda text: "\n".join(",".join(f'"{cell}"' for cell in line.split(",")) for line in text.split("\n")[:-1]),
        lambda text: text.replace("t,", '"t",', 1),
        lambda text: "\ufeff" + text.replace("t,", '"t",', 1),
        lambda text: text.replace(",", ";"),
        lambda text: text.replace(",", "\t"),
        lambda text: european(text, ";"),
        lambda text: european(text, "\t"),
        lambda text: "\ufeff" + european(text, ";").replace("\n", "\r\n").replace(";", " ; "),
        lambda text: "\n".join(
            ";".join(f'"{cell}"' for cell in line.split(";")) for line in european(text).split("\n")
        ),
        lambda text: european(text).replace("\n", "\n\n"),
    ],
    ids=[
        *(
            "bom",
            "crlf",
            "cr",
            "no end",
            "blank end",
            "blank",
            "spaces",
            "padded",
            "tabs",
            "quoted",
            "name",
            "bom name",
        ),
        *("semicolons", "tabs alone", "decimal commas", "commas and tabs", "european", "quoted commas", "blank commas"),
    ],
)
def test_spellings_of_one_table(tmp_path: Path, change) -> None:
    text = csv_text(DRIVEN, rows(DRIVEN))
    drive = load_experiment(write_experiment(tmp_path, drive_1=change(text))).recordings[0]
    np.testing.assert_array_equal(drive.tau, numbers(rows(DRIVEN), DRIVEN, ["arm.tau"]))
    np.testing.assert_array_equal(drive.markers[:, 2], numbers(rows(DRIVEN), DRIVEN, ["arm.m3.x", "arm.m3.y"]))


def test_toml_with_bom_crlf_and_whole_numbers(tmp_path: Path) -> None:
    toml = "\ufeff" + TOML.replace("length = 1.0", "length = 1").replace("\n", "\r\n")
    length = load_experiment(write_experiment(tmp_path, toml)).rig.links[0].length
    assert length == 1.0
    assert isinstance(length, float)


def test_sensors_are_optional(tmp_path: Path) -> None:
    rig = load_experiment(write_experiment(tmp_path, TOML.replace("[sensors]\nmarker_noise = 0.0005\n", ""))).rig
    assert (rig.marker_noise, rig.encoder_noise) == (None, None)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_number_of_links(tmp_path: Path, count: int) -> None:
    toml = 'schema = 1\nname = "chain"\nbase.gravity = [0, 0]\n'
    columns, time = ["t"], 0.01 * np.arange(20)
    values = [time]
    for number in range(count):
        joint = "revolute" if number % 2 == 0 else "clamped"
        toml += f'[[link]]\nname = "l{number}"\njoint = "{joint}"\nlength = 1\nmass = 1\nbending_stiffness = 1\n'
        toml += f"markers = {[0.5, 1.0][: 1 + number % 2]}\n"
        names = [f"l{number}.theta"] if joint == "revolute" else []
        names += [f"l{number}.m{k}.{axis}" for k in range(1, 2 + number % 2) for axis in "xy"]
        values += [0.1 * np.sin(30.0 * time + len(columns) + k) for k in range(len(names))]
        columns += names
    toml += '[[recording]]\nfile = "a.csv"\nkind = "static"\nrole = "train"\n'
    (tmp_path / "a.csv").write_text(
        csv_text(columns, [[repr(float(x)) for x in row] for row in zip(*values, strict=True)])
    )
    (tmp_path / "experiment.toml").write_text(toml)
    experiment = load_experiment(tmp_path / "experiment.toml")
    recording = experiment.recordings[0]
    assert recording.theta.shape == (20, (count + 1) // 2)
    assert recording.markers.shape == (20, sum(1 + number % 2 for number in range(count)), 2)
    for index, own in enumerate(experiment.rig.marker_slices):
        column = columns.index(f"l{index}.m1.y")
        np.testing.assert_array_equal(recording.markers[:, own.start, 1], values[column])
    for column, index in enumerate(experiment.rig.active_links):
        np.testing.assert_array_equal(recording.theta[:, column], values[columns.index(f"l{index}.theta")])


def test_import_is_light() -> None:
    code = "import sys, vjm.records; print(sorted({'pandas', 'pydantic', 'scipy'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(("folder", "count"), [("hub_rig", 8), ("silicone_beam", 4)])
def test_real_data(folder: str, count: int) -> None:
    file = DATA / folder / "experiment.toml"
    if not file.exists():
        pytest.skip(f"{file} is not here")
    experiment = load_experiment(file)
    assert len(experiment.recordings) == count
    assert experiment.warnings == ()
    for recording in experiment.recordings:
        assert np.isfinite(recording.markers[recording.frames]).all()
