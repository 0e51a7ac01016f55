"""The loads of boosters on the core at their attachments (docs/model.md, section 13).

Each booster is a rigid body. Its attachments balance its thrust, the forces of air and liquid on it, and its inertia.
"""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.kernel.jit import formula, kernel
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import find_interval, interpolate_into
from maxq.control.kernel.vectors import (
    Symmetric,
    Vector,
    add,
    cross,
    inertia_times,
    scaled,
    set_vector,
    symmetric_at,
    vector_at,
)
from maxq.sim.vehicle.air.kernel import air_acts
from maxq.sim.vehicle.block import W_BI_B, Counts
from maxq.sim.vehicle.body.kernel import plus_point
from maxq.sim.vehicle.derivative import StageRecord, gimbal_bend, moved_engine
from maxq.sim.vehicle.loads.columns import (
    AIR_FORCE,
    AIR_MOMENT,
    ALONG,
    ATTACHED,
    ATTACHED_INERTIA,
    BOOSTER_CG,
    BOOSTER_INERTIA,
    BOOSTER_MASS,
    BOOSTER_ROWS,
    BOOSTER_WIDTH,
    COUPLE_Y,
    COUPLE_Z,
    FIRST_Y,
    FIRST_Z,
    HELD,
    HELD_INERTIA,
    JOINT_WIDTH,
    LEAN_Y,
    LEAN_Y_INERTIA,
    LEAN_Z,
    LEAN_Z_INERTIA,
    MOVED_Y,
    MOVED_Z,
    SECOND_Y,
    SECOND_Z,
    SLOPE,
    SLOPE_INERTIA,
    SPATIAL_BOOSTER_ROWS,
    TWIST,
    Drivers,
    Loads,
    SectionLoad,
    add_loads,
    load_of_point,
    modes_of_planes,
)
from maxq.sim.vehicle.modes.planar import of_plane
from maxq.sim.vehicle.schedule import PITCH, TANK_HINGE, YAW, tank_column
from maxq.sim.vehicle.slosh.kernel import Slosh, bob_mass, pendulum_length
from maxq.sim.vehicle.state import N_PENDULUM, pendulum_index
from maxq.sim.vehicle.workspace import Evaluation, Work


@formula
def shape_column(loads: Loads, sizes: Counts, of_boosters: int, booster: int, plane: int, row: int) -> int:
    """Return the first column of a row of a booster's shapes in a plane (PITCH, YAW)."""
    modes = modes_of_planes(sizes)
    return of_boosters + BOOSTER_WIDTH * loads.boosters + ((2 * booster + plane) * BOOSTER_ROWS + row) * modes


@formula
def spatial_shape_column(loads: Loads, sizes: Counts, of_boosters: int, booster: int, row: int) -> int:
    """Return the first column of a row of a booster's shapes in the spatial modes."""
    first = shape_column(loads, sizes, of_boosters, loads.boosters, 0, 0)
    return first + (booster * SPATIAL_BOOSTER_ROWS + row) * sizes.spatial_modes


@formula
def joint_column(loads: Loads, sizes: Counts, of_boosters: int, booster: int) -> int:
    return spatial_shape_column(loads, sizes, of_boosters, loads.boosters, 0) + JOINT_WIDTH * booster


@kernel
def from_centre(centre: Vector, place: Vector) -> Vector:
    """Return the vector, B, between two places that are given by station, y and z."""
    return centre[0] - place[0], place[1] - centre[1], place[2] - centre[2]


@kernel
def relative_accel(rate: Vector, alpha: Vector, r: Vector) -> Vector:
    """Return the acceleration of a point of the rigid body relative to that of another, to which `r` leads from it."""
    return add(cross(alpha, r), cross(rate, cross(rate, r)))


