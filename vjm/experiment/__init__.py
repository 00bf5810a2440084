"""The experiment: a rig and what was recorded on it, read from a TOML file and CSV recordings or built in Python."""

from __future__ import annotations

import os

from vjm.experiment.experiment import Experiment
from vjm.experiment.records import Link, Recording, Rig

__all__ = ["Experiment", "Link", "Recording", "Rig", "load_experiment"]


def load_experiment(path: str | os.PathLike[str]) -> Experiment:
    """Read an experiment file and every recording it lists.

    Args:
        path: the TOML file; recordings are found relative to it.

    Returns:
        The experiment; its `warnings` hold what a user should know before trusting results.

    Raises:
        ExperimentError: the experiment file is unusable, or a recording it lists is missing.
        RecordingError: a recording is unusable.
    """
    from vjm.experiment.load import load  # pandas and pydantic are slow to import

    return load(path)
