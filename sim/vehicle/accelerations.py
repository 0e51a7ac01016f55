"""Accelerations of the body and its modes, and tensions of the pendulums' rods, from one coupled system.

Without pendulums, the vehicle's mass matrix is block-diagonal: six rigid coordinates, whose CG the deflected engines
displace slightly, and each mode alone. A pendulum couples these blocks through one unknown, the tension of its rod. An
engine on a compliant mount couples them through its angular accelerations in two planes. Elimination of the other
accelerations leaves a small linear system for these unknowns (docs/model.md, section 7). The system is exact. Its order
is the number of pendulums plus twice the number of such engines.
"""

from __future__ import annotations

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import formula, kernel
from maxq.control.kernel.records import Array
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.block import Counts
from maxq.sim.vehicle.body.kernel import Balance
from maxq.sim.vehicle.engine.modes import add_roll_to_modes, roll_moment_of_modes
from maxq.sim.vehicle.modes.planar import Modes, PlanarMotion, add_to_modes, modal_accelerations, modal_sum, of_plane
from maxq.sim.vehicle.modes.spatial import (
    add_tension_to_spatial,
    apply_spatial_load,
    free_spatial_accelerations,
    spatial_along_rod,
    spatial_compliance,
    spatial_motion,
)
from maxq.sim.vehicle.slosh import kernel as slosh
from maxq.sim.vehicle.tvc_load.kernel import MAX_UNKNOWNS, System, add_load_to_modes, load_responses, moment_about_hinge
from maxq.sim.vehicle.workspace import Work


@kernel
def accelerate(
    sizes: Counts,
    on_pad: int,
    balanced: Balance,
    force: vec.Vector,
    moment: vec.Vector,
    pad_accel: vec.Vector,
    properties: Array,
    y: Array,
    first: int,
    work: Work,
) -> tuple[vec.Vector, vec.Vector]:
    """Return the specific force at the core CG and the angular acceleration, in B.

    - `on_pad`: 1 on the pad or the launch rail, where the body has the acceleration `pad_accel` and no angular
      acceleration, and only modes and pendulums respond.
    - `balanced`: CG and inertia with the engines deflected.
    - `force`, `moment` (about the core CG): loads without the tensions of the rods.
    - `first`: index of the first pendulum's state in `y`.

    Modal accelerations and tensions (N) are written to `work`.
    """
    offset, inverse, modes = balanced.offset, balanced.inverse_inertia, work.modes
    planar, spatial, system, unknown = modes.planar, modes.spatial, work.system, work.system.unknown
    inverse_mass = properties[sch.schedule_width(sizes) + sch.INVERSE_CORE_MASS]
    accel = vec.scaled(inverse_mass, force)  # acceleration of the deflected CG without tensions
    if on_pad == 1:
        inverse_mass, accel, inverse = 0.0, pad_accel, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    rolls_modes = balanced.given_way_kgm2 > 0.0  # otherwise no deflected mass couples roll and modes
    for k in range(sizes.pendulums):
        tank = work.tank[k]
        _add_damper_to_modes(sizes, k, tank, properties, modes)
        if rolls_modes:
            _arm_through_modes(sizes, k, vec.vector_at(y, first + slosh.N_PENDULUM * k), properties, modes, tank)
        vec.set_vector(tank.alpha_radps2pN, 0, vec.symmetric_times(inverse, vec.vector_at(tank.arm_m, 0)))
    if rolls_modes:
        moment = (moment[0] + roll_moment_of_modes(sizes, planar.force_N, spatial.force_N, modes), moment[1], moment[2])
    alpha = vec.symmetric_times(inverse, vec.add(moment, vec.scaled(-1.0, vec.cross(offset, force))))
    modal_accelerations(sizes, properties, planar.force_N, planar.accel_mps2)
    if sizes.spatial_modes > 0:
        free_spatial_accelerations(sizes, properties, spatial)
    if sizes.tvc_loads > 0:
        load_responses(sizes, inverse_mass, inverse, properties, system)
    _solve_tensions(sizes, inverse_mass, accel, alpha, properties, y, first, work)
    for k in range(sizes.pendulums):
        u, tension, tank = vec.vector_at(y, first + slosh.N_PENDULUM * k), unknown[k], work.tank[k]
        accel = vec.add(accel, vec.scaled(inverse_mass * tension, u))
        alpha = vec.add(alpha, vec.scaled(tension, vec.vector_at(tank.alpha_radps2pN, 0)))
        add_tension_to_modes(sizes, k, tension * u[1], tension * u[2], properties, planar)
        if sizes.spatial_modes > 0:
            shapes = tank.shapes_along_rod
            add_tension_to_spatial(sizes, properties, shapes, tension, spatial.accel_mps2)
    for k in range(2 * sizes.tvc_loads):
        swing, turn = system.swing[k], unknown[sizes.pendulums + k]
        accel = vec.add(accel, vec.scaled(turn, vec.vector_at(swing.accel_mps2, 0)))
        alpha = vec.add(alpha, vec.scaled(turn, vec.vector_at(swing.alpha_radps2, 0)))
        add_load_to_modes(sizes, swing, turn, modes)
    if rolls_modes:
        add_roll_to_modes(sizes, alpha[0], modes)
        for k in range(sizes.pendulums):
            tank = work.tank[k]
            tank.bending_accel_mps2[1] += alpha[0] * tank.roll_bend_y_m
            tank.bending_accel_mps2[2] += alpha[0] * tank.roll_bend_z_m
    if sizes.spatial_modes > 0:
        for k in range(sizes.pendulums):
            bending = work.tank[k].bending_accel_mps2
            moved = spatial_motion(sizes, properties, sch.tank_place(k), spatial.accel_mps2)
            bending[0] = moved[0]
            bending[1] += moved[1]
            bending[2] += moved[2]
    return vec.add(accel, vec.cross(offset, alpha)), alpha


