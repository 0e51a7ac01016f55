"""Plant every fault, run the certificate, and write the table of docs/verification.md:
`python -m maxq.tools.dev.verification.planted`.

The exit code is 1 if a fault is missed, or if a loop without a fault disagrees.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from maxq.design import operating_points
from maxq.design.certificate.certificate import NodeCertificate, certify_node
from maxq.design.certificate.response import INCOHERENT, WITHIN_DB, WITHIN_DEG
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.verification.planted_faults import FAULTS, PlantedFault
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

TIME_S = 40.0
FEW_LINES = 10
"""The table lists a fault that is missed, or that at most this number of lines reveals."""


def margin_text(what: str, difference: float, unit: str) -> str:
    """Return the change of a margin with its name and unit; milliseconds for a delay."""
    if unit == "s":
        difference, unit = 1e3 * difference, "ms"
    name = {"gain_up": "upper gain", "gain_down": "lower gain"}.get(what, what)
    return f"{name} {difference:+.3g} {unit}"


def row(fault: PlantedFault, found: NodeCertificate) -> str:
    """Return the row of the table for a fault."""
    r = found.responses
    off = [margin_text(e.what, e.difference, e.unit) for e in found.margins if not e.agrees]
    clean = np.isfinite(r.unrounded_db)
    db, deg = np.where(clean, r.unrounded_db, r.difference_db), np.where(clean, r.unrounded_deg, r.difference_deg)
    share = np.nan_to_num(np.maximum(np.abs(db) / WITHIN_DB, np.abs(deg) / WITHIN_DEG), nan=np.inf)
    k = int(np.argmax(np.where(np.array(r.reason) == INCOHERENT, 0.0, share))) if len(share) else 0
    worst = f"{db[k]:+.2f}, {deg[k]:+.1f}, {r.lines_hz[k]:.3g}" if r.faulty else "-"
    name = fault.name if found.unexplained else f"**MISSED:** {fault.name}"
    return f"| {name} | {len(r.faulty)} | {worst} | {', '.join(off) or '-'} |"


def main() -> int:
    """Rewrite the table. Return 1 if a fault was missed, or if a loop without a fault disagrees."""
    loaded = load_scenario("nominal")
    node = operating_points.nodes(loaded, [TIME_S])[0]
    sound = certify_node(loaded, node, fault=lambda packed: None)
    with ThreadPoolExecutor(max_workers=2) as pool:
        found = list(pool.map(lambda fault: certify_node(loaded, node, fault=fault.plant), FAULTS))
    missed = [fault.name for fault, f in zip(FAULTS, found, strict=True) if not f.unexplained]
    table = [
        f"| fault | lines off, of {len(sound.responses.lines_hz)} | worst line: dB, deg, Hz | margins off |",
        "|---|---|---|---|",
        *(
            row(fault, f)
            for fault, f in zip(FAULTS, found, strict=True)
            if not f.unexplained or len(f.responses.faulty) <= FEW_LINES
        ),
        f"| {'none' if sound.agrees else '**FALSE ALARM:** none'} | {len(sound.responses.faulty)} | - | - |",
    ]
    rewrite(VERIFICATION, "faults", "\n".join(table))
    print("\n".join(table))
    return int(bool(missed) or not sound.agrees)


if __name__ == "__main__":
    sys.exit(main())
