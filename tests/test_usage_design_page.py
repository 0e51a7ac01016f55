"""The page of `simdesign` has the expected content and planes, and a limited size."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maxq.design import operating_points
from maxq.design.verify.judging import Wanted, judge
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign
from maxq.tools.design.figures import explorer, limits_over_flight
from maxq.tools.plots.figures import as_csv

Printed = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def figures(page: str) -> dict[str, dict[str, Any]]:
    (found,) = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', page, re.DOTALL)
    return {figure["name"]: figure for figure in json.loads(found)}


def words(page: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page.split("<script", maxsplit=1)[0])).split())


def outcome(path: Path) -> tuple[str, ...]:
    """Return the tone, word and reason of a page's outcome."""
    (found,) = re.findall(r'<div class="outcome (\w+)"><b>(.*?)</b><p>(.*?)</p>', path.read_text(encoding="utf-8"))
    return tuple(map(html.unescape, found))


def test_an_analysis_is_a_page(capsys: Printed) -> None:
    assert simdesign.main(["analyse", "ksr3-default", "--at", "20", "--at", "40", "--out", "here"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "PASSED: stable, all 9 limits met; page: here/analysis.html"
    assert sorted(path.name for path in Path("here").iterdir()) == ["analysis.html", "analysis.json"]
    page = Path("here/analysis.html").read_text(encoding="utf-8")
    assert len(page) < 300_000
    assert not re.findall(r"""(?:src|href)=["']?(?:https?:)?//""", page), "nothing from outside"
    text = words(page)
    assert "PASSED Stable, all 9 limits met." in text
    assert "simdesign analyse ksr3-default --at 20 --at 40 --out here" in text
    told = json.loads(Path("here/analysis.json").read_text())
    for limit in told["limits"]:
        assert f"{limit['name']} " in text
    rows = [re.findall(r"<td.*?>(.*?)</td>", row) for row in page.split("<caption>")[1].split("<tr>")[2:]]
    (phase,) = [row for row in rows if row[0] == "phase margin"]
    asked, value, left = (float(cell.removeprefix("≥\xa0").removesuffix(" deg")) for cell in phase[1:4])
    assert (left, len(phase[2]), len(phase[3])) == (pytest.approx(value - asked, abs=1e-9), 9, 9), (
        "as exact as the value"
    )
    drawn = figures(page)
    assert set(drawn) == {"utilisation", "limits", "loop", "gains", "filter"}
    loop = drawn["loop"]
    assert [panel["plane"] for panel in loop["panels"]] == [
        "gain",
        "phase",
        "distance",
        "nichols",
        "nyquist",
        "critical",
    ]
    assert [one["name"] for one in loop["loops"]] == ["20 s, pitch and yaw", "40 s, pitch and yaw"]
    assert sum(one["first"] for one in loop["loops"]) == 1, "the loop that is shown first"
    for one, node in zip(loop["loops"], told["nodes"], strict=True):
        marks = {mark["what"]: mark for mark in one["marks"]}
        assert marks["gain"]["x"] == pytest.approx(node["gain_up"]["at_hz"], rel=1e-4)
        assert marks["gain"]["y"] == pytest.approx(-node["gain_up"]["db"], abs=1e-3)
        assert (marks["phase"]["y2"] + 180.0) % 360.0 == pytest.approx(node["phase"]["deg"], abs=0.1)
        assert marks["least"]["name"] == f"{node['modulus']:.3g}"
        distance = np.abs(1.0 + 10.0 ** (np.array(one["y"]) / 20.0) * np.exp(1j * np.radians(one["y2"])))
        assert distance.min() == pytest.approx(node["modulus"], rel=0.01)


def test_a_design_with_other_gains_in_yaw_is_shown_in_both_planes() -> None:
    text = builtin_files("design")["ksr3-default"].read_text(encoding="utf-8")
    weaker = "[{ time_s = 5.0, k_p = 0.9, k_d_s = 0.4 }, { time_s = 55.0, k_p = 0.6, k_d_s = 0.3 }]"
    text = text.replace('yaw = "pitch"', f"yaw_table = {weaker}", 1)
    Path("mine.toml").write_text(text, encoding="utf-8")
    simdesign.main(["analyse", "mine.toml", "--at", "40", "--out", "here"])
    loops = figures(Path("here/analysis.html").read_text(encoding="utf-8"))["loop"]["loops"]
    assert [(one["group"], one["name"]) for one in loops] == [("pitch", "40 s, pitch"), ("yaw", "40 s, yaw")]
    assert loops[0]["text"] != loops[1]["text"]


def test_a_missed_limit_leads_the_page(capsys: Printed) -> None:
    text = builtin_files("design")["ksr3-default"].read_text(encoding="utf-8")
    Path("strict.toml").write_text(text.replace("gain_margin_db = 6.0", "gain_margin_db = 9.6"), encoding="utf-8")
    assert simdesign.main(["analyse", "strict.toml", "--at", "40", "--out", "here"]) == 1
    shown = words(Path("here/analysis.html").read_text(encoding="utf-8"))
    assert "FAILED Gain margin missed" in shown
    told = capsys.readouterr().out.splitlines()[-1].partition("; page: ")[0].removeprefix("FAILED: ")
    assert outcome(Path("here/analysis.html")) == ("bad", "FAILED", f"{told[0].upper()}{told[1:]}.")
    tightest = shown.partition("Tightest limits: ")[2]
    wanted = r"gain margin(, \w+, other axes closed)?: \S+ dB at 40 s, limit ≥\s9.6 dB, margin to limit -\S+ dB"
    assert len(re.findall(wanted, tightest)) == 3


def test_the_data_of_the_loops_are_all_there() -> None:
    loaded = load_scenario("nominal")
    assert loaded.design is not None
    judged = judge(operating_points.nodes(loaded, [20.0, 40.0]), loaded.design)
    limits = [Wanted({"gain_margin_db": 6.0, "phase_margin_deg": 30.0, "modulus_db": -6.0}), Wanted()]
    plot = explorer(judged, ["20 s", "40 s"], limits, ["pitch"] * 2)
    (zone,), (least,) = (plot.loops[0]["limits"][plane] for plane in ("nichols", "distance"))
    assert (zone["x"].min(), zone["y"].max()) == (-210.0, 6.0)
    assert least["value"] == pytest.approx(0.501, abs=1e-3)
    assert plot.loops[1]["limits"] == {"nichols": [], "critical": [], "distance": []}
    (near,) = plot.loops[0]["limits"]["critical"]
    outline = near["x"] + 1j * near["y"]
    turned = (np.degrees(np.angle(outline)) + 360.0) % 360.0 - 180.0
    share = np.abs(20.0 * np.log10(np.abs(outline))) / 6.0 + np.abs(turned) / 30.0
    np.testing.assert_allclose(share, 1.0, atol=1e-9)  # on the diamond of 6 dB and 30 deg, all around
    assert len(outline) == 48
    assert (near["x"].min(), near["y"].max()) == pytest.approx((-1.9953, np.sin(np.radians(30.0))), abs=0.02)
    (panel,) = [p for p in plot.panels if p.plane == "critical"]
    assert panel.equal
    assert panel.x_range == (-1.6, 0.6), "the unit circle near -1"
    rows = [line.split(",") for line in as_csv(plot).splitlines()]
    mine = [row for row in rows if row[0] == "40 s"]
    assert len(mine) == len(plot.loops[1]["x"])
    hz, level_db = float(mine[50][-4]), float(mine[50][-3])
    assert level_db == pytest.approx(20.0 * np.log10(abs(judged[1].loop.response(np.array([hz]))[0])), abs=0.01)
    assert limits_over_flight([]) == []
