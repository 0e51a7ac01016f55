"""The whole flight computer in flight code: version 2 of the interface against independent solutions.

| result | compared with |
|---|---|
| version 1 in a library and behind a socket | the flight of the same code of version 2, bit for bit |
| propellant with throttle, cutoff and restart | the built-in flight's, over the time that the tables have run |
| GNSS, barometer, magnetometer | true motion of the log, standard atmosphere and dipole in NumPy |
| errors of GNSS | their standard deviations and correlation |
| faults of the sensors and switches | the flight without faults |
| dispersed flights | the target orbit, and a repetition of a run, bit for bit |
| petrel from pad to orbit | the built-in guidance, a repetition, bit for bit, and the computer in Python |
"""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler
from flightkit import COMPUTER, Tree, merged, toml
from made_once import copy_of
from petrelkit import folder
from test_oracle_cutoff import CONSTANT, SPACE, THRUST_N, MASS_kg

import maxq
from maxq import Flight
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import flown_run, flown_to, powered_spans
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.investigation import refly
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.run.instances import Inputs, Outputs, size_of
from maxq.sim.run.sandbox import sandbox_problem
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun, simverify
from maxq.tools.design.export import export_c

VERSION_1 = Path(__file__).parent / "data" / "maxq_fsw_version_1.h"
SEQUENCE = """
#include "maxq_fsw.h"
int32_t maxq_fsw_abi(void) { return MAXQ_FSW_ABI; }
int64_t maxq_fsw_bytes(void) { return 8; }
int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *s) { (void)self; return s->sequencing == 1 ? 0 : 1; }
int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    (void)self;
    STEP
    return 0;
}
void maxq_fsw_close(void *self) { (void)self; }
"""
IDEAL = ["switches.bending=false", "switches.slosh=false", "requirement="]


def library(folder: Path, step: str, name: str = "sequence") -> Path:
    source = folder / f"{name}.c"
    source.write_text(SEQUENCE.replace("STEP", step))
    return compiled(folder, source, name)


def sequenced(code: Path, *more: str, scenario: str | Path = "nominal") -> Flight:
    return fly(load_scenario(scenario, [*IDEAL, *flies(library=code, sequencing="flight-code"), *more]))


# --- version 1


@needs_compiler
def test_a_library_of_version_1_flies_unchanged(tmp_path: Path) -> None:
    """Compile the example with the header of version 1, which also checks the sizes that it receives."""
    first, second = tmp_path / "first", tmp_path / "second"
    for place in (first, second):
        place.mkdir()
        (place / "pd.h").write_text((EXAMPLES / "pd.h").read_text())
        text = (EXAMPLES / "pd_law.c").read_text()
        checks = "if (in->bytes != (int64_t)sizeof *in || out->bytes != (int64_t)sizeof *out) { return 9; }"
        text = text.replace("    pd_step(self, in, out);", f"    {checks}\n    pd_step(self, in, out);")
        assert checks in text
        (place / "pd_law.c").write_text(text.replace("return pd_init", "return setup->abi != MAXQ_FSW_ABI || pd_init"))
    (first / "maxq_fsw.h").write_text(VERSION_1.read_text())
    powered = ["run.duration_s=20", "requirement="]
    flights = [
        fly(load_scenario("nominal", [*powered, *flies(library=compiled(place, place / "pd_law.c", "pd_law"))]))
        for place in (first, second)
    ]
    assert flights[0].outcome == "duration"
    assert flights[0].state_hash == flights[1].state_hash


@needs_compiler
@pytest.mark.skipif(bool(sandbox_problem()), reason=sandbox_problem() or "there is a sandbox")
@pytest.mark.parametrize("version", [1, 2])
def test_a_library_in_a_sandbox_receives_the_structs_of_its_version(tmp_path: Path, version: int) -> None:
    if version == 1:
        (tmp_path / "maxq_fsw.h").write_text(VERSION_1.read_text())
    source = tmp_path / "sizes.c"
    step = f"""
    out->gimbal_rad[0] = -1.1 * in->attitude_error_rad[1];
    out->monitor[0] = (double)in->bytes, out->monitor[1] = (double)out->bytes, out->monitor[2] = {version};
    """
    source.write_text(SEQUENCE.replace("STEP", step).replace("s->sequencing == 1 ? 0 : 1", "s->abi - MAXQ_FSW_ABI"))
    code = flies(library=compiled(tmp_path, source, "sizes"))
    flights = [
        fly(load_scenario("nominal", ["run.duration_s=3", "requirement=", *code, *more]))
        for more in ([], ["vehicle.computer.sandbox=true"])
    ]
    assert flights[0].outcome == "duration"
    assert flights[0].state_hash == flights[1].state_hash
    for flight in flights:
        sizes = [flight[f"monitor_{k}"][-1] for k in (1, 2, 3)]
        assert sizes == [size_of(Inputs, version), size_of(Outputs, version), version]


