"""Accelerations of the coupled system: rigid body with a deflected engine, modes, and the tensions that join the bobs.

Without its pendulums the vehicle's mass matrix is block-diagonal: six rigid coordinates (whose CG the deflected
engine moves a little) and the modes, each alone. Every pendulum couples them through one number, the tension of its
rod. Eliminating the accelerations leaves one small linear system for the tensions (docs/model.md, section 7):
exact, and no larger than the number of tanks.
"""

from __future__ import annotations

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_TANKS
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Symmetric, Vector, add, cross, dot, scaled, symmetric_times
from maxq.sim.vehicle.bending import add_to_modes, modal_sum, of_plane, scale_modes
from maxq.sim.vehicle.schedule import (
    INVERSE_CORE_MASS,
    MODE_FIRST,
    MODE_INVERSE_MASS,
    MODE_TANK_COMPLIANCE,
    PITCH,
    YAW,
    compliance_column,
    following_column,
    mode_column,
    schedule_width,
)
from maxq.sim.vehicle.slosh import (
    ALPHA,
    ARM,
    BENDING_ACCEL_Y,
    BENDING_ACCEL_Z,
    DAMPER_FORCE_Y,
    DAMPER_FORCE_Z,
    DEMAND,
    Slosh,
    bob_mass,
)
from maxq.sim.vehicle.state import Counts, pendulum_index
from maxq.sim.vehicle.workspace import FORCE, GRAM, PENDULUM, PENDULUM_WIDTH, TENSION


