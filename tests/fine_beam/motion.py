"""Simulated motions of a beam with hidden physics, several recordings at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import root

from tests.fine_beam.beam import NO_BODY, Beam, Body
from tests.fine_beam.extended import Extended
from tests.fine_beam.hidden import Physics
from tests.fine_beam.stepper import Drive, Stepper

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Run:
    """One recording to simulate.

    Attributes:
        torque: true torque at the joint at each instant, N m, (T,); None: zero. Before t = 0 the joint is held.
        tip_amplitudes: of vibration modes at the start, m of transverse tip motion.
        payload: on the tip, on top of the beam's own.
        held: the joint is held still throughout, by a constant torque (`Motion.hold`), and no tip_amplitudes.
        theta: joint angle at the start, rad.
        push: what is added to coordinates and rates at the start, (2 n,); None: nothing.
    """

    torque: Array | None = None
    tip_amplitudes: tuple[float, ...] = ()
    payload: Body = NO_BODY
    held: bool = False
    theta: float = 0.0
    push: Array | None = None


@dataclass(frozen=True)
class Motion:
    """What became of a run: time in s (T,), coordinates (T, n) and rates (T, n) of the extended beam.

    Attributes:
        hold: torque at the joint that keeps the initial equilibrium, N m.
        states: all states, (T, d), internal ones last.
    """

    beam: Extended = field(repr=False)
    time: Array
    states: Array
    hold: float

    @property
    def coordinates(self) -> Array:
        """(T, n)."""
        return self.states[:, self.beam.parts.coordinates]

    @property
    def rates(self) -> Array:
        """(T, n)."""
        return self.states[:, self.beam.parts.rates]

    @property
    def theta(self) -> Array:
        """Angle that an encoder sees, the motor's, rad, (T,)."""
        return self.coordinates[:, 0] if self.beam.revolute else np.zeros(len(self.time))

    def at(self, time: Array) -> Motion:
        """The same motion at other instants inside its span, by cubic Hermite interpolation; no internal states."""
        if np.min(time) < self.time[0] - 1e-9 or np.max(time) > self.time[-1] + 1e-9:
            raise ValueError(f"asked outside the simulated span {self.time[0]:g} s to {self.time[-1]:g} s")
        spline = CubicHermiteSpline(self.time, self.coordinates, self.rates)
        return replace(self, time=np.asarray(time), states=np.hstack([spline(time), spline(time, 1)]))

    def positions(self, arc_lengths: Sequence[float] | Array, across: Sequence[float] | Array | None = None) -> Array:
        """Positions, m, (T, k, 2), of points at arc lengths, m, and distances from the centre line to the left, m.

        Beyond its end the link goes on straight.
        """
        basis, arcs = self.beam.basis, np.asarray(arc_lengths, dtype=float)
        sides = np.zeros(len(arcs)) if across is None else np.asarray(across, dtype=float)
        inside = np.minimum(arcs, basis.length)
        angle = self.coordinates @ self.beam.heading.T + self.beam.arc
        rows = basis.integrals_to(inside)
        points = rows @ np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        if np.any(inside < arcs) or np.any(sides):
            turning = self.coordinates[:, : self.beam.bending.start] @ self.beam.tip_heading[: self.beam.bending.start]
            bent = self.coordinates[:, self.beam.bending] @ (rows @ basis.curvature).T
            here = turning[:, None] + bent + self.beam.physics.rest_curvature_curvature * inside
            tangent, normal = _directions(here)
            points = points + (arcs - inside)[:, None] * tangent + sides[:, None] * normal
        if self.beam.physics.has_table:
            points = points + self.coordinates[:, -1:, None] * self.beam.slide
        return np.asarray(points)