@needs_compiler
@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_computer_behind_a_socket_flies_both_versions(tmp_path: Path, kind: str) -> None:
    """Fly the law in the simulator's process, and behind a socket in each version."""
    law = compiled(tmp_path, EXAMPLES / "pd_law.c", "pd_law")
    powered = ["run.duration_s=3", "requirement="]
    hashes = {fly(load_scenario("nominal", [*powered, *flies(library=law)])).state_hash}
    program = compiled(tmp_path, EXAMPLES / "computer.c", "computer", str(EXAMPLES / "pd_law.c"), program=True)
    for version in (1, 2):
        with subprocess.Popen([program, kind, "0"], stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                port = process.stdout.readline().strip()
                there = flies(address=f"{kind}://127.0.0.1:{port}", interface=version)
                hashes.add(fly(load_scenario("nominal", [*powered, *there])).state_hash)
            finally:
                process.kill()
    assert len(hashes) == 1


# --- sequence


@needs_compiler
def test_throttle_cutoff_and_restart_consume_the_propellant_of_the_tables(tmp_path: Path) -> None:
    """Compare the mass with that of the built-in flight at the time that the tables have run."""
    step = """
    out->ignition = in->tick == 0 || in->tick == 1200;
    out->throttle = in->tick == 300 ? 0.6 : in->tick == 700 ? 1.1 : 0.0;
    out->cutoff = in->tick == 900;
    out->cutoff_delay_s = 0.0005;
    """
    held = ["run.duration_s=20", "holddown={release='time',release_s=100}"]
    flight = sequenced(library(tmp_path, step), *held)
    plain = fly(load_scenario("nominal", [*IDEAL, *held, "run.duration_s=40"]))
    computer = flight.scenario.vehicle.computer
    assert computer is not None
    delay_s = computer.delay_s
    lit, slow, fast, off = (0.01 * (tick + 1) + delay_s for tick in (0, 300, 700, 900))
    again = 12.01 + delay_s
    off += 0.0005
    times = flight.time_s("mass_kg")
    ran = np.interp(
        times,
        [0.0, lit, slow, fast, off, again, 30.0],
        np.cumsum([0.0, 0.0, slow - lit, 0.6 * (fast - slow), 1.1 * (off - fast), 0.0, 30.0 - again]),
    )
    wanted = np.interp(ran, plain.time_s("mass_kg"), plain["mass_kg"])
    # the log of the built-in flight is interpolated linearly between rows 0.02 s apart
    assert np.abs(flight["mass_kg"] - wanted).max() < 0.02
    assert flight["mass_kg"][0] - flight["mass_kg"][-1] > 500.0
    events = [(e.name, e.time_s) for e in flight.events]
    assert events[0] == ("ignition", pytest.approx(lit, abs=1e-9))
    assert ("cutoff", pytest.approx(off, abs=1e-9)) in events
    assert ("restart", pytest.approx(again, abs=1e-9)) in events
    thrust, pressure = flight["thrust_N"], flight["pressure_Pa"]
    engine = flight.scenario.vehicle.stage[0].engines[0]
    full = np.interp(times, plain.time_s("thrust_N"), plain["thrust_N"]) + pressure * engine.exit_area_m2
    at = [int(np.searchsorted(times, t)) for t in (5.0, 8.5)]
    for k, share in zip(at, (0.6, 1.1), strict=True):
        ideal = np.interp(ran[k], times, full)
        assert thrust[k] + pressure[k] * engine.exit_area_m2 == pytest.approx(share * ideal, rel=1e-6)
    coasting = (times > off + 0.1) & (times < again)
    assert np.all(thrust[coasting] == 0.0)


def written(folder: Path, tree: Tree) -> Path:
    path = folder / "scenario.toml"
    path.write_text("\n".join(f"{key} = {toml(value)}" for key, value in tree.items()))
    return path


@needs_compiler
def test_code_separates_a_fairing_before_the_time_of_the_vehicle_file(tmp_path: Path) -> None:
    """In empty space, the speed is that of constant thrust on two masses, exchanged 9 s before `separation_s`.

    Tables that begin at `separation_s` have no row for the propellant that is left then.
    """
    step = "out->ignition = 1; out->fairing_separation = in->tick == 99;"
    code = {"law": "external", "library": str(library(tmp_path, step)), "sequencing": "flight-code"}
    first = CONSTANT | {"separation_s": 10.0}
    later = merged(CONSTANT | {"continues": True, "clock": "preceding"}, {"mass": {"mass_kg": 0.8 * MASS_kg}})
    changes: Tree = {
        "initial": {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [100.0, 0.0, 0.0]},
        "vehicle": {"stage": [first, later], "computer": COMPUTER | code},
        "run": {"duration_s": 3.0},
    }
    tree = merged(SPACE, changes)
    flight = fly(load_scenario(written(tmp_path, tree)))
    lit_s, left_s = (0.01 + COMPUTER["delay_s"], 1.0 + COMPUTER["delay_s"])
    assert flight.event_s("separation") == pytest.approx(left_s, abs=1e-9)
    gained_mps = THRUST_N / MASS_kg * (left_s - lit_s) + THRUST_N / (0.8 * MASS_kg) * (3.0 - left_s)
    assert flight["v_I_x_mps"][-1] == pytest.approx(100.0 + gained_mps, rel=1e-9)

    columns = {"mass_kg": 800.0, "x_cg_m": 2.5, "Ixx_kgm2": 200.0, "Iyy_kgm2": 1500.0, "Izz_kgm2": 1500.0}
    table = {"time_s": [0.0, 20.0], **{name: [value, value] for name, value in columns.items()}}
    later |= {"clock": "own", "mass": {"table": table}}
    early = fly(load_scenario(written(tmp_path, merged(tree, {"vehicle": {"stage": [first, later]}}))))
    assert early.cause == "commanded fairing_separation in stage 1 before the tables of stage 2 begin"
    assert early.end_s == pytest.approx(left_s, abs=1e-9)


@needs_compiler
def test_operating_points_follow_the_commanded_ignitions(tmp_path: Path) -> None:
    """Two stages with 2 s of thrust: both are lit later than in the vehicle file, and the first one is restarted.

    The spans contain the delay of the propellant tables, which the flight also counts (`Clock.idle_ns`).
    """
    step = """
    out->ignition = in->tick == 49 || in->tick == 149 || in->tick == 399;
    out->cutoff = in->tick == 99;
    out->stage_separation = in->tick == 299;
    """
    code = {"law": "external", "library": str(library(tmp_path, step)), "sequencing": "flight-code"}
    thrust = {"time_s": [0.0, 2.0, 2.001], "thrust_vacuum_N": [THRUST_N, THRUST_N, 0.0]}
    stage = merged(CONSTANT, {"engine": {"table": thrust}})
    changes: Tree = {
        "initial": {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [100.0, 0.0, 0.0]},
        "vehicle": {"stage": [stage | {"separation_s": 2.5}, stage], "computer": COMPUTER | code},
        "run": {"duration_s": 7.0},
    }
    loaded = load_scenario(written(tmp_path, merged(SPACE, changes)))
    assert [dataclasses.astuple(span) for span in powered_spans(loaded)] == [
        (0, *(pytest.approx(t, abs=1e-9) for t in (0.503, 1.003, 0.503))),
        (0, *(pytest.approx(t, abs=1e-9) for t in (1.503, 3.003, 1.003))),
        (1, *(pytest.approx(t, abs=1e-9) for t in (4.003, 6.004, 1.503))),
    ]
    times_s = node_times(loaded, 2, edges=(0.1, 0.1))
    assert times_s == pytest.approx((0.553, 0.953, 1.653, 2.853, 4.203, 5.803), abs=1e-9)
    run = flown_run(loaded, faults=False)
    for span in powered_spans(loaded):
        flown_to(run, round(0.5 * (span.begin_s + span.end_s), 2))
        assert 1e-9 * run.memory.clock.idle_ns == pytest.approx(span.idle_s, abs=2e-9)  # a hold begins 1 ns late


@needs_compiler
def test_without_an_ignition_the_vehicle_remains_on_the_pad(tmp_path: Path) -> None:
    flight = sequenced(library(tmp_path, "(void)in; (void)out;"), "run.duration_s=2")
    assert [e.name for e in flight.events] == []
    assert flight.final["on_pad"] == 1.0
    assert flight.final["thrust_N"] == 0.0


@needs_compiler
@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("out->abort = in->tick == 49 ? 17 : 0;", "aborted the flight with abort = 17"),
        ("out->stage_separation = in->tick == 49;", "commanded stage_separation in stage 1: allowed is no separation"),
        ("out->throttle = in->tick == 49 ? 3.0 : 0.0;", "gave throttle: allowed is 0, or 0.1 to 1.2"),
        ("out->cutoff_delay_s = in->tick == 49 ? -1.0 : 0.0;", "gave cutoff_delay_s: not from 0 to 1000 s"),
        ("out->turn_thruster[1] = in->tick == 49 ? 2 : 0;", "gave turn_thruster = 2: allowed is -1, 0 or 1"),
    ],
)
def test_a_wrong_command_ends_the_flight_with_its_cause(tmp_path: Path, step: str, said: str) -> None:
    flight = sequenced(library(tmp_path, step), "run.duration_s=2")
    assert (flight.outcome, flight.cause, flight.end_s) == ("flight_software", said, 0.5)


