"""The Earth's kernels equal 40-digit geodesy, the gradient of the potential, and sums over many masses."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from maxq.control.kernel.records import pack
from maxq.sim.world.earth import (
    earth_position,
    flat,
    geodetic,
    gravitation,
    gravity_gradient_torque,
    local_frame,
    sphere,
    wgs84,
)

NO_GRAVITY, UNIFORM, INVERSE_SQUARE, J2 = 0, 1, 2, 3  # gravity of an Earth

FT = 0.3048


def record(earth):
    return pack([earth])[0]


def error(got, exact: mpmath.mpf) -> float:
    """Return got - exact in 40 digits; a NumPy scalar would round the oracle to a double first."""
    with mpmath.workdps(40):
        return float(mpmath.mpf(float(got)) - exact)


def exact_geodetic(a: float, f: float, p: float, z: float) -> tuple[mpmath.mpf, mpmath.mpf]:
    """Return the latitude and altitude of (p, z) by Newton's method on the foot of the normal, in 40 digits."""
    with mpmath.workdps(40):
        a, f, p, z = map(mpmath.mpf, (a, f, p, z))
        e2 = f * (2 - f)

        def miss(latitude):
            normal = a / mpmath.sqrt(1 - e2 * mpmath.sin(latitude) ** 2)
            return p * mpmath.sin(latitude) - (z + e2 * normal * mpmath.sin(latitude)) * mpmath.cos(latitude)

        latitude = mpmath.findroot(miss, mpmath.atan2(z, p * (1 - e2)))
        sin, cos = mpmath.sin(latitude), mpmath.cos(latitude)
        return latitude, p * cos + z * sin - a * mpmath.sqrt(1 - e2 * sin**2)


LATITUDES = np.deg2rad([-90.0, -89.9999999, -60.0, -1e-7, 0.0, 1e-9, 12.3, 36.7, 45.0, 71.0, 89.99, 90.0])


@pytest.mark.parametrize("altitude", [-10e3, 0.0, 30.0, 42e3, 300e3, 1000e3])
@pytest.mark.parametrize("latitude", LATITUDES)
def test_geodetic_matches_forty_digits(latitude, altitude):
    earth = record(wgs84())
    x, y, z = earth_position(earth, latitude, 2.2, altitude)
    # The position in the meridian plane as a double, so that the oracle sees the very same point.
    p = math.hypot(x, y)
    exact_latitude, exact_altitude = exact_geodetic(earth.equatorial_radius_m, earth.flattening, p, z)
    got_latitude, got_longitude, got_altitude = geodetic(earth, p, 0.0, z)
    assert got_longitude == 0.0
    assert abs(error(got_latitude, exact_latitude)) < 4e-16
    assert abs(error(got_altitude, exact_altitude)) < 3.5e-9  # rounding: 3 units in the last place of 7e6 m

    fast_altitude, sin, cos, _, _ = local_frame(earth, p, 0.0, z)
    assert abs(error(fast_altitude, exact_altitude)) < 3.5e-9
    assert abs(error(math.atan2(sin, cos), exact_latitude)) < 3e-13


def test_high_orbit_stays_accurate():
    earth = record(wgs84())
    for latitude in (0.3, 1.2):
        x, _, z = earth_position(earth, latitude, 0.0, 4.0e7)
        exact_latitude, exact_altitude = exact_geodetic(earth.equatorial_radius_m, earth.flattening, x, z)
        altitude, sin, cos, _, _ = local_frame(earth, x, 0.0, z)
        assert abs(error(altitude, exact_altitude)) < 2.5e-8
        assert abs(error(math.atan2(sin, cos), exact_latitude)) < 3e-13


def test_another_figure_than_wgs84():
    earth = record(wgs84(equatorial_radius_m=3396190.0, flattening=1 / 169.8))  # Mars
    x, _, z = earth_position(earth, 0.8, 0.0, 10e3)
    exact_latitude, exact_altitude = exact_geodetic(earth.equatorial_radius_m, earth.flattening, x, z)
    latitude, _, altitude = geodetic(earth, x, 0.0, z)
    assert abs(error(latitude, exact_latitude)) < 4e-16
    assert abs(error(altitude, exact_altitude)) < 2e-9


def potential(earth, x, y, z):
    """Return mu/r (1 - J2 (R/r)^2 P2(sin)) in 40 digits."""
    r = mpmath.sqrt(x * x + y * y + z * z)
    mu, ratio = mpmath.mpf(earth.mu_m3ps2), mpmath.mpf(earth.gravity_radius_m) / r
    j2 = mpmath.mpf(earth.j2) if earth.gravity == J2 else 0
    return mu / r * (1 - j2 * ratio**2 * (3 * (z / r) ** 2 - 1) / 2)


