"""Verify a design in a child that is killed after a number of stored parts, then in another that completes.

    python killing_verify.py SUITE DIR PARTS SIGNAL

The parent has loaded everything before it forks. Print, as JSON, the parts and campaign runs that existed at the
signal, the exit code of the killed child, and the numbers that the second child recalled, computed and found.
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


def main(suite: str, folder: Path, parts: int, number: int) -> None:
    FlightRun(load_scenario("nominal"), log=False).result()
    child = os.fork()
    if child == 0:
        os._exit(verify(suite, folder / "first"))
    until = time.monotonic() + 240.0
    while len(list(memory.glob("*.json"))) < parts:
        if time.monotonic() > until or os.waitpid(child, os.WNOHANG)[0]:
            sys.exit(f"there are never {parts} parts")
        time.sleep(0.005)
    os.kill(child, number)
    _, status = os.waitpid(child, 0)
    told = {"code": os.waitstatus_to_exitcode(status), "parts": len(list(memory.glob("*.json"))), "runs": runs_kept()}
    again = os.fork()
    if again == 0:
        os._exit(verify(suite, folder / "second"))
    _, status = os.waitpid(again, 0)
    verdict = json.loads((folder / "second" / "verdict.json").read_text())
    told |= verdict["parts"] | {"second": os.waitstatus_to_exitcode(status), "requirements": verdict["requirements"]}
    print(json.dumps(told))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), signal.Signals[sys.argv[4]].value)
