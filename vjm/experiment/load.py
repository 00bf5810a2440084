"""From an experiment file to an `Experiment`."""

from __future__ import annotations

import math
import os
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from vjm.errors import ExperimentError
from vjm.experiment.checks import experiment_warnings
from vjm.experiment.csv import read_recording
from vjm.experiment.schema import (
    ExperimentTable,
    LinkTable,
    RecordingTable,
    experiment_error,
    recording_gravity,
    shown,
    table_name,
)
from vjm.records import Experiment, Link, Rig

_SECTION_KEYS = ("youngs_modulus", "width", "thickness")


def build_rig(file: Path, tables: ExperimentTable) -> Rig:
    """The rig an experiment file describes.

    Args:
        file: the experiment file, for errors.
        tables: its validated tables.

    Raises:
        ExperimentError: tables that contradict themselves or one another.
    """
    _check_names(file, tables.link)
    links = tuple(_build_link(file, index, table) for index, table in enumerate(tables.link))
    if not any(link.markers for link in links):
        raise ExperimentError(file, "link[1] " + links[0].name, "markers", "no link has a marker", "at least one")
    gravity = (tables.base.gravity[0], tables.base.gravity[1])
    return Rig(tables.name, links, gravity, tables.sensors.marker_noise, tables.sensors.encoder_noise)


def check_repeats(file: Path, tables: ExperimentTable, rig: Rig) -> None:
    """Recordings with one `repeat` label must be of one kind, payload and gravity.

    Raises:
        ExperimentError: naming the later of two recordings that contradict each other.
    """
    first: dict[str, int] = {}
    for index, table in enumerate(tables.recording):
        if table.repeat is None:
            continue
        other = first.setdefault(table.repeat, index)
        here, there = (_conditions(tables.recording[i], rig) for i in (index, other))
        for key, value in here.items():
            if value != there[key]:
                place = table_name("recording", other, tables.recording[other].file)
                problem = f"{shown(value)}, but [{place}] with the same repeat label '{table.repeat}' has another"
                name = table_name("recording", index, table.file)
                raise ExperimentError(file, name, key, problem, f"{shown(there[key])}, or another label")


def _conditions(table: RecordingTable, rig: Rig) -> dict[str, object]:
    return {"kind": table.kind, "payload": table.payload, "gravity": recording_gravity(table, rig)}


def _check_names(file: Path, tables: list[LinkTable]) -> None:
    first: dict[str, int] = {}
    for index, table in enumerate(tables):
        if first.setdefault(table.name, index) != index:
            problem = f"'{table.name}' is already the name of link[{first[table.name] + 1}]"
            raise ExperimentError(file, table_name("link", index, table.name), "name", problem, "a name of its own")


def _build_link(file: Path, index: int, table: LinkTable) -> Link:
    place = table_name("link", index, table.name)
    _check_markers(file, place, table)
    if table.hub_inertia is not None and table.joint == "clamped":
        raise ExperimentError(
            file, place, "hub_inertia", "the link is clamped and has no hub", 'this key only with joint = "revolute"'
        )
    return Link(
        name=table.name,
        joint=table.joint,
        length=table.length,
        mass=table.mass,
        bending_stiffness=_bending_stiffness(file, place, table),
        markers=tuple(table.markers),
        hub_inertia=table.hub_inertia or 0.0,
        payload=table.payload,
        markers_frame=table.markers_frame,
        width=table.width,
        thickness=table.thickness,
        youngs_modulus=table.youngs_modulus,
        virtual_joints=table.virtual_joints,
    )


def _check_markers(file: Path, place: str, table: LinkTable) -> None:
    previous = 0.0
    for number, marker in enumerate(table.markers, start=1):
        if marker > table.length:
            expected = f"arc lengths up to the link's length, {table.length:g} m"
            raise ExperimentError(file, place, "markers", f"item {number} is {marker:g}, beyond the link", expected)
        if marker <= previous:
            expected = "strictly increasing arc lengths, from the proximal end outwards"
            problem = f"item {number} is {marker:g} after {previous:g}"
            raise ExperimentError(file, place, "markers", problem, expected)
        previous = marker


def _bending_stiffness(file: Path, place: str, table: LinkTable) -> float:
    """EI as given, or E w h^3 / 12 [N m^2]."""
    given = [key for key in _SECTION_KEYS if getattr(table, key) is not None]
    either = "either youngs_modulus, width and thickness, or bending_stiffness"
    if table.bending_stiffness is not None:
        if given:
            raise ExperimentError(file, place, given[0], "given together with bending_stiffness", either)
        return table.bending_stiffness
    if table.youngs_modulus is None or table.width is None or table.thickness is None:
        absent = next(key for key in _SECTION_KEYS if key not in given) if given else "bending_stiffness"
        raise ExperimentError(file, place, absent, "missing", either)
    stiffness = table.youngs_modulus * table.width * table.thickness * table.thickness * table.thickness / 12.0
    if not (math.isfinite(stiffness) and stiffness > 0.0):
        problem = f"bending stiffness E w h^3 / 12 comes out as {stiffness:g}"
        raise ExperimentError(file, place, "youngs_modulus", problem, "values that give a finite positive one")
    return stiffness


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
