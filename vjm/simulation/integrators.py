"""Time steps for virtual-joint chains: stiff in K, smooth in everything else.

Every integrator advances all copies of a `System` together, each under its own torque.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vjm.errors import SimulationDivergedError
from vjm.model import dynamics
from vjm.records import Array, Indices
from vjm.simulation.system import Drive, System, Trajectory

_DIVERGED = 1e3  # rad; no joint turns so far
_ELBOW_GRID = 0.05  # rad between angles of an elbow at which the linear part is taken


def _runge_kutta(system: System, q: Array, v: Array, z: Array, drive: Drive) -> Trajectory:
    """Integrate by classical fourth-order Runge-Kutta steps: the reference (section 6.4 takes 100 us).

    Args:
        system: the copies.
        q, v: (C, nv) initial angles [rad] and rates [rad/s].
        z: (C, nz) initial internal states.
        drive: the torques over the steps.

    Returns:
        The trajectory, from time zero.

    Raises:
        SimulationDivergedError: the trajectory left the finite numbers.
    """
    step, count = drive.step, len(drive.start)
    record = _Recorder(drive, q, z)
    half = step / 2

    def slopes(time: float, q: Array, v: Array, z: Array, torque: Array) -> tuple[Array, Array]:
        force, rates = system.further_forces(time, q, v, z)
        return system.acceleration(q, v, torque, force), rates

    for k in range(count):
        time, middle = k * step, drive.middle[k]
        a1, z1 = slopes(time, q, v, z, drive.start[k])
        record.put(k, q, v, a1, z)
        q2, v2 = q + half * v, v + half * a1
        a2, z2 = slopes(time + half, q2, v2, system.update_states(q, z + half * z1, q2), middle)
        q3, v3 = q + half * v2, v + half * a2
        a3, z3 = slopes(time + half, q3, v3, system.update_states(q, z + half * z2, q3), middle)
        q4, v4 = q + step * v3, v + step * a3
        a4, z4 = slopes(time + step, q4, v4, system.update_states(q, z + step * z3, q4), drive.end[k])
        end = q + step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        z = system.update_states(q, z + step / 6 * (z1 + 2 * z2 + 2 * z3 + z4), end)
        q = end
    return record.finish(q, v, slopes(count * step, q, v, z, drive.ends[-1])[0], z)


def _exponential(system: System, q: Array, v: Array, z: Array, drive: Drive) -> Trajectory:
    """Integrate by fourth-order exponential time differencing (Cox and Matthews 2002, ETDRK4): the fast default.

    The linear part (M at zero passive angles, D, K) is advanced exactly whatever the step; the steps only have to
    resolve what the bending itself changes. Where an active joint further out bends the arm, the linear part is taken
    at the nearest of a grid of its angles. Internal states of effects are advanced by the classical Runge-Kutta steps
    that this becomes where the linear part is zero. Arguments, result and errors are those of `_runge_kutta`.
    """
    n, count = q.shape[1], len(drive.start)
    linear = _LinearPropagator(system, drive.step)
    weights = linear.at(q)
    shared = len(weights.state) == 1

    def multiply(states: Array, matrices: Array) -> Array:
        """Return (C, m) states times the transposed matrix of each copy, or that all copies share."""
        return np.asarray(states @ matrices[0] if shared else np.matmul(states[:, None, :], matrices)[:, 0, :])

    record = _Recorder(drive, q, z)
    # From the quadratic's torque at the start of each step to the torque itself, for what lies between steps.
    missing = drive.ends[:-1] - drive.start
    torques = [_of_all_joints(system, active) for active in (drive.start, drive.middle, drive.end)]
    size, step = 2 * n, drive.step

    def accelerate(k: float, x: Array, z: Array, springs: Array, torque: Array) -> tuple[Array, Array]:
        if not system.has_further_forces:
            return system.free_acceleration(x, springs + torque), z
        force, rates = system.further_forces(k * step, x[:, :n], x[:, n:], z)
        return system.free_acceleration(x, springs + torque + force), rates

    def update(x: Array, z: Array, to: Array) -> Array:
        return system.update_states(x[:, :n], z, to[:, :n]) if system.effects else z

    x = np.concatenate([q, v], axis=1)
    for k in range(count):
        if linear.varies:
            weights = linear.at(x)
        p = multiply(x, weights.state)  # springs, L x, exp(L h / 2) x, exp(L h) x
        a, z1 = accelerate(k, x, z, p[:, :n], torques[0][k])
        record.put(k, x[:, :n], x[:, n:], a + multiply(missing[k], weights.answer), z)
        drift, result = p[:, size : 2 * size], p[:, 2 * size :]
        p = multiply(a - p[:, n:size], weights.first)
        first, result = p[:, :size], result + p[:, size:]
        x2 = drift + first
        p = multiply(x2, weights.second)  # springs, L x, exp(L h / 2) x
        later = p[:, size:] - first
        a, z2 = accelerate(k + 0.5, x2, update(x, z + step / 2 * z1, x2), p[:, :n], torques[1][k])
        p = multiply(a - p[:, n:size], weights.middle)
        x3, result = drift + p[:, :size], result + p[:, size:]
        p = multiply(x3, weights.rate)
        a, z3 = accelerate(k + 0.5, x3, update(x, z + step / 2 * z2, x3), p[:, :n], torques[1][k])
        p = multiply(a - p[:, n:], weights.middle)
        x4, result = later + 2 * p[:, :size], result + p[:, size:]
        p = multiply(x4, weights.rate)
        a, z4 = accelerate(k + 1, x4, update(x, z + step * z3, x4), p[:, :n], torques[2][k])
        to = result + multiply(a - p[:, n:], weights.end)
        z = update(x, z + step / 6 * (z1 + 2 * z2 + 2 * z3 + z4), to)
        x = to
    q, v = x[:, :n], x[:, n:]
    force, _ = system.further_forces(count * step, q, v, z)
    return record.finish(q, v, system.acceleration(q, v, drive.ends[-1], force), z)


def _of_all_joints(system: System, active: Array) -> Array:
    """Torques of all joints (S, C, nv) from those of the active ones (S, C, n_a)."""
    torques = np.zeros((len(active), *system.stiffness.shape))
    torques[:, :, system.active] = active
    return torques


def phi_functions(W: Array) -> tuple[Array, Array, Array, Array]:
    """Return exp, phi_1, phi_2, phi_3 of matrices W (K, m, m): power series of halved matrices, then doubling.

    phi_k(z) = (phi_{k-1}(z) - 1 / (k - 1)!) / z with phi_0 = exp (Hochbruck and Ostermann 2010).
    """
    norm = float(np.abs(W).sum(axis=2).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / 0.5))))
    X = W / 2.0**halvings
    X2 = X @ X
    one, X3 = np.eye(W.shape[-1]), X2 @ X
    c = 1 / np.cumprod(np.arange(1.0, 12.0))[2:]  # 1 / (k + 3)!, enough for norms of up to a half
    phi3 = c[6] * one + c[7] * X + c[8] * X2
    phi3 = c[3] * one + c[4] * X + c[5] * X2 + X3 @ phi3
    phi3 = c[0] * one + c[1] * X + c[2] * X2 + X3 @ phi3
    phi2 = one / 2 + X @ phi3
    phi1 = one + X @ phi2
    flow = one + X @ phi1
    for _ in range(halvings):
        phi3 = (flow @ phi3 + phi1 / 2 + phi2 + phi3) / 8
        phi2 = (flow @ phi2 + phi1 + phi2) / 4
        phi1 = (flow @ phi1 + phi1) / 2
        flow = flow @ flow
    return flow, phi1, phi2, phi3


def rate_scale(acceleration: Array) -> float:
    """Return the size of rates per unit of angles that balances d/dt (q, v) = (v, a) [1/s].

    Args:
        acceleration: (..., nv, >= nv) derivative of a by q, and by more [1/s^2].
    """
    size = acceleration.shape[-2]
    largest = float(np.abs(acceleration[..., :size]).sum(axis=-1).max())
    return max(float(np.sqrt(largest)), 1e-6)


@dataclass(frozen=True)
class _Weights:
    """ETDRK4's matrices (C, ...), transposed, and side by side where they multiply the same vector.

    The remainder enters the rates only, so its weights are (2 nv, nv). `answer` turns active torques (n_a,) into
    accelerations (nv,). One copy stands for all where they are equal.
    """

    state: Array
    first: Array
    second: Array
    middle: Array
    rate: Array
    end: Array
    answer: Array

    @classmethod
    def of(cls, system: System, inertia: Array, copies: list[int], step: float) -> _Weights:
        """Return those of some copies with mass matrices (c, nv, nv)."""
        n = inertia.shape[1]
        try:
            inverse: Array = np.asarray(np.linalg.inv(inertia), dtype=float)
        except np.linalg.LinAlgError as error:
            remedy = "a joint moves nothing: give its hub or its links mass"
            raise SimulationDivergedError(0.0, step, remedy) from error
        springs = np.zeros((len(copies), n, 2 * n))
        springs[:, range(n), range(n)] = -system.stiffness[copies]
        springs[:, range(n), range(n, 2 * n)] = -system.damping[copies]
        rate: Array = inverse @ springs
        half_flow, half_phi, _, _ = _flow(rate, step / 2)
        flow, phi1, phi2, phi3 = _flow(rate, step)
        half = step / 2 * half_phi[:, :, n:]
        start = step * (phi1 - 3 * phi2 + 4 * phi3)[:, :, n:]
        middle = step * (2 * phi2 - 4 * phi3)[:, :, n:]
        end = step * (4 * phi3 - phi2)[:, :, n:]
        return cls(
            state=_side_by_side(springs, rate, half_flow, flow),
            first=_side_by_side(half, start),
            second=_side_by_side(springs, rate, half_flow),
            middle=_side_by_side(half, middle),
            rate=_side_by_side(springs, rate),
            end=_side_by_side(end),
            answer=_side_by_side(inverse[:, :, system.active]),
        )

    def of_copy(self, c: int) -> tuple[Array, ...]:
        """Return one copy's matrices."""
        return tuple(getattr(self, name)[c] for name in self.__dataclass_fields__)


