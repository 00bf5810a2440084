"""Design of the next experiment: the recording that best discriminates between models that fit equally well.

Changed versions of the recordings are simulated by both models. The second is fitted to the first one's simulation, its
parameters having the covariance that the recordings so far give them; the chi^2 that this fit leaves is the difference
to be expected (T-optimal discrimination: Atkinson and Fedorov, Biometrika 62, 1975; here linearised).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import linalg

from vjm.diagnosis.candidate_fit import information_of
from vjm.diagnosis.records import Proposal
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.trajectory_fit import TrajectoryFit
from vjm.records import REFERENCE, Array, Indices, Recording
from vjm.simulation.run import InitialStatePrior, Run, linearize, simulate_runs

# Maps a recording, its initial state (2 nv,) and the indices of active coordinates to the changed recording and state.
_Change = Callable[[Recording, Array, Indices], tuple[Recording, Array]]


def propose_recordings(best: TrajectoryFit, alternatives: Sequence[TrajectoryFit]) -> tuple[Proposal, ...]:
    """Rank changed recordings by the chi^2 of the nearest alternative, if the best model is true; the largest first."""
    proposals = []
    for text, change in _changes(best):
        for run in _largest_motions(best):
            difference = min((_difference(best, alternative, run, change) for alternative in alternatives), default=0.0)
            proposals.append(Proposal(f"repeat {run.observed.recording.file} {text}", difference))
    return tuple(sorted(proposals, key=lambda proposal: -proposal.difference))


def _changes(best: TrajectoryFit) -> Iterator[tuple[str, _Change]]:
    """Yield changes to try, each in words and as a function."""
    chain = best.point.chain
    mass = float(f"{0.1 * sum(link.masses.sum() for link in chain.links):.1g}")  # a tenth of the arm's, rounded
    yield (
        f"with a known mass of {1e3 * mass:.3g} g on the tip",
        lambda recording, state, active: (replace(recording, payload=recording.payload + mass), state),
    )
    yield "at twice the amplitude", partial(_scaled, 2.0)
    yield "at half the amplitude", partial(_scaled, 0.5)
    if chain.active.size:
        yield "from a joint angle 90° away", _turned


def _scaled(factor: float, recording: Recording, state: Array, active: Indices) -> tuple[Recording, Array]:
    """Return the recording and its initial state with torques and motion scaled, from the same joint angles.

    Joints of a given motion turn with scaled accelerations.
    """
    scaled = factor * state
    scaled[active] = state[active]
    given = recording.acceleration
    return replace(
        recording, tau=factor * recording.tau, acceleration=None if given is None else factor * given
    ), scaled


def _turned(recording: Recording, state: Array, active: Indices) -> tuple[Recording, Array]:
    """Return the recording and its initial state with the first joint turned by 90 degrees."""
    theta, turned = recording.theta.copy(), state.copy()
    theta[:, 0] += np.pi / 2
    turned[active[0]] += np.pi / 2
    return replace(recording, theta=theta), turned


def _largest_motions(best: TrajectoryFit) -> list[Run]:
    """Return the driven recording and the decay with the largest motion, reference recordings excluded."""
    changed = [run for run in best.point.runs if run.observed.recording.condition != REFERENCE]
    changed.sort(key=lambda run: float(np.nansum(np.nanvar(run.observed.recording.markers, axis=0))))
    largest = {run.observed.recording.kind: run for run in changed}  # the last of each kind
    return [run for kind, run in largest.items() if kind in ("driven", "decay")]


def _difference(true: TrajectoryFit, candidate: TrajectoryFit, run: Run, change: _Change) -> float:
    """Return the chi^2 of another model refitted to what a true one simulates; zero if either diverges."""
    file = run.observed.recording.file
    other = next((other for other in candidate.point.runs if other.observed.recording.file == file), None)
    if other is None:  # it diverges over the recording itself
        return 0.0
    try:
        shown, predicted = _changed_run(true, run, change), _changed_run(candidate, other, change)
        moved = replace(candidate.point.problem, observed=(predicted.observed,)).perturbed_arms(candidate.point.x)[0]
        states = 2 * predicted.basis.slow_count  # columns of the initial state, before those of the parameters
        slopes = np.zeros((predicted.residual.size, states + len(moved)))
        (linearization,) = linearize([predicted], [moved])
        for measured, part in predicted.jacobian(linearization):
            slopes[measured] = part
    except (SimulationDivergedError, InsufficientDataError):
        return 0.0
    values, vectors = linalg.eigh(information_of(candidate).normal)
    prior = np.zeros((len(moved), slopes.shape[1]))  # root of the information that the recordings so far give
    prior[:, states:] = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    rows = np.vstack([slopes, prior])
    difference = np.concatenate([predicted.residual - shown.residual, np.zeros(len(moved))])
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    fitted = (rows / scale) @ np.linalg.lstsq(rows / scale, difference, rcond=1e-10)[0]
    return float(np.sum((difference - fitted) ** 2))


def _changed_run(model: TrajectoryFit, run: Run, change: _Change) -> Run:
    """Simulate a changed version of a model's recording."""
    point = model.point
    recording, state = change(run.observed.recording, run.state, run.chain.active)
    (arm,) = point.problem.arms(point.x, [recording])
    observed, prior = run.observed.of_recording(recording), InitialStatePrior.of(arm, recording)
    return simulate_runs([arm], [observed], [prior], [state], 1.0)[0]
