"""Levenberg and Marquardt's damping: none as long as full steps help, as much as it takes where they do not."""

from __future__ import annotations

from dataclasses import dataclass

_SMALLEST = 1e-10  # of the columns' squared lengths
_LARGEST = 1e6
_FIRST_RISE = 4.0
_FALL = 5.0


@dataclass(frozen=True)
class Damping:
    """How much a step is held back.

    Attributes:
        value: of the columns' squared lengths; zero for a full step.
        rise: by what factor the next failure raises it; grows with every failure in a row (Nielsen 1999).
    """

    value: float = 0.0
    rise: float = _FIRST_RISE

    @property
    def exhausted(self) -> bool:
        """Whether no step however small has helped."""
        return self.value > _LARGEST

    def better(self) -> Damping:
        """After a step that helped."""
        lower = self.value / _FALL
        return Damping(lower if lower > _SMALLEST else 0.0)

    def worse(self) -> Damping:
        """After a step that did not."""
        return Damping(max(self.rise * self.value, _SMALLEST), 2 * self.rise)
