"""Events: commands that take effect, ignition, burnout, separation, and events that depend on the state.

Instants known in advance are met exactly, because no step extends beyond them. Liftoff, apogee, impact and the end of
the rail depend on the state. A step that crosses such an event is repeated with adjusted lengths until the crossing is
known to the nanosecond.
"""

from __future__ import annotations

import math

from maxq.control.computer import computer_tick
from maxq.control.external import commanded_attitude
from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel, routine, routine_beside
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.noise import standard_normal, uniform_pair
from maxq.control.kernel.records import Array
from maxq.sim.flight.faults import switch_faults
from maxq.sim.flight.injection import GIMBAL_COMMAND, RATE_COMMAND, next_switch, replaced, total_signal
from maxq.sim.flight.launch import RAIL_EXIT, lift_off, rail_surplus
from maxq.sim.flight.navigation import advance_navigation
from maxq.sim.flight.parameters import (
    APOGEE,
    BURNOUT,
    CONTROL_LOST,
    DROPS,
    LIFTOFF,
    NEVER,
    SEPARATION,
    TUMBLE,
    Memory,
    Parameters,
)
from maxq.sim.flight.sequence import hand_over_discretes, obey
from maxq.sim.flight.step import flight_instant
from maxq.sim.vehicle import state as states
from maxq.sim.vehicle.block import Q_BI, R_I, V_I, W_BI_B, Counts, counts
from maxq.sim.vehicle.engine.kernel import total_thrust
from maxq.sim.vehicle.environment import Environment, climb_rate, flight_direction, velocity_over_ground
from maxq.sim.vehicle.faults import ANY_FAULT, GYRO_LOST, GYRO_WALK, SAMPLE_LOST
from maxq.sim.vehicle.schedule import CORE_CG, TOTAL_MASS
from maxq.sim.vehicle.sensor.further import SENSOR_STREAM, sensor_slots
from maxq.sim.vehicle.sensor.gyro import GYRO_STREAM
from maxq.sim.vehicle.sensor.receivers import measure
from maxq.sim.vehicle.workspace import Aux
from maxq.sim.world.atmosphere import air
from maxq.sim.world.earth import local_frame
from maxq.sim.world.gust_history import history_tick
from maxq.sim.world.turbulence import turbulence_tick


@kernel
def record_event(p: Parameters, memory: Memory, event: int, now_ns: int) -> None:
    """Record the first occurrence of an event, and end the flight if the event is in run.stop_at."""
    if memory.clock.event_ns[event] < 0:
        memory.clock.event_ns[event] = now_ns
        if event == LIFTOFF and p.faults.count > 0:
            memory.faults.next_ns = now_ns  # from now on, the instants of faults timed from liftoff are known
    if (p.timeline.stop_mask >> event) & 1 == 1:
        memory.clock.finished = 1


@routine
def burn_out(p: Parameters, memory: Memory, y: Array) -> None:
    """End the thrust of a stage now; it is a burnout unless the guidance has commanded a cutoff before a restart."""
    clock, burnout = memory.clock, memory.burnout
    memory.held.burning = 0
    clock.stage_burnout_ns[clock.stage] = clock.now_ns
    burnout.time_ns = clock.now_ns
    vec.set_vector(burnout.r_I_m, 0, vec.vector_at(y, R_I))
    vec.set_vector(burnout.v_I_mps, 0, vec.vector_at(y, V_I))
    if clock.cut_off_ns == 0 and p.computer.burns.count > 0:
        memory.computer.burns.depleted = 1
    if clock.cut_off_ns > 0 and memory.computer.burns.number + 1 < p.computer.burns.count:
        return
    clock.event_ns[BURNOUT] = -1  # the burnout of the last stage counts
    record_event(p, memory, BURNOUT, clock.now_ns)


