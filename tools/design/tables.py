"""What is printed about a design: limits, margins and lobes at every node."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from maxq.design.margins.lobes import Lobe
from maxq.design.margins.measure import Bound
from maxq.design.verify.judging import Check, Judged
from maxq.tools.cli.terminal import aligned

MET, MISSED = "met", "MISSED"


def limits_table(checks: Sequence[Check]) -> list[str]:
    """Every limit, its worst value and where."""
    rows = [("limit", "wanted", "worst", "at", "")]
    for check in checks:
        k = check.worst
        at = f"{check.time_s[k]:g} s" if math.isfinite(check.time_s[k]) else "filter"
        unit = f" {check.unit}" if check.unit else ""
        rows.append(
            (check.text, f"{check.sense} {check.limit:g}{unit}", number(float(check.values[k]), 3) + unit, at,
             MET if check.passed else MISSED)
        )  # fmt: skip
    return ["limits", *aligned(rows, "  ", right=(2, 3))]


def nodes_table(checks: Sequence[Check], times_s: Sequence[float]) -> list[str]:
    """A row a node, a column a limit; what misses its limit is marked with !, and the row says so."""
    shown = [check for check in checks if math.isfinite(check.time_s[0]) and check.key != "unstable_poles"]
    stable = next((check for check in checks if check.key == "unstable_poles"), None)
    rows = [
        ("time, s", "loop", *(_short(check) for check in shown), ""),
        ("", "", *(f"{check.sense} {check.limit:g} " for check in shown), ""),
    ]
    for n, time_s in enumerate(times_s):
        good = stable is None or bool(stable.met()[n])
        cells = [number(float(c.values[n]), 3) + (" " if c.met()[n] else "!") for c in shown]
        passed = good and all(bool(c.met()[n]) for c in shown)
        rows.append((f"{time_s:g}", "stable" if good else "UNSTABLE", *cells, "pass" if passed else "FAIL"))
    return ["at the nodes", *aligned(rows, "  ", right=(0, *range(2, 2 + len(shown))))]


def margins_table(judged: Sequence[Judged]) -> list[str]:
    """A row a node: margins up and down, by class, and the distances to -1."""
    rows = [
        ("time, s", "loop", "gain up", "down", "phase", "delay", "least", "diamond", "aero", "rigid", "rigid", "cross"),
        ("", "", "dB", "dB", "deg", "ms", "|1+L|", "clear", "dB", "dB", "deg", "Hz"),
    ]
    for j in judged:
        m = j.margins
        rows.append(
            (
                f"{j.time_s:g}", "stable" if m.stable else f"{max(m.unstable_poles, 1)} UNSTABLE",
                _bound(m.gain_up_db), _bound(m.gain_down_db), _bound(m.phase_deg, 1), _bound(m.delay_s, 1, 1e3),
                number(m.modulus, 3), number(m.clearances[0].value, 2) if m.clearances else "-",
                _bound(m.aero_gain_db), _bound(m.rigid_gain_db), _bound(m.rigid_phase_deg, 1),
                number(m.crossover_hz, 3),
            )
        )  # fmt: skip
    return ["margins over all crossings", *aligned(rows, "  ", right=(0, *range(2, 12)))]


def lobes_table(judged: Sequence[Judged]) -> list[str]:
    """A row a node, a column a lobe: its peak, and the phase that it is from harm, or G for gain-stabilised."""
    labels = list(dict.fromkeys(lobe.label for j in judged for lobe in j.lobes))
    if not labels:
        return []
    rows = [("time, s", *labels)]
    for j in judged:
        by_label = {lobe.label: lobe for lobe in j.lobes}
        rows.append((f"{j.time_s:g}", *(_lobe(by_label.get(label), j.margins.stable) for label in labels)))
    head = "lobes: peak dB, and how it is stabilised (G gain; P phase, with the turn in degrees that would harm)"
    return [head, *aligned(rows, "  ", right=tuple(range(1 + len(labels))))]


def budget_table(judged: Sequence[Judged], crossing: str, column: Literal["gain_db", "phase_deg"]) -> list[str]:
    """A row a node: what each part adds to gain or phase at the crossing that sets a margin, and the margin left."""
    have = [j for j in judged if crossing in j.budgets]
    if not have:
        return []
    parts = list(dict.fromkeys(share.part for j in have for share in j.budgets[crossing].shares))
    unit, digits = ("deg", 1) if column == "phase_deg" else ("dB", 2)
    rows = [("time, s", "at Hz", *(_PARTS.get(part, part) for part in parts), "sum", "left")]
    for j in have:
        budget = j.budgets[crossing]
        shares = {share.part: getattr(share, column) for share in budget.shares}
        left = abs(budget.phase_margin_deg) if column == "phase_deg" else abs(budget.gain_db)
        cells = [number(shares.get(part, math.nan), digits) for part in parts]
        whole = number(getattr(budget, column), digits)
        rows.append((f"{j.time_s:g}", f"{budget.frequency_hz:.3g}", *cells, whole, number(left, digits)))
    return [f"budget at the {crossing}, {unit}", *aligned(rows, "  ", right=tuple(range(len(rows[0]))))]


_PARTS = {"rigid body": "rigid", "aerodynamics": "aero", "engine inertia": "engine"}


def _lobe(lobe: Lobe | None, stable: bool) -> str:
    if lobe is None:
        return "-"
    how = "G      " if lobe.stabilised == "gain" else f"P {number(lobe.phase_deg, 0):>4s}°"
    return f"{lobe.peak_db:.2f} {how if stable else '       '}"


def _bound(bound: Bound, digits: int = 2, scale: float = 1.0) -> str:
    return number(scale * bound.value, digits)


def number(value: float, digits: int) -> str:
    """A value for a cell; `-` where there is none."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "inf" if value > 0.0 else "-inf"
    return f"{value:.{digits}f}"


_SHORT = {
    "gain_margin_db": "gain dB",
    "phase_margin_deg": "phase deg",
    "zone": "zone",
    "modulus_db": "|1+L| dB",
    "first_mode_db": "mode 1 dB",
    "first_mode_phase_deg": "mode 1 deg",
    "second_mode_db": "mode 2 dB",
    "higher_modes_db": "modes 3+ dB",
    "rigid_hz": "rigid Hz",
    "rigid_zeta": "rigid zeta",
}


def _short(check: Check) -> str:
    return _SHORT.get(check.key, check.text) + " "
