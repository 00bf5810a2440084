"""Fits of models with effects: the coordinates of the chain and of the effects, all at once.

Maximum likelihood over whole trajectories, as in `vjm.identification.trajectory_fit`, whose coordinates are extended
by each effect's sizes (in units of typical magnitudes, zero where absent) and shape parameters (logarithms).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from vjm.chain.curve import transfer_state
from vjm.chain.virtual_links import Chain
from vjm.effects.effect import Effect, Key
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.check import estimates
from vjm.identification.parameters import Parametrisation
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.identification.uncertainty import Information, trajectory_information
from vjm.records import REFERENCE, Array, Recording, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.model import Model
from vjm.simulation.run import Run

Names = frozenset[Key]

INCOMPLETE = 1.5  # RMS residual over noise from which a model certainly lacks something, misjudged noise or not
DIVERGED_MISFIT = 4.0  # the same from which an open-loop simulation has lost the phase of the recording
_SHAPE_STEP = 1.0  # of a shape parameter's logarithm in one step: a factor e
_LEAST_JOINT = 1e-3  # bound below which the joint would vanish, and the chain with it change its size


@dataclass(frozen=True)
class Extension:
    """Coordinates of the chain, then those of effects.

    Attributes:
        base: the chain's coordinates.
        effects: those added, at any size.
        reference_effects: number of them, the first ones, that act in the reference recordings too.
    """

    base: Parametrisation
    effects: tuple[Effect, ...]
    reference_effects: int = 0

    def chain(self, x: Array) -> Chain:
        """Return the chain, without effects."""
        return self.base.chain(x[: len(self.base.coordinates)])

    def present(self, x: Array) -> tuple[Effect, ...]:
        """Return the effects at coordinates x (p,)."""
        return tuple(effect.at(x[part]) for effect, part in zip(self.effects, self.parts, strict=True))

    def arms(self, x: Array, recordings: Sequence[Recording]) -> tuple[Arm, ...]:
        """Return the arm that moves in each of the recordings."""
        chain, present = self.chain(x), self.present(x)
        reference, extended = Arm.of(chain, present[: self.reference_effects]), Arm.of(chain, present)
        return tuple(reference if each.condition == REFERENCE else extended for each in recordings)

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds (p,), (p,)."""
        bounds = zip(self.base.bounds, *(effect.bounds for effect in self.effects), strict=True)
        lower, upper = map(np.concatenate, bounds)
        for effect, part in zip(self.effects, self.parts, strict=True):
            if adds_joint(effect, self.base.template):
                lower[part.start] = _LEAST_JOINT
        return lower, upper

    @cached_property
    def max_step(self) -> Array:
        """(p,) largest change of each coordinate in one step: shape parameters mean little while sizes are wrong."""
        effects = [np.full(effect.coordinates.size, np.inf) for effect in self.effects]
        for effect, reach in zip(self.effects, effects, strict=True):
            reach[effect.magnitude_count :] = _SHAPE_STEP
        return np.concatenate([self.base.max_step, *effects])

    @cached_property
    def parts(self) -> tuple[slice, ...]:
        """Coordinates of each effect."""
        counts = [effect.coordinates.size for effect in self.effects]
        stops = (len(self.base.coordinates) + np.cumsum(counts, dtype=int)).tolist()
        return tuple(slice(stop - count, stop) for stop, count in zip(stops, counts, strict=True))


def adds_joint(effect: Effect, chain: Chain) -> bool:
    """Return True if an effect is a joint of its own, which the chain does not have at the effect's null."""
    coordinates = effect.coordinates
    present = effect.at(np.where(np.arange(coordinates.size) < effect.magnitude_count, 1.0, 0.0))
    return present.chain(chain).size != chain.size


