"""The subcommand `simdesign CASE`: optimise a case, judge the design, and write and draw it.

--orders adds the paper's filters and gain schedules: its Fig. 9, and the designs of Figs 7, 8, 11 to 14.
"""

from __future__ import annotations

import math
import shlex
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import partial
from itertools import product, zip_longest
from multiprocessing import get_context
from pathlib import Path

from pydantic import ValidationError

from maxq.control.kernel.machine import cores
from maxq.control.structures import STRUCTURES as KNOWN
from maxq.design import operating_points
from maxq.design.case.schema import LoadedCase, read_case
from maxq.design.laws.design_file import DESIGN_NAME, design_text, forget_pictures
from maxq.design.laws.law import DesignedLaw
from maxq.design.laws.schedule import UnsolvableError
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.model.powered import loss_text
from maxq.design.optimise.pareto import Aim, aims_of, check_aims, trade_off
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.search import SearchProgress as Watch
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import each_stage, solve
from maxq.design.optimise.way_out import tried
from maxq.design.verify.judging import Check, JudgedLoop, Wanted
from maxq.design.verify.names import stage_name
from maxq.design.verify.outcome import DesignOutcome, make_design, objective_text
from maxq.design.verify.own_flight import CaseDesign, design_case
from maxq.sim.files import check_writable, plain_name, write_whole
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import Exit, Interruption
from maxq.tools.cli.terminal import Progress, aligned, tell
from maxq.tools.design.page import DesignPage, PageTable, other_plane, titled, write_page
from maxq.tools.design.report import (
    KINDS,
    SENSITIVITIES,
    Group,
    case_record,
    case_report,
    comments,
    search_rows,
    sensitivity_rows,
    uncovered_lines,
    uncovered_record,
    uncovered_table,
    wind_table,
    write_record,
)
from maxq.tools.design.trade import StageTrade, trade_sheets, trade_table, write_trade
from maxq.tools.design.way_out import trials_text, way_out_table

RECORD_NAME, PAGE_NAME = "design.json", "design.html"


@dataclass(frozen=True)
class Made:
    """The result of a case: the exit code, the folder of the design, and the design with its outcome.

    `orders` contains the results of --orders for each stage, and is empty without this option.
    """

    code: Exit
    folder: Path
    found: CaseDesign
    orders: Sequence[FoundDesigns]


