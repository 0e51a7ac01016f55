"""The page that `simdesign` writes: outcome, limits, open loops, gains and filter, budgets and lobes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from maxq.design.loop.fixed_path import LoopKind
from maxq.design.loop.loop import loops
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.quantities import TOLERANCE
from maxq.design.verify.judging import Check, JudgedLoop, Wanted, judge
from maxq.sim.files import write_whole
from maxq.sim.run.quantities import number_text
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_vehicle import Vehicle
from maxq.tools.design import figures as drawn
from maxq.tools.design.report import GAIN_HEADS, Group, budget_rows, lobes_rows, margins_rows
from maxq.tools.plots.figures import Plot

_TIGHTEST = 3
_SAME = 1e-6
_MARGINS = (
    "time, s",
    "loop",
    "upper gain margin, dB",
    "lower gain margin, dB",
    "phase margin, deg",
    "delay margin, ms",
    "least |1\u00a0+\u00a0L|",
    "clearance of the zone",
    "lower gain margin of the rigid body, dB",
    "upper gain margin of the rigid body, dB",
    "phase margin of the rigid body, deg",
    "crossover, Hz",
)
_MEANINGS = {
    "upper gain margin, dB": "smallest rise of the gain that makes the loop neutrally stable",
    "lower gain margin, dB": "smallest fall of the gain that makes the loop neutrally stable",
    "phase margin, deg": "smallest change of the phase, lag or lead, that makes the loop neutrally stable",
    "delay margin, ms": "smallest additional delay that makes the loop neutrally stable",
    "least |1\u00a0+\u00a0L|": "smallest distance of L from -1; its reciprocal is the peak sensitivity",
    "clearance of the zone": "clearance of L from the diamond of 6 dB and 30 deg: negative inside, 0 on its border, "
    "1 a diamond's width away",
    "crossover, Hz": "last gain crossover outside lobes, the bandwidth",
    "at Hz": "frequency of the crossing that sets the margin",
    "V/F": "gyro pulses counted over one sample",
    "hold": "command held over one sample",
    "sum": "gain or phase of L at the crossing",
    "left": "margin: distance of the sum from 0 dB or -180 deg",
}
"""The meanings of the columns in the tables of margins and budgets, by head."""
_TRIED_HZ = np.geomspace(0.02, 20.0, 40)
PageTable = tuple[str, Sequence[tuple[str, ...]]]
"""The caption of a table, and its rows, beginning with the head."""


@dataclass(frozen=True)
class DesignPage:
    """The content of a page.

    - `verdict`: the outcome in capitals, a colon and the reason.
    - `block`: rows of the title block.
    - `others`: the open loops of the other plane, if they differ.
    - `wanted`: a function that returns the limits of a stage.
    - `data`: the names of files in the same folder, and their content.
    - `gaps`: intervals without operating points.
    - `flown`: captions and checks of the same design as it flies.
    - `more`: headings, notes and tables that follow all others.
    - `texts`: headings and lines of tables in the form of the terminal.
    """

    name: str
    kind: str
    about: str
    verdict: str
    passed: bool
    block: tuple[tuple[str, str], ...]
    groups: Sequence[Group]
    others: Sequence[JudgedLoop]
    wanted: Callable[[int], Wanted]
    design: Design
    vehicle: Vehicle
    data: Sequence[tuple[str, str]]
    gaps: Sequence[str] = ()
    flown: Sequence[tuple[str, Sequence[Check]]] = ()
    more: Sequence[tuple[str, str, Sequence[PageTable]]] = ()
    texts: Sequence[tuple[str, Sequence[str]]] = ()
    command: str = ""


def other_plane(
    judged: Sequence[JudgedLoop],
    design: Design,
    kind: LoopKind,
    nodes: Callable[[list[float], Plane], list[Node]],
    watch: Callable[[int], None] | None = None,
) -> list[JudgedLoop]:
    """Return the loops of the plane that was not judged, or none if they are equal to those of the judged plane.

    `nodes` returns the operating points at vehicle times (s) in a plane.
    """
    plane: Plane = "yaw" if judged[0].node.plane == "pitch" else "pitch"
    found = nodes([j.time_s for j in judged], plane)
    pairs = zip(judged, loops(found, design, kind=kind), strict=True)
    if all(_close(one.loop.response(_hz(one)), other.response(_hz(one))) for one, other in pairs):
        return []
    return judge(found, design, kind, watch)


def _hz(judged: JudgedLoop) -> np.ndarray:
    highest = float(judged.margins.curve.frequency_hz[-1])
    return _TRIED_HZ[highest > _TRIED_HZ]


def _close(one: np.ndarray, other: np.ndarray) -> bool:
    return bool((np.abs(one - other) <= _SAME * np.abs(one)).all())


def write_page(path: Path, shown: DesignPage) -> Path:
    """Write the page, and return its path. Raises FileError."""
    from maxq.tools.pages.render import render  # noqa: PLC0415  # lazy: for the page only

    checks = [replace(c, text=_named(g.stage, c.text)) for g in shown.groups for c in g.checks]
    bounded = [c for c in checks if not c.passed or not drawn.is_stability(c)]
    first = sorted(bounded, key=lambda c: (c.passed, _nearest(c)))[:_TIGHTEST]
    page = render(
        "design.html.j2",
        _plots(shown),
        shown=shown,
        tone="good" if shown.passed else "bad",
        tightest=[(_sentence(c), _outcome(c)) for c in first],
        limits=[
            *((_caption(g), [check_row(c) for c in g.checks]) for g in shown.groups),
            *((caption, [check_row(c) for c in checks]) for caption, checks in shown.flown if checks),
        ],
        tables=[*_tables(shown.groups), *shown.more],
        meanings=_MEANINGS,
        gain_heads=GAIN_HEADS,
    )
    return write_whole(path, page)


def _named(stage: str, text: str) -> str:
    return f"{stage}: {text}" if stage else text


def _caption(group: Group) -> str:
    worst = f"dispersed: {group.worst.text}" if group.worst is not None else ""
    return "; ".join(filter(None, (titled("Limits", group.stage), worst)))


def titled(what: str, stage: str) -> str:
    """Return a title, followed by the name of its stage if there are several."""
    return f"{what}, {stage}" if stage else what


def _nearest(check: Check) -> float:
    """Return the least margin of a check as a share of its limit, or infinity if it has none."""
    left = drawn.relative_margin(check)
    return float(np.nanmin(left)) if np.isfinite(left).any() else math.inf


def _outcome(check: Check) -> str:
    return "met" if check.passed else "missed"


def _cells(check: Check) -> tuple[str, str, str, str]:
    """Return the cells of a check: its limit, the worst value, the margin to the limit, and the place."""
    k, unit = check.worst, f" {check.unit}" if check.unit else ""
    value = float(check.values[k])
    left = value - check.wanted if check.sense == ">=" else check.wanted - value
    left = 0.0 if check.passed and left < TOLERANCE else left
    at = f"{check.time_s[k]:g} s" if math.isfinite(check.time_s[k]) else "filter"
    worst = number_text(value) if math.isfinite(value) else "none"
    margin = f"{left:z.{len(worst.partition('.')[2])}f}{unit}" if math.isfinite(left) else ""  # as exact as the value
    return f"{check.sense} {check.wanted:g}{unit}", worst + unit * math.isfinite(value), margin, at


def check_row(check: Check) -> tuple[str, ...]:
    limit, value, left, at = _cells(check)
    if drawn.is_stability(check):
        limit, value, left = "0", f"{float(check.values[check.worst]):g}" if not check.passed else "0", ""
        at = "" if check.passed else at
    return check.text, limit, value, left, at, _outcome(check)


def _sentence(check: Check) -> str:
    limit, value, left, at = _cells(check)
    where = "" if at == "filter" else f" at {at}"
    return f"{check.text}: {value}{where}, limit {limit}" + (f", margin to limit {left}" if left else "")


def _plots(shown: DesignPage) -> list[Plot]:
    judged, names, wanted, planes = list[JudgedLoop](), list[str](), list[Wanted](), list[str]()
    mine = [(g.stage, j) for g in shown.groups for j in g.judged]
    stages = {j.node.stage: stage for stage, j in mine}
    for some in ([j for _, j in mine], shown.others):
        for j in sorted(some, key=lambda j: j.time_s):
            stage, plane = stages[j.node.stage], str(j.node.plane) if shown.others else "pitch and yaw"
            judged.append(j)
            names.append(", ".join(filter(None, (f"{j.time_s:g} s", stage, plane))))
            wanted.append(shown.wanted(j.node.stage))
            planes.append(plane)
    checks = [c for g in shown.groups for c in g.checks]
    return [
        *drawn.limits_over_flight(checks),
        drawn.explorer(judged, names, wanted, planes),
        drawn.gains_plot(shown.design, GAIN_HEADS),
        drawn.filter_plot(shown.vehicle, shown.design, [j.flown for _, j in mine]),
    ]


def _tables(groups: Sequence[Group]) -> list[tuple[str, str, Sequence[PageTable]]]:
    """Return the headings, notes and tables of the margins, budgets and lobes."""
    margins, budgets, lobes = list[PageTable](), list[PageTable](), list[PageTable]()
    for g in groups:
        _, _, *rows = margins_rows([(j.time_s, j.margins) for j in g.judged])
        margins.append((titled("Margins", g.stage), [_MARGINS, *rows]))
        for crossing, unit, found in (
            ("phase margin", "deg", budget_rows(g.judged, "phase margin", "phase_deg")),
            ("upper gain margin", "dB", budget_rows(g.judged, "upper gain margin", "gain_db")),
        ):
            if found:
                budgets.append((titled(f"Budget of the {crossing}, {unit}", g.stage), found))
        if rows := lobes_rows(g.judged):
            lobes.append((titled("Lobes", g.stage), rows))
    parts = (
        ("Margins", "Over all crossings, unless a column states the rigid body.", margins),
        ("Error budgets", "Contribution of each part to gain or phase at the crossing that sets the margin.", budgets),
        ("Lobes", "Peak in dB. G: gain-stabilised; P: phase-stabilised, with its phase margin in degrees.", lobes),
    )
    return [part for part in parts if part[2]]
