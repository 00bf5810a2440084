"""Friction and springs at an active joint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import (
    NO_TORQUE,
    ColumnEffect,
    Effect,
    JointEffect,
    Motion,
    RateIndependentUpdate,
    active_coordinate,
    changed_link,
    has_torque,
    magnitude,
)
from vjm.records import Array, Recording, Rig

# Dry friction holds by a bristle that bends by so much before it slips [rad]: less than an encoder shows, and that an
# arm which sticks with an everyday torque (0.008 N m) swings on it at some 10 Hz, which steps of a millisecond resolve.
_PRESLIDING = 1e-5
_LONGEST_STEP = 1e-3
_GRADUAL = 0.05  # rad/s; what the joint's rate changes by between instants at which derivatives are taken


@dataclass(frozen=True)
class CoulombFriction(JointEffect):
    """Dry friction at the active joint: constant against the motion, and sticking.

    A bristle bends elastically by up to z_s and slips beyond (Prandtl's stop): over any way of the joint its angle z
    changes as the joint's does, and is held within -z_s and z_s; the torque is -torque z / z_s.

    Attributes:
        torque: [N m].
    """

    torque: float = magnitude("N m", 0.008, lower=0.0)

    id = "coulomb_friction"
    description = "dry friction at the active joint"
    clause = "dry friction of {torque} at the joint of {link}"
    reference = (
        "P. Dupont, V. Hayward, B. Armstrong and F. Altpeter, Single state elastoplastic friction models, IEEE "
        "Transactions on Automatic Control 47(5), 2002"
    )
    distinguishing_experiment = "slow sweeps in both directions, and motion that comes to a stop"
    abscissa = "joint_rate"
    common = True
    dissipative = True
    in_urdf = True
    nonsmooth = True

    def smoothed(self) -> Effect:
        """Without the bristle: reversals take as long as derivatives are apart."""
        return _SmoothFriction(link=self.link, torque=self.torque)

    def state_count(self, chain: Chain) -> int:
        """The bristle."""
        return 0 if self.is_null else 1

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of the bristle."""
        joint, torque = active_coordinate(chain, self.index), self.torque
        return None if self.is_null else _at(joint, lambda v, z: -torque / _PRESLIDING * z[..., 0])

    def rate_independent_update(self, chain: Chain) -> RateIndependentUpdate | None:
        """With the joint, as far as it does not slip."""
        if self.is_null:
            return None
        joint = active_coordinate(chain, self.index)
        return lambda q, z, to: np.clip(z + (to - q)[..., joint, None], -_PRESLIDING, _PRESLIDING)

    @property
    def max_step(self) -> float:
        """That resolves sticking."""
        return np.inf if self.is_null else _LONGEST_STEP

    @property
    def joint_friction(self) -> float:
        """Dry friction torque at the active joint [N m]."""
        return self.torque


@dataclass(frozen=True)
class _SmoothFriction(JointEffect):
    """Dry friction whose sign changes gradually."""

    torque: float = magnitude("N m", 0.008, lower=0.0)

    id = "coulomb_friction"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Against the joint's motion."""
        joint, torque = active_coordinate(chain, self.index), self.torque
        return None if self.is_null else _at(joint, lambda v, z: -torque * np.tanh(v[..., joint] / _GRADUAL))


def _at(joint: int, torque: Callable[[Array, Array], Array]) -> Motion:
    """A torque of rates and internal states at one joint."""

    def force(time: Array, q: Array, v: Array, z: Array) -> Array:
        found = np.zeros(v.shape)
        found[..., joint] = torque(v, z)
        return found

    return force


@dataclass(frozen=True)
class ViscousFriction(JointEffect):
    """Linear friction at the active joint.

    Attributes:
        coefficient: [N m s/rad].
    """

    coefficient: float = magnitude("N m s/rad", 0.004, lower=0.0)

    id = "viscous_friction"
    description = "viscous friction at the active joint"
    clause = "viscous friction of {coefficient} at the joint of {link}"
    reference = "B. Siciliano et al., Robotics: Modelling, Planning and Control, Springer, 2009, chapter 7"
    distinguishing_experiment = "motion of the joint at speeds that differ much, with the link bending little"
    abscissa = "joint_rate"
    dissipative = True
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """With a damper at the joint."""
        if self.is_null:
            return chain
        damping = chain.links[self.index].joint_damping + self.coefficient
        return changed_link(chain, self.index, joint_damping=damping)


@dataclass(frozen=True)
class JointSpring(JointEffect):
    """A cable or hose that pulls the active joint back to zero.

    Attributes:
        stiffness: [N m/rad].
    """

    stiffness: float = magnitude("N m/rad", 0.05, lower=0.0)

    id = "joint_spring"
    description = "a cable or hose that pulls the active joint back to zero"
    clause = "a cable or hose of {stiffness} that pulls the joint of {link} back to zero"
    reference = "W. Khalil and E. Dombre, Modeling, Identification and Control of Robots, Hermes Penton, 2002"
    distinguishing_experiment = "slow sweeps in both directions over a wide range of the joint"
    abscissa = "joint_angle"

    def chain(self, chain: Chain) -> Chain:
        """With a spring at the joint."""
        if self.is_null:
            return chain
        stiffness = chain.links[self.index].joint_stiffness + self.stiffness
        return changed_link(chain, self.index, joint_stiffness=stiffness)


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

    gain: float = magnitude("", 0.05, null=1.0, lower=0.2, upper=5.0)

    id = "torque_gain"
    description = "the true torque is a multiple of the recorded one"
    clause = "a true torque at the joint of {link} that is {gain} times the recorded one"
    reference = (
        "M. Gautier and S. Briot, Global identification of joint drive gains and dynamic parameters of robots, Journal "
        "of Dynamic Systems, Measurement, and Control 136(5), 2014"
    )
    distinguishing_experiment = "a recording with a weighed mass on the tip"
    common = True

    def true_inputs(self, recording: Recording) -> Recording:
        """With the true torque."""
        return recording if self.is_null else replace(recording, tau=self.column_of(recording.tau, self.gain, 0.0))


@dataclass(frozen=True)
class TorqueOffset(TorqueEffect):
    """The true torque is the recorded one and a constant.

    Attributes:
        offset: true less recorded [N m].
    """

    offset: float = magnitude("N m", 0.005)

    id = "torque_offset"
    description = "a constant torque beside the recorded one"
    clause = "a constant torque of {offset} beside the recorded one at the joint of {link}"
    reference = (
        "J. Swevers, W. Verdonck and J. De Schutter, Dynamic model identification for industrial robots, IEEE Control "
        "Systems Magazine 27(5), 2007"
    )
    distinguishing_experiment = "recordings at several hub angles, and slow sweeps in both directions"
    abscissa = "joint_angle"

    def true_inputs(self, recording: Recording) -> Recording:
        """With the true torque."""
        return recording if self.is_null else replace(recording, tau=self.column_of(recording.tau, 1.0, self.offset))
