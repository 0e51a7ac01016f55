"""Logged and counted values of a flight follow from its data with NumPy, SciPy's rotations and the ellipsoid.

A few steps of KSR-III in the air with rotation about all axes make every axis and plane different.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from flightkit import Parts, load, scenario_of
from scipy.integrate import trapezoid
from scipy.spatial.transform import Rotation

from maxq import Flight, FlightRun
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array, blank
from maxq.sim.flight.metrics import METRIC, _gather_incidence
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.workspace import Aux

START = [
    "run.duration_s=0.04",
    "log.fast_hz=1000",
    "log.slow_hz=1000",
    "run.stop_at=[]",
    "initial.geodetic={latitude_deg=33.0, longitude_deg=126.0, altitude_m=5000.0}",
    "initial.ned_mps=[210.0, -260.0, -240.0]",
    "initial.euler_deg=[-47.0, 39.0, 12.0]",
    "initial.rate_BE_degps=[4.0, 3.0, -2.0]",
]
ROUNDING = 1e-9


@pytest.fixture(scope="module", params=[[], ["initial.rate_BE_degps=[-2.0, 1.0, 9.0]"]], ids=["pitch", "yaw"])
def flight(request: pytest.FixtureRequest) -> Flight:
    return fly(load_scenario("nominal", [*START, *request.param]))


def columns(flight: Flight, form: str, *names: str) -> Array:
    return np.stack([flight[form.format(name)] for name in names], axis=1)


def test_place_and_velocity_over_the_ground(flight: Flight) -> None:
    time_s, rate = flight.time_s("r_I_x_m"), 7.292115e-5  # WGS 84
    r_I, v_I = columns(flight, "r_I_{}_m", *"xyz"), columns(flight, "v_I_{}_mps", *"xyz")
    earth = Rotation.from_rotvec(np.outer(-rate * time_s, [0.0, 0.0, 1.0]))
    r_E = earth.apply(r_I)
    np.testing.assert_allclose(columns(flight, "r_E_{}_m", *"xyz"), r_E, rtol=1e-12)
    latitude, longitude = np.radians(flight["latitude_deg"]), np.radians(flight["longitude_deg"])
    height = flight["altitude_m"]
    a, e2 = 6378137.0, 6.694379990141316e-3
    normal = a / np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    outward = (normal + height) * np.cos(latitude)
    there = [outward * np.cos(longitude), outward * np.sin(longitude), ((1 - e2) * normal + height) * np.sin(latitude)]
    np.testing.assert_allclose(np.array(there).T, r_E, atol=1e-6)
    v_E = earth.apply(v_I - rate * np.cross([0.0, 0.0, 1.0], r_I))
    north = [-np.sin(latitude) * np.cos(longitude), -np.sin(latitude) * np.sin(longitude), np.cos(latitude)]
    east = [-np.sin(longitude), np.cos(longitude), 0.0 * longitude]
    n, e = np.array(north).T, np.array(east).T
    over_ground = np.array([(v_E * axis).sum(axis=1) for axis in (n, e, np.cross(n, e))]).T
    np.testing.assert_allclose(columns(flight, "v_N_{}_mps", "north", "east", "down"), over_ground, atol=1e-8)
    np.testing.assert_allclose(over_ground[0], [210.0, -260.0, -240.0], atol=1e-8)
    np.testing.assert_allclose(flight["speed_mps"], np.linalg.norm(over_ground, axis=1), rtol=ROUNDING)
    slope = np.degrees(np.arcsin(-over_ground[:, 2] / np.linalg.norm(over_ground, axis=1)))
    np.testing.assert_allclose(flight["flight_path_deg"], slope, rtol=ROUNDING)
    attitude = Rotation.from_quat(columns(flight, "q_BI_{}", *"xyzw"))
    local = Rotation.from_matrix(np.stack([n, e, np.cross(n, e)], axis=2))
    angles = (local.inv() * earth * attitude).as_euler("ZYX", degrees=True)
    np.testing.assert_allclose(columns(flight, "{}_deg", "yaw", "pitch", "roll"), angles, atol=1e-8)
    np.testing.assert_allclose(angles[0], [-47.0, 39.0, 12.0], atol=1e-8)


def test_over_a_flat_earth_the_axes_are_north_east_down() -> None:
    v_N, angles = np.array([210.0, -260.0, -240.0]), [-47.0, 39.0, 12.0]
    start = {"ned_mps": list(v_N), "euler_deg": angles}
    parts = Parts(engine=False)
    row = fly(load(scenario_of(parts, initial=start, run={"duration_s": 0.01}))).final
    np.testing.assert_allclose([row[f"v_N_{k}_mps"] for k in ("north", "east", "down")], v_N, rtol=ROUNDING)
    np.testing.assert_allclose([row[f"{k}_deg"] for k in ("yaw", "pitch", "roll")], angles, rtol=ROUNDING)
    assert row["flight_path_deg"] == pytest.approx(math.degrees(math.atan2(240.0, math.hypot(210.0, 260.0))))
    assert row["altitude_m"] == pytest.approx(2.4, rel=1e-9)


def test_incidence_is_that_of_the_velocity_in_body_axes(flight: Flight) -> None:
    attitude = Rotation.from_quat(columns(flight, "q_BI_{}", *"xyzw"))
    r_I, v_I = columns(flight, "r_I_{}_m", *"xyz"), columns(flight, "v_I_{}_mps", *"xyz")
    flow = attitude.inv().apply(v_I - 7.292115e-5 * np.cross([0.0, 0.0, 1.0], r_I))  # in still air
    u, v, w = flow.T
    speed = np.linalg.norm(flow, axis=1)
    total = np.degrees(np.arccos(u / speed))
    q = 0.5 * flight["density_kgpm3"] * speed**2
    for name, found in (
        ("airspeed_mps", speed),
        ("mach", speed / flight["sound_speed_mps"]),
        ("alpha_deg", np.degrees(np.arctan2(w, u))),
        ("beta_deg", np.degrees(np.arcsin(v / speed))),
        ("alpha_total_deg", total),
        ("dynamic_pressure_Pa", q),
        ("q_alpha_Padeg", q * total),
    ):
        np.testing.assert_allclose(flight[name], found, rtol=1e-7)
    assert min(abs(flight["alpha_deg"]).min(), abs(flight["beta_deg"]).min()) > 0.1


def test_metrics_are_the_extremes_of_what_is_logged(flight: Flight) -> None:
    """The metrics are the extremes of the log of every step, after engine start, with the vehicle free."""
    assert (flight["on_pad"] == 0.0).all()

    def most(*names: str) -> float:
        return float(max(np.abs(flight[name]).max() for name in names))

    swing = [
        np.degrees(np.arctan(np.hypot(*(np.tan(np.radians(flight[f"slosh_{t}_{p}_deg"])) for p in ("pitch", "yaw")))))
        for t in ("lox", "jeta1")
    ]
    force = columns(flight, "specific_force_B_{}_mps2", *"xyz")
    for name, found in (
        ("max_speed_mps", most("speed_mps")),
        ("max_altitude_m", most("altitude_m")),
        ("max_mach", most("mach")),
        ("max_dynamic_pressure_Pa", most("dynamic_pressure_Pa")),
        ("max_powered_dynamic_pressure_Pa", most("dynamic_pressure_Pa")),
        ("max_alpha_deg", most("alpha_total_deg")),
        ("max_q_alpha_Padeg", most("q_alpha_Padeg")),
        ("max_attitude_error_deg", most("attitude_error_pitch_deg", "attitude_error_yaw_deg")),
        ("max_roll_error_deg", most("attitude_error_roll_deg")),
        ("max_computer_attitude_error_deg", most("error_pitch_deg", "error_yaw_deg")),
        ("max_computer_roll_error_deg", most("error_roll_deg")),
        ("max_gimbal_deg", most("gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg")),
        ("max_gimbal_rate_degps", most("gimbal_pitch_rate_degps", "gimbal_yaw_rate_degps")),
        ("max_bending_m", np.hypot(flight["bend_pitch_gimbal_m"], flight["bend_yaw_gimbal_m"]).max()),
        ("max_slosh_deg", np.max(swing)),
        ("max_thrust_over_weight_g", most("thrust_over_weight_g")),
        ("max_axial_load_g", most("axial_load_g")),
        ("max_lateral_load_g", np.hypot(force[:, 1], force[:, 2]).max() / 9.80665),
    ):
        assert flight.metrics[name] == pytest.approx(found, rel=1e-7), name
        assert found > 0.0, name
    saturated = (flight["saturated_pitch"] == 1.0) | (flight["saturated_yaw"] == 1.0)
    assert flight.metrics["saturation_time_s"] == pytest.approx(1e-3 * saturated[:-1].sum(), abs=1.1e-3)


def test_incidence_and_its_product_with_pressure_have_extremes_of_their_own() -> None:
    """Angle of attack and its product with pressure have separate extremes.

    The angle is computed where it may raise either extreme: it rises as the pressure falls, and the reverse.
    """
    run = FlightRun(load_scenario("nominal", START), log=False)
    extremes, aux = run.memory.extremes, blank(Aux)[0]
    gather = from_python(_gather_incidence)
    for now_ns, q, alpha_deg in ((0, 2000.0, 5.0), (1, 1100.0, 6.0), (2, 4000.0, 4.0), (3, 900.0, 50.0)):
        aux.air.flow_B_mps = 300.0, 300.0 * math.tan(math.radians(alpha_deg)), 0.0
        gather(extremes, q, aux, now_ns)
    assert extremes.value[METRIC.max_alpha_deg] == pytest.approx(6.0)  # below 1 kPa nothing counts
    assert extremes.value[METRIC.max_q_alpha_Padeg] == pytest.approx(16_000.0)
    assert extremes.time_ns[[METRIC.max_alpha_deg, METRIC.max_q_alpha_Padeg]].tolist() == [1, 2]


def test_mass_and_loads(flight: Flight) -> None:
    mass, thrust = flight["mass_kg"], flight["thrust_N"]
    np.testing.assert_allclose(flight["thrust_over_weight_g"], thrust / mass / 9.80665, rtol=ROUNDING)
    np.testing.assert_allclose(
        flight["axial_load_g"], (thrust + flight["aero_force_B_x_N"]) / mass / 9.80665, rtol=ROUNDING
    )
    assert mass[0] - mass[-1] == pytest.approx(trapezoid(flight["mass_flow_kgps"], dx=1e-3), rel=1e-3)
    assert (flight["Ixx_kgm2"] < 0.05 * flight["Iyy_kgm2"]).all()  # a slender body of revolution
    np.testing.assert_allclose(flight["Iyy_kgm2"], flight["Izz_kgm2"], rtol=0.01)
