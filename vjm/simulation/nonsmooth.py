"""Pieces of a motion in which joints stick, slip or touch the flanks of a gap, and derivatives across their bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from vjm.effects.contact import Contact
from vjm.records import Array, Indices, Mask
from vjm.simulation.stick_slip import FrictionHistory
from vjm.simulation.system import Trajectory


class Pieces(NamedTuple):
    """P pieces of intervals, in each of which joints are held or slip in one direction, and touch a flank or do not.

    Attributes:
        bounds: (P + 1,) instants between them, in half steps since the motion's first.
        held: (P, n_a) true for joints that are held.
        direction: (P, n_a) sign of the rate of the others.
        lost: (P, n_a) share of a small change of the joint's rate that is lost at the piece's beginning: all of it
            where the joint stops there, part of it where it turns round.
        side: (P, n_c) sign of the angle of joints that touch a flank; zero for those that do not.
        met: (P, n_c) the same of those that come to it at the piece's beginning.
    """

    bounds: Array
    held: Mask
    direction: Array
    lost: Array
    side: Array
    met: Array

    @property
    def instants(self) -> Array:
        """(2 P + 1,) beginnings, middles and ends, in half steps."""
        instants = np.empty(2 * len(self.bounds) - 1)
        instants[::2], instants[1::2] = self.bounds, (self.bounds[:-1] + self.bounds[1:]) / 2
        return instants

    @classmethod
    def of(
        cls,
        edges: Indices,
        history: FrictionHistory | None,
        path: Trajectory | None = None,
        contacts: Sequence[Contact] = (),
    ) -> Self:
        """Cut intervals of a motion.

        Args:
            edges: (K + 1,) half steps between the intervals.
            history: what dry friction has done; None without any.
            path: the motion, if there are gaps.
            contacts: n_c gaps of joints.
        """
        slips = None if history is None else _Slips.of(history, edges)
        touches = [] if path is None else [_Touches.of(path, each, k, edges) for k, each in enumerate(contacts)]
        events = [each.instants for each in touches] + ([] if slips is None else [slips.instants])
        bounds = np.unique(np.concatenate([edges, *events]))
        if path is not None and path.impacts is not None:
            bounds = _cut(bounds, 2 * (path.impacts.path.time - path.time[0]) / path.step)
        middle = (bounds[:-1] + bounds[1:]) / 2
        none = np.zeros((middle.size, 0))
        held, direction, lost = (none.astype(bool), none, none) if slips is None else slips.during(bounds, middle)
        sides = [each.during(bounds, middle) for each in touches]
        side, met = (np.stack(part, axis=1) for part in zip(*sides, strict=True)) if sides else (none, none)
        return cls(bounds, held, direction, lost, side, met)


def _cut(bounds: Array, instants: Array) -> Array:
    """Return bounds with further instants between them, in half steps, without those that are nearly the same."""
    after = np.clip(np.searchsorted(bounds, instants), 1, bounds.size - 1)
    apart = np.minimum(instants - bounds[after - 1], bounds[after] - instants) > 1e-3
    return np.unique(np.concatenate([bounds, instants[apart]]))


class _Slips(NamedTuple):
    """Changes of dry friction in a motion: E stops and releases, in half steps."""

    history: FrictionHistory  # from half step `begin` on
    begin: int
    holds: Mask
    held_before: Mask
    half: Indices  # (E,)
    joint: Indices
    change: Array
    instants: Array  # of these, and of releases within a half step

    @classmethod
    def of(cls, history: FrictionHistory, edges: Indices) -> Self:
        begin = max(int(edges[0]) - 1, 0)  # with the half step before, in which a joint may have been held
        history = FrictionHistory(*(values[begin : edges[-1]] for values in history))
        holds = np.isfinite(history.stop) & (history.restarted == 0.0)
        held_before = np.concatenate([np.zeros_like(holds[:1]), (holds & np.isinf(history.release))[:-1]])
        stops, released = np.isfinite(history.stop) & ~held_before, held_before & ~holds
        first = int(edges[0]) - begin
        half, joint = np.nonzero((stops | released)[first:])
        half += first
        change = half + np.where(stops[half, joint], history.stop[half, joint], 0.0)
        later = np.isfinite(history.release[first:])
        releases = np.nonzero(later)[0] + first + history.release[first:][later]
        instants = begin + np.concatenate([change, releases])
        return cls(history, begin, holds, held_before, half, joint, np.asarray(begin + change, dtype=float), instants)

    def during(self, bounds: Array, middle: Array) -> tuple[Mask, Array, Array]:
        """Return (P, n_a) what is held, directions and shares lost, of pieces between bounds (P + 1,)."""
        before, after, stop, slipping, restarted, release = self.history
        now = middle.astype(int) - self.begin
        passed = middle[:, None] - self.begin - now[:, None]
        changed = self.held_before[now] | (passed >= stop[now])
        half, joint = self.half, self.joint
        stops = np.isfinite(stop[half, joint]) & ~self.held_before[half, joint]
        slipped, left = slipping[half, joint], restarted[half, joint]
        kept = np.divide(left, slipped, out=np.zeros(half.size), where=slipped != 0.0)
        lost = np.zeros(changed.shape)
        lost[np.searchsorted(bounds, self.change), joint] = np.where(stops, 1.0 - kept, 0.0)
        direction = np.sign(np.where(changed, after[now], before[now]))
        return self.holds[now] & changed & (passed < release[now]), direction, lost


class _Touches(NamedTuple):
    """Changes of a joint's contact with the flanks of its gap: E beginnings and ends, in half steps."""

    path: Trajectory
    contact: Contact
    touching: bool  # before the first of them
    instants: Array  # (E,)
    met: Mask  # (E,) true where it comes to a flank

    @classmethod
    def of(cls, path: Trajectory, contact: Contact, place: int, edges: Indices) -> Self:
        """Return the changes of the contact in a place of the motion's impacts, in intervals between edges (K + 1,)."""
        impacts = path.impacts
        if impacts is None:
            return cls(path, contact, False, np.zeros(0), np.zeros(0, dtype=bool))
        own = impacts.contacts == place
        instants, met = 2 * impacts.instants[own], impacts.met[own]
        earlier = np.count_nonzero(instants <= edges[0])
        touching = bool(impacts.touching[place]) != bool(earlier % 2)
        during = slice(earlier, np.count_nonzero(instants < edges[-1]))
        return cls(path, contact, touching, instants[during], met[during])

    def during(self, bounds: Array, middle: Array) -> tuple[Array, Array]:
        """Return the sides (P,) on which it touches in pieces between bounds (P + 1,), and on which it comes to one."""
        changed = np.searchsorted(self.instants, middle) % 2 == 1
        angle = self.path.angles(self.path.time[0] + self.path.step / 2 * middle)[:, self.contact.joint]
        side = np.where(changed != self.touching, np.sign(angle), 0.0)
        return side, np.where(np.isin(bounds[:-1], self.instants[self.met]), side, 0.0)


