"""Sloshing propellant: one spherical pendulum per tank, at any angle, coupled through the tension of its rod.

The bob of mass m hangs on a massless rod of length L from a hinge on the bent body axis. Only the rod's tension and
the damping act between bob and body. Damping is viscous, on the velocity of the bob relative to the point of
the body that it passes, and reacts on the body at that same point: so it dissipates in any motion and conserves the
angular momentum (docs/model.md, section 5; with the reaction at the hinge instead, as eq. 27 of the paper has it, the
moment arm of the damper is lost).

For every tank a block of the workspace holds the quantities by which the coupled system is solved (`solve.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_TANKS
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG
from maxq.control.kernel.vectors import Vector, add, cross, dot, scaled, set_vector, vector_at
from maxq.sim.vehicle.bending import modal_sum, of_plane
from maxq.sim.vehicle.block import W_BI_B, Counts, Sizes, StateBlock
from maxq.sim.vehicle.schedule import (
    CORE_CG,
    MODE_FIRST,
    PITCH,
    TANK_HINGE,
    TANK_LENGTH,
    TANK_MASS,
    TANK_TRAVEL,
    YAW,
    mode_column,
    tank_column,
)
from maxq.sim.vehicle.workspace import ETA, NU, PENDULUM, PENDULUM_WIDTH, RATE, TENSIONS

# The unit vector u_B from the hinge to the bob, and kappa_B, its inertial derivative in body components.
PENDULUMS = StateBlock(
    {f"slosh_{{}}_u_{a}": "1" for a in "xyz"} | {f"slosh_{{}}_kappa_{a}_1ps": "1/s" for a in "xyz"}, "tanks"
)

# a tank's block of the workspace
ARM = 0  # moment of a unit tension about the CG with the engine deflected, B, m (3)
HINGE_ACCEL = 3  # acceleration of the hinge that does not depend on the accelerations sought, B, m/s2 (3)
SHIFT = 6  # displacement of the hinge by bending: y, z, m (2)
DEMAND = 8  # tension per bob mass at zero acceleration, m/s2
ALPHA = 9  # angular acceleration of the body per unit tension, rad/s2 per N (3)
HINGE = 12  # hinge relative to the core CG without bending, B, m (3)
DAMPING = 15  # acceleration of the bob by damping, B, m/s2 (3)
ASYMMETRY = 18  # see `_plane_asymmetry`: y, z, m (2)
DAMPER_FORCE = 20  # lateral force of the damper on the bent axis: y, z, N (2)
BENDING_ACCEL = 22  # acceleration of the hinge by bending: y, z, m/s2 (2)


@kernel
def tank_block(tank: int) -> int:
    """Where the workspace holds the block of a tank."""
    return PENDULUM + PENDULUM_WIDTH * tank


@dataclass(frozen=True)
class Slosh:
    planes_differ: int  # 1: pitch and yaw modes have other shapes, or one plane has none
    damping_ratio: Annotated[Array, (MAX_TANKS,)]  # of the pendulum under the present axial acceleration
    mass_factor: Annotated[Array, (MAX_TANKS,)]
    length_factor: Annotated[Array, (MAX_TANKS,)]


def pack_slosh(tanks: Sequence[Any], bending: Any) -> Slosh:
    """From the stage's sections `tank` that slosh, and `bending` (or None)."""
    zeta = np.zeros(MAX_TANKS)
    zeta[: len(tanks)] = [tank.damping_ratio for tank in tanks]
    planes_differ = bending is not None and bending.pitch != bending.yaw
    return Slosh(int(planes_differ), zeta, np.ones(MAX_TANKS), np.ones(MAX_TANKS))


@kernel
def pendulum_length(slosh: Slosh, properties: Array, tank: int) -> float:
    length: float = properties[tank_column(tank) + TANK_LENGTH] * slosh.length_factor[tank]
    return length


@kernel
def bob_mass(slosh: Slosh, properties: Array, tank: int) -> float:
    mass: float = properties[tank_column(tank) + TANK_MASS] * slosh.mass_factor[tank]
    return mass


@kernel
def pendulum_start(y: Array, first: int, rate: Vector) -> None:
    """Aft of its hinge, at rest relative to a body that turns at `rate` (B, rad/s)."""
    aft = (-1.0, 0.0, 0.0)
    set_vector(y, first, aft)
    set_vector(y, first + 3, cross(rate, aft))


@kernel
def restore_pendulum(y: Array, first: int) -> None:
    """Bring the unit vector back to length one and its derivative to right angles with it."""
    u = vector_at(y, first)
    scale = 1.0 / math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    u = (u[0] * scale, u[1] * scale, u[2] * scale)
    kappa = vector_at(y, first + 3)
    along = u[0] * kappa[0] + u[1] * kappa[1] + u[2] * kappa[2]
    set_vector(y, first, u)
    set_vector(y, first + 3, (kappa[0] - along * u[0], kappa[1] - along * u[1], kappa[2] - along * u[2]))


