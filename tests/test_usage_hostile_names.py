"""Names and texts from files appear unchanged, and have no effect on a page, a picture or a terminal."""

from __future__ import annotations

import io
import re
import sys
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pytest
from file_fuzzer import LAYOUT
from matplotlib.text import Text
from scenario_files import write_ascent

import maxq
from maxq import DataSet, ScenarioError
from maxq.design.verify.suite import read_suite
from maxq.design.verify.verify import verify
from maxq.sim.campaign.analysis import judged, lost
from maxq.sim.campaign.runner import run_campaign
from maxq.sim.input.files import builtin_files
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign
from maxq.tools.campaign_report import report as campaign_text
from maxq.tools.campaign_report import write_report
from maxq.tools.cli.terminal import Progress
from maxq.tools.flight_report import report as flight_text
from maxq.tools.plots.style import drawing, png, sheet
from maxq.tools.vehicle.build import build
from maxq.tools.vehicle.figures import page as layout_page
from maxq.tools.vehicle.layout import read_layout
from maxq.tools.verify.figures import plots
from maxq.tools.verify.report import Signed, page_of
from maxq.tools.verify.report import report as review_text

SCRIPT = "</td></title><script>alert(1)</script><img src=x onerror=alert(1)>"
NAME = f"{SCRIPT} {{{{7*7}}}} [red]&amp; $\\frac$"
"""HTML, a template, rich's markup, an entity, mathematics that is none."""
QUOTED = NAME.replace("\\", "\\\\")

OURS = (Path(__file__).parents[1] / "tools" / "pages" / "plots.js").read_text(encoding="utf-8")
"""The one script that a page may run."""

SHORT = f"""\
schema = 1
extends = "ascent.toml"
name = "{QUOTED}"
description = "{QUOTED} described"
unset = ["injection", "requirement"]
[run]
duration_s = 60.0
[vehicle_overrides]
name = "{QUOTED} vehicle"
stage.0.name = "{QUOTED} stage"
stage.0.aero.surface.0.name = "{QUOTED} surface"
[design_overrides]
name = "{QUOTED} design"
description = "{QUOTED} of the design"
[[requirement]]
name = "{QUOTED} requirement"
metric = "max_speed_mps"
limit = 1000.0
"""
CAMPAIGN = f"""\
schema = 1
extends = "short.toml"
name = "{QUOTED} campaign"
[run]
duration_s = 0.2
[campaign]
runs = 12
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
name = "{QUOTED} thrust"
source = "{QUOTED} source"
distribution = "normal"
three_sigma = 0.03
"""
SUITE = f"""\
schema = 2
name = "{QUOTED} suite"
scenario = "short.toml"
[[flight]]
name = "{QUOTED} flight"
why = "{QUOTED} why"
[[dispersed_limit]]
requirement = "{QUOTED} requirement"
limit = 1000.0
why = "{QUOTED} reason"
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_ascent(tmp_path)
    for name, text in (("short", SHORT), ("campaign", CAMPAIGN), ("suite", SUITE)):
        (tmp_path / f"{name}.toml").write_text(text)
    return tmp_path


class Page(HTMLParser):
    """A page as a browser reads it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.acts: list[str] = []
        self.words = ""
        page = page.replace(f"<script>\n{OURS}\n</script>", "", 1)
        self.feed(page.replace('<script type="application/json" id="figures">', "<p>", 1))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        within = tag == "a" and [name for name, _ in attrs] == ["href"] and (attrs[0][1] or "").startswith("#")
        if tag in ("script", "iframe", "object", "link", "a") and not within:
            self.acts.append(tag)
        for name, value in attrs:
            if name.startswith("on") or (name in ("src", "href") and not within):
                self.acts.append(f"{tag} {name}={value}")

    def handle_data(self, data: str) -> None:
        self.words += data


def only_shows(page: str, *names: str, acts: tuple[str, ...] = ()) -> None:
    found = Page(page)
    assert found.acts == list(acts)
    assert Heard(page).faults == []
    for name in names:
        assert f"{NAME} {name}".strip() in found.words, name
    for shown in (
        "&lt;script&gt;alert(1)",
        "onerror=alert(1)&gt;",
        "\\u003cscript\\u003ealert(1)",
        "onerror=alert(1)\\u003e",
    ):
        page = page.replace(shown, "")
    assert "alert(1)" not in page


_HEARD = {"html": "lang", "th": "scope", "img": "alt"} | dict.fromkeys(("nav", "input", "select", "svg"), "aria-label")
_FIRST = {"table": "caption", "details": "summary"}  # elements that must come first inside others


