"""Impact points against integration by SciPy: the ellipse without J2, and the fall through air that moves.

The oracle integrates in the Earth-fixed frame with centrifugal and Coriolis accelerations, and finds geodetic
altitudes by iteration, so that it shares neither frame nor formulas with the model.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from maxq.control.kernel.records import Array
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.impact import AirColumn, air_column, falling_impacts, vacuum_impacts
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.world.earth import Earth, flat, wgs84

MU, A, F, SPIN = 3.986004418e14, 6378137.0, 1.0 / 298.257223563, 7.292115e-5
STATES = np.array(  # time, position and velocity in I: a booster, a core, a retrograde polar stage, one that falls
    [
        [85.6, 3.93e6, -5.07e6, 5.8e5, 1.5e3, 1.3e3, 1.1e3],
        [230.0, 4.35e6, -4.80e6, 5.7e5, 4.1e3, 3.9e3, -1.0e2],
        [600.0, 1.00e6, 2.00e6, 6.10e6, -3.0e3, 2.5e3, 1.5e3],
        [5.0, -6.40e6, 1.00e5, -1.00e5, 3.0e2, -4.7e2, 2.0e2],
    ]
)
COLUMN = AirColumn(
    np.array([-1e3, 120e3]),
    math.log(1.2) - np.array([-1e3, 120e3]) / 7200.0,
    np.array([[30.0, -20.0, 0.0], [30.0, -20.0, 0.0]]),
)


def altitude_m(r_E_m: Array) -> tuple[float, float]:
    """Return geodetic altitude and latitude (rad) by iteration of tan(latitude) = (z + e2 N sin(latitude)) / p."""
    e2, p = F * (2.0 - F), math.hypot(r_E_m[0], r_E_m[1])
    latitude = math.atan2(r_E_m[2], p * (1.0 - e2))
    for _ in range(30):
        normal = A / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        latitude = math.atan2(r_E_m[2] + e2 * normal * math.sin(latitude), p)
    return p * math.cos(latitude) + r_E_m[2] * math.sin(latitude) - A * math.sqrt(
        1.0 - e2 * math.sin(latitude) ** 2
    ), latitude


def fallen(state: Array, ground_m: float, j2: float, ballistic_kgpm2: float = math.inf) -> tuple[float, float, float]:
    """Return latitude, longitude (deg) and time of the fall, by integration in the Earth-fixed frame."""
    angle = SPIN * state[0]
    turn = np.array(
        [[math.cos(angle), math.sin(angle), 0.0], [-math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    spin = np.array([0.0, 0.0, SPIN])
    r0 = turn @ state[1:4]
    v0 = turn @ state[4:7] - np.cross(spin, r0)

    def rate(_: float, y: Array) -> Array:
        r, v = y[:3], y[3:]
        radius = np.linalg.norm(r)
        sine2 = (r[2] / radius) ** 2
        factor = 1.5 * j2 * (A / radius) ** 2
        gravity = -MU / radius**3 * r * (1.0 + factor * (np.array([1.0, 1.0, 3.0]) - 5.0 * sine2))
        a = gravity - 2.0 * np.cross(spin, v) - np.cross(spin, np.cross(spin, r))
        if math.isfinite(ballistic_kgpm2):
            h, lat = altitude_m(r)
            lon = math.atan2(r[1], r[0])
            north = np.array([-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)])
            east = np.array([-math.sin(lon), math.cos(lon), 0.0])
            past = v - 30.0 * north + 20.0 * east
            density = 1.2 * math.exp(-h / 7200.0) if h < 120e3 else 0.0
            a = a - 0.5 * density * np.linalg.norm(past) * past / ballistic_kgpm2
        return np.concatenate([v, a])

    def ground(_: float, y: Array) -> float:
        return altitude_m(y[:3])[0] - ground_m

    ground.terminal, ground.direction = True, -1.0  # type: ignore[attr-defined]
    found = solve_ivp(rate, (0.0, 4000.0), np.concatenate([r0, v0]), "DOP853", events=ground, rtol=1e-10, atol=1e-5)
    end = found.y_events[0][0]
    return math.degrees(altitude_m(end[:3])[1]), math.degrees(math.atan2(end[1], end[0])), float(found.t_events[0][0])


def metres(found: object, index: int, wanted: tuple[float, float, float]) -> float:
    """Return the distance on the ground between impact `index` and the oracle's, m."""
    latitude, longitude = found.latitude_deg[index], found.longitude_deg[index]  # type: ignore[attr-defined]
    north = math.radians(latitude - wanted[0]) * 6.37e6
    east = math.radians(longitude - wanted[1]) * 6.37e6 * math.cos(math.radians(latitude))
    return math.hypot(north, east)


