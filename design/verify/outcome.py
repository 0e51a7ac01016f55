"""The result of a case: the design as it is written to its file, judged as any design is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from maxq.design.case.design_file import design_of
from maxq.design.case.read import LoadedCase
from maxq.design.case.schema import Case
from maxq.design.loop.fixed_path import Kind
from maxq.design.model.node import Node
from maxq.design.optimise.criteria import OBJECTIVES
from maxq.design.optimise.robust import deviated
from maxq.design.optimise.solution import Solution
from maxq.design.verify.judging import Check, Judged, Wanted, checks, judge
from maxq.sim.scenario.schema_design import Design, Limits


@dataclass(frozen=True)
class Outcome:
    """A design judged by its case: on the case's own loop, as it flies, and on dispersed plants if it is robust."""

    loaded: LoadedCase
    design: Design
    judged: tuple[Judged, ...]
    found: tuple[Check, ...]
    flown: tuple[Judged, ...]  # sampled; the same as `judged` where the case's loop is
    flown_found: tuple[Check, ...]
    dispersed: tuple[Judged, ...]  # worst plants of a robust case
    dispersed_found: tuple[Check, ...]
    wanted: Wanted

    @property
    def feasible(self) -> bool:
        """All limits of the case are met. Those of the sampled loop are for information only."""
        return all(check.passed for check in (*self.found, *self.dispersed_found))

    @property
    def missed(self) -> list[str]:
        """Limits that are missed, and by how much."""
        out = []
        for where, found in (("", self.found), (" of dispersed plants", self.dispersed_found)):
            for check in found:
                if not check.passed:
                    k = check.worst
                    by = f" by {abs(check.values[k] - check.limit):.3g} {check.unit}".rstrip()
                    at = f" at {check.time_s[k]:g} s" if check.time_s[k] == check.time_s[k] else ""
                    out.append(f"{check.text}{where} missed{'' if by.endswith('nan') else by}{at}")
        return out

    @property
    def objective_db(self) -> float:
        """Largest peak of the first mode over the nodes (42), on the case's own loop."""
        return max(j.peak_db(1) for j in self.judged)


def make_design(loaded: LoadedCase, solution: Solution) -> Design:
    """The design to be written; roll control as in the scenario's own design."""
    own = loaded.scenario.design
    state = "all limits met" if solution.feasible else "limits are missed"
    peak = f"; {objective_text(solution)}; {state}"
    made = f"{loaded.case.filter.structure}, {loaded.case.gains.schedule} gains, {loaded.case.loop} loop{peak}"
    text = loaded.case.description
    return design_of(
        name=loaded.name, description=f"{text}. {made}" if text else made, vehicle=loaded.scenario.vehicle.name,
        law=solution.law, roll=own.roll if own else None, limits=informative(loaded.case),
    )  # fmt: skip


def objective_text(solution: Solution) -> str:
    """What was reached, in words."""
    return OBJECTIVES[solution.case.objective.kind].reached(solution.objective_db)


def informative(case: Case) -> Limits:
    """The limits of the case, as a design file states them."""
    wanted = wanted_of(case)
    return Limits(**{name: getattr(wanted, name) for name in Limits.model_fields})


def wanted_of(case: Case) -> Wanted:
    """The case's limits; a two-phase design is held to the reference's rigid-body motion."""
    wanted = Wanted.of(case.limits)
    if case.gains.schedule == "two-phase":
        wanted = replace(wanted, rigid_hz=case.reference.rigid_hz, rigid_zeta=case.reference.rigid_zeta)
    return wanted


def judge_solution(loaded: LoadedCase, solution: Solution, nodes: Sequence[Node]) -> Outcome:
    """Judge the design as it is written, at the case's nodes and at the dispersed plants of a robust search."""
    design, case = make_design(loaded, solution), loaded.case
    wanted = wanted_of(case)

    def judged(at: Sequence[Node], kind: Kind, limits: Wanted) -> tuple[tuple[Judged, ...], tuple[Check, ...]]:
        each = tuple(judge(at, design, kind))
        return each, tuple(checks(each, design, limits))

    own = judged(nodes, case.loop, wanted)
    flown = own if case.loop == "sampled" else judged(nodes, "sampled", wanted)
    off: tuple[tuple[Judged, ...], tuple[Check, ...]] = (), ()
    if case.robust is not None and (dispersed := dispersed_nodes(solution, nodes)):
        off = judged(dispersed, case.loop, Wanted.of(case.robust.limits))
    return Outcome(loaded, design, *own, *flown, *off, wanted)


def dispersed_nodes(solution: Solution, nodes: Sequence[Node]) -> list[Node]:
    """The dispersed plants of a robust search, rebuilt from their labels."""
    ranges = solution.case.robust
    if ranges is None:
        return []
    by_label = {node.label: node for node in nodes}
    out = []
    for label in dict.fromkeys(c.plant for c in solution.constraints if c.dispersed and c.plant is not None):
        name, _, letters = label.removesuffix("]").rpartition(" [")
        ends = [{"-": -1, "0": 0, "+": 1}[letter] for letter in letters]
        out.append(deviated(by_label[name], ranges, ends))
    return out
