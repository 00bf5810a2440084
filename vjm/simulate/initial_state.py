"""Replay: an open-loop simulation whose initial state, and nothing else, is estimated from the recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.errors import SimulationDivergedError
from vjm.experiment.records import Recording, Rig
from vjm.modes import equilibrium, linearise
from vjm.simulate.observation import Observed
from vjm.simulate.rollout import Simulation, half_interval, rollouts
from vjm.simulate.sensitivity import Basis, Moved, first_angles, jacobian
from vjm.simulate.steps import Steps, sample
from vjm.simulate.triangle import Triangle

Array = NDArray[np.float64]

_MOST_ITERATIONS = 15
_TOLERANCE = 1e-5  # relative decrease of chi^2 that is not worth another step
_NEGLIGIBLE = 1e-2  # decrease of chi^2: what is left is a tenth of a standard deviation of the state
_FIRST_DAMPING = 1e-3
_USUAL_BEND = 0.1  # lengths; bending of the arm's whole length by this much is nothing unusual to start from
_USUAL_TURN = 1.0  # rad of an active joint


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
class Start:
    """What is known of a recording's initial state before it is looked at.

    A weak preference for rest, by the energy that bending the arm by a tenth of its length takes: it matters only for
    motion that the recording cannot show.

    Attributes:
        rest: (2 nv,) angles of rest at the first measured active angles, and zero rates [rad, rad/s].
        root: (2 nv, 2 nv) |root (state - rest)|^2 is added to chi^2.
    """

    rest: Array
    root: Array

    @classmethod
    def of(cls, chain: Chain, recording: Recording) -> Start:
        """Of a chain at a recording's beginning."""
        theta = first_angles(recording)
        q = equilibrium(chain, recording.payload, recording.gravity, theta)
        M, _, _, _ = linearise(chain, recording.payload, recording.gravity, theta)
        stiffness = min(float(np.mean(link.stiffness * link.cells)) for link in chain.links)
        energy = 1.5 * stiffness * _USUAL_BEND**2 / sum(link.length for link in chain.links)
        n = chain.size
        root = np.zeros((2 * n, 2 * n))
        root[range(n), range(n)] = np.sqrt(chain.stiffness / (2 * energy))
        root[chain.active, chain.active] = 1 / _USUAL_TURN
        root[n:, n:] = np.linalg.cholesky(M / (2 * energy)).T
        return cls(np.concatenate([q, np.zeros(n)]), root)


@dataclass(frozen=True)
class Run:
    """A simulation of one recording from an initial state, beside what was measured.

    Attributes:
        observed: the measurements.
        start: what was known of the initial state.
        chain: what was simulated.
        state: (2 nv,) initial angles and rates.
        steps: the trajectory at the integrator's instants; one copy.
    """

    observed: Observed
    start: Start
    chain: Chain
    state: Array
    steps: Steps

    @cached_property
    def path(self) -> tuple[Array, Array]:
        """q, v (T, nv) at the recording's instants [rad, rad/s]."""
        q, v = sample(self.steps, self.observed.recording.time)
        return q[:, 0], v[:, 0]

    @cached_property
    def residual(self) -> Array:
        """(N,) measured less simulated, weighted."""
        return self.observed.residual(self.chain, self.path[0])

    @cached_property
    def chi2(self) -> float:
        """Sum of the squared weighted residuals."""
        return float(self.residual @ self.residual)

    @cached_property
    def cost(self) -> float:
        """The residuals' loss and what the initial state adds to it."""
        away = self.start.root @ (self.state - self.start.rest)
        return float(np.sum(self.observed.loss.value(self.residual**2)) + away @ away)

    @cached_property
    def stride(self) -> int:
        """Steps in half an interval over which derivatives are advanced."""
        return half_interval(self.chain, self.observed.recording, self.steps.step)

    @cached_property
    def basis(self) -> Basis:
        """The m modes that its derivatives are told in."""
        return Basis.of(self.chain, self.observed.recording, 2 * self.stride * self.steps.step)

    def rows(self, moved: Sequence[Moved]) -> Iterator[tuple[Array, Array]]:
        """Derivatives (r, 2 m + p) of the weighted predictions, and the residuals (r,), as the loss lets them count."""
        parts = jacobian(self.observed, self.chain, self.basis, moved, self.steps, self.stride)
        kept = np.sqrt(self.observed.loss.slope(self.residual**2))
        for markers, angles, part in parts:
            share = np.concatenate([kept[markers], kept[angles]])
            yield share[:, None] * part, share * np.concatenate([self.residual[markers], self.residual[angles]])

    def triangle(self, moved: Sequence[Moved] = ()) -> Triangle:
        """The linearised least-squares problem: modes' initial coordinates and rates first, then p parameters."""
        states = self.basis.states
        columns = states.shape[1] + len(moved)
        root = np.zeros((self.state.size, columns))
        root[:, : states.shape[1]] = self.start.root @ states
        gathered = Triangle.of(self.rows(moved), columns)
        return gathered.with_rows(root, self.start.root @ (self.start.rest - self.state))


