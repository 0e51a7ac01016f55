"""Several burns of one engine agree with Hohmann's transfer, Kepler's equation and SciPy.

| quantity | against |
|---|---|
| speed gained by each burn (rocket equation from the log's mass) | Hohmann's two impulses |
| coast | conserved energy and angular momentum; SciPy's DOP853 from cutoff to restart |
| instant of the restart | apogee found by SciPy; mean anomaly of a state made from it |
| propellant | thrust over exhaust speed times the time of both burns; no flow in the coast |
| operating points of each burn | the log's mass, thrust times arm over inertia, the response in flight |
| settling | a bob that swung in the coast hangs in line with the thrust |
"""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flightkit import Tree, load, merged, toml, with_stage
from scipy.integrate import solve_ivp

from maxq import Flight, LoadedScenario, ScenarioError
from maxq.control.burns import to_apogee_s
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array
from maxq.design import operating_points
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.held_flight import hold
from maxq.design.certificate.in_flight import in_flight_response
from maxq.design.model import powered
from maxq.design.model.node import at_same_propellant_s, node_of
from maxq.design.model.node_times import node_times
from maxq.design.model.powered import Span
from maxq.design.verify.uncovered import uncovered
from maxq.sim.run.flight import Event
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign, simverify

MU, RADIUS_m = 3.986004418e14, 6378137.0
LOW_m, HIGH_m = RADIUS_m + 300e3, RADIUS_m + 1000e3
THRUST_N, FLOW_kgps, ARM_s = 16000.0, 5.0, 14.0
EXHAUST_mps = THRUST_N / FLOW_kgps
STAGE: Tree = {
    "ignition_s": 1.0,
    "interpolation": "linear",
    "mass": {
        "table": {
            "time_s": [0.0, 1.0, 211.0],
            "mass_kg": [2000.0, 2000.0, 950.0],
            "x_cg_m": [2.0] * 3,
            "Ixx_kgm2": [200.0] * 3,
            "Iyy_kgm2": [1500.0] * 3,
            "Izz_kgm2": [1500.0] * 3,
        }
    },
    "engine": {
        "table": {"time_s": [0.0, 201.0, 201.01], "thrust_vacuum_N": [THRUST_N, THRUST_N, 0.0]},
        "gimbal_station_m": 4.0,
        "exit_station_m": 5.0,
    },
    "roll_thrusters": {"torque_Nm": 20.0, "pitch_yaw_torque_Nm": 40.0},
}
TREE: Tree = {
    "schema": 1,
    "vehicle": {
        "reference": {"length_m": 5.0, "diameter_m": 1.0, "area_m2": 0.785},
        "stage": [STAGE],
        "computer": {
            "sample_s": 0.01,
            "delay_s": 0.0,
            "count_rad": 0.0,
            "angle_error_limit_deg": 20.0,
            "command_limit_deg": 6.0,
        },
    },
    "design": {
        "law": "pd",
        "gains": {"table": {"time_s": [0.0], "k_p": [1.0], "k_d_s": [1.0]}},
        "filter": {"structure": "none"},
        "roll": {"k_rate_s": 2.0, "dead_band_deg": 0.5, "hysteresis_deg": 0.1, "minimum_on_s": 0.02},
    },
    "run": {"duration_s": 3000.0, "step_s": 0.01, "stop_at": []},
    "earth": {
        "shape": "sphere",
        "sphere_radius_m": RADIUS_m,
        "gravity": "inverse_square",
        "mu_m3ps2": MU,
        "rotating": False,
    },
    "atmosphere": {"model": "vacuum"},
    "initial": {
        "inertial_m": [LOW_m, 0.0, 0.0],
        "inertial_mps": [0.0, math.sqrt(MU / LOW_m), 0.0],
        "dcm_BI": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]],
        "rate_BI_degps": [0.0, 0.0, 0.0],
    },
    "guidance": {
        "cutoff": {"apogee_altitude_m": 1000e3},
        "restart": [
            {
                "before_apogee_s": ARM_s,
                "orbit": {"perigee_altitude_m": 1000e3, "apogee_altitude_m": 1000e3, "isp_s": EXHAUST_mps / 9.80665},
            }
        ],
    },
    "log": {"fast_hz": 1.0, "slow_hz": 1.0, "transform_hz": 1.0},
}


