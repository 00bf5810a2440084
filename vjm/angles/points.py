"""Virtual-joint angles from representative points on a shape function, as in the paper (eqs. 10-12)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.shape.fit import ShapeFit

Array = NDArray[np.float64]

_NEWTON_STEPS = 30
_TOLERANCE = 1e-13  # of the link's length


def representative_points(fit: ShapeFit, lengths: ArrayLike) -> Array:
    """Ends of the virtual links: the virtual joints on the curve, each at its link's length from the one before.

    Virtual link 0 lies along the x axis of Sigma_i; joint 1 is therefore at (l_0, 0). From there on
    (x_(j+1) - x_j)^2 + (y_(j+1) - y_j)^2 = l_j^2 with y_(j+1) = y(x_(j+1)), solved by Newton's method for all frames
    at once.

    Args:
        fit: shape functions of T frames, over positions x along the link.
        lengths: (n + 1,) virtual links [m].

    Returns:
        (T, n + 1, 2) joints 1 .. n and the tip [m]; NaN for frames in which a point does not exist.
    """
    sizes = np.asarray(lengths, dtype=float)
    frames = len(fit.coefficients)
    points = np.zeros((frames, sizes.size, 2))
    points[:, 0, 0] = sizes[0]
    for j in range(1, sizes.size):
        points[:, j] = _next_point(fit, points[:, j - 1], float(sizes[j]))
    return points


def _next_point(fit: ShapeFit, point: Array, size: float) -> Array:
    x0, y0 = point[:, 0], point[:, 1]
    slope = fit.evaluate(x0[:, None], 1)[:, 0]
    x = x0 + size / np.sqrt(1 + slope**2)
    for _ in range(_NEWTON_STEPS):
        rise = fit.evaluate(x[:, None])[:, 0] - y0
        error = (x - x0) ** 2 + rise**2 - size**2
        if not np.any(np.abs(error) > _TOLERANCE * size**2):  # frames already given up are NaN and stay so
            break
        tangent = 2 * (x - x0) + 2 * rise * fit.evaluate(x[:, None], 1)[:, 0]
        # A step is kept within half a virtual link, and ahead of the last joint.
        step = np.clip(error / np.where(tangent == 0, 1e-300, tangent), -size / 2, size / 2)
        x = np.where(x - step > x0, x - step, (x + x0) / 2)
    y = fit.evaluate(x[:, None])[:, 0]
    exists = (np.abs(np.hypot(x - x0, y - y0) - size) < 1e-9 * size) & (x <= fit.length * (1 + 1e-6))
    return np.where(exists[:, None], np.stack([x, y], axis=-1), np.nan)


def chord_angles(points: ArrayLike) -> Array:
    """Angles phi (T, n) [rad]: each virtual link's direction less that of the one before it (eq. 12).

    Args:
        points: (T, n + 1, 2) joints 1 .. n and the tip [m].
    """
    joints = np.asarray(points, dtype=float)
    chords = np.diff(joints, axis=1)
    directions = np.arctan2(chords[..., 1], chords[..., 0])
    return np.diff(directions, axis=1, prepend=np.zeros((len(joints), 1)))
