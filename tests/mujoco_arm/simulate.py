"""Motion of an arm of flexible links: the mechanics are MuJoCo's, and so, if asked, is the time integration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from tests.mujoco_arm.chain import Arm

Array = NDArray[np.float64]

_CREEP = 2e-3  # rad/s, below which dry friction fades into creep; joints here turn a hundred times as fast


@dataclass(frozen=True)
class Motion:
    """A simulated motion: time in s (T,), coordinates in rad (T, n) and their rates (T, n), in MuJoCo's order."""

    arm: Arm
    time: Array
    coordinates: Array
    rates: Array

    @property
    def angles(self) -> Array:
        """Active joint angles, rad, (T, active joints)."""
        return self.coordinates[:, self.arm.active]

    @property
    def energy(self) -> Array:
        """Kinetic, bending and gravity potential energy, J, (T,), as MuJoCo computes it."""
        model = self.arm.build()
        data = mujoco.MjData(model)
        energy = np.empty(len(self.time))
        for index in range(len(energy)):
            data.qpos[:], data.qvel[:] = self.coordinates[index], self.rates[index]
            mujoco.mj_forward(model, data)
            energy[index] = data.energy.sum()
        return energy

    def positions(self, link: int, arc_lengths: list[float]) -> Array:
        """Base-frame positions at k arc lengths (m) of a link, m, (T, k, 2)."""
        return self.arm.positions(self.coordinates, link, arc_lengths)


def simulate(
    arm: Arm, time: Array, torque: Array | None = None, coordinates: Array | None = None, max_step: float = 1e-4
) -> Motion:
    """Integrate the motion from standstill, with steps that stiff springs and dampers do not limit.

    Args:
        arm: the arm.
        time: equally spaced instants, s, (T,), at which the motion is returned.
        torque: of the active joints at these instants, N m, (T, active joints), linear between them; default zero.
        coordinates: at the first instant, rad, (n,); default: straight along x.
        max_step: longest time step, s.

    Returns:
        The motion at `time`.
    """
    count = _substeps(time, max_step)
    stepper = _ImplicitStepper(arm, (time[1] - time[0]) / count, coordinates)
    return _march(arm, time, torque, count, stepper.advance, stepper.state)


def simulate_with_mujoco(
    arm: Arm, time: Array, torque: Array | None = None, coordinates: Array | None = None, max_step: float = 1e-4
) -> Motion:
    """The same by MuJoCo's Runge-Kutta method of fourth order, which is stable only in short steps."""
    count = _substeps(time, max_step)
    model = arm.build((time[1] - time[0]) / count)
    data = mujoco.MjData(model)
    if coordinates is not None:
        data.qpos[:] = coordinates

    def advance(torque: Array) -> None:
        data.ctrl[:] = torque
        mujoco.mj_step(model, data)

    return _march(arm, time, torque, count, advance, lambda: np.stack([data.qpos, data.qvel]))


def _substeps(time: Array, max_step: float) -> int:
    """Steps from each instant to the next."""
    return max(1, int(np.ceil((time[1] - time[0]) / max_step - 1e-6)))


def _march(
    arm: Arm,
    time: Array,
    torque: Array | None,
    count: int,
    advance: Callable[[Array], None],
    state: Callable[[], Array],
) -> Motion:
    """Take `count` steps from each instant to the next, each under the torque of its middle."""
    knots = np.zeros((len(time), len(arm.active))) if torque is None else torque
    middles = (np.arange(count)[:, None] + 0.5) / count
    states = [state()]
    for start, end in pairwise(knots):
        for middle in start + middles * (end - start):
            advance(middle)
        states.append(state())
    stacked = np.array(states)
    if not np.all(np.isfinite(stacked)):
        raise ArithmeticError("the simulation diverged: take a shorter step")
    return Motion(arm, time, stacked[:, 0], stacked[:, 1])


class _ImplicitStepper:
    """Steps of the implicit midpoint rule, of second order: stiff springs and dampers do not limit them.

    Inertia and velocity-dependent forces are MuJoCo's at the middle of the step: extrapolated from the step before,
    then corrected once, without which the undamped motion loses energy. Springs K and dampers C are implicit: the
    change of the rates in a step h is u with (M + h C / 2 + h^2 K / 4) u = h f. K and C are diagonal, so MuJoCo
    solves that too: they go in as armatures. Dry friction is a force like the velocity-dependent ones.
    """

    def __init__(self, arm: Arm, step: float, coordinates: Array | None) -> None:
        self._model = arm.build()
        self._stiffness: Array = self._model.jnt_stiffness.copy()
        self._damping: Array = self._model.dof_damping.copy()
        self._model.jnt_stiffness[:] = 0.0
        self._model.dof_damping[:] = 0.0
        self._model.dof_armature[:] = 0.5 * step * self._damping + 0.25 * step**2 * self._stiffness
        self._model.opt.enableflags = 0  # no energies
        self._data = mujoco.MjData(self._model)
        self._step = step
        self._coordinates = np.zeros(self._model.nv) if coordinates is None else np.array(coordinates, dtype=float)
        self._rates = np.zeros(self._model.nv)
        self._change = np.zeros(self._model.nv)
        self._friction = np.zeros(self._model.nv)
        self._friction[arm.active] = [link.joint_friction for link in arm.links if link.joint == "revolute"]

    def state(self) -> Array:
        """Coordinates and rates, (2, n)."""
        return np.stack([self._coordinates, self._rates])

    def advance(self, torque: Array) -> None:
        """One step under the torque (active joints,), N m."""
        known = self._coordinates + 0.5 * self._step * self._rates
        self._data.ctrl[:] = torque
        self._springs = -self._stiffness * known - self._damping * self._rates
        change = self._change_of_rates(known, self._change)
        self._change = self._change_of_rates(known, change)
        self._coordinates = known + 0.5 * self._step * (self._rates + self._change)
        self._rates = self._rates + self._change

    def _change_of_rates(self, known: Array, change: Array) -> Array:
        """Change of the rates, (n,), with inertia and velocity-dependent forces as they are for a guess of it."""
        self._data.qpos[:] = known + 0.25 * self._step * change
        self._data.qvel[:] = rates = self._rates + 0.5 * change
        self._data.qfrc_applied[:] = self._springs - self._friction * np.tanh(rates / _CREEP)
        mujoco.mj_forward(self._model, self._data)
        return np.asarray(self._step * self._data.qacc)
