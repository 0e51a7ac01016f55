"""Integration steps by Runge-Kutta methods of order four over intervals without switching."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import disjoint_routine, kernel, rare_routine, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import interpolate_into
from maxq.control.kernel.vectors import Vector, add, scaled, set_vector
from maxq.sim.flight.injection import BODY_FORCE, BODY_TORQUE, THRUST, total_signal
from maxq.sim.flight.metrics import gather
from maxq.sim.flight.oscillators import (
    BLOCK_WIDTH,
    COUNT,
    FORCED,
    FORCED_HALF,
    HEAD,
    KEPT_SIZE,
    LARGEST,
    LAST,
    MIDDLE,
    MOVED_SIZE,
    MOVED_WIDTH,
    TURNED,
    TURNED_HALF,
    blocks_for,
    row_times,
)
from maxq.sim.flight.parameters import ERRORS_SQUARED, NEVER, Clock, Memory, Parameters
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle import state as states
from maxq.sim.vehicle.block import Q_BI, R_I, V_I, Counts, counts
from maxq.sim.vehicle.derivative import derivative, derive_properties
from maxq.sim.vehicle.engine.kernel import EngineOutputs
from maxq.sim.vehicle.environment import CROSSFLOW_PART
from maxq.sim.vehicle.loads.columns import MAX_LOAD_COLUMNS
from maxq.sim.vehicle.slosh.kernel import bob_mass
from maxq.sim.vehicle.workspace import PROPERTIES_SIZE, Aux, Evaluation, Work
from maxq.sim.world.gust_history import gust_behind
from maxq.sim.world.turbulence import turbulence_at


class Workspace(NamedTuple):
    """The arrays of a step in addition to the flight's own state."""

    start: Evaluation  # at the start of the step, with the state of the flight
    middle: Evaluation  # at the later stages; `middle` and `end` have separate properties, and share all other arrays
    end: Evaluation
    y_end: Array  # state at the end of the step
    work: Work  # scratch memory of the derivative
    columns: Array  # columns of the section loads
    moved: Array  # for each block of oscillators, values passed between the stages
    kept: Array  # matrices of the blocks, see oscillators.py
    between: Evaluation  # at an instant within the step


ERRORS_NS = 500_000_000
"""The time between two estimates of a flight's integration errors."""


@dataclass
class Arena:
    """The memory of a Workspace."""

    y_end: Annotated[Array, (states.MAX_STATE,)]
    y_stage: Annotated[Array, (states.MAX_STATE,)]
    start_rate: Annotated[Array, (states.MAX_STATE,)]
    stage_rate: Annotated[Array, (states.MAX_STATE,)]
    start_properties: Annotated[Array, (PROPERTIES_SIZE,)]
    middle_properties: Annotated[Array, (PROPERTIES_SIZE,)]
    end_properties: Annotated[Array, (PROPERTIES_SIZE,)]
    work: Work
    start_aux: Aux
    stage_aux: Aux
    columns: Annotated[Array, (MAX_LOAD_COLUMNS,)]
    moved: Annotated[Array, (MOVED_SIZE,)]
    kept: Annotated[Array, (KEPT_SIZE,)]
    y_between: Annotated[Array, (states.MAX_STATE,)]
    between_rate: Annotated[Array, (states.MAX_STATE,)]


@kernel
def schedule_clock(p: Parameters, clock: Clock, now_ns: int, elapsed_s: float) -> float:
    """Return the schedule time, s, `elapsed_s` after the instant `now_ns`; it is constant after a cutoff."""
    if 0 < clock.cut_off_ns <= now_ns:
        now_ns, elapsed_s = clock.cut_off_ns, 0.0
    if p.timeline.frozen == 1:
        return p.timeline.frozen_s
    lag_s = clock.throttled * (1e-9 * (now_ns - clock.throttled_ns) + elapsed_s)  # 0 without throttling
    return p.timeline.burn_rate * (1e-9 * (now_ns - p.timeline.stage_start_ns - clock.idle_ns) + elapsed_s - lag_s)


@kernel
def flight_instant(clock: Clock, instant_ns: int) -> int:
    """Return the instant at which the schedule reaches `instant_ns` of the flight time of an undisturbed schedule."""
    if clock.throttled == 0.0 or instant_ns >= NEVER:
        return instant_ns + clock.idle_ns
    left_ns: int = instant_ns + clock.idle_ns - clock.throttled_ns
    return clock.throttled_ns + math.ceil(left_ns / (1.0 - clock.throttled))


