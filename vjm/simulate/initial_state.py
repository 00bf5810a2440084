"""Replay: an open-loop simulation whose initial state, and nothing else, is estimated from the recording."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vjm.chain.curve import marker_positions
from vjm.chain.records import Chain
from vjm.errors import SimulationDivergedError
from vjm.experiment.records import Recording, Rig
from vjm.modes import equilibrium
from vjm.simulate.rollout import Simulation, marker_arcs, rollout, simulate

Array = NDArray[np.float64]

_MOST_ITERATIONS = 20
_TOLERANCE = 1e-6  # relative decrease of chi^2 at which the search has converged
_PERTURBATION = 1e-6  # rad, and rad times the slowest angular frequency for rates
_SMALLEST_SINGULAR = 1e-9  # of the largest: state directions the recording does not show stay where they were
_MOST_DAMPING = 1e8


@dataclass(frozen=True)
class Replay:
    """An open-loop simulation from the most likely initial state.

    Attributes:
        simulation: the trajectory.
        chi2: weighted sum of squared residuals.
        count: number of measured values behind it.
        marker_rms: of the residuals of all measured marker coordinates [m].
        theta_rms: of the active joints' residuals [rad]; None without active joints.
        status: `converged`, or `not converged` (the remedy is a better model: the state alone cannot follow the data).
    """

    simulation: Simulation
    chi2: float
    count: int
    marker_rms: float
    theta_rms: float | None
    status: Literal["converged", "not converged"]


@dataclass(frozen=True)
class _Measured:
    """What was measured, flat, with where it stands in (T, k, 2) and (T, n_a) arrays."""

    markers: NDArray[np.intp]
    theta: NDArray[np.intp]
    values: Array
    weights: Array

    @classmethod
    def of(cls, recording: Recording, marker_noise: float, encoder_noise: float) -> _Measured:
        markers = np.flatnonzero(np.isfinite(recording.markers))
        theta = np.flatnonzero(np.isfinite(recording.theta))
        values = np.r_[recording.markers.ravel()[markers], recording.theta.ravel()[theta]]
        weights = np.r_[np.full(markers.size, 1 / marker_noise), np.full(theta.size, 1 / encoder_noise)]
        return cls(markers, theta, values, weights)

    def of_model(self, markers: Array, theta: Array) -> Array:
        """Model values (C, m) at what was measured, of markers (T, C, k, 2) and theta (T, C, n_a)."""
        copies = markers.shape[1]
        flat = np.moveaxis(markers, 1, 0).reshape(copies, -1)[:, self.markers]
        return np.concatenate([flat, np.moveaxis(theta, 1, 0).reshape(copies, -1)[:, self.theta]], axis=1)


def replay(chain: Chain, rig: Rig, recording: Recording, marker_noise: float, encoder_noise: float) -> Replay:
    """Simulate a recording open loop from its most likely initial state (Levenberg-Marquardt from rest).

    The first step is the least-squares fit of the linear motion to the whole recording, so no guess is needed.

    Args:
        chain: the arm.
        rig: says where the markers are.
        recording: what was measured, and the torque.
        marker_noise: 1-sigma [m].
        encoder_noise: 1-sigma [rad].

    Raises:
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: the chain's simulation diverges even from rest.
    """
    measured = _Measured.of(recording, marker_noise, encoder_noise)
    state = np.concatenate([_start(chain, recording), np.zeros(chain.size)])
    scale = _state_scale(chain)
    values, jacobian = _linearised(chain, rig, recording, measured, state, scale)
    residual = measured.weights * (measured.values - values)
    chi2, damping, status = float(residual @ residual), 0.0, "not converged"
    for _ in range(_MOST_ITERATIONS):
        step = scale * _damped_step(measured.weights[:, None] * jacobian, residual, damping)
        trial = _chi2(chain, rig, recording, measured, state + step)
        if trial < chi2:
            converged = chi2 - trial < _TOLERANCE * chi2
            state, chi2, damping = state + step, trial, damping / 10 if damping > 1e-6 else 0.0
            if converged:
                status = "converged"
                break
            values, jacobian = _linearised(chain, rig, recording, measured, state, scale)
            residual = measured.weights * (measured.values - values)
        else:
            if trial - chi2 < _TOLERANCE * chi2 or damping > _MOST_DAMPING:
                status = "converged"
                break
            damping = max(10 * damping, 1e-3)
    simulation = simulate(chain, rig, recording, state[: chain.size], state[chain.size :])
    return _report(simulation, recording, chi2, measured.values.size, status == "converged")


def _start(chain: Chain, recording: Recording) -> Array:
    """Rest at the first measured active angles, passive joints hanging under gravity."""
    first = [column[np.isfinite(column)][:1] for column in recording.theta.T]
    theta = np.array([value[0] if value.size else 0.0 for value in first])
    return equilibrium(chain, recording.payload, recording.gravity, theta)


def _state_scale(chain: Chain) -> Array:
    """(2 nv,) natural sizes of the state's components: one radian, and one radian per unit of the stiffest joint."""
    omega = np.sqrt(chain.stiffness.max() / max(sum(float(link.masses @ link.lengths**2) for link in chain.links), 1e-12))
    return np.r_[np.ones(chain.size), np.full(chain.size, omega)]


def _linearised(
    chain: Chain, rig: Rig, recording: Recording, measured: _Measured, state: Array, scale: Array
) -> tuple[Array, Array]:
    """Model values (m,) and their derivative (m, 2 nv) by the scaled initial state: one batched simulation."""
    states = state + np.vstack([np.zeros(state.size), np.diag(_PERTURBATION * scale)])
    n = chain.size
    q, _ = rollout([chain] * len(states), recording, states[:, :n], states[:, n:])
    values = measured.of_model(marker_positions(chain, q, *marker_arcs(rig)), q[:, :, chain.active])
    return values[0], (values[1:] - values[0]).T / _PERTURBATION


def _chi2(chain: Chain, rig: Rig, recording: Recording, measured: _Measured, state: Array) -> float:
    try:
        simulation = simulate(chain, rig, recording, state[: chain.size], state[chain.size :])
    except SimulationDivergedError:
        return float("inf")
    model = measured.of_model(simulation.markers[:, None], simulation.theta[:, None])[0]
    return float(np.sum((measured.weights * (measured.values - model)) ** 2))


def _damped_step(jacobian: Array, residual: Array, damping: float) -> Array:
    left, singular, right = np.linalg.svd(jacobian, full_matrices=False)
    kept = singular > _SMALLEST_SINGULAR * singular[0]
    gains = np.where(kept, singular / np.maximum(singular**2 + damping * singular[0] ** 2, 1e-300), 0.0)
    step: Array = right.T @ (gains * (left.T @ residual))
    return step


def _report(simulation: Simulation, recording: Recording, chi2: float, count: int, converged: bool) -> Replay:
    marker_residual = recording.markers - simulation.markers
    theta_residual = recording.theta - simulation.theta
    known = np.isfinite(theta_residual)
    return Replay(
        simulation=simulation,
        chi2=chi2,
        count=count,
        marker_rms=float(np.sqrt(np.nanmean(marker_residual**2))),
        theta_rms=float(np.sqrt(np.mean(theta_residual[known] ** 2))) if known.any() else None,
        status="converged" if converged else "not converged",
    )
