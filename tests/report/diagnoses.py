"""Diagnoses put together from the real pieces, without a search: quick to make, and right in every field."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from tests.report.fits import DEMO, _chain
from tests.simulation.integrators import simulate
from vjm.diagnosis.records import Alternative, Candidate, Cause, Diagnosis, Gain, Remaining
from vjm.diagnosis.symptoms import Symptoms
from vjm.effects import (
    BUILTIN,
    ClampCompliance,
    CoulombFriction,
    Effect,
    MarkerOffset,
    TimeOffset,
    TipPayload,
    ViscousFriction,
)
from vjm.experiment.load import load_experiment
from vjm.model.modes import modes
from vjm.records import NO_PAYLOAD, Estimate, Experiment, Link, Recording, RecordingComparison, Rig
from vjm.report.figures.diagnosis import diagnosis_pictures
from vjm.report.figures.panels import Picture
from vjm.simulation.arm import Arm
from vjm.simulation.model import Model

Array = NDArray[np.float64]

PAYLOAD = TipPayload(link=0, mass=0.0133)
CLAMP = ClampCompliance(link=0, compliance=0.011)
FRICTION = CoulombFriction(link=0, torque=7.4e-3)
VISCOUS = ViscousFriction(link=0, coefficient=0.03)
DELAY = TimeOffset(delay=0.012)
NOISE = 3e-4, 1e-4


def payload_experiment(effects: tuple[Effect, ...]) -> tuple[Experiment, Model]:
    """The demo's rig and recordings, its beam carrying effects, and that beam without them."""
    given = load_experiment(DEMO)
    base = Model(_chain(given.rig, 4, 1.0388, 3e-4), given.rig, *NOISE, _estimates(given.rig))
    return _moved(given, base, effects, {each.file: _bent(base, each) for each in given.recordings}), base


def hub_experiment(effects: tuple[Effect, ...]) -> tuple[Experiment, Model]:
    """A driven steel link with effects on it, three recordings, and the link without them."""
    link = Link("beam", "revolute", 1.0, 0.44, 1.9, (0.2, 0.4, 0.6, 0.8, 1.0), hub_inertia=0.02)
    rig = Rig("steel link on a hub", (link,), (0.0, 0.0), *NOISE)
    recordings = tuple(_drive(rig, number) for number in range(3))
    base = Model(_chain(rig, 4, 1.0, 3e-4), rig, *NOISE, _estimates(rig))
    at_rest = np.zeros(2 * base.chain.size)
    return _moved(Experiment(rig, recordings), base, effects, {each.file: at_rest for each in recordings}), base


def _drive(rig: Rig, number: int) -> Recording:
    time = np.arange(0, 3.0, 0.005)
    sweep = np.sin(2 * np.pi * (0.4 + 0.15 * number) * time) + 0.5 * np.sin(2 * np.pi * (1.3 + 0.2 * number) * time)
    tau = 0.03 * (1 + 0.3 * number) * sweep[:, None]
    role = "holdout" if number == 2 else "train"
    unknown = np.zeros((time.size, 5, 2))  # until it is simulated
    return Recording(time, unknown, np.zeros((time.size, 1)), tau, kind="driven", role=role, file=f"drive_{number}.csv")


def _bent(model: Model, recording: Recording) -> Array:
    """A first state for a decay: bent, and at rest; the second mode as well in half of the recordings."""
    n = model.chain.size
    shape = 0.05 * np.ones(n) if recording.kind != "quiet" else np.zeros(n)
    return np.concatenate([shape * (1 + 0.6 * np.cos(3 * np.arange(n)) * ("both" in recording.file)), np.zeros(n)])


def _moved(experiment: Experiment, base: Model, effects: tuple[Effect, ...], states: dict[str, Array]) -> Experiment:
    """The recordings as an arm with effects would have made them, with noise; frames every 0.01 s or as they were."""
    arm, made = Arm.of(base.chain, effects), []
    for k, recording in enumerate(experiment.recordings):
        noise = np.random.default_rng(k)
        more = arm.chain.size - base.chain.size
        q, v = np.split(states[recording.file], 2)
        q, v = (np.concatenate([each[:0], np.zeros(more), each]) for each in (q, v))
        motion = simulate(arm, base.rig, recording, q, v)
        markers = motion.markers + NOISE[0] * noise.standard_normal(motion.markers.shape)
        if recording.theta.size:
            markers[1::2] = np.nan  # the camera is half as fast
        theta = motion.theta + NOISE[1] * noise.standard_normal(motion.theta.shape)
        made.append(replace(recording, markers=markers, theta=theta))
    return replace(experiment, recordings=tuple(made))


def _estimates(rig: Rig) -> tuple[Estimate, ...]:
    known = ((f"{rig.links[0].name}.bending_stiffness", 1.974, 3e-4, "N m^2"),)
    return tuple(Estimate(*each) for each in known)


def followed_by(
    experiment: Experiment, base: Model, model: Model, next_best: Model | None
) -> tuple[RecordingComparison, ...]:
    """Every recording, replayed by all models."""
    before = [base.replay(recording) for recording in experiment.recordings]
    after = [model.replay(recording) for recording in experiment.recordings] if model.effects else before
    other = [None if next_best is None else next_best.replay(recording) for recording in experiment.recordings]
    return tuple(
        RecordingComparison(recording, NOISE, *simulated)
        for recording, *simulated in zip(experiment.recordings, after, before, other, strict=True)
    )