@kernel
def _arm_through_modes(
    sizes: Counts, k: int, u: vec.Vector, properties: Array, modes: Modes, tank: slosh.TankWork
) -> None:
    """Add the effect of tank k's tension through modes and deflected engines to its roll arm (docs/model.md, 7.3)."""
    y, z = _bending_acceleration(sizes, k, properties, modes.planar.roll_m)
    tank.roll_bend_y_m, tank.roll_bend_z_m = y, z
    roll = u[1] * y + u[2] * z
    if sizes.spatial_modes > 0:
        moved = spatial_motion(sizes, properties, sch.tank_place(k), modes.spatial.roll_m)
        roll += u[0] * moved[0] + u[1] * moved[1] + u[2] * moved[2]
    tank.arm_m[0] += roll


@kernel
def _add_damper_to_modes(sizes: Counts, k: int, tank: slosh.TankWork, properties: Array, modes: Modes) -> None:
    """Add the force of the damper of tank k to the generalised forces."""
    force_y, force_z = tank.damper_force_N[1], tank.damper_force_N[2]
    in_pitch, in_yaw = (
        sch.mode_column(sizes, sch.PITCH, sch.MODE_FIRST + k),
        sch.mode_column(sizes, sch.YAW, sch.MODE_FIRST + k),
    )
    add_to_modes(sizes, properties, in_pitch, force_z, modes.planar.force_N, of_plane(sch.PITCH))
    add_to_modes(sizes, properties, in_yaw, force_y, modes.planar.force_N, of_plane(sch.YAW))
    if sizes.spatial_modes > 0:
        load = (tank.damper_force_N[0], force_y, force_z, 0.0, 0.0, 0.0)
        apply_spatial_load(sizes, properties, sch.tank_place(k), load, modes.spatial.force_N)


@kernel
def add_tension_to_modes(
    sizes: Counts, k: int, force_y: float, force_z: float, properties: Array, modes: PlanarMotion
) -> None:
    """Add the effect of the lateral force of tank k's rod to the modal accelerations."""
    in_pitch = sch.derived_column(sizes, sch.PITCH, sch.MODE_TANK_COMPLIANCE + k)
    in_yaw = sch.derived_column(sizes, sch.YAW, sch.MODE_TANK_COMPLIANCE + k)
    add_to_modes(sizes, properties, in_pitch, force_z, modes.accel_mps2, of_plane(sch.PITCH))
    add_to_modes(sizes, properties, in_yaw, force_y, modes.accel_mps2, of_plane(sch.YAW))


