"""A wind profile that does not cover the flight, as required, fails it with a clear message."""

from __future__ import annotations

import pytest

from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

WIND = ["wind.profile=winds/anheung-november.csv", "run.duration_s=20"]


@pytest.mark.parametrize(("outside", "passes"), [("hold", True), ("error", False)])
def test_a_flight_above_its_wind_profile(outside: str, passes: bool, tmp_path) -> None:
    profile = tmp_path / "low.csv"
    profile.write_text("altitude_m,speed_mps,from_deg\n0,5,270\n500,6,270\n")
    flight = fly(load_scenario("nominal", [*WIND[1:], f"wind.profile={profile}", f"wind.outside={outside}"]), log=False)
    assert flight.passed is passes
    assert any("the wind profile ends at 500 m" in text for text in flight.failures) is not passes


def test_a_profile_that_covers_it() -> None:
    assert fly(load_scenario("nominal", [*WIND, "wind.outside=error"]), log=False).passed
