"""The parts of a vehicle as meshes: skin, ribs, tanks, fins, nozzle, liquids, cut into pieces that bend."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from maxq.tools.plots.palette import ORANGE, SKY, rgba
from maxq.tools.replay import mesh
from maxq.tools.replay.vehicle_shape import StageShape, TankShape, VehicleShape

_SKIN, _WALL, _METAL, _LIQUIDS = [236, 240, 246, 58], [190, 200, 215, 40], [96, 100, 110, 255], (SKY, ORANGE)
_FIN, _RIB = [150, 156, 166, 255], [120, 128, 140, 255]


def vehicle_meshes(shape: VehicleShape, number: int) -> list[tuple[str, rr.AsComponents]]:
    """What the vehicle of a stage is made of, piece by piece, in the coordinates of the pieces.

    Entities are given relative to the stage's.
    """
    out: list[tuple[str, rr.AsComponents]] = []
    joints = shape.joints(number)
    flying = shape.stages[number:]
    for i, (a, b) in enumerate(itertools.pairwise(joints)):
        skins = [m for stage in flying if (m := _skin(stage, a, b)) is not None]
        if skins:
            out.append((f"piece_{i:02}/skin", mesh3d(mesh.joined(skins), _SKIN)))
        rings = [mesh.revolved(_ring(x - a, _radius(flying, x)), 32) for x in (a, b) if _radius(flying, x) > 0]
        if rings:
            out.append((f"piece_{i:02}/rib", mesh3d(mesh.joined(rings), _RIB)))
        walls = [m for stage in flying for tank in stage.tanks if (m := _tank_wall(tank, a, b)) is not None]
        if walls:
            out.append((f"piece_{i:02}/tanks", mesh3d(mesh.joined(walls), _WALL)))
        fins = [m for stage in flying for m in _fins(stage, a, b)]
        if fins:
            out.append((f"piece_{i:02}/fins", mesh3d(mesh.joined(fins), _FIN)))
    engine = shape.stages[number].engine
    if engine is not None:
        length = engine.exit_station_m - engine.gimbal_station_m
        bell = mesh.revolved(_bell(length, engine.exit_radius_m))
        out.append(("engine/nozzle", mesh3d(bell, _METAL)))
        style = rr.Arrows3D.from_fields(colors=rgba(ORANGE), radii=0.012 * shape.length_m, show_labels=True)
        out.append(("engine/thrust", style))
    for k, tank in enumerate(t for stage in flying for t in stage.tanks):
        body = rr.Mesh3D.from_fields(
            triangle_indices=mesh.liquid_triangles(),
            vertex_normals=mesh.liquid_normals(),
            albedo_factor=rgba(_LIQUIDS[k % 2]),
        )
        out.append((f"liquid/{tank.name}", body))
    return out


def mesh3d(body: mesh.Mesh, colour: Sequence[int]) -> rr.Mesh3D:
    """A mesh for the viewer in one colour (RGBA)."""
    return rr.Mesh3D(
        vertex_positions=body.vertices,
        triangle_indices=body.triangles,
        vertex_normals=body.normals,
        albedo_factor=colour,
    )


def _radius(stages: Sequence[StageShape], station: float) -> float:
    for stage in reversed(stages):
        if stage.front_m <= station <= stage.end_m:
            stations, radii = np.array(stage.profile).T
            return float(np.interp(station, stations, radii))
    return 0.0


def _ring(x: float, radius: float) -> list[tuple[float, float]]:
    """A thin hoop, so that the bent shape is seen through the skin."""
    w = 0.02 * radius
    return [(-x - w, 1.002 * radius), (-x, 1.012 * radius), (-x + w, 1.002 * radius)]


def _skin(stage: StageShape, a: float, b: float) -> mesh.Mesh | None:
    """The skin between two stations, in the piece's coordinates (x forward from station a)."""
    front, end = max(a, stage.front_m), min(b, stage.end_m)
    if end - front <= 1e-9:
        return None
    stations, radii = np.array(stage.profile).T
    inside = stations[(stations > front) & (stations < end)]
    cuts = np.concatenate([[front], inside, [end]])
    values = np.interp(cuts, stations, radii)
    return mesh.revolved([(a - s, r) for s, r in zip(cuts[::-1], values[::-1], strict=True)])


def _tank_wall(tank: TankShape, a: float, b: float) -> mesh.Mesh | None:
    front, end = max(a, tank.top_station_m), min(b, tank.bottom_station_m)
    if end - front <= 1e-9:
        return None
    parts = [mesh.revolved([(a - end, tank.radius_m), (a - front, tank.radius_m)])]
    for station, here in ((tank.top_station_m, front), (tank.bottom_station_m, end)):
        if station == here:  # a rim where the tank ends
            parts.append(mesh.revolved([(a - here, 0.0), (a - here, tank.radius_m)]))
    return mesh.joined(parts)


def _fins(stage: StageShape, a: float, b: float) -> list[mesh.Mesh]:
    """Fins whose root's middle lies between two stations."""
    fins = stage.fins
    if fins is None or not a <= fins.root_station_m + 0.5 * fins.root_chord_m < b:
        return []
    out = []
    for i in range(fins.count):
        angle = 2.0 * math.pi * (i + 0.5) / fins.count
        c, s = math.cos(angle), math.sin(angle)
        corners = []
        for station, r in (
            (fins.root_station_m, fins.root_radius_m),
            (fins.tip_station_m, fins.tip_radius_m),
            (fins.tip_station_m + fins.tip_chord_m, fins.tip_radius_m),
            (fins.root_station_m + fins.root_chord_m, fins.root_radius_m),
        ):
            corners.append((a - station, c * r, s * r))
        out.append(mesh.plate(corners, 0.02 * fins.root_chord_m))
    return out


def _bell(length: float, exit_radius: float) -> list[tuple[float, float]]:
    """Chamber, throat and bell of a nozzle, from the exit to the gimbal at x = 0."""
    throat = 0.4 * exit_radius
    x = np.linspace(-length, -0.35 * length, 8)
    share = (x + length) / (0.65 * length)
    bell = [(float(a), float(exit_radius - (exit_radius - throat) * s**2)) for a, s in zip(x, share, strict=True)]
    return [*bell, (-0.25 * length, 0.62 * exit_radius), (-0.02 * length, 0.62 * exit_radius), (0.0, 0.0)]
