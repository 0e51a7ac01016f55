"""What the log says of several engines."""

from __future__ import annotations

import numpy as np
import pytest

from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly, logged_channels
from maxq.sim.scenario.loader import load_scenario

NINE = "tests/data/nine-engines/flight.toml"
GROUPED = ["vehicle.stage.0.engine.8.group='middle'", "fault=[{kind='engine-off',engine=1,at_s=3.0}]"]


def channels(*overrides: str) -> tuple[str, ...]:
    scenario = load_scenario(NINE, list(overrides)).scenario
    return logged_channels(scenario, pack_flight(scenario).sizes).names


def test_channels_of_engines_and_groups_are_there_where_there_are_several() -> None:
    assert {f"thrust_engine_E{k}_N" for k in range(1, 10)} <= set(channels())
    assert not any("group" in name for name in channels())
    assert {"gimbal_group_1_pitch_angle_deg", "gimbal_group_middle_yaw_rate_degps"} <= set(channels(*GROUPED))
    one = load_scenario("nominal").scenario
    names = logged_channels(one, pack_flight(one).sizes).names
    assert not any("engine" in name or "group" in name for name in names)


@pytest.mark.slow
def test_each_engine_shows_its_own_thrust_and_each_group_its_angle() -> None:
    flight = fly(load_scenario(NINE, [*GROUPED, "run.duration_s=6.0"]))
    t = flight.time_s("thrust_engine_E2_N")
    lost, other = flight["thrust_engine_E2_N"], flight["thrust_engine_E3_N"]
    before, after = (t > 1.0) & (t < 3.0), t > 3.0
    np.testing.assert_allclose(lost[before], other[before], rtol=1e-12)
    assert not lost[after].any()
    total = sum(flight[f"thrust_engine_E{k}_N"] for k in range(1, 10))
    slow = np.interp(flight.time_s("thrust_N"), t, total)
    np.testing.assert_allclose(flight["thrust_N"][-50:], slow[-50:], rtol=1e-5)
    np.testing.assert_array_equal(flight["gimbal_group_1_pitch_angle_deg"], flight["gimbal_pitch_angle_deg"])
