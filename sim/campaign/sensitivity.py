"""Global sensitivity of a metric to the dispersed inputs, from the runs that were flown: no further runs.

- rank correlation (Spearman): sign and strength of a monotone influence;
- first-order Sobol' index: the share of the metric's variance that the input explains, as the variance between classes
  of the input (Pearson's correlation ratio), corrected for the number of classes;
- Borgonovo's delta: how far the metric's distribution moves, on average, when the input is known, as half the
  difference between the histograms of a class and of all (Plischke, Borgonovo & Smith, EJOR 226, 2013), less what the
  same number of runs gives for an independent input. It also detects an influence on the spread alone.

All are of inputs one by one. Inputs that are correlated with each other (neighbouring winds) share their influence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.plan import SEED_KEY
from maxq.sim.campaign.runs import input_types

_MOST_RUNS = 20_000  # the first so many are used: more change nothing in the digits that are shown
_FEWEST_RUNS = 30
_SHUFFLES = 8


@dataclass(frozen=True)
class Driver:
    """Influence of an input on a metric. `noise`: bound of |rank| for an input without influence (2 sigma)."""

    name: str
    rank: float
    first_order: float
    delta: float
    noise: float

    @property
    def matters(self) -> bool:
        return abs(self.rank) > self.noise or self.delta > self.noise


def rank_correlation(x: Array, y: Array) -> float:
    """Spearman's; 0 where one of them does not vary."""
    from scipy.stats import spearmanr  # noqa: PLC0415  # lazy: a second to import, at a campaign's end only

    return float(spearmanr(x, y).statistic) if np.ptp(x) > 0.0 and np.ptp(y) > 0.0 else 0.0


def first_order(x: Array, y: Array) -> float:
    """First-order Sobol' index of x, 0 to 1."""
    n, total = len(y), float(np.var(y))
    classes = _classes(x)
    count = np.bincount(classes)
    used = int((count > 0).sum())
    if total == 0.0 or used < 2 or n <= used:
        return 0.0
    sums = np.bincount(classes, weights=y)
    means = sums[count > 0] / count[count > 0]
    between = float((count[count > 0] * (means - y.mean()) ** 2).sum()) / n
    return float(np.clip(1.0 - (1.0 - between / total) * (n - 1) / (n - used), 0.0, 1.0))


def borgonovo(x: Array, y: Array) -> float:
    """Borgonovo's delta of x, 0 to 1."""
    classes, bins = _classes(x), _classes(y)
    if classes.max(initial=0) < 1 or bins.max(initial=0) < 1:
        return 0.0
    rng = np.random.default_rng(20020412)  # the same noise is taken off every time
    by_chance = np.mean([_distance(rng.permutation(classes), bins) for _ in range(_SHUFFLES)])
    return float(np.clip((_distance(classes, bins) - by_chance) / (1.0 - by_chance), 0.0, 1.0))


def _distance(classes: IntArray, bins: IntArray) -> float:
    n, width = len(classes), int(bins.max()) + 1
    table = np.bincount(classes * width + bins, minlength=(int(classes.max()) + 1) * width).reshape(-1, width)
    share = table.sum(axis=1, keepdims=True)
    inside = table / np.maximum(share, 1)
    overall = table.sum(axis=0) / n
    return float((share[:, 0] / n * 0.5 * np.abs(inside - overall).sum(axis=1)).sum())


def _classes(x: Array) -> IntArray:
    """Class of each value: about n^(1/3) classes of equally many."""
    n = len(x)
    count = int(np.clip(round(n ** (1.0 / 3.0)), 2, 40))
    edges = np.quantile(x, np.linspace(0.0, 1.0, count + 1)[1:-1])
    return np.searchsorted(np.unique(edges), x, side="right")


def sample_of(data: DataSet) -> DataSet:
    """The runs that the indices are estimated from."""
    return data if len(data.runs) <= _MOST_RUNS else DataSet(data.folder, data.campaign, limit=_MOST_RUNS)


def inputs_of(sample: DataSet) -> dict[str, Array]:
    """Numeric inputs of the runs with usable metrics, by name; those that do not vary are left out."""
    good = ~sample.void
    out = {}
    names = [n for n, kind in input_types(sample.campaign).items() if n != SEED_KEY and str(kind) != "string"]
    sample.read(names)
    for name in names:
        values = sample.numbers(name)[good]
        if len(values) and np.isfinite(values).all() and np.ptp(values) > 0.0:
            out[name] = values
    return out


def drivers(sample: DataSet, metric: str, inputs: dict[str, Array]) -> list[Driver]:
    """All inputs by their influence on a metric, the strongest first; none with fewer than 30 runs."""
    y = sample.numbers(metric)[~sample.void]
    good = np.isfinite(y)
    n = int(good.sum())
    if n < _FEWEST_RUNS or np.ptp(y[good]) == 0.0:
        return []
    noise = 2.0 / math.sqrt(n - 1)
    found = [
        Driver(
            name, rank_correlation(x[good], y[good]), first_order(x[good], y[good]), borgonovo(x[good], y[good]), noise
        )
        for name, x in inputs.items()
    ]
    return sorted(found, key=lambda d: -max(abs(d.rank), d.delta))
