"""Effects that break the contract, each in one way, and two that keep it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from vjm.chain.virtual_links import Array, Chain
from vjm.effects import Effect, StateFunction, magnitude, shape_parameter
from vjm.effects.contact import Contact
from vjm.effects.effect import JointEffect, WaveEffect
from vjm.records import Recording, Rig


@dataclass(frozen=True)
class CubicFriction(JointEffect):
    """A torque at the active joint that grows with the cube of its rate: nothing is wrong with it."""

    coefficient: float = magnitude("N m s^3/rad^3", 0.004, lower=0.0)

    id = "cubic_friction"
    description = "friction that grows with the cube of the rate"
    assumptions = "the same torque at all angles"
    reference = "A. Author, A Book, 2001"
    dissipative = True

    def torque(self, rate: Array, angle: Array) -> Array:
        """At the joint."""
        return -self.coefficient * rate**3

    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        """At the joint only."""
        if self.is_null:
            return None
        joint = self.active_joint(chain)

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(v.shape)
            found[..., joint] = self.torque(v[..., joint], q[..., joint])
            return found

        return force


class Undecorated(CubicFriction):
    extra: float = magnitude("N m", 1.0)


@dataclass(frozen=True)
class Nameless(CubicFriction):
    id = "cubic friction!"


@dataclass(frozen=True)
class Unreferenced(CubicFriction):
    reference = ""


@dataclass(frozen=True)
class Unassuming(CubicFriction):
    """Does not even say that it assumes nothing."""

    assumptions = " "


@dataclass(frozen=True)
class Undeclared(CubicFriction):
    exponent: float = 3.0


@dataclass(frozen=True)
class PresentByDefault(CubicFriction):
    coefficient: float = field(default=0.004, metadata=magnitude("N m s^3/rad^3", 0.004).metadata)


@dataclass(frozen=True)
class WithoutSize(Effect):
    """Never anything but absent."""

    frequency: float = shape_parameter("Hz", 5.0)

    id = "without_size"
    description = "a torque without a size"
    assumptions = "none"
    reference = "A. Author, A Book, 2001"

    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        return lambda time, q, v, z: np.ones(q.shape)


@dataclass(frozen=True)
class Camera(Effect):
    """A camera that is shifted along x: nothing is wrong with it."""

    shift: float = magnitude("m", 0.005)

    id = "camera_shift"
    description = "a camera that is shifted along the arm"
    assumptions = "the same shift in every recording"
    reference = "A. Author, A Book, 2001"

    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        return positions if self.is_null else positions + np.array([self.shift, 0.0])


@dataclass(frozen=True)
class LosesValue(CubicFriction):
    def at(self, coordinates: Array) -> Self:
        return replace(self, coefficient=0.002 * float(coordinates[0]))


@dataclass(frozen=True)
class NotNothing(CubicFriction):
    def chain(self, chain: Chain) -> Chain:
        return replace(chain, gravity=(0.001 + self.coefficient, 0.0))


@dataclass(frozen=True)
class PushesWhenAbsent(CubicFriction):
    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        return lambda time, q, v, z: -(self.coefficient + 1e-12) * v


@dataclass(frozen=True)
class RoundsWhenAbsent(Camera):
    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        return (positions + 1.0) - 1.0 + np.array([self.shift, 0.0])


@dataclass(frozen=True)
class WrongShape(CubicFriction):
    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        return None if self.is_null else lambda time, q, v, z: -self.coefficient * v[..., :1]


@dataclass(frozen=True)
class OneInstantOnly(CubicFriction):
    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        return None if self.is_null else lambda time, q, v, z: -self.coefficient * v * float(np.linalg.norm(v))


@dataclass(frozen=True)
class NotANumber(CubicFriction):
    def torque(self, rate: Array, angle: Array) -> Array:
        with np.errstate(invalid="ignore"):
            return -self.coefficient * rate**1.5


@dataclass(frozen=True)
class OnlySmall(CubicFriction):
    coefficient: float = magnitude("N m s^3/rad^3", 0.004, lower=0.0, upper=0.02)

    def torque(self, rate: Array, angle: Array) -> Array:
        if self.coefficient > 0.015:
            raise ValueError("too much friction")
        return super().torque(rate, angle)


@dataclass(frozen=True)
class StateWithoutRates(CubicFriction):
    def initial_states(self, chain: Chain, q: Array) -> Array:
        return np.zeros((*q.shape[:-1], 1))


@dataclass(frozen=True)
class FrictionWithoutSlope(CubicFriction):
    """Does not say what stands for dry friction where derivatives are taken."""

    def dry_friction(self, chain: Chain) -> tuple[int, Callable[[Array], Array]] | None:
        return self.active_joint(chain), lambda rate: np.full(rate.shape, self.coefficient)


@dataclass(frozen=True)
class FrictionThatPushes(CubicFriction):
    def dry_friction(self, chain: Chain) -> tuple[int, Callable[[Array], Array]] | None:
        return None if self.smooth else (self.active_joint(chain), lambda rate: -np.full(rate.shape, self.coefficient))


@dataclass(frozen=True)
class FrictionOfALink(CubicFriction):
    def dry_friction(self, chain: Chain) -> tuple[int, Callable[[Array], Array]] | None:
        return None if self.smooth else (chain.size - 1, lambda rate: np.full(rate.shape, self.coefficient))


@dataclass(frozen=True)
class SmoothedAway(JointEffect):
    """Has derivatives of nothing."""

    stiffness: float = magnitude("N m/rad", 0.05, lower=0.0)

    id = "smoothed_away"
    description = "a spring at the active joint"
    assumptions = "constant stiffness"
    reference = "A. Author, A Book, 2001"

    def chain(self, chain: Chain) -> Chain:
        return chain if self.smooth else self.with_link(chain, joint_stiffness=self.stiffness)


@dataclass(frozen=True)
class SmoothWithStates(CubicFriction):
    """Where derivatives are taken it has an internal state that it has not otherwise."""

    def initial_states(self, chain: Chain, q: Array) -> Array:
        return np.zeros((*q.shape[:-1], 1 if self.smooth else 0))

    def state_rates(self, chain: Chain) -> StateFunction | None:
        return (lambda time, q, v, z: -z) if self.smooth else None


@dataclass(frozen=True)
class WritesIntoArrays(Camera):
    def marker_positions(self, positions: Array, headings: Array, time: Array) -> Array:
        if not self.is_null:
            positions[..., 0] += self.shift
        return positions


@dataclass(frozen=True)
class WritesIntoRecords(CubicFriction):
    def true_inputs(self, recording: Recording) -> Recording:
        if not self.is_null:
            object.__setattr__(recording, "payload", recording.payload + 0.01)
        return recording


@dataclass(frozen=True)
class Idle(CubicFriction):
    def torque(self, rate: Array, angle: Array) -> Array:
        return 0.0 * rate


@dataclass(frozen=True)
class Modest(CubicFriction):
    def untestable(self, rig: Rig, recordings: Sequence[Recording]) -> str:
        return "nobody will ever see it"


@dataclass(frozen=True)
class Motor(CubicFriction):
    """Called dissipative, and pushes."""

    def torque(self, rate: Array, angle: Array) -> Array:
        return self.coefficient * rate


@dataclass(frozen=True)
class Spring(CubicFriction):
    """Called dissipative, and gives back what it took."""

    def torque(self, rate: Array, angle: Array) -> Array:
        return -10.0 * self.coefficient * angle


@dataclass(frozen=True)
class TakesDampingAway(JointEffect):
    """Called dissipative, by way of the chain."""

    share: float = magnitude("", 0.1, lower=0.0, upper=1.0)

    id = "less_damping"
    description = "less damping than there is"
    assumptions = "none"
    reference = "A. Author, A Book, 2001"
    dissipative = True

    def chain(self, chain: Chain) -> Chain:
        return self.with_link(chain, damping=(1 - self.share) * self.link_of(chain).damping)


@dataclass(frozen=True)
class TakesDampingAwayBehindAJoint(TakesDampingAway):
    """The same, with a joint of its own at the link's root."""

    def chain(self, chain: Chain) -> Chain:
        return chain if self.is_null else self.with_link(super().chain(chain), root_stiffness=100.0 / self.share)


