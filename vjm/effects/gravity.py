"""Gravity in the plane of motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

from vjm.effects.effect import Effect, size
from vjm.experiment.records import Recording


@dataclass(frozen=True)
class InPlaneGravity(Effect):
    """Uniform gravity in the plane, beside what is known: the base is tilted.

    Attributes:
        gx, gy: in the base frame [m/s^2].
    """

    gx: float = size("m/s^2", 0.25, lower=-30.0, upper=30.0)
    gy: float = size("m/s^2", 0.25, lower=-30.0, upper=30.0)

    id = "in_plane_gravity"
    says = "gravity in the plane of motion: the base is tilted"
    reference = "B. Siciliano et al., Robotics: Modelling, Planning and Control, Springer, 2009, chapter 7"
    apart_by = "recordings at several hub angles"

    def inputs(self, recording: Recording) -> Recording:
        """With more gravity."""
        if self.is_null:
            return recording
        x, y = recording.gravity
        return replace(recording, gravity=(x + self.gx, y + self.gy))
