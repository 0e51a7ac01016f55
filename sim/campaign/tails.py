"""The tail of a metric, from peaks over a threshold, with an extrapolation beyond the values of the runs.

The excesses over a high threshold u follow, in the limit, a generalised Pareto distribution (Pickands, Ann. Statist. 3,
1975; Coles, An Introduction to Statistical Modeling of Extreme Values, 2001, chapter 4):

    P(X > u + y | X > u) = (1 + xi y / sigma)^(-1/xi)

It is fitted by maximum likelihood over theta = xi / sigma; shape and scale follow in closed form (Grimshaw,
Technometrics 35, 1993). Bounds are the upper ends of two-sided profile-likelihood intervals, which include the
uncertainty of the share of runs beyond the threshold. For 1,000 runs of common distributions and 90 % confidence, their
coverage is 84 to 95 % (tests/test_oracle_campaign_statistics.py). Unlike counts and order statistics, this method
extrapolates. Its result is an estimate in addition to the verdicts, and depends on the quality of the fit. The fit is
therefore tested by its Anderson-Darling distance, compared with that of samples from the fitted distribution.

A second mechanism in a few runs has a different tail, to which a fit to all excesses does not apply. The largest
excesses are therefore compared with the others by the likelihood ratio of two tails to a single tail (compare Northrop
& Coleman, Extremes 17, 2014). If they differ, there is no estimate. docs/verdicts.md gives the measured power and
coverage. No test detects a mechanism that occurs in none of the runs; `Tail.unseen` bounds its frequency.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import boxcox, inv_boxcox, ndtri

from maxq.control.kernel.records import Array
from maxq.sim.campaign.statistics import failure_upper, last

_SHARE = 0.1  # share of the runs beyond the threshold
_FEWEST, _MOST = 30, 500  # least and largest number of excesses
_SHAPES = np.linspace(-0.99, 1.5, 84)
_SAMPLES = 99  # number of samples with which the distance is compared
_PILED = 0.05  # share of equal excesses above which a tail is not continuous
_LARGEST = (3, 5, 10, 20)  # numbers of largest excesses that are compared with the others
_DEPARTS = 0.05  # share of the samples of a single tail at or below which two tails are assumed
_BEST_SEEN = 1e-15


@dataclass(frozen=True)
class Tail:
    """The tail of a metric towards its limit.

    `problem` is the reason for a missing fit, or empty. Without a fit, the other fields are nan or empty, except that
    `largest` is given if it is the reason.
    """

    problem: str
    threshold: float = math.nan
    share: float = math.nan  # share of the runs beyond the threshold
    shape: float = math.nan  # xi: below 0 the tail ends, above 0 it is heavier than an exponential one
    scale: float = math.nan
    quantile: float = math.nan  # value that a share `success` of all flights does not exceed
    quantile_bound: float = math.nan  # its one-sided bound with `confidence`
    beyond: float = math.nan  # probability of a value beyond the limit
    beyond_bound: float = math.nan
    fit: float = math.nan  # share of samples from the fitted distribution with a larger distance from their fit
    largest: float = math.nan  # share of these samples whose largest excesses differ more from the others
    unseen: float = math.nan  # bound, with `confidence`, of the share of flights with a mechanism seen in no run
    excesses: tuple[float, ...] = ()  # values beyond the threshold, in order towards the limit
    expected: tuple[float, ...] = ()  # values of the fitted distribution at the same ranks


def tail_of(values: Array, limit: float, success: float, confidence: float, largest: bool = True) -> Tail:
    """Return the tail of a metric from its `values` (runs,) by peaks over a threshold; nan is omitted.

    `limit` is the limit of the metric. With `largest` False, it is a minimum, and the tail is that of small values.
    """
    sign = 1.0 if largest else -1.0
    x = np.sort(sign * values[np.isfinite(values)])
    n = len(x)
    k = min(max(round(_SHARE * n), _FEWEST), _MOST)
    if n < 4 * _FEWEST:
        return Tail(f"{n} runs; {4 * _FEWEST} are needed")
    share, p = k / n, 1.0 - success
    if p >= share:
        return Tail(f"{100.0 * success:g} % is within the values flown")
    u = 0.5 * (x[n - k - 1] + x[n - k])
    y = x[n - k :] - u
    different, counts = np.unique(x[n - k :], return_counts=True)
    if counts.max() > max(_PILED * k, 2):
        return Tail(f"{counts.max()} of {k} values are equal, at {sign * different[np.argmax(counts)]:g}")
    shape, scale = (float(part[0]) for part in fit_pareto(y[None]))
    uniform = np.random.default_rng(1954).random((_SAMPLES, k))  # the samples are the same every time
    samples = np.sort(_excess_at(shape, scale, uniform), axis=1)
    alike = float(np.mean(two_tails(samples) >= two_tails(y[None])[0]))
    if alike <= _DEPARTS:
        return Tail(f"the largest values depart from the rest ({alike:.2f}): a second mechanism?", largest=alike)
    best = _log_likelihood(y, np.array([shape]), np.array([scale]))[0]
    allowed = 0.5 * float(ndtri(0.5 + 0.5 * confidence)) ** 2
    shares = share * np.exp(np.linspace(-4.0, 4.0, 9) / math.sqrt(k))  # possible shares of runs beyond the threshold
    known = k * np.log(shares / share) + (n - k) * np.log1p(-shares) - (n - k) * math.log1p(-share)
    each, chance = (part.ravel() for part in np.meshgrid(_SHAPES, known))
    beyond_u = np.repeat(shares, len(_SHAPES))

    def likely(excess: float, probability: float) -> bool:
        """Return True if the data are compatible with this probability of a value `excess` above the threshold."""
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
        _share_farther(y, shape, scale, samples),
        alike,
        failure_upper(0, n, confidence),
        *shown,
    )


def fit_pareto(y: Array, largest: int = 0) -> tuple[Array, Array]:
    """Return the shape and scale (samples,) of generalised Pareto distributions fitted to excesses `y` (samples, k).

    The excesses are in increasing order. The number `largest` of them, at the end, are treated as censored: the fit
    uses only that they are larger than the others.
    """
    known = y.shape[1] - largest
    top = y[:, known - 1]
    y = np.minimum(y, top[:, None])
    mean = y.sum(axis=1) / known
    inside = 1.0 - np.geomspace(1e-6, 1.0, 40)[:-1]  # fractions of -1/top, where the distribution ends at `top`
    grid = np.concatenate([-inside[None] / top[:, None], np.geomspace(1e-4, 30.0, 40)[None] / mean[:, None]], axis=1)
    grid.sort(axis=1)

    def profile(theta: Array) -> Array:
        shape = np.log1p(theta[..., None] * y[:, None]).sum(axis=-1) / known
        with np.errstate(divide="ignore", invalid="ignore"):
            found = -np.log(shape / theta) - shape - 1.0 + largest / known * np.log1p(theta * top[:, None])
        return np.where((shape > _SHAPES[0]) & np.isfinite(found), found, -np.inf)

    at, rows = np.argmax(profile(grid), axis=1), np.arange(len(y))
    low, high = grid[rows, np.maximum(at - 1, 0)], grid[rows, np.minimum(at + 1, grid.shape[1] - 1)]
    for _ in range(28):
        a, b = low + 0.382 * (high - low), high - 0.382 * (high - low)
        better = profile(a[:, None])[:, 0] > profile(b[:, None])[:, 0]
        low, high = np.where(better, low, a), np.where(better, b, high)
    theta = 0.5 * (low + high)
    shape = np.log1p(theta[:, None] * y).sum(axis=1) / known
    return shape, shape / theta


def two_tails(y: Array) -> Array:
    """Return the log-likelihood ratio (samples,) of two tails to a single tail of excesses `y` (samples, k).

    The excesses are in increasing order. The second tail is exponential, consists of the largest excesses, and begins
    at the largest of the others. The number of its excesses is that in `_LARGEST` with the largest ratio.
    """

    def likelihood(largest: int) -> Array:
        shape, scale = (part[:, None] for part in fit_pareto(y, largest))
        known = y.shape[1] - largest
        with np.errstate(divide="ignore", invalid="ignore"):
            inner = np.log1p(shape * y[:, :known] / scale)
            body = -known * np.log(scale[:, 0]) - ((1.0 + 1.0 / shape) * inner).sum(axis=1)
            body -= largest / shape[:, 0] * inner[:, -1]
            beyond = (y[:, known:] - y[:, known - 1 : known]).sum(axis=1)
            return np.asarray(body - (largest * (np.log(beyond / largest) + 1.0) if largest else 0.0))

    one = likelihood(0)
    return np.asarray(np.max([likelihood(largest) - one for largest in _LARGEST], axis=0))


def _log_likelihood(y: Array, shape: Array, scale: Array) -> Array:
    """Return the log-likelihood (shapes,) of excesses `y` (k,); -inf if one is beyond the end of the distribution.

    `shape` and `scale` (shapes,) are those of generalised Pareto distributions.
    """
    xi = np.where(np.abs(shape) < 1e-6, 1e-6, shape)  # an exponential distribution to rounding
    with np.errstate(divide="ignore", invalid="ignore"):
        inner = np.log1p(xi[:, None] * y / scale[:, None])
        total = -len(y) * np.log(scale) - (1.0 + 1.0 / xi) * inner.sum(axis=1)
    return np.where(np.isfinite(total) & (scale > 0.0), total, -np.inf)


def _excess_at(shape: float, scale: float, probability: Array | float) -> Array:
    """Return the excess of a generalised Pareto distribution that is exceeded with this probability."""
    return np.asarray(-scale * boxcox(probability, -shape))


def _beyond(shape: Array | float, scale: Array | float, excess: Array | float) -> Array:
    """Return the probability that this excess is exceeded; 0 beyond the end of the distribution."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(inv_boxcox(-excess / scale, -shape), nan=0.0))


def _last(holds: Callable[[float], bool], low: float, high: float) -> float:
    """Return the largest value of a condition that holds at `low`.

    If the condition also holds at `high`, the result is `high`, or inf if `high` is positive.
    """
    if holds(high):
        return math.inf if high > 0.0 else high
    return last(holds, low, high, 30)


def _share_farther(y: Array, shape: float, scale: float, samples: Array) -> float:
    """Return the share of samples of the fitted distribution with a larger Anderson-Darling distance from their fit."""
    distances = _distance(samples, *fit_pareto(samples))
    return float(np.mean(distances >= _distance(y[None], np.array([shape]), np.array([scale]))[0]))


def _distance(y: Array, shape: Array, scale: Array) -> Array:
    """Return the Anderson-Darling distances (samples,) of excesses `y` (samples, k) from their fitted distributions.

    The excesses are in increasing order, and `shape` and `scale` are (samples,).
    """
    k = y.shape[1]
    survival = np.clip(_beyond(shape[:, None], scale[:, None], y), 1e-15, 1.0 - 1e-15)
    weights = (2.0 * np.arange(1, k + 1) - 1.0) / k
    return np.asarray(-k - (weights * (np.log1p(-survival) + np.log(survival[:, ::-1]))).sum(axis=1))
