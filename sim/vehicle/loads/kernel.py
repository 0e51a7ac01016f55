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
from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import formula, kernel, routine
from maxq.control.kernel.limits import (
    MAX_BOOSTERS,
    MAX_ENGINES,
    MAX_LOAD_STATIONS,
    MAX_MODES,
    MAX_PENDULUMS,
    MAX_STAGES,
    MAX_SURFACES,
)
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import PitchYaw
from maxq.control.kernel.tables import TableRef, find_interval, interpolate_into
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
from maxq.sim.vehicle.air.kernel import SurfaceLoad, air_acts
from maxq.sim.vehicle.block import W_BI_B, Counts, counts
from maxq.sim.vehicle.body.kernel import coriolis_of_outflow, plus_point
from maxq.sim.vehicle.derivative import StageInputs, StageRecord, gimbal_bend, moved_engine
from maxq.sim.vehicle.modes.planar import of_plane
from maxq.sim.vehicle.schedule import CORE_CG, CORE_INERTIA, CORE_MASS, PITCH, TANK_HINGE, YAW, tank_column
from maxq.sim.vehicle.slosh.kernel import Slosh, bob_mass, pendulum_length
from maxq.sim.vehicle.state import N_PENDULUM, pendulum_index
from maxq.sim.vehicle.workspace import Evaluation, Work

# Quantities with limits, in the order of the extremes and of a station's limits. Shears and moments are magnitudes over
# both planes.
KINDS = ("compression", "tension", "shear", "bending_moment", "equivalent_compression", "equivalent_tension")
COMPRESSION, TENSILE, SHEAR, BENDING, EQUIVALENT_COMPRESSION, EQUIVALENT_TENSION = range(6)
N_KINDS = len(KINDS)

# Columns of the table over time: those of the whole line mass, then those of every station.
TOTAL_MASS, TOTAL_FIRST, TOTAL_SECOND = 0, 1, 2  # of the whole line mass: kg, kg m, kg m2 about the nose
STATIONS = 3
MASS, FIRST, SECOND = 0, 1, 2  # of the parts forward of the station
AXIAL_MASS = 3  # mass supported by the body forward of the station; liquid is supported by the bottom of its tank
AXIAL_FIRST = 4
RADIUS = 5  # radius of the equivalent axial load, m; 0: none
LIMITS = 6  # limit of each kind; 0: none
STATION_MODES = LIMITS + N_KINDS
# Then for each plane (once if both planes have the same modes) rows of `modes_of_planes` modes:
INERTIA, INERTIA_MOMENT, AXIAL_MOMENT, DISPLACEMENT = 0, 1, 2, 3
MODE_ROWS = 4
# Then for the spatial modes the same rows for the motion along z and along y, and the inertia along x.
SPATIAL_ROWS = 2 * MODE_ROWS + 1
# Columns of a booster: mass, CG (station, y, z) and inertia about it, as the schedule's for the core
BOOSTER_MASS, BOOSTER_CG, BOOSTER_INERTIA = 0, 1, 4
BOOSTER_WIDTH = 10
# then for each booster and plane rows of `modes_of_planes` modes: the shape at the first attachment and the booster's
# slope, as they are and without rigid motion
HELD, SLOPE, HELD_INERTIA, SLOPE_INERTIA = 0, 1, 2, 3
BOOSTER_ROWS = 4
# then for each booster its loads on the core, in scratch memory only
ALONG, FIRST_Y, FIRST_Z, COUPLE_Y, COUPLE_Z, SECOND_Y, SECOND_Z, MOVED_Y, MOVED_Z = range(9)
AIR_FORCE, AIR_MOMENT = 0, 3  # of the air on the booster, before its loads on the core are known
JOINT_WIDTH = 9
MAX_BOOSTER_COLUMNS = MAX_BOOSTERS * (BOOSTER_WIDTH + 2 * BOOSTER_ROWS * MAX_MODES + JOINT_WIDTH)
MAX_LOAD_COLUMNS = STATIONS + MAX_LOAD_STATIONS * (STATION_MODES + (2 * MODE_ROWS + SPATIAL_ROWS) * MAX_MODES)
MAX_LOAD_COLUMNS += MAX_BOOSTER_COLUMNS

