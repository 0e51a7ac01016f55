"""The ways out of an infeasible case as `simdesign` prints and writes them: conflict, bounds and trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from maxq.design.optimise.search import UNSETTLED
from maxq.design.optimise.solution import ActiveBound, Constraint, Solution
from maxq.design.optimise.way_out import Relief, conflict, prices
from maxq.tools.cli.terminal import aligned

POINTS = 3  # most operating points of a limit in a table


def way_out_table(solution: Solution) -> list[str]:
    """Return the limits in conflict, the variables at their bounds, and the trials of an infeasible design, as
    lines.
    """
    found = conflict(solution)
    if not found and not solution.trials:
        return []
    lines = ["way out"]
    if found:
        rows = [("limits in conflict", "gains dB per dB", "a dB is", "at (part)")]
        rows += [(each.name, f"{each.gains_db:.3f}", each.by, _at(each.points)) for each in found]
        lines += aligned(rows, "  ", right=(1, 2))
        if (residual := solution.certificate.kkt_residual) > UNSETTLED:
            lines.append(f"  uncertain: the optimality conditions are met to {residual:.1e} only")
        if solution.bounds:
            lines.append("  active bounds of variables, and the gain by moving them")
            lines += [f"    {bound.text}" for bound in _dearest(solution)]
    if solution.trials:
        lines.append(f"  short trials from the best effort, which misses {solution.violation_db:.3g} dB")
        lines += [f"    {text}" for text in _trials(solution, settings=True)]
    return lines


def way_out_comments(solution: Solution) -> list[str]:
    """Return the conflict, bounds and trials as lines for the head of a design file."""
    found = conflict(solution)
    parts = ", ".join(f"{each.name} {each.gains_db:.2f}" for each in found)
    lines = [f"in conflict at {solution.violation_db:.3g} dB (dB gained by a dB of relief): {parts}"] if found else []
    lines += [bound.text for bound in _dearest(solution)] if found else []
    return [*lines, *(f"trial: {text}" for text in _trials(solution, settings=True))]


def trials_text(solution: Solution) -> str:
    """Return the results of the trials as a clause, or "" without trials."""
    said = _trials(solution)
    return f"short trials from there: {'; '.join(said)}" if said else ""


def way_out_record(solution: Solution) -> dict[str, Any]:
    """Return the record of the conflict and the trials for design.json."""
    limits = _record(conflict(solution))
    return {"missing_db": solution.violation_db, "conflict": limits, "trials": [asdict(t) for t in solution.trials]}


def prices_record(solution: Solution) -> list[dict[str, Any]]:
    """Return the record of the cost of each limit of a feasible design for design.json."""
    return _record(prices(solution))


def _record(found: Sequence[Relief]) -> list[dict[str, Any]]:
    return [
        {
            "limit": each.name,
            "gains_db_per_db": each.gains_db,
            "a_db_is": each.by,
            "at": [
                {"point": c.plant, "time_s": c.time_s, "frequency_hz": c.frequency_hz, "part": c.multiplier}
                for c in each.points
            ],
        }
        for each in found
    ]


def _trials(solution: Solution, settings: bool = False) -> list[str]:
    return [t.text + (f"; {' '.join(t.settings)}" if settings else "") for t in solution.trials]


def _dearest(solution: Solution) -> list[ActiveBound]:
    """Return the active bounds of variables in decreasing order of their price."""
    return sorted(solution.bounds, key=lambda bound: -bound.price_db)


def _at(points: tuple[Constraint, ...]) -> str:
    """Return the operating points at which a limit is active, with their parts, as given (the largest first)."""
    said = [f"{c.plant or 'filter'} ({c.multiplier:.2f})" for c in points[:POINTS]]
    return ", ".join(said) + (f" and {len(points) - POINTS} more" if len(points) > POINTS else "")
