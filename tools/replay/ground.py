"""The ground: a grid that follows the Earth's curvature, the pad, and where north and east are."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr

from maxq.tools.replay import mesh
from maxq.tools.replay.earth_frame import LaunchSite
from maxq.tools.replay.flight import Channels
from maxq.tools.replay.vehicle_meshes import mesh3d
from maxq.tools.replay.vehicle_shape import VehicleShape

_GRID, _PAD, _BLOCK, _COMPASS = [74, 88, 106, 150], [96, 112, 132, 255], [110, 100, 88, 255], [150, 160, 175, 255]


def ground(recording: rr.RecordingStream, place: LaunchSite, reach_m: float, drop_m: float) -> str:
    """A grid on the Earth's surface as far as the flight reaches, and the pad. Static. Returns the grid's spacing.

    The simulation begins with the CG at the site's altitude; the ground is drawn `drop_m` lower, under the vehicle.
    """
    step = 10.0 ** math.floor(math.log10(max(reach_m, 100.0) / 2.0))
    if reach_m / step > 12:
        step *= 5.0
    count = math.ceil(1.15 * reach_m / step)
    lines, along = [], np.linspace(-count * step, count * step, 16 * count + 1)
    for i in range(-count, count + 1):  # beside the site, not through it
        across = np.full(len(along), (i + 0.5) * step)
        lines += [place.ground(along, across), place.ground(across, along)]
    lines = [line - [0.0, 0.0, drop_m] for line in lines]
    thin = rr.Radius.ui_points(0.5)
    recording.log("ground/grid", rr.LineStrips3D(lines, colors=_GRID, radii=thin), static=True)
    near = np.linspace(-60.0, 60.0, 13)
    pad = [[(x, y, -drop_m) for y in near] for x in near] + [[(x, y, -drop_m) for x in near] for y in near]
    recording.log("ground/pad", rr.LineStrips3D(pad, colors=_PAD, radii=0.05), static=True)
    corners = [[-4.0, -4.0], [4.0, -4.0], [4.0, 4.0], [-4.0, 4.0]]
    block = mesh.plate([(x, y, -drop_m - 0.3) for x, y in corners], 0.6)
    recording.log("ground/pad/block", mesh3d(block, _BLOCK), static=True)
    ends = place.ground(np.array([0.12 * reach_m, 0.0]), np.array([0.0, 0.12 * reach_m]))
    recording.log(
        "ground/compass",
        rr.Arrows3D(vectors=ends, origins=np.zeros((2, 3)), colors=_COMPASS, radii=rr.Radius.ui_points(1.0)),
        static=True,
    )
    names = rr.Points3D(
        1.15 * ends, labels=["E", "N"], show_labels=True, colors=_COMPASS, radii=rr.Radius.ui_points(0.5)
    )
    recording.log("ground/compass/names", names, static=True)
    return _length(step)


def _length(metres: float) -> str:
    return f"{metres / 1000.0:g} km" if metres >= 1000.0 else f"{metres:g} m"


def tail_below_cg(channels: Channels, shape: VehicleShape | None) -> float:
    """How far the vehicle's end lies behind its CG at first, m."""
    if shape is None or "cg_station_m" not in channels or not len(channels["cg_station_m"]):
        return 0.0
    stage = shape.stages[0]
    end = stage.engine.exit_station_m if stage.engine is not None else stage.end_m
    return max(float(end - channels["cg_station_m"][0]), 0.0)
