"""Time steps for virtual-joint chains: stiff in K, smooth in everything else.

Every integrator advances all copies of a `Mechanism` together, each under its own torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

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
    record = _Recorder(drive, q)
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


def exponential(system: System, q: Array, v: Array, drive: Drive) -> Steps:
    """Fourth-order exponential time differencing (Cox and Matthews 2002, ETDRK4): the fast default.

    The constant part (M at zero angles, D, K) is advanced exactly whatever the step; the steps only have to resolve
    what the bending itself changes. Arguments, result and errors are those of `runge_kutta`.
    """
    linear, inverse = _linear_part(system)
    n, count = q.shape[1], len(drive.start)
    weights = _Weights.of(linear, _springs(system, len(linear)), drive.step)
    multiply = _multiply_shared if len(linear) == 1 else _multiply_each
    record = _Recorder(drive, q)
    # From the quadratic's acceleration at the start of each step to the torque's own, for what lies between steps.
    missing = np.einsum("cij,scj->sci", inverse[:, :, system.active], drive.ends[:-1] - drive.start)
    spread = [_spread(system, torques) for torques in (drive.start, drive.middle, drive.end)]
    advance, size = system.free_acceleration, 2 * n
    x = np.concatenate([q, v], axis=1)
    for k in range(count):
        p = multiply(x, weights.state)  # springs, L x, exp(L h / 2) x, exp(L h) x
        a = advance(x, p[:, :n] + spread[0][k])
        record.put(k, x[:, :n], x[:, n:], a + missing[k])
        drift, result = p[:, size : 2 * size], p[:, 2 * size :]
        p = multiply(a - p[:, n:size], weights.first)
        first, result = p[:, :size], result + p[:, size:]
        x2 = drift + first
        p = multiply(x2, weights.second)  # springs, L x, exp(L h / 2) x
        later = p[:, size:] - first
        p = multiply(advance(x2, p[:, :n] + spread[1][k]) - p[:, n:size], weights.middle)
        x3, result = drift + p[:, :size], result + p[:, size:]
        p = multiply(x3, weights.rate)
        p = multiply(advance(x3, p[:, :n] + spread[1][k]) - p[:, n:], weights.middle)
        x4, result = later + 2 * p[:, :size], result + p[:, size:]
        p = multiply(x4, weights.rate)
        x = result + multiply(advance(x4, p[:, :n] + spread[2][k]) - p[:, n:], weights.end)
    return record.finish(x[:, :n], x[:, n:], system.acceleration(x[:, :n], x[:, n:], drive.ends[-1]))


INTEGRATORS = {"exponential": exponential, "rk4": runge_kutta}


def _multiply_shared(states: Array, matrices: Array) -> Array:
    """(C, m) states times the transposed matrix that all copies share."""
    result: Array = states @ matrices[0]
    return result


def _multiply_each(states: Array, matrices: Array) -> Array:
    """(C, m) states, each times its own copy's transposed matrix."""
    result: Array = np.matmul(states[:, None, :], matrices)[:, 0, :]
    return result


def _linear_part(system: System) -> tuple[Array, Array]:
    """Constant part of d/dt (q, v) at zero angles (C, 2 nv, 2 nv), one where all share it; M^-1 (C, nv, nv)."""
    copies, n = system.stiffness.shape
    full = dynamics.mass_matrix(system.mechanism, np.zeros((1, copies * n)))[0]
    inertia = np.stack([full[c * n : (c + 1) * n, c * n : (c + 1) * n] for c in range(copies)])
    inverse = np.linalg.inv(inertia)
    linear = np.zeros((copies, 2 * n, 2 * n))
    linear[:, :n, n:] = np.eye(n)
    linear[:, n:, :n] = -inverse * system.stiffness[:, None, :]
    linear[:, n:, n:] = -inverse * system.damping[:, None, :]
    return (linear[:1] if (linear == linear[0]).all() else linear), inverse


def _springs(system: System, copies: int) -> Array:
    """(copies, nv, 2 nv) torques of the springs and dampers by angles and rates."""
    n = system.stiffness.shape[1]
    found = np.zeros((copies, n, 2 * n))
    found[:, range(n), range(n)] = -system.stiffness[:copies]
    found[:, range(n), range(n, 2 * n)] = -system.damping[:copies]
    return found


def _spread(system: System, torques: Array) -> Array:
    """Active joints' torques (S, C, n_a) among those of all joints (S, C, nv)."""
    found = np.zeros((len(torques), *system.stiffness.shape))
    found[:, :, system.active] = torques
    return found


@dataclass(frozen=True)
class _Weights:
    """ETDRK4's matrices, transposed, and side by side where they multiply the same vector.

    The remainder enters the rates only, so its weights are (2 nv, nv).
    """

    state: Array
    first: Array
    second: Array
    middle: Array
    rate: Array
    end: Array

    @classmethod
    def of(cls, linear: Array, springs: Array, step: float) -> _Weights:
        n = linear.shape[-1] // 2
        half_flow, half_phi, _, _ = _phi_functions(linear, step / 2)
        flow, phi1, phi2, phi3 = _phi_functions(linear, step)
        half = step / 2 * half_phi[:, :, n:]
        start, middle, end = (
            step * weight[:, :, n:] for weight in (phi1 - 3 * phi2 + 4 * phi3, 2 * phi2 - 4 * phi3, 4 * phi3 - phi2)
        )
        rate = linear[:, n:, :]
        return cls(
            state=_side_by_side(springs, rate, half_flow, flow),
            first=_side_by_side(half, start),
            second=_side_by_side(springs, rate, half_flow),
            middle=_side_by_side(half, middle),
            rate=_side_by_side(springs, rate),
            end=_side_by_side(end),
        )


def _side_by_side(*matrices: Array) -> Array:
    return np.ascontiguousarray(np.swapaxes(np.concatenate(matrices, axis=1), 1, 2))


def _phi_functions(linear: Array, step: float) -> tuple[Array, Array, Array, Array]:
    """exp(z), phi1(z), phi2(z), phi3(z) of z = L h, all (C, 2 nv, 2 nv)."""
    size = linear.shape[-1]
    # exp of this block matrix holds them in its first row.
    block = np.zeros((len(linear), 4 * size, 4 * size))
    block[:, :size, :size] = linear * step
    for k in range(3):
        block[:, k * size : (k + 1) * size, (k + 1) * size : (k + 2) * size] = np.eye(size)
    row = expm(block)[:, :size, :]
    flow, phi1, phi2, phi3 = (row[:, :, k * size : (k + 1) * size] for k in range(4))
    return flow, phi1, phi2, phi3


class _Recorder:
    """Keeps the steps and notices divergence."""

    def __init__(self, drive: Drive, q: Array) -> None:
        self.drive = drive
        self.q, self.v, self.a = (np.empty((len(drive.ends), *q.shape)) for _ in range(3))

    def put(self, k: int, q: Array, v: Array, a: Array) -> None:
        self.q[k], self.v[k], self.a[k] = q, v, a
        if not np.abs(q).max() < _LARGEST_ANGLE:
            copy = int(np.argmin((np.abs(q) < _LARGEST_ANGLE).all(axis=1)))
            time = float(self.drive.first[copy]) + self.drive.step * max(k - 1, 0)
            remedy = "take smaller steps, or check the model's masses, stiffness and torque"
            raise SimulationDivergedError(time, self.drive.step, remedy)

    def finish(self, q: Array, v: Array, a: Array) -> Steps:
        self.put(len(self.q) - 1, q, v, a)
        return Steps(self.drive.step * np.arange(float(len(self.q))), self.q, self.v, self.a)
