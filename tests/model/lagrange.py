"""Equations of motion of planar serial arms straight from the Lagrangian: closed forms for two bodies, numbers for any.

Two bodies. Body 0 turns by theta about the origin; body 1 by phi more about a pin on body 0, a distance l0 out. With
masses m0, m1, centres c0, c1 and inertias I0, I1 about them, hub inertia H on body 0, point mass p on body 1 at l1,

    r0 = c0 u(theta),  r1 = l0 u(theta) + c1 u(theta + phi),  rp = l0 u(theta) + l1 u(theta + phi),  u = (cos, sin),

    T = 1/2 (H + I0 + m0 c0^2) theta'^2 + 1/2 I1 (theta' + phi')^2 + 1/2 m1 |r1'|^2 + 1/2 p |rp'|^2
      = 1/2 alpha theta'^2 + 1/2 beta (theta' + phi')^2 + gamma cos(phi) theta' (theta' + phi'),

    alpha = H + I0 + m0 c0^2 + (m1 + p) l0^2,  beta = I1 + m1 c1^2 + p l1^2,  gamma = l0 (m1 c1 + p l1),

    V = -mu0 g.u(theta) - mu1 g.u(theta + phi) + 1/2 K phi^2,  mu0 = m0 c0 + (m1 + p) l0,  mu1 = m1 c1 + p l1.

d/dt dT/dtheta' - dT/dtheta + dV/dtheta = tau, and the same for phi with -D phi' on the right:

    M11 = alpha + beta + 2 gamma cos(phi),  M12 = beta + gamma cos(phi),  M22 = beta,
    h1 = -gamma sin(phi) phi' (2 theta' + phi') + G1 + G2,  h2 = gamma sin(phi) theta'^2 + G2,
    G1 = mu0 (gx sin theta - gy cos theta),  G2 = mu1 (gx sin(theta + phi) - gy cos(theta + phi)).

A clamped link is theta = 0 for good: beta phi'' + G2 + K phi + D phi' = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vjm.chain.virtual_links import Chain, LinkChain
from vjm.records import Payload

Array = NDArray[np.float64]
_STEP = 1e-30  # of the complex-step derivative, which has no rounding error


@dataclass(frozen=True)
class TwoBodies:
    """The closed form above. Angles, rates and accelerations are (T,) arrays."""

    alpha: float
    beta: float
    gamma: float
    mu0: float
    mu1: float
    stiffness: float
    damping: float
    gravity: tuple[float, float]

    @classmethod
    def of(cls, link: LinkChain, payload: Payload, gravity: tuple[float, float]) -> TwoBodies:
        """The constants of a link with one virtual joint."""
        (l0, l1), (m0, m1), (c0, c1), (i0, i1) = link.lengths, link.masses, link.mass_centers, link.inertias
        carried = ((link.payload, l1 + link.payload_offset), (payload.mass, l1 + payload.offset))
        p, first = (sum(m * r**k for m, r in carried) for k in (0, 1))
        second = sum(m * r**2 for m, r in carried) + link.payload_inertia + payload.inertia
        return cls(
            alpha=link.hub_inertia + i0 + m0 * (link.hub_radius + c0) ** 2 + (m1 + p) * (link.hub_radius + l0) ** 2,
            beta=i1 + m1 * c1**2 + second,
            gamma=(link.hub_radius + l0) * (m1 * c1 + first),
            mu0=m0 * (link.hub_radius + c0) + (m1 + p) * (link.hub_radius + l0),
            mu1=m1 * c1 + first,
            stiffness=float(link.stiffness[0]),
            damping=float(link.damping[0]),
            gravity=gravity,
        )

    def mass_matrix(self, phi: Array) -> Array:
        """(T, 2, 2)."""
        m12 = self.beta + self.gamma * np.cos(phi)
        m11 = self.alpha + self.beta + 2 * self.gamma * np.cos(phi)
        return np.moveaxis(np.array([[m11, m12], [m12, self.beta + 0 * phi]]), -1, 0)

    def bias(self, theta: Array, phi: Array, theta_rate: Array, phi_rate: Array) -> Array:
        """H, (T, 2)."""
        gx, gy = self.gravity
        g1 = self.mu0 * (gx * np.sin(theta) - gy * np.cos(theta))
        g2 = self.mu1 * (gx * np.sin(theta + phi) - gy * np.cos(theta + phi))
        swirl = self.gamma * np.sin(phi)
        return np.stack([g1 + g2 - swirl * phi_rate * (2 * theta_rate + phi_rate), g2 + swirl * theta_rate**2], axis=-1)


def _segments(chain: Chain) -> tuple[Array, list[tuple[float, float, Array]]]:
    """The headings' map (B, nv) and each body's mass, inertia and reach (B,): centre = sum of reach_i u(heading_i)."""
    headings: list[Array] = []
    lengths: list[float] = []
    bodies: list[tuple[float, float, list[float]]] = []
    heading, coordinate = np.zeros(chain.size), 0
    for link in chain.links:
        for j in range(link.virtual_joints + 1):
            heading = heading.copy()
            if j > 0 or link.joint == "revolute":
                heading[coordinate] = 1.0
                coordinate += 1
            if j == 0:  # a hub of its radius, without mass
                headings.append(heading)
                bodies.append((0.0, 0.0, [*lengths, 0.0]))
                lengths.append(link.hub_radius)
            headings.append(heading)
            inertia = link.inertias[j] + (link.hub_inertia if j == 0 else 0.0)
            bodies.append((link.masses[j], inertia, [*lengths, link.mass_centers[j]]))
            lengths.append(float(link.lengths[j]))
        beyond = [*lengths[:-1], lengths[-1] + link.payload_offset]
        bodies.append((link.payload, link.payload_inertia, beyond))
    padded = [(m, i, np.array(reach + [0.0] * (len(lengths) - len(reach)))) for m, i, reach in bodies]
    return np.array(headings), padded


def lagrange_mass_matrix(chain: Chain, q: NDArray) -> NDArray:
    """(nv, nv) Hessian of the kinetic energy by the rates, at q (nv,), real or complex."""
    headings, bodies = _segments(chain)
    angle = headings @ q
    total = np.zeros((chain.size, chain.size), dtype=angle.dtype)
    for mass, inertia, reach in bodies:
        spin = headings[np.flatnonzero(reach)[-1] if reach.any() else 0]
        x, y = (-reach * np.sin(angle)) @ headings, (reach * np.cos(angle)) @ headings
        total += mass * (np.outer(x, x) + np.outer(y, y)) + inertia * np.outer(spin, spin)
    return total


def lagrange_potential(chain: Chain, q: NDArray) -> complex:
    """Gravity's potential energy at q (nv,), real or complex."""
    headings, bodies = _segments(chain)
    angle, (gx, gy) = headings @ q, chain.gravity
    return -sum(mass * (reach @ (gx * np.cos(angle) + gy * np.sin(angle))) for mass, _, reach in bodies)


def lagrange_bias(chain: Chain, q: Array, v: Array) -> Array:
    """h = M' v - 1/2 d(v M v)/dq + dV/dq at q, v (nv,); derivatives by complex steps."""
    size = chain.size
    slopes, force = np.empty((size, size, size)), np.empty(size)
    for k in range(size):
        moved = q + 1j * _STEP * np.eye(size)[k]
        slopes[k] = lagrange_mass_matrix(chain, moved).imag / _STEP
        force[k] = lagrange_potential(chain, moved).imag / _STEP
    return np.asarray(np.einsum("kij,j,k->i", slopes, v, v) - np.einsum("kij,i,j->k", slopes, v, v) / 2 + force)
