"""The sequence of a flight that external flight code commands: ignitions, cutoffs, throttle and separations.

Without flight code, the ignition, burnout and separation of a stage have fixed times on its clock. Here the tables of a
stage are held at their ignition (`Clock.cut_off_ns`) until the code commands it, and `Clock.idle_ns` contains the time
by which the schedule is behind. A separation moves the zero of the next stage's clock to its instant. A stage that
continues keeps its clock: its tables depend on the propellant consumed.

A command acts `delay_ns` after its sample if it was 0 at the preceding sample, and is ignored where it has no effect.
"""

from __future__ import annotations

from maxq.control.external import (
    ABORTED,
    BAD_SEPARATION,
    EARLY,
    FAIRING_SEPARATION,
    FIRST_SEPARATION_SWITCH,
    LIFTOFF_SWITCH,
    TOO_MANY,
)
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.sim.flight.parameters import MAX_IGNITIONS, N_COMMANDS, NEVER, Memory, Parameters
from maxq.sim.flight.step import schedule_clock
from maxq.sim.vehicle.block import counts
from maxq.sim.vehicle.faults import LIFTOFF_SWITCH_STUCK, SAMPLE_LOST, SEPARATION_SWITCH_STUCK
from maxq.sim.vehicle.sensor.gauges import read_gauges

EARLIEST_S = 1e-6  # by which a separation may precede the first time of the next tables


@routine
def hand_over_discretes(p: Parameters, pool: Array, memory: Memory, properties: Array) -> None:
    """Write the inputs of flight code that are neither gyro nor guidance: sensors, gauges and switches."""
    inputs, clock, faults, received = (
        memory.computer.external.inputs,
        memory.clock,
        memory.held.faults,
        memory.receivers,
    )
    clock_s = schedule_clock(p, clock, clock.now_ns, 0.0)
    read_gauges(
        p.gauges,
        p.vehicle.engine,
        counts(p.vehicle.sizes),
        pool,
        clock_s,
        properties,
        inputs.chamber_pressure,
        inputs.tank_kg,
    )
    inputs.discretes = 0
    if memory.held.on_pad == 0 and faults[LIFTOFF_SWITCH_STUCK] == 0.0:
        inputs.discretes += LIFTOFF_SWITCH
    if faults[SEPARATION_SWITCH_STUCK] == 0.0:
        inputs.discretes += FIRST_SEPARATION_SWITCH * ((1 << clock.stage) - 1)
    memory.computer.external.health = received.health
    memory.computer.external.gyro_lost = 1 if faults[SAMPLE_LOST] > 0.0 else 0
    sensors = p.computer.sensors
    inputs.imu_count = min(1 + sensors.gyros, sensors.count - sensors.gyros)
    inputs.gnss_number, inputs.gnss_time_s = received.gnss.number, 1e-9 * received.gnss.valid_ns
    inputs.pressure_Pa = received.pressure_Pa
    for axis in range(3):
        inputs.gnss_r_E_m[axis], inputs.gnss_v_E_mps[axis] = (
            received.gnss.solution[axis],
            received.gnss.solution[3 + axis],
        )
        inputs.magnetic_B_T[axis] = received.magnetic_B_T[axis]


@routine
def obey(p: Parameters, memory: Memory) -> None:
    """Carry out the commands of the last sample, which take effect later, and end the flight after a wrong one."""
    clock, external, out = memory.clock, memory.computer.external, memory.computer.external.outputs
    due_ns = max(clock.now_ns + p.computer.delay_ns, clock.now_ns + 1)
    given = (out.ignition, out.cutoff, out.stage_separation, out.booster_separation, out.fairing_separation)
    for k in range(N_COMMANDS):
        asked, memory.asked[k] = memory.asked[k], 1 if given[k] != 0 else 0
        if asked != 0 or given[k] == 0:
            continue
        if k == 0:
            ignite(p, memory, due_ns)
        elif k == 1:
            if memory.held.burning == 1 and clock.cut_off_ns == 0:
                clock.cut_off_ns = due_ns + round(1e9 * out.cutoff_delay_s)
                clock.decay_ns = p.timeline.decay_ns
        elif p.timeline.separates != k - 1:
            external.fault, external.code = BAD_SEPARATION, k - 1
        elif clock.separation_ns == NEVER:
            clock.separation_ns = due_ns
    if out.throttle != 0.0:
        clock.pending_throttled = 1.0 - out.throttle
    if out.abort != 0:
        external.fault, external.code = ABORTED, out.abort


@kernel
def ignite(p: Parameters, memory: Memory, due_ns: int) -> None:
    """Command an ignition if the engine is off and has propellant left."""
    clock = memory.clock
    if memory.held.burning == 1 or clock.cut_off_ns == 0 or clock.ignite_ns > 0:
        return
    if clock.cut_off_ns - clock.idle_ns >= p.timeline.burnout_ns:
        return
    if clock.restarts >= MAX_IGNITIONS:
        memory.computer.external.fault = TOO_MANY
        return
    clock.ignite_ns = due_ns


@kernel
def await_ignition(p: Parameters, memory: Memory) -> None:
    """Hold the tables of a stage that begins now at their ignition, unless its engine burns on from the last stage."""
    clock = memory.clock
    clock.separation_ns = NEVER
    if p.timeline.continues > 0 and (memory.held.burning == 1 or clock.cut_off_ns > 0):
        return
    if p.timeline.burn_start_ns < NEVER:
        clock.cut_off_ns, clock.decay_ns = max(p.timeline.burn_start_ns + clock.idle_ns, 1), 0


@kernel
def begin_clock(after: Parameters, pool: Array, memory: Memory) -> int:
    """Set the clock of the stage `after`, which begins now.

    Returns 1, and ends the flight, if a stage that continues has no tables yet: more propellant is left than at their
    first time.
    """
    clock, timeline = memory.clock, after.timeline
    if timeline.continues == 0:
        clock.idle_ns = clock.now_ns - timeline.stage_start_ns
        clock.cut_off_ns, clock.ignite_ns = 0, 0
        clock.throttled, clock.pending_throttled = 0.0, 0.0
    elif schedule_clock(after, clock, clock.now_ns, 0.0) < pool[after.vehicle.schedule.offset] - EARLIEST_S:
        memory.computer.external.fault = EARLY
        clock.finished = 1
        return 1
    return 0


assert N_COMMANDS == 2 + FAIRING_SEPARATION
