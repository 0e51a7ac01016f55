"""Decimation that keeps the extremes: every point kept is a sample of the log, at its own time.

Averages, or every n-th sample, would show an oscillation of 9 Hz too small or at a wrong frequency. Here, the smallest
and the largest sample of each interval are kept, as well as the first and the last sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray

KeptRows = NDArray[np.intp]


def extremes(times_ns: IntArray, values: Array, interval_ns: int, *, even: bool = False) -> KeptRows:
    """Return the indices, in rising order, of the smallest and largest samples of `values` (n,) in each interval.

    Gaps (NaN) remain gaps: an interval without numbers keeps one NaN. Samples inside a constant stretch are omitted
    without loss. With `even`, they are omitted only if all samples are equal: Rerun merges a fixed number of samples
    into a pixel, and would draw a stretch with few samples at the preceding value.
    """
    n = len(values)
    if n < 3:
        return np.arange(n)
    kept = np.arange(n)
    if interval_ns > 0:
        starts = np.flatnonzero(np.diff(times_ns // interval_ns, prepend=times_ns[0] // interval_ns - 1))
        if len(starts) * 2 < n:
            chosen = np.zeros(n, bool)
            for extreme in (np.minimum, np.maximum):
                chosen[_first_of_each(values, starts, extreme)] = True
            chosen[[0, -1]] = True
            kept = np.flatnonzero(chosen)
    line = values[kept]
    same = (line[1:] == line[:-1]) | (np.isnan(line[1:]) & np.isnan(line[:-1]))
    if even and not same.all():
        return kept
    bends = np.ones(len(line), bool)
    bends[1:-1] = ~(same[1:] & same[:-1])
    return kept[bends]


def _first_of_each(values: Array, starts: KeptRows, extreme: np.ufunc) -> KeptRows:
    """Return the index of the first occurrence of the extreme in each interval. `starts` are the intervals' first
    indices.
    """
    gaps = np.isnan(values)
    filled = np.where(gaps, np.inf if extreme is np.minimum else -np.inf, values) if gaps.any() else values
    lengths = np.diff(starts, append=len(values))
    at = np.flatnonzero(filled == np.repeat(extreme.reduceat(filled, starts), lengths))
    return at[np.diff(np.searchsorted(starts, at, side="right"), prepend=0) > 0]


def extremes_on_grid(times_ns: IntArray, values: Array, start_ns: int, interval_ns: int, count: int) -> Array:
    """Return the smallest and largest of `values` (n,) in each of `count` intervals from `start_ns` on, as an array (2
    count,).

    Both are in the order of the trend, and NaN if an interval contains no number. Samples outside the grid are ignored.
    """
    out = np.full((count, 2), np.nan)
    number = (times_ns - start_ns) // interval_ns
    inside = np.flatnonzero((number >= 0) & (number < count))
    if not len(inside):
        return out.ravel()
    some, number = values[inside], number[inside]
    first = np.flatnonzero(np.diff(number, prepend=-1))
    last = np.append(first[1:], len(some)) - 1
    low, high = np.fmin.reduceat(some, first), np.fmax.reduceat(some, first)
    falls = some[last] < some[first]
    out[number[first], 0] = np.where(falls, high, low)
    out[number[first], 1] = np.where(falls, low, high)
    return out.ravel()


def changed(values: Array, tolerance: float) -> KeptRows:
    """Return the indices of the rows of `values` (n, ...) that differ from the preceding row after rounding to
    `tolerance`.

    The last row of each constant stretch is included.
    """
    steps = np.round(np.nan_to_num(values.reshape(len(values), -1)) / tolerance)
    if not len(steps):
        return np.zeros(0, np.intp)
    moved = (steps[1:] != steps[:-1]).any(axis=1)
    keep = np.append(True, moved)
    keep[:-1] |= moved  # so that interpolation does not start at the beginning of the constant stretch
    return np.flatnonzero(keep)


def every(times_ns: IntArray, period_ns: int, last_period: int = -1) -> KeptRows:
    """Return the indices of the first row in each period, for periods after `last_period`."""
    return np.flatnonzero(np.diff(times_ns // period_ns, prepend=last_period) > 0)


def last_before(times_ns: IntArray, at_ns: IntArray) -> KeptRows:
    """Return for each time in `at_ns` the index of the last row at or before it, or 0 if there is none."""
    return np.clip(np.searchsorted(times_ns, at_ns, side="right") - 1, 0, None)
