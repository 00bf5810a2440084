"""The trajectory method: starting values, outliers, integrator steps, and the number of virtual joints."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.chain.layout import rig_layouts, starting_chain
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.identification.parameters import Parametrisation
from vjm.identification.torque_method import TorqueFit, fit_torque
from vjm.identification.training_data import JointChoice, TrainingData
from vjm.identification.trajectory_fit import DIVERGED_MISFIT, Point, TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.records import VISIBLE_SHARE, Array, Progress, Recording
from vjm.simulation.arm import Arm
from vjm.simulation.integrate import default_step
from vjm.simulation.least_squares import Loss, LossName
from vjm.simulation.measurement import Observations
from vjm.simulation.run import InitialStatePrior, Run, is_followed, simulate_runs
from vjm.simulation.system import Trajectory, measured_torque
from vjm.text import listed, number

# Raised at starting values with which the arm cannot be simulated, or has no position of rest because it buckles.
_UNUSABLE_START = (SimulationDivergedError, InsufficientDataError)


@dataclass(frozen=True)
class TrajectoryMethod:
    """Fits of one experiment's trajectories with different numbers of virtual joints."""

    data: TrainingData
    # The recordings that can be simulated; without outliers once a first fit has detected them.
    observed: tuple[Observations, ...]
    hubs: tuple[int, ...]  # indices of the links whose hub inertia is identified
    torque: TorqueFit | None  # the torque method's fit; None where it has no data
    progress: Progress | None
    rough: bool = False  # True for loose tolerances: minima of uniform links are only a start for other searches

    def joint_counts(self) -> list[tuple[int, ...]]:
        """Return the numbers of joints of each link to try, from as many as modes are seen."""
        data = self.data
        planned = tuple(choice.joints for choice in data.joints)
        if all(choice.requested for choice in data.joints):
            return [planned]
        first = tuple(min(max(order, 2), count) for order, count in zip(data.shape.orders, planned, strict=True))
        largest = max(count - start for count, start in zip(planned, first, strict=True))
        if data.parameters == "uniform":
            largest += 3  # motion may show modes that the shape functions do not
        return [
            tuple(link.virtual_joints or start + k for start, link in zip(first, data.rig.links, strict=True))
            for k in range(largest + 1)
        ]

    def fit_from(self, joints: Sequence[int], fit: TrajectoryFit) -> TrajectoryFit:
        """Fit uniform links with given numbers of joints, with accurate steps, from a fit with about as many."""
        return self._with_accurate_steps(self._fit_from(joints, fit, self.rough))

    def _fit_from(self, joints: Sequence[int], fit: TrajectoryFit, rough: bool) -> TrajectoryFit:
        """Fit as `fit_from` does, with integrator steps as long as comparing numbers of joints allows."""
        problem, point = self._problem(joints), fit.point
        arms = problem.arms(point.x)
        states = [run.transferred_state(arm) for run, arm in zip(point.runs, arms, strict=True)]
        if self._starts_with_long_steps:
            step_multiple = search_step_multiple(point)
        else:
            step_multiple = _largest_step_multiple(arms, problem.observed, states, point.misfit**2)
        problem = replace(problem, step_multiple=step_multiple)
        return fit_trajectory(problem, point.x, self.progress, states, rough=rough, stop=_StallRule(self.rough))

    @property
    def _starts_with_long_steps(self) -> bool:
        """True if only the last fits take accurate integrator steps: an elbow's are many times shorter."""
        return self.data.rig.has_elbow

    def _with_accurate_steps(self, fit: TrajectoryFit) -> TrajectoryFit:
        """Refit with integrator steps so short that their error is below a tenth of every standard error.

        And so short that they hide no fast mode of a decay. With elbows, steps are halved until the estimates' change
        says so, by Richardson extrapolation: as if of third order, where the integrator's fourth makes errors fall
        faster. Each refit takes a Gauss-Newton step or two.
        """
        rough = self._starts_with_long_steps
        while rough and fit.point.problem.step_multiple > 1.0:
            point, stop = fit.point, _StallRule(self.rough)
            problem = replace(point.problem, step_multiple=max(point.problem.step_multiple / 2, 1.0))
            rough = self.rough or problem.step_multiple > 1.0
            fit = fit_trajectory(problem, point.x, self.progress, point.states, rough=rough, stop=stop)
            change = fit.point.x - point.x
            moved = float(np.linalg.norm(fit.point.reduced()[0].R[:-1, :-1] @ change)) / (2**3 - 1)
            halved = fit.point.runs[0].trajectory.step < point.runs[0].trajectory.step  # unless another bound limits it
            if not fit.converged or (halved and moved < 0.1 * max(fit.point.misfit, 1.0)):
                break
        if hides_fast_modes(fit, DIVERGED_MISFIT):
            problem = replace(fit.point.problem, step_multiple=1.0)
            stop = _StallRule(self.rough)
            fit = fit_trajectory(problem, fit.point.x, self.progress, fit.point.states, rough=self.rough, stop=stop)
        if not fit.converged or self.rough or not rough:
            return fit
        return fit_trajectory(fit.point.problem, fit.point.x, self.progress, fit.point.states, stop=_StallRule())

    def select_joints(self, first: TrajectoryFit) -> tuple[TrajectoryFit, tuple[str, ...]]:
        """Return the fit with the fewest joints that one joint more does not improve, and what that joint would do.

        The search begins at `first`, a fit of uniform links with the first of `joint_counts`. It skips numbers of
        joints between which the discretisation error still falls fast.
        """
        uniform, best, known = first, self._with_requested_parameters(first), [first]
        counts = self.joint_counts()
        k = 0
        while first.converged and k + 1 < len(counts):
            k = _next_count(counts, k, known) if self._starts_with_long_steps else k + 1
            uniform = self._fit_from(counts[k], uniform, self.rough or self._starts_with_long_steps)
            known.append(uniform)
            trial = self._with_requested_parameters(uniform)
            if not _explains_more(best, trial):  # with loose tolerances: decide by the final fits
                best, trial = self._final_fit(best), self._final_fit(trial)
                if not _explains_more(best, trial):
                    return best, (_joint_note(best, trial),)
            best = trial
        return self._final_fit(best), ()

    def _final_fit(self, fit: TrajectoryFit) -> TrajectoryFit:
        """Refit uniform links with accurate integrator steps; fits of other parameters have them already."""
        return self._with_accurate_steps(fit) if self.data.parameters == "uniform" else fit

    def joint_choices(self, fit: TrajectoryFit) -> tuple[JointChoice, ...]:
        """Return a fit's numbers of joints with their discretisation errors."""
        data = self.data
        return tuple(
            JointChoice.of(link, order, link_chain.virtual_joints, planned.requested, data.layout)
            for link, order, link_chain, planned in zip(
                data.rig.links, data.shape.orders, fit.point.chain.links, data.joints, strict=True
            )
        )

    def _problem(self, joints: Sequence[int]) -> TrajectoryProblem:
        """Return the problem of uniform links with given numbers of joints."""
        payloads = [observed.recording.payload_body for observed in self.observed]
        cuts = rig_layouts(self.data.rig, joints, self.data.layout, payloads)
        template = starting_chain(self.data.rig, cuts)
        return TrajectoryProblem(Parametrisation(template, "uniform", self.hubs), self.observed)

    def _fit_from_far(self, joints: Sequence[int]) -> TrajectoryFit:
        """Fit uniform links with given numbers of joints, without a fit to start from.

        The first periods of the recordings are fitted from several starting values: the torque method's estimate, with
        and without measured frequencies, and nominal values; then, if none of these converges, other stiffnesses.
        """
        problem = self._problem(joints)
        nominal, starts = problem.parametrisation.start, list[Array]()
        if self.torque is not None and self.torque.problem.parametrisation.hubs == self.hubs:
            with contextlib.suppress(InsufficientDataError):
                starts.append(self.torque.with_frequencies().x)
            starts.append(self.torque.x)
        starts.append(nominal)
        stiffness = np.array([coordinate.group == "stiffness" for coordinate in problem.parametrisation.coordinates])
        # Nominal values are taken to be within a factor of four. Nine stiffnesses in that range are factors of 1.41
        # apart, so that one of them is within 19 % of any, and its frequencies within 9 %.
        alternatives = [np.where(stiffness, factor * nominal, nominal) for factor in np.geomspace(0.25, 4.0, 9)]
        horizon = _first_horizon(problem, [*starts, *alternatives])
        if self._starts_with_long_steps:
            problem = replace(problem, step_multiple=_first_step_multiple(problem.until(horizon), nominal))
        fit = _fit_first_periods(problem.until(horizon), starts, alternatives, self.progress)
        start, stop, rough = fit.point, _StallRule(self.rough), self.rough or self._starts_with_long_steps
        return fit_trajectory(problem, start.x, self.progress, start.states, horizon, rough=rough, stop=stop)

    def _with_requested_parameters(self, fit: TrajectoryFit) -> TrajectoryFit:
        """Fit the requested parameters from uniform links, which a weak prior prefers."""
        if self.data.parameters == "uniform":
            return fit
        fit = self._with_accurate_steps(fit)
        parametrisation = Parametrisation(fit.point.chain, self.data.parameters, self.hubs)
        x, (centre, width) = parametrisation.start, parametrisation.preference
        for _ in range(8):  # the scale only falls, by 10 % or more, until it settles
            # The prior is scaled by the RMS residual of this very model, so that it counts as one measured value.
            scale = max(fit.point.misfit, 1.0)
            problem = replace(fit.point.problem, parametrisation=parametrisation, preference=(centre, width / scale))
            fit = fit_trajectory(problem, x, self.progress, fit.point.states)
            x = fit.point.x
            if max(fit.point.misfit, 1.0) > 0.9 * scale:
                break
        return fit


