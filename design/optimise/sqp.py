"""The descent from one start to a local optimum, by sequential quadratic programming in a trust region.

The method solves minimax problems. Newton's method on the active rows completes the descent and gives the residual of
the optimality conditions.

Each step minimises t + penalty v + d'Bd/2, with every linearised peak of the objective at most t and every other excess
at most v >= 0. An objective of several terms has a t for each. B is the matrix of the Lagrangian's second derivatives,
made positive semidefinite. If curved rows reduce the gain of a step, the step is repeated once with the rows as
evaluated at the trial point (second-order correction). Without it, the penalty on a curved limit makes steps very short
(Maratos effect). A step is accepted only for its effect on the real problem. All peaks and crossings are solved for
again, and the closed loop must remain stable.

Linear programmes alone (B = 0) converge slowly wherever fewer rows are active than there are variables. From one start
of F6 with free gains, they reached -10.4 dB after 120 steps, compared with -13.4 dB after 29 steps of this method.

General solvers such as SLSQP and IPOPT assume a fixed set of functions. They are not suitable, because peaks and
crossings appear and vanish with the variables, and because a step into instability must be rejected. Only searches
without gradients were compared. In 20 to 300 s of processor time, differential evolution and CMA-ES found nothing
better than this method in 0.6 to 2 s (docs/performance.md, tools/dev/bench/optimise.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array
from maxq.design.optimise.curves import CurveIndices
from maxq.design.optimise.problem import Problem, ProblemAtPoint, level_of
from maxq.design.optimise.quadratic_programme import solve_quadratic

FIRST_RADIUS = 0.3
LARGEST_RADIUS = 1.0
LEAST_RADIUS = 1e-9
FIRST_PENALTY = 100.0
LARGEST_PENALTY = 1e4
RIDGE = 1e-2  # dB per unit of a variable squared; keeps the values of variables without effect
MET_DB = 1e-7  # largest violation that counts as met
ACTIVE_DB = 1e-5
AT_BOUND = 1e-9
LEAST_CURVATURE = 1e-3  # dB per unit of a variable squared; smaller curvature counts as flat
WEIGHT = 10.0  # weight of the equation that the leading rows' multipliers sum to 1


@dataclass(frozen=True)
class Step:
    """The solution of the model: step, predicted merit, and multipliers of the rows."""

    change: Array
    merit: float
    multipliers: Array


@dataclass(frozen=True)
class Merit:
    """The merit that a step must lower: the weights of the objective and of the largest excess.

    An `objective` weight of 0 considers the limits only.
    """

    objective: float
    penalty: float

    def of(self, at: ProblemAtPoint) -> float:
        """Return the merit of a point.

        Unstable points are worse than any stable point, and more unstable poles are worse than fewer.
        """
        value = self.objective * at.objective_db + self.penalty * at.violation_db
        return value + 1e7 * at.unstable


def model_step(
    problem: Problem, at: ProblemAtPoint, curvature: Array, radius: float, merit: Merit, excess_db: Array | None = None
) -> Step:
    """Return the best step of the model with |d| <= radius, for a positive semidefinite `curvature`.

    `excess_db` replaces the excess of the rows, for a second-order correction.
    """
    rows, n, terms = at.rows, problem.size, len(at.levels_db)
    excess_db = rows.excess_db if excess_db is None else excess_db
    last = n + terms  # unknowns: the step, t of each term of the objective, v
    a = np.zeros((len(rows), last + 1))
    a[:, :n] = at.gradient
    made_small = np.flatnonzero(rows.objective)
    a[made_small, n + rows.term[made_small]] = -1.0
    a[~rows.objective, last] = -1.0
    # t is relative to the present level of its term
    right = level_of(rows, at.levels_db) - excess_db
    linear = np.zeros(last + 1)
    linear[n:last], linear[last] = max(merit.objective, 1e-9), merit.penalty
    quadratic = np.zeros((last + 1, last + 1))
    quadratic[:n, :n] = curvature
    lower, upper = np.full(last + 1, -np.inf), np.full(last + 1, np.inf)
    lower[:n] = np.minimum(np.maximum(problem.lower - at.variables, -radius), 0.0)
    upper[:n] = np.maximum(np.minimum(problem.upper - at.variables, radius), 0.0)
    lower[n:last], lower[last] = -1e3, 0.0
    start = np.zeros(last + 1)
    start[n:last], start[last] = 1.0, at.violation_db + 0.1
    found = solve_quadratic(quadratic, linear, a, right, lower, upper, start)
    change = np.clip(found.z[:n], lower[:n], upper[:n])
    promised = float(linear @ found.z + 0.5 * change @ curvature @ change)
    return Step(change, merit.objective * at.objective_db + promised + 1e7 * at.unstable, found.rows)


def descend(
    problem: Problem,
    start: Array,
    most: int = 80,
    tolerance_db: float = 1e-7,
    limits_only: bool = False,
    give_up: Callable[[int, ProblemAtPoint], bool] | None = None,
) -> ProblemAtPoint:
    """Return the end point of a descent from a start.

    The descent ends after `most` steps, if no step is predicted to gain `tolerance_db`, or if `give_up` returns True
    for the number of steps and the point. `limits_only` lowers the largest excess and ignores the objective.
    """
    at = problem.evaluate(np.clip(start, problem.lower, problem.upper))
    merit = Merit(0.0, 1.0) if limits_only else Merit(1.0, FIRST_PENALTY)
    radius = FIRST_RADIUS
    multipliers: Array | None = None
    for count in range(most):
        if give_up is not None and give_up(count, at):
            break
        if limits_only and at.violation_db == 0.0 and at.unstable == 0:
            break
        curvature = RIDGE * np.eye(problem.size)
        if multipliers is not None:
            values, vectors = np.linalg.eigh(problem.curvature(at, multipliers))
            curvature = (vectors * (np.maximum(values, 0.0) + RIDGE)) @ vectors.T
        moved = _step(problem, at, curvature, radius, merit, tolerance_db)
        if moved is None:
            if limits_only or at.violation_db <= MET_DB or merit.penalty >= LARGEST_PENALTY:
                break
            merit = Merit(1.0, 10.0 * merit.penalty)
            radius = max(radius, 0.03)
            continue
        step, after, radius = moved
        if radius < LEAST_RADIUS:
            break
        multipliers = matched(step.multipliers, at, after)
        at = after
    return at


def _step(
    problem: Problem, at: ProblemAtPoint, curvature: Array, radius: float, merit: Merit, tolerance_db: float
) -> tuple[Step, ProblemAtPoint, float] | None:
    """Return the step of the model, the point at its end and the next radius.

    Returns None if the model predicts no improvement.
    """
    before = merit.of(at)
    while True:
        step = model_step(problem, at, curvature, radius, merit)
        promised = before - step.merit
        if promised < tolerance_db:
            return None
        after = _moved(problem, at, step.change)
        if before - merit.of(after) < 0.75 * promised and after.unstable <= at.unstable:
            corrected = _corrected_excess(at, after, step.change)
            bent = _moved(problem, at, model_step(problem, at, curvature, radius, merit, corrected).change)
            after = min((after, bent), key=merit.of)
        gain, size = before - merit.of(after), float(np.abs(step.change).max())
        if gain > 0.75 * promised and size > 0.9 * radius:
            radius = min(2.0 * radius, LARGEST_RADIUS)
        elif gain < 0.25 * promised:
            radius = min(radius, size) * (0.5 if gain > 0.0 else 0.25)
        if gain > 1e-3 * promised or radius < LEAST_RADIUS:
            return step, after, radius


def _moved(problem: Problem, at: ProblemAtPoint, change: Array) -> ProblemAtPoint:
    return problem.evaluate(np.clip(at.variables + change, problem.lower, problem.upper))


def counterparts(
    before: ProblemAtPoint, after: ProblemAtPoint, which: CurveIndices
) -> tuple[CurveIndices, CurveIndices]:
    """Return the rows among `which` of one point that exist at another point, and the corresponding rows there.

    Rows correspond if they are the same feature of the same plant, nearest in frequency.
    """
    a, b = before.rows, after.rows
    key_a, key_b = (((r.plant + 1) * 64 + r.what) * 16 + r.feature + 1 for r in (a, b))
    by_key: dict[int, list[int]] = {}
    for k, key in enumerate(key_b.tolist()):
        by_key.setdefault(key, []).append(k)
    found, partner = [], []
    for i in which.tolist():
        same = by_key.get(int(key_a[i]))
        if same is not None:
            distance = np.abs(b.x[same] - a.x[i])
            found.append(i)
            partner.append(same[int(np.argmin(distance))])
    return np.array(found, np.int64), np.array(partner, np.int64)


def _corrected_excess(at: ProblemAtPoint, trial: ProblemAtPoint, change: Array) -> Array:
    """Return the excess of the rows for which the linear model agrees with the trial point."""
    out = at.rows.excess_db.copy()
    mine, theirs = counterparts(at, trial, np.arange(len(at.rows), dtype=np.int64))
    out[mine] = trial.rows.excess_db[theirs] - at.gradient[mine] @ change
    return out


def matched(multipliers: Array, before: ProblemAtPoint, after: ProblemAtPoint) -> Array:
    """Return the multipliers transferred to the rows of another point."""
    out = np.zeros(len(after.rows))
    mine, theirs = counterparts(before, after, np.flatnonzero(multipliers > 1e-7).astype(np.int64))
    for i, j in zip(mine, theirs, strict=True):
        out[j] += multipliers[i]
    return out


@dataclass(frozen=True)
class Optimality:
    """The Karush-Kuhn-Tucker conditions at a point, with the multipliers that satisfy them best.

    `residual` is the largest component of the sum of multipliers times gradients, including those of the bounds. It is
    relative to the largest component of any active gradient. The multipliers of the objective sum to 1 in each of its
    terms.
    """

    multipliers: Array  # (rows,)
    lower: Array  # (variables,)
    upper: Array
    residual: float


def optimality(problem: Problem, at: ProblemAtPoint, worst_violation: bool = False) -> Optimality:
    """Return the multipliers of a point, by non-negative least squares.

    Without a leading row, the residual is infinite. `worst_violation` selects the problem with the largest excess as
    its objective.
    """
    rows, n = at.rows, problem.size
    if worst_violation:
        leads, others = ~rows.objective & (rows.excess_db > at.violation_db - ACTIVE_DB), np.zeros(len(rows), bool)
    else:
        leads = rows.objective & (at.over_db > -ACTIVE_DB)
        others = ~rows.objective & (rows.excess_db > -ACTIVE_DB)
    lead, other = np.flatnonzero(leads), np.flatnonzero(others)
    if not len(lead):  # as at an unstable point; SciPy's nnls crashes on a matrix without columns
        return Optimality(np.zeros(len(rows)), np.zeros(n), np.zeros(n), math.inf)
    low = np.flatnonzero(at.variables <= problem.lower + AT_BOUND)
    high = np.flatnonzero(at.variables >= problem.upper - AT_BOUND)
    gradients = at.gradient[np.concatenate([lead, other])]
    scale = max(float(np.abs(gradients).max(initial=0.0)), 1e-12)
    columns = np.concatenate([gradients / scale, -np.eye(n)[low], np.eye(n)[high]])
    # the last equations, with a high weight: the leading rows' multipliers sum to 1 in each term
    terms = np.unique(rows.term[lead])
    sums = np.zeros((len(terms), len(columns)))
    sums[:, : len(lead)] = WEIGHT * (rows.term[lead] == terms[:, None])
    system = np.vstack([columns.T, sums])
    found = scipy.optimize.nnls(system, np.append(np.zeros(n), np.full(len(terms), WEIGHT)))[0]
    total = float(found[: len(lead)].sum()) / len(terms)
    found = found / total if total > 0.0 else found
    multipliers = np.zeros(len(rows))
    multipliers[lead], multipliers[other] = found[: len(lead)], found[len(lead) : len(lead) + len(other)]
    lower, upper = np.zeros(n), np.zeros(n)
    rest = found[len(lead) + len(other) :]
    lower[low], upper[high] = rest[: len(low)] * scale, rest[len(low) :] * scale
    return Optimality(multipliers, lower, upper, float(np.abs(columns.T @ found).max(initial=0.0)))


def polished(problem: Problem, at: ProblemAtPoint, most: int = 6) -> tuple[ProblemAtPoint, Optimality]:
    """Improve a point by at most `most` Newton steps that lower the residual and meet the limits.

    Returns the point and its optimality.
    """
    best, quality = at, optimality(problem, at)
    for _ in range(most):
        if quality.residual < 1e-11:
            break
        change = _newton(problem, best, quality)
        if change is None or float(np.abs(change).max(initial=0.0)) > 0.05:
            break
        trial = problem.evaluate(np.clip(best.variables + change, problem.lower, problem.upper))
        if trial.unstable > 0 or trial.violation_db > max(1e-9, best.violation_db):
            break
        if trial.objective_db > best.objective_db + 1e-6:
            break
        again = optimality(problem, trial)
        if again.residual >= quality.residual:
            break
        best, quality = trial, again
    return best, quality


def _newton(problem: Problem, at: ProblemAtPoint, quality: Optimality) -> Array | None:
    """Return the step to the point at which the active rows hold with equality and the Lagrangian is stationary.

    Returns None without active rows.
    """
    active = np.flatnonzero(quality.multipliers > 1e-9)
    free = np.flatnonzero((quality.lower <= 0.0) & (quality.upper <= 0.0))
    if len(active) == 0:
        return None
    gradient, term = at.gradient[active], at.rows.term[active]
    terms = np.unique(term[term >= 0])
    # unknowns: the free variables, and t of each term relative to its present level
    rows = np.concatenate([gradient[:, free], -(term[:, None] == terms).astype(float)], axis=1)
    right = -at.over_db[active]
    step = np.linalg.lstsq(rows, right, rcond=1e-10)[0]
    null = scipy.linalg.null_space(rows, rcond=1e-10)
    if null.shape[1] > 0:
        n = len(free)
        quadratic = np.zeros((n + len(terms), n + len(terms)))
        quadratic[:n, :n] = problem.curvature(at, np.where(quality.multipliers > 1e-9, quality.multipliers, 0.0))[
            np.ix_(free, free)
        ]
        slope = np.append(np.zeros(n), np.ones(len(terms))) + quadratic @ step
        values, vectors = np.linalg.eigh(null.T @ quadratic @ null)
        steep = values > LEAST_CURVATURE
        along = vectors.T @ (null.T @ slope)
        step = step - null @ (vectors @ np.where(steep, along / np.where(steep, values, 1.0), 0.0))
    change = np.zeros(problem.size)
    change[free] = step[: len(free)]
    return change