# The loads of a section, in adjacent elements.
AXIAL, SHEAR_Y, SHEAR_Z, MOMENT_Y, MOMENT_Z = range(5)
SECTION_WIDTH = 5
_EXTREMES = N_KINDS * MAX_LOAD_STATIONS  # number of extremes of a stage
MAX_EXTREMES = MAX_STAGES * _EXTREMES


@dataclass(frozen=True)
class Loads:
    """The load stations of a stage, and the data for distributing its forces."""

    stations: int  # 0: no section loads
    period_ns: int
    coast: int  # 1: extremes are also gathered without thrust
    alike: int  # 1: both planes have the same modes
    table: TableRef  # over the stage clock, columns as above
    nose_m: float  # ends of the body, over which the rest of the aerodynamic force is spread
    tail_m: float
    station_m: Annotated[Array, (MAX_LOAD_STATIONS,)]
    bottom_m: Annotated[Array, (MAX_PENDULUMS,)]  # station at which the body supports the liquid of a tank
    axial_points: int  # number of points at which the axial aerodynamic force acts
    axial_m: Annotated[Array, (MAX_SURFACES,)]
    axial_share: Annotated[Array, (MAX_SURFACES,)]
    boosters: int
    booster_table: TableRef  # over the schedule's clock, columns as above
    booster_axial: TableRef  # over Mach number: CA of each booster
    held_m: Annotated[Array, (MAX_BOOSTERS,)]  # stations of the attachments of each booster
    second_m: Annotated[Array, (MAX_BOOSTERS,)]  # as `held_m` for a booster with one attachment
    axis_y_m: Annotated[Array, (MAX_BOOSTERS,)]
    axis_z_m: Annotated[Array, (MAX_BOOSTERS,)]
    engine_booster: Annotated[IntArray, (MAX_ENGINES,)]  # for each engine of the vehicle its booster; -1: the core
    engine_y_m: Annotated[Array, (MAX_ENGINES,)]
    engine_z_m: Annotated[Array, (MAX_ENGINES,)]
    tank_booster: Annotated[IntArray, (MAX_PENDULUMS,)]
    surface_booster: Annotated[IntArray, (MAX_SURFACES + 1,)]


@dataclass
class SectionLoads:
    """The loads at the stations at the last evaluation, and their extremes so far."""

    at_ns: int  # time of `section`
    due_ns: int  # time of the next evaluation for the extremes
    mismatch: float  # largest relative difference between line mass and core so far
    mismatch_ns: int
    section: Annotated[Array, (SECTION_WIDTH * MAX_LOAD_STATIONS,)]
    value: Annotated[Array, (MAX_EXTREMES,)]  # stage by stage, kind by kind, station by station
    value_ns: Annotated[IntArray, (MAX_EXTREMES,)]
    ratio: Annotated[Array, (MAX_EXTREMES,)]  # ratio to the limit
    ratio_ns: Annotated[IntArray, (MAX_EXTREMES,)]


class Drivers(NamedTuple):
    """The inertial forces on the line mass at an instant: forces per kilogram (minus the acceleration), in B.

    At a station x they are (x, y, z) + (x_per_m, y_per_m, z_per_m) (x_cg - x). The moments y, z are per kilogram.
    The core is without boosters.
    """

    mass: float  # of the core, kg
    scale: float  # factor of the line mass: the core's mass over its sum
    cg: Vector  # station, y, z of the core's CG
    force: Vector
    per_m: Vector
    moment: tuple[float, float]
    surfaces: int  # number of lifting parts with aerodynamic loads
    spread: tuple[float, float, float, float]  # lateral force per metre: constant and slope along the body, y and z
    drag_N: float  # axial aerodynamic force on the core
    centre: Vector  # station, y, z of the CG of core and boosters
    accel: Vector  # specific force there, with the outflow's share
    spin: Vector  # moment of the outflow per kilogram


@formula
def extreme_index(stage: int, kind: int, station: int) -> int:
    return (stage * N_KINDS + kind) * MAX_LOAD_STATIONS + station


@kernel
def modes_of_planes(sizes: Counts) -> int:
    """Return the number of modes in each row of a station's columns."""
    return max(sizes.pitch_modes, sizes.yaw_modes)


