"""Motion of the air relative to the Earth, in local North-East-Down, over altitude: a profile plus discrete
gusts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.jit import kernel
from maxq.control.kernel.limits import MAX_GUSTS
from maxq.control.kernel.records import Array, IntArray
from maxq.control.kernel.tables import NO_TABLE, TableRef, find_interval, interpolate

ONE_MINUS_COSINE, SHEAR = 0, 1  # Gust.kind


def _gust_values() -> Array:
    return np.zeros(MAX_GUSTS)


@dataclass(frozen=True)
class Wind:
    """Parameter record; make one with `wind_of`.

    `profile`: columns north, east, down [m/s] over altitude [m], end values held outside it; no columns:
    calm. `factor` multiplies the profile and not the gusts, whose strength is given on its own.
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


@dataclass(frozen=True)
class Gust:
    """A horizontal gust layer that begins at `altitude_m` and blows from the compass direction `from_deg`.

    ONE_MINUS_COSINE rises over `edge_m` as (1 - cos)/2, holds for `thickness_m` - 2 `edge_m`, falls over
    `edge_m` (NASA-HDBK-1001, sec. 2; with 2 edge = thickness the classical 1-cosine). SHEAR rises linearly
    over `thickness_m` and then holds at all altitudes above. Raises ValueError for a shape that cannot be.
    """

    kind: int
    altitude_m: float
    thickness_m: float
    speed_mps: float
    from_deg: float
    edge_m: float = 0.0  # of ONE_MINUS_COSINE

    def __post_init__(self) -> None:
        if self.kind not in (ONE_MINUS_COSINE, SHEAR):
            raise ValueError(f"Gust.kind {self.kind} is none of 0 one-minus-cosine, 1 shear")
        if not self.thickness_m > 0.0:
            raise ValueError(f"a gust's thickness must be positive, not {self.thickness_m} m")
        if self.kind == ONE_MINUS_COSINE and not 0.0 < 2.0 * self.edge_m <= self.thickness_m:
            raise ValueError(
                f"a one-minus-cosine gust's edge must lie above 0 and at most at half its thickness "
                f"({self.thickness_m} m), not at {self.edge_m} m"
            )


def wind_of(profile: TableRef = NO_TABLE, gusts: Sequence[Gust] = (), factor: float = 1.0) -> Wind:
    """A wind of a profile (see `wind_components` for its columns) and at most `MAX_GUSTS` gusts, which add up.

    Raises ValueError for more gusts or for a profile that has not three columns.
    """
    if profile.n_columns not in (0, 3):
        raise ValueError(f"a wind profile has columns north, east, down: three, not {profile.n_columns}")
    if len(gusts) > MAX_GUSTS:
        raise ValueError(f"{len(gusts)} gusts; at most {MAX_GUSTS} are possible")
    columns = np.zeros((6, MAX_GUSTS))
    for i, g in enumerate(gusts):
        north, east, _ = wind_components(g.speed_mps, g.from_deg)[0]
        columns[:, i] = g.kind, g.altitude_m, g.thickness_m, g.edge_m, north, east
    kinds, altitude, thickness, edge, north, east = columns
    return Wind(profile, factor, len(gusts), kinds.astype(np.int64), altitude, thickness, edge, north, east)


def wind_components(speed_mps: ArrayLike, from_deg: ArrayLike) -> Array:
    """Columns north, east, down [m/s], (n, 3), of the air's motion, from its speed and where it blows from.

    `from_deg` is meteorological: clockwise from north, 270 = a westerly, air moving to the east.
    Interpolate these components, not speed and direction: a direction jumps by 360 degrees at north and
    means nothing in a calm, while the mean of two wind vectors is the wind half-way between them.
    """
    speed = np.atleast_1d(np.asarray(speed_mps, float))
    direction = np.deg2rad(np.atleast_1d(np.asarray(from_deg, float)))
    return np.stack([-speed * np.cos(direction), -speed * np.sin(direction), np.zeros_like(speed)], axis=1)


@kernel
def wind_ned(wind: Wind, pool: Array, altitude_m: float) -> tuple[float, float, float]:
    """(north, east, down) [m/s] of the air's motion relative to the Earth at a geometric altitude [m]."""
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
    """Share (0..1) of a gust's full speed at `above` > 0 metres over its lower end."""
    if kind == SHEAR:
        return min(above / thickness, 1.0)
    from_end = min(above, thickness - above)  # the shape is the same from both ends
    if from_end <= 0.0:
        return 0.0
    if from_end >= edge:
        return 1.0
    return 0.5 - 0.5 * math.cos(math.pi * from_end / edge)
