"""Names of a recording's columns: which there can be, and which there must be."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vjm.errors import RecordingError, shown, suggestion

if TYPE_CHECKING:
    from vjm.experiment.records import Input, Kind, Rig


def check_columns(name: Path | str, columns: Sequence[str], rig: Rig, kind: Kind, given: Input = "torque") -> None:
    """Check that each column occurs once, that the rig knows it, and that none is missing.

    Raises:
        RecordingError: naming the column, the file or recording.
    """
    check_known_columns(name, columns, rig)
    for column, expected in needed_columns(columns, rig, kind == "driven" and given == "torque"):
        if column not in columns:
            raise RecordingError(name, None, column, "the column is missing", expected)


def check_known_columns(
    name: Path | str, columns: Sequence[str], rig: Rig, row: int | None = None, letters: str = "xy"
) -> None:
    """Check that each column occurs once and that the rig knows it.

    Args:
        name: of the file or recording.
        columns: the names.
        rig: the arm.
        row: the line of a file that has them.
        letters: of a marker's coordinates in the base frame.

    Raises:
        RecordingError: naming the column, the file or recording, and the row.
    """
    known = set(known_columns(rig, letters))
    for position, column in enumerate(columns):
        if column in columns[:position]:
            raise RecordingError(name, row, column, "the column occurs twice", "each column once")
        if column not in known:
            problem = _unknown_reason(column, rig, known) if column else "a column without a name"
            raise RecordingError(name, row, column, problem, f"only the columns {_known_columns(rig, letters)}")


def known_columns(rig: Rig, letters: str = "xy") -> Iterator[str]:
    """Yield the names of all columns that recordings of a rig can have; `letters` as in `check_known_columns`."""
    yield "t"
    for link in rig.links:
        if link.joint == "revolute":
            yield from (f"{link.name}.{quantity}" for quantity in ("theta", "tau"))
        axes = letters if link.markers_frame == "base" else "xy"
        yield from (f"{link.name}.m{k}.{axis}" for k in range(1, len(link.markers) + 1) for axis in axes)


def _known_columns(rig: Rig, letters: str) -> str:
    parts = ["t"]
    for link in rig.links:
        parts += [f"{link.name}.theta", f"{link.name}.tau"] if link.joint == "revolute" else []
        count = len(link.markers)
        numbers = "K = 1" if count == 1 else f"K = 1..{count}"
        axes = letters if link.markers_frame == "base" else "xy"
        names = [f"{link.name}.mK.{axis}" for axis in axes]
        parts += [f"{', '.join(names[:-1])} and {names[-1]} ({numbers})"] if count else []
    return ", ".join(parts)


def _unknown_reason(column: str, rig: Rig, known: set[str]) -> str:
    owner, _, quantity = column.partition(".")
    link = {link.name: link for link in rig.links}.get(owner)
    if link is not None and quantity in ("theta", "tau"):
        return f"unknown column: link '{owner}' is clamped and has no active joint"
    if link is not None and quantity.endswith(".z") and f"{column[:-1]}x" in known:
        return "unknown column: neither axis of the base frame is z in [camera] axes"
    if link is not None and re.fullmatch(r"m[1-9][0-9]*\.[xyz]", quantity):
        return f"unknown column: link '{owner}' has {len(link.markers)} markers"
    if link is None and quantity:
        return f"unknown column: there is no link {shown(owner)}{suggestion(column, sorted(known))}"
    return f"unknown column{suggestion(column, sorted(known))}"


def needed_columns(
    columns: Sequence[str], rig: Rig, torque: bool, axes: tuple[str, str] = ("x", "y")
) -> Iterator[tuple[str, str]]:
    """Yield the names of the columns that a recording must have beside those it has, and what is expected in them.

    Args:
        columns: the names it has.
        rig: the arm.
        torque: whether a torque drives it.
        axes: letters of the two columns that hold a marker's position in the base frame.
    """
    yield "t", "the time of each row [s]"
    for link in rig.links:
        if link.joint == "revolute":
            yield f"{link.name}.theta", angle_of(link.name)
        if link.joint == "revolute" and torque:
            yield f"{link.name}.tau", f"the torque that drives link '{link.name}' [N m]"
        x, y = axes if link.markers_frame == "base" else ("x", "y")
        pairs = [(f"{link.name}.m{k}.{x}", f"{link.name}.m{k}.{y}") for k in range(1, len(link.markers) + 1)]
        given = [pair for pair in pairs if pair[0] in columns or pair[1] in columns]
        if pairs and not given:
            yield pairs[0][1], f"columns of at least one marker of link '{link.name}'"
        for first, second in given:
            yield second, f"{x} and {y} of a marker, both [m]"
            if link.markers_frame == "base":
                yield first, f"both {x} and {y} of a marker measured in the base frame [m]"


def angle_of(link: str) -> str:
    """Return what is expected in the column of a link's joint angle."""
    return f"the angle of the active joint of link '{link}' [rad]"
