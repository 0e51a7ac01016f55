"""Wind has the signs, profile and gust shapes of its definitions."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pydantic import ValidationError

from maxq.control.kernel.records import pack
from maxq.control.kernel.tables import Pool, fit
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.packing.environment import pack_wind
from maxq.sim.scenario import schema_environment as schema
from maxq.sim.world.wind import Wind, wind_components, wind_ned

MAX_GUSTS = 16

NO_POOL = np.zeros(1)


def profiled(altitude, columns, **more):
    pool = Pool()
    pool.add(fit([0.0, 1.0], [5.0, 6.0]))  # another table first: the reference must be honoured
    ref = pool.add(fit(altitude, columns, "linear"))
    return pack([Wind(ref, **more)])[0], pool.array()


def shear(altitude_m, thickness_m, speed_mps, from_deg):
    return schema.Gust(
        kind="shear", altitude_m=altitude_m, thickness_m=thickness_m, speed_mps=speed_mps, from_deg=from_deg
    )


def one_minus_cosine(altitude_m, thickness_m, speed_mps, from_deg, edge_m):
    return schema.Gust(
        kind="one-minus-cosine",
        altitude_m=altitude_m,
        thickness_m=thickness_m,
        speed_mps=speed_mps,
        from_deg=from_deg,
        edge_m=edge_m,
    )


def gusty(*gusts):
    return pack([pack_wind(schema.WindSection(gust=gusts), Pool(), 0.0)])[0]


@pytest.mark.parametrize(
    ("from_deg", "north", "east"),
    [(0, -1, 0), (90, 0, -1), (180, 1, 0), (270, 0, 1), (630, 0, 1), (225, 0.5**0.5, 0.5**0.5)],
)
def test_wind_blows_from_its_direction(from_deg, north, east):
    assert wind_components(10.0, from_deg)[0] == pytest.approx([10 * north, 10 * east, 0.0], abs=1e-13)


def test_components_do_not_spin_through_south_at_north():
    """Half-way between 350 and 10 degrees the wind is northerly; interpolated directions would give a southerly."""
    row, pool = profiled([0.0, 1000.0], wind_components([10.0, 10.0], [350.0, 10.0]))
    north, east, _ = wind_ned(row, pool, 500.0)
    assert north == pytest.approx(-10.0 * math.cos(math.radians(10.0)))
    assert east == pytest.approx(0.0, abs=1e-13)


def test_profile_is_interpolated_held_and_scaled():
    row, pool = profiled([1e3, 2e3], [[10.0, -4.0, 1.0], [20.0, 4.0, 3.0]], factor=2.0)
    assert wind_ned(row, pool, 1250.0) == pytest.approx((25.0, -4.0, 3.0))
    assert wind_ned(row, pool, 0.0) == (20.0, -8.0, 2.0)
    assert wind_ned(row, pool, 9e4) == (40.0, 8.0, 6.0)


@pytest.mark.parametrize("turn_deg", [90.0, 137.0, -45.0])
def test_a_turned_profile_blows_from_a_turned_direction(turn_deg):
    def packed(directions, **more):
        table = CsvTable("", {"altitude_m": levels, "speed_mps": np.array([5.0, 20.0, 12.0]), "from_deg": directions})
        pool = Pool()
        wind = pack([pack_wind(schema.WindSection(profile=table, **more), pool, 0.0)])[0]
        return [wind_ned(wind, pool.array(), altitude) for altitude in (0.0, 400.0, 2000.0)]

    levels, directions = np.array([0.0, 1000.0, 2000.0]), np.array([330.0, 20.0, 180.0])
    turned = packed(directions, turn_deg=turn_deg)
    assert np.allclose(turned, packed((directions + turn_deg) % 360.0), rtol=0, atol=1e-12)


def test_factor_leaves_the_gusts_alone():
    pool = Pool()
    wind = schema.WindSection(speed_mps=10.0, from_deg=180.0, factor=3.0, gust=(shear(0.0, 1.0, 7.0, 180.0),))
    row = pack([pack_wind(wind, pool, 0.0)])[0]
    assert wind_ned(row, pool.array(), 500.0) == pytest.approx((37.0, 0.0, 0.0), abs=1e-12)


def test_calm():
    assert wind_ned(pack([Wind()])[0], NO_POOL, 1e4) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("altitude", "share"),
    [
        (9999.0, 0.0),
        (10000.0, 0.0),
        (10010.0, 0.5 * (1 - math.cos(math.pi / 3))),
        (10015.0, 0.5),
        (10030.0, 1.0),
        (10100.0, 1.0),
        (10170.0, 1.0),
        (10180.0, 0.5 * (1 + math.cos(math.pi / 3))),
        (10185.0, 0.5),
        (10200.0, 0.0),
        (10300.0, 0.0),
    ],
)
def test_one_minus_cosine(altitude, share):
    row = gusty(one_minus_cosine(10000.0, 200.0, 9.0, 270.0, edge_m=30.0))
    assert wind_ned(row, NO_POOL, altitude) == pytest.approx((0.0, 9.0 * share, 0.0), abs=1e-12)


@pytest.mark.parametrize("corner", [10000.0, 10030.0, 10170.0, 10200.0])
def test_one_minus_cosine_is_smooth_at_its_corners(corner):
    row = gusty(one_minus_cosine(10000.0, 200.0, 9.0, 270.0, edge_m=30.0))
    below, at, above = (wind_ned(row, NO_POOL, corner + d)[1] for d in (-1e-3, 0.0, 1e-3))
    assert abs(above - at) + abs(at - below) < 1e-7  # a kink of the ramp's mean slope would give 3e-4


def test_shear_ramps_and_holds():
    row = gusty(shear(9000.0, 1000.0, 20.0, 0.0))
    for altitude, speed in [(8999.0, 0.0), (9000.0, 0.0), (9250.0, 5.0), (10000.0, 20.0), (40000.0, 20.0)]:
        assert wind_ned(row, NO_POOL, altitude) == pytest.approx((-speed, 0.0, 0.0), abs=1e-12)


def test_gusts_add_up_to_the_last_one():
    row = gusty(*[shear(100.0 * i, 10.0, 1.0, 180.0) for i in range(MAX_GUSTS)])
    assert wind_ned(row, NO_POOL, 5000.0)[0] == pytest.approx(float(MAX_GUSTS))
    assert wind_ned(row, NO_POOL, 450.0)[0] == pytest.approx(5.0)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValidationError, match=f"at most {MAX_GUSTS}"):
        gusty(*[shear(0.0, 1.0, 1.0, 0.0)] * (MAX_GUSTS + 1))
    with pytest.raises(ValidationError, match="thickness"):
        shear(0.0, 0.0, 1.0, 0.0)
    with pytest.raises(ValidationError, match="edge"):
        one_minus_cosine(0.0, 100.0, 1.0, 0.0, edge_m=51.0)
    with pytest.raises(ValidationError, match="kind"):
        schema.Gust(kind="ramp", altitude_m=0.0, thickness_m=1.0, speed_mps=1.0, from_deg=0.0)
