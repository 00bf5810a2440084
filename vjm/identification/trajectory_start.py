"""Where the trajectory method's search begins when all it has is guesses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.errors import SimulationDivergedError
from vjm.identification.trajectory_fit import Progress, TrajectoryFit, fit_trajectory
from vjm.identification.trajectory_problem import Point, TrajectoryProblem
from vjm.simulate.initial_state import most_likely
from vjm.simulate.run import Start
from vjm.simulate.steps import still

Array = NDArray[np.float64]

_LOST = 10.0  # RMS residual over noise of the first periods beyond which other starts are tried
_EXPLAINED = 0.3  # unless it is less than this share of the motion


def from_afar(
    problem: TrajectoryProblem, likely: Sequence[Array], others: Sequence[Array], progress: Progress | None
) -> TrajectoryFit:
    """The fit to the recordings' first periods that follows them best.

    Args:
        problem: those periods.
        likely: (p,) coordinates to start from, the first of them first, the others by how well they follow.
        others: the same, tried where none of these leads anywhere.
        progress: told (text, done, total) now and then.

    Raises:
        SimulationDivergedError: no start can be simulated.
    """
    fit = _attempted(problem, likely[0], progress)
    if fit is None or fit.point.misfit > _LOST:
        fit = _first(problem, likely, progress)
    if fit is None or fit.point.misfit > max(_LOST, _EXPLAINED * _motion(problem, likely[-1])):
        fit = _first(problem, [*likely, *others], progress)
    # Where nothing runs at all, let the search itself say what is wrong.
    return fit or fit_trajectory(problem, likely[-1], progress)


def _first(problem: TrajectoryProblem, starts: Sequence[Array], progress: Progress | None) -> TrajectoryFit | None:
    """The fit from the likeliest start; from the next ones too, until one misses by little."""
    best: TrajectoryFit | None = None
    ranked = sorted((_misfit_at(problem, x), k) for k, x in enumerate(starts))
    for expected, k in ranked:
        if not np.isfinite(expected) or (best is not None and best.point.misfit < _LOST):
            break
        trial = _attempted(problem, starts[k], progress)
        if trial is not None and (best is None or trial.point.misfit < best.point.misfit):
            best = trial
    return best


def _motion(problem: TrajectoryProblem, x: Array) -> float:
    """RMS of what was measured about the arm's rest, in units of the noise."""
    squares = 0.0
    for seen, arm in zip(problem.observed, problem.arms(x), strict=True):
        rest = Start.of(arm, seen.recording).rest[: arm.chain.size]
        residual = seen.residual(arm, still(seen.recording.time, rest))
        squares += float(residual @ residual)
    return float(np.sqrt(squares / sum(seen.count for seen in problem.observed)))


def _misfit_at(problem: TrajectoryProblem, x: Array) -> float:
    """RMS weighted residual from the most likely initial states at coordinates x; infinite where nothing runs."""
    try:
        found = most_likely(problem.arms(x), problem.observed)
    except SimulationDivergedError:
        return np.inf
    return Point(problem, x, tuple(run for run, _ in found)).misfit


def _attempted(problem: TrajectoryProblem, x: Array, progress: Progress | None) -> TrajectoryFit | None:
    """The fit from there; None where the arm cannot be simulated so."""
    try:
        return fit_trajectory(problem, x, progress, rough=True)
    except SimulationDivergedError:
        return None
