"""The vehicle as a function of time: columns of one table per stage, and how they are laid out.

Mass, thrust, tanks and modes change as propellant leaves. All of it is one table over the stage's burn clock, so
that a kernel finds the interval once and evaluates every column in one sweep. Fixed columns first, then five per
tank, then `mode_width` per mode (pitch plane, then yaw plane).
"""

from __future__ import annotations

from maxq.control.jit import kernel
from maxq.control.records import Array
from maxq.sim.dynamics.state import Sizes

CORE_MASS = 0  # kg, without the sloshing masses
CORE_CG = 1  # x_n aft of the nose, y, z, m
CORE_INERTIA = 4  # integrals about the core CG in B, kg m2: Ixx, Iyy, Izz, Ixy, Ixz, Iyz (products positive)
CG_RATE = 10  # time derivative of CORE_CG, m/s
INERTIA_RATE = 13  # time derivative of CORE_INERTIA, kg m2/s
TOTAL_MASS = 19  # kg, sloshing masses included
MASS_FLOW = 20  # kg/s, minus the derivative of TOTAL_MASS
THRUST_VACUUM = 21  # N
N_CONSTANT = 22

TANK_MASS = 0  # kg
TANK_LENGTH = 1  # pendulum length, m
TANK_HINGE = 2  # station of the hinge, m aft of the nose
TANK_MASS_RATE = 3  # kg/s
TANK_TRAVEL = 4  # rate at which the bob moves aft with the liquid, m/s: of hinge plus length
TANK_WIDTH = 5

MODE_OMEGA = 0  # rad/s
MODE_MASS = 1  # generalised mass, kg
MODE_PHI_GIMBAL = 2
MODE_SLOPE_GIMBAL = 3  # d(phi)/d(x_n), 1/m
MODE_SLOPE_GYRO = 4
MODE_INVERSE_MASS = 5  # 1/kg, filled in by `complete`
MODE_FIRST = 6  # then phi at each tank; phi, slope at each surface; a row of axial softening, kg/m per mode


@kernel
def tank_column(tank: int) -> int:
    return N_CONSTANT + TANK_WIDTH * tank


@kernel
def mode_width(sizes: Sizes, modes: int) -> int:
    """Columns of one mode in a plane of `modes` modes."""
    return MODE_FIRST + sizes.tanks + 2 * sizes.surfaces + modes


@kernel
def pitch_column(sizes: Sizes, mode: int) -> int:
    return N_CONSTANT + TANK_WIDTH * sizes.tanks + mode * mode_width(sizes, sizes.pitch_modes)


@kernel
def yaw_column(sizes: Sizes, mode: int) -> int:
    return pitch_column(sizes, sizes.pitch_modes) + mode * mode_width(sizes, sizes.yaw_modes)


@kernel
def schedule_width(sizes: Sizes) -> int:
    return yaw_column(sizes, sizes.yaw_modes)


@kernel
def compliance_column(sizes: Sizes, plane: int) -> int:
    """Behind the table's columns: sum over the modes of phi_k phi_j / M for tanks k, j, in pitch (0) or yaw (1)."""
    return schedule_width(sizes) + plane * sizes.tanks * sizes.tanks


@kernel
def complete(sizes: Sizes, props: Array) -> None:
    """Fill in what follows from the table's columns and is used many times a step."""
    first, width = pitch_column(sizes, 0), mode_width(sizes, sizes.pitch_modes)
    _complete_plane(sizes, sizes.pitch_modes, first, width, compliance_column(sizes, 0), props)
    first, width = yaw_column(sizes, 0), mode_width(sizes, sizes.yaw_modes)
    _complete_plane(sizes, sizes.yaw_modes, first, width, compliance_column(sizes, 1), props)


@kernel
def _complete_plane(sizes: Sizes, modes: int, first: int, width: int, compliance: int, props: Array) -> None:
    n = sizes.tanks
    for i in range(modes):
        m = first + i * width
        props[m + MODE_INVERSE_MASS] = 1.0 / props[m + MODE_MASS]
    for k in range(n):
        for j in range(k, n):
            total = 0.0
            for i in range(modes):
                m = first + i * width
                total += props[m + MODE_FIRST + k] * props[m + MODE_FIRST + j] * props[m + MODE_INVERSE_MASS]
            props[compliance + k * n + j] = total
            props[compliance + j * n + k] = total
