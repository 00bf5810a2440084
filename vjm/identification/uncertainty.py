"""Standard errors, and in words which parameters the data determine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vjm.identification.information import Information
from vjm.identification.parametrisation import Coordinate, Parametrisation
from vjm.parameters import Estimate

Array = NDArray[np.float64]

_LARGEST_RELATIVE = 0.5  # standard error over value beyond which a parameter is not identified
_SINGULAR = 1e-10  # eigenvalues this small against the largest are none
_NOT_SEEN = 100.0  # standard error over value beyond which the number itself says nothing
_STRONG = 0.9  # correlation worth naming
_AT_BOUND = 1e-6


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
        known = bool(np.isfinite(std[k])) and visible[k]
        result.append(
            Estimate(
                coordinate.name, float(values[k]), float(std[k]) if known else None, coordinate.unit, not reason, reason
            )
        )
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
    lower, upper = parametrisation.bounds
    if x[k] - lower[k] < _AT_BOUND or upper[k] - x[k] < _AT_BOUND:
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
