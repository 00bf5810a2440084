"""The errors vjm raises.

Every one descends from `VjmError`, carries the data it speaks of as attributes, and says in one message
where the fault is and what was expected.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeGuard

# Control characters, halves of surrogate pairs, and what makes other characters change places or vanish.
_UNPRINTABLE = re.compile(
    r"[\x00-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ud800-\udfff\ufeff\ufff9-\ufffb\ufffe\uffff]"
)


_SHORT_ESCAPES = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}


def printable(text: str) -> str:
    """Return text in which characters that a terminal would obey instead of show are written as escapes.

    Names of files and columns may hold any. The escapes are those of JSON, TOML and Python.
    """
    return _UNPRINTABLE.sub(lambda match: _SHORT_ESCAPES.get(match[0], f"\\u{ord(match[0]):04x}"), text)


class VjmError(Exception):
    """Root of every error that vjm raises on purpose; its message is printable, and may have several lines."""

    def __init__(self, *lines: str) -> None:
        super().__init__("\n".join(map(printable, lines)))


class InputError(VjmError):
    """The input is unusable; the command line exits with status 2."""


class ExperimentError(InputError):
    """A fault in an experiment file, or in a record built in Python.

    Attributes:
        file: the experiment file; None for a record built in Python.
        table: the TOML table, counted from 1 and named, as `link[1] beam` or `recording[2] slew.csv`; empty for the
            file as a whole; the record, as `link beam`.
        key: the key inside the table; empty where the table itself is at fault.
        expected: what would have been right.
    """

    def __init__(
        self, file: Path | str | None, table: str, key: str, problem: str, expected: str, in_python: str = ""
    ) -> None:
        """Make the error; `in_python` is advice that is of no use for a file."""
        self.file = None if file is None else Path(file)
        self.table, self.key, self.problem, self.expected = table, key, problem, expected
        place = ", ".join(part for part in (f"[{table}]" if table else "", f"key '{key}'" if key else "") if part)
        advice = f"; {in_python}" if in_python and file is None else ""
        parts = ["" if file is None else str(file), place, f"{problem}; expected {expected}{advice}"]
        super().__init__(": ".join(part for part in parts if part))

    def at(self, file: Path, table: str = "") -> ExperimentError:
        """Return the same fault as one of a file's table; an empty table leaves it as it is."""
        return ExperimentError(file, table or self.table, self.key, self.problem, self.expected)


class RecordingError(InputError):
    """A fault in a recording.

    Attributes:
        file: the CSV file, or the recording's name.
        row: line of the file, the header being line 1; None where no single row is at fault.
        column: the column's name; None where no single column is at fault.
        expected: what would have been right.
        index: of the sample in an array or a table; None for a file.
    """

    def __init__(
        self,
        file: Path | str,
        row: int | None,
        column: str | None,
        problem: str,
        expected: str,
        index: int | None = None,
    ) -> None:
        self.file = Path(file)
        self.row, self.column, self.problem, self.expected, self.index = row, column, problem, expected, index
        places = {"row": row, "index": index, "column": None if column is None else f"'{column}'"}
        place = ", ".join(f"{name} {value}" for name, value in places.items() if value is not None)
        super().__init__(f"{file}: {place + ': ' if place else ''}{problem}; expected {expected}")


class ModelFileError(InputError):
    """A model file (model.json or URDF) cannot be read.

    Attributes:
        file: the file.
        problem: what is wrong with it.
        expected: what would have been right.
    """

    def __init__(self, file: Path | str, problem: str, expected: str) -> None:
        self.file, self.problem, self.expected = Path(file), problem, expected
        super().__init__(f"{file}: {problem}; expected {expected}")


class ChoiceError(InputError):
    """A name that is not among the choices.

    Attributes:
        what: what was to be chosen.
        given: the name given.
        choices: the names there are.
    """

    def __init__(self, what: str, given: object, choices: Iterable[object]) -> None:
        self.what, self.given, self.choices = what, given, tuple(choices)
        super().__init__(f"unknown {what} {given!r}; choose one of: {', '.join(map(str, self.choices))}")


