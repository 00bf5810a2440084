"""A torque sensor, or a motor's torque constant, that is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from vjm.effects.effect import size
from vjm.effects.places import NO_TORQUE, ColumnEffect, has_torque
from vjm.experiment.records import Recording, Rig


@dataclass(frozen=True)
class TorqueEffect(ColumnEffect):
    """Changes the torque that really acted."""

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Without torques there is nothing to be wrong."""
        return super().untestable(rig, recordings) or ("" if has_torque(recordings) else NO_TORQUE)


@dataclass(frozen=True)
class TorqueGain(TorqueEffect):
    """The true torque is a multiple of the recorded one.

    Attributes:
        gain: true over recorded.
    """

    gain: float = size("", 0.05, null=1.0, lower=0.2, upper=5.0)

    id = "torque_gain"
    says = "the true torque is a multiple of the recorded one"
    reference = (
        "M. Gautier and S. Briot, Global identification of joint drive gains and dynamic parameters of robots, Journal "
        "of Dynamic Systems, Measurement, and Control 136(5), 2014"
    )
    apart_by = "a recording with a weighed mass on the tip"

    def inputs(self, recording: Recording) -> Recording:
        """With the true torque."""
        return recording if self.is_null else replace(recording, tau=self.column_of(recording.tau, self.gain, 0.0))


@dataclass(frozen=True)
class TorqueOffset(TorqueEffect):
    """The true torque is the recorded one and a constant.

    Attributes:
        offset: true less recorded [N m].
    """

    offset: float = size("N m", 0.005)

    id = "torque_offset"
    says = "a constant torque beside the recorded one"
    reference = (
        "J. Swevers, W. Verdonck and J. De Schutter, Dynamic model identification for industrial robots, IEEE Control "
        "Systems Magazine 27(5), 2007"
    )
    apart_by = "recordings at several hub angles, and slow sweeps in both directions"

    def inputs(self, recording: Recording) -> Recording:
        """With the true torque."""
        return recording if self.is_null else replace(recording, tau=self.column_of(recording.tau, 1.0, self.offset))
