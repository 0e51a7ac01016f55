"""The motion of the air relative to the Earth over altitude: a profile plus discrete gusts, in North-East-Down."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_GUSTS
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.tables import NO_TABLE, TableRef, find_interval, interpolate

ONE_MINUS_COSINE, SHEAR = 0, 1
"""The kinds of gust layers, which begin at an altitude and have a thickness, m.

ONE_MINUS_COSINE rises over its edge as (1 - cos)/2, is constant over thickness - 2 edge, and falls over its edge
(NASA-HDBK-1001, sec. 2; with 2 edge = thickness it is the classical 1-cosine). SHEAR rises linearly over its thickness
and is constant at all altitudes above.
"""


def _gust_values() -> Array:
    return np.zeros(MAX_GUSTS)


@dataclass(frozen=True)
class Wind:
    """The parameter record of wind.

    `profile`: columns north, east, down [m/s] over altitude [m], whose end values apply outside; without columns, calm
    air. `factor` multiplies only the profile, not the gusts.
    """

    profile: TableRef = NO_TABLE
    factor: float = 1.0
    n_gusts: int = 0
    gust_kind: Annotated[IntArray, (MAX_GUSTS,)] = field(default_factory=lambda: np.zeros(MAX_GUSTS, np.int64))
    gust_altitude_m: Annotated[Array, (MAX_GUSTS,)] = field(default_factory=_gust_values)
    gust_thickness_m: Annotated[Array, (MAX_GUSTS,)] = field(default_factory=_gust_values)
    gust_edge_m: Annotated[Array, (MAX_GUSTS,)] = field(default_factory=_gust_values)
    gust_north_mps: Annotated[Array, (MAX_GUSTS,)] = field(default_factory=_gust_values)
    gust_east_mps: Annotated[Array, (MAX_GUSTS,)] = field(default_factory=_gust_values)


def wind_components(speed_mps: ArrayLike, from_deg: ArrayLike) -> Array:
    """Return the components north, east, down of the air's motion, (n, 3), in m/s.

    `speed_mps` (n,) is the wind speed, and `from_deg` (n,) the direction from which the wind blows: clockwise from
    north, so that 270 is a westerly, air moving to the east. Interpolate these components, not speed and direction: a
    direction jumps by 360 deg at north and is undefined in calm air.
    """
    speed = np.atleast_1d(np.asarray(speed_mps, float))
    direction = np.deg2rad(np.atleast_1d(np.asarray(from_deg, float)))
    return np.stack([-speed * np.cos(direction), -speed * np.sin(direction), np.zeros_like(speed)], axis=1)


@kernel
def wind_ned(wind: Wind, pool: Array, altitude_m: float) -> tuple[float, float, float]:
    """Return (north, east, down) [m/s] of the air's motion relative to the Earth at a geometric altitude [m]."""
    north, east, down = 0.0, 0.0, 0.0
    profile = wind.profile
    if profile.n_columns > 0:
        k = find_interval(pool, profile, altitude_m)
        north = wind.factor * interpolate(pool, profile, k, altitude_m, 0)
        east = wind.factor * interpolate(pool, profile, k, altitude_m, 1)
        down = wind.factor * interpolate(pool, profile, k, altitude_m, 2)
    for i in range(wind.n_gusts):
        above = altitude_m - wind.gust_altitude_m[i]
        if above > 0.0:
            share = _gust_share(wind.gust_kind[i], above, wind.gust_thickness_m[i], wind.gust_edge_m[i])
            north += share * wind.gust_north_mps[i]
            east += share * wind.gust_east_mps[i]
    return north, east, down


@kernel
def _gust_share(kind: int, above: float, thickness: float, edge: float) -> float:
    """Return the share (0..1) of a gust's full speed at `above` > 0 metres above its lower end."""
    if kind == SHEAR:
        return min(above / thickness, 1.0)
    from_end = min(above, thickness - above)  # the shape is the same from both ends
    if from_end <= 0.0:
        return 0.0
    if from_end >= edge:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * from_end / edge)
