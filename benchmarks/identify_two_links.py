"""`vjm identify` on two flexible links with an elbow motor, report included, as a whole process.

The recordings are those of an arm simulated by MuJoCo (`tests/mujoco_arm`), with noise: seven of 5 s, five to train
with. Once with nominal stiffnesses 15 % off, and once with torques of a wrong scale and sign, which no model follows.
"""

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from clock import ROOT, header, line

sys.path.append(str(ROOT))

from tests.fine_beam import Frames, LinkRecord, RecordingEntry, write_arm_recording, write_experiment
from tests.mujoco_arm.simulate import Motion, simulate
from tests.mujoco_arm.two_links import (
    ENCODER_NOISE,
    FRAME_RATE,
    MARKER_NOISE,
    MARKERS,
    MAX_STEP,
    NOMINAL_STIFFNESS,
    RATE,
    SWINGS,
    TRUE_ARM,
    Sine,
    slews,
    swing,
)

DURATION = 5  # s
MORE_SWINGS = (
    [[Sine(0.3, 0.5), Sine(0.02, 1.7), Sine(1e-3, 4.3)], [Sine(0.6, 0.45), Sine(0.01, 2.3), Sine(1e-3, 6.1)]],
    [[Sine(0.6, 0.25), Sine(0.015, 0.9), Sine(4e-4, 6.0)], [Sine(-0.3, 0.6), Sine(0.03, 1.6), Sine(1e-3, 8.0)]],
    [[Sine(0.2, 0.8), Sine(0.01, 2.1), Sine(1e-3, 3.0)], [Sine(0.5, 0.7), Sine(0.02, 1.2), Sine(3e-3, 4.5)]],
)
TURNS = ((0.6, -0.5), (-0.4, 0.7))  # rad, of the slews that are held out
WRONG_TORQUE = np.array([1.6, -0.7])  # times the true one, of shoulder and elbow
LIMIT, LIMIT_WRONG = 20.0, 120.0  # s


def simulate_drives() -> list[tuple[Motion, np.ndarray]]:
    """Motions, and torques, N m, (T, 2)."""
    time = np.arange(DURATION * RATE + 1) / RATE
    rigid = TRUE_ARM.straight_mass_matrix()[np.ix_(TRUE_ARM.active, TRUE_ARM.active)]
    accelerations = [swing(time, joints) for joints in (*SWINGS, *MORE_SWINGS)] + [slews(time, turn) for turn in TURNS]
    torques = [acceleration @ rigid for acceleration in accelerations]
    return [(simulate(TRUE_ARM, time, torque, max_step=MAX_STEP), torque) for torque in torques]


def write(folder: Path, drives: list[tuple[Motion, np.ndarray]], torque_factor: np.ndarray) -> Path:
    """Write the experiment, with measured torques times a factor (2,), and return its file."""
    folder.mkdir()
    entries, every = [], RATE // FRAME_RATE
    for k, (motion, torque) in enumerate(drives):
        noise, records = np.random.default_rng([1, k]), []
        for i, link in enumerate(TRUE_ARM.links):
            markers = motion.positions(i, MARKERS)[::every]
            markers = markers + MARKER_NOISE * noise.standard_normal(markers.shape)
            angle = motion.angles[:, i] + ENCODER_NOISE * noise.standard_normal(len(motion.time))
            measured = (motion.time, torque_factor[i] * torque[:, i])
            frames = Frames(motion.time[::every], markers)
            records.append(LinkRecord(link.name, frames, (motion.time, angle), measured))
        entries.append(RecordingEntry(f"drive_{k}.csv", "driven", "train" if k < 5 else "holdout"))
        write_arm_recording(folder / entries[-1].file, records)
    links: list[dict[str, str | float | list[float]]] = [
        {
            "name": link.name,
            "joint": link.joint,
            "hub_inertia": link.hub_inertia,
            "length": link.length,
            "mass": link.mass,
            "bending_stiffness": nominal,
            "markers": MARKERS,
        }
        for link, nominal in zip(TRUE_ARM.links, NOMINAL_STIFFNESS, strict=True)
    ]
    sensors = {"marker_noise": MARKER_NOISE, "encoder_noise": ENCODER_NOISE}
    write_experiment(folder / "experiment.toml", "two links", links, sensors, entries)
    return folder / "experiment.toml"


def processor_time(experiment: Path) -> float:
    """Seconds that `vjm identify` takes of one processor."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "vjm", "identify", str(experiment), "-q", "-o", str(experiment.parent / "out")]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    drives = simulate_drives()
    with tempfile.TemporaryDirectory() as folder:
        right = write(Path(folder) / "right", drives, np.ones(2))
        wrong = write(Path(folder) / "wrong", drives, WRONG_TORQUE)
        seconds, seconds_wrong = processor_time(right), processor_time(wrong)
    header("vjm identify on two flexible links, seven recordings of 5 s")
    line("identify, processor time", seconds, "s", LIMIT)
    line("torques that do not match, processor time", seconds_wrong, "s", LIMIT_WRONG)


if __name__ == "__main__":
    main()