@disjoint_routine
def read_schedule(p: Parameters, pool: Array, memory: Memory, now_ns: int, elapsed_s: float, properties: Array) -> None:
    """Write the properties of the vehicle `elapsed_s` after `now_ns`; an engine that does not burn has no thrust."""
    clock_s = schedule_clock(p, memory.clock, now_ns, elapsed_s)
    interpolate_into(pool, p.vehicle.schedule, memory.clock.interval, clock_s, properties, 0)
    if 0 < memory.clock.cut_off_ns <= now_ns:
        stop_flow(counts(p.vehicle.sizes), properties)
    if memory.clock.throttled != 0.0:
        throttle_engines(counts(p.vehicle.sizes), 1.0 - memory.clock.throttled, properties)
    derive_properties(p.vehicle, pool, clock_s, properties)
    if memory.clock.throttled != 0.0 and p.vehicle.sizes.feed_lines > 0:
        throttle_feed_lines(counts(p.vehicle.sizes), 1.0 - memory.clock.throttled, properties)
    decay_ns, since_cutoff_ns = memory.clock.decay_ns, now_ns - memory.clock.cut_off_ns
    if decay_ns > 0 and memory.clock.cut_off_ns > 0 and since_cutoff_ns >= 0:
        left = max(1.0 - (since_cutoff_ns + 1e9 * elapsed_s) / decay_ns, 0.0)
        sizes = counts(p.vehicle.sizes)
        for curve in range(sizes.thrust_curves):
            properties[sch.thrust_column(sizes, curve)] *= left
    if memory.held.burning == 0:
        sizes = counts(p.vehicle.sizes)
        for curve in range(sizes.thrust_curves):
            properties[sch.thrust_column(sizes, curve)] = 0.0


@kernel
def stop_flow(sizes: Counts, properties: Array) -> None:
    """Set the rates of the vehicle's properties to zero, because no propellant flows after a cutoff."""
    for column in range(sch.CG_RATE, sch.TOTAL_MASS):
        properties[column] = 0.0
    properties[sch.MASS_FLOW] = 0.0
    for tank in range(sizes.pendulums):
        properties[sch.tank_column(tank) + sch.TANK_MASS_RATE] = 0.0
        properties[sch.tank_column(tank) + sch.TANK_TRAVEL] = 0.0


@rare_routine
def throttle_engines(sizes: Counts, throttle: float, properties: Array) -> None:
    """Multiply the thrust of all engines, and the rates of the vehicle's properties, by the throttle."""
    for column in range(sch.CG_RATE, sch.TOTAL_MASS):
        properties[column] *= throttle
    properties[sch.MASS_FLOW] *= throttle
    for tank in range(sizes.pendulums):
        properties[sch.tank_column(tank) + sch.TANK_MASS_RATE] *= throttle
        properties[sch.tank_column(tank) + sch.TANK_TRAVEL] *= throttle
    for curve in range(sizes.thrust_curves):
        properties[sch.thrust_column(sizes, curve)] *= throttle


@rare_routine
def throttle_feed_lines(sizes: Counts, throttle: float, properties: Array) -> None:
    """Multiply the resistances of all feed lines by the throttle.

    The pressure drop of turbulent flow is proportional to the square of the flow, and its slope to the flow.
    """
    for line in range(sizes.feed_lines):
        first = sch.feed_column(sizes, line)
        properties[first + sch.FEED_RESISTANCE] *= throttle
        properties[first + sch.FEED_DISCHARGE_RESISTANCE] *= throttle


@routine
def evaluate(
    p: Parameters, pool: Array, memory: Memory, now_ns: int, elapsed_s: float, at: Evaluation, work: Work
) -> None:
    """Evaluate the derivative `elapsed_s` after the start of the step at `now_ns`."""
    inputs = memory.inputs
    if p.injections.count > 0:
        inputs.force_x_N = total_signal(p.injections, pool, BODY_FORCE, 0, now_ns, elapsed_s)
        inputs.force_y_N = total_signal(p.injections, pool, BODY_FORCE, 1, now_ns, elapsed_s)
        inputs.force_z_N = total_signal(p.injections, pool, BODY_FORCE, 2, now_ns, elapsed_s)
        inputs.torque_x_Nm = total_signal(p.injections, pool, BODY_TORQUE, 0, now_ns, elapsed_s)
        inputs.torque_y_Nm = total_signal(p.injections, pool, BODY_TORQUE, 1, now_ns, elapsed_s)
        inputs.torque_z_Nm = total_signal(p.injections, pool, BODY_TORQUE, 2, now_ns, elapsed_s)
        inputs.thrust_share = total_signal(p.injections, pool, THRUST, 0, now_ns, elapsed_s)
    inputs.now_ns, inputs.elapsed_s = now_ns, elapsed_s
    if p.environment.turbulence.on == 1:
        tick = p.environment.turbulence.tick_ns
        since_s = 1e-9 * (now_ns - memory.clock.next_gust_ns + tick) + elapsed_s
        gust = turbulence_at(memory.gusts, 1e9 * since_s / tick)
        if p.environment.penetration == 1:
            gust = gusts_along_body(p, memory, 1e9 * since_s / tick, at.properties[sch.CORE_CG], work.aero.wind_B_mps)
        inputs.gust_x_mps, inputs.gust_y_mps, inputs.gust_z_mps = gust
    derivative(p.vehicle, p.environment, pool, memory.held, inputs, at, work)