def candidates(experiment: Experiment, found: tuple[Effect, ...]) -> tuple[Candidate, ...]:
    """What a screen would say of every built-in effect; the ones found first."""
    rig, recordings = experiment.rig, experiment.recordings
    present = {each.id: each for each in found}
    listed = []
    for k, effect in enumerate(sorted(BUILTIN, key=lambda each: each.id not in present)):
        reason = effect.untestable(rig, recordings)
        variant = next(iter(effect.variants(rig, recordings)), effect)
        if reason:
            listed.append(Candidate(variant, None, None, {}, {}, reason))
            continue
        sizes = {each.name: each.typical_magnitude for each in variant.parameters if not each.shape_parameter}
        z = 400.0 / (1 + k) if present else 1.0 + 0.05 * k
        p = 1e-300 if z > 10 else 0.8
        named = present.get(effect.id, variant).values
        guessed = {name: named[name] if np.isfinite(named[name]) else value for name, value in sizes.items()}
        listed.append(Candidate(variant, z, p, guessed, {name: 0.05 * value for name, value in sizes.items()}))
    return tuple(sorted(listed, key=lambda each: not each.testable))


def cause(effect: Effect, alternatives: tuple[Alternative, ...] = ()) -> Cause:
    """An effect with a standard error of a hundredth."""
    sizes = {}
    for each in effect.parameters:
        value = float(effect.values[each.name])
        sizes[each.name] = Estimate(each.name, value, None if each.integer else 0.01 * abs(value), each.unit)
    words = "training residual falls from 7.30 to 1.00 × noise"
    return Cause(effect, sizes, 1e-300, 4.1e4, alternatives, words)


def make_diagnosis(
    experiment: Experiment, base: Model, effects: tuple[Effect, ...], other: tuple[Effect, ...] = (), **changes: object
) -> Diagnosis:
    """A diagnosis that found these effects, the next best explanation being others."""
    model = replace(base, effects=effects)
    next_best = replace(base, effects=other) if other else None
    followed = followed_by(experiment, base, model, next_best)
    shown = [each.reference for each in followed if each.reference is not None]
    payloads = {NO_PAYLOAD} | {each.recording.payload_body for each in shown}
    held_out = [each for each in followed if each.recording.role == "holdout"]
    rms = [_rms(held_out, name) for name in ("reference", "simulated", "alternative")]
    gain = None
    if rms[0] is not None and rms[1] is not None:
        less = 1 - rms[1] / rms[0]
        gain = Gain(rms[0], rms[1], NOISE[0], less, (less - 0.02, min(less + 0.02, 0.999)), rms[2])
    made = Diagnosis(
        experiment=experiment,
        verdict="named" if effects else "none",
        causes=tuple(cause(each) for each in effects),
        candidates=candidates(experiment, effects),
        model=model,
        reference=base,
        recordings=followed,
        gain=gain,
        remaining=Remaining(0.4),
        symptoms=Symptoms.of(
            base.rig, shown, {each: modes(base.chain, each).frequencies[:2].tolist() for each in payloads}
        ),
        next_experiment=None,
        noise="from the experiment file, and what the quiet recording shows agrees",
        next_best=other,
        notes=("the chain has 4 virtual joints",),
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def _rms(followed: list[RecordingComparison], name: str) -> float | None:
    found = [getattr(each, name) for each in followed]
    if not found or any(each is None for each in found):
        return None
    return float(np.sqrt(np.mean([each.marker_rms**2 for each in found])))


@cache
def named() -> Diagnosis:
    """Viscous friction at a driven joint, the runner-up being a late camera."""
    experiment, base = hub_experiment((VISCOUS,))
    return make_diagnosis(experiment, base, (VISCOUS,), (DELAY,))


@cache
def pair() -> Diagnosis:
    """A late camera and a marker that is off."""
    effects = (DELAY, MarkerOffset(link=0, marker=3, along=4e-3, across=-6e-3, columns=(0, 1, 2, 3, 4)))
    experiment, base = hub_experiment(effects)
    return make_diagnosis(experiment, base, effects)


@cache
def undecided() -> Diagnosis:
    """A mass on the tip of a clamped beam, or a compliant clamp."""
    experiment, base = payload_experiment((PAYLOAD,))
    return make_diagnosis(
        experiment,
        base,
        (PAYLOAD,),
        (CLAMP,),
        verdict="set",
        causes=(cause(PAYLOAD, (Alternative(CLAMP, 0.7),)),),
        next_experiment="to distinguish tip payload from clamp compliance: record a decay with a known mass on the tip",
    )


@cache
def unknown() -> Diagnosis:
    """Something that no candidate explains."""
    experiment, base = payload_experiment((PAYLOAD,))
    looks = "most of it in the camera of both_modes.csv, between 5 and 9 Hz; odd in the velocity of the tip"
    return make_diagnosis(
        experiment,
        base,
        (),
        verdict="unknown",
        remaining=Remaining(1e-40, looks),
        next_experiment='record the arm at rest (kind = "quiet"): what is there without motion comes from outside',
    )


@cache
def nothing() -> Diagnosis:
    """A beam that is as it should be."""
    return make_diagnosis(*payload_experiment(()), ())


@cache
def insufficient() -> Diagnosis:
    """Recordings that cannot support a statement."""
    found = nothing()
    why = "no recording is held out, so that nothing could confirm a cause"
    return replace(
        found, verdict="insufficient", gain=None, remaining=Remaining(None), warnings=(why,), next_experiment=why
    )


DIAGNOSES = {
    "named": named,
    "pair": pair,
    "undecided": undecided,
    "unknown": unknown,
    "nothing": nothing,
    "insufficient": insufficient,
}


def pictures_of(diagnosis: Diagnosis) -> list[Picture]:
    """The pictures of one of these diagnoses, drawn once."""
    if id(diagnosis) not in _DRAWN:
        _DRAWN[id(diagnosis)] = diagnosis_pictures(diagnosis)
    return _DRAWN[id(diagnosis)]


_DRAWN: dict[int, list[Picture]] = {}
