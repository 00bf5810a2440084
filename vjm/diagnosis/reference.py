"""Model of an arm before a change: effects that the recordings in the reference condition show already.

The same search that looks for the effects of the change finds them; all recordings are then simulated with them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vjm.diagnosis.baseline import Baseline
from vjm.diagnosis.candidate_fit import INCOMPLETE_MISFIT, SearchOptions
from vjm.diagnosis.selection import Report, Search
from vjm.diagnosis.simulations import open_loop
from vjm.diagnosis.workers import Workers
from vjm.effects import Effect
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.records import REFERENCE, Rig
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.text import in_sentence, number, ratio


def find_preexisting_effects(
    baseline: Baseline,
    effects: Sequence[Effect],
    rig: Rig,
    report: Report,
    workers: Workers,
    seed: int = 0,
    deadline: float = np.inf,
) -> tuple[TrajectoryFit, str]:
    """Extend the model of the reference recordings by the effect that explains much of them, if one does.

    Args:
        baseline: the model without effects.
        effects: what to look for.
        rig: the arm.
        report: called with what is being done, in words.
        workers: share the work.
        seed: of random numbers.
        deadline: reading of `time.monotonic` after which nothing more is fitted [s].

    Returns:
        The model, and a warning where the baseline misses the reference recordings; empty where it does not.
    """
    misfit, noise = baseline.fit.misfit, 1e3 * baseline.fit.point.runs[0].observed.noise[0]
    if not baseline.changed or misfit < INCOMPLETE_MISFIT:
        return baseline.fit, ""
    warning = (
        f"reference recordings: residual {number(misfit * noise, 2)} mm, {ratio(misfit)} × noise: present before the "
        "change, not counted as one"
    )
    start = replace(baseline.fit, point=_in_condition(baseline.fit.point, None))
    smooth = [effect for effect in effects if not effect.nonsmooth]
    # A cause that explains less than 30 % of chi^2 is no better than not to know.
    options = SearchOptions(least_share=0.3, max_effects=1, seed=seed, deadline=deadline)
    search = Search(rig, start, smooth, options, report, workers)
    best = open_loop(search.run().best, search.whole, deadline)
    if not best.effects:
        return baseline.fit, f"{warning}; {'out of time' if search.stopped else 'no single candidate explains it'}"
    problem = best.point.problem
    problem = replace(problem, effects=best.effects, reference_effects=len(best.effects))
    point = _in_condition(replace(best.point, problem=problem), REFERENCE)
    known = replace(best, point=point)
    effect = known.effects[0]
    values = ", ".join(f"{p.name} {number(effect.values[p.name])} {p.unit}".rstrip() for p in effect.parameters)
    remaining = noise * (known.misfit if known.misfit > INCOMPLETE_MISFIT else 1.0)
    explanation = (
        f"{in_sentence(effect.title)} ({values}) reduces it to {number(remaining, 2)} mm and is in both models"
    )
    return known, f"{warning}; {explanation}"


def _in_condition(point: Point, condition: str | None) -> Point:
    """Return a point with its recordings in another condition."""
    runs = tuple(
        replace(run, observed=replace(run.observed, recording=replace(run.observed.recording, condition=condition)))
        for run in point.runs
    )
    return replace(point, runs=runs, problem=replace(point.problem, observed=tuple(run.observed for run in runs)))


def add_changed_recordings(baseline: Baseline, reference: TrajectoryFit) -> tuple[TrajectoryFit, float]:
    """Add the recordings in which something may have changed to the model of the reference recordings.

    Args:
        baseline: the fit, and the recordings that it has not.
        reference: the same fit, with effects that were there before any change.

    Returns:
        The model as it was before any change, simulated in all training recordings; and the misfit of the reference
        recordings that counts as noise from here on: one where it is noise.
    """
    if not baseline.changed:
        return reference, 1.0
    point, problem = reference.point, reference.point.problem
    misfit = point.misfit if point.misfit > INCOMPLETE_MISFIT else 1.0
    known = [replace(run, observed=_with_larger_noise(run.observed, misfit)) for run in point.runs]
    changed = [_with_larger_noise(observed, misfit) for observed in baseline.changed]
    arms = problem.arms(point.x, [observed.recording for observed in changed])
    added = [run for run, _ in fit_initial_states(arms, changed, step_multiple=problem.step_multiple)]
    runs = [*(known if misfit > 1 else point.runs), *added]
    problem = replace(problem, observed=tuple(run.observed for run in runs))
    return TrajectoryFit(Point(problem, point.x, tuple(runs))), misfit


def _with_larger_noise(observed: Observations, factor: float) -> Observations:
    return replace(observed, noise=(factor * observed.noise[0], factor * observed.noise[1]))