def make(
    case: str,
    *,
    overrides: tuple[str, ...] = (),
    out: str | None = None,
    starts: int | None = None,
    seed: int | None = None,
    page: bool = True,
    plots: bool = False,
    orders: bool = False,
    pareto: str | None = None,
    trials: bool = True,
) -> Made:
    """Optimise a case, write its files and print the result.

    The arguments are the options of `simdesign optimise`. Raises ScenarioError and FileError.
    """
    begun_s = time.perf_counter()
    search = (("starts", starts), ("seed", seed))
    overrides = (*overrides, *(f"search.{key}={value}" for key, value in search if value is not None))
    loaded = read_case(case, overrides)
    folder = Path(out or Path("runs") / plain_name(loaded.name, "design"))
    with Progress() as progress, Interruption(at_once=True) as stop:

        def shown(stage: int, number: int) -> Watch:
            name = stage_name(loaded.scenario.vehicle, stage)

            def show(done: int, of: int, best_db: float, what: str) -> None:
                stop.check()
                whose = "" if loaded.case.robust is None else " for the plants so far"
                note = "" if math.isnan(best_db) else f"best so far {best_db:.2f} dB{whose}"
                about = " ".join(filter(None, ("optimising", name, f"(round {number})" if number > 1 else "")))
                progress.show(f"{about}: {what}", done, of, note)

            show(0, 0, math.nan, "starts")
            return show

        def ready() -> None:
            stop.check()
            check_writable(folder)

        try:
            if orders:
                for stage in each_stage(loaded):
                    order_cases(stage)  # reject an option that the law does not have before the search
            aims = None if pareto is None else _aims(pareto, loaded)
            made = design_case(loaded, shown, ready)  # Ctrl-C ends it with the best so far
        except ValidationError as error:
            said = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
            raise ScenarioError(loaded.label, said, "stage") from None
        except (UnsolvableError, ValueError) as error:
            raise ScenarioError(loaded.label, str(error)) from None
        untraced = ""
        solved, trades, interrupted = list[FoundDesigns](), list[StageTrade](), made.interrupted
        if trials and not interrupted:
            made, interrupted = _with_trials(made, progress, stop)
        try:
            for stage, mine in zip(made.stages, made.plants, strict=True) if orders and not interrupted else ():
                name = stage_name(loaded.scenario.vehicle, mine.each[0].node.stage)
                about = " ".join(filter(None, ("optimising", name)))
                watch = lambda n, of, at=about: progress.show(f"{at}: orders", n, of)  # noqa: E731  # short
                solved.append(solve_orders(order_cases(stage), mine, watch))
            if aims is not None and not interrupted:
                for k in range(len(made.results)):
                    trades.append(_traced(made, k, aims, progress))
        except KeyboardInterrupt:  # the design itself is complete
            solved, trades, interrupted = [], [], True
        except ValueError as error:
            untraced = str(error)  # the design itself is complete
        results = made.results
        with Interruption() as interruption:  # write the result even if Ctrl-C is pressed now
            forget_pictures(folder)
            files, verdict, written = _write(folder, made, solved), _verdict(made, folder), list[Path]()
            for trade in trades:
                files += write_trade(folder, loaded, trade)
                if page:
                    sheets = trade_sheets(trade, f"Trade-off: {loaded.name}")
                    from maxq.tools.design import pictures  # noqa: PLC0415  # lazy: Matplotlib

                    files += pictures.draw_all(sheets, folder, progress.show)
            if page and not made.interrupted:
                progress.show("writing the page", 0, 1)
                said = verdict.splitlines()[-1]
                written = [write_page(folder / PAGE_NAME, _page(made, said, _command(case, overrides, out)))]
                files += written
            if plots and not made.interrupted:
                for (outcome, _), found in zip_longest(results, solved):
                    into = folder / f"stage-{_number(outcome) + 1}" if len(results) > 1 else folder
                    files += _draw(into, outcome, found, progress, lambda: interruption.requested)
    for (outcome, solution), found in zip_longest(results, solved):
        if len(results) > 1:
            tell(f"--- {stage_name(loaded.scenario.vehicle, _number(outcome))}\n")
        tell(case_report(outcome, solution))
        if found is not None:
            tell("\n" + "\n".join(orders_table(found)))
    for trade in trades:
        tell("\n" + "\n".join(trade_table(trade)))
    if untraced:
        tell("", f"no trade-off: {untraced}")
    tell("\nflights", *(f"  {one.text}" for one in made.rounds))
    if made.uncovered:
        tell("", *uncovered_table(loaded.scenario.vehicle, made.uncovered))
    tell(f"\n{len(files)} files in {folder}/; {time.perf_counter() - begun_s:.1f} s in all")
    tell(verdict + (f"; page: {written[0]}" if written else ""))
    code = Exit.INTERRUPTED if interrupted or interruption.requested else Exit.OK if made.feasible else Exit.FAILED
    return Made(code, folder, made, solved)


def _aims(pareto: str, loaded: LoadedCase) -> tuple[Aim, Aim]:
    """Return the objectives of --pareto. Raises ValueError for others, and for a case without wind for the load."""
    aims = aims_of(pareto)
    check_aims(loaded.case, aims)
    return aims


def _traced(made: CaseDesign, k: int, aims: tuple[Aim, Aim], progress: Progress) -> StageTrade:
    """Return the trade-off of the stage at index `k` of a design. Raises ValueError as `trade_off` does."""
    vehicle, solutions = made.stages[k].scenario.vehicle, [solution for _, solution in made.results]
    number = _number(made.results[k][0])
    about = " of ".join(filter(None, ("tracing the trade-off", stage_name(vehicle, number))))
    points = trade_off(made.stages[k], made.plants[k], aims, [solutions[k].law], partial(progress.show, about))
    several = len(vehicle.stage) > 1
    return StageTrade(points, aims, number + 1 if several else None, (*solutions[:k], *solutions[k + 1 :]))


def _with_trials(made: CaseDesign, progress: Progress, stop: Interruption) -> tuple[CaseDesign, bool]:
    """Return the design with trials for each infeasible stage, and True if the trials were interrupted."""
    results, cut = [], False
    for stage, (outcome, solution) in zip(made.stages, made.results, strict=True):
        name = stage_name(stage.scenario.vehicle, _number(outcome))

        def show(done: int, of: int, best_db: float, what: str, name: str = name) -> None:
            stop.check()
            note = "" if math.isnan(best_db) else f"reached {best_db:.2f} dB missing"
            progress.show(": ".join(filter(None, (name, what))), done, of, note)

        if not cut:
            trials, cut = tried(stage, solution, show)
            solution = replace(solution, trials=trials)  # noqa: PLW2901  # the same solution with trials
        results.append((outcome, solution))
    return replace(made, results=tuple(results)), cut


