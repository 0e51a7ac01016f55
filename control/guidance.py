"""Guidance by a programme of commanded body rates over time, integrated exactly.

The control law needs the commanded angle (Lee, Ahn & Roh eq. 33: theta_e is the integral of q_g - q_c). A sum of
sampled rates would have a discretisation error. The programme's table therefore contains the angle at each breakpoint
in addition to the rates, and the kernel integrates the polynomial of the interval in closed form. Cubic rates (pchip)
give a quartic angle, linear rates a quadratic angle, and stepwise rates a piecewise linear angle. All are exact to
rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.attitude import Strapdown, start_strapdown
from maxq.control.kernel.jit import kernel
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Cubics, Method, TableRef, find_interval, fit

ROLL, PITCH, YAW = 0, 1, 2  # body axes x, y, z
N_AXES = 3


@dataclass
class GuidanceState:
    """The state of the guidance, per body axis x, y, z (roll, pitch, yaw).

    - `start_rad`: integral of the programme at the start of the computer.
    - `programme_rad`: change of this integral since the start.
    - `injected_rad`: integral of the injected rates.
    - `angle_rad`: commanded angle, the sum of the two.
    - `increment_rad`, `rate_radps`: commanded turn of the body in the last sample, and this turn divided by the sample
      period.
    - `attitude`: commanded attitude from the same rates, the reference of the attitude error.
    """

    start_rad: Annotated[Array, (3,)]
    programme_rad: Annotated[Array, (3,)]
    injected_rad: Annotated[Array, (3,)]
    angle_rad: Annotated[Array, (3,)]
    increment_rad: Annotated[Array, (3,)]
    rate_radps: Annotated[Array, (3,)]
    attitude: Strapdown


def rate_programme(
    time_s: ArrayLike,
    pitch_radps: ArrayLike,
    yaw_radps: ArrayLike = 0.0,
    roll_radps: ArrayLike = 0.0,
    method: Method = "linear",
) -> Cubics:
    """Return the programme table of commanded body rates at `time_s` (n,); a single number is a constant rate.

    Columns 0-2 are the commanded rates about x, y, z (roll, pitch, yaw), rad/s. Columns 3-5 are their integrals from
    the first time to the beginning of each interval, rad. The end rates apply outside `time_s`. With `step`, each rate
    applies up to the next time, and the last rate indefinitely. Raises ValueError as `tables.fit` does, and for columns
    of different lengths.
    """
    times = np.atleast_1d(np.asarray(time_s, float))
    rates = np.zeros((len(times), N_AXES))
    for axis, key, given in (
        (ROLL, "roll_radps", roll_radps),
        (PITCH, "pitch_radps", pitch_radps),
        (YAW, "yaw_radps", yaw_radps),
    ):
        column = np.asarray(given, float)
        if column.shape not in ((), times.shape):
            raise ValueError(f"{key} has {column.size} values: allowed is 1 or {len(times)}, one for each time_s")
        rates[:, axis] = column
    if method == "step":  # a stepwise table ends at its last point; an additional point holds the last rate
        times, rates = np.append(times, times[-1] + 1.0), np.vstack([rates, rates[-1]])
    table = fit(times, rates, method)
    span = np.diff(table.breaks)[:, None]
    c = table.coefficients
    gains = span * (c[:, 0] + span * (c[:, 1] / 2 + span * (c[:, 2] / 3 + span * c[:, 3] / 4)))
    angles = np.zeros_like(c)
    angles[1:, 0] = np.cumsum(gains, axis=0)[:-1]
    return Cubics(table.breaks, np.concatenate([c, angles], axis=2))


@kernel
def programme_angle(pool: Array, programme: TableRef, time_s: float, axis: int) -> float:
    """Return the integral of the commanded rate about body axis `axis` from the table's first time to `time_s`, rad.

    The end rates apply outside the table. Without a programme, the integral is 0.
    """
    if programme.n_breaks == 0:
        return 0.0
    first = pool[programme.offset]
    last = pool[programme.offset + programme.n_breaks - 1]
    inside_s = min(max(time_s, first), last)
    k = find_interval(pool, programme, inside_s)
    s = inside_s - pool[programme.offset + k]
    n = programme.n_columns
    i = programme.offset + programme.n_breaks + 4 * n * k + axis
    c0, c1, c2, c3 = pool[i], pool[i + n], pool[i + 2 * n], pool[i + 3 * n]
    inside_rad = pool[i + 3] + s * (c0 + s * (c1 / 2.0 + s * (c2 / 3.0 + s * c3 / 4.0)))
    rate_radps = c0 + s * (c1 + s * (c2 + s * c3))
    angle_rad: float = inside_rad + rate_radps * (time_s - inside_s)
    return angle_rad


@kernel
def start_guidance(pool: Array, programme: TableRef, state: GuidanceState, time_s: float) -> None:
    """Start the guidance at `time_s` with commanded angles of 0."""
    for axis in range(3):
        state.start_rad[axis] = programme_angle(pool, programme, time_s, axis)
        state.programme_rad[axis] = 0.0
        state.injected_rad[axis] = 0.0
        state.angle_rad[axis] = 0.0
        state.increment_rad[axis] = 0.0
        state.rate_radps[axis] = 0.0
    start_strapdown(state.attitude)


@kernel
def advance_guidance(
    pool: Array,
    programme: TableRef,
    state: GuidanceState,
    axis: int,
    time_s: float,
    sample_s: float,
    on: int,
    injected_radps: float,
    replaces: int,
) -> None:
    """Advance the commanded angle of body axis `axis` to `time_s`, the end of a sample of `sample_s`.

    `injected_radps` is a rate, constant over that sample, which is added to the programme's rate, or replaces it if
    `replaces` is not 0. With `on` = 0, the programme's angle is held.
    """
    before_rad = state.programme_rad[axis]
    if on != 0:
        state.programme_rad[axis] = programme_angle(pool, programme, time_s, axis) - state.start_rad[axis]
    state.injected_rad[axis] += injected_radps * sample_s
    if replaces != 0:
        state.injected_rad[axis] -= state.programme_rad[axis] - before_rad
    angle_rad = state.programme_rad[axis] + state.injected_rad[axis]
    state.increment_rad[axis] = angle_rad - state.angle_rad[axis]
    state.angle_rad[axis] = angle_rad
    state.rate_radps[axis] = state.increment_rad[axis] / sample_s


@kernel
def unroll(state: GuidanceState, sample_s: float) -> None:
    """Transform the commanded increments in pitch and yaw from axes that do not roll to the body axes.

    The body axes are rotated by the commanded roll at the middle of the sample.
    """
    roll_rad = state.angle_rad[ROLL] - 0.5 * state.increment_rad[ROLL]
    sine, cosine = math.sin(roll_rad), math.cos(roll_rad)
    pitch_rad, yaw_rad = state.increment_rad[PITCH], state.increment_rad[YAW]
    state.increment_rad[PITCH] = cosine * pitch_rad + sine * yaw_rad
    state.increment_rad[YAW] = cosine * yaw_rad - sine * pitch_rad
    for axis in (PITCH, YAW):
        state.rate_radps[axis] = state.increment_rad[axis] / sample_s
