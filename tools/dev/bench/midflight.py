"""A flight stopped half-way, where everything is at work: what the microbenchmarks and the count start
from.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario, load_scenario

STOPPED_NS = 30_000_000_000  # near the largest dynamic pressure, all tanks and modes alive


def scenario() -> LoadedScenario:
    return load_scenario("nominal", ["run.duration_s=59.0"])


def stopped_flight() -> FlightRun:
    """The nominal flight at `STOPPED_NS`, ready to fly on."""
    run = FlightRun(scenario(), log=False)
    run.fly_segment(STOPPED_NS)
    return run


def save(path: Path) -> None:
    """State and memory of the stopped flight, for a process that cannot fly there itself."""
    run = stopped_flight()
    np.savez(path, state=run.packed.state, memory=np.frombuffer(run.packed.memory.tobytes(), np.uint8))


def restore(path: Path) -> FlightRun:
    """A run that stands where the saved one stopped."""
    run = FlightRun(scenario(), log=False)
    with np.load(path) as saved:
        run.packed.state[:] = saved["state"]
        run.packed.memory.view(np.uint8)[:] = saved["memory"]
    return run


if __name__ == "__main__":
    save(Path(sys.argv[1]))
