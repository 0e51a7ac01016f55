"""The search from many starts for one optimum, with measures of its reliability.

Descents from all starts are rough at first, with fewer variables if the law has a simpler form. For PD, this form has
gains linear in time, since the filter determines the optimum to which a start leads. All starts that end at the same
optimum are one candidate. Each candidate that may be the best is then optimised to convergence with all its variables.
From the best point, some of the variables are moved far away at random, and the descent is repeated. Some of these
steps find a better optimum nearby. If the others return to the best point, this is the strongest evidence that no
better one exists. Newton's method refines the best point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.optimise.problem import Problem, ProblemAtPoint
from maxq.design.optimise.sqp import MET_DB, Optimality, descend, optimality, polished

ROUGH_STEPS, ROUGH_DB = 40, 1e-3
FINE_STEPS, FINE_DB = 150, 1e-8
SAME_DB = 0.02  # ends with a smaller difference belong to one optimum
HOPELESS_DB = 3.0  # candidates that are worse by more are not continued
MOST_CANDIDATES = 3
NEAR_DB = 0.05
PATIENCE = 10  # steps after which an unstable start is abandoned; twice this number for a start that is far behind
FAR_MISSED_DB, FAR_BEHIND_DB = 0.3, 4.0
FURTHER_DB = 0.002  # least improvement by a random step that indicates a better optimum
UNSETTLED = 1e-3  # residual of the optimality conditions above which a further search from a best effort is promising

SearchProgress = Callable[[int, int, float, str], None]
"""A function that is called with the completed steps, the total, the best objective so far (dB or nan), and the kind.

