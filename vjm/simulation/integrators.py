"""Time steps for virtual-joint chains: stiff in K, smooth in everything else.

Every integrator advances all copies of a `Mechanism` together, each under its own torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vjm.effects.effect import Effect, Motion, RateIndependentUpdate
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.model import dynamics
from vjm.records import Array, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.encoder_feedback import EncoderFeedback, shown

_GAUSS = np.array([-1.0, 1.0]) / np.sqrt(3.0)  # exact for the product of a line and a quadratic


@dataclass(frozen=True)
class Drive:
    """Active joints' torques over evenly spaced steps.

    Within a step the torque may have kinks at its samples. There it is replaced by the quadratic with the same mean,
    first and second moment: all that motion slower than the step can tell apart.

    Attributes:
        start, middle, end: (S, C, n_a) the quadratic's values at the steps' ends and middles [N m].
        ends: (S + 1, C, n_a) the torque itself at the steps' ends [N m].
        first: (C,) instants of the first step's start [s].
        step: [s].
    """

    start: Array
    middle: Array
    end: Array
    ends: Array
    first: Array
    step: float

    @classmethod
    def of(cls, recordings: Sequence[Recording], step: float, count: int) -> Drive:
        """The drive of C recordings, each from its own first instant; no torque acts after a recording's end.

        Raises:
            InsufficientDataError: an active joint without measured torque.
        """
        parts = [_fitted(*measured_torque(recording), recording.time, step, count) for recording in recordings]
        start, middle, end, ends = (np.stack(each, axis=1) for each in zip(*parts, strict=True))
        return cls(start, middle, end, ends, np.array([recording.time[0] for recording in recordings]), step)


def measured_torque(recording: Recording) -> tuple[Array, Array]:
    """Instants (T',) [s] and torques (T', n_a) [N m] at which all the active joints' torques were measured.

    Raises:
        InsufficientDataError: an active joint without measured torque: what drives it is unknown.
    """
    if recording.tau.shape[1] == 0:
        return recording.time[:1], np.zeros((1, 0))
    known = np.isfinite(recording.tau).all(axis=1)
    if known.sum() < 2:
        raise InsufficientDataError(
            f"simulation of {recording.file}",
            "no torque was measured at its active joints",
            "record the column LINK.tau",
        )
    return recording.time[known], recording.tau[known]


def _fitted(knots: Array, torque: Array, time: Array, step: float, count: int) -> tuple[Array, Array, Array, Array]:
    """The quadratics' values (S, n_a) at starts, middles and ends, and the torque at the steps' ends (S + 1, n_a)."""
    edges = np.asarray(time[0] + step * np.arange(count + 1))
    # Pieces on which the torque is a line: between neighbouring knots and steps' ends.
    inner = knots[(knots > edges[0]) & (knots < edges[-1])]
    bounds = np.union1d(edges, inner)
    middles, halves = (bounds[1:] + bounds[:-1]) / 2, np.diff(bounds) / 2
    owner = np.clip(((middles - edges[0]) / step).astype(int), 0, count - 1)
    instants = middles[:, None] + halves[:, None] * _GAUSS
    x = (instants - edges[owner][:, None]) * 2 / step - 1
    moments = (np.ones_like(x), x, (3 * x**2 - 1) / 2)
    after = time[-1] + 1e-9 * step
    quadratics, ends = [], []
    for column in torque.T:
        values = np.where(instants > after, 0.0, np.interp(instants, knots, column)) * halves[:, None]
        c0, c1, c2 = (
            (2 * k + 1) / step * np.bincount(owner, (values * moment).sum(axis=1), count)
            for k, moment in enumerate(moments)
        )
        quadratics.append((c0 - c1 + c2, c0 - c2 / 2, c0 + c1 + c2))
        ends.append(np.where(edges > after, 0.0, np.interp(edges, knots, column)))
    if not quadratics:
        empty = np.zeros((count, 0))
        return empty, empty, empty, np.zeros((count + 1, 0))
    start, middle, end = (np.stack(each, axis=-1) for each in zip(*quadratics, strict=True))
    return start, middle, end, np.stack(ends, axis=-1)


_LARGEST_ANGLE = 1e3  # rad; beyond it a trajectory has diverged


class Acting(NamedTuple):
    """Effects on some of the copies.

    Attributes:
        copies: their numbers.
        force: generalised forces; None: none.
        rates: of change of the internal states; None: none have any.
        rate_independent_update: how internal states follow the joints' way; None: none do.
    """

    copies: NDArray[np.intp]
    force: Motion | None
    rates: Motion | None
    rate_independent_update: RateIndependentUpdate | None


@dataclass(frozen=True)
class System:
    """What is integrated: the copies' mechanism with their springs and dampers.

    Attributes:
        mechanism: the copies as branches of one model.
        stiffness, damping: (C, nv) of each copy's joints [N m/rad, N m s/rad].
        active: coordinates that torques drive.
        acting: what acts on the copies beyond springs, dampers and torques.
        states: number nz of each copy's internal states.
        feedback: what draws the copies' active joints; None: nothing does.
        sensors: of each copy, the effects in what it shows.
    """

    mechanism: dynamics.Mechanism
    stiffness: Array
    damping: Array
    active: NDArray[np.intp]
    acting: tuple[Acting, ...] = ()
    states: int = 0
    feedback: EncoderFeedback | None = None
    sensors: tuple[tuple[Effect, ...], ...] = ()

    @classmethod
    def of(cls, arms: Sequence[Arm], payloads: Sequence[float], gravity: tuple[float, float]) -> System:
        """The system of several arms with the same coordinates, each with its own payload [kg] on the tip.

        Args:
            arms: one a copy.
            payloads: one a copy [kg].
            gravity: in the plane, for all [m/s^2].
        """
        chains = [arm.chain for arm in arms]
        return cls(
            dynamics.build(chains, payloads, gravity),
            np.stack([chain.stiffness for chain in chains]),
            np.stack([chain.damping for chain in chains]),
            chains[0].active,
            _acting(arms, payloads),
            sum(arms[0].states),
            EncoderFeedback.together([arm.feedback for arm in arms]),
            tuple(arm.sensors for arm in arms),
        )

    @property
    def is_pushed(self) -> bool:
        """Whether anything acts beyond springs, dampers and torques."""
        return bool(self.acting) or self.feedback is not None

    def pushed(self, time: float, q: Array, v: Array, z: Array) -> tuple[Array, Array]:
        """Forces of effects and guide (C, nv) [N m] and rates of internal states (C, nz), since the start [s]."""
        force, rates = np.zeros(q.shape), np.zeros(z.shape)
        for copies, push, change, _ in self.acting:
            rows = slice(None) if len(copies) == len(q) else copies
            at = np.full(len(copies), time)
            if push is not None:
                force[rows] = push(at, q[rows], v[rows], z[rows])
            if change is not None:
                rates[rows] = change(at, q[rows], v[rows], z[rows])
        if self.feedback is not None:
            force[:, self.active] += self.feedback.torque(time, *self._shown(q[:, self.active], v[:, self.active]))
        return force, rates

    def _shown(self, theta: Array, rate: Array) -> tuple[Array, Array]:
        """What encoders show of the copies' active joints' angles and rates (C, n_a)."""
        if not any(self.sensors):
            return theta, rate
        found = [shown(*each) for each in zip(self.sensors, theta, rate, strict=True)]
        return np.stack([angle for angle, _ in found]), np.stack([speed for _, speed in found])

    def carried(self, q: Array, z: Array, to: Array) -> Array:
        """Internal states (C, nz), those that follow the joints' way carried from angles q to others (C, nv)."""
        ways = [
            (each.copies, each.rate_independent_update)
            for each in self.acting
            if each.rate_independent_update is not None
        ]
        found = z.copy() if ways else z
        for copies, rate_independent_update in ways:
            found[copies] = rate_independent_update(q[copies], z[copies], to[copies])
        return found

    def acceleration(self, q: Array, v: Array, torque: Array, force: Array) -> Array:
        """(C, nv) accelerations at q, v (C, nv) under active joints' torques (C, n_a) and forces (C, nv) [N m]."""
        total = force - self.stiffness * q - self.damping * v
        total[:, self.active] += torque
        flat = dynamics.forward_dynamics(self.mechanism, q.ravel(), v.ravel(), total.ravel())
        return flat.reshape(q.shape)

    def free_acceleration(self, x: Array, torque: Array) -> Array:
        """(C, nv) accelerations at x = (q, v) (C, 2 nv) under torques (C, nv) of all joints, springs included."""
        n = torque.shape[1]
        flat = dynamics.forward_dynamics(self.mechanism, x[:, :n].ravel(), x[:, n:].ravel(), torque.ravel())
        return flat.reshape(torque.shape)


