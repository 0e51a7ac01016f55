"""The probability that a flight misses a requirement, for rare failures, by subset simulation.

The probability is a product of conditional probabilities of about 0.1, one for each of several levels of the metric
between its usual values and the limit (Au & Beck, Probab. Eng. Mech. 16, 2001). Flights beyond a level are drawn by
Markov chains from the flights that are already beyond it, in the space of a run's standard normal numbers z:

    z' = sqrt(1 - s^2) z + s xi,        accepted if its flight is beyond the level,

with a step size s for which 44 % are accepted (Papaioannou et al., Probab. Eng. Mech. 41, 2015). The seed of a run's
noise is replaced with probability s. Populations are independent, so that the spread of their estimates includes the
correlation of chains and of levels. The bounds are those of Student's distribution for the logarithm of the
probability, at half of the stated risk because the estimates are skewed. Their coverage for closed forms is given in
docs/verdicts.md. Estimate and bounds do not include a failure mode that no chain reaches.

No bounds are given in two cases: if a population reaches a value that no flight exceeds, or if the noise determines the
failure. There is no distance between seeds. If a flight near the limit rarely remains there with another seed, the
chains keep their few initial seeds, and the estimate is too low.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import stdtrit

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.campaign.own_kernels import OwnKernels
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.runs import VOID, fly_rows
from maxq.sim.campaign.schema import Envelope
from maxq.sim.campaign.statistics import MET, NOT_MET, OPEN, Judgement

POPULATIONS = 5
LEVEL = 0.1  # conditional probability of a level
FEWEST = 200  # least number of points of a level; with fewer points, the coverage of the bounds is too low
_MOST_LEVELS = 12
_ACCEPTED = 0.44
_FEWEST_AT_ONCE = 8
_FRESH_NOISE = 0.05  # least share of flights that remain beyond the last level with other noise (docs/verdicts.md)
SHARE_OF_FLIGHTS = 1.0 / (POPULATIONS * 4.6)  # points of a level / all flights, for populations with four levels

Value = Callable[[Array, IntArray], Array]
"""A function that returns the excess of each point beyond the limit, (points,).

