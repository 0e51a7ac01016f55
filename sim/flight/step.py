"""One step of the classical fourth-order Runge-Kutta method over a stretch in which nothing switches."""

from __future__ import annotations

import math

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import interpolate_into
from maxq.sim.flight.injection import BODY_FORCE, BODY_TORQUE, total_signal
from maxq.sim.flight.parameters import Memory, Parameters
from maxq.sim.vehicle.derivative import complete, derivative
from maxq.sim.vehicle.schedule import THRUST_VACUUM
from maxq.sim.vehicle.state import Q_BI, counts, pendulum_index, state_size


@kernel
def schedule_clock(p: Parameters, now_ns: int, elapsed_s: float) -> float:
    """Schedule time, s, `elapsed_s` after the instant `now_ns`."""
    if p.timeline.frozen == 1:
        return p.timeline.frozen_s
    return p.timeline.burn_rate * (1e-9 * (now_ns - p.timeline.stage_start_ns) + elapsed_s)


@routine
def read_schedule(p: Parameters, pool: Array, memory: Memory, now_ns: int, elapsed_s: float, properties: Array) -> None:
    """The vehicle `elapsed_s` after `now_ns`. An engine that does not burn has no thrust, whatever its table says."""
    clock_s = schedule_clock(p, now_ns, elapsed_s)
    interpolate_into(pool, p.vehicle.schedule, memory.clock.interval, clock_s, properties, 0)
    complete(p.vehicle, properties)
    if memory.held.burning == 0:
        properties[THRUST_VACUUM] = 0.0


@routine
def evaluate(
    p: Parameters, pool: Array, memory: Memory, now_ns: int, elapsed_s: float, properties: Array, y: Array, dy: Array,
    work: Array, aux: Array,
) -> None:  # fmt: skip
    """Derivative `elapsed_s` into the step that starts at `now_ns`."""
    held = memory.held
    if p.injections.count > 0:
        held.force_x_N = total_signal(p.injections, pool, BODY_FORCE, 0, now_ns, elapsed_s)
        held.force_y_N = total_signal(p.injections, pool, BODY_FORCE, 1, now_ns, elapsed_s)
        held.force_z_N = total_signal(p.injections, pool, BODY_FORCE, 2, now_ns, elapsed_s)
        held.torque_x_Nm = total_signal(p.injections, pool, BODY_TORQUE, 0, now_ns, elapsed_s)
        held.torque_y_Nm = total_signal(p.injections, pool, BODY_TORQUE, 1, now_ns, elapsed_s)
        held.torque_z_Nm = total_signal(p.injections, pool, BODY_TORQUE, 2, now_ns, elapsed_s)
    if p.environment.turbulence.on == 1:
        tick = p.environment.turbulence.tick_ns
        since = 1e-9 * (now_ns - memory.clock.next_gust_ns + tick) + elapsed_s
        held.turbulence_phase = 1e9 * since / tick
    derivative(p.vehicle, p.environment, pool, held, memory.gusts, properties, y, dy, work, aux)


@routine
def runge_kutta(
    p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, y: Array, k_1: Array, y_end: Array,
    y_stage: Array, k: Array, properties_mid: Array, properties_end: Array, work: Array, aux: Array,
) -> None:  # fmt: skip
    """State `step_ns` after `now_ns` into `y_end`, given the derivative `k_1` at its start.

    Classical method of order four (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, table 1.2).
    """
    n = state_size(counts(p.vehicle.sizes))
    h = 1e-9 * step_ns
    read_schedule(p, pool, memory, now_ns, 0.5 * h, properties_mid)
    read_schedule(p, pool, memory, now_ns, h, properties_end)
    for i in range(n):
        y_stage[i] = y[i] + 0.5 * h * k_1[i]
        y_end[i] = y[i] + h / 6.0 * k_1[i]
    evaluate(p, pool, memory, now_ns, 0.5 * h, properties_mid, y_stage, k, work, aux)
    for i in range(n):
        y_stage[i] = y[i] + 0.5 * h * k[i]
        y_end[i] += h / 3.0 * k[i]
    evaluate(p, pool, memory, now_ns, 0.5 * h, properties_mid, y_stage, k, work, aux)
    for i in range(n):
        y_stage[i] = y[i] + h * k[i]
        y_end[i] += h / 3.0 * k[i]
    evaluate(p, pool, memory, now_ns, h, properties_end, y_stage, k, work, aux)
    for i in range(n):
        y_end[i] += h / 6.0 * k[i]
    restore_constraints(p, y_end)


@kernel
def restore_constraints(p: Parameters, y: Array) -> None:
    """Bring the quaternion and the pendulums' unit vectors back to length one, and their rates at right angles."""
    a, b, c, d = y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3]
    scale = 1.0 / math.sqrt(a * a + b * b + c * c + d * d)
    for j in range(4):
        y[Q_BI + j] *= scale
    sizes = counts(p.vehicle.sizes)
    for tank in range(sizes.tanks):
        i = pendulum_index(sizes, tank)
        scale = 1.0 / math.sqrt(y[i] * y[i] + y[i + 1] * y[i + 1] + y[i + 2] * y[i + 2])
        for j in range(3):
            y[i + j] *= scale
        along = y[i] * y[i + 3] + y[i + 1] * y[i + 4] + y[i + 2] * y[i + 5]
        for j in range(3):
            y[i + 3 + j] -= along * y[i + j]
