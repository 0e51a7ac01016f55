"""The trade-off between two objectives of a case: designs of which none is better than another in both.

The ends of the curve are the optima of either objective alone. Between them, the first objective is minimised with a
limit on the second, in equal steps (the epsilon-constraint method: Haimes, Lasdon & Wismer, IEEE Trans. Syst. Man
Cybern. SMC-1, 1971). Each search begins at the design of the neighbouring point. The multiplier of the limit is the
slope of the curve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from maxq.design.case.schema import Case, LoadedCase, ObjectiveName, ObjectiveSection
from maxq.design.laws.law import DesignedLaw
from maxq.design.model.node import flown_point
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.robust import ranges_of
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import solve
from maxq.design.optimise.way_out import plants_of
from maxq.design.quantities import QUANTITIES

POINTS = 9
FLAT_DB = 1e-3  # ends that differ by less have no trade-off
SAME_DB = 1e-5  # smallest improvement by the search from the other neighbour


@dataclass(frozen=True)
class Aim:
    """An objective of a trade-off: the objective of a case, and the limit on the same quantity.

    `about` is the label of an axis. A value in dB is converted by `limit` to the limit and by `shown` to a report.
    """

    kind: ObjectiveName
    key: str
    about: str
    limit: Callable[[float], float]
    shown: Callable[[float], float]


AIMS: dict[str, Aim] = {
    "peak": Aim("first-mode-peak", "first_mode_db", "largest peak of mode 1, dB", lambda db: db, lambda db: db),
    "margin": Aim("least-margin", "modulus_db", "least |1 + L|", lambda db: -db, lambda db: 10.0 ** (-db / 20.0)),
    "load": Aim(
        "load",
        "q_alpha_Padeg",
        "largest rms of q alpha, Pa deg",
        lambda db: 10.0 ** (db / 20.0),
        lambda db: 10.0 ** (db / 20.0),
    ),
}
"""The objectives of a trade-off by the names of --pareto."""


@dataclass(frozen=True)
class TradePoint:
    """A design on the curve. `values_db` contains both objectives; a smaller value is better.

    `slope` is the derivative of the first with respect to the second, dB per dB. It is NaN at the ends.
    """

    solution: Solution
    values_db: tuple[float, float]
    slope: float


def aims_of(text: str) -> tuple[Aim, Aim]:
    """Return the two objectives that a text names, such as "load,margin". Raises ValueError."""
    names = [name.strip() for name in text.split(",")]
    if len(names) != 2 or len(set(names)) != 2 or not set(names) <= set(AIMS):
        raise ValueError(f"--pareto {text}: allowed are two of {', '.join(AIMS)}, such as load,margin")
    return AIMS[names[0]], AIMS[names[1]]


def check_aims(case: Case, aims: tuple[Aim, Aim]) -> None:
    """Raise ValueError if the case has no wind for the load."""
    if any(aim.kind == "load" for aim in aims) and case.wind is None:
        raise ValueError("--pareto with load: the case has no wind; allowed is a case with a table [wind]")


def trade_off(
    loaded: LoadedCase,
    plants: Plants,
    aims: tuple[Aim, Aim],
    also_from: Sequence[DesignedLaw] = (),
    watch: Callable[[int, int], None] = lambda done, of: None,
    count: int = POINTS,
) -> tuple[TradePoint, ...]:
    """Return the curve of a case with one stage, from the optimum of the first objective to the optimum of the second.

    `plants` are the plants of the case. Limits of the case on both quantities are omitted, and all other limits hold.
    `also_from` contains laws as starts. Each of the `count` points is searched from both neighbours. Points without a
    feasible design are omitted. Raises ValueError if an end is infeasible, or if the case has no wind for the load.
    """
    check_aims(loaded.case, aims)
    first, second = (_minimised(loaded, aim, aims) for aim in aims)
    ends, steps = list[Solution](), 2 * count - 2
    for n, one in enumerate((first, second)):
        watch(n, steps)
        ends.append(solve(one, plants, also_from))
        if not ends[-1].feasible:
            raise ValueError(f"--pareto: the optimum of {aims[n].kind} alone is infeasible: {ends[-1].explanation()}")
        also_from = (*also_from, ends[-1].law)
    best, last = (TradePoint(end, _values(loaded, end, aims), math.nan) for end in ends)
    low, high = last.values_db[1], best.values_db[1]
    if high - low < FLAT_DB:
        return (best, last)
    found: dict[int, TradePoint] = {0: last, count - 1: best}
    for n, k in enumerate([*range(1, count - 1), *range(count - 2, 0, -1)]):
        watch(2 + n, steps)
        forth = n < count - 2  # from the last end; then back from the first one
        near = found[max(j for j in found if j < k)] if forth else found[min(j for j in found if j > k)]
        held = _held(first, aims[1], low + (high - low) * k / (count - 1))
        solution = solve(held, plants, [near.solution.law])
        before = found.get(k)
        if solution.feasible and (before is None or solution.objective_db < before.values_db[0] - SAME_DB):
            found[k] = TradePoint(solution, _values(loaded, solution, aims), _slope(solution, aims[1]))
    return tuple(found[k] for k in sorted(found, reverse=True))


def _held(first: LoadedCase, aim: Aim, most_db: float) -> LoadedCase:
    """Return the case of the first objective with a limit on the second (`aim`), and a single start of its own."""
    limits = first.case.limits.model_copy(update={aim.key: aim.limit(most_db)})
    few = first.case.search.model_copy(update={"starts": 1, "leaps": 0})
    return replace(first, case=first.case.model_copy(update={"limits": limits, "search": few}))


def _minimised(loaded: LoadedCase, aim: Aim, aims: tuple[Aim, Aim]) -> LoadedCase:
    """Return the case with one objective of a trade-off, without soft goals and limits on both quantities."""
    case = loaded.case
    limits = case.limits.model_copy(update={one.key: None for one in aims})
    goals = tuple(one for one in case.goal if one.hard)
    changed = {"objective": ObjectiveSection(kind=aim.kind), "limits": limits, "goal": goals}
    return replace(loaded, case=case.model_copy(update=changed))


def _values(loaded: LoadedCase, solution: Solution, aims: tuple[Aim, Aim]) -> tuple[float, float]:
    """Return both objectives of a solution at its operating points, dB."""
    return (_value(loaded, solution, aims[0]), _value(loaded, solution, aims[1]))


def _value(loaded: LoadedCase, solution: Solution, aim: Aim) -> float:
    case = solution.case
    if case.objective.kind == aim.kind:
        return solution.objective_db
    cases = case.model_copy(
        update={"objective": ObjectiveSection(kind=aim.kind), "limits": case.limits.model_copy(update={aim.key: None})}
    )
    nodes, ranges = [flown_point(node) for node in solution.nodes], None
    if case.robust is not None:
        ranges = ranges_of(loaded, nodes)
    plants = plants_of(cases, nodes, solution, ranges)
    return make_problem(cases, plants).evaluate(solution.variables).objective_db


def _slope(solution: Solution, aim: Aim) -> float:
    """Return the derivative of the objective with respect to the limit of a solution, dB per dB."""
    label = QUANTITIES[aim.key].label
    return -sum(c.multiplier for c in solution.constraints if c.what == label and c.limit is not None)
