"""The subcommand `simdesign analyse DESIGN`: the margins of a design at operating points of a flight, and their page.

`simdesign errata` computes the effect of each erratum of the paper on peaks and margins at every operating point.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from maxq.design import operating_points
from maxq.design.case.basis import Basis, stated_basis
from maxq.design.laws.design_file import DESIGN_NAME, design_path, forget_pictures
from maxq.design.loop.fixed_path import Cut, fixed_path
from maxq.design.loop.loop import close_loop
from maxq.design.margins.measure import margins
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node, with_cuts
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import powered_flight
from maxq.design.operating_points import published_nodes
from maxq.design.paper.nodes import PaperNode
from maxq.design.verify.judging import (
    Check,
    JudgedLoop,
    Wanted,
    flies_as_measured,
    judge,
    margins_of_all_axes,
    multiloop_checks,
    stage_checks,
    worst_times_s,
)
from maxq.design.verify.names import stage_name
from maxq.design.verify.uncovered import Uncovered, uncovered
from maxq.sim.files import check_writable, write_whole
from maxq.sim.input.documents import COMMAND_LINE, Source, Text
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading, builtin_files, find, scenarios_folder
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import Progress, aligned, tell
from maxq.tools.design.report import (
    KINDS,
    AnalysisOrder,
    Group,
    analysis_record,
    analysis_report,
    analysis_verdict,
    uncovered_lines,
    uncovered_record,
    uncovered_table,
    write_record,
)

if TYPE_CHECKING:
    from maxq.design.paper.errata_effects import Effect
    from maxq.design.verify.dispersed_limits import WorstOfBasis

RECORD_NAME, PAGE_NAME = "analysis.json", "analysis.html"
_FILE_WIDTH = 1_000_000  # columns: no row of a file is folded
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
    """Analyse a design, write its files and print the report. Return the exit code."""
    if "scenario" not in order.given:
        order = replace(order, scenario=designed_along(order.design))
    scenario, design = load(order.scenario, order.vehicle, order.design)
    path = Path(order.design)
    name = path.parent.name if path.name == DESIGN_NAME and path.parent.name else path.name.removesuffix(".toml")
    wanted = order.page or order.plots
    folder = Path(order.out) if order.out is not None else Path("runs") / f"analyse-{name}" if wanted else None
    bases = bases_of(scenario, design, path.name)
    order = by_basis(order, bases)
    with Progress() as progress:
        progress.show("linearising at the operating points", 0, 0)
        points_s = operating_points_s(scenario, design, order, bases)
        between_s = instants_between(points_s, scenario, order, bases)
        nodes, loss = (
            _found(scenario, order, sorted([*points_s, *between_s]) if between_s else points_s, operating_points.nodes),
            powered_flight(scenario, order.faults)[1],
        )
        if any(basis.bends for basis in bases.values()):
            nodes = with_cuts(nodes, scenario)
        if folder is not None:
            check_writable(folder)
        judged = judge(nodes, design, order.kind, lambda n: progress.show("measuring margins", n, len(nodes)))
        groups = []
        for stage in sorted({node.stage for node in nodes}):
            basis, every = bases.get(stage, Basis()), [j for j in judged if j.node.stage == stage]
            worst_s = worst_times_s(stage_checks(every, design, basis, order.kind))
            mine = [j for j in every if j.time_s in worst_s.union(points_s)]
            found = stage_checks(mine, design, basis, order.kind)
            here = basis.model_copy(update={"loop": order.kind, "errata": order.errata, "plant": order.plant})
            show = partial(progress.show, "measuring all axes together")
            together = margins_of_all_axes(scenario, design, [j.time_s for j in mine], here, show)
            coupled = multiloop_checks(together, Wanted.of(basis.limits))
            worst, off = dispersed_checks(scenario, every, points_s, design, basis, order, progress)
            stage_called = stage_name(scenario.vehicle, stage)
            groups.append(Group(stage_called, mine, found, together, coupled, worst, off))
        judged = [j for group in groups for j in group.judged]
        judged_by = judged_by_text(order, scenario, bases, len(points_s), len(between_s))
        gaps: tuple[Uncovered, ...] = ()
        if not order.times_s and not order.faults:
            alone = [stage for stage, basis in bases.items() if basis.between_nodes != "hold"]
            points = {g.judged[0].node.stage: [j.time_s for j in g.judged] for g in groups}
            gaps = uncovered(scenario, points, order.axis, alone)
        files, verdict, page = [], analysis_verdict(groups, loss), None
        if folder is not None:
            forget_pictures(folder)
            record = analysis_record(name, order, groups, judged_by, loss)
            files.append(write_record(folder / RECORD_NAME, record | {"not_covered": uncovered_record(gaps)}))
            if order.page:
                progress.show("writing the page", 0, 1)
                page = _write_page(folder, name, order, scenario, design, groups, judged_by, verdict, gaps)
                files.append(page)
            if order.plots:
                from maxq.tools.design import pictures  # noqa: PLC0415  # lazy: Matplotlib, with --plots only

                title = f"{scenario.vehicle.name}, {design.name or name}, {order.kind} loop"
                sheets = pictures.judged_sheets(judged, title, Wanted.stated_by(design, judged[0].node.stage))
                files += pictures.draw_all(sheets, folder, progress.show)
    tell(analysis_report(name, order, design, groups, judged_by, loss))
    if gaps:
        tell("", *uncovered_table(scenario.vehicle, gaps))
    tell(f"\n{len(files)} file{'s' * (len(files) > 1)} in {folder}/" if files else "")
    tell(verdict + (f"; page: {page}" if page is not None else ""))
    return Exit.OK if verdict.startswith("PASSED") else Exit.FAILED


def _write_page(
    folder: Path,
    name: str,
    order: AnalysisOrder,
    scenario: LoadedScenario,
    design: Design,
    groups: Sequence[Group],
    judged_by: str,
    verdict: str,
    gaps: Sequence[Uncovered],
) -> Path:
    from maxq.tools.design.page import DesignPage, other_plane, write_page  # noqa: PLC0415  # lazy: with pages only

    judged = [j for group in groups for j in group.judged]
    nodes = partial(_found, scenario, order, make=operating_points.nodes)
    page = DesignPage(
        name=f"{name}: {design.name}" if design.name not in ("", name) else name,
        kind="Analysis of a control design",
        about=f"{judged_by[:1].upper()}{judged_by[1:]}.",
        verdict=verdict,
        passed=verdict.startswith("PASSED"),
        block=(
            ("vehicle", scenario.vehicle.name),
            ("scenario", scenario.name),
            ("plane", order.axis),
            ("loop", KINDS[order.kind]),
            ("errata", order.errata),
            ("plant", order.plant),
        ),
        groups=groups,
        others=other_plane(judged, design, order.kind, lambda times_s, plane: nodes(times_s, axis=plane)),
        wanted=partial(Wanted.stated_by, design),
        design=design,
        vehicle=scenario.vehicle,
        data=[(RECORD_NAME, "limits, margins, lobes and budgets at all operating points")],
        gaps=uncovered_lines(scenario.vehicle, gaps),
        command=_command(order),
    )
    return write_page(folder / PAGE_NAME, page)


def _command(order: AnalysisOrder) -> str:
    """Return the command that repeats an analysis."""
    words = ["simdesign", "analyse", order.design]
    for key in (key for key in order.given if key not in ("design", "plots")):
        if not (value := getattr(order, key)):
            continue
        option = f"--{_WORDS.get(key, key)}"
        for one in value if isinstance(value, tuple) else (value,):
            words += [option] if one is True else [option, f"{one:g}" if isinstance(one, float) else str(one)]
    return shlex.join(words)


def load(scenario: str, vehicle: str | None, design: str) -> tuple[LoadedScenario, Design]:
    """Return the scenario with the design to be analysed, and that design. Its own flight gives the operating points.

    Raises ScenarioError.
    """
    changes = [f'vehicle="{vehicle}"'] if vehicle is not None else []
    flown = load_scenario(scenario, [f'design="{design_path(design)}"', *changes])
    assert flown.design is not None
    return flown, flown.design


def dispersed_checks(
    scenario: LoadedScenario,
    judged: Sequence[JudgedLoop],
    points_s: Sequence[float],
    design: Design,
    basis: Basis,
    order: AnalysisOrder,
    progress: Progress,
) -> tuple[WorstOfBasis | None, list[Check]]:
    """Return the worst vehicles found for a stage's robust basis, and the checks of its limits on them.

    Without a robust basis, return None and no checks. The search uses only the sampled loop of the flown design, and
    includes instants between the operating points only if limits hold there.
    """
    if basis.robust is None or not flies_as_measured(order.kind, order.errata, order.plant):
        return None, []
    from maxq.design.model.deviations import acting_at  # noqa: PLC0415  # lazy, as the next two: with a robust basis
    from maxq.design.model.spread import campaign_of  # noqa: PLC0415
    from maxq.design.verify.dispersed_limits import worst_of_basis  # noqa: PLC0415

    at = [j.flown for j in judged if j.time_s in points_s]
    beside = [j.flown for j in judged if j.time_s not in points_s]
    show = partial(progress.show, "searching dispersed vehicles")
    campaign = acting_at(campaign_of(basis.robust, scenario), basis.robust, judged[0].flown)
    worst = worst_of_basis(at, beside, design, basis.robust, campaign, show)
    limits = basis.model_copy(update={"limits": basis.robust.limits})
    found = stage_checks(judge(worst.nodes, design, order.kind), design, limits, order.kind)
    return worst, [replace(c, key=f"dispersed_{c.key}", text=f"{c.text}, dispersed", short=c.heading) for c in found]


# The design's own basis

_WORDS = {"times_s": "at", "every_s": "every"}
_OPTIONS = {"kind": "loop", "axis": "plane", "errata": "errata", "plant": "plant"}
"""The options, and the keys of a basis that correspond to them."""


def designed_along(design: str) -> str:
    """Return the scenario that the basis of a design names, built in or a file. The default is "nominal".

    Raises ScenarioError for another name, and for a file that does not exist in the working folder.
    """
    source, reading = Source(COMMAND_LINE, (Path.cwd(), scenarios_folder())), Reading()
    path = find(Text.of(design_path(design), source))
    tree = {} if path is None else reading.document(path, design, "design")
    found = [each.get("basis") for each in (tree, *tree.get("stage", ())) if isinstance(each, dict)]
    names = [str(basis["scenario"]) for basis in found if isinstance(basis, dict) and basis.get("scenario")]
    if not names:
        return "nominal"
    if names[0] not in builtin_files("scenario") and not Path(names[0]).is_file():
        allowed = "a built-in scenario or a file; name the scenario of this design with --scenario"
        raise ScenarioError(design, "no such scenario", "basis.scenario", value=names[0], allowed=allowed)
    return names[0]


def bases_of(scenario: LoadedScenario, design: Design, label: str) -> dict[int, Basis]:
    """Return the basis of each stage that states a basis, by the index of the stage. Raises ScenarioError."""
    found = {n: stated_basis(design, n, label) for n in range(len(scenario.vehicle.stage))}
    return {n: basis for n, basis in found.items() if basis is not None}


def by_basis(order: AnalysisOrder, bases: Mapping[int, Basis]) -> AnalysisOrder:
    """Return the order with the loop, plane, errata and plant of the first basis in place of options that are not
    given.
    """
    first = next(iter(bases.values()), Basis())
    return replace(order, **{key: getattr(first, of) for key, of in _OPTIONS.items() if key not in order.given})


def operating_points_s(
    scenario: LoadedScenario, design: Design, order: AnalysisOrder, bases: Mapping[int, Basis]
) -> list[float]:
    """Return the vehicle times at which to judge the design, s.

    They are the requested times, otherwise those of each stage's basis that are under thrust, otherwise the rows of
    the gain tables and every `every_s` between their ends.
    """
    if order.times_s:
        return list(dict.fromkeys(order.times_s))
    times: set[float] = set()
    for span in powered_flight(scenario)[0]:
        gains, stated = design.of_stage(span.stage).gains, bases.get(span.stage, Basis()).nodes_s
        if stated is not None and "every_s" not in order.given:
            times |= {t for t in stated if span.holds(t)}
        elif gains.over != "time_s":
            times |= {t for t in node_times(scenario) if span.holds(t)}
        else:
            rows = [float(t) for t in gains.table["time_s"]]
            between = (round(float(t), 9) for t in np.arange(rows[0], rows[-1], order.every_s))
            times |= {t for t in (*rows, *between) if span.begin_s < t < span.end_s}
    return sorted(times) or list(node_times(scenario))


def instants_between(
    points_s: Iterable[float], scenario: LoadedScenario, order: AnalysisOrder, bases: Mapping[int, Basis]
) -> list[float]:
    """Return instants between the operating points (s) of each stage whose limits also apply between them."""
    out: list[float] = []
    if order.times_s or "every_s" in order.given:
        return out
    for span in powered_flight(scenario)[0]:
        mine = [t for t in points_s if span.holds(t)]
        if mine and bases.get(span.stage, Basis()).between_nodes == "hold":
            from maxq.design.optimise.over_time import instants_beside  # noqa: PLC0415  # lazy: few designs need it

            out += instants_beside(mine)
    return out


def judged_by_text(
    order: AnalysisOrder, scenario: LoadedScenario, bases: Mapping[int, Basis], points: int, between: int
) -> str:
    """Return one line that states whether the design's own basis is used, and its extent: loop, points and limits."""
    count = f"{points} operating point{'s' * (points != 1)}"
    if not bases:
        return f"the design states no basis: judged on the {order.kind} loop at {count}, without limits"
    first = next(iter(bases.values()))
    limits = len({key for basis in bases.values() for key in basis.limits.asked})
    parts = [f"{order.kind} loop", count, f"{limits} limit{'s' * (limits != 1)}"]
    parts += [f"checked between them ({between} instants)"] if between else []
    if any(b.robust is not None for b in bases.values()):
        searched = "also for the worst dispersed vehicles found"
        flies = flies_as_measured(order.kind, order.errata, order.plant)
        parts.append(searched if flies else "for the nominal vehicle only")
    stated = len({t for basis in bases.values() for t in basis.nodes_s or ()})
    others = [
        f"{getattr(order, key)} {option}, designed for {getattr(first, key_of)}"
        for key, key_of in _OPTIONS.items()
        for option in (("loop" if key == "kind" else key),)
        if getattr(order, key) != getattr(first, key_of)
    ]
    if (stated and points != stated) or order.times_s or "every_s" in order.given:
        others.append(f"{count}, designed for {stated or 'those of its flight'}")
    same = Path(order.scenario).resolve() == Path(first.scenario).resolve()
    if first.scenario not in ("", scenario.name) and not same:
        others.append(f"along {scenario.name}, designed along {first.scenario}")
    unstated = [stage_name(scenario.vehicle, n) for n in range(len(scenario.vehicle.stage)) if n not in bases]
    others += [f"{', '.join(unstated)} without limits"] if unstated else []
    if others:
        return f"conditions differ from the design's own: {'; '.join(others)}; judged here: {', '.join(parts)}"
    return f"judged by the design's own basis: {', '.join(parts)}"


