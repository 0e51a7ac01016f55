"""The flight loop: steps between events, with the computer's samples, metrics and log rows."""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.computer import start_computer, take_over
from maxq.control.kernel.jit import bare_pointer, entry, kernel, routine, routine_beside
from maxq.control.kernel.limits import MAX_PENDULUMS, MAX_STAGES
from maxq.control.kernel.records import Array, IntArray, Records
from maxq.control.kernel.tables import find_interval
from maxq.sim.flight import events, step
from maxq.sim.flight.launch import RAIL_EXIT, leave_rail, lift_off, start_launch
from maxq.sim.flight.metric_table import N_METRICS
from maxq.sim.flight.metrics import gather, keep_state
from maxq.sim.flight.navigation import start_navigation
from maxq.sim.flight.parameters import APOGEE, DIVERGED, IMPACT, LIFTOFF, N_EVENTS, NEVER, Memory, Parameters
from maxq.sim.flight.sequence import await_ignition, begin_clock
from maxq.sim.flight.telemetry import Logged, fill_fast, fill_slow
from maxq.sim.vehicle.block import Q_BI, counts
from maxq.sim.vehicle.environment import ANCHOR_DUE, climb_rate, climbs_certainly, flight_direction
from maxq.sim.vehicle.loads.columns import MAX_EXTREMES
from maxq.sim.vehicle.loads.kernel import evaluate_sections, gather_sections
from maxq.sim.vehicle.schedule import TOTAL_MASS, properties_size
from maxq.sim.vehicle.state import FINITE, divergence_cause, state_size
from maxq.sim.vehicle.workspace import Evaluation
from maxq.sim.world.gust_history import history_start
from maxq.sim.world.turbulence import turbulence_start


class LogRows(NamedTuple):
    """The memory for log rows: times (ns) and values of both rate groups, and the number of rows (2,)."""

    fast_ns: IntArray
    fast: Array
    slow_ns: IntArray
    slow: Array
    counts: IntArray


@entry
def begin(P: Records, pool: Array, state: Records, y: Array) -> None:
    """Set the memory of a flight to its start; `y` must contain the initial state of the first stage."""
    p, memory = P[0], state[0]
    clock = memory.clock
    clock.started, clock.throttled, clock.pending_throttled = 1, 0.0, 0.0
    for event in range(N_EVENTS):
        clock.event_ns[event] = -1
    for stage in range(len(P)):
        clock.stage_burnout_ns[stage] = -1
        clock.stage_separation_ns[stage] = -1
    for extreme in range(MAX_EXTREMES):
        memory.sections.value_ns[extreme], memory.sections.ratio_ns[extreme] = -1, -1
    memory.sections.mismatch_ns = -1
    for metric in range(N_METRICS):
        memory.extremes.value[metric] = 0.0
        memory.extremes.time_ns[metric] = -1
    for pendulum in range(MAX_STAGES * MAX_PENDULUMS):
        memory.waves.largest[pendulum] = 0.0
        memory.waves.largest_ns[pendulum], memory.waves.broke_ns[pendulum] = -1, -1
    memory.burnout.time_ns = -1
    start_launch(memory.launch)
    clock.command_due_ns = NEVER
    clock.next_gust_ns = clock.now_ns if p.environment.turbulence.on == 1 else NEVER
    altitude_m, along_N = climb_rate(p.environment.earth, y)[0], flight_direction(p.environment, pool, y)
    turbulence_start(p.environment.turbulence, pool, memory.gusts, altitude_m, along_N)
    history_start(memory.history, memory.gusts)
    start_computer(p.computer, pool, memory.computer, 1e-9 * clock.now_ns)
    for component in range(4):
        memory.truth.start_q_BI[component] = y[Q_BI + component]
    if p.navigation.on == 1:
        start_navigation(p.navigation, memory.navigation, memory.computer.attitude.measured, y, clock.now_ns)
    clock.next_sample_ns = clock.now_ns + p.computer.sample_ns
    start_stage(p, pool, memory)


@routine
def start_stage(p: Parameters, pool: Array, memory: Memory) -> None:
    """Set the schedule and the engine to the start of a stage."""
    clock = memory.clock
    now = clock.now_ns
    clock.interval = find_interval(pool, p.vehicle.schedule, step.schedule_clock(p, memory.clock, now, 0.0))
    clock.fresh, clock.next_break_ns = 1, now
    memory.faults.next_ns = now if p.faults.count > 0 else NEVER
    clock.separation_ns = p.timeline.separation_ns
    if p.timeline.sequenced == 1:
        await_ignition(p, memory)
        if p.timeline.continues > 0 and memory.held.burning == 0 and clock.stage_burnout_ns[clock.stage - 1] >= 0:
            clock.stage_burnout_ns[clock.stage] = clock.stage_burnout_ns[clock.stage - 1]
        return
    cut_off = clock.cut_off_ns > 0 and clock.stage_burnout_ns[clock.stage - 1] >= 0
    ends_ns = NEVER if 0 < clock.cut_off_ns <= now else p.timeline.burnout_ns + clock.idle_ns
    burns = p.timeline.burn_start_ns <= now < ends_ns and not cut_off
    memory.held.burning = 1 if burns else 0
    if cut_off:  # cutoff in an earlier stage, of which a part has been dropped; the gimbals remain centred
        clock.stage_burnout_ns[clock.stage] = clock.stage_burnout_ns[clock.stage - 1]


