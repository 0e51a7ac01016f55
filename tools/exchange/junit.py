"""Verdicts as JUnit XML, which continuous integration shows as tests: one test case for each requirement.

A requirement that is not met is a failure, and an undecided one an error. A waived one passes, with the waiver as its
output. Source of the form: junit-10.xsd of the Jenkins plugin xUnit.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

from maxq.design.verify.suite import ACCEPTED, REJECTED, JudgedRequirement
from maxq.design.verify.verify import Verification
from maxq.sim.campaign.analysis import DataSet, Judged
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.sim.files import whole_file
from maxq.tools.cli.frame import CommandError
from maxq.tools.verify.outcome import headline

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class TestCase:
    """A requirement. `group` is its class name, `said` the reason, and `more` a command that repeats it or a waiver."""

    group: str
    name: str
    outcome: Literal["met", "missed", "undecided"]
    said: str
    more: str = ""

    __test__ = False  # pytest collects classes of this name


@dataclass(frozen=True)
class TestSuite:
    """The requirements of one verdict, with its duration, s, and further facts."""

    name: str
    cases: list[TestCase]
    wall_s: float
    properties: Mapping[str, str]

    __test__ = False


def checked_path(name: str) -> Path:
    """Return the path of a JUnit file. Raises CommandError unless the name ends with .xml."""
    if not name.lower().endswith(".xml"):
        raise CommandError(f"--junit {name}: the name of this file ends with .xml")
    return Path(name)


def suite_of_verification(found: Verification, design: str) -> TestSuite:
    """Return the test suite of a verified design."""
    words: dict[str, Literal["met", "missed"]] = {ACCEPTED: "met", REJECTED: "missed"}
    cases = [
        TestCase(
            r.part,
            f"{r.name} ({r.where})" if r.where else r.name,
            "met" if r.waived else words.get(r.judgement, "undecided"),
            r.reason,
            _further(r),
        )
        for r in found.requirements
    ]
    about = {"verdict": found.judgement, "headline": headline(found)}
    about |= {"missing evidence": "; ".join(found.missing_evidence)} if found.missing_evidence else {}
    return TestSuite(f"{design} by {found.suite.name}", cases, found.wall_s, about)


def _further(r: JudgedRequirement) -> str:
    """Return the waiver of a requirement, or the command that repeats a result other than met."""
    if r.waived:
        return f"waived by {r.waived}"
    return f"again: {r.again}" if r.again and r.judgement != ACCEPTED else ""


def suite_of_campaign(data: DataSet, verdicts: Iterable[Judged], headline: str, wall_s: float) -> TestSuite:
    """Return the test suite of a campaign."""
    words: dict[str, Literal["met", "missed"]] = {MET: "met", NOT_MET: "missed"}
    cases = []
    for v in verdicts:
        shown = v.shown
        said = f"missed in {shown.failures} of {shown.runs} runs"
        if v.metric and v.worst:
            value, limit, unit = v.worst_text
            said = f"worst {value} {unit} in run {v.worst[0].run}, limit {limit} {unit}; {said}"
        said += f"; {shown.more} more runs needed" if shown.more else ""
        more = "" if v.first_missed is None else f"again: simrun refly {data.folder} --run {v.first_missed}"
        cases.append(TestCase("campaign", v.name, words.get(shown.judgement, "undecided"), said, more))
    return TestSuite(data.campaign.name, cases, wall_s, {"headline": headline, "folder": str(data.folder)})


def write_junit(path: Path, suites: Iterable[TestSuite]) -> Path:
    """Write verdicts as JUnit XML and return the path. Raises FileError."""
    root = ElementTree.Element("testsuites", name="maxq")
    total: Counter[str] = Counter()
    for suite in suites:
        counts: Counter[str] = Counter(case.outcome for case in suite.cases)
        total += counts
        node = ElementTree.SubElement(root, "testsuite", {"name": _text(suite.name), **_counts(counts)})
        node.set("skipped", "0")
        node.set("time", f"{suite.wall_s:.3f}")
        properties = ElementTree.SubElement(node, "properties")
        for name, value in suite.properties.items():
            ElementTree.SubElement(properties, "property", name=name, value=_text(value))
        for case in suite.cases:
            item = ElementTree.SubElement(node, "testcase", classname=_text(case.group), name=_text(case.name))
            if case.outcome == "met":
                if case.more:
                    ElementTree.SubElement(item, "system-out").text = _text(case.more)
                continue
            tag = "failure" if case.outcome == "missed" else "error"
            told = ElementTree.SubElement(item, tag, type=case.outcome, message=_text(case.said))
            told.text = _text(case.more) or None
    for key, value in _counts(total).items():
        root.set(key, value)
    ElementTree.indent(root)
    with whole_file(path) as part:
        ElementTree.ElementTree(root).write(part, "utf-8", xml_declaration=True)
    return path


def _counts(counts: Counter[str]) -> dict[str, str]:
    return {"tests": str(counts.total()), "failures": str(counts["missed"]), "errors": str(counts["undecided"])}


def _text(text: str) -> str:
    """Return a text without the characters that XML excludes."""
    return _NOT_XML.sub("\ufffd", text)
