"""What is judged of a design as JSON: margins, lobes, limits; NaN and infinity as null and text."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

from maxq.design.optimise.solution import Solution
from maxq.design.verify.judging import Check, Judged, RigidBody
from maxq.design.verify.outcome import Outcome
from maxq.sim.files import write_whole

SCHEMA = 1
_BOUNDS = {"gain_up": "db", "gain_down": "db", "phase": "deg", "delay": "s", "aero_gain": "db", "rigid_gain": "db",
           "rigid_phase": "deg"}  # fmt: skip
_NUMBERS = ("stable", "unstable_poles", "growth_1ps", "growth_hz", "crossover_hz", "modulus")


def node_record(judged: Judged) -> dict[str, Any]:
    """One node."""
    m = judged.margins
    record: dict[str, Any] = {"time_s": judged.time_s, **judged.loop.law.gains}
    record |= {key: getattr(m, key) for key in _NUMBERS}
    for key, unit in _BOUNDS.items():
        bound = getattr(m, f"{key}_{unit}")
        record[key] = {unit: bound.value, "at_hz": bound.frequency_hz}
    return record | {
        "disks": asdict(m.disks),
        "zones": [asdict(c.zone) | {"clearance": c.value, "at_hz": c.frequency_hz} for c in m.clearances],
        "lobes": [asdict(lobe) for lobe in judged.lobes],
        "rigid_body": {
            body: dict(zip(("hz", "zeta"), judged.rigid(body), strict=True)) for body in get_args(RigidBody)
        },
        "budgets": {name: asdict(budget) for name, budget in judged.budgets.items()},
    }


def checks_record(checks: Sequence[Check]) -> list[dict[str, Any]]:
    """Limits beside what was reached."""
    return [
        {
            "key": check.key,
            "name": check.text,
            "unit": check.unit,
            "sense": check.sense,
            "limit": check.limit,
            "worst": float(check.values[check.worst]),
            "at_s": float(check.time_s[check.worst]),
            "met": check.passed,
            "values": check.values.tolist(),
        }
        for check in checks
    ]


def analysis_record(name: str, order: Any, judged: Sequence[Judged], checks: Sequence[Check]) -> dict[str, Any]:
    """Of `simdesign analyse`."""
    return {
        "schema": SCHEMA,
        "design": name,
        **{key: getattr(order, key) for key in ("scenario", "axis", "kind", "errata", "plant")},
        "passed": all(check.passed for check in checks),
        "limits": checks_record(checks),
        "nodes": [node_record(j) for j in judged],
    }


def case_record(outcome: Outcome, solution: Solution) -> dict[str, Any]:
    """Of `simdesign CASE`."""
    case, c = outcome.loaded.case, solution.certificate
    return {
        "schema": SCHEMA,
        "name": outcome.loaded.name,
        "status": solution.status,
        "feasible": outcome.feasible and solution.feasible,
        "missed": outcome.missed,
        "explanation": solution.explanation(),
        "objective_db": solution.objective_db,
        "nominal_objective_db": solution.nominal_objective_db,
        "case": case.model_dump(mode="json", by_alias=True),
        **solution.law.record(),
        "search": asdict(c),
        "constraints": [asdict(x) for x in solution.constraints],
        "bounds": [asdict(x) for x in solution.bounds],
        "limits": checks_record(outcome.found),
        "limits_as_flown": checks_record(outcome.flown_found),
        "limits_dispersed": checks_record(outcome.dispersed_found),
        "nodes": [node_record(j) for j in outcome.judged],
    }


def write_record(path: Path, record: dict[str, Any]) -> Path:
    """As JSON that any reader takes: NaN is null, infinity the text "inf". Raises FileError."""
    return write_whole(path, json.dumps(_plain(record), indent=1, allow_nan=False) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):  # NumPy's float64 is one, too
        return None if math.isnan(value) else float(value) if math.isfinite(value) else "inf" if value > 0 else "-inf"
    if hasattr(value, "item"):
        return _plain(value.item())
    return value