Its arguments are standard normal numbers (points, scores) and seeds of noise (points,). The result is above 0 for a
failure, and nan for a point outside the bounds of the draws or without a valid scenario.
"""


@dataclass(frozen=True)
class Population:
    """The estimate of a population.

    - `levels`: levels passed, in the unit of the value.
    - `stuck`: True if no value exceeded the last level, or if there were too many levels.
    - `fresh_noise`: share of the flights with replaced noise, with or without other numbers, that remained beyond the
      last level; 1 without levels.
    - `nearest`: standard normal numbers and noise of the failing flight nearest to the centre of the distribution.
    """

    probability: float
    levels: tuple[float, ...]
    flights: int
    stuck: bool
    fresh_noise: float
    nearest: tuple[Array, int] | None


@dataclass(frozen=True)
class Rare:
    """The probability of failure, its bounds, each with the required confidence, and the populations `each`.

    `undecided` is the reason for missing bounds (`low` is then 0 and `high` 1), or empty. `crude` is the number of
    flights for which direct sampling would have the same standard error.
    """

    probability: float
    low: float
    high: float
    crude: float
    each: tuple[Population, ...]
    undecided: str = ""

    def judgement(self, allowed: float) -> Judgement:
        """Return the verdict on the requirement that the probability of failure is at most `allowed`."""
        return MET if self.high <= allowed else NOT_MET if self.low > allowed else OPEN

    @property
    def flights(self) -> int:
        return sum(one.flights for one in self.each)

    @property
    def nearest(self) -> tuple[Array, int] | None:
        found = [one.nearest for one in self.each if one.nearest is not None]
        return min(found, key=lambda point: float(np.linalg.norm(point[0])), default=None)


def subset_simulation(
    value: Value,
    scores: int,
    population: int,
    confidence: float,
    seed: int = 1,
    watch: Callable[[int, int, int], None] = lambda number, level, flights: None,
) -> Rare:
    """Return the probability of `value` > 0 for independent standard normal numbers and noise.

    `scores` is the number of normal numbers, and `population` the number of points of a level. `watch` is called with
    the numbers of the population, of its levels, and of all flights.
    """
    each = list[Population]()
    for number in range(POPULATIONS):
        flown = sum(one.flights for one in each)
        told = partial(lambda number, flown, level, flights: watch(number, level, flown + flights), number, flown)
        each.append(_population(value, scores, population, np.random.default_rng([seed, number]), told))
    p = np.array([one.probability for one in each])
    mean = float(p.mean())
    if stuck := sum(one.stuck for one in each):
        reason = f"{stuck} of {POPULATIONS} populations reached a value that no flight exceeds"
        return Rare(mean, 0.0, 1.0, math.nan, tuple(each), reason)
    fresh = float(np.mean([one.fresh_noise for one in each]))
    if fresh < _FRESH_NOISE:
        reason = (
            f"noise decides: {fresh:.1%} of flights stay beyond the last level with other noise, "
            f"and {_FRESH_NOISE:.0%} are needed"
        )
        return Rare(mean, 0.0, 1.0, math.nan, tuple(each), reason)
    error = float(p.std(ddof=1)) / math.sqrt(POPULATIONS) / mean
    factor = math.exp(float(stdtrit(POPULATIONS - 1, 0.5 * (1.0 + confidence))) * error)
    crude = (1.0 - mean) / (mean * error**2) if error > 0.0 else math.inf
    return Rare(mean, mean / factor, min(mean * factor, 1.0), crude, tuple(each))


def _population(
    value: Value, scores: int, n: int, rng: np.random.Generator, watch: Callable[[int, int], None]
) -> Population:
    chains, step_size, p, levels = max(round(LEVEL * n), 2), 0.6, 1.0, list[float]()
    z, noise = rng.normal(size=(n, scores)), rng.integers(2**62, size=n)
    v = value(z, noise)
    flights = n
    for _ in range(1000):
        again = np.flatnonzero(np.isnan(v))
        if not len(again):
            break
        z[again], noise[again] = rng.normal(size=(len(again), scores)), rng.integers(2**62, size=len(again))
        v[again] = value(z[again], noise[again])
        flights += len(again)
    best: tuple[Array, int] | None = None
    fresh_noise = 1.0
    while True:
        watch(len(levels), flights)
        for k in np.flatnonzero(v > 0.0):
            if best is None or np.linalg.norm(z[k]) < np.linalg.norm(best[0]):
                best = z[k].copy(), int(noise[k])
        order = np.argsort(-v, kind="stable")
        failing = float(np.mean(v > 0.0))
        if failing >= LEVEL:
            return Population(p * failing, tuple(levels), flights, False, fresh_noise, best)
        level = min(0.5 * float(v[order[chains - 1]] + v[order[chains]]), 0.0)
        beyond = np.flatnonzero(v > level)
        if len(levels) == _MOST_LEVELS or not len(beyond) or (levels and level <= levels[-1]):
            return Population(0.0, tuple(levels), flights, True, fresh_noise, best)
        p *= len(beyond) / n
        levels.append(level)
        z, noise, v = z[beyond], noise[beyond], v[beyond]
        kept = [(z, noise, v)]
        changed, stayed = 0, 0
        for step in range(1, math.ceil(n / len(beyond))):
            move = math.sqrt(1.0 - step_size**2) * z + step_size * rng.normal(size=z.shape)
            fresh = np.where(rng.random(len(z)) < step_size, rng.integers(2**62, size=len(z)), noise)
            there = value(move, fresh)
            flights += len(there)
            accepted = there > level
            other = fresh != noise
            changed, stayed = changed + int(other.sum()), stayed + int((accepted & other).sum())
            z, noise = np.where(accepted[:, None], move, z), np.where(accepted, fresh, noise)
            v = np.where(accepted, there, v)
            kept.append((z, noise, v))
            step_size = float(np.clip(step_size * math.exp((accepted.mean() - _ACCEPTED) / math.sqrt(step)), 0.05, 1.0))
            watch(len(levels), flights)
        fresh_noise = stayed / changed if changed else 1.0
        z, noise, v = (np.concatenate(parts)[:n] for parts in zip(*kept, strict=True))


def rare_failure(
    campaign: LoadedCampaign,
    metric: str,
    limit: float,
    *,
    largest: bool = True,
    flights: int = 10_000,
    workers: int = 1,
    watch: Callable[[int, int, int], None] = lambda number, level, flights: None,
    stop: Callable[[], bool] = lambda: False,
) -> Rare:
    """Return the probability that the metric of a flight is beyond its limit, from about `flights` flights.

    The draws are those of the campaign, from its seed: [[disperse]], wind and noise. A flight without usable metrics
    misses every limit. `watch` is that of `subset_simulation`. Raises KeyboardInterrupt if `stop` returns True.
    """
    flown = campaign.with_campaign(envelope=Envelope(runs=0))
    sign = 1.0 if largest else -1.0
    with ThreadPoolExecutor(workers) as pool, OwnKernels(campaign, flights) as kernels:

        def value(z: Array, noise: IntArray) -> Array:
            drawn, good = flown.plan.of_scores(z, noise)
            runs, out = np.flatnonzero(good).tolist(), np.full(len(z), math.nan)
            size = max(math.ceil(len(runs) / workers), _FEWEST_AT_ONCE)
            parts = [[(drawn, run) for run in runs[k : k + size]] for k in range(0, len(runs), size)]
            for rows in pool.map(lambda part: fly_rows(flown, part, stop, kernels.pack), parts):
                for row in rows:
                    if row.redraws == 0 and row.outcome != "refused":
                        found = sign * (row.metrics[metric] - limit)
                        out[row.run] = math.inf if row.outcome in VOID or math.isnan(found) else found
            if stop():
                raise KeyboardInterrupt
            return out

        population = max(round(flights * SHARE_OF_FLIGHTS), FEWEST)
        scores, wanted = len(flown.plan.score_names), campaign.campaign
        return subset_simulation(value, scores, population, wanted.confidence, wanted.seed, watch)
