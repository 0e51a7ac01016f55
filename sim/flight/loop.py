"""The flight: steps from instant to instant, with the computer's samples, events, metrics and log rows in between."""

from __future__ import annotations

from dataclasses import dataclass

from maxq.control.computer import start_computer
from maxq.control.kernel.jit import bare_pointer, entry, kernel, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.tables import find_interval
from maxq.sim.flight.arena import PROPERTIES_SIZE, workspace_of
from maxq.sim.flight.events import (
    detect_loss_of_control,
    divergence_cause,
    event_function,
    process_due_events,
    record_event,
    step_length,
    transfer_state,
)
from maxq.sim.flight.metrics import N_METRICS, gather
from maxq.sim.flight.parameters import (
    APOGEE,
    DIVERGED,
    FINITE,
    IMPACT,
    LIFTOFF,
    N_EVENTS,
    NEVER,
    Memory,
    Parameters,
)
from maxq.sim.flight.step import evaluate, read_schedule, runge_kutta, schedule_clock
from maxq.sim.flight.telemetry import fill_fast, fill_slow
from maxq.sim.vehicle.environment import climb_rate, climbs_certainly
from maxq.sim.vehicle.nearby import ANCHOR_DUE
from maxq.sim.vehicle.state import Sizes, counts, state_size
from maxq.sim.vehicle.workspace import ALTITUDE, ANCHOR, AXIAL_LOAD, PRESSURE
from maxq.sim.world.turbulence import turbulence_start


@dataclass(frozen=True)
class Logged:
    """How wide a log's bending and slosh rows are: the widest stage's; `on` = 0 for no log."""

    on: int
    sizes: Sizes


@entry
def begin(P: Array, pool: Array, state: Array, y: Array) -> None:
    """Set the memory of a flight to its start; `y` holds the initial state of the first stage already."""
    p, memory = P[0], state[0]
    clock = memory.clock
    clock.started = 1
    for event in range(N_EVENTS):
        clock.event_ns[event] = -1
    for stage in range(len(P)):
        clock.stage_burnout_ns[stage] = -1
        clock.stage_separation_ns[stage] = -1
    for metric in range(N_METRICS):
        memory.extremes.value[metric] = 0.0
        memory.extremes.time_ns[metric] = -1
    clock.command_due_ns = NEVER
    clock.next_gust_ns = clock.now_ns if p.environment.turbulence.on == 1 else NEVER
    turbulence_start(p.environment.turbulence, pool, memory.gusts, climb_rate(p.environment.earth, y)[0])
    start_computer(p.computer, pool, memory.computer, 1e-9 * clock.now_ns)
    clock.next_sample_ns = clock.now_ns + p.computer.sample_ns
    start_stage(p, pool, memory)


@routine
def start_stage(p: Parameters, pool: Array, memory: Memory) -> None:
    """Schedule and engine at the start of a stage."""
    clock = memory.clock
    now = clock.now_ns
    clock.interval = find_interval(pool, p.vehicle.schedule, schedule_clock(p, now, 0.0))
    clock.fresh, clock.next_break_ns = 1, now
    memory.held.burning = 1 if p.timeline.burn_start_ns <= now < p.timeline.burnout_ns else 0


