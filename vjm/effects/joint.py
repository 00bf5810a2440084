"""Friction, springs and torques at an active joint; what is soft or loose between ground, joint, clamp and link."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from vjm.chain.virtual_links import Chain, LinkChain, MovingBase
from vjm.effects.contact import Contact
from vjm.effects.effect import (
    ColumnEffect,
    Effect,
    JointEffect,
    LinkEffect,
    StateFunction,
    magnitude,
    shape_parameter,
)
from vjm.records import Array, Payload, Recording, Rig

# In the link's own unit of time T: with it angles of a hub that slews and stops are 0.2 urad off (`docs/method.md`).
_FRICTION_STEP = 1 / 120
# In rad / T, range of the joint's rate over which friction reverses where derivatives are taken: so much the rate
# changes between two instants at which they are.
_GRADUAL_REVERSAL = 1 / 40


@dataclass(frozen=True)
class _DryFriction(JointEffect):
    """Dry friction at the active joint, against the motion, and sticking."""

    abscissa = "joint_rate"
    dissipative = True
    nonsmooth = True

    def largest(self, rate: Array) -> Array:
        """Return the torque (...) [N m] that opposes the motion at rates (...) [rad/s]; at rest, that it may reach."""
        raise NotImplementedError

    def dry_friction(self, chain: Chain) -> tuple[int, Callable[[Array], Array]] | None:
        """Return the joint's coordinate and its friction; None where it is gradual."""
        return None if self.smooth else (self.active_joint(chain), self.largest)

    def force(self, chain: Chain, payload: Payload) -> StateFunction | None:
        """Return the torque if it is gradual: its sign changes over a range of rates."""
        if not self.smooth:
            return None
        joint, gradual = self.active_joint(chain), self.units(chain)[2] / _GRADUAL_REVERSAL
        return self.force_on(
            joint, lambda time, q, v, z: -self.largest(v[..., joint]) * np.tanh(gradual * v[..., joint])
        )

    def max_step(self, chain: Chain) -> float:
        """Return the time step [s] that resolves sticking."""
        return self.units(chain)[2] * _FRICTION_STEP


@dataclass(frozen=True)
class CoulombFriction(_DryFriction):
    """Dry friction at the active joint: constant against the motion, and sticking."""

    torque: float = magnitude("N m", 0.004, lower=0.0, in_rig_units=True)

    description = "dry (Coulomb) friction at the active joint"
    clause = "dry friction of {torque} at the joint of '{link}'"
    assumptions = (
        "equal torque in both directions, at all angles and under all loads; no more at rest than in motion; "
        "no presliding; on the motor's side of a gear or a gap"
    )
    reference = (
        "D. Karnopp, Computer simulation of stick-slip friction in mechanical dynamic systems, J. Dynamic Systems, "
        "Measurement, and Control 107(1), 1985"
    )
    distinguishing_experiment = "slow sweeps in both directions, and motion that stops"
    common = True
    in_urdf = True

    def largest(self, rate: Array) -> Array:
        """Return the same torque (...) [N m] at all rates."""
        return np.full(np.shape(rate), self.torque)


@dataclass(frozen=True)
class Stribeck(_DryFriction):
    """Dry friction that falls with the joint's rate v, torque exp(-(v / speed)^2), and sticks.

    This is the excess of friction at low rates over that at high ones, which is `coulomb_friction`. A speed above all
    rates of the joint would make the two the same.
    """

    torque: float = magnitude("N m", 0.004, lower=0.0, in_rig_units=True)
    # At most a tenth of the rate 3.5 rad / T at which a link in its first mode swings by one radian: a joint that is
    # driven as fast leaves the friction that falls with its speed behind.
    speed: float = shape_parameter("rad/s", 0.05, lower=5e-3, upper=0.35, grid=(0.02, 0.05, 0.125), in_rig_units=True)

    title = "Stribeck friction"
    description = "dry friction at the active joint that falls with speed (Stribeck)"
    clause = "dry friction of {torque} at the joint of '{link}' that falls with speed, Stribeck velocity {speed}"
    assumptions = (
        "a fall as exp(-(rate / speed)^2), without memory; equal torque in both directions and at all angles; "
        "no presliding; on the motor's side of a gear or a gap"
    )
    reference = "B. Armstrong-Helouvry et al., A survey of models for machines with friction, Automatica 30(7), 1994"
    distinguishing_experiment = "sweeps at several constant speeds, slow and fast"

    def largest(self, rate: Array) -> Array:
        """Return the torque (...) [N m] at rates (...) [rad/s]."""
        return np.asarray(self.torque * np.exp(-((rate / self.speed) ** 2)))


