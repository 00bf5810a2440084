"""The experiment: a rig and what was recorded on it, with coordinates that cannot be right left out once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from vjm.errors import ExperimentError, shown
from vjm.experiment.checks import cleaned, experiment_warnings
from vjm.experiment.records import Recording, Rig, Role, as_rig, check_recording, several


@dataclass(frozen=True)
class Experiment:
    """A rig and what was recorded on it.

    Attributes:
        rig: the arm; a bare link is fine too.
        recordings: in the file's order; a bare one is fine too.
        file: the experiment file, None for an experiment built in Python.

    Raises:
        ExperimentError: no recording, or recordings of one `repeat` label that differ in kind, payload or gravity.
        RecordingError: a recording that does not fit the rig, or has fewer than 10 usable frames.
    """

    rig: Rig
    recordings: tuple[Recording, ...]
    file: Path | None = None

    def __post_init__(self) -> None:
        """Validate."""
        rig = as_rig(self.rig)
        rig.require_markers()
        recordings = []
        for number, recording in enumerate(several(self.recordings, Recording, "experiment", "recordings"), start=1):
            recording = recording.completed(rig, number)
            check_recording(recording.file, rig, recording)
            recordings.append(recording)
        object.__setattr__(self, "rig", rig)
        object.__setattr__(self, "recordings", tuple(recordings))
        self._check_repeats()

    def _check_repeats(self) -> None:
        """Refuse recordings of one `repeat` label that differ in kind, payload or gravity."""
        first: dict[str, int] = {}
        for index, recording in enumerate(self.recordings):
            if recording.repeat is None:
                continue
            number = first.setdefault(recording.repeat, index)
            other = self.recordings[number]
            for key in ("kind", "payload", "gravity"):
                here, there = getattr(recording, key), getattr(other, key)
                if here != there:
                    place = f"[recording[{number + 1}] {other.file}] with the same repeat label '{recording.repeat}'"
                    problem = f"{shown(here)}, but {place} has another"
                    table, expected = f"recording[{index + 1}] {recording.file}", f"{shown(there)}, or another label"
                    raise ExperimentError(self.file, table, key, problem, expected)

    def __repr__(self) -> str:
        lines = [repr(self.rig), *map(repr, self.recordings[:8])]
        more = len(self.recordings) - 8
        lines += [f"and {more} more recordings"] if more > 0 else []
        return "Experiment(" + "\n  ".join(lines) + ")"

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """Sentences that a user should read before trusting results."""
        return tuple(experiment_warnings(self.rig, self.recordings))

    @cached_property
    def cleaned_recordings(self) -> tuple[Recording, ...]:
        """The recordings without coordinates that cannot be right: what models are fitted to and compared with.

        Raises:
            RecordingError: nothing is left of a link's markers in a recording.
        """
        return tuple(cleaned(self.rig, recording) for recording in self.recordings)

    def with_role(self, role: Role) -> tuple[Recording, ...]:
        """Return the recordings of one role as they were read, in order."""
        return tuple(recording for recording in self.recordings if recording.role == role)
