"""A result as a page: what it holds, and how a terminal, a notebook and a browser show it."""

from __future__ import annotations

import base64
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cache
from importlib import resources
from importlib.metadata import version
from io import StringIO
from itertools import compress
from typing import Any, Literal, TextIO

from jinja2 import Environment, StrictUndefined, Template
from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from vjm.errors import printable
from vjm.report.figures.panels import Picture
from vjm.text import UNKNOWN, short

_WIDTH = 80  # columns where the output is no terminal
_MOST_ROWS = 16  # of a table on a terminal
_MOST_LINES = 20  # of a verdict in Python's prompt
_MOST_WARNINGS = 8  # on a terminal
_RECORDING = "recording"  # header of a first column with names of files
_SHORTEST_NAME = 12  # characters of one, of which the first seven and the last four are left
_COLORS = {"good": "green", "fair": "yellow", "poor": "red"}

# As close as the noise allows; something small is missing; not to be trusted yet.
Grade = Literal["good", "fair", "poor"]


@dataclass(frozen=True)
class Table:
    """A table."""

    caption: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]  # cells as text
    words: int = 1  # number of columns, from the left, that hold words; the others hold numbers
    notes: tuple[str, ...] = ()  # at the end of a row, a remark that needs room; empty where there is none
    optional: tuple[str, ...] = ()  # columns that a narrow terminal leaves out, from the first on

    def without(self, *columns: str) -> Table:
        """Return the table without the named columns."""
        selected = [name not in columns for name in self.headers]
        headers, *rows = (tuple(compress(row, selected)) for row in (self.headers, *self.rows))
        return replace(self, headers=headers, rows=tuple(rows), words=sum(selected[: self.words]))

    def without_empty(self, *columns: str) -> Table:
        """Return the table without those of the named columns that hold nothing but dashes."""
        places = {name: self.headers.index(name) for name in columns if name in self.headers}
        return self.without(*(name for name, k in places.items() if all(row[k] == UNKNOWN for row in self.rows)))

    def widths(self, wrapped: bool = False) -> list[int]:
        """Return how wide its columns must be with their headers wrapped; words are wrapped from 30 characters on.

        Cells are wrapped at commas if `wrapped`.
        """
        pieces = [[row[k].split(", ") if wrapped else [row[k]] for row in self.rows] for k in range(len(self.headers))]
        cells = [max((len(part) for cell in column for part in cell), default=1) for column in pieces]
        cells[: self.words] = [min(width, 30) for width in cells[: self.words]]
        return [max(width, *map(len, head.split(" ")), 1) for head, width in zip(self.headers, cells, strict=True)]


def named(pictures: Sequence[Picture], *beginnings: str) -> list[Picture]:
    """Return the pictures whose names begin with one of `beginnings`."""
    return [picture for picture in pictures if picture.name.startswith(beginnings)]


@dataclass(frozen=True)
class Section:
    """Part of a page: a heading, sentences, tables, plots, pictures, terms with their descriptions, a paragraph."""

    heading: str = ""
    points: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    terms: Sequence[tuple[str, str]] = ()
    text: str = ""
    plots: Mapping[str, Any] | None = None  # time histories, as report.js plots them
    still: Sequence[Picture] = ()  # pictures of these, where no script may run
    folded: bool = False  # details: shown in HTML when they are asked for

    @property
    def anchor(self) -> str:
        """Name of the section in links."""
        return self.heading.lower().replace(" ", "-")

    @property
    def filled(self) -> bool:
        """True if there is anything in it beside a paragraph."""
        return any((self.points, self.tables, self.pictures, self.terms, self.plots, self.still))