@cache
def flight() -> Flight:
    return fly(load(TREE))


def states(flown: Flight) -> Array:
    names = [f"{of}_{axis}_{unit}" for of, unit in (("r_I", "m"), ("v_I", "mps")) for axis in "xyz"]
    return np.stack([flown[name] for name in names], axis=1)


def coasting(flown: Flight) -> Array:
    t = flown.time_s("mass_kg")
    return (t > flown.event_s("cutoff")) & (t < flown.event_s("restart"))


def kepler(_: float, y: Array) -> Array:
    return np.concatenate([y[3:], -MU / np.linalg.norm(y[:3]) ** 3 * y[:3]])


@pytest.mark.slow
def test_two_burns_are_hohmanns_transfer() -> None:
    """A burn over the angle a from the apsis loses at most a^2 / 6 of its impulse; 24 s are 0.028 rad."""
    flown, axis_m = flight(), 0.5 * (LOW_m + HIGH_m)
    ends = (math.sqrt(MU / LOW_m), math.sqrt(MU * (2.0 / LOW_m - 1.0 / axis_m)))
    high = (math.sqrt(MU * (2.0 / HIGH_m - 1.0 / axis_m)), math.sqrt(MU / HIGH_m))
    mass = flown["mass_kg"]
    between_kg = mass[coasting(flown)][0]
    gained = EXHAUST_mps * math.log(mass[0] / between_kg), EXHAUST_mps * math.log(between_kg / mass[-1])
    assert gained[0] == pytest.approx(ends[1] - ends[0], rel=2e-3)
    assert gained[1] == pytest.approx(high[1] - high[0], rel=2e-3)
    assert not flown.failures
    assert flown.metrics["perigee_altitude_m"] == pytest.approx(1000e3, abs=300.0)
    assert flown.metrics["apogee_altitude_m"] == pytest.approx(1000e3, abs=300.0)
    assert flown.metrics["cutoff_perigee_error_m"] == pytest.approx(
        abs(flown.metrics["perigee_altitude_m"] - 1000e3), abs=1.0
    )


@pytest.mark.slow
def test_the_coast_conserves_energy_and_ends_before_the_apogee() -> None:
    flown = flight()
    y = states(flown)[coasting(flown)]
    r, v = y[:, :3], y[:, 3:]
    energy = 0.5 * (v * v).sum(axis=1) - MU / np.linalg.norm(r, axis=1)
    momentum = np.cross(r, v)
    assert np.ptp(energy) < 1e-9 * abs(energy[0])
    assert np.ptp(momentum[:, 2]) < 1e-9 * abs(momentum[0, 2])
    t = flown.time_s("mass_kg")[coasting(flown)]

    def apogee(_, y):
        return y[:3] @ y[3:]

    apogee.terminal, apogee.direction = True, -1.0
    found = solve_ivp(kepler, (t[0], 4000.0), y[0], method="DOP853", rtol=1e-12, atol=1e-6, events=apogee, t_eval=t)
    assert np.abs(found.y.T - y).max() < 0.02
    assert found.t_events[0][0] - flown.event_s("restart") == pytest.approx(ARM_s, abs=2e-3)
    assert np.linalg.norm(found.y_events[0][0][:3]) == pytest.approx(HIGH_m, abs=20.0)  # the first burn's cutoff


