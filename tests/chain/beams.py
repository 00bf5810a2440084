"""Uniform beams, as chains and as Euler and Bernoulli have them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from vjm.chain.layout import layout, uniform_chain
from vjm.chain.virtual_links import Chain, Distal
from vjm.records import Link

Array = NDArray[np.float64]


def beam_chain(
    n: int,
    name: str = "end-corrected",
    *,
    joint: Literal["revolute", "clamped"] = "clamped",
    length: float = 1.0,
    mass: float = 1.0,
    bending_stiffness: float = 1.0,
    hub_inertia: float = 0.0,
    payload: float = 0.0,
    kelvin_voigt: float = 0.0,
    gravity: tuple[float, float] = (0.0, 0.0),
    distal: Distal = "free",
) -> Chain:
    """A uniform beam of n virtual joints; in units of its length, mass and stiffness unless given."""
    hub_inertia = hub_inertia if joint == "revolute" else 0.0
    link = Link("beam", joint, length, mass, bending_stiffness, (length,), hub_inertia=hub_inertia, payload=payload)
    cuts = layout(length, n, name, distal)
    return Chain("arm", (uniform_chain(link, cuts, kelvin_voigt=kelvin_voigt),), gravity)


def roots(function: Callable[[float], float], most: float, count: int) -> Array:
    """The first sign changes of a function of z on (0.3, most)."""
    grid = np.linspace(0.3, most, 2000)
    signs = np.sign([function(z) for z in grid])
    starts = np.flatnonzero(signs[1:] != signs[:-1])[:count]
    return np.array([brentq(function, grid[i], grid[i + 1], xtol=1e-14, rtol=1e-14) for i in starts])


def clamped_frequencies(count: int, payload: float = 0.0, rotary_inertia: float = 0.0) -> Array:
    """Hz, of a clamped beam of unit length, mass and stiffness with a body on the tip.

    w = A (cosh zx - cos zx) + B (sinh zx - sin zx) satisfies w(0) = w'(0) = 0 and w'''' = z^4 w, omega = z^2. On the
    tip w'' = j omega^2 w' and w''' = -p omega^2 w. The determinant of the two conditions, divided by 2 z^5 cosh z, is
    cos z + 1 / cosh z + p z (cos z tanh z - sin z) - j z^3 (cos z tanh z + sin z) + p j z^4 (1 / cosh z - cos z).
    """

    def determinant(z: float) -> float:
        cos, sin, tanh, inverse = np.cos(z), np.sin(z), np.tanh(z), 1 / np.cosh(z)
        mass, inertia = payload * z, rotary_inertia * z**3
        bent = cos + inverse + mass * (cos * tanh - sin) - inertia * (cos * tanh + sin)
        return float(bent + mass * inertia * (inverse - cos))

    return roots(determinant, 4.0 * count, count) ** 2 / (2 * np.pi)


def hub_frequencies(count: int, hub_inertia: float) -> Array:
    """Hz, of a beam of unit length, mass and stiffness on a hub free to turn.

    The whole displacement w(x) has w(0) = 0, and its slope there is the hub's angle: the root's moment turns the hub,
    w''(0) = -H omega^2 w'(0). So w = A (cosh zx - cos zx) + B sinh zx + C sin zx, omega = z^2, with
    2 A = -H z^3 (B + C). On the free end w'' = w''' = 0:

        A (cosh z + cos z) + B sinh z - C sin z = 0,
        A (sinh z - sin z) + B cosh z - C cos z = 0.
    """

    def determinant(z: float) -> float:
        hub = -hub_inertia * z**3 / 2
        bent, sheared = hub * (np.cosh(z) + np.cos(z)), hub * (np.sinh(z) - np.sin(z))
        matrix = [[bent + np.sinh(z), bent - np.sin(z)], [sheared + np.cosh(z), sheared - np.cos(z)]]
        return float(np.linalg.det(np.array(matrix) / np.cosh(z)))

    return roots(determinant, 4.0 * count + 2, count) ** 2 / (2 * np.pi)
