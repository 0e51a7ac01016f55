"""Verdicts for continuous integration: JUnit XML of a campaign, and the published schema of verdict.json.

`test_usage_verify.py` checks both for a verification, which it flies anyway.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from campaignkit import write_campaign
from jsonschema import Draft202012Validator
from junit_form import is_junit

from maxq.tools import simrun
from maxq.tools.cli.frame import CommandError
from maxq.tools.exchange.junit import TestCase, TestSuite, checked_path, write_junit

REQUIREMENTS = """\
[[requirement]]
name = "speed & <mass>"
metric = "max_speed_mps"
limit = 1e-3
[[requirement]]
metric = "max_gimbal_deg"
limit = 5.0
"""


def test_a_campaign_is_a_test_suite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Six runs of 0.3 s: all miss the limit of the speed, and too few show the others."""
    monkeypatch.chdir(tmp_path)
    file = write_campaign(tmp_path, runs=6, rest=REQUIREMENTS)
    assert simrun.main(["campaign", str(file), "--out", "c", "--no-report", "--junit", "out/c.xml"]) == 1
    suite = is_junit(tmp_path / "out/c.xml").find("testsuite")
    assert suite is not None
    cases = {case.attrib["name"]: case for case in suite.findall("testcase")}
    assert list(cases) == ["control kept", "speed & <mass>", "max_gimbal_deg", "all requirements"]
    missed = cases["speed & <mass>"].find("failure")
    assert missed is not None
    assert missed.attrib["type"] == "missed"
    assert "missed in 6 of 6 runs" in missed.attrib["message"]
    assert "limit 0.001 m/s" in missed.attrib["message"]
    assert missed.text == "again: simrun refly c --run 0"
    undecided = cases["max_gimbal_deg"].find("error")
    assert undecided is not None
    assert undecided.attrib["type"] == "undecided"
    assert "missed in 0 of 6 runs" in undecided.attrib["message"]
    assert "more runs needed" in undecided.attrib["message"]
    (headline,) = [p.attrib["value"] for p in suite.iter("property") if p.attrib["name"] == "headline"]
    assert headline.startswith("MISSED: speed & <mass> ")
    assert simrun.main(["report", "c", "--no-report", "--junit", "again.xml"]) == 1
    again = {case.attrib["name"] for case in is_junit(tmp_path / "again.xml").iter("testcase")}
    assert again == set(cases)


def test_a_waiver_passes_and_characters_that_xml_excludes_are_replaced(tmp_path: Path) -> None:
    cases = [
        TestCase("margins", "a\x00b\x1b", "met", "", "waived by the board"),
        TestCase("margins", "ü ≤ \U0001f680", "missed", 'x "1" < 2', ""),
    ]
    root = is_junit(write_junit(tmp_path / "v.xml", [TestSuite("s", cases, 1.5, {"k": "v"})]))
    first, second = root.iter("testcase")
    assert first.attrib["name"] == "a\ufffdb\ufffd"
    assert first.findtext("system-out") == "waived by the board"
    assert second.attrib["name"] == "ü ≤ \U0001f680"
    (told,) = second
    assert told.attrib["message"] == 'x "1" < 2'


def test_the_name_of_a_junit_file_ends_with_xml() -> None:
    with pytest.raises(CommandError, match=r"--junit v\.json: the name of this file ends with \.xml"):
        checked_path("v.json")


def test_the_schema_of_a_verdict_is_printed_and_strict(capsys: pytest.CaptureFixture[str]) -> None:
    assert simrun.main(["schema", "verdict"]) == 0
    schema = json.loads(capsys.readouterr().out)
    Draft202012Validator.check_schema(schema)
    assert schema["additionalProperties"] is False
    assert {"schema", "verdict", "requirements", "hashes", "attempt", "wall_s"} <= set(schema["required"])
    assert "files" not in schema["required"]
    assert schema["properties"]["schema"]["const"] == 2
    requirement = {"$defs": schema["$defs"], "$ref": "#/$defs/RequirementRecord"}
    texts = dict.fromkeys(("part", "name", "wanted", "found", "where", "again", "waived"), "x")
    good = texts | {"verdict": "rejected", "room": None, "more_runs": 0}
    checker = Draft202012Validator(requirement)
    assert checker.is_valid(good)
    assert not checker.is_valid(good | {"verdict": "fine"})
    assert not checker.is_valid({key: value for key, value in good.items() if key != "found"})
