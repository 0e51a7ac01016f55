"""The tables for a review board: statements of [board] and findings of a verification, for the page and
verdict.json.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, get_args

from maxq.design.verify.board import BoardSection, Factor
from maxq.design.verify.board_findings import ALEATORY, EPISTEMIC, UNSAID, FaultCase, missed_probability
from maxq.design.verify.shared_code import shared_code
from maxq.design.verify.verify import Verification

ABSENT = "absent"
NO_BOARD = BoardSection(vehicle="none")
AVERAGED = (
    "The shares of campaigns and random vehicles average over all deviations, epistemic ones included. They are not "
    "the worst over the epistemic ones. The worst third of each is selected from three; its 90 % bounds are for one "
    "third alone."
)
SHARED = (
    "The table lists the imports of the program. Agreement of linear model, certificate and flights is no evidence for "
    "code that both execute."
)


@dataclass(frozen=True)
class BoardTable:
    """A table of texts, with a `note` that explains it. A table without rows means that its subject is absent."""

    name: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str = ""

    @property
    def all_absent(self) -> bool:
        """Return True if no row states anything about the item in its first cell."""
        return all(cell in ("", ABSENT) for row in self.rows for cell in row[1:])


def board_tables(found: Verification) -> list[BoardTable]:
    """Return the tables of a verification. The suite may lack a [board]."""
    board = found.suite.board or NO_BOARD
    shared = [tuple(row) for row in shared_code(found.scenario)]
    return [
        _waivers(found),
        _pedigree(board, found.board.inputs),
        _credibility(board),
        *_deviations(found),
        _faults(found, board),
        _second_tool(found),
        BoardTable("shared code", ("part", "executed by", "modules, and the names that are imported"), shared, SHARED),
    ]


def board_record(found: Verification) -> dict[str, Any]:
    """Return the tables as in verdict.json: by name, a list of rows by heading, or "absent" for a table
    without rows.
    """
    tables = board_tables(found)
    return {t.name: [dict(zip(t.head, row, strict=True)) for row in t.rows] or ABSENT for t in tables}


def waiver_lines(found: Verification) -> list[str]:
    """Return a line for each waiver: its requirement, approver and state."""
    return [f"waiver of {a.waiver.about}, by {a.waiver.approver}: {a.state}" for a in found.board.waivers]


def _percent(value: float) -> str:
    return f"{100.0 * value:.4g} %"


def _waivers(found: Verification) -> BoardTable:
    rows = [
        (w.about, w.reason, w.approver, w.date, w.expires, f"{100.0 * w.room:g} %", a.state)
        for a in found.board.waivers
        for w in (a.waiver,)
    ]
    head = ("requirement", "reason", "approver", "from", "until", "margin to limit at least", "state")
    return BoardTable("waivers", head, rows)


def _pedigree(board: BoardSection, inputs: Sequence[str]) -> BoardTable:
    rows: list[tuple[str, ...]] = [
        (p.input, p.obtained, p.source, p.date or ABSENT, p.use_history or ABSENT) for p in board.pedigree
    ]
    listed = {p.input for p in board.pedigree}
    rows += [(name, ABSENT, "", "", "") for name in inputs if name not in listed]
    return BoardTable("data pedigree", ("input", "obtained", "source", "date", "use history"), rows)


def _credibility(board: BoardSection) -> BoardTable:
    known = {c.factor: c for c in board.credibility}
    rows = [
        (factor, str(known[factor].level), known[factor].evidence) if factor in known else (factor, ABSENT, ABSENT)
        for factor in get_args(Factor)
    ]
    return BoardTable("credibility factors (NASA-STD-7009)", ("factor", "level, 0 to 4", "evidence"), rows)


def _deviations(found: Verification) -> Iterator[BoardTable]:
    kinds, thirds = list[tuple[str, ...]](), list[tuple[str, ...]]()
    for one in found.board.deviations:
        for kind in (EPISTEMIC, ALEATORY, UNSAID):
            names = one.kinds[kind]
            kinds.append((one.campaign, kind, str(len(names)), "; ".join(names) or "none"))
        for worst in one.worst:
            low, high = worst.bounds
            share = f"{_percent(worst.missed / worst.runs)} ({_percent(low)} to {_percent(high)})"
            here, there = f"{worst.missed} of {worst.runs}", f"{worst.others_missed} of {worst.others}"
            thirds.append((one.campaign, worst.deviation, worst.third, here, share, there))
    head: tuple[str, ...] = ("campaign", "kind", "number", "deviations")
    yield BoardTable("deviations by kind", head, kinds, AVERAGED if kinds else "")
    head = ("campaign", "epistemic deviation", "worst third", "runs that miss a limit", "share", "in the other thirds")
    yield BoardTable("worst third of each epistemic deviation", head, thirds)


def _faults(found: Verification, board: BoardSection) -> BoardTable:
    def row(case: FaultCase) -> tuple[str, ...]:
        probability = f"{case.probability:.3g}" if case.probability is not None else ABSENT
        return case.name, probability, "met" if case.met else "missed" if case.counts else "missed, not required"

    cases, most = found.board.faults, board.fault_probability
    rows, unsaid = list(map(row, cases)), sum(c.probability is None for c in cases if not c.met)
    without = f", {unsaid} without a probability" if unsaid else ""
    allowed = f"allowed: {most:g}" if most is not None else f"allowed: {ABSENT}"
    rows += [("sum of the missed cases", f"{missed_probability(cases):.3g}{without}", allowed)] if cases else []
    return BoardTable("fault cases", ("fault case", "probability", "outcome"), rows)


def _second_tool(found: Verification) -> BoardTable:
    rows = []
    for v in found.board.second_tool:
        g, known = v.given, math.isfinite(v.own)
        numbers = [f"{g.value:.6g}", *((f"{v.own:.6g}", f"{v.difference:+.3g}") if known else (ABSENT, ABSENT))]
        outcome = ABSENT if not known else "met" if abs(v.difference) <= g.tolerance else "missed"
        quantity = f"{g.quantity}, {v.unit}" if v.unit else g.quantity
        rows.append((g.tool, g.file, quantity, g.where, *numbers, f"{g.tolerance:g}", outcome))
    head = ("tool", "file", "quantity", "at", "second tool", "maxq", "difference", "tolerance", "outcome")
    return BoardTable("values of a second tool", head, rows)
