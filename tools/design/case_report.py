"""What is printed about a designed case, and what its design file says above the numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from maxq.design.case.read import LoadedCase
from maxq.design.optimise.solution import Constraint, Solution
from maxq.design.verify.outcome import Outcome
from maxq.tools.cli.terminal import aligned, printable
from maxq.tools.design import tables

_LOOPS = {"sampled": "sampled, as it flies", "pade": "the paper's Pade approximants", "exact": "without aliasing"}


def report(loaded: LoadedCase, outcome: Outcome, solution: Solution) -> str:
    """All that is said about it, in plain text."""
    case = loaded.case
    head = [printable(f"{loaded.name}: {case.description}" if case.description else loaded.name)]
    head.append(
        f"{case.filter.structure}, {case.gains.schedule} gains; along {case.scenario}, {case.plane}; "
        f"{_LOOPS[case.loop]}; errata: {case.errata}; plant: {case.plant}"
    )
    times = [j.time_s for j in outcome.judged]
    parts = [
        head, design_table(outcome), search_table(solution), tables.margins_table(outcome.judged),
        tables.lobes_table(outcome.judged), tables.limits_table(outcome.found),
        tables.nodes_table(outcome.found, times),
    ]  # fmt: skip
    if outcome.dispersed_found:
        lines = tables.limits_table(outcome.dispersed_found)
        parts.append([f"limits of {len(outcome.dispersed)} dispersed plants", *lines[1:]])
    if case.loop != "sampled":
        parts.append(["the same design as it flies (sampled)", *tables.limits_table(outcome.flown_found)[1:]])
    return "\n\n".join("\n".join(part) for part in parts if part)


def design_table(outcome: Outcome) -> list[str]:
    """Gains and filter."""
    table = outcome.design.gains.table
    rows = [("time, s", "k_p", "k_d, s")]
    for t, p, d in zip(table["time_s"], table["k_p"], table["k_d_s"], strict=True):
        rows.append((f"{t:g}", f"{p:.4f}", f"{d:.4f}"))
    lines = ["gains", *aligned(rows, "  ", right=(0, 1, 2)), f"filter {outcome.design.filter.structure}"]
    sections = [("section", "zero Hz", "zeta", "pole Hz", "zeta")]
    for q in outcome.design.filter.quadratic:
        sections.append(
            ("quadratic", f"{q.zero_hz:.3f}", f"{q.zero_zeta:.4f}", f"{q.pole_hz:.3f}", f"{q.pole_zeta:.4f}")
        )
    for f in outcome.design.filter.first_order:
        sections.append(("first order", f"{f.zero_hz:.3f}", "", f"{f.pole_hz:.3f}", ""))
    return [*lines, *aligned(sections, "  ", right=(1, 2, 3, 4))]


def search_table(solution: Solution) -> list[str]:
    """How sure the optimum is."""
    c = solution.certificate
    active = [x for x in solution.constraints if x.active]
    rows = [
        ("objective", f"{solution.objective_db:.4f} dB"),
        ("starts", c.statement()),
        ("ends, dB", ", ".join("-" if math.isnan(x) else f"{x:.2f}" for x in sorted(c.ends_db))),
        ("KKT residual", f"{c.kkt_residual:.1e}"),
        ("active", _active(active, solution)),
        ("effort", f"{c.evaluations} evaluations, {c.seconds:.2f} s, seed {c.seed}"),
    ]
    return ["search", *aligned(rows, "  ")]


def _active(active: Sequence[Constraint], solution: Solution) -> str:
    counts: dict[str, int] = {}
    for x in active:
        counts[x.what] = counts.get(x.what, 0) + 1
    names = [f"{what} ({n} nodes)" if n > 1 else what for what, n in counts.items()]
    names += [f"{b.variable} at its {b.side} bound" for b in solution.bounds]
    return "; ".join(names) or "none"


def comments(outcome: Outcome, solution: Solution) -> list[str]:
    """Lines above the design: what made it, and whether it holds its limits."""
    case = outcome.loaded.case
    form = f"{case.filter.structure}, {case.gains.schedule} gains"
    first = f"Written by simdesign for the case {outcome.loaded.name} ({form})."
    if solution.status == "interrupted":
        state = "INTERRUPTED: the best so far" + (
            ", which meets all limits." if outcome.feasible else "; it misses limits:"
        )
    elif outcome.feasible and solution.feasible:
        state = "All limits of the case are met."
    else:
        state = "INFEASIBLE: the best effort misses limits of the case:"
    return [first, state, *(f"  {line}" for line in outcome.missed)]
