"""Section loads: axial force, shear and bending moment at stations of the body axis, by summation of forces.

The load at a station is the sum of all forces forward of it: aerodynamic, pendulum, injected and inertial forces. The
inertial forces are those of the line mass under the computed accelerations, including those of the modes
(docs/model.md, section 13). Section loads do not influence the flight. They are evaluated between steps, at a separate
rate, from the contents of `aux` and `work` after the derivative. Without stations they cost one comparison per step.

Signs are those of the loads on the part forward of the cut. Axial force is positive in tension, and shear along +y, +z.
The bending moment about +y is positive if it turns the nose up, so that it compresses the -z side (a beam with x
forward and z down sags). The moment about +z is positive if it turns the nose to the right, so that it compresses the
+y side.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import PitchYaw
from maxq.control.kernel.tables import find_interval, interpolate_into
from maxq.control.kernel.vectors import Vector, add, cross, inertia_times, scaled, symmetric_at, vector_at
from maxq.sim.vehicle.air.kernel import SurfaceLoad, air_acts
from maxq.sim.vehicle.block import W_BI_B, Counts, counts
from maxq.sim.vehicle.body.kernel import coriolis_of_outflow
from maxq.sim.vehicle.derivative import StageInputs, StageRecord
from maxq.sim.vehicle.loads.boosters import (
    air_on_boosters,
    from_centre,
    join_boosters,
    joint_column,
    load_of_booster,
    relative_accel,
    without_boosters,
)
from maxq.sim.vehicle.loads.columns import (
    AIR_FORCE,
    AIR_MOMENT,
    AXIAL,
    AXIAL_FIRST,
    AXIAL_MASS,
    AXIAL_MOMENT,
    DISPLACEMENT,
    FIRST,
    INERTIA,
    INERTIA_MOMENT,
    LIMITS,
    MASS,
    MODE_ROWS,
    MOMENT_Y,
    MOMENT_Z,
    N_KINDS,
    RADIUS,
    SECOND,
    SECTION_WIDTH,
    SHEAR_Y,
    SHEAR_Z,
    STATION_MODES,
    STATIONS,
    TOTAL_FIRST,
    TOTAL_MASS,
    TOTAL_SECOND,
    Drivers,
    Loads,
    SectionLoad,
    SectionLoads,
    add_loads,
    extreme_index,
    load_of_point,
    modes_of_planes,
    station_width,
)
from maxq.sim.vehicle.modes.planar import of_plane
from maxq.sim.vehicle.schedule import CORE_CG, CORE_INERTIA, CORE_MASS, PITCH, TANK_HINGE, YAW, tank_column
from maxq.sim.vehicle.slosh.kernel import bob_mass, pendulum_length
from maxq.sim.vehicle.state import N_PENDULUM, pendulum_index
from maxq.sim.vehicle.workspace import Evaluation, Work


@routine
def evaluate_sections(
    loads: Loads,
    vehicle: StageRecord,
    inputs: StageInputs,
    pool: Array,
    clock_s: float,
    at: Evaluation,
    work: Work,
    columns: Array,
    out: SectionLoads,
) -> tuple[float, float]:
    """Write the loads at all stations to `out.section`, right after the derivative at `at`.

    `columns` is scratch memory. Return mass and CG station of the core without boosters.
    """
    sizes = counts(vehicle.sizes)
    interpolate_into(pool, loads.table, find_interval(pool, loads.table, clock_s), clock_s, columns, 0)
    width = station_width(sizes, loads.alike)
    roll = at.y[W_BI_B]
    of_boosters = STATIONS + width * loads.stations
    if loads.boosters > 0:
        k = find_interval(pool, loads.booster_table, clock_s)
        interpolate_into(pool, loads.booster_table, k, clock_s, columns, of_boosters)
        air_on_boosters(loads, vehicle, sizes, pool, at, work, columns, of_boosters)
    drivers = _drivers(loads, vehicle, sizes, at, work, columns, of_boosters)
    if loads.boosters > 0:
        join_boosters(loads, vehicle, sizes, drivers, at, work, columns, of_boosters)
    for n in range(loads.stations):
        station, c = loads.station_m[n], STATIONS + width * n
        total, shift_y, shift_z = _inertia(sizes, loads.alike, drivers, station, roll, work, columns, c)
        if sizes.spatial_modes > 0:
            more, moved_y, moved_z = _spatial_inertia(
                sizes, loads.alike, drivers, roll, at.aux.alpha_BI_B_radps2[0], work, columns, c
            )
            total, shift_y, shift_z = add_loads(total, more), shift_y + moved_y, shift_z + moved_z
        total = add_loads(total, _aerodynamic(loads, drivers, station, shift_y, shift_z, work))
        for tank in range(sizes.pendulums):
            if loads.tank_booster[tank] < 0:
                total = add_loads(total, _of_pendulum(loads, vehicle, sizes, tank, station, shift_y, shift_z, at, work))
        for b in range(loads.boosters):
            joint = joint_column(loads, sizes, of_boosters, b)
            total = add_loads(total, load_of_booster(loads, b, station, shift_y, shift_z, columns, joint))
        centre = drivers.centre
        if centre[0] <= station:
            force = (inputs.force_x_N, inputs.force_y_N, inputs.force_z_N)
            injected = load_of_point(station, centre[0], force, centre[1] - shift_y, centre[2] - shift_z)
            total = add_loads(total, injected)
            total = (total[0], total[1], total[2], total[3] + inputs.torque_y_Nm, total[4] + inputs.torque_z_Nm)
        for s in range(sizes.buffets):
            if vehicle.buffet.station_m[s] <= station:
                force = (0.0, at.aux.buffet_N[2 * s + 1], at.aux.buffet_N[2 * s])
                total = add_loads(total, load_of_point(station, vehicle.buffet.station_m[s], force, 0.0, 0.0))
        first = SECTION_WIDTH * n
        for j in range(SECTION_WIDTH):
            out.section[first + j] = total[j]
    return drivers.mass, drivers.cg[0]


@kernel
def _drivers(
    loads: Loads, vehicle: StageRecord, sizes: Counts, at: Evaluation, work: Work, columns: Array, of_boosters: int
) -> Drivers:
    """Return the inertial forces on the line mass, which has the momentum of the core.

    They have the rates of momentum and angular momentum of the core. The difference between the rate of angular
    momentum and that of the transverse motion alone, which is due to the rotation of the sections, becomes a uniform
    moment per kilogram.
    """
    properties, y, _, aux = at
    whole, centre, rate = properties[CORE_MASS], vector_at(properties, CORE_CG), vector_at(y, W_BI_B)
    alpha, accel = vector_at(aux.alpha_BI_B_radps2, 0), vector_at(aux.specific_force_B_mps2, 0)
    air_force, air_moment = vector_at(aux.aero_force_B_N, 0), vector_at(aux.aero_moment_B_Nm, 0)
    spin = (0.0, 0.0, 0.0)
    if vehicle.jet_damping == 1:  # the propellant's Coriolis force is spread over the mass
        jet_force, jet_moment = coriolis_of_outflow(sizes, rate, properties)
        accel = add(accel, scaled(-1.0 / whole, jet_force))
        spin = scaled(1.0 / whole, jet_moment)
    mass, cg, inertia, core_accel = whole, centre, symmetric_at(properties, CORE_INERTIA), accel
    if loads.boosters > 0:
        mass, cg, inertia = without_boosters(loads, whole, centre, inertia, columns, of_boosters)
        core_accel = add(accel, relative_accel(rate, alpha, from_centre(centre, cg)))
        for b in range(loads.boosters):
            air = joint_column(loads, sizes, of_boosters, b)
            force = vector_at(columns, air + AIR_FORCE)
            first = (centre[0] - loads.held_m[b], -centre[1], -centre[2])
            air_force = add(air_force, scaled(-1.0, force))
            moment = add(vector_at(columns, air + AIR_MOMENT), cross(first, force))
            air_moment = add(air_moment, scaled(-1.0, moment))
    momentum_rate = add(inertia_times(inertia, alpha), cross(rate, inertia_times(inertia, rate)))
    if vehicle.jet_damping == 1:
        momentum_rate = add(momentum_rate, scaled(-mass, spin))
    p, q, r = rate
    per_m = (q * q + r * r, -alpha[2] - p * q, alpha[1] - p * r)
    total, first_moment, second = columns[TOTAL_MASS], columns[TOTAL_FIRST], columns[TOTAL_SECOND]
    scale = mass / total
    lever = scale * (total * cg[0] - first_moment)
    turning = scale * (total * cg[0] * cg[0] - 2.0 * cg[0] * first_moment + second)
    force = scaled(-1.0, core_accel)
    moment_y = -momentum_rate[1] + lever * force[2] + turning * per_m[2]
    moment_z = -momentum_rate[2] - lever * force[1] - turning * per_m[1]
    surfaces = sizes.surfaces if air_acts(vehicle.aero, aux.air) else 0
    spread = _spread(loads, surfaces, centre, air_force, air_moment, work)
    moments = (moment_y / mass, moment_z / mass)
    return Drivers(mass, scale, cg, force, per_m, moments, surfaces, spread, air_force[0], centre, accel, spin)


@kernel
def _spread(
    loads: Loads, surfaces: int, cg: Vector, force: Vector, moment: Vector, work: Work
) -> tuple[float, float, float, float]:
    """Return the lateral force per metre, linear along the body, of the force and moment not due to the lifting parts.

    The remainder is due to cross-flow, damping and the coefficients of the whole vehicle. `force` and `moment` about
    `cg` are those of the air on the core.
    """
    force_y, force_z = force[1], force[2]
    # first moments about the body's nose; the axial force acts on the body axis, not at the CG
    arm = cg[0] - loads.nose_m
    first_y = arm * force_y - (moment[2] - cg[1] * force[0])
    first_z = arm * force_z + (moment[1] + cg[2] * force[0])
    for s in range(surfaces):
        if loads.surface_booster[s] >= 0:
            continue
        surface = work.aero.surface[s]
        place = _surface_station(loads, surface) - loads.nose_m
        force_y -= surface.force_y_N
        force_z -= surface.force_z_N
        first_y -= place * surface.force_y_N
        first_z -= place * surface.force_z_N
    length = loads.tail_m - loads.nose_m
    per, square = 1.0 / length, 1.0 / (length * length)
    slope_y = (12.0 * first_y * per - 6.0 * force_y) * square
    slope_z = (12.0 * first_z * per - 6.0 * force_z) * square
    return force_y * per - 0.5 * slope_y * length, slope_y, force_z * per - 0.5 * slope_z * length, slope_z


@kernel
def _surface_station(loads: Loads, surface: SurfaceLoad) -> float:
    """Return the station at which the force of a lifting part acts, limited to the body.

    The limit is needed because a slope near zero can have its centre anywhere.
    """
    if surface.slope == 0.0:
        return loads.tail_m
    place: float = surface.slope_station_m / surface.slope
    return min(max(place, loads.nose_m), loads.tail_m)


@kernel
def _inertia(
    sizes: Counts, alike: int, d: Drivers, station: float, roll: float, work: Work, columns: Array, c: int
) -> tuple[SectionLoad, float, float]:
    """Return the inertial loads forward of a station, and its displacement by bending (y, z, m)."""
    mass, first, second = d.scale * columns[c + MASS], d.scale * columns[c + FIRST], d.scale * columns[c + SECOND]
    hung, hung_first = d.scale * columns[c + AXIAL_MASS], d.scale * columns[c + AXIAL_FIRST]
    lever = mass * d.cg[0] - first  # integral of m (x_cg - x)
    # integrals of m (x_s - x) and m (x_s - x) (x_cg - x)
    arm, spin = station * mass - first, station * d.cg[0] * mass - (station + d.cg[0]) * first + second
    axial = d.force[0] * hung + d.per_m[0] * (hung * d.cg[0] - hung_first)
    shear_y, shear_z = d.force[1] * mass + d.per_m[1] * lever, d.force[2] * mass + d.per_m[2] * lever
    moment_y = -(d.force[2] * arm + d.per_m[2] * spin) + d.moment[0] * mass
    moment_z = d.force[1] * arm + d.per_m[1] * spin + d.moment[1] * mass
    m, planar = modes_of_planes(sizes), work.modes.planar
    in_pitch = c + STATION_MODES
    in_yaw = in_pitch + (1 - alike) * MODE_ROWS * m
    shift_y, shift_z = 0.0, 0.0
    aside_y, aside_z = 0.0, 0.0  # mass times displacement by bending relative to the cut, of the supported mass
    for i in range(m):
        eta, xi = planar.eta_m[of_plane(PITCH) + i], planar.eta_m[of_plane(YAW) + i]
        along_z = d.scale * (planar.accel_mps2[of_plane(PITCH) + i] + roll * planar.nu_mps[of_plane(YAW) + i])
        along_y = d.scale * (planar.accel_mps2[of_plane(YAW) + i] - roll * planar.nu_mps[of_plane(PITCH) + i])
        shear_z -= along_z * columns[in_pitch + INERTIA * m + i]
        shear_y -= along_y * columns[in_yaw + INERTIA * m + i]
        moment_y += along_z * columns[in_pitch + INERTIA_MOMENT * m + i]
        moment_z -= along_y * columns[in_yaw + INERTIA_MOMENT * m + i]
        aside_z += d.scale * eta * columns[in_pitch + AXIAL_MOMENT * m + i]
        aside_y += d.scale * xi * columns[in_yaw + AXIAL_MOMENT * m + i]
        shift_z += eta * columns[in_pitch + DISPLACEMENT * m + i]
        shift_y += xi * columns[in_yaw + DISPLACEMENT * m + i]
    moment_y += d.cg[2] * axial + aside_z * d.force[0]
    moment_z -= d.cg[1] * axial + aside_y * d.force[0]
    return (axial, shear_y, shear_z, moment_y, moment_z), shift_y, shift_z


@kernel
def _spatial_inertia(
    sizes: Counts, alike: int, d: Drivers, roll: float, roll_accel: float, work: Work, columns: Array, c: int
) -> tuple[SectionLoad, float, float]:
    """Return the contribution of the spatial modes to `_inertia` (docs/model.md, 13.3)."""
    n, first = sizes.spatial_modes, c + STATION_MODES + (2 - alike) * MODE_ROWS * modes_of_planes(sizes)
    axial, shear_y, shear_z, moment_y, moment_z = 0.0, 0.0, 0.0, 0.0, 0.0
    shift_y, shift_z, aside_y, aside_z, modes = 0.0, 0.0, 0.0, 0.0, work.modes.spatial
    for i in range(n):
        eta, rate = modes.eta_m[i], modes.rate_mps[i]
        # Second derivative of the modal coordinate itself; the quasi-velocities include the roll rate.
        accel = modes.accel_mps2[i] - roll_accel * modes.turned_m[i] - roll * modes.turned_rate_mps[i]
        along, across = d.scale * (accel - roll * roll * eta), d.scale * (2.0 * roll * rate + roll_accel * eta)
        in_z, in_y = first + i, first + MODE_ROWS * n + i
        axial -= d.scale * accel * columns[first + 2 * MODE_ROWS * n + i]
        inertia_z, inertia_y = columns[in_z + INERTIA * n], columns[in_y + INERTIA * n]
        shear_z -= along * inertia_z + across * inertia_y
        shear_y -= along * inertia_y - across * inertia_z
        about_y, about_z = columns[in_z + INERTIA_MOMENT * n], columns[in_y + INERTIA_MOMENT * n]
        moment_y += along * about_y + across * about_z
        moment_z -= along * about_z - across * about_y
        aside_z += d.scale * eta * columns[in_z + AXIAL_MOMENT * n]
        aside_y += d.scale * eta * columns[in_y + AXIAL_MOMENT * n]
        shift_z += eta * columns[in_z + DISPLACEMENT * n]
        shift_y += eta * columns[in_y + DISPLACEMENT * n]
    moment_y += d.cg[2] * axial + aside_z * d.force[0]
    moment_z -= d.cg[1] * axial + aside_y * d.force[0]
    return (axial, shear_y, shear_z, moment_y, moment_z), shift_y, shift_z


@kernel
def _aerodynamic(loads: Loads, d: Drivers, station: float, shift_y: float, shift_z: float, work: Work) -> SectionLoad:
    """Return the aerodynamic loads forward of a station.

    Lifting parts act at their stations, the axial force acts at its points, and the remainder is spread over the body.
    """
    x = min(max(station - loads.nose_m, 0.0), loads.tail_m - loads.nose_m)
    beyond = station - loads.nose_m - x
    constant_y, slope_y, constant_z, slope_z = d.spread
    shear_y, shear_z = (constant_y + 0.5 * slope_y * x) * x, (constant_z + 0.5 * slope_z * x) * x
    moment_z = (constant_y / 2.0 + slope_y * x / 6.0) * x * x + beyond * shear_y
    moment_y = -(constant_z / 2.0 + slope_z * x / 6.0) * x * x - beyond * shear_z
    total = (0.0, shear_y, shear_z, moment_y, moment_z)
    for s in range(d.surfaces):
        if loads.surface_booster[s] >= 0:
            continue
        surface = work.aero.surface[s]
        place = _surface_station(loads, surface)
        if place <= station:
            total = add_loads(
                total, load_of_point(station, place, (0.0, surface.force_y_N, surface.force_z_N), 0.0, 0.0)
            )
    for k in range(loads.axial_points):
        if loads.axial_m[k] <= station:
            force = (loads.axial_share[k] * d.drag_N, 0.0, 0.0)
            total = add_loads(total, load_of_point(station, loads.axial_m[k], force, -shift_y, -shift_z))
    return total


@kernel
def _of_pendulum(
    loads: Loads,
    vehicle: StageRecord,
    sizes: Counts,
    tank: int,
    station: float,
    shift_y: float,
    shift_z: float,
    at: Evaluation,
    work: Work,
) -> SectionLoad:
    """Return the load of a pendulum.

    The rod acts at its hinge (laterally) and at the bottom of the tank (axially), and the damper's force acts at the
    bob.
    """
    own, y = work.tank[tank], at.y
    first = pendulum_index(sizes, 0) + N_PENDULUM * tank
    u, pull = vector_at(y, first), work.system.unknown[tank]
    hinge = at.properties[tank_column(tank) + TANK_HINGE]
    length = pendulum_length(at.properties, tank)
    aside_y, aside_z = own.shift_m[1] - shift_y, own.shift_m[2] - shift_z
    total = (0.0, 0.0, 0.0, 0.0, 0.0)
    if hinge <= station:
        total = load_of_point(station, hinge, (0.0, pull * u[1], pull * u[2]), 0.0, 0.0)
    if max(hinge, loads.bottom_m[tank]) <= station:
        total = add_loads(total, load_of_point(station, hinge, (pull * u[0], 0.0, 0.0), aside_y, aside_z))
    bob = hinge - length * u[0]
    if bob <= station:
        along = -bob_mass(at.properties, tank) * own.damping_mps2[0]
        force = (along, own.damper_force_N[1], own.damper_force_N[2])
        total = add_loads(total, load_of_point(station, bob, force, aside_y + length * u[1], aside_z + length * u[2]))
    return total


@routine
def gather_sections(
    loads: Loads, sizes: Counts, stage: int, now_ns: int, mass: float, cg_m: float, columns: Array, out: SectionLoads
) -> None:
    """Update the extremes of `stage` with `out.section`, evaluated with `columns`.

    `mass` (kg) and `cg_m` (station) are those of the core, with which the line mass is compared.
    """
    total = columns[TOTAL_MASS]
    apart = abs(columns[TOTAL_FIRST] / total - cg_m) / (loads.tail_m - loads.nose_m)
    mismatch = max(abs(total / mass - 1.0), apart)
    if mismatch > out.mismatch:
        out.mismatch, out.mismatch_ns = mismatch, now_ns
    width = station_width(sizes, loads.alike)
    for n in range(loads.stations):
        first, c = SECTION_WIDTH * n, STATIONS + width * n
        axial = out.section[first + AXIAL]
        shear = math.hypot(out.section[first + SHEAR_Y], out.section[first + SHEAR_Z])
        bending = math.hypot(out.section[first + MOMENT_Y], out.section[first + MOMENT_Z])
        radius = columns[c + RADIUS]
        edge = 2.0 * bending / radius if radius > 0.0 else math.nan
        values = (-axial, axial, shear, bending, edge - axial, edge + axial)
        for kind in range(N_KINDS):
            e, limit = extreme_index(stage, kind, n), columns[c + LIMITS + kind]
            if values[kind] > out.value[e]:
                out.value[e], out.value_ns[e] = values[kind], now_ns
            if limit > 0.0 and values[kind] > limit * out.ratio[e]:
                out.ratio[e], out.ratio_ns[e] = values[kind] / limit, now_ns


class SectionRow(NamedTuple):
    """The log row of the loads at one station."""

    section_place_axial_N: Annotated[float, "N", "axial force, tension positive"]
    section_place_shear_axis_N: Annotated[PitchYaw, "N", "shear of the forces forward of it, along +z, +y"]
    section_place_bending_axis_Nm: Annotated[PitchYaw, "N m", "bending moment of the forces forward of it about +y, +z"]


@kernel
def section_row(out: SectionLoads, stations: int, station: int) -> SectionRow:
    """Return the row of a station; all values are nan if the stage has fewer stations."""
    if station >= stations:
        nothing = PitchYaw(math.nan, math.nan)
        return SectionRow(math.nan, nothing, nothing)
    c = SECTION_WIDTH * station
    return SectionRow(
        section_place_axial_N=out.section[c + AXIAL],
        section_place_shear_axis_N=PitchYaw(out.section[c + SHEAR_Z], out.section[c + SHEAR_Y]),
        section_place_bending_axis_Nm=PitchYaw(out.section[c + MOMENT_Y], out.section[c + MOMENT_Z]),
    )
