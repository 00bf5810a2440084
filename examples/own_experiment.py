"""Write an experiment folder from arrays, as a lab's own script would, and ask vjm what it makes of it.

python examples/own_experiment.py [folder]      (without it: my_experiment)
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

import vjm

EXPERIMENT = """\
schema = 1
name = "my beam"

[base]
gravity = [0.0, 0.0]

[[link]]
name = "beam"
joint = "clamped"
length = 0.8
mass = 0.31
bending_stiffness = 1.8
markers = [0.2, 0.4, 0.6, 0.8]

[[recording]]
file = "release.csv"
kind = "decay"
role = "train"
"""
ARCS = np.array([0.2, 0.4, 0.6, 0.8])  # m


def camera() -> tuple[np.ndarray, np.ndarray]:
    """Time (T,) [s] and marker positions (T, k, 2) [m]. Here made up: replace this by what your camera gives."""
    time = np.arange(0, 8, 1 / 60)
    swing = 0.05 * np.exp(-0.05 * time) * np.cos(2 * np.pi * 2.05 * time)  # of the tip [m]
    deflection = np.outer(swing, (ARCS / 0.8) ** 2 * (6 - 4 * ARCS / 0.8 + (ARCS / 0.8) ** 2) / 3)
    noise = np.random.default_rng(1).normal(scale=3e-4, size=(time.size, 4, 2))
    return time, np.stack([np.broadcast_to(ARCS, deflection.shape), deflection], axis=-1) + noise


def main(folder: str = "my_experiment") -> None:
    time, markers = camera()
    markers[100:103, 2] = np.nan  # three frames in which something hid marker 3: their cells stay empty

    table = pd.DataFrame({"t": time})
    for k in range(markers.shape[1]):
        table[f"beam.m{k + 1}.x"] = markers[:, k, 0]
        table[f"beam.m{k + 1}.y"] = markers[:, k, 1]
    here = Path(folder)
    here.mkdir(exist_ok=True)
    table.to_csv(here / "release.csv", index=False)
    (here / "experiment.toml").write_text(EXPERIMENT, encoding="utf-8")

    found = vjm.check(vjm.load_experiment(here / "experiment.toml"))
    for warning in found.warnings:
        print("!", warning)
    for choice, parameters in found.identifiable.items():
        known = [parameter.name for parameter in parameters if parameter.identifiable]
        print(f"--parameters {choice}: {len(known)} of {len(parameters)} determined")


if __name__ == "__main__":
    main(*sys.argv[1:])
