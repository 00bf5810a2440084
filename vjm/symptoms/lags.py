"""Whether the camera's clock and the encoders' tell the same time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vjm.symptoms.alignment import Alignment
from vjm.symptoms.bands import Bands
from vjm.symptoms.records import UNKNOWN, Estimate
from vjm.symptoms.regression import estimate

_FREEDOM = 11  # of one recording's standard error


@dataclass(frozen=True)
class Lag:
    """Camera against encoders in one recording.

    Attributes:
        recording: index.
        camera: delay of the camera's residual against the simulation [s].
        encoder: delay of the encoders' residual [s].
        lag: of the camera behind the encoders [s].
        clock: by how much more time the camera counts, relative.
        described: misfit that each of the two describes, in units of the noise squared.
    """

    recording: int
    camera: Estimate
    encoder: Estimate
    lag: Estimate
    clock: Estimate
    described: tuple[float, float]


def camera_lag(index: int, alignments: Sequence[Alignment], bands: Bands) -> Lag | None:
    """Lag of the camera behind the encoders in one recording; None without both, or without motion.

    It is what is left of their delays once amplitude, phase, frequency and damping of all bands are as measured:
    what is wrong with the motion itself, both sensors show at the same time.

    Args:
        index: of the recording.
        alignments: of its sensors, all about the same instant.
        bands: of the recording.
    """
    delays = {each.channels.sensor: each.delay for each in alignments}
    if len(delays) < 2 or not all(np.isfinite(each.std) for each in (*delays.values(), bands.lag)):
        return None
    return Lag(index, delays["camera"], delays["encoder"], bands.lag, bands.clock, (bands.others[2], bands.others[3]))


def pooled(found: Sequence[Estimate]) -> Estimate:
    """Mean of what several recordings say, with an error that their scatter does not belie."""
    known = [each for each in found if np.isfinite(each.std) and each.std > 0]
    if not known:
        return UNKNOWN
    values, weights = np.array([each.value for each in known]), np.array([each.std for each in known]) ** -2
    mean, std = float(np.average(values, weights=weights)), float(np.sum(weights) ** -0.5)
    scatter = np.sqrt(np.sum(weights * (values - mean) ** 2) / max(values.size - 1, 1))
    return estimate(mean, std, std * max(float(scatter), 1.0), _FREEDOM + values.size - 1)
