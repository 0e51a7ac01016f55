"""Aerodynamic forces and moments over the full circle of incidence.

With the velocity relative to the air (U, V, W) in B and rho S / 2 in front, the normal force of a lifting surface is
-CN_alpha |U| W_k, the cross-flow drag -C_c |(V, W)| W, the axial force -CA U |U|: for small incidence these are
q S CN_alpha alpha and q S CA, at 90 degrees only the cross-flow is left, and nothing is undefined at rest
(docs/model.md, section 6). W_k is the local cross flow: bending turns the surface (slope) and moves it (rate).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import TableRef, find_interval, interpolate_into
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle.bending import add_to_modes, modal_sum, of_plane
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.schedule import CORE_CG, PITCH, YAW, mode_column, padded_modes, surface_row
from maxq.sim.vehicle.workspace import ETA, FORCE, MACH_ROW, NU

# Columns of the Mach table; CD is the drag along the relative wind, whatever the attitude. From FIRST_SURFACE on, per
# surface, CN_alpha and CN_alpha times its station.
CA, CA_COAST, CD, CMQ, CNR, CLP, CROSSFLOW, CM0, FIRST_SURFACE = range(9)


@dataclass(frozen=True)
class Aero:
    on: int
    table: TableRef
    area_m2: float
    chord_m: float  # pitch moment and damping
    yaw_chord_m: float
    span_m: float  # roll moment and damping
    crossflow_station_m: float
    earth_rates: int  # 1: damping acts on rates relative to the Earth, 0: on inertial ones
    local_incidence: int  # 1: bending changes the incidence of the surfaces
    force_factor: float  # on CN_alpha and cross-flow
    axial_factor: float  # on CA and CD
    damping_factor: float
    centre_shift_m: float  # moves every surface aft


@kernel
def coefficients(aero: Aero, pool: Array, mach: float, work: Array) -> None:
    """Interpolate the Mach table into the workspace."""
    k = find_interval(pool, aero.table, mach)
    interpolate_into(pool, aero.table, k, mach, work, MACH_ROW)


@kernel
def body_loads(
    aero: Aero, density: float, flow: Vector, rate: Vector, burning: int, cg: Vector, work: Array
) -> tuple[Vector, Vector]:
    """Axial force, drag, cross-flow and rate damping: force and moment about the core CG in B."""
    u, v, w = flow
    half = 0.5 * density * aero.area_m2
    speed = math.sqrt(u * u + v * v + w * w)
    lateral = math.sqrt(v * v + w * w)
    axial = work[MACH_ROW + CA] if burning == 1 else work[MACH_ROW + CA_COAST]
    drag = half * aero.axial_factor * work[MACH_ROW + CD] * speed
    cross = half * aero.force_factor * work[MACH_ROW + CROSSFLOW] * lateral
    fx = -half * aero.axial_factor * axial * u * abs(u) - drag * u
    fy_cross, fz_cross = -cross * v, -cross * w
    arm = cg[0] - aero.crossflow_station_m
    damping = 0.5 * half * aero.damping_factor * speed
    mx = damping * aero.span_m * aero.span_m * work[MACH_ROW + CLP] * rate[0]
    my = damping * aero.chord_m * aero.chord_m * work[MACH_ROW + CMQ] * rate[1]
    mz = damping * aero.yaw_chord_m * aero.yaw_chord_m * work[MACH_ROW + CNR] * rate[2]
    my += half * speed * speed * aero.chord_m * work[MACH_ROW + CM0] - arm * fz_cross
    mz += arm * fy_cross
    # the aerodynamic axis is the body axis, which misses a CG that lies beside it
    mx += -cg[1] * fz_cross + cg[2] * fy_cross
    my += -cg[2] * fx
    mz += cg[1] * fx
    return (fx, fy_cross - drag * v, fz_cross - drag * w), (mx, my, mz)


@kernel
def surface_loads(
    aero: Aero, sizes: Counts, density: float, flow: Vector, properties: Array, work: Array
) -> tuple[Vector, Vector]:
    """Normal force of the lifting surfaces with their local incidence; adds to the modes' generalised forces."""
    u, v, w = flow
    half = 0.5 * density * aero.area_m2 * aero.force_factor * abs(u)
    x_cg, y_cg, z_cg = properties[CORE_CG], properties[CORE_CG + 1], properties[CORE_CG + 2]
    fy, fz, mx, my, mz = 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(sizes.surfaces):
        cn = work[MACH_ROW + FIRST_SURFACE + 2 * s]
        cn_x = work[MACH_ROW + FIRST_SURFACE + 2 * s + 1] + cn * aero.centre_shift_m
        in_pitch = mode_column(sizes, PITCH, surface_row(sizes, s))
        in_yaw = mode_column(sizes, YAW, surface_row(sizes, s))
        w_local, v_local = w, v
        if aero.local_incidence == 1:
            w_local += u * modal_sum(sizes, properties, in_pitch + padded_modes(sizes), work, of_plane(ETA, PITCH))
            w_local += modal_sum(sizes, properties, in_pitch, work, of_plane(NU, PITCH))
            v_local += u * modal_sum(sizes, properties, in_yaw + padded_modes(sizes), work, of_plane(ETA, YAW))
            v_local += modal_sum(sizes, properties, in_yaw, work, of_plane(NU, YAW))
        force_y, force_z = -half * cn * v_local, -half * cn * w_local
        add_to_modes(sizes, properties, in_pitch, force_z, work, of_plane(FORCE, PITCH))
        add_to_modes(sizes, properties, in_yaw, force_y, work, of_plane(FORCE, YAW))
        fy += force_y
        fz += force_z
        mx += -y_cg * force_z + z_cg * force_y
        my += half * w_local * (cn * x_cg - cn_x)
        mz -= half * v_local * (cn * x_cg - cn_x)
    return (0.0, fy, fz), (mx, my, mz)
