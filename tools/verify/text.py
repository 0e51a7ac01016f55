"""What `simverify` prints: a table of requirements, the ranking of several designs, the verdict as the last line."""

from __future__ import annotations

import math
from collections.abc import Sequence

from maxq.design.verify.suite import ACCEPTED, REJECTED, UNDECIDED
from maxq.design.verify.verify import Verification
from maxq.tools.cli.terminal import aligned, printable


def report(found: Verification, title: str) -> list[str]:
    """Every requirement, a row each, by part."""
    rows = [("", "requirement", "wanted", "found", "room", "where", "verdict")]
    last = ""
    for r in found.requirements:
        part = r.part if r.part != last else ""
        last = r.part
        room = f"{100.0 * r.room:.0f} %" if math.isfinite(r.room) else ""
        rows.append((part, printable(r.name), r.wanted, printable(_short(r.found)), room, r.where, _mark(r.judgement)))
    return [title, *aligned(rows, "  ", right=(4,))]


def _short(text: str, most: int = 60) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def _mark(judgement: str) -> str:
    return judgement if judgement == ACCEPTED else judgement.upper()


def reasons(found: Verification) -> list[str]:
    """Why a design is not accepted, a line each, and what shows it."""
    out = []
    for r in (*found.of(REJECTED), *found.of(UNDECIDED)):
        out.append(f"  {r.judgement}: {printable(r.reason)}")
        if r.again:
            out.append(f"      {r.again}")
    return out


def headline(found: Verification, name: str = "") -> str:
    """The verdict; `name` is the design's for people."""
    counts = [f"{len(found.of(j))} {j}" for j in (ACCEPTED, REJECTED, UNDECIDED) if found.of(j)]
    more = f", {found.more_runs} more runs would settle it" if found.judgement == UNDECIDED and found.more_runs else ""
    said = f"of {len(found.requirements)} requirements {', '.join(counts)}{more}"
    return f"{found.judgement.upper()}: {printable(name or found.design)}; {said}"


def ranked(every: Sequence[Verification]) -> list[Verification]:
    """The best first."""
    return sorted(every, key=lambda v: v.merit, reverse=True)


def ranking(every: Sequence[Verification]) -> list[str]:
    """Designs side by side, the best first."""
    head = ("", "design", "verdict", "rejected", "undecided", "tightest", "room", "gain dB", "phase deg", "mode 1 deg")
    rows: list[tuple[str, ...]] = [head]
    for n, v in enumerate(ranked(every), 1):
        finite = [r for r in v.requirements if math.isfinite(r.room)]
        worst = min(finite, key=lambda r: r.room, default=None)
        nominal = {r.name.partition(",")[0]: r.found for r in v.requirements if r.part == "margins"}
        rows.append(
            (
                str(n), v.design, _mark(v.judgement), str(len(v.of(REJECTED))), str(len(v.of(UNDECIDED))),
                printable(worst.name) if worst else "", f"{100.0 * worst.room:.0f} %" if worst else "",
                _number(nominal.get("gain margin up", "")), _number(nominal.get("phase margin", "")),
                _number(nominal.get("first mode: phase margin", "")),
            )
        )  # fmt: skip
    return ["ranking", *aligned(rows, "  ", right=(0, 3, 4, 6, 7, 8, 9))]


def _number(text: str) -> str:
    return text.partition(" ")[0] if text else "-"
