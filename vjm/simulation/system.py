"""Equations of motion of several copies of an arm, what drives them, and their trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain
from vjm.effects.contact import Contact
from vjm.effects.effect import StateFunction
from vjm.errors import InsufficientDataError
from vjm.model.dynamics import Mechanism, mechanism_of
from vjm.records import Array, Indices, Mask, Payload, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.stick_slip import FrictionHistory


@dataclass(frozen=True)
class Drive:
    """Torques of active joints over evenly spaced steps.

    Within a step the torque may have kinks at its samples. There it is replaced by the quadratic with the same mean,
    first and second moment: motion slower than the step cannot tell them apart.

    Attributes:
        start, middle, end: (S, C, n_a) the quadratic's values at the steps' ends and middles [N m].
        ends: (S + 1, C, n_a) the torque itself at the steps' ends [N m].
        first: (C,) instants of the first step's start [s].
        began: (C,) instants at which the recordings began [s].
        step: [s].
    """

    start: Array
    middle: Array
    end: Array
    ends: Array
    first: Array
    began: Array
    step: float

    @classmethod
    def of(cls, recordings: Sequence[Recording], began: Sequence[float], step: float, count: int) -> Drive:
        """Return the torques of C recordings, each from its first instant; none act after a recording's end.

        Args:
            recordings: the recordings.
            began: instants at which they began, before their first where they are parts of longer ones [s].
            step: [s].
            count: number of steps.

        Raises:
            InsufficientDataError: an active joint without measured torque.
        """
        parts = [_fit_quadratics(recording, step, count) for recording in recordings]
        start, middle, end, ends = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        first = np.array([recording.time[0] for recording in recordings])
        return cls(start, middle, end, ends, first, np.array(began), step)


def measured_torque(recording: Recording) -> tuple[Array, Array]:
    """Return instants (T',) [s] and torques (T', n_a) [N m] where all active joints' torques were measured.

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
            'record the column LINK.tau, or give the recording input = "motion"',
        )
    return recording.time[known], recording.tau[known]


def torque_at(recording: Recording, time: Array) -> Array:
    """Return the torques (..., n_a) [N m] at instants (...) [s], linear between those measured.

    Raises:
        InsufficientDataError: as of `measured_torque`.
    """
    knots, measured = measured_torque(recording)
    torque = np.empty((*time.shape, measured.shape[1]))
    for joint, column in enumerate(measured.T):
        torque[..., joint] = np.interp(time, knots, column)
    return torque


def _fit_quadratics(recording: Recording, step: float, count: int) -> tuple[Array, Array, Array, Array]:
    """Return quadratics' values (S, n_a) at starts, middles and ends, and torques at the steps' ends (S + 1, n_a)."""
    knots, _ = measured_torque(recording)
    edges = np.asarray(recording.time[0] + step * np.arange(count + 1))
    # Pieces on which the torque is a line: between neighbouring knots and steps' ends.
    bounds = np.union1d(edges, knots[(knots > edges[0]) & (knots < edges[-1])])
    middles, halves = (bounds[1:] + bounds[:-1]) / 2, np.diff(bounds) / 2
    first = np.searchsorted(bounds, edges)  # piece of each step
    starts = np.repeat(edges[:-1], np.diff(first))
    # Gauss-Legendre nodes: exact for the product of a line and a quadratic.
    instants = middles[:, None] + halves[:, None] * (np.array([-1.0, 1.0]) / np.sqrt(3.0))
    x = (instants - starts[:, None]) * 2 / step - 1

    def torque(time: Array) -> Array:
        values = torque_at(recording, time)
        values[time > recording.time[-1] + 1e-9 * step] = 0.0
        return values

    weighted = torque(instants) * halves[:, None, None]
    c0, c1, c2 = (
        (2 * k + 1) / step * np.add.reduceat((weighted * legendre[..., None]).sum(axis=1), first[:-1])
        for k, legendre in enumerate((np.ones_like(x), x, (3 * x**2 - 1) / 2))
    )
    return c0 - c1 + c2, c0 - c2 / 2, c0 + c1 + c2, torque(edges)


class _Acting(NamedTuple):
    """Copies with the same effects, one arm for them all, and the effects' force if they exert any."""

    copies: Indices | slice
    arm: Arm
    force: StateFunction | None


