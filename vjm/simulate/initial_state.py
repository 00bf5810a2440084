"""Replay: an open-loop simulation whose initial state, and nothing else, is estimated from the recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vjm.chain.curve import marker_positions
from vjm.chain.records import Chain
from vjm.errors import SimulationDivergedError
from vjm.experiment.records import Recording, Rig
from vjm.modes import equilibrium, linearise
from vjm.simulate.integrators import linear_response, sample
from vjm.simulate.rollout import Simulation, default_step, marker_arcs, rollout

Array = NDArray[np.float64]

_MOST_ITERATIONS = 8
_TOLERANCE = 1e-3  # relative decrease of chi^2 that is not worth another step: half a thousandth of the residual
_COARSE_TOLERANCE = 5e-2
_NEGLIGIBLE = 1e-2  # decrease of chi^2: what is left is a tenth of a standard deviation of the state
_PERTURBATION = 1e-6  # rad, and rad times the slowest angular frequency for rates
_LARGEST_UNCERTAINTY = 0.02  # rad a joint: directions of the state that the recording shows less surely stay at rest
_LEAST_DAMPING = 1e-6  # of the largest singular value squared


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
    """What was measured, flat: markers at the camera's frames, then angles at the encoders' samples."""

    frames: NDArray[np.intp]
    markers: NDArray[np.intp]
    theta: NDArray[np.intp]
    values: Array
    weights: Array

    @classmethod
    def of(cls, recording: Recording, marker_noise: float, encoder_noise: float) -> _Measured:
        frames = recording.frames
        seen = recording.markers[frames].ravel()
        markers, theta = np.flatnonzero(np.isfinite(seen)), np.flatnonzero(np.isfinite(recording.theta))
        values = np.concatenate([seen[markers], recording.theta.ravel()[theta]])
        weights = np.concatenate([np.full(markers.size, 1 / marker_noise), np.full(theta.size, 1 / encoder_noise)])
        return cls(frames, markers, theta, values, weights)

    def of_model(self, markers: Array, theta: Array) -> Array:
        """Model values (C, m) at what was measured, of markers (F, C, k, 2) and theta (T, C, n_a)."""
        copies = markers.shape[1]
        flat = np.moveaxis(markers, 1, 0).reshape(copies, -1)[:, self.markers]
        return np.concatenate([flat, np.moveaxis(theta, 1, 0).reshape(copies, -1)[:, self.theta]], axis=1)


def replay(chain: Chain, rig: Rig, recording: Recording, marker_noise: float, encoder_noise: float) -> Replay:
    """Simulate a recording open loop from its most likely initial state (Levenberg-Marquardt from rest).

    The linear motion's least-squares fit to the whole recording comes first, so no guess is needed; the last steps use
    the simulation's own derivatives.

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
    problem = _Problem(chain, rig, recording, _Measured.of(recording, marker_noise, encoder_noise), _state_scale(chain))
    run = problem.run(np.concatenate([_start(chain, recording), np.zeros(chain.size)]))
    run, _ = _search(problem, run, problem.linear_jacobian, _COARSE_TOLERANCE)
    run, converged = _search(problem, run, problem.jacobian, _TOLERANCE)
    return _report(problem, run, converged)


@dataclass(frozen=True)
class _Run:
    """One simulation from an initial state: (2 nv,), its path (T, nv) each, weighted residuals (m,) and chi^2."""

    state: Array
    q: Array
    v: Array
    residual: Array

    @property
    def chi2(self) -> float:
        return float(self.residual @ self.residual)


def _search(problem: _Problem, run: _Run, jacobian_at: Callable[[_Run], Array], tolerance: float) -> tuple[_Run, bool]:
    """Levenberg-Marquardt; a Jacobian is kept as long as steps along it bring half of what they promise."""
    damping, fresh = 0.0, True
    factors = np.linalg.svd(jacobian_at(run), full_matrices=False)
    for _ in range(_MOST_ITERATIONS):
        step, predicted = _damped_step(factors, run.residual, damping)
        if predicted < max(tolerance * run.chi2, _NEGLIGIBLE):
            return run, True
        trial = problem.attempt(run.state + problem.scale * step)
        decrease = -np.inf if trial is None else run.chi2 - trial.chi2
        if trial is not None and decrease > 0:
            run, damping = trial, damping / 10 if damping > _LEAST_DAMPING else 0.0
        if decrease > predicted / 2:
            fresh = False
        elif decrease > 0 or not fresh:
            factors, fresh = np.linalg.svd(jacobian_at(run), full_matrices=False), True
        else:
            damping = max(10 * damping, _LEAST_DAMPING)
    return run, False


