"""The clamp of a tail on the pad: force and moment that hold position and slope of the bent axis at the first gimbal.

The rest of the body is free, so that the modes bend as those of a cantilever (docs/model.md, section 4). With planar
modes, each plane has two conditions, and axial motion and roll follow the rigid body. Spatial modes have six conditions
together.
"""

from __future__ import annotations

from maxq.control.kernel.jit import kernel, rare_routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import (
    Matrix,
    Symmetric,
    Vector,
    add,
    cross,
    dot,
    rotate_back,
    scaled,
    symmetric_times,
    vector_at,
)
from maxq.sim.vehicle import schedule as sch
from maxq.sim.vehicle.accelerations import add_tension_to_modes, eliminate, entry
from maxq.sim.vehicle.block import W_BI_B, Counts, Sizes, counts
from maxq.sim.vehicle.environment import velocity_over_ground
from maxq.sim.vehicle.modes.planar import apply_gimbal_load, modal_accelerations, motion_at, of_plane
from maxq.sim.vehicle.modes.spatial import (
    add_tension_to_spatial,
    apply_spatial_load,
    free_spatial_accelerations,
    spatial_along_rod,
    spatial_motion,
)
from maxq.sim.vehicle.slosh.kernel import bob_mass
from maxq.sim.vehicle.state import pendulum_index
from maxq.sim.vehicle.workspace import Work
from maxq.sim.world.earth import Earth

_SETTLING_1PS = 200.0  # rate at which a velocity of the clamped tail decays


@rare_routine
def clamp_tail(
    of: Sizes,
    earth: Earth,
    station_m: float,
    rotation: Matrix,
    offset: Vector,
    inverse_inertia: Symmetric,
    pad: Vector,
    force: Vector,
    moment: Vector,
    properties: Array,
    y: Array,
    work: Work,
) -> tuple[Vector, Vector]:
    """Return force and moment (about the core CG) with those of the clamp, and add its load to the generalised forces.

    `force` and `moment` are all others; `pad` is the specific force of the pad. `offset` is the vector from the core CG
    to the CG with the engines deflected.
    """
    sizes, modes, pitch, yaw = counts(of), work.modes.planar, of_plane(sch.PITCH), of_plane(sch.YAW)
    if sizes.spatial_modes > 0:
        return _clamp_spatial(
            sizes, earth, station_m, rotation, offset, inverse_inertia, pad, force, moment, properties, y, work
        )
    moved_y, moved_z, _, _ = motion_at(sizes, properties, 0, modes.eta_m, pitch, yaw)
    at = (
        properties[sch.CORE_CG] - station_m,
        moved_y - properties[sch.CORE_CG + 1],
        moved_z - properties[sch.CORE_CG + 2],
    )
    carried, about_cg = _carried(sizes, pad, offset, properties, y, work)
    reaction = add(carried, scaled(-1.0, force))
    about_clamp = add(about_cg, scaled(-1.0, moment))
    couple = add(about_clamp, scaled(-1.0, cross(at, reaction)))
    load = (reaction[0], reaction[1], reaction[2], couple[0], couple[1], couple[2])
    apply_gimbal_load(sizes, properties, 0, load, modes.force_N)

    modal_accelerations(sizes, properties, modes.force_N, modes.accel_mps2)
    for k in range(sizes.pendulums):
        pull = _hanging(k, pad, properties, y, pendulum_index(sizes, k))
        add_tension_to_modes(sizes, k, pull[1], pull[2], properties, modes)
    bent_y, bent_z, turned_y, turned_z = motion_at(sizes, properties, 0, modes.accel_mps2, pitch, yaw)
    rate_y, rate_z, turning_y, turning_z = motion_at(sizes, properties, 0, modes.rate_mps, pitch, yaw)
    velocity, turn = _over_ground(earth, rotation, at, y)
    velocity = scaled(-_SETTLING_1PS, add(velocity, (0.0, rate_y, rate_z)))
    turn = scaled(-_SETTLING_1PS, add(turn, (0.0, turning_y, turning_z)))
    in_pitch = _compliance(sizes, sch.PITCH, at[0], inverse_inertia[1], properties)
    in_yaw = _compliance(sizes, sch.YAW, at[0], inverse_inertia[2], properties)
    force_z, moment_y = _solved(in_pitch, velocity[2] - bent_z, turn[1] - turned_y)
    force_y, moment_z = _solved(in_yaw, velocity[1] - bent_y, turned_z - turn[2])
    held = (properties[sch.TOTAL_MASS] * velocity[0], force_y, force_z)
    apply_gimbal_load(sizes, properties, 0, (0.0, force_y, force_z, 0.0, moment_y, -moment_z), modes.force_N)
    couple = add(cross(at, held), (turn[0] / inverse_inertia[0], moment_y, -moment_z))
    return add(carried, held), add(about_cg, couple)


