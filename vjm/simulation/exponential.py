"""Exponential time differencing: long steps for chains that are stiff in K and smooth in everything else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vjm.errors import SimulationDivergedError
from vjm.model import dynamics
from vjm.records import Array, Indices
from vjm.simulation.integrators import Drive, Recorder, Steps, System

_NORM = 0.5  # to which matrices are halved before their power series
_COEFFICIENTS = 1 / np.cumprod(np.arange(1.0, 12.0))[2:]  # 1 / (k + 3)!


def phi_functions(W: Array) -> tuple[Array, Array, Array, Array]:
    """exp, phi_1, phi_2, phi_3 of matrices W (K, m, m): power series of halved matrices, then doubling.

    phi_k(z) = (phi_{k-1}(z) - 1 / (k - 1)!) / z with phi_0 = exp (Hochbruck and Ostermann 2010).
    """
    norm = float(np.abs(W).sum(axis=2).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / _NORM))))
    X = W / 2.0**halvings
    X2 = X @ X
    one, X3 = np.eye(W.shape[-1]), X2 @ X
    phi3 = _series(one, X, X2, X3)
    phi2 = one / 2 + X @ phi3
    phi1 = one + X @ phi2
    flow = one + X @ phi1
    for _ in range(halvings):
        phi3 = (flow @ phi3 + phi1 / 2 + phi2 + phi3) / 8
        phi2 = (flow @ phi2 + phi1 + phi2) / 4
        phi1 = (flow @ phi1 + phi1) / 2
        flow = flow @ flow
    return flow, phi1, phi2, phi3


def _series(one: Array, X: Array, X2: Array, X3: Array) -> Array:
    """phi_3 by its power series."""
    c = _COEFFICIENTS
    found: Array = c[6] * one + c[7] * X + c[8] * X2
    found = c[3] * one + c[4] * X + c[5] * X2 + X3 @ found
    found = c[0] * one + c[1] * X + c[2] * X2 + X3 @ found
    return found


def rate_scale(acceleration: Array) -> float:
    """Size of rates per unit of angles that balances d/dt (q, v) = (v, a), from a by q, (..., nv, >= nv) [1/s]."""
    size = acceleration.shape[-2]
    largest = float(np.abs(acceleration[..., :size]).sum(axis=-1).max())
    return max(float(np.sqrt(largest)), 1e-6)


_ELBOW_GRID = 0.05  # rad between angles of an elbow at which the linear part is taken


def exponential(system: System, q: Array, v: Array, z: Array, drive: Drive) -> Steps:
    """Fourth-order exponential time differencing (Cox and Matthews 2002, ETDRK4): the fast default.

    The linear part (M at zero passive angles, D, K) is advanced exactly whatever the step; the steps only have to
    resolve what the bending itself changes. Where an active joint further out bends the arm, the linear part is taken
    at the nearest of a grid of its angles. Internal states of effects are advanced by the classical Runge-Kutta steps
    that this becomes where the linear part is zero. Arguments, result and errors are those of `runge_kutta`.
    """
    n, count = q.shape[1], len(drive.start)
    linear = _LinearPart(system, drive.step)
    weights = linear.at(q)
    multiply = _multiply_shared if len(weights.state) == 1 else _multiply_each
    record = Recorder(drive, q, z)
    # From the quadratic's torque at the start of each step to the torque itself, for what lies between steps.
    missing = drive.ends[:-1] - drive.start
    spread = [_spread(system, torques) for torques in (drive.start, drive.middle, drive.end)]
    size, step = 2 * n, drive.step

    def respond(k: float, x: Array, z: Array, springs: Array, torque: Array) -> tuple[Array, Array]:
        if not system.is_pushed:
            return system.free_acceleration(x, springs + torque), z
        force, rates = system.pushed(k * step, x[:, :n], x[:, n:], z)
        return system.free_acceleration(x, springs + torque + force), rates

    def carried(x: Array, z: Array, to: Array) -> Array:
        return system.carried(x[:, :n], z, to[:, :n]) if system.acting else z

    x = np.concatenate([q, v], axis=1)
    for k in range(count):
        if linear.varies:
            weights = linear.at(x)
        p = multiply(x, weights.state)  # springs, L x, exp(L h / 2) x, exp(L h) x
        a, z1 = respond(k, x, z, p[:, :n], spread[0][k])
        record.put(k, x[:, :n], x[:, n:], a + multiply(missing[k], weights.answer), z)
        drift, result = p[:, size : 2 * size], p[:, 2 * size :]
        p = multiply(a - p[:, n:size], weights.first)
        first, result = p[:, :size], result + p[:, size:]
        x2 = drift + first
        p = multiply(x2, weights.second)  # springs, L x, exp(L h / 2) x
        later = p[:, size:] - first
        a, z2 = respond(k + 0.5, x2, carried(x, z + step / 2 * z1, x2), p[:, :n], spread[1][k])
        p = multiply(a - p[:, n:size], weights.middle)
        x3, result = drift + p[:, :size], result + p[:, size:]
        p = multiply(x3, weights.rate)
        a, z3 = respond(k + 0.5, x3, carried(x, z + step / 2 * z2, x3), p[:, :n], spread[1][k])
        p = multiply(a - p[:, n:], weights.middle)
        x4, result = later + 2 * p[:, :size], result + p[:, size:]
        p = multiply(x4, weights.rate)
        a, z4 = respond(k + 1, x4, carried(x, z + step * z3, x4), p[:, :n], spread[2][k])
        to = result + multiply(a - p[:, n:], weights.end)
        z = carried(x, z + step / 6 * (z1 + 2 * z2 + 2 * z3 + z4), to)
        x = to
    q, v = x[:, :n], x[:, n:]
    force, _ = system.pushed(count * step, q, v, z)
    return record.finish(q, v, system.acceleration(q, v, drive.ends[-1], force), z)


def _multiply_shared(states: Array, matrices: Array) -> Array:
    """(C, m) states times the transposed matrix that all copies share."""
    result: Array = states @ matrices[0]
    return result


def _multiply_each(states: Array, matrices: Array) -> Array:
    """(C, m) states, each times its own copy's transposed matrix."""
    result: Array = np.matmul(states[:, None, :], matrices)[:, 0, :]
    return result


