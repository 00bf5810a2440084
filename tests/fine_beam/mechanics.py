"""Equations of motion of a planar, inextensible, unshearable, geometrically exact beam.

The heading is psi(s, t) = theta(t) + sum_m a_m(t) B_m(s), the centre line r(s) = integral of (cos psi, sin psi).
Lagrange's equations are exact in psi; only the basis and the quadrature are finite.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from tests.fine_beam.basis import Basis, make_basis

if TYPE_CHECKING:
    from tests.fine_beam.beam import Beam, Numerics

Array = NDArray[np.float64]


class Mechanics:
    """One beam in one basis: n = 1 + m coordinates (theta, a_1..a_m) with a hub, n = m when clamped."""

    def __init__(self, beam: Beam, numerics: Numerics) -> None:
        basis: Basis = make_basis(beam.length, numerics.basis_size, numerics.node_count)
        if beam.hub_radius:
            raise ValueError("a beam on the rim of a hub is for `simulate_runs`")
        self.beam = beam
        self.basis = basis
        self.has_hub = beam.joint == "revolute"
        node_count = len(basis.nodes)
        hub_columns = 1 if self.has_hub else 0
        self.heading: Array = np.hstack([np.ones((node_count, hub_columns)), basis.heading])
        self.curvature: Array = np.hstack([np.zeros((node_count, hub_columns)), basis.curvature])
        self.size: int = self.heading.shape[1]
        # Rows scaled by the root of the mass they carry, the payload last: mass integrals become plain products.
        self._root_mass: Array = np.sqrt(np.append(beam.mass / beam.length * basis.weights, beam.payload))
        self._weighted_integrals: Array = self._root_mass[:, None] * np.vstack([basis.cumulative, basis.weights])
        self._weight: Array = self._root_mass[:, None] * np.asarray(beam.gravity)
        self._fields: Array = np.vstack([self.heading, self.curvature])
        self._hub_inertia: Array = np.zeros((self.size, self.size))
        if self.has_hub:
            self._hub_inertia[0, 0] = beam.hub_inertia

    def bending_moment(self, curvature: Array, curvature_rate: Array) -> Array:
        """Moment at the nodes, N m, from curvature (1/m) and its rate (1/(m s)): elastic and Kelvin-Voigt, (N,)."""
        return np.asarray(self.beam.bending_stiffness * (curvature + self.beam.kelvin_voigt_time * curvature_rate))

    def root_torque(self, torque: float, theta: float, theta_rate: float) -> float:
        """Torque that reaches the hub, N m."""
        return torque

    def _inertia_terms(self, heading: Array, heading_rate: Array) -> tuple[Array, Array]:
        """Scaled Jacobian of the centre line (2, N + 1, n) and its convective acceleration (2, N + 1)."""
        cosine, sine, rate_squared = np.cos(heading), np.sin(heading), heading_rate**2
        integrands = np.empty((len(heading), 2, self.size + 1))
        integrands[:, 0, :-1] = -sine[:, None] * self.heading
        integrands[:, 1, :-1] = cosine[:, None] * self.heading
        integrands[:, 0, -1] = -cosine * rate_squared
        integrands[:, 1, -1] = -sine * rate_squared
        scaled = (self._weighted_integrals @ integrands.reshape(len(heading), -1)).reshape(-1, 2, self.size + 1)
        return scaled[..., :-1], scaled[..., -1]

    def acceleration(self, coordinates: Array, rates: Array, torque: float) -> Array:
        """Second derivative of the coordinates, (n,), for hub torque in N m (ignored when clamped)."""
        node_count = len(self.basis.nodes)
        fields = self._fields @ np.stack([coordinates, rates], axis=1)
        jacobian, convective = self._inertia_terms(*fields[:node_count].T)
        jacobian = jacobian.reshape(-1, self.size)
        force = (self._weight - convective).reshape(-1) @ jacobian
        force -= (self.basis.weights * self.bending_moment(*fields[node_count:].T)) @ self.curvature
        if self.has_hub:
            force[0] += self.root_torque(torque, coordinates[0], rates[0])
        _, solution, failure = dposv(jacobian.T @ jacobian + self._hub_inertia, force)
        if failure:
            raise ArithmeticError("the mass matrix is not positive definite: the beam needs mass")
        return np.asarray(solution)

    def static_residual(self, coordinates: Array, tip_force: Array) -> Array:
        """Generalised force at rest, (n,), with a dead force (2,) in N on the tip: zero in equilibrium."""
        jacobian, _ = self._inertia_terms(self.heading @ coordinates, np.zeros(len(self.basis.nodes)))
        curvature = self.curvature @ coordinates
        moment = self.bending_moment(curvature, np.zeros_like(curvature))
        tip_jacobian = self.basis.weights @ self._tangent_rates(coordinates)
        bending = (self.basis.weights * moment) @ self.curvature
        return np.asarray(
            self._weight.reshape(-1) @ jacobian.reshape(-1, self.size) + tip_force @ tip_jacobian - bending
        )

    def _tangent_rates(self, coordinates: Array) -> Array:
        """Derivative of (cos psi, sin psi) by the coordinates at the nodes, (2, N, n)."""
        heading = self.heading @ coordinates
        return np.stack([-np.sin(heading)[:, None] * self.heading, np.cos(heading)[:, None] * self.heading])

    def linearised(self) -> tuple[Array, Array]:
        """Mass and stiffness matrix, (n, n) each, about the straight beam without gravity."""
        jacobian, _ = self._inertia_terms(np.zeros(len(self.basis.nodes)), np.zeros(len(self.basis.nodes)))
        flat = jacobian.reshape(-1, self.size)
        stiffness = self.beam.bending_stiffness * (self.curvature.T * self.basis.weights) @ self.curvature
        return flat.T @ flat + self._hub_inertia, stiffness

    def energy(self, coordinates: Array, rates: Array) -> Array:
        """Kinetic, bending and gravity potential energy, J, (T,), for coordinates and rates (T, n)."""
        position, velocity = self._motion(coordinates, rates)
        masses = self._root_mass**2
        kinetic = 0.5 * np.einsum("tkc,k->t", velocity**2, masses)
        if self.has_hub:
            kinetic = kinetic + 0.5 * self.beam.hub_inertia * rates[:, 0] ** 2
        bending = 0.5 * self.beam.bending_stiffness * (coordinates @ self.curvature.T) ** 2 @ self.basis.weights
        gravity = -np.einsum("tkc,k,c->t", position, masses, np.asarray(self.beam.gravity))
        return np.asarray(kinetic + bending + gravity)

    def angular_momentum(self, coordinates: Array, rates: Array) -> Array:
        """Angular momentum about the proximal end, kg m^2/s, (T,), for coordinates and rates (T, n)."""
        position, velocity = self._motion(coordinates, rates)
        cross = position[..., 0] * velocity[..., 1] - position[..., 1] * velocity[..., 0]
        hub = self.beam.hub_inertia * rates[:, 0] if self.has_hub else 0.0
        return np.asarray(cross @ self._root_mass**2 + hub)

    def _motion(self, coordinates: Array, rates: Array) -> tuple[Array, Array]:
        """Position (m) and velocity (m/s) of the nodes and, last, of the tip; (T, N + 1, 2) each."""
        rows = np.vstack([self.basis.cumulative, self.basis.weights])
        heading, heading_rate = coordinates @ self.heading.T, rates @ self.heading.T
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        normal = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
        return rows @ tangent, rows @ (normal * heading_rate[..., None])
