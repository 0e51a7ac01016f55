"""The log of several engines has their channels."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from maxq import ScenarioError
from maxq.control.kernel.records import blank
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly, logged_channels
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.engine.kernel import EngineOutputs, engine_row

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


def test_engines_taken_together_show_equal_shares_and_one_that_is_not_there_none() -> None:
    engines = blank(EngineOutputs)[0]
    engines.thrust_N[:2] = 3e4, 7e3
    engine = SimpleNamespace(parts=(3.0, 1.0, 3.0, 0.0), taken_as=(0, 1, 0, 0))
    row = getattr(engine_row, "py_func", engine_row)
    thrusts = [row(engine, number, engines).thrust_engine_N for number in range(4)]
    np.testing.assert_array_equal(thrusts, [1e4, 7e3, 1e4, np.nan])


def test_each_engine_on_a_load_of_its_own_has_channels() -> None:
    load = "vehicle.stage.0.tvc_load={frequency_hz=12.0,damping_ratio=0.03}"
    assert {"actuator_pitch_angle_deg", "hinge_yaw_moment_Nm"} <= set(channels(load))
    several = set(channels(load, GROUPED[0]))
    assert {"swing_load_2_yaw_angle_deg", "actuator_load_1_pitch_angle_deg", "hinge_load_2_pitch_moment_Nm"} <= several


@pytest.mark.parametrize(
    ("section", "entries", "said"),
    [
        ("actuator", "[{group=''},{group=''}]", "already has an entry"),
        ("actuator", "[{group=''}]", "no entry for group 'middle'"),
        (
            "actuator",
            "[{group='middle'},{group='outer'}]",
            "no gimballed engine is of this group; allowed: '', 'middle'",
        ),
        ("actuator", "{group='middle'}", "one table moves all groups"),
        ("tvc_load", "[{group='outer'}]", "no gimballed engine is of this group"),
        ("tvc_load", "[{group='middle'},{group='middle'}]", "already has an entry"),
    ],
)
def test_lists_by_group_are_refused_by_their_place(section: str, entries: str, said: str) -> None:
    axis = "omega_hz=[5.8,7.2,52.6,15.6],zeta=[0.87,0.49,0.15,0.042],angle_limit_deg=4.0,rate_limit_degps=25.0"
    given = {"actuator": axis, "tvc_load": "frequency_hz=12.0,damping_ratio=0.03"}[section]
    with pytest.raises(ScenarioError) as caught:
        load_scenario(NINE, [GROUPED[0], f"vehicle.stage.0.{section}={entries.replace('}', f',{given}}}')}"])
    assert said in str(caught.value)
    assert f"stage.0.{section}" in str(caught.value)


def test_an_engine_without_inertia_does_not_swing() -> None:
    load = "vehicle.stage.0.tvc_load={frequency_hz=12.0,damping_ratio=0.03}"
    light = [f"vehicle.stage.0.engine.3.{key}=0.0" for key in ("gimballed_mass_kg", "inertia_about_gimbal_kgm2")]
    with pytest.raises(ScenarioError, match=r"engine\.3\.inertia_about_gimbal_kgm2"):
        load_scenario(NINE, [load, *light])
