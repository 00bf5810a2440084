"""Choice of the number of virtual joints of a link."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain
from vjm.model.modes import modes
from vjm.records import Array, Link

FREQUENCY_TOLERANCE = 1e-3  # relative; of the order to which a few seconds of recording show a frequency
_REFERENCE_JOINTS = 40  # twice the most that are tried: 16 times as exact, the layout being of fourth order
_MOST_JOINTS = 20


@dataclass(frozen=True)
class JointChoice:
    """A number of virtual joints and its discretisation error.

    Attributes:
        joints: n.
        error: largest relative error of the visible modes' frequencies, against a chain of 40 joints.
        requested: True if a user asked for this n.
    """

    joints: int
    error: float
    requested: bool = False


def choose_virtual_joints(link: Link, visible: int, joints: int | None = None) -> JointChoice:
    """Choose the smallest n whose chain has the frequencies of the `visible` slowest modes right to 0.1 %.

    The link has its nominal values, is the only one and its active joint is free. Of given `joints` only the error is
    found.
    """
    reference = _frequencies(link, _REFERENCE_JOINTS)

    def choice(n: int) -> JointChoice:
        frequencies = _frequencies(link, n)
        count = min(visible, frequencies.size)
        return JointChoice(n, float(np.max(np.abs(frequencies[:count] / reference[:count] - 1))))

    if joints is not None:
        return choice(joints)
    choices = [choice(n) for n in range(visible + 1, _MOST_JOINTS + 1)]
    return next((each for each in choices if each.error < FREQUENCY_TOLERANCE), choices[-1])


def _frequencies(link: Link, n: int) -> Array:
    chain = Chain(link.name, (uniform_chain(link, layout(link.length, n)),))
    return modes(chain).frequencies
