"""The launch site's local-level frame, and the vehicle's motion in it for 3-D viewers.

`launch_site` has x east, y north, z up (the N of the flight is north, east, down) and is fixed relative to the Earth.
`body` is B (x forward, y right, z down) with its origin at the core CG.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.log.messages import FramePath
from maxq.sim.packing.initial import quaternion
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.world.earth import FLAT, Earth, earth_position, ned_axes

PARENT, CHILD = "launch_site", "body"
ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class LaunchSite:
    """The local-level frame at a site: its origin `origin_E_m` (3,), and `enu_E` (3, 3) with rows east, north, up in E.

    On a flat Earth, the axes are those of E.
    """

    def __init__(self, earth: Earth, site: Site) -> None:
        self.earth, self.site = earth, site
        latitude, longitude = math.radians(site.latitude_deg), math.radians(site.longitude_deg)
        self.origin_E_m = np.array(plain(earth_position)(earth, latitude, longitude, site.altitude_m))
        ned_E = np.eye(3)
        if earth.figure != FLAT:
            sines = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
            ned_E = np.array(plain(ned_axes)(*sines)).reshape(3, 3)
        self.enu_E = ENU_NED @ ned_E


class LaunchFrames:
    """The poses of the body relative to the launch site, from the first slow row in each period of `transform_ns`.

    Poses are therefore at most as frequent as slow rows. Positions are differences from the site in double precision,
    with a rounding error of a few nanometres.
    """

    def __init__(self, table: ChannelTable, site: LaunchSite, transform_ns: int) -> None:
        self._site = site
        self._period_ns = transform_ns
        self._last_period = -1
        self._position = [table.index(f"r_E_{axis}_m") for axis in "xyz"]
        self._attitude = [table.index(f"q_BI_{part}") for part in "wxyz"]
        self._q_enu_E = quaternion(site.enu_E)

    def path(self, times_ns: IntArray, rows: Array) -> FramePath:
        """Return the poses in slow rows (n, columns) at `times_ns` (n,), which follow those of the preceding call."""
        periods = times_ns // self._period_ns
        first = np.diff(periods, prepend=self._last_period) > 0
        if len(periods):
            self._last_period = int(periods[-1])
        times_ns, rows = times_ns[first], rows[first]
        position_m = (rows[:, self._position] - self._site.origin_E_m) @ self._site.enu_E.T
        half = -0.5 * float(self._site.earth.rate_radps) * 1e-9 * times_ns
        zero = np.zeros_like(half)
        q_EI = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
        rotation = _product(_product(self._q_enu_E[None, :], q_EI), rows[:, self._attitude])
        return FramePath(PARENT, CHILD, times_ns, position_m, rotation)


def _product(p: Array, q: Array) -> Array:
    """Return the products (n, 4) of the quaternions `p` and `q` (n, 4), scalar first."""
    pw, px, py, pz = p.T
    qw, qx, qy, qz = q.T
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=1,
    )


def plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the Python function of a kernel that calls no other kernel, for a call that is not worth compiling."""
    return getattr(function, "py_func", function)