# --- sensors for navigation

SENSORS = [
    "vehicle.gnss={station_m=2.5,offset_m=[0.3,-0.2],period_s=0.1,latency_s=0.04}",
    "vehicle.barometer={}",
    "vehicle.magnetometer={}",
]


def sensed(*more: str) -> Flight:
    return fly(load_scenario("nominal", ["run.duration_s=12", *IDEAL, *SENSORS, *more]))


@cache
def without_errors() -> Flight:
    return sensed()


def rotation(q: np.ndarray) -> np.ndarray:
    """Return rotation matrices (n, 3, 3) from B of quaternions (n, 4), scalar first."""
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def columns(flight: Flight, name: str, parts: str) -> np.ndarray:
    return np.stack([flight[name.format(part)] for part in parts], axis=1)


def true_antenna(flight: Flight, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity of the antenna of `SENSORS` in E at rows of the slow log."""
    rows = np.searchsorted(flight.time_s("r_I_x_m"), times - 1e-6)
    q, w = columns(flight, "q_BI_{}", "wxyz")[rows], columns(flight, "w_BI_B_{}_radps", "xyz")[rows]
    to_I, rate = rotation(q), 7.292115e-5
    arm = np.stack([flight["cg_station_m"][rows] - 2.5, np.full(len(rows), 0.3), np.full(len(rows), -0.2)], axis=1)
    r = columns(flight, "r_I_{}_m", "xyz")[rows] + np.einsum("nij,nj->ni", to_I, arm)
    v = columns(flight, "v_I_{}_mps", "xyz")[rows] + np.einsum("nij,nj->ni", to_I, np.cross(w, arm))
    v = v - np.cross([0.0, 0.0, rate], r)
    c, s = np.cos(rate * times), np.sin(rate * times)
    turned = [np.stack([c * x + s * y, c * y - s * x, z], axis=1) for x, y, z in (r.T, v.T)]
    return turned[0], turned[1]


def solutions(flight: Flight) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the times, positions and velocities of all GNSS solutions in a log, in E."""
    times, first = np.unique(flight["gnss_time_s"], return_index=True)
    keep = times > 0.0
    r, v = columns(flight, "gnss_r_E_{}_m", "xyz"), columns(flight, "gnss_v_E_{}_mps", "xyz")
    return times[keep], r[first][keep], v[first][keep]


def test_gnss_without_errors_is_the_motion_of_the_antenna() -> None:
    flight = without_errors()
    times, r, v = solutions(flight)
    assert len(times) >= 115
    true_r, true_v = true_antenna(flight, times)
    assert np.abs(r - true_r).max() < 1e-6
    assert np.abs(v - true_v).max() < 1e-8


def test_gnss_arrives_after_its_latency() -> None:
    flight = without_errors()
    now, valid = flight.time_s("gnss_time_s"), flight["gnss_time_s"]
    at = (np.abs(now % 0.1 - 0.05) < 0.0005) & (now > 0.2)
    assert np.allclose(valid[at], now[at] - 0.05, atol=1e-9)
    early = (np.abs(now % 0.1 - 0.03) < 0.0005) & (now > 0.3)
    assert np.allclose(valid[early], now[early] - 0.13, atol=1e-9)


@pytest.mark.parametrize("correlation_s", [0.0, 0.5])
def test_gnss_errors_have_their_standard_deviations(correlation_s: float) -> None:
    """Compare with a flight without errors; standard errors of 120 solutions, fewer if they are correlated."""
    noise = [
        "vehicle.gnss.position_noise_m=[2.0,3.0,6.0]",
        "vehicle.gnss.velocity_noise_mps=[0.1,0.2,0.3]",
        f"vehicle.gnss.correlation_s={correlation_s}",
    ]
    clean, noisy, again = without_errors(), sensed(*noise), sensed(*noise)
    wrong = [a - b for a, b in zip(solutions(noisy)[1:], solutions(clean)[1:], strict=True)]
    assert np.array_equal(noisy["gnss_r_E_x_m"], again["gnss_r_E_x_m"])
    assert noisy.state_hash == clean.state_hash  # sensors for flight code do not change the flight
    up = solutions(clean)[1] / np.linalg.norm(solutions(clean)[1], axis=1)[:, None]
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east, axis=1)[:, None]
    axes = np.stack([np.cross(up, east), east, -up], axis=1)  # geocentric: 0.2 deg from the geodetic axes
    kept = math.exp(-0.1 / correlation_s) if correlation_s else 0.0
    for error, sigmas in zip(wrong, ((2.0, 3.0, 6.0), (0.1, 0.2, 0.3)), strict=True):
        local = np.einsum("nij,nj->ni", axes, error) / np.array(sigmas)
        effective = len(local) * (1.0 - kept**2) / (1.0 + kept**2)
        assert np.abs(local.std(axis=0) - 1.0).max() < 4.0 / math.sqrt(2.0 * effective)
        lag = (local[1:] * local[:-1]).mean(axis=0) / (local**2).mean(axis=0)
        assert np.abs(lag - kept).max() < 4.0 / math.sqrt(len(local))
    other = sensed(*noise, "run.seed=99")
    assert not np.array_equal(noisy["gnss_r_E_x_m"], other["gnss_r_E_x_m"])


