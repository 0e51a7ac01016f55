"""Local frame and air by series about a place equal the exact formulas, and are used only within their range."""

import math

import numpy as np
import pytest

from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import blank, pack
from maxq.control.kernel.tables import Pool
from maxq.sim.vehicle import environment
from maxq.sim.vehicle.environment import ANCHOR_DUE, ANCHOR_SET, NO_ANCHOR, Anchor, NEAR_m
from maxq.sim.world.atmosphere import Atmosphere, air
from maxq.sim.world.earth import earth_position, flat, local_frame, sphere, wgs84
from maxq.sim.world.thermosphere import upper_air

VACUUM, US1976 = 0, 1  # model of an atmosphere
TOP_m = 86000.0  # of the closed formulas

frame_and_air = from_python(environment.frame_and_air)
_pool = Pool()
AIR = pack([Atmosphere(US1976, table=_pool.add(upper_air()), density_factor=1.1)])[0]
POOL = _pool.array()
WGS84 = pack([wgs84()])[0]
# geopotential bases of the standard's layers in geometric metres: series may not cross them
EDGES_m = [6356766.0 * h / (6356766.0 - h) for h in (11e3, 20e3, 32e3, 47e3, 51e3, 71e3)] + [TOP_m]


def anchored(earth, atmosphere, place):
    anchor = blank(Anchor)[0]
    anchor.state = ANCHOR_DUE
    frame_and_air(earth, atmosphere, POOL, *place, anchor)
    return anchor


def exact(earth, atmosphere, place):
    frame = local_frame(earth, *place)
    return np.array(frame), np.array(air(atmosphere, POOL, frame[0]))


@pytest.mark.parametrize("earth", [wgs84(), sphere()], ids=["ellipsoid", "sphere"])
@pytest.mark.parametrize("distance_m", [1.0, 0.99 * NEAR_m])
def test_a_neighbour_is_where_the_exact_formulas_have_it(earth, distance_m):
    earth = pack([earth])[0]
    rng = np.random.default_rng(1)
    steps = distance_m / NEAR_m
    for _ in range(300):
        latitude, longitude = math.radians(rng.uniform(-84, 84)), rng.uniform(-math.pi, math.pi)
        place = np.array(earth_position(earth, latitude, longitude, rng.uniform(0.0, 84e3)))
        direction = rng.normal(size=3)
        there = place + distance_m * direction / np.linalg.norm(direction)
        anchor = anchored(earth, AIR, place)
        assert anchor.state == ANCHOR_SET
        frame, gas = frame_and_air(earth, AIR, POOL, *there, anchor)
        frame_there, gas_there = exact(earth, AIR, there)
        # rounding of the exact altitude, and the third powers
        assert abs(frame[0] - frame_there[0]) < 5e-9
        # squares of the turn, which grow towards the poles
        assert np.abs(np.array(frame[1:]) - frame_there[1:]).max() < 1e-15 + 2e-10 * steps**2
        assert np.abs(np.array(gas) / gas_there - 1.0).max() < 2e-12


def test_the_series_is_used_at_all():
    """The series is used, so that the test above does not compare the exact formulas with themselves."""
    place = np.array(earth_position(WGS84, 0.6, 2.2, 5000.0))
    anchor = anchored(WGS84, AIR, place)
    there = place + np.array([3.0, 4.0, 5.0])
    near, far = frame_and_air(WGS84, AIR, POOL, *there, anchor)[0], exact(WGS84, AIR, there)[0]
    assert near[1] != far[1]
    beyond = place + np.array([0.0, 0.0, 1.01 * NEAR_m])
    assert frame_and_air(WGS84, AIR, POOL, *beyond, anchor)[0] == tuple(exact(WGS84, AIR, beyond)[0])


@pytest.mark.parametrize("edge_m", EDGES_m)
def test_no_series_reaches_into_another_layer(edge_m):
    for below_m, rise_m in ((2.0, 4.0), (-2.0, -4.0), (2.0, 1.0), (-2.0, -1.0)):
        latitude, longitude = 0.6, 2.2
        place = np.array(earth_position(WGS84, latitude, longitude, edge_m - below_m))
        there = np.array(earth_position(WGS84, latitude, longitude, edge_m - below_m + rise_m))
        anchor = anchored(WGS84, AIR, place)
        _, gas = frame_and_air(WGS84, AIR, POOL, *there, anchor)
        assert np.abs(np.array(gas) / exact(WGS84, AIR, there)[1] - 1.0).max() < 1e-11


def test_what_is_not_near_anything_is_exact():
    flat_earth = pack([flat()])[0]
    assert anchored(flat_earth, AIR, (10.0, 20.0, -3000.0)).state == NO_ANCHOR
    pole = earth_position(WGS84, math.radians(88.0), 0.3, 1000.0)
    assert anchored(WGS84, AIR, pole).state == NO_ANCHOR
    place = earth_position(WGS84, 0.6, 2.2, 5000.0)
    anchor = blank(Anchor)[0]  # nobody has dropped an anchor
    frame, gas = frame_and_air(WGS84, AIR, POOL, *place, anchor)
    assert anchor.state == NO_ANCHOR
    assert frame == tuple(exact(WGS84, AIR, place)[0])
    assert gas == tuple(exact(WGS84, AIR, place)[1])


def test_other_atmospheres_are_not_continued():
    vacuum = pack([Atmosphere(VACUUM)])[0]
    place = np.array(earth_position(WGS84, 0.6, 2.2, 5000.0))
    anchor = anchored(WGS84, vacuum, place)
    _, gas = frame_and_air(WGS84, vacuum, POOL, *(place + 1.0), anchor)
    assert gas[0] == 0.0


def test_a_place_that_is_no_number_is_not_near():
    anchor = anchored(WGS84, AIR, earth_position(WGS84, 0.6, 2.2, 5000.0))
    frame, _ = frame_and_air(WGS84, AIR, POOL, math.nan, 0.0, 0.0, anchor)
    assert math.isnan(frame[0])
