"""The distance along the ground equals published geodesics and the great circle."""

from __future__ import annotations

import math

import pytest
from scipy.integrate import quad

from maxq.sim.run.fly import fly
from maxq.sim.run.metrics import geodesic_m
from maxq.sim.scenario.loader import load_scenario

WGS84 = (6378137.0, 1.0 / 298.257223563)


def between(a: tuple[float, float], b: tuple[float, float], ellipsoid: tuple[float, float] = WGS84) -> float:
    start, end = ((math.radians(x), math.radians(y)) for x, y in (a, b))
    return geodesic_m(*ellipsoid, start, end)


def dms(degrees: int, minutes: int, seconds: float) -> float:
    return degrees + minutes / 60.0 + seconds / 3600.0


def test_flinders_peak_to_buninyong() -> None:
    """The distance is 54972.271 m on GRS 80 (Geoscience Australia, GDA technical manual, chapter 4)."""
    flinders = (-dms(37, 57, 3.72030), dms(144, 25, 29.52440))
    buninyong = (-dms(37, 39, 10.15610), dms(143, 55, 35.38390))
    grs80 = (6378137.0, 1.0 / 298.257222101)
    assert between(flinders, buninyong, grs80) == pytest.approx(54972.271, abs=5e-4)


def test_quarter_of_the_meridian_and_of_the_equator() -> None:
    """The distance from equator to pole is 10001965.729 m on WGS-84 (NIMA TR8350.2: 10001965.7293 m)."""
    assert between((0.0, 20.0), (90.0, 20.0)) == pytest.approx(10001965.7293, abs=1e-3)
    assert between((0.0, 170.0), (0.0, -100.0)) == pytest.approx(0.5 * math.pi * WGS84[0], abs=1e-3)


def test_on_a_sphere_it_is_the_great_circle() -> None:
    sphere = (6371000.0, 0.0)
    a, b = (36.7, 126.47), (-12.0, -170.0)
    s, t = math.radians(a[0]), math.radians(b[0])
    cosine = math.sin(s) * math.sin(t) + math.cos(s) * math.cos(t) * math.cos(math.radians(b[1] - a[1]))
    assert between(a, b, sphere) == pytest.approx(6371000.0 * math.acos(cosine), rel=1e-12)


def test_places_without_a_way() -> None:
    assert between((12.0, 34.0), (12.0, 34.0)) == 0.0
    assert between((12.0, 180.0), (12.0, -180.0)) == 0.0
    assert math.isnan(between((0.5, 0.0), (-0.4, 179.7)))
    assert math.isnan(between((0.0, 0.0), (math.nan, 0.0)))


def test_a_flight_time_counts_from_lift_off_and_the_range_from_the_site() -> None:
    flight = fly(load_scenario("nominal", ["run.duration_s=40.0", "run.step_s=0.002"]), log=False)
    assert flight.metrics["flight_time_s"] == pytest.approx(40.0 - flight.event_s("liftoff"), abs=1e-9)
    end = flight.final["latitude_deg"], flight.final["longitude_deg"]
    assert flight.metrics["range_m"] == pytest.approx(between((36.70, 126.47), end), abs=1e-6)
    assert 500.0 < flight.metrics["range_m"] < 20000.0
    assert flight.metrics["final_speed_mps"] == flight.final["speed_mps"]


def test_on_a_flat_earth_the_range_is_the_horizontal_distance() -> None:
    flat = ["earth.shape=flat", "earth.rotating=false", "earth.gravity=uniform"]
    flight = fly(load_scenario("nominal", ["run.duration_s=20.0", "run.step_s=0.002", *flat]), log=False)
    x, y = flight.final["r_E_x_m"], flight.final["r_E_y_m"]
    assert flight.metrics["range_m"] == pytest.approx(math.hypot(x, y), rel=1e-12)
    assert math.isnan(flight.metrics["final_latitude_deg"])


@pytest.mark.parametrize("site_m", [0.0, -12.5])
def test_a_vehicle_that_leaves_a_pad_at_ground_level_has_not_come_down(site_m: float) -> None:
    """On a pad that moves with the Earth, a nanometre of rounding is neither a flight nor, on return, an impact."""
    flight = fly(load_scenario("nominal", [f"site.altitude_m={site_m}", "run.duration_s=2.0"]), log=False)
    assert [e.name for e in flight.events if e.name in ("liftoff", "impact")] == ["liftoff"]


@pytest.mark.parametrize("latitude_deg", [20.0, 45.0, 70.0])
def test_arcs_of_the_meridian_are_their_integrals(latitude_deg: float) -> None:
    """To 0.2 mm, a hundredth of the effect of Vincenty's third-order terms; the curvature is integrated by SciPy."""
    radius_m, flattening = 6378137.0, 1.0 / 298.257223563
    e2, end = flattening * (2.0 - flattening), math.radians(latitude_deg)
    arc = quad(lambda u: radius_m * (1.0 - e2) / (1.0 - e2 * math.sin(u) ** 2) ** 1.5, 0.0, end, epsabs=1e-7)[0]
    assert geodesic_m(radius_m, flattening, (0.0, 0.3), (end, 0.3)) == pytest.approx(arc, rel=0.0, abs=2e-4)
