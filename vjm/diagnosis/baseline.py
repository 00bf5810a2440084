"""Baseline of a diagnosis: the model without effects, from which the search for effects starts.

The uniform model is fitted to the training recordings (to those in the reference condition, where there are any), with
the camera's noise estimated on the way and the chain's discretization error measured and known from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vjm.diagnosis.candidate_fit import INCOMPLETE_MISFIT
from vjm.diagnosis.discretization import corrected_for_discretization
from vjm.diagnosis.noise import Noise
from vjm.effects import BUILTIN
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.identification.training_data import TrainingData
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.identification.trajectory_method import TrajectoryMethod, first_fit, simulatable
from vjm.records import REFERENCE, Experiment, Progress
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run


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
        progress: called with (text, done, total) now and then.

    Raises:
        InsufficientDataError: recordings that cannot determine a model.
        SimulationDivergedError: no start can be simulated.
    """
    data = TrainingData.of(experiment)
    search, fit = first_fit(data, progress=progress, rough=True)
    resting, changed, unused = _further_recordings(experiment, search)
    rested, moved = _simulated(fit.point, resting), _simulated(fit.point, changed)
    pairs = zip((*resting, *changed), (*rested, *moved), strict=True)
    diverging = [measured.recording.file for measured, run in pairs if run is None]
    diverge = tuple(f"{file}: not used, as the model without effects diverges over it" for file in diverging)
    runs = [*fit.point.runs, *(run for run in rested if run is not None)]
    noise = Noise.of(runs)
    sensor_noise = search.observed[0].noise
    # The measured noise, whose own error is below 10 %, replaces a given one only if it is larger by more than that.
    if noise.std is not None and (experiment.rig.marker_noise is None or noise.std > 1.1 * sensor_noise[0]):
        sensor_noise = (noise.std, sensor_noise[1])
    # With eight joints the third mode's frequency is right to 0.1 % (`tests/chain/test_layout_accuracy.py`).
    joints = tuple(max(8, link.virtual_joints) for link in fit.point.chain.links)
    delay = max(effect.longest_delay(experiment.rig) for effect in BUILTIN)
    observed = tuple(_prepared(run, sensor_noise, noise, delay) for run in runs)
    fit = replace(fit, point=replace(fit.point, runs=tuple(runs)))
    # Where the model lacks much, its best parameters are only a start for the search: a rough minimum will do.
    fit = replace(search, observed=observed, rough=fit.point.misfit > INCOMPLETE_MISFIT).fit_from(joints, fit)
    prepared = tuple(_prepared(run, sensor_noise, noise, delay) for run in moved if run is not None)
    fit = corrected_for_discretization(fit, experiment.rig) or fit
    return Baseline(fit, noise, prepared, (*map(str, (*search.data.problems, *unused)), *diverge))


def _further_recordings(
    experiment: Experiment, search: TrajectoryMethod
) -> tuple[list[Observations], list[Observations], tuple[InsufficientDataError, ...]]:
    """Return training recordings not yet fitted: those at rest and those that may have changed; and why not others."""
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


def _simulated(point: Point, observed: Sequence[Observations]) -> list[Run | None]:
    """Simulate further recordings by the model of a fit; None for those that diverge."""
    runs: list[Run | None] = []
    for measured in observed:
        arm = point.problem.arms(point.x, [measured.recording])[0]
        try:
            runs += [run for run, _ in fit_initial_states([arm], [measured], step_multiple=point.problem.step_multiple)]
        except SimulationDivergedError:
            runs.append(None)
    return runs


def _prepared(run: Run, sensor_noise: tuple[float, float], noise: Noise, delay: float) -> Observations:
    """Return a run's measurements with the noise found, but without outliers.

    Frames that a camera with a delay [s] took outside the recording are left out as well.
    """
    recording = trimmed(run).recording
    if recording.theta.shape[1]:
        begin, end = recording.time[0] + delay, recording.time[-1] - delay
        interior = (recording.time >= begin) & (recording.time <= end)
        if interior.sum() > recording.time.size / 2:
            recording = replace(recording, markers=np.where(interior[:, None, None], recording.markers, np.nan))
    return run.with_motion_errors(noise.whitened(run.observed.of_recording(recording, sensor_noise)))
