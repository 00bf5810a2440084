"""From what pydantic found wrong in an experiment file to one error a person can act on."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from vjm.errors import ExperimentError
from vjm.experiment.schema import SECTIONS, ExperimentTable, Table

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
