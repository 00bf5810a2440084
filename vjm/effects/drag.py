"""The air's resistance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.effects.effect import Motion, size
from vjm.effects.places import LinkEffect
from vjm.effects.rods import Rods

Array = NDArray[np.float64]

_NODES = 3  # Gauss-Legendre nodes a virtual link; two are exact but where the velocity changes its sign
_SLOW = 1e-3  # m/s; the size of a smaller velocity is rounded off
_REFERENCE = (
    "W. E. Baker, W. E. Woolam and D. Young, Air and internal damping of thin cantilever beams, International Journal "
    "of Mechanical Sciences 9(11), 1967"
)


@dataclass(frozen=True)
class LinearDrag(LinkEffect):
    """A force per length against the normal velocity.

    Attributes:
        coefficient: force per length over velocity [N s/m^2].
    """

    coefficient: float = size("N s/m^2", 0.05, lower=0.0)

    id = "linear_drag"
    says = "air drag in proportion to the velocity"
    reference = _REFERENCE
    apart_by = "two or more modes in free decay: drag damps the slow ones most"
    dissipative = True

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Against the motion of the link's virtual links."""
        if self.is_null:
            return None
        return resistance(chain, self.index, lambda normal: -self.coefficient * normal)


@dataclass(frozen=True)
class QuadraticDrag(LinkEffect):
    """A force per length against the normal velocity, times its size.

    Attributes:
        coefficient: force per length over the velocity's square [N s^2/m^3].
    """

    coefficient: float = size("N s^2/m^3", 0.1, lower=0.0)

    id = "quadratic_drag"
    says = "air drag in proportion to the square of the velocity"
    reference = _REFERENCE
    apart_by = "two amplitudes: its damping grows with the amplitude"
    dissipative = True

    def force(self, chain: Chain, payload: float) -> Motion | None:
        """Against the motion of the link's virtual links."""
        if self.is_null:
            return None
        return resistance(
            chain, self.index, lambda normal: -self.coefficient * normal * np.sqrt(normal * normal + _SLOW**2)
        )


def resistance(chain: Chain, index: int, density: Callable[[Array], Array]) -> Motion:
    """Generalised forces of a force per length along the normals of one link's virtual links.

    Args:
        chain: the arm.
        index: of the link.
        density: from normal velocities [m/s] to forces per length [N/m].
    """
    rods = Rods(chain)
    abscissae, gauss = np.polynomial.legendre.leggauss(_NODES)
    own = np.flatnonzero(rods.owners == index)
    lengths = rods.lengths[own, None]
    places, weights = lengths * (1 + abscissae) / 2, lengths * gauss / 2  # (b, nodes)
    moments = weights * places
    shape = (rods.lengths.size,)
    first, last = int(own[0]), int(own[-1]) + 1

    def force(time: Array, q: Array, v: Array, z: Array) -> Array:
        motion = rods.motion(q, v)
        normal, rate = motion.normal[..., first:last, None], motion.rate[..., first:last, None]
        densities = density(normal + rate * places)
        pushes, turns = np.zeros((2, *v.shape[:-1], *shape))
        pushes[..., first:last] = (densities * weights).sum(axis=-1)
        turns[..., first:last] = (densities * moments).sum(axis=-1)
        return rods.torques(motion.direction, pushes, turns)

    return force