@kernel
def gusts_along_body(p: Parameters, memory: Memory, fraction: float, cg_m: float, wind_B_mps: Array) -> Vector:
    """Return the turbulence at the core CG, and write the difference at each part to `wind_B_mps`.

    The nose meets the turbulence first. `fraction`: part of the time to the next tick, as in `turbulence_at`.
    """
    here = gust_behind(memory.history, memory.gusts, fraction, max(cg_m, 0.0))
    parts = counts(p.vehicle.sizes).surfaces
    for k in range(parts + 1):
        station, at = (
            (p.vehicle.aero.crossflow_station_m, CROSSFLOW_PART) if k == parts else (p.vehicle.aero.station_m[k], k)
        )
        there = gust_behind(memory.history, memory.gusts, fraction, max(station, 0.0))
        set_vector(wind_B_mps, 3 * at, add(there, scaled(-1.0, here)))
    return here


@routine
def runge_kutta(p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, space: Workspace) -> None:
    """Write the state `step_ns` after `now_ns` to `space.y_end`, given state, properties and derivative at its start.

    Method: the classical method of order four (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I,
    table 1.2).
    """
    n = states.state_size(counts(p.vehicle.sizes))
    h = 1e-9 * step_ns
    y, k_1, y_end, y_stage, k = space.start.y, space.start.dy, space.y_end, space.middle.y, space.middle.dy
    read_schedule(p, pool, memory, now_ns, 0.5 * h, space.middle.properties)
    read_schedule(p, pool, memory, now_ns, h, space.end.properties)
    for i in range(n):
        y_stage[i] = y[i] + 0.5 * h * k_1[i]
        y_end[i] = y[i] + h / 6.0 * k_1[i]
    evaluate(p, pool, memory, now_ns, 0.5 * h, space.middle, space.work)
    for i in range(n):
        y_stage[i] = y[i] + 0.5 * h * k[i]
        y_end[i] += h / 3.0 * k[i]
    evaluate(p, pool, memory, now_ns, 0.5 * h, space.middle, space.work)
    for i in range(n):
        y_stage[i] = y[i] + h * k[i]
        y_end[i] += h / 3.0 * k[i]
    evaluate(p, pool, memory, now_ns, h, space.end, space.work)
    for i in range(n):
        y_end[i] += h / 6.0 * k[i]
    states.restore_constraints(counts(p.vehicle.sizes), y_end)


