"""Fits of models with effects: all parameters, the effects' and the chain's, at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vjm.diagnosis.extension import Extension
from vjm.effects.effect import Effect
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import TrajectoryFit, first_horizon, fit_trajectory
from vjm.identification.trajectory_problem import Point, TrajectoryProblem
from vjm.simulate.run import transferred

Array = NDArray[np.float64]

ADRIFT = 4.0  # misfit of a start that does not follow the recordings for long
_LARGEST_START = 5.0  # everyday sizes; a linear guess beyond that is no guide


@dataclass(frozen=True)
class Explanation:
    """A model with effects, fitted.

    Attributes:
        effects: with the parameters with which its chain follows the recordings; none: the model without effects.
        fit: the minimum.
        shift: (p,) from its chain's coordinates to those of a beam, whose joints have no end; None: not known.
    """

    effects: tuple[Effect, ...]
    fit: TrajectoryFit
    shift: Array | None = None

    @property
    def point(self) -> Point:
        """Where the fit is."""
        return self.fit.point

    @property
    def chi2(self) -> float:
        """Sum of squared weighted residuals."""
        return self.fit.point.chi2

    @property
    def estimate(self) -> Array:
        """(p,) coordinates, as a beam has them."""
        if self.shift is None:
            return self.point.x
        return np.clip(self.point.x + self.shift, *self.point.problem.varied.bounds)

    @property
    def everywhere(self) -> int:
        """Number of its effects that act in the reference recordings too."""
        extension = self.fit.point.problem.extension
        return extension.everywhere if isinstance(extension, Extension) else 0

    @cached_property
    def names(self) -> frozenset[tuple[str, int | None]]:
        """Which effects, and where."""
        return frozenset((effect.id, effect.link) for effect in self.effects)


def refit(
    start: Explanation,
    effects: Sequence[Effect],
    sizes: Sequence[Array],
    hopeless: Callable[[Point, float], bool] | None = None,
    lost: bool = False,
    whole: TrajectoryProblem | None = None,
) -> Explanation | None:
    """Fit a model with other effects, from a fit with some of them or with none.

    Args:
        start: where to begin.
        effects: those wanted, with the inner parameters from which their search starts.
        sizes: (s,) guessed size of each, in everyday sizes.
        hopeless: may end the search, as of `fit_trajectory`.
        lost: whether the start does not follow the recordings.
        whole: the problem to solve, where the start is of the recordings' first seconds only; None: the start's.

    Returns:
        The fit; None where it cannot be simulated.
    """
    base = start.point.problem.parametrisation
    extension = Extension(base, tuple(effects), start.everywhere)
    first = [
        effect.coordinates if effect in start.effects else _sized(effect, guess)
        for effect, guess in zip(effects, sizes, strict=True)
    ]
    x = np.concatenate([start.point.x[: len(base.coordinates)], *first])
    lower, upper = extension.bounds
    x = np.clip(x, lower, upper)
    problem = replace(whole or start.point.problem, extension=extension)
    arms = problem.arms(x)
    states = [transferred(run.chain, arm.chain, run.state) for run, arm in zip(start.point.runs, arms, strict=True)]
    known = _followed(start, extension.effects, lost) if whole is None else start.point.problem.longest
    try:
        fit = fit_trajectory(problem, x, None, states, known=known, hopeless=hopeless)
    except (SimulationDivergedError, InsufficientDataError):
        if problem.coarse == 1.0:
            return None
        finer = replace(start.point, problem=replace(start.point.problem, coarse=1.0))
        whole = None if whole is None else replace(whole, coarse=1.0)
        return refit(replace(start, fit=replace(start.fit, point=finer)), effects, sizes, hopeless, lost, whole)
    return Explanation(extension.present(fit.point.x), fit)


def _followed(start: Explanation, effects: Sequence[Effect], lost: bool) -> float:
    """How long an explanation is known to follow the recordings [s], with further effects."""
    # What sticks and slips is found from the recordings' beginnings.
    new = [each for each in effects if (each.id, each.link) not in start.names]
    adrift = lost or start.point.misfit > ADRIFT
    return 0.0 if adrift or any(each.abrupt for each in new) else np.inf


def shortened(explanation: Explanation) -> Explanation:
    """The same explanation of the recordings' first periods only, which it follows better.

    A fit of recordings that it cannot follow may have ended anywhere: the search begins there and at the nominal chain.
    """
    point = explanation.point
    nominal = point.problem.parametrisation.start
    plain = np.concatenate([nominal, point.x[nominal.size :]])
    part = point.problem.until(min(first_horizon(point.problem, x) for x in (point.x, plain)))
    fits: list[TrajectoryFit] = []
    for x, states in ((point.x, [run.state for run in point.runs]), (plain, None)):
        with contextlib.suppress(SimulationDivergedError, InsufficientDataError):
            fits.append(fit_trajectory(part, x, None, states, rough=True))
    if not fits:
        return explanation
    fit = min(fits, key=lambda each: each.point.chi2)
    extension = part.extension
    effects = extension.present(fit.point.x) if isinstance(extension, Extension) else ()
    return Explanation(effects, fit)


def _sized(effect: Effect, guess: Array) -> Array:
    """(p,) coordinates of an effect of a guessed size."""
    found = effect.coordinates.copy()
    found[: effect.sizes] = np.clip(guess, -_LARGEST_START, _LARGEST_START)
    return found
