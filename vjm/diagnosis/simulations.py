"""Open-loop simulations of all recordings by the models that a diagnosis compares, and the baseline's symptoms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.encoder_feedback import simulate_open_loop, without_feedback
from vjm.diagnosis.records import Findings
from vjm.diagnosis.symptoms import Symptoms, symptoms
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.records import Array, Experiment, RecordingComparison
from vjm.simulation.initial_state import simulated_recording
from vjm.simulation.measurement import Observations
from vjm.simulation.model import Model
from vjm.simulation.run import Run

_Runs = dict[str, tuple[Run, bool]]  # by file: the simulation, and whether its initial state was found


def compare_recordings(
    experiment: Experiment,
    noise: tuple[float, float],
    before: CandidateFit,
    best: CandidateFit,
    next_best: CandidateFit | None,
) -> tuple[RecordingComparison, ...]:
    """Simulate all recordings by up to three models, from their most likely initial states.

    Args:
        experiment: the recordings, in whose order the result is.
        noise: 1-sigma of a marker coordinate [m] and of an encoder [rad].
        before: the model before any change, fitted to all training recordings that can be used.
        best: the model with the causes; its outliers are left out of the recordings.
        next_best: the next best model; None where there is none.
    """
    recordings = {run.observed.recording.file: run.observed.recording for run in before.point.runs}
    further = [recording for recording in experiment.cleaned_recordings if recording.file not in recordings]
    observed = [Observations.of(experiment.rig, recording, noise) for recording in further]
    by_best = _simulate(best, observed)
    trimmed_runs = {file: trimmed(run) for file, (run, _) in by_best.items()}
    changed = [clean for file, clean in trimmed_runs.items() if clean is not by_best[file][0].observed]
    by_best |= _simulate(best, changed, [by_best[clean.recording.file][0].state for clean in changed])
    observed = [trimmed_runs.get(one.recording.file, one) for one in observed]
    recordings |= {one.recording.file: one.recording for one in observed}
    by_before = by_best if before is best else _simulate(before, observed)
    by_next = _simulate(next_best, observed) if next_best else {}
    after, reference, alternative = (
        {file: simulated_recording(*run) for file, run in (_fitted(model, before) | runs).items()}
        for model, runs in ((best, by_best), (before, by_before), (next_best, by_next))
    )
    return tuple(
        RecordingComparison(recordings[file], noise, after.get(file), reference.get(file), alternative.get(file))
        for file in (recording.file for recording in experiment.recordings)
    )


def _fitted(model: CandidateFit | None, open_loop: CandidateFit) -> _Runs:
    if model is None:
        return {}
    return {run.observed.recording.file: (run, True) for run in without_feedback(model, open_loop).point.runs}


def _simulate(model: CandidateFit, observed: Sequence[Observations], states: Sequence[Array] | None = None) -> _Runs:
    """Simulations of recordings that were not fitted; those that are not possible are left out."""
    if not observed:
        return {}
    try:
        runs = simulate_open_loop(model, observed, states)
    except (InsufficientDataError, SimulationDivergedError):
        if len(observed) == 1:
            return {}
        single = [_simulate(model, [one], states and [states[k]]) for k, one in enumerate(observed)]
        return {file: run for part in single for file, run in part.items()}
    return {one.recording.file: run for one, run in zip(observed, runs, strict=True)}


def simulate_without_each_cause(findings: Findings) -> Findings:
    """Simulate the most improved recording without each cause; a single one leaves the model fitted without it."""
    shown = findings.most_improved
    if shown is None:
        return findings
    causes = []
    for cause in findings.causes:
        others = tuple(effect for effect in findings.model.effects if effect.key != cause.effect.key)
        without = shown.reference
        if len(findings.causes) > 1:
            try:
                without = replace(findings.model, effects=others).replay(shown.recording)
            except (InsufficientDataError, SimulationDivergedError):
                without = None
        causes.append(replace(cause, without=without))
    return replace(findings, causes=tuple(causes))


def find_symptoms(model: Model, recordings: Sequence[RecordingComparison]) -> Symptoms | None:
    """Describe what the model before any change gets wrong; None where it cannot simulate any recording."""
    count = 4  # more modes are hardly ever seen by a camera
    shown = [comparison.reference for comparison in recordings if comparison.reference is not None]
    payloads = sorted({0.0} | {simulated.recording.payload for simulated in shown})
    frequencies = {payload: model.modes(payload).frequencies[:count].tolist() for payload in payloads}
    return symptoms(model.rig, shown, frequencies) if shown else None
