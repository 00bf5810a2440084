"""A residual against a motion's position, velocity and direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.records import Array
from vjm.symptoms.records import Estimate
from vjm.symptoms.regression import regress, solve

_TAILS = 5.0  # per cent at either end that do not count to a motion's range


@dataclass(frozen=True)
class Profile:
    """A residual, P times, and the motion at which it was left.

    Attributes:
        recordings: indices of those it is from.
        sensor: whose residual it is.
        motion: name of what moves.
        quantity: `torque` that the model misses, `acceleration` of the residual, or the `residual` itself.
        unit: of the quantity.
        motion_unit: of the position.
        points: residual and motion.
        values: (P,) of the quantity, without what goes with other things beside the motion.
        estimates: change of the quantity a unit of position, a unit of velocity, and its jump from backwards to
            forwards.
        reach: ranges of position and velocity; and one.
        described: share that each of the three describes of what the others leave of the quantity's mean square.
    """

    recordings: tuple[int, ...]
    sensor: str
    motion: str
    quantity: str
    unit: str
    motion_unit: str
    points: Points
    values: Array
    estimates: tuple[Estimate, Estimate, Estimate]
    reach: tuple[float, float, float]
    described: tuple[float, float, float]


@dataclass(frozen=True)
class Points:
    """A residual and a motion, P times.

    Attributes:
        values: (P,) of the residual, of its acceleration, or of a torque.
        std: (P,) of their noise.
        position, velocity: (P,) of the motion [rad or m, a second].
        way: (P,) from minus one, backwards, to one, forwards.
        blocks: (P,) stretches of time that are taken as independent.
        beside: (P, m) what else may explain the values.
        recording: (P,) number of the recording, from 0.
    """

    values: Array
    std: Array
    position: Array
    velocity: Array
    way: Array
    blocks: NDArray[np.intp]
    beside: Array
    recording: NDArray[np.intp]

    @staticmethod
    def joined(parts: Sequence[Points]) -> Points:
        """Those of several recordings."""
        starts = np.cumsum([0, *(int(each.blocks.max()) + 1 for each in parts)])
        return Points(
            np.concatenate([each.values for each in parts]),
            np.concatenate([each.std for each in parts]),
            np.concatenate([each.position for each in parts]),
            np.concatenate([each.velocity for each in parts]),
            np.concatenate([each.way for each in parts]),
            np.concatenate([each.blocks + start for each, start in zip(parts, starts, strict=False)]),
            np.concatenate([each.beside for each in parts]),
            np.concatenate([np.full(each.values.size, k) for k, each in enumerate(parts)]),
        )


def fitted(
    recordings: tuple[int, ...], name: str, motion: str, units: tuple[str, str], motion_unit: str, points: Points
) -> Profile:
    """How a residual goes with a motion, position, velocity and direction told apart from each other.

    Args:
        recordings: indices of those whose points they are; each may have a constant of its own.
        name: of the sensor.
        motion: name of what moves.
        units: quantity and its unit.
        motion_unit: of the position.
        points: of all the recordings.
    """
    own = (points.recording[:, None] == np.arange(len(recordings))).astype(float)
    terms = np.stack([points.position, points.velocity, 0.5 * points.way], axis=1)
    columns = np.hstack([terms, own, points.beside]) / points.std[:, None]
    values = points.values / points.std
    found = regress(columns, values, points.blocks)
    other = 3 + len(recordings)
    kept = values - columns[:, other:] @ found.values[other:]
    left = max(float(np.sum(found.left**2)), 1e-300)
    reach = [float(np.subtract(*np.percentile(each, [100 - _TAILS, _TAILS]))) for each in terms.T[:2]]
    described = []
    for k in range(3):
        without = np.delete(columns, k, axis=1)
        alone = values - without @ solve(without, values)
        gained = max(float(np.sum(alone**2)) - left, 0.0)
        described.append(gained / (gained + left))
    return Profile(
        recordings,
        name,
        motion,
        *units,
        motion_unit,
        points,
        kept * points.std,
        (found[0], found[1], found[2]),
        (reach[0], reach[1], 1.0),
        (described[0], described[1], described[2]),
    )


def joined(found: Sequence[Profile]) -> Profile | None:
    """One profile of what several recordings show of the same thing; None where they do not show the same.

    Args:
        found: of the same sensor and quantity, one a recording.
    """
    if len(found) < 2 or len({each.points.beside.shape[1] for each in found}) > 1:
        return None
    first = found[0]
    recordings = tuple(index for each in found for index in each.recordings)
    units, points = (first.quantity, first.unit), Points.joined([each.points for each in found])
    return fitted(recordings, first.sensor, first.motion, units, first.motion_unit, points)
