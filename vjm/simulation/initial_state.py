"""Replay: an open-loop simulation whose initial state, and nothing else, is estimated from the recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vjm.effects.effect import is_nonsmooth
from vjm.errors import SimulationDivergedError
from vjm.records import Array, Recording, Rig, SimulatedRecording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import simulation
from vjm.simulation.integrators import still
from vjm.simulation.least_squares import Damping, SquareRootInformation
from vjm.simulation.measurement import Observed
from vjm.simulation.run import Run, Start, run_all

_ITERATIONS = 3  # markers are nearly linear in such small angles
_STEP = 1e-6  # rad
_NEARER = 0.2, 0.0  # parts of what a state was changed by


def state_at_rest(arm: Arm, observed: Observed, start: Start) -> Array:
    """(2 nv,) the state at rest that explains a recording best if nothing moves in it.

    Link and springs are as they are at rest; joints that motors turn, and those at links' roots, stand where they are
    seen, and where effects let them stay.
    """
    chain, n = arm.chain, arm.chain.size
    loose = np.concatenate([chain.active, chain.roots]).astype(int)
    rest, time = start.rest[:n], observed.recording.time

    def off(q: Array) -> Array:
        return np.concatenate([observed.residual(arm, still(time, q)), start.root[:n, :n] @ (rest - q)])

    q = rest.copy()
    for _ in range(_ITERATIONS if loose.size else 0):
        here = off(q)
        slopes = np.column_stack([(here - off(q + _STEP * np.eye(n)[k])) / _STEP for k in loose])
        q[loose] += np.linalg.lstsq(slopes, here, rcond=None)[0]
    return np.concatenate([arm.rest_state(q), np.zeros(n)])


def run_or_rest(
    arms: Sequence[Arm],
    observed: Sequence[Observed],
    starts: Sequence[Start],
    states: Sequence[Array],
    known: Sequence[Array],
    step_multiple: float,
) -> list[Run]:
    """Simulate recordings as `run_all`; arms that stick or rattle, where they are quiet, from the best of three states.

    Args:
        arms, observed, starts, coarse: as of `run_all`.
        states: (2 nv,) where to begin; a quiet recording also where it stands.
        known: (2 nv,) where else a quiet recording may begin.
    """
    quiet = [k for k, arm in enumerate(arms) if is_nonsmooth(arm.effects) and observed[k].recording.kind == "quiet"]
    further = [(k, state_at_rest(arms[k], observed[k], starts[k])) for k in quiet]
    further += [(k, known[k]) for k in quiet if known[k] is not states[k]]
    every = [*range(len(arms)), *(k for k, _ in further)]
    runs = run_all(
        [arms[k] for k in every],
        [observed[k] for k in every],
        [starts[k] for k in every],
        [*states, *(state for _, state in further)],
        step_multiple,
    )
    found = runs[: len(arms)]
    for (k, _), run in zip(further, runs[len(arms) :], strict=True):
        found[k] = min(found[k], run, key=lambda each: each.cost)
    return found


def backtrack(runs: Sequence[Run], changes: Sequence[Array], step_multiple: float) -> list[Run]:
    """Begin recordings with a part of a change or without it, where that follows them better.

    Args:
        runs: with the whole of the change.
        changes: (2 nv,) of each initial state.
        step_multiple: multiple of the default step.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    if not runs:
        return []
    every = [run for run in runs for _ in _NEARER]
    states = [run.state - (1 - part) * by for run, by in zip(runs, changes, strict=True) for part in _NEARER]
    found = run_all(
        [run.arm for run in every], [run.observed for run in every], [run.start for run in every], states, step_multiple
    )
    tries = len(_NEARER)
    return [min(run, *found[k * tries : (k + 1) * tries], key=lambda each: each.cost) for k, run in enumerate(runs)]


_MOST_ITERATIONS = 20
_TOLERANCE = 1e-4  # relative decrease of chi^2 that is not worth another step
_IN_VAIN = 4  # steps that gain no more than that, after which none does where something held sticks or rattles
_NEGLIGIBLE = 1e-2  # decrease of chi^2: what is left is a tenth of a standard deviation of the state


