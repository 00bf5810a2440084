"""Where the search begins: the model without effects beside all training recordings, also those that have changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vjm.diagnosis.base import Base
from vjm.diagnosis.refit import Explanation, refit
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.identification.trajectory_problem import Point
from vjm.simulate.initial_state import most_likely
from vjm.simulate.run import Run

LACKING = 1.5  # misfit of the reference recordings from which something was missing before the change
_LOST = 0.3  # share of the motion; a larger residual does not follow it


@dataclass(frozen=True)
class Beginning:
    """Where the search begins.

    Attributes:
        before: the model as it was before any change, beside all training recordings.
        start: the best model without effects, from which effects are looked for.
        lost: whether it does not follow what has changed: then no slope is a guide.
        lacking: misfit of the reference recordings, in units of the noise, that is taken as noise; one: it is noise.
    """

    before: Explanation
    start: Explanation
    lost: bool = False
    lacking: float = 1.0


def beginning(base: Base, plain: Explanation) -> Beginning:
    """From the model of the reference recordings, or of all where there are none.

    Args:
        base: the base fit, and the recordings that it has not.
        plain: the same fit, with what was there before any change.
    """
    if not base.others:
        return Beginning(plain, plain)
    point = plain.point
    lacking = point.misfit if point.misfit > LACKING else 1.0
    problem = point.problem
    known = [_scaled(run, lacking) for run in point.runs]
    others = [replace(each, noise=(lacking * each.noise[0], lacking * each.noise[1])) for each in base.others]
    arms = problem.varied.arms(point.x, [each.recording for each in others])
    new = [run for run, _ in most_likely(arms, others, coarse=problem.coarse)]
    runs = (*known, *new)
    problem = replace(problem, observed=tuple(run.observed for run in runs))
    before = Explanation(TrajectoryFit(Point(problem, point.x, runs), False, 0))
    if any(_lost(run) for run in new):
        return Beginning(before, before, True, lacking)
    start = refit(before, before.effects)
    return Beginning(before, start or before, False, lacking)


def _scaled(run: Run, factor: float) -> Run:
    """The same run with its noise so many times as large."""
    if factor == 1.0:
        return run
    noise = run.observed.noise
    return replace(run, observed=replace(run.observed, noise=(factor * noise[0], factor * noise[1])))


def _lost(run: Run) -> bool:
    """Whether a run does not follow its recording."""
    seen = run.observed
    markers, _ = seen.spread(seen.values - seen.predicted(run.arm, run.steps))
    measured, _ = seen.spread(seen.values)
    motion = np.nanstd(measured, axis=0)
    return bool(np.sqrt(np.nanmean(markers**2)) > _LOST * np.sqrt(np.mean(motion**2)))
