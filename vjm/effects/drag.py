"""Planar kinematics of a chain's virtual links as rigid rods: velocities of their points, and what forces there do.

Rod b has heading psi_b and turns at w_b. With e_b = exp(i psi_b), the component of a point's velocity along the normal
i e_b at distance x from the rod's proximal end is Re(conj(e_b) sum_{a<b} l_a w_a e_a) + x w_b.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import LinkEffect, Motion, magnitude
from vjm.records import Array

ComplexArray = NDArray[np.complex128]


class RodMotion(NamedTuple):
    """How the B rods move.

    Attributes:
        direction: (..., B) exp(i psi).
        rate: (..., B) w [rad/s].
        normal: (..., B) velocity of each rod's proximal end along the rod's normal [m/s].
    """

    direction: ComplexArray
    rate: Array
    normal: Array


class Rods:
    """The virtual links of all links of a chain, from the base outwards.

    Attributes:
        lengths: (B,) [m].
        owners: (B,) index of each rod's link.
    """

    def __init__(self, chain: Chain) -> None:
        self.lengths = np.concatenate([link.lengths for link in chain.links])
        self.owners = np.repeat(range(len(chain.links)), [link.lengths.size for link in chain.links])
        self._turns, rest = _turns(chain)
        self._rest = np.exp(1j * rest)
        # [a, b]: what rod a adds to the place of rod b's proximal end.
        self._reach = np.triu(np.repeat(self.lengths[:, None], self.lengths.size, axis=1), 1)

    def motion(self, q: Array, v: Array) -> RodMotion:
        """How the rods move at angles (..., nv) [rad] and rates (..., nv) [rad/s]."""
        direction = self._rest * np.exp(1j * (q @ self._turns))
        rate = v @ self._turns
        normal = (((direction * rate) @ self._reach) * direction.conj()).real
        return RodMotion(direction, rate, normal)

    def torques(self, direction: ComplexArray, force: Array, moment: Array) -> Array:
        """What forces on the rods do at the joints.

        Args:
            direction: as in `RodMotion`.
            force: (..., B) along each rod's normal [N].
            moment: (..., B) of these forces about the rod's proximal end [N m].

        Returns:
            (..., nv) generalised forces [N m].
        """
        lever = (direction * force) @ self._reach.T
        result: Array = (moment + (lever * direction.conj()).real) @ self._turns.T
        return result


def _turns(chain: Chain) -> tuple[Array, Array]:
    """(nv, B) derivatives of the rods' headings by the joints' angles, and (B,) the headings at zero [rad]."""
    rods = sum(link.lengths.size for link in chain.links)
    turns, bends = np.zeros((chain.size, rods)), np.zeros(rods)
    rod = 0
    for link, part in zip(chain.links, chain.passive_slices, strict=True):
        turns[part.stop - link.coordinates : part.start, rod:] = 1.0
        for j, coordinate in enumerate(range(part.start, part.stop), start=1):
            turns[coordinate, rod + j :] = 1.0
            bends[rod + j] = link.rest_curvature * float(link.cells[j - 1])
        rod += link.lengths.size
    return turns, np.cumsum(bends)


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

    coefficient: float = magnitude("N s/m^2", 0.05, lower=0.0)

    id = "linear_drag"
    description = "air drag in proportion to the velocity"
    clause = "air drag of {coefficient} on {link}, in proportion to the velocity"
    reference = _REFERENCE
    distinguishing_experiment = "two or more modes in free decay: drag damps the slow ones most"
    abscissa = "amplitude"
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

    coefficient: float = magnitude("N s^2/m^3", 0.1, lower=0.0)

    id = "quadratic_drag"
    description = "air drag in proportion to the square of the velocity"
    clause = "air drag of {coefficient} on {link}, in proportion to the square of the velocity"
    reference = _REFERENCE
    distinguishing_experiment = "two amplitudes: its damping grows with the amplitude"
    abscissa = "amplitude"
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
