"""Every recording replayed by the model without effects, by the extended one and by the runner-up."""

from __future__ import annotations

from collections.abc import Sequence

from vjm.diagnosis.baseline import Base
from vjm.diagnosis.candidate_fit import CandidateFit
from vjm.diagnosis.encoder_feedback import replayed, without_feedback
from vjm.diagnosis.records import Replayed
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.experiment.cleaning import cleaned
from vjm.identification.outliers import trimmed
from vjm.records import Array, Experiment
from vjm.simulation.initial_state import Replay, report
from vjm.simulation.measurement import Observed
from vjm.simulation.model import Model
from vjm.simulation.run import Run
from vjm.symptoms.find import Symptoms, symptoms
from vjm.symptoms.records import Followed

Known = dict[str, tuple[Run, bool]]  # runs by file, and whether their initial states were found

_MOST_MODES = 4


def follow(
    experiment: Experiment, base: Base, plain: CandidateFit, best: CandidateFit, next_best: CandidateFit | None
) -> tuple[Replayed, ...]:
    """All recordings, in the experiment's order."""
    noise = base.point.runs[0].observed.noise
    known = [_trained(each, plain) if each else {} for each in (plain, best, next_best)]
    others = [cleaned(experiment.rig, each) for each in experiment.recordings if each.file not in known[0]]
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
        Replayed(shown[each.file], *_three([_reported(mine.get(each.file)) for mine in known]), noise[0])
        for each in experiment.recordings
    )


def _three(replays: Sequence[Replay | None]) -> tuple[Replay | None, Replay | None, Replay | None]:
    before, after, next_best = replays
    return before, after, next_best


def _trained(candidate_fit: CandidateFit, free: CandidateFit) -> Known:
    return {run.observed.recording.file: (run, True) for run in without_feedback(candidate_fit, free).point.runs}


def _reported(found: tuple[Run, bool] | None) -> Replay | None:
    return None if found is None else report(*found)


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


def found_symptoms(experiment: Experiment, plain: Model, followed: Sequence[Replayed], base: Base) -> Symptoms | None:
    """What the model without effects gets wrong."""
    frequencies = plain.modes().frequencies[:_MOST_MODES].tolist()
    shown = []
    for each in followed:
        if each.before is None:
            continue
        own = None
        if each.recording.payload:
            own = tuple(plain.modes(each.recording.payload).frequencies[:_MOST_MODES].tolist())
        simulation = each.before.simulation
        noise = (plain.marker_noise, plain.encoder_noise)
        shown.append(Followed(experiment.rig, each.recording, simulation.markers, simulation.theta, noise, own))
    return symptoms(shown, frequencies) if shown else None