The kind is "starts" or "perturbations", or for a robust case "worst plants, round 1". The best objective applies to the
plants of the present round.
"""


@dataclass(frozen=True)
class BestPoint:
    """The best point and the evidence for it.

    `ends_db` contains the objective at the end of each start, and nan where no stable design was found. An infeasible
    best point has the least violation, and its `optimality` is that of the violation.
    """

    best: ProblemAtPoint
    optimality: Optimality
    feasible: bool
    ends_db: Array  # of starts, without leaps
    evaluations: int
    interrupted: bool
    leaps_db: Array  # objective at the end of each random step, or nan

    @property
    def settled(self) -> bool:
        """Return True if the loops are stable and the optimality conditions are met."""
        return self.best.unstable == 0 and self.optimality.residual <= UNSETTLED

    @property
    def near_best(self) -> int:
        """Return the number of starts that ended within NEAR_DB of the best point."""
        return int((self.ends_db <= self.best.objective_db + NEAR_DB).sum())

    @property
    def leaps_back(self) -> int:
        """Return the number of random steps that ended within NEAR_DB of the best point."""
        return int((self.leaps_db <= self.best.objective_db + NEAR_DB).sum())


def search(
    problem: Problem,
    starts: Sequence[Array],
    rough: tuple[Problem, Callable[[Array], Array]] | None = None,
    starts_of_rough: Sequence[Array] = (),
    progress: SearchProgress | None = None,
    leaps: int = 0,
    seed: int = 0,
) -> BestPoint:
    """Search from `starts` of the problem, and from `starts_of_rough` of a smaller problem.

    `rough` is the smaller problem and the conversion of its variables to those of the problem. `leaps` random steps
    from the best candidate may find a better optimum nearby. KeyboardInterrupt ends the search, and the best point so
    far is returned. It is raised again if there is no point yet.
    """
    interrupted = False
    small, lift = rough if rough is not None else (problem, lambda x: x)
    total = len(starts) + len(starts_of_rough) + leaps
    before = problem.evaluations + (small.evaluations if small is not problem else 0)
    ends: list[tuple[ProblemAtPoint, Array]] = []  # rough end, and the corresponding start of the problem
    best_db = np.nan
    try:
        for where, given, to in ((problem, starts, None), (small, starts_of_rough, lift)):
            for start in given:
                end = descend(where, start, ROUGH_STEPS, ROUGH_DB, give_up=partial(_hopeless, best_db))
                ends.append((end, to(end.variables) if to is not None else end.variables))
                if _feasible(end, 1e-3):
                    best_db = float(np.fmin(best_db, end.objective_db))
                if progress is not None:
                    progress(len(ends), total, best_db, "starts")
        if ends and all(end.unstable for end, _ in ends):
            k = min(range(len(ends)), key=lambda n: _rank(ends[n][0]))
            if (mended := _mended(problem, problem.evaluate(ends[k][1]))) is not None:
                ends[k] = mended, mended.variables
    except KeyboardInterrupt:
        interrupted = True
        if not ends:
            raise
    fine: dict[int, ProblemAtPoint] = {}
    leaps_db: list[float] = []
    leapt: ProblemAtPoint | None = None
    # treated separately, since equal ends with all and with few variables belong to different optima
    own = min(len(starts), len(ends))
    candidates = [*_candidates([end for end, _ in ends[:own]])]
    candidates += [own + k for k in _candidates([end for end, _ in ends[own:]])]
    try:
        for k in candidates if not interrupted else ():
            fine[k] = descend(problem, ends[k][1], FINE_STEPS, FINE_DB)
        if fine and leaps > 0 and not interrupted:
            leapt = min(fine.values(), key=_rank)
            for leapt, leap_db in _leapt(problem, leapt, leaps, seed):  # noqa: B020  # each continues from the last
                leaps_db.append(leap_db)
                if progress is not None:
                    progress(len(ends) + len(leaps_db), total, leapt.objective_db, "perturbations")
    except KeyboardInterrupt:
        interrupted = True
    for k in candidates[:1] if not fine else ():
        fine[k] = problem.evaluate(ends[k][1])
    found = _answer(problem, ends, own, fine, leapt, interrupted)
    made = problem.evaluations + (small.evaluations if small is not problem else 0) - before
    return replace(found, leaps_db=np.array(leaps_db), evaluations=made)


def _mended(problem: Problem, at: ProblemAtPoint) -> ProblemAtPoint | None:
    """Return the end of a descent from an unstable point after its gains at unstable plants have been interpolated.

    The gains are interpolated from those of neighbouring plants. Returns None if this makes no loop stable. The rows of
    an unstable loop lead away from -1 on the wrong side. A plant with gains of its own then remains unstable, while all
    other plants reach a good end.
    """
    found = None
    while at.unstable > 0:
        start = problem.law.beside(at.variables, problem.unstable_plants(at.variables))
        if start is None:
            break
        after = descend(problem, start, ROUGH_STEPS, ROUGH_DB, give_up=partial(_hopeless, np.nan))
        if after.unstable >= at.unstable:
            break
        found = at = after
    return found


def _leapt(problem: Problem, best: ProblemAtPoint, leaps: int, seed: int) -> Iterator[tuple[ProblemAtPoint, float]]:
    """Yield the best end so far after each random step from it, and the objective at the end of that step, dB.

    The objective is nan if no stable design was found.
    """
    rng = np.random.default_rng(seed)
    for number in range(leaps):
        leap = best.variables + problem.law.leap_size(number) * rng.standard_normal(problem.size)
        patience = partial(_hopeless, best.objective_db)
        end = descend(problem, leap, ROUGH_STEPS, ROUGH_DB, give_up=patience)
        feasible = _feasible(end, 1e-3)
        if feasible and (end.objective_db < best.objective_db - FURTHER_DB or not _feasible(best, 1e-3)):
            further = descend(problem, end.variables, FINE_STEPS, FINE_DB)
            if _rank(further) < _rank(best):
                best = end = further
        yield best, end.objective_db if feasible else math.nan


def _answer(
    problem: Problem,
    ends: list[tuple[ProblemAtPoint, Array]],
    own: int,
    fine: dict[int, ProblemAtPoint],
    leapt: ProblemAtPoint | None,
    interrupted: bool,
) -> BestPoint:
    best = min([*fine.values(), *([leapt] if leapt is not None else [])], key=_rank)
    feasible = _feasible(best, 10.0 * MET_DB)
    if feasible:
        best, quality = polished(problem, best) if not interrupted else (best, optimality(problem, best))
    else:
        tried = [] if interrupted else [descend(problem, best.variables, FINE_STEPS, 1e-7, limits_only=True)]
        best = min([best, *tried], key=lambda e: (e.unstable, e.violation_db))
        feasible = _feasible(best, 10.0 * MET_DB)
        quality = optimality(problem, best, worst_violation=not feasible)
    ends_db = np.array([end.objective_db if _feasible(end, 1e-3) else np.nan for end, _ in ends])
    rough_db = ends_db.copy()
    for k, end in fine.items():  # other starts at the same optimum would reach the same end
        if _feasible(end, 10.0 * MET_DB):
            same = (np.abs(rough_db - rough_db[k]) <= SAME_DB) & ((np.arange(len(ends)) < own) == (k < own))
            ends_db[same] = np.fmin(ends_db[same], end.objective_db)
    return BestPoint(best, quality, feasible, ends_db, 0, interrupted, np.zeros(0))


def _hopeless(best_db: float, steps: int, at: ProblemAtPoint) -> bool:
    """Return True if a start should be abandoned because it is still unstable or far behind the best value."""
    if steps < PATIENCE:
        return False
    behind = not np.isnan(best_db) and (at.violation_db > FAR_MISSED_DB or at.objective_db > best_db + FAR_BEHIND_DB)
    return at.unstable > 0 or (steps >= 2 * PATIENCE and behind)


def _feasible(at: ProblemAtPoint, tolerance_db: float) -> bool:
    return at.unstable == 0 and at.violation_db <= tolerance_db


def _rank(at: ProblemAtPoint) -> tuple[int, float, float]:
    """Return the sort key of a point: stable before unstable, limits met before violated, then by the objective."""
    violation = 0.0 if at.violation_db <= 10.0 * MET_DB else at.violation_db
    return at.unstable, violation, at.objective_db


def _candidates(ends: Sequence[ProblemAtPoint]) -> list[int]:
    """Return the indices of ends that are worth continuing, the best first, with one end for each optimum."""
    order = sorted(
        range(len(ends)), key=lambda k: (ends[k].unstable, max(ends[k].violation_db - 1e-3, 0.0), ends[k].objective_db)
    )
    out: list[int] = []
    for k in order:
        first = ends[order[0]]
        if out and ((not _feasible(ends[k], 1e-3) and _feasible(first, 1e-3)) or len(out) >= MOST_CANDIDATES):
            break
        if out and _feasible(first, 1e-3) and ends[k].objective_db > first.objective_db + HOPELESS_DB:
            break
        if all(abs(ends[k].objective_db - ends[j].objective_db) > SAME_DB for j in out):
            out.append(k)
    return out
