"""Experiment files (TOML) and their recordings (CSV), read into an `Experiment`."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import GenericAlias
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel, Field, ValidationError, create_model

from vjm.errors import ExperimentError, RecordingError, shown, suggestion
from vjm.experiment.arrays import check_time
from vjm.experiment.conventions import (
    Camera,
    Conventions,
    Units,
    check_known_columns,
    known_columns,
    needed_columns,
)
from vjm.experiment.records import (
    Array,
    Experiment,
    Indices,
    Link,
    Recording,
    Rig,
)
from vjm.experiment.schema import STRICT, explain, table_model
from vjm.files import as_path, check_file, read_file
from vjm.text import counted

_SEPARATORS = ",;\t"
# Stands in a proposed file for what has to be filled in: as no key takes it, reading the file names it.
UNKNOWN = "?"
_TEXT = "a CSV text file in UTF-8"
_SECTIONS: dict[str, Any] = {
    "base": table_model(Rig, ("gravity",), ("gravity",)),
    "link": table_model(Link, required=("markers",)),
    "sensors": table_model(Rig, ("marker_noise", "encoder_noise")),
    "units": table_model(Units),
    "camera": table_model(Camera),
    "recording": create_model(
        "recording",
        __base__=table_model(Recording, required=("file", "role")),
        motors_file=(str | None, Field(None, description="the name of a CSV file, relative to the experiment file")),
    ),
}
_COLUMNS = 'a name of the documentation and the files\' own, as "beam.m1.x" = "Marker1_X"'
_FIELDS: dict[str, Any] = {
    "schema_": (int, Field(alias="schema", ge=1, le=1, description="schema = 1, the only one there is")),
    "name": (str, table_model(Rig, ("name",)).model_fields["name"]),
    "base": (_SECTIONS["base"], Field(description="a table [base] with gravity = [x, y] in m/s^2")),
    "link": (
        GenericAlias(list, _SECTIONS["link"]),
        Field(min_length=1, description="at least one table [[link]], from the base outwards"),
    ),
    "sensors": (_SECTIONS["sensors"], Field(default=None, description="a table [sensors]")),
    "units": (_SECTIONS["units"], Field(default=None, description="a table [units] of the recordings' units")),
    "camera": (_SECTIONS["camera"], Field(default=None, description="a table [camera]")),
    "columns": (dict[str, Any], Field(default=None, description=f"a table [columns], in each line {_COLUMNS}")),
    "recording": (
        GenericAlias(list, _SECTIONS["recording"]),
        Field(min_length=1, description="at least one table [[recording]]"),
    ),
}
_FILE = create_model("File", __config__=STRICT, **_FIELDS)


def load_experiment(path: str | os.PathLike[str]) -> Experiment:
    """Read an experiment file and every recording it lists.

    Args:
        path: the TOML file; recordings are found relative to it.

    Returns:
        The experiment; its `warnings` hold what a user should know before trusting results.

    Raises:
        ExperimentError: the experiment file is unusable, or a recording it lists is missing.
        RecordingError: a recording is unusable.
        ShapeError: no path.
    """
    file = as_path("path", path, "the path of an experiment file (TOML)")
    document = parse_document(file, _read_toml(file))
    rig, conventions, files = described(file, document)
    all_columns: dict[str, None] = {}  # header names of all files, in order
    recordings: list[Recording] = []
    for index, (sources, table) in enumerate(zip(files, document["recording"], strict=True)):
        try:
            recordings.append(_read_recording(sources, table, rig, conventions, all_columns))
        except ExperimentError as error:  # a key of the table that contradicts another
            raise error.at(file, _table_name(document, "recording", index)) from error
    for standard, header in conventions.columns.items():
        if header not in all_columns:
            problem = f"no recording has a column {shown(header)}{suggestion(header, all_columns)}"
            expected = f"one of the files' columns: {', '.join(all_columns)}"
            raise ExperimentError(file, "columns", standard, problem, expected)
    known = {*known_columns(rig, "xyz"), *conventions.columns.values()}
    return Experiment(
        rig, tuple(recordings), file, conventions, tuple(name for name in all_columns if name not in known)
    )


def described(file: Path, document: dict[str, Any]) -> tuple[Rig, Conventions, list[list[Path]]]:
    """Return what an experiment file says: the arm, what recorded numbers mean, and the files; no recording is read.

    Args:
        file: the experiment file, relative to which recordings are found.
        document: its tables.

    Raises:
        ExperimentError: a key is unknown, missing or has the wrong value, or contradicts another.
    """
    try:
        _FILE.model_validate(document)
    except ValidationError as error:
        raise _refusal(file, document, error) from error
    links, table_name = [], ""
    try:
        for index, table in enumerate(document["link"]):
            table_name = _table_name(document, "link", index)
            links.append(Link(**table))
        table_name = ""  # faults of the rig and of the camera name their own
        rig = Rig(document["name"], tuple(links), **document["base"], **document.get("sensors", {}))
        rig.require_markers()
        camera = Camera(**document.get("camera", {}))
    except ExperimentError as error:
        raise error.at(file, table_name) from error
    if "camera" in document and not any(link.markers_frame == "base" and link.markers for link in rig.links):
        problem = (
            "every link's markers are in its own frame (markers_frame = \"link\"), which the camera's pose is not in"
        )
        raise ExperimentError(file, "camera", "", problem, 'no [camera], or markers_frame = "base"')
    columns = _renamed_columns(file, document.get("columns", {}), rig, camera)
    conventions = Conventions(Units(**document.get("units", {})), camera, columns)
    return rig, conventions, _recording_files(file, document)


def _renamed_columns(file: Path, table: dict[str, Any], rig: Rig, camera: Camera) -> dict[str, str]:
    """Return the files' column names by the documentation's, from the table [columns]; bare dotted keys in it nest."""
    columns: dict[str, str] = {}
    known = list(known_columns(rig, camera.columns))

    def collect(prefix: str, value: Any) -> None:
        if isinstance(value, dict) and value:
            for key, item in value.items():
                collect(f"{prefix}.{key}" if prefix else key, item)
            return
        if prefix not in known:
            problem = f"unknown column{suggestion(prefix, known)}"
            raise ExperimentError(file, "columns", prefix, problem, f"only the names {', '.join(known)}")
        if not isinstance(value, str) or value.strip() in {"", UNKNOWN}:
            raise ExperimentError(file, "columns", prefix, f"got {shown(value)}", "the name of a column, a string")
        existing = next((standard for standard, header in columns.items() if header == value.strip()), None)
        if existing is not None:
            expected = "a column of its own for each name"
            raise ExperimentError(file, "columns", prefix, f"{shown(value)} is already '{existing}'", expected)
        columns[prefix] = value.strip()

    if table:
        collect("", table)
    return columns


def _read_toml(file: Path) -> bytes:
    try:
        return read_file(file)
    except FileNotFoundError as error:
        raise ExperimentError(file, "", "", "there is no such file", "an experiment file (TOML)") from error
    except IsADirectoryError as error:
        raise ExperimentError(file, "", "", "this is a directory", "the experiment file (TOML) itself") from error
    except OSError as error:
        raise ExperimentError(file, "", "", f"cannot be read ({error.strerror})", "a readable file") from error


def parse_document(file: Path, raw: bytes) -> dict[str, Any]:
    """Return the tables of an experiment file's content; raise an `ExperimentError` where it is not valid TOML."""
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
    section, *location = details[0]["loc"]
    model: type[BaseModel] = _FILE
    table, key, items = "", str(section), location
    if section in _SECTIONS and location:
        model, table = _SECTIONS[str(section)], str(section)
        if isinstance(location[0], int):
            table, location = _table_name(document, table, location[0]), location[1:]
        key, items = str(location[0]) if location else "", location[1:]
    problem, expected = explain(details[0], model, key, items)
    remaining = len(details) - 1
    note = f" (and {counted(remaining, 'more fault')} in this file)" if remaining else ""
    return ExperimentError(file, table, key, problem + note, expected)


