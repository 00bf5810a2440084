"""The heading's basis along the beam, and quadrature that is exact for polynomials."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Basis:
    """Bending functions B_m(s) sampled at N Gauss-Legendre nodes of [0, length].

    Attributes:
        length: beam length, m.
        nodes: arc lengths, m, (N,); one of no weight may follow, at the distal end, and one may come first, at zero,
            whose weight is a rigid hub's radius.
        weights: quadrature weights, m, (N,).
        heading: B_m at the nodes, (N, m); B_m(0) = 0.
        curvature: dB_m/ds at the nodes, 1/m, (N, m); zero at the distal end where that carries no moment.
        cumulative: takes nodal values of f to the integral of f from 0 to each node, m, (N, N).
    """

    length: float
    nodes: Array
    weights: Array
    heading: Array
    curvature: Array
    cumulative: Array
    hub: float = 0.0  # radius, m

    def integrals_to(self, arc_lengths: Array) -> Array:
        """Rows that take nodal values of f to its integral from 0 to each arc length, m, (k, N)."""
        abscissae = 2.0 * np.asarray(arc_lengths, dtype=float) / self.length - 1.0
        hubs = int(self.hub != 0.0)
        count = int(np.count_nonzero(self.weights)) - hubs
        rows = 0.5 * self.length * _integrals(abscissae, count)
        padded = np.pad(rows, ((0, 0), (hubs, len(self.nodes) - count - hubs)))
        padded[:, :hubs] = self.hub
        return padded

    def with_tip_node(self) -> Basis:
        """The same with one more node, at the distal end and of no weight."""
        return Basis(
            length=self.length,
            nodes=np.append(self.nodes, self.length),
            weights=np.append(self.weights, 0.0),
            heading=np.vstack([self.heading, self.weights @ self.curvature]),
            curvature=np.vstack([self.curvature, np.zeros(self.curvature.shape[1])]),
            cumulative=np.pad(np.vstack([self.cumulative, self.weights]), ((0, 0), (0, 1))),
        )

    def with_hub(self, radius: float) -> Basis:
        """The same on the rim of a hub: one more node, at the joint, with the hub's heading; places are from there."""
        return Basis(
            length=self.length,
            nodes=np.append(0.0, self.nodes),
            weights=np.append(radius, self.weights),
            heading=np.pad(self.heading, ((1, 0), (0, 0))),
            curvature=np.pad(self.curvature, ((1, 0), (0, 0))),
            cumulative=np.pad(np.hstack([np.full((len(self.nodes), 1), radius), self.cumulative]), ((1, 0), (0, 0))),
            hub=radius,
        )


def _integrals(abscissae: Array, count: int) -> Array:
    """Integrate, from -1 to each abscissa, the polynomial through values at `count` Gauss nodes; (k, count)."""
    gauss_nodes, gauss_weights = legendre.leggauss(count)
    degree = np.arange(count)
    # Gauss quadrature gives the Legendre coefficients of the interpolating polynomial exactly.
    coefficients = (degree[:, None] + 0.5) * legendre.legvander(gauss_nodes, count - 1).T * gauss_weights
    polynomials = legendre.legvander(abscissae, count)
    integrals = np.empty((len(abscissae), count))
    integrals[:, 0] = polynomials[:, 1] + 1.0
    integrals[:, 1:] = (polynomials[:, 2:] - polynomials[:, : count - 1]) / (2 * degree[1:] + 1)
    return integrals @ coefficients


@lru_cache(maxsize=64)
def make_basis(length: float, size: int, node_count: int, tip_moment: bool = False) -> Basis:
    """Build `size` bending functions; the curvatures P_m - P_(m-1) vanish at the distal end if no moment acts there.

    Building that condition in makes the highest, merely numerical, natural frequency several times lower. Where what is
    on the tip resists turning, the curvatures are P_(m-1).
    """
    gauss_nodes, gauss_weights = legendre.leggauss(node_count)
    cumulative = 0.5 * length * _integrals(gauss_nodes, node_count)
    polynomials = legendre.legvander(gauss_nodes, size)
    curvature = (polynomials[:, :-1] if tip_moment else polynomials[:, 1:] - polynomials[:, :-1]) / length
    return Basis(
        length=length,
        nodes=0.5 * length * (gauss_nodes + 1.0),
        weights=0.5 * length * gauss_weights,
        heading=cumulative @ curvature,
        curvature=curvature,
        cumulative=cumulative,
    )
