"""How many shape functions the markers support, and how many markers the modes need (eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.shape.families import basis, cantilever_roots
from vjm.shape.fit import fit_shape

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OrderChoice:
    """Cross-validated number of shape functions.

    Attributes:
        order: the number chosen.
        errors: (o_max,) root mean square error of predicting a left-out marker [m], for 1 .. o_max functions; NaN
            where leaving one out leaves too few.
    """

    order: int
    errors: Array


def required_markers(length: float, modes: int) -> int:
    """Least number of markers k >= 2 l / lambda_min (eq. 1) to see the first `modes` bending modes.

    lambda_min is the wavelength of the highest of them on a clamped link, 2 pi l / (beta l).
    """
    shortest = 2 * np.pi * length / float(cantilever_roots(modes)[-1])
    return int(np.ceil(2 * length / shortest))


def visible_modes(markers: int) -> int:
    """Number of bending modes that `markers` markers can tell apart (eq. 1 turned round)."""
    count = 1
    while required_markers(1.0, count + 1) <= markers and count < markers:
        count += 1
    return count


def choose_order(x: ArrayLike, y: ArrayLike, length: float, family: str = "cantilever") -> OrderChoice:
    """Number of shape functions by leave-one-marker-out cross-validation, bounded by o_max = k - 1 (k = 1: one).

    Args:
        x: (k,) arc lengths of the markers [m].
        y: (T, k) lateral positions [m]; frames with missing markers are left out.
        length: l of the link [m].
        family: of the shape functions.
    """
    places, lateral = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    complete = lateral[np.isfinite(lateral).all(axis=1)]
    k = places.size
    errors = np.full(max(k - 1, 1), np.nan)
    if len(complete) == 0 or k == 1:
        return OrderChoice(1, errors)
    for order in range(1, k):
        functions = basis(family, order, places, length)
        hat = functions @ np.linalg.pinv(functions)
        residual = fit_shape(places, complete, length, family, order).residuals
        errors[order - 1] = np.sqrt(np.mean((residual / np.maximum(1 - np.diag(hat), 1e-9)) ** 2))
    return OrderChoice(int(np.nanargmin(errors)) + 1, errors)
