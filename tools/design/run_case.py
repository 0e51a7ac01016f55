"""`simdesign CASE`: optimise a case, judge what came of it, write and draw it."""

from __future__ import annotations

import math
import re
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.sim.files import FileError, check_writable, write_whole
from maxq.sim.scenario.errors import ScenarioError
from maxq.tools.cli.terminal import Progress, printable

if TYPE_CHECKING:
    from maxq.design.case.read import LoadedCase
    from maxq.design.model.node import Node
    from maxq.design.optimise.plants import Plants
    from maxq.design.optimise.solution import Solution
    from maxq.design.verify.outcome import Outcome
    from maxq.tools.design.orders import Found

_DESIGNED, _INFEASIBLE, _BAD_INPUT, _INTERRUPTED = 0, 1, 2, 130
RECORD_NAME = "design.json"


@dataclass(frozen=True)
class Order:
    """What the command line asks for."""

    case: str
    overrides: tuple[str, ...] = ()
    out: str | None = None
    starts: int | None = None
    seed: int | None = None
    pictures: bool = True
    orders: bool = False


@dataclass(frozen=True)
class Made:
    """What came of a case: the exit code, and the design in its folder. `orders`: those of --orders, else None."""

    code: int
    folder: Path
    outcome: Outcome
    solution: Solution
    orders: Found | None

    @property
    def interrupted(self) -> bool:
        return self.code == _INTERRUPTED

    @property
    def meets_limits(self) -> bool:
        """All limits of the case."""
        return self.outcome.feasible and self.solution.feasible


def execute(order: Order) -> int:
    """Do it; returns the exit code. Whatever is wrong with the input is one line on stderr."""
    try:
        return make(order).code
    except (ScenarioError, FileError) as error:
        print(f"simdesign: {printable(str(error))}", file=sys.stderr)
        return _BAD_INPUT


def make(order: Order) -> Made:
    """Optimise the case, write and print what came of it. Raises ScenarioError."""
    begun_s = time.perf_counter()
    from maxq.design.case.design_file import forget_pictures  # noqa: PLC0415
    from maxq.design.case.read import read_case  # noqa: PLC0415  # lazy, as all imports here
    from maxq.design.optimise.solve import nominal_plants, solve  # noqa: PLC0415  # lazy
    from maxq.design.verify.outcome import judge_solution  # noqa: PLC0415
    from maxq.tools.cli.interruption import Interruption  # noqa: PLC0415
    from maxq.tools.design.case_report import report  # noqa: PLC0415

    more = [
        f"search.{key}={value}" for key, value in (("starts", order.starts), ("seed", order.seed)) if value is not None
    ]
    loaded = read_case(order.case, [*order.overrides, *more])
    folder = Path(order.out or Path("runs") / (re.sub(r"[^\w.-]+", "-", loaded.name).strip(".-") or "design"))
    with Progress() as progress, Interruption(at_once=True) as stop:
        try:
            plants = nominal_plants(loaded)
        except ValueError as error:
            raise ScenarioError(loaded.label, str(error)) from None
        stop.check()
        check_writable(folder)

        def show(done: int, of: int, best_db: float) -> None:
            stop.check()
            note = "" if math.isnan(best_db) else f"best so far {best_db:.2f} dB"
            progress.show("optimising: starts", done, of, note)

        show(0, 1, math.nan)
        solution = solve(loaded, plants, progress=show)  # Ctrl-C ends it with the best so far
        orders, cut_short = None, False
        if order.orders and solution.status != "interrupted":
            try:
                orders = _solve_orders(order, (*order.overrides, *more), plants, progress)
            except KeyboardInterrupt:  # the design itself is there
                cut_short = True
        with Interruption() as interruption:  # what has been found is written, whatever is pressed now
            outcome = judge_solution(loaded, solution, [plant.node for plant in plants.each])
            forget_pictures(folder)  # pictures that an earlier run has left there
            files = _write(folder, outcome, solution, orders)
            if order.pictures and solution.status != "interrupted":
                files += _draw(folder, outcome, progress, interruption)
                if orders is not None:
                    files += _draw_orders(folder, orders, plants)
    print(report(loaded, outcome, solution))
    if orders is not None:
        from maxq.tools.design.orders import orders_table  # noqa: PLC0415

        print("\n" + "\n".join(orders_table(orders)))
    print(f"\n{len(files)} files in {folder}/; {time.perf_counter() - begun_s:.1f} s in all")
    print(_verdict(outcome, solution, folder))
    if solution.status == "interrupted" or cut_short or interruption.requested:
        code = _INTERRUPTED
    else:
        code = _DESIGNED if outcome.feasible and solution.feasible else _INFEASIBLE
    return Made(code, folder, outcome, solution, orders)


