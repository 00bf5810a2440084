"""Experiment folders with something hidden in them, and apart from them what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam import (
    Faults,
    Frames,
    Motion,
    Physics,
    RecordingEntry,
    Run,
    film,
    shown_angle,
    shown_markers,
    simulate_runs,
    write_experiment,
    write_recording,
)
from tests.fine_beam.hidden import fields_of, is_mechanical
from tests.hidden.plans import Plan, plans_of
from tests.hidden.settings import Rig, Setting, Units, setting_of
from tests.hidden.severities import Planted, written

if TYPE_CHECKING:
    from tests.hidden.two_links import TwoLinkSetting

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Conditions:
    """How recordings are made.

    Attributes:
        noise_correlation: of the camera's noise from frame to frame.
        outliers: share of marker sightings that are wrong by centimetres.
        dropped_frames: share of frames lost.
        reference: two more recordings, in which nothing is hidden.
        noise: of camera and encoder, over that of the setting.
    """

    noise_correlation: float = 0.0
    outliers: float = 0.0
    dropped_frames: float = 0.0
    reference: bool = False
    noise: float = 1.0


PLAIN = Conditions()


@dataclass(frozen=True)
class Truth:
    """What is true of an experiment folder.

    Attributes:
        rig: its kind.
        seed: that drew it.
        effects: what is hidden, in the units of the recordings.
        setting: arm and sensors.
        noise_rms: RMS between the markers as written and as a perfect model would show them, m, by file.
        right_rms: the same without the outliers.
    """

    rig: Rig
    seed: int
    effects: tuple[Planted, ...]
    setting: Setting | TwoLinkSetting
    noise_rms: dict[str, float]
    right_rms: dict[str, float]


@dataclass(frozen=True)
class Shown:
    """One recording without noise.

    Attributes:
        plan: what is recorded.
        frames, markers: time stamps in s (f,) and markers in m (f, k, 2).
        samples, angle, torque: times in s (e,), the encoder's angle in rad (e,), the recorded torque in N m (e,).
    """

    plan: Plan
    frames: Array
    markers: Array
    samples: Array
    angle: Array
    torque: Array


def physics_of(effects: Sequence[Planted]) -> tuple[Physics, Faults]:
    """What several effects make of an arm and of its sensors."""
    mechanical: dict[str, Any] = {}
    sensory: dict[str, Any] = {}
    for each in effects:
        (mechanical if is_mechanical(each.effect) else sensory).update(fields_of(each.effect, each.parameters))
    whole = ("marker_offset_marker", "timestamp_jitter_seed")
    sensory |= {name: int(sensory[name]) for name in whole if name in sensory}
    return Physics(**mechanical), Faults(**sensory)


def perform(rig: Rig, effects: Sequence[Planted], seed: int, reference: bool = False) -> list[Shown]:
    """What perfect sensors, but for their hidden faults, would have recorded of an experiment, in the plans' order."""
    shown = _perform(rig, *physics_of(effects), seed, reference=False)
    return [*shown, *_perform(rig, *physics_of(()), seed, reference=True)] if reference else [*shown]


@lru_cache(maxsize=8)  # several tests look at the same experiment, each in its own way
def _perform(rig: Rig, physics: Physics, faults: Faults, seed: int, reference: bool) -> tuple[Shown, ...]:
    """The same of the recordings in the reference condition, or of the others."""
    setting = setting_of(rig, seed)
    plans = [plan for plan in plans_of(setting, seed, reference) if (plan.entry.condition == "reference") is reference]
    return tuple(perform_plans(setting, physics, faults, plans))


def perform_plans(
    setting: Setting, physics: Physics, faults: Faults, plans: Sequence[Plan], push: Array | None = None
) -> list[Shown]:
    """The same of recordings with the same things hidden; repeats are one motion.

    `push` is added to coordinates and rates at every start, (2 n,).
    """
    rate = setting.encoder.rate
    physics = replace(physics, marker_mass_arcs=setting.markers)
    margin = int(np.ceil(faults.margin(setting.duration, setting.beam.length) * rate - 1e-9))
    time = np.arange(-margin, round(setting.duration * rate) + margin + 1) / rate
    distinct = {plan.entry.repeat or plan.entry.file: plan for plan in plans}
    runs = [_run(plan, physics, time, push) for plan in distinct.values()]
    found = dict(zip(distinct, simulate_runs(setting.beam, physics, time, runs), strict=True))
    return [
        _show(setting, plan, found[plan.entry.repeat or plan.entry.file], physics, faults, k)
        for k, plan in enumerate(plans)
    ]