def _side_by_side(*matrices: Array) -> Array:
    return np.ascontiguousarray(np.swapaxes(np.concatenate(matrices, axis=1), 1, 2))


def _flow(rate: Array, step: float) -> tuple[Array, Array, Array, Array]:
    """exp(z), phi1(z), phi2(z), phi3(z) of z = L h, all (C, 2 nv, 2 nv), for L with lower half `rate` (C, nv, 2 nv)."""
    n = rate.shape[1]
    scale = rate_scale(rate)
    balanced = np.zeros((len(rate), 2 * n, 2 * n))
    balanced[:, :n, n:] = scale * np.eye(n)
    balanced[:, n:, :n] = rate[:, :, :n] / scale
    balanced[:, n:, n:] = rate[:, :, n:]
    units = np.r_[np.ones(n), np.full(n, scale)]
    flow, phi1, phi2, phi3 = (function * units[:, None] / units for function in phi_functions(step * balanced))
    return flow, phi1, phi2, phi3


class _LinearPropagator:
    """ETDRK4's matrices at the copies' elbow angles, each computed once."""

    def __init__(self, system: System, step: float) -> None:
        self.system = system
        self.step = step
        self.elbows = system.active[system.active > 0]
        self.known: dict[tuple[int, ...], tuple[Array, ...]] = {}
        self.current: tuple[bytes, _Weights] | None = None

    @property
    def varies(self) -> bool:
        """True if there are elbows, joints further out that bend the arm."""
        return self.elbows.size > 0

    def at(self, x: Array) -> _Weights:
        """Return those at angles x (C, >= nv)."""
        places = np.round(x[:, self.elbows] / _ELBOW_GRID).astype(np.intp)
        key = places.tobytes()
        if self.current is None or self.current[0] != key:
            self.current = key, self._gathered(places) if self.varies else self._all(places)
        return self.current[1]

    def _gathered(self, places: Indices) -> _Weights:
        keys = [(c, *place) for c, place in enumerate(places.tolist())]
        new = [c for c, key in enumerate(keys) if key not in self.known]
        if new:
            computed = _Weights.of(self.system, self._inertia(places)[new], new, self.step)
            self.known |= {keys[c]: computed.of_copy(k) for k, c in enumerate(new)}
        return _Weights(*(np.stack(parts) for parts in zip(*(self.known[key] for key in keys), strict=True)))

    def _all(self, places: Indices) -> _Weights:
        system, inertia = self.system, self._inertia(places)
        parts = (inertia, system.stiffness, system.damping)
        equal = all((part == part[0]).all() for part in parts)
        copies = [0] if equal else list(range(len(inertia)))
        return _Weights.of(system, inertia[copies], copies, self.step)

    def _inertia(self, places: Indices) -> Array:
        """(C, nv, nv) the copies' mass matrices at zero angles, but for the elbows'."""
        copies, n = self.system.stiffness.shape
        q = np.zeros((copies, n))
        q[:, self.elbows] = _ELBOW_GRID * places
        full = dynamics.mass_matrix(self.system.mechanism, q.reshape(1, -1))[0]
        return np.stack([full[c * n : (c + 1) * n, c * n : (c + 1) * n] for c in range(copies)])


