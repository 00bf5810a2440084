"""Exponential integration: matrices of steps that advance the linear part of x' = L x + f(x) exactly.

The first unknowns are angles, the next their rates, so that f, what remains, is in the accelerations alone.
"""

from __future__ import annotations

import numpy as np

from vjm.records import Array

# Of the five stages below, the first of which is a step's start: instants of the others and of the step's end, as
# shares of it, and weights of the stages' rates where the linear part is zero: the explicit method of order four.
NODES = np.array([0.5, 0.5, 1.0, 0.5, 1.0])
_EXPLICIT_WEIGHTS = np.array(
    [
        [1 / 2, 0.0, 0.0, 0.0, 0.0],
        [0.0, 1 / 2, 0.0, 0.0, 0.0],
        [0.0, 1 / 2, 1 / 2, 0.0, 0.0],
        [1 / 4, 1 / 8, 1 / 8, 0.0, 0.0],
        [1 / 6, 0.0, 0.0, 1 / 6, 2 / 3],
    ]
)


def linear_part(mobility: Array, stiffness: Array, damping: Array) -> Array:
    """Return L (C, 2 n, 2 n) [1/s] from the inverse of mass matrices (C, n, n) and springs and dampers (C, n)."""
    n = mobility.shape[1]
    L = np.zeros((len(mobility), 2 * n, 2 * n))
    L[:, :n, n:] = np.eye(n)
    L[:, n:, :n], L[:, n:, n:] = -mobility * stiffness[:, None], -mobility * damping[:, None]
    return L


def runge_kutta_stages(L: Array, step: float) -> tuple[list[list[Array]], tuple[Array, ...], tuple[Array, ...]]:
    """Return matrices of a step's later stages and its end, by the exponential Runge-Kutta method of stiff order four.

    Source: M. Hochbruck and A. Ostermann, Explicit exponential Runge-Kutta methods for semilinear parabolic problems,
    SIAM Journal on Numerical Analysis 43 (2005), eq. (5.19).

    Args:
        L: linear parts (C, 2 n, 2 n) [1/s].
        step: [s].

    Returns:
        Of the second to fifth stage and of the end, matrices to the state there: (C, 2 n, 2 n) from the step's start,
        and (C, 2 n, n) from what remains of the accelerations of each stage before. Also of half a step and of the
        whole, exp and step times phi_1, phi_2, phi_3 by accelerations.
    """
    n = L.shape[1] // 2
    half_flow, *half = phi_functions(L, step / 2, n)
    flow, *full = _of_twice_the_step(half_flow, *half)
    (half1, half2, half3), (phi1, phi2, phi3) = ([step * phi[:, :, n:] for phi in phis] for phis in (half, full))
    late = half2 / 2 - phi3 + phi2 / 4 - half3 / 2
    last = half2 / 4 - late
    stages = [
        [half_flow, half1 / 2],
        [half_flow, half1 / 2 - half2, half2],
        [flow, phi1 - 2 * phi2, phi2, phi2],
        [half_flow, half1 / 2 - 2 * late - last, late, late, last],
        [flow, phi1 - 3 * phi2 + 4 * phi3, 0 * phi1, 0 * phi1, 4 * phi3 - phi2, 4 * phi2 - 8 * phi3],
    ]
    return stages, (half_flow, half1, half2, half3), (flow, phi1, phi2, phi3)


def internal_stage(z: Array, rates: Array, step: float) -> Array:
    """Return internal states (...), which the linear part leaves alone, at a stage of a step [s] or at its end.

    Args:
        z: those at the step's start.
        rates: (s, ...) of change at the s stages before.
        step: [s].
    """
    if not z.size:
        return z
    count = len(rates)
    mean: Array = _EXPLICIT_WEIGHTS[count - 1, :count].dot(
        rates.reshape(count, -1)
    )  # has less overhead than `tensordot`
    return z + step * mean.reshape(z.shape)


def phi_functions(L: Array, step: float, size: int) -> tuple[Array, Array, Array, Array]:
    """Return exp, phi_1, phi_2, phi_3 of step * L for x' = L x: power series of halved matrices, then doubling.

    phi_k(z) = (phi_{k-1}(z) - 1 / (k - 1)!) / z with phi_0 = exp (Hochbruck and Ostermann 2010).
    L is (K, m, m) [1/s]. The first `size` unknowns are angles, the next their rates, which are balanced with them.
    """
    units, halvings, (flow, phi1, phi2, phi3) = _of_halved_step(L, step, size)
    for _ in range(halvings):
        flow, phi1, phi2, phi3 = _of_twice_the_step(flow, phi1, phi2, phi3)
    back = units[:, None] / units
    return flow * back, phi1 * back, phi2 * back, phi3 * back


def flow_and_response(L: Array, step: float, size: int, forcing: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return exp(step L) and the sum of phi_k(step L) F_k of forcing F_1, F_2, F_3 (K, m, p); L and size as above.

    Doubling the forcing in place of the matrices, of which it has fewer columns, gives the same.
    """
    units, halvings, (flow, *phis) = _of_halved_step(L, step, size)
    flows = [flow]
    for _ in range(halvings):
        flows.append(flows[-1] @ flows[-1])
    F1, F2, F3 = (part / units[:, None] for part in forcing)
    if F1.shape[2]:
        for half in reversed(flows[:-1]):
            F1, F2, F3 = (half @ F1 + F1) / 2 + F2 / 4 + F3 / 16, (half @ F2 + F2) / 4 + F3 / 8, (half @ F3 + F3) / 8
    response = sum(phi @ part for phi, part in zip(phis, (F1, F2, F3), strict=True))
    return flows[-1] * (units[:, None] / units), response * units[:, None]


def _of_halved_step(L: Array, step: float, size: int) -> tuple[Array, int, tuple[Array, Array, Array, Array]]:
    """Return the balanced unknowns' units (m,), and exp, phi_1, phi_2, phi_3 of a step that was halved so many times.

    Arguments as of `phi_functions`.
    """
    stiffness = float(np.abs(L[:, size : 2 * size, :size]).sum(axis=-1).max(initial=0.0))
    units = np.ones(L.shape[-1])
    units[size : 2 * size] = max(float(np.sqrt(stiffness)), 1e-6)
    W = step * L * (units / units[:, None])
    norm = float(np.abs(W).sum(axis=2).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / 0.5))))
    X = W / 2.0**halvings
    X2 = X @ X
    identity, X3 = np.eye(W.shape[-1]), X2 @ X
    c = 1 / np.cumprod(np.arange(1.0, 12.0))[2:]  # 1 / (k + 3)!, enough for norms of up to a half
    phi3 = c[6] * identity + c[7] * X + c[8] * X2
    phi3 = c[3] * identity + c[4] * X + c[5] * X2 + X3 @ phi3
    phi3 = c[0] * identity + c[1] * X + c[2] * X2 + X3 @ phi3
    phi2 = identity / 2 + X @ phi3
    phi1 = identity + X @ phi2
    return units, halvings, (identity + X @ phi1, phi1, phi2, phi3)


def _of_twice_the_step(flow: Array, phi1: Array, phi2: Array, phi3: Array) -> tuple[Array, Array, Array, Array]:
    """Return exp, phi_1, phi_2, phi_3 of 2 z from those of z (Hochbruck and Ostermann 2010)."""
    return (
        flow @ flow,
        (flow @ phi1 + phi1) / 2,
        (flow @ phi2 + phi1 + phi2) / 4,
        (flow @ phi3 + phi1 / 2 + phi2 + phi3) / 8,
    )
