"""The optima as Markdown: values, what is gained, parameters, and the paper's claims beside them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

from maxq.design.case.read import read_case
from maxq.tools.dev.studies.case_study.optima import LIMITS, PLANTS, SCHEDULES, STRUCTURES, Optimum

PLANT_NAMES = {"flown": "the reconstructed vehicle", "table2": "the plant of Table 2"}
LIMIT_NAMES = {"identical": "identical limits", "relaxed": "relaxed limits"}
CLAIM_1, CLAIM_2 = (3.0, 5.0), (0.33, 0.57)
"""What the paper gains: Subcase 1 on the reference, Subcase 2 on Subcase 1, dB."""


class Optima:
    """By plant, limits, schedule and structure."""

    def __init__(self, found: Iterable[Optimum]) -> None:
        self.all = {o.key: o for o in found}

    def peak(self, plant: str, limits: str, schedule: str, structure: str) -> float:
        """NaN for one that misses its limits."""
        o = self.all[plant, limits, schedule, structure]
        return o.objective_db if o.status == "optimal" else math.nan

    def gains(self, plant: str, limits: str) -> tuple[list[float], list[float]]:
        """What Subcase 1 gains on the reference, and Subcase 2 on Subcase 1, of each structure."""
        peaks = {s: [self.peak(plant, limits, s, f) for f in STRUCTURES] for s in SCHEDULES}
        first = [a - b for a, b in zip(peaks["two-phase"], peaks["linear"], strict=True)]
        second = [a - b for a, b in zip(peaks["linear"], peaks["free"], strict=True)]
        return first, second


def peaks_table(optima: Optima) -> list[str]:
    """Fig. 9 as numbers: a row a filter, three columns for each plant and set of limits."""
    lines = []
    for plant in PLANTS:
        for limits in LIMITS:
            first, second = optima.gains(plant, limits)
            lines += [
                "",
                f"**{PLANT_NAMES[plant].capitalize()}, {LIMIT_NAMES[limits]}** (largest peak of mode 1, dB)",
                "",
                "| filter | two-phase | Subcase 1 | gained | Subcase 2 | gained further | starts, leaps at the best |",
                "|---|---:|---:|---:|---:|---:|---|",
            ]
            for k, structure in enumerate(STRUCTURES):
                two_phase, linear, free = (_n(optima.peak(plant, limits, s, structure)) for s in SCHEDULES)
                sure = ", ".join(_sure(optima.all[plant, limits, s, structure]) for s in SCHEDULES)
                cells = [structure, two_phase, linear, _n(first[k]), free, _n(second[k]), sure]
                lines.append(f"| {' | '.join(cells)} |")
    return lines[1:]


def claims_table(optima: Optima) -> list[str]:
    """The paper's claims beside ours."""
    lines = ["| claim of the paper | " + " | ".join(_heading(p, m) for p in PLANTS for m in LIMITS) + " |"]
    lines.append("|---|" + "---|" * (len(PLANTS) * len(LIMITS)))
    first = [_span(optima.gains(p, m)[0]) for p in PLANTS for m in LIMITS]
    second = [_span(optima.gains(p, m)[1]) for p in PLANTS for m in LIMITS]
    falling = [_monotonic(optima, p, m) for p in PLANTS for m in LIMITS]
    lines.append(
        f"| Subcase 1 gains {CLAIM_1[0]:g} to {CLAIM_1[1]:g} dB on the two-phase design | " + " | ".join(first) + " |"
    )
    lines.append(f"| Subcase 2 gains a further {CLAIM_2[0]} to {CLAIM_2[1]} dB | " + " | ".join(second) + " |")
    lines.append("| the peak falls with every order of the filter | " + " | ".join(falling) + " |")
    return lines


def parameters_table(optima: Optima, plant: str, limits: str) -> list[str]:
    """Gains at first and last node and filter of every optimum of a table."""
    lines = [
        "| design | k_p | k_d, s | quadratic sections: zero Hz, zeta; pole Hz, zeta | first order: zero; pole, Hz |"
    ]
    lines.append("|---|---|---|---|---|")
    for structure in STRUCTURES:
        for schedule in SCHEDULES:
            o = optima.all[plant, limits, schedule, structure]
            quadratic = "<br>".join(f"{a:.3f}, {b:.3f}; {c:.3f}, {d:.3f}" for a, b, c, d in o.quadratic)
            first = "<br>".join(f"{a:.3f}; {b:.3f}" for a, b in o.first_order)
            lines.append(f"| {structure} {schedule} | {_ends(o.k_p)} | {_ends(o.k_d_s)} | {quadratic} | {first} |")
    return lines


def limits_table() -> list[str]:
    """What the two sets ask for."""
    names = {
        "gain_margin_db": "GM_R (44), dB", "phase_margin_deg": "PM_R (45), deg", "second_mode_db": "P2_UL (43), dB",
        "filter_gain_at_infinity": "P^F (46)", "rigid_hz": "omega_RB,min (47), Hz", "rigid_zeta": "zeta_RB,min (48)",
    }  # fmt: skip
    cases = {name: read_case(case).case for name, case in LIMITS.items()}
    lines = ["| limit | paper | " + " | ".join(cases) + " |", "|---|---|" + "---|" * len(cases)]
    for key, text in names.items():
        paper = {"rigid_hz": "0.5 (reference)", "rigid_zeta": "0.7 (reference)"}.get(key, "not given")
        lines.append(
            f"| {text} | {paper} | " + " | ".join(f"{getattr(c.limits, key):g}" for c in cases.values()) + " |"
        )
    bounds = next(iter(cases.values())).filter.bounds
    for key in type(bounds).model_fields:
        low, high = getattr(bounds, key)
        lines.append(
            f"| bounds of {key} (50) | not given | " + " | ".join([f"{low:g} to {high:g}"] * len(cases)) + " |"
        )
    return lines


def _heading(plant: str, limits: str) -> str:
    return f"{'flown' if plant == 'flown' else 'Table 2'}, {limits}"


def _span(values: Sequence[float]) -> str:
    good = [v for v in values if not math.isnan(v)]
    missing = "" if len(good) == len(values) else f" ({len(values) - len(good)} infeasible)"
    return f"{min(good):.2f} to {max(good):.2f}{missing}" if good else "infeasible"


def _monotonic(optima: Optima, plant: str, limits: str) -> str:
    steps = []
    for schedule in SCHEDULES:
        peaks = [optima.peak(plant, limits, schedule, f) for f in STRUCTURES]
        steps += [a - b for a, b in itertools.pairwise(peaks) if not math.isnan(a + b)]
    return f"yes, by {min(steps):.2f} dB at least" if min(steps) > 0.0 else f"no: {min(steps):.2f} dB at worst"


def _sure(o: Optimum) -> str:
    return f"{o.near_best}/{o.starts} {o.leaps_back}/{o.leaps}" if o.status == "optimal" else o.status


def _ends(values: Sequence[float]) -> str:
    return f"{values[0]:.4f} to {values[-1]:.4f}" + (f" ({len(values)} nodes)" if len(values) > 2 else "")


def _n(value: float) -> str:
    return "infeasible" if math.isnan(value) else f"{value:.2f}"