@pytest.mark.slow
def test_propellant_leaves_in_the_burns_only_and_thrusters_turn_the_vehicle() -> None:
    flown = flight()
    mass, coast = flown["mass_kg"], coasting(flown)
    assert np.ptp(mass[coast]) == 0.0
    assert not flown["mass_flow_kgps"][coast].any()
    first_s = flown.event_s("cutoff") - flown.event_s("ignition")
    second_s = flown.event_s("burnout") - flown.event_s("restart")
    assert mass[0] - mass[-1] == pytest.approx(FLOW_kgps * (first_s + second_s), abs=1e-6)
    assert [e.name for e in flown.events if e.name != "apogee"] == ["ignition", "cutoff", "restart", "burnout"]
    y = states(flown)[coast][-1]  # half a revolution later the vehicle still points along its motion
    forward = np.cross(np.cross(y[:3], y[3:]), y[:3])
    q = [flown[f"q_BI_{part}"][coast][-1] for part in "wxyz"]
    nose = np.array(
        [1.0 - 2.0 * (q[2] ** 2 + q[3] ** 2), 2.0 * (q[1] * q[2] + q[0] * q[3]), 2.0 * (q[1] * q[3] - q[0] * q[2])]
    )
    off_deg = math.degrees(math.acos(nose @ forward / np.linalg.norm(forward)))
    assert off_deg < 1.0  # dead band of 0.5 deg in pitch and in yaw
    assert y[:3] @ [1.0, 0.0, 0.0] < -0.9 * HIGH_m


def test_time_to_apogee_is_keplers() -> None:
    solve, axis_m, eccentricity = from_python(to_apogee_s), 8.0e6, 0.1
    period_s = 2.0 * math.pi * math.sqrt(axis_m**3 / MU)
    for anomaly in (-3.0, -1.0, 0.0, 0.5, 2.0, 3.0):
        x = axis_m * (math.cos(anomaly) - eccentricity), axis_m * math.sqrt(1 - eccentricity**2) * math.sin(anomaly)
        rate = math.sqrt(MU / axis_m**3) / (1.0 - eccentricity * math.cos(anomaly))
        v = -axis_m * rate * math.sin(anomaly), axis_m * rate * math.sqrt(1 - eccentricity**2) * math.cos(anomaly)
        mean = anomaly - eccentricity * math.sin(anomaly)
        left_s = (math.pi - mean) / (2.0 * math.pi) * period_s
        assert solve(MU, (*x, 0.0), (*v, 0.0)) == pytest.approx(left_s, rel=1e-12)
    assert solve(MU, (7e6, 0.0, 0.0), (0.0, 12e3, 0.0)) == math.inf


TANK: Tree = {
    "table": {
        "time_s": [0.0, 300.0],
        "slosh_mass_kg": [200.0, 200.0],
        "pendulum_length_m": [0.4, 0.4],
        "hinge_station_m": [1.5, 1.5],
    },
    "damping_ratio": 0.1,
}


def settled_deg(settling_s: float) -> float:
    """Return the largest bob angle in the second burn, after a coast in which the vehicle turned by 45 deg."""
    coast: dict[str, Any] = {"coast_s": 100.0, "settling_s": settling_s, "settling_thrust_N": 400.0}
    last = {"cutoff": {"inertial_speed_mps": 7900.0}}
    k = math.sqrt(0.5)
    turned = {"dcm_BI": [[k, k, 0.0], [0.0, 0.0, 1.0], [k, -k, 0.0]]}
    tree = merged(TREE, {"run": {"duration_s": 130.0}, "guidance": {"restart": [coast | last]}})
    tree["guidance"]["cutoff"] = {"inertial_speed_mps": 7760.0}
    tree["initial"] = {k: v for k, v in tree["initial"].items() if k != "dcm_BI"} | turned
    flown = fly(load(with_stage(tree, tank=[TANK])))
    t = flown.time_s("slosh_1_yaw_deg")
    angles = np.hypot(flown["slosh_1_yaw_deg"], flown["slosh_1_pitch_deg"])
    return float(angles[t >= flown.event_s("restart")][0])


@pytest.mark.slow
def test_settling_thrust_brings_the_liquid_aft() -> None:
    """Under 0.2 m/s2, a pendulum of 0.4 m has a period of 9 s and decays by exp(-0.1 0.71 80) = 0.003 in 80 s."""
    assert settled_deg(80.0) < 1.0
    assert settled_deg(0.0) > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("coast_s", [9.99, 10.0, 10.03, 10.07])
