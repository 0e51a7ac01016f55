"""Allocation of the law's commands in pitch, yaw and roll to the gimbal angles of groups of engines.

    u = A v,   v = (pitch, yaw, roll),   u = pitch and yaw angle of each group

A command is the common angle of all gimballed engines that would produce the required moment. In pitch and yaw all
engines deflect alike; in roll each engine deflects in the direction that rolls the vehicle. Let B (3, channels) be the
moments per radian of each channel and D = diag(sums of |B| over the channels of each axis). The weights of the channels
are W = engines / limit^2. Then

    A = W^-1 B' (B W^-1 B')^-1 D

is the pseudo-inverse, which minimises the sum over engines of (angle / limit)^2 subject to B u = D v.

A is a stepwise table over time. It changes when the computer receives the loss of an engine. D keeps its value, so that
the loop keeps its gain as long as no angle exceeds its limit. Pitch and yaw have priority. The margin that they leave
to each channel's limit bounds the roll command by one factor for all channels, so that roll disturbs no other axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_ENGINES
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import NO_TABLE, TableRef, find_interval, interpolate

_PARALLEL = 1e-9  # least determinant of controllable axes, relative to that of perpendicular axes


@dataclass(frozen=True)
class Allocation:
    """The parameters of the allocation to `groups` groups of engines; a single group receives the law's commands.

    - `matrix`: place of A, (2 groups x 3) columns, row by row.
    - `k_p`, `k_d_s`: gains of the roll command, -k_p times the roll error and -k_d_s times the roll rate.
    - `roll_limit_rad`: limit of the roll command.
    """

    groups: int
    matrix: TableRef
    k_p: float
    k_d_s: float
    roll_limit_rad: float
    limit_rad: Annotated[Array, (2 * MAX_ENGINES,)]  # of each channel's actuator


@dataclass
class AllocationState:
    """The state of the allocation.

    `roll_rad`: roll command. `angle_rad`: angles of the last tick, pitch and yaw of each group.
    """

    roll_rad: float
    angle_rad: Annotated[Array, (2 * MAX_ENGINES,)]


ONE_GROUP = Allocation(1, NO_TABLE, 0.0, 0.0, 0.0, np.zeros(2 * MAX_ENGINES))


def pseudo_inverse(effect: Array, scales: Sequence[float], authority: Array) -> Array:
    """Return A (channels, 3) from `effect` B (3, channels), `scales` W^-1/2 (channels,) and `authority` diag D (3,).

    The column of an axis is zero if the channels cannot turn the vehicle about it, or not independently of another
    axis. No linear-algebra library is used, because its rounding depends on the processor.
    """
    squares = np.array(scales, float) ** 2
    out = np.zeros((effect.shape[1], 3))
    axes = _independent(effect, squares)
    if axes:
        rows = effect[axes]
        gram = np.array([[math.fsum(p * q * squares) for q in rows] for p in rows])
        for k, axis in enumerate(axes):
            wanted = np.zeros(len(axes))
            wanted[k] = authority[axis]
            weights = _solved(gram, wanted)
            out[:, axis] = squares * sum(w * row for w, row in zip(weights, rows, strict=True))
    return out


def _independent(effect: Array, squares: Array) -> list[int]:
    """Return the axes that the channels can turn independently, pitch and yaw before roll."""
    found: list[Array] = []
    axes: list[int] = []
    for axis in range(3):
        row = effect[axis] * np.sqrt(squares)
        length = math.sqrt(math.fsum(row * row))
        if length == 0.0:
            continue
        left = row / length
        for other in found:
            left = left - math.fsum(left * other) * other
        rest = math.sqrt(math.fsum(left * left))
        if rest > math.sqrt(_PARALLEL):
            found.append(left / rest)
            axes.append(axis)
    return axes


def _solved(matrix: Array, right: Array) -> Array:
    """Return the solution of a positive definite system of at most three equations."""
    m, x = matrix.astype(float).copy(), right.astype(float).copy()
    for k in range(len(m)):
        for i in range(len(m)):
            if i != k:
                factor = m[i, k] / m[k, k]
                m[i], x[i] = m[i] - factor * m[k], x[i] - factor * x[k]
    return np.asarray(x / np.diag(m))


@kernel
def roll_command(a: Allocation, phi_e_rad: float, p_radps: float) -> float:
    """Return the roll command for the gimbals, rad."""
    return min(max(-a.k_p * phi_e_rad - a.k_d_s * p_radps, -a.roll_limit_rad), a.roll_limit_rad)


@kernel
def allocate(
    a: Allocation,
    pool: Array,
    state: AllocationState,
    time_s: float,
    pitch_rad: float,
    yaw_rad: float,
    roll_rad: float,
    limit_rad: float,
) -> int:
    """Write the angles of all channels into `state.angle_rad`.

    Returns 1 if the pitch and yaw commands alone exceed a limit and are clipped, otherwise 0. The limit of a channel is
    the lower of `limit_rad` and the limit of its actuator.
    """
    state.roll_rad = roll_rad
    k = find_interval(pool, a.matrix, time_s)
    share, cut = 1.0, 0
    for channel in range(2 * a.groups):
        first = interpolate(pool, a.matrix, k, time_s, 3 * channel) * pitch_rad
        wanted = first + interpolate(pool, a.matrix, k, time_s, 3 * channel + 1) * yaw_rad
        turning = abs(interpolate(pool, a.matrix, k, time_s, 3 * channel + 2) * roll_rad)
        limit = min(limit_rad, a.limit_rad[channel])
        cut = 1 if abs(wanted) > limit else cut
        kept = min(max(wanted, -limit), limit)
        state.angle_rad[channel] = kept
        if turning > 0.0:
            share = min(share, (limit - abs(kept)) / turning)
    for channel in range(2 * a.groups):
        turning = interpolate(pool, a.matrix, k, time_s, 3 * channel + 2) * roll_rad
        state.angle_rad[channel] += share * turning
    return cut


@kernel
def start_allocation(state: AllocationState) -> None:
    state.roll_rad = 0.0
    for channel in range(2 * MAX_ENGINES):
        state.angle_rad[channel] = 0.0