def _run(plan: Plan, physics: Physics, time: Array, push: Array | None) -> Run:
    torque = None
    if plan.torque is not None:
        torque = physics.torque_gain_gain * plan.torque(time) + physics.torque_offset_offset
    held = plan.entry.kind == "quiet"
    return Run(torque, plan.tip_amplitudes, plan.entry.body, held=held, push=push)


def _show(setting: Setting, plan: Plan, motion: Motion, physics: Physics, faults: Faults, number: int) -> Shown:
    stamps = np.arange(round(setting.duration * setting.camera.rate) + 1) / setting.camera.rate
    samples = np.arange(round(setting.duration * setting.encoder.rate) + 1) / setting.encoder.rate
    if plan.torque is None:
        torque = np.full(len(samples), (motion.hold - physics.torque_offset_offset) / physics.torque_gain_gain)
        torque = torque if plan.entry.kind == "quiet" else np.zeros(len(samples))
    else:
        torque = plan.torque(samples)
    markers = shown_markers(motion, stamps, setting.markers, faults, number)
    return Shown(plan, stamps, markers, samples, shown_angle(motion, samples, faults), torque)


def write_hidden(
    folder: Path, rig: Rig, effects: Sequence[Planted], seed: int, conditions: Conditions = PLAIN
) -> Truth:
    """Write an experiment into a folder; the truth is in nothing but what is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    setting = setting_of(rig, seed)
    camera = replace(
        setting.camera,
        noise=conditions.noise * setting.camera.noise,
        noise_correlation=conditions.noise_correlation,
        outliers=conditions.outliers,
        dropped_frames=conditions.dropped_frames,
    )
    encoder = replace(setting.encoder, noise=conditions.noise * setting.encoder.noise)
    setting, units, beam = replace(setting, camera=camera, encoder=encoder), setting.units, setting.beam
    shown = perform(rig, effects, seed, conditions.reference)
    noise = {each.plan.entry.file: _write(folder, setting, each, 1000 * seed + k) for k, each in enumerate(shown)}
    link: dict[str, Any] = {"name": "beam", "joint": beam.joint, "length": units.length * beam.length}
    link |= {"mass": units.mass * beam.mass, "markers": [units.length * arc for arc in setting.markers]}
    powers = {"bending_stiffness": (3, 1, -2), "hub_inertia": (2, 1, 0)}
    link |= {key: units.of(*powers[key]) * value for key, value in setting.nominal.items()}
    link |= {"hub_radius": units.length * beam.hub_radius} if beam.hub_radius else {}
    sensors = {"marker_noise": units.length * camera.noise}
    sensors |= {"encoder_noise": setting.encoder.noise} if setting.turns else {}
    entries = [_written(each.plan.entry, units) for each in shown]
    write_experiment(folder / "experiment.toml", f"{rig} rig", link, sensors, entries)
    every, right = ({file: pair[k] for file, pair in noise.items()} for k in (0, 1))
    return Truth(rig, seed, tuple(written(each, units) for each in effects), setting, every, right)


def _written(entry: RecordingEntry, units: Units) -> RecordingEntry:
    if entry.payload is None:
        return entry
    mass, offset, inertia = entry.body
    return replace(
        entry,
        payload=units.mass * mass,
        payload_offset=units.length * offset,
        payload_inertia=units.of(2, 1, 0) * inertia,
    )


def _write(folder: Path, setting: Setting, shown: Shown, seed: int) -> tuple[float, float]:
    """Write one recording with its noise; returns the RMS of the markers' noise with and without outliers, m."""
    camera, units = setting.camera, setting.units
    frames = film(shown.frames, shown.markers, camera, seed)
    path = folder / shown.plan.entry.file
    scaled = Frames(units.time * frames.time, units.length * frames.markers)
    decimals = 6 - min(0, int(np.floor(np.log10(units.length))))
    if setting.turns:
        noise = np.random.default_rng([seed, 5]).standard_normal(len(shown.samples))
        time, angle = units.time * shown.samples, shown.angle + setting.encoder.noise * noise
        write_recording(path, "beam", scaled, (time, angle), (time, units.torque * shown.torque), decimals)
    else:
        write_recording(path, "beam", scaled, decimals=decimals)
    kept = np.isin(shown.frames, frames.time)
    right = film(shown.frames, shown.markers, replace(camera, outliers=0.0), seed).markers
    errors = frames.markers - shown.markers[kept], right - shown.markers[kept]
    every, typical_magnitude = (units.length * float(np.sqrt(np.mean(error**2))) for error in errors)
    return every, typical_magnitude
