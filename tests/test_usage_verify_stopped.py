"""`simverify` ends soon after a signal, even if a worker's call takes minutes.

| claim | expected |
|---|---|
| SIGINT or SIGTERM while every worker searches without end | exit code 130, one line that says how to resume |
| results stored before the signal | all of them, unchanged, and recalled by the same command |
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SUITE = """
schema = 2
[margins]
times_s = [40.0]
planes = ["pitch"]
cases = 0
corner_sigmas = 0.0
[margins.worst]
starts = 1
"""
SEARCH_S = 3600.0
WITHIN_S = 300.0  # a bound for a busy machine, far below the duration of the search
STUCK = f"""
import sys, time
from pathlib import Path
from maxq.design.verify import memory, worst
from maxq.tools.simverify import command

def search(*arguments):
    Path("searching").touch()
    time.sleep({SEARCH_S})

memory.default_folder = lambda: Path("memory")
worst.search_node = search
sys.argv = ["simverify", "ksr3-robust", "--suite", "suite.toml", "--no-pack"]
command()
"""


def stored(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {f.name: (f.stat().st_mtime_ns, f.read_bytes()) for f in (folder / "memory").glob("*.json")}


@pytest.mark.long
def test_a_signal_ends_a_search_that_does_not_return(tmp_path: Path) -> None:
    (tmp_path / "suite.toml").write_text(SUITE)
    before: dict[str, tuple[int, bytes]] = {}
    for number in (signal.SIGTERM, signal.SIGINT):
        (tmp_path / "searching").unlink(missing_ok=True)
        with subprocess.Popen(
            [sys.executable, "-c", STUCK], cwd=tmp_path, env=os.environ, stderr=subprocess.PIPE, text=True
        ) as child:
            until = time.monotonic() + WITHIN_S
            while not (tmp_path / "searching").exists():
                assert child.poll() is None, child.communicate()[1]
                assert time.monotonic() < until, "no search begins"
                time.sleep(0.05)
            now = stored(tmp_path)
            child.send_signal(number)
            try:
                said = child.communicate(timeout=WITHIN_S)[1]
            finally:
                child.kill()
        assert child.returncode == 130
        assert said.splitlines()[-1] == (
            "simverify: interrupted; finished results are kept, and the same command resumes"
        )
        assert stored(tmp_path) == now
        assert len(now) > 0
        assert before in ({}, now)  # the second command recalls what the first one stored
        before = now