def first_fit(
    data: TrainingData, loss: LossName = "linear", progress: Progress | None = None, rough: bool = False
) -> tuple[TrajectoryMethod, TrajectoryFit]:
    """Fit uniform links with the smallest number of joints, from far away, to recordings without their outliers.

    Args:
        data: the training data.
        loss: one of `vjm.simulation.least_squares.LOSSES`, applied to weighted residuals.
        progress: called with (text, done, total) now and then.
        rough: True for loose tolerances, where the minimum is only a start for other searches.

    Returns:
        The method, which fits other numbers of joints from here, and the fit.

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
    observed = tuple(Observations.of(data.rig, recording, data.noise, Loss(loss)) for recording in recordings)
    torque = fit_torque(data, progress=progress) if data.prepared else None
    rough = rough or data.parameters != "uniform"
    usable_data = replace(data, problems=problems)
    search = TrajectoryMethod(usable_data, observed, data.driven_hubs(recordings), torque, progress, rough)
    joints = search.joint_counts()[0]
    fit = search._fit_from_far(joints)
    observed = tuple(run.with_motion_errors(trimmed(run)) for run in fit.point.runs)
    if any(cleaned is not original for cleaned, original in zip(observed, search.observed, strict=True)):
        search = replace(search, observed=observed)
        fit = search.fit_from(joints, fit)
    return search, fit


def simulatable(recordings: Sequence[Recording]) -> tuple[list[Recording], tuple[InsufficientDataError, ...]]:
    """Return the recordings whose torques or joint motion were measured, and why others cannot be simulated."""
    usable, problems = [], []
    for recording in recordings:
        try:
            if recording.input == "torque":
                measured_torque(recording)
            usable.append(recording)
        except InsufficientDataError as error:
            problems.append(error.with_traceback(None))
    return usable, tuple(problems)


def _fit_first_periods(
    problem: TrajectoryProblem, starts: Sequence[Array], others: Sequence[Array], progress: Progress | None
) -> TrajectoryFit:
    """Fit the recordings' first periods from several starting values (p,); return the fit with the smallest residual.

    The first start is tried, then the other ones in the order of their residuals, then `others` in that order, until a
    fit converges.
    """

    def best_of(candidates: Sequence[Array]) -> TrajectoryFit | None:
        """Fit from one candidate after another until a fit has converged; return the best."""
        best: TrajectoryFit | None = None
        for x in candidates:
            if best is not None and best.point.misfit < DIVERGED_MISFIT:
                break
            with contextlib.suppress(*_UNUSABLE_START):
                trial = fit_trajectory(problem, x, progress, rough=True, stop=_StallRule())
                best = trial if best is None or trial.point.misfit < best.point.misfit else best
        return best

    def by_misfit(candidates: Sequence[Array]) -> list[Array]:
        """Return the candidates that can be simulated, in the order of their residuals."""
        points = []
        for x in candidates:
            with contextlib.suppress(*_UNUSABLE_START):
                points.append(problem.point(x))
        return [point.x for point in sorted(points, key=lambda point: point.misfit) if np.isfinite(point.misfit)]

    def better(fit: TrajectoryFit | None, candidates: Sequence[Array]) -> TrajectoryFit | None:
        fits = [trial for trial in (fit, best_of(by_misfit(candidates))) if trial is not None]
        return min(fits, key=lambda trial: trial.point.misfit, default=None)

    fit = best_of(starts[:1])
    if fit is None or fit.point.misfit > DIVERGED_MISFIT:
        fit = better(fit, starts[1:])
    # An incomplete model may leave 30 % of the motion as a residual; a fit to another cycle leaves about all of it.
    if fit is None or fit.point.misfit > max(DIVERGED_MISFIT, 0.3 * _rms_motion(fit.point)):
        fit = better(fit, others)
    # Where no start can be simulated, this raises the error that says why.
    return fit or fit_trajectory(problem, starts[-1], progress)


def _first_horizon(problem: TrajectoryProblem, candidates: Sequence[Array]) -> float:
    """Return the first horizon [s] at the first candidate (p,) whose arm has a position of rest.

    Raises:
        InsufficientDataError: none of them has one.
    """
    for x in candidates[:-1]:
        with contextlib.suppress(InsufficientDataError):
            return problem.first_horizon(x)
    return problem.first_horizon(candidates[-1])


def _rms_motion(point: Point) -> float:
    """Return the RMS deviation of the measured values from the point's arm at rest, in units of the noise."""
    squares = 0.0
    for run in point.runs:
        at_rest = Trajectory.at_rest(run.observed.recording.time, run.prior.rest[: run.chain.size])
        squares += float(np.sum(run.observed.residual(run.arm, at_rest) ** 2))
    return float(np.sqrt(squares / max(point.count, 1)))


