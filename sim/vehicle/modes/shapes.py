"""The shapes of modes between the stations of their tables, on the core and on the boosters that it carries."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import fit, hermite
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable


class ModeShapes:
    """The shapes of the T times and M modes of a table: cubics with its `phi` and `slope_pm` at the stations.

    Beyond the first and last station the end cubics continue.
    """

    def __init__(self, table: ModeTable) -> None:
        self._of = table.phi.shape[:2]
        stations = len(table.station_m)
        columns = (values.reshape(-1, stations).T for values in (table.phi, table.slope_pm))
        self._cubics = hermite(table.station_m, *columns)

    def value(self, station_m: ArrayLike) -> Array:
        """Return phi (P, T, M) at stations (P,)."""
        s, (c0, c1, c2, c3) = self._at(station_m)
        return np.reshape(c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s), (-1, *self._of))

    def slope(self, station_m: ArrayLike) -> Array:
        """Return d(phi)/d(station) (P, T, M) at stations (P,), 1/m."""
        s, (_, c1, c2, c3) = self._at(station_m)
        return np.reshape(c1 + c2 * s * 2.0 + c3 * (s * s) * 3.0, (-1, *self._of))

    def _at(self, station_m: ArrayLike) -> tuple[Array, Array]:
        """Return the distance (P, 1) into the interval of each station, and its coefficients (4, P, T M)."""
        x, breaks = np.atleast_1d(np.asarray(station_m, float)), self._cubics.breaks
        k = np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
        return (x - breaks[k])[:, None], self._cubics.coefficients[k].transpose(1, 0, 2)


class _Rigid:
    """The shapes of a rigid booster that one station of the core clamps, or two stations hold at its ends."""

    def __init__(self, core: ModeShapes, attachments_m: tuple[float, ...]) -> None:
        first, last = attachments_m[0], attachments_m[-1]
        self._at, self._first = first, core.value(first)
        self._slope = core.slope(first) if first == last else (core.value(last) - self._first) / (last - first)

    def value(self, station_m: ArrayLike) -> Array:
        x = np.atleast_1d(np.asarray(station_m, float))
        return np.asarray(self._first + (x - self._at)[:, None, None] * self._slope)

    def slope(self, station_m: ArrayLike) -> Array:
        return np.repeat(self._slope, np.size(station_m), axis=0)


def on_body(core: ModeShapes, attachments_m: tuple[float, ...]) -> ModeShapes | _Rigid:
    """Return the shapes of the core, or of a booster on it."""
    return _Rigid(core, attachments_m) if attachments_m else core


def spatial_shapes(table: SpatialModeTable) -> Callable[[ArrayLike], Array]:
    """Return the shapes (P, 6, T, M) at stations (P,): displacement along, rotation (1/m) about x, y, z of B."""
    n, lateral = table.modes, [ModeShapes(plane) for plane in table.lateral()]
    straight = np.stack([table.displacement[..., 0], table.rotation_pm[..., 0]])  # along and about x
    joined = fit(table.station_m, straight.transpose(3, 0, 1, 2).reshape(len(table.station_m), -1))

    def shapes(station_m: ArrayLike) -> Array:
        x, about_x = joined.at(station_m).reshape(-1, 2, len(table.time_s), n).transpose(1, 0, 2, 3)
        y, z = (plane.value(station_m) for plane in lateral)
        slope_y, slope_z = (plane.slope(station_m) for plane in lateral)
        return np.stack([x, y, z, about_x, slope_z, -slope_y], axis=1)

    return shapes


def spatial_on(
    core: Callable[[ArrayLike], Array], attachments_m: tuple[float, ...], place_m: tuple[float, float]
) -> Callable[[ArrayLike], Array]:
    """Return the shapes of the core, or of a point at y and z of a booster that moves as `_Rigid`."""
    if not attachments_m:
        return core
    first, last = attachments_m[0], attachments_m[-1]
    moved, turned = np.split(core(first), 2, axis=1)
    if first != last:
        lean = (core(last)[:, :3] - moved) / (last - first)
        turned = np.stack([turned[:, 0], lean[:, 2], -lean[:, 1]], axis=1)

    def shapes(station_m: ArrayLike) -> Array:
        x = np.atleast_1d(np.asarray(station_m, float))
        arm = np.stack([first - x, np.full(len(x), place_m[0]), np.full(len(x), place_m[1])], axis=1)[..., None, None]
        swept = np.cross(turned, np.broadcast_to(arm, (len(x), *turned.shape[1:])), axis=1)
        return np.concatenate([moved + swept, np.repeat(turned, len(x), axis=0)], axis=1)

    return shapes
