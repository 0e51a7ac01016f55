"""The metrics of the impact point against closed forms on equator and meridians, and against the log of a flight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

import maxq
from maxq.control.kernel.limits import MAX_TRAIL
from maxq.control.kernel.records import Array
from maxq.sim.flight.metric_table import ImpactMetrics
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.run.metrics import geodesic_m
from maxq.sim.run.range_safety import impact_metrics
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.scenario.schema_launch import RangeSafety
from maxq.sim.world.earth import wgs84

EARTH = replace(wgs84(), rate_radps=0.0)
A, E2 = EARTH.equatorial_radius_m, EARTH.flattening * (2.0 - EARTH.flattening)
SITE = Site(latitude_deg=0.0, longitude_deg=0.0, azimuth_deg=90.0)
SQUARE = ((-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0))


def metrics_of(*places_deg: tuple[float, float], site: Site = SITE, **given: object) -> tuple[Array, Array]:
    """Return the metrics of points on the ground, which are their own impact points, and their times 0, 1, ... s."""
    latitude, longitude = np.radians(np.array(places_deg)).T
    normal = A / np.sqrt(1.0 - E2 * np.sin(latitude) ** 2) - 1e-3  # 1 mm below the ground
    across = normal * np.cos(latitude)
    r = np.stack([across * np.cos(longitude), across * np.sin(longitude), (1.0 - E2) * normal * np.sin(latitude)], 1)
    found, at_s = impact_metrics(
        EARTH, site, RangeSafety.model_validate(given), np.arange(len(r), dtype=float), r, np.zeros_like(r) + 1.0
    )
    return np.array(found), np.array(at_s)


def meridian_m(start_deg: float, end_deg: float) -> float:
    """Return the length of a meridian by quadrature of its radius of curvature."""
    return quad(lambda x: A * (1.0 - E2) / (1.0 - E2 * math.sin(x) ** 2) ** 1.5, *np.radians([start_deg, end_deg]))[0]


def test_range_and_cross_range_are_the_lengths_of_equator_and_meridian() -> None:
    found, at_s = metrics_of((0.0, 0.1), (0.0, 12.0), (-0.7, 0.0), (0.3, 5.0))
    assert found[0] == pytest.approx(A * math.radians(12.0), abs=0.01)
    assert found[1] == pytest.approx(meridian_m(0.0, 0.7), abs=0.01)
    assert math.isnan(found[2])
    assert at_s[:2].tolist() == [1.0, 2.0]
    assert math.isnan(at_s[2])
    north, _ = metrics_of((3.0, 0.25), azimuth_deg=0.0)  # to the nearest point of the meridian, not along the parallel
    parallel_m = A / math.sqrt(1.0 - E2 * math.sin(math.radians(3.0)) ** 2) * math.cos(math.radians(3.0))
    assert north[1] == pytest.approx(parallel_m * math.radians(0.25), rel=1e-5)


@pytest.mark.parametrize(
    ("place", "wanted_m"),
    [
        ((0.0, 1.5), A * math.radians(0.5)),
        ((0.0, 0.25), -A * math.radians(0.75)),
        ((0.0, -1.0001), A * math.radians(0.0001)),
        ((0.0, 80.0), A * math.radians(79.0)),
    ],
)
@pytest.mark.parametrize("turn", [1, -1])
def test_the_excursion_is_the_distance_to_the_nearest_edge(
    place: tuple[float, float], wanted_m: float, turn: int
) -> None:
    found, at_s = metrics_of((0.0, 0.0), place, zone=SQUARE[::turn])
    assert found[2] == pytest.approx(wanted_m, abs=0.5)
    assert at_s[2] == 1.0


def test_corners_notches_and_the_antimeridian() -> None:
    assert metrics_of((0.0, 179.9), zone=SQUARE)[0][2] > 19e6  # the antipode of an inside point is not inside
    corner, _ = metrics_of((1.5, 1.0), zone=SQUARE)
    assert corner[2] == pytest.approx(meridian_m(1.0, 1.5), abs=0.01)
    notched = ((-1.0, -1.0), (-1.0, 1.0), (0.0, 0.2), (1.0, 1.0), (1.0, -1.0))
    notch, _ = metrics_of((0.0, 0.5), zone=notched)
    assert 0.0 < notch[2] < A * math.radians(0.3)
    ring = ((-1.0, 179.0), (-1.0, -179.0), (1.0, -179.0), (1.0, 179.0))
    across, _ = metrics_of((0.0, -179.5), site=SITE.model_copy(update={"longitude_deg": 179.0}), zone=ring)
    assert across[2] == pytest.approx(-A * math.radians(0.5), abs=0.5)
    assert across[0] == pytest.approx(A * math.radians(1.5), abs=0.01)


def test_a_flight_has_the_metrics_of_its_log_and_no_other_state() -> None:
    """Its trail is full after 51.1 s, and is then kept every 0.2 s. The flight itself does not change."""
    given = "range_safety={azimuth_deg=200.0, zone=[[34.0, 126.0], [34.0, 127.0], [36.0, 127.0], [36.0, 126.0]]}"
    run = ["run.duration_s=60", "run.step_s=0.005"]
    plain, scenario = load_scenario("checkcases/two-stage", run), load_scenario("checkcases/two-stage", [*run, given])
    flight, unlogged = fly(scenario), fly(scenario, log=False)  # in one segment, as in a campaign
    assert flight.state_hash == fly(plain, log=False).state_hash
    for name in ImpactMetrics._fields:
        assert unlogged.metrics[name] == flight.metrics[name]
        assert unlogged.metric_times_s[name] == flight.metric_times_s[name]
    log = maxq.impacts(flight)
    time_s = log.time_s("impact_latitude_deg")
    kept = np.isclose(np.mod(time_s + 1e-9, 0.2), 0.0, atol=1e-6)
    assert MAX_TRAIL < 10 * 60
    site, earth = scenario.scenario.site, log.earth
    start = math.radians(site.latitude_deg), math.radians(site.longitude_deg)
    points = np.radians(np.stack([log["impact_latitude_deg"], log["impact_longitude_deg"]], 1)[kept])
    ranges_m = [geodesic_m(earth.equatorial_radius_m, earth.flattening, start, tuple(p)) for p in points.tolist()]
    assert flight.metrics["max_impact_range_m"] == pytest.approx(max(ranges_m), abs=1e-3)
    assert flight.metric_times_s["max_impact_range_m"] == pytest.approx(time_s[kept][np.argmax(ranges_m)], abs=1e-9)
    latitude, longitude = np.degrees(points).T
    east_m = 111.4e3 * np.cos(points[:, 0])  # per degree
    to_edges_m = [(latitude - 34.0) * 110.93e3, (36.0 - latitude) * 110.93e3]
    to_edges_m += [(longitude - 126.0) * east_m, (127.0 - longitude) * east_m]
    assert flight.metrics["max_impact_excursion_m"] == pytest.approx(-np.min(to_edges_m), rel=5e-3)


@pytest.mark.parametrize(
    ("overrides", "key", "problem"),
    [
        (["requirement=[{metric='max_impact_range_m', limit=1e5}]"], "requirement.0.metric", "[range_safety]"),
        (
            ["requirement=[{metric='max_impact_excursion_m', limit=0.0}]", "range_safety={}"],
            "requirement.0.metric",
            "range_safety.zone",
        ),
        (["range_safety={zone=[[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]}"], "range_safety.zone", "twice"),
        (["range_safety={zone=[[0.0, 0.0], [1.0, 0.0]]}"], "range_safety.zone", "too few"),
        (
            ["earth={shape='flat', gravity='uniform', rotating=false}", "range_safety={}"],
            "range_safety",
            "no impact point",
        ),
    ],
)
def test_impossible_requirements_are_rejected(overrides: list[str], key: str, problem: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario("checkcases/two-stage", overrides)
    assert key in str(error.value)
    assert problem in str(error.value)
