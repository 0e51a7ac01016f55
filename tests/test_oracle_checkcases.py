"""Further check cases agree with an independent integration from first principles.

The scenarios are those of scenarios/checkcases; this module contains their vehicles again as textbook equations.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from oracles.textbook_flight import RATE, Air, Body, State, Vector, cross, geodetic, integrate, ned_axes, start
from scipy.integrate import solve_ivp

from maxq import Flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

FOOT, SLUG = 0.3048, 0.45359237 * 9.80665 / 0.3048
SPHERE_AREA, SPHERE_INERTIA = 0.1963495 * FOOT**2, 3.6 * SLUG * FOOT**2
BRICK_MASS, BRICK_AREA = 0.155404754 * SLUG, 0.22222 * FOOT**2
BRICK_INERTIA = np.diag([0.001894220, 0.006211019, 0.007194665]) * SLUG * FOOT**2
BRICK_LENGTHS = np.array([0.33333, 0.66667, 0.33333]) * FOOT  # b, cbar, b
NOTHING = np.zeros(3)


@cache
def flown(name: str, *overrides: str) -> Flight:
    return fly(load_scenario(f"checkcases/{name}", overrides))


def drag(air: Air, area: float, coefficient: float) -> Vector:
    return -0.5 * air.density * air.speed * area * coefficient * air.flow_B


def sphere() -> Body:
    return Body(
        lambda t: SLUG, lambda t: SPHERE_INERTIA * np.eye(3), lambda t, air: (drag(air, SPHERE_AREA, 0.1), NOTHING)
    )


def brick(earth_rates: bool = False, push=lambda t: NOTHING, twist=lambda t: NOTHING) -> Body:
    """Return the brick with CD 0.01, Clp = Cmq = Cnr = -1: each moment is q S L C (L rate / 2 V)."""

    def loads(t: float, air: Air) -> tuple[Vector, Vector]:
        rate = air.rate_BE_B if earth_rates else air.rate_BI_B
        moment = -0.25 * air.density * air.speed * BRICK_AREA * BRICK_LENGTHS**2 * rate
        return drag(air, BRICK_AREA, 0.01) + push(t), moment + twist(t)

    return Body(lambda t: BRICK_MASS, lambda t: BRICK_INERTIA, loads)


def differences(flight: Flight, times: Vector, states: list[State]) -> dict[str, float]:
    """Return the largest differences of position (m), velocity (m/s), attitude (rad) and inertial rate (rad/s)."""
    rows = np.searchsorted(flight.time_s("altitude_m"), times - 1e-9)
    assert np.abs(flight.time_s("altitude_m")[rows] - times).max() < 1e-9
    worst = dict.fromkeys(("position", "velocity", "attitude", "rate"), 0.0)
    for row, t, state in zip(rows, times, states, strict=True):
        at = {name: flight[name][row] for name in CHANNELS}
        latitude, longitude, altitude = geodetic(state.position)
        velocity = ned_axes(latitude, longitude).T @ state.velocity
        turned = np.array(
            [[np.cos(RATE * t), -np.sin(RATE * t), 0], [np.sin(RATE * t), np.cos(RATE * t), 0], [0, 0, 1]]
        )
        w, x, y, z = (at[f"q_BI_{c}"] for c in "wxyz")
        axis = np.array([x, y, z])
        by = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        ours = (w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * by
        found = {
            "position": np.abs([at[f"r_E_{c}_m"] for c in "xyz"] - state.position).max(),
            "velocity": np.abs([at[f"v_N_{c}_mps"] for c in ("north", "east", "down")] - velocity).max(),
            "attitude": np.abs(ours - turned @ state.attitude).max(),
            "rate": np.abs([at[f"w_BI_B_{c}_radps"] for c in "xyz"] - state.rate).max(),
        }
        found["position"] = max(found["position"], abs(at["altitude_m"] - altitude))
        for name, value in found.items():
            worst[name] = max(worst[name], float(value))
    return worst


CHANNELS = (
    *(f"r_E_{c}_m" for c in "xyz"),
    *(f"v_N_{c}_mps" for c in ("north", "east", "down")),
    *(f"q_BI_{c}" for c in "wxyz"),
    *(f"w_BI_B_{c}_radps" for c in "xyz"),
    "altitude_m",
)
THIRTY = np.linspace(0.0, 30.0, 31)


def assert_within(found: dict[str, float], position: float, velocity: float, attitude: float, rate: float):
    allowed = {"position": position, "velocity": velocity, "attitude": attitude, "rate": rate}
    assert {k: v for k, v in found.items() if not v <= allowed[k]} == {}


DROP = ((25.0, -70.0, 9144.0), (40.0, -25.0, 10.0), (30.0, 10.0, -20.0))


@cache
def damped_brick(frame: str) -> list[State]:
    inertial = frame == "inertial"
    begin = start(*DROP, (10.0, 20.0, 30.0), inertial)
    return integrate(brick(earth_rates=not inertial), begin, THIRTY)


@pytest.mark.parametrize("frame", ["inertial", "earth"])
def test_brick_with_rate_damping(frame):
    flight = flown(f"brick-damping-{frame}")
    assert_within(differences(flight, THIRTY, damped_brick(frame)), 2e-7, 2e-9, 1e-10, 1e-10)


def test_inertial_and_earth_relative_damping_can_be_told_apart():
    wrong = flown("brick-damping-earth", "vehicle.stage.0.aero.rate_reference=inertial")
    assert differences(wrong, THIRTY, damped_brick("earth"))["rate"] > 1e-5


def test_wind_linear_in_altitude():
    def wind(altitude: float) -> Vector:
        share = altitude / (30000 * FOOT)
        return np.array([3.0 - 15.0 * share, (-20.0 + 90.0 * share) * FOOT, 0.0])

    begin = start((0.0, 0.0, 30000 * FOOT), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), True)
    states = integrate(sphere(), begin, THIRTY, wind_ned=wind)
    assert_within(differences(flown("wind-shear"), THIRTY, states), 2e-7, 2e-9, 1e-12, 1e-15)


SHOTS = {
    "shot-north": ((0.0, 0.0, 0.0), (304.8, 0.0, -304.8), (0.0, 0.0, 0.0)),
    "shot-southwest": ((-41.0, -179.99, 100.0), (-174.8, -249.7, -304.8), (235.0, 45.0, 0.0)),
}


@pytest.mark.parametrize("name", SHOTS)
def test_launch_to_any_azimuth(name):
    states = integrate(sphere(), start(*SHOTS[name], (0.0, 0.0, 0.0), False), THIRTY)
    assert_within(differences(flown(name), THIRTY, states), 2e-7, 2e-9, 1e-12, 1e-15)


def test_shot_crosses_the_date_line():
    longitude = flown("shot-southwest")["longitude_deg"]
    assert longitude[0] == pytest.approx(-179.99)
    assert longitude[-1] > 179.9


def test_simultaneous_force_and_torque_schedules():
    def push(t: float) -> Vector:
        along = np.interp(t, [0.0, 4.0, 7.5, 12.0], [0.0, 30.0, -10.0, 5.0]) if t < 12.0 else 0.0
        below = 15.0 * np.sin(2 * np.pi * 0.4 * (t - 2.0)) if 2.0 <= t < 20.0 else 0.0
        return np.array([along, 0.0, below])

    def twist(t: float) -> Vector:
        pitch = np.interp(t, [0.0, 5.0, 10.0, 15.0], [1e-3, -2e-3, 2e-3, 0.0])
        yaw = 1.5e-3 if 3.0 <= t < 7.0 else -1.5e-3 if 7.0 <= t < 11.0 else 0.0
        return np.array([2e-4 if 1.0 <= t < 6.5 else 0.0, pitch, yaw])

    kinks = (1.0, 2.0, 3.0, 4.0, 5.0, 6.5, 7.0, 7.5, 10.0, 11.0, 12.0, 15.0, 20.0)
    states = integrate(brick(push=push, twist=twist), start(*DROP, (0.0, 0.0, 0.0), True), THIRTY, kinks)
    assert_within(differences(flown("brick-forced"), THIRTY, states), 2e-7, 2e-9, 1e-10, 1e-10)


# --- two stages ---

AREA, LENGTH = 0.63617, 0.9
BURN_1, SEPARATION, IGNITION_2, BURN_2 = 40.0, 45.0, 48.0, 68.0


class Stage:
    """A stage as in its vehicle file; `clock` counts from the start of the stage."""

    def __init__(self, begins, mass_times, mass_rows, thrust_times, thrust, engine, aero, reference):
        self.begins, self.mass_times, self.mass_rows = begins, mass_times, np.array(mass_rows, float)
        self.thrust_times, self.thrust = thrust_times, thrust
        self.exit_area, self.gimbal, self.offset, self.misalignment = engine
        self.aero, self.reference = aero, reference

    def props(self, t: float) -> Vector:
        """Return mass, CG (station, y, z), Ixx, Iyy, Izz and the integrals Ixy, Ixz, Iyz."""
        first, last = self.mass_times
        share = min(max((t - self.begins - first) / (last - first), 0.0), 1.0)
        return self.mass_rows[0] + share * (self.mass_rows[1] - self.mass_rows[0])

    def inertia(self, t: float) -> Vector:
        xx, yy, zz, xy, xz, yz = self.props(t)[4:]
        return np.array([[xx, -xy, -xz], [-xy, yy, -yz], [-xz, -yz, zz]])

    def place(self, t: float, station: float, y: float = 0.0, z: float = 0.0) -> Vector:
        """Return the vector in B from the CG to a point of the body."""
        _, x_cg, y_cg, z_cg = self.props(t)[:4]
        return np.array([x_cg - station, y - y_cg, z - z_cg])

    def loads(self, t: float, air: Air, burning: bool, earth_rates: bool) -> tuple[Vector, Vector]:
        c = {name: np.interp(air.mach, self.aero["mach"], column) for name, column in self.aero.items()}
        u, v, w = air.flow_B
        dense = 0.5 * air.density * AREA
        axial = c["CA"] if burning else c.get("CA_coast", c["CA"])
        force = -dense * np.array([axial * u * abs(u), c["CN_alpha_pr"] * abs(u) * v, c["CN_alpha_pr"] * abs(u) * w])
        rate = air.rate_BE_B if earth_rates else air.rate_BI_B
        moment = (
            dense
            * LENGTH
            * (
                np.array([0.0, c["Cm_alpha_pr"] * abs(u) * w, -c["Cm_alpha_pr"] * abs(u) * v])
                + np.array([0.0, c.get("Cm0", 0.0), 0.0]) * air.speed**2
                + 0.5 * LENGTH * air.speed * np.array([c["Clp"], c["Cmq"], c["Cnr"]]) * rate
            )
        )
        moment = moment + cross(self.place(t, self.reference), force)
        if burning:
            vacuum = np.interp(t - self.begins, self.thrust_times, self.thrust)
            pitch, yaw = np.radians(self.misalignment)
            push = max(vacuum - self.exit_area * air.pressure, 0.0) * np.array(
                [np.cos(pitch) * np.cos(yaw), -np.sin(yaw), np.sin(pitch) * np.cos(yaw)]
            )
            force = force + push
            moment = moment + cross(self.place(t, self.gimbal, *self.offset), push)
        return force, moment

    def body(self, burns: tuple[float, float], earth_rates: bool) -> Body:
        return Body(
            lambda t: float(self.props(t)[0]),
            self.inertia,
            lambda t, air: self.loads(t, air, burns[0] <= t < burns[1], earth_rates),
        )


FIRST = Stage(
    0.0,
    [0.0, 40.0],
    [[3000, 6.1, 0.004, -0.002, 310, 21000, 21100, 6, 14, -3], [1500, 5.3, 0.008, -0.005, 190, 13000, 13050, 4, 9, -2]],
    [0.0, 39.8, 40.0],
    [62000.0, 68000.0, 0.0],
    (0.12, 10.2, (0.003, 0.001), (0.02, -0.03)),
    {
        "mach": [0.0, 0.8, 1.2, 2.5, 5.0],
        "CA": [0.32, 0.36, 0.61, 0.42, 0.30],
        "CA_coast": [0.40, 0.46, 0.75, 0.50, 0.35],
        "CN_alpha_pr": [9.0, 9.8, 10.9, 8.1, 6.4],
        "Cm_alpha_pr": [-14.0, -16.0, -19.0, -9.0, -6.0],
        "Cm0": [0.004, 0.004, 0.002, 0.001, 0.0],
        "Cmq": [-240.0, -260.0, -310.0, -210.0, -170.0],
        "Cnr": [-230.0, -250.0, -300.0, -205.0, -165.0],
        "Clp": [-4.0, -4.4, -5.0, -3.6, -3.0],
    },
    7.0,
)
SECOND = Stage(
    SEPARATION,
    [3.0, 23.0],
    [[900, 3.4, 0.003, 0.001, 90, 1900, 1920, 0, 1, 0], [520, 3.0, 0.005, 0.002, 60, 1400, 1415, 0, 0.6, 0]],
    [0.0, 22.9, 23.0],
    [15000.0, 17000.0, 0.0],
    (0.08, 5.6, (0.0, 0.0), (-0.01, 0.015)),
    {
        "mach": [0.0, 1.5, 3.0, 8.0],
        "CA": [0.30, 0.45, 0.33, 0.25],
        "CN_alpha_pr": [6.0, 7.0, 6.2, 5.0],
        "Cm_alpha_pr": [-4.0, -4.5, -3.5, -2.5],
        "Cmq": [-90.0, -100.0, -85.0, -70.0],
        "Cnr": [-90.0, -100.0, -85.0, -70.0],
        "Clp": [-2.0, -2.2, -1.8, -1.5],
    },
    4.2,
)


def wind_of_two_stages(altitude: float) -> Vector:
    heights = [0.0, 8000.0, 30000.0]
    return np.array(
        [np.interp(altitude, heights, [2.0, 5.0, 0.0]), np.interp(altitude, heights, [3.0, 12.0, 0.0]), 0.0]
    )


@cache
def two_stages_by_the_book() -> tuple[Vector, list[State]]:
    begin = start((34.5, 126.5, 200.0), (4.0, 3.0, -60.0), (200.0, 84.0, 15.0), (2.0, 0.0, 0.0), False)
    lower, upper = np.linspace(0.0, 45.0, 46), np.linspace(45.0, 100.0, 56)
    flight = FIRST.body((0.0, BURN_1), earth_rates=False)
    states = integrate(flight, begin, lower, (39.8, BURN_1), wind_of_two_stages)
    end = states[-1]
    # the upper part flies on with its own CG: a point of the body that was turning about the old one
    shift = SECOND.place(SEPARATION, 0.0) - FIRST.place(SEPARATION, 0.0)
    turning = end.rate - end.attitude.T @ np.array([0.0, 0.0, RATE])
    after = State(
        end.position - end.attitude @ shift, end.velocity - end.attitude @ cross(turning, shift), end.attitude, end.rate
    )
    flight = SECOND.body((IGNITION_2, BURN_2), earth_rates=True)
    more = integrate(flight, after, upper, (IGNITION_2, 67.9, BURN_2), wind_of_two_stages)
    return np.concatenate([lower[:-1], upper]), states[:-1] + more


@pytest.mark.slow
def test_two_stages():
    times, states = two_stages_by_the_book()
    assert_within(differences(flown("two-stage"), times, states), 5e-4, 1e-5, 2e-8, 1e-8)


def test_mass_of_two_stages():
    times, _ = two_stages_by_the_book()
    mass = [(FIRST if t < SEPARATION else SECOND).props(t)[0] for t in times]
    flight = flown("two-stage")
    ours = flight["mass_kg"][np.searchsorted(flight.time_s("mass_kg"), times - 1e-9)]
    np.testing.assert_allclose(ours, mass, rtol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        "switches.jet_damping=true",
        "switches.moving_cg=true",
        "vehicle.stage.0.interpolation=pchip",
        "vehicle.stage.0.aero.interpolation=pchip",
        "vehicle.stage.0.aero.moment_reference_m=7.001",
        "vehicle.stage.1.aero.moment_reference_m=4.201",
        "vehicle.stage.1.aero.rate_reference=inertial",
        "vehicle.stage.1.engine.exit_area_m2=0.0801",
    ],
)
def test_two_stages_resolve_what_they_are_for(wrong):
    """The comparison detects each of these mistakes."""
    times, states = two_stages_by_the_book()
    found = differences(flown("two-stage", wrong), times, states)
    assert found["position"] > 5e-4 or found["rate"] > 1e-8


# --- gravity gradient on a body with products of inertia ---

JEOD_MU = 3.986004415e14
UNEQUAL = np.array([[500.0, 60.0, -45.0], [60.0, 900.0, 80.0], [-45.0, 80.0, 1200.0]])


def pull(position: Vector) -> Vector:
    return np.asarray(-JEOD_MU * position / np.linalg.norm(position) ** 3)


def attracted(r: Vector, to_inertial: Vector, tensor: Vector) -> Vector:
    """Return the moment in B of the attraction of six point masses with this inertia tensor."""
    moments, axes = np.linalg.eigh(0.5 * np.trace(tensor) * np.eye(3) - tensor)
    out = np.zeros(3)
    for moment, axis in zip(moments, axes.T, strict=True):
        for arm in (30.0 * axis, -30.0 * axis):  # so far that the difference in pull is not rounded off
            mass = 0.5 * moment / 30.0**2
            out += mass * cross(arm, to_inertial.T @ pull(r + to_inertial @ arm))
    return out


def test_gravity_gradient_turns_a_body_with_products_of_inertia():
    flight = flown("exo-10d", f"vehicle.stage.0.mass.inertia_kgm2={UNEQUAL.tolist()}", "run.duration_s=1200.0")

    def derivative(t: float, y: Vector) -> Vector:
        to_inertial, rate = y[6:15].reshape(3, 3), y[15:]
        moment = attracted(y[:3], to_inertial, UNEQUAL)
        rows = [cross(row, rate) for row in to_inertial]
        spin_up = np.linalg.solve(UNEQUAL, moment - cross(rate, UNEQUAL @ rate))
        return np.concatenate([y[3:6], pull(y[:3]), *rows, spin_up])

    def attitude(row: int) -> Vector:
        w, *axis = (flight[f"q_BI_{c}"][row] for c in "wxyz")
        x, y, z = axis
        by = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + 2 * w * by + 2 * by @ by

    def rate(row: int) -> Vector:
        return np.array([flight[f"w_BI_B_{c}_radps"][row] for c in "xyz"])

    position = [flight[f"r_I_{c}_m"][0] for c in "xyz"]
    velocity = [flight[f"v_I_{c}_mps"][0] for c in "xyz"]
    begin = np.concatenate([position, velocity, attitude(0).ravel(), rate(0)])
    end = solve_ivp(derivative, (0.0, 1200.0), begin, "DOP853", rtol=1e-11, atol=1e-14).y[:, -1]
    assert np.abs(end[15:] - rate(0)).max() > 1e-4  # it does turn it
    np.testing.assert_allclose(rate(-1), end[15:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(attitude(-1).ravel(), end[6:15], rtol=0, atol=1e-10)
