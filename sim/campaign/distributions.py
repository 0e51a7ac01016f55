"""Distributions by their quantile functions: a uniform number in, a draw out."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

from maxq.control.kernel.records import Array
from maxq.sim.campaign.schema import Disperse


def standard_normal(u: Array) -> Array:
    return np.asarray(ndtri(u))


def quantile(d: Disperse, u: Array, nominal: float) -> Array:
    """Draws of a distribution over numbers. `nominal`: the centre where the file names none."""
    if d.distribution == "normal":
        return np.asarray(_centre(d, nominal) + _sigma(d) * standard_normal(u))
    if d.distribution == "truncated-normal":
        return _truncated(_centre(d, nominal), _sigma(d), d.low, d.high, u)
    if d.distribution == "log-normal":
        median = d.median if d.median is not None else _centre(d, nominal)
        return np.asarray(median * np.exp(_sigma(d) * standard_normal(u)))
    assert d.low is not None
    assert d.high is not None
    if d.distribution == "uniform":
        return np.asarray(d.low + (d.high - d.low) * u)
    assert d.distribution == "triangular"
    assert d.mode is not None
    return _triangular(d.low, d.mode, d.high, u)


def box(d: Disperse, nominal: float, sigmas: float = 3.0) -> tuple[float, float]:
    """Least and greatest value of a search: the distribution's ends, or where `sigmas` of a normal one lie."""
    tail = float(ndtr(-sigmas))
    ends = quantile(d, np.array([tail, 1.0 - tail]), nominal)
    if d.distribution in ("uniform", "triangular"):
        assert d.low is not None
        assert d.high is not None
        return d.low, d.high
    return float(ends[0]), float(ends[1])


def chosen(d: Disperse, u: Array) -> np.ndarray:
    """Indices of `values`, as often as their weights say."""
    assert d.values is not None
    weights = np.array(d.weights or (1.0,) * len(d.values), dtype=float)
    edges = np.cumsum(weights / weights.sum())
    return np.minimum(np.searchsorted(edges, u, side="right"), len(weights) - 1)


def correlated(matrix: tuple[tuple[float, ...], ...], scores: list[Array]) -> list[Array]:
    """Zero-mean normal draws with a covariance from independent scores, one array for each key.

    Draw j depends on the scores of keys 0 .. j. Sums are written out, so that they do not depend on the processor.
    """
    factor = cholesky(np.array(matrix))
    out = []
    for row, _ in enumerate(scores):
        total = np.zeros_like(scores[0])
        for column in range(row + 1):
            total = total + factor[row, column] * scores[column]
        out.append(total)
    return out


def cholesky(matrix: Array) -> Array:
    """Lower factor of a covariance, which may be singular."""
    n = len(matrix)
    factor = np.zeros((n, n))
    for j in range(n):
        rest = matrix[j, j] - sum(factor[j, k] ** 2 for k in range(j))
        factor[j, j] = np.sqrt(rest) if rest > 1e-12 * max(matrix[j, j], 1e-300) else 0.0
        for i in range(j + 1, n):
            if factor[j, j] > 0.0:
                factor[i, j] = (matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))) / factor[j, j]
    return factor


def _sigma(d: Disperse) -> float:
    if d.sigma is not None:
        return d.sigma
    assert d.three_sigma is not None
    return d.three_sigma / 3.0


def _centre(d: Disperse, nominal: float) -> float:
    if d.mean is not None:
        return d.mean
    return {"set": nominal, "scale": 1.0, "add": 0.0}[d.apply]


def _truncated(mean: float, sigma: float, low: float | None, high: float | None, u: Array) -> Array:
    """Normal between `low` and `high`; drawn in the lower tail, where probabilities keep their digits."""
    a = -np.inf if low is None else (low - mean) / sigma
    b = np.inf if high is None else (high - mean) / sigma
    if a > 0.0:
        return np.asarray(np.clip(mean - sigma * ndtri(ndtr(-b) + (1.0 - u) * (ndtr(-a) - ndtr(-b))), low, high))
    return np.asarray(np.clip(mean + sigma * ndtri(ndtr(a) + u * (ndtr(b) - ndtr(a))), low, high))


def _triangular(low: float, mode: float, high: float, u: Array) -> Array:
    width = high - low
    if width == 0.0:
        return np.full_like(u, low)
    left = low + np.sqrt(u * width * (mode - low))
    right = high - np.sqrt((1.0 - u) * width * (high - mode))
    return np.where(u * width < mode - low, left, right)