@kernel
def without_boosters(
    loads: Loads, mass: float, centre: Vector, inertia: Symmetric, columns: Array, of_boosters: int
) -> tuple[float, Vector, Symmetric]:
    """Return mass, CG (station, y, z) and inertia about it of the core alone, from those of core and boosters."""
    left, first = mass, (0.0, 0.0, 0.0)  # the first moment is about the common CG
    for b in range(loads.boosters):
        c = of_boosters + BOOSTER_WIDTH * b
        own, place = columns[c + BOOSTER_MASS], from_centre(centre, vector_at(columns, c + BOOSTER_CG))
        of_booster = plus_point(symmetric_at(columns, c + BOOSTER_INERTIA), own, place)
        inertia = (
            inertia[0] - of_booster[0],
            inertia[1] - of_booster[1],
            inertia[2] - of_booster[2],
            inertia[3] - of_booster[3],
            inertia[4] - of_booster[4],
            inertia[5] - of_booster[5],
        )
        left -= own
        first = add(first, scaled(-own, place))
    r = scaled(1.0 / left, first)
    return left, (centre[0] - r[0], centre[1] + r[1], centre[2] + r[2]), plus_point(inertia, -left, r)


class Pull(NamedTuple):
    """A force and its moment about the first attachment of a booster on the core's axis, B."""

    force: Vector
    moment: Vector


@kernel
def _pulled(pull: Pull, arm: Vector, force: Vector) -> Pull:
    """Return the load with another force, to whose point `arm` leads from the attachment."""
    return Pull(add(pull.force, force), add(pull.moment, cross(arm, force)))


