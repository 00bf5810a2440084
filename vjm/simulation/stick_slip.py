"""Dry friction of active joints: when it stops, holds and releases them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from vjm.records import Array, Indices


class FrictionHistory(NamedTuple):
    """Record of when dry friction has stopped and held active joints, for each half of a motion's H / 2 steps.

    Attributes:
        before, after: (H, ..., n_a) rates at the beginning and at the end of the half step [rad/s].
        stop: (H, ..., n_a) share of it after which the joint stops; infinite where it does not.
        slipping: (H, ..., n_a) acceleration with which it stops [rad/s^2].
        restarted: (H, ..., n_a) acceleration with which it then slips on; zero where friction holds the joint.
        release: (H, ..., n_a) share of the half step after which a joint that is held slips again; infinite where it
            does not.
    """

    before: Array
    after: Array
    stop: Array
    slipping: Array
    restarted: Array
    release: Array

    def of_copy(self, copy: int, steps: int) -> FrictionHistory:
        """Return the first steps of one of the copies."""
        return FrictionHistory(*(values[: 2 * steps, copy] for values in self))


def multiply(states: Array, matrices: Array, out: Array | None = None) -> Array:
    """Return states (C, m) times the transposed matrix of each copy, or that all copies share, in `out` if given."""
    if len(matrices) == 1:
        product: Array = states.dot(matrices[0], out)  # has less overhead than `np.dot` and `np.matmul`
        return product
    result: Array = np.matmul(states[:, None, :], matrices, out=None if out is None else out[:, None, :])[:, 0]
    return result


# A quadratic's values at the start, the middle and the end of a step, from its moments of order 0, 1 and 2 in either
# half, as of `under_friction`: by Legendre's coefficients.
_BY_MOMENTS = np.array(
    [
        [15 / 16, -21 / 4, 15 / 4, -9 / 16, 9 / 4, 15 / 4],
        [21 / 32, 15 / 8, -15 / 8, 21 / 32, -15 / 8, -15 / 8],
        [-9 / 16, -9 / 4, 15 / 4, 15 / 16, 21 / 4, 15 / 4],
    ]
)
# The mean and the change over either half of what is given at the start, in the middle and at the end: Simpson's.
_MEANS_AND_CHANGES = np.array([[5 / 12, 8 / 12, -1 / 12], [-1, 1, 0], [-1 / 12, 8 / 12, 5 / 12], [0, -1, 1]])
_PASSES = 3  # where friction depends on the rate: with more, the error of steps of any length hardly falls


class FrictionWeights(NamedTuple):
    """Mean accelerations of n_a active joints over the halves of a step, by the linear part, transposed (C, ...).

    What remains beside the linear part stays as it is at the start. One copy stands for all where they are equal.

    Attributes:
        by_motion: (C, 4 n, 2 n_a) of either half, by torques, angles, rates and accelerations at the step's start, the
            last of these under friction.
        by_friction: (C, n_a, 2 n_a) by that friction, which is then left out.
        by_torque: (C, 2 n_a, 2 n_a) by the torques on the joints in the middle and at the end of the step.
        mobility: (C, n_a, n_a) of a half step, by torques during it.
        later: (C, n_a, n_a) of the second half, by torques during the first.
    """

    by_motion: Array
    by_friction: Array
    by_torque: Array
    mobility: Array
    later: Array


class StickSlip:
    """Dry friction of the copies' active joints, from step to step.

    The joints' accelerations without it are those of the linear part, which follows fast modes, too. They change
    linearly over the halves of a step, in which a joint stops, is held as long as friction can hold it, and slips on.
    The friction is then replaced by the quadratic with the same mean, first and second moment. A joint that is held
    thus moves by as much as the linear part is wrong, and is stopped again in the next step.

    Attributes:
        torque: (C, n_a) over the second half of the last step [N m].
        history: of all half steps, as far as they have been advanced.
    """

    def __init__(
        self,
        largest: Callable[[Array], Array],
        torques: tuple[Array, Array, Array],
        joints: slice | Indices,
        step: float,
    ) -> None:
        """Begin without friction.

        Args:
            largest: friction torques (..., C, n_a) [N m] at rates (..., C, n_a) [rad/s].
            torques: those on all joints at S steps' starts and at the end of the last (S + 1, C, nv), in their middles
                and at their ends (S, C, nv) [N m]. Friction is added to them.
            joints: coordinates of the active joints.
            step: [s].
        """
        self._largest, self._half_step = largest, step / 2
        self._torques, self._joints = torques, joints
        self._ahead = np.concatenate([torque[:, :, joints] for torque in torques[1:]], axis=2)
        count, copies, _ = torques[1].shape
        self.torque = np.zeros((copies, self._ahead.shape[2] // 2))
        # Arrays of the whole motion: those of single steps would take ten times the memory in a long recording.
        self.history = FrictionHistory(*np.empty((len(FrictionHistory._fields), 2 * count, *self.torque.shape)))
        self._half = 0  # the next one
        self._largest_torques = largest(np.zeros((3, *self.torque.shape)))
        self._moments = np.empty((2, 3, *self.torque.shape))

    def over_step(self, k: int, motion: Array, weights: FrictionWeights) -> tuple[Array, Array]:
        """Add the friction of a step to the torques in its middle and at its end, and at the start of the next one.

        Args:
            k: the step.
            motion: (C, 4 n) torques, angles, rates and accelerations at its start.
            weights: those of the step.

        Returns:
            By how much the quadratic's torque (C, n_a) at the start exceeds the friction that is in the accelerations
            there, and what is missing of it to the friction itself.
        """
        n, acting = motion.shape[1] // 4, self.torque
        rate = motion[:, 2 * n : 3 * n][:, self._joints]
        pushes = multiply(motion, weights.by_motion) + multiply(self._ahead[k], weights.by_torque)
        pushes += multiply(acting, weights.by_friction)
        own = np.diagonal(weights.mobility, axis1=1, axis2=2)
        rates, largest = np.empty(self._largest_torques.shape), self._largest_torques
        rates[0], largest[:2] = rate, largest[2]
        torques = np.stack([self.torque, self.torque])
        for _ in range(_PASSES):
            rates[1:] = self._over_halves(rate, pushes, largest, torques, weights)
            assumed, largest = largest, self._largest(rates)
            if (largest == assumed).all():
                break
        self._half += 2
        self.torque, self._largest_torques = torques[1], largest
        at_start = -np.sign(rate) * largest[0]
        if not rate.all():
            n_a = rate.shape[1]
            holding = (pushes[:, n_a:] / 2 - 1.5 * pushes[:, :n_a]) / own
            at_start = np.where(rate == 0.0, np.maximum(np.minimum(holding, largest[0]), -largest[0]), at_start)
        first, middle, end = _BY_MOMENTS.dot(self._moments.reshape(6, -1)).reshape(rates.shape) / own
        for values, row, added in zip(self._torques, (k + 1, k, k), (self.torque, middle, end), strict=True):
            values[row][:, self._joints] += added
        return first - acting, at_start - first

    def _over_halves(
        self, rate: Array, pushes: Array, largest: Array, torques: Array, weights: FrictionWeights
    ) -> Array:
        """Return rates (2, C, n_a) in the middle and at the end of a step; note what happens, and friction's moments.

        Args:
            rate: (C, n_a) at the start [rad/s].
            pushes: (C, 2 n_a) mean accelerations without friction in the halves [rad/s^2].
            largest: (3, C, n_a) largest friction torques at the start, in the middle and at the end [N m].
            torques: (2, C, n_a) mean torques of the halves [N m]: a guess, which is replaced.
            weights: those of the step.
        """
        n, mobility = rate.shape[1], weights.mobility
        brakes = _MEANS_AND_CHANGES.dot(largest.reshape(3, -1)).reshape(2, 2, *rate.shape)
        change = pushes[:, n:] - pushes[:, :n]
        for half, (torque, moments) in enumerate(zip(torques, self._moments, strict=True)):
            push = pushes[:, n:] + multiply(torques[0], weights.later) if half else pushes[:, :n]
            for j in range(n):  # each under the latest friction of the others
                own, pushed = mobility[:, j, j], push[:, j]
                if n > 1:
                    pushed = pushed + multiply(torque, mobility)[:, j] - own * torque[:, j]
                found, by_friction = under_friction(
                    rate[:, j], (pushed, change[:, j]), own * brakes[half, :, :, j], self._half_step
                )
                torque[:, j] = by_friction[0] / own
                for values, of_joint in zip(self.history, found, strict=True):
                    values[self._half + half, :, j] = of_joint
                for values, of_joint in zip(moments, by_friction, strict=True):
                    values[:, j] = of_joint
            rate = self.history.after[self._half + half]
        return self.history.after[self._half : self._half + 2]


def under_friction(
    rate: Array, push: tuple[Array, Array], braking: tuple[Array, Array], duration: float
) -> tuple[FrictionHistory, tuple[Array, Array, Array]]:
    """Return what becomes of joints in a half step [s], and three moments of the friction's accelerations.

    These are the integrals of the friction, of it times x, and times x^2, from x = -1/2 at the beginning to 1/2.

    Args:
        rate: at its beginning [rad/s].
        push: mean of the accelerations by all but friction, and what they change by [rad/s^2].
        braking: the same of the friction's, against the motion; as large a push it withstands at rest.
        duration: [s].
    """
    (mean, change), (brake, brake_change), direction = push, braking, np.sign(rate)
    slip, slip_change = mean - direction * brake, change - direction * brake_change
    after = rate + duration * slip
    never = np.full(rate.shape, np.inf)
    friction = -direction * brake
    if (rate * after > 0.0).all():  # none stops
        moments = friction, -direction * brake_change / 12, friction / 12
        return FrictionHistory(rate, after, never, slip, slip, never), moments
    # Zero of rate + b share + c share^2: of the two, the one that stays finite as c vanishes, or the other.
    b, c = duration * (slip - slip_change / 2), duration * slip_change / 2
    q = -(b + np.copysign(np.sqrt(np.maximum(b * b - 4 * c * rate, 0.0)), b)) / 2
    zero = rate / q
    zero = np.where(rate == 0.0, 0.0, np.where((zero >= 0.0) & (zero <= 1.0), zero, q / c))
    stops = (rate * after <= 0.0) & (zero >= 0.0) & (zero < 1.0) & (brake > 0.0)
    share = np.where(stops, zero, 1.0)
    left = 1.0 - share
    # Where it stops and at the end: pushes, what friction withstands of them, and what it leaves.
    bound, first, last = brake + brake_change * share / 2, mean + change * (share - 0.5), mean + change / 2
    held = np.maximum(np.minimum(first, bound), -bound)
    restarted = first - held
    turns = restarted != 0.0
    ended = np.where(turns, last - held, last - np.maximum(np.minimum(last, bound), -bound))
    over = np.where(last == first, 1.0, last - first)
    net = np.where(last == first, restarted, (ended - restarted) / over * (ended + restarted) / 2)
    again = turns & (net * restarted < 0.0)  # it turns, and stops again: as if it were held in between
    net, restarted = np.where(again, 0.0, net), np.where(again, 0.0, restarted)
    after = np.where(stops, net * left * duration, after)
    releases, change_held = stops & ~turns & (ended != 0.0), last - ended - held
    release = np.where(releases, share + left * (change_held + held - first) / over, never)
    history = FrictionHistory(
        rate, after, np.where(stops, share, never), slip + slip_change * (share - 0.5), restarted, release
    )
    # The friction until it stops and from then on: means, and what they change by.
    one, other = -direction * (brake - brake_change * left / 2), net - (first + last) / 2
    d_one, d_other = -direction * brake_change * share, -change_held
    by_x = share * left * (other - one) / 2 + (d_other * left**2 + d_one * share**2) / 12
    by_x2 = (
        one * share * (share**2 + 3 * left**2)
        + other * left * (left**2 + 3 * share**2)
        + share * left * (d_other * left - d_one * share)
    ) / 12
    return history, (np.where(stops, (after - rate) / duration - mean, friction), by_x, by_x2)
