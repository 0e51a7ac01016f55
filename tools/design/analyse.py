"""`simdesign analyse DESIGN`: margins and pictures of any design at nodes of a flight."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxq.sim.files import FileError, check_writable
from maxq.sim.scenario.errors import ScenarioError
from maxq.tools.cli.terminal import Progress, printable

if TYPE_CHECKING:
    from maxq.design.api import Plant
    from maxq.design.loop.fixed_path import Kind
    from maxq.design.model.node import Node
    from maxq.design.model.vehicle_at import Plane
    from maxq.design.verify.judging import Check, Judged, Wanted
    from maxq.sim.scenario.loader import LoadedScenario
    from maxq.sim.scenario.schema_design import Design

_PASSED, _FAILED, _BAD_INPUT = 0, 1, 2
EVERY_S = 5.0
RECORD_NAME = "analysis.json"


@dataclass(frozen=True)
class Order:
    """What the command line asks for."""

    design: str
    scenario: str = "nominal"
    vehicle: str | None = None
    times_s: tuple[float, ...] = ()
    kind: Kind = "sampled"
    axis: Plane = "pitch"
    errata: str = "corrected"
    plant: Plant = "flown"
    out: str | None = None
    pictures: bool = True


def execute(order: Order) -> int:
    """Do it; returns the exit code. Whatever is wrong with the input is one line on stderr."""
    try:
        return _execute(order)
    except (ScenarioError, FileError) as error:
        print(f"simdesign: {printable(str(error))}", file=sys.stderr)
        return _BAD_INPUT


def _execute(order: Order) -> int:
    from maxq.design.case.design_file import forget_pictures  # noqa: PLC0415  # lazy, as all here
    from maxq.design.verify.judging import Wanted, checks, judge  # noqa: PLC0415  # lazy
    from maxq.tools.design.record import analysis_record, write_record  # noqa: PLC0415  # lazy

    scenario, design = load(order.scenario, order.vehicle, order.design)
    name = _name(order.design)
    folder = _folder(order, name)
    times_s = order.times_s or default_times_s(design)
    with Progress() as progress:
        nodes = find_nodes(scenario, times_s, order.axis, order.errata, order.plant)
        if folder is not None:
            check_writable(folder)
        judged = judge(
            nodes,
            design,
            order.kind,
            lambda n: progress.show("measuring margins", n, len(nodes)),
        )
        wanted = Wanted.of(design.limits) if design.limits else Wanted()
        found = checks(judged, design, wanted)
        files = []
        if folder is not None:
            forget_pictures(folder)
            title = f"{design.name or name}, {order.axis}, {order.kind}"
            files.append(write_record(folder / RECORD_NAME, analysis_record(name, order, judged, found)))
            if order.pictures:
                files += _draw(folder, title, design, scenario, judged, wanted, progress)
    print(report(name, order, design, judged, found))
    print(f"\n{len(files)} files in {folder}/" if files else "")
    print(verdict(found))
    return _PASSED if all(check.passed for check in found) else _FAILED


def load(scenario: str, vehicle: str | None, design: str) -> tuple[LoadedScenario, Design]:
    """The scenario whose flight is linearised, and the design to judge. Raises ScenarioError.

    The flight is that with the scenario's own design, as that of a case is: so a design is judged at the conditions for
    which it was made. A scenario without one flies the design that is judged.
    """
    from maxq.design.case.design_file import design_path  # noqa: PLC0415  # lazy
    from maxq.sim.scenario.loader import load_scenario  # noqa: PLC0415  # lazy

    changes = [f'vehicle="{vehicle}"'] if vehicle is not None else []
    with_it = load_scenario(scenario, [f'design="{design_path(design)}"', *changes])
    assert with_it.design is not None
    own = load_scenario(scenario, changes)
    return (own if own.design is not None else with_it), with_it.design


def default_times_s(design: Design) -> list[float]:
    """The rows of the gain table, and every five seconds between its ends."""
    rows = [float(t) for t in design.gains.table["time_s"]]
    count = int((rows[-1] - rows[0]) // EVERY_S)
    return sorted({*rows, *(rows[0] + EVERY_S * k for k in range(count + 1))})


def find_nodes(
    scenario: LoadedScenario,
    times_s: Sequence[float],
    axis: Plane = "pitch",
    errata: str = "corrected",
    plant: Plant = "flown",
) -> list[Node]:
    """Nodes along the flight. Raises ScenarioError for a time outside the powered flight."""
    from maxq.design import api  # noqa: PLC0415  # lazy

    try:
        nodes = api.nodes(scenario, times_s, plane=axis, errata=errata, plant=plant)
        for node in nodes:
            _ = node.plant  # where there is none, say so before the work
    except ValueError as error:
        raise ScenarioError(scenario.label, str(error), allowed="times under thrust") from None
    return nodes


def report(name: str, order: Order, design: Design, judged: Sequence[Judged], found: Sequence[Check]) -> str:
    """All that is printed."""
    from maxq.tools.design import tables  # noqa: PLC0415  # lazy

    what = {"sampled": "sampled, as it flies", "pade": "the paper's Pade approximants", "exact": "without aliasing"}
    where = f"along {order.scenario}, {order.axis}; loop opened at the gimbal command; {what[order.kind]}"
    if order.errata != "corrected" or order.plant != "flown":
        where += f"; errata: {order.errata}; plant: {order.plant}"
    head = [printable(f"{name}: {design.name}" if design.name else name), where]
    parts = [
        head, tables.margins_table(judged), tables.lobes_table(judged),
        tables.budget_table(judged, "phase margin", "phase_deg"),
        tables.budget_table(judged, "gain margin up", "gain_db"), tables.limits_table(found),
    ]  # fmt: skip
    if len(found) > 1:
        parts.append(tables.nodes_table(found, [j.time_s for j in judged]))
    return "\n\n".join("\n".join(part) for part in parts if part)


def verdict(found: Sequence[Check]) -> str:
    """The last line."""
    missed = [check.text for check in found if not check.passed]
    if not missed:
        return "PASSED: stable" + (
            f", all {len(found) - 1} limits met" if len(found) > 1 else "; the design states no limits"
        )
    return "FAILED: " + ", ".join("unstable" if text == "unstable poles" else f"{text} missed" for text in missed)


def _folder(order: Order, name: str) -> Path | None:
    if order.out is not None:
        return Path(order.out)
    return Path("runs") / f"analyse-{name}" if order.pictures else None


def _name(design: str) -> str:
    path = Path(design)
    return path.parent.name if path.name == "design.toml" and path.parent.name else path.name.removesuffix(".toml")


def _draw(
    folder: Path, title: str, design: Design, scenario: LoadedScenario, judged: Sequence[Judged], wanted: Wanted,
    progress: Any,
) -> list[Path]:  # fmt: skip
    from maxq.tools.design.album import loop_sheets, margin_sheets  # noqa: PLC0415  # lazy

    sheets = [*margin_sheets({"": judged}, wanted), *loop_sheets(judged, title, wanted)]
    files = []
    from maxq.tools.plots.style import drawing  # noqa: PLC0415  # lazy

    with drawing():
        for n, (stem, draw) in enumerate(sheets):
            progress.show("drawing", n, len(sheets))
            files += draw(folder / stem)
    return files
