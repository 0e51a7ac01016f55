"""The results of a campaign are readable in the last line, the table of requirements and the report."""

from __future__ import annotations

import re
from pathlib import Path

import campaignkit
import pytest

import maxq
from maxq.sim.campaign.statistics import judge_failures
from maxq.tools import simrun

REQUIREMENTS = """\
[[requirement]]
metric = "max_speed_mps"
limit = 100.0
name = "speed"
[[requirement]]
metric = "max_dynamic_pressure_Pa"
limit = 2000.0
name = "pressure"
[[requirement]]
metric = "saturation_time_s"
limit = 0.0
name = "saturation"
"""


def told(folder: Path, capsys: pytest.CaptureFixture[str], rest: str = REQUIREMENTS, campaign: str = "") -> list[str]:
    """Return what a campaign of 20 runs prints."""
    file = campaignkit.write_campaign(folder, runs=20, campaign=campaign, rest=rest)
    simrun.main([str(file), "--out", str(folder / "out")])
    return capsys.readouterr().out.splitlines()


def test_a_settled_campaign_names_its_tightest_requirement(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = told(tmp_path, capsys, campaign="success = 0.5\nconfidence = 0.5")
    said = "MET: all 4 requirements together in 50 % of flights with 50 % confidence; "
    said += "0 of 20 runs failed; tightest: speed, "
    assert lines[-1].startswith(said)
    assert re.search(r", \d\.\d{3} of 100 m/s, \d % used in run \d+$", lines[-1])
    at = lines.index("requirements")
    heads = lines[at + 1].split()
    assert heads[:7] == ["requirement", "verdict", "worst", "limit", "used", "run", "failed"]
    assert [line.split()[0] for line in lines[at + 2 : at + 6]] == ["speed", "pressure", "control", "saturation"]
    assert "<= 2 kPa" in lines[at + 3]  # as the value, which is below 0.1 kPa
    assert "to go" not in lines[at + 1]  # nothing is to go: the column would be empty
    assert "50 % quantile" in lines[at + 1]
    assert lines[-3].startswith("next: read ")


def test_too_few_runs_are_undecided_without_a_quantile(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = told(tmp_path, capsys)
    more = judge_failures(0, 20, 0.9973, 0.9).more
    said = f"UNDECIDED: {more} more runs needed to show 99.73 % of flights with 90 % confidence; "
    assert lines[-1].startswith(said + "0 of 4 requirements met; 0 of 20 runs failed; tightest: speed, ")
    head = lines[lines.index("requirements") + 1]
    assert "quantile" not in head  # between the two worst of 20 runs
    assert "bound" not in head
    assert f"next: repeat the command with --runs {20 + more}" in lines


def test_a_missed_requirement_comes_first_with_its_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = told(tmp_path, capsys, REQUIREMENTS.replace("100.0", "1.0"))
    said = r"MISSED: speed \d\.\d{3} m/s > 1 m/s in 20 of 20 runs \(worst: run \d+\); required in 99.73 % "
    assert re.match(said, lines[-1])
    assert lines[-1].endswith("; 0 of 4 requirements met")
    assert any(re.match(r"next: simrun refly \S+ --run \d+$", line) for line in lines)
    at = lines.index("requirements")
    assert lines[at + 2].split()[:2] == ["speed", "missed"]
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    worst = [
        re.findall("<td.*?>(.*?)</td>", row, re.DOTALL) for row in page.split("Worst flights</h2>")[1].split("<tr>")[2:]
    ]
    assert [row[0] for row in worst[:4]] == ["speed", "", "", "pressure"], (
        "three that miss, and the worst that does not"
    )
    values = [float(row[1].removesuffix(" m/s")) for row in worst[:3]]
    assert values == sorted(values, reverse=True)
    assert values[2] > 1.0
    assert f"<span>--run</span> {worst[0][2]}</code>" in worst[0][4]
    assert page.count('class="n bad">') == 3
    assert '<td class="n used bad" style="--used:' in page
    assert "<dt>campaign</dt>" not in page, "it is the title"


def test_the_first_campaign_of_a_newcomer_ends_settled() -> None:
    campaign = maxq.load("campaigns/first").campaign
    for failures, judgement in ((0, "met"), (1, "undecided"), (20, "missed")):
        shown = judge_failures(failures, campaign.runs, campaign.success, campaign.confidence)
        assert shown.judgement == judgement
    needed = judge_failures(0, 1, campaign.success, campaign.confidence).more + 1
    assert needed <= campaign.runs <= 100


@pytest.mark.parametrize("width", [80, 120])
def test_the_table_of_requirements_keeps_its_lines_whole(
    tmp_path: Path, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    lines = told(tmp_path, capsys, campaign="success = 0.5\nconfidence = 0.5")
    at = lines.index("requirements")
    assert [line.split()[0] for line in lines[at + 2 : at + 6]] == ["speed", "pressure", "control", "saturation"]
    assert max(map(len, lines[at : at + 6])) <= width
