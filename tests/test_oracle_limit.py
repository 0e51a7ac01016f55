"""`simrun limit` finds known limits, such as the fall time to a speed."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from typing import Any

import pytest

from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.limit import find_limit
from maxq.sim.run.record import fly_to_end
from maxq.tools import simrun, simrun_limit

G_MPS2 = 9.7521  # at 9,144 m over the equator: GM / r^2 (1 + 1.5 J2 (a / r)^2) less the centrifugal acceleration


@dataclass
class _Flown:
    passed: bool


class _Plant:
    """A plant whose flights miss their limits at the values of `bad`."""

    def __init__(self, bad: Any, allowed: float = 1e9) -> None:
        self.bad, self.allowed, self.asked = bad, allowed, []

    def __call__(self, value: float) -> Any:
        if abs(value) > self.allowed:
            raise ScenarioError("--set", f"{value:g} is too large")
        self.asked.append(value)
        return _Flown(not self.bad(value))


@pytest.mark.parametrize(
    ("first", "last", "threshold"), [(0.0, None, 17.3), (0.0, None, 0.004), (4.0, None, 4000.0), (0.0, 40.0, 17.3)]
)
def test_limit_is_bracketed_within_one_percent(first: float, last: float | None, threshold: float) -> None:
    plant = _Plant(lambda value: value > threshold)
    found = find_limit(plant, first, last)
    assert found.met is not None
    assert found.missed is not None
    assert found.met <= threshold < found.missed
    assert found.missed - found.met <= 0.01 * (found.missed - first) + 1e-12
    assert len(plant.asked) == len(set(plant.asked)) == len(found.flown) <= 40


def test_search_downwards_finds_the_smallest_value() -> None:
    found = find_limit(_Plant(lambda value: value < -3.0), 10.0, -10.0)
    assert found.met is not None
    assert found.missed is not None
    assert found.missed < -3.0 <= found.met
    assert found.met - found.missed <= 0.01 * (10.0 - found.missed)


def test_a_band_of_misses_below_a_larger_value_that_is_met_is_the_limit() -> None:
    """Doubling steps (31, 63, 127) skip the band of misses from 35 to 45; the search of eight intervals finds it."""
    found = find_limit(_Plant(lambda value: 35.0 < value < 50.0 or value > 100.0), 0.0)
    assert found.met is not None
    assert found.missed is not None
    assert found.met <= 35.0 < found.missed <= found.met + 0.36


def test_what_was_not_found_is_not_claimed() -> None:
    none = find_limit(_Plant(lambda value: False), 0.0, 8.0)
    assert (none.met, none.missed, len(none.flown)) == (8.0, None, 9)
    refused = find_limit(_Plant(lambda value: False, allowed=10.0), 0.0)
    assert (refused.met, refused.missed, refused.refused) == (7.0, None, "--set: 15 is too large")
    at_once = find_limit(_Plant(lambda value: True), 2.0)
    assert (at_once.met, at_once.missed, list(at_once.flown)) == (None, 2.0, [2.0])
    with pytest.raises(ScenarioError, match="11 is too large"):
        find_limit(_Plant(lambda value: False, allowed=10.0), 11.0)


def test_an_interrupted_search_returns_what_it_flew() -> None:
    plant = _Plant(lambda value: value > 17.3)
    found = find_limit(plant, 0.0, 40.0, stop=lambda: len(plant.asked) >= 4)
    assert (found.met, found.missed, len(found.flown)) == (15.0, None, 4)


def test_an_interruption_within_a_flight_keeps_the_flights_before_it() -> None:
    def fly_at(value: float) -> Any:
        if value > interrupted:
            raise KeyboardInterrupt
        return _Flown(True)

    interrupted = 10.0
    found = find_limit(fly_at, 0.0, 40.0)
    assert (found.met, found.missed, list(found.flown)) == (10.0, None, [0.0, 5.0, 10.0])
    interrupted = -1.0
    with pytest.raises(KeyboardInterrupt):
        find_limit(fly_at, 0.0, 40.0)


def test_ctrl_c_within_a_flight_prints_the_flights_before_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    flights = 0

    def flown(*arguments: Any, **options: Any) -> Any:
        nonlocal flights
        flights += 1
        if flights == 3:
            signal.raise_signal(signal.SIGINT)
        return fly_to_end(*arguments, **options)

    monkeypatch.setattr(simrun_limit, "fly_to_end", flown)
    assert simrun.main(["limit", "checkcases/nesc-01", "run.duration_s", "--start", "1", "--end", "9"]) == 130
    said = capsys.readouterr().out
    assert "NO LIMIT FOUND: interrupted: all requirements met from 1 to 2 (2 flights" in said
    assert said.count(" met\n") == 2


def test_fall_time_to_a_speed(capsys: pytest.CaptureFixture[str]) -> None:
    limit = 'requirement=[{metric="final_speed_mps", limit=50.0}]'
    form = ["checkcases/nesc-01", "--search", "run.duration_s", "--start", "1", "--end", "9", "--set", limit]
    assert simrun.main(form) == 0
    said = " ".join(capsys.readouterr().out.split())
    verdict = said[said.index("LIMIT: ") :]
    met_s = float(verdict.split()[3])
    assert met_s <= 50.0 / G_MPS2 < met_s * 1.01
    assert "; at 5.15625, final_speed_mps 50.28 m/s > 50 m/s at 5.156 s" in verdict
    assert verdict.endswith("(11 flights, one for each value)")


def test_errors_name_the_key_and_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert simrun.main(["limit", "nominal", "site.utc"]) == 2
    assert 'nominal: site.utc = "2002-11-28T05:52:26Z": is not a number' in capsys.readouterr().err
    assert simrun.main(["limit", "nominal", "run.step_s", "--end", "0.001"]) == 2
    assert "--end 0.001: the search begins at this value" in capsys.readouterr().err
    assert simrun.main(["limit", "nominal", "wind.sped_mps"]) == 2
    assert "wind.sped_mps = 0.0: unknown key; did you mean speed_mps" in capsys.readouterr().err
