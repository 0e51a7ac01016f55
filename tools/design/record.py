"""What is judged of a design as JSON: margins, lobes, limits; NaN and infinity as null and text."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from maxq.design.margins.measure import Bound
from maxq.design.optimise.solution import Solution
from maxq.design.verify.judging import Check, Judged
from maxq.design.verify.outcome import Outcome
from maxq.sim.files import write_whole

SCHEMA = 1


def node_record(judged: Judged) -> dict[str, Any]:
    """One node."""
    m = judged.margins
    rigid = {body: dict(zip(("hz", "zeta"), judged.rigid(body), strict=True)) for body in ("paper", "aerodynamic")}
    disk = asdict(m.disks)
    return {
        "time_s": judged.time_s,
        **judged.loop.law.gains,
        "stable": m.stable,
        "unstable_poles": m.unstable_poles,
        "growth_1ps": m.growth_1ps,
        "growth_hz": m.growth_hz,
        "gain_up": _bound(m.gain_up_db, "db"),
        "gain_down": _bound(m.gain_down_db, "db"),
        "phase": _bound(m.phase_deg, "deg"),
        "delay": _bound(m.delay_s, "s"),
        "aero_gain": _bound(m.aero_gain_db, "db"),
        "rigid_gain": _bound(m.rigid_gain_db, "db"),
        "rigid_phase": _bound(m.rigid_phase_deg, "deg"),
        "crossover_hz": m.crossover_hz,
        "modulus": m.modulus,
        "disks": disk,
        "zones": [
            {
                "shape": c.zone.shape,
                "gain_db": c.zone.gain_db,
                "phase_deg": c.zone.phase_deg,
                "clearance": c.value,
                "at_hz": c.frequency_hz,
            }
            for c in m.clearances
        ],
        "lobes": [asdict(lobe) for lobe in judged.lobes],
        "rigid_body": rigid,
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
        "scenario": order.scenario,
        "axis": order.axis,
        "kind": order.kind,
        "errata": order.errata,
        "plant": order.plant,
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
        "gains": {"time_s": solution.nodes_s.tolist(), "k_p": solution.k_p.tolist(), "k_d_s": solution.k_d_s.tolist()},
        "filter": asdict(solution.filter) | {"prewarp_hz": solution.prewarp_hz},
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


def _bound(bound: Bound, unit: str) -> dict[str, float]:
    return {unit: bound.value, "at_hz": bound.frequency_hz}
