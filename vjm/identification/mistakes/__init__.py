"""Mistakes that people make in experiments, found before anything is fitted: units, axes, signs, order, noise."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from warnings import catch_warnings, simplefilter

import numpy as np

from vjm.errors import MistakeError
from vjm.experiment.checks import MIN_FRAMES, tracked
from vjm.identification.mistakes.evidence import Mistake
from vjm.identification.mistakes.geometry import (
    distance_mistakes,
    heading_mistakes,
    length_mistake,
    origin_mistakes,
    sideways_mistakes,
    untracked_mistakes,
)
from vjm.identification.mistakes.rig import noise_mistakes, rig_mistakes, sag_mistakes
from vjm.identification.mistakes.torque import balances, torque_gains, torque_mistakes, torque_sign
from vjm.records import Experiment


def find_mistakes(experiment: Experiment) -> tuple[Mistake, ...]:
    """Look for mistakes that explain the recordings far better than the experiment file does.

    Checks that rest on something found wrong are skipped: first the geometry, then the rest. Nothing is changed.
    """
    with np.errstate(all="ignore"), catch_warnings():  # of absurd numbers, which are what is looked for
        simplefilter("ignore", RuntimeWarning)
        lengths = [mistake for link in experiment.rig.links if (mistake := length_mistake(link))]
        untracked = tuple(untracked_mistakes(experiment))
        skipped = {file for mistake in untracked for file in mistake.files}
        experiment = _tracked(experiment, skipped)
        geometric = [*lengths, *untracked, *distance_mistakes(experiment, skipped), *sideways_mistakes(experiment)]
        wrong_files = {file for mistake in geometric for file in mistake.files}
        if lengths or len(wrong_files) == len({recording.file for recording in experiment.recordings}):
            return tuple(geometric)
        moments = [] if wrong_files else balances(experiment)
        gains = torque_gains(experiment, moments)
        turned = heading_mistakes(experiment, tuple(wrong_files), torque_sign(gains))
        moved = origin_mistakes(experiment, tuple(wrong_files))
        if turned or moved or wrong_files:
            return (*geometric, *turned, *moved, *noise_mistakes(experiment))
        numbers = rig_mistakes(experiment)
        if not any(mistake.certain for mistake in numbers):
            torques = torque_mistakes(experiment, moments, gains)
            numbers = torques if any(mistake.certain for mistake in torques) else [*numbers, *torques]
        if not any(mistake.certain for mistake in numbers):
            numbers = [*numbers, *sag_mistakes(experiment)]
        return (*numbers, *noise_mistakes(experiment))


def _tracked(experiment: Experiment, skipped: Collection[str]) -> Experiment:
    """Return the experiment without markers that were not tracked; recordings that are skipped are left as they are."""
    rig, origin = experiment.rig, experiment.conventions.camera.origin
    recordings = tuple(
        recording if recording.file in skipped else tracked(rig, recording, origin)
        for recording in experiment.recordings
    )
    enough = all(recording.frames.size >= MIN_FRAMES for recording in recordings)
    changed = any(new is not old for new, old in zip(recordings, experiment.recordings, strict=True))
    return replace(experiment, recordings=recordings) if enough and changed else experiment


def refuse_mistakes(experiment: Experiment) -> tuple[str, ...]:
    """Raise a `MistakeError` if there is a mistake that is certain; else return those that are likely, as warnings."""
    mistakes = find_mistakes(experiment)
    certain = [str(mistake) for mistake in mistakes if mistake.certain]
    if certain:
        raise MistakeError(certain)
    return tuple(str(mistake) for mistake in mistakes)


__all__ = ["Mistake", "find_mistakes", "refuse_mistakes"]
