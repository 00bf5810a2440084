"""The chain's own parameters and those of effects beside them, as one set of coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.effects.effect import Effect
from vjm.experiment.records import REFERENCE, Recording
from vjm.identification.parametrisation import Parametrisation
from vjm.simulate.arm import Arm

Array = NDArray[np.float64]

_INNER_STEP = 1.0  # of a logarithm
_LEAST_JOINT = 1e-3  # of an everyday size: an effect that is a joint of its own must not lose it on the way


@dataclass(frozen=True)
class Extension:
    """Coordinates of the base fit, then those of effects.

    Attributes:
        base: the chain's own.
        effects: what is added, at any size.
        everywhere: number of them, the first ones, that act in the reference recordings too.
    """

    base: Parametrisation
    effects: tuple[Effect, ...]
    everywhere: int = 0

    def chain(self, x: Array) -> Chain:
        """The chain, without effects."""
        return self.base.chain(x[: self._first])

    def present(self, x: Array) -> tuple[Effect, ...]:
        """The effects at coordinates x (p,)."""
        return tuple(effect.at(x[part]) for effect, part in zip(self.effects, self.parts, strict=True))

    def arms(self, x: Array, recordings: Sequence[Recording]) -> tuple[Arm, ...]:
        """What moves in each of the recordings; in those called reference, only what acts everywhere."""
        chain, present = self.chain(x), self.present(x)
        plain, extended = Arm.of(chain, present[: self.everywhere]), Arm.of(chain, present)
        return tuple(plain if each.condition == REFERENCE else extended for each in recordings)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,)."""
        lower, upper = zip(self.base.bounds, *(effect.bounds for effect in self.effects), strict=True)
        found = np.concatenate(lower), np.concatenate(upper)
        for effect, part in zip(self.effects, self.parts, strict=True):
            if adds_joint(effect, self.base.template):
                found[0][part.start] = _LEAST_JOINT
        return found

    @cached_property
    def reach(self) -> Array:
        """(p,) by how much a step of a search may change each coordinate.

        Effects' inner ones, as a time constant's logarithm, mean little while the sizes are wrong, and soon run away.
        """
        found = np.concatenate(
            [self.base.reach, *(np.full(effect.coordinates.size, np.inf) for effect in self.effects)]
        )
        for effect, part in zip(self.effects, self.parts, strict=True):
            found[part.start + effect.sizes : part.stop] = _INNER_STEP
        return found

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """The coordinates of each effect."""
        counts = [effect.coordinates.size for effect in self.effects]
        stops = (self._first + np.cumsum(counts, dtype=int)).tolist()
        return tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))

    @property
    def _first(self) -> int:
        return len(self.base.coordinates)


def adds_joint(effect: Effect, chain: Chain) -> bool:
    """Whether an effect is a joint of its own, which its null value has not."""
    usual = effect.at(np.ones_like(effect.coordinates) * (np.arange(effect.coordinates.size) < effect.sizes))
    return usual.chain(chain).size != chain.size
