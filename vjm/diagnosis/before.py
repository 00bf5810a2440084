"""What was missing already before a change: looked for in the reference recordings alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from vjm.diagnosis.base import Base
from vjm.diagnosis.beginning import LACKING, Beginning
from vjm.diagnosis.extension import Extension
from vjm.diagnosis.refit import Explanation
from vjm.diagnosis.search import Found, Rules, Search
from vjm.diagnosis.workers import Workers
from vjm.effects import Effect
from vjm.experiment.records import REFERENCE, Rig
from vjm.identification.trajectory_problem import Point

_MUCH = Rules(matters=0.3, most=1)  # share of chi^2: what explains less is no better than not to know


def already_there(
    base: Base, effects: Sequence[Effect], rig: Rig, tell: Callable[[str], None], workers: Workers
) -> Explanation:
    """The model of the reference recordings, with the effect that explains much of them, if one does.

    Args:
        base: the model without effects.
        effects: what to look for.
        rig: the arm.
        tell: told what is being done.
        workers: share the work.
    """
    if not base.others or base.point.misfit < LACKING:
        return base.plain
    start = Explanation(replace(base.fit, point=_as(base.point, None)))
    smooth = [effect for effect in effects if not effect.abrupt]
    search = Search(rig, Beginning(start, start), smooth, _MUCH, tell, workers)
    best = search.run(Found.nothing(start, search.judged(start))).best
    if not best.effects:
        return base.plain
    problem = best.point.problem
    extension = Extension(problem.parametrisation, best.effects, everywhere=len(best.effects))
    point = _as(replace(best.point, problem=replace(problem, extension=extension)), REFERENCE)
    return Explanation(replace(best.fit, point=point))


def _as(point: Point, condition: str | None) -> Point:
    """The same with its recordings in another condition."""
    runs = tuple(
        replace(run, observed=replace(run.observed, recording=replace(run.observed.recording, condition=condition)))
        for run in point.runs
    )
    return replace(point, runs=runs, problem=replace(point.problem, observed=tuple(run.observed for run in runs)))


def told(base: Base, known: Explanation, lacking: float) -> str:
    """What the reference recordings show already, as a sentence; empty where it is nothing but noise."""
    if base.point.misfit < LACKING or not base.others:
        return ""
    noise = 1e3 * base.point.runs[0].observed.noise[0]
    said = (
        f"already in the reference recordings the model misses by {base.point.misfit * noise:.2g} mm, "
        f"{base.point.misfit:.3g} times the noise: present before the change, and not counted as one"
    )
    if not known.effects:
        return f"{said}; no single candidate explains it"
    effect = known.effects[0]
    values = ", ".join(f"{name} {value:.3g}" for name, value in effect.values.items())
    return f"{said}; {effect.id} ({values}) explains it down to {lacking * noise:.2g} mm and is part of both models"
