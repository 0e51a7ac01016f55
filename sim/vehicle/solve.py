"""Accelerations of the coupled system: rigid body with a deflected engine, modes, and the tensions of the pendulums.

Without its pendulums the vehicle's mass matrix is block-diagonal: six rigid coordinates (whose CG the deflected engine
displaces a little) and the modes, each alone. Every pendulum couples them through one number, the tension of its rod.
Eliminating the accelerations leaves one small linear system for the tensions (docs/model.md, section 7): exact, and no
larger than the number of tanks.
"""

from __future__ import annotations

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_TANKS
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import (
    Symmetric,
    Vector,
    add,
    cross,
    dot,
    scaled,
    set_vector,
    symmetric_times,
    vector_at,
)
from maxq.sim.vehicle.bending import add_to_modes, free_modal_accelerations, modal_sum, of_plane
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.schedule import (
    INVERSE_CORE_MASS,
    MODE_FIRST,
    MODE_TANK_COMPLIANCE,
    PITCH,
    YAW,
    compliance_column,
    derived_column,
    mode_column,
    schedule_width,
)
from maxq.sim.vehicle.slosh import (
    ALPHA,
    ARM,
    BENDING_ACCEL,
    DAMPER_FORCE,
    DEMAND,
    Slosh,
    bob_mass,
    tank_block,
)
from maxq.sim.vehicle.workspace import ACCEL, FORCE, GRAM, TENSION

N_PENDULUM = 6  # states of a pendulum


@kernel
def accelerate(
    slosh: Slosh, sizes: Counts, on_pad: int, offset: Vector, inverse: Symmetric, force: Vector, moment: Vector,
    pad_accel: Vector, properties: Array, y: Array, first: int, work: Array,
) -> tuple[Vector, Vector]:  # fmt: skip  # thirteen lines otherwise
    """Specific force at the core CG and angular acceleration, in B; modal accelerations and tensions (N) in `work`.

    `force` and `moment` (about the core CG) are those without the rods' tensions; `offset` leads from the core CG to
    the CG with the engine deflected, `inverse` is the inverse inertia about the latter. The pendulums' states begin at
    y[first]. On the pad the body has the accelerations of the pad, and only modes and bobs respond.
    """
    inverse_mass = properties[schedule_width(sizes) + INVERSE_CORE_MASS]
    accel = scaled(inverse_mass, force)  # of the CG with the engine deflected, without tensions
    if on_pad == 1:
        inverse_mass, accel, inverse = 0.0, pad_accel, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    alpha = symmetric_times(inverse, add(moment, scaled(-1.0, cross(offset, force))))
    for k in range(sizes.tanks):
        b = tank_block(k)
        _add_damper_to_modes(sizes, k, work[b + DAMPER_FORCE], work[b + DAMPER_FORCE + 1], properties, work)
        set_vector(work, b + ALPHA, symmetric_times(inverse, vector_at(work, b + ARM)))
    free_modal_accelerations(sizes, properties, work)
    _solve_tensions(slosh, sizes, inverse_mass, accel, alpha, properties, y, first, work)
    for k in range(sizes.tanks):
        u, tension = vector_at(y, first + N_PENDULUM * k), work[TENSION + k]
        accel = add(accel, scaled(inverse_mass * tension, u))
        alpha = add(alpha, scaled(tension, vector_at(work, tank_block(k) + ALPHA)))
        _add_tension_to_modes(sizes, k, tension * u[1], tension * u[2], properties, work)
    return add(accel, cross(offset, alpha)), alpha


@kernel
def _add_damper_to_modes(
    sizes: Counts, k: int, force_y: float, force_z: float, properties: Array, work: Array
) -> None:  # fmt: skip  # as ruff would, but for a line of one bracket
    """Add the force of the damper of tank k to the generalised forces."""
    in_pitch, in_yaw = mode_column(sizes, PITCH, MODE_FIRST + k), mode_column(sizes, YAW, MODE_FIRST + k)
    add_to_modes(sizes, properties, in_pitch, force_z, work, of_plane(FORCE, PITCH))
    add_to_modes(sizes, properties, in_yaw, force_y, work, of_plane(FORCE, YAW))


