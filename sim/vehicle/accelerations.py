"""Accelerations of the body and its modes, and tensions of the pendulums' rods, solved for together.

Without its pendulums the vehicle's mass matrix is block-diagonal: six rigid coordinates (whose CG the deflected engine
displaces a little) and the modes, each alone. Every pendulum couples them through one number, the tension of its rod,
every engine on a compliant mount through its angular acceleration. Eliminating the other accelerations leaves one small
linear system for these (docs/model.md, section 7): exact, and no larger than the number of tanks and of such engines.
"""

from __future__ import annotations

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle import slosh
from maxq.sim.vehicle.bending import add_to_modes, modal_accelerations, modal_sum, of_plane
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.engine_modes import add_roll_to_modes, roll_moment_of_modes
from maxq.sim.vehicle.rigid import Balance
from maxq.sim.vehicle.spatial_modes import (
    add_tension_to_spatial,
    apply_spatial_load,
    free_spatial_accelerations,
    spatial_along_rod,
    spatial_compliance,
    spatial_motion,
)
from maxq.sim.vehicle.tvc_load import ALPHA as LOAD_ALPHA
from maxq.sim.vehicle.tvc_load import (
    INERTIA,
    KNOWN,
    RIGID_ACCEL,
    add_load_to_modes,
    load_block,
    load_modal,
    load_responses,
    load_spatial,
    moment_about_hinge,
)
from maxq.sim.vehicle.workspace import (
    ACCEL,
    FORCE,
    GRAM,
    MAX_UNKNOWNS,
    ROLL,
    SPATIAL_ACCEL,
    SPATIAL_FORCE,
    SPATIAL_ROLL,
    TENSION,
)


@kernel
def accelerate(
    sizes: Counts, on_pad: int, balanced: Balance, force: vec.Vector, moment: vec.Vector,
    pad_accel: vec.Vector, properties: Array, y: Array, first: int, work: Array,
) -> tuple[vec.Vector, vec.Vector]:  # fmt: skip  # twelve lines otherwise
    """Specific force at the core CG and angular acceleration, in B; modal accelerations and tensions (N) in `work`.

    `force` and `moment` (about the core CG) are those without the rods' tensions, `balanced` CG and inertia with the
    engines deflected. The pendulums' states begin at y[first]. On the pad the body has the accelerations of the pad,
    and only modes and bobs respond.
    """
    offset, inverse = balanced.offset, balanced.inverse_inertia
    inverse_mass = properties[sch.schedule_width(sizes) + sch.INVERSE_CORE_MASS]
    accel = vec.scaled(inverse_mass, force)  # of the CG with the engine deflected, without tensions
    if on_pad == 1:
        inverse_mass, accel, inverse = 0.0, pad_accel, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rolls_modes = balanced.given_way_kgm2 > 0.0  # else no deflected mass couples roll and modes
    for k in range(sizes.pendulums):
        b = slosh.tank_block(k)
        _add_damper_to_modes(sizes, k, work[b + slosh.DAMPER_FORCE], work[b + slosh.DAMPER_FORCE + 1], properties, work)
        if rolls_modes:
            _arm_through_modes(sizes, k, vec.vector_at(y, first + slosh.N_PENDULUM * k), properties, work)
        vec.set_vector(work, b + slosh.ALPHA, vec.symmetric_times(inverse, vec.vector_at(work, b + slosh.ARM)))
    if rolls_modes:
        moment = (moment[0] + roll_moment_of_modes(sizes, FORCE, SPATIAL_FORCE, work), moment[1], moment[2])
    alpha = vec.symmetric_times(inverse, vec.add(moment, vec.scaled(-1.0, vec.cross(offset, force))))
    modal_accelerations(sizes, properties, work, FORCE, ACCEL)
    if sizes.spatial_modes > 0:
        free_spatial_accelerations(sizes, properties, work)
    if sizes.tvc_loads > 0:
        load_responses(sizes, inverse_mass, inverse, properties, work)
    _solve_tensions(sizes, inverse_mass, accel, alpha, properties, y, first, work)
    for k in range(sizes.pendulums):
        u, tension = vec.vector_at(y, first + slosh.N_PENDULUM * k), work[TENSION + k]
        accel = vec.add(accel, vec.scaled(inverse_mass * tension, u))
        alpha = vec.add(alpha, vec.scaled(tension, vec.vector_at(work, slosh.tank_block(k) + slosh.ALPHA)))
        _add_tension_to_modes(sizes, k, tension * u[1], tension * u[2], properties, work)
        if sizes.spatial_modes > 0:
            add_tension_to_spatial(sizes, properties, k, tension, work)
    for k in range(2 * sizes.tvc_loads):
        b, swing = load_block(k), work[TENSION + sizes.pendulums + k]
        accel = vec.add(accel, vec.scaled(swing, vec.vector_at(work, b + RIGID_ACCEL)))
        alpha = vec.add(alpha, vec.scaled(swing, vec.vector_at(work, b + LOAD_ALPHA)))
        add_load_to_modes(sizes, k, swing, work)
    if rolls_modes:
        add_roll_to_modes(sizes, alpha[0], work)
        for k in range(sizes.pendulums):
            b = slosh.tank_block(k)
            work[b + slosh.BENDING_ACCEL] += alpha[0] * work[b + slosh.ROLL_BEND]
            work[b + slosh.BENDING_ACCEL + 1] += alpha[0] * work[b + slosh.ROLL_BEND + 1]
    if sizes.spatial_modes > 0:
        for k in range(sizes.pendulums):
            b, moved = slosh.tank_block(k), spatial_motion(sizes, properties, sch.tank_place(k), work, SPATIAL_ACCEL)
            work[b + slosh.ALONG_X + 3] = moved[0]
            work[b + slosh.BENDING_ACCEL] += moved[1]
            work[b + slosh.BENDING_ACCEL + 1] += moved[2]
    return vec.add(accel, vec.cross(offset, alpha)), alpha