@kernel
def restart(memory: Memory) -> None:
    """Ignite the engine; its schedule continues from the time of the cutoff, or begins if it has not burned yet."""
    clock, n = memory.clock, memory.clock.restarts
    clock.restart_ns[n], clock.restart_cut_off_ns[n], clock.restart_stage[n] = (
        clock.now_ns,
        clock.cut_off_ns,
        clock.stage,
    )
    clock.restarts += 1
    clock.idle_ns += clock.now_ns - clock.cut_off_ns
    clock.cut_off_ns, clock.ignite_ns = 0, 0
    clock.throttled, clock.pending_throttled = 0.0, 0.0
    clock.stage_burnout_ns[clock.stage] = -1
    clock.fresh, clock.next_break_ns = 1, clock.now_ns
    memory.held.burning, memory.held.settling_N, clock.pending_settling_N = 1, 0.0, 0.0


@routine
def process_due_events(p: Parameters, pool: Array, memory: Memory, y: Array, aux: Aux, properties: Array) -> int:
    """Process all events that are due now.

    Returns 1 if the engine was ignited for the first time, burned out or was cut off, otherwise 0. A restart sets
    `clock.fresh` instead.
    """
    clock, held = memory.clock, memory.held
    now = clock.now_ns
    if clock.throttled != 0.0 and (clock.cut_off_ns == 0 or now <= clock.cut_off_ns):
        clock.idle_ns += int(clock.throttled * (now - clock.throttled_ns))
        clock.throttled_ns = now
    if 0 < clock.ignite_ns <= now:
        restart(memory)
    advance_schedule(p, pool, memory)
    changed = 0
    burnout_ns = flight_instant(clock, p.timeline.burnout_ns)
    cut_off = 0 < clock.cut_off_ns <= now
    if clock.decay_ns > 0 and clock.cut_off_ns == now:
        clock.fresh = 1
    ignites = held.burning == 0 and p.timeline.burn_start_ns <= now < burnout_ns and not cut_off
    if ignites and p.timeline.sequenced == 0:
        held.burning = 1
        changed = 1
    if cut_off:  # thrust decays without flow, hence beyond the burnout
        burnout_ns = clock.cut_off_ns + clock.decay_ns
    if held.burning == 1 and now >= burnout_ns:
        burn_out(p, memory, y)
        changed = 1
    if held.on_pad == 1 and now >= p.timeline.release_ns:
        lift_off(p.launch, memory.launch, held, y, now)
        record_event(p, memory, LIFTOFF, now)
    if now >= memory.faults.next_ns:
        liftoff_ns = clock.event_ns[LIFTOFF]
        sensors = states.sensor_index(p.vehicle.sizes, 0)
        switch_faults(p.faults, memory.faults, now, liftoff_ns, NEVER, clock.stage, sensors, y, held.faults)
    if now >= clock.next_gust_ns:
        clock.next_gust_ns = now + p.environment.turbulence.tick_ns
        if clock.steps > 0:  # the first gust was drawn at the start
            along_N = flight_direction(p.environment, pool, y)
            turbulence, air = p.environment.turbulence, aux.air
            turbulence_tick(turbulence, pool, memory.gusts, air.airspeed_mps, air.altitude_m, along_N)
            if p.environment.penetration == 1:
                way_m = air.airspeed_mps * 1e-9 * turbulence.tick_ns
                history_tick(memory.history, memory.gusts, way_m, p.environment.reach_m)
    apply_due_command(p, pool, memory)  # before the sample, whose command replaces the pending command
    if now >= clock.next_sample_ns:
        if p.computer.over != 0 or p.computer.external != 0:
            navigate(p.environment, pool, y, properties[TOTAL_MASS], memory.computer.navigation)
        sample_computer(p, pool, memory, y, properties)
        clock.next_sample_ns = now + p.computer.sample_ns
        apply_due_command(p, pool, memory)  # again, because a command without delay is due at once
    return changed