def _number(outcome: DesignOutcome) -> int:
    """Return the index of the stage."""
    return outcome.judged[0].node.stage


def _verdict(made: CaseDesign, folder: Path) -> str:
    """Return the last line, preceded by the command that flies the design if this is feasible."""
    results, loaded = made.results, made.results[0][0].loaded
    if made.interrupted:
        return f"INTERRUPTED: the best so far is kept; {made.claim}"
    several = len(results) > 1
    where = [f"stage {_number(outcome) + 1}: " if several else "" for outcome, _ in results]
    if made.feasible:
        reached = "; ".join(w + objective_text(solution) for w, (_, solution) in zip(where, results, strict=True))
        met = "; ".join(dict.fromkeys(solution.met for _, solution in results))
        file = loaded.case.scenario if loaded.case.scenario in builtin_files("scenario") else loaded.scenario.label
        if Path(file).is_relative_to(Path.cwd()):
            file = str(Path(file).relative_to(Path.cwd()))
        fly = f"simrun {shlex.quote(file)} --set {shlex.quote(f'design={folder}/{DESIGN_NAME}')}"
        return f"fly it with:\n  {fly}\nDESIGNED: {reached}, {met}"
    said = [f"its own flight is lost: {loss_text(made.loss)}"] if made.loss is not None else []
    said += [
        w + "; ".join(filter(None, (solution.explanation() or "; ".join(outcome.missed), trials_text(solution))))
        for w, (outcome, solution) in zip(where, results, strict=True)
        if not (outcome.feasible and solution.feasible)
    ]
    return f"INFEASIBLE: {'; '.join(said)}"


def _page(made: CaseDesign, verdict: str, command: str) -> DesignPage:
    groups, others, more, wanted = list[Group](), list[JudgedLoop](), list[PageTable](), dict[int, Wanted]()
    slopes = list[PageTable]()
    flown, texts = list[tuple[str, Sequence[Check]]](), list[tuple[str, list[str]]]()
    vehicle = made.results[0][0].loaded.scenario.vehicle
    for outcome, solution in made.results:
        loaded, stage = outcome.loaded, stage_name(vehicle, _number(outcome))
        off = [replace(c, key=f"dispersed_{c.key}", text=f"{c.text}, dispersed") for c in outcome.dispersed_found]
        groups.append(Group(stage, outcome.judged, outcome.found, (), outcome.coupled_found, None, off))
        nodes = partial(_nodes, loaded)
        others += other_plane(outcome.judged, outcome.design, loaded.case.loop, nodes)
        wanted[_number(outcome)] = outcome.wanted
        more.append((titled("Search", stage), [(), *search_rows(solution)]))
        slopes.append((titled(SENSITIVITIES, stage), sensitivity_rows(solution)))
        if loaded.case.loop != "sampled":
            flown.append((titled("Limits of the same design as it flies, sampled", stage), outcome.flown_found))
        for title, lines in (("Way out", way_out_table(solution)), ("In the wind of the case", wind_table(outcome))):
            texts += [(titled(title, stage), lines[1:])] if lines else []
    loaded, cases = made.results[0][0].loaded, [outcome.loaded.case for outcome, _ in made.results]
    case = loaded.case
    return DesignPage(
        name=loaded.name,
        kind="Control design of a case",
        about=case.description,
        verdict=verdict,
        passed=made.feasible,
        block=(
            ("vehicle", vehicle.name),
            ("scenario", loaded.scenario.name),
            ("plane", case.plane),
            ("loop", KINDS[case.loop]),
            (
                "filter and gain schedule",
                ", ".join(dict.fromkeys(f"{c.filter.structure} {c.gains.schedule}" for c in cases)),
            ),
            ("errata", case.errata),
            ("plant", case.plant),
        ),
        groups=groups,
        others=others,
        wanted=wanted.__getitem__,
        design=made.design,
        vehicle=vehicle,
        data=[
            (DESIGN_NAME, "the design, to fly, to analyse and to verify"),
            (RECORD_NAME, "limits, margins, lobes and the search"),
        ],
        gaps=uncovered_lines(vehicle, made.uncovered),
        flown=flown,
        more=[("Search", "", [*more, *slopes])],
        texts=texts,
        command=command,
    )


