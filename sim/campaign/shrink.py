"""The fewest dispersions of a run with which it still fails: delta debugging (Zeller & Hildebrandt, IEEE TSE 28, 2002).

All other inputs go back to their nominal values. The result is minimal in the sense that no single one of the remaining
inputs can go back without the failure going away; there may be another set of the same size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from maxq.sim.campaign.flying import VOID, fly_scenario
from maxq.sim.campaign.loaded import LoadedCampaign
from maxq.sim.campaign.targets import Refused
from maxq.sim.run.fly import Flight
from maxq.sim.scenario.loader import LoadedScenario


@dataclass(frozen=True)
class Shrunk:
    """What is left of a failure: inputs by name, the scenario with them alone, its flight, and how many were flown."""

    failure: str
    inputs: tuple[str, ...]
    scenario: LoadedScenario
    flight: Flight
    flights: int


def failures_of(flight: Flight) -> list[str]:
    """What a flight fails in: its outcome if that is bad, control lost, and the requirements it misses."""
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
    """The smallest set of inputs of `run` that still gives `failure` (default: the first thing that it fails in).

    None where the run does not fail so. `watch` gets the inputs left and the flights flown. Raises Refused.
    """
    drawn = campaign.plan.draw(run, 1)
    whole = fly_scenario(campaign.scenario_of(run))
    found = failures_of(whole)
    if failure is None:
        failure = found[0] if found else None
    if failure is None or failure not in found:
        return None
    wanted = failure
    flown = [1]

    def fails(kept: Sequence[str]) -> bool:
        flown[0] += 1
        try:
            flight = fly_scenario(campaign.mixed(drawn, run, kept))
        except Refused:  # these values exclude each other
            return False
        return wanted in failures_of(flight)

    with ThreadPoolExecutor(workers) as pool:
        left = _minimal(list(campaign.input_names), fails, pool, lambda names: watch(len(names), flown[0]))
    scenario = campaign.mixed(drawn, run, left)
    flight = fly_scenario(scenario)
    return Shrunk(wanted, tuple(left), scenario, flight, flown[0] + 1)


def _minimal(
    names: list[str],
    fails: Callable[[Sequence[str]], bool],
    pool: ThreadPoolExecutor,
    watch: Callable[[list[str]], None],
) -> list[str]:
    """ddmin: try parts, then what is left without each part, of ever finer divisions. Independent of the threads:
    of all trials of a round the first one in order that fails is taken."""
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
