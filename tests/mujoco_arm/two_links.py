"""An experiment with an arm of two flexible links, shoulder and elbow driven, as files."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam import Frames, LinkRecord, RecordingEntry, write_arm_recording, write_experiment
from tests.fine_beam.write import Value
from tests.mujoco_arm.chain import Arm, Link
from tests.mujoco_arm.simulate import Motion, simulate

Array = NDArray[np.float64]

TRUE_ARM = Arm(
    (
        Link("upper", 0.5, 0.2, bending_stiffness=1.5, kelvin_voigt_time=1e-3, hub_inertia=0.02),
        Link("fore", 0.5, 0.2, bending_stiffness=1.0, kelvin_voigt_time=2e-3, hub_inertia=0.008),
    )
)
NOMINAL_STIFFNESS = (1.28, 1.17)  # N m^2: off by -15 % and 17 %
MARKERS = [0.125, 0.25, 0.375, 0.5]  # ends of segments
DURATION, RATE, FRAME_RATE = 4, 500, 100  # s, samples per second
MARKER_NOISE, ENCODER_NOISE = 3e-4, 1e-4  # m, rad
# With 32 segments, markers are then within 4e-6 m of the converged motion.
MAX_STEP = 4e-4


class Sine(NamedTuple):
    """Amplitude in rad and frequency in Hz."""

    amplitude: float
    frequency: float


class Drive(NamedTuple):
    """A recording, and what turns joints of a rigid arm by the wanted accelerations, rad/s^2, (T, 2), at times (T,)."""

    entry: RecordingEntry
    accelerations: Callable[[Array], Array]


def swing(time: Array, joints: list[list[Sine]]) -> Array:
    """Accelerations, rad/s^2, (T, joints), of sums of sines that set in slowly: they leave no drift behind."""
    step = 1e-4
    before, now, after = (_angles(time + shift, joints) for shift in (-step, 0.0, step))
    return (after - 2.0 * now + before) / step**2


def _angles(time: Array, joints: list[list[Sine]]) -> Array:
    onset = 1.0 - np.exp(-((time / 0.7) ** 2))
    sums = [sum(a * np.sin(2.0 * np.pi * f * time) for a, f in sines) for sines in joints]
    return np.asarray(np.stack(onset * sums, axis=1))


def slews(time: Array, angles: tuple[float, float]) -> Array:
    """Accelerations, rad/s^2, (T, 2), that turn by `angles` (rad) within a second, and back two seconds later."""
    knots = np.array([0.0, 0.1, 0.4, 0.6, 0.9, 1.0])
    values = 5.0 * np.array([0.0, 1.0, 1.0, -1.0, -1.0, 0.0])  # a turn of 1 rad
    there, back = (np.interp(time, start + knots, values) for start in (0.2, 2.2))
    return np.asarray((there - back)[:, None] * np.array(angles))


SWINGS = (
    [[Sine(0.5, 0.35), Sine(0.01, 1.1), Sine(7e-4, 3.3)], [Sine(-0.5, 0.35), Sine(0.02, 1.3), Sine(2e-3, 5.5)]],
    [[Sine(0.5, 0.3), Sine(0.01, 1.4), Sine(5e-4, 5.2)], [Sine(0.4, 0.3), Sine(0.015, 1.9), Sine(2e-3, 7.3)]],
)
DRIVES = (
    Drive(RecordingEntry("swing_1.csv", "driven", "train"), lambda time: swing(time, SWINGS[0])),
    Drive(RecordingEntry("swing_2.csv", "driven", "train"), lambda time: swing(time, SWINGS[1])),
    Drive(RecordingEntry("slew.csv", "driven", "holdout"), lambda time: slews(time, (0.6, -0.5))),
)


def write_two_link_experiment(folder: Path, seed: int) -> None:
    """Write experiment.toml and its recordings into `folder`; the seed is of the sensors' noise."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, drive in enumerate(DRIVES):
        records = _measure(*simulate_drive(index), np.random.default_rng([seed, index]))
        write_arm_recording(folder / drive.entry.file, records)
    write_experiment(
        folder / "experiment.toml",
        name="two flexible links",
        link=[_link_table(link, nominal) for link, nominal in zip(TRUE_ARM.links, NOMINAL_STIFFNESS, strict=True)],
        sensors={"marker_noise": MARKER_NOISE, "encoder_noise": ENCODER_NOISE},
        recordings=[drive.entry for drive in DRIVES],
    )


@cache
def simulate_drive(index: int) -> tuple[Motion, Array]:
    """The true motion of a drive, and its torques, N m, (T, 2), those of the arm if it were rigid and straight."""
    time = np.arange(DURATION * RATE + 1) / RATE
    rigid = TRUE_ARM.straight_mass_matrix()[np.ix_(TRUE_ARM.active, TRUE_ARM.active)]
    torque = DRIVES[index].accelerations(time) @ rigid
    return simulate(TRUE_ARM, time, torque, max_step=MAX_STEP), torque


def _measure(motion: Motion, torque: Array, noise: np.random.Generator) -> list[LinkRecord]:
    """What the sensors see of each link."""
    records = []
    every = RATE // FRAME_RATE
    for index, link in enumerate(TRUE_ARM.links):
        markers = motion.positions(index, MARKERS)[::every]
        markers = markers + MARKER_NOISE * noise.standard_normal(markers.shape)
        angle = motion.angles[:, index] + ENCODER_NOISE * noise.standard_normal(len(motion.time))
        frames = Frames(motion.time[::every], markers)
        records.append(LinkRecord(link.name, frames, (motion.time, angle), (motion.time, torque[:, index])))
    return records


def _link_table(link: Link, nominal_stiffness: float) -> dict[str, Value]:
    return {
        "name": link.name,
        "joint": link.joint,
        "hub_inertia": link.hub_inertia,
        "length": link.length,
        "mass": link.mass,
        "bending_stiffness": nominal_stiffness,
        "markers": MARKERS,
    }
