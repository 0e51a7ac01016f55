"""Pictures are equal for equal content, and a notebook's settings are unchanged."""

from __future__ import annotations

import csv
import io
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib as mpl
import numpy as np
import petrelkit as petrel
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text
from picture_check import faults
from replaykit import OLD_LOG

import maxq
from maxq.design.margins.distances import Zone
from maxq.design.verify.judging import Wanted, judge
from maxq.sim.campaign.analysis import Band
from maxq.tools.design import pictures
from maxq.tools.design.open_loop import LoopPicture, Mark
from maxq.tools.design.pictures_loop import contours, draw_loop
from maxq.tools.pages.render import _environment, command, render, sentence
from maxq.tools.plots import campaign, style
from maxq.tools.plots.figures import Panel, Plot, as_csv, as_json, at, band, limit, line, points, thinned
from maxq.tools.plots.palette import RED
from maxq.tools.plots.style import STYLE, curve, drawing, label, name_point, save, settle, sheet
from maxq.tools.replay import sheets
from maxq.tools.replay.flight import open_flights


def test_files_are_equal_when_drawn_twice_and_left_whole(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        with drawing():
            figure, places = sheet(1, 2)
            places[0].plot([0.0, 1.0], [0.0, 2.0], **curve(1), label="rise")
            places[0].legend()
            label(places[1], "time, s", "angle, deg", "empty")
            files.append(save(figure, tmp_path / name / "picture"))
    assert [path.name for path in files[0]] == ["picture.svg", "picture.png"]
    for one, other in zip(*files, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert "<dc:date>" not in files[0][0].read_text()
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["picture.png", "picture.svg"]


def test_style_ends_with_the_drawing() -> None:
    before = mpl.rcParams["font.size"]
    with drawing():
        assert mpl.rcParams["font.size"] == STYLE["font.size"]
    assert mpl.rcParams["font.size"] == before


def test_formats_can_be_chosen(tmp_path: Path) -> None:
    with drawing(("png",)):
        assert save(sheet()[0], tmp_path / "one") == [tmp_path / "one.png"]


def test_every_setting_of_the_style_is_known() -> None:
    assert set(STYLE) <= set(mpl.rcParams)


def test_curves_differ_in_more_than_colour() -> None:
    seen = [curve(k) for k in range(7)]
    assert len({str(c["linestyle"]) for c in seen}) == len({str(c["color"]) for c in seen}) == 7


def test_names_of_points_find_places_of_their_own() -> None:
    """Twenty names on a dense curve, some at the same point, have separate places."""
    with drawing():
        figure, (place,) = sheet(1, 1)
        x = np.linspace(0.0, 10.0, 400)
        place.plot(x, np.sin(3.0 * x))
        for k in range(20):
            name_point(place, 0.5 * k, float(np.sin(1.5 * k)), f"point {k}")
        for k in range(4):
            name_point(place, 5.0, 0.0, f"same {k}", must=False)
        label(place, "time, s", "value", "a title")
    assert not faults(figure)


def test_leaders_of_names_do_not_cross() -> None:
    """Names of neighbouring points far from free space have leaders that cross neither each other nor a spike."""
    with drawing():
        figure, (place,) = sheet(1, 1)
        place.set(xlim=(0.0, 10.0), ylim=(0.0, 10.0))
        for k in range(12):  # a hatched area without room for a name
            place.plot([6.4 + 0.3 * k] * 2, [0.0, 6.0], color="C0")
        for k, x in enumerate((8.0, 8.3, 8.6, 8.9)):
            name_point(place, x, 3.0 + 0.4 * (k % 2), f"a long name {k}")
        label(place, "time, s", "value", "a title")
        settle(figure)
        leaders = [
            np.array([place.transData.transform(t.xy), Text.get_window_extent(t).get_points().mean(axis=0)])
            for t in place.texts
            if isinstance(t, Annotation) and t.arrow_patch is not None and t.arrow_patch.get_visible()
        ]
    assert len(leaders) == 4
    assert not any(_crosses(a, b) for k, a in enumerate(leaders) for b in leaders[:k])


def _crosses(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if two segments (2, 2) cross, by the parameters of their intersection."""
    try:
        s, t = np.linalg.solve(np.stack([a[1] - a[0], b[0] - b[1]], axis=1), b[0] - a[0])
    except np.linalg.LinAlgError:
        return False
    return bool(0.0 < s < 1.0 and 0.0 < t < 1.0)


@pytest.mark.long
def test_pictures_of_the_second_vehicle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sheets to the second stage and design pictures at two operating points are drawn; conftest.py checks each."""
    drawn = []

    def kept(figure: Figure, stem: Path) -> list[Path]:
        style.settle(figure)
        drawn.append(stem.name)
        return []

    monkeypatch.setattr(sheets, "save", kept)
    changes = ("run.duration_s=130", "log.fast_hz=200", "log.slow_hz=100")
    maxq.fly(petrel.scenario(*changes), folder=tmp_path / "flight")
    sheets.write_sheets(open_flights([str(tmp_path / "flight")])[0], tmp_path)
    assert {"05-bending", "14-requirements"} < set(drawn)
    loaded, nodes = petrel.scenario(), petrel.nodes(5.502, 60.0)
    assert loaded.design is not None
    judged, tanks = judge(nodes, loaded.design), ["oxygen", "kerosene"]
    of_case = pictures.case_sheets("petrel, first gains", loaded.design, nodes, nodes, tanks, "petrel")
    every = [
        *pictures.judged_sheets(
            judged, "petrel: petrel, first gains, sampled", Wanted({"gain_margin_db": 6.0, "phase_margin_deg": 30.0})
        ),
        *of_case,
    ]
    with drawing():
        for name, draw in every:
            kept(draw(), Path(name))
    assert len(drawn) > 20


def test_flight_sheets_name_axes_and_panels_in_one_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Axes are `name, unit`, and titles begin with a capital letter except for the symbol q."""
    axes: list[Axes] = []

    def kept(figure: Figure, _: Path) -> list[Path]:
        axes.extend(figure.axes)
        return []

    monkeypatch.setattr(sheets, "save", kept)
    sheets.write_sheets(open_flights([str(OLD_LOG)])[0], tmp_path)
    assert len(axes) > 30
    assert {place.get_xlabel() for place in axes} >= {"dynamic pressure, kPa", "Mach number", "wind, m/s"}
    assert {place.get_title(loc="left") for place in axes} >= {"Profile", "From above", "Pitch", "Yaw", "Roll"}
    assert not [place for place in axes if re.search(r"\(\S+\)$", place.get_xlabel() + place.get_ylabel())]
    titles = [place.get_title(loc="left") for place in axes]
    assert not [title for title in titles if title[:1].islower() and not title.startswith("q alpha")]


@pytest.mark.crowded
def test_a_text_over_another_and_a_clipped_one_are_found() -> None:
    with drawing():
        figure, (place,) = sheet(1, 1)
        place.text(0.5, 0.5, "one")
        place.text(0.5, 0.5, "another")
        figure.text(0.99, 0.5, "beyond the edge")
    assert faults(figure) == ["'beyond the edge' is clipped", "'one' lies over 'another'"]


@pytest.mark.parametrize("name", ["-6 dB", "3 dB", "6 dB"])
def test_contours_are_those_of_the_closed_loop(name: str) -> None:
    """On an M contour |L / (1 + L)| equals its label; at -180 deg L = -M / (M +- 1)."""
    (phase, level), *_ = [(p, d) for text, p, d in contours() if text == name]
    loop = 10.0 ** (level / 20.0) * np.exp(1j * np.radians(phase))
    m_db = float(name.removesuffix(" dB"))
    closed_db = 20.0 * np.log10(np.abs(loop / (1.0 + loop)))
    assert closed_db[np.isfinite(closed_db)] == pytest.approx(m_db, abs=1e-9)
    m = 10.0 ** (m_db / 20.0)
    at_180 = level[np.abs(phase + 180.0) < 1.0]
    wanted = 20.0 * np.log10(m / (m + 1.0)) if m < 1.0 else 20.0 * np.log10(m / np.abs(np.array([m + 1.0, m - 1.0])))
    assert all(np.min(np.abs(at_180 - w)) < 0.05 for w in np.atleast_1d(wanted))


def test_a_loop_is_drawn_with_its_margins_near_minus_one() -> None:
    """Half of a loop through the unit circle has a gain margin of 6.02 dB at -0.5 and 60 deg at the unit circle."""
    hz = np.geomspace(0.1, 10.0, 201)
    curve = 0.5 * np.exp(-1j * np.pi * hz)
    crossing, nearest = np.exp(1j * np.radians(-120.0)), -0.6 - 0.3j
    marks = [
        Mark(1.0, -0.5 + 0j, "upper 6.0 dB, 1 Hz", "gain"),
        Mark(0.7, complex(crossing), "60 deg, 0.7 Hz", "phase"),
        Mark(0.8, nearest, "0.5", "least"),
        Mark(2.0, 0.5 + 0j, "mode 1"),
        Mark(3.0, -0.4 + 0j, "", "gain"),
    ]
    with drawing():
        figure = draw_loop(LoopPicture("a loop", hz, curve, marks, [Zone("ellipse", 30.0, 6.0)]))
        style.settle(figure)
    *_, near = figure.axes
    titles = [place.get_title(loc="left") for place in figure.axes]
    assert titles[:3] == ["Gain |L|", "Nichols", "Phase of L"]
    assert titles[3:] == ["Nyquist (logarithmic beyond 0 dB)", "Distance to -1", "Nyquist near -1 (to scale)"]
    red = [np.asarray(line.get_xydata()) for line in near.lines if line.get_color() == RED]
    gain, arc, least = red
    np.testing.assert_allclose(gain, [(-0.5, 0.0), (-1.0, 0.0)])
    np.testing.assert_allclose(np.hypot(*arc.T), 1.0)
    np.testing.assert_allclose(arc[[0, -1]], [(-0.5, -np.sqrt(0.75)), (-1.0, 0.0)], atol=1e-12)
    assert arc[:, 1].max() < 1e-12, "the short way"
    np.testing.assert_allclose(least, [(-0.6, -0.3), (-1.0, 0.0)])
    names = {text.get_text() for text in near.texts}
    assert {"upper 6.0 dB", "60 deg", "|1 + L| 0.5", "mode 1"} <= names
    (zone,) = near.patches
    outline = zone.get_path().vertices @ [1.0, 1j]
    turned = (np.degrees(np.angle(outline)) + 360.0) % 360.0 - 180.0
    np.testing.assert_allclose((20.0 * np.log10(np.abs(outline)) / 6.0) ** 2 + (turned / 30.0) ** 2, 1.0, atol=1e-9)
    left, right = near.get_xlim()
    low, high = near.get_ylim()
    assert left < -1.0 < right
    assert low < -1.0 < 1.0 < high
    distance = figure.axes[4]
    np.testing.assert_allclose(distance.lines[0].get_ydata(), np.abs(1.0 + curve))
    assert distance.lines[-1].get_ydata() == pytest.approx(0.5)


def test_phase_contours_have_one_phase() -> None:
    for phase, level in ((p, d) for text, p, d in contours() if not text):
        loop = (10.0 ** (level / 20.0) * np.exp(1j * np.radians(phase)))[np.isfinite(phase)]
        turns = np.angle(loop / (1.0 + loop))
        assert np.abs(np.exp(1j * (turns - turns[0])) - 1.0).max() < 1e-6


@pytest.mark.parametrize(("kind", "failures"), [("limit", 3), ("minimum", 5)])
def test_red_is_what_misses_the_limit_and_not_what_lies_on_it(kind: str, failures: int) -> None:
    values = np.repeat([0.0, 1.0, 2.0], [5, 4, 3])
    v: Any = SimpleNamespace(
        name="gimbal", metric="max_gimbal_deg", unit="deg", kind=kind, bound=1.0, tolerance=float("nan")
    )
    assert campaign.missed(values, v).sum() == failures
    bars = campaign.bars(values, np.arange(len(values)) + 100, v)
    assert (sum(bars["y"]), sum(bars["y2"])) == (len(values), failures)
    assert (bars["y2"] <= bars["y"]).all()
    spread = np.random.default_rng(5).normal(size=300)
    bars = campaign.bars(spread, np.arange(300), v)
    for k, run in enumerate(bars["runs"]):  # the worst run of each bar
        low, high = bars["edges"][k : k + 2]
        inside = spread[(spread >= low) & ((spread < high) | (k == len(bars["y"]) - 1))]
        assert bars["y"][k] == len(inside)
        assert run is None if not len(inside) else spread[run] == (inside.max() if kind == "limit" else inside.min())
    v.bound = 2.0 if kind == "limit" else 0.0
    assert not campaign.missed(values, v).any()


@pytest.mark.parametrize(("runs", "name"), [(19, "5 to 95 % (about all runs)"), (20, "5 to 95 %")])
def test_a_band_of_few_runs_says_so(runs: int, name: str) -> None:
    lines = np.array([[1.0, 1.5], [2.0, 2.5], [3.0, 3.5]])
    band = Band("mach", runs, np.array([0.0, 1.0]), (5.0, 50.0, 95.0), lines, np.array([runs, runs]))
    shown, median = campaign._envelope(band, "1", []).series
    assert (shown["name"], median["name"]) == (name, "median")
    assert [shown["y"].tolist(), shown["y2"].tolist(), median["y"].tolist()] == [*lines[[0, 2]].tolist(), [2.0, 2.5]]


def test_texts_of_pages_are_sentences_and_options_stay_whole() -> None:
    assert [sentence(text) for text in ("", "a b", "A b.", "why?")] == ["", "A b.", "A b.", "Why?"]
    shown = "<code>simrun x <span>--set</span> &#39;a-b=&lt;--c&gt;&#39; <span>--out</span> d</code>"
    assert command("simrun x --set 'a-b=<--c>' --out d") == shown


def test_pages_list_their_headings_and_repeat_the_heads_of_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    from maxq.tools.pages import render as module  # noqa: PLC0415  # the module, not its function

    text = "{{ date }}<!-- contents --><h2>One</h2><figcaption>A.</figcaption><table>\n<caption>B.</caption>"
    text += "<tr><th>a</th></tr><tr><td>1</td></tr></table><h2>Two</h2>"
    made = SimpleNamespace(
        get_template=lambda _: SimpleNamespace(render=lambda values: text.replace("{{ date }}", values["date"]))
    )
    monkeypatch.setattr(module, "_environment", lambda: made)
    page = render("any", date="2026-11-22")
    assert page.startswith("2026-11-22")
    assert "<figcaption><b>Figure 1.</b> A.</figcaption>" in page
    assert '<li><a href="#s1">One</a></li><li><a href="#s2">Two</a></li>' in page
    assert '<h2 id="s2">2 Two</h2>' in page
    assert (
        '<table><caption><b>Table 1.</b> B.</caption><thead><tr><th scope="col">a</th></tr></thead>'
        "<tr><td>1</td></tr></table>" in page
    )


def test_data_of_a_figure_hold_all_that_is_drawn_and_end_no_script() -> None:
    name = '</script><b>"gain", up'
    panel = Panel(
        "a",
        [
            line([0.0, 1.0], [2.0, math.nan], name),
            band([0.0], [1.0], [3.0], "b"),
            points([5], [6], runs=[17]),
            limit(4.0),
            at(7.0, "then"),
        ],
    )
    plot = Plot("p", "title", [panel], command="simrun --run {}")
    text = as_json([plot])
    assert "<" not in text
    (back,) = json.loads(text)
    assert back["panels"][0]["series"][0]["name"] == name
    assert back["panels"][0]["series"][0]["y"] == [2.0, None]
    rows = list(csv.reader(io.StringIO(as_csv(plot))))
    assert rows[1:] == [
        ["a", name, "0.0", "2.0", "", ""],
        ["a", name, "1.0", "", "", ""],
        ["a", "b", "0.0", "1.0", "3.0", ""],
        ["a", "", "5", "6", "", "17"],
        ["a", "limit", "", "4.0", "", ""],
        ["a", "then", "7.0", "", "", ""],
    ]


@pytest.mark.parametrize("name", ['=HYPERLINK("http://a")', "+1", "-1", "@a", "\tb"])
def test_a_name_is_no_formula_of_a_spreadsheet(name: str) -> None:
    x = np.array([-1.0])
    rows = list(csv.reader(io.StringIO(as_csv(Plot("p", "title", [Panel(name, [line(x, x, name)])])))))
    assert rows[1][:4] == [f"'{name}", f"'{name}", "-1.0", "-1.0"]


def test_a_thinned_curve_stays_within_a_share_of_its_range() -> None:
    x = np.linspace(0.0, 10.0, 20001)
    y = np.sin(x) + 5.0 * np.exp(-(((x - 4.0) / 0.01) ** 2))
    a, b = thinned(x, y)
    assert len(a) < 2500
    assert np.abs(np.interp(x, a, b) - y).max() < np.ptp(y) / 200.0
    assert (a[0], a[-1]) == (x[0], x[-1])


def test_only_a_short_place_of_a_requirement_stays_on_one_line() -> None:
    """A long place of a requirement is broken into lines.

    On one line, a place of 197 characters makes the table of requirements 2038 pixels wide.
    """
    cell: Any = _environment().get_template("elements.html.j2").module
    short, long = "at 106.79 s, pitch, stage 1, as flown it", "at 53.8 s, yaw; sigmas: slope of mode 1 <"
    assert (len(short), len(long)) == (40, 41)
    assert cell.place_cell(short[:-1]) == '<td class="limit">106.79 s, pitch, stage 1, as flown i</td>'
    assert cell.place_cell(short) == "<td>106.79 s, pitch, stage 1, as flown it</td>"
    assert cell.place_cell(long) == "<td>53.8 s, yaw; sigmas: slope of mode 1 &lt;</td>"
