"""The properties of a vehicle over time: columns of one table per stage, and their layout.

Mass, thrust, tanks and modes change as propellant is consumed. All are columns of one table over the stage's burn
clock, so that a kernel searches the interval once and evaluates all columns together. Their values at an instant are
the array `properties` of the kernels. The order of the columns is:

- the fixed columns;
- eight columns per tank;
- the planar modes, row by row for all modes of a plane (pitch, then yaw). A row has a multiple of four modes, with
  zeros for unused modes, so that kernels process four modes at a time;
- the spatial modes, row by row for all modes: frequency and mass, six rows for each place, softening and turning. A
  place is a station at which loads or sensors act; its rows are displacement along and rotation about x, y, z;
- further thrust curves.

Properties derived from these columns follow in the array. They are computed by `complete_modes`,
`complete_spatial_modes`, `rigid.prepare_outflow` and `derive_properties`.
"""

from __future__ import annotations

from maxq.control.kernel.jit import formula, kernel
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.block import Counts, Sizes

CORE_MASS = 0  # kg, without the sloshing masses
CORE_CG = 1  # station aft of the nose, y, z, m
CORE_INERTIA = 4  # integrals about the core CG in B, kg m2: Ixx, Iyy, Izz, Ixy, Ixz, Iyz (products positive)
CG_RATE = 10  # time derivative of CORE_CG, m/s
INERTIA_RATE = 13  # time derivative of CORE_INERTIA, kg m2/s
TOTAL_MASS = 19  # kg, including the sloshing masses
MASS_FLOW = 20  # kg/s, the negative derivative of TOTAL_MASS
THRUST_VACUUM = 21  # N, first curve; see `thrust_column` for the others
N_CONSTANT = 22

TANK_MASS = 0  # kg
TANK_LENGTH = 1  # pendulum length, m
TANK_HINGE = 2  # station of the hinge, m aft of the nose
TANK_MASS_RATE = 3  # kg/s
TANK_TRAVEL = 4  # rate at which the bob moves aft with the liquid, m/s: derivative of hinge plus length
TANK_VISCOUS = 5  # damping ratio of a smooth wall times the fourth root of the axial load, (m/s2)^(1/4)
TANK_RING = 6  # damping ratio of ring baffles divided by the square root of the swing
TANK_WAVE = 7  # wave height per sine of the swing, m; 0: unknown
TANK_WIDTH = 8

MODE_OMEGA = 0  # rows of a plane: rad/s
MODE_MASS = 1  # generalised mass, kg
MODE_PHI_GIMBAL = 2
MODE_SLOPE_GIMBAL = 3  # d(phi)/d(x_n), 1/m
MODE_SLOPE_GYRO = 4
# then phi at each tank; phi, slope at each surface and further gimbal; axial softening by each mode, kg/m
MODE_FIRST = 5

SPATIAL_OMEGA = 0  # rows of the spatial modes: rad/s
SPATIAL_MASS = 1  # generalised mass, kg
SPATIAL_FIRST = 2  # then six at each place; axial softening by each mode, kg/m; turning by each mode (eq. 4.7)
GYRO_PLACE = 0

# Derived properties, which follow the columns of the table.
INVERSE_CORE_MASS = 0  # 1/kg
INVERSE_TOTAL_MASS = 1
INNER_FLOW = 2  # momentum of the propellant relative to the body, B, kg m/s (3)
JET_DAMPING = 5  # integrals, as of an inertia, which times the angular rate give minus the moment, kg m2/s (6)
MOMENT_REFERENCE = 11  # station to which the aerodynamic moments refer, m aft of the nose
RATE_DAMPING = 12  # moment per body rate, given with the mass properties, N m s/rad (3)
N_DERIVED = 15
FEED_HEAD = 0  # of a feed line: tank pressure per axial acceleration, kg/m2
FEED_INERTANCE = 1  # Pa s2/kg
FEED_RESISTANCE = 2  # Pa s/kg
FEED_FLOW_GAIN = 3  # liquid stored at the pump per flow of the line, s
FEED_PUMP_GAIN = 4
FEED_DISCHARGE_INERTANCE = 5
FEED_DISCHARGE_RESISTANCE = 6
FEED_CHAMBER = 7  # chamber pressure per flow, Pa s/kg
FEED_COMPLIANCE = 8  # kg/Pa
FEED_WIDTH = 9
MODE_INVERSE_MASS = 0  # rows of a plane, and of the spatial modes: 1/kg
MODE_STIFFNESS = 1  # N/m
MODE_DAMPING = 2  # N s/m
MODE_TANK_COMPLIANCE = 3  # then the acceleration per newton at each tank, 1/kg

