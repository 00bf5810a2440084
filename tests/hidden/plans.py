"""What is recorded on each rig: drives and decays drawn a little from a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam import RecordingEntry
from tests.hidden.settings import Setting

Array = NDArray[np.float64]
Torque = Callable[[Array], Array]

KNOWN_PAYLOAD = 0.05  # kg, in one recording of the hub-driven rig


@dataclass(frozen=True)
class Plan:
    """One recording.

    Attributes:
        entry: its table in the experiment file.
        torque: what is recorded as the torque, N m, at instants from the start, s; None: the joint is held or clamped.
        tip_amplitudes: of vibration modes at the start, m.
    """

    entry: RecordingEntry
    torque: Torque | None = None
    tip_amplitudes: tuple[float, ...] = ()


def plans_of(setting: Setting, seed: int, reference: bool) -> list[Plan]:
    """The recordings of a setting; with two more in which nothing is hidden, under `reference`."""
    random = np.random.default_rng([seed, 1])
    return (_hub_plans if setting.turns else _clamped_plans)(setting, random, reference)


def _hub_plans(setting: Setting, random: np.random.Generator, reference: bool) -> list[Plan]:
    small = _sines(setting, random, (0.06, 0.03, 0.02), (0.9, 2.3, 6.1))
    large = _sines(setting, random, (0.24, 0.08, 0.05), (0.8, 2.7, 5.3))
    loaded = _sines(setting, random, (0.08, 0.04, 0.02), (0.8, 2.1, 5.6))
    other = _sines(setting, random, (0.11, 0.07, 0.03), (0.55, 1.7, 3.9))
    # From a point to a body a third as long as the link, held anywhere along it.
    radius = 0.1 * random.uniform()
    body = {"payload": KNOWN_PAYLOAD, "payload_inertia": KNOWN_PAYLOAD * radius**2}
    body["payload_offset"] = 3**0.5 * radius * random.uniform(-1.0, 1.0)
    plans = [
        Plan(RecordingEntry("quiet.csv", "quiet", "train")),
        Plan(RecordingEntry("drive_small_1.csv", "driven", "train", repeat="drive_small"), small),
        Plan(RecordingEntry("drive_small_2.csv", "driven", "train", repeat="drive_small"), small),
        Plan(RecordingEntry("drive_large.csv", "driven", "train"), large),
        Plan(RecordingEntry("chirp.csv", "driven", "train"), _chirp(setting, random)),
        Plan(RecordingEntry("drive_payload.csv", "driven", "train", **body), loaded),
        Plan(RecordingEntry("slew.csv", "driven", "holdout"), _slew(setting, random)),
        Plan(RecordingEntry("drive_other.csv", "driven", "holdout"), other),
    ]
    if reference:
        plans += [
            Plan(RecordingEntry("reference_small.csv", "driven", "train", condition="reference"), small),
            Plan(RecordingEntry("reference_large.csv", "driven", "train", condition="reference"), large),
        ]
    return plans


def _clamped_plans(setting: Setting, random: np.random.Generator, reference: bool) -> list[Plan]:
    def decay(file: str, role: str, *amplitudes: float, condition: str | None = None) -> Plan:
        drawn = tuple(float(setting.drive * size * random.uniform(0.85, 1.15)) for size in amplitudes)
        return Plan(RecordingEntry(file, "decay", role, condition=condition), None, drawn)

    plans = [
        Plan(RecordingEntry("quiet.csv", "quiet", "train")),
        decay("first_mode.csv", "train", 0.10, 0.003),
        decay("small.csv", "train", 0.03, 0.008),
        decay("second_mode.csv", "train", 0.02, -0.02, 0.002),
        decay("both_modes.csv", "holdout", 0.065, -0.013),
        decay("large.csv", "holdout", 0.14, 0.01),
    ]
    if reference:
        plans += [
            decay("reference_large.csv", "train", 0.10, 0.004, condition="reference"),
            decay("reference_small.csv", "train", 0.03, -0.012, condition="reference"),
        ]
    return plans


def _sines(setting: Setting, random: np.random.Generator, sizes: tuple[float, ...], rates: tuple[float, ...]) -> Torque:
    """A sum of sines (N m, Hz) that fades in within a quarter of a second."""
    amplitudes = setting.drive * np.array(sizes) * random.uniform(0.85, 1.15, len(sizes))
    pulsations = 2.0 * np.pi * setting.speed * np.array(rates) * random.uniform(0.92, 1.08, len(rates))
    # The slowest wave starts near zero, which keeps the arm from turning round and round.
    phases = np.append(random.uniform(0.2, 0.6), random.uniform(0.0, 2.0 * np.pi, len(sizes) - 1))

    def torque(time: Array) -> Array:
        waves = np.sin(np.multiply.outer(time, pulsations) + phases) @ amplitudes
        return np.asarray(waves * np.clip(4.0 * time, 0.0, 1.0))

    return torque


def _chirp(setting: Setting, random: np.random.Generator) -> Torque:
    """From slow to fast, through the first three modes."""
    size, slow, fast = 0.09 * random.uniform(0.85, 1.15), 0.4 * random.uniform(0.9, 1.1), 14.0
    size, slow, fast = setting.drive * size, setting.speed * slow, setting.speed * fast

    def torque(time: Array) -> Array:
        phase = 2.0 * np.pi * (slow * time + 0.5 * (fast - slow) / setting.duration * time**2)
        return np.asarray(size * np.sin(phase) * (time > 0.0))

    return torque


def _slew(setting: Setting, random: np.random.Generator) -> Torque:
    """There and back with corners, twice, then free."""
    size, rate = setting.drive * 0.15 * random.uniform(0.85, 1.15), 0.45 * random.uniform(0.95, 1.05)
    rate *= setting.speed

    def torque(time: Array) -> Array:
        return np.asarray(size * np.sign(np.sin(2.0 * np.pi * rate * time)) * (time > 0.0) * (time < 2.0 / rate))

    return torque
