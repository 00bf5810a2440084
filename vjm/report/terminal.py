"""Results on a terminal, and as plain text."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from io import StringIO

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from vjm.diagnosis.records import Diagnosis
from vjm.identification.check import Check
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.report.page import Page, summary_page
from vjm.report.tables import Table
from vjm.report.verdict import verdict

_WIDTH = 110  # columns where the output is no terminal
_MOST_ROWS = 16  # of a table
_MOST_WARNINGS = 8
_COLORS = {"good": "green", "fair": "yellow", "poor": "red"}


def print_summary(result: Check | Identification | Comparison | Diagnosis, ending: str = "") -> None:
    """Print the summary of a result on stdout, in colour on a terminal, and a last line that is never broken."""
    # A terminal without Unicode shows a substitute instead of failing.
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="replace" if sys.stdout.encoding.lower() not in ("utf-8", "utf8") else "backslashreplace")
    console = _console(sys.stdout, None if sys.stdout.isatty() else _WIDTH)
    _print(console, summary_page(result))
    if ending:
        console.print(Text(ending), soft_wrap=True)


def summary_text(result: Check | Identification | Comparison | Diagnosis) -> str:
    """Return the summary of a result as plain text."""
    stream = StringIO()
    _print(_console(stream, _WIDTH), summary_page(result))
    return stream.getvalue()


def brief_text(result: Check | Identification | Comparison | Diagnosis, most: int = 20) -> str:
    """Return the verdict on a result as plain text of so many lines at most."""
    found = verdict(result)
    lines = [f"<{type(result).__name__} of {result.experiment.rig.name!r}>", *textwrap.wrap(found.headline, _WIDTH)]
    for point in found.points:
        lines += _item("-", point, _WIDTH).splitlines()
    return "\n".join(lines if len(lines) <= most else [*lines[: most - 1], "  …"])


def _console(stream: object, width: int | None) -> Console:
    return Console(file=stream, markup=False, highlight=False, emoji=False, width=width)  # type: ignore[arg-type]


def _print(console: Console, page: Page) -> None:
    title = f"Diagnosis: {page.title}" if page.kind == "diagnosis" else page.title
    console.print(Text(title, style="bold"))
    console.print(Text(page.verdict.headline, style=_COLORS[page.verdict.grade]))
    _print_points(console, page.verdict.points)
    for section in page.sections:
        if section.heading and (section.points or section.tables):
            console.print(Text(f"{section.heading}:", style="bold"))
        _print_points(console, section.points)
        for table in section.tables:
            _print_table(console, table)
    if page.warnings:
        more = len(page.warnings) - _MOST_WARNINGS
        shown = page.warnings[:_MOST_WARNINGS]
        console.print(Text("Warnings:", style="bold yellow"))
        _print_points(console, (*shown, f"… and {more} more, see the report") if more > 0 else shown, "!")


def _print_points(console: Console, points: Sequence[str], mark: str = "-") -> None:
    for point in points:
        console.print(Text(_item(mark, point, console.width)), soft_wrap=True)


def _item(mark: str, text: str, width: int) -> str:
    return textwrap.fill(text, width - 1, initial_indent=f"  {mark} ", subsequent_indent="    ", break_on_hyphens=False)


def _print_table(console: Console, table: Table) -> None:
    rich = RichTable(box=box.SIMPLE_HEAD, title=table.caption, title_justify="left", title_style="bold")
    rich.collapse_padding = True
    rich.pad_edge = False
    # Names, which are copied, are never broken, unless one is far too long.
    unbroken = max((len(row[0]) for row in table.rows), default=0) <= 30
    for k, header in enumerate(table.headers):
        justify = "left" if k < table.words else "right"
        rich.add_column(Text(header), justify=justify, overflow="fold", no_wrap=k == 0 and unbroken)  # type: ignore[arg-type]
    for row in table.rows[:_MOST_ROWS]:
        rich.add_row(*map(Text, row))
    console.print(rich)
    if len(table.rows) > _MOST_ROWS:
        console.print(Text(f"  … and {len(table.rows) - _MOST_ROWS} more in the report"))
