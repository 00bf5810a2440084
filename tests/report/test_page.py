"""A page as one HTML file, safe whatever the names, with the verdict first; and as text."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from importlib import resources
from importlib.metadata import version
from io import StringIO
from pathlib import Path

import pytest

from tests.report.fits import demo_fit, pictures_of
from vjm.identification.comparison import Comparison
from vjm.identification.records import Identification
from vjm.report.output import result_page
from vjm.report.page import Page, Section, Table

HOSTILE = "<script>alert('1')</script><img src=http://evil.example/x onerror=alert(2)>&amp; \"quoted\" {{ 7 * 7 }}"


class Elements(HTMLParser):
    """Tags and their attributes, text of scripts, and that every tag is closed."""

    VOID = frozenset({"meta", "img", "br", "link"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.scripts: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


NETWORK = re.compile(r"fetch\(|XMLHttpRequest|WebSocket|EventSource|sendBeacon|import\(|importScripts|new Image")


def assert_self_contained(page: str) -> None:
    """Nothing but data and the report's own script is in it, which asks nobody for anything."""
    elements = Elements(page)
    for tag, attributes in elements.found:
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert not any(name.startswith("on") for name in attributes)
        assert tag != "script" or attributes in ({}, {"type": "application/json"})
        for name in ("src", "href", "xlink:href", "srcset", "data", "action"):
            value = attributes.get(name)
            assert value is None or value.startswith(("data:image/png;base64,", "#"))
    *data, own = elements.scripts or [""]
    for text in data:
        json.loads(text)
    assert not own or own.rstrip().endswith(resources.files("vjm.report").joinpath("report.js").read_text().rstrip())
    assert not NETWORK.search(own)
    assert not re.search(r"url\(|@import", page)


@pytest.mark.parametrize("fit", ["demo", "elbow"], indirect=True)
def test_page_is_one_light_file(fit: Identification) -> None:
    page = result_page(fit, pictures_of(fit)).html()
    assert_self_contained(page)
    assert len(page) < 3e6
    order = ['class="headline"', "<svg", 'class="contents"', "Table 1", "Table 2", 'class="plots"', "<details>"]
    places = [page.index(each) for each in order]
    assert places == sorted(places)
    for text in (*(recording.file for recording in fit.experiment.recordings), *fit.notes):
        assert text in page


def headings(page: str) -> list[tuple[str, str]]:
    """Levels and texts of the headings, in order."""
    return re.findall(r"<(h[1-6])[^>]*>(.*?)</h", page)


@pytest.mark.parametrize("fit", ["demo", "silicone"], indirect=True)
def test_page_can_be_found_through(fit: Identification) -> None:
    page = result_page(fit, pictures_of(fit)).html(command="vjm identify 'my beam.toml'")
    elements = Elements(page)
    assert [level for level, _ in headings(page)] == ["h1"] + ["h2"] * (len(headings(page)) - 1)
    anchors = [attributes["id"] for tag, attributes in elements.found if tag == "h2"]
    links = [attributes["href"] for tag, attributes in elements.found if tag == "a"]
    assert links == [f"#{anchor}" for anchor in anchors]
    folded = re.findall(r"<details>\s*<summary><h2[^>]*>(.*?)</h2></summary>", page)
    assert folded == ["Residuals", "Identifiability", "Data", "Input", "Settings"]
    assert page.count("<details") == page.count("</details>") == len(folded)
    assert all(attributes.get("alt") for tag, attributes in elements.found if tag == "img")
    assert all(attributes.get("aria-label") for tag, attributes in elements.found if tag == "svg")
    assert "<code>vjm identify &#39;my beam.toml&#39;</code>" in page
    assert re.search(rf"\d{{4}}-\d\d-\d\d \d\d:\d\d [+-]\d{{4}}, vjm {re.escape(version('vjm'))}", page)


def test_page_tells_what_went_into_it() -> None:
    fit = demo_fit()
    section = next(section for section in result_page(fit, []).sections if section.heading == "Input")
    rows = {row[0]: row[1:] for row in section.tables[0].rows}
    assert rows["both_modes.csv"] == ("decay", "held out", "10.0", "301")
    assert rows["quiet.csv"][:2] == ("quiet", "train")
    assert section.terms[0] == ("Experiment file", str(fit.experiment.file))
    python = replace(fit, experiment=replace(fit.experiment, file=None))
    assert result_page(python, []).sections[-2].terms[0][1] == "none, built in Python"


def test_pictures_of_time_histories_are_for_pages_without_scripts() -> None:
    fit = demo_fit()
    page = result_page(fit, pictures_of(fit)).html()
    without = "".join(re.findall(r"<noscript>(.*?)</noscript>", page, re.DOTALL))
    count = sum(picture.name.startswith("tip") for picture in pictures_of(fit))
    assert without.count("<img") == count > 0
    assert page.count("<img") == len(pictures_of(fit))


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_phone_shows_plots_and_no_cut_columns(tmp_path: Path) -> None:
    """In a frame as narrow as a phone: plots are there, all sections unfold, and the page does not scroll sideways."""
    fit = demo_fit()
    look = """<script>setTimeout(() => {
      dispatchEvent(new Event("beforeprint"));
      const wide = [...document.querySelectorAll("main *")].filter(each => !each.closest(".scroll, svg")
        && each.getBoundingClientRect().right > innerWidth);
      const [recording, signal] = document.querySelectorAll("select");
      parent.postMessage(JSON.stringify({plots: document.querySelectorAll(".uplot canvas").length,
        folded: document.querySelectorAll("details:not([open])").length, wide: wide.length, width: innerWidth,
        chosen: [recording, signal].map(each => each.selectedOptions[0].text),
        scroll: document.documentElement.scrollWidth}), "*"); }, 500)</script></body>"""
    page = result_page(fit, pictures_of(fit)).html().replace("</body>", look)
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    frame = (
        '<body><iframe src="report.html" width="400" height="800" style="border:0"></iframe><script>addEventListener'
    )
    frame += '("message", event => { document.body.innerHTML = "<pre>" + event.data + "</pre>"; })</script></body>'
    (tmp_path / "phone.html").write_text(frame, encoding="utf-8")
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000", "--dump-dom"]
    command = ["chromium", *options, (tmp_path / "phone.html").as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout
    match = re.search(r"<pre>(.*)</pre>", shown)
    assert match is not None
    seen = json.loads(match.group(1))
    assert seen.pop("scroll") <= seen.pop("width") <= 400
    assert seen == {"plots": 2, "folded": 0, "wide": 0, "chosen": ["both_modes.csv (held out)", "beam.m5.y"]}


def test_a_terminal_is_sent_nothing_that_it_would_obey() -> None:
    hostile = "a\nb\x1b[2J\x9b2J\u202e"
    table = Table("", ("file", "[mm]"), ((hostile, "1"),))
    page = Page(
        hostile, "check", hostile, "good", (hostile,), (hostile,), (Section(points=(hostile,), tables=(table,)),)
    )
    text = page.text()
    assert text.count(r"a\nb\u001b[2J\u009b2J\u202e") == 6
    assert not {"\x1b", "\x9b", "\u202e"} & {*text, *page.brief("Check")}


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