def _recording_files(file: Path, document: dict[str, Any]) -> list[list[Path]]:
    """Return for each recording its file and, where there is one, that of its motors."""
    paths: list[list[Path]] = []
    first: dict[str, int] = {}
    tables = document["recording"]
    for index, table in enumerate(tables):
        place = _table_name(document, "recording", index)
        path = _existing_file(file, place, "file", table["file"])
        number = first.setdefault(os.path.realpath(path), index)
        role = tables[number]["role"]
        if role != table["role"]:
            problem = f"the same file is recording[{number + 1}], of role '{role}'"
            raise ExperimentError(file, place, "file", problem, "a file to be either train or holdout")
        motors = [table["motors_file"]] if "motors_file" in table else []
        paths.append([path, *(_existing_file(file, place, "motors_file", name) for name in motors)])
    return paths


def _existing_file(file: Path, place: str, key: str, name: str) -> Path:
    path = file.parent / name
    try:
        check_file(path)
    except FileNotFoundError as error:
        expected = "a CSV file, its path relative to the experiment file"
        raise ExperimentError(file, place, key, f"there is no file {path}", expected) from error
    except OSError as error:
        raise ExperimentError(file, place, key, f"{path} cannot be read ({error.strerror})", "a CSV file") from error
    return path


@dataclass(frozen=True)
class RecordingTable:
    """Numbers of a recording file.

    Attributes:
        file: the CSV file.
        values: (T,) numbers of each column, in the file's units; NaN for an empty cell.
        lines: (T,) of the file, the header being line 1.
    """

    file: Path
    values: dict[str, Array]
    lines: Indices


