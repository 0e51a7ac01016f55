"""Turning points of the curve: peaks of |L|, least distances, and near misses between two points of the grid."""

from __future__ import annotations

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.design.margins.curve import Curve, sample
from maxq.design.margins.objectives import (
    along,
    complementary,
    log_size,
    minus_log_size,
    minus_sine,
    sensitivity,
    sine,
    symmetric,
)
from maxq.design.margins.solving import minima

LOWEST_PEAK = np.log(1e-3)  # peaks below -60 dB are not refined
REACH = 4.0  # a minimum may lie lower than its parabola by this many times the parabola's drop

_OBJECTIVES = (sensitivity, complementary, symmetric, minus_log_size, log_size, sine, minus_sine)


def refine_extremes(curve: Curve) -> Curve:
    """The curve with its turning points solved for and added.

    They are the minima of |1 + L|, |1 + 1/L| and |1 + L|/|1 - L| that may be the least of all, the maxima of |L|,
    and those of |L| and of the phase that may reach 1 and 180 degrees where the points of the grid do not.
    """
    triples = [_candidates(curve, k) for k in range(len(_OBJECTIVES))]
    kind = np.concatenate([np.full(len(middle), k) for k, (middle, _) in enumerate(triples)])
    middle = np.concatenate([m for m, _ in triples])
    values = np.concatenate([v for _, v in triples])
    if not len(middle):
        return curve
    f = curve.frequency_hz[middle[:, None] + np.arange(-1, 2)]
    found = minima(along(curve.source, _OBJECTIVES, kind), f, values)
    return curve.with_points(found, sample(curve.source, found))


def _candidates(curve: Curve, k: int) -> tuple[IntArray, Array]:
    """Middle points of brackets worth refining for an objective, and the values (brackets, 3) there."""
    objective = _OBJECTIVES[k]
    value = objective(curve.loop)
    middle, around = brackets(value)
    here, drop = around[:, 1], _drop(curve.frequency_hz, middle, around)
    reachable = here - REACH * drop
    if objective in (sensitivity, complementary, symmetric):
        worth = reachable <= value.min()
    elif objective is minus_log_size:
        worth = here < -LOWEST_PEAK
    elif objective is log_size:
        worth = (here > 0.0) & (reachable < 0.0)
    else:
        worth = (here > 0.0) & (reachable < 0.0) & (curve.loop.real[middle] < 0.0)
    return middle[worth], around[worth]


def brackets(value: Array) -> tuple[IntArray, Array]:
    """Inner points that are not above either neighbour and below one: their numbers, and the three values."""
    left, here, right = value[:-2], value[1:-1], value[2:]
    middle = 1 + np.flatnonzero((here <= left) & (here <= right) & ((here < left) | (here < right)))
    return middle, value[middle[:, None] + np.arange(-1, 2)]


def _drop(f: Array, middle: IntArray, around: Array) -> Array:
    """How far the parabola through each three points dips below the middle one."""
    a, c, b = f[middle - 1], f[middle], f[middle + 1]
    left, right = (around[:, 0] - around[:, 1]) / (c - a), (around[:, 2] - around[:, 1]) / (b - c)
    slope = (right * (c - a) - left * (b - c)) / (b - a)
    curvature = (left + right) / (b - a)
    return np.asarray(slope**2 / (4.0 * np.maximum(curvature, 1e-300)))
