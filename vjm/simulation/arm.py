"""An arm to simulate: a chain, and the effects on it and on its sensors."""

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
_MOMENT = 1e-4  # s, over which encoders' readings are differentiated


@dataclass(frozen=True)
class Arm:
    """A chain with effects.

    Attributes:
        chain: with all that the effects change of it.
        effects: those present, in the order in which they were added.
        feedback: from measured angles to active joints; None: open loop.
    """

    chain: Chain
    effects: tuple[Effect, ...] = ()
    feedback: EncoderFeedback | None = None

    def __reduce__(self) -> tuple[type[Arm], tuple[Chain, tuple[Effect, ...], EncoderFeedback | None]]:
        return Arm, (self.chain, self.effects, self.feedback)  # without cached functions, which cannot be pickled

    @classmethod
    def of(cls, chain: Chain, effects: Sequence[Effect] = ()) -> Arm:
        """Return a chain with effects added; those at their null are left out."""
        present = tuple(effect for effect in effects if not effect.is_null)
        for effect in present:
            chain = effect.chain(chain)
        return cls(chain, present)

    def with_feedback(self, feedback: EncoderFeedback | None) -> Arm:
        """Return the same arm with other feedback."""
        return self if feedback is self.feedback else replace(self, feedback=feedback)

    def inputs(self, recording: Recording) -> Recording:
        """Return the recording with the inputs that really drove the arm."""
        for effect in self.effects:
            recording = effect.true_inputs(recording)
        return recording

    @cached_property
    def states(self) -> tuple[int, ...]:
        """Number of each effect's internal states."""
        return tuple(effect.state_count(self.chain) for effect in self.effects)

    def initial_states(self, q: Array) -> Array:
        """Return (..., nz) internal states at a recording's start, at angles q (..., nv) [rad]."""
        parts = [effect.initial_states(self.chain, q) for effect in self.effects]
        return np.concatenate([np.zeros((*q.shape[:-1], 0)), *parts], axis=-1)

    def rest_angles(self, q: Array) -> Array:
        """Return angles (..., nv) near the given ones [rad] at which the effects let the arm stay."""
        for effect in self.effects:
            q = effect.rest_angles(self.chain, q)
        return q

    def forces(self, payload: float) -> Motion | None:
        """Return the sum of the effects' generalised forces; None where there are none."""
        forces = self._hooks(lambda effect: effect.force(self.chain, payload))
        if not forces:
            return None
        if len(self.effects) == 1:
            return forces[0][0]

        def total(time: Array, q: Array, v: Array, z: Array) -> Array:
            return np.asarray(sum(force(time, q, v, z[..., part]) for force, part in forces))

        return total

    @cached_property
    def rates(self) -> Motion | None:
        """Rates of change of all internal states; None where there are none."""
        functions = self._hooks(lambda effect: effect.state_rates(self.chain))
        if not functions:
            return None

        def all_rates(time: Array, q: Array, v: Array, z: Array) -> Array:
            rates = np.zeros(z.shape)
            for function, part in functions:
                rates[..., part] = function(time, q, v, z[..., part])
            return rates

        return all_rates

    @cached_property
    def rate_independent_update(self) -> RateIndependentUpdate | None:
        """Update of the internal states that depend on the joints' path only; None where none does."""
        functions = self._hooks(lambda effect: effect.rate_independent_update(self.chain))
        if not functions:
            return None

        def update(q: Array, z: Array, to: Array) -> Array:
            updated = z.copy()
            for function, part in functions:
                updated[..., part] = function(q, z[..., part], to)
            return updated

        return update

    @property
    def longest_step(self) -> float:
        """Time step that the effects allow [s]."""
        return min((effect.max_step for effect in self.effects), default=np.inf)

    @cached_property
    def sensors(self) -> tuple[Effect, ...]:
        """Effects on the sensors."""
        return tuple(effect for effect in self.effects if effect.sensor)

    def encoder_angles(self, theta: Array) -> Array:
        """Return the encoders' readings of active joints' angles (..., n_a) [rad]."""
        for effect in self.sensors:
            theta = effect.encoder_angles(theta)
        return theta

    def read_encoders(self, theta: Array, rate: Array) -> tuple[Array, Array]:
        """Return the encoders' readings of angles [rad] and rates [rad/s] (..., n_a) of the active joints."""
        if all(type(effect).encoder_angles is Effect.encoder_angles for effect in self.sensors):
            return theta, rate
        flat, flat_rate = (values.reshape(-1, theta.shape[-1]) for values in (theta, rate))
        before, now, after = (self.encoder_angles(flat + t * flat_rate) for t in (-_MOMENT, 0, _MOMENT))
        return now.reshape(theta.shape), ((after - before) / (2 * _MOMENT)).reshape(theta.shape)

    @cached_property
    def smooth(self) -> tuple[Arm, NDArray[np.intp]]:
        """The arm of which derivatives are taken, and which of this arm's internal states it has."""
        effects = tuple(effect.smoothed() for effect in self.effects)
        if all(one is two for one, two in zip(effects, self.effects, strict=True)):
            return self, np.arange(sum(self.states))
        kept = [
            np.arange(part.start, part.stop)
            for part, effect in zip(self._state_slices, effects, strict=True)
            if effect.state_count(self.chain)
        ]
        return Arm(self.chain, effects, self.feedback), np.concatenate([np.zeros(0, dtype=np.intp), *kept])

    @cached_property
    def _state_slices(self) -> list[slice]:
        stops = np.cumsum(self.states, dtype=int).tolist()
        return [slice(stop - count, stop) for stop, count in zip(stops, self.states, strict=True)]

    def _hooks(self, hook: Callable[[Effect], T | None]) -> list[tuple[T, slice]]:
        """Results of a hook, with the internal states of their effects; None is left out."""
        results = [(hook(effect), part) for effect, part in zip(self.effects, self._state_slices, strict=True)]
        return [(result, part) for result, part in results if result is not None]
