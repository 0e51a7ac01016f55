"""Check the figures of pages in a real browser: `make test-browser`. Not collected by `make test`: it needs Chromium.

MAXQ_PAGES=report.html:review.html adds those pages to the check of texts.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from browser_replay import Page, page

from maxq.tools.pages import render as pages
from maxq.tools.plots import campaign
from maxq.tools.plots.figures import Panel, Plot, as_csv, at, band, limit, line, loop, points, shape

__all__ = ["page"]

BODY = """{% extends "skeleton.html.j2" %}{% from "elements.html.j2" import plot %}
{% block title %}figures{% endblock %}
{% block body %}{% for p in plots %}{{ plot(plots, p.name) }}{% endfor %}{% endblock %}"""
FAULTS = """(() => {
  const found = [];
  for (const svg of document.querySelectorAll("figure svg")) {
    const whole = svg.getBoundingClientRect();
    const texts = [...svg.querySelectorAll("text")].map((t) => [t.textContent, t.getBoundingClientRect()]);
    for (const [text, b] of texts)
      if (b.left < whole.left - 1 || b.right > whole.right + 1 || b.top < whole.top - 2 || b.bottom > whole.bottom + 2)
        found.push(`${text} is clipped in ${svg.getAttribute("aria-label")}`);
    texts.forEach(([one, a], k) => texts.slice(k + 1).forEach(([other, b]) => {
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      if (across > 1.5 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 3)
        found.push(`${one} lies over ${other} in ${svg.getAttribute("aria-label")}`);
    }));
  }
  const wide = document.documentElement.scrollWidth;
  if (wide > innerWidth + 1) found.push(`the page is ${wide} wide`);
  return found;
})()"""


def plots() -> list[Plot]:
    """Return a plot of every kind of series, with numbers of every magnitude."""
    t, random = np.linspace(0.0, 60.0, 200), np.random.default_rng(1)
    values = random.normal(5.0, 1.0, 200)
    v: Any = SimpleNamespace(name="gimbal", metric="max_gimbal_deg", unit="deg", kind="limit", bound=6.5)
    hz = np.geomspace(0.02, 50.0, 600)
    loop = 8.0 / ((2j * np.pi * hz) ** 2 + 0.1j * hz) * (1.0 + 2j * np.pi * hz) * np.exp(-0.05j * 2.0 * np.pi * hz)
    turn, level = np.degrees(np.angle(-loop)) - 180.0, 20.0 * np.log10(np.abs(loop))
    names = ["an input with a name that is much too long for so narrow a panel", "b"]
    rows = {"kind": "rows", "colour": "blue", "name": "", "names": names, "matters": [True, False]}
    rows |= {"x": [0.5, -0.2], "y": [0.5, -0.2]}
    panels = [
        Panel("large", [line(t, 1e5 * np.sin(t)), band(t, 0 * t, 4e4 + 0 * t, "band"), limit(9e4)], "time, s", "Pa"),
        Panel("small", [line(t, 1e-5 * t, mark="o"), at(30.0, "half")], "time, s", "1"),
        Panel("constant", [line(t, 0.0 * t)], "time, s"),
        Panel("runs", [points(values, -values, runs=np.arange(200))], "x", "y"),
        Panel("bars", [campaign.bars(values, np.arange(200), v), at(6.5, "limit")], "gimbal, deg", "runs"),
        Panel("rows", [rows], "rank", x_range=(-1.0, 1.0), y_range=(0.0, 1.0), rows=True),
        Panel("loop", [line(hz, level)], "frequency, Hz", "dB", log_x=True),
        Panel(
            "Nichols",
            [
                line(turn, level, "L"),
                points([-120.0, -121.0], [5.0, 5.1], labels=["slosh 1", "slosh 2"]),
                shape([(-210.0, 0.0), (-180.0, -6.0), (-150.0, 0.0), (-180.0, 6.0)], "zone"),
            ],
            "phase, deg",
            "|L|, dB",
            (-360.0, 0.0),
            (-40.0, 30.0),
            plane="nichols",
        ),
    ]
    made = [Plot(f"columns-{n}", "All", panels, "A caption.", n, 170, command="simrun --run {}") for n in (2, 3)]
    return [*made, loops()]


def loops() -> Plot:
    """Return the figure of open loops, for two operating points in pitch and one in yaw."""
    hz = np.geomspace(0.05, 50.0, 400)
    every = []
    for at_s, plane, gain in ((10.0, "pitch", 6.0), (20.0, "pitch", 9.0), (20.0, "yaw", 3.0)):
        curve = gain / (2j * np.pi * hz) * np.exp(-0.03j * 2.0 * np.pi * hz)
        level, phase = 20.0 * np.log10(np.abs(curve)), np.degrees(np.unwrap(np.angle(curve)))
        k = int(np.argmin(np.abs(phase + 180.0)))
        mark = {"x": hz[k], "y": level[k], "y2": -180.0, "what": "gain", "name": "upper", "colour": "limit"}
        name = f"{at_s:g} s, {plane}"
        every.append(loop(hz, level, phase, name, [mark], group=plane, at=at_s, text="margins", first=at_s == 10.0))
    bode = [
        Panel("gain", [], "frequency, Hz", "dB", (0.05, 50.0), (-40.0, 30.0), log_x=True, plane="gain"),
        Panel("phase", [], "frequency, Hz", "deg", (0.05, 50.0), (-1080.0, 0.0), log_x=True, plane="phase"),
        Panel("distance", [], "frequency, Hz", "|1 + L|", (0.05, 50.0), (0.0, 2.0), log_x=True, plane="distance"),
    ]
    nichols = Panel("Nichols plane", [], "phase, deg", "dB", (-360.0, 0.0), (-40.0, 30.0), plane="nichols")
    nyquist = Panel("Nyquist plane", [], x_range=(-3.0, 3.0), y_range=(-3.0, 3.0), plane="nyquist", equal=True)
    critical = Panel("near -1", [], "Re L", "Im L", (-1.6, 0.6), (-1.1, 1.1), plane="critical", equal=True)
    return Plot("loops", "Loops", [*bode, nichols, nyquist, critical], "A caption.", 2, 180, loops=every, split=3)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    made: Any = pages._environment().from_string(BODY)
    monkeypatch.setattr(pages, "_environment", lambda: SimpleNamespace(get_template=lambda _: made))
    (tmp_path / "page.html").write_text(pages.render("", plots()), encoding="utf-8")
    return tmp_path / "page.html"


def shown(page: Page, file: Path, width: int) -> None:
    page.do("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=False)
    page.do("Page.enable")
    page.do("Runtime.enable")
    page.do("Page.navigate", url=file.resolve().as_uri())
    deadline = time.monotonic() + 20.0
    while value(page, "document.readyState") != "complete" and time.monotonic() < deadline:
        time.sleep(0.1)


def value(page: Page, what: str) -> Any:
    return page.do("Runtime.evaluate", expression=what, returnByValue=True)["result"].get("value")


def mouse(page: Page, kind: str, x: float, y: float, count: int = 0) -> None:
    button = "left" if count else "none"
    page.do("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=int(bool(count)), clickCount=count)


@pytest.mark.parametrize("width", [390, 800, 1280])
def test_no_text_is_clipped_or_lies_over_another(page: Page, file: Path, width: int) -> None:
    named = [Path(name) for name in os.environ.get("MAXQ_PAGES", "").split(":") if name]
    for each in (file, *named):
        shown(page, each, width)
        assert page.errors == []
        assert value(page, "document.querySelectorAll('figure.plot svg[role=img]').length") > 3
        assert value(page, FAULTS) == [], each


def test_overlapping_texts_are_found(page: Page, file: Path) -> None:
    """The check finds two overlapping texts, so it can fail."""
    shown(page, file, 1280)
    value(page, "(() => { const t = document.querySelector('figure svg text'); t.after(t.cloneNode(true)); })()")
    assert len(value(page, FAULTS)) == 1


def test_a_point_tells_its_values_and_its_command_and_a_panel_zooms(page: Page, file: Path) -> None:
    shown(page, file, 1280)
    panel = "[...document.querySelectorAll('.panel')].find((p) => p.innerText.startsWith('Runs'))"
    value(page, f"{panel}.scrollIntoView()")
    box = f"(({panel}).querySelectorAll('circle')[7].getBoundingClientRect())"
    x, y = (value(page, f"{box}.{side} + {box}.{size} / 2") for side, size in (("left", "width"), ("top", "height")))
    mouse(page, "mouseMoved", x, y)
    assert "run 7" in value(page, "document.querySelector('.tip').textContent").splitlines()
    mouse(page, "mousePressed", x, y, 1)
    mouse(page, "mouseReleased", x, y, 1)
    assert value(page, f"{panel}.closest('figure').querySelector('.command code').textContent") == "simrun --run 7"
    ticks = f"[...{panel}.querySelectorAll('svg > text')].map((t) => t.textContent).join(' ')"
    before = value(page, ticks)
    mouse(page, "mousePressed", x - 20, y - 15, 1)
    mouse(page, "mouseMoved", x, y, 1)
    mouse(page, "mouseMoved", x + 20, y + 15, 1)
    mouse(page, "mouseReleased", x + 20, y + 15, 1)
    assert value(page, ticks) != before
    assert not value(page, f"{panel}.querySelector('button').hidden")
    value(page, f"{panel}.querySelector('button').click()")
    assert value(page, ticks) == before


def key(page: Page, name: str) -> None:
    codes = {"ArrowRight": 39, "ArrowLeft": 37, "ArrowDown": 40, "Enter": 13, "Escape": 27, "+": 187}
    more = {"text": name} if len(name) == 1 else {}
    page.do("Input.dispatchKeyEvent", type="keyDown", key=name, windowsVirtualKeyCode=codes[name], **more)
    page.do("Input.dispatchKeyEvent", type="keyUp", key=name, windowsVirtualKeyCode=codes[name])


CURVES = """[...document.querySelectorAll('#figure-loops .panel')]
  .map((p) => [...p.querySelectorAll('svg[role=img] path')].map((q) => q.getAttribute('d'))
  .reduce((a, b) => b.length > a.length ? b : a, ''))"""


def test_a_slider_chooses_the_loop_of_every_plane(page: Page, file: Path) -> None:
    """Three key presses show both operating points in pitch; choosing the yaw plane shows the one in yaw."""
    shown(page, file, 1280)
    figure = "document.getElementById('figure-loops')"
    assert value(page, f"{figure}.querySelector('output b').textContent") == "10 s, pitch"
    before = value(page, CURVES)
    assert len(before) == 6
    value(page, f"{figure}.querySelector('input').focus()")
    key(page, "ArrowRight")
    assert value(page, f"{figure}.querySelector('output b').textContent") == "20 s, pitch"
    after = value(page, CURVES)
    assert [one != other for one, other in zip(before, after, strict=True)] == [True, False, True, True, True, True], (
        "the phase of a loop does not depend on its gain"
    )
    key(page, "ArrowLeft")
    assert value(page, CURVES) == before
    value(page, f"{figure}.querySelector('select').value = 'yaw'")
    value(page, f"{figure}.querySelector('select').dispatchEvent(new Event('change'))")
    assert value(page, f"{figure}.querySelector('output b').textContent") == "20 s, yaw"
    assert page.errors == []


def test_panels_of_a_column_are_aligned_and_zoom_together(page: Page, file: Path) -> None:
    shown(page, file, 1280)
    panels = "[...document.querySelectorAll('#figure-loops .panel')].slice(0, 3)"
    lefts = f"{panels}.map((p) => p.querySelector('clipPath rect').getAttribute('x')).join()"
    left, *others = value(page, lefts).split(",")
    assert others == [left, left]
    middles = """[...document.querySelectorAll('.under')].map((p) => {
        const text = new Range(), frame = p.parentNode.querySelector('clipPath rect');
        text.selectNodeContents(p);
        const b = text.getBoundingClientRect(), s = p.parentNode.querySelector('svg[role=img]').getBoundingClientRect();
        return Math.abs((b.left + b.right - frame.getAttribute('width')) / 2 - s.left - frame.getAttribute('x'));
      })"""
    assert max(value(page, middles)) < 3.0, "titles are in the middle of their axes"
    along = "[...p.querySelectorAll('svg > text[text-anchor=middle]')].map((t) => t.textContent).join(' ')"
    ticks = f"{panels}.map((p) => {along})"
    before = value(page, ticks)
    value(page, f"{panels}[0].querySelector('svg[role=img]').focus()")
    for name in ("ArrowRight", "ArrowRight", "+", "+"):
        key(page, name)
    after = value(page, ticks)
    assert all(one != other for one, other in zip(before, after, strict=True))
    assert "|1 + L|" in value(page, "document.querySelector('.tip').textContent")
    key(page, "Escape")
    assert value(page, ticks) == before


def test_a_point_is_reached_by_keyboard(page: Page, file: Path) -> None:
    shown(page, file, 1280)
    panel = "[...document.querySelectorAll('.panel')].find((p) => p.innerText.startsWith('Runs'))"
    value(page, f"{panel}.querySelector('svg[role=img]').focus()")
    for name in ("ArrowRight", "ArrowRight", "ArrowRight", "Enter"):
        key(page, name)
    assert "run 2" in value(page, "document.querySelector('.tip').textContent").splitlines()
    assert value(page, f"{panel}.closest('figure').querySelector('.command code').textContent") == "simrun --run 2"


@pytest.mark.parametrize("number", [0, 2])
def test_the_page_gives_the_data_that_lie_beside_it(page: Page, file: Path, number: int) -> None:
    shown(page, file, 1280)
    value(
        page, "window.kept = []; URL.createObjectURL = (blob) => { blob.text().then((t) => kept.push(t)); return '#'; }"
    )
    value(page, f"document.querySelectorAll('a.data')[{number}].dispatchEvent(new Event('click'))")
    deadline = time.monotonic() + 20.0
    while not value(page, "kept.length") and time.monotonic() < deadline:
        time.sleep(0.1)
    (text,) = value(page, "kept")
    wanted = as_csv(plots()[number])
    rows, own = text.split("\r\n"), wanted.rstrip().split("\r\n")
    assert len(rows) == len(own)
    for a, b in zip(rows, own, strict=True):
        for x, y in zip(a.rsplit(",", 4), b.rsplit(",", 4), strict=True):
            assert x == y or float(x) == float(y)
