"""The log of a flight: rows that declare their channels, and the kernels that fill them.

The fast group contains oscillating quantities (actuator, gyro, control, bending, slosh), the slow group all others.
Values are in the units of the log. control/kernel/rows.py describes the declaration of a row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.computer import ControlRow, GuidanceRow, control_row, guidance_row
from maxq.control.external import MonitorRow, monitor_row
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, NorthEastDown, QuaternionRow, RollPitchYaw, Xyz, degrees, put, xyz
from maxq.control.kernel.vectors import rotate, rotation_from_quaternion, vector_at
from maxq.control.laws.adaptive import AdaptiveRow, adaptive_row
from maxq.control.laws.drift import DriftRow, drift_row
from maxq.control.laws.load_relief import LoadReliefRow, load_relief_row
from maxq.sim.flight.channels import ChannelTable, Topic, declared_channels, declared_topics
from maxq.sim.flight.parameters import Memory, Parameters
from maxq.sim.vehicle.actuator.kernel import ActuatorRow, actuator_row
from maxq.sim.vehicle.buffet.kernel import BuffetRow, buffet_row
from maxq.sim.vehicle.engine.kernel import EngineRow, GroupRow, engine_row, group_row
from maxq.sim.vehicle.environment import AirData
from maxq.sim.vehicle.feed.kernel import FeedRow, feed_row
from maxq.sim.vehicle.loads.kernel import SectionRow, section_row
from maxq.sim.vehicle.modes.planar import BendingRow, ModeRow, bending_row, put_modes
from maxq.sim.vehicle.schedule import CORE_CG, CORE_INERTIA, CORE_MASS, MASS_FLOW, TOTAL_MASS
from maxq.sim.vehicle.sensor.further import (
    ACCELEROMETER,
    AccelerometerRow,
    FurtherAccelerometerRow,
    RateGyroRow,
    accelerometer_row,
    further_accelerometer_row,
    rate_gyro_row,
)
from maxq.sim.vehicle.sensor.gyro import GyroRow, gyro_row
from maxq.sim.vehicle.sensor.receivers import ReceiverRow, receiver_row
from maxq.sim.vehicle.slosh.kernel import SloshRow, WaveRow, slosh_row, wave_row
from maxq.sim.vehicle.state import (
    GYRO,
    Q_BI,
    R_I,
    V_I,
    W_BI_B,
    Sizes,
    eta_index,
    feed_index,
    pendulum_index,
    sensor_index,
    spatial_index,
    xi_index,
)
from maxq.sim.vehicle.tvc_load.kernel import SwingRow, TvcLoadRow, swing_row, tvc_load_row
from maxq.sim.vehicle.workspace import Aux, Evaluation
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.sim.world.earth import FLAT, earth_rotation, geodetic, inertial_to_earth, ned_axes

FAST, SLOW = "fast", "slow"


@dataclass(frozen=True)
class Logged:
    """The parts for which the rows of a log have columns, those of the widest stage; `on` = 0 means no log."""

    on: int
    sizes: Sizes
    stations: int  # number of stations of section loads
    waves: int  # 1: with the height of the waves
    engines: int  # 0 for a vehicle with one engine
    external: int  # 1: with the monitored values of external flight code
    adaptive: int  # 1: with the total gain of adaptive augmenting control
    drift: int  # 1: with the drift that the computer integrates
    receivers: int  # 1: with the sensors for navigation


# --- fast group


class FastRow(NamedTuple):
    """The topics of the fast group that every vehicle has."""

    actuator: Annotated[ActuatorRow, "gimbal command and gimbal motion"]
    gyro: Annotated[GyroRow, "rate gyro"]
    control: Annotated[ControlRow, "flight computer"]


@routine
def fill_fast(p: Parameters, out: Logged, memory: Memory, at: Evaluation, row: Array) -> None:
    """Fill one row of the fast group."""
    props, y, aux, logged = at.properties, at.y, at.aux, out.sizes
    sizes, engines = p.vehicle.sizes, aux.engines
    column = put(
        row,
        0,
        FastRow(
            actuator=actuator_row(
                memory.held.command_rad[0], memory.held.command_rad[1], engines.channel[0], engines.channel[1]
            ),
            gyro=gyro_row(y, GYRO, memory.held.faults, aux.gyro_bending_radps),
            control=control_row(memory.computer),
        ),
    )
    if logged.pitch_modes + logged.yaw_modes + logged.spatial_modes > 0:
        column = put_modes(row, column, y, eta_index(sizes), sizes.pitch_modes, logged.pitch_modes)
        column = put_modes(row, column, y, xi_index(sizes), sizes.yaw_modes, logged.yaw_modes)
        column = put_modes(row, column, y, spatial_index(sizes), sizes.spatial_modes, logged.spatial_modes)
        column = put(row, column, bending_row(aux.gimbal_bending))
    for tank in range(logged.pendulums):
        first = pendulum_index(sizes, tank)
        column = put(row, column, slosh_row(p.vehicle.slosh, sizes, tank, props, y, first, aux.tension_N))
    for tank in range(logged.pendulums * out.waves):
        column = put(row, column, wave_row(p.vehicle.slosh, sizes, tank, props, y, pendulum_index(sizes, tank)))
    if logged.tvc_loads == 1:
        column = put(row, column, tvc_load_row(sizes, aux.tvc_loads))
    if logged.tvc_loads > 1:
        for load in range(logged.tvc_loads):
            column = put(row, column, swing_row(sizes.tvc_loads, load, aux.tvc_loads))
    if logged.further_groups > 0:
        for group in range(1 + logged.further_groups):
            column = put(row, column, group_row(sizes.further_groups, group, memory.held.command_rad, engines))
    for number in range(out.engines):
        column = put(row, column, engine_row(p.vehicle.engine, number, engines))
    for station in range(logged.buffets):
        column = put(row, column, buffet_row(sizes.buffets, station, aux.buffet_N))
    for line in range(logged.feed_lines):
        column = put(row, column, feed_row(sizes.feed_lines, line, y, feed_index(sizes)))
    if out.external == 1:
        column = put(row, column, monitor_row(memory.computer.external))
    if out.adaptive == 1:
        column = put(row, column, adaptive_row(memory.computer.adaptive))
    if out.drift == 1:
        column = put(row, column, drift_row(memory.computer.law.drift))
    if out.receivers == 1:
        column = put(row, column, receiver_row(memory.receivers))
    for k in range(logged.sensors):
        first, counted = sensor_index(sizes, k), vector_at(memory.computer.sensors.value[k], 0)
        if p.vehicle.sensors[k].kind == ACCELEROMETER and k == p.computer.sensors.accelerometer:
            column = put(row, column, accelerometer_row(memory.held.faults, k, y, first, counted))
            column = put(row, column, load_relief_row(memory.computer.law.relief))
        elif p.vehicle.sensors[k].kind == ACCELEROMETER:
            column = put(row, column, further_accelerometer_row(memory.held.faults, k, y, first, counted))
        else:
            column = put(row, column, rate_gyro_row(memory.held.faults, k, y, first, counted))


# --- slow group


class MotionRow(NamedTuple):
    r_I_axis_m: Annotated[Xyz, "m", "position of the core CG, inertial"]
    v_I_axis_mps: Annotated[Xyz, "m/s", "velocity of the core CG, inertial"]
    q_BI_axis: Annotated[QuaternionRow, "1", "attitude quaternion, B to I, component"]
    w_BI_B_axis_radps: Annotated[Xyz, "rad/s", "angular velocity relative to I"]
    r_E_axis_m: Annotated[Xyz, "m", "position of the core CG, Earth-fixed"]
    latitude_deg: Annotated[float, "deg", "geodetic latitude"]
    longitude_deg: Annotated[float, "deg", "longitude, east positive"]
    altitude_m: Annotated[float, "m", "geodetic altitude"]
    v_N_axis_mps: Annotated[NorthEastDown, "m/s", "velocity relative to the Earth"]
    speed_mps: Annotated[float, "m/s", "speed relative to the Earth"]
    flight_path_deg: Annotated[float, "deg", "flight-path angle above the horizon"]
    yaw_deg: Annotated[float, "deg", "Euler angle 3-2-1 of B relative to local NED: yaw"]
    pitch_deg: Annotated[float, "deg", "Euler angle 3-2-1 of B relative to local NED: pitch"]
    roll_deg: Annotated[float, "deg", "Euler angle 3-2-1 of B relative to local NED: roll"]
    attitude_error_axis_deg: Annotated[
        RollPitchYaw, "deg", "commanded to true attitude at the last sample, as roll and tilt of the x axis in B"
    ]


@kernel
def motion_row(p: Parameters, memory: Memory, y: Array) -> MotionRow:
    earth = p.environment.earth
    cos, sin = earth_rotation(earth, 1e-9 * memory.clock.now_ns)
    r_E = inertial_to_earth(cos, sin, y[R_I], y[R_I + 1], y[R_I + 2])
    latitude, longitude, altitude = geodetic(earth, r_E[0], r_E[1], r_E[2])
    turning = earth.rate_radps
    vx, vy, vz = inertial_to_earth(cos, sin, y[V_I] + turning * y[R_I + 1], y[V_I + 1] - turning * y[R_I], y[V_I + 2])
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    if earth.figure != FLAT:
        axes = ned_axes(math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude))
    rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    v_north, v_east, v_down = rotate(axes, (vx, vy, vz))
    forward = rotate(axes, inertial_to_earth(cos, sin, rotation[0], rotation[3], rotation[6]))
    right = rotate(axes, inertial_to_earth(cos, sin, rotation[1], rotation[4], rotation[7]))
    under = rotate(axes, inertial_to_earth(cos, sin, rotation[2], rotation[5], rotation[8]))
    return MotionRow(
        r_I_axis_m=xyz(y, R_I),
        v_I_axis_mps=xyz(y, V_I),
        q_BI_axis=QuaternionRow(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3]),
        w_BI_B_axis_radps=xyz(y, W_BI_B),
        r_E_axis_m=Xyz(r_E[0], r_E[1], r_E[2]),
        latitude_deg=DEG * latitude,
        longitude_deg=DEG * longitude,
        altitude_m=altitude,
        v_N_axis_mps=NorthEastDown(v_north, v_east, v_down),
        speed_mps=math.sqrt(vx * vx + vy * vy + vz * vz),
        flight_path_deg=DEG * math.atan2(-v_down, math.sqrt(v_north * v_north + v_east * v_east)),
        yaw_deg=DEG * math.atan2(forward[1], forward[0]),
        pitch_deg=DEG * math.atan2(-forward[2], math.sqrt(forward[0] ** 2 + forward[1] ** 2)),
        roll_deg=DEG * math.atan2(right[2], under[2]),
        attitude_error_axis_deg=degrees(memory.truth.error_rad),
    )


class AirRow(NamedTuple):
    density_kgpm3: Annotated[float, "kg/m3", "air density"]
    pressure_Pa: Annotated[float, "Pa", "ambient pressure"]
    temperature_K: Annotated[float, "K", "ambient temperature"]
    sound_speed_mps: Annotated[float, "m/s", "speed of sound"]
    airspeed_mps: Annotated[float, "m/s", "speed relative to the air"]
    mach: Annotated[float, "1", "Mach number"]
    dynamic_pressure_Pa: Annotated[float, "Pa", "dynamic pressure"]
    alpha_deg: Annotated[float, "deg", "angle of attack, atan2(w, u)"]
    beta_deg: Annotated[float, "deg", "angle of sideslip, asin(v / V)"]
    alpha_total_deg: Annotated[float, "deg", "total angle of attack: between body axis and relative wind"]
    q_alpha_Padeg: Annotated[float, "Pa deg", "dynamic pressure times total angle of attack"]
    wind_N_axis_mps: Annotated[NorthEastDown, "m/s", "velocity of the air relative to the Earth"]


@kernel
def air_row(air: AirData) -> AirRow:
    u, v, w = xyz(air.flow_B_mps, 0)
    alpha_total = math.atan2(math.sqrt(v**2 + w**2), u)
    return AirRow(
        density_kgpm3=air.density_kgpm3,
        pressure_Pa=air.pressure_Pa,
        temperature_K=air.temperature_K,
        sound_speed_mps=air.sound_speed_mps,
        airspeed_mps=air.airspeed_mps,
        mach=air.mach,
        dynamic_pressure_Pa=air.dynamic_pressure_Pa,
        alpha_deg=DEG * math.atan2(w, u),
        beta_deg=DEG * math.atan2(v, math.sqrt(u**2 + w**2)),
        alpha_total_deg=DEG * alpha_total,
        q_alpha_Padeg=DEG * (air.dynamic_pressure_Pa * alpha_total),
        wind_N_axis_mps=NorthEastDown(air.wind_N_mps[0], air.wind_N_mps[1], air.wind_N_mps[2]),
    )


class LoadsRow(NamedTuple):
    aero_force_B_axis_N: Annotated[Xyz, "N", "aerodynamic force"]
    aero_moment_B_axis_Nm: Annotated[Xyz, "N m", "aerodynamic moment about the core CG"]
    specific_force_B_axis_mps2: Annotated[Xyz, "m/s2", "specific force at the core CG, as sensed by an accelerometer"]
    alpha_BI_B_axis_radps2: Annotated[Xyz, "rad/s2", "angular acceleration"]
    gravitation_I_axis_mps2: Annotated[Xyz, "m/s2", "gravitation"]
    thrust_over_weight_g: Annotated[float, "g", "thrust over mass"]
    axial_load_g: Annotated[float, "g", "axial specific force of the whole vehicle, (thrust + aerodynamics) / mass"]


@kernel
def loads_row(props: Array, aux: Aux) -> LoadsRow:
    weight_N = props[TOTAL_MASS] * STANDARD_GRAVITY_mps2
    return LoadsRow(
        aero_force_B_axis_N=xyz(aux.aero_force_B_N, 0),
        aero_moment_B_axis_Nm=xyz(aux.aero_moment_B_Nm, 0),
        specific_force_B_axis_mps2=xyz(aux.specific_force_B_mps2, 0),
        alpha_BI_B_axis_radps2=xyz(aux.alpha_BI_B_radps2, 0),
        gravitation_I_axis_mps2=xyz(aux.air.gravitation_I_mps2, 0),
        thrust_over_weight_g=aux.engines.axial_thrust_N / weight_N,
        axial_load_g=(aux.engines.axial_thrust_N + aux.aero_force_B_N[0]) / weight_N,
    )


class VehicleRow(NamedTuple):
    thrust_N: Annotated[float, "N", "thrust at ambient pressure"]
    mass_flow_kgps: Annotated[float, "kg/s", "mass leaving the vehicle"]
    mass_kg: Annotated[float, "kg", "total mass"]
    core_mass_kg: Annotated[float, "kg", "mass without the sloshing masses"]
    cg_station_m: Annotated[float, "m", "core CG, aft of the nose"]
    Ixx_kgm2: Annotated[float, "kg m2", "core inertia about its CG"]
    Iyy_kgm2: Annotated[float, "kg m2", "core inertia about its CG"]
    Izz_kgm2: Annotated[float, "kg m2", "core inertia about its CG"]
    stage: Annotated[float, "1", "number of the active stage, from 0"]
    on_pad: Annotated[float, "1", "1 while hold-down is engaged"]


@kernel
def vehicle_row(memory: Memory, props: Array, aux: Aux) -> VehicleRow:
    return VehicleRow(
        thrust_N=aux.engines.axial_thrust_N,
        mass_flow_kgps=props[MASS_FLOW],
        mass_kg=props[TOTAL_MASS],
        core_mass_kg=props[CORE_MASS],
        cg_station_m=props[CORE_CG],
        Ixx_kgm2=props[CORE_INERTIA],
        Iyy_kgm2=props[CORE_INERTIA + 1],
        Izz_kgm2=props[CORE_INERTIA + 2],
        stage=memory.clock.stage,
        on_pad=memory.held.on_pad,
    )


class SlowRow(NamedTuple):
    """The topics of the slow group."""

    truth: Annotated[MotionRow, "motion"]
    air: Annotated[AirRow, "air data"]
    loads: Annotated[LoadsRow, "forces and accelerations"]
    vehicle: Annotated[VehicleRow, "mass and thrust"]
    guidance: Annotated[GuidanceRow, "commanded and measured attitude"]


@routine
def fill_slow(p: Parameters, stations: int, memory: Memory, at: Evaluation, row: Array) -> None:
    """Fill one row of the slow group; `stations` is the number of sections for which the log has columns."""
    props, aux = at.properties, at.aux
    values = SlowRow(
        truth=motion_row(p, memory, at.y),
        air=air_row(aux.air),
        loads=loads_row(props, aux),
        vehicle=vehicle_row(memory, props, aux),
        guidance=guidance_row(memory.computer),
    )
    column = put(row, 0, values)
    for station in range(stations):
        column = put(row, column, section_row(memory.sections, p.loads.stations, station))


def channel_table(
    sizes: Sizes,
    tanks: tuple[str, ...],
    stations: tuple[str, ...] = (),
    waves: bool = False,
    groups: tuple[str, ...] = (),
    engines: tuple[str, ...] = (),
    external: bool = False,
    accelerometers: int = 0,
    adaptive: bool = False,
    drift: bool = False,
    receivers: bool = False,
) -> ChannelTable:
    """Return the channels of a vehicle with these numbers of parts, in the order of the kernels' columns.

    - `tanks`, `groups`, `engines`: names of the pendulums, the groups of engines and the engines, used in channel
      names.
    - `stations`: description of each station of the section loads; channel names contain the numbers, from 1.
    - `waves`: True to include the height of the pendulums' waves.
    - `external`: True to include the monitored values of external flight code.
    - `accelerometers`: number of the last sensors that are accelerometers.
    - `adaptive`: True to include the total gain.
    - `drift`: True to include the drift that the computer integrates.
    - `receivers`: True to include the sensors for navigation.
    """
    topics = declared_topics(FAST, FastRow)
    kinds = (("pitch", sizes.pitch_modes), ("yaw", sizes.yaw_modes), ("spatial", sizes.spatial_modes))
    modes = [(kind, i) for kind, count in kinds for i in range(1, count + 1)]
    bending = [declared_channels(ModeRow, "mode", f"{kind}_{i}", f"{kind} mode {i}") for kind, i in modes]
    if bending:
        channels = (*sum(bending, ()), *declared_channels(BendingRow))
        topics.append(Topic("/bending", FAST, channels, "bending modes"))
    slosh = [declared_channels(SloshRow, "tank", tank, f"tank {tank}") for tank in tanks]
    if waves:
        slosh += [declared_channels(WaveRow, "tank", tank, f"tank {tank}") for tank in tanks]
    if slosh:
        topics.append(Topic("/slosh", FAST, sum(slosh, ()), "slosh pendulums"))
    swinging = [declared_channels(SwingRow, "load", f"load_{n + 1}", f"load {n + 1}") for n in range(sizes.tvc_loads)]
    if swinging:
        channels = declared_channels(TvcLoadRow) if len(swinging) == 1 else sum(swinging, ())
        topics.append(Topic("/tvc_load", FAST, channels, "engines on their compliance"))
    moved = [declared_channels(GroupRow, "group", f"group_{name}", f"group {name}") for name in groups]
    thrusts = [declared_channels(EngineRow, "engine", f"engine_{name}", f"engine {name}") for name in engines]
    if moved or thrusts:
        topics.append(Topic("/engines", FAST, sum(moved + thrusts, ()), "groups of engines, and engines"))
    buffet = [declared_channels(BuffetRow, "place", str(n), f"station {n}") for n in range(1, sizes.buffets + 1)]
    if buffet:
        topics.append(Topic("/buffet", FAST, sum(buffet, ()), "forces of buffet"))
    lines = [declared_channels(FeedRow, "line", str(n), f"feed line {n}") for n in range(1, sizes.feed_lines + 1)]
    if lines:
        topics.append(Topic("/feed", FAST, sum(lines, ()), "oscillations in feed lines"))
    if external:
        topics.append(Topic("/flight_code", FAST, declared_channels(MonitorRow), "external flight code"))
    if adaptive:
        topics.append(Topic("/adaptive", FAST, declared_channels(AdaptiveRow), "adaptive augmenting control"))
    if drift:
        topics.append(Topic("/drift", FAST, declared_channels(DriftRow), "drift in the computer"))
    if receivers:
        topics.append(Topic("/navigation_sensors", FAST, declared_channels(ReceiverRow), "sensors for navigation"))
    further = range(2, 2 + sizes.sensors - accelerometers)
    sensors = [declared_channels(RateGyroRow, "number", str(n), f"rate gyro {n}") for n in further]
    if accelerometers:
        sensors += [declared_channels(AccelerometerRow), declared_channels(LoadReliefRow)]
    for n in range(2, 1 + accelerometers):
        sensors.append(declared_channels(FurtherAccelerometerRow, "number", str(n), f"accelerometer {n}"))
    if sensors:
        topics.append(Topic("/sensors", FAST, sum(sensors, ()), "additional sensors, and load relief"))
    topics += declared_topics(SLOW, SlowRow)
    sections = [declared_channels(SectionRow, "place", str(i), place) for i, place in enumerate(stations, start=1)]
    if sections:
        topics.append(Topic("/sections", SLOW, sum(sections, ()), "section loads"))
    return ChannelTable(tuple(topics))
