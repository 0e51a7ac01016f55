"""What any attitude law works on: the attitude error theta_e and the measured rate q_g, per body axis.

theta_e is the counted angle minus the commanded angle, both kept whole, so it is an exact sum and never drifts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import RollPitchYaw, degrees


@dataclass
class AttitudeError:
    """Triples are per body axis (roll, pitch, yaw).

    `theta_e_rad`: clamped angle error; `discarded_rad`: what the clamp has taken out of it so far, so the whole error
    is the sum of both; `error_limited`: 1 while clamped. `rate_radps`: measured rate q_g, the increment over the
    sample.
    """

    theta_e_rad: Annotated[Array, (3,)]
    discarded_rad: Annotated[Array, (3,)]
    error_limited: Annotated[IntArray, (3,)]
    rate_radps: Annotated[Array, (3,)]


@kernel
def start_attitude_error(state: AttitudeError) -> None:
    """No error, no rate."""
    for axis in range(3):
        state.theta_e_rad[axis] = 0.0
        state.discarded_rad[axis] = 0.0
        state.error_limited[axis] = 0
        state.rate_radps[axis] = 0.0


@kernel
def update_attitude_error(
    state: AttitudeError, axis: int, angle_rad: float, commanded_rad: float, rate_radps: float, limit_rad: float
) -> None:
    """theta_e of body axis `axis` from the counted and the commanded angle, clamped at `limit_rad`.

    Anti-windup by conditional accumulation: at the limit, error that would go further out is discarded for
    good, error that comes back counts at once. The law so answers a reversal without first unwinding, and
    from then on holds the attitude at which the limit was left.
    """
    error_rad = angle_rad - commanded_rad - state.discarded_rad[axis]
    clamped_rad = min(max(error_rad, -limit_rad), limit_rad)
    state.error_limited[axis] = 0
    if clamped_rad != error_rad:
        state.error_limited[axis] = 1
        state.discarded_rad[axis] += error_rad - clamped_rad
    state.theta_e_rad[axis] = clamped_rad
    state.rate_radps[axis] = rate_radps


@kernel
def whole_error(state: AttitudeError, axis: int) -> float:
    """Attitude error of body axis `axis`, rad, without the clamp."""
    error_rad: float = state.theta_e_rad[axis] + state.discarded_rad[axis]
    return error_rad


class AttitudeRow(NamedTuple):
    """What is logged of the attitude error."""

    error_axis_deg: Annotated[RollPitchYaw, "deg", "attitude error theta_e"]
    measured_axis_rate_degps: Annotated[RollPitchYaw, "deg/s", "angular rate in the control law"]


@kernel
def attitude_row(state: AttitudeError) -> AttitudeRow:
    return AttitudeRow(error_axis_deg=degrees(state.theta_e_rad), measured_axis_rate_degps=degrees(state.rate_radps))
