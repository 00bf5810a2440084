"""Standard errors, and in words which parameters the data determine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vjm.identification.parametrisation import Coordinate, Parametrisation
from vjm.identification.torque_fit import TorqueFit
from vjm.parameters import Estimate

Array = NDArray[np.float64]

_LARGEST_RELATIVE = 0.5  # standard error over value beyond which a parameter is not identified
_SINGULAR = 1e-10  # eigenvalues this small against the largest are none
_NOT_SEEN = 100.0  # standard error over value beyond which the number itself says nothing
_STRONG = 0.9  # correlation worth naming
_AT_BOUND = 1e-6


def covariance(fit: TorqueFit) -> Array:
    """(p, p) covariance of the coordinates, valid for coloured residuals.

    The passive rows' noise is correlated in time, by the smoothing filter among others, so the plain inverse of the
    normal matrix is too small: scores are summed over lags up to the filter's reach (Newey and West 1987).
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
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    silent = values <= _SINGULAR * values[-1]
    inverse = scale[:, None] * ((vectors[:, ~silent] / values[~silent]) @ vectors[:, ~silent].T) * scale
    # What the recordings do not respond to at all is not known at all, rather than known exactly.
    unknown = scale[:, None] * (vectors[:, silent] @ vectors[:, silent].T) * scale
    result: Array = inverse @ spread @ inverse + unknown / _SINGULAR
    return result


def _long_run(scores: Array, lags: int) -> Array:
    total = scores.T @ scores
    for lag in range(1, lags + 1):
        weight = 1 - lag / (lags + 1)
        cross = scores[lag:].T @ scores[:-lag]
        total = total + weight * (cross + cross.T)
    return np.asarray(total)


def to_physical(parametrisation: Parametrisation, x: Array, coordinates: Array) -> Array:
    """(p, p) covariance of the physical parameters from that of the coordinates."""
    value = parametrisation.physical(x)
    columns = []
    for k in range(x.size):
        step = 1e-6 * max(abs(x[k]), 1e-3)
        moved = x.copy()
        moved[k] += step
        columns.append((parametrisation.physical(moved) - value) / step)
    slope = np.stack(columns, axis=1)
    result: Array = slope @ coordinates @ slope.T
    return result


def estimates(parametrisation: Parametrisation, fit: TorqueFit, physical: Array) -> tuple[Estimate, ...]:
    """Every coordinate's parameter with its standard error and whether the data determine it.

    Args:
        parametrisation: what was identified.
        fit: the minimum found.
        physical: (p, p) covariance of the physical parameters.
    """
    values = parametrisation.physical(fit.x)
    std = np.sqrt(np.maximum(np.diag(physical), 0))
    correlation = physical / np.maximum(np.outer(std, std), 1e-300)
    visible = _seen(fit)
    result = []
    for k, coordinate in enumerate(parametrisation.coordinates):
        reason = _reason(k, parametrisation, fit, values, std, correlation, visible)
        known = bool(np.isfinite(std[k])) and visible[k]
        result.append(
            Estimate(
                coordinate.name, float(values[k]), float(std[k]) if known else None, coordinate.unit, not reason, reason
            )
        )
    return tuple(result)


def _seen(fit: TorqueFit) -> NDArray[np.bool_]:
    """(p,) whether a coordinate has any part in the directions the residuals respond to."""
    normal = sum(np.einsum("srp,srq->pq", jacobian, jacobian) for jacobian in fit.jacobians)
    normal = np.asarray(normal) + fit.frequency_jacobian.T @ fit.frequency_jacobian
    size = np.sqrt(np.maximum(np.diag(normal), 0))
    return size > _SINGULAR * max(float(size.max()), 1e-300)


def _reason(
    k: int,
    parametrisation: Parametrisation,
    fit: TorqueFit,
    values: Array,
    std: Array,
    correlation: Array,
    visible: NDArray[np.bool_],
) -> str:
    """Why parameter k is not determined by the data; empty if it is."""
    coordinate: Coordinate = parametrisation.coordinates[k]
    if not visible[k]:
        return "the recordings do not respond to it"
    lower, upper = parametrisation.bounds
    if fit.x[k] - lower[k] < _AT_BOUND or upper[k] - fit.x[k] < _AT_BOUND:
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
