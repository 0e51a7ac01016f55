"""Mode tables as columns of the schedule: shapes at the places of loads and sensors, softening, turning."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import fit, hermite
from maxq.sim.vehicle.engine.packing import Mount
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)


class Carried(NamedTuple):
    """The places that boosters carry.

    - `boosters`: stations of the core to which each booster is attached (`_Rigid`), and y and z of its axis, m.
    - `tanks`, `surfaces`: body of each tank and of each surface: 0 for the core, then the boosters from 1.
    """

    boosters: tuple[tuple[tuple[float, ...], tuple[float, float]], ...] = ()
    tanks: tuple[int, ...] = ()
    surfaces: tuple[int, ...] = ()

    def of(self, bodies: tuple[int, ...], n: int) -> tuple[tuple[float, ...], tuple[float, float]]:
        """Return the stations to which the body of part n is attached (none on the core), and its y and z."""
        return self.boosters[bodies[n] - 1] if self.boosters and bodies[n] > 0 else ((), (0.0, 0.0))


class Places(NamedTuple):
    """The stations (m) at which modes act or are sensed."""

    mounts: tuple[Mount, ...]  # of engines
    gyro_m: float
    hinges_m: tuple[bytes, ...]  # hinge of each tank at each time (T,), as bytes
    surfaces_m: tuple[float, ...]
    sensors_m: tuple[float, ...] = ()  # of the sensors after the gyro
    carried: Carried = Carried()


class ModeShapes:
    """The shapes of a table's T times and M modes: cubics with its `phi` and `slope_pm` at the stations.

    Beyond the first and last station, the end cubics continue.
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
        """Return the distance (P, 1) of each station into its interval, and the coefficients (4, P, T M)."""
        x, breaks = np.atleast_1d(np.asarray(station_m, float)), self._cubics.breaks
        k = np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
        return (x - breaks[k])[:, None], self._cubics.coefficients[k].transpose(1, 0, 2)


class _Rigid:
    """The shapes of a rigid booster, clamped at one station of the core or held at its ends by two stations."""

    def __init__(self, core: ModeShapes, attachments_m: tuple[float, ...]) -> None:
        first, last = attachments_m[0], attachments_m[-1]
        self._at, self._first = first, core.value(first)
        self._slope = core.slope(first) if first == last else (core.value(last) - self._first) / (last - first)

    def value(self, station_m: ArrayLike) -> Array:
        x = np.atleast_1d(np.asarray(station_m, float))
        return np.asarray(self._first + (x - self._at)[:, None, None] * self._slope)

    def slope(self, station_m: ArrayLike) -> Array:
        return np.repeat(self._slope, np.size(station_m), axis=0)


def _on(core: ModeShapes, attachments_m: tuple[float, ...]) -> ModeShapes | _Rigid:
    """Return the shapes of the core, or of a booster attached to it."""
    return _Rigid(core, attachments_m) if attachments_m else core


@lru_cache(maxsize=16)  # a campaign packs the same modes thousands of times; a table has two planes, or one for both
def mode_values(table: ModeTable, shape: tuple[int, int], at: Places) -> Array:
    """Return the schedule columns of a plane's modes over the table's times, (T, rows times lanes).

    `shape`: rows and lanes."""
    (rows, padded_modes), n, shapes = shape, table.modes, ModeShapes(table)
    mounts, gyro_m, hinges_m, surfaces_m, sensors_m, carried = at
    of_mounts = [(_on(shapes, mount.attachments_m), mount.station_m) for mount in mounts]
    gimbals = [shape(x)[0] for on, x in of_mounts for shape in (on.value, on.slope)]
    columns = [2.0 * np.pi * table.frequency_hz, table.generalized_mass_kg]  # (times, modes) each
    columns += [*gimbals[:2], shapes.slope(gyro_m)[0]]
    for k, hinge in enumerate(hinges_m):  # the hinge position differs between times
        on = _on(shapes, carried.of(carried.tanks, k)[0])
        columns.append(np.diagonal(on.value(np.frombuffer(hinge))).T)
    for k, station in enumerate(surfaces_m):
        on = _on(shapes, carried.of(carried.surfaces, k)[0])
        columns += [on.value(station)[0], on.slope(station)[0]]
    columns += gimbals[2:]
    for station in sensors_m:
        columns += [shapes.value(station)[0], shapes.slope(station)[0]]
    values = np.zeros((len(table.time_s), rows, padded_modes))
    values[:, : len(columns), :n] = np.stack(columns, axis=1)
    first = rows - padded_modes
    values[:, first : first + n, :n] = _softening(table, shapes, mounts).transpose(0, 2, 1)
    return values.reshape(len(table.time_s), -1)


