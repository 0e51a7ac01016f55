"""The separation of crossings that occur in pairs between two points of a curve, by bounds on derivatives.

All zeros and poles p of L must be known. The derivatives of ln |L| and of the phase along the frequency axis are then
sums with one term for each. The term of a factor (j w - p) is the real and imaginary part of j / (j w - p). The term of
a factor (z - p) of a sampled loop, z = exp(j t), is the real and imaginary part of j z / (z - p). Each term is monotone
in t between its extremes, which are known:

    s   ln |.|: +-1 / (2 |Re p|) at w = Im p +- |Re p|         phase: -1 / Re p at w = Im p
    z   ln |.|: +-r / |1 - r^2| where cos (t - u) = 2 r / (1 + r^2)    phase: 1 / (1 -+ r) at t = u, u + pi,

p = r exp(j u). Every term, and therefore their sum, has bounds that hold over a whole interval (interval arithmetic,
except for rounding: R. E. Moore, Interval Analysis, 1966). An interval is settled if a function is monotone in it. It
is also settled if the function has the same sign at both ends and too small a slope to reach zero in between. Any other
interval is halved. If an interval remains unsettled at a relative width of NARROW, the function touches zero rather
than crosses it, within double precision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.design.loop.loop import OpenLoop
from maxq.design.margins.curve import FLOOR, merged
from maxq.design.margins.response import TWO_PI, LoopResponse, reciprocal
from maxq.design.margins.solving import TINY, angle, log_abs
from maxq.design.model.state_space import ComplexArray

NARROW = 1e-9
CANCELLED = 1e-9  # relative distance at which a zero and a pole cancel
AGREES = 1e-3  # permitted variation of ln L minus the sum of its factors along the curve
PROBES = 64  # points of the curve at which L is compared with its factors
MOST_HALVINGS = 40


class ZerosAndPoles(NamedTuple):
    """The zeros and poles of L in s, or in z for a sampled loop, (factors,).

    `sign` is +1 for a zero and -1 for a pole. `period_s` is the sampling period, or 0 in s. `size_at` and `phase_at`,
    (places, factors), locate the extremes of the derivatives of each factor's ln |.| and phase, in rad/s or as t = w T.
    `size` and `phase` are the values at these extremes.
    """

    at: ComplexArray
    sign: Array
    period_s: float
    size_at: Array
    size: Array
    phase_at: Array
    phase: Array


def factors_of(loop: OpenLoop) -> ZerosAndPoles:
    """Return the zeros and poles of a loop without cancelling pairs, or empty arrays if they are unknown."""
    known = loop.factors()
    if known is None:
        return with_extremes(np.zeros(0, np.complex128), np.zeros(0), 0.0)
    zeros, poles = known
    gone: tuple[set[int], set[int]] = (set(), set())
    near = np.abs(zeros[:, None] - poles) < CANCELLED * np.maximum(np.abs(poles), TINY)
    for i, j in np.argwhere(near).tolist():
        if i not in gone[0] and j not in gone[1]:
            gone[0].add(i)
            gone[1].add(j)
    zeros, poles = np.delete(zeros, list(gone[0])), np.delete(poles, list(gone[1]))
    sign = np.append(np.ones(len(zeros)), -np.ones(len(poles)))
    return with_extremes(np.concatenate([zeros, poles]).astype(np.complex128), sign, loop.sample_s or 0.0)


def with_extremes(at: ComplexArray, sign: Array, period_s: float) -> ZerosAndPoles:
    """Return the zeros and poles with the locations and values of the extremes of their derivatives."""
    with np.errstate(all="ignore"):
        if period_s == 0.0:
            a, w = np.abs(at.real), at.imag
            size_at, size = [w + a, w - a], [0.5 / a, -0.5 / a]
            phase_at, phase = [w], [-1.0 / at.real]
        else:
            r, u = np.abs(at), np.angle(at)
            near, top = np.arccos(np.clip(2.0 * r / (1.0 + r * r), -1.0, 1.0)), r / np.abs(1.0 - r * r)
            # t is in [0, pi], while u + near reaches 2 pi and u - near reaches -2 pi
            size_at = [u + near, u - near, u + near - 2.0 * np.pi, u - near + 2.0 * np.pi]
            size, far = [top, -top, top, -top], 1.0 / (1.0 + r)
            phase_at, phase = [u, u + np.pi, u - np.pi], [1.0 / (1.0 - r), far, far]
    return ZerosAndPoles(at, sign, period_s, np.array(size_at), np.array(size), np.array(phase_at), np.array(phase))


@routine
def _agree(f: Array, loop: ComplexArray, by: ZerosAndPoles) -> NDArray[np.bool_]:
    """Return True for the points of the curve at which L is the product of its factors, up to a common constant."""
    n = len(f)
    probes = np.unique(np.linspace(0.0, n - 1.0, PROBES).astype(np.int64))
    m = len(probes)
    size, turn, good = np.empty(m), np.empty(m), np.zeros(m, np.bool_)
    for i in range(m):
        x = _point(f[probes[i]], by.period_s)
        size[i], turn[i] = log_abs(loop[probes[i]]), angle(loop[probes[i]])
        for j in range(len(by.at)):
            size[i] -= by.sign[j] * np.log(abs(x - by.at[j]))
            turn[i] -= by.sign[j] * angle(x - by.at[j])
    middle = np.median(size)
    for i in range(m):
        alike = 0
        for k in range(m):
            alike += 1 if abs(np.sin(turn[k] - turn[i])) < AGREES else 0
        good[i] = abs(size[i] - middle) < AGREES and alike > 0.5 * m
    out = np.zeros(n, np.bool_)
    for i in range(m):
        out[probes[i]] = good[i]
        if i + 1 < m and good[i] and good[i + 1]:
            out[probes[i] : probes[i + 1]] = True
    return out


@routine
def _point(hz: float, period_s: float) -> complex:
    """Return the point s on the imaginary axis, or z on the unit circle, of a frequency in Hz."""
    if period_s == 0.0:
        return complex(0.0, TWO_PI * hz)
    return complex(np.exp(complex(0.0, TWO_PI * hz * period_s)))


@kernel
def _range_of(
    first: float, last: float, low: float, high: float, places: Array, values: Array, j: int
) -> tuple[float, float]:
    """Return the least and greatest value of a factor's derivative over an interval, from its ends and its extremes."""
    least, most = min(first, last), max(first, last)
    for k in range(len(places)):
        if low < places[k, j] < high:
            least, most = min(least, values[k, j]), max(most, values[k, j])
    return least, most


