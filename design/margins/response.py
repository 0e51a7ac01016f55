"""The response L of one loop for compiled code: from poles and residues, or from a Python callback.

With other loops closed, the same numbers describe each element of the matrix of all loops (`axes`).

The sampled response is the sum of one term for each pole of actuator, vehicle and gyro. Consider a pole l with residue
R of the continuous path. The command is held over a period T and takes effect after m periods and t, and the output is
averaged over a period. The term of the pole is then

    R (z^-(m+1) / T) [ E1(T) (E1(T - t) + exp(l (T - t)) E1(t) / z) / (z - exp(l T))
                       + E2(T - t) + (E2(t) + E1(T - t) E1(t)) / z ],       E1(a) = (exp(l a) - 1) / l,
                                                                            E2(a) = (E1(a) - a) / l

which sampling.py computes from matrix exponentials. All terms are functions of w = z - 1, since z of a slow pole
differs little from 1. Aberth's method finds all zeros of 1 + L simultaneously, starting from those of a similar loop
(O. Aberth, Math. Comput. 27, 1973). A C callback evaluates any other loop (`loop.OpenLoop`).
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from maxq.control.kernel.jit import routine
from maxq.control.kernel.records import Array
from maxq.design.loop.loop import OpenLoop
from maxq.design.model.state_space import ComplexArray

FASTEST = 1e-6  # poles with |z| below this value are those of pure delays
TWO_PI = 6.283185307179586
_MOST_ROUNDS = 60


class LoopResponse(NamedTuple):
    """The data from which compiled functions compute the open loop L.

    `ask` is the address of the callback and `token` its argument. An address of 0 means that there is no callback.

    If `axes` is above 1, the loop is the first of several, and the others are closed. `pairs`, `singles` and `direct`
    then contain all elements of the matrix, row by row, and `zeros` and `poles` the law of each row. The rows have
    equal numbers of them and the same `gain`.
    """

    sample_s: float
    pairs: Array  # (pairs, 6): two numerators of degree 1 in w (the second acts a period later), and the denominator
    singles: Array  # (poles, 3): two residues and the pole, in w
    direct: Array  # (2,)
    zeros: ComplexArray  # zeros of the law, in w
    poles: ComplexArray
    gain: float
    periods: int  # whole periods of delay
    ask: int
    token: int
    axes: int = 1


class _Asked:
    """A loop that compiled code evaluates through the callback, with the first exception that the loop raised."""

    def __init__(self, loop: OpenLoop) -> None:
        self.loop, self.problem = loop, None  # type: tuple[OpenLoop, BaseException | None]

    def answer(self, frequency_hz: Array) -> ComplexArray:
        """Return L at frequencies in Hz, or NaN after an exception. `asking` raises the exception again."""
        if self.problem is None:
            try:
                return sampled(self.loop, frequency_hz)
            except BaseException as problem:  # exceptions cannot pass through compiled code
                self.problem = problem
        return np.full(len(frequency_hz), complex(np.nan, np.nan))


_ASKED: dict[int, _Asked] = {}
_TOKENS = itertools.count(1)


def _answer(token: int, count: int, frequency_hz: int, out: int) -> None:
    f = np.ctypeslib.as_array((ctypes.c_double * count).from_address(frequency_hz))
    values = np.ctypeslib.as_array((ctypes.c_double * (2 * count)).from_address(out)).view(np.complex128)
    values[:] = _ASKED[token].answer(f.copy())


_ANSWER = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * 4)(_answer)
_ADDRESS = ctypes.cast(_ANSWER, ctypes.c_void_p).value or 0


@contextmanager
def asking(loop: OpenLoop) -> Iterator[LoopResponse]:
    """Provide the response of any loop to compiled code for the duration of the context.

    Raises the exception that the loop raised, and ValueError for a response that is not finite or has the wrong shape.
    """
    token, asked = next(_TOKENS), _Asked(loop)
    _ASKED[token] = asked
    none, nothing = np.zeros((0, 6)), np.zeros(0, np.complex128)
    try:
        yield LoopResponse(0.0, none, none[:, :3].copy(), np.zeros(2), nothing, nothing, 0.0, 0, _ADDRESS, token, 1)
    finally:
        del _ASKED[token]
        if asked.problem is not None:
            raise asked.problem


def sampled(loop: OpenLoop, frequency_hz: Array) -> ComplexArray:
    """Return L at frequencies in Hz. Raises ValueError if a value is not finite or the shape is wrong."""
    values = np.asarray(loop.response(frequency_hz), np.complex128)
    if values.shape != frequency_hz.shape:
        raise ValueError(f"the loop's response has shape {values.shape}, not {frequency_hz.shape}")
    good = np.isfinite(values)
    if not good.all():
        k = int(np.argmin(good))
        raise ValueError(f"the loop's response at {frequency_hz[k]:.9g} Hz is {values[k]}")
    return values


@intrinsic  # type: ignore[untyped-decorator]  # Numba has no types
def _call(context: Any, address: Any, token: Any, count: Any, frequency_hz: Any, out: Any) -> Any:
    """Call the C function at an address (Numba intrinsic)."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.FunctionType(ir.VoidType(), [ir.IntType(64)] * 4).as_pointer())
        builder.call(pointer, arguments[1:])
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), build