def test_the_vacuum_point_is_that_of_an_integration_without_j2() -> None:
    found = vacuum_impacts(wgs84(), STATES[:, 0], STATES[:, 1:4], STATES[:, 4:7], -30.0)
    for index, state in enumerate(STATES):
        wanted = fallen(state, -30.0, 0.0)
        assert found.fall_s[index] == pytest.approx(wanted[2], abs=1e-5)
        assert metres(found, index, wanted) < 0.05  # error of the oracle's integration


def test_the_neglect_of_j2_moves_the_point_by_at_most_half_a_percent_of_the_distance() -> None:
    found = vacuum_impacts(wgs84(), STATES[:, 0], STATES[:, 1:4], STATES[:, 4:7])
    for index, state in enumerate(STATES[:3]):
        moved = metres(found, index, fallen(state, 0.0, 1.08262982e-3))
        way = found.fall_s[index] * np.linalg.norm(state[4:7])
        assert 0.0 < moved < 5e-3 * way


@pytest.mark.parametrize("ballistic_kgpm2", [100.0, 3000.0])
def test_the_point_with_drag_is_that_of_an_integration_in_wind(ballistic_kgpm2: float) -> None:
    found = falling_impacts(wgs84(), COLUMN, ballistic_kgpm2, STATES[:, 0], STATES[:, 1:4], STATES[:, 4:7], 100.0)
    for index in (0, 3):
        wanted = fallen(STATES[index], 100.0, 1.08262982e-3, ballistic_kgpm2)
        assert found.fall_s[index] == pytest.approx(wanted[2], abs=0.02)
        assert metres(found, index, wanted) < 5.0  # of some hundred kilometres: the step of the integration


def test_orbits_escapes_and_a_flat_earth_have_no_impact_point_and_the_ground_is_its_own() -> None:
    r = np.array([[6.7e6, 0.0, 0.0], [6.7e6, 0.0, 0.0], [6378137.0 - 5.0, 0.0, 0.0]])
    v = np.array([[0.0, 7800.0, 0.0], [0.0, 12000.0, 0.0], [0.0, 465.0, 0.0]])
    t = np.array([0.0, 0.0, 100.0])
    found = vacuum_impacts(wgs84(), t, r, v)
    assert np.isnan(found.fall_s).tolist() == [True, True, False]
    assert np.isnan(found.latitude_deg).tolist() == [True, True, False]
    assert found.fall_s[2] == 0.0
    assert found.longitude_deg[2] == pytest.approx(-math.degrees(100.0 * SPIN), abs=1e-12)
    assert np.isnan(vacuum_impacts(flat(), t, r, v).fall_s).all()
    drag = falling_impacts(wgs84(), COLUMN, 100.0, t, r, v)
    assert np.isnan(drag.fall_s).tolist() == [True, True, False]
    assert drag.fall_s[2] == pytest.approx(0.0, abs=1e-6)


def test_a_vertical_throw_on_an_earth_at_rest_falls_back_to_its_place() -> None:
    earth: Earth = replace(wgs84(), rate_radps=0.0)
    speed, radius = 1000.0, A
    found = vacuum_impacts(earth, np.zeros(1), np.array([[radius + 1.0, 0.0, 0.0]]), np.array([[speed, 0.0, 0.0]]))
    assert abs(found.latitude_deg[0]) < 1e-9
    assert abs(found.longitude_deg[0]) < 1e-9
    assert found.fall_s[0] == pytest.approx(fallen_back_s(radius + 1.0, radius, speed), rel=1e-7)


def fallen_back_s(start_m: float, end_m: float, speed_mps: float) -> float:
    """Return the time of a vertical throw in a central field, by quadrature of dr / v from the top."""
    top = 1.0 / (1.0 / start_m - speed_mps**2 / (2.0 * MU))
    total = 0.0
    for low in (start_m, end_m):
        u, weights = np.polynomial.legendre.leggauss(60)
        x = 0.5 * (u + 1.0) * math.sqrt(top - low)  # r = top - x^2
        r = top - x**2
        speed = np.sqrt(2.0 * MU * (1.0 / r - 1.0 / top)) / x
        total += float(np.sum(weights * 2.0 / speed)) * 0.5 * math.sqrt(top - low)
    return total


def test_the_air_of_a_scenario_is_the_standard_atmosphere_with_its_wind() -> None:
    packed = pack_flight(load_scenario("nominal", ["wind.speed_mps=10", "wind.from_deg=270"]).scenario)
    column = air_column(packed, 0.0)
    for altitude, density in ((0.0, 1.2250), (5000.0, 0.73643), (20000.0, 0.088910), (80000.0, 1.8458e-5)):
        found = math.exp(np.interp(altitude, column.altitude_m, column.log_density))
        assert found == pytest.approx(density, rel=2e-4)  # US Standard Atmosphere 1976, table I: five digits
    assert column.wind_N_mps[3] == pytest.approx([0.0, 10.0, 0.0], abs=1e-9)
    assert column.altitude_m[0] <= 0.0
