"""The records and columns of the section loads, which the kernels of this folder share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import formula, kernel
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
from maxq.control.kernel.tables import TableRef
from maxq.control.kernel.vectors import Vector
from maxq.sim.vehicle.block import Counts

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
# then for each booster rows of the spatial modes: motion along x, y, z of the first attachment, rotation about x, slope
# along y and z; then the motion along x, y, z and the slopes without rigid motion
ATTACHED, TWIST, LEAN_Y, LEAN_Z, ATTACHED_INERTIA, LEAN_Y_INERTIA, LEAN_Z_INERTIA = 0, 3, 4, 5, 6, 9, 10
SPATIAL_BOOSTER_ROWS = 11
# then for each booster its loads on the core, in scratch memory only
ALONG, FIRST_Y, FIRST_Z, COUPLE_Y, COUPLE_Z, SECOND_Y, SECOND_Z, MOVED_Y, MOVED_Z = range(9)
AIR_FORCE, AIR_MOMENT = 0, 3  # of the air on the booster, before its loads on the core are known
JOINT_WIDTH = 9
MAX_BOOSTER_COLUMNS = MAX_BOOSTERS * (
    BOOSTER_WIDTH + (2 * BOOSTER_ROWS + SPATIAL_BOOSTER_ROWS) * MAX_MODES + JOINT_WIDTH
)
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


SectionLoad = tuple[float, float, float, float, float]


@kernel
def add_loads(a: SectionLoad, b: SectionLoad) -> SectionLoad:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4]


@kernel
def load_of_point(station: float, x: float, force: Vector, y: float, z: float) -> SectionLoad:
    """Return the load of a force at station `x`, forward of the cut.

    (y, z) is its position relative to the centre of the cut.
    """
    ahead = station - x
    return force[0], force[1], force[2], z * force[0] - ahead * force[2], ahead * force[1] - y * force[0]
