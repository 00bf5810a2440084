"""The experiment file's tables, as pydantic models: keys, types and signs.

A field's description is the text an error gives as what was expected.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from vjm.experiment.records import Joint, Kind, MarkersFrame, Role

MAX_VIRTUAL_JOINTS = 60

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=2, max_length=2)]
Label = Annotated[str, Field(min_length=1)]

_GRAVITY = "two finite numbers, gravity along x and y of the base frame [m/s^2]"
_PAYLOAD = "a finite number, zero or positive [kg]"


def _positive(unit: str) -> str:
    return f"a finite positive number [{unit}]"


class Table(BaseModel):
    """A TOML table: no key but those listed, no type coercion, finite numbers."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


class BaseTable(Table):
    """`[base]`."""

    gravity: Vector = Field(description=_GRAVITY)


class LinkTable(Table):
    """`[[link]]`; bending stiffness comes either as such or as modulus, width and thickness."""

    name: str = Field(pattern=r"\A[A-Za-z0-9_]+\z", description="a name of letters, digits and underscores")
    joint: Joint = Field(description='"revolute" or "clamped"')
    length: Positive = Field(description=_positive("m"))
    mass: Positive = Field(description=_positive("kg"))
    markers: list[Positive] = Field(description="a list of finite positive numbers, arc lengths [m]")
    hub_inertia: NotNegative | None = Field(default=None, description="a finite number, zero or positive [kg m^2]")
    payload: NotNegative = Field(default=0.0, description=_PAYLOAD)
    width: Positive | None = Field(default=None, description=_positive("m"))
    thickness: Positive | None = Field(default=None, description=_positive("m"))
    youngs_modulus: Positive | None = Field(default=None, description=_positive("Pa"))
    bending_stiffness: Positive | None = Field(default=None, description=_positive("N m^2"))
    markers_frame: MarkersFrame = Field(default="base", description='"base" or "link"')
    virtual_joints: Annotated[int, Field(ge=1, le=MAX_VIRTUAL_JOINTS)] | None = Field(
        default=None, description=f"a whole number from 1 to {MAX_VIRTUAL_JOINTS}"
    )


class SensorsTable(Table):
    """`[sensors]`."""

    marker_noise: Positive | None = Field(default=None, description=_positive("m"))
    encoder_noise: Positive | None = Field(default=None, description=_positive("rad"))


class RecordingTable(Table):
    """`[[recording]]`."""

    file: Label = Field(description="the name of a CSV file, relative to the experiment file")
    kind: Kind = Field(description='"driven", "decay", "static" or "quiet"')
    role: Role = Field(description='"train" or "holdout"')
    repeat: Label | None = Field(default=None, description="a label shared by recordings that repeat one experiment")
    condition: Label | None = Field(default=None, description='a label, as "reference"')
    payload: NotNegative = Field(default=0.0, description=_PAYLOAD)
    gravity: Vector | None = Field(default=None, description=_GRAVITY)


class ExperimentTable(Table):
    """The whole file."""

    schema_: int = Field(alias="schema", ge=1, le=1, description="schema = 1, the only one there is")
    name: Label = Field(description="the experiment's name, a string that is not empty")
    base: BaseTable = Field(description="a table [base] with gravity = [x, y] in m/s^2")
    link: list[LinkTable] = Field(min_length=1, description="at least one table [[link]], from the base outwards")
    sensors: SensorsTable = Field(default_factory=SensorsTable, description="a table [sensors]")
    recording: list[RecordingTable] = Field(min_length=1, description="at least one table [[recording]]")


SECTIONS: dict[str, type[Table]] = {
    "base": BaseTable,
    "link": LinkTable,
    "sensors": SensorsTable,
    "recording": RecordingTable,
}
