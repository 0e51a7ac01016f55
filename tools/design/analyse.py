"""`simdesign analyse DESIGN`: margins and pictures of a design at nodes of a flight.

`simdesign errata`: what each erratum of the paper does to peaks and margins at every node.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from maxq.design import api
from maxq.design.laws.design_file import DESIGN_NAME, design_path, forget_pictures
from maxq.design.loop.fixed_path import Cut, fixed_path
from maxq.design.margins.measure import margins
from maxq.design.margins.multiloop import MultiloopMargins, multiloop_margins
from maxq.design.model.node import Node, node_times, powered_flight
from maxq.design.paper.errata_effects import Effect, errata_effects, peaks_db
from maxq.design.paper.nodes import PaperNode
from maxq.design.verify.judging import Wanted, checks, judge, multiloop_checks
from maxq.design.verify.verify import stage_name
from maxq.sim.files import check_writable, write_whole
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import Progress, aligned, tell
from maxq.tools.design.report import (
    AnalysisOrder,
    Group,
    analysis_record,
    analysis_report,
    analysis_verdict,
    write_record,
)

RECORD_NAME = "analysis.json"
_FILE_WIDTH = 1_000_000  # whole rows
_UNSTABLE = "unstable"
QUANTITIES = {
    "peak 1": "peak of mode 1, dB",
    "peak 2": "peak of mode 2, dB",
    "peak 3": "peak of mode 3, dB",
    "gain": "gain margin (least of up and down), dB",
    "phase": "phase margin, deg",
    "slosh": "highest peak of slosh, dB",
}

N = TypeVar("N", bound=Node)


def execute(order: AnalysisOrder) -> int:
    """Do it; returns the exit code."""
    scenario, design = load(order.scenario, order.vehicle, order.design)
    path = Path(order.design)
    name = path.parent.name if path.name == DESIGN_NAME and path.parent.name else path.name.removesuffix(".toml")
    folder = Path(order.out) if order.out is not None else Path("runs") / f"analyse-{name}" if order.pictures else None
    with Progress() as progress:
        nodes, loss = find_nodes(scenario, design, order), powered_flight(scenario, order.faults)[1]
        if folder is not None:
            check_writable(folder)
        judged = judge(nodes, design, order.kind, lambda n: progress.show("measuring margins", n, len(nodes)))
        groups = []
        for stage in sorted({node.stage for node in nodes}):
            wanted, mine = Wanted.of(design.of_stage(stage).limits), [j for j in judged if j.node.stage == stage]
            together = all_axes(scenario, design, [j.time_s for j in mine], order, progress)
            coupled = multiloop_checks(together, wanted)
            name_of = stage_name(scenario.vehicle, stage)
            groups.append(Group(name_of, mine, checks(mine, design, wanted), together, coupled))
        files = []
        if folder is not None:
            forget_pictures(folder)
            files.append(write_record(folder / RECORD_NAME, analysis_record(name, order, groups, loss)))
            if order.pictures:
                from maxq.tools.design import pictures  # noqa: PLC0415  # lazy: matplotlib, not with --no-pictures

                title = f"{scenario.vehicle.name}: {design.name or name}, {order.kind}"
                sheets = pictures.judged_sheets(judged, title, Wanted.of(design.limits))
                files += pictures.draw_all(sheets, folder, progress.show)
    tell(analysis_report(name, order, design, groups, loss))
    tell(f"\n{len(files)} files in {folder}/" if files else "")
    verdict = analysis_verdict(groups, loss)
    tell(verdict)
    return Exit.OK if verdict.startswith("PASSED") else Exit.FAILED


def all_axes(
    scenario: LoadedScenario, design: Design, times_s: Sequence[float], order: AnalysisOrder, progress: Progress
) -> list[MultiloopMargins]:
    """Margins of all axes together; none of a vehicle or a computer other than what flies."""
    if (order.kind, order.errata, order.plant) != ("sampled", "corrected", "flown"):
        return []
    out = []
    progress.show("measuring all axes together", 0, len(set(times_s)))
    for loop in api.multiloops(scenario, design, times_s):
        out.append(multiloop_margins(loop))
        progress.show("measuring all axes together", len(out), len(set(times_s)))
    return out


def load(scenario: str, vehicle: str | None, design: str) -> tuple[LoadedScenario, Design]:
    """The scenario with the design to judge, whose own flight gives the operating points, and that design.

    Raises ScenarioError.
    """
    changes = [f'vehicle="{vehicle}"'] if vehicle is not None else []
    flown = load_scenario(scenario, [f'design="{design_path(design)}"', *changes])
    assert flown.design is not None
    return flown, flown.design


def find_nodes(scenario: LoadedScenario, design: Design, order: AnalysisOrder) -> list[Node]:
    """Nodes along the flight, by default at the rows of the gain tables and every `every_s` between their ends, as far
    as they lie under thrust.

    Raises ScenarioError for a time outside the powered flight.
    """
    return _found(scenario, design, order, api.nodes)


def _found(scenario: LoadedScenario, design: Design, order: AnalysisOrder, make: Callable[..., list[N]]) -> list[N]:
    try:
        times_s = order.times_s or _gain_times(scenario, design, order.every_s)
        nodes = make(
            scenario, times_s, plane=order.axis, errata=order.errata, plant=order.plant, faults=order.faults
        )  # fmt: skip  # nine lines otherwise
        for node in nodes:
            _ = node.plant  # raises where there is none, before the long work
    except ValueError as error:
        raise ScenarioError(scenario.label, str(error)) from None
    return nodes


def _gain_times(scenario: LoadedScenario, design: Design, every_s: float) -> list[float]:
    times: set[float] = set()
    for span in powered_flight(scenario)[0]:
        gains = design.of_stage(span.stage).gains
        if gains.over != "time_s":
            return list(node_times(scenario))
        rows = [float(t) for t in gains.table["time_s"]]
        between = (round(float(t), 9) for t in np.arange(rows[0], rows[-1], every_s))
        times |= {t for t in (*rows, *between) if span.begin_s < t < span.end_s}
    return sorted(times) or list(node_times(scenario))


# errata


def execute_errata(order: AnalysisOrder) -> int:
    """Do it; returns the exit code."""
    scenario, design = load(order.scenario, order.vehicle, order.design)
    with Progress() as progress:
        nodes = _found(scenario, design, order, api.published_nodes)
        found: list[Effect] = []
        for n, node in enumerate(nodes):
            found += effects([node], design)
            progress.show("switching errata", n + 1, len(nodes))
    if order.out is not None:
        write_whole(Path(order.out), errata_report(found, order, _FILE_WIDTH) + "\n")
    tell(errata_report(found, order))
    return Exit.OK


def effects(nodes: Sequence[PaperNode], design: Design) -> list[Effect]:
    """Of every erratum at every node, on the design's loop with the paper's Pade approximants."""

    def measure(node: Node, cut: Cut) -> Mapping[str, float]:
        """Peaks, and for the whole loop its margins; `unstable` is 1 where it is not stable."""
        loop = api.close(fixed_path(node, "pade", cut), design)
        peaks = peaks_db(loop)
        out = {f"peak {i}": peaks[f"bending {i}"] for i in (1, 2, 3) if f"bending {i}" in peaks}
        slosh = [db for name, db in peaks.items() if name.startswith("slosh")]
        if slosh:
            out["slosh"] = max(slosh)
        if cut == "gimbal_command":
            m = margins(loop, resonances=loop.fixed.resonances(), zones=())
            out |= {"gain": min(m.gain_up_db.value, m.gain_down_db.value), "phase": m.phase_deg.value}
            out[_UNSTABLE] = float(not m.stable)
        return out

    return errata_effects(nodes, measure)


def errata_report(found: Sequence[Effect], order: AnalysisOrder, width: int | None = None) -> str:
    """A table of every quantity: a row an erratum, a column a node; printed less corrected."""
    times = list(dict.fromkeys(e.node.time_s for e in found))
    names = list(dict.fromkeys(e.erratum for e in found))
    by_place = {(e.erratum, e.node.time_s): e for e in found}
    about = {e.erratum: e.about for e in found}
    head = [
        "errata of Lee, Ahn & Roh: what each does, left in alone, to the open loop (cut at the gimbal command,",
        f"paper's Pade approximants) of {order.design} along {order.scenario}; plant: {order.plant}",
    ]
    rows = [("nr", "switch", "equations", "as printed", "corrected")]
    rows += [(a.number, name, a.equations, a.printed, a.corrected) for name, a in about.items()]
    parts = [head, aligned(rows, width=width)]
    for key, title in QUANTITIES.items():
        if not any(key in e.corrected for e in found):
            continue
        table = [("time, s", *(f"{t:g}" for t in times))]
        table.append(("corrected", *(_cell(by_place[names[0], t].corrected.get(key, math.nan)) for t in times)))
        table += [(name, *(_change(by_place[name, t], key) for t in times)) for name in names]
        right = tuple(range(1, 1 + len(times)))
        parts.append([f"{title}: as printed less corrected", *aligned(table, "  ", right, width=width)])
    legend = "unst.: the loop as printed is unstable and has no margin; -: the loop has none of it, or cannot be made"
    errors = dict.fromkeys(f"{e.erratum}: {e.error}" for e in found if e.error)
    parts.append([legend, *errors])
    return "\n\n".join("\n".join(part) for part in parts)


def _change(effect: Effect, key: str) -> str:
    if key in ("gain", "phase") and effect.printed.get(_UNSTABLE, 0.0) > 0.0:
        return "unst."
    return _cell(effect.change(key), sign="+")


def _cell(value: float, sign: str = "") -> str:
    return "-" if math.isnan(value) else "inf" if math.isinf(value) else f"{value:{sign}.2f}"
