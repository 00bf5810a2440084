"""Matrix exponentials and phi functions: linear motion under forcing that is a polynomial in time, exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_NORM = 0.5  # to which matrices are halved before their power series
_COEFFICIENTS = 1 / np.cumprod(np.arange(1.0, 12.0))[2:]  # 1 / (k + 3)!


def phi_functions(W: Array) -> tuple[Array, Array, Array, Array]:
    """exp, phi_1, phi_2, phi_3 of matrices W (K, m, m): power series of halved matrices, then doubling.

    phi_k(z) = (phi_{k-1}(z) - 1 / (k - 1)!) / z with phi_0 = exp (Hochbruck and Ostermann 2010).
    """
    norm = float(np.abs(W).sum(axis=2).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / _NORM))))
    X = W / 2.0**halvings
    X2 = X @ X
    one, X3 = np.eye(W.shape[-1]), X2 @ X
    phi3 = _series(one, X, X2, X3)
    phi2 = one / 2 + X @ phi3
    phi1 = one + X @ phi2
    flow = one + X @ phi1
    for _ in range(halvings):
        phi3 = (flow @ phi3 + phi1 / 2 + phi2 + phi3) / 8
        phi2 = (flow @ phi2 + phi1 + phi2) / 4
        phi1 = (flow @ phi1 + phi1) / 2
        flow = flow @ flow
    return flow, phi1, phi2, phi3


def _series(one: Array, X: Array, X2: Array, X3: Array) -> Array:
    """phi_3 by its power series."""
    c = _COEFFICIENTS
    found: Array = c[6] * one + c[7] * X + c[8] * X2
    found = c[3] * one + c[4] * X + c[5] * X2 + X3 @ found
    found = c[0] * one + c[1] * X + c[2] * X2 + X3 @ found
    return found


def rate_scale(acceleration: Array) -> float:
    """Size of rates per unit of angles that balances d/dt (q, v) = (v, a), from a by q, (..., nv, >= nv) [1/s]."""
    size = acceleration.shape[-2]
    largest = float(np.abs(acceleration[..., :size]).sum(axis=-1).max())
    return max(float(np.sqrt(largest)), 1e-6)
