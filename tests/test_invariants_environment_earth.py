"""Positions on every Earth have round trips and orthonormal axes, including singular places."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maxq.control.kernel.records import pack
from maxq.sim.world.earth import (
    earth_position,
    earth_rotation,
    earth_to_ned,
    flat,
    geodetic,
    gravitation,
    ground_velocity,
    inertial_to_earth,
    local_frame,
    ned_axes,
    ned_to_earth,
    sphere,
    wgs84,
)

FLAT, SPHERE, ELLIPSOID = 0, 1, 2  # figure of an Earth
NO_GRAVITY, UNIFORM, J2 = 0, 1, 3  # gravity of an Earth

EARTHS = {"wgs84": wgs84(), "sphere": sphere(), "flat": flat()}
ROWS = {name: pack([earth])[0] for name, earth in EARTHS.items()}
ROUND = [ROWS["wgs84"], ROWS["sphere"]]

latitudes = st.floats(-math.pi / 2, math.pi / 2)
longitudes = st.floats(-math.pi, math.pi)
altitudes = st.floats(-10e3, 1000e3)


@pytest.mark.parametrize("earth", ROUND)
@settings(deadline=None)  # the first example compiles the kernels
@given(latitude=latitudes, longitude=longitudes, altitude=altitudes)
def test_geodetic_round_trip(earth, latitude, longitude, altitude):
    position = earth_position(earth, latitude, longitude, altitude)
    got = geodetic(earth, *position)
    assert np.linalg.norm(np.subtract(earth_position(earth, *got), position)) < 6e-9
    assert got[0] == pytest.approx(latitude, abs=1e-15)
    assert got[2] == pytest.approx(altitude, abs=5e-9)
    if abs(latitude) < 1.5:
        assert got[1] == pytest.approx(longitude, abs=1e-15)


@pytest.mark.parametrize("earth", ROUND)
@settings(deadline=None)  # the first example compiles the kernels
@given(latitude=latitudes, longitude=longitudes, altitude=altitudes)
def test_local_frame_and_geodetic_agree(earth, latitude, longitude, altitude):
    position = earth_position(earth, latitude, longitude, altitude)
    lat, lon, h = geodetic(earth, *position)
    fast_h, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, *position)
    assert fast_h == pytest.approx(h, abs=3e-9)
    assert (sin_lat, cos_lat) == pytest.approx((math.sin(lat), math.cos(lat)), abs=3e-13)
    assert (sin_lon, cos_lon) == pytest.approx((math.sin(lon), math.cos(lon)), abs=5e-16)
    assert cos_lat >= 0.0


@pytest.mark.parametrize("name", EARTHS)
@settings(deadline=None)  # the first example compiles the kernels
@given(x=st.floats(-1e7, 1e7), y=st.floats(-1e7, 1e7), z=st.floats(-1e7, 1e7))
def test_ned_axes_are_a_right_handed_set_everywhere(name, x, y, z):
    """The axes are right-handed everywhere, including the centre of the Earth, where latitude is a convention."""
    _, *frame = local_frame(ROWS[name], x, y, z)
    axes = np.array(ned_axes(*frame)).reshape(3, 3)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0, abs=1e-14)
    assert np.isfinite(geodetic(ROWS[name], x, y, z)).all()


def test_ned_conversions_are_the_axes():
    frame = local_frame(ROWS["wgs84"], 3e6, -4e6, 4e6)[1:]
    axes = np.array(ned_axes(*frame)).reshape(3, 3)
    vector = np.array([1.0, -2.0, 3.0])
    assert earth_to_ned(*frame, *vector) == pytest.approx(tuple(axes @ vector), abs=1e-15)
    assert ned_to_earth(*frame, *vector) == pytest.approx(tuple(axes.T @ vector), abs=1e-15)


def test_ned_axes_point_north_east_and_down():
    """At 0 N 90 E, north is z, east is -x and down is -y; each sign depends on its axis."""
    frame = local_frame(ROWS["wgs84"], 0.0, 6.4e6, 0.0)[1:]
    assert ned_axes(*frame) == pytest.approx((0, 0, 1, -1, 0, 0, 0, -1, 0), abs=1e-15)


def test_axes_are_the_derivatives_of_position():
    earth, lat, lon, h = ROWS["wgs84"], 0.64, 2.2, 12e3
    frame = local_frame(earth, *earth_position(earth, lat, lon, h))[1:]
    north, east, down = np.array(ned_axes(*frame)).reshape(3, 3)
    step = 1e-5

    def slope(d_lat: float, d_lon: float, d_h: float) -> np.ndarray:
        ahead = earth_position(earth, lat + step * d_lat, lon + step * d_lon, h + 1e6 * step * d_h)
        behind = earth_position(earth, lat - step * d_lat, lon - step * d_lon, h - 1e6 * step * d_h)
        difference = np.subtract(ahead, behind)
        return difference / np.linalg.norm(difference)

    assert slope(1, 0, 0) == pytest.approx(north, abs=1e-9)
    assert slope(0, 1, 0) == pytest.approx(east, abs=1e-9)
    assert slope(0, 0, -1) == pytest.approx(down, abs=1e-9)


@pytest.mark.parametrize("earth", ROUND)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_poles(earth, sign):
    polar = earth.equatorial_radius_m * (1.0 - earth.flattening)
    latitude, longitude, altitude = geodetic(earth, 0.0, 0.0, sign * (polar + 5e3))
    assert latitude == sign * math.pi / 2
    assert longitude == 0.0
    assert altitude == pytest.approx(5e3, abs=2e-9)
    assert local_frame(earth, 0.0, 0.0, sign * (polar + 5e3))[1:] == pytest.approx((sign, 0, 0, 1), abs=1e-15)


def test_date_line():
    earth = ROWS["wgs84"]
    assert geodetic(earth, -6.4e6, 0.0, 1e6)[1] == math.pi
    assert geodetic(earth, -6.4e6, -1e-3, 1e6)[1] == pytest.approx(-math.pi, abs=1e-9)
    here, beyond = (np.array(local_frame(earth, -6.4e6, y, 1e6)) for y in (1e-3, -1e-3))
    assert here == pytest.approx(beyond, abs=1e-8)  # continuous where the longitude jumps


@pytest.mark.parametrize("earth", ROUND)
def test_centre_is_finite(earth):
    assert geodetic(earth, 0.0, 0.0, 0.0) == (0.0, 0.0, -earth.equatorial_radius_m)
    assert np.isfinite(gravitation(earth, 0.0, 0.0, 0.0)).all()


@pytest.mark.parametrize("shape", EARTHS)
@settings(deadline=None)  # the first example compiles the kernels
@given(angle=st.floats(-10, 10), z=st.floats(-7e6, 7e6))
def test_rotation_about_the_pole_changes_neither_altitude_nor_gravity(shape, angle, z):
    earth = ROWS[shape]
    cos, sin = math.cos(angle), math.sin(angle)
    here, turned = (5e6, 1e6, z), inertial_to_earth(cos, sin, 5e6, 1e6, z)
    assert local_frame(earth, *turned)[:3] == pytest.approx(local_frame(earth, *here)[:3], abs=1e-8)
    expected = inertial_to_earth(cos, sin, *gravitation(earth, *here))
    if shape != "flat":
        rounding = 16 * np.finfo(float).eps * np.linalg.norm(expected)  # of the turns and of r to the fourth power
        assert gravitation(earth, *turned) == pytest.approx(expected, abs=rounding)


def test_inertial_positions_give_inertial_axes():
    """The axes of a position in I are the axes of E turned into I, also in the fast path."""
    earth = ROWS["wgs84"]
    cos, sin = earth_rotation(earth, 5000.0)
    in_e = (-3e6, 4e6, 4e6)
    in_i = inertial_to_earth(cos, -sin, *in_e)  # back by the negative angle
    from_e = ned_to_earth(*local_frame(earth, *in_e)[1:], 7.0, 8.0, 9.0)
    from_i = ned_to_earth(*local_frame(earth, *in_i)[1:], 7.0, 8.0, 9.0)
    assert inertial_to_earth(cos, -sin, *from_e) == pytest.approx(from_i, abs=1e-13)


def test_earth_turns_eastward_at_its_rate():
    earth = ROWS["wgs84"]
    quarter = 0.5 * math.pi / earth.rate_radps
    x, y, z = inertial_to_earth(*earth_rotation(earth, -quarter), 1.0, 0.0, 5.0)
    assert (x, y, z) == pytest.approx((0.0, 1.0, 5.0), abs=1e-12)
    assert inertial_to_earth(*earth_rotation(earth, quarter), x, y, z) == pytest.approx((1, 0, 5), abs=1e-15)
    ahead = inertial_to_earth(*earth_rotation(earth, -0.5), 6e6, 1e6, 0.0)
    behind = inertial_to_earth(*earth_rotation(earth, 0.5), 6e6, 1e6, 0.0)
    assert ground_velocity(earth, 6e6, 1e6) == pytest.approx(tuple(np.subtract(ahead, behind)), abs=1e-6)
    assert earth_rotation(pack([wgs84(rate_radps=0.0)])[0], 1e4) == (1.0, 0.0)


def test_flat_earth_is_its_own_ned():
    earth = ROWS["flat"]
    assert gravitation(earth, 1e3, 2e3, -3e3) == (0.0, 0.0, 9.80665)
    assert geodetic(earth, 1e3, 2e3, -3e3) == (0.0, 0.0, 3e3)
    assert earth_position(earth, 0.3, 0.4, 3e3) == (0.0, 0.0, -3e3)
    frame = local_frame(earth, 1e3, 2e3, -3e3)
    assert frame[0] == 3e3
    assert np.array_equal(np.array(ned_axes(*frame[1:])).reshape(3, 3), np.eye(3))
    assert ned_to_earth(*frame[1:], 1.0, 2.0, 3.0) == (1.0, 2.0, 3.0)
    assert ground_velocity(earth, 1e3, 2e3) == (0.0, 0.0, 0.0)


def test_uniform_and_no_gravity_on_a_round_earth():
    uniform = gravitation(pack([sphere(gravity=UNIFORM, uniform_mps2=9.0)])[0], 3e6, 0.0, -4e6)
    assert uniform == pytest.approx((-5.4, 0.0, 7.2), rel=1e-14)
    assert gravitation(pack([wgs84(gravity=NO_GRAVITY)])[0], 6e6, 0.0, 0.0) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"figure": FLAT, "gravity": J2, "rate_radps": 0.0}, "uniform or none"),
        ({"figure": FLAT, "gravity": UNIFORM}, "does not rotate"),
        ({"figure": SPHERE}, "no flattening"),
        ({"figure": ELLIPSOID, "flattening": 0.2}, "outside"),
        ({"figure": 7}, "figure"),
        ({"gravity": 9}, "gravity"),
        ({"mu_m3ps2": 0.0}, "positive"),
    ],
)
def test_meaningless_earths_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        wgs84(**values)