@dataclass(frozen=True)
class System:
    """Equations of motion of several copies: their mechanism, springs, dampers and effects.

    Attributes:
        mechanisms: the distinct chains with their payloads, and the copies that move as each of them.
        stiffness, damping: (C, nv) of each copy's joints [N m/rad, N m s/rad], without the flanks of their gaps.
        contacts: gaps of joints, as one contact of arrays (C, n_c); those that a copy lacks are never closed.
        active: coordinates that torques drive.
        arms: one a copy.
        acting: effects that exert forces or have internal states, copies with the same ones together.
    """

    mechanisms: tuple[tuple[Indices | slice, Mechanism], ...]
    stiffness: Array
    damping: Array
    contacts: Contact
    active: NDArray[np.intp]
    arms: tuple[Arm, ...]
    acting: tuple[_Acting, ...]

    @classmethod
    def of(cls, arms: Sequence[Arm], payloads: Sequence[Payload], gravity: tuple[float, float]) -> System:
        """Return the system of several arms with as many coordinates each, and bodies on their tips."""
        chains = [arm.chain for arm in arms]
        return cls(
            _mechanisms(chains, payloads, gravity),
            np.stack([arm.springs[0] for arm in arms]),
            np.stack([arm.springs[1] for arm in arms]),
            _contacts([arm.contacts for arm in arms]),
            chains[0].active,
            tuple(arms),
            _acting_effects(arms, payloads),
        )

    @property
    def _all_copies(self) -> slice:
        return slice(0, len(self.arms), 1)

    def of_copy(self, copy: int) -> System:
        """Return the system of one of the copies."""
        alone = slice(0, 1, 1)
        copies = np.arange(len(self.arms))
        mechanisms = tuple((alone, mechanism) for group, mechanism in self.mechanisms if copy in copies[group])
        acting = tuple(part._replace(copies=alone) for part in self.acting if copy in copies[part.copies])
        of_copy = slice(copy, copy + 1)
        return System(
            mechanisms,
            self.stiffness[of_copy],
            self.damping[of_copy],
            self.contacts.at(of_copy),
            self.active,
            self.arms[of_copy],
            acting,
        )

    def springs(self, touching: Mask) -> tuple[Array, Array]:
        """Return stiffness and damping (C, nv) with the flanks that joints (C, n_c) touch."""
        copies, places = np.nonzero(touching)
        stiffness, damping = self.stiffness.copy(), self.damping.copy()
        for copy, place in zip(copies, places, strict=True):
            contact = self.contacts.at((copy, place))
            stiffness[copy, contact.joint] += contact.stiffness
            damping[copy, contact.joint] += contact.damping
        return stiffness, damping

    @property
    def has_contacts(self) -> bool:
        """True if a joint of any copy has a gap."""
        return bool(np.size(self.contacts.joint))

    @property
    def has_further_forces(self) -> bool:
        """True if anything acts beyond springs, dampers and torques."""
        return bool(self.acting)

    def further_forces(self, time: Array, q: Array, v: Array, z: Array) -> tuple[Array, Array]:
        """Return effects' forces (C, nv) [N m] and rates of internal states (C, nz) at times (C,) [s].

        Times are since each copy's recording began.
        """
        if len(self.acting) == 1 and self.acting[0].copies == self._all_copies:
            ((_, arm, exerted),) = self.acting
            force = np.zeros(q.shape) if exerted is None else exerted(time, q, v, z)
            return force, arm.state_rates(time, q, v, z) if arm.has_state_rates else np.zeros(z.shape)
        force, rates = np.zeros(q.shape), np.zeros(z.shape)
        for copies, arm, exerted in self.acting:
            motion = q[copies], v[copies], z[copies]
            if exerted is not None:
                force[copies] = exerted(time[copies], *motion)
            if arm.has_state_rates:
                rates[copies] = arm.state_rates(time[copies], *motion)
        return force, rates

    @cached_property
    def has_dry_friction(self) -> bool:
        """True if a joint of any copy may stick."""
        return bool(self._braked)

    @cached_property
    def _braked(self) -> list[tuple[Indices | slice, Arm]]:
        groups: dict[int, list[int]] = {}
        for k, arm in enumerate(self.arms):
            if arm.has_dry_friction:
                groups.setdefault(id(arm), []).append(k)
        return [(as_slice(copies), self.arms[copies[0]]) for copies in groups.values()]

    def friction_torques(self, rates: Array) -> Array:
        """Return the active joints' dry friction (..., C, n_a) [N m] at rates (..., C, n_a) [rad/s]."""
        if len(self._braked) == 1 and self._braked[0][0] == self._all_copies:
            return self._braked[0][1].friction_torques(rates)
        torques = np.zeros(rates.shape)
        for copies, arm in self._braked:
            torques[..., copies, :] = arm.friction_torques(rates[..., copies, :])
        return torques

    def accelerations(self, q: Array, v: Array, torque: Array, out: Array | None = None) -> Array:
        """Return accelerations (C, nv) under torques of all joints (C, nv), springs included; in `out` if given."""
        if len(self.mechanisms) == 1:
            return self.mechanisms[0][1].forward_dynamics(q, v, torque, out)
        result = np.empty(torque.shape) if out is None else out
        for copies, mechanism in self.mechanisms:
            result[copies] = mechanism.forward_dynamics(q[copies], v[copies], torque[copies])
        return result


