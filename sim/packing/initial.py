"""The state at the start of a flight, from values in any of the frames that a scenario may use."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from maxq.control.kernel.jit import entry, from_python
from maxq.control.kernel.records import Array, Records, blank, pack
from maxq.control.kernel.tables import table_in
from maxq.control.kernel.vectors import rotation_from_quaternion
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.values import NS_PER_S
from maxq.sim.packing.environment import pack_earth
from maxq.sim.scenario import schema_environment as schema
from maxq.sim.scenario.schema_launch import Rail
from maxq.sim.scenario.schema_scenario import Initial, Scenario
from maxq.sim.vehicle.engine.kernel import total_thrust
from maxq.sim.vehicle.environment import AirData, Anchor, Environment, air_data, pad_acceleration
from maxq.sim.vehicle.schedule import TOTAL_MASS
from maxq.sim.vehicle.state import Q_BI, R_I, V_I, W_BI_B
from maxq.sim.world import earth as kernels
from maxq.sim.world.earth import Earth

earth_rotation, earth_position = from_python(kernels.earth_rotation), from_python(kernels.earth_position)
_total_thrust = from_python(total_thrust)
local_frame, ned_axes = from_python(kernels.local_frame), from_python(kernels.ned_axes)


def initial_motion(scenario: Scenario, y: Array) -> None:
    """Write the initial position, velocity, attitude and rates of a scenario into the state `y` (MAX_STATE,)."""
    position_I, velocity_I, q_BI, rate_B = _motion(
        scenario.initial, scenario.site, scenario.earth, scenario.rail, scenario.run.start_s
    )
    y[R_I : R_I + 3], y[V_I : V_I + 3] = position_I, velocity_I
    y[Q_BI : Q_BI + 4], y[W_BI_B : W_BI_B + 3] = q_BI, rate_B


@cached_by_identity
def _motion(
    initial: Initial | None, site: schema.Site, given_earth: schema.EarthSection, rail: Rail | None, start_s: float
) -> tuple[Array, Array, Array, Array]:
    given, earth = initial or Initial(), pack([pack_earth(given_earth)])[0]
    cos, sin = earth_rotation(earth, start_s)
    to_inertial = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    spin_I = np.array([0.0, 0.0, earth.rate_radps])
    position_E = _position(given, site, earth, to_inertial)
    _, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, *position_E)
    ned_E = np.array(ned_axes(sin_lat, cos_lat, sin_lon, cos_lon)).reshape(3, 3)  # rows north, east, down
    ned_to_inertial = product(to_inertial, ned_E.T)
    position_I = product(to_inertial, position_E)
    ground_I = np.cross(spin_I, position_I)
    if given.inertial_mps is not None:
        velocity_I = np.array(given.inertial_mps)
    elif given.earth_mps is not None:
        velocity_I = ground_I + product(to_inertial, np.array(given.earth_mps))
    else:
        velocity_I = ground_I + product(ned_to_inertial, np.array(given.ned_mps or (0.0, 0.0, 0.0)))
    attitude = _attitude(given, site, rail, ned_to_inertial)
    if given.rate_BI_degps is not None:
        rate_B = np.radians(given.rate_BI_degps)
    elif given.rate_BI_radps is not None:
        rate_B = np.array(given.rate_BI_radps)
    else:
        rate_B = np.radians(given.rate_BE_degps or (0.0, 0.0, 0.0)) + product(attitude.T, spin_I)
    return position_I, velocity_I, quaternion(attitude), rate_B


def product(a: Array, b: Array) -> Array:
    """Return the product of the matrix `a` (3, 3) and the matrix or vector `b` (3, ...).

    Unlike that of BLAS, its rounding is the same on every processor.
    """
    return np.asarray(
        np.multiply.outer(a[:, 0], b[0]) + np.multiply.outer(a[:, 1], b[1]) + np.multiply.outer(a[:, 2], b[2])
    )


def site_axes(initial: Initial | None, site: schema.Site, earth: Earth) -> Array:
    """Return the unit vectors north, east and down at the start as rows (3, 3), in E."""
    given = initial or Initial()
    _, sin_lat, cos_lat, sin_lon, cos_lon = local_frame(earth, *_position(given, site, earth, np.eye(3)))
    return np.array(ned_axes(sin_lat, cos_lat, sin_lon, cos_lon)).reshape(3, 3)


def _position(given: Initial, site: schema.Site, earth: Earth, to_inertial: Array) -> Array:
    if given.inertial_m is not None:
        return product(to_inertial.T, np.array(given.inertial_m))
    if given.earth_m is not None:
        return np.array(given.earth_m)
    place = given.geodetic or site
    return np.array(
        earth_position(earth, math.radians(place.latitude_deg), math.radians(place.longitude_deg), place.altitude_m)
    )


def _attitude(given: Initial, site: schema.Site, rail: Rail | None, ned_to_inertial: Array) -> Array:
    """Return the initial rotation matrix (3, 3) from B to I components."""
    if given.q_BI is not None:
        return rotation(np.array(given.q_BI))
    if given.dcm_BI is not None:
        return np.array(given.dcm_BI).T
    if given.euler_deg is not None:
        return product(ned_to_inertial, euler_to_ned(*np.radians(given.euler_deg)))
    azimuth_deg = site.azimuth_deg if rail is None or rail.azimuth_deg is None else rail.azimuth_deg
    azimuth = math.radians(azimuth_deg)
    north, east = math.cos(azimuth), math.sin(azimuth)
    nose, under = np.array([0.0, 0.0, -1.0]), np.array([north, east, 0.0])
    if rail is not None:
        level, upright = math.cos(math.radians(rail.elevation_deg)), math.sin(math.radians(rail.elevation_deg))
        nose, under = level * under + upright * nose, upright * under - level * nose
    return product(ned_to_inertial, np.stack([nose, np.cross(under, nose), under], axis=1))


def euler_to_ned(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation matrix (3, 3) from B to N components for Euler angles of the sequence 3-2-1, rad."""
    cy, sy, cp, sp = math.cos(yaw), math.sin(yaw), math.cos(pitch), math.sin(pitch)
    cr, sr = math.cos(roll), math.sin(roll)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation(q: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion (4,), scalar first, of any norm except 0."""
    w, x, y, z = q / math.hypot(*q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion(matrix: Array) -> Array:
    """Return the unit quaternion (4,) of a rotation matrix, with its scalar first and not negative.

    The component with the largest square is the divisor, so that the result is exact to rounding at any angle
    (Shepperd, J. Guidance and Control 1(3), 1978).
    """
    m = matrix
    trace = float(np.trace(m))
    squares = np.array([trace, m[0, 0], m[1, 1], m[2, 2]])
    k = int(np.argmax(squares))
    if k == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        i, j, h = k - 1, k % 3, (k + 1) % 3
        q = np.zeros(4)
        q[0] = m[h, j] - m[j, h]
        q[1 + i] = 1 + m[i, i] - m[j, j] - m[h, h]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + h] = m[h, i] + m[i, h]
    q /= math.hypot(*q)
    return np.asarray(q if q[0] >= 0 else -q)


def thrust_exceeds_weight_s(p: Any, pool: Array, y: Array) -> float:
    """Return the liftoff time of a held vehicle on its clock, s, or infinity if it does not lift off.

    `p` contains the parameters of the first stage. Before liftoff, the vehicle is at rest in constant air, so that
    thrust and mass over time determine the liftoff time. Except for rounding, it equals the time found in flight to the
    nanosecond.
    """
    pressure_Pa, load_mps2 = _on_the_pad(p.environment, pool, y, blank(Anchor), blank(AirData))
    table, timeline = table_in(pool, p.vehicle.schedule), p.timeline
    start_ns, burnout_ns = (int(timeline[f"{name}_ns"]) for name in ("burn_start", "burnout"))

    def lifts(now_ns: int) -> bool:
        row = table(float(timeline.burn_rate) * now_ns / NS_PER_S)
        thrust_N = _total_thrust(p.vehicle.engine, p.vehicle.sizes, row, pressure_Pa)
        return start_ns <= now_ns < burnout_ns and bool(thrust_N >= row[TOTAL_MASS] * load_mps2)

    first, last, step = start_ns, min(int(timeline.stop_ns), burnout_ns), int(timeline.step_ns)
    high = next((now_ns for now_ns in range(first, last, step) if lifts(now_ns)), None)
    if high is None:
        return math.inf
    low = max(high - step, first)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if lifts(middle) else (middle, high)
    return high / NS_PER_S


@entry
def _on_the_pad(environment: Environment, pool: Array, y: Array, anchor: Records, out: Records) -> tuple[float, float]:
    """Return the air pressure, Pa, and the axial specific force, m/s2, of a vehicle at rest on the Earth."""
    rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    gravity = air_data(environment, pool, (0.0, 0.0, 0.0), rotation, y, anchor[0], out[0])
    return out[0].pressure_Pa, pad_acceleration(environment.earth, rotation, gravity, y)[0]
