"""Exponential Runge-Kutta steps of fourth order (ETDRK4; Cox and Matthews, J. Comput. Phys. 176, 2002)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from tests.fine_beam.mechanics import Mechanics

Array = NDArray[np.float64]


class _Step(NamedTuple):
    """Matrices (2 n, 2 n) of one step length: propagators over a whole and a half step, and the stages' weights."""

    whole: Array
    half: Array
    half_weight: Array
    first: Array
    middle: Array
    last: Array


class ExponentialRungeKutta:
    """Solves the stiff linear bending vibration exactly and steps what the large rotation adds explicitly.

    The basis has natural frequencies of thousands of rad/s that carry next to no motion; an explicit method would
    have to follow them, this one need only follow the motion.
    """

    def __init__(self, mechanics: Mechanics, kelvin_voigt_time: float) -> None:
        self._mechanics = mechanics
        self._size = mechanics.size
        mass, stiffness = mechanics.linearised()
        restoring = -np.linalg.solve(mass, stiffness)
        zero, identity = np.zeros_like(mass), np.eye(self._size)
        self.linear: Array = np.block([[zero, identity], [restoring, kelvin_voigt_time * restoring]])
        self._steps: dict[float, _Step] = {}

    def run(self, time: Array, torque: Array, state: Array, max_step: float) -> Array:
        """Integrate from state (2 n,) over time (T,) with piecewise linear torque (T,); states (T, 2 n)."""
        states = np.empty((len(time), len(state)))
        states[0] = state
        for index in range(len(time) - 1):
            interval = time[index + 1] - time[index]
            count = max(1, int(np.ceil(interval / max_step - 1e-6)))
            # Torque knots fall on step ends, so that the torque's kinks cost no order of accuracy.
            torques = np.linspace(torque[index], torque[index + 1], 2 * count + 1).tolist()
            step = self._step(round(interval / count, 12))
            for substep in range(count):
                state = self._advance(state, step, *torques[2 * substep : 2 * substep + 3])
            states[index + 1] = state
        if not np.all(np.isfinite(states)):
            raise ArithmeticError("the simulation diverged: take a shorter step")
        return states

    def _advance(self, state: Array, step: _Step, start: float, middle: float, end: float) -> Array:
        """One step, with the torque at its start, middle and end."""
        first = self._remainder(state, start)
        free = step.half @ state
        stage = free + step.half_weight @ first
        second = self._remainder(stage, middle)
        third = self._remainder(free + step.half_weight @ second, middle)
        fourth = self._remainder(step.half @ stage + step.half_weight @ (2.0 * third - first), end)
        return np.asarray(step.whole @ state + step.first @ first + step.middle @ (second + third) + step.last @ fourth)

    def _remainder(self, state: Array, torque: float) -> Array:
        """Time derivative of the state less its linear part, (2 n,)."""
        derivative = -(self.linear @ state)
        derivative[: self._size] += state[self._size :]
        derivative[self._size :] += self._mechanics.acceleration(state[: self._size], state[self._size :], torque)
        return derivative

    def _step(self, length: float) -> _Step:
        """Matrices for a step of `length` s."""
        if length not in self._steps:
            whole, phi_1, phi_2, phi_3 = phi_functions(self.linear * length)
            half, half_phi, _, _ = phi_functions(self.linear * (0.5 * length))
            self._steps[length] = _Step(
                whole=whole,
                half=half,
                half_weight=0.5 * length * half_phi,
                first=length * (phi_1 - 3.0 * phi_2 + 4.0 * phi_3),
                middle=length * (2.0 * phi_2 - 4.0 * phi_3),
                last=length * (4.0 * phi_3 - phi_2),
            )
        return self._steps[length]


def phi_functions(matrix: Array) -> tuple[Array, Array, Array, Array]:
    """exp(A) and phi_1..phi_3(A), (d, d) each, from one exponential of an augmented matrix.

    No division by A: the hub's free rotation makes it singular.
    """
    size = len(matrix)
    augmented = np.zeros((4 * size, 4 * size))
    augmented[:size, :size] = matrix
    augmented[: 3 * size, size:] += np.eye(3 * size)
    blocks = expm(augmented)[:size]
    return blocks[:, :size], blocks[:, size : 2 * size], blocks[:, 2 * size : 3 * size], blocks[:, 3 * size :]
