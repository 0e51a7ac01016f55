"""The metrics of the instantaneous impact point: its range, its cross-range, and its distance to a permitted zone.

The impact point is that in vacuum (impact.py), at the states that the flight kept in its trail. Nearest points are on
the sphere of geodetic latitudes, where the flight line and the edges of the zone are great circles. Distances are
those along the ellipsoid.
"""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.flight.metric_table import ImpactMetrics
from maxq.sim.run.impact import vacuum_impacts
from maxq.sim.run.metrics import geodesic_m
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.scenario.schema_launch import RangeSafety
from maxq.sim.world.earth import Earth


def impact_metrics(
    earth: Earth, site: Site, given: RangeSafety, time_s: Array, r_I_m: Array, v_I_mps: Array
) -> tuple[ImpactMetrics, ImpactMetrics]:
    """Return the metrics, and the times of their values, s, for states (n, 3) in I at `time_s` (n,).

    States without an impact point, as in orbit, are ignored. The result is nan if no state has one; the excursion is
    nan without a zone.
    """
    found = vacuum_impacts(earth, time_s, r_I_m, v_I_mps, min(site.altitude_m, 0.0))
    known = np.isfinite(found.fall_s)
    values, times = dict.fromkeys(ImpactMetrics._fields, math.nan), dict.fromkeys(ImpactMetrics._fields, math.nan)
    points = _vectors(found.latitude_deg[known], found.longitude_deg[known])
    origin = _vectors(site.latitude_deg, site.longitude_deg)
    azimuth = math.radians(site.azimuth_deg if given.azimuth_deg is None else given.azimuth_deg)
    line = _normal(site.latitude_deg, site.longitude_deg, azimuth)
    nearest = [np.broadcast_to(origin, points.shape), points - (points @ line)[:, None] * line]
    signs = [np.ones(len(points))] * 2
    if given.zone is not None:
        corners = _vectors(*np.array(given.zone).T)
        nearest.append(_nearest_on_ring(points, corners))
        signs.append(np.where(_inside(points, corners), -1.0, 1.0))
    for name, ends, sign in zip(ImpactMetrics._fields, nearest, signs, strict=False):
        if not len(points):
            break
        k = int(np.argmax(sign * _angles(points, ends)))
        distance_m = geodesic_m(earth.equatorial_radius_m, earth.flattening, _place(points[k]), _place(ends[k]))
        values[name], times[name] = float(sign[k]) * distance_m, float(time_s[known][k])
    return ImpactMetrics(**values), ImpactMetrics(**times)


def _vectors(latitude_deg: Array | float, longitude_deg: Array | float) -> Array:
    """Return unit vectors (..., 3) along the geodetic normals of places."""
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    across = np.cos(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)], axis=-1)


def _place(vector: Array) -> tuple[float, float]:
    """Return latitude and longitude, rad, of a vector (3,) of any length."""
    x, y, z = vector.tolist()
    return math.atan2(z, math.hypot(x, y)), math.atan2(y, x)


def _normal(latitude_deg: float, longitude_deg: float, azimuth: float) -> Array:
    """Return the normal (3,) of the great circle through a place in the direction `azimuth`, rad."""
    s, c = math.sin(math.radians(latitude_deg)), math.cos(math.radians(latitude_deg))
    east = np.array([-math.sin(math.radians(longitude_deg)), math.cos(math.radians(longitude_deg)), 0.0])
    outward = np.array([east[1], -east[0], 0.0])
    north = c * np.array([0.0, 0.0, 1.0]) - s * outward
    return np.asarray(math.sin(azimuth) * north - math.cos(azimuth) * east)


def _angles(first: Array, second: Array) -> Array:
    """Return the angles (...,), rad, between vectors (..., 3)."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(first, second), axis=-1), np.sum(first * second, axis=-1)))


def _nearest_on_ring(points: Array, corners: Array) -> Array:
    """Return the nearest points (n, 3), of any length, on the arcs between successive corners (m, 3) of a ring."""
    best, found = np.full(len(points), np.inf), np.zeros_like(points)
    for first, last in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        normal = np.cross(first, last)
        size = np.linalg.norm(normal)
        if size == 0.0:
            continue
        normal = normal / size
        foot = points - (points @ normal)[:, None] * normal
        on_arc = (np.cross(normal, first) @ foot.T >= 0.0) & (np.cross(last, normal) @ foot.T >= 0.0)
        nearer = np.where((points @ first >= points @ last)[:, None], first, last)
        end = np.where(on_arc[:, None], foot, nearer)
        angle = _angles(points, end)
        found = np.where((angle < best)[:, None], end, found)
        best = np.minimum(angle, best)
    return found


def _inside(points: Array, corners: Array) -> np.ndarray:
    """Return a mask (n,) of points around which the ring of `corners` (m, 3) turns.

    The ring turns around the antipode of an inside point as well, which is therefore excluded.
    """
    east = np.stack([-points[:, 1], points[:, 0], np.zeros(len(points))], axis=1)
    north = np.cross(points, east)
    bearing = np.arctan2(east @ corners.T, north @ corners.T)  # both axes have the same length
    turned = np.diff(bearing, axis=1, append=bearing[:, :1])
    turned = np.mod(turned + math.pi, 2.0 * math.pi) - math.pi
    centre = corners.sum(axis=0)
    return np.asarray((np.abs(turned.sum(axis=1)) > math.pi) & (points @ centre > 0.0))
