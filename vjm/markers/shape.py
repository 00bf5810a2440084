"""How many shape functions the markers support, and how many markers the modes need (eq. 1)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from vjm.errors import ChoiceError, ShapeError
from vjm.records import Array

FamilyName = Literal["polynomial", "clamped-polynomial", "trigonometric", "cantilever"]
FAMILIES: tuple[str, ...] = get_args(FamilyName)


def basis(family: str, order: int, x: ArrayLike, length: float, derivative: int = 0) -> Array:
    """Basis functions Y_1 .. Y_order, or one of their derivatives by x.

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


def _polynomial(x: Array, orders: NDArray[np.intp], derivative: int) -> Array:
    return _powers(x, orders, derivative)


def _clamped_polynomial(x: Array, orders: NDArray[np.intp], derivative: int) -> Array:
    return _powers(x, orders + 1, derivative)


def _trigonometric(x: Array, orders: NDArray[np.intp], derivative: int) -> Array:
    k = (2 * orders - 1) * np.pi / 2
    if derivative == 0:
        return 1 - np.cos(k * x)
    return k * np.sin(k * x) if derivative == 1 else k**2 * np.cos(k * x)


def cantilever_roots(count: int) -> Array:
    """(count,) roots beta l of 1 + cos(z) cosh(z) = 0, smallest first."""
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
    "polynomial": _polynomial,
    "clamped-polynomial": _clamped_polynomial,
    "trigonometric": _trigonometric,
    "cantilever": _cantilever,
}


_HUBER = 2.5  # residuals beyond this many sigma lose weight in the robust fit
_ROBUST_PASSES = 8
_MAD_TO_SIGMA = 1.4826
_CHUNK = 50_000  # frames a batch, bounds the memory


@dataclass(frozen=True)
class ShapeFit:
    """A shape function y(x, t) = sum_o a_o(t) Y_o(x).

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
        """(T, p) shape, slope or second derivative at p places [m, -, 1/m]; x is (p,) or (T, p) [m]."""
        functions = basis(self.family, self.order, x, self.length, derivative)
        values: Array = np.einsum("...po,...o->...p", functions, self.coefficients)
        return values

    def velocity(self, x: ArrayLike, rates: ArrayLike) -> Array:
        """(T, p) lateral velocity v(x, t) [m/s] from the coefficients' rates (T, order) [m/s]."""
        functions = basis(self.family, self.order, x, self.length)
        values: Array = np.einsum("...po,...o->...p", functions, np.asarray(rates, dtype=float))
        return values

    @property
    def marker_rms(self) -> Array:
        """(k,) root mean square residual of each marker [m]."""
        with np.errstate(invalid="ignore"):
            result: Array = np.sqrt(np.nanmean(self.residuals**2, axis=0))
        return result


