"""A mass on the tip."""

from __future__ import annotations

from dataclasses import dataclass

from vjm.chain.records import Chain
from vjm.effects.effect import size
from vjm.effects.places import TipEffect, changed_link


@dataclass(frozen=True)
class TipPayload(TipEffect):
    """A point mass at the distal end of the last link.

    Attributes:
        mass: [kg].
    """

    mass: float = size("kg", 0.01, lower=0.0)

    id = "tip_payload"
    says = "an unknown mass on the tip"
    reference = "L. Meirovitch, Fundamentals of Vibrations, McGraw-Hill, 2001"
    apart_by = "a recording with a known mass on the tip, static sag under gravity, or driven recordings"
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """With a larger payload."""
        if self.is_null:
            return chain
        return changed_link(chain, -1, payload=chain.links[-1].payload + self.mass)
