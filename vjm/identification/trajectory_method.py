"""The trajectory method: where it starts, what it leaves out, and how many virtual joints explain the recordings."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.identification.parameters import Parametrisation
from vjm.identification.prepare import Data
from vjm.identification.torque_method import (
    START_DAMPING,
    TorqueFit,
    TorqueProblem,
    driven_hubs,
    fit_uniform,
    with_frequencies,
)
from vjm.identification.trajectory_fit import (
    Point,
    TrajectoryFit,
    TrajectoryProblem,
    first_horizon,
    fit_trajectory,
)
from vjm.identification.virtual_joints import JointChoice, choose_virtual_joints
from vjm.records import Array, Experiment, Progress, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.least_squares import Loss
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, simulate_runs, transfer_state
from vjm.simulation.system import Trajectory, measured_torque

_LOST = 10.0  # RMS residual over noise of the first periods beyond which other starts are tried
_EXPLAINED = 0.3  # unless it is less than this share of the motion


def screen_unreliable(
    problem: TrajectoryProblem, likely: Sequence[Array], others: Sequence[Array], progress: Progress | None
) -> TrajectoryFit:
    """The fit to the recordings' first periods that follows them best.

    Args:
        problem: those periods.
        likely: (p,) coordinates to start from, the first of them first, the others by how well they follow.
        others: the same, tried where none of these leads anywhere.
        progress: told (text, done, total) now and then.

    Raises:
        SimulationDivergedError: no start can be simulated.
    """
    fit = _attempted(problem, likely[0], progress)
    if fit is None or fit.point.misfit > _LOST:
        fit = _first(problem, likely, progress)
    if fit is None or fit.point.misfit > max(_LOST, _EXPLAINED * _motion(problem, likely[-1])):
        fit = _first(problem, [*likely, *others], progress)
    # Where nothing runs at all, let the search itself say what is wrong.
    return fit or fit_trajectory(problem, likely[-1], progress)


def _first(problem: TrajectoryProblem, starts: Sequence[Array], progress: Progress | None) -> TrajectoryFit | None:
    """The fit from the likeliest start; from the next ones too, until one misses by little."""
    best: TrajectoryFit | None = None
    ranked = sorted((_misfit_at(problem, x), k) for k, x in enumerate(starts))
    for expected, k in ranked:
        if not np.isfinite(expected) or (best is not None and best.point.misfit < _LOST):
            break
        trial = _attempted(problem, starts[k], progress)
        if trial is not None and (best is None or trial.point.misfit < best.point.misfit):
            best = trial
    return best


def _motion(problem: TrajectoryProblem, x: Array) -> float:
    """RMS of what was measured about the arm's rest, in units of the noise."""
    squares = 0.0
    for seen, arm in zip(problem.observed, problem.arms(x), strict=True):
        rest = InitialStatePrior.of(arm, seen.recording).rest[: arm.chain.size]
        residual = seen.residual(arm, Trajectory.at_rest(seen.recording.time, rest))
        squares += float(residual @ residual)
    return float(np.sqrt(squares / sum(seen.count for seen in problem.observed)))


def _misfit_at(problem: TrajectoryProblem, x: Array) -> float:
    """RMS weighted residual from the most likely initial states at coordinates x; infinite where nothing runs."""
    try:
        found = fit_initial_states(problem.arms(x), problem.observed)
    except SimulationDivergedError:
        return np.inf
    return Point(problem, x, tuple(run for run, _ in found)).misfit


def _attempted(problem: TrajectoryProblem, x: Array, progress: Progress | None) -> TrajectoryFit | None:
    """The fit from there; None where the arm cannot be simulated so."""
    try:
        return fit_trajectory(problem, x, progress, rough=True)
    except SimulationDivergedError:
        return None


_WORTH_A_JOINT = 0.005  # relative fall of the RMS residual
_COARSE = (4.0, 2.0)  # times the integrator's default step
_UNSEEN = 0.01  # chi^2 of the integration error: no direction of the parameters moves by more than its root
_OTHER_STIFFNESS = tuple(float(factor) for factor in np.geomspace(0.25, 4.0, 9))
_MOST_PASSES = 8
_BEYOND = 3  # joints more than the modes' frequencies ask for, at most


