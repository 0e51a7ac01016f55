"""Fewer samples that lie about nothing: every point kept is a sample of the log, every extreme is kept.

Averaging, or taking every n-th sample, shows an oscillation of 9 Hz too small or at a wrong frequency. Here the
smallest and the largest sample of each interval stay, at their own times, and so do the first and the last sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray


def extremes(times_ns: IntArray, values: Array, interval_ns: int) -> NDArray[np.intp]:
    """Indices, rising, of the samples to keep of `values` (n,): smallest and largest in each interval.

    Gaps (nan) stay gaps: an interval without numbers keeps one nan. Samples inside a stretch that does not change are
    left out, which loses nothing of a line.
    """
    n = len(values)
    if n < 3:
        return np.arange(n)
    kept = np.arange(n)
    if interval_ns > 0:
        starts = np.flatnonzero(np.diff(times_ns // interval_ns, prepend=times_ns[0] // interval_ns - 1))
        if len(starts) * 2 < n:
            kept = _of_intervals(values, starts)
    return kept[_bends(values[kept])]


def _of_intervals(values: Array, starts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Where the smallest and largest value of each interval stand; `starts` are the intervals' first indices."""
    n = len(values)
    lengths = np.diff(starts, append=n)
    if len(lengths) > 2 and (lengths[1:-1] == lengths[1]).all():  # evenly sampled: as a matrix
        width, first = int(lengths[1]), int(starts[1])
        whole = values[first : first + width * (len(lengths) - 2)].reshape(-1, width)
        base = first + width * np.arange(len(whole))
        low, high = _argmin(whole), _argmax(whole)
        edges = [_piece(values, 0, first), _piece(values, first + whole.size, n)]
        found = np.concatenate([base + low, base + high, *edges])
    else:
        found = np.concatenate([_piece(values, a, a + w) for a, w in zip(starts, lengths, strict=True)])
    kept = np.zeros(n, bool)
    kept[found] = kept[0] = kept[n - 1] = True
    return np.flatnonzero(kept)


def _piece(values: Array, start: int, end: int) -> NDArray[np.intp]:
    part = values[start:end].reshape(1, -1)
    if not part.size:
        return np.zeros(0, np.intp)
    return start + np.array([_argmin(part)[0], _argmax(part)[0]], np.intp)


def _argmin(rows: Array) -> NDArray[np.intp]:
    return np.asarray(np.argmin(np.where(np.isnan(rows), np.inf, rows), axis=1))


def _argmax(rows: Array) -> NDArray[np.intp]:
    return np.asarray(np.argmax(np.where(np.isnan(rows), -np.inf, rows), axis=1))


def _bends(values: Array) -> NDArray[np.bool_]:
    """False inside stretches of equal values (or of nan)."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    keep = np.ones(len(values), bool)
    keep[1:-1] = ~(same[1:] & same[:-1])
    return keep
