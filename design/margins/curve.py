"""The frequency response of a loop as a curve, on a grid that is adapted to its poles.

Each pole of L and each zero of 1 + L is surrounded by points, so that no narrow feature is missed. Their offsets begin
at a fraction of the half width (the real part) and grow by factors of 1 + sqrt(2). The circle of a resonance therefore
has some twenty points at any damping ratio from 0.05 to 1e-6. Zeros of L are not known to the grid but turn the phase.
Intervals over which the phase of L or of 1 + L turns by more than TURN_RAD are halved until none remains.
`with_extremes` adds the turning points: peaks of |L|, least distances, and near misses between two points of the grid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from maxq.control.kernel.jit import formula, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.loop import OpenLoop
from maxq.design.margins import solving
from maxq.design.margins.response import TWO_PI, LoopResponse, values_at
from maxq.design.margins.solving import (
    COMPLEMENTARY,
    LAG_DEG,
    LOG_SIZE,
    MINUS_LOG_SIZE,
    MINUS_SINE,
    SENSITIVITY,
    SINE,
    SYMMETRIC,
    TINY,
    angle,
    objective,
    square,
)
from maxq.design.model.state_space import ComplexArray

LOWEST_HZ = 1e-5  # a slower root (time constant above 4 hours) is drift and not part of the loop's dynamics
PER_DECADE = 16
PER_DECADE_FLAT = 6  # points per decade below the slowest and above the fastest pole
TURN_RAD = 0.6
FLOOR = 1e-4  # the phase of L is irrelevant below this magnitude (-80 dB)
NARROW = 1e-12  # relative width below which an interval is not halved
MOST_POINTS = 200_000
_MOST_ROUNDS = 40
ASYMPTOTIC, DRIFT_UP_TO_HZ = 4.0, 1e-3  # ratio of frequencies; a time constant of a few minutes
ON_AXIS = 1e-9  # |Re p| / |p| below which a pole counts as on the axis
OSCILLATING = 0.5  # damping ratio below which a pole gets its own points

LOWEST_PEAK = np.log(1e-3)  # peaks below -60 dB are not refined
REACH = 4.0  # a minimum may be below the middle point by this multiple of the parabola's drop

TAN_TURN = float(np.tan(TURN_RAD))
_RATIO = 1.0 + np.sqrt(2.0)
_STEPS = 25
IMPROPER, WINDING = 1, 2
"""Problems of a curve: |L| grows without bound, or the phase turns too often to be resolved."""


class Trace(NamedTuple):
    """The response L at rising frequencies, in the form for compiled code (see `LoopCurve`).

    `problem` is 0, IMPROPER or WINDING.
    """

    frequency_hz: Array
    loop: ComplexArray
    slope_at_zero: int
    at_zero: float
    slope_at_end: int
    finite_end: bool
    problem: int


@dataclass(frozen=True)
class LoopCurve:
    """The response L at rising frequencies, and the poles (rad/s) from which the grid was derived.

    `finite_end` is True if the curve ends at the Nyquist frequency. `slope_at_zero` and `slope_at_end` are the
    exponents n of the asymptotes L ~ (j f)^n; the slope at the Nyquist frequency is 0. If `slope_at_zero` is 0, L is
    real at zero frequency and even in f, and `at_zero` is its limit.
    """

    source: OpenLoop
    frequency_hz: Array
    loop: ComplexArray
    open_poles: ComplexArray
    closed_poles: ComplexArray
    slope_at_zero: int
    at_zero: float
    slope_at_end: int
    finite_end: bool

    @property
    def lowest_radps(self) -> float:
        """Return the frequency below which poles count as drift, rad/s."""
        return float(2.0 * np.pi * self.frequency_hz[0])


@formula
def lowest_hz_of(open_poles: ComplexArray) -> float:
    """Return the lowest frequency (Hz) of the curve of a loop with these poles (rad/s): LOWEST_HZ, or above slow roots.

    In thin air, path and attitude have slow roots with time constants up to a few hours. L has no asymptote near these
    roots, so the curve cannot begin there. If the roots follow each other up to DRIFT_UP_TO_HZ without a gap of twice
    the factor ASYMPTOTIC, the curve begins in the middle of their widest gap.
    """
    low, every = LOWEST_HZ, np.sort(np.abs(open_poles)) / TWO_PI
    for hz in every:
        if low / ASYMPTOTIC < hz < ASYMPTOTIC * low:
            low = ASYMPTOTIC * hz
    if low <= DRIFT_UP_TO_HZ:
        return low
    low, widest = LOWEST_HZ, 1.0
    for k in range(len(every) - 1):
        a, b = max(every[k], LOWEST_HZ / ASYMPTOTIC), every[k + 1]
        middle = math.sqrt(a * b)
        if LOWEST_HZ <= middle <= DRIFT_UP_TO_HZ and b > widest * a:
            low, widest = middle, b / a
    return low


def finite(poles: ComplexArray, kind: str) -> ComplexArray:
    """Return the poles except those at minus infinity (z = 0 of a sampled loop). Raises ValueError for NaN.

    `kind` is the word for the message, "open" or "closed".
    """
    p = np.atleast_1d(np.asarray(poles, np.complex128))
    p = p[np.abs(p.real) != np.inf]
    if not np.isfinite(p).all():
        raise ValueError(f"{kind}-loop poles are not numbers: {p[~np.isfinite(p)][0]}")
    return np.ascontiguousarray(p)


@routine
def traced(open_: ComplexArray, closed: ComplexArray, lowest: float, end: float, loop: LoopResponse) -> Trace:
    """Return the curve from `lowest` to `end` in Hz, which is infinite for a continuous loop."""
    first = values_at(np.array([lowest, min(2.0 * lowest, end)]), loop)
    slope_at_zero, at_zero = 0, first[0].real
    if abs(first[0]) > 0.0 and abs(first[1]) > 0.0:
        slope_at_zero = round_(np.log2(abs(first[1]) / abs(first[0])))
        at_zero = (4.0 * first[0].real - first[1].real) / 3.0
    finite_end, slope_at_end, problem = np.isfinite(end), 0, 0
    if not finite_end:
        end, slope_at_end, problem = _end(open_, closed, lowest, loop)
    f = _grid(open_, closed, lowest, end, finite_end)
    f, values, followed = _refined(f, values_at(f, loop), loop)
    if problem == 0 and not followed:
        problem = WINDING
    return Trace(f, values, slope_at_zero, at_zero, slope_at_end, finite_end, problem)


@routine
def round_(x: float) -> int:
    return int(np.round(x)) if abs(x) < 1e9 else 0


@routine
def _end(open_: ComplexArray, closed: ComplexArray, lowest: float, loop: LoopResponse) -> tuple[float, int, int]:
    """Return the highest frequency of a continuous loop's curve (Hz), the slope there, and the problem.

    The curve ends where L has reached its asymptote or is negligibly small.
    """
    fastest, some = 100.0 * lowest, False
    for which in range(2):
        for p in open_ if which == 0 else closed:
            if p.imag >= 0.0 and abs(p) > TWO_PI * lowest:
                fastest, some = max(fastest, abs(p) / TWO_PI), True
    f = 30.0 * (fastest if some else max(1.0, fastest)) * 10.0 ** np.arange(7.0)
    values = values_at(np.concatenate((f, 1.1 * f)), loop)
    place, steep, still = 6, np.nan, False
    for k in range(7):
        size = abs(values[k])
        slope = np.log(abs(values[k + 7]) / size) / np.log(1.1)
        quarter = angle(values[k]) / (0.25 * TWO_PI)
        level = np.round(slope) == 0.0  # a level end may be near -1, and a sloping one is far from it
        settled = abs(slope - np.round(slope)) < (1e-4 if level else 0.01)
        settled = settled and abs(quarter - np.round(quarter)) < (1e-4 if level else 0.02)
        if settled or size < FLOOR or k == 6:
            place, steep, still = k, slope, settled
            break
    n = round_(steep) if np.isfinite(steep) else -1
    small = abs(values[place]) < FLOOR
    problem = IMPROPER if n > 0 and abs(values[place]) > 0.0 and (still or not small) else 0
    # the phase of a pure delay never settles: L remains small or level above this frequency
    return f[place], min(n, 0) if still else -1 if small else 0, problem


@routine
def _decades(low: float, high: float, density: float, out: Array, n: int) -> int:
    count = max(2, int(np.ceil(density * np.log10(max(high / low, 1.001)))))
    ratio = (high / low) ** (1.0 / count)
    f = low
    for _ in range(count):
        out[n] = f
        n += 1
        f *= ratio
    return n


@routine
def _grid(open_: ComplexArray, closed: ComplexArray, lowest: float, end: float, finite_end: bool) -> Array:
    decades = np.log10(end / lowest)
    out = np.empty(20 + int(2 * PER_DECADE * decades) + (2 * _STEPS + 1) * (len(open_) + len(closed)))
    slow, fast, n = np.inf, 0.0, 0
    for which in range(2):
        for p in open_ if which == 0 else closed:
            size = abs(p)
            if p.imag < 0.0 or size <= TWO_PI * lowest:
                continue
            slow, fast = min(slow, size / TWO_PI), max(fast, size / TWO_PI)
            if p.imag > 0.0 and abs(p.real) < OSCILLATING * size:
                width, step = max(abs(p.real), ON_AXIS * size), 1.0 / _RATIO
                # omits a pole on the axis, where L is infinite
                if abs(p.real) >= ON_AXIS * size:
                    out[n] = p.imag / TWO_PI
                    n += 1
                for _ in range(_STEPS):
                    if step * width >= 0.7 * p.imag:
                        break
                    out[n], out[n + 1] = (p.imag - step * width) / TWO_PI, (p.imag + step * width) / TWO_PI
                    n += 2
                    step *= _RATIO
    if fast == 0.0:
        slow = fast = 1.0
    slow = min(max(0.3 * slow, 2.0 * lowest), 0.5 * end)
    fast = min(max(3.0 * fast, 2.0 * lowest), 0.5 * end)
    n = _decades(lowest, slow, PER_DECADE_FLAT, out, n)
    n = _decades(slow, fast, PER_DECADE, out, n)
    n = _decades(fast, end, PER_DECADE_FLAT, out, n)
    out[n], out[n + 1], out[n + 2] = lowest, end, end * (1.0 - 1e-6)
    f = np.sort(out[: n + (3 if finite_end else 2)])
    m = 0
    for x in f:
        if lowest <= x <= end and (m == 0 or x - f[m - 1] > NARROW * x):
            f[m] = x
            m += 1
    return f[:m].copy()


@routine
def _turned(a: complex, b: complex) -> bool:
    """Return True if the angle between two complex values exceeds TURN_RAD."""
    way = a * b.conjugate()
    return bool(way.real < 0.0 or abs(way.imag) > TAN_TURN * way.real)


@routine
def _refined(f: Array, loop: ComplexArray, source: LoopResponse) -> tuple[Array, ComplexArray, bool]:
    """Return the curve with intervals halved in which L or 1 + L turns too far, and True if none remains.

    Intervals next to them that are much wider are halved too.
    """
    n = len(f)
    fresh = np.ones(n, np.bool_)
    for _ in range(_MOST_ROUNDS):
        coarse, any_ = np.zeros(n, np.bool_), False
        for k in range(n - 1):
            if not fresh[k] or f[k + 1] - f[k] <= 1e3 * NARROW * f[k + 1]:
                continue
            a, b = loop[k], loop[k + 1]
            seen = max(square(a), square(b)) > FLOOR * FLOOR
            if (seen and _turned(b, a)) or _turned(1.0 + b, 1.0 + a):
                coarse[k] = any_ = True
        if not any_:
            break
        # a turn by a multiple of 2 pi is invisible, so intervals next to a turn are also refined
        more = coarse.copy()
        for k in range(n - 1):
            beside = np.inf
            if k > 0 and coarse[k - 1]:
                beside = 0.5 * (f[k] - f[k - 1])
            if k < n - 2 and coarse[k + 1]:
                beside = min(beside, 0.5 * (f[k + 2] - f[k + 1]))
            more[k] = coarse[k] or f[k + 1] - f[k] > 4.0 * beside
        new = np.flatnonzero(more)
        if n + len(new) > MOST_POINTS:
            return f, loop, False
        middle = 0.5 * (f[new] + f[new + 1])
        f, loop, places = merged(f, loop, middle, source)
        n, fresh = len(f), np.zeros(len(f), np.bool_)
        fresh[places] = True
        fresh[places - 1] = True
    return f, loop, True


@routine
def merged(f: Array, loop: ComplexArray, new: Array, source: LoopResponse) -> tuple[Array, ComplexArray, IntArray]:
    """Return the curve with points added, and the indices of the new points. Existing points are omitted."""
    new = np.sort(new)
    values = values_at(new, source)
    n = len(f)
    g, h, places = np.empty(n + len(new)), np.empty(n + len(new), np.complex128), np.empty(len(new), np.int64)
    i = k = m = count = 0
    while i < n or k < len(new):
        if k == len(new) or (i < n and f[i] <= new[k]):
            g[m], h[m] = f[i], loop[i]
            i += 1
        else:
            x = new[k]
            k += 1
            if m > 0 and g[m - 1] == x:
                continue
            g[m], h[m] = x, values[k - 1]
            places[count] = m
            count += 1
        m += 1
    return g[:m].copy(), h[:m].copy(), places[:count].copy()


@routine
def is_bracket(value: Array, k: int) -> bool:
    """Return True for an inner point that is not above either neighbour and is below at least one of them."""
    left, here, right = value[k - 1], value[k], value[k + 1]
    return bool(here <= left and here <= right and (here < left or here < right))


@routine
def course(kind: int, loop: ComplexArray) -> Array:
    """Return an inexpensive monotone function of an objective of L at each point, without a logarithm."""
    out = np.empty(len(loop))
    for k in range(len(loop)):
        size = square(loop[k])
        if kind == MINUS_LOG_SIZE:
            out[k] = -size
        elif kind == LOG_SIZE:
            out[k] = size
        elif kind in (SINE, MINUS_SINE):
            sine = loop[k].imag / np.sqrt(max(size, TINY))
            out[k] = sine if kind == SINE else -sine
        else:
            by = 1.0 if kind == SENSITIVITY else size if kind == COMPLEMENTARY else square(1.0 - loop[k])
            out[k] = square(1.0 + loop[k]) / max(by, TINY)
    return out


@routine
def with_extremes(f: Array, loop: ComplexArray, distances: int, source: LoopResponse) -> tuple[Array, ComplexArray]:
    """Return the curve with its turning points added.

    These are the maxima of |L|, and the minima of the first `distances` (0 to 3) of the functions |1 + L|, |1 + 1/L|
    and |1 + L|/|1 - L|. Of the minima, only those that may be global are included. Extremes of |L| and of the phase are
    added if they may reach 1 or 180 degrees between two points of the grid.
    """
    n, m, none = len(f), 0, np.zeros((0, 3))
    kinds, points, values = np.empty(7 * n, np.int64), np.empty((7 * n, 3)), np.empty((7 * n, 3))
    for kind in range(LAG_DEG):
        if distances <= kind <= SYMMETRIC:
            continue
        rising = course(kind, loop)
        least = 0.0
        if kind <= SYMMETRIC:
            least = objective(kind, 0.0, loop[int(np.argmin(rising))], none)
        for k in range(1, n - 1):
            if not is_bracket(rising, k) or (kind >= SINE and not (rising[k] > 0.0 and loop[k].real < 0.0)):
                continue
            for p in range(3):
                points[m, p], values[m, p] = f[k - 1 + p], objective(kind, 0.0, loop[k - 1 + p], none)
            here = values[m, 1]
            _, drop = solving.vertex(f[k - 1], f[k], f[k + 1], values[m, 0], here, values[m, 2])
            reachable = here - REACH * drop
            if kind <= SYMMETRIC:
                worth = reachable <= least
            elif kind == MINUS_LOG_SIZE:
                worth = here < -LOWEST_PEAK
            else:
                worth = here > 0.0 and reachable < 0.0
            if worth:
                kinds[m] = kind
                m += 1
    found = solving.minima(kinds[:m], points[:m], values[:m], source, none)
    f, loop, _ = merged(f, loop, found, source)
    return f, loop