def _mechanisms(
    chains: Sequence[Chain], payloads: Sequence[Payload], gravity: tuple[float, float]
) -> tuple[tuple[Indices | slice, Mechanism], ...]:
    """Return the mechanisms; copies of the same chain with the same payload share one."""
    groups: dict[tuple[int, Payload], list[int]] = {}
    for k, (chain, payload) in enumerate(zip(chains, payloads, strict=True)):
        groups.setdefault((id(chain), payload), []).append(k)
    return tuple(
        (as_slice(copies), mechanism_of(chains[copies[0]], payload, gravity)) for (_, payload), copies in groups.items()
    )


def _contacts(of_copies: Sequence[Sequence[Contact]]) -> Contact:
    """Return the contacts of C copies as one of arrays (C, n_c)."""
    count = max(map(len, of_copies))
    none = Contact(0, np.finfo(float).max, 0.0, 0.0)
    rows = np.array([[*contacts, *[none] * (count - len(contacts))] for contacts in of_copies], dtype=float)
    joint, gap, stiffness, damping = np.moveaxis(rows.reshape(len(of_copies), count, len(none)), 2, 0)
    return Contact(joint.astype(np.intp), gap, stiffness, damping)


def _acting_effects(arms: Sequence[Arm], payloads: Sequence[Payload]) -> tuple[_Acting, ...]:
    """Return the effects that act on the copies, those of copies with the same effects and payload together."""
    groups: dict[tuple[int, int, Payload], list[int]] = {}
    for k, (arm, payload) in enumerate(zip(arms, payloads, strict=True)):
        groups.setdefault((id(arm.chain), id(arm.effects), payload), []).append(k)
    acting = []
    for (*_, payload), copies in groups.items():
        arm = arms[copies[0]]
        force = arm.forces(payload)
        if force is not None or any(arm.state_counts):
            acting.append(_Acting(as_slice(copies), arm, force))
    return tuple(acting)


def as_slice(indices: Sequence[int] | Indices) -> Indices | slice:
    """Return an index of evenly spaced rows or columns as a slice, which copies nothing; of others, as an array."""
    steps = {int(step) for step in np.diff(indices)} or {1}
    if len(steps) > 1 or min(steps) < 1 or not len(indices):
        return np.array(indices)
    return slice(int(indices[0]), int(indices[-1]) + 1, steps.pop())


# Weights of q, h v and h^2 a at a step's start and end, by powers (rows) of the share of the step that has passed.
_QUINTIC_HERMITE = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, 0.0, 0.5, 0.0, 0.0, 0.0],
        [-10.0, -6.0, -1.5, 10.0, -4.0, 0.5],
        [15.0, 8.0, 1.5, -15.0, 7.0, -1.0],
        [-6.0, -3.0, -0.5, 6.0, -3.0, 0.5],
    ]
)


def quintic_hermite(duration: float, start: Array, end: Array) -> Array:
    """Return coefficients (6, ...) by powers of the share of a duration [s] of motions between two instants.

    `start` and `end` are positions, rates and accelerations (3, ...) there.
    """
    units = np.reshape([1.0, duration, duration**2], (3,) + (1,) * (start.ndim - 1))
    return np.asarray(np.tensordot(_QUINTIC_HERMITE, np.concatenate([units * start, units * end]), 1))


