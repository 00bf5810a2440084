"""An arm to simulate: a chain, and the effects on it and on its sensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.effects.contact import Contact
from vjm.effects.effect import Effect, StateFunction, is_nonsmooth
from vjm.model.urdf import chain_to_urdf, simulator_file
from vjm.records import NO_PAYLOAD, Array, Indices, Payload, Recording
from vjm.text import in_sentence

T = TypeVar("T")
# Inertia of a drive whose motion is given, over the arm's: reactions turn it by a millionth of the angle by which they
# would turn the arm (large mass method: P. Leger, I. M. Ide and P. Paultre, Computers & Structures 36(6), 1990).
_HEAVY = 1e6


@dataclass(frozen=True)
class Arm:
    """A chain with effects.

    Attributes:
        chain: with all that the effects change of it.
        effects: those present, in the order in which they were added.
    """

    chain: Chain
    effects: tuple[Effect, ...] = ()

    def __reduce__(self) -> tuple[type[Arm], tuple[Chain, tuple[Effect, ...]]]:
        return Arm, (self.chain, self.effects)  # without cached functions, which cannot be pickled

    @classmethod
    def of(cls, chain: Chain, effects: Sequence[Effect] = ()) -> Arm:
        """Return a chain with effects added; those at their null are left out."""
        present = tuple(effect for effect in effects if not effect.is_null)
        for effect in present:
            chain = effect.chain(chain)
        return cls(chain, present)

    def in_recording(self, recording: Recording) -> Arm:
        """Return the arm as a recording's input moves it: with drives that nothing stops if their motion is given."""
        if recording.input != "motion":
            return self
        payload = recording.payload_body
        if payload not in self._prescribed:
            armature = _HEAVY * _largest_inertia(self.chain, payload)
            self._prescribed[payload] = Arm(replace(self.chain, armature=armature), self.effects)
        return self._prescribed[payload]

    @cached_property
    def _prescribed(self) -> dict[Payload, Arm]:
        """The arm with drives so heavy that it turns as they are accelerated, by what is known to be on its tip."""
        return {}

    def inputs(self, recording: Recording) -> Recording:
        """Return the recording with the inputs that really drove the arm.

        Where the motion of the active joints is given, that is the torque by which their drives follow it.
        """
        for effect in self.effects:
            recording = effect.true_inputs(recording)
        if recording.acceleration is None:
            return recording
        return replace(recording, tau=self.chain.armature * recording.acceleration, input="torque")

    @cached_property
    def gravity(self) -> tuple[float, float]:
        """Gravity in the plane [m/s^2] where the known one is the chain's: effects may add to that."""
        return self.loads()[1]

    def loads(self, payload: Payload = NO_PAYLOAD) -> tuple[Payload, tuple[float, float]]:
        """Return payload and gravity [m/s^2] as they are where this payload and the chain's gravity are what is known.

        The former is what is known to be on the tip beside the chain's own payload.
        """
        idle = np.zeros((1, self.chain.active.size))
        still = Recording(
            np.zeros(1),
            np.zeros((1, 0, 2)),
            idle,
            idle,
            kind="quiet",
            gravity=self.chain.gravity,
            payload=payload.mass,
            payload_offset=payload.offset,
            payload_inertia=payload.inertia,
        )
        inputs = self.inputs(still)
        return inputs.payload_body, inputs.gravity

    @cached_property
    def state_counts(self) -> tuple[int, ...]:
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

    @cached_property
    def contacts(self) -> list[Contact]:
        """Gaps of joints, whose flanks are among the chain's springs and dampers."""
        return [contact for contact, _ in self._hooks(lambda effect: effect.contact(self.chain))]

    @cached_property
    def springs(self) -> tuple[Array, Array]:
        """Stiffness [N m/rad] and damping [N m s/rad] of the joints (nv,) where none touches a flank of its gap.

        The chain has the flanks, too, as if joints were in contact for good.
        """
        stiffness, damping = self.chain.stiffness.copy(), self.chain.damping.copy()
        for contact in self.contacts:
            stiffness[contact.joint] -= contact.stiffness
            damping[contact.joint] -= contact.damping
        return stiffness, damping

    def forces(self, payload: Payload) -> StateFunction | None:
        """Return the sum of the effects' generalised forces; None without any."""
        forces = self._hooks(lambda effect: effect.force(self.chain, payload))
        if not forces:
            return None
        if len(self.effects) == len(forces) == 1:
            return forces[0][0]

        def total(time: Array, q: Array, v: Array, z: Array) -> Array:
            return np.asarray(sum(force(time, q, v, z[..., part]) for force, part in forces))

        return total

    def state_rates(self, time: Array, q: Array, v: Array, z: Array) -> Array:
        """Return rates of change of all internal states (..., nz) in a motion, whose time is since the start."""
        if len(self.effects) == 1 and self.has_state_rates:  # without an array for all effects'
            return self._state_rates[0][0](time, q, v, z)
        rates = np.zeros(z.shape)
        for function, part in self._state_rates:
            rates[..., part] = function(time, q, v, z[..., part])
        return rates

    @property
    def has_state_rates(self) -> bool:
        """True if any internal state has a rate of change."""
        return bool(self._state_rates)

    def follow(self, time: Array, q: Array, v: Array, z: Array | None = None) -> Array:
        """Return the internal states (I, ..., nz) along given motions, integrated by Heun's method.

        Args:
            time: (I, ...) since each recording's start [s].
            q, v: (I, ..., nv) angles [rad] and rates [rad/s]; where the rates do not add up to the change of the
                angles, as from one segment of a recording to the next, the angles count.
            z: (..., nz) at the first instant; None: those of a recording's start.
        """
        start = self.initial_states(q[0]) if z is None else z
        states = np.broadcast_to(start, (*time.shape, sum(self.state_counts)))
        if not states.size:
            return states
        durations = np.diff(time, axis=0)[..., None]
        with np.errstate(divide="ignore", invalid="ignore"):
            missing = np.where(durations > 0, np.diff(q, axis=0) / durations, 0.0) - (v[:-1] + v[1:]) / 2
        # What relaxes or yields in less than the time between two instants is followed in several steps.
        longest = durations.reshape(len(durations), -1).max(axis=1, initial=0.0)
        counts = np.maximum(np.ceil(longest / self._longest_state_step - 1e-6), 1).astype(int)  # but for rounding
        interval, ends = np.repeat(np.arange(counts.size), counts), np.cumsum(counts)
        share = (np.arange(interval.size) - (ends - counts)[interval]) / counts[interval]
        share_after, duration = share + 1 / counts[interval], (durations.T / counts).T[interval]
        before, after = ([_between(values, interval, at) for values in (time, q, v)] for at in (share, share_after))
        followed = [start]
        for k, step in enumerate(duration):
            slope = self.state_rates(before[0][k], before[1][k], before[2][k] + missing[interval[k]], followed[-1])
            guess = followed[-1] + step * slope
            end_slope = self.state_rates(after[0][k], after[1][k], after[2][k] + missing[interval[k]], guess)
            followed.append(followed[-1] + step / 2 * (slope + end_slope))
        return np.stack([np.broadcast_to(followed[at], states.shape[1:]) for at in (0, *ends)])

    def urdf(self) -> str:
        """Return the URDF of the chain, with dry friction at its active joints.

        Raises:
            ShapeError: as of `chain_to_urdf`.
        """
        return chain_to_urdf(self.chain, self._friction)

    def simulator_file(self, simulator: str, urdf: str, markers: Sequence[Sequence[float]] = ()) -> str:
        """Return what a simulator reads beside the URDF, with every effect that it can carry and a list of the others.

        Args:
            simulator: one of `SIMULATORS`.
            urdf: name of the URDF file.
            markers: for each link, arc lengths of its markers [m].

        Raises:
            ChoiceError, ShapeError: as of `vjm.model.urdf.simulator_file`.
        """
        chain = replace(self.chain, gravity=self.gravity)
        return simulator_file(chain, simulator, urdf, self._friction, markers, self.not_in_simulators)

    @property
    def not_in_simulators(self) -> tuple[str, ...]:
        """Effects that `simulator_file` cannot carry, each with the name of its link."""
        effects = [effect for effect in self.effects if not (effect.in_urdf or effect.in_simulators)]
        places = [f" ({self.chain.links[effect.link].name})" if effect.link is not None else "" for effect in effects]
        return tuple(f"{in_sentence(effect.title)}{place}" for effect, place in zip(effects, places, strict=True))

    @property
    def _friction(self) -> dict[str, float]:
        """Dry friction at active joints by their link's name [N m]."""
        at_speed = self.friction_torques(np.full(self.chain.active.size, np.inf))
        names = [link.name for link in self.chain.links if link.joint == "revolute"]
        return {name: float(torque) for name, torque in zip(names, at_speed, strict=True) if torque}

    @cached_property
    def _dry_friction(self) -> list[tuple[int, Callable[[Array], Array]]]:
        joints = self.chain.active.tolist()
        hooks = self._hooks(lambda effect: effect.dry_friction(self.chain))
        return [(joints.index(joint), friction) for (joint, friction), _ in hooks]

    @property
    def has_dry_friction(self) -> bool:
        """True if a joint may stick."""
        return bool(self._dry_friction)

    def friction_torques(self, rates: Array) -> Array:
        """Return the active joints' dry friction (..., n_a) [N m] at rates (..., n_a); the largest possible at zero."""
        torques = np.zeros(rates.shape)
        for joint, friction in self._dry_friction:
            torques[..., joint] += friction(rates[..., joint])
        return torques

    @property
    def longest_step(self) -> float:
        """Time step that the effects allow [s]."""
        longest = min((effect.max_step(self.chain) for effect in self.effects), default=np.inf)
        # Friction is computed as if nothing hit within the step; halving the step reduces that error to a tenth.
        return longest / 2 if self.contacts and self.has_dry_friction else longest

    @cached_property
    def _longest_state_step(self) -> float:
        """Time step that the internal states allow [s]."""
        stateful = zip(self.effects, self.state_counts, strict=True)
        return min((effect.max_step(self.chain) for effect, count in stateful if count), default=np.inf)

    @cached_property
    def sensors(self) -> tuple[Effect, ...]:
        """Effects on the sensors, in the order in which the camera's change what it sees."""
        return tuple(sorted((effect for effect in self.effects if effect.sensor), key=lambda each: each.camera_order))

    @cached_property
    def exposure_effects(self) -> tuple[Effect, ...]:
        """Effects on the instants at which the camera sees markers."""
        return tuple(effect for effect in self.sensors if type(effect).camera_instants is not Effect.camera_instants)

    @cached_property
    def timing_variance(self) -> float:
        """Variance of the instants at which the camera takes its frames [s^2]."""
        return sum(effect.timing_noise**2 for effect in self.sensors)

    def encoder_angles(self, theta: Array) -> Array:
        """Return the encoders' readings of active joints' angles (..., n_a) [rad]."""
        for effect in self.sensors:
            theta = effect.encoder_angles(theta)
        return theta

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        """Return where the camera sees markers (F, k, 2) [m], with headings (F, k) [rad] of the link there, at (F,)."""
        for effect in self.sensors:
            positions = effect.marker_positions(positions, headings, time)
        return positions

    @cached_property
    def smooth(self) -> Arm:
        """The arm with what sticks doing so gradually."""
        if not is_nonsmooth(self.effects):
            return self
        return Arm(self.chain, tuple(replace(effect, smooth=True) for effect in self.effects))

    def states_of(self, other: Arm) -> Indices:
        """Return the indices (nz,) of another arm's internal states among those of this one, which has its effects."""
        own = {effect.key: part for effect, part in zip(self.effects, self._state_slices, strict=True)}
        parts = [np.arange(sum(self.state_counts))[own[effect.key]] for effect in other.effects]
        return np.concatenate([np.zeros(0, dtype=np.intp), *parts])

    @cached_property
    def _state_rates(self) -> list[tuple[StateFunction, slice]]:
        return self._hooks(lambda effect: effect.state_rates(self.chain))

    @cached_property
    def _state_slices(self) -> list[slice]:
        stops = np.cumsum(self.state_counts, dtype=int).tolist()
        return [slice(stop - count, stop) for stop, count in zip(stops, self.state_counts, strict=True)]

    def _hooks(self, hook: Callable[[Effect], T | None]) -> list[tuple[T, slice]]:
        """Return the results of a hook, with the internal states of their effects; None is left out."""
        results = [(hook(effect), part) for effect, part in zip(self.effects, self._state_slices, strict=True)]
        return [(result, part) for result, part in results if result is not None]


def _largest_inertia(chain: Chain, payload: Payload) -> float:
    """Return a bound of the inertia that a joint of a chain with a payload moves [kg m^2]: all masses at full reach."""
    reach = sum(abs(link.hub_radius) + link.length for link in chain.links)
    inertia = payload.inertia + payload.mass * (reach + abs(payload.offset)) ** 2
    for link in chain.links:
        inertia += link.hub_inertia + link.root_inertia + float(link.inertias.sum()) + link.payload_inertia
        inertia += float(link.masses.sum()) * reach**2 + link.payload * (reach + abs(link.payload_offset)) ** 2
    return inertia


def _between(values: Array, interval: Indices, share: Array) -> Array:
    """Interpolate values (I, ...) of instants linearly, at shares (S,) of intervals (S,) between them."""
    share = share.reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(values[interval] + share * (values[interval + 1] - values[interval]))
