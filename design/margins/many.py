"""Margins of many vehicles at one node: the curve, crossings and lobes of `measure.margins`, compiled.

The sampled response is the sum of one term for each pole of actuator, vehicle and gyro. A pole l with residue R of
the continuous path answers a command that is held over a period T and acts t late, and is averaged over that period, by

    R (z^-(m+1) / T) [ E1(T) (E1(T - t) + exp(l (T - t)) E1(t) / z) / (z - exp(l T))
                       + E2(T - t) + (E2(t) + E1(T - t) E1(t)) / z ],       E1(a) = (exp(l a) - 1) / l,
                                                                            E2(a) = (E1(a) - a) / l

for a delay of m periods and t: what sampling.py finds by matrix exponentials. Everything is a function of w = z - 1,
since slow poles differ from 1 by little. Zeros of 1 + L are all found at once, from those of the nominal vehicle
(O. Aberth, Math. Comput. 27, 1973). Grid, refinement, solvers, encirclements and lobes are those of curve.py,
solving.py and lobes.py, and take their numbers from there; disks, zones and the bounds of bounds.py are left out: two
crossings that lie closer to each other than the grid's points can be missed. Vehicles that these formulae do not serve
(repeated poles, poles on the axis, zeros that do not converge) are handed back for `measure.margins`.

This module holds all that its machine code depends on: Numba looks at one file only.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maxq.control.kernel.jit import entry, routine
from maxq.control.kernel.records import Array, IntArray
from maxq.design.model.state_space import ComplexArray

At = Any
"""What L depends on: period, terms of pairs and single poles, what passes directly, law, periods of delay."""

DONE, UNSTABLE, HANDED_BACK = 0, 1, 2
MARGINS, DELAY, MINIMA, COUNT = 7, 3, 8, 23
"""Values of a vehicle, COUNT in all. MARGINS of them: gain up (dB), gain down (dB), rigid phase (deg), delay (s), slosh
phase (deg), phase of the first mode (deg), peak of the others (dB); NaN of an unstable loop. Then, of that too, the
MINIMA lowest |1 + L| and where each is (Hz), NaN behind the last."""

_LOWEST_HZ = 1e-5
_PER_DECADE, _PER_DECADE_FLAT = 16, 6
_TURN_RAD, _FLOOR, _NARROW = 0.6, 1e-4, 1e-12
_FARTHEST, _REAL, _ASYMPTOTIC, _DRIFT_UP_TO_HZ, _ON_AXIS, _OSCILLATING = 1e9, 1e-6, 4.0, 1e-3, 1e-9, 0.5
_NEAR, _GOLDEN, _STEP = 0.7, 0.3819660112501051, 8.9e-16
_LOWEST_PEAK = -6.907755278982137
_SHARE, _VALLEY, _LEAST, _ROUNDING_DB, _LIGHT = 0.5, 0.5, 2.0, 1e-9, 0.3
_DB = 8.685889638065037
_FASTEST = 1e-6
_MOST_POINTS = 6000
_MOST_ROUNDS = 60
_TWO_PI = 6.283185307179586


@routine
def _over(x: complex) -> complex:
    """1 / x; not a number at zero, where Numba's own raises."""
    square = x.real * x.real + x.imag * x.imag
    return complex(x.real / square, -x.imag / square)


@routine
def _log_size(x: complex) -> float:
    return float(np.log(max(abs(x), 1e-300)))