@kernel
def _arm_through_modes(sizes: Counts, k: int, u: vec.Vector, properties: Array, work: Array) -> None:
    """Add to the roll arm of tank k what its tension moves of deflected engines through the modes (7.3)."""
    b = slosh.tank_block(k)
    y, z = _bending_acceleration(sizes, k, properties, work, ROLL)
    work[b + slosh.ROLL_BEND], work[b + slosh.ROLL_BEND + 1] = y, z
    roll = u[1] * y + u[2] * z
    if sizes.spatial_modes > 0:
        moved = spatial_motion(sizes, properties, sch.tank_place(k), work, SPATIAL_ROLL)
        roll += u[0] * moved[0] + u[1] * moved[1] + u[2] * moved[2]
    work[b + slosh.ARM] += roll


@kernel
def _add_damper_to_modes(
    sizes: Counts, k: int, force_y: float, force_z: float, properties: Array, work: Array
) -> None:  # fmt: skip  # as ruff would, but for a line of one bracket
    """Add the force of the damper of tank k to the generalised forces."""
    in_pitch, in_yaw = (
        sch.mode_column(sizes, sch.PITCH, sch.MODE_FIRST + k),
        sch.mode_column(sizes, sch.YAW, sch.MODE_FIRST + k),
    )
    add_to_modes(sizes, properties, in_pitch, force_z, work, of_plane(FORCE, sch.PITCH))
    add_to_modes(sizes, properties, in_yaw, force_y, work, of_plane(FORCE, sch.YAW))
    if sizes.spatial_modes > 0:
        load = (work[slosh.tank_block(k) + slosh.ALONG_X + 2], force_y, force_z, 0.0, 0.0, 0.0)
        apply_spatial_load(sizes, properties, sch.tank_place(k), load, work, SPATIAL_FORCE)


@kernel
def _add_tension_to_modes(
    sizes: Counts, k: int, force_y: float, force_z: float, properties: Array, work: Array
) -> None:  # fmt: skip  # as ruff would, but for a line of one bracket
    """Add the lateral force of the rod of tank k to the modal accelerations."""
    in_pitch = sch.derived_column(sizes, sch.PITCH, sch.MODE_TANK_COMPLIANCE + k)
    in_yaw = sch.derived_column(sizes, sch.YAW, sch.MODE_TANK_COMPLIANCE + k)
    add_to_modes(sizes, properties, in_pitch, force_z, work, of_plane(ACCEL, sch.PITCH))
    add_to_modes(sizes, properties, in_yaw, force_y, work, of_plane(ACCEL, sch.YAW))


@kernel
def _gram(row: int, column: int) -> int:
    """Where the workspace holds an entry of the matrix of the tensions."""
    return GRAM + row * MAX_UNKNOWNS + column


