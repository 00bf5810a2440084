"""A small valid experiment, as text that tests alter."""

from __future__ import annotations

from pathlib import Path

import numpy as np

TOML = """\
schema = 1
name = "two links"

[base]
gravity = [0.0, -9.81]

[[link]]
name = "arm"
joint = "revolute"
hub_inertia = 0.02
length = 1.0
mass = 0.4
width = 0.03
thickness = 0.002
youngs_modulus = 7e10
markers = [0.25, 0.5, 1.0]

[[link]]
name = "tip"
joint = "clamped"
length = 0.5
mass = 0.1
bending_stiffness = 1.5
payload = 0.05
markers = [0.2, 0.5]
markers_frame = "link"
virtual_joints = 3

[sensors]
marker_noise = 0.0005

[[recording]]
file = "drive_1.csv"
kind = "driven"
role = "train"
repeat = "drive"

[[recording]]
file = "drive_2.csv"
kind = "driven"
role = "holdout"
repeat = "drive"

[[recording]]
file = "free.csv"
kind = "decay"
role = "train"
payload = 0.1
gravity = [0, 0]
"""

DRIVEN = [
    "t", "arm.theta", "arm.tau", "arm.m1.x", "arm.m1.y", "arm.m2.x", "arm.m2.y", "arm.m3.x", "arm.m3.y",
    "tip.m1.y", "tip.m2.y",
]  # fmt: skip
FREE = [name for name in DRIVEN if name != "arm.tau"]
ROWS = 40
FILES = {"drive_1.csv": DRIVEN, "drive_2.csv": DRIVEN, "free.csv": FREE}


def rows(columns: list[str], count: int = ROWS, seed: int = 0) -> list[list[str]]:
    """Cells of a rotating arm: encoder and torque in every row, camera in every second one."""
    time = 0.01 * np.arange(count)
    angle = 0.3 * np.sin(5.0 * time)
    noise = np.random.default_rng(seed).normal(0.0, 2e-4, (count, len(columns)))
    values = {"t": time, "arm.theta": angle, "arm.tau": 0.1 * np.cos(5.0 * time)}
    for number, arc in enumerate((0.25, 0.5, 1.0), start=1):
        values[f"arm.m{number}.x"] = arc * np.cos(angle)
        values[f"arm.m{number}.y"] = arc * np.sin(angle)
    for number, arc in enumerate((0.2, 0.5), start=1):
        values[f"tip.m{number}.x"] = np.full(count, arc)
        values[f"tip.m{number}.y"] = 0.02 * arc * np.sin(9.0 * time)
    table = np.stack([values[name] for name in columns], axis=1)
    table[:, [".m" in name for name in columns]] += noise[:, [".m" in name for name in columns]]
    return [
        ["" if ".m" in name and row % 2 else repr(float(value)) for name, value in zip(columns, line, strict=True)]
        for row, line in enumerate(table)
    ]


def csv_text(columns: list[str], cells: list[list[str]]) -> str:
    return "\n".join(",".join(line) for line in [columns, *cells]) + "\n"


def write_experiment(folder: Path, toml: str = TOML, **changed: str) -> Path:
    """Write the experiment, with the text of some recordings (`drive_1=...`) changed; the experiment file's path."""
    for seed, (name, columns) in enumerate(FILES.items()):
        text = changed.get(name.removesuffix(".csv"), csv_text(columns, rows(columns, seed=seed)))
        (folder / name).write_bytes(text.encode("utf-8", "surrogateescape"))
    file = folder / "experiment.toml"
    file.write_bytes(toml.encode("utf-8", "surrogateescape"))
    return file
