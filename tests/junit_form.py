"""The form of JUnit XML that Jenkins accepts, as a strict check: elements, their order, and attributes.

Source: junit-10.xsd of Jenkins' plugin xUnit, for the elements that a report of verdicts needs.
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

FORM = {  # element: required attributes, further attributes, children, text allowed
    "testsuites": ((), ("name", "time", "tests", "failures", "errors"), ("testsuite",), False),
    "testsuite": (
        ("name", "tests", "failures", "errors"),
        ("time", "skipped", "timestamp", "hostname", "id", "package", "group", "file", "log", "url"),
        ("testsuite", "properties", "testcase", "system-out", "system-err"),
        False,
    ),
    "properties": ((), (), ("property",), False),
    "property": (("name", "value"), (), (), False),
    "testcase": (
        ("name",),
        ("time", "classname", "group"),
        ("skipped", "error", "failure", "system-out", "system-err"),
        False,
    ),
    "failure": ((), ("type", "message"), (), True),
    "error": ((), ("type", "message"), (), True),
    "skipped": ((), ("type", "message"), (), True),
    "system-out": ((), (), (), True),
    "system-err": ((), (), (), True),
}


def is_junit(path: Path) -> ElementTree.Element:
    """Return the root of a JUnit file after its form and its numbers of cases have been asserted."""
    root = ElementTree.parse(path).getroot()
    assert root.tag == "testsuites"
    for node in root.iter():
        required, further, children, text = FORM[node.tag]
        assert set(required) <= set(node.attrib) <= {*required, *further}
        assert {child.tag for child in node} <= set(children)
        assert text or not (node.text or "").strip()
        assert not (node.tail or "").strip()
        if "time" in node.attrib:
            assert re.fullmatch(r"\d+\.\d*", node.attrib["time"])
    for node in (root, *root.findall("testsuite")):
        cases = list(node.iter("testcase"))
        assert int(node.attrib["tests"]) == len(cases) > 0
        assert int(node.attrib["failures"]) == sum(case.find("failure") is not None for case in cases)
        assert int(node.attrib["errors"]) == sum(case.find("error") is not None for case in cases)
    return root
