"""Attitude control law: proportional, integral and derivative terms, then the bending filter of PD (pd.py).

    delta = -k_p theta_e - k_d q_g - i,      i_n = i_(n-1) + T k_i theta_e

The gain is inside the sum, so that a change of the scheduled gain does not cause a step of the command. The anti-windup
is conditional integration (Astrom & Hagglund, Advanced PID Control, 3.5): the integral is held while the last command
was limited and the error would increase the excess. The integral also has its own limit. The linear model is
design/laws/pid.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.rows import DEG, PitchYaw
from maxq.control.kernel.tables import look_up
from maxq.control.laws.pd import LawInputs, PdRecord, PdState, filtered, proportional_derivative


@dataclass(frozen=True)
class Pid:
    """The parameters of PID in addition to the gains."""

    limit_rad: float  # limit of the integral term


@dataclass
class PidState:
    """The state of PID, per gimbal axis (pitch, yaw): the gain in use, and the integral i."""

    k_i_ps: Annotated[Array, (2,)]
    integral_rad: Annotated[Array, (2,)]


@kernel
def start_pid(state: PidState) -> None:
    for gimbal in range(2):
        state.k_i_ps[gimbal] = 0.0
        state.integral_rad[gimbal] = 0.0


@kernel
def integrate(pid: Pid, integral: PidState, k_i_ps: float, given: LawInputs) -> None:
    """Add the attitude error of a sample to the integral of an axis, subject to its limit and the anti-windup."""
    gimbal = given.gimbal
    integral.k_i_ps[gimbal] = k_i_ps
    more_rad = given.sample_s * k_i_ps * given.error_rad
    if more_rad * given.cut_rad >= 0.0:  # a positive error lowers the command, away from the upper limit
        whole_rad = integral.integral_rad[gimbal] + more_rad
        integral.integral_rad[gimbal] = min(max(whole_rad, -pid.limit_rad), pid.limit_rad)


@kernel
def tick_pid(law: PdRecord, pid: Pid, pool: Array, state: PdState, integral: PidState, given: LawInputs) -> float:
    """Compute a tick as `tick_pd` does and add the integral, which is reset to 0 while `on` is 0.

    The gain table has three columns for each axis.
    """
    pid_rad, gimbal = 0.0, given.gimbal
    if given.on == 0:
        integral.integral_rad[gimbal] = 0.0
    elif law.gains.n_breaks != 0:
        integrate(pid, integral, look_up(pool, law.gains, given.at, 3 * gimbal + 2), given)
        pd_rad = proportional_derivative(law, pool, state, given, 3)
        pid_rad = pd_rad - integral.integral_rad[gimbal]
    return filtered(law, state, gimbal, pid_rad)


class PidRow(NamedTuple):
    """The log row of the integral."""

    k_i_axis_ps: Annotated[PitchYaw, "1/s", "integral gain; 0 without an integral"]
    integral_axis_deg: Annotated[PitchYaw, "deg", "integral's share of the law's output, with its sign reversed"]


@kernel
def pid_row(state: PidState) -> PidRow:
    k_i, integral = state.k_i_ps, state.integral_rad
    return PidRow(
        k_i_axis_ps=PitchYaw(k_i[0], k_i[1]), integral_axis_deg=PitchYaw(DEG * integral[0], DEG * integral[1])
    )