@pytest.mark.parametrize("gravity", [INVERSE_SQUARE, J2])
@pytest.mark.parametrize("position", [(6.4e6, 0.0, 0.0), (1.1e6, -2.2e6, 6.1e6), (0.0, 0.0, -6.4e6), (-7e6, 3e6, 9e5)])
def test_gravitation_is_the_gradient_of_the_potential(gravity, position):
    earth = wgs84(gravity=gravity)
    got = gravitation(record(earth), *position)
    with mpmath.workdps(40):
        at = [mpmath.mpf(v) for v in position]
        for i in range(3):
            order = tuple(int(i == j) for j in range(3))
            expected = mpmath.diff(lambda x, y, z: potential(earth, x, y, z), at, order)
            assert abs(error(got[i], expected)) < 1e-14


@pytest.mark.parametrize(
    ("earth", "radius_ft", "altitude_ft", "g_ftps2"),
    [
        # NESC, SIM 4, on the equator at t = 0: cases 06 and 09 (ellipsoid, J2), case 04 (sphere)
        (wgs84(), 2.09556463255e7, 30000.0, 32.1065359519),
        (wgs84(), 2.09256463255e7, 0.0, 32.1988102141),
        (sphere(), 2.09322545305e7, 30000.0, 32.1263120705),
    ],
)
def test_nesc_gravity_and_altitude(earth, radius_ft, altitude_ft, g_ftps2):
    """The values agree within the twelve recorded digits."""
    row = record(earth)
    x, _, _ = earth_position(row, 0.0, 0.0, altitude_ft * FT)
    assert x / FT == pytest.approx(radius_ft, rel=3e-12)
    assert -gravitation(row, x, 0.0, 0.0)[0] / FT == pytest.approx(g_ftps2, rel=3e-12)


def test_gravity_gradient_torque_is_the_moment_of_the_attraction_of_many_masses():
    rng = np.random.default_rng(5)
    earth = wgs84(gravity=INVERSE_SQUARE)
    masses = rng.uniform(1.0, 5.0, 12)
    places = rng.normal(size=(12, 3)) * (100e3, 60e3, 20e3)  # large, so that the difference of g stands out
    places -= masses @ places / masses.sum()
    r = np.array([3e9, -4e9, 2e9])  # far, so that the neglected third order is small
    x, y, z = places.T
    tensor = [float(masses @ v) for v in (y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z)]
    with mpmath.workdps(40):
        total = [mpmath.mpf(0)] * 3
        for m, place in zip(masses, places, strict=True):
            at = [mpmath.mpf(float(a)) + mpmath.mpf(float(b)) for a, b in zip(r, place, strict=True)]
            k = -mpmath.mpf(earth.mu_m3ps2) * float(m) / mpmath.sqrt(sum(v * v for v in at)) ** 3
            force = [k * v for v in at]
            px, py, pz = map(float, place)
            total[0] += py * force[2] - pz * force[1]
            total[1] += pz * force[0] - px * force[2]
            total[2] += px * force[1] - py * force[0]
    got = gravity_gradient_torque(record(earth), tuple(r), tuple(tensor))
    expected = [float(t) for t in total]
    assert np.linalg.norm(np.subtract(got, expected)) < 3e-4 * np.linalg.norm(expected)


@pytest.mark.parametrize("earth", [flat(), wgs84(gravity=UNIFORM), wgs84(gravity=NO_GRAVITY)])
def test_no_gravity_gradient_without_an_inverse_square_field(earth):
    assert gravity_gradient_torque(record(earth), (7e6, 1e6, 0.0), (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)) == (0, 0, 0)


def test_a_long_body_is_pulled_upright():
    """For a rod along x tilted out of the vertical towards +z, the torque turns its upper end back."""
    earth = record(wgs84())
    up = np.array([math.cos(0.1), 0.0, math.sin(0.1)])  # vertical in B: x axis 0.1 rad from it
    torque = gravity_gradient_torque(earth, tuple(7e6 * up), (0.0, 100.0, 100.0, 0.0, 0.0, 0.0))
    expected = 3 * earth.mu_m3ps2 / 7e6**3 * 100.0 * math.sin(0.1) * math.cos(0.1)
    # x must turn towards +z, that is about -y
    assert torque == pytest.approx((0.0, -expected, 0.0), rel=1e-12)


def test_constants_are_those_of_the_check_cases():
    earth = wgs84()
    assert (earth.mu_m3ps2, earth.j2, earth.rate_radps) == (3.986004418e14, 1.08262982e-3, 7.292115e-5)
    assert pytest.approx(298.257223563, rel=1e-15) == 1.0 / earth.flattening