@routine
def _objective(kind: int, x: complex) -> float:
    """0 ln |L|, 1 minus that, 2 sine of the phase, 3 minus that, 4 ln |1 + L|."""
    if kind == 0:
        return _log_size(x)
    if kind == 1:
        return -_log_size(x)
    if kind == 4:
        return _log_size(1.0 + x)
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
def _terms(
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
def _at(hz: float, at: At) -> complex:
    """L at a frequency."""
    sample_s, pairs, singles, direct, zeros, poles, gain, periods = at
    half = 0.5 * _TWO_PI * hz * sample_s
    sine = np.sin(half)
    w = complex(-2.0 * sine * sine, 2.0 * sine * np.cos(half))
    late = _over(1.0 + w)
    total = direct[0] + direct[1] * late
    for i in range(len(pairs)):
        p = pairs[i]
        total += (p[0] * w + p[1] + (p[2] * w + p[3]) * late) * _over((w + p[4]) * w + p[5])
    for i in range(len(singles)):
        total += (singles[i, 0] + singles[i, 1] * late) * _over(w - singles[i, 2])
    top, below = gain + 0j, 1.0 + 0j
    for i in range(len(zeros)):
        top = top * (w - zeros[i])
    for i in range(len(poles)):
        below = below * (w - poles[i])
    for _ in range(periods):
        top = top * late
    return complex(total * top * _over(below))


@routine
def _newton(
    w: complex, mu: ComplexArray, alpha: ComplexArray, beta: ComplexArray, every: ComplexArray, at: At
) -> complex:
    """Derivative over value, by w, of (1 + L) times the factors of `every` pole."""
    _, _, _, direct, zeros, poles, gain, periods = at
    late = _over(1.0 + w)
    total, slope = direct[0] + direct[1] * late, -direct[1] * late * late
    for i in range(len(mu)):
        near = _over(w - mu[i])
        value = (alpha[i] + beta[i] * late) * near
        total += value
        slope -= value * near + beta[i] * late * late * near
    top, by = gain * total + 0j, slope * _over(total)
    for i in range(len(zeros)):
        top = top * (w - zeros[i])
        by += _over(w - zeros[i])
    for i in range(len(poles)):
        near = _over(w - poles[i])
        top = top * near
        by -= near
    for _ in range(periods):
        top = top * late
        by -= late
    out = by * _over(1.0 + _over(top))
    for i in range(len(every)):
        out += _over(w - every[i])
    return complex(out)


@routine
def _zeros_of_one_plus(
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
                    by -= _over(roots[i] - roots[k])
            move = _over(by)
            if not (np.isfinite(move.real) and np.isfinite(move.imag)):
                roots[i] += complex(1e-9, 1e-9) * (abs(roots[i]) + 1e-6)
                left += 1
                continue
            roots[i] -= move
            if abs(move) < 1e-9 * abs(roots[i]) + 1e-14 or abs(1.0 + roots[i]) < 0.1 * _FASTEST:
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
def _wrapped(angle: float) -> float:
    return float((angle + 0.5 * _TWO_PI) % _TWO_PI - 0.5 * _TWO_PI)


@routine
def _angle(x: complex) -> float:
    return float(np.arctan2(x.imag, x.real))


@routine
def _turned(a: complex, b: complex) -> float:
    return abs(_angle(a * b.conjugate()))


@routine
def _least_of(kind: int, a: float, c: float, b: float, fa: float, fc: float, fb: float, at: At) -> float:
    """The lowest point of an objective within a bracket, as solving.minima."""
    wide = b - a
    for step in range(100):
        left, right = (fa - fc) / (c - a), (fb - fc) / (b - c)
        curvature = (left + right) / (b - a)
        slope = (right * (c - a) - left * (b - c)) / (b - a)
        x, promised = c - slope / (2.0 * curvature), slope * slope / (4.0 * curvature)
        to_right = b - c > c - a
        golden = c + _GOLDEN * (b - c if to_right else a - c)
        stalled = False
        if step % 3 == 2:
            stalled = b - a > 0.5 * wide
            wide = b - a
        nudge = max(1e-6 * (b - a), _STEP * abs(c))
        if not np.isfinite(x):
            x = golden
        if abs(x - c) < nudge:
            x = c + (nudge if to_right else -nudge)
        if stalled:
            x = golden
        f = _objective(kind, _at(x, at))
        beyond, better = x > c, f <= fc
        x_end, f_end = (c, fc) if better else (x, f)
        if beyond == better:
            a, fa = x_end, f_end
        else:
            b, fb = x_end, f_end
        if better:
            c, fc = x, f
        if (not promised >= 1e-12 and step >= 3) or b - a < 8.0 * _STEP * abs(c):
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
        f = _objective(kind, _at(x, at))
        if (f > 0.0) == (f1 > 0.0):
            x3, f3 = x1, f1
        else:
            x3, f3, x2, f2 = x2, f2, x1, f1
        x1, f1 = x, f
        best = x1 if abs(f1) < abs(f2) else x2
        width = abs(x2 - x1)
        shortest = _STEP * abs(x1) / width if width > 0.0 else 1.0
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
def _merged(f: Array, loop: ComplexArray, n: int, new: Array, at: At) -> tuple[Array, ComplexArray, int]:
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
            g[m], h[m] = x, _at(x, at)
        m += 1
    return g[:m], h[:m], m


@routine
def _grid(open_: ComplexArray, closed: ComplexArray, lowest: float, end: float) -> Array:
    """As curve._grid; without number of points where a pole lies on the axis."""
    out = np.empty(200 + 60 * (len(open_) + len(closed)))
    slow, fast = np.inf, 0.0
    n = 0
    for which in range(2):
        group = open_ if which == 0 else closed
        for p in group:
            size = abs(p)
            if p.imag < 0.0 or size <= _TWO_PI * lowest:
                continue
            slow, fast = min(slow, size / _TWO_PI), max(fast, size / _TWO_PI)
            if p.imag > 0.0 and abs(p.real) < _OSCILLATING * size:
                width = abs(p.real)
                if width <= _ON_AXIS * size:
                    return out[:0]
                step = 1.0 / (1.0 + np.sqrt(2.0))
                out[n] = p.imag / _TWO_PI
                n += 1
                for _ in range(25):
                    if step * width >= 0.7 * p.imag:
                        break
                    out[n], out[n + 1] = (p.imag - step * width) / _TWO_PI, (p.imag + step * width) / _TWO_PI
                    n += 2
                    step *= 1.0 + np.sqrt(2.0)
    slow = min(max(0.3 * slow, 2.0 * lowest), 0.5 * end)
    fast = min(max(3.0 * fast, 2.0 * lowest), 0.5 * end)
    n = _decades(lowest, slow, _PER_DECADE_FLAT, out, n)
    n = _decades(slow, fast, _PER_DECADE, out, n)
    n = _decades(fast, end, _PER_DECADE_FLAT, out, n)
    out[n], out[n + 1], out[n + 2] = lowest, end, end * (1.0 - 1e-6)
    f = np.sort(out[: n + 3])
    m = 0
    for x in f:
        if lowest <= x <= end and (m == 0 or x - f[m - 1] > _NARROW * x):
            f[m] = x
            m += 1
    return f[:m]


@routine
def _refined(f: Array, loop: ComplexArray, at: At) -> tuple[Array, ComplexArray]:
    """As curve._refine."""
    n = len(f)
    fresh = np.ones(n, np.bool_)
    for _ in range(40):
        coarse, any_ = np.zeros(n, np.bool_), False
        for k in range(n - 1):
            if not fresh[k] or f[k + 1] - f[k] <= 1e3 * _NARROW * f[k + 1]:
                continue
            a, b = loop[k], loop[k + 1]
            if (_turned(b, a) > _TURN_RAD and max(abs(a), abs(b)) > _FLOOR) or _turned(1.0 + b, 1.0 + a) > _TURN_RAD:
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
                g[m], h[m] = x, _at(x, at)
                next_[m - 1] = next_[m] = True
                m += 1
        f, loop, fresh, n = g, h, next_, total
    return f, loop


@routine
def _extremes(f: Array, loop: ComplexArray, at: At) -> Array:
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
                worth = here < -_LOWEST_PEAK
            else:
                worth = 0.0 < here < _NEAR and (kind == 0 or loop[k].real < 0.0)
            if worth:
                found[m] = _least_of(kind, f[k - 1], f[k], f[k + 1], left, here, right, at)
                m += 1
    return found[:m]


@routine
def _nearest(f: Array, loop: ComplexArray, at: At, out: Array) -> None:
    """The lowest minima of |1 + L| and their frequencies, behind the margins."""
    n = len(f)
    value = np.abs(1.0 + loop)
    low = np.ones(n, np.bool_)
    for k in range(n):
        low[k] = (k == 0 or value[k] <= value[k - 1]) and (k == n - 1 or value[k] < value[k + 1])
    for place in range(MINIMA):
        best = -1
        for k in range(n):
            if low[k] and (best < 0 or value[k] < value[best]):
                best = k
        if best < 0:
            break
        hz = f[best]
        if 0 < best < n - 1 and value[best] < 2.0 * value.min():
            a, c, b = np.log(value[best - 1]), np.log(value[best]), np.log(value[best + 1])
            hz = _least_of(4, f[best - 1], f[best], f[best + 1], a, c, b, at)
        out[MARGINS + place], out[MARGINS + MINIMA + place] = abs(1.0 + _at(hz, at)), hz
        low[best] = False


@routine
def _crossings(f: Array, loop: ComplexArray, at: At) -> tuple[Array, IntArray, IntArray]:
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
        if k == n - 2 and abs(b) < _REAL:
            continue
        if (a >= 0.0) != (b >= 0.0) and (loop[k].real < 0.0 or loop[k + 1].real < 0.0) and m < n:
            places[m] = _root_of(2, f[k], f[k + 1], a, b, at)
            kinds[m], ways[m] = 1, 1 if a >= 0.0 else -1
            m += 1
    return places[:m], kinds[:m], ways[:m]


@routine
def _one(
    poles: ComplexArray, residues: ComplexArray, owner: IntArray, sample_s: float, whole: int, rest_s: float, zeros:
    ComplexArray, law_poles: ComplexArray, gain: float, law_hz: ComplexArray, integrates: bool, start: ComplexArray,
    out: Array, peak_db: float,
) -> int:  # fmt: skip  # one line for each otherwise
    """Margins of one vehicle into `out`; DONE, UNSTABLE or HANDED_BACK."""
    n = len(poles)
    mu, alpha, beta = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n, np.complex128)
    direct = np.zeros(2)
    _terms(poles, residues, sample_s, rest_s, mu, alpha, beta, direct)
    periods = whole + 1
    swings = 0
    for i in range(n):
        swings += 1 if poles[i].imag > 0.0 else 0
    pairs, singles = np.empty((swings, 6)), np.empty((n - 2 * swings, 3))
    a = b = 0
    for i in range(n):
        if poles[i].imag > 0.0:
            pairs[a, 0], pairs[a, 1] = 2.0 * alpha[i].real, -2.0 * (alpha[i] * mu[i].conjugate()).real
            pairs[a, 2], pairs[a, 3] = 2.0 * beta[i].real, -2.0 * (beta[i] * mu[i].conjugate()).real
            pairs[a, 4], pairs[a, 5] = -2.0 * mu[i].real, mu[i].real ** 2 + mu[i].imag ** 2
            a += 1
        elif poles[i].imag == 0.0:
            singles[b, 0], singles[b, 1], singles[b, 2] = alpha[i].real, beta[i].real, mu[i].real
            b += 1
    gain = gain / sample_s
    at = (sample_s, pairs, singles, direct, zeros, law_poles, gain, periods)

    # poles of 1 + L times its denominator: those of the path, of the law, and of the delay
    late = periods + (1 if rest_s > 0.0 else 0)
    every, m = np.empty(n + len(law_poles) + late, np.complex128), n
    every[:n] = mu
    cancelled = integrates  # a path that rests has a zero where the first integrator has its pole
    for p in law_poles:
        if abs(p) > 1e-9 or cancelled:
            every[m] = p
            m += 1
        else:
            cancelled = True
    for _ in range(late):
        every[m] = -1.0
        m += 1
    if m != len(start):
        return HANDED_BACK
    roots = start.copy()
    if not _zeros_of_one_plus(roots, mu, alpha, beta, every[:m], at):
        return HANDED_BACK
    closed, m = np.empty(len(roots), np.complex128), 0
    for w in roots:
        if abs(1.0 + w) > _FASTEST:
            closed[m] = (
                np.log(1.0 + w) / sample_s
                if abs(w) > 0.1
                else complex(
                    0.5 * np.log1p(2.0 * w.real + w.real * w.real + w.imag * w.imag), np.arctan2(w.imag, 1.0 + w.real)
                )
                / sample_s
            )
            if abs(closed[m].imag) < 1e-7 * abs(closed[m]):
                closed[m] = complex(closed[m].real, 0.0)
            m += 1
    closed = closed[:m]
    fold = _TWO_PI / sample_s
    open_ = np.empty(n + len(law_hz), np.complex128)
    for i in range(n):
        open_[i] = complex(poles[i].real, poles[i].imag - fold * np.round(poles[i].imag / fold))
    open_[n:] = law_hz

    # where the curve begins
    low = _LOWEST_HZ
    for size in np.sort(np.abs(open_)) / _TWO_PI:
        if low / _ASYMPTOTIC < size < _ASYMPTOTIC * low:
            low = _ASYMPTOTIC * size
    if low > _DRIFT_UP_TO_HZ:
        low = _LOWEST_HZ
    end = 0.5 / sample_s
    growing = 0
    for p in closed:
        if abs(p) > _TWO_PI * low and p.real >= -_ON_AXIS * abs(p):
            growing += 1
    first = _at(low, at)
    second = _at(2.0 * low, at)
    slope_at_zero = int(np.round(np.log2(abs(second) / abs(first))))
    at_zero = (4.0 * first.real - second.real) / 3.0

    f = _grid(open_, closed, low, end)
    if len(f) == 0:
        return HANDED_BACK
    loop = np.empty(len(f), np.complex128)
    for k in range(len(f)):
        loop[k] = _at(f[k], at)
        if not (np.isfinite(loop[k].real) and np.isfinite(loop[k].imag)):
            return HANDED_BACK
    f, loop = _refined(f, loop, at)
    if len(f) == 0:
        return HANDED_BACK
    f, loop, m = _merged(f, loop, len(f), _extremes(f, loop, at), at)
    places, kinds, ways = _crossings(f, loop, at)
    values = np.empty(len(places), np.complex128)
    for k in range(len(places)):
        values[k] = _at(places[k], at)
    f, loop, m = _merged(f, loop, m, places, at)

    _nearest(f, loop, at, out)

    # encirclements
    right = 0
    for p in open_:
        right += 1 if abs(p) > _TWO_PI * low and p.real > _ON_AXIS * abs(p) else 0
    branches = 0
    for k in range(len(places)):
        if kinds[k] == 1 and values[k].real < 0.0 and 1.0 < abs(values[k]) < _FARTHEST:
            branches += ways[k]
    start_loop = loop[0]
    order = -slope_at_zero if abs(start_loop) > 1.0 else 0
    if order == 0:
        begin = 0.0 if (1.0 + start_loop).real >= 0.0 else 0.5 * _TWO_PI
        turn = _wrapped(_angle(1.0 + start_loop) - begin)
    else:
        unit = 1.0 + 0j
        for _ in range(abs(order)):
            unit = unit * (1j if order > 0 else -1j)
        begin = 0.0 if (start_loop * unit).real >= 0.0 else 0.5 * _TWO_PI
        arrived = begin - order * 0.25 * _TWO_PI
        turn = arrived - begin + _wrapped(_angle(1.0 + start_loop) - arrived)
    turn += _angle(1.0 + loop[m - 2]) - _angle(1.0 + loop[0]) + _TWO_PI * branches
    ended = 0.0 if (1.0 + loop[m - 1]).real >= 0.0 else 0.5 * _TWO_PI
    turn += _wrapped(ended - _angle(1.0 + loop[m - 2]))
    encircled = int(np.round(right - turn / (0.5 * _TWO_PI)))
    if growing > 0 or encircled != 0:
        return UNSTABLE if growing > 0 and encircled > 0 else HANDED_BACK
    return _judged(f, loop, places, kinds, values, poles, owner, slope_at_zero, at_zero, at, out, peak_db)


@routine
def _judged(
    f: Array, loop: ComplexArray, places: Array, kinds: IntArray, values: ComplexArray, poles: ComplexArray, owner:
    IntArray, slope_at_zero: int, at_zero: float, at: At, out: Array, peak_db: float,
) -> int:  # fmt: skip  # one line for each otherwise
    """Gain, phase and delay margins, and lobes, as measure.margins and lobes.find_lobes."""
    m, end = len(f), f[-1]
    up = down = phase = delay = np.inf
    for k in range(len(places)):
        if kinds[k] == 1 and values[k].real < 0.0 and 1.0 / _FARTHEST < abs(values[k]) < _FARTHEST:
            db = -_DB * _log_size(values[k])
            if db >= 0.0:
                up = min(up, db)
            else:
                down = min(down, -db)
        elif kinds[k] == 0:
            lag = np.degrees(_angle(-values[k])) % 360.0
            delay = min(delay, lag / (360.0 * places[k]))
    if slope_at_zero == 0 and at_zero < 0.0 and abs(loop[0].imag) < 0.1 * abs(loop[0]):
        db = -_DB * np.log(abs(at_zero))
        up, down = (min(up, db), down) if db >= 0.0 else (up, min(down, -db))
    last = loop[m - 1]
    if last.real < 0.0 and abs(last.imag) < _REAL * abs(last):
        db = -_DB * np.log(abs(last.real))
        up, down = (min(up, db), down) if db >= 0.0 else (up, min(down, -db))

    # lobes, in rising order of frequency
    centre, width, whose = np.empty(len(poles)), np.empty(len(poles)), np.zeros(len(poles), np.int64)
    n, fold = 0, 1.0 / at[0]
    for i in range(len(poles)):
        p = poles[i]
        if owner[i] == 0 or p.imag <= 0.0 or -p.real >= _LIGHT * abs(p):
            continue
        hz = abs(p.imag / _TWO_PI - np.round(p.imag / _TWO_PI / fold) * fold)
        if f[0] < hz < f[m - 1]:
            centre[n], width[n], whose[n] = hz, max(abs(p.real) / _TWO_PI, 1e-9 * hz), owner[i]
            n += 1
    strength = np.empty(n, np.complex128)
    for j in range(n):
        total = 0j
        for part in range(3):
            hz = centre[j] + (0.0 if part == 0 else width[j] if part == 1 else -width[j])
            mirrored = hz > end
            x = max(2.0 * end - hz if mirrored else hz, f[0])
            value = _at(x, at)
            value = value.conjugate() if mirrored else value
            total += 2.0 * value if part == 0 else -value
        strength[j] = total
    slosh_deg = first_deg = np.inf
    higher_db = -np.inf
    in_bending = np.zeros(len(places), np.bool_)
    for j in range(n):
        nearest = 0
        for k in range(m):
            if abs(f[k] - centre[j]) < abs(f[nearest] - centre[j]):
                nearest = k
        deep = _VALLEY * abs(loop[nearest])
        low = high = centre[j]
        if _in_lobe(f[nearest], loop[nearest], strength, centre, width, j) and not _valley(loop, nearest, deep):
            low = _end_of_lobe(f, loop, strength, centre, width, j, nearest, deep, -1, at)
            high = _end_of_lobe(f, loop, strength, centre, width, j, nearest, deep, 1, at)
        low = max(min(low, centre[j] - _LEAST * width[j]), f[0])
        high = min(max(high, centre[j] + _LEAST * width[j]), f[m - 1])
        low_loop = _at(low, at)
        high_loop = _at(high, at)
        begin = np.searchsorted(f, low)
        stop = np.searchsorted(f, high, side="right")
        greatest, top = 0.0, begin
        for k in range(begin, stop):
            if abs(loop[k]) > greatest:
                greatest, top = abs(loop[k]), k
        at_end = max(abs(low_loop), abs(high_loop))
        if at_end >= greatest or f[top] == low or f[top] == high:
            greatest = max(greatest, at_end)
            top = begin
            for k in range(begin, stop):
                if abs(f[k] - centre[j]) < abs(f[top] - centre[j]):
                    top = k
        level = _DB * np.log(max(greatest, 1e-300))
        shown = _DB * _log_size(loop[top])
        lag = lead = np.inf
        if level > _ROUNDING_DB:
            crossed = False
            for k in range(len(places)):
                if kinds[k] == 0 and low <= places[k] <= high:
                    turn = np.degrees(_angle(-values[k])) % 360.0
                    lag, lead, crossed = min(lag, turn), min(lead, 360.0 - turn), True
            if not crossed:
                least = most = begin
                for k in range(begin - 1, stop + 1):
                    value = low_loop if k < begin else high_loop if k == stop else loop[k]
                    if abs(value) >= min(1.0, greatest):
                        turn = np.degrees(_angle(-value)) % 360.0
                        if turn < lag:
                            lag, least = turn, k
                        if 360.0 - turn < lead:
                            lead, most = 360.0 - turn, k
                lag = min(lag, _least_turn(f, low, high, least, begin, stop, 1.0, lag, at))
                lead = min(lead, _least_turn(f, low, high, most, begin, stop, -1.0, lead, at))
        if whose[j] < 0:
            if shown > peak_db:
                slosh_deg = min(slosh_deg, lag, lead)
            continue
        for k in range(len(places)):
            in_bending[k] = in_bending[k] or low <= places[k] <= high
        if whose[j] == 1:
            if shown > 0.0:
                first_deg = min(first_deg, lag, lead)
        else:
            higher_db = max(higher_db, shown)
    for k in range(len(places)):
        if kinds[k] == 0 and not in_bending[k]:
            phase = min(phase, abs(np.degrees(_angle(-values[k]))))
    out[0], out[1], out[2], out[3] = up, down, phase, delay
    out[4], out[5], out[6] = slosh_deg, first_deg, higher_db
    return DONE


@routine
def _least_turn(
    f: Array, low: float, high: float, k: int, begin: int, stop: int, way: float, found: float, at: At
) -> float:
    """Least lag (`way` 1) or lead (-1) beside point number k of those from `begin` to `stop`, deg."""
    a = low if k - 1 < begin else f[k - 1]
    b = high if k + 1 >= stop else f[k + 1]
    for _ in range(6):
        place = 0
        step = (b - a) / 16.0
        for i in range(1, 16):
            value = _at(a + i * step, at)
            turn = np.degrees(_angle(-value)) % 360.0
            turn = turn if way > 0.0 else 360.0 - turn
            if abs(value) >= 1.0 and turn <= found:
                found, place = turn, i
        if place == 0:
            break
        a, b = a + (place - 1) * step, a + (place + 1) * step
    return found


@routine
def _valley(loop: ComplexArray, k: int, deep: float) -> bool:
    """A deep minimum of |L| among the points of the curve."""
    here, n = abs(loop[k]), len(loop)
    return here < deep and (k == 0 or here <= abs(loop[k - 1])) and (k == n - 1 or here <= abs(loop[k + 1]))


@routine
def _in_lobe(hz: float, value: complex, strength: ComplexArray, centre: Array, width: Array, j: int) -> bool:
    """Whether a point belongs to a lobe: its term is large against the rest, and the largest of all."""
    term = strength[j] * _over(complex(1.0, (hz - centre[j]) / width[j]))
    size = abs(term)
    if size <= _SHARE * abs(value - term):
        return False
    for other in range(len(strength)):
        if abs(strength[other] * _over(complex(1.0, (hz - centre[other]) / width[other]))) > size:
            return False
    return True


@routine
def _end_of_lobe(
    f: Array, loop: ComplexArray, strength: ComplexArray, centre: Array, width: Array, j: int, k: int, deep: float,
    way: int, at: At,
) -> float:  # fmt: skip  # one line for each otherwise
    """Where the run of points about number k ends, up or down, as lobes._solved_ends."""
    last = len(f) - 1 if way > 0 else 0
    while True:
        if k == last:
            return float(f[k])
        k += way
        if _valley(loop, k, deep):
            if k in (0, len(f) - 1):
                return float(f[k])
            a, c, b = _log_size(loop[k - 1]), _log_size(loop[k]), _log_size(loop[k + 1])
            return _least_of(0, f[k - 1], f[k], f[k + 1], a, c, b, at)
        if not _in_lobe(f[k], loop[k], strength, centre, width, j):
            break
    outer, inner = f[k], f[k - way]
    for _ in range(22):
        x = 0.5 * (outer + inner)
        value = _at(x, at)
        if _in_lobe(x, value, strength, centre, width, j):
            inner = x
        else:
            outer = x
    return float(inner)


@entry
def measure_many(
    poles: ComplexArray, residues: ComplexArray, owner: IntArray, sample_s: float, whole: IntArray, rest_s: Array,
    zeros: ComplexArray, law_poles: ComplexArray, gain: float, law_radps: ComplexArray, integrates: bool, start:
    ComplexArray, peak_db: float, values: Array, status: IntArray,
) -> None:  # fmt: skip  # one line for each otherwise
    """Margins of vehicles into `values` (vehicles, COUNT), `status` (vehicles,): DONE, UNSTABLE or HANDED_BACK.

    `poles` (vehicles, n) of the continuous path, rad/s, both of each pair, and its residues; `owner` of each: +k mode
    k, -k tank k, 0 nothing. Delay of each: `whole` periods and `rest_s`. The law from mean rate to command: `zeros`,
    `law_poles` in w = z - 1, `gain`, and its poles besides integrators, rad/s. `integrates`: no zero of the path takes
    the integrator's pole away. `start`: zeros of 1 + L of a vehicle like these, in w. `status` may come as HANDED_BACK:
    such a vehicle is left out.
    """
    for v in range(len(poles)):
        if status[v] != HANDED_BACK:
            status[v] = _one(
                poles[v], residues[v], owner[v], sample_s, whole[v], rest_s[v], zeros, law_poles, gain, law_radps,
                integrates, start, values[v], peak_db,
            )  # fmt: skip  # sixteen lines otherwise
