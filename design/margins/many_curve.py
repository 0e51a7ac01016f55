"""The curve of one of many vehicles, compiled: L from poles and residues, zeros of 1 + L, grid, crossings.

The sampled response is the sum of one term for each pole of actuator, vehicle and gyro. A pole l with residue R of
the continuous path answers a command that is held over a period T and acts t late, and is averaged over that period, by

    R (z^-(m+1) / T) [ E1(T) (E1(T - t) + exp(l (T - t)) E1(t) / z) / (z - exp(l T))
                       + E2(T - t) + (E2(t) + E1(T - t) E1(t)) / z ],       E1(a) = (exp(l a) - 1) / l,
                                                                            E2(a) = (E1(a) - a) / l

for a delay of m periods and t: what sampling.py finds by matrix exponentials. Everything is a function of w = z - 1,
since slow poles differ from 1 by little. Zeros of 1 + L are all found at once, from those of the nominal vehicle
(O. Aberth, Math. Comput. 27, 1973). Grid, refinement and solvers are those of curve.py and solving.py, and so are their
constants; what is made of the curve stands in many.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maxq.control.kernel.jit import routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.margins import curve, solving
from maxq.design.model.state_space import ComplexArray

At = Any
"""What L depends on: period, terms of pairs and single poles, what passes directly, law, periods of delay."""

_NEAR = 0.7
FASTEST = 1e-6
_MOST_POINTS = 6000
_MOST_ROUNDS = 60
TWO_PI = 6.283185307179586


@routine
def over(x: complex) -> complex:
    """1 / x; not a number at zero, where Numba's own raises."""
    square = x.real * x.real + x.imag * x.imag
    return complex(x.real / square, -x.imag / square)


@routine
def log_size(x: complex) -> float:
    return float(np.log(max(abs(x), 1e-300)))


@routine
def _objective(kind: int, x: complex) -> float:
    """0 ln |L|, 1 minus that, 2 sine of the phase, 3 minus that, 4 ln |1 + L|."""
    if kind == 0:
        return log_size(x)
    if kind == 1:
        return -log_size(x)
    if kind == 4:
        return log_size(1.0 + x)
    sine = x.imag / max(abs(x), 1e-300)
    return sine if kind == 2 else -sine


@routine
def _e1(x: complex, a: float) -> complex:
    """(exp(x) - 1) / x times a."""
    if abs(x) > 0.5:
        return complex(a * (np.exp(x) - 1.0) / x)
    total, term = 1.0 + 0j, 1.0 + 0j
    for k in range(2, 18):
        term = term * x / k
        total += term
    return a * total


@routine
def _e2(x: complex, a: float) -> complex:
    """(exp(x) - 1 - x) / x^2 times a^2."""
    if abs(x) > 0.5:
        return complex(a * a * (np.exp(x) - 1.0 - x) / (x * x))
    total, term = 0.5 + 0j, 0.5 + 0j
    for k in range(3, 19):
        term = term * x / k
        total += term
    return a * a * total


@routine
def terms(
    poles: ComplexArray, residues: ComplexArray, sample_s: float, rest_s: float, mu: ComplexArray, alpha:
    ComplexArray, beta: ComplexArray, direct: Array,
) -> None:  # fmt: skip  # one line for each otherwise
    """w of each pole, its two residues in z, and what passes directly."""
    direct[0] = direct[1] = 0.0
    for i in range(len(poles)):
        x = poles[i]
        whole, late, early = _e1(x * sample_s, sample_s), _e1(x * (sample_s - rest_s), sample_s - rest_s), 0j
        mu[i] = x * whole
        alpha[i] = residues[i] * whole * late
        on_way = residues[i] * _e2(x * (sample_s - rest_s), sample_s - rest_s)
        direct[0] += on_way.real
        beta[i] = 0.0
        if rest_s > 0.0:
            early = _e1(x * rest_s, rest_s)
            beta[i] = residues[i] * whole * np.exp(x * (sample_s - rest_s)) * early
            direct[1] += (residues[i] * (_e2(x * rest_s, rest_s) + late * early)).real


