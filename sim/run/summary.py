"""summary.json: what a flight came to, for people and scripts."""

from __future__ import annotations

import json
import math
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from maxq.sim.files import write_whole
from maxq.sim.log.head import LogError
from maxq.sim.run.fly import Flight
from maxq.sim.run.history import Event
from maxq.sim.run.judgement import Verdict, unit_of

SUMMARY_SCHEMA = 2  # 2: channel names of log schema 2 under `final`
_PACKAGES = ("maxq", "numpy", "numba")


def summary_of(flight: Flight, log: str | None, timing: dict[str, float]) -> dict[str, Any]:
    """All of a flight but its channels over time. A number that does not exist is None."""
    scenario = flight.scenario.scenario
    return {
        "schema": SUMMARY_SCHEMA,
        "scenario": scenario.name,
        "description": scenario.description,
        "outcome": flight.outcome,
        "cause": flight.cause,
        "passed": flight.passed,
        "failures": list(flight.failures),
        "end_s": flight.end_s,
        "events": [_event(event) for event in flight.events],
        "metrics": {
            name: {
                "value": _number(value),
                "unit": unit_of(name),
                "time_s": _number(flight.metric_times_s[name]),
            }
            for name, value in flight.metrics.items()
        },
        "requirements": [_requirement(verdict) for verdict in flight.verdicts],
        "final": {name: _number(value) for name, value in flight.final.items()},
        "state_hash": flight.state_hash,
        "steps": flight.steps,
        "seed": scenario.run.seed,
        "log": log,
        "timing": {"flight_s": flight.wall_s} | timing,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Of what the bits of a flight depend on."""
    return {"python": platform.python_version()} | {name: version(name) for name in _PACKAGES}


def write_summary(path: Path, flight: Flight, log: str | None, timing: dict[str, float]) -> None:
    """Write the summary whole or not at all. Raises LogError where it cannot be written."""
    text = json.dumps(summary_of(flight, log, timing), indent=2, ensure_ascii=False, allow_nan=False)
    write_whole(path, text + "\n", LogError)


def _event(event: Event) -> dict[str, Any]:
    return {"name": event.name, "time_s": event.time_s} | ({"stage": event.stage} if event.stage else {})


def _requirement(verdict: Verdict) -> dict[str, Any]:
    kind, bound = verdict.bound
    metric = verdict.requirement.metric
    return {
        "name": verdict.name,
        "metric": metric,
        kind: bound,
        "value": _number(verdict.value),
        "unit": unit_of(metric),
        "time_s": _number(verdict.time_s),
        "met": verdict.met,
    }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
