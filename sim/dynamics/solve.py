"""Accelerations of the coupled system: rigid body with a deflected engine, modes, and the tensions that join the bobs.

Without its pendulums the vehicle's mass matrix is block-diagonal: six rigid coordinates (whose CG the deflected
engine moves a little) and the modes, each alone. Every pendulum couples them through one number, the tension of its
rod. Eliminating the accelerations leaves one small linear system for the tensions (docs/model.md, section 7):
exact, and no larger than the number of tanks.
"""

from __future__ import annotations

from maxq.control.jit import kernel
from maxq.control.records import Array
from maxq.sim.dynamics.schedule import (
    MODE_FIRST,
    MODE_INVERSE_MASS,
    compliance_column,
    mode_width,
    pitch_column,
    yaw_column,
)
from maxq.sim.dynamics.slosh import (
    ACCEL,
    ALPHA,
    ARM,
    BEND_Y,
    BEND_Z,
    DEMAND,
    PUSH_Y,
    PUSH_Z,
    Slosh,
    bob_mass,
)
from maxq.sim.dynamics.state import MAX_TANKS, Sizes, pendulum_index
from maxq.sim.dynamics.vectors import Symmetric, Vector, add, cross, dot, scaled, symmetric_times
from maxq.sim.dynamics.workspace import FORCE_PITCH, FORCE_YAW, GRAM, PENDULUM, PENDULUM_WIDTH, TENSION


@kernel
def rigid_answer(
    mass: float, offset: Vector, inverse: Symmetric, force: Vector, moment: Vector
) -> tuple[Vector, Vector]:
    """Acceleration and angular acceleration of the rigid part under a force and a moment about the core CG.

    `offset` leads from the core CG to the CG with the engine deflected, `inverse` is the inverse inertia about the
    latter.
    """
    alpha = symmetric_times(inverse, add(moment, scaled(-1.0, cross(offset, force))))
    return add(scaled(1.0 / mass, force), scaled(-1.0, cross(alpha, offset))), alpha


@kernel
def accelerate(
    slosh: Slosh, sizes: Sizes, held: int, mass: float, offset: Vector, inverse: Symmetric, force: Vector,
    moment: Vector, held_accel: Vector, props: Array, y: Array, work: Array,
) -> tuple[Vector, Vector]:  # fmt: skip
    """Specific acceleration of the core CG and angular acceleration, in B.

    On return the workspace's modal forces hold the modal accelerations, and TENSION the rods' tensions (N).
    On the pad (`held`) the body's accelerations are those of the pad and only modes and bobs answer.
    """
    felt, alpha = held_accel, (0.0, 0.0, 0.0)
    if held == 0:
        felt, alpha = rigid_answer(mass, offset, inverse, force, moment)
    _divide_by_modal_mass(sizes, props, work)
    for k in range(sizes.tanks):
        _answer_to_tension(sizes, k, held, mass, offset, inverse, y, work)
        _bend_without_pendulums(sizes, k, props, work)
    _bend_by_pushes(sizes, props, work)  # of the dampers
    _tensions(slosh, sizes, felt, alpha, props, y, work)
    for k in range(sizes.tanks):
        b = PENDULUM + PENDULUM_WIDTH * k
        tension = work[TENSION + k]
        felt = add(felt, scaled(tension, (work[b + ACCEL], work[b + ACCEL + 1], work[b + ACCEL + 2])))
        alpha = add(alpha, scaled(tension, (work[b + ALPHA], work[b + ALPHA + 1], work[b + ALPHA + 2])))
        _pull(sizes, k, tension, props, y, work)
    return felt, alpha


@kernel
def _divide_by_modal_mass(sizes: Sizes, props: Array, work: Array) -> None:
    c, width = pitch_column(sizes, 0) + MODE_INVERSE_MASS, mode_width(sizes, sizes.pitch_modes)
    for i in range(sizes.pitch_modes):
        work[FORCE_PITCH + i] *= props[c + i * width]
    c, width = yaw_column(sizes, 0) + MODE_INVERSE_MASS, mode_width(sizes, sizes.yaw_modes)
    for i in range(sizes.yaw_modes):
        work[FORCE_YAW + i] *= props[c + i * width]


@kernel
def _answer_to_tension(
    sizes: Sizes, k: int, held: int, mass: float, offset: Vector, inverse: Symmetric, y: Array, work: Array
) -> None:
    """Rigid acceleration per newton of tension in rod k."""
    b = PENDULUM + PENDULUM_WIDTH * k
    accel, alpha = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if held == 0:
        i = pendulum_index(sizes, k)
        arm = (work[b + ARM], work[b + ARM + 1], work[b + ARM + 2])
        accel, alpha = rigid_answer(mass, offset, inverse, (y[i], y[i + 1], y[i + 2]), arm)
    for j in range(3):
        work[b + ACCEL + j] = accel[j]
        work[b + ALPHA + j] = alpha[j]


