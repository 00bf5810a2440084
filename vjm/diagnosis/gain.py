"""What the extended model gains on recordings that nothing was fitted to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.records import Gain, Replayed
from vjm.experiment.records import REFERENCE

Array = NDArray[np.float64]

_BLOCK = 0.25  # s; residuals farther apart are taken to be independent
_DRAWS = 2000


def gain(followed: Sequence[Replayed], seed: int) -> Gain | None:
    """On the held-out ones among the recordings; None where none can be simulated by both models.

    Args:
        followed: recordings, replayed before and after.
        seed: of the block bootstrap.
    """
    held_out = [each for each in followed if each.recording.role == "holdout" and each.before and each.after]
    changed = [each for each in held_out if each.recording.condition != REFERENCE]
    held_out = changed or held_out  # nothing is to be gained where nothing has changed
    if not held_out:
        return None
    blocks = np.concatenate([_blocks(each) for each in held_out])
    before, after, count, runner_up = blocks.sum(axis=0)
    draws = np.random.default_rng(seed).integers(0, len(blocks), (_DRAWS, len(blocks)))
    sums = blocks[draws].sum(axis=1)
    reductions = 1 - np.sqrt(sums[:, 1] / np.maximum(sums[:, 0], 1e-300))
    low, high = np.quantile(reductions, (0.025, 0.975)).tolist()
    return Gain(
        before=float(np.sqrt(before / count)),
        after=float(np.sqrt(after / count)),
        noise=held_out[0].noise,
        reduction=float(1 - np.sqrt(after / before)),
        interval=(low, high),
        runner_up=float(np.sqrt(runner_up / count)) if np.isfinite(runner_up) else None,
    )


def _blocks(each: Replayed) -> Array:
    """(B, 4) sums over stretches of time: squares before, after [m^2], number of values, squares of the runner-up."""
    recording = each.recording
    known = np.isfinite(recording.markers)
    columns = []
    for replay in (each.before, each.after, each.runner_up):
        if replay is None:
            columns.append(np.full(len(known), np.nan))
            continue
        off = np.where(known, recording.markers - replay.simulation.markers, 0.0)
        columns.append(np.sum(off**2, axis=(1, 2)))
    rows = np.column_stack([columns[0], columns[1], known.sum(axis=(1, 2)), columns[2]])
    numbers = ((recording.time - recording.time[0]) / _BLOCK).astype(int)
    starts = np.flatnonzero(np.diff(numbers, prepend=-1))
    found: Array = np.add.reduceat(rows, starts, axis=0)
    return found[found[:, 2] > 0]
