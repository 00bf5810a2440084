"""Every recording replayed by the model without effects, by the extended one and by the next best one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from vjm.diagnosis.baseline import Base
from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.encoder_feedback import replayed, without_feedback
from vjm.effects.effect import Effect
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.identification.outliers import trimmed
from vjm.records import Array, Experiment, RecordingComparison, SimulatedRecording
from vjm.simulation.initial_state import simulated_recording
from vjm.simulation.measurement import Observed
from vjm.simulation.model import Model
from vjm.simulation.run import Run
from vjm.symptoms.find import Symptoms, symptoms
from vjm.symptoms.records import Followed

Known = dict[str, tuple[Run, bool]]  # runs by file, and whether their initial states were found

_MOST_MODES = 4
LEAST_FRAMES = 40  # of a recording that is to show how a cause acts


def follow(
    experiment: Experiment, base: Base, plain: CandidateFit, best: CandidateFit, next_best: CandidateFit | None
) -> tuple[RecordingComparison, ...]:
    """All recordings, in the experiment's order."""
    noise = base.point.runs[0].observed.noise
    known = [_trained(each, plain) if each else {} for each in (plain, best, next_best)]
    others = [each for each in experiment.cleaned_recordings if each.file not in known[0]]
    observed = [Observed.of(experiment.rig, each, noise) for each in others]
    after = _replayed(best, observed)
    # Of the model that follows best, what stands out is an outlier.
    clean = {file: trimmed(run) for file, (run, _) in after.items()}
    again = [each for file, each in clean.items() if each is not after[file][0].observed]
    after |= _replayed(best, again, [after[each.recording.file][0].state for each in again])
    observed = [clean.get(each.recording.file, each) for each in observed]
    before = after if plain is best else _replayed(plain, observed)
    other = _replayed(next_best, observed) if next_best else {}
    for mine, further in zip(known, (before, after, other), strict=True):
        mine |= further
    shown = {each.recording.file: each.recording for each in observed}
    shown |= {file: run.observed.recording for file, (run, _) in known[0].items() if file not in shown}
    return tuple(
        RecordingComparison(
            recording=shown[each.file],
            noise=noise,
            simulated=_reported(known[1].get(each.file)),
            reference=_reported(known[0].get(each.file)),
            alternative=_reported(known[2].get(each.file)),
        )
        for each in experiment.recordings
    )


def most_improved(recordings: Sequence[RecordingComparison]) -> RecordingComparison | None:
    """Return the recording in which causes gain most, rather one held out; None where none can be simulated."""
    usable = [each for each in recordings if each.reference is not None and each.simulated is not None]
    moving = [each for each in usable if each.recording.kind != "quiet" and each.recording.frames.size >= LEAST_FRAMES]
    return max(moving or usable, key=_improvement, default=None)


def _improvement(comparison: RecordingComparison) -> float:
    """Return by how much the mean squared residual falls, in units of the noise; held out it counts twice."""
    before, after = (0.0 if one is None else one.marker_rms for one in (comparison.reference, comparison.simulated))
    weight = 2.0 if comparison.recording.role == "holdout" else 1.0
    return weight * (before**2 - after**2) / comparison.noise[0] ** 2


def without_cause(
    model: Model, cause: Effect, causes: Sequence[Effect], recordings: Sequence[RecordingComparison]
) -> SimulatedRecording | None:
    """Simulate the most improved recording with all effects of a model but one of the causes.

    Args:
        model: with the causes, and with what was present before a change.
        cause: the one to be left out.
        causes: all of them.
        recordings: simulated with and without the causes.

    Returns:
        None where it cannot be simulated. A single cause leaves the model fitted without it.
    """
    first = most_improved(recordings)
    if first is None or len(causes) == 1:
        return None if first is None else first.reference
    others = tuple(effect for effect in model.effects if effect.key != cause.key)
    try:
        return replace(model, effects=others).replay(first.recording)
    except (InsufficientDataError, SimulationDivergedError):
        return None


def _trained(candidate_fit: CandidateFit, free: CandidateFit) -> Known:
    return {run.observed.recording.file: (run, True) for run in without_feedback(candidate_fit, free).point.runs}


def _reported(found: tuple[Run, bool] | None) -> SimulatedRecording | None:
    return None if found is None else simulated_recording(*found)


def _replayed(
    candidate_fit: CandidateFit, observed: Sequence[Observed], states: Sequence[Array] | None = None
) -> Known:
    """Recordings that were not fitted, but those that cannot be simulated."""
    if not observed:
        return {}
    try:
        found = replayed(candidate_fit, observed, states)
    except (InsufficientDataError, SimulationDivergedError):
        if len(observed) == 1:
            return {}
        alone = [_replayed(candidate_fit, [each], states and [states[k]]) for k, each in enumerate(observed)]
        return {file: each for part in alone for file, each in part.items()}
    return {each.recording.file: one for each, one in zip(observed, found, strict=True)}


def found_symptoms(
    experiment: Experiment, plain: Model, followed: Sequence[RecordingComparison], base: Base
) -> Symptoms | None:
    """What the model without effects gets wrong."""
    frequencies = plain.modes().frequencies[:_MOST_MODES].tolist()
    shown = []
    for each in followed:
        if each.reference is None:
            continue
        own = None
        if each.recording.payload:
            own = tuple(plain.modes(each.recording.payload).frequencies[:_MOST_MODES].tolist())
        simulation = each.reference.simulation
        noise = (plain.marker_noise, plain.encoder_noise)
        shown.append(Followed(experiment.rig, each.recording, simulation.markers, simulation.theta, noise, own))
    return symptoms(shown, frequencies) if shown else None
