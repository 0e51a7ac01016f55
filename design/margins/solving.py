"""Objectives along a loop's frequency response, and vectorised solvers for their roots and minima.

The solvers take many problems at once: each step is one call with all those that are still open. A call of the
response costs much the same for one frequency as for twenty, so what counts is the number of calls: six to ten.
`function(x, which)` gives the values of the problems with the indices `which` at `x`. SciPy's elementwise solvers use
the same methods, with an overhead of their own larger than the response's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.loop import OpenLoop
from maxq.design.model.state_space import ComplexArray

Objective = Callable[[ComplexArray], Array]
"""A real function of L that is made least, or zero, along the curve."""
Function = Callable[[Array, IntArray], Array]

TINY = 1e-300  # lower bound of a logarithm's argument
DB = 20.0 / np.log(10.0)  # dB per neper
ROOT_TOLERANCE = 1e-11  # of the function, nepers or sine of an angle: 1e-10 dB or 6e-10 degrees
STEP = 4.0 * np.finfo(float).eps  # relative width below which a bracket is a point
VALUE_TOLERANCE = 1e-12  # improvement of a minimum below which it is accepted
MOST_STEPS = 100
GOLDEN = 0.3819660112501051


def log_size(loop: ComplexArray) -> Array:
    """ln |L|."""
    return np.asarray(np.log(np.maximum(np.abs(loop), TINY)))


def minus_log_size(loop: ComplexArray) -> Array:
    return -log_size(loop)


def sine(loop: ComplexArray) -> Array:
    """Sine of L's phase: zero on the real axis."""
    return np.asarray(loop.imag / np.maximum(np.abs(loop), TINY))


def minus_sine(loop: ComplexArray) -> Array:
    return -sine(loop)


def sensitivity(loop: ComplexArray) -> Array:
    """ln of 1/|S| = |1 + L|."""
    return log_size(1.0 + loop)


def complementary(loop: ComplexArray) -> Array:
    """ln of 1/|T| = |1 + 1/L|."""
    return np.asarray(log_size(1.0 + loop) - log_size(loop))


def symmetric(loop: ComplexArray) -> Array:
    """ln of |1 + L| / |1 - L|."""
    return np.asarray(log_size(1.0 + loop) - log_size(1.0 - loop))


def from_minus_one_deg(loop: ComplexArray) -> Array:
    """Phase beyond the nearest -180 + 360 k degrees, in (-180, 180]."""
    return np.asarray(np.degrees(np.angle(-loop)))


def sample(loop: OpenLoop, frequency_hz: Array) -> ComplexArray:
    """L, checked. Raises ValueError where it is not finite or has another shape."""
    values = np.asarray(loop.response(frequency_hz), np.complex128)
    if values.shape != frequency_hz.shape:
        raise ValueError(f"the loop's response has shape {values.shape}, not {frequency_hz.shape}")
    good = np.isfinite(values)
    if not good.all():
        k = int(np.argmin(good))
        raise ValueError(f"the loop's response at {frequency_hz[k]:.9g} Hz is {values[k]}")
    return values


def along(loop: OpenLoop, objectives: Sequence[Objective], kind: IntArray) -> Function:
    """For the solvers: problem i is that of `objectives[kind[i]]`."""

    def function(frequency_hz: Array, which: IntArray) -> Array:
        values, kinds = sample(loop, frequency_hz), kind[which]
        out = np.empty(len(which))
        for k, objective in enumerate(objectives):
            chosen = kinds == k
            if chosen.any():
                out[chosen] = objective(values[chosen])
        return out

    return function


