"""The flight computer at one sample instant: from gyro angle increments to gimbal and roll commands.

    increments -> converter -> attitude, rate -> error -> law -> x total gain -> + injection -> limit -> DAC
          guidance, commanded attitude -----^          roll error and rate -> switching line -> thrusters
    several groups of engines: pitch, yaw and roll -> allocation -> limit -> DAC, for each group (allocation.py)

The law is a module of control/laws. flown.py there contains the parameters and states of all laws, and calls the law
that flies. External flight code replaces the law, the roll control and the roll command (external.py).

The computer contains neither the plant nor its own delay. It returns the command at once; the caller applies the
command `delay_ns` later and holds it.

Triples are per body axis x, y, z (roll, pitch, yaw), pairs per gimbal axis (pitch, yaw).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np

from maxq.control import loop_filters
from maxq.control.allocation import ONE_GROUP, Allocation, AllocationState, allocate, roll_command, start_allocation
from maxq.control.attitude import (
    METHODS,
    AttitudeError,
    AttitudeRow,
    attitude_row,
    set_attitude_error,
    start_attitude_error,
    turn,
    update_attitude_error,
)
from maxq.control.burns import Burns, BurnsState, advance_burns, start_burns
from maxq.control.converter import Converter, ConverterState, convert, make_converter, round_half_away, start_converter
from maxq.control.external import (
    HEALTH_ACCELEROMETER,
    HEALTH_GYRO,
    HEALTH_RATE_GYROS,
    ExternalState,
    commanded_attitude,
    step_external,
)
from maxq.control.filter_schedule import MovingFilter, freeze_moving, move_filter
from maxq.control.filters import DiscreteFilter
from maxq.control.guidance import GuidanceState, advance_guidance, start_guidance, unroll
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_UNITS
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import PitchYaw, QuaternionRow, RollPitchYaw, degrees, quaternion
from maxq.control.kernel.tables import NO_TABLE, Cubics, Pool, TableRef
from maxq.control.laws.adaptive import Adaptive, AdaptiveState, augmented, start_adaptive
from maxq.control.laws.flown import FlownLaw, LawStates, make_law, navigate_law, start_laws, tick_law
from maxq.control.laws.own import OwnLaw
from maxq.control.laws.pd import LawInputs, LawRow, filtered, law_row, settle_pd
from maxq.control.laws.pid import PidRow, pid_row
from maxq.control.orbit_guidance import OrbitGuidanceState, start_orbit_guidance
from maxq.control.roll import Roll, RollState, silence_roll, start_roll, update_roll
from maxq.control.sensors import Sensors, SensorState, blended_rate, make_sensors, read_sensors, start_sensors
from maxq.control.structures import GAINS, OVER, Attitude, Law, Over

# No gyro and no scenario produces a larger angle in one sample, so a larger value is a fault.
INCREMENT_LIMIT_RAD = 1.0e3

_UNUSED_ROLL = Roll(0.0, 1.0, 0.0, 0)


@dataclass(frozen=True)
class Computer:
    """The parameters of the flight computer.

    - `sample_ns`: period of the ticks.
    - `delay_ns`: time from a tick to the effect of its command, applied by the plant.
    - `external`: 1 if external flight code is called.
    - `control_on`: with 0, the law returns 0, and injected commands still pass.
    - `guidance_on`: with 0, the programme is stopped.
    - `roll_on`: with 0, no thruster fires.
    - `unrolled`: 1 if the pitch and yaw axes of the programme do not roll.
    - `programme`: table of `guidance.rate_programme`.
    - `attitude`: definition of the attitude error, index into `METHODS` of attitude.py.
    - `angle_error_limit_rad`: limit of theta_e.
    - `command_limit_rad`: limit of each gimbal command; inf is no limit.
    - `dac_step_rad`: step of the digital-to-analogue converter; 0 is an ideal converter.
    """

    sample_ns: int
    delay_ns: int
    external: int
    control_on: int
    guidance_on: int
    roll_on: int
    unrolled: int
    programme: TableRef
    converter: Converter
    attitude: int
    angle_error_limit_rad: float
    law: FlownLaw
    command_limit_rad: float
    dac_step_rad: float
    roll: Roll
    allocation: Allocation  # of the current stage
    sensors: Sensors
    takes_over: int = 0  # 1: the stage has its own law or timing, which starts at its separation
    over: int = 0  # variable of the gain schedule, index into `OVER` of structures.py
    burns: Burns = field(default_factory=Burns)  # cutoffs and restarts of the last stage's engine
    adaptive: Adaptive = field(default_factory=Adaptive)
    loops: loop_filters.LoopFilters = field(default_factory=loop_filters.LoopFilters)


@dataclass
class ComputerState:
    """The state of the flight computer, allocated by `records.blank` and initialised by `start_computer`.

    - `ticks`: number of processed samples.
    - `invalid_inputs`: number of rejected inputs (`computer_tick`).
    - `requested_rad`: output of the law plus the injected command.
    - `command_limited`: 1 if this sum exceeds the limit.
    - `command_rad`: gimbal command of the last tick; the roll demand is `roll.demand`.
    - `navigation`: speed_mps, mass_kg, dynamic_pressure_Pa at the end of the sample (`OVER` of structures.py). The
      caller writes them if scheduled gains or external flight code use them.
    """

    ticks: int
    invalid_inputs: int
    converter: ConverterState
    guidance: GuidanceState
    attitude: AttitudeError
    law: LawStates
    requested_rad: Annotated[Array, (2,)]
    command_limited: Annotated[IntArray, (2,)]
    command_rad: Annotated[Array, (2,)]
    roll: RollState
    turning: Annotated[tuple[RollState, ...], (2,)]  # pitch and yaw thrusters, which fire in a coast
    allocation: AllocationState
    external: ExternalState
    sensors: SensorState
    orbit: OrbitGuidanceState
    burns: BurnsState
    adaptive: AdaptiveState
    loops: loop_filters.LoopFilterState
    navigation: Annotated[Array, (3,)]


def build_computer(
    pool: Pool,
    *,
    sample_ns: int,
    delay_ns: int = 0,
    count_rad: float = 0.0,
    dac_step_rad: float = 0.0,
    attitude: Attitude = "quaternion",
    angle_error_limit_rad: float = np.inf,
    command_limit_rad: float = np.inf,
    law: Law = "pd",
    gains: Cubics | None = None,
    over: Over = "time_s",
    integral_limit_rad: float = np.inf,
    programme: Cubics | None = None,
    unrolled: bool = False,
    pitch_filter: DiscreteFilter | None = None,
    yaw_filter: DiscreteFilter | None = None,
    moving_filter: MovingFilter | None = None,
    roll: Roll | None = None,
    control_on: bool = True,
    guidance_on: bool = True,
    roll_on: bool = True,
    external: bool = False,
    sensors: Sensors | None = None,
    relief_hz: float | None = None,
    adaptive: Adaptive | None = None,
    loops: loop_filters.LoopFilters | None = None,
    own: OwnLaw | None = None,
) -> Computer:
    """Return the parameters of a computer, and add its tables to `pool`.

    - `gains`: table of `pd.gains_table` with the columns of `law` over the variable `over`. Without it, the law returns
      0.
    - `integral_limit_rad`: limit of the integral of PID.
    - `programme`: table of `guidance.rate_programme`. Without it, the commanded rates are 0.
    - `pitch_filter`, `yaw_filter`: filters of `BendingFilter.discretize`. Without `yaw_filter`, the pitch filter also
      applies to yaw; without either, the law's output is not filtered. A filter without sections leaves its axis
      unfiltered.
    - `moving_filter`, `roll`, `sensors`, `adaptive`, `loops`: results of `filter_schedule.make_moving_filter`,
      `roll.make_roll`, `sensors.make_sensors`, `adaptive.make_adaptive` and `loop_filters.make_loop_filters`. Without
      `roll`, no thruster fires.
    - `relief_hz`: corner frequency of the accelerometer lag of a load-relief law.
    - `own`: code of the law `own`, with the number of its columns in `gains`.

    A `count_rad` of 0 is an ideal converter, a `dac_step_rad` of 0 an ideal DAC, and an infinite limit is no limit.
    Raises ValueError with key, value and allowed values.
    """
    for key, value, holds, allowed in (
        ("sample_ns", sample_ns, sample_ns > 0 and int(sample_ns) == sample_ns, "a whole number above 0"),
        ("delay_ns", delay_ns, delay_ns >= 0 and int(delay_ns) == delay_ns, "a whole number from 0"),
        ("dac_step_rad", dac_step_rad, 0 <= dac_step_rad < np.inf, "a finite number from 0"),
        ("angle_error_limit_rad", angle_error_limit_rad, angle_error_limit_rad > 0, "above 0"),
        ("command_limit_rad", command_limit_rad, command_limit_rad > 0, "above 0"),
    ):
        if not holds:
            raise ValueError(f"{key} = {value}: allowed is {allowed}")
    return Computer(
        sample_ns=sample_ns,
        delay_ns=delay_ns,
        external=int(external),
        control_on=int(control_on),
        guidance_on=int(guidance_on),
        roll_on=int(roll_on and (external or roll is not None)),
        unrolled=int(unrolled),
        programme=_placed(pool, "programme", programme, 6),
        converter=make_converter(count_rad),
        attitude=METHODS.index(attitude),
        angle_error_limit_rad=angle_error_limit_rad,
        law=make_law(
            law,
            _placed(pool, "gains", gains, 2 * (own.count if own else len(GAINS[law]))),
            sample_ns,
            pitch_filter,
            yaw_filter or pitch_filter,
            moving=moving_filter,
            integral_limit_rad=integral_limit_rad,
            relief_hz=relief_hz or 0.0,
            own=own,
        ),
        command_limit_rad=command_limit_rad,
        dac_step_rad=dac_step_rad,
        roll=roll or _UNUSED_ROLL,
        allocation=ONE_GROUP,
        sensors=sensors or make_sensors(),
        over=OVER.index(over),
        adaptive=adaptive or Adaptive(),
        loops=loops or loop_filters.LoopFilters(),
    )


def _placed(pool: Pool, key: str, table: Cubics | None, n_columns: int) -> TableRef:
    if table is None:
        return NO_TABLE
    if table.n_columns != n_columns:
        raise ValueError(f"{key} has {table.n_columns} columns: allowed is {n_columns}")
    return pool.add(table)


@routine
def start_computer(computer: Computer, pool: Array, state: ComputerState, time_s: float) -> None:
    """Initialise `state`, with the programme starting at `time_s`, the beginning of the first sample."""
    state.ticks = 0
    state.invalid_inputs = 0
    start_guidance(pool, computer.programme, state.guidance, time_s)
    start_converter(state.converter)
    start_attitude_error(state.attitude)
    start_laws(computer.law, state.law)
    start_roll(state.roll)
    start_allocation(state.allocation)
    start_sensors(computer.sensors, state.sensors)
    start_orbit_guidance(state.orbit)
    start_burns(state.burns)
    for k in range(2):
        start_roll(state.turning[k])
    start_adaptive(computer.adaptive, state.adaptive)
    loop_filters.start_loop_filters(state.loops)
    for gimbal in range(2):
        state.requested_rad[gimbal] = 0.0
        state.command_limited[gimbal] = 0
        state.command_rad[gimbal] = 0.0
    for k in range(3):
        state.navigation[k] = 0.0


@routine
def take_over(before: Computer, computer: Computer, state: ComputerState) -> None:
    """Hand over from the law of the stage `before` to that of a stage with its own law.

    The new filters are settled at the last inputs of the old filters, which fade out. Adaptation and roll control
    restart.
    """
    attitude, old, new, loops = state.attitude, before.loops, computer.loops, state.loops
    loops.fading = new.fade_ticks
    for gimbal in range(2):
        memory = state.law.pd.filter_memory[gimbal]
        loop_filters.keep_filter(
            loops, loop_filters.OUTPUT, gimbal, before.law.pd.sections[gimbal], before.law.pd.n_sections[gimbal], memory
        )
        moving = before.law.pd.moving
        if moving.table.n_breaks != 0:
            kept, kept_memory = (
                loops.old_sections[loop_filters.OUTPUT, gimbal],
                loops.old_memory[loop_filters.OUTPUT, gimbal],
            )
            freeze_moving(moving, state.law.pd.moving, gimbal, kept, kept_memory)
            loops.old_n_sections[loop_filters.OUTPUT, gimbal] = moving.n_quadratic + moving.n_first_order
        loop_filters.take_over_filter(old, new, loops, loop_filters.ATTITUDE, gimbal, attitude.theta_e_rad[gimbal + 1])
        loop_filters.take_over_filter(old, new, loops, loop_filters.RATE, gimbal, attitude.rate_radps[gimbal + 1])
        if computer.sensors.accelerometer >= 0:
            lateral_mps2 = state.sensors.value[computer.sensors.accelerometer, 2 - gimbal]
            loop_filters.take_over_filter(old, new, loops, loop_filters.ACCELERATION, gimbal, lateral_mps2)
        settle_pd(computer.law.pd, state.law.pd, gimbal)
    start_adaptive(computer.adaptive, state.adaptive)
    start_roll(state.roll)


@routine
def computer_tick(
    computer: Computer,
    pool: Array,
    state: ComputerState,
    time_s: float,
    increment_rad: Array,
    rate_injection_radps: Array,
    rate_replaces: IntArray,
    gimbal_injection_rad: Array,
    gimbal_replaces: IntArray,
) -> None:
    """Process the sample that ends at `time_s`, and write the new command into `state`.

    - `increment_rad` (3,): gyro angles about x, y, z since the last tick.
    - `rate_injection_radps` (3,): rates, constant over the sample, added to the commanded rates. They replace the
      commanded rates where `rate_replaces` (3,) is not 0.
    - `gimbal_injection_rad` (2,), `gimbal_replaces` (2,): the same for the filtered command, before limit and DAC.

    Writes `state.command_rad` (2,) in pitch and yaw, `state.roll.demand`, and the angles of each group of engines in
    `state.allocation`.

    An input that is not finite, or an angle beyond `INCREMENT_LIMIT_RAD` in one sample, is replaced by 0 and counted in
    `state.invalid_inputs`, so that it does not corrupt sums and filters. The caller checks this count and ensures that
    `time_s` is finite.
    """
    sample_s = computer.sample_ns / 1.0e9
    for axis in range(3):
        measured_rad = increment_rad[axis]
        if not abs(measured_rad) <= INCREMENT_LIMIT_RAD:
            measured_rad = 0.0
            state.invalid_inputs += 1
        injected_radps = rate_injection_radps[axis]
        if not abs(injected_radps) * sample_s <= INCREMENT_LIMIT_RAD:
            injected_radps = 0.0
            state.invalid_inputs += 1
        convert(computer.converter, state.converter, axis, measured_rad)
        advance_guidance(
            pool,
            computer.programme,
            state.guidance,
            axis,
            time_s,
            sample_s,
            computer.guidance_on,
            injected_radps,
            rate_replaces[axis],
        )
        state.attitude.rate_radps[axis] = state.converter.increment_rad[axis] / sample_s
    if computer.sensors.count > 0:
        state.invalid_inputs += read_sensors(
            computer.sensors, state.sensors, state.ticks, sample_s, INCREMENT_LIMIT_RAD
        )
        for gimbal in range(2):
            first_radps = state.attitude.rate_radps[1 + gimbal]
            state.attitude.rate_radps[1 + gimbal] = blended_rate(computer.sensors, state.sensors, gimbal, first_radps)
    if computer.unrolled != 0:
        unroll(state.guidance, sample_s)
    if computer.burns.count > 0 and computer.guidance_on != 0:
        follow_burns(computer.burns, state, time_s, sample_s)
    turn(state.guidance.attitude, state.guidance.increment_rad)
    turn(state.attitude.measured, state.converter.increment_rad)
    update_attitude_error(
        state.attitude,
        computer.attitude,
        state.guidance.attitude,
        state.converter.angle_rad,
        state.guidance.angle_rad,
        computer.angle_error_limit_rad,
    )
    if computer.external != 0:
        call_external(computer, state, time_s)
    at = time_s if computer.over == 0 else state.navigation[computer.over - 1]
    if computer.law.pd.moving.table.n_breaks != 0:
        move_filter(computer.law.pd.moving, pool, state.law.pd.moving, at)
    for gimbal in range(2):
        injected_rad = gimbal_injection_rad[gimbal]
        if not abs(injected_rad) <= INCREMENT_LIMIT_RAD:
            injected_rad = 0.0
            state.invalid_inputs += 1
        update_command(computer, pool, state, gimbal, at, injected_rad, gimbal_replaces[gimbal])
    if computer.external != 0:
        state.roll.demand = state.external.outputs.roll_thruster * computer.roll_on
    elif computer.roll_on != 0:
        update_roll(computer.roll, state.roll, state.attitude.theta_e_rad[0], state.attitude.rate_radps[0])
    else:
        silence_roll(state.roll)
    if computer.burns.turns != 0:
        fire_in_coast(computer, state)
    allocate_commands(computer, pool, state, time_s)
    if state.loops.fading > 0:
        state.loops.fading -= 1
    state.ticks += 1


@routine
def follow_burns(burns: Burns, state: ComputerState, time_s: float, sample_s: float) -> None:
    """Replace the commanded turn in pitch and yaw by that of the burns, if they steer; roll follows the programme."""
    guidance = state.guidance
    turns, turn_y, turn_z = advance_burns(burns, state.burns, state.orbit, guidance.attitude.q, time_s, sample_s)
    if turns == 1:
        guidance.increment_rad[1], guidance.increment_rad[2] = turn_y, turn_z
        guidance.rate_radps[1], guidance.rate_radps[2] = turn_y / sample_s, turn_z / sample_s


@routine
def fire_in_coast(computer: Computer, state: ComputerState) -> None:
    """Update the demands on the pitch and yaw thrusters by the switching line of roll control."""
    for k in range(2):
        if state.burns.coasting == 1:
            error_rad, rate_radps = state.attitude.theta_e_rad[1 + k], state.attitude.rate_radps[1 + k]
            update_roll(computer.roll, state.turning[k], error_rad, rate_radps - state.guidance.rate_radps[1 + k])
        else:
            silence_roll(state.turning[k])


@routine
def call_external(computer: Computer, state: ComputerState, time_s: float) -> None:
    """Pass the sample to the external flight code, which writes `state.external.outputs`."""
    inputs, converter, guidance, attitude = state.external.inputs, state.converter, state.guidance, state.attitude
    inputs.tick, inputs.time_s = state.ticks, time_s
    inputs.time_ns = round(1.0e9 * inputs.time_s)
    inputs.health = HEALTH_GYRO if state.invalid_inputs == state.external.invalid_before else 0
    inputs.health += state.external.health
    inputs.imu_health = (1 << inputs.imu_count) - 1
    if state.external.gyro_lost != 0:
        inputs.health, inputs.imu_health = inputs.health & ~HEALTH_GYRO, inputs.imu_health & ~1
    state.external.invalid_before = state.invalid_inputs
    for axis in range(3):
        inputs.counts[axis] = converter.counts[axis]
        inputs.delta_angle_rad[axis] = converter.increment_rad[axis]
        inputs.imu_delta_angle_rad[0, axis] = converter.increment_rad[axis]
        inputs.angle_rad[axis] = converter.angle_rad[axis]
        inputs.rate_radps[axis] = attitude.rate_radps[axis]
        inputs.commanded_angle_rad[axis] = guidance.angle_rad[axis]
        inputs.commanded_rate_radps[axis] = guidance.rate_radps[axis]
        inputs.attitude_error_rad[axis] = attitude.theta_e_rad[axis]
    for k in range(4):
        inputs.q_BR[k], inputs.commanded_q_BR[k] = attitude.measured.q[k], guidance.attitude.q[k]
    inputs.speed_mps, inputs.mass_kg, inputs.dynamic_pressure_Pa = (
        state.navigation[0],
        state.navigation[1],
        state.navigation[2],
    )
    if computer.sensors.count > 0:
        hand_sensors(computer, state)
    step_external(state.external)
    wanted = commanded_attitude(state.external.outputs, (0.0, 0.0, 0.0, 0.0))
    if wanted != (0.0, 0.0, 0.0, 0.0):  # the error in the log is then that of the code's guidance
        set_attitude_error(attitude, wanted, computer.angle_error_limit_rad)


@routine
def hand_sensors(computer: Computer, state: ComputerState) -> None:
    """Copy the samples of the further sensors into the inputs of the flight code."""
    inputs, sensors = state.external.inputs, state.sensors
    gyros = computer.sensors.gyros
    inputs.health |= HEALTH_ACCELEROMETER + HEALTH_RATE_GYROS
    for k in range(computer.sensors.count):
        unit = 1 + k if k < gyros else k - gyros
        if sensors.lost[k] != 0 and unit < MAX_UNITS:
            inputs.imu_health &= ~(1 << unit)
        if sensors.lost[k] != 0 and k <= gyros:
            inputs.health &= ~(HEALTH_RATE_GYROS if k < gyros else HEALTH_ACCELEROMETER)
        for axis in range(3):
            if k < gyros:
                inputs.further_rate_radps[k, axis] = sensors.value[k, axis]
            if k == gyros:
                inputs.delta_velocity_mps[axis] = sensors.delta[k, axis]
            if unit < MAX_UNITS and k < gyros:
                inputs.imu_delta_angle_rad[unit, axis] = sensors.delta[k, axis]
            elif unit < MAX_UNITS:
                inputs.imu_delta_velocity_mps[unit, axis] = sensors.delta[k, axis]


@routine
def allocate_commands(computer: Computer, pool: Array, state: ComputerState, time_s: float) -> None:
    """Allocate the commands in pitch, yaw and roll to the groups of engines.

    With several groups, limit and DAC act on the angles of each group.
    """
    a, angles = computer.allocation, state.allocation.angle_rad
    if a.groups == 1:
        angles[0], angles[1] = state.command_rad[0], state.command_rad[1]
        return
    roll_rad = 0.0
    if computer.external != 0:
        roll_rad = state.external.outputs.roll_gimbal_rad * computer.control_on
    elif computer.control_on != 0:
        roll_rad = roll_command(a, state.attitude.theta_e_rad[0], state.attitude.rate_radps[0])
    pitch_rad, yaw_rad = state.requested_rad[0], state.requested_rad[1]
    limit_rad = computer.command_limit_rad
    if allocate(a, pool, state.allocation, time_s, pitch_rad, yaw_rad, roll_rad, limit_rad) == 1:
        for gimbal in range(2):
            state.command_limited[gimbal] = 1
    for channel in range(2 * a.groups):
        angles[channel] = limit_and_quantise(angles[channel], limit_rad, computer.dac_step_rad)


@routine
def update_command(
    computer: Computer, pool: Array, state: ComputerState, gimbal: int, at: float, injected_rad: float, replaces: int
) -> None:
    """Compute the command of gimbal axis `gimbal` (0 pitch, 1 yaw) from the law with the gains at `at`.

    The steps are law, fade-out, adaptation, injection, limit and DAC.
    """
    error_rad, rate_radps = state.attitude.theta_e_rad[gimbal + 1], state.attitude.rate_radps[gimbal + 1]
    lateral_mps2, sample_s = 0.0, computer.sample_ns / 1.0e9
    if computer.external == 0 and computer.law.accelerometer == 1:
        force_mps2, turned_rad = state.sensors.value[computer.sensors.accelerometer], state.attitude.error_rad
        lateral_mps2 = force_mps2[2 - gimbal]
        navigate_law(computer.law, state.law, gimbal, lateral_mps2, force_mps2[0], turned_rad[gimbal + 1], sample_s)
    if computer.loops.on != 0 or state.loops.fading > 0:
        error_rad = loop_filters.filtered_input(computer.loops, state.loops, loop_filters.ATTITUDE, gimbal, error_rad)
        rate_radps = loop_filters.filtered_input(computer.loops, state.loops, loop_filters.RATE, gimbal, rate_radps)
        lateral_mps2 = loop_filters.filtered_input(
            computer.loops, state.loops, loop_filters.ACCELERATION, gimbal, lateral_mps2
        )
    cut_rad = state.requested_rad[gimbal]
    if abs(cut_rad) <= computer.command_limit_rad:
        cut_rad = 0.0
    given = LawInputs(gimbal, at, error_rad, rate_radps, lateral_mps2, sample_s, cut_rad, computer.control_on)
    if computer.external != 0:
        wanted_rad = state.external.outputs.gimbal_rad[gimbal] * computer.control_on
        # sections with which a certificate alters the loop, not those of a design
        law_rad = filtered(computer.law.pd, state.law.pd, gimbal, wanted_rad)
    else:
        law_rad = tick_law(computer.law, pool, state.law, given)
    if state.loops.fading > 0:
        law_rad = loop_filters.faded(
            computer.loops, state.loops, loop_filters.OUTPUT, gimbal, state.law.pd.pd_rad[gimbal], law_rad
        )
        state.law.pd.filtered_rad[gimbal] = law_rad
    if computer.adaptive.on != 0 and computer.control_on != 0:
        law_rad = augmented(
            computer.adaptive, state.adaptive, state.attitude, state.guidance.rate_radps, gimbal, sample_s, law_rad
        )
        state.law.pd.filtered_rad[gimbal] = law_rad
    requested_rad = injected_rad if replaces != 0 else law_rad + injected_rad
    state.requested_rad[gimbal] = requested_rad
    state.command_limited[gimbal] = 1 if abs(requested_rad) > computer.command_limit_rad else 0
    state.command_rad[gimbal] = limit_and_quantise(requested_rad, computer.command_limit_rad, computer.dac_step_rad)


@kernel
def limit_and_quantise(requested_rad: float, limit_rad: float, step_rad: float) -> float:
    """Return `requested_rad`, limited to ±`limit_rad` and rounded to a DAC step within the limit; step 0 is ideal."""
    command_rad = min(max(requested_rad, -limit_rad), limit_rad)
    if step_rad == 0.0:
        return command_rad
    steps = round_half_away(command_rad / step_rad)
    # The limit is not generally a multiple of the step; the tolerance accepts a multiple despite rounding.
    if abs(steps) * step_rad > limit_rad * (1.0 + 1.0e-12):
        steps -= 1 if steps > 0 else -1
    return steps * step_rad


class ControlRow(NamedTuple):
    """The log row of the computer, at the rate of the fast group."""

    counts_axis: Annotated[RollPitchYaw, "1", "gyro pulses of the last sample"]
    attitude: AttitudeRow
    law: LawRow
    pid: PidRow
    saturated_axis: Annotated[PitchYaw, "1", "1 while the command is at its limit"]
    roll_thruster: Annotated[float, "1", "roll thrusters: -1, 0 or 1"]


@kernel
def control_row(state: ComputerState) -> ControlRow:
    counts, limited = state.converter.counts, state.command_limited
    return ControlRow(
        counts_axis=RollPitchYaw(counts[0], counts[1], counts[2]),
        attitude=attitude_row(state.attitude),
        law=law_row(state.law.pd),
        pid=pid_row(state.law.pid),
        saturated_axis=PitchYaw(limited[0], limited[1]),
        roll_thruster=state.roll.demand,
    )


class GuidanceRow(NamedTuple):
    """The log row of the attitude in the computer; R is B at the start of the computer."""

    axis_commanded_deg: Annotated[RollPitchYaw, "deg", "integral of the commanded rate"]
    axis_measured_deg: Annotated[RollPitchYaw, "deg", "attitude angle: sum of the gyro pulses"]
    q_BR_commanded_axis: Annotated[QuaternionRow, "1", "commanded attitude, B to R, component"]
    q_BR_measured_axis: Annotated[QuaternionRow, "1", "measured attitude, B to R, component"]


@kernel
def guidance_row(state: ComputerState) -> GuidanceRow:
    return GuidanceRow(
        axis_commanded_deg=degrees(state.guidance.angle_rad),
        axis_measured_deg=degrees(state.converter.angle_rad),
        q_BR_commanded_axis=quaternion(state.guidance.attitude.q),
        q_BR_measured_axis=quaternion(state.attitude.measured.q),
    )