@kernel
def station_width(sizes: Counts, alike: int) -> int:
    """Return the number of columns of a station."""
    return STATION_MODES + (2 - alike) * MODE_ROWS * modes_of_planes(sizes) + SPATIAL_ROWS * sizes.spatial_modes


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
        _air_on_boosters(loads, vehicle, sizes, pool, at, work, columns, of_boosters)
    drivers = _drivers(loads, vehicle, sizes, at, work, columns, of_boosters)
    if loads.boosters > 0:
        _join_boosters(loads, vehicle, sizes, drivers, at, work, columns, of_boosters)
    for n in range(loads.stations):
        station, c = loads.station_m[n], STATIONS + width * n
        total, shift_y, shift_z = _inertia(sizes, loads.alike, drivers, station, roll, work, columns, c)
        if sizes.spatial_modes > 0:
            more, moved_y, moved_z = _spatial_inertia(
                sizes, loads.alike, drivers, roll, at.aux.alpha_BI_B_radps2[0], work, columns, c
            )
            total, shift_y, shift_z = _add(total, more), shift_y + moved_y, shift_z + moved_z
        total = _add(total, _aerodynamic(loads, drivers, station, shift_y, shift_z, work))
        for tank in range(sizes.pendulums):
            if loads.tank_booster[tank] < 0:
                total = _add(total, _of_pendulum(loads, vehicle, sizes, tank, station, shift_y, shift_z, at, work))
        for b in range(loads.boosters):
            joint = joint_column(loads, sizes, of_boosters, b)
            total = _add(total, _of_booster(loads, b, station, shift_y, shift_z, columns, joint))
        centre = drivers.centre
        if centre[0] <= station:
            force = (inputs.force_x_N, inputs.force_y_N, inputs.force_z_N)
            injected = _of_point(station, centre[0], force, centre[1] - shift_y, centre[2] - shift_z)
            total = _add(total, injected)
            total = (total[0], total[1], total[2], total[3] + inputs.torque_y_Nm, total[4] + inputs.torque_z_Nm)
        first = SECTION_WIDTH * n
        for j in range(SECTION_WIDTH):
            out.section[first + j] = total[j]
    return drivers.mass, drivers.cg[0]


SectionLoad = tuple[float, float, float, float, float]


@kernel
def _add(a: SectionLoad, b: SectionLoad) -> SectionLoad:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4]


@kernel
def _of_point(station: float, x: float, force: Vector, y: float, z: float) -> SectionLoad:
    """Return the load of a force at station `x`, forward of the cut.

    (y, z) is its position relative to the centre of the cut.
    """
    ahead = station - x
    return force[0], force[1], force[2], z * force[0] - ahead * force[2], ahead * force[1] - y * force[0]


@formula
def shape_column(loads: Loads, sizes: Counts, of_boosters: int, booster: int, plane: int, row: int) -> int:
    """Return the first column of a row of a booster's shapes in a plane (PITCH, YAW)."""
    modes = modes_of_planes(sizes)
    return of_boosters + BOOSTER_WIDTH * loads.boosters + ((2 * booster + plane) * BOOSTER_ROWS + row) * modes


@formula
def joint_column(loads: Loads, sizes: Counts, of_boosters: int, booster: int) -> int:
    return shape_column(loads, sizes, of_boosters, loads.boosters, 0, 0) + JOINT_WIDTH * booster


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
        mass, cg, inertia = _without_boosters(loads, whole, centre, inertia, columns, of_boosters)
        core_accel = add(accel, _relative_accel(rate, alpha, _from_centre(centre, cg)))
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
def _from_centre(centre: Vector, place: Vector) -> Vector:
    """Return the vector, B, between two places that are given by station, y and z."""
    return centre[0] - place[0], place[1] - centre[1], place[2] - centre[2]


@kernel
def _relative_accel(rate: Vector, alpha: Vector, r: Vector) -> Vector:
    """Return the acceleration of a point of the rigid body relative to that of another, to which `r` leads from it."""
    return add(cross(alpha, r), cross(rate, cross(rate, r)))


