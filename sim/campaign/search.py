"""The worst flight within the 3-sigma box of the dispersions, by differential evolution over the same kernel.

SciPy's differential_evolution (Storn & Price, J. Global Optimization 11, 1997), generation by generation, so that all
flights of one are in the air together and the result does not depend on the threads. Noise and wind are those of the
nominal scenario unless the campaign gives the worst run's: what is searched are the numbers of [[disperse]].
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import differential_evolution

from maxq.control.kernel.records import Array
from maxq.sim.campaign.flying import VOID, fly_scenario
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.plan import SEED_KEY, Drawn
from maxq.sim.campaign.targets import Refused
from maxq.sim.campaign.wind import WIND_KEY
from maxq.sim.run.fly import Flight
from maxq.sim.scenario.loader import LoadedScenario

SIGMAS = 3.0


@dataclass(frozen=True)
class Found:
    """The worst flight of a search; `draws` by input name, `flights` flown."""

    metric: str
    value: float
    draws: dict[str, float]
    scenario: LoadedScenario
    flight: Flight
    flights: int


def search_worst(
    campaign: LoadedCampaign,
    metric: str,
    *,
    largest: bool = True,
    flights: int = 2000,
    seed: int = 1,
    start: int | None = None,
    workers: int = 1,
    watch: Callable[[float, int], None] = lambda best, flown: None,
    stop: Callable[[], bool] = lambda: False,
) -> Found:
    """Search about `flights` flights for the largest (or smallest) value of `metric`.

    `start`: the run whose wind and noise are flown, and whose draws, cut to the box, the search begins with.
    A flight that comes to nothing counts as infinitely bad. Raises ValueError where nothing can be searched.
    """
    boxes = campaign.boxes(SIGMAS)
    if not boxes:
        raise ValueError("the campaign disperses no number that has a box")
    names = list(boxes)
    bounds = np.array([boxes[name] for name in names])
    drawn = campaign.plan.draw(start, 1) if start is not None else None
    sign = -1.0 if largest else 1.0
    flown = [0]
    best: list[tuple[float, Array]] = []

    def scenario_of(x: Array) -> LoadedScenario:
        return _scenario(campaign, dict(zip(names, x.tolist(), strict=True)), drawn)

    def cost(x: Array) -> float:
        try:
            flight = fly_scenario(scenario_of(x))
        except Refused:
            return math.inf
        value = flight.metrics[metric]
        return -math.inf if flight.outcome in VOID or math.isnan(value) else sign * value

    box: Any = [(low, high) for low, high in bounds.tolist()]
    population = min(max(4 * len(names), 16), max(flights // 4, 8))
    first = _first(names, bounds, population, seed, drawn)
    with ThreadPoolExecutor(workers) as pool:

        def together(function: Callable[[Array], float], xs: object) -> list[float]:
            points = [np.asarray(x) for x in xs]  # type: ignore[attr-defined]  # SciPy hands over an iterable
            values = list(pool.map(cost, points))
            flown[0] += len(points)
            at = int(np.argmin(values))
            if not best or values[at] < best[0][0]:
                best[:] = [(values[at], points[at].copy())]
            watch(sign * best[0][0], flown[0])
            return [1e300 if value == math.inf else max(value, -1e300) for value in values]

        def enough(*_: Any) -> Any:
            return stop() or flown[0] >= flights or (bool(best) and best[0][0] == -math.inf)

        differential_evolution(
            cost, box, init=first, workers=together, updating="deferred", polish=False, tol=1e-6,
            maxiter=max(flights // population - 1, 0), rng=np.random.default_rng(seed), callback=enough,
        )  # fmt: skip
    scenario = scenario_of(best[0][1])
    flight = fly_scenario(scenario)
    draws = dict(zip(names, best[0][1].tolist(), strict=True))
    return Found(metric, flight.metrics[metric], draws, scenario, flight, flown[0] + 1)


def _scenario(campaign: LoadedCampaign, draws: dict[str, float], drawn: Drawn | None) -> LoadedScenario:
    """These draws; wind and noise of a run where one is given."""
    if drawn is None:
        return campaign.changed(draws)
    return campaign.changed(draws, campaign.surroundings(drawn, drawn.first, (SEED_KEY, WIND_KEY)))


def _first(names: list[str], bounds: Array, population: int, seed: int, drawn: Drawn | None) -> Array:
    """The first generation: a Latin hypercube over the box, and the run that the search begins with."""
    rng = np.random.default_rng(seed)
    cells = np.stack([rng.permutation(population) for _ in names], axis=1)
    u = (cells + rng.random(cells.shape)) / population
    points = bounds[:, 0] + u * (bounds[:, 1] - bounds[:, 0])
    if drawn is not None:
        points[0] = np.clip([float(drawn.draws[name][0]) for name in names], bounds[:, 0], bounds[:, 1])
    return np.asarray(points)
