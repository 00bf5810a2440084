"""Every recording replayed by the model without effects, by the extended one and by the runner-up."""

from __future__ import annotations

from collections.abc import Sequence

from vjm.diagnosis.base import Base
from vjm.diagnosis.holding import freed, replayed
from vjm.diagnosis.records import Replayed
from vjm.diagnosis.refit import Explanation
from vjm.errors import InsufficientDataError, SimulationDivergedError
from vjm.experiment.cleaning import cleaned
from vjm.experiment.records import Experiment, Recording
from vjm.identification.outliers import without_outliers
from vjm.model import Model
from vjm.simulate.initial_state import Replay, report
from vjm.simulate.observation import Observed
from vjm.simulate.run import Run
from vjm.symptoms import Followed, Symptoms, symptoms

_MOST_MODES = 4


def follow(
    experiment: Experiment, base: Base, plain: Explanation, best: Explanation, runner_up: Explanation | None
) -> tuple[Replayed, ...]:
    """All recordings, in the experiment's order."""
    noise = base.point.runs[0].observed.noise
    known = [_trained(each, plain) if each else {} for each in (plain, best, runner_up)]
    found = []
    for recording in experiment.recordings:
        if recording.file in known[0]:
            run = known[0][recording.file]
            replays = [_reported(each.get(recording.file)) for each in known]
            found.append(Replayed(run.observed.recording, *_three(replays), noise[0]))
            continue
        part = cleaned(experiment.rig, recording)
        after = _replayed(experiment, best, part, noise)
        if after is not None:
            part, _ = without_outliers(part, after.simulation.markers, noise[0])
            after = _replayed(experiment, best, part, noise)
        before = after if plain is best else _replayed(experiment, plain, part, noise)
        other = _replayed(experiment, runner_up, part, noise) if runner_up else None
        found.append(Replayed(part, before, after, other, noise[0]))
    return tuple(found)


def _three(replays: Sequence[Replay | None]) -> tuple[Replay | None, Replay | None, Replay | None]:
    before, after, other = replays
    return before, after, other


def _trained(explanation: Explanation, free: Explanation) -> dict[str, Run]:
    return {run.observed.recording.file: run for run in freed(explanation, free).point.runs}


def _reported(run: Run | None) -> Replay | None:
    return None if run is None else report(run, True)


def _replayed(
    experiment: Experiment, explanation: Explanation, recording: Recording, noise: tuple[float, float]
) -> Replay | None:
    """A recording that was not fitted; None where it cannot be simulated."""
    try:
        return report(*replayed(explanation, Observed.of(experiment.rig, recording, noise)))
    except (InsufficientDataError, SimulationDivergedError):
        return None


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