@kernel
def _tensions(slosh: Slosh, sizes: Sizes, felt: Vector, alpha: Vector, props: Array, y: Array, work: Array) -> None:
    """Solve  (1/m_k) T_k + sum_l G_kl T_l = demand_k - (hinge acceleration along the rod without tensions)."""
    n = sizes.tanks
    in_pitch, in_yaw = compliance_column(sizes, 0), compliance_column(sizes, 1)
    for k in range(n):
        i, b = pendulum_index(sizes, k), PENDULUM + PENDULUM_WIDTH * k
        u = (y[i], y[i + 1], y[i + 2])
        arm = (work[b + ARM], work[b + ARM + 1], work[b + ARM + 2])
        mass = bob_mass(slosh, props, k)
        along = dot(u, felt) + dot(arm, alpha) + u[1] * work[b + BEND_Y] + u[2] * work[b + BEND_Z]
        work[TENSION + k] = mass * (work[b + DEMAND] - along)
        for j in range(n):
            i_j, b_j = pendulum_index(sizes, j), PENDULUM + PENDULUM_WIDTH * j
            g = dot(u, (work[b_j + ACCEL], work[b_j + ACCEL + 1], work[b_j + ACCEL + 2]))
            g += dot(arm, (work[b_j + ALPHA], work[b_j + ALPHA + 1], work[b_j + ALPHA + 2]))
            g += props[in_pitch + k * n + j] * u[2] * y[i_j + 2] + props[in_yaw + k * n + j] * u[1] * y[i_j + 1]
            work[GRAM + k * MAX_TANKS + j] = mass * g
        work[GRAM + k * MAX_TANKS + k] += 1.0
    for k in range(n):  # elimination; the symmetric form of the matrix is positive definite, so no pivoting is needed
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
def _bend_without_pendulums(sizes: Sizes, k: int, props: Array, work: Array) -> None:
    """Acceleration of hinge k by the modes, before any pendulum pushes them."""
    b = PENDULUM + PENDULUM_WIDTH * k
    c, width = pitch_column(sizes, 0) + MODE_FIRST + k, mode_width(sizes, sizes.pitch_modes)
    along_z = 0.0
    for i in range(sizes.pitch_modes):
        along_z += props[c + i * width] * work[FORCE_PITCH + i]
    c, width = yaw_column(sizes, 0) + MODE_FIRST + k, mode_width(sizes, sizes.yaw_modes)
    along_y = 0.0
    for i in range(sizes.yaw_modes):
        along_y += props[c + i * width] * work[FORCE_YAW + i]
    work[b + BEND_Y], work[b + BEND_Z] = along_y, along_z


@kernel
def _bend_by_pushes(sizes: Sizes, props: Array, work: Array) -> None:
    """Add to the hinges' accelerations what the dampers' pushes do to each other through the modes."""
    n = sizes.tanks
    in_pitch, in_yaw = compliance_column(sizes, 0), compliance_column(sizes, 1)
    for k in range(n):
        b = PENDULUM + PENDULUM_WIDTH * k
        for j in range(n):
            b_j = PENDULUM + PENDULUM_WIDTH * j
            work[b + BEND_Y] += props[in_yaw + k * n + j] * work[b_j + PUSH_Y]
            work[b + BEND_Z] += props[in_pitch + k * n + j] * work[b_j + PUSH_Z]


@kernel
def _pull(sizes: Sizes, k: int, tension: float, props: Array, y: Array, work: Array) -> None:
    """Let rod and damper of tank k act on the modes, and the rod on all hinges through them."""
    n = sizes.tanks
    b, i = PENDULUM + PENDULUM_WIDTH * k, pendulum_index(sizes, k)
    pull_y, pull_z = tension * y[i + 1], tension * y[i + 2]
    in_pitch, in_yaw = compliance_column(sizes, 0) + k * n, compliance_column(sizes, 1) + k * n
    for j in range(n):
        b_j = PENDULUM + PENDULUM_WIDTH * j
        work[b_j + BEND_Y] += props[in_yaw + j] * pull_y
        work[b_j + BEND_Z] += props[in_pitch + j] * pull_z
    pull_y += work[b + PUSH_Y]
    pull_z += work[b + PUSH_Z]
    c, width = pitch_column(sizes, 0), mode_width(sizes, sizes.pitch_modes)
    for j in range(sizes.pitch_modes):
        m = c + j * width
        work[FORCE_PITCH + j] += pull_z * props[m + MODE_FIRST + k] * props[m + MODE_INVERSE_MASS]
    c, width = yaw_column(sizes, 0), mode_width(sizes, sizes.yaw_modes)
    for j in range(sizes.yaw_modes):
        m = c + j * width
        work[FORCE_YAW + j] += pull_y * props[m + MODE_FIRST + k] * props[m + MODE_INVERSE_MASS]
