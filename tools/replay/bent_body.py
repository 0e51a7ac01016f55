"""The bent centre line: mode shapes times modal coordinates, and how much larger than life it is drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.sim.scenario.modes import ModeTable
from maxq.tools.replay.flight import Channels
from maxq.tools.replay.vehicle_shape import StageShape

PLANES = ("pitch", "yaw")
LARGEST = 0.35  # of the diameter: how far the automatic factor lets the body bend


def modal_coordinates(channels: Channels, plane: str, at: NDArray[np.intp] | slice = slice(None)) -> Array:
    """Displacement coordinates (n, modes) of a plane, nan (a stage with fewer modes) as zero."""
    names = [c.name for t in channels.table.topics for c in t.channels if c.name.startswith(f"eta_{plane}_")]
    names = [name for name in names if name.endswith("_m")]
    if not names:
        return np.zeros((0, 0))
    return np.nan_to_num(np.stack([channels[name][at] for name in names], axis=1))


def shapes_at(table: ModeTable, clock_s: Array, stations_m: Array, column: str = "phi") -> Array:
    """Mode shapes (n, modes, stations), or their slopes, at stage times (n,) and stations; linear between the rows."""
    values: Array = getattr(table, column)
    place = np.clip(stations_m, table.station_m[0], table.station_m[-1])
    k = np.clip(np.searchsorted(table.station_m, place) - 1, 0, len(table.station_m) - 2)
    part = (place - table.station_m[k]) / (table.station_m[k + 1] - table.station_m[k])
    along = values[:, :, k] * (1.0 - part) + values[:, :, k + 1] * part
    if len(table.time_s) == 1:
        return np.broadcast_to(along[0], (len(clock_s), *along.shape[1:]))
    now = np.clip(clock_s, table.time_s[0], table.time_s[-1])
    t = np.clip(np.searchsorted(table.time_s, now) - 1, 0, len(table.time_s) - 2)
    share = ((now - table.time_s[t]) / (table.time_s[t + 1] - table.time_s[t]))[:, None, None]
    return np.asarray(along[t] * (1.0 - share) + along[t + 1] * share)


def bent_line(
    stage: StageShape, clock_s: Array, pitch: Array, yaw: Array, stations_m: Array, column: str = "phi"
) -> Array:
    """Displacement (n, stations, 2) of the axis along body y and z, true to scale; with `slope_pm` its slope."""
    out = np.zeros((len(clock_s), len(stations_m), 2))
    for axis, (table, eta) in enumerate(zip(reversed(stage.modes), (yaw, pitch), strict=True)):
        if table is not None and eta.shape[1:] and eta.shape[1] >= table.modes:
            shapes = shapes_at(table, clock_s, stations_m, column)
            out[:, :, axis] = np.einsum("nm,nms->ns", eta[:, : table.modes], shapes)
    return out


def nice_factor(largest_m: float, wanted_m: float, most: float = 1e6) -> float:
    """The largest of 1, 2, 5, 10, 20, ... that keeps `largest_m` times it below `wanted_m`; 1 for no bending at all."""
    if not np.isfinite(largest_m) or largest_m <= 0.0 or largest_m >= wanted_m:
        return 1.0
    exact = min(wanted_m / largest_m, most)
    power = 10.0 ** np.floor(np.log10(exact))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= exact * (1 + 1e-12)))
