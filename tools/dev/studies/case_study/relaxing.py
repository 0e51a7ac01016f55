"""How far the rigid-body limits must be lowered for the integrated design to gain what the paper says (erratum 20)."""

from __future__ import annotations

import math
from collections.abc import Sequence

from maxq.design.case.read import read_case
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import nominal_plants, solve
from maxq.tools.dev.studies.case_study.optima import STRUCTURES
from maxq.tools.dev.studies.case_study.optima_tables import Optima

STEPS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
FROM, TO = (0.5, 0.7), (0.4, 0.55)


def relaxing_table(known: Optima, steps: Sequence[float] = STEPS) -> list[str]:
    """dB that Subcase 1 gains on the two-phase design, a row a pair of limits, a column a filter; flown plant."""
    lines = ["| rigid-body limits | k_d | " + " | ".join(STRUCTURES) + " |", "|---|---:|" + "---:|" * len(STRUCTURES)]
    plants = nominal_plants(read_case("ksr3-identical"))
    before: dict[str, Solution] = {}
    for step in steps:
        hz, zeta = (a + step * (b - a) for a, b in zip(FROM, TO, strict=True))
        cells = []
        for structure in STRUCTURES:
            changes = [f"filter.structure={structure}", f"limits.rigid_hz={hz!r}", f"limits.rigid_zeta={zeta!r}"]
            also = [before[f] for f in (structure, STRUCTURES[max(STRUCTURES.index(structure) - 1, 0)]) if f in before]
            solution = solve(read_case("ksr3-identical", changes), plants, also)
            before[structure] = solution
            reference = known.peak("flown", "identical", "two-phase", structure)
            cells.append(f"{reference - solution.objective_db:.2f}" if solution.feasible else "infeasible")
        share = 20.0 * math.log10(hz * zeta / (FROM[0] * FROM[1]))
        lines.append(f"| {hz:.3f} Hz, {zeta:.4f} | {share:.1f} dB | " + " | ".join(cells) + " |")
    return lines