class _StallRule:
    """Stopping rule for a search that stalls far from the recordings.

    A search whose gradient leads to the right minimum takes most of the cost away with each step; one that has not
    halved it in five trials has stalled. It has not stalled if it converges to a distant minimum, as where the model
    lacks a mass: then each step lowers the cost, and the next one is predicted to gain next to nothing. With loose
    tolerances the search also ends once no recording is followed: later searches begin in short segments.
    """

    def __init__(self, rough: bool = False) -> None:
        self.rough = rough
        self.costs: list[float] = []
        self.count = 0

    def __call__(self, point: Point, predicted: float) -> bool:
        """Return True to end the search at a point, given the predicted decrease of the cost by its next step."""
        if self.rough and not any(is_followed([run]) for run in point.runs):
            return True
        if point.count != self.count:  # the horizon was lengthened: costs are not comparable
            self.costs, self.count = [], point.count
        self.costs.append(point.cost)
        recent = self.costs[-6:]
        converging = predicted < VISIBLE_SHARE * point.cost and bool(np.all(np.diff(recent) < 0))
        return point.misfit > DIVERGED_MISFIT and len(recent) > 5 and 2 * point.cost > recent[0] and not converging


def _next_count(counts: Sequence[tuple[int, ...]], k: int, fits: Sequence[TrajectoryFit]) -> int:
    """Return the index of the numbers of joints to try after the k-th.

    The discretisation error of a chain falls with a power of n, and so does the excess of chi^2 over the noise.
    Extrapolating the power between the last two fits, numbers are skipped from which one joint more would still lower
    chi^2 by ten times the visible gain.
    """
    if len(fits) < 2 or min(fit.misfit for fit in fits[-2:]) <= 1.0:
        return k + 1
    sizes = [float(np.mean(joints)) for joints in counts]
    n, m = (np.mean([link.virtual_joints for link in fit.point.chain.links]) for fit in fits[-2:])
    previous, last = (fit.misfit**2 - 1 for fit in fits[-2:])
    power = np.log(previous / last) / np.log(m / n)
    for following in range(k + 1, len(counts) - 1):
        excess, next_excess = (last * (sizes[index] / m) ** -power for index in (following, following + 1))
        if excess - next_excess < 10 * VISIBLE_SHARE * (1 + excess):
            return following
    return len(counts) - 1


