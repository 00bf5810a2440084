"""Trajectories written down, not simulated: sums of decaying sinusoids, with one thing wrong whose size is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.symptoms import Symptom, Symptoms
from vjm.records import NO_PAYLOAD, Link, Recording, Rig, SimulatedRecording, Simulation

Array = NDArray[np.float64]
Change = Callable[[Array, Array, Array], tuple[Array, Array]]

FREQUENCIES = (1.2, 7.5)
NOISE = 3e-4, 1e-4  # of markers [m] and encoder [rad]
ARCS = np.array([0.2, 0.4, 0.6, 0.8, 1.0])
INERTIA = 0.02
LINK = Link("beam", "revolute", 1.0, 0.44, 1.9, tuple(ARCS.tolist()), hub_inertia=INERTIA)
RIG = Rig("arm", (LINK,), (0.0, 0.0), *NOISE)
CLAMPED = Rig("beam", (replace(LINK, joint="clamped", hub_inertia=0.0),), (0.0, 0.0), NOISE[0])
_SHAPES = np.array([ARCS**2, ARCS**2 * (3.6 - 4.6 * ARCS)])  # of the deflection, mode by mode
_TURNS = np.array([-0.6, 0.5])  # of the joint, in each mode


@dataclass(frozen=True)
class Motion:
    """How the arm moves.

    Attributes:
        amplitudes: of the two modes [m].
        frequencies: of the two modes [Hz].
        decays: of the two modes [1/s].
        phases: of the two modes [rad].
        slew: amplitude [rad] and frequency [Hz] of a slow motion of the joint.
        hardening: by how much the first mode swings faster at its largest amplitude, relative, going with the square.
        drag: by how much faster the first mode decays at its largest amplitude [1/s].
    """

    amplitudes: tuple[float, float] = (0.08, 0.01)
    frequencies: tuple[float, float] = FREQUENCIES
    decays: tuple[float, float] = (0.15, 0.5)
    phases: tuple[float, float] = (0.4, 1.4)
    slew: tuple[float, float] = (0.3, 0.3)
    hardening: float = 0.0
    drag: float = 0.0

    def modes(self, t: Array) -> Array:
        """(T, 2) [m]."""
        parts = []
        for m, (a, f, d, phase) in enumerate(
            zip(self.amplitudes, self.frequencies, self.decays, self.phases, strict=True)
        ):
            size, more = np.exp(-d * t), np.zeros_like(t)
            if m == 0:
                size = size / (1 + self.drag * (1 - np.exp(-d * t)) / d)  # a' = -d a - drag a^2
                more = self.hardening * (1 - np.exp(-2 * d * t)) / (2 * d)
            parts.append(a * size * np.cos(2 * np.pi * f * (t + more) + phase))
        return np.stack(parts, axis=1)

    def theta(self, t: Array) -> Array:
        """(T, 1) [rad]."""
        slow = self.slew[0] * np.sin(2 * np.pi * self.slew[1] * t)
        return np.asarray((slow + self.modes(t) @ _TURNS)[:, None])

    def markers(self, t: Array, clamped: bool = False) -> Array:
        """(T, 5, 2) [m]: on a rail that the joint shifts, or, clamped, on a beam."""
        across = self.modes(t) @ _SHAPES
        if clamped:
            return np.stack([np.broadcast_to(ARCS, across.shape), across], axis=2)
        cosine, sine = np.cos(self.theta(t)), np.sin(self.theta(t))
        return np.stack([cosine * ARCS - sine * across, sine * ARCS + cosine * across], axis=2)


MOTION = Motion()
STILL = Motion(amplitudes=(0.0, 0.0), slew=(0.0, 0.45))


def simulated(
    seed: int,
    truth: Motion = MOTION,
    model: Motion = MOTION,
    *,
    file: str = "drive.csv",
    kind: Any = "driven",
    clamped: bool = False,
    duration: float = 5.0,
    rate: float = 500.0,
    frames: int = 5,
    lag: float = 0.0,
    clock: float = 1.0,
    change: Change | None = None,
    noise: Callable[[np.random.Generator, Array], Array] | None = None,
) -> SimulatedRecording:
    """A recording of `truth`, simulated by `model`.

    Args:
        seed: of the noise.
        truth: how the arm moves.
        model: how the model thinks that it moves.
        file: name.
        kind: of the recording.
        clamped: without a joint.
        duration: [s].
        rate: of the encoder [Hz].
        frames: the camera takes every so many of the encoder's instants.
        lag: of the camera [s].
        clock: how fast the camera's time runs.
        change: what is further wrong: of time, markers and angles, returns the two.
        noise: noise of size one instead of white noise, given an array of its shape.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration * rate)) / rate
    markers, theta = truth.markers((t - lag) / clock, clamped), truth.theta(t)
    if change is not None:
        markers, theta = change(t, markers, theta)
    draw = noise or (lambda generator, like: generator.standard_normal(like.shape))
    seen = np.arange(t.size) % frames == 0
    shown = markers[seen] + NOISE[0] * draw(rng, markers[seen])
    shown[rng.random(shown.shape[:2]) < 0.03] = np.nan  # hidden for a moment
    markers = np.full_like(markers, np.nan)
    markers[seen] = shown
    theta = np.empty((t.size, 0)) if clamped else theta + NOISE[1] * draw(rng, theta)
    torque = 0.1 * np.sin(2 * t[:, None]) * (kind == "driven") * np.ones_like(theta)
    recording = Recording(t, markers, theta, torque, kind=kind, role="train", file=file)
    angle = np.empty((t.size, 0)) if clamped else model.theta(t)
    state = np.empty((t.size, 0))
    simulation = Simulation(t, state, state, angle, model.markers(t, clamped))
    return SimulatedRecording(recording, simulation, NOISE, "converged")


def found(*recordings: SimulatedRecording) -> Symptoms:
    """The symptoms of recordings, at the two modes' frequencies."""
    clamped = any(one.simulation.theta.shape[1] == 0 for one in recordings)
    return Symptoms.of(CLAMPED if clamped else RIG, recordings, {NO_PAYLOAD: FREQUENCIES})


def the(result: Symptoms, kind: str, sensor: str | None = None, mode: int | None = None) -> Symptom:
    """The largest symptom of a kind, of a sensor or a mode where these are given."""
    return next(
        symptom
        for symptom in result.found
        if symptom.kind == kind and sensor in (None, symptom.sensor) and mode in (None, symptom.mode)
    )


def assert_found(result: Symptoms, symptom: Symptom, truth: float, relative: float = 0.1) -> None:
    """Check that it is put into words, and that its value is right within its error, which is not too large."""
    assert symptom in result.significant, symptom
    assert abs(symptom.value - truth) < 4 * symptom.std, symptom
    assert symptom.std < relative * abs(truth), symptom


def kinds(result: Symptoms) -> set[str]:
    """Of those that are put into words."""
    return {symptom.kind for symptom in result.significant}
