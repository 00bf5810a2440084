"""Fits of uniform links with different numbers of virtual joints, and how many joints the recordings ask for."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vjm.chain.records import Chain
from vjm.errors import InsufficientDataError
from vjm.experiment.records import Experiment
from vjm.identification.data import Data
from vjm.identification.parametrisation import Parametrisation
from vjm.identification.select import cuts_of, nominal_chain
from vjm.identification.torque_fit import Progress, TorqueFit, TorqueProblem
from vjm.identification.torque_method import START_DAMPING, with_frequencies
from vjm.identification.trajectory_fit import TrajectoryFit, first_horizon, fit_trajectory
from vjm.identification.trajectory_problem import TrajectoryProblem
from vjm.identification.trajectory_start import from_afar
from vjm.simulate.arm import Arm
from vjm.simulate.observation import Observed
from vjm.simulate.run import Start, run_all, transferred

Array = NDArray[np.float64]

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
    observed: tuple[Observed, ...]
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
        return nominal_chain(rig, cuts_of(rig, joints, self.data.options.layout), START_DAMPING)

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
        fit = from_afar(short, starts, others, self.progress)
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
        states = [transferred(run.chain, chain, run.state) for run in fit.point.runs]
        problem = self.problem(joints)
        chain = problem.parametrisation.chain(fit.point.x)
        problem = replace(problem, coarse=_coarsest(chain, problem.observed, states, fit.point.misfit**2))
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


def _coarsest(chain: Chain, observed: Sequence[Observed], states: Sequence[Array], excess: float) -> float:
    """Largest multiple of the integrator's default step that shifts no estimate by a tenth of its standard error.

    Args:
        chain: the arm, about as it will be.
        observed: the recordings.
        states: (2 nv,) initial states, about as they will be.
        excess: mean square of the weighted residuals.
    """
    arms = [Arm(chain)] * len(observed)
    starts = [Start.of(arm, each.recording) for arm, each in zip(arms, observed, strict=True)]
    exact = run_all(arms, observed, starts, states, 1.0)
    for coarse in _COARSE:
        runs = run_all(arms, observed, starts, states, coarse)
        error = sum(float(np.sum((one.residual - two.residual) ** 2)) for one, two in zip(runs, exact, strict=True))
        if error < _UNSEEN * max(excess, 1.0):
            return coarse
    return 1.0