@kernel
def pendulum_loads(
    slosh: Slosh, sizes: Counts, tank: int, rate: Vector, axial_load: float, offset: Vector, properties: Array,
    y: Array, first: int, work: Array,
) -> tuple[Vector, Vector]:  # fmt: skip  # eleven lines otherwise
    """Fill a tank's block of the workspace; returns the force and moment (about the core CG) of its damper, B.

    The states of the pendulum lie at y[first:first+6]; `offset` leads from the core CG to the CG with the engine
    deflected.
    """
    p, q, r = rate
    b, column = tank_block(tank), tank_column(tank)
    u, kappa = vector_at(y, first), vector_at(y, first + 3)
    length = pendulum_length(slosh, properties, tank)
    hinge = (
        properties[CORE_CG] - properties[column + TANK_HINGE],
        -properties[CORE_CG + 1],
        -properties[CORE_CG + 2],
    )
    shift_y, shift_z, shift_rate_y, shift_rate_z, nu_y, nu_z = _bending_at_tank(sizes, tank, properties, work)
    # velocity of the hinge by bending, with the rotation of the bent axis (docs/model.md, eq. 5.3)
    bend = (q * shift_z - r * shift_y, nu_y, nu_z)
    asymmetry_y, asymmetry_z, asymmetry_rate_y, asymmetry_rate_z = 0.0, 0.0, 0.0, 0.0
    if slosh.planes_differ == 1:
        asymmetry_y, asymmetry_z, asymmetry_rate_y, asymmetry_rate_z = _plane_asymmetry(sizes, tank, properties, work)
        bend = (bend[0], bend[1] - p * asymmetry_z, bend[2] + p * asymmetry_y)
    accel = add(cross(rate, cross(rate, hinge)), cross(rate, bend))
    accel = (accel[0], accel[1] - p * asymmetry_rate_z, accel[2] + p * asymmetry_rate_y)
    # with the liquid's surface the bob travels aft, which gives it a Coriolis acceleration
    travel = 2.0 * properties[column + TANK_TRAVEL]
    accel = (accel[0] + q * shift_rate_z - r * shift_rate_y, accel[1] - travel * r, accel[2] + travel * q)
    arm = cross((hinge[0] - offset[0], hinge[1] - offset[1], hinge[2] - offset[2]), u)
    roll_arm = arm[0] + asymmetry_y * u[2] - asymmetry_z * u[1]
    set_vector(work, b + ARM, (roll_arm, arm[1] + shift_z * u[0], arm[2] - shift_y * u[0]))
    set_vector(work, b + HINGE_ACCEL, accel)
    set_vector(work, b + HINGE, hinge)
    work[b + SHIFT], work[b + SHIFT + 1] = shift_y, shift_z
    work[b + ASYMMETRY], work[b + ASYMMETRY + 1] = asymmetry_y, asymmetry_z
    work[b + DEMAND] = length * dot(kappa, kappa) - dot(accel, u)
    u_rate = add(kappa, scaled(-1.0, cross(rate, u)))  # d(u)/dt in B
    # 2 zeta omega L with omega = sqrt(a / L)
    damping = scaled(-2.0 * slosh.damping_ratio[tank] * math.sqrt(abs(axial_load) * length), u_rate)
    set_vector(work, b + DAMPING, damping)
    force = scaled(-bob_mass(slosh, properties, tank), damping)
    work[b + DAMPER_FORCE], work[b + DAMPER_FORCE + 1] = force[1], force[2]
    moment = cross(add(hinge, scaled(length, u)), force)
    roll = moment[0] + asymmetry_y * force[2] - asymmetry_z * force[1]
    return force, (roll, moment[1] + shift_z * force[0], moment[2] - shift_y * force[0])


@kernel
def _bending_at_tank(
    sizes: Counts, tank: int, properties: Array, work: Array
) -> tuple[float, float, float, float, float, float]:
    """Displacement of a hinge by bending, its rate in B, and its quasi-velocity: y, z each."""
    in_pitch, in_yaw = mode_column(sizes, PITCH, MODE_FIRST + tank), mode_column(sizes, YAW, MODE_FIRST + tank)
    return (
        modal_sum(sizes, properties, in_yaw, work, of_plane(ETA, YAW)),
        modal_sum(sizes, properties, in_pitch, work, of_plane(ETA, PITCH)),
        modal_sum(sizes, properties, in_yaw, work, of_plane(RATE, YAW)),
        modal_sum(sizes, properties, in_pitch, work, of_plane(RATE, PITCH)),
        modal_sum(sizes, properties, in_yaw, work, of_plane(NU, YAW)),
        modal_sum(sizes, properties, in_pitch, work, of_plane(NU, PITCH)),
    )