def _read_recording(
    files: Sequence[Path], table: dict[str, Any], rig: Rig, conventions: Conventions, all_columns: dict[str, None]
) -> Recording:
    """Return the recording in a CSV file, or two; arguments and errors are those of `read_tables`."""
    tables = read_tables(files, table, rig, conventions, all_columns)
    fields = {key: value for key, value in table.items() if key != "motors_file"}
    return _to_recording(_merged(tables, conventions), tables, fields, rig, conventions)


def read_tables(
    files: Sequence[Path], table: dict[str, Any], rig: Rig, conventions: Conventions, all_columns: dict[str, None]
) -> list[RecordingTable]:
    """Return the numbers in the CSV file of a recording, or in its two.

    Args:
        files: the recording's, and that of its motors if there is one.
        table: the recording's in the experiment file, valid by itself.
        rig: the arm.
        conventions: of the files.
        all_columns: names of the files' columns are added to it.

    Raises:
        RecordingError: a column is unknown, missing or there twice, or a cell is no number.
    """
    tables = [_read_table(file, rig, conventions, all_columns) for file in files]
    columns = [column for csv_table in tables for column in csv_table.values]
    for column in tables[1].values if len(tables) > 1 else ():
        if column != "t" and ".m" in column:
            problem, expected = "a marker's column in a motors_file", "only times, angles and torques"
            raise RecordingError(tables[1].file, 1, conventions.name_in_files(column), problem, expected)
        if column != "t" and column in tables[0].values:
            problem = f"the column is in {tables[0].file.name} as well"
            raise RecordingError(tables[1].file, 1, conventions.name_in_files(column), problem, "it in one of them")
    torque = table["kind"] == "driven" and table.get("input", "torque") == "torque"
    for column, expected in needed_columns(columns, rig, torque, conventions.camera.letters):
        lacking = [csv_table for csv_table in tables if column not in csv_table.values]
        if len(lacking) == len(tables) or (lacking and column == "t"):  # times are needed in each file
            source = lacking[-1] if column.endswith((".theta", ".tau")) else lacking[0]
            name, problem = conventions.name_in_files(column), "the column is missing"
            if column in conventions.columns:
                problem += suggestion(name, [each for each in all_columns if each not in conventions.columns.values()])
            else:
                expected += ", or the file's name for it in [columns]"
            raise RecordingError(source.file, 1, name, problem, expected)
    return tables


def _read_table(file: Path, rig: Rig, conventions: Conventions, all_columns: dict[str, None]) -> RecordingTable:
    """Return the numbers of a file's columns that are named; others are an error unless [columns] names some."""
    header, separator, body = _read_text(file)
    all_columns.update(dict.fromkeys(header))
    letters = conventions.camera.columns
    names = [conventions.standard_name(name) for name in header]
    known = set(known_columns(rig, letters))
    used = tuple(not conventions.columns or name in known for name in names)
    try:
        check_known_columns(file, [name for name, use in zip(names, used, strict=True) if use], rig, 1, letters)
    except RecordingError as error:
        column = conventions.name_in_files(error.column or "")
        remedy = "" if conventions.columns or error.column in known else ", or the file's own names in [columns]"
        raise RecordingError(file, 1, column, error.problem, error.expected + remedy) from error
    numbers, lines = _parse(file, header, separator, body, used)
    columns = [(name, column) for name, use, column in zip(names, used, numbers.T, strict=True) if use]
    return RecordingTable(file, dict(columns), lines)