def test_a_restart_at_the_instant_of_a_sample_happens_once(coast_s: float) -> None:
    """The first cutoff is due at the ignition, on a sample; rounding moves the restart across another sample."""
    last = {"coast_s": coast_s, "cutoff": {"inertial_speed_mps": 7760.0}}
    ends = {"cutoff": {"inertial_speed_mps": 7000.0}, "restart": [last]}
    flown = fly(load(merged({**TREE, "guidance": ends}, {"run": {"duration_s": 20.0}})), log=False)
    assert [e.name for e in flown.events if e.name != "apogee"] == ["ignition", "cutoff", "restart", "burnout"]
    assert flown.event_s("restart") - flown.event_s("cutoff") == pytest.approx(coast_s, abs=3e-9)
    burned_s = flown.event_s("burnout") - flown.event_s("restart")
    gained = EXHAUST_mps * math.log(2000.0 / (2000.0 - FLOW_kgps * burned_s))
    assert gained == pytest.approx(7760.0 - math.sqrt(MU / LOW_m), abs=0.2)  # nearly along the motion
    assert flown.metrics["cutoff_speed_error_mps"] < 1e-4
    assert not flown.failures


def dropping(drop_s: float, guidance: Tree) -> Flight:
    """Fly 20 s with a part that is dropped while the engine stays."""
    rest = STAGE | {"continues": True, "clock": "preceding"}
    vehicle = TREE["vehicle"] | {"stage": [STAGE | {"separation_s": drop_s}, rest]}
    run = {"duration_s": 20.0, "step_s": 0.01, "stop_at": []}
    return fly(load({**TREE, "vehicle": vehicle, "guidance": guidance, "run": run}), log=False)


def test_a_part_dropped_after_a_cutoff_leaves_its_time_and_errors() -> None:
    """The dropped part has no mass, so that cutoff and restart are those of a flight without the drop."""
    ends = {"cutoff": {"inertial_speed_mps": 7740.0}}
    flown = dropping(8.0, ends)
    assert [(e.name, e.stage) for e in flown.events if e.name in ("cutoff", "burnout")] == [("burnout", 1)]
    assert flown.metric_times_s["cutoff_speed_mps"] == flown.event_s("burnout") < 3.0
    assert flown.metrics["cutoff_speed_error_mps"] < 1e-5
    again = ends | {"restart": [{"coast_s": 10.0, "cutoff": {"inertial_speed_mps": 7760.0}}]}
    flown = dropping(8.0, again)
    kinds = "cutoff", "separation", "restart", "burnout"
    found = [(e.name, e.stage) for e in flown.events if e.name in kinds]
    assert found == [("cutoff", 1), ("separation", 1), ("restart", 2), ("burnout", 2)]
    assert flown.event_s("restart") - flown.event_s("cutoff") == pytest.approx(10.0, abs=3e-9)
    assert flown.metrics["cutoff_speed_error_mps"] < 1e-4


def test_a_flight_may_end_between_the_command_of_a_cutoff_and_the_cutoff() -> None:
    ends = {"guidance": {"cutoff": {"inertial_speed_mps": 7740.0}}, "run": {"stop_at": []}}
    cut_off_s = fly(load(merged({**TREE, **ends}, {"run": {"duration_s": 4.0}})), log=False).event_s("burnout")
    short = merged({**TREE, **ends}, {"run": {"duration_s": math.floor(1e3 * cut_off_s) / 1e3}})
    flown = fly(load(short), log=False)
    assert [e.name for e in flown.events if e.name != "apogee"] == ["ignition"]
    assert math.isnan(flown.metrics["cutoff_speed_error_mps"])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"guidance": {"restart": [{"coast_s": 10.0}] * 4}}, "restart"),
        ({"guidance": {"restart": [{"coast_s": 10.0}, {"coast_s": 5.0}]}}, "another burn follows"),
        ({"guidance": {"restart": [{}]}}, "when it begins"),
        ({"guidance": {"restart": [{"coast_s": 10.0, "before_apogee_s": 5.0}]}}, "before_apogee_s"),
        ({"guidance": {"cutoff": {}}}, "names no quantity"),
        ({"guidance": {"cutoff": {"earth_speed_mps": 7e3}}}, "apogee_altitude_m"),
        ({"design": {"roll": None}}, "nothing switches the thrusters"),
        ({"vehicle": {"stage": [STAGE | {"roll_thrusters": {"torque_Nm": 20.0}}]}}, "pitch_yaw_torque_Nm"),
        ({"earth": {"gravity": "uniform"}}, "there are no orbits"),
    ],
)
def test_burns_that_cannot_be(changes: Tree, said: str) -> None:
    tree = merged(TREE, changes)
    if tree["design"].get("roll") is None:
        del tree["design"]["roll"]
    if said == "names no quantity":
        tree["guidance"]["cutoff"] = {}
    with pytest.raises(ScenarioError, match=said):
        load(tree)


