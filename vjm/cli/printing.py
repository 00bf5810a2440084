"""What the commands print: a short summary for a person, or the result object."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from vjm.files import json_text
from vjm.report.tables import Table
from vjm.report.verdict import Verdict

_MOST_ROWS = 16
_MOST_WARNINGS = 8
_LONGEST_NAME = 30
_COLORS = {"good": "green", "fair": "yellow", "poor": "red"}
_PLAIN_WIDTH = 110  # columns where the output is no terminal


def print_json(result: dict[str, Any]) -> None:
    """The result object, and nothing else."""
    _forgiving_stdout()
    sys.stdout.write(json_text(result))


class Summary:
    """Prints the parts of a summary on stdout."""

    def __init__(self, title: str) -> None:
        _forgiving_stdout()
        width = None if sys.stdout.isatty() else _PLAIN_WIDTH
        self.console = Console(file=sys.stdout, markup=False, highlight=False, emoji=False, width=width)
        self.console.print(Text(title, style="bold"))

    def verdict(self, verdict: Verdict) -> None:
        """The finding and its points."""
        self.console.print(Text(verdict.headline, style=_COLORS[verdict.grade]))
        self.points(verdict.points)

    def points(self, points: Sequence[str]) -> None:
        """A list of sentences."""
        for point in points:
            self._item("-", point)

    def line(self, text: str) -> None:
        """One line."""
        self.console.print(Text(text))

    def table(self, table: Table) -> None:
        """A table; of a long one the first rows."""
        rich = RichTable(box=box.SIMPLE_HEAD, title=table.caption, title_justify="left", title_style="bold")
        rich.collapse_padding = True
        rich.pad_edge = False
        for k, header in enumerate(table.headers):
            words = k < table.words
            rich.add_column(
                Text(header), justify="left" if words else "right", overflow="fold", no_wrap=_whole(k, table)
            )
        for row in table.rows[:_MOST_ROWS]:
            rich.add_row(*map(Text, row))
        self.console.print(rich)
        left = len(table.rows) - _MOST_ROWS
        if left > 0:
            self.line(f"  … and {left} more in the report")

    def notes(self, notes: Sequence[str]) -> None:
        """What was decided on the way, and what the result rests on."""
        if notes:
            self.console.print(Text("Notes:", style="bold"))
            self.points(notes)

    def warnings(self, warnings: Sequence[str]) -> None:
        """What a user should know before trusting the result."""
        if not warnings:
            return
        self.console.print(Text("Warnings:", style="bold yellow"))
        for warning in warnings[:_MOST_WARNINGS]:
            self._item("!", warning)
        if len(warnings) > _MOST_WARNINGS:
            self._item("!", f"… and {len(warnings) - _MOST_WARNINGS} more, see the report")

    def report(self, path: Path) -> None:
        """Where everything is; on one line, so that it can be copied."""
        self.console.print(Text(f"Report: {path}"), soft_wrap=True)

    def _item(self, mark: str, text: str) -> None:
        wrapper = textwrap.TextWrapper(self.console.width - 1, f"  {mark} ", "    ", break_on_hyphens=False)
        self.console.print(Text(wrapper.fill(text)), soft_wrap=True)


def _whole(column: int, table: Table) -> bool:
    """Whether a column's cells are never broken: names, which are copied, unless one is far too long."""
    return column == 0 and max((len(row[0]) for row in table.rows), default=0) <= _LONGEST_NAME


def _forgiving_stdout() -> None:
    """Let a terminal without Unicode show a substitute instead of failing."""
    reconfigure = getattr(sys.stdout, "reconfigure", None)
    if reconfigure is not None:
        reconfigure(errors="replace" if sys.stdout.encoding.lower() not in ("utf-8", "utf8") else "backslashreplace")
