"""Attitude control law: proportional and derivative, on counted angles (Lee, Ahn & Roh eq 33).

    delta_pd = -k_p theta_e - k_d q_g,    theta_e = integral of (q_g - q_c)

theta_e is the counted angle minus the commanded angle, both kept whole, so it is an exact sum and never
drifts. A positive error gives a negative command: a positive gimbal angle turns the body positively.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np

from maxq.control.converter import round_half_away
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.rows import DEG, PitchYaw, RollPitchYaw, degrees
from maxq.control.kernel.tables import Cubics, TableRef, fit, look_up, merge


@dataclass(frozen=True)
class GainSchedule:
    """Gains of one axis over time: `time_s` (n,), `k_p` (n,), `k_d_s` (n,) in s; linear between, held
    outside.
    """

    time_s: Sequence[float]
    k_p: Sequence[float]
    k_d_s: Sequence[float]


@dataclass(frozen=True)
class Law:
    """`gains`: table over time of k_p, k_d in pitch, k_p, k_d in yaw (`gains_table`); none means a law that
    gives 0.

    `angle_error_limit_rad`: clamp of theta_e. `command_limit_rad`: of each gimbal command. inf: no limit.
    `dac_step_rad`: step of the digital-to-analogue converter; 0 is none.
    """

    gains: TableRef
    angle_error_limit_rad: float
    command_limit_rad: float
    dac_step_rad: float


@dataclass
class LawState:
    """Triples are per body axis (roll, pitch, yaw), pairs per gimbal axis (pitch, yaw).

    `theta_e_rad`: clamped angle error; `discarded_rad`: what the clamp has taken out of it so far, so the
    whole error is the sum of both; `error_limited`: 1 while clamped. `rate_radps`: measured rate q_g, the
    increment over the sample. `k_p`, `k_d_s`: gains in use. `pd_rad`: delta_pd; `filtered_rad`: after the
    bending filter; `requested_rad`: with the injected command; `command_limited`: 1 where the limit then cut
    it.
    """

    theta_e_rad: Annotated[Array, (3,)]
    discarded_rad: Annotated[Array, (3,)]
    error_limited: Annotated[IntArray, (3,)]
    rate_radps: Annotated[Array, (3,)]
    k_p: Annotated[Array, (2,)]
    k_d_s: Annotated[Array, (2,)]
    pd_rad: Annotated[Array, (2,)]
    filtered_rad: Annotated[Array, (2,)]
    requested_rad: Annotated[Array, (2,)]
    command_limited: Annotated[IntArray, (2,)]


def gains_table(pitch: GainSchedule, yaw: GainSchedule | None = None) -> Cubics:
    """Table of columns k_p, k_d_s (pitch), k_p, k_d_s (yaw) over time, s; yaw is as pitch unless given.

    Raises ValueError for columns of different lengths and as `tables.fit` does.
    """
    tables = []
    for axis, schedule in (("pitch", pitch), ("yaw", yaw or pitch)):
        for key in ("k_p", "k_d_s"):
            given, wanted = len(getattr(schedule, key)), len(schedule.time_s)
            if given != wanted or wanted == 0:
                raise ValueError(f"gains of {axis}: {key} has {given} values: allowed is {max(wanted, 1)}")
        tables.append(fit(schedule.time_s, np.column_stack([schedule.k_p, schedule.k_d_s]), "linear"))
    return merge(tables)


@kernel
def update_angle_error(law: Law, state: LawState, axis: int, angle_rad: float, commanded_rad: float) -> None:
    """theta_e of body axis `axis` from the counted and the commanded angle.

    Anti-windup by conditional accumulation: at the limit, error that would go further out is discarded for
    good, error that comes back counts at once. The law so answers a reversal without first unwinding, and
    from then on holds the attitude at which the limit was left.
    """
    error_rad = angle_rad - commanded_rad - state.discarded_rad[axis]
    clamped_rad = min(max(error_rad, -law.angle_error_limit_rad), law.angle_error_limit_rad)
    state.error_limited[axis] = 0
    if clamped_rad != error_rad:
        state.error_limited[axis] = 1
        state.discarded_rad[axis] += error_rad - clamped_rad
    state.theta_e_rad[axis] = clamped_rad


@kernel
def proportional_derivative(law: Law, pool: Array, state: LawState, gimbal: int, time_s: float) -> float:
    """delta_pd, rad, of gimbal axis `gimbal` (0 pitch, 1 yaw) at `time_s` (eq 33); notes the gains."""
    if law.gains.n_breaks == 0:
        return 0.0
    axis = gimbal + 1
    k_p = look_up(pool, law.gains, time_s, 2 * gimbal)
    k_d_s = look_up(pool, law.gains, time_s, 2 * gimbal + 1)
    state.k_p[gimbal] = k_p
    state.k_d_s[gimbal] = k_d_s
    pd_rad: float = -k_p * state.theta_e_rad[axis] - k_d_s * state.rate_radps[axis]
    return pd_rad


@kernel
def limit_and_quantise(law: Law, requested_rad: float) -> float:
    """`requested_rad` within ±command_limit_rad, at the nearest DAC step that is not beyond the limit."""
    limit_rad, step_rad = law.command_limit_rad, law.dac_step_rad
    command_rad = min(max(requested_rad, -limit_rad), limit_rad)
    if step_rad == 0.0:
        return command_rad
    steps = round_half_away(command_rad / step_rad)
    # The limit is in general no multiple of the step; the margin keeps rounding from refusing one that is.
    if abs(steps) * step_rad > limit_rad * (1.0 + 1.0e-12):
        steps -= 1 if steps > 0 else -1
    return steps * step_rad


class LawRow(NamedTuple):
    """What is logged of the law."""

    error_axis_deg: Annotated[RollPitchYaw, "deg", "attitude error theta_e"]
    measured_axis_rate_degps: Annotated[RollPitchYaw, "deg/s", "angular rate in the control law"]
    k_p_axis: Annotated[PitchYaw, "1", "proportional gain"]
    k_d_axis_s: Annotated[PitchYaw, "s", "rate gain"]
    law_axis_deg: Annotated[PitchYaw, "deg", "output of the PD law"]


@kernel
def law_row(state: LawState) -> LawRow:
    return LawRow(
        error_axis_deg=degrees(state.theta_e_rad),
        measured_axis_rate_degps=degrees(state.rate_radps),
        k_p_axis=PitchYaw(state.k_p[0], state.k_p[1]),
        k_d_axis_s=PitchYaw(state.k_d_s[0], state.k_d_s[1]),
        law_axis_deg=PitchYaw(DEG * state.pd_rad[0], DEG * state.pd_rad[1]),
    )
