"""Natural modes of an arm at rest, in which its initial state and derivatives of its motion are told."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from vjm.chain.records import Chain
from vjm.experiment.records import Recording
from vjm.modes import linearise

Array = NDArray[np.float64]

_MOST_TURN = 3.2  # rad an interval; what lies inside it is interpolated, to three hundredths at this limit
_MOST_MODES = 16


@dataclass(frozen=True)
class Basis:
    """Natural modes of the arm at rest, in which derivatives are told.

    A camera does not show how the fastest of them start, so initial states are told in the slow ones.

    Attributes:
        shapes: (nv, m) joint angles of each mode, with modal mass one; slowest first.
        slow: number of slow modes.
    """

    shapes: Array
    slow: int

    @classmethod
    def of(cls, chain: Chain, recording: Recording, interval: float) -> Basis:
        """The modes of an arm, active joints free; slow are those that turn little in an interval [s]."""
        M, _, K, _ = linearise(chain, recording.payload, recording.gravity, first_angles(recording))
        squares, shapes = linalg.eigh(K, M)
        slow = int(np.count_nonzero(np.sqrt(np.maximum(squares, 0.0)) * interval < _MOST_TURN))
        return cls(shapes[:, :_MOST_MODES], min(max(slow, chain.active.size + 1), chain.size, _MOST_MODES))

    @property
    def states(self) -> Array:
        """(2 nv, 2 slow) initial angles and rates of a unit of each slow mode's coordinate and rate."""
        shapes = self.shapes[:, : self.slow]
        nothing = np.zeros_like(shapes)
        return np.block([[shapes, nothing], [nothing, shapes]])


def first_angles(recording: Recording) -> Array:
    """Active joints' angles (n_a,) first measured; zero where none was."""
    first = [column[np.isfinite(column)][:1] for column in recording.theta.T]
    return np.array([value[0] if value.size else 0.0 for value in first])
