"""A recording's CSV file, read into a `Recording`."""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vjm.errors import RecordingError, shown
from vjm.experiment.records import Array, Indices, Recording, Rig, check_columns

_TEXT = "a CSV text file in UTF-8"


def read_recording(file: Path, table: dict[str, Any], rig: Rig) -> Recording:
    """Return one recording.

    Args:
        file: its CSV file.
        table: its table in the experiment file, valid by itself.
        rig: the arm, which says what columns there can be.

    Raises:
        RecordingError: the file is unusable; the error names row and column where there is one.
    """
    columns, body = _read_text(file)
    check_columns(file, columns, rig, table["kind"], row=1)
    values, lines = _parse(file, columns, body)
    try:
        return Recording.from_dataframe(pd.DataFrame(values, columns=list(columns)), rig, **table)
    except RecordingError as error:
        row = None if error.row is None else int(lines[error.row])
        raise RecordingError(file, row, error.column, error.problem, error.expected) from error


def _read_text(file: Path) -> tuple[tuple[str, ...], bytes]:
    """Return a CSV file's column names, and the bytes after the header line."""
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
    return _split_header(file, header.decode("utf-8")), rest[0] if rest else b""


def _split_header(file: Path, header: str) -> tuple[str, ...]:
    try:
        names = tuple(name.strip() for name in next(csv.reader([header], strict=True), []))
    except csv.Error as error:
        raise RecordingError(file, 1, None, f"the header cannot be read ({error})", "column names") from error
    separator = next((mark for mark in ";\t" if len(names) == 1 and mark in header), None)
    if separator is not None:
        raise RecordingError(file, 1, None, f"cells are separated by {separator!r}", "cells separated by commas")
    return names


def _parse(file: Path, columns: tuple[str, ...], body: bytes) -> tuple[Array, Indices]:
    """Return the (T, c) numbers after a header, NaN where a cell is empty, and the line of the file of each row."""
    body = body.rstrip(b"\r\n")
    if not body or body.isspace():
        raise RecordingError(file, None, None, "no row follows the header", "rows of numbers")
    values = _parse_at_once(body, columns)
    if values is None:
        return _parse_row_by_row(file, columns, body.decode("utf-8"))
    return values, np.arange(2, len(values) + 2, dtype=np.intp)


def _parse_at_once(body: bytes, columns: tuple[str, ...]) -> Array | None:
    """Return the (T, c) values of a body whose every line is a full row of finite numbers; None for any other body."""
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
    return None if np.isinf(values).any() else values


def _parse_row_by_row(file: Path, columns: tuple[str, ...], text: str) -> tuple[Array, Indices]:
    """Read text that has a fault, quotes, or blank lines; locate the fault."""
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