@dataclass(frozen=True)
class Search:
    """Fits of one experiment with different numbers of joints.

    Attributes:
        experiment, data: what is fitted.
        observed: the recordings, as they are fitted.
        hubs: indices of the links whose hub inertia is identified.
        progress: told (text, done, total) now and then.
        rough: whether minima are only a start for other searches.
    """

    experiment: Experiment
    data: Data
    observed: tuple[Observations, ...]
    hubs: tuple[int, ...]
    progress: Progress | None
    rough: bool = False

    @property
    def asked(self) -> bool:
        """Whether the numbers of joints were asked for."""
        return all(choice.asked for choice in self.data.plan.joints)

    @property
    def only_a_start(self) -> bool:
        """Whether the uniform links are not what is asked for."""
        return self.rough or self.data.options.parameters != "uniform"

    def candidates(self) -> list[tuple[int, ...]]:
        """Numbers of joints to try, the smallest first: from as many as there are modes seen to the plan's."""
        planned = tuple(choice.joints for choice in self.data.plan.joints)
        if self.asked:
            return [planned]
        orders = self.data.plan.shape.orders
        first = tuple(min(max(order, 2), n) for order, n in zip(orders, planned, strict=True))
        most = max(n - m for n, m in zip(planned, first, strict=True))
        if self.data.options.parameters == "uniform":
            most += _BEYOND
        return [
            tuple(link.virtual_joints or m + k for m, link in zip(first, self.experiment.rig.links, strict=True))
            for k in range(most + 1)
        ]

    def template(self, joints: Sequence[int]) -> Chain:
        """The nominal chain with so many joints."""
        rig = self.experiment.rig
        return nominal_chain(rig, rig_layouts(rig, joints, self.data.options.layout), START_DAMPING)

    def problem(self, joints: Sequence[int]) -> TrajectoryProblem:
        """Of uniform links with so many joints."""
        return TrajectoryProblem(Parametrisation(self.template(joints), "uniform", self.hubs), self.observed)

    def far(self, joints: Sequence[int], torque: tuple[TorqueProblem, TorqueFit] | None) -> TrajectoryFit:
        """Uniform links with so many joints, from far away.

        The search begins with the recordings' first periods, at what the torque method found, held to the measured
        frequencies; where that does not follow them, other stiffnesses are tried.
        """
        problem = self.problem(joints)
        nominal = problem.parametrisation.start
        starts = [*self._by_torque(torque), nominal]
        horizon = first_horizon(problem, starts[0])
        short = problem.until(horizon)
        stiffness = np.array([c.group == "stiffness" for c in problem.parametrisation.coordinates])
        others = [np.where(stiffness, factor * nominal, nominal) for factor in _OTHER_STIFFNESS]
        fit = screen_unreliable(short, starts, others, self.progress)
        states = [run.state for run in fit.point.runs]
        return fit_trajectory(problem, fit.point.x, self.progress, states, horizon, rough=self.only_a_start)

    def _by_torque(self, torque: tuple[TorqueProblem, TorqueFit] | None) -> list[Array]:
        """Coordinates that the torque method finds: held to the measured frequencies if it can be, and free."""
        if torque is None or torque[0].parametrisation.hubs != self.hubs:
            return []
        with contextlib.suppress(InsufficientDataError):
            return [with_frequencies(*torque, self.data)[1].x, torque[1].x]
        return [torque[1].x]

    def near(self, joints: Sequence[int], fit: TrajectoryFit) -> TrajectoryFit:
        """Uniform links with so many joints, from a fit with about as many."""
        chain = self.template(joints)
        states = [transfer_state(run.chain, chain, run.state) for run in fit.point.runs]
        problem = self.problem(joints)
        chain = problem.parametrisation.chain(fit.point.x)
        problem = replace(problem, step_multiple=_coarsest(chain, problem.observed, states, fit.point.misfit**2))
        return fit_trajectory(problem, fit.point.x, self.progress, states, rough=self.only_a_start)

    def refined(self, fit: TrajectoryFit) -> TrajectoryFit:
        """The same with the parameters asked for, the uniform links being where they start and what they prefer."""
        kind = self.data.options.parameters
        if kind == "uniform":
            return fit
        parametrisation = Parametrisation(fit.point.chain, kind, self.hubs)
        problem = replace(fit.point.problem, parametrisation=parametrisation, preference=parametrisation.preference)
        x = parametrisation.start
        for _ in range(_MOST_PASSES):
            # The preference counts as much as one of the values that this model itself leaves unexplained.
            problem = replace(problem, spread=max(fit.point.misfit, 1.0))
            fit = fit_trajectory(problem, x, self.progress, [run.state for run in fit.point.runs])
            x = fit.point.x
            if max(fit.point.misfit, 1.0) > 0.9 * problem.spread:
                break
        return fit

    def enough_joints(
        self, counts: Sequence[tuple[int, ...]], uniform: TrajectoryFit
    ) -> tuple[TrajectoryFit, tuple[int, ...], tuple[str, ...]]:
        """The fit with the fewest joints that one joint more does not improve, those joints, and a sentence on it."""
        best, joints = self.refined(uniform), counts[0]
        for more in counts[1:]:
            uniform = self.near(more, uniform)
            trial = self.refined(uniform)
            gain = 1 - float(np.sqrt(trial.point.chi2 / best.point.chi2))
            if not self._worth(best, trial):
                return best, joints, (_note(gain, best, trial),)
            best, joints = trial, more
        return best, joints, ()

    def _worth(self, fewer: TrajectoryFit, more: TrajectoryFit) -> bool:
        """Whether the larger chain explains the recordings better: by a Bayesian information criterion, and visibly."""
        count = fewer.point.count
        gain = count * np.log(fewer.point.chi2 / max(more.point.chi2, 1e-300))
        added = more.point.x.size - fewer.point.x.size
        return bool(gain > max(added * np.log(count), 2 * _WORTH_A_JOINT * count))


