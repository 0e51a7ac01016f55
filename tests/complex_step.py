"""Provide complex-step derivatives of complex functions, and an independent form of the filter F3."""

from __future__ import annotations

from typing import Any

import numpy as np


class Pair:
    """The number x + j y with complex x and y, so that a complex step passes through it.

    Source: Squire & Trapp, SIAM Review 40, 1998.
    """

    def __init__(self, x: Any, y: Any = 0.0) -> None:
        self.x, self.y = x, y

    def __add__(self, other: Any) -> Pair:
        o = other if isinstance(other, Pair) else Pair(other)
        return Pair(self.x + o.x, self.y + o.y)

    def __mul__(self, other: Any) -> Pair:
        o = other if isinstance(other, Pair) else Pair(other)
        return Pair(self.x * o.x - self.y * o.y, self.x * o.y + self.y * o.x)

    def inverse(self) -> Pair:
        square = self.x * self.x + self.y * self.y
        return Pair(self.x / square, -self.y / square)

    def log(self) -> tuple[Any, Any]:
        """Return the natural logarithm of the magnitude, and the angle; valid within a quarter turn."""
        return 0.5 * np.log(self.x**2 + self.y**2), np.arctan(self.y / self.x)


def filter_f3(own: Any, s: complex) -> Pair:
    """Return F3 at s. `own`: ln zero (Hz), its zeta, ln pole, its zeta; ln zero, ln pole of the first-order section."""
    z_hz, z_zeta, p_hz, p_zeta, z1_hz, p1_hz = own[:6]
    at = Pair(s.real, s.imag)

    def second(ln_hz: Any, zeta: Any) -> Pair:
        w = 2.0 * np.pi * np.exp(ln_hz)
        return Pair(1.0) + at * (2.0 * zeta / w) + at * at * (1.0 / w**2)

    def first(ln_hz: Any) -> Pair:
        return Pair(1.0) + at * (1.0 / (2.0 * np.pi * np.exp(ln_hz)))

    return second(z_hz, z_zeta) * first(z1_hz) * (second(p_hz, p_zeta) * first(p1_hz)).inverse()