def _spread(system: System, torques: Array) -> Array:
    """Active joints' torques (S, C, n_a) among those of all joints (S, C, nv)."""
    found = np.zeros((len(torques), *system.stiffness.shape))
    found[:, :, system.active] = torques
    return found


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
        """Of some copies with mass matrices (c, nv, nv)."""
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
        """One copy's matrices."""
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
    flow, phi1, phi2, phi3 = (each * units[:, None] / units for each in phi_functions(step * balanced))
    return flow, phi1, phi2, phi3


class _LinearPart:
    """The matrices that belong to the copies' elbow angles, each worked out once."""

    def __init__(self, system: System, step: float) -> None:
        self.system = system
        self.step = step
        self.elbows = system.active[system.active > 0]
        self.known: dict[tuple[int, ...], tuple[Array, ...]] = {}
        self.current: tuple[bytes, _Weights] | None = None

    @property
    def varies(self) -> bool:
        """Whether there are elbows."""
        return self.elbows.size > 0

    def at(self, x: Array) -> _Weights:
        """Those of the copies' angles x (C, >= nv)."""
        places = np.round(x[:, self.elbows] / _ELBOW_GRID).astype(np.intp)
        key = places.tobytes()
        if self.current is None or self.current[0] != key:
            self.current = key, self._gathered(places) if self.varies else self._all(places)
        return self.current[1]

    def _gathered(self, places: Indices) -> _Weights:
        keys = [(c, *place) for c, place in enumerate(places.tolist())]
        new = [c for c, key in enumerate(keys) if key not in self.known]
        if new:
            worked_out = _Weights.of(self.system, self._inertia(places)[new], new, self.step)
            self.known |= {keys[c]: worked_out.of_copy(k) for k, c in enumerate(new)}
        return _Weights(*(np.stack(parts) for parts in zip(*(self.known[key] for key in keys), strict=True)))

    def _all(self, places: Indices) -> _Weights:
        system, inertia = self.system, self._inertia(places)
        parts = (inertia, system.stiffness, system.damping)
        equal = all((each == each[0]).all() for each in parts)
        copies = [0] if equal else list(range(len(inertia)))
        return _Weights.of(system, inertia[copies], copies, self.step)

    def _inertia(self, places: Indices) -> Array:
        """(C, nv, nv) the copies' mass matrices at zero angles, but for the elbows'."""
        copies, n = self.system.stiffness.shape
        q = np.zeros((copies, n))
        q[:, self.elbows] = _ELBOW_GRID * places
        full = dynamics.mass_matrix(self.system.mechanism, q.reshape(1, -1))[0]
        return np.stack([full[c * n : (c + 1) * n, c * n : (c + 1) * n] for c in range(copies)])
