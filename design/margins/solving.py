"""Many roots or minima of a function of one variable at once: each step is one call with all that are still open.

`function(x, which)` gives the values of problems number `which` (indices) at `x`. A call costs much the same for one
frequency as for twenty, so what counts is the number of calls: six to ten for either solver.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from maxq.control.kernel.records import Array, IntArray

Function = Callable[[Array, IntArray], Array]

ROOT_TOLERANCE = 1e-11  # of the function: nepers or sine of an angle, so 1e-10 dB or 6e-10 degrees
STEP = 4.0 * np.finfo(float).eps  # relative width below which a bracket is a point
VALUE_TOLERANCE = 1e-12  # improvement that is not worth another step to a minimum
MOST_STEPS = 100
GOLDEN = 0.3819660112501051


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
            t[open_] = np.clip(_chandrupatla(x, b, x3, f, fb, f3), shortest, 1.0 - shortest)
            done = (np.minimum(np.abs(f), np.abs(fb)) < ROOT_TOLERANCE) | (shortest > 0.25)
            open_ = open_[~done]
    return best


def _chandrupatla(x1: Array, x2: Array, x3: Array, f1: Array, f2: Array, f3: Array) -> Array:
    """Where in [x1, x2] to look next, as a share."""
    xi, phi = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2)
    safe = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi)
    share = f1 / (f2 - f1) * f3 / (f2 - f3) + (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
    return np.where(safe & np.isfinite(share), share, 0.5)


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
            x, gain = _vertex(a[i], c[i], b[i], fa[i], fc[i], fb[i])
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


def _vertex(a: Array, c: Array, b: Array, fa: Array, fc: Array, fb: Array) -> tuple[Array, Array]:
    """Lowest point of the parabola through three points, and how far it lies below the middle one."""
    left, right = (fa - fc) / (c - a), (fb - fc) / (b - c)
    curvature = (left + right) / (b - a)
    # slope at c of the interpolating parabola
    slope = (right * (c - a) - left * (b - c)) / (b - a)
    return np.asarray(c - slope / (2.0 * curvature)), np.asarray(slope**2 / (4.0 * curvature))


def _narrow(state: tuple[Array, ...], i: IntArray, x: Array, f: Array) -> None:
    """Take a new point into the brackets number `i`."""
    a, c, b, fa, fc, fb = state
    right, better = x > c[i], f <= fc[i]
    # the old middle becomes an end if the new point is lower, otherwise the new point does
    x_end, f_end = np.where(better, c[i], x), np.where(better, fc[i], f)
    to_left_end = right == better
    a[i], fa[i] = np.where(to_left_end, x_end, a[i]), np.where(to_left_end, f_end, fa[i])
    b[i], fb[i] = np.where(to_left_end, b[i], x_end), np.where(to_left_end, fb[i], f_end)
    c[i], fc[i] = np.where(better, x, c[i]), np.where(better, f, fc[i])