def test_settling_thrust_counts_as_an_axial_load() -> None:
    """Settling by 20 kN, on the mass left by the first burn, exceeds the 16 kN of the second burn as an axial load."""
    push = {"coast_s": 5.0, "settling_s": 3.0, "settling_thrust_N": 20000.0, "cutoff": {"inertial_speed_mps": 9000.0}}
    ends = {"cutoff": {"inertial_speed_mps": 7760.0}, "restart": [push]}
    tree = merged({**TREE, "guidance": ends}, {"run": {"duration_s": 40.0}})
    flown = fly(load(tree))
    kg = flown["mass_kg"][coasting(flown)][0]
    at_s = flown.metric_times_s["max_axial_load_g"]
    assert flown.event_s("cutoff") < at_s < flown.event_s("restart")
    assert flown.metrics["max_axial_load_g"] == pytest.approx(20000.0 / kg / 9.80665, rel=1e-9)


def test_no_cutoff_is_commanded_after_the_propellant_is_exhausted() -> None:
    """Falling towards the Earth, the vehicle passes the speed that the burn did not reach, and nothing is commanded."""
    push = {"coast_s": 50.0, "settling_s": 49.0, "settling_thrust_N": 900.0, "cutoff": {"inertial_speed_mps": 9000.0}}
    low = {"inertial_mps": [1500.0, 3000.0, 0.0]}
    tree = merged({**TREE, "guidance": {"restart": [push]}}, {"run": {"duration_s": 700.0}, "initial": low})
    tree["guidance"]["cutoff"] = {"inertial_speed_mps": 5200.0}
    flown = fly(load(tree))
    speed = np.linalg.norm(states(flown)[:, 3:], axis=1)
    end = flown.time_s("mass_kg") > flown.event_s("burnout") + 1.0
    assert speed[end][0] < 5200.0 < speed[end].max()
    assert [e.name for e in flown.events if e.name != "apogee"] == ["ignition", "burnout"]
    still = flown["specific_force_B_x_mps2"][flown.time_s("specific_force_B_x_mps2") > flown.event_s("burnout") + 1.0]
    assert np.abs(still).max() < 1e-9


AGAIN: Tree = merged(
    TREE | {"guidance": {}},
    {
        "run": {"duration_s": 60.0},
        "log": {"slow_hz": 100.0},
        "vehicle": {"computer": {"delay_s": 0.003}},
        "design": {"gains": {"table": {"mass_kg": [1000.0], "k_p": [1.0], "k_d_s": [1.0]}}},
        "guidance": {
            "cutoff": {"inertial_speed_mps": 7800.0},
            "restart": [{"coast_s": 20.0, "cutoff": {"inertial_speed_mps": 7900.0}}],
        },
    },
)
del AGAIN["design"]["gains"]["table"]["time_s"]


@cache
def again() -> LoadedScenario:
    return load(AGAIN)


def burned_kg(time_s: float) -> float:
    """Return the propellant that a log of the flight without operating points shows as burned."""
    flown = fly(again())
    return 2000.0 - float(np.interp(time_s, flown.time_s("mass_kg"), flown["mass_kg"]))


def test_each_burn_is_a_powered_span() -> None:
    flown, (spans, loss) = fly(again(), log=False), powered.powered_flight(again())
    assert loss is None
    ends = [[flown.event_s("ignition"), flown.event_s("cutoff")], [flown.event_s("restart"), flown.event_s("burnout")]]
    assert [[span.begin_s, span.end_s] for span in spans] == ends
    assert [span.stage for span in spans] == [0, 0]
    assert [span.idle_s for span in spans] == pytest.approx([0.0, 20.0], abs=1e-8)


