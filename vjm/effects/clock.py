"""Cameras that do not see everything at the instant of the time stamp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.effects.effect import Effect, size
from vjm.effects.places import LINK_FRAME, NO_CLOCK, has_encoder, has_torque, in_base_frame
from vjm.experiment.records import Recording, Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ClockEffect(Effect):
    """In the camera's clock against that of encoders and torques."""

    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """One clock alone is never wrong."""
        return "" if has_torque(recordings) or has_encoder(recordings) else NO_CLOCK


@dataclass(frozen=True)
class TimeOffset(ClockEffect):
    """The camera shows an earlier state than that of its time stamp.

    Attributes:
        delay: [s].
    """

    delay: float = size("s", 0.015, lower=-0.1, upper=0.1)

    id = "time_offset"
    says = "a camera that lags behind its time stamps"
    reference = (
        "P. Furgale, J. Rehder and R. Siegwart, Unified temporal and spatial calibration for multi-sensor systems, "
        "IEEE/RSJ International Conference on Intelligent Robots and Systems (IROS), 2013"
    )
    apart_by = "driven recordings with fast motion, and two recordings that start differently"

    def instants(self, time: Array, positions: Array) -> Array:
        """Earlier."""
        return time if self.is_null else time - self.delay


@dataclass(frozen=True)
class ClockScale(ClockEffect):
    """The camera's clock runs faster than the encoder's.

    Attributes:
        scale: time of the camera over true time.
    """

    scale: float = size("", 0.002, null=1.0, lower=0.8, upper=1.25)

    id = "clock_scale"
    says = "a camera whose clock does not run at the encoder's rate"
    reference = (
        "E. Olson, A passive solution to the sensor synchronization problem, IEEE/RSJ International Conference on "
        "Intelligent Robots and Systems (IROS), 2010"
    )
    apart_by = "long driven recordings"

    def instants(self, time: Array, positions: Array) -> Array:
        """By the encoder's clock."""
        return time if self.is_null else time / self.scale


@dataclass(frozen=True)
class RollingShutter(Effect):
    """Rows are read one after another: a marker is shown as it was earlier, in proportion to its y.

    Attributes:
        readout: delay over y [s/m].
    """

    readout: float = size("s/m", 0.005, lower=-0.2, upper=0.2)

    id = "rolling_shutter"
    says = "a camera that reads its rows one after another"
    reference = (
        "C.-K. Liang, L.-W. Chang and H. H. Chen, Analysis and compensation of rolling shutter effect, IEEE "
        "Transactions on Image Processing 17(8), 2008"
    )
    apart_by = "fast motion far to both sides of the base"
    sensor = True

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Rows are the camera's."""
        return "" if in_base_frame(rig) else LINK_FRAME

    def instants(self, time: Array, positions: Array) -> Array:
        """Each marker's own."""
        return time if self.is_null else time[:, None] - self.readout * positions[..., 1]