def _directions(angle: Array) -> tuple[Array, Array]:
    """Unit vectors along and to the left of an angle (...), (..., 2) each."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine, sine], axis=-1), np.stack([-sine, cosine], axis=-1)


def simulate_runs(
    beam: Beam, physics: Physics, time: Array, runs: Sequence[Run], step: float | None = None, size: int = 8
) -> list[Motion]:
    """Integrate runs together, each from the equilibrium with its joint held, plus its vibration modes.

    Args:
        beam: the link.
        physics: what is hidden.
        time: increasing instants, s, (T,), zero at the recordings' start; before it the joint is held by a torque.
        runs: the recordings.
        step: longest step, s; None: what the physics ask for.
        size: number of bending functions.
    """
    extended = _extended(beam, physics, runs, size)
    equilibria = [_equilibrium(beam, physics, [run, *runs], size) for run in runs]
    holds = np.array([hold for _, hold in equilibria])
    state = np.zeros((len(runs), extended.dimension))
    for k, (run, (coordinates, _)) in enumerate(zip(runs, equilibria, strict=True)):
        state[k, extended.parts.coordinates] = coordinates + _modal(extended, int(extended.group[k]), run)
        if run.push is not None:
            state[k, : 2 * extended.size] += run.push
    if physics.hysteresis_ratio:
        yields = physics.hysteresis_yield_angle / beam.length
        bend = state[:, extended.parts.coordinates] @ extended.curvature.T
        # Bent from straight to there without a reversal.
        state[:, extended.parts.slip] = np.sign(bend) * yields * (1.0 - np.exp(-np.abs(bend) / yields))
    drive = _drive(time, runs, holds)
    state[:, extended.parts.torque] = drive.start[0, :, None]
    states = Stepper(extended).run(time, drive, state, physics.step if step is None else step)
    # Each of a beam in the functions of all, its own payload first.
    return [
        Motion(_extended(beam, physics, [run, *runs], size), time, states[:, k], float(holds[k]))
        for k, run in enumerate(runs)
    ]


def _extended(beam: Beam, physics: Physics, runs: Sequence[Run], size: int) -> Extended:
    """The beam with the runs' payloads."""
    return Extended(beam, physics, [run.payload for run in runs], size, max(2 * size, physics.nodes))


def _drive(time: Array, runs: Sequence[Run], holds: Array) -> Drive:
    """True torques; they jump at t = 0, where the joint is let go."""
    driven = [np.zeros(len(time)) if run.torque is None else run.torque for run in runs]
    held = np.array([run.held for run in runs])
    torques = np.where(held, holds, np.stack(driven, axis=1))
    before = time < -1e-9
    start = np.where(before[:-1, None], holds, torques[:-1])
    end = np.where(before[:-1, None], holds, torques[1:])
    return Drive(start, end)


def _modal(beam: Extended, k: int, run: Run) -> Array:
    """Coordinates (n,) of a run's vibration modes, of the arm on a base that stands still."""
    shapes = beam.modes_on_ground(k)
    chosen = shapes[:, : len(run.tip_amplitudes)]
    to_tip = beam.basis.weights @ beam.heading
    return np.asarray(chosen @ (np.array(run.tip_amplitudes) / (to_tip @ chosen)))


def _equilibrium(beam: Beam, physics: Physics, runs: Sequence[Run], size: int) -> tuple[Array, float]:
    """Coordinates (n,) at rest with the joint of the first run held at its theta, and the torque that holds it, N m.

    The tone, the friction and the slip are left out: they hold nothing.
    """
    calm = replace(physics, external_tone_amplitude=0.0, hysteresis_ratio=0.0)
    single, run = _extended(beam, calm, runs, size), runs[0]
    first = int(single.revolute)

    def forces(coordinates: Array) -> Array:
        state = np.zeros((len(runs), single.dimension))
        state[0, single.parts.coordinates] = coordinates
        balance: Array = single.forces(state, 0.0, np.zeros(len(runs)), single.fields(state))[0]
        return balance

    def residual(free: Array) -> Array:
        return forces(np.concatenate([[run.theta][:first], free]))[first:]

    start = np.zeros(single.size - first)
    if single.motor:
        start[0] = run.theta
    if np.max(np.abs(residual(start))) > 1e-12:
        start = _solve(residual, start, 0.5 * physics.backlash_gap if single.motor else 0.0)
    coordinates = np.concatenate([[run.theta][:first], start])
    return coordinates, -float(forces(coordinates)[0]) if first else 0.0


def _solve(residual: Callable[[Array], Array], start: Array, play: float) -> Array:
    """Zero of the residual; a hub with play is tried on either flank."""
    for side in (0.0,) if play == 0.0 else (1.02, -1.02):
        guess = start.copy()
        guess[0] += side * play
        found = root(residual, guess, tol=1e-13)
        if np.max(np.abs(found.fun)) < 1e-9:
            return np.asarray(found.x)
    raise ArithmeticError("no equilibrium found")
