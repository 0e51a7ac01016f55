"""One step of the classical fourth-order Runge-Kutta method over a stretch in which nothing switches."""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.kernel.jit import bare_pointer, kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import interpolate_into
from maxq.control.kernel.vectors import Vector, add, scaled, set_vector
from maxq.sim.flight.injection import BODY_FORCE, BODY_TORQUE, total_signal
from maxq.sim.flight.parameters import Memory, Parameters
from maxq.sim.vehicle.block import counts
from maxq.sim.vehicle.derivative import derivative, derive_properties
from maxq.sim.vehicle.loads import MAX_LOAD_COLUMNS
from maxq.sim.vehicle.schedule import CORE_CG, thrust_column
from maxq.sim.vehicle.state import MAX_STATE, restore_constraints, state_size
from maxq.sim.vehicle.workspace import AUX_SIZE, CROSSFLOW_PART, PART_WIND, PROPERTIES_SIZE, WORK_SIZE, Evaluation
from maxq.sim.world.gust_history import gust_behind
from maxq.sim.world.turbulence import turbulence_at


class Workspace(NamedTuple):
    """The arrays that a step works with, besides the flight's own state."""

    start: Evaluation  # at the start of the step, with the state of the flight
    middle: Evaluation  # at its later stages; `middle` and `end` have properties of their own, and share the rest
    end: Evaluation
    y_end: Array  # state at the end of the step
    work: Array  # scratch memory of the derivative
    columns: Array  # of the section loads


_Y_END = 0
_Y_STAGE = _Y_END + MAX_STATE
_K_1 = _Y_STAGE + MAX_STATE
_K = _K_1 + MAX_STATE
_START = _K + MAX_STATE
_MIDDLE = _START + PROPERTIES_SIZE
_END = _MIDDLE + PROPERTIES_SIZE
_WORK = _END + PROPERTIES_SIZE
_AUX = _WORK + WORK_SIZE
_AUX_STAGE = _AUX + AUX_SIZE
_COLUMNS = _AUX_STAGE + AUX_SIZE
ARENA_SIZE = _COLUMNS + MAX_LOAD_COLUMNS


@kernel
def workspace_of(arena: Array, y: Array) -> Workspace:
    """Parts of `arena` (ARENA_SIZE,) and the state `y`, as bare pointers."""
    y_stage, k = bare_pointer(arena[_Y_STAGE:_K_1]), bare_pointer(arena[_K:_START])
    aux = bare_pointer(arena[_AUX_STAGE:_COLUMNS])
    return Workspace(
        start=Evaluation(
            bare_pointer(arena[_START:_MIDDLE]),
            bare_pointer(y),
            bare_pointer(arena[_K_1:_K]),
            bare_pointer(arena[_AUX:_AUX_STAGE]),
        ),
        middle=Evaluation(bare_pointer(arena[_MIDDLE:_END]), y_stage, k, aux),
        end=Evaluation(bare_pointer(arena[_END:_WORK]), y_stage, k, aux),
        y_end=bare_pointer(arena[_Y_END:_Y_STAGE]),
        work=bare_pointer(arena[_WORK:_AUX]),
        columns=bare_pointer(arena[_COLUMNS:ARENA_SIZE]),
    )


@kernel
def schedule_clock(p: Parameters, now_ns: int, elapsed_s: float) -> float:
    """Schedule time, s, `elapsed_s` after the instant `now_ns`."""
    if p.timeline.frozen == 1:
        return p.timeline.frozen_s
    return p.timeline.burn_rate * (1e-9 * (now_ns - p.timeline.stage_start_ns) + elapsed_s)


@routine
def read_schedule(p: Parameters, pool: Array, memory: Memory, now_ns: int, elapsed_s: float, properties: Array) -> None:
    """Properties of the vehicle `elapsed_s` after `now_ns`; no thrust from an engine that does not burn."""
    clock_s = schedule_clock(p, now_ns, elapsed_s)
    interpolate_into(pool, p.vehicle.schedule, memory.clock.interval, clock_s, properties, 0)
    derive_properties(p.vehicle, pool, clock_s, properties)
    if memory.held.burning == 0:
        sizes = counts(p.vehicle.sizes)
        for curve in range(sizes.thrust_curves):
            properties[thrust_column(sizes, curve)] = 0.0


@routine
def evaluate(
    p: Parameters, pool: Array, memory: Memory, now_ns: int, elapsed_s: float, at: Evaluation, work: Array
) -> None:  # fmt: skip  # nine lines otherwise
    """Derivative `elapsed_s` into the step that starts at `now_ns`."""
    inputs = memory.inputs
    if p.injections.count > 0:
        inputs.force_x_N = total_signal(p.injections, pool, BODY_FORCE, 0, now_ns, elapsed_s)
        inputs.force_y_N = total_signal(p.injections, pool, BODY_FORCE, 1, now_ns, elapsed_s)
        inputs.force_z_N = total_signal(p.injections, pool, BODY_FORCE, 2, now_ns, elapsed_s)
        inputs.torque_x_Nm = total_signal(p.injections, pool, BODY_TORQUE, 0, now_ns, elapsed_s)
        inputs.torque_y_Nm = total_signal(p.injections, pool, BODY_TORQUE, 1, now_ns, elapsed_s)
        inputs.torque_z_Nm = total_signal(p.injections, pool, BODY_TORQUE, 2, now_ns, elapsed_s)
    if p.environment.turbulence.on == 1:
        tick = p.environment.turbulence.tick_ns
        since_s = 1e-9 * (now_ns - memory.clock.next_gust_ns + tick) + elapsed_s
        gust = turbulence_at(memory.gusts, 1e9 * since_s / tick)
        if p.environment.penetration == 1:
            gust = gusts_along_body(p, memory, 1e9 * since_s / tick, at.properties[CORE_CG], work)
        inputs.gust_x_mps, inputs.gust_y_mps, inputs.gust_z_mps = gust
    derivative(p.vehicle, p.environment, pool, memory.held, inputs, at, work)


@kernel
def gusts_along_body(p: Parameters, memory: Memory, fraction: float, cg_m: float, work: Array) -> Vector:
    """Turbulence at the core CG; at each part, less that, into the workspace. The nose meets it first."""
    here = gust_behind(memory.history, memory.gusts, fraction, max(cg_m, 0.0))
    parts = counts(p.vehicle.sizes).surfaces
    for k in range(parts + 1):
        station, at = (
            (p.vehicle.aero.crossflow_station_m, CROSSFLOW_PART) if k == parts else (p.vehicle.aero.station_m[k], k)
        )
        there = gust_behind(memory.history, memory.gusts, fraction, max(station, 0.0))
        set_vector(work, PART_WIND + 3 * at, add(there, scaled(-1.0, here)))
    return here


@routine
def runge_kutta(p: Parameters, pool: Array, memory: Memory, now_ns: int, step_ns: int, space: Workspace) -> None:
    """State `step_ns` after `now_ns` into `space.y_end`, given state, properties and derivative at its start.

    Classical method of order four (Hairer, Norsett & Wanner, Solving Ordinary Differential Equations I, table 1.2).
    """
    n = state_size(counts(p.vehicle.sizes))
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
    restore_constraints(counts(p.vehicle.sizes), y_end)
