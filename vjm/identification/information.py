"""What a fit's residuals say of its coordinates, and how far they can be trusted (Fisher information, sandwich)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.identification.torque_fit import TorqueFit
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.simulate.run import Run

Array = NDArray[np.float64]

_LAGS = 10  # samples, of the test for coloured residuals
_FALSE_ALARM = 1e-3


@dataclass(frozen=True)
class Information:
    """Of p coordinates.

    Attributes:
        normal: (p, p) J^T J of the weighted residuals, initial states eliminated.
        spread: (p, p) covariance of their scores J^T r; equal to `normal` where the residuals are white noise of
            the size they were weighted with.
    """

    normal: Array
    spread: Array


def of_torque(fit: TorqueFit) -> Information:
    """Of torque errors, whose noise is correlated in time, by the smoothing filter among others.

    Scores are summed over lags up to the filter's reach (Newey and West 1987).
    """
    count = fit.x.size
    normal, spread = np.zeros((count, count)), np.zeros((count, count))
    for residual, jacobian, prepared in zip(fit.residuals, fit.jacobians, fit.prepared, strict=True):
        normal += np.einsum("srp,srq->pq", jacobian, jacobian)
        scores = np.einsum("srp,sr->sp", jacobian, residual)
        time = prepared.derivatives.time
        inside = prepared.derivatives.interior
        reach = float(time[inside][0] - time[0]) if inside.any() else 0.0
        lags = int(np.ceil(2 * reach / float(np.median(np.diff(time))))) + 1
        spread += _long_run(scores, min(lags, len(scores) - 1))
    normal, spread = normal / fit.spread**2, spread / fit.spread**4
    normal += fit.frequency_jacobian.T @ fit.frequency_jacobian
    spread += fit.frequency_jacobian.T @ fit.frequency_jacobian
    return Information(normal, spread)


def _long_run(scores: Array, lags: int) -> Array:
    total = scores.T @ scores
    for lag in range(1, lags + 1):
        weight = 1 - lag / (lags + 1)
        cross = scores[lag:].T @ scores[:-lag]
        total = total + weight * (cross + cross.T)
    return np.asarray(total)


@dataclass(frozen=True)
class Whiteness:
    """What is left of a recording once the model has explained it.

    Attributes:
        file: the recording's.
        chi2: mean square of the weighted residuals: one where they are noise.
        correlation: largest correlation of a residual with those up to ten samples later, over all sensors.
        coloured: whether they are certainly no white noise.
    """

    file: str
    chi2: float
    correlation: float
    coloured: bool


def of_trajectory(fit: TrajectoryFit, noise_known: bool) -> tuple[Information, tuple[Whiteness, ...]]:
    """Of whole trajectories.

    White residuals give the Fisher information, scaled by their own size. Where they are coloured, or larger than the
    noise, the scores' long-run covariance is taken instead, if it is larger (sandwich): Bartlett weights, their reach
    by Andrews (1991).

    Args:
        fit: the minimum.
        noise_known: whether the sensors' noise was given, not estimated from the same data.
    """
    point = fit.point
    count = point.x.size
    moved = point.problem.moved(point.x)
    whiteness = tuple(_whiteness(run) for run in point.runs)
    normal, plain = np.zeros((count, count)), np.zeros((count, count))
    for triangle, white in zip(point.triangles, whiteness, strict=True):
        R = triangle.eliminated(triangle.columns - count).R[:, :-1]
        normal += R.T @ R
        plain += R.T @ R * (max(white.chi2, 1.0) if noise_known else white.chi2)
    if not any(white.coloured for white in whiteness):
        return Information(normal, plain), whiteness
    sandwich = np.zeros((count, count))
    for run, triangle, own in zip(point.runs, point.triangles, moved, strict=True):
        scores = _by_frame(run, run.scores(own, triangle))
        sandwich += _long_run(scores, min(reach_of(scores), len(scores) - 1))
    return Information(normal, _larger(sandwich, plain, normal)), whiteness


def _by_frame(run: Run, scores: Array) -> Array:
    """Scores (T, p) of all sensors, summed from one camera frame to the next, (F, p)."""
    frames = run.observed.frames
    starts = np.unique(np.r_[0, frames[1:]]) if frames.size else np.arange(len(scores))
    summed: Array = np.add.reduceat(scores, starts, axis=0)
    return summed


def reach_of(series: Array) -> int:
    """Number of samples over which series (F, p) are correlated, by their first-order autoregressions."""
    power = np.sum(series[:-1] ** 2, axis=0)
    rho = np.clip(np.sum(series[1:] * series[:-1], axis=0) / np.maximum(power, 1e-300), -0.97, 0.97)
    alpha = float(np.max(4 * rho**2 / (1 - rho**2) ** 2, initial=0.0))
    return max(1, int(np.ceil(1.1447 * (alpha * len(series)) ** (1 / 3))))


def _larger(one: Array, other: Array, normal: Array) -> Array:
    """The one of two spreads that makes the coordinates less sure, direction by direction."""
    root = np.linalg.cholesky(normal + 1e-12 * np.diag(np.diag(normal)) + 1e-300 * np.eye(len(normal)))
    whitened = [np.linalg.solve(root, np.linalg.solve(root, each).T) for each in (one, other)]
    values, vectors = np.linalg.eigh(whitened[0] - whitened[1])
    more = (vectors * np.maximum(values, 0.0)) @ vectors.T
    result: Array = other + root @ more @ root.T
    return result


def _whiteness(run: Run) -> Whiteness:
    """Ljung and Box's test over all the sensors of a recording."""
    statistic, freedom, largest = 0.0, 0, 0.0
    for series in run.series():
        known = np.isfinite(series).any(axis=1)
        values = np.nan_to_num(series[known])
        lags = min(_LAGS, len(values) // 4)
        power = float(np.sum(values**2))
        if lags < 1 or power == 0:
            continue
        r = np.array([np.sum(values[lag:] * values[:-lag]) for lag in range(1, lags + 1)]) / power
        count = int(np.isfinite(series).sum())
        statistic, freedom = statistic + count * float(np.sum(r**2)), freedom + lags
        largest = max(largest, float(np.abs(r).max()))
    chi2 = run.chi2 / max(run.observed.count, 1)
    excess = stats.chi2.isf(_FALSE_ALARM, max(run.observed.count, 1)) / max(run.observed.count, 1)
    coloured = freedom > 0 and (statistic > stats.chi2.isf(_FALSE_ALARM, freedom) or chi2 > excess)
    return Whiteness(run.observed.recording.file, chi2, largest, bool(coloured))