def test_the_barometer_measures_the_standard_atmosphere() -> None:
    """Compare with US 1976 below 11 km, bias and scale factor included."""
    flight = sensed("vehicle.barometer={bias_Pa=120.0,scale_factor=0.01}")
    at = flight.time_s("barometer_Pa")
    rows = (np.abs(at % 0.02) < 1e-6) & (at > 0.05)
    altitude = np.interp(at[rows], flight.time_s("altitude_m"), flight["altitude_m"])
    geopotential = 6356766.0 * altitude / (6356766.0 + altitude)
    pressure = 101325.0 * (1.0 - 0.0065 * geopotential / 288.15) ** (9.80665 * 0.0289644 / (8.31432 * 0.0065))
    assert np.abs(flight["barometer_Pa"][rows] - (1.01 * pressure + 120.0)).max() < 1.0


def test_the_magnetometer_measures_the_gradient_of_the_dipole() -> None:
    """Compare with the numerical gradient of the first-degree potential of IGRF-13 in spherical coordinates."""
    flight = without_errors()
    at = flight.time_s("r_I_x_m")
    measured = np.stack([np.interp(at, flight.time_s("gnss_time_s"), flight[f"magnetometer_{a}_nT"]) for a in "xyz"], 1)

    def potential(r: np.ndarray) -> float:
        radius = float(np.linalg.norm(r))
        theta, phi = math.acos(r[2] / radius), math.atan2(r[1], r[0])
        field = -29404.8 * math.cos(theta) + (-1450.9 * math.cos(phi) + 4652.5 * math.sin(phi)) * math.sin(theta)
        return 6371200.0 * (6371200.0 / radius) ** 2 * field

    for t in (2.0, 10.0):
        k = int(np.searchsorted(at, t - 1e-6))
        r = columns(flight, "r_E_{}_m", "xyz")[k]
        step = 10.0
        field = -np.array([potential(r + step * e) - potential(r - step * e) for e in np.eye(3)]) / (2.0 * step)
        angle = 7.292115e-5 * t
        inertial = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        body = rotation(columns(flight, "q_BI_{}", "wxyz")[k : k + 1])[0].T @ inertial @ field
        assert np.abs(measured[k] - body).max() < 0.5  # of 48,000 nT


