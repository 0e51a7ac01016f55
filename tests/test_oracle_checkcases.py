"""Check cases beyond those with published histories, against an independent integration from first principles.

Scenarios are those of scenarios/checkcases; here their vehicles are written a second time, as textbook equations.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from oracles.textbook_flight import (
    RATE,
    Air,
    Body,
    State,
    Vector,
    geodetic,
    integrate,
    ned_axes,
    no_wind,
    start,
)

from maxq.sim.flight.fly import Flight, fly
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
        lambda t: SLUG,
        lambda t: SPHERE_INERTIA * np.eye(3),
        lambda t, air: (drag(air, SPHERE_AREA, 0.1), NOTHING),
    )


def brick(earth_rates: bool = False, push=lambda t: NOTHING, twist=lambda t: NOTHING) -> Body:
    """CD 0.01, Clp = Cmq = Cnr = -1: each moment is q S L C (L rate / 2 V)."""

    def loads(t: float, air: Air) -> tuple[Vector, Vector]:
        rate = air.rate_BE_B if earth_rates else air.rate_BI_B
        moment = -0.25 * air.density * air.speed * BRICK_AREA * BRICK_LENGTHS**2 * rate
        return drag(air, BRICK_AREA, 0.01) + push(t), moment + twist(t)

    return Body(lambda t: BRICK_MASS, lambda t: BRICK_INERTIA, loads)


def differences(flight: Flight, times: Vector, states: list[State]) -> dict[str, float]:
    """Largest differences of position (m), velocity (m/s), attitude (rad) and inertial rate (rad/s)."""
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
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        ours = (w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * cross
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


@pytest.mark.parametrize("frame", ["inertial", "earth"])
def test_brick_with_rate_damping(frame):
    inertial = frame == "inertial"
    begin = start(*DROP, (10.0, 20.0, 30.0), inertial)
    states = integrate(brick(earth_rates=not inertial), begin, THIRTY)
    assert_within(
        differences(flown(f"brick-damping-{frame}"), THIRTY, states), 1e-6, 1e-7, 1e-8, 1e-8
    )


def test_wind_linear_in_altitude():
    def wind(altitude: float) -> Vector:
        share = altitude / (30000 * FOOT)
        return np.array([3.0 - 15.0 * share, (-20.0 + 90.0 * share) * FOOT, 0.0])

    begin = start((0.0, 0.0, 30000 * FOOT), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), True)
    states = integrate(sphere(), begin, THIRTY, wind_ned=wind)
    assert_within(differences(flown("wind-shear"), THIRTY, states), 1e-6, 1e-7, 1e-10, 1e-12)


SHOTS = {
    "shot-north": ((0.0, 0.0, 0.0), (304.8, 0.0, -304.8), (0.0, 0.0, 0.0)),
    "shot-southwest": ((-41.0, -179.99, 100.0), (-174.8, -249.7, -304.8), (235.0, 45.0, 0.0)),
}


@pytest.mark.parametrize("name", SHOTS)
def test_launch_to_any_azimuth(name):
    states = integrate(sphere(), start(*SHOTS[name], (0.0, 0.0, 0.0), False), THIRTY)
    assert_within(differences(flown(name), THIRTY, states), 1e-6, 1e-7, 1e-10, 1e-12)


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
    # a stretch must see its own side of a jump at both of its ends
    body = brick(push=one_sided(push, kinks), twist=one_sided(twist, kinks))
    states = integrate(body, start(*DROP, (0.0, 0.0, 0.0), True), THIRTY, kinks)
    assert_within(differences(flown("brick-forced"), THIRTY, states), 1e-6, 1e-7, 1e-8, 1e-8)
