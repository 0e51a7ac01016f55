"""The assessment of a case's design as written to the file, and the design made from the solutions of its stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.design.case.schema import Case, LoadedCase
from maxq.design.laws.design_file import design_of
from maxq.design.model.node import flown_point
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.optimise.criteria import OBJECTIVES
from maxq.design.optimise.robust import dispersed_nodes, ranges_of
from maxq.design.optimise.solution import Solution
from maxq.design.verify.judging import (
    Check,
    InWind,
    JudgedLoop,
    Wanted,
    checks,
    goal_checks,
    in_wind,
    judge,
    wind_checks,
)
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.scenario.schema_design import Design, LoopFiltersSection, StageLaw


@dataclass(frozen=True)
class DesignOutcome:
    """The assessment of a design by its case.

    It covers the case's own loop, the loop as flown, and dispersed plants of a robust case.
    """

    loaded: LoadedCase
    design: Design
    judged: Sequence[JudgedLoop]
    found: Sequence[Check]
    flown_found: Sequence[Check]  # on the sampled loop; equal to `found` if the case's loop is sampled
    dispersed_found: Sequence[Check]  # at the worst plants of a robust case
    wanted: Wanted
    in_wind: Sequence[InWind] = ()  # at `judged`
    coupled_found: Sequence[Check] = ()  # for each axis with the other loops closed, along the design's own flight

    @property
    def flies_otherwise(self) -> bool:
        """Return True if the flight computer is sampled but the loop of the case is not."""
        return self.loaded.case.loop != "sampled" and self.judged[0].node.instruments.sample_s > 0.0

    @property
    def feasible(self) -> bool:
        """Return True if all limits of the case are met. Checks on the sampled loop are for information only."""
        return all(check.passed for check in (*self.found, *self.coupled_found, *self.dispersed_found))

    @property
    def missed(self) -> list[str]:
        """Return a line for each missed limit, with the amount."""
        out = []
        for where, found in (("", (*self.found, *self.coupled_found)), (" of dispersed plants", self.dispersed_found)):
            for check in (c for c in found if not c.passed):
                value, time_s = check.values[check.worst], check.time_s[check.worst]
                by = "" if np.isnan(value) else f" by {abs(value - check.wanted):.3g} {check.unit}".rstrip()
                at = "" if np.isnan(time_s) else f" at {time_s:g} s"
                out.append(f"{check.text}{where} missed{by}{at}")
        return out


def make_design(loaded: LoadedCase, *solutions: Solution, missed: Sequence[int] = ()) -> Design:
    """Return the design to be written, from one solution per stage.

    The description begins with that of the case and continues with the form and the result of each stage. Roll control,
    and stages that were not designed, are taken from the scenario's own design. `missed` contains the stages, from 0,
    that miss limits along the design's own flight.
    """
    case, points, base = loaded.case, loaded.points, loaded.base
    own, stages = (None, 1) if base is None else (base.design, len(base.vehicle.stage))
    forms, results = list[tuple[str, str, str]](), list[str]()  # of each stage
    for n, solution in sorted((s.nodes[0].stage, s) for s in solutions):
        mine, where = solution.case, f"stage {n + 1}: " if stages > 1 else ""
        met = solution.feasible and n not in missed
        forms.append((mine.filter.structure, mine.gains.schedule, mine.loop))
        results.append(f"{where}{objective_text(solution)}; {solution.met if met else 'limits are missed'}")
    text = described(case.description, forms, results)

    def alone(solution: Solution) -> Design:
        stage, at_s = solution.nodes[0].stage, tuple(node.time_s for node in solution.nodes)
        rolls = own.of_stage(stage) if own else None
        designed = design_of(
            name=loaded.name,
            description=text,
            vehicle=points.name if points is not None else loaded.scenario.vehicle.name,
            law=solution.law,
            roll=rolls.roll if rolls else None,
            basis=solution.case.basis("" if base is None else case.scenario or base.name, at_s).as_table(),
        )
        return designed.model_copy(update={"roll_gimbal": rolls.roll_gimbal if rolls else None})

    designs = {solution.nodes[0].stage: alone(solution) for solution in solutions}
    first = designs[min(designs)]
    if stages == 1:
        return first
    names = StageLaw.model_fields
    flown = [designs.get(n) or (with_law(own.of_stage(n), first) if own else first) for n in range(stages)]
    # states the absence of loop filters if another stage has some
    none = LoopFiltersSection() if any(d.loop_filters is not None for d in flown) else None
    laws = []
    for n, d in enumerate(flown):
        said = {k: getattr(d, k) for k in names if k != "fade_s"} | {"loop_filters": d.loop_filters or none}
        laws.append(StageLaw(**said, fade_s=own.stage[n].fade_s if own and n < len(own.stage) else None))
    return first.model_copy(update={"stage": tuple(laws), "basis": None})


def with_law(own: Design, other: Design) -> Design:
    """Return a stage's design expressed in the law of another design, with additional gains of 0.

    Raises ScenarioError if the design has gains that the other law does not have.
    """
    if own.law == other.law:
        return own
    if not set(own.gain_names) <= set(other.gain_names):
        raise ScenarioError(
            own.name or "design",
            "flies in stages that the case does not design",
            "law",
            value=own.law,
            allowed=f"a scenario whose design is of the law {other.law}, or of pd",
        )
    tables = {
        key: CsvTable(
            "",
            {
                **table.columns,
                **{
                    k: np.full(len(table), -1.0 if k == "accel_per_incidence_mps2" else 0.0)
                    for k in other.gain_names
                    if k not in table
                },
            },
        )
        for key in ("table", "yaw_table")
        if (table := getattr(own.gains, key)) is not None
    }
    return own.model_copy(update={"gains": own.gains.model_copy(update=tables), "load_relief": other.load_relief})


def described(purpose: str, forms: Sequence[tuple[str, str, str]], results: Sequence[str]) -> str:
    """Return the description of a design: its purpose, and the form and the result of each stage.

    A form is the names of the filter, the gain schedule and the loop model. Equal names of gains or loops are not
    repeated.
    """
    filters, gains, kinds = zip(*forms, strict=True)
    form = f"filter {'/'.join(filters)}, {'/'.join(dict.fromkeys(gains))} gains, {'/'.join(dict.fromkeys(kinds))} loop"
    first = f"{purpose.rstrip('.')} ({form})" if purpose else form
    return ". ".join([first, *(text[0].upper() + text[1:] for text in results)])


def objective_text(solution: Solution) -> str:
    """Return the name and the value reached of the objective.

    For a robust case, the values of the worst plant found and of the nominal plants are given.
    """
    reached = OBJECTIVES[solution.case.objective.kind].reached
    text = reached(solution.objective_db)
    if solution.case.robust is None:
        return text
    return f"{text} at the worst plant found ({reached(solution.nominal_objective_db)} nominal)"


def wanted_of(case: Case) -> Wanted:
    """Return the limits that a case with one stage imposes."""
    return Wanted.of(case.basis("", case.times_s).limits)


def judge_solution(
    loaded: LoadedCase, solution: Solution, design: Design | None = None, between: Sequence[OperatingPoint] = ()
) -> DesignOutcome:
    """Assess the design as written, at the operating points of the search.

    The dispersed plants of a robust search are included. `design` is the design of all stages, if the solution is one
    of several. `between` contains additional operating points.
    """
    design, case = design or make_design(loaded, solution), loaded.case
    nodes = sorted((*solution.nodes, *between), key=lambda node: node.time_s)
    wanted = wanted_of(case)

    judged = judge(nodes, design, case.loop)
    as_flown = case.loop == "sampled" or not nodes[0].instruments.sample_s > 0.0
    flown = checks(judged if as_flown else judge(nodes, design, "sampled"), design, wanted)
    winds = in_wind(case, nodes, design, None if loaded.base is None else loaded.base.design)
    found = [*(flown if as_flown else checks(judged, design, wanted))]
    found += [*goal_checks(judged, case.goal), *wind_checks(winds, case.limits, nodes)]
    if case.robust is None:
        return DesignOutcome(loaded, design, judged, found, flown, [], wanted, winds)
    vehicles = [flown_point(node) for node in nodes]
    dispersed = dispersed_nodes(ranges_of(loaded, vehicles), vehicles, solution.constraints)
    off = list[Check]()
    if dispersed:
        found_off = judge(dispersed, design, case.loop)
        off += checks(found_off, design, Wanted.of(case.robust.limits)) + goal_checks(found_off, case.goal, True)
        off += wind_checks(in_wind(case, dispersed, design, None), case.robust.limits, dispersed)
    return DesignOutcome(loaded, design, judged, found, flown, off, wanted, winds)
