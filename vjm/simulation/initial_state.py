"""Maximum-likelihood initial states of recordings, and simulations from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from vjm.effects.effect import is_nonsmooth
from vjm.errors import SimulationDivergedError
from vjm.records import Array
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import LevenbergMarquardt, SquareRootInformation, Status, Step, minimise
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run, earlier_runs, linearize_by_states, simulate_runs, state_at
from vjm.simulation.system import Trajectory

# Multiple of the integrator's default step for a first search where an arm has elbows. Markers are then right to a
# tenth of a millimetre: enough for steps towards the most likely initial state.
_COARSE_STEP_MULTIPLE = 4.0
MOST_TRIALS = 20  # simulations of a search for an initial state that starts anywhere
FEW_TRIALS = 4  # simulations by which a state comes near the most likely one, if it starts from near there
_FEW_STEPS = 3  # a search that starts near its minimum arrives in so many, or shows that it hardly gains
# Levenberg-Marquardt dampings that are tried together where joints stick, a factor of ten apart: from one that shortens
# no more than what is hardly measured to one that shortens all.
_DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
_RELATIVE_TOLERANCE = 1e-4  # relative decrease of chi^2 below which the search ends


def _state_at_rest(arm: Arm, observed: Observations, prior: InitialStatePrior) -> Array:
    """Return the state at rest (2 nv,) that fits a recording best if nothing moves in it.

    The angles of active joints and of links' roots are fitted by least squares; virtual joints stay at their angles of
    rest. Effects then correct angles at which they would not let the arm stand.
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


def simulate_from_best_states(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    priors: Sequence[InitialStatePrior],
    states: Sequence[Array],
    others: Sequence[Array],
    step_multiple: float,
) -> list[Run]:
    """Simulate recordings from given initial states; quiet ones of nonsmooth arms from the best of three.

    With stick-slip or play the likelihood of the initial state has several maxima. In a quiet recording the state at
    rest and another state are therefore tried beside the given one, and the run with the lowest cost is returned.

    Args:
        arms, observed, priors, step_multiple: as of `simulate_runs`.
        states: (2 nv,) initial state of each recording.
        others: (2 nv,) the other state to try for each recording, such as that of the iterate before.
    """
    quiet = [k for k, arm in enumerate(arms) if is_nonsmooth(arm.effects) and observed[k].recording.kind == "quiet"]
    trials = [(k, _state_at_rest(arms[k], observed[k], priors[k])) for k in quiet]
    trials += [(k, others[k]) for k in quiet if others[k] is not states[k]]
    indices = [*range(len(arms)), *(k for k, _ in trials)]
    runs = simulate_runs(
        [arms[k] for k in indices],
        [observed[k] for k in indices],
        [priors[k] for k in indices],
        [*states, *(state for _, state in trials)],
        step_multiple,
    )
    best = runs[: len(arms)]
    for (k, _), run in zip(trials, runs[len(arms) :], strict=True):
        best[k] = min(best[k], run, key=lambda run: run.cost)
    return best


