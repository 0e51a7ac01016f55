"""The launch: the rail that guides a small rocket, and the clearance to a tower next to the pad.

The vehicle is a rigid cylinder from its nose to the nozzle exits, without bending. The tower is a vertical cylinder,
whose foot is at the height of the nozzle exits on the pad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Q_BI, R_I
from maxq.sim.vehicle.derivative import Held
from maxq.sim.vehicle.environment import velocity_over_ground
from maxq.sim.world.earth import Earth, earth_rotation, inertial_to_earth

RAIL_EXIT = 100  # after the events of parameters.py, which are part of a flight's state


WATCHED_NS = 2_000_000_000  # after the release of a clamp


@dataclass(frozen=True)
class Launch:
    """The parameters of the launch.

    - `rail_m`: travel guided by the rail; 0: no rail.
    - `tower_m`: height of the tower; 0: no tower.
    - `tower_E_m`: horizontal vector from the vehicle's tail on the pad to the axis of the tower, in E.
    - `up_E`: vertical of the site, in E.
    - `radii_m`: sum of the radii of vehicle and tower.
    - `tail_station_m`: station of the rearmost nozzle exit.
    """

    rail_m: float
    tower_m: float
    tower_E_m: Annotated[Array, (3,)]
    up_E: Annotated[Array, (3,)]
    radii_m: float
    tail_station_m: float


@dataclass
class LaunchMemory:
    """The state of the launch; times are -1 until there is a value.

    - `rail_x_m`: position along the body axis at liftoff from the rail, which rotates with the Earth, as does the axis.
    - `rail_exit_ns`, `rail_exit_mps`: time at the end of the rail, and speed there relative to the Earth.
    - `tail_E_m`: position of the tail at the start, in E.
    - `clearance_m`, `drift_m`: least distance to the tower, and largest horizontal displacement of the tail below the
      tower's top, with their times.
    - `clear`: 1 after the tail has passed the top.
    - `watched_ns`: end of the time after the release of a clamp in which `bending_radps` is gathered.
    - `bending_radps`: largest rate of bending at the gyro then.
    """

    rail_x_m: float
    rail_exit_ns: int
    rail_exit_mps: float
    tail_E_m: Annotated[Array, (3,)]
    clearance_m: float
    clearance_ns: int
    drift_m: float
    drift_ns: int
    clear: int
    watched_ns: int
    bending_radps: float
    bending_ns: int


@kernel
def start_launch(state: LaunchMemory) -> None:
    """Set the launch to its start."""
    state.rail_exit_ns, state.clearance_ns, state.drift_ns, state.clear = -1, -1, -1, 0
    state.clearance_m, state.drift_m = math.inf, 0.0
    state.watched_ns, state.bending_ns, state.bending_radps = -1, -1, 0.0


@kernel
def along_axis(y: Array) -> float:
    """Return the component of the position along the body's x axis, m."""
    rotation = vec.rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    place: float = vec.rotate_back(rotation, vec.vector_at(y, R_I))[0]
    return place


@routine
def lift_off(launch: Launch, state: LaunchMemory, held: Held, y: Array, now_ns: int) -> None:
    """Release the vehicle, which its rail continues to guide if there is one."""
    if held.clamped == 1:
        state.watched_ns = now_ns + WATCHED_NS
    held.on_pad, held.clamped = 0, 0
    if launch.rail_m > 0.0:
        held.on_rail, state.rail_x_m = 1, along_axis(y)


@kernel
def track_release(state: LaunchMemory, bending_radps: Array, now_ns: int) -> None:
    """Update the largest rate of bending (about y, z) after the release of a clamp."""
    rate_radps = math.hypot(bending_radps[0], bending_radps[1])
    if rate_radps > state.bending_radps:
        state.bending_radps, state.bending_ns = rate_radps, now_ns


@routine
def rail_surplus(launch: Launch, state: LaunchMemory, y: Array) -> float:
    """Return the travel beyond the end of the rail, m; negative on the rail."""
    surplus_m: float = along_axis(y) - state.rail_x_m - launch.rail_m
    return surplus_m


@routine
def leave_rail(earth: Earth, state: LaunchMemory, held: Held, y: Array, now_ns: int) -> None:
    """End the guidance by the rail, and record the time and the speed."""
    held.on_rail = 0
    state.rail_exit_ns, state.rail_exit_mps = now_ns, vec.norm(velocity_over_ground(earth, y))


@routine
def track_tower(earth: Earth, launch: Launch, state: LaunchMemory, y: Array, properties: Array, now_ns: int) -> None:
    """Update clearance and drift until the tail has passed the top of the tower."""
    cos, sin = earth_rotation(earth, 1e-9 * now_ns)
    rotation = vec.rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    station, across, upwards = properties[sch.CORE_CG], -properties[sch.CORE_CG + 1], -properties[sch.CORE_CG + 2]
    r, aft = vec.vector_at(y, R_I), (station - launch.tail_station_m, across, upwards)
    nose, tail = (vec.add(r, vec.rotate(rotation, (station, across, upwards))), vec.add(r, vec.rotate(rotation, aft)))
    nose = inertial_to_earth(cos, sin, nose[0], nose[1], nose[2])
    tail = inertial_to_earth(cos, sin, tail[0], tail[1], tail[2])
    if state.clearance_ns < 0:
        vec.set_vector(state.tail_E_m, 0, tail)
    foot, up = vec.vector_at(state.tail_E_m, 0), vec.vector_at(launch.up_E, 0)
    tail, nose = vec.add(tail, vec.scaled(-1.0, foot)), vec.add(nose, vec.scaled(-1.0, foot))
    height_m = vec.dot(tail, up)
    if height_m > launch.tower_m:
        state.clear = 1
        return
    distance_m = between(tail, nose, vec.vector_at(launch.tower_E_m, 0), up, launch.tower_m) - launch.radii_m
    if distance_m < state.clearance_m:
        state.clearance_m, state.clearance_ns = distance_m, now_ns
    drift_m = vec.norm(vec.add(tail, vec.scaled(-height_m, up)))
    if drift_m >= state.drift_m:
        state.drift_m, state.drift_ns = drift_m, now_ns


@kernel
def between(tail: vec.Vector, nose: vec.Vector, foot: vec.Vector, up: vec.Vector, height_m: float) -> float:
    """Return the distance between the line from tail to nose and the vertical line of a height above `foot`, m.

    Source: Ericson, Real-Time Collision Detection, section 5.1.9. `up` is a unit vector.
    """
    along, away = vec.add(nose, vec.scaled(-1.0, tail)), vec.add(tail, vec.scaled(-1.0, foot))
    a, b, c = vec.dot(along, along), vec.dot(along, up), vec.dot(along, away)
    f = vec.dot(up, away)
    parallel = a - b * b
    s = min(max((b * f - c) / parallel, 0.0), 1.0) if parallel > 1e-12 * a else 0.0
    t = b * s + f
    if t < 0.0:
        t, s = 0.0, min(max(-c / a, 0.0), 1.0)
    elif t > height_m:
        t, s = height_m, min(max((b * height_m - c) / a, 0.0), 1.0)
    return vec.norm(vec.add(away, vec.add(vec.scaled(s, along), vec.scaled(-t, up))))
