"""Validation of fields, the same for records built in Python and for the tables of an experiment file.

A field is checked if its record annotates it as `Annotated[type, constraints, "what is expected"]`. A pydantic model is
made from the annotations; the text tells what was expected where the model refuses a value.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache
from typing import Annotated, Any, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError, create_model
from pydantic_core import ErrorDetails

from vjm.errors import ExperimentError, shown, suggestion
from vjm.files import plain

# No key but those listed, no conversion of types, no infinities.
STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


@cache
def table_model(record: type, keys: tuple[str, ...] = (), required: tuple[str, ...] = ()) -> type[BaseModel]:
    """Return the pydantic model of a record's annotated fields.

    Args:
        record: a dataclass.
        keys: the fields wanted; all of them if empty.
        required: fields that a table must have although they have a default in Python.
    """
    fields: dict[str, Any] = {}
    hints = get_type_hints(record, include_extras=True)
    for field in dataclasses.fields(record):
        hint = hints[field.name]
        expected = [text for text in getattr(hint, "__metadata__", ()) if isinstance(text, str)]
        if expected and (not keys or field.name in keys):
            if get_origin(hint.__origin__) is tuple:  # a list is as good; its items are strict all the same
                hint = Annotated[hint, Strict(False)]
            optional = field.default is not dataclasses.MISSING and field.name not in required
            fields[field.name] = (hint, Field(field.default if optional else ..., description=expected[0]))
    return create_model(record.__name__, __config__=STRICT, **fields)


def check_fields(record: Any, name: object) -> None:
    """Check the annotated fields of a frozen dataclass being initialized; put plain Python values in their place.

    Raises:
        ExperimentError: a field has the wrong type or value; errors call the record by its class and `name`.
    """
    kind: type = type(record)
    model = table_model(kind)
    defaults = {key: field.default for key, field in model.model_fields.items()}
    # A default may be what no table can say, as the rig's gravity.
    specified = {key: value for key, default in defaults.items() if (value := getattr(record, key)) is not default}
    try:
        valid = model.model_validate(plain(specified, finite=False))
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        key, *items = detail["loc"]
        label = kind.__name__.lower()
        table = f"{label} {name}" if isinstance(name, str) and name else label
        raise ExperimentError(None, table, str(key), *explain(detail, model, str(key), items)) from error
    for key in specified:
        object.__setattr__(record, key, getattr(valid, key))


def explain(detail: ErrorDetails, model: type[BaseModel], key: str, items: Sequence[int | str]) -> tuple[str, str]:
    """Return problem and expectation of an error in the key of a table, `items` being the place in its value."""
    fields = {field.alias or name: field for name, field in model.model_fields.items()}
    if detail["type"] == "extra_forbidden":
        return f"unknown key{suggestion(key, fields)}", f"only the keys {', '.join(fields)}"
    expected = fields[key].description or "" if key in fields else "a table"
    if detail["type"] == "missing":
        return f"got {shown(detail['input'])}" if items else "missing", expected
    position = f"item {items[0] + 1} is " if items and isinstance(items[0], int) else "got "
    return position + shown(detail["input"]), expected
