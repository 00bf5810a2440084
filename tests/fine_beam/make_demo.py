"""Make the demo's data: a clamped stainless steel beam, released and left to vibrate; and again once it has changed.

Run from the repository's root: python -m tests.fine_beam.make_demo
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from tests.fine_beam.beam import Beam, Numerics, Trajectory, simulate
from tests.fine_beam.hidden import Physics
from tests.fine_beam.motion import Motion, Run, simulate_runs
from tests.fine_beam.sensor_faults import Faults, shown_markers
from tests.fine_beam.sensors import Camera, film, observe
from tests.fine_beam.states import linear_modes, modal_state
from tests.fine_beam.write import RecordingEntry, write_experiment, write_recording

ROOT = Path(__file__).resolve().parents[2]
DEMO_DIRECTORY = ROOT / "vjm" / "demo"
TRUTH_FILE = Path(__file__).with_name("demo_truth.json")

LINK: dict[str, str | float | list[float]] = {
    "name": "beam",
    "joint": "clamped",
    "length": 1.0,
    "mass": 0.44,
    "width": 0.035,
    "thickness": 0.0015,
    "youngs_modulus": 1.93e11,
    "markers": [0.2, 0.4, 0.6, 0.8, 1.0],
}
MARKERS = [0.2, 0.4, 0.6, 0.8, 1.0]
NOMINAL_STIFFNESS = 1.93e11 * 0.035 * 0.0015**3 / 12.0
# 3.88 % stiffer than the nominal modulus says: an irregular number, so that nobody finds it by rounding.
TRUE_BEAM = Beam(length=1.0, mass=0.44, bending_stiffness=1.973629, kelvin_voigt_time=3.07e-4)
CAMERA = Camera(rate=30.0, noise=3e-4)
# Steps end on the camera's frames; at this length the markers are within 2e-8 m of the converged motion.
STEPS_PER_SECOND = 600
NUMERICS = Numerics(max_step=1.0 / STEPS_PER_SECOND)


class DemoRecording(NamedTuple):
    """A recording: what the experiment file says of it, its length in s, modal tip amplitudes in m, and its seed."""

    entry: RecordingEntry
    duration: float
    tip_amplitudes: list[float]
    seed: int


# What has happened to the beam by the time of the later recordings: its clamp has come loose a little.
LATER = Physics(clamp_compliance_compliance=3.37e-3)

RECORDINGS = (
    DemoRecording(RecordingEntry("quiet.csv", "quiet", "train"), 2.0, [0.0], 7301),
    DemoRecording(RecordingEntry("first_mode.csv", "decay", "train"), 10.0, [0.1, 0.0025], 7302),
    DemoRecording(RecordingEntry("second_mode.csv", "decay", "train"), 10.0, [0.004, 0.02], 7303),
    DemoRecording(RecordingEntry("both_modes.csv", "decay", "holdout"), 10.0, [0.065, -0.013], 7304),
)

LATER_RECORDINGS = (
    DemoRecording(RecordingEntry("later_first_mode.csv", "decay", "train"), 10.0, [0.09, 0.003], 7311),
    DemoRecording(RecordingEntry("later_second_mode.csv", "decay", "train"), 10.0, [0.005, -0.018], 7312),
    DemoRecording(RecordingEntry("later_loaded.csv", "decay", "train", payload=0.05), 10.0, [0.08, 0.004], 7313),
    DemoRecording(RecordingEntry("later_both_modes.csv", "decay", "holdout"), 10.0, [0.07, 0.012], 7314),
)


def make_demo(directory: Path, truth_file: Path) -> None:
    """Write experiment.toml and its recordings into `directory`, and what is true of them into `truth_file`."""
    directory.mkdir(parents=True, exist_ok=True)
    for recording in RECORDINGS:
        trajectory = simulate_recording(recording)
        frames = observe(trajectory, MARKERS, CAMERA, recording.seed)
        write_recording(directory / recording.entry.file, "beam", frames)
    for recording, motion in zip(LATER_RECORDINGS, simulate_later(LATER_RECORDINGS), strict=True):
        stamps = np.arange(round(recording.duration * CAMERA.rate) + 1) / CAMERA.rate
        frames = film(stamps, shown_markers(motion, stamps, MARKERS, Faults()), CAMERA, recording.seed)
        write_recording(directory / recording.entry.file, "beam", frames)
    before = [recording.entry for recording in RECORDINGS]
    later = [replace(entry, condition="reference") for entry in before]
    later += [recording.entry for recording in LATER_RECORDINGS]
    for file, name, entries in (
        ("experiment.toml", "stainless steel beam, clamped", before),
        ("later.toml", "the same beam, a week later", later),
    ):
        write_experiment(directory / file, name, LINK, {"marker_noise": CAMERA.noise}, entries)
    truth_file.write_bytes((json.dumps(demo_truth(), indent=2) + "\n").encode("utf-8"))


def simulate_recording(recording: DemoRecording, numerics: Numerics = NUMERICS) -> Trajectory:
    """The true motion behind a recording."""
    time = np.arange(round(recording.duration * STEPS_PER_SECOND) + 1) / STEPS_PER_SECOND
    state = modal_state(TRUE_BEAM, recording.tip_amplitudes, numerics)
    return simulate(TRUE_BEAM, time, state=state, numerics=numerics)


def simulate_later(recordings: Sequence[DemoRecording], step: float = 1e-3) -> list[Motion]:
    """The true motions behind later recordings."""
    time = np.arange(round(max(each.duration for each in recordings) * STEPS_PER_SECOND) + 1) / STEPS_PER_SECOND
    runs = [Run(None, tuple(each.tip_amplitudes), each.entry.body) for each in recordings]
    return simulate_runs(TRUE_BEAM, LATER, time, runs, step)


def demo_truth() -> dict[str, object]:
    """True parameters, and the first three modes from the simulator's linearisation and in closed form."""
    modes = linear_modes(TRUE_BEAM)
    closed = euler_bernoulli_frequencies(TRUE_BEAM, 3)
    return {
        "bending_stiffness": TRUE_BEAM.bending_stiffness,
        "bending_stiffness_nominal": _rounded(NOMINAL_STIFFNESS),
        "kelvin_voigt_time": TRUE_BEAM.kelvin_voigt_time,
        "marker_noise": CAMERA.noise,
        "clamp_compliance_later": LATER.clamp_compliance_compliance,
        "simulator": {
            "frequencies_hz": [_rounded(value) for value in modes.frequencies[:3]],
            "damping_ratios": [_rounded(value) for value in modes.damping_ratios[:3]],
        },
        "euler_bernoulli": {
            "frequencies_hz": [_rounded(value) for value in closed],
            "damping_ratios": [_rounded(np.pi * value * TRUE_BEAM.kelvin_voigt_time) for value in closed],
        },
    }


def euler_bernoulli_frequencies(beam: Beam, count: int) -> list[float]:
    """Natural frequencies, Hz, of a clamped-free beam: cos(z) cosh(z) = -1."""
    scale = np.sqrt(beam.bending_stiffness / (beam.mass * beam.length**3)) / (2.0 * np.pi)
    # Each root lies within one unit of an odd multiple of pi / 2; divided by cosh, the function stays of order one.
    centres = np.pi * (np.arange(count) + 0.5)
    roots = [brentq(lambda z: np.cos(z) + 1.0 / np.cosh(z), z - 1.0, z + 1.0, xtol=1e-14) for z in centres]
    return [float(scale * z**2) for z in roots]


def _rounded(value: float) -> float:
    """Nine significant digits: the same on every computer."""
    return float(f"{value:.9g}")


if __name__ == "__main__":
    make_demo(DEMO_DIRECTORY, TRUTH_FILE)
