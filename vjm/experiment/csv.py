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
from numpy.typing import NDArray

from vjm.errors import RecordingError, shown
from vjm.experiment.records import Array, Recording, Rig, check_columns

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_IN_CELLS = b"0123456789+-.eE \t\r"
_CELL = "a finite number, or an empty cell where nothing was measured"
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
    values, lines = _parse_cells(file, columns, body)
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


def _parse_cells(file: Path, columns: tuple[str, ...], body: bytes) -> tuple[Array, NDArray[np.intp]]:
    """Return the (T, c) numbers after a header, NaN where a cell is empty, and the line of the file of each row."""
    body = body.rstrip(b"\r\n")
    if not body or body.isspace():
        raise RecordingError(file, None, None, "no row follows the header", "rows of numbers")
    values = _parse_at_once(body, columns)
    if values is None:
        return _parse_row_by_row(file, columns, body.decode("utf-8"))
    lines = np.arange(2, len(values) + 2, dtype=np.intp)
    if np.isinf(values).any():
        row, column = np.argwhere(np.isinf(values))[0]
        raise RecordingError(file, int(lines[row]), columns[column], "an infinite value", _CELL)
    return values, lines


def _split_header(file: Path, header: str) -> tuple[str, ...]:
    try:
        names = tuple(name.strip() for name in next(csv.reader([header], strict=True), []))
    except csv.Error as error:
        raise RecordingError(file, 1, None, f"the header cannot be read ({error})", "column names") from error
    separator = next((mark for mark in ";\t" if len(names) == 1 and mark in header), None)
    if separator is not None:
        raise RecordingError(file, 1, None, f"cells are separated by {separator!r}", "cells separated by commas")
    return names


def _parse_at_once(body: bytes, columns: tuple[str, ...]) -> Array | None:
    """Return the (T, c) values of a body whose every line is a full row of plain numbers; None for any other body."""
    if not _is_plain(body, len(columns)):
        return None
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
            header=None,
            names=list(columns),
            index_col=False,
            dtype=np.float64,
            na_values=[""],
            keep_default_na=False,
            skip_blank_lines=False,
            engine="c",
            low_memory=False,
        )
    except ValueError:  # a cell such as 1-2: the slow path says where
        return None
    return frame.to_numpy(dtype=np.float64)


def _is_plain(body: bytes, width: int) -> bool:
    """Return True if a body has no character but those of numbers, and `width` cells in every line."""
    if body.count(b"\r") != body.count(b"\r\n"):
        return False
    separators = body.translate(None, _IN_CELLS) + b"\n"  # and whatever else does not belong in a number
    line = b"," * (width - 1) + b"\n"
    return separators == line * (len(separators) // width)


def _parse_row_by_row(file: Path, columns: tuple[str, ...], text: str) -> tuple[Array, NDArray[np.intp]]:
    """Read text that has a fault, quotes, or blank lines; locate the fault."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[list[float]] = []
    lines: list[int] = []
    try:
        for row in reader:
            if any(cell.strip() for cell in row) or len(row) > 1:
                rows.append(_parse_row(file, columns, reader.line_num + 1, row))
                lines.append(reader.line_num + 1)
    except csv.Error as error:
        raise RecordingError(
            file, reader.line_num + 1, None, f"cannot be read ({error})", "cells and commas"
        ) from error
    return np.array(rows, dtype=np.float64), np.array(lines, dtype=np.intp)


def _parse_row(file: Path, columns: tuple[str, ...], line: int, row: list[str]) -> list[float]:
    if len(row) != len(columns):
        expected = f"{len(columns)} cells, as in the header"
        raise RecordingError(file, line, None, f"{len(row)} cell{'' if len(row) == 1 else 's'}", expected)
    return [_parse_cell(file, line, name, cell.strip()) for name, cell in zip(columns, row, strict=True)]


def _parse_cell(file: Path, line: int, column: str, cell: str) -> float:
    if not cell:
        return math.nan
    if _NUMBER.fullmatch(cell):
        value = float(cell)
        if math.isfinite(value):
            return value
        raise RecordingError(file, line, column, f"an infinite value, {shown(cell)}", _CELL)
    infinite = cell.lstrip("+-").lower() in {"inf", "infinity"}
    problem = f"an infinite value, {shown(cell)}" if infinite else f"{shown(cell)} is not a number"
    raise RecordingError(file, line, column, problem, _CELL)