@routine
def value_at(hz: float, at: At) -> complex:
    """L at a frequency."""
    sample_s, pairs, singles, direct, zeros, poles, gain, periods = at
    half = 0.5 * TWO_PI * hz * sample_s
    sine = np.sin(half)
    w = complex(-2.0 * sine * sine, 2.0 * sine * np.cos(half))
    late = over(1.0 + w)
    total = direct[0] + direct[1] * late
    for i in range(len(pairs)):
        p = pairs[i]
        total += (p[0] * w + p[1] + (p[2] * w + p[3]) * late) * over((w + p[4]) * w + p[5])
    for i in range(len(singles)):
        total += (singles[i, 0] + singles[i, 1] * late) * over(w - singles[i, 2])
    top, below = gain + 0j, 1.0 + 0j
    for i in range(len(zeros)):
        top = top * (w - zeros[i])
    for i in range(len(poles)):
        below = below * (w - poles[i])
    for _ in range(periods):
        top = top * late
    return complex(total * top * over(below))


@routine
def _newton(
    w: complex, mu: ComplexArray, alpha: ComplexArray, beta: ComplexArray, every: ComplexArray, at: At
) -> complex:
    """Derivative over value, by w, of (1 + L) times the factors of `every` pole."""
    _, _, _, direct, zeros, poles, gain, periods = at
    late = over(1.0 + w)
    total, slope = direct[0] + direct[1] * late, -direct[1] * late * late
    for i in range(len(mu)):
        near = over(w - mu[i])
        value = (alpha[i] + beta[i] * late) * near
        total += value
        slope -= value * near + beta[i] * late * late * near
    top, by = gain * total + 0j, slope * over(total)
    for i in range(len(zeros)):
        top = top * (w - zeros[i])
        by += over(w - zeros[i])
    for i in range(len(poles)):
        near = over(w - poles[i])
        top = top * near
        by -= near
    for _ in range(periods):
        top = top * late
        by -= late
    out = by * over(1.0 + over(top))
    for i in range(len(every)):
        out += over(w - every[i])
    return complex(out)


@routine
def zeros_of_one_plus(
    roots: ComplexArray, mu: ComplexArray, alpha: ComplexArray, beta: ComplexArray, every: ComplexArray, at: At
) -> bool:
    """Aberth's method on all of them; False where it does not converge."""
    n = len(roots)
    done = np.zeros(n, np.bool_)
    for _ in range(_MOST_ROUNDS):
        left = 0
        for i in range(n):
            if done[i]:
                continue
            by = _newton(roots[i], mu, alpha, beta, every, at)
            for k in range(n):
                if k != i:
                    by -= over(roots[i] - roots[k])
            move = over(by)
            if not (np.isfinite(move.real) and np.isfinite(move.imag)):
                roots[i] += complex(1e-9, 1e-9) * (abs(roots[i]) + 1e-6)
                left += 1
                continue
            roots[i] -= move
            if abs(move) < 1e-9 * abs(roots[i]) + 1e-14 or abs(1.0 + roots[i]) < 0.1 * FASTEST:
                done[i] = True
            else:
                left += 1
        if left == 0:
            return True
    return False


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
def wrapped(turn: float) -> float:
    return float((turn + 0.5 * TWO_PI) % TWO_PI - 0.5 * TWO_PI)


@routine
def angle(x: complex) -> float:
    return float(np.arctan2(x.imag, x.real))


@routine
def _turned(a: complex, b: complex) -> float:
    return abs(angle(a * b.conjugate()))


@routine
def least_of(kind: int, a: float, c: float, b: float, fa: float, fc: float, fb: float, at: At) -> float:
    """The lowest point of an objective within a bracket, as solving.minima."""
    wide = b - a
    for step in range(100):
        left, right = (fa - fc) / (c - a), (fb - fc) / (b - c)
        curvature = (left + right) / (b - a)
        slope = (right * (c - a) - left * (b - c)) / (b - a)
        x, promised = c - slope / (2.0 * curvature), slope * slope / (4.0 * curvature)
        to_right = b - c > c - a
        golden = c + solving.GOLDEN * (b - c if to_right else a - c)
        stalled = False
        if step % 3 == 2:
            stalled = b - a > 0.5 * wide
            wide = b - a
        nudge = max(1e-6 * (b - a), solving.STEP * abs(c))
        if not np.isfinite(x):
            x = golden
        if abs(x - c) < nudge:
            x = c + (nudge if to_right else -nudge)
        if stalled:
            x = golden
        f = _objective(kind, value_at(x, at))
        beyond, better = x > c, f <= fc
        x_end, f_end = (c, fc) if better else (x, f)
        if beyond == better:
            a, fa = x_end, f_end
        else:
            b, fb = x_end, f_end
        if better:
            c, fc = x, f
        if (not promised >= 1e-12 and step >= 3) or b - a < 8.0 * solving.STEP * abs(c):
            break
    return c


