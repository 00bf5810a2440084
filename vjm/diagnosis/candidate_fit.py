"""Fits of models with effects: all parameters, the effects' and the chain's, at once."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, Key, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, first_horizon, fit_trajectory
from vjm.records import REFERENCE, Array, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import most_likely
from vjm.simulation.run import transferred

_INNER_STEP = 1.0  # of a logarithm
_LEAST_JOINT = 1e-3  # of an everyday size: an effect that is a joint of its own must not lose it on the way


@dataclass(frozen=True)
class Extension:
    """Coordinates of the base fit, then those of effects.

    Attributes:
        base: the chain's own.
        effects: what is added, at any size.
        reference_effects: number of them, the first ones, that act in the reference recordings too.
    """

    base: Parametrisation
    effects: tuple[Effect, ...]
    reference_effects: int = 0

    def chain(self, x: Array) -> Chain:
        """The chain, without effects."""
        return self.base.chain(x[: self._first])

    def present(self, x: Array) -> tuple[Effect, ...]:
        """The effects at coordinates x (p,)."""
        return tuple(effect.at(x[part]) for effect, part in zip(self.effects, self.parts, strict=True))

    def arms(self, x: Array, recordings: Sequence[Recording]) -> tuple[Arm, ...]:
        """What moves in each of the recordings; in those called reference, only what acts everywhere."""
        chain, present = self.chain(x), self.present(x)
        plain, extended = Arm.of(chain, present[: self.reference_effects]), Arm.of(chain, present)
        return tuple(plain if each.condition == REFERENCE else extended for each in recordings)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,)."""
        lower, upper = zip(self.base.bounds, *(effect.bounds for effect in self.effects), strict=True)
        found = np.concatenate(lower), np.concatenate(upper)
        for effect, part in zip(self.effects, self.parts, strict=True):
            if adds_joint(effect, self.base.template):
                found[0][part.start] = _LEAST_JOINT
        return found

    @cached_property
    def reach(self) -> Array:
        """(p,) by how much a step of a search may change each coordinate.

        Effects' inner ones, as a time constant's logarithm, mean little while the sizes are wrong, and soon run away.
        """
        found = np.concatenate(
            [self.base.reach, *(np.full(effect.coordinates.size, np.inf) for effect in self.effects)]
        )
        for effect, part in zip(self.effects, self.parts, strict=True):
            found[part.start + effect.magnitude_count : part.stop] = _INNER_STEP
        return found

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """The coordinates of each effect."""
        counts = [effect.coordinates.size for effect in self.effects]
        stops = (self._first + np.cumsum(counts, dtype=int)).tolist()
        return tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))

    @property
    def _first(self) -> int:
        return len(self.base.coordinates)


def adds_joint(effect: Effect, chain: Chain) -> bool:
    """Whether an effect is a joint of its own, which its null value has not."""
    typical_magnitude = effect.at(
        np.ones_like(effect.coordinates) * (np.arange(effect.coordinates.size) < effect.magnitude_count)
    )
    return typical_magnitude.chain(chain).size != chain.size


Names = frozenset[Key]

DIVERGED_MISFIT = 4.0  # misfit of a start that does not follow the recordings for long
_ASTRAY = 1.5  # the same of one that was held
_LARGEST_START = 5.0  # everyday sizes; a linear guess beyond that is no guide
_ABRUPT_START = 0.5  # of what sticks or rattles: much smaller than the motion, it does nothing that slopes show
_BEGINNINGS = 3.0  # times the first periods: long enough to tell explanations apart where nothing is a guide
_LEAST_START = 0.1  # of a joint: one that is nearly rigid says little of which way to go