def _verdict(outcome: Outcome, solution: Solution, folder: Path) -> str:
    """The last line."""
    from maxq.design.verify.outcome import objective_text  # noqa: PLC0415  # lazy

    fly = f"fly it with: simrun {outcome.loaded.case.scenario} --set design={folder}/design.toml"
    if solution.status == "interrupted":
        state = "it meets all limits" if outcome.feasible else "it misses limits"
        return f"INTERRUPTED: the best so far is kept; {state}"
    if outcome.feasible and solution.feasible:
        return f"DESIGNED: {objective_text(solution)}, all limits met; {fly}"
    why = solution.explanation() or "; ".join(outcome.missed)
    return f"INFEASIBLE: {why}"


def _solve_orders(order: Order, overrides: tuple[str, ...], plants: Plants, progress: Progress) -> Found:
    from maxq.tools.design.orders import solve_orders  # noqa: PLC0415  # lazy

    return solve_orders(order.case, overrides, plants, lambda n, of: progress.show("optimising: orders", n, of))


def _draw_orders(folder: Path, orders: Found, plants: Plants) -> list[Path]:
    from maxq.tools.design.orders import draw_orders  # noqa: PLC0415  # lazy
    from maxq.tools.plots.style import drawing  # noqa: PLC0415

    with drawing():
        return draw_orders(orders, plants, folder)


def _write(folder: Path, outcome: Outcome, solution: Solution, orders: Found | None) -> list[Path]:
    from maxq.design.case.design_file import DESIGN_NAME, design_text  # noqa: PLC0415
    from maxq.tools.design.case_report import comments  # noqa: PLC0415  # lazy
    from maxq.tools.design.record import case_record, write_record  # noqa: PLC0415

    text = design_text(outcome.design, comments(outcome, solution))
    record = case_record(outcome, solution)
    if orders is not None:
        from maxq.tools.design.orders import orders_record, write_orders  # noqa: PLC0415  # lazy

        record["orders"] = orders_record(orders)
    files = [write_whole(folder / DESIGN_NAME, text), write_record(folder / RECORD_NAME, record)]
    return files if orders is None else files + write_orders(orders, folder)


def _draw(folder: Path, outcome: Outcome, progress: Progress, interruption: object) -> list[Path]:
    from maxq.tools.design import album  # noqa: PLC0415  # lazy
    from maxq.tools.plots.style import drawing  # noqa: PLC0415

    loaded = outcome.loaded
    nodes = [j.node for j in outcome.judged]
    along = _along(loaded, nodes)
    sheets = [
        *album.vehicle_sheets(along, [tank.name for tank in loaded.scenario.vehicle.stage[0].tank]),
        *album.design_sheets({loaded.name: outcome.design}, nodes),
        *album.margin_sheets({"": outcome.judged}, outcome.wanted),
        *album.loop_sheets(outcome.judged, f"{loaded.name}, {loaded.case.loop}", outcome.wanted),
    ]
    files: list[Path] = []
    with drawing():
        for n, (stem, draw) in enumerate(sheets):
            if getattr(interruption, "requested", False):
                break
            progress.show("drawing", n, len(sheets))
            files += draw(folder / stem)
    return files


def _along(loaded: LoadedCase, nodes: list[Node]) -> list[Node]:
    """Nodes every half second between the first and the last, for curves over time."""
    from maxq.design import api  # noqa: PLC0415  # lazy

    case = loaded.case
    first, last = nodes[0].time_s, nodes[-1].time_s
    count = max(1, round(2.0 * (last - first)))
    times = [first + (last - first) * k / count for k in range(count + 1)]
    return api.nodes(loaded.scenario, times, plane=case.plane, errata=case.errata, plant=case.plant)