@kernel
def apply_due_command(p: Parameters, pool: Array, memory: Memory) -> None:
    """Pass a command that is due to the actuators and thrusters, which hold it.

    After burnout the gimbals are commanded to their centre, because without thrust the law could only drive them
    against their stops.
    """
    clock, held = memory.clock, memory.held
    if clock.now_ns >= clock.command_due_ns:
        for channel in range(2 + 2 * p.vehicle.sizes.further_groups):
            if clock.stage_burnout_ns[clock.stage] >= 0:
                clock.pending_rad[channel] = 0.0
            held.command_rad[channel] = clock.pending_rad[channel]
        held.roll_torque_Nm = p.vehicle.roll_torque_Nm * clock.pending_roll
        if clock.pending_throttled != clock.throttled and held.burning == 1:
            clock.throttled, clock.throttled_ns = clock.pending_throttled, clock.now_ns
            clock.next_break_ns = clock.now_ns
            advance_schedule(p, pool, memory)
        if p.computer.burns.count > 1 or p.computer.external == 1:
            held.settling_N = clock.pending_settling_N
            held.turn_torque_Nm[0] = p.vehicle.turn_torque_Nm * clock.pending_turn[0]
            held.turn_torque_Nm[1] = p.vehicle.turn_torque_Nm * clock.pending_turn[1]
        clock.command_due_ns = NEVER


@routine
def navigate(environment: Environment, pool: Array, y: Array, mass_kg: float, navigation: Array) -> None:
    """Write the variables of gain schedules other than time, without error, to `navigation` (3,).

    They are those of `OVER` in control/structures.py.
    """
    earth = environment.earth
    vx, vy, vz = velocity_over_ground(earth, y)
    squares = vx * vx + vy * vy + vz * vz
    altitude = local_frame(earth, y[R_I], y[R_I + 1], y[R_I + 2])[0]
    navigation[0], navigation[1] = math.sqrt(squares), mass_kg
    navigation[2] = 0.5 * air(environment.atmosphere, pool, altitude)[0] * squares


