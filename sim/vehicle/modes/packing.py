"""Mode tables as columns of the schedule: shapes where something acts or measures, softening, turning."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import fit, hermite
from maxq.sim.input.errors import refuse
from maxq.sim.vehicle.engine.packing import Mount
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(4)


class Places(NamedTuple):
    """Stations (m) at which modes act or are sensed."""

    mounts: tuple[Mount, ...]  # of engines
    gyro_m: float
    hinges_m: tuple[bytes, ...]  # of each tank at each time (T,), as bytes
    surfaces_m: tuple[float, ...]
    sensors_m: tuple[float, ...] = ()  # beyond the gyro


class ModeShapes:
    """Shapes of the T times and M modes of a table: cubics with its `phi` and `slope_pm` at the stations.

    Beyond the first and last station the cubics there go on.
    """

    def __init__(self, table: ModeTable) -> None:
        self._of = table.phi.shape[:2]
        stations = len(table.station_m)
        columns = (values.reshape(-1, stations).T for values in (table.phi, table.slope_pm))
        self._cubics = hermite(table.station_m, *columns)

    def value(self, station_m: ArrayLike) -> Array:
        """phi (P, T, M) at stations (P,)."""
        s, (c0, c1, c2, c3) = self._at(station_m)
        return np.reshape(c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s), (-1, *self._of))

    def slope(self, station_m: ArrayLike) -> Array:
        """d(phi)/d(station) (P, T, M) at stations (P,), 1/m."""
        s, (_, c1, c2, c3) = self._at(station_m)
        return np.reshape(c1 + c2 * s * 2.0 + c3 * (s * s) * 3.0, (-1, *self._of))

    def _at(self, station_m: ArrayLike) -> tuple[Array, Array]:
        """Distance (P, 1) into the interval of each station, and its coefficients (4, P, T M)."""
        x, breaks = np.atleast_1d(np.asarray(station_m, float)), self._cubics.breaks
        k = np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
        return (x - breaks[k])[:, None], self._cubics.coefficients[k].transpose(1, 0, 2)


@lru_cache(maxsize=16)  # a campaign packs the same modes thousands of times; a table has two planes, or one for both
def mode_values(table: ModeTable, shape: tuple[int, int], at: Places) -> Array:
    """Rows and lanes (`shape`) of a plane over the table's times, (T, rows times lanes)."""
    (rows, padded_modes), n, shapes = shape, table.modes, ModeShapes(table)
    mounts, gyro_m, hinges_m, surfaces_m, sensors_m = at
    gimbals = [shape(mount.station_m)[0] for mount in mounts for shape in (shapes.value, shapes.slope)]
    columns = [2.0 * np.pi * table.frequency_hz, table.generalized_mass_kg]  # each of them (times, modes)
    columns += [*gimbals[:2], shapes.slope(gyro_m)[0]]
    for hinge in hinges_m:  # at each time the hinge of that time
        columns.append(np.diagonal(shapes.value(np.frombuffer(hinge))).T)
    for station in surfaces_m:
        columns += [shapes.value(station)[0], shapes.slope(station)[0]]
    columns += gimbals[2:]
    for station in sensors_m:
        columns += [shapes.value(station)[0], shapes.slope(station)[0]]
    values = np.zeros((len(table.time_s), rows, padded_modes))
    values[:, : len(columns), :n] = np.stack(columns, axis=1)
    first = rows - padded_modes
    values[:, first : first + n, :n] = _softening(table, shapes, mounts).transpose(0, 2, 1)
    return values.reshape(len(table.time_s), -1)


def _softening(table: ModeTable, shapes: ModeShapes, mounts: tuple[Mount, ...]) -> Array:
    """Return the softening by the thrust of engines at several stations, each of which carries its share."""
    first, *others = (_softening_up_to(table, shapes, mount) for mount in mounts)
    for other in others:
        first = first + other
    return first


def _softening_up_to(table: ModeTable, shapes: ModeShapes, mount: Mount) -> Array:
    """Generalised stiffness per unit of axial acceleration that the axial load takes from the modes, kg/m.

    At each time (times, modes, modes): integral of m_forward phi_i' phi_j' dx up to the gimbal, less what the engine
    behind it gives back: it hangs in tension (docs/model.md, section 4; the axial force at a station is the mass
    forward of it times the acceleration).
    """
    x, gimbal_m = table.station_m, mount.station_m
    points, weights = gauss(np.unique(np.append(x[x < gimbal_m], gimbal_m)))
    slopes = shapes.slope(points).transpose(1, 2, 0)  # (times, modes, points)
    loads = [weights * np.interp(points, x, forward) for forward in table.mass_forward_kg]
    # math.fsum, not a matrix product: BLAS rounds as it likes, another way on each processor, and a flight would too
    matrices = np.array(
        [[[math.fsum(a * b * load) for b in slope] for a in slope] for slope, load in zip(slopes, loads, strict=True)]
    )
    hanging = mount.hanging_kgm * np.array([np.outer(slope, slope) for slope in shapes.slope(gimbal_m)[0]])
    return np.asarray(mount.thrust_share * matrices - hanging)


def gauss(breaks: Array) -> tuple[Array, Array]:
    """Points and weights of an integral over each interval, for polynomials of degree 7: all first points, ..."""
    half = 0.5 * np.diff(breaks)
    points = 0.5 * (breaks[1:] + breaks[:-1]) + np.outer(_GAUSS_NODES, half)
    return points.ravel(), np.outer(_GAUSS_WEIGHTS, half).ravel()


