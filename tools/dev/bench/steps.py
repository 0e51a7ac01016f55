"""The benchmark of error against step: RK4 at fixed steps, and steps selected by run.accuracy, for several vehicles.

Converter, DAC and roll thrusters, whose outputs are steps, are ideal as in precision.py. The reference is RK4 at 0.1
ms. The error of a metric is relative to its requirement or, without a requirement, to the metric itself.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.packing.integration import step_ns
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.bench.precision import EVERY_NS, QUANTITIES, differences

REFERENCE_S = 1e-4
METHODS = (
    "step_s=0.001", "step_s=0.0035", "step_s=0.005",
    "accuracy=0.0001", "accuracy=0.001", "accuracy=0.01", "accuracy=0.05", "accuracy=0.1",
)  # fmt: skip  # a table
IDEAL = ("switches.converter=ideal", "switches.roll_control=false", "vehicle.computer.dac_step_deg=0.0")
ACTUATOR = "vehicle.stage.0.actuator"
CASES = {
    "KSR-III": ("nominal", ("run.duration_s=59",)),
    "KSR-III, actuator of 100 Hz": (
        "nominal", ("run.duration_s=59", f"{ACTUATOR}.omega_hz.2=100.0"),
    ),
    "KSR-III on its TVC load": ("tvc-load", ("run.duration_s=59",)),
    "petrel, both stages": ("petrel", ("run.duration_s=160",)),
}  # fmt: skip  # a table
GUST = (
    'wind.gust=[{kind="one-minus-cosine", altitude_m=8000.0, thickness_m=1500.0, edge_m=500.0,'
    " speed_mps=15.0, from_deg=310.0}]"
)


@dataclass
class StepStudyFlight:
    """The states of a flight every `EVERY_NS` with the sizes of their stage, and the cost of the flight."""

    states: dict[int, tuple[Array, Any]]
    flight: Flight
    cpu_s: float
    longest_ms: tuple[float, ...]  # longest step of each stage


def _fly(scenario: str, overrides: tuple[str, ...], method: str) -> StepStudyFlight:
    run = FlightRun(load_scenario(scenario, [*IDEAL, GUST, *overrides, f"run.{method}"]), log=False)
    states, cpu_s = {}, 0.0
    while not run.finished:
        start = time.process_time()
        run.fly_segment(EVERY_NS)
        cpu_s += time.process_time() - start
        sizes = run.packed.parameters[int(run.memory.clock.stage)].vehicle.sizes
        states[int(run.memory.clock.now_ns)] = run.packed.state.copy(), sizes
    of = run.loaded.scenario
    return StepStudyFlight(states, run.result(), cpu_s, tuple(step_ns(of, stage) / 1e6 for stage in of.vehicle.stage))


def _row(flown: StepStudyFlight, exact: StepStudyFlight) -> dict[str, Any]:
    both = sorted(set(flown.states) & set(exact.states))
    errors = [differences(flown.states[t][0], exact.states[t][0], exact.states[t][1]) for t in both]
    metric, share = max(_shares(flown.flight, exact.flight), key=lambda item: item[1])
    return {
        "longest_ms": [round(ms, 3) for ms in flown.longest_ms],
        "steps_per_s": round(flown.flight.steps / flown.flight.end_s),
        "cpu_s": round(flown.cpu_s, 4),
        **{name: max(e[name] for e in errors) for name in QUANTITIES},
        "worst_metric": metric,
        "share": share,
    }


def _shares(flight: Flight, exact: Flight) -> Iterator[tuple[str, float]]:
    """Yield the name and error of each metric, as a share of its requirement or of its value."""
    limits = {r.metric: abs(r.limit or r.minimum or 0.0) for r in exact.scenario.scenario.requirement}
    for name, value in exact.metrics.items():
        scale = limits.get(name) or abs(value)
        if np.isfinite(value) and scale > 1e-9 and not name.startswith("step_error"):
            yield name, abs(flight.metrics[name] - value) / scale


def measure() -> dict[str, Any]:
    """Return the errors and costs by flight and method."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "petrel"
        simvehicle = [sys.executable, "-m", "maxq.tools.simvehicle", "petrel", "--out", str(made)]
        subprocess.run(simvehicle, check=True, stdout=subprocess.DEVNULL)
        for name, (scenario, overrides) in CASES.items():
            path = str(made / "scenario.toml") if scenario == "petrel" else scenario
            exact = _fly(path, overrides, f"step_s={REFERENCE_S}")
            found[name] = {method: _row(_fly(path, overrides, method), exact) for method in METHODS}
    return found


if __name__ == "__main__":
    print(json.dumps(measure()), file=sys.stdout)