def test_spans_of_a_part_dropped_in_the_coast() -> None:
    """The second stage begins with a restart, and its tables stood still for the 10 s of the coast."""
    named = (
        ("ignition", 1.0, 1),
        ("cutoff", 5.0, 1),
        ("separation", 8.0, 1),
        ("restart", 15.0, 2),
        ("burnout", 20.0, 2),
    )
    events = [Event(name, round(1e9 * at_s), stage) for name, at_s, stage in named]
    assert powered.spans_of(events, 2, 30.0) == (Span(0, 1.0, 5.0), Span(1, 15.0, 20.0, 10.0))
    assert powered.spans_of(events[:4], 2, 17.0) == (Span(0, 1.0, 5.0), Span(1, 15.0, 17.0, 10.0))


def test_operating_points_are_in_each_burn() -> None:
    spans, times_s = powered.powered_spans(again()), node_times(again(), 4)
    inside = [[t for t in times_s if span.holds(t)] for span in spans]
    assert [len(mine) for mine in inside] == [4, 4]
    nodes = operating_points.nodes(again(), times_s)
    for node, held in ((node, hold(again(), node).node) for node in nodes):
        kg = 2000.0 - burned_kg(node.time_s)
        assert node.vehicle.total_mass_kg == pytest.approx(kg, abs=1e-3)
        assert held.vehicle.total_mass_kg == pytest.approx(kg, abs=1e-3)
        assert node.scheduled("mass_kg") == node.vehicle.total_mass_kg
        assert node.derivatives.m_delta_1ps2 == pytest.approx(THRUST_N * 2.0 / 1500.0, rel=1e-9)
        assert node.axial_load_mps2 == pytest.approx(THRUST_N / kg, rel=1e-6)
    with pytest.raises(ValueError, match="the engine does not burn"):
        operating_points.nodes(again(), [0.5 * (spans[0].end_s + spans[1].begin_s)])


def test_only_the_ends_of_each_burn_are_uncovered() -> None:
    spans, times_s = powered.powered_spans(again()), node_times(again(), 4)
    ends = [(spans[0].begin_s, times_s[0]), (times_s[3], spans[0].end_s)]
    ends += [(spans[1].begin_s, times_s[4]), (times_s[7], spans[1].end_s)]
    assert [(one.begin_s, one.end_s) for one in uncovered(again(), {0: times_s})] == ends
    bare = [one for one in uncovered(again(), {0: times_s[:4]}) if one.begin_s > times_s[4] - 1.0]
    assert [(one.begin_s, one.end_s, one.why) for one in bare] == [
        (spans[1].begin_s, spans[1].end_s, "under thrust, no operating point")
    ]


def test_a_dispersed_flight_has_the_same_propellant_after_a_longer_coast() -> None:
    """With 2 % less flow, every second of the engine burns 4.9 kg."""
    longer = merged(AGAIN, {"vehicle": {}})
    longer["guidance"] = AGAIN["guidance"] | {"restart": [AGAIN["guidance"]["restart"][0] | {"coast_s": 23.0}]}
    longer["vehicle"] = longer["vehicle"] | {"stage": [merged(STAGE, {"engine": {"mass_flow_factor": 0.98}})]}
    (node,) = operating_points.nodes(again(), [node_times(again(), 4)[5]])
    run = powered.flown_run(load(longer), faults=False)
    at_s = at_same_propellant_s(run, again().scenario, node)
    powered.flown_to(run, at_s)
    there = node_of(run.packed, run.now_s, 0)
    assert there.stage_start_s == pytest.approx(23.0, abs=1e-8)
    assert there.vehicle.total_mass_kg == pytest.approx(node.vehicle.total_mass_kg, abs=0.03)  # within half a step
    assert (at_s - 23.0 - 1.0) * 0.98 == pytest.approx(node.time_s - node.stage_start_s - 1.0, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.003, 0.0])
