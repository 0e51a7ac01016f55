"""Allocation: the law's commands in pitch, yaw and roll as gimbal angles of groups of engines, and roll by gimbals.

    u = A v,   v = (pitch, yaw, roll),   u = pitch and yaw angle of each group

A command is the angle of which all gimballed engines together would make the wanted moment: in pitch and yaw deflected
alike, in roll each the way that turns the vehicle. With B (3, channels) the moments of a radian in each channel,
D = diag(sum of those of each axis) and the weights W = engines / limit^2 of the channels,

    A = W^-1 B' (B W^-1 B')^-1 D,   the pseudo-inverse: for B u = D v the least sum over engines of (angle / limit)^2

A is a table over time, stepwise: it changes when the computer learns that an engine is lost, with D as it was, so that
the loop keeps its gain as long as the angles reach. Pitch and yaw come first: what they leave of each channel's limit
bounds roll, by one factor for all channels, so that roll disturbs no other axis.
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

_PARALLEL = 1e-9  # of a determinant, relative to that of perpendicular axes: less means that an axis cannot be had


@dataclass(frozen=True)
class Allocation:
    """`groups` of engines; one has the law's commands as they are. `matrix`: (2 groups x 3) columns, row by row.

    Roll by gimbals: -k_p times the roll error, -k_d_s times the roll rate, within the limit.
    """

    groups: int
    matrix: TableRef
    k_p: float
    k_d_s: float
    roll_limit_rad: float
    limit_rad: Annotated[Array, (2 * MAX_ENGINES,)]  # of each channel's actuator


@dataclass
class AllocationState:
    """`roll_rad`: command in roll; `angle_rad`: commands issued at the last tick, pitch and yaw of each group."""

    roll_rad: float
    angle_rad: Annotated[Array, (2 * MAX_ENGINES,)]


ONE_GROUP = Allocation(1, NO_TABLE, 0.0, 0.0, 0.0, np.zeros(2 * MAX_ENGINES))


def pseudo_inverse(effect: Array, scales: Sequence[float], authority: Array) -> Array:
    """A (channels, 3) of `effect` B (3, channels), W^-1/2 of the channels and D (3,).

    The command of an axis that the channels cannot turn, or not apart from another, gives nothing. Without a
    linear-algebra library, which would round in its own way on each processor.
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
    """Axes that can be turned one apart from the other: pitch and yaw before roll."""
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
    """Solve a positive definite system of at most three equations."""
    m, x = matrix.astype(float).copy(), right.astype(float).copy()
    for k in range(len(m)):
        for i in range(len(m)):
            if i != k:
                factor = m[i, k] / m[k, k]
                m[i], x[i] = m[i] - factor * m[k], x[i] - factor * x[k]
    return np.asarray(x / np.diag(m))


@kernel
def roll_command(a: Allocation, phi_e_rad: float, p_radps: float) -> float:
    """Command in roll to the gimbals, rad."""
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
    """Angles of all channels into `state.angle_rad`; 1 where pitch and yaw alone exceed a limit, which cuts them.

    A channel's limit is the lower one of `limit_rad` and its actuator's.
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