@entry
def advance(
    P: Array, pool: Array, state: Array, y: Array, arena: Array, until_ns: int, logged: Array,
    fast_ns: IntArray, fast: Array, slow_ns: IntArray, slow: Array, rows: IntArray,
) -> None:  # fmt: skip
    """Fly until `until_ns` or the end of the flight, whichever comes first.

    `P` (stages,) of Parameters, `state` (1,) of Memory, `logged` (1,) of Logged. Log rows go to `fast`, `slow` with
    their times (ns) and counts `rows` (2,). Where a call ends changes nothing in the flight, as long as `until_ns` is
    a multiple of the step.
    """
    memory = state[0]
    clock = memory.clock
    pool, y = bare_pointer(pool), bare_pointer(y)
    y_end, y_stage, k_1, k, properties, properties_mid, properties_end, work, aux, aux_stage = workspace_of(arena)
    swapped = 0
    while clock.finished == 0 and clock.now_ns < until_ns:
        p = P[clock.stage]
        now = clock.now_ns
        if now >= p.timeline.separation_ns and clock.stage + 1 < len(P):
            separate(P, pool, memory, y, properties, properties_end)
            clock.fresh = 1
            continue
        if process_due_events(p, pool, memory, y, aux) == 1 or clock.fresh == 1:
            read_schedule(p, pool, memory, now, 0.0, properties)
            clock.fresh = 0
        work[ANCHOR] = ANCHOR_DUE  # a step's start is worked out exactly; its stages are near it
        evaluate(p, pool, memory, now, 0.0, properties, y, k_1, work, aux)
        detect_loss_of_control(p, memory, y, aux)
        if memory.held.on_pad == 1 and p.timeline.release_ns == NEVER:
            if event_function(p, memory, LIFTOFF, y, properties, aux[AXIAL_LOAD], aux[PRESSURE]) >= 0.0:
                memory.held.on_pad = 0
                record_event(p, memory, LIFTOFF, now)
                continue
        log(p, memory, logged, properties, y, aux, fast_ns, fast, slow_ns, slow, rows, 0)
        step_ns = step_length(p, pool, memory, until_ns)
        gather(
            memory.extremes, p.vehicle, p.environment.earth, memory.held, memory.computer, now, 1e-9 * step_ns,
            properties, y, aux,
        )  # fmt: skip
        if clock.finished == 1:
            break
        runge_kutta(
            p, pool, memory, now, step_ns, y, k_1, y_end, y_stage, k, properties_mid, properties_end, work, aux_stage
        )
        clock.cause = divergence_cause(p, y_end)
        if clock.cause != FINITE:
            record_event(p, memory, DIVERGED, now)
            clock.finished = 1
            break
        event = detect_crossing(p, memory, y_end, properties_end, aux)
        if event >= 0:
            step_ns = locate_event(
                p, pool, memory, event, step_ns, y, k_1, y_end, y_stage, k, properties_mid, properties_end, work,
                aux, aux_stage,
            )  # fmt: skip
        for i in range(state_size(counts(p.vehicle.sizes))):
            y[i] = y_end[i]
        properties, properties_end = properties_end, properties
        swapped = 1 - swapped
        clock.now_ns = now + step_ns
        clock.steps += 1
        if event >= 0:
            apply_event(p, memory, event)
        if clock.now_ns >= p.timeline.stop_ns:
            clock.finished = 1
    if swapped == 1:  # the next call finds the schedule's row where this one found it
        for column in range(PROPERTIES_SIZE):
            properties_end[column] = properties[column]
    if clock.finished == 1 and clock.started == 1:
        clock.started = 2
        p = P[clock.stage]
        read_schedule(p, pool, memory, clock.now_ns, 0.0, properties)
        work[ANCHOR] = ANCHOR_DUE
        evaluate(p, pool, memory, clock.now_ns, 0.0, properties, y, k_1, work, aux)
        gather(
            memory.extremes, p.vehicle, p.environment.earth, memory.held, memory.computer, clock.now_ns, 0.0,
            properties, y, aux,
        )  # fmt: skip
        log(p, memory, logged, properties, y, aux, fast_ns, fast, slow_ns, slow, rows, 1)


@routine
def separate(P: Array, pool: Array, memory: Memory, y: Array, properties: Array, properties_after: Array) -> None:
    """Go over to the next stage."""
    clock = memory.clock
    before, after = P[clock.stage], P[clock.stage + 1]
    read_schedule(before, pool, memory, clock.now_ns, 0.0, properties)
    interval = clock.interval
    clock.interval = find_interval(pool, after.vehicle.schedule, schedule_clock(after, clock.now_ns, 0.0))
    read_schedule(after, pool, memory, clock.now_ns, 0.0, properties_after)
    clock.interval = interval
    transfer_state(before, after, memory, properties, properties_after, y)
    clock.stage += 1
    start_stage(after, pool, memory)


