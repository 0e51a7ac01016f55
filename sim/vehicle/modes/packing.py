"""Mode tables as columns of the schedule: shapes at the places of loads and sensors, and softening."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.vehicle.engine.packing import Mount
from maxq.sim.vehicle.modes.shapes import ModeShapes, on_body, spatial_on, spatial_shapes
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
    sensors_m: tuple[float, ...] = ()  # of feed lines, buffet, then sensors after the gyro
    carried: Carried = Carried()


@lru_cache(maxsize=16)  # a campaign packs the same modes thousands of times; a table has two planes, or one for both
def mode_values(table: ModeTable, shape: tuple[int, int], at: Places) -> Array:
    """Return the schedule columns of a plane's modes over the table's times, (T, rows times lanes).

    `shape`: rows and lanes."""
    (rows, padded_modes), n, shapes = shape, table.modes, ModeShapes(table)
    mounts, gyro_m, hinges_m, surfaces_m, sensors_m, carried = at
    of_mounts = [(on_body(shapes, mount.attachments_m), mount.station_m) for mount in mounts]
    gimbals = [shape(x)[0] for on, x in of_mounts for shape in (on.value, on.slope)]
    columns = [2.0 * np.pi * table.frequency_hz, table.generalized_mass_kg]  # (times, modes) each
    columns += [*gimbals[:2], shapes.slope(gyro_m)[0]]
    for k, hinge in enumerate(hinges_m):  # the hinge position differs between times
        on = on_body(shapes, carried.of(carried.tanks, k)[0])
        columns.append(np.diagonal(on.value(np.frombuffer(hinge))).T)
    for k, station in enumerate(surfaces_m):
        on = on_body(shapes, carried.of(carried.surfaces, k)[0])
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
        [np.outer(slope, slope) for slope in on_body(shapes, mount.attachments_m).slope(gimbal_m)[0]]
    )
    return np.asarray(mount.thrust_share * matrices - hanging)


def gauss(breaks: Array) -> tuple[Array, Array]:
    """Return points and weights of an integral over each interval, exact for polynomials of degree 7.

    The order is the first points of all intervals, then the second points, and so on.
    """
    half = 0.5 * np.diff(breaks)
    points = 0.5 * (breaks[1:] + breaks[:-1]) + np.outer(_GAUSS_NODES, half)
    return points.ravel(), np.outer(_GAUSS_WEIGHTS, half).ravel()


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
