"""A result as a page: what it holds, and how a terminal, a notebook and a browser show it."""

from __future__ import annotations

import base64
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from importlib.metadata import version
from io import StringIO
from itertools import compress
from typing import TYPE_CHECKING, Literal, TextIO

from jinja2 import Environment, StrictUndefined, Template
from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from vjm.report.text import UNKNOWN

if TYPE_CHECKING:
    from vjm.report.figures.panels import Picture

_WIDTH = 110  # columns where the output is no terminal
_MOST_ROWS = 16  # of a table on a terminal
_MOST_WARNINGS = 8  # on a terminal
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

    def without_empty(self, *columns: str) -> Table:
        """Return the table without those of the named columns that hold nothing but dashes."""
        kept = [name not in columns or {row[k] for row in self.rows} - {UNKNOWN} for k, name in enumerate(self.headers)]
        headers, *rows = (tuple(compress(row, kept)) for row in (self.headers, *self.rows))
        return replace(self, headers=headers, rows=tuple(rows))


@dataclass(frozen=True)
class Section:
    """Part of a page: a heading, sentences, tables, pictures, terms with their descriptions, a paragraph."""

    heading: str = ""
    points: Sequence[str] = ()
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    terms: Sequence[tuple[str, str]] = ()
    text: str = ""


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

    def html(self, fragment: bool = False) -> str:
        """Return it as a self-contained HTML file, or as a fragment for notebooks."""
        return _template().render(page=self, fragment=fragment, vjm=version("vjm"), embedded=_embedded)

    def text(self) -> str:
        """Return as plain text what a terminal shows."""
        stream = StringIO()
        self.write(stream)
        return stream.getvalue()

    def brief(self, kind: str, most: int = 20) -> str:
        """Return the verdict as plain text under a line with a kind of result, so many lines at most."""
        lines = [f"<{kind} of {self.title!r}>", *textwrap.wrap(self.headline, _WIDTH)]
        for point in self.points:
            lines += _item(point, _WIDTH).splitlines()
        return "\n".join(lines if len(lines) <= most else [*lines[: most - 1], "  …"])

    def write(self, stream: TextIO) -> None:
        """Write it without pictures, terms and paragraphs, in colour on a terminal."""
        width = None if stream.isatty() else _WIDTH
        console = Console(file=stream, markup=False, highlight=False, emoji=False, width=width)
        title = f"Diagnosis: {self.title}" if self.kind == "diagnosis" else self.title
        console.print(Text(title, style="bold"))
        console.print(Text(self.headline, style=_COLORS[self.grade]))
        _print_points(console, self.points)
        for section in self.sections:
            if section.heading and (section.points or section.tables):
                console.print(Text(f"{section.heading}:", style="bold"))
            _print_points(console, section.points)
            for table in section.tables:
                _print_table(console, table)
        if self.warnings:
            more = len(self.warnings) - _MOST_WARNINGS
            console.print(Text("Warnings:", style="bold yellow"))
            _print_points(console, self.warnings[:_MOST_WARNINGS], "!")
            _print_points(console, [f"… and {more} more, see the report"] if more > 0 else [], "!")


def _embedded(picture: Picture) -> str:
    return "data:image/png;base64," + base64.b64encode(picture.png).decode("ascii")


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    text = resources.files("vjm.report").joinpath("report.html.jinja").read_text(encoding="utf-8")
    return environment.from_string(text)


def _print_points(console: Console, points: Sequence[str], mark: str = "-") -> None:
    for point in points:
        console.print(Text(_item(point, console.width, mark)), soft_wrap=True)


def _item(text: str, width: int, mark: str = "-") -> str:
    return textwrap.fill(text, width - 1, initial_indent=f"  {mark} ", subsequent_indent="    ", break_on_hyphens=False)


def _print_table(console: Console, table: Table) -> None:
    """Print a table; headers are wrapped, but no cell is unless it is far too long or a terminal too narrow."""
    rich = RichTable(box=box.SIMPLE_HEAD, title=table.caption, title_justify="left", title_style="bold")
    rich.collapse_padding = True
    rich.pad_edge = False
    cells = [max((len(row[k]) for row in table.rows), default=1) for k in range(len(table.headers))]
    cells[: table.words] = [min(width, 30) for width in cells[: table.words]]
    least = [max(width, *map(len, header.split()), 1) for header, width in zip(table.headers, cells, strict=True)]
    room = console.width - 2 * len(least)
    wrapped = sum(map(max, cells, map(len, table.headers))) > room
    broken = console.is_terminal and sum(least) > room
    for k, header in enumerate(table.headers):
        justify: Literal["left", "right"] = "left" if k < table.words else "right"
        width = least[k] if wrapped and not broken else None
        rich.add_column(Text(header), justify=justify, overflow="fold", min_width=width, max_width=width)
    # Names are copied: they are not broken even where other cells have to be.
    rich.columns[0].no_wrap = cells[0] < 30
    for row in table.rows[:_MOST_ROWS]:
        rich.add_row(*map(Text, row))
    console.print(rich, crop=False)
    if len(table.rows) > _MOST_ROWS:
        console.print(Text(f"  … and {len(table.rows) - _MOST_ROWS} more in the report"))