@dataclass(frozen=True)
class Page:
    """A result as it is shown, whatever shows it."""

    title: str  # name of the rig
    kind: Literal["identification", "simulation", "check", "diagnosis"]
    headline: str  # the verdict, in one or two sentences
    grade: Grade
    points: Sequence[str]  # what supports the verdict
    warnings: Sequence[str]
    sections: Sequence[Section]
    animation: Mapping[str, Any] | None = None  # of rig and motion, as report.html.jinja draws it

    def html(self, fragment: bool = False, command: str = "") -> str:
        """Return it as a self-contained HTML file, or as a fragment for notebooks.

        The file states the `command` that made it, if any, and the time.
        """
        made = {"vjm": version("vjm"), "date": f"{datetime.now().astimezone():%Y-%m-%d %H:%M %z}", "command": command}
        return _template().render(page=self, fragment=fragment, made=made, embedded=_embedded, asset=_asset)

    def text(self) -> str:
        """Return as plain text what a terminal shows."""
        stream = StringIO()
        self.write(stream)
        return stream.getvalue()

    def brief(self, kind: str) -> str:
        """Return the verdict as plain text under a line with a kind of result, in few lines."""
        lines = [f"<{kind} of {self.title!r}>", *textwrap.wrap(printable(self.headline), _WIDTH)]
        for point in self.points:
            lines += _item(point, _WIDTH).splitlines()
        return "\n".join(lines if len(lines) <= _MOST_LINES else [*lines[: _MOST_LINES - 1], "  …"])

    def write(self, stream: TextIO) -> None:
        """Write it without pictures, terms and paragraphs, in colour on a terminal."""
        width = None if stream.isatty() else _WIDTH
        console = Console(file=stream, markup=False, highlight=False, emoji=False, width=width)
        title = f"Diagnosis: {self.title}" if self.kind == "diagnosis" else self.title
        console.print(Text(printable(title), style="bold"))
        console.print(Text(printable(self.headline), style=_COLORS[self.grade]))
        _print_points(console, self.points)
        for section in self.sections:
            if section.heading and (section.points or section.tables):
                console.print(Text(f"{section.heading}:", style="bold"))
            _print_points(console, section.points)
            for table in section.tables:
                _print_table(console, table)
        if self.warnings:
            count = len(self.warnings) - _MOST_WARNINGS
            console.print(Text("Warnings:", style="bold yellow"))
            _print_points(console, self.warnings[:_MOST_WARNINGS], "!")
            _print_points(console, [f"… and {count} more, see the report"] if count > 0 else [], "!")


def _embedded(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")


@cache
def _asset(name: str) -> str:
    """Return a template, a style sheet or a script of the report."""
    return resources.files("vjm.report").joinpath(name).read_text(encoding="utf-8")


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "ensure_ascii": False}
    return environment.from_string(_asset("report.html.jinja"))


def _print_points(console: Console, points: Sequence[str], mark: str = "-") -> None:
    for point in points:
        console.print(Text(_item(point, console.width, mark)), soft_wrap=True)


def _item(text: str, width: int, mark: str = "-") -> str:
    return textwrap.fill(
        printable(text), width - 1, initial_indent=f"  {mark} ", subsequent_indent="    ", break_on_hyphens=False
    )


def _with_short_names(table: Table, width: int) -> Table:
    """Return the table with names of recordings as short as it takes to fit; they are in full in the report."""
    first, *remaining = table.widths()
    room = width - sum(remaining) - 2 * len(table.headers)
    if table.headers[0] != _RECORDING or first <= room or room < _SHORTEST_NAME:
        return table
    return replace(table, rows=tuple((short(row[0], room), *row[1:]) for row in table.rows))


def _print_table(console: Console, table: Table) -> None:
    """Print a table; optional columns are left out and headers wrapped where it is too wide, and at last cells."""
    table = replace(table, rows=tuple(tuple(map(printable, row)) for row in table.rows))
    for name in table.optional:
        if sum(table.widths()) + 2 * len(table.headers) > console.width:
            table = table.without(name)
    table = _with_short_names(table, console.width)
    rich = RichTable(box=box.SIMPLE_HEAD, title=table.caption, title_justify="left", title_style="bold")
    rich.collapse_padding = True
    rich.pad_edge = False
    widths = table.widths(wrapped=sum(table.widths()) + 2 * len(table.headers) > console.width)
    fits = sum(widths) + 2 * len(widths) <= console.width
    roomy = sum(map(max, widths, map(len, table.headers))) + 2 * len(widths) <= console.width
    for k, (header, width) in enumerate(zip(table.headers, widths, strict=True)):
        justify: Literal["left", "right"] = "left" if k < table.words else "right"
        fixed = None if roomy or (console.is_terminal and not fits) else width
        rich.add_column(Text(header), justify=justify, overflow="fold", min_width=fixed, max_width=fixed)
    # Names are copied: they are not broken even where other cells have to be.
    rich.columns[0].no_wrap = widths[0] < 30
    for row in table.rows[:_MOST_ROWS]:
        rich.add_row(*map(Text, row))
    console.print(rich, crop=False)
    if len(table.rows) > _MOST_ROWS:
        console.print(Text(f"  … and {len(table.rows) - _MOST_ROWS} more in the report"))