PITCH, YAW = 0, 1


@formula
def tank_column(tank: int) -> int:
    return N_CONSTANT + TANK_WIDTH * tank


@formula
def padded_modes(sizes: Sizes | Counts) -> int:
    """Return the length of a row of modal quantities: the modes of a plane, padded to a multiple of four."""
    return 4 * sizes.mode_groups


@formula
def mode_rows(sizes: Sizes | Counts) -> int:
    """Return the number of rows of a plane."""
    return softening_row(sizes, 0) + padded_modes(sizes)


@formula
def mode_column(sizes: Sizes | Counts, plane: int, row: int) -> int:
    """Return the column of the first mode in a row of a plane (PITCH, YAW); the other modes follow."""
    return N_CONSTANT + TANK_WIDTH * sizes.pendulums + (plane * mode_rows(sizes) + row) * padded_modes(sizes)


@formula
def softening_row(sizes: Sizes | Counts, mode: int) -> int:
    """Return the row of the softening of each mode under axial load, per displacement of `mode`."""
    return gimbal_row(sizes, sizes.gimbals) + mode


@formula
def surface_row(sizes: Sizes | Counts, surface: int) -> int:
    """Return the row of the shapes at a lifting surface; the row of the slopes follows."""
    return MODE_FIRST + sizes.pendulums + 2 * surface


@formula
def tank_place(tank: int) -> int:
    return 1 + tank


@formula
def surface_place(sizes: Sizes | Counts, surface: int) -> int:
    return 1 + sizes.pendulums + surface


@formula
def gimbal_place(sizes: Sizes | Counts, gimbal: int) -> int:
    return 1 + sizes.pendulums + sizes.surfaces + gimbal


@formula
def spatial_column(sizes: Sizes | Counts, row: int) -> int:
    """Return the column of the first spatial mode in a row; the other modes follow."""
    return mode_column(sizes, 2, 0) + row * sizes.spatial_modes


@formula
def place_column(sizes: Sizes | Counts, place: int, component: int) -> int:
    """Return the column of a component of the shapes at a place: 0 to 2 displacement, 3 to 5 rotation (1/m), in B."""
    return spatial_column(sizes, SPATIAL_FIRST + 6 * place + component)


@formula
def spatial_softening_row(sizes: Sizes | Counts, mode: int) -> int:
    """Return the row of the softening of each spatial mode under axial load, per displacement of `mode`."""
    return SPATIAL_FIRST + 6 * gimbal_place(sizes, sizes.gimbals) + mode


@formula
def turning_row(sizes: Sizes | Counts, mode: int) -> int:
    """Return the row of the share of each spatial mode in the shape of `mode` rotated by 90 deg about x."""
    return spatial_softening_row(sizes, sizes.spatial_modes) + mode


@formula
def first_acted(sizes: Sizes | Counts) -> int:
    """Return the index, among the stations of gimbals, of the first station of feed lines, then of buffet."""
    return sizes.gimbals - sizes.sensors - sizes.buffets - sizes.feed_lines


@formula
def gimbal_row(sizes: Sizes | Counts, gimbal: int) -> int:
    """Return the row of the shapes at a station of gimbals; the row of the slopes follows."""
    return MODE_PHI_GIMBAL if gimbal == 0 else surface_row(sizes, sizes.surfaces) + 2 * (gimbal - 1)


@formula
def thrust_column(sizes: Sizes | Counts, curve: int) -> int:
    """Return the column of a curve of vacuum thrust; curves after the first follow the modes."""
    return THRUST_VACUUM if curve == 0 else spatial_column(sizes, turning_row(sizes, sizes.spatial_modes)) + curve - 1


