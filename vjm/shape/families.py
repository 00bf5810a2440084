"""Families of link shape functions: y(x) = sum_o a_o Y_o(x / l), o = 1 .. order (eq. 2)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from vjm.errors import ChoiceError, ShapeError

Array = NDArray[np.float64]
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
