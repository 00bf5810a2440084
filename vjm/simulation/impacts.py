"""Steps in which joints come to the flanks of their gaps, or leave them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from scipy.optimize import brentq

from vjm.effects.contact import Contact
from vjm.records import Array, Mask
from vjm.simulation.exponential import NODES, internal_stage, linear_part, runge_kutta_stages
from vjm.simulation.stick_slip import multiply
from vjm.simulation.system import Impacts, System, Trajectory, quintic_hermite

PATH_SHARES = np.arange(1, 9) / 8  # of a step, at which contacts are looked for
# By which a joint may be off between steps [rad]: a millionth of the arm's length at the tip, as `default_step` allows.
_RESOLVED = 1e-6
_QUINTIC_ORDER = 6  # halved steps have errors smaller by this power of two


class _Instant(NamedTuple):
    """A motion at one instant.

    Attributes:
        share: of the step that has passed.
        state: (2 nv + nz,) angles [rad], rates [rad/s] and internal states.
        slope: (2 nv + nz,) rate of change of the state.
    """

    share: float
    state: Array
    slope: Array


class ContactSteps:
    """Contacts of the copies' joints, from step to step.

    While nothing changes, flanks in contact are part of the linear part, which is advanced exactly. A step in which a
    contact begins or ends is advanced once more for the copy, by smaller steps from one of these instants to the next.

    Attributes:
        touching: (C, n_c) true for joints that are pressed against a flank.
        torque: (C, nv) of these flanks' springs where angles are zero [N m].
    """

    def __init__(
        self,
        system: System,
        start: tuple[Array, Array],
        torques: tuple[Array, Array, Array],
        elapsed: Array,
        step: float,
    ) -> None:
        """Begin with a motion.

        Args:
            system: the copies.
            start: angles and rates (C, nv) [rad, rad/s].
            torques: those on all joints at S steps' starts and at the end of the last (S + 1, C, nv), in their middles
                and at their ends (S, C, nv), quadratics in between [N m].
            elapsed: (C,) time since each recording began [s].
            step: [s].
        """
        q, v = start
        self._contacts, self._rows, self._active = system.contacts, np.arange(len(q))[:, None], system.active
        self._torques, self._elapsed, self._step = torques, elapsed, step
        self.touching = self._event_function(q, v) > 0.0
        self.torque = np.zeros(q.shape)
        parts = zip(range(len(q)), self.touching, self.torque, q, strict=True)
        self._copies = [_CopyContacts(system.of_copy(copy), step, *of_copy) for copy, *of_copy in parts]

    def _event_function(self, q: Array, v: Array) -> Array:
        joints = self._contacts.joint
        return self._contacts.event_function(q[self._rows, joints], v[self._rows, joints])

    def advance(
        self, k: int, motion: Array, paths: Array, further: Array | None, end: Array, z: tuple[Array, Array]
    ) -> bool:
        """Advance copies anew whose contacts begin or end in a step, and return whether there are any.

        Args:
            k: the step.
            motion: (C, 4 n) torques, angles, rates and accelerations at its start.
            paths: (C, 4 n, 3 n s) matrices to angles, rates and accelerations at s shares of it, by the linear part;
                one stands for all copies where they are equal.
            further: (C, n_a) torques to be added at its start [N m]; None: nothing.
            end: (C, 2 n) angles and rates at its end; those of the copies are replaced.
            z: (C, nz) internal states at its start and at its end; those at the end, too.
        """
        n = motion.shape[1] // 4
        path = multiply(motion, paths).reshape(len(motion), -1, 3 * n)
        changes, vibrates = self._changes_and_vibrations(motion[:, n:], path, end)
        for copy in np.flatnonzero(vibrates & ~changes).tolist():
            self._copies[copy].record(k, motion[copy, n:], path[copy], end[copy], z[0][copy], z[1][copy])
        for copy in np.flatnonzero(changes).tolist():
            torques = np.stack([part[k, copy] for part in self._torques])
            if further is not None:
                torques[0, self._active] += further[copy]
            state = np.concatenate([motion[copy, n : 3 * n], z[0][copy]])
            state = self._copies[copy].advance(k, state, torques, float(self._elapsed[copy] + k * self._step))
            end[copy], z[1][copy] = np.split(state, [2 * n])
        return bool(changes.any())

    def _changes_and_vibrations(self, start: Array, path: Array, end: Array) -> tuple[Mask, Mask]:
        """Return in which copies (C,) contacts begin or end in a step, and in which joints with gaps vibrate.

        Args:
            start: (C, 3 n) angles, rates and accelerations at its start.
            path: (C, s, 3 n) the same at shares of it, by the linear part.
            end: (C, 2 n) angles and rates at its end.
        """
        n, h, rows, joints = end.shape[1] // 2, self._step, self._rows, np.asarray(self._contacts.joint)
        q0, v0, a0 = (start[rows, joints + k * n] for k in range(3))
        q, v, a = (path[rows, :, joints + k * n] for k in range(3))  # (C, n_c, s)
        touches = self._contacts.at((..., None)).event_function(q, v) > 0.0
        at_end = self._event_function(end[:, :n], end[:, n:]) > 0.0
        changes = (touches != self.touching[:, :, None]).any(axis=2) | (at_end != self.touching)
        # The quintic between start and end is off where a joint vibrates within the step.
        quintic = _quintic_halfway(h, (q0, v0, a0), (q[:, :, -1], v[:, :, -1], a[:, :, -1]))
        vibrates: Mask = np.abs(q[:, :, PATH_SHARES.size // 2 - 1] - quintic) > _RESOLVED
        return np.asarray(changes.any(axis=1)), np.asarray(vibrates.any(axis=1))

    def impacts(self, copy: int, steps: int, first: float) -> Impacts:
        """Return what has happened to a copy in a number of steps, the first of which begins at an instant [s]."""
        return self._copies[copy].impacts(steps, first)


class _CopyContacts:
    """Contacts of one copy of a system; their present state, `touching` and `torque`, is changed in place."""

    def __init__(self, system: System, step: float, touching: Mask, torque: Array, q: Array) -> None:
        self.system, self.step = system, step
        self.contacts = system.contacts.at(0)
        self.touching, self.torque = touching, torque
        self.began = touching.copy()
        self.elbows = system.active[system.active > 0]
        self.matrices: dict[tuple[bytes, float], tuple[Array, list[Array]]] = {}
        self.take_linear_part(q)
        self.share = 0.5  # of a step: the smaller steps, at most half of it, by which they are told from it
        self.path: list[tuple[int, _Instant]] = []
        self.changes: list[tuple[float, int, bool]] = []  # steps, which contact, whether it comes to a flank
        self.update_flanks(q)

    def take_linear_part(self, q: Array) -> None:
        """Take the linear part of the smaller steps at angles (nv,), those beside the elbows' being zero."""
        bent = np.zeros((1, q.size))
        bent[0, self.elbows] = q[self.elbows]
        ((_, mechanism),) = self.system.mechanisms
        self.mobility: Array = np.asarray(np.linalg.inv(mechanism.mass_matrix(bent)), dtype=float)
        self.matrices.clear()

    def update_flanks(self, q: Array) -> None:
        """Update springs, and the torque of flanks in contact, on the sides where the joints are at angles (nv,)."""
        (self.stiffness,), (self.damping,) = self.system.springs(self.touching[None])
        pressed = self.contacts.at(self.touching)
        self.torque[:] = 0.0
        np.add.at(self.torque, pressed.joint, pressed.stiffness * pressed.gap / 2 * np.sign(q[pressed.joint]))

    def record(self, k: int, start: Array, path: Array, end: Array, z: Array, z_end: Array) -> None:
        """Note the motion within a step.

        Args:
            k: the step.
            start: (3 nv,) angles, rates and accelerations at its start.
            path: (s, 3 nv) those at shares of it, by the linear part; the cubic is added to them that leads to its end.
            end: (2 nv,) angles and rates there.
            z, z_end: (nz,) internal states at its start and its end.
        """
        n, h, shares = self.torque.size, self.step, np.r_[0.0, PATH_SHARES]
        missing_q, missing_v = np.split(end - path[-1, : 2 * n], 2)
        cubic = np.outer([0.0, 0.0, 3.0, -2.0], missing_q) + h * np.outer([0.0, 0.0, -1.0, 1.0], missing_v)
        slopes = [np.asarray(polyval(shares, polyder(cubic, order))).T / h**order for order in range(3)]
        q, v, a = (
            each + slope for each, slope in zip(np.split(np.vstack([start, path]), 3, axis=1), slopes, strict=True)
        )
        rates = (z_end - z) / h
        for place, share in enumerate(shares.tolist()):
            state = np.concatenate([q[place], v[place], z + share * h * rates])
            self.path.append((k, _Instant(share, state, np.concatenate([v[place], a[place], rates]))))

    def advance(self, k: int, state: Array, torques: Array, time: float) -> Array:
        """Advance by a step, as `ContactSteps.advance` says."""
        start, middle, end = torques
        drive = np.stack([start, 4 * middle - 3 * start - end, 2 * (start - 2 * middle + end)])
        if self.elbows.size:
            self.take_linear_part(state[: self.torque.size])
        instant = self.at(0.0, state, drive, time)
        self.path.append((k, instant))
        while instant.share < 1.0:
            self.share = min(self.share, self.longest_share())
            halfway, ahead = self.smaller_step(instant, min(instant.share + self.share, 1.0), drive, time)
            off = self.off_halfway(instant, halfway, ahead)
            if off > 1.0:
                self.share /= 2
                continue
            if off < 2.0**-_QUINTIC_ORDER:
                self.share = min(2 * self.share, 0.5)
            change = self.first_change(instant, halfway, ahead)
            if change is not None:
                place, share = change
                if share < ahead.share:
                    _, ahead = self.smaller_step(instant, share, drive, time)
                self.path.append((k, ahead))
                self.begin_or_end(place, instant, k + ahead.share)
                self.update_flanks(ahead.state)
                ahead = self.at(ahead.share, ahead.state, drive, time)
            instant = ahead
            self.path.append((k, instant))
        return instant.state

    def at(self, share: float, state: Array, drive: Array, time: float) -> _Instant:
        """Return the motion at a share of a step, under torques (3, nv) by its powers and the present contacts."""
        n = drive.shape[1]
        q, v, z = state[None, :n], state[None, n : 2 * n], state[None, 2 * n :]
        torque = drive[0] + share * (drive[1] + share * drive[2]) + self.torque - self.stiffness * q - self.damping * v
        rates = z
        if self.system.has_further_forces:
            force, rates = self.system.further_forces(np.array([time + share * self.step]), q, v, z)
            torque += force
        slope = np.concatenate([v, self.system.accelerations(q, v, torque), rates], axis=1)[0]
        return _Instant(share, state, slope)

    def smaller_step(self, start: _Instant, share: float, drive: Array, time: float) -> tuple[_Instant, _Instant]:
        """Return the motion halfway to a later share and there, by the method that all steps are advanced by."""
        n, duration = self.torque.size, share - start.share
        linear, stages = self.linear_rate_and_stages(duration)
        known, z = np.split(start.state, [2 * n])
        rates, instants = np.zeros((0, z.size)), [start]
        for stage, node in zip(stages, NODES, strict=True):
            _, state, slope = instants[-1]
            known = np.concatenate([known, slope[n : 2 * n] - linear.dot(state[: 2 * n])])
            rates = np.vstack([rates, slope[2 * n :]])
            state = np.concatenate([stage.dot(known), internal_stage(z, rates, duration * self.step)])
            instants.append(self.at(start.share + node * duration, state, drive, time))
        return instants[-2], instants[-1]._replace(share=share)

    def linear_rate_and_stages(self, duration: float) -> tuple[Array, list[Array]]:
        """Return matrices to linear accelerations, and to the stages of a smaller step, in the present contacts.

        They are (nv, 2 nv) from the state, and (2 nv, 2 nv + s nv) from the state at the step's start and from what
        remains of the accelerations of the s stages before. Durations are shares of a step. Matrices of powers of two
        are kept: the others lead to or from an event.
        """
        key = self.touching.tobytes(), duration
        if key in self.matrices:
            return self.matrices[key]
        L = linear_part(self.mobility, self.stiffness[None], self.damping[None])
        stages, *_ = runge_kutta_stages(L, duration * self.step)
        found = L[0, self.torque.size :], [np.concatenate([part[0] for part in stage], axis=1) for stage in stages]
        if np.frexp(duration)[0] == 0.5:
            self.matrices[key] = found
        return found

    def longest_share(self) -> float:
        """Return the power of two of a step that resolves the contacts' vibrations, however small they are.

        Whether a flank pushes depends on them: a quintic through a radian of a vibration is within 2e-5 of it.
        """
        pressed = self.contacts.at(self.touching)
        own = self.mobility[0, pressed.joint, pressed.joint]
        rates = np.maximum(np.sqrt(pressed.stiffness * own), pressed.damping * own)
        return float(2.0 ** min(-1.0, -np.ceil(np.log2(self.step * rates)).max(initial=1.0)))

    def off_halfway(self, start: _Instant, halfway: _Instant, end: _Instant) -> float:
        """Return by how much the quintic between start and end is off halfway, as a multiple of what it may be."""
        n = self.torque.size
        motions = ((at.state[:n], *np.split(at.slope[: 2 * n], 2)) for at in (start, end))
        q = halfway.state[:n]
        off = np.abs(_quintic_halfway((end.share - start.share) * self.step, *motions) - q)
        # Diverging angles need not be followed closer than their digits allow.
        return float((off / (_RESOLVED * np.maximum(1.0, np.abs(q)))).max())

    def first_change(self, start: _Instant, halfway: _Instant, end: _Instant) -> tuple[int, float] | None:
        """Return which contact is the first to begin or end between two instants, and at what share; None if none."""
        n, joints = self.torque.size, np.asarray(self.contacts.joint)
        pressed = [self.contacts.event_function(at.state[joints], at.state[n + joints]) > 0.0 for at in (halfway, end)]
        changed_halfway, changed = np.stack(pressed) != self.touching
        changes = []
        for place in np.flatnonzero(changed_halfway | changed).tolist():
            joint = int(joints[place])
            before, after = (
                np.array([instant.state[joint], instant.state[n + joint], instant.slope[n + joint]])
                for instant in (start, end)
            )
            duration = (end.share - start.share) * self.step
            turn = quintic_hermite(duration, before, after)
            of_joint = self.contacts.at(place), turn.tolist(), (polyder(turn) / duration).tolist()
            share = 0.5 if changed_halfway[place] else 1.0
            if _event_function(0.0, *of_joint) * _event_function(share, *of_joint) < 0.0:
                share = float(brentq(_event_function, 0.0, share, of_joint, xtol=1e-12))
            changes.append((start.share + share * (end.share - start.share) if share < 1.0 else end.share, place))
        if not changes:
            return None
        share, place = min(changes)
        return place, share

    def begin_or_end(self, place: int, before: _Instant, steps: float) -> None:
        """Let a contact begin or end after so many steps, and note whether its joint comes to a flank."""
        contact, begins = self.contacts.at(place), not self.touching[place]
        self.touching[place] = begins
        apart = bool(contact.depth(before.state[contact.joint]) <= 0.0)
        self.changes.append((steps, place, begins and apart))

    def impacts(self, steps: int, first: float) -> Impacts:
        """Return what has happened, as `ContactSteps.impacts` says."""
        n = self.torque.size
        kept = [(k, instant) for k, instant in self.path if k < steps]
        time = first + self.step * np.array([k + instant.share for k, instant in kept])
        size = self.path[0][1].state.size if self.path else 2 * n
        states, slopes = (
            np.array([getattr(instant, name) for _, instant in kept]).reshape(-1, size) for name in ("state", "slope")
        )
        path = Trajectory(
            time, states[:, :n], states[:, n : 2 * n], slopes[:, n : 2 * n], states[:, 2 * n :], evenly=False
        )
        changes = [change for change in self.changes if change[0] < steps]
        instants, places, met = zip(*changes, strict=True) if changes else ((), (), ())
        return Impacts(
            path,
            self.began,
            np.array(instants, dtype=float),
            np.array(places, dtype=np.intp),
            np.array(met, dtype=bool),
        )


def _quintic_halfway(duration: float, start: Sequence[Array], end: Sequence[Array]) -> Array:
    """Return the middle (...) of the quintic through angles, rates and accelerations (...) at a duration's ends."""
    return np.asarray(polyval(0.5, quintic_hermite(duration, np.stack(start), np.stack(end))))


def _event_function(share: float, contact: Contact, turn: Sequence[float], rate: Sequence[float]) -> float:
    """Return a contact's event_function at a share of a motion, whose angle and rate are polynomials of it."""
    motion = (np.asarray(reduce(lambda value, c: value * share + c, reversed(each), 0.0)) for each in (turn, rate))
    return float(contact.event_function(*motion))
