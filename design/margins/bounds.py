"""Crossings that come in pairs between two points of a curve: excluded, or separated, by bounds on derivatives.

Where all zeros and poles p of L are known, the derivatives of ln |L| and of the phase along the frequency axis are sums
of one term for each: of a factor (j w - p) real and imaginary part of j / (j w - p), and of a factor (z - p) of a
sampled loop, z = exp(j t), those of j z / (z - p). Each term is monotone in t but for a few places that are known:

    s   ln |.|: +-1 / (2 |Re p|) at w = Im p +- |Re p|         phase: -1 / Re p at w = Im p
    z   ln |.|: +-r / |1 - r^2| where cos (t - u) = 2 r / (1 + r^2)    phase: 1 / (1 -+ r) at t = u, u + pi,

p = r exp(j u). So every term, and their sum, has bounds that hold over a whole interval (interval arithmetic up to
rounding: R. E. Moore, Interval Analysis, 1966). An interval is settled where a function is monotone in it, or of one
sign at both ends and too flat to reach zero in between; any other is halved. What is left at a relative width of NARROW
touches zero rather than crosses it, as far as double precision tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array, IntArray
from maxq.design.loop.loop import OpenLoop
from maxq.design.margins.curve import FLOOR
from maxq.design.margins.response import sampled
from maxq.design.margins.solving import TINY, from_minus_one_deg
from maxq.design.model.state_space import ComplexArray

NARROW = 1e-9
CANCELLED = 1e-9  # relative distance at which a zero and a pole take each other away
AGREES = 1e-3  # of ln L less its zeros and poles, along the curve: they are those of L
PROBES = 64  # points of the curve at which they are compared
MOST_HALVINGS = 40

Range = tuple[Array, Array]


@dataclass(frozen=True)
class Factors:
    """Zeros and poles of L, in s, or in z at a period."""

    at: ComplexArray
    sign: Array  # +1 of a zero, -1 of a pole
    sample_s: float | None

    @classmethod
    def of(cls, loop: OpenLoop) -> Factors | None:
        """None where they are not known, or without number."""
        known = loop.factors()
        if known is None:
            return None
        zeros, poles = known
        gone: tuple[set[int], set[int]] = (set(), set())
        near = np.abs(zeros[:, None] - poles) < CANCELLED * np.maximum(np.abs(poles), TINY)
        for i, j in np.argwhere(near).tolist():
            if i not in gone[0] and j not in gone[1]:
                gone[0].add(i)
                gone[1].add(j)
        zeros, poles = np.delete(zeros, list(gone[0])), np.delete(poles, list(gone[1]))
        sign = np.append(np.ones(len(zeros)), -np.ones(len(poles)))
        return cls(np.concatenate([zeros, poles]), sign, loop.sample_s)

    def angle(self, frequency_hz: Array) -> Array:
        """w in rad/s, or t = w T."""
        return 2.0 * np.pi * frequency_hz * (1.0 if self.sample_s is None else self.sample_s)

    def agree(self, frequency_hz: Array, loop: ComplexArray) -> NDArray[np.bool_]:
        """Where along the curve L is the product of its factors, by a constant the same for most points."""
        k = np.unique(np.linspace(0.0, len(loop) - 1.0, PROBES).astype(int))
        t = self.angle(frequency_hz[k])
        x = 1j * t if self.sample_s is None else np.exp(1j * t)
        with np.errstate(all="ignore"):
            left = np.log(loop[k]) - (self.sign * np.log(x[:, None] - self.at)).sum(axis=1)
            size = np.abs(left.real - np.median(left.real)) < AGREES
            same = np.abs(np.sin(left.imag - left.imag[:, None])) < AGREES
        both = size & (same.sum(axis=0) > 0.5 * len(k))
        return np.asarray(np.interp(np.arange(len(loop)), k, both) == 1.0)

    def slopes(self, low_hz: Array, high_hz: Array) -> tuple[Range, Range]:
        """Least and greatest derivative of ln |L| and of the phase over intervals in rising order."""
        low, high = self.angle(low_hz), self.angle(high_hz)
        ends = [self._terms(t) for t in (low, high)]
        out = []
        for part, places in zip((np.real, np.imag), self._extremes(), strict=True):
            one, other = (part(end) * self.sign for end in ends)
            least, most = np.minimum(one, other), np.maximum(one, other)
            for at, value in places:
                # intervals are apart or touch: at most one holds a place
                k = np.searchsorted(low, at, side="right") - 1
                j = np.flatnonzero((k >= 0) & (at > low[k]) & (at < high[k]))
                signed = (value * self.sign)[j]
                least[k[j], j] = np.minimum(least[k[j], j], signed)
                most[k[j], j] = np.maximum(most[k[j], j], signed)
            out.append((least.sum(axis=1), most.sum(axis=1)))
        return out[0], out[1]

    def _terms(self, t: Array) -> ComplexArray:
        """(points, factors): derivative of ln of each factor."""
        with np.errstate(all="ignore"):
            if self.sample_s is None:
                return np.asarray(1j / (1j * t[:, None] - self.at))
            z = np.exp(1j * t)[:, None]
            return np.asarray(1j * z / (z - self.at))

    def _extremes(self) -> tuple[list[Range], list[Range]]:
        """Of ln |.| and of the phase of each factor: places (factors,) and the values there."""
        with np.errstate(all="ignore"):
            if self.sample_s is None:
                a, w = self.at.real, self.at.imag
                top = 0.5 / np.abs(a)
                return [(w + np.abs(a), top), (w - np.abs(a), -top)], [(w, -1.0 / a)]
            r, u = np.abs(self.at), np.angle(self.at)
            near, top = np.arccos(np.clip(2.0 * r / (1.0 + r * r), -1.0, 1.0)), r / np.abs(1.0 - r * r)
            # t lies from 0 to pi, u + near up to 2 pi and u - near down to -2 pi
            size = [(u + near, top), (u - near, -top), (u + near - 2.0 * np.pi, top), (u - near + 2.0 * np.pi, -top)]
            far = 1.0 / (1.0 + r)
            return size, [(u, 1.0 / (1.0 - r)), (u + np.pi, far), (u - np.pi, far)]


def separated(loop: OpenLoop, f: Array, values: ComplexArray) -> tuple[Array, ComplexArray]:
    """Return a curve with as many more points as it takes that no step hides two crossings of |L| = 1, or two of the
    negative real axis where |L| is above FLOOR.

    It is left alone where the zeros and poles of L are not known, or are not those of the curve.
    """
    factors = Factors.of(loop)
    if factors is None:
        return f, values
    agree = factors.agree(f, values)
    open_ = np.flatnonzero(agree[1:] & agree[:-1])
    for _ in range(MOST_HALVINGS):
        open_ = open_[f[open_ + 1] - f[open_] > NARROW * f[open_ + 1]]
        if not len(open_):
            break
        open_ = open_[_unsettled(factors, f, values, open_)]
        middle = 0.5 * (f[open_] + f[open_ + 1])
        f, values = np.insert(f, open_ + 1, middle), np.insert(values, open_ + 1, sampled(loop, middle))
        first = open_ + np.arange(len(open_))
        open_ = np.sort(np.concatenate([first, first + 1]))
    return f, values


def _unsettled(factors: Factors, f: Array, values: ComplexArray, k: IntArray) -> NDArray[np.bool_]:
    """Which of the steps from point `k` may hide a pair."""
    size, phase = factors.slopes(f[k], f[k + 1])
    width = factors.angle(f[k + 1] - f[k])
    gain = np.log(np.maximum(np.abs(values), TINY))
    before = np.radians(from_minus_one_deg(values[k]))
    turn = np.angle(values[k + 1] * np.conj(values[k]))
    # the true turn is this one where no other fits into the bounds
    ambiguous = (phase[1] - phase[0]) * width > np.pi
    small = np.maximum(_greatest(gain[k], gain[k + 1], size, width), gain[k]) < np.log(FLOOR)
    hidden = _may_hide(before, before + turn, phase, width) | ambiguous
    # a turn through the positive real axis is none through the negative one
    for whole in (-2.0 * np.pi, 2.0 * np.pi):
        hidden |= _may_hide(before + whole, before + turn + whole, phase, width)
    return np.asarray(_may_hide(gain[k], gain[k + 1], size, width) | (hidden & ~small))


def _greatest(first: Array, last: Array, slope: Range, width: Array) -> Array:
    """Upper bound of a function over steps, from its ends and the bounds of its slope."""
    low, high = slope
    with np.errstate(divide="ignore", invalid="ignore"):
        peak = (high * last - low * first - low * high * width) / (high - low)
    return np.where((low < 0.0) & (high > 0.0), np.nan_to_num(peak, nan=np.inf), np.maximum(first, last))


def _may_hide(first: Array, last: Array, slope: Range, width: Array) -> NDArray[np.bool_]:
    """Whether a function with these ends may have more zeros in a step than its ends show."""
    low, high = slope
    turns = (low < 0.0) & (high > 0.0)
    above = -_greatest(-first, -last, (-high, -low), width) > 0.0
    below = _greatest(first, last, slope, width) < 0.0
    return np.asarray(turns & ~above & ~below)