@kernel
def air_on_boosters(
    loads: Loads,
    vehicle: StageRecord,
    sizes: Counts,
    pool: Array,
    at: Evaluation,
    work: Work,
    columns: Array,
    of_boosters: int,
) -> None:
    """Write the force of the air on each booster, and its moment about the first attachment of the straight core."""
    aero, air = vehicle.aero, at.aux.air
    axial_at = joint_column(loads, sizes, of_boosters, loads.boosters)
    acts = air_acts(aero, air)
    if acts:
        k = find_interval(pool, loads.booster_axial, air.mach)
        interpolate_into(pool, loads.booster_axial, k, air.mach, columns, axial_at)
    u = air.flow_B_mps[0]
    push = -0.5 * air.density_kgpm3 * aero.area_m2 * aero.axial_factor * u * abs(u)
    for b in range(loads.boosters):
        pull, place_y, place_z = Pull((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), loads.axis_y_m[b], loads.axis_z_m[b]
        if acts:
            pull = _pulled(pull, (0.0, place_y, place_z), (push * columns[axial_at + b], 0.0, 0.0))
        for s in range(sizes.surfaces if acts else 0):
            surface = work.aero.surface[s]
            if loads.surface_booster[s] == b and surface.slope != 0.0:
                arm = (loads.held_m[b] - surface.slope_station_m / surface.slope, place_y, place_z)
                pull = _pulled(pull, arm, (0.0, surface.force_y_N, surface.force_z_N))
        joint = joint_column(loads, sizes, of_boosters, b)
        set_vector(columns, joint + AIR_FORCE, pull.force)
        set_vector(columns, joint + AIR_MOMENT, pull.moment)


@kernel
def join_boosters(
    loads: Loads,
    vehicle: StageRecord,
    sizes: Counts,
    d: Drivers,
    at: Evaluation,
    work: Work,
    columns: Array,
    of_boosters: int,
) -> None:
    """Write the loads of each booster on the core in place of those of the air on it (docs/model.md, 13.4)."""
    y, planar, m = at.y, work.modes.planar, modes_of_planes(sizes)
    rate, alpha = vector_at(y, W_BI_B), vector_at(at.aux.alpha_BI_B_radps2, 0)
    for b in range(loads.boosters):
        c, joint = of_boosters + BOOSTER_WIDTH * b, joint_column(loads, sizes, of_boosters, b)
        first_m = loads.held_m[b]
        moved_y, moved_z, turned_y, turned_z = 0.0, 0.0, 0.0, 0.0  # the attachment, and aft displacement per metre
        held_y, held_z, along_y, along_z = 0.0, 0.0, 0.0, 0.0  # accelerations without rigid motion, and per metre
        in_pitch = shape_column(loads, sizes, of_boosters, b, PITCH, 0)
        in_yaw = shape_column(loads, sizes, of_boosters, b, YAW, 0)
        for i in range(m):
            eta, xi = planar.eta_m[of_plane(PITCH) + i], planar.eta_m[of_plane(YAW) + i]
            bent_z = d.scale * (planar.accel_mps2[of_plane(PITCH) + i] + rate[0] * planar.nu_mps[of_plane(YAW) + i])
            bent_y = d.scale * (planar.accel_mps2[of_plane(YAW) + i] - rate[0] * planar.nu_mps[of_plane(PITCH) + i])
            moved_z += eta * columns[in_pitch + HELD * m + i]
            moved_y += xi * columns[in_yaw + HELD * m + i]
            turned_z += eta * columns[in_pitch + SLOPE * m + i]
            turned_y += xi * columns[in_yaw + SLOPE * m + i]
            held_z += bent_z * columns[in_pitch + HELD_INERTIA * m + i]
            held_y += bent_y * columns[in_yaw + HELD_INERTIA * m + i]
            along_z += bent_z * columns[in_pitch + SLOPE_INERTIA * m + i]
            along_y += bent_y * columns[in_yaw + SLOPE_INERTIA * m + i]
        turned, stretched, swung = (0.0, turned_y, turned_z), (0.0, 0.0, 0.0), (0.0, 0.0)
        if sizes.spatial_modes > 0:
            of_spatial = spatial_shape_column(loads, sizes, of_boosters, b, 0)
            held, turned, more, along, stretched, swung = _in_spatial_modes(
                sizes, d.scale, rate[0], alpha[0], work, columns, of_spatial, turned
            )
            moved_y, moved_z = moved_y + held[0], moved_z + held[1]
            held_y, held_z = held_y + more[0], held_z + more[1]
            along_y, along_z = along_y + along[0], along_z + along[1]
        pull = Pull(vector_at(columns, joint + AIR_FORCE), vector_at(columns, joint + AIR_MOMENT))
        mass, place = columns[c + BOOSTER_MASS], vector_at(columns, c + BOOSTER_CG)
        inertia = symmetric_at(columns, c + BOOSTER_INERTIA)
        aft = place[0] - first_m
        accel = add(d.accel, relative_accel(rate, alpha, from_centre(d.centre, place)))
        accel = add(accel, (0.0, held_y + aft * along_y, held_z + aft * along_z))
        if sizes.spatial_modes > 0:  # the motion along x, and that by rotation about x, of a CG off the axis
            along_x = stretched[0] + place[1] * stretched[1] + place[2] * stretched[2]
            aside_y, aside_z = -place[2] * swung[0] - place[1] * swung[1], place[1] * swung[0] - place[2] * swung[1]
            accel = add(accel, (along_x, aside_y, aside_z))
        pull = _pulled(pull, _on_booster(first_m, place, turned), scaled(-mass, accel))
        couple = add(inertia_times(inertia, alpha), cross(rate, inertia_times(inertia, rate)))
        couple = add(couple, scaled(-mass, d.spin))
        across = 0.5 * (inertia[1] + inertia[2])
        couple = add(couple, (0.0, across * along_z, -across * along_y))
        pull = Pull(pull.force, add(pull.moment, scaled(-1.0, couple)))
        for n in range(MAX_ENGINES):
            if loads.engine_booster[n] == b:
                pull = _with_engine(loads, vehicle, sizes, n, turned, d, rate, alpha, at, work, pull)
        for tank in range(sizes.pendulums):
            if loads.tank_booster[tank] == b:
                pull = _with_pendulum(vehicle.slosh, sizes, first_m, tank, turned, at, work, pull)
        force, moment, reach = pull.force, pull.moment, loads.second_m[b] - first_m
        second_y, second_z, couple_y, couple_z = 0.0, 0.0, moment[1], moment[2]
        if reach != 0.0:
            second_y, second_z, couple_y, couple_z = -moment[2] / reach, moment[1] / reach, 0.0, 0.0
        columns[joint + ALONG] = force[0]
        columns[joint + FIRST_Y], columns[joint + FIRST_Z] = force[1] - second_y, force[2] - second_z
        columns[joint + COUPLE_Y], columns[joint + COUPLE_Z] = couple_y, couple_z
        columns[joint + SECOND_Y], columns[joint + SECOND_Z] = second_y, second_z
        columns[joint + MOVED_Y], columns[joint + MOVED_Z] = moved_y, moved_z


@kernel
def _in_spatial_modes(
    sizes: Counts, scale: float, roll: float, roll_accel: float, work: Work, columns: Array, c: int, turned: Vector
) -> tuple[tuple[float, float], Vector, tuple[float, float], tuple[float, float], Vector, tuple[float, float]]:
    """Return the motion of a booster in the spatial modes, whose rows begin at `c` (docs/model.md, 13.3).

    - displacement y, z of the first attachment, and `turned` with twist and slopes;
    - accelerations without rigid motion: y, z of the first attachment, and their increase per metre aft;
    - acceleration along x, and per metre of offset in y and z;
    - acceleration by twist per metre of offset: across it, and towards the axis.
    """
    n, modes = sizes.spatial_modes, work.modes.spatial
    moved_y, moved_z, held_y, held_z, along_y, along_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    twist, lean_y, lean_z, spin, inward = turned[0], turned[1], turned[2], 0.0, 0.0
    stretch, stretch_y, stretch_z = 0.0, 0.0, 0.0
    for i in range(n):
        eta, first = modes.eta_m[i], c + i
        accel = modes.accel_mps2[i] - roll_accel * modes.turned_m[i] - roll * modes.turned_rate_mps[i]
        along = scale * (accel - roll * roll * eta)
        across = scale * (2.0 * roll * modes.rate_mps[i] + roll_accel * eta)
        moved_y += eta * columns[first + (ATTACHED + 1) * n]
        moved_z += eta * columns[first + (ATTACHED + 2) * n]
        twist += eta * columns[first + TWIST * n]
        lean_y += eta * columns[first + LEAN_Y * n]
        lean_z += eta * columns[first + LEAN_Z * n]
        y, z = columns[first + (ATTACHED_INERTIA + 1) * n], columns[first + (ATTACHED_INERTIA + 2) * n]
        held_y, held_z = held_y + (along * y - across * z), held_z + (along * z + across * y)
        y, z = columns[first + LEAN_Y_INERTIA * n], columns[first + LEAN_Z_INERTIA * n]
        along_y, along_z = along_y + (along * y - across * z), along_z + (along * z + across * y)
        stretch += scale * accel * columns[first + ATTACHED_INERTIA * n]
        stretch_y, stretch_z = stretch_y + scale * accel * y, stretch_z + scale * accel * z
        spin += along * columns[first + TWIST * n]
        inward += across * columns[first + TWIST * n]
    leaning, stretched = (twist, lean_y, lean_z), (stretch, stretch_y, stretch_z)
    return (moved_y, moved_z), leaning, (held_y, held_z), (along_y, along_z), stretched, (spin, inward)


@kernel
def _on_booster(first_m: float, place: Vector, turned: Vector) -> Vector:
    """Return the vector from the first attachment to a place (station, y, z) of the booster.

    `turned`: rotation of the booster about x, and its displacement along y and z per metre aft.
    """
    aft = place[0] - first_m
    return -aft, place[1] + aft * turned[1] - turned[0] * place[2], place[2] + aft * turned[2] + turned[0] * place[1]


@kernel
def _with_engine(
    loads: Loads,
    vehicle: StageRecord,
    sizes: Counts,
    n: int,
    turned: Vector,
    d: Drivers,
    rate: Vector,
    alpha: Vector,
    at: Evaluation,
    work: Work,
    pull: Pull,
) -> Pull:
    """Return the load on a booster with that of engine n of the vehicle: thrust, and inertia of its deflection."""
    e, k = vehicle.engine, vehicle.engine.taken_as[n]
    share, first_m = 1.0 / e.parts[k], loads.held_m[loads.engine_booster[n]]
    engine = moved_engine(e, vehicle.sizes, k, at.properties, at.aux)
    place = (e.gimbal_station_m[k], loads.engine_y_m[n], loads.engine_z_m[n])
    gimbal, axis = _on_booster(first_m, place, turned), engine.axis
    if vehicle.follower_thrust == 1:
        bend = gimbal_bend(sizes, at.properties, e.gimbal[k], work.modes)
        axis = add(axis, cross((bend.twist, bend.slope_y, bend.slope_z), axis))
    thrust = scaled(share * at.aux.engines.thrust_N[k], axis)
    pull = _pulled(pull, gimbal, thrust)
    pull = Pull(pull.force, add(pull.moment, scaled(e.roll_arm_m[k], thrust)))
    mass, inertia, arm = share * e.gimballed_mass_kg[k], share * e.inertia_kgm2[k], e.cg_from_gimbal_m[k]
    if mass > 0.0 or inertia > 0.0:  # the engine at rest is part of the booster's mass
        place = (place[0] + arm * e.rest_x[k], place[1] - arm * e.rest_y[k], place[2] - arm * e.rest_z[k])
        rest = _on_booster(first_m, place, turned)
        accel = add(d.accel, relative_accel(rate, alpha, from_centre(d.centre, place)))
        pull = _pulled(pull, rest, scaled(mass, accel))
        accel = add(accel, relative_accel(rate, alpha, engine.delta))
        accel = add(accel, add(engine.delta_accel, scaled(2.0, cross(rate, engine.delta_rate))))
        pull = _pulled(pull, add(rest, engine.delta), scaled(-mass, accel))
        turning = add(engine.relative_accel, cross(rate, engine.relative_rate))
        pull = Pull(pull.force, add(pull.moment, scaled(-inertia, turning)))
    return pull


@kernel
def _with_pendulum(
    slosh: Slosh, sizes: Counts, first_m: float, tank: int, turned: Vector, at: Evaluation, work: Work, pull: Pull
) -> Pull:
    """Return the load on a booster with that of a pendulum: the rod's tension at its hinge, the damper at the bob."""
    own, first = work.tank[tank], pendulum_index(sizes, 0) + N_PENDULUM * tank
    u, tension = vector_at(at.y, first), work.system.unknown[tank]
    length, hinge = pendulum_length(at.properties, tank), at.properties[tank_column(tank) + TANK_HINGE]
    place = _on_booster(first_m, (hinge, slosh.place_y_m[tank], slosh.place_z_m[tank]), turned)
    pull = _pulled(pull, place, scaled(tension, u))
    along = -bob_mass(at.properties, tank) * own.damping_mps2[0]
    return _pulled(pull, add(place, scaled(length, u)), (along, own.damper_force_N[1], own.damper_force_N[2]))


@kernel
def load_of_booster(
    loads: Loads, b: int, station: float, shift_y: float, shift_z: float, columns: Array, joint: int
) -> SectionLoad:
    """Return the loads of a booster's attachments forward of a station."""
    total = (0.0, 0.0, 0.0, 0.0, 0.0)
    if loads.held_m[b] <= station:
        force = vector_at(columns, joint + ALONG)
        aside_y, aside_z = columns[joint + MOVED_Y] - shift_y, columns[joint + MOVED_Z] - shift_z
        total = load_of_point(station, loads.held_m[b], force, aside_y, aside_z)
        total = add_loads(total, (0.0, 0.0, 0.0, columns[joint + COUPLE_Y], columns[joint + COUPLE_Z]))
    if loads.second_m[b] <= station:
        force = (0.0, columns[joint + SECOND_Y], columns[joint + SECOND_Z])
        total = add_loads(total, load_of_point(station, loads.second_m[b], force, 0.0, 0.0))
    return total
