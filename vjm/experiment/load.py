"""From an experiment file to an `Experiment`."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vjm.errors import ExperimentError
from vjm.experiment.checks import experiment_warnings
from vjm.experiment.faults import experiment_error, table_name
from vjm.experiment.records import Experiment
from vjm.experiment.rules import build_rig, check_repeats
from vjm.experiment.schema import ExperimentTable
from vjm.experiment.table import read_recording


def load_experiment(path: str | os.PathLike[str]) -> Experiment:
    """Read an experiment file and every recording it lists.

    Args:
        path: the TOML file; recordings are found relative to it.

    Returns:
        The experiment, with warnings.

    Raises:
        ExperimentError: the experiment file is unusable, or a recording it lists is missing.
        RecordingError: a recording is unusable.
    """
    file = Path(path)
    tables = parse_experiment(file)
    rig = build_rig(file, tables)
    check_repeats(file, tables, rig)
    recordings = tuple(
        read_recording(source, table, rig)
        for source, table in zip(_recording_files(file, tables), tables.recording, strict=True)
    )
    return Experiment(rig, recordings, file, tuple(experiment_warnings(rig, recordings)))


def parse_experiment(file: Path) -> ExperimentTable:
    """The tables of an experiment file, each valid by itself.

    Raises:
        ExperimentError: the file cannot be read, is not TOML, or has a faulty table or key.
    """
    document = _read_toml(file)
    try:
        return ExperimentTable.model_validate(document)
    except ValidationError as error:
        raise experiment_error(file, document, error) from error


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        raw = file.read_bytes()
    except FileNotFoundError as error:
        raise ExperimentError(file, "", "", "there is no such file", "an experiment file (TOML)") from error
    except IsADirectoryError as error:
        raise ExperimentError(file, "", "", "this is a directory", "the experiment file (TOML) itself") from error
    except (OSError, ValueError) as error:
        raise ExperimentError(file, "", "", f"cannot be read ({error})", "a readable file") from error
    try:
        return tomllib.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ExperimentError(file, "", "", f"line {line} is not UTF-8", "a text file in UTF-8") from error
    except RecursionError as error:
        raise ExperimentError(file, "", "", "values nested too deeply", "the tables of an experiment") from error
    except ValueError as error:  # TOMLDecodeError, or a number with thousands of digits
        raise ExperimentError(file, "", "", f"not valid TOML: {error}", "valid TOML") from error


def _recording_files(file: Path, tables: ExperimentTable) -> list[Path]:
    """Paths of the recordings; each must exist, and none serve both fitting and holdout."""
    paths: list[Path] = []
    first: dict[Path, int] = {}
    for index, table in enumerate(tables.recording):
        place = table_name("recording", index, table.file)
        path = file.parent / table.file
        try:
            exists, resolved = path.is_file(), path.resolve()
        except (OSError, ValueError) as error:
            raise ExperimentError(file, place, "file", f"{path} cannot be read ({error})", "a CSV file") from error
        if not exists:
            problem = f"{path} is a directory" if path.is_dir() else f"there is no file {path}"
            raise ExperimentError(file, place, "file", problem, "a CSV file, its path relative to the experiment file")
        other = first.setdefault(resolved, index)
        if tables.recording[other].role != table.role:
            problem = f"the same file is recording[{other + 1}], of role '{tables.recording[other].role}'"
            raise ExperimentError(file, place, "file", problem, "a file to be either train or holdout")
        paths.append(path)
    return paths
