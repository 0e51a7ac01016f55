"""Flight metrics: maxima and totals gathered in the kernel at every step.

A metric is declared as a field of `MetricIndex` (sim/flight/metric_table.py) and updated in `gather`. `Extremes`
contains the value and the time of each metric.
"""

from __future__ import annotations

import math

from maxq.control.kernel.jit import kernel, rare_routine, routine
from maxq.control.kernel.limits import MAX_PENDULUMS, MAX_TRAIL
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import vector_at
from maxq.sim.flight.launch import track_release, track_tower
from maxq.sim.flight.metric_table import N_METRICS, MetricIndex
from maxq.sim.flight.parameters import Extremes, Memory, Parameters, Trail
from maxq.sim.vehicle.derivative import StageRecord
from maxq.sim.vehicle.schedule import TOTAL_MASS
from maxq.sim.vehicle.slosh.kernel import bob_mass, wave_share
from maxq.sim.vehicle.state import R_I, V_I, Sizes, counts, pendulum_index
from maxq.sim.vehicle.workspace import Aux, Evaluation
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2

SIGNIFICANT_PRESSURE_PA = 1000.0  # below this dynamic pressure the angle of attack has no consequence


METRIC = MetricIndex(*range(N_METRICS))


@kernel
def raise_to(extremes: Extremes, metric: int, value: float, now_ns: int) -> None:
    if value > extremes.value[metric]:
        extremes.value[metric] = value
        extremes.time_ns[metric] = now_ns


@kernel
def largest_error(error_rad: Array) -> tuple[float, float]:
    """Return the largest errors of roll, and of pitch and yaw, deg."""
    return math.degrees(abs(error_rad[0])), math.degrees(max(abs(error_rad[1]), abs(error_rad[2])))


@routine
def gather(p: Parameters, memory: Memory, now_ns: int, step_s: float, at: Evaluation) -> None:
    """Update all metrics with an evaluation at the start of a step of `step_s`."""
    props, y, aux, extremes = at.properties, at.y, at.aux, memory.extremes
    turning = p.environment.earth.rate_radps
    vx, vy, vz = y[V_I] + turning * y[R_I + 1], y[V_I + 1] - turning * y[R_I], y[V_I + 2]
    raise_to(extremes, METRIC.max_speed_mps, math.sqrt(vx * vx + vy * vy + vz * vz), now_ns)
    raise_to(extremes, METRIC.max_altitude_m, aux.air.altitude_m, now_ns)
    raise_to(extremes, METRIC.max_mach, aux.air.mach, now_ns)
    q = aux.air.dynamic_pressure_Pa
    raise_to(extremes, METRIC.max_dynamic_pressure_Pa, q, now_ns)
    thrust_N = aux.engines.axial_thrust_N
    thrust_g = thrust_N / props[TOTAL_MASS] / STANDARD_GRAVITY_mps2
    raise_to(extremes, METRIC.max_thrust_over_weight_g, thrust_g, now_ns)
    sensed = (aux.aero_force_B_N[0] + thrust_N + memory.held.settling_N) / props[TOTAL_MASS]
    raise_to(extremes, METRIC.max_axial_load_g, abs(sensed) / STANDARD_GRAVITY_mps2, now_ns)
    _gather_bending(extremes, p.vehicle.sizes, now_ns, aux)
    if p.launch.tower_m > 0.0 and memory.launch.clear == 0:
        track_tower(p.environment.earth, p.launch, memory.launch, y, props, now_ns)
    if now_ns <= memory.launch.watched_ns:
        track_release(memory.launch, aux.gyro_bending_radps, now_ns)
    if memory.held.burning == 0 or memory.held.on_pad == 1:
        return
    raise_to(extremes, METRIC.max_powered_dynamic_pressure_Pa, q, now_ns)
    _gather_incidence(extremes, q, aux, now_ns)
    _, force_y, force_z = vector_at(aux.specific_force_B_mps2, 0)
    lateral_mps2 = math.sqrt(force_y * force_y + force_z * force_z)
    raise_to(extremes, METRIC.max_lateral_load_g, lateral_mps2 / STANDARD_GRAVITY_mps2, now_ns)
    roll_deg, lateral_deg = largest_error(memory.truth.error_rad)
    raise_to(extremes, METRIC.max_attitude_error_deg, lateral_deg, now_ns)
    raise_to(extremes, METRIC.max_roll_error_deg, roll_deg, now_ns)
    roll_deg, lateral_deg = largest_error(memory.computer.attitude.error_rad)
    raise_to(extremes, METRIC.max_computer_attitude_error_deg, lateral_deg, now_ns)
    raise_to(extremes, METRIC.max_computer_roll_error_deg, roll_deg, now_ns)
    pitch, yaw = aux.engines.channel[0], aux.engines.channel[1]
    gimbal = max(abs(pitch.angle_rad), abs(yaw.angle_rad))
    raise_to(extremes, METRIC.max_gimbal_deg, math.degrees(gimbal), now_ns)
    gimbal_rate = max(abs(pitch.rate_radps), abs(yaw.rate_radps))
    raise_to(extremes, METRIC.max_gimbal_rate_degps, math.degrees(gimbal_rate), now_ns)
    _gather_slosh(p.vehicle, memory, now_ns, props, y)
    limited = memory.computer.command_limited
    if limited[0] == 1 or limited[1] == 1:
        extremes.value[METRIC.saturation_time_s] += step_s
        extremes.time_ns[METRIC.saturation_time_s] = now_ns


