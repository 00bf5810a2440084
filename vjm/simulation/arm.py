"""An arm to simulate: a chain, the effects on it and on its sensors, and feedback from its encoders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, Motion, RateIndependentUpdate, is_nonsmooth
from vjm.errors import InsufficientDataError
from vjm.markers.smoothing import Smoother
from vjm.model.dynamics import Mechanism
from vjm.model.urdf import chain_to_urdf
from vjm.records import Array, Recording

T = TypeVar("T")
_MOMENT = 1e-4  # s, over which encoders' readings are differentiated
_GRID = 1e-3  # s; encoders are no faster, and in between it is interpolated


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
        q = np.zeros(self.chain.size)
        return tuple(effect.initial_states(self.chain, q).size for effect in self.effects)

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

    def state_rates(self, time: Array, q: Array, v: Array, z: Array) -> Array:
        """Return rates of change of all internal states (..., nz) in a motion, whose time is since the start."""
        rates = np.zeros(z.shape)
        for function, part in self._state_rates:
            rates[..., part] = function(time, q, v, z[..., part])
        return rates

    def update_states(self, q: Array, z: Array, to: Array) -> Array:
        """Return internal states (..., nz) after a change of angles (..., nv); only rate-independent ones change."""
        updated = z.copy()
        for function, part in self._state_updates:
            updated[..., part] = function(q, z[..., part], to)
        return updated

    def urdf(self) -> str:
        """Return the URDF of the chain, with dry friction at its active joints.

        Raises:
            ShapeError: as of `chain_to_urdf`.
        """
        friction: dict[str, float] = {}
        for effect in self.effects:
            if effect.joint_friction:
                name = self.chain.links[effect.link or 0].name
                friction[name] = friction.get(name, 0.0) + effect.joint_friction
        return chain_to_urdf(self.chain, friction)

    @property
    def longest_step(self) -> float:
        """Time step that the effects allow [s]."""
        return min((effect.max_step(self.chain) for effect in self.effects), default=np.inf)

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
        if not is_nonsmooth(self.effects):
            return self, np.arange(sum(self.states))
        effects = tuple(replace(effect, smooth=True) for effect in self.effects)
        smooth = Arm(self.chain, effects, self.feedback)
        slices = zip(self._state_slices, smooth.states, strict=True)
        return smooth, np.concatenate([np.arange(part.start, part.start + count) for part, count in slices])

    @cached_property
    def _state_rates(self) -> list[tuple[Motion, slice]]:
        return self._hooks(lambda effect: effect.state_rates(self.chain))

    @cached_property
    def _state_updates(self) -> list[tuple[RateIndependentUpdate, slice]]:
        return self._hooks(lambda effect: effect.rate_independent_update(self.chain))

    @cached_property
    def _state_slices(self) -> list[slice]:
        stops = np.cumsum(self.states, dtype=int).tolist()
        return [slice(stop - count, stop) for stop, count in zip(stops, self.states, strict=True)]

    def _hooks(self, hook: Callable[[Effect], T | None]) -> list[tuple[T, slice]]:
        """Results of a hook, with the internal states of their effects; None is left out."""
        results = [(hook(effect), part) for effect, part in zip(self.effects, self._state_slices, strict=True)]
        return [(result, part) for result, part in results if result is not None]


@dataclass(frozen=True)
class EncoderFeedback:
    """Springs and dampers from active joints to measured angles, of one recording or of C copies.

    They are for fits of joints that stick. Simulated open loop, a joint that sticks a moment too early stays off for
    the rest of the recording, and the cost has many minima. With feedback it comes back: residuals show what the model
    lacks, and parameters that are right leave nothing but noise, as they do open loop.

    Source: L. Ljung, System Identification: Theory for the User, 2nd ed. 1999, section 4.3 (a predictor that is
    corrected by what was measured, with a gain that is given).

    Attributes:
        theta, rate: (S, n_a) or (S, C, n_a) angles [rad] and rates [rad/s] at every `_GRID` since the start.
        stiffness, damping: (n_a,) or (C, n_a) [N m/rad, N m s/rad].
    """

    theta: Array = field(repr=False)
    rate: Array = field(repr=False)
    stiffness: Array
    damping: Array

    @classmethod
    def of(
        cls, recording: Recording, chain: Chain, noise: float, frequency: float, ratio: float
    ) -> EncoderFeedback | None:
        """Return feedback on which a chain's active joints would oscillate slowly.

        Args:
            recording: where angles were measured.
            chain: gives the joints' inertia.
            noise: 1-sigma of an angle [rad].
            frequency: of that oscillation [Hz].
            ratio: its damping ratio.

        Returns:
            The feedback; None where there is no active joint, or too little was measured.
        """
        known = np.isfinite(recording.theta).all(axis=1)
        if not chain.active.size:
            return None
        try:
            smoother = Smoother(recording.time[known])
        except InsufficientDataError:
            return None
        smooth = smoother.derivatives(recording.theta[known], np.full(chain.active.size, noise))
        time = recording.time[known] - recording.time[0]
        grid = _GRID * np.arange(int(np.ceil(np.ptp(recording.time) / _GRID)) + 2)
        theta, rate = (
            np.stack([np.interp(grid, time, column) for column in columns.T], axis=-1)
            for columns in (smooth.value, smooth.rate)
        )
        mechanism = Mechanism(chain, recording.payload)
        inertia = np.diag(mechanism.mass_matrix(np.zeros((1, chain.size)))[0])[chain.active]
        omega = 2 * np.pi * frequency
        return cls(theta, rate, inertia * omega**2, 2 * ratio * omega * inertia)

    @classmethod
    def stacked(cls, feedbacks: Sequence[EncoderFeedback | None]) -> EncoderFeedback | None:
        """Return the feedback of copies that are advanced together; None where none has any."""
        given = [feedback for feedback in feedbacks if feedback is not None]
        if not given:
            return None
        longest, zero = max(len(feedback.theta) for feedback in given), np.zeros(given[0].stiffness.shape)

        def extend(values: Array) -> Array:
            return np.concatenate([values, np.repeat(values[-1:], longest - len(values), axis=0)])

        return cls(
            np.stack([extend(feedback.theta if feedback else zero[None]) for feedback in feedbacks], axis=1),
            np.stack([extend(feedback.rate if feedback else zero[None]) for feedback in feedbacks], axis=1),
            np.stack([feedback.stiffness if feedback else zero for feedback in feedbacks]),
            np.stack([feedback.damping if feedback else zero for feedback in feedbacks]),
        )

    def torque(self, time: ArrayLike, theta: Array, rate: Array) -> Array:
        """Return torques (..., n_a) [N m] at a time since the start [s], for encoders' readings (..., n_a)."""
        place = np.clip(np.asarray(time, dtype=float) / _GRID, 0.0, len(self.theta) - 2)
        first = place.astype(int)
        share = (place - first)[..., None]
        angle = (1 - share) * self.theta[first] + share * self.theta[first + 1]
        speed = (1 - share) * self.rate[first] + share * self.rate[first + 1]
        torque: Array = self.stiffness * (angle - theta) + self.damping * (speed - rate)
        return torque
