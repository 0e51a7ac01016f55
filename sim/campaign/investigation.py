"""The investigation of a campaign: repetition of a run, reduction of a failure, search for the worst flight."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.error import CampaignError
from maxq.sim.campaign.plan import SEED_KEY, WIND_KEY
from maxq.sim.campaign.read import LoadedCampaign
from maxq.sim.campaign.runs import VOID, fly_scenario, recorded_row, schema_of, table_of
from maxq.sim.campaign.store import campaign_in
from maxq.sim.campaign.targets import Refused
from maxq.sim.files import check_writable
from maxq.sim.log.head import LogError
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import FlightRun, with_half_step
from maxq.sim.run.record import record
from maxq.sim.scenario.loader import LoadedScenario

SIGMAS = 3.0
_SEED = 1  # seed of the search


@dataclass(frozen=True)
class Reflown:
    """A repeated flight and its comparison with the data set; `same` is None if no comparison is possible."""

    flight: Flight
    folder: Path
    same: bool | None
    differences: tuple[str, ...]


def flight_folder(folder: Path, run: int) -> Path:
    return folder / "flights" / f"run-{run:06d}"


def refly(
    folder: Path,
    run: int,
    out: Path | None = None,
    *,
    campaign: LoadedCampaign | None = None,
    log: bool = True,
    watch: Callable[[FlightRun], None] | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Reflown:
    """Fly run `run` of the campaign in `folder` again, and compare it with the data set bit by bit.

    `out` is the folder of the flight (default: DIR/flights/run-000417 for run 417). `log`, `watch` and `stop` are those
    of `sim.run.record.record`. Raises CampaignError if the draws give no valid scenario, and LogError if a file cannot
    be written.
    """
    campaign = campaign or campaign_in(folder)
    if run < 0:
        raise CampaignError(f"{folder}: runs are numbered from 0; there is no run {run}")
    try:
        made = campaign.inputs(run)
    except Refused as refused:
        raise CampaignError(f"run {run} of {folder} has no scenario: {refused}") from None
    out = out or flight_folder(folder, run)
    check_writable(out, LogError)
    loaded: LoadedScenario | None = made.loaded
    while loaded is not None:
        flight = record(FlightRun(loaded, log=log), out, log=log, watch=watch, stop=stop, number=run)
        loaded = with_half_step(flight)
    before = DataSet(folder, campaign).row(run)
    if before is None or flight.outcome == "interrupted":
        return Reflown(flight, out, None, ())
    now = table_of([recorded_row(made, flight)], schema_of(campaign)).to_pylist()[0]
    found = tuple(differing(before, now))
    return Reflown(flight, out, not found, found)


def differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return a description of each column that is not equal bit by bit."""

    def bits(value: Any) -> Any:
        if not isinstance(value, float):
            return value
        return "nan" if math.isnan(value) else struct.pack("<d", value)

    return [f"{k} {v!r}, now {now.get(k)!r}" for k, v in before.items() if bits(v) != bits(now.get(k))]


# a failure reduced to its causes


@dataclass(frozen=True)
class Shrunk:
    """A failure reduced to the inputs that cause it.

    `inputs` are the names of the remaining inputs, `scenario` disperses only these, and `flights` is the number of
    flights of the reduction.
    """

    failure: str
    inputs: tuple[str, ...]
    scenario: LoadedScenario
    flight: Flight
    flights: int


def failures_of(flight: Flight) -> list[str]:
    """Return the failures of a flight: an outcome without usable metrics, loss of control, missed requirements."""
    found = [flight.outcome] if flight.outcome in VOID else []
    found += ["control lost"] if any(e.name == "control_lost" for e in flight.events) else []
    return found + [v.name for v in flight.verdicts if not v.met]


def shrink_run(
    campaign: LoadedCampaign,
    run: int,
    failure: str | None = None,
    workers: int = 1,
    watch: Callable[[int, int], None] = lambda left, flights: None,
) -> Shrunk | None:
    """Return a minimal set of inputs of `run` that still causes `failure` (default: its first failure).

    Method: delta debugging (Zeller & Hildebrandt, IEEE TSE 28, 2002), with all other inputs at their nominal values.
    The set is minimal in the sense that the failure disappears if any single remaining input returns to nominal; a
    smaller set may exist. The result is None if the run does not have this failure. `watch` is called with the numbers
    of remaining inputs and of flights. Raises Refused.
    """
    drawn = campaign.plan.draw(run, 1)
    found = failures_of(fly_scenario(campaign.scenario_of(run)))
    wanted = failure or (found[0] if found else "")
    if wanted not in found:
        return None
    flown = [1]

    def fails(kept: Sequence[str]) -> bool:
        flown[0] += 1
        try:
            flight = fly_scenario(campaign.mixed(drawn, run, kept))
        except Refused:  # these values are incompatible
            return False
        return wanted in failures_of(flight)

    with ThreadPoolExecutor(workers) as pool:
        left = _minimal(list(campaign.input_names), fails, pool, lambda names: watch(len(names), flown[0]))
    scenario = campaign.mixed(drawn, run, left)
    return Shrunk(wanted, tuple(left), scenario, fly_scenario(scenario), flown[0] + 1)


