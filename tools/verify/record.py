"""verdict.json: what was asked of a design and what became of it, for scripts."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from maxq.design.certificate.certificate import NodeCertificate
from maxq.design.verify.verify import Verification
from maxq.tools.design.record import write_record

SCHEMA = 1
VERDICT_NAME = "verdict.json"


def verdict_record(found: Verification, command: str) -> dict[str, Any]:
    """All but histories."""
    return {
        "schema": SCHEMA,
        "design": found.design,
        "design_name": found.design_name,
        "vehicle": found.vehicle,
        "suite": found.suite.name,
        "verdict": found.judgement,
        "more_runs": found.more_runs,
        "command": command,
        "requirements": [
            {
                "part": r.part, "name": r.name, "wanted": r.wanted, "found": r.found, "verdict": r.judgement,
                "room": r.room, "where": r.where, "more_runs": r.more_runs, "again": r.again,
            }
            for r in found.requirements
        ],
        "flights": [
            {
                "name": f.name, "outcome": f.outcome, "passed": f.passed, "failures": list(f.failures),
                "metrics": f.metrics, "state_hash": f.state_hash, "again": f.again,
            }
            for f in found.flights
        ],
        "certificate": [_node(c) for c in found.certificates],
        "authority": [vars(a) for a in found.authority],
        "slosh": [vars(a) | {"in_band": a.in_band} for a in found.slosh],
        "campaigns": [{"name": c.name, "runs": c.runs, "folder": str(c.folder)} for c in found.campaigns],
        "hashes": {"design": found.design_hash, "scenario": found.vehicle_hash, "code": found.code},
        "versions": found.versions,
        "parts": {"recalled": found.recalled, "worked_out": found.worked_out},
        "wall_s": found.wall_s,
        "walls_s": found.walls_s,
        "cpus_s": found.cpus_s,
    }  # fmt: skip


def _node(c: NodeCertificate) -> dict[str, Any]:
    r = c.responses
    return {
        "time_s": c.time_s,
        "plane": c.plane,
        "agrees": c.agrees,
        "unexplained": list(c.unexplained),
        "margins": [vars(m) for m in c.margins],
        "lines": [
            {
                "hz": r.lines_hz[i], "sampled_db": _db(r.sampled[i]), "pade_db": _db(r.pade[i]),
                "difference_db": r.difference_db[i], "difference_deg": r.difference_deg[i],
                "unrounded_db": r.unrounded_db[i], "unrounded_deg": r.unrounded_deg[i],
                "coherence": r.coherence[i], "error": r.error[i], "nonlinear_db": r.nonlinear_db[i],
                "reason": r.reason[i],
            }
            for i in range(len(r.lines_hz))
        ],
    }  # fmt: skip


def _db(value: complex) -> float:
    return 20.0 * math.log10(max(abs(value), 1e-300))


def write_verdict(folder: Path, found: Verification, command: str) -> Path:
    """Write verdict.json. Raises FileError where it cannot be written."""
    return write_record(folder / VERDICT_NAME, verdict_record(found, command))
