"""Experiment files (TOML) and their recordings (CSV), read into an `Experiment`."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import tomllib
from pathlib import Path
from types import GenericAlias
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel, Field, ValidationError, create_model

from vjm.errors import ExperimentError, RecordingError, shown
from vjm.experiment.records import Array, Experiment, Indices, Link, Recording, Rig, check_columns
from vjm.experiment.schema import STRICT, explain, table_model

_TEXT = "a CSV text file in UTF-8"
_SECTIONS: dict[str, Any] = {
    "base": table_model(Rig, ("gravity",), ("gravity",)),
    "link": table_model(Link, required=("markers",)),
    "sensors": table_model(Rig, ("marker_noise", "encoder_noise")),
    "recording": table_model(Recording, required=("file", "role")),
}
_FIELDS: dict[str, Any] = {
    "schema_": (int, Field(alias="schema", ge=1, le=1, description="schema = 1, the only one there is")),
    "name": (str, table_model(Rig, ("name",)).model_fields["name"]),
    "base": (_SECTIONS["base"], Field(description="a table [base] with gravity = [x, y] in m/s^2")),
    "link": (
        GenericAlias(list, _SECTIONS["link"]),
        Field(min_length=1, description="at least one table [[link]], from the base outwards"),
    ),
    "sensors": (_SECTIONS["sensors"], Field(default=None, description="a table [sensors]")),
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
    """
    try:
        file = Path(path)
    except TypeError as error:
        raise ExperimentError(None, "", "", f"got {shown(path)}", "the path of an experiment file (TOML)") from error
    document = _read_toml(file)
    try:
        _FILE.model_validate(document)
    except ValidationError as error:
        raise _refusal(file, document, error) from error
    links, table_name = [], ""
    try:
        for index, table in enumerate(document["link"]):
            table_name = _table_name(document, "link", index)
            links.append(Link(**table))
        table_name = ""  # faults of the rig name their own
        rig = Rig(document["name"], tuple(links), **document["base"], **document.get("sensors", {}))
        rig.require_markers()
    except ExperimentError as error:
        raise error.at(file, table_name) from error
    files = _recording_files(file, document)
    tables = zip(files, document["recording"], strict=True)
    recordings = [_read_recording(source, table, rig) for source, table in tables]
    return Experiment(rig, tuple(recordings), file)


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


def _read_recording(file: Path, table: dict[str, Any], rig: Rig) -> Recording:
    """Return the recording in a CSV file; its table in the experiment file is valid by itself."""
    columns, body = _read_text(file)
    check_columns(file, columns, rig, table["kind"], table.get("input", "torque"), row=1)
    if not body or body.isspace():
        raise RecordingError(file, None, None, "no row follows the header", "rows of numbers")
    values, lines = _parse_at_once(body, columns) or _parse_row_by_row(file, columns, body.decode("utf-8"))
    try:
        return Recording.from_dataframe(pd.DataFrame(values, columns=list(columns)), rig, **table)
    except RecordingError as error:
        row = None if error.index is None else int(lines[error.index])
        raise RecordingError(file, row, error.column, error.problem, error.expected) from error


def _read_text(file: Path) -> tuple[tuple[str, ...], bytes]:
    try:
        raw = file.read_bytes()
    except (OSError, ValueError) as error:
        raise RecordingError(file, None, None, f"cannot be read ({error})", "a readable file") from error
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
    header, *rest = re.split(rb"\r\n|\n|\r", raw, maxsplit=1)
    return _split_header(file, header.decode("utf-8")), rest[0].rstrip(b"\r\n") if rest else b""


def _split_header(file: Path, header: str) -> tuple[str, ...]:
    try:
        names = tuple(name.strip() for name in next(csv.reader([header], strict=True), []))
    except csv.Error as error:
        raise RecordingError(file, 1, None, f"the header cannot be read ({error})", "column names") from error
    separator = next((mark for mark in ";\t" if len(names) == 1 and mark in header), None)
    if separator is not None:
        raise RecordingError(file, 1, None, f"cells are separated by {separator!r}", "cells separated by commas")
    return names


def _parse_at_once(body: bytes, columns: tuple[str, ...]) -> tuple[Array, Indices] | None:
    """Return the (T, c) values and their lines if every line is a full row of finite numbers; None otherwise."""
    separators = body.translate(None, b"0123456789+-.eE \t\r") + b"\n"  # and whatever does not belong in a number
    line = b"," * (len(columns) - 1) + b"\n"
    if separators != line * (len(separators) // len(columns)) or body.count(b"\r") != body.count(b"\r\n"):
        return None
    options: dict[str, Any] = {"index_col": False, "skip_blank_lines": False, "low_memory": False, "engine": "c"}
    empty: dict[str, Any] = {"na_values": [""], "keep_default_na": False}
    try:
        frame = pd.read_csv(io.BytesIO(body), header=None, names=list(columns), dtype=np.float64, **options, **empty)
    except ValueError:  # a cell such as 1-2: the slow path says where
        return None
    values = frame.to_numpy(dtype=np.float64)
    return None if np.isinf(values).any() else (values, np.arange(2, len(values) + 2, dtype=np.intp))


def _parse_row_by_row(file: Path, columns: tuple[str, ...], text: str) -> tuple[Array, Indices]:
    """Return (T, c) values and their lines of text that has quotes, blank lines, or a fault, which is located."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[list[float]] = []
    lines: list[int] = []
    try:
        for cells in reader:
            line = reader.line_num + 1  # after the header
            if not any(cell.strip() for cell in cells) and len(cells) <= 1:
                continue
            if len(cells) != len(columns):
                problem = f"{len(cells)} cell{'' if len(cells) == 1 else 's'}"
                raise RecordingError(file, line, None, problem, f"{len(columns)} cells, as in the header")
            rows.append([_parse_cell(file, line, *item) for item in zip(columns, cells, strict=True)])
            lines.append(line)
    except csv.Error as error:
        line = reader.line_num + 1
        raise RecordingError(file, line, None, f"cannot be read ({error})", "cells and commas") from error
    return np.array(rows, dtype=np.float64), np.array(lines, dtype=np.intp)


def _parse_cell(file: Path, line: int, column: str, text: str) -> float:
    cell = text.strip()
    if not cell:
        return math.nan
    number = re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", cell, re.ASCII)
    if number and math.isfinite(float(cell)):
        return float(cell)
    infinite = number or cell.lstrip("+-").lower() in {"inf", "infinity"}
    problem = f"an infinite value, {shown(cell)}" if infinite else f"{shown(cell)} is not a number"
    expected = "a finite number, or an empty cell where nothing was measured"
    raise RecordingError(file, line, column, problem, expected)
