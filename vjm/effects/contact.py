"""Contact of a joint with the flanks of a gap."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np
from scipy.interpolate import make_interp_spline

from vjm.records import Array, Indices


class Contact(NamedTuple):
    """Flanks to either side of a gap in which a joint turns freely; they push and never pull.

    Attributes, of one contact or arrays of several:
        joint: its coordinate.
        gap: whole width [rad].
        stiffness, damping: of either flank [N m/rad, N m s/rad].
    """

    joint: int | Indices
    gap: float | Array
    stiffness: float | Array
    damping: float | Array

    def at(self, places: Any) -> Self:
        """Return some of several, by an index of their arrays."""
        joint, gap, stiffness, damping = (np.asarray(values)[places] for values in self)
        return self._replace(joint=joint, gap=gap, stiffness=stiffness, damping=damping)

    def depth(self, twist: Array) -> Array:
        """Return how far a flank is pressed in (...) [rad] at angles (...) [rad]; negative between the flanks."""
        return np.asarray(np.abs(twist) - self.gap / 2)

    def resistance(self, twist: Array, rate: Array) -> Array:
        """Return k d + c d' (...) [N m] at angles (...) [rad] and rates (...) [rad/s]: the push where it touches."""
        return np.asarray(self.stiffness * self.depth(twist) + self.damping * np.sign(twist) * rate)

    def event_function(self, twist: Array, rate: Array) -> Array:
        """Return the smaller of depth and resistance (...), whose zeros are events: positive where a flank pushes."""
        return np.asarray(np.minimum(self.depth(twist), self.resistance(twist, rate)))

    def fall(self, time: Array, acceleration: Array) -> Array:
        """Return the motion of a joint that falls freely from one flank to the other, and stops where it lands.

        It leaves a flank when it is pulled off. To first order in the gap, nothing else changes.

        Args:
            time: (I,) instants [s].
            acceleration: (I,) what the joint has where it is free [rad/s^2].

        Returns:
            (3, I) its angles [rad], rates [rad/s] and accelerations [rad/s^2].
        """
        linear, half = make_interp_spline(time, acceleration, k=1), float(self.gap) / 2
        rate_at, angle_at = linear.antiderivative(1), linear.antiderivative(2)
        free, motion = np.stack([angle_at(time), rate_at(time), acceleration]), np.zeros((3, time.size))
        flank, landed = half * float(np.sign(np.trim_zeros(acceleration, "f")[:1]).sum()), 0
        while True:
            pulled_off = np.flatnonzero(flank * acceleration[landed:] < 0)
            leaves = landed + int(pulled_off[0]) if pulled_off.size else time.size
            motion[0, landed:leaves] = flank
            if leaves == time.size:
                return motion
            start = time[leaves]
            if leaves > landed:  # as the acceleration passes zero
                before, after = acceleration[leaves - 1 : leaves + 1]
                start -= after / (after - before) * (start - time[leaves - 1])
            falling = free[:, leaves:].copy()
            falling[0] += flank - angle_at(start) - (time[leaves:] - start) * rate_at(start)
            falling[1] -= rate_at(start)
            outside = np.abs(falling[0]) > half
            outside[0] &= flank * falling[0, 0] < 0  # it has just left the other one
            landed = leaves + (int(np.argmax(outside)) if outside.any() else outside.size)
            motion[:, leaves:landed] = falling[:, : landed - leaves]
            if landed == time.size:
                return motion
            flank = float(np.copysign(half, falling[0, landed - leaves]))
