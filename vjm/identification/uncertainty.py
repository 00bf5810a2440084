"""Standard errors, and in words which parameters the data determine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.identification.information import Information
from vjm.identification.parametrisation import Coordinate, Parametrisation
from vjm.modes import modes
from vjm.parameters import Estimate

Array = NDArray[np.float64]

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