@kernel
def _solve_tensions(
    sizes: Counts, inverse_mass: float, accel: vec.Vector, alpha: vec.Vector, properties: Array, y: Array,
    first: int, work: Array,
) -> None:  # fmt: skip  # ten lines otherwise
    """Solve  (1/m_k) T_k + sum_l G_kl T_l = demand_k - (hinge acceleration along the rod without tensions).

    G is symmetric: how much the hinge of k accelerates along its rod per newton of tension in l. With arms about the CG
    of the deflected vehicle the rigid part of it is u_k.u_l / m + arm_k.(J^-1 arm_l). Both sides are multiplied by m_k.
    """
    n = sizes.pendulums
    in_pitch, in_yaw = sch.compliance_column(sizes, sch.PITCH), sch.compliance_column(sizes, sch.YAW)
    for k in range(n):
        b, u, mass = slosh.tank_block(k), vec.vector_at(y, first + slosh.N_PENDULUM * k), slosh.bob_mass(properties, k)
        arm = vec.vector_at(work, b + slosh.ARM)
        bend_y, bend_z = _bending_acceleration(sizes, k, properties, work, ACCEL)
        work[b + slosh.BENDING_ACCEL], work[b + slosh.BENDING_ACCEL + 1] = bend_y, bend_z
        along = vec.dot(u, accel) + vec.dot(arm, alpha) + u[1] * bend_y + u[2] * bend_z
        if sizes.spatial_modes > 0:
            along += spatial_along_rod(sizes, properties, sch.tank_place(k), k, u, work, SPATIAL_ACCEL)
        work[TENSION + k] = mass * (work[b + slosh.DEMAND] - along)
        for j in range(k + 1):
            u_j = vec.vector_at(y, first + slosh.N_PENDULUM * j)
            g = inverse_mass * vec.dot(u, u_j)
            g += vec.dot(arm, vec.vector_at(work, slosh.tank_block(j) + slosh.ALPHA))
            g += properties[in_pitch + k * n + j] * u[2] * u_j[2] + properties[in_yaw + k * n + j] * u[1] * u_j[1]
            if sizes.spatial_modes > 0:
                g += spatial_compliance(sizes, properties, k, j, work)
            work[_gram(j, k)] = slosh.bob_mass(properties, j) * g
            work[_gram(k, j)] = mass * g
        work[_gram(k, k)] += 1.0
    if sizes.tvc_loads > 0:
        _add_loads(sizes, accel, alpha, properties, y, first, work)
    _eliminate(n + 2 * sizes.tvc_loads, work)
    for k in range(n):  # the tensions accelerate the hinges, too
        u, tension = vec.vector_at(y, first + slosh.N_PENDULUM * k), work[TENSION + k]
        for j in range(n):
            b = slosh.tank_block(j)
            work[b + slosh.BENDING_ACCEL] += properties[in_yaw + k * n + j] * (tension * u[1])
            work[b + slosh.BENDING_ACCEL + 1] += properties[in_pitch + k * n + j] * (tension * u[2])
    for k in range(2 * sizes.tvc_loads):  # and so does the engine's swing
        for j in range(n):
            b, swing = slosh.tank_block(j), work[TENSION + n + k]
            bend_y, bend_z = _bending_acceleration(sizes, j, properties, work, load_modal(k, 1))
            work[b + slosh.BENDING_ACCEL] += swing * bend_y
            work[b + slosh.BENDING_ACCEL + 1] += swing * bend_z


@kernel
def _bending_acceleration(
    sizes: Counts, k: int, properties: Array, work: Array, quantity: int
) -> tuple[float, float]:  # fmt: skip  # as ruff would, but for a line of one bracket
    """Acceleration of the hinge of tank k along y and z, from the modal accelerations at `quantity`."""
    bend_z = modal_sum(
        sizes, properties, sch.mode_column(sizes, sch.PITCH, sch.MODE_FIRST + k), work, of_plane(quantity, sch.PITCH)
    )
    bend_y = modal_sum(
        sizes, properties, sch.mode_column(sizes, sch.YAW, sch.MODE_FIRST + k), work, of_plane(quantity, sch.YAW)
    )
    return bend_y, bend_z


@kernel
def _add_loads(
    sizes: Counts, accel: vec.Vector, alpha: vec.Vector, properties: Array, y: Array, first: int, work: Array
) -> None:  # fmt: skip  # ten lines otherwise
    """Rows and columns of the engine's angular accelerations s in the system of the tensions (docs/model.md, 14.4):

        I_i s_i - sum_j (b_i . Y_j) s_j - sum_k h_ki T_k = known_i + b_i . X,

    and m_k h_ki s_i in the row of tank k, h_ki the acceleration of its hinge along the rod per unit of s_i.
    """
    n = sizes.pendulums
    for i in range(2 * sizes.tvc_loads):
        b, modal, row = load_block(i), load_modal(i, 1), n + i
        rigid, turning = vec.vector_at(work, b + RIGID_ACCEL), vec.vector_at(work, b + LOAD_ALPHA)
        for k in range(n):
            u, arm = (
                vec.vector_at(y, first + slosh.N_PENDULUM * k),
                vec.vector_at(work, slosh.tank_block(k) + slosh.ARM),
            )
            bend_y, bend_z = _bending_acceleration(sizes, k, properties, work, modal)
            along = vec.dot(u, rigid) + vec.dot(arm, turning) + u[1] * bend_y + u[2] * bend_z
            if sizes.spatial_modes > 0:
                along += spatial_along_rod(sizes, properties, sch.tank_place(k), k, u, work, load_spatial(i, 1))
            work[_gram(k, row)] = slosh.bob_mass(properties, k) * along
            work[_gram(row, k)] = -along
        for j in range(2 * sizes.tvc_loads):
            work[_gram(n + j, row)] = -moment_about_hinge(sizes, j, rigid, turning, modal, load_spatial(i, 1), work)
        work[_gram(row, row)] += work[b + INERTIA]
        work[TENSION + row] = work[b + KNOWN] + moment_about_hinge(sizes, i, accel, alpha, ACCEL, SPATIAL_ACCEL, work)


@kernel
def _eliminate(n: int, work: Array) -> None:
    """Solve GRAM T = TENSION in place, right-hand side in, tensions out.

    No pivoting is needed: brought to symmetric form, tensions first, the matrix is definite in every pivot.
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
