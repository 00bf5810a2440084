"""Friction and springs at an active joint."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.effects.effect import Motion, size
from vjm.effects.places import JointEffect, active_coordinate, changed_link

Array = NDArray[np.float64]

# Sticking is creeping: below torque / _STEEPNESS dry friction is viscous with this coefficient [N m s/rad]. An everyday
# torque of 0.008 N m then sticks below 5e-4 rad/s. A slope that is the same for every torque makes the force
# proportional to the parameter, and makes sticking no stiffer for larger torques: the joint's rate is at most
# 16 / 0.005 = 3200 1/s with the lightest of usual hubs [kg m^2], where an explicit step of fourth order is stable up
# to 2.5 / 3200 = 0.8 ms.
_STEEPNESS = 16.0
_LONGEST_STEP = 5e-4


@dataclass(frozen=True)
class CoulombFriction(JointEffect):
    """Dry friction at the active joint: constant against the motion, with a smooth stand-in for sticking.

    Attributes:
        torque: [N m].
    """

    torque: float = size("N m", 0.008, lower=0.0)

    id = "coulomb_friction"
    says = "dry friction at the active joint"
    reference = (
        "B. Armstrong-Helouvry, P. Dupont and C. Canudas de Wit, A survey of models, analysis tools and compensation "
        "methods for the control of machines with friction, Automatica 30(7), 1994"
    )
    apart_by = "slow sweeps in both directions, and motion that comes to a stop"
    dissipative = True
    in_urdf = True
    abrupt = True

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Against the joint's motion."""
        if self.is_null:
            return None
        joint, torque, steepness = active_coordinate(chain, self.index), self.torque, _STEEPNESS / self.torque

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(v.shape)
            found[..., joint] = -torque * np.tanh(steepness * v[..., joint])
            return found

        return force

    @property
    def longest_step(self) -> float:
        """At which sticking is stable."""
        return np.inf if self.is_null else _LONGEST_STEP


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
