"""Simulations by the models of a search: open loop over whole recordings, those held out from the search as well."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import monotonic

import numpy as np

from vjm.chain.curve import transfer_state
from vjm.diagnosis.records import Cause, Diagnosis, held_out
from vjm.effects.effect import Key, is_nonsmooth
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.comparison import replay_each, replay_without_outliers
from vjm.identification.trajectory_fit import Point, TrajectoryFit
from vjm.records import Array, Experiment, RecordingComparison, Rig, SimulatedRecording
from vjm.simulation.arm import Arm
from vjm.simulation.initial_state import FEW_TRIALS, MOST_TRIALS, best_of_starts, fit_initial_states
from vjm.simulation.measurement import Observations
from vjm.simulation.run import Run, all_followed, state_at


def open_loop(fit: TrajectoryFit, whole: Sequence[Observations], deadline: float = np.inf) -> TrajectoryFit:
    """Return a model in whole recordings, from their most likely initial states, as far as known at the deadline.

    These are known where it was fitted to whole recordings and follows them; where it loses one, they are looked for
    anew. Recordings that it cannot be simulated over are left out. With stick-slip or
    play, whose simulations take many steps, the search for a state from that of a segment is a short one.
    """
    fitted = len(fit.point.runs) == len(whole)
    if fitted and all_followed(fit.point.runs):
        return fit
    problem = replace(fit.point.problem, observed=tuple(whole))

    def known(chosen: Sequence[int]) -> list[Run]:
        return [replace(fit.point.runs[k], observed=whole[k]) for k in chosen] if fitted else []

    def likely(chosen: Sequence[int]) -> list[Run]:
        states = None if fitted else [state_at(fit.point.runs, whole[k]) for k in chosen]
        early = states is not None and is_nonsmooth(fit.effects)
        observed = [whole[k] for k in chosen]
        trials = FEW_TRIALS if early else MOST_TRIALS
        runs = [run for run, _ in _simulate(fit, observed, states, trials, deadline)]
        if not fitted:
            return runs
        return [min(pair, key=lambda run: run.chi2) for pair in zip(runs, known(chosen), strict=True)]

    try:
        runs = likely(range(len(whole)))
    except SimulationDivergedError:
        runs = []  # some models fit segments but diverge over whole recordings, as with negative damping
        for k in range(len(whole)):
            try:
                runs += likely([k])
            except SimulationDivergedError:
                runs += known([k])
    problem = replace(problem, observed=tuple(run.observed for run in runs))
    return TrajectoryFit(Point(problem, fit.point.x, tuple(runs)))


def simulate_recordings(
    experiment: Experiment,
    noise: tuple[float, float],
    reference: TrajectoryFit,
    best: TrajectoryFit,
    next_best: TrajectoryFit | None,
    deadline: float = np.inf,
) -> tuple[RecordingComparison, ...]:
    """Simulate all recordings, without the outliers that the best model shows, from their most likely initial states.

    Recordings that were fitted have been simulated. With stick-slip or play no state is improved much after the
    deadline, a reading of `time.monotonic` [s].
    """
    known = {run.observed.recording.file: run.observed.recording for run in reference.point.runs}
    unfitted = [recording for recording in experiment.cleaned_recordings if recording.file not in known]
    observed, by_best = replay_without_outliers(
        partial(_simulate, best, deadline=deadline),
        [Observations.of(experiment.rig, recording, noise) for recording in unfitted],
    )
    recordings = known | {observation.recording.file: observation.recording for observation in observed}

    def by_file(model: TrajectoryFit | None) -> dict[str, SimulatedRecording]:
        if model is None:
            return {}
        fitted = [(run, True) for run in model.point.runs]
        replays = by_best if model is best else replay_each(partial(_simulate, model, deadline=deadline), observed)
        runs = [result for result in (*fitted, *replays) if not isinstance(result, str)]
        return {run.observed.recording.file: run.simulated_recording(converged) for run, converged in runs}

    after, before, alternative = by_file(best), by_file(reference), by_file(next_best)
    return tuple(
        RecordingComparison(recordings[file], noise, after.get(file), before.get(file), alternative.get(file))
        for file in (recording.file for recording in experiment.recordings)
    )


def with_holdout_gains(
    rig: Rig,
    causes: Sequence[Cause],
    recordings: Sequence[RecordingComparison],
    best: TrajectoryFit,
    fits: Mapping[frozenset[Key], TrajectoryFit],
) -> tuple[Cause, ...]:
    """Simulate the held-out recordings without each cause, all else fitted again, and say what it gains there.

    Args:
        rig: the arm.
        causes: of the best model.
        recordings: beside their simulations by the best model.
        best: the best model.
        fits: known ones, by the keys of their effects.
    """
    tested = held_out(recordings)
    if not tested:
        return tuple(causes)
    simulated = [comparison.simulated for comparison in tested if comparison.simulated is not None]
    after = _marker_rms(simulated)
    if len(causes) == 1:
        before = _marker_rms([comparison.reference for comparison in tested if comparison.reference is not None])
        return (replace(causes[0], holdout_gain=before - after),)
    observed = [Observations.of(rig, comparison.recording, comparison.noise) for comparison in tested]
    chains, gained = [arm.chain for arm in _arms(best, observed)], []
    for cause in causes:
        reduced, gain = fits.get(best.effect_keys - {cause.effect.key}), None
        if reduced is not None:
            triples = zip(chains, _arms(reduced, observed), simulated, strict=True)
            states = [transfer_state(chain, arm.chain, run.simulation.initial_state) for chain, arm, run in triples]
            with contextlib.suppress(SimulationDivergedError):
                runs = _simulate(reduced, observed, states)
                gain = _marker_rms([run.simulated_recording(converged) for run, converged in runs]) - after
        gained.append(replace(cause, holdout_gain=gain))
    return tuple(gained)


def _marker_rms(simulated: Sequence[SimulatedRecording]) -> float:
    """Return the RMS of the marker residuals of several recordings together [m]."""
    return float(np.sqrt(np.nanmean(np.concatenate([run.marker_residual.ravel() for run in simulated]) ** 2)))


def _arms(model: TrajectoryFit, observed: Sequence[Observations]) -> tuple[Arm, ...]:
    return model.point.problem.arms(model.point.x, [observations.recording for observations in observed])


def _simulate(
    model: TrajectoryFit,
    observed: Sequence[Observations],
    states: Sequence[Array | None] | None = None,
    max_trials: int = MOST_TRIALS,
    deadline: float = np.inf,
) -> list[tuple[Run, bool]]:
    """Simulate recordings by a model, from their most likely initial states; also say which of these were found.

    With stick-slip or play the likelihood of a state has many maxima, and simulations take many steps. States that are
    not known are first looked for in the recordings' first periods, from several starts, and after the deadline, a
    reading of `time.monotonic` [s], for a few steps only.
    """
    arms, multiple = _arms(model, observed), model.point.problem.step_multiple
    if not is_nonsmooth(model.effects):
        return fit_initial_states(arms, observed, states, multiple, max_trials)
    if states is None:
        duration = model.point.problem.first_horizon(model.point.x)
        first = [each.truncated(float(each.recording.time[0]) + duration) for each in observed]
        early = [run for run, _ in fit_initial_states(arms, first, None, multiple, max_trials)]
        pairs = [(k, run, effect) for k, run in enumerate(early) for effect in run.arm.effects]
        proposed = [(k, state) for k, run, effect in pairs for state in effect.other_states(run.chain, run.state)]
        early = best_of_starts(early, proposed, multiple)
        near = fit_initial_states(arms, observed, [run.state for run in early], multiple, FEW_TRIALS)
        if monotonic() > deadline or all(converged for _, converged in near):
            return near
        states = [run.state for run, _ in near]
    return fit_initial_states(arms, observed, states, multiple, max_trials, deadline)


def simulate_without_each_cause(findings: Diagnosis) -> Diagnosis:
    """Simulate the most improved recording without each cause: by the reference model where there is only one."""
    comparison = findings.most_improved
    if comparison is None or comparison.simulated is None:
        return findings
    causes = []
    for cause in findings.causes:
        remaining = tuple(effect for effect in findings.model.effects if effect.key != cause.effect.key)
        without = comparison.reference
        if len(findings.causes) > 1:
            try:
                model, recording = replace(findings.model, effects=remaining), comparison.recording
                source, target = findings.model.arm_in(recording).chain, model.arm_in(recording).chain
                state = transfer_state(source, target, comparison.simulated.simulation.initial_state)
                without = model.replay(recording, state)
            except (InsufficientDataError, SimulationDivergedError):
                without = None
        causes.append(replace(cause, without=without))
    return replace(findings, causes=tuple(causes))