def _merged(tables: Sequence[RecordingTable], conventions: Conventions) -> tuple[dict[str, Array], Indices]:
    """Return the columns (T,) of one or two files by their time, and the row of each file (T, files); -1 for none."""
    times = [table.values["t"] for table in tables]
    for table, time in zip(tables, times, strict=True):
        try:
            check_time(str(table.file), conventions.name_in_files("t"), time)
        except RecordingError as error:
            row = None if error.index is None else int(table.lines[error.index])
            raise RecordingError(table.file, row, error.column, error.problem, error.expected) from error
    if len(tables) == 1:
        return dict(tables[0].values), np.arange(times[0].size)[:, None]
    first, second = times
    if first[-1] < second[0] or second[-1] < first[0]:
        (start, stop), camera = second[[0, -1]], tables[0].file.name
        others = f"in {camera} they are from {first[0]:.10g} to {first[-1]:.10g}"
        problem = f"times from {start:.10g} to {stop:.10g}; {others}"
        raise RecordingError(tables[1].file, None, conventions.name_in_files("t"), problem, "times by one clock")
    # Instants that differ by rounding share a row: in a ten thousandth of a sample no signal changes noticeably.
    tolerance = 1e-4 * float(np.median(np.diff(second))) if second.size > 1 else 0.0
    nearest = np.clip(np.searchsorted(first, second - tolerance), 0, first.size - 1)
    shared = np.abs(first[nearest] - second) <= tolerance
    shared[1:] &= (nearest[1:] != nearest[:-1]) | ~shared[:-1]
    time = np.concatenate([first, second[~shared]])
    order = np.argsort(time, kind="stable")
    rows = np.full((time.size, 2), -1, dtype=np.intp)
    rows[: first.size, 0] = np.arange(first.size)
    rows[nearest[shared], 1] = np.flatnonzero(shared)
    rows[first.size :, 1] = np.flatnonzero(~shared)
    rows = rows[order]
    values = {"t": time[order]}
    for table, table_rows in zip(tables, rows.T, strict=True):
        for column, numbers in table.values.items():
            if column != "t":
                values[column] = np.where(table_rows >= 0, numbers[table_rows], np.nan)
    return values, rows


def _to_recording(
    merged: tuple[dict[str, Array], Indices],
    tables: Sequence[RecordingTable],
    fields: dict[str, Any],
    rig: Rig,
    conventions: Conventions,
) -> Recording:
    """Return a recording with these fields, in SI and the base frame, of the numbers in its files."""
    values, rows = merged
    with np.errstate(over="ignore"):  # of absurd numbers; infinite ones are refused
        si = {name: numbers * conventions.units.factor(name) for name, numbers in values.items()}
        for link in rig.links:
            for k in range(1, len(link.markers) + 1) if link.markers_frame == "base" else ():
                marker = f"{link.name}.m{k}"
                coordinates = [si.pop(f"{marker}.{letter}", None) for letter in conventions.camera.letters]
                for letter in "xyz":
                    si.pop(f"{marker}.{letter}", None)
                if coordinates[0] is not None and coordinates[1] is not None:
                    si[f"{marker}.x"], si[f"{marker}.y"] = conventions.camera.to_base(coordinates[0], coordinates[1])
    try:
        return Recording.from_dataframe(pd.DataFrame(si), rig, **fields)
    except RecordingError as error:
        columns = [error.column or "", conventions.name_in_files(error.column or "")]
        owners = [k for k, csv_table in enumerate(tables) if columns[0] in csv_table.values]  # both of the time
        owner = next((k for k in reversed(owners) if error.index is None or rows[error.index, k] >= 0), 0)
        row = -1 if error.index is None else int(rows[error.index, owner])
        line = int(tables[owner].lines[row]) if row >= 0 else None
        raise RecordingError(tables[owner].file, line, columns[1] or None, error.problem, error.expected) from error


def read_numbers(file: Path) -> tuple[tuple[str, ...], Array]:
    """Return the names of a CSV file's columns, and their numbers (T, columns); NaN for a cell that holds none.

    Raises:
        RecordingError: it is no CSV file, or no row follows its header.
    """
    header, separator, body = _read_text(file)
    return header, _parse(file, header, separator, body, (False,) * len(header))[0]


def _read_text(file: Path) -> tuple[tuple[str, ...], str, bytes]:
    """Return the names in a file's header, what separates its cells, and what follows the header."""
    try:
        raw = read_file(file)
    except OSError as error:
        raise RecordingError(file, None, None, f"cannot be read ({error.strerror})", "a readable file") from error
    try:
        raw.isascii() or raw.decode("utf-8")  # the former is much faster
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise RecordingError(file, line, None, f"byte {raw[error.start]:#04x} is not UTF-8", _TEXT) from error
    if b"\0" in raw:
        raise RecordingError(file, raw.count(b"\n", 0, raw.index(b"\0")) + 1, None, "a NUL byte", _TEXT)
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if not raw or raw.isspace():
        raise RecordingError(file, None, None, "the file is empty", "a header line and rows of numbers")
    header, *body = re.split(rb"\r\n|\n|\r", raw, maxsplit=1)
    return *_split_header(file, header.decode("utf-8")), body[0].rstrip(b"\r\n") if body else b""


