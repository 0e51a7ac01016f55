"""What is integrated: one definition of the state vector.

The first `N_FIXED` entries are the same for every vehicle; bending and slosh follow, as many as the vehicle has:

    r_I v_I q_BI w_BI_B | actuator pitch, yaw | gyro roll, pitch, yaw | gyro integrals
    eta[n_pitch] nu_pitch[n_pitch] xi[n_yaw] nu_yaw[n_yaw] | per tank: u_B (3), kappa_B (3)

Position and velocity are those of the *core* CG (the vehicle without its sloshing masses, engine straight), in the
inertial frame. The modal rates are quasi-velocities that already hold the turning of the bending plane with the
roll rate p:  nu_pitch = d(eta)/dt + p xi,  nu_yaw = d(xi)/dt - p eta.  A pendulum is the unit vector u_B from its
hinge to its bob and kappa_B, the *inertial* derivative of that vector in body components (docs/model.md, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from maxq.control.kernel.jit import integer, kernel
from maxq.control.kernel.limits import MAX_MODES, MAX_TANKS

R_I = 0  # position of the core CG in I, m
V_I = 3  # its velocity in I, m/s
Q_BI = 6  # attitude quaternion, scalar first: v_I = q v_B q*
W_BI_B = 10  # angular velocity of B relative to I, in B, rad/s
ACTUATOR = 13  # six states an axis: pitch, yaw
GYRO = 25  # two states an axis: roll, pitch, yaw
GYRO_ANGLE = 31  # integral of the gyro's rate since the last sample, rad: roll, pitch, yaw
N_FIXED = 34

N_ACTUATOR = 6
N_GYRO = 2
N_PENDULUM = 6

MAX_STATE = N_FIXED + 4 * MAX_MODES + N_PENDULUM * MAX_TANKS


@dataclass(frozen=True)
class Sizes:
    """How many flexible and sloshing parts a stage has: with them every index of the state is known."""

    pitch_modes: int
    yaw_modes: int
    tanks: int
    surfaces: int


class Counts(NamedTuple):
    """Sizes as plain numbers: those of a record are read anew after every write to an array.

    In a kernel compiled for one vehicle (`records.with_constants`) they are constants, which takes the arithmetic of
    indices and the ends of loops out of it: measured, a seventh of a flight's time.
    """

    pitch_modes: int
    yaw_modes: int
    tanks: int
    surfaces: int


@kernel
def counts(sizes: Sizes) -> Counts:
    return Counts(
        integer(sizes, "pitch_modes"), integer(sizes, "yaw_modes"), integer(sizes, "tanks"), integer(sizes, "surfaces")
    )


@kernel
def state_size(sizes: Sizes | Counts) -> int:
    return N_FIXED + 2 * (sizes.pitch_modes + sizes.yaw_modes) + N_PENDULUM * sizes.tanks


@kernel
def eta_index(sizes: Sizes | Counts) -> int:
    """First of the pitch plane's modal coordinates; its rates follow after `pitch_modes` entries."""
    return N_FIXED


@kernel
def xi_index(sizes: Sizes | Counts) -> int:
    """First of the yaw plane's modal coordinates; its rates follow after `yaw_modes` entries."""
    return N_FIXED + 2 * sizes.pitch_modes


@kernel
def pendulum_index(sizes: Sizes | Counts, tank: int) -> int:
    """u_B of a tank's pendulum; kappa_B follows after three entries."""
    return N_FIXED + 2 * (sizes.pitch_modes + sizes.yaw_modes) + N_PENDULUM * tank