def _explains_more(smaller: TrajectoryFit, larger: TrajectoryFit) -> bool:
    """Return True if the larger chain has the smaller Bayesian information criterion (BIC), and a visible gain."""
    count = smaller.point.count
    gain = count * np.log(smaller.point.chi2 / max(larger.point.chi2, 1e-300))
    added = larger.point.x.size - smaller.point.x.size
    return bool(gain > max(added * np.log(count), VISIBLE_SHARE * count))


def _joint_note(smaller: TrajectoryFit, larger: TrajectoryFit) -> str:
    """Say what one virtual joint more would do to the residual and to the parameters."""
    gain = 1 - float(np.sqrt(larger.point.chi2 / smaller.point.chi2))
    reduction = f"reduce the residual by {number(100 * gain, 2)} %" if gain > 0 else "not reduce the residual"
    note = f"one more virtual joint would {reduction}"
    coarse, fine = (fit.point.problem.parametrisation for fit in (smaller, larger))
    if coarse.kind != "uniform":
        return note
    values, fine_values = coarse.physical(smaller.point.x), fine.physical(larger.point.x)
    shifts = np.abs(fine_values / np.where(values > 0, values, np.inf) - (values > 0))
    named = zip(coarse.coordinates, shifts.tolist(), strict=True)
    return f"{note}, and would change {listed([f'{c.name} by {number(100 * shift, 2)} %' for c, shift in named])}"


