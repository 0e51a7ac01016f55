"""The triangle meshes of a vehicle, in pieces that follow the bending: skin, ribs, tanks, fins, nozzles and liquids.

Lengths are in metres. The x axis points to the nose, as in body axes.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.tools.plots.palette import ORANGE, SKY, rgba
from maxq.tools.replay.vehicle_shape import BoosterShape, StageShape, TankShape, VehicleShape

SIDES = 24
_SKIN, _WALL, _METAL, _LIQUIDS = [236, 240, 246, 58], [190, 200, 215, 40], [96, 100, 110, 255], (SKY, ORANGE)
LOAD_SHARES = (0.0, 0.33, 0.67, 1.0, 1.02)
_BOOSTER = [225, 228, 234, 170]
_FIN, _RIB = [150, 156, 166, 255], [120, 128, 140, 255]


@dataclass(frozen=True)
class Mesh:
    """A surface of `vertices` (n, 3) and `triangles` (m, 3), whose corners are counter-clockwise seen from outside."""

    vertices: Array
    triangles: NDArray[np.uint32]

    @property
    def normals(self) -> Array:
        """Return the outward normals at the vertices (n, 3), each the mean of those of the adjoining faces."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        normals = np.zeros_like(self.vertices)
        for k in range(3):
            np.add.at(normals, self.triangles[:, k], np.cross(b - a, c - a))
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))


