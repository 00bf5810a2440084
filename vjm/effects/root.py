"""What is soft or loose between a motor, or the ground, and a link's root."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.effects.effect import Effect, JointEffect, LinkEffect, Motion, magnitude
from vjm.records import Array

_MOTOR_SHARE = 0.5  # of the hub's inertia, on the motor's side of a gear

# Flanks of teeth in contact: [N m/rad], and damped [N m s/rad] enough for a hub of 0.02 kg m^2 to rebound with a third
# of its speed.
_FLANK_STIFFNESS = 2000.0
_FLANK_DAMPING = 2.0
_GRADUAL = 0.15  # of the gap, over which flanks come into contact where derivatives are taken
# Short against the flanks' own oscillation (a light hub of 0.005 kg m^2 on its flank: 5 ms a period), which is no part
# of the chain's linear springs while the gap is open.
_LONGEST_STEP = 6e-4


@dataclass(frozen=True)
class ClampCompliance(LinkEffect):
    """The link's root turns in its clamp.

    Attributes:
        compliance: turn over the bending moment at the root [rad/(N m)].
    """

    compliance: float = magnitude("rad/(N m)", 0.005, lower=0.0)

    id = "clamp_compliance"
    description = "a clamp that gives way: the link's root turns in it"
    clause = "a clamp of {link} that gives way, by {compliance}"
    reference = (
        "K. R. Chun, Free vibration of a beam with one end spring-hinged and the other free, Journal of Applied "
        "Mechanics 39(4), 1972"
    )
    distinguishing_experiment = "a recording with a known mass on the tip, or a marker next to the clamp"
    common = True
    in_urdf = True

    def chain(self, chain: Chain) -> Chain:
        """With a joint at the root."""
        if self.is_null:
            return chain
        return _with_link(chain, self.index, lambda link: in_series(link, 1 / self.compliance))


@dataclass(frozen=True)
class GearElasticity(JointEffect):
    """A spring between the motor, where the encoder is, and the hub. Each has half of the hub's inertia.

    Attributes:
        stiffness: [N m/rad].
    """

    stiffness: float = magnitude("N m/rad", 60.0, null=np.inf, lower=1.0, reciprocal=True)

    id = "gear_elasticity"
    description = "an elastic gear or shaft between the motor's encoder and the hub"
    clause = "an elastic gear or shaft of {stiffness} between motor and hub of {link}"
    reference = (
        "M. W. Spong, Modeling and control of elastic joint robots, Journal of Dynamic Systems, Measurement, and "
        "Control 109(4), 1987"
    )
    distinguishing_experiment = "a marker on the hub, or a recording with a known mass on the tip"

    def chain(self, chain: Chain) -> Chain:
        """With a joint between motor and hub."""
        if self.is_null:
            return chain
        return _with_link(chain, self.index, lambda link: behind_gear(in_series(link, self.stiffness)))


@dataclass(frozen=True)
class Backlash(JointEffect):
    """A dead zone between motor and hub; each has half of the hub's inertia.

    Its flanks push and never pull: they exert k d + c d' at a depth d, as long as that is positive.

    Attributes:
        gap: its whole width [rad].
    """

    gap: float = magnitude("rad", 0.004, lower=0.0, upper=0.2)

    id = "backlash"
    nonsmooth = True
    description = "play between the motor and the hub"
    clause = "play of {gap} between motor and hub of {link}"
    reference = (
        "M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash - a survey, Automatica 38(10), 2002"
    )
    distinguishing_experiment = "a marker on the hub, and slow motion that changes its direction"

    def smoothed(self) -> Effect:
        """With flanks so soft that contact does not begin between two instants at which derivatives are taken."""
        return _SmoothBacklash(link=self.link, gap=self.gap)

    def chain(self, chain: Chain) -> Chain:
        """With the stiff flanks in contact for good; `force` makes the gap."""
        if self.is_null:
            return chain
        return _with_link(
            chain, self.index, lambda link: behind_gear(in_series(link, _FLANK_STIFFNESS, _FLANK_DAMPING))
        )

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """What cancels the root joint's spring and damper inside the gap."""
        if self.is_null:
            return None
        link, root = chain.links[self.index], chain.passive_slices[self.index].start - 1
        stiffness, damping = link.root_stiffness or 0.0, link.root_damping
        sides = np.array([1.0, -1.0])

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            depth, share = self._contact(sides * q[..., root, None] - self.gap / 2)
            push = np.maximum(stiffness * depth + damping * share * sides * v[..., root, None], 0.0)
            found = np.zeros(v.shape)
            found[..., root] = stiffness * q[..., root] + damping * v[..., root] - push @ sides
            return found

        return force

    def rest_angles(self, chain: Chain, q: Array) -> Array:
        """With the hub between the flanks, on one of them at most."""
        if self.is_null:
            return q
        root, found = chain.passive_slices[self.index].start - 1, q.copy()
        found[..., root] = np.clip(q[..., root], -self.gap / 2, self.gap / 2)
        return found

    def _contact(self, beyond: Array) -> tuple[Array, Array]:
        """How deep a flank is pressed [rad] at angles beyond it [rad], and its share in contact."""
        return np.maximum(beyond, 0.0), (beyond > 0).astype(float)

    @property
    def max_step(self) -> float:
        """That resolves an impact."""
        return np.inf if self.is_null else _LONGEST_STEP


@dataclass(frozen=True)
class _SmoothBacklash(Backlash):
    """Play whose contact begins gradually."""

    def _contact(self, beyond: Array) -> tuple[Array, Array]:
        """By a sigmoid, whose integral is a logarithm, instead of a corner."""
        soft = 2 * _GRADUAL * self.gap
        return soft / 2 * np.logaddexp(0.0, 2 * beyond / soft), (1 + np.tanh(beyond / soft)) / 2


def in_series(link: LinkChain, stiffness: float, damping: float = 0.0) -> LinkChain:
    """The link with a spring [N m/rad] and damper [N m s/rad] at its root, in series with those that are there.

    Of two springs, each with a light damper beside it, a share k / k_1 of the turn is in the first.
    """
    if link.root_stiffness is None:
        return replace(link, root_stiffness=stiffness, root_damping=damping)
    first, total = link.root_stiffness, link.root_stiffness * stiffness / (link.root_stiffness + stiffness)
    losses = (total / first) ** 2 * link.root_damping + (total / stiffness) ** 2 * damping
    return replace(link, root_stiffness=total, root_damping=losses)


def behind_gear(link: LinkChain) -> LinkChain:
    """The link with the hub's share of its inertia beyond the root joint, unless it is there already."""
    if link.root_inertia > 0:
        return link
    motor = _MOTOR_SHARE * link.hub_inertia
    return replace(link, hub_inertia=motor, root_inertia=link.hub_inertia - motor)


def _with_link(chain: Chain, index: int, change: Callable[[LinkChain], LinkChain]) -> Chain:
    links = list(chain.links)
    links[index] = change(links[index])
    return replace(chain, links=tuple(links))
