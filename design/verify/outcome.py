"""A designed case: the design as it is written, judged anew by what judges any design."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from maxq.design.case.design_file import design_of
from maxq.design.case.read import LoadedCase
from maxq.design.case.schema import Case
from maxq.design.loop.fixed_path import Kind
from maxq.design.model.node import Node
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
        """All limits of the case are met; those of the loop that flies are told, and decide nothing."""
        return all(check.passed for check in (*self.found, *self.dispersed_found))

    @property
    def missed(self) -> list[str]:
        """What stands in the way, and by how much."""
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
    """What is written; roll control as in the scenario's own design."""
    own = loaded.scenario.design
    state = "all limits met" if solution.feasible else "limits are missed"
    peak = f"; {objective_text(solution)}; {state}"
    made = f"{loaded.case.filter.structure}, {loaded.case.gains.schedule} gains, {loaded.case.loop} loop{peak}"
    text = loaded.case.description
    return design_of(
        name=loaded.name, description=f"{text}. {made}" if text else made, vehicle=loaded.scenario.vehicle.name,
        time_s=solution.nodes_s, k_p=solution.k_p, k_d_s=solution.k_d_s, flt=solution.filter,
        discretization="prewarped", prewarp_hz=solution.prewarp_hz, roll=own.roll if own else None,
        limits=informative(loaded.case),
    )  # fmt: skip


def objective_text(solution: Solution) -> str:
    """What was reached, in words."""
    if solution.case.objective.kind == "least-margin":
        return f"least |1 + L| {10.0 ** (-solution.objective_db / 20.0):.3f}"
    return f"largest peak of mode 1 {solution.objective_db:.2f} dB"


def informative(case: Case) -> Limits:
    """What the case asks for, as a design file states it."""
    wanted = wanted_of(case)
    names = Limits.model_fields
    return Limits(**{name: getattr(wanted, name) for name in names})


def wanted_of(case: Case) -> Wanted:
    """The case's limits; a two-phase design is held to the reference's rigid-body motion."""
    wanted = Wanted.of(case.limits)
    if case.gains.schedule == "two-phase":
        wanted = replace(wanted, rigid_hz=case.reference.rigid_hz, rigid_zeta=case.reference.rigid_zeta)
    return wanted


def judge_solution(loaded: LoadedCase, solution: Solution, nodes: Sequence[Node]) -> Outcome:
    """Judge the design as it is written, at the case's nodes and at the dispersed plants that the search has met."""
    design, case = make_design(loaded, solution), loaded.case
    dispersed = dispersed_nodes(solution, nodes)
    kind: Kind = case.loop
    wanted = wanted_of(case)
    judged = tuple(judge(nodes, design, kind))
    found = tuple(checks(judged, design, wanted))
    flown = judged if kind == "sampled" else tuple(judge(nodes, design, "sampled"))
    flown_found = found if kind == "sampled" else tuple(checks(flown, design, wanted))
    off = tuple(judge(dispersed, design, kind)) if case.robust is not None else ()
    off_found = tuple(checks(off, design, Wanted.of(case.robust.limits))) if case.robust is not None and off else ()
    return Outcome(loaded, design, judged, found, flown, flown_found, off, off_found, wanted)


def dispersed_nodes(solution: Solution, nodes: Sequence[Node]) -> list[Node]:
    """The plants off the nominal one that a robust search has met, rebuilt from their labels."""
    ranges = solution.case.robust
    if ranges is None:
        return []
    from maxq.design.optimise.robust import deviated  # noqa: PLC0415  # few cases are robust

    by_label = {node.label: node for node in nodes}
    out = []
    for label in dict.fromkeys(c.plant for c in solution.constraints if c.dispersed and c.plant is not None):
        name, _, letters = label.removesuffix("]").rpartition(" [")
        ends = [{"-": -1, "0": 0, "+": 1}[letter] for letter in letters]
        out.append(deviated(by_label[name], ranges, ends))
    return out
