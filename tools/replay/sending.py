"""Columns for the viewer: times, rows that changed, and nothing else."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray

TIMELINE = "sim_time"
APPLICATION = "maxq"


def times(times_ns: IntArray) -> list[rr.TimeColumn]:
    """The time column of `send_columns`."""
    return [rr.TimeColumn(TIMELINE, duration=times_ns.astype("timedelta64[ns]"))]


def matrices(columns: Array) -> pa.Array:
    """Matrices (n, 9), column by column, for `Transform3D.columns`, which would convert other forms one by one."""
    kind = rr.components.TransformMat3x3Batch(np.eye(3)).pa_array.type
    return pa.FixedSizeListArray.from_arrays(pa.array(columns.astype("f4").ravel()), type=kind)


def changed(values: Array, tolerance: float) -> NDArray[np.intp]:
    """Indices of the rows of `values` (n, ...) that differ from the row before by more than rounding to `tolerance`."""
    steps = np.round(np.nan_to_num(values.reshape(len(values), -1)) / tolerance)
    if not len(steps):
        return np.zeros(0, np.intp)
    moved = (steps[1:] != steps[:-1]).any(axis=1)
    keep = np.concatenate([[True], moved])
    keep[:-1] |= moved  # the last row of a standstill, so that nothing creeps from its beginning to its end
    return np.flatnonzero(keep)


def every(times_ns: IntArray, period_ns: int, last_period: int = -1) -> NDArray[np.intp]:
    """Indices of the first row in each period."""
    return np.flatnonzero(np.diff(times_ns // period_ns, prepend=last_period) > 0)
