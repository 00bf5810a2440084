"""A hub-driven beam as an experiment folder: two drives to train on and a slew held out, seen by imperfect sensors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam.beam import Beam, Trajectory, simulate
from tests.fine_beam.sensors import Camera, Encoder, observe, read_encoder
from tests.fine_beam.write import RecordingEntry, write_experiment, write_recording

Array = NDArray[np.float64]

TRUTH = Beam(length=1.0, mass=0.44, bending_stiffness=1.97, kelvin_voigt_time=5e-4, joint="revolute", hub_inertia=0.02)
MARKERS = [0.2, 0.4, 0.6, 0.8, 1.0]
CAMERA = Camera(100.0, 3e-4)
ENCODER = Encoder(500.0, 1e-4)
DURATION = 5.0
NOMINAL = 0.8  # of the true bending stiffness


@dataclass(frozen=True)
class Drive:
    """One recording: its file, role, and the sines of its torque (N m, Hz, rad)."""

    file: str
    role: str
    sines: tuple[tuple[float, float, float], ...]


DRIVES = (
    Drive("drive_small.csv", "train", ((0.06, 0.9, 0.0), (0.03, 2.3, 1.0), (0.02, 6.1, 2.0))),
    Drive("drive_large.csv", "train", ((0.18, 0.7, 0.0), (0.08, 2.7, 2.0), (0.05, 5.3, 0.5))),
)
SLEW = "slew.csv"


def torque_of(drive: Drive, time: Array) -> Array:
    """N m, (T,), from zero on."""
    waves = [size * np.sin(2 * np.pi * rate * time + phase) for size, rate, phase in drive.sines]
    return np.asarray(np.sum(waves, axis=0) * np.minimum(1.0, 4 * time))


def slew_torque(time: Array) -> Array:
    """N m, (T,): there and back, with corners."""
    return np.asarray(0.16 * np.sign(np.sin(2 * np.pi * 0.45 * time)) * (time < 4.4))


@cache
def motions() -> dict[str, tuple[Trajectory, Array]]:
    """Each recording's motion and torque at 500 Hz."""
    time = np.arange(round(DURATION * 500) + 1) / 500
    torques = {drive.file: torque_of(drive, time) for drive in DRIVES} | {SLEW: slew_torque(time)}
    return {file: (simulate(TRUTH, time, torque), torque) for file, torque in torques.items()}


def write_hub_experiment(folder: Path, seed: int, camera: Camera = CAMERA, encoder: Encoder = ENCODER) -> Path:
    """Write the experiment as seen with the noise of a seed; returns its file."""
    roles = {drive.file: drive.role for drive in DRIVES} | {SLEW: "holdout"}
    for k, (file, (motion, torque)) in enumerate(motions().items()):
        frames = observe(motion, MARKERS, camera, 100 * seed + k)
        angle = read_encoder(motion, encoder, 100 * seed + k)
        write_recording(folder / file, "beam", frames, angle, (motion.time, torque))
    link: dict[str, str | float | list[float]] = {
        "name": "beam",
        "joint": "revolute",
        "length": TRUTH.length,
        "mass": TRUTH.mass,
        "bending_stiffness": NOMINAL * TRUTH.bending_stiffness,
        "hub_inertia": 1.2 * TRUTH.hub_inertia,
        "markers": MARKERS,
    }
    sensors = {"marker_noise": camera.noise, "encoder_noise": encoder.noise}
    entries = [RecordingEntry(file, "driven", role) for file, role in roles.items()]
    write_experiment(folder / "experiment.toml", "hub-driven beam", link, sensors, entries)
    return folder / "experiment.toml"
