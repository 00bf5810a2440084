"""Many fits of one model to data like those recorded: bootstrap and Monte Carlo, on any executor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from scipy import stats

from vjm.errors import ChoiceError, InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.identification.records import Identification
from vjm.identification.trajectory_fit import FixedParameter, Point, TrajectoryFit, fit_trajectory
from vjm.identification.uncertainty import covariance, of_trajectory, reach_of, to_physical
from vjm.records import Array, Progress
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

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
        excess = found.point.cost - found.point.fixed_cost - self.fit.point.cost
        return float(np.sqrt(max(excess, 0.0))) / self.inflation

    def _held(self, value: float, near: TrajectoryFit) -> TrajectoryFit:
        fixed = FixedParameter(self.index, value, 1e-3 * self.std / self.inflation)
        problem = replace(self.fit.point.problem, fixed=fixed)
        states: Sequence[Array] = [run.state for run in near.point.runs]
        return fit_trajectory(problem, near.point.x, states=states)


Kind = Literal["noise", "blocks"]
KINDS: tuple[str, ...] = get_args(Kind)


@dataclass(frozen=True)
class Resampled:
    """What the same fit finds in data made anew.

    Attributes:
        names: of the p parameters.
        truth: (p,) their values in the model that made the data.
        values: (B, p) found in each sample.
        std: (B, p) standard errors that each sample's fit gives itself.
        failed: number of samples whose fit did not converge; they are not among the values.
    """

    names: tuple[str, ...]
    truth: Array
    values: Array
    std: Array
    failed: int

    @property
    def spread(self) -> Array:
        """(p,) standard deviation over the samples."""
        return np.asarray(np.std(self.values, axis=0, ddof=1))

    @property
    def bias(self) -> Array:
        """(p,) mean over the samples less the truth."""
        return np.asarray(np.mean(self.values, axis=0) - self.truth)

    @property
    def correlation(self) -> Array:
        """(p, p) correlation over the samples."""
        return np.asarray(np.corrcoef(self.values, rowvar=False)).reshape(len(self.names), len(self.names))

    def interval(self, confidence: float = 0.95) -> Array:
        """(p, 2) basic bootstrap interval of each parameter: the quantiles mirrored about the truth of the samples.

        Raises:
            ShapeError: a confidence outside (0, 1).
        """
        if not 0 < confidence < 1:
            raise ShapeError("confidence", confidence, "a number between 0 and 1")
        tails = [(1 + confidence) / 2, (1 - confidence) / 2]
        return np.asarray(2 * self.truth - np.quantile(self.values, tails, axis=0)).T


def bootstrap(
    fit: Identification,
    samples: int = 100,
    *,
    kind: str = "blocks",
    executor: Executor | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Resampled:
    """Fit data like those recorded again and again: how far do the parameters scatter?

    The data are the fitted trajectories with errors put back on: white noise of the sensors' size (a Monte Carlo
    study of the model), or the recordings' own residuals in blocks as long as they are correlated, which keeps their
    colour.

    Args:
        fit: of method `trajectory`.
        samples: number B of data sets.
        kind: of the errors: `blocks` or `noise`.
        executor: runs the fits; any `concurrent.futures.Executor`, such as a process pool's or
            `dask.distributed.Client.get_executor()`. None: one after another, here.
        seed: of the errors; the same seed gives the same samples on every executor.
        progress: told (text, done, total) after every fit.

    Raises:
        ChoiceError: an unknown kind.
        ShapeError: fewer than two samples.
        InsufficientDataError: a fit by another method, or too many fits that fail.
    """
    if kind not in KINDS:
        raise ChoiceError("kind", kind, KINDS)
    if samples < 2:
        raise ShapeError("samples", samples, "two or more")
    if fit.trajectory is None:
        raise InsufficientDataError("bootstrap", f"the fit is of method {fit.method!r}", "use method 'trajectory'")
    return resample(fit.trajectory.fit.point, samples, kind, executor, seed, progress)


def resample(
    point: Point,
    samples: int,
    kind: str = "noise",
    executor: Executor | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Resampled:
    """The same of any point, which need not be a minimum: with kind `noise`, data from a known truth."""
    seeds = np.random.SeedSequence(seed).spawn(samples)
    bare = replace(point, runs=tuple(replace(run) for run in point.runs))  # without what can be worked out again
    job = partial(_refit, bare, kind)
    run: Callable[..., object] = map if executor is None else executor.map
    found = []
    for k, each in enumerate(run(job, seeds)):  # type: ignore[arg-type, var-annotated]
        found.append(each)
        if progress is not None:
            progress("fitting resampled data", k + 1, samples)
    kept = [each for each in found if each is not None]
    if len(kept) < max(2, samples // 2):
        raise InsufficientDataError(
            "bootstrap", f"{samples - len(kept)} of {samples} fits failed", "identify fewer parameters"
        )
    values, std = (np.stack(each) for each in zip(*kept, strict=True))
    parametrisation = point.problem.parametrisation
    names = tuple(coordinate.name for coordinate in parametrisation.coordinates)
    return Resampled(names, parametrisation.physical(point.x), values, std, samples - len(kept))


def _refit(point: Point, kind: str, seed: np.random.SeedSequence) -> tuple[Array, Array] | None:
    """Parameters (p,) found in one data set, and their standard errors; None where the fit fails."""
    rng = np.random.default_rng(seed)
    errors = _noise if kind == "noise" else _blocks
    observed = tuple(_remade(run, errors(run, rng)) for run in point.runs)
    problem = replace(point.problem, observed=observed)
    try:
        fit = fit_trajectory(problem, point.x, states=[run.state for run in point.runs])
    except SimulationDivergedError:
        return None
    if not fit.converged:
        return None
    parametrisation, x = problem.parametrisation, fit.point.x
    information, _ = of_trajectory(fit, noise_known=True)
    return parametrisation.physical(x), np.sqrt(np.diag(to_physical(parametrisation, x, covariance(information))))


def _remade(run: Run, errors: Array) -> Observations:
    """The recording as the run would have made it, with weighted errors (N,)."""
    seen = run.observed
    return replace(seen, values=seen.predicted(run.arm, run.trajectory) + errors / seen.weights)


def _noise(run: Run, rng: np.random.Generator) -> Array:
    return rng.standard_normal(run.observed.count)


def _blocks(run: Run, rng: np.random.Generator) -> Array:
    """The run's own weighted residuals (N,), blocks as long as they are correlated drawn with replacement."""
    errors = []
    for series in run.residual_series():
        # Instants at which the sensor showed nothing are no part of a block.
        rows = np.isfinite(series).any(axis=1)
        values = series[rows]
        length = min(reach_of(np.nan_to_num(values)), len(values))
        starts = rng.integers(0, len(values) - length + 1, -(-len(values) // length))
        drawn = np.concatenate([values[start : start + length] for start in starts])[: len(values)]
        # Where the block drawn has no value but one is wanted, the value itself stays.
        errors.append(np.where(np.isfinite(drawn), drawn, values)[np.isfinite(values)])
    return np.concatenate(errors)
