"""Find the crossings of a rational loop as roots of polynomials in 200-digit arithmetic.

Sturm's chain counts the roots, so none is missed, however close two are. L = N / D follows from the state space
(float64 entries taken as exact): D = det(x - A), N = det(x - A + b c) - D + d D. With x = exp(j t), both |N|^2 - |D|^2
and Im N D* are trigonometric polynomials, sums of cos k t and sin k t, which are T_k and sin t U_(k-1) in y = cos t.
With x = j w they are polynomials in w^2, the second one times w.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from mpmath import mp, mpf

DIGITS = 200


def characteristic(a: np.ndarray) -> list[mpf]:
    """Return the coefficients of det(x - A) in rising powers, by the Hessenberg form."""
    n = len(a)
    h = mp.hessenberg(mp.matrix(a.tolist()))[1] if n > 1 else mp.matrix(a.tolist())
    ps = [[mpf(1)]]
    for k in range(1, n + 1):
        p = [mpf(0), *ps[k - 1]]
        for i, c in enumerate(ps[k - 1]):
            p[i] -= h[k - 1, k - 1] * c
        below = mpf(1)
        for m in range(1, k):
            below *= h[k - m, k - m - 1]
            for i, c in enumerate(ps[k - m - 1]):
                p[i] -= h[k - m - 1, k - 1] * below * c
        ps.append(p)
    return ps[n]


def numerator_and_denominator(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: float) -> tuple[list[mpf], list[mpf]]:
    below = characteristic(a)
    bc = mp.matrix(b.tolist()) * mp.matrix([c.tolist()])
    turned = mp.matrix(a.tolist()) - bc
    above = [p - q + mpf(d) * q for p, q in zip(characteristic(np.array(turned.tolist())), below, strict=True)]
    return above, below


def crossings(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, d: float, sample_s: float | None, highest: float = 2e4
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the frequencies (Hz) of |L| = 1 and of interior real L up to `highest` rad/s, and L at the latter."""
    with mp.workdps(DIGITS):
        n, q = numerator_and_denominator(a, b, c, d)
        if sample_s is None:
            size, phase = _along_axis(n, q)
        else:
            size, phase = _along_circle(n, q)
        if sample_s is None:
            found = [
                [mp.sqrt(r) / (2 * mp.pi) for r in real_roots(p, mpf(0), mpf(highest) ** 2)] for p in (size, phase)
            ]
        else:
            turns = [[mp.acos(r) for r in reversed(real_roots(p, mpf(-1), mpf(1)))] for p in (size, phase)]
            found = [[t / (2 * mp.pi * mpf(sample_s)) for t in each] for each in turns]
        at = []
        for f in found[1]:
            x = 2j * mp.pi * f if sample_s is None else mp.exp(2j * mp.pi * f * mpf(sample_s))
            at.append(complex(mp.polyval(n[::-1], x) / mp.polyval(q[::-1], x)).real)
        return np.array(found[0], float), np.array(found[1], float), np.array(at)


def response(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: float, sample_s: float | None, f_hz: float) -> complex:
    """Return L at one frequency, from a linear system in 60 digits."""
    with mp.workdps(60):
        x = 2j * mp.pi * mpf(f_hz) if sample_s is None else mp.exp(2j * mp.pi * mpf(f_hz) * mpf(sample_s))
        found = mp.lu_solve(mp.eye(len(a)) * x - mp.matrix(a.tolist()), mp.matrix(b.tolist()))
        return complex(mp.fsum(mpf(float(k)) * v for k, v in zip(c, found, strict=True)) + mpf(float(d)))


