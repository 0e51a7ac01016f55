"""Curves of many flights as families: one entity for each curve, with a line for each flight in it.

An entity for each curve of each flight, thousands of them, would keep the viewer busy for a minute. Lines of one entity
share their times. So every interval gives two rows, a quarter and three quarters into it, of its smallest and its
largest value in the order of the trend: no value is changed, but each may stand up to three quarters of an interval
aside.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.plots.palette import rgba
from maxq.tools.replay.flight import Channels
from maxq.tools.replay.plots import Tab
from maxq.tools.replay.sending import times

ROOT = "family"
FROM = 20
"""So many flights, apart from those seen closely, become families."""
_WIDTH, _ALPHA = 1.2, 0.5


def extremes_on_grid(times_ns: IntArray, values: Array, start_ns: int, interval_ns: int, count: int) -> Array:
    """Smallest and largest of `values` (n,) in each of `count` intervals from `start_ns` on, as rows (2 count,).

    nan where an interval holds no number. Samples outside are left out.
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


class Family:
    """Collects flights, then sends their curves."""

    def __init__(self, span_s: tuple[float, float], interval_ns: int) -> None:
        self._interval_ns = interval_ns
        self._start_ns = round(span_s[0] * 1e9) // interval_ns * interval_ns
        self._count = (round(span_s[1] * 1e9) - self._start_ns) // interval_ns + 1
        self._lines: dict[tuple[str, str], list[tuple[str, str, Array]]] = {}

    def add(self, label: str, colour: str, tabs: Sequence[Tab], channels: Channels) -> None:
        """A flight's curves in these tabs, named after it."""
        for tab in tabs:
            for plot in tab.plots:
                for curve in plot.curves:
                    ns, values = curve.values(channels)
                    rows = extremes_on_grid(ns, values, self._start_ns, self._interval_ns, self._count)
                    line = f"{label}: {curve.label}", colour, rows.astype("f4")
                    self._lines.setdefault((plot.key, curve.label), []).append(line)

    def send(self, recording: rr.RecordingStream) -> None:
        """Everything collected; it is forgotten on the way."""
        quarters = np.arange(2 * self._count) // 2 * self._interval_ns
        quarters += np.where(np.arange(2 * self._count) % 2, 3, 1) * self._interval_ns // 4
        at = self._start_ns + quarters
        for number, key in enumerate(list(self._lines)):
            lines = self._lines.pop(key)
            entity = f"{ROOT}/plots/{key[0]}/curve_{number + 1}"
            style = rr.SeriesLines(
                names=[name for name, _, _ in lines],
                colors=[rgba(colour, _ALPHA) for _, colour, _ in lines],
                widths=[_WIDTH] * len(lines),
                aggregation_policy=rr.components.AggregationPolicy.MinMax,
            )
            recording.log(entity, style, static=True)
            values = np.stack([rows for _, _, rows in lines], axis=1)
            some = np.flatnonzero(np.isfinite(values).any(axis=1))
            columns = rr.Scalars.columns(scalars=values[some].astype(float))
            recording.send_columns(entity, times(at[some]), columns)
