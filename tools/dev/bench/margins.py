"""The benchmark of the margins: of one loop, of a sweep of dispersed vehicles, and of `simdesign analyse`.

    python -m maxq.tools.dev.bench.margins

The module prints CPU times as JSON. The sweep measures the random vehicles of the suite `standard` at one operating
point of the scenario nominal, including those that are measured individually near a limit.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from maxq.design.loop.loop import loops
from maxq.design.margins.measure import margins
from maxq.design.model.deviations import deviations_of
from maxq.design.operating_points import nodes
from maxq.design.quantities import SWEPT
from maxq.design.verify.linear import SweptVehicles
from maxq.design.verify.suite import read_suite
from maxq.sim.campaign.read import load_campaign
from maxq.sim.scenario.loader import load_scenario

TIME_S, VEHICLES, LOOPS = 40.0, 10_000, 300


def _cpu_s(work: Callable[[], Any]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


def measure() -> dict[str, float]:
    """Return CPU times: ms of a loop, s of the sweep and its exact measurements, s of the command."""
    nominal, wanted = load_scenario("nominal"), read_suite("standard").suite.margins
    assert nominal.design is not None
    assert wanted is not None
    (node,) = nodes(nominal, [TIME_S])
    (loop,) = loops([node], nominal.design)
    drawn = deviations_of(load_campaign("campaigns/ksr3"), node).drawn(range(VEHICLES))
    swept, table, rows = SweptVehicles(node, nominal.design, wanted.dispersed), np.empty((VEHICLES, len(SWEPT))), []
    swept.measure(node, drawn[:10], table, np.arange(10))  # loads the compiled code
    margins(loop)
    sweep_s = _cpu_s(lambda: rows.append(swept.measure(node, drawn, table, np.arange(VEHICLES))))
    loop_s = statistics.median(_cpu_s(lambda: margins(loop)) for _ in range(LOOPS))
    return {"loop_ms": 1e3 * loop_s, "sweep_s": sweep_s, "exact": rows[0], "analyse_s": _analyse_s()}


def _analyse_s() -> float:
    command = str(Path(sys.executable).with_name("simdesign"))
    taken = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(6):
            before = getrusage(RUSAGE_CHILDREN)
            words = [command, "analyse", "ksr3-default", "--no-pictures"]
            subprocess.run(words, cwd=folder, check=True, stdout=subprocess.DEVNULL)
            after = getrusage(RUSAGE_CHILDREN)
            taken.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return statistics.median(taken[1:])


if __name__ == "__main__":
    with threadpool_limits(limits=1, user_api="blas"):
        print(json.dumps(measure()))