@kernel
def accelerate(
    slosh: Slosh, sizes: Counts, held: int, offset: Vector, inverse: Symmetric, force: Vector, moment: Vector,
    held_accel: Vector, properties: Array, y: Array, work: Array,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Specific acceleration of the core CG and angular acceleration, in B.

    `force` and `moment` (about the core CG) are those without the rods' tensions; `offset` leads from the core CG to
    the CG with the engine deflected, `inverse` is the inverse inertia about the latter. On return the workspace's
    modal forces hold the modal accelerations, and TENSION the rods' tensions (N).
    On the pad (`held`) the body's accelerations are those of the pad and only modes and bobs answer.
    """
    inverse_mass = properties[schedule_width(sizes) + INVERSE_CORE_MASS]
    accel = scaled(inverse_mass, force)  # of the CG with the engine deflected, without tensions
    if held == 1:
        inverse_mass, accel, inverse = 0.0, held_accel, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    alpha = symmetric_times(inverse, add(moment, scaled(-1.0, cross(offset, force))))
    for k in range(sizes.tanks):
        b = PENDULUM + PENDULUM_WIDTH * k
        _apply_damper_to_modes(sizes, k, properties, work)
        turned = symmetric_times(inverse, (work[b + ARM], work[b + ARM + 1], work[b + ARM + 2]))
        work[b + ALPHA], work[b + ALPHA + 1], work[b + ALPHA + 2] = turned[0], turned[1], turned[2]
    for plane in (PITCH, YAW):
        scale_modes(sizes, properties, following_column(sizes, plane, MODE_INVERSE_MASS), work, of_plane(FORCE, plane))
    _tensions(slosh, sizes, inverse_mass, accel, alpha, properties, y, work)
    for k in range(sizes.tanks):
        b, i = PENDULUM + PENDULUM_WIDTH * k, pendulum_index(sizes, k)
        tension = work[TENSION + k]
        accel = add(accel, scaled(inverse_mass * tension, (y[i], y[i + 1], y[i + 2])))
        alpha = add(alpha, scaled(tension, (work[b + ALPHA], work[b + ALPHA + 1], work[b + ALPHA + 2])))
        _apply_tension_to_modes(sizes, k, tension * y[i + 1], tension * y[i + 2], properties, work)
    return add(accel, cross(offset, alpha)), alpha


@kernel
def _apply_damper_to_modes(sizes: Counts, k: int, properties: Array, work: Array) -> None:
    """Let the damper of tank k act on the modes."""
    b = PENDULUM + PENDULUM_WIDTH * k
    in_pitch, in_yaw = mode_column(sizes, PITCH, MODE_FIRST + k), mode_column(sizes, YAW, MODE_FIRST + k)
    add_to_modes(sizes, properties, in_pitch, work[b + DAMPER_FORCE_Z], work, of_plane(FORCE, PITCH))
    add_to_modes(sizes, properties, in_yaw, work[b + DAMPER_FORCE_Y], work, of_plane(FORCE, YAW))


@kernel
def _tensions(
    slosh: Slosh,
    sizes: Counts,
    inverse_mass: float,
    accel: Vector,
    alpha: Vector,
    properties: Array,
    y: Array,
    work: Array,
) -> None:
    """Solve  (1/m_k) T_k + sum_l G_kl T_l = demand_k - (hinge acceleration along the rod without tensions).

    G is symmetric: how much the hinge of k moves along its rod per newton of tension in l. With arms about the CG of
    the deflected vehicle the rigid part of it is u_k.u_l / m + arm_k.(J^-1 arm_l).
    """
    n = sizes.tanks
    in_pitch, in_yaw = compliance_column(sizes, PITCH), compliance_column(sizes, YAW)
    for k in range(n):
        i, b = pendulum_index(sizes, k), PENDULUM + PENDULUM_WIDTH * k
        u = (y[i], y[i + 1], y[i + 2])
        arm = (work[b + ARM], work[b + ARM + 1], work[b + ARM + 2])
        mass = bob_mass(slosh, properties, k)
        bend_z = modal_sum(sizes, properties, mode_column(sizes, PITCH, MODE_FIRST + k), work, of_plane(FORCE, PITCH))
        bend_y = modal_sum(sizes, properties, mode_column(sizes, YAW, MODE_FIRST + k), work, of_plane(FORCE, YAW))
        work[b + BENDING_ACCEL_Y], work[b + BENDING_ACCEL_Z] = bend_y, bend_z
        along = dot(u, accel) + dot(arm, alpha) + u[1] * bend_y + u[2] * bend_z
        work[TENSION + k] = mass * (work[b + DEMAND] - along)
        for j in range(k + 1):
            i_j, b_j = pendulum_index(sizes, j), PENDULUM + PENDULUM_WIDTH * j
            g = inverse_mass * dot(u, (y[i_j], y[i_j + 1], y[i_j + 2]))
            g += dot(arm, (work[b_j + ALPHA], work[b_j + ALPHA + 1], work[b_j + ALPHA + 2]))
            g += (
                properties[in_pitch + k * n + j] * u[2] * y[i_j + 2]
                + properties[in_yaw + k * n + j] * u[1] * y[i_j + 1]
            )
            work[GRAM + j * MAX_TANKS + k] = bob_mass(slosh, properties, j) * g
            work[GRAM + k * MAX_TANKS + j] = mass * g
        work[GRAM + k * MAX_TANKS + k] += 1.0
    _eliminate(n, work)
    for k in range(n):
        i = pendulum_index(sizes, k)
        pull_y, pull_z = work[TENSION + k] * y[i + 1], work[TENSION + k] * y[i + 2]
        for j in range(n):
            b_j = PENDULUM + PENDULUM_WIDTH * j
            work[b_j + BENDING_ACCEL_Y] += properties[in_yaw + k * n + j] * pull_y
            work[b_j + BENDING_ACCEL_Z] += properties[in_pitch + k * n + j] * pull_z


@kernel
def _eliminate(n: int, work: Array) -> None:
    """Solve GRAM T = TENSION in place; its symmetric form is positive definite, so no pivoting is needed."""
    if n == 2:
        a, b, c, d = work[GRAM], work[GRAM + 1], work[GRAM + MAX_TANKS], work[GRAM + MAX_TANKS + 1]
        e, f = work[TENSION], work[TENSION + 1]
        scale = 1.0 / (a * d - b * c)
        work[TENSION], work[TENSION + 1] = scale * (d * e - b * f), scale * (a * f - c * e)
        return
    for k in range(n):
        pivot = 1.0 / work[GRAM + k * MAX_TANKS + k]
        for row in range(k + 1, n):
            factor = work[GRAM + row * MAX_TANKS + k] * pivot
            for j in range(k + 1, n):
                work[GRAM + row * MAX_TANKS + j] -= factor * work[GRAM + k * MAX_TANKS + j]
            work[TENSION + row] -= factor * work[TENSION + k]
    for back in range(n):
        k = n - 1 - back
        total = work[TENSION + k]
        for j in range(k + 1, n):
            total -= work[GRAM + k * MAX_TANKS + j] * work[TENSION + j]
        work[TENSION + k] = total / work[GRAM + k * MAX_TANKS + k]


@kernel
def _apply_tension_to_modes(
    sizes: Counts, k: int, pull_y: float, pull_z: float, properties: Array, work: Array
) -> None:
    """Add to the modal accelerations what the rod of tank k pulls."""
    in_pitch, in_yaw = (
        following_column(sizes, PITCH, MODE_TANK_COMPLIANCE + k),
        following_column(sizes, YAW, MODE_TANK_COMPLIANCE + k),
    )
    add_to_modes(sizes, properties, in_pitch, pull_z, work, of_plane(FORCE, PITCH))
    add_to_modes(sizes, properties, in_yaw, pull_y, work, of_plane(FORCE, YAW))
