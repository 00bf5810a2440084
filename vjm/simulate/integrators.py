"""Time steps for virtual-joint chains: stiff in K, smooth in everything else.

Every integrator advances all copies of a `Mechanism` together, with joint torques that are linear between knots.
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

Array = NDArray[np.float64]

_LARGEST_ANGLE = 1e3  # rad; beyond it a trajectory has diverged


@dataclass(frozen=True)
class Steps:
    """A trajectory at the integrator's own instants.

    Attributes:
        time: (S + 1,) [s].
        q, v, a: (S + 1, C, nv) angles [rad], rates [rad/s] and accelerations [rad/s^2] of C copies.
    """

    time: Array
    q: Array
    v: Array
    a: Array


@dataclass(frozen=True)
class System:
    """What is integrated: the copies' mechanism with their springs and dampers.

    Attributes:
        mechanism: the copies as branches of one model.
        stiffness, damping: (C, nv) of each copy's joints [N m/rad, N m s/rad].
    """

    mechanism: dynamics.Mechanism
    stiffness: Array
    damping: Array

    @classmethod
    def of(cls, chains: Sequence[Chain], payload: float, gravity: tuple[float, float]) -> System:
        """The system of several chains with the same coordinates, all under the same gravity [m/s^2]."""
        return cls(
            dynamics.build(chains, payload, gravity),
            np.stack([chain.stiffness for chain in chains]),
            np.stack([chain.damping for chain in chains]),
        )

    def acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """(C, nv) accelerations at q, v (C, nv) under joint torques (nv,) or (C, nv) [N m]."""
        total = torque - self.stiffness * q - self.damping * v
        flat = dynamics.forward_dynamics(self.mechanism, q.ravel(), v.ravel(), total.ravel())
        return flat.reshape(q.shape)


def runge_kutta(system: System, q: Array, v: Array, torque: Array, start: float, step: float) -> Steps:
    """Classical fourth-order Runge-Kutta with fixed steps: the reference (section 6.4 takes 100 us).

    Args:
        system: the copies.
        q, v: (C, nv) initial angles [rad] and rates [rad/s].
        torque: (2 S + 1, nv) joint torques [N m] at the S steps' ends and middles.
        start, step: first instant and step [s].

    Raises:
        SimulationDivergedError: the trajectory left the finite numbers.
    """
    count = len(torque) // 2
    record = _Recorder(start, step, count, q)
    half = step / 2
    for k in range(count):
        now, middle, end = torque[2 * k : 2 * k + 3]
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
    return record.finish(q, v, system.acceleration(q, v, torque[-1]))


def exponential(system: System, q: Array, v: Array, torque: Array, start: float, step: float) -> Steps:
    """Fourth-order exponential time differencing (Cox and Matthews 2002, ETDRK4): the fast default.

    The constant part (M at zero angles, D, K) is advanced exactly whatever the step; the steps only have to resolve
    what the bending itself changes. Arguments, result and errors are those of `runge_kutta`.
    """
    linear = _linear_part(system)
    n, count = q.shape[1], len(torque) // 2
    propagators = _Propagators.of(linear, step)
    multiply = _multiply_shared if len(linear) == 1 else _multiply_each
    from_state, from_first, from_second, from_middle, rate, end = propagators.stacked()
    record = _Recorder(start, step, count, q)
    x = np.concatenate([q, v], axis=1)
    for k in range(count):
        now, middle, last = torque[2 * k : 2 * k + 3]
        a = system.acceleration(x[:, :n], x[:, n:], now)
        record.put(k, x[:, :n], x[:, n:], a)
        products = multiply(x, from_state)  # exp(L h / 2) x, exp(L h) x, L x
        drift, result = products[:, : 2 * n], products[:, 2 * n : 4 * n]
        n1 = a - products[:, 4 * n :]
        products = multiply(n1, from_first)
        first, result = products[:, : 2 * n], result + products[:, 2 * n :]
        x2 = drift + first
        products = multiply(x2, from_second)
        later = products[:, : 2 * n] - first
        n2 = system.acceleration(x2[:, :n], x2[:, n:], middle) - products[:, 2 * n :]
        products = multiply(n2, from_middle)
        x3, result = drift + products[:, : 2 * n], result + products[:, 2 * n :]
        n3 = system.acceleration(x3[:, :n], x3[:, n:], middle) - multiply(x3, rate)
        products = multiply(n3, from_middle)
        x4, result = later + 2 * products[:, : 2 * n], result + products[:, 2 * n :]
        n4 = system.acceleration(x4[:, :n], x4[:, n:], last) - multiply(x4, rate)
        x = result + multiply(n4, end)
    return record.finish(x[:, :n], x[:, n:], system.acceleration(x[:, :n], x[:, n:], torque[-1]))


def linear_response(M: Array, D: Array, K: Array, start: float, step: float, count: int) -> Steps:
    """Free motion of M x'' + D x' + K x = 0 from each unit initial state in turn, exact at every step.

    Args:
        M, D, K: (nv, nv).
        start, step: first instant and step [s].
        count: number of steps S.

    Returns:
        Steps of C = 2 nv copies; copy c started with component c of (x, x') at one and all others at zero.
    """
    n = len(M)
    rate = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, np.hstack([K, D]))]])
    flow = expm(rate * step)
    states = np.empty((count + 1, 2 * n, 2 * n))
    states[0] = np.eye(2 * n)
    for k in range(count):
        states[k + 1] = flow @ states[k]
    copies = np.swapaxes(states, 1, 2)
    a = copies @ rate[n:].T
    instants = np.asarray(start + step * np.arange(count + 1), dtype=float)
    return Steps(instants, copies[:, :, :n], copies[:, :, n:], a)


INTEGRATORS = {"exponential": exponential, "rk4": runge_kutta}


def _multiply_shared(states: Array, matrices: Array) -> Array:
    """(C, m) states times the transposed matrix that all copies share."""
    result: Array = states @ matrices[0]
    return result


def _multiply_each(states: Array, matrices: Array) -> Array:
    """(C, m) states, each times its own copy's transposed matrix."""
    result: Array = np.matmul(states[:, None, :], matrices)[:, 0, :]
    return result


def _linear_part(system: System) -> Array:
    """(C, 2 nv, 2 nv) constant part of d/dt (q, v), at zero angles; a single one if all copies share it."""
    copies, n = system.stiffness.shape
    full = dynamics.mass_matrix(system.mechanism, np.zeros((1, copies * n)))[0]
    inertia = np.stack([full[c * n : (c + 1) * n, c * n : (c + 1) * n] for c in range(copies)])
    inverse = np.linalg.inv(inertia)
    linear = np.zeros((copies, 2 * n, 2 * n))
    linear[:, :n, n:] = np.eye(n)
    linear[:, n:, :n] = -inverse * system.stiffness[:, None, :]
    linear[:, n:, n:] = -inverse * system.damping[:, None, :]
    return linear[:1] if (linear == linear[0]).all() else linear


@dataclass(frozen=True)
class _Propagators:
    """L, exp(L h), exp(L h / 2) and ETDRK4's weights, (C, 2 nv, nv) as the remainder enters the rates only."""

    rate: Array
    half_flow: Array
    half_first: Array
    flow: Array
    start: Array
    middle: Array
    end: Array

    @classmethod
    def of(cls, linear: Array, step: float) -> _Propagators:
        n = linear.shape[-1] // 2
        half_flow, half_first, _, _ = _phi_functions(linear, step / 2)
        flow, phi1, phi2, phi3 = _phi_functions(linear, step)
        weights = (phi1 - 3 * phi2 + 4 * phi3, 2 * phi2 - 4 * phi3, 4 * phi3 - phi2)
        start, middle, end = (step * weight[:, :, n:] for weight in weights)
        return cls(linear[:, n:, :], half_flow, step / 2 * half_first[:, :, n:], flow, start, middle, end)

    def stacked(self) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Transposed, and side by side where they multiply the same vector."""
        return (
            _side_by_side(self.half_flow, self.flow, self.rate),
            _side_by_side(self.half_first, self.start),
            _side_by_side(self.half_flow, self.rate),
            _side_by_side(self.half_first, self.middle),
            _side_by_side(self.rate),
            _side_by_side(self.end),
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

    def __init__(self, start: float, step: float, count: int, q: Array) -> None:
        self.time = np.asarray(start + step * np.arange(count + 1), dtype=float)
        self.step = step
        self.q, self.v, self.a = (np.empty((count + 1, *q.shape)) for _ in range(3))

    def put(self, k: int, q: Array, v: Array, a: Array) -> None:
        self.q[k], self.v[k], self.a[k] = q, v, a
        if not np.abs(q).max() < _LARGEST_ANGLE:
            remedy = "take smaller steps, or check the model's masses, stiffness and torque"
            raise SimulationDivergedError(float(self.time[max(k - 1, 0)]), self.step, remedy)

    def finish(self, q: Array, v: Array, a: Array) -> Steps:
        self.put(len(self.time) - 1, q, v, a)
        return Steps(self.time, self.q, self.v, self.a)


def sample(steps: Steps, time: Array) -> tuple[Array, Array]:
    """Angles and rates at any instants between the first and last step, by quintic Hermite interpolation.

    Args:
        steps: the trajectory.
        time: (T,) [s].

    Returns:
        q, v (T, C, nv) [rad, rad/s].
    """
    h = float(steps.time[1] - steps.time[0])
    k = np.clip(((time - steps.time[0]) / h).astype(int), 0, len(steps.time) - 2)
    s = ((time - steps.time[k]) / h)[:, None, None]
    q0, v0, a0 = steps.q[k], steps.v[k] * h, steps.a[k] * h * h / 2
    jump = steps.q[k + 1] - q0 - v0 - a0
    slope = steps.v[k + 1] * h - v0 - 2 * a0
    bend = (steps.a[k + 1] * h * h - 2 * a0) / 2
    c3, c4, c5 = 10 * jump - 4 * slope + bend, -15 * jump + 7 * slope - 2 * bend, 6 * jump - 3 * slope + bend
    q = q0 + s * (v0 + s * (a0 + s * (c3 + s * (c4 + s * c5))))
    v = (v0 + s * (2 * a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h
    return q, v
