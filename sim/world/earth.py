"""The Earth: its figure, its rotation and its gravitation.

Frames: I inertial and E Earth-fixed, both Earth-centred with z to the north pole, E = I at t = 0; N local
North-East-Down on the geodetic normal. On a flat Earth I = E = N at the site (x north, y east, z down).

A rotation about the pole changes neither altitude nor local axes. Hence a kernel with a position in I computes altitude
and the NED axes *in I* directly, without the Earth's rotation angle. Only a longitude requires the position in E. The
functions used at every step (`local_frame`, `ned_to_earth`, ...) call no trigonometric function.

Constants are those of the NESC check cases (NASA/TM-2015-218675): WGS-84 with the J2 of EGM.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from maxq.control.kernel.jit import entry, kernel, routine
from maxq.control.kernel.records import Array, Records
from maxq.control.kernel.vectors import Matrix, Symmetric, Vector
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2

FLAT, SPHERE, ELLIPSOID = 0, 1, 2  # Earth.figure
NO_GRAVITY, UNIFORM, INVERSE_SQUARE, J2, ALONG_BODY = 0, 1, 2, 3, 4  # Earth.gravity

WGS84_RADIUS_m = 6378137.0
WGS84_FLATTENING = 1.0 / 298.257223563
WGS84_MU_m3ps2 = 3.986004418e14
WGS84_J2 = 1.08262982e-3
WGS84_RATE_radps = 7.292115e-5
MEAN_RADIUS_m = 6371007.1809  # sphere of equal surface area (authalic)

_NOWHERE_m = 1e-100  # a point this close to the axis or the centre is treated as on it, because the squares underflow


@dataclass(frozen=True)
class Earth:
    """The parameter record of the Earth, made with `wgs84`, `sphere` or `flat`.

    - `gravity`: UNIFORM is `uniform_mps2` along +z (flat) or towards the centre (round). INVERSE_SQUARE and J2 are the
      gravitation of `mu_m3ps2`, without a centrifugal part. ALONG_BODY is `uniform_mps2` aft along the vehicle's axis.
      It is only set in packed records (design/certificate/held_flight.py).
    - `gravity_radius_m`: reference radius of `j2`.

    Raises ValueError for an invalid combination.
    """

    figure: int = ELLIPSOID  # not "shape": on an uncompiled np.record, that is the shape of an array
    equatorial_radius_m: float = WGS84_RADIUS_m
    flattening: float = WGS84_FLATTENING
    rate_radps: float = WGS84_RATE_radps  # rotation of E relative to I about z; 0: not rotating
    gravity: int = J2
    mu_m3ps2: float = WGS84_MU_m3ps2
    j2: float = WGS84_J2
    gravity_radius_m: float = WGS84_RADIUS_m
    uniform_mps2: float = STANDARD_GRAVITY_mps2

    def __post_init__(self) -> None:
        if self.figure not in (FLAT, SPHERE, ELLIPSOID):
            raise ValueError(f"Earth.figure = {self.figure} must be 0 flat, 1 sphere or 2 ellipsoid")
        if self.gravity not in (NO_GRAVITY, UNIFORM, INVERSE_SQUARE, J2):
            raise ValueError(f"Earth.gravity = {self.gravity} must be 0 none, 1 uniform, 2 inverse square or 3 J2")
        if self.figure == FLAT and self.gravity not in (NO_GRAVITY, UNIFORM):
            raise ValueError("a flat Earth has no centre: its gravity is uniform or none")
        if self.figure == FLAT and self.rate_radps != 0.0:
            raise ValueError("a flat Earth does not rotate")
        if self.figure == SPHERE and self.flattening != 0.0:
            raise ValueError("a sphere has no flattening")
        if not 0.0 <= self.flattening < 0.1:
            raise ValueError(f"flattening {self.flattening} is outside 0 .. 0.1, where the geodetic kernels hold")
        if not (self.equatorial_radius_m > 0.0 and self.gravity_radius_m > 0.0 and self.mu_m3ps2 > 0.0):
            raise ValueError("radii and mu of the Earth must be positive")


def wgs84(**replaced: Any) -> Earth:
    """Return the rotating WGS-84 ellipsoid with J2; `replaced` are fields of `Earth`."""
    return Earth(**replaced)


def sphere(**replaced: Any) -> Earth:
    """Return a rotating sphere with inverse-square gravitation (NESC cases 4, 5); `replaced` are fields of `Earth`."""
    default = {"equatorial_radius_m": MEAN_RADIUS_m, "flattening": 0.0, "gravity": INVERSE_SQUARE}
    return Earth(SPHERE, **(default | replaced))


def flat(**replaced: Any) -> Earth:
    """Return a flat Earth at rest: I = E = NED at the site, altitude = -z; `replaced` are fields of `Earth`."""
    return Earth(FLAT, **({"flattening": 0.0, "rate_radps": 0.0, "gravity": UNIFORM} | replaced))


def geocentric_rad(latitude_deg: float, flattening: float = WGS84_FLATTENING) -> float:
    """Return the geocentric latitude (rad) of a point on the ellipsoid with this geodetic latitude."""
    return math.atan((1.0 - flattening) ** 2 * math.tan(math.radians(latitude_deg)))


@kernel
def gravitation(earth: Earth, x: float, y: float, z: float) -> Vector:
    """Return the gravitational acceleration (gx, gy, gz) [m/s2] at (x, y, z) [m], in the frame of the position: I or E.

    On a flat Earth it is (0, 0, +g), because I is NED there. J2: Vallado, Fundamentals of Astrodynamics, 4th ed., sec.
    8.6.1, the gradient of mu/r (1 - J2 (R/r)^2 (3 sin^2 - 1)/2). Within a metre of the centre the value is finite but
    meaningless.
    """
    if earth.gravity == NO_GRAVITY:
        return 0.0, 0.0, 0.0
    if earth.figure == FLAT:
        return 0.0, 0.0, earth.uniform_mps2
    inv_r2 = 1.0 / max(x * x + y * y + z * z, 1.0)
    inv_r = math.sqrt(inv_r2)
    if earth.gravity == UNIFORM:
        k = -earth.uniform_mps2 * inv_r
        return k * x, k * y, k * z
    k = -earth.mu_m3ps2 * inv_r2 * inv_r
    if earth.gravity == INVERSE_SQUARE:
        return k * x, k * y, k * z
    radius = earth.gravity_radius_m
    c = 1.5 * earth.j2 * radius * radius * inv_r2
    s = 5.0 * z * z * inv_r2
    across = k * (1.0 + c * (1.0 - s))
    return across * x, across * y, k * (1.0 + c * (3.0 - s)) * z


@kernel
def gravity_gradient_torque(earth: Earth, r_B: Vector, inertia: Symmetric) -> Vector:
    """Return the gravity-gradient torque [N m] about the centre of mass, in B: 3 mu / r^5 (r x J r).

    `r_B` [m]: position of the centre of mass relative to the Earth's centre, in B. `inertia` [kg m2]: elements (J_xx,
    J_yy, J_zz, J_xy, J_xz, J_yz) of the tensor about the centre of mass, so that J_xy = -integral(x y dm). Only the
    spherical part of the field is included; the gradient of J2 is a thousandth of it. The torque is zero in a uniform
    field and without gravity. Source: Hughes, Spacecraft Attitude Dynamics, sec. 8.1.
    """
    if earth.gravity not in (INVERSE_SQUARE, J2):
        return 0.0, 0.0, 0.0
    x, y, z = r_B
    j_xx, j_yy, j_zz, j_xy, j_xz, j_yz = inertia
    inv_r2 = 1.0 / max(x * x + y * y + z * z, 1.0)
    k = 3.0 * earth.mu_m3ps2 * inv_r2 * inv_r2 * math.sqrt(inv_r2)
    l_x = j_xx * x + j_xy * y + j_xz * z
    l_y = j_xy * x + j_yy * y + j_yz * z
    l_z = j_xz * x + j_yz * y + j_zz * z
    return k * (y * l_z - z * l_y), k * (z * l_x - x * l_z), k * (x * l_y - y * l_x)


@kernel
def local_frame(earth: Earth, x: float, y: float, z: float) -> tuple[float, float, float, float, float]:
    """Return the altitude [m] and (sin latitude, cos latitude, sin longitude, cos longitude) at (x, y, z) [m].

    For a position in E the longitude is the true longitude. For a position in I it is the inertial azimuth of the
    meridian, and `ned_axes`, `ned_to_earth`, `earth_to_ned` then use the NED axes in I.

    Method: one pass of Bowring's formula (Survey Review 28, 1985), started from his corrected parametric latitude. Then
    h = p cos + z sin - a sqrt(1 - e^2 sin^2), in which an error of the latitude enters squared. From -10 km up, the
    altitude is exact to rounding (2.5e-9 m up to 1000 km, 2e-8 m at 40 000 km) and the latitude to 2.5e-13 rad.

    On the polar axis the longitude is 0. Within 8 e^2 a = 340 km of the centre the geodetic normal is not unique, so
    that latitude and altitude are geocentric there. On a flat Earth the altitude is -z and the four numbers are (-1, 0,
    0, 1), which make the NED axes the identity.
    """
    if earth.figure == FLAT:
        return -z, -1.0, 0.0, 0.0, 1.0
    p2 = x * x + y * y
    p = math.sqrt(p2)
    sin_lon, cos_lon = 0.0, 1.0
    if p > _NOWHERE_m:
        inv_p = 1.0 / p
        sin_lon, cos_lon = y * inv_p, x * inv_p
    r = math.sqrt(p2 + z * z)
    a = earth.equatorial_radius_m
    e2 = earth.flattening * (2.0 - earth.flattening)
    e2a = e2 * a
    if earth.figure == SPHERE or r <= 8.0 * e2a:
        if r <= _NOWHERE_m:
            return -a, 0.0, 1.0, 0.0, 1.0
        inv_r = 1.0 / r
        return r - a, z * inv_r, p * inv_r, sin_lon, cos_lon
    ratio = 1.0 - earth.flattening
    sin_lat, cos_lat = _bowring(ratio, e2a, p, z, z * (ratio * r + e2a), p * r)
    altitude = p * cos_lat + z * sin_lat - a * math.sqrt(1.0 - e2 * sin_lat * sin_lat)
    return altitude, sin_lat, cos_lat, sin_lon, cos_lon


@kernel
def _bowring(ratio: float, e2a: float, p: float, z: float, s: float, c: float) -> tuple[float, float]:
    """Return sine and cosine of the geodetic latitude, given (s, c) proportional to those of the parametric latitude.

    `ratio` b/a, `e2a` e^2 a [m], `p` distance from the axis [m]. Numerator and denominator of Bowring's tan(latitude)
    are both multiplied by b/a, which avoids a division.
    """
    inv = 1.0 / math.sqrt(s * s + c * c)
    s, c = s * inv, c * inv
    s, c = ratio * z + e2a * s * s * s, ratio * (p - e2a * c * c * c)
    inv = 1.0 / math.sqrt(s * s + c * c)
    return s * inv, c * inv


@routine
def geodetic(earth: Earth, x: float, y: float, z: float) -> Vector:
    """Return (latitude [rad], longitude [rad] in -pi..pi, altitude [m]) of the Earth-fixed position (x, y, z) [m].

    A second pass of Bowring's formula makes the latitude exact to rounding (3e-16 rad) from -10 km up. Poles, axis and
    centre are treated as in `local_frame`. On a flat Earth the result is (0, 0, -z). This function is for logs and
    set-up; `local_frame` is faster.
    """
    if earth.figure == FLAT:
        return 0.0, 0.0, -z
    altitude, sin_lat, cos_lat, _, _ = local_frame(earth, x, y, z)
    longitude = math.atan2(y, x)
    e2a = earth.flattening * (2.0 - earth.flattening) * earth.equatorial_radius_m
    p2 = x * x + y * y
    if earth.figure == ELLIPSOID and p2 + z * z > 64.0 * e2a * e2a:
        ratio = 1.0 - earth.flattening
        p = math.sqrt(p2)
        sin_lat, cos_lat = _bowring(ratio, e2a, p, z, ratio * sin_lat, cos_lat)
        a, e2 = earth.equatorial_radius_m, earth.flattening * (2.0 - earth.flattening)
        altitude = p * cos_lat + z * sin_lat - a * math.sqrt(1.0 - e2 * sin_lat * sin_lat)
    return math.atan2(sin_lat, cos_lat), longitude, altitude


@entry
def geodetic_places(earth: Records, r_m: Array, out: Array) -> None:
    """Write the latitude, longitude (rad) and altitude (m) of positions `r_m` (n, 3) into `out` (n, 3): `geodetic`.

    `earth` (1,) is of Earth. For positions in I, the longitude is the azimuth about the polar axis.
    """
    for k in range(len(r_m)):
        out[k, 0], out[k, 1], out[k, 2] = geodetic(earth[0], r_m[k, 0], r_m[k, 1], r_m[k, 2])


@entry
def gravitations(earth: Records, r_m: Array, out: Array) -> None:
    """Write the accelerations, m/s2, at positions `r_m` (n, 3) into `out` (n, 3): `gravitation`."""
    for k in range(len(r_m)):
        out[k, 0], out[k, 1], out[k, 2] = gravitation(earth[0], r_m[k, 0], r_m[k, 1], r_m[k, 2])


@kernel
def earth_position(earth: Earth, latitude_rad: float, longitude_rad: float, altitude_m: float) -> Vector:
    """Return the Earth-fixed position (x, y, z) [m] of a geodetic position.

    On a flat Earth it is (0, 0, -altitude), at the site.
    """
    if earth.figure == FLAT:
        return 0.0, 0.0, -altitude_m
    sin_lat, cos_lat = math.sin(latitude_rad), math.cos(latitude_rad)
    e2 = earth.flattening * (2.0 - earth.flattening)
    normal = earth.equatorial_radius_m / math.sqrt(1.0 - e2 * sin_lat * sin_lat)
    p = (normal + altitude_m) * cos_lat
    return (p * math.cos(longitude_rad), p * math.sin(longitude_rad), (normal * (1.0 - e2) + altitude_m) * sin_lat)


@kernel
def ned_axes(sin_lat: float, cos_lat: float, sin_lon: float, cos_lon: float) -> Matrix:
    """Return the unit vectors north, east, down (three numbers each) in E.

    They are in I for the output of `local_frame` in I. As rows, they are the rotation matrix from E to N.
    """
    return (
        -sin_lat * cos_lon,
        -sin_lat * sin_lon,
        cos_lat,
        -sin_lon,
        cos_lon,
        0.0,
        -cos_lat * cos_lon,
        -cos_lat * sin_lon,
        -sin_lat,
    )


@kernel
def ned_to_earth(
    sin_lat: float, cos_lat: float, sin_lon: float, cos_lon: float, n: float, e: float, d: float
) -> Vector:
    """Return the components in E (or I, see `local_frame`) of a vector with components (n, e, d) in N."""
    outward = -sin_lat * n - cos_lat * d
    return cos_lon * outward - sin_lon * e, sin_lon * outward + cos_lon * e, cos_lat * n - sin_lat * d


@kernel
def earth_to_ned(
    sin_lat: float, cos_lat: float, sin_lon: float, cos_lon: float, x: float, y: float, z: float
) -> Vector:
    """Return the components (n, e, d) in N of a vector with components (x, y, z) in E (or I, see `local_frame`)."""
    outward = cos_lon * x + sin_lon * y
    return cos_lat * z - sin_lat * outward, cos_lon * y - sin_lon * x, -cos_lat * outward - sin_lat * z


@kernel
def earth_rotation(earth: Earth, time_s: float) -> tuple[float, float]:
    """Return (cos, sin) of the angle by which E has rotated about z relative to I at `time_s` after E = I."""
    if earth.rate_radps == 0.0:
        return 1.0, 0.0
    angle = earth.rate_radps * time_s
    return math.cos(angle), math.sin(angle)


@kernel
def inertial_to_earth(cos: float, sin: float, x: float, y: float, z: float) -> Vector:
    """Return the components in E of a vector (x, y, z) in I; (cos, sin) is from `earth_rotation`."""
    return cos * x + sin * y, cos * y - sin * x, z


@kernel
def ground_velocity(earth: Earth, x: float, y: float) -> Vector:
    """Return the velocity relative to I [m/s] of the Earth-fixed point at (x, y, any z) [m].

    Components are in the frame of the position.
    """
    return -earth.rate_radps * y, earth.rate_radps * x, 0.0
