"""Local frame and air of a place, and of places a few metres from it by short series.

The local frame on the ellipsoid and the standard atmosphere are chains of roots, divisions and powers in which
everything waits for everything. The four stages of a Runge-Kutta step lie within metres of each other: the first is
worked out exactly and remembered (`ANCHOR_DUE` becomes `ANCHOR_SET`), the others go on from there. A workspace of zeros
(`NO_ANCHOR`) remembers nothing: every evaluation is then by itself, as one that is differentiated numerically must be.

Within `NEAR_m` and at that distance: altitude to 3e-11 m (third powers left out), pressure to 3e-13 of itself, the
directions of north and east to 1e-10 rad (squares left out, which near the poles are not small: see `drop`). A step
of 1 ms at 1 km/s goes a tenth as far, which makes that 1e-13 m, 1e-16 and 1e-12 rad. Farther away, in another layer of
the atmosphere, over a flat Earth and in other atmospheres than US 1976 the exact formulas are used.
"""

from __future__ import annotations

import math

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.workspace import ANCHOR
from maxq.sim.world.atmosphere import (
    US1976,
    Atmosphere,
    GAS_CONSTANT_Jpkg_K,
    air,
    speed_of_sound,
    us1976_about,
    us1976_nearby,
)
from maxq.sim.world.earth import FLAT, Earth, local_frame

NO_ANCHOR, ANCHOR_DUE, ANCHOR_SET = 0.0, 1.0, 2.0  # of the workspace's anchor
NEAR_m = 10.0

Frame = tuple[float, float, float, float, float]  # as `earth.local_frame` returns it
Gas = tuple[float, float, float, float]  # as `atmosphere.air` returns it

_PLACE = ANCHOR + 1  # x, y, z, m
_FRAME = ANCHOR + 4  # altitude, sines and cosines
_CURVATURE_NORTH = ANCHOR + 9  # 1/m, of the surface at this altitude
_CURVATURE_EAST = ANCHOR + 10
_LONGITUDE = ANCHOR + 11  # by how much the longitude turns per metre to the east, 1/m
_GAS = ANCHOR + 12  # density, pressure, temperature, speed of sound
_INVERSE_TEMPERATURE = ANCHOR + 16
_GEOPOTENTIAL = ANCHOR + 17  # see `us1976_about`
_REACH_DOWN = ANCHOR + 20
_REACH_UP = ANCHOR + 21


@kernel
def frame_and_air(
    earth: Earth, atmosphere: Atmosphere, pool: Array, x: float, y: float, z: float, work: Array
) -> tuple[Frame, Gas]:
    """`local_frame` and `air` at a position (I, m)."""
    dx, dy, dz = x - work[_PLACE], y - work[_PLACE + 1], z - work[_PLACE + 2]
    if work[ANCHOR] == ANCHOR_SET and dx * dx + dy * dy + dz * dz < NEAR_m * NEAR_m:
        frame = _frame_nearby(dx, dy, dz, work)
        rise = frame[0] - work[_FRAME]
        if work[_REACH_DOWN] < rise < work[_REACH_UP]:
            return frame, _air_nearby(atmosphere, rise, work)
        return frame, air(atmosphere, pool, frame[0])
    frame = local_frame(earth, x, y, z)
    gas = air(atmosphere, pool, frame[0])
    if work[ANCHOR] == ANCHOR_DUE:
        _set_anchor(earth, atmosphere, x, y, z, frame, gas, work)
    return frame, gas


@kernel
def _set_anchor(
    earth: Earth, atmosphere: Atmosphere, x: float, y: float, z: float, frame: Frame, gas: Gas, work: Array
) -> None:  # fmt: skip
    """Remember a place, unless there is no ellipsoid or a pole is so near that meridians converge within metres."""
    altitude, sin_lat, cos_lat, _, _ = frame
    if earth.figure == FLAT or cos_lat < 0.1 or altitude < -1e5:
        work[ANCHOR] = NO_ANCHOR
        return
    work[ANCHOR] = ANCHOR_SET
    work[_PLACE], work[_PLACE + 1], work[_PLACE + 2] = x, y, z
    for j in range(5):
        work[_FRAME + j] = frame[j]
    e2 = earth.flattening * (2.0 - earth.flattening)
    flat = 1.0 - e2 * sin_lat * sin_lat
    normal = earth.equatorial_radius_m / math.sqrt(flat)
    work[_CURVATURE_NORTH] = 1.0 / (normal * (1.0 - e2) / flat + altitude)
    work[_CURVATURE_EAST] = 1.0 / (normal + altitude)
    work[_LONGITUDE] = work[_CURVATURE_EAST] / cos_lat
    work[_REACH_DOWN], work[_REACH_UP] = 0.0, 0.0
    if atmosphere.model == US1976:
        for j in range(4):
            work[_GAS + j] = gas[j]
        work[_INVERSE_TEMPERATURE] = 1.0 / gas[2]
        scale, curvature, lapse, on_pad, up = us1976_about(altitude, gas[2])
        work[_GEOPOTENTIAL], work[_GEOPOTENTIAL + 1], work[_GEOPOTENTIAL + 2] = scale, curvature, lapse
        work[_REACH_DOWN], work[_REACH_UP] = on_pad, up


@kernel
def _frame_nearby(dx: float, dy: float, dz: float, work: Array) -> Frame:
    """The local frame `dx`, `dy`, `dz` from the anchor: the surface curves away beneath."""
    sin_lat, cos_lat = work[_FRAME + 1], work[_FRAME + 2]
    sin_lon, cos_lon = work[_FRAME + 3], work[_FRAME + 4]
    outward = cos_lon * dx + sin_lon * dy
    north = cos_lat * dz - sin_lat * outward
    east = cos_lon * dy - sin_lon * dx
    up = cos_lat * outward + sin_lat * dz
    turn_north = work[_CURVATURE_NORTH] * north
    turn_east = work[_LONGITUDE] * east
    bulge = 0.5 * (turn_north * north + work[_CURVATURE_EAST] * east * east)
    return (
        work[_FRAME] + (up + bulge),
        sin_lat + turn_north * cos_lat,
        cos_lat - turn_north * sin_lat,
        sin_lon + turn_east * cos_lon,
        cos_lon - turn_east * sin_lon,
    )


@kernel
def _air_nearby(atmosphere: Atmosphere, rise: float, work: Array) -> Gas:
    """The standard atmosphere `rise` metres above the anchor, in the same layer."""
    geopotential = work[_GEOPOTENTIAL] * rise * (1.0 - rise * work[_GEOPOTENTIAL + 1])
    pressure, warmer = us1976_nearby(
        work[_GAS + 1], work[_INVERSE_TEMPERATURE], work[_GEOPOTENTIAL + 2], geopotential
    )  # fmt: skip
    temperature = warmer * work[_GAS + 2]
    density = atmosphere.density_factor * pressure / (GAS_CONSTANT_Jpkg_K * temperature)
    return density, pressure, temperature, speed_of_sound(temperature)