def replays(
    arms: Sequence[Arm],
    rig: Rig,
    recordings: Sequence[Recording],
    marker_noise: float,
    encoder_noise: float,
    states: Sequence[Array | None] | None = None,
    step_multiple: float = 1.0,
) -> list[SimulatedRecording]:
    """Simulate recordings open loop from their most likely initial states (Levenberg-Marquardt from rest).

    Args:
        arms: one a recording.
        rig: says where the markers are.
        recordings: what was measured, and the torques.
        marker_noise: 1-sigma [m].
        encoder_noise: 1-sigma [rad].
        states: (2 nv,) where to start the search for the initial states; None: at rest.
        step_multiple: multiple of the integrator's default step.

    Raises:
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: the chain's simulation diverges even from rest.
    """
    observed = [Observed.of(rig, recording, (marker_noise, encoder_noise)) for recording in recordings]
    return [
        simulated_recording(run, converged) for run, converged in most_likely(arms, observed, states, step_multiple)
    ]


def replay(arm: Arm, rig: Rig, recording: Recording, marker_noise: float, encoder_noise: float) -> SimulatedRecording:
    """The same of a single recording."""
    return replays([arm], rig, [recording], marker_noise, encoder_noise)[0]


class _Search:
    """One recording's way to its most likely initial state."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self.damping = Damping()
        self.linearized: SquareRootInformation | None = None
        self.converged = False
        self.gains = [np.inf] * _IN_VAIN

    def proposal(self) -> Array | None:
        """The next state to try; None once nothing is to be gained."""
        held = self.run.observed.feedback is not None and is_nonsmooth(self.run.arm.effects)
        if held and sum(self.gains[-_IN_VAIN:]) < _TOLERANCE * self.run.cost:
            self.converged = True  # slopes promise more than there is
            return None
        if self.linearized is None:
            self.linearized = self.run.linearized()
        step = self.linearized.damped(self.damping.value).best()
        if self.linearized.decrease(step) < max(_TOLERANCE * self.run.chi2, _NEGLIGIBLE):
            self.converged = True
            return None
        return self.run.state + self.run.basis.states @ step

    def _length(self, damping: float) -> float:
        """Of the step at a damping, in the lengths of the predictions' derivatives."""
        linearized = self.run.linearized() if self.linearized is None else self.linearized
        return float(np.linalg.norm(linearized.scale * linearized.damped(damping).best()))

    def judge(self, trial: Run | None) -> None:
        """Go there if it is better."""
        gain = 0.0 if trial is None else max(self.run.cost - trial.cost, 0.0)
        self.gains.append(gain)
        if trial is not None and gain > 0:
            self.run, self.linearized = trial.weighed(), None
            self.damping = self.damping.better()
        else:
            self.damping = self.damping.worse(self._length)


def most_likely(
    arms: Sequence[Arm],
    observed: Sequence[Observed],
    states: Sequence[Array | None] | None = None,
    step_multiple: float = 1.0,
    most: int = _MOST_ITERATIONS,
) -> list[tuple[Run, bool]]:
    """Each recording's run from its most likely initial state, and whether the search for it converged.

    Args:
        arms: one a recording.
        observed: the recordings.
        states: (2 nv,) where to start; None: at rest.
        step_multiple: multiple of the default step.
        most: simulations to try.
    """
    starts = [Start.of(arm, each.recording) for arm, each in zip(arms, observed, strict=True)]
    given = [None] * len(starts) if states is None else states
    first = [start.rest if state is None else state for start, state in zip(starts, given, strict=True)]
    runs = run_all(arms, observed, starts, first, step_multiple)
    searches = [_Search(run.weighed()) for run in runs]
    for _ in range(most):
        proposals = [(search, search.proposal()) for search in searches if not search.converged]
        pending = [(search, state) for search, state in proposals if state is not None]
        if not pending:
            break
        for (search, _), trial in zip(pending, _attempts(pending, step_multiple), strict=True):
            search.judge(trial)
    return [(search.run, search.converged) for search in searches]


def _attempts(pending: Sequence[tuple[_Search, Array]], step_multiple: float) -> list[Run | None]:
    """Runs from the proposed states; None where one diverges."""
    arms = [search.run.arm for search, _ in pending]
    observed = [search.run.observed for search, _ in pending]
    starts = [search.run.start for search, _ in pending]
    try:
        return [*run_all(arms, observed, starts, [state for _, state in pending], step_multiple)]
    except SimulationDivergedError:
        if len(pending) == 1:
            return [None]
        return [_attempts([each], step_multiple)[0] for each in pending]


def simulated_recording(run: Run, converged: bool) -> SimulatedRecording:
    """Return a run as its user sees it; `converged` says whether its initial state was found."""
    observed = run.observed
    return SimulatedRecording(
        recording=observed.recording,
        simulation=simulation(run.arm, observed.arcs, observed.recording, run.steps),
        noise=observed.noise,
        chi2=run.chi2,
        count=observed.count,
        status="converged" if converged else "not converged",
    )