def backtrack(runs: Sequence[Run], changes: Sequence[Array], step_multiple: float) -> list[Run]:
    """Backtrack along the last changes (2 nv,) of runs' initial states: keep all of a change, a fifth or none.

    Return for each run the one of the three simulations with the lowest cost.

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


def damped_states(run: Run, linearized: SquareRootInformation, change: Array) -> list[Array]:
    """Return the states (2 nv,) to which damped steps lead, the longest first; arguments as of `best_damped`."""
    count = linearized.columns - change.size
    steps = [linearized.damped(damping).solve(count, change) for damping in _DAMPINGS]
    return [run.state + run.basis.states @ step for step in steps]


def best_damped(
    trials: Sequence[Run],
    runs: Sequence[Run],
    linearized: Sequence[SquareRootInformation],
    change: Array,
    step_multiple: float,
) -> list[Run]:
    """Return for each recording the best of a trial and of simulations from states to which damped steps lead.

    A long motion that sticks follows its linear model over short steps only, and what hardly shows in it makes a step
    long. Which damping that takes differs from one recording to the next; all are tried at once, which is faster than
    one after another.

    Args:
        trials: with the step that was not damped.
        runs: those from which the steps are taken.
        linearized: problems of their initial states and coordinates there.
        change: (p,) change of the coordinates, none where the problems are of initial states alone.
        step_multiple: multiple of the integrator's default step.
    """
    if not trials:
        return []
    pairs = zip(runs, linearized, strict=True)
    states = [state for run, problem in pairs for state in damped_states(run, problem, change)]
    count = len(_DAMPINGS)
    try:
        damped = _simulate_again([trial for trial in trials for _ in _DAMPINGS], states, step_multiple)
    except SimulationDivergedError:
        return [*trials]
    return [
        min([trial, *damped[k * count : (k + 1) * count]], key=lambda run: run.cost) for k, trial in enumerate(trials)
    ]


def refine_initial_states(
    runs: Sequence[Run], target_costs: Sequence[float], before: Sequence[Run], step_multiple: float
) -> list[Run]:
    """Refine the initial states of runs by a few Levenberg-Marquardt steps; return the best runs found.

    A run that stays above its target cost may be at a local minimum. It is also started at rest, and from the state at
    which the preceding segment of its recording ends (multistart).

    Args:
        runs: those to be improved.
        target_costs: cost that each should have at most.
        before: runs of all segments at the iterate before, which give the preceding segments' final states.
        step_multiple: multiple of the integrator's default step.
    """
    best = _continue_search(runs, step_multiple)
    trials = []
    for k, (run, cost) in enumerate(zip(best, target_costs, strict=True)):
        if run.cost > cost:
            earlier = earlier_runs(before, run.observed)
            trials += [(k, run.prior.rest), *([(k, state_at(earlier, run.observed))] if earlier else [])]
    if trials:
        try:
            restarted = _simulate_again([best[k] for k, _ in trials], [state for _, state in trials], step_multiple)
        except SimulationDivergedError:
            return best
        for (k, _), run in zip(trials, _continue_search(restarted, step_multiple), strict=True):
            best[k] = min(best[k], run, key=lambda run: run.cost)
    return best


def _continue_search(runs: Sequence[Run], step_multiple: float) -> list[Run]:
    """Continue the search for each run's initial state for a few steps; return the better of old and new runs."""
    searches = [_InitialStateSearch(run) for run in runs]
    minimise(searches, lambda running: _trial_runs(running, step_multiple), _FEW_STEPS, linearize_by_states)
    new_runs = [search.point.with_prior_scale(run.prior.scale) for search, run in zip(searches, runs, strict=True)]
    return [min(pair, key=lambda run: run.cost) for pair in zip(runs, new_runs, strict=True)]


def _simulate_again(runs: Sequence[Run], states: Sequence[Array], step_multiple: float) -> list[Run]:
    """Simulate the recordings of some runs again, from other initial states (2 nv,)."""
    arms, observed, priors = zip(*((run.arm, run.observed, run.prior) for run in runs), strict=True)
    return simulate_runs(arms, observed, priors, states, step_multiple)


@dataclass(frozen=True)
class _InitialStateStep(Step):
    """Step of the search for an initial state.

    Attributes:
        state: (2 nv,) initial state to which it leads.
    """

    state: Array


class _InitialStateSearch(LevenbergMarquardt[Run, _InitialStateStep]):
    """Search for one recording's most likely initial state."""

    def step_at(self, damping: float) -> _InitialStateStep:
        linearized = self.point.linearized_by_state
        change = linearized.damped(damping).best()
        length = float(np.linalg.norm(linearized.scale * change))
        return _InitialStateStep(
            linearized.decrease(change), length, self.point.state + self.point.basis.states @ change
        )

    def stopping_rule(self) -> Status:
        # A hundredth of chi^2 is a tenth of a standard deviation of the state.
        if self.step.predicted < max(_RELATIVE_TOLERANCE * self.point.chi2, 1e-2):
            return "converged"
        # Where the model itself is wrong, no initial state brings chi^2 down to the noise: the last steps together must
        # take off 1 % of the excess, which is 0.5 % of the RMS residual.
        recent = [decrease for decrease in self.decreases if decrease > 0][-_FEW_STEPS:]
        excess = self.point.chi2 - self.point.expected_chi2
        return "stopped" if len(recent) == _FEW_STEPS and sum(recent) < 0.01 * excess else "running"

    def is_nonsmooth_minimum(self, trial: Run | None) -> bool:
        recent = self.decreases[-(_FEW_STEPS + 1) :]
        nonsmooth = is_nonsmooth(self.point.arm.effects)
        return nonsmooth and len(recent) > _FEW_STEPS and sum(recent) < _RELATIVE_TOLERANCE * self.point.cost


