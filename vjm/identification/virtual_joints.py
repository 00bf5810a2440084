"""How many virtual joints a link needs, and the nominal chain of a rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.model.modes import modes
from vjm.records import Array, Link

FREQUENCY_TOLERANCE = 1e-3  # relative discretisation error allowed in the frequencies of the modes seen
_REFERENCE_JOINTS = 40
_MOST_JOINTS = 20


@dataclass(frozen=True)
class JointChoice:
    """A number of virtual joints and what it costs.

    Attributes:
        joints: n.
        modes: number of modes it has to carry.
        error: largest relative error of their natural frequencies, against a chain of 40 joints.
        asked: whether a user asked for this n.
    """

    joints: int
    modes: int
    error: float
    asked: bool = False


def choose_virtual_joints(link: Link, seen: int, joints: int | None = None) -> JointChoice:
    """The smallest n whose chain has the `seen` slowest modes' frequencies right to 0.1 %, or the cost of a given n.

    Args:
        link: nominal values; as the only link, its active joint free.
        seen: number of modes that the markers show.
        joints: n, where it is given.
    """
    reference = _frequencies(link, _REFERENCE_JOINTS)

    def choice(n: int) -> JointChoice:
        found = _frequencies(link, n)
        count = min(seen, found.size)
        return JointChoice(n, seen, float(np.max(np.abs(found[:count] / reference[:count] - 1))))

    if joints is not None:
        return choice(joints)
    tried = [choice(n) for n in range(seen + 1, _MOST_JOINTS + 1)]
    return next((one for one in tried if one.error < FREQUENCY_TOLERANCE), tried[-1])


def _frequencies(link: Link, n: int) -> Array:
    chain = Chain(link.name, (uniform_chain(link, layout(link.length, n)),))
    return modes(chain).frequencies
