"""Attitude in the flight computer: strapdown quaternions and the attitude error theta_e, the input of every law.

The error is computed from the counted gyro increments and the commanded rates of the guidance, in one of two ways:

| `attitude` | theta_e |
|---|---|
| `quaternion` | from the commanded to the measured attitude: the roll, and the tilt of x about y and z of the body |
| `rate-integral` | per body axis, the integral of the measured minus the commanded rate (Lee, Ahn & Roh eq. 33) |

Rotations about several axes do not commute, so `rate-integral` is an attitude error only while the vehicle turns about
one axis. `quaternion` is valid at any attitude, for errors below 180 deg. A large roll error, as in a roll manoeuvre,
does not rotate the axes about which the gimbals correct the tilt. With the rotation vector as the error, these axes
would be rotated by half of the roll error. For small errors about one axis the two errors, and hence the linear loops,
are equal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple, get_args

from maxq.control.kernel import vectors as vec
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import RollPitchYaw, degrees
from maxq.control.structures import Attitude

METHODS: tuple[Attitude, ...] = get_args(Attitude)
QUATERNION = METHODS.index("quaternion")


@dataclass
class Strapdown:
    """The strapdown attitude.

    `q`: unit quaternion from B to R, the attitude at the start; scalar first. `last_rad`: last angle increment.
    """

    q: Annotated[Array, (4,)]
    last_rad: Annotated[Array, (3,)]


@dataclass
class AttitudeError:
    """The attitude error; triples are per body axis (roll, pitch, yaw).

    - `measured`: attitude from the counted gyro increments.
    - `error_rad`: attitude error.
    - `theta_e_rad`: attitude error clamped at its limit, the input of the law.
    - `rate_radps`: measured rate q_g, the increment divided by the sample period, or a blend of several gyros.
    """

    measured: Strapdown
    error_rad: Annotated[Array, (3,)]
    theta_e_rad: Annotated[Array, (3,)]
    rate_radps: Annotated[Array, (3,)]


@kernel
def start_strapdown(state: Strapdown) -> None:
    """Set the attitude to R and the last increment to zero."""
    state.q[0] = 1.0
    for axis in range(3):
        state.q[1 + axis] = 0.0
        state.last_rad[axis] = 0.0


@kernel
def turn(state: Strapdown, increment_rad: Array) -> None:
    """Advance the attitude by `increment_rad` (3,), the integral of the body rates over a sample.

    The rotation vector of the sample is the increment plus one twelfth of (last increment x increment). This coning
    term is exact to third order for rates that are linear over two samples (Savage, J. Guidance 21(1), 1998, 19-28).
    """
    last, new = vec.vector_at(state.last_rad, 0), vec.vector_at(increment_rad, 0)
    by = vec.quaternion_of(vec.add(new, vec.scaled(1.0 / 12.0, vec.cross(last, new))))
    q = vec.quaternion_product(vec.quaternion_at(state.q, 0), by)
    to_unit = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for k in range(4):
        state.q[k] = to_unit * q[k]
    for axis in range(3):
        state.last_rad[axis] = increment_rad[axis]


@kernel
def start_attitude_error(state: AttitudeError) -> None:
    """Set the measured attitude to R, and the errors and rates to zero."""
    start_strapdown(state.measured)
    for axis in range(3):
        state.error_rad[axis] = 0.0
        state.theta_e_rad[axis] = 0.0
        state.rate_radps[axis] = 0.0


@kernel
def update_attitude_error(
    state: AttitudeError, method: int, commanded: Strapdown, angle_rad: Array, commanded_rad: Array, limit_rad: float
) -> None:
    """Update theta_e from the attitudes, or from the counted and the commanded angles (3,), as `method` requires.

    theta_e is clamped at `limit_rad` per axis. The clamp limits only the input of the law: `error_rad` is not limited,
    so that a return from beyond the limit is counted in full.
    """
    if method == QUATERNION:
        set_attitude_error(state, vec.quaternion_at(commanded.q, 0), limit_rad)
        return
    for axis in range(3):
        state.error_rad[axis] = angle_rad[axis] - commanded_rad[axis]
    limit_attitude_error(state, limit_rad)


@kernel
def set_attitude_error(state: AttitudeError, commanded: vec.Quaternion, limit_rad: float) -> None:
    """Set the error to roll and tilt from the attitude `commanded`, B to R, to the measured one."""
    turned = vec.quaternion_product(vec.conjugate(commanded), vec.quaternion_at(state.measured.q, 0))
    vec.set_vector(state.error_rad, 0, vec.roll_and_tilt(turned))
    limit_attitude_error(state, limit_rad)


@kernel
def limit_attitude_error(state: AttitudeError, limit_rad: float) -> None:
    for axis in range(3):
        state.theta_e_rad[axis] = min(max(state.error_rad[axis], -limit_rad), limit_rad)


class AttitudeRow(NamedTuple):
    """The log row of the attitude error."""

    error_axis_deg: Annotated[RollPitchYaw, "deg", "attitude error theta_e in the computer"]
    measured_axis_rate_degps: Annotated[RollPitchYaw, "deg/s", "angular rate in the control law"]


@kernel
def attitude_row(state: AttitudeError) -> AttitudeRow:
    return AttitudeRow(error_axis_deg=degrees(state.theta_e_rad), measured_axis_rate_degps=degrees(state.rate_radps))
