"""The arms that hidden physics are tried on, and what is asked of their motions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tests.fine_beam.beam import Beam
from tests.fine_beam.hidden import Physics
from tests.fine_beam.motion import Motion, Run, simulate_runs

Array = NDArray[np.float64]

MARKERS = [0.2, 0.4, 0.6, 0.8, 1.0]
HUB = Beam(length=1.0, mass=0.44, bending_stiffness=1.97, kelvin_voigt_time=5e-4, joint="revolute", hub_inertia=0.02)
CLAMPED = replace(HUB, joint="clamped", hub_inertia=0.0)
RIGID = replace(HUB, bending_stiffness=2e4, kelvin_voigt_time=1e-5)
INERTIA = 0.02 + 0.44 / 3.0  # of the rigid arm about its joint, kg m^2
TIME = np.arange(501) / 500.0


def drive(time: Array) -> Array:
    """A hub torque, N m, with corners."""
    return np.asarray(0.15 * np.sin(5.0 * time) + 0.05 * np.sign(np.sin(12.0 * time)))


def alone(beam: Beam, physics: Physics, run: Run, time: Array = TIME, step: float | None = None) -> Motion:
    """A run by itself."""
    return simulate_runs(beam, physics, time, [run], step)[0]


def rms(first: Motion, second: Motion) -> float:
    """Between the markers of two motions, m."""
    return float(np.sqrt(np.mean((first.positions(MARKERS) - second.positions(MARKERS)) ** 2)))


def energy(motion: Motion) -> Array:
    """Kinetic and elastic energy, that of Maxwell arms with it, without gravity, J, (T,)."""
    heading, rate = motion.coordinates @ motion.beam.heading.T, motion.rates @ motion.beam.heading.T
    normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    basis, beam = motion.beam.basis, motion.beam.beam
    bodies = motion.beam.bodies[motion.beam.group[0]]
    reaches = [basis.weights + body.offset * np.eye(len(basis.nodes))[-1] for body in bodies]
    velocity = np.vstack([basis.cumulative, *reaches]) @ (rate[..., None] * normal)
    moved = 0.0
    if motion.beam.physics.has_table:
        velocity += motion.rates[:, -1:, None] * motion.beam.slide
        moved = 0.5 * motion.beam.physics.base_compliance_mass * motion.rates[:, -1] ** 2
    masses = np.append(motion.beam.line * basis.weights, [body.mass for body in bodies])
    kinetic = 0.5 * np.sum(velocity**2, axis=-1) @ masses
    kinetic += 0.5 * sum(body.inertia for body in bodies) * (motion.rates @ motion.beam.tip_heading) ** 2
    share = motion.beam.physics.motor_share
    shares = [share, 1.0 - share] if motion.beam.motor else [1.0] * int(motion.beam.revolute)
    hubs = 0.5 * beam.hub_inertia * motion.rates[:, : len(shares)] ** 2 @ np.array(shares)
    elastic = 0.5 * np.sum(motion.coordinates @ motion.beam.stiffness * motion.coordinates, axis=-1)
    bending = motion.beam.bending_stiffness[motion.beam.bending, motion.beam.bending]
    arms = motion.states[:, motion.beam.parts.maxwell].reshape(len(elastic), len(motion.beam.ratios), len(bending))
    elastic += 0.5 * np.sum(arms @ bending * arms, axis=-1) @ motion.beam.ratios
    return np.asarray(kinetic + hubs + moved + elastic)