@dataclass(frozen=True)
class Trajectory:
    """Motion of one arm, or of C copies, at the integrator's own instants.

    Attributes:
        time: (S + 1,) [s].
        q, v, a: (S + 1, ..., nv) angles [rad], rates [rad/s] and accelerations [rad/s^2]; copies are in the middle.
        z: (S + 1, ..., nz) internal states of the effects.
        start: instant at which the recording began, from which effects count time [s]; None: the first.
        friction: what dry friction has done to the active joints; None without any.
        impacts: what joints with gaps have done; None without any.
        evenly: False if instants are not evenly spaced; where two are the same, the motion jumps.
    """

    time: Array
    q: Array
    v: Array
    a: Array
    z: Array
    _: KW_ONLY
    start: float | None = None
    friction: FrictionHistory | None = None
    impacts: Impacts | None = None
    evenly: bool = True

    @property
    def began(self) -> float:
        """Instant at which the recording began [s]."""
        return float(self.time[0]) if self.start is None else self.start

    def elapsed(self, time: Array) -> Array:
        """Return instants (...) [s] as times since the recording began."""
        return time - self.began

    @property
    def motion(self) -> tuple[Array, Array, Array, Array]:
        """The attributes q, v, a and z."""
        return self.q, self.v, self.a, self.z

    @property
    def step(self) -> float:
        """Distance between instants [s]."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    @classmethod
    def at_rest(cls, time: Array, q: Array) -> Trajectory:
        """Return the trajectory of an arm at constant angles (nv,) [rad] from the first instant [s] to the last."""
        constant = np.broadcast_to(q, (2, q.size))
        return cls(np.array([time[0], time[-1]]), constant, 0 * constant, 0 * constant, np.zeros((2, 0)))

    def at(self, rows: Indices) -> Trajectory:
        """Return the motion at some of its instants."""
        return Trajectory(*(values[rows] for values in (self.time, *self.motion)), start=self.began)

    def between(self, steps: Array) -> Trajectory:
        """Return the motion at instants (I,) that are fractional numbers of steps from the first.

        Accelerations and internal states, which may have kinks and jumps, are linear within a step.
        """
        time = self.time[0] + self.step * steps
        q, v = self.sample(time)
        k, duration = self._steps(time)
        share = (time - self.time[k]) / duration
        a, z = (
            values[k] + share.reshape(-1, *(1,) * (values.ndim - 1)) * (values[k + 1] - values[k])
            for values in (self.a, self.z)
        )
        return Trajectory(time, q, v, a, z, start=self.began)

    def _steps(self, time: Array) -> tuple[Indices, float | Array]:
        """Return the steps (...) in which instants (...) [s] are, and these steps' durations [s]."""
        if self.evenly:
            k = np.clip(((time - self.time[0]) / self.step).astype(int), 0, len(self.time) - 2)
            return k, self.step
        last = np.searchsorted(self.time, self.time[-1]) - 1
        k = np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, last)
        return k, self.time[k + 1] - self.time[k]

    def sample(self, time: Array) -> tuple[Array, Array]:
        """Return angles and rates (..., nv) [rad, rad/s] at instants (...) [s], by quintic Hermite interpolation.

        Those of C copies are (..., C, nv).
        """
        return self._interpolated(time), self._interpolated(time, 1)

    def angles(self, time: Array) -> Array:
        """Return angles (..., nv) [rad] at instants (...) [s], as of `sample`."""
        return self._interpolated(time)

    def _interpolated(self, time: Array, order: int = 0) -> Array:
        """Return the angles' derivative of an order (..., nv) at instants (...) [s]."""
        k, h = self._steps(time)
        weights = polyval((time - self.time[k]) / h, polyder(_QUINTIC_HERMITE, order)) / h**order
        weights, h = (np.reshape(each, np.shape(each) + (1,) * (self.q.ndim - 1)) for each in (weights, h))
        total: Array = weights[0] * self.q[k]
        terms = (self.v, h, k), (self.a, h**2, k), (self.q, 1.0, k + 1), (self.v, h, k + 1), (self.a, h**2, k + 1)
        for weight, (values, unit, rows) in zip(weights[1:], terms, strict=True):
            total += weight * unit * values[rows]
        if self.impacts is not None and (inside := self.impacts.covers(time, self.step)).any():
            total[inside] = self.impacts.path._interpolated(time[inside], order)
        return total


@dataclass(frozen=True)
class Impacts:
    """Contacts of joints with the flanks of their gaps in a motion, which begin and end within its steps.

    Attributes:
        path: the motion in the steps in which they do, at closer instants; two of these are the same where it jumps.
        touching: (n_c,) true for joints that are in contact at the motion's beginning.
        instants: (E,) beginnings and ends of contacts, in steps since then.
        contacts: (E,) which of the contacts.
        met: (E,) true where a joint comes to a flank, whose damper then pushes at once.
    """

    path: Trajectory
    touching: Mask
    instants: Array
    contacts: Indices
    met: Mask

    def covers(self, time: Array, step: float) -> Mask:
        """Return whether instants (...) [s] are in one of these steps [s]."""
        if self.path.time.size < 2:
            return np.zeros(np.shape(time), dtype=bool)
        _, duration = self.path._steps(time)
        inside = (time >= self.path.time[0]) & (time <= self.path.time[-1])
        return np.asarray(inside & (duration < 0.75 * step))  # others lie between one of these steps and the next
