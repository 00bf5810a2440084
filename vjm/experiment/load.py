"""From an experiment file to an `Experiment`."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from annotated_types import MinLen
from pydantic import BaseModel, Field, ValidationError, create_model

from vjm.errors import ExperimentError
from vjm.experiment.csv import read_recording
from vjm.experiment.experiment import Experiment
from vjm.experiment.records import Link, Recording, Rig
from vjm.experiment.schema import STRICT, explain, table_model

_SECTIONS: dict[str, Any] = {
    "base": table_model(Rig, ("gravity",), ("gravity",)),
    "link": table_model(Link, required=("markers",)),
    "sensors": table_model(Rig, ("marker_noise", "encoder_noise")),
    "recording": table_model(Recording, required=("file", "role")),
}


def _several(section: str) -> Any:
    return Annotated[list[_SECTIONS[section]], MinLen(1)]  # type: ignore[valid-type]


_FIELDS: dict[str, Any] = {
    "schema_": (int, Field(alias="schema", ge=1, le=1, description="schema = 1, the only one there is")),
    "name": (str, table_model(Rig, ("name",)).model_fields["name"]),
    "base": (_SECTIONS["base"], Field(description="a table [base] with gravity = [x, y] in m/s^2")),
    "link": (_several("link"), Field(description="at least one table [[link]], from the base outwards")),
    "sensors": (_SECTIONS["sensors"], Field(default=None, description="a table [sensors]")),
    "recording": (_several("recording"), Field(description="at least one table [[recording]]")),
}
_FILE = create_model("File", __config__=STRICT, **_FIELDS)


def load(path: str | os.PathLike[str]) -> Experiment:
    """Read an experiment file and every recording it lists; see `vjm.load_experiment`."""
    file = Path(path)
    document = _read_toml(file)
    try:
        _FILE.model_validate(document)
    except ValidationError as error:
        raise _refusal(file, document, error) from error
    links = []
    for index, table in enumerate(document["link"]):
        with _faults_of(file, _table_name(document, "link", index)):
            links.append(Link(**table))
    with _faults_of(file):
        rig = Rig(document["name"], tuple(links), **document["base"], **document.get("sensors", {}))
        rig.require_markers()
    files = _recording_files(file, document)
    tables = zip(files, document["recording"], strict=True)
    recordings = [read_recording(source, table, rig) for source, table in tables]
    return Experiment(rig, tuple(recordings), file)


@contextmanager
def _faults_of(file: Path, table: str = "") -> Iterator[None]:
    """Say of a fault in a record which file and table it stands in."""
    try:
        yield
    except ExperimentError as error:
        raise error.at(file, table) from error


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


def _table_name(document: dict[str, Any], section: str, index: int) -> str:
    """Return what errors call a table of an array of tables: `link[1] beam`, counted from 1."""
    table = document[section][index]
    label = table.get("name", table.get("file")) if isinstance(table, dict) else None
    place = f"{section}[{index + 1}]"
    return f"{place} {label}" if isinstance(label, str) and label else place


def _refusal(file: Path, document: dict[str, Any], error: ValidationError) -> ExperimentError:
    """Return the first fault pydantic found; unknown keys go first, being often the cause of missing ones."""
    details = sorted(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")
    section, *rest = details[0]["loc"]
    model: type[BaseModel] = _FILE
    table, key, items = "", str(section), rest
    if section in _SECTIONS and rest:
        model, table = _SECTIONS[str(section)], str(section)
        if isinstance(rest[0], int):
            table, rest = _table_name(document, table, rest[0]), rest[1:]
        key, items = str(rest[0]) if rest else "", rest[1:]
    problem, expected = explain(details[0], model, key, items)
    more = len(details) - 1
    note = f" (and {more} more fault{'s' if more > 1 else ''} in this file)" if more else ""
    return ExperimentError(file, table, key, problem + note, expected)


def _recording_files(file: Path, document: dict[str, Any]) -> list[Path]:
    """Return the paths of the recordings; each must exist, and none serve both fitting and holdout."""
    paths: list[Path] = []
    first: dict[Path, int] = {}
    tables = document["recording"]
    for index, table in enumerate(tables):
        place = _table_name(document, "recording", index)
        path = file.parent / table["file"]
        try:
            exists, resolved = path.is_file(), path.resolve()
        except (OSError, ValueError) as error:
            raise ExperimentError(file, place, "file", f"{path} cannot be read ({error})", "a CSV file") from error
        if not exists:
            problem = f"{path} is a directory" if path.is_dir() else f"there is no file {path}"
            raise ExperimentError(file, place, "file", problem, "a CSV file, its path relative to the experiment file")
        number = first.setdefault(resolved, index)
        role = tables[number]["role"]
        if role != table["role"]:
            problem = f"the same file is recording[{number + 1}], of role '{role}'"
            raise ExperimentError(file, place, "file", problem, "a file to be either train or holdout")
        paths.append(path)
    return paths
