"""Fits that race: a few steps of each explanation, the promising ones to their end, the hopeless ones given up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.refit import Explanation, refit
from vjm.diagnosis.screen import Screen
from vjm.effects import Effect
from vjm.identification.trajectory_problem import Point

Array = NDArray[np.float64]
# What to start from, the effects wanted, their guessed sizes, and whether the start does not follow the recordings.
Job = tuple[Explanation, list[Effect], list[Array], bool]

ALIKE = 10.0  # chi^2 by which an explanation must be worse to be told from another
_FIRST_STEPS = 2  # of each explanation, before the most promising are followed to the end
_MARGIN = 3.0  # a refit is given up once its next step promises less than a third of what it lacks
# Of an explanation that leaves so large a misfit, the best parameters do not matter once a step lowers chi^2 by less.
_DONE = ((1.5, 1e-2), (1.01, 1e-3))


def proposal(start: Explanation, seen: Screen, chosen: Sequence[int], lost: bool = False) -> Job:
    """What to fit: an explanation with further effects, of sizes that a screen guesses.

    Args:
        start: the explanation.
        seen: the screen.
        chosen: of its effects.
        lost: whether the start does not follow the recordings: then sizes are everyday ones.
    """
    added = [seen.effects[k] for k in chosen]
    guess = np.ones(sum(effect.sizes for effect in added)) if lost else seen.guess(chosen)
    stops = np.cumsum([effect.sizes for effect in added])
    sizes = [guess[stop - effect.sizes : stop] for stop, effect in zip(stops, added, strict=True)]
    known = [effect.coordinates[: effect.sizes] for effect in start.effects]
    return start, [*start.effects, *added], [*known, *sizes], lost


def begun_with(job: Job) -> Explanation | None:
    """A refit's first steps."""
    start, effects, sizes, lost = job
    return refit(start, effects, sizes, Patience(_FIRST_STEPS), lost)


def finished(begun: Explanation, record: float = np.inf) -> Explanation | None:
    """A refit to its end; given up once it will not come near the record."""
    if begun.fit.converged:
        return begun
    own = [effect.coordinates[: effect.sizes] for effect in begun.effects]
    return refit(begun, begun.effects, own, Patience(np.inf, record))


class Patience:
    """Ends a fit after some steps, or when it will not come near a record, or when it is wrong and as good as done."""

    def __init__(self, steps: float, record: float = np.inf) -> None:
        self.left = steps
        self.record = record

    def __call__(self, point: Point, predicted: float) -> bool:
        """Whether to end it where it is, given by how much its next step may lower chi^2."""
        self.left -= 1
        share = predicted / point.chi2
        wrong = any(point.misfit > misfit and share < little for misfit, little in _DONE)
        return self.left < 0 or wrong or point.chi2 - _MARGIN * predicted > self.record + 5 * ALIKE