# --- faults


def during(flight: Flight, name: str, begin_s: float, end_s: float) -> np.ndarray:
    at = flight.time_s(name)
    return flight[name][(at > begin_s + 0.011) & (at < end_s - 0.001)]


def test_faults_of_gnss() -> None:
    clean = without_errors()
    outage = sensed("fault=[{kind='gnss-outage',at_s=3.0,until_s=6.0}]")
    times = solutions(outage)[0]
    assert times[(times > 2.95) & (times < 6.05)].tolist() == [6.0]
    stuck = sensed("fault=[{kind='gnss-stuck',at_s=3.0,until_s=6.0}]")
    assert np.ptp(during(stuck, "gnss_r_E_x_m", 3.0, 6.0)) == 0.0
    assert np.ptp(during(stuck, "gnss_time_s", 3.0, 6.0)) > 2.5
    biased = sensed("fault=[{kind='gnss-bias',at_s=3.0,position_bias_m=[30.0,-40.0,120.0]}]")
    error = solutions(biased)[1] - solutions(clean)[1]
    assert np.abs(error[solutions(clean)[0] < 2.95]).max() == 0.0
    assert np.linalg.norm(error[-1]) == pytest.approx(130.0, abs=1e-6)
    assert biased.state_hash == clean.state_hash


def test_faults_of_barometer_and_magnetometer() -> None:
    clean = without_errors()
    biased = sensed(
        "fault=[{kind='barometer-bias',at_s=3.0,bias_Pa=500.0},{kind='magnetometer-bias',at_s=3.0,axis='y',bias_nT=70.0}]"
    )
    change = during(biased, "barometer_Pa", 3.0, 9.0) - during(clean, "barometer_Pa", 3.0, 9.0)
    assert np.allclose(change, 500.0)
    changes = [
        np.median(during(biased, f"magnetometer_{a}_nT", 3.0, 9.0) - during(clean, f"magnetometer_{a}_nT", 3.0, 9.0))
        for a in "xyz"
    ]
    assert np.allclose(changes, [0.0, 70.0, 0.0], atol=1e-6)
    off = sensed("fault=[{kind='barometer-dead',at_s=3.0},{kind='magnetometer-stuck',at_s=3.0}]")
    assert not during(off, "barometer_Pa", 3.0, 9.0).any()
    assert np.ptp(during(off, "magnetometer_x_nT", 3.0, 9.0)) == 0.0


