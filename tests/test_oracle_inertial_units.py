"""Several inertial units in the inputs of flight code, and their selection by the reference computer.

| result | compared with |
|---|---|
| increments of three units | the log of each sensor |
| lost samples, faults of one unit | the increments without the fault |
| code of version 2 before this field | the same code with the present header, bit for bit |
| reference computer with a failed unit | the true position of the flight |
"""

from __future__ import annotations

import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from flight_code import compiled, flies, needs_compiler
from petrelkit import folder
from test_oracle_flight_computer import IDEAL, ORBIT, SEQUENCE, computer_flight, flight_computer, library

from maxq import Flight
from maxq.control.external import HEADER
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

LAG = "omega_hz=60.0,zeta=0.7"
UNITS = [
    f"vehicle.stage.0.rate_gyro=[{{station_m=4.0,{LAG}}},{{station_m=5.0,{LAG},latency_samples=1}}]",
    f"vehicle.stage.0.accelerometer={{station_m=3.0,{LAG}}}",
    f"vehicle.stage.0.further_accelerometer=[{{station_m=4.0,{LAG}}},{{station_m=5.0,{LAG},latency_samples=1}}]",
]


def copying(folder: Path, name: str, *values: str) -> list[str]:
    """Return the overrides of code that ignites and copies expressions into its monitors."""
    words = " ".join(f"out->monitor[{k}] = {value};" for k, value in enumerate(values))
    return flies(library=library(folder, f"out->ignition = 1; {words}", name), sequencing="flight-code")


def flown(code: list[str], *more: str) -> Flight:
    return fly(load_scenario("nominal", [*IDEAL, *code, *UNITS, "run.duration_s=1.5", "log.fast_hz=100", *more]))


@needs_compiler
def test_the_inputs_contain_the_increments_of_all_units(tmp_path: Path) -> None:
    """Compare the increments over 10 ms with the counted means in the log."""
    values = ["in->imu_delta_angle_rad[0][1] - in->delta_angle_rad[1]", "in->imu_delta_velocity_mps[0][0]"]
    values += [f"in->imu_delta_{kind}[{n}][0]" for n in (1, 2) for kind in ("angle_rad", "velocity_mps")]
    flight = flown(copying(tmp_path, "copying", *values, "in->imu_count", "in->imu_health"))
    rate, force = "gyro_{}_roll_counted_degps", "accelerometer_{}x_counted_mps2"
    wanted = [
        0.0 * flight["monitor_1"],
        0.01 * flight[force.format("")],
        *(
            channel
            for n in (2, 3)
            for channel in (np.radians(0.01 * flight[rate.format(n)]), 0.01 * flight[force.format(f"{n}_")])
        ),
    ]
    for k, values_of in enumerate(wanted, start=1):
        assert flight[f"monitor_{k}"][1:] == pytest.approx(values_of[1:], rel=1e-12, abs=1e-15), k
    assert (flight.final["monitor_7"], flight.final["monitor_8"]) == (3.0, 7.0)
    assert 0.05 < flight["monitor_2"].max() < 0.5
    late, own = flight["monitor_6"], flight["monitor_2"]
    assert np.abs(late[2:] - own[1:-1]).max() < 0.02 * own.max()  # a sample later, 2 m away


@needs_compiler
def test_a_lost_sample_clears_the_bit_of_its_unit_and_keeps_the_last_one(tmp_path: Path) -> None:
    values = "in->imu_delta_angle_rad[0][1]", "in->imu_delta_velocity_mps[2][0]", "in->imu_health", "in->health"
    code = copying(tmp_path, "lost", *values)
    lost = ",".join(
        f"{{kind='{kind}-lost',{kind}={number},at_s=0.8,until_s=1.2}}"
        for kind, number in (("gyro", 1), ("accelerometer", 3))
    )
    ideal = "switches.converter='ideal'"  # otherwise, the converter counts the increment again, with its remainder
    clean, flight = flown(code, ideal), flown(code, ideal, f"fault=[{lost}]")
    at = flight.time_s("monitor_1")
    during = (at > 0.81) & (at < 1.19)
    assert set(flight["monitor_3"][during]) == {2.0}
    assert set(flight["monitor_3"][(at > 0.1) & ~((at > 0.79) & (at < 1.21))]) == {7.0}
    assert np.ptp(flight["monitor_1"][during]) == 0.0
    assert np.ptp(flight["monitor_2"][during]) == 0.0
    assert np.ptp(clean["monitor_2"][during]) > 1e-4
    assert set(flight["monitor_4"][during]) == {2.0 + 4.0}  # the first accelerometer and the further gyros


def test_wrong_units_are_rejected() -> None:
    with pytest.raises(ScenarioError, match="there is no first accelerometer"):
        load_scenario("nominal", [UNITS[2]])
    four = UNITS[0].replace("rate_gyro=[", f"rate_gyro=[{{station_m=4.5,{LAG}}},")
    with pytest.raises(ScenarioError, match="6 sensors after the first gyro"):
        load_scenario("nominal", [four, *UNITS[1:]])
    fault = "fault=[{kind='accelerometer-bias',accelerometer=3,bias_mps2=1.0,at_s=0.0}]"
    with pytest.raises(ScenarioError, match=r"the vehicle has no such accelerometer"):
        load_scenario("nominal", [UNITS[1], fault])


