"""Plants every fault, asks the certificate, and writes the table of docs/verification.md:
`python -m maxq.tools.dev.verification.planted`. Exit code 1 where one is missed.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

from maxq.design import api
from maxq.design.certificate.certificate import NodeCertificate, certify_node
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.verification.planted_faults import FAULTS, Fault
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

TIME_S = 40.0


def row(fault: Fault, found: NodeCertificate) -> str:
    """A row of the table."""
    r, k = found.responses, found.responses.worst
    off = [f"{e.what} {e.difference:+.3g} {e.unit}" for e in found.edges if not e.agrees]
    seen = f"{len(r.faulty)} of {len(r.lines_hz)}"
    clean = r.unrounded_db[k] == r.unrounded_db[k]  # not NaN
    db, deg = (r.unrounded_db, r.unrounded_deg) if clean else (r.difference_db, r.difference_deg)
    worst = f"{db[k]:+.2f} dB, {deg[k]:+.1f}° at {r.lines_hz[k]:.3g} Hz" if r.faulty else "-"
    verdict = "found" if found.unexplained else "MISSED"
    return f"| {fault.name} | {fault.where} | {verdict} | {seen} | {worst} | {', '.join(off) or '-'} |"


def main() -> int:
    """Rewrite the table; 1 if a fault was missed, or something found where nothing was planted."""
    loaded = load_scenario("nominal")
    node = api.nodes(loaded, [TIME_S])[0]
    sound = certify_node(loaded, node, fault=lambda packed: None)
    with ThreadPoolExecutor(max_workers=2) as pool:
        found = list(pool.map(lambda fault: certify_node(loaded, node, fault=fault.plant), FAULTS))
    missed = [fault.name for fault, f in zip(FAULTS, found, strict=True) if not f.unexplained]
    table = [
        "| fault | coupling | | lines off | worst line | margins off |",
        "|---|---|---|---|---|---|",
        *(row(fault, f) for fault, f in zip(FAULTS, found, strict=True)),
        f"| none | | {'stands' if sound.stands else 'FALSE ALARM'} | {len(sound.responses.faulty)} of "
        f"{len(sound.responses.lines_hz)} | - | - |",
    ]
    rewrite(VERIFICATION, "faults", "\n".join(table))
    print("\n".join(table))
    return int(bool(missed) or not sound.stands)


if __name__ == "__main__":
    sys.exit(main())