@routine
def slopes(low_hz: float, high_hz: float, by: ZerosAndPoles) -> tuple[float, float, float, float]:
    """Return the least and greatest derivative of ln |L|, then of the phase, over an interval.

    The derivatives are with respect to w (rad/s), or t = w T for a sampled loop. They are NaN or infinite if an end of
    the interval is a zero or pole.
    """
    per_hz = TWO_PI * (by.period_s if by.period_s > 0.0 else 1.0)
    low, high = low_hz * per_hz, high_hz * per_hz
    left, right = _point(low_hz, by.period_s), _point(high_hz, by.period_s)
    turn_left, turn_right = (1j * left, 1j * right) if by.period_s > 0.0 else (1j, 1j)
    size_least = size_most = phase_least = phase_most = 0.0
    for j in range(len(by.at)):
        first, last = turn_left * reciprocal(left - by.at[j]), turn_right * reciprocal(right - by.at[j])
        if np.isnan(first.real + last.real):
            return np.nan, np.nan, np.nan, np.nan
        least, most = _range_of(first.real, last.real, low, high, by.size_at, by.size, j)
        size_least += least if by.sign[j] > 0.0 else -most
        size_most += most if by.sign[j] > 0.0 else -least
        least, most = _range_of(first.imag, last.imag, low, high, by.phase_at, by.phase, j)
        phase_least += least if by.sign[j] > 0.0 else -most
        phase_most += most if by.sign[j] > 0.0 else -least
    return size_least, size_most, phase_least, phase_most


@routine
def separated(f: Array, loop: ComplexArray, by: ZerosAndPoles, source: LoopResponse) -> tuple[Array, ComplexArray]:
    """Return a curve with added points, such that no interval between two points hides two crossings.

    The crossings are those of |L| = 1, and those of the negative real axis where |L| is above FLOOR. The curve is
    unchanged if the zeros and poles of L are unknown or inconsistent with the curve.
    """
    if len(by.at) == 0:
        return f, loop
    agree = _agree(f, loop, by)
    steps = np.flatnonzero(agree[1:] & agree[:-1])
    for _ in range(MOST_HALVINGS):
        middle, m = np.empty(len(steps)), 0
        for k in steps:
            if f[k + 1] - f[k] > NARROW * f[k + 1] and _unsettled(f[k], f[k + 1], loop[k], loop[k + 1], by):
                middle[m] = 0.5 * (f[k] + f[k + 1])
                m += 1
        if m == 0:
            break
        f, loop, places = merged(f, loop, middle[:m], source)
        steps = np.sort(np.concatenate((places - 1, places)))
    return f, loop


@routine
def _unsettled(low_hz: float, high_hz: float, first: complex, last: complex, by: ZerosAndPoles) -> bool:
    """Return True for an interval that may hide a pair of crossings."""
    size_least, size_most, phase_least, phase_most = slopes(low_hz, high_hz, by)
    width = (high_hz - low_hz) * TWO_PI * (by.period_s if by.period_s > 0.0 else 1.0)
    gain, next_gain = log_abs(first), log_abs(last)
    if _may_hide(gain, next_gain, size_least, size_most, width):
        return True
    if max(_greatest(gain, next_gain, size_least, size_most, width), gain) < np.log(FLOOR):
        return False
    # the principal turn is the true one if the bounds exclude all others
    if (phase_most - phase_least) * width > 0.5 * TWO_PI:
        return True
    before, turn = angle(-first), angle(last * first.conjugate())
    # checks the crossings of -180 + 360 k degrees only
    for whole in (0.0, -TWO_PI, TWO_PI):
        if _may_hide(before + whole, before + turn + whole, phase_least, phase_most, width):
            return True
    return False


@routine
def _greatest(first: float, last: float, low: float, high: float, width: float) -> float:
    """Return an upper bound of a function over an interval, from its end values and the bounds of its slope."""
    if low < 0.0 < high:
        peak = (high * last - low * first - low * high * width) / (high - low)
        return np.inf if np.isnan(peak) else peak
    return max(first, last)


@routine
def _may_hide(first: float, last: float, low: float, high: float, width: float) -> bool:
    """Return True if a function with these end values and slope bounds may have a hidden pair of zeros."""
    if not low < 0.0 < high:
        return False
    return bool(
        -_greatest(-first, -last, -high, -low, width) <= 0.0 and _greatest(first, last, low, high, width) >= 0.0
    )