def _acting(arms: Sequence[Arm], payloads: Sequence[float]) -> tuple[Acting, ...]:
    """What acts on the copies; those with the same effects and payload together."""
    groups: dict[tuple[int, int, float], list[int]] = {}
    for k, (arm, payload) in enumerate(zip(arms, payloads, strict=True)):
        groups.setdefault((id(arm.chain), id(arm.effects), payload), []).append(k)
    found = [
        Acting(
            np.array(copies),
            arms[copies[0]].forces(payload),
            arms[copies[0]].rates,
            arms[copies[0]].rate_independent_update,
        )
        for (*_, payload), copies in groups.items()
    ]
    return tuple(each for each in found if each.force is not None or each.rates is not None)


def runge_kutta(system: System, q: Array, v: Array, z: Array, drive: Drive) -> Steps:
    """Classical fourth-order Runge-Kutta with fixed steps: the reference (section 6.4 takes 100 us).

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
    record = Recorder(drive, q, z)
    half = step / 2

    def slopes(time: float, q: Array, v: Array, z: Array, torque: Array) -> tuple[Array, Array]:
        force, rates = system.pushed(time, q, v, z)
        return system.acceleration(q, v, torque, force), rates

    for k in range(count):
        time, middle = k * step, drive.middle[k]
        a1, z1 = slopes(time, q, v, z, drive.start[k])
        record.put(k, q, v, a1, z)
        q2, v2 = q + half * v, v + half * a1
        a2, z2 = slopes(time + half, q2, v2, system.carried(q, z + half * z1, q2), middle)
        q3, v3 = q + half * v2, v + half * a2
        a3, z3 = slopes(time + half, q3, v3, system.carried(q, z + half * z2, q3), middle)
        q4, v4 = q + step * v3, v + step * a3
        a4, z4 = slopes(time + step, q4, v4, system.carried(q, z + step * z3, q4), drive.end[k])
        end = q + step / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        z = system.carried(q, z + step / 6 * (z1 + 2 * z2 + 2 * z3 + z4), end)
        q = end
    return record.finish(q, v, slopes(count * step, q, v, z, drive.ends[-1])[0], z)


class Recorder:
    """Keeps the steps and notices divergence."""

    def __init__(self, drive: Drive, q: Array, z: Array) -> None:
        self.drive = drive
        self.q, self.v, self.a, self.z = (np.empty((len(drive.ends), *like.shape)) for like in (q, q, q, z))

    def put(self, k: int, q: Array, v: Array, a: Array, z: Array) -> None:
        """Keep what the copies do at step k."""
        self.q[k], self.v[k], self.a[k], self.z[k] = q, v, a, z
        if not np.abs(q).max() < _LARGEST_ANGLE:
            copy = int(np.argmin((np.abs(q) < _LARGEST_ANGLE).all(axis=1)))
            time = float(self.drive.first[copy]) + self.drive.step * max(k - 1, 0)
            remedy = "take smaller steps, or check the model's masses, stiffness and torque"
            raise SimulationDivergedError(time, self.drive.step, remedy)

    def finish(self, q: Array, v: Array, a: Array, z: Array) -> Steps:
        """Keep the last instant; the whole trajectory, from time zero."""
        self.put(len(self.q) - 1, q, v, a, z)
        return Steps(self.drive.step * np.arange(float(len(self.q))), self.q, self.v, self.a, self.z)


@dataclass(frozen=True)
class Steps:
    """A trajectory at the integrator's own instants.

    Attributes:
        time: (S + 1,) evenly spaced [s].
        q, v, a: (S + 1, C, nv) angles [rad], rates [rad/s] and accelerations [rad/s^2] of C copies.
        z: (S + 1, C, nz) internal states of the effects.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    z: Array

    @property
    def step(self) -> float:
        """Distance between instants [s]."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


def sample(steps: Steps, time: Array) -> tuple[Array, Array]:
    """Angles and rates at any instants between the first and last step, by quintic Hermite interpolation.

    Args:
        steps: the trajectory.
        time: (T,) [s].

    Returns:
        q, v (T, C, nv) [rad, rad/s].
    """
    h = steps.step
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


def still(time: Array, q: Array) -> Steps:
    """An arm that stays at angles (nv,) [rad] from the first of the instants [s] to the last."""
    ends = np.array([time[0], time[-1]])
    each = (np.broadcast_to(x, (2, 1, x.size)) for x in (q, 0 * q, 0 * q, np.zeros(0)))
    return Steps(ends, *each)
