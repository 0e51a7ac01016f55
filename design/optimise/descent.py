"""From one start to a local optimum: sequential quadratic programming for minimax problems within a trust region.

Each step minimises  t + penalty v + d'Bd/2  with every linearised peak of the objective at most t and every other
excess at most v >= 0, B the Lagrangian's second derivatives made positive semidefinite. Where rows curve so much that
the step gains little, it is tried once more with the rows as the trial point has them (second-order correction:
without it the penalty on a limit that bends makes steps creep, Maratos' effect). A step counts only for what it does
to the real problem: all peaks and crossings are found and solved for anew, and the closed loop must stay stable.

Linear programmes alone (B = 0) creep wherever fewer rows are active than there are variables: from one start of F6 with
free gains they stood at -10.4 dB after 120 steps, this at -13.4 dB after 29.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.optimise.curves import Indices
from maxq.design.optimise.problem import Evaluation, Problem
from maxq.design.optimise.quadratic_programme import solve_quadratic

FIRST_RADIUS = 0.3
LARGEST_RADIUS = 1.0
LEAST_RADIUS = 1e-9
FIRST_PENALTY = 100.0
LARGEST_PENALTY = 1e4
RIDGE = 1e-2  # dB per unit of a variable squared: variables that do nothing stay where they are
MET_DB = 1e-7  # a limit that is violated by less is met


@dataclass(frozen=True)
class Step:
    """Solution of the model: step, predicted merit, multipliers of the rows."""

    change: Array
    merit: float
    multipliers: Array


@dataclass(frozen=True)
class Descent:
    """Where a start ended."""

    end: Evaluation
    steps: int
    converged: bool


@dataclass(frozen=True)
class Merit:
    """What a step must bring down: weight of the objective (0: only the limits count) and of the largest excess."""

    objective: float
    penalty: float

    def of(self, at: Evaluation) -> float:
        """Unstable points are worse than any stable one, the fewer unstable poles the better."""
        value = self.objective * at.objective_db + self.penalty * at.violation_db
        return value + 1e7 * at.unstable


def model_step(
    problem: Problem, at: Evaluation, curvature: Array, radius: float, merit: Merit, excess_db: Array | None = None
) -> Step:
    """The best step within |d| <= radius for a positive semidefinite `curvature`.

    `excess_db` of the rows in place of theirs: with a second-order correction.
    """
    rows, n = at.rows, problem.size
    excess_db = rows.excess_db if excess_db is None else excess_db
    a = np.zeros((len(rows), n + 2))
    a[:, :n] = at.gradient
    a[rows.objective, n] = -1.0
    a[~rows.objective, n + 1] = -1.0
    # t counts from the present objective
    right = np.where(rows.objective, at.objective_db, 0.0) - excess_db
    linear = np.zeros(n + 2)
    linear[n], linear[n + 1] = max(merit.objective, 1e-9), merit.penalty
    quadratic = np.zeros((n + 2, n + 2))
    quadratic[:n, :n] = curvature
    lower, upper = np.full(n + 2, -np.inf), np.full(n + 2, np.inf)
    lower[:n] = np.minimum(np.maximum(problem.lower - at.variables, -radius), 0.0)
    upper[:n] = np.maximum(np.minimum(problem.upper - at.variables, radius), 0.0)
    lower[n], lower[n + 1] = -1e3, 0.0
    start = np.zeros(n + 2)
    start[n], start[n + 1] = 1.0, at.violation_db + 0.1
    found = solve_quadratic(quadratic, linear, a, right, lower, upper, start)
    change = np.clip(found.z[:n], lower[:n], upper[:n])
    promised = float(linear @ found.z + 0.5 * change @ curvature @ change)
    return Step(change, merit.objective * at.objective_db + promised + 1e7 * at.unstable, found.rows)


def positive_part(matrix: Array) -> Array:
    """The matrix with its negative eigenvalues set to zero, and a small ridge."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * (np.maximum(values, 0.0) + RIDGE)) @ vectors.T)


def descend(
    problem: Problem,
    start: Array,
    most: int = 80,
    tolerance_db: float = 1e-7,
    limits_only: bool = False,
    give_up: Callable[[int, Evaluation], bool] | None = None,
) -> Descent:
    """Run until no step promises `tolerance_db`, or `give_up` finds the point hopeless after a number of steps.

    `limits_only`: bring down the largest excess, whatever the objective.
    """
    at = problem.evaluate(np.clip(start, problem.lower, problem.upper))
    merit = Merit(0.0, 1.0) if limits_only else Merit(1.0, FIRST_PENALTY)
    radius = FIRST_RADIUS
    multipliers: Array | None = None
    for count in range(most):
        if give_up is not None and give_up(count, at):
            return Descent(at, count, False)
        if limits_only and at.violation_db == 0.0 and at.unstable == 0:
            return Descent(at, count, True)
        if multipliers is None:
            curvature = RIDGE * np.eye(problem.size)
        else:
            curvature = positive_part(problem.curvature(at, multipliers))
        moved = _step(problem, at, curvature, radius, merit, tolerance_db)
        if moved is None:
            if limits_only or at.violation_db <= MET_DB or merit.penalty >= LARGEST_PENALTY:
                return Descent(at, count, at.unstable == 0)
            merit = Merit(1.0, 10.0 * merit.penalty)
            radius = max(radius, 0.03)
            continue
        step, after, radius = moved
        if radius < LEAST_RADIUS:
            return Descent(at, count, False)
        multipliers = matched(step.multipliers, at, after)
        at = after
    return Descent(at, most, False)


def _step(
    problem: Problem, at: Evaluation, curvature: Array, radius: float, merit: Merit, tolerance_db: float
) -> tuple[Step, Evaluation, float] | None:
    """The model's step, the point it leads to and the next radius; None where the model promises nothing."""
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


def _moved(problem: Problem, at: Evaluation, change: Array) -> Evaluation:
    return problem.evaluate(np.clip(at.variables + change, problem.lower, problem.upper))


def counterparts(before: Evaluation, after: Evaluation, which: Indices) -> tuple[Indices, Indices]:
    """Rows number `which` of one point, and the rows of another that are the same feature, nearest in frequency."""
    a, b = before.rows, after.rows
    key_a, key_b = (
        ((r.plant + 1) * 16 + r.what) * 32 + (r.feature + 1) * 2 + r.objective.astype(np.int64) for r in (a, b)
    )
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


def _corrected_excess(at: Evaluation, trial: Evaluation, change: Array) -> Array:
    """Excess of the rows such that the linear model agrees with the trial point."""
    out = at.rows.excess_db.copy()
    mine, theirs = counterparts(at, trial, np.arange(len(at.rows), dtype=np.int64))
    out[mine] = trial.rows.excess_db[theirs] - at.gradient[mine] @ change
    return out


def matched(multipliers: Array, before: Evaluation, after: Evaluation) -> Array:
    """Multipliers for the rows at another point."""
    out = np.zeros(len(after.rows))
    mine, theirs = counterparts(before, after, np.flatnonzero(multipliers > 1e-7).astype(np.int64))
    for i, j in zip(mine, theirs, strict=True):
        out[j] += multipliers[i]
    return out
