"""Where effects act: on active joints, on links or on the tip; and what recordings must hold to show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.effects.effect import Effect
from vjm.experiment.records import Recording, Rig

Array = NDArray[np.float64]

NO_JOINT = "the arm has no active joint"
NO_TORQUE = "no torque was recorded"
NO_ENCODER = "no encoder was recorded"
NO_CLOCK = "nothing but the camera was recorded, so there is no other clock"
LINK_FRAME = "marker coordinates are relative to a link that turns, not to the camera"


@dataclass(frozen=True)
class LinkEffect(Effect):
    """Acts on a link, the first one where none is named."""

    @property
    def index(self) -> int:
        """Of the link."""
        return self.link or 0

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Every link."""
        return tuple(range(len(rig.links)))


@dataclass(frozen=True)
class JointEffect(LinkEffect):
    """Acts at a link's active joint."""

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """Links with an active joint."""
        return rig.active_links

    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        """Nothing turns where every link is clamped."""
        return "" if rig.active_links else NO_JOINT


@dataclass(frozen=True)
class ColumnEffect(JointEffect):
    """Acts on an active joint's column of a recording.

    Attributes:
        column: of `Recording.tau` and `Recording.theta`; None: the link's index, right where no link before it is
            clamped.
    """

    column: int | None = field(default=None, kw_only=True)

    @property
    def own(self) -> int:
        """The joint's column."""
        return self.index if self.column is None else self.column

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """One for each active joint."""
        found = super().variants(rig, recordings)
        return tuple(replace(each, column=rig.active_links.index(each.index)) for each in found)

    def column_of(self, values: Array, gain: float, offset: float) -> Array:
        """The joint's column of values (T, n_a) times a gain, and an offset added."""
        changed = values.copy()
        changed[:, self.own] = gain * values[:, self.own] + offset
        return changed


@dataclass(frozen=True)
class TipEffect(Effect):
    """Acts at the distal end of the last link."""

    def places(self, rig: Rig) -> tuple[int | None, ...]:
        """The last link."""
        return (len(rig.links) - 1,)


def changed_link(chain: Chain, index: int, **changes: Any) -> Chain:
    """The chain with fields of one link replaced."""
    links = list(chain.links)
    links[index] = replace(links[index], **changes)
    return replace(chain, links=tuple(links))


def active_coordinate(chain: Chain, index: int) -> int:
    """Coordinate of a link's active joint."""
    return int(chain.passive_slices[index].stop) - chain.links[index].coordinates


def has_torque(recordings: Sequence[Recording]) -> bool:
    """Whether any torque was recorded."""
    return any(bool(np.isfinite(recording.tau).any()) for recording in recordings)


def has_encoder(recordings: Sequence[Recording]) -> bool:
    """Whether any active joint angle was recorded."""
    return any(bool(np.isfinite(recording.theta).any()) for recording in recordings)


def in_base_frame(rig: Rig) -> bool:
    """Whether all marker coordinates are as the camera sees them: the frame of a first, clamped link is the base's."""
    return all(
        link.markers_frame == "base" or (i == 0 and link.joint == "clamped")
        for i, link in enumerate(rig.links)
        if link.markers
    )