@needs_compiler
def test_a_switch_that_is_stuck_hides_the_liftoff(tmp_path: Path) -> None:
    code = library(tmp_path, "out->ignition = 1; if (in->discretes & MAXQ_FSW_LIFTOFF) { return 5; }")
    assert sequenced(code, "run.duration_s=3").cause == "its step returned 5"
    stuck = "fault=[{kind='switch-stuck',switch='liftoff',at_s=0.0}]"
    assert sequenced(code, "run.duration_s=3", stuck).outcome == "duration"
    late = sequenced(code, "run.duration_s=3", stuck.replace("at_s=0.0", "at_s=0.0,until_s=2.0"))
    assert (late.cause, late.end_s) == ("its step returned 5", 2.0)


def test_python_code_commands_the_sequence(tmp_path: Path) -> None:
    """Ignite and cut off from Python, at the first tenth of the full chamber pressure."""
    (tmp_path / "code.py").write_text(
        "class Computer:\n"
        "    interface = 2\n"
        "    def __init__(self, setup):\n"
        "        assert setup.sequencing == 1 and setup.mu_m3ps2 > 3.9e14\n"
        "    def step(self, inputs):\n"
        "        burns = inputs.chamber_pressure[0] > 0.1\n"
        "        return {'ignition': int(inputs.tick == 9), 'cutoff': int(burns),\n"
        "                'monitor': [inputs.pressure_Pa] * 8}\n"
    )
    code = flies(python=tmp_path / "code.py:Computer", sequencing="flight-code")
    flight = fly(load_scenario("nominal", [*IDEAL, *code, "run.duration_s=2", "vehicle.barometer={}"]))
    computer = flight.scenario.vehicle.computer
    assert computer is not None
    assert flight.events[0].name == "ignition"
    assert flight.events[0].time_s == pytest.approx(0.1 + computer.delay_s, abs=1e-9)
    assert 0.1 < flight.event_s("burnout") < 1.0
    assert flight.final["thrust_N"] == 0.0
    assert flight.final["monitor_1"] == pytest.approx(flight.final["pressure_Pa"], rel=1e-9)


@needs_compiler
def test_code_of_version_1_cannot_command_the_sequence(tmp_path: Path) -> None:
    (tmp_path / "maxq_fsw.h").write_text(VERSION_1.read_text())
    (tmp_path / "pd.h").write_text((EXAMPLES / "pd.h").read_text())
    (tmp_path / "pd_law.c").write_text((EXAMPLES / "pd_law.c").read_text())
    old = compiled(tmp_path, tmp_path / "pd_law.c", "pd_law")
    with pytest.raises(ScenarioError, match=r"version 1 of maxq_fsw\.h: sequencing = 'flight-code' needs version 2"):
        sequenced(old)
    with pytest.raises(ScenarioError, match="the design commands no sequence"):
        load_scenario("nominal", ["vehicle.computer.sequencing=flight-code"])


# --- petrel

RECEIVERS = [f"vehicle.stage.{n}.accelerometer={{station_m=6.8,omega_hz=60.0,zeta=0.7}}" for n in range(3)] + [
    "vehicle.gnss={station_m=3.0}"
]
ANGLES = "-DLAW_COUNT_RAD=0.0"  # the law takes angles in place of pulses
ORBIT = "guidance.orbit={perigee_altitude_m=250e3,apogee_altitude_m=300e3,isp_s=343.0}"


@cache
def flight_computer() -> Path:
    """Return the reference flight computer with the law of petrel's first gains; compiled once for the session."""
    return copy_of("flight_computer", _compile) / "libflight_computer.so"


def _compile(out: Path) -> None:
    loaded = load_scenario(folder() / "scenario.toml")
    export_c(loaded, out / "law")
    law = [str(out / "law" / name) for name in ("flight_law.c", "flight_law_tables.c")]
    flags = [ANGLES, "-I", str(out / "law"), *law]
    compiled(out, EXAMPLES / "orbit" / "flight_computer.c", "flight_computer", *flags)


