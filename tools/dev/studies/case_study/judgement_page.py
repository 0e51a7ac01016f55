"""Tables of the verdicts in docs/case-study.md, from docs/case-study-verdicts.json alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from maxq.tools.dev.studies.case_study.judgement import COMPARED, TOLD_MARGINS

Results = Mapping[str, Any]
_CAMPAIGN = "ksr3: "
_TOLD = ("slosh angle", "gimbal rate", "lateral load", "attitude error", "bending moment of the structure")


def ranking_table(designs: Results) -> list[str]:
    """Every design, the best first, and why it is not accepted."""
    peaks = any("peak_db" in found for found in designs.values())
    shown = [*(["mode 1 peak, dB"] if peaks else []), *TOLD_MARGINS]
    head = ["", "design", "verdict", *shown, "rejected for", "undecided"]
    lines = ["| " + " | ".join(head) + " |", "|---:|---|---|" + "---:|" * len(shown) + "---|---|"]
    for n, (name, found) in enumerate(designs.items(), 1):
        by_name = {r["name"]: r for r in found["requirements"]}
        cells = [str(n), name.removeprefix("ksr3-"), f"**{found['verdict']}**"]
        cells += [f"{found['peak_db']:.2f}"] if peaks else []
        cells += [by_name[x]["found"].partition(" ")[0] if x in by_name else "-" for x in TOLD_MARGINS.values()]
        for verdict in ("rejected", "undecided"):
            cells.append("; ".join(_reason(r) for r in found["requirements"] if r["verdict"] == verdict) or "-")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _reason(r: Mapping[str, Any]) -> str:
    name = r["name"].removeprefix(_CAMPAIGN)
    where = f", {r['where']}" if r["where"] and not r["where"].startswith(("run", "at ")) else ""
    return f"{name} ({r['found']}{where})"


def side_by_side_table(results: Results) -> list[str]:
    """Every requirement for the two that are compared."""
    both = [{r["name"]: r for r in results["designs"][name]["requirements"]} for name in COMPARED]
    head = ["", "requirement", "wanted"]
    for name in COMPARED:
        head += [name.removeprefix("ksr3-"), ""]
    lines = ["| " + " | ".join(head) + " |", "|---|---|---|---|---|---|---|"]
    last = ""
    for name, r in both[1].items():
        if r["part"] == "scenarios" and all(b[name]["verdict"] == "accepted" for b in both):
            continue
        cells = [r["part"] if r["part"] != last else "", name.removeprefix(_CAMPAIGN), r["wanted"]]
        last = r["part"]
        for b in both:
            mine = b.get(name)
            cells += [mine["found"], _mark(mine["verdict"])] if mine else ["-", ""]
        lines.append("| " + " | ".join(cells) + " |")
    kept = [name for name, r in both[1].items()
            if r["part"] == "scenarios" and all(b[name]["verdict"] == "accepted" for b in both)]  # fmt: skip
    return [*lines, "", f"Flown and accepted with both: {', '.join(kept)}."]


def _mark(verdict: str) -> str:
    return verdict if verdict == "accepted" else f"**{verdict}**"


def limits_table(results: Results) -> list[str]:
    """The limits that hold off the nominal flight, with their reasons."""
    limits = next(iter(results["designs"].values()))["limits"]
    rows = [f"| {name} | {limit:g} | {why} |" for name, (limit, why) in limits.items()]
    return ["| requirement | at most | why |", "|---|---:|---|", *rows]


def changes_table(results: Results) -> list[str]:
    """What would have to change: median, worst and failures of the campaign's flights."""
    lines = ["| flown | design | " + " | ".join(f"{name}: median, worst, failed" for name in _TOLD) + " | verdict |"]
    lines.append("|---|---|" + "---|" * len(_TOLD) + "---|")
    for what in results["changes"][COMPARED[0]]:
        for design in COMPARED:
            found = results["changes"][design][what]
            by_name = {r["name"].removeprefix(_CAMPAIGN): r for r in found["requirements"]}
            cells = [what if design == COMPARED[0] else "", design.removeprefix("ksr3-")]
            for name in _TOLD:
                r = by_name[name]
                cells.append(f"{_number(r['median'])}, {_number(r['worst'])}, {r['failed']}{_sign(r['verdict'])}")
            left = [name for name, r in by_name.items() if r["verdict"] != "accepted"]
            cells.append(_mark(found["verdict"]) + (f": {', '.join(left)}" if len(left) < 3 and left else ""))
            lines.append("| " + " | ".join(cells) + " |")
    return [*lines, "", f"{results['runs']} flights each; ✗ rejected, ? not settled."]


def _sign(verdict: str) -> str:
    return {"accepted": "", "rejected": " ✗", "undecided": " ?"}[verdict]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}" if abs(value) < 1e4 else f"{value:.0f}"
