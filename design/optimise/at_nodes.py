"""The solution of a case at its operating points: problem, search from all starts, and stability check by poles."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.case.goals import TRANSFERS
from maxq.design.case.schema import Case, LoadedCase
from maxq.design.laws.law import DesignedLaw, LawVariables
from maxq.design.laws.registry import law_kind
from maxq.design.loop.fixed_path import ExactFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.optimise.criteria import ASSESSED, OBJECTIVES, Criterion, criterion_of
from maxq.design.optimise.loops import Loops
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.problem import Problem, ProblemAtPoint, ProblemGoals
from maxq.design.optimise.response_goals import ResponseGoal, ResponseGoals
from maxq.design.optimise.search import FINE_STEPS, PATIENCE, BestPoint, SearchProgress, search
from maxq.design.optimise.solution import MET_DB, Solution, make_solution
from maxq.design.optimise.sqp import descend
from maxq.design.optimise.templates import bands_of_goals
from maxq.design.quantities import STEPS

MORE_STARTS = 3  # factor on the number of starts if the limits cannot be met
LEAST_EVALUATIONS = 60  # minimum number of evaluations of a search for the limits alone
FREED = ("second_mode_db", "filter_gain_at_infinity", "rigid_hz", "rigid_zeta")
"""The limits that are omitted in turn if no stable design is found."""
LIMITS_DB = 1e-7  # smallest improvement per step in such a search


def make_problem(case: Case, plants: Plants, like: LawVariables | None = None) -> Problem:
    """Return the optimisation problem of a case.

    `like` is the law of another problem of the same case, whose fixed results are reused.
    """
    return _problem_of(case, plants, law_kind(case.law).variables(plants.task(case), like))


def _problem_of(case: Case, plants: Plants, law: LawVariables) -> Problem:
    loops = Loops(plants.curves, plants.unstable_open, law)
    objective, limits = OBJECTIVES[case.objective.kind], plants.task(case).limits
    return Problem(loops, plants.bands, limits, case.limits, objective, _goals_of(case, plants, law))


def _goals_of(case: Case, plants: Plants, law: LawVariables) -> ProblemGoals:
    """Return the goals of a case in the form of the optimiser."""
    term_of = {id(one): case.term_of(k) for k, one in case.soft_goals.items()}
    applies = [np.array([one.applies(p.node.time_s, p.dispersed) for p in plants.each], bool) for one in case.goal]
    bands = bands_of_goals(case.goal, applies, plants.curves)
    criteria, responses = list[Criterion](), list[ResponseGoal]()
    for k, (one, where) in enumerate(zip(case.goal, applies, strict=True)):
        term = term_of.get(id(one), -1)
        if one.quantity in STEPS or one.quantity == "function":
            responses.append(ResponseGoal(one, where, term))
        elif one.quantity in TRANSFERS or one.quantity in ASSESSED:
            criteria.append(criterion_of(one, k, term, where, bands))
    data = [p.goal_data for p in plants.each if p.goal_data is not None]
    terms = 1 + max((case.term_of(k) for k in case.soft_goals), default=0)
    return ProblemGoals(tuple(criteria), bands, ResponseGoals(responses, law, data, plants.times_s), terms)


def solve_at_nodes(
    loaded: LoadedCase, plants: Plants, also_from: Sequence[DesignedLaw] = (), progress: SearchProgress | None = None
) -> Solution:
    """Return the best design found for the plants at the operating points of the case.

    If no stable design is found, the limits that a case can omit are omitted in turn, and the search is repeated from
    two starts. `Solution.stable_without` lists the limits without which a stable design was found.
    """
    begun, case = time.perf_counter(), loaded.case
    problem, found = search_best(case, plants, also_from, progress)
    solution = finished(case, plants, problem, found, begun)
    if solution.certificate.stable or solution.status == "interrupted":
        return solution
    freed = []
    for name in (n for n in FREED if n not in case.limits.without):
        limits = case.limits.model_copy(update={"without": (*case.limits.without, name)})
        fewer = case.search.model_copy(update={"starts": 2, "leaps": 0})
        freer = case.model_copy(update={"limits": limits, "search": fewer})
        if finished(freer, plants, *search_best(freer, plants), begun).certificate.stable:
            freed.append(name)
    return replace(solution, stable_without=tuple(freed))


def finished(case: Case, plants: Plants, problem: Problem, found: BestPoint, begun: float) -> Solution:
    """Return the solution at the best point of a search, with its stability checked by poles."""
    seconds = time.perf_counter() - begun
    stable = closes_stably(plants, problem, found.best.variables)
    return make_solution(case, plants, problem, found, seconds, stable)


def search_best(
    case: Case, plants: Plants, also_from: Sequence[DesignedLaw] = (), progress: SearchProgress | None = None
) -> tuple[Problem, BestPoint]:
    """Search from all starts: those of other laws, and the law's own starts in the number that the case specifies.

    If no start meets the limits, the search is repeated from `MORE_STARTS` times as many starts, and finally for the
    limits alone. The violation has local minima of its own, and the starts that suit the objective may miss the best of
    them.
    """
    problem, found = _search_from(case, plants, also_from, progress)
    if found.feasible or found.interrupted:
        return problem, found
    wanted = case.search.model_copy(update={"starts": MORE_STARTS * case.search.starts, "leaps": 0})
    again = _search_from(case.model_copy(update={"search": wanted}), plants, also_from, progress)[1]
    better = min(found, again, key=lambda f: (not f.feasible, f.best.unstable, f.best.violation_db))
    made = found.evaluations + again.evaluations
    return problem, search_on(case, problem, replace(better, evaluations=made, interrupted=again.interrupted))


def search_on(case: Case, problem: Problem, found: BestPoint, also_settled: bool = False) -> BestPoint:
    """Return the better point after a search for the limits alone, from a search that misses them.

    The search begins at the best effort and at the law's own starts. It uses about half the number of evaluations of
    the previous search. `also_settled` includes a best effort that is settled.
    """
    if found.feasible or found.interrupted or (found.settled and not also_settled):
        return found
    before, own = problem.evaluations, problem.law.starts(MORE_STARTS * case.search.starts, case.search.seed)
    try:
        most = before + max(LEAST_EVALUATIONS, found.evaluations // 2)
        end = meet_limits(problem, [found.best.variables, *own], most)
        again = search(problem, [end.variables]) if limits_rank(end) < limits_rank(found.best) else found
    except KeyboardInterrupt:
        return replace(found, interrupted=True)
    better = min(again, found, key=lambda f: (not f.feasible, *limits_rank(f.best)))
    return replace(better, evaluations=found.evaluations + problem.evaluations - before)


def meet_limits(
    problem: Problem, starts: Sequence[Array], most: int, progress: Callable[[ProblemAtPoint], None] = lambda _: None
) -> ProblemAtPoint:
    """Return the point with the least violation among the results of descents from all starts.

    The search ends at the first point that meets the limits, or after `most` evaluations of the problem. `progress` is
    called with the best point so far.
    """
    best: ProblemAtPoint | None = None

    def watch(count: int, at: ProblemAtPoint) -> bool:
        nonlocal best
        best = at if best is None else min(best, at, key=limits_rank)
        progress(best)
        return problem.evaluations >= most or (count >= PATIENCE and at.unstable > best.unstable)

    for start in starts:
        watch(0, descend(problem, start, FINE_STEPS, LIMITS_DB, limits_only=True, give_up=watch))
        if problem.evaluations >= most or (best is not None and limits_rank(best) <= (0, MET_DB)):
            break
    assert best is not None
    return best


def limits_rank(at: ProblemAtPoint) -> tuple[int, float]:
    """Return the sort key of a point if only the limits count. Stable points precede unstable points."""
    return at.unstable, at.violation_db


def _search_from(
    case: Case, plants: Plants, also_from: Sequence[DesignedLaw], progress: SearchProgress | None
) -> tuple[Problem, BestPoint]:
    problem = make_problem(case, plants)
    law, (count, leaps, seed) = problem.law, (case.search.starts, case.search.leaps, case.search.seed)
    given = [x for x in map(law.variables_of, also_from) if x is not None]
    simpler = law.simpler()
    if simpler is None:
        starts = [*given, *law.starts(count, seed)]
        if case.variable:  # starts that differ in fixed variables alone are equal
            starts = list({np.clip(x, law.lower, law.upper).round(9).tobytes(): x for x in starts}.values())
        return problem, search(problem, starts, progress=progress, leaps=leaps, seed=seed)
    # one start has all variables, and the others have few for a low cost
    few, lift = simpler
    own, fresh = law.starts(1, seed), few.starts(count, seed)[: count - 1]
    return problem, search(
        problem, [*given, *own], (_problem_of(case, plants, few), lift), fresh, progress, leaps, seed
    )


def closes_stably(plants: Plants, problem: Problem, variables: Array) -> bool:
    """Return True if every closed loop is stable by its eigenvalues.

    The optimiser uses the argument principle instead, so that the check is independent.
    """
    for plant, law in zip(plants.each, problem.law.controllers(variables), strict=True):
        poles = plant.without_drift(Loop(plant.path, law).closed_poles())
        if isinstance(plant.path, ExactFixedPath):
            poles = poles[np.abs(poles) < 1e3]
        if len(poles) > 0 and float(poles.real.max()) >= 0.0:
            return False
    return True
