"""Units, frame and column names of recording files, and the conversion of what they hold to SI and the base frame."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import cos, pi, sin
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from vjm.errors import ExperimentError, RecordingError, shown, suggestion

if TYPE_CHECKING:
    from vjm.experiment.records import Input, Kind, Rig

Array = NDArray[np.float64]
_Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
_Offset = Annotated[float, Ge(-1e6), Le(1e6)]

# SI units in each unit that recordings may have.
FACTORS: dict[str, dict[str, float]] = {
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254},
    "angle": {"rad": 1.0, "deg": pi / 180.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "torque": {"N m": 1.0, "N mm": 1e-3},
}


@dataclass(frozen=True)
class Units:
    """Units of the numbers in recording files.

    Attributes:
        length: of marker coordinates.
        angle: of encoders.
        time: of the column `t`.
        torque: of active joints.
    """

    length: Annotated[Literal["m", "mm", "cm", "in"], '"m", "mm", "cm" or "in"'] = "m"
    angle: Annotated[Literal["rad", "deg"], '"rad" or "deg"'] = "rad"
    time: Annotated[Literal["s", "ms", "us"], '"s", "ms" or "us"'] = "s"
    torque: Annotated[Literal["N m", "N mm"], '"N m" or "N mm"'] = "N m"

    def factor(self, column: str) -> float:
        """Return what a number in a column, by its name in the documentation, is to be multiplied with to be SI."""
        quantity = {"t": "time", "theta": "angle", "tau": "torque"}.get(column.rpartition(".")[2], "length")
        return FACTORS[quantity][getattr(self, quantity)]


@dataclass(frozen=True)
class Camera:
    """Pose of the camera's frame in the base frame.

    Two of the camera's axes, in `axes`, span the plane; in that plane its frame is turned by `rotation` and has its
    origin at `origin`.

    Attributes:
        origin: (x, y) of the camera frame's origin in the base frame [m].
        rotation: of the camera's frame, counterclockwise in the base frame [rad].
        axes: columns of a marker's coordinates that are x and y, each with a minus sign where it points the other way.

    Raises:
        ExperimentError: both axes are the same column.
    """

    origin: Annotated[
        tuple[_Offset, _Offset], "two finite numbers, the camera's origin in the base frame [m], at most 1e6"
    ] = (0.0, 0.0)
    rotation: Annotated[float, Ge(-2 * pi), Le(2 * pi), "an angle in radians, at most 2 pi = 6.28"] = 0.0
    axes: Annotated[tuple[_Axis, _Axis], 'two of "x", "y", "z", "-x", "-y", "-z", as ["x", "-z"]'] = ("x", "y")

    def __post_init__(self) -> None:
        """Validate."""
        if self.letters[0] == self.letters[1]:
            expected = f'two different columns, as ["{self.axes[0]}", "{"y" if self.letters[0] != "y" else "x"}"]'
            raise ExperimentError(None, "camera", "axes", f"both are the column {self.letters[0]}", expected)

    @property
    def letters(self) -> tuple[str, str]:
        """Names of the two columns, without their signs."""
        return self.axes[0][-1], self.axes[1][-1]

    @property
    def columns(self) -> str:
        """Letters of all columns that a marker may have: the two, and x and y, which are read all the same."""
        return "".join(sorted({*"xy", *self.letters}))

    def to_base(self, first: Array, second: Array) -> tuple[Array, Array]:
        """Return x and y (T,) in the base frame [m] of the two columns' coordinates (T,) [m]."""
        signs = [-1.0 if axis.startswith("-") else 1.0 for axis in self.axes]
        x, y = signs[0] * first, signs[1] * second
        if self.rotation:
            x, y = cos(self.rotation) * x - sin(self.rotation) * y, sin(self.rotation) * x + cos(self.rotation) * y
        return x + self.origin[0], y + self.origin[1]


@dataclass(frozen=True)
class Conventions:
    """Meaning of the numbers in an experiment's recording files.

    Attributes:
        units: of the numbers.
        camera: the pose of its frame; markers whose `markers_frame` is the link's are not in it.
        columns: the files' names of columns by those of the documentation, where they differ.
    """

    units: Units = field(default_factory=Units)
    camera: Camera = field(default_factory=Camera)
    columns: Mapping[str, str] = field(default_factory=dict)

    def standard_name(self, column: str) -> str:
        """Return the documentation's name of a file's column; its own where it has no other."""
        return next((standard for standard, header in self.columns.items() if header == column), column)

    def name_in_files(self, column: str) -> str:
        """Return what the files call a column of the documentation."""
        return self.columns.get(column, column)

    def source_of(self, marker: str, axis: Literal["x", "y"], frame: str) -> str:
        """Return the files' column of a marker's coordinate in its frame; `MARKER.AXIS` where it mixes two columns."""
        if frame == "link":
            return self.name_in_files(f"{marker}.{axis}")
        letter = self.camera.letters["xy".index(axis)]
        return f"{marker}.{axis}" if self.camera.rotation else self.name_in_files(f"{marker}.{letter}")


def check_columns(name: Path | str, columns: Sequence[str], rig: Rig, kind: Kind, given: Input) -> None:
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


def known_columns(rig: Rig, letters: str) -> Iterator[str]:
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
        present = [pair for pair in pairs if pair[0] in columns or pair[1] in columns]
        if pairs and not present:
            yield pairs[0][1], f"columns of at least one marker of link '{link.name}'"
        for first, second in present:
            yield second, f"{x} and {y} of a marker, both [m]"
            if link.markers_frame == "base":
                yield first, f"both {x} and {y} of a marker measured in the base frame [m]"


def angle_of(link: str) -> str:
    """Return what is expected in the column of a link's joint angle."""
    return f"the angle of the active joint of link '{link}' [rad]"