@formula
def schedule_width(sizes: Sizes | Counts) -> int:
    return thrust_column(sizes, sizes.thrust_curves)


@formula
def derived_column(sizes: Sizes | Counts, plane: int, row: int) -> int:
    """Return the column of the first mode in a row of derived properties, as `mode_column` does for the table."""
    return (
        schedule_width(sizes)
        + N_DERIVED
        + (plane * (MODE_TANK_COMPLIANCE + sizes.pendulums) + row) * padded_modes(sizes)
    )


@formula
def compliance_column(sizes: Sizes | Counts, plane: int) -> int:
    """Return the first column of the compliances: sums over the modes of phi_k phi_j / M for tanks k, j."""
    return derived_column(sizes, 2, 0) + plane * sizes.pendulums * sizes.pendulums


@formula
def spatial_derived(sizes: Sizes | Counts, row: int) -> int:
    """Return the column of the first spatial mode in a row of derived properties."""
    return compliance_column(sizes, 2) + row * sizes.spatial_modes


@formula
def feed_column(sizes: Sizes | Counts, line: int) -> int:
    """Return the first column of a feed line."""
    return spatial_derived(sizes, MODE_TANK_COMPLIANCE) + FEED_WIDTH * line


@formula
def properties_size(sizes: Sizes | Counts) -> int:
    """Return the number of columns of the table plus that of the derived properties."""
    return feed_column(sizes, sizes.feed_lines)


@kernel
def complete_modes(
    sizes: Counts, plane: int, modes: int, zeta: Array, frequency_factor: Array, properties: Array
) -> None:
    """Compute the derived properties of one plane: inverse mass, stiffness, damping, compliance."""
    omega_at, mass_at = mode_column(sizes, plane, MODE_OMEGA), mode_column(sizes, plane, MODE_MASS)
    inverse = derived_column(sizes, plane, MODE_INVERSE_MASS)
    stiffness, damping = derived_column(sizes, plane, MODE_STIFFNESS), derived_column(sizes, plane, MODE_DAMPING)
    for i in range(padded_modes(sizes)):
        if i < modes:
            omega = properties[omega_at + i] * frequency_factor[i]
            properties[inverse + i] = 1.0 / properties[mass_at + i]
            properties[stiffness + i] = properties[mass_at + i] * omega * omega
            properties[damping + i] = 2.0 * zeta[i] * properties[mass_at + i] * omega
        else:
            properties[inverse + i], properties[stiffness + i], properties[damping + i] = 0.0, 0.0, 0.0
    n, compliance = sizes.pendulums, compliance_column(sizes, plane)
    for k in range(n):
        at_k = mode_column(sizes, plane, MODE_FIRST + k)
        yield_k = derived_column(sizes, plane, MODE_TANK_COMPLIANCE + k)
        for i in range(padded_modes(sizes)):
            properties[yield_k + i] = properties[at_k + i] * properties[inverse + i]
        for j in range(k, n):
            at_j = mode_column(sizes, plane, MODE_FIRST + j)
            total = 0.0
            for i in range(modes):
                total += properties[yield_k + i] * properties[at_j + i]
            properties[compliance + k * n + j] = total
            properties[compliance + j * n + k] = total


@kernel
def complete_spatial_modes(sizes: Counts, zeta: Array, frequency_factor: Array, properties: Array) -> None:
    """Compute the derived properties of the spatial modes: inverse mass, stiffness, damping."""
    omega_at, mass_at = spatial_column(sizes, SPATIAL_OMEGA), spatial_column(sizes, SPATIAL_MASS)
    inverse = spatial_derived(sizes, MODE_INVERSE_MASS)
    stiffness, damping = spatial_derived(sizes, MODE_STIFFNESS), spatial_derived(sizes, MODE_DAMPING)
    for i in range(sizes.spatial_modes):
        omega, mass = properties[omega_at + i] * frequency_factor[i], properties[mass_at + i]
        properties[inverse + i] = 1.0 / mass
        properties[stiffness + i] = mass * omega * omega
        properties[damping + i] = 2.0 * zeta[i] * mass * omega