@dataclass(frozen=True)
class ViscousFriction(JointEffect):
    """Linear friction at the active joint."""

    coefficient: float = magnitude("N m s/rad", 0.004, lower=0.0, in_rig_units=True)

    description = "viscous friction at the active joint"
    clause = "viscous friction of {coefficient} at the joint of '{link}'"
    assumptions = (
        "equal coefficient in both directions, at all angles and temperatures; on the motor's side of a gear or a gap"
    )
    reference = "B. Siciliano et al., Robotics: Modelling, Planning and Control, Springer, 2009, chapter 7"
    distinguishing_experiment = "joint motion over a wide range of speeds with little bending"
    abscissa = "joint_rate"
    dissipative = True
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with a damper at the joint."""
        return self.with_link(chain, joint_damping=self.link_of(chain).joint_damping + self.coefficient)


@dataclass(frozen=True)
class JointSpring(JointEffect):
    """A cable or hose that pulls the active joint back to zero."""

    stiffness: float = magnitude("N m/rad", 0.025, lower=0.0, in_rig_units=True)

    description = "joint spring: a cable or hose that pulls the active joint back to zero"
    clause = "a cable or hose pulls the joint of '{link}' back to zero, {stiffness}"
    assumptions = "constant stiffness, without loss; rest at the joint's zero; on the motor's side of a gear or a gap"
    reference = "W. Khalil and E. Dombre, Modeling, Identification and Control of Robots, Hermes Penton, 2002"
    distinguishing_experiment = "slow sweeps in both directions over a wide joint range"
    abscissa = "joint_angle"
    in_simulators = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with a spring at the joint."""
        return self.with_link(chain, joint_stiffness=self.link_of(chain).joint_stiffness + self.stiffness)


@dataclass(frozen=True)
class TorqueGain(ColumnEffect):
    """A true torque that is a multiple, the gain, of the recorded one."""

    gain: float = magnitude("", 0.05, null=1.0, lower=0.2, upper=5.0)

    description = "torque gain: the true torque is a multiple of the recorded one"
    clause = "the true torque at the joint of '{link}' is {gain} times the recorded one"
    assumptions = "one constant gain at all torques and rates; no delay"
    reference = "M. Gautier and S. Briot, Global identification of joint drive gains, J. Dynamic Systems 136(5), 2014"
    distinguishing_experiment = "a recording with a weighed mass on the tip"
    common = True

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with the true torque."""
        return replace(recording, tau=self.with_column(recording.tau, gain=self.gain))


@dataclass(frozen=True)
class TorqueOffset(ColumnEffect):
    """A true torque that is the recorded one and a constant, the offset."""

    offset: float = magnitude("N m", 0.0025, in_rig_units=True)

    description = "torque offset: a constant torque added to the recorded one"
    clause = "the true torque at the joint of '{link}' is the recorded one plus {offset}"
    assumptions = "one constant offset in every recording and at all angles"
    reference = "J. Swevers et al., Dynamic model identification for industrial robots, IEEE Control Syst. 27(5), 2007"
    distinguishing_experiment = "recordings at several hub angles, and slow sweeps in both directions"
    abscissa = "joint_angle"

    def true_inputs(self, recording: Recording) -> Recording:
        """Return the recording with the true torque."""
        return replace(recording, tau=self.with_column(recording.tau, offset=self.offset))


@dataclass(frozen=True)
class HubRadius(JointEffect):
    """A link that begins on the rim of a hub, at a radius from the joint's axis beyond the one that is known."""

    # Typical: a hundredth of the link's length across. At most as wide as the link is long.
    radius: float = magnitude("m", 0.005, lower=-0.5, upper=0.5, in_rig_units=True)

    description = "radius of the hub: the link begins away from the joint's axis"
    clause = "link '{link}' begins {radius} further from its joint's axis than known"
    assumptions = "a rigid hub; a straight link that begins in the direction from the axis"
    reference = "P. K. C. Wang and J.-D. Wei, Vibrations in a moving flexible robot arm, J. Sound Vib. 116(1), 1987"
    distinguishing_experiment = "recordings at several hub angles"
    abscissa = "marker"
    on_drive = False
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with a larger hub."""
        return self.with_link(chain, hub_radius=self.link_of(chain).hub_radius + self.radius)


@dataclass(frozen=True)
class ClampCompliance(LinkEffect):
    """A clamp in which the link's root turns, on a spring with a damper beside it.

    The spring turns by the compliance times its part of the bending moment there.
    """

    compliance: float = magnitude("rad/(N m)", 0.01, lower=0.0, in_rig_units=True)
    # Typical: 0.035 of a typical spring's moment in the slowest mode, 3.5 rad / T: the loss factor of built-up
    # structures, 0.01 to 0.1. At most as large as that moment: beyond, the damper holds the root in every mode.
    # Searches start from typical: a little of it does to all modes of a clamped link what the link's own damping does,
    # and what tells the two apart goes with its square, which has no slope at zero.
    damping: float = shape_parameter("N m s/rad", 1.0, upper=30.0, power=1, grid=(1.0,), in_rig_units=True)

    description = "compliant clamp: the link's root rotates under load"
    clause = "the clamp of '{link}' is compliant, {compliance}[, damping {damping}]"
    assumptions = "a linear spring and damper; a root that turns about its own end and does not shift"
    reference = "K. R. Chun, Free vibration of a beam with one end spring-hinged, J. Applied Mechanics 39(4), 1972"
    distinguishing_experiment = "a recording with a known mass on the tip, or a marker next to the clamp"
    common = True
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with a joint at the root."""
        if self.is_null:
            return chain
        return self.with_link(chain, **_in_series(self.link_of(chain), 1 / self.compliance, self.damping))


