"""Certify the nominal scenario's design at eleven operating points in both planes:
`python -m maxq.tools.dev.verification.certificates`.

Every second operating point is written into the table of docs/verification.md. The exit code is 1 if a certificate
fails.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from maxq.design.certificate.certificate import PLANES, NodeCertificate, certify
from maxq.design.certificate.in_flight import InFlightResponse, in_flight_response
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.verification.section import VERIFICATION, rewrite

TIMES_S = tuple(float(t) for t in range(5, 60, 5))


def row(c: NodeCertificate, passing: InFlightResponse) -> str:
    """Return a row of the table: the largest differences at an operating point. `passing` is its response in flight."""
    r = c.responses
    clean = np.isfinite(r.unrounded.real)
    above = clean & (np.abs(r.sampled) > 10.0**-2.5)
    low = ~clean
    cells = [f"{c.time_s:g}", c.plane, f"{np.abs(r.difference_db[low]).max():.2f}"]
    cells += [f"{np.abs(r.unrounded_db[above]).max():.3f}", f"{np.abs(r.unrounded_deg[above]).max():.2f}"]
    cells += [f"{np.nanmax(np.abs(r.nonlinear_db)):.2f}"]
    for e in c.margins:
        cells.append(f"{100.0 * e.difference / e.held:+.2f}" if e.unit == "s" else f"{e.difference:+.3f}")
    held = next((e for e in c.margins if e.what == "gain_down"), None)
    cells.append(f"{held.held:.1f}, {held.sampled:.1f}" if held else "")
    cells.append(f"{np.abs(passing.difference_db).max():.1f}")
    cells.append("agrees" if c.agrees and "unexplained" not in passing.reason else "; ".join(c.unexplained))
    return f"| {' | '.join(cells)} |"


def main() -> int:
    """Certify the design, rewrite the table, and return the exit code."""
    loaded = load_scenario("nominal")
    begun = time.perf_counter()
    found = certify(loaded, TIMES_S)
    wall_s = time.perf_counter() - begun
    through = {(f.time_s, f.plane): f for p in PLANES for f in in_flight_response(loaded, TIMES_S, p)}
    table = [
        "| time, s | plane | below 2.7 Hz, dB | above, dB | above, deg | half amplitude, dB | upper gain, dB |"
        " lower gain, dB | delay, % | lower gain margin: held, flown, dB | in flight, dB | |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
        *(row(c, through[c.time_s, c.plane]) for c in found if c.time_s in TIMES_S[::2] or not c.agrees),
    ]
    rewrite(VERIFICATION, "certificates", "\n".join(table))
    print("\n".join(table))
    print(f"{wall_s:.0f} s for {len(found)} nodes")
    return int(not all(c.agrees for c in found))


if __name__ == "__main__":
    sys.exit(main())
