"""Dry friction of active joints: when it stops, holds and releases them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vjm.records import Array, Indices, Mask


class FrictionHistory(NamedTuple):
    """Record of when dry friction has stopped and held active joints, for each half of a motion's H / 2 steps.

    Attributes:
        before, after: (H, ..., n_a) rates at the beginning and at the end of the half step [rad/s].
        stop: (H, ..., n_a) share of it after which the joint stops; infinite where it does not.
        slipping: (H, ..., n_a) acceleration until then [rad/s^2].
        restarted: (H, ..., n_a) acceleration from then on if it stops; zero where friction holds the joint.
    """

    before: Array
    after: Array
    stop: Array
    slipping: Array
    restarted: Array

    def of_copy(self, copy: int, steps: int) -> FrictionHistory:
        """Return the first steps of one of the copies."""
        return FrictionHistory(*(values[: 2 * steps, copy] for values in self))

    def pieces(self, edges: Indices) -> Pieces:
        """Cut intervals, of which the instants (K + 1,) between them are numbers of half steps, where joints change."""
        begin = max(int(edges[0]) - 1, 0)  # with the half step before, in which a joint may have been held
        before, after, stop, slipping, restarted = (values[begin : edges[-1]] for values in self)
        edges = edges - begin
        holds = np.isfinite(stop) & (restarted == 0.0)
        held_before = np.concatenate([np.zeros_like(holds[:1]), holds[:-1]])
        stops, released = np.isfinite(stop) & ~held_before, held_before & ~holds
        half, joint = np.nonzero((stops | released)[edges[0] :])
        half += edges[0]
        change = half + np.where(stops[half, joint], stop[half, joint], 0.0)
        bounds = np.unique(np.concatenate([edges, change]))
        middle = (bounds[:-1] + bounds[1:]) / 2
        now, interval = middle.astype(int), np.searchsorted(edges, middle) - 1
        changed = held_before[now] | (middle[:, None] - now[:, None] >= stop[now])
        slipped, left = slipping[half, joint], restarted[half, joint]
        kept = np.divide(left, slipped, out=np.zeros(half.size), where=slipped != 0.0)
        lost = np.zeros(changed.shape)
        lost[np.searchsorted(bounds, change), joint] = np.where(stops[half, joint], 1.0 - kept, 0.0)
        lengths = edges[interval + 1] - edges[interval]
        return Pieces(
            interval,
            (bounds[:-1] - edges[interval]) / lengths,
            (bounds[1:] - edges[interval]) / lengths,
            holds[now] & changed,
            np.sign(np.where(changed, after[now], before[now])),
            lost,
        )


class Pieces(NamedTuple):
    """P pieces of K intervals, in each of which an active joint is held, or slips in one direction.

    Attributes:
        interval: (P,) the interval that it is a piece of.
        start, end: (P,) shares of the interval.
        held: (P, n_a) true for joints that are held.
        direction: (P, n_a) sign of the rate of the others.
        lost: (P, n_a) share of a small change of the joint's rate that is lost at the piece's beginning: all of it
            where the joint stops there, part of it where it turns round.
    """

    interval: Indices
    start: Array
    end: Array
    held: Mask
    direction: Array
    lost: Array

    @property
    def at_edges(self) -> Indices:
        """(K + 1,) pieces that begin at the intervals' edges; at the last one, the piece that ends there."""
        return np.append(np.flatnonzero(self.start == 0.0), len(self.start) - 1)

    def sampled(self, values: Array) -> tuple[Array, Array, Array]:
        """Return values (P, ...) at each piece's beginning, middle and end, by parabolas through those of intervals.

        Args:
            values: (2 K + 1, ...) at the beginning, the middle and the end of each interval.
        """
        first, middle, last = (values[2 * self.interval + k] for k in range(3))
        shares = (self.start, (self.start + self.end) / 2, self.end)
        x = [share.reshape(-1, *(1,) * (values.ndim - 1)) for share in shares]
        at = [(1 - s) * (1 - 2 * s) * first + 4 * s * (1 - s) * middle + s * (2 * s - 1) * last for s in x]
        return at[0], at[1], at[2]


def under_friction(rate: Array, push: Array, braking: Array, duration: float) -> FrictionHistory:
    """Return what becomes of joints in a half step [s].

    Args:
        rate: at its beginning [rad/s].
        push: accelerations by all but friction [rad/s^2].
        braking: the friction's, against the motion; as large a push it withstands at rest.
        duration: [s].
    """
    slipping = push - np.sign(rate) * braking
    after = rate + slipping * duration
    never = np.full(rate.shape, np.inf)
    if (rate * after > 0.0).all():  # none stops
        return FrictionHistory(rate, after, never, slipping, slipping)
    until = np.where(rate == 0.0, 0.0, -rate / slipping)
    restarted = push - np.maximum(np.minimum(push, braking), -braking)
    stops = (until >= 0.0) & (until < duration) & (braking > 0.0)
    after = np.where(stops, restarted * (duration - until), after)
    return FrictionHistory(rate, after, np.where(stops, until / duration, never), slipping, restarted)