def _split_header(file: Path, header: str) -> tuple[tuple[str, ...], str]:
    """Return the names in a header and what separates them: a semicolon or a tab where there is nothing else."""
    found = [mark for mark in _SEPARATORS if mark in header] or [","]
    if len(found) > 1 and "," not in found:
        raise RecordingError(file, 1, None, "semicolons and tabs between names", "cells separated by one of them")
    try:
        names = tuple(name.strip() for name in next(csv.reader([header], delimiter=found[0], strict=True), []))
    except csv.Error as error:
        raise RecordingError(file, 1, None, f"the header cannot be read ({error})", "column names") from error
    if not names:
        raise RecordingError(file, 1, None, "the header is empty", "column names")
    return names, found[0]


def _parse(
    file: Path, columns: tuple[str, ...], separator: str, body: bytes, used: tuple[bool, ...]
) -> tuple[Array, Indices]:
    """Return the (T, c) values of what follows a header, and their lines.

    Where commas do not separate cells, they are decimal commas, and points none. A column that is not `used` is NaN
    where it holds no number.
    """
    decimal = "," if separator != "," and b"," in body else "."
    mixed = decimal == "," and b"." in body
    standard = body if separator == "," else body.translate(bytes.maketrans(f"{separator}{decimal}".encode(), b",."))
    parsed = None if body.isspace() or mixed else _parse_at_once(standard, len(columns))
    values, lines = parsed or _parse_row_by_row(file, columns, (separator, decimal), body.decode("utf-8"), used)
    if not lines.size:
        raise RecordingError(file, None, None, "no row follows the header", "rows of numbers")
    return values, lines


def _parse_at_once(body: bytes, count: int) -> tuple[Array, Indices] | None:
    """Return the (T, count) values and their lines if every line is a full row of finite numbers; else None."""
    separators = body.translate(None, b"0123456789+-.eE \t\r") + b"\n"  # and whatever does not belong in a number
    line = b"," * (count - 1) + b"\n"
    if separators != line * (len(separators) // count) or body.count(b"\r") != body.count(b"\r\n"):
        return None
    options: dict[str, Any] = {"index_col": False, "skip_blank_lines": False, "low_memory": False, "engine": "c"}
    empty: dict[str, Any] = {"na_values": [""], "keep_default_na": False}
    try:
        frame = pd.read_csv(io.BytesIO(body), header=None, names=range(count), dtype=np.float64, **options, **empty)
    except ValueError:  # a cell such as 1-2: the slow path says where
        return None
    values = frame.to_numpy(dtype=np.float64)
    return None if np.isinf(values).any() else (values, np.arange(2, len(values) + 2, dtype=np.intp))


def _parse_row_by_row(
    file: Path, columns: tuple[str, ...], marks: tuple[str, str], text: str, used: tuple[bool, ...]
) -> tuple[Array, Indices]:
    """Return (T, c) values and their lines of text that has quotes, blank lines, or a fault, which is located.

    `marks` are what separates cells and what separates decimals. Columns that are not `used` are NaN, whatever they
    hold.
    """
    separator, decimal = marks
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    rows: list[list[float]] = []
    lines: list[int] = []
    try:
        for cells in reader:
            line = reader.line_num + 1  # after the header
            if not any(cell.strip() for cell in cells) and len(cells) <= 1:
                continue
            if len(cells) != len(columns):
                expected = f"{len(columns)} cells, as in the header"
                raise RecordingError(file, line, None, counted(len(cells), "cell"), expected)
            named = zip(columns, cells, used, strict=True)
            rows.append([_parse_cell(file, line, name, cell, use, decimal) for name, cell, use in named])
            lines.append(line)
    except csv.Error as error:
        line = reader.line_num + 1
        raise RecordingError(file, line, None, f"cannot be read ({error})", "cells and separators") from error
    return np.array(rows, dtype=np.float64), np.array(lines, dtype=np.intp)


def _parse_cell(file: Path, line: int, column: str, text: str, used: bool, decimal: str) -> float:
    cell, mark = text.strip(), re.escape(decimal)
    number = re.fullmatch(rf"[+-]?(\d+{mark}?\d*|{mark}\d+)([eE][+-]?\d+)?", cell, re.ASCII)
    if number and math.isfinite(value := float(cell.replace(decimal, "."))):
        return value
    if not cell or not used:
        return math.nan
    infinite = number or cell.lstrip("+-").lower() in {"inf", "infinity"}
    problem = f"an infinite value, {shown(cell)}" if infinite else f"{shown(cell)} is not a number"
    written = " with a decimal comma, as others in this file" if decimal == "," else ""
    expected = f"a finite number{written}, or an empty cell where nothing was measured"
    raise RecordingError(file, line, column, problem, expected)
