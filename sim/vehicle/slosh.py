"""Sloshing propellant: one spherical pendulum per tank, at any angle, coupled through the tension of its rod.

The bob of mass m hangs on a massless rod of length L from a hinge on the bent body axis. Only the rod's tension and
the damping act between bob and body. Damping is viscous, on the velocity of the bob relative to the body's point it
passes, and reacts on the body at that same point: so it dissipates whatever the motion, and leaves the angular
momentum alone (docs/model.md, section 5; with the reaction at the hinge instead, as eq. 27 of the paper has it, the
moment arm of the damper is lost).

For every tank a block of the workspace holds what the solution of the coupled system needs (`solve.py`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_TANKS
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Vector, add, cross, dot, scaled
from maxq.sim.vehicle.bending import modal_sum, of_plane
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
from maxq.sim.vehicle.state import Counts, pendulum_index
from maxq.sim.vehicle.workspace import ETA, NU, PENDULUM, PENDULUM_WIDTH, RATE

# a tank's block of the workspace
ARM = 0  # moment that a unit tension exerts about the CG with the engine deflected, in B, m (3)
HINGE_ACCEL = 3  # acceleration of the hinge that does not depend on the accelerations sought, B, m/s2 (3)
SHIFT_Y = 6  # displacement of the hinge by bending, m
SHIFT_Z = 7
DEMAND = 8  # tension per bob mass at zero acceleration, m/s2
ALPHA = 9  # answer of the body to a unit tension: its angular acceleration, rad/s2 per N (3)
HINGE = 12  # hinge relative to the core CG without bending, B, m (3)
DAMPING = 15  # acceleration of the bob by damping, B, m/s2 (3)
ASYMMETRY_Y = 18  # by how much the planes' unlikeness moves the hinge, m: see `_plane_asymmetry`
ASYMMETRY_Z = 19
DAMPER_FORCE_Y = 20  # lateral force of the damper on the bent axis, N
DAMPER_FORCE_Z = 21
BENDING_ACCEL_Y = 22  # acceleration of the hinge by bending, m/s2: without the pendulums, later with them
BENDING_ACCEL_Z = 23


@dataclass(frozen=True)
class Slosh:
    planes_differ: int  # 1: pitch and yaw modes have other shapes, or one plane has none
    damping_ratio: Annotated[Array, (MAX_TANKS,)]  # of the pendulum under the present axial acceleration
    mass_factor: Annotated[Array, (MAX_TANKS,)]
    length_factor: Annotated[Array, (MAX_TANKS,)]


@kernel
def pendulum_length(slosh: Slosh, properties: Array, tank: int) -> float:
    length: float = properties[tank_column(tank) + TANK_LENGTH] * slosh.length_factor[tank]
    return length


@kernel
def bob_mass(slosh: Slosh, properties: Array, tank: int) -> float:
    mass: float = properties[tank_column(tank) + TANK_MASS] * slosh.mass_factor[tank]
    return mass


@kernel
def pendulum_loads(
    slosh: Slosh,
    sizes: Counts,
    tank: int,
    rate: Vector,
    axial_load: float,
    offset: Vector,
    properties: Array,
    y: Array,
    work: Array,
) -> tuple[Vector, Vector]:
    """Prepare one pendulum: fill its block, and return the force and moment (about the core CG) of its damper.

    `offset` leads from the core CG to the CG with the engine deflected.
    """
    p, q, r = rate
    b = PENDULUM + PENDULUM_WIDTH * tank
    i = pendulum_index(sizes, tank)
    u = (y[i], y[i + 1], y[i + 2])
    kappa = (y[i + 3], y[i + 4], y[i + 5])
    length, mass = pendulum_length(slosh, properties, tank), bob_mass(slosh, properties, tank)
    hinge = (
        properties[CORE_CG] - properties[tank_column(tank) + TANK_HINGE],
        -properties[CORE_CG + 1],
        -properties[CORE_CG + 2],
    )
    move_y, move_z, moving_y, moving_z, nu_y, nu_z = _bend_at_tank(sizes, tank, properties, work)
    # velocity that bending gives the hinge, including the turning of the bent axis (docs/model.md, eq. 5.3)
    bend = (q * move_z - r * move_y, nu_y, nu_z)
    uneven_y, uneven_z, uneven_rate_y, uneven_rate_z = 0.0, 0.0, 0.0, 0.0
    if slosh.planes_differ == 1:
        uneven_y, uneven_z, uneven_rate_y, uneven_rate_z = _plane_asymmetry(sizes, tank, properties, work)
        bend = (bend[0], bend[1] - p * uneven_z, bend[2] + p * uneven_y)
    known = add(cross(rate, cross(rate, hinge)), cross(rate, bend))
    known = (known[0], known[1] - p * uneven_rate_z, known[2] + p * uneven_rate_y)
    # with the liquid's surface the bob travels aft, which gives it a Coriolis acceleration
    travel = 2.0 * properties[tank_column(tank) + TANK_TRAVEL]
    known = (known[0] + q * moving_z - r * moving_y, known[1] - travel * r, known[2] + travel * q)
    arm = cross((hinge[0] - offset[0], hinge[1] - offset[1], hinge[2] - offset[2]), u)
    work[b + ASYMMETRY_Y], work[b + ASYMMETRY_Z] = uneven_y, uneven_z
    roll_arm = arm[0] + uneven_y * u[2] - uneven_z * u[1]
    _store(work, b + ARM, (roll_arm, arm[1] + move_z * u[0], arm[2] - move_y * u[0]))
    _store(work, b + HINGE_ACCEL, known)
    _store(work, b + HINGE, hinge)
    work[b + SHIFT_Y], work[b + SHIFT_Z] = move_y, move_z
    work[b + DEMAND] = length * dot(kappa, kappa) - dot(known, u)
    swing = add(kappa, scaled(-1.0, cross(rate, u)))  # d(u)/dt in B
    # 2 zeta omega L with omega = sqrt(a / L)
    damping = scaled(-2.0 * slosh.damping_ratio[tank] * math.sqrt(abs(axial_load) * length), swing)
    _store(work, b + DAMPING, damping)
    force = scaled(-mass, damping)
    bob = add(hinge, scaled(length, u))
    moment = cross(bob, force)
    roll = moment[0] + uneven_y * force[2] - uneven_z * force[1]
    moment = (roll, moment[1] + move_z * force[0], moment[2] - move_y * force[0])
    work[b + DAMPER_FORCE_Y], work[b + DAMPER_FORCE_Z] = force[1], force[2]
    return force, moment


@kernel
def _store(work: Array, i: int, a: Vector) -> None:
    work[i], work[i + 1], work[i + 2] = a[0], a[1], a[2]


@kernel
def _bend_at_tank(
    sizes: Counts, tank: int, properties: Array, work: Array
) -> tuple[float, float, float, float, float, float]:
    """Displacement, its rate in B, and quasi-velocity of a hinge by bending: y, z each."""
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
    """Where the hinge is, less where it would be if each plane had the other's shapes: y, z and their rates in B.

    The quasi-velocities hold the roll rate with the shape of their own plane; where the planes differ, roll moves the
    hinge by this much more (docs/model.md, eq. 5.6).
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
    slosh: Slosh, sizes: Counts, tank: int, rate: Vector, specific_force: Vector, alpha: Vector, properties: Array,
    y: Array, dy: Array, work: Array,
) -> None:  # fmt: skip
    """Derivative of a pendulum's states once the body's accelerations are known (solve.py).

    An empty tank's pendulum rests: it weighs nothing, so nothing feels it.
    """
    b = PENDULUM + PENDULUM_WIDTH * tank
    i = pendulum_index(sizes, tank)
    if bob_mass(slosh, properties, tank) <= 0.0:
        for j in range(6):
            dy[i + j] = 0.0
        return
    u = (y[i], y[i + 1], y[i + 2])
    kappa = (y[i + 3], y[i + 4], y[i + 5])
    length = pendulum_length(slosh, properties, tank)
    move_y, move_z = work[b + SHIFT_Y], work[b + SHIFT_Z]
    turning = cross(alpha, (work[b + HINGE], work[b + HINGE + 1], work[b + HINGE + 2]))
    hinge = (
        work[b + HINGE_ACCEL] + specific_force[0] + turning[0] + alpha[1] * move_z - alpha[2] * move_y,
        work[b + HINGE_ACCEL + 1]
        + specific_force[1]
        + turning[1]
        + work[b + BENDING_ACCEL_Y]
        - alpha[0] * work[b + ASYMMETRY_Z],
        work[b + HINGE_ACCEL + 2]
        + specific_force[2]
        + turning[2]
        + work[b + BENDING_ACCEL_Z]
        + alpha[0] * work[b + ASYMMETRY_Y],
    )
    per_length = 1.0 / length
    along = per_length * dot(hinge, u) - dot(kappa, kappa)
    spin_u, spin_kappa = cross(rate, u), cross(rate, kappa)
    for j in range(3):
        dy[i + j] = kappa[j] - spin_u[j]
        dy[i + 3 + j] = along * u[j] - spin_kappa[j] + per_length * (work[b + DAMPING + j] - hinge[j])
