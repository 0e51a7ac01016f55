"""What is printed about a campaign: verdicts, drivers, the worst flights, and the verdict as the last line."""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from pathlib import Path

from maxq.sim.campaign.analysis import DataSet, Judged, Lost
from maxq.sim.campaign.statistics import MET, NOT_MET
from maxq.tools.cli.terminal import aligned, printable


def verdict_table(verdicts: Sequence[Judged], success: float, confidence: float) -> list[str]:
    """Lines: one requirement each."""
    head = (
        "requirement", "limit", "median", f"{100 * success:g} %", f"bound at {100 * confidence:g} %", "worst", "run",
        "failed", "allowed", "success", "verdict",
    )  # fmt: skip
    rows: list[tuple[str, ...]] = [head]
    for v in verdicts:
        rows.append((
            printable(v.name), limit_text(v), value_text(v.median), value_text(v.quantile), value_text(v.tolerance),
            value_text(v.worst[0].value) if v.worst else "", str(v.worst[0].run) if v.worst else "",
            str(v.shown.failures), str(v.shown.allowed) if v.shown.allowed >= 0 else "",
            success_text(v), verdict_text(v),
        ))  # fmt: skip
    return aligned(rows, "  ", right=(1, 2, 3, 4, 5, 6, 7, 8))


def limit_text(v: Judged) -> str:
    if not v.metric:
        return ""
    sign = "<=" if v.kind == "limit" else ">="
    return f"{sign} {v.bound:g}{'' if v.unit == '1' else ' ' + v.unit}"


def value_text(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.5g}"


def success_text(v: Judged) -> str:
    """The estimate and its two one-sided bounds."""
    shown = v.shown
    if shown.runs == 0:
        return ""
    return f"{100 * shown.success:.4g} % ({100 * shown.success_least:.4g} .. {100 * shown.success_most:.4g})"


def verdict_text(v: Judged) -> str:
    if v.shown.judgement in (MET, NOT_MET):
        return v.shown.judgement
    return f"not yet: {v.shown.more} more runs without failure"


def headline(verdicts: Sequence[Judged], runs: int, success: float, confidence: float, failed: int) -> str:
    """The campaign in one line."""
    level = f"{100 * success:g} % with {100 * confidence:g} % confidence"
    if runs == 0:
        return "NO RUNS: nothing can be said"
    missed = [v.name for v in verdicts if v.shown.judgement == NOT_MET]
    still = [v for v in verdicts if v.shown.judgement not in (MET, NOT_MET)]
    failures = f"{failed} of {runs} runs failed"
    if missed:
        return f"NOT MET ({level}): {', '.join(printable(name) for name in missed)}; {failures}"
    if still:
        more = max(v.shown.more for v in still)
        return f"NOT YET SETTLED ({level}): {len(still)} of {len(verdicts)} open, {more} more runs needed; {failures}"
    return f"MET ({level}): all {len(verdicts)} requirements; {failures}"


def worst_lines(verdicts: Sequence[Judged], folder: Path, losses: Sequence[Lost]) -> list[str]:
    """The worst flight of each requirement that was missed, and how to fly it again."""
    rows = []
    for lost in losses[:5]:
        rows.append((f"run {lost.run}", lost.outcome, printable(lost.cause)[:90]))
    for v in verdicts:
        if v.metric and v.shown.failures and v.worst:
            worst = v.worst[0]
            rows.append((f"run {worst.run}", printable(v.name), f"{worst.value:.5g} at {worst.time_s:.3f} s"))
    if not rows:
        return []
    return ["worst flights", *aligned(rows, "  "), f"  again with a log: {replay(folder, '417')}".replace("417", "RUN")]


def replay(folder: Path, run: int | str) -> str:
    return f"simrun --from {shlex.quote(str(folder))} --run {run}"


def report(data: DataSet, verdicts: Sequence[Judged], losses: Sequence[Lost], failed: int) -> list[str]:
    """All that is said about a campaign's results, but the last line."""
    campaign = data.campaign.campaign
    scenario = data.campaign.base.scenario
    title = printable(f"{scenario.name}: {scenario.description}" if scenario.description else scenario.name)
    counts = {outcome: data.outcomes.count(outcome) for outcome in dict.fromkeys(sorted(data.outcomes))}
    ends = ", ".join(f"{count} {outcome}" for outcome, count in counts.items())
    lines = [title, "", f"{len(data.runs)} runs: {ends or 'none'}; {failed} failed", ""]
    lines += ["requirements", *verdict_table(verdicts, campaign.success, campaign.confidence)]
    worst = worst_lines(verdicts, data.folder, losses)
    return [*lines, *(["", *worst] if worst else [])]
