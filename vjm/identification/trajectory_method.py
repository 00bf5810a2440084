"""The trajectory method: where it starts, what it leaves out, and how many virtual joints explain the recordings."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.curve import transfer_state
from vjm.chain.layout import nominal_chain, rig_layouts
from vjm.chain.virtual_links import Chain
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.identification.parameters import Parametrisation
from vjm.identification.torque_method import START_KELVIN_VOIGT, TorqueFit, fit_torque
from vjm.identification.training_data import JointChoice, TrainingData
from vjm.identification.trajectory_fit import TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.records import Array, Progress, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.least_squares import Loss
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, simulate_runs
from vjm.simulation.system import Trajectory, measured_torque

# A start is followed by others while its fit of the first periods misses by more than ten times the noise, or, where
# the model itself lacks something, by more than 30 % of the motion: a fit of another cycle misses by about all of it.
_DIVERGED_MISFIT = 10.0
_DIVERGED_SHARE = 0.3


@dataclass(frozen=True)
class TrajectoryMethod:
    """Fits of one experiment's trajectories with different numbers of virtual joints."""

    data: TrainingData
    # The recordings that can be simulated, without their outliers once a first fit has shown them.
    observed: tuple[Observations, ...]
    hubs: tuple[int, ...]  # indices of the links whose hub inertia is identified
    torque: TorqueFit | None  # what the torque method finds, if anything
    progress: Progress | None
    rough: bool = False  # True if minima of uniform links are only a start for other searches

    def candidates(self) -> list[tuple[int, ...]]:
        """Return numbers of joints to try, the smallest first: from as many as there are modes seen to the planned."""
        data = self.data
        planned = tuple(choice.joints for choice in data.joints)
        if all(choice.requested for choice in data.joints):
            return [planned]
        first = tuple(min(max(order, 2), n) for order, n in zip(data.shape.orders, planned, strict=True))
        most = max(n - m for n, m in zip(planned, first, strict=True))
        if data.parameters == "uniform":
            most += 3  # motion may show modes that the shape functions do not
        return [
            tuple(link.virtual_joints or m + k for m, link in zip(first, data.rig.links, strict=True))
            for k in range(most + 1)
        ]

    def near(self, joints: Sequence[int], fit: TrajectoryFit) -> TrajectoryFit:
        """Fit uniform links with so many joints, from a fit with about as many."""
        problem = self._problem(joints)
        template = problem.parametrisation.template
        states = [transfer_state(run.chain, template, run.state) for run in fit.point.runs]
        chain = problem.parametrisation.chain(fit.point.x)
        step_multiple = _largest_step_multiple(chain, problem.observed, states, fit.point.misfit**2)
        problem = replace(problem, step_multiple=step_multiple)
        return fit_trajectory(problem, fit.point.x, self.progress, states, rough=self.rough)

    def enough_joints(self, first: TrajectoryFit) -> tuple[TrajectoryFit, tuple[str, ...]]:
        """Return the fit with the fewest joints that one joint more does not improve, and what that joint would do.

        The search begins at `first`, of uniform links with the first of the candidate numbers of joints.
        """
        uniform, best = first, self._refined(first)
        for joints in self.candidates()[1:]:
            uniform = self.near(joints, uniform)
            trial = self._refined(uniform)
            if not _explains_more(best, trial):
                return best, (_comparison(best, trial),)
            best = trial
        return best, ()

    def joint_choices(self, fit: TrajectoryFit) -> tuple[JointChoice, ...]:
        """Return a fit's numbers of joints with their discretisation errors."""
        links = zip(self.data.rig.links, self.data.shape.orders, fit.point.chain.links, strict=True)
        requested = all(choice.requested for choice in self.data.joints)
        return tuple(JointChoice.of(link, order, own.virtual_joints, requested) for link, order, own in links)

    def _problem(self, joints: Sequence[int]) -> TrajectoryProblem:
        """The problem of uniform links with so many joints."""
        cuts = rig_layouts(self.data.rig, joints, self.data.layout)
        template = nominal_chain(self.data.rig, cuts, START_KELVIN_VOIGT)
        return TrajectoryProblem(Parametrisation(template, "uniform", self.hubs), self.observed)

    def _far(self, joints: Sequence[int]) -> TrajectoryFit:
        """Fit uniform links with so many joints, from far away.

        The search begins with the recordings' first periods, at what the torque method found, held to the measured
        frequencies if it can be, and free; where that does not follow them, other stiffnesses are tried.
        """
        problem = self._problem(joints)
        nominal, starts = problem.parametrisation.start, list[Array]()
        if self.torque is not None and self.torque.problem.parametrisation.hubs == self.hubs:
            with contextlib.suppress(InsufficientDataError):
                starts.append(self.torque.with_frequencies().x)
            starts.append(self.torque.x)
        starts.append(nominal)
        horizon = problem.first_horizon(starts[0])
        stiffness = np.array([c.group == "stiffness" for c in problem.parametrisation.coordinates])
        # Nominal values are off by less than a factor of four; frequencies nine steps apart by at most 9 %.
        others = [np.where(stiffness, factor * nominal, nominal) for factor in np.geomspace(0.25, 4.0, 9)]
        fit = _fit_first_periods(problem.until(horizon), starts, others, self.progress)
        return fit_trajectory(problem, fit.point.x, self.progress, fit.point.states, horizon, self.rough)

    def _refined(self, fit: TrajectoryFit) -> TrajectoryFit:
        """The fit of the parameters asked for, which start from uniform links and prefer them where data are silent."""
        if self.data.parameters == "uniform":
            return fit
        parametrisation = Parametrisation(fit.point.chain, self.data.parameters, self.hubs)
        x, (centre, width) = parametrisation.start, parametrisation.preference
        for _ in range(8):  # the scale only falls, by 10 % or more
            # The preference counts as much as one of the values that this model itself leaves unexplained.
            scale = max(fit.point.misfit, 1.0)
            problem = replace(fit.point.problem, parametrisation=parametrisation, preference=(centre, width / scale))
            fit = fit_trajectory(problem, x, self.progress, fit.point.states)
            x = fit.point.x
            if max(fit.point.misfit, 1.0) > 0.9 * scale:
                break
        return fit


