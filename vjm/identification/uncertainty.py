"""Standard errors, and in words which parameters the data determine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from vjm.chain.virtual_links import Chain
from vjm.identification.parameters import Coordinate, Parametrisation
from vjm.identification.torque_method import TorqueFit
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.model.modes import modes
from vjm.records import Array, Estimate
from vjm.simulation.run import Run

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
    for linearized, white in zip(point.linearizations, whiteness, strict=True):
        R = linearized.eliminated(linearized.columns - count).R[:, :-1]
        normal += R.T @ R
        plain += R.T @ R * (max(white.chi2, 1.0) if noise_known else white.chi2)
    if not any(white.coloured for white in whiteness):
        return Information(normal, plain), whiteness
    sandwich = np.zeros((count, count))
    for run, linearized, own in zip(point.runs, point.linearizations, moved, strict=True):
        scores = _by_frame(run, run.scores(own, linearized))
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
    for series in run.residual_series():
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


_LARGEST_RELATIVE = 0.5  # standard error over value beyond which a parameter is not identified
_SINGULAR = 1e-10  # eigenvalues this small against the largest are none
_NOT_SEEN = 100.0  # standard error over value beyond which the number itself says nothing
_STRONG = 0.9  # correlation worth naming
_AT_BOUND = 1e-6
_SLOWER = 4  # modes that a recording can be made to excite


def covariance(information: Information) -> Array:
    """(p, p) covariance of the coordinates."""
    normal = information.normal
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    silent = values <= _SINGULAR * values[-1]
    inverse = scale[:, None] * ((vectors[:, ~silent] / values[~silent]) @ vectors[:, ~silent].T) * scale
    # What the recordings do not respond to at all is not known at all, rather than known exactly.
    unknown = scale[:, None] * (vectors[:, silent] @ vectors[:, silent].T) * scale
    result: Array = inverse @ information.spread @ inverse + unknown / _SINGULAR
    return result


def to_physical(parametrisation: Parametrisation, x: Array, coordinates: Array) -> Array:
    """(p, p) covariance of the physical parameters from that of the coordinates."""
    slope = parametrisation.jacobian(x)
    result: Array = slope @ coordinates @ slope.T
    return result


def estimates(
    parametrisation: Parametrisation, x: Array, information: Information, physical: Array
) -> tuple[Estimate, ...]:
    """Every coordinate's parameter with its standard error and whether the data determine it.

    Args:
        parametrisation: what was identified.
        x: (p,) coordinates found.
        information: what the residuals say of them.
        physical: (p, p) covariance of the physical parameters.
    """
    values = parametrisation.physical(x)
    std = np.sqrt(np.maximum(np.diag(physical), 0))
    correlation = physical / np.maximum(np.outer(std, std), 1e-300)
    visible = _seen(information)
    result = []
    for k, coordinate in enumerate(parametrisation.coordinates):
        reason = _reason(k, parametrisation, x, values, std, correlation, visible)
        remedy = _remedy(k, parametrisation, x) if reason else ""
        known = bool(np.isfinite(std[k])) and visible[k]
        error = float(std[k]) if known else None
        result.append(Estimate(coordinate.name, float(values[k]), error, coordinate.unit, not reason, reason, remedy))
    return tuple(result)


def _seen(information: Information) -> NDArray[np.bool_]:
    """(p,) whether a coordinate has any part in the directions the residuals respond to."""
    size = np.sqrt(np.maximum(np.diag(information.normal), 0))
    return size > _SINGULAR * max(float(size.max()), 1e-300)


def _reason(
    k: int,
    parametrisation: Parametrisation,
    x: Array,
    values: Array,
    std: Array,
    correlation: Array,
    visible: NDArray[np.bool_],
) -> str:
    """Why parameter k is not determined by the data; empty if it is."""
    coordinate: Coordinate = parametrisation.coordinates[k]
    if not visible[k]:
        return "the recordings do not respond to it"
    if _at_bound(k, parametrisation, x):
        return "at its bound: the data do not hold it away from there"
    relative = std[k] / max(abs(values[k]), 1e-300)
    if relative <= _LARGEST_RELATIVE:
        return ""
    others = np.abs(correlation[k]).copy()
    others[k] = 0.0
    partner = int(np.argmax(others))
    reason = f"its standard error is {100 * relative:.0f} % of its value"
    if relative > _NOT_SEEN:
        reason = "the recordings see it only together with other parameters"
    if others[partner] > _STRONG:
        name = parametrisation.coordinates[partner].name
        reason += f"; it moves together with {name} (correlation {correlation[k, partner]:+.2f})"
    elif coordinate.group == "damping":
        reason += "; the motion decays too little to show it"
    return reason


def _at_bound(k: int, parametrisation: Parametrisation, x: Array) -> bool:
    lower, upper = parametrisation.bounds
    return bool(x[k] - lower[k] < _AT_BOUND or upper[k] - x[k] < _AT_BOUND)


def _remedy(k: int, parametrisation: Parametrisation, x: Array) -> str:
    """Which recording would determine parameter k."""
    found = _recording_for(parametrisation.coordinates[k], parametrisation.chain(x))
    if parametrisation.kind != "uniform" and _at_bound(k, parametrisation, x):
        found += "; or fewer parameters (--parameters uniform)"
    return found


def _recording_for(coordinate: Coordinate, chain: Chain) -> str:
    """Which recording a parameter shows in."""
    group, shared = coordinate.group, coordinate.index < 0
    if group == "hub":
        return "a driven recording whose torque changes faster, so that the hub's own inertia takes more of it"
    if group not in ("stiffness", "damping"):
        return "a recording with a known payload on the tip, or with another one, or one that excites higher modes"
    if group == "stiffness" and shared:
        return "a recording in which the link bends farther beyond the camera's noise, or one with more markers on it"
    mode = _mode_to_excite(chain, coordinate)
    if group == "stiffness":
        return f"markers nearer to this joint, or a recording that excites {mode}, which bends it most"
    more = "faster modes lose more in a period" if shared else "it bends this joint most"
    return f"a longer free decay, or one that excites {mode}: {more}"


def _mode_to_excite(chain: Chain, coordinate: Coordinate) -> str:
    """The one of the slower modes in which a joint has most of the elastic energy; for a whole link, the second."""
    found = modes(chain, gravity=(0.0, 0.0))
    count = min(_SLOWER, found.frequencies.size)
    energy = chain.stiffness[:, None] * found.shapes[:, :count] ** 2
    share = energy / np.maximum(energy.sum(axis=0), 1e-300)
    joint = chain.passive_slices[coordinate.link].start + coordinate.index
    mode = min(1, count - 1) if coordinate.index < 0 else int(np.argmax(share[joint]))
    return f"mode {mode + 1} (about {found.frequencies[mode]:.2g} Hz)"
