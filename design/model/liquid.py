"""Lateral slosh of an upright cylinder as a pendulum (Lee, Ahn & Roh, eqs 22, 23, 25, with errata 6 and 7).

With the tank's radius R, the liquid's depth h and xi the first root of J1' (NASA SP-106, ch. 6; Dodge, The New
"Dynamic Behavior of Liquids in Moving Containers", 2000):

    L = R / (xi tanh(xi h / R)),    m_p = m 2 R tanh(xi h / R) / (xi h (xi^2 - 1)),
    hinge above the liquid's CG by  h / 2 - (2 R / xi) tanh(xi h / (2 R)) + L.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.vehicle_at import Pendulums

XI = 1.84118378134066
_SHALLOWEST = 1e-6  # depth in radii: the formulae are limits at zero


@dataclass(frozen=True)
class Liquids:
    """What lies in the tanks, one entry a tank, (tanks,)."""

    radius_m: Array
    height_m: Array


def as_printed(pendulums: Pendulums, liquids: Liquids, radius: bool, liquid: bool) -> Pendulums:
    """The pendulums that eqs 22, 23 and 25 give with their errata left in.

    `radius` False: the diameter stands where the radius should. `liquid` False: all propellant for that of the tank.
    Each true pendulum tells how much liquid there is and where; the hinge, of which the paper says nothing, goes
    where the formula above puts it with the same radius. Damping ratio stays.
    """
    r = liquids.radius_m
    h = np.maximum(liquids.height_m, _SHALLOWEST * r)
    used = r if radius else 2.0 * r
    in_tank = pendulums.mass_kg / _mass_ratio(r, h)
    counted = in_tank if liquid else np.full_like(in_tank, in_tank.sum())
    centre = pendulums.hinge_station_m + _hinge_above(r, h, pendulums.length_m)
    length = pendulums.length_m if radius else _length(used, h)
    mass = counted * _mass_ratio(used, h)
    there = pendulums.mass_kg > 0.0
    grown = np.divide(mass, pendulums.mass_kg, out=np.ones_like(mass), where=there)
    return dataclasses.replace(
        pendulums,
        mass_kg=mass,
        mass_rate_kgps=pendulums.mass_rate_kgps * grown,
        length_m=length,
        hinge_station_m=centre - _hinge_above(used, h, length),
    )


def _length(radius: Array, height: Array) -> Array:
    return np.asarray(radius / (XI * np.tanh(XI * height / radius)))


def _mass_ratio(radius: Array, height: Array) -> Array:
    x = XI * height / radius
    return np.asarray(2.0 * np.tanh(x) / (x * (XI * XI - 1.0)))


def _hinge_above(radius: Array, height: Array, length: Array) -> Array:
    """Height of the hinge above the liquid's CG."""
    return np.asarray(0.5 * height - 2.0 * radius / XI * np.tanh(0.5 * XI * height / radius) + length)