@routine
def _root_of(kind: int, x1: float, x2: float, f1: float, f2: float, at: At) -> float:
    """A root in a bracket, as solving.roots."""
    best = x1 if abs(f1) < abs(f2) else x2
    if f1 == 0.0 or f2 == 0.0:
        return best
    share = min(max(f1 / (f1 - f2), 0.05), 0.95)
    for _ in range(100):
        x = x1 + share * (x2 - x1)
        f = _objective(kind, value_at(x, at))
        if (f > 0.0) == (f1 > 0.0):
            x3, f3 = x1, f1
        else:
            x3, f3, x2, f2 = x2, f2, x1, f1
        x1, f1 = x, f
        best = x1 if abs(f1) < abs(f2) else x2
        width = abs(x2 - x1)
        shortest = solving.STEP * abs(x1) / width if width > 0.0 else 1.0
        xi, phi = (x1 - x2) / (x3 - x2), (f1 - f2) / (f3 - f2)
        share = 0.5
        if phi * phi < xi and (1.0 - phi) ** 2 < 1.0 - xi:
            tried = f1 / (f2 - f1) * f3 / (f2 - f3) + (x3 - x1) / (x2 - x1) * f1 / (f3 - f1) * f2 / (f3 - f2)
            share = tried if np.isfinite(tried) else 0.5
        share = min(max(share, shortest), 1.0 - shortest)
        if min(abs(f1), abs(f2)) < 1e-11 or shortest > 0.25:
            break
    return best


@routine
def merged(f: Array, loop: ComplexArray, n: int, new: Array, at: At) -> tuple[Array, ComplexArray, int]:
    """The curve with points added; those that are there already are left out."""
    new = np.sort(new)
    g, h = np.empty(n + len(new)), np.empty(n + len(new), np.complex128)
    i = k = m = 0
    while i < n or k < len(new):
        if k == len(new) or (i < n and f[i] <= new[k]):
            g[m], h[m] = f[i], loop[i]
            i += 1
        else:
            x = new[k]
            k += 1
            if (m > 0 and g[m - 1] == x) or (i < n and f[i] == x):
                continue
            g[m], h[m] = x, value_at(x, at)
        m += 1
    return g[:m], h[:m], m


@routine
def grid(open_: ComplexArray, closed: ComplexArray, lowest: float, end: float) -> Array:
    """As curve._grid; without number of points where a pole lies on the axis."""
    out = np.empty(200 + 60 * (len(open_) + len(closed)))
    slow, fast = np.inf, 0.0
    n = 0
    for which in range(2):
        group = open_ if which == 0 else closed
        for p in group:
            size = abs(p)
            if p.imag < 0.0 or size <= TWO_PI * lowest:
                continue
            slow, fast = min(slow, size / TWO_PI), max(fast, size / TWO_PI)
            if p.imag > 0.0 and abs(p.real) < curve.OSCILLATING * size:
                width = abs(p.real)
                if width <= curve.ON_AXIS * size:
                    return out[:0]
                step = 1.0 / (1.0 + np.sqrt(2.0))
                out[n] = p.imag / TWO_PI
                n += 1
                for _ in range(25):
                    if step * width >= 0.7 * p.imag:
                        break
                    out[n], out[n + 1] = (p.imag - step * width) / TWO_PI, (p.imag + step * width) / TWO_PI
                    n += 2
                    step *= 1.0 + np.sqrt(2.0)
    slow = min(max(0.3 * slow, 2.0 * lowest), 0.5 * end)
    fast = min(max(3.0 * fast, 2.0 * lowest), 0.5 * end)
    n = _decades(lowest, slow, curve.PER_DECADE_FLAT, out, n)
    n = _decades(slow, fast, curve.PER_DECADE, out, n)
    n = _decades(fast, end, curve.PER_DECADE_FLAT, out, n)
    out[n], out[n + 1], out[n + 2] = lowest, end, end * (1.0 - 1e-6)
    f = np.sort(out[: n + 3])
    m = 0
    for x in f:
        if lowest <= x <= end and (m == 0 or x - f[m - 1] > curve.NARROW * x):
            f[m] = x
            m += 1
    return f[:m]