@rare_routine
def keep_state(trail: Trail, now_ns: int, y: Array) -> None:
    """Keep position and velocity in I of the state `y` in the trail, which must be due."""
    if trail.count == MAX_TRAIL:
        trail.count //= 2
        trail.period_ns *= 2
        for k in range(trail.count):
            trail.time_ns[k] = trail.time_ns[2 * k]
            for axis in range(3):
                trail.r_I_m[3 * k + axis] = trail.r_I_m[6 * k + axis]
                trail.v_I_mps[3 * k + axis] = trail.v_I_mps[6 * k + axis]
    k = trail.count
    trail.time_ns[k] = now_ns
    for axis in range(3):
        trail.r_I_m[3 * k + axis], trail.v_I_mps[3 * k + axis] = y[R_I + axis], y[V_I + axis]
    trail.count = k + 1
    trail.next_ns = (now_ns // trail.period_ns + 1) * trail.period_ns


@kernel
def angle_above(lateral: float, axial: float, floor_deg: float) -> float:
    """Return the angle atan2(lateral, axial), deg, or 0 if its tangent is not above `floor_deg`.

    An angle never exceeds its tangent, so that small angles need no arc tangent.
    """
    if axial > 0.0 and math.degrees(lateral) <= floor_deg * axial:
        return 0.0
    return math.degrees(math.atan2(lateral, axial))


@kernel
def _gather_incidence(extremes: Extremes, q: float, aux: Aux, now_ns: int) -> None:
    if q > SIGNIFICANT_PRESSURE_PA:
        u, v, w = vector_at(aux.air.flow_B_mps, 0)
        lateral = math.sqrt(v * v + w * w)
        floor_deg = min(extremes.value[METRIC.max_alpha_deg], extremes.value[METRIC.max_q_alpha_Padeg] / q)
        alpha_deg = angle_above(lateral, u, floor_deg)
        raise_to(extremes, METRIC.max_alpha_deg, alpha_deg, now_ns)
        raise_to(extremes, METRIC.max_q_alpha_Padeg, q * alpha_deg, now_ns)


@kernel
def _gather_bending(extremes: Extremes, sizes: Sizes, now_ns: int, aux: Aux) -> None:
    if sizes.pitch_modes + sizes.yaw_modes + sizes.spatial_modes > 0:
        move_y, move_z = aux.gimbal_bending.moved_y_m, aux.gimbal_bending.moved_z_m
        raise_to(extremes, METRIC.max_bending_m, math.sqrt(move_y * move_y + move_z * move_z), now_ns)


@kernel
def _gather_slosh(vehicle: StageRecord, memory: Memory, now_ns: int, props: Array, y: Array) -> None:
    sizes, extremes, waves = counts(vehicle.sizes), memory.extremes, memory.waves
    for tank in range(sizes.pendulums):
        if bob_mass(props, tank) > 0.0:
            i = pendulum_index(sizes, tank)
            lateral = math.sqrt(y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])
            angle_deg = angle_above(lateral, -y[i], extremes.value[METRIC.max_slosh_deg])
            raise_to(extremes, METRIC.max_slosh_deg, angle_deg, now_ns)
            share = wave_share(vehicle.slosh, tank, props, lateral)
            k = memory.clock.stage * MAX_PENDULUMS + tank
            if share > waves.largest[k]:
                waves.largest[k], waves.largest_ns[k] = share, now_ns
                if share >= 1.0 and waves.broke_ns[k] < 0:
                    waves.broke_ns[k] = now_ns
