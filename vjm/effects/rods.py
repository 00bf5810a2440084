"""Planar kinematics of a chain's virtual links as rigid rods: velocities of their points, and what forces there do.

Rod b has heading psi_b and turns at w_b. With e_b = exp(i psi_b), the component of a point's velocity along the normal
i e_b at distance x from the rod's proximal end is Re(conj(e_b) sum_{a<b} l_a w_a e_a) + x w_b.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain

Array = NDArray[np.float64]
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
