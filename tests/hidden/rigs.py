"""Experiment folders with something hidden in them, and apart from them what it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam import (
    Beam,
    Camera,
    Encoder,
    Faults,
    Motion,
    Physics,
    Run,
    film,
    shown_angle,
    shown_markers,
    simulate_runs,
    write_experiment,
    write_recording,
)
from tests.fine_beam.hidden import fields_of, is_mechanical
from tests.hidden.plans import DURATION, Plan, Rig, plans_of
from tests.hidden.severities import Planted

Array = NDArray[np.float64]

MARKERS = [0.2, 0.4, 0.6, 0.8, 1.0]
CAMERA = Camera(rate=100.0, noise=3e-4)
ENCODER = Encoder(rate=500.0, noise=1e-4)
SAMPLES = 500  # of encoder and torque in a second


@dataclass(frozen=True)
class Conditions:
    """How recordings are made.

    Attributes:
        noise_correlation: of the camera's noise from frame to frame.
        outliers: share of marker sightings that are wrong by centimetres.
        dropped_frames: share of frames lost.
        reference: two more recordings, in which nothing is hidden.
    """

    noise_correlation: float = 0.0
    outliers: float = 0.0
    dropped_frames: float = 0.0
    reference: bool = False


PLAIN = Conditions()


@dataclass(frozen=True)
class Truth:
    """What is true of an experiment folder.

    Attributes:
        rig: "hub" or "clamped".
        seed: that drew it.
        effects: what is hidden.
        beam: the link without it.
        noise_rms: RMS between the markers as written and as a perfect model would show them, m, by file.
        right_rms: the same without the outliers.
    """

    rig: Rig
    seed: int
    effects: tuple[Planted, ...]
    beam: Beam
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


def beam_of(rig: Rig, seed: int) -> tuple[Beam, dict[str, float]]:
    """The true link, and what the experiment file says of its stiffness and hub inertia."""
    random = np.random.default_rng([seed, 3])
    stiffness = 1.97 * random.uniform(0.97, 1.03)
    damping, hub = 5e-4 * random.uniform(0.8, 1.25), 0.02 * random.uniform(0.95, 1.05)
    nominal = {"bending_stiffness": float(stiffness * (1.0 + 0.03 * random.standard_normal()))}
    hub_nominal = float(hub * (1.0 + 0.05 * random.standard_normal()))
    beam = Beam(1.0, 0.44, stiffness, damping)
    if rig == "clamped":
        return beam, nominal
    return replace(beam, joint="revolute", hub_inertia=hub), nominal | {"hub_inertia": hub_nominal}


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
    beam, _ = beam_of(rig, seed)
    plans = plans_of(rig, seed, reference)
    shown: dict[str, Shown] = {}
    for hidden, clean in ((effects, False), ((), True)):
        chosen = [plan for plan in plans if (plan.entry.condition == "reference") is clean]
        if chosen:
            shown |= {each.plan.entry.file: each for each in perform_plans(beam, *physics_of(hidden), chosen)}
    return [shown[plan.entry.file] for plan in plans]


def perform_plans(
    beam: Beam, physics: Physics, faults: Faults, plans: Sequence[Plan], push: Array | None = None
) -> list[Shown]:
    """The same of recordings with the same things hidden; repeats are one motion.

    `push` is added to coordinates and rates at every start, (2 n,).
    """
    margin = int(np.ceil(faults.margin(DURATION, beam.length) * SAMPLES - 1e-9))
    time = np.arange(-margin, round(DURATION * SAMPLES) + margin + 1) / SAMPLES
    distinct = {plan.entry.repeat or plan.entry.file: plan for plan in plans}
    motions = simulate_runs(beam, physics, time, [_run(plan, physics, time, push) for plan in distinct.values()])
    found = dict(zip(distinct, motions, strict=True))
    return [
        _show(plan, found[plan.entry.repeat or plan.entry.file], physics, faults, k) for k, plan in enumerate(plans)
    ]


def _run(plan: Plan, physics: Physics, time: Array, push: Array | None) -> Run:
    torque = None
    if plan.torque is not None:
        torque = physics.torque_gain_gain * plan.torque(time) + physics.torque_offset_offset
    held = plan.entry.kind == "quiet"
    return Run(torque, plan.tip_amplitudes, plan.entry.payload or 0.0, held=held, push=push)


def _show(plan: Plan, motion: Motion, physics: Physics, faults: Faults, number: int) -> Shown:
    stamps = np.arange(round(DURATION * CAMERA.rate) + 1) / CAMERA.rate
    samples = np.arange(round(DURATION * SAMPLES) + 1) / SAMPLES
    if plan.torque is None:
        torque = np.full(len(samples), (motion.hold - physics.torque_offset_offset) / physics.torque_gain_gain)
        torque = torque if plan.entry.kind == "quiet" else np.zeros(len(samples))
    else:
        torque = plan.torque(samples)
    markers = shown_markers(motion, stamps, MARKERS, faults, number)
    return Shown(plan, stamps, markers, samples, shown_angle(motion, samples, faults), torque)


def write_hidden(
    folder: Path, rig: Rig, effects: Sequence[Planted], seed: int, conditions: Conditions = PLAIN
) -> Truth:
    """Write an experiment into a folder; the truth is in nothing but what is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = replace(
        CAMERA,
        noise_correlation=conditions.noise_correlation,
        outliers=conditions.outliers,
        dropped_frames=conditions.dropped_frames,
    )
    shown = perform(rig, effects, seed, conditions.reference)
    noise = {each.plan.entry.file: _write(folder, rig, each, camera, 1000 * seed + k) for k, each in enumerate(shown)}
    beam, nominal = beam_of(rig, seed)
    link: dict[str, Any] = {"name": "beam", "joint": beam.joint, "length": beam.length, "mass": beam.mass}
    sensors = {"marker_noise": camera.noise} | ({"encoder_noise": ENCODER.noise} if rig == "hub" else {})
    entries = [each.plan.entry for each in shown]
    write_experiment(folder / "experiment.toml", f"{rig} rig", link | nominal | {"markers": MARKERS}, sensors, entries)
    every, right = ({file: pair[k] for file, pair in noise.items()} for k in (0, 1))
    return Truth(rig, seed, tuple(effects), beam, every, right)


def _write(folder: Path, rig: Rig, shown: Shown, camera: Camera, seed: int) -> tuple[float, float]:
    """Write one recording with its noise; returns the RMS of the markers' noise with and without outliers, m."""
    frames = film(shown.frames, shown.markers, camera, seed)
    path = folder / shown.plan.entry.file
    if rig == "clamped":
        write_recording(path, "beam", frames)
    else:
        noise = np.random.default_rng([seed, 5]).standard_normal(len(shown.samples))
        angle = shown.angle + ENCODER.noise * noise
        write_recording(path, "beam", frames, (shown.samples, angle), (shown.samples, shown.torque))
    kept = np.isin(shown.frames, frames.time)
    right = film(shown.frames, shown.markers, replace(camera, outliers=0.0), seed).markers
    errors = frames.markers - shown.markers[kept], right - shown.markers[kept]
    every, typical_magnitude = (float(np.sqrt(np.mean(error**2))) for error in errors)
    return every, typical_magnitude
