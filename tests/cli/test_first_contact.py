"""A person's path from what camera and motor driver wrote to a report with the cause: init, check, identify, diagnose.

The recordings are a continuous beam's, not a chain's, with a mass on its tip that nobody wrote down.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.fine_beam import Beam, Physics, Run, simulate_runs
from tests.report.schema import DiagnoseResult, IdentifyResult
from vjm.cli import main

BEAM = Beam(length=0.6, mass=0.21, bending_stiffness=1.1, kelvin_voigt_time=6e-4, joint="revolute", hub_inertia=0.006)
HIDDEN = 0.009  # kg on the tip
MARKERS = [0.15, 0.3, 0.45, 0.6]
CAMERA_RATE, DRIVE_RATE, DURATION = 50, 200, 1.2  # Hz, Hz, s
TORQUES = {  # N m, Hz
    "run_1": ((0.06, 0.8), (0.02, 5.5)),
    "run_2": ((0.05, 1.4), (0.03, 3.7)),
    "run_3": ((0.05, 1.0), (0.03, 4.6)),
}
SUSPECTS = "tip_payload,torque_gain,viscous_friction,time_offset"


def write_raw(folder: Path) -> None:
    """Write CSV files in milliseconds, millimetres and degrees, camera and motor apart, with names of their own."""
    noise = np.random.default_rng(0)
    instants = np.arange(round(DURATION * DRIVE_RATE) + 1) / DRIVE_RATE
    torques = [sum(size * np.sin(2 * np.pi * rate * instants) for size, rate in sines) for sines in TORQUES.values()]
    runs = [Run(np.asarray(torque)) for torque in torques]
    for name, torque, motion in zip(
        TORQUES, torques, simulate_runs(BEAM, Physics(tip_payload_mass=HIDDEN), instants, runs), strict=True
    ):
        angle = np.rad2deg(motion.theta + 1e-4 * noise.standard_normal(instants.size))
        motor = {"Time (ms)": 1e3 * instants, "Motor angle (deg)": angle, "Motor torque (N m)": torque}
        pd.DataFrame(motor).round(5).to_csv(folder / f"{name}_motor.csv", index=False)
        stamps = instants[:: DRIVE_RATE // CAMERA_RATE]
        places = motion.at(stamps).positions(MARKERS)
        places = 1e3 * (places + 3e-4 * noise.standard_normal(places.shape))
        camera = {"Frame #": np.arange(stamps.size), "Time (ms)": 1e3 * stamps}
        for k, (x, y) in enumerate(np.moveaxis(places, (1, 2), (0, 1)), start=1):
            camera |= {f"Dot{k} X (mm)": x, f"Dot{k} Y (mm)": y}
        pd.DataFrame(camera).round(2).to_csv(folder / f"{name}.csv", index=False)


def test_from_raw_files_to_the_cause(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig, seconds = tmp_path / "rig", {}
    rig.mkdir()
    write_raw(rig)

    def run(command: str, *arguments: str | Path) -> str:
        began = time.perf_counter()
        status = main([command, *map(str, arguments)])
        seconds[command] = time.perf_counter() - began
        said = capsys.readouterr()
        assert (status, said.err) == (0, ""), said.err
        assert max(len(line.rstrip()) for line in said.out.splitlines() if str(tmp_path) not in line) <= 80
        return said.out

    file = rig / "experiment.toml"
    known = ("--length", "0.6", "--mass", "0.21", "--bending-stiffness", "1.2", "--hub-inertia", "0.006")
    assert "2 training recordings, 1 held out." in run("init", rig, *known)
    assert "3 of 3 parameters determined" in run("check", file, "-o", rig / "check")
    run("identify", file, "-o", rig / "identified")
    said = run("diagnose", file, "-o", rig / "diagnosed", "--effects", SUSPECTS)

    assert seconds["check"] < 10, seconds
    assert seconds["identify"] < 60, seconds
    assert "Residual is consistent with noise" in said
    identified = IdentifyResult.model_validate(json.loads((rig / "identified" / "result.json").read_text()))
    assert identified.status == "converged"
    assert any("unmodelled dynamics" in warning for warning in identified.warnings)
    diagnosed = DiagnoseResult.model_validate(json.loads((rig / "diagnosed" / "result.json").read_text()))
    assert diagnosed.verdict == "named"
    (cause,) = diagnosed.causes
    mass = cause.parameters["mass"]
    assert cause.effect == "tip_payload"
    assert mass.std is not None
    assert abs(mass.value - HIDDEN) < 3 * mass.std < 0.3 * HIDDEN  # two drives hardly show where its centre is
    assert f"Cause found: unknown mass of {1e3 * mass.value:.2f} ± {1e3 * mass.std:.2f} g" in " ".join(said.split())
    alone = {each.effect: each for each in diagnosed.candidates if each.residual is not None}
    assert alone["tip_payload"].residual == pytest.approx(1.0, abs=0.1)
    assert diagnosed.gain is not None
    assert alone["tip_payload"].holdout_rms_m == diagnosed.gain.holdout_rms_after_m
    (link,) = diagnosed.model.links
    stiffness = link.bending_stiffness
    assert stiffness.std is not None
    assert abs(stiffness.value - BEAM.bending_stiffness) < 3 * stiffness.std < 0.02 * BEAM.bending_stiffness
    (held_out,) = (each for each in diagnosed.recordings if each.role == "holdout")
    assert held_out.file == "run_3.csv"
    assert held_out.marker_rms_after_m == pytest.approx(3e-4, rel=0.1)
    page = (rig / "diagnosed" / "report.html").read_text(encoding="utf-8")
    assert f"unknown mass of {1e3 * mass.value:.2f}" in page
    assert (rig / "check" / "check.png").read_bytes().startswith(b"\x89PNG")
