"""Aerodynamic forces and moments by coefficients over Mach number and angle of attack.

The coefficients belong to the whole vehicle or to its parts. Those of a table refer to body axes (CX, CY, CZ and Cl,
Cm, Cn about x, y, z) or to aeroballistic axes. The latter are x, z' in the plane of total angle of attack, on the side
to which the vehicle moves through the air, and y' perpendicular to the plane. Lift and drag (-CZ and -CX) are rotated
by the angle of attack in that plane. The loads of all tables are summed, each with the flow at its own station.
Derivatives with respect to the body rates are in body axes (docs/model.md, section 6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.grids import N_COLUMNS, GridRefs, interpolate_grid
from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.limits import MAX_SURFACES
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.vectors import Vector

NO_AXIS, MACH_AXIS, TOTAL, ROLL, ALPHA, BETA = range(6)  # variables of a grid
BODY_AXES, AEROBALLISTIC = 0, 1
ALWAYS, POWER_ON, POWER_OFF = range(3)
# Roles of the columns of a table: forces and moments first, then derivatives with respect to p span / 2V, q chord / 2V
# and r yaw chord / 2V.
ROLES = ("CX", "CY", "CZ", "Cl", "Cm", "Cn", "Clp", "Clr", "Cmq", "Cnr", "Cnp", "CYp", "CYr", "CNq")
CX, CY, CZ, CL, CM, CN, CLP, CLR, CMQ, CNR, CNP, CYP, CYR, CNQ = range(len(ROLES))
N_ROLES = len(ROLES)


@dataclass(frozen=True)
class IncidenceTables:
    """The tables over the angle of attack; `Sizes.tables` is their number."""

    grid: GridRefs
    axis: Annotated[IntArray, (MAX_SURFACES, 3)]  # NO_AXIS ... BETA
    role: Annotated[IntArray, (MAX_SURFACES, N_ROLES)]  # role of each column
    axes: Annotated[IntArray, (MAX_SURFACES,)]  # BODY_AXES, AEROBALLISTIC
    along_wind: Annotated[IntArray, (MAX_SURFACES,)]  # 1: CX and CZ are minus drag and minus lift
    power: Annotated[IntArray, (MAX_SURFACES,)]
    first_roll_rad: Annotated[Array, (MAX_SURFACES,)]  # start of the range of the roll angle
    any_rates: Annotated[IntArray, (MAX_SURFACES,)]  # 1: the table has derivatives with respect to the body rates


@dataclass
class IncidenceWork:
    """The coefficients of a table in one evaluation of the derivative."""

    grid_row: Annotated[Array, (N_ROLES,)]  # in the order of the columns
    coefficient: Annotated[Array, (N_ROLES,)]  # in the order of the roles


@kernel
def _angle(kind: int, mach: float, flow: Vector, lateral: float, first_roll: float) -> float:
    """Return a variable of a grid, Mach number or angle in rad; `lateral` is the speed perpendicular to the axis."""
    u, v, w = flow
    if kind == MACH_AXIS:
        return mach
    if kind == TOTAL:
        return math.atan2(lateral, u)
    if kind == ALPHA:
        return math.atan2(w, u)
    if kind == BETA:
        return math.atan2(v, math.sqrt(u * u + w * w))
    if kind == ROLL:
        angle = math.atan2(v, w)
        return angle - 2.0 * math.pi * math.floor((angle - first_roll) / (2.0 * math.pi))
    return 0.0


@routine
def table_coefficients(
    tables: IncidenceTables, pool: Array, j: int, mach: float, flow: Vector, work: IncidenceWork
) -> None:
    """Write the coefficients of table `j` in the local flow (B, m/s) to `work`, with zeros for missing coefficients."""
    lateral = math.sqrt(flow[1] * flow[1] + flow[2] * flow[2])
    first_roll = float(tables.first_roll_rad[j])
    interpolate_grid(
        pool,
        tables.grid,
        j,
        _angle(tables.axis[j, 0], mach, flow, lateral, first_roll),
        _angle(tables.axis[j, 1], mach, flow, lateral, first_roll),
        _angle(tables.axis[j, 2], mach, flow, lateral, first_roll),
        work.grid_row,
        0,
    )
    for role in range(N_ROLES):
        work.coefficient[role] = 0.0
    for c in range(tables.grid.at[j, N_COLUMNS]):
        work.coefficient[tables.role[j, c]] = work.grid_row[c]


@routine
def static_loads(
    tables: IncidenceTables,
    j: int,
    flow: Vector,
    lengths: Vector,
    axial_factor: float,
    force_factor: float,
    work: IncidenceWork,
) -> tuple[Vector, Vector, Vector]:
    """Return axial force, lateral force (B) and moment (B, m) per dynamic pressure and area, from `work`.

    `lengths`: reference lengths of roll, pitch and yaw moment, m. In wind axes, the axial force includes the axial
    components of drag and lift.
    """
    (u, v, w), c = flow, work.coefficient
    lateral, across_y, across_z = 0.0, 0.0, 1.0  # unit vector of z'
    if tables.axes[j] == AEROBALLISTIC:
        lateral = math.sqrt(v * v + w * w)
        across_z = 0.0  # along the axis, all terms that depend on the plane are zero
        if lateral > 0.0:
            across_y, across_z = v / lateral, w / lateral
    x = axial_factor * c[CX]
    y, z = force_factor * c[CY], force_factor * c[CZ]
    if tables.along_wind[j] == 1:
        in_plane = lateral if tables.axes[j] == AEROBALLISTIC else w
        speed = math.sqrt(u * u + in_plane * in_plane)
        if speed > 0.0:
            cosine, sine = u / speed, in_plane / speed
            x, z = cosine * x - sine * z, sine * x + cosine * z
    yaw_length = lengths[1] if tables.axes[j] == AEROBALLISTIC else lengths[2]
    roll = lengths[0] * c[CL]
    pitch, yaw = lengths[1] * c[CM], yaw_length * c[CN]
    moment = (
        force_factor * roll,
        force_factor * (pitch * across_z + yaw * across_y),
        force_factor * (yaw * across_z - pitch * across_y),
    )
    return (x, 0.0, 0.0), (0.0, y * across_z + z * across_y, z * across_z - y * across_y), moment


@routine
def rate_loads(rate: Vector, lengths: Vector, work: IncidenceWork) -> tuple[Vector, Vector]:
    """Return the lateral force (B, m2/s) and the moment (B, m3/s) due to the body rates, from `work`.

    The loads are these results times air density, speed and reference area, divided by four.
    """
    p, q, r = lengths[0] * rate[0], lengths[1] * rate[1], lengths[2] * rate[2]
    c = work.coefficient
    return (
        (0.0, c[CYP] * p + c[CYR] * r, -c[CNQ] * q),
        (lengths[0] * (c[CLP] * p + c[CLR] * r), lengths[1] * c[CMQ] * q, lengths[2] * (c[CNR] * r + c[CNP] * p)),
    )