@routine
def exponential_runge_kutta(
    p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, space: Workspace
) -> None:
    """Take a step as `runge_kutta` does, with the exact motion of the fast linear parts under a constant force.

    Method: the exponential method of order four, B4 of S. Krogstad, Generalized integrating factor methods for stiff
    PDEs, J. Comput. Phys. 203 (2005), 72. It is written in terms of r, the derivative minus that at the start minus D
    times the motion since the start. For D = 0 it is the classical method.
    """
    n = states.state_size(counts(p.vehicle.sizes))
    h = 1e-9 * step_ns
    y, k_1, y_end, y_stage, k = space.start.y, space.start.dy, space.y_end, space.middle.y, space.middle.dy
    kept, moved = space.kept, space.moved
    slot = blocks_for(kept, p.vehicle, memory.clock.stage, now_ns, step_ns, space.start)
    blocks = int(kept[slot + COUNT])
    read_schedule(p, pool, memory, now_ns, 0.5 * h, space.middle.properties)
    read_schedule(p, pool, memory, now_ns, h, space.end.properties)
    for i in range(n):
        y_stage[i] = y[i] + 0.5 * h * k_1[i]
        y_end[i] = y[i] + h / 6.0 * k_1[i]
    for b in range(blocks):
        _block_stage(kept, slot + HEAD + BLOCK_WIDTH * b, moved, MOVED_WIDTH * b, 2, y, k_1, k, y_stage)
    evaluate(p, pool, memory, now_ns, 0.5 * h, space.middle, space.work)
    for i in range(n):
        y_stage[i] = y[i] + 0.5 * h * k[i]
        y_end[i] += h / 3.0 * k[i]
    for b in range(blocks):
        _block_stage(kept, slot + HEAD + BLOCK_WIDTH * b, moved, MOVED_WIDTH * b, 3, y, k_1, k, y_stage)
    evaluate(p, pool, memory, now_ns, 0.5 * h, space.middle, space.work)
    gather(p, memory, now_ns + step_ns // 2, 0.0, space.middle)  # long steps would miss peaks
    for i in range(n):
        y_stage[i] = y[i] + h * k[i]
        y_end[i] += h / 3.0 * k[i]
    for b in range(blocks):
        _block_stage(kept, slot + HEAD + BLOCK_WIDTH * b, moved, MOVED_WIDTH * b, 4, y, k_1, k, y_stage)
    evaluate(p, pool, memory, now_ns, h, space.end, space.work)
    for i in range(n):
        y_end[i] += h / 6.0 * k[i]
    for b in range(blocks):
        _block_stage(kept, slot + HEAD + BLOCK_WIDTH * b, moved, MOVED_WIDTH * b, 5, y, k_1, k, y_end)
    states.restore_constraints(counts(p.vehicle.sizes), y_end)


@kernel
def _block_stage(
    kept: Array, block: int, moved: Array, at: int, stage: int, y: Array, k_1: Array, k: Array, out: Array
) -> None:
    """Write the states of one block at stage 2, 3 or 4, or at the end of the step (5), to `out`.

    `k` is the derivative at the previous stage. `moved[at:]` contains five vectors of the block:

    - the derivative at the start;
    - the motion since the start at the previous stage;
    - the motion at the end under the constant force;
    - r, and its sum over the middle stages.
    """
    first, stride, n, matrices = int(kept[block]), int(kept[block + 1]), int(kept[block + 2]), int(kept[block + 3])
    if n == 2:  # with literal numbers the compiler unrolls the loops
        _block_of(2, first, stride, matrices, kept, moved, at, stage, y, k_1, k, out)
    elif n == 6:
        _block_of(6, first, stride, matrices, kept, moved, at, stage, y, k_1, k, out)
    else:
        _block_of(n, first, stride, matrices, kept, moved, at, stage, y, k_1, k, out)


@kernel
def _block_of(
    n: int,
    first: int,
    stride: int,
    matrices: int,
    kept: Array,
    moved: Array,
    at: int,
    stage: int,
    y: Array,
    k_1: Array,
    k: Array,
    out: Array,
) -> None:
    start, last, end, now, total = at, at + LARGEST, at + 2 * LARGEST, at + 3 * LARGEST, at + 4 * LARGEST
    size = n * n
    for j in range(n):
        i = first + stride * j
        if stage == 2:
            moved[start + j] = k_1[i]
        else:
            moved[now + j] = k[i] - k_1[i] - row_times(kept, matrices, j, n, moved, last)
    for j in range(n):
        i = first + stride * j
        if stage == 2:
            moved[last + j] = row_times(kept, matrices + FORCED_HALF * size, j, n, moved, start)
        elif stage == 3:
            moved[total + j] = moved[now + j]
            moved[last + j] += row_times(kept, matrices + TURNED_HALF * size, j, n, moved, now)
        elif stage == 4:
            moved[total + j] += moved[now + j]
            moved[end + j] = row_times(kept, matrices + FORCED * size, j, n, moved, start)
            moved[last + j] = moved[end + j] + row_times(kept, matrices + TURNED * size, j, n, moved, now)
        else:
            moved[last + j] = moved[end + j] + row_times(kept, matrices + MIDDLE * size, j, n, moved, total)
            moved[last + j] += row_times(kept, matrices + LAST * size, j, n, moved, now)
        out[i] = y[i] + moved[last + j]


@routine
def take_step(p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, space: Workspace) -> None:
    """Write the state `step_ns` after `now_ns` to `space.y_end`, by the integration method of this flight."""
    if p.timeline.even == 1:
        exponential_runge_kutta(p, pool, memory, now_ns, step_ns, space)
    else:
        runge_kutta(p, pool, memory, now_ns, step_ns, space)


@routine
def estimate_errors(p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, space: Workspace) -> None:
    """Repeat the step as two halves, and add the estimated error to the flight's error.

    The error is multiplied by the number of such steps between two estimates. An attitude error rotates the specific
    force, and a speed error becomes a position error in time. The state at the end of the step is restored;
    `space.start` is overwritten.

    Errors of smooth steps are added as if they never cancelled. If an engine reaches or leaves an edge of its play or a
    stop within the step, the instant is arbitrary and the error has either sign. Such errors are added as squares.

    For a method of order four the difference is 15/16 of the error (Hairer, Norsett & Wanner I, section II.4).
    """
    sizes, errors, whole, y_end = counts(p.vehicle.sizes), memory.errors, space.between.y, space.y_end
    n, half_ns = states.state_size(sizes), step_ns // 2
    met = starts_or_stops(p.vehicle.sizes.further_groups, space.start.aux.engines, space.end.aux.engines)
    for i in range(n):
        whole[i] = y_end[i]
    take_step(p, pool, memory, now_ns, half_ns, space)
    for i in range(n):
        space.start.y[i] = y_end[i]
    read_schedule(p, pool, memory, now_ns + half_ns, 0.0, space.start.properties)
    evaluate(p, pool, memory, now_ns + half_ns, 0.0, space.start, space.work)
    take_step(p, pool, memory, now_ns + half_ns, step_ns - half_ns, space)
    met = met or starts_or_stops(p.vehicle.sizes.further_groups, space.start.aux.engines, space.end.aux.engines)
    steps, share, between_s = ERRORS_NS / step_ns, 16.0 / 15.0, 1e-9 * ERRORS_NS
    turned, away, faster, pushed = 0.0, 0.0, 0.0, 0.0
    for i in range(Q_BI, Q_BI + 4):
        turned += (whole[i] - y_end[i]) ** 2
    for i in range(3):
        away += (whole[R_I + i] - y_end[R_I + i]) ** 2
        faster += (whole[V_I + i] - y_end[V_I + i]) ** 2
        pushed += space.end.aux.specific_force_B_mps2[i] ** 2
    bent, swung = 0.0, 0.0
    for first, modes in (
        (states.eta_index(sizes), sizes.pitch_modes), (states.xi_index(sizes), sizes.yaw_modes),
        (states.spatial_index(sizes), sizes.spatial_modes),
    ):  # fmt: skip  # a table
        for i in range(first, first + modes):
            bent = max(bent, abs(whole[i] - y_end[i]))
    for tank in range(sizes.pendulums):
        if bob_mass(space.end.properties, tank) <= 0.0:  # its states stopped when the tank became empty within the step
            continue
        i = states.pendulum_index(sizes, tank)
        for j in range(i, i + 3):
            swung = max(swung, abs(whole[j] - y_end[j]))
    of_step = (share * math.degrees(2.0 * math.sqrt(turned)), share * bent, share * math.degrees(swung))
    for i in range(3):
        if met:
            errors[ERRORS_SQUARED + i] += steps * of_step[i] ** 2
        else:
            errors[i] += steps * of_step[i]
    turned_rad = math.radians(errors[0] + math.sqrt(errors[ERRORS_SQUARED]))
    errors[4] += steps * share * math.sqrt(faster) + between_s * math.sqrt(pushed) * turned_rad
    errors[3] += steps * share * math.sqrt(away) + between_s * errors[4]
    for i in range(n):
        y_end[i] = whole[i]


@kernel
def starts_or_stops(further_groups: int, before: EngineOutputs, after: EngineOutputs) -> bool:
    """Return True if an engine rests at one of two evaluations and moves at the other."""
    for channel in range(2 + 2 * further_groups):
        if (before.channel[channel].rate_radps == 0.0) != (after.channel[channel].rate_radps == 0.0):
            return True
    return False


@routine
def evaluate_between(
    p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, elapsed_ns: int, space: Workspace
) -> None:
    """Write state and derivative `elapsed_ns` after the start of the last step to `space.between`.

    The state is that of the cubic of the method (Hairer, Norsett & Wanner I, section II.6). The cubic has the states of
    both ends and the derivatives of the first and the last stage.
    """
    n, h, x = states.state_size(counts(p.vehicle.sizes)), 1e-9 * step_ns, elapsed_ns / step_ns
    y, k_1, y_end, k_4, out = space.start.y, space.start.dy, space.y_end, space.end.dy, space.between.y
    for i in range(n):
        out[i] = y[i] + x * x * (3.0 - 2.0 * x) * (y_end[i] - y[i])
        out[i] += h * x * (1.0 - x) * ((1.0 - x) * k_1[i] - x * k_4[i])
    states.restore_constraints(counts(p.vehicle.sizes), out)
    elapsed_s = 1e-9 * elapsed_ns
    read_schedule(p, pool, memory, now_ns, elapsed_s, space.between.properties)
    evaluate(p, pool, memory, now_ns, elapsed_s, space.between, space.work)