def _minimal(
    names: list[str],
    fails: Callable[[Sequence[str]], bool],
    pool: ThreadPoolExecutor,
    watch: Callable[[list[str]], None],
) -> list[str]:
    """Return a minimal failing subset of `names` (ddmin).

    Each part of a division is tried, then the remainder without each part, with increasingly fine divisions. The result
    does not depend on the threads, because the first failing trial of a round, in order, is chosen.
    """
    if fails([]):
        return []  # it fails without any dispersion
    pieces = 2
    while len(names) > 1:
        watch(names)
        parts = [names[len(names) * i // pieces : len(names) * (i + 1) // pieces] for i in range(pieces)]
        rests = [[name for name in names if name not in set(part)] for part in parts]
        trials = parts if pieces == 2 else [*parts, *rests]
        results = list(pool.map(fails, trials))
        hit = next((i for i, failed in enumerate(results) if failed), None)
        if hit is None and pieces >= len(names):
            break
        if hit is None:
            pieces = min(2 * pieces, len(names))
        else:
            names = trials[hit]
            pieces = 2 if hit < len(parts) else max(pieces - 1, 2)
    return names


# a search for the worst flight


@dataclass(frozen=True)
class WorstFlight:
    """The worst flight of a search, with its draws by input name, and the number of flights of the search."""

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
    start: int | None = None,
    workers: int = 1,
    watch: Callable[[float, int], None] = lambda best, flown: None,
    stop: Callable[[], bool] = lambda: False,
) -> WorstFlight:
    """Search for the largest (or smallest) value of `metric` in the 3-sigma box, with about `flights` flights.

    The search uses SciPy's differential_evolution (Storn & Price, J. Global Optimization 11, 1997). All flights of a
    generation run in parallel, and the result does not depend on the threads. The variables are the numeric draws of
    [[disperse]]. If a run `start` is given, its wind and noise replace the nominal wind and noise, and its draws,
    limited to the box, are in the first generation. A flight without usable metrics is regarded as infinitely bad.
    `watch` is called with the worst value and the number of flights. Raises CampaignError if there are no variables.
    """
    from scipy.optimize import differential_evolution  # noqa: PLC0415  # lazy: half a second, for the search only

    boxes = campaign.boxes(SIGMAS)
    if not boxes:
        raise CampaignError(f"{campaign.name}: no dispersed number has bounds to search within")
    names, bounds = list(boxes), np.array(list(boxes.values()))
    drawn = campaign.plan.draw(start, 1) if start is not None else None
    surroundings = campaign.values_of(drawn, drawn.first, (SEED_KEY, WIND_KEY)) if drawn is not None else None
    sign = -1.0 if largest else 1.0
    flown = [0]
    best: list[tuple[float, Array]] = []

    def scenario_of(x: Array) -> LoadedScenario:
        return campaign.changed(dict(zip(names, x.tolist(), strict=True)), surroundings)

    def cost(x: Array) -> float:
        try:
            flight = fly_scenario(scenario_of(x))
        except Refused:
            return math.inf
        value = flight.metrics[metric]
        return -math.inf if flight.outcome in VOID or math.isnan(value) else sign * value

    population = min(max(4 * len(names), 16), max(flights // 4, 8))
    first = _first(bounds, population)
    if drawn is not None:
        first[0] = np.clip([float(drawn.draws[name][0]) for name in names], bounds[:, 0], bounds[:, 1])
    with ThreadPoolExecutor(workers) as pool:

        def together(function: Callable[[Array], float], xs: Any) -> list[float]:
            points = [np.asarray(x) for x in xs]
            values = list(pool.map(cost, points))
            flown[0] += len(points)
            at = int(np.argmin(values))
            if not best or values[at] < best[0][0]:
                best[:] = [(values[at], points[at].copy())]
            watch(sign * best[0][0], flown[0])
            return [1e300 if value == math.inf else max(value, -1e300) for value in values]

        def enough(*_: Any) -> Any:
            return stop() or flown[0] >= flights or (bool(best) and best[0][0] == -math.inf)

        box: Any = bounds.tolist()
        differential_evolution(
            cost,
            box,
            init=first,
            workers=together,
            updating="deferred",
            polish=False,
            tol=1e-6,
            maxiter=max(flights // population - 1, 0),
            rng=np.random.default_rng(_SEED),
            callback=enough,
        )
    scenario = scenario_of(best[0][1])
    flight = fly_scenario(scenario)
    draws = dict(zip(names, best[0][1].tolist(), strict=True))
    return WorstFlight(metric, flight.metrics[metric], draws, scenario, flight, flown[0] + 1)


def _first(bounds: Array, population: int) -> Array:
    """Return the first generation (population, variables), a Latin hypercube in `bounds` (variables, 2)."""
    rng = np.random.default_rng(_SEED)
    cells = np.stack([rng.permutation(population) for _ in bounds], axis=1)
    u = (cells + rng.random(cells.shape)) / population
    return np.asarray(bounds[:, 0] + u * (bounds[:, 1] - bounds[:, 0]))
