"""Natural frequencies of a clamped link of linear thickness, in closed form: the answer to simulations of a taper."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import iv, jv, kv, yv

Array = NDArray[np.float64]


def wedge_pulsations(length: float, mass: float, stiffness: float, taper: float, count: int) -> Array:
    """The first pulsations, rad/s, (count,), of a cantilever of thickness 1 + taper (1/2 - s/length), times the mean.

    With x counted from the wedge's apex, (x^3 y'')'' = k^2 x y, whose solutions are x^(-1/2) times Bessel functions of
    order one of 2 (k x)^(1/2) (Kirchhoff 1879; Mabie and Rogers 1964). Positive tapers only.

    Args:
        length: of the link, m.
        mass: of the link, kg.
        stiffness: at the mean thickness, N m^2.
        taper: of the thickness, between 0 and 2.
        count: of pulsations.
    """
    root, tip = (1.0 / taper + 0.5) * length, (1.0 / taper - 0.5) * length

    def determinant(pulsation: float) -> float:
        k = pulsation * np.sqrt(mass / length / stiffness) * length / taper
        here, there = 2.0 * np.sqrt(k * root), 2.0 * np.sqrt(k * tip)
        # Place and slope at the root, moment and shear at the tip, each over its own power of x.
        rows = [[jv(1, here), yv(1, here), iv(1, here), kv(1, here)]]
        rows.append([-jv(2, here), -yv(2, here), iv(2, here), -kv(2, here)])
        rows.append([jv(3, there), yv(3, there), iv(3, there), kv(3, there)])
        rows.append([jv(2, there), yv(2, there), iv(2, there), -kv(2, there)])
        matrix = np.array(rows)
        return float(np.linalg.det(matrix / np.abs(matrix).max(axis=0)))

    unit = np.sqrt(stiffness / mass / length**3)
    trials = unit * np.arange(0.5, 20.0 * count**2, 0.25)
    values = np.array([determinant(trial) for trial in trials])
    edges = np.flatnonzero(values[:-1] * values[1:] < 0.0)[:count]
    return np.array([brentq(determinant, trials[k], trials[k + 1], xtol=1e-12) for k in edges])
