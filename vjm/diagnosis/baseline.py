"""Baseline of a diagnosis: the model without effects, and the point from which the search for effects starts.

The uniform model is fitted to the training recordings (to those in the reference condition, where there are any), with
the camera's noise estimated on the way and the chain's discretization error measured and known from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from vjm.diagnosis.candidate_fit import INCOMPLETE
from vjm.diagnosis.noise import Noise
from vjm.errors import SimulationDivergedError
from vjm.identification.discretization import DiscretizationBias
from vjm.identification.outliers import trimmed
from vjm.identification.training_data import TrainingData
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.identification.trajectory_method import TrajectoryMethod, first_fit, simulatable
from vjm.records import REFERENCE, Experiment, Progress
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

_LEAST_JOINTS = 8  # of a link: the third mode's frequency is then right to about one per cent (error of order 1/n^2)
_LARGER_NOISE = 1.1  # times the noise given, from which the measured one is used: its own error is below 10 %
_LARGEST_DELAY = 0.1  # s; bound of the camera delays that are looked for
CLOSE = 2.0  # misfit up to which the discretization error is comparable with what else is missing


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
