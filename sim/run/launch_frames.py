"""The vehicle's motion as 3-D viewers want it: the body frame in a frame at the launch site.

`launch_site` has x east, y north, z up (the N of the flight is north, east, down) and does not turn
relative to the Earth. `body` is B (x forward, y right, z down) with its origin at the core CG.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.channels import ChannelTable
from maxq.sim.log.foxglove import FramePath
from maxq.sim.packing.initial import quaternion
from maxq.sim.scenario.schema_environment import Site
from maxq.sim.world.earth import FLAT, Earth, earth_position, ned_axes

PARENT, CHILD = "launch_site", "body"
_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class LaunchFrames:
    """Poses of the body, picked from the slow rows: the first row in each period of `transform_ns`.

    So transforms come at most as often as slow rows do. Positions are differences to the site in double
    precision: rounding is a few nanometres.
    """

    def __init__(self, table: ChannelTable, earth: Earth, site: Site, transform_ns: int) -> None:
        self._period_ns = transform_ns
        self._last_period = -1
        self._rate_radps = float(earth.rate_radps)
        self._position = [table.index(f"r_E_{axis}_m") for axis in "xyz"]
        self._attitude = [table.index(f"q_BI_{part}") for part in "wxyz"]
        latitude, longitude = math.radians(site.latitude_deg), math.radians(site.longitude_deg)
        self._site_E_m = np.array(_plain(earth_position)(earth, latitude, longitude, site.altitude_m))
        to_ned = np.eye(3)
        if earth.figure != FLAT:
            sines = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
            to_ned = np.array(_plain(ned_axes)(*sines)).reshape(3, 3)
        self._to_enu = _ENU_NED @ to_ned
        self._q_to_enu = quaternion(self._to_enu)

    def path(self, times_ns: IntArray, rows: Array) -> FramePath:
        """The next poses from slow rows (n, columns) that follow those of the last call."""
        periods = times_ns // self._period_ns
        first = np.diff(periods, prepend=self._last_period) > 0
        if len(periods):
            self._last_period = int(periods[-1])
        times_ns, rows = times_ns[first], rows[first]
        position_m = (rows[:, self._position] - self._site_E_m) @ self._to_enu.T
        half = -0.5 * self._rate_radps * 1e-9 * times_ns
        nothing = np.zeros_like(half)
        q_EI = np.stack([np.cos(half), nothing, nothing, np.sin(half)], axis=1)
        rotation = _product(_product(self._q_to_enu[None, :], q_EI), rows[:, self._attitude])
        return FramePath(PARENT, CHILD, times_ns, position_m, rotation)


def _product(p: Array, q: Array) -> Array:
    """Quaternion products (n, 4), scalar first."""
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


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel that calls no other one, as the Python function it is: one call is not worth compiling it."""
    return getattr(function, "py_func", function)
