"""Gimballed engine: thrust, and direction of the thrust with its time derivatives.

The engine is mounted on a gimbal behind the vehicle and follows the actuators exactly. With the engine straight its
mass is part of the core; `rigid.engine_reaction` adds the effects of a deflection ("tail wags dog").
"""

from __future__ import annotations

from dataclasses import dataclass

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.vectors import Vector, sine_cosine


@dataclass(frozen=True)
class Engine:
    exit_area_m2: float
    thrust_factor: float
    gimbal_station_m: float
    exit_station_m: float
    gimbal_offset_y_m: float
    gimbal_offset_z_m: float
    misalignment_pitch_rad: float
    misalignment_yaw_rad: float
    gimballed_mass_kg: float
    cg_from_gimbal_m: float  # aft of the gimbal, along the engine's axis
    inertia_kgm2: float  # about the engine's own CG, taken as isotropic


@kernel
def thrust_axis_motion(
    pitch: float, pitch_rate: float, pitch_accel: float, yaw: float, yaw_rate: float, yaw_accel: float
) -> tuple[Vector, Vector, Vector]:
    """Unit vector of the thrust in B with its first and second time derivative.

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


@kernel
def thrust(engine: Engine, vacuum_thrust_N: float, ambient_pressure_Pa: float) -> float:
    """Thrust against the ambient pressure, N; never negative: so weak a flow separates from the nozzle."""
    return max(engine.thrust_factor * vacuum_thrust_N - ambient_pressure_Pa * engine.exit_area_m2, 0.0)