def _command(case: str, overrides: Sequence[str], out: str | None) -> str:
    """Return the command that repeats a design."""
    sets = [word for change in overrides for word in ("--set", change)]
    return shlex.join(["simdesign", "optimise", case, *sets, *(("--out", out) if out is not None else ())])


def _write(folder: Path, made: CaseDesign, orders: Sequence[FoundDesigns]) -> list[Path]:
    results = made.results
    records = [case_record(outcome, solution) for outcome, solution in results]
    for record, found in zip(records, orders, strict=False):
        record["orders"] = orders_record(found)
    record = records[0]
    if len(records) > 1:
        numbers = [{"stage": _number(outcome) + 1} for outcome, _ in results]
        stages = [number | each for number, each in zip(numbers, records, strict=True)]
        record = {"schema": record["schema"], "name": record["name"], "feasible": made.feasible, "stages": stages}
    record |= {
        "feasible": made.feasible,
        "flights": [one.text for one in made.rounds],
        "lost": None if made.loss is None else loss_text(made.loss),
        "not_designed": [n + 1 for n in made.not_designed],
        "not_covered": uncovered_record(made.uncovered),
    }
    text = design_text(made.design, comments(made))
    files = [write_whole(folder / DESIGN_NAME, text), write_record(folder / RECORD_NAME, record)]
    for structure, schedule, one, _ in order_designs(orders):
        text = design_text(one, [f"{structure} with {schedule} gains, of --orders"])
        files.append(write_whole(order_folder(folder, structure, schedule) / DESIGN_NAME, text))
    return files


def _draw(
    folder: Path, outcome: DesignOutcome, orders: FoundDesigns | None, progress: Progress, stop: Callable[[], bool]
) -> list[Path]:
    from maxq.tools.design import pictures  # noqa: PLC0415  # lazy: Matplotlib, with --plots only

    loaded, nodes = outcome.loaded, [j.flown for j in outcome.judged]
    stage = _number(outcome)
    tanks = loaded.scenario.vehicle.stage[stage].pendulum_names
    sheets = [
        *pictures.case_sheets(
            loaded.name,
            outcome.design.of_stage(stage),
            nodes,
            _along(loaded, nodes),
            tanks,
            loaded.scenario.vehicle.name,
        ),
        *pictures.judged_sheets(
            outcome.judged, f"{loaded.scenario.vehicle.name}, {loaded.name}, {loaded.case.loop} loop", outcome.wanted
        ),
    ]
    if orders is not None:
        series = {name: {f: _peak(orders[f, schedule][1]) for f in STRUCTURES} for schedule, name in SCHEDULES.items()}
        designs = {schedule: {f: make_design(*orders[f, schedule]) for f in STRUCTURES} for schedule in SCHEDULES}
        sheets += pictures.order_sheets(series, designs, nodes)
    return pictures.draw_all(sheets, folder, progress.show, stop)


def _along(loaded: LoadedCase, nodes: Sequence[Node]) -> list[Node]:
    """Return operating points about every half second from the first node to the last, for curves over time."""
    case, first, last = loaded.case, nodes[0].time_s, nodes[-1].time_s
    count = max(1, round(2.0 * (last - first)))
    return _nodes(loaded, [first + (last - first) * k / count for k in range(count + 1)], case.plane)


def _nodes(loaded: LoadedCase, times_s: Sequence[float], plane: Plane) -> list[Node]:
    case = loaded.case
    return operating_points.nodes(loaded.along, times_s, plane=plane, errata=case.errata, plant=case.plant)


# The paper's filters and gain schedules

STRUCTURES = tuple(name for name, sections in KNOWN.items() if sum(sections))
SCHEDULES = {"two-phase": "two-phase", "linear": "Subcase 1", "free": "Subcase 2"}
FoundDesigns = Mapping[tuple[str, str], tuple[LoadedCase, Solution]]
"""The cases and their solutions by structure and schedule."""


