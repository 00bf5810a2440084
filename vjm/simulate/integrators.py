"""Time steps for virtual-joint chains: stiff in K, smooth in everything else.

Every integrator advances all copies of a `Mechanism` together, each under its own torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm import dynamics
from vjm.chain.records import Chain
from vjm.errors import SimulationDivergedError
from vjm.simulate.drive import Drive
from vjm.simulate.steps import Steps

Array = NDArray[np.float64]

_LARGEST_ANGLE = 1e3  # rad; beyond it a trajectory has diverged


@dataclass(frozen=True)
class System:
    """What is integrated: the copies' mechanism with their springs and dampers.

    Attributes:
        mechanism: the copies as branches of one model.
        stiffness, damping: (C, nv) of each copy's joints [N m/rad, N m s/rad].
        active: coordinates that torques drive.
    """

    mechanism: dynamics.Mechanism
    stiffness: Array
    damping: Array
    active: NDArray[np.intp]

    @classmethod
    def of(cls, chains: Sequence[Chain], payloads: Sequence[float], gravity: tuple[float, float]) -> System:
        """The system of several chains with the same coordinates, each with its own payload [kg] on the tip.

        Args:
            chains: one a copy.
            payloads: one a copy [kg].
            gravity: in the plane, for all [m/s^2].
        """
        return cls(
            dynamics.build(chains, payloads, gravity),
            np.stack([chain.stiffness for chain in chains]),
            np.stack([chain.damping for chain in chains]),
            chains[0].active,
        )

    def acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """(C, nv) accelerations at q, v (C, nv) under torques (C, n_a) of the active joints [N m]."""
        total = -self.stiffness * q - self.damping * v
        total[:, self.active] += torque
        flat = dynamics.forward_dynamics(self.mechanism, q.ravel(), v.ravel(), total.ravel())
        return flat.reshape(q.shape)

    def free_acceleration(self, x: Array, torque: Array) -> Array:
        """(C, nv) accelerations at x = (q, v) (C, 2 nv) under torques (C, nv) of all joints, springs included."""
        n = torque.shape[1]
        flat = dynamics.forward_dynamics(self.mechanism, x[:, :n].ravel(), x[:, n:].ravel(), torque.ravel())
        return flat.reshape(torque.shape)


def runge_kutta(system: System, q: Array, v: Array, drive: Drive) -> Steps:
    """Classical fourth-order Runge-Kutta with fixed steps: the reference (section 6.4 takes 100 us).

    Args:
        system: the copies.
        q, v: (C, nv) initial angles [rad] and rates [rad/s].
        drive: the torques over the steps.

    Returns:
        The trajectory, from time zero.

    Raises:
        SimulationDivergedError: the trajectory left the finite numbers.
    """
    step, count = drive.step, len(drive.start)
    record = Recorder(drive, q)
    half = step / 2
    for k in range(count):
        now, middle, end = drive.start[k], drive.middle[k], drive.end[k]
        a1 = system.acceleration(q, v, now)
        record.put(k, q, v, a1)
        v2 = v + half * a1
        a2 = system.acceleration(q + half * v, v2, middle)
        v3 = v + half * a2
        a3 = system.acceleration(q + half * v2, v3, middle)
        v4 = v + step * a3
        a4 = system.acceleration(q + step * v3, v4, end)
        q = q + step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return record.finish(q, v, system.acceleration(q, v, drive.ends[-1]))


class Recorder:
    """Keeps the steps and notices divergence."""

    def __init__(self, drive: Drive, q: Array) -> None:
        self.drive = drive
        self.q, self.v, self.a = (np.empty((len(drive.ends), *q.shape)) for _ in range(3))

    def put(self, k: int, q: Array, v: Array, a: Array) -> None:
        """Keep what the copies do at step k."""
        self.q[k], self.v[k], self.a[k] = q, v, a
        if not np.abs(q).max() < _LARGEST_ANGLE:
            copy = int(np.argmin((np.abs(q) < _LARGEST_ANGLE).all(axis=1)))
            time = float(self.drive.first[copy]) + self.drive.step * max(k - 1, 0)
            remedy = "take smaller steps, or check the model's masses, stiffness and torque"
            raise SimulationDivergedError(time, self.drive.step, remedy)

    def finish(self, q: Array, v: Array, a: Array) -> Steps:
        """Keep the last instant; the whole trajectory, from time zero."""
        self.put(len(self.q) - 1, q, v, a)
        return Steps(self.drive.step * np.arange(float(len(self.q))), self.q, self.v, self.a)
