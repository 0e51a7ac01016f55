"""`simverify` does not compute results again after a kill, after Ctrl-C, or for a changed design.

| case | expected |
|---|---|
| killed with SIGKILL, or interrupted, part-way | the same command recalls every part and gives the same result |
| one changed gain | certificate and margins again at its operating point alone; flights and ascents again |
| the same design under another name | everything recalled |
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from maxq import Verification
from maxq.design.verify.suite import read_suite
from maxq.design.verify.verify import verify
from maxq.sim.input.files import builtin_files

SUITE = """
schema = 2
[margins]
times_s = [25.0, 30.0, 35.0]
cases = 4
corner_sigmas = 0.0
success = 0.5
[certificate]
times_s = [30.0, 35.0]
planes = ["pitch"]
in_flight = false
[[flight]]
name = "six seconds"
set = ["run.duration_s=6.0"]
[[flight]]
name = "seven seconds"
set = ["run.duration_s=7.0"]
"""
CAMPAIGN = """
[[campaign]]
file = "campaigns/ksr3"
runs = 8
set = ["run.duration_s=6.0", "campaign.keep=[]"]
"""
PARTS = 2 + 1 + 3 + 1 + 2 + 1  # flights; instants; margins; slosh; certificate; intervals that are not covered


@pytest.fixture(scope="module")
def in_one_go(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the result of one uninterrupted run and, after a signal when all was stored, of a second run."""
    return _killed(tmp_path_factory.mktemp("whole"), f"{PARTS}:SIGCONT")


def _killed(folder: Path, *kills: str) -> dict[str, Any]:
    suite = folder / "suite.toml"
    suite.write_text(SUITE + CAMPAIGN)
    script = Path(__file__).with_name("killing_verify.py")
    run = subprocess.run(
        [sys.executable, str(script), str(suite), str(folder), *kills],
        capture_output=True,
        text=True,
        timeout=600,
        check=True,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    told: dict[str, Any] = json.loads(run.stdout)
    return told


@pytest.mark.long
def test_second_time_everything_is_recalled(in_one_go: dict[str, Any]) -> None:
    assert in_one_go["killed"] == [{"code": 3, "parts": PARTS, "runs": 8}]  # 3: too few flights to be sure
    assert in_one_go["code"] == 3
    assert (in_one_go["recalled"], in_one_go["worked_out"], in_one_go["written_again"]) == (PARTS, 0, 0)


@pytest.mark.long
def test_an_interrupted_verification_goes_on(tmp_path: Path, in_one_go: dict[str, Any]) -> None:
    """A verification that is killed early, interrupted and killed late completes in the same folder."""
    told = _killed(tmp_path, "2:SIGKILL", "4:SIGINT", "8:SIGKILL")
    assert [killed["code"] for killed in told["killed"]] == [-9, 130, -9]
    for parts, killed in zip((2, 4, 8), told["killed"], strict=True):
        assert parts <= killed["parts"] < PARTS or killed["runs"] < 8
    at_last = told["killed"][-1]["parts"]
    assert (told["recalled"], told["worked_out"]) == (at_last, PARTS - at_last)
    assert told["written_again"] == 0  # nothing that was whole is done again
    wanted = [{**r, "again": ""} for r in in_one_go["requirements"]]  # the folder of the runs differs
    assert [{**r, "again": ""} for r in told["requirements"]] == wanted


def _verified(design: Path, suite, memory: Path) -> Verification:
    return verify(str(design), suite, memory=memory)


@pytest.mark.long
def test_one_changed_gain_redoes_what_depends_on_it(tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(SUITE)
    suite, memory = read_suite(tmp_path / "suite.toml"), tmp_path / "memory"
    text = builtin_files("design")["ksr3-free"].read_text()  # a gain at every node
    line = next(line for line in text.splitlines() if "time_s = 30.0" in line)
    k_p = float(line.partition("k_p = ")[2].partition(",")[0])
    changed = text.replace(line, line.replace(repr(k_p), repr(1.01 * k_p)))
    assert changed != text
    for name, content in (("first", text), ("other", text), ("changed", changed)):
        (tmp_path / f"{name}.toml").write_text(content)
    first = _verified(tmp_path / "first.toml", suite, memory)
    parts = PARTS + 1  # of this design slosh is flown, too
    assert (first.recalled, first.worked_out) == (0, parts)
    other = _verified(tmp_path / "other.toml", suite, memory)
    changed_ = _verified(tmp_path / "changed.toml", suite, memory)
    assert other.worked_out <= 2  # the flights' commands name the file
    anew = 2 + 1 + 1 + 2 + 1  # flights, instants, margins at 30 s, slosh and its flight, certificate at 30 s
    assert (changed_.recalled, changed_.worked_out) == (parts - anew, anew)
    before, after = first.results.certificates, changed_.results.certificates
    assert [c.time_s for c in after] == [30.0, 35.0]
    assert before[0].margins != after[0].margins
    assert before[1].margins == after[1].margins
