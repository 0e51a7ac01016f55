"""The shapes of modes between the stations of their tables, on the core and on the boosters that it carries."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Method, fit, hermite
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

    def along(self, station_m: Array) -> Array:
        """Return phi (T, ..., M) at stations (T, ...) of each time; the body is rigid beyond the first and last one."""
        breaks = self._cubics.breaks
        inside = np.clip(station_m, breaks[0], breaks[-1])
        k = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(breaks) - 2)
        t = np.arange(len(station_m)).reshape(-1, *[1] * (station_m.ndim - 1))
        coefficients = self._cubics.coefficients.reshape(len(breaks) - 1, 4, *self._of)
        c0, c1, c2, c3 = (coefficients[:, power][k, t] for power in range(4))
        s, beyond = (inside - breaks[k])[..., None], (station_m - inside)[..., None]
        value = c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s)
        return np.asarray(value + beyond * (c1 + c2 * s * 2.0 + c3 * (s * s) * 3.0))

    def _at(self, station_m: ArrayLike) -> tuple[Array, Array]:
        """Return the distance (P, 1) into the interval of each station, and its coefficients (4, P, T M)."""
        x, breaks = np.atleast_1d(np.asarray(station_m, float)), self._cubics.breaks
        k = np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
        return (x - breaks[k])[:, None], self._cubics.coefficients[k].transpose(1, 0, 2)


def shapes_over(table: ModeTable, times: Array, method: Method) -> ModeShapes:
    """Return the shapes of a table at other times."""
    stacked = np.stack([table.phi, table.slope_pm], axis=1)
    over_time = fit(table.time_s, stacked.reshape(len(table.time_s), -1), method).at(times)
    phi, slope_pm = over_time.reshape(len(times), *stacked.shape[1:]).swapaxes(0, 1)
    return ModeShapes(replace(table, time_s=times, phi=phi, slope_pm=slope_pm))


def spatial_over(table: SpatialModeTable, times: Array, method: Method) -> SpatialModeTable:
    """Return a table of spatial modes at other times."""
    stacked = np.stack([table.displacement, table.rotation_pm], axis=1)
    over_time = fit(table.time_s, stacked.reshape(len(table.time_s), -1), method).at(times)
    displacement, rotation_pm = over_time.reshape(len(times), *stacked.shape[1:]).swapaxes(0, 1)
    return replace(table, time_s=times, displacement=displacement, rotation_pm=rotation_pm)


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


class SpatialShapes:
    """The shapes of spatial modes: displacement along, and rotation (1/m) about x, y, z of B."""

    def __init__(self, table: SpatialModeTable) -> None:
        self._of, self._lateral = (len(table.time_s), table.modes), [ModeShapes(plane) for plane in table.lateral()]
        straight = np.stack([table.displacement[..., 0], table.rotation_pm[..., 0]])  # along and about x
        self._straight = fit(table.station_m, straight.transpose(3, 0, 1, 2).reshape(len(table.station_m), -1))

    def at(
        self, station_m: ArrayLike, attachments_m: tuple[float, ...] = (), place_m: tuple[float, float] = (0.0, 0.0)
    ) -> Array:
        """Return the shapes (P, 6, T, M) at stations (P,) of the core, or at y and z of a booster on it."""
        if not attachments_m:
            return self._on(self._lateral, station_m)
        x, first = np.atleast_1d(np.asarray(station_m, float)), attachments_m[0]
        moved, turned = np.split(self._on([on_body(y, attachments_m) for y in self._lateral], first), 2, axis=1)
        arm = np.stack([first - x, np.full(len(x), place_m[0]), np.full(len(x), place_m[1])], axis=1)[..., None, None]
        swept = np.cross(turned, np.broadcast_to(arm, (len(x), *turned.shape[1:])), axis=1)
        return np.concatenate([moved + swept, np.repeat(turned, len(x), axis=0)], axis=1)

    def _on(self, lateral: Sequence[ModeShapes | _Rigid], station_m: ArrayLike) -> Array:
        x, about_x = self._straight.at(station_m).reshape(-1, 2, *self._of).transpose(1, 0, 2, 3)
        y, z = (plane.value(station_m) for plane in lateral)
        slope_y, slope_z = (plane.slope(station_m) for plane in lateral)
        return np.stack([x, y, z, about_x, slope_z, -slope_y], axis=1)