@kernel
def _plane_asymmetry(sizes: Counts, tank: int, properties: Array, work: Array) -> tuple[float, float, float, float]:
    """Displacement of the hinge less that with each plane's shapes in the other: y, z (m) and their rates in B.

    The quasi-velocities include the roll rate with the shapes of their own plane; where the planes differ, roll moves
    the hinge by this much more (docs/model.md, eq. 5.6).
    """
    in_pitch, in_yaw = mode_column(sizes, PITCH, MODE_FIRST + tank), mode_column(sizes, YAW, MODE_FIRST + tank)
    along_y, along_z, rate_y, rate_z = 0.0, 0.0, 0.0, 0.0
    for i in range(max(sizes.pitch_modes, sizes.yaw_modes)):
        p, q = of_plane(0, PITCH) + i, of_plane(0, YAW) + i
        more_in_yaw = properties[in_yaw + i] - properties[in_pitch + i]
        along_y += more_in_yaw * work[ETA + q]
        rate_y += more_in_yaw * work[RATE + q]
        along_z -= more_in_yaw * work[ETA + p]
        rate_z -= more_in_yaw * work[RATE + p]
    return along_y, along_z, rate_y, rate_z


@kernel
def pendulum_derivative(
    slosh: Slosh, tank: int, rate: Vector, specific_force: Vector, alpha: Vector, properties: Array, y: Array,
    first: int, dy: Array, work: Array,
) -> None:  # fmt: skip  # eleven lines otherwise
    """Derivative of the states at y[first:first+6] once the body's accelerations are known (solve.py).

    The pendulum of an empty tank rests: without mass it has no effect.
    """
    b = tank_block(tank)
    if bob_mass(slosh, properties, tank) <= 0.0:
        for j in range(6):
            dy[first + j] = 0.0
        return
    u, kappa = vector_at(y, first), vector_at(y, first + 3)
    shift_y, shift_z = work[b + SHIFT], work[b + SHIFT + 1]
    accel, damping = vector_at(work, b + HINGE_ACCEL), vector_at(work, b + DAMPING)
    tangential = cross(alpha, vector_at(work, b + HINGE))
    bend_y, bend_z = work[b + BENDING_ACCEL], work[b + BENDING_ACCEL + 1]
    asymmetry_y, asymmetry_z = work[b + ASYMMETRY], work[b + ASYMMETRY + 1]
    hinge = (
        accel[0] + specific_force[0] + tangential[0] + alpha[1] * shift_z - alpha[2] * shift_y,
        accel[1] + specific_force[1] + tangential[1] + bend_y - alpha[0] * asymmetry_z,
        accel[2] + specific_force[2] + tangential[2] + bend_z + alpha[0] * asymmetry_y,
    )
    per_length = 1.0 / pendulum_length(slosh, properties, tank)
    along = per_length * dot(hinge, u) - dot(kappa, kappa)
    spin_u, spin_kappa = cross(rate, u), cross(rate, kappa)
    for j in range(3):
        dy[first + j] = kappa[j] - spin_u[j]
        dy[first + 3 + j] = along * u[j] - spin_kappa[j] + per_length * (damping[j] - hinge[j])


class SloshRow(NamedTuple):
    """One slosh pendulum."""

    slosh_tank_pitch_deg: Annotated[float, "deg", "pendulum angle in the pitch plane"]
    slosh_tank_yaw_deg: Annotated[float, "deg", "pendulum angle in the yaw plane"]
    slosh_tank_pitch_rate_degps: Annotated[float, "deg/s", "rate of that angle in the pitch plane"]
    slosh_tank_yaw_rate_degps: Annotated[float, "deg/s", "rate of that angle in the yaw plane"]
    slosh_tank_tension_N: Annotated[float, "N", "tension of the pendulum rod"]


@kernel
def slosh_row(slosh: Slosh, sizes: Sizes, tank: int, properties: Array, y: Array, first: int, aux: Array) -> SloshRow:
    """Nan throughout for an empty tank and one that the stage does not have."""
    if tank >= sizes.tanks or bob_mass(slosh, properties, tank) <= 0.0:
        return SloshRow(math.nan, math.nan, math.nan, math.nan, math.nan)
    i = first
    u_x, u_y, u_z = -y[i], y[i + 1], y[i + 2]
    # d(u)/dt in B = kappa - w x u
    rate_x = -(y[i + 3] - (y[W_BI_B + 1] * u_z - y[W_BI_B + 2] * u_y))
    rate_y = y[i + 4] - (-y[W_BI_B + 2] * u_x - y[W_BI_B] * u_z)
    rate_z = y[i + 5] - (y[W_BI_B] * u_y + y[W_BI_B + 1] * u_x)
    return SloshRow(
        slosh_tank_pitch_deg=DEG * math.atan2(u_z, u_x),
        slosh_tank_yaw_deg=DEG * math.atan2(u_y, u_x),
        slosh_tank_pitch_rate_degps=DEG * ((u_x * rate_z - u_z * rate_x) / (u_x * u_x + u_z * u_z)),
        slosh_tank_yaw_rate_degps=DEG * ((u_x * rate_y - u_y * rate_x) / (u_x * u_x + u_y * u_y)),
        slosh_tank_tension_N=aux[TENSIONS + tank],
    )