@kernel
def detect_crossing(p: Parameters, memory: Memory, y: Array, properties: Array, aux: Array) -> int:
    """The event that the step to `y` has passed, or -1."""
    clock = memory.clock
    if memory.held.on_pad == 1:
        if p.timeline.release_ns == NEVER:
            if event_function(p, memory, LIFTOFF, y, properties, aux[AXIAL_LOAD], aux[PRESSURE]) >= 0.0:
                return LIFTOFF
        return -1
    if clock.climbing == 1:
        if (
            not climbs_certainly(p.environment.earth, y)
            and event_function(p, memory, APOGEE, y, properties, 0.0, 0.0) >= 0.0
        ):
            return APOGEE
        return -1
    if aux[ALTITUDE] > p.timeline.ground_altitude_m:
        if event_function(p, memory, IMPACT, y, properties, 0.0, 0.0) >= 0.0:
            return IMPACT
    if event_function(p, memory, APOGEE, y, properties, 0.0, 0.0) < 0.0:
        clock.climbing = 1
    return -1


@kernel
def apply_event(p: Parameters, memory: Memory, event: int) -> None:
    """A crossing has been met."""
    if event == LIFTOFF:
        memory.held.on_pad = 0
    if event == APOGEE:
        memory.clock.climbing = 0
    record_event(p, memory, event, memory.clock.now_ns)


@routine
def locate_event(
    p: Parameters, pool: Array, memory: Memory, event: int, step_ns: int, y: Array, k_1: Array, y_end: Array,
    y_stage: Array, k: Array, properties_mid: Array, properties_end: Array, work: Array, aux: Array, aux_stage: Array,
) -> int:  # fmt: skip
    """Shortest step, in whole ns, after which `event` has happened; leaves the state there in `y_end`.

    Regula falsi with bisection every other time, on the step length; each trial repeats the step from its start.
    """
    low, high = 0, step_ns
    at_low, at_high = 0.0, event_function(p, memory, event, y_end, properties_end, aux[AXIAL_LOAD], aux[PRESSURE])
    best = high
    halve = 1
    while high - low > 1:
        trial = (low + high) // 2
        if halve == 0 and at_high > at_low:
            trial = low + int((high - low) * (-at_low) / (at_high - at_low))
            trial = min(max(trial, low + 1), high - 1)
        halve = 1 - halve
        runge_kutta(
            p, pool, memory, memory.clock.now_ns, trial, y, k_1, y_end, y_stage, k, properties_mid, properties_end,
            work, aux_stage,
        )  # fmt: skip
        value = event_function(p, memory, event, y_end, properties_end, aux[AXIAL_LOAD], aux[PRESSURE])
        best = trial
        if value >= 0.0:
            high, at_high = trial, value
        else:
            low, at_low = trial, value
    if best != high:
        runge_kutta(
            p, pool, memory, memory.clock.now_ns, high, y, k_1, y_end, y_stage, k, properties_mid, properties_end, work,
            aux_stage,
        )  # fmt: skip
    return high


@routine
def log(
    p: Parameters, memory: Memory, logged: Array, properties: Array, y: Array, aux: Array, fast_ns: IntArray,
    fast: Array, slow_ns: IntArray, slow: Array, rows: IntArray, last: int,
) -> None:  # fmt: skip
    """Write the rows that are due at this instant; at the flight's end both, whether due or not."""
    if logged[0].on == 0:
        return
    now = memory.clock.now_ns
    if rows[0] > 0 and fast_ns[rows[0] - 1] == now and last == 1:
        return  # the flight ended at an instant that has been logged already
    if now % p.timeline.fast_ns == 0 or last == 1:
        fill_fast(p, logged[0].sizes, memory, properties, y, aux, fast[rows[0]])
        fast_ns[rows[0]] = now
        rows[0] += 1
    if now % p.timeline.slow_ns == 0 or last == 1:
        fill_slow(p, memory, properties, y, aux, slow[rows[1]])
        slow_ns[rows[1]] = now
        rows[1] += 1