@routine
def refined(f: Array, loop: ComplexArray, at: At) -> tuple[Array, ComplexArray]:
    """As curve._refine."""
    n = len(f)
    fresh = np.ones(n, np.bool_)
    for _ in range(40):
        coarse, any_ = np.zeros(n, np.bool_), False
        for k in range(n - 1):
            if not fresh[k] or f[k + 1] - f[k] <= 1e3 * curve.NARROW * f[k + 1]:
                continue
            a, b = loop[k], loop[k + 1]
            turned = _turned(b, a) if max(abs(a), abs(b)) > curve.FLOOR else 0.0
            if max(turned, _turned(1.0 + b, 1.0 + a)) > curve.TURN_RAD:
                coarse[k] = any_ = True
        if not any_:
            break
        more = coarse.copy()
        for k in range(n - 1):
            beside = np.inf
            if k > 0 and coarse[k - 1]:
                beside = 0.5 * (f[k] - f[k - 1])
            if k < n - 2 and coarse[k + 1]:
                beside = min(beside, 0.5 * (f[k + 2] - f[k + 1]))
            more[k] = coarse[k] or f[k + 1] - f[k] > 4.0 * beside
        total = n + more.sum()
        if total > _MOST_POINTS:
            return f[:0], loop[:0]
        g, h, next_ = np.empty(total), np.empty(total, np.complex128), np.zeros(total, np.bool_)
        m = 0
        for k in range(n):
            g[m], h[m] = f[k], loop[k]
            m += 1
            if k < n - 1 and more[k]:
                x = 0.5 * (f[k] + f[k + 1])
                g[m], h[m] = x, value_at(x, at)
                next_[m - 1] = next_[m] = True
                m += 1
        f, loop, fresh, n = g, h, next_, total
    return f, loop


@routine
def extremes(f: Array, loop: ComplexArray, at: At) -> Array:
    """Peaks of |L|, and near misses of 1 and of the negative real axis, as curve.refine_extremes without disks."""
    n = len(f)
    found, m = np.empty(n), 0
    value = np.empty(n)
    for kind in range(4):
        for k in range(n):
            value[k] = _objective(kind, loop[k])
        for k in range(1, n - 1):
            left, here, right = value[k - 1], value[k], value[k + 1]
            if not (here <= left and here <= right and (here < left or here < right)) or m >= n:
                continue
            if kind == 1:
                worth = here < -curve.LOWEST_PEAK
            else:
                worth = 0.0 < here < _NEAR and (kind == 0 or loop[k].real < 0.0)
            if worth:
                found[m] = least_of(kind, f[k - 1], f[k], f[k + 1], left, here, right, at)
                m += 1
    return found[:m]


@routine
def crossings(f: Array, loop: ComplexArray, at: At) -> tuple[Array, IntArray, IntArray]:
    """(frequency, kind 0: |L| = 1, 1: negative real axis, rising or turn) of each."""
    n, m = len(f), 0
    places, kinds, ways = np.empty(n), np.zeros(n, np.int64), np.zeros(n, np.int64)
    for k in range(n - 1):
        a, b = _objective(0, loop[k]), _objective(0, loop[k + 1])
        if (a >= 0.0) != (b >= 0.0) and m < n:
            places[m] = _root_of(0, f[k], f[k + 1], a, b, at)
            kinds[m], ways[m] = 0, 1 if b >= 0.0 else -1
            m += 1
    for k in range(n - 1):
        a, b = _objective(2, loop[k]), _objective(2, loop[k + 1])
        if k == n - 2 and abs(b) < curve.REAL:
            continue
        if (a >= 0.0) != (b >= 0.0) and (loop[k].real < 0.0 or loop[k + 1].real < 0.0) and m < n:
            places[m] = _root_of(2, f[k], f[k + 1], a, b, at)
            kinds[m], ways[m] = 1, 1 if a >= 0.0 else -1
            m += 1
    return places[:m], kinds[:m], ways[:m]
