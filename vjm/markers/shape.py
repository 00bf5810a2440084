"""Shape functions of a link fitted to markers (eqs. 1-7)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from vjm.errors import ChoiceError, ShapeError
from vjm.records import Array

FamilyName = Literal["polynomial", "clamped-polynomial", "trigonometric", "cantilever"]
FAMILIES: tuple[str, ...] = get_args(FamilyName)
BoolArray = NDArray[np.bool_]


def basis(family: str, order: int, x: ArrayLike, length: float, derivative: int = 0) -> Array:
    """Return the basis functions Y_1 .. Y_order, or one of their derivatives by x.

    Args:
        family: `polynomial`, x^1 .. x^order as in the paper's eq. (2); `clamped-polynomial`, x^2 .. x^(order + 1), with
            no slope at the clamp; `trigonometric`, 1 - cos((2 o - 1) pi x / 2 l); `cantilever`, the modes of a
            clamped-free beam.
        order: number of functions, at least 1.
        x: (...) places along the link [m].
        length: l of the link [m].
        derivative: 0, 1 or 2.

    Returns:
        (..., order), scaled so that each function is of order one at the tip [m^-derivative].

    Raises:
        ChoiceError: unknown family.
        ShapeError: order below 1, or derivative above 2.
    """
    if family not in _FUNCTIONS:
        raise ChoiceError("shape family", family, FAMILIES)
    if order < 1 or derivative not in (0, 1, 2):
        raise ShapeError("order, derivative", (order, derivative), "order at least 1, derivative 0, 1 or 2")
    scaled = np.asarray(x, dtype=float)[..., None] / length
    return _FUNCTIONS[family](scaled, np.arange(1, order + 1), derivative) / length**derivative


def _powers(x: Array, exponents: NDArray[np.intp], derivative: int) -> Array:
    factor = np.ones(exponents.size)
    for k in range(derivative):
        factor = factor * (exponents - k)
    result: Array = factor * x ** np.maximum(exponents - derivative, 0)
    return result


def _trigonometric(x: Array, orders: NDArray[np.intp], derivative: int) -> Array:
    k = (2 * orders - 1) * np.pi / 2
    if derivative == 0:
        return 1 - np.cos(k * x)
    return k * np.sin(k * x) if derivative == 1 else k**2 * np.cos(k * x)


def cantilever_roots(count: int) -> Array:
    """Return the (count,) roots beta l of 1 + cos(z) cosh(z) = 0, smallest first."""
    centers = (np.arange(1, count + 1) - 0.5) * np.pi
    # Divided by cosh, the equation keeps its roots and stays of order one.
    return np.array([brentq(lambda z: np.cos(z) + 1 / np.cosh(z), c - 0.4, c + 0.4, xtol=1e-14) for c in centers])


def _cantilever(x: Array, orders: NDArray[np.intp], derivative: int) -> Array:
    beta = cantilever_roots(orders.size)
    decay, grow = np.exp(-beta), np.exp(beta * (x - 1))
    # sigma = (cosh + cos) / (sinh + sin); cosh - sigma sinh written without the difference of huge numbers
    denominator = 1 - decay**2 + 2 * decay * np.sin(beta)
    sigma = (1 + decay**2 + 2 * decay * np.cos(beta)) / denominator
    rising = (np.sin(beta) - np.cos(beta) - decay) / denominator * grow
    falling = (1 + sigma) / 2 * np.exp(-beta * x)
    cosine, sine = np.cos(beta * x), np.sin(beta * x)
    if derivative == 0:
        values = rising + falling - cosine + sigma * sine
    elif derivative == 1:
        values = beta * (rising - falling + sine + sigma * cosine)
    else:
        values = beta**2 * (rising + falling + cosine - sigma * sine)
    result: Array = values / 2  # a mode of unit modal mass is two at the tip
    return result


_FUNCTIONS: dict[str, Callable[[Array, NDArray[np.intp], int], Array]] = {
    "polynomial": _powers,
    "clamped-polynomial": lambda x, orders, derivative: _powers(x, orders + 1, derivative),
    "trigonometric": _trigonometric,
    "cantilever": _cantilever,
}


_CHUNK = 50_000  # frames a batch, bounds the memory
_HUBER = 2.5  # standard deviations beyond which residuals lose weight in the robust fit; few of Gaussian noise are
_ROBUST_PASSES = 8  # most reweightings; frames settle in two to five


@dataclass(frozen=True)
class ShapeFit:
    """Shape function y(x, t) = sum_o a_o(t) Y_o(x).

    Attributes:
        family: of the basis functions.
        order: number of them.
        length: l of the link [m].
        coefficients: (T, order) a_o [m]; NaN for frames with too few markers.
        covariance: (order, order) of a frame with all markers, per unit variance of a marker coordinate.
        residuals: (T, k) measured less fitted [m]; NaN where a marker is missing.
    """

    family: str
    order: int
    length: float
    coefficients: Array
    covariance: Array
    residuals: Array

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
        order: number of functions.
        robust: Huber weights, so that single wild markers do not bend the curve.

    Raises:
        ShapeError: arrays that do not fit together, or fewer markers than functions.
        ChoiceError: unknown family.
    """
    lateral, along = np.asarray(y, dtype=float), np.asarray(x, dtype=float)
    k = lateral.shape[-1]
    if lateral.ndim != 2 or along.shape not in ((k,), lateral.shape):
        raise ShapeError("x, y", (along.shape, lateral.shape), "y (T, k) and x (k,) or (T, k)")
    if not 1 <= order <= k:
        raise ShapeError("order", order, f"1 to the number of markers, {k}")
    known = np.isfinite(lateral) & np.isfinite(along)
    typical = basis(family, order, along if along.ndim == 1 else np.nanmedian(along, axis=0), length)
    coefficients = np.full((len(lateral), order), np.nan)
    for first in range(0, len(lateral), _CHUNK):
        rows = slice(first, first + _CHUNK)
        if along.ndim == 1 and not robust:
            coefficients[rows] = _solve_fixed(typical, lateral[rows], known[rows])
            continue
        functions = typical
        if along.ndim == 2:
            functions = basis(family, order, np.where(known[rows], along[rows], 0.0), length)
        coefficients[rows] = _solve_varying(functions, lateral[rows], known[rows], robust)
    inverse = np.linalg.pinv(typical)
    fitted = ShapeFit(family, order, length, coefficients, inverse @ inverse.T, np.empty((0, 0)))
    return replace(fitted, residuals=lateral - fitted.evaluate(along))