@dataclass(frozen=True)
class CandidateFit:
    """Fit of a model with effects, or with none.

    Attributes:
        fit: the minimum.
        shift: (p,) from the coordinates of its chain to those of a beam; None: not known.
    """

    fit: TrajectoryFit
    shift: Array | None = None

    @classmethod
    def unfitted(cls, problem: TrajectoryProblem, x: Array, runs: Sequence[Run]) -> Self:
        """Return a model at coordinates x (p,) with its simulations, nothing but initial states being fitted."""
        return cls(TrajectoryFit(Point(problem, x, tuple(runs)), False, 0))

    @property
    def point(self) -> Point:
        """Coordinates and simulations of the fit."""
        return self.fit.point

    @property
    def chi2(self) -> float:
        """Sum of squared weighted residuals."""
        return self.fit.point.chi2

    @property
    def misfit(self) -> float:
        """RMS weighted residual: one where it is noise."""
        return self.fit.point.misfit

    @property
    def estimate(self) -> Array:
        """(p,) coordinates of a beam, as far as the shift to them is known."""
        if self.shift is None:
            return self.point.x
        return np.clip(self.point.x + self.shift, *self.point.problem.varied.bounds)

    @property
    def extension(self) -> Extension:
        """Coordinates, also where no effect has been added to the chain's."""
        problem = self.point.problem
        return problem.extension if isinstance(problem.extension, Extension) else Extension(problem.parametrisation, ())

    @cached_property
    def effects(self) -> tuple[Effect, ...]:
        """Effects, with the parameters at which the chain follows the recordings."""
        return self.extension.present(self.point.x)

    @property
    def reference_effects(self) -> int:
        """Number of effects, the first ones, that act in the reference recordings too."""
        return self.extension.reference_effects

    @property
    def new_effects(self) -> tuple[Effect, ...]:
        """Effects that were not there before the change."""
        return self.effects[self.reference_effects :]

    @cached_property
    def information(self) -> Information:
        """Fisher information of the coordinates, and the covariance of their scores."""
        return trajectory_information(self.fit, True)[0]

    def model(self, rig: Rig, noise: tuple[float, float]) -> Model:
        """Return the model with the estimates of its chain's parameters, for a rig and its sensors' noise [m, rad]."""
        parametrisation, information = self.point.problem.parametrisation, self.information
        own = slice(len(parametrisation.coordinates))
        estimate, scores = self.estimate[own], information.score_covariance[own, own]
        kept = Information(information.normal[own, own], scores)
        physical = parametrisation.physical_covariance(estimate, information.covariance[own, own])
        parameters = estimates(parametrisation, estimate, kept, physical)
        chain = parametrisation.chain(self.point.x[own])
        return Model(chain, rig, *noise, parameters, self.effects, self.reference_effects)

    @cached_property
    def names(self) -> Names:
        """Ids and places of the effects."""
        return named(self.effects)

    @property
    def uses_feedback(self) -> bool:
        """True if simulations are held near the angles that encoders measured."""
        return self.point.problem.with_feedback

    @property
    def follows(self) -> bool:
        """True if simulations keep the phase of the recordings to their ends, as they always do with feedback."""
        return self.uses_feedback or self.misfit <= DIVERGED_MISFIT


def named(effects: Sequence[Effect]) -> Names:
    """Return the ids and places of effects."""
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
        whole: the problem to solve where the start has the recordings' first seconds only; None: the start's.

    Returns:
        The fit; None where it cannot be simulated.
    """
    base = start.point.problem.parametrisation
    extension = Extension(base, tuple(effects), start.reference_effects)
    chain = start.point.x[: len(base.coordinates)]
    x = np.clip(np.concatenate([chain, *(effect.coordinates for effect in effects)]), *extension.bounds)
    problem = replace(whole or start.point.problem, extension=extension)
    arms = problem.arms(x)
    states = [transfer_state(run.chain, arm.chain, run.state) for run, arm in zip(start.point.runs, arms, strict=True)]
    known = _followed_for(start, extension.effects) if whole is None else start.point.problem.longest
    try:
        return CandidateFit(fit_trajectory(problem, x, None, states, known_duration=known, stop=hopeless))
    except (SimulationDivergedError, InsufficientDataError):
        if problem.step_multiple == 1.0:
            return None
    finer = replace(start.point, problem=replace(start.point.problem, step_multiple=1.0))
    whole = None if whole is None else replace(whole, step_multiple=1.0)
    return refit(replace(start, fit=replace(start.fit, point=finer)), effects, hopeless, whole)


def _followed_for(start: CandidateFit, effects: Sequence[Effect]) -> float:
    """Time for which a model with other effects is known to follow the recordings from a start [s]."""
    new = [effect for effect in effects if effect.key not in start.names]
    gone = [effect for effect in start.effects if effect.key not in named(effects)]
    # A joint more or less changes frequencies: over many periods a wrong one fits any phase.
    if any(adds_joint(effect, start.point.chain) and not effect.nonsmooth for effect in (*new, *gone)):
        return 0.0
    # Open loop, stick-slip is found from the first periods only.
    stick_slip = any(effect.nonsmooth for effect in new) and not start.uses_feedback
    return np.inf if start.follows and not stick_slip else 0.0
