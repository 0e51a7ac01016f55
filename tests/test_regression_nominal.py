"""The nominal flight has the numbers of Table 1 of the paper and maxq's recorded numbers.

The recorded numbers may change with the model or the vehicle's data, but not by accident. After an intended change,
check the pictures of docs/flights/nominal.md again and give the reason in the commit.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from maxq import Flight, FlightRun
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

BEFORE = json.loads(Path("tests/data/one-engine-before.json").read_text())["flights"]


@pytest.fixture(scope="module")
def nominal() -> Flight:
    return fly(load_scenario("nominal"), log=False)


@pytest.mark.parametrize(
    ("metric", "paper", "within"),
    [
        ("max_speed_mps", 850.0, 0.02 * 850.0),
        ("max_altitude_m", 43_000.0, 1500.0),
        ("range_m", 79_000.0, 3000.0),
        ("flight_time_s", 230.0, 6.0),
    ],
)
def test_table_1(nominal: Flight, metric: str, paper: float, within: float) -> None:
    assert nominal.metrics[metric] == pytest.approx(paper, abs=within)


def test_the_papers_acceleration_lies_between_thrust_over_mass_and_what_is_sensed(nominal: Flight) -> None:
    assert nominal.metrics["max_axial_load_g"] < 4.1 < nominal.metrics["max_thrust_over_weight_g"]


def test_events_come_in_order(nominal: Flight) -> None:
    assert [event.name for event in nominal.events] == ["ignition", "liftoff", "burnout", "apogee", "impact"]
    assert nominal.passed
    assert 233_003 <= nominal.steps <= 233_503  # of a millisecond, and a few that end at events


@pytest.mark.parametrize(
    ("metric", "value"),
    [
        ("max_speed_mps", 852.139),
        ("max_altitude_m", 42391.0),
        ("max_powered_dynamic_pressure_Pa", 52692.1),
        ("max_alpha_deg", 4.40638),
        ("max_q_alpha_Padeg", 49820.6),
        ("max_attitude_error_deg", 3.20955),  # of the true attitude; the next was this before
        ("max_computer_attitude_error_deg", 3.20929),
        ("max_gimbal_deg", 2.72513),
        ("max_slosh_deg", 4.66656),
        ("max_thrust_over_weight_g", 4.20848),
        ("max_axial_load_g", 3.60047),
        ("range_m", 79334.5),
        ("flight_time_s", 233.003),
    ],
)
def test_as_last_looked_at(nominal: Flight, metric: str, value: float) -> None:
    assert nominal.metrics[metric] == pytest.approx(value, rel=2e-5)


def flown(scenario: str, changes: list[str]) -> FlightRun:
    run = FlightRun(load_scenario(scenario, changes), log=False)
    while not run.finished:
        run.fly_segment(10**12)
    return run


@pytest.mark.parametrize("flight", BEFORE)
def test_one_engine_on_a_stiff_mount_with_slopes_and_one_gust_flies_as_before(flight: str) -> None:
    """The flight is equal to the bit where it was recorded; the sine of another processor may round differently."""
    given = BEFORE[flight]
    state = flown(given["scenario"], given["set"]).packed.state
    np.testing.assert_allclose(state[state != 0.0], given["state"], rtol=1e-9, atol=1e-12)


def test_what_came_in_since_changes_no_bit_where_it_is_told_to_do_nothing() -> None:
    """Later keys and switches set to no effect, with engine and actuator as lists of one, change no bit."""
    stage = load_scenario("nominal").scenario.vehicle.stage[0]
    one, servo = stage.engines[0], stage.actuators[0]
    assert servo is not None
    numbers = (
        "exit_area_m2",
        "gimbal_station_m",
        "exit_station_m",
        "gimballed_mass_kg",
        "cg_from_gimbal_m",
        "inertia_about_gimbal_kgm2",
    )
    engine = ", ".join(f"{key} = {getattr(one, key)!r}" for key in numbers)
    later = (
        f"vehicle.stage.0.engine = [{{table = 'vehicles/ksr3/thrust.csv', {engine}, group = 'all', gimbal = 'both', "
        "cant_deg = [0, 0], offset_m = [0, 0], misalignment_deg = [0, 0]}]",
        f"vehicle.stage.0.actuator = [{{group = 'all', model = 'sixth-order', omega_hz = {list(servo.omega_hz)}, "
        f"zeta = {list(servo.zeta)}, angle_limit_deg = {servo.angle_limit_deg}, limits_act_on = 'servo', "
        f"rate_limit_degps = {servo.rate_limit_degps}, backlash_deg = 0.0}}]",
        "switches.gust_penetration = false",
        "switches.slosh_exchange = false",
        "switches.tvc_load = false",
        "switches.section_loads = false",
    )
    gust = BEFORE["through a gust to burnout"]["set"][2]
    usual, told = (flown("nominal", ["run.duration_s=40", gust, *more]) for more in ((), later))
    np.testing.assert_array_equal(told.packed.state, usual.packed.state)
    assert told.state_hash() == usual.state_hash()