@dataclass(frozen=True)
class GearElasticity(JointEffect):
    """A spring, with a damper beside it, between the motor, where the encoder is, and the hub.

    The motor has a share of the hub's inertia.
    """

    stiffness: float = magnitude("N m/rad", 30.0, null=np.inf, lower=0.5, reciprocal=True, in_rig_units=True)
    motor_share: float = shape_parameter("", 0.5, lower=0.02, upper=0.98)
    # Typical: 9 % of critical where the halves of a hub of 0.045 m l^2 swing against each other on a typical spring, by
    # 51 rad / T. At most as large as that spring's torque in the slowest mode, 3.5 rad / T behind a heavy hub: beyond,
    # the damper holds the hub to the motor in every mode.
    damping: float = shape_parameter("N m s/rad", 0.1, upper=9.0, power=1, in_rig_units=True)

    on_drive = False
    description = "gear elasticity between the motor's encoder and the hub"
    clause = "the gear or shaft between motor and hub of '{link}' is elastic, {stiffness}[, damping {damping}]"
    assumptions = "a linear spring and damper; an encoder on the motor; motor and hub that share the rig's hub inertia"
    reference = "M. W. Spong, Modeling and control of elastic joint robots, J. Dynamic Systems 109(4), 1987"
    distinguishing_experiment = "a marker on the hub, or a recording with a known mass on the tip"
    in_simulators = True

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with a joint between motor and hub."""
        if self.is_null:
            return chain
        link = self.link_of(chain)
        spring = _in_series(link, self.stiffness, self.damping)
        return self.with_link(chain, **spring, **_behind_gear(link, self.motor_share))


# Logarithms of a table's frequency over the typical one, 2.3 / T, to which searches may go: an eighth of it is slower
# than the arm by itself, sixteen times it faster than the arm's fourth mode.
_LOG_TABLE_FREQUENCIES = (-np.log(8.0), np.log(16.0))


@dataclass(frozen=True)
class BaseCompliance(Effect):
    """A table under the base that moves: a mass on a spring, which slides in one direction of the plane.

    It does not turn; the camera stands on the ground. The displacement is from where the table stands under the weight
    of all that it carries. The damping ratio is that of the table by itself.

    A search varies, at a frequency (stiffness / mass)^(1/2), two compliances that together are the table's, c cos(2 d)
    and c sin(2 d) of a compliance c at an angle d from the direction where it started. In these the motion is about
    linear, however near the arm moves to that frequency. At the null the mass is that of a table of typical stiffness.

    Attributes:
        start: direction from which the search started [rad]; None: the table's own.
    """

    stiffness: float = magnitude("N/m", 1500.0, null=np.inf, lower=50.0, reciprocal=True, in_rig_units=True)
    # At the typical stiffness frequencies of 1, 2.3 and 5.5 / T, between the modes of an arm.
    mass: float = shape_parameter("kg", 7.2, lower=0.01, upper=1e4, grid=(38.0, 7.2, 1.26), in_rig_units=True)
    # What a stiff table does is linear in cos(2 direction) and sin(2 direction): three directions span it.
    direction: float = shape_parameter("rad", np.pi / 2, lower=-np.inf, grid=(np.pi / 6, np.pi / 2, 5 * np.pi / 6))
    damping_ratio: float = shape_parameter("", 0.03, lower=1e-4, upper=1.0)

    start: float | None = field(default=None, kw_only=True, compare=False, repr=False)

    description = "base compliance: the table moves under the base"
    clause = (
        "the table moves under the base: {mass} on a spring of {stiffness}, direction {direction}, damping ratio "
        "{damping_ratio}"
    )
    assumptions = (
        "a rigid table that slides along one line and does not turn; a linear spring and damper; a camera on the ground"
    )
    reference = "E. I. Rivin, Stiffness and Damping in Mechanical Design, Marcel Dekker, 1999, chapter 5"
    distinguishing_experiment = "a fiducial on the base in the camera's view, or an accelerometer on the table"
    abscissa = "frequency"
    in_urdf = True

    @property
    def coordinates(self) -> Array:
        """(4,) compliance along the start over a typical one, logs of frequency and damping, compliance across it."""
        stiffness, mass, _, damping = self.parameters
        known = self.stiffness if np.isfinite(self.stiffness) else stiffness.typical_magnitude
        frequency = np.log(known / self.mass * mass.typical_magnitude / stiffness.typical_magnitude) / 2
        compliance, loss = stiffness.coordinate(self.stiffness), damping.coordinate(self.damping_ratio)
        angle = 0.0 if self.start is None else 2 * (self.direction - self.start)
        return np.array([compliance * np.cos(angle), frequency, loss, compliance * np.sin(angle)])

    def at(self, coordinates: Array) -> Self:
        """Return the same effect at other coordinates (4,)."""
        stiffness, mass, _, damping = self.parameters
        along, frequency, loss, across = np.asarray(coordinates, dtype=float).tolist()
        compliance, start = float(np.hypot(along, across)), self.direction if self.start is None else self.start
        return replace(
            self,
            stiffness=stiffness.value(compliance),
            mass=float(mass.typical_magnitude * np.exp(-2 * frequency) / (compliance or 1.0)),
            # Not wrapped: it would jump near the start, and has a standard error.
            direction=start + float(np.arctan2(across, along)) / 2,
            damping_ratio=damping.value(loss),
            start=start,
        )

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (4,), (4,) of the coordinates."""
        stiffness, _, _, damping = self.parameters
        largest = stiffness.bounds[1]
        pairs = np.array([stiffness.bounds, _LOG_TABLE_FREQUENCIES, damping.bounds, (-largest, largest)])
        return pairs[:, 0], pairs[:, 1]

    @property
    def size_coordinates(self) -> tuple[int, ...]:
        """Indices of the two compliances."""
        return 0, 3

    def recentred(self) -> Self:
        """Return it with its own direction as the start, if it slides rather across the start than along it.

        The compliance along the start has a lower bound, at which a search would stay.
        """
        along, _, _, across = self.coordinates
        return replace(self, start=None) if abs(across) > along else self

    def superposes(self, other: Effect) -> bool:
        """Return True for a table of the same frequency and damping: compliances in several directions add up."""
        return isinstance(other, BaseCompliance) and replace(other, direction=self.direction) == self

    def superposition(self, variants: Sequence[Effect], sizes: Array) -> tuple[Self, Array]:
        """Return the table along the direction in which the sum of compliances is largest, and how large it is."""
        directions = np.array([variant.values["direction"] for variant in variants])
        axes = np.stack([np.cos(directions), np.sin(directions)])
        compliances, principal = np.linalg.eigh((axes * sizes) @ axes.T)
        direction = float(np.arctan2(principal[1, -1], principal[0, -1]) % np.pi)
        return replace(self, direction=direction, start=None), compliances[-1:]

    def with_softer_joint(self, factor: float) -> Self:
        """Return it with the table's mass times a factor: its frequency is what a search may miss."""
        return replace(self, mass=factor * self.mass)

    def chain(self, chain: Chain) -> Chain:
        """Return the chain on a base that slides."""
        if self.is_null:
            return chain
        damping = 2 * self.damping_ratio * float(np.sqrt(self.stiffness * self.mass))
        return replace(chain, base=MovingBase(self.mass, self.stiffness, damping, self.direction))