@dataclass(frozen=True)
class CandidateFit:
    """A model with effects, fitted.

    Attributes:
        fit: the minimum.
        shift: (p,) from its chain's coordinates to those of a beam, whose joints have no end; None: not known.
    """

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
    def extension(self) -> Extension:
        """Its coordinates; without effects, none beside the chain's."""
        problem = self.point.problem
        return problem.extension if isinstance(problem.extension, Extension) else Extension(problem.parametrisation, ())

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Its effects, with the parameters with which its chain follows the recordings."""
        return self.extension.present(self.point.x)

    @property
    def uses_feedback(self) -> bool:
        """Whether its simulations are held near the angles that encoders measured."""
        return self.point.problem.with_feedback

    @property
    def follows(self) -> bool:
        """Whether its simulations keep step with the recordings to their ends, as held ones do whatever they lack."""
        return self.uses_feedback or self.point.misfit <= DIVERGED_MISFIT

    @property
    def reference_effects(self) -> int:
        """Number of its effects that act in the reference recordings too."""
        return self.extension.reference_effects

    @cached_property
    def names(self) -> Names:
        """Which effects, and where."""
        return named(self.effects)


def named(effects: Sequence[Effect]) -> Names:
    """What several effects are known by."""
    return frozenset(effect.key for effect in effects)


def refit(
    start: CandidateFit,
    effects: Sequence[Effect],
    hopeless: Callable[[Point, float], bool] | None = None,
    whole: TrajectoryProblem | None = None,
) -> CandidateFit | None:
    """Fit a model with other effects, from a fit with some of them or with none.

    Args:
        start: where to begin.
        effects: those wanted, with the parameters from which their search starts.
        hopeless: may end the search, as of `fit_trajectory`.
        whole: the problem to solve, where the start is of the recordings' first seconds only; None: the start's.

    Returns:
        The fit; None where it cannot be simulated.
    """
    base = start.point.problem.parametrisation
    extension = Extension(base, tuple(effects), start.reference_effects)
    chain = start.point.x[: len(base.coordinates)]
    x = np.clip(np.concatenate([chain, *(effect.coordinates for effect in effects)]), *extension.bounds)
    problem = replace(whole or start.point.problem, extension=extension)
    arms = problem.arms(x)
    states = [transferred(run.chain, arm.chain, run.state) for run, arm in zip(start.point.runs, arms, strict=True)]
    known = _followed(start, extension.effects) if whole is None else start.point.problem.longest
    try:
        fit = fit_trajectory(problem, x, None, states, known=known, hopeless=hopeless)
    except (SimulationDivergedError, InsufficientDataError):
        if problem.step_multiple == 1.0:
            return None
        finer = replace(start.point, problem=replace(start.point.problem, step_multiple=1.0))
        whole = None if whole is None else replace(whole, step_multiple=1.0)
        return refit(replace(start, fit=replace(start.fit, point=finer)), effects, hopeless, whole)
    return CandidateFit(fit)


def _followed(start: CandidateFit, effects: Sequence[Effect]) -> float:
    """How long an explanation is known to follow the recordings [s], with other effects."""
    new = [each for each in effects if each.key not in start.names]
    gone = [each for each in start.effects if each.key not in named(effects)]
    # A joint more swings many times in a recording: with a wrong frequency, soon in any phase.
    if any(adds_joint(each, start.point.chain) and not each.nonsmooth for each in (*new, *gone)):
        return 0.0
    # Nor open loop can what sticks and slips be found but from there.
    sticking = any(each.nonsmooth for each in new) and not start.uses_feedback
    return np.inf if start.follows and not sticking else 0.0


def truncated_fit(candidate_fit: CandidateFit) -> CandidateFit:
    """The same explanation of the recordings' first periods only, which it follows better.

    A fit of recordings that it cannot follow may have ended anywhere: the search begins there and at the nominal chain.
    """
    point = candidate_fit.point
    nominal = point.problem.parametrisation.start
    plain = np.concatenate([nominal, point.x[nominal.size :]])
    part = point.problem.until(min(first_horizon(point.problem, x) for x in (point.x, plain)))
    fits: list[TrajectoryFit] = []
    for x, states in ((point.x, [run.state for run in point.runs]), (plain, None)):
        with contextlib.suppress(SimulationDivergedError, InsufficientDataError):
            fits.append(fit_trajectory(part, x, None, states, rough=True))
    if not fits:
        return candidate_fit
    return CandidateFit(min(fits, key=lambda each: each.point.chi2))


def parameters_unreliable(candidate_fit: CandidateFit) -> bool:
    """Whether a fit that was held lacks so much that its chain may be any, and others had better begin at the nominal.

    Held, no joint drifts, but a chain of wrong frequencies is soon in any phase too.
    """
    return (
        candidate_fit.uses_feedback and candidate_fit.point.misfit > _ASTRAY and not is_nonsmooth(candidate_fit.effects)
    )


def truncated_at_parameters(candidate_fit: CandidateFit) -> CandidateFit:
    """The same parameters beside the recordings' beginnings, from their most likely initial states there."""
    point = candidate_fit.point
    duration = _BEGINNINGS * first_horizon(point.problem, point.x)
    return _beside_first(candidate_fit, point.x, duration, [run.state for run in point.runs])


def restart_from_nominal(candidate_fit: CandidateFit) -> CandidateFit:
    """Its effects beside the nominal chain and the recordings' first periods; itself where that cannot be simulated."""
    nominal = candidate_fit.point.problem.parametrisation.start
    x = np.concatenate([nominal, candidate_fit.point.x[nominal.size :]])
    try:
        return _beside_first(candidate_fit, x, first_horizon(candidate_fit.point.problem, x))
    except (SimulationDivergedError, InsufficientDataError):
        return candidate_fit


def _beside_first(
    candidate_fit: CandidateFit, x: Array, duration: float, states: Sequence[Array] | None = None
) -> CandidateFit:
    """Coordinates x (p,) beside the recordings' first seconds, not fitted."""
    part = candidate_fit.point.problem.until(duration)
    found = most_likely(part.arms(x), part.observed, states, part.step_multiple)
    return CandidateFit(TrajectoryFit(Point(part, x, tuple(run for run, _ in found)), False, 0))


def sized(effect: Effect, guess: Array, chain: Chain) -> Effect:
    """An effect of a guessed size (s,), in everyday sizes, to be fitted beside a chain."""
    found = effect.coordinates
    rigid = _LEAST_START if adds_joint(effect, chain) else -_LARGEST_START
    least = _ABRUPT_START if effect.nonsmooth else rigid
    found[: effect.magnitude_count] = np.clip(guess, least, _LARGEST_START)
    return effect.at(np.clip(found, *effect.bounds))