@dataclass(frozen=True)
class HiddenMotor(CubicFriction):
    """Called dissipative, and drives the joint behind the torque sensor's back."""

    def true_inputs(self, recording: Recording) -> Recording:
        return recording if self.is_null else replace(recording, tau=recording.tau + self.coefficient)


@dataclass(frozen=True)
class GapWithoutFlanks(CubicFriction):
    """A gap at the first virtual joint, whose flanks are stiffer than that."""

    def contact(self, chain: Chain) -> Contact | None:
        joint = int(chain.passive[0])
        return None if self.is_null else Contact(joint, 0.01, 2 * float(chain.stiffness[joint]), 0.0)


@dataclass(frozen=True)
class GapOfNoJoint(CubicFriction):
    def contact(self, chain: Chain) -> Contact | None:
        return None if self.is_null else Contact(chain.size, 0.01, 1.0, 0.0)


@dataclass(frozen=True)
class Explosive(CubicFriction):
    dissipative = False

    def torque(self, rate: Array, angle: Array) -> Array:
        return 1e5 * self.coefficient * angle


@dataclass(frozen=True)
class Constant(CubicFriction):
    """Has no use for its size."""

    def torque(self, rate: Array, angle: Array) -> Array:
        return -0.004 * rate**3


@dataclass(frozen=True)
class ConstantWave(WaveEffect, JointEffect):
    """Has no use for its amplitude and its phase, which are two sizes."""

    amplitude: float = magnitude("N m", 0.004, lower=0.0)
    frequency: float = shape_parameter("Hz", 2.5, lower=5e-3, upper=5e3, from_spectrum="time")
    phase: float = shape_parameter("rad", 0.0, lower=-np.pi, upper=np.pi)

    id = "constant_wave"
    description = "a wave of one size"
    assumptions = "none"
    reference = "A. Author, A Book, 2001"

    def force(self, chain: Chain, payload: float) -> StateFunction | None:
        """At the joint only."""
        joint, pulsation = self.active_joint(chain), 0.0 if self.is_null else 2 * np.pi * self.frequency
        return self.force_on(joint, lambda time, q, v, z: 0.004 * np.sin(pulsation * time))


@dataclass(frozen=True)
class Folded(CubicFriction):
    """Two sizes that do the same."""

    def torque(self, rate: Array, angle: Array) -> Array:
        return -0.004 * np.sin(2.5 * self.coefficient / 0.004) * rate**3


@dataclass(frozen=True)
class Stiffer(JointEffect):
    """Another name for the bending stiffness."""

    share: float = magnitude("", 0.05, lower=-0.5)

    id = "stiffer"
    description = "a stiffer link"
    assumptions = "none"
    reference = "A. Author, A Book, 2001"

    def chain(self, chain: Chain) -> Chain:
        link, factor = self.link_of(chain), 1 + self.share
        return self.with_link(chain, stiffness=factor * link.stiffness, damping=factor * link.damping)