def test_the_loop_of_a_second_burn_is_measured_in_flight(delay_s: float) -> None:
    """Without a delay, the command of a tick is in the log row of the tick itself."""
    scenario = load(merged(AGAIN, {"vehicle": {"computer": {"delay_s": delay_s}}}))
    span = powered.powered_spans(scenario)[1]
    (found,) = in_flight_response(scenario, [round(0.5 * (span.begin_s + span.end_s), 2)], "pitch")
    assert set(found.reason) == {""}
    assert np.abs(found.difference_db).max() < 0.3
    assert np.abs(found.difference_deg).max() < 1.0
    (node,) = operating_points.nodes(scenario, [found.time_s])
    certificate = certify_node(scenario, node, names=("gain_down",))
    assert certificate.stable
    assert certificate.unexplained == ()


@pytest.mark.long
def test_a_design_holds_its_limits_in_each_burn(tmp_path: Path) -> None:
    """Gains over mass from one burn to the next; no limit is evaluated in the coast, where no engine burns."""
    text = "\n".join(f"{key} = {toml(value)}" for key, value in AGAIN.items())
    (tmp_path / "scenario.toml").write_text(text)
    (tmp_path / "case.toml").write_text(CASE)
    assert simdesign.main([str(tmp_path / "case.toml"), "--out", str(tmp_path / "made"), "--no-pictures"]) == 0
    found = json.loads((tmp_path / "made" / "design.json").read_text())
    assert found["feasible"]
    spans = powered.powered_spans(load_scenario(tmp_path / "scenario.toml"))
    times_s = found["case"]["nodes_s"]
    assert [sum(span.holds(t) for t in times_s) for span in spans] == [3, 3]
    assert found["search"]["instants"] == pytest.approx(4.0 * sum(span.end_s - span.begin_s for span in spans), abs=2.0)
    ends_kg = [2000.0 - FLOW_kgps * (times_s[k] - spans[k].idle_s - 1.0) for k in (-1, 0)]
    assert found["gains"]["mass_kg"] == pytest.approx(ends_kg, abs=0.03)  # operating points are at steps
    k_p = (0.3 * 2.0 * math.pi) ** 2 / (THRUST_N * 2.0 / 1500.0)
    assert found["gains"]["k_p"] == pytest.approx([k_p, k_p], rel=1e-6)
    made = str(tmp_path / "made")
    judged = ["analyse", made, "--scenario", str(tmp_path / "scenario.toml"), "--out", str(tmp_path / "judged")]
    assert simdesign.main([*judged, "--no-pictures"]) == 0
    (tmp_path / "suite.toml").write_text(SUITE)
    given = [made, "--suite", str(tmp_path / "suite.toml"), "--out", str(tmp_path / "verdict"), "--no-pack"]
    assert simverify.main(given) == 0
    verdict = json.loads((tmp_path / "verdict" / "verdict.json").read_text())
    assert verdict["verdict"] == "passed screening"
    of = {requirement["name"]: requirement["found"] for requirement in verdict["requirements"]}
    assert of["flight and linear loop agree, pitch"] == "2 of 2 operating points"
    assert of["in-flight response, pitch"] == "18 of 18 lines"  # nine in each burn
    missing = [text for text in verdict["missing_evidence"] if "margins: no operating point" in text]
    assert missing == []


CASE = """
schema = 2
scenario = "scenario.toml"
nodes_per_stage = 3
gains = {schedule = "linear", over = "mass_kg"}
objective = {kind = "least-margin"}
filter = {structure = "F2"}
search = {starts = 1, leaps = 0}
[limits]
rigid_body = "aerodynamic"
rigid_hz = 0.3
rigid_zeta = 0.5
without = ["second_mode_db"]
"""
SUITE = """
schema = 2
description = "two burns"
scenario = "scenario.toml"
[margins]
nodes_per_stage = 8
planes = ["pitch"]
cases = 0
nominal = {gain_up_db = 6.0}
dispersed = {gain_up_db = 3.0}
worst = {modulus = 0.25, starts = 1}
[certificate]
nodes_per_stage = 1
planes = ["pitch"]
[[flight]]
name = "nominal"
"""
