"""Contact of a joint with the flanks of a gap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vjm.records import Array


class Contact(NamedTuple):
    """Flanks to either side of a gap in which a joint turns freely; they push and never pull.

    Attributes:
        joint: its coordinate.
        gap: whole width [rad].
        stiffness, damping: of either flank [N m/rad, N m s/rad].
    """

    joint: int
    gap: float
    stiffness: float
    damping: float

    def depth(self, twist: Array) -> Array:
        """Return how far a flank is pressed in (...) [rad] at angles (...) [rad]; negative between the flanks."""
        return np.asarray(np.abs(twist) - self.gap / 2)

    def resistance(self, twist: Array, rate: Array) -> Array:
        """Return k d + c d' (...) [N m] at angles (...) [rad] and rates (...) [rad/s]: the push where it touches."""
        return np.asarray(self.stiffness * self.depth(twist) + self.damping * np.sign(twist) * rate)

    def touches(self, twist: Array, rate: Array) -> Array:
        """Return where (...) the joint is pressed against a flank."""
        return np.asarray(self.torque(twist, rate) != 0.0)

    def torque(self, twist: Array, rate: Array) -> Array:
        """Return the flanks' torque (...) on the joint [N m]."""
        push = np.where(self.depth(twist) > 0.0, np.maximum(self.resistance(twist, rate), 0.0), 0.0)
        return np.asarray(-np.sign(twist) * push)