def _first_step_multiple(problem: TrajectoryProblem, x: Array) -> float:
    """Return the multiple of the integrator's default step for searches from x (p,), with initial states at rest.

    It is one, the most accurate, where the arm cannot be simulated from there.
    """
    arms = problem.arms(x)
    with contextlib.suppress(*_UNUSABLE_START):
        states = [
            InitialStatePrior.of(arm, observations.recording).rest
            for arm, observations in zip(arms, problem.observed, strict=True)
        ]
        return search_step_multiple(problem.simulated(x, states, states, [1.0] * len(states)), 1.0)
    return 1.0


def search_step_multiple(point: Point, reduced_chi2: float | None = None, largest: float = 16.0) -> float:
    """Return the largest multiple of the integrator's default step whose error is negligible beside the residuals.

    The error of a step is taken as the difference from one half as long.

    Args:
        point: where the recordings are simulated.
        reduced_chi2: mean square residual to compare with; None: the point's own. At least one is taken.
        largest: multiple to begin with.
    """
    arms, observed, coarse, before = [run.arm for run in point.runs], point.problem.observed, list[Run](), 1.0
    # 3 % of the RMS residual changes chi^2 by a thousandth: a tenth of what decides for one joint more.
    tolerance = 0.03**2 * max(point.misfit**2 if reduced_chi2 is None else reduced_chi2, 1.0) * point.count
    for multiple in (candidate for candidate in (16.0, 8.0, 4.0, 2.0, 1.0) if candidate <= largest):
        try:
            fine = simulate_runs(arms, observed, None, point.states, multiple)
        except SimulationDivergedError:
            continue
        pairs = [*zip(coarse, fine, strict=True)] if coarse else []
        differences = [
            coarse_run.residual - fine_run.residual
            for coarse_run, fine_run in pairs
            if coarse_run.trajectory.step > fine_run.trajectory.step
        ]
        if differences and sum(float(difference @ difference) for difference in differences) < tolerance:
            return before
        coarse, before = fine, multiple
    return 1.0


def hides_fast_modes(fit: TrajectoryFit, max_misfit: float) -> bool:
    """Return True if the steps are longer than the default, in decays that the model misses by no more than a misfit.

    A release from a bent shape begins in several modes at once. Derivatives over longer intervals show fewer of them,
    so that the first frames are missed, which does not matter where far more is. The default steps of arms with elbows
    are far shorter than these intervals.
    """
    decays = [run for run in fit.point.runs if run.observed.recording.kind == "decay" and not run.chain.elbows.size]
    # Not by the multiple alone: other bounds may have kept the steps short.
    default = [default_step(run.chain, run.observed.recording.payload_body) for run in decays]
    longer = any(run.trajectory.step > 1.001 * step for run, step in zip(decays, default, strict=True))
    return longer and fit.point.problem.step_multiple > 1.0 and fit.misfit < max_misfit


def _largest_step_multiple(
    arms: Sequence[Arm], observed: Sequence[Observations], states: Sequence[Array], reduced_chi2: float
) -> float:
    """Return the largest multiple of the integrator's default step that moves no estimate by 0.1 standard errors."""
    exact = simulate_runs(arms, observed, None, states, 1.0)
    for multiple in (4.0, 2.0):
        try:
            runs = simulate_runs(arms, observed, None, states, multiple)
        except SimulationDivergedError:
            continue
        error = sum(
            float(np.sum((run.residual - exact_run.residual) ** 2)) for run, exact_run in zip(runs, exact, strict=True)
        )
        if error < 0.1**2 * max(reduced_chi2, 1.0):  # no estimate moves by more standard errors than the root
            return multiple
    return 1.0
