"""The command as a process: exit status, streams, and one identification from end to end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.report.fits import DEMO
from tests.report.schema import IdentifyResult, SimulateResult


def vjm(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "vjm", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def short_experiment(folder: Path) -> Path:
    """The demo's beam, the first second and a half of one recording to train on and of one held out."""
    rig = DEMO.read_text(encoding="utf-8").partition("[[recording]]")[0]
    for name, role in (("first_mode.csv", "train"), ("both_modes.csv", "holdout")):
        lines = (DEMO.parent / name).read_text(encoding="utf-8").splitlines()
        (folder / name).write_text("\n".join(lines[:46]) + "\n", encoding="utf-8")
        rig += f'[[recording]]\nfile = "{name}"\nkind = "decay"\nrole = "{role}"\n'
    (folder / "experiment.toml").write_text(rig, encoding="utf-8")
    return folder / "experiment.toml"


@pytest.mark.slow
def test_identify_then_simulate(tmp_path: Path) -> None:
    experiment, out = short_experiment(tmp_path), tmp_path / "out"
    identified = vjm("identify", experiment, "-o", out, "--json", "--virtual-joints", "3")
    assert (identified.returncode, identified.stderr) == (0, "")
    result = IdentifyResult.model_validate_json(identified.stdout)
    assert len(result.model.links[0].virtual_joints) == 3
    assert len(list((out / "figures").iterdir())) >= 6
    simulated = vjm("simulate", experiment, out / "model.json", "-o", tmp_path / "again", "--json")
    assert (simulated.returncode, simulated.stderr) == (0, "")
    again = SimulateResult.model_validate_json(simulated.stdout)
    assert again.model == result.model
    for one, other in zip(again.recordings, result.recordings, strict=True):
        assert one.marker_rms_m == pytest.approx(other.marker_rms_m, rel=1e-6)


def test_unusable_input_has_status_2_and_no_traceback(tmp_path: Path) -> None:
    result = vjm("identify", tmp_path / "nothing.toml", "-o", tmp_path / "out")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith("vjm: ")
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


def test_reader_that_goes_away() -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    command = [sys.executable, "-m", "vjm", "urdf", str(DEMO)]
    result = subprocess.run(command, stdout=write_end, stderr=subprocess.PIPE, text=True)
    os.close(write_end)
    assert (result.returncode, result.stderr) == (1, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device of Linux")
def test_output_that_cannot_be_written() -> None:
    command = [sys.executable, "-m", "vjm", "urdf", str(DEMO)]
    with open("/dev/full", "w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert (result.returncode, result.stderr.count("\n")) == (1, 1)
    assert result.stderr.startswith("vjm: the output cannot be written")


def test_version_and_no_command() -> None:
    assert vjm("--version").stdout.startswith("vjm ")
    result = vjm()
    assert result.returncode == 2
    assert "usage: vjm" in result.stderr
