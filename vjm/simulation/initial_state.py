"""Most likely initial states of recordings, and simulations from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from vjm.effects.effect import is_nonsmooth
from vjm.errors import SimulationDivergedError
from vjm.records import Array
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import LevenbergMarquardt, Status, Step, minimise
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run, earlier_runs, linearize_by_states, simulate_runs, state_at
from vjm.simulation.system import Trajectory

# Multiple of the default step of arms with elbows, with which markers are right to a tenth of a millimetre: enough for
# steps towards the most likely initial state.
_COARSE = 4.0
_FEW_STEPS = 3  # in which a search near its end arrives, or shows that it hardly gains
_TOLERANCE = 1e-4  # relative decrease of chi^2 that is not worth another step


def _state_at_rest(arm: Arm, observed: Observations, prior: InitialStatePrior) -> Array:
    """Return the (2 nv,) state at rest that explains a recording best if nothing moves in it.

    Links and springs are as they are at rest; active joints and links' roots stand where the least-squares fit of the
    recording puts them, and where effects let them stay.
    """
    n = arm.chain.size
    fitted = np.concatenate([arm.chain.active, arm.chain.roots]).astype(int)
    rest, time, weight = prior.rest[:n], observed.recording.time, prior.sqrt_information[:n, :n]

    def angles(change: Array) -> Array:
        q = rest.copy()
        q[fitted] += change
        return q

    def residual(change: Array) -> Array:
        q = angles(change)
        return np.concatenate([observed.residual(arm, Trajectory.at_rest(time, q)), weight @ (rest - q)])

    change = least_squares(residual, np.zeros(fitted.size), ftol=1e-12, xtol=1e-12).x if fitted.size else np.zeros(0)
    return np.concatenate([arm.rest_angles(angles(change)), np.zeros(n)])


def simulate_or_rest(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    priors: Sequence[InitialStatePrior],
    states: Sequence[Array],
    known: Sequence[Array],
    step_multiple: float,
) -> list[Run]:
    """Simulate recordings; quiet ones of arms that stick or rattle from the best of three initial states.

    Args:
        arms, observed, priors, step_multiple: as of `simulate_runs`.
        states: (2 nv,) initial states; a quiet recording's may also be the state at rest.
        known: (2 nv,) further initial states of quiet recordings.
    """
    quiet = [k for k, arm in enumerate(arms) if is_nonsmooth(arm.effects) and observed[k].recording.kind == "quiet"]
    further = [(k, _state_at_rest(arms[k], observed[k], priors[k])) for k in quiet]
    further += [(k, known[k]) for k in quiet if known[k] is not states[k]]
    indices = [*range(len(arms)), *(k for k, _ in further)]
    runs = simulate_runs(
        [arms[k] for k in indices],
        [observed[k] for k in indices],
        [priors[k] for k in indices],
        [*states, *(state for _, state in further)],
        step_multiple,
    )
    best = runs[: len(arms)]
    for (k, _), run in zip(further, runs[len(arms) :], strict=True):
        best[k] = min(best[k], run, key=lambda run: run.cost)
    return best


def backtrack(runs: Sequence[Run], changes: Sequence[Array], step_multiple: float) -> list[Run]:
    """Simulate runs with a fifth of the changes (2 nv,) of their initial states, or none; return the best of the three.

    Raises:
        SimulationDivergedError: one of them diverged.
    """
    if not runs:
        return []
    shares = (0.2, 0.0)
    states = [run.state - (1 - share) * change for run, change in zip(runs, changes, strict=True) for share in shares]
    trials = _simulate_again([run for run in runs for _ in shares], states, step_multiple)
    groups = zip(runs, trials[0::2], trials[1::2], strict=True)
    return [min(group, key=lambda run: run.cost) for group in groups]


def refine_initial_states(
    runs: Sequence[Run], wanted: Sequence[float], before: Sequence[Run], step_multiple: float
) -> list[Run]:
    """Return runs from more likely initial states, if a few simulations find any.

    Those that stay far from what was wanted may be at a minimum from which no slope leads away, and are also begun at
    rest, and where the same recording's segment before ends.

    Args:
        runs: those to be improved.
        wanted: cost that each should have at most.
        before: simulations of the same recordings.
        step_multiple: multiple of the default step.
    """
    best = _search_on(runs, step_multiple)
    trials = []
    for k, (run, cost) in enumerate(zip(best, wanted, strict=True)):
        if run.cost > cost:
            earlier = earlier_runs(before, run.observed)
            trials += [(k, run.prior.rest), *([(k, state_at(earlier, run.observed))] if earlier else [])]
    if trials:
        try:
            others = _simulate_again([best[k] for k, _ in trials], [state for _, state in trials], step_multiple)
        except SimulationDivergedError:
            return best
        for (k, _), run in zip(trials, _search_on(others, step_multiple), strict=True):
            best[k] = min(best[k], run, key=lambda run: run.cost)
    return best


def _search_on(runs: Sequence[Run], step_multiple: float) -> list[Run]:
    """Search for more likely initial states for a few simulations, beside the same priors."""
    searches = [_InitialStateSearch(run) for run in runs]
    minimise(searches, lambda running: _attempts(running, step_multiple), _FEW_STEPS, linearize_by_states)
    found = [search.point.with_prior_scale(run.prior.scale) for search, run in zip(searches, runs, strict=True)]
    return [min(pair, key=lambda run: run.cost) for pair in zip(runs, found, strict=True)]


def _simulate_again(runs: Sequence[Run], states: Sequence[Array], step_multiple: float) -> list[Run]:
    """Runs of the same recordings from other initial states."""
    arms, observed, priors = zip(*((run.arm, run.observed, run.prior) for run in runs), strict=True)
    return simulate_runs(arms, observed, priors, states, step_multiple)


@dataclass(frozen=True)
class _StateStep(Step):
    """Step to another initial state (2 nv,)."""

    state: Array


class _InitialStateSearch(LevenbergMarquardt[Run, _StateStep]):
    """Search for one recording's most likely initial state."""

    def step_at(self, damping: float) -> _StateStep:
        linearized = self.point.linearized_by_state
        change = linearized.damped(damping).best()
        length = float(np.linalg.norm(linearized.scale * change))
        return _StateStep(linearized.decrease(change), length, self.point.state + self.point.basis.states @ change)

    def stopping_rule(self) -> Status:
        # A hundredth of chi^2 is a tenth of a standard deviation of the state.
        if self.step.predicted < max(_TOLERANCE * self.point.chi2, 1e-2):
            return "converged"
        # Where a model misses its recording, steps that lower a hundredth of what it misses change the RMS residual by
        # half a per cent.
        recent = [decrease for decrease in self.decreases if decrease > 0][-_FEW_STEPS:]
        missed = self.point.chi2 - self.point.expected_chi2
        return "stopped" if len(recent) == _FEW_STEPS and sum(recent) < 0.01 * missed else "running"

    def is_rough_minimum(self, trial: Run | None) -> bool:
        recent = self.decreases[-4:]
        rough = is_nonsmooth(self.point.arm.effects)
        return rough and len(recent) == 4 and sum(recent) < _TOLERANCE * self.point.cost


