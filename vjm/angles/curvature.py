"""Virtual-joint angles from the curvature of a shape function over the arc length.

A joint stands for its cell's bending, phi_j = cell_j kappa(s_j): the angle whose spring moment is the beam's own
bending moment there, and the inverse of the curve that `vjm.chain.curve` draws through the joints.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vjm.shape.families import basis
from vjm.shape.fit import ShapeFit

Array = NDArray[np.float64]

_NODES = 24  # Gauss-Legendre nodes for the tip's position


def curvature_angles(fit: ShapeFit, joint_arcs: ArrayLike, cells: ArrayLike) -> Array:
    """Angles phi (T, n) [rad]; NaN for frames whose curve does not exist (its slope by arc length exceeds one).

    With y given over arc length, sin(psi) = y' and kappa = y'' / cos(psi).

    Args:
        fit: shape functions of T frames, over arc lengths.
        joint_arcs: (n,) arc length of each virtual joint [m].
        cells: (n,) length of beam each stands for [m].
    """
    arcs = np.asarray(joint_arcs, dtype=float)
    return np.asarray(cells, dtype=float) * fit.evaluate(arcs, 2) / _cosine(fit.evaluate(arcs, 1))


def curvature_map(fit: ShapeFit, joint_arcs: ArrayLike, cells: ArrayLike) -> Array:
    """(n, order) derivative of phi by the coefficients of a straight link [rad/m]."""
    functions = basis(fit.family, fit.order, np.asarray(joint_arcs, dtype=float), fit.length, 2)
    return np.asarray(cells, dtype=float)[:, None] * functions


def tip_pose(fit: ShapeFit) -> tuple[Array, Array]:
    """Position (T, 2) [m] and heading (T,) [rad] of the distal end in the link frame."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    cosine = _cosine(fit.evaluate(fit.length * (1 + nodes) / 2, 1))
    end = np.array([fit.length])
    position = np.stack([cosine @ weights * fit.length / 2, fit.evaluate(end)[:, 0]], axis=-1)
    return position, np.arcsin(_valid(fit.evaluate(end, 1)[:, 0]))


def _valid(sine: Array) -> Array:
    return np.where(np.abs(sine) < 1, sine, np.nan)


def _cosine(sine: Array) -> Array:
    cosine: Array = np.sqrt(1 - _valid(sine) ** 2)
    return cosine