def roots(function: Function, low: Array, high: Array, f_low: Array, f_high: Array) -> Array:
    """A root in each bracket whose ends have values of unlike sign (zero counts as either).

    Chandrupatla's method: inverse quadratic interpolation where it is safe, bisection elsewhere (T. R.
    Chandrupatla, Advances in Engineering Software 28, 1997). A jump through zero is found like a root.
    """
    x1, x2, f1, f2 = low.copy(), high.copy(), f_low.copy(), f_high.copy()
    best = np.where(np.abs(f1) < np.abs(f2), x1, x2)
    open_ = np.flatnonzero((f1 != 0.0) & (f2 != 0.0))
    with np.errstate(all="ignore"):
        t = np.clip(f1 / (f1 - f2), 0.05, 0.95)  # the first step is the secant's
        for _ in range(MOST_STEPS):
            if not len(open_):
                break
            a, b, fa, fb, share = x1[open_], x2[open_], f1[open_], f2[open_], t[open_]
            x = a + share * (b - a)
            f = function(x, open_)
            same = (f > 0.0) == (fa > 0.0)
            x3, f3 = np.where(same, a, b), np.where(same, fa, fb)
            b, fb = np.where(same, b, a), np.where(same, fb, fa)
            x1[open_], x2[open_], f1[open_], f2[open_] = x, b, f, fb
            best[open_] = np.where(np.abs(f) < np.abs(fb), x, b)
            width = np.abs(b - x)
            shortest = STEP * np.abs(x) / width
            xi, phi = (x - b) / (x3 - b), (f - fb) / (f3 - fb)
            safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
            share = f / (fb - f) * f3 / (fb - f3) + (x3 - x) / (b - x) * f / (f3 - f) * fb / (f3 - fb)
            share = np.where(safe & np.isfinite(share), share, 0.5)
            t[open_] = np.clip(share, shortest, 1.0 - shortest)
            done = (np.minimum(np.abs(f), np.abs(fb)) < ROOT_TOLERANCE) | (shortest > 0.25)
            open_ = open_[~done]
    return best


def minima(function: Function, points: Array, values: Array) -> Array:
    """The lowest point within each bracket; `points` and `values` (problems, 3), the middle value the least.

    Parabolas, and a golden section where they stall. The value is good to VALUE_TOLERANCE, the place to its root.
    """
    a, c, b = points.T.copy()
    fa, fc, fb = values.T.copy()
    open_ = np.flatnonzero(np.isfinite(fa + fb + fc))
    wide = b - a
    with np.errstate(all="ignore"):
        for step in range(MOST_STEPS):
            if not len(open_):
                break
            i = open_
            x, gain = vertex(a[i], c[i], b[i], fa[i], fc[i], fb[i])
            to_right = b[i] - c[i] > c[i] - a[i]
            golden = c[i] + GOLDEN * np.where(to_right, b[i] - c[i], a[i] - c[i])
            stalled = b[i] - a[i] > 0.5 * wide[i] if step % 3 == 2 else np.zeros(len(i), bool)
            if step % 3 == 2:
                wide[i] = b[i] - a[i]
            nudge = np.maximum(1e-6 * (b[i] - a[i]), STEP * np.abs(c[i]))
            x = np.where(np.isfinite(x), x, golden)
            x = np.where(np.abs(x - c[i]) < nudge, c[i] + np.where(to_right, nudge, -nudge), x)
            x = np.where(stalled, golden, x)
            f = function(x, i)
            _narrow((a, c, b, fa, fc, fb), i, x, f)
            done = ~(gain >= VALUE_TOLERANCE) & (step >= 3) | (b[i] - a[i] < 8.0 * STEP * np.abs(c[i]))
            open_ = i[~done]
    return np.asarray(c)


def vertex(a: Array, c: Array, b: Array, fa: Array, fc: Array, fb: Array) -> tuple[Array, Array]:
    """Lowest point of the parabola through three points, and how far it lies below the middle one."""
    left, right = (fa - fc) / (c - a), (fb - fc) / (b - c)
    curvature = (left + right) / (b - a)
    # slope at c of the interpolating parabola
    slope = (right * (c - a) - left * (b - c)) / (b - a)
    return np.asarray(c - slope / (2.0 * curvature)), np.asarray(slope**2 / (4.0 * curvature))


def _narrow(state: tuple[Array, ...], i: IntArray, x: Array, f: Array) -> None:
    """Update the brackets `i` with a new point."""
    a, c, b, fa, fc, fb = state
    right, better = x > c[i], f <= fc[i]
    # the old middle becomes an end if the new point is lower, otherwise the new point does
    x_end, f_end = np.where(better, c[i], x), np.where(better, fc[i], f)
    to_left_end = right == better
    a[i], fa[i] = np.where(to_left_end, x_end, a[i]), np.where(to_left_end, f_end, fa[i])
    b[i], fb[i] = np.where(to_left_end, b[i], x_end), np.where(to_left_end, fb[i], f_end)
    c[i], fc[i] = np.where(better, x, c[i]), np.where(better, f, fc[i])


def wrapped(angle: float, half_turn: float) -> float:
    """The same angle in [-half_turn, half_turn)."""
    return float((angle + half_turn) % (2.0 * half_turn) - half_turn)
