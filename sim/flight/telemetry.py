"""The channel table: what is logged, in which unit and frame. Kernel columns, MCAP schemas and docs come from it.

Angles are kept in radians by the kernel and logged in degrees where a name says so (`Channel.scale`).
The fast group holds what swings (actuator, gyro, control, bending, slosh), the slow group the rest.
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import rotation_from_quaternion, turn
from maxq.sim.flight.channels import Channel, ChannelTable, Topic
from maxq.sim.flight.metrics import STANDARD_GRAVITY_MPS2
from maxq.sim.flight.parameters import Memory, Parameters
from maxq.sim.vehicle.schedule import CORE_CG, CORE_INERTIA, CORE_MASS, MASS_FLOW, TOTAL_MASS
from maxq.sim.vehicle.slosh import bob_mass
from maxq.sim.vehicle.state import (
    GYRO,
    N_GYRO,
    Q_BI,
    R_I,
    V_I,
    W_BI_B,
    Sizes,
    eta_index,
    pendulum_index,
    xi_index,
)
from maxq.sim.vehicle.workspace import (
    AERO_FORCE,
    AERO_MOMENT,
    AIRSPEED,
    ANGULAR_ACCEL,
    DENSITY,
    DYNAMIC_PRESSURE,
    ENGINE_PITCH,
    ENGINE_YAW,
    FELT,
    FLOW,
    GIMBAL_BEND,
    GRAVITATION,
    GYRO_BEND,
    MACH,
    PRESSURE,
    SOUND_SPEED,
    TEMPERATURE,
    TENSIONS,
    THRUST,
    WIND_N,
)
from maxq.sim.world.earth import FLAT, earth_rotation, geodetic, inertial_to_earth, ned_axes

DEG = 180.0 / math.pi
FAST, SLOW = "fast", "slow"


def _triple(name: str, unit: str, frame: str, text: str, axes: str = "xyz", scale: float = 1.0) -> list[Channel]:
    """Three channels; `{}` in the name stands for the axis."""
    return [Channel(name.format(a), unit, frame, f"{text}, {a}", scale) for a in axes]


def _truth() -> list[Channel]:
    return [
        *_triple("r_I_{}_m", "m", "I", "position of the core CG, inertial"),
        *_triple("v_I_{}_mps", "m/s", "I", "velocity of the core CG, inertial"),
        *[Channel(f"q_BI_{c}", "1", "", f"attitude quaternion, B to I, component {c}") for c in "wxyz"],
        *_triple("w_BI_B_{}_radps", "rad/s", "B", "angular velocity relative to I"),
        *_triple("r_E_{}_m", "m", "E", "position of the core CG, Earth-fixed"),
        Channel("latitude_deg", "deg", "", "geodetic latitude", DEG),
        Channel("longitude_deg", "deg", "", "longitude, east positive", DEG),
        Channel("altitude_m", "m", "", "geodetic altitude"),
        *[
            Channel(f"v_N_{axis}_mps", "m/s", "N", f"velocity relative to the Earth, {axis}")
            for axis in ("north", "east", "down")
        ],
        Channel("speed_mps", "m/s", "", "speed relative to the Earth"),
        Channel("flight_path_deg", "deg", "", "angle of that velocity above the horizon", DEG),
        Channel("yaw_deg", "deg", "", "Euler angle 3-2-1 of B relative to local NED: yaw", DEG),
        Channel("pitch_deg", "deg", "", "Euler angle 3-2-1 of B relative to local NED: pitch", DEG),
        Channel("roll_deg", "deg", "", "Euler angle 3-2-1 of B relative to local NED: roll", DEG),
    ]


def _air() -> list[Channel]:
    return [
        Channel("density_kgpm3", "kg/m3", "", "air density"),
        Channel("pressure_Pa", "Pa", "", "ambient pressure"),
        Channel("temperature_K", "K", "", "ambient temperature"),
        Channel("sound_speed_mps", "m/s", "", "speed of sound"),
        Channel("airspeed_mps", "m/s", "", "speed relative to the air"),
        Channel("mach", "1", "", "Mach number"),
        Channel("dynamic_pressure_Pa", "Pa", "", "dynamic pressure"),
        Channel("alpha_deg", "deg", "", "angle of attack, atan2(w, u)", DEG),
        Channel("beta_deg", "deg", "", "angle of sideslip, asin(v / V)", DEG),
        Channel("alpha_total_deg", "deg", "", "angle between body axis and relative wind", DEG),
        Channel("q_alpha_Padeg", "Pa deg", "", "dynamic pressure times total incidence", DEG),
        *[
            Channel(f"wind_N_{axis}_mps", "m/s", "N", f"motion of the air relative to the Earth, {axis}")
            for axis in ("north", "east", "down")
        ],
    ]


def _loads() -> list[Channel]:
    return [
        *_triple("aero_force_B_{}_N", "N", "B", "aerodynamic force"),
        *_triple("aero_moment_B_{}_Nm", "N m", "B", "aerodynamic moment about the core CG"),
        *_triple("felt_B_{}_mps2", "m/s2", "B", "specific force at the core CG (what an accelerometer senses)"),
        *_triple("alpha_BI_B_{}_radps2", "rad/s2", "B", "angular acceleration"),
        *_triple("gravitation_I_{}_mps2", "m/s2", "I", "gravitation"),
        Channel("thrust_over_weight_g", "g", "", "thrust over mass"),
        Channel(
            "axial_load_g",
            "g",
            "",
            "axial specific force of the whole vehicle, (thrust + aerodynamics) / mass",
        ),
    ]


def _vehicle() -> list[Channel]:
    return [
        Channel("thrust_N", "N", "", "thrust against ambient pressure"),
        Channel("mass_flow_kgps", "kg/s", "", "mass leaving the vehicle"),
        Channel("mass_kg", "kg", "", "total mass"),
        Channel("core_mass_kg", "kg", "", "mass without the sloshing masses"),
        Channel("cg_station_m", "m", "", "core CG, aft of the nose"),
        Channel("Ixx_kgm2", "kg m2", "", "core inertia about its CG"),
        Channel("Iyy_kgm2", "kg m2", "", "core inertia about its CG"),
        Channel("Izz_kgm2", "kg m2", "", "core inertia about its CG"),
        Channel("stage", "1", "", "number of the stage that flies, from 0"),
        Channel("held_down", "1", "", "1 while held down on the pad"),
    ]


def _guidance() -> list[Channel]:
    return [
        Channel(f"{axis}_{what}_{unit}", unit_text, "", f"{text}, {axis}", DEG)
        for what, unit, unit_text, text in (
            ("commanded", "deg", "deg", "integral of the commanded rate"),
            ("counted", "deg", "deg", "sum of the gyro's pulses"),
        )
        for axis in ("roll", "pitch", "yaw")
    ]


def _gyro() -> list[Channel]:
    axes = ("roll", "pitch", "yaw")
    return [
        *[Channel(f"gyro_{a}_rate_degps", "deg/s", "", f"gyro output, {a}", DEG) for a in axes],
        *[Channel(f"body_{a}_rate_degps", "deg/s", "", f"true body rate, {a}", DEG) for a in axes],
        *[
            Channel(f"bending_{a}_rate_degps", "deg/s", "", f"turning rate by bending at the gyro, {a}", DEG)
            for a in axes[1:]
        ],
    ]


def _control() -> list[Channel]:
    planes = ("pitch", "yaw")
    return [
        *[Channel(f"counts_{a}", "1", "", f"gyro pulses of the last sample, {a}") for a in ("roll", *planes)],
        *[Channel(f"error_{a}_deg", "deg", "", f"angle error theta_e, {a}", DEG) for a in ("roll", *planes)],
        *[Channel(f"measured_{a}_rate_degps", "deg/s", "", f"rate in the law, {a}", DEG) for a in ("roll", *planes)],
        *[Channel(f"k_p_{a}", "1", "", f"proportional gain, {a}") for a in planes],
        *[Channel(f"k_d_{a}_s", "s", "", f"rate gain, {a}") for a in planes],
        *[Channel(f"law_{a}_deg", "deg", "", f"output of the PD law, {a}", DEG) for a in planes],
        *[Channel(f"filtered_{a}_deg", "deg", "", f"output of the bending filter, {a}", DEG) for a in planes],
        *[Channel(f"saturated_{a}", "1", "", f"1 where the command lies at its limit, {a}") for a in planes],
        Channel("roll_thruster", "1", "", "roll thrusters: -1, 0 or 1"),
    ]


def _actuator() -> list[Channel]:
    return [
        Channel(f"gimbal_{a}_{what}_{unit}", unit_text, "", f"{text}, {a}", DEG)
        for a in ("pitch", "yaw")
        for what, unit, unit_text, text in (
            ("command", "deg", "deg", "command that the actuator gets"),
            ("angle", "deg", "deg", "engine angle"),
            ("rate", "degps", "deg/s", "engine rate"),
            ("accel", "degps2", "deg/s2", "engine acceleration"),
        )
    ]


def _bending(sizes: Sizes) -> list[Channel]:
    planes = (("pitch", sizes.pitch_modes), ("yaw", sizes.yaw_modes))
    return [
        *[
            Channel(f"eta_{plane}_{i + 1}_{unit}", unit_text, "", f"{text}, {plane} mode {i + 1}")
            for plane, count in planes
            for i in range(count)
            for unit, unit_text, text in (
                ("m", "m", "modal coordinate (displacement of the gimbal)"),
                ("mps", "m/s", "modal rate"),
            )
        ],
        *[
            Channel(f"bend_{plane}_{what}", unit, "", f"{text}, {plane}", scale)
            for plane, _ in planes
            for what, unit, text, scale in (
                ("gimbal_m", "m", "displacement of the gimbal by bending", 1.0),
                ("gimbal_deg", "deg", "turning of the gimbal by bending", DEG),
            )
        ],
    ]


def _slosh(tanks: tuple[str, ...]) -> list[Channel]:
    return [
        Channel(f"slosh_{tank}_{what}", unit, "", f"{text}, tank {tank}", scale)
        for tank in tanks
        for what, unit, text, scale in (
            ("pitch_deg", "deg", "pendulum angle in the pitch plane", DEG),
            ("yaw_deg", "deg", "pendulum angle in the yaw plane", DEG),
            ("pitch_rate_degps", "deg/s", "its rate", DEG),
            ("yaw_rate_degps", "deg/s", "its rate", DEG),
            ("tension_N", "N", "force of the rod", 1.0),
        )
    ]


def channel_table(sizes: Sizes, tanks: tuple[str, ...]) -> ChannelTable:
    """Channels of a vehicle with so many modes and these tanks."""
    topics = [
        Topic("/actuator", FAST, tuple(_actuator()), "gimbal command and engine motion"),
        Topic("/gyro", FAST, tuple(_gyro()), "rate gyro"),
        Topic("/control", FAST, tuple(_control()), "flight computer"),
    ]
    if sizes.pitch_modes + sizes.yaw_modes > 0:
        topics.append(Topic("/bending", FAST, tuple(_bending(sizes)), "bending modes"))
    if tanks:
        topics.append(Topic("/slosh", FAST, tuple(_slosh(tanks)), "slosh pendulums"))
    topics += [
        Topic("/truth", SLOW, tuple(_truth()), "motion"),
        Topic("/air", SLOW, tuple(_air()), "air data"),
        Topic("/loads", SLOW, tuple(_loads()), "forces and accelerations"),
        Topic("/vehicle", SLOW, tuple(_vehicle()), "mass and thrust"),
        Topic("/guidance", SLOW, tuple(_guidance()), "commanded and counted attitude"),
    ]
    return ChannelTable(tuple(topics))


@routine
def fill_fast(p: Parameters, logged: Sizes, memory: Memory, props: Array, y: Array, aux: Array, row: Array) -> None:
    """One row of the fast group; `logged` is how many modes and tanks the log has columns for."""
    law, held, sizes = memory.computer.law, memory.held, p.vehicle.sizes
    row[0], row[4] = held.command_pitch_rad, held.command_yaw_rad
    for j in range(3):
        row[1 + j], row[5 + j] = aux[ENGINE_PITCH + j], aux[ENGINE_YAW + j]
        row[8 + j], row[11 + j] = y[GYRO + N_GYRO * j], y[W_BI_B + j]
        row[16 + j] = memory.computer.converter.counts[j]
        row[19 + j], row[22 + j] = law.theta_e_rad[j], law.rate_radps[j]
    row[14], row[15] = aux[GYRO_BEND], aux[GYRO_BEND + 1]
    for j in range(2):
        row[25 + j], row[27 + j] = law.k_p[j], law.k_d_s[j]
        row[29 + j], row[31 + j] = law.pd_rad[j], law.filtered_rad[j]
        row[33 + j] = law.command_limited[j]
    row[35] = memory.computer.roll.demand
    c = 36
    if logged.pitch_modes + logged.yaw_modes > 0:
        c = _fill_bending(sizes, logged, y, aux, row, c)
    _fill_slosh(p, logged, props, y, aux, row, c)


@kernel
def _fill_bending(sizes: Sizes, logged: Sizes, y: Array, aux: Array, row: Array, c: int) -> int:
    eta, xi = eta_index(sizes), xi_index(sizes)
    for i in range(logged.pitch_modes):
        there = i < sizes.pitch_modes
        row[c] = y[eta + i] if there else math.nan
        row[c + 1] = y[eta + sizes.pitch_modes + i] if there else math.nan
        c += 2
    for i in range(logged.yaw_modes):
        there = i < sizes.yaw_modes
        row[c] = y[xi + i] if there else math.nan
        row[c + 1] = y[xi + sizes.yaw_modes + i] if there else math.nan
        c += 2
    row[c], row[c + 1] = aux[GIMBAL_BEND + 1], aux[GIMBAL_BEND + 2]
    row[c + 2], row[c + 3] = aux[GIMBAL_BEND], aux[GIMBAL_BEND + 3]
    return c + 4


@kernel
def _fill_slosh(p: Parameters, logged: Sizes, props: Array, y: Array, aux: Array, row: Array, c: int) -> None:
    sizes = p.vehicle.sizes
    for tank in range(logged.tanks):
        i = pendulum_index(sizes, tank)
        if tank >= sizes.tanks or bob_mass(p.vehicle.slosh, props, tank) <= 0.0:
            for j in range(5):
                row[c + j] = math.nan
        else:
            u_x, u_y, u_z = -y[i], y[i + 1], y[i + 2]
            # d(u)/dt in B = kappa - w x u
            rate_x = -(y[i + 3] - (y[W_BI_B + 1] * u_z - y[W_BI_B + 2] * u_y))
            rate_y = y[i + 4] - (-y[W_BI_B + 2] * u_x - y[W_BI_B] * u_z)
            rate_z = y[i + 5] - (y[W_BI_B] * u_y + y[W_BI_B + 1] * u_x)
            row[c], row[c + 1] = math.atan2(u_z, u_x), math.atan2(u_y, u_x)
            row[c + 2] = (u_x * rate_z - u_z * rate_x) / (u_x * u_x + u_z * u_z)
            row[c + 3] = (u_x * rate_y - u_y * rate_x) / (u_x * u_x + u_y * u_y)
            row[c + 4] = aux[TENSIONS + tank]
        c += 5


@routine
def fill_slow(p: Parameters, memory: Memory, props: Array, y: Array, aux: Array, row: Array) -> None:
    """One row of the slow group."""
    for j in range(3):
        row[j], row[3 + j], row[10 + j] = y[R_I + j], y[V_I + j], y[W_BI_B + j]
    for j in range(4):
        row[6 + j] = y[Q_BI + j]
    _fill_place(p, memory, y, row)
    c = 27
    lateral = math.sqrt(aux[FLOW + 1] ** 2 + aux[FLOW + 2] ** 2)
    incidence = math.atan2(lateral, aux[FLOW])
    row[c], row[c + 1], row[c + 2] = aux[DENSITY], aux[PRESSURE], aux[TEMPERATURE]
    row[c + 3], row[c + 4], row[c + 5] = aux[SOUND_SPEED], aux[AIRSPEED], aux[MACH]
    row[c + 6] = aux[DYNAMIC_PRESSURE]
    row[c + 7] = math.atan2(aux[FLOW + 2], aux[FLOW])
    row[c + 8] = math.atan2(aux[FLOW + 1], math.sqrt(aux[FLOW] ** 2 + aux[FLOW + 2] ** 2))
    row[c + 9] = incidence
    row[c + 10] = aux[DYNAMIC_PRESSURE] * incidence
    for j in range(3):
        row[c + 11 + j] = aux[WIND_N + j]
    c += 14
    for j in range(3):
        row[c + j], row[c + 3 + j] = aux[AERO_FORCE + j], aux[AERO_MOMENT + j]
        row[c + 6 + j], row[c + 9 + j] = aux[FELT + j], aux[ANGULAR_ACCEL + j]
        row[c + 12 + j] = aux[GRAVITATION + j]
    weight = props[TOTAL_MASS] * STANDARD_GRAVITY_MPS2
    row[c + 15] = aux[THRUST] / weight
    row[c + 16] = (aux[THRUST] + aux[AERO_FORCE]) / weight
    c += 17
    row[c], row[c + 1] = aux[THRUST], props[MASS_FLOW]
    row[c + 2], row[c + 3], row[c + 4] = props[TOTAL_MASS], props[CORE_MASS], props[CORE_CG]
    for j in range(3):
        row[c + 5 + j] = props[CORE_INERTIA + j]
    row[c + 8], row[c + 9] = memory.clock.stage, memory.held.down
    c += 10
    for j in range(3):
        row[c + j] = memory.computer.guidance.angle_rad[j]
        row[c + 3 + j] = memory.computer.converter.angle_rad[j]


@kernel
def _fill_place(p: Parameters, memory: Memory, y: Array, row: Array) -> None:
    """Position, velocity and attitude relative to the Earth."""
    earth = p.around.earth
    cos, sin = earth_rotation(earth, 1e-9 * memory.clock.now_ns)
    x, yy, z = inertial_to_earth(cos, sin, y[R_I], y[R_I + 1], y[R_I + 2])
    latitude, longitude, altitude = geodetic(earth, x, yy, z)
    turning = earth.rate_radps
    vx, vy, vz = inertial_to_earth(cos, sin, y[V_I] + turning * y[R_I + 1], y[V_I + 1] - turning * y[R_I], y[V_I + 2])
    axes = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    if earth.figure != FLAT:
        axes = ned_axes(math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude))
    rotation = rotation_from_quaternion(y[Q_BI], y[Q_BI + 1], y[Q_BI + 2], y[Q_BI + 3])
    v_north, v_east, v_down = turn(axes, (vx, vy, vz))
    forward = turn(axes, inertial_to_earth(cos, sin, rotation[0], rotation[3], rotation[6]))
    right = turn(axes, inertial_to_earth(cos, sin, rotation[1], rotation[4], rotation[7]))
    under = turn(axes, inertial_to_earth(cos, sin, rotation[2], rotation[5], rotation[8]))
    speed = math.sqrt(vx * vx + vy * vy + vz * vz)
    row[13], row[14], row[15] = x, yy, z
    row[16], row[17], row[18] = latitude, longitude, altitude
    row[19], row[20], row[21] = v_north, v_east, v_down
    row[22] = speed
    row[23] = math.atan2(-v_down, math.sqrt(v_north * v_north + v_east * v_east))
    row[24] = math.atan2(forward[1], forward[0])
    row[25] = math.atan2(-forward[2], math.sqrt(forward[0] ** 2 + forward[1] ** 2))
    row[26] = math.atan2(right[2], under[2])


def scaled_rows(table: ChannelTable, group: str, rows: Array) -> Array:
    """Kernel rows in the units of the channels."""
    return np.asarray(rows * table.scales(group))
