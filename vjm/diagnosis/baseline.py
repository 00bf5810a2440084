"""Baseline of a diagnosis: the model without effects, from which the search for effects starts.

The uniform model is fitted to the training recordings (to those in the reference condition, where there are any), with
the camera's noise estimated on the way and the chain's discretization error measured and known from then on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import monotonic

import numpy as np

from vjm.diagnosis.candidate_fit import INCOMPLETE_MISFIT
from vjm.diagnosis.noise import Noise
from vjm.effects import BUILTIN
from vjm.effects.effect import is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.discretization import DiscretizationBias, first_order_bias, with_offset
from vjm.identification.outliers import trimmed
from vjm.identification.training_data import TrainingData
from vjm.identification.trajectory_fit import Point, TrajectoryFit, fit_trajectory
from vjm.identification.trajectory_method import TrajectoryMethod, first_fit, simulatable
from vjm.records import REFERENCE, Experiment, Progress, Rig
from vjm.simulation.initial_state import fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run

CLOSE_MISFIT = 2.0  # misfit up to which the discretization error is comparable with what else is missing


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
    runs = [*fit.point.runs, *_simulated(fit.point, resting)]
    noise = Noise.of(runs)
    sensor_noise = search.observed[0].noise
    # The measured noise, whose own error is below 10 %, replaces a given one only if it is larger by more than that.
    if noise.std is not None and (experiment.rig.marker_noise is None or noise.std > 1.1 * sensor_noise[0]):
        sensor_noise = (noise.std, sensor_noise[1])
    # With eight joints the third mode's frequency is right to 0.1 % (`tests/chain/test_layout_accuracy.py`).
    joints = tuple(max(8, link.virtual_joints) for link in fit.point.chain.links)
    delay = max(effect.longest_delay(experiment.rig) for effect in BUILTIN)
    observed = tuple(_prepared(run.observed, run, sensor_noise, noise, delay) for run in runs)
    fit = replace(fit, point=replace(fit.point, runs=tuple(runs)))
    # Where the model lacks much, its best parameters are only a start for the search: a rough minimum will do.
    fit = replace(search, observed=observed, rough=fit.point.misfit > INCOMPLETE_MISFIT).fit_from(joints, fit)
    changed_runs = [(measured, next(iter(_simulated(fit.point, [measured])), None)) for measured in changed]
    prepared = tuple(_prepared(measured, run, sensor_noise, noise, delay) for measured, run in changed_runs)
    fit = corrected_for_discretization(fit, experiment.rig) or fit
    return Baseline(fit, noise, prepared, (*search.data.problems, *unused))


def corrected_for_discretization(
    fit: TrajectoryFit, rig: Rig, negligible: float = 0.0, deadline: float = np.inf
) -> TrajectoryFit | None:
    """Fit a model beside its chain's discretization error, where what is missing is no larger than that may be.

    None where that error cannot be told, or not before a reading of `time.monotonic`, the deadline [s]. With stick-slip
    or play it is corrected to first order, but for a decrease of chi^2 that is negligible.
    """
    if fit.misfit > CLOSE_MISFIT:
        return fit
    if is_nonsmooth(fit.effects):
        return _corrected_to_first_order(fit, rig, negligible, deadline)
    bias = DiscretizationBias.of(fit.point, rig, CLOSE_MISFIT, deadline)
    return None if bias is None else bias.corrected(fit, CLOSE_MISFIT, deadline)


def _corrected_to_first_order(fit: TrajectoryFit, rig: Rig, negligible: float, deadline: float) -> TrajectoryFit | None:
    """Correct a model with stick-slip or play; where a joint only just sticks, further corrections need not settle.

    Where a beam's chi^2 is lower by no more than what is negligible, its parameters alone are told: a fit takes several
    times as long. None where what a beam leaves is more than noise and more than the chain leaves.
    """
    bias = None if monotonic() > deadline else first_order_bias(fit.point, rig)
    if bias is None:
        return None
    if bias.decrease <= negligible:
        nothing = [np.zeros_like(difference) for difference in bias.offset]
        return replace(fit, point=with_offset(fit.point, nothing), shift=bias.shift)
    point = with_offset(fit.point, bias.offset)
    states = [run.state for run in point.runs]
    try:
        beam = fit_trajectory(point.problem, point.x, None, states, stop=lambda *_: monotonic() > deadline)
    except (SimulationDivergedError, InsufficientDataError):
        return None
    if beam.chi2 > max(fit.chi2, beam.point.noise_limit):
        return None
    runs = zip(beam.point.runs, fit.point.runs, bias.offset, strict=True)
    offset = [after.predicted - before.predicted + difference for after, before, difference in runs]
    return replace(fit, point=with_offset(fit.point, offset), shift=beam.point.x - fit.point.x)


def corrected_again(fit: TrajectoryFit, rig: Rig, negligible: float, deadline: float) -> TrajectoryFit | None:
    """Measure the discretization error beside the effects of a model, and refit; None where that cannot be done.

    Without these effects, initial states of a wrong model took their part, which finer chains do not take over: what
    they lose looks like a discretization error, and biases damping.
    """
    if monotonic() > deadline:
        return None
    point = with_offset(fit.point, None)
    try:
        if point is not fit.point:
            fit = fit_trajectory(point.problem, point.x, None, point.states, stop=lambda *_: monotonic() > deadline)
    except (SimulationDivergedError, InsufficientDataError):
        return None
    corrected = corrected_for_discretization(fit, rig, negligible, deadline)
    return None if corrected is None or corrected.shift is None else corrected


def _further_recordings(
    experiment: Experiment, search: TrajectoryMethod
) -> tuple[list[Observations], list[Observations], tuple[str, ...]]:
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


def _simulated(point: Point, observed: Sequence[Observations]) -> list[Run]:
    """Simulate further recordings by the model of a fit; those that diverge are left out."""
    runs: list[Run] = []
    for measured in observed:
        arm = point.problem.arms(point.x, [measured.recording])[0]
        try:
            runs += [run for run, _ in fit_initial_states([arm], [measured], step_multiple=point.problem.step_multiple)]
        except SimulationDivergedError:
            continue
    return runs


def _prepared(
    observed: Observations, run: Run | None, sensor_noise: tuple[float, float], noise: Noise, delay: float
) -> Observations:
    """Return measurements with the noise found, but without outliers, which a run of them shows, if there is one.

    Frames that a camera with a delay [s] took outside the recording are left out as well.
    """
    recording = (observed if run is None else trimmed(run)).recording
    if recording.theta.shape[1]:
        begin, end = recording.time[0] + delay, recording.time[-1] - delay
        interior = (recording.time >= begin) & (recording.time <= end)
        if interior.sum() > recording.time.size / 2:
            recording = replace(recording, markers=np.where(interior[:, None, None], recording.markers, np.nan))
    observed = noise.whitened(observed.of_recording(recording, sensor_noise))
    return observed if run is None else run.with_motion_errors(observed)
