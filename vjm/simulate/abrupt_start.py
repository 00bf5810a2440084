"""Initial states beside what sticks or rattles.

There, slopes are no guide: a state a little off is that of another motion, and no search leads from one to the other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.effects.effect import is_abrupt
from vjm.simulate.arm import Arm
from vjm.simulate.observation import Observed
from vjm.simulate.run import Run, Start, run_all
from vjm.simulate.steps import still

Array = NDArray[np.float64]

_ITERATIONS = 3  # markers are nearly linear in such small angles
_STEP = 1e-6  # rad
_NEARER = 0.2, 0.0  # parts of what a state was changed by


def standing(arm: Arm, observed: Observed, start: Start) -> Array:
    """(2 nv,) the state at rest that explains a recording best if nothing moves in it.

    Link and springs are as they are at rest; joints that motors turn, and those at links' roots, stand where they are
    seen, and where effects let them stay.
    """
    chain, n = arm.chain, arm.chain.size
    loose = np.concatenate([chain.active, chain.roots]).astype(int)
    rest, time = start.rest[:n], observed.recording.time

    def off(q: Array) -> Array:
        return np.concatenate([observed.residual(arm, still(time, q)), start.root[:n, :n] @ (rest - q)])

    q = rest.copy()
    for _ in range(_ITERATIONS if loose.size else 0):
        here = off(q)
        slopes = np.column_stack([(here - off(q + _STEP * np.eye(n)[k])) / _STEP for k in loose])
        q[loose] += np.linalg.lstsq(slopes, here, rcond=None)[0]
    return np.concatenate([arm.settled(q), np.zeros(n)])


def run_or_stand(
    arms: Sequence[Arm],
    observed: Sequence[Observed],
    starts: Sequence[Start],
    states: Sequence[Array],
    known: Sequence[Array],
    coarse: float,
) -> list[Run]:
    """Simulate recordings as `run_all`; arms that stick or rattle, where they are quiet, from the best of three states.

    Args:
        arms, observed, starts, coarse: as of `run_all`.
        states: (2 nv,) where to begin; a quiet recording also where it stands.
        known: (2 nv,) where else a quiet recording may begin.
    """
    quiet = [k for k, arm in enumerate(arms) if is_abrupt(arm.effects) and observed[k].recording.kind == "quiet"]
    further = [(k, standing(arms[k], observed[k], starts[k])) for k in quiet]
    further += [(k, known[k]) for k in quiet if known[k] is not states[k]]
    every = [*range(len(arms)), *(k for k, _ in further)]
    runs = run_all(
        [arms[k] for k in every],
        [observed[k] for k in every],
        [starts[k] for k in every],
        [*states, *(state for _, state in further)],
        coarse,
    )
    found = runs[: len(arms)]
    for (k, _), run in zip(further, runs[len(arms) :], strict=True):
        found[k] = min(found[k], run, key=lambda each: each.cost)
    return found


def run_nearer(runs: Sequence[Run], changes: Sequence[Array], coarse: float) -> list[Run]:
    """Begin recordings with a part of a change or without it, where that follows them better.

    Args:
        runs: with the whole of the change.
        changes: (2 nv,) of each initial state.
        coarse: multiple of the default step.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    if not runs:
        return []
    every = [run for run in runs for _ in _NEARER]
    states = [run.state - (1 - part) * by for run, by in zip(runs, changes, strict=True) for part in _NEARER]
    found = run_all(
        [run.arm for run in every], [run.observed for run in every], [run.start for run in every], states, coarse
    )
    tries = len(_NEARER)
    return [min(run, *found[k * tries : (k + 1) * tries], key=lambda each: each.cost) for k, run in enumerate(runs)]