class ShapeError(InputError):
    """Arrays, or values in them, that do not fit together.

    Attributes:
        name: the argument at fault.
        given: what was given.
        expected: what was expected.
    """

    def __init__(self, name: str, given: object, expected: str) -> None:
        self.name, self.given, self.expected = name, given, expected
        super().__init__(f"{name}: got {given}; expected {expected}")


class InsufficientDataError(InputError):
    """The recordings cannot determine what was asked for.

    Attributes:
        what: what was asked for.
        reason: why the data do not give it.
        remedy: what would.
    """

    def __init__(self, what: str, reason: str, remedy: str) -> None:
        self.what, self.reason, self.remedy = what, reason, remedy
        super().__init__(f"{what}: {reason}; {remedy}")


class MistakeError(InputError):
    """Recordings that a mistake explains far better than the experiment file does.

    Attributes:
        mistakes: what is wrong and what to change, a sentence each.
    """

    def __init__(self, mistakes: Iterable[str]) -> None:
        self.mistakes = tuple(mistakes)
        super().__init__(*self.mistakes)


class EffectError(InputError):
    """An effect that does not keep the contract of effects.

    Attributes:
        effect: its id, or its class where it has none.
        clause: of the contract, as `vjm.check_effect` names it.
        found: what it does.
        expected: what it should do.
    """

    def __init__(self, effect: str, clause: str, found: str, expected: str) -> None:
        self.effect, self.clause, self.found, self.expected = effect, clause, found, expected
        super().__init__(f"effect {effect}, clause '{clause}': {found}; expected {expected}")


class SimulationDivergedError(VjmError):
    """A simulation left the finite numbers, or cannot begin.

    Attributes:
        time: last finite instant [s].
        step: integration step [s].
        remedy: what to change.
    """

    def __init__(self, time: float, step: float, remedy: str, problem: str = "") -> None:
        """Say what went wrong, a problem in words or the divergence itself, and the remedy."""
        self.time, self.step, self.remedy = time, step, remedy
        diverged = f"the simulation diverged after t = {time:.6g} s with steps of {step:.3g} s"
        super().__init__(f"{problem or diverged}; {remedy}")


class MissingPackageError(VjmError):
    """A package that vjm does without, but not for this.

    Attributes:
        package: what is absent.
        purpose: what it is for.
        remedy: how to install it.
    """

    def __init__(self, package: str, purpose: str, remedy: str) -> None:
        self.package, self.purpose, self.remedy = package, purpose, remedy
        super().__init__(f"{purpose} needs the package {package}, which is not installed; {remedy}")


def is_whole(value: object, least: int) -> TypeGuard[int]:
    """Return True for a whole number of at least `least`; False and True are none."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least


def is_number(value: object) -> TypeGuard[float]:
    """Return True for a finite number; False and True are none."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def require(argument: str, value: Any, valid: bool, expected: str) -> None:
    """Raise a `ShapeError` for the value of an argument that is not `valid`, with what is expected."""
    if not valid:
        raise ShapeError(argument, shown(value), expected)


def require_choice(what: str, value: object, choices: Iterable[object]) -> None:
    """Raise a `ChoiceError` for what is not among the choices; arrays and lists, which cannot be compared, are not."""
    choices = tuple(choices)
    if not (value is None or isinstance(value, str)) or value not in choices:
        raise ChoiceError(what, value, choices)


def require_kind(argument: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raise a `ShapeError` for the value of an argument that is no object of a kind, with what is expected."""
    require(argument, value, isinstance(value, kind), expected)


def require_progress(progress: object) -> None:
    """Raise a `ShapeError` for what cannot be told of progress."""
    require("progress", progress, progress is None or callable(progress), "a function of (text, done, total), or None")


def shown(value: object) -> str:
    """Return a value as error messages show it: its repr, cut short."""
    longest = 60
    try:
        text = repr(value)
    except ValueError:  # an integer too long for Python to print
        text = f"a very long {type(value).__name__}"
    return text if len(text) <= longest else text[: longest - 3] + "..."


def suggestion(name: str, choices: Iterable[str]) -> str:
    """Return `, did you mean 'NAME'?` for the nearest choice; empty where none is near."""
    matches = difflib.get_close_matches(name, list(choices), n=1)
    return f", did you mean '{matches[0]}'?" if matches else ""