@kernel
def _add_tension_to_modes(
    sizes: Counts, k: int, force_y: float, force_z: float, properties: Array, work: Array
) -> None:  # fmt: skip  # as ruff would, but for a line of one bracket
    """Add the lateral force of the rod of tank k to the modal accelerations."""
    in_pitch = derived_column(sizes, PITCH, MODE_TANK_COMPLIANCE + k)
    in_yaw = derived_column(sizes, YAW, MODE_TANK_COMPLIANCE + k)
    add_to_modes(sizes, properties, in_pitch, force_z, work, of_plane(ACCEL, PITCH))
    add_to_modes(sizes, properties, in_yaw, force_y, work, of_plane(ACCEL, YAW))


@kernel
def _gram(row: int, column: int) -> int:
    """Where the workspace holds an entry of the matrix of the tensions."""
    return GRAM + row * MAX_TANKS + column


@kernel
def _solve_tensions(
    slosh: Slosh, sizes: Counts, inverse_mass: float, accel: Vector, alpha: Vector, properties: Array, y: Array,
    first: int, work: Array,
) -> None:  # fmt: skip  # ten lines otherwise
    """Solve  (1/m_k) T_k + sum_l G_kl T_l = demand_k - (hinge acceleration along the rod without tensions).

    G is symmetric: how much the hinge of k accelerates along its rod per newton of tension in l. With arms about the CG
    of the deflected vehicle the rigid part of it is u_k.u_l / m + arm_k.(J^-1 arm_l). Both sides are multiplied by m_k.
    """
    n = sizes.tanks
    in_pitch, in_yaw = compliance_column(sizes, PITCH), compliance_column(sizes, YAW)
    for k in range(n):
        b, u, mass = tank_block(k), vector_at(y, first + N_PENDULUM * k), bob_mass(slosh, properties, k)
        arm = vector_at(work, b + ARM)
        bend_z = modal_sum(sizes, properties, mode_column(sizes, PITCH, MODE_FIRST + k), work, of_plane(ACCEL, PITCH))
        bend_y = modal_sum(sizes, properties, mode_column(sizes, YAW, MODE_FIRST + k), work, of_plane(ACCEL, YAW))
        work[b + BENDING_ACCEL], work[b + BENDING_ACCEL + 1] = bend_y, bend_z
        along = dot(u, accel) + dot(arm, alpha) + u[1] * bend_y + u[2] * bend_z
        work[TENSION + k] = mass * (work[b + DEMAND] - along)
        for j in range(k + 1):
            u_j = vector_at(y, first + N_PENDULUM * j)
            g = inverse_mass * dot(u, u_j)
            g += dot(arm, vector_at(work, tank_block(j) + ALPHA))
            g += properties[in_pitch + k * n + j] * u[2] * u_j[2] + properties[in_yaw + k * n + j] * u[1] * u_j[1]
            work[_gram(j, k)] = bob_mass(slosh, properties, j) * g
            work[_gram(k, j)] = mass * g
        work[_gram(k, k)] += 1.0
    _eliminate(n, work)
    for k in range(n):  # the tensions accelerate the hinges, too
        u, tension = vector_at(y, first + N_PENDULUM * k), work[TENSION + k]
        for j in range(n):
            b = tank_block(j)
            work[b + BENDING_ACCEL] += properties[in_yaw + k * n + j] * (tension * u[1])
            work[b + BENDING_ACCEL + 1] += properties[in_pitch + k * n + j] * (tension * u[2])


@kernel
def _eliminate(n: int, work: Array) -> None:
    """Solve GRAM T = TENSION in place, right-hand side in, tensions out.

    The symmetric form of the matrix is positive definite, so that no pivoting is needed.
    """
    if n == 2:
        a, b, c, d = work[_gram(0, 0)], work[_gram(0, 1)], work[_gram(1, 0)], work[_gram(1, 1)]
        e, f = work[TENSION], work[TENSION + 1]
        scale = 1.0 / (a * d - b * c)
        work[TENSION], work[TENSION + 1] = scale * (d * e - b * f), scale * (a * f - c * e)
        return
    for k in range(n):
        pivot = 1.0 / work[_gram(k, k)]
        for row in range(k + 1, n):
            factor = work[_gram(row, k)] * pivot
            for j in range(k + 1, n):
                work[_gram(row, j)] -= factor * work[_gram(k, j)]
            work[TENSION + row] -= factor * work[TENSION + k]
    for back in range(n):
        k = n - 1 - back
        total = work[TENSION + k]
        for j in range(k + 1, n):
            total -= work[_gram(k, j)] * work[TENSION + j]
        work[TENSION + k] = total / work[_gram(k, k)]
