"""Positions of rest: Newton's method with a line search on out-of-balance torques."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vjm.records import Array

# `unstable`: in balance, but about to fall over or to buckle; `stalled`: no step reduces the torques;
# `iterations`: too many steps.
EquilibriumStatus = Literal["converged", "unstable", "stalled", "iterations"]
_TOLERANCE = 1e-9  # rad or m, of the last step
_ITERATIONS = 100  # Newton doubles the digits with each of the last ones: more than this many is no convergence
_LARGEST_STEP = 0.5  # rad or m: where a joint's torque is far from linear in its angle
_ARMIJO = 1e-4  # J. Nocedal and S. J. Wright, Numerical Optimization, 2nd ed. 2006, section 3.1


@dataclass(frozen=True)
class BalancedPosition:
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


def balance(residual: Callable[[Array], Array], tangent: Callable[[Array], Array], start: Array) -> BalancedPosition:
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
        return BalancedPosition(position, "converged", 0, 0.0)
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
            after = residual(trial)
            if after @ after <= (1 - 2 * _ARMIJO * share) * (torque @ torque):
                position, torque = trial, after
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
    return BalancedPosition(position, status, steps, float(np.abs(torque).max()))