@pytest.mark.long
@needs_compiler
def test_the_flight_computer_behind_a_socket_flies_the_same_bits(tmp_path: Path) -> None:
    """Link it with computer.c, and fly the first stage in lock-step."""
    sources = [EXAMPLES / "orbit" / "flight_computer.c"]
    sources += [flight_computer().parent / "law" / name for name in ("flight_law.c", "flight_law_tables.c")]
    flags = [ANGLES, "-I", str(EXAMPLES / "orbit"), "-I", str(flight_computer().parent / "law"), *map(str, sources)]
    program = compiled(tmp_path, EXAMPLES / "computer.c", "computer", *flags, program=True)
    with subprocess.Popen([program, "tcp", "0"], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            there = flies(address=f"tcp://127.0.0.1:{process.stdout.readline().strip()}", interface=2)
            given = ["requirement=", ORBIT, *RECEIVERS, "vehicle.computer.sequencing=flight-code", *there]
            flight = fly(load_scenario(folder() / "scenario.toml", [*given, "run.duration_s=30"]), log=False)
        finally:
            process.kill()
    assert flight.state_hash == computer_flight("run.duration_s=30").state_hash


def python_flight(*more: str, log: bool = False) -> Flight:
    design = folder() / "design.toml"
    code = flies(
        python=f"{EXAMPLES}/orbit/flight_computer.py:Computer", sequencing="flight-code", data=design, settings=design
    )
    return fly(load_scenario(folder() / "scenario.toml", ["requirement=", ORBIT, *code, *RECEIVERS, *more]), log=log)


@pytest.mark.slow
@needs_compiler
def test_the_flight_computer_in_python_flies_as_that_in_c() -> None:
    """Compare the first 20 s, with the pitch-over, where both laws command the same angles."""
    flight = python_flight("run.duration_s=20", log=True)
    other = computer_flight("run.duration_s=20", log=True)
    assert np.abs(flight["gimbal_pitch_command_deg"] - other["gimbal_pitch_command_deg"]).max() < 0.02
    assert flight["altitude_m"][-1] == pytest.approx(other["altitude_m"][-1], abs=0.1)


def computer_flight(*more: str, log: bool = False) -> Flight:
    code = flies(library=flight_computer(), sequencing="flight-code")
    return fly(load_scenario(folder() / "scenario.toml", ["requirement=", ORBIT, *code, *RECEIVERS, *more]), log=log)


@pytest.mark.slow
@needs_compiler
def test_the_flight_computer_flies_petrel_from_pad_to_orbit() -> None:
    """Reach the orbit of the built-in guidance with GNSS errors, and repeat the flight bit for bit."""
    flight = computer_flight(log=True)
    metrics = flight.metrics
    names = "ignition liftoff burnout separation ignition separation burnout"
    assert [e.name for e in flight.events] == names.split()
    assert abs(metrics["cutoff_perigee_error_m"]) < 50.0
    assert abs(metrics["cutoff_apogee_error_m"]) < 200.0
    built_in = fly(load_scenario(folder() / "scenario.toml", ["requirement=", ORBIT]), log=False)
    assert flight.event_s("burnout") == pytest.approx(built_in.event_s("burnout"), abs=0.1)
    assert metrics["max_attitude_error_deg"] < 2.0
    navigated = np.stack([flight[f"monitor_{k}"] for k in (1, 2, 3)], axis=1)
    at, cut_off_s = flight.time_s("monitor_1"), flight.event_s("burnout")
    true = np.stack([np.interp(at, flight.time_s("r_I_x_m"), flight[f"r_I_{a}_m"]) for a in "xyz"], axis=1)
    sampled = np.abs(at % 0.02) < 1e-6
    late = sampled & (at > 200.0) & (at < cut_off_s)
    assert np.linalg.norm(navigated - true, axis=1)[late].max() < 20.0  # accelerometer to CG, and one GNSS lever arm
    assert computer_flight().state_hash == flight.state_hash


@pytest.mark.long
@needs_compiler
def test_the_flight_computer_in_python_reaches_the_orbit_of_that_in_c() -> None:
    """Fly both to orbit: their arithmetic differs in the last bits only, which Newton's method stops at 1e-3."""
    flight, other = python_flight(), computer_flight()
    assert [(e.name, pytest.approx(e.time_s, abs=1e-3)) for e in flight.events] == [
        (e.name, e.time_s) for e in other.events
    ]
    for name, most_m in (("cutoff_perigee_error_m", 50.0), ("cutoff_apogee_error_m", 200.0)):
        assert abs(flight.metrics[name]) < most_m
        assert flight.metrics[name] == pytest.approx(other.metrics[name], abs=1.0)


NOISY_GNSS = [
    "vehicle.gnss={station_m=3.0,period_s=0.1,latency_s=0.05,position_noise_m=[3.0,3.0,6.0],"
    "velocity_noise_mps=[0.05,0.05,0.1],correlation_s=1.0}"
]
NOISY = [*NOISY_GNSS, *(f"vehicle.stage.{n}.accelerometer.bias_mps2=[0.01,-0.005,0.005]" for n in range(3))]


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("seed", [1, 3])  # with 3, a faster estimate of the tilt loses GNSS
def test_gnss_errors_outage_and_false_positions_leave_an_orbit(seed: int) -> None:
    """Fly with noise and accelerometer bias, 60 s without GNSS, and 20 s of positions that are 3 km off."""
    faults = [
        "fault=[{kind='gnss-outage',at_s=150.0,until_s=210.0},"
        "{kind='gnss-bias',at_s=300.0,until_s=320.0,position_bias_m=[3000.0,0.0,0.0]}]"
    ]
    flight = computer_flight(*NOISY, *faults, f"run.seed={seed}")
    assert abs(flight.metrics["cutoff_perigee_error_m"]) < 50.0
    # GNSS noise leaves a random error of about 180 m, the RMS of 13 seeds; a lost GNSS, more than 5 km.
    assert abs(flight.metrics["cutoff_apogee_error_m"]) < 600.0
    assert flight.final["monitor_8"] == 200.0  # the rejected solutions are those of the false positions
    blind = computer_flight(*NOISY, "fault=[{kind='gnss-outage',at_s=0.0}]")
    assert abs(blind.metrics["cutoff_apogee_error_m"]) > 5000.0  # of the accelerometer's bias


@pytest.mark.long
@needs_compiler
def test_dispersed_flights_with_the_flight_computer_reach_the_orbit(tmp_path: Path) -> None:
    """Disperse thrust, wind and the accelerometer's bias, and fly a run again to the same bits."""
    keys = [f"vehicle.stage.{n}.accelerometer.bias_mps2.0" for n in range(3)]
    own = f"""
[[disperse]]
keys = {keys}
apply = "add"
distribution = "normal"
three_sigma = 0.02
source = "assumed"
"""
    campaign = folder() / "with_flight_code.toml"
    campaign.write_text((folder() / "campaign.toml").read_text() + own)
    code = flies(library=flight_computer(), sequencing="flight-code")
    words = [word for change in (ORBIT, *code, *NOISY_GNSS, *RECEIVERS[:3]) for word in ("--set", change)]
    out = tmp_path / "out"
    assert simrun.main([str(campaign), "--runs", "3", "--out", str(out), *words]) == 3  # undecided: no run has failed
    flown = maxq.read(out)
    assert isinstance(flown, DataSet)
    errors_m = np.ravel(flown.column("cutoff_apogee_error_m"))
    assert np.abs(errors_m).max() < 500.0
    assert len(set(errors_m)) == 3
    assert refly(out, 1, log=False).same


VERIFIED = """
schema = 2
scenario = "scenario.toml"
[margins]
times_s = [20.0, 126.0]
planes = ["pitch"]
cases = 0
corner_sigmas = 0.0
between_nodes = "ignore"
[margins.nominal]
gain_up_db = 3.0
[certificate]
times_s = [20.0]
planes = ["pitch"]
in_flight = false
[[flight]]
name = "ignition"
set = ["run.duration_s=5.0"]
[[campaign]]
file = "campaign.toml"
runs = 2
set = ["run.duration_s=2.0", "campaign.keep=[]"]
"""
CAMPAIGN = """
schema = 1
extends = "scenario.toml"
[campaign]
runs = 2
[[disperse]]
name = "thrust"
keys = ["vehicle.stage.0.engine.0.mass_flow_factor"]
apply = "scale"
distribution = "normal"
three_sigma = 0.03
source = "assumed"
"""


@pytest.mark.long
@needs_compiler
def test_code_that_commands_the_sequence_is_verified(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Margins of both stages, certificate, flight, campaign and a pack that agrees; the certificate has the margins."""
    code = flies(library=flight_computer(), sequencing="flight-code", timeout_s=60.0)
    given = [ORBIT, *code, *RECEIVERS, "run.duration_s=130"]
    (tmp_path / "scenario.toml").write_text(load_scenario(folder() / "scenario.toml", given).as_flown)
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    (tmp_path / "suite.toml").write_text(VERIFIED)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MAXQ_LEDGER", str(tmp_path / "ledger"))
    monkeypatch.setattr("maxq.design.verify.memory.default_folder", lambda: tmp_path / "memory")
    simverify.main([str(folder() / "design.toml"), "--suite", "suite.toml", "--out", "pack"])
    verdict = json.loads((tmp_path / "pack" / "verdict.json").read_text())
    found = {r["name"]: r["verdict"] for r in verdict["requirements"]}
    assert found["stable at every operating point, stage 2 (second)"] == found["ignition"] == "accepted"
    (point,) = verdict["certificate"]
    margins = [row for row in point["margins"] if row["what"] in ("gain_up", "gain_down")]
    assert [row["measured"] for row in margins] == pytest.approx([row["held"] for row in margins], abs=0.2)
    assert verdict["campaigns"][0]["runs"] == 2
    capsys.readouterr()
    assert simverify.main(["--check", "pack", "--sample", "0"]) == 0
    assert "DIFFERS" not in capsys.readouterr().out
