"""Whether recordings can support a statement about what is missing."""

from __future__ import annotations

import numpy as np

from vjm.experiment.records import REFERENCE, Experiment, Recording

_LEAST_FRAMES = 30


def why_insufficient(experiment: Experiment) -> tuple[str, ...]:
    """Why an experiment's recordings cannot support a diagnosis, a sentence each; none where they can."""
    train, held_out = experiment.with_role("train"), experiment.with_role("holdout")
    found = []
    if not held_out:
        found.append(
            "no recording is held out, so that nothing could confirm a cause: give one of another kind or amplitude "
            'role = "holdout"'
        )
    moving = [each for each in train if each.kind in ("driven", "decay")]
    if len(moving) < 2 and not _referenced(experiment):
        found.append(
            "only one training recording moves: what is wrong in one recording looks like another initial state or "
            "another stiffness; record at least one more, with another amplitude or drive"
        )
    if _referenced(experiment):
        found += _contradictory(experiment)
    if any(_blind(each) for each in held_out) and all(_blind(each) for each in held_out):
        found.append("the held-out recordings show next to no marker: nothing could confirm a cause")
    return tuple(found)


def _referenced(experiment: Experiment) -> bool:
    return any(each.condition == REFERENCE for each in experiment.recordings)


def _contradictory(experiment: Experiment) -> list[str]:
    """What is wrong with recordings in the reference condition."""
    train = experiment.with_role("train")
    found = []
    if not any(each.condition == REFERENCE for each in train):
        found.append('recordings with condition = "reference" are held out only: none is there to train on')
    if all(each.condition == REFERENCE for each in train):
        found.append(
            'every training recording has condition = "reference", in which the effect sought is absent: none is left '
            "that could show it"
        )
    labels: dict[str, set[str | None]] = {}
    for each in experiment.recordings:
        if each.repeat is not None:
            labels.setdefault(each.repeat, set()).add(each.condition)
    found += [
        f'repeats "{label}" are said to be one experiment, and differ in their condition'
        for label, conditions in labels.items()
        if len(conditions) > 1
    ]
    return found


def _blind(recording: Recording) -> bool:
    return int(np.isfinite(recording.markers).any(axis=(1, 2)).sum()) < _LEAST_FRAMES
