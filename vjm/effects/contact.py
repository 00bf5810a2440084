"""Contact of a joint with the flanks of a gap."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

import numpy as np

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
