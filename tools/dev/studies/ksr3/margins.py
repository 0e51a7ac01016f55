"""Margins of an open-loop frequency response L (negative feedback: -1 is the point to avoid)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array

Response = NDArray[np.complex128]


@dataclass(frozen=True)
class Margins:
    """Infinite where there is no crossing. `modulus` is the least distance of L from -1."""

    gain_up_db: float  # least increase that reaches -1
    gain_down_db: float  # least decrease that reaches -1
    phase_deg: float  # least turn, either way, over all crossings of |L| = 1
    modulus: float


def margins(loop: Response) -> Margins:
    """From L on a grid fine enough to resolve its resonances; crossings are interpolated linearly."""
    up, down = np.inf, np.inf
    for size in _negative_axis_crossings(loop):
        gain = -20 * np.log10(size)
        up, down = (min(up, gain), down) if gain > 0 else (up, min(down, -gain))
    return Margins(float(up), float(down), _phase_margin_deg(loop), float(np.abs(1 + loop).min()))


def _negative_axis_crossings(loop: Response) -> Array:
    """|L| where L meets the negative real axis, the ends of the grid included."""
    y0, y1 = loop.imag[:-1], loop.imag[1:]
    k = np.flatnonzero(np.signbit(y0) != np.signbit(y1))
    share = y0[k] / (y0[k] - y1[k])
    real = loop.real[k] + share * (loop.real[k + 1] - loop.real[k])
    ends = loop.real[[0, -1]]  # the response is real at zero frequency and at Nyquist
    real = np.append(real, ends[np.abs(loop.imag[[0, -1]]) < 1e-2 * np.abs(ends)])
    return np.asarray(-real[real < 0])


def _phase_margin_deg(loop: Response) -> float:
    size = np.abs(loop) - 1
    k = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
    share = size[k] / (size[k] - size[k + 1])
    point = loop[k] + share * (loop[k + 1] - loop[k])
    return float(np.degrees(np.abs(np.angle(-point))).min()) if len(point) else float("inf")


def unstable_closed_loop_poles(loop: Response, unstable_open: int) -> float:
    """How many poles of the closed loop lie outside the unit circle, by the argument principle.

    `loop` runs from zero frequency to Nyquist. The upper half of the unit circle turns 1 + L by pi for every
    unstable pole of the open loop less one of the closed loop. Not an integer when the grid is too coarse.
    """
    angle = np.unwrap(np.angle(1 + loop))
    return unstable_open - float(angle[-1] - angle[0]) / np.pi
