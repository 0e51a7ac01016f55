"""The effect of each erratum on a loop: each switched alone from corrected to as printed, and all of them together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from maxq.design.loop.fixed_path import Cut
from maxq.design.loop.loop import Loop
from maxq.design.loop.resonance import Resonance
from maxq.design.paper.errata import ABOUT, CORRECTED, PAPER, Erratum, one_at_a_time
from maxq.design.paper.nodes import PaperNode

Measure = Callable[[PaperNode, Cut], Mapping[str, float]]
"""A measure that returns named numbers of the loop at an operating point, opened at a cut."""

OPENED = Erratum("16", "42", "opened from q_c to q", "opened at the gimbal command")
TOGETHER = Erratum("all", "1 to 28", "every switch of the preset paper", "every switch of the preset corrected")
EXPLAINED = {**ABOUT, "opened_at": OPENED, "paper": TOGETHER}


@dataclass(frozen=True)
class Effect:
    """The effect of an uncorrected erratum at one operating point, as named results of a measure.

    If the loop does not exist, for example because the vehicle lacks the affected parts, `error` gives the reason.
    """

    erratum: str  # a key of EXPLAINED
    node: PaperNode
    corrected: Mapping[str, float]
    printed: Mapping[str, float]
    error: str = ""

    @property
    def about(self) -> Erratum:
        return EXPLAINED[self.erratum]

    def change(self, name: str) -> float:
        """Return the printed minus the corrected value, or nan if either is missing."""
        return self.printed.get(name, float("nan")) - self.corrected.get(name, float("nan"))


def errata_effects(nodes: Iterable[PaperNode], measure: Measure) -> list[Effect]:
    """Return the effects by operating point, with errata in the order of EXPLAINED.

    The errata of the operating points themselves are ignored.
    """
    cut: Cut = "gimbal_command"
    out = []
    for node in nodes:
        cases = [(name, errata, cut) for name, errata in one_at_a_time()]
        literal: Cut = "rate_command_to_q"
        right = node.with_errata(CORRECTED)
        cases += [("opened_at", right.errata, literal), ("paper", PAPER, cut)]
        corrected = dict(measure(right, cut))
        for name, errata, opened in cases:
            try:
                out.append(Effect(name, node, corrected, dict(measure(node.with_errata(errata), opened))))
            except ValueError as problem:
                out.append(Effect(name, node, corrected, {}, str(problem)))
    return out


def peaks_db(loop: Loop) -> dict[str, float]:
    """Return the peak of |L| (dB) within the half-widths of each lightly damped pole of bending and slosh, by label."""
    return {r.label: peak_db(loop, r) for r in loop.fixed.resonances() if r.kind in ("bending", "slosh")}


def peak_db(loop: Loop, resonance: Resonance) -> float:
    """Return the largest |L| (dB) within a half-width of a resonance, to 1e-6 dB.

    On a steep slope, as near slosh, |L| may have no maximum. The result is then the value at the edge.
    """
    low, high = (resonance.frequency_hz + side * resonance.half_width_hz for side in (-1.0, 1.0))
    low, high = max(low, 1e-6), min(high, loop.highest_hz)
    best = 0.0
    for _ in range(5):
        f = np.linspace(low, high, 17)
        size = np.abs(loop.response(f))
        k = int(np.argmax(size))
        low, high, best = f[max(k - 1, 0)], f[min(k + 1, 16)], float(size[k])
    return float(20.0 * np.log10(best)) if best > 0.0 else -math.inf