def order_cases(stage: LoadedCase) -> dict[tuple[str, str], LoadedCase]:
    """Return the cases of a stage with each structure and schedule. Raises ValidationError if its law has no such
    gains.
    """
    case, out = stage.case, {}
    for structure, schedule in product(STRUCTURES, SCHEDULES):
        asked = {"structure": structure, "prewarp_hz": case.filter.prewarp_hz, "bounds": case.filter.bounds}
        given = {k: v for k, v in dict(case).items() if k != "schema_version"}
        filter_ = {k: v for k, v in asked.items() if v is not None}
        changed = type(case).model_validate({**given, "filter": filter_, "gains": {"schedule": schedule}})
        out[structure, schedule] = replace(stage, case=changed)
    return out


START = "fork" if sys.platform == "linux" else "spawn"
"""The start of the processes of a pool: a fork has the compiled functions and the data of this process at once."""


def solve_orders(
    cases: Mapping[tuple[str, str], LoadedCase], plants: Plants, watch: Callable[[int, int], None]
) -> FoundDesigns:
    """Solve the cases of all structures and schedules on all cores.

    Each search also starts from the solutions of the simpler cases that it contains, so that more freedom is never
    worse. `watch` receives the number of solved cases and their total.
    """
    contained = {
        (f, s): [c for c in ((_before(STRUCTURES, f), s), (f, _before(tuple(SCHEDULES), s))) if c in cases]
        for f, s in cases
    }
    found: dict[tuple[str, str], Solution] = {}
    under_way: dict[Future[Solution], tuple[str, str]] = {}
    with ProcessPoolExecutor(cores(), get_context(START), _begin_orders, (cases, plants)) as pool:
        try:
            while len(found) < len(cases):
                waiting = [key for key in cases if key not in found and key not in under_way.values()]
                for key in waiting:
                    if found.keys() >= set(contained[key]):
                        under_way[pool.submit(_solve_order, key, [found[c].law for c in contained[key]])] = key
                watch(len(found), len(cases))
                for done in wait(under_way, return_when=FIRST_COMPLETED).done:
                    found[under_way.pop(done)] = done.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return {key: (loaded, found[key]) for key, loaded in cases.items()}


_orders: tuple[Mapping[tuple[str, str], LoadedCase], Plants]  # cases of a pool process


def _begin_orders(cases: Mapping[tuple[str, str], LoadedCase], plants: Plants) -> None:
    global _orders  # noqa: PLW0603  # the state of a pool process, set once at its start
    _orders = cases, plants
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends the signal to all; the command ends the pool


def _solve_order(key: tuple[str, str], contained: Sequence[DesignedLaw]) -> Solution:
    cases, plants = _orders
    return solve(cases[key], plants, contained)


def _before(names: Sequence[str], name: str) -> str:
    """Return the preceding name, or "" for the first name."""
    return ("", *names)[names.index(name)]


def order_designs(orders: Sequence[FoundDesigns]) -> Iterator[tuple[str, str, Design, list[Solution]]]:
    """Yield each structure and schedule with which every stage meets its limits, with the design and its solutions."""
    for structure, schedule in orders[0] if orders else ():
        solutions = [found[structure, schedule][1] for found in orders]
        if all(solution.feasible for solution in solutions):
            yield structure, schedule, make_design(orders[0][structure, schedule][0], *solutions), solutions


def orders_table(found: FoundDesigns) -> list[str]:
    """Return a table of the objective (dB) by structure and schedule."""
    rows = [("filter", *SCHEDULES.values(), "gained", "further")]
    for structure in STRUCTURES:
        peaks = [_peak(found[structure, schedule][1]) for schedule in SCHEDULES]
        values = (*peaks, peaks[0] - peaks[1], peaks[1] - peaks[2])
        rows.append((structure, *("infeasible" if math.isnan(x) else f"{x:.2f}" for x in values)))
    return ["over the filter's order, dB", *aligned(rows, "  ", right=(1, 2, 3, 4, 5))]


def orders_record(found: FoundDesigns) -> list[dict[str, object]]:
    """Return the record of --orders for design.json."""
    return [
        {
            "structure": structure,
            "schedule": schedule,
            "status": s.status,
            "objective_db": s.objective_db,
            "violation_db": s.violation_db,
            "near_best": s.certificate.near_best,
            "starts": s.certificate.starts,
            **s.law.record(),
        }
        for (structure, schedule), (_, s) in found.items()
    ]


def order_folder(folder: Path, structure: str, schedule: str) -> Path:
    """Return the folder for the design of a structure and a schedule."""
    return folder / f"{structure}-{schedule}"


def _peak(solution: Solution) -> float:
    return solution.objective_db if solution.feasible else math.nan
