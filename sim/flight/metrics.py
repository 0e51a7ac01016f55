"""What a flight is judged by: extremes and totals gathered in the kernel as it flies.

One definition: the table below names every metric, its unit and meaning; the kernel keeps value and time of each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.computer import ComputerState
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.sim.vehicle.derivative import Held, Vehicle
from maxq.sim.vehicle.schedule import TOTAL_MASS
from maxq.sim.vehicle.slosh import bob_mass
from maxq.sim.vehicle.state import R_I, V_I, counts, pendulum_index
from maxq.sim.vehicle.workspace import (
    AERO_FORCE,
    ALTITUDE,
    DYNAMIC_PRESSURE,
    ENGINE_PITCH,
    ENGINE_YAW,
    FLOW,
    GIMBAL_BEND,
    MACH,
    SPECIFIC_FORCE,
    THRUST,
)
from maxq.sim.world.earth import Earth

STANDARD_GRAVITY_MPS2 = 9.80665
SIGNIFICANT_PRESSURE_PA = 1000.0  # incidence below this dynamic pressure is of no consequence


@dataclass(frozen=True)
class Metric:
    name: str
    meaning: str


METRICS = (
    Metric("max_speed_mps", "largest speed relative to the Earth"),
    Metric("max_altitude_m", "largest altitude"),
    Metric("max_mach", "largest Mach number"),
    Metric("max_dynamic_pressure_Pa", "largest dynamic pressure"),
    Metric("max_powered_dynamic_pressure_Pa", "largest dynamic pressure under thrust"),
    Metric("max_alpha_deg", "largest total incidence while the dynamic pressure exceeds 1 kPa under thrust"),
    Metric(
        "max_q_alpha_Padeg",
        "largest product of dynamic pressure (above 1 kPa) and total incidence under thrust",
    ),
    Metric("max_attitude_error_deg", "largest attitude error of pitch or yaw in the computer under thrust"),
    Metric("max_roll_error_deg", "largest roll error in the computer under thrust"),
    Metric("max_gimbal_deg", "largest engine angle of either axis under thrust"),
    Metric("max_gimbal_rate_degps", "largest engine rate of either axis under thrust"),
    Metric("max_bending_m", "largest displacement of the gimbal by bending, either plane"),
    Metric("max_slosh_deg", "largest angle of a slosh pendulum from the body axis under thrust"),
    Metric("max_thrust_over_weight_g", "largest thrust over mass"),
    Metric("max_axial_load_g", "largest sensed axial specific force at the vehicle's CG"),
    Metric("max_lateral_load_g", "largest sensed lateral specific force at the core CG under thrust"),
    Metric("saturation_time_s", "time during which a gimbal command lies at its limit"),
)
(
    SPEED, ALTITUDE_MAX, MACH_MAX, Q_MAX, Q_POWERED, ALPHA_MAX, Q_ALPHA_MAX, ERROR_MAX, ROLL_MAX, GIMBAL_MAX,
    GIMBAL_RATE_MAX, BENDING_MAX, SLOSH_MAX, THRUST_MAX, AXIAL_MAX, LATERAL_MAX, SATURATION,
) = range(len(METRICS))  # fmt: skip
N_METRICS = len(METRICS)


@dataclass
class Extremes:
    """Value and time of each metric so far."""

    value: Annotated[Array, (N_METRICS,)]
    time_ns: Annotated[IntArray, (N_METRICS,)]


@kernel
def raise_to(extremes: Extremes, metric: int, value: float, now_ns: int) -> None:
    if value > extremes.value[metric]:
        extremes.value[metric] = value
        extremes.time_ns[metric] = now_ns


@routine
def gather(
    extremes: Extremes, vehicle: Vehicle, earth: Earth, held: Held, computer: ComputerState, now_ns: int,
    step_s: float, props: Array, y: Array, aux: Array,
) -> None:  # fmt: skip
    """Update all metrics at the start of a step of `step_s`."""
    turning = earth.rate_radps
    vx, vy, vz = y[V_I] + turning * y[R_I + 1], y[V_I + 1] - turning * y[R_I], y[V_I + 2]
    raise_to(extremes, SPEED, math.sqrt(vx * vx + vy * vy + vz * vz), now_ns)
    raise_to(extremes, ALTITUDE_MAX, aux[ALTITUDE], now_ns)
    raise_to(extremes, MACH_MAX, aux[MACH], now_ns)
    q = aux[DYNAMIC_PRESSURE]
    raise_to(extremes, Q_MAX, q, now_ns)
    raise_to(extremes, THRUST_MAX, aux[THRUST] / props[TOTAL_MASS] / STANDARD_GRAVITY_MPS2, now_ns)
    sensed = (aux[AERO_FORCE] + aux[THRUST]) / props[TOTAL_MASS]
    raise_to(extremes, AXIAL_MAX, abs(sensed) / STANDARD_GRAVITY_MPS2, now_ns)
    _gather_bending(extremes, vehicle, now_ns, aux)
    if held.burning == 0 or held.on_pad == 1:
        return
    raise_to(extremes, Q_POWERED, q, now_ns)
    _gather_incidence(extremes, q, aux, now_ns)
    felt = math.sqrt(
        aux[SPECIFIC_FORCE + 1] * aux[SPECIFIC_FORCE + 1] + aux[SPECIFIC_FORCE + 2] * aux[SPECIFIC_FORCE + 2]
    )
    raise_to(extremes, LATERAL_MAX, felt / STANDARD_GRAVITY_MPS2, now_ns)
    law = computer.law
    error = max(abs(law.theta_e_rad[1] + law.discarded_rad[1]), abs(law.theta_e_rad[2] + law.discarded_rad[2]))
    raise_to(extremes, ERROR_MAX, math.degrees(error), now_ns)
    raise_to(extremes, ROLL_MAX, math.degrees(abs(law.theta_e_rad[0] + law.discarded_rad[0])), now_ns)
    gimbal = max(abs(aux[ENGINE_PITCH]), abs(aux[ENGINE_YAW]))
    raise_to(extremes, GIMBAL_MAX, math.degrees(gimbal), now_ns)
    gimbal_rate = max(abs(aux[ENGINE_PITCH + 1]), abs(aux[ENGINE_YAW + 1]))
    raise_to(extremes, GIMBAL_RATE_MAX, math.degrees(gimbal_rate), now_ns)
    _gather_slosh(extremes, vehicle, now_ns, props, y)
    if computer.law.command_limited[0] == 1 or computer.law.command_limited[1] == 1:
        extremes.value[SATURATION] += step_s
        extremes.time_ns[SATURATION] = now_ns


@kernel
def angle_above(lateral: float, axial: float, floor_deg: float) -> float:
    """Angle atan2(lateral, axial), deg, where it exceeds `floor_deg`, else 0: an angle is never above its tangent."""
    if axial > 0.0 and math.degrees(lateral) <= floor_deg * axial:
        return 0.0
    return math.degrees(math.atan2(lateral, axial))


@kernel
def _gather_incidence(extremes: Extremes, q: float, aux: Array, now_ns: int) -> None:
    if q > SIGNIFICANT_PRESSURE_PA:
        lateral = math.sqrt(aux[FLOW + 1] * aux[FLOW + 1] + aux[FLOW + 2] * aux[FLOW + 2])
        floor_deg = min(extremes.value[ALPHA_MAX], extremes.value[Q_ALPHA_MAX] / q)
        alpha_deg = angle_above(lateral, aux[FLOW], floor_deg)
        raise_to(extremes, ALPHA_MAX, alpha_deg, now_ns)
        raise_to(extremes, Q_ALPHA_MAX, q * alpha_deg, now_ns)


@kernel
def _gather_bending(extremes: Extremes, vehicle: Vehicle, now_ns: int, aux: Array) -> None:
    sizes = counts(vehicle.sizes)
    if sizes.pitch_modes + sizes.yaw_modes > 0:
        move_y, move_z = aux[GIMBAL_BEND], aux[GIMBAL_BEND + 1]
        raise_to(extremes, BENDING_MAX, math.sqrt(move_y * move_y + move_z * move_z), now_ns)


@kernel
def _gather_slosh(extremes: Extremes, vehicle: Vehicle, now_ns: int, props: Array, y: Array) -> None:
    sizes = counts(vehicle.sizes)
    for tank in range(sizes.tanks):
        if bob_mass(vehicle.slosh, props, tank) > 0.0:
            i = pendulum_index(sizes, tank)
            lateral = math.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])
            raise_to(extremes, SLOSH_MAX, angle_above(lateral, -y[i], extremes.value[SLOSH_MAX]), now_ns)