def _note(gain: float, fewer: TrajectoryFit, more: TrajectoryFit) -> str:
    """What one virtual joint more would do."""
    note = f"one virtual joint more would make the residual {100 * max(gain, 0.0):.2g} % smaller"
    one, two = (fit.point.problem.parametrisation for fit in (fewer, more))
    if one.kind != "uniform":
        return note
    values, others = one.physical(fewer.point.x), two.physical(more.point.x)
    shifts = np.abs(others / np.where(values > 0, values, np.inf) - (values > 0))
    named = zip(one.coordinates, shifts.tolist(), strict=True)
    return f"{note} and move " + ", ".join(f"{c.name} by {100 * shift:.2g} %" for c, shift in named)


def _coarsest(chain: Chain, observed: Sequence[Observations], states: Sequence[Array], excess: float) -> float:
    """Largest multiple of the integrator's default step that shifts no estimate by a tenth of its standard error.

    Args:
        chain: the arm, about as it will be.
        observed: the recordings.
        states: (2 nv,) initial states, about as they will be.
        excess: mean square of the weighted residuals.
    """
    arms = [Arm(chain)] * len(observed)
    starts = [InitialStatePrior.of(arm, each.recording) for arm, each in zip(arms, observed, strict=True)]
    exact = simulate_runs(arms, observed, starts, states, 1.0)
    for step_multiple in _COARSE:
        runs = simulate_runs(arms, observed, starts, states, step_multiple)
        error = sum(float(np.sum((one.residual - two.residual) ** 2)) for one, two in zip(runs, exact, strict=True))
        if error < _UNSEEN * max(excess, 1.0):
            return step_multiple
    return 1.0


@dataclass(frozen=True)
class ByTrajectory:
    """What the trajectory method found.

    Attributes:
        fit: the minimum.
        joints: numbers of virtual joints, and what they cost.
        torque: the torque method's fit that it started from; None where there was none.
        problems: why others were not used, a sentence each.
        notes: what was decided on the way.
    """

    fit: TrajectoryFit
    joints: tuple[JointChoice, ...]
    torque: tuple[TorqueProblem, TorqueFit] | None
    problems: tuple[str, ...]
    notes: tuple[str, ...]


def by_trajectory(
    experiment: Experiment, data: Data, loss: str = "linear", progress: Progress | None = None
) -> ByTrajectory:
    """Identify by whole trajectories.

    Args:
        experiment: the rig.
        data: its recordings.
        loss: of the weighted residuals, one of `LOSSES`.
        progress: told (text, done, total) now and then.

    Raises:
        InsufficientDataError: no recording can be simulated.
        SimulationDivergedError: no start can be simulated.
    """
    search, fit, torque, problems = first_fit(experiment, data, loss, progress)
    counts = search.candidates()
    fit, joints, notes = search.enough_joints(counts, fit)
    choices = tuple(
        replace(choose_virtual_joints(link, order, n), asked=len(counts) == 1 and search.asked)
        for link, order, n in zip(experiment.rig.links, data.plan.shape.orders, joints, strict=True)
    )
    return ByTrajectory(fit, choices, torque, problems, notes)


def first_fit(
    experiment: Experiment,
    data: Data,
    loss: str = "linear",
    progress: Progress | None = None,
    rough: bool = False,
) -> tuple[Search, TrajectoryFit, tuple[TorqueProblem, TorqueFit] | None, tuple[str, ...]]:
    """Uniform links with few joints, from far away, to recordings without their outliers.

    Args:
        experiment, data, loss, progress: as of `by_trajectory`.
        rough: whether the minimum is only a start for other searches.

    Returns:
        What further fits start with, the fit, what the torque method found (None where there was nothing for it to
        find), and why recordings were not used, a sentence each.

    Raises:
        InsufficientDataError: no recording can be simulated.
        SimulationDivergedError: no start can be simulated.
    """
    recordings, problems = simulated(data.recordings)
    noise = (data.settings.marker_noise, data.settings.encoder_noise)
    observed = tuple(Observations.of(experiment.rig, each, noise, Loss(loss)) for each in recordings)
    torque = fit_uniform(experiment, data, progress) if data.prepared else None
    search = Search(experiment, data, observed, driven_hubs(experiment, recordings), progress, rough)
    joints = search.candidates()[0]
    fit = search.far(joints, torque)
    observed = tuple(trimmed(run) for run in fit.point.runs)
    if any(one is not two for one, two in zip(observed, search.observed, strict=True)):
        search = replace(search, observed=observed)
        fit = search.near(joints, fit)
    return search, fit, torque, problems


def simulated(recordings: Sequence[Recording]) -> tuple[tuple[Recording, ...], tuple[str, ...]]:
    """Recordings whose torques are known, and what is wrong with the others.

    Raises:
        InsufficientDataError: there is none.
    """
    kept, problems = [], []
    for recording in recordings:
        try:
            measured_torque(recording)
            kept.append(recording)
        except InsufficientDataError as error:
            problems.append(str(error))
    if not kept:
        raise InsufficientDataError(
            "method trajectory",
            "no torque was measured at the active joints of any training recording, so none can be simulated",
            "record the column LINK.tau, or use method 'torque'",
        )
    return tuple(kept), tuple(problems)
