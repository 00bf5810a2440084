"""What is simulated: a chain, and what acts on it and on its sensors beyond it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, Motion, RateIndependentUpdate
from vjm.records import Array, Recording
from vjm.simulation.encoder_feedback import EncoderFeedback

T = TypeVar("T")


@dataclass(frozen=True)
class Arm:
    """A chain with effects.

    Attributes:
        chain: with all that the effects change of it.
        effects: those present, in the order in which they were added.
        feedback: what draws its active joints towards what was measured; None: it moves as it does.
    """

    chain: Chain
    effects: tuple[Effect, ...] = ()
    feedback: EncoderFeedback | None = None

    def __reduce__(self) -> tuple[type[Arm], tuple[Chain, tuple[Effect, ...], EncoderFeedback | None]]:
        return Arm, (self.chain, self.effects, self.feedback)  # without functions that were kept

    @classmethod
    def of(cls, chain: Chain, effects: Sequence[Effect] = ()) -> Arm:
        """A chain with effects added; those at their null are left out."""
        present = tuple(effect for effect in effects if not effect.is_null)
        for effect in present:
            chain = effect.chain(chain)
        return cls(chain, present)

    def with_feedback(self, feedback: EncoderFeedback | None) -> Arm:
        """The same on a guide."""
        return self if feedback is self.feedback else replace(self, feedback=feedback)

    def inputs(self, recording: Recording) -> Recording:
        """The recording with what really drove the arm."""
        for effect in self.effects:
            recording = effect.true_inputs(recording)
        return recording

    @cached_property
    def states(self) -> tuple[int, ...]:
        """Number of each effect's internal states."""
        return tuple(effect.state_count(self.chain) for effect in self.effects)

    def rest(self, q: Array) -> Array:
        """(..., nz) internal states at a recording's start, at angles q (..., nv) [rad]."""
        parts = [effect.initial_states(self.chain, q) for effect in self.effects]
        return np.concatenate([np.zeros((*q.shape[:-1], 0)), *parts], axis=-1)

    def rest_state(self, q: Array) -> Array:
        """Angles (..., nv) near the given ones [rad] at which its effects let it stay."""
        for effect in self.effects:
            q = effect.rest_angles(self.chain, q)
        return q

    def forces(self, payload: float) -> Motion | None:
        """The effects' generalised forces together; None where there are none."""
        acting = self._told(lambda effect: effect.force(self.chain, payload))
        if not acting:
            return None
        if len(acting) == 1 and len(self.effects) == 1:
            return acting[0][0]

        def total(time: Array, q: Array, v: Array, z: Array) -> Array:
            summed = acting[0][0](time, q, v, z[..., acting[0][1]])
            for force, part in acting[1:]:
                summed = summed + force(time, q, v, z[..., part])
            return summed

        return total

    @cached_property
    def rates(self) -> Motion | None:
        """Rates of change of all internal states; None where there are none."""
        changing = self._told(lambda effect: effect.state_rates(self.chain))
        if not changing:
            return None

        def together(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(z.shape)
            for rates, part in changing:
                found[..., part] = rates(time, q, v, z[..., part])
            return found

        return together

    @cached_property
    def rate_independent_update(self) -> RateIndependentUpdate | None:
        """How internal states follow the joints' way, the others as given; None where none does."""
        following = self._told(lambda effect: effect.rate_independent_update(self.chain))
        if not following:
            return None

        def together(q: Array, z: Array, to: Array) -> Array:
            found = z.copy()
            for rate_independent_update, part in following:
                found[..., part] = rate_independent_update(q, z[..., part], to)
            return found

        return together

    @property
    def longest_step(self) -> float:
        """Time step that the effects allow [s]."""
        return min((effect.max_step for effect in self.effects), default=np.inf)

    @cached_property
    def sensors(self) -> tuple[Effect, ...]:
        """The effects that are in the sensors."""
        return tuple(effect for effect in self.effects if effect.sensor)

    @cached_property
    def smooth(self) -> tuple[Arm, NDArray[np.intp]]:
        """The arm of which derivatives are taken, and which of this arm's internal states it has."""
        effects = tuple(effect.smoothed() for effect in self.effects)
        if all(one is two for one, two in zip(effects, self.effects, strict=True)):
            return self, np.arange(sum(self.states))
        kept = [
            np.arange(part.start, part.stop)
            for part, effect in zip(self._parts, effects, strict=True)
            if effect.state_count(self.chain)
        ]
        return Arm(self.chain, effects, self.feedback), np.concatenate([np.zeros(0, dtype=np.intp), *kept])

    @cached_property
    def _parts(self) -> list[slice]:
        stops = np.cumsum(self.states, dtype=int).tolist()
        return [slice(stop - count, stop) for stop, count in zip(stops, self.states, strict=True)]

    def _told(self, hook: Callable[[Effect], T | None]) -> list[tuple[T, slice]]:
        """What a hook of the effects says, and which internal states are theirs, of those where it says anything."""
        told = [(hook(effect), part) for effect, part in zip(self.effects, self._parts, strict=True)]
        return [(each, part) for each, part in told if each is not None]
