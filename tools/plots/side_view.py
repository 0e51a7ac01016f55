"""The side view of a vehicle as a figure to scale: nose on the left, stations along the axis."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.plots.figures import Panel, Plot, Series, points, shape


def revolved(station_m: Any, radius_m: Any, said: str = "", *, y_m: float = 0.0, **more: Any) -> Series:
    """Return a body of revolution about an axis at `y_m`. `station_m` is (n,), `radius_m` is (n,) or a single
    radius.
    """
    x, r = np.asarray(station_m, float), np.broadcast_to(np.asarray(radius_m, float), np.shape(station_m))
    return shape(np.concatenate([np.stack([x, y_m + r], 1), np.stack([x, y_m - r], 1)[::-1]]), said, **more)


def tank(station_m: Any, radius_m: Any, said: str, colour: str, *, full: bool, y_m: float = 0.0) -> Series:
    """Return the liquid of a tank if `full`, else its empty volume."""
    return revolved(station_m, radius_m, said, y_m=y_m, fill=colour, opacity=0.5 if full else 0.12, bare=True)


def nozzle(gimbal_station_m: float, exit_station_m: float, exit_radius_m: float, y_m: float) -> Series:
    r = exit_radius_m * np.array([0.3, 1.0, -1.0, -0.3])
    x = [gimbal_station_m, exit_station_m, exit_station_m, gimbal_station_m]
    return shape(np.stack([x, y_m + r], 1), fill="grey", opacity=0.4)


def fins(chord_m: Sequence[float] | Array, root_radius_m: float, tip_radius_m: float) -> list[Series]:
    """Return a pair of fins. `chord_m` contains four stations: leading edge at root and tip, trailing edge at tip and
    root.
    """
    across = np.array([root_radius_m, tip_radius_m, tip_radius_m, root_radius_m])
    return [shape(np.stack([chord_m, side * across], 1), fill="grey") for side in (1.0, -1.0)]


def figure(title: str, bodies: Sequence[Series], marks: Iterable[tuple[str, float, str]], caption: str) -> Plot:
    """Return the figure named "vehicle". `marks` on the axis are tuples of name, station (m) and colour."""
    tail_m = max(float(np.max(s["x"])) for s in bodies)
    half_m = max(float(np.max(np.abs(s["y"]))) for s in bodies)
    marked = [
        points([station], [0.0], f"{name}: {station:.2f} m", colour=colour, labels=[name], size=4)
        for name, station, colour in marks
    ]
    height = int(min(max(110.0 + 960.0 * 2.0 * half_m / tail_m, 150.0), 420.0))
    along, across = (-0.02 * tail_m, 1.02 * tail_m), (-half_m, half_m)
    hulls = [s | {"solid": True} if s.get("fill") == "page" else s for s in bodies]  # names avoid solid bodies
    panel = Panel("", [*hulls, *marked], "station, m aft of the nose", "radius, m", along, across, equal=True)
    return Plot("vehicle", title, [panel], caption, 1, height)
