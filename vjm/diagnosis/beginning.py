"""Where the search begins: the model without effects beside all training recordings, also those that have changed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vjm.diagnosis.base import Base
from vjm.diagnosis.candidates import Looked
from vjm.diagnosis.refit import Explanation, refit
from vjm.diagnosis.screen import screen
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.identification.trajectory_problem import Point
from vjm.simulate.initial_state import most_likely
from vjm.simulate.run import Run

_LACKING = 1.5  # misfit of the reference recordings from which something was missing before the change
_TELLING = 20.0  # per cent
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


def beginning(base: Base) -> Beginning:
    """From the base fit."""
    plain = Explanation((), base.fit)
    if not base.others:
        return Beginning(plain, plain)
    lacking = base.point.misfit if base.point.misfit > _LACKING else 1.0
    problem = base.point.problem
    known = [_scaled(run, lacking) for run in base.point.runs]
    others = [replace(each, noise=(lacking * each.noise[0], lacking * each.noise[1])) for each in base.others]
    arms = problem.varied.arms(base.point.x, [each.recording for each in others])
    new = [run for run, _ in most_likely(arms, others, coarse=problem.coarse)]
    runs = (*known, *new)
    problem = replace(problem, observed=tuple(run.observed for run in runs))
    before = Explanation((), TrajectoryFit(Point(problem, base.point.x, runs), False, 0))
    if any(_lost(run) for run in new):
        return Beginning(before, before, True, lacking)
    start = refit(before, [], [])
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


def present_before(base: Base, looked: Looked, lacking: float) -> str:
    """What the reference recordings show already, as a sentence; empty where they show nothing."""
    if lacking <= 1.0:
        return ""
    seen = screen(base.point, (), [variant for variant in looked.variants if not variant.abrupt])
    best = int(np.argmax(seen.statistics))
    share = 100 * seen.statistics[best] / max(base.point.chi2 - base.point.count, 1.0)
    looks = f"most like {seen.effects[best].id}, which would explain {min(share, 100.0):.0f} % of it"
    if share < _TELLING:
        looks = "no single candidate explains it"
    peak = max(float(np.nanmax(np.abs(run.observed.recording.markers))) for run in base.point.runs)
    rms = lacking * base.point.runs[0].observed.noise[0]
    return (
        f"already in the reference recordings the model misses by {1e3 * rms:.2g} mm ({100 * rms / peak:.2g} % of the "
        f"largest deflection), {lacking:.3g} times the noise: present before the change, not counted as one; {looks}"
    )