class _Recorder:
    """Record of a trajectory that notices divergence."""

    def __init__(self, drive: Drive, q: Array, z: Array) -> None:
        self.drive = drive
        self.q, self.v, self.a, self.z = (np.empty((len(drive.ends), *like.shape)) for like in (q, q, q, z))

    def put(self, k: int, q: Array, v: Array, a: Array, z: Array) -> None:
        """Store the copies' motion at step k."""
        self.q[k], self.v[k], self.a[k], self.z[k] = q, v, a, z
        if not np.abs(q).max() < _DIVERGED:
            copy = int(np.argmin((np.abs(q) < _DIVERGED).all(axis=1)))
            time = float(self.drive.first[copy]) + self.drive.step * max(k - 1, 0)
            remedy = "take smaller steps, or check the model's masses, stiffness and torque"
            raise SimulationDivergedError(time, self.drive.step, remedy)

    def finish(self, q: Array, v: Array, a: Array, z: Array) -> Trajectory:
        """Store the last instant and return the trajectory, from time zero."""
        self.put(len(self.q) - 1, q, v, a, z)
        return Trajectory(self.drive.step * np.arange(float(len(self.q))), self.q, self.v, self.a, self.z)


INTEGRATORS = {"exponential": _exponential, "rk4": _runge_kutta}