@entry
def advance(
    P: Records,
    pool: Array,
    state: Records,
    y: Array,
    arena: Records,
    until_ns: int,
    log_of: Records,
    fast_ns: IntArray,
    fast: Array,
    slow_ns: IntArray,
    slow: Array,
    rows: IntArray,
) -> None:
    """Fly until `until_ns` or the end of the flight, whichever comes first.

    - `P` (stages,): Parameters.
    - `state` (1,), `arena` (1,), `log_of` (1,): Memory, Arena and Logged.
    - `fast_ns`, `fast`, `slow_ns`, `slow`, `rows` (2,): times, values and numbers of log rows.

    The end of a call does not change the flight if `until_ns` is a multiple of the step. With steps of equal length,
    the call ends with the first step that reaches `until_ns`.
    """
    memory, logged = state[0], log_of[0]
    clock = memory.clock
    room = arena[0]
    y_stage, rate, aux = room.y_stage, room.stage_rate, room.stage_aux
    start, middle = room.start_properties, room.middle_properties
    pool = bare_pointer(pool)
    space = step.Workspace(  # not in a function, because no kernel can return a tuple with a record
        start=Evaluation(start, bare_pointer(y), room.start_rate, room.start_aux),
        middle=Evaluation(middle, y_stage, rate, aux),
        end=Evaluation(room.end_properties, y_stage, rate, aux),
        y_end=room.y_end,
        work=room.work,
        columns=room.columns,
        moved=room.moved,
        kept=room.kept,
        between=Evaluation(middle, room.y_between, room.between_rate, aux),
    )
    now_at, log_rows = space.start, LogRows(fast_ns, fast, slow_ns, slow, rows)
    while clock.finished == 0 and clock.now_ns < until_ns:
        p = P[clock.stage]
        if clock.now_ns < clock.separation_ns or clock.stage + 1 == len(P):  # first, because it is slow to compile
            fly_step(p, pool, memory, logged, until_ns, space, log_rows)
        else:
            separate(P, pool, memory, now_at.y, now_at.properties, space.end.properties, space.y_end)
            clock.fresh = 1
    if clock.finished == 1 and clock.started == 1:
        clock.started = 2
        p = P[clock.stage]
        step.read_schedule(p, pool, memory, clock.now_ns, 0.0, now_at.properties)
        evaluate_exactly(p, pool, memory, space)
        if p.loads.stations > 0:
            track_sections(p, pool, memory, space, logged.on, 1)
        gather(p, memory, clock.now_ns, 0.0, now_at)
        if logged.on == 1:
            log(p, memory, logged, now_at, log_rows, clock.now_ns, 1)


@kernel
def fly_step(
    p: Parameters, pool: Array, memory: Memory, logged: Logged, until_ns: int, space: step.Workspace, log_rows: LogRows
) -> None:
    """Process the events due at this instant, log a row, and step to the next instant or event."""
    clock, now_at, now = memory.clock, space.start, memory.clock.now_ns
    if events.process_due_events(p, pool, memory, now_at.y, now_at.aux, now_at.properties) == 1 or clock.fresh == 1:
        step.read_schedule(p, pool, memory, now, 0.0, now_at.properties)
        clock.fresh = 0
    evaluate_exactly(p, pool, memory, space)
    events.detect_loss_of_control(p, memory, now_at.aux)
    if memory.held.on_pad == 1 and p.timeline.release_ns == NEVER:
        if events.event_function(p, memory, LIFTOFF, now_at.y, now_at.properties, now_at.aux) >= 0.0:
            apply_event(p, memory, now_at.y, LIFTOFF)
            return
    if p.loads.stations > 0:
        track_sections(p, pool, memory, space, logged.on, 0)
    if logged.on == 1:
        log(p, memory, logged, now_at, log_rows, now, 0)
    step_ns = events.step_length(p, pool, memory, until_ns)
    gather(p, memory, now, 1e-9 * step_ns, now_at)
    if memory.trail.period_ns > 0 and now >= memory.trail.next_ns:
        keep_state(memory.trail, now, now_at.y)
    if clock.finished == 1:
        return
    step.take_step(p, pool, memory, now, step_ns, space)
    clock.cause = divergence_cause(counts(p.vehicle.sizes), space.y_end)
    if clock.cause != FINITE:
        events.record_event(p, memory, DIVERGED, now)
        clock.finished = 1
        return
    event = detect_crossing(p, memory, space)
    if event >= 0:
        step_ns = locate_event(p, pool, memory, event, step_ns, space)
    if logged.on == 1 and p.timeline.even == 1:
        log_between(p, pool, memory, logged, space, log_rows, step_ns)
    if p.timeline.even == 1 and now >= clock.next_errors_ns and event < 0:
        clock.next_errors_ns = now + step.ERRORS_NS
        step.estimate_errors(p, pool, memory, now, step_ns, space)
    sizes = counts(p.vehicle.sizes)
    for i in range(state_size(sizes)):
        now_at.y[i] = space.y_end[i]
    for column in range(properties_size(sizes)):
        now_at.properties[column] = space.end.properties[column]
    clock.now_ns = now + step_ns
    clock.steps += 1
    if event >= 0:
        apply_event(p, memory, now_at.y, event)
    if clock.now_ns >= p.timeline.stop_ns:
        clock.finished = 1