def first_fit(
    data: TrainingData, loss: str = "linear", progress: Progress | None = None, rough: bool = False
) -> tuple[TrajectoryMethod, TrajectoryFit]:
    """Fit uniform links with few joints, from far away, to recordings without their outliers.

    The loss is one of `vjm.simulation.least_squares.LOSSES`, of weighted residuals; a `rough` minimum is only a start
    for other searches. Also return what these start with.

    Raises:
        InsufficientDataError: no recording can be simulated.
        SimulationDivergedError: no start can be simulated.
    """
    recordings, problems = simulatable(data.recordings)
    if not recordings:
        raise InsufficientDataError(
            "method trajectory",
            "no torque was measured at the active joints of any training recording, so none can be simulated",
            "record the column LINK.tau, give the recordings input = 'motion', or use method 'torque'",
        )
    observed = tuple(Observations.of(data.rig, each, data.noise, Loss(loss)) for each in recordings)
    torque = fit_torque(data, progress=progress) if data.prepared else None
    rough = rough or data.parameters != "uniform"
    used = replace(data, problems=problems)
    search = TrajectoryMethod(used, observed, data.driven_hubs(recordings), torque, progress, rough)
    joints = search.candidates()[0]
    fit = search._far(joints)
    observed = tuple(trimmed(run) for run in fit.point.runs)
    if any(one is not two for one, two in zip(observed, search.observed, strict=True)):
        search = replace(search, observed=observed)
        fit = search.near(joints, fit)
    return search, fit


def simulatable(recordings: Sequence[Recording]) -> tuple[list[Recording], tuple[str, ...]]:
    """Return the recordings whose torques or motion are known, and what is wrong with the others."""
    kept, problems = [], []
    for recording in recordings:
        try:
            if recording.input == "torque":
                measured_torque(recording)
            kept.append(recording)
        except InsufficientDataError as error:
            problems.append(str(error))
    return kept, tuple(problems)