@routine_beside
def sample_computer(p: Parameters, pool: Array, memory: Memory, y: Array, properties: Array) -> None:
    """Run one tick of the flight computer on the gyro's angle increments since the last tick."""
    clock = memory.clock
    now = clock.now_ns
    begun = now - p.computer.sample_ns  # a rate is commanded over the sample that ends now
    walk = p.vehicle.gyro.random_walk_rad_rts * math.sqrt(1e-9 * p.computer.sample_ns)
    for axis in range(3):
        measured_rad = y[states.GYRO_ANGLE + axis]
        if memory.held.faults[ANY_FAULT] > 0.0:
            noisy = memory.held.faults[GYRO_WALK + axis]
            walk = math.sqrt(1e-9 * p.computer.sample_ns * (p.vehicle.gyro.random_walk_rad_rts**2 + noisy * noisy))
        if walk > 0.0:
            measured_rad += walk * standard_normal(p.timeline.seed, GYRO_STREAM + axis, clock.samples)
        if memory.held.faults[SAMPLE_LOST] == 0.0:
            memory.increment_rad[axis] = measured_rad
        y[states.GYRO_ANGLE + axis] = 0.0
        memory.rate_injection_radps[axis] = total_signal(p.injections, pool, RATE_COMMAND, axis, begun, 0.0)
        memory.rate_replaces[axis] = replaced(p.injections, RATE_COMMAND, axis, begun)
    for gimbal in range(2):
        memory.gimbal_injection_rad[gimbal] = total_signal(p.injections, pool, GIMBAL_COMMAND, gimbal + 1, now, 0.0)
        memory.gimbal_replaces[gimbal] = replaced(p.injections, GIMBAL_COMMAND, gimbal + 1, now)
    if p.vehicle.sizes.sensors > 0:
        sample_sensors(p, memory, y)
    navigation, held = memory.navigation, memory.held.on_pad + memory.held.on_rail
    if p.navigation.on == 1:
        measured, start_q_BI = memory.computer.attitude.measured, memory.truth.start_q_BI
        advance_navigation(p.environment.earth, navigation, measured, start_q_BI, y, now, held)
    if p.computer.burns.count > 0:
        orbit = memory.computer.orbit
        vec.set_vector(orbit.position_m, 0, vec.vector_at(y, R_I))
        vec.set_vector(orbit.velocity_mps, 0, vec.vector_at(y, V_I))
        if p.navigation.on == 1:
            for axis in range(3):
                orbit.position_m[axis] += navigation.position_m[axis]
                orbit.velocity_mps[axis] += navigation.velocity_mps[axis]
        for component in range(4):
            orbit.start_q_BI[component] = memory.truth.start_q_BI[component]
    if p.receivers.on == 1:
        seed, faults, sample = p.timeline.seed, memory.held.faults, clock.samples
        measure(p.receivers, memory.receivers, p.environment, pool, seed, sample, now, properties, faults, y)
    clock.samples += 1
    if p.computer.external == 1:
        memory.computer.external.inputs.stage = clock.stage
        hand_over_discretes(p, pool, memory, properties)
    computer_tick(
        p.computer,
        pool,
        memory.computer,
        1e-9 * now,
        memory.increment_rad,
        memory.rate_injection_radps,
        memory.rate_replaces,
        memory.gimbal_injection_rad,
        memory.gimbal_replaces,
    )
    if p.computer.external == 1:
        for k in range(2):
            clock.pending_turn[k] = memory.computer.external.outputs.turn_thruster[k]
    if p.timeline.sequenced == 1:
        obey(p, memory)
    if memory.computer.external.fault != 0:
        clock.finished = 1
    if p.computer.burns.count > 0:
        burns = memory.computer.burns
        burning = memory.held.burning == 1 and burns.coasting == 0
        if not math.isinf(burns.cut_off_s) and clock.cut_off_ns == 0 and burning:
            clock.cut_off_ns = max(round(1e9 * burns.cut_off_s), now + 1)
            clock.decay_ns = p.timeline.decay_ns
        waits = burns.coasting == 1 and clock.cut_off_ns > 0
        if not math.isinf(burns.ignite_s) and waits and clock.ignite_ns == 0:
            clock.ignite_ns = max(round(1e9 * burns.ignite_s), now + 1)
        clock.pending_settling_N = burns.settling_N
        for k in range(2):
            clock.pending_turn[k] = memory.computer.turning[k].demand
    start = memory.truth.start_q_BI
    commanded = vec.quaternion_at(memory.computer.guidance.attitude.q, 0)
    if p.computer.external == 1:
        commanded = commanded_attitude(memory.computer.external.outputs, commanded)
    wanted = vec.quaternion_product(vec.quaternion_at(start, 0), commanded)
    turned = vec.quaternion_product(vec.conjugate(wanted), vec.quaternion_at(y, Q_BI))
    vec.set_vector(memory.truth.error_rad, 0, vec.roll_and_tilt(turned))
    for channel in range(2 + 2 * p.vehicle.sizes.further_groups):
        clock.pending_rad[channel] = memory.computer.allocation.angle_rad[channel]
    clock.pending_roll = memory.computer.roll.demand
    clock.command_due_ns = now + p.computer.delay_ns


@routine
def sample_sensors(p: Parameters, memory: Memory, y: Array) -> None:
    """Write the outputs of the sensors after the gyro since the last sample, with noise, and mark lost samples."""
    sample, seed, root_s = memory.clock.samples, p.timeline.seed, math.sqrt(1e-9 * p.computer.sample_ns)
    read, faults = memory.computer.sensors, memory.held.faults
    for k in range(p.vehicle.sizes.sensors):
        sensor, stream = p.vehicle.sensors[k], SENSOR_STREAM + 4 * k
        own = sensor.triad.random_walk_rad_rts
        walk = own * root_s
        for axis in range(3):
            i = states.sensor_index(p.vehicle.sizes, k) + 6 + axis
            read.increment[k, axis] = y[i]
            if faults[ANY_FAULT] > 0.0:
                walk = root_s * math.hypot(own, faults[sensor_slots(k) + GYRO_WALK - GYRO_LOST + axis])
            if walk > 0.0:
                read.increment[k, axis] += walk * standard_normal(seed, stream + axis, sample)
            y[i] = 0.0
        read.lost[k] = 1 if faults[SAMPLE_LOST + 1 + k] > 0.0 else 0
        if sensor.dropout > 0.0 and uniform_pair(seed, stream + 3, sample)[0] < sensor.dropout:
            read.lost[k] = 1


