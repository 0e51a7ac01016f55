"""Cutoffs at a speed or an apogee, the launch rail and the clearance to a tower agree with closed forms.

Flat or spherical Earths without air, constant thrust. The instant of a cutoff is extrapolated over at most 1.5 samples
of 10 ms, hence the error of a quantity q is at most 1.5^2 samples^2 q'' / 2.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from flightkit import Tree, load, merged
from scipy.optimize import minimize

from maxq import Flight, ScenarioError
from maxq.control.kernel.jit import from_python
from maxq.sim.flight.launch import between
from maxq.sim.run.fly import fly

MASS_kg, FLOW_kgps, THRUST_N, G = 1000.0, 4.0, 20000.0, 9.80665
MU = 3.986004418e14
SAMPLE_S = 0.01
TREE: Tree = {
    "schema": 1,
    "vehicle": {
        "reference": {"length_m": 6.0, "diameter_m": 1.0, "area_m2": 0.785},
        "stage": [
            {
                "interpolation": "linear",
                "mass": {
                    "table": {
                        "time_s": [0.0, 160.0],
                        "mass_kg": [MASS_kg, MASS_kg - 160.0 * FLOW_kgps],
                        "x_cg_m": [2.5] * 2,
                        "Ixx_kgm2": [200.0] * 2,
                        "Iyy_kgm2": [1500.0] * 2,
                        "Izz_kgm2": [1500.0] * 2,
                    }
                },
                "engine": {
                    "table": {"time_s": [0.0, 150.0, 150.01], "thrust_vacuum_N": [THRUST_N, THRUST_N, 0.0]},
                    "gimbal_station_m": 5.0,
                    "exit_station_m": 6.0,
                },
            }
        ],
    },
    "run": {"duration_s": 60.0, "step_s": SAMPLE_S, "stop_at": ["burnout"]},
    "earth": {"shape": "flat", "rotating": False, "gravity": "uniform", "uniform_mps2": G},
    "atmosphere": {"model": "vacuum"},
    "log": {"fast_hz": 100.0, "slow_hz": 100.0, "transform_hz": 10.0},
}
CONSTANT: Tree = merged(
    TREE["vehicle"]["stage"][0],
    {
        "mass": {"mass_kg": MASS_kg, "x_cg_m": 2.5, "inertia_kgm2": np.diag([200.0, 1500.0, 1500.0])},
        "engine": {"table": {"time_s": [0.0], "thrust_vacuum_N": [THRUST_N]}},
    },
)
del CONSTANT["mass"]["table"]


ACCEL = THRUST_N / MASS_kg
SPACE: Tree = merged(
    TREE,
    {
        "earth": {"gravity": "none"},
        "vehicle": {"stage": [CONSTANT]},
        "run": {"duration_s": 60.0, "step_s": 0.002, "stop_at": []},
    },
)
del SPACE["earth"]["uniform_mps2"]


def in_space(speed_mps: float, more: Tree, **stage: object) -> Flight:
    """Return a flight north from 100 m/s without gravity, with thrust along it up to an inertial speed."""
    changes: Tree = {
        "initial": {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [100.0, 0.0, 0.0]},
        "guidance": {"cutoff": {"inertial_speed_mps": speed_mps}},
        "vehicle": {"stage": [CONSTANT | stage]},
    }
    return fly(load(merged(SPACE, changes | more)))


def flown(changes: Tree) -> Flight:
    return fly(load(merged(TREE, changes)))


def constant(changes: Tree) -> Tree:
    return merged({"vehicle": {"stage": [CONSTANT]}, "run": {"duration_s": 4.0, "stop_at": []}}, changes)


def test_cutoff_at_a_speed_is_that_of_the_rocket_equation() -> None:
    exhaust, wanted = THRUST_N / FLOW_kgps, 400.0
    flight = flown({"guidance": {"cutoff": {"earth_speed_mps": wanted}}})
    at_s = flight.event_s("burnout")
    gained = exhaust * math.log(MASS_kg / (MASS_kg - FLOW_kgps * at_s)) - G * at_s
    jerk = THRUST_N * FLOW_kgps / (MASS_kg - FLOW_kgps * at_s) ** 2
    assert 25.0 < at_s < 45.0
    assert gained == pytest.approx(wanted, abs=1.5**2 * SAMPLE_S**2 * jerk)
    assert flight.metrics["cutoff_speed_error_mps"] == pytest.approx(abs(gained - wanted), abs=1e-7)
    assert not flight.failures
    late = flown({"guidance": {"cutoff": {"earth_speed_mps": 9e3}}, "run": {"duration_s": 151.0}})
    assert late.failures == ("the engine burned out before the cutoff",)


def test_inertial_speed_includes_the_rotation_and_apogee_is_where_the_flight_turns() -> None:
    round_: Tree = {
        "earth": {"shape": "wgs84", "rotating": True, "gravity": "inverse_square"},
        "site": {"latitude_deg": 0.0},
    }
    del round_["site"]
    tree = merged(TREE, {"guidance": {"cutoff": {"inertial_speed_mps": 700.0}}})
    tree["earth"] = round_["earth"]
    flight = fly(load(tree))
    assert flight.metrics["cutoff_inertial_speed_mps"] == pytest.approx(700.0, abs=1e-4)
    ground = 7.292115e-5 * (6378137.0 + flight.metrics["cutoff_altitude_m"])
    over = flight.metrics["cutoff_speed_mps"]
    assert over == pytest.approx(math.sqrt(700.0**2 - ground**2), rel=0.02)  # nearly vertical: Coriolis turns it
    tree["guidance"] = {"cutoff": {"apogee_altitude_m": 40e3}}
    tree["run"] = {"duration_s": 300.0, "step_s": SAMPLE_S, "stop_at": ["apogee"]}
    flight = fly(load(tree))
    assert flight.outcome == "apogee"
    assert flight.metrics["cutoff_apogee_error_m"] < 0.5
    assert flight.metrics["max_altitude_m"] == pytest.approx(40e3, abs=2.0)


@pytest.mark.parametrize("factor", [0.0, 1.0, 1.5])
def test_thrust_decays_after_a_cutoff_that_allows_for_it(factor: float) -> None:
    """A cutoff that allows for a decay of 2 s, which gives half of its impulse, is 1 s before that of full thrust."""
    flight = in_space(500.0, {}, cutoff_decay_s=2.0, cutoff_decay_factor=factor)
    cutoff_s = 400.0 / ACCEL - 1.0
    assert flight.event_s("burnout") == pytest.approx(cutoff_s + 2.0 * factor, abs=1e-8)
    assert flight.metrics["cutoff_inertial_speed_mps"] == pytest.approx(500.0 + ACCEL * (factor - 1.0), abs=1e-6)
    t, speed = flight.time_s("v_I_x_mps"), flight["v_I_x_mps"]
    decays = 2.0 * factor
    into = np.clip(t - cutoff_s, 0.0, max(decays, 1e-9))
    wanted = 100.0 + ACCEL * (np.minimum(t, cutoff_s) + into - into**2 / (2.0 * max(decays, 1e-9)))
    np.testing.assert_allclose(speed, wanted, atol=1e-6)


def test_apogee_after_a_decay_is_the_one_that_was_wanted() -> None:
    """The flight begins level at 200 km, with 8 m/s2 along it; Kepler's apogee is that at the end of 2 s of decay.

    A sample of 10 ms in which the acceleration grows by 6e-5 m/s2 leaves less than 0.1 m/s2 of its second difference.
    """
    radius = 6378137.0
    tree = merged(
        SPACE, {"run": {"duration_s": 60.0, "step_s": SAMPLE_S}, "guidance": {"cutoff": {"apogee_altitude_m": 600e3}}}
    )
    tree["earth"] = {"shape": "sphere", "rotating": False, "gravity": "inverse_square", "sphere_radius_m": radius}
    tree["initial"] = {
        "geodetic": {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": 200e3},
        "euler_deg": [0.0, 0.0, 0.0],
        "ned_mps": [7700.0, 0.0, 0.0],
    }
    engine = {"engine": {"table": {"time_s": [0.0], "thrust_vacuum_N": [8.0 * MASS_kg]}}}
    tree["vehicle"] = merged(TREE["vehicle"], {"stage": [merged(CONSTANT, engine) | {"cutoff_decay_s": 2.0}]})
    flight = fly(load(tree))
    assert flight.event_s("burnout") > 5.0
    place, velocity = (
        np.array([flight[f"{name}_{axis}_{unit}"][-1] for axis in "xyz"])
        for name, unit in (("r_I", "m"), ("v_I", "mps"))
    )
    energy, spin = 0.5 * velocity @ velocity - MU / np.linalg.norm(place), np.linalg.norm(np.cross(place, velocity))
    apogee = -0.5 * MU / energy * (1.0 + math.sqrt(1.0 + 2.0 * energy * spin**2 / MU**2))
    assert apogee == pytest.approx(radius + 600e3, abs=1.0)
    assert flight.metrics["cutoff_apogee_error_m"] < 1.0


def test_speed_after_a_decay_includes_gravity() -> None:
    """Upwards against 9.8 m/s2; with half of the decay as lead the speed would end 9.8 m/s too low."""
    up = {
        "guidance": {"cutoff": {"inertial_speed_mps": 100.0}},
        "vehicle": {"stage": [CONSTANT | {"cutoff_decay_s": 2.0}]},
    }
    flight = fly(load(merged(TREE, up)))
    cutoff_s = (100.0 - (ACCEL - 2.0 * G)) / (ACCEL - G)
    assert flight.event_s("burnout") == pytest.approx(cutoff_s + 2.0, abs=1e-6)
    assert flight.metrics["cutoff_inertial_speed_mps"] == pytest.approx(100.0, abs=1e-5)


@pytest.mark.parametrize("later_s", [0.0, 0.7, 4.0])
def test_a_separation_within_the_decay_does_not_change_it(later_s: float) -> None:
    """The cutoff at 1 s before 500 m/s decays over 2 s; a stage that continues begins within it."""
    cutoff_s = 400.0 / ACCEL - 1.0
    first = CONSTANT | {"cutoff_decay_s": 2.0, "separation_s": cutoff_s + 0.5}
    later = CONSTANT | {"continues": True, "clock": "preceding", "cutoff_decay_s": later_s}
    flight = in_space(500.0, {"vehicle": {"stage": [first, later]}})
    assert flight.event_s("burnout") == pytest.approx(cutoff_s + 2.0, abs=1e-8)
    assert flight["v_I_x_mps"][-1] == pytest.approx(500.0, abs=1e-6)


@pytest.mark.parametrize("decay_s", [0.0, 0.2])
def test_thrust_decays_beyond_the_burnout_and_does_not_return_after_a_separation(decay_s: float) -> None:
    """From 100 to 104 m/s in 0.2 s, the decay moves the cutoff to 0.1 s; the propellant would last until 0.22 s.

    At 0.25 s a stage begins whose thrust would decay within 2 s.
    """
    ends = {"table": {"time_s": [0.0, 0.22, 0.221], "thrust_vacuum_N": [THRUST_N, THRUST_N, 0.0]}}
    first = merged(CONSTANT, {"engine": ends if decay_s > 0.0 else {}})
    first |= {"cutoff_decay_s": decay_s, "separation_s": 0.35 if decay_s > 0.0 else 0.25}
    changes: Tree = {
        "initial": {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [100.0, 0.0, 0.0]},
        "guidance": {"cutoff": {"inertial_speed_mps": 104.0}},
        "vehicle": {"stage": [first, CONSTANT | {"continues": True, "clock": "preceding", "cutoff_decay_s": 2.0}]},
        "run": {"duration_s": 0.5, "step_s": 0.01},
    }
    flight = fly(load(merged(SPACE, changes)))
    assert flight["v_I_x_mps"][-1] == pytest.approx(104.0, abs=1e-6)
    assert flight.metrics["cutoff_inertial_speed_mps"] == pytest.approx(104.0, abs=1e-6)


def test_rail_exit_speed_of_constant_thrust() -> None:
    """v^2 = 2 L (F / m - g sin(elevation)); the rail holds the attitude against a side force and a torque."""
    length, elevation, azimuth = 6.0, 75.0, 30.0
    rail = {"length_m": length, "elevation_deg": elevation, "azimuth_deg": azimuth}
    push = [
        {"at": "body_force", "axis": "y", "kind": "step", "amplitude_N": 3000.0},
        {"at": "body_torque", "axis": "z", "kind": "step", "amplitude_Nm": 500.0},
    ]
    flight = flown(constant({"rail": rail, "injection": push}))
    accel = THRUST_N / MASS_kg - G * math.sin(math.radians(elevation))
    assert flight.metrics["rail_exit_speed_mps"] == pytest.approx(math.sqrt(2.0 * length * accel), rel=1e-9)
    exit_s = flight.event_s("rail_exit")
    assert exit_s == pytest.approx(math.sqrt(2.0 * length / accel), abs=2e-9)
    t = flight.time_s("r_E_x_m")
    on = t <= exit_s
    place = np.stack([flight[f"r_E_{axis}_m"] for axis in "xyz"], axis=1)
    level, up = math.cos(math.radians(elevation)), math.sin(math.radians(elevation))
    along = np.array([level * math.cos(math.radians(azimuth)), level * math.sin(math.radians(azimuth)), -up])
    np.testing.assert_allclose(place[on], 0.5 * accel * t[on, None] ** 2 * along, atol=1e-9)
    assert np.ptp(flight["pitch_deg"][on]) < 1e-9
    late = t - exit_s > 0.5
    turned = np.linalg.norm(np.stack([flight[f"w_BI_B_{axis}_radps"][late] for axis in "yz"]), axis=0)
    np.testing.assert_allclose(turned, 500.0 / 1500.0 * (t[late] - exit_s), rtol=1e-6)  # free from the exit on


def test_a_rail_turns_with_the_earth() -> None:
    tree = merged(TREE, constant({"rail": {"length_m": 20.0, "elevation_deg": 80.0}, "run": {"duration_s": 3.0}}))
    tree["earth"] = {"shape": "wgs84", "gravity": "j2"}
    tree["site"] = {"latitude_deg": 40.0, "longitude_deg": 10.0, "azimuth_deg": 90.0}
    flight = fly(load(tree))
    on = flight.time_s("r_E_x_m") <= flight.event_s("rail_exit")
    place = np.stack([flight[f"r_E_{axis}_m"][on] for axis in "xyz"], axis=1)
    moved = place[-1] - place[0]
    latitude, longitude = math.radians(40.0), math.radians(10.0)
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    up = np.array(
        [math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)]
    )
    along = math.cos(math.radians(80.0)) * east + math.sin(math.radians(80.0)) * up
    off = (place - place[0]) - np.outer((place - place[0]) @ along, along)
    assert np.linalg.norm(moved) > 19.0
    assert np.abs(off).max() < 1e-7  # 6.4e6 m to rounding


def test_a_vehicle_that_does_not_leave_its_rail_slides_back() -> None:
    """After 1 s of thrust the vehicle slides back without friction, both along the rail with g sin(elevation)."""
    burn = {"engine": {"table": {"time_s": [0.0, 1.0, 1.0001], "thrust_vacuum_N": [THRUST_N, THRUST_N, 0.0]}}}
    rail = {"length_m": 50.0, "elevation_deg": 70.0}
    short = {
        "rail": rail,
        "run": {"duration_s": 9.0, "stop_at": ["impact"]},
        "vehicle": {"stage": [merged(CONSTANT, burn)]},
    }
    flight = flown(short)
    pull = G * math.sin(math.radians(70.0))
    speed = THRUST_N / MASS_kg - pull
    apogee_s = 1.0 + speed / pull
    assert flight.event_s("apogee") == pytest.approx(apogee_s, abs=1e-3)
    assert flight.event_s("impact") == pytest.approx(apogee_s + math.sqrt(speed / pull + (speed / pull) ** 2), abs=1e-3)
    assert math.isnan(flight.metrics["rail_exit_speed_mps"])


def test_clearance_and_drift_at_a_tower() -> None:
    """Under a side force F at the CG, the tail moves sideways by F / (T - m g) of its height above the pad."""
    side, height, distance = 900.0, 30.0, 4.0
    push = [{"at": "body_force", "axis": "z", "kind": "step", "amplitude_N": side}]
    tower = {"distance_m": distance, "azimuth_deg": 90.0, "height_m": height, "radius_m": 0.4, "vehicle_radius_m": 0.7}
    limits = [{"metric": "min_tower_clearance_m", "minimum": 0.5}, {"metric": "max_tower_drift_m", "limit": 2.0}]
    near = constant({"injection": push, "tower": tower, "requirement": limits, "run": {"step_s": 0.001}})
    flight = flown(near)
    slope = side / (THRUST_N - MASS_kg * G)
    one_step_m = slope * 0.001 * math.sqrt(2.0 * height * (THRUST_N / MASS_kg - G))  # last step below the top
    assert flight.metrics["max_tower_drift_m"] == pytest.approx(slope * height, abs=one_step_m)
    least = distance - slope * height - 0.4 - 0.7
    assert flight.metrics["min_tower_clearance_m"] == pytest.approx(least, abs=one_step_m)
    assert [v.met for v in flight.verdicts] == [least >= 0.5, slope * height <= 2.0]
    cleared_s = math.sqrt(2.0 * height / (THRUST_N / MASS_kg - G))
    assert flight.metric_times_s["min_tower_clearance_m"] == pytest.approx(cleared_s, abs=0.0011)
    away = flown(merged(near, {"tower": tower | {"azimuth_deg": 0.0}}))  # the drift passes it at a right angle
    assert away.metrics["min_tower_clearance_m"] == pytest.approx(distance - 1.1, abs=1e-6)


def test_distance_of_lines_is_the_least_of_all_pairs_of_points() -> None:
    rng, distance = np.random.default_rng(3), from_python(between)
    up = np.array([0.6, 0.0, 0.8])
    for _ in range(40):
        tail, nose, foot = rng.normal(size=(3, 3)) * 3.0
        height = float(rng.uniform(0.1, 5.0))

        def apart(x: np.ndarray, tail=tail, nose=nose, foot=foot, height=height) -> float:  # type: ignore[no-untyped-def]
            return float(np.sum((tail + x[0] * (nose - tail) - foot - x[1] * height * up) ** 2))

        least = minimize(apart, [0.5, 0.5], bounds=[(0, 1), (0, 1)], method="L-BFGS-B", options={"ftol": 1e-15})
        found = distance(tuple(tail), tuple(nose), tuple(foot), tuple(up), height)
        assert found == pytest.approx(math.sqrt(least.fun), abs=1e-5)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rail": {"length_m": 5.0, "elevation_deg": 85.0}, "initial": {"held": False}}, "begins in the air"),
        (
            {"rail": {"length_m": 5.0, "elevation_deg": 85.0}, "initial": {"held": True, "euler_deg": [0, 90, 0]}},
            "sets the attitude",
        ),
        ({"tower": {"distance_m": 0.4, "azimuth_deg": 0.0, "height_m": 9.0}}, "above 0.5"),
        ({"requirement": [{"metric": "min_tower_clearance_m", "minimum": 1.0}]}, "does not measure it"),
        ({"requirement": [{"metric": "cutoff_speed_error_mps", "limit": 1.0}]}, "guidance.orbit or guidance.cutoff"),
        (
            {
                "guidance": {"cutoff": {"earth_speed_mps": 1e3}},
                "requirement": [{"metric": "cutoff_perigee_error_m", "limit": 1.0}],
            },
            "a last burn that aims at it",
        ),
        ({"guidance": {"cutoff": {"apogee_altitude_m": 1e5}}}, "there are no orbits"),
        ({"guidance": {"cutoff": {"earth_speed_mps": 1e3, "inertial_speed_mps": 1e3}}}, "inertial_speed_mps"),
    ],
)
def test_launches_that_cannot_be(changes: Tree, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load(merged(TREE, changes))