class DryFrictionCoefficients(NamedTuple):
    """Dry friction of n_a active joints in the variational equations, along a motion of I instants."""

    rates: Array  # (n_a, m) the joints' rates by modal rates
    response: Array  # (I, m, n_a) modal accelerations by torques on the joints
    by_parameters: Array  # (I, n_a, m, p) modal accelerations by the parameters where the joint turns forwards

    def at(self, instants: slice) -> Self:
        """Return the coefficients at some of the instants."""
        return self._replace(response=self.response[instants], by_parameters=self.by_parameters[instants])

    def locked(self, held: Mask, share: Array | float = 1.0) -> Array:
        """Return projections (P, m, m) of modal accelerations: what torques leave that hold joints (P, n_a).

        Of rates, if impulses do so. A share (P, n_a) below one is what each of the joints loses of its acceleration.
        """
        both = held[:, :, None] & held[:, None, :]
        mobility = np.where(both, self.rates @ self.response, np.eye(held.shape[1]))
        torques = np.linalg.solve(mobility, (held * share)[:, :, None] * self.rates)
        return np.asarray(np.eye(self.rates.shape[1]) - self.response @ torques)

    def stopped(self, held: Mask, lost: Array) -> Array:
        """Return what becomes (P, m, m) of modal rates where joints lose shares (P, n_a) of a change of theirs."""
        return self.locked(held | (lost > 0), np.where(held, 1.0, lost))


class ContactCoefficients(NamedTuple):
    """A contact of a joint in the variational equations, along a motion of I instants."""

    contact: Contact
    turns: Array  # (m,) the joint's angle by modal coordinates
    response: Array  # (I, m) modal accelerations by a torque on the joint
    by_parameters: Array  # (I, m, p) modal accelerations by the parameters while it touches
    gaps: Array  # (p,) the gap by the parameters

    def at(self, instants: slice) -> Self:
        """Return the coefficients at some of the instants."""
        return self._replace(response=self.response[instants], by_parameters=self.by_parameters[instants])

    def by_state(self, touching: Mask) -> Array:
        """Return modal accelerations (P, m, 2 m) by modal coordinates and rates where the joint touches (P,)."""
        torque = -np.concatenate([self.contact.stiffness * self.turns, self.contact.damping * self.turns])
        return np.asarray((touching[:, None] * self.response)[:, :, None] * torque)

    def arrival(self, met: Array) -> tuple[Array, Array]:
        """Return changes of modal rates, where a flank is met (P,), by coordinates (P, m, m) and parameters (P, m, p).

        The damper's push sets in there at once, later or earlier.
        """
        impulse = self.contact.damping * self.response
        by_state = -(np.abs(met)[:, None] * impulse)[:, :, None] * self.turns
        return by_state, (met[:, None] * impulse)[:, :, None] * self.gaps / 2
