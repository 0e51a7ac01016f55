"""Newton's method on the active rows, to polish an optimum, and the residual of the optimality conditions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from scipy.optimize import nnls

from maxq.control.kernel.records import Array
from maxq.design.optimise.problem import Evaluation, Problem

ACTIVE_DB = 1e-5
AT_BOUND = 1e-9
LEAST_CURVATURE = 1e-3  # dB per unit of a variable squared; less counts as flat


@dataclass(frozen=True)
class Optimality:
    """Karush-Kuhn-Tucker conditions at a point, with the multipliers that fulfil them best.

    `residual`: largest component of  sum of multipliers times gradients + multipliers of the bounds, as a share of the
    largest component of any active gradient. The objective's multipliers have the sum 1.
    """

    multipliers: Array  # (rows,)
    lower: Array  # (variables,)
    upper: Array
    residual: float


def optimality(problem: Problem, at: Evaluation, worst_violation: bool = False) -> Optimality:
    """By non-negative least squares. `worst_violation`: of the problem whose objective is the largest excess."""
    rows, n = at.rows, problem.size
    if worst_violation:
        leads, others = ~rows.objective & (rows.excess_db > at.violation_db - ACTIVE_DB), np.zeros(len(rows), bool)
    else:
        leads = rows.objective & (rows.excess_db > at.objective_db - ACTIVE_DB)
        others = ~rows.objective & (rows.excess_db > -ACTIVE_DB)
    lead, other = np.flatnonzero(leads), np.flatnonzero(others)
    low = np.flatnonzero(at.variables <= problem.lower + AT_BOUND)
    high = np.flatnonzero(at.variables >= problem.upper - AT_BOUND)
    gradients = at.gradient[np.concatenate([lead, other])]
    scale = max(float(np.abs(gradients).max(initial=0.0)), 1e-12)
    columns = np.concatenate([gradients / scale, -np.eye(n)[low], np.eye(n)[high]])
    # the last equation, weighted so that it holds: the leading rows' multipliers sum to 1
    sums = np.zeros(len(columns))
    sums[: len(lead)] = WEIGHT
    system = np.vstack([columns.T, sums])
    found = nnls(system, np.append(np.zeros(n), WEIGHT))[0]
    total = float(found[: len(lead)].sum())
    found = found / total if total > 0.0 else found
    multipliers = np.zeros(len(rows))
    multipliers[lead], multipliers[other] = found[: len(lead)], found[len(lead) : len(lead) + len(other)]
    lower, upper = np.zeros(n), np.zeros(n)
    rest = found[len(lead) + len(other) :]
    lower[low], upper[high] = rest[: len(low)] * scale, rest[len(low) :] * scale
    return Optimality(multipliers, lower, upper, float(np.abs(columns.T @ found).max(initial=0.0)))


WEIGHT = 10.0


def polished(problem: Problem, at: Evaluation, most: int = 6) -> tuple[Evaluation, Optimality]:
    """Newton steps as long as they bring the residual down and meet the limits."""
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


def _newton(problem: Problem, at: Evaluation, quality: Optimality) -> Array | None:
    """Step to where the active rows hold with equality and the Lagrangian is stationary."""
    active = np.flatnonzero(quality.multipliers > 1e-9)
    free = np.flatnonzero((quality.lower <= 0.0) & (quality.upper <= 0.0))
    if len(active) == 0:
        return None
    gradient, objective = at.gradient[active], at.rows.objective[active]
    # unknowns: the free variables, and t, which counts from the present objective
    rows = np.concatenate([gradient[:, free], -objective[:, None].astype(float)], axis=1)
    right = -(at.rows.excess_db[active] - np.where(objective, at.objective_db, 0.0))
    step = np.linalg.lstsq(rows, right, rcond=1e-10)[0]
    null = scipy.linalg.null_space(rows, rcond=1e-10)
    if null.shape[1] > 0:
        n = len(free)
        quadratic = np.zeros((n + 1, n + 1))
        quadratic[:n, :n] = problem.curvature(at, np.where(quality.multipliers > 1e-9, quality.multipliers, 0.0))[
            np.ix_(free, free)
        ]
        slope = np.append(np.zeros(n), 1.0) + quadratic @ step
        values, vectors = np.linalg.eigh(null.T @ quadratic @ null)
        steep = values > LEAST_CURVATURE
        along = vectors.T @ (null.T @ slope)
        step = step - null @ (vectors @ np.where(steep, along / np.where(steep, values, 1.0), 0.0))
    change = np.zeros(problem.size)
    change[free] = step[: len(free)]
    return change
