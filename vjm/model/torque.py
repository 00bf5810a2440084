"""Torque errors and their objective J (eqs. 14-15)."""

from __future__ import annotations

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
    """Active and passive torque errors (eq. 14), from one batched RNEA.

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


def objective(errors: ArrayLike, weights: ArrayLike | None = None) -> float:
    """J of eq. (15): time mean of the weighted squares of the torque errors.

    Args:
        errors: (T, m) [N m]; NaN rows of joints without measured torque count nothing.
        weights: (m, m) symmetric weight, the inverse of the errors' noise covariance [1/(N m)^2]; identity when None.
    """
    values = np.nan_to_num(np.asarray(errors, dtype=float))
    if weights is None:
        return float(np.mean(np.sum(values**2, axis=1)))
    return float(np.mean(np.einsum("ti,ij,tj->t", values, np.asarray(weights, dtype=float), values)))
