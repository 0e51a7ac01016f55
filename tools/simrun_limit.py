"""The subcommand `simrun limit SCENARIO KEY`: the largest value of a number at which all requirements are met."""

from __future__ import annotations

import shlex
from typing import Any

from maxq.sim.input.documents import parse_override
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.run.limit import find_limit
from maxq.sim.run.metrics import tightest_first
from maxq.sim.run.record import fly_to_end
from maxq.sim.scenario.loader import load_scenario, told
from maxq.tools.cli.frame import CommandError, Exit, Interruption
from maxq.tools.cli.terminal import Progress, aligned, printable, tell
from maxq.tools.flight_report import requirement_cells, verdict_line


def execute(
    scenario: str, key: str, *, start: float | None = None, end: float | None = None, overrides: tuple[str, ...] = ()
) -> int:
    """Search for the limit between `start` and `end`, print the flights, and return the exit code.

    `start` is by default the scenario's value, or 0 if it has none. Without `end`, the steps double until a requirement
    is missed. Raises CommandError.
    """
    first = _present(scenario, key, overrides) if start is None else start
    if end == first:
        raise CommandError(f"--end {end:g}: the search begins at this value; --start sets another")
    with Interruption() as stop, Progress() as progress:
        count = 0

        def fly_at(value: float) -> Flight:
            nonlocal count
            count += 1
            run = FlightRun(load_scenario(scenario, (*overrides, f"{key}={value!r}")), log=False)

            def watch(run: FlightRun) -> None:
                progress.show("searching", 0.0, 0.0, count=f"flight {count}, {key} = {value:g}, {run.now_s:.0f} s")

            flight = fly_to_end(run, watch=watch, stop=stop)
            if flight.outcome == "interrupted":
                raise KeyboardInterrupt
            return flight

        found = find_limit(fly_at, first, end, stop=stop)
    rows = [(key, "", "tightest requirement", "value", "limit", "used")]
    for value, flight in sorted(found.flown.items()):
        rows.append((f"{value:g}", "met" if flight.passed else "MISSED", *_tightest(flight)))
    tell(*aligned(rows, right=(0, 3, 5)))
    if found.refused:
        tell(f"not allowed, and not flown: {found.refused}")
    flights = f"{len(found.flown)} flights, one for each value"
    if found.missed is None:
        stopped = "interrupted: " if stop.requested else ""
        tell(f"NO LIMIT FOUND: {stopped}all requirements met from {first:g} to {found.met:g} ({flights})")
        return Exit.INTERRUPTED if stop.requested else Exit.OK
    changed = " ".join(f"--set {shlex.quote(text)}" for text in (*overrides, f"{key}={found.missed!r}"))
    tell(f"next: simrun {shlex.quote(scenario)} {changed}")
    first_miss = f"at {found.missed:g}, {verdict_line(found.flown[found.missed]).removeprefix('FAILED: ')}"
    if found.met is None:
        tell(f"MISSED: {first_miss}; the search begins at a value that meets all requirements, see --start")
        return Exit.FAILED
    tell(f"LIMIT: {key} = {found.met:g} met; {first_miss} ({flights})")
    return Exit.INTERRUPTED if stop.requested else Exit.OK


def _present(scenario: str, key: str, overrides: tuple[str, ...]) -> float:
    """Return the scenario's value of a key, or 0 if it has no value or cannot be loaded without this key.

    Raises ScenarioError if the value is not a number.
    """
    try:
        found: Any = told(load_scenario(scenario, overrides).scenario)
    except ScenarioError:
        return 0.0
    path, _ = parse_override(f"{key}=0")
    for name in path:
        if isinstance(found, list) and isinstance(name, int) and name < len(found):
            found = found[name]
        else:
            found = found.get(name) if isinstance(found, dict) else None
    if found is None:
        return 0.0
    if isinstance(found, bool) or not isinstance(found, int | float):
        raise ScenarioError(scenario, "is not a number, and has no largest value", key, value=found)
    return float(found)


def _tightest(flight: Flight) -> tuple[str, str, str, str]:
    """Return the name, value, limit and utilisation of the requirement with the least margin, or the failure of the
    flight.
    """
    if flight.failures:
        return printable(flight.failures[0]), "", "", ""
    if not flight.verdicts:
        return "", "", "", ""
    return requirement_cells(tightest_first(flight.verdicts)[0])
