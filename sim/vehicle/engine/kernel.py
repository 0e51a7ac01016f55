"""Engines: thrust, and direction of the thrust with its time derivatives.

An engine is mounted on a gimbal at the aft end and follows the actuators of its group exactly, in two planes, in one,
or not at all. At rest its mass is part of the core; `rigid.engine_reaction` adds the effects of a deflection ("tail
wags dog").

Engines that move together and differ only in their lateral position are combined into one engine, with n times the
thrust, mass and inertia at the mean of their positions. The combination is exact (docs/model.md, section 3), and takes
the computing time of a single engine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.kernel.vectors import Vector, cross, scaled, set_vector, sine_cosine, vector_at
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.schedule import CORE_CG, THRUST_VACUUM, thrust_column

_PER_ENGINE = (MAX_ENGINES,)
Numbers = Annotated[Array, _PER_ENGINE]
Indices = Annotated[IntArray, _PER_ENGINE]


@dataclass(frozen=True)
class Engine:
    """The parameters of all engines of a stage; `Sizes.engines` is their number.

    - `turned_*_rad`: cant plus misalignment, added to the gimbal angles.
    - `rest_*`: unit vector of the thrust with cant, without deflection and misalignment, B.
    - `lever_*_m`: vector from the body axis at the gimbal's station to the engine's CG at rest (aft, y, z), for the
      modes. Its y and z are used for canted engines only; without cant they are of second order.
    - `exit_*`: centre and second moments of the nozzle exits about it, for jet damping.
    """

    exit_area_m2: Numbers
    thrust_factor: Numbers
    curve: Indices  # index of the curve of vacuum thrust
    group: Indices
    follows_pitch: Numbers  # 1 if the engine follows its group in this plane, otherwise 0
    follows_yaw: Numbers
    gimbal: Indices  # index of the station of gimbals, as in the mode shapes
    gimbal_station_m: Numbers
    gimbal_offset_y_m: Numbers
    gimbal_offset_z_m: Numbers
    turned_pitch_rad: Numbers
    turned_yaw_rad: Numbers
    rest_x: Numbers
    rest_y: Numbers
    rest_z: Numbers
    gimballed_mass_kg: Numbers
    cg_from_gimbal_m: Numbers  # aft of the gimbal, along the axis of the engine
    inertia_kgm2: Numbers  # about the CG of the engine, assumed isotropic
    lever_x_m: Numbers
    lever_y_m: Numbers
    lever_z_m: Numbers
    swings: Indices  # index of the engine's TVC load; -1: the engine follows its actuators
    exit_station_m: Numbers
    exit_y_m: Numbers
    exit_z_m: Numbers
    exit_yy_m2: Numbers
    exit_zz_m2: Numbers
    exit_yz_m2: Numbers
    roll_arm_m: Numbers  # torque about the thrust axis per newton of thrust
    flow_weight: Numbers  # mass flow per newton of the curve, relative to the other engines
    taken_as: Indices  # index of the engine of this record that represents each engine of the vehicle
    parts: Numbers  # number of engines combined


@dataclass
class GimbalMotion:
    """The gimbal angle in one plane and its derivatives."""

    angle_rad: float
    rate_radps: float
    accel_radps2: float


@dataclass
class EngineOutputs:
    """The auxiliary outputs of the engines."""

    channel: Annotated[tuple[GimbalMotion, ...], (2 * MAX_ENGINES,)]  # pitch, yaw of each group
    thrust_N: Annotated[Array, _PER_ENGINE]
    axial_thrust_N: float  # sum of the thrusts along x with the engines at rest


@kernel
def set_motion(channel: GimbalMotion, motion: Vector) -> None:
    channel.angle_rad, channel.rate_radps, channel.accel_radps2 = motion[0], motion[1], motion[2]


@kernel
def engine_axis_motion(e: Engine, k: int, pitch: GimbalMotion, yaw: GimbalMotion) -> tuple[Vector, Vector, Vector]:
    """Return `thrust_axis_motion` of engine k, from the motion of its group."""
    in_pitch, in_yaw = e.follows_pitch[k], e.follows_yaw[k]
    return thrust_axis_motion(
        in_pitch * pitch.angle_rad + e.turned_pitch_rad[k],
        in_pitch * pitch.rate_radps,
        in_pitch * pitch.accel_radps2,
        in_yaw * yaw.angle_rad + e.turned_yaw_rad[k],
        in_yaw * yaw.rate_radps,
        in_yaw * yaw.accel_radps2,
    )


@kernel
def thrust_axis_motion(
    pitch: float, pitch_rate: float, pitch_accel: float, yaw: float, yaw_rate: float, yaw_accel: float
) -> tuple[Vector, Vector, Vector]:
    """Return the unit vector of the thrust in B, and its first and second time derivatives.

    Positive angles (rad) give positive pitch and yaw moments.
    """
    sp, cp = sine_cosine(pitch)
    sy, cy = sine_cosine(yaw)
    p2, y2, py = pitch_rate * pitch_rate, yaw_rate * yaw_rate, 2.0 * pitch_rate * yaw_rate
    axis = (cp * cy, -sy, sp * cy)
    rate = (-sp * cy * pitch_rate - cp * sy * yaw_rate, -cy * yaw_rate, cp * cy * pitch_rate - sp * sy * yaw_rate)
    accel = (
        -sp * cy * pitch_accel - cp * sy * yaw_accel - cp * cy * (p2 + y2) + sp * sy * py,
        -cy * yaw_accel + sy * y2,
        cp * cy * pitch_accel - sp * sy * yaw_accel - sp * cy * (p2 + y2) - cp * sy * py,
    )
    return axis, rate, accel


class Deflected(NamedTuple):
    """A deflected engine at one instant, in B (m)."""

    axis: Vector  # unit vector of the thrust
    gimbal: Vector  # gimbal point relative to the core CG
    delta: Vector  # engine CG relative to its rest position, and its derivatives
    delta_rate: Vector
    delta_accel: Vector
    relative_rate: Vector  # angular velocity of the engine relative to the body, and its derivative
    relative_accel: Vector


@dataclass
class KeptEngine:
    """The values of `Deflected` as a record."""

    axis: Annotated[Array, (3,)]
    gimbal_m: Annotated[Array, (3,)]
    delta_m: Annotated[Array, (3,)]
    delta_rate_mps: Annotated[Array, (3,)]
    delta_accel_mps2: Annotated[Array, (3,)]
    relative_rate_radps: Annotated[Array, (3,)]
    relative_accel_radps2: Annotated[Array, (3,)]


KeptEngines = tuple[KeptEngine, ...]


@kernel
def deflected_engine(
    e: Engine, k: int, axis: Vector, axis_rate: Vector, axis_accel: Vector, properties: Array
) -> Deflected:
    arm = e.cg_from_gimbal_m[k]
    return Deflected(
        axis,
        gimbal_point(e, k, properties),
        scaled(arm, (e.rest_x[k] - axis[0], e.rest_y[k] - axis[1], e.rest_z[k] - axis[2])),
        scaled(-arm, axis_rate),
        scaled(-arm, axis_accel),
        cross(axis, axis_rate),
        cross(axis, axis_accel),
    )


@kernel
def gimbal_point(e: Engine, k: int, properties: Array) -> Vector:
    """Return the position of engine k's gimbal relative to the core CG, B, m."""
    return (
        properties[CORE_CG] - e.gimbal_station_m[k],
        e.gimbal_offset_y_m[k] - properties[CORE_CG + 1],
        e.gimbal_offset_z_m[k] - properties[CORE_CG + 2],
    )