def run_all(
    chains: Sequence[Chain],
    observed: Sequence[Observed],
    starts: Sequence[Start],
    states: Sequence[Array],
    coarse: float,
) -> list[Run]:
    """Simulate several recordings together.

    Args:
        chains: one a recording.
        observed, starts: the recordings.
        states: (2 nv,) initial states.
        coarse: multiple of the default step.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    recordings = [each.recording for each in observed]
    n = chains[0].size
    first = np.stack(states)
    steps = rollouts(chains, recordings, first[:, :n], first[:, n:], coarse=coarse)
    return [Run(*each) for each in zip(observed, starts, chains, states, steps, strict=True)]


def replays(
    chain: Chain,
    rig: Rig,
    recordings: Sequence[Recording],
    marker_noise: float,
    encoder_noise: float,
) -> list[Replay]:
    """Simulate recordings open loop from their most likely initial states (Levenberg-Marquardt from rest).

    Args:
        chain: the arm.
        rig: says where the markers are.
        recordings: what was measured, and the torques.
        marker_noise: 1-sigma [m].
        encoder_noise: 1-sigma [rad].

    Raises:
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: the chain's simulation diverges even from rest.
    """
    observed = [Observed.of(rig, recording, marker_noise, encoder_noise) for recording in recordings]
    return [report(run, converged) for run, converged in most_likely(chain, observed)]


def replay(chain: Chain, rig: Rig, recording: Recording, marker_noise: float, encoder_noise: float) -> Replay:
    """The same of a single recording."""
    return replays(chain, rig, [recording], marker_noise, encoder_noise)[0]


@dataclass
class _Search:
    """One recording's way to its most likely initial state."""

    run: Run
    damping: float = 0.0
    triangle: Triangle | None = None
    converged: bool = False

    def proposal(self) -> Array | None:
        """The next state to try; None once nothing is to be gained."""
        if self.triangle is None:
            self.triangle = self.run.triangle()
        step = self.triangle.damped(self.damping).best()
        if self.triangle.decrease(step) < max(_TOLERANCE * self.run.chi2, _NEGLIGIBLE):
            self.converged = True
            return None
        return self.run.state + self.run.basis.states @ step

    def judge(self, trial: Run | None) -> None:
        """Go there if it is better."""
        if trial is not None and trial.cost < self.run.cost:
            self.run, self.triangle = trial, None
            self.damping = self.damping / 10 if self.damping > _FIRST_DAMPING else 0.0
        else:
            self.damping = max(10 * self.damping, _FIRST_DAMPING)


def most_likely(
    chain: Chain, observed: Sequence[Observed], states: Sequence[Array] | None = None, coarse: float = 1.0
) -> list[tuple[Run, bool]]:
    """Each recording's run from its most likely initial state, and whether the search for it converged.

    Args:
        chain: the arm.
        observed: the recordings.
        states: (2 nv,) where to start; None: at rest.
        coarse: multiple of the default step.
    """
    starts = [Start.of(chain, each.recording) for each in observed]
    first = [start.rest for start in starts] if states is None else states
    runs = run_all([chain] * len(observed), observed, starts, first, coarse)
    searches = [_Search(run) for run in runs]
    for _ in range(_MOST_ITERATIONS):
        proposals = [(search, search.proposal()) for search in searches if not search.converged]
        pending = [(search, state) for search, state in proposals if state is not None]
        if not pending:
            break
        for (search, _), trial in zip(pending, _attempts(chain, pending, coarse), strict=True):
            search.judge(trial)
    return [(search.run, search.converged) for search in searches]


def _attempts(chain: Chain, pending: Sequence[tuple[_Search, Array]], coarse: float) -> list[Run | None]:
    """Runs from the proposed states; None where one diverges."""
    parts = [(search.run.observed, search.run.start, state) for search, state in pending]
    try:
        return list(run_all([chain] * len(parts), *map(list, zip(*parts, strict=True)), coarse))  # type: ignore[arg-type]
    except SimulationDivergedError:
        if len(parts) == 1:
            return [None]
        return [_attempts(chain, [each], coarse)[0] for each in pending]


def report(run: Run, converged: bool) -> Replay:
    """A run as its user sees it."""
    recording, chain = run.observed.recording, run.chain
    q, v = run.path
    simulation = Simulation(recording.time, q, v, q[:, chain.active], run.observed.arcs.markers(chain, q))
    split = run.observed.markers.size
    off = run.observed.values - run.observed.predicted(chain, q)
    counted = run.observed.weights > 0
    markers, angles = off[:split][counted[:split]], off[split:][counted[split:]]
    return Replay(
        simulation=simulation,
        chi2=run.chi2,
        count=run.observed.count,
        marker_rms=float(np.sqrt(np.mean(markers**2))) if markers.size else float("nan"),
        theta_rms=float(np.sqrt(np.mean(angles**2))) if angles.size else None,
        status="converged" if converged else "not converged",
    )
