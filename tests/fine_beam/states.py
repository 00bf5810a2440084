"""Linear modes, and initial states made of modes or of a static load."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, eigvals
from scipy.optimize import root

from tests.fine_beam.beam import DEFAULT_NUMERICS, Beam, Numerics, State
from tests.fine_beam.integrator import ExponentialRungeKutta
from tests.fine_beam.mechanics import Mechanics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Modes:
    """Vibration modes about the straight beam without gravity, the hub's free rotation left out.

    Attributes:
        frequencies: undamped natural frequencies, Hz, (m,).
        damping_ratios: of the damped linear system, (m,); NaN where overdamped.
        shapes: coordinates (n,) of each mode per metre of transverse tip motion, (n, m).
    """

    frequencies: Array
    damping_ratios: Array
    shapes: Array


def linear_modes(beam: Beam, numerics: Numerics = DEFAULT_NUMERICS) -> Modes:
    """Solve the linear eigenproblem; the damping ratios come from the damped system's own eigenvalues."""
    mechanics = Mechanics(beam, numerics)
    mass, stiffness = mechanics.linearised()
    squared, shapes = eigh(stiffness, mass)
    first = 1 if mechanics.has_hub else 0
    shapes = shapes[:, first:]
    pulsations = np.sqrt(squared[first:])
    tip = mechanics.basis.weights @ mechanics.heading @ shapes
    return Modes(
        frequencies=pulsations / (2.0 * np.pi),
        damping_ratios=_damping_ratios(ExponentialRungeKutta(mechanics, beam.kelvin_voigt_time).linear, pulsations),
        shapes=shapes / tip,
    )


def _damping_ratios(linear: Array, pulsations: Array) -> Array:
    """Damping ratios, (m,), of the eigenvalues of the first-order system (2 n, 2 n) that belong to each mode."""
    roots = np.asarray(eigvals(linear), dtype=complex)
    oscillating = roots[roots.imag > 0.0]
    sizes = np.abs(oscillating)
    ratios = np.full(len(pulsations), np.nan)
    for index, pulsation in enumerate(pulsations):
        if len(sizes) and np.min(np.abs(sizes / pulsation - 1.0)) < 1e-6:
            nearest = oscillating[np.argmin(np.abs(sizes - pulsation))]
            ratios[index] = -nearest.real / abs(nearest)
    return ratios


def rest_state(numerics: Numerics = DEFAULT_NUMERICS, theta: float = 0.0) -> State:
    """Straight and at rest at joint angle theta (rad)."""
    return State(np.zeros(numerics.basis_size), np.zeros(numerics.basis_size), theta)


def modal_state(beam: Beam, tip_amplitudes: list[float], numerics: Numerics = DEFAULT_NUMERICS) -> State:
    """At rest in a sum of linear modes, each given by its transverse tip displacement in m."""
    shapes = linear_modes(beam, numerics).shapes[:, : len(tip_amplitudes)]
    return _at_rest(beam, shapes @ np.asarray(tip_amplitudes, dtype=float))


def static_state(
    beam: Beam, tip_force: tuple[float, float] = (0.0, 0.0), theta: float = 0.0, numerics: Numerics = DEFAULT_NUMERICS
) -> State:
    """Equilibrium under gravity and a dead force (N) on the tip, the hub held at theta (rad)."""
    mechanics = Mechanics(beam, numerics)
    held = [theta] if mechanics.has_hub else []
    load = np.asarray(tip_force, dtype=float)

    def residual(bending: Array) -> Array:
        return mechanics.static_residual(np.concatenate([held, bending]), load)[len(held) :]

    solution = root(residual, np.zeros(numerics.basis_size), tol=1e-13)
    if np.max(np.abs(residual(solution.x))) > 1e-9 * beam.bending_stiffness / beam.length:
        raise ArithmeticError(f"no equilibrium found: {solution.message}")
    return _at_rest(beam, np.concatenate([held, solution.x]))


def _at_rest(beam: Beam, coordinates: Array) -> State:
    """Split coordinates (n,) into joint angle and bending."""
    if beam.joint == "revolute":
        return State(coordinates[1:], np.zeros(len(coordinates) - 1), float(coordinates[0]))
    return State(coordinates, np.zeros(len(coordinates)))