@needs_compiler
def test_a_library_of_version_2_before_these_fields_flies_unchanged(tmp_path: Path) -> None:
    header = HEADER.read_text()
    before = re.sub(r".*\bimu_\w+.*\n", "", header)
    assert header.count("imu_") > before.count("imu_") == 0
    step = (
        "out->ignition = 1; out->gimbal_rad[0] = -in->attitude_error_rad[1]; out->monitor[0] = in->bytes - sizeof *in;"
    )
    flights = []
    for name, text in (("before", before), ("now", header)):
        place = tmp_path / name
        place.mkdir()
        (place / "maxq_fsw.h").write_text(text)
        (place / "code.c").write_text(SEQUENCE.replace("STEP", step))
        flights.append(flown(flies(library=compiled(place, place / "code.c", name), sequencing="flight-code")))
    assert flights[0].state_hash == flights[1].state_hash
    assert [flight.final["monitor_1"] for flight in flights] == [160.0, 0.0]


# --- the reference computer

STATION = "station_m=6.8,omega_hz=60.0,zeta=0.7"
THREE = [
    *(f"vehicle.stage.{n}.accelerometer={{{STATION}}}" for n in range(3)),
    *(f"vehicle.stage.{n}.rate_gyro=[{{{STATION}}},{{{STATION}}}]" for n in range(3)),
    *(f"vehicle.stage.{n}.further_accelerometer=[{{{STATION}}},{{{STATION}}}]" for n in range(3)),
]
FAILED = {
    "bias": "{kind='gyro-bias',bias_degps=5.0,at_s=4.0},{kind='accelerometer-bias',bias_mps2=-8.0,at_s=4.0}",
    "freeze": "{kind='gyro-stuck',at_s=9.0},{kind='accelerometer-stuck',at_s=3.0}",
    "noise": "{kind='gyro-noisy',noise_deg_rt_h=60.0,at_s=4.0},"
    "{kind='accelerometer-noisy',noise_mps_rt_h=60.0,at_s=4.0}",
    "loss": "{kind='gyro-lost',at_s=9.0},{kind='accelerometer-lost',at_s=3.0}",
}

ALONE_M = {"bias": 20.0, "loss": 5.0}  # least additional error without other units


def position_error_m(*more: str) -> float:
    """Return the distance of the navigated from the true position at the end of 12 s without GNSS."""
    code = flies(library=flight_computer(), sequencing="flight-code")
    given = ["requirement=", ORBIT, *code, "run.duration_s=12", *more]
    flight = fly(load_scenario(folder() / "scenario.toml", given), log=False)
    navigated = [flight.final[f"monitor_{k}"] for k in (1, 2, 3)]
    return float(np.linalg.norm([x - flight.final[f"r_I_{a}_m"] for x, a in zip(navigated, "xyz", strict=True)]))


@cache
def clean_m() -> float:
    return position_error_m(*THREE)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("kind", FAILED)
def test_a_failed_unit_does_not_change_the_navigation(kind: str) -> None:
    """The first unit fails in flight; the distance of the accelerometer from the CG is part of the error."""
    failed = f"fault=[{FAILED[kind]}]"
    assert position_error_m(*THREE, failed) == pytest.approx(clean_m(), abs=0.5)
    if kind in ALONE_M:
        assert position_error_m(*THREE[:3], failed) > clean_m() + ALONE_M[kind]


def units_with_errors(stage: int) -> list[str]:
    """Return three units of a stage with constant errors up to 2 deg/h and 5 mm/s2."""
    gyros = ("[1.0,-2.0,1.0]", "[-1.0,1.0,-2.0]")
    accelerometers = ("[-0.003,0.004,-0.002]", "[0.001,0.002,0.005]")
    place = f"vehicle.stage.{stage}"
    return [
        f"{place}.accelerometer={{{STATION},bias_mps2=[0.004,-0.002,0.003]}}",
        f"{place}.rate_gyro=[{','.join(f'{{{STATION},bias_degph={bias}}}' for bias in gyros)}]",
        f"{place}.further_accelerometer=[{','.join(f'{{{STATION},bias_mps2={bias}}}' for bias in accelerometers)}]",
    ]


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("kind", ["none", *FAILED])
def test_units_with_errors_reach_the_orbit_also_after_a_failure(kind: str) -> None:
    """Fly from pad to orbit with GNSS. A failed unit is left out; the greater of the other two would drift by 4 deg."""
    units = [change for stage in range(3) for change in units_with_errors(stage)]
    failed = [] if kind == "none" else [f"fault=[{FAILED[kind]}]"]
    flight = computer_flight(*units, *failed)
    assert flight.final["monitor_8"] == 0.0  # no solution of the receiver is rejected
    assert abs(flight.metrics["cutoff_perigee_error_m"]) < 50.0
    assert abs(flight.metrics["cutoff_apogee_error_m"]) < 500.0


@pytest.mark.long
@needs_compiler
def test_a_single_failed_unit_misses_the_orbit() -> None:
    alone = [units_with_errors(stage)[0] for stage in range(3)]
    flight = computer_flight(*alone, f"fault=[{FAILED['bias']}]")
    assert math.isnan(flight.metrics["cutoff_apogee_error_m"])
