"""Baseline of a diagnosis: the model without effects, and the point from which the search for effects starts.

The uniform model is fitted to the training recordings (to those in the reference condition, where there are any), with
the camera's noise estimated on the way and the chain's discretization error measured and known from then on: the
predictions of a chain with n joints differ from those of a beam by a term of order 1/n^2, in recordings of large bends
far above the noise of many samples, and its best parameters are biased. A finer chain is therefore fitted once, with
the derivatives of the coarse one (deferred correction: Pereyra, Numerische Mathematik 10, 1967); Richardson's
extrapolation of the differences gives the offset of the predictions and the shift of the parameters to those of a beam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from vjm.chain.curve import transfer_state
from vjm.chain.layout import DEFAULT_LAYOUT, nominal_chain, rig_layouts
from vjm.diagnosis.candidate_fit import INCOMPLETE
from vjm.diagnosis.noise import Noise
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.identification.parameters import Parametrisation
from vjm.identification.torque_method import START_KELVIN_VOIGT
from vjm.identification.training_data import TrainingData
from vjm.identification.trajectory_fit import Point, TrajectoryFit, TrajectoryProblem, fit_trajectory
from vjm.identification.trajectory_method import TrajectoryMethod, first_fit, simulatable
from vjm.model.dynamics import mechanism_of
from vjm.records import REFERENCE, Array, Experiment, Progress, Rig
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run, simulate_runs

_LEAST_JOINTS = 8  # of a link: the third mode's frequency is then right to about one per cent (error of order 1/n^2)
_LARGER_NOISE = 1.1  # times the noise given, from which the measured one is used: its own error is below 10 %
_LARGEST_DELAY = 0.1  # s; bound of the camera delays that are looked for
CLOSE = 2.0  # misfit up to which the discretization error is comparable with what else is missing
_REFINEMENT = 3  # times as many joints: leaves a ninth of the error, which the extrapolation removes
_EXTRAPOLATION = _REFINEMENT**2 / (_REFINEMENT**2 - 1)  # Richardson's, for an error of order 1/n^2
_PASSES = 4  # corrections; each reduces the rest of the error by the error itself
_CONVERGED = 1e-4  # relative decrease of chi^2 from one pass to the next, below a tenth of a typical noise of chi^2


@dataclass(frozen=True)
class Baseline:
    """Model without effects, and the training recordings."""

    fit: TrajectoryFit  # to all training recordings; to those in the reference condition, where there are any
    noise: Noise  # of the camera
    changed: tuple[Observations, ...]  # training recordings not in `fit`: those in which something may have changed
    problems: tuple[str, ...]  # why recordings are not used, a sentence each


def fit_baseline(experiment: Experiment, progress: Progress | None = None) -> Baseline:
    """Fit the model without effects.

    Args:
        experiment: the rig and its recordings.
        progress: told (text, done, total) now and then.

    Raises:
        InsufficientDataError: recordings that cannot determine a model.
        SimulationDivergedError: no start can be simulated.
    """
    data = TrainingData.of(experiment)
    search, fit = first_fit(data, progress=progress, rough=True)
    resting, changed, unused = _further_recordings(experiment, search)
    runs = [*fit.point.runs, *_simulated(fit.point, resting)]
    noise = Noise.of(runs)
    size = search.observed[0].noise
    if noise.std is not None and (experiment.rig.marker_noise is None or noise.std > _LARGER_NOISE * size[0]):
        size = (noise.std, size[1])
    joints = tuple(max(_LEAST_JOINTS, link.virtual_joints) for link in fit.point.chain.links)
    observed = tuple(_prepared(trimmed(run), size, noise) for run in runs)
    fit = replace(fit, point=replace(fit.point, runs=tuple(runs)))
    # Where the model lacks much, its best parameters are of no interest.
    fit = replace(search, observed=observed, rough=fit.point.misfit > INCOMPLETE).near(joints, fit)
    model = fit
    bias = DiscretizationBias.of(fit.point, experiment.rig) if model.misfit < CLOSE else None
    outlier_free = [next((trimmed(run) for run in _simulated(fit.point, [one])), one) for one in changed]
    others = tuple(_prepared(one, size, noise) for one in outlier_free)
    return Baseline(bias.corrected(model) if bias else model, noise, others, (*search.data.problems, *unused))


def _further_recordings(
    experiment: Experiment, search: TrajectoryMethod
) -> tuple[list[Observations], list[Observations], tuple[str, ...]]:
    """Training recordings not yet fitted: those at rest, those that may have changed; and why others are not usable."""
    train = [recording for recording in experiment.cleaned_recordings if recording.role == "train"]
    fitted = {observed.recording.file for observed in search.observed}
    referenced = any(recording.condition == REFERENCE for recording in train)
    usable, problems = simulatable([recording for recording in train if recording.file not in fitted])
    resting: list[Observations] = []
    changed: list[Observations] = []
    for recording in usable:
        observed = Observations.of(experiment.rig, recording, search.observed[0].noise)
        (changed if referenced and recording.condition != REFERENCE else resting).append(observed)
    return resting, changed, problems


def _simulated(point: Point, observed: Sequence[Observations]) -> list[Run]:
    """Simulate further recordings by the model of a fit; those that diverge are left out."""
    runs: list[Run] = []
    for one in observed:
        arm = point.problem.arms(point.x, [one.recording])[0]
        try:
            runs += [run for run, _ in fit_initial_states([arm], [one], step_multiple=point.problem.step_multiple)]
        except SimulationDivergedError:
            continue
    return runs


def _prepared(observed: Observations, size: tuple[float, float], noise: Noise) -> Observations:
    """Measurements with the noise that was found, without frames that a delayed camera took outside of the drive."""
    recording = observed.recording
    if recording.theta.shape[1]:
        begin, end = recording.time[0] + _LARGEST_DELAY, recording.time[-1] - _LARGEST_DELAY
        inside = (recording.time >= begin) & (recording.time <= end)
        if inside.sum() > recording.time.size / 2:
            recording = replace(recording, markers=np.where(inside[:, None, None], recording.markers, np.nan))
    return noise.whitened(observed.of_recording(recording, size))


@dataclass(frozen=True)
class SearchStart:
    """Model from which the search for effects starts."""

    reference: TrajectoryFit  # the model as it was before any change, simulated in all training recordings
    reference_misfit: float = 1.0  # misfit of the reference recordings that counts as noise; one where it is noise

    @classmethod
    def of(cls, baseline: Baseline, reference: TrajectoryFit) -> Self:
        """Add the changed recordings to the model of the reference recordings.

        Args:
            baseline: the fit, and the recordings that it has not.
            reference: the same fit, with effects that were there before any change.
        """
        if not baseline.changed:
            return cls(reference)
        point, problem = reference.point, reference.point.problem
        misfit = point.misfit if point.misfit > INCOMPLETE else 1.0
        known = [replace(run, observed=_with_larger_noise(run.observed, misfit)) for run in point.runs]
        others = [_with_larger_noise(observed, misfit) for observed in baseline.changed]
        arms = problem.arms(point.x, [observed.recording for observed in others])
        new = [run for run, _ in fit_initial_states(arms, others, step_multiple=problem.step_multiple)]
        runs = [*(known if misfit > 1 else point.runs), *new]
        problem = replace(problem, observed=tuple(run.observed for run in runs))
        return cls(TrajectoryFit(Point(problem, point.x, tuple(runs))), misfit)


def _with_larger_noise(observed: Observations, factor: float) -> Observations:
    return replace(observed, noise=(factor * observed.noise[0], factor * observed.noise[1]))


@dataclass(frozen=True)
class DiscretizationBias:
    """Difference between a beam and a fitted chain with few joints, each fitted as well as it can be."""

    offset: tuple[Array, ...]  # (N,) for each recording, the beam's predictions less the chain's [m, rad]
    shift: Array  # (p,) the beam's coordinates less the chain's

    @classmethod
    def of(cls, point: Point, rig: Rig, rough: bool = False) -> Self | None:
        """Compare a fitted chain with a finer one; None where that cannot be simulated.

        Args:
            point: where the chain fits best.
            rig: the arm.
            rough: compare them at the same parameters, which gives most of the offset, and no shift.
        """
        start = with_offset(point, None)
        finer = _finer(start, rig)
        best, chi2, here = None, np.inf, start
        try:
            for remaining in reversed(range(1 if rough else _PASSES)):
                predicted = _predictions(finer, here)
                previous, chi2 = chi2, sum(map(_chi2, here.runs, predicted))
                if not chi2 < previous * (1 - _CONVERGED):
                    break
                best = predicted, here.x
                if remaining:
                    offset = [fine - _predicted(run) for fine, run in zip(predicted, here.runs, strict=True)]
                    shifted = with_offset(here, offset)
                    states = [run.state for run in shifted.runs]
                    fit = fit_trajectory(shifted.problem, shifted.x, None, states, rough=True)
                    here = with_offset(fit.point, None)
        except (SimulationDivergedError, InsufficientDataError):
            return None
        if best is None:
            return None
        predicted, x = best
        offset = [_EXTRAPOLATION * (fine - _predicted(run)) for fine, run in zip(predicted, start.runs, strict=True)]
        return cls(tuple(offset), _EXTRAPOLATION * (x - point.x))

    def corrected(self, candidate: TrajectoryFit, rough: bool = False) -> TrajectoryFit:
        """Fit a model again beside the bias; a rough fit is only a start for others."""
        point = with_offset(candidate.point, self.offset)
        fit = fit_trajectory(point.problem, point.x, None, [run.state for run in point.runs], rough=rough)
        return replace(fit, shift=self.shift)


def with_offset(point: Point, offset: Sequence[Array] | None) -> Point:
    """Return the same simulations with offsets (N,) of their predictions, one for each recording; None: without."""
    runs = tuple(
        replace(run, observed=replace(run.observed, discretization_offset=own))
        for run, own in zip(point.runs, [None] * len(point.runs) if offset is None else offset, strict=True)
    )
    return replace(point, problem=replace(point.problem, observed=tuple(run.observed for run in runs)), runs=runs)


def _finer(point: Point, rig: Rig) -> TrajectoryProblem:
    """The problem of a chain with more joints."""
    coarse = point.problem.parametrisation
    joints = [_REFINEMENT * link.virtual_joints for link in coarse.template.links]
    template = nominal_chain(rig, rig_layouts(rig, joints, DEFAULT_LAYOUT), START_KELVIN_VOIGT)
    finer = Parametrisation(template, coarse.kind, coarse.hubs)
    return replace(point.problem, parametrisation=finer)


def _predictions(finer: TrajectoryProblem, point: Point) -> list[Array]:
    """Predictions of the finer chain for each recording [m, rad]."""
    observed = [run.observed for run in point.runs]
    arms = finer.arms(point.x, [run.observed.recording for run in point.runs])
    states = [_transferred_with_momentum(run, arm) for run, arm in zip(point.runs, arms, strict=True)]
    return [_predicted(run) for run in simulate_runs(arms, observed, None, states, point.problem.step_multiple)]


def _transferred_with_momentum(run: Run, arm: Arm) -> Array:
    """A run's initial state (2 nv,) in a finer chain, with the same momentum of its active joints.

    Initial rates of fast modes differ from chain to chain; a joint that turns freely must not drift by the difference.
    """
    state = transfer_state(run.chain, arm.chain, run.state)
    active = arm.chain.active
    if not active.size:
        return state
    recording = run.observed.recording
    (q, v), (finer_q, finer_v) = np.split(run.state, 2), np.split(state, 2)
    mass = mechanism_of(run.chain, run.arm.inputs(recording).payload).mass_matrix(q[None])[0]
    finer_mass = mechanism_of(arm.chain, arm.inputs(recording).payload).mass_matrix(finer_q[None])[0]
    missing = (mass @ v)[run.chain.active] - (finer_mass @ finer_v)[active]
    finer_v[active] += np.linalg.solve(finer_mass[np.ix_(active, active)], missing)
    return np.concatenate([finer_q, finer_v])


def _predicted(run: Run) -> Array:
    return run.observed.predicted(run.arm, run.trajectory)


def _chi2(run: Run, predicted: Array) -> float:
    residual = run.observed.whitened(run.observed.weights * (run.observed.values - predicted))
    return float(residual @ residual)
