"""Without rerun-sdk, as on cluster workers and in containers, only `simreplay` and `--view` are unavailable."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]
OLD_LOG = ROOT / "tests" / "data" / "logs" / "schema-1" / "flight.mcap"
NEEDED = [*map(Requirement, tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"])]
VIEWER = next(requirement for requirement in NEEDED if requirement.name == "rerun-sdk")
# What comes with rerun-sdk and with nothing else that maxq needs.
ABSENT = ("rerun", "rerun_bindings", "rerun_cli", "rerun_sdk", "attr", "attrs", "psutil")
HIDE = f"import sys; sys.modules.update(dict.fromkeys({ABSENT!r}))\n"

EVERY_MODULE = """
from importlib import import_module
from pathlib import Path
from maxq.control.kernel import jit
root = Path(jit.__file__).parents[2]
import maxq
for layer in ("control", "sim", "design", "tools"):
    for path in (root / layer).rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        if not {".ns", "dev"} & set(parts) and parts[:2] != ("tools", "replay"):
            import_module(".".join(("maxq", *parts)))
            print(".".join(parts))
"""

EVERY_USE = """
import maxq
from maxq.tools import simdesign, simreplay, simrun, simverify

def check(code, command, *arguments):
    found = command.main(list(arguments))
    assert found == code, (arguments, found)

check(0, simrun, "nominal", "--set", "run.duration_s=0.5", "--out", "flight")
log = maxq.read("flight")
assert log["altitude_m"].size == 51 and log.time_s("altitude_m")[-1] == 0.5
maxq.plot(log, "mach").savefig("mach.svg")
for option in ("--summary", "--plots=plots"):
    check(0, simreplay, "flight", option)
data = maxq.campaign(maxq.load("campaigns/first", "run.duration_s=0.1"), "campaign", runs=4, workers=2)
assert repr(data) == "<DataSet campaign: 4 runs of first, 0 failed>"
check(3, simrun, "--from", "campaign")  # reported; undecided after four runs
made = maxq.optimise("ksr3-relaxed", "search.starts=2", "nodes_s=[10, 40]", "filter.structure=F2")
made.save("mine.toml")
assert made.bode(40.0).axes
check(0, simdesign, "analyse", "mine.toml", "--at", "40", "--out", "analysis")
flight = "flight=[{name='half a second', set=['run.duration_s=0.5']}]"
short = [word for part in ("certificate=", "margins=", flight) for word in ("--set", part)]
check(0, simverify, "mine.toml", "--suite", "quick", *short, "--out", "verdict")
"""


def without_viewer(code: str, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python code in `folder` as if rerun-sdk and its exclusive dependencies were not installed."""
    return subprocess.run(
        [sys.executable, "-c", HIDE + code, *words],
        cwd=folder,
        env=os.environ,  # without COLUMNS, which readline sets below Python
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_only_the_replay_imports_the_viewer(tmp_path: Path) -> None:
    done = without_viewer(EVERY_MODULE, tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 250


@pytest.mark.long
def test_all_else_works_without_the_viewer(tmp_path: Path) -> None:
    done = without_viewer(EVERY_USE, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "flight" / "flight.mcap").is_file()
    assert list((tmp_path / "plots").glob("*.svg"))
    assert (tmp_path / "campaign" / "report.html").is_file()


NEED_THE_VIEWER = [
    ("simreplay", "OLD --web", "simreplay: "),
    ("simreplay", "OLD --save replay.rrd", "simreplay: "),
    ("simreplay", "OLD --screenshot replay.png --at 1", "simreplay: "),
    ("simrun", "nominal --view", "simrun: --view: "),
    ("simrun", "nominal --view --view-port 9876", "simrun: --view: "),
]
EVERY_NEED = """
import contextlib, importlib, io, json

for command, *arguments in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = importlib.import_module(f"maxq.tools.{command}").main(arguments)
    print(json.dumps([code, out.getvalue(), err.getvalue()]))
"""


@pytest.mark.slow
def test_a_command_that_needs_the_viewer_says_how_to_install_it(tmp_path: Path) -> None:
    words = [[command, *arguments.replace("OLD", str(OLD_LOG)).split()] for command, arguments, _ in NEED_THE_VIEWER]
    done = without_viewer(EVERY_NEED, tmp_path, json.dumps(words))
    assert (done.returncode, done.stderr) == (0, "")
    found = [json.loads(line) for line in done.stdout.splitlines()]
    for (code, out, err), (_, arguments, says) in zip(found, NEED_THE_VIEWER, strict=True):
        assert (code, out) == (2, ""), arguments
        said = re.fullmatch(rf"{says}the Rerun viewer is not installed; install it with: pip install '(.+)'\n", err)
        assert said, err
        assert Requirement(said[1]) == VIEWER
    assert list(tmp_path.iterdir()) == []


def test_the_slim_requirements_are_those_of_the_package_without_the_viewer() -> None:
    lines = (ROOT / "requirements-slim.txt").read_text().splitlines()
    slim = [Requirement(line) for line in lines if line and not line.startswith("#")]
    assert slim == [requirement for requirement in NEEDED if requirement != VIEWER]