def _ask(address: int, token: int, frequency_hz: Array, out: ComplexArray) -> None:
    out[:] = _ASKED[token].answer(frequency_hz)


@overload(_ask)
def _ask_compiled(address, token, frequency_hz, out):  # type: ignore[no-untyped-def]  # Numba compares both signatures
    def asked(address, token, frequency_hz, out):  # type: ignore[no-untyped-def]  # as above
        _call(address, token, len(frequency_hz), frequency_hz.ctypes.data, out.ctypes.data)

    return asked


@routine
def values_at(f: Array, loop: LoopResponse) -> ComplexArray:
    """Return L at frequencies `f` in Hz."""
    out = np.empty(len(f), np.complex128)
    if loop.ask != 0:
        if len(f) > 0:
            _ask(loop.ask, loop.token, f, out)
    elif loop.axes > 1:
        _close_others(matrix_at(f, loop), out)
    else:
        _sum_terms(f, loop, out)
    return out


@routine
def matrix_at(f: Array, loop: LoopResponse) -> ComplexArray:
    """Return the matrix of all loops at frequencies `f` in Hz, (axes, axes, frequencies)."""
    m = loop.axes
    pairs, singles = len(loop.pairs) // (m * m), len(loop.singles) // (m * m)
    law, law_poles = len(loop.zeros) // m, len(loop.poles) // m
    out = np.empty((m, m, len(f)), np.complex128)
    for k in range(m * m):
        i = k // m
        one = LoopResponse(
            loop.sample_s,
            loop.pairs[k * pairs : (k + 1) * pairs],
            loop.singles[k * singles : (k + 1) * singles],
            loop.direct[2 * k : 2 * k + 2],
            loop.zeros[i * law : (i + 1) * law],
            loop.poles[i * law_poles : (i + 1) * law_poles],
            loop.gain,
            loop.periods,
            0,
            0,
            1,
        )
        _sum_terms(f, one, out[i, k % m])
    return out


@routine
def _close_others(whole: ComplexArray, out: ComplexArray) -> None:
    """Compute the first loop with the others closed, L_11 - L_1o (1 + L_oo)^-1 L_o1, into `out`.

    `whole` has the shape (axes, axes, frequencies), with two or three axes.
    """
    for k in range(len(out)):
        a = 1.0 + whole[1, 1, k]
        if len(whole) == 2:
            out[k] = whole[0, 0, k] - whole[0, 1, k] * whole[1, 0, k] * reciprocal(a)
            continue
        b, c, d = whole[1, 2, k], whole[2, 1, k], 1.0 + whole[2, 2, k]
        first = d * whole[1, 0, k] - b * whole[2, 0, k]
        second = a * whole[2, 0, k] - c * whole[1, 0, k]
        around = whole[0, 1, k] * first + whole[0, 2, k] * second
        out[k] = whole[0, 0, k] - around * reciprocal(a * d - b * c)


@routine
def reciprocal(x: complex) -> complex:
    """Return 1 / x, or NaN at zero, for which Numba's division raises."""
    square = x.real * x.real + x.imag * x.imag
    return complex(x.real / square, -x.imag / square)


@routine
def _e1(x: complex, a: float) -> complex:
    """Return a (exp(x) - 1) / x."""
    if abs(x) > 0.5:
        return complex(a * (np.exp(x) - 1.0) / x)
    total, term = 1.0 + 0j, 1.0 + 0j
    for k in range(2, 18):
        term = term * x / k
        total += term
    return a * total


@routine
def _e2(x: complex, a: float) -> complex:
    """Return a^2 (exp(x) - 1 - x) / x^2."""
    if abs(x) > 0.5:
        return complex(a * a * (np.exp(x) - 1.0 - x) / (x * x))
    total, term = 0.5 + 0j, 0.5 + 0j
    for k in range(3, 19):
        term = term * x / k
        total += term
    return a * a * total


@routine
def terms(
    poles: ComplexArray,
    residues: ComplexArray,
    sample_s: float,
    rest_s: float,
    mu: ComplexArray,
    alpha: ComplexArray,
    beta: ComplexArray,
    direct: Array,
) -> None:
    """Compute w of each pole (`mu`), its two residues in z (`alpha`, `beta`), and the `direct` part.

    The results are written into the last four arguments.
    """
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
def by_pairs(poles: ComplexArray, mu: ComplexArray, alpha: ComplexArray, beta: ComplexArray) -> tuple[Array, Array]:
    """Return the terms of conjugate pairs and of real poles, as the fields of `LoopResponse`."""
    n, swings = len(poles), 0
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
    return pairs, singles


