"""The optimisation of a design that meets its limits also between its nodes.

The search finds instants at which the design is worse than at its nodes, and adds them as nodes. The exchange method is
that for dispersed plants (robust.py; Blankenship & Falk, J. Optim. Theory Appl. 19, 1976), with time as the parameter.
The result depends on the grid of instants, and the certificate states their number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.design.case.schema import CaseGains, LoadedCase
from maxq.design.laws.law import DesignedLaw, LawVariables
from maxq.design.model.powered import by_burn
from maxq.design.optimise.at_nodes import make_problem, solve_at_nodes
from maxq.design.optimise.plants import Plant, Plants, make_plant, make_plants, nodes_of
from maxq.design.optimise.problem import level_of
from maxq.design.optimise.search import SearchProgress
from maxq.design.optimise.solution import Solution

INSTANTS_S, MOST_INSTANTS = (
    0.25,
    400,
)  # spacing along the flight; most instants of a stage in the assessment of a design
FINE_S = 0.05  # spacing next to the worst instants
WORSE_DB = 0.02  # smallest excess of the objective for which an instant is added
COARSE = 1e-4  # tolerance of the curves along the whole flight: 1e-3 dB
ROUNDS = 12
UNSTABLE_DB = 1e3


@dataclass
class Instants:
    """The case at any instant, with a cache of its plants."""

    loaded: LoadedCase
    known: dict[float, Plant]

    def plants(self, times_s: Sequence[float]) -> list[Plant]:
        missing = [t for t in times_s if t not in self.known]
        if missing:
            nodes = nodes_of(self.loaded, missing)
            self.known |= {t: make_plant(node, self.loaded.case) for t, node in zip(missing, nodes, strict=True)}
        return [self.known[t] for t in times_s]

    def over(self, times_s: Sequence[float], plants: Plants, law: LawVariables, solution: Solution) -> Array:
        """Return the excess (dB) of the design at each time relative to its worst node, (kinds of rows, times)."""
        case = self.loaded.case.model_copy(update={"nodes_s": tuple(times_s)})
        problem = make_problem(case, plants, law)
        there = problem.evaluate(solution.variables, complete=True)
        rows, out = there.rows, np.full((len(problem.kinds), len(times_s)), -np.inf)
        level = level_of(rows, solution.levels_db, max(solution.violation_db, 0.0))
        of_plant = rows.plant >= 0
        np.maximum.at(out, (rows.what[of_plant], rows.plant[of_plant]), (rows.excess_db - level)[of_plant])
        if there.unstable:
            out[0, problem.loops.unstable_poles(problem.loops.response(solution.variables)) > 0] = UNSTABLE_DB
        return out


def solve_over_time(
    loaded: LoadedCase, nominal: Plants, also_from: Sequence[DesignedLaw] = (), progress: SearchProgress | None = None
) -> Solution:
    """Return the best design found that meets its limits at all examined instants between the first and the last node.

    The objective at these instants is at most WORSE_DB worse than at the nodes. Gains that are free at every node
    remain free at the nodes of the case only.
    """
    loaded = gains_at_nodes(loaded, nominal)
    case = loaded.case
    burns = burns_of(loaded, case.times_s)
    ends, grid = {t for burn in burns for t in burn}, instants_in(burns, INSTANTS_S)
    instants = Instants(loaded, dict(zip(case.times_s, nominal.each, strict=True)))
    solution, checked = solve_at_nodes(loaded, nominal, also_from, progress), Checked()
    try:
        everywhere = make_plants(instants.plants(grid), COARSE)
        for number in range(ROUNDS + 1):
            if solution.status == "interrupted":
                break
            problem = make_problem(loaded.case, plants_at(instants, loaded))
            law, matters_db = problem.law, problem.matters_db(WORSE_DB)
            over, times_s = instants.over(grid, everywhere, law, solution), grid
            beside = {t + k * FINE_S for t in np.array(grid)[peaks(over, matters_db)] for k in range(-4, 5)}
            if beside:
                # includes the first and the last node, since linear gains are defined at both ends of a problem
                times_s = sorted({*ends, *(round(t, 9) for t in beside if within(burns, t))})
                over = instants.over(times_s, make_plants(instants.plants(times_s)), law, solution)
            checked = Checked(len({*grid, *times_s}), float(over.max(initial=0.0)))
            worst_s = np.array(times_s)[peaks(over, matters_db)].tolist() if beside else []
            new = set(worst_s).difference(loaded.case.times_s)
            if not new or number == ROUNDS:
                break
            loaded = with_nodes(loaded, new)
            # the next design has not been compared at other instants
            solution, checked = solve_at_nodes(loaded, plants_at(instants, loaded), [solution.law], progress), Checked()
    except KeyboardInterrupt:
        solution = replace(solution, status="interrupted")
    certificate = replace(solution.certificate, instants=checked.instants, worst_instant_db=checked.worst_db)
    return replace(solution, certificate=certificate)


@dataclass(frozen=True)
class Checked:
    """The number of instants at which a design was compared with its worst node, and the worst excess (dB)."""

    instants: int = 0
    worst_db: float = 0.0


def plants_at(instants: Instants, loaded: LoadedCase) -> Plants:
    """Return the plants at the nodes of a case."""
    return make_plants(instants.plants(loaded.case.times_s))


def gains_at_nodes(loaded: LoadedCase, nominal: Plants) -> LoadedCase:
    """Return the case with gains at its present nodes in place of gains that are free at every node.

    Linear gains over a quantity other than time keep their present ends, since added nodes may be beyond them.
    """
    case, gains = loaded.case, loaded.case.gains
    if gains.schedule == "free" and gains.over == "time_s":
        gains = CaseGains(schedule="nodes", nodes_s=case.times_s)
    elif gains.schedule in ("free", "linear") and gains.over != "time_s":
        at = np.unique([plant.node.scheduled(gains.over) for plant in nominal.each])
        at = at if gains.schedule == "free" or len(at) == 1 else at[[0, -1]]
        gains = CaseGains(schedule="nodes", over=gains.over, nodes=tuple(at.tolist()))
    return replace(loaded, case=case.model_copy(update={"gains": gains}))


def instants_along(first_s: float, last_s: float, apart_s: float) -> list[float]:
    """Return times from the first to the last with approximately the given spacing, or one time if both are equal."""
    count = 1 if first_s == last_s else max(2, round((last_s - first_s) / apart_s) + 1)
    return np.linspace(first_s, last_s, count).round(9).tolist()  # type: ignore[no-any-return]  # floats


EndsOfBurns = Sequence[tuple[float, float]]
"""The first and the last operating point of a stage in each of its burns, s."""


def burns_of(loaded: LoadedCase, times_s: Sequence[float]) -> EndsOfBurns:
    """Return the first and the last of the operating points in each burn; one burn without a restart."""
    several = loaded.points is None and loaded.along.scenario.guidance.restart
    mine = by_burn(loaded.along, times_s) if several else [times_s]
    return [(min(each), max(each)) for each in mine]


def within(burns: EndsOfBurns, time_s: float) -> bool:
    """Return True for a time between the first and the last operating point of a burn."""
    return any(first <= time_s <= last for first, last in burns)


def instants_in(burns: EndsOfBurns, apart_s: float) -> list[float]:
    """Return the times of `instants_along` in each burn."""
    return [t for first, last in burns for t in instants_along(first, last, apart_s)]


def instants_beside(times_s: Sequence[float], burns: EndsOfBurns = ()) -> list[float]:
    """Return the instants between operating points at which limits are assessed.

    `burns` are those of a stage with restarts.
    """
    if burns:
        return [t for each in burns for t in instants_beside([t for t in times_s if within([each], t)])]
    first, last = min(times_s), max(times_s)
    every = instants_along(first, last, max(INSTANTS_S, (last - first) / MOST_INSTANTS))
    return [t for t in every if t not in times_s]


def with_nodes(loaded: LoadedCase, times_s: Iterable[float]) -> LoadedCase:
    """Return the case of a stage with further nodes at the given times."""
    nodes_s = tuple(sorted({*loaded.case.times_s, *times_s}))
    return replace(loaded, case=loaded.case.model_copy(update={"nodes_s": nodes_s}))


def peaks(over: Array, matters_db: Array) -> IntArray:
    """Return the indices of instants at which a kind of row has a local maximum above its threshold.

    `over` has the shape (kinds, instants), and `matters_db` the shape (kinds,), or (1,) for all kinds.
    """
    padded = np.pad(over, ((0, 0), (1, 1)), constant_values=-np.inf)
    top = (over > matters_db[:, None]) & (over >= padded[:, :-2]) & (over > padded[:, 2:])
    return np.flatnonzero(top.any(axis=0))
