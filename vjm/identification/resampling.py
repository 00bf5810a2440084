"""Many fits of one model: intervals by the likelihood's profile, bootstrap and Monte Carlo, on any executor."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from scipy import stats
from scipy.optimize import root_scalar

from vjm.errors import ChoiceError, InsufficientDataError, ShapeError, SimulationDivergedError
from vjm.identification.records import Identification
from vjm.identification.trajectory_fit import Point, TrajectoryFit, fit_trajectory
from vjm.identification.uncertainty import correlation_length, trajectory_information
from vjm.records import Array, Progress
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

ErrorKind = Literal["noise", "blocks"]


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
    """Find the values of a parameter that the recordings do not reject, all others being fitted anew at each.

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
    estimate = fit[name]
    if not 0 < confidence < 1:
        raise ShapeError("confidence", confidence, "a number between 0 and 1")
    best = _trajectory_fit(fit, "profile")
    if estimate.std is None or not estimate.std > 0:
        raise InsufficientDataError("profile", f"{name}: {estimate.reason or 'no standard error'}", "record more")
    index = fit.parameters.index(estimate)
    quantile = float(stats.norm.ppf((1 + confidence) / 2))
    low, high = (_profile_end(best, index, sign * estimate.std, quantile) for sign in (-1.0, 1.0))
    return ProfileInterval(name, estimate.value, max(low, 0.0), high, confidence)


def _trajectory_fit(fit: Identification, what: str) -> TrajectoryFit:
    if fit.trajectory is None:
        raise InsufficientDataError(what, f"the fit is of method {fit.method!r}", "use method 'trajectory'")
    return fit.trajectory


def _profile_end(best: TrajectoryFit, index: int, std: float, quantile: float) -> float:
    """End of the interval, in the direction of a signed `std`: the root of the likelihood ratio reaches the quantile.

    Infinite where it does not within 30 standard errors: then the recordings set no limit there.
    """
    parametrisation = best.point.problem.parametrisation
    value = float(parametrisation.physical(best.point.x)[index])
    # The likelihood knows of white noise only: standard errors are larger where the residuals are not.
    R = best.point.reduced()[0].R[:-1, :-1]
    slope = parametrisation.jacobian(best.point.x)[index]
    inflation = max(abs(std) / float(np.linalg.norm(np.linalg.lstsq(R.T, slope, rcond=None)[0])), 1.0)
    near = best

    def excess(offset: float) -> float:
        """Return the standard deviations by which the fit there is less likely than the best one."""
        nonlocal near
        if offset == 0.0:
            return -quantile
        fixed = (index, value + offset * std, 1e-3 * abs(std) / inflation)
        problem = replace(best.point.problem, fixed=fixed)
        near = fit_trajectory(problem, near.point.x, states=near.point.states)
        held = problem.fixed_residual(near.point.x) ** 2
        return float(np.sqrt(max(near.point.cost - held - best.point.cost, 0.0))) / inflation - quantile

    inside, outside = 0.0, 1.1 * quantile  # a parabola's end and a little
    while excess(outside) < 0:
        inside, outside = outside, 2 * outside
        if outside > 30:
            return float(np.sign(std)) * np.inf
    near = best
    return value + std * float(root_scalar(excess, bracket=(inside, outside), xtol=0.02).root)