def real_roots(p: list[mpf], low: mpf, high: mpf) -> list[mpf]:
    """Return the roots of a polynomial (rising powers) between two points to 15 digits; double roots once."""
    while p[-1] == 0:
        p = p[:-1]
    chain = [p, [k * x for k, x in enumerate(p)][1:]]
    while len(chain[-1]) > 1:
        rest, by = list(chain[-2]), chain[-1]
        while len(rest) >= len(by):
            factor, shift = rest[-1] / by[-1], len(rest) - len(by)
            for i, x in enumerate(by[:-1]):
                rest[i + shift] -= factor * x
            rest.pop()
        largest = max(abs(x) for x in rest)
        if largest == 0:
            break
        chain.append([-x / largest for x in rest])

    def changes(x: mpf) -> int:
        values = [v for v in (mp.polyval(q[::-1], x) for q in chain) if v != 0]
        return sum((a < 0) != (b < 0) for a, b in pairwise(values))

    found, open_ = [], [(low, high, changes(low), changes(high))]
    while open_:
        a, b, at_a, at_b = open_.pop()
        if at_a == at_b:
            continue
        if b - a < mpf(10) ** -15 * max(abs(a), abs(b)):
            found.append((a + b) / 2)
            continue
        middle = (a + b) / 2
        at_middle = changes(middle) if at_a - at_b > 1 else None
        if at_middle is None:  # one root: the sign of p tells where
            right = (mp.polyval(p[::-1], a) < 0) == (mp.polyval(p[::-1], middle) < 0)
            at_middle = at_a if right else at_b
        open_ += [(a, middle, at_a, at_middle), (middle, b, at_middle, at_b)]
    return sorted(found)


def _along_circle(n: list[mpf], q: list[mpf]) -> tuple[list[mpf], list[mpf]]:
    """Return |N|^2 - |D|^2 and Im N D* / sin t as polynomials in y = cos t, in rising powers."""
    length = len(q)

    def lag(u: list[mpf], v: list[mpf], k: int) -> mpf:
        return mp.fsum(u[i + k] * v[i] for i in range(length - k))

    size = [lag(n, n, k) - lag(q, q, k) for k in range(length)]
    phase = [lag(n, q, k) - lag(q, n, k) for k in range(length)]  # of sin k t
    first, second = [[mpf(1)], [mpf(0), mpf(1)]], [[mpf(1)], [mpf(0), mpf(2)]]
    for kind in (first, second):
        for k in range(2, length):
            p = [mpf(0), *(2 * x for x in kind[k - 1])]
            for i, x in enumerate(kind[k - 2]):
                p[i] -= x
            kind.append(p)
    out = [mpf(0)] * length, [mpf(0)] * length
    for k in range(length):
        for i, x in enumerate(first[k]):
            out[0][i] += (1 if k == 0 else 2) * size[k] * x
        if k > 0:
            for i, x in enumerate(second[k - 1]):
                out[1][i] += phase[k] * x
    for p in out:  # what poles at z = 0 leave of the highest powers is rounding
        while abs(p[-1]) < mpf(10) ** (-DIGITS // 2) * max(abs(x) for x in p):
            p.pop()
    return out


def _along_axis(n: list[mpf], q: list[mpf]) -> tuple[list[mpf], list[mpf]]:
    """Return both polynomials in w^2, in rising powers."""

    def parts(p: list[mpf]) -> tuple[list[mpf], list[mpf]]:
        """Return the even part of p(j w), and the odd part divided by w, in w^2."""
        return [x * (-1) ** k for k, x in enumerate(p[::2])], [x * (-1) ** k for k, x in enumerate(p[1::2])]

    def times(u: list[mpf], v: list[mpf], shift: int = 0) -> list[mpf]:
        out = [mpf(0)] * (len(q) + 2)
        for i, x in enumerate(u):
            for j, y in enumerate(v):
                out[i + j + shift] += x * y
        return out

    (n_even, n_odd), (q_even, q_odd) = parts(n), parts(q)
    size = [
        a + b - c - d
        for a, b, c, d in zip(
            times(n_even, n_even), times(n_odd, n_odd, 1), times(q_even, q_even), times(q_odd, q_odd, 1), strict=True
        )
    ]
    phase = [a - b for a, b in zip(times(n_odd, q_even), times(n_even, q_odd), strict=True)]
    return size, phase