@routine
def _sum_terms(f: Array, loop: LoopResponse, out: ComplexArray) -> None:
    """Compute L at the frequencies `f` (Hz) from its partial fractions, into `out`.

    Each term is added at all frequencies in real arithmetic, so that the compiler vectorises the loops.
    """
    n = len(f)
    real, imag, late_re, late_im, re, im = np.empty((6, n))
    direct_0, direct_1 = loop.direct[0], loop.direct[1]
    for k in range(n):
        half = 0.5 * TWO_PI * f[k] * loop.sample_s
        sine, cosine = np.sin(half), np.cos(half)
        real[k], imag[k] = -2.0 * sine * sine, 2.0 * sine * cosine
        # 1 / z
        late_re[k], late_im[k] = cosine * cosine - sine * sine, -2.0 * sine * cosine
        re[k], im[k] = direct_0 + direct_1 * late_re[k], direct_1 * late_im[k]
    for i in range(len(loop.pairs)):
        p = loop.pairs[i]
        b0, a0, b1, a1, c1, c0 = p[0], p[1], p[2], p[3], p[4], p[5]
        for k in range(n):
            x, y = real[k], imag[k]
            u, v = b1 * x + a1, b1 * y
            top_re = b0 * x + a0 + u * late_re[k] - v * late_im[k]
            top_im = b0 * y + u * late_im[k] + v * late_re[k]
            below_re, below_im = (x + c1) * x - y * y + c0, (x + c1) * y + y * x
            share = 1.0 / (below_re * below_re + below_im * below_im)
            re[k] += (top_re * below_re + top_im * below_im) * share
            im[k] += (top_im * below_re - top_re * below_im) * share
    for i in range(len(loop.singles)):
        b0, b1, root = loop.singles[i, 0], loop.singles[i, 1], loop.singles[i, 2]
        for k in range(n):
            top_re, top_im, x, y = b0 + b1 * late_re[k], b1 * late_im[k], real[k] - root, imag[k]
            share = 1.0 / (x * x + y * y)
            re[k] += (top_re * x + top_im * y) * share
            im[k] += (top_im * x - top_re * y) * share
    for i in range(len(loop.zeros)):
        root_re, root_im = loop.zeros[i].real, loop.zeros[i].imag
        for k in range(n):
            x, y = real[k] - root_re, imag[k] - root_im
            re[k], im[k] = re[k] * x - im[k] * y, re[k] * y + im[k] * x
    for i in range(len(loop.poles)):
        root_re, root_im = loop.poles[i].real, loop.poles[i].imag
        for k in range(n):
            x, y = real[k] - root_re, imag[k] - root_im
            share = 1.0 / (x * x + y * y)
            re[k], im[k] = (re[k] * x + im[k] * y) * share, (im[k] * x - re[k] * y) * share
    for _ in range(loop.periods):
        for k in range(n):
            re[k], im[k] = re[k] * late_re[k] - im[k] * late_im[k], re[k] * late_im[k] + im[k] * late_re[k]
    for k in range(n):
        out[k] = complex(loop.gain * re[k], loop.gain * im[k])


@routine
def _newton(
    w: complex, mu: ComplexArray, alpha: ComplexArray, beta: ComplexArray, every: ComplexArray, loop: LoopResponse
) -> complex:
    """Return the logarithmic derivative of 1 + L times the product of (w - p) over all poles `every`.

    The derivative is with respect to w.
    """
    late = reciprocal(1.0 + w)
    total, slope = loop.direct[0] + loop.direct[1] * late, -loop.direct[1] * late * late
    for i in range(len(mu)):
        near = reciprocal(w - mu[i])
        value = (alpha[i] + beta[i] * late) * near
        total += value
        slope -= value * near + beta[i] * late * late * near
    top, by = loop.gain * total + 0j, slope * reciprocal(total)
    for i in range(len(loop.zeros)):
        top = top * (w - loop.zeros[i])
        by += reciprocal(w - loop.zeros[i])
    for i in range(len(loop.poles)):
        near = reciprocal(w - loop.poles[i])
        top = top * near
        by -= near
    for _ in range(loop.periods):
        top = top * late
        by -= late
    out = by * reciprocal(1.0 + reciprocal(top))
    for i in range(len(every)):
        out += reciprocal(w - every[i])
    return complex(out)


@routine
def zeros_of_one_plus(
    roots: ComplexArray,
    mu: ComplexArray,
    alpha: ComplexArray,
    beta: ComplexArray,
    every: ComplexArray,
    loop: LoopResponse,
) -> bool:
    """Refine all zeros of 1 + L in place by Aberth's method. Return False if the iteration does not converge."""
    n = len(roots)
    done = np.zeros(n, np.bool_)
    for _ in range(_MOST_ROUNDS):
        left = 0
        for i in range(n):
            if done[i]:
                continue
            by = _newton(roots[i], mu, alpha, beta, every, loop)
            for k in range(n):
                if k != i:
                    by -= reciprocal(roots[i] - roots[k])
            move = reciprocal(by)
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
