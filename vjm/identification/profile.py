"""Profile-likelihood intervals: how far a parameter can go while all the others make up for it as best they can."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.errors import ChoiceError, InsufficientDataError, ShapeError
from vjm.identification.records import Identification
from vjm.identification.trajectory_fit import TrajectoryFit, fit_trajectory
from vjm.identification.trajectory_problem import Hold

Array = NDArray[np.float64]

_MOST_STEPS = 12
_CLOSE = 0.02  # standard deviations
_FARTHEST = 30.0  # standard errors


@dataclass(frozen=True)
class ProfileInterval:
    """An interval of one parameter.

    Attributes:
        name: of the parameter.
        value: the most likely one, in the parameter's unit.
        low, high: ends of the interval; zero or infinite where the recordings set no limit on that side.
        confidence: that the truth is inside.
    """

    name: str
    value: float
    low: float
    high: float
    confidence: float


def profile_interval(fit: Identification, name: str, confidence: float = 0.95) -> ProfileInterval:
    """The values of a parameter that the recordings do not reject, all others being fitted anew at each.

    Unlike value +- standard errors it need not be symmetric, and knows of bounds. Where the residuals are no white
    noise, the likelihood is scaled as the standard errors are.

    Args:
        fit: of method `trajectory`.
        name: of one of its parameters, such as `beam.bending_stiffness`.
        confidence: of the interval.

    Raises:
        ChoiceError: no such parameter.
        ShapeError: a confidence outside (0, 1).
        InsufficientDataError: a fit by another method, or a parameter that the recordings do not respond to.
    """
    names = [estimate.name for estimate in fit.parameters]
    if name not in names:
        raise ChoiceError("parameter", name, names)
    if not 0 < confidence < 1:
        raise ShapeError("confidence", confidence, "a number between 0 and 1")
    if fit.trajectory is None:
        raise InsufficientDataError("profile", f"the fit is of method {fit.method!r}", "use method 'trajectory'")
    index = names.index(name)
    estimate = fit.parameters[index]
    if estimate.std is None or not estimate.std > 0:
        raise InsufficientDataError("profile", f"{name}: {estimate.reason or 'no standard error'}", "record more")
    profile = _Profile(fit.trajectory.fit, index, estimate.std, _plain_std(fit.trajectory.fit, index))
    quantile = float(stats.norm.ppf((1 + confidence) / 2))
    ends = [profile.end(sign, quantile) for sign in (-1.0, 1.0)]
    return ProfileInterval(name, estimate.value, max(ends[0], 0.0), ends[1], confidence)


def _plain_std(fit: TrajectoryFit, index: int) -> float:
    """Standard error by the Fisher information alone, which is what the likelihood itself knows."""
    point = fit.point
    R = point.gathered()[0].R[:-1, :-1]
    slope = point.problem.parametrisation.jacobian(point.x)[index]
    return float(np.linalg.norm(np.linalg.lstsq(R.T, slope, rcond=None)[0]))


class _Profile:
    """Fits with one parameter held."""

    def __init__(self, fit: TrajectoryFit, index: int, std: float, plain: float) -> None:
        self.fit = fit
        self.index = index
        self.std = std
        self.inflation = max(std / plain, 1.0)
        self.value = float(fit.point.problem.parametrisation.physical(fit.point.x)[index])

    def end(self, sign: float, quantile: float) -> float:
        """Where the signed root of the likelihood ratio reaches the quantile, by secants."""
        offset, found = sign * quantile * self.std, self.fit
        inside, outside = 0.0, np.inf
        for _ in range(_MOST_STEPS):
            found = self._held(self.value + offset, found)
            reached = self._root(found)
            if abs(reached - quantile) < _CLOSE:
                return self.value + offset
            if reached < quantile:
                inside = abs(offset)
            else:
                outside = abs(offset)
            size = abs(offset) * quantile / max(reached, 0.1 * quantile)
            if np.isfinite(outside):
                size = float(np.clip(size, 0.9 * inside + 0.1 * outside, 0.1 * inside + 0.9 * outside))
            if size > _FARTHEST * self.std:
                return sign * np.inf
            offset = sign * size
        return self.value + offset

    def _root(self, found: TrajectoryFit) -> float:
        """Standard deviations by which the fit is less likely than the best one."""
        excess = found.point.cost - found.point.held_cost - self.fit.point.cost
        return float(np.sqrt(max(excess, 0.0))) / self.inflation

    def _held(self, value: float, near: TrajectoryFit) -> TrajectoryFit:
        hold = Hold(self.index, value, 1e-3 * self.std / self.inflation)
        problem = replace(self.fit.point.problem, hold=hold)
        states: Sequence[Array] = [run.state for run in near.point.runs]
        return fit_trajectory(problem, near.point.x, states=states)
