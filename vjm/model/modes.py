"""Positions of rest, and natural frequencies, damping ratios and shapes of a chain linearised about them (M, D, K)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, ShapeError
from vjm.model.dynamics import Mechanism, mechanism_of
from vjm.records import NO_PAYLOAD, Array, Payload

# `unstable`: in balance, but about to fall over or to buckle; `stalled`: no step reduces the torques;
# `iterations`: too many steps.
EquilibriumStatus = Literal["converged", "unstable", "stalled", "iterations"]
_TOLERANCE = 1e-9  # rad or m, of the last step
_ITERATIONS = 100  # Newton doubles the digits with each of the last ones: more than this many is no convergence
_LARGEST_STEP = 0.5  # rad or m: where a joint's torque is far from linear in its angle
_ARMIJO = 1e-4  # J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed. 2006, section 3.1
_RIGID = 1e-6  # a mode this much slower than the fastest is a rigid-body motion


@dataclass(frozen=True)
class Modes:
    """Vibration modes, slowest first; rigid-body motion is left out."""

    frequencies: Array  # (m,) undamped natural frequencies [Hz]
    damping_ratios: Array  # (m,) fractions of critical damping
    shapes: Array  # (nv, m) joint angles of each mode, with modal mass one


def linearise(
    chain: Chain, payload: Payload = NO_PAYLOAD, gravity: tuple[float, float] | None = None, theta: ArrayLike = 0.0
) -> tuple[Array, Array, Array, Array]:
    """Return M, D, K (nv, nv) about the position of rest, and that position (nv,).

    Args:
        chain: the arm.
        payload: extra body on the tip.
        gravity: in the plane [m/s^2]; the chain's when None.
        theta: active joint angles held while the passive joints come to rest [rad].

    Raises:
        InsufficientDataError: no position of rest was found: the link buckles or the load is out of all proportion.
    """
    active = np.broadcast_to(theta, chain.active.shape).astype(float)
    load = chain.gravity if gravity is None else gravity
    # Without gravity, M and K do not depend on the angle of an active first joint: at zero, results are remembered.
    angles = np.where(chain.active > 0, active, 0.0) if not any(load) else active
    M, D, K, q = _linearised(chain, payload, load, tuple(angles.tolist()))
    rest = q.copy()
    rest[chain.active] = active
    return M, D, K, rest


@lru_cache(maxsize=64)
def _linearised(
    chain: Chain, payload: Payload, gravity: tuple[float, float], theta: tuple[float, ...]
) -> tuple[Array, Array, Array, Array]:
    """Linearise as `linearise`; the last results are remembered, as many segments of recordings share them."""
    mechanism = mechanism_of(chain, payload, gravity)
    q = np.zeros(chain.size)
    q[chain.active] = theta
    if any(gravity):
        q = _rest_position(chain, mechanism, q)
    M = mechanism.mass_matrix(q[None])[0]
    K = np.diag(chain.stiffness) + mechanism.gravity_stiffness(q)
    result = M, np.diag(chain.damping), (K + K.T) / 2, q
    for matrix in result:
        matrix.setflags(write=False)  # they are shared
    return result


def _rest_position(chain: Chain, mechanism: Mechanism, start: Array) -> Array:
    """Return the joint angles (nv,) [rad] at which the passive joints rest under gravity, the active ones held."""
    q, passive, K = start.copy(), chain.passive, np.diag(chain.stiffness)

    def residual(phi: Array) -> Array:
        q[passive] = phi
        zero = np.zeros((1, chain.size))
        unbalanced: Array = mechanism.inverse_dynamics(q[None], zero, zero)[0] + K @ q
        return unbalanced[passive]

    def tangent(phi: Array) -> Array:
        q[passive] = phi
        return np.asarray((K + mechanism.gravity_stiffness(q))[np.ix_(passive, passive)])

    solution = balance(residual, tangent, q[passive])
    # An unstable equilibrium is no position of rest.
    if solution.status != "converged":
        raise InsufficientDataError("position of rest", "none was found", "check gravity, masses and bending stiffness")
    q[passive] = solution.position
    return q


def modes(chain: Chain, payload: Payload = NO_PAYLOAD, gravity: tuple[float, float] | None = None) -> Modes:
    """Return the vibration modes of the chain with its active joints free to turn; arguments as of `linearise`."""
    return modes_of(*linearise(chain, payload, gravity)[:3])


def locked_modes(
    chain: Chain, payload: Payload = NO_PAYLOAD, gravity: tuple[float, float] | None = None, theta: ArrayLike = 0.0
) -> tuple[Modes, Array]:
    """Return the modes of the p passive joints, with shapes (p, m), and their inertia (p, p); active joints are locked.

    Arguments and errors as of `linearise` and `modes_of`.
    """
    M, D, K, _ = linearise(chain, payload, gravity, theta)
    passive = np.ix_(chain.passive, chain.passive)
    return modes_of(M[passive], D[passive], K[passive]), M[passive]


def modes_of(M: Array, D: Array, K: Array) -> Modes:
    """Return the modes of M x'' + D x' + K x = 0; the damping of a mode is its share of D (exact for light damping).

    Raises:
        ShapeError: a mass matrix that is not positive definite.
    """
    try:
        squares, shapes = linalg.eigh(K, M)
    except linalg.LinAlgError as error:
        raise ShapeError("M", "a matrix that is not positive definite", "positive masses and inertias") from error
    elastic = squares > _RIGID**2 * max(float(np.abs(squares).max()), 1e-300)
    omega = np.sqrt(squares[elastic])
    shapes = shapes[:, elastic]
    ratios = np.einsum("im,ij,jm->m", shapes, D, shapes) / (2 * omega)
    return Modes(omega / (2 * np.pi), ratios, shapes)


@dataclass(frozen=True)
class _BalancedPosition:
    """End of Newton's method.

    Attributes:
        position: (n,) [rad], sliding joints [m].
        status: `converged`, or why not.
        iterations: number of steps.
        residual: largest torque out of balance [N m].
    """

    position: Array
    status: EquilibriumStatus
    iterations: int
    residual: float


def balance(residual: Callable[[Array], Array], tangent: Callable[[Array], Array], start: Array) -> _BalancedPosition:
    """Find where torques are in balance, by Newton's method with backtracking.

    Each step solves K_t d = -r with the tangent stiffness K_t; it is halved until |r|^2 has decreased by 1e-4 of what
    its slope promises (J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed. 2006, section 11.2).

    Args:
        residual: torques out of balance r (n,) [N m] at a position (n,).
        tangent: their derivative K_t (n, n) [N m/rad].
        start: (n,) position.
    """
    position = np.array(start, dtype=float)
    torque, steps = residual(position), 0
    status: EquilibriumStatus = "iterations"
    if position.size == 0:
        return _BalancedPosition(position, "converged", 0, 0.0)
    while steps < _ITERATIONS:
        steps += 1
        slope = tangent(position)
        step = -np.linalg.lstsq(slope, torque, rcond=None)[0]
        largest = float(np.abs(step).max())
        if np.linalg.norm(slope @ step + torque) > np.linalg.norm(torque) / 2:  # no turn of any joint reduces them
            status = "stalled"
            break
        share = min(1.0, _LARGEST_STEP / max(largest, 1e-300))
        while share > 1e-10:
            trial = position + share * step
            trial_torque = residual(trial)
            if trial_torque @ trial_torque <= (1 - 2 * _ARMIJO * share) * (torque @ torque):
                position, torque = trial, trial_torque
                break
            share /= 2
        else:  # rounding alone keeps a tiny step from reducing the torques
            status = "converged" if largest < _TOLERANCE else "stalled"
            break
        if largest < _TOLERANCE:
            status = "converged"
            break
    slope = tangent(position)
    if status == "converged" and np.linalg.eigvalsh((slope + slope.T) / 2)[0] <= 0:
        status = "unstable"
    return _BalancedPosition(position, status, steps, float(np.abs(torque).max()))