def fit_initial_states(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    states: Sequence[Array | None] | None = None,
    step_multiple: float = 1.0,
    max_trials: int = MOST_TRIALS,
    deadline: float = np.inf,
) -> list[tuple[Run, bool]]:
    """Estimate each recording's initial state by maximum likelihood; return its run, and whether the search converged.

    Args:
        arms: one a recording.
        observed: the recordings.
        states: (2 nv,) where to start (Levenberg-Marquardt); None: at rest.
        step_multiple: multiple of the integrator's default step.
        max_trials: number of simulations at most.
        deadline: reading of `time.monotonic` after which each search ends where it stands [s].

    Raises:
        InsufficientDataError: no torque measured at an active joint.
        SimulationDivergedError: a simulation diverges even from its start.
    """
    if step_multiple < _COARSE_STEP_MULTIPLE and arms[0].chain.elbows.size:
        states, max_trials = _states_by_long_steps(arms, observed, states, max_trials, deadline)
    priors = [InitialStatePrior.of(arm, values.recording) for arm, values in zip(arms, observed, strict=True)]
    initial = [None] * len(priors) if states is None else states
    starts = [prior.rest if state is None else state for prior, state in zip(priors, initial, strict=True)]
    runs = simulate_runs(arms, observed, priors, starts, step_multiple)
    searches = [_InitialStateSearch(run.with_scaled_prior()) for run in runs]
    minimise(searches, lambda running: _trial_runs(running, step_multiple), max_trials, linearize_by_states, deadline)
    return [(search.point, search.status == "converged") for search in searches]


def best_of_starts(
    runs: Sequence[Run], starts: Sequence[tuple[int, Array]], step_multiple: float, deadline: float = np.inf
) -> list[Run]:
    """Return runs, each the best of itself and of short searches that start from other states (multistart).

    Args:
        runs: of recordings or segments.
        starts: index of a run and the state (2 nv,) from which to start instead, as often as wanted. If a simulation
            from one of them diverges, the runs are returned as they are.
        step_multiple, deadline: as of `fit_initial_states`.
    """
    best = [*runs]
    if not starts:
        return best
    arms, observed = zip(*((runs[k].arm, runs[k].observed) for k, _ in starts), strict=True)
    try:
        found = fit_initial_states(arms, observed, [state for _, state in starts], step_multiple, FEW_TRIALS, deadline)
    except SimulationDivergedError:
        return best
    for (k, _), (run, _) in zip(starts, found, strict=True):
        best[k] = min(best[k], run, key=lambda run: run.cost)
    return best


def _states_by_long_steps(
    arms: Sequence[Arm],
    observed: Sequence[Observations],
    states: Sequence[Array | None] | None,
    max_trials: int,
    deadline: float,
) -> tuple[list[Array | None], int]:
    """Fill in missing initial states (2 nv,) by a search with long integrator steps.

    Also return the number of simulations that the search with short steps then needs at most: a quarter, as it only
    refines what the first one found.
    """
    filled: list[Array | None] = [None] * len(arms) if states is None else [*states]
    unknown = [k for k, state in enumerate(filled) if state is None]
    if not unknown:
        return filled, max_trials
    try:
        fits = fit_initial_states(
            [arms[k] for k in unknown],
            [observed[k] for k in unknown],
            None,
            _COARSE_STEP_MULTIPLE,
            max_trials,
            deadline,
        )
    except SimulationDivergedError:  # the steps are too long
        return filled, max_trials
    for k, (run, _) in zip(unknown, fits, strict=True):
        filled[k] = run.state
    return filled, max(1, max_trials // 4)


def _trial_runs(
    searches: Sequence[LevenbergMarquardt[Run, _InitialStateStep]], step_multiple: float
) -> list[Run | None]:
    """Simulate each search's proposed step, shortened where joints stick; None in place of a run that diverges."""
    try:
        runs, states = [search.point for search in searches], [search.step.state for search in searches]
        trials = _simulate_again(runs, states, step_multiple)
    except SimulationDivergedError:
        if len(searches) == 1:
            return [None]
        return [_trial_runs([search], step_multiple)[0] for search in searches]
    short = [
        k
        for k, (search, trial) in enumerate(zip(searches, trials, strict=True))
        if trial.arm.has_dry_friction and search.point.cost - trial.cost < search.step.predicted / 2
    ]
    linearized = [runs[k].linearized_by_state for k in short]
    best = best_damped([trials[k] for k in short], [runs[k] for k in short], linearized, np.zeros(0), step_multiple)
    replaced = dict(zip(short, best, strict=True))
    return [replaced.get(k, trial) for k, trial in enumerate(trials)]
