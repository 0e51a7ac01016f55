"""The inner shape of an axisymmetric tank: surface and volume of its liquid over depth."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Profile(NamedTuple):
    """Inner shape of a tank, lengths in radii of its cylindrical part; domes are half ellipsoids, 0 flat."""

    bottom: float
    wall: float
    top: float

    def surface_radius(self, depth: Array) -> Array:
        """Radius of the surface at rest when the liquid is `depth` deep."""
        low = 1.0 - np.minimum(depth, self.bottom) / self.bottom if self.bottom else 0.0 * depth
        high = np.maximum(depth - self.bottom - self.wall, 0.0) / self.top if self.top else 0.0 * depth
        return np.asarray(np.sqrt(np.maximum(1.0 - low**2 - high**2, 0.0)))

    def volume(self, depth: Array) -> Array:
        """Of the liquid, in cubes of the radius."""
        in_bottom, above = np.minimum(depth, self.bottom), np.maximum(depth - self.bottom, 0.0)
        in_wall, in_top = np.minimum(above, self.wall), np.maximum(above - self.wall, 0.0)
        out = np.pi * in_wall
        if self.bottom:
            out = out + np.pi * in_bottom**2 / self.bottom * (1.0 - in_bottom / (3.0 * self.bottom))
        if self.top:
            out = out + np.pi * in_top * (1.0 - in_top**2 / (3.0 * self.top**2))
        return np.asarray(out)

    @property
    def height(self) -> float:
        return self.bottom + self.wall + self.top

    def depth(self, volume: Array) -> Array:
        """The inverse of `volume`, by bisection."""
        low, high = np.zeros_like(volume), np.full_like(volume, self.height)
        for _ in range(60):
            middle = 0.5 * (low + high)
            below = self.volume(middle) < volume
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return np.asarray(0.5 * (low + high))
