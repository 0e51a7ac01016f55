"""Axial force coefficient over Mach number: an assumed shape, scaled to the flight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import PchipInterpolator

MACH = np.array([0.0, 0.5, 0.8, 0.95, 1.05, 1.2, 1.5, 2.0, 2.5, 3.0, 5.0])
SHAPE = np.array([0.50, 0.48, 0.50, 0.68, 0.88, 0.90, 0.80, 0.66, 0.56, 0.50, 0.40])


@dataclass(frozen=True)
class Drag:
    """`scale` times the shape; `coast_base` is added when no jet fills the base."""

    scale: float
    coast_base: float

    @cached_property
    def _curve(self) -> PchipInterpolator:
        return PchipInterpolator(MACH, self.scale * SHAPE)

    def coefficient(self, mach: float, *, engine_on: bool) -> float:
        return float(self._curve(min(mach, MACH[-1]))) + (0.0 if engine_on else self.coast_base)
