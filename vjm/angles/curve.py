"""Virtual-joint angles whose curve passes closest to the markers: the inverse of `vjm.chain.curve`.

Where there are at least as many markers as joints, the angles of a chain's own markers come back exactly, however far
it bends.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.chain.curve import CurveMap
from vjm.errors import InsufficientDataError

Array = NDArray[np.float64]

_STEPS = 12  # Gauss-Newton converges quadratically on exact data
_TOLERANCE = 1e-13  # rad
_LARGEST_TURN = 0.5  # rad a step
_RIDGE = 1e-14  # keeps frames without enough markers solvable; their angles are thrown away
_CHUNK = 20_000  # frames a batch, bounds the memory


def curve_angles(curve: CurveMap, markers: ArrayLike, start: ArrayLike) -> Array:
    """Angles phi (T, n) [rad] by least squares on all measured coordinates; NaN for frames with too few.

    Args:
        curve: maps phi to the markers' positions.
        markers: (T, k, 2) in the link frame [m]; NaN where not measured.
        start: (T, n) first guess [rad]; zero where NaN.

    Raises:
        InsufficientDataError: fewer markers than virtual joints.
    """
    n = curve.heading.shape[1]
    positions, guess = np.asarray(markers, dtype=float), np.nan_to_num(np.asarray(start, dtype=float))
    if curve.arcs.size < n:
        raise InsufficientDataError(
            "angles by the curve", f"{curve.arcs.size} markers cannot place {n} virtual joints", "ask for fewer joints"
        )
    parts = [
        _solve(curve, positions[row : row + _CHUNK], guess[row : row + _CHUNK])
        for row in range(0, len(positions), _CHUNK)
    ]
    return np.concatenate(parts) if parts else guess


def _solve(curve: CurveMap, markers: Array, phi: Array) -> Array:
    known = np.isfinite(markers)
    values = np.where(known, markers, 0.0)
    enough = known[..., 1].sum(axis=1) >= phi.shape[1]
    for _ in range(_STEPS):
        residual = np.where(known, values - curve.positions(phi), 0.0).reshape(len(phi), -1)
        jacobian = np.where(known[..., None], curve.jacobian(phi), 0.0).reshape(*residual.shape, -1)
        normal = np.einsum("tmi,tmj->tij", jacobian, jacobian)
        right = np.einsum("tmi,tm->ti", jacobian, residual)
        # Columns scaled to one before solving: joints near the tip move the markers little.
        size = np.sqrt(np.maximum(np.einsum("tii->ti", normal), 1e-300))
        scaled = normal / (size[:, :, None] * size[:, None, :])
        step = np.linalg.solve(scaled + _RIDGE * np.eye(phi.shape[1]), (right / size)[..., None])[..., 0] / size
        largest = np.abs(step).max(axis=1, keepdims=True)
        phi = phi + step * np.minimum(1.0, _LARGEST_TURN / np.maximum(largest, 1e-300))
        if not (largest[enough] > _TOLERANCE).any():
            break
    return np.where(enough[:, None], phi, np.nan)


def curve_covariance(curve: CurveMap) -> Array:
    """(n, n) covariance of phi per unit variance of a marker coordinate, for a straight link [rad^2/m^2]."""
    lateral = curve.jacobian(np.zeros(curve.heading.shape[1]))[:, 1, :]
    inverse = np.linalg.pinv(lateral)
    covariance: Array = inverse @ inverse.T
    return covariance
