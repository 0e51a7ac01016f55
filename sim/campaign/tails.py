"""Tails of a metric: peaks over a threshold, and what they say beyond the values that were flown.

The excesses of a tail over a high threshold follow, in the limit, a generalised Pareto distribution (Pickands, Ann.
Statist. 3, 1975; Coles, An Introduction to Statistical Modeling of Extreme Values, 2001, chapter 4)

    P(X > u + y | X > u) = (1 + xi y / sigma)^(-1/xi)

fitted here by maximum likelihood along theta = xi / sigma, where the rest is in closed form (Grimshaw, Technometrics
35, 1993). Bounds are upper ends of two-sided profile-likelihood intervals, the share of runs beyond the threshold being
uncertain as well; of 1,000 runs of usual distributions they cover in 84 to 95 % of cases at 90 %
(tests/test_oracle_campaign_statistics.py). Unlike counts and order statistics this extrapolates: it is an estimate
beside the verdicts, as good as the fit, which is therefore tested (Anderson & Darling's distance against that of
samples from the fitted distribution) and shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import boxcox, inv_boxcox, ndtri

from maxq.control.kernel.records import Array
from maxq.sim.campaign.statistics import last

_SHARE = 0.1  # of the runs lies beyond the threshold
_FEWEST, _MOST = 30, 500  # excesses
_SHAPES = np.linspace(-0.99, 1.5, 84)
_SAMPLES = 99  # that the distance is compared with
_PILED = 0.05  # share of equal excesses that no continuous tail has
_BEST_SEEN = 1e-15


@dataclass(frozen=True)
class Tail:
    """The tail of a metric towards its limit. `problem`: why there is no fit; then the rest is nan or empty."""

    problem: str
    threshold: float = math.nan
    share: float = math.nan  # of the runs beyond the threshold
    shape: float = math.nan  # xi: below 0 the tail ends, above 0 it is heavier than an exponential one
    scale: float = math.nan
    quantile: float = math.nan  # that a share `success` of all flights does not exceed
    quantile_bound: float = math.nan  # its one-sided bound with `confidence`
    beyond: float = math.nan  # probability of a value beyond the limit
    beyond_bound: float = math.nan
    fit: float = math.nan  # share of samples from the fitted distribution that lie farther from theirs
    excesses: tuple[float, ...] = ()  # rising, towards the limit
    expected: tuple[float, ...] = ()  # of the fitted distribution, at the same ranks


def tail_of(values: Array, limit: float, success: float, confidence: float, largest: bool = True) -> Tail:
    """Peaks over threshold of the metric's `values` (runs,); `largest` False: below a least value.

    nan among the values (runs without one) is left out.
    """
    sign = 1.0 if largest else -1.0
    x = np.sort(sign * values[np.isfinite(values)])
    n = len(x)
    k = min(max(round(_SHARE * n), _FEWEST), _MOST)
    if n < 4 * _FEWEST:
        return Tail(f"{n} runs; {4 * _FEWEST} are needed")
    share, p = k / n, 1.0 - success
    if p >= share:
        return Tail(f"{100.0 * success:g} % lies within what was flown")
    u = 0.5 * (x[n - k - 1] + x[n - k])
    y = x[n - k :] - u
    different, counts = np.unique(x[n - k :], return_counts=True)
    if counts.max() > max(_PILED * k, 2):
        return Tail(f"{counts.max()} of {k} values are equal, at {sign * different[np.argmax(counts)]:g}")
    shape, scale = (float(part[0]) for part in fit_pareto(y[None]))
    best = _log_likelihood(y, np.array([shape]), np.array([scale]))[0]
    allowed = 0.5 * float(ndtri(0.5 + 0.5 * confidence)) ** 2
    shares = share * np.exp(np.linspace(-4.0, 4.0, 9) / math.sqrt(k))  # of the runs that may lie beyond the threshold
    known = k * np.log(shares / share) + (n - k) * np.log1p(-shares) - (n - k) * math.log1p(-share)
    each, chance = (part.ravel() for part in np.meshgrid(_SHAPES, known))
    beyond_u = np.repeat(shares, len(_SHAPES))

    def likely(excess: float, probability: float) -> bool:
        """Return True if the data allow that a value that far beyond the threshold is exceeded with that
        probability.
        """
        with np.errstate(divide="ignore"):
            scales = excess / boxcox(beyond_u / probability, each)
        return bool(best - (_log_likelihood(y, each, scales) + chance).max() <= allowed)

    quantile = float(_excess_at(shape, scale, p / share))
    highest = _last(lambda e: likely(e, p), quantile, 100.0 * max(quantile, float(y[-1])))
    excess = sign * limit - u
    beyond = most = math.nan
    if excess > 0.0:
        beyond = share * float(_beyond(shape, scale, excess))
        first = math.log(max(beyond, _BEST_SEEN))
        most = math.exp(_last(lambda log_p: likely(excess, math.exp(log_p)), first, math.log(share) - 1e-9))
    expected = _excess_at(shape, scale, 1.0 - (np.arange(k) + 0.5) / k)
    shown = (tuple((sign * (u + part)).tolist()) for part in (y, expected))
    return Tail(
        "",
        sign * u,
        share,
        shape,
        scale,
        sign * (u + quantile),
        sign * (u + highest),
        beyond,
        most,
        _share_farther(y, shape, scale),
        *shown,
    )


def fit_pareto(y: Array) -> tuple[Array, Array]:
    """Shape and scale (samples,) of the generalised Pareto distribution of excesses y (samples, k)."""
    top, mean = y.max(axis=1), y.mean(axis=1)
    inside = 1.0 - np.geomspace(1e-6, 1.0, 60)[:-1]  # of the way to -1/top, where a sample would lie beyond the end
    grid = np.concatenate([-inside[None] / top[:, None], np.geomspace(1e-4, 30.0, 60)[None] / mean[:, None]], axis=1)
    grid.sort(axis=1)

    def profile(theta: Array) -> Array:
        shape = np.log1p(theta[..., None] * y[:, None]).mean(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = -np.log(shape / theta) - shape - 1.0
        return np.where((shape > _SHAPES[0]) & np.isfinite(found), found, -np.inf)

    at, rows = np.argmax(profile(grid), axis=1), np.arange(len(y))
    low, high = grid[rows, np.maximum(at - 1, 0)], grid[rows, np.minimum(at + 1, grid.shape[1] - 1)]
    for _ in range(40):
        a, b = low + 0.382 * (high - low), high - 0.382 * (high - low)
        better = profile(a[:, None])[:, 0] > profile(b[:, None])[:, 0]
        low, high = np.where(better, low, a), np.where(better, b, high)
    theta = 0.5 * (low + high)
    shape = np.log1p(theta[:, None] * y).mean(axis=1)
    return shape, shape / theta


def _log_likelihood(y: Array, shape: Array, scale: Array) -> Array:
    """(shapes,); -inf where a value lies beyond the end of the distribution."""
    xi = np.where(np.abs(shape) < 1e-6, 1e-6, shape)  # an exponential distribution, as far as digits go
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = np.log1p(xi[:, None] * y / scale[:, None])
        total = -len(y) * np.log(scale) - (1.0 + 1.0 / xi) * inner.sum(axis=1)
    return np.where(np.isfinite(total) & (scale > 0.0), total, -np.inf)


def _excess_at(shape: float, scale: float, probability: Array | float) -> Array:
    """Excess that is exceeded with a probability."""
    return np.asarray(-scale * boxcox(probability, -shape))


def _beyond(shape: Array | float, scale: Array | float, excess: Array | float) -> Array:
    """Probability that an excess is exceeded; 0 beyond the end of the distribution."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(inv_boxcox(-excess / scale, -shape), nan=0.0))


def _last(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return the end of a condition that holds at `low`; inf if it does not end below a `high` above 0."""
    if holds(high):
        return math.inf if high > 0.0 else high
    return last(holds, low, high, 30)


def _share_farther(y: Array, shape: float, scale: float) -> float:
    """Parametric bootstrap of the Anderson-Darling distance; the same samples every time."""
    uniform = np.random.default_rng(1954).random((_SAMPLES, len(y)))
    drawn = np.sort(_excess_at(shape, scale, uniform), axis=1)
    distances = _distance(drawn, *fit_pareto(drawn))
    return float(np.mean(distances >= _distance(y[None], np.array([shape]), np.array([scale]))[0]))


def _distance(y: Array, shape: Array, scale: Array) -> Array:
    """Anderson and Darling's, (samples,), of rising excesses from the distribution fitted to them."""
    k = y.shape[1]
    survival = np.clip(_beyond(shape[:, None], scale[:, None], y), 1e-15, 1.0 - 1e-15)
    weights = (2.0 * np.arange(1, k + 1) - 1.0) / k
    return np.asarray(-k - (weights * (np.log1p(-survival) + np.log(survival[:, ::-1]))).sum(axis=1))
