"""Fly all NESC check cases and write their largest differences into docs/verification.md:
`python -m maxq.tools.dev.verification.nesc [--check]`.

Pictures are written to docs/pictures/verification. With --check, nothing is written. The exit code is 1 if a tolerance
is missed.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from maxq.sim.run.flight import Flight
from maxq.tools.dev.verification.nesc_cases import ALL_CASES, LargestDifference, fly_case
from maxq.tools.dev.verification.nesc_pictures import draw
from maxq.tools.dev.verification.section import VERIFICATION, markers, rewrite
from maxq.tools.plots.style import drawing

DOCUMENT = VERIFICATION
BEGIN, END = markers("nesc")

HEADER = """\
| case | scenario | step, s | compared | missed | nearest to its tolerance | difference | limit | ratio | at, s |
|---|---|---|---|---|---|---|---|---|---|
"""


def row(case: str, scenario: str, flight: Flight, differences: list[LargestDifference]) -> str:
    """Return a row of the table, with the variable nearest to its tolerance."""
    worst = max(differences, key=lambda d: d.ratio)
    missed = sum(not d.ratio <= 1.0 for d in differences)
    step = flight.scenario.scenario.run.step_s
    cells = [case, f"`{scenario}`", f"{step:g}", str(len(differences)), str(missed)]
    cells += [f"{worst.variable} ({worst.reference})", f"{worst.largest:.2g}", f"{worst.tolerance:.2g}"]
    cells += [f"{worst.ratio:.2g}", f"{worst.at_s:g}"]
    return f"| {' | '.join(cells)} |\n"


def insert(table: str, document: Path = DOCUMENT) -> None:
    """Write the table between its markers. Raises ValueError if they are missing."""
    rewrite(document, "nesc", table)


def main() -> int:
    parser = argparse.ArgumentParser(description="Fly the NESC check cases and tabulate the differences.")
    parser.add_argument("--check", action="store_true", help="leave docs/verification.md as it is")
    arguments = parser.parse_args()
    begun = time.perf_counter()
    flights: dict[str, Flight] = {}
    table, missed = HEADER, 0
    for case, (scenario, compare) in ALL_CASES.items():
        if scenario not in flights:
            flights[scenario] = fly_case(scenario)
        differences = compare(flights[scenario])
        missed += sum(not d.ratio <= 1.0 for d in differences)
        table += row(case, scenario, flights[scenario], differences)
    print(table, end="")
    print(f"{missed} missed; {time.perf_counter() - begun:.1f} s")
    if not arguments.check:
        insert(table)
        with drawing(("png",)):
            draw(flights)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
