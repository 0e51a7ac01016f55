"""Sensor faults follow their definitions, instants and events, and a scenario without faults is unchanged."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import maxq
from maxq import Flight, FlightRun, ScenarioError, record
from maxq.control.kernel.records import Array
from maxq.sim.campaign.targets import Dispersed, TargetChange, find_target
from maxq.sim.packing.faults import WRITES
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_fault import KINDS, FaultKind
from maxq.tools.flight_report import report

# the law is off: what the gyro says changes nothing in the motion
OPEN = (
    "run.duration_s=5",
    "switches.control=false",
    "switches.roll_control=false",
    "switches.converter=ideal",
    "vehicle.stage.0.gyro.noise_deg_rt_h=0",
)


def flown(fault: str = "", *more: str) -> Flight:
    return fly(load_scenario("nominal", (*OPEN, *more, *((f"fault=[{fault}]",) if fault else ()))))


@pytest.fixture(scope="module")
def healthy() -> Flight:
    return flown()


def measured(flight: Flight, axis: str) -> tuple[Array, Array]:
    """Return the times of the samples and the measured angle, deg."""
    return flight.time_s(f"{axis}_measured_deg")[:-1], flight[f"{axis}_measured_deg"][:-1]  # the end is no sample


@pytest.mark.parametrize(("start", "stop"), [(2.0, 3.5), (2.003512345, 3.500000001), (0.0, math.inf)])
def test_a_bias_adds_exactly_its_time_integral(healthy: Flight, start: float, stop: float) -> None:
    until = "" if stop == math.inf else f", until_s = {stop}"
    faulty = flown(f'{{kind = "gyro-bias", at_s = {start}{until}, axis = "yaw", bias_degps = 0.7}}')
    time_s, angle = measured(faulty, "yaw")
    expected = 0.7 * (np.clip(time_s, start, stop) - start)
    assert np.abs(angle - measured(healthy, "yaw")[1] - expected).max() < 1e-9
    for axis in ("roll", "pitch"):  # a longer flight by one boundary rounds otherwise
        assert np.abs(measured(faulty, axis)[1] - measured(healthy, axis)[1]).max() < 1e-9


def test_after_lift_off_it_counts_from_there(healthy: Flight) -> None:
    lifted = healthy.event_s("liftoff")
    faulty = flown('{kind = "gyro-bias", at_s = 1.25, until_s = 2.5, since = "liftoff", bias_degps = -1.5}')
    time_s, angle = measured(faulty, "pitch")
    expected = -1.5 * (np.clip(time_s, lifted + 1.25, lifted + 2.5) - lifted - 1.25)
    assert np.abs(angle - measured(healthy, "pitch")[1] - expected).max() < 1e-9
    assert faulty.event_s("fault") == pytest.approx(lifted + 1.25, abs=1e-12)
    assert faulty.event_s("fault_end") == pytest.approx(lifted + 2.5, abs=1e-12)


@pytest.mark.parametrize(("kind", "share"), [("gyro-stuck", 1.0), ("gyro-dead", 0.0)])
def test_a_stuck_gyro_keeps_its_last_rate_and_a_dead_one_has_none(healthy: Flight, kind: str, share: float) -> None:
    faulty = flown(f'{{kind = "{kind}", at_s = 2.5, until_s = 4.0, axis = "pitch"}}')
    time_s, rate = faulty.time_s("gyro_pitch_rate_degps"), faulty["gyro_pitch_rate_degps"]
    gyro = np.interp(2.5, time_s, healthy["gyro_pitch_rate_degps"])
    during = (time_s >= 2.5) & (time_s < 4.0)
    assert gyro != 0.0
    assert (rate[during] == share * gyro).all()
    assert np.abs(rate[~during] - healthy["gyro_pitch_rate_degps"][~during]).max() < 1e-9
    samples_s, angle = measured(faulty, "pitch")
    _, right = measured(healthy, "pitch")
    here = (samples_s >= 2.5) & (samples_s <= 4.0)
    expected = right[samples_s == 2.5] + share * gyro * (samples_s[here] - 2.5)
    assert np.abs(angle[here] - expected).max() < 1e-9


def test_a_noisy_gyro_has_the_random_walk_asked_for(healthy: Flight) -> None:
    faulty = flown('{kind = "gyro-noisy", at_s = 0.0, noise_deg_rt_h = 30.0}')
    steps = [np.diff(measured(faulty, a)[1] - measured(healthy, a)[1]) for a in ("roll", "pitch", "yaw")]
    normal = np.concatenate(steps)[np.newaxis] / (30.0 / 60.0 * math.sqrt(0.01))
    spread = 5.0 * math.sqrt(2.0 / normal.size)  # five sigma of the variance of this number of draws
    assert abs(normal.var() - 1.0) < spread
    assert abs(np.corrcoef(steps[0], steps[1])[0, 1]) < 5.0 / math.sqrt(len(steps[0]))


@pytest.mark.parametrize("harmless", ['kind = "gyro-bias", bias_degps = 0.0', 'kind = "gyro-dead", since = "liftoff"'])
def test_a_fault_that_does_nothing_leaves_every_bit(harmless: str) -> None:
    at_s = "1.0" if "bias" in harmless else "100.0"
    usual = fly(load_scenario("nominal", ("run.duration_s=3",)), log=False)
    again = fly(load_scenario("nominal", ("run.duration_s=3", f"fault=[{{{harmless}, at_s = {at_s}}}]")), log=False)
    assert again.state_hash == usual.state_hash


def test_of_two_faults_of_one_thing_the_later_one_holds() -> None:
    pair = '{kind = "gyro-bias", at_s = 1.0, bias_degps = 5.0}, {kind = "gyro-bias", at_s = 2.0, bias_degps = 0.0}'
    faulty = flown(pair)
    time_s = faulty.time_s("gyro_yaw_rate_degps")
    added = faulty["gyro_yaw_rate_degps"] - flown()["gyro_yaw_rate_degps"]
    assert np.abs(added - 5.0 * ((time_s >= 1.0) & (time_s < 2.0))).max() < 1e-9


def test_a_fault_stands_in_log_summary_and_report(tmp_path: Path) -> None:
    fault = 'fault=[{kind = "gyro-stuck", at_s = 1.5, until_s = 2.0, axis = "yaw"}]'
    flight = record(FlightRun(load_scenario("nominal", ("run.duration_s=3", fault))), tmp_path)
    texts = [(event.time_ns, event.text, event.level.name) for event in maxq.read(tmp_path / "flight.mcap").events]
    assert (1_500_000_000, "fault: gyro-stuck yaw", "WARNING") in texts
    assert (2_000_000_000, "fault_end: gyro-stuck yaw", "INFO") in texts
    told = json.loads((tmp_path / "summary.json").read_text())["events"]
    assert {"name": "fault", "time_s": 1.5, "detail": "gyro-stuck yaw"} in told
    assert "gyro-stuck yaw" in report(flight, [], 0.0)


def test_numbers_of_a_fault_can_be_drawn() -> None:
    base = load_scenario("nominal", ('fault=[{kind = "gyro-bias", at_s = 1.0, bias_degps = 0.5}]',)).scenario
    changes = [TargetChange(find_target(base, f"fault.0.{key}"), "set", key) for key in ("at_s", "bias_degps")]
    drawn = Dispersed(base, changes)({"at_s": 7.25, "bias_degps": -2.0}).fault[0]
    assert (drawn.at_s, drawn.bias_degps) == (7.25, -2.0)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ('{kind = "gyro-bias", at_s = 1.0}', "fault.0.bias_degps: required key is missing: kind is gyro-bias"),
        (
            '{kind = "gyro-dead", at_s = 1.0, bias_degps = 1.0}',
            "has no meaning here; allowed: this key with kind = gyro-bias",
        ),
        ('{kind = "gyro-dead", at_s = 1.0, until_s = 1.0}', "fault.0.until_s = 1.0: ends before it begins"),
        ('{kind = "gyro-dead", at_s = 1e-10}', "whole number of nanoseconds"),
        (
            '{kind = "gyro-dead", at_s = 1.0, stage = 1}',
            "fault.0.stage = 1: the vehicle has no such stage; allowed: 0 .. 0",
        ),
        ('{kind = "dead", at_s = 1.0}', "fault.0.kind"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(fault: str, said: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        load_scenario("nominal", (f"fault=[{fault}]",))
    assert said in str(refused.value)


def test_a_part_that_is_missing_or_ideal_cannot_fail() -> None:
    fault = 'fault=[{kind = "gyro-dead", at_s = 1.0}]'
    with pytest.raises(ScenarioError, match="there is no gyro to fail"):
        load_scenario("checkcases/nesc-01", (fault,))
    with pytest.raises(ScenarioError, match="an ideal gyro cannot fail"):
        load_scenario("nominal", (fault, "switches.gyro=ideal"))


# --- sensors beyond the first gyro
SENSORS = (
    "vehicle.stage.0.rate_gyro=[{station_m=8.0, omega_hz=60, zeta=0.65}, {station_m=11.5, omega_hz=50, zeta=0.7}]",
    "vehicle.stage.0.accelerometer={station_m=4.0, omega_hz=80, zeta=0.7}",
)


@pytest.fixture(scope="module")
def sensing() -> Flight:
    return flown("", *SENSORS)


OUTPUTS = ("gyro_2_yaw_rate_degps", "gyro_3_yaw_rate_degps", "accelerometer_y_mps2")
COUNTED = ("gyro_2_yaw_counted_degps", "gyro_3_yaw_counted_degps", "accelerometer_y_counted_mps2")
WHICH = ('gyro-{0}", gyro = 2, axis = "yaw"', 'gyro-{0}", gyro = 3, axis = "yaw"', 'accelerometer-{0}", axis = "y"')
BIAS = ("bias_degps = 0.7", "bias_degps = 0.7", "bias_mps2 = 0.7")
NOISE = ("noise_deg_rt_h = 30.0", "noise_deg_rt_h = 30.0", "noise_mps_rt_h = 30.0")


@pytest.mark.parametrize("sensor", range(3))
def test_each_sensor_fails_by_itself(sensing: Flight, sensor: int) -> None:
    """All four faults follow each other; the computer counts the mean of the output over each sample."""
    kinds = [WHICH[sensor].format(kind) for kind in ("bias", "stuck", "dead", "noisy")]
    faulty = flown(
        f'{{kind = "{kinds[0]}, at_s = 1.0, until_s = 1.5, {BIAS[sensor]}}}, '
        f'{{kind = "{kinds[1]}, at_s = 2.0, until_s = 2.504}}, {{kind = "{kinds[2]}, at_s = 3.0, until_s = 3.5}}, '
        f'{{kind = "{kinds[3]}, at_s = 4.0, {NOISE[sensor]}}}',
        *SENSORS,
    )
    time_s, output = faulty.time_s(OUTPUTS[sensor]), faulty[OUTPUTS[sensor]]
    right = sensing[OUTPUTS[sensor]]
    held = np.interp(2.0, time_s, right)
    expected = np.where((time_s >= 1.0) & (time_s < 1.5), right + 0.7, right)
    expected = np.where((time_s >= 2.0) & (time_s < 2.504), held, expected)
    expected = np.where((time_s >= 3.0) & (time_s < 3.5), 0.0, expected)
    assert abs(held) > 1e-7
    assert np.abs(output - expected).max() < 1e-9
    samples_s, counted = faulty.time_s(COUNTED[sensor])[:-1], faulty[COUNTED[sensor]][:-1]
    before = counted - sensing[COUNTED[sensor]][:-1]
    whole = (samples_s > 1.0105) & (samples_s <= 1.5)
    assert whole.sum() >= 50

    assert np.abs(before[whole] - 0.7).max() < 1e-9
    assert np.abs(counted[(samples_s > 2.011) & (samples_s < 2.5)] - held).max() < 1e-9
    assert np.abs(counted[(samples_s > 3.011) & (samples_s < 3.5)]).max() < 1e-12
    walk = np.unique(before[samples_s > 4.011])  # logged more often than sampled
    assert np.std(walk) == pytest.approx(30.0 / 60.0 / math.sqrt(0.01), rel=4.0 / math.sqrt(2.0 * len(walk)))
    for other in {*range(3)} - {sensor}:
        assert np.abs(faulty[OUTPUTS[other]] - sensing[OUTPUTS[other]]).max() < 1e-9
        assert np.abs(faulty[COUNTED[other]] - sensing[COUNTED[other]]).max() < 1e-9
    assert np.abs(faulty["gyro_yaw_rate_degps"] - sensing["gyro_yaw_rate_degps"]).max() < 1e-9


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (
            '{kind = "gyro-dead", at_s = 1.0, gyro = 4}',
            "fault.0.gyro = 4: the vehicle has no such gyro; allowed: 1 .. 3",
        ),
        (
            '{kind = "accelerometer-dead", at_s = 1.0, axis = "yaw"}',
            'fault.0.axis = "yaw": accelerometer-dead has no such axis; allowed: x, y, z',
        ),
        ('{kind = "accelerometer-dead", at_s = 1.0, gyro = 2}', "allowed: this key with kind = gyro-stuck"),
        ('{kind = "accelerometer-bias", at_s = 1.0}', "fault.0.bias_mps2: required key is missing"),
    ],
)
def test_sensors_that_are_not_there_are_refused_in_a_line(fault: str, said: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        load_scenario("nominal", (f"fault=[{fault}]", *SENSORS))
    assert said in str(refused.value)
    assert str(refused.value).count("\n") <= 1


def test_sensors_of_an_ideal_vehicle_do_not_fail() -> None:
    fault = 'fault=[{kind = "accelerometer-dead", at_s = 1.0}]'
    with pytest.raises(ScenarioError, match="there is no accelerometer to fail"):
        load_scenario("nominal", (fault,))
    with pytest.raises(ScenarioError, match="an ideal accelerometer cannot fail"):
        load_scenario("nominal", (fault, *SENSORS, "switches.gyro=ideal"))


def test_every_kind_is_described_and_packed() -> None:
    assert set(get_args(FaultKind)) == set(KINDS)
    assert {kind.part for kind in KINDS.values()} == set(WRITES)
