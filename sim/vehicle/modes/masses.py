"""The masses that spatial modes move: those at the stations of their table, and the engines behind their gimbals.

A table of modes contains the locked engines in its shapes and generalised masses. Its masses may contain them at
stations of their own or at the gimbals, or leave them out.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.input.errors import refuse
from maxq.sim.vehicle.modes.shapes import SpatialShapes
from maxq.sim.vehicle.modes.tables import PointMass, SpatialModeTable, twisting


class _Moved(NamedTuple):
    """Lumped masses and inertias as W weights, and the motion of each.

    - `weight` (T, W).
    - `shape` (T, M, W): displacement or rotation by each mode.
    - `turned` (T, M, W): that of the modes turned by a right angle about x.
    """

    weight: Array
    shape: Array
    turned: Array

    def products(self) -> Array:
        """Return the sums of mass times shape times shape, (T, M, M)."""
        return np.array([products(a, a, w) for a, w in zip(self.shape, self.weight, strict=True)])


@lru_cache(maxsize=16)
def turning(table: SpatialModeTable, engines: tuple[PointMass, ...], gyration_m2: float) -> Array:
    """Return (T, M, M), entry [j, i]: the share A_ij of mode i in the shape of mode j turned by a right angle about x.

    Method: least squares over the masses. The result is exact for any masses if the turned shapes are sums of modes. It
    is made antisymmetric with the generalised masses, as the integrals of the derivation are (docs/model.md, 4.7).
    `gyration_m2`: roll inertia per mass, for tables without its distribution.
    """
    moved = _moved(table, apart(table, engines), gyration_m2)
    out = np.zeros((len(table.time_s), table.modes, table.modes))
    for t, (weight, shapes, turned) in enumerate(zip(*moved, strict=True)):
        share, sums = solved(products(shapes, shapes, weight), products(shapes, turned, weight))  # (i, j)
        if sums:
            what = f"mode {sums[0] + 1} of time {t + 1} is a sum of the others, or rests"
            raise refuse(what, "independent modes")
        exchange = table.generalized_mass_kg[t][:, None] * share
        out[t] = (0.5 * (exchange - exchange.T) / table.generalized_mass_kg[t][:, None]).T
    return out


def apart(table: SpatialModeTable, engines: tuple[PointMass, ...]) -> tuple[PointMass, ...]:
    """Return the point masses that count in addition to those of the table.

    They are none, the engines, or the engines less their masses at the gimbals. The choice is the one with which the
    shapes are closest to orthogonal and have the generalised masses.
    """
    if not engines or not (table.mass_forward_kg.any() or table.mass_kg is not None):
        return ()
    at_gimbals = tuple(e._replace(mass_kg=-e.mass_kg, inertia_kgm2=0.0, arm_m=(0.0, 0.0, 0.0)) for e in engines)
    choices = ((), engines, (*engines, *at_gimbals))
    return min(choices, key=lambda points: float((_defects(table, points) ** 2).sum()))


def _defects(table: SpatialModeTable, points: tuple[PointMass, ...]) -> Array:
    """Return products of the shapes relative to the generalised masses, less those of orthogonal modes, (T, M, M).

    They are 0 for modes that twist, if the table has no roll inertia.
    """
    root = np.sqrt(table.generalized_mass_kg)
    out: Array = _moved(table, points, 0.0).products() / (root[:, :, None] * root[:, None, :]) - np.eye(table.modes)
    if table.roll_inertia_kgm2 is None:
        unknown = twisting(table)
        out[unknown[:, :, None] | unknown[:, None, :]] = 0.0
    return out


def misfit(table: SpatialModeTable, engines: tuple[PointMass, ...], within: tuple[float, float]) -> str | None:
    """Return a sentence if the shapes do not fit the masses at the stations, or None.

    `within`: factor of the generalised masses, and largest product of two modes relative to theirs.
    """
    if table.mass_kg is None:
        return None
    defects = _defects(table, apart(table, engines))
    own, pairs = 1.0 + np.diagonal(defects, axis1=1, axis2=2), np.abs(np.triu(defects, 1))
    factor, across = within
    if max(own.max(), 1.0 / max(own.min(), 1e-300)) <= factor and pairs.max() <= across:
        return None
    said = (
        f"with the masses at the stations the shapes' products are {own.min():.3g} to {own.max():.3g} "
        f"of the generalised masses, and up to {pairs.max():.2f} between modes"
    )
    if pairs.max() > across:
        t, i, j = np.unravel_index(int(np.argmax(pairs)), pairs.shape)
        said += f" ({i + 1} and {j + 1} at {table.time_s[t]:g} s): the coupling of these modes by roll is uncertain"
    return said


def _moved(table: SpatialModeTable, points: tuple[PointMass, ...], gyration_m2: float) -> _Moved:
    """Return the masses at the stations and the given point masses."""
    mass, roll = _lumped(table, gyration_m2)
    x, y, z, about_x = (*np.moveaxis(table.displacement, -1, 0), table.rotation_pm[..., 0])
    weight, shape = [mass, mass, mass, roll], [x, y, z, about_x]
    turned = [0.0 * x, -z, y, 0.0 * x]
    core = SpatialShapes(table)
    for point in points:
        x, y, z, *theta = core.at(point.station_m, point.attachments_m)[0]  # (T, M) each
        a, b, c = point.arm_m
        moved = (x + theta[1] * c - theta[2] * b, y + theta[2] * a - theta[0] * c, z + theta[0] * b - theta[1] * a)
        motions = (*moved, *theta)
        # the axial motion of a mass off the axis turns with its section, which neglects its tilt (docs/model.md, 4)
        quarter = (-theta[2] * c - theta[1] * b, -moved[2], moved[1], 0.0 * x, -theta[2], theta[1])
        own = (point.mass_kg,) * 3 + (point.inertia_kgm2,) * 3
        weight += [np.full((len(table.time_s), 1), value) for value in own]
        shape += [motion[..., None] for motion in motions]
        turned += [motion[..., None] for motion in quarter]
    return _Moved(np.concatenate(weight, axis=1), np.concatenate(shape, axis=2), np.concatenate(turned, axis=2))


def _lumped(table: SpatialModeTable, gyration_m2: float) -> tuple[Array, Array]:
    """Return mass and roll inertia at the stations, (T, S), from the table or from the mass forward of them."""
    mass = table.mass_kg
    if mass is None:
        between = np.maximum(np.diff(table.mass_forward_kg, axis=1), 0.0)
        mass = 0.5 * (np.pad(between, ((0, 0), (1, 0))) + np.pad(between, ((0, 0), (0, 1))))
        mass[mass.sum(axis=1) == 0.0] = 1.0  # the masses are unknown
    return mass, gyration_m2 * mass if table.roll_inertia_kgm2 is None else table.roll_inertia_kgm2


def products(a: Array, b: Array, weight: Array) -> Array:
    """Return weighted scalar products of the rows of `a` with those of `b`.

    math.fsum is used, because BLAS rounds differently on each processor, which would change the flight.
    """
    return np.array([[math.fsum(weight * p * q) for q in b] for p in a])


def solved(matrix: Array, right: Array) -> tuple[Array, list[int]]:
    """Solve a positive definite system by Gaussian elimination.

    The result does not depend on the rounding of a linear-algebra library. The second result lists the redundant
    unknowns, which remain zero.
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
