"""Designs at operating points of published derivatives: `simdesign analyse DESIGN --points FILE`, and cases with the
key `points`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.design.case.basis import Basis, stated_basis
from maxq.design.laws.design_file import DESIGN_NAME, design_text, forget_pictures
from maxq.design.loop.fixed_path import LoopKind
from maxq.design.verify.judging import judge, stage_checks
from maxq.sim.files import check_writable, plain_name, write_whole
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading, builtin_files, locate
from maxq.sim.scenario.loader import read_design
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import Progress, tell
from maxq.tools.design.report import (
    AnalysisOrder,
    Group,
    analysis_record,
    analysis_report,
    analysis_verdict,
    case_record,
    case_report,
    write_record,
)

if TYPE_CHECKING:
    from maxq.design.case.schema import LoadedCase
    from maxq.design.model.given_file import GivenPoints
    from maxq.design.optimise.search import SearchProgress
    from maxq.design.optimise.solution import Solution
    from maxq.design.verify.outcome import DesignOutcome

RECORD_NAME, CASE_RECORD_NAME = "analysis.json", "design.json"
_NO_FLIGHT = ("scenario", "vehicle", "faults", "every_s", "errata", "plant", "axis", "plots")
"""The options that require a flight."""


def points_of(order: AnalysisOrder) -> str | None:
    """Return the file of derivatives in the options, else that in the basis of the design, or None.

    The basis is used only if no scenario is given. Return None also for a design that cannot be read.
    """
    if order.points is not None or "scenario" in order.given:
        return order.points
    path = Path(order.design)
    if order.design not in builtin_files("design") and not path.is_file():
        return None
    try:
        basis = read_design(order.design).basis
    except ScenarioError:  # reported when the design is read with a scenario
        return None
    points = (basis or {}).get("points")
    return None if points is None else str(points)


def execute(order: AnalysisOrder, points: str) -> int:
    """Analyse a design at given points, write its record and print the report. Return the exit code.

    Raises CommandError for an option that requires a flight, and ScenarioError.
    """
    from maxq.design.model.given_file import given_points, read_points  # noqa: PLC0415  # lazy: with points only

    for key in order.given:
        if key in _NO_FLIGHT and getattr(order, key):
            raise CommandError(f"--{key.removesuffix('_s')} has no meaning with points: they are given, not flown")
    design, read = read_design(order.design), read_points(points)
    name = Path(order.design).name.removesuffix(".toml")
    basis = stated_basis(design, 0, order.design) or Basis()
    kind = _kind_of(order, read, basis if design.basis else None)
    order = replace(order, kind=kind, axis=read.plane, points=points, scenario=f"the points of {read.name or points}")
    times_s = list(dict.fromkeys(order.times_s)) or list(basis.nodes_s or read.times_s)
    folder = Path(order.out) if order.out is not None else None
    try:
        nodes = given_points(read, times_s)
        with Progress() as progress:
            judged = judge(nodes, design, kind, lambda n: progress.show("measuring margins", n, len(nodes)))
            checks = stage_checks(judged, design, basis, kind)
    except ValueError as error:
        raise ScenarioError(points, str(error)) from None
    groups = [Group("", judged, checks, (), (), None, ())]
    about = _judged_by(design, basis, times_s, order.given)
    verdict, files = analysis_verdict(groups), []
    if folder is not None:
        check_writable(folder)
        forget_pictures(folder)
        files.append(write_record(folder / RECORD_NAME, analysis_record(name, order, groups, about)))
    tell(analysis_report(name, order, design, groups, about))
    tell(f"\n{len(files)} files in {folder}/" if files else "", verdict)
    return Exit.OK if verdict.startswith("PASSED") else Exit.FAILED


def is_case_of_points(case: str) -> bool:
    """Return True for a case file with points. Return False for other files, also if the file cannot be read."""
    try:
        return "points" in Reading().document(*locate(case, "case"), "case")
    except ScenarioError:
        return False


def make(case: str, *, overrides: tuple[str, ...] = (), out: str | None = None) -> Exit:
    """Optimise a case of points, write the design, and print the result. Return the exit code.

    Raises ScenarioError and FileError.
    """
    from maxq.design.case.schema import read_case  # noqa: PLC0415  # lazy, as below: an analysis needs no case
    from maxq.design.laws.schedule import UnsolvableError  # noqa: PLC0415
    from maxq.design.verify.outcome import objective_text  # noqa: PLC0415

    loaded = read_case(case, overrides)
    folder = Path(out or Path("runs") / plain_name(loaded.name, "design"))
    check_writable(folder)
    with Progress() as progress:

        def show(done: int, of: int, best_db: float, what: str) -> None:
            note = "" if math.isnan(best_db) else f"best so far {best_db:.2f} dB"
            progress.show(f"optimising: {what}", done, of, note)

        try:
            outcome, solution = designed_at_points(loaded, show)
        except (UnsolvableError, ValueError) as error:
            raise ScenarioError(loaded.label, str(error)) from None
    feasible = outcome.feasible and solution.feasible
    head = [f"Written by simdesign for the case {loaded.name}, at the points of {loaded.case.points}.", *outcome.missed]
    files = [
        write_whole(folder / DESIGN_NAME, design_text(outcome.design, head)),
        write_record(folder / CASE_RECORD_NAME, case_record(outcome, solution)),
    ]
    tell(case_report(outcome, solution), f"\n{len(files)} files in {folder}/")
    met, missed = f"{objective_text(solution)}, {solution.met}", solution.explanation() or "; ".join(outcome.missed)
    tell(f"DESIGNED: {met}" if feasible else f"INFEASIBLE: {missed}")
    return Exit.OK if feasible else Exit.FAILED


def designed_at_points(loaded: LoadedCase, progress: SearchProgress | None = None) -> tuple[DesignOutcome, Solution]:
    """Return the judged design of a case of points, and its solution. Raises UnsolvableError or ValueError if there is
    none.
    """
    from maxq.design.optimise.solve import each_stage, solve  # noqa: PLC0415
    from maxq.design.verify.outcome import judge_solution  # noqa: PLC0415

    (stage,) = each_stage(loaded)
    solution = solve(stage, progress=progress)
    return judge_solution(stage, solution), solution


def _kind_of(order: AnalysisOrder, read: GivenPoints, basis: Basis | None) -> LoopKind:
    """Return the kind of loop: from the options, else from the basis, else by the computer.

    For the computer, it is `sampled`, or `exact` if the computer does not sample. Raises CommandError.
    """
    samples = read.computer.sample_s > 0.0
    if "kind" in order.given:
        if order.kind == "sampled" and not samples:
            raise CommandError("the computer of the points does not sample: allowed is --kind exact or pade")
        return order.kind
    if basis is not None and (samples or basis.loop != "sampled"):
        return basis.loop
    return "sampled" if samples else "exact"


def kind_of_points(order: AnalysisOrder, read: GivenPoints, design: Design) -> LoopKind:
    """Return the kind of loop of a design at points, as in an analysis. Raises CommandError."""
    return _kind_of(order, read, stated_basis(design, 0, order.design) if design.basis else None)


def _judged_by(design: Design, basis: Basis, times_s: list[float], given: tuple[str, ...]) -> str:
    count = f"{len(times_s)} operating point{'s' * (len(times_s) != 1)}"
    if design.basis is None:
        return f"the design states no basis: judged at {count}, without limits"
    whose = (
        "by conditions that differ from the design's own"
        if {"kind", "times_s"} & {*given}
        else "by the design's own basis"
    )
    limits = len(basis.limits.asked)
    return f"judged {whose}: {count}, {limits} limit{'s' * (limits != 1)}"
