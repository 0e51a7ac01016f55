"""A small dense convex quadratic programme: primal-dual interior point with Mehrotra's predictor and corrector.

SciPy has no solver for it. With 40 unknowns and 200 rows this one takes 1 to 4 ms.
Nocedal & Wright, Numerical Optimization (2nd ed.), section 16.6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from maxq.control.records import Array

MOST_ITERATIONS = 60
TOLERANCE = 1e-10
TO_BOUNDARY = 0.995


@dataclass(frozen=True)
class QuadraticSolution:
    """Point, multipliers of the rows and of the bounds (lower, upper), all 0 or more."""

    z: Array
    rows: Array
    lower: Array
    upper: Array
    converged: bool


def solve_quadratic(
    quadratic: Array, linear: Array, rows: Array, right: Array, lower: Array, upper: Array, start: Array
) -> QuadraticSolution:
    """Least z'Qz/2 + c'z with rows z <= right and lower <= z <= upper (infinite: no bound); Q positive semidefinite."""
    below, above = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
    m, p = len(rows), len(below)
    limit = np.concatenate([right, -lower[below], upper[above]])

    def times(z: Array) -> Array:
        return np.concatenate([rows @ z, -z[below], z[above]])

    def transposed(w: Array) -> Array:
        out = np.asarray(w[:m] @ rows)
        out[below] -= w[m : m + p]
        out[above] += w[m + p :]
        return out

    z = start.copy()
    slack = np.maximum(limit - times(z), 1e-2)
    dual = np.full(len(slack), 1e-1) / np.maximum(slack, 1e-1)
    scale = 1.0 + float(np.abs(linear).max())
    converged = False
    for _ in range(MOST_ITERATIONS):
        stationarity = quadratic @ z + linear + transposed(dual)
        primal = times(z) + slack - limit
        gap = float(slack @ dual) / len(slack)
        if max(float(np.abs(stationarity).max()) / scale, float(np.abs(primal).max()), gap) < TOLERANCE:
            converged = True
            break
        weight = dual / slack
        matrix = quadratic + (rows.T * weight[:m]) @ rows
        diagonal = np.zeros(len(z))
        diagonal[below] += weight[m : m + p]
        diagonal[above] += weight[m + p :]
        matrix[np.diag_indices(len(z))] += diagonal + 1e-13 * (1.0 + diagonal)
        try:
            factor = scipy.linalg.cho_factor(matrix, check_finite=False)
        except scipy.linalg.LinAlgError:
            break

        kkt = _Kkt(factor, stationarity, primal, weight, slack, dual, times, transposed)
        _, ds, dl = kkt.direction(np.zeros(len(slack)))
        reach_s, reach_l = _longest(slack, ds), _longest(dual, dl)
        ahead = float((slack + reach_s * ds) @ (dual + reach_l * dl)) / len(slack)
        dz, ds, dl = kkt.direction((ahead / gap) ** 3 * gap - ds * dl)
        reach = min(TO_BOUNDARY * _longest(slack, ds), TO_BOUNDARY * _longest(dual, dl), 1.0)
        z, slack, dual = z + reach * dz, slack + reach * ds, dual + reach * dl
    lower_dual, upper_dual = np.zeros(len(z)), np.zeros(len(z))
    lower_dual[below], upper_dual[above] = dual[m : m + p], dual[m + p :]
    return QuadraticSolution(z, dual[:m], lower_dual, upper_dual, converged)


@dataclass(frozen=True)
class _Kkt:
    """The linear system of an iteration, factored once for predictor and corrector."""

    factor: Any
    stationarity: Array
    primal: Array
    weight: Array
    slack: Array
    dual: Array
    times: Callable[[Array], Array]
    transposed: Callable[[Array], Array]

    def direction(self, target: Array) -> tuple[Array, Array, Array]:
        """Steps of z, slack and dual towards slack * dual = target."""
        short = target - self.slack * self.dual
        pull = short / self.slack + self.weight * self.primal
        dz = scipy.linalg.cho_solve(self.factor, -self.stationarity - self.transposed(pull), check_finite=False)
        ds = -self.primal - self.times(dz)
        return dz, ds, (short - self.dual * ds) / self.slack


def _longest(value: Array, change: Array) -> float:
    """Largest step up to 1/TO_BOUNDARY that keeps the values positive."""
    falling = change < 0.0
    return float(min(1.0 / TO_BOUNDARY, (-value[falling] / change[falling]).min(initial=np.inf)))