@dataclass(frozen=True)
class Resampled:
    """Estimates from B simulated data sets.

    Attributes:
        names: of the p parameters.
        truth: (p,) their values in the model that made the data.
        values: (B, p) estimated from each sample.
        std: (B, p) standard errors that each sample's fit gives itself.
        failed: number of samples whose fit did not converge; they are not among the values.
    """

    names: tuple[str, ...]
    truth: Array
    values: Array
    std: Array
    failed: int

    @property
    def sample_std(self) -> Array:
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
        """Return the basic bootstrap interval (p, 2): the samples' quantiles mirrored about their truth.

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
    kind: ErrorKind = "blocks",
    executor: Executor | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Resampled:
    """Fit simulated data like those recorded again and again, to see how far the parameters scatter.

    The data are the fitted trajectories with errors put back on: white noise of the sensors' standard deviation (a
    Monte Carlo study of the model), or the recordings' own residuals in blocks as long as they are correlated.

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
    if kind not in get_args(ErrorKind):
        raise ChoiceError("kind", kind, get_args(ErrorKind))
    if samples < 2:
        raise ShapeError("samples", samples, "two or more")
    return _resampled(_trajectory_fit(fit, "bootstrap").point, samples, kind, executor, seed, progress)


def _resampled(
    point: Point, samples: int, kind: ErrorKind, executor: Executor | None, seed: int, progress: Progress | None = None
) -> Resampled:
    """The bootstrap at any point, which need not be a minimum: with kind `noise`, data from a known truth."""
    seeds = np.random.SeedSequence(seed).spawn(samples)
    bare = replace(point, runs=tuple(replace(run) for run in point.runs))  # without what can be worked out again
    run: Callable[..., object] = map if executor is None else executor.map
    fits: list[tuple[Array, Array]] = []
    for done, fit in enumerate(run(partial(_refit, bare, kind), seeds), 1):  # type: ignore[arg-type, var-annotated]
        fits += [] if fit is None else [fit]
        if progress is not None:
            progress("fitting resampled data", done, samples)
    if len(fits) < max(2, samples // 2):
        reason = f"{samples - len(fits)} of {samples} fits failed"
        raise InsufficientDataError("bootstrap", reason, "identify fewer parameters")
    values, std = (np.stack(arrays) for arrays in zip(*fits, strict=True))
    parametrisation = point.problem.parametrisation
    names = tuple(coordinate.name for coordinate in parametrisation.coordinates)
    return Resampled(names, parametrisation.physical(point.x), values, std, samples - len(fits))


def _refit(point: Point, kind: ErrorKind, seed: np.random.SeedSequence) -> tuple[Array, Array] | None:
    """Parameters (p,) estimated from one data set, and their standard errors; None where the fit fails."""
    rng = np.random.default_rng(seed)
    observed = tuple(_simulated(run, kind, rng) for run in point.runs)
    problem = replace(point.problem, observed=observed)
    try:
        fit = fit_trajectory(problem, point.x, states=point.states)
    except SimulationDivergedError:
        return None
    if not fit.converged:
        return None
    parametrisation, x = problem.parametrisation, fit.point.x
    information, _ = trajectory_information(fit, noise_known=True)
    covariance = parametrisation.physical_covariance(x, information.covariance)
    return parametrisation.physical(x), np.sqrt(np.diag(covariance))


def _simulated(run: Run, kind: ErrorKind, rng: np.random.Generator) -> Observations:
    """The recording as the run would have made it, with new errors."""
    observed = run.observed
    errors = rng.standard_normal(observed.count) if kind == "noise" else _block_errors(run, rng)
    return replace(observed, values=observed.predicted(run.arm, run.trajectory) + errors / observed.weights)


def _block_errors(run: Run, rng: np.random.Generator) -> Array:
    """The run's own weighted residuals (N,), blocks as long as they are correlated drawn with replacement."""
    errors = []
    for series in run.residual_series():
        # Instants at which the sensor showed nothing are no part of a block.
        values = series[np.isfinite(series).any(axis=1)]
        length = min(correlation_length(np.nan_to_num(values)), len(values))
        starts = rng.integers(0, len(values) - length + 1, -(-len(values) // length))
        drawn = np.concatenate([values[start : start + length] for start in starts])[: len(values)]
        # Where the block drawn has no value but one is wanted, the value itself stays.
        errors.append(np.where(np.isfinite(drawn), drawn, values)[np.isfinite(values)])
    return np.concatenate(errors)
