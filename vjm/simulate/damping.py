"""Levenberg and Marquardt's damping: none as long as full steps help, as much as it takes where they do not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

_SMALLEST = 1e-10  # of the columns' squared lengths
_LARGEST = 1e6
_RISE = 4.0
_FALL = 5.0
_SHORTER = 0.5


@dataclass(frozen=True)
class Damping:
    """How much a step is held back.

    Attributes:
        value: of the columns' squared lengths; zero for a full step.
    """

    value: float = 0.0

    @property
    def exhausted(self) -> bool:
        """Whether no step however small has helped."""
        return self.value > _LARGEST

    def better(self) -> Damping:
        """After a step that helped."""
        lower = self.value / _FALL
        return Damping(lower if lower > _SMALLEST else 0.0)

    def worse(self, length: Callable[[float], float]) -> Damping:
        """After a step that did not: so much more that the next one is clearly shorter, or it would only fail again.

        Args:
            length: of the step at a damping, in any metric.
        """
        longest, found = _SHORTER * length(self.value), self
        while not found.exhausted:
            found = Damping(max(_RISE * found.value, _SMALLEST))
            if length(found.value) < longest:
                break
        return found