@kernel
def move_sensors(before: Parameters, after: Parameters, y: Array) -> None:
    """Move the states of the sensors to their new place in the state vector at a separation."""
    old, new = states.sensor_index(before.vehicle.sizes, 0), states.sensor_index(after.vehicle.sizes, 0)
    n = states.N_SENSOR * after.vehicle.sizes.sensors
    for i in range(n):
        j = i if new < old else n - 1 - i
        y[new + j] = y[old + j]


@kernel
def step_length(p: Parameters, pool: Array, memory: Memory, until_ns: int) -> int:
    """Return the time to the next instant at which a step must end, ns."""
    clock, timeline = memory.clock, p.timeline
    now = clock.now_ns
    end = NEVER
    if timeline.even == 0:
        end = min((now // timeline.step_ns + 1) * timeline.step_ns, until_ns)
    for instant in (
        clock.next_sample_ns,
        clock.command_due_ns,
        clock.cut_off_ns,
        clock.cut_off_ns + clock.decay_ns if clock.cut_off_ns > 0 else NEVER,
        clock.ignite_ns,
        clock.next_gust_ns,
        memory.faults.next_ns,
        timeline.burn_start_ns,
        flight_instant(clock, timeline.burnout_ns),
        clock.separation_ns,
        timeline.release_ns,
        timeline.stop_ns,
    ):
        if now < instant < end:
            end = instant
    end = min(end, clock.next_break_ns)
    if p.injections.count > 0:
        end = next_switch(p.injections, pool, now, end)
    if timeline.even == 1:
        return (end - now) // ((end - now - 1) // timeline.step_ns + 1)
    return end - now


@kernel
def advance_schedule(p: Parameters, pool: Array, memory: Memory) -> None:
    """Advance to the interval of the schedule that begins at or before now, because rates may jump there."""
    schedule, clock = p.vehicle.schedule, memory.clock
    if clock.now_ns < clock.next_break_ns:
        return
    clock.fresh = 1
    clock.next_break_ns = NEVER
    if 0 < clock.cut_off_ns < clock.now_ns:
        return
    while p.timeline.frozen == 0 and clock.interval < schedule.n_breaks - 2:
        table_s = pool[schedule.offset + clock.interval + 1] / p.timeline.burn_rate
        at = flight_instant(clock, p.timeline.stage_start_ns + round(1e9 * table_s))
        if at > clock.now_ns:
            clock.next_break_ns = at
            return
        clock.interval += 1


@routine
def event_function(p: Parameters, memory: Memory, event: int, y: Array, properties: Array, aux: Aux) -> float:
    """Return a number that becomes positive when `event` occurs; `aux` belongs to the start of the step."""
    if event == RAIL_EXIT:
        return rail_surplus(p.launch, memory.launch, y)
    if event == LIFTOFF:
        thrust_N = total_thrust(p.vehicle.engine, counts(p.vehicle.sizes), properties, aux.air.pressure_Pa)
        surplus_N: float = thrust_N - properties[TOTAL_MASS] * aux.axial_load_mps2
        return surplus_N
    altitude, climb = climb_rate(p.environment.earth, y)
    if event == APOGEE:
        return -climb
    return p.timeline.ground_altitude_m - altitude


@routine
def detect_loss_of_control(p: Parameters, memory: Memory, aux: Aux) -> None:
    """Record the events detected at the start of a step: loss of control and tumbling."""
    if memory.held.on_pad == 1:
        return
    clock, timeline, error_rad = memory.clock, p.timeline, memory.truth.error_rad
    if memory.held.burning == 1 and clock.event_ns[CONTROL_LOST] < 0:
        if max(abs(error_rad[1]), abs(error_rad[2])) > timeline.control_lost_rad:
            record_event(p, memory, CONTROL_LOST, clock.now_ns)
    if aux.air.dynamic_pressure_Pa > timeline.tumble_pressure_Pa and clock.event_ns[TUMBLE] < 0:
        if aux.air.flow_B_mps[0] < math.cos(timeline.tumble_rad) * aux.air.airspeed_mps:
            record_event(p, memory, TUMBLE, clock.now_ns)


@routine
def transfer_state(
    before: Parameters, after: Parameters, pool: Array, memory: Memory, old: Array, new: Array, whole: Array, y: Array
) -> None:
    """Separate a stage: the upper stage continues with the motion of the whole vehicle at its own core CG.

    Its modes take their part of the motion of the bent axis, and the rigid body takes the rest (docs/model.md, 4.10).
    Engines and bobs start at rest, unless the stage continues. Boosters that separate keep their momentum. An impulse
    and springs accelerate the stage: springs of energy E give both parts the momentum sqrt(2 E m_1 m_2 / (m_1 + m_2)).
    Tip-off rates are added. `old` and `new` are the properties before and after; `whole` is scratch memory. Stations
    are measured from the nose, which is the same before and after.
    """
    size, handed_on = counts(before.vehicle.sizes), after.timeline.handed_on
    rate, turned = vec.vector_at(y, W_BI_B), (0.0, 0.0, 0.0)
    for i in range(states.state_size(size)):
        whole[i] = y[i]
    shift = (old[CORE_CG] - new[CORE_CG], new[CORE_CG + 1] - old[CORE_CG + 1], new[CORE_CG + 2] - old[CORE_CG + 2])
    gained = vec.cross(rate, shift)
    if handed_on >= 0:
        nose = (-new[CORE_CG], new[CORE_CG + 1], new[CORE_CG + 2])  # from the nose to the new core CG
        moved, turned = bent_motion(size, pool, handed_on, 0, nose, whole)
        faster, turning = bent_motion(size, pool, handed_on, 1, nose, whole)
        shift = vec.add(shift, moved)
        gained = vec.add(gained, vec.add(faster, carried(rate, moved)))
        rate = vec.add(rate, vec.add(turning, carried(rate, turned)))  # in the rotated axes
    rotation = vec.rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    shift_I, velocity_I = vec.rotate(rotation, shift), vec.rotate(rotation, gained)
    if handed_on >= 0:
        q = vec.quaternion_product(vec.quaternion_at(y, Q_BI), vec.quaternion_of(turned))
        y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3] = q
        rotation = vec.rotation_from_quaternion(q[0], q[1], q[2], q[3])
    t, upper_kg = before.timeline, new[TOTAL_MASS]
    lower_kg = max(old[TOTAL_MASS] - upper_kg, 0.0)
    push_Ns = t.separation_impulse_Ns
    if t.separation_spring_J > 0.0:
        push_Ns += math.sqrt(2.0 * t.separation_spring_J * upper_kg * lower_kg / (upper_kg + lower_kg))
    pushed_I = vec.rotate(rotation, (push_Ns / upper_kg, 0.0, 0.0))
    rate = (rate[0] + t.tip_off_radps[0], rate[1] + t.tip_off_radps[1], rate[2] + t.tip_off_radps[2])
    for j in range(3):
        y[R_I + j] += shift_I[j]
        y[V_I + j] += velocity_I[j] + pushed_I[j]
        y[W_BI_B + j] = rate[j]
    if after.timeline.continues == 0:
        for channel in range(2 * MAX_ENGINES):
            memory.held.command_rad[channel], memory.held.engine_rad[channel] = 0.0, 0.0
        memory.held.roll_torque_Nm, memory.held.burning = 0.0, 0
        memory.held.turn_torque_Nm[0], memory.held.turn_torque_Nm[1] = 0.0, 0.0
        move_sensors(before, after, y)
        states.start_states(after.vehicle.sizes, rate, 1, y)
    if after.timeline.continues == DROPS:
        keep_parts(size, counts(after.vehicle.sizes), turned, whole, y)
    if handed_on >= 0:
        own, row = counts(after.vehicle.sizes), 6
        for k in range(3):
            first, modes = modes_in(own, k)
            for i in range(modes):
                y[first + i] = handed(size, pool, handed_on, row + i, 0, whole)
                y[first + modes + i] = handed(size, pool, handed_on, row + i, 1, whole)
            row += modes
    if after.timeline.continues != 1 and after.vehicle.sizes.air_lags > 0:  # the air is quasi-steady at the start
        own = counts(after.vehicle.sizes)
        late = states.air_lag_index(own)
        y[late] = y[states.eta_index(own)] if own.pitch_modes > 0 else 0.0
        y[late + 1] = y[states.xi_index(own)] if own.yaw_modes > 0 else 0.0
    record_event(before, memory, SEPARATION, memory.clock.now_ns)
    memory.clock.stage_separation_ns[memory.clock.stage] = memory.clock.now_ns


@routine
def keep_parts(old: Counts, new: Counts, turned: vec.Vector, whole: Array, y: Array) -> None:
    """Write the states of the parts that remain when boosters separate; they are the first parts of each kind.

    The modes of the remaining configuration are at rest until their motion is transferred. The axes B rotate by
    `turned`, rad. The bobs keep their inertial direction and rate.
    """
    for i in range(states.N_FIXED, states.state_size(new)):
        y[i] = 0.0
    q = vec.quaternion_of(turned)
    rotation = vec.rotation_from_quaternion(q[0], q[1], q[2], q[3])
    for tank in range(new.pendulums):
        i, j = states.pendulum_index(new, tank), states.pendulum_index(old, tank)
        vec.set_vector(y, i, vec.rotate_back(rotation, vec.vector_at(whole, j)))
        vec.set_vector(y, i + 3, vec.rotate_back(rotation, vec.vector_at(whole, j + 3)))
    for kind in range(4):
        i, j, n = states.actuator_index(new, 1), states.actuator_index(old, 1), 2 * states.N_ACTUATOR
        n *= new.further_groups
        if kind == 1:
            i, j = states.tvc_load_index(new), states.tvc_load_index(old)
            n = states.feed_index(new) - i
        if kind == 2:
            i, j = states.sensor_index(new, 0), states.sensor_index(old, 0)
            n = states.N_SENSOR * new.sensors
        if kind == 3:
            i, j = states.feed_index(new), states.feed_index(old)
            n = states.N_FEED * min(new.feed_lines, old.feed_lines)
        for k in range(n):
            y[i + k] = whole[j + k]


@kernel
def bent_motion(
    sizes: Counts, pool: Array, at: int, rates: int, place: vec.Vector, y: Array
) -> tuple[vec.Vector, vec.Vector]:
    """Return modal displacement and rotation, or their rates, of the remaining part at `place`, relative to the nose.

    `rates` is 0 for displacements and 1 for rates.
    """
    moved = (
        handed(sizes, pool, at, 0, rates, y),
        handed(sizes, pool, at, 1, rates, y),
        handed(sizes, pool, at, 2, rates, y),
    )
    turned = (
        handed(sizes, pool, at, 3, rates, y),
        handed(sizes, pool, at, 4, rates, y),
        handed(sizes, pool, at, 5, rates, y),
    )
    return vec.add(moved, vec.cross(turned, place)), turned


@kernel
def carried(rate: vec.Vector, moved: vec.Vector) -> vec.Vector:
    """Return w x moved without the roll-rate terms along y and z, which quasi-velocities already include."""
    return (rate[1] * moved[2] - rate[2] * moved[1], rate[2] * moved[0], -rate[1] * moved[0])


@routine
def handed(sizes: Counts, pool: Array, at: int, row: int, rates: int, y: Array) -> float:
    """Return a row of the matrix at pool[at:] times the coordinates of all modes, or times their quasi-velocities."""
    total, column = 0.0, at + row * (sizes.pitch_modes + sizes.yaw_modes + sizes.spatial_modes)
    for k in range(3):
        first, modes = modes_in(sizes, k)
        for i in range(modes):
            total += pool[column + i] * y[first + rates * modes + i]
        column += modes
    return total


@kernel
def modes_in(sizes: Counts, kind: int) -> tuple[int, int]:
    """Return the first state and the number of the modes in pitch (0), in yaw (1), or in space (2).

    The quasi-velocities of the modes follow their coordinates.
    """
    if kind == 0:
        return states.eta_index(sizes), sizes.pitch_modes
    if kind == 1:
        return states.xi_index(sizes), sizes.yaw_modes
    return states.spatial_index(sizes), sizes.spatial_modes