@kernel
def _without_boosters(
    loads: Loads, mass: float, centre: Vector, inertia: Symmetric, columns: Array, of_boosters: int
) -> tuple[float, Vector, Symmetric]:
    """Return mass, CG (station, y, z) and inertia about it of the core alone, from those of core and boosters."""
    left, first = mass, (0.0, 0.0, 0.0)  # the first moment is about the common CG
    for b in range(loads.boosters):
        c = of_boosters + BOOSTER_WIDTH * b
        own, place = columns[c + BOOSTER_MASS], _from_centre(centre, vector_at(columns, c + BOOSTER_CG))
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
            total = _add(total, _of_point(station, place, (0.0, surface.force_y_N, surface.force_z_N), 0.0, 0.0))
    for k in range(loads.axial_points):
        if loads.axial_m[k] <= station:
            force = (loads.axial_share[k] * d.drag_N, 0.0, 0.0)
            total = _add(total, _of_point(station, loads.axial_m[k], force, -shift_y, -shift_z))
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
        total = _of_point(station, hinge, (0.0, pull * u[1], pull * u[2]), 0.0, 0.0)
    if max(hinge, loads.bottom_m[tank]) <= station:
        total = _add(total, _of_point(station, hinge, (pull * u[0], 0.0, 0.0), aside_y, aside_z))
    bob = hinge - length * u[0]
    if bob <= station:
        along = -bob_mass(at.properties, tank) * own.damping_mps2[0]
        force = (along, own.damper_force_N[1], own.damper_force_N[2])
        total = _add(total, _of_point(station, bob, force, aside_y + length * u[1], aside_z + length * u[2]))
    return total


class Pull(NamedTuple):
    """A force and its moment about the first attachment of a booster on the core's axis, B."""

    force: Vector
    moment: Vector


@kernel
def _pulled(pull: Pull, arm: Vector, force: Vector) -> Pull:
    """Return the load with another force, to whose point `arm` leads from the attachment."""
    return Pull(add(pull.force, force), add(pull.moment, cross(arm, force)))


@kernel
def _air_on_boosters(
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
def _join_boosters(
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
        turned = (turned_y, turned_z)
        pull = Pull(vector_at(columns, joint + AIR_FORCE), vector_at(columns, joint + AIR_MOMENT))
        mass, place = columns[c + BOOSTER_MASS], vector_at(columns, c + BOOSTER_CG)
        inertia = symmetric_at(columns, c + BOOSTER_INERTIA)
        aft = place[0] - first_m
        accel = add(d.accel, _relative_accel(rate, alpha, _from_centre(d.centre, place)))
        accel = add(accel, (0.0, held_y + aft * along_y, held_z + aft * along_z))
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
def _on_booster(first_m: float, place: Vector, turned: tuple[float, float]) -> Vector:
    """Return the vector from the first attachment to a place (station, y, z) of the booster, with its rotation."""
    aft = place[0] - first_m
    return -aft, place[1] + aft * turned[0], place[2] + aft * turned[1]


@kernel
def _with_engine(
    loads: Loads,
    vehicle: StageRecord,
    sizes: Counts,
    n: int,
    turned: tuple[float, float],
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
        accel = add(d.accel, _relative_accel(rate, alpha, _from_centre(d.centre, place)))
        pull = _pulled(pull, rest, scaled(mass, accel))
        accel = add(accel, _relative_accel(rate, alpha, engine.delta))
        accel = add(accel, add(engine.delta_accel, scaled(2.0, cross(rate, engine.delta_rate))))
        pull = _pulled(pull, add(rest, engine.delta), scaled(-mass, accel))
        turning = add(engine.relative_accel, cross(rate, engine.relative_rate))
        pull = Pull(pull.force, add(pull.moment, scaled(-inertia, turning)))
    return pull


@kernel
def _with_pendulum(
    slosh: Slosh,
    sizes: Counts,
    first_m: float,
    tank: int,
    turned: tuple[float, float],
    at: Evaluation,
    work: Work,
    pull: Pull,
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
def _of_booster(
    loads: Loads, b: int, station: float, shift_y: float, shift_z: float, columns: Array, joint: int
) -> SectionLoad:
    """Return the loads of a booster's attachments forward of a station."""
    total = (0.0, 0.0, 0.0, 0.0, 0.0)
    if loads.held_m[b] <= station:
        force = vector_at(columns, joint + ALONG)
        aside_y, aside_z = columns[joint + MOVED_Y] - shift_y, columns[joint + MOVED_Z] - shift_z
        total = _of_point(station, loads.held_m[b], force, aside_y, aside_z)
        total = _add(total, (0.0, 0.0, 0.0, columns[joint + COUPLE_Y], columns[joint + COUPLE_Z]))
    if loads.second_m[b] <= station:
        force = (0.0, columns[joint + SECOND_Y], columns[joint + SECOND_Z])
        total = _add(total, _of_point(station, loads.second_m[b], force, 0.0, 0.0))
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