def spatial_shapes(table: SpatialModeTable) -> Callable[[ArrayLike], Array]:
    """The shapes (P, 6, T, M) at stations (P,): displacement along, rotation (1/m) about x, y, z of B."""
    n, lateral = table.modes, [ModeShapes(plane) for plane in table.lateral()]
    straight = np.stack([table.displacement[..., 0], table.rotation_pm[..., 0]])  # along and about x
    joined = fit(table.station_m, straight.transpose(3, 0, 1, 2).reshape(len(table.station_m), -1))

    def shapes(station_m: ArrayLike) -> Array:
        x, about_x = joined.at(station_m).reshape(-1, 2, len(table.time_s), n).transpose(1, 0, 2, 3)
        y, z = (plane.value(station_m) for plane in lateral)
        slope_y, slope_z = (plane.slope(station_m) for plane in lateral)
        return np.stack([x, y, z, about_x, slope_z, -slope_y], axis=1)

    return shapes


@lru_cache(maxsize=16)
def spatial_values(table: SpatialModeTable, at: Places, gyration_m2: float) -> Array:
    """Rows and lanes of the spatial modes over the table's times, (T, rows times M).

    `gyration_m2`: roll inertia per mass, for tables that do not say how it is distributed.
    """
    shapes = spatial_shapes(table)
    columns = [2.0 * np.pi * table.frequency_hz, table.generalized_mass_kg]  # each of them (times, modes)
    columns += [*shapes(at.gyro_m)[0]]
    for hinge in at.hinges_m:  # at each time the hinge of that time
        columns += [*np.diagonal(shapes(np.frombuffer(hinge)), axis1=0, axis2=2).transpose(0, 2, 1)]
    for station in (*at.surfaces_m, *(mount.station_m for mount in at.mounts), *at.sensors_m):
        columns += [*shapes(station)[0]]
    softening = sum(_softening(plane, ModeShapes(plane), at.mounts) for plane in table.lateral())
    rows = [np.stack(columns, axis=1), np.transpose(softening, (0, 2, 1)), _turning(table, gyration_m2)]
    return np.concatenate(rows, axis=1).reshape(len(table.time_s), -1)


def _turning(table: SpatialModeTable, gyration_m2: float) -> Array:
    """(T, M, M), entry [j, i]: the share A_ij of mode i in the shape of mode j turned by a right angle about x.

    Least squares over the stations under their masses: exact where the turned shapes are sums of modes, whatever the
    masses; made antisymmetric with the generalised masses, as the integrals of the derivation are (docs/model.md, 4.7).
    """
    masses, rolling = _lumped(table, gyration_m2)
    x, y, z, about_x = (*np.moveaxis(table.displacement, -1, 0), table.rotation_pm[..., 0])
    out = np.zeros((len(table.time_s), table.modes, table.modes))
    for t, (mass, roll) in enumerate(zip(masses, rolling, strict=True)):
        weight = np.concatenate([mass, mass, mass, roll])
        shapes = np.concatenate([x[t], y[t], z[t], about_x[t]], axis=1)
        turned = np.concatenate([0.0 * x[t], -z[t], y[t], 0.0 * x[t]], axis=1)
        share, sums = solved(products(shapes, shapes, weight), products(shapes, turned, weight))  # (i, j)
        if sums:
            what = f"mode {sums[0] + 1} of time {t + 1} is a sum of the others, or rests"
            raise refuse(what, "independent modes")
        exchange = table.generalized_mass_kg[t][:, None] * share
        out[t] = (0.5 * (exchange - exchange.T) / table.generalized_mass_kg[t][:, None]).T
    return out


def _lumped(table: SpatialModeTable, gyration_m2: float) -> tuple[Array, Array]:
    """Mass and roll inertia at the stations, (T, S): those of the table, else of the mass forward of them."""
    mass = table.mass_kg
    if mass is None:
        between = np.maximum(np.diff(table.mass_forward_kg, axis=1), 0.0)
        mass = 0.5 * (np.pad(between, ((0, 0), (1, 0))) + np.pad(between, ((0, 0), (0, 1))))
        mass[mass.sum(axis=1) == 0.0] = 1.0  # nothing is known of the masses
    return mass, gyration_m2 * mass if table.roll_inertia_kgm2 is None else table.roll_inertia_kgm2


def products(a: Array, b: Array, weight: Array) -> Array:
    """Weighted scalar products of the rows of `a` with those of `b`; math.fsum for the reason given in `_softening`."""
    return np.array([[math.fsum(weight * p * q) for q in b] for p in a])


def solved(matrix: Array, right: Array) -> tuple[Array, list[int]]:
    """Gauss's elimination for a positive definite matrix, without a linear-algebra library's own rounding.

    Second, the unknowns that the others make superfluous; they are left at zero.
    """
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), np.finfo(float).tiny))
    m, x = matrix * np.outer(scale, scale), right * scale[:, None]
    sums = []
    for k in range(len(m)):
        if m[k, k] < 1e-10:
            sums.append(k)
            m[k], m[:, k], x[k], m[k, k] = 0.0, 0.0, 0.0, 1.0
            continue
        for i in range(len(m)):
            if i != k:
                factor = m[i, k] / m[k, k]
                m[i], x[i] = m[i] - factor * m[k], x[i] - factor * x[k]
    return x / np.diag(m)[:, None] * scale[:, None], sums