def fit_initial_states(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    states: Sequence[Array | None] | None = None,
    step_multiple: float = 1.0,
    most: int = 20,
) -> list[tuple[Run, bool]]:
    """Return each recording's run from its most likely initial state, and whether the search for it converged.

    Args:
        arms: one a recording.
        observed: the recordings.
        states: (2 nv,) where to start (Levenberg-Marquardt); None: at rest.
        step_multiple: multiple of the default step.
        most: simulations to try.

    Raises:
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: a simulation diverges even from its start.
    """
    if step_multiple < _COARSE and arms[0].chain.elbows.size:
        states, most = _approximate_states(arms, observed, states, most)
    priors = [InitialStatePrior.of(arm, values.recording) for arm, values in zip(arms, observed, strict=True)]
    given = [None] * len(priors) if states is None else states
    first = [prior.rest if state is None else state for prior, state in zip(priors, given, strict=True)]
    runs = simulate_runs(arms, observed, priors, first, step_multiple)
    searches = [_InitialStateSearch(run.with_scaled_prior()) for run in runs]
    minimise(searches, lambda running: _attempts(running, step_multiple), most, linearize_by_states)
    return [(search.point, search.status == "converged") for search in searches]


def _approximate_states(
    arms: Sequence[Arm], observed: Sequence[Observations], states: Sequence[Array | None] | None, most: int
) -> tuple[list[Array | None], int]:
    """States (2 nv,) near which to look for the most likely ones, and how many simulations to try there.

    Where no states are given, they are those found with long steps: what these did not find, short ones will not.
    """
    found: list[Array | None] = [None] * len(arms) if states is None else [*states]
    unknown = [k for k, state in enumerate(found) if state is None]
    if not unknown:
        return found, most
    try:
        fits = fit_initial_states([arms[k] for k in unknown], [observed[k] for k in unknown], None, _COARSE, most)
    except SimulationDivergedError:  # the steps are too long
        return found, most
    for k, (run, _) in zip(unknown, fits, strict=True):
        found[k] = run.state
    return found, max(1, most // 4)


def _attempts(searches: Sequence[LevenbergMarquardt[Run, _StateStep]], step_multiple: float) -> list[Run | None]:
    """Runs from the states that steps lead to; None where one diverges."""
    try:
        runs, states = [search.point for search in searches], [search.step.state for search in searches]
        return [*_simulate_again(runs, states, step_multiple)]
    except SimulationDivergedError:
        if len(searches) == 1:
            return [None]
        return [_attempts([search], step_multiple)[0] for search in searches]