def circle(sides: int = SIDES) -> Array:
    """Return the unit circle in the y-z plane, (sides, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def revolved(profile: Sequence[tuple[float, float]], sides: int = SIDES) -> Mesh:
    """Return a surface of revolution about x. `profile` contains (x, radius) from one end to the other."""
    x, radius = np.array(profile, float).T
    points = np.empty((len(x), sides, 3))
    points[:, :, 0] = x[:, None]
    points[:, :, 1:] = radius[:, None, None] * circle(sides)
    return Mesh(points.reshape(-1, 3), _strip_triangles(len(x), sides))


def _strip_triangles(rows: int, sides: int) -> NDArray[np.uint32]:
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = a + sides, b + sides
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]).astype("u4")


def liquid_vertices(floor_x: Array, surface_x: Array, radius: float, tilt: Array, shift: Array) -> NDArray[np.float32]:
    """Return the vertices (n, 4 sides, 3) of n states of a liquid in an upright cylinder: floor, wall (two rings),
    surface.

    `floor_x` and `surface_x` (n,) are positions on the axis. `tilt` (n, 2) is the rise of the surface per metre along y
    and z. `shift` (n, 2, 2) is the displacement by bending in y and z, of the floor and of the surface. The surface
    does not go below the floor. The rings of the wall are separate from those of floor and surface, so that edges look
    sharp.
    """
    ring = radius * circle()
    top = np.maximum(surface_x[:, None] + tilt @ ring.T, floor_x[:, None])
    low = np.broadcast_to(floor_x[:, None], top.shape)
    out = np.empty((len(floor_x), 4, len(ring), 3), np.float32)
    for part, (x, end) in enumerate(((low, 0), (low, 0), (top, 1), (top, 1))):
        out[:, part, :, 0] = x
        out[:, part, :, 1:] = ring + shift[:, None, end]
    return out.reshape(len(floor_x), -1, 3)


def _liquid(colour: str) -> rr.Mesh3D:
    """Return the constant part of a liquid's mesh: its triangles, and the normals of an upright surface.

    `liquid_vertices` completes it.
    """
    middle = np.arange(1, SIDES - 1)
    disc = np.stack([0 * middle, middle, middle + 1], axis=1)
    triangles = np.concatenate([disc[:, ::-1], _strip_triangles(2, SIDES) + SIDES, disc + 3 * SIDES])
    normals = np.zeros((4, SIDES, 3))
    normals[0, :, 0], normals[1:3, :, 1:], normals[3, :, 0] = -1.0, circle(), 1.0
    return rr.Mesh3D.from_fields(
        triangle_indices=triangles, vertex_normals=normals.reshape(-1, 3), albedo_factor=rgba(colour)
    )


def plate(corners: Sequence[tuple[float, float, float]], thickness: float) -> Mesh:
    """Return a flat plate with four corners, centred on their plane."""
    base = np.array(corners, float)
    normal = np.cross(base[1] - base[0], base[2] - base[0])
    normal *= 0.5 * thickness / np.linalg.norm(normal)
    top, bottom = base + normal, base - normal
    edges = [[bottom[i], bottom[i - 3], top[i - 3], top[i]] for i in range(4)]
    points = np.concatenate([top, bottom[::-1], *edges])
    face = np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(points, np.concatenate([face + first for first in range(0, len(points), 4)]).astype("u4"))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Return several meshes as one mesh."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    triangles = [m.triangles + np.uint32(start) for m, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(triangles))


# -- a vehicle -----------------------------------------------------------------------------------------------------
def vehicle_meshes(shape: VehicleShape, number: int, loaded: bool) -> list[tuple[str, rr.AsComponents]]:
    """Return the meshes of the vehicle that flies in stage `number`, each with its entity and in its own coordinates.

    Entities are relative to that of the stage. `loaded` is True if the colour of the skin shows its load, which
    changes.
    """
    out: list[tuple[str, rr.AsComponents]] = []
    flying = shape.stages[number:]
    for i, (a, b) in enumerate(itertools.pairwise(shape.joints(number))):
        radii = [(x, radius) for x in (a, b) if (radius := _radius(flying, x)) > 0.0]
        parts: dict[str, tuple[list[int], Sequence[Mesh | None]]] = {
            "skin": (_SKIN, [_skin(stage, a, b) for stage in flying]),
            "rib": (_RIB, [revolved(_ring(x - a, radius), 32) for x, radius in radii]),
            "tanks": (_WALL, [_tank_wall(tank, a, b) for stage in flying for tank in stage.tanks]),
            "fins": (_FIN, [fin for stage in flying for fin in _fins(stage, a, b)]),
            "boosters": (_BOOSTER, [_booster(one, a, b) for one in flying[0].boosters]),
        }
        for name, (colour, meshes) in parts.items():
            if there := [m for m in meshes if m is not None]:
                mesh = mesh3d(joined(there), None if loaded and name == "skin" else colour)
                out.append((f"piece_{i:02}/{name}", mesh))
    engine = shape.stages[number].engine
    if engine is not None:
        for name, one in shape.stages[number].nozzles:
            bell = _bell(one.exit_station_m - one.gimbal_station_m, one.exit_radius_m)
            out.append((f"{name}/nozzle", mesh3d(revolved(bell), _METAL)))
        style = rr.Arrows3D.from_fields(colors=rgba(ORANGE), radii=0.012 * shape.length_m, show_labels=True)
        out.append(("engine/thrust", style))
    for k, tank in enumerate(t for stage in flying for t in stage.tanks):
        out.append((f"liquid/{tank.name}", _liquid(_LIQUIDS[k % 2])))
    return out


def mesh3d(body: Mesh, colour: Sequence[int] | None) -> rr.Mesh3D:
    """Return a mesh for the viewer in one colour (RGBA). Without a colour, the colour is sent separately."""
    return rr.Mesh3D(
        vertex_positions=body.vertices,
        triangle_indices=body.triangles,
        vertex_normals=body.normals,
        albedo_factor=colour,
    )


def load_colours(shares: Array) -> IntArray:
    """Return RGBA as 32-bit words for utilisations of a limit: plain skin at 0, via yellow to red at 1, and violet
    above.
    """
    scale = np.array([_SKIN, [250, 205, 90, 150], [240, 120, 40, 200], [205, 30, 40, 235], [150, 30, 190, 255]])
    rgba = np.stack([np.interp(shares, LOAD_SHARES, channel) for channel in scale.T], axis=-1).round().astype("u4")
    return np.asarray(rgba @ np.array([1 << 24, 1 << 16, 1 << 8, 1], "u4"))


def _radius(stages: Sequence[StageShape], station: float) -> float:
    for stage in reversed(stages):
        if stage.front_m <= station <= stage.end_m:
            return float(np.interp(station, *stage.profile.T))
    return 0.0


def _ring(x: float, radius: float) -> list[tuple[float, float]]:
    """Return the profile of a thin hoop, which shows the bent shape through the skin."""
    w = 0.02 * radius
    return [(-x - w, 1.002 * radius), (-x, 1.012 * radius), (-x + w, 1.002 * radius)]


def _skin(stage: StageShape, a: float, b: float) -> Mesh | None:
    """Return the skin between stations a and b in the coordinates of the piece (x forward from a), or None."""
    front, end = max(a, stage.front_m), min(b, stage.end_m)
    if end - front <= 1e-9:
        return None
    stations, radii = stage.profile.T
    inside = stations[(stations > front) & (stations < end)]
    cuts = np.concatenate([[front], inside, [end]])
    values = np.interp(cuts, stations, radii)
    return revolved([(a - s, r) for s, r in zip(cuts[::-1], values[::-1], strict=True)])


def _tank_wall(tank: TankShape, a: float, b: float) -> Mesh | None:
    front, end = max(a, tank.top_station_m), min(b, tank.bottom_station_m)
    if end - front <= 1e-9:
        return None
    parts = [revolved([(a - end, tank.radius_m), (a - front, tank.radius_m)])]
    for station, here in ((tank.top_station_m, front), (tank.bottom_station_m, end)):
        if station == here:  # a rim at the end of the tank
            parts.append(revolved([(a - here, 0.0), (a - here, tank.radius_m)]))
    return joined(parts)


def _fins(stage: StageShape, a: float, b: float) -> list[Mesh]:
    """Return the fins whose root has its middle between two stations."""
    fins = stage.fins
    if fins is None or not a <= fins.root_station_m + 0.5 * fins.root_chord_m < b:
        return []
    corners = (
        (fins.root_station_m, fins.root_radius_m),
        (fins.tip_station_m, fins.tip_radius_m),
        (fins.tip_station_m + fins.tip_chord_m, fins.tip_radius_m),
        (fins.root_station_m + fins.root_chord_m, fins.root_radius_m),
    )
    angles = 2.0 * np.pi * (np.arange(fins.count) + 0.5) / fins.count
    return [
        plate([(a - x, math.cos(angle) * r, math.sin(angle) * r) for x, r in corners], 0.02 * fins.root_chord_m)
        for angle in angles
    ]


def booster_mesh(booster: BoosterShape) -> rr.Mesh3D:
    """Return a whole booster, in coordinates whose origin is the nose of the vehicle."""
    skin = _booster(booster, 0.0, math.inf)
    assert skin is not None
    return mesh3d(skin, _BOOSTER)


def _booster(booster: BoosterShape, a: float, b: float) -> Mesh | None:
    """Return the skin of a booster between stations a and b in the coordinates of the piece, or None."""
    stations, radii = booster.profile.T
    front, end = max(a, float(stations[0])), min(b, float(stations[-1]))
    if end - front <= 1e-9:
        return None
    cuts = np.unique(np.concatenate([[front, end], stations[(stations > front) & (stations < end)]]))
    values = np.interp(cuts, stations[:-1], radii[:-1])
    skin = revolved([(a - s, r) for s, r in zip(cuts[::-1], values[::-1], strict=True)])
    return Mesh(skin.vertices + np.array([0.0, *booster.position_m]), skin.triangles)


def _bell(length: float, exit_radius: float) -> list[tuple[float, float]]:
    """Return the profile of a nozzle from its exit, over bell, throat and chamber, to the gimbal at x = 0."""
    throat = 0.4 * exit_radius
    x = np.linspace(-length, -0.35 * length, 8)
    share = (x + length) / (0.65 * length)
    bell = [(float(a), float(exit_radius - (exit_radius - throat) * s**2)) for a, s in zip(x, share, strict=True)]
    return [*bell, (-0.25 * length, 0.62 * exit_radius), (-0.02 * length, 0.62 * exit_radius), (0.0, 0.0)]
