"""One recording's CSV file, read into the arrays of a `Recording`."""

from __future__ import annotations

import csv
import io
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from vjm.errors import RecordingError
from vjm.experiment.schema import RecordingTable, recording_gravity, shown, suggestion
from vjm.records import Array, Kind, Link, Recording, Rig

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_IN_CELLS = b"0123456789+-.eE \t\r"
_CELL = "a finite number, or an empty cell where nothing was measured"
_TEXT = "a CSV text file in UTF-8"


@dataclass(frozen=True)
class Cells:
    """A table of numbers.

    Attributes:
        columns: the c names in the header.
        values: (T, c), NaN where a cell is empty.
        lines: (T,) line of the file that each row stands on, the header being line 1.
    """

    columns: tuple[str, ...]
    values: Array
    lines: NDArray[np.intp]


def read_text(file: Path) -> tuple[tuple[str, ...], bytes]:
    """A CSV file's column names, and the bytes after the header line.

    Raises:
        RecordingError: the file cannot be read, is empty, or is not text.
    """
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


def parse_cells(file: Path, columns: tuple[str, ...], body: bytes) -> Cells:
    """The numbers after a header.

    Args:
        file: the CSV file, for errors.
        columns: its c >= 2 different column names.
        body: what follows the header line.

    Raises:
        RecordingError: a cell that is no finite number, a row with too many or too few cells, no row at all.
    """
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
    return Cells(columns, values, lines)


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
    """(T, c) values of a body whose every line is a full row of plain numbers; None for any other body."""
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
    """Whether a body has no character but those of numbers, and `width` cells in every line."""
    if body.count(b"\r") != body.count(b"\r\n"):
        return False
    separators = body.translate(None, _IN_CELLS) + b"\n"  # and whatever else does not belong in a number
    line = b"," * (width - 1) + b"\n"
    return separators == line * (len(separators) // width)


def _parse_row_by_row(file: Path, columns: tuple[str, ...], text: str) -> Cells:
    """The same as `parse_cells`, slower, for text that has a fault, quotes, or blank lines."""
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
    return Cells(columns, np.array(rows, dtype=np.float64), np.array(lines, dtype=np.intp))


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


MIN_FRAMES = 10


def read_recording(file: Path, table: RecordingTable, rig: Rig) -> Recording:
    """One recording.

    Args:
        file: its CSV file.
        table: its table in the experiment file.
        rig: the arm, which says what columns there can be.

    Raises:
        RecordingError: the file is unusable; the error names row and column where there is one.
    """
    columns, body = read_text(file)
    check_columns(file, columns, rig, table.kind)
    cells = parse_cells(file, columns, body)
    time = _gather(cells, ["t"])[:, 0]
    _check_time(file, cells, time)
    active = [rig.links[i].name for i in rig.active_links]
    theta = _gather(cells, [f"{name}.theta" for name in active])
    tau = _gather(cells, [f"{name}.tau" for name in active])
    names = [name for link in rig.links for name in _marker_columns(link)]
    markers = _gather(cells, names).reshape(len(time), -1, 2)
    _check_measured(file, rig, table.kind, theta, tau)
    _check_frames(file, rig, markers)
    gravity = recording_gravity(table, rig)
    return Recording(
        table.file, table.kind, table.role, time, theta, tau, markers, gravity, table.payload, table.repeat,
        table.condition,
    )  # fmt: skip


def check_columns(file: Path, columns: tuple[str, ...], rig: Rig, kind: Kind) -> None:
    """A header must have each column once, none that the rig does not know, and those that are needed.

    Args:
        file: the CSV file, for errors.
        columns: the header's names.
        rig: the arm.
        kind: of the recording; a driven one needs the torques.

    Raises:
        RecordingError: naming the column.
    """
    known = _known_columns(rig)
    for position, name in enumerate(columns):
        if name in columns[:position]:
            raise RecordingError(file, 1, name, "the column occurs twice", "each column once")
        if name not in known:
            problem = "a column without a name" if not name else _unknown_reason(name, rig, known)
            raise RecordingError(file, 1, name, problem, f"only the columns {_describe_columns(rig)}")
    for name, reason in _needed_columns(columns, rig, kind):
        if name not in columns:
            raise RecordingError(file, 1, name, "the column is missing", reason)


def _marker_columns(link: Link) -> list[str]:
    return [f"{link.name}.m{number}.{axis}" for number in range(1, len(link.markers) + 1) for axis in "xy"]


def _known_columns(rig: Rig) -> set[str]:
    joints = {f"{rig.links[i].name}.{quantity}" for i in rig.active_links for quantity in ("theta", "tau")}
    return {"t"} | joints | {name for link in rig.links for name in _marker_columns(link)}


def _describe_columns(rig: Rig) -> str:
    parts = ["t"]
    for link in rig.links:
        parts += [f"{link.name}.theta", f"{link.name}.tau"] if link.joint == "revolute" else []
        count = len(link.markers)
        numbers = "K = 1" if count == 1 else f"K = 1..{count}"
        parts += [f"{link.name}.mK.x and {link.name}.mK.y ({numbers})"] if count else []
    return ", ".join(parts)


def _unknown_reason(name: str, rig: Rig, known: set[str]) -> str:
    """What is wrong with a column name that is not among the known ones."""
    links = {link.name: link for link in rig.links}
    owner, _, quantity = name.partition(".")
    link = links.get(owner)
    if link is not None and quantity in ("theta", "tau"):
        return f"unknown column: link '{owner}' is clamped and has no active joint"
    if link is not None and re.fullmatch(r"m[1-9][0-9]*\.[xy]", quantity):
        return f"unknown column: link '{owner}' has {len(link.markers)} markers"
    if link is None and quantity:
        return f"unknown column: there is no link {shown(owner)}{suggestion(name, sorted(known))}"
    return f"unknown column{suggestion(name, sorted(known))}"


def _needed_columns(columns: tuple[str, ...], rig: Rig, kind: Kind) -> list[tuple[str, str]]:
    """Names of the columns a recording needs, given those it has, and why."""
    needed = [("t", "the time of each row [s]")]
    for link in rig.links:
        if link.joint == "revolute":
            needed.append((f"{link.name}.theta", f"the angle of the active joint of link '{link.name}' [rad]"))
        if link.joint == "revolute" and kind == "driven":
            needed.append((f"{link.name}.tau", f"the torque that drives link '{link.name}' [N m]"))
        pairs = [(f"{link.name}.m{number}.x", f"{link.name}.m{number}.y") for number in range(1, len(link.markers) + 1)]
        given = [pair for pair in pairs if pair[0] in columns or pair[1] in columns]
        if pairs and not given:
            needed.append((pairs[0][1], f"columns of at least one marker of link '{link.name}'"))
        for x, y in given:
            needed.append((y, "x and y of a marker, both [m]"))
            if link.markers_frame == "base":
                needed.append((x, "both x and y of a marker measured in the base frame [m]"))
    return needed


def _gather(cells: Cells, names: list[str]) -> Array:
    """(T, len(names)) the named columns, NaN for those the file does not have."""
    position = {name: index for index, name in enumerate(cells.columns)}
    out = np.full((len(cells.values), len(names)), np.nan)
    present = [index for index, name in enumerate(names) if name in position]
    out[:, present] = cells.values[:, [position[names[index]] for index in present]]
    return out


def _check_time(file: Path, cells: Cells, time: Array) -> None:
    bad = np.flatnonzero(np.isnan(time))
    if bad.size:
        raise RecordingError(file, int(cells.lines[bad[0]]), "t", "the time is missing", "a time in every row [s]")
    bad = np.flatnonzero(np.diff(time) <= 0.0)
    if bad.size:
        row = int(bad[0]) + 1
        problem = f"time does not increase, {time[row]:.9g} after {time[row - 1]:.9g}"
        raise RecordingError(file, int(cells.lines[row]), "t", problem, "a time later than the row before")


def _check_measured(file: Path, rig: Rig, kind: Kind, theta: Array, tau: Array) -> None:
    """Columns that are needed must also hold numbers."""
    for column, index in enumerate(rig.active_links):
        name = rig.links[index].name
        if not np.isfinite(theta[:, column]).any():
            raise RecordingError(file, None, f"{name}.theta", "every cell is empty", "joint angles [rad]")
        if kind == "driven" and not np.isfinite(tau[:, column]).any():
            raise RecordingError(file, None, f"{name}.tau", "every cell is empty", "joint torques [N m]")


def _check_frames(file: Path, rig: Rig, markers: Array) -> None:
    """Enough frames must have a marker whose position is known: y, and x where it is in the base frame."""
    measured = np.isfinite(markers)
    usable = measured[:, :, 1].copy()
    for link, own in zip(rig.links, rig.marker_slices, strict=True):
        if link.markers_frame == "base":
            usable[:, own] &= measured[:, own, 0]
    count = int(usable.any(axis=1).sum())
    if count < MIN_FRAMES:
        problem = f"{count} usable frame{'' if count == 1 else 's'}"
        raise RecordingError(file, None, None, problem, f"at least {MIN_FRAMES} rows with a measured marker")