def _fit_first_periods(
    problem: TrajectoryProblem, starts: Sequence[Array], others: Sequence[Array], progress: Progress | None
) -> TrajectoryFit:
    """The fit to the recordings' first periods that follows them best.

    The first start (p,) is tried first, then all by how well they follow, then `others` where none leads anywhere.
    """

    def best_of(candidates: Sequence[Array]) -> TrajectoryFit | None:
        """Fit from the start that follows best; from the next ones too, until one misses by little."""
        best: TrajectoryFit | None = None
        for x in candidates:
            if best is not None and best.point.misfit < _DIVERGED_MISFIT:
                break
            with contextlib.suppress(SimulationDivergedError):
                trial = fit_trajectory(problem, x, progress, rough=True)
                best = trial if best is None or trial.point.misfit < best.point.misfit else best
        return best

    def by_misfit(candidates: Sequence[Array]) -> list[Array]:
        """Return the candidates that can be simulated, the one that follows best first."""
        points = []
        for x in candidates:
            with contextlib.suppress(SimulationDivergedError):
                points.append(problem.point(x))
        return [point.x for point in sorted(points, key=lambda point: point.misfit) if np.isfinite(point.misfit)]

    fit = best_of(starts[:1])
    if fit is None or fit.point.misfit > _DIVERGED_MISFIT:
        fit = best_of(by_misfit(starts))
    if fit is None or fit.point.misfit > max(_DIVERGED_MISFIT, _DIVERGED_SHARE * _motion(problem, starts[-1])):
        fit = best_of(by_misfit([*starts, *others]))
    # Where nothing runs at all, let the search itself say what is wrong.
    return fit or fit_trajectory(problem, starts[-1], progress)


def _motion(problem: TrajectoryProblem, x: Array) -> float:
    """RMS of what was measured about the arm's rest, in units of the noise."""
    squares = 0.0
    for observed, arm in zip(problem.observed, problem.arms(x), strict=True):
        rest = InitialStatePrior.of(arm, observed.recording).rest[: arm.chain.size]
        squares += float(np.sum(observed.residual(arm, Trajectory.at_rest(observed.recording.time, rest)) ** 2))
    return float(np.sqrt(squares / sum(observed.count for observed in problem.observed)))


def _explains_more(fewer: TrajectoryFit, more: TrajectoryFit) -> bool:
    """Return True if the larger chain explains the recordings better: by Schwarz's criterion (BIC), and visibly."""
    count = fewer.point.count
    gain = count * np.log(fewer.point.chi2 / max(more.point.chi2, 1e-300))
    added = more.point.x.size - fewer.point.x.size
    return bool(gain > max(added * np.log(count), 0.01 * count))  # of chi^2: 0.5 % of the RMS residual


def _comparison(fewer: TrajectoryFit, more: TrajectoryFit) -> str:
    """A sentence on what one virtual joint more would do."""
    gain = 1 - float(np.sqrt(more.point.chi2 / fewer.point.chi2))
    note = f"one virtual joint more would make the residual {100 * max(gain, 0.0):.2g} % smaller"
    one, two = (fit.point.problem.parametrisation for fit in (fewer, more))
    if one.kind != "uniform":
        return note
    values, others = one.physical(fewer.point.x), two.physical(more.point.x)
    shifts = np.abs(others / np.where(values > 0, values, np.inf) - (values > 0))
    named = zip(one.coordinates, shifts.tolist(), strict=True)
    return f"{note} and move " + ", ".join(f"{c.name} by {100 * shift:.2g} %" for c, shift in named)


def _largest_step_multiple(
    chain: Chain, observed: Sequence[Observations], states: Sequence[Array], mean_square: float
) -> float:
    """Largest multiple of the integrator's default step that shifts no estimate by a tenth of its standard error."""
    arms = [Arm(chain)] * len(observed)
    exact = simulate_runs(arms, observed, None, states, 1.0)
    for multiple in (4.0, 2.0):
        runs = simulate_runs(arms, observed, None, states, multiple)
        error = sum(float(np.sum((one.residual - two.residual) ** 2)) for one, two in zip(runs, exact, strict=True))
        if error < 0.1**2 * max(mean_square, 1.0):  # no direction of the parameters moves by more than the root
            return multiple
    return 1.0