@dataclass(frozen=True)
class Backlash(JointEffect):
    """A dead zone, of whole width gap, between motor and hub; the motor has a share of the hub's inertia.

    Its flanks push and never pull: they exert k d + c d' at a depth d, as long as that is positive.
    """

    gap: float = magnitude("rad", 0.004, lower=0.0, upper=0.2)
    motor_share: float = shape_parameter("", 0.5, lower=0.02, upper=0.98)
    # Typical flanks turn by a thousandth of what the link bends, and let a hub of 0.05 m l^2 rebound with a third of
    # its speed. Little as that is, taken for granted it would be an error of the gap of a per cent or two. The softest
    # are those of an elastic gear with play.
    flank_stiffness: float = shape_parameter(
        "N m/rad", 1000.0, 0.5, upper=1e4, grid=(1000.0, 100.0, 10.0), in_rig_units=True
    )
    flank_damping: float = shape_parameter("N m s/rad", 2.2, 0.002, upper=20.0, in_rig_units=True)

    on_drive = False
    nonsmooth = True
    description = "backlash between the motor and the hub"
    clause = "backlash of {gap} between motor and hub of '{link}'"
    assumptions = (
        "equal flanks, each a linear spring and damper in contact; no friction in the gap; an encoder on the motor"
    )
    reference = "M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash, Automatica 38(10), 2002"
    distinguishing_experiment = "a marker on the hub, and slow motion with reversals"

    def variants(self, rig: Rig, recordings: Sequence[Recording]) -> tuple[Self, ...]:
        """Return an instance for each joint and stiffness of the flanks, all with the same damping ratio."""
        started: list[Self] = []
        for variant in super().variants(rig, recordings):
            typical = variant.at(np.zeros(variant.coordinates.size))
            damping = typical.flank_damping * float(np.sqrt(variant.flank_stiffness / typical.flank_stiffness))
            started.append(replace(variant, flank_damping=damping))
        return tuple(started)

    def chain(self, chain: Chain) -> Chain:
        """Return the chain with the stiff flanks in contact for good; `contact` makes the gap."""
        if self.is_null:
            return chain
        link = self.link_of(chain)
        flank = _in_series(link, self.flank_stiffness, self.flank_damping)
        return self.with_link(chain, **flank, **_behind_gear(link, self.motor_share))

    def contact(self, chain: Chain) -> Contact | None:
        """Return the gap at the root joint, with flanks as stiff as that."""
        if self.is_null:
            return None
        link = self.link_of(chain)
        return Contact(self._root(chain), self.gap, link.root_stiffness or 0.0, link.root_damping)

    def rest_angles(self, chain: Chain, q: Array) -> Array:
        """Return the angles with the hub between the flanks, on one of them at most."""
        if self.is_null:
            return q
        root, rest = self._root(chain), q.copy()
        rest[..., root] = np.clip(q[..., root], -self.gap / 2, self.gap / 2)
        return rest

    def other_states(self, chain: Chain, state: Array) -> Array:
        """Return states (3, 2 nv) with the hub on either flank and between them, moving with the motor."""
        root, n = self._root(chain), chain.size
        states = np.tile(state, (3, 1))
        states[:, root] = self.gap * np.array([-0.5, 0.0, 0.5])
        states[:, n + root] = 0.0
        # The hub stays where it is: the motor, whose joint is the one before, takes up the difference.
        states[:, root - 1] += state[root] - states[:, root]
        states[:, n + root - 1] += state[n + root]
        return states

    def _root(self, chain: Chain) -> int:
        return int(self.virtual_joints(chain).start) - 1


def _in_series(link: LinkChain, stiffness: float, damping: float) -> dict[str, float]:
    """The link's root joint with a spring [N m/rad] and damper [N m s/rad] in series with those that are there.

    Of two springs, each with a light damper beside it, a share k / k_1 of the turn is in the first.
    """
    if link.root_stiffness is None:
        return {"root_stiffness": stiffness, "root_damping": damping}
    first, total = link.root_stiffness, link.root_stiffness * stiffness / (link.root_stiffness + stiffness)
    losses = (total / first) ** 2 * link.root_damping + (total / stiffness) ** 2 * damping
    return {"root_stiffness": total, "root_damping": losses}


def _behind_gear(link: LinkChain, motor_share: float) -> dict[str, float]:
    """Return the hub's inertia divided between motor and root joint, unless it is so already."""
    if link.root_inertia > 0:
        return {}
    motor = motor_share * link.hub_inertia
    return {"hub_inertia": motor, "root_inertia": link.hub_inertia - motor}
