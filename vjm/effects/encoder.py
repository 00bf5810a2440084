"""An encoder whose zero is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.effects.effect import size
from vjm.effects.places import NO_ENCODER, ColumnEffect, has_encoder
from vjm.experiment.records import Recording, Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EncoderOffset(ColumnEffect):
    """The encoder's zero is not where the link points along x.

    Attributes:
        offset: shown less true angle [rad].
    """

    offset: float = size("rad", 0.005, lower=-np.pi, upper=np.pi)

    id = "encoder_offset"
    says = "the encoder's zero is off"
    reference = (
        "J. M. Hollerbach and C. W. Wampler, The calibration index and taxonomy for robot kinematic calibration "
        "methods, International Journal of Robotics Research 15(6), 1996"
    )
    apart_by = "a fixed fiducial beside the base in the camera's view; under gravity, static sag at several hub angles"
    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Without an encoder there is nothing to be wrong."""
        return super().untestable(rig, recordings) or ("" if has_encoder(recordings) else NO_ENCODER)

    def encoder(self, theta: Array) -> Array:
        """Shifted."""
        return theta if self.is_null else self.column_of(theta, 1.0, self.offset)
