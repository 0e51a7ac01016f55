"""Compiled objectives along a loop's frequency response, and solvers for their roots and minima.

The solvers treat many problems simultaneously: each step evaluates L at one frequency of every open problem. A loop
that Python evaluates costs about the same for one frequency as for twenty, so the number of steps determines the time.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from maxq.control.kernel.jit import formula, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.own_part import SHARE
from maxq.design.margins.response import LoopResponse, reciprocal, values_at
from maxq.design.model.state_space import ComplexArray

Real = TypeVar("Real", float, Array)

TINY = 1e-300  # lower bound of a logarithm's argument
DB = 20.0 / np.log(10.0)  # dB per neper
ROOT_TOLERANCE = 1e-11  # of the function, in nepers or as the sine of an angle: 1e-10 dB or 6e-10 degrees
STEP = 4.0 * np.finfo(float).eps  # relative width below which a bracket counts as a point
VALUE_TOLERANCE = 1e-12  # a minimum is accepted if the expected improvement is smaller
MOST_STEPS = 100
GOLDEN = 0.3819660112501051

SENSITIVITY, COMPLEMENTARY, SYMMETRIC, MINUS_LOG_SIZE, LOG_SIZE, SINE, MINUS_SINE, LAG_DEG, LEAD_DEG, CLEARANCE = range(
    10
)
"""Objectives: ln |1 + L|, ln |1 + 1/L|, ln |1 + L|/|1 - L|, -ln |L|, ln |L|, sine of the phase and its negative, lag
and lead that turn L to the phase of -1, deg. Numbers from CLEARANCE upwards are the clearances of zones 0, 1, ..., and
from CORNER downwards their corners (distances.py). From LOBE upwards, the objective is ln of the ratio of a lobe's term
to its bound (`lobe_excess`)."""
CORNER, LOBE = -1, 1000
DIAMOND, RECTANGLE, ELLIPSE = range(3)


def log_size(loop: ComplexArray) -> Array:
    """Return ln |L|."""
    return np.asarray(np.log(np.maximum(np.abs(loop), TINY)))


def from_minus_one_deg(loop: ComplexArray) -> Array:
    """Return the phase relative to the nearest -180 + 360 k degrees, in (-180, 180]."""
    return np.asarray(np.degrees(np.angle(-loop)))


@formula
def vertex(a: Real, c: Real, b: Real, fa: Real, fc: Real, fb: Real) -> tuple[Real, Real]:
    """Return the lowest point of the parabola through three points, and its depth below the middle point."""
    left, right = (fa - fc) / (c - a), (fb - fc) / (b - c)
    curvature = (left + right) / (b - a)
    slope = (right * (c - a) - left * (b - c)) / (b - a)
    return c - slope / (2.0 * curvature), slope * slope / (4.0 * curvature)


def wrapped(angle: float, half_turn: float) -> float:
    """Return the angle wrapped to [-half_turn, half_turn)."""
    return float((angle + half_turn) % (2.0 * half_turn) - half_turn)


@routine
def log_abs(x: complex) -> float:
    return float(np.log(max(abs(x), TINY)))


@routine
def square(x: complex) -> float:
    """Return |x|^2."""
    return float(x.real * x.real + x.imag * x.imag)


@routine
def angle(x: complex) -> float:
    return float(np.arctan2(x.imag, x.real))


@routine
def lag_of(x: complex) -> float:
    """Return the lag in [0, 360) deg that turns a complex value to the phase of -1."""
    return float(np.degrees(angle(-x)) % 360.0)


@routine
def lobe_excess(j: int, hz: float, x: complex, lobes: Array) -> float:
    """Return ln of the ratio of lobe j's term to its bound.

    The bound is the largest other term, or SHARE times the rest of L if that is larger. `x` is L at `hz`. `lobes`
    (lobes, 4) contains real and imaginary part of the strength, frequency and half width, Hz.
    """
    most = 0.0
    for i in range(len(lobes)):
        term = complex(lobes[i, 0], lobes[i, 1]) * reciprocal(complex(1.0, (hz - lobes[i, 2]) / lobes[i, 3]))
        most = max(most, SHARE * abs(x - term) if i == j else abs(term))
    own = complex(lobes[j, 0], lobes[j, 1]) * reciprocal(complex(1.0, (hz - lobes[j, 2]) / lobes[j, 3]))
    return float(np.log(max(abs(own), TINY) / max(most, TINY)))


@routine
def objective(kind: int, hz: float, x: complex, shapes: Array) -> float:
    """Return an objective at a frequency `hz` where L is `x`.

    `shapes` contains zones (zones, 3) as shape and half axes in deg and dB, or the lobes of `lobe_excess`.
    """
    if kind == SENSITIVITY:
        return log_abs(1.0 + x)
    if kind == COMPLEMENTARY:
        return log_abs(1.0 + x) - log_abs(x)
    if kind == SYMMETRIC:
        return log_abs(1.0 + x) - log_abs(1.0 - x)
    if kind == LOG_SIZE:
        return log_abs(x)
    if kind == MINUS_LOG_SIZE:
        return -log_abs(x)
    if kind == SINE:
        return x.imag / max(abs(x), TINY)
    if kind == MINUS_SINE:
        return -x.imag / max(abs(x), TINY)
    if kind == LAG_DEG:
        return lag_of(x)
    if kind == LEAD_DEG:
        return 360.0 - lag_of(x)
    if kind >= LOBE:
        return lobe_excess(kind - LOBE, hz, x, shapes)
    zone = shapes[kind - CLEARANCE if kind > 0 else CORNER - kind]
    across, up = abs(np.degrees(angle(-x))) / zone[1], abs(DB * log_abs(x)) / zone[2]
    if kind < 0:
        return float(across - up)
    if zone[0] == DIAMOND:
        return float(across + up - 1.0)
    return float(max(across, up) if zone[0] == RECTANGLE else np.hypot(across, up)) - 1.0


@routine
def objectives(kind: int, loop: ComplexArray, zones: Array) -> Array:
    """Return an objective that depends on L alone, at each point of a curve."""
    out = np.empty(len(loop))
    for k in range(len(loop)):
        out[k] = objective(kind, 0.0, loop[k], zones)
    return out


@routine
def roots(kind: IntArray, ends: Array, values: Array, loop: LoopResponse, shapes: Array) -> Array:
    """Return a root (Hz) of each objective in its bracket.

    `ends` and `values` have the shape (problems, 2). The two values of a problem have opposite signs; zero counts as
    either sign. Chandrupatla's method uses inverse quadratic interpolation if it is safe, and bisection otherwise (T.
    R. Chandrupatla, Advances in Engineering Software 28, 1997). A jump through zero counts as a root.
    """
    n = len(kind)
    x1, x2, f1, f2 = ends[:, 0].copy(), ends[:, 1].copy(), values[:, 0].copy(), values[:, 1].copy()
    best, share, open_ = np.empty(n), np.empty(n), np.empty(n, np.bool_)
    for i in range(n):
        best[i] = x1[i] if abs(f1[i]) < abs(f2[i]) else x2[i]
        share[i] = min(max(f1[i] / (f1[i] - f2[i]), 0.05), 0.95)  # the first step is a secant step
        open_[i] = f1[i] != 0.0 and f2[i] != 0.0
    for _ in range(MOST_STEPS):
        which = np.flatnonzero(open_)
        if len(which) == 0:
            break
        at = np.empty(len(which))
        for j in range(len(which)):
            i = which[j]
            at[j] = x1[i] + share[i] * (x2[i] - x1[i])
        there = values_at(at, loop)
        for j in range(len(which)):
            i, x, f = which[j], at[j], objective(kind[which[j]], at[j], there[j], shapes)
            if (f > 0.0) == (f1[i] > 0.0):
                x3, f3 = x1[i], f1[i]
            else:
                x3, f3 = x2[i], f2[i]
                x2[i], f2[i] = x1[i], f1[i]
            x1[i], f1[i] = x, f
            best[i] = x if abs(f) < abs(f2[i]) else x2[i]
            width = abs(x2[i] - x)
            shortest = STEP * abs(x) / width if width > 0.0 else 1.0
            xi, phi = (x - x2[i]) / (x3 - x2[i]), (f - f2[i]) / (f3 - f2[i])
            share[i] = 0.5
            if phi * phi < xi and (1.0 - phi) ** 2 < 1.0 - xi:
                tried = f / (f2[i] - f) * f3 / (f2[i] - f3)
                tried += (x3 - x) / (x2[i] - x) * f / (f3 - f) * f2[i] / (f3 - f2[i])
                share[i] = tried if np.isfinite(tried) else 0.5
            share[i] = min(max(share[i], shortest), 1.0 - shortest)
            open_[i] = not (min(abs(f), abs(f2[i])) < ROOT_TOLERANCE or shortest > 0.25)
    return best


@routine
def minima(kind: IntArray, points: Array, values: Array, loop: LoopResponse, shapes: Array) -> Array:
    """Return the lowest point (Hz) within each bracket.

    `points` and `values` have the shape (problems, 3), and the middle value is the least. The method uses parabolas,
    and a golden section if they stall. The minimum is accurate to VALUE_TOLERANCE, and its location to the square root
    of that.
    """
    n = len(kind)
    a, c, b = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    fa, fc, fb = values[:, 0].copy(), values[:, 1].copy(), values[:, 2].copy()
    wide, promised, open_ = b - a, np.empty(n), np.isfinite(fa + fc + fb)
    for step in range(MOST_STEPS):
        which = np.flatnonzero(open_)
        if len(which) == 0:
            break
        at = np.empty(len(which))
        for j in range(len(which)):
            i = which[j]
            x, promised[i] = vertex(a[i], c[i], b[i], fa[i], fc[i], fb[i])
            to_right = b[i] - c[i] > c[i] - a[i]
            golden = c[i] + GOLDEN * (b[i] - c[i] if to_right else a[i] - c[i])
            nudge = max(1e-6 * (b[i] - a[i]), STEP * abs(c[i]))
            x = x if np.isfinite(x) else golden
            if abs(x - c[i]) < nudge:
                x = c[i] + (nudge if to_right else -nudge)
            if step % 3 == 2:
                x = golden if b[i] - a[i] > 0.5 * wide[i] else x
                wide[i] = b[i] - a[i]
            at[j] = x
        there = values_at(at, loop)
        for j in range(len(which)):
            i, x, f = which[j], at[j], objective(kind[which[j]], at[j], there[j], shapes)
            beyond, better = x > c[i], f <= fc[i]
            x_end, f_end = (c[i], fc[i]) if better else (x, f)
            if beyond == better:
                a[i], fa[i] = x_end, f_end
            else:
                b[i], fb[i] = x_end, f_end
            if better:
                c[i], fc[i] = x, f
            done = (not promised[i] >= VALUE_TOLERANCE and step >= 3) or b[i] - a[i] < 8.0 * STEP * abs(c[i])
            open_[i] = not done
    return c
