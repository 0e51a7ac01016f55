"""The drop zones of a campaign: the dispersion of the drop points of each separation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import f as f_distribution

from maxq.control.kernel.records import Array
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.drops import DROP_COLUMNS, drop_columns
from maxq.sim.packing.environment import pack_earth
from maxq.sim.run.impact_channels import dropped_body
from maxq.sim.world.earth import Earth

LEVEL = 0.99
"""The probability that the next drop point is in the ellipse of a zone."""
_FEWEST = 3  # points, for a covariance and one degree of freedom


@dataclass(frozen=True)
class DropZone:
    """The drop points of one separation.

    - `latitude_deg`, `longitude_deg`: the mean point.
    - `east_m`, `north_m` (n,): points relative to it, along the ellipsoid.
    - `runs` (n,): their runs.
    - `axes_m`: semi-axes of the ellipse that contains the next point with probability LEVEL; nan for fewer than three
      points. `azimuth_deg` is the azimuth of the major axis, from north through east, 0 to 180.
    """

    number: int
    name: str
    model: str
    latitude_deg: float
    longitude_deg: float
    east_m: Array
    north_m: Array
    runs: Array
    axes_m: tuple[float, float]
    azimuth_deg: float
    earth: Earth

    def outline_m(self, corners: int = 73) -> Array:
        """Return points (corners, 2) east and north on the ellipse, m."""
        turn, angle = math.radians(self.azimuth_deg), np.linspace(0.0, 2.0 * math.pi, corners)
        along, across = self.axes_m[0] * np.cos(angle), self.axes_m[1] * np.sin(angle)
        return np.stack(
            [along * math.sin(turn) + across * math.cos(turn), along * math.cos(turn) - across * math.sin(turn)], axis=1
        )


def drop_zones(data: DataSet) -> list[DropZone]:
    """Return the drop zones of a campaign, in order of the separations, without those that no run has."""
    scenario = data.campaign.base.scenario
    names = drop_columns(scenario)
    if not names or not data.parts:
        return []
    data.read(names)
    earth = pack_earth(scenario.earth)
    found = []
    for n in range(1, len(scenario.vehicle.stage)):
        latitude, longitude = (data.numbers(name.format(n)) for name in DROP_COLUMNS[:2])
        known = np.isfinite(latitude + longitude) & ~data.void
        if not known.any():
            continue
        body = dropped_body(scenario.vehicle.stage, n - 1, 0.0, np.zeros(3), np.zeros(3))
        around = np.radians(longitude[known])
        middle_deg = math.degrees(math.atan2(float(np.mean(np.sin(around))), float(np.mean(np.cos(around)))))
        offset_deg = np.mod(longitude[known] - middle_deg + 180.0, 360.0) - 180.0
        middle_deg, offset_deg = middle_deg + float(offset_deg.mean()), offset_deg - offset_deg.mean()
        mean_deg = float(latitude[known].mean())
        east_per_rad, north_per_rad = radii_m(earth.equatorial_radius_m, earth.flattening, math.radians(mean_deg))
        east = east_per_rad * np.radians(offset_deg)
        north = north_per_rad * np.radians(latitude[known] - mean_deg)
        axes, azimuth = prediction_ellipse(east, north)
        model = "vacuum" if body.ballistic_kgpm2 is None else f"drag, m / (C_D A) = {body.ballistic_kgpm2:g} kg/m2"
        found.append(
            DropZone(n, body.name, model, mean_deg, middle_deg, east, north, data.runs[known], axes, azimuth, earth)
        )
    return found


def radii_m(radius_m: float, flattening: float, latitude_rad: float) -> tuple[float, float]:
    """Return the lengths on the ellipsoid per radian of longitude and of geodetic latitude, m."""
    e2 = flattening * (2.0 - flattening)
    w = math.sqrt(1.0 - e2 * math.sin(latitude_rad) ** 2)
    return radius_m / w * math.cos(latitude_rad), radius_m * (1.0 - e2) / w**3


def prediction_ellipse(east_m: Array, north_m: Array, level: float = LEVEL) -> tuple[tuple[float, float], float]:
    """Return the semi-axes, m, and the azimuth of the major axis, deg, of a normal prediction ellipse about the mean.

    The next point of the same normal distribution is inside with probability `level`. Its squared Mahalanobis distance
    by the sample covariance of n points is 2 (n^2 - 1) / (n (n - 2)) times an F(2, n - 2) variate. Source: Johnson and
    Wichern, Applied Multivariate Statistical Analysis, section 5.4. The result is nan for fewer than three points.
    """
    n = len(east_m)
    if n < _FEWEST:
        return (math.nan, math.nan), math.nan
    values, vectors = np.linalg.eigh(np.cov(np.stack([east_m, north_m])))
    scale = 2.0 * (n * n - 1.0) / (n * (n - 2.0)) * _f_quantile(level, n - 2)
    minor, major = (math.sqrt(max(float(value), 0.0) * scale) for value in values)
    return (major, minor), math.degrees(math.atan2(vectors[0, 1], vectors[1, 1])) % 180.0


@lru_cache(maxsize=64)
def _f_quantile(level: float, freedom: int) -> float:
    """Return the quantile of an F(2, freedom) variate."""
    return float(f_distribution.ppf(level, 2, freedom))
