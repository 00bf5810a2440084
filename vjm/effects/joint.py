"""Friction and springs at an active joint."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.effects.effect import Effect, Motion, Way, size
from vjm.effects.places import JointEffect, active_coordinate, changed_link

Array = NDArray[np.float64]

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

    torque: float = size("N m", 0.008, lower=0.0)

    id = "coulomb_friction"
    says = "dry friction at the active joint"
    reference = (
        "P. Dupont, V. Hayward, B. Armstrong and F. Altpeter, Single state elastoplastic friction models, IEEE "
        "Transactions on Automatic Control 47(5), 2002"
    )
    apart_by = "slow sweeps in both directions, and motion that comes to a stop"
    dissipative = True
    in_urdf = True
    abrupt = True

    def smooth(self) -> Effect:
        """Without the bristle: reversals take as long as derivatives are apart."""
        return _SmoothFriction(link=self.link, torque=self.torque)

    def states(self, chain: Chain) -> int:
        """The bristle."""
        return 0 if self.is_null else 1

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of the bristle."""
        joint, torque = active_coordinate(chain, self.index), self.torque
        return None if self.is_null else _at(joint, lambda v, z: -torque / _PRESLIDING * z[..., 0])

    def way(self, chain: Chain) -> Way | None:
        """With the joint, as far as it does not slip."""
        if self.is_null:
            return None
        joint = active_coordinate(chain, self.index)
        return lambda q, z, to: np.clip(z + (to - q)[..., joint, None], -_PRESLIDING, _PRESLIDING)

    @property
    def longest_step(self) -> float:
        """That resolves sticking."""
        return np.inf if self.is_null else _LONGEST_STEP


@dataclass(frozen=True)
class _SmoothFriction(JointEffect):
    """Dry friction whose sign changes gradually."""

    torque: float = size("N m", 0.008, lower=0.0)

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

    coefficient: float = size("N m s/rad", 0.004, lower=0.0)

    id = "viscous_friction"
    says = "viscous friction at the active joint"
    reference = "B. Siciliano et al., Robotics: Modelling, Planning and Control, Springer, 2009, chapter 7"
    apart_by = "motion of the joint at speeds that differ much, with the link bending little"
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

    stiffness: float = size("N m/rad", 0.05, lower=0.0)

    id = "joint_spring"
    says = "a cable or hose that pulls the active joint back to zero"
    reference = "W. Khalil and E. Dombre, Modeling, Identification and Control of Robots, Hermes Penton, 2002"
    apart_by = "slow sweeps in both directions over a wide range of the joint"

    def chain(self, chain: Chain) -> Chain:
        """With a spring at the joint."""
        if self.is_null:
            return chain
        stiffness = chain.links[self.index].joint_stiffness + self.stiffness
        return changed_link(chain, self.index, joint_stiffness=stiffness)
