"""Mode tables as columns of the schedule: shapes at the places of loads and sensors, and softening."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.vehicle.engine.packing import Mount
from maxq.sim.vehicle.modes.shapes import ModeShapes, SpatialShapes, on_body
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


class Hung(NamedTuple):
    """Masses that a section, or a booster, carries behind it: their first moment about it.

    `moment_kgm`: constant, or at each time of a table. `attachments_m`: those of the booster.
    """

    station_m: float
    moment_kgm: tuple[float, ...]
    attachments_m: tuple[float, ...] = ()


class Places(NamedTuple):
    """The stations (m) at which modes act or are sensed, and the axial loads.

    `mass_kg`: mass of the vehicle at each time of a table.
    """

    mounts: tuple[Mount, ...]  # of engines
    gyro_m: float
    hinges_m: tuple[bytes, ...]  # hinge of each tank at each time (T,), as bytes
    surfaces_m: tuple[float, ...]
    sensors_m: tuple[float, ...] = ()  # of feed lines, buffet, then sensors after the gyro
    carried: Carried = Carried()
    mass_kg: tuple[float, ...] = ()
    hung: tuple[Hung, ...] = ()


@lru_cache(maxsize=16)  # a campaign packs the same modes thousands of times; a table has two planes, or one for both
def mode_values(table: ModeTable, shape: tuple[int, int], at: Places) -> Array:
    """Return the schedule columns of a plane's modes over the table's times, (T, rows times lanes).

    `shape`: rows and lanes."""
    (rows, padded_modes), n, shapes = shape, table.modes, ModeShapes(table)
    mounts, gyro_m, hinges_m, surfaces_m, sensors_m, carried = at[:6]
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
    values[:, first : first + n, :n] = _softening(table, shapes, at).transpose(0, 2, 1)
    return values.reshape(len(table.time_s), -1)


def _softening(table: ModeTable, shapes: ModeShapes, at: Places) -> Array:
    """Return the reduction of the generalised stiffness by the axial load, per unit of axial acceleration, kg/m.

    At each time, (times, modes, modes), it is the integral of N phi_i' phi_j' dx up to the last station at which thrust
    enters. The compression N per acceleration is the mass forward of a section, less the share of the thrust that
    enters forward of it times the mass of the vehicle. Masses that hang behind a section are in tension
    (docs/model.md, section 4). A booster is a rigid body that its thrust pushes and its mass pulls along its own axis.
    """
    x, forward, total = table.station_m, table.mass_forward_kg, np.zeros(())
    last_m, known = max(mount.enters_m for mount in at.mounts), bool(forward.any())
    for mount in at.mounts:
        share, ends_m = np.reshape(mount.thrust_share, (-1, 1, 1)), mount.enters_m
        total = total + share * _weighted(shapes, np.append(x[x < ends_m], ends_m), x, forward)
        if not known:
            continue
        mass = np.reshape(at.mass_kg, (-1, 1))
        if ends_m < last_m:
            between = np.concatenate([[ends_m], x[(x > ends_m) & (x < last_m)], [last_m]])
            total = total - share * _weighted(shapes, between, x, mass - forward)
        if mount.attachments_m:
            slope = on_body(shapes, mount.attachments_m).slope(ends_m)[0]
            pushed = share[:, 0, 0] * mass[:, 0] * (mount.station_m - ends_m)
            total = total + pushed[:, None, None] * (slope[:, :, None] * slope[:, None, :])
    for hung in at.hung:
        if hung.attachments_m and not known:
            continue
        slope = on_body(shapes, hung.attachments_m).slope(hung.station_m)[0]
        total = total - np.reshape(hung.moment_kgm, (-1, 1, 1)) * np.array([np.outer(each, each) for each in slope])
    return np.asarray(total)


def _weighted(shapes: ModeShapes, breaks: Array, x: Array, loads: Array) -> Array:
    """Return the integrals (T, M, M) over `breaks` of loads (T, S), linear between the stations x, times two slopes."""
    points, weights = gauss(np.unique(breaks))
    slopes = shapes.slope(points).transpose(1, 2, 0)  # (times, modes, points)
    at_points = [weights * np.interp(points, x, load) for load in loads]
    # math.fsum, not a matrix product: BLAS rounds differently on each processor, which would change the flight.
    return np.array(
        [
            [[math.fsum(a * b * load) for b in slope] for a in slope]
            for slope, load in zip(slopes, at_points, strict=True)
        ]
    )


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
    shapes = SpatialShapes(table)
    columns = [2.0 * np.pi * table.frequency_hz, table.generalized_mass_kg]  # (times, modes) each
    columns += [*shapes.at(at.gyro_m)[0]]
    for k, hinge in enumerate(at.hinges_m):  # at each time the hinge of that time
        of_hinge = shapes.at(np.frombuffer(hinge), *at.carried.of(at.carried.tanks, k))
        columns += [*np.diagonal(of_hinge, axis1=0, axis2=2).transpose(0, 2, 1)]
    places: list[tuple[float, tuple[float, ...], tuple[float, float]]] = []
    places += [(x, *at.carried.of(at.carried.surfaces, k)) for k, x in enumerate(at.surfaces_m)]
    places += [(mount.station_m, mount.attachments_m, (0.0, 0.0)) for mount in at.mounts]
    for place in (*places, *((x, (), (0.0, 0.0)) for x in at.sensors_m)):
        columns += [*shapes.at(*place)[0]]
    softening = sum(_softening(plane, ModeShapes(plane), at) for plane in table.lateral())
    return np.concatenate([np.stack(columns, axis=1), np.transpose(softening, (0, 2, 1))], axis=1)
