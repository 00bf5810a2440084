"""Torque errors and their objective J (eqs. 14-15)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from vjm.chain.virtual_links import Chain
from vjm.errors import ShapeError
from vjm.model import dynamics
from vjm.records import Array


def torque_errors(
    chain: Chain,
    q: ArrayLike,
    v: ArrayLike,
    a: ArrayLike,
    torque: ArrayLike,
    payload: float = 0.0,
    gravity: tuple[float, float] | None = None,
    mechanism: dynamics.Mechanism | None = None,
) -> Array:
    """Return active and passive torque errors (eq. 14), from one batched RNEA.

    tau_ea = tau_a - M11 theta'' - M12 phi'' - h1 and tau_ep = -(M21 theta'' + M22 phi'' + h2 + K phi + D phi').

    Args:
        chain: the arm.
        q, v, a: (T, nv) angles [rad], rates [rad/s], accelerations [rad/s^2].
        torque: (T, n_a) active joint torques [N m]; NaN where not measured.
        payload: extra point mass on the tip [kg].
        gravity: in the plane [m/s^2]; the chain's when None.
        mechanism: the chain's, where the caller has built it already.

    Returns:
        (T, nv) errors in the chain's order [N m]; NaN on active rows without measured torque.

    Raises:
        ShapeError: arrays that do not fit the chain.
    """
    applied = np.asarray(torque, dtype=float)
    if applied.ndim != 2 or applied.shape[1] != chain.active.size:
        raise ShapeError("torque", f"shape {applied.shape}", f"shape (T, {chain.active.size})")
    built = dynamics.build(chain, payload, gravity) if mechanism is None else mechanism
    errors = dynamics.inverse_dynamics(built, q, v, a)
    errors += chain.stiffness * np.asarray(q, dtype=float)
    errors += chain.damping * np.asarray(v, dtype=float)
    np.negative(errors, out=errors)
    errors[:, chain.active] += applied
    return errors


def objective(weighted_errors: Iterable[ArrayLike]) -> float:
    """Return J of eq. (15), here as a mean: of the squares of all weighted torque errors.

    Args:
        weighted_errors: of each recording, (T, m) errors times F^T for a weight W = F^T F, the inverse of their noise
            covariance; in units of the noise, NaN rows of joints without measured torque count nothing.
    """
    values = np.concatenate([np.ravel(errors) for errors in weighted_errors])
    return float(np.mean(values[np.isfinite(values)] ** 2))
