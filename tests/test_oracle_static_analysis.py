"""The exported C law against an open static analyser: cppcheck with its addon for MISRA C:2012."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from maxq.sim.scenario.loader import load_scenario
from maxq.tools.design.export import export_c

CPPCHECK = shutil.which("cppcheck", path=os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"])))
SOURCES = ("flight_law.c", "flight_law_tables.c", "flight_law_fsw.c")
MISRA = "misra-c2012-"
DEVIATIONS = {
    ("flight_law.c", "12.1"): "advisory: a * b + c needs no parentheses",
    ("flight_law.c", "15.7"): "the demand for thrusters remains 0 in the missing else",
    ("flight_law_tables.h", "2.2"): "false: a macro is 0 in some designs, and the size of an array is this macro + 1",
    ("flight_law_fsw.c", "8.7"): "advisory: the simulator calls these functions",
    ("flight_law_fsw.c", "11.5"): "advisory: the instance is a pointer to void in the interface",
    ("maxq_fsw.h", "2.5"): "advisory: macros of the interface for other flight code",
}
"""The accepted deviations, by file and rule, with their reasons."""
OF_OPTIONS = {("flight_law.c", "17.7"): "false: a cast to a pointer to an array is no call"}
"""Those of laws whose filters change and fade out."""


@pytest.mark.slow
@pytest.mark.skipif(CPPCHECK is None, reason="cppcheck is not installed")
def test_the_exported_law_deviates_from_misra_only_as_listed(tmp_path: Path) -> None:
    """Check that there are no findings but the listed ones, and that the analyser finds a fault that is put in."""
    export_c(load_scenario("nominal", []), tmp_path)
    assert found(tmp_path) == set(DEVIATIONS)
    with (tmp_path / "flight_law.c").open("a") as file:
        file.write("static int fault(void) { int list[2] = {0, 1}; goto end; end: return list[2]; }\n")
    added = {rule for _, rule in found(tmp_path) - set(DEVIATIONS)}
    assert {"arrayIndexOutOfBounds", "15.1"} <= added


@pytest.mark.long
@pytest.mark.skipif(CPPCHECK is None, reason="cppcheck is not installed")
@pytest.mark.parametrize("law", [{"LOAD_RELIEF": 1}, {"LOAD_RELIEF": 2}, {"INTEGRAL": 1}, {"INTEGRAL": 1, "DRIFT": 1}])
def test_laws_with_all_their_options_deviate_only_as_listed(tmp_path: Path, law: dict[str, int]) -> None:
    """Switch on all parts that a law can have: filters of the loops, filters that change, adaptation, further gyros."""
    export_c(load_scenario("nominal", []), tmp_path)
    header = tmp_path / "flight_law_tables.h"
    text = header.read_text()
    switches = dict.fromkeys(("LOOP_FILTERS", "MOVING_FILTER", "ADAPTIVE", "TURN_THRUSTERS"), 1)
    for name, value in (switches | {"FURTHER_GYROS": 2, "GAINS": 5, "FILTER_PARAMETERS": 4} | law).items():
        text, count = re.subn(rf"(#define LAW_{name}) \d+", rf"\1 {value}", text)
        assert count == 1
    header.write_text(text)
    deviations = {pair for pair in found(tmp_path, "flight_law.c") if pair[0] == "flight_law.c"}
    assert deviations <= {*DEVIATIONS, *OF_OPTIONS}


def found(folder: Path, *sources: str) -> set[tuple[str, str]]:
    """Return all findings as pairs of the file's name and the rule of MISRA, or the name of another finding."""
    words = ["--enable=warning,style,performance,portability", "--addon=misra", f"--addon-python={sys.executable}"]
    words += ["--std=c99", "--quiet", "--template={severity}|{file}|{id}"]
    done = subprocess.run(
        [str(CPPCHECK), *words, *(sources or SOURCES)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
        timeout=500,
    )
    lines = (line.split("|") for line in done.stderr.splitlines() if line.count("|") == 2)
    return {(Path(file).name, rule.removeprefix(MISRA)) for kind, file, rule in lines if kind != "information"}