class Heard(HTMLParser):
    """A page as a screen reader announces it; elements without a name, a caption or a scope are faults."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.faults: list[str] = []
        self.open, self.headings, self.heads, self.last = [""], [], [], ""
        self.feed(page.replace(f"<script>\n{OURS}\n</script>", "", 1))
        if self.headings[:1] != [1] or self.headings.count(1) > 1 or any(b > a + 1 for a, b in pairwise(self.headings)):
            self.faults.append(f"headings {self.headings}")
        self.faults += ["a head without text"] * self.heads.count("")

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given, name = dict(attrs), _HEARD.get(tag)
        if name and not given.get(name) and "label" not in self.open:
            self.faults.append(f"{tag} without {name}")
        if tag == "svg" and given.get("role") != "img":
            self.faults.append("svg without a role")
        if tag != _FIRST.get(self.last, tag):
            self.faults.append(f"{self.last} without {_FIRST[self.last]}")
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        self.heads += [""] * (tag == "th")
        self.last = tag
        self.open += [tag] * (tag not in ("meta", "img", "input", "br", "hr"))

    def handle_endtag(self, tag: str) -> None:
        while len(self.open) > 1 and self.open.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if "th" in self.open:
            self.heads[-1] += data.strip()


def test_a_page_that_cannot_be_heard_is_found() -> None:
    page = "<html><h1>a</h1><h3>b</h3><table><tr><th></th></tr></table><svg></svg><input><img src=x><nav></nav>"
    expected = ["html without lang", "table without caption", "th without scope", "svg without aria-label"]
    expected += ["svg without a role", "input without aria-label", "img without alt", "nav without aria-label"]
    assert Heard(page).faults == [*expected, "headings [1, 3]", "a head without text"]


def test_a_page_that_acts_is_found() -> None:
    """A page with active content is found, so the check can fail."""
    assert Page(f"<td>{SCRIPT}</td>").acts == ["script", "img src=x", "img onerror=alert(1)"]
    assert Page(f"<script>{OURS}alert(1)</script>").acts == ["script"]


@pytest.mark.slow
def test_pages_and_texts_of_a_campaign(here: Path) -> None:
    campaign, folder = maxq.load("campaign.toml"), here / "out"
    run_campaign(campaign, folder, workers=1)
    data = DataSet(folder, campaign)
    write_report(data, judged(data), lost(data), 12)
    page = (folder / "report.html").read_text(encoding="utf-8")
    only_shows(page, "campaign", "described", "requirement", "thrust", "source")
    assert f"{NAME} requirement" in "\n".join(campaign_text(data, judged(data), lost(data)))


@pytest.mark.slow
def test_page_and_text_of_a_review(here: Path) -> None:
    found = verify("designs/trial.toml", read_suite("suite.toml"), workers=1)
    page = page_of(found, f"simverify {NAME} command", plots(found, NAME), Signed(NAME, NAME))
    only_shows(page, "vehicle", "suite", "flight", "why", "reason", "requirement", "command")
    assert f"{NAME} flight" in "\n".join(review_text(found, "title"))


@pytest.mark.slow
def test_page_of_a_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maxq.tools.vehicle.build.MODE_ROWS", 2)  # quicker
    texts = LAYOUT.replace("schema = 1", f'schema = 1\nname = "{QUOTED} layout"\ndescription = "{QUOTED} said"')
    (tmp_path / "layout.toml").write_text(texts.replace('"structure"', f'"{QUOTED} part"'))
    page = layout_page(build(read_layout(tmp_path / "layout.toml")), "BUILT: stable", passed=True)
    only_shows(page, "layout", "said")


def test_page_of_a_design(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    text = builtin_files("design")["ksr3-default"].read_text(encoding="utf-8")
    named = text.replace('name = "KSR-III default"', f'name = "{QUOTED} design"')
    Path("mine.toml").write_text(named, encoding="utf-8")
    assert simdesign.main(["analyse", "mine.toml", "--at", "40", "--out", "out"]) == 0
    page = Path("out/analysis.html").read_text(encoding="utf-8")
    only_shows(page, "design", acts=("a", "a href=analysis.json"))


@pytest.mark.slow
def test_text_of_a_flight(here: Path) -> None:
    assert f"{NAME} requirement" in flight_text(fly(load_scenario("short.toml")), [], 1.0)


def test_rich_shows_markup_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    shown = Terminal()
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr("maxq.tools.cli.terminal._PATIENCE_S", 0.0)
    monkeypatch.setenv("COLUMNS", "200")
    with Progress() as progress:
        progress.show("[red]flying[/red]", 1, 2, "[blink]name[/blink] [/nothing]")
    assert "[red]flying[/red]" in shown.getvalue()
    assert "[blink]name[/blink] [/nothing]" in shown.getvalue()


@pytest.mark.crowded
@pytest.mark.parametrize("name", [NAME, "$\\frac$", "$x$ and $", "\\$", "a $ b"])
def test_pictures_draw_every_name(name: str) -> None:
    with drawing():
        figure, (place, *_) = sheet(1, 1, title=name)
        place.set_title(name)
        place.plot([0, 1], [0, 1], label=name)
        place.set_xlabel(r"$Z_\alpha$, 1/s")
        place.legend()
        assert png(figure, 20).startswith(b"\x89PNG")
        own = next(text for text in figure.findobj(Text) if text.get_text().startswith("$Z"))
        assert own.get_parse_math()


@pytest.mark.parametrize("odd", ["\\u0000", "\\u001b[31m", "\\u0007", "\\u007f", "\\u009b31m", "\\u202e", "\\u2066"])
@pytest.mark.parametrize("key", ["name", "description", "vehicle.name", "vehicle.stage.0.name", "design.description"])
def test_texts_cannot_act_on_a_terminal(here: Path, key: str, odd: str) -> None:
    with pytest.raises(ScenarioError, match="holds a control character; allowed: text") as caught:
        load_scenario("ascent.toml", [f'{key}="a{odd}b"'])
    assert str(caught.value).isprintable()


def test_texts_have_a_length(here: Path) -> None:
    assert load_scenario("ascent.toml", [f'name="{"x" * 200}"']).name == "x" * 200
    with pytest.raises(ScenarioError, match="has 201 characters; allowed: a text of at most 200"):
        load_scenario("ascent.toml", [f'name="{"x" * 201}"'])
    with pytest.raises(ScenarioError, match="has 20001 characters"):
        load_scenario("ascent.toml", [f'description="{"x" * 20001}"'])