def _found(
    scenario: LoadedScenario,
    order: AnalysisOrder,
    times_s: Iterable[float],
    make: Callable[..., list[N]],
    axis: Plane | None = None,
) -> list[N]:
    """Return operating points along the flight.

    Raises ScenarioError for a time outside the powered flight, and for an operating point without a plant.
    """
    try:
        nodes = make(
            scenario, times_s, plane=axis or order.axis, errata=order.errata, plant=order.plant, faults=order.faults
        )
        for node in nodes:
            _ = node.plant  # raises if there is none, before the long work
    except ValueError as error:
        raise ScenarioError(scenario.label, str(error)) from None
    return nodes


# Errata


def execute_errata(order: AnalysisOrder) -> int:
    """Compute and print the effects of the errata. Return the exit code."""
    scenario, design = load(order.scenario, order.vehicle, order.design)
    with Progress() as progress:
        nodes = _found(scenario, order, operating_points_s(scenario, design, order, {}), published_nodes)
        found: list[Effect] = []
        for n, node in enumerate(nodes):
            found += effects([node], design)
            progress.show("switching errata", n + 1, len(nodes))
    if order.out is not None:
        write_whole(Path(order.out), errata_report(found, order, _FILE_WIDTH) + "\n")
    tell(errata_report(found, order))
    return Exit.OK


def effects(nodes: Sequence[PaperNode], design: Design) -> list[Effect]:
    """Return the effect of every erratum at every operating point, on the design's loop with the paper's Pade
    approximants.
    """
    from maxq.design.paper.errata_effects import errata_effects, peaks_db  # noqa: PLC0415  # lazy: for `errata` only

    def measure(node: Node, cut: Cut) -> Mapping[str, float]:
        """Return the peaks and, for the whole loop, its margins. `unstable` is 1 if the loop is unstable."""
        loop = close_loop(fixed_path(node, "pade", cut), design)
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
    """Return a table for each quantity: a row for each erratum, a column for each operating point, printed minus
    corrected.
    """
    times = list(dict.fromkeys(e.node.time_s for e in found))
    names = list(dict.fromkeys(e.erratum for e in found))
    by_place = {(e.erratum, e.node.time_s): e for e in found}
    about = {e.erratum: e.about for e in found}
    head = [
        "errata of Lee, Ahn & Roh: effect of each, left in alone, on the open loop (cut at the gimbal command,",
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
