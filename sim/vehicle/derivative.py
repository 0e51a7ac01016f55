"""The time derivative of the state, and the records that it reads.

Each step of `_derivative` is one part of the model, in the order of docs/model.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel, rare_routine, routine, routine_beside
from maxq.control.kernel.limits import MAX_ENGINES, MAX_FEED_LINES, MAX_SENSORS
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import TableRef, find_interval, interpolate_into
from maxq.control.kernel.vectors import (
    Matrix,
    Symmetric,
    Vector,
    add,
    cross,
    inertia_times,
    rotation_from_quaternion,
    scaled,
    set_vector,
    vector_at,
)
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle import state as states
from maxq.sim.vehicle.accelerations import accelerate
from maxq.sim.vehicle.actuator.kernel import Actuator, actuator_motion, actuator_rates, resisted_acceleration
from maxq.sim.vehicle.air.kernel import (
    Aero,
    air_acts,
    body_loads,
    coefficients,
    moment_reference,
    surface_loads,
    table_loads,
)
from maxq.sim.vehicle.air.lag import lag_first_modes
from maxq.sim.vehicle.block import Q_BI, W_BI_B, Counts, Sizes, are_usual, counts, rigid_counts, usual_counts
from maxq.sim.vehicle.body import kernel as rigid
from maxq.sim.vehicle.buffet.kernel import Buffet, buffet_loads
from maxq.sim.vehicle.clamp import clamp_tail
from maxq.sim.vehicle.engine.kernel import (
    Deflected,
    Engine,
    deflected_at,
    deflected_engine,
    engine_axis_motion,
    put_deflected,
    set_motion,
    thrust,
)
from maxq.sim.vehicle.engine.modes import Rates, engine_velocity, gimbal_rates, modal_roll_response
from maxq.sim.vehicle.environment import (
    AirData,
    Environment,
    air_data,
    pad_acceleration,
    rail_acceleration,
    winds_along_body,
)
from maxq.sim.vehicle.faults import ACTUATOR_FAULT, N_FAULT_SLOTS, STUCK
from maxq.sim.vehicle.feed.kernel import FeedLine, feed_derivative, feed_forces, thrust_with_feed
from maxq.sim.vehicle.modes.planar import (
    Bending,
    Modes,
    apply_gimbal_load,
    bending_rate_at_gyro,
    elastic_forces,
    gimbal_displacement,
    gyroscopic_forces,
    modal_derivative,
    modal_state,
)
from maxq.sim.vehicle.modes.spatial import (
    Load,
    SpatialModes,
    apply_spatial_load,
    outer_spatial_load,
    spatial_derivative,
    spatial_elastic_forces,
    spatial_gyroscopic,
    spatial_motion,
    spatial_rate_at_gyro,
    spatial_state,
    sum_of_loads,
)
from maxq.sim.vehicle.sensor.further import Sensor, sense
from maxq.sim.vehicle.sensor.gyro import Gyro, gyro_derivative, sensed_rate
from maxq.sim.vehicle.slosh.kernel import Slosh, exchange_loads, pendulum_derivative, pendulum_loads
from maxq.sim.vehicle.tvc_load.kernel import TvcLoad, load_derivative, prepare_loads, resistance, swing_engines
from maxq.sim.vehicle.workspace import Aux, Evaluation, Work
from maxq.sim.world.earth import gravity_gradient_torque


@dataclass(frozen=True)
class StageRecord:
    """The parameters of a stage."""

    sizes: Sizes
    schedule: TableRef
    engine: Engine
    actuator_pitch: Actuator
    actuator_yaw: Actuator
    # pitch and yaw of each group after the first
    further_actuators: Annotated[tuple[Actuator, ...], (2 * MAX_ENGINES - 2,)]
    tvc_load: TvcLoad
    gyro: Gyro
    sensors: Annotated[tuple[Sensor, ...], (MAX_SENSORS,)]
    aero: Aero
    bending: Bending
    spatial_modes: SpatialModes
    slosh: Slosh
    buffet: Buffet
    feed_lines: Annotated[tuple[FeedLine, ...], (MAX_FEED_LINES,)]
    rate_damping: TableRef  # columns about x, y, z over the schedule's clock, N m s/rad; NO_TABLE: none
    roll_torque_Nm: float
    turn_torque_Nm: float  # of the thrusters in pitch and yaw
    jet_damping: int
    follower_thrust: int
    gravity_gradient: int


@dataclass
class Held:
    """The quantities that are constant between two events of the flight."""

    on_pad: int  # 1: held down
    on_rail: int  # 1: guided by the launch rail
    clamped: int  # 1: held at the tail alone, on the pad
    burning: int
    command_rad: Annotated[Array, (2 * MAX_ENGINES,)]  # command to the actuators: pitch and yaw of each group
    engine_rad: Annotated[Array, (2 * MAX_ENGINES,)]  # angles at the start of the step, the memory of the play
    roll_torque_Nm: float
    turn_torque_Nm: Annotated[Array, (2,)]  # torque of the thrusters in pitch and yaw
    settling_N: float  # forward thrust before a restart
    faults: Annotated[Array, (N_FAULT_SLOTS,)]  # see faults.py


@dataclass
class StageInputs:
    """The external inputs that vary within a step, evaluated at every stage of the Runge-Kutta method."""

    force_x_N: float  # injected force, in B, at the core CG
    force_y_N: float
    force_z_N: float
    torque_x_Nm: float
    torque_y_Nm: float
    torque_z_Nm: float
    gust_x_mps: float  # gust in the frame of the turbulence: B, or north, east, down
    gust_y_mps: float
    gust_z_mps: float
    thrust_share: float  # injected thrust of all engines, relative to their thrust
    now_ns: int  # start of the step, and time since then, for the buffet
    elapsed_s: float


@kernel
def derive_properties(vehicle: StageRecord, pool: Array, clock_s: float, properties: Array) -> None:
    """Compute the derived properties, which follow the columns of the schedule, once per instant."""
    sizes = counts(vehicle.sizes)
    if not are_usual(sizes):
        _derive_unusual_properties(vehicle, pool, clock_s, properties)
    elif sizes.mode_groups > 0:
        _derive_properties(vehicle, usual_counts(sizes), pool, clock_s, properties)
    else:
        _derive_properties(vehicle, rigid_counts(sizes), pool, clock_s, properties)


@rare_routine
def _derive_unusual_properties(vehicle: StageRecord, pool: Array, clock_s: float, properties: Array) -> None:
    _derive_properties(vehicle, counts(vehicle.sizes), pool, clock_s, properties)


@kernel
def _derive_properties(vehicle: StageRecord, sizes: Counts, pool: Array, clock_s: float, properties: Array) -> None:
    bending = vehicle.bending
    sch.complete_modes(sizes, sch.PITCH, sizes.pitch_modes, bending.zeta_pitch, bending.frequency_factor, properties)
    sch.complete_modes(sizes, sch.YAW, sizes.yaw_modes, bending.zeta_yaw, bending.frequency_factor, properties)
    if sizes.spatial_modes > 0:
        sch.complete_spatial_modes(
            sizes, vehicle.spatial_modes.zeta, vehicle.spatial_modes.frequency_factor, properties
        )
    rigid.prepare_outflow(vehicle.engine, vehicle.slosh, sizes, properties)
    moment_reference(vehicle.aero, sizes, pool, clock_s, properties)
    for line in range(sizes.feed_lines):
        table = vehicle.feed_lines[line].table
        interpolate_into(
            pool, table, find_interval(pool, table, clock_s), clock_s, properties, sch.feed_column(sizes, line)
        )
    if vehicle.rate_damping.n_columns > 0:
        k = find_interval(pool, vehicle.rate_damping, clock_s)
        interpolate_into(
            pool, vehicle.rate_damping, k, clock_s, properties, sch.schedule_width(sizes) + sch.RATE_DAMPING
        )


@routine_beside
def derivative(
    vehicle: StageRecord,
    environment: Environment,
    pool: Array,
    held: Held,
    inputs: StageInputs,
    at: Evaluation,
    work: Work,
) -> None:
    """Write the derivative of `at.y` to `at.dy` and auxiliary outputs to `at.aux`.

    `at.properties` must be those of this instant.
    """
    sizes = counts(vehicle.sizes)
    if not are_usual(sizes):
        _unusual_derivative(vehicle, environment, pool, held, inputs, at, work)
    elif sizes.mode_groups > 0:
        _derivative(vehicle, usual_counts(sizes), environment, pool, held, inputs, at, work)
    else:
        _rigid_derivative(vehicle, environment, pool, held, inputs, at, work)
    if vehicle.tvc_load.stalls == 1:
        stall_actuators(vehicle, vehicle.sizes, held, at.y, at.dy, at.aux)


@rare_routine
def _unusual_derivative(
    vehicle: StageRecord,
    environment: Environment,
    pool: Array,
    held: Held,
    inputs: StageInputs,
    at: Evaluation,
    work: Work,
) -> None:
    _derivative(vehicle, counts(vehicle.sizes), environment, pool, held, inputs, at, work)


@rare_routine
def _rigid_derivative(
    vehicle: StageRecord,
    environment: Environment,
    pool: Array,
    held: Held,
    inputs: StageInputs,
    at: Evaluation,
    work: Work,
) -> None:
    _derivative(vehicle, rigid_counts(counts(vehicle.sizes)), environment, pool, held, inputs, at, work)


@kernel
def _derivative(
    vehicle: StageRecord,
    sizes: Counts,
    environment: Environment,
    pool: Array,
    held: Held,
    inputs: StageInputs,
    at: Evaluation,
    work: Work,
) -> None:
    (properties, y, dy, aux), modes = at, work.modes
    eta, xi, spatial, pendulums = (
        states.eta_index(sizes),
        states.xi_index(sizes),
        states.spatial_index(sizes),
        states.pendulum_index(sizes, 0),
    )
    loads = states.tvc_load_index(sizes)
    rate = vector_at(y, W_BI_B)
    rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])

    gust = (inputs.gust_x_mps, inputs.gust_y_mps, inputs.gust_z_mps)
    gravitation = air_data(environment, pool, gust, rotation, y, work.anchor, aux.air)
    modal_state(sizes, rate[0], y, eta, xi, modes.planar)
    if sizes.spatial_modes > 0:
        spatial_state(sizes, rate[0], properties, y, spatial, modes.spatial)
    engine, balanced = engine_motion(vehicle, sizes, held, properties, y, work, aux)

    if sizes.air_lags > 0:
        lag_first_modes(
            vehicle.aero.lag_m,
            aux.air.airspeed_mps,
            rate[0],
            y,
            states.air_lag_index(sizes),
            dy,
            modes.planar,
            work.aero.late,
        )
    aero_force, aero_moment = aerodynamics(
        vehicle, sizes, environment, pool, held, rotation, rate, properties, y, work, aux.air
    )
    if sizes.buffets > 0:
        buffet_loads(
            vehicle.buffet,
            vehicle.sizes,
            pool,
            inputs.now_ns,
            inputs.elapsed_s,
            aux.air.mach,
            aux.air.dynamic_pressure_Pa,
            properties,
            modes,
            work.buffet,
            aux.buffet_N,
        )
    if sizes.feed_lines > 0:
        feed_forces(vehicle.feed_lines, vehicle.sizes, properties, y, states.feed_index(sizes), work.feed)
    thrust_force, thrust_moment, gimbal_load = thrust_loads(
        vehicle, sizes, engine, inputs.thrust_share, properties, work, aux
    )
    inverse_mass = properties[sch.schedule_width(sizes) + sch.INVERSE_TOTAL_MASS]
    pad, axial_load = (0.0, 0.0, 0.0), (aero_force[0] + thrust_force[0]) * inverse_mass
    if held.on_pad + held.on_rail > 0:
        pad = pad_acceleration(environment.earth, rotation, gravitation, y)
        if held.on_rail == 1:
            pad = rail_acceleration(environment.earth, rotation, pad, axial_load, y)
        axial_load = pad[0]

    force = add(add(aero_force, thrust_force), (inputs.force_x_N, inputs.force_y_N, inputs.force_z_N))
    moment = add(aero_moment, thrust_moment)
    if sizes.buffets > 0:
        force, moment = add(force, vector_at(work.buffet.load, 0)), add(moment, vector_at(work.buffet.load, 3))
    if held.settling_N > 0.0:
        force, axial_load = add(force, (held.settling_N, 0.0, 0.0)), axial_load + held.settling_N * inverse_mass
    if held.turn_torque_Nm[0] != 0.0 or held.turn_torque_Nm[1] != 0.0:
        moment = add(moment, (0.0, held.turn_torque_Nm[0], held.turn_torque_Nm[1]))
    moment = add(moment, (held.roll_torque_Nm + inputs.torque_x_Nm, inputs.torque_y_Nm, inputs.torque_z_Nm))
    if vehicle.gravity_gradient == 1:
        moment = add(moment, gravity_gradient_moment(environment, balanced.inertia, rotation, y))
    if vehicle.jet_damping == 1:
        jet_force, jet_moment = rigid.coriolis_of_outflow(sizes, rate, properties)
        force, moment = add(force, jet_force), add(moment, jet_moment)
    if vehicle.rate_damping.n_columns > 0:
        behind = sch.schedule_width(sizes) + sch.RATE_DAMPING
        moment = add(
            moment,
            (-properties[behind] * rate[0], -properties[behind + 1] * rate[1], -properties[behind + 2] * rate[2]),
        )
    moment = add(moment, scaled(-1.0, cross(rate, inertia_times(balanced.inertia, rate))))

    if sizes.spatial_modes > 0:
        moment = add(
            moment, outer_spatial_load(sizes, properties, sch.gimbal_place(sizes, 0), gimbal_load, modes.spatial)
        )
    reaction_load, momentum = (
        (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        rigid.engine_momentum(vehicle.engine, 0, engine, rate[0]),
    )
    first_rates = gimbal_rates(sizes, properties, 0, modes)
    if vehicle.engine.gimballed_mass_kg[0] > 0.0 or vehicle.engine.inertia_kgm2[0] > 0.0:
        reaction_force, reaction_moment, reaction_load = rigid.engine_reaction(
            vehicle.engine, 0, engine, rate, axial_load, engine_velocity(vehicle.engine, 0, first_rates)
        )
        force, moment = add(force, reaction_force), add(moment, reaction_moment)
    if sizes.engines > 1:
        further_force, further_moment, reaction_load, momentum = further_reactions(
            vehicle.engine, vehicle.sizes, rate, axial_load, first_rates, reaction_load, momentum, properties, work
        )
        force, moment = add(force, further_force), add(moment, further_moment)
    if sizes.spatial_modes > 0:
        apply_spatial_load(sizes, properties, sch.gimbal_place(sizes, 0), reaction_load, modes.spatial.force_N)
        apply_spatial_load(sizes, properties, sch.gimbal_place(sizes, 0), momentum, modes.spatial.momentum_Ns)
    if sizes.pitch_modes + sizes.yaw_modes > 0:
        apply_gimbal_load(sizes, properties, 0, sum_of_loads(gimbal_load, reaction_load), modes.planar.force_N)
        gyroscopic = gyroscopic_forces(sizes, properties, 0, rate, momentum, modes.planar)
        roll = elastic_forces(vehicle.bending, sizes, properties, axial_load, modes.planar)
        moment = add(moment, (gyroscopic[0] + roll, gyroscopic[1], gyroscopic[2]))
    if sizes.spatial_modes > 0:
        moment = add(moment, spatial_gyroscopic(sizes, properties, rate, modes.spatial))
        k_soft = vehicle.bending.softening_factor * axial_load
        moment = add(moment, (spatial_elastic_forces(sizes, properties, k_soft, modes.spatial), 0.0, 0.0))
    for tank in range(sizes.pendulums):
        first = pendulums + states.N_PENDULUM * tank
        damper_force, damper_moment = pendulum_loads(
            vehicle.slosh, sizes, tank, rate, axial_load, balanced.offset, properties, y, first, modes, work.tank[tank]
        )
        force, moment = add(force, damper_force), add(moment, damper_moment)
    if vehicle.slosh.exchange == 1:
        liquid_force, liquid_moment = exchange_loads(
            vehicle.slosh, sizes, rate, properties, y, pendulums, modes, work.tank
        )
        force, moment = add(force, liquid_force), add(moment, liquid_moment)

    if sizes.tvc_loads > 0:
        prepare_loads(
            vehicle.tvc_load,
            vehicle.engine,
            engine,
            balanced.offset,
            sizes,
            rate,
            first_rates,
            axial_load,
            properties,
            y,
            loads,
            held.faults,
            work.engine,
            modes,
            work.system,
            aux.tvc_loads,
        )
    if held.clamped == 1:
        force, moment = clamp_tail(
            vehicle.sizes,
            environment.earth,
            vehicle.engine.gimbal_station_m[0],
            rotation,
            balanced.offset,
            balanced.inverse_inertia,
            pad,
            force,
            moment,
            properties,
            y,
            work,
        )
    fixed = held.on_pad - held.clamped
    specific_force, alpha = accelerate(
        sizes, fixed + held.on_rail, balanced, force, moment, pad, properties, y, pendulums, work
    )

    rigid.kinematics(environment.earth, fixed, rotation, rate, specific_force, alpha, gravitation, properties, y, dy)
    actuator_rates(vehicle.actuator_pitch, held.faults, 0, y, states.ACTUATOR, held.command_rad[0], dy)
    actuator_rates(
        vehicle.actuator_yaw, held.faults, 1, y, states.ACTUATOR + states.N_ACTUATOR, held.command_rad[1], dy
    )
    for k in range(2 * sizes.further_groups):
        i = states.actuator_index(sizes, 1) + states.N_ACTUATOR * k
        actuator_rates(vehicle.further_actuators[k], held.faults, 2 + k, y, i, held.command_rad[2 + k], dy)
    bend_y, bend_z = bending_rate_at_gyro(sizes, properties, modes.planar)
    local = (rate[0], rate[1] + bend_y, rate[2] + bend_z)
    if sizes.spatial_modes > 0:
        added = spatial_rate_at_gyro(sizes, rate[0], properties, modes.spatial)
        local, bend_y, bend_z = add(local, added), bend_y + added[1], bend_z + added[2]
    sensed = sensed_rate(vehicle.gyro, local)
    gyro_derivative(vehicle.gyro, y, states.GYRO, sensed, held.faults, dy)
    modal_derivative(sizes, eta, xi, dy, modes.planar)
    if sizes.spatial_modes > 0:
        spatial_derivative(sizes, spatial, dy, modes.spatial)
    for tank in range(sizes.pendulums):
        first = pendulums + states.N_PENDULUM * tank
        own = work.tank[tank]
        pendulum_derivative(vehicle.slosh, sizes, tank, rate, specific_force, alpha, properties, y, first, dy, own)
        aux.tension_N[tank] = work.system.unknown[tank]
    if sizes.tvc_loads > 0:
        load_derivative(vehicle.tvc_load, vehicle.engine, sizes, y, loads, dy, work.system, aux.engines, aux.tvc_loads)
    if sizes.feed_lines > 0:
        steady = axial_load - (work.feed.axial_N * inverse_mass if held.on_pad == 0 else 0.0)
        feed_derivative(
            vehicle.feed_lines,
            vehicle.sizes,
            specific_force[0] - steady,
            properties,
            y,
            states.feed_index(sizes),
            dy,
            modes,
            work.feed,
        )
    if sizes.sensors > 0:
        first = states.sensor_index(sizes, 0)
        sense(vehicle.sensors, sizes, rate, specific_force, alpha, properties, held.faults, y, first, dy, modes)
    aux.axial_load_mps2 = axial_load
    set_vector(aux.aero_force_B_N, 0, aero_force)
    set_vector(aux.aero_moment_B_Nm, 0, aero_moment)
    set_vector(aux.specific_force_B_mps2, 0, specific_force)
    set_vector(aux.alpha_BI_B_radps2, 0, alpha)
    aux.gyro_bending_radps[0], aux.gyro_bending_radps[1] = bend_y, bend_z


@rare_routine
def stall_actuators(vehicle: StageRecord, of: Sizes, held: Held, y: Array, dy: Array, aux: Aux) -> None:
    """Write the accelerations of the servos against the torques of their engines."""
    sizes = counts(of)
    loads = states.tvc_load_index(sizes)
    for channel in range(2 + 2 * sizes.further_groups):
        against = resistance(vehicle.tvc_load, vehicle.engine, sizes, channel, y, loads, held.faults, aux.tvc_loads)
        if against == 0.0 or held.faults[ACTUATOR_FAULT + channel] == STUCK:
            continue
        a, i = vehicle.actuator_pitch, states.ACTUATOR + states.N_ACTUATOR * channel
        if channel == 1:
            a = vehicle.actuator_yaw
        if channel > 1:
            a, i = vehicle.further_actuators[channel - 2], i - 2 * states.N_ACTUATOR - states.ACTUATOR
            i += states.actuator_index(sizes, 1)
        dy[i + 1] = resisted_acceleration(a, held.faults, channel, y, i, held.command_rad[channel], against)


@kernel
def engine_motion(
    vehicle: StageRecord, sizes: Counts, held: Held, properties: Array, y: Array, work: Work, aux: Aux
) -> tuple[Deflected, rigid.Balance]:
    """Return the first engine, deflected by its actuators, and the CG and inertia with all engines deflected.

    Further engines are written to `work`, and angles, rates and accelerations of each group to `aux`.
    """
    i, command, before, faults = states.ACTUATOR, held.command_rad, held.engine_rad, held.faults
    channel = aux.engines.channel
    set_motion(channel[0], actuator_motion(vehicle.actuator_pitch, faults, 0, y, i, command, before))
    i += states.N_ACTUATOR
    set_motion(channel[1], actuator_motion(vehicle.actuator_yaw, faults, 1, y, i, command, before))
    for k in range(2 * sizes.further_groups):
        i = states.actuator_index(sizes, 1) + states.N_ACTUATOR * k
        motion = actuator_motion(vehicle.further_actuators[k], faults, 2 + k, y, i, command, before)
        set_motion(channel[2 + k], motion)
    if sizes.tvc_loads > 0:  # the actuators move one end of the spring; the engine has its own angles
        first_load = states.tvc_load_index(sizes)
        swing_engines(vehicle.tvc_load, vehicle.engine, sizes, y, first_load, aux.engines, aux.tvc_loads)
    axis, axis_rate, axis_accel = engine_axis_motion(vehicle.engine, 0, channel[0], channel[1])
    first = deflected_engine(vehicle.engine, 0, axis, axis_rate, axis_accel, properties)
    if sizes.engines > 1:
        further_motion(vehicle.engine, vehicle.sizes, properties, work, aux)
    given_way = 0.0
    if sizes.mode_groups + sizes.spatial_modes > 0:
        given_way = modal_roll_response(vehicle.engine, vehicle.sizes, first.delta, properties, work.engine, work.modes)
    return first, rigid.balance(vehicle.engine, sizes, first, given_way, properties, work.engine)


@routine
def further_motion(e: Engine, of: Sizes, properties: Array, work: Work, aux: Aux) -> None:
    """Write the deflected engines after the first to `work`."""
    for k in range(1, of.engines):
        put_deflected(work.engine[k], moved_engine(e, of, k, properties, aux))


@kernel
def moved_engine(e: Engine, of: Sizes, k: int, properties: Array, aux: Aux) -> Deflected:
    """Return engine k as its group, or its TVC load, moves it; after the derivative with the solved acceleration."""
    pitch, yaw = aux.engines.channel[2 * e.group[k]], aux.engines.channel[2 * e.group[k] + 1]
    if of.tvc_loads > 0 and e.swings[k] >= 0:
        pitch, yaw = aux.tvc_loads.swing[2 * e.swings[k]], aux.tvc_loads.swing[2 * e.swings[k] + 1]
    axis, axis_rate, axis_accel = engine_axis_motion(e, k, pitch, yaw)
    return deflected_engine(e, k, axis, axis_rate, axis_accel, properties)


@kernel
def aerodynamics(
    vehicle: StageRecord,
    sizes: Counts,
    environment: Environment,
    pool: Array,
    held: Held,
    rotation: Matrix,
    rate: Vector,
    properties: Array,
    y: Array,
    work: Work,
    air: AirData,
) -> tuple[Vector, Vector]:
    """Return force and moment about the core CG in B, and add the loads to the generalised forces in `work`."""
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if air_acts(vehicle.aero, air):
        flow = vector_at(air.flow_B_mps, 0)
        coefficients(vehicle.aero, pool, air.mach, work.aero.mach_row)
        if vehicle.aero.earth_rates == 1:
            spin = environment.earth.rate_radps
            rate = (rate[0] - rotation[6] * spin, rate[1] - rotation[7] * spin, rate[2] - rotation[8] * spin)
        cg = vector_at(properties, sch.CORE_CG)
        if environment.penetration == 1:
            winds_along_body(
                environment,
                pool,
                vehicle.aero.station_m,
                sizes.surfaces,
                vehicle.aero.crossflow_station_m,
                cg[0],
                rotation,
                y,
                work.anchor,
                air,
                work.aero.wind_B_mps,
            )
        force, moment = body_loads(vehicle.aero, air.density_kgpm3, flow, rate, held.burning, cg, work.aero)
        surface_force, surface_moment = surface_loads(
            vehicle.aero, sizes, air.density_kgpm3, flow, properties, work.modes, work.aero
        )
        force, moment = add(force, surface_force), add(moment, surface_moment)
        if sizes.tables > 0:
            table_force, table_moment = table_loads(
                vehicle.aero,
                sizes,
                pool,
                air.density_kgpm3,
                air.mach,
                flow,
                rate,
                held.burning,
                properties,
                work.modes,
                work.aero,
            )
            force, moment = add(force, table_force), add(moment, table_moment)
    return force, moment


@kernel
def thrust_loads(
    vehicle: StageRecord, sizes: Counts, engine: Deflected, share: float, properties: Array, work: Work, aux: Aux
) -> tuple[Vector, Vector, Load]:
    """Return the loads of the thrust along the deflected engines on the bent body.

    They are the force and the moment about the core CG, in B, and the load on the modes at the first gimbal station.
    Loads at other stations are added to the modes directly. `share` is an injected thrust relative to that of the
    engines. `outer_spatial_load` adds the moment due to the displacement by spatial modes.
    """
    strength = (1.0 + share) * thrust(vehicle.engine, 0, properties[sch.THRUST_VACUUM], aux.air.pressure_Pa)
    pushed = strength
    if sizes.feed_lines > 0:
        strength, push = thrust_with_feed(strength, 0, work.feed)
        pushed = strength + push
    aux.engines.thrust_N[0], aux.engines.axial_thrust_N = strength, vehicle.engine.rest_x[0] * strength
    bend = gimbal_bend(sizes, properties, 0, work.modes)
    gimbal = aux.gimbal_bending
    gimbal.moved_y_m, gimbal.moved_z_m = bend.moved_y, bend.moved_z
    gimbal.slope_y_rad, gimbal.slope_z_rad = bend.slope_y, bend.slope_z
    force, moment, load = thrust_load(vehicle.engine, 0, engine, pushed, vehicle.follower_thrust, bend)
    if sizes.engines > 1:
        further_force, further_moment, load = further_thrusts(
            vehicle.engine, vehicle.sizes, vehicle.follower_thrust, load, bend, share, properties, work, aux
        )
        force, moment = add(force, further_force), add(moment, further_moment)
    return force, moment, load


class Bend(NamedTuple):
    """The motion of a gimbal station due to bending: displacement (m) and rotation (rad) in B."""

    shift_y: float  # displacement by planar modes
    shift_z: float
    moved_y: float  # displacement by all modes
    moved_z: float
    twist: float
    slope_y: float
    slope_z: float


@kernel
def gimbal_bend(sizes: Counts, properties: Array, gimbal: int, modes: Modes) -> Bend:
    shift_y, shift_z, slope_y, slope_z = gimbal_displacement(sizes, properties, gimbal, modes.planar)
    moved_y, moved_z, twist = shift_y, shift_z, 0.0
    if sizes.spatial_modes > 0:
        spatial = spatial_motion(sizes, properties, sch.gimbal_place(sizes, gimbal), modes.spatial.eta_m)
        moved_y, moved_z = shift_y + spatial[1], shift_z + spatial[2]
        twist, slope_y, slope_z = spatial[3], slope_y + spatial[4], slope_z + spatial[5]
    return Bend(shift_y, shift_z, moved_y, moved_z, twist, slope_y, slope_z)


@kernel
def thrust_load(
    e: Engine, k: int, engine: Deflected, strength: float, follower: int, bend: Bend
) -> tuple[Vector, Vector, Load]:
    """Return the loads of `thrust_loads` for engine k, whose gimbal is displaced by `bend`."""
    if strength <= 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    axis = engine.axis
    if follower == 1:
        axis = add(axis, cross((bend.twist, bend.slope_y, bend.slope_z), axis))
    force = scaled(strength, axis)
    moment = cross(engine.gimbal, force)
    moment = (moment[0], moment[1] + bend.shift_z * force[0], moment[2] - bend.shift_y * force[0])
    off_y, off_z = e.gimbal_offset_y_m[k], e.gimbal_offset_z_m[k]
    couple = (off_y * force[2] - off_z * force[1], off_z * force[0], -off_y * force[0])
    if e.roll_arm_m[k] != 0.0:
        swirl = scaled(e.roll_arm_m[k], force)
        moment, couple = add(moment, swirl), add(couple, swirl)
    return force, moment, (force[0], force[1], force[2], couple[0], couple[1], couple[2])


@routine
def further_thrusts(
    e: Engine,
    of: Sizes,
    follower: int,
    load: Load,
    first_bend: Bend,
    share: float,
    properties: Array,
    work: Work,
    aux: Aux,
) -> tuple[Vector, Vector, Load]:
    """Return force and moment of the engines after the first, and `load` plus their load.

    `load` refers to the first station of gimbals; loads at other stations are added to the modes directly.
    """
    sizes, modes = counts(of), work.modes
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(1, sizes.engines):
        strength = (1.0 + share) * thrust(e, k, properties[sch.thrust_column(sizes, e.curve[k])], aux.air.pressure_Pa)
        pushed = strength
        if sizes.feed_lines > 0:
            strength, push = thrust_with_feed(strength, k, work.feed)
            pushed = strength + push
        aux.engines.thrust_N[k] = strength
        aux.engines.axial_thrust_N += e.rest_x[k] * strength
        gimbal, bend = e.gimbal[k], first_bend
        if gimbal > 0:
            bend = gimbal_bend(sizes, properties, gimbal, modes)
        own_force, own_moment, own_load = thrust_load(e, k, deflected_at(work.engine[k]), pushed, follower, bend)
        force, moment = add(force, own_force), add(moment, own_moment)
        if gimbal == 0:
            load = sum_of_loads(load, own_load)
            continue
        apply_gimbal_load(sizes, properties, gimbal, own_load, modes.planar.force_N)
        if sizes.spatial_modes > 0:
            place = sch.gimbal_place(sizes, gimbal)
            moment = add(moment, outer_spatial_load(sizes, properties, place, own_load, modes.spatial))
    return force, moment, load


@routine
def further_reactions(
    e: Engine,
    of: Sizes,
    rate: Vector,
    axial_load: float,
    first_rates: Rates,
    load: Load,
    momentum: Load,
    properties: Array,
    work: Work,
) -> tuple[Vector, Vector, Load, Load]:
    """Return the reaction of the engines after the first: force, moment, and `load` and `momentum` with theirs added.

    `load` and `momentum` refer to the first station of gimbals. Loads at other stations are added to the modes
    directly, and their gyroscopic moments to the moment.
    """
    sizes, modes = counts(of), work.modes
    force, moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(1, sizes.engines):
        engine, gimbal = deflected_at(work.engine[k]), e.gimbal[k]
        rates = first_rates
        if gimbal > 0:
            rates = gimbal_rates(sizes, properties, gimbal, modes)
        own_force, own_moment, own_load = rigid.engine_reaction(
            e, k, engine, rate, axial_load, engine_velocity(e, k, rates)
        )
        own_momentum = rigid.engine_momentum(e, k, engine, rate[0])
        force, moment = add(force, own_force), add(moment, own_moment)
        if gimbal == 0:
            load, momentum = sum_of_loads(load, own_load), sum_of_loads(momentum, own_momentum)
            continue
        apply_gimbal_load(sizes, properties, gimbal, own_load, modes.planar.force_N)
        moment = add(moment, gyroscopic_forces(sizes, properties, gimbal, rate, own_momentum, modes.planar))
        if sizes.spatial_modes > 0:
            place = sch.gimbal_place(sizes, gimbal)
            apply_spatial_load(sizes, properties, place, own_load, modes.spatial.force_N)
            apply_spatial_load(sizes, properties, place, own_momentum, modes.spatial.momentum_Ns)
    return force, moment, load, momentum


@kernel
def gravity_gradient_moment(environment: Environment, j: Symmetric, rotation: tuple[float, ...], y: Array) -> Vector:
    """Return the gravity-gradient moment on the core, in B, N m.

    `j`: inertia integrals (products positive). `rotation`: from B to I.
    """
    r = (
        rotation[0] * y[0] + rotation[3] * y[1] + rotation[6] * y[2],
        rotation[1] * y[0] + rotation[4] * y[1] + rotation[7] * y[2],
        rotation[2] * y[0] + rotation[5] * y[1] + rotation[8] * y[2],
    )
    return gravity_gradient_torque(environment.earth, r, (j[0], j[1], j[2], -j[3], -j[4], -j[5]))
