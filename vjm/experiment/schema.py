"""The experiment file's tables, as pydantic models: keys, types and signs; and what to say of a fault in them."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from vjm.errors import ExperimentError
from vjm.records import Joint, Kind, MarkersFrame, Rig, Role

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


def recording_gravity(table: RecordingTable, rig: Rig) -> tuple[float, float]:
    """Gravity in one recording, its own or the rig's [m/s^2]."""
    return rig.gravity if table.gravity is None else (table.gravity[0], table.gravity[1])


_LONGEST_SHOWN = 60


def shown(value: object) -> str:
    """A value as an error message shows it: its repr, cut short."""
    try:
        text = repr(value)
    except ValueError:  # an integer too long for Python to print
        text = f"a very long {type(value).__name__}"
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 3] + "..."


def suggestion(name: str, choices: Iterable[str]) -> str:
    """`, did you mean 'NAME'?` for the nearest choice; empty where none is near."""
    near = difflib.get_close_matches(name, list(choices), n=1)
    return f", did you mean '{near[0]}'?" if near else ""


def table_name(section: str, index: int, label: object) -> str:
    """How errors call a table of an array of tables: `link[1] beam`, counted from 1.

    Args:
        section: `link` or `recording`.
        index: from 0.
        label: the table's `name` or `file`, as far as it is known.
    """
    place = f"{section}[{index + 1}]"
    return f"{place} {label}" if isinstance(label, str) and label else place


def experiment_error(file: Path, document: Mapping[str, Any], error: ValidationError) -> ExperimentError:
    """The first fault pydantic found, as an error; unknown keys go first, being often the cause of missing ones.

    Args:
        file: the experiment file.
        document: the file's content, as parsed.
        error: what pydantic raised.
    """
    details = sorted(error.errors(include_url=False), key=lambda detail: detail["type"] != "extra_forbidden")
    model, table, key, items = _place(document, details[0]["loc"])
    problem, expected = _explain(details[0], model, key, items)
    more = len(details) - 1
    note = f" (and {more} more fault{'s' if more > 1 else ''} in this file)" if more else ""
    return ExperimentError(file, table, key, problem + note, expected)


def _place(
    document: Mapping[str, Any], location: tuple[int | str, ...]
) -> tuple[type[Table], str, str, tuple[int | str, ...]]:
    """Model, table, key and position inside the key's value of a pydantic location."""
    parts = list(location)
    section = parts[0] if parts else ""
    if not isinstance(section, str) or section not in SECTIONS or len(parts) == 1:
        return ExperimentTable, "", str(section), tuple(parts[1:])
    model, table = SECTIONS[section], section
    rest = parts[1:]
    if isinstance(rest[0], int):
        content = document[section][rest[0]]
        label = content.get("name", content.get("file")) if isinstance(content, dict) else None
        table = table_name(section, rest[0], label)
        rest = rest[1:]
    return model, table, str(rest[0]) if rest else "", tuple(rest[1:])


def _explain(detail: ErrorDetails, model: type[Table], key: str, items: tuple[int | str, ...]) -> tuple[str, str]:
    """Problem and expectation of one pydantic error."""
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    if detail["type"] == "extra_forbidden":
        return f"unknown key{suggestion(key, fields)}", f"only the keys {', '.join(fields)}"
    expected = fields[key].description or "" if key in fields else "a table"
    if detail["type"] == "missing":
        return "missing", expected
    position = f"item {items[0] + 1} is " if items and isinstance(items[0], int) else "got "
    return position + shown(detail["input"]), expected
