"""A local descent within a box or a ball, which ends if no small step lowers the value.

Each round evaluates steps in both directions along every coordinate, all at once. Together with the present value,
these give slope and curvature along each coordinate. The next point is the best of the evaluated points and of points
along the step that slopes and curvatures predict for all coordinates. A round without an improvement halves the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from maxq.control.kernel.records import Array

RangeShape = Literal["box", "ellipsoid"]
_FIRST, _LAST = 0.3, 0.003  # steps, relative to the reach
_SHARES = np.array([1.0, 0.6, 0.35, 0.2, 0.1])
_GAIN = 1e-5  # smallest improvement of a round, relative to the value
_MOST_ROUNDS = 40


@dataclass(frozen=True)
class Region:
    """The points u with |u_i| <= reach (box), or with |u| <= reach (an ellipsoid in coordinates of a ball)."""

    shape: RangeShape
    reach: float

    def nearest(self, points: Array) -> Array:
        """Return the points of the region that are nearest to `points` (..., coordinates), in the same shape."""
        if self.shape == "box":
            return np.asarray(np.clip(points, -self.reach, self.reach))
        size = np.linalg.norm(points, axis=-1, keepdims=True)
        return np.asarray(points * np.minimum(1.0, self.reach / np.maximum(size, 1e-300)))

    def farthest(self, direction: Array) -> Array:
        """Return the point of the region that is farthest in a direction, (coordinates,)."""
        if self.shape == "box":
            return self.reach * np.sign(direction)
        return np.asarray(self.reach * direction / max(float(np.linalg.norm(direction)), 1e-300))


def descend(
    values_at: Callable[[Sequence[Array]], Sequence[float]], start: Array, value: float, region: Region
) -> tuple[Array, float]:
    """Return the end point of a descent from `start` (coordinates,), and the value there.

    `values_at` returns the values of many points. `value` is the value at `start`.
    """
    u, units, step = np.asarray(start, float), np.eye(len(start)), _FIRST
    for _ in range(_MOST_ROUNDS):
        if step < _LAST:
            break
        width = step * region.reach
        polls = region.nearest(np.concatenate([u + width * units, u - width * units]))
        found = np.asarray(values_at(list(polls)))
        up, down = found.reshape(2, -1) - value
        slope, curvature = (up - down) / (2.0 * width), (up + down) / width**2
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = np.where(curvature > 0.0, -slope / curvature, -np.sign(slope) * np.inf)
        newton = np.nan_to_num(np.clip(newton, -2.0 * width, 2.0 * width))
        # excludes coordinates at a bound, where one side is not evaluated, if the other side is no better
        newton = np.where(np.minimum(up, down) < 0.0, newton, 0.0 if region.shape == "box" else newton)
        trials = region.nearest(u + _SHARES[:, None] * newton)
        every, values = np.concatenate([polls, trials]), np.append(found, values_at(list(trials)))
        k = int(np.argmin(values))
        if values[k] < value - _GAIN * max(abs(value), 0.01):
            u, value = every[k], float(values[k])
        else:
            step *= 0.5
    return u, value


def to_corner(
    values_at: Callable[[Sequence[Array]], Sequence[float]], start: Array, box: Region
) -> tuple[Array, float]:
    """Return a corner of a box near `start` that no change of a single coordinate improves, and its value.

    If several coordinates lower the value, they are moved together where this is better than the best single change.
    """
    u = box.reach * np.where(start >= 0.0, 1.0, -1.0)
    (value,) = values_at([u])
    while len(u):
        found = np.asarray(values_at([np.where(np.arange(len(u)) == k, -u, u) for k in range(len(u))]))
        k, lower = int(np.argmin(found)), found < value - 1e-6
        if not lower[k]:
            break
        flips, least = np.arange(len(u)) == k, float(found[k])
        if lower.sum() > 1:
            (together,) = values_at([np.where(lower, -u, u)])
            flips, least = (lower, together) if together < least else (flips, least)
        u, value = np.where(flips, -u, u), least
    return u, value
