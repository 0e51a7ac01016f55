"""Aerodynamic forces and moments over the full circle of angle of attack, by slopes over Mach number.

The velocity relative to the air is (U, V, W) in B, and all forces have the factor rho S / 2. The normal force of a
lifting surface is -CN_alpha |U| W_k, the cross-flow drag is -C_c |(V, W)| W, and the axial force is -CA U |U|. For
small angles of attack these are q S CN_alpha alpha and q S CA. At 90 deg only the cross-flow drag remains, and no term
is undefined at rest (docs/model.md, section 6). W_k is the local lateral velocity, which includes the slope and the
rate of bending at the surface. Tables over Mach number and angle of attack may be used in addition to the slopes or
instead of them (`incidence.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_SURFACES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import TableRef, find_interval, interpolate_into, look_up
from maxq.control.kernel.vectors import Vector, add, cross, scaled, vector_at
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.air.incidence import (
    ALWAYS,
    POWER_ON,
    IncidenceTables,
    IncidenceWork,
    rate_loads,
    static_loads,
    table_coefficients,
)
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.environment import CROSSFLOW_PART, AirData, PartWinds
from maxq.sim.vehicle.modes.planar import Modes, add_to_modes, modal_sum, of_plane
from maxq.sim.vehicle.modes.spatial import apply_spatial_load, outer_spatial_load, spatial_motion

# Columns of the Mach table. CD is the drag along the relative wind at any attitude. From FIRST_SURFACE on, each surface
# has CN_alpha and CN_alpha times its station. From `Aero.off_axis` on, the columns are CA of the boosters times y and z
# of their axes.
CA, CA_COAST, CD, CMQ, CNR, CLP, CROSSFLOW, CM0, FIRST_SURFACE = range(9)

FIXED, OVER_TIME, OVER_MASS = range(3)  # motion of the moment reference


@dataclass(frozen=True)
class Aero:
    on: int
    table: TableRef
    area_m2: float
    chord_m: float  # for pitch moment and damping
    yaw_chord_m: float
    span_m: float  # for roll moment and damping
    crossflow_station_m: float
    earth_rates: int  # 1: damping acts on rates relative to the Earth, 0: on inertial rates
    lag_m: float  # length of the lag behind the first modes
    local_incidence: int  # 1: bending changes the angle of attack of the surfaces
    penetration: int  # 1: each part has the wind at its own position
    force_factor: float  # of CN_alpha and cross-flow drag
    axial_factor: float  # of CA and CD
    damping_factor: float
    centre_shift_m: float  # shift of every surface aft
    airspeed_floor_mps: float  # below it, there is no aerodynamic force
    tables: IncidenceTables
    station_m: Annotated[Array, (MAX_SURFACES + 1,)]  # station of each surface and table for modes and wind
    place_y_m: Annotated[Array, (MAX_SURFACES + 1,)]  # position of each surface relative to the body axis
    place_z_m: Annotated[Array, (MAX_SURFACES + 1,)]
    off_axis: int  # column of the Mach table with axial forces off the body axis, or -1
    reference: TableRef  # station to which the moments of tables, and of the slopes of `remainder`, refer
    reference_moves: int  # FIXED, OVER_TIME, OVER_MASS
    remainder: int  # surface whose moment uses a moving reference, or -1


@dataclass
class SurfaceLoad:
    """The load of a lifting surface or table."""

    force_y_N: float
    force_z_N: float
    slope: float  # CN_alpha
    slope_station_m: float  # CN_alpha times its station


@dataclass
class AeroWork:
    """The memory of the aerodynamics in one evaluation of the derivative."""

    mach_row: Annotated[Array, (FIRST_SURFACE + 2 * (MAX_SURFACES + 2),)]  # columns of the Mach table
    surface: Annotated[tuple[SurfaceLoad, ...], (MAX_SURFACES + 1,)]
    wind_B_mps: PartWinds
    late: Annotated[Array, (4,)]  # see `lag.lag_first_modes`
    incidence: IncidenceWork


@kernel
def put_surface(kept: SurfaceLoad, force_y_N: float, force_z_N: float, slope: float, slope_station_m: float) -> None:
    kept.force_y_N, kept.force_z_N, kept.slope, kept.slope_station_m = force_y_N, force_z_N, slope, slope_station_m


@kernel
def air_acts(aero: Aero, air: AirData) -> bool:
    """Return True if aerodynamic forces act: in the atmosphere, at or above the airspeed floor."""
    acts: bool = aero.on == 1 and air.density_kgpm3 > 0.0 and air.airspeed_mps >= aero.airspeed_floor_mps
    return acts


@kernel
def moment_reference(aero: Aero, sizes: Counts, pool: Array, clock_s: float, properties: Array) -> None:
    """Write the station of the moment reference at this instant to the derived properties, if it is used."""
    if sizes.tables > 0 or aero.reference_moves != FIXED:
        x = properties[sch.TOTAL_MASS] if aero.reference_moves == OVER_MASS else clock_s
        properties[sch.schedule_width(sizes) + sch.MOMENT_REFERENCE] = look_up(pool, aero.reference, x, 0)


@kernel
def coefficients(aero: Aero, pool: Array, mach: float, mach_row: Array) -> None:
    """Interpolate the Mach table into `mach_row`."""
    k = find_interval(pool, aero.table, mach)
    interpolate_into(pool, aero.table, k, mach, mach_row, 0)


@kernel
def body_loads(
    aero: Aero, density: float, flow: Vector, rate: Vector, burning: int, cg: Vector, work: AeroWork
) -> tuple[Vector, Vector]:
    """Return the force and moment about the core CG in B of axial force, drag, cross-flow and rate damping."""
    (u, v, w), row = flow, work.mach_row
    half = 0.5 * density * aero.area_m2
    speed = math.sqrt(u * u + v * v + w * w)
    v_cross, w_cross = v, w
    if aero.penetration == 1:
        v_cross -= work.wind_B_mps[3 * CROSSFLOW_PART + 1]
        w_cross -= work.wind_B_mps[3 * CROSSFLOW_PART + 2]
    lateral = math.sqrt(v_cross * v_cross + w_cross * w_cross)
    axial = row[CA] if burning == 1 else row[CA_COAST]
    drag = half * aero.axial_factor * row[CD] * speed
    cross = half * aero.force_factor * row[CROSSFLOW] * lateral
    fx = -half * aero.axial_factor * axial * u * abs(u) - drag * u
    fy_cross, fz_cross = -cross * v_cross, -cross * w_cross
    arm = cg[0] - aero.crossflow_station_m
    damping = 0.5 * half * aero.damping_factor * speed
    mx = damping * aero.span_m * aero.span_m * row[CLP] * rate[0]
    my = damping * aero.chord_m * aero.chord_m * row[CMQ] * rate[1]
    mz = damping * aero.yaw_chord_m * aero.yaw_chord_m * row[CNR] * rate[2]
    my += half * speed * speed * aero.chord_m * row[CM0] - arm * fz_cross
    mz += arm * fy_cross
    # The aerodynamic axis is the body axis, which does not pass through an offset CG.
    mx += -cg[1] * fz_cross + cg[2] * fy_cross
    my += -cg[2] * fx
    mz += cg[1] * fx
    if aero.off_axis >= 0:
        push = -half * aero.axial_factor * u * abs(u)
        my += push * row[aero.off_axis + 1]
        mz -= push * row[aero.off_axis]
    return (fx, fy_cross - drag * v, fz_cross - drag * w), (mx, my, mz)


@kernel
def surface_loads(
    aero: Aero, sizes: Counts, density: float, flow: Vector, properties: Array, modes: Modes, work: AeroWork
) -> tuple[Vector, Vector]:
    """Return force and moment (about the core CG, B) of the lifting surfaces at their local angles of attack.

    The forces are also added to the generalised forces of the modes.
    """
    whole, row = 0.5 * density * aero.area_m2 * aero.force_factor, work.mach_row
    x_cg, y_cg, z_cg = properties[sch.CORE_CG], properties[sch.CORE_CG + 1], properties[sch.CORE_CG + 2]
    fy, fz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(sizes.surfaces - sizes.tables):
        cn = row[FIRST_SURFACE + 2 * s]
        cn_x = row[FIRST_SURFACE + 2 * s + 1] + cn * aero.centre_shift_m
        if s == aero.remainder:
            cn_x += cn * properties[sch.schedule_width(sizes) + sch.MOMENT_REFERENCE]
        in_pitch = sch.mode_column(sizes, sch.PITCH, sch.surface_row(sizes, s))
        in_yaw = sch.mode_column(sizes, sch.YAW, sch.surface_row(sizes, s))
        u_local, v_local, w_local = local_flow(aero, sizes, s, flow, properties, modes, work)
        half = whole * abs(u_local)
        force_y, force_z = -half * cn * v_local, -half * cn * w_local
        add_to_modes(sizes, properties, in_pitch, force_z, modes.planar.force_N, of_plane(sch.PITCH))
        add_to_modes(sizes, properties, in_yaw, force_y, modes.planar.force_N, of_plane(sch.YAW))
        if sizes.spatial_modes > 0:
            load = (0.0, force_y, force_z, 0.0, 0.0, 0.0)
            moved = outer_spatial_load(sizes, properties, sch.surface_place(sizes, s), load, modes.spatial)
            mx, my, mz = mx + moved[0], my + moved[1], mz + moved[2]
        fy += force_y
        fz += force_z
        put_surface(work.surface[s], force_y, force_z, cn, cn_x)
        mx += (aero.place_y_m[s] - y_cg) * force_z - (aero.place_z_m[s] - z_cg) * force_y
        my += half * w_local * (cn * x_cg - cn_x)
        mz -= half * v_local * (cn * x_cg - cn_x)
    return (0.0, fy, fz), (mx, my, mz)


@kernel
def local_flow(
    aero: Aero, sizes: Counts, s: int, flow: Vector, properties: Array, modes: Modes, work: AeroWork
) -> Vector:
    """Return the flow at surface or table `s` of the bent body, B, m/s."""
    u, v, w = flow
    if aero.penetration == 1:
        u, v, w = add(flow, scaled(-1.0, vector_at(work.wind_B_mps, 3 * s)))
    if aero.local_incidence == 1:
        in_pitch = sch.mode_column(sizes, sch.PITCH, sch.surface_row(sizes, s))
        in_yaw = sch.mode_column(sizes, sch.YAW, sch.surface_row(sizes, s))
        planar, slopes = modes.planar, sch.padded_modes(sizes)
        w += u * modal_sum(sizes, properties, in_pitch + slopes, planar.eta_m, of_plane(sch.PITCH))
        w += modal_sum(sizes, properties, in_pitch, planar.nu_mps, of_plane(sch.PITCH))
        v += u * modal_sum(sizes, properties, in_yaw + slopes, planar.eta_m, of_plane(sch.YAW))
        v += modal_sum(sizes, properties, in_yaw, planar.nu_mps, of_plane(sch.YAW))
        if sizes.air_lags > 0:
            late, phi, slope = work.late, properties[in_pitch], properties[in_pitch + slopes]
            w += u * (slope * late[0]) + phi * late[1]
            phi, slope = properties[in_yaw], properties[in_yaw + slopes]
            v += u * (slope * late[2]) + phi * late[3]
        if sizes.spatial_modes > 0:
            turned = spatial_motion(sizes, properties, sch.surface_place(sizes, s), modes.spatial.eta_m)
            moving = spatial_motion(sizes, properties, sch.surface_place(sizes, s), modes.spatial.nu_mps)
            v, w = v + (moving[1] - u * turned[5]), w + (moving[2] + u * turned[4])
    return u, v, w


@kernel
def table_loads(
    aero: Aero,
    sizes: Counts,
    pool: Array,
    density: float,
    mach: float,
    flow: Vector,
    rate: Vector,
    burning: int,
    properties: Array,
    modes: Modes,
    work: AeroWork,
) -> tuple[Vector, Vector]:
    """Return force and moment about the core CG in B of the tables over angle of attack.

    The loads are also added to the generalised forces of the modes.
    """
    lengths = (aero.span_m, aero.chord_m, aero.yaw_chord_m)
    reference_m = properties[sch.schedule_width(sizes) + sch.MOMENT_REFERENCE]
    cg = properties[sch.CORE_CG]
    arm = (cg - reference_m, -properties[sch.CORE_CG + 1], -properties[sch.CORE_CG + 2])
    total_force, total_moment = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for j in range(sizes.tables):
        power = aero.tables.power[j]
        kept = work.surface[sizes.surfaces - sizes.tables + j]
        kept.force_y_N, kept.force_z_N = 0.0, 0.0
        if power == ALWAYS or (power == POWER_ON) == (burning == 1):
            s = sizes.surfaces - sizes.tables + j
            local = local_flow(aero, sizes, s, flow, properties, modes, work)
            table_coefficients(aero.tables, pool, j, mach, local, work.incidence)
            half = 0.5 * density * aero.area_m2
            square = local[0] * local[0] + local[1] * local[1] + local[2] * local[2]
            axial, lateral, couple = static_loads(
                aero.tables, j, local, lengths, aero.axial_factor, aero.force_factor, work.incidence
            )
            axial, lateral, couple = (
                scaled(half * square, axial),
                scaled(half * square, lateral),
                scaled(half * square, couple),
            )
            if aero.tables.any_rates[j] == 1:
                damping = 0.5 * half * aero.damping_factor * math.sqrt(square)
                by_rate, couple_by_rate = rate_loads(rate, lengths, work.incidence)
                lateral = add(lateral, scaled(damping, by_rate))
                couple = add(couple, scaled(damping, couple_by_rate))
            moment = add(couple, add(cross(arm, axial), cross((arm[0] - aero.centre_shift_m, arm[1], arm[2]), lateral)))
            total_force = add(total_force, add(axial, lateral))
            total_moment = add(total_moment, moment)
            # The load on the modes is the force at the table's station, and the moment about that station.
            forward = aero.station_m[s] - reference_m - aero.centre_shift_m
            put_surface(kept, lateral[1], lateral[2], 1.0, aero.station_m[s])
            couple_y, couple_z = couple[1] - forward * lateral[2], couple[2] + forward * lateral[1]
            in_pitch = sch.mode_column(sizes, sch.PITCH, sch.surface_row(sizes, s))
            in_yaw = sch.mode_column(sizes, sch.YAW, sch.surface_row(sizes, s))
            slopes = sch.padded_modes(sizes)
            add_to_modes(sizes, properties, in_pitch, lateral[2], modes.planar.force_N, of_plane(sch.PITCH))
            add_to_modes(sizes, properties, in_pitch + slopes, couple_y, modes.planar.force_N, of_plane(sch.PITCH))
            add_to_modes(sizes, properties, in_yaw, lateral[1], modes.planar.force_N, of_plane(sch.YAW))
            add_to_modes(sizes, properties, in_yaw + slopes, -couple_z, modes.planar.force_N, of_plane(sch.YAW))
            if sizes.spatial_modes > 0:
                place, load = sch.surface_place(sizes, s), (0.0, lateral[1], lateral[2], couple[0], couple_y, couple_z)
                moved = outer_spatial_load(sizes, properties, place, load, modes.spatial)
                apply_spatial_load(sizes, properties, place, (axial[0], 0.0, 0.0, 0.0, 0.0, 0.0), modes.spatial.force_N)
                total_moment = add(total_moment, moved)
    return total_force, total_moment
