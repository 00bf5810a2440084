"""Uncertainty of parameters: information and whiteness of the residuals, profile intervals and the bootstrap."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Self, get_args

import numpy as np
from scipy import stats
from scipy.optimize import root_scalar

from vjm.errors import (
    ChoiceError,
    InsufficientDataError,
    SimulationDivergedError,
    is_number,
    is_whole,
    require,
    require_kind,
    require_progress,
)
from vjm.identification.parameters import at_bounds
from vjm.identification.records import Identification, Whiteness
from vjm.identification.torque_method import TorqueFit
from vjm.identification.trajectory_fit import Point, TrajectoryFit, fit_trajectory
from vjm.records import NOT_NOISE, Array, Mask, Progress
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run, linearize
from vjm.threads import on_one_thread

SINGULAR = 1e-10  # of the largest eigenvalue: below, forward differences of 1e-6 leave rounding errors only


@dataclass(frozen=True)
class Information:
    """Information of weighted residuals r with derivatives J on p coordinates."""

    normal: Array  # (p, p) J^T J, initial states eliminated
    # (p, p) of the scores J^T r; equal to `normal` where the residuals are white noise of the standard deviation they
    # were weighted with.
    score_covariance: Array
    held: Mask  # (p,) true for coordinates that are at a bound, and so do not follow the noise

    @classmethod
    def of_torque_errors(cls, fit: TorqueFit) -> Self:
        """Return the information in torque errors, whose noise is correlated in time, not only by the smoothing filter.

        Scores are summed over lags up to the filter's length (Newey and West 1987).
        """
        problem, start = fit.problem, 0
        score_covariance = np.zeros((fit.x.size, fit.x.size))
        for residual, prepared in zip(problem.torque_residuals(fit.x), problem.data.prepared, strict=True):
            jacobian = fit.jacobian[start : start + residual.size].reshape(*residual.shape, fit.x.size)
            scores = np.einsum("srp,sr->sp", jacobian, residual / problem.residual_scale)
            start += residual.size
            time, interior = prepared.derivatives.time, prepared.derivatives.interior
            edge = float(time[interior][0] - time[0]) if interior.any() else 0.0
            lags = int(np.ceil(2 * edge / float(np.median(np.diff(time))))) + 1
            score_covariance += _long_run_covariance(scores, lags)
        errors, frequencies = fit.jacobian[:start], fit.jacobian[start : start + len(problem.targets)]
        known = frequencies.T @ frequencies
        held = at_bounds(fit.x, problem.parametrisation.bounds)
        return cls(errors.T @ errors + known, score_covariance + known, held)

    @property
    def covariance(self) -> Array:
        """(p, p) covariance of the coordinates (sandwich); huge along directions that the data do not respond to.

        The others' is that of an estimate without the coordinates that are held, whose own variances are what they
        would be if free: how far from the bound they may be.
        """
        result = self._covariance(np.ones(self.held.size, dtype=bool))
        if self.held.any():
            variances = np.diag(result)[self.held]
            result[self.held], result[:, self.held] = 0.0, 0.0
            result[self.held, self.held] = variances
            result[np.ix_(~self.held, ~self.held)] = self._covariance(~self.held)
        return result

    def _covariance(self, chosen: Mask) -> Array:
        """Return the covariance of some coordinates, the others being known."""
        scale, values, vectors, silent = self._axes(chosen)
        scores = self.score_covariance[np.ix_(chosen, chosen)]
        inverse = scale[:, None] * ((vectors[:, ~silent] / values[~silent]) @ vectors[:, ~silent].T) * scale
        unknown = scale[:, None] * (vectors[:, silent] @ vectors[:, silent].T) * scale
        result: Array = inverse @ scores @ inverse + unknown / SINGULAR
        return result

    def _axes(self, chosen: Mask) -> tuple[Array, Array, Array, Mask]:
        """Return the eigenvalues and eigenvectors of the information on some coordinates, in units of their own.

        The units (c,) come first; last (c,) true for axes that the residuals do not respond to.
        """
        normal = self.normal[np.ix_(chosen, chosen)]
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-200))  # whose square is finite over SINGULAR
        values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
        return scale, values, vectors, values <= SINGULAR * values.max(initial=0.0)

    @property
    def inflation(self) -> float:
        """Factor by which differences of chi^2 between models scatter more than beside white noise of unit variance.

        It is the mean eigenvalue of the score covariance over the information, by which a likelihood ratio is adjusted
        where the model is wrong or the noise correlated (R. E. Chandler and S. Bate, Biometrika 94, 2007).
        """
        free = ~self.held
        scale, values, vectors, silent = self._axes(free)
        axes = scale[:, None] * vectors[:, ~silent] / np.sqrt(values[~silent])
        eigenvalues = np.einsum("ij,ik,kj->j", axes, self.score_covariance[np.ix_(free, free)], axes)
        return float(np.mean(eigenvalues)) if eigenvalues.size else 1.0

    @property
    def visible(self) -> Mask:
        """(p,) True where the residuals respond to a coordinate at all."""
        response = np.sqrt(np.maximum(np.diag(self.normal), 0))
        return response > SINGULAR * max(float(response.max()), 1e-300)


def trajectory_information(fit: TrajectoryFit, noise_known: bool) -> tuple[Information, tuple[Whiteness, ...]]:
    """Return the information in whole trajectories, and each recording's whiteness.

    White residuals give the Fisher information, scaled by their own mean square. Where they are correlated, or larger
    than the noise, the scores' long-run covariance is taken instead, if it is larger (sandwich): Bartlett weights over
    a bandwidth by Andrews (1991).

    `noise_known` says whether the sensors' noise was given, not estimated from the same data.
    """
    point = fit.point
    count = point.x.size
    whiteness = tuple(_whiteness(run) for run in point.runs)
    normal, uncorrelated = np.zeros((2, count, count))
    for linearized, tested in zip(point.linearizations, whiteness, strict=True):
        R = linearized.eliminated(linearized.columns - count).R[:, :-1]
        normal += R.T @ R
        uncorrelated += R.T @ R * (max(tested.mean_square, 1.0) if noise_known else tested.mean_square)
    if all(tested.white for tested in whiteness):
        return Information(normal, uncorrelated, point.held), whiteness
    sandwich, perturbed = np.zeros((count, count)), point.problem.perturbed_arms(point.x)
    for run, linearized, by_parameters in zip(
        point.runs, point.linearizations, linearize(point.runs, perturbed), strict=True
    ):
        scores = run.scores(by_parameters, linearized)
        frames = run.observed.frames  # summed from one camera frame to the next: an even rate
        starts = np.unique(np.r_[0, frames[1:]]) if frames.size else np.arange(len(scores))
        summed = np.add.reduceat(scores, starts, axis=0)
        sandwich += _long_run_covariance(summed, _correlation_length(summed))
    return Information(normal, _larger(sandwich, uncorrelated, normal), point.held), whiteness


def _long_run_covariance(scores: Array, lags: int) -> Array:
    """Return the sum of autocovariances up to a lag, with Bartlett weights."""
    from statsmodels.stats.sandwich_covariance import S_hac_simple  # takes a second

    result: Array = S_hac_simple(scores, nlags=min(lags, len(scores) - 1))
    return result


def _correlation_length(series: Array) -> int:
    """Return the number of samples over which series (F, p) are correlated, by first-order autoregressions.

    Andrews (1991), eqs. 6.2 and 6.4 for Bartlett weights; 0.97 bounds the correlation away from a random walk's.
    """
    power = np.sum(series[:-1] ** 2, axis=0)
    rho = np.clip(np.sum(series[1:] * series[:-1], axis=0) / np.maximum(power, 1e-300), -0.97, 0.97)
    alpha = float(np.max(4 * rho**2 / (1 - rho**2) ** 2, initial=0.0))
    return max(1, int(np.ceil(1.1447 * (alpha * len(series)) ** (1 / 3))))


def _larger(covariance: Array, reference: Array, normal: Array) -> Array:
    """Return the larger of two score covariances, direction by direction."""
    root = np.linalg.cholesky(normal + 1e-12 * np.diag(np.diag(normal)) + 1e-300 * np.eye(len(normal)))
    first, second = (np.linalg.solve(root, np.linalg.solve(root, matrix).T) for matrix in (covariance, reference))
    values, vectors = np.linalg.eigh(first - second)
    excess = (vectors * np.maximum(values, 0.0)) @ vectors.T
    result: Array = reference + root @ excess @ root.T
    return result


def _whiteness(run: Run) -> Whiteness:
    """Apply Box and Pierce's test to ten lags of all sensors of a recording.

    Correlations are pooled over a sensor's coordinates, and values that were not measured count as zero.
    """
    statistic, freedom, largest = 0.0, 0, 0.0
    sensors = 1 if run.observed.encoders_are_input else 2
    for series in run.residual_series()[:sensors]:
        known = np.isfinite(series).any(axis=1)
        values = np.nan_to_num(series[known])
        lags = min(10, len(values) // 4)
        power = float(np.sum(values**2))
        if lags < 1 or power == 0:
            continue
        r = np.array([np.sum(values[lag:] * values[:-lag]) for lag in range(1, lags + 1)]) / power
        statistic, freedom = statistic + np.isfinite(series).sum() * float(np.sum(r**2)), freedom + lags
        largest = max(largest, float(np.abs(r).max()))
    count = max(run.expected_chi2, 1)
    correlated = freedom > 0 and statistic > stats.chi2.isf(NOT_NOISE, freedom)
    excessive = freedom > 0 and run.chi2 > stats.chi2.isf(NOT_NOISE, count)
    return Whiteness(run.observed.recording.file, run.chi2 / count, largest, bool(correlated), bool(excessive))


ErrorKind = Literal["noise", "blocks"]


@on_one_thread
def profile_interval(fit: Identification, name: str, confidence: float = 0.95) -> tuple[float, float]:
    """Find the values of a parameter that the recordings do not reject, all others being fitted again at each.

    Unlike value +- standard errors it need not be symmetric, and respects bounds. Where the residuals are no white
    noise, the likelihood is scaled as the standard errors are.

    Args:
        fit: of method `trajectory`.
        name: of one of its parameters, such as `beam.bending_stiffness`.
        confidence: of the interval.

    Returns:
        Ends of the interval, in the parameter's unit; zero or infinite where the recordings set no limit on that side.

    Raises:
        ChoiceError: no such parameter.
        ShapeError: no fit, or a confidence outside (0, 1).
        InsufficientDataError: a fit by another method, or a parameter that the recordings do not respond to.
    """
    _require_fit(fit)
    estimate = fit[name]
    valid = is_number(confidence) and 0 < confidence < 1
    require("confidence", confidence, valid, "a number between 0 and 1")
    best = _trajectory_fit(fit, "profile")
    if estimate.std is None or not estimate.std > 0:
        raise InsufficientDataError("profile", f"{name}: {estimate.reason or 'no standard error'}", "record more")
    index = fit.parameters.index(estimate)
    quantile = float(stats.norm.ppf((1 + confidence) / 2))
    low, high = (_profile_end(best, index, sign * estimate.std, quantile) for sign in (-1.0, 1.0))
    return max(low, 0.0), high


def _require_fit(fit: Identification) -> None:
    require_kind("fit", fit, Identification, "what vjm.identify returned")


def _trajectory_fit(fit: Identification, purpose: str) -> TrajectoryFit:
    if fit.trajectory is None:
        raise InsufficientDataError(purpose, f"the fit is of method {fit.method!r}", "use method 'trajectory'")
    return fit.trajectory


def _profile_end(best: TrajectoryFit, index: int, std: float, quantile: float) -> float:
    """Find the end of the interval in the direction of a signed `std`: where the likelihood's root meets the quantile.

    Infinite where it does not within 30 standard errors: then the recordings set no limit there.
    """
    parametrisation = best.point.problem.parametrisation
    value = float(parametrisation.physical(best.point.x)[index])
    # The likelihood assumes white noise: standard errors are larger where the residuals are coloured.
    R = best.point.reduced()[0].R[:-1, :-1]
    slope = parametrisation.jacobian(best.point.x)[index]
    inflation = max(abs(std) / float(np.linalg.norm(np.linalg.lstsq(R.T, slope, rcond=None)[0])), 1.0)
    current = best

    def excess(offset: float) -> float:
        """Return the standard deviations by which the fit there is less likely than the best one."""
        nonlocal current
        if offset == 0.0:
            return -quantile
        fixed = (index, value + offset * std, 1e-3 * abs(std) / inflation)
        problem = replace(best.point.problem, fixed=fixed)
        current = fit_trajectory(problem, current.point.x, states=current.point.states)
        held = float(problem.prior(current.point.x)[1][-1]) ** 2
        return float(np.sqrt(max(current.point.cost - held - best.point.cost, 0.0))) / inflation - quantile

    lower, upper = 0.0, 1.1 * quantile  # a parabola's end and a little
    while excess(upper) < 0:
        lower, upper = upper, 2 * upper
        if upper > 30:
            return float(np.sign(std)) * np.inf
    current = best
    return value + std * float(root_scalar(excess, bracket=(lower, upper), xtol=0.02).root)


def bootstrap(
    fit: Identification,
    samples: int = 100,
    *,
    kind: ErrorKind = "blocks",
    executor: Executor | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Array, Array]:
    """Fit simulated data like those recorded again and again, to see how far the parameters scatter.

    The data are the fitted trajectories with errors put back on: white noise of the sensors' standard deviation (a
    Monte Carlo study of the model), or the recordings' own residuals in blocks as long as they are correlated.

    Args:
        fit: of method `trajectory`.
        samples: number of data sets.
        kind: of the errors: `blocks` or `noise`.
        executor: runs the fits; any `concurrent.futures.Executor`, such as a process pool's or
            `dask.distributed.Client.get_executor()`. None: one after another, here.
        seed: of the errors; the same seed gives the same samples on every executor.
        progress: called with (text, done, total) after every fit.

    Returns:
        (B, p) values of `fit.parameters` estimated from each sample, and (B, p) the standard errors that each fit
        gives itself; B is smaller where fits did not converge.

    Raises:
        ChoiceError: an unknown kind.
        ShapeError: no fit, fewer than two samples, or another argument of the wrong kind.
        InsufficientDataError: a fit by another method, or too many fits that fail.
    """
    if kind not in get_args(ErrorKind):
        raise ChoiceError("kind", kind, get_args(ErrorKind))
    _require_fit(fit)
    require("samples", samples, is_whole(samples, 2), "a whole number, two or more")
    require("seed", seed, is_whole(seed, 0), "a whole number, zero or more")
    valid = executor is None or callable(getattr(executor, "map", None))
    require("executor", executor, valid, "a concurrent.futures.Executor, or None")
    require_progress(progress)
    return _resampled(_trajectory_fit(fit, "bootstrap").point, samples, kind, executor, seed, progress)


def _resampled(
    point: Point, samples: int, kind: ErrorKind, executor: Executor | None, seed: int, progress: Progress | None = None
) -> tuple[Array, Array]:
    """Bootstrap at any point, which need not be a minimum: with kind `noise`, data from a known truth."""
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
    return values, std


@on_one_thread  # called in processes of an executor
def _refit(point: Point, kind: ErrorKind, seed: np.random.SeedSequence) -> tuple[Array, Array] | None:
    """Estimate parameters (p,) from one data set, with their standard errors; None where the fit fails."""
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
    """Return the recording as the run would have made it, with new errors."""
    observed = run.observed
    errors = rng.standard_normal(observed.count) if kind == "noise" else _block_errors(run, rng)
    if observed.motion_errors is not None:
        errors = errors + observed.motion_errors @ rng.standard_normal(observed.motion_errors.shape[1])
    return replace(observed, values=run.predicted + errors / observed.weights)


def _block_errors(run: Run, rng: np.random.Generator) -> Array:
    """Draw blocks of the run's weighted residuals (N,) with replacement, as long as these are correlated."""
    errors = []
    for series in run.residual_series():
        # Instants at which the sensor showed nothing are no part of a block.
        values = series[np.isfinite(series).any(axis=1)]
        length = min(_correlation_length(np.nan_to_num(values)), len(values))
        starts = rng.integers(0, len(values) - length + 1, -(-len(values) // length))
        drawn = np.concatenate([values[start : start + length] for start in starts])[: len(values)]
        # Where the block drawn has no value but one is wanted, the value itself stays.
        errors.append(np.where(np.isfinite(drawn), drawn, values)[np.isfinite(values)])
    return np.concatenate(errors)