def _softening(table: ModeTable, shapes: ModeShapes, mounts: tuple[Mount, ...]) -> Array:
    """Return the softening by the thrust of engines at several stations, each with its share of the thrust."""
    first, *others = (_softening_up_to(table, shapes, mount) for mount in mounts)
    for other in others:
        first = first + other
    return first


def _softening_up_to(table: ModeTable, shapes: ModeShapes, mount: Mount) -> Array:
    """Return the reduction of the generalised stiffness by the axial load, per unit of axial acceleration, kg/m.

    At each time, (times, modes, modes), it is the integral of m_forward phi_i' phi_j' dx up to the gimbal. The
    contribution of the engine aft of the gimbal, which is in tension, is subtracted (docs/model.md, section 4). The
    axial force at a station is the mass forward of it times the acceleration.
    """
    x, gimbal_m = table.station_m, mount.attachments_m[0] if mount.attachments_m else mount.station_m
    points, weights = gauss(np.unique(np.append(x[x < gimbal_m], gimbal_m)))
    slopes = shapes.slope(points).transpose(1, 2, 0)  # (times, modes, points)
    loads = [weights * np.interp(points, x, forward) for forward in table.mass_forward_kg]
    # math.fsum, not a matrix product: BLAS rounds differently on each processor, which would change the flight.
    matrices = np.array(
        [[[math.fsum(a * b * load) for b in slope] for a in slope] for slope, load in zip(slopes, loads, strict=True)]
    )
    hanging = mount.hanging_kgm * np.array(
        [np.outer(slope, slope) for slope in _on(shapes, mount.attachments_m).slope(gimbal_m)[0]]
    )
    return np.asarray(mount.thrust_share * matrices - hanging)


def gauss(breaks: Array) -> tuple[Array, Array]:
    """Return points and weights of an integral over each interval, exact for polynomials of degree 7.

    The order is the first points of all intervals, then the second points, and so on.
    """
    half = 0.5 * np.diff(breaks)
    points = 0.5 * (breaks[1:] + breaks[:-1]) + np.outer(_GAUSS_NODES, half)
    return points.ravel(), np.outer(_GAUSS_WEIGHTS, half).ravel()


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


@lru_cache(maxsize=16)
def spatial_values(table: SpatialModeTable, at: Places) -> Array:
    """Return rows and lanes of the spatial modes over the table's times, (T, rows, M), without `masses.turning`."""
    shapes = spatial_shapes(table)
    columns = [2.0 * np.pi * table.frequency_hz, table.generalized_mass_kg]  # (times, modes) each
    columns += [*shapes(at.gyro_m)[0]]
    for k, hinge in enumerate(at.hinges_m):  # at each time the hinge of that time
        on = spatial_on(shapes, *at.carried.of(at.carried.tanks, k))
        columns += [*np.diagonal(on(np.frombuffer(hinge)), axis1=0, axis2=2).transpose(0, 2, 1)]
    places = [(spatial_on(shapes, *at.carried.of(at.carried.surfaces, k)), x) for k, x in enumerate(at.surfaces_m)]
    places += [(spatial_on(shapes, mount.attachments_m, (0.0, 0.0)), mount.station_m) for mount in at.mounts]
    for on, station in (*places, *((shapes, x) for x in at.sensors_m)):
        columns += [*on(station)[0]]
    softening = sum(_softening(plane, ModeShapes(plane), at.mounts) for plane in table.lateral())
    return np.concatenate([np.stack(columns, axis=1), np.transpose(softening, (0, 2, 1))], axis=1)
