"""Offset, gain and delay of every coordinate, once the simulation's time has been laid over the measured one.

The simulation s(t) is read at t - delay - stretch (t - t0), where that fits best (Gauss-Newton), every coordinate with
an offset and a gain of its own. Delay and stretch belong to a whole sensor, the camera or the encoders.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vjm.records import Array
from vjm.symptoms.records import UNKNOWN, Estimate
from vjm.symptoms.regression import regress, solve
from vjm.symptoms.signals import Channels, centred

_MOST_STEPS = 8
_HALVINGS = 4
_ENOUGH = 1e-6  # relative decrease of the misfit that is not worth another step


class Coordinate(NamedTuple):
    """One coordinate: what was found, and the misfit that it describes by itself, in units of the noise squared.

    Attributes:
        name: of the coordinate.
        offset: constant difference [m or rad].
        gain: measured over simulated motion, less one.
        delay: by how much it comes later [s].
        drift: of an encoder, how far it moves away from the model over the recording [rad].
    """

    name: str
    offset: tuple[Estimate, float]
    gain: tuple[Estimate, float]
    delay: tuple[Estimate, float]
    drift: tuple[Estimate, float]


@dataclass(frozen=True)
class Alignment:
    """How one sensor of one recording lies on the simulation.

    Attributes:
        channels: the sensor.
        delay: of all its coordinates together: positive where the measured motion comes later [s].
        stretch: of its time against the simulation's, relative: positive where the measured motion takes longer.
        coordinates: (C) each by itself.
        described: misfit that the delay describes, in units of the noise squared.
    """

    channels: Channels
    delay: Estimate
    stretch: Estimate
    coordinates: tuple[Coordinate, ...]
    described: float


def align(channels: Channels, middle: float) -> Alignment:
    """Offset, gain and delay of a sensor's coordinates.

    Args:
        channels: of one sensor in one recording.
        middle: the instant t0 at which the delay is told [s].
    """
    warp = np.zeros(2)
    shifted = _Shifted.of(channels, warp, middle)
    for _ in range(_MOST_STEPS):
        step = shifted.step()
        trial = shifted
        for halving in range(_HALVINGS):
            trial = _Shifted.of(channels, warp + step / 2**halving, middle)
            if trial.cost < shifted.cost:
                break
        if trial.cost > shifted.cost * (1 - _ENOUGH):
            break
        warp, shifted = trial.warp, trial
    known = channels.known.T
    blocks = np.broadcast_to(channels.blocks, known.shape)[known]
    whole = shifted.left + shifted.columns @ warp
    pooled = regress(shifted.columns, whole, blocks, 2 * len(channels.names))
    change = shifted.columns[:, 0] * pooled[0].value
    singles = tuple(_single(channels, shifted, c) for c in range(len(channels.names)))
    return Alignment(
        channels,
        pooled[0],
        pooled[1],
        singles,
        float(change @ (2 * whole - change)),
    )


@dataclass(frozen=True)
class _Shifted:
    """The simulation at shifted times, and what it leaves.

    Attributes:
        warp: (2,) delay [s] and stretch.
        simulated: (F, C) [m or rad].
        late: (F, C) by how much a delay of one second would move it [m or rad]; and
        slow: (F, C) the same of a stretch of one.
        columns: (N, 2) both over what is known, offsets and gains taken out, in units of the noise.
        left: (N,) the residual, likewise.
    """

    warp: Array
    simulated: Array
    late: Array
    slow: Array
    columns: Array
    left: Array

    @property
    def cost(self) -> float:
        return float(self.left @ self.left)

    def step(self) -> Array:
        """(2,) the change of the warp that would be best if the motion were linear in it."""
        return solve(self.columns, self.left)

    @staticmethod
    def of(channels: Channels, warp: Array, middle: float) -> _Shifted:
        time, known = channels.time, channels.known
        since = time - middle
        shifted = np.clip(time - warp[0] - warp[1] * since, time[0], time[-1])
        simulated, rate = (np.asarray(channels.path(shifted, order), dtype=np.float64) for order in (0, 1))
        late, slow = -rate, -rate * since[:, None]
        shape = centred(simulated, known) * channels.moving
        power = np.maximum(np.sum(shape**2, axis=0), 1e-300)

        def without_gain(values: Array) -> Array:
            inner = centred(values, known)
            rest: Array = inner - shape * (np.sum(shape * inner, axis=0) / power)
            return rest.T[known.T] / channels.noise

        left = without_gain(np.where(known, channels.measured, 0.0) - simulated)
        columns = np.stack([without_gain(late * channels.moving), without_gain(slow * channels.moving)], axis=1)
        return _Shifted(warp, simulated, late, slow, columns, left)


def _single(channels: Channels, shifted: _Shifted, c: int) -> Coordinate:
    """Offset, gain, delay and drift of one coordinate."""
    rows = channels.known[:, c]
    left = channels.measured[rows, c] - shifted.simulated[rows, c]
    changes = [np.ones(left.size)]
    if channels.moving[c]:
        shape, motion = shifted.simulated[rows, c], np.stack([shifted.late[rows, c], shifted.slow[rows, c]])
        changes += [shape - shape.mean(), motion[0], motion[1]]
        left = left + shifted.warp @ motion
    if channels.sensor == "encoder":
        time = channels.time[rows]
        changes.append((time - time.mean()) / (channels.time[-1] - channels.time[0]))
    found = regress(np.stack(changes, axis=1) / channels.noise, left / channels.noise, channels.blocks[rows])
    residual = channels.residual[rows, c]

    def part(index: int) -> tuple[Estimate, float]:
        change = changes[index] * (found.values[index] / channels.noise)
        return found[index], float(change @ (2 * residual - change))

    missing = (UNKNOWN, 0.0)
    return Coordinate(
        channels.names[c],
        part(0),
        part(1) if channels.moving[c] else missing,
        part(2) if channels.moving[c] else missing,
        part(len(changes) - 1) if channels.sensor == "encoder" else missing,
    )
