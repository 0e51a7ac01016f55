"""Verify a design in children that are killed one after the other, then in one that completes.

    python killing_verify.py SUITE DIR PARTS:SIGNAL ...

Each child receives its signal when this number of parts is stored. The parent loads everything before it forks. The
output is JSON: the exit code of each killed child with the numbers of parts and campaign runs then stored. For the last
child it gives the exit code, the requirements, the numbers of recalled and computed parts, and the number of stored
parts that were written again.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path

import pyarrow.dataset as ds

from maxq import FlightRun
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simverify

memory = Path(sys.argv[2]) / "memory"


def verify(suite: str, out: Path) -> int:
    from maxq.design.verify import memory as module  # noqa: PLC0415  # after the fork: the child's own

    module.default_folder = lambda: memory
    sys.stdout = open(os.devnull, "w")  # noqa: SIM115  # the process ends with it
    return simverify.main(["ksr3-robust", "--suite", suite, "--no-pack", "--out", str(out)])


def runs_kept() -> int:
    return sum(ds.dataset(f).count_rows() for f in memory.glob("campaign-*/runs") if any(f.iterdir()))


def stored() -> dict[str, int]:
    """Return the time at which each stored part was written."""
    return {file.name: file.stat().st_mtime_ns for file in memory.glob("*.json")}


def kill(suite: str, folder: Path, parts: int, number: int) -> dict[str, int]:
    child = os.fork()
    if child == 0:
        os._exit(verify(suite, folder / "killed"))
    until = time.monotonic() + 240.0
    while len(stored()) < parts:
        if time.monotonic() > until or os.waitpid(child, os.WNOHANG)[0]:
            sys.exit(f"there are never {parts} parts")
        time.sleep(0.005)
    os.kill(child, number)
    _, status = os.waitpid(child, 0)
    return {"code": os.waitstatus_to_exitcode(status), "parts": len(stored()), "runs": runs_kept()}


def main(suite: str, folder: Path, kills: list[str]) -> None:
    FlightRun(load_scenario("nominal"), log=False).result()
    killed, before = [], {}
    for word in kills:
        parts, _, name = word.partition(":")
        killed.append(kill(suite, folder, int(parts), signal.Signals[name].value))
        before = stored() | before
    last = os.fork()
    if last == 0:
        os._exit(verify(suite, folder / "last"))
    _, status = os.waitpid(last, 0)
    verdict = json.loads((folder / "last" / "verdict.json").read_text())
    now = stored()
    told = verdict["parts"] | {
        "killed": killed,
        "code": os.waitstatus_to_exitcode(status),
        "requirements": verdict["requirements"],
        "written_again": sum(now[name] != time_ns for name, time_ns in before.items()),
    }
    print(json.dumps(told))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])
