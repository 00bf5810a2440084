"""What recordings that repeat one experiment leave in common, and what each leaves of its own."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vjm.simulate.run import Run

Array = NDArray[np.float64]

_TOGETHER = 0.1  # frames by which instants of two recordings may differ
_LEAST = 100  # values


@dataclass(frozen=True)
class Repeated:
    """What a model leaves of markers in recordings that repeat each other, in units of the noise.

    Noise alone gives one for both, since no two recordings share it. What a model gets wrong every time is in the
    first; in the second is what differs from one recording to the next.

    Attributes:
        common: RMS of the sum of two recordings' residuals over the square root of two.
        own: the same of their difference.
        noise: of a marker coordinate [m].
    """

    common: float
    own: float
    noise: float

    @property
    def share(self) -> float:
        """Of the mean square beyond noise, what repeats; NaN where there is none."""
        common, own = (max(each**2 - 1.0, 0.0) for each in (self.common, self.own))
        return common / (common + own) if common + own > 0 else float("nan")


def repeated(runs: Sequence[Run]) -> Repeated | None:
    """From recordings that share a `repeat` label, each beside the next; None where there are none.

    Args:
        runs: beside what was measured; initial states are each one's own.
    """
    sums, differences = np.zeros(0), np.zeros(0)
    for one, two in _pairs(runs):
        sums, differences = np.r_[sums, (one + two) / np.sqrt(2)], np.r_[differences, (one - two) / np.sqrt(2)]
    if sums.size < _LEAST:
        return None
    common, own = (float(np.sqrt(np.mean(each**2))) for each in (sums, differences))
    return Repeated(common, own, runs[0].observed.noise[0])


def _pairs(runs: Sequence[Run]) -> Iterator[tuple[Array, Array]]:
    """(N,), (N,) residuals of the same marker coordinates at the same instants since the start."""
    for label in sorted({each for run in runs if (each := run.observed.recording.repeat) is not None}):
        for one, two in pairwise(run for run in runs if run.observed.recording.repeat == label):
            (times, residuals), (others, there) = _frames(one), _frames(two)
            nearest = np.clip(np.searchsorted(others, times), 1, others.size - 1) if others.size > 1 else None
            if nearest is None or times.size < 2:
                continue
            nearest -= (times - others[nearest - 1]) < (others[nearest] - times)
            near = np.abs(others[nearest] - times) < _TOGETHER * np.median(np.diff(times))
            first, second = residuals[near], there[nearest[near]]
            seen = np.isfinite(first) & np.isfinite(second)
            yield first[seen], second[seen]


def _frames(run: Run) -> tuple[Array, Array]:
    """(F,) instants since the start [s] and (F, 2 k) markers' residuals, in units of the noise."""
    seen = run.observed
    time = seen.recording.time
    return time[seen.frames] - time[0], seen.spread(run.residual)[0]


def noise_told(found: Repeated | None) -> str:
    """What repeats say of the noise, as part of a sentence."""
    if found is None:
        return "no recording that was fitted repeats another"
    return f"recordings that repeat each other differ by {1e3 * found.own * found.noise:.2g} mm beside the model"


def remains_told(found: Repeated | None) -> str:
    """Whether what is left happens every time; empty where repeats do not say."""
    if found is None or not np.isfinite(found.share):
        return ""
    share = 100 * found.share
    if share >= 50:
        return f"{share:.0f} % of it is the same in recordings that repeat each other: the arm does this every time"
    return (
        f"{100 - share:.0f} % of it differs between recordings that repeat each other: a disturbance, or something "
        "that sticks, slips or has changed from one to the next"
    )
