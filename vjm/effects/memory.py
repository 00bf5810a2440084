"""Bending that remembers: creep and hysteresis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.effects.effect import Motion, inner, size
from vjm.effects.places import LinkEffect

Array = NDArray[np.float64]

_CREEP_STEPS = 1.5  # longest step, in time constants; an explicit one of fourth order is stable up to 2.8
_SLIP_RATE = 5.0  # rad/s of a whole link's bending, which is fast; the slip follows it over one yield angle
_SLIP_STEPS = 1.5
_SLOW = 1e-4  # rad/s of one joint; the sign of a smaller rate is rounded off


@dataclass(frozen=True)
class MemoryEffect(LinkEffect):
    """A spring beside each of the link's own, whose angle z is an internal state.

    Attributes:
        ratio: its stiffness over that of the link's own spring.
    """

    ratio: float = size("", 0.03, lower=0.0, upper=1.0)

    def states(self, chain: Chain) -> int:
        """One for each virtual joint of the link."""
        return 0 if self.is_null else chain.links[self.index].virtual_joints


@dataclass(frozen=True)
class ViscoelasticCreep(MemoryEffect):
    """Standard linear solid: beside each spring K another, ratio K, in series with a damper.

    Attributes:
        time_constant: of the series [s].
    """

    time_constant: float = inner("s", 0.1, lower=1e-3, upper=1e3, grid=(0.01, 0.032, 0.1, 0.32, 1.0))

    id = "viscoelastic_creep"
    says = "creep: a part of the bending stiffness that relaxes"
    reference = "C. Zener, Elasticity and Anelasticity of Metals, University of Chicago Press, 1948"
    apart_by = "two or more modes in free decay, and a static bend that is held"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Of the relaxing springs."""
        if self.is_null:
            return None
        part, factor = chain.passive_slices[self.index], -self.ratio * chain.links[self.index].stiffness

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(v.shape)
            found[..., part] = factor * z
            return found

        return force

    def rates(self, chain: Chain) -> Motion | None:
        """The springs follow phi and relax: z' = phi' - z / time_constant."""
        if self.is_null:
            return None
        part, slow = chain.passive_slices[self.index], 1 / self.time_constant
        return lambda time, q, v, z: v[..., part] - slow * z

    @property
    def longest_step(self) -> float:
        """At which the relaxation is stable."""
        return np.inf if self.is_null else _CREEP_STEPS * self.time_constant


@dataclass(frozen=True)
class Hysteresis(MemoryEffect):
    """Bouc-Wen: a part of each spring slips above a yield angle, moment K ((1 - ratio) phi + ratio z).

    Attributes:
        ratio: the part of the stiffness that slips.
        yield_angle: of the bending of the whole link, of which each joint has a part [rad].
    """

    ratio: float = size("", 0.05, lower=0.0, upper=1.0)
    yield_angle: float = inner("rad", 0.05, lower=1e-3, upper=3.0, grid=(0.01, 0.031, 0.097, 0.3))

    id = "hysteresis"
    says = "hysteresis: stiffness that is lost where the link bends farther than it slips"
    reference = (
        "Y.-K. Wen, Method for random vibration of hysteretic systems, Journal of the Engineering Mechanics Division, "
        "ASCE 102(2), 1976"
    )
    apart_by = "recordings at two amplitudes, and a slow one"

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """On top of the springs' own -K phi."""
        if self.is_null:
            return None
        part, factor = chain.passive_slices[self.index], self.ratio * chain.links[self.index].stiffness

        def force(time: Array, q: Array, v: Array, z: Array) -> Array:
            found = np.zeros(q.shape)
            found[..., part] = factor * (q[..., part] - z)
            return found

        return force

    def rates(self, chain: Chain) -> Motion | None:
        """Slipping: z' = phi' (1 - |z| / y (1 + sign(phi' z)) / 2), with |z| sign(phi' z) = z sign(phi')."""
        if self.is_null:
            return None
        part, scale = chain.passive_slices[self.index], 0.5 / self.yields(chain)

        def rates(time: Array, q: Array, v: Array, z: Array) -> Array:
            rate = v[..., part]
            return rate * (1 - scale * (np.abs(z) + z * np.tanh(rate / _SLOW)))

        return rates

    def rest(self, chain: Chain, q: Array) -> Array:
        """The joints' angles, as far as they do not slip."""
        if self.is_null:
            return super().rest(chain, q)
        yields = self.yields(chain)
        result: Array = yields * np.tanh(q[..., chain.passive_slices[self.index]] / yields)
        return result

    def yields(self, chain: Chain) -> Array:
        """(n,) each joint's part of the yield angle [rad]."""
        link = chain.links[self.index]
        result: Array = self.yield_angle * link.cells / link.length
        return result

    @property
    def longest_step(self) -> float:
        """At which slipping is stable in fast motion."""
        return np.inf if self.is_null else _SLIP_STEPS * self.yield_angle / _SLIP_RATE
