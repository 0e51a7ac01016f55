"""Everything in the frame of the launch site: x east, y north, z up (the log's `launch_site`)."""

from __future__ import annotations

import math

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.log.foxglove import FramePath
from maxq.sim.packing.environment import pack_earth
from maxq.sim.run import launch_frames
from maxq.sim.run.launch_frames import ENU_NED, LaunchFrames
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.world.earth import FLAT, Earth, wgs84
from maxq.tools.replay.flight import Channels, ReplayFlight, launch_of

FAR_KM = 20.0
"""A flight that begins farther from its site than this is shown in the axes of the place where it begins."""
_NEEDED = tuple(f"r_E_{a}_m" for a in "xyz") + tuple(f"q_BI_{c}" for c in "wxyz")


class LaunchSite(launch_frames.LaunchSite):
    """The launch site's frame; `moved`: it lies where the flight begins instead."""

    def __init__(self, earth: Earth, site: Site, moved: bool = False) -> None:
        super().__init__(earth, site)
        self.moved = moved

    def frames(self, table: ChannelTable, period_ns: int) -> LaunchFrames:
        return LaunchFrames(table, self, period_ns)

    def from_ned(self, latitude_deg: Array, longitude_deg: Array, v_N: Array) -> Array:
        """Vectors (n, 3) given north, east, down at places (n,), in the axes of the site."""
        if self.earth.figure == FLAT:
            return np.asarray(v_N @ ENU_NED.T)
        lat, lon = np.radians(latitude_deg), np.radians(longitude_deg)
        sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
        north, east, down = v_N.T
        across = -sin_lat * north - cos_lat * down
        v_E = np.stack(
            [across * cos_lon - sin_lon * east, across * sin_lon + cos_lon * east, cos_lat * north - sin_lat * down], 1
        )
        return np.asarray(v_E @ self.enu_E.T)

    def ground(self, east_m: Array, north_m: Array) -> Array:
        """Points (n, 3) on the ground at the site's altitude below points of the horizontal plane (n,)."""
        if self.earth.figure == FLAT:
            return np.stack([east_m, north_m, np.zeros_like(east_m)], axis=1)
        flattening, a = self.earth.flattening, self.earth.equatorial_radius_m
        height = self.site.altitude_m
        semi = np.array([a + height, a + height, a * (1.0 - flattening) + height])
        on_plane = self.origin_E_m + np.stack([east_m, north_m, np.zeros_like(east_m)], 1) @ self.enu_E
        direction = -self.enu_E[2]  # straight down at the site, to the ellipsoid of the site's height
        p, d = on_plane / semi, direction / semi
        a2, b1, c0 = float(d @ d), p @ d, (p * p).sum(axis=1) - 1.0
        root = np.sqrt(np.maximum(b1 * b1 - a2 * c0, 0.0))
        drop = (-b1 - root) / a2
        return np.stack([east_m, north_m, -drop], axis=1)


def place_of(flight: ReplayFlight) -> LaunchSite:
    """The launch site's frame of a logged flight."""
    earth, site = launch_of(flight.log)
    return launch_site(pack_earth(earth), site, flight.log)


def launch_site(earth: Earth | None, site: Site, channels: Channels) -> LaunchSite:
    """The frame to draw in; `earth`: None for WGS-84; `channels` say where the flight begins."""
    earth = earth or wgs84()
    if earth.figure == FLAT or "latitude_deg" not in channels or not len(channels["latitude_deg"]):
        return LaunchSite(earth, site)
    start = float(channels["latitude_deg"][0]), float(channels["longitude_deg"][0])
    north = start[0] - site.latitude_deg
    east = ((start[1] - site.longitude_deg + 180.0) % 360.0 - 180.0) * math.cos(math.radians(site.latitude_deg))
    if 111.0 * math.hypot(north, east) < FAR_KM:
        return LaunchSite(earth, site)
    moved = site.model_copy(update={"latitude_deg": start[0], "longitude_deg": start[1], "altitude_m": 0.0})
    return LaunchSite(earth, moved, moved=True)


def path_of(channels: Channels, frames: LaunchFrames) -> FramePath:
    """The motion in a log or block; `frames` picks the poses and remembers where it was."""
    table = channels.table
    times_ns = channels.time_ns(_NEEDED[0])
    rows = np.zeros((len(times_ns), len(table.columns(table.topic(_NEEDED[0]).group))))
    for name in _NEEDED:
        rows[:, table.index(name)] = channels[name]
    return frames.path(times_ns, rows)


def has_motion(channels: Channels) -> bool:
    return all(name in channels for name in _NEEDED)
