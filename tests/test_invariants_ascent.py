"""Flights of one scenario share their parts: each is bit-identical to a flight that begins at the start."""

from __future__ import annotations

import dataclasses

import pytest

from maxq.design.model import powered
from maxq.design.model.node_times import flies_to
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario

GUSTS = ("wind.turbulence.exceedance=moderate",)
FAULT = ("fault=[{kind='thrust-loss',engine=0,at_s=20.2,until_s=20.6,loss=0.35}]",)


@pytest.mark.parametrize(
    ("name", "changes", "times_s"),
    [
        ("nominal", (), (0.3, 20.005, 33.123, 59.0, 61.0)),
        ("ksr3-ringed", GUSTS, (12.5, 41.0, 59.3)),
        ("nominal", FAULT, (20.3, 20.7, 25.0)),
        ("checkcases/two-stage", (), (12.0, 31.4, 70.0, 90.0)),
    ],
)
def test_a_flight_that_continues_an_earlier_one_is_bit_identical(
    name: str, changes: tuple[str, ...], times_s: tuple[float, ...]
) -> None:
    """All memory and states are compared at instants between and on the ends of segments, in two orders."""
    scenario = load_scenario(name, changes)
    powered.powered_flight(scenario, faults=True)
    later = [found(powered.flown_run(scenario, faults=True), (time_s,)) for time_s in reversed(times_s)][::-1]
    again = found(powered.flown_run(scenario, faults=True), times_s)
    fixed = scenario.scenario.run.model_copy(update={"accuracy": None})
    flown = scenario.scenario.model_copy(update={"run": fixed})
    alone = FlightRun(dataclasses.replace(scenario, scenario=flown), pack_flight(flown), log=False)
    wanted = found(alone, times_s)
    assert again == wanted
    assert [one for (one,) in later] == wanted


def found(run: FlightRun, times_s: tuple[float, ...]) -> list[tuple[float, str, bytes]]:
    """Return the time, the hash of the state and the memory of a flight at vehicle times."""
    out = []
    for time_s in times_s:
        flies_to(run, time_s)
        out.append((run.now_s, run.state_hash(), run.packed.memory.tobytes()))
    return out


def test_a_second_flight_takes_no_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first flight visits 20.005 s; the second has only to recall it."""
    scenario, advanced = load_scenario("nominal"), []
    flies_to(powered.flown_run(scenario, faults=False), 20.005)
    advance = FlightRun._advance
    monkeypatch.setattr(
        FlightRun,
        "_advance",
        lambda run, until_ns, *rest: advanced.append(until_ns - run._now_ns) or advance(run, until_ns, *rest),
    )
    run = powered.flown_run(scenario, faults=False)
    assert flies_to(run, 20.005)
    assert run.now_s == pytest.approx(20.005, abs=1e-12)
    assert sum(advanced) == 0