@formula
def entry(row: int, column: int) -> int:
    """Return the index of an entry in the matrix of the system."""
    return row * MAX_UNKNOWNS + column


@kernel
def _solve_tensions(
    sizes: Counts,
    inverse_mass: float,
    accel: vec.Vector,
    alpha: vec.Vector,
    properties: Array,
    y: Array,
    first: int,
    work: Work,
) -> None:
    """Solve (1/m_k) T_k + sum_l G_kl T_l = demand_k - (hinge acceleration along the rod without tensions).

    G is symmetric: G_kl is the acceleration of the hinge of k along its rod per newton of tension in l. With arms about
    the CG of the deflected vehicle, its rigid part is u_k.u_l / m + arm_k.(J^-1 arm_l). Both sides are multiplied by
    m_k, so that a tank without mass leaves the system regular.
    """
    n, planar, spatial, system = sizes.pendulums, work.modes.planar, work.modes.spatial, work.system
    matrix, unknown = system.matrix, system.unknown
    in_pitch, in_yaw = sch.compliance_column(sizes, sch.PITCH), sch.compliance_column(sizes, sch.YAW)
    for k in range(n):
        u, mass = vec.vector_at(y, first + slosh.N_PENDULUM * k), slosh.bob_mass(properties, k)
        tank = work.tank[k]
        arm, shapes = vec.vector_at(tank.arm_m, 0), tank.shapes_along_rod
        bend_y, bend_z = _bending_acceleration(sizes, k, properties, planar.accel_mps2)
        tank.bending_accel_mps2[1], tank.bending_accel_mps2[2] = bend_y, bend_z
        along = vec.dot(u, accel) + vec.dot(arm, alpha) + u[1] * bend_y + u[2] * bend_z
        if sizes.spatial_modes > 0:
            accel_mps2 = spatial.accel_mps2
            along += spatial_along_rod(sizes, properties, sch.tank_place(k), u, accel_mps2, shapes)
        unknown[k] = mass * (tank.demand_mps2 - along)
        for j in range(k + 1):
            u_j, other = vec.vector_at(y, first + slosh.N_PENDULUM * j), work.tank[j]
            g = inverse_mass * vec.dot(u, u_j)
            g += vec.dot(arm, vec.vector_at(other.alpha_radps2pN, 0))
            g += properties[in_pitch + k * n + j] * u[2] * u_j[2] + properties[in_yaw + k * n + j] * u[1] * u_j[1]
            if sizes.spatial_modes > 0:
                g += spatial_compliance(sizes, properties, shapes, other.shapes_along_rod)
            matrix[entry(j, k)] = slosh.bob_mass(properties, j) * g
            matrix[entry(k, j)] = mass * g
        matrix[entry(k, k)] += 1.0
    if sizes.tvc_loads > 0:
        _add_loads(sizes, accel, alpha, properties, y, first, work)
    eliminate(n + 2 * sizes.tvc_loads, system)
    for k in range(n):  # the tensions also accelerate the hinges
        u, tension = vec.vector_at(y, first + slosh.N_PENDULUM * k), unknown[k]
        for j in range(n):
            bending = work.tank[j].bending_accel_mps2
            bending[1] += properties[in_yaw + k * n + j] * (tension * u[1])
            bending[2] += properties[in_pitch + k * n + j] * (tension * u[2])
    for k in range(2 * sizes.tvc_loads):  # as do the angular accelerations of the engines
        for j in range(n):
            bending, turn = work.tank[j].bending_accel_mps2, unknown[n + k]
            bend_y, bend_z = _bending_acceleration(sizes, j, properties, system.swing[k].planar_accel_mps2)
            bending[1] += turn * bend_y
            bending[2] += turn * bend_z


