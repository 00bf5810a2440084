"""Least-squares fit of a link shape function to markers, all frames at once (eqs. 3-7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.errors import ShapeError
from vjm.shape.families import basis

Array = NDArray[np.float64]

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