@kernel
def _clamp_spatial(
    sizes: Counts,
    earth: Earth,
    station_m: float,
    rotation: Matrix,
    offset: Vector,
    inverse_inertia: Symmetric,
    pad: Vector,
    force: Vector,
    moment: Vector,
    properties: Array,
    y: Array,
    work: Work,
) -> tuple[Vector, Vector]:
    """Return the same as `clamp_tail` for spatial modes."""
    modes, place = work.modes.spatial, sch.gimbal_place(sizes, 0)
    moved = spatial_motion(sizes, properties, place, modes.eta_m)
    straight = (properties[sch.CORE_CG] - station_m, -properties[sch.CORE_CG + 1], -properties[sch.CORE_CG + 2])
    at = add(straight, (moved[0], moved[1], moved[2]))
    carried, about_cg = _carried(sizes, pad, offset, properties, y, work)
    reaction = add(carried, scaled(-1.0, force))
    couple = add(add(about_cg, scaled(-1.0, moment)), scaled(-1.0, cross(at, reaction)))
    load = (reaction[0], reaction[1], reaction[2], couple[0], couple[1], couple[2])
    apply_spatial_load(sizes, properties, place, load, modes.force_N)

    free_spatial_accelerations(sizes, properties, modes)
    accel_mps2 = modes.accel_mps2
    for k in range(sizes.pendulums):
        u, shapes = vector_at(y, pendulum_index(sizes, k)), work.tank[k].shapes_along_rod
        spatial_along_rod(sizes, properties, sch.tank_place(k), u, accel_mps2, shapes)
        tension = -bob_mass(properties, k) * dot(pad, u)
        add_tension_to_spatial(sizes, properties, shapes, tension, accel_mps2)
    bent, rates = (
        spatial_motion(sizes, properties, place, modes.accel_mps2),
        spatial_motion(sizes, properties, place, modes.rate_mps),
    )
    velocity, turn = _over_ground(earth, rotation, at, y)
    velocity = scaled(-_SETTLING_1PS, add(velocity, (rates[0], rates[1], rates[2])))
    turn = scaled(-_SETTLING_1PS, add(turn, (rates[3], rates[4], rates[5])))
    system, first = work.system, sch.place_column(sizes, place, 0)
    inverse = sch.spatial_derived(sizes, sch.MODE_INVERSE_MASS)
    inverse_mass = properties[sch.schedule_width(sizes) + sch.INVERSE_CORE_MASS]
    for row in range(3):
        system.unknown[row], system.unknown[3 + row] = velocity[row] - bent[row], turn[row] - bent[3 + row]
    for column in range(6):  # accelerations of the tail by each component of the clamp's load
        push = (1.0 * (column == 0), 1.0 * (column == 1), 1.0 * (column == 2))
        twist = (1.0 * (column == 3), 1.0 * (column == 4), 1.0 * (column == 5))
        alpha = symmetric_times(inverse_inertia, add(cross(straight, push), twist))
        accel = add(scaled(inverse_mass, push), cross(alpha, straight))
        for row in range(6):
            total = accel[row] if row < 3 else alpha[row - 3]
            for i in range(sizes.spatial_modes):
                of_row, of_column = first + row * sizes.spatial_modes + i, first + column * sizes.spatial_modes + i
                total += properties[of_row] * properties[of_column] * properties[inverse + i]
            system.matrix[entry(row, column)] = total
    eliminate(6, system)
    held = (system.unknown[0], system.unknown[1], system.unknown[2])
    couple = (system.unknown[3], system.unknown[4], system.unknown[5])
    load = (held[0], held[1], held[2], couple[0], couple[1], couple[2])
    apply_spatial_load(sizes, properties, place, load, modes.force_N)
    return add(carried, held), add(about_cg, add(cross(straight, held), couple))


