"""Attitude control laws with feedback of the lateral drift: PD, or PID, plus drift velocity and displacement.

    delta = -k_p theta_e - k_d q_g [- i] + k_zd v + k_z z,    v = v + T (a - a_x theta_e),    z = z + T v

v and z are the velocity and the displacement of the accelerometer across the reference trajectory, along +z in pitch
and -y in yaw. The computer has no other navigation. It rotates the measured specific force (lateral a, axial a_x) by
the attitude error into the axes of the commanded attitude, and integrates it. Gravity equals that of the reference
trajectory and cancels. On a trajectory without lateral force, such as a gravity turn in still air, the reference is v =
z = 0. A trajectory that the programme flies at an angle of attack adds its own drift.

Positive gains oppose the drift: wind from below accelerates the body upwards (v < 0), and the nose is lowered.
Greensite and Zavoli write delta = ... - k_zd v - k_z z, with negative gains. Errors of the accelerometer are
integrated: a bias b gives the displacement b t^2 / 2. The attitude error is that of the gyro, without its limit. Its
sine is approximated by the angle, with an error of 1 % at 14 deg. The linear model is design/laws/drift.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.kernel.tables import look_up
from maxq.control.laws.pd import LawInputs, PdRecord, PdState, filtered, proportional_derivative
from maxq.control.laws.pid import Pid, PidState, integrate


@dataclass
class DriftState:
    """The state of the drift feedback, per gimbal axis (pitch, yaw).

    - `k_zd_radspm`, `k_z_radpm`: gains in use.
    - `velocity_mps`, `displacement_m`: drift along +z (pitch) and -y (yaw) of the commanded attitude.
    - `share_rad`: contribution of the drift to the command.
    """

    k_zd_radspm: Annotated[Array, (2,)]
    k_z_radpm: Annotated[Array, (2,)]
    velocity_mps: Annotated[Array, (2,)]
    displacement_m: Annotated[Array, (2,)]
    share_rad: Annotated[Array, (2,)]


@kernel
def start_drift(state: DriftState) -> None:
    """Set drift, gains and contribution to 0."""
    for gimbal in range(2):
        state.k_zd_radspm[gimbal], state.k_z_radpm[gimbal] = 0.0, 0.0
        state.velocity_mps[gimbal], state.displacement_m[gimbal], state.share_rad[gimbal] = 0.0, 0.0, 0.0


@kernel
def navigate_drift(
    state: DriftState, gimbal: int, lateral_mps2: float, axial_mps2: float, error_rad: float, sample_s: float
) -> None:
    """Integrate the specific force of a sample: a_z (pitch) or a_y (yaw), and a_x times the attitude error."""
    sign = 1.0 - 2.0 * gimbal
    state.velocity_mps[gimbal] += sample_s * (sign * lateral_mps2 - axial_mps2 * error_rad)
    state.displacement_m[gimbal] += sample_s * state.velocity_mps[gimbal]


@kernel
def tick_drift(
    law: PdRecord,
    pid: Pid,
    pool: Array,
    state: PdState,
    integral: PidState,
    drift: DriftState,
    given: LawInputs,
    with_integral: int,
) -> float:
    """Compute a tick as `tick_pd` does, plus the drift feedback, and the integral if `with_integral` is 1.

    Each axis has four columns in the gain table, or five with an integral, whose gain is the third.
    """
    law_rad, gimbal, columns = 0.0, given.gimbal, 4 + with_integral
    if given.on == 0:
        integral.integral_rad[gimbal] = 0.0
    elif law.gains.n_breaks != 0:
        first = columns * gimbal + 2 + with_integral
        drift.k_zd_radspm[gimbal] = look_up(pool, law.gains, given.at, first)
        drift.k_z_radpm[gimbal] = look_up(pool, law.gains, given.at, first + 1)
        v, z = drift.velocity_mps[gimbal], drift.displacement_m[gimbal]
        drift.share_rad[gimbal] = drift.k_zd_radspm[gimbal] * v + drift.k_z_radpm[gimbal] * z
        law_rad = proportional_derivative(law, pool, state, given, columns)
        if with_integral == 1:
            integrate(pid, integral, look_up(pool, law.gains, given.at, columns * gimbal + 2), given)
            law_rad -= integral.integral_rad[gimbal]
        law_rad += drift.share_rad[gimbal]
    return filtered(law, state, gimbal, law_rad)


class DriftRow(NamedTuple):
    """The log row of the drift feedback."""

    drift_axis_mps: Annotated[PitchYaw, "m/s", "drift velocity that the computer integrates, along +z and -y"]
    displacement_axis_m: Annotated[PitchYaw, "m", "integral of the drift velocity"]
    drift_share_axis_deg: Annotated[PitchYaw, "deg", "share of the drift in the law's output; 0 without drift feedback"]


@kernel
def drift_row(state: DriftState) -> DriftRow:
    v, z, share = state.velocity_mps, state.displacement_m, state.share_rad
    return DriftRow(
        drift_axis_mps=PitchYaw(v[0], v[1]),
        displacement_axis_m=PitchYaw(z[0], z[1]),
        drift_share_axis_deg=PitchYaw(DEG * share[0], DEG * share[1]),
    )