def _solve_fixed(functions: Array, lateral: Array, known: BoolArray) -> Array:
    """Markers at fixed places: one pseudo-inverse for each pattern of missing markers."""
    order = functions.shape[-1]
    coefficients = np.full((len(lateral), order), np.nan)
    patterns, which = np.unique(known, axis=0, return_inverse=True)
    for p, pattern in enumerate(patterns):
        if pattern.sum() >= order:
            rows = which.ravel() == p
            coefficients[rows] = lateral[rows][:, pattern] @ np.linalg.pinv(functions[pattern]).T
    return coefficients


def _solve_varying(functions: Array, lateral: Array, known: BoolArray, robust: bool) -> Array:
    """Markers at measured places, or robust: normal equations of every frame in one batch."""
    order = functions.shape[-1]
    coefficients = np.full((len(lateral), order), np.nan)
    usable = known.sum(axis=1) >= order
    functions, known = np.broadcast_to(functions, (*known.shape, order))[usable], known[usable]
    values, weight = np.where(known, lateral[usable], 0.0), known.astype(float)
    solution = _solve_normal_equations(functions, values, weight)
    for _ in range(_ROBUST_PASSES if robust and len(solution) else 0):
        residual = np.abs(values - np.einsum("tko,to->tk", functions, solution))
        scale = 1.4826 * float(np.median(residual[known]))  # standard deviation of Gaussian noise of that median
        trust = np.minimum(1.0, _HUBER * max(scale, 1e-300) / np.maximum(residual, 1e-300))
        doubted = ((trust < 1) & known).any(axis=1)  # the others' solution is the plain one
        if not doubted.any():
            break
        solution[doubted] = _solve_normal_equations(functions[doubted], values[doubted], (weight * trust)[doubted])
    coefficients[usable] = solution
    return coefficients


def _solve_normal_equations(functions: Array, values: Array, weight: Array) -> Array:
    """Weighted least squares (T, order) of a batch."""
    scaled = np.sqrt(weight)[..., None] * functions
    normal = np.einsum("tko,tkp->top", scaled, scaled)
    right = np.einsum("tko,tk->to", scaled, np.sqrt(weight) * values)
    return np.asarray(np.einsum("top,tp->to", np.linalg.pinv(normal, rcond=1e-13, hermitian=True), right))


def required_markers(modes: int) -> int:
    """Return the least number of markers k >= 2 l / lambda_min (eq. 1) that shows the first bending modes.

    lambda_min is the wavelength of the highest of them on a clamped link, 2 pi l / (beta l): the length cancels.
    """
    return int(np.ceil(float(cantilever_roots(modes)[-1]) / np.pi))


def visible_modes(markers: int) -> int:
    """Return the number of bending modes that `markers` markers can tell apart (eq. 1)."""
    count = 1
    while required_markers(count + 1) <= markers and count < markers:
        count += 1
    return count


def choose_order(x: ArrayLike, y: ArrayLike, length: float, family: str = "cantilever") -> int:
    """Return the number of shape functions, at most k - 1, that predicts left-out markers best (cross-validation).

    Args:
        x: (k,) arc lengths of the markers [m].
        y: (T, k) lateral positions [m]; frames with missing markers are left out.
        length: l of the link [m].
        family: of the shape functions.
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