@kernel
def _carried(
    sizes: Counts, pad: Vector, offset: Vector, properties: Array, y: Array, work: Work
) -> tuple[Vector, Vector]:
    """Return force and moment (about the core CG) with which, and with hanging bobs, the body moves as the pad."""
    carried = scaled(properties[sch.CORE_MASS], pad)
    about_cg = cross(offset, carried)
    for k in range(sizes.pendulums):
        pull = _hanging(k, pad, properties, y, pendulum_index(sizes, k))
        tank = work.tank[k]
        carried = add(carried, scaled(-1.0, pull))
        hinge = add(vector_at(tank.hinge_m, 0), (0.0, tank.shift_m[1], tank.shift_m[2]))
        about_cg = add(about_cg, scaled(-1.0, cross(hinge, pull)))
    return carried, about_cg


@kernel
def _over_ground(earth: Earth, rotation: Matrix, at: Vector, y: Array) -> tuple[Vector, Vector]:
    """Return velocity and angular rate over the ground of a place `at` (from the CG) of the rigid body, B."""
    turn = add(vector_at(y, W_BI_B), scaled(-1.0, rotate_back(rotation, (0.0, 0.0, earth.rate_radps))))
    return add(rotate_back(rotation, velocity_over_ground(earth, y)), cross(turn, at)), turn


@kernel
def _hanging(tank: int, pad: Vector, properties: Array, y: Array, first: int) -> Vector:
    """Return the force that the rod of a bob at rest relative to the pad exerts on the body, in B, N."""
    u = vector_at(y, first)
    return scaled(-bob_mass(properties, tank) * dot(pad, u), u)


@kernel
def _compliance(
    sizes: Counts, plane: int, arm: float, inverse_inertia: float, properties: Array
) -> tuple[float, float, float]:
    """Return the acceleration of the tail per force, of its slope per force, and of its slope per moment.

    The slope is that over the station, which grows aft.
    """
    inverse_mass = properties[sch.schedule_width(sizes) + sch.INVERSE_CORE_MASS]
    move, both, turn = inverse_mass + arm * arm * inverse_inertia, -arm * inverse_inertia, inverse_inertia
    phi = sch.mode_column(sizes, plane, sch.gimbal_row(sizes, 0))
    slope = sch.mode_column(sizes, plane, sch.gimbal_row(sizes, 0) + 1)
    inverse = sch.derived_column(sizes, plane, sch.MODE_INVERSE_MASS)
    for i in range(sch.padded_modes(sizes)):
        move += properties[phi + i] * properties[phi + i] * properties[inverse + i]
        both += properties[phi + i] * properties[slope + i] * properties[inverse + i]
        turn += properties[slope + i] * properties[slope + i] * properties[inverse + i]
    return move, both, turn


@kernel
def _solved(compliance: tuple[float, float, float], accel: float, turn: float) -> tuple[float, float]:
    """Return the force and the moment that give the tail an acceleration and its slope an angular acceleration."""
    move, both, slope = compliance
    scale = 1.0 / (move * slope - both * both)
    return scale * (slope * accel - both * turn), scale * (move * turn - both * accel)
