"""Standard errors, and in words which parameters the data determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from vjm.chain.virtual_links import Chain
from vjm.identification.parameters import Parametrisation
from vjm.identification.torque_method import TorqueFit
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.model.modes import modes
from vjm.records import Array, Estimate, Mask
from vjm.simulation.run import Run

_SINGULAR = 1e-10  # of the largest eigenvalue: below, forward differences of 1e-6 leave rounding errors only
_MAX_RELATIVE_STD = 0.5  # a parameter beyond is not identified: within two standard errors it may be zero
_MAX_MEANINGFUL_STD = 100.0  # relative; beyond, the number itself says nothing
_STRONG_CORRELATION = 0.9  # worth naming: the partner alone explains more than 80 % of the variance


@dataclass(frozen=True)
class Information:
    """Information of weighted residuals r with derivatives J on p coordinates.

    Attributes:
        normal: (p, p) J^T J, initial states eliminated.
        score_covariance: (p, p) covariance of the scores J^T r; equal to `normal` where the residuals are white noise
            of the standard deviation they were weighted with.
    """

    normal: Array
    score_covariance: Array

    @property
    def covariance(self) -> Array:
        """(p, p) covariance of the coordinates (sandwich); huge along directions that the data do not respond to."""
        scale = 1 / np.sqrt(np.maximum(np.diag(self.normal), 1e-300))
        values, vectors = np.linalg.eigh(self.normal * np.outer(scale, scale))
        silent = values <= _SINGULAR * values[-1]
        inverse = scale[:, None] * ((vectors[:, ~silent] / values[~silent]) @ vectors[:, ~silent].T) * scale
        unknown = scale[:, None] * (vectors[:, silent] @ vectors[:, silent].T) * scale
        result: Array = inverse @ self.score_covariance @ inverse + unknown / _SINGULAR
        return result

    @property
    def visible(self) -> Mask:
        """(p,) True where the residuals respond to a coordinate at all."""
        response = np.sqrt(np.maximum(np.diag(self.normal), 0))
        return response > _SINGULAR * max(float(response.max()), 1e-300)


@dataclass(frozen=True)
class Whiteness:
    """Test of a recording's weighted residuals for white noise.

    Attributes:
        file: the recording's.
        chi2: their mean square: one where they are noise.
        correlation: largest correlation of a residual with those up to ten samples later, over all sensors.
        coloured: True if they are certainly no white noise.
    """

    file: str
    chi2: float
    correlation: float
    coloured: bool


def torque_information(fit: TorqueFit) -> Information:
    """Return the information in torque errors, whose noise is correlated in time, by the smoothing filter among others.

    Scores are summed over lags up to the filter's length (Newey and West 1987).
    """
    normal, score_covariance = np.zeros((2, fit.x.size, fit.x.size))
    for residual, jacobian, prepared in zip(fit.residuals, fit.jacobians, fit.problem.data.prepared, strict=True):
        normal += np.einsum("srp,srq->pq", jacobian, jacobian)
        scores = np.einsum("srp,sr->sp", jacobian, residual)
        time = prepared.derivatives.time
        inside = prepared.derivatives.interior
        edge = float(time[inside][0] - time[0]) if inside.any() else 0.0
        lags = int(np.ceil(2 * edge / float(np.median(np.diff(time))))) + 1
        score_covariance += _long_run_covariance(scores, lags)
    scale = fit.problem.residual_scale
    frequency = fit.frequency_jacobian.T @ fit.frequency_jacobian
    return Information(normal / scale**2 + frequency, score_covariance / scale**4 + frequency)


def trajectory_information(fit: TrajectoryFit, noise_known: bool) -> tuple[Information, tuple[Whiteness, ...]]:
    """Return the information in whole trajectories, and each recording's whiteness.

    White residuals give the Fisher information, scaled by their own mean square. Where they are coloured, or larger
    than the noise, the scores' long-run covariance is taken instead, if it is larger (sandwich): Bartlett weights over
    a bandwidth by Andrews (1991).

    `noise_known` says whether the sensors' noise was given, not estimated from the same data.
    """
    point = fit.point
    count = point.x.size
    moved = point.problem.moved(point.x)
    whiteness = tuple(_whiteness(run) for run in point.runs)
    normal, plain = np.zeros((2, count, count))
    for linearized, white in zip(point.linearizations, whiteness, strict=True):
        R = linearized.eliminated(linearized.columns - count).R[:, :-1]
        normal += R.T @ R
        plain += R.T @ R * (max(white.chi2, 1.0) if noise_known else white.chi2)
    if not any(white.coloured for white in whiteness):
        return Information(normal, plain), whiteness
    sandwich = np.zeros((count, count))
    for run, linearized, own in zip(point.runs, point.linearizations, moved, strict=True):
        scores = run.scores(own, linearized)
        frames = run.observed.frames  # summed from one camera frame to the next: an even rate
        starts = np.unique(np.r_[0, frames[1:]]) if frames.size else np.arange(len(scores))
        summed = np.add.reduceat(scores, starts, axis=0)
        sandwich += _long_run_covariance(summed, correlation_length(summed))
    return Information(normal, _larger(sandwich, plain, normal)), whiteness


def _long_run_covariance(scores: Array, lags: int) -> Array:
    """Sum of autocovariances up to a lag, with Bartlett weights."""
    from statsmodels.stats.sandwich_covariance import S_hac_simple  # takes a second

    result: Array = S_hac_simple(scores, nlags=min(lags, len(scores) - 1))
    return result


def correlation_length(series: Array) -> int:
    """Return the number of samples over which series (F, p) are correlated, by first-order autoregressions.

    Andrews (1991), eqs. 6.2 and 6.4 for Bartlett weights; 0.97 bounds the correlation away from a random walk's.
    """
    power = np.sum(series[:-1] ** 2, axis=0)
    rho = np.clip(np.sum(series[1:] * series[:-1], axis=0) / np.maximum(power, 1e-300), -0.97, 0.97)
    alpha = float(np.max(4 * rho**2 / (1 - rho**2) ** 2, initial=0.0))
    return max(1, int(np.ceil(1.1447 * (alpha * len(series)) ** (1 / 3))))


def _larger(one: Array, other: Array, normal: Array) -> Array:
    """The larger of two score covariances, direction by direction."""
    root = np.linalg.cholesky(normal + 1e-12 * np.diag(np.diag(normal)) + 1e-300 * np.eye(len(normal)))
    first, second = (np.linalg.solve(root, np.linalg.solve(root, each).T) for each in (one, other))
    values, vectors = np.linalg.eigh(first - second)
    excess = (vectors * np.maximum(values, 0.0)) @ vectors.T
    result: Array = other + root @ excess @ root.T
    return result


def _whiteness(run: Run) -> Whiteness:
    """Box and Pierce's test over ten lags of all the sensors of a recording, at a false-alarm rate of 0.1 %.

    Correlations are pooled over a sensor's coordinates, and values that were not measured count as zero.
    """
    statistic, freedom, largest = 0.0, 0, 0.0
    for series in run.residual_series():
        known = np.isfinite(series).any(axis=1)
        values = np.nan_to_num(series[known])
        lags = min(10, len(values) // 4)
        power = float(np.sum(values**2))
        if lags < 1 or power == 0:
            continue
        r = np.array([np.sum(values[lag:] * values[:-lag]) for lag in range(1, lags + 1)]) / power
        statistic, freedom = statistic + np.isfinite(series).sum() * float(np.sum(r**2)), freedom + lags
        largest = max(largest, float(np.abs(r).max()))
    count = max(run.observed.count, 1)
    correlated = freedom > 0 and statistic > stats.chi2.isf(1e-3, freedom)
    large = freedom > 0 and run.chi2 > stats.chi2.isf(1e-3, count)
    return Whiteness(run.observed.recording.file, run.chi2 / count, largest, bool(correlated or large))


def estimates(
    parametrisation: Parametrisation, x: Array, information: Information, physical: Array
) -> tuple[Estimate, ...]:
    """Return every parameter at coordinates x (p,) with its standard error and whether the data determine it, in words.

    `physical` is the (p, p) covariance of the physical parameters.
    """
    values = parametrisation.physical(x)
    std = np.sqrt(np.maximum(np.diag(physical), 0))
    correlation = physical / np.maximum(np.outer(std, std), 1e-300)
    lower, upper = parametrisation.bounds
    at_bound = np.minimum(x - lower, upper - x) < 1e-6  # searches start no nearer
    visible = information.visible
    result = []
    for k, coordinate in enumerate(parametrisation.coordinates):
        reason = remedy = ""
        if not visible[k]:
            reason = "the recordings do not respond to it"
        elif at_bound[k]:
            reason = "at its bound: the data do not hold it away from there"
        elif not std[k] <= _MAX_RELATIVE_STD * max(abs(values[k]), 1e-300):
            reason = _uncertain(k, parametrisation, std[k] / max(abs(values[k]), 1e-300), correlation[k])
        if reason:
            remedy = _remedy(parametrisation, k, x)
            if parametrisation.kind != "uniform" and at_bound[k]:
                remedy += "; or fewer parameters (--parameters uniform)"
        error = float(std[k]) if np.isfinite(std[k]) and visible[k] else None
        result.append(Estimate(coordinate.name, float(values[k]), error, coordinate.unit, not reason, reason, remedy))
    return tuple(result)


def _uncertain(k: int, parametrisation: Parametrisation, relative_std: float, correlation: Array) -> str:
    """Explain why parameter k has so large a standard error."""
    others = np.abs(correlation)
    others[k] = 0.0
    partner = int(np.argmax(others))
    reason = f"its standard error is {100 * relative_std:.0f} % of its value"
    if relative_std > _MAX_MEANINGFUL_STD:
        reason = "the recordings see it only together with other parameters"
    if others[partner] > _STRONG_CORRELATION:
        name = parametrisation.coordinates[partner].name
        reason += f"; it moves together with {name} (correlation {correlation[partner]:+.2f})"
    elif parametrisation.coordinates[k].group == "damping":
        reason += "; the motion decays too little to show it"
    return reason


def _remedy(parametrisation: Parametrisation, k: int, x: Array) -> str:
    """Name the recording that would determine parameter k."""
    coordinate = parametrisation.coordinates[k]
    group, shared = coordinate.group, coordinate.index < 0
    if group == "hub":
        return "a driven recording whose torque changes faster, so that the hub's own inertia takes more of it"
    if group not in ("stiffness", "damping"):
        return "a recording with a known payload on the tip, or with another one, or one that excites higher modes"
    if group == "stiffness" and shared:
        return "a recording in which the link bends farther beyond the camera's noise, or one with more markers on it"
    mode = _mode_to_excite(parametrisation.chain(x), coordinate.link, coordinate.index)
    if group == "stiffness":
        return f"markers nearer to this joint, or a recording that excites {mode}, which bends it most"
    more = "faster modes lose more in a period" if shared else "it bends this joint most"
    return f"a longer free decay, or one that excites {mode}: {more}"


def _mode_to_excite(chain: Chain, link: int, index: int) -> str:
    """The one of the four slowest modes with most of its elastic energy in a joint; for a whole link, the second."""
    found = modes(chain, gravity=(0.0, 0.0))
    count = min(4, found.frequencies.size)  # faster ones are hard to excite
    energy = chain.stiffness[:, None] * found.shapes[:, :count] ** 2
    share = energy / np.maximum(energy.sum(axis=0), 1e-300)
    joint = chain.passive_slices[link].start + index
    mode = min(1, count - 1) if index < 0 else int(np.argmax(share[joint]))
    return f"mode {mode + 1} (about {found.frequencies[mode]:.2g} Hz)"