@kernel
def put_deflected(kept: KeptEngine, engine: Deflected) -> None:
    """Store an engine after the first for the other parts of the derivative."""
    set_vector(kept.axis, 0, engine.axis)
    set_vector(kept.gimbal_m, 0, engine.gimbal)
    set_vector(kept.delta_m, 0, engine.delta)
    set_vector(kept.delta_rate_mps, 0, engine.delta_rate)
    set_vector(kept.delta_accel_mps2, 0, engine.delta_accel)
    set_vector(kept.relative_rate_radps, 0, engine.relative_rate)
    set_vector(kept.relative_accel_radps2, 0, engine.relative_accel)


@kernel
def deflected_at(kept: KeptEngine) -> Deflected:
    return Deflected(
        vector_at(kept.axis, 0),
        vector_at(kept.gimbal_m, 0),
        vector_at(kept.delta_m, 0),
        vector_at(kept.delta_rate_mps, 0),
        vector_at(kept.delta_accel_mps2, 0),
        vector_at(kept.relative_rate_radps, 0),
        vector_at(kept.relative_accel_radps2, 0),
    )


@kernel
def beside_axis(e: Engine, k: int) -> tuple[float, float]:
    """Return the offset of engine k's CG at rest from the body axis along y and z, m."""
    arm = e.cg_from_gimbal_m[k]
    return e.gimbal_offset_y_m[k] - arm * e.rest_y[k], e.gimbal_offset_z_m[k] - arm * e.rest_z[k]


