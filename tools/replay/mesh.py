"""Triangle meshes of simple bodies, in metres. Axis x points to the nose, as in B."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array

SIDES = 24


@dataclass(frozen=True)
class Mesh:
    """`vertices` (n, 3) float32, `triangles` (m, 3) and `normals` (n, 3) that point outwards."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    normals: NDArray[np.float32]


def circle(sides: int = SIDES) -> Array:
    """Unit circle in the y-z plane (sides, 2)."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def revolved(profile: Sequence[tuple[float, float]], sides: int = SIDES) -> Mesh:
    """A surface of revolution about x; `profile` lists (x, radius) from one end to the other."""
    x, radius = np.array(profile, float).T
    ring = circle(sides)
    rows = len(x)
    points = np.empty((rows, sides, 3))
    points[:, :, 0] = x[:, None]
    points[:, :, 1:] = radius[:, None, None] * ring
    return with_normals(points.reshape(-1, 3), _strip_triangles(rows, sides))


def _strip_triangles(rows: int, sides: int) -> NDArray[np.uint32]:
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = a + sides, b + sides
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]).astype("u4")


def liquid_triangles(sides: int = SIDES) -> NDArray[np.uint32]:
    """Triangles of `liquid_vertices`: wall, floor and surface of a body of liquid."""
    wall = _strip_triangles(2, sides)
    j = np.arange(sides)
    following = (j + 1) % sides
    floor = np.stack([np.full(sides, 4 * sides), 2 * sides + following, 2 * sides + j], 1)
    surface = np.stack([np.full(sides, 4 * sides + 1), 3 * sides + j, 3 * sides + following], 1)
    return np.concatenate([wall, floor, surface]).astype("u4")


def liquid_vertices(floor_x: Array, surface_x: Array, radius: float, tilt: Array, shift: Array) -> NDArray[np.float32]:
    """Vertices (n, 4 sides + 2, 3) of n states of a liquid in an upright cylinder.

    `floor_x`, `surface_x` (n,): heights on the axis; `tilt` (n, 2): rise of the surface per metre along y and z;
    `shift` (n, 2, 2): displacement in y and z of the floor and of the surface (bending). The surface does not go below
    the floor. The rings of the wall and those of floor and surface are separate, so that edges look like edges.
    """
    ring = radius * circle()
    n, sides = len(floor_x), len(ring)
    out = np.empty((n, 4 * sides + 2, 3), np.float32)
    top = np.maximum(surface_x[:, None] + tilt @ ring.T, floor_x[:, None])
    low = np.broadcast_to(floor_x[:, None], top.shape)
    for part, (x, end) in enumerate(((low, 0), (top, 1), (low, 0), (top, 1))):
        here = out[:, part * sides : (part + 1) * sides]
        here[:, :, 0] = x
        here[:, :, 1:] = ring[None] + shift[:, None, end]
    for k, (x, end) in enumerate(((floor_x, 0), (np.maximum(surface_x, floor_x), 1))):
        out[:, 4 * sides + k, 0] = x
        out[:, 4 * sides + k, 1:] = shift[:, end]
    return out


def liquid_normals() -> NDArray[np.float32]:
    """Normals of `liquid_vertices`, for an upright surface."""
    ring = circle()
    sides = len(ring)
    out = np.zeros((4 * sides + 2, 3), np.float32)
    out[: 2 * sides, 1:] = np.concatenate([ring, ring])
    out[2 * sides : 3 * sides, 0] = out[4 * sides, 0] = -1.0
    out[3 * sides : 4 * sides, 0] = out[4 * sides + 1, 0] = 1.0
    return out


def plate(corners: Sequence[tuple[float, float, float]], thickness: float) -> Mesh:
    """A flat plate with four corners, thickened across its plane."""
    base = np.array(corners, float)
    normal = np.cross(base[1] - base[0], base[2] - base[0])
    normal *= 0.5 * thickness / np.linalg.norm(normal)
    points: list[Array] = []
    triangles: list[list[int]] = []

    def face(*quad: Array) -> None:
        start = len(points)
        points.extend(quad)
        triangles.extend([[start, start + 1, start + 2], [start, start + 2, start + 3]])

    face(*(base + normal))
    face(*(base - normal)[::-1])
    for i in range(4):
        a, b = base[i], base[(i + 1) % 4]
        face(a - normal, b - normal, b + normal, a + normal)
    return with_normals(np.array(points), np.array(triangles, "u4"))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.triangles + np.uint32(s) for m, s in zip(meshes, starts, strict=True)]),
        np.concatenate([m.normals for m in meshes]),
    )


def with_normals(vertices: Array, triangles: NDArray[np.uint32]) -> Mesh:
    """A mesh whose normals are the means of the adjoining faces'."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, triangles[:, k], faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return Mesh(vertices.astype(np.float32), triangles.astype("u4"), normals.astype(np.float32))
