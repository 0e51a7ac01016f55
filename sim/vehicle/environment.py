"""The environment at the vehicle's position: gravitation, air, wind and turbulence."""

from __future__ import annotations

import math
from dataclasses import dataclass

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Matrix, Vector, add, cross, rotate_back, scaled, set_vector, vector_at
from maxq.sim.vehicle.block import R_I, V_I
from maxq.sim.vehicle.nearby import frame_and_air
from maxq.sim.vehicle.workspace import (
    AIRSPEED,
    ALTITUDE,
    DENSITY,
    DYNAMIC_PRESSURE,
    FLOW,
    GRAVITATION,
    MACH,
    PRESSURE,
    SOUND_SPEED,
    TEMPERATURE,
    WIND_N,
)
from maxq.sim.world.atmosphere import Atmosphere
from maxq.sim.world.earth import FLAT, Earth, gravitation, ground_velocity, local_frame, ned_to_earth
from maxq.sim.world.turbulence import Turbulence
from maxq.sim.world.wind import Wind, wind_ned


@dataclass(frozen=True)
class Environment:
    earth: Earth
    atmosphere: Atmosphere
    wind: Wind
    turbulence: Turbulence


@kernel
def air_data(
    environment: Environment, pool: Array, gust: Vector, rotation: Matrix, y: Array, work: Array, aux: Array
) -> Vector:  # fmt: skip  # nine lines otherwise
    """Air data into `aux`; returns the gravitation in I, m/s2. `gust`: of the turbulence, B, m/s."""
    x, yy, z = y[R_I], y[R_I + 1], y[R_I + 2]
    gravity = gravitation(environment.earth, x, yy, z)
    frame, gas = frame_and_air(environment.earth, environment.atmosphere, pool, x, yy, z, work)
    altitude, sin_lat, cos_lat, sin_lon, cos_lon = frame
    density, pressure, temperature, sound_speed = gas
    wind = wind_ned(environment.wind, pool, altitude)
    wind_I = ned_to_earth(sin_lat, cos_lat, sin_lon, cos_lon, wind[0], wind[1], wind[2])
    ground = ground_velocity(environment.earth, x, yy)
    relative = (
        y[V_I] - ground[0] - wind_I[0],
        y[V_I + 1] - ground[1] - wind_I[1],
        y[V_I + 2] - ground[2] - wind_I[2],
    )
    flow = add(rotate_back(rotation, relative), scaled(-1.0, gust))
    airspeed = math.sqrt(flow[0] * flow[0] + flow[1] * flow[1] + flow[2] * flow[2])
    aux[ALTITUDE], aux[DENSITY], aux[PRESSURE] = altitude, density, pressure
    aux[TEMPERATURE], aux[SOUND_SPEED], aux[AIRSPEED] = temperature, sound_speed, airspeed
    aux[MACH], aux[DYNAMIC_PRESSURE] = airspeed / sound_speed, 0.5 * density * airspeed * airspeed
    set_vector(aux, FLOW, flow)
    set_vector(aux, WIND_N, wind)
    set_vector(aux, GRAVITATION, gravity)
    return gravity


@kernel
def pad_acceleration(earth: Earth, rotation: Matrix, gravity: Vector, y: Array) -> Vector:
    """Specific force that the pad exerts on a vehicle it carries along, in B, m/s2."""
    spin = (0.0, 0.0, earth.rate_radps)
    carried = cross(spin, cross(spin, vector_at(y, R_I)))
    return rotate_back(rotation, add(carried, scaled(-1.0, gravity)))


@kernel
def climbs_certainly(earth: Earth, y: Array) -> bool:
    """Whether the altitude rises for any figure of the Earth: the velocity is 1 degree above the horizontal of a
    sphere, and no normal of the ellipsoid is inclined by more than 0.2 degrees to the radius. A flat Earth: never.
    """
    x, yy, z = y[R_I], y[R_I + 1], y[R_I + 2]
    ground = ground_velocity(earth, x, yy)
    vx, vy, vz = y[V_I] - ground[0], y[V_I + 1] - ground[1], y[V_I + 2]
    outward = x * vx + yy * vy + z * vz
    squares = (x * x + yy * yy + z * z) * (vx * vx + vy * vy + vz * vz)
    return earth.figure != FLAT and outward > 0.0 and outward * outward > 3.1e-4 * squares


@routine
def climb_rate(earth: Earth, y: Array) -> tuple[float, float]:
    """Altitude (m) and its rate (m/s) relative to the rotating Earth."""
    altitude, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, y[R_I], y[R_I + 1], y[R_I + 2])
    ground = ground_velocity(earth, y[R_I], y[R_I + 1])
    vx, vy, vz = y[V_I] - ground[0], y[V_I + 1] - ground[1], y[V_I + 2] - ground[2]
    return altitude, cos_lat * (cos_lon * vx + sin_lon * vy) + sin_lat * vz