def fit_shape(
    x: ArrayLike,
    y: ArrayLike,
    length: float,
    family: str = "cantilever",
    order: int = 1,
    weights: ArrayLike | None = None,
    robust: bool = False,
) -> ShapeFit:
    """Fit shape functions to markers in the link frame.

    Args:
        x: (k,) arc lengths, or (T, k) measured positions along the link [m].
        y: (T, k) lateral positions [m]; NaN where a marker is missing.
        length: l of the link [m].
        family: see `vjm.shape.families.basis`.
        order: number of functions.
        weights: (k,) inverse variances, relative to each other; equal when None.
        robust: Huber weights, so that single wild markers do not bend the curve.

    Raises:
        ShapeError: arrays that do not fit together, or fewer markers than functions.
        ChoiceError: unknown family.
    """
    lateral = np.asarray(y, dtype=float)
    along = np.asarray(x, dtype=float)
    k = lateral.shape[-1]
    if lateral.ndim != 2 or along.shape not in ((k,), lateral.shape):
        raise ShapeError("x, y", (along.shape, lateral.shape), "y (T, k) and x (k,) or (T, k)")
    if not 1 <= order <= k:
        raise ShapeError("order", order, f"1 to the number of markers, {k}")
    weight = np.ones(k) if weights is None else np.asarray(weights, dtype=float)
    if weight.shape != (k,) or not (weight > 0).all():
        raise ShapeError("weights", weight.tolist(), f"{k} positive numbers")
    functions = basis(family, order, along if along.ndim == 1 else np.zeros(k), length)
    solve = _solve_fixed if along.ndim == 1 and not robust else _solve_varying
    coefficients = np.concatenate(
        [
            solve(family, order, length, along if along.ndim == 1 else along[rows], lateral[rows], weight, robust)
            for rows in _chunks(len(lateral))
        ]
        or [np.empty((0, order))]
    )
    fitted = ShapeFit(family, order, length, coefficients, np.empty((0, 0)), np.empty((0, 0)))
    if along.ndim == 2:
        functions = basis(family, order, np.nanmedian(along, axis=0), length)
    inverse = np.linalg.pinv(np.sqrt(weight)[:, None] * functions) * np.sqrt(weight)
    return ShapeFit(family, order, length, coefficients, inverse @ inverse.T, lateral - fitted.evaluate(along))


def _chunks(count: int) -> list[slice]:
    return [slice(start, start + _CHUNK) for start in range(0, count, _CHUNK)]


def _solve_fixed(family: str, order: int, length: float, x: Array, y: Array, weight: Array, _robust: bool) -> Array:
    """Markers at fixed places: one pseudo-inverse for each pattern of missing markers."""
    functions = basis(family, order, x, length)
    known = np.isfinite(y)
    result = np.full((len(y), order), np.nan)
    patterns, which = np.unique(known, axis=0, return_inverse=True)
    for p, pattern in enumerate(patterns):
        if pattern.sum() < order:
            continue
        root = np.sqrt(weight[pattern])
        inverse = np.linalg.pinv(root[:, None] * functions[pattern]) * root
        rows = which.ravel() == p
        result[rows] = y[rows][:, pattern] @ inverse.T
    return result


def _solve_varying(family: str, order: int, length: float, x: Array, y: Array, weight: Array, robust: bool) -> Array:
    """Markers at measured places, or robust: normal equations of every frame in one batch."""
    places = np.broadcast_to(x, y.shape)
    known = np.isfinite(y) & np.isfinite(places)
    functions = basis(family, order, np.where(known, places, 0.0), length)
    values = np.where(known, y, 0.0)
    result = np.full((len(y), order), np.nan)
    usable = known.sum(axis=1) >= order
    functions, values, base = functions[usable], values[usable], np.where(known, weight, 0.0)[usable]
    solution = _normal_equations(functions, values, base)
    for _ in range(_ROBUST_PASSES if robust and len(solution) else 0):
        residual = np.abs(values - np.einsum("tko,to->tk", functions, solution)) * np.sqrt(weight)
        scale = _MAD_TO_SIGMA * float(np.median(residual[base > 0]))
        trust = np.minimum(1.0, _HUBER * max(scale, 1e-300) / np.maximum(residual, 1e-300))
        doubted = ((trust < 1) & (base > 0)).any(axis=1)  # the others' solution is the plain one
        if not doubted.any():
            break
        solution[doubted] = _normal_equations(functions[doubted], values[doubted], (base * trust)[doubted])
    result[usable] = solution
    return result


def _normal_equations(functions: Array, values: Array, weight: Array) -> Array:
    """Weighted least squares of a batch by QR-free normal equations of scaled columns."""
    scaled = np.sqrt(weight)[..., None] * functions
    gram = np.einsum("tko,tkp->top", scaled, scaled)
    right = np.einsum("tko,tk->to", scaled, np.sqrt(weight) * values)
    solution: Array = np.einsum("top,tp->to", np.linalg.pinv(gram, rcond=1e-13, hermitian=True), right)
    return solution


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
