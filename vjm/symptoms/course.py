"""Where in a recording the misfit sits: when, and how much of it is slower than any vibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from vjm.records import Array
from vjm.symptoms.records import Estimate
from vjm.symptoms.regression import estimate, solve
from vjm.symptoms.signals import Channels

_STRETCHES = 5
_SLOW = 0.5  # of the lowest natural frequency
_MOST_WAVES = 40
_UPS_AND_DOWNS = 0.15, 0.3  # standard error of the logarithm: of noise, and of a residual that is more than noise


@dataclass(frozen=True)
class Course:
    """How the misfit of a recording spreads over its time.

    Attributes:
        recording: index.
        edges: (K + 1,) of equal stretches of time [s].
        rms: (K,) of the residual in units of the noise.
        growth: natural logarithm of the last over the first.
        described: misfit beyond what an even spread would leave in the stretches.
    """

    recording: int
    edges: Array
    rms: Array
    growth: Estimate
    described: float


def course(index: int, sensors: Sequence[Channels]) -> Course | None:
    """Spread of a recording's misfit over time; None for one that is too short.

    Args:
        index: of the recording.
        sensors: of it.
    """
    if not sensors:
        return None
    start = min(float(each.time[0]) for each in sensors)
    stop = max(float(each.time[-1]) for each in sensors)
    edges = np.linspace(start, stop, _STRETCHES + 1)
    total, count = np.zeros(_STRETCHES), np.zeros(_STRETCHES)
    for sensor in sensors:
        stretch = np.clip(np.searchsorted(edges, sensor.time, side="right") - 1, 0, _STRETCHES - 1)
        total += np.bincount(stretch, np.sum(sensor.residual**2, axis=1), _STRETCHES)
        count += np.bincount(stretch, sensor.known.sum(axis=1), _STRETCHES)
    if count.min() < 2 or total.min() <= 0:
        return None
    power = total / count
    std = float(np.hypot(np.sqrt(0.5 / count[0] + 0.5 / count[-1]), _UPS_AND_DOWNS[int(power.max() > 2)]))
    growth = estimate(0.5 * float(np.log(power[-1] / power[0])), std, 0.0, 1)
    described = float(np.sum(np.maximum(total - count * total.sum() / count.sum(), 0.0)))
    return Course(index, edges, np.sqrt(power), growth, described)


@dataclass(frozen=True)
class Wander:
    """The slow part of a residual.

    Attributes:
        sensor: the coordinate that wanders most, by its noise.
        size: root mean square of its slow part [m or rad].
        limit: frequency below which it is slow [Hz].
        described: misfit that the slow part of all coordinates is, in units of the noise squared.
    """

    sensor: str
    size: Estimate
    limit: float
    described: float


def wander(channels: Channels, lowest: float) -> Wander | None:
    """What of a residual is slower than half the lowest natural frequency; None where the recording is too short.

    Args:
        channels: a sensor of one recording.
        lowest: natural frequency [Hz].
    """
    duration = float(channels.time[-1] - channels.time[0])
    count = min(int(2 * duration * _SLOW * lowest), _MOST_WAVES)
    if count < 1 or len(channels.time) < 4 * count:
        return None
    phase = np.pi * (channels.time - channels.time[0]) / duration
    waves = np.cos(phase[:, None] * np.arange(count + 1))
    described = np.zeros(len(channels.names))
    for c, rows in enumerate(channels.known.T):
        left = channels.residual[rows, c] - channels.residual[rows, c].mean()
        described[c] = float(np.sum(left**2) - np.sum((left - waves[rows] @ solve(waves[rows], left)) ** 2))
    counts = channels.known.sum(axis=0)
    most = int(np.argmax(described / counts))
    chance = float(special.chdtrc(count * described.size, max(float(described.sum()), 0.0)))
    size = channels.noise * float(np.sqrt(max(described[most] - count, 0.0) / counts[most]))
    error = channels.noise / float(np.sqrt(2 * counts[most]))
    found = Estimate(size, error, chance)
    return Wander(
        channels.names[most], found, _SLOW * lowest, max(float(described.sum()) - count * described.size, 0.0)
    )
