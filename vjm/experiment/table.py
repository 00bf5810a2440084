"""One recording's CSV file, read into the arrays of a `Recording`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from vjm.errors import RecordingError
from vjm.experiment.cells import Cells, parse_cells, read_text
from vjm.experiment.faults import shown, suggestion
from vjm.experiment.records import Array, Kind, Link, Recording, Rig
from vjm.experiment.rules import recording_gravity
from vjm.experiment.schema import RecordingTable

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