@kernel
def evaluate_exactly(p: Parameters, pool: Array, memory: Memory, space: step.Workspace) -> None:
    """Evaluate the derivative at the start of a step, whose position becomes the anchor of the later stages."""
    space.work.anchor.state = ANCHOR_DUE
    step.evaluate(p, pool, memory, memory.clock.now_ns, 0.0, space.start, space.work)
    for channel in range(2 + 2 * p.vehicle.sizes.further_groups):
        memory.held.engine_rad[channel] = space.start.aux.engines.channel[channel].angle_rad


@routine
def track_sections(p: Parameters, pool: Array, memory: Memory, space: step.Workspace, logged: int, last: int) -> None:
    """Evaluate section loads that are due for the extremes or a log row, immediately after `evaluate_exactly`."""
    now, sections, at = memory.clock.now_ns, memory.sections, space.start
    due = now >= sections.due_ns
    if not due and (logged == 0 or (now % p.timeline.slow_ns != 0 and last == 0)):
        return
    clock_s = step.schedule_clock(p, memory.clock, now, 0.0)
    mass, cg_m = evaluate_sections(
        p.loads, p.vehicle, memory.inputs, pool, clock_s, at, space.work, space.columns, sections
    )
    if due:
        sections.due_ns = (now // p.loads.period_ns + 1) * p.loads.period_ns
        if memory.held.burning == 1 or memory.held.on_pad == 1 or p.loads.coast == 1:
            gather_sections(
                p.loads, counts(p.vehicle.sizes), memory.clock.stage, now, mass, cg_m, space.columns, sections
            )


@routine
def separate(
    P: Records, pool: Array, memory: Memory, y: Array, properties: Array, properties_after: Array, whole: Array
) -> None:
    """Separate the stage that has burned out, and continue with the next stage.

    `whole` is scratch memory for a state.
    """
    clock = memory.clock
    before, after = P[clock.stage], P[clock.stage + 1]
    ends = after.timeline.continues == 0 and clock.now_ns >= before.timeline.burnout_ns + clock.idle_ns
    if before.timeline.sequenced == 1:
        ends = after.timeline.continues == 0
    if memory.held.burning == 1 and ends:
        events.burn_out(before, memory, y)  # at the same instant, before the separation
        if clock.finished == 1:
            return
    step.read_schedule(before, pool, memory, clock.now_ns, 0.0, properties)
    if before.timeline.sequenced == 1 and begin_clock(after, pool, memory) == 1:
        return
    interval = clock.interval
    clock.interval = find_interval(pool, after.vehicle.schedule, step.schedule_clock(after, clock, clock.now_ns, 0.0))
    step.read_schedule(after, pool, memory, clock.now_ns, 0.0, properties_after)
    clock.interval = interval
    events.transfer_state(before, after, pool, memory, properties, properties_after, whole, y)
    properties[TOTAL_MASS] = properties_after[TOTAL_MASS]  # for a sample at this instant
    clock.stage += 1
    if after.computer.takes_over == 1:
        take_over(before.computer, after.computer, memory.computer)
        begun_ns = clock.next_sample_ns - before.computer.sample_ns
        clock.next_sample_ns = max(clock.now_ns, begun_ns + after.computer.sample_ns)
    start_stage(after, pool, memory)


@kernel
def detect_crossing(p: Parameters, memory: Memory, space: step.Workspace) -> int:
    """Return the event that the step has passed, or -1."""
    clock, aux, y, properties = memory.clock, space.start.aux, space.y_end, space.end.properties
    if memory.held.on_pad == 1:
        if p.timeline.release_ns == NEVER and events.event_function(p, memory, LIFTOFF, y, properties, aux) >= 0.0:
            return LIFTOFF
        return -1
    if memory.held.on_rail == 1 and events.event_function(p, memory, RAIL_EXIT, y, properties, aux) >= 0.0:
        return RAIL_EXIT
    if clock.climbing == 1:
        if (
            not climbs_certainly(p.environment.earth, y)
            and events.event_function(p, memory, APOGEE, y, properties, aux) >= 0.0
        ):
            return APOGEE
        return -1
    # A vehicle that has just left a pad at ground altitude has not come down.
    above = aux.air.altitude_m > p.timeline.ground_altitude_m + 1e-3
    if above and events.event_function(p, memory, IMPACT, y, properties, aux) >= 0.0:
        return IMPACT
    if events.event_function(p, memory, APOGEE, y, properties, aux) < 0.0:
        clock.climbing = 1
    return -1


@kernel
def apply_event(p: Parameters, memory: Memory, y: Array, event: int) -> None:
    """Apply the effects of liftoff, the end of the rail, apogee or impact at the current instant."""
    if event == RAIL_EXIT:
        leave_rail(p.environment.earth, memory.launch, memory.held, y, memory.clock.now_ns)
        return
    if event == LIFTOFF:
        lift_off(p.launch, memory.launch, memory.held, y, memory.clock.now_ns)
    if event == APOGEE:
        memory.clock.climbing = 0
    events.record_event(p, memory, event, memory.clock.now_ns)


@routine
def locate_event(p: Parameters, pool: Array, memory: Memory, event: int, step_ns: int, space: step.Workspace) -> int:
    """Return the shortest step, in whole ns, after which `event` has occurred, and write its state to `space.y_end`.

    Method: regula falsi alternating with bisection, on the step length. Each trial repeats the step from its start.
    """
    now = memory.clock.now_ns
    low, high = 0, step_ns
    at_low, at_high = 0.0, events.event_function(p, memory, event, space.y_end, space.end.properties, space.start.aux)
    best = high
    halve = 1
    while high - low > 1:
        trial = (low + high) // 2
        if halve == 0 and at_high > at_low:
            trial = low + int((high - low) * (-at_low) / (at_high - at_low))
            trial = min(max(trial, low + 1), high - 1)
        halve = 1 - halve
        step.take_step(p, pool, memory, now, trial, space)
        value = events.event_function(p, memory, event, space.y_end, space.end.properties, space.start.aux)
        best = trial
        if value >= 0.0:
            high, at_high = trial, value
        else:
            low, at_low = trial, value
    if best != high:
        step.take_step(p, pool, memory, now, high, space)
    return high


@routine_beside
def log(p: Parameters, memory: Memory, logged: Logged, at: Evaluation, out: LogRows, now: int, last: int) -> None:
    """Write the rows that are due at this instant; at the end of the flight, write both."""
    rows = out.counts
    if rows[0] > 0 and out.fast_ns[rows[0] - 1] == now and last == 1:
        return  # this instant has been logged already
    if now % p.timeline.fast_ns == 0 or last == 1:
        fill_fast(p, logged, memory, at, out.fast[rows[0]])
        out.fast_ns[rows[0]] = now
        rows[0] += 1
    if now % p.timeline.slow_ns == 0 or last == 1:
        fill_slow(p, logged.stations, memory, at, out.slow[rows[1]])
        out.slow_ns[rows[1]] = now
        rows[1] += 1


@routine
def log_between(
    p: Parameters, pool: Array, memory: Memory, logged: Logged, space: step.Workspace, out: LogRows, step_ns: int
) -> None:
    """Write the rows that are due within the last step."""
    clock, fast_ns, slow_ns = memory.clock, p.timeline.fast_ns, p.timeline.slow_ns
    began = clock.now_ns
    due = began
    while True:
        due = min((due // fast_ns + 1) * fast_ns, (due // slow_ns + 1) * slow_ns)
        if due >= began + step_ns:
            break
        step.evaluate_between(p, pool, memory, began, step_ns, due - began, space)
        clock.now_ns = due  # rows compute the Earth's rotation from this time
        if p.loads.stations > 0 and due % slow_ns == 0:
            clock_s = step.schedule_clock(p, memory.clock, due, 0.0)
            at = space.between
            evaluate_sections(
                p.loads, p.vehicle, memory.inputs, pool, clock_s, at, space.work, space.columns, memory.sections
            )
        log(p, memory, logged, space.between, out, due, 0)
    clock.now_ns = began
