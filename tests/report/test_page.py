"""A page as one HTML file, safe whatever the names, with the verdict first; and as text."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from io import StringIO

import pytest

from tests.report.fits import demo_fit, pictures_of
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.report.output import result_page
from vjm.report.page import Page, Section, Table

HOSTILE = "<script>alert('1')</script><img src=http://evil.example/x onerror=alert(2)>&amp; \"quoted\" {{ 7 * 7 }}"


class Elements(HTMLParser):
    """Tags and their attributes, and that every tag is closed."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def assert_self_contained(page: str) -> None:
    for tag, attributes in Elements(page).found:
        assert tag not in ("script", "link", "iframe", "object", "base")
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "srcset", "data"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:image/png;base64,")
    assert not re.search(r"url\(|@import", page)


@pytest.mark.parametrize("fit", ["demo", "elbow"], indirect=True)
def test_page_is_one_light_file(fit: Identification) -> None:
    page = result_page(fit, pictures_of(fit)).html()
    assert_self_contained(page)
    assert len(page) < 3e6
    assert page.index("headline") < page.index("Table 1") < page.index("Table 2") < page.index("<figure>")
    for text in (*(recording.file for recording in fit.experiment.recordings), *fit.notes):
        assert text in page


def test_hostile_names_stay_text() -> None:
    fit = demo_fit()
    rig = replace(fit.experiment.rig, name=HOSTILE)
    recording = replace(fit.recordings[0].recording, file=HOSTILE)
    hostile = replace(
        fit,
        experiment=replace(fit.experiment, rig=rig),
        recordings=(replace(fit.recordings[0], recording=recording, problem=HOSTILE),),
        warnings=(HOSTILE,),
        notes=(HOSTILE,),
        parameters=tuple(replace(each, reason=HOSTILE, remedy=HOSTILE, identifiable=False) for each in fit.parameters),
    )
    page = result_page(hostile, pictures_of(fit)[:1]).html()
    assert_self_contained(page)
    assert "&lt;script&gt;alert(" in page
    assert "{{ 7 * 7 }}" in page


def test_report_page() -> None:
    fit = demo_fit()
    comparison = Comparison(fit.experiment, fit.model, fit.nominal, fit.covariance, fit.recordings, ())
    page = result_page(comparison, []).html()
    assert_self_contained(page)
    assert result_page(comparison).headline.replace("'", "&#39;") in page
    assert "<p>Warnings</p>" not in page


@pytest.mark.parametrize("columns", [None, 60, 160])
def test_cells_of_tables_are_not_wrapped(columns: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the output is no terminal, or one that is wide enough."""
    cell = "(2.00489 ± 0.00031) × 10⁻²"
    row = ("beam.hub_inertia", *[cell] * 5)
    table = Table("Table", ("parameter", *["a long header, which is wrapped"] * 5), (row,))
    stream = StringIO()
    if columns is not None:
        monkeypatch.setattr(stream, "isatty", lambda: True)
        monkeypatch.setenv("COLUMNS", str(columns))
    Page("rig", "check", "Done.", "good", (), (), [Section(tables=[table])]).write(stream)
    lines = re.sub(r"\x1b\[[\d;]*m", "", stream.getvalue()).splitlines()
    assert any(line.count(cell) == 5 for line in lines) == (columns != 60)
    assert max(map(len, lines)) <= 60 or columns != 60
    assert any("beam.hub_inertia" in line for line in lines)
