"""What is left of a design where the vehicle is not quite as it should be: sampled loop, every node, many vehicles."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design import api
from maxq.design.case.schema import Robust
from maxq.design.model.node import Node
from maxq.design.optimise.robust import DEVIATIONS, deviated
from maxq.sim.scenario.schema_design import Design
from maxq.tools.design.judging import judge
from maxq.tools.plots.palette import GREY
from maxq.tools.plots.style import MARKERS, curve, label, save, sheet

FACTORS = tuple(np.round(np.linspace(0.85, 1.15, 13), 3))
CORNERS, SEED = 40, 2002


@dataclass(frozen=True)
class Left:
    """The worst over all nodes of one vehicle; NaN margins where a node is unstable."""

    unstable_nodes: int
    gain_db: float
    phase_deg: float
    modulus: float
    delay_s: float
    first_mode_db: float


def worst(nodes: Sequence[Node], design: Design) -> Left:
    """Of these nodes."""
    judged = judge(nodes, design, "sampled")
    lost = sum(not j.margins.stable for j in judged)
    if lost:
        margins = (math.nan, math.nan, math.nan, math.nan)
    else:
        margins = (
            min(j.gain_margin_db for j in judged),
            min(j.margins.phase_deg.value for j in judged),
            min(j.margins.modulus for j in judged),
            min(j.margins.delay_s.value for j in judged),
        )
    return Left(lost, *margins, max(j.peak_db(1) for j in judged))


def bending_sweep(nodes: Sequence[Node], design: Design, factors: Sequence[float] = FACTORS) -> list[Left]:
    """All bending frequencies times a factor."""
    return [worst([node.with_(bending_frequency=float(f)) for node in nodes], design) for f in factors]


def corners(nodes: Sequence[Node], design: Design, ranges: Robust, count: int = CORNERS) -> list[Left]:
    """Corners of the ranges drawn at random, the same for every design: not those for which one was made."""
    rng = np.random.default_rng(SEED)
    ends = rng.choice([-1, 1], (count, len(DEVIATIONS)))
    return [worst([deviated(node, ranges, [int(e) for e in row]) for node in nodes], design) for row in ends]


def side_by_side(designs: Mapping[str, Design], times_s: Sequence[float] = api.PAPER_TIMES_S) -> list[str]:
    """Markdown: nominal and dispersed, a row a design."""
    nodes = api.nodes("nominal", times_s)
    ranges = Robust()
    lines = [
        "| design | mode 1 peak, dB | gain, dB | phase, deg | least \\|1+L\\| | delay, ms | mode 1 at -10 %, dB | "
        f"stable over bending | stable at {CORNERS} corners | gain there, dB | phase, deg | least \\|1+L\\| |",
        "|---|---:|---:|---:|---:|---:|---:|---|---:|---:|---:|---:|",
    ]
    for name, design in designs.items():
        nominal = worst(nodes, design)
        lower = worst([node.with_(bending_frequency=0.9) for node in nodes], design)
        sweep = bending_sweep(nodes, design)
        off = corners(nodes, design, ranges)
        held = [o for o in off if o.unstable_nodes == 0]
        lines.append(
            f"| {name} | {_n(nominal.first_mode_db, 1)} | {_n(nominal.gain_db, 2)} | {_n(nominal.phase_deg, 1)} | "
            f"{_n(nominal.modulus, 3)} | {_n(1e3 * nominal.delay_s, 0)} | {_n(lower.first_mode_db, 1)} | "
            f"{_stable_range(sweep)} | {len(held)} | "
            f"{_n(_least(off, 'gain_db'), 2)} | {_n(_least(off, 'phase_deg'), 1)} | {_n(_least(off, 'modulus'), 3)} |"
        )
    return lines


def _stable_range(sweep: Sequence[Left]) -> str:
    """The run of factors around 1 without an unstable node, in percent."""
    good = [left.unstable_nodes == 0 for left in sweep]
    k = int(np.argmin(np.abs(np.array(FACTORS) - 1.0)))
    if not good[k]:
        return "not even nominal"
    low, high = k, k
    while low > 0 and good[low - 1]:
        low -= 1
    while high < len(good) - 1 and good[high + 1]:
        high += 1
    percent: Array = 100.0 * (np.array(FACTORS) - 1.0)
    return f"{percent[low]:+.1f} to {percent[high]:+.1f} %"


def _least(off: Sequence[Left], name: str) -> float:
    """The least over all corners, if all are stable."""
    values = [getattr(o, name) for o in off]
    return math.nan if any(math.isnan(v) for v in values) else min(values)


def _n(value: float, digits: int) -> str:
    return "unstable" if math.isnan(value) else f"{value:.{digits}f}"


def draw_sweep(swept: Mapping[str, Sequence[Left]], stem: Path) -> list[Path]:
    """Least |1 + L| and the first mode's peak over the bending frequencies; nothing where a node is unstable."""
    percent = 100.0 * (np.array(FACTORS) - 1.0)
    figure, places = sheet(1, 2, height_in=3.0)
    for k, (name, left) in enumerate(swept.items()):
        places[0].plot(percent, [each.modulus for each in left], marker=MARKERS[k], **curve(k), label=name)
        places[1].plot(percent, [each.first_mode_db for each in left], marker=MARKERS[k], **curve(k))
    places[0].set_ylim(bottom=0.0)
    places[1].axhline(0.0, color=GREY, linewidth=0.8)
    for place, text in zip(places, ("least |1 + L| over all nodes", "largest peak of mode 1, dB"), strict=True):
        label(place, "bending frequencies, % off (no point: unstable)" if place is places[0] else "", text)
    label(places[1], "bending frequencies, % off")
    places[0].legend()
    return save(figure, stem)
