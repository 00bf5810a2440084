"""Units, frame and column names of recording files, and the conversion of what they hold to SI and the base frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, pi, sin
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray

from vjm.errors import ExperimentError

Array = NDArray[np.float64]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
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
    rotation: Annotated[float, Ge(-1e6), Le(1e6), "a finite number [rad], at most 1e6"] = 0.0
    axes: Annotated[tuple[Axis, Axis], 'two of "x", "y", "z", "-x", "-y", "-z", as ["x", "-z"]'] = ("x", "y")

    def __post_init__(self) -> None:
        """Validate."""
        if self.letters[0] == self.letters[1]:
            expected = f'two different columns, as ["{self.axes[0]}", "{"y" if self.letters[0] != "y" else "x"}"]'
            raise ExperimentError(None, "camera", "axes", f"both are the column {self.letters[0]}", expected)

    @property
    def letters(self) -> tuple[str, str]:
        """Names of the two columns, without their signs."""
        return self.axes[0][-1], self.axes[1][-1]

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
        return next((ours for ours, theirs in self.columns.items() if theirs == column), column)

    def name_in_files(self, column: str) -> str:
        """Return what the files call a column of the documentation."""
        return self.columns.get(column, column)

    def source_of(self, marker: str, axis: Literal["x", "y"], frame: str) -> str:
        """Return the files' column of a marker's coordinate in its frame; `MARKER.AXIS` where it mixes two columns."""
        if frame == "link":
            return self.name_in_files(f"{marker}.{axis}")
        letter = self.camera.letters["xy".index(axis)]
        return f"{marker}.{axis}" if self.camera.rotation else self.name_in_files(f"{marker}.{letter}")