@dataclass(frozen=True)
class _Problem:
    """Weighted residuals of a recording as a function of the initial state."""

    chain: Chain
    rig: Rig
    recording: Recording
    measured: _Measured
    scale: Array

    def run(self, state: Array) -> _Run:
        """Simulate from the initial state (2 nv,)."""
        q, v = self._rollout(state[None])
        residual = self.measured.weights * (self.measured.values - self._values(q)[0])
        return _Run(state, q[:, 0], v[:, 0], residual)

    def attempt(self, state: Array) -> _Run | None:
        """The same; None where the simulation diverges."""
        try:
            return self.run(state)
        except SimulationDivergedError:
            return None

    def jacobian(self, run: _Run) -> Array:
        """(m, 2 nv) derivative of the weighted model values by the scaled state: one batched simulation."""
        q, _ = self._rollout(run.state + np.diag(_PERTURBATION * self.scale))
        return self._difference(run.q, q)

    def linear_jacobian(self, run: _Run) -> Array:
        """The same with the linear motion's derivatives about the position of rest."""
        recording, chain = self.recording, self.chain
        M, D, K, _ = linearise(chain, recording.payload, recording.gravity, run.q[0, chain.active])
        step = default_step(chain, recording.payload)
        count = int(np.ceil((recording.time[-1] - recording.time[0]) / step))
        free, _ = sample(linear_response(M, D, K, float(recording.time[0]), step, count), recording.time)
        return self._difference(run.q, run.q[:, None] + _PERTURBATION * self.scale[:, None] * free)

    def _rollout(self, states: Array) -> tuple[Array, Array]:
        n = self.chain.size
        return rollout([self.chain] * len(states), self.recording, states[:, :n], states[:, n:])

    def _values(self, q: Array) -> Array:
        markers = marker_positions(self.chain, q[self.measured.frames], *marker_arcs(self.rig))
        return self.measured.of_model(markers, q[..., self.chain.active])

    def _difference(self, nominal: Array, moved: Array) -> Array:
        """Slope (m, C) between a path (T, nv) and its perturbed copies (T, C, nv)."""
        values = self._values(np.concatenate([nominal[:, None], moved], axis=1))
        slope: Array = self.measured.weights[:, None] * (values[1:] - values[0]).T / _PERTURBATION
        return slope


def _start(chain: Chain, recording: Recording) -> Array:
    """Rest at the first measured active angles, passive joints hanging under gravity."""
    first = [column[np.isfinite(column)][:1] for column in recording.theta.T]
    theta = np.array([value[0] if value.size else 0.0 for value in first])
    return equilibrium(chain, recording.payload, recording.gravity, theta)


def _state_scale(chain: Chain) -> Array:
    """(2 nv,) natural sizes of the state's components: one radian, and one radian per unit of the stiffest joint."""
    omega = np.sqrt(
        chain.stiffness.max() / max(sum(float(link.masses @ link.lengths**2) for link in chain.links), 1e-12)
    )
    return np.concatenate([np.ones(chain.size), np.full(chain.size, float(omega))])


def _damped_step(factors: tuple[Array, Array, Array], residual: Array, damping: float) -> tuple[Array, float]:
    """Step along the Jacobian's singular directions and the decrease of chi^2 that it promises."""
    left, singular, right = factors
    kept = singular > 1 / _LARGEST_UNCERTAINTY
    components = left.T @ residual
    gains = np.where(kept, singular / np.maximum(singular**2 + damping * singular[0] ** 2, 1e-300), 0.0)
    taken = gains * singular
    return right.T @ (gains * components), float(np.sum(components**2 * taken * (2 - taken)))


def _report(problem: _Problem, run: _Run, converged: bool) -> Replay:
    chain, recording = problem.chain, problem.recording
    markers = marker_positions(chain, run.q, *marker_arcs(problem.rig))
    simulation = Simulation(recording.time, run.q, run.v, run.q[:, chain.active], markers)
    marker_residual = recording.markers - markers
    theta_residual = recording.theta - simulation.theta
    known = np.isfinite(theta_residual)
    return Replay(
        simulation=simulation,
        chi2=run.chi2,
        count=run.residual.size,
        marker_rms=float(np.sqrt(np.nanmean(marker_residual**2))),
        theta_rms=float(np.sqrt(np.mean(theta_residual[known] ** 2))) if known.any() else None,
        status="converged" if converged else "not converged",
    )