@kernel
def thrust(e: Engine, k: int, vacuum_thrust_N: float, ambient_pressure_Pa: float) -> float:
    """Return the thrust of engine k at the ambient pressure, N.

    It is never negative, because the flow would separate from the nozzle.
    """
    strength: float = max(e.thrust_factor[k] * vacuum_thrust_N - ambient_pressure_Pa * e.exit_area_m2[k], 0.0)
    return strength


@kernel
def total_thrust(e: Engine, sizes: Counts, properties: Array, ambient_pressure_Pa: float) -> float:
    """Return the sum of the thrusts of all engines at rest along the body axis, N."""
    total: float = e.rest_x[0] * thrust(e, 0, properties[THRUST_VACUUM], ambient_pressure_Pa)
    for k in range(1, sizes.engines):
        vacuum_N = properties[thrust_column(sizes, e.curve[k])]
        total += e.rest_x[k] * thrust(e, k, vacuum_N, ambient_pressure_Pa)
    return total


@kernel
def flow_share(e: Engine, sizes: Counts, k: int, properties: Array) -> float:
    """Return the share of engine k in the mass flow."""
    if sizes.engines == 1:
        return 1.0
    own, total = 0.0, 0.0
    for j in range(sizes.engines):
        flow = e.flow_weight[j] * properties[thrust_column(sizes, e.curve[j])]
        own = flow if j == k else own
        total += flow
    return own / total if total > 0.0 else 0.0


class GroupRow(NamedTuple):
    """The logged values of a group of engines, in a vehicle with several groups."""

    gimbal_group_axis_command_deg: Annotated[PitchYaw, "deg", "command to the actuators"]
    gimbal_group_axis_angle_deg: Annotated[PitchYaw, "deg", "gimbal angle"]
    gimbal_group_axis_rate_degps: Annotated[PitchYaw, "deg/s", "gimbal rate"]


@kernel
def group_row(further_groups: int, group: int, command_rad: Array, engines: EngineOutputs) -> GroupRow:
    """Return the row of a group; all values are nan for a group that the stage does not have."""
    if group > further_groups:
        none = PitchYaw(math.nan, math.nan)
        return GroupRow(none, none, none)
    pitch, yaw = engines.channel[2 * group], engines.channel[2 * group + 1]
    return GroupRow(
        gimbal_group_axis_command_deg=PitchYaw(DEG * command_rad[2 * group], DEG * command_rad[2 * group + 1]),
        gimbal_group_axis_angle_deg=PitchYaw(DEG * pitch.angle_rad, DEG * yaw.angle_rad),
        gimbal_group_axis_rate_degps=PitchYaw(DEG * pitch.rate_radps, DEG * yaw.rate_radps),
    )


class EngineRow(NamedTuple):
    """The logged values of an engine, in a vehicle with several engines."""

    thrust_engine_N: Annotated[float, "N", "thrust at ambient pressure"]


@kernel
def engine_row(e: Engine, number: int, engines: EngineOutputs) -> EngineRow:
    """Return the row of an engine; the value is nan for an engine that the stage does not have."""
    if e.parts[number] == 0.0:
        return EngineRow(math.nan)
    return EngineRow(thrust_engine_N=engines.thrust_N[e.taken_as[number]] / e.parts[number])
