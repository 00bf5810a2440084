"""Fingers on the plots of a page, in a phone of headless Chromium, where there is one."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.report.fits import demo_fit
from vjm.report.output import result_page

_DRIVER, _BROWSER = shutil.which("chromedriver"), shutil.which("chromium") or shutil.which("google-chrome")
_PHONE = {"width": 400, "height": 800, "pixelRatio": 2, "touch": True}
_SAMPLE = 1 / 30  # s

pytestmark = pytest.mark.skipif(not (_DRIVER and _BROWSER), reason="needs chromium and chromedriver")


class Phone:
    """A page in a browser with a touch screen, by the WebDriver protocol."""

    def __init__(self, port: int) -> None:
        self._base = f"http://127.0.0.1:{port}"
        arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        options = {"binary": _BROWSER, "args": arguments, "mobileEmulation": {"deviceMetrics": _PHONE}}
        session = self._call("POST", "/session", {"capabilities": {"alwaysMatch": {"goog:chromeOptions": options}}})
        self._base += f"/session/{session['sessionId']}"

    def _call(self, method: str, path: str, body: object = None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(self._base + path, data, {"Content-Type": "application/json"}, method=method)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def open(self, page: Path) -> None:
        self._call("POST", "/url", {"url": page.as_uri()})

    def run(self, script: str) -> Any:
        return self._call("POST", "/execute/sync", {"script": script, "args": []})

    def touch(self, *fingers: list[tuple[float, float]], times: int = 1) -> None:
        """Move fingers along paths of points, all of one length, over the first plot; [px] from its upper left."""
        left, top = self.run(_OVER + "over.scrollIntoView({block: 'center'}); return [box().left, box().top]")
        actions = []
        for k, path in enumerate(fingers):
            first, *others = (
                {"type": "pointerMove", "x": round(left + x), "y": round(top + y), "duration": 16 * (i > 0)}
                for i, (x, y) in enumerate(path)
            )
            down, up = {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0}
            steps = [first, down, *others, up, {"type": "pause", "duration": 50}] * times
            actions.append({"type": "pointer", "id": f"{k}", "parameters": {"pointerType": "touch"}, "actions": steps})
        self._call("POST", "/actions", {"actions": actions})

    def shown(self) -> list[float]:
        """Return the times at the left and the right end of the first plot, as its legend tells them [s]."""
        return [float(self.run(_OVER + f"return at({share})")) for share in (0, 1)]

    def end(self) -> None:
        self._call("DELETE", "")


_OVER = """
const over = document.querySelector(".u-over"), box = () => over.getBoundingClientRect();
const at = share => {
  const {left, top, width} = box();
  over.dispatchEvent(new MouseEvent("mouseenter"));
  const place = {clientX: left + share * (width - 1), clientY: top + 20, bubbles: true};
  over.dispatchEvent(new MouseEvent("mousemove", place));
  return over.closest(".uplot").querySelector(".u-value").textContent;
};
"""


@pytest.fixture(scope="module")
def phone() -> Iterator[Phone]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with subprocess.Popen([str(_DRIVER), f"--port={port}"], stdout=subprocess.DEVNULL) as driver:
        for _ in range(100):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        try:
            one = Phone(port)
            yield one
            one.end()
        finally:
            driver.terminate()


@pytest.fixture
def page(phone: Phone, tmp_path: Path) -> Phone:
    """The demo's report, its plot at the whole of a recording of 10 s."""
    (tmp_path / "report.html").write_text(result_page(demo_fit(), []).html(), encoding="utf-8")
    phone.open(tmp_path / "report.html")
    assert phone.shown() == pytest.approx([0, 10], abs=_SAMPLE)
    return phone


def line(start: tuple[float, float], end: tuple[float, float], count: int = 12) -> list[tuple[float, float]]:
    """Points on a straight line."""
    return [
        (start[0] + (end[0] - start[0]) * k / count, start[1] + (end[1] - start[1]) * k / count)
        for k in range(count + 1)
    ]


def pinched(page: Phone) -> tuple[float, float, float]:
    """Spread two fingers to double their distance; return the ends before and after of what is shown, and the width."""
    width = page.run(_OVER + "return box().width")
    quarter = width / 4
    middle = width / 2
    page.touch(
        line((middle - quarter / 2, 100), (middle - quarter, 100)),
        line((middle + quarter / 2, 100), (middle + quarter, 100)),
    )
    low, high = page.shown()
    return low, high, width


def test_two_fingers_zoom_about_their_middle(page: Phone) -> None:
    low, high, _ = pinched(page)
    assert (low, high) == pytest.approx((2.5, 7.5), abs=0.1)


def test_one_finger_drags_sideways(page: Phone) -> None:
    low, high, width = pinched(page)
    page.touch(line((0.75 * width, 100), (0.35 * width, 104)))
    first, last = page.shown()
    # 40 % of what is shown, but for the 10 px and more that tell a drag from a tap
    assert 0.3 * (high - low) < first - low <= 0.41 * (high - low)
    assert last - first == pytest.approx(high - low, abs=2 * _SAMPLE)


def test_dragging_ends_where_the_recording_does(page: Phone) -> None:
    low, high, width = pinched(page)
    for _ in range(2):
        page.touch(line((0.95 * width, 100), (0.05 * width, 100)))
    first, last = page.shown()
    assert last == pytest.approx(10, abs=_SAMPLE)
    assert last - first == pytest.approx(high - low, abs=2 * _SAMPLE)


def test_a_double_tap_shows_the_whole_recording(page: Phone) -> None:
    _, _, width = pinched(page)
    page.touch([(0.5 * width, 100)])
    assert page.shown()[0] > 1  # one tap reads a value
    time.sleep(0.5)
    page.touch([(0.5 * width, 100)], times=2)
    assert page.shown() == pytest.approx([0, 10], abs=_SAMPLE)


def test_one_finger_scrolls_the_page(page: Phone) -> None:
    low, high, width = pinched(page)
    before = page.run("return scrollY")
    page.touch(line((0.5 * width, 180), (0.5 * width + 6, 20)))
    time.sleep(0.3)
    assert page.run("return scrollY") > before + 50
    assert page.shown() == pytest.approx([low, high], abs=_SAMPLE)