@kernel
def _bending_acceleration(sizes: Counts, k: int, properties: Array, accel_mps2: Array) -> tuple[float, float]:
    """Return the acceleration of the hinge of tank k along y and z, from the modal accelerations."""
    bend_z = modal_sum(
        sizes, properties, sch.mode_column(sizes, sch.PITCH, sch.MODE_FIRST + k), accel_mps2, of_plane(sch.PITCH)
    )
    bend_y = modal_sum(
        sizes, properties, sch.mode_column(sizes, sch.YAW, sch.MODE_FIRST + k), accel_mps2, of_plane(sch.YAW)
    )
    return bend_y, bend_z


@kernel
def _add_loads(
    sizes: Counts, accel: vec.Vector, alpha: vec.Vector, properties: Array, y: Array, first: int, work: Work
) -> None:
    """Add the rows and columns of the engines' angular accelerations s to the system of the tensions.

    The equations are (docs/model.md, 14.4)

            I_i s_i - sum_j (b_i . Y_j) s_j - sum_k h_ki T_k = known_i + b_i . X,

    and m_k h_ki s_i in the row of tank k, where h_ki is the acceleration of its hinge along the rod per unit of s_i.
    """
    n, system, modes = sizes.pendulums, work.system, work.modes
    matrix, unknown = system.matrix, system.unknown
    accelerations = modes.planar.accel_mps2, modes.spatial.accel_mps2
    for i in range(2 * sizes.tvc_loads):
        swing, row = system.swing[i], n + i
        rigid, turning = vec.vector_at(swing.accel_mps2, 0), vec.vector_at(swing.alpha_radps2, 0)
        planar, spatial = swing.planar_accel_mps2, swing.spatial_accel_mps2
        for k in range(n):
            u, tank = vec.vector_at(y, first + slosh.N_PENDULUM * k), work.tank[k]
            arm = vec.vector_at(tank.arm_m, 0)
            bend_y, bend_z = _bending_acceleration(sizes, k, properties, planar)
            along = vec.dot(u, rigid) + vec.dot(arm, turning) + u[1] * bend_y + u[2] * bend_z
            if sizes.spatial_modes > 0:
                shapes = tank.shapes_along_rod
                along += spatial_along_rod(sizes, properties, sch.tank_place(k), u, spatial, shapes)
            matrix[entry(k, row)] = slosh.bob_mass(properties, k) * along
            matrix[entry(row, k)] = -along
        for j in range(2 * sizes.tvc_loads):
            about = moment_about_hinge(sizes, system.swing[j], rigid, turning, planar, spatial)
            matrix[entry(n + j, row)] = -about
        matrix[entry(row, row)] += swing.inertia_kgm2
        about = moment_about_hinge(sizes, swing, accel, alpha, accelerations[0], accelerations[1])
        unknown[row] = swing.known_Nm + about


@kernel
def eliminate(n: int, system: System) -> None:
    """Solve the system in place: `unknown` contains the right-hand side, then the solution.

    No pivoting is needed, because the symmetric form of the matrix is quasi-definite, so that no pivot is zero.
    """
    matrix, unknown = system.matrix, system.unknown
    if n == 2:
        a, b, c, d = matrix[entry(0, 0)], matrix[entry(0, 1)], matrix[entry(1, 0)], matrix[entry(1, 1)]
        e, f = unknown[0], unknown[1]
        scale = 1.0 / (a * d - b * c)
        unknown[0], unknown[1] = scale * (d * e - b * f), scale * (a * f - c * e)
        return
    for k in range(n):
        pivot = 1.0 / matrix[entry(k, k)]
        for row in range(k + 1, n):
            factor = matrix[entry(row, k)] * pivot
            for j in range(k + 1, n):
                matrix[entry(row, j)] -= factor * matrix[entry(k, j)]
            unknown[row] -= factor * unknown[k]
    for back in range(n):
        k = n - 1 - back
        total = unknown[k]
        for j in range(k + 1, n):
            total -= matrix[entry(k, j)] * unknown[j]
        unknown[k] = total / matrix[entry(k, k)]
