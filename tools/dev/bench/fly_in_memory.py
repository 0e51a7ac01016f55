"""The nominal flight with its full log in arrays. `latency` measures the peak memory of its process."""

from __future__ import annotations

from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

if __name__ == "__main__":
    fly(load_scenario("nominal"))
