"""The environment at the vehicle's position: gravitation, air, wind and turbulence.

The local frame on the ellipsoid and the standard atmosphere require many roots, divisions and powers. The four stages
of a Runge-Kutta step are within metres of each other. The first stage is evaluated exactly and stored as the anchor
(`ANCHOR_DUE` becomes `ANCHOR_SET`); the others are computed from it by short series. With `NO_ANCHOR` nothing is
stored, and each evaluation is independent, as numerical differentiation requires.

The series are used within `NEAR_m`. At that distance the errors are 3e-11 m in altitude (third powers omitted), 3e-13
relative in pressure, and 1e-10 rad in the directions of north and east (squares omitted). Near the poles the squares
are not small, and no anchor is set. A step of 1 ms at 1 km/s covers a tenth of `NEAR_m`, with errors of 1e-13 m, 1e-16
and 1e-12 rad. The exact formulas are used at larger distances, in another layer of the atmosphere, above 86 km, over a
flat Earth and in atmospheres other than US 1976.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import entry, kernel, routine
from maxq.control.kernel.limits import MAX_SURFACES
from maxq.control.kernel.records import Array, Records
from maxq.control.kernel.vectors import Matrix, Vector, add, cross, rotate, rotate_back, scaled, set_vector, vector_at
from maxq.sim.vehicle.block import R_I, V_I
from maxq.sim.world.atmosphere import (
    US1976,
    Atmosphere,
    GAS_CONSTANT_Jpkg_K,
    TOP_m,
    air,
    speed_of_sound,
    us1976_about,
    us1976_nearby,
)
from maxq.sim.world.earth import ALONG_BODY, FLAT, Earth, gravitation, ground_velocity, local_frame, ned_to_earth
from maxq.sim.world.turbulence import HORIZONTAL, Turbulence
from maxq.sim.world.wind import Wind, wind_ned


@dataclass(frozen=True)
class Environment:
    earth: Earth
    atmosphere: Atmosphere
    wind: Wind
    turbulence: Turbulence
    penetration: int  # 1: each part of the vehicle has the wind at its own position
    reach_m: float  # distance of the last part from the nose


@dataclass
class AirData:
    """The air and the gravitation at the core CG."""

    altitude_m: float  # above the ellipsoid, sphere or plane
    density_kgpm3: float
    pressure_Pa: float
    temperature_K: float
    sound_speed_mps: float
    airspeed_mps: float  # relative to the moving air
    mach: float
    dynamic_pressure_Pa: float
    flow_B_mps: Annotated[Array, (3,)]  # velocity relative to the air
    wind_N_mps: Annotated[Array, (3,)]  # velocity of the air relative to the Earth: north, east, down
    gravitation_I_mps2: Annotated[Array, (3,)]


@dataclass
class Anchor:
    """A position with its local frame and air."""

    state: int  # NO_ANCHOR ... ANCHOR_SET
    place_I_m: Annotated[Array, (3,)]
    altitude_m: float
    sin_lat: float
    cos_lat: float
    sin_lon: float
    cos_lon: float
    curvature_north_1pm: float  # curvature of the surface at this altitude, northwards
    curvature_east_1pm: float
    longitude_1pm: float  # change of longitude per metre to the east
    pressure_Pa: float
    temperature_K: float
    inverse_temperature_1pK: float
    scale: float  # scale of geopotential altitude; for this and the next two see `us1976_about`
    curvature_1pm: float
    lapse_Kpm: float
    reach_down_m: float
    reach_up_m: float


CROSSFLOW_PART = MAX_SURFACES + 1  # the last part with its own wind: the station of the cross-flow
# wind at each surface and at the cross-flow, minus that at the CG
PartWinds = Annotated[Array, (3 * (CROSSFLOW_PART + 1),)]


@kernel
def air_data(
    environment: Environment, pool: Array, gust: Vector, rotation: Matrix, y: Array, anchor: Anchor, out: AirData
) -> Vector:
    """Write the air data to `out`, and return the gravitation in I, m/s2.

    `gust`: velocity of the turbulence, in its frame, m/s. `rotation`: from B to I.
    """
    x, yy, z = y[R_I], y[R_I + 1], y[R_I + 2]
    gravity = gravitation(environment.earth, x, yy, z)
    if environment.earth.gravity == ALONG_BODY:
        gravity = rotate(rotation, (-environment.earth.uniform_mps2, 0.0, 0.0))
    frame, gas = frame_and_air(environment.earth, environment.atmosphere, pool, x, yy, z, anchor)
    altitude, sin_lat, cos_lat, sin_lon, cos_lon = frame
    density, pressure, temperature, sound_speed = gas
    wind = wind_ned(environment.wind, pool, altitude)
    wind_I = ned_to_earth(sin_lat, cos_lat, sin_lon, cos_lon, wind[0], wind[1], wind[2])
    ground = ground_velocity(environment.earth, x, yy)
    relative = (y[V_I] - ground[0] - wind_I[0], y[V_I + 1] - ground[1] - wind_I[1], y[V_I + 2] - ground[2] - wind_I[2])
    if environment.turbulence.frame == HORIZONTAL:
        gust = rotate_back(rotation, ned_to_earth(sin_lat, cos_lat, sin_lon, cos_lon, gust[0], gust[1], gust[2]))
    flow = add(rotate_back(rotation, relative), scaled(-1.0, gust))
    airspeed = math.sqrt(flow[0] * flow[0] + flow[1] * flow[1] + flow[2] * flow[2])
    out.altitude_m, out.density_kgpm3, out.pressure_Pa = altitude, density, pressure
    out.temperature_K, out.sound_speed_mps, out.airspeed_mps = temperature, sound_speed, airspeed
    out.mach, out.dynamic_pressure_Pa = airspeed / sound_speed, 0.5 * density * airspeed * airspeed
    set_vector(out.flow_B_mps, 0, flow)
    set_vector(out.wind_N_mps, 0, wind)
    set_vector(out.gravitation_I_mps2, 0, gravity)
    return gravity


@entry
def air_over_altitude(environment: Records, pool: Array, altitude_m: Array, out: Array) -> None:
    """Write density, kg/m3, and wind north, east, down, m/s, at altitudes (n,) into `out` (n, 4), without turbulence.

    `environment` (1,) is of Environment.
    """
    for k in range(len(altitude_m)):
        out[k, 0] = air(environment[0].atmosphere, pool, altitude_m[k])[0]
        out[k, 1], out[k, 2], out[k, 3] = wind_ned(environment[0].wind, pool, altitude_m[k])


@kernel
def winds_along_body(
    environment: Environment,
    pool: Array,
    stations_m: Array,
    parts: int,
    crossflow_m: float,
    cg_m: float,
    rotation: Matrix,
    y: Array,
    anchor: Anchor,
    air_at_cg: AirData,
    wind_B_mps: Array,
) -> None:
    """Replace the turbulence in `wind_B_mps` by the air's velocity at each part minus that at the core CG, in B.

    Profile and gusts are evaluated at the altitude of the part, along the straight axis. On entry, `wind_B_mps`
    contains the difference of the turbulence, in the frame of the turbulence.
    """
    frame, _ = frame_and_air(environment.earth, environment.atmosphere, pool, y[R_I], y[R_I + 1], y[R_I + 2], anchor)
    altitude, sin_lat, cos_lat, sin_lon, cos_lon = frame
    # vertical component of the x axis
    upward = cos_lat * (cos_lon * rotation[0] + sin_lon * rotation[3]) + sin_lat * rotation[6]
    here = vector_at(air_at_cg.wind_N_mps, 0)
    for k in range(parts + 1):
        station, at = (crossflow_m, CROSSFLOW_PART) if k == parts else (stations_m[k], k)
        there = wind_ned(environment.wind, pool, altitude + (cg_m - station) * upward)
        more, turbulence = add(there, scaled(-1.0, here)), (0.0, 0.0, 0.0)
        if environment.turbulence.on == 1:
            turbulence = vector_at(wind_B_mps, 3 * at)
        if environment.turbulence.frame == HORIZONTAL:
            more, turbulence = add(more, turbulence), (0.0, 0.0, 0.0)
        more_I = ned_to_earth(sin_lat, cos_lat, sin_lon, cos_lon, more[0], more[1], more[2])
        set_vector(wind_B_mps, 3 * at, add(rotate_back(rotation, more_I), turbulence))


@kernel
def pad_acceleration(earth: Earth, rotation: Matrix, gravity: Vector, y: Array) -> Vector:
    """Return the specific force of the pad on a vehicle that moves with it, in B, m/s2."""
    spin = (0.0, 0.0, earth.rate_radps)
    carried = cross(spin, cross(spin, vector_at(y, R_I)))
    return rotate_back(rotation, add(carried, scaled(-1.0, gravity)))


@kernel
def rail_acceleration(earth: Earth, rotation: Matrix, pad: Vector, axial_mps2: float, y: Array) -> Vector:
    """Return the specific force of a vehicle on its launch rail, in B, m/s2.

    The vehicle moves without friction along its axis, which rotates with the Earth. `pad`: specific force of the pad.
    `axial_mps2`: axial force of thrust and air per mass.
    """
    spin = rotate_back(rotation, (0.0, 0.0, earth.rate_radps))
    over_ground = rotate_back(rotation, velocity_over_ground(earth, y))
    coriolis = cross(spin, over_ground)
    return axial_mps2, pad[1] + 2.0 * coriolis[1], pad[2] + 2.0 * coriolis[2]


@kernel
def velocity_over_ground(earth: Earth, y: Array) -> Vector:
    """Return the velocity relative to the rotating Earth, in I, m/s."""
    ground = ground_velocity(earth, y[R_I], y[R_I + 1])
    return y[V_I] - ground[0], y[V_I + 1] - ground[1], y[V_I + 2] - ground[2]


@kernel
def climbs_certainly(earth: Earth, y: Array) -> bool:
    """Return True if the altitude increases for any figure of the Earth; always False for a flat Earth.

    The velocity must be 1 deg above the horizontal of a sphere. This is sufficient, because no normal of the ellipsoid
    is inclined by more than 0.2 deg to the radius.
    """
    x, yy, z = y[R_I], y[R_I + 1], y[R_I + 2]
    ground = ground_velocity(earth, x, yy)
    vx, vy, vz = y[V_I] - ground[0], y[V_I + 1] - ground[1], y[V_I + 2]
    outward = x * vx + yy * vy + z * vz
    squares = (x * x + yy * yy + z * z) * (vx * vx + vy * vy + vz * vz)
    return earth.figure != FLAT and outward > 0.0 and outward * outward > 3.1e-4 * squares


@routine
def climb_rate(earth: Earth, y: Array) -> tuple[float, float]:
    """Return the altitude (m) and its rate (m/s) relative to the rotating Earth."""
    altitude, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, y[R_I], y[R_I + 1], y[R_I + 2])
    vx, vy, vz = velocity_over_ground(earth, y)
    return altitude, cos_lat * (cos_lon * vx + sin_lon * vy) + sin_lat * vz


@routine
def flight_direction(environment: Environment, pool: Array, y: Array) -> Vector:
    """Return the unit vector of the velocity relative to the air without turbulence, in north, east, down.

    The result is upwards if this velocity is zero, and for turbulence in the frame BODY, which does not use it.
    """
    if environment.turbulence.frame != HORIZONTAL:
        return 0.0, 0.0, -1.0
    earth = environment.earth
    altitude, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, y[R_I], y[R_I + 1], y[R_I + 2])
    vx, vy, vz = velocity_over_ground(earth, y)
    wind = wind_ned(environment.wind, pool, altitude)
    outward = cos_lon * vx + sin_lon * vy
    north = cos_lat * vz - sin_lat * outward - wind[0]
    east = cos_lon * vy - sin_lon * vx - wind[1]
    down = -cos_lat * outward - sin_lat * vz - wind[2]
    speed = math.sqrt(north * north + east * east + down * down)
    if speed < 1e-6:
        return 0.0, 0.0, -1.0
    return north / speed, east / speed, down / speed


NO_ANCHOR, ANCHOR_DUE, ANCHOR_SET = range(3)  # states of an anchor
NEAR_m = 10.0

Frame = tuple[float, float, float, float, float]  # as `earth.local_frame` returns it
Gas = tuple[float, float, float, float]  # as `atmosphere.air` returns it


@kernel
def frame_and_air(
    earth: Earth, atmosphere: Atmosphere, pool: Array, x: float, y: float, z: float, anchor: Anchor
) -> tuple[Frame, Gas]:
    """Return `local_frame` and `air` at a position (frame I, m).

    Within `NEAR_m` of the anchor, the results are series about it; `air` also requires an altitude within the anchor's
    reach. An anchor that is due is set at this position.
    """
    dx, dy, dz = x - anchor.place_I_m[0], y - anchor.place_I_m[1], z - anchor.place_I_m[2]
    if anchor.state == ANCHOR_SET and dx * dx + dy * dy + dz * dz < NEAR_m * NEAR_m:
        frame = _frame_nearby(dx, dy, dz, anchor)
        rise = frame[0] - anchor.altitude_m
        if anchor.reach_down_m < rise < anchor.reach_up_m:
            return frame, _air_nearby(atmosphere, rise, anchor)
        return frame, air(atmosphere, pool, frame[0])
    frame = local_frame(earth, x, y, z)
    gas = air(atmosphere, pool, frame[0])
    if anchor.state == ANCHOR_DUE:
        _set_anchor(earth, atmosphere, x, y, z, frame, gas, anchor)
    return frame, gas


@kernel
def _set_anchor(
    earth: Earth, atmosphere: Atmosphere, x: float, y: float, z: float, frame: Frame, gas: Gas, anchor: Anchor
) -> None:
    """Set the anchor at a position, unless the Earth is flat or meridians converge within metres near a pole."""
    altitude, sin_lat, cos_lat, _, _ = frame
    if earth.figure == FLAT or cos_lat < 0.1 or altitude < -1e5:
        anchor.state = NO_ANCHOR
        return
    anchor.state = ANCHOR_SET
    set_vector(anchor.place_I_m, 0, (x, y, z))
    anchor.altitude_m, anchor.sin_lat, anchor.cos_lat, anchor.sin_lon, anchor.cos_lon = frame
    e2 = earth.flattening * (2.0 - earth.flattening)
    flat = 1.0 - e2 * sin_lat * sin_lat
    normal = earth.equatorial_radius_m / math.sqrt(flat)
    anchor.curvature_north_1pm = 1.0 / (normal * (1.0 - e2) / flat + altitude)
    anchor.curvature_east_1pm = 1.0 / (normal + altitude)
    anchor.longitude_1pm = anchor.curvature_east_1pm / cos_lat
    anchor.reach_down_m, anchor.reach_up_m = 0.0, 0.0
    if atmosphere.model == US1976 and altitude < TOP_m:
        anchor.pressure_Pa, anchor.temperature_K = gas[1], gas[2]
        anchor.inverse_temperature_1pK = 1.0 / gas[2]
        scale, curvature, lapse, down, up = us1976_about(altitude, gas[2])
        anchor.scale, anchor.curvature_1pm, anchor.lapse_Kpm = scale, curvature, lapse
        anchor.reach_down_m, anchor.reach_up_m = down, up


@kernel
def _frame_nearby(dx: float, dy: float, dz: float, anchor: Anchor) -> Frame:
    """Return the local frame at `dx`, `dy`, `dz` (I, m) from the anchor, including the curvature of the surface."""
    sin_lat, cos_lat, sin_lon, cos_lon = anchor.sin_lat, anchor.cos_lat, anchor.sin_lon, anchor.cos_lon
    outward = cos_lon * dx + sin_lon * dy
    north = cos_lat * dz - sin_lat * outward
    east = cos_lon * dy - sin_lon * dx
    up = cos_lat * outward + sin_lat * dz
    turn_north = anchor.curvature_north_1pm * north
    turn_east = anchor.longitude_1pm * east
    bulge = 0.5 * (turn_north * north + anchor.curvature_east_1pm * east * east)
    return (
        anchor.altitude_m + (up + bulge),
        sin_lat + turn_north * cos_lat,
        cos_lat - turn_north * sin_lat,
        sin_lon + turn_east * cos_lon,
        cos_lon - turn_east * sin_lon,
    )


@kernel
def _air_nearby(atmosphere: Atmosphere, rise: float, anchor: Anchor) -> Gas:
    """Return the standard atmosphere `rise` metres above the anchor, in the same layer."""
    geopotential = anchor.scale * rise * (1.0 - rise * anchor.curvature_1pm)
    pressure, warmer = us1976_nearby(anchor.pressure_Pa, anchor.inverse_temperature_1pK, anchor.lapse_Kpm, geopotential)
    temperature = warmer * anchor.temperature_K
    density = atmosphere.density_factor * pressure / (GAS_CONSTANT_Jpkg_K * temperature)
    return density, pressure, temperature, speed_of_sound(temperature)
