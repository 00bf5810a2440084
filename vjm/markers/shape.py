"""Shape functions of a link fitted to markers (eqs. 1-7).

Eq. (1) asks for k >= 2 l / lambda_min markers. With lambda = 2 pi l / (beta l) the wavelength of a clamped link's mode,
that is k >= beta l / pi, which is m - 1/2 for mode m and a little more: as many markers as modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from vjm.records import Array, Indices, Mask

FamilyName = Literal["polynomial", "clamped-polynomial", "trigonometric", "cantilever"]
FAMILIES: tuple[str, ...] = get_args(FamilyName)


def basis(family: str, order: int, x: ArrayLike, length: float, derivative: int = 0) -> Array:
    """Return the basis functions Y_1 .. Y_order (..., order), or a derivative of theirs by x [m^-derivative].

    They are scaled so that each is of order one at the tip.

    Args:
        family: `polynomial`, x^1 .. x^order as in the paper's eq. (2); `clamped-polynomial`, x^2 .. x^(order + 1), with
            no slope at the clamp; `trigonometric`, 1 - cos((2 o - 1) pi x / 2 l); `cantilever`, the modes of a
            clamped-free beam.
        order: number of functions, at least 1.
        x: (...) places along the link [m].
        length: l of the link [m].
        derivative: 0, 1 or 2.
    """
    scaled = np.asarray(x, dtype=float)[..., None] / length
    return _FUNCTIONS[family](scaled, np.arange(1, order + 1), derivative) / length**derivative


def _powers(x: Array, exponents: Indices, derivative: int) -> Array:
    factor = np.ones(exponents.size)
    for k in range(derivative):
        factor = factor * (exponents - k)
    result: Array = factor * x ** np.maximum(exponents - derivative, 0)
    return result


def _trigonometric(x: Array, orders: Indices, derivative: int) -> Array:
    k = (2 * orders - 1) * np.pi / 2
    result: Array = (derivative == 0) - k**derivative * np.cos(k * x + derivative * np.pi / 2)
    return result


def _cantilever_roots(count: int) -> Array:
    """Return the (count,) roots beta l of 1 + cos(z) cosh(z) = 0, smallest first."""
    centers = (np.arange(1, count + 1) - 0.5) * np.pi
    # Divided by cosh, the equation keeps its roots and stays of order one.
    return np.array([brentq(lambda z: np.cos(z) + 1 / np.cosh(z), c - 0.4, c + 0.4, xtol=1e-14) for c in centers])


def _cantilever(x: Array, orders: Indices, derivative: int) -> Array:
    beta = _cantilever_roots(orders.size)
    decay, grow = np.exp(-beta), np.exp(beta * (x - 1))
    # sigma = (cosh + cos) / (sinh + sin); cosh - sigma sinh written without the difference of huge numbers
    denominator = 1 - decay**2 + 2 * decay * np.sin(beta)
    sigma = (1 + decay**2 + 2 * decay * np.cos(beta)) / denominator
    rising = (np.sin(beta) - np.cos(beta) - decay) / denominator * grow
    falling = (-1) ** derivative * (1 + sigma) / 2 * np.exp(-beta * x)
    angle = beta * x + derivative * np.pi / 2  # a derivative of a sine or cosine leads by a quarter period
    values = rising + falling - np.cos(angle) + sigma * np.sin(angle)
    result: Array = beta**derivative * values / 2  # a mode of unit modal mass is two at the tip
    return result


_FUNCTIONS: dict[str, Callable[[Array, Indices, int], Array]] = {
    "polynomial": _powers,
    "clamped-polynomial": lambda x, orders, derivative: _powers(x, orders + 1, derivative),
    "trigonometric": _trigonometric,
    "cantilever": _cantilever,
}


_HUBER = 2.5  # standard deviations beyond which residuals lose weight in the robust fit; few of Gaussian noise are
_ROBUST_PASSES = 8  # most reweightings; frames settle in two to five


@dataclass(frozen=True)
class ShapeFit:
    """Shape function y(x, t) = sum_o a_o(t) Y_o(x)."""

    family: str  # of the basis functions
    order: int  # number of them
    length: float  # l of the link [m]
    coefficients: Array  # (T, order) a_o [m]; NaN for frames with too few markers
    covariance: Array  # (order, order) of a frame with all markers, per unit variance of a marker coordinate
    residuals: Array  # (T, k) measured less fitted [m]; NaN where a marker is missing

    def evaluate(self, x: ArrayLike, derivative: int = 0) -> Array:
        """Return (T, p) shape, slope or second derivative [m, -, 1/m] at p places (p,) or (T, p) [m]."""
        functions = basis(self.family, self.order, x, self.length, derivative)
        return np.asarray(np.einsum("...po,...o->...p", functions, self.coefficients))


def fit_shape(
    x: ArrayLike, y: ArrayLike, length: float, family: str = "cantilever", order: int = 1, robust: bool = False
) -> ShapeFit:
    """Fit shape functions to markers in the link frame by least squares.

    Args:
        x: (k,) arc lengths, or (T, k) measured positions along the link [m].
        y: (T, k) lateral positions [m]; NaN where a marker is missing.
        length: l of the link [m].
        family: see `basis`.
        order: number of functions, no more than there are markers.
        robust: Huber weights, so that single wild markers do not bend the curve.
    """
    lateral, axial = np.asarray(y, dtype=float), np.asarray(x, dtype=float)
    known = np.isfinite(lateral) & np.isfinite(axial)
    functions = typical = basis(family, order, axial if axial.ndim == 1 else np.nanmedian(axial, axis=0), length)
    if axial.ndim == 2:
        functions = basis(family, order, np.where(known, axial, 0.0), length)
    coefficients = np.full((len(lateral), order), np.nan)
    usable = known.sum(axis=1) >= order
    functions = np.broadcast_to(functions, (*known.shape, order))[usable]
    coefficients[usable] = _solve(functions, lateral[usable], known[usable], robust)
    inverse = np.linalg.pinv(typical)
    fit = ShapeFit(family, order, length, coefficients, inverse @ inverse.T, np.empty((0, 0)))
    return replace(fit, residuals=lateral - fit.evaluate(axial))


def _solve(functions: Array, lateral: Array, known: Mask, robust: bool) -> Array:
    """Return the coefficients (T, order) for functions (T, k, order), with Huber weights if `robust`."""
    values, weight = np.where(known, lateral, 0.0), known.astype(float)
    solution = _weighted_least_squares(functions, values, weight)
    for _ in range(_ROBUST_PASSES if robust and len(solution) else 0):
        residual = np.abs(values - np.einsum("tko,to->tk", functions, solution))
        scale = 1.4826 * float(np.median(residual[known]))  # standard deviation of Gaussian noise of that median
        huber_weight = np.minimum(1.0, _HUBER * max(scale, 1e-300) / np.maximum(residual, 1e-300))
        reweighted = ((huber_weight < 1) & known).any(axis=1)  # the others' solution is the plain one
        if not reweighted.any():
            break
        solution[reweighted] = _weighted_least_squares(
            functions[reweighted], values[reweighted], (weight * huber_weight)[reweighted]
        )
    return solution


def _weighted_least_squares(functions: Array, values: Array, weight: Array) -> Array:
    root = np.sqrt(weight)
    return np.asarray(np.einsum("tok,tk->to", np.linalg.pinv(root[..., None] * functions), root * values))


def choose_order(x: ArrayLike, y: ArrayLike, length: float, family: str = "cantilever") -> int:
    """Return the number of shape functions, at most k - 1, that predicts left-out markers best (cross-validation).

    Markers are at arc lengths x (k,) [m]; frames of their lateral positions y (T, k) [m] that miss some are left out.
    """
    places, lateral = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    complete = lateral[np.isfinite(lateral).all(axis=1)]
    if len(complete) == 0 or places.size == 1:
        return 1
    errors = []
    for order in range(1, places.size):
        functions = basis(family, order, places, length)
        leverage = np.diag(functions @ np.linalg.pinv(functions))
        residual = fit_shape(places, complete, length, family, order).residuals
        errors.append(np.sqrt(np.mean((residual / np.maximum(1 - leverage, 1e-9)) ** 2)))
    return int(np.argmin(errors)) + 1
